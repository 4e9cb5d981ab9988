//! Snapshots in order of time: files, memory, synthetic turbulence; reading ahead; inspection.
//!
//! In: paths and settings. Out: [`SnapshotSource`](super::SnapshotSource)s, and snapshots read ahead by one I/O thread. Calls
//! `grids` (how to read a file), `cf` and `formats` (requests only).

#[allow(clippy::module_inception)] // The archive itself.
mod archive;
mod check;
mod every;
mod files;
mod fills;
mod follow;
mod group;
mod inspect;
mod memory;
mod read_ahead;
mod steady;
mod synthetic;

pub use archive::Archive;
pub use every::Every;
pub use files::expand;
pub use inspect::{AxisReport, Inspection, MissingReport, ResamplingReport, ResolutionReport, TimeReport, VariableReport, inspect};
pub use memory::MemorySource;
pub use read_ahead::{DEFAULT_READ_AHEAD, ReadAhead, follow, read_ahead};
pub use steady::Steady;
pub use synthetic::{GlobeTurbulence, synthesize};

use crate::ArchiveSettings;
use crate::formats::Limits;

/// Limits that the settings give.
fn limits(settings: &ArchiveSettings) -> Limits {
    Limits::new(settings.memory_gib, settings.external)
}
