//! The bounded memory of traced samples: newest wins, and labels of a window that has slid on are set aside until a re-test says that
//! they still hold.

use super::network::draw;
use super::{Samples, fresh_stamp};
use std::ops::Range;

/// Share of re-traced labels that must still hold for the stale ones to be used again. A label error in one sample of twenty, at the
/// tolerance of the test, adds less to the loss than the tolerance itself.
pub const KEEP_STALE: f64 = 0.95;

/// Where a ring stood when somebody took a copy of it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct BufferMark {
    epoch: u64,
    pushed: u64,
}

/// Newest samples, at most `capacity`, those set aside included.
#[derive(Debug)]
pub struct ReplayBuffer {
    capacity: usize,
    /// Labels of the present window. Circular once full.
    fresh: Samples,
    /// Where the next fresh sample goes once full.
    next: usize,
    /// Labels of an earlier window.
    stale: Samples,
    pushed: u64,
    /// Another number whenever samples were moved, which no other ring has.
    epoch: u64,
    /// Times of samples that say nothing of time; none where nobody asks for times.
    now: Option<[f32; 2]>,
}

impl ReplayBuffer {
    /// An empty ring of at least one sample.
    pub fn new(capacity: usize) -> Self {
        let empty = Samples::default();
        Self { capacity: capacity.max(1), fresh: empty.clone(), next: 0, stale: empty, pushed: 0, epoch: fresh_stamp(), now: None }
    }

    /// A full ring of these samples.
    pub fn holding(samples: &Samples) -> Self {
        let mut ring = Self::new(samples.len());
        ring.push(samples);
        ring
    }

    /// Samples that say nothing of time are of these unit times from now on, and every sample is kept with its own.
    pub fn set_now(&mut self, times: [f32; 2]) {
        self.now = Some(times);
    }

    /// Where the ring stands now.
    pub fn mark(&self) -> BufferMark {
        BufferMark { epoch: self.epoch, pushed: self.pushed }
    }

    /// Whether samples still lie where they lay at `mark`.
    pub fn continues(&self, mark: BufferMark) -> bool {
        mark.epoch == self.epoch
    }

    /// Places in [`ReplayBuffer::samples`] that have been written since `mark`: all of them where samples have been moved since, or without a mark.
    pub fn written_since(&self, mark: Option<BufferMark>) -> [Range<usize>; 2] {
        let len = self.len();
        let fresh = match mark {
            Some(mark) if self.continues(mark) => usize::try_from(self.pushed - mark.pushed).map_or(len, |fresh| fresh.min(len)),
            _ => len,
        };
        // The newest sample lies before `end`, and after the last place comes the first one again.
        let end = if len < self.capacity { len } else { self.next };
        if fresh <= end { [end - fresh..end, 0..0] } else { [len - (fresh - end)..len, 0..end] }
    }

    /// Most samples held.
    pub fn capacity(&self) -> usize {
        self.capacity
    }

    /// Samples that may be trained on, in no particular order.
    pub fn samples(&self) -> &Samples {
        &self.fresh
    }

    /// Number of samples that may be trained on.
    pub fn len(&self) -> usize {
        self.fresh.len()
    }

    /// Whether nothing may be trained on.
    pub fn is_empty(&self) -> bool {
        self.fresh.is_empty()
    }

    /// Samples set aside since the window slid.
    pub fn stale(&self) -> &Samples {
        &self.stale
    }

    /// Samples ever pushed.
    pub fn pushed(&self) -> u64 {
        self.pushed
    }

    /// Takes samples in; stale ones make room first, then the oldest fresh ones. Arrivals and Jacobians are kept when every sample has them; a
    /// push without them, or with them for the first time, starts the ring anew, since half of a flow map cannot be trained on.
    pub fn push(&mut self, samples: &Samples) {
        if samples.is_empty() {
            return;
        }
        if !self.fresh.is_empty() && shape(&self.fresh) != shape(samples) {
            self.fresh = Samples::default();
            self.next = 0;
            self.epoch = fresh_stamp();
        }
        self.pushed += samples.len() as u64;
        let first = samples.len().saturating_sub(self.capacity);
        for index in first..samples.len() {
            if self.fresh.len() < self.capacity {
                append(&mut self.fresh, samples, index, self.now);
            } else {
                overwrite(&mut self.fresh, self.next, samples, index, self.now);
                self.next = (self.next + 1) % self.capacity;
            }
        }
        let room = self.capacity - self.fresh.len();
        self.stale.points.truncate(room);
        self.stale.log_stretch.truncate(room);
        self.stale.arrival.truncate(room);
        self.stale.jacobian.truncate(room);
        self.stale.times.truncate(room);
    }

    /// The window slid: all labels are set aside. What had been set aside before is dropped.
    pub fn mark_stale(&mut self) {
        self.stale = std::mem::take(&mut self.fresh);
        self.next = 0;
        self.epoch = fresh_stamp();
    }

    /// Numbers of up to `count` samples to trace anew before they are marked stale, drawn with repetition by seed and counter.
    pub fn probe(&self, count: usize, seed: u64, counter: u64) -> Vec<usize> {
        let len = self.len();
        (0..count.min(len)).map(|i| draw(seed, counter + i as u64, len)).collect()
    }

    /// Tells which share of the probed labels still holds: from [`KEEP_STALE`] on the stale samples may be trained on again (as many as fit),
    /// below it they are dropped. Returns whether they were kept.
    pub fn revalidate(&mut self, share_holding: f64) -> bool {
        let stale = std::mem::take(&mut self.stale);
        let same = self.fresh.is_empty() || shape(&self.fresh) == shape(&stale);
        let keep = share_holding >= KEEP_STALE && same && !stale.is_empty();
        if !keep {
            return false;
        }
        let room = (self.capacity - self.fresh.len()).min(stale.len());
        for index in 0..room {
            append(&mut self.fresh, &stale, index, None);
        }
        self.epoch = fresh_stamp();
        true
    }
}

fn shape(samples: &Samples) -> [bool; 2] {
    [samples.arrival.len() == samples.len(), samples.jacobian.len() == samples.len()]
}

fn append(to: &mut Samples, from: &Samples, index: usize, now: Option<[f32; 2]>) {
    to.points.push(from.points[index]);
    to.log_stretch.push(from.log_stretch.get(index).copied().unwrap_or(f32::NAN));
    to.arrival.extend(from.arrival.get(index));
    to.jacobian.extend(from.jacobian.get(index));
    to.times.extend(from.times.get(index).copied().or(now));
}

fn overwrite(to: &mut Samples, at: usize, from: &Samples, index: usize, now: Option<[f32; 2]>) {
    to.points[at] = from.points[index];
    to.log_stretch[at] = from.log_stretch.get(index).copied().unwrap_or(f32::NAN);
    if let (Some(to), Some(&from)) = (to.arrival.get_mut(at), from.arrival.get(index)) {
        *to = from;
    }
    if let (Some(to), Some(&from)) = (to.jacobian.get_mut(at), from.jacobian.get(index)) {
        *to = from;
    }
    if let (Some(to), Some(from)) = (to.times.get_mut(at), from.times.get(index).copied().or(now)) {
        *to = from;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn numbered(range: std::ops::Range<u32>) -> Samples {
        Samples {
            points: range.clone().map(|i| [i as f32, 0.0, 0.0]).collect(),
            log_stretch: range.map(|i| i as f32).collect(),
            ..Samples::default()
        }
    }

    fn labels(samples: &Samples) -> Vec<u32> {
        let mut labels: Vec<u32> = samples.log_stretch.iter().map(|&s| s as u32).collect();
        labels.sort_unstable();
        labels
    }

    #[test]
    fn the_newest_stay() {
        let mut ring = ReplayBuffer::new(10);
        ring.push(&numbered(0..7));
        ring.push(&numbered(7..13));
        assert_eq!(labels(ring.samples()), (3..13).collect::<Vec<_>>());
        ring.push(&numbered(100..125));
        assert_eq!(labels(ring.samples()), (115..125).collect::<Vec<_>>());
        assert_eq!((ring.len(), ring.pushed()), (10, 38));
        assert!(ring.samples().points.iter().zip(&ring.samples().log_stretch).all(|(p, s)| p[0] == *s));
    }

    #[test]
    fn stale_labels_are_not_drawn_until_they_are_shown_to_hold() {
        let half_stale = || {
            let mut ring = ReplayBuffer::new(10);
            ring.push(&numbered(0..8));
            ring.mark_stale();
            assert!(ring.is_empty() && ring.stale().len() == 8);
            ring.push(&numbered(50..55));
            ring
        };
        // Room for ten: five fresh ones push three of the eight stale ones out.
        let (mut ring, mut dropped) = (half_stale(), half_stale());
        assert_eq!((ring.len(), ring.stale().len()), (5, 5));
        assert_eq!(labels(ring.samples()), (50..55).collect::<Vec<_>>());
        assert_eq!(ring.probe(100, 1, 0).len(), 5);
        assert!(!dropped.revalidate(0.94));
        assert_eq!((dropped.len(), dropped.stale().len()), (5, 0));
        assert!(ring.revalidate(0.96));
        assert_eq!(ring.len(), 10);
    }

    #[test]
    fn a_copy_that_takes_what_was_written_stays_a_copy() {
        let mut ring = ReplayBuffer::new(10);
        let (mut copy, mut mark, mut next) = (Vec::new(), None, 0);
        for count in [0, 3, 4, 5, 10, 1, 9, 25, 7] {
            ring.push(&numbered(next..next + count));
            next += count;
            copy.resize(ring.len(), f32::NAN);
            let ranges = ring.written_since(mark);
            assert!(ranges.iter().map(ExactSizeIterator::len).sum::<usize>() <= count as usize, "nothing is taken twice");
            for range in ranges {
                copy[range.clone()].copy_from_slice(&ring.samples().log_stretch[range]);
            }
            assert_eq!(copy, ring.samples().log_stretch, "after {next}");
            mark = Some(ring.mark());
        }
        ring.mark_stale();
        ring.push(&numbered(90..92));
        ring.revalidate(1.0);
        assert_eq!((ring.len(), ring.written_since(mark)), (10, [0..10, 0..0]), "all were moved");
        assert_ne!(ReplayBuffer::new(10).mark(), ReplayBuffer::new(10).mark(), "two rings are never the same");
    }

    #[test]
    fn flow_map_labels_travel_along() {
        let mut ring = ReplayBuffer::new(4);
        let mut samples = numbered(0..6);
        samples.arrival = (0..6).map(|i| [i as f32; 3]).collect();
        samples.jacobian = (0..6).map(|i| [i as f32; 9]).collect();
        ring.push(&samples);
        ring.push(&samples);
        let held = ring.samples();
        assert!((0..4).all(|i| held.arrival[i][1] == held.log_stretch[i] && held.jacobian[i][8] == held.log_stretch[i]));
        ring.push(&numbered(6..8));
        assert_eq!((ring.len(), ring.samples().arrival.len()), (2, 0));
    }
}
