//! Errors before a run starts. During a run, faults of publishing are warnings and counts.

use crate::setting::Refused;
use ridgewatch_zmtp::BindError;
use std::{io, path::PathBuf};
use thiserror::Error;

/// Accepted endpoints.
const ENDPOINTS: &str =
    "tcp://HOST:PORT (port 0 takes a free one), ipc://PATH, \"private\" (a socket that only this user reaches) or \"none\"";

/// Why frames cannot be published. Every variant arises before work starts or while a file is read back.
#[derive(Debug, Error)]
pub enum PublishError {
    /// A setting out of its range.
    #[error(transparent)]
    Setting(#[from] Refused),
    /// Not an endpoint.
    #[error("endpoint `{endpoint}`: {problem}; accepted: {ENDPOINTS}")]
    Endpoint {
        /// As given.
        endpoint: String,
        /// Reason.
        problem: String,
    },
    /// Another program listens at the endpoint.
    #[error("endpoint `{endpoint}` is in use by another program: choose another one (with tcp, port 0 takes a free one), or `none`")]
    EndpointInUse {
        /// As given.
        endpoint: String,
    },
    /// The system refuses to bind, or a file or folder is not this user's.
    #[error("endpoint `{endpoint}` cannot be bound: {source}")]
    Bind {
        /// As given.
        endpoint: String,
        /// Cause.
        source: BindError,
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
    pub(super) fn of_bind(endpoint: &str, error: BindError) -> Self {
        let endpoint = endpoint.to_owned();
        match error {
            BindError::Endpoint(problem) => Self::Endpoint { endpoint, problem },
            BindError::InUse => Self::EndpointInUse { endpoint },
            source => Self::Bind { endpoint, source },
        }
    }

    /// Setting at fault. `None` if the error is of another kind.
    pub fn refused(&self) -> Option<Refused> {
        match self {
            PublishError::Setting(refused) => Some(refused.clone()),
            PublishError::Endpoint { endpoint, problem } => {
                Some(Refused::new("publish.endpoint", format_args!("is \"{endpoint}\": {problem}"), ENDPOINTS))
            }
            _ => None,
        }
    }
}
