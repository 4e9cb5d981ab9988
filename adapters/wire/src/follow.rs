//! Following blocks, wherever they come from: rings of this node, or relays of others.

use crate::lock::{Following, blocks, producer_lives};
use crate::reader::{Read, RingReader, StepInfo};
use crate::{Description, Limits, WireError};
use std::collections::BTreeMap;
use std::io::ErrorKind;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

/// How often new rings are looked for.
const LOOK: Duration = Duration::from_millis(100);
/// How often producers are told that somebody follows, at least while [`RingFollower::poll`] or [`RingFollower::beat`] is called.
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
        /// Steps of the block that were overwritten before this one could be read.
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

/// One block's ring.
struct Followed {
    reader: RingReader,
    /// Nothing more is read, since what was read could not be: until a new producer takes its place.
    refused: bool,
    /// Its end was told.
    ended: bool,
    looked: Instant,
    /// When its producer was last told that somebody follows.
    told: Instant,
}

impl Followed {
    /// Tells the producer how far its steps were taken. A ring that cannot be written to is one that nobody waits for.
    fn acknowledge(&mut self, mark: u32) {
        self.told = Instant::now();
        let _ = self.reader.acknowledge(mark);
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
    /// The block to be asked next, so that none is starved.
    turn: u32,
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
            turn: 0,
            mark,
            following,
        })
    }

    /// The next thing that happened; none: nothing new. A step's values are in `values`, and its producer may go on.
    pub fn poll(&mut self, values: &mut Vec<f32>) -> Option<Event> {
        self.beat();
        if self.looked.is_none_or(|looked| looked.elapsed() > LOOK) {
            if let Some(event) = self.look() {
                return Some(event);
            }
            self.looked = Some(Instant::now());
        }
        let order: Vec<u32> = self.rings.range(self.turn..).chain(self.rings.range(..self.turn)).map(|(block, _)| *block).collect();
        for block in order {
            let Some(followed) = self.rings.get_mut(&block) else { continue };
            let generation = followed.reader.header().generation;
            let event = match if followed.refused { Ok(Read::Nothing) } else { followed.reader.read(values) } {
                Ok(Read::Step(info)) => {
                    self.turn = block + 1;
                    followed.acknowledge(self.mark);
                    let StepInfo { step, time, published, missed, .. } = info;
                    Some(Event::Step { block, generation, step, time, published, missed })
                }
                Ok(Read::Ended) if !followed.ended => {
                    followed.ended = true;
                    Some(Event::Ended { block, generation, closed: true })
                }
                Ok(Read::Nothing) if !followed.ended && followed.looked.elapsed() > LOOK => {
                    followed.looked = Instant::now();
                    // The lock may already be that of a producer that took the place of this one.
                    let gone = !followed.reader.is_current() || !producer_lives(&self.ring, block);
                    gone.then(|| {
                        followed.ended = true;
                        Event::Ended { block, generation, closed: false }
                    })
                }
                Ok(_) => None,
                Err(error) => {
                    followed.refused = true;
                    Some(Event::Refused(error))
                }
            };
            if event.is_some() {
                return event;
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
        let (mark, now) = (self.mark, Instant::now());
        let quiet = |followed: &&mut Followed| !followed.refused && now.duration_since(followed.told) > BEAT;
        self.rings.values_mut().filter(quiet).for_each(|followed| followed.acknowledge(mark));
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
            if self.rings.get(&block).is_some_and(|followed| followed.reader.is_current() || !followed.ended) {
                continue;
            }
            // A ring without a producer that was never followed is what a killed run left.
            if !producer_lives(&self.ring, block) && !self.closed_in_order(block) {
                continue;
            }
            match RingReader::open(&self.ring, block, &self.limits) {
                Ok(reader) => {
                    let known = self.rings.get(&block).map(|f| f.reader.header().producer);
                    if known == Some(reader.header().producer) {
                        continue;
                    }
                    self.refused.remove(&block);
                    let header = reader.header();
                    let event = Event::Opened { description: Box::new(header.description.clone()), generation: header.generation };
                    let now = Instant::now();
                    let mut followed = Followed { reader, refused: false, ended: false, looked: now, told: now };
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
