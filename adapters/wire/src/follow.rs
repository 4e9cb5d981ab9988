//! Follows the rings of all blocks in a folder, across restarts and kills of their producers.

use crate::choice::{self, Unread};
use crate::lock::{Following, blocks, producer_lives};
use crate::place::Place;
use crate::reader::{Read, RingReader, SlotRead, StepInfo};
use crate::{Description, Limits, WireError};
use std::collections::{BTreeMap, BTreeSet};
use std::io::ErrorKind;
use std::ops::Bound;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

/// Most steps that one poll starts to read, if a producer overtakes each of them.
const ATTEMPTS: usize = 4;
/// Interval between two searches for new rings, and between two checks of a producer.
const SCAN_INTERVAL: Duration = Duration::from_millis(100);
/// Interval between two heartbeats to a producer, while [`RingFollower::poll`] or [`RingFollower::beat`] is called and while a step is read.
const HEARTBEAT_INTERVAL: Duration = Duration::from_secs(1);

/// Event of a block.
#[derive(Debug)]
pub enum Event {
    /// A producer was found, or replaced one that ended. Its description is checked.
    Opened {
        /// The published field.
        description: Box<Description>,
        /// Time of the opening, nanoseconds since 1970.
        generation: u64,
    },
    /// A step; its values are in the buffer.
    Step {
        /// Index of the block.
        block: u32,
        /// Time of the opening, nanoseconds since 1970.
        generation: u64,
        /// The solver's number.
        step: u64,
        /// The solver's time.
        time: f64,
        /// Time of publication, nanoseconds since 1970.
        published: u64,
        /// Earlier steps of the block that were overwritten unread, or skipped because another block had lost them.
        missed: u64,
    },
    /// The producer closed the block or its process ended, and all remaining steps were read.
    Ended {
        /// Index of the block.
        block: u32,
        /// Time of the opening, nanoseconds since 1970.
        generation: u64,
        /// True if the block was closed; false if its process ended without that, or the relay is gone.
        closed: bool,
    },
    /// A ring was refused; the others are still followed.
    Refused(WireError),
}

/// Start and number of blocks, which all rings of one start of a simulation share.
type Simulation = (u64, u32);

/// Writes this follower's mark to a ring.
struct Heartbeat {
    mark: u32,
    sent: Instant,
}

impl Heartbeat {
    /// Tells the producer which steps were taken. A ring that cannot be written to has no producer that waits.
    fn send(&mut self, reader: &RingReader) {
        self.sent = Instant::now();
        let _ = reader.acknowledge(self.mark);
    }

    fn send_if_due(&mut self, reader: &RingReader) {
        if self.sent.elapsed() > HEARTBEAT_INTERVAL {
            self.send(reader);
        }
    }
}

/// One block's ring.
struct Followed {
    reader: RingReader,
    heartbeat: Heartbeat,
    /// Available steps, if the simulation has several blocks.
    unread: Unread,
    /// True after an error: nothing more is read until a new producer replaces the ring.
    refused: bool,
    /// True if the last look found no unread step.
    drained: bool,
    /// True if the producer had closed the ring before that look.
    closed: bool,
    /// True if the producer's process has ended or the ring was replaced.
    gone: bool,
    /// True if another ring has this one's path.
    replaced: bool,
    /// True once the end was reported.
    ended: bool,
    /// Time of the last check of the producer.
    checked: Instant,
}

impl Followed {
    fn begin(reader: RingReader, mark: u32) -> Self {
        let (unread, now) = (Unread::default(), Instant::now());
        let (refused, drained, closed, gone, replaced, ended) = (false, false, false, false, false, false);
        let mut heartbeat = Heartbeat { mark, sent: now };
        heartbeat.send(&reader);
        Self { reader, heartbeat, unread, refused, drained, closed, gone, replaced, ended, checked: now }
    }

    fn simulation(&self) -> Simulation {
        let description = &self.reader.header().description;
        (description.start, description.block.count)
    }

    fn is_read(&self) -> bool {
        !self.refused && !self.ended
    }

    /// Checks whether the producer is still there. If it is gone, its remaining steps are looked for once more.
    fn check_producer(&mut self, ring: &Path, block: u32) {
        if self.gone || self.ended || !(self.drained || self.refused) || self.checked.elapsed() <= SCAN_INTERVAL {
            return;
        }
        self.checked = Instant::now();
        // The lock may already belong to a new producer, and an error of the check leaves the ring as it is.
        self.gone = !self.reader.is_current() || producer_lives(ring, block).is_ok_and(|lives| !lives);
        self.drained &= !self.gone;
    }

    /// Reports the end once, after all remaining steps were read.
    fn end(&mut self, block: u32) -> Option<Event> {
        let over = if self.refused { self.gone } else { self.drained && (self.closed || self.gone) };
        if !over || std::mem::replace(&mut self.ended, true) {
            return None;
        }
        Some(Event::Ended { block, generation: self.reader.header().generation, closed: self.closed && !self.refused })
    }

    fn refuse(&mut self, error: WireError) -> Event {
        self.refused = true;
        Event::Refused(error)
    }

    fn step(&mut self, block: u32, info: StepInfo) -> Event {
        self.heartbeat.send(&self.reader);
        let StepInfo { step, time, published, missed, .. } = info;
        Event::Step { block, generation: self.reader.header().generation, step, time, published, missed }
    }
}

/// Follows all rings of a folder, each from its oldest step on.
pub struct RingFollower {
    ring: PathBuf,
    limits: Limits,
    rings: BTreeMap<u32, Followed>,
    /// Last refusal of each block, and of the folder (`None`), so that each is reported once.
    reported: BTreeMap<Option<u32>, String>,
    scanned: Option<Instant>,
    /// The simulation that was polled last; they take turns.
    turn: Simulation,
    /// The step that is being read, if the simulation has several blocks.
    current: Option<(Simulation, Place)>,
    /// Number of this follower's marks in the rings.
    mark: u32,
    #[allow(dead_code)]
    following: Following,
}

impl RingFollower {
    /// Begins to follow; the folder is created if it does not exist.
    ///
    /// # Errors
    /// The folder does not belong to this user alone, or has too many followers.
    pub fn begin(ring: &Path, limits: Limits) -> Result<Self, WireError> {
        let following = Following::begin(ring)?;
        let mark = following.mark()?;
        let (rings, reported, turn) = (BTreeMap::new(), BTreeMap::new(), (0, 0));
        Ok(Self { ring: ring.into(), limits, rings, reported, scanned: None, turn, current: None, mark, following })
    }

    /// Returns the next event, or `None` if there is none. A step's values are in `values`, and its producer may overwrite the step.
    pub fn poll(&mut self, values: &mut Vec<f32>) -> Option<Event> {
        self.poll_while(values, &mut || true)
    }

    /// [`Self::poll`] that calls `go_on` after each MiB of a step. If it returns false, the step stays unread. A step whose producer does not wait may be
    /// overwritten meanwhile.
    pub fn poll_while(&mut self, values: &mut Vec<f32>, go_on: &mut dyn FnMut() -> bool) -> Option<Event> {
        self.beat();
        if self.scanned.is_none_or(|scanned| scanned.elapsed() > SCAN_INTERVAL) {
            if let Some(event) = self.scan() {
                return Some(event);
            }
            self.scanned = Some(Instant::now());
        }
        for (block, followed) in &mut self.rings {
            followed.check_producer(&self.ring, *block);
            if let Some(event) = followed.end(*block) {
                return Some(event);
            }
        }
        let simulations: BTreeSet<Simulation> = self.rings.values().filter(|f| !f.ended).map(Followed::simulation).collect();
        let later = (Bound::Excluded(self.turn), Bound::Unbounded);
        for simulation in simulations.range(later).chain(simulations.range(..=self.turn)) {
            self.turn = *simulation;
            let event = match simulation.1 {
                1 => self.read_field(*simulation, values, go_on),
                _ => self.read_block(*simulation, values, go_on),
            };
            if event.is_some() {
                return event;
            }
        }
        None
    }

    /// Reads the next step of a simulation in one block.
    fn read_field(&mut self, simulation: Simulation, values: &mut Vec<f32>, go_on: &mut dyn FnMut() -> bool) -> Option<Event> {
        let block = *self.rings.iter().find(|(_, followed)| followed.simulation() == simulation && !followed.refused)?.0;
        let read = self.read_ring(block, go_on, |reader, go_on| reader.read_while(values, go_on))?;
        let followed = self.rings.get_mut(&block)?;
        match read {
            Ok(None) => None,
            Ok(Some(Read::Step(info))) => {
                followed.drained = false;
                Some(followed.step(block, info))
            }
            Ok(Some(end)) => {
                (followed.drained, followed.closed) = (true, followed.closed || end == Read::Ended);
                None
            }
            Err(error) => Some(followed.refuse(error)),
        }
    }

    /// Reads the next block of the current step of a simulation in several blocks, or the first block of its next step.
    fn read_block(&mut self, simulation: Simulation, values: &mut Vec<f32>, go_on: &mut dyn FnMut() -> bool) -> Option<Event> {
        for _ in 0..ATTEMPTS {
            // All rings are examined before a new step is begun, not between the blocks of a step.
            let block = match self.next(simulation).filter(|(_, place)| self.current == Some((simulation, *place))) {
                Some((block, _)) => block,
                None => {
                    if let Some(refused) = self.look_ahead(simulation) {
                        return Some(refused);
                    }
                    let (block, place) = self.next(simulation)?;
                    // Blocks that were opened before this step was published are there now; their steps would fall behind.
                    if !self.is_whole(simulation)
                        && let Some(event) = self.scan()
                    {
                        return Some(event);
                    }
                    self.current = Some((simulation, place));
                    block
                }
            };
            let (number, _) = self.rings.get(&block)?.unread.first()?;
            let read = self.read_ring(block, go_on, |reader, go_on| reader.take(number, values, go_on))?;
            let followed = self.rings.get_mut(&block)?;
            match read {
                Ok(SlotRead::Step(info)) => {
                    followed.unread.took();
                    return Some(followed.step(block, info));
                }
                Ok(SlotRead::Stopped) => return None,
                Ok(SlotRead::Overwritten) => {
                    followed.unread.overwritten(&mut followed.reader, number + 1);
                    self.current = None;
                }
                Err(error) => return Some(followed.refuse(error)),
            }
        }
        None
    }

    /// Returns true if all blocks of a simulation were found.
    fn is_whole(&self, simulation: Simulation) -> bool {
        self.rings.values().filter(|followed| followed.simulation() == simulation).count() == simulation.1 as usize
    }

    /// The ring to read next, and the place of its oldest step. Replaced rings come first: their blocks are not opened anew before they are read.
    fn next(&self, simulation: Simulation) -> Option<(u32, Place)> {
        let rings = self.rings.iter().filter(|(_, f)| f.simulation() == simulation && f.is_read());
        let of = |replaced: bool| rings.clone().filter(move |(_, f)| f.replaced == replaced).map(|(block, f)| (*block, &f.unread));
        choice::next(of(true)).or_else(|| choice::next(of(false)))
    }

    /// Examines all rings of a simulation in several blocks, and skips steps that cannot become complete.
    fn look_ahead(&mut self, simulation: Simulation) -> Option<Event> {
        let mut rings: Vec<&mut Followed> = self.rings.values_mut().filter(|f| f.simulation() == simulation && f.is_read()).collect();
        let newest = rings.iter().filter_map(|followed| followed.unread.last()).map(|(round, _)| round).max().unwrap_or(0);
        for followed in &mut rings {
            let looked = followed.reader.is_closed().and_then(|closed| {
                followed.closed |= closed;
                followed.unread.look(&mut followed.reader, newest)
            });
            if let Err(error) = looked {
                return Some(followed.refuse(error));
            }
            followed.drained = followed.unread.is_empty();
        }
        rings.retain(|followed| !followed.replaced);
        let place = choice::catch_up(rings.iter_mut().map(|followed| &mut followed.unread).collect())?;
        for followed in rings {
            if followed.unread.skip_to(&mut followed.reader, place) {
                followed.heartbeat.send(&followed.reader);
            }
        }
        None
    }

    /// Sends a heartbeat to all producers without taking a step: they wait as long as their policy allows.
    pub fn hold(&mut self) {
        self.rings.values_mut().filter(|f| !f.refused).for_each(|f| f.heartbeat.send(&f.reader));
    }

    /// [`Self::hold`] at most once a second; cheap in between.
    pub fn beat(&mut self) {
        self.rings.values_mut().filter(|f| !f.refused).for_each(|f| f.heartbeat.send_if_due(&f.reader));
    }

    /// Reads a ring. After each piece of the values, heartbeats that are due are sent and `go_on` is called.
    fn read_ring<T>(
        &mut self,
        block: u32,
        go_on: &mut dyn FnMut() -> bool,
        read: impl FnOnce(&mut RingReader, &mut dyn FnMut(&RingReader) -> bool) -> T,
    ) -> Option<T> {
        // Out of the map, so that the others can be borrowed for their heartbeats.
        let mut followed = self.rings.remove(&block)?;
        let Followed { reader, heartbeat, .. } = &mut followed;
        let result = read(reader, &mut |reader| {
            heartbeat.send_if_due(reader);
            self.beat();
            go_on()
        });
        self.rings.insert(block, followed);
        Some(result)
    }

    /// Reports a refusal unless it was the last one of its block or of the folder.
    fn refuse_once(&mut self, block: Option<u32>, error: WireError) -> Option<Event> {
        let text = error.to_string();
        let is_new = self.reported.get(&block) != Some(&text);
        self.reported.insert(block, text);
        is_new.then_some(Event::Refused(error))
    }

    /// Looks for rings that are new, or that replaced an old one.
    fn scan(&mut self) -> Option<Event> {
        // Otherwise a folder that cannot be read, for instance because no descriptor is left, would seem empty.
        if let Err(error) = std::fs::read_dir(&self.ring)
            && error.kind() != ErrorKind::NotFound
        {
            let error = WireError::io(&self.ring, "cannot be examined", error);
            return self.refuse_once(None, error);
        }
        self.reported.remove(&None);
        for block in blocks(&self.ring) {
            // The rest of an old ring is read first.
            if let Some(followed) = self.rings.get_mut(&block) {
                followed.replaced = !followed.reader.is_current();
                if !followed.replaced || !followed.ended {
                    continue;
                }
            }
            // A ring without a producer that was never followed is left from a killed run.
            let opened = match producer_lives(&self.ring, block) {
                Ok(false) if !self.closed_in_order(block) => continue,
                Ok(_) => RingReader::open(&self.ring, block, &self.limits),
                Err(error) => Err(error),
            };
            match opened {
                Ok(reader) => {
                    let header = reader.header();
                    if self.rings.get(&block).is_some_and(|known| known.reader.header().producer == header.producer) {
                        continue;
                    }
                    self.reported.remove(&Some(block));
                    let event = Event::Opened { description: Box::new(header.description.clone()), generation: header.generation };
                    self.rings.insert(block, Followed::begin(reader, self.mark));
                    return Some(event);
                }
                // It was removed meanwhile.
                Err(WireError::Io { source, .. }) if source.kind() == ErrorKind::NotFound => {}
                Err(error) => {
                    if let Some(event) = self.refuse_once(Some(block), error) {
                        return Some(event);
                    }
                }
            }
        }
        None
    }

    /// Returns true if a ring without a producer was closed, not killed: its last steps count.
    fn closed_in_order(&self, block: u32) -> bool {
        !self.rings.contains_key(&block)
            && RingReader::open(&self.ring, block, &self.limits).and_then(|reader| reader.is_closed()).unwrap_or(false)
    }
}

impl Drop for RingFollower {
    fn drop(&mut self) {
        for followed in self.rings.values() {
            let _ = followed.reader.leave(self.mark);
        }
    }
}
