//! Upload queue of snapshots. Snapshots that a window needs now come first. Those of later windows follow, in the order in which they are read.

use ridgewatch_field::Snapshot;
use std::collections::VecDeque;
use std::sync::{Arc, Weak};

/// Snapshots to upload, and the device copies `T` of those that are uploaded but not yet taken by a window.
#[derive(Debug)]
pub(super) struct PrefetchQueue<T> {
    entries: VecDeque<Entry<T>>,
}

#[derive(Debug)]
struct Entry<T> {
    /// Weak, so that the queue does not keep a snapshot alive that no window needs any more.
    host: Weak<Snapshot>,
    is_needed: bool,
    stage: Stage<T>,
}

#[derive(Debug)]
enum Stage<T> {
    Waiting,
    Uploading,
    Uploaded(Arc<T>),
}

impl<T> Default for PrefetchQueue<T> {
    fn default() -> Self {
        Self { entries: VecDeque::new() }
    }
}

impl<T> PrefetchQueue<T> {
    /// Adds a snapshot that will be needed after all that were added before.
    pub(super) fn expect(&mut self, snapshot: &Arc<Snapshot>) {
        self.entries.retain(|e| !matches!(e.stage, Stage::Waiting) || e.host.strong_count() > 0);
        self.entries.push_back(Entry { host: Arc::downgrade(snapshot), is_needed: false, stage: Stage::Waiting });
    }

    /// Moves a snapshot that a window needs now before all others.
    pub(super) fn need(&mut self, snapshot: &Arc<Snapshot>) {
        match self.find(snapshot) {
            Some(at) => self.entries[at].is_needed = true,
            None => {
                let at = self.entries.iter().position(|e| !e.is_needed).unwrap_or(self.entries.len());
                self.entries.insert(at, Entry { host: Arc::downgrade(snapshot), is_needed: true, stage: Stage::Waiting });
            }
        }
    }

    /// Starts the upload of the next needed snapshot. `None` if no needed snapshot waits.
    pub(super) fn next_needed(&mut self) -> Option<Arc<Snapshot>> {
        self.begin(|e| e.is_needed)
    }

    /// Starts the upload of the next expected snapshot. `None` if `most` of them are uploaded or uploading, if the next one does not fit, or if no
    /// snapshot waits.
    pub(super) fn next_early(&mut self, most: usize, fits: impl Fn(&Snapshot) -> bool) -> Option<Arc<Snapshot>> {
        if self.entries.iter().filter(|e| !e.is_needed && !matches!(e.stage, Stage::Waiting)).count() >= most {
            return None;
        }
        let mut waiting = self.entries.iter().filter(|e| !e.is_needed && matches!(e.stage, Stage::Waiting));
        let first = waiting.find_map(|e| e.host.upgrade())?;
        if fits(&first) { self.begin(|e| std::ptr::eq(e.host.as_ptr(), Arc::as_ptr(&first))) } else { None }
    }

    fn begin(&mut self, which: impl Fn(&Entry<T>) -> bool) -> Option<Arc<Snapshot>> {
        let waiting = self.entries.iter_mut().filter(|e| matches!(e.stage, Stage::Waiting) && which(e));
        let (entry, snapshot) = waiting.filter_map(|e| e.host.upgrade().map(|s| (e, s))).next()?;
        entry.stage = Stage::Uploading;
        Some(snapshot)
    }

    /// Ends the upload of a snapshot. If `uploaded` is `None`, the upload failed, and the snapshot is removed.
    pub(super) fn end(&mut self, snapshot: &Arc<Snapshot>, uploaded: Option<Arc<T>>) {
        let Some(at) = self.find(snapshot) else { return };
        match uploaded {
            Some(uploaded) => self.entries[at].stage = Stage::Uploaded(uploaded),
            None => drop(self.entries.remove(at)),
        }
    }

    /// Returns true while a snapshot is being uploaded.
    pub(super) fn is_uploading(&self, snapshot: &Arc<Snapshot>) -> bool {
        self.find(snapshot).is_some_and(|at| matches!(self.entries[at].stage, Stage::Uploading))
    }

    /// Takes the uploaded snapshots of a window. Entries before the newest of them are removed, because the window has passed them.
    pub(super) fn take(&mut self, window: &[&Arc<Snapshot>]) -> Vec<Arc<T>> {
        let wanted = |e: &Entry<T>| window.iter().any(|s| std::ptr::eq(e.host.as_ptr(), Arc::as_ptr(s)));
        let count = self.entries.iter().rposition(wanted).map_or(0, |last| last + 1);
        let taken = self.entries.drain(..count).filter(wanted);
        taken.filter_map(|e| if let Stage::Uploaded(uploaded) = e.stage { Some(uploaded) } else { None }).collect()
    }

    /// Drops the uploaded copies to free device memory. Their snapshots wait again.
    pub(super) fn release(&mut self) {
        self.entries.iter_mut().filter(|e| matches!(e.stage, Stage::Uploaded(_))).for_each(|e| e.stage = Stage::Waiting);
    }

    fn find(&self, snapshot: &Arc<Snapshot>) -> Option<usize> {
        self.entries.iter().position(|e| std::ptr::eq(e.host.as_ptr(), Arc::as_ptr(snapshot)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use ridgewatch_field::{Axis, Geometry, Grid};

    fn snapshots(count: usize) -> Vec<Arc<Snapshot>> {
        let axis = |name| Axis::uniform(name, "", 0.0, 1.0, 2).unwrap();
        let grid = Arc::new(Grid { axes: vec![axis("x"), axis("y")], geometry: Geometry::Cartesian, slab: (0.0, 1.0) });
        (0..count).map(|t| Arc::new(Snapshot::new(t as f64, grid.clone(), vec![[0.0; 4]; 4]))).collect()
    }

    fn upload(queue: &mut PrefetchQueue<f64>) -> Option<f64> {
        let next = queue.next_early(2, |_| true)?;
        queue.end(&next, Some(Arc::new(next.time)));
        Some(next.time)
    }

    #[test]
    fn the_next_two_come_over_in_order_and_a_slide_takes_the_first() {
        let s = snapshots(5);
        let mut queue = PrefetchQueue::default();
        s.iter().for_each(|s| queue.expect(s));
        assert!(queue.next_early(2, |_| false).is_none(), "what does not fit stays");
        assert_eq!((upload(&mut queue), upload(&mut queue), upload(&mut queue)), (Some(0.0), Some(1.0), None));
        let taken = queue.take(&[&s[0]]);
        assert_eq!(taken.len(), 1);
        assert_eq!(*taken[0], 0.0);
        assert_eq!(upload(&mut queue), Some(2.0), "there is room again");
        // A window that needs the fourth has passed the second and the third, and uploads the fourth itself.
        assert!(queue.take(&[&s[0], &s[3]]).is_empty());
        assert_eq!(upload(&mut queue), Some(4.0));
        assert_eq!(queue.take(&[&s[3], &s[4]]).len(), 1);
    }

    #[test]
    fn one_on_its_way_is_waited_for_and_one_that_fails_is_not() {
        let s = snapshots(2);
        let mut queue = PrefetchQueue::<f64>::default();
        s.iter().for_each(|s| queue.expect(s));
        let first = queue.next_early(2, |_| true).unwrap();
        assert!(queue.is_uploading(&s[0]) && !queue.is_uploading(&s[1]));
        queue.end(&first, None);
        assert!(!queue.is_uploading(&s[0]));
        assert_eq!(upload(&mut queue), Some(1.0));
        queue.release();
        assert_eq!(upload(&mut queue), Some(1.0), "let go, it comes again");
        // The window passes the first during its upload: the copy is not kept.
        let s = snapshots(2);
        let mut queue = PrefetchQueue::<f64>::default();
        s.iter().for_each(|s| queue.expect(s));
        let first = queue.next_early(1, |_| true).unwrap();
        assert!(queue.take(&[&s[1]]).is_empty());
        queue.end(&first, Some(Arc::new(0.0)));
        assert!(queue.entries.is_empty());
    }

    #[test]
    fn what_nobody_holds_any_more_is_forgotten() {
        let mut s = snapshots(3);
        let mut queue = PrefetchQueue::<f64>::default();
        s.iter().for_each(|s| queue.expect(s));
        let kept = s.pop().unwrap();
        s.clear();
        assert_eq!(upload(&mut queue), Some(2.0));
        queue.expect(&kept);
        assert_eq!(queue.entries.len(), 2, "the dead ones are gone");
    }

    #[test]
    fn what_a_window_needs_comes_before_what_is_expected() {
        let s = snapshots(4);
        let mut queue = PrefetchQueue::<f64>::default();
        s[..3].iter().for_each(|s| queue.expect(s));
        queue.need(&s[2]);
        queue.need(&s[3]);
        let needed: Vec<f64> = std::iter::from_fn(|| queue.next_needed()).map(|s| s.time).collect();
        assert_eq!(needed, [3.0, 2.0], "one that was not expected is needed all the same");
        queue.end(&s[2], Some(Arc::new(2.0)));
        queue.end(&s[3], None);
        assert_eq!(queue.take(&[&s[2], &s[3]]).len(), 1, "one that failed is not there");
    }
}
