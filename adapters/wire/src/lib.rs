//! Transport of a simulation's velocity to ridgewatch.
//!
//! On one node, each block of the domain has a ring of steps in a file under `/dev/shm`. The [`Producer`] copies a step into the next slot, and the
//! [`RingReader`] reads and checks it. Between nodes, a [`relay`] sends signed [`message`]s over TCP. The [`Assembler`] joins the blocks of a decomposed
//! domain.
//!
//! All input is untrusted: each length is checked before memory is allocated for it, and each fault is a [`WireError`].

mod assemble;
mod byte_lock;
mod bytes;
mod choice;
mod clean;
mod copy;
#[cfg(test)]
#[path = "../tests/support/counting.rs"]
mod counting;
mod description;
mod error;
mod follow;
mod header;
mod lock;
mod map;
#[cfg(feature = "messages")]
pub mod message;
mod place;
mod private;
mod producer;
#[cfg(all(test, feature = "messages"))]
#[path = "../tests/support/random.rs"]
mod random;
mod reader;
#[cfg(feature = "messages")]
pub mod relay;
mod system;

pub use assemble::{Assembler, Incomplete, Step};
pub use choice::LEAD;
pub use clean::{Cleaned, Leftover, clean, find_rings, leftovers};
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

/// The ring's folder that the environment names; `None` if [`RING_VARIABLE`] is not set or empty.
pub fn ring_from_environment() -> Option<PathBuf> {
    std::env::var_os(RING_VARIABLE).filter(|name| !name.is_empty()).map(PathBuf::from)
}

/// Path of a block's ring in the ring's folder.
pub fn block_path(ring: &Path, block: u32) -> PathBuf {
    ring.join(format!("block-{block:05}.ring"))
}

/// Path of a block's ring until its header is complete.
fn part_path(ring: &Path, block: u32) -> PathBuf {
    ring.join(format!(".block-{block:05}.part"))
}

/// Path of the file whose lock each follower holds.
fn followers_path(ring: &Path) -> PathBuf {
    ring.join("followers.lock")
}

/// Path of the file whose lock the block's producer holds.
fn lock_path(ring: &Path, block: u32) -> PathBuf {
    ring.join(format!("block-{block:05}.lock"))
}
