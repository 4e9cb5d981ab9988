//! Signs of progress of this process, for whoever watches that it does not hang: work that takes long, and loops that wait, leave a mark
//! several times a minute. Work that knows how much of it is done tells so, for people.

use std::borrow::Cow;
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

/// What is known of work.
#[derive(Debug)]
struct Told {
    number: u64,
    name: Cow<'static, str>,
    began: Instant,
    /// Share that is done; 0 if it is not known.
    share: f64,
    /// How far it is, in words; may be empty.
    state: String,
}

impl Told {
    fn says_how_far(&self) -> bool {
        self.share > 0.0 || !self.state.is_empty()
    }

    fn in_words(&self) -> String {
        in_words(&self.name, &self.state, self.began.elapsed().as_secs_f64(), self.share)
    }
}

/// All work in progress, in the order in which it was begun here.
static TOLD: Mutex<Vec<Told>> = Mutex::new(Vec::new());

fn lock() -> MutexGuard<'static, Vec<Told>> {
    TOLD.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Work in progress, until it is dropped. Of work within other work, or beside it, what began first and says how far it is is told.
#[derive(Debug)]
pub struct Work {
    number: u64,
}

impl Work {
    /// Begins work of this name, such as "reading the window".
    pub fn begin(name: impl Into<Cow<'static, str>>) -> Self {
        Self::begun(name, Instant::now())
    }

    /// Work that began earlier.
    pub fn begun(name: impl Into<Cow<'static, str>>, began: Instant) -> Self {
        static NUMBERS: AtomicU64 = AtomicU64::new(0);
        let number = NUMBERS.fetch_add(1, Ordering::Relaxed);
        lock().push(Told { number, name: name.into(), began, share: 0.0, state: String::new() });
        Self { number }
    }

    /// So many of so many parts are done.
    pub fn reached(&self, done: usize, all: usize) {
        self.reached_share(done as f64 / all.max(1) as f64);
    }

    /// This share is done, from 0 to 1.
    pub fn reached_share(&self, share: f64) {
        mark();
        self.update(|told| told.share = share);
    }

    /// How far it is, in words, beside the share or where that is not known.
    pub fn stands(&self, state: String) {
        mark();
        self.update(|told| told.state = state);
    }

    fn update(&self, news: impl FnOnce(&mut Told)) {
        if let Some(told) = lock().iter_mut().find(|told| told.number == self.number) {
            news(told);
        }
    }
}

impl Drop for Work {
    fn drop(&mut self) {
        lock().retain(|told| told.number != self.number);
    }
}

/// The work in progress in words, with the share done and the time left if it goes on as so far. `None` without any, or in its first two
/// seconds.
pub fn work() -> Option<String> {
    of_all(&lock(), YOUNG)
}

/// In words what is to be told of all work, without what is younger than this.
fn of_all(all: &[Told], young: Duration) -> Option<String> {
    let old = || all.iter().filter(|told| told.began.elapsed() >= young);
    old().find(|told| told.says_how_far()).or(old().next()).map(Told::in_words)
}

fn in_words(name: &str, state: &str, seconds: f64, share: f64) -> String {
    let mut text = name.to_owned();
    if !state.is_empty() {
        text += &format!(": {state}");
    }
    if !(share > 0.0 && share <= 1.0) {
        return text;
    }
    let left = (seconds * (1.0 - share) / share).ceil();
    let left = if left < 120.0 { format!("{left} s") } else { format!("{:.0} min", (left / 60.0).ceil()) };
    let colon = if state.is_empty() { ":" } else { "," };
    text + &format!("{colon} {:.0} %, about {left} left", 100.0 * share)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn time_left_is_told_as_it_went_so_far() {
        assert_eq!(in_words("tracing", "", 3.0, 0.0), "tracing");
        assert_eq!(in_words("tracing", "", 3.0, 0.25), "tracing: 25 %, about 9 s left");
        assert_eq!(in_words("tracing", "", 100.0, 0.1), "tracing: 10 %, about 15 min left");
        assert_eq!(in_words("tracing", "", 3.0, 1.0), "tracing: 100 %, about 0 s left");
        assert_eq!(in_words("choosing", "24 of at most 96", 3.0, 0.0), "choosing: 24 of at most 96");
        assert_eq!(in_words("choosing", "24 of at most 96", 3.0, 0.25), "choosing: 24 of at most 96, 25 %, about 9 s left");
        assert_eq!(in_words("tracing", "", 3.0, f64::NAN), "tracing", "no number is made up");
    }

    #[test]
    fn the_first_work_that_says_how_far_it_is_is_told() {
        let told = || of_all(&lock(), Duration::ZERO).map(|text| text.split(", about").next().unwrap_or_default().to_owned());
        assert_eq!(told(), None);
        let outer = Work::begin("outer");
        assert_eq!(work(), None, "it may be over soon");
        let inner = Work::begin("inner");
        assert_eq!(told().as_deref(), Some("outer"));
        inner.reached(3, 4);
        assert_eq!(told().as_deref(), Some("inner: 75 %"), "the other does not know");
        outer.reached(1, 4);
        assert_eq!(told().as_deref(), Some("outer: 25 %"));
        drop(outer);
        assert_eq!(told().as_deref(), Some("inner: 75 %"), "what was beside it goes on");
        drop(inner);
        assert_eq!(told(), None);
        let earlier = Work::begun("earlier", Instant::now() - YOUNG);
        earlier.stands("almost".to_owned());
        assert_eq!(work().as_deref(), Some("earlier: almost"));
    }
}
