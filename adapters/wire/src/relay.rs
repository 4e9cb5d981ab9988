//! From a node's rings to followers elsewhere.
//!
//! The relay gives each follower a thread and a view of the rings of its own: a follower that is slow reads more rarely and sees newer steps, and
//! costs nothing but one step's memory. One that takes nothing for [`PATIENCE`] is cut off.

use crate::follow::{Event, RingFollower};
use crate::message::{ConnectionFile, Facts, Key, Kind, Session};
use crate::{Description, Limits, WireError};
use std::collections::BTreeMap;
use std::io::BufReader;
use std::net::{TcpListener, TcpStream, ToSocketAddrs};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, AtomicUsize, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender, sync_channel};
use std::time::{Duration, Instant};

/// Longest that a peer may take for a piece of a message.
pub const PATIENCE: Duration = Duration::from_secs(5);
/// How often a relay with nothing to send says that it lives.
const PULSE: Duration = Duration::from_secs(1);
/// How often an idle thread looks for new steps.
const IDLE: Duration = Duration::from_millis(1);
/// Pause before a follower tries again to connect.
const AGAIN: Duration = Duration::from_millis(500);
/// Followers at once.
const FOLLOWERS: usize = 16;

/// What a relay has done.
#[derive(Debug, Default)]
pub struct RelayCounts {
    /// Followers there now.
    pub followers: AtomicUsize,
    /// Connections that proved the key.
    pub accepted: AtomicU64,
    /// Connections that did not.
    pub refused: AtomicU64,
    /// Steps sent.
    pub steps: AtomicU64,
    /// Bytes of their values.
    pub bytes: AtomicU64,
}

fn timeouts(stream: &TcpStream) -> std::io::Result<()> {
    stream.set_nodelay(true)?;
    stream.set_read_timeout(Some(PATIENCE))?;
    stream.set_write_timeout(Some(PATIENCE))
}

/// Serves the rings of a folder until `stop` is set. `tell` hears of followers that come and go, and why.
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
    // Steps are kept for followers that come later only as long as somebody follows: the relay itself does.
    let _following = crate::lock::Following::begin(ring)?;
    listener.set_nonblocking(true).map_err(broken)?;
    let mut threads: Vec<std::thread::JoinHandle<()>> = Vec::new();
    while !stop.load(Ordering::Relaxed) {
        threads.retain(|thread| !thread.is_finished());
        let (stream, peer) = match listener.accept() {
            Ok(came) => came,
            Err(e) if e.kind() == std::io::ErrorKind::WouldBlock => {
                std::thread::sleep(Duration::from_millis(20));
                continue;
            }
            // A peer that went before it was taken, or no descriptor left: later ones may fare better.
            Err(e) => {
                tell(format!("a connection was lost: {e}"));
                std::thread::sleep(Duration::from_millis(100));
                continue;
            }
        };
        if threads.len() >= FOLLOWERS {
            counts.refused.fetch_add(1, Ordering::Relaxed);
            tell(format!("{peer} was sent away: {FOLLOWERS} are there"));
            continue;
        }
        let (ring, key, counts, stop, tell) = (ring.to_owned(), key.clone(), counts.clone(), stop.clone(), tell.clone());
        let work = move || {
            let ended = follower(stream, ring, &key, &counts, &stop);
            if let Err(error) = ended {
                tell(format!("follower {peer}: {error}"));
            }
        };
        let started = std::thread::Builder::new().name("ridgewatch-relay".into()).spawn(work);
        threads.extend(started.map_err(broken));
    }
    for thread in threads {
        let _ = thread.join();
    }
    Ok(())
}

/// One follower.
fn follower(mut stream: TcpStream, ring: PathBuf, key: &Key, counts: &RelayCounts, stop: &AtomicBool) -> Result<(), WireError> {
    let broken = |e| WireError::io(Path::new("connection"), "broke", e);
    stream.set_nonblocking(false).and_then(|()| timeouts(&stream)).map_err(broken)?;
    let mut session = Session::accept(&mut stream, key).inspect_err(|_| {
        counts.refused.fetch_add(1, Ordering::Relaxed);
    })?;
    counts.accepted.fetch_add(1, Ordering::Relaxed);
    counts.followers.fetch_add(1, Ordering::Relaxed);
    let ended = send_steps(&mut stream, &mut session, &ring, counts, stop);
    counts.followers.fetch_sub(1, Ordering::Relaxed);
    ended
}

fn send_steps(
    stream: &mut TcpStream,
    session: &mut Session,
    ring: &Path,
    counts: &RelayCounts,
    stop: &AtomicBool,
) -> Result<(), WireError> {
    let mut rings = RingFollower::begin(ring, Limits { step_bytes: u64::MAX })?;
    // Descriptions that the follower does not have yet, by block, and generations.
    let mut fresh: BTreeMap<u32, Box<Description>> = BTreeMap::new();
    let mut generations: BTreeMap<u32, u64> = BTreeMap::new();
    let (mut values, mut sent) = (Vec::new(), Instant::now());
    let quiet = Facts { kind: Kind::Pulse, block: 0, generation: 0, step: 0, time: 0.0, published: 0, missed: 0 };
    while !stop.load(Ordering::Relaxed) {
        match rings.poll(&mut values) {
            Some(Event::Opened { description, generation }) => {
                generations.insert(description.block.index, generation);
                fresh.insert(description.block.index, description);
            }
            Some(Event::Step { block, step, time, published, missed }) => {
                let generation = generations.get(&block).copied().unwrap_or(0);
                let facts = Facts { kind: Kind::Step, block, generation, step, time, published, missed };
                session.send(stream, &facts, fresh.remove(&block).as_deref(), &values)?;
                counts.steps.fetch_add(1, Ordering::Relaxed);
                counts.bytes.fetch_add(size_of_val(values.as_slice()) as u64, Ordering::Relaxed);
                sent = Instant::now();
            }
            // What went without closing ends for the follower too.
            Some(Event::Ended { block, .. }) => {
                let generation = generations.get(&block).copied().unwrap_or(0);
                session.send(stream, &Facts { kind: Kind::Ended, block, generation, ..quiet }, fresh.remove(&block).as_deref(), &[])?;
                sent = Instant::now();
            }
            Some(Event::Refused(_)) => {}
            None if sent.elapsed() > PULSE => {
                session.send(stream, &quiet, None, &[])?;
                sent = Instant::now();
            }
            None => std::thread::sleep(IDLE),
        }
    }
    Ok(())
}

/// Where a relay is; usually what its connection file says now.
pub type Place = Box<dyn Fn() -> Result<ConnectionFile, WireError> + Send>;

/// Follows a relay; connects anew whenever the connection breaks.
pub struct RelayFollower {
    events: Receiver<(Event, Vec<f32>)>,
    /// Buffers on their way back.
    spare: SyncSender<Vec<f32>>,
    stop: Arc<AtomicBool>,
}

impl RelayFollower {
    /// Starts the thread that receives. `place` is asked before each attempt to connect: a relay that was started anew has another address
    /// and key.
    ///
    /// # Errors
    /// The thread could not be started.
    pub fn begin(place: Place, limits: Limits) -> Result<Self, WireError> {
        // One step waits, one is being received, and the rest waits at the relay: newest wins there.
        let ((sender, events), (spare, back)) = (sync_channel(1), sync_channel(2));
        let stop = Arc::new(AtomicBool::new(false));
        let flag = stop.clone();
        let work = move || receive(&*place, limits, &sender, &back, &flag);
        let started = std::thread::Builder::new().name("ridgewatch-relay".into()).spawn(work);
        started.map_err(|e| WireError::io(Path::new("thread"), "could not be started", e))?;
        Ok(Self { events, spare, stop })
    }

    /// The next thing that happened, or none within the limit. A step's values are in `values`.
    pub fn poll(&mut self, values: &mut Vec<f32>, limit: Duration) -> Option<Event> {
        match self.events.recv_timeout(limit) {
            Ok((event, mut came)) => {
                std::mem::swap(values, &mut came);
                let _ = self.spare.try_send(came);
                Some(event)
            }
            Err(RecvTimeoutError::Timeout) => None,
            Err(RecvTimeoutError::Disconnected) => {
                std::thread::sleep(limit);
                None
            }
        }
    }
}

impl Drop for RelayFollower {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
    }
}

/// Connects, receives, and does so again until nobody listens.
fn receive(
    place: &dyn Fn() -> Result<ConnectionFile, WireError>,
    limits: Limits,
    to: &SyncSender<(Event, Vec<f32>)>,
    spare: &Receiver<Vec<f32>>,
    stop: &AtomicBool,
) {
    let mut told = String::new();
    // Blocks as they were last announced in a session.
    let mut blocks: BTreeMap<u32, (Description, u64)> = BTreeMap::new();
    while !stop.load(Ordering::Relaxed) {
        let found = place();
        let ended = found.and_then(|found| session(&found.address, &found.key, limits, to, spare, stop, &mut blocks, &mut told));
        let Err(error) = ended else { return };
        // Once for each reason: a relay that is not there yet is no news every half second.
        let words = error.to_string();
        if words != told {
            told = words;
            if to.send((Event::Refused(error), Vec::new())).is_err() {
                return;
            }
        }
        std::thread::sleep(AGAIN);
    }
}

fn session(
    address: &str,
    key: &Key,
    limits: Limits,
    to: &SyncSender<(Event, Vec<f32>)>,
    spare: &Receiver<Vec<f32>>,
    stop: &AtomicBool,
    blocks: &mut BTreeMap<u32, (Description, u64)>,
    told: &mut String,
) -> Result<(), WireError> {
    let broken = |e| WireError::io(Path::new(address), "cannot be reached", e);
    let found = address.to_socket_addrs().map_err(broken)?.next();
    let found = found.ok_or_else(|| WireError::field("address", address, "HOST:PORT of a relay"))?;
    let stream = TcpStream::connect_timeout(&found, PATIENCE).map_err(broken)?;
    timeouts(&stream).map_err(broken)?;
    let mut plain = stream;
    let mut session = Session::connect(&mut plain, key)?;
    told.clear();
    let mut from = BufReader::with_capacity(1 << 16, plain);
    while !stop.load(Ordering::Relaxed) {
        let mut values = spare.try_recv().unwrap_or_default();
        let mut announced = None;
        let mut note = |block: u32, description: Option<Description>| {
            if description.is_some() {
                announced = description;
            }
            announced.as_ref().or(blocks.get(&block).map(|(known, _)| known)).map(Description::block_bytes)
        };
        let facts = session.receive(&mut from, &limits, &mut note, &mut values)?;
        if let Some(description) = announced {
            let same = blocks.get(&facts.block).is_some_and(|(known, generation)| *known == description && *generation == facts.generation);
            blocks.insert(facts.block, (description.clone(), facts.generation));
            // After a mere break of the connection nothing was opened.
            if !same {
                let event = Event::Opened { description: Box::new(description), generation: facts.generation };
                if to.send((event, Vec::new())).is_err() {
                    return Ok(());
                }
            }
        }
        let Facts { block, step, time, published, missed, .. } = facts;
        let event = match facts.kind {
            Kind::Step => Event::Step { block, step, time, published, missed },
            Kind::Ended => Event::Ended { block, closed: true },
            Kind::Pulse => continue,
        };
        if to.send((event, values)).is_err() {
            return Ok(());
        }
    }
    Ok(())
}
