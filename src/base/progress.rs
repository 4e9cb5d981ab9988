//! Signs of progress of this process, for whoever watches that it does not hang: work that takes long, and loops that wait, leave a mark
//! several times a minute.

use std::sync::atomic::{AtomicU64, Ordering};

static MARKS: AtomicU64 = AtomicU64::new(0);

/// Leaves a mark. Costs nothing beside any work; threads that would leave millions a second leave some of them.
pub fn mark() {
    MARKS.fetch_add(1, Ordering::Relaxed);
}

/// Number of marks so far.
pub fn marks() -> u64 {
    MARKS.load(Ordering::Relaxed)
}
