//! One opened file: its header as plain data, and values on request. The formats meet here.

use super::SourceError;
use super::classic::ClassicStore;
use super::hdf5_store::Hdf5Store;
use super::netcdf4::NetCdf4Store;
use std::fs::File;
use std::io::{Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

/// External type of a variable or attribute.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum NumberType {
    I8,
    U8,
    I16,
    U16,
    I32,
    U32,
    I64,
    U64,
    F32,
    F64,
    /// Characters, one byte each.
    Text,
    /// Types that hold no numbers.
    Other,
}

impl NumberType {
    pub(crate) fn is_number(self) -> bool {
        !matches!(self, Self::Text | Self::Other)
    }

    /// Bytes of one in a file, at least.
    fn bytes(self) -> u64 {
        match self {
            Self::I8 | Self::U8 | Self::Text | Self::Other => 1,
            Self::I16 | Self::U16 => 2,
            Self::I32 | Self::U32 | Self::F32 => 4,
            Self::I64 | Self::U64 | Self::F64 => 8,
        }
    }

    pub(crate) fn is_float(self) -> bool {
        matches!(self, Self::F32 | Self::F64)
    }

    pub(crate) fn name(self) -> &'static str {
        match self {
            Self::I8 => "int8",
            Self::U8 => "uint8",
            Self::I16 => "int16",
            Self::U16 => "uint16",
            Self::I32 => "int32",
            Self::U32 => "uint32",
            Self::I64 => "int64",
            Self::U64 => "uint64",
            Self::F32 => "float32",
            Self::F64 => "float64",
            Self::Text => "text",
            Self::Other => "other",
        }
    }
}

/// Value of an attribute.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum Attribute {
    Text(String),
    Numbers(NumberType, Vec<f64>),
}

/// A named extent.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Dimension {
    pub(crate) name: String,
    pub(crate) len: usize,
}

/// A variable's header.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Variable {
    pub(crate) name: String,
    pub(crate) number: NumberType,
    /// Indices into [`Header::dimensions`], slowest first.
    pub(crate) dimensions: Vec<usize>,
    pub(crate) attributes: Vec<(String, Attribute)>,
}

impl Variable {
    /// Attribute of this name, whatever its case.
    pub(crate) fn attribute(&self, name: &str) -> Option<&Attribute> {
        self.attributes.iter().find(|(n, _)| n.eq_ignore_ascii_case(name)).map(|(_, a)| a)
    }

    /// Text attribute, trimmed.
    pub(crate) fn text(&self, name: &str) -> Option<&str> {
        match self.attribute(name) {
            Some(Attribute::Text(text)) => Some(text.trim()),
            _ => None,
        }
    }

    /// Numbers of an attribute (none when it is text or absent).
    pub(crate) fn numbers(&self, name: &str) -> &[f64] {
        match self.attribute(name) {
            Some(Attribute::Numbers(_, values)) => values,
            _ => &[],
        }
    }

    /// `units`, or `unit` as some products write it.
    pub(crate) fn units(&self) -> Option<&str> {
        self.text("units").or_else(|| self.text("unit"))
    }
}

/// All that a file says about itself.
#[derive(Debug, Clone, Default, PartialEq)]
pub(crate) struct Header {
    pub(crate) dimensions: Vec<Dimension>,
    pub(crate) variables: Vec<Variable>,
    /// Attributes of the file itself.
    pub(crate) attributes: Vec<(String, Attribute)>,
}

impl Header {
    /// First number of an attribute of the file.
    pub(crate) fn number(&self, name: &str) -> Option<f64> {
        match self.attributes.iter().find(|(n, _)| n == name) {
            Some((_, Attribute::Numbers(_, values))) => values.first().copied(),
            _ => None,
        }
    }

    /// Index of a dimension, which is added where it is not there.
    pub(crate) fn dimension(&mut self, dimension: Dimension) -> usize {
        self.dimensions.iter().position(|d| *d == dimension).unwrap_or_else(|| {
            self.dimensions.push(dimension);
            self.dimensions.len() - 1
        })
    }

    /// The same header with these variables only.
    pub(crate) fn part(&self, names: &[String]) -> Self {
        let variables = self.variables.iter().filter(|v| names.contains(&v.name)).cloned().collect();
        Self { dimensions: self.dimensions.clone(), variables, attributes: Vec::new() }
    }

    pub(crate) fn find(&self, name: &str) -> Option<usize> {
        self.variables.iter().position(|v| v.name == name)
    }

    pub(crate) fn shape(&self, variable: &Variable) -> Vec<usize> {
        variable.dimensions.iter().map(|&d| self.dimensions[d].len).collect()
    }

    /// `time, lat, lon`.
    pub(crate) fn dimension_names(&self, variable: &Variable) -> String {
        variable.dimensions.iter().map(|&d| self.dimensions[d].name.as_str()).collect::<Vec<_>>().join(", ")
    }
}

/// File formats that are told apart.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Format {
    /// NetCDF classic: version 1, 2 (64-bit offset) or 5 (64-bit data).
    Classic(u8),
    /// NetCDF-4.
    NetCdf4,
    /// HDF5 without the structure of NetCDF.
    Hdf5,
}

impl Format {
    pub(crate) fn name(self) -> &'static str {
        match self {
            Self::Classic(1) => "NetCDF classic",
            Self::Classic(2) => "NetCDF 64-bit offset",
            Self::Classic(_) => "NetCDF 64-bit data",
            Self::NetCdf4 => "NetCDF-4",
            Self::Hdf5 => "HDF5",
        }
    }
}

enum Store {
    Classic(ClassicStore),
    NetCdf4(NetCdf4Store),
    Hdf5(Hdf5Store),
}

/// Deflate shrinks at most this much: a variable that would be larger than its file by more was never written.
const LARGEST_SHRINKAGE: u64 = 1032;
/// Values that any file may hold, however small it is.
const ALWAYS_ALLOWED: u64 = 1 << 20;

/// An open file.
pub(crate) struct Container {
    pub(crate) path: PathBuf,
    pub(crate) format: Format,
    pub(crate) header: Header,
    store: Store,
    /// Bytes of the file.
    length: u64,
}

impl Container {
    /// Opens a file and reads its header, nothing else.
    pub(crate) fn open(path: &Path) -> Result<Self, SourceError> {
        Self::open_like(path, None)
    }

    /// The same where a file is expected to hold the variables of `like`: where it saves time, others are left out of the header, and the names
    /// of dimensions are taken on trust. (Of a NetCDF-4 file libnetcdf reads every variable: milliseconds, and many small reads.)
    pub(crate) fn open_like(path: &Path, like: Option<&Header>) -> Result<Self, SourceError> {
        let failed = |cause| SourceError::Open { path: path.to_path_buf(), cause };
        let mut file = crate::files::open(path).map_err(failed)?;
        let length = file.metadata().map_err(failed)?.len();
        let format = sniff(&mut file, length).map_err(failed)?.map_err(|found| SourceError::NotNetCdf { path: path.into(), found })?;
        let (format, header, store) = match format {
            Format::Classic(version) => {
                let (header, store) = ClassicStore::open(path, file, length, version)?;
                (format, header, Store::Classic(store))
            }
            Format::NetCdf4 | Format::Hdf5 => match like.and_then(|like| Hdf5Store::open_like(path, like)) {
                Some((header, store)) => (Format::NetCdf4, header, Store::Hdf5(store)),
                None => match NetCdf4Store::open(path)? {
                    Some((header, store)) => (Format::NetCdf4, header, Store::NetCdf4(store)),
                    None => {
                        let (header, store) = Hdf5Store::open(path)?;
                        (Format::Hdf5, header, Store::Hdf5(store))
                    }
                },
            },
        };
        Ok(Self { path: path.to_path_buf(), format, header, store, length })
    }

    /// Number of values in a block of a variable; refused where the file is too short for so many.
    pub(crate) fn check_count(&self, variable: usize, count: &[usize]) -> Result<usize, SourceError> {
        let header = &self.header.variables[variable];
        let failed = |what: String| SourceError::Read { path: self.path.clone(), variable: header.name.clone(), what };
        let total = count.iter().try_fold(1usize, |n, &c| n.checked_mul(c)).ok_or_else(|| failed(format!("{count:?} values overflow")))?;
        let largest = self.length.saturating_mul(LARGEST_SHRINKAGE) / header.number.bytes();
        if total as u64 <= largest.max(ALWAYS_ALLOWED) {
            return Ok(total);
        }
        Err(failed(format!("{total} values cannot come from a file of {} bytes: it is damaged or was never written", self.length)))
    }

    /// Raw values of a hyperslab as `f64` (no unpacking), in the file's order, slowest dimension first.
    pub(crate) fn read(&self, variable: usize, start: &[usize], count: &[usize]) -> Result<Vec<f64>, SourceError> {
        let header = &self.header.variables[variable];
        let failed = |what: String| SourceError::Read { path: self.path.clone(), variable: header.name.clone(), what };
        let shape = self.header.shape(header);
        let inside = start.len() == shape.len() && count.len() == shape.len();
        if !inside || (0..shape.len()).any(|k| start[k].checked_add(count[k]).is_none_or(|end| end > shape[k])) {
            return Err(failed(format!("{count:?} values from {start:?} were asked for, but its shape is {shape:?}")));
        }
        if header.number == NumberType::Other {
            return Err(failed("it holds no numbers".into()));
        }
        let total = self.check_count(variable, count)?;
        let mut values: Vec<f64> = Vec::new();
        values.try_reserve_exact(total).map_err(|_| failed(format!("no memory for {total} values")))?;
        if total > 0 {
            match &self.store {
                Store::Classic(store) => store.read(variable, &shape, start, count, &mut values).map_err(|e| failed(e.to_string()))?,
                Store::NetCdf4(store) => store.read(&header.name, header.number, start, count, total, &mut values).map_err(failed)?,
                Store::Hdf5(store) => store.read(&header.name, start, count, &mut values).map_err(failed)?,
            }
        }
        Ok(values)
    }

    /// Rows of characters along the last dimension, without what pads them.
    pub(crate) fn read_text(&self, variable: usize) -> Result<Vec<String>, SourceError> {
        let width = self.header.shape(&self.header.variables[variable]).last().copied().unwrap_or(1).max(1);
        let bytes = self.read_all(variable)?;
        let row = |row: &[f64]| row.iter().map(|&b| char::from(b as u8)).collect::<String>();
        Ok(bytes.chunks(width).map(|r| row(r).trim_matches(['\0', ' ']).to_owned()).collect())
    }

    /// All values of a variable.
    pub(crate) fn read_all(&self, variable: usize) -> Result<Vec<f64>, SourceError> {
        let shape = self.header.shape(&self.header.variables[variable]);
        self.read(variable, &vec![0; shape.len()], &shape)
    }
}

/// Tells the format by the first bytes; the inner error says what else the file seems to be.
fn sniff(file: &mut File, length: u64) -> std::io::Result<Result<Format, String>> {
    const HDF5: [u8; 8] = *b"\x89HDF\r\n\x1a\n";
    let mut head = [0u8; 8];
    let got = length.min(8) as usize;
    file.read_exact(&mut head[..got])?;
    file.seek(SeekFrom::Start(0))?;
    if let [b'C', b'D', b'F', version @ (1 | 2 | 5), ..] = head
        && got >= 4
    {
        return Ok(Ok(Format::Classic(version)));
    }
    // The signature of HDF5 may follow a user block of 512 bytes times a power of two.
    let mut at = 0u64;
    while at + 8 <= length && at <= 1 << 20 {
        let mut signature = [0u8; 8];
        file.seek(SeekFrom::Start(at))?;
        file.read_exact(&mut signature)?;
        if signature == HDF5 {
            return Ok(Ok(Format::Hdf5));
        }
        at = if at == 0 { 512 } else { at * 2 };
    }
    Ok(Err(match head {
        _ if got == 0 => "it is empty".into(),
        [b'G', b'R', b'I', b'B', ..] => "it is GRIB: convert it, for example with `cdo -f nc copy`".into(),
        [0x1f, 0x8b, ..] => "it is compressed with gzip: unpack it first".into(),
        [b'P', b'K', 3, 4, ..] => "it is a zip archive: unpack it first".into(),
        [b'C', b'D', b'F', version, ..] => format!("its version {version} is unknown"),
        _ => format!("it starts with {:?}", String::from_utf8_lossy(&head[..got])),
    }))
}
