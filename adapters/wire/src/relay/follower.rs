//! The other end: what a relay sends.

use super::lookup::{self, Lookup};
use super::pace::{PATIENCE, Paced, greet};
use super::{IDLE, PULSE};
use crate::follow::Event;
use crate::message::{Ask, ConnectionFile, Facts, Kind, Session};
use crate::{Description, Limits, WireError};
use std::collections::BTreeMap;
use std::io::{BufReader, ErrorKind};
use std::net::{SocketAddr, TcpStream};
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender, TrySendError, sync_channel};
use std::time::{Duration, Instant};

/// Pause before a follower tries again to connect.
const AGAIN: Duration = Duration::from_millis(500);

/// Steps of a block that a [`RelayFollower`] holds, at most: one that is received, one that waits, and two on their way back.
pub const BUFFERS: u64 = 4;

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
        let (mut reached, mut lookup) = (Instant::now(), Lookup::new(lookup::system));
        while !self.stop.load(Ordering::Relaxed) {
            let found = (self.place)();
            let connected = found.and_then(|found| connect(&found, &mut |name| lookup.find(name, PATIENCE), &self.stop));
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
            if let Err(error) = session.ask(to.begin(), ask) {
                return Ok(Err(error));
            }
            from.get_mut().begin();
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
                if let Err(error) = session.ask(to.begin(), Ask::Hold) {
                    return Ok(Err(error));
                }
                said = Instant::now();
            }
            std::thread::sleep(IDLE);
        }
    }
}

/// A session with the relay at a place, whose name `find` looks up.
fn connect(
    place: &ConnectionFile,
    find: &mut dyn FnMut(&str) -> std::io::Result<Vec<SocketAddr>>,
    stop: &AtomicBool,
) -> Result<(TcpStream, Session), WireError> {
    let address = place.address.as_str();
    let broken = |e| WireError::io(Path::new(address), "cannot be reached", e);
    let stream = find(address).and_then(|found| reach(&found)).map_err(broken)?;
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
    use std::net::TcpListener;

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
}
