//! Which step is read next where a node has the rings of several blocks, so that what is read of them belongs together.
//!
//! The heads of a ring's slots are looked at before any values are read. Steps are read in the order of their places, and no ring runs further than
//! [`AHEAD`] ahead of the slowest. Where a ring has lost steps the solver is faster than the reading: then the newest step that all rings hold comes
//! next, since it will be there for longest, and what is before it is passed over in all of them.

use crate::place::{Place, Rounds};
use crate::{ReadAt, RingReader, WireError};
use std::collections::VecDeque;

/// Steps of a ring that are read before the slowest ring has published them. Whoever puts blocks together lets one more wait at least.
pub(crate) const AHEAD: usize = 2;

/// Steps of a ring that were looked at and not read.
#[derive(Debug, Default)]
pub(crate) struct Ahead {
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

impl Ahead {
    /// Looks for steps that were published, and for those that were overwritten unread, which the reader passes over. `newest` is the round that the
    /// rings have come to.
    pub fn look<F: ReadAt>(&mut self, reader: &mut RingReader<F>, newest: u64) -> Result<(), WireError> {
        let there = reader.there()?;
        self.overwritten(reader, there.start);
        for number in self.next.max(there.start)..there.end {
            match reader.step_of(number)? {
                Some(step) => self.there.push_back((number, self.rounds.get_or_insert(Rounds::begin(newest)).next(step, newest))),
                None => self.overwritten(reader, number + 1),
            }
        }
        self.next = there.end;
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
            if self.read.len() > AHEAD {
                self.read.pop_front();
            }
        }
    }

    /// Whether so many were read that a ring whose last one is `slowest` has not had yet, that no more of them are to be.
    fn is_far_from(&self, slowest: Option<Place>) -> bool {
        self.read.len() == AHEAD && self.read.front().copied() > slowest
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
pub(crate) fn next<'a, K: Ord>(rings: impl Iterator<Item = (K, &'a Ahead)> + Clone) -> Option<(K, Place)> {
    let slowest = rings.clone().map(|(_, ring)| ring.last()).min()?;
    let near = rings.filter(|(_, ring)| !ring.is_far_from(slowest));
    near.filter_map(|(key, ring)| ring.first().map(|(_, place)| (place, key))).min().map(|(place, key)| (key, place))
}

/// Where one of the rings has lost steps: the place from which reading goes on in all of them.
pub(crate) fn catch_up(mut rings: Vec<&mut Ahead>) -> Option<Place> {
    let lost = || rings.iter().filter(|ring| ring.lost);
    let newest_first = lost().next()?.there.iter().rev().map(|(_, place)| *place);
    let common = newest_first.into_iter().find(|place| rings.iter().all(|ring| ring.has(*place)));
    // Where they have none in common, what the ring that lost most has left: before that nothing will be whole.
    let place = common.or_else(|| lost().filter_map(|ring| ring.first()).map(|(_, place)| place).max())?;
    rings.iter_mut().for_each(|ring| ring.lost = false);
    Some(place)
}
