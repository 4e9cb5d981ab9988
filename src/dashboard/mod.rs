//! The dashboard: a web page that shows the published frames.
//!
//! In: the messages of a publisher, over ZeroMQ, and commands of browsers. Out: one page and a WebSocket, over HTTP, and the commands to the run.
//! Calls `publish` for the names of messages, `steer` for commands, and the crate `ridgewatch-zmtp`.
//!
//! One thread does all of it but the encoding of files and planes. A picture is forwarded as it was encoded. A browser gets the newest picture when it has drawn the one before, so
//! that none waits for another one and no queue grows behind it.

mod access;
mod client;
mod error;
mod field;
mod files;
mod history;
mod hub;
mod layers;
mod metrics;
mod pixels;
mod planes;
mod received;
mod server;
mod steering;
mod token;

pub use access::host_name;
pub use error::DashboardError;
pub use token::Token;

use crate::publish::NewestFrame;
use access::Access;
use bytes::Bytes;
use history::History;
use hub::{Hub, Shown};
use pixels::Pixels;
use ridgewatch_zmtp::{check_endpoint, private_endpoint};
use std::io::ErrorKind;
use std::net::{IpAddr, Ipv4Addr, SocketAddr, TcpListener};
use std::path::PathBuf;
use std::sync::Arc;
use std::thread::JoinHandle;
use std::time::Duration;
use steering::Wheel;
use tokio::sync::oneshot;

/// Port that is taken if it is free.
pub const DEFAULT_PORT: u16 = 8577;
/// Longest wait at the end for tasks of the runtime.
const SHUTDOWN_LIMIT: Duration = Duration::from_millis(200);

/// What a dashboard shows, and to whom.
#[derive(Debug)]
pub struct DashboardSettings {
    /// ZeroMQ endpoint of the publisher: `tcp://HOST:PORT`, `ipc://PATH`, or `private`.
    pub endpoint: String,
    /// Address to listen at.
    pub address: IpAddr,
    /// Port to listen at, 0 for any free one. `None`: [`DEFAULT_PORT`], or any free one if it is taken.
    pub port: Option<u16>,
    /// Names, besides those of this machine's loopback, by which browsers reach it through a proxy.
    pub hosts: Vec<String>,
    /// What a browser must know to steer. Whoever knows [`Token::watching`] of it sees the same.
    pub token: Token,
    /// Connection file of the run's command socket; `None`: pages only watch.
    pub steer: Option<PathBuf>,
    /// Frames whose pixels and files are served: those of the run in this process; `None` in a process of its own, which asks the publisher for all
    /// layers while a page needs them.
    pub newest: Option<Arc<NewestFrame>>,
    /// Folder of the run, for those who look back; `None`: pages have the frames that they received.
    pub run: Option<PathBuf>,
    /// Chart of speed against accuracy, as SVG.
    pub chart: Option<Vec<u8>>,
}

impl DashboardSettings {
    /// Serves this machine only, with these frames, to those who watch.
    pub fn local(endpoint: String, port: Option<u16>, token: Token) -> Self {
        Self {
            endpoint,
            address: Ipv4Addr::LOCALHOST.into(),
            port,
            hosts: Vec::new(),
            token,
            steer: None,
            newest: None,
            run: None,
            chart: None,
        }
    }
}

/// A server that runs until it is dropped.
#[derive(Debug)]
pub struct Dashboard {
    address: SocketAddr,
    endpoint: String,
    token: Token,
    /// Dropped to end the thread.
    stop: Option<oneshot::Sender<()>>,
    thread: Option<JoinHandle<()>>,
}

/// Threads that decode, encode and read files. Pictures of the past take one of them at most, so that the newest one does not wait.
const BLOCKING_THREADS: usize = 4;

impl Dashboard {
    /// Listens, and begins to follow the publisher, which need not exist yet.
    ///
    /// # Errors
    /// An endpoint or a name of a host that is not accepted, a port in use, or an error of the system.
    pub fn start(settings: DashboardSettings) -> Result<Self, DashboardError> {
        let DashboardSettings { endpoint, address, port, hosts, token, steer, newest, run, chart } = settings;
        let endpoint = match endpoint.as_str() {
            crate::publish::DEFAULT_ENDPOINT => private_endpoint("frames").map_err(|source| DashboardError::Private { source })?,
            _ => endpoint,
        };
        check_endpoint(&endpoint).map_err(|problem| DashboardError::Endpoint { endpoint: endpoint.clone(), problem })?;
        let listener = listen(address, port)?;
        let address = listener.local_addr()?;
        let access = Access::new(token.clone(), hosts, address)?;
        let (wheel, requests) = Wheel::new(steer);
        let is_beside_run = newest.is_some();
        let shown = Shown { pixels: Pixels::new(newest), history: run.map(History::new), chart: chart.map(Bytes::from), is_beside_run };
        let hub = Arc::new(Hub::new(endpoint.clone(), wheel, shown));
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().max_blocking_threads(BLOCKING_THREADS).build()?;
        let listener = {
            let _inside = runtime.enter();
            tokio::net::TcpListener::from_std(listener)?
        };
        let (stop, stopped) = oneshot::channel();
        let thread = std::thread::Builder::new().name("ridgewatch-dashboard".to_owned()).spawn(move || {
            runtime.block_on(async {
                tokio::select! {
                    // Its sender is dropped.
                    _ = stopped => {}
                    () = hub.follow() => {}
                    () = hub.follow_layers(), if !is_beside_run => {}
                    () = hub.wheel.drive(requests) => {}
                    () = server::serve(listener, access, Arc::clone(&hub)) => {}
                }
            });
            runtime.shutdown_timeout(SHUTDOWN_LIMIT);
        })?;
        Ok(Self { address, endpoint, token, stop: Some(stop), thread: Some(thread) })
    }

    /// Address of the page, without the token.
    pub fn address(&self) -> SocketAddr {
        self.address
    }

    /// Endpoint of the publisher.
    pub fn endpoint(&self) -> &str {
        &self.endpoint
    }

    /// Address of the page with the token: whoever knows it sees the frames, and steers.
    pub fn url(&self) -> String {
        format!("http://{}/?token={}", self.address, self.token.secret())
    }

    /// Address of the page with the token that only watches.
    pub fn watching_url(&self) -> String {
        format!("http://{}/?token={}", self.address, self.token.watching().secret())
    }
}

impl Drop for Dashboard {
    fn drop(&mut self) {
        self.stop.take();
        if self.thread.take().is_some_and(|thread| thread.join().is_err()) {
            tracing::error!("the dashboard's thread ended by a panic");
        }
    }
}

fn listen(address: IpAddr, port: Option<u16>) -> Result<TcpListener, DashboardError> {
    let wanted = SocketAddr::new(address, port.unwrap_or(DEFAULT_PORT));
    let listener = match TcpListener::bind(wanted) {
        Err(error) if port.is_none() && error.kind() == ErrorKind::AddrInUse => TcpListener::bind((address, 0)),
        bound => bound,
    };
    let listener = listener.map_err(|source| DashboardError::Listen { address: wanted, source })?;
    listener.set_nonblocking(true)?;
    Ok(listener)
}
