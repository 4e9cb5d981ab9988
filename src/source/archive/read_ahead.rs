//! The I/O thread, which reads ahead into a bounded channel, and waits for further snapshots if the source is followed.

use crate::error::SourceError;
use crate::snapshots::{Listener, News, SnapshotSource, StillReading};
use ridgewatch_field::Snapshot;
use std::ops::Range;
use std::sync::atomic::{AtomicBool, AtomicU64, AtomicUsize, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError, sync_channel};
use std::sync::{Arc, Mutex, OnceLock, PoisonError};
use std::time::{Duration, Instant};

/// Default capacity of the channel.
pub const DEFAULT_READ_AHEAD: usize = 2;

/// Time between two looks for further snapshots.
const LOOK: Duration = Duration::from_secs(1);
/// Time within which a thread that waits notices that nobody reads any more.
const NOTICE: Duration = Duration::from_millis(50);

/// What the thread and its reader share.
#[derive(Default)]
struct Shared {
    reading_nanoseconds: AtomicU64,
    listener: OnceLock<Listener>,
    /// Snapshots that are known.
    count: AtomicUsize,
    /// True while further ones may come.
    is_followed: AtomicBool,
    /// True once the thread has ended, or panicked.
    has_ended: AtomicBool,
    /// True once nobody reads any more.
    is_dropped: AtomicBool,
    /// What the looks found since it was asked for.
    news: Mutex<News>,
}

/// Snapshots in time order, read ahead by a thread. Dropping it ends the thread after the current read.
pub struct ReadAhead {
    receiver: Receiver<Result<Arc<Snapshot>, SourceError>>,
    returned: usize,
    waited: Duration,
    shared: Arc<Shared>,
    /// Error of a thread that could not start; returned once.
    failed: Option<SourceError>,
    ended: bool,
}

/// Starts reading snapshots `range` (clipped to the existing ones) on a thread named `ridgewatch-io`. At most `capacity` snapshots
/// (at least one) wait in the channel; the thread holds one more. A snapshot that cannot be read yields an error, and reading
/// continues with the next.
pub fn read_ahead(source: Box<dyn SnapshotSource>, range: Range<usize>, capacity: usize) -> ReadAhead {
    start(source, range, capacity, None)
}

/// The same of all snapshots, and of those that come later: reading ends when none has come for `longest`.
pub fn follow(source: Box<dyn SnapshotSource>, capacity: usize, longest: Duration) -> ReadAhead {
    start(source, 0..usize::MAX, capacity, Some(longest))
}

fn start(mut source: Box<dyn SnapshotSource>, range: Range<usize>, capacity: usize, longest: Option<Duration>) -> ReadAhead {
    let mut range = range.start..range.end.min(source.times().len());
    let (sender, receiver) = sync_channel(capacity.max(1));
    let shared =
        Arc::new(Shared { count: AtomicUsize::new(range.len()), is_followed: AtomicBool::new(longest.is_some()), ..Shared::default() });
    let own = shared.clone();
    let count = range.len();
    let work = move || {
        let _ended = Ended(own.clone());
        loop {
            for index in range.clone() {
                let begin = Instant::now();
                let read = source.read(index).map(Arc::new);
                own.reading_nanoseconds.fetch_add(begin.elapsed().as_nanos() as u64, Ordering::Relaxed);
                if let (Ok(snapshot), Some(tell)) = (&read, own.listener.get()) {
                    tell(snapshot);
                }
                // The receiver was dropped.
                if sender.send(read).is_err() {
                    return;
                }
            }
            match longest.and_then(|longest| own.wait_for_more(&mut *source, longest)) {
                Some(more) => range = range.end..range.end + more,
                None => break,
            }
        }
        // Before the channel closes: this is an end, and no panic.
        own.is_followed.store(false, Ordering::Release);
    };
    let failed = std::thread::Builder::new().name("ridgewatch-io".into()).spawn(work).err().map(|e| SourceError::ReaderStopped {
        index: 0,
        count,
        what: format!("it could not start: {e}"),
    });
    ReadAhead { receiver, returned: 0, waited: Duration::ZERO, shared, failed, ended: false }
}

/// Says that the thread ends, in a panic too.
struct Ended(Arc<Shared>);

impl Drop for Ended {
    fn drop(&mut self) {
        self.0.has_ended.store(true, Ordering::Release);
    }
}

impl Shared {
    /// Looks for further snapshots until there are some, and returns their number; `None` after `longest`, or once nobody reads.
    fn wait_for_more(&self, source: &mut dyn SnapshotSource, longest: Duration) -> Option<usize> {
        let begin = Instant::now();
        loop {
            let found = source.look();
            let more = found.dates.len();
            let mut news = self.news.lock().unwrap_or_else(PoisonError::into_inner);
            news.dates.extend(found.dates);
            news.warnings.extend(found.warnings);
            drop(news);
            if more > 0 {
                self.count.fetch_add(more, Ordering::Release);
                return Some(more);
            }
            let looked = Instant::now();
            while looked.elapsed() < LOOK {
                if self.is_dropped.load(Ordering::Relaxed) || begin.elapsed() >= longest {
                    return None;
                }
                std::thread::sleep(NOTICE.min(longest));
            }
        }
    }
}

impl Drop for ReadAhead {
    fn drop(&mut self) {
        self.shared.is_dropped.store(true, Ordering::Relaxed);
    }
}

impl ReadAhead {
    /// Time that the caller has waited for snapshots.
    pub fn waited(&self) -> Duration {
        self.waited
    }

    /// Time that the thread has spent reading.
    pub fn reading(&self) -> Duration {
        Duration::from_nanos(self.shared.reading_nanoseconds.load(Ordering::Relaxed))
    }

    /// The next snapshot; `None` at the end. Waits for at most `limit`.
    ///
    /// # Errors
    /// The snapshot is still being read: ask again.
    pub fn next_within(&mut self, limit: Duration) -> Result<Option<Result<Arc<Snapshot>, SourceError>>, StillReading> {
        if self.remaining() == 0 && !self.is_followed() {
            return Ok(None);
        }
        if let Some(error) = self.failed.take() {
            self.ended = true;
            return Ok(Some(Err(error)));
        }
        let begin = Instant::now();
        let received = self.receiver.recv_timeout(limit);
        self.waited += begin.elapsed();
        match received {
            Ok(snapshot) => {
                self.returned += 1;
                Ok(Some(snapshot))
            }
            Err(RecvTimeoutError::Timeout) => Err(StillReading),
            Err(RecvTimeoutError::Disconnected) if self.remaining() == 0 && !self.is_followed() => Ok(None),
            Err(RecvTimeoutError::Disconnected) => {
                self.ended = true;
                let count = self.shared.count.load(Ordering::Acquire);
                Ok(Some(Err(SourceError::ReaderStopped { index: self.returned, count, what: "it panicked".into() })))
            }
        }
    }

    /// Sets the listener, which is called with each snapshot before it is returned. A second call has no effect.
    pub fn tell(&self, listener: Listener) {
        // The first listener receives all snapshots already.
        let _ = self.shared.listener.set(listener);
    }

    /// Number of snapshots still to come, of those that are known.
    pub fn remaining(&self) -> usize {
        if self.ended { 0 } else { self.shared.count.load(Ordering::Acquire) - self.returned }
    }

    /// True while snapshots may come that are not known yet.
    pub fn is_followed(&self) -> bool {
        !self.ended && self.shared.is_followed.load(Ordering::Acquire)
    }

    /// True while this many snapshots are neither known nor known not to come.
    pub fn is_waiting_for(&self, count: usize) -> bool {
        self.is_followed() && !self.shared.has_ended.load(Ordering::Acquire) && self.remaining() < count
    }

    /// What has come since this was asked last.
    pub fn news(&self) -> News {
        std::mem::take(&mut *self.shared.news.lock().unwrap_or_else(PoisonError::into_inner))
    }
}

impl Iterator for ReadAhead {
    type Item = Result<Arc<Snapshot>, SourceError>;

    /// The next snapshot; waits until it is read.
    fn next(&mut self) -> Option<Self::Item> {
        loop {
            // Any limit serves: the loop waits on.
            if let Ok(next) = self.next_within(Duration::from_secs(3600)) {
                return next;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::archive::memory::MemorySource;
    use ridgewatch_field::{Axis, Geometry, Grid};

    fn source(count: usize, made: Arc<AtomicUsize>, panic_at: usize) -> Box<dyn SnapshotSource> {
        let axis = |n| Axis::uniform(n, "m", 0.0, 1.0, 2).unwrap();
        let grid = Arc::new(Grid { axes: vec![axis("x"), axis("y")], geometry: Geometry::Cartesian, slab: (0.0, 1.0) });
        let on = grid.clone();
        let make = move |i: usize, time: f64| {
            assert!(i != panic_at, "wanted by the test");
            made.fetch_add(1, Ordering::SeqCst);
            Snapshot::from_components(time, on.clone(), &[i as f32; 4], &[0.0; 4], &[])
        };
        Box::new(MemorySource::new("test", grid, (0..count).map(|i| i as f64).collect(), make).unwrap())
    }

    /// Waits until `made` is `count` or a minute went by, then a little longer to see whether more come.
    fn settled(made: &AtomicUsize, count: usize) -> usize {
        let begin = Instant::now();
        while made.load(Ordering::SeqCst) < count && begin.elapsed() < Duration::from_secs(60) {
            std::thread::sleep(Duration::from_millis(1));
        }
        std::thread::sleep(Duration::from_millis(30));
        made.load(Ordering::SeqCst)
    }

    #[test]
    fn all_come_in_order() {
        let mut reader = read_ahead(source(20, Arc::default(), 99), 5..30, 2);
        assert_eq!(reader.remaining(), 15);
        let times: Vec<f64> = reader.by_ref().map(|s| s.unwrap().time).collect();
        assert_eq!(times, (5..20).map(f64::from).collect::<Vec<_>>());
        assert!(reader.next().is_none() && reader.reading() > Duration::ZERO);
    }

    #[test]
    fn a_listener_hears_of_what_is_read_before_it_is_given() {
        let made = Arc::new(AtomicUsize::new(0));
        let mut reader = read_ahead(source(30, made.clone(), 99), 0..30, 2);
        // Two wait and one is in hand: the thread stands still until the first is taken.
        assert_eq!(settled(&made, 3), 3);
        let heard = Arc::new(std::sync::Mutex::new(Vec::new()));
        let hears = heard.clone();
        reader.tell(Box::new(move |snapshot| hears.lock().unwrap().push(snapshot.time)));
        for (index, snapshot) in reader.by_ref().enumerate() {
            let time = snapshot.unwrap().time;
            assert!(index < 3 || heard.lock().unwrap().contains(&time), "snapshot {time} was given unannounced");
        }
        assert_eq!(*heard.lock().unwrap(), (3..30).map(f64::from).collect::<Vec<_>>(), "those read from then on, once each, in order");
    }

    #[test]
    fn memory_is_bounded_and_dropping_ends_the_thread() {
        let made = Arc::new(AtomicUsize::new(0));
        let mut reader = read_ahead(source(1000, made.clone(), 9999), 0..1000, 3);
        reader.next().unwrap().unwrap();
        // One taken, three waiting, one in hand.
        assert_eq!(settled(&made, 5), 5);
        drop(reader);
        // The closure holds the other count until the thread ends.
        let begin = Instant::now();
        while Arc::strong_count(&made) > 1 {
            assert!(begin.elapsed() < Duration::from_secs(60), "the thread is still there");
            std::thread::sleep(Duration::from_millis(1));
        }
        assert_eq!(made.load(Ordering::SeqCst), 5);
    }

    #[test]
    fn a_panicking_source_is_an_error() {
        let mut reader = read_ahead(source(5, Arc::default(), 2), 0..5, 1);
        assert!(reader.next().unwrap().is_ok() && reader.next().unwrap().is_ok());
        let message = reader.next().unwrap().unwrap_err().to_string();
        assert!(message.contains("before snapshot 2 of 5"), "{message}");
        assert!(reader.next().is_none());
    }
}
