//! Between the cycle and the socket: the newest frame, the records that wait, and what is on its way.

use super::PublishStatistics;
use crate::engine::{Frame, FrameRecord};
use bytes::Bytes;
use std::collections::VecDeque;
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

/// Records that may wait for the socket, or be on their way, at once.
pub(super) const RECORDS_WAITING: usize = 256;

/// What a message part carries; each kind has its own cap.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Kind {
    Picture,
    Record,
}

/// Shared by the cycle, the publishing thread and every payload that the socket holds.
#[derive(Debug, Default)]
pub(super) struct Mailbox {
    state: Mutex<State>,
    changed: Condvar,
}

#[derive(Debug, Default)]
pub(super) struct State {
    /// The newest frame: it replaces one that was not taken yet.
    pub(super) frame: Option<Frame>,
    pub(super) records: VecDeque<Arc<FrameRecord>>,
    /// When set, the publishing thread should be done by then.
    pub(super) close_by: Option<Instant>,
    pub(super) statistics: PublishStatistics,
    on_their_way: Vec<Part>,
    next_ticket: u64,
}

#[derive(Debug)]
struct Part {
    ticket: u64,
    /// Socket that it was given to; a cut-off bears a new one.
    generation: u64,
    kind: Kind,
    bytes: u64,
    since: Instant,
}

/// A message part that tells the mailbox when the socket lets go of it. The `zeromq` crate keeps up to 100,000 messages a
/// subscriber and has no high-water mark: this is how its memory is bounded from outside.
struct Counted {
    bytes: Vec<u8>,
    ticket: u64,
    mailbox: Arc<Mailbox>,
}

impl AsRef<[u8]> for Counted {
    fn as_ref(&self) -> &[u8] {
        &self.bytes
    }
}

impl Drop for Counted {
    fn drop(&mut self) {
        let mut state = self.mailbox.lock();
        if let Some(at) = state.on_their_way.iter().position(|p| p.ticket == self.ticket) {
            state.on_their_way.swap_remove(at);
        }
        self.mailbox.changed.notify_all();
    }
}

impl Mailbox {
    pub(super) fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Takes a frame in without ever waiting.
    pub(super) fn put(&self, frame: Frame) {
        let mut state = self.lock();
        state.statistics.frames += 1;
        if state.records.len() >= RECORDS_WAITING {
            state.records.pop_front();
            state.statistics.records_dropped += 1;
        }
        state.records.push_back(Arc::clone(&frame.record));
        if state.frame.replace(frame).is_some() {
            state.statistics.superseded += 1;
        }
        self.changed.notify_all();
    }

    /// Asks the publishing thread to be done by then.
    pub(super) fn close(&self, by: Instant) {
        self.lock().close_by.get_or_insert(by);
        self.changed.notify_all();
    }

    /// Waits for any change, at most so long.
    pub(super) fn wait<'a>(&self, state: MutexGuard<'a, State>, limit: Duration) -> MutexGuard<'a, State> {
        self.changed.wait_timeout(state, limit).unwrap_or_else(PoisonError::into_inner).0
    }

    /// Wraps bytes so that the mailbox knows how long the socket of this generation holds them.
    pub(super) fn count(self: &Arc<Self>, bytes: Vec<u8>, kind: Kind, generation: u64) -> Bytes {
        let mut state = self.lock();
        let ticket = state.next_ticket;
        state.next_ticket += 1;
        state.on_their_way.push(Part { ticket, generation, kind, bytes: bytes.len() as u64, since: Instant::now() });
        let held = state.on_their_way.iter().map(|p| p.bytes).sum();
        state.statistics.peak_queued_bytes = state.statistics.peak_queued_bytes.max(held);
        drop(state);
        Bytes::from_owner(Counted { bytes, ticket, mailbox: Arc::clone(self) })
    }
}

impl State {
    /// Parts of a kind that this generation's socket holds.
    pub(super) fn held(&self, kind: Kind, generation: u64) -> usize {
        self.on_their_way.iter().filter(|p| p.kind == kind && p.generation == generation).count()
    }

    /// Since when this generation's socket holds the part that it holds longest.
    pub(super) fn oldest(&self, generation: u64) -> Option<Instant> {
        self.on_their_way.iter().filter(|p| p.generation == generation).map(|p| p.since).min()
    }
}
