//! ZeroMQ sockets (ZMTP 3.0 and 3.1, NULL mechanism) over TCP and Unix sockets, each on one thread of its own: a PUB socket, and a ROUTER socket that
//! answers; and one connection of a SUB or a DEALER socket.
//!
//! In: messages. Out: their bytes to each subscriber at that subscriber's pace. No subscriber costs another one anything: each has its own slots
//! and its own deadline, what it may send is bounded ([`Limits`]), and a lock is held for the change of a queue, never across a read or a write.

mod bind;
mod client;
mod message;
mod owner;
mod parse;
mod router;
mod socket;
mod subscriber;

pub use bind::{BindError, Peers, check_endpoint, private_endpoint};
pub use client::Limits;
pub use message::Keep;
pub use parse::{Fault, Incoming, Parser, Role};
pub use router::{Answer, Answers, RouterSocket};
pub use socket::{Counts, PubSocket};
pub use subscriber::{Requester, Stream, SubscribeError, Subscriber};

use std::sync::{Mutex, MutexGuard, PoisonError};

/// Locks; a panic elsewhere leaves all states here usable.
fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}
