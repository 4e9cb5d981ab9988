//! Requests to the formats and their answers: plain data that can cross a process boundary.

use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};
use thiserror::Error;

/// A question about one file.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub enum Request {
    /// Opens a file and lists what it holds.
    List {
        path: PathBuf,
        /// Listing of a file of the same kind. Where this saves time, only its variables are listed, and the names of dimensions
        /// are taken from it.
        expected: Option<Listing>,
    },
    /// Describes one variable.
    Describe { path: PathBuf, variable: String },
    /// Reads the block of `count` entries from `start` on, one number for each dimension of the variable.
    Read { path: PathBuf, variable: String, start: Vec<usize>, count: Vec<usize> },
}

/// The answer to a [`Request`].
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub enum Response {
    /// To [`Request::List`].
    Listing(Listing),
    /// To [`Request::Describe`].
    Description(Description),
    /// To [`Request::Read`]: raw numbers (not unpacked), slowest dimension first.
    Values(Vec<f64>),
}

/// External type of a variable or attribute.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum NumberType {
    Int8,
    Uint8,
    Int16,
    Uint16,
    Int32,
    Uint32,
    Int64,
    Uint64,
    Float32,
    Float64,
    /// Characters of one byte.
    Text,
    /// Types that hold no numbers.
    Other,
}

impl NumberType {
    pub fn is_number(self) -> bool {
        !matches!(self, Self::Text | Self::Other)
    }

    pub fn is_float(self) -> bool {
        matches!(self, Self::Float32 | Self::Float64)
    }

    /// Bytes of one number in a file; at least this many for [`NumberType::Other`].
    pub fn bytes(self) -> usize {
        match self {
            Self::Int8 | Self::Uint8 | Self::Text | Self::Other => 1,
            Self::Int16 | Self::Uint16 => 2,
            Self::Int32 | Self::Uint32 | Self::Float32 => 4,
            Self::Int64 | Self::Uint64 | Self::Float64 => 8,
        }
    }
}

/// Value of an attribute.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub enum Attribute {
    Text(String),
    Numbers(NumberType, Vec<f64>),
}

/// A named extent.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Dimension {
    pub name: String,
    pub len: usize,
}

/// A variable of a [`Listing`].
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Variable {
    pub name: String,
    pub number: NumberType,
    /// Indices into [`Listing::dimensions`], slowest first.
    pub dimensions: Vec<usize>,
    pub attributes: Vec<(String, Attribute)>,
}

impl Variable {
    /// Attribute of this name, regardless of case.
    pub fn attribute(&self, name: &str) -> Option<&Attribute> {
        self.attributes.iter().find(|(n, _)| n.eq_ignore_ascii_case(name)).map(|(_, a)| a)
    }

    /// Text attribute, trimmed.
    pub fn text(&self, name: &str) -> Option<&str> {
        match self.attribute(name) {
            Some(Attribute::Text(text)) => Some(text.trim()),
            _ => None,
        }
    }

    /// Numbers of an attribute; empty if it is text or absent.
    pub fn numbers(&self, name: &str) -> &[f64] {
        match self.attribute(name) {
            Some(Attribute::Numbers(_, values)) => values,
            _ => &[],
        }
    }

    /// `units`, or `unit` as some products write it.
    pub fn units(&self) -> Option<&str> {
        self.text("units").or_else(|| self.text("unit"))
    }
}

/// A variable by itself.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Description {
    pub number: NumberType,
    /// Slowest first.
    pub dimensions: Vec<Dimension>,
    pub attributes: Vec<(String, Attribute)>,
}

/// File formats.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum Format {
    /// NetCDF classic: version 1, 2 (64-bit offset) or 5 (64-bit data).
    Classic(u8),
    /// NetCDF-4.
    NetCdf4,
    /// HDF5 without the structure of NetCDF.
    Hdf5,
    /// GRIB whose first message is of this edition.
    Grib(u8),
    /// Zarr of this version, and whether its arrays name their dimensions.
    Zarr { version: u8, named: bool },
}

impl Format {
    pub fn name(self) -> &'static str {
        match self {
            Self::Classic(1) => "NetCDF classic",
            Self::Classic(2) => "NetCDF 64-bit offset",
            Self::Classic(_) => "NetCDF 64-bit data",
            Self::NetCdf4 => "NetCDF-4",
            Self::Hdf5 => "HDF5",
            Self::Grib(1) => "GRIB 1",
            Self::Grib(_) => "GRIB 2",
            Self::Zarr { version: 2, .. } => "Zarr 2",
            Self::Zarr { .. } => "Zarr 3",
        }
    }

    /// True if files of this format name their dimensions, so that coordinates can be found by name.
    pub fn names_dimensions(self) -> bool {
        !matches!(self, Self::Hdf5 | Self::Zarr { named: false, .. })
    }
}

/// Attribute of a variable of [`NumberType::Other`]: why it cannot be read.
pub const UNREADABLE: &str = "unreadable";

/// Dimensions, variables and attributes of a file.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Listing {
    pub path: PathBuf,
    pub format: Format,
    /// Length of the file; `u64::MAX` if it does not bound what the file holds.
    pub bytes: u64,
    pub dimensions: Vec<Dimension>,
    pub variables: Vec<Variable>,
    /// Attributes of the file itself.
    pub attributes: Vec<(String, Attribute)>,
}

/// Largest factor by which deflate shrinks data. A variable larger than its file by more than this was never written.
const MAX_COMPRESSION: u64 = 1032;
/// Values that any file may hold, however small it is.
const ALWAYS_ALLOWED: u64 = 1 << 20;

impl Listing {
    /// Attribute of the file.
    pub fn attribute(&self, name: &str) -> Option<&Attribute> {
        self.attributes.iter().find(|(n, _)| n == name).map(|(_, a)| a)
    }

    /// First number of an attribute of the file.
    pub fn number(&self, name: &str) -> Option<f64> {
        match self.attribute(name) {
            Some(Attribute::Numbers(_, values)) => values.first().copied(),
            _ => None,
        }
    }

    /// Index of a dimension, which is added if it is new.
    pub fn dimension(&mut self, dimension: Dimension) -> usize {
        self.dimensions.iter().position(|d| *d == dimension).unwrap_or_else(|| {
            self.dimensions.push(dimension);
            self.dimensions.len() - 1
        })
    }

    /// This listing with the named variables only.
    pub fn part(&self, names: &[String]) -> Self {
        let variables = self.variables.iter().filter(|v| names.contains(&v.name)).cloned().collect();
        Self { variables, attributes: Vec::new(), ..self.clone() }
    }

    /// Index of a variable.
    pub fn find(&self, name: &str) -> Option<usize> {
        self.variables.iter().position(|v| v.name == name)
    }

    /// Indices of the variables that `fits` accepts.
    pub fn matching(&self, fits: impl Fn(&Variable) -> bool) -> impl Iterator<Item = usize> {
        (0..self.variables.len()).filter(move |&i| fits(&self.variables[i]))
    }

    /// Lengths of the dimensions of a variable, slowest first.
    pub fn shape(&self, variable: &Variable) -> Vec<usize> {
        variable.dimensions.iter().map(|&d| self.dimensions[d].len).collect()
    }

    /// Names of the dimensions of a variable: `time, lat, lon`.
    pub fn dimension_names(&self, variable: &Variable) -> String {
        variable.dimensions.iter().map(|&d| self.dimensions[d].name.as_str()).collect::<Vec<_>>().join(", ")
    }

    /// Number of values in a block of a variable.
    ///
    /// # Errors
    /// The file is too short to hold this many values.
    pub fn check_count(&self, variable: &Variable, count: &[usize]) -> Result<usize, FormatError> {
        let failed = |what| self.read_error(&variable.name, what);
        let total = count.iter().try_fold(1usize, |n, &c| n.checked_mul(c)).ok_or_else(|| failed(format!("{count:?} values overflow")))?;
        let max = self.bytes.saturating_mul(MAX_COMPRESSION) / variable.number.bytes() as u64;
        if total as u64 <= max.max(ALWAYS_ALLOWED) {
            return Ok(total);
        }
        Err(failed(format!("{total} values cannot come from a file of {} bytes: it is damaged or was never written", self.bytes)))
    }

    /// Error about the values of a variable.
    pub fn read_error(&self, variable: &str, what: impl ToString) -> FormatError {
        FormatFault::Read(variable.into(), what.to_string()).of(&self.path)
    }
}

/// A file that could not be opened or read.
#[derive(Debug, Clone, PartialEq, Error, Serialize, Deserialize)]
#[error("{}: {fault}", path.display())]
pub struct FormatError {
    /// The file.
    pub path: PathBuf,
    /// The fault.
    pub fault: FormatFault,
}

/// Fault of a file.
#[derive(Debug, Clone, PartialEq, Error, Serialize, Deserialize)]
pub enum FormatFault {
    /// The operating system refuses, with this error.
    #[error("cannot be opened: {0}")]
    Open(String),
    /// Another process writes to the file, or HDF5 cannot lock it, for this reason.
    #[error("cannot be locked: {0}. To read it all the same, set HDF5_USE_FILE_LOCKING=FALSE in the environment")]
    Locked(String),
    /// Another format, perhaps this one.
    #[error(
        "neither NetCDF, HDF5, GRIB nor Zarr ({0}); accepted are NetCDF classic, 64-bit offset, 64-bit data, NetCDF-4, HDF5, GRIB 1 and 2, \
         and Zarr 2 and 3"
    )]
    Unknown(String),
    /// The file is shorter than its header says.
    #[error("truncated: {found} bytes, but its header needs {expected}")]
    Truncated {
        /// Bytes that the header needs.
        expected: u64,
        /// Bytes of the file.
        found: u64,
    },
    /// A header that contradicts itself, or that a library refuses.
    #[error("damaged or truncated: {0}")]
    Damaged(String),
    /// The file may be whole, but reading it would reach other files, or cost more than is accepted: the reason.
    #[error("refused: {0}")]
    Refused(String),
    /// The values of this variable cannot be read, for this reason.
    #[error("variable `{0}` cannot be read: {1}")]
    Read(String, String),
}

impl FormatFault {
    /// The fault of this file.
    pub fn of(self, path: &Path) -> FormatError {
        FormatError { path: path.into(), fault: self }
    }
}
