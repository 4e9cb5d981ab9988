//! What can be wrong with an archive, in words that name the file, the variable, what was found and what is accepted.

use crate::field::AxisFault;
use crate::setting::Refused;
use std::path::PathBuf;
use thiserror::Error;

/// Why velocity data could not be read.
#[derive(Debug, Error)]
pub enum SourceError {
    /// Nothing to open.
    #[error("no file given: name NetCDF or HDF5 files, a folder of them or a pattern such as `data/*.nc`")]
    NoFiles,
    /// A pattern or folder without files.
    #[error("no file matches `{pattern}`")]
    NoMatch {
        /// The pattern.
        pattern: String,
    },
    /// The operating system refuses.
    #[error("{}: cannot be opened: {cause}", path.display())]
    Open {
        /// The file.
        path: PathBuf,
        /// What the operating system says.
        cause: std::io::Error,
    },
    /// HDF5 locks a file before it reads it, and cannot.
    #[error(
        "{}: cannot be locked, as HDF5 does before it reads: {why} (the library: {what}). To read it all the same, set HDF5_USE_FILE_LOCKING=FALSE in the environment",
        path.display()
    )]
    Locked {
        /// The file.
        path: PathBuf,
        /// Who or what is in the way.
        why: String,
        /// What the library says.
        what: String,
    },
    /// Some other format.
    #[error("{}: neither NetCDF nor HDF5 ({found}); accepted are NetCDF classic, 64-bit offset, 64-bit data, NetCDF-4 and HDF5", path.display())]
    NotNetCdf {
        /// The file.
        path: PathBuf,
        /// What it seems to be.
        found: String,
    },
    /// The file is shorter than its header says.
    #[error("{}: truncated: {found} bytes, but its header needs {expected}", path.display())]
    Truncated {
        /// The file.
        path: PathBuf,
        /// Bytes that the header needs.
        expected: u64,
        /// Bytes there are.
        found: u64,
    },
    /// A header that contradicts itself, or that the NetCDF library refuses.
    #[error("{}: damaged or truncated: {what}", path.display())]
    Damaged {
        /// The file.
        path: PathBuf,
        /// What does not fit.
        what: String,
    },
    /// Values of a variable cannot be read.
    #[error("{}: variable `{variable}` cannot be read: {what}", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// The variable.
        variable: String,
        /// What the library says.
        what: String,
    },
    /// No pair of variables is a horizontal velocity.
    #[error(
        "{}: no velocity found ({lacking}). Name the variables with `u = \"...\"` and `v = \"...\"` under [archive].\n\
         Variables in the file:\n{candidates}",
        path.display()
    )]
    NoVelocity {
        /// The file.
        path: PathBuf,
        /// Which component is lacking.
        lacking: String,
        /// One line a variable: what it is and what it lacks.
        candidates: String,
    },
    /// A unit that is not understood.
    #[error("{}: variable `{variable}` has unit `{unit}`; accepted are {accepted}", path.display())]
    UnknownUnit {
        /// The file.
        path: PathBuf,
        /// The variable.
        variable: String,
        /// Its unit.
        unit: String,
        /// Accepted units.
        accepted: String,
    },
    /// A variable that the settings name is not there.
    #[error("{}: `{key} = \"{variable}\"` names no variable of the file{nearest}; it has {present}", path.display())]
    VariableNotFound {
        /// The file.
        path: PathBuf,
        /// Key of the setting.
        key: String,
        /// Its value.
        variable: String,
        /// The nearest name, in words; may be empty.
        nearest: String,
        /// Names in the file.
        present: String,
    },
    /// Components on different points.
    #[error(
        "{}: `{first}` lies on ({first_dimensions}) but `{second}` on ({second_dimensions}): staggered components \
         are read where they are WRF's (dimensions `..._stag`, with PH and PHB) or have longitudes and latitudes of their own",
        path.display()
    )]
    Staggered {
        /// The file.
        path: PathBuf,
        /// A component.
        first: String,
        /// Its dimensions.
        first_dimensions: String,
        /// Another component.
        second: String,
        /// Its dimensions.
        second_dimensions: String,
    },
    /// The dimensions of the velocity do not make a grid.
    #[error("{}: variable `{variable}`: {what}", path.display())]
    Layout {
        /// The file.
        path: PathBuf,
        /// The variable.
        variable: String,
        /// What does not fit and what would.
        what: String,
    },
    /// Coordinates that make no axis.
    #[error("{}: {fault}", path.display())]
    Axis {
        /// The file.
        path: PathBuf,
        /// Why not.
        fault: AxisFault,
    },
    /// The times are missing or not understood.
    #[error("{}: time: {what}", path.display())]
    Time {
        /// The file.
        path: PathBuf,
        /// What does not fit and what would.
        what: String,
    },
    /// Two snapshots of one time.
    #[error("{} and {} both hold a snapshot of {time}: remove one", first.display(), second.display())]
    DuplicateTime {
        /// The time, as a date where there is a calendar.
        time: String,
        /// A file.
        first: PathBuf,
        /// Another file (or the same).
        second: PathBuf,
    },
    /// Files that do not belong together.
    #[error("{} and {} do not belong to one archive: {what}", first.display(), second.display())]
    Mixed {
        /// The first file.
        first: PathBuf,
        /// The one that differs.
        second: PathBuf,
        /// What differs.
        what: String,
    },
    /// A setting whose value does not fit the file.
    #[error("`{key}` = {found}: {accepted}")]
    Setting {
        /// Key.
        key: &'static str,
        /// Its value.
        found: String,
        /// What is accepted.
        accepted: String,
    },
    /// One time, and nothing said about others.
    #[error(
        "{source_name} holds one time ({time}): the FTLE needs velocities over a duration. Add files of other times or, to take the flow as \
         steady, set `archive.steady = true` and `time.tau`"
    )]
    OneTime {
        /// The archive.
        source_name: String,
        /// The time.
        time: String,
    },
    /// The archive is shorter than tau.
    #[error(
        "tau = {tau} needs {needed} snapshots {interval} apart, but {source_name} has {found}, which span {span}: shorten tau or add files"
    )]
    TooShort {
        /// The archive.
        source_name: String,
        /// |tau| in time units.
        tau: f64,
        /// Snapshots needed at the archive's median interval.
        needed: usize,
        /// Snapshots there are.
        found: usize,
        /// Median interval.
        interval: f64,
        /// Span of the archive.
        span: f64,
    },
    /// A snapshot that is not there.
    #[error("snapshot {index} was asked for, but there are {count} (counted from 0)")]
    NoSuchSnapshot {
        /// Index.
        index: usize,
        /// How many there are.
        count: usize,
    },
    /// An archive cannot be written.
    #[error("{}: cannot be written: {what}", path.display())]
    Write {
        /// The file or folder.
        path: PathBuf,
        /// What the library or the operating system says.
        what: String,
    },
    /// In-memory data that do not fit together.
    #[error("{what}")]
    Inconsistent {
        /// What does not fit.
        what: String,
    },
    /// A simulation that runs now.
    #[error(transparent)]
    Live(#[from] ridgewatch_wire::WireError),
    /// The I/O thread is gone.
    #[error("the reading thread ended before snapshot {index} of {count}: {what}")]
    ReaderStopped {
        /// Snapshots that came.
        index: usize,
        /// Snapshots expected.
        count: usize,
        /// What is known about it.
        what: String,
    },
    /// The thread that follows a simulation is gone; the simulation may run on.
    #[error("the thread that follows the simulation ended after {steps} steps: {what}")]
    LiveStopped {
        /// Whole steps that came.
        steps: u64,
        /// What is known about it.
        what: String,
    },
}

impl SourceError {
    /// The setting at fault, where it is one.
    pub fn refused(&self) -> Option<Refused> {
        let qualified = |key: &str| match key {
            "tau" => "time.tau".to_owned(),
            key if key.starts_with("live.") => key.to_owned(),
            key => format!("archive.{}", key.trim_start_matches("archive.")),
        };
        Some(match self {
            SourceError::Setting { key, found, accepted } => Refused::new(qualified(key), format_args!("is {found}"), accepted),
            SourceError::VariableNotFound { path, key, variable, nearest, present } => Refused::new(
                qualified(key),
                format_args!("is \"{variable}\", which names no variable of {}{nearest}", path.display()),
                format!("one of {present}"),
            ),
            _ => return None,
        })
    }
}
