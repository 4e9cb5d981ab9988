//! The socket of a run, and the file that leads to it.

use super::SteerError;
use super::session::Session;
use crate::run::Steering;
use ridgewatch_wire::message::{ConnectionFile, Key};
use ridgewatch_zmtp::{BindError, Limits, RouterSocket, private_endpoint};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

/// Name of the private socket.
const NAME: &str = "commands";

/// Listens for commands until it is dropped.
#[derive(Debug)]
pub struct CommandSocket {
    router: RouterSocket,
    connection: ConnectionFile,
    path: PathBuf,
}

impl CommandSocket {
    /// Binds `private`, `ipc://PATH` or `tcp://HOST:PORT`, and writes the connection file (mode 0600), with a new key: `PATH.connection`, or
    /// `commands-PORT.connection` in the private folder.
    ///
    /// # Errors
    /// An endpoint that is not accepted or in use, or an error of the system.
    pub fn bind(endpoint: &str, steering: Arc<Steering>) -> Result<Self, SteerError> {
        let limits = Limits {
            connections: 16,
            handshake: Duration::from_secs(5),
            stall: Duration::from_secs(2),
            frames: 10_000,
            ..Limits::default()
        };
        let failed = |source| SteerError::Bind { endpoint: endpoint.to_owned(), source };
        let resolved =
            if endpoint == crate::publish::DEFAULT_ENDPOINT { private_endpoint(NAME).map_err(failed)? } else { endpoint.to_owned() };
        let key = Key::random()?;
        let answers = {
            let key = key.clone();
            move || Box::new(Session::new(key.clone(), Arc::clone(&steering))) as Box<_>
        };
        let router = RouterSocket::bind(&resolved, None, limits, Box::new(answers)).map_err(failed)?;
        let path = beside(router.endpoint()).map_err(failed)?;
        let connection = ConnectionFile { address: router.endpoint().to_owned(), key };
        connection.write(&path)?;
        Ok(Self { router, connection, path })
    }

    /// The endpoint, with the port that was bound.
    pub fn endpoint(&self) -> &str {
        self.router.endpoint()
    }

    /// The connection file.
    pub fn connection(&self) -> &Path {
        &self.path
    }
}

impl Drop for CommandSocket {
    fn drop(&mut self) {
        self.connection.remove(&self.path);
    }
}

/// Path of the connection file of an endpoint.
fn beside(endpoint: &str) -> Result<PathBuf, BindError> {
    let named = match endpoint.strip_prefix("ipc://") {
        Some(path) => path.to_owned(),
        None => {
            let port = endpoint.rsplit(':').next().unwrap_or_default();
            private_endpoint(&format!("{NAME}-{port}"))?.replacen("ipc://", "", 1)
        }
    };
    Ok(PathBuf::from(named + ".connection"))
}

/// Path of the connection file of the private socket.
///
/// # Errors
/// The private folder cannot be used.
pub fn default_connection() -> Result<PathBuf, SteerError> {
    private_endpoint(NAME)
        .and_then(|endpoint| beside(&endpoint))
        .map_err(|source| SteerError::Bind { endpoint: crate::publish::DEFAULT_ENDPOINT.to_owned(), source })
}
