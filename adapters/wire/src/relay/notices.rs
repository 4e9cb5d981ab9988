//! Rate limit for notices that any peer can cause.

use std::sync::{Mutex, MutexGuard};
use std::time::{Duration, Instant};

/// Least interval between two notices of one kind.
const INTERVAL: Duration = Duration::from_secs(1);

/// Notices of one kind: one per [`INTERVAL`] is reported, and the others are counted and summarised.
pub(super) struct Notices {
    /// Text of the summary after the count.
    summary: &'static str,
    /// Time of the last report, and number of notices since.
    state: Mutex<(Option<Instant>, u64)>,
}

impl Notices {
    pub fn new(summary: &'static str) -> Self {
        Self { summary, state: Mutex::default() }
    }

    fn state(&self) -> MutexGuard<'_, (Option<Instant>, u64)> {
        self.state.lock().unwrap_or_else(|broken| broken.into_inner())
    }

    /// Returns the text to report now, or `None` if the notice was counted.
    pub fn add(&self, text: impl FnOnce() -> String) -> Option<String> {
        let mut state = self.state();
        if state.0.is_some_and(|last| last.elapsed() < INTERVAL) {
            state.1 += 1;
            return None;
        }
        state.0 = Some(Instant::now());
        Some(text())
    }

    /// Returns the summary of the counted notices, if it is due.
    pub fn due(&self) -> Option<String> {
        let mut state = self.state();
        if state.1 == 0 || state.0.is_some_and(|last| last.elapsed() < INTERVAL) {
            return None;
        }
        let more = std::mem::replace(&mut *state, (Some(Instant::now()), 0)).1;
        Some(format!("{more} more {}", self.summary))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn notices_of_one_kind_are_reported_once_a_second_and_none_is_lost() {
        let notices = Notices::new("were rejected");
        let add = |n: usize| notices.add(|| format!("{n} was rejected"));
        assert_eq!((add(0).as_deref(), notices.due()), (Some("0 was rejected"), None));
        assert!((1..=1000).all(|n| add(n).is_none()) && notices.due().is_none());
        notices.state().0 = Some(Instant::now() - INTERVAL);
        assert_eq!(notices.due().as_deref(), Some("1000 more were rejected"));
        assert_eq!((notices.due(), add(1001)), (None, None));
    }
}
