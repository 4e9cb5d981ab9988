//! Relay: sends the steps of a node's rings to followers on other nodes.
//!
//! Each follower has a thread and its own [`RingFollower`], and gets the next step when it requests one. A slow follower sees newer steps or delays a producer
//! that waits, and costs the memory of one step. A follower that neither reads nor sends anything for [`PEER_TIMEOUT`] is disconnected.

use self::notices::Notices;
use self::paced::{IDLE, PULSE, Paced, greet};
use crate::follow::{Event, RingFollower};
use crate::message::{ASK_BYTES, Ask, Facts, Key, Kind, Session};
use crate::{Limits, WireError, system};
use std::collections::VecDeque;
use std::io::{ErrorKind, Read, Write};
use std::net::{Shutdown, SocketAddr, TcpListener, TcpStream};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, AtomicU64, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

mod follower;
mod lookup;
mod notices;
mod paced;

pub use follower::{BUFFERS, Locate, RelayFollower};
pub use paced::PEER_TIMEOUT;

/// Interval of heartbeats to the producers while a follower has no open request.
const HOLD: Duration = Duration::from_millis(50);
/// Most followers.
const MAX_FOLLOWERS: usize = 16;
/// Most connections that have not proved the key yet.
const MAX_UNPROVEN: usize = 16;

/// Counters of a relay.
#[derive(Debug, Default)]
pub struct RelayCounts {
    /// Current followers.
    pub followers: AtomicUsize,
    /// Connections that proved the key.
    pub accepted: AtomicU64,
    /// Connections that were rejected.
    pub refused: AtomicU64,
    /// Steps sent.
    pub steps: AtomicU64,
    /// Bytes of their values.
    pub bytes: AtomicU64,
}

/// A stream that sends heartbeats to the producers between its pieces, however long a step takes.
struct Beating<'a> {
    stream: Paced<'a>,
    rings: &'a mut RingFollower,
}

impl Write for Beating<'_> {
    fn write(&mut self, from: &[u8]) -> std::io::Result<usize> {
        self.rings.beat();
        self.stream.write(from)
    }

    fn flush(&mut self) -> std::io::Result<()> {
        Ok(())
    }
}

/// Connections that have not proved the key yet.
#[derive(Default)]
struct Unproven(Mutex<VecDeque<(SocketAddr, TcpStream)>>);

impl Unproven {
    /// Adds a connection, and closes the oldest if there are too many.
    fn add(&self, peer: SocketAddr, stream: &TcpStream) -> std::io::Result<()> {
        let mut open = self.0.lock().unwrap_or_else(|broken| broken.into_inner());
        open.push_back((peer, stream.try_clone()?));
        if open.len() > MAX_UNPROVEN
            && let Some((_, oldest)) = open.pop_front()
        {
            // The peer may have closed it.
            let _ = oldest.shutdown(Shutdown::Both);
        }
        Ok(())
    }

    fn remove(&self, peer: SocketAddr) {
        self.0.lock().unwrap_or_else(|broken| broken.into_inner()).retain(|(one, _)| *one != peer);
    }
}

/// One of the [`MAX_FOLLOWERS`] places, freed however the follower's thread ends.
struct Place<'a> {
    followers: &'a AtomicUsize,
    /// Number of followers before this one.
    before: usize,
}

impl<'a> Place<'a> {
    fn take(followers: &'a AtomicUsize) -> Self {
        Self { followers, before: followers.fetch_add(1, Ordering::Relaxed) }
    }
}

impl Drop for Place<'_> {
    fn drop(&mut self) {
        self.followers.fetch_sub(1, Ordering::Relaxed);
    }
}

/// State that the connections of a relay share.
struct Relay {
    ring: PathBuf,
    key: Key,
    counts: Arc<RelayCounts>,
    unproven: Unproven,
    stop: Arc<AtomicBool>,
    tell: Arc<dyn Fn(String) + Send + Sync>,
    /// Interval of pulses while there is nothing to send or a step is read.
    pulse: Duration,
    rejected: Notices,
    lost: Notices,
    left: Notices,
    refused: Notices,
}

/// Serves the rings of a folder until `stop` is set. `tell` gets notices of followers that are rejected or leave.
///
/// # Errors
/// The folder is not this user's alone, or the listener broke.
pub fn serve(
    ring: &Path,
    listener: &TcpListener,
    key: &Key,
    counts: &Arc<RelayCounts>,
    stop: &Arc<AtomicBool>,
    tell: Arc<dyn Fn(String) + Send + Sync>,
) -> Result<(), WireError> {
    let broken = |e| WireError::io(Path::new("listener"), "broke", e);
    // Steps are kept for later followers only while the ring is followed: the relay itself follows it.
    let _following = crate::lock::Following::begin(ring)?;
    listener.set_nonblocking(true).map_err(broken)?;
    let relay = Arc::new(Relay::new(ring, key, counts, stop, tell));
    let mut threads: Vec<JoinHandle<()>> = Vec::new();
    while !stop.load(Ordering::Relaxed) {
        threads.retain(|thread| !thread.is_finished());
        relay.summarise();
        let (stream, peer) = match listener.accept() {
            // The threads of closed connections are about to end.
            Ok((_, peer)) if threads.len() > MAX_FOLLOWERS + 2 * MAX_UNPROVEN => {
                relay.refuse(peer, "too many come at once".to_owned());
                continue;
            }
            Ok(came) => came,
            Err(e) if e.kind() == ErrorKind::WouldBlock => {
                std::thread::sleep(Duration::from_millis(20));
                continue;
            }
            // The peer has gone or no descriptor is left; later connections may succeed.
            Err(e) => {
                relay.report(&relay.lost, || format!("a connection was lost: {e}"));
                std::thread::sleep(Duration::from_millis(100));
                continue;
            }
        };
        threads.extend(relay.attend(stream, peer, std::thread::Builder::new()));
    }
    for thread in threads {
        let _ = thread.join();
    }
    Ok(())
}

impl Relay {
    fn new(ring: &Path, key: &Key, counts: &Arc<RelayCounts>, stop: &Arc<AtomicBool>, tell: Arc<dyn Fn(String) + Send + Sync>) -> Self {
        Self {
            ring: ring.to_owned(),
            key: key.clone(),
            counts: counts.clone(),
            unproven: Unproven::default(),
            stop: stop.clone(),
            tell,
            pulse: PULSE,
            rejected: Notices::new("were rejected"),
            lost: Notices::new("connections were lost"),
            left: Notices::new("follower connections ended"),
            refused: Notices::new("rings were refused"),
        }
    }

    fn refuse(&self, peer: SocketAddr, why: String) {
        self.counts.refused.fetch_add(1, Ordering::Relaxed);
        self.report(&self.rejected, || format!("{peer} was rejected: {why}"));
    }

    fn report(&self, notices: &Notices, text: impl FnOnce() -> String) {
        if let Some(text) = notices.add(text) {
            (self.tell)(text);
        }
    }

    /// Reports the summaries of notices that came too fast.
    fn summarise(&self) {
        [&self.rejected, &self.lost, &self.left, &self.refused].into_iter().filter_map(Notices::due).for_each(|text| (self.tell)(text));
    }

    /// Starts a thread for a connection, or rejects it if no thread can be started.
    fn attend(self: &Arc<Self>, stream: TcpStream, peer: SocketAddr, thread: std::thread::Builder) -> Option<JoinHandle<()>> {
        let relay = self.clone();
        let started = thread.name("ridgewatch-relay".into()).spawn(move || relay.connection(&stream, peer));
        started.map_err(|e| self.refuse(peer, format!("no thread could be started for it: {e}"))).ok()
    }

    /// Serves one connection until it ends.
    fn connection(&self, stream: &TcpStream, peer: SocketAddr) {
        let mut place = None;
        let admit = || match place.insert(Place::take(&self.counts.followers)).before {
            MAX_FOLLOWERS.. => {
                Err(WireError::field("followers", format_args!("{MAX_FOLLOWERS} already"), format!("at most {MAX_FOLLOWERS}")))
            }
            _ => Ok(()),
        };
        let greeted = self.unproven.add(peer, stream).map_err(WireError::connection);
        let greeted = greeted.and_then(|()| greet(stream, &self.stop, |paced| Session::accept_if(paced, &self.key, admit)));
        self.unproven.remove(peer);
        let session = match greeted {
            Ok(session) => session,
            Err(error) => return self.refuse(peer, error.to_string()),
        };
        self.counts.accepted.fetch_add(1, Ordering::Relaxed);
        if let Err(error) = self.send_steps(stream, session)
            && !self.stop.load(Ordering::Relaxed)
        {
            self.report(&self.left, || format!("follower {peer}: {error}"));
        }
    }

    /// Answers each request of the follower with the next event.
    fn send_steps(&self, stream: &TcpStream, mut session: Session) -> Result<(), WireError> {
        let mut rings = RingFollower::begin(&self.ring, Limits::default())?;
        let (mut values, mut asked) = (Vec::new(), false);
        let (mut sent, mut heard) = (Instant::now(), Instant::now());
        let quiet = Facts { kind: Kind::Pulse, block: 0, generation: 0, step: 0, time: 0.0, published: 0, missed: 0 };
        while !self.stop.load(Ordering::Relaxed) {
            let begin = Instant::now();
            let mut pulsed = Ok(());
            let mut pulse = || {
                if pulsed.is_ok() && sent.elapsed() > self.pulse {
                    pulsed = session.send(&mut Paced::new(stream, &self.stop), &quiet, None, &[]);
                    sent = Instant::now();
                }
                pulsed.is_ok() && !self.stop.load(Ordering::Relaxed)
            };
            let event = if asked { rings.poll_while(&mut values, &mut pulse) } else { None };
            pulsed?;
            // Messages of the follower were not received while a step was read.
            heard += begin.elapsed();
            if event.is_none() {
                if !asked {
                    rings.hold();
                }
                if let Some(ask) = receive_ask(&mut Paced::new(stream, &self.stop), &mut session, if asked { IDLE } else { HOLD })? {
                    asked |= ask == Ask::Next;
                    heard = Instant::now();
                }
                if heard.elapsed() > PEER_TIMEOUT {
                    return Err(WireError::io(Path::new("connection"), "the follower sent nothing", ErrorKind::TimedOut.into()));
                }
                if !asked {
                    continue;
                }
            }
            let (facts, description) = match event {
                Some(Event::Opened { description, generation }) => {
                    let facts = Facts { kind: Kind::Opened, block: description.block.index, generation, ..quiet };
                    (facts, Some(description))
                }
                Some(Event::Step { block, generation, step, time, published, missed }) => {
                    self.counts.steps.fetch_add(1, Ordering::Relaxed);
                    self.counts.bytes.fetch_add(size_of_val(values.as_slice()) as u64, Ordering::Relaxed);
                    (Facts { kind: Kind::Step, block, generation, step, time, published, missed }, None)
                }
                Some(Event::Ended { block, generation, closed }) => {
                    let kind = if closed { Kind::Ended } else { Kind::Lost };
                    (Facts { kind, block, generation, ..quiet }, None)
                }
                Some(Event::Refused(error)) => {
                    self.report(&self.refused, || format!("refused: {error}"));
                    continue;
                }
                None if sent.elapsed() > self.pulse => (quiet, None),
                None => continue,
            };
            let step: &[f32] = if facts.kind == Kind::Step { &values } else { &[] };
            session.send(
                &mut Beating { stream: Paced::new(stream, &self.stop), rings: &mut rings },
                &facts,
                description.as_deref(),
                step,
            )?;
            // A pulse is no answer. A completed send shows that the follower reads.
            asked = facts.kind == Kind::Pulse;
            (sent, heard) = (Instant::now(), if asked { heard } else { Instant::now() });
        }
        Ok(())
    }
}

/// Receives a request of the follower; `None` if there is none within the limit.
fn receive_ask(stream: &mut Paced, session: &mut Session, limit: Duration) -> Result<Option<Ask>, WireError> {
    if !system::readable(stream.stream, limit).map_err(WireError::connection)? {
        return Ok(None);
    }
    let mut bytes = [0; ASK_BYTES];
    stream.read_exact(&mut bytes).map_err(WireError::connection)?;
    session.check_ask(&bytes).map(Some)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Description;
    use std::os::fd::AsRawFd;

    /// Closes a connection by a TCP reset.
    fn reset(stream: TcpStream) {
        let at_once = libc::linger { l_onoff: 1, l_linger: 0 };
        // SAFETY: an option of a socket that lives, with its own type.
        let done = unsafe {
            let (value, length) = ((&raw const at_once).cast(), size_of_val(&at_once) as libc::socklen_t);
            libc::setsockopt(stream.as_raw_fd(), libc::SOL_SOCKET, libc::SO_LINGER, value, length)
        };
        assert_eq!(done, 0);
    }

    #[test]
    fn producers_hear_of_a_follower_while_a_step_is_sent() {
        let ring = PathBuf::from("/dev/shm").join(format!("rw-beating-{}", std::process::id()));
        let axis = |name| crate::AxisDescription::uniform(name, "m", 0.0, 1.0, 2);
        let description = Description::whole(crate::Geometry::Cartesian, vec![axis("x"), axis("y")], "s");
        let producer = crate::Producer::open(&ring, description, 2, crate::Policy::NewestWins).unwrap();
        let mut rings = RingFollower::begin(&ring, Limits::default()).unwrap();
        let begin = Instant::now();
        assert!(matches!(rings.poll(&mut Vec::new()), Some(Event::Opened { .. })));
        // Heartbeat in the first follower's mark.
        let heartbeat = || {
            let (file, mut bytes) = (std::fs::File::open(crate::block_path(&ring, 0)).unwrap(), [0; 8]);
            std::os::unix::fs::FileExt::read_exact_at(&file, &mut bytes, crate::header::MARK as u64 + 8).unwrap();
            u64::from_ne_bytes(bytes)
        };
        let opened = heartbeat();
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let stream = TcpStream::connect(listener.local_addr().unwrap()).unwrap();
        let stop = AtomicBool::new(false);
        let mut beating = Beating { stream: Paced::new(&stream, &stop), rings: &mut rings };
        beating.write_all(&[0]).unwrap();
        assert!(heartbeat() == opened || begin.elapsed() > Duration::from_secs(1), "a second is not over");
        std::thread::sleep(Duration::from_millis(1100));
        beating.write_all(&[0]).unwrap();
        assert!(heartbeat() > opened);
        drop((rings, producer));
        assert!(!ring.exists());
    }

    #[test]
    fn a_follower_hears_of_its_relay_while_a_step_is_read() {
        let ring = PathBuf::from("/dev/shm").join(format!("rw-pulses-{}", std::process::id()));
        let axis = |name| crate::AxisDescription::uniform(name, "m", 0.0, 1.0, 1024);
        let description = Description::whole(crate::Geometry::Cartesian, vec![axis("x"), axis("y")], "s");
        let producer = crate::Producer::open(&ring, description, 2, crate::Policy::NewestWins).unwrap();
        let plane = vec![1.0f32; 1 << 20];
        let field = [plane.as_ptr().cast::<u8>(); 2];
        // SAFETY: a value a node.
        unsafe { producer.publish(0, 0.0, &crate::Field::packed(&field, crate::Element::F32, [1024, 1024, 1])).unwrap() };
        let (counts, stop) = (Arc::default(), Arc::new(AtomicBool::new(false)));
        let key = Key::random().unwrap();
        let mut relay = Relay::new(&ring, &key, &counts, &stop, Arc::new(|_| ()));
        // Every piece takes longer than this.
        relay.pulse = Duration::ZERO;
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let mut stream = TcpStream::connect(listener.local_addr().unwrap()).unwrap();
        std::thread::scope(|scope| {
            scope.spawn(|| {
                let (stream, peer) = listener.accept().unwrap();
                relay.connection(&stream, peer);
            });
            let mut session = Session::connect(&mut stream, &key).unwrap();
            let mut block_bytes = None;
            let mut note = |_: u32, announced: Option<Description>| {
                block_bytes = announced.map(|announced| announced.block_bytes()).or(block_bytes);
                block_bytes
            };
            let mut next = |session: &mut Session, values: &mut Vec<f32>| {
                session.ask(&mut stream, Ask::Next).unwrap();
                let mut pulses = 0;
                loop {
                    match session.receive(&mut stream, &Limits::default(), &mut note, values).unwrap().kind {
                        Kind::Pulse => pulses += 1,
                        kind => return (kind, pulses),
                    }
                }
            };
            let mut values = Vec::new();
            assert_eq!(next(&mut session, &mut values).0, Kind::Opened);
            let (kind, pulses) = next(&mut session, &mut values);
            stop.store(true, Ordering::Relaxed);
            // 8 MiB; more pulses may come before the read begins.
            assert!(kind == Kind::Step && pulses >= 8, "{kind:?} after {pulses} pulses");
            assert!(values.len() == 1 << 21 && values.iter().all(|v| *v == 1.0));
        });
        drop(producer);
        assert!(!ring.exists());
    }

    #[test]
    fn a_follower_for_whom_no_thread_can_be_had_is_told_and_sent_away() {
        let (told, hear) = std::sync::mpsc::channel();
        let told = Mutex::new(told);
        let tell = move |words| told.lock().unwrap().send(words).unwrap();
        let (counts, key) = (Arc::<RelayCounts>::default(), Key::random().unwrap());
        let relay = Arc::new(Relay::new(Path::new("/dev/shm"), &key, &counts, &Arc::default(), Arc::new(tell)));
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let mut client = TcpStream::connect(listener.local_addr().unwrap()).unwrap();
        let (stream, peer) = listener.accept().unwrap();
        // No address space has room for this stack.
        assert!(relay.attend(stream, peer, std::thread::Builder::new().stack_size(1 << 60)).is_none());
        let words = hear.try_recv().unwrap();
        assert!(words.starts_with(&format!("{peer} was rejected: no thread could be started for it: ")), "{words}");
        assert_eq!(counts.refused.load(Ordering::Relaxed), 1);
        assert_eq!(client.read(&mut [0]).unwrap(), 0, "hung up");
    }

    #[test]
    fn a_follower_whose_thread_panics_leaves_its_place() {
        let followers = AtomicUsize::new(3);
        let panicked = std::panic::catch_unwind(|| {
            let place = Place::take(&followers);
            assert_eq!((place.before, followers.load(Ordering::Relaxed)), (3, 4));
            panic!("as a follower's thread may");
        });
        assert!(panicked.is_err());
        assert_eq!(followers.load(Ordering::Relaxed), 3);
    }

    #[test]
    fn a_stranger_that_resets_its_connection_costs_nobody_else_a_place() {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let address = listener.local_addr().unwrap();
        let unproven = Unproven::default();
        let mut clients = Vec::new();
        for n in 0..MAX_UNPROVEN + 2 {
            let client = TcpStream::connect(address).unwrap();
            let (stream, peer) = listener.accept().unwrap();
            if n == 0 {
                reset(client);
                // The reset has arrived, and the connection is still in the list.
                assert!((&stream).read(&mut [0]).is_err());
                assert!(stream.shutdown(Shutdown::Both).is_err(), "a reset connection cannot be shut down");
            } else {
                clients.push(client);
            }
            unproven.add(peer, &stream).unwrap();
        }
        assert_eq!(unproven.0.lock().unwrap().len(), MAX_UNPROVEN);
    }
}
