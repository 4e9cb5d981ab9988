//! Follower side of a relay.

use super::lookup::{self, Lookup};
use super::paced::{IDLE, PEER_TIMEOUT, PULSE, Paced, greet};
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

/// Pause between two attempts to connect.
const RECONNECT_PAUSE: Duration = Duration::from_millis(500);

/// Most steps of a block that a [`RelayFollower`] holds: one is received, one waits, and the buffers of two are returned.
pub const BUFFERS: u64 = 4;

/// Returns the address and the key of a relay; usually reads its connection file.
pub type Locate = Box<dyn Fn() -> Result<ConnectionFile, WireError> + Send>;

/// Follows a relay, and reconnects whenever the connection breaks.
pub struct RelayFollower {
    events: Receiver<(Event, Vec<f32>)>,
    /// Returns buffers to the thread.
    spare: SyncSender<Vec<f32>>,
    stop: Arc<AtomicBool>,
    /// Generations of the open blocks.
    open: BTreeMap<u32, u64>,
    /// True once a panic of the thread was reported.
    broken: bool,
}

impl RelayFollower {
    /// Starts the thread that receives. `locate` is called before each attempt to connect, because a restarted relay has another address and key. If no relay
    /// can be reached for `gone`, its blocks end.
    ///
    /// # Errors
    /// The thread could not be started.
    pub fn begin(locate: Locate, limits: Limits, gone: Duration) -> Result<Self, WireError> {
        // One step waits, one is received, and the others stay at the relay.
        let ((sender, events), (spare, back)) = (sync_channel(1), sync_channel(2));
        let stop = Arc::new(AtomicBool::new(false));
        let blocks = BTreeMap::new();
        let reported = String::new();
        let mut receiving = Receiving { locate, limits, gone, to: sender, spare: back, stop: stop.clone(), blocks, reported };
        let work = move || drop(receiving.run());
        let started = std::thread::Builder::new().name("ridgewatch-relay".into()).spawn(work);
        started.map_err(|e| WireError::io(Path::new("thread"), "could not be started", e))?;
        Ok(Self { events, spare, stop, open: BTreeMap::new(), broken: false })
    }

    /// Open blocks and their generations.
    pub fn blocks(&self) -> impl Iterator<Item = (u32, u64)> {
        self.open.iter().map(|(block, generation)| (*block, *generation))
    }

    /// Returns the next event, or `None` if there is none within the limit. A step's values are in `values`. A panic of the receiving thread is reported once,
    /// and then its blocks end.
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

/// A block that a relay announced.
struct Known {
    description: Description,
    generation: u64,
    /// True if it was announced in the current session.
    announced: bool,
}

/// The thread that receives.
struct Receiving {
    locate: Locate,
    limits: Limits,
    gone: Duration,
    to: SyncSender<(Event, Vec<f32>)>,
    spare: Receiver<Vec<f32>>,
    stop: Arc<AtomicBool>,
    /// Blocks that have not ended.
    blocks: BTreeMap<u32, Known>,
    /// Text of the last failure to connect; empty if there was none.
    reported: String,
}

/// The [`RelayFollower`] was dropped.
struct Dropped;

/// End of a session.
enum End {
    Dropped,
    Broken(WireError),
}

impl From<Dropped> for End {
    fn from(_: Dropped) -> Self {
        Self::Dropped
    }
}

impl From<WireError> for End {
    fn from(error: WireError) -> Self {
        Self::Broken(error)
    }
}

impl Receiving {
    /// Connects, receives, and reconnects until the follower is dropped.
    fn run(&mut self) -> Result<(), Dropped> {
        let (mut reached, mut lookup) = (Instant::now(), Lookup::new(lookup::system));
        while !self.stop.load(Ordering::Relaxed) {
            let found = (self.locate)();
            let connected = found.and_then(|found| connect(&found, &mut |name| lookup.find(name, PEER_TIMEOUT), &self.stop));
            let error = match connected {
                Ok((stream, session)) => {
                    self.reported.clear();
                    match self.session(&stream, session) {
                        Err(End::Broken(error)) => {
                            reached = Instant::now();
                            error
                        }
                        Ok(()) | Err(End::Dropped) => return Ok(()),
                    }
                }
                Err(error) => error,
            };
            // Each reason is reported once, not at every attempt.
            let text = error.to_string();
            if text != self.reported {
                self.reported = text;
                self.pass_on(Event::Refused(error), Vec::new())?;
            }
            if reached.elapsed() > self.gone {
                self.blocks.values_mut().for_each(|known| known.announced = false);
                self.end_unannounced()?;
            }
            std::thread::sleep(RECONNECT_PAUSE);
        }
        Ok(())
    }

    fn pass_on(&self, event: Event, values: Vec<f32>) -> Result<(), Dropped> {
        self.to.send((event, values)).map_err(|_| Dropped)
    }

    /// Ends blocks that the relay does not have any more.
    fn end_unannounced(&mut self) -> Result<(), Dropped> {
        let is_gone = |(block, known): (&u32, &Known)| (!known.announced).then_some((*block, known.generation));
        while let Some((block, generation)) = self.blocks.iter().find_map(is_gone) {
            self.blocks.remove(&block);
            self.pass_on(Event::Ended { block, generation, closed: false }, Vec::new())?;
        }
        Ok(())
    }

    /// Receives until the session breaks or the follower is dropped.
    fn session(&mut self, stream: &TcpStream, mut session: Session) -> Result<(), End> {
        let stop = self.stop.clone();
        let (mut from, mut to) = (BufReader::with_capacity(1 << 16, Paced::new(stream, &stop)), Paced::new(stream, &stop));
        self.blocks.values_mut().for_each(|known| known.announced = false);
        let mut ask = Ask::Next;
        while !self.stop.load(Ordering::Relaxed) {
            session.ask(to.begin(), ask)?;
            from.get_mut().begin();
            let mut values = self.spare.try_recv().unwrap_or_default();
            let mut announced = None;
            let mut note = |block: u32, description: Option<Description>| {
                announced = description;
                announced.as_ref().or(self.blocks.get(&block).map(|known| &known.description)).map(Description::block_bytes)
            };
            let facts = session.receive(&mut from, &self.limits, &mut note, &mut values)?;
            // A pulse is no answer: the request stays open.
            ask = if facts.kind == Kind::Pulse { Ask::Hold } else { Ask::Next };
            let Facts { block, generation, step, time, published, missed, .. } = facts;
            // The relay announces all its blocks before their first step.
            if facts.kind != Kind::Opened {
                self.end_unannounced()?;
            }
            let event = match facts.kind {
                Kind::Opened => {
                    let accepted = "one with each block that was opened";
                    let description = announced.ok_or_else(|| WireError::field("description", "missing", accepted))?;
                    let known = Known { description: description.clone(), generation, announced: true };
                    let before = self.blocks.insert(block, known);
                    // After a reconnection the block is the same.
                    if before.is_some_and(|before| before.generation == generation && before.description == description) {
                        continue;
                    }
                    Event::Opened { description: Box::new(description), generation }
                }
                Kind::Step => Event::Step { block, generation, step, time, published, missed },
                Kind::Ended | Kind::Lost => {
                    self.blocks.remove(&block);
                    Event::Ended { block, generation, closed: facts.kind == Kind::Ended }
                }
                Kind::Pulse => continue,
            };
            self.hand_over(event, values, &mut to, &mut session)?;
        }
        Ok(())
    }

    /// Waits until the event is taken. Heartbeats meanwhile keep the relay from closing the connection.
    fn hand_over(&self, event: Event, values: Vec<f32>, to: &mut Paced, session: &mut Session) -> Result<(), End> {
        let (mut said, mut item) = (Instant::now(), (event, values));
        loop {
            item = match self.to.try_send(item) {
                Ok(()) => return Ok(()),
                Err(TrySendError::Full(item)) => item,
                Err(TrySendError::Disconnected(_)) => return Err(End::Dropped),
            };
            if self.stop.load(Ordering::Relaxed) {
                return Err(End::Dropped);
            }
            if said.elapsed() > PULSE {
                session.ask(to.begin(), Ask::Hold)?;
                said = Instant::now();
            }
            std::thread::sleep(IDLE);
        }
    }
}

/// Opens a session with a relay, whose name `find` resolves.
fn connect(
    relay: &ConnectionFile,
    find: &mut dyn FnMut(&str) -> std::io::Result<Vec<SocketAddr>>,
    stop: &AtomicBool,
) -> Result<(TcpStream, Session), WireError> {
    let address = relay.address.as_str();
    let broken = |e| WireError::io(Path::new(address), "cannot be reached", e);
    let stream = find(address).and_then(|found| reach(&found)).map_err(broken)?;
    let session = greet(&stream, stop, |paced| Session::connect(paced, &relay.key))?;
    Ok((stream, session))
}

/// Connects to the first address that answers. The addresses share [`PEER_TIMEOUT`] equally.
fn reach(addresses: &[SocketAddr]) -> std::io::Result<TcpStream> {
    let mut failed = ErrorKind::AddrNotAvailable.into();
    for address in addresses {
        match TcpStream::connect_timeout(address, PEER_TIMEOUT / addresses.len() as u32) {
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
        // The port is closed again.
        let closed = TcpListener::bind("127.0.0.2:0").unwrap().local_addr().unwrap();
        assert_eq!(reach(&[closed, open]).unwrap().peer_addr().unwrap(), open);
        assert_eq!(reach(&[closed, closed]).unwrap_err().kind(), ErrorKind::ConnectionRefused);
        assert_eq!(reach(&[]).unwrap_err().kind(), ErrorKind::AddrNotAvailable);
    }
}
