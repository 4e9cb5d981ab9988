//! Selects the next step to read if a node has rings of several blocks, so that the blocks that are read belong together.
//!
//! The heads of the slots are read before any values. Steps are read in the order of their places, and no ring is read more than [`LEAD`] steps ahead of the
//! slowest. A ring that has lost steps shows that the solver is faster than the reader: then the newest step that all rings hold is read next, because it
//! stays longest, and earlier steps are skipped in all rings.

use crate::place::{Place, Rounds};
use crate::reader::SlotContent;
use crate::{ReadAt, RingReader, WireError};
use std::collections::VecDeque;

/// Most steps of a ring that are read before the slowest ring has published them. An assembler must hold at least one more.
pub const LEAD: usize = 2;

/// Steps of a ring whose heads were read and whose values were not.
#[derive(Debug, Default)]
pub(crate) struct Unread {
    /// Numbers in the ring, and places; both ascend.
    available: VecDeque<(u64, Place)>,
    /// The first number whose head was not read.
    next: u64,
    /// Set with the first head.
    rounds: Option<Rounds>,
    /// Places of the steps that were read last.
    read: VecDeque<Place>,
    /// True if steps were overwritten unread.
    lost: bool,
}

impl Unread {
    /// Reads the heads of new steps, and skips steps that were overwritten unread. `newest` is the newest round of all rings.
    pub fn look<F: ReadAt>(&mut self, reader: &mut RingReader<F>, newest: u64) -> Result<(), WireError> {
        let available = reader.available()?;
        self.overwritten(reader, available.start);
        for number in self.next.max(available.start)..available.end {
            match reader.peek(number)? {
                SlotContent::Step(step) => {
                    self.available.push_back((number, self.rounds.get_or_insert(Rounds::begin(newest)).next(step, newest)))
                }
                SlotContent::Overwritten => self.overwritten(reader, number + 1),
                // The next look finds it.
                SlotContent::NotVisible => break,
            }
            self.next = number + 1;
        }
        Ok(())
    }

    /// Drops the steps before a number, which were overwritten.
    pub fn overwritten<F: ReadAt>(&mut self, reader: &mut RingReader<F>, number: u64) {
        self.available.drain(..self.available.partition_point(|(one, _)| *one < number));
        self.lost |= reader.skip_to(number);
    }

    /// Number and place of the oldest step.
    pub fn first(&self) -> Option<(u64, Place)> {
        self.available.front().copied()
    }

    /// Place of the step that was read last.
    pub fn last(&self) -> Option<Place> {
        self.read.back().copied()
    }

    pub fn is_empty(&self) -> bool {
        self.available.is_empty()
    }

    /// Records that the oldest step was read.
    pub fn took(&mut self) {
        if let Some((_, place)) = self.available.pop_front() {
            self.read.push_back(place);
            if self.read.len() > LEAD {
                self.read.pop_front();
            }
        }
    }

    /// Returns true if [`LEAD`] steps were read that a ring whose last step is `slowest` has not delivered yet.
    fn is_ahead_of(&self, slowest: Option<Place>) -> bool {
        self.read.len() == LEAD && self.read.front().copied() > slowest
    }

    fn has(&self, place: Place) -> bool {
        self.available.binary_search_by_key(&place, |(_, one)| *one).is_ok()
    }

    /// Skips the steps before a place; returns true if there were any.
    pub fn skip_to<F: ReadAt>(&mut self, reader: &mut RingReader<F>, place: Place) -> bool {
        self.available.drain(..self.available.partition_point(|(_, one)| *one < place));
        reader.skip_to(self.first().map_or(self.next, |(number, _)| number))
    }
}

/// Among the rings of one simulation that are not too far ahead, the one whose oldest step comes first.
pub(crate) fn next<'a, K: Ord>(rings: impl Iterator<Item = (K, &'a Unread)> + Clone) -> Option<(K, Place)> {
    let slowest = rings.clone().map(|(_, ring)| ring.last()).min()?;
    let near = rings.filter(|(_, ring)| !ring.is_ahead_of(slowest));
    near.filter_map(|(key, ring)| ring.first().map(|(_, place)| (place, key))).min().map(|(place, key)| (key, place))
}

/// The place at which reading continues in all rings, if one of them has lost steps; `None` if none has.
pub(crate) fn catch_up(mut rings: Vec<&mut Unread>) -> Option<Place> {
    let lost = || rings.iter().filter(|ring| ring.lost);
    let newest_first = lost().next()?.available.iter().rev().map(|(_, place)| *place);
    let common = newest_first.into_iter().find(|place| rings.iter().all(|ring| ring.has(*place)));
    // If they share no step: the oldest step of the ring that lost most, since no earlier step can become complete.
    let place = common.or_else(|| lost().filter_map(|ring| ring.first()).map(|(_, place)| place).max())?;
    rings.iter_mut().for_each(|ring| ring.lost = false);
    Some(place)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::header::PUBLISHED;
    use crate::{AxisDescription, Description, Element, Field, Geometry, Limits, Policy, Producer, block_path};
    use std::cell::RefCell;
    use std::path::Path;
    use std::rc::Rc;

    /// A ring in memory.
    struct Memory(Rc<RefCell<Vec<u8>>>);

    impl ReadAt for Memory {
        fn length(&self) -> std::io::Result<u64> {
            Ok(self.0.borrow().len() as u64)
        }

        fn read_at(&self, to: &mut [u8], offset: u64) -> std::io::Result<()> {
            to.copy_from_slice(&self.0.borrow()[offset as usize..][..to.len()]);
            Ok(())
        }

        fn write_at(&self, _: &[u8], _: u64) -> std::io::Result<()> {
            Ok(())
        }
    }

    #[test]
    fn a_step_whose_count_is_seen_before_its_head_is_not_lost() {
        let ring = Path::new("/dev/shm").join(format!("rw-unseen-{}", std::process::id()));
        let axis = |name| AxisDescription::uniform(name, "m", 0.0, 1.0, 2);
        let description = Description::whole(Geometry::Cartesian, vec![axis("x"), axis("y")], "s");
        let producer = Producer::open(&ring, description, 2, Policy::NewestWins).unwrap();
        let publish = |step| {
            let (plane, extent) = ([0f32; 4], producer.description().block.extent);
            // SAFETY: a value a node.
            unsafe { producer.publish(step, 0.0, &Field::packed(&[plane.as_ptr().cast(); 2], Element::F32, extent)).unwrap() };
            std::fs::read(block_path(&ring, 0)).unwrap()
        };
        let now: Vec<Vec<u8>> = (0..4).map(publish).collect();
        drop(producer);
        // The ring after `steps` steps, with another count.
        let seen = |steps: usize, published: u64| {
            let mut bytes = now[steps - 1].clone();
            bytes[PUBLISHED..PUBLISHED + 8].copy_from_slice(&published.to_ne_bytes());
            bytes
        };
        let memory = Rc::new(RefCell::new(now[0].clone()));
        let mut reader = RingReader::over("memory".into(), Memory(memory.clone()), &Limits::default()).unwrap();
        let mut unread = Unread::default();
        let mut steps = |bytes: Vec<u8>| {
            *memory.borrow_mut() = bytes;
            unread.look(&mut reader, 0).unwrap();
            unread.available.iter().map(|(number, _)| *number).collect::<Vec<_>>()
        };
        assert_eq!(steps(seen(1, 1)), [0]);
        // The second slot was never written, and the first still holds the first step.
        assert_eq!(steps(seen(1, 2)), [0]);
        assert_eq!(steps(seen(2, 2)), [0, 1]);
        assert_eq!(steps(seen(2, 3)), [1]);
        assert_eq!(steps(seen(3, 3)), [1, 2]);
        // With a count that lags behind, a step was overwritten.
        assert_eq!(steps(seen(4, 3)), [1, 2], "what was looked at stays until it is read");
        assert_eq!(steps(seen(4, 4)), [2, 3]);
    }
}
