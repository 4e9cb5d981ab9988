//! From a node's rings to followers elsewhere.
//!
//! The relay gives each follower a thread and a view of the rings of its own, and sends the next step when the follower asks for it: one that is slow
//! sees newer steps, or holds a producer that waits, and costs nothing but one step's memory. One that takes nothing and says nothing for
//! [`PATIENCE`] is cut off.

use crate::follow::{Event, RingFollower};
use crate::message::{ASK_BYTES, Ask, ConnectionFile, Facts, Key, Kind, PIECE, Session};
use crate::{Description, Limits, WireError, system};
use std::collections::{BTreeMap, VecDeque};
use std::io::{BufReader, ErrorKind, Read, Write};
use std::net::{Shutdown, SocketAddr, TcpListener, TcpStream, ToSocketAddrs};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, AtomicU64, AtomicUsize, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender, TrySendError, sync_channel};
use std::sync::{Arc, Mutex, MutexGuard};
use std::time::{Duration, Instant};

/// Longest that a peer may take for a piece of a message: 1 MiB, or what is left of it.
pub const PATIENCE: Duration = Duration::from_secs(5);
/// How often a relay with nothing to send says that it lives.
const PULSE: Duration = Duration::from_secs(1);
/// How often an idle thread looks for new steps.
const IDLE: Duration = Duration::from_millis(1);
/// How often a relay whose follower holds tells the producers that somebody follows.
const HOLD: Duration = Duration::from_millis(50);
/// Pause before a follower tries again to connect.
const AGAIN: Duration = Duration::from_millis(500);
/// Followers at once.
const FOLLOWERS: usize = 16;
/// Connections at once that have not proved the key yet.
const STRANGERS: usize = 16;

/// Steps of a block that a [`RelayFollower`] holds, at most: one that is received, one that waits, and two on their way back.
pub const BUFFERS: u64 = 4;

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

/// The longest that a wait lasts before it is looked whether to stop.
const TICK: Duration = Duration::from_millis(200);

/// How long a peer may take until the first bytes of a step are there: [`PATIENCE`], and a second for each 256 MB that it copies from its ring and signs
/// before it sends them.
fn patience(bytes: u64) -> Duration {
    PATIENCE + Duration::from_micros(bytes / 256)
}

/// A stream of which each [`PIECE`] of a message must be through within [`PATIENCE`], however slowly the peer dribbles; a wait ends with `stop`.
struct Paced<'a> {
    stream: &'a TcpStream,
    stop: &'a AtomicBool,
    /// Until when the piece must be through; none before its first byte was tried.
    until: Option<Instant>,
    /// Bytes of the piece that are through.
    through: usize,
}

impl<'a> Paced<'a> {
    fn new(stream: &'a TcpStream, stop: &'a AtomicBool) -> Self {
        Self { stream, stop, until: None, through: 0 }
    }

    /// Begins a message, of which the first bytes may take so long.
    fn begin(&mut self, first: Duration) -> &mut Self {
        (self.until, self.through) = (Some(Instant::now() + first), 0);
        self
    }

    /// One attempt to pass bytes on, at most a [`TICK`] long; the callers try again after an interruption.
    fn attempt(&mut self, pass: impl FnOnce(&TcpStream) -> std::io::Result<usize>) -> std::io::Result<usize> {
        if self.stop.load(Ordering::Relaxed) {
            return Err(std::io::Error::new(ErrorKind::ConnectionAborted, "told to stop"));
        }
        let until = *self.until.get_or_insert_with(|| Instant::now() + PATIENCE);
        match pass(self.stream) {
            Err(e) if e.kind() == ErrorKind::WouldBlock => {
                let late = Instant::now() >= until;
                Err(if late { ErrorKind::TimedOut } else { ErrorKind::Interrupted }.into())
            }
            Ok(bytes) => {
                self.through += bytes;
                if self.through >= PIECE {
                    self.begin(PATIENCE);
                } else if Instant::now() >= until {
                    return Err(ErrorKind::TimedOut.into());
                }
                Ok(bytes)
            }
            Err(e) => Err(e),
        }
    }
}

impl Read for Paced<'_> {
    fn read(&mut self, to: &mut [u8]) -> std::io::Result<usize> {
        self.attempt(|mut stream| stream.read(to))
    }
}

impl Write for Paced<'_> {
    fn write(&mut self, from: &[u8]) -> std::io::Result<usize> {
        self.attempt(|mut stream| stream.write(from))
    }

    fn flush(&mut self) -> std::io::Result<()> {
        Ok(())
    }
}

/// A stream between whose pieces producers are told that somebody follows, however long a step takes on its way.
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

/// Both sides' greetings take [`PATIENCE`] in all; afterwards each piece of a message may.
fn greet(
    stream: &TcpStream,
    stop: &AtomicBool,
    greeting: impl FnOnce(&mut Paced) -> Result<Session, WireError>,
) -> Result<Session, WireError> {
    let broken = |e| WireError::io(Path::new("connection"), "broke", e);
    let timeouts = || stream.set_read_timeout(Some(TICK)).and_then(|()| stream.set_write_timeout(Some(TICK)));
    stream.set_nonblocking(false).and_then(|()| stream.set_nodelay(true)).and_then(|()| timeouts()).map_err(broken)?;
    greeting(&mut Paced::new(stream, stop))
}

/// Connections that have not proved the key yet.
#[derive(Default)]
struct Strangers(Mutex<VecDeque<(SocketAddr, TcpStream)>>);

impl Strangers {
    /// One more; where there are too many, the oldest is cut off.
    fn come(&self, peer: SocketAddr, stream: &TcpStream) -> std::io::Result<()> {
        let mut there = self.0.lock().unwrap_or_else(|broken| broken.into_inner());
        there.push_back((peer, stream.try_clone()?));
        if there.len() > STRANGERS
            && let Some((_, oldest)) = there.pop_front()
        {
            // It may have gone by itself.
            let _ = oldest.shutdown(Shutdown::Both);
        }
        Ok(())
    }

    fn go(&self, peer: SocketAddr) {
        self.0.lock().unwrap_or_else(|broken| broken.into_inner()).retain(|(one, _)| *one != peer);
    }
}

/// How often news of one kind is said, at most: whoever reaches the port can make some.
const APART: Duration = Duration::from_secs(1);

/// News of one kind: said once in [`APART`], the rest counted and said together.
struct News {
    /// What befell those that were counted.
    rest: &'static str,
    /// When it was last said, and how often it happened since.
    said: Mutex<(Option<Instant>, u64)>,
}

impl News {
    fn new(rest: &'static str) -> Self {
        Self { rest, said: Mutex::default() }
    }

    fn said(&self) -> MutexGuard<'_, (Option<Instant>, u64)> {
        self.said.lock().unwrap_or_else(|broken| broken.into_inner())
    }

    /// What is to be said of one more now: that.
    fn come(&self, words: impl FnOnce() -> String) -> Option<String> {
        let mut said = self.said();
        if said.0.is_some_and(|last| last.elapsed() < APART) {
            said.1 += 1;
            return None;
        }
        said.0 = Some(Instant::now());
        Some(words())
    }

    /// What is to be said now of those that were counted.
    fn due(&self) -> Option<String> {
        let mut said = self.said();
        if said.1 == 0 || said.0.is_some_and(|last| last.elapsed() < APART) {
            return None;
        }
        let more = std::mem::replace(&mut *said, (Some(Instant::now()), 0)).1;
        Some(format!("{more} more {}", self.rest))
    }
}

/// One of the [`FOLLOWERS`] places, which its follower leaves however its thread ends.
struct Seat<'a> {
    followers: &'a AtomicUsize,
    /// How many had one before.
    before: usize,
}

impl<'a> Seat<'a> {
    fn take(followers: &'a AtomicUsize) -> Self {
        Self { followers, before: followers.fetch_add(1, Ordering::Relaxed) }
    }
}

impl Drop for Seat<'_> {
    fn drop(&mut self) {
        self.followers.fetch_sub(1, Ordering::Relaxed);
    }
}

/// What the connections of a relay share.
struct Relay {
    ring: PathBuf,
    key: Key,
    counts: Arc<RelayCounts>,
    strangers: Strangers,
    stop: Arc<AtomicBool>,
    tell: Arc<dyn Fn(String) + Send + Sync>,
    sent_away: News,
    lost: News,
    left: News,
    refused: News,
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
    let relay = Arc::new(Relay {
        ring: ring.to_owned(),
        key: key.clone(),
        counts: counts.clone(),
        strangers: Strangers::default(),
        stop: stop.clone(),
        tell,
        sent_away: News::new("were sent away"),
        lost: News::new("connections were lost"),
        left: News::new("follower connections ended"),
        refused: News::new("rings were refused"),
    });
    let mut threads: Vec<std::thread::JoinHandle<()>> = Vec::new();
    while !stop.load(Ordering::Relaxed) {
        threads.retain(|thread| !thread.is_finished());
        relay.say_rest();
        let (stream, peer) = match listener.accept() {
            // Whoever was cut off is about to end its thread.
            Ok((_, peer)) if threads.len() > FOLLOWERS + 2 * STRANGERS => {
                relay.refuse(peer, "too many come at once".to_owned());
                continue;
            }
            Ok(came) => came,
            Err(e) if e.kind() == ErrorKind::WouldBlock => {
                std::thread::sleep(Duration::from_millis(20));
                continue;
            }
            // A peer that went before it was taken, or no descriptor left: later ones may fare better.
            Err(e) => {
                relay.say(&relay.lost, || format!("a connection was lost: {e}"));
                std::thread::sleep(Duration::from_millis(100));
                continue;
            }
        };
        let relay = relay.clone();
        let work = move || relay.connection(&stream, peer);
        let started = std::thread::Builder::new().name("ridgewatch-relay".into()).spawn(work);
        threads.extend(started.map_err(broken));
    }
    for thread in threads {
        let _ = thread.join();
    }
    Ok(())
}

impl Relay {
    fn refuse(&self, peer: SocketAddr, why: String) {
        self.counts.refused.fetch_add(1, Ordering::Relaxed);
        self.say(&self.sent_away, || format!("{peer} was sent away: {why}"));
    }

    fn say(&self, news: &News, words: impl FnOnce() -> String) {
        if let Some(words) = news.come(words) {
            (self.tell)(words);
        }
    }

    /// Says together what came too fast to be said one by one.
    fn say_rest(&self) {
        [&self.sent_away, &self.lost, &self.left, &self.refused].into_iter().filter_map(News::due).for_each(|words| (self.tell)(words));
    }

    /// One that came, until it goes.
    fn connection(&self, stream: &TcpStream, peer: SocketAddr) {
        let broken = |e| WireError::io(Path::new("connection"), "broke", e);
        let mut seat = None;
        let admit = || match seat.insert(Seat::take(&self.counts.followers)).before {
            FOLLOWERS.. => Err(WireError::field("followers", format_args!("{FOLLOWERS} already"), format!("at most {FOLLOWERS}"))),
            _ => Ok(()),
        };
        let greeted = self.strangers.come(peer, stream).map_err(broken);
        let greeted = greeted.and_then(|()| greet(stream, &self.stop, |paced| Session::accept_if(paced, &self.key, admit)));
        self.strangers.go(peer);
        let session = match greeted {
            Ok(session) => session,
            Err(error) => return self.refuse(peer, error.to_string()),
        };
        self.counts.accepted.fetch_add(1, Ordering::Relaxed);
        if let Err(error) = self.send_steps(stream, session)
            && !self.stop.load(Ordering::Relaxed)
        {
            self.say(&self.left, || format!("follower {peer}: {error}"));
        }
    }

    /// Answers each time that the follower asks with the next thing that happens.
    fn send_steps(&self, stream: &TcpStream, mut session: Session) -> Result<(), WireError> {
        let mut rings = RingFollower::begin(&self.ring, Limits::default())?;
        let (mut values, mut asked) = (Vec::new(), false);
        let (mut sent, mut heard) = (Instant::now(), Instant::now());
        let quiet = Facts { kind: Kind::Pulse, block: 0, generation: 0, step: 0, time: 0.0, published: 0, missed: 0 };
        while !self.stop.load(Ordering::Relaxed) {
            let begin = Instant::now();
            let event = if asked { rings.poll(&mut values) } else { None };
            // The follower is silent while it waits for what takes long to read.
            heard += begin.elapsed();
            if event.is_none() {
                if !asked {
                    rings.hold();
                }
                if let Some(ask) = hear(&mut Paced::new(stream, &self.stop), &mut session, if asked { IDLE } else { HOLD })? {
                    asked |= ask == Ask::Next;
                    heard = Instant::now();
                }
                if heard.elapsed() > PATIENCE {
                    return Err(WireError::io(Path::new("connection"), "nothing was heard of it", ErrorKind::TimedOut.into()));
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
                    self.say(&self.refused, || format!("refused: {error}"));
                    continue;
                }
                None if sent.elapsed() > PULSE => (quiet, None),
                None => continue,
            };
            let step: &[f32] = if facts.kind == Kind::Step { &values } else { &[] };
            session.send(
                &mut Beating { stream: Paced::new(stream, &self.stop), rings: &mut rings },
                &facts,
                description.as_deref(),
                step,
            )?;
            // A pulse is no answer. And what takes long to send is taken.
            asked = facts.kind == Kind::Pulse;
            (sent, heard) = (Instant::now(), if asked { heard } else { Instant::now() });
        }
        Ok(())
    }
}

/// What the follower asks, if it does so within the limit.
fn hear(stream: &mut Paced, session: &mut Session, limit: Duration) -> Result<Option<Ask>, WireError> {
    let broken = |e| WireError::io(Path::new("connection"), "broke", e);
    if !system::readable(stream.stream, limit).map_err(broken)? {
        return Ok(None);
    }
    let mut bytes = [0; ASK_BYTES];
    stream.read_exact(&mut bytes).map_err(broken)?;
    session.check_ask(&bytes).map(Some)
}

/// Where a relay is; usually what its connection file says now.
pub type Whereabouts = Box<dyn Fn() -> Result<ConnectionFile, WireError> + Send>;

/// Follows a relay; connects anew whenever the connection breaks.
pub struct RelayFollower {
    events: Receiver<(Event, Vec<f32>)>,
    /// Buffers on their way back.
    spare: SyncSender<Vec<f32>>,
    stop: Arc<AtomicBool>,
    /// Generations of the blocks that were opened and have not ended.
    open: BTreeMap<u32, u64>,
    /// The thread is gone, and that was told.
    broken: bool,
}

impl RelayFollower {
    /// Starts the thread that receives. `place` is asked before each attempt to connect: a relay that was started anew has another address
    /// and key. When none could be reached for as long as `gone`, its blocks count as ended.
    ///
    /// # Errors
    /// The thread could not be started.
    pub fn begin(place: Whereabouts, limits: Limits, gone: Duration) -> Result<Self, WireError> {
        // One step waits, one is being received, and the rest waits at the relay: newest wins there.
        let ((sender, events), (spare, back)) = (sync_channel(1), sync_channel(2));
        let stop = Arc::new(AtomicBool::new(false));
        let blocks = BTreeMap::new();
        let told = String::new();
        let mut receiving = Receiving { place, limits, gone, to: sender, spare: back, stop: stop.clone(), blocks, told };
        // Whoever listened has left, or there is nothing to say.
        let work = move || drop(receiving.run());
        let started = std::thread::Builder::new().name("ridgewatch-relay".into()).spawn(work);
        started.map_err(|e| WireError::io(Path::new("thread"), "could not be started", e))?;
        Ok(Self { events, spare, stop, open: BTreeMap::new(), broken: false })
    }

    /// Blocks that were opened and have not ended, and their generations.
    pub fn blocks(&self) -> impl Iterator<Item = (u32, u64)> {
        self.open.iter().map(|(block, generation)| (*block, *generation))
    }

    /// The next thing that happened, or none within the limit. A step's values are in `values`. Should the thread that receives have panicked, that is
    /// told once, and all of its blocks end.
    pub fn poll(&mut self, values: &mut Vec<f32>, limit: Duration) -> Option<Event> {
        match self.events.recv_timeout(limit) {
            Ok((event, mut came)) => {
                std::mem::swap(values, &mut came);
                let _ = self.spare.try_send(came);
                match &event {
                    Event::Opened { description, generation } => {
                        self.open.insert(description.block.index, *generation);
                    }
                    Event::Ended { block, .. } => {
                        self.open.remove(block);
                    }
                    Event::Step { .. } | Event::Refused(_) => {}
                }
                Some(event)
            }
            Err(RecvTimeoutError::Timeout) => None,
            Err(RecvTimeoutError::Disconnected) if !std::mem::replace(&mut self.broken, true) => {
                let gone = ErrorKind::BrokenPipe.into();
                Some(Event::Refused(WireError::io(Path::new("thread that receives from a relay"), "has panicked", gone)))
            }
            Err(RecvTimeoutError::Disconnected) => match self.open.pop_first() {
                Some((block, generation)) => Some(Event::Ended { block, generation, closed: false }),
                None => {
                    std::thread::sleep(limit);
                    None
                }
            },
        }
    }
}

impl Drop for RelayFollower {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
    }
}

/// A block as a relay announced it.
struct Known {
    description: Description,
    generation: u64,
    /// In the session that is.
    announced: bool,
}

/// The thread that receives.
struct Receiving {
    place: Whereabouts,
    limits: Limits,
    gone: Duration,
    to: SyncSender<(Event, Vec<f32>)>,
    spare: Receiver<Vec<f32>>,
    stop: Arc<AtomicBool>,
    /// Blocks that have not ended.
    blocks: BTreeMap<u32, Known>,
    /// Why the last attempt to connect failed; empty: it did not.
    told: String,
}

/// Nobody listens any more.
struct Left;

impl Receiving {
    /// Connects, receives, and does so again until nobody listens.
    fn run(&mut self) -> Result<(), Left> {
        let mut reached = Instant::now();
        while !self.stop.load(Ordering::Relaxed) {
            let found = (self.place)();
            let connected = found.and_then(|found| connect(&found, &self.stop));
            let error = match connected {
                Ok((stream, session)) => {
                    self.told.clear();
                    let Err(error) = self.session(&stream, session)? else { return Ok(()) };
                    reached = Instant::now();
                    error
                }
                Err(error) => error,
            };
            // Once for each reason: a relay that is not there yet is no news every half second.
            let words = error.to_string();
            if words != self.told {
                self.told = words;
                self.pass_on(Event::Refused(error), Vec::new())?;
            }
            if reached.elapsed() > self.gone {
                self.blocks.values_mut().for_each(|known| known.announced = false);
                self.end_unannounced()?;
            }
            std::thread::sleep(AGAIN);
        }
        Ok(())
    }

    fn pass_on(&self, event: Event, values: Vec<f32>) -> Result<(), Left> {
        self.to.send((event, values)).map_err(|_| Left)
    }

    /// Ends blocks that a relay no longer has.
    fn end_unannounced(&mut self) -> Result<(), Left> {
        while let Some((block, generation)) =
            self.blocks.iter().find_map(|(block, known)| (!known.announced).then_some((*block, known.generation)))
        {
            self.blocks.remove(&block);
            self.pass_on(Event::Ended { block, generation, closed: false }, Vec::new())?;
        }
        Ok(())
    }

    /// Receives until the session breaks.
    fn session(&mut self, stream: &TcpStream, mut session: Session) -> Result<Result<(), WireError>, Left> {
        let stop = self.stop.clone();
        let (mut from, mut to) = (BufReader::with_capacity(1 << 16, Paced::new(stream, &stop)), Paced::new(stream, &stop));
        self.blocks.values_mut().for_each(|known| known.announced = false);
        let mut ask = Ask::Next;
        while !self.stop.load(Ordering::Relaxed) {
            if let Err(error) = session.ask(to.begin(PATIENCE), ask) {
                return Ok(Err(error));
            }
            let largest = self.blocks.values().map(|known| known.description.block_bytes()).max();
            from.get_mut().begin(patience(largest.unwrap_or_default()));
            let mut values = self.spare.try_recv().unwrap_or_default();
            let mut announced = None;
            let mut note = |block: u32, description: Option<Description>| {
                announced = description;
                announced.as_ref().or(self.blocks.get(&block).map(|known| &known.description)).map(Description::block_bytes)
            };
            let facts = match session.receive(&mut from, &self.limits, &mut note, &mut values) {
                Ok(facts) => facts,
                Err(error) => return Ok(Err(error)),
            };
            // A pulse is no answer: what was asked stands.
            ask = if facts.kind == Kind::Pulse { Ask::Hold } else { Ask::Next };
            let Facts { block, generation, step, time, published, missed, .. } = facts;
            // All that is there is announced before the first step.
            if facts.kind != Kind::Opened {
                self.end_unannounced()?;
            }
            let event = match (facts.kind, announced) {
                (Kind::Opened, Some(description)) => {
                    let known = Known { description: description.clone(), generation, announced: true };
                    let before = self.blocks.insert(block, known);
                    // After a mere break of the connection nothing was opened.
                    if before.is_some_and(|before| before.generation == generation && before.description == description) {
                        continue;
                    }
                    Event::Opened { description: Box::new(description), generation }
                }
                (Kind::Opened, None) => {
                    let error = WireError::field("description", "missing", "one with each block that was opened");
                    return Ok(Err(error));
                }
                (Kind::Step, _) => Event::Step { block, generation, step, time, published, missed },
                (kind @ (Kind::Ended | Kind::Lost), _) => {
                    self.blocks.remove(&block);
                    Event::Ended { block, generation, closed: kind == Kind::Ended }
                }
                (Kind::Pulse, _) => continue,
            };
            if let Err(error) = self.hand_over(event, values, &mut to, &mut session)? {
                return Ok(Err(error));
            }
        }
        Ok(Ok(()))
    }

    /// Waits until the event is taken, and says so to the relay, which would take the silence for an end.
    fn hand_over(&self, event: Event, values: Vec<f32>, to: &mut Paced, session: &mut Session) -> Result<Result<(), WireError>, Left> {
        let (mut said, mut item) = (Instant::now(), (event, values));
        loop {
            item = match self.to.try_send(item) {
                Ok(()) => return Ok(Ok(())),
                Err(TrySendError::Full(item)) => item,
                Err(TrySendError::Disconnected(_)) => return Err(Left),
            };
            if self.stop.load(Ordering::Relaxed) {
                return Err(Left);
            }
            if said.elapsed() > PULSE {
                if let Err(error) = session.ask(to.begin(PATIENCE), Ask::Hold) {
                    return Ok(Err(error));
                }
                said = Instant::now();
            }
            std::thread::sleep(IDLE);
        }
    }
}

/// A session with the relay at a place.
fn connect(place: &ConnectionFile, stop: &AtomicBool) -> Result<(TcpStream, Session), WireError> {
    let address = place.address.as_str();
    let broken = |e| WireError::io(Path::new(address), "cannot be reached", e);
    let found: Vec<SocketAddr> = address.to_socket_addrs().map_err(broken)?.collect();
    let stream = reach(&found).map_err(broken)?;
    let session = greet(&stream, stop, |paced| Session::connect(paced, &place.key))?;
    Ok((stream, session))
}

/// The first address of a name that answers. [`PATIENCE`] is for all of them, in equal parts.
fn reach(addresses: &[SocketAddr]) -> std::io::Result<TcpStream> {
    let mut failed = ErrorKind::AddrNotAvailable.into();
    for address in addresses {
        match TcpStream::connect_timeout(address, PATIENCE / addresses.len() as u32) {
            Ok(stream) => return Ok(stream),
            Err(error) => failed = error,
        }
    }
    Err(failed)
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::os::fd::AsRawFd;

    /// Closes a connection by a reset.
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
    fn all_addresses_of_a_name_are_tried() {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let open = listener.local_addr().unwrap();
        // Nobody listens there any more.
        let closed = TcpListener::bind("127.0.0.2:0").unwrap().local_addr().unwrap();
        assert_eq!(reach(&[closed, open]).unwrap().peer_addr().unwrap(), open);
        assert_eq!(reach(&[closed, closed]).unwrap_err().kind(), ErrorKind::ConnectionRefused);
        assert_eq!(reach(&[]).unwrap_err().kind(), ErrorKind::AddrNotAvailable);
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
        // The first follower's mark.
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
    fn news_of_one_kind_are_said_once_a_second_and_none_is_lost() {
        let news = News::new("were sent away");
        let come = |n: usize| news.come(|| format!("{n} was sent away"));
        assert_eq!((come(0).as_deref(), news.due()), (Some("0 was sent away"), None));
        assert!((1..=1000).all(|n| come(n).is_none()) && news.due().is_none());
        news.said().0 = Some(Instant::now() - APART);
        assert_eq!(news.due().as_deref(), Some("1000 more were sent away"));
        assert_eq!((news.due(), come(1001)), (None, None));
    }

    #[test]
    fn a_follower_whose_thread_panics_leaves_its_place() {
        let followers = AtomicUsize::new(3);
        let panicked = std::panic::catch_unwind(|| {
            let seat = Seat::take(&followers);
            assert_eq!((seat.before, followers.load(Ordering::Relaxed)), (3, 4));
            panic!("as a follower's thread may");
        });
        assert!(panicked.is_err());
        assert_eq!(followers.load(Ordering::Relaxed), 3);
    }

    #[test]
    fn a_stranger_that_resets_its_connection_costs_nobody_else_a_place() {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let address = listener.local_addr().unwrap();
        let strangers = Strangers::default();
        let mut there = Vec::new();
        for n in 0..STRANGERS + 2 {
            let client = TcpStream::connect(address).unwrap();
            let (stream, peer) = listener.accept().unwrap();
            if n == 0 {
                reset(client);
                // It has arrived, and nobody has taken the oldest from the list yet.
                assert!((&stream).read(&mut [0]).is_err());
                assert!(stream.shutdown(Shutdown::Both).is_err(), "a reset connection cannot be shut down");
            } else {
                there.push(client);
            }
            strangers.come(peer, &stream).unwrap();
        }
        assert_eq!(strangers.0.lock().unwrap().len(), STRANGERS);
    }
}
