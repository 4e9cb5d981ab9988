//! Following blocks, wherever they come from: rings of this node, or relays of others.

use crate::choice::{self, Unread};
use crate::lock::{Following, blocks, producer_lives};
use crate::place::Place;
use crate::reader::{Read, RingReader, StepInfo, Tried};
use crate::{Description, Limits, WireError};
use std::collections::{BTreeMap, BTreeSet};
use std::io::ErrorKind;
use std::ops::Bound;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

/// Steps that are begun to be read in one look, if a producer overtakes each of them.
const ATTEMPTS: usize = 4;
/// How often new rings are looked for.
const LOOK: Duration = Duration::from_millis(100);
/// How often producers are told that somebody follows, at least: while [`RingFollower::poll`] or [`RingFollower::beat`] is called again and again, and
/// while a step is read.
const BEAT: Duration = Duration::from_secs(1);

/// What happened to a block.
#[derive(Debug)]
pub enum Event {
    /// A producer was found, or took over from one that ended. Its description is checked.
    Opened {
        /// What it publishes.
        description: Box<Description>,
        /// When it was opened, nanoseconds since 1970.
        generation: u64,
    },
    /// A step; its values are in the buffer.
    Step {
        /// Which block.
        block: u32,
        /// When its producer opened it.
        generation: u64,
        /// The solver's number.
        step: u64,
        /// Its time.
        time: f64,
        /// When it was published, nanoseconds since 1970.
        published: u64,
        /// Steps of the block before this one that were overwritten before they could be read, or passed over since that had happened to another block.
        missed: u64,
    },
    /// The producer closed the block, or its process ended; all that it left was read.
    Ended {
        /// Which block.
        block: u32,
        /// When its producer opened it.
        generation: u64,
        /// Whether it was closed; else its process ended without that, or the relay is gone.
        closed: bool,
    },
    /// Something was refused; following goes on.
    Refused(WireError),
}

/// Rings of one start of a simulation name the same start and the same number of blocks.
type Simulation = (u64, u32);

/// One block's ring.
struct Followed {
    reader: RingReader,
    /// Of one block among several: what is there.
    unread: Unread,
    /// Nothing more is read, since what was read could not be: until a new producer takes its place.
    refused: bool,
    /// There was nothing to be read when it was last looked at.
    drained: bool,
    /// The producer has closed it, as was seen before that look.
    closed: bool,
    /// The producer's process has ended, or another ring is in its place.
    gone: bool,
    /// Another ring is in its place.
    replaced: bool,
    /// Its end was told.
    ended: bool,
    looked: Instant,
    /// When its producer was last told that somebody follows.
    told: Instant,
}

impl Followed {
    fn begin(reader: RingReader) -> Self {
        let (unread, now) = (Unread::default(), Instant::now());
        let (refused, drained, closed, gone, replaced, ended) = (false, false, false, false, false, false);
        Self { reader, unread, refused, drained, closed, gone, replaced, ended, looked: now, told: now }
    }

    /// Tells the producer how far its steps were taken.
    fn acknowledge(&mut self, mark: u32) {
        acknowledge(&self.reader, &mut self.told, mark);
    }

    /// [`Self::acknowledge`], where the producer has heard nothing for a second.
    fn beat(&mut self, mark: u32) {
        if !self.refused {
            beat(&self.reader, &mut self.told, mark);
        }
    }

    fn simulation(&self) -> Simulation {
        let description = &self.reader.header().description;
        (description.start, description.block.count)
    }

    /// Looks whether the producer is still there. What it left is looked for once more then.
    fn look_for_producer(&mut self, ring: &Path, block: u32) {
        if self.gone || self.ended || !(self.drained || self.refused) || self.looked.elapsed() <= LOOK {
            return;
        }
        self.looked = Instant::now();
        // The lock may already be that of a producer that took the place of this one.
        // Where it cannot be told, the ring is left as it is.
        self.gone = !self.reader.is_current() || producer_lives(ring, block).is_ok_and(|lives| !lives);
        self.drained &= !self.gone;
    }

    /// Its end, once: all that it left was read.
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

    fn step(&mut self, block: u32, info: StepInfo, mark: u32) -> Event {
        self.acknowledge(mark);
        let StepInfo { step, time, published, missed, .. } = info;
        Event::Step { block, generation: self.reader.header().generation, step, time, published, missed }
    }
}

/// A ring that cannot be written to is one that nobody waits for.
fn acknowledge(reader: &RingReader, told: &mut Instant, mark: u32) {
    *told = Instant::now();
    let _ = reader.acknowledge(mark);
}

fn beat(reader: &RingReader, told: &mut Instant, mark: u32) {
    if told.elapsed() > BEAT {
        acknowledge(reader, told, mark);
    }
}

/// Follows all rings of a folder, each from its oldest step on.
pub struct RingFollower {
    ring: PathBuf,
    limits: Limits,
    rings: BTreeMap<u32, Followed>,
    /// Rings that were refused, with their words, so that each is told once.
    refused: BTreeMap<u32, String>,
    /// Why the folder could not be looked at last time, told once.
    unseen: Option<String>,
    looked: Option<Instant>,
    /// The simulation that was asked last, so that none is starved.
    turn: Simulation,
    /// Of a simulation in several blocks, the step that is being read.
    current: Option<(Simulation, Place)>,
    /// Which of the rings' marks is this follower's.
    mark: u32,
    #[allow(dead_code)]
    following: Following,
}

impl RingFollower {
    /// Begins; the folder is made where it is not there.
    ///
    /// # Errors
    /// The folder is not this user's alone, or has too many followers.
    pub fn begin(ring: &Path, limits: Limits) -> Result<Self, WireError> {
        let following = Following::begin(ring)?;
        let mark = following.mark()?;
        Ok(Self {
            ring: ring.into(),
            limits,
            rings: BTreeMap::new(),
            refused: BTreeMap::new(),
            unseen: None,
            looked: None,
            turn: (0, 0),
            current: None,
            mark,
            following,
        })
    }

    /// The next thing that happened; none: nothing new. A step's values are in `values`, and its producer may go on.
    pub fn poll(&mut self, values: &mut Vec<f32>) -> Option<Event> {
        self.poll_beside(values, &mut || true)
    }

    /// The same, with `beside` asked after each MiB of a step whether to go on; where it says no, nothing is taken. A step whose producer does not wait may be
    /// overwritten meanwhile.
    pub fn poll_beside(&mut self, values: &mut Vec<f32>, beside: &mut dyn FnMut() -> bool) -> Option<Event> {
        self.beat();
        if self.looked.is_none_or(|looked| looked.elapsed() > LOOK) {
            if let Some(event) = self.look() {
                return Some(event);
            }
            self.looked = Some(Instant::now());
        }
        for (block, followed) in &mut self.rings {
            followed.look_for_producer(&self.ring, *block);
            if let Some(event) = followed.end(*block) {
                return Some(event);
            }
        }
        let simulations: BTreeSet<Simulation> = self.rings.values().filter(|f| !f.ended).map(Followed::simulation).collect();
        let later = (Bound::Excluded(self.turn), Bound::Unbounded);
        for simulation in simulations.range(later).chain(simulations.range(..=self.turn)) {
            self.turn = *simulation;
            let event = match simulation.1 {
                1 => self.read_field(*simulation, values, beside),
                _ => self.read_block(*simulation, values, beside),
            };
            if event.is_some() {
                return event;
            }
        }
        None
    }

    /// Of a simulation in one block, its next step.
    fn read_field(&mut self, simulation: Simulation, values: &mut Vec<f32>, beside: &mut dyn FnMut() -> bool) -> Option<Event> {
        let block = *self.rings.iter().find(|(_, followed)| followed.simulation() == simulation && !followed.refused)?.0;
        let found = self.read_ring(block, beside, |reader, beside| reader.read_beside(values, beside))?;
        let followed = self.rings.get_mut(&block)?;
        match found {
            Ok(None) => None,
            Ok(Some(Read::Step(info))) => {
                followed.drained = false;
                Some(followed.step(block, info, self.mark))
            }
            Ok(Some(end)) => {
                (followed.drained, followed.closed) = (true, followed.closed || end == Read::Ended);
                None
            }
            Err(error) => Some(followed.refuse(error)),
        }
    }

    /// Of a simulation in several blocks, the next block of the step that is being read, or the first one of another step.
    fn read_block(&mut self, simulation: Simulation, values: &mut Vec<f32>, beside: &mut dyn FnMut() -> bool) -> Option<Event> {
        for _ in 0..ATTEMPTS {
            // The step goes on from what is known. Before another is begun all rings are looked at.
            let block = match self.next(simulation).filter(|(_, place)| self.current == Some((simulation, *place))) {
                Some((block, _)) => block,
                None => {
                    if let Some(refused) = self.look_ahead(simulation) {
                        return Some(refused);
                    }
                    let (block, place) = self.next(simulation)?;
                    self.current = Some((simulation, place));
                    block
                }
            };
            let (number, _) = self.rings.get(&block)?.unread.first()?;
            let found = self.read_ring(block, beside, |reader, beside| reader.take(number, values, beside))?;
            let followed = self.rings.get_mut(&block)?;
            match found {
                Ok(Tried::Step(info)) => {
                    followed.unread.took();
                    return Some(followed.step(block, info, self.mark));
                }
                Ok(Tried::BrokenOff) => return None,
                Ok(Tried::Overwritten) => {
                    followed.unread.overwritten(&mut followed.reader, number + 1);
                    self.current = None;
                }
                Err(error) => return Some(followed.refuse(error)),
            }
        }
        None
    }

    /// The ring to be read next, and the place of its oldest step. What is in a ring that was replaced comes first: its block is not opened anew before.
    fn next(&self, simulation: Simulation) -> Option<(u32, Place)> {
        let rings = self.rings.iter().filter(|(_, f)| f.simulation() == simulation && !f.refused && !f.ended);
        let of = |replaced: bool| rings.clone().filter(move |(_, f)| f.replaced == replaced).map(|(block, f)| (*block, &f.unread));
        choice::next(of(true)).or_else(|| choice::next(of(false)))
    }

    /// Looks at all rings of a simulation in several blocks, and passes over what will not be whole.
    fn look_ahead(&mut self, simulation: Simulation) -> Option<Event> {
        let mut rings: Vec<&mut Followed> =
            self.rings.values_mut().filter(|f| f.simulation() == simulation && !f.refused && !f.ended).collect();
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
            if followed.unread.pass(&mut followed.reader, place) {
                followed.acknowledge(self.mark);
            }
        }
        None
    }

    /// Tells producers that somebody follows, without taking anything: they wait as long as their policy lets them.
    pub fn hold(&mut self) {
        let mark = self.mark;
        self.rings.values_mut().filter(|followed| !followed.refused).for_each(|followed| followed.acknowledge(mark));
    }

    /// [`Self::hold`] for those producers that have heard nothing for a second: costs nothing in between.
    pub fn beat(&mut self) {
        self.rings.values_mut().for_each(|followed| followed.beat(self.mark));
    }

    /// Reads a ring; after each piece of the values all producers are told, where it is time, and `beside` is called.
    fn read_ring<T>(
        &mut self,
        block: u32,
        beside: &mut dyn FnMut() -> bool,
        read: impl FnOnce(&mut RingReader, &mut dyn FnMut(&RingReader) -> bool) -> T,
    ) -> Option<T> {
        // Apart from the others, which are told of meanwhile.
        let mut followed = self.rings.remove(&block)?;
        let Followed { reader, told, .. } = &mut followed;
        let found = read(reader, &mut |reader| {
            beat(reader, told, self.mark);
            self.beat();
            beside()
        });
        self.rings.insert(block, followed);
        Some(found)
    }

    /// Looks for rings that are new, or that a new producer put in the place of an old one.
    fn look(&mut self) -> Option<Event> {
        // What cannot be looked at, for want of a descriptor for instance, looks empty below.
        if let Err(error) = std::fs::read_dir(&self.ring)
            && error.kind() != ErrorKind::NotFound
        {
            let error = WireError::io(&self.ring, "cannot be looked at", error);
            let words = Some(error.to_string());
            let is_news = self.unseen != words;
            self.unseen = words;
            return is_news.then_some(Event::Refused(error));
        }
        self.unseen = None;
        for block in blocks(&self.ring) {
            // What the old one left is read first.
            if let Some(followed) = self.rings.get_mut(&block) {
                followed.replaced = !followed.reader.is_current();
                if !followed.replaced || !followed.ended {
                    continue;
                }
            }
            // A ring without a producer that was never followed is what a killed run left.
            let opened = match producer_lives(&self.ring, block) {
                Ok(false) if !self.closed_in_order(block) => continue,
                Ok(_) => RingReader::open(&self.ring, block, &self.limits),
                Err(error) => Err(error),
            };
            match opened {
                Ok(reader) => {
                    let known = self.rings.get(&block).map(|f| f.reader.header().producer);
                    if known == Some(reader.header().producer) {
                        continue;
                    }
                    self.refused.remove(&block);
                    let header = reader.header();
                    let event = Event::Opened { description: Box::new(header.description.clone()), generation: header.generation };
                    let mut followed = Followed::begin(reader);
                    followed.acknowledge(self.mark);
                    self.rings.insert(block, followed);
                    return Some(event);
                }
                // It went meanwhile.
                Err(WireError::Io { source, .. }) if source.kind() == ErrorKind::NotFound => {}
                Err(error) => {
                    let words = error.to_string();
                    if self.refused.get(&block) != Some(&words) {
                        self.refused.insert(block, words);
                        return Some(Event::Refused(error));
                    }
                }
            }
        }
        None
    }

    /// Whether a ring without a producer was closed and not killed: its last steps count.
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
