//! The velocity window on the GPU: each snapshot is uploaded once and kept while a window needs it.

pub(super) mod grid;
mod missing_cells;
mod prefetch;
mod snapshot;
mod store;
mod uploader;

pub use missing_cells::DeviceMissingCells;
pub use snapshot::DeviceSnapshot;
pub use store::{DeviceWindow, SnapshotStore};
