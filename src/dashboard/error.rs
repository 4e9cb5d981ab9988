//! Errors before the server runs. Afterwards, faults of the publisher are shown on the page, and those of browsers end their connection.

use ridgewatch_zmtp::BindError;
use std::io;
use std::net::SocketAddr;
use std::path::PathBuf;
use thiserror::Error;

/// Why there is no dashboard.
#[derive(Debug, Error)]
pub enum DashboardError {
    /// Not an endpoint to subscribe to.
    #[error("endpoint `{endpoint}`: {problem}; accepted: tcp://HOST:PORT, ipc://PATH or \"private\" (where `--publish` publishes)")]
    Endpoint {
        /// As given.
        endpoint: String,
        /// Reason.
        problem: String,
    },
    /// The folder of the private endpoint cannot be used.
    #[error("endpoint `private`: {source}")]
    Private {
        /// Cause.
        source: BindError,
    },
    /// Not a name of a host.
    #[error("host `{0}`: accepted: a name or an address as browsers send it, without scheme, port or path")]
    HostName(String),
    /// The address cannot be listened at.
    #[error("cannot listen at {address}: {source}; choose another port, 0 for any free one")]
    Listen {
        /// The address.
        address: SocketAddr,
        /// Error of the system.
        source: io::Error,
    },
    /// The file of a token cannot be used.
    #[error("{path}: {problem}", path = path.display())]
    TokenFile {
        /// The file.
        path: PathBuf,
        /// What was found, and what is accepted.
        problem: String,
    },
    /// An error of the system.
    #[error("cannot start the dashboard: {0}")]
    System(#[from] io::Error),
}

impl DashboardError {
    /// Whether the request is at fault, and not the system.
    pub fn is_usage(&self) -> bool {
        matches!(self, Self::Endpoint { .. } | Self::HostName(_) | Self::TokenFile { .. })
    }
}
