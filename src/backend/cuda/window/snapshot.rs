//! A snapshot on the GPU.

use crate::cuda::{Buffer, Storage};
use cudarc::driver::CudaEvent;
use ridgewatch_field::Snapshot;
use std::sync::{Arc, OnceLock, Weak};

/// One snapshot on the device.
#[derive(Debug)]
pub struct DeviceSnapshot {
    /// The snapshot on the host. The reference keeps its address unique, by which snapshots are compared.
    pub(in crate::cuda) host: Arc<Snapshot>,
    /// Encoded velocities, [`Storage::bytes`] per node.
    pub(in crate::cuda) nodes: Buffer<u32>,
    pub(in crate::cuda) storage: Storage,
    pub(in crate::cuda) scale: f32,
    /// True if some nodes have no data.
    pub(in crate::cuda) missing: bool,
    /// End of the upload.
    pub(in crate::cuda) ready: CudaEvent,
    /// The next snapshot, to which the stored changes lead. It is set once, because tracers of earlier windows keep reading the changes.
    pub(in crate::cuda) next: OnceLock<Weak<Snapshot>>,
}
