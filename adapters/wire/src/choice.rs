//! Which step is read next where a node has the rings of several blocks, so that what is read of them belongs together.
//!
//! The heads of a ring's slots are looked at before any values are read. Steps are read in the order of their places, and no ring runs further than
//! [`LEAD`] ahead of the slowest. Where a ring has lost steps the solver is faster than the reading: then the newest step that all rings hold comes
//! next, since it will be there for longest, and what is before it is passed over in all of them.

use crate::place::{Place, Rounds};
use crate::reader::Found;
use crate::{ReadAt, RingReader, WireError};
use std::collections::VecDeque;

/// Steps of a ring that are read before the slowest ring has published them. Whoever puts blocks together lets one more wait at least.
pub const LEAD: usize = 2;

/// Steps of a ring that were looked at and not read.
#[derive(Debug, Default)]
pub(crate) struct Unread {
    /// Their numbers in the ring, and their places, which rise.
    there: VecDeque<(u64, Place)>,
    /// The first number that was not looked at.
    next: u64,
    /// Once one was looked at.
    rounds: Option<Rounds>,
    /// Places of those that were read last.
    read: VecDeque<Place>,
    /// Some were overwritten unread.
    lost: bool,
}

impl Unread {
    /// Looks for steps that were published, and for those that were overwritten unread, which the reader passes over. `newest` is the round that the
    /// rings have come to.
    pub fn look<F: ReadAt>(&mut self, reader: &mut RingReader<F>, newest: u64) -> Result<(), WireError> {
        let there = reader.there()?;
        self.overwritten(reader, there.start);
        for number in self.next.max(there.start)..there.end {
            match reader.look_at(number)? {
                Found::Step(step) => self.there.push_back((number, self.rounds.get_or_insert(Rounds::begin(newest)).next(step, newest))),
                Found::Overwritten => self.overwritten(reader, number + 1),
                // It comes with the next look.
                Found::Unseen => break,
            }
            self.next = number + 1;
        }
        Ok(())
    }

    /// What is before a number is not there any more.
    pub fn overwritten<F: ReadAt>(&mut self, reader: &mut RingReader<F>, number: u64) {
        self.there.drain(..self.there.partition_point(|(one, _)| *one < number));
        self.lost |= reader.pass(number);
    }

    /// Number and place of the oldest.
    pub fn first(&self) -> Option<(u64, Place)> {
        self.there.front().copied()
    }

    /// Place of the one that was read last.
    pub fn last(&self) -> Option<Place> {
        self.read.back().copied()
    }

    pub fn is_empty(&self) -> bool {
        self.there.is_empty()
    }

    /// The oldest was read.
    pub fn took(&mut self) {
        if let Some((_, place)) = self.there.pop_front() {
            self.read.push_back(place);
            if self.read.len() > LEAD {
                self.read.pop_front();
            }
        }
    }

    /// Whether so many were read that a ring whose last one is `slowest` has not had yet, that no more of them are to be.
    fn is_far_from(&self, slowest: Option<Place>) -> bool {
        self.read.len() == LEAD && self.read.front().copied() > slowest
    }

    fn has(&self, place: Place) -> bool {
        self.there.binary_search_by_key(&place, |(_, one)| *one).is_ok()
    }

    /// Passes over what is before a place; whether anything was.
    pub fn pass<F: ReadAt>(&mut self, reader: &mut RingReader<F>, place: Place) -> bool {
        self.there.drain(..self.there.partition_point(|(_, one)| *one < place));
        reader.pass(self.first().map_or(self.next, |(number, _)| number))
    }
}

/// Of rings of one simulation, those that are waited for: the one whose oldest step is read next.
pub(crate) fn next<'a, K: Ord>(rings: impl Iterator<Item = (K, &'a Unread)> + Clone) -> Option<(K, Place)> {
    let slowest = rings.clone().map(|(_, ring)| ring.last()).min()?;
    let near = rings.filter(|(_, ring)| !ring.is_far_from(slowest));
    near.filter_map(|(key, ring)| ring.first().map(|(_, place)| (place, key))).min().map(|(place, key)| (key, place))
}

/// Where one of the rings has lost steps: the place from which reading goes on in all of them.
pub(crate) fn catch_up(mut rings: Vec<&mut Unread>) -> Option<Place> {
    let lost = || rings.iter().filter(|ring| ring.lost);
    let newest_first = lost().next()?.there.iter().rev().map(|(_, place)| *place);
    let common = newest_first.into_iter().find(|place| rings.iter().all(|ring| ring.has(*place)));
    // Where they have none in common, what the ring that lost most has left: before that nothing will be whole.
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
        // As it was when so many steps were there, but for their count.
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
            unread.there.iter().map(|(number, _)| *number).collect::<Vec<_>>()
        };
        assert_eq!(steps(seen(1, 1)), [0]);
        // The second slot was never written, the first still holds the first step.
        assert_eq!(steps(seen(1, 2)), [0]);
        assert_eq!(steps(seen(2, 2)), [0, 1]);
        assert_eq!(steps(seen(2, 3)), [1]);
        assert_eq!(steps(seen(3, 3)), [1, 2]);
        // The other way about a step was overwritten.
        assert_eq!(steps(seen(4, 3)), [1, 2], "what was looked at stays until it is read");
        assert_eq!(steps(seen(4, 4)), [2, 3]);
    }
}
