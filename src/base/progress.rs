//! Signs of progress of this process, for whoever watches that it does not hang: work that takes long, and loops that wait, leave a mark
//! several times a minute. Work that knows how much of it is done tells so, for people.

use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

static MARKS: AtomicU64 = AtomicU64::new(0);

/// Leaves a mark. Costs nothing beside any work; threads that would leave millions a second leave some of them.
pub fn mark() {
    MARKS.fetch_add(1, Ordering::Relaxed);
}

/// Number of marks so far.
pub fn marks() -> u64 {
    MARKS.load(Ordering::Relaxed)
}

/// Work younger than this is not told: it may be over soon.
const YOUNG: Duration = Duration::from_secs(2);

/// What is told of work: its name, when it began, and the share that is done.
static TOLD: Mutex<Option<(&str, Instant, f64)>> = Mutex::new(None);

fn lock() -> MutexGuard<'static, Option<(&'static str, Instant, f64)>> {
    TOLD.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Work in progress, until it is dropped. Work within other work, or beside it, tells nothing.
#[derive(Debug)]
pub struct Work {
    tells: bool,
}

impl Work {
    /// Begins work of this name, such as "reading the window".
    pub fn begin(name: &'static str) -> Self {
        let mut told = lock();
        let tells = told.is_none();
        if tells {
            *told = Some((name, Instant::now(), 0.0));
        }
        Self { tells }
    }

    /// So many of so many parts are done.
    pub fn reached(&self, done: usize, all: usize) {
        mark();
        if let Some((.., share)) = lock().as_mut().filter(|_| self.tells) {
            *share = done as f64 / all.max(1) as f64;
        }
    }
}

impl Drop for Work {
    fn drop(&mut self) {
        if self.tells {
            *lock() = None;
        }
    }
}

/// The work in progress in words, with the share done and the time left as they have gone so far. `None` without any, or in its first two seconds.
pub fn work() -> Option<String> {
    let (name, began, share) = lock().filter(|(_, began, _)| began.elapsed() >= YOUNG)?;
    Some(in_words(name, began.elapsed().as_secs_f64(), share))
}

fn in_words(name: &str, seconds: f64, share: f64) -> String {
    if !(share > 0.0 && share <= 1.0) {
        return name.to_owned();
    }
    let left = (seconds * (1.0 - share) / share).ceil();
    let left = if left < 120.0 { format!("{left} s") } else { format!("{:.0} min", (left / 60.0).ceil()) };
    format!("{name}: {:.0} %, about {left} left", 100.0 * share)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn time_left_is_told_as_it_went_so_far() {
        assert_eq!(in_words("tracing", 3.0, 0.0), "tracing");
        assert_eq!(in_words("tracing", 3.0, 0.25), "tracing: 25 %, about 9 s left");
        assert_eq!(in_words("tracing", 100.0, 0.1), "tracing: 10 %, about 15 min left");
        assert_eq!(in_words("tracing", 3.0, 1.0), "tracing: 100 %, about 0 s left");
    }

    #[test]
    fn work_within_work_tells_nothing() {
        let outer = Work::begin("outer");
        outer.reached(1, 4);
        {
            let inner = Work::begin("inner");
            inner.reached(3, 4);
        }
        assert_eq!(lock().map(|(name, _, share)| (name, share)), Some(("outer", 0.25)));
        assert_eq!(work(), None, "it may be over soon");
        drop(outer);
        assert!(lock().is_none());
    }
}
