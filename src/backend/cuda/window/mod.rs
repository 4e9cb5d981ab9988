//! The velocity window on the GPU: one upload for each snapshot, held for as long as a window needs it.

pub(super) mod grid;
mod missing_cells;
mod prefetch;
mod store;
mod uploader;

pub use missing_cells::DeviceMissingCells;
pub use store::{DeviceSnapshot, DeviceWindow, SnapshotStore};
