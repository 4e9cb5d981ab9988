//! Which snapshots come over before a window asks for them: the bookkeeping, in the order of reading.

use crate::field::Snapshot;
use std::collections::VecDeque;
use std::sync::{Arc, Weak};

/// Snapshots that are expected, and what `T` holds of those that came over.
#[derive(Debug)]
pub(in crate::backend::cuda) struct PrefetchQueue<T> {
    entries: VecDeque<Entry<T>>,
}

#[derive(Debug)]
struct Entry<T> {
    /// Weak, so that what nobody wants after all is not kept for it.
    host: Weak<Snapshot>,
    stage: Stage<T>,
}

#[derive(Debug)]
enum Stage<T> {
    Waiting,
    OnTheWay,
    There(Arc<T>),
}

impl<T> Default for PrefetchQueue<T> {
    fn default() -> Self {
        Self { entries: VecDeque::new() }
    }
}

impl<T> PrefetchQueue<T> {
    /// One that will be wanted after all that were expected before.
    pub(in crate::backend::cuda) fn expect(&mut self, snapshot: &Arc<Snapshot>) {
        self.entries.retain(|e| !matches!(e.stage, Stage::Waiting) || e.host.strong_count() > 0);
        self.entries.push_back(Entry { host: Arc::downgrade(snapshot), stage: Stage::Waiting });
    }

    /// The next one to bring, when fewer than `most` are there or on the way and it fits; it then is on its way.
    pub(in crate::backend::cuda) fn next(&mut self, most: usize, fits: impl Fn(&Snapshot) -> bool) -> Option<Arc<Snapshot>> {
        if self.entries.iter().filter(|e| !matches!(e.stage, Stage::Waiting)).count() >= most {
            return None;
        }
        let waiting = self.entries.iter_mut().filter(|e| matches!(e.stage, Stage::Waiting));
        let (entry, snapshot) = waiting.filter_map(|e| e.host.upgrade().map(|s| (e, s))).next()?;
        if !fits(&snapshot) {
            return None;
        }
        entry.stage = Stage::OnTheWay;
        Some(snapshot)
    }

    /// What became of one that was on its way; none: whoever wants it brings it himself.
    pub(in crate::backend::cuda) fn arrived(&mut self, snapshot: &Arc<Snapshot>, there: Option<Arc<T>>) {
        let Some(at) = self.find(snapshot) else { return };
        match there {
            Some(there) => self.entries[at].stage = Stage::There(there),
            None => drop(self.entries.remove(at)),
        }
    }

    /// Whether it is worth waiting for.
    pub(in crate::backend::cuda) fn is_on_the_way(&self, snapshot: &Arc<Snapshot>) -> bool {
        self.find(snapshot).is_some_and(|at| matches!(self.entries[at].stage, Stage::OnTheWay))
    }

    /// What is there of a window's snapshots. Everything that was expected before the newest of them is forgotten: what the window has
    /// not taken by then, it never will.
    pub(in crate::backend::cuda) fn take(&mut self, window: &[&Arc<Snapshot>]) -> Vec<Arc<T>> {
        let wanted = |e: &Entry<T>| window.iter().any(|s| std::ptr::eq(e.host.as_ptr(), Arc::as_ptr(s)));
        let count = self.entries.iter().rposition(wanted).map_or(0, |last| last + 1);
        let taken = self.entries.drain(..count).filter(wanted);
        taken.filter_map(|e| if let Stage::There(there) = e.stage { Some(there) } else { None }).collect()
    }

    /// Lets go of what is there; it comes over again in its turn.
    pub(in crate::backend::cuda) fn let_go(&mut self) {
        self.entries.iter_mut().filter(|e| matches!(e.stage, Stage::There(_))).for_each(|e| e.stage = Stage::Waiting);
    }

    fn find(&self, snapshot: &Arc<Snapshot>) -> Option<usize> {
        self.entries.iter().position(|e| std::ptr::eq(e.host.as_ptr(), Arc::as_ptr(snapshot)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::field::{Axis, Geometry, Grid};

    fn snapshots(count: usize) -> Vec<Arc<Snapshot>> {
        let axis = |name| Axis::uniform(name, "", 0.0, 1.0, 2).unwrap();
        let grid = Arc::new(Grid { axes: vec![axis("x"), axis("y")], geometry: Geometry::Cartesian, slab: (0.0, 1.0) });
        (0..count).map(|t| Arc::new(Snapshot::new(t as f64, grid.clone(), vec![[0.0; 4]; 4]))).collect()
    }

    fn bring(ahead: &mut PrefetchQueue<f64>) -> Option<f64> {
        let next = ahead.next(2, |_| true)?;
        ahead.arrived(&next, Some(Arc::new(next.time)));
        Some(next.time)
    }

    #[test]
    fn the_next_two_come_over_in_order_and_a_slide_takes_the_first() {
        let s = snapshots(5);
        let mut ahead = PrefetchQueue::default();
        s.iter().for_each(|s| ahead.expect(s));
        assert!(ahead.next(2, |_| false).is_none(), "what does not fit stays");
        assert_eq!((bring(&mut ahead), bring(&mut ahead), bring(&mut ahead)), (Some(0.0), Some(1.0), None));
        let taken = ahead.take(&[&s[0]]);
        assert_eq!(taken.len(), 1);
        assert_eq!(*taken[0], 0.0);
        assert_eq!(bring(&mut ahead), Some(2.0), "there is room again");
        // A window that wants the fourth has passed the second and the third by, and brings the fourth itself.
        assert!(ahead.take(&[&s[0], &s[3]]).is_empty());
        assert_eq!(bring(&mut ahead), Some(4.0));
        assert_eq!(ahead.take(&[&s[3], &s[4]]).len(), 1);
    }

    #[test]
    fn one_on_its_way_is_waited_for_and_one_that_fails_is_not() {
        let s = snapshots(2);
        let mut ahead = PrefetchQueue::<f64>::default();
        s.iter().for_each(|s| ahead.expect(s));
        let first = ahead.next(2, |_| true).unwrap();
        assert!(ahead.is_on_the_way(&s[0]) && !ahead.is_on_the_way(&s[1]));
        ahead.arrived(&first, None);
        assert!(!ahead.is_on_the_way(&s[0]));
        assert_eq!(bring(&mut ahead), Some(1.0));
        ahead.let_go();
        assert_eq!(bring(&mut ahead), Some(1.0), "let go, it comes again");
        // Passed by while on its way: what arrives is not kept.
        let s = snapshots(2);
        let mut ahead = PrefetchQueue::<f64>::default();
        s.iter().for_each(|s| ahead.expect(s));
        let first = ahead.next(1, |_| true).unwrap();
        assert!(ahead.take(&[&s[1]]).is_empty());
        ahead.arrived(&first, Some(Arc::new(0.0)));
        assert!(ahead.entries.is_empty());
    }

    #[test]
    fn what_nobody_holds_any_more_is_forgotten() {
        let mut s = snapshots(3);
        let mut ahead = PrefetchQueue::<f64>::default();
        s.iter().for_each(|s| ahead.expect(s));
        let kept = s.pop().unwrap();
        s.clear();
        assert_eq!(bring(&mut ahead), Some(2.0));
        ahead.expect(&kept);
        assert_eq!(ahead.entries.len(), 2, "the dead ones are gone");
    }
}
