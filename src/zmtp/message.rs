//! Messages as bytes on the wire, and the account of those that are held.

use crate::lock;
use crate::parse::{COMMAND, LONG, MORE};
use std::sync::{Arc, Condvar, Mutex};
use std::time::Duration;

/// What becomes of a message that its subscriber has not taken when the next one of its topic comes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Keep {
    /// The next one replaces it.
    Newest,
    /// The next one replaces it. It is small, and does not count among the messages in flight.
    Note,
    /// As [`Keep::Newest`], for those alone who subscribe to its whole topic. It is large: it counts among its own kind, and its subscriber has
    /// [`crate::Limits::bulk_stall`] to take it.
    Bulk,
    /// Both wait, up to [`crate::Limits::queued`] messages; then the oldest is dropped.
    All,
}

impl Keep {
    /// Place of its kind among those whose messages in flight are counted.
    fn in_flight(self) -> Option<usize> {
        match self {
            Self::Newest => Some(0),
            Self::Bulk => Some(1),
            Self::Note | Self::All => None,
        }
    }
}

/// A message, encoded once for all subscribers.
#[derive(Debug)]
pub(crate) struct Message {
    /// First part.
    pub topic: Vec<u8>,
    pub keep: Keep,
    /// Order in which messages were made.
    pub number: u64,
    /// All but the bytes of the last part, which may be large and are not copied.
    pub head: Vec<u8>,
    pub last: Vec<u8>,
    ledger: Arc<Ledger>,
}

impl Drop for Message {
    fn drop(&mut self) {
        let mut held = lock(&self.ledger.held);
        held.bytes -= self.bytes();
        if let Some(kind) = self.keep.in_flight() {
            held.in_flight[kind] -= 1;
        }
        self.ledger.freed.notify_all();
    }
}

impl Message {
    fn bytes(&self) -> u64 {
        (self.head.len() + self.last.len()) as u64
    }
}

/// Adds the header of a frame.
pub(crate) fn header(to: &mut Vec<u8>, flags: u8, length: usize) {
    match u8::try_from(length) {
        Ok(length) => to.extend([flags, length]),
        Err(_) => {
            to.push(flags | LONG);
            to.extend((length as u64).to_be_bytes());
        }
    }
}

/// Adds a command.
pub(crate) fn command(to: &mut Vec<u8>, name: &[u8], body: &[u8]) {
    header(to, COMMAND, 1 + name.len() + body.len());
    to.push(name.len() as u8);
    to.extend(name);
    to.extend(body);
}

/// Account of the messages that any subscriber still holds.
#[derive(Debug, Default)]
pub(crate) struct Ledger {
    held: Mutex<Held>,
    freed: Condvar,
}

#[derive(Debug, Default)]
struct Held {
    bytes: u64,
    peak_bytes: u64,
    /// Number of messages of each kind that is counted.
    in_flight: [usize; 2],
    made: u64,
}

impl Ledger {
    pub fn message(self: &Arc<Self>, parts: &[&[u8]], last: Vec<u8>, keep: Keep) -> Arc<Message> {
        let mut head = Vec::with_capacity(parts.iter().map(|part| part.len() + 9).sum::<usize>() + 9);
        for part in parts {
            header(&mut head, MORE, part.len());
            head.extend(*part);
        }
        header(&mut head, 0, last.len());
        let mut held = lock(&self.held);
        held.made += 1;
        let topic = parts.first().copied().unwrap_or(&last).to_vec();
        let message = Message { topic, keep, number: held.made, head, last, ledger: Arc::clone(self) };
        held.bytes += message.bytes();
        held.peak_bytes = held.peak_bytes.max(held.bytes);
        if let Some(kind) = keep.in_flight() {
            held.in_flight[kind] += 1;
        }
        Arc::new(message)
    }

    pub fn peak_bytes(&self) -> u64 {
        lock(&self.held).peak_bytes
    }

    /// Whether fewer than `limit` messages of a kind are held, after waiting for it.
    pub fn wait_below(&self, keep: Keep, limit: usize, wait: Duration) -> bool {
        let Some(kind) = keep.in_flight() else { return true };
        let held = lock(&self.held);
        let waited = self.freed.wait_timeout_while(held, wait, |held| held.in_flight[kind] >= limit);
        waited.unwrap_or_else(std::sync::PoisonError::into_inner).0.in_flight[kind] < limit
    }
}
