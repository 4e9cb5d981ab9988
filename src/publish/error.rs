//! What can go wrong before a run starts. During a run nothing here is an error: it is a warning and a count.

use crate::setting::Refused;
use std::{io, path::PathBuf};
use thiserror::Error;

/// Why frames cannot go out. Every variant arises before work starts or while a file is read back.
#[derive(Debug, Error)]
pub enum PublishError {
    /// A setting out of its range.
    #[error(transparent)]
    Setting(#[from] Refused),
    /// An endpoint that cannot be understood.
    #[error("endpoint `{endpoint}`: {problem}; accepted is tcp://HOST:PORT (port 0 takes a free one) or `none`")]
    Endpoint {
        /// As given.
        endpoint: String,
        /// What is wrong with it.
        problem: String,
    },
    /// Somebody else listens there.
    #[error("endpoint `{endpoint}` is in use by another program: choose another port, port 0 for a free one, or `none`")]
    PortInUse {
        /// As given.
        endpoint: String,
    },
    /// The system refuses the socket.
    #[error("endpoint `{endpoint}` cannot be bound: {source}")]
    Bind {
        /// As given.
        endpoint: String,
        /// What the system said.
        source: io::Error,
    },
    /// A helper thread could not be started.
    #[error("cannot start the thread {name}: {source}")]
    Thread {
        /// Its name.
        name: &'static str,
        /// What the system said.
        source: io::Error,
    },
    /// The run folder cannot be made or written.
    #[error("run folder {path}: cannot be written: {source}", path = path.display())]
    Folder {
        /// Folder, or file in it.
        path: PathBuf,
        /// What the system said.
        source: io::Error,
    },
    /// The run folder holds an older run.
    #[error("run folder {path} already holds a run ({found}): choose another folder, or pass --overwrite to replace it", path = path.display())]
    Occupied {
        /// The folder.
        path: PathBuf,
        /// A file of the older run.
        found: String,
    },
    /// The place where the scene of a run goes is not free, or cannot be written.
    #[error("{path}: {problem}", path = path.display())]
    Scene {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        problem: String,
    },
    /// An EXR file that cannot be read or written.
    #[error("{path}: {problem}", path = path.display())]
    Exr {
        /// The file.
        path: PathBuf,
        /// What is wrong, and what is accepted.
        problem: String,
    },
    /// A preview that cannot be written.
    #[error("{path}: {problem}", path = path.display())]
    Png {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        problem: String,
    },
}

impl PublishError {
    /// The setting at fault, where it is one.
    pub fn refused(&self) -> Option<Refused> {
        match self {
            PublishError::Setting(refused) => Some(refused.clone()),
            PublishError::Endpoint { endpoint, problem } => Some(Refused::new(
                "publish.endpoint",
                format_args!("is \"{endpoint}\": {problem}"),
                "tcp://HOST:PORT (port 0 takes a free one) or \"none\"",
            )),
            _ => None,
        }
    }
}
