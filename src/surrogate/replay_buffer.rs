//! Bounded buffer of traced samples. New samples replace the oldest. When the window slides, the labels become stale and are not used until
//! a test of some of them confirms that they still hold.

use super::network::draw;
use super::{Samples, fresh_stamp};
use std::ops::Range;

/// Minimum share of re-traced labels that must still hold for stale labels to be used again. Errors as large as the test's tolerance in one of
/// twenty samples add less to the loss than the tolerance itself.
pub const KEEP_STALE: f64 = 0.95;

/// State of a buffer at the time of a copy.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct BufferMark {
    epoch: u64,
    pushed: u64,
}

/// Newest samples, at most `capacity`, stale ones included.
#[derive(Debug)]
pub struct ReplayBuffer {
    capacity: usize,
    /// Labels of the present window. Circular once full.
    fresh: Samples,
    /// Index of the next fresh sample in a full buffer.
    next: usize,
    /// Labels of an earlier window.
    stale: Samples,
    pushed: u64,
    /// Unique number, replaced whenever samples are moved.
    epoch: u64,
    /// Unit times of samples without their own times; `None` if times are not used.
    now: Option<[f32; 2]>,
}

impl ReplayBuffer {
    /// Creates an empty buffer for at least one sample.
    pub fn new(capacity: usize) -> Self {
        let empty = Samples::default();
        Self { capacity: capacity.max(1), fresh: empty.clone(), next: 0, stale: empty, pushed: 0, epoch: fresh_stamp(), now: None }
    }

    /// Creates a full buffer of these samples.
    pub fn holding(samples: &Samples) -> Self {
        let mut buffer = Self::new(samples.len());
        buffer.push(samples);
        buffer
    }

    /// Sets the unit times of samples that are pushed without times. From now on every sample is stored with its times.
    pub fn set_now(&mut self, times: [f32; 2]) {
        self.now = Some(times);
    }

    /// Present state of the buffer, for [`ReplayBuffer::written_since`].
    pub fn mark(&self) -> BufferMark {
        BufferMark { epoch: self.epoch, pushed: self.pushed }
    }

    /// True if no sample has moved since `mark`.
    pub fn continues(&self, mark: BufferMark) -> bool {
        mark.epoch == self.epoch
    }

    /// Index ranges of [`ReplayBuffer::samples`] written since `mark`; all indices if samples have moved since, or without a mark.
    pub fn written_since(&self, mark: Option<BufferMark>) -> [Range<usize>; 2] {
        let len = self.len();
        let fresh = match mark {
            Some(mark) if self.continues(mark) => usize::try_from(self.pushed - mark.pushed).map_or(len, |fresh| fresh.min(len)),
            _ => len,
        };
        // The newest sample is before `end`; the buffer is circular.
        let end = if len < self.capacity { len } else { self.next };
        if fresh <= end { [end - fresh..end, 0..0] } else { [len - (fresh - end)..len, 0..end] }
    }

    /// Maximum number of samples.
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

    /// True if there are no samples for training.
    pub fn is_empty(&self) -> bool {
        self.fresh.is_empty()
    }

    /// Number of stale samples.
    pub fn stale(&self) -> &Samples {
        &self.stale
    }

    /// Number of samples pushed so far.
    pub fn pushed(&self) -> u64 {
        self.pushed
    }

    /// Adds samples. Stale samples are replaced first, then the oldest fresh ones. Arrivals and Jacobians are kept only if every sample has them: a
    /// push that differs in this from the buffer clears it first.
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
        let mut first = samples.len().saturating_sub(self.capacity);
        let room = (self.capacity - self.fresh.len()).min(samples.len() - first);
        append(&mut self.fresh, samples, first..first + room, self.now);
        first += room;
        while first < samples.len() {
            let part = (samples.len() - first).min(self.capacity - self.next);
            overwrite(&mut self.fresh, self.next, samples, first..first + part, self.now);
            self.next = (self.next + part) % self.capacity;
            first += part;
        }
        let room = self.capacity - self.fresh.len();
        self.stale.points.truncate(room);
        self.stale.log_stretch.truncate(room);
        self.stale.arrival.truncate(room);
        self.stale.jacobian.truncate(room);
        self.stale.times.truncate(room);
    }

    /// Marks all labels as stale, since the window has slid. Labels that were stale before are dropped.
    pub fn mark_stale(&mut self) {
        self.stale = std::mem::take(&mut self.fresh);
        self.next = 0;
        self.epoch = fresh_stamp();
    }

    /// Indices of up to `count` samples to trace again before they are marked stale, drawn with repetition from seed and counter.
    pub fn probe(&self, count: usize, seed: u64, counter: u64) -> Vec<usize> {
        let len = self.len();
        (0..count.min(len)).map(|i| draw(seed, counter + i as u64, len)).collect()
    }

    /// Decides on the stale labels by the share of probed labels that still hold. From [`KEEP_STALE`] on they are used again (as many as fit), below
    /// it they are dropped. Returns true if they were kept.
    pub fn revalidate(&mut self, share_holding: f64) -> bool {
        let stale = std::mem::take(&mut self.stale);
        let same = self.fresh.is_empty() || shape(&self.fresh) == shape(&stale);
        let keep = share_holding >= KEEP_STALE && same && !stale.is_empty();
        if !keep {
            return false;
        }
        let room = (self.capacity - self.fresh.len()).min(stale.len());
        append(&mut self.fresh, &stale, 0..room, None);
        self.epoch = fresh_stamp();
        true
    }
}

fn shape(samples: &Samples) -> [bool; 2] {
    [samples.arrival.len() == samples.len(), samples.jacobian.len() == samples.len()]
}

/// Log-stretches of samples that have some; NaN for others, whose arrivals are their labels.
fn log_stretches(of: &Samples, range: Range<usize>) -> impl Iterator<Item = f32> {
    range.map(|index| of.log_stretch.get(index).copied().unwrap_or(f32::NAN))
}

fn append(to: &mut Samples, from: &Samples, range: Range<usize>, now: Option<[f32; 2]>) {
    to.points.extend_from_slice(&from.points[range.clone()]);
    to.log_stretch.extend(log_stretches(from, range.clone()));
    to.arrival.extend_from_slice(from.arrival.get(range.clone()).unwrap_or_default());
    to.jacobian.extend_from_slice(from.jacobian.get(range.clone()).unwrap_or_default());
    match (from.times.get(range.clone()), now) {
        (Some(times), _) if !from.times.is_empty() => to.times.extend_from_slice(times),
        (_, Some(now)) => to.times.extend(std::iter::repeat_n(now, range.len())),
        _ => {}
    }
}

fn overwrite(to: &mut Samples, at: usize, from: &Samples, range: Range<usize>, now: Option<[f32; 2]>) {
    /// Nothing where one of them has none.
    fn put<T: Copy>(to: &mut [T], into: &Range<usize>, from: &[T], range: &Range<usize>) {
        if let (Some(to), Some(from)) = (to.get_mut(into.clone()), from.get(range.clone())) {
            to.copy_from_slice(from);
        }
    }
    let into = at..at + range.len();
    put(&mut to.points, &into, &from.points, &range);
    to.log_stretch[into.clone()].iter_mut().zip(log_stretches(from, range.clone())).for_each(|(to, from)| *to = from);
    put(&mut to.arrival, &into, &from.arrival, &range);
    put(&mut to.jacobian, &into, &from.jacobian, &range);
    put(&mut to.times, &into, &from.times, &range);
    if let (true, Some(now), Some(times)) = (from.times.is_empty(), now, to.times.get_mut(into)) {
        times.fill(now);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use ridgewatch_field::UnitPoint;

    fn numbered(range: std::ops::Range<u32>) -> Samples {
        Samples {
            points: range.clone().map(|i| UnitPoint([i as f32, 0.0, 0.0])).collect(),
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
        let mut buffer = ReplayBuffer::new(10);
        buffer.push(&numbered(0..7));
        buffer.push(&numbered(7..13));
        assert_eq!(labels(buffer.samples()), (3..13).collect::<Vec<_>>());
        buffer.push(&numbered(100..125));
        assert_eq!(labels(buffer.samples()), (115..125).collect::<Vec<_>>());
        assert_eq!((buffer.len(), buffer.pushed()), (10, 38));
        assert!(buffer.samples().points.iter().zip(&buffer.samples().log_stretch).all(|(p, s)| p.0[0] == *s));
    }

    #[test]
    fn stale_labels_are_not_drawn_until_they_are_shown_to_hold() {
        let half_stale = || {
            let mut buffer = ReplayBuffer::new(10);
            buffer.push(&numbered(0..8));
            buffer.mark_stale();
            assert!(buffer.is_empty() && buffer.stale().len() == 8);
            buffer.push(&numbered(50..55));
            buffer
        };
        // Capacity ten: five fresh samples replace three of the eight stale ones.
        let (mut buffer, mut dropped) = (half_stale(), half_stale());
        assert_eq!((buffer.len(), buffer.stale().len()), (5, 5));
        assert_eq!(labels(buffer.samples()), (50..55).collect::<Vec<_>>());
        assert_eq!(buffer.probe(100, 1, 0).len(), 5);
        assert!(!dropped.revalidate(0.94));
        assert_eq!((dropped.len(), dropped.stale().len()), (5, 0));
        assert!(buffer.revalidate(0.96));
        assert_eq!(buffer.len(), 10);
    }

    #[test]
    fn a_copy_that_takes_what_was_written_stays_a_copy() {
        let mut buffer = ReplayBuffer::new(10);
        let (mut copy, mut mark, mut next) = (Vec::new(), None, 0);
        for count in [0, 3, 4, 5, 10, 1, 9, 25, 7] {
            buffer.push(&numbered(next..next + count));
            next += count;
            copy.resize(buffer.len(), f32::NAN);
            let ranges = buffer.written_since(mark);
            assert!(ranges.iter().map(ExactSizeIterator::len).sum::<usize>() <= count as usize, "nothing is taken twice");
            for range in ranges {
                copy[range.clone()].copy_from_slice(&buffer.samples().log_stretch[range]);
            }
            assert_eq!(copy, buffer.samples().log_stretch, "after {next}");
            mark = Some(buffer.mark());
        }
        buffer.mark_stale();
        buffer.push(&numbered(90..92));
        buffer.revalidate(1.0);
        assert_eq!((buffer.len(), buffer.written_since(mark)), (10, [0..10, 0..0]), "all were moved");
        assert_ne!(ReplayBuffer::new(10).mark(), ReplayBuffer::new(10).mark(), "two rings are never the same");
    }

    #[test]
    fn flow_map_labels_travel_along() {
        let mut buffer = ReplayBuffer::new(4);
        let mut samples = numbered(0..6);
        samples.arrival = (0..6).map(|i| UnitPoint([i as f32; 3])).collect();
        samples.jacobian = (0..6).map(|i| [i as f32; 9]).collect();
        buffer.push(&samples);
        buffer.push(&samples);
        let held = buffer.samples();
        assert!((0..4).all(|i| held.arrival[i].0[1] == held.log_stretch[i] && held.jacobian[i][8] == held.log_stretch[i]));
        buffer.push(&numbered(6..8));
        assert_eq!((buffer.len(), buffer.samples().arrival.len()), (2, 0));
    }
}
