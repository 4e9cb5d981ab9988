//! The socket: a thread that accepts and serves connections, and the handle through which messages come.

use crate::bind::{BindError, Bound, Peers};
use crate::client::{Client, End, Limits};
use crate::lock;
use crate::message::{Keep, Ledger};
use crate::owner::{Owner, displaced, users_of};
use std::future::ready;
use std::io;
use std::net::SocketAddr;
use std::sync::{Arc, Mutex};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};
use tokio::net::{TcpListener, TcpStream, UnixListener, UnixStream};
use tokio::runtime::Runtime;
use tokio::sync::{Notify, watch};

/// Descriptors that a runtime needs at most, with some to spare.
const SPARE_DESCRIPTORS: usize = 12;
/// Maximum number of connections whose users are looked up together.
const BATCH: usize = 64;
/// Pause after a connection could not be accepted, because no descriptor is free for instance.
const PAUSE: Duration = Duration::from_millis(100);
/// Longest wait, at the end, for a lookup of users.
pub(crate) const SHUTDOWN_LIMIT: Duration = Duration::from_millis(100);
/// Share of the time for a message after which a subscriber gives way to one that is ready, if too many messages are in flight.
const GIVE_WAY: u32 = 8;

/// Counts since the start.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Counts {
    /// Maximum number of subscribers at a time.
    pub peak_subscribers: u64,
    /// Subscribers that were disconnected because they did not read.
    pub stalled: u64,
    /// Connections that were closed for what they sent, or for not greeting in time.
    pub faults: u64,
    /// Connections of users that are not accepted.
    pub refused: u64,
    /// Connections that gave way to another one.
    pub displaced: u64,
    /// [`Keep::All`] messages that were dropped because too many waited for a subscriber.
    pub dropped: u64,
    /// Maximum number of bytes of messages that were held at a time.
    pub peak_bytes: u64,
}

/// A PUB socket. Dropping it closes all connections, in a tenth of a second at most.
#[derive(Debug)]
pub struct PubSocket {
    shared: Arc<Shared>,
    endpoint: String,
    close_by: watch::Sender<Option<Instant>>,
    /// `None` once it has ended.
    thread: Mutex<Option<JoinHandle<()>>>,
}

/// What the thread and the handle share.
#[derive(Debug)]
struct Shared {
    limits: Limits,
    clients: Mutex<Vec<Arc<Client>>>,
    /// A client has left.
    left: Notify,
    counts: Mutex<Counts>,
    ledger: Arc<Ledger>,
}

impl PubSocket {
    /// Binds `tcp://HOST:PORT` (`*`: every interface; port 0: a free one) or `ipc://PATH`. `peers` is by default [`Peers::User`] where only this
    /// machine reaches the endpoint, and [`Peers::Any`] elsewhere.
    ///
    /// # Errors
    /// An endpoint that is not accepted or in use, or an error of the system.
    pub fn bind(endpoint: &str, peers: Option<Peers>, limits: Limits) -> Result<Self, BindError> {
        let Opened { listener, endpoint, peers, runtime } = Opened::new(endpoint, peers)?;
        let shared =
            Arc::new(Shared { limits, clients: Mutex::default(), left: Notify::new(), counts: Mutex::default(), ledger: Arc::default() });
        let (close_by, closing) = watch::channel(None);
        let served = Arc::clone(&shared);
        let thread = std::thread::Builder::new().name("ridgewatch-zmtp".to_owned()).spawn(move || {
            runtime.block_on(run(listener, peers, served, closing));
            // Drops all tasks, and with them their connections.
            runtime.shutdown_timeout(SHUTDOWN_LIMIT);
        })?;
        Ok(Self { shared, endpoint, close_by, thread: Mutex::new(Some(thread)) })
    }

    /// The endpoint, with the port that was bound.
    pub fn endpoint(&self) -> &str {
        &self.endpoint
    }

    /// Whether a client subscribes to the topic.
    pub fn is_wanted(&self, topic: &[u8]) -> bool {
        lock(&self.shared.clients).iter().any(|client| client.wants(topic, Keep::Newest))
    }

    /// Whether a client subscribes to this topic of [`Keep::Bulk`]; `Some(true)`: and one has subscribed since such a message was given to it.
    pub fn wants_bulk(&self, topic: &[u8]) -> Option<bool> {
        let clients = lock(&self.shared.clients);
        clients.iter().any(|client| client.wants(topic, Keep::Bulk)).then(|| clients.iter().any(|client| client.awaits(topic)))
    }

    /// Sends a message of several parts, of which the first is its topic, to those who subscribe to it. Never waits.
    pub fn send(&self, parts: &[&[u8]], last: Vec<u8>, keep: Keep) {
        let message = self.shared.ledger.message(parts, last, keep);
        let clients = lock(&self.shared.clients).clone();
        let dropped = clients.iter().filter(|client| client.give(&message, self.shared.limits.queued)).count();
        lock(&self.shared.counts).dropped += dropped as u64;
    }

    /// Whether fewer than [`Limits::in_flight`] messages of this kind, [`Keep::Newest`] or [`Keep::Bulk`], are held, after waiting for it. If subscribers
    /// of the topic are ready meanwhile, those that hold the oldest message for long are disconnected, so that slow ones cost them little.
    pub fn has_room(&self, topic: &[u8], keep: Keep, wait: Duration) -> bool {
        let limit = self.shared.limits.in_flight;
        if self.shared.ledger.wait_below(keep, limit, Duration::ZERO) {
            return true;
        }
        let patience = self.shared.limits.stall_of(keep) / GIVE_WAY;
        let clients = lock(&self.shared.clients).clone();
        let oldest = clients.iter().filter_map(|client| client.writing(keep)).min();
        if let Some((number, since)) = oldest
            && since.elapsed() >= patience
            && clients.iter().any(|client| client.wants(topic, keep) && client.writing(keep).is_none())
        {
            let holders = clients.iter().filter(|client| client.writing(keep).is_some_and(|(held, _)| held == number));
            let closed = holders.map(|client| client.close()).count();
            lock(&self.shared.counts).stalled += closed as u64;
        }
        drop(clients);
        self.shared.ledger.wait_below(keep, limit, wait)
    }

    /// Counts so far.
    pub fn counts(&self) -> Counts {
        Counts { peak_bytes: self.shared.ledger.peak_bytes(), ..*lock(&self.shared.counts) }
    }

    /// Waits at most until `by` until subscribers have taken what was sent, and closes all connections.
    pub fn close(&self, by: Instant) {
        self.close_by.send_replace(Some(by));
        // A panic has been printed.
        let _ = lock(&self.thread).take().map(JoinHandle::join);
    }
}

impl Drop for PubSocket {
    fn drop(&mut self) {
        self.close(Instant::now());
    }
}

/// A socket that listens, and the runtime that will serve it.
pub(crate) struct Opened {
    pub listener: Listener,
    /// With the port that was bound.
    pub endpoint: String,
    pub peers: Peers,
    pub runtime: Runtime,
}

impl Opened {
    /// Listens; see [`PubSocket::bind`].
    pub fn new(endpoint: &str, peers: Option<Peers>) -> Result<Self, BindError> {
        let (bound, endpoint) = Bound::open(endpoint)?;
        let peers = peers.unwrap_or(if bound.is_local() { Peers::User } else { Peers::Any });
        bound.open_to(peers)?;
        // Where another crate enables tokio's signals, the runtime panics without these descriptors.
        let spare = (0..SPARE_DESCRIPTORS).map(|_| std::fs::File::open("/dev/null")).collect::<io::Result<Vec<_>>>()?;
        drop(spare);
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().max_blocking_threads(1).build()?;
        let listener = {
            let _inside = runtime.enter();
            Listener::new(bound)?
        };
        Ok(Self { listener, endpoint, peers, runtime })
    }
}

pub(crate) enum Listener {
    Tcp(TcpListener),
    Unix(UnixListener, #[expect(dead_code, reason = "removes the file at the end")] crate::bind::SocketFile),
}

pub(crate) enum Stream {
    Tcp(TcpStream),
    Unix(UnixStream),
}

/// An accepted connection: its two addresses, or the user at the other end.
enum From {
    Addresses(SocketAddr, SocketAddr),
    User(u32),
}

impl Listener {
    fn new(bound: Bound) -> io::Result<Self> {
        Ok(match bound {
            Bound::Tcp(listener) => {
                listener.set_nonblocking(true)?;
                Self::Tcp(TcpListener::from_std(listener)?)
            }
            Bound::Unix(listener, file) => {
                listener.set_nonblocking(true)?;
                Self::Unix(UnixListener::from_std(listener)?, file)
            }
        })
    }

    async fn accept(&self) -> io::Result<(Stream, From)> {
        match self {
            Self::Tcp(listener) => {
                let (stream, peer) = listener.accept().await?;
                let here = stream.local_addr()?;
                // Fails for a connection that is closed already.
                let _ = stream.set_nodelay(true);
                Ok((Stream::Tcp(stream), From::Addresses(peer, here)))
            }
            Self::Unix(listener, _) => {
                let (stream, _) = listener.accept().await?;
                let user = stream.peer_cred()?.uid();
                Ok((Stream::Unix(stream), From::User(user)))
            }
        }
    }

    /// All connections that wait, up to [`BATCH`], with their owners; at least one.
    pub async fn batch(&self) -> Vec<(Stream, Owner)> {
        let mut batch = Vec::new();
        while batch.is_empty() {
            match self.accept().await {
                Ok(accepted) => batch.push(accepted),
                Err(error) if error.kind() == io::ErrorKind::ConnectionAborted => {}
                // No descriptor is free, for instance. Later connections may succeed.
                Err(_) => tokio::time::sleep(PAUSE).await,
            }
        }
        while batch.len() < BATCH {
            tokio::select! {
                biased;
                Ok(accepted) = self.accept() => batch.push(accepted),
                () = ready(()) => break,
            }
        }
        let pairs: Vec<_> =
            batch.iter().filter_map(|(_, from)| if let From::Addresses(peer, here) = from { Some((*peer, *here)) } else { None }).collect();
        // The system's tables of connections may be long; messages must not wait for them.
        let found = if pairs.is_empty() { Vec::new() } else { look_up(pairs).await };
        let mut found = found.into_iter();
        let owner = |from| match from {
            From::User(user) => Owner::User(user),
            From::Addresses(peer, _) => Owner::of(peer.ip(), found.next().flatten()),
        };
        let (streams, from): (Vec<_>, Vec<_>) = batch.into_iter().unzip();
        streams.into_iter().zip(from.into_iter().map(owner)).collect()
    }
}

/// [`users_of`] in a thread of its own. If the system refuses the thread, no user is known. (`spawn_blocking` panics then.)
async fn look_up(pairs: Vec<(SocketAddr, SocketAddr)>) -> Vec<Option<u32>> {
    let (send, receive) = tokio::sync::oneshot::channel();
    let work = move || {
        // The receiver is gone only when the socket closes.
        let _ = send.send(users_of(&pairs));
    };
    match std::thread::Builder::new().name("ridgewatch-peers".to_owned()).spawn(work) {
        Ok(_) => receive.await.unwrap_or_default(),
        Err(_) => Vec::new(),
    }
}

/// Serves until it is asked to close.
async fn run(listener: Listener, peers: Peers, shared: Arc<Shared>, mut closing: watch::Receiver<Option<Instant>>) {
    let accepts = async {
        loop {
            for (stream, owner) in listener.batch().await {
                shared.admit(stream, owner, peers);
            }
        }
    };
    let by = tokio::select! {
        () = accepts => return,
        by = closing.wait_for(Option::is_some) => by.ok().and_then(|by| *by).unwrap_or_else(Instant::now),
    };
    drop(listener);
    lock(&shared.clients).iter().for_each(|client| client.finish());
    let all_left = async {
        while !lock(&shared.clients).is_empty() {
            shared.left.notified().await;
        }
    };
    // If time is up, what is left is dropped with the runtime.
    let _ = tokio::time::timeout_at(by.into(), all_left).await;
}

impl Shared {
    /// Starts to serve a connection.
    fn admit(self: &Arc<Self>, stream: Stream, owner: Owner, peers: Peers) {
        if !peers.accept(owner) {
            lock(&self.counts).refused += 1;
            return;
        }
        let client = Arc::new(Client::new(owner));
        let mut clients = lock(&self.clients);
        if clients.len() >= self.limits.connections {
            let present: Vec<_> = clients.iter().map(|one| (one.owner, one.has_subscribed(), one.idle_since())).collect();
            if let Some(index) = displaced(&present) {
                clients.remove(index).close();
                lock(&self.counts).displaced += 1;
            }
        }
        clients.push(Arc::clone(&client));
        drop(clients);
        let shared = Arc::clone(self);
        tokio::spawn(async move {
            let _leaving = Leaving { shared: &shared, client: &client };
            let subscribed = || shared.count_subscribers();
            let ended = match stream {
                Stream::Tcp(mut stream) => {
                    let (from, to) = stream.split();
                    client.serve(from, to, &shared.limits, subscribed).await
                }
                Stream::Unix(mut stream) => {
                    let (from, to) = stream.split();
                    client.serve(from, to, &shared.limits, subscribed).await
                }
            };
            let mut counts = lock(&shared.counts);
            match ended {
                Err(End::Stall) => counts.stalled += 1,
                Err(End::Fault(_) | End::Handshake) => counts.faults += 1,
                Err(End::System(_)) | Ok(()) => {}
            }
        });
    }

    fn count_subscribers(&self) {
        let subscribers = lock(&self.clients).iter().filter(|client| client.has_subscribed()).count() as u64;
        let mut counts = lock(&self.counts);
        counts.peak_subscribers = counts.peak_subscribers.max(subscribers);
    }
}

/// Removes a client when its task ends, however it ends.
struct Leaving<'a> {
    shared: &'a Shared,
    client: &'a Arc<Client>,
}

impl Drop for Leaving<'_> {
    fn drop(&mut self) {
        lock(&self.shared.clients).retain(|one| !Arc::ptr_eq(one, self.client));
        self.shared.left.notify_one();
    }
}
