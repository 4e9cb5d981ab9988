//! The ZeroMQ publisher: newest wins, frames in flight are capped, a subscriber that stalls is cut off.
//!
//! The cycle puts a frame into the mailbox and goes on. A thread of its own takes the newest one when fewer than the cap are on
//! their way, encodes it and sends it. The `zeromq` crate's PUB socket has no high-water mark and no call to drop one peer, and a writer task
//! blocked by a peer outlives the socket. So each socket lives in a tokio runtime of its own: when the oldest part on its way has been
//! held longer than the limit, the runtime is shut down, which closes all its connections and frees all that they held, and a new
//! one takes over. The listener stays open all the while: healthy subscribers reconnect at once, and nobody can take the port.

use super::guard::{guard, private_listener};
use super::mailbox::{Kind, Mailbox, State};
use super::message::{FRAME_TOPIC, RECORD_TOPIC, encode_frame};
use super::{Payload, PublishError, PublishSettings};
use crate::engine::{Frame, FrameRecord};
use bytes::Bytes;
use serde::{Deserialize, Serialize};
use std::collections::HashSet;
use std::net::{TcpListener, ToSocketAddrs};
use std::sync::{Arc, MutexGuard};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};
use zeromq::util::PeerIdentity;
use zeromq::{PubSocket, Socket, SocketEvent, SocketSend, ZmqMessage};

/// How often the publishing thread looks around when nothing happens.
const TICK: Duration = Duration::from_millis(100);
/// Longest that a cut-off waits for the old socket's tasks.
const SHUTDOWN_LIMIT: Duration = Duration::from_millis(500);
/// Attempts to open a new socket after a cut-off, one a [`TICK`].
const REOPEN_ATTEMPTS: u32 = 100;

/// What became of the frames on the socket. `frames = sent + superseded + without_subscriber + failed`, once finished.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct PublishStatistics {
    /// Frames that the cycle handed over.
    pub frames: u64,
    /// Pictures given to the socket.
    pub sent: u64,
    /// Pictures replaced by a newer one before they could be sent.
    pub superseded: u64,
    /// Pictures that nobody subscribed to (no encoding is spent on them).
    pub without_subscriber: u64,
    /// Pictures that could not be encoded or sent.
    pub failed: u64,
    /// Records given to the socket, or heard by nobody.
    pub records: u64,
    /// Records dropped because too many waited.
    pub records_dropped: u64,
    /// Times that all connections were closed because a subscriber stalled.
    pub stall_disconnects: u64,
    /// Most subscribers at once.
    pub peak_subscribers: u64,
    /// Most bytes that the socket held at once, beside one copy a subscriber of the frame being written to it.
    pub peak_queued_bytes: u64,
    /// Whether publishing ended early because no new socket could be opened.
    pub socket_lost: bool,
}

/// Publishes frames until it is finished.
#[derive(Debug)]
pub struct Publisher {
    mailbox: Arc<Mailbox>,
    endpoint: String,
    /// None once finished.
    thread: Option<JoinHandle<()>>,
}

impl Drop for Publisher {
    /// Left without [`Publisher::finish`], after an error elsewhere: the thread ends by itself and nobody waits for it.
    fn drop(&mut self) {
        self.mailbox.close(Instant::now());
    }
}

impl Publisher {
    /// Binds `endpoint` (`tcp://HOST:PORT`; `*` is every interface, port 0 a free one) and starts the publishing thread. Of the
    /// settings it reads `payload`, `frames_in_flight` and `stall_seconds`.
    pub fn start(endpoint: &str, settings: &PublishSettings) -> Result<Self, PublishError> {
        settings.check()?;
        let listener = bind(endpoint)?;
        let refuse = |source| PublishError::Bind { endpoint: endpoint.to_owned(), source };
        let resolved = format!("tcp://{}", listener.local_addr().map_err(refuse)?);
        // In a thread of its own, since the caller may itself be inside a runtime, where none may be driven or dropped.
        let first = std::thread::scope(|scope| scope.spawn(|| Generation::open(&listener, 0)).join())
            .unwrap_or_else(|_| Err(std::io::Error::other("the socket could not be set up")))
            .map_err(refuse)?;
        let mailbox = Arc::new(Mailbox::default());
        let worker = Worker {
            mailbox: Arc::clone(&mailbox),
            listener,
            payload: settings.payload,
            cap: settings.frames_in_flight,
            stall: Duration::from_secs_f64(settings.stall_seconds),
            generation: 0,
        };
        let name = "ridgewatch-publish";
        let thread = std::thread::Builder::new()
            .name(name.to_owned())
            .spawn(move || worker.run(first))
            .map_err(|source| PublishError::Thread { name, source })?;
        Ok(Self { mailbox, endpoint: resolved, thread: Some(thread) })
    }

    /// Where it listens, with the port that it got.
    pub fn endpoint(&self) -> &str {
        &self.endpoint
    }

    /// Hands a frame over; never waits. A picture that was not taken yet is replaced; its record still goes out.
    pub fn frame(&self, frame: Frame) {
        self.mailbox.put(frame);
    }

    /// Figures so far.
    pub fn statistics(&self) -> PublishStatistics {
        self.mailbox.lock().statistics
    }

    /// Sends what is left, waits at most `linger` until subscribers have it, and closes the socket.
    pub fn finish(mut self, linger: Duration) -> PublishStatistics {
        self.mailbox.close(Instant::now() + linger);
        if self.thread.take().is_some_and(|thread| thread.join().is_err()) {
            tracing::error!("the publishing thread ended by a panic");
        }
        self.mailbox.lock().statistics
    }
}

/// Resolves and binds. The standard library sets `SO_REUSEADDR`: connections of an earlier run do not block the port, a listener does.
fn bind(endpoint: &str) -> Result<TcpListener, PublishError> {
    let wrong = |problem: String| PublishError::Endpoint { endpoint: endpoint.to_owned(), problem };
    let address = endpoint.strip_prefix("tcp://").ok_or_else(|| wrong("only tcp is served".to_owned()))?;
    let (host, port) = address.rsplit_once(':').ok_or_else(|| wrong("it has no port".to_owned()))?;
    let port: u16 = port.parse().map_err(|_| wrong(format!("`{port}` is no port from 0 to 65535")))?;
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

/// One PUB socket in a runtime of its own, so that shutting the runtime down ends whatever the socket spawned.
struct Generation {
    number: u64,
    runtime: tokio::runtime::Runtime,
    socket: PubSocket,
    subscribers: HashSet<PeerIdentity>,
    next_event: Box<dyn FnMut() -> Option<SocketEvent> + Send>,
    /// Lets subscribers in.
    door: tokio::task::JoinHandle<()>,
}

impl Generation {
    fn open(listener: &TcpListener, number: u64) -> std::io::Result<Self> {
        let listener = listener.try_clone()?;
        let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(1).thread_name("ridgewatch-zmq").enable_all().build()?;
        let (socket, mut events, door) = runtime.block_on(async {
            let mut socket = PubSocket::new();
            let events = socket.monitor();
            let (inside, place) = private_listener()?;
            socket.bind_listener(inside).await.map_err(std::io::Error::other)?;
            listener.set_nonblocking(true)?;
            let door = tokio::spawn(guard(tokio::net::TcpListener::from_std(listener)?, place));
            std::io::Result::Ok((socket, events, door))
        })?;
        let next_event = Box::new(move || events.try_recv().ok());
        Ok(Self { number, runtime, socket, subscribers: HashSet::new(), next_event, door })
    }

    /// Reads who came and went; returns how many are there.
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

    /// Ends it at once: connections are closed, and what they held is freed.
    fn cut(self) {
        drop(self.socket);
        self.runtime.shutdown_timeout(SHUTDOWN_LIMIT);
    }

    /// Ends it after the writers have written what they hold, or at `by`.
    fn close(self, by: Instant) {
        // The writer tasks end by themselves once the socket is gone and their queues are empty, and with them the connections at the door.
        self.door.abort();
        drop(self.socket);
        while self.runtime.metrics().num_alive_tasks() > 0 && Instant::now() < by {
            std::thread::sleep(Duration::from_millis(2));
        }
        self.runtime.shutdown_timeout(SHUTDOWN_LIMIT);
    }
}

/// What the publishing thread should do next.
enum Step {
    Picture(Frame),
    Records(Vec<Arc<FrameRecord>>),
    CutOff,
    Look,
    Close(Instant),
}

/// The publishing thread.
struct Worker {
    mailbox: Arc<Mailbox>,
    listener: TcpListener,
    payload: Payload,
    cap: usize,
    stall: Duration,
    generation: u64,
}

impl Worker {
    fn run(mut self, first: Generation) {
        let mut current = Some(first);
        loop {
            if let Some(generation) = &mut current {
                let subscribers = generation.subscribers() as u64;
                let mut state = self.mailbox.lock();
                state.statistics.peak_subscribers = state.statistics.peak_subscribers.max(subscribers);
            }
            match self.next_step() {
                Step::Records(records) => self.send_records(current.as_mut(), &records),
                Step::Picture(frame) => self.send_picture(current.as_mut(), &frame),
                Step::CutOff => current = self.replace(current),
                Step::Look => {}
                Step::Close(by) => {
                    if let Some(generation) = current {
                        generation.close(by);
                    }
                    return;
                }
            }
        }
    }

    /// Waits, at most a tick, for something to do.
    fn next_step(&self) -> Step {
        let mut state = self.mailbox.lock();
        let until = Instant::now() + TICK;
        loop {
            if let Some(step) = self.ready(&mut state) {
                return step;
            }
            let now = Instant::now();
            let wake = state.oldest(self.generation).map_or(until, |oldest| until.min(oldest + self.stall));
            let wake = state.close_by.map_or(wake, |by| wake.min(by));
            if now >= until {
                return Step::Look;
            }
            // A millisecond more than needed, so that the deadline has passed on waking.
            state = self.mailbox.wait(state, wake.saturating_duration_since(now) + Duration::from_millis(1));
        }
    }

    fn ready(&self, state: &mut MutexGuard<'_, State>) -> Option<Step> {
        let now = Instant::now();
        let oldest = state.oldest(self.generation);
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
            return Some(Step::CutOff);
        }
        let room = super::mailbox::RECORDS_WAITING.saturating_sub(state.held(Kind::Record, self.generation));
        if room > 0 && !state.records.is_empty() {
            let count = room.min(state.records.len());
            return Some(Step::Records(state.records.drain(..count).collect()));
        }
        if state.held(Kind::Picture, self.generation) < self.cap {
            return state.frame.take().map(Step::Picture);
        }
        None
    }

    fn send_records(&self, mut generation: Option<&mut Generation>, records: &[Arc<FrameRecord>]) {
        for record in records {
            let sent = match generation.as_deref_mut() {
                Some(generation) if !generation.subscribers.is_empty() => {
                    serde_json::to_vec(&**record).map_err(|e| e.to_string()).and_then(|json| {
                        let json = self.mailbox.count(json, Kind::Record, generation.number);
                        generation.send(vec![Bytes::from_static(RECORD_TOPIC.as_bytes()), json])
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

    fn send_picture(&self, generation: Option<&mut Generation>, frame: &Frame) {
        let Some(generation) = generation.filter(|g| !g.subscribers.is_empty()) else {
            self.mailbox.lock().statistics.without_subscriber += 1;
            return;
        };
        let sent = encode_frame(frame, self.payload).and_then(|(header, payload)| {
            let payload = self.mailbox.count(payload, Kind::Picture, generation.number);
            generation.send(vec![Bytes::from_static(FRAME_TOPIC.as_bytes()), Bytes::from(header), payload])
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

    /// Cuts everybody off and opens a new socket on the same listener.
    fn replace(&mut self, old: Option<Generation>) -> Option<Generation> {
        if let Some(old) = old {
            let subscribers = old.subscribers.len();
            tracing::warn!("one of {subscribers} subscribers held a message longer than {:?}: all are cut off to reconnect", self.stall);
            old.cut();
        }
        self.generation += 1;
        self.mailbox.lock().statistics.stall_disconnects += 1;
        for attempt in 1..=REOPEN_ATTEMPTS {
            match Generation::open(&self.listener, self.generation) {
                Ok(generation) => return Some(generation),
                Err(error) if attempt == 1 => tracing::warn!("no new socket yet: {error}"),
                Err(_) => {}
            }
            if self.mailbox.lock().close_by.is_some_and(|by| Instant::now() >= by) {
                break;
            }
            std::thread::sleep(TICK);
        }
        tracing::error!("publishing ends: no new socket after {REOPEN_ATTEMPTS} attempts; the run goes on");
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
            ("tcp://127.0.0.1:99999", "no port from 0"),
            ("tcp://:5577", "no host"),
            ("tcp://no such host:5577", "unknown"),
        ] {
            let error = bind(endpoint).unwrap_err().to_string();
            assert!(error.contains(hint) && error.contains(endpoint), "{error}");
        }
        assert_ne!(bind("tcp://127.0.0.1:0").unwrap().local_addr().unwrap().port(), 0);
    }
}
