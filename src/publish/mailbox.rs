//! Buffer between the cycle and the socket: the newest frame, the waiting records, and the message parts in flight.

use super::summary::PublishStatistics;
use crate::run::{Frame, FrameRecord};
use bytes::Bytes;
use std::collections::VecDeque;
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

/// Maximum number of records that wait for the socket, and of records in flight.
pub(super) const MAX_RECORDS: usize = 256;

/// Content of a message part. Each kind has its own cap.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Kind {
    Picture,
    Record,
}

/// Shared by the cycle, the publishing thread and every payload in the socket.
#[derive(Debug, Default)]
pub(super) struct Mailbox {
    state: Mutex<State>,
    changed: Condvar,
}

#[derive(Debug, Default)]
pub(super) struct State {
    /// The newest frame. It replaces one that was not sent yet.
    pub(super) frame: Option<Frame>,
    pub(super) records: VecDeque<Arc<FrameRecord>>,
    /// Deadline of the publishing thread, once it is asked to end.
    pub(super) close_by: Option<Instant>,
    pub(super) statistics: PublishStatistics,
    in_flight: Vec<Part>,
    next_ticket: u64,
}

#[derive(Debug)]
struct Part {
    ticket: u64,
    /// Number of the socket instance that it was given to.
    instance: u64,
    kind: Kind,
    bytes: u64,
    since: Instant,
}

/// A message part that tells the mailbox when the socket drops it. The `zeromq` crate keeps up to 100,000 messages a subscriber and has no
/// high-water mark; counting the parts bounds its memory from outside.
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
        if let Some(at) = state.in_flight.iter().position(|p| p.ticket == self.ticket) {
            state.in_flight.swap_remove(at);
        }
        self.mailbox.changed.notify_all();
    }
}

impl Mailbox {
    pub(super) fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Stores a frame. Never waits.
    pub(super) fn put(&self, frame: Frame) {
        let mut state = self.lock();
        state.statistics.frames += 1;
        if state.records.len() >= MAX_RECORDS {
            state.records.pop_front();
            state.statistics.records_dropped += 1;
        }
        state.records.push_back(Arc::clone(&frame.record));
        if state.frame.replace(frame).is_some() {
            state.statistics.superseded += 1;
        }
        self.changed.notify_all();
    }

    /// Asks the publishing thread to end by this time.
    pub(super) fn close(&self, by: Instant) {
        self.lock().close_by.get_or_insert(by);
        self.changed.notify_all();
    }

    /// Waits for any change, at most `limit`.
    pub(super) fn wait<'a>(&self, state: MutexGuard<'a, State>, limit: Duration) -> MutexGuard<'a, State> {
        self.changed.wait_timeout(state, limit).unwrap_or_else(PoisonError::into_inner).0
    }

    /// Wraps bytes so that the mailbox knows how long the socket instance holds them.
    pub(super) fn count(self: &Arc<Self>, bytes: Vec<u8>, kind: Kind, instance: u64) -> Bytes {
        let mut state = self.lock();
        let ticket = state.next_ticket;
        state.next_ticket += 1;
        state.in_flight.push(Part { ticket, instance, kind, bytes: bytes.len() as u64, since: Instant::now() });
        let held = state.in_flight.iter().map(|p| p.bytes).sum();
        state.statistics.peak_queued_bytes = state.statistics.peak_queued_bytes.max(held);
        drop(state);
        Bytes::from_owner(Counted { bytes, ticket, mailbox: Arc::clone(self) })
    }
}

impl State {
    /// Number of parts of a kind in flight in this socket instance.
    pub(super) fn held(&self, kind: Kind, instance: u64) -> usize {
        self.in_flight.iter().filter(|p| p.kind == kind && p.instance == instance).count()
    }

    /// When the oldest part in flight was given to this socket instance.
    pub(super) fn oldest(&self, instance: u64) -> Option<Instant> {
        self.in_flight.iter().filter(|p| p.instance == instance).map(|p| p.since).min()
    }
}
