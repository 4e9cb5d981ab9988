//! How a simulation's velocity travels to ridgewatch.
//!
//! On one node: a ring of steps in a file under `/dev/shm`, one a block of the domain. The [`Producer`] copies a step into the next slot
//! and goes on; the [`RingReader`] reads what is there and checks all of it. Between nodes: signed [`message`]s over TCP. Blocks of
//! a decomposed domain are put together by the [`Assembler`].
//!
//! What comes from outside is never believed: every length is checked before memory is taken for it, every fault is a [`WireError`].

mod assemble;
mod bytes;
mod choice;
mod copy;
#[cfg(test)]
#[path = "../tests/support/counting.rs"]
mod counting;
mod description;
mod error;
mod follow;
mod header;
mod lock;
#[cfg(feature = "messages")]
pub mod message;
mod place;
mod producer;
mod reader;
#[cfg(feature = "messages")]
pub mod relay;
mod system;

pub use assemble::{Assembler, Incomplete, Step};
pub use choice::LEAD;
pub use copy::{Element, Field};
pub use description::{AXIS_NODES, AxisDescription, BlockExtent, Description, Geometry, Limits, TEXT, even};
pub use error::WireError;
pub use follow::{Event, RingFollower};
pub use header::{Header, MAGIC, VERSION};
pub use lock::{Following, blocks, producer_lives};
pub use producer::{Policy, Producer, Published};
pub use reader::{Read, ReadAt, RingReader, StepInfo};

use std::path::{Path, PathBuf};

/// The environment variable that names the ring's folder.
pub const RING_VARIABLE: &str = "RIDGEWATCH_RING";

/// The file of one block in a ring's folder.
pub fn block_path(ring: &Path, block: u32) -> PathBuf {
    ring.join(format!("block-{block:05}.ring"))
}

/// A block's file until it is whole.
fn part_path(ring: &Path, block: u32) -> PathBuf {
    ring.join(format!(".block-{block:05}.part"))
}

/// Who follows the ring holds this file's lock.
fn followers_path(ring: &Path) -> PathBuf {
    ring.join("followers.lock")
}

/// The lock of a block's file; whoever holds it is its producer.
fn lock_path(ring: &Path, block: u32) -> PathBuf {
    ring.join(format!("block-{block:05}.lock"))
}
