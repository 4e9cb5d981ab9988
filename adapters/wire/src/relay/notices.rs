//! News that whoever reaches the port can make, in bounded number.

use std::sync::{Mutex, MutexGuard};
use std::time::{Duration, Instant};

/// How often news of one kind is said, at most: whoever reaches the port can make some.
const APART: Duration = Duration::from_secs(1);

/// News of one kind: said once in [`APART`], the rest counted and said together.
pub(super) struct News {
    /// What befell those that were counted.
    rest: &'static str,
    /// When it was last said, and how often it happened since.
    said: Mutex<(Option<Instant>, u64)>,
}

impl News {
    pub fn new(rest: &'static str) -> Self {
        Self { rest, said: Mutex::default() }
    }

    fn said(&self) -> MutexGuard<'_, (Option<Instant>, u64)> {
        self.said.lock().unwrap_or_else(|broken| broken.into_inner())
    }

    /// What is to be said of one more now: that.
    pub fn come(&self, words: impl FnOnce() -> String) -> Option<String> {
        let mut said = self.said();
        if said.0.is_some_and(|last| last.elapsed() < APART) {
            said.1 += 1;
            return None;
        }
        said.0 = Some(Instant::now());
        Some(words())
    }

    /// What is to be said now of those that were counted.
    pub fn due(&self) -> Option<String> {
        let mut said = self.said();
        if said.1 == 0 || said.0.is_some_and(|last| last.elapsed() < APART) {
            return None;
        }
        let more = std::mem::replace(&mut *said, (Some(Instant::now()), 0)).1;
        Some(format!("{more} more {}", self.rest))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn news_of_one_kind_are_said_once_a_second_and_none_is_lost() {
        let news = News::new("were sent away");
        let come = |n: usize| news.come(|| format!("{n} was sent away"));
        assert_eq!((come(0).as_deref(), news.due()), (Some("0 was sent away"), None));
        assert!((1..=1000).all(|n| come(n).is_none()) && news.due().is_none());
        news.said().0 = Some(Instant::now() - APART);
        assert_eq!(news.due().as_deref(), Some("1000 more were sent away"));
        assert_eq!((news.due(), come(1001)), (None, None));
    }
}
