//! Errors before a run starts. During a run, faults of publishing are warnings and counts.

use crate::setting::Refused;
use std::{io, path::PathBuf};
use thiserror::Error;

/// Why frames cannot be published. Every variant arises before work starts or while a file is read back.
#[derive(Debug, Error)]
pub enum PublishError {
    /// A setting out of its range.
    #[error(transparent)]
    Setting(#[from] Refused),
    /// An endpoint that is not `tcp://HOST:PORT`.
    #[error("endpoint `{endpoint}`: {problem}; accepted is tcp://HOST:PORT (port 0 takes a free one) or `none`")]
    Endpoint {
        /// As given.
        endpoint: String,
        /// Reason.
        problem: String,
    },
    /// Another program listens at the endpoint.
    #[error("endpoint `{endpoint}` is in use by another program: choose another port, port 0 for a free one, or `none`")]
    PortInUse {
        /// As given.
        endpoint: String,
    },
    /// The system refuses to bind.
    #[error("endpoint `{endpoint}` cannot be bound: {source}")]
    Bind {
        /// As given.
        endpoint: String,
        /// Error of the system.
        source: io::Error,
    },
    /// A helper thread could not be started.
    #[error("cannot start the thread {name}: {source}")]
    Thread {
        /// Its name.
        name: &'static str,
        /// Error of the system.
        source: io::Error,
    },
    /// The run folder cannot be created or written.
    #[error("run folder {path}: cannot be written: {source}", path = path.display())]
    Folder {
        /// Folder, or file in it.
        path: PathBuf,
        /// Error of the system.
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
    /// A run in progress writes into the run folder.
    #[error("run folder {path} is in use by {holder}: choose another folder, or wait for the end of that run", path = path.display())]
    InUse {
        /// The folder.
        path: PathBuf,
        /// The process.
        holder: String,
    },
    /// A picture or a scene that cannot be read or written.
    #[error("{path}: {problem}", path = path.display())]
    File {
        /// The file.
        path: PathBuf,
        /// The problem, and what is accepted.
        problem: String,
    },
}

impl PublishError {
    /// Setting at fault. `None` if the error is of another kind.
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
