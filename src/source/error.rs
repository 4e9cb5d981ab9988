//! Errors of the sources. Each names the file, the variable, what was found and what is accepted.

use super::formats::{FormatError, FormatFault};
use ridgewatch_base::setting::Refused;
use std::fmt::Display;
use std::path::{Path, PathBuf};
use thiserror::Error;

/// Why velocity data could not be read.
#[derive(Debug, Error)]
pub enum SourceError {
    /// Nothing to open.
    #[error("no file given: name NetCDF, HDF5 or GRIB files, Zarr stores, a folder of them or a pattern such as `data/*.nc`")]
    NoFiles,
    /// A pattern or folder without files.
    #[error("no file matches `{pattern}`")]
    NoMatch {
        /// The pattern.
        pattern: String,
    },
    /// A file that cannot be opened or read.
    #[error(transparent)]
    Format(#[from] FormatError),
    /// A file whose contents do not fit, or that cannot be written.
    #[error("{}: {what}", path.display())]
    File {
        /// The file.
        path: PathBuf,
        /// The misfit, and what is accepted.
        what: String,
    },
    /// The settings name a variable that the file lacks.
    #[error("{}: `{key} = \"{variable}\"` names no variable of the file{nearest}; it has {present}", path.display())]
    VariableNotFound {
        /// The file.
        path: PathBuf,
        /// Key of the setting.
        key: String,
        /// Its value.
        variable: String,
        /// Sentence about the nearest name; may be empty.
        nearest: String,
        /// Names in the file.
        present: String,
    },
    /// Two snapshots of one time.
    #[error("{} and {} both hold a snapshot of {time}: remove one", first.display(), second.display())]
    DuplicateTime {
        /// The time, as a date if there is a calendar.
        time: String,
        /// A file.
        first: PathBuf,
        /// Another file, or the same.
        second: PathBuf,
    },
    /// Files that do not belong together.
    #[error("{} and {} do not belong to one archive: {what}", first.display(), second.display())]
    Mixed {
        /// The first file.
        first: PathBuf,
        /// The file that differs.
        second: PathBuf,
        /// The difference.
        what: String,
    },
    /// A setting whose value does not fit the data.
    #[error("`{key}` = {found}: {accepted}")]
    Setting {
        /// Key.
        key: &'static str,
        /// Its value.
        found: String,
        /// Accepted values.
        accepted: String,
    },
    /// Only one time, and no setting that takes the flow as steady.
    #[error(
        "{source_name} holds one time ({time}): the FTLE needs velocities over a duration. Add files of other times or, to take the flow as \
         steady, use --set archive.steady=true --set time.tau=DURATION"
    )]
    OneTime {
        /// The archive.
        source_name: String,
        /// The time.
        time: String,
    },
    /// The archive is shorter than tau.
    #[error(
        "tau = {tau} needs {needed} snapshots {interval} apart, but {source_name} has {found}, which span {span}: add files, or shorten it with --set time.tau=DURATION"
    )]
    TooShort {
        /// The archive.
        source_name: String,
        /// |tau| with its unit.
        tau: String,
        /// Snapshots needed at the archive's median interval.
        needed: usize,
        /// Number of snapshots.
        found: usize,
        /// Median interval.
        interval: String,
        /// Span of the archive.
        span: String,
    },
    /// An index beyond the last snapshot.
    #[error("snapshot {index} was asked for, but there are {count} (counted from 0)")]
    NoSuchSnapshot {
        /// Index.
        index: usize,
        /// Number of snapshots.
        count: usize,
    },
    /// In-memory data that do not fit together, or a thread that cannot start.
    #[error("{0}")]
    Inconsistent(String),
    /// A running simulation.
    #[error(transparent)]
    Live(#[from] ridgewatch_wire::WireError),
    /// The I/O thread ended early.
    #[error("the reading thread ended before snapshot {index} of {count}: {what}")]
    ReaderStopped {
        /// Snapshots received.
        index: usize,
        /// Snapshots expected.
        count: usize,
        /// The reason, as far as it is known.
        what: String,
    },
    /// The thread that follows a simulation ended; the simulation may still run.
    #[error("the thread that follows the simulation ended after {steps} steps: {what}")]
    LiveStopped {
        /// Whole steps received.
        steps: u64,
        /// The reason, as far as it is known.
        what: String,
    },
}

impl SourceError {
    /// A setting whose value does not fit.
    pub(super) fn setting(key: &'static str, found: impl ToString, accepted: impl Into<String>) -> Self {
        Self::Setting { key, found: found.to_string(), accepted: accepted.into() }
    }

    /// A file whose contents do not fit.
    pub(super) fn file(path: &Path, what: impl ToString) -> Self {
        Self::File { path: path.into(), what: what.to_string() }
    }

    /// True for a file that another process has locked.
    pub(super) fn is_locked(&self) -> bool {
        matches!(self, Self::Format(FormatError { fault: FormatFault::Locked(_), .. }))
    }

    /// A variable that does not fit.
    pub(super) fn variable(path: &Path, variable: &str, what: impl Display) -> Self {
        Self::file(path, format!("variable `{variable}`: {what}"))
    }

    /// A file or folder that cannot be written.
    pub(super) fn write(path: &Path, what: impl Display) -> Self {
        Self::file(path, format!("cannot be written: {what}"))
    }

    /// The setting at fault, if the error is about a setting.
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
