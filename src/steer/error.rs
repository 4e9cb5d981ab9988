//! Errors of the command socket and of its clients. A command that is refused is an answer and no error.

use ridgewatch_wire::WireError;
use ridgewatch_zmtp::{BindError, SubscribeError};
use thiserror::Error;

/// Why there is no command socket, or no connection to one.
#[derive(Debug, Error)]
pub enum SteerError {
    /// The socket cannot listen.
    #[error("command socket `{endpoint}`: {source} (--steer=ENDPOINT: private, ipc://PATH or tcp://HOST:PORT)")]
    Bind {
        /// As given.
        endpoint: String,
        /// Cause.
        source: BindError,
    },
    /// The connection file cannot be written or read.
    #[error(transparent)]
    File(#[from] WireError),
    /// The socket cannot be reached, or the connection has ended.
    #[error(transparent)]
    Link(#[from] SubscribeError),
    /// An answer that is not one of this socket, or that another key has signed.
    #[error("an answer that is not understood: {0}")]
    Answer(String),
    /// The system has no random numbers.
    #[error("no random numbers: {0}")]
    Random(String),
}

impl SteerError {
    /// Whether another program listens at the endpoint.
    pub fn is_in_use(&self) -> bool {
        matches!(self, Self::Bind { source: BindError::InUse, .. })
    }

    /// Whether the request is at fault, and not the system.
    pub fn is_usage(&self) -> bool {
        matches!(self, Self::Bind { source: BindError::Endpoint(_), .. })
    }
}
