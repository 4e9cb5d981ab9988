//! ZeroMQ publisher: the newest frame wins, frames in flight are capped, stalled subscribers are disconnected.
//!
//! The cycle puts a frame into the mailbox and continues. The publishing thread takes the newest frame when fewer than the cap are in flight,
//! encodes it and sends it. The `zeromq` crate's PUB socket has no high-water mark and no call to disconnect one peer, and a writer task blocked
//! by a peer outlives the socket. Each socket therefore lives in its own tokio runtime, a [`SocketInstance`]. If the oldest part in flight
//! exceeds the time limit, the runtime is shut down, which closes all connections and frees their memory, and a new instance takes over.
//! The listener stays open meanwhile, so that healthy subscribers reconnect at once and no other program takes the port.

use super::error::PublishError;
use super::guard::{guard, private_listener};
use super::mailbox::{Kind, MAX_RECORDS, Mailbox, State};
use super::message::{FRAME_TOPIC, RECORD_TOPIC, encode_frame};
use super::settings::{Payload, PublishSettings};
use super::summary::PublishStatistics;
use crate::run::{Frame, FrameRecord};
use bytes::Bytes;
use std::collections::HashSet;
use std::net::{TcpListener, ToSocketAddrs};
use std::sync::{Arc, MutexGuard};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};
use zeromq::util::PeerIdentity;
use zeromq::{PubSocket, Socket, SocketEvent, SocketSend, ZmqMessage};

/// Longest wait of the publishing thread.
const TICK: Duration = Duration::from_millis(100);
/// Longest wait for the tasks of a socket instance that is closed.
const SHUTDOWN_LIMIT: Duration = Duration::from_millis(500);
/// Attempts to open a new socket instance, one a [`TICK`].
const REOPEN_ATTEMPTS: u32 = 100;

/// Publishes frames until [`Publisher::finish`].
#[derive(Debug)]
pub struct Publisher {
    mailbox: Arc<Mailbox>,
    endpoint: String,
    /// `None` once finished.
    thread: Option<JoinHandle<()>>,
}

impl Drop for Publisher {
    /// Without [`Publisher::finish`], after an error elsewhere, the thread ends by itself.
    fn drop(&mut self) {
        self.mailbox.close(Instant::now());
    }
}

impl Publisher {
    /// Binds `endpoint` (`tcp://HOST:PORT`; `*` is every interface, port 0 a free one) and starts the publishing thread. Uses the settings
    /// `payload`, `frames_in_flight` and `stall_seconds`.
    ///
    /// # Errors
    /// A setting or an endpoint that is not accepted, a port in use, or an error of the system.
    pub fn start(endpoint: &str, settings: &PublishSettings) -> Result<Self, PublishError> {
        settings.check()?;
        let listener = bind(endpoint)?;
        let refuse = |source| PublishError::Bind { endpoint: endpoint.to_owned(), source };
        let resolved = format!("tcp://{}", listener.local_addr().map_err(refuse)?);
        // In another thread, since a runtime cannot be driven or dropped inside another one.
        let first = std::thread::scope(|scope| scope.spawn(|| SocketInstance::open(&listener, 0)).join())
            .unwrap_or_else(|_| Err(std::io::Error::other("the socket could not be created")))
            .map_err(refuse)?;
        let mailbox = Arc::new(Mailbox::default());
        let worker = Worker {
            mailbox: Arc::clone(&mailbox),
            listener,
            payload: settings.payload,
            cap: settings.frames_in_flight,
            stall: Duration::from_secs_f64(settings.stall_seconds),
            number: 0,
        };
        let name = "ridgewatch-publish";
        let thread = std::thread::Builder::new()
            .name(name.to_owned())
            .spawn(move || worker.run(first))
            .map_err(|source| PublishError::Thread { name, source })?;
        Ok(Self { mailbox, endpoint: resolved, thread: Some(thread) })
    }

    /// Endpoint, with the port that was bound.
    pub fn endpoint(&self) -> &str {
        &self.endpoint
    }

    /// Publishes a frame. Never waits. It replaces a picture that was not sent yet; that record is still sent.
    pub fn frame(&self, frame: Frame) {
        self.mailbox.put(frame);
    }

    /// Counts so far.
    pub fn statistics(&self) -> PublishStatistics {
        self.mailbox.lock().statistics
    }

    /// Sends the rest, waits at most `linger` until subscribers have it, and closes the socket.
    pub fn finish(mut self, linger: Duration) -> PublishStatistics {
        self.mailbox.close(Instant::now() + linger);
        if self.thread.take().is_some_and(|thread| thread.join().is_err()) {
            tracing::error!("the publishing thread ended by a panic");
        }
        self.mailbox.lock().statistics
    }
}

/// Resolves and binds. The standard library sets `SO_REUSEADDR`, so that only a listener blocks the port, not connections of an earlier run.
fn bind(endpoint: &str) -> Result<TcpListener, PublishError> {
    let wrong = |problem: String| PublishError::Endpoint { endpoint: endpoint.to_owned(), problem };
    let address = endpoint.strip_prefix("tcp://").ok_or_else(|| wrong("only tcp is served".to_owned()))?;
    let (host, port) = address.rsplit_once(':').ok_or_else(|| wrong("it has no port".to_owned()))?;
    let port: u16 = port.parse().map_err(|_| wrong(format!("`{port}` is not a port from 0 to 65535")))?;
    let host = match host.trim_start_matches('[').trim_end_matches(']') {
        "" => return Err(wrong("it has no host".to_owned())),
        "*" => "0.0.0.0",
        host => host,
    };
    let addresses: Vec<_> = (host, port).to_socket_addrs().map_err(|e| wrong(format!("host `{host}` is unknown: {e}")))?.collect();
    TcpListener::bind(addresses.as_slice()).map_err(|source| match source.kind() {
        std::io::ErrorKind::AddrInUse => PublishError::PortInUse { endpoint: endpoint.to_owned() },
        _ => PublishError::Bind { endpoint: endpoint.to_owned(), source },
    })
}

/// A PUB socket with its own runtime: shutting the runtime down ends all tasks of the socket.
struct SocketInstance {
    number: u64,
    runtime: tokio::runtime::Runtime,
    socket: PubSocket,
    subscribers: HashSet<PeerIdentity>,
    next_event: Box<dyn FnMut() -> Option<SocketEvent> + Send>,
    /// Accepts connections.
    acceptor: tokio::task::JoinHandle<()>,
}

impl SocketInstance {
    fn open(listener: &TcpListener, number: u64) -> std::io::Result<Self> {
        let listener = listener.try_clone()?;
        let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(1).thread_name("ridgewatch-zmq").enable_all().build()?;
        let (socket, mut events, acceptor) = runtime.block_on(async {
            let mut socket = PubSocket::new();
            let events = socket.monitor();
            let (inside, place) = private_listener()?;
            socket.bind_listener(inside).await.map_err(std::io::Error::other)?;
            listener.set_nonblocking(true)?;
            let acceptor = tokio::spawn(guard(tokio::net::TcpListener::from_std(listener)?, place));
            std::io::Result::Ok((socket, events, acceptor))
        })?;
        let next_event = Box::new(move || events.try_recv().ok());
        Ok(Self { number, runtime, socket, subscribers: HashSet::new(), next_event, acceptor })
    }

    /// Number of subscribers, after the latest connection events.
    fn subscribers(&mut self) -> usize {
        while let Some(event) = (self.next_event)() {
            match event {
                SocketEvent::Accepted(_, peer) => {
                    self.subscribers.insert(peer);
                }
                SocketEvent::Disconnected(peer) => {
                    self.subscribers.remove(&peer);
                }
                _ => {}
            }
        }
        self.subscribers.len()
    }

    fn send(&mut self, parts: Vec<Bytes>) -> Result<(), String> {
        let message = ZmqMessage::try_from(parts).map_err(|e| e.to_string())?;
        self.runtime.block_on(self.socket.send(message)).map_err(|e| e.to_string())
    }

    /// Closes all connections at once and frees their memory.
    fn abort(self) {
        drop(self.socket);
        self.runtime.shutdown_timeout(SHUTDOWN_LIMIT);
    }

    /// Closes the socket when its writers are done, at the latest at `by`.
    fn close(self, by: Instant) {
        // Without the socket, the writer tasks end when their queues are empty, and then their connections.
        self.acceptor.abort();
        drop(self.socket);
        while self.runtime.metrics().num_alive_tasks() > 0 && Instant::now() < by {
            std::thread::sleep(Duration::from_millis(2));
        }
        self.runtime.shutdown_timeout(SHUTDOWN_LIMIT);
    }
}

/// Next step of the publishing thread.
enum Step {
    Picture(Frame),
    Records(Vec<Arc<FrameRecord>>),
    DisconnectAll,
    Update,
    Close(Instant),
}

/// The publishing thread.
struct Worker {
    mailbox: Arc<Mailbox>,
    listener: TcpListener,
    payload: Payload,
    cap: usize,
    stall: Duration,
    number: u64,
}

impl Worker {
    fn run(mut self, first: SocketInstance) {
        let mut current = Some(first);
        loop {
            if let Some(instance) = &mut current {
                let subscribers = instance.subscribers() as u64;
                let mut state = self.mailbox.lock();
                state.statistics.peak_subscribers = state.statistics.peak_subscribers.max(subscribers);
            }
            match self.next_step() {
                Step::Records(records) => self.send_records(current.as_mut(), &records),
                Step::Picture(frame) => self.send_picture(current.as_mut(), &frame),
                Step::DisconnectAll => current = self.replace(current),
                Step::Update => {}
                Step::Close(by) => {
                    if let Some(instance) = current {
                        instance.close(by);
                    }
                    return;
                }
            }
        }
    }

    /// Waits for the next step, at most a tick.
    fn next_step(&self) -> Step {
        let mut state = self.mailbox.lock();
        let until = Instant::now() + TICK;
        loop {
            if let Some(step) = self.ready(&mut state) {
                return step;
            }
            let now = Instant::now();
            let wake = state.oldest(self.number).map_or(until, |oldest| until.min(oldest + self.stall));
            let wake = state.close_by.map_or(wake, |by| wake.min(by));
            if now >= until {
                return Step::Update;
            }
            // A millisecond longer, so that the deadline has passed on waking.
            state = self.mailbox.wait(state, wake.saturating_duration_since(now) + Duration::from_millis(1));
        }
    }

    fn ready(&self, state: &mut MutexGuard<'_, State>) -> Option<Step> {
        let now = Instant::now();
        let oldest = state.oldest(self.number);
        if let Some(by) = state.close_by {
            let done = state.frame.is_none() && state.records.is_empty() && oldest.is_none();
            if done || now >= by {
                let left = u64::from(state.frame.take().is_some());
                state.statistics.superseded += left;
                state.statistics.records_dropped += state.records.len() as u64;
                state.records.clear();
                return Some(Step::Close(by));
            }
        }
        if oldest.is_some_and(|since| now >= since + self.stall) {
            return Some(Step::DisconnectAll);
        }
        let room = MAX_RECORDS.saturating_sub(state.held(Kind::Record, self.number));
        if room > 0 && !state.records.is_empty() {
            let count = room.min(state.records.len());
            return Some(Step::Records(state.records.drain(..count).collect()));
        }
        if state.held(Kind::Picture, self.number) < self.cap {
            return state.frame.take().map(Step::Picture);
        }
        None
    }

    fn send_records(&self, mut instance: Option<&mut SocketInstance>, records: &[Arc<FrameRecord>]) {
        for record in records {
            let sent = match instance.as_deref_mut() {
                Some(instance) if !instance.subscribers.is_empty() => {
                    serde_json::to_vec(&**record).map_err(|e| e.to_string()).and_then(|json| {
                        let json = self.mailbox.count(json, Kind::Record, instance.number);
                        instance.send(vec![Bytes::from_static(RECORD_TOPIC.as_bytes()), json])
                    })
                }
                _ => Ok(()),
            };
            let mut state = self.mailbox.lock();
            match sent {
                Ok(()) => state.statistics.records += 1,
                Err(error) => {
                    state.statistics.records_dropped += 1;
                    drop(state);
                    tracing::warn!("record of frame {} was not published: {error}", record.frame);
                }
            }
        }
    }

    fn send_picture(&self, instance: Option<&mut SocketInstance>, frame: &Frame) {
        let Some(instance) = instance.filter(|g| !g.subscribers.is_empty()) else {
            self.mailbox.lock().statistics.without_subscriber += 1;
            return;
        };
        let sent = encode_frame(frame, self.payload).and_then(|(header, payload)| {
            let payload = self.mailbox.count(payload, Kind::Picture, instance.number);
            instance.send(vec![Bytes::from_static(FRAME_TOPIC.as_bytes()), Bytes::from(header), payload])
        });
        let mut state = self.mailbox.lock();
        match sent {
            Ok(()) => state.statistics.sent += 1,
            Err(error) => {
                state.statistics.failed += 1;
                drop(state);
                tracing::warn!("frame {} was not published: {error}", frame.record.frame);
            }
        }
    }

    /// Closes all connections and opens a new socket instance on the same listener.
    fn replace(&mut self, old: Option<SocketInstance>) -> Option<SocketInstance> {
        if let Some(old) = old {
            let subscribers = old.subscribers.len();
            tracing::warn!(
                "one of {subscribers} subscribers held a message longer than {:?}: all are disconnected and may reconnect",
                self.stall
            );
            old.abort();
        }
        self.number += 1;
        self.mailbox.lock().statistics.stall_disconnects += 1;
        for attempt in 1..=REOPEN_ATTEMPTS {
            match SocketInstance::open(&self.listener, self.number) {
                Ok(instance) => return Some(instance),
                Err(error) if attempt == 1 => tracing::warn!("no new socket yet: {error}"),
                Err(_) => {}
            }
            if self.mailbox.lock().close_by.is_some_and(|by| Instant::now() >= by) {
                break;
            }
            std::thread::sleep(TICK);
        }
        tracing::error!("publishing ends: no new socket after {REOPEN_ATTEMPTS} attempts; the run continues");
        self.mailbox.lock().statistics.socket_lost = true;
        None
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn endpoints_are_checked() {
        for (endpoint, hint) in [
            ("udp://127.0.0.1:5577", "only tcp"),
            ("tcp://127.0.0.1", "no port"),
            ("tcp://127.0.0.1:99999", "not a port from 0"),
            ("tcp://:5577", "no host"),
            ("tcp://no such host:5577", "unknown"),
        ] {
            let error = bind(endpoint).unwrap_err().to_string();
            assert!(error.contains(hint) && error.contains(endpoint), "{error}");
        }
        assert_ne!(bind("tcp://127.0.0.1:0").unwrap().local_addr().unwrap().port(), 0);
    }
}
