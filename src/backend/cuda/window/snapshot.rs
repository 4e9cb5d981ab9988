//! A snapshot on the GPU.

use crate::backend::cuda::{Buffer, Storage};
use crate::field::Snapshot;
use cudarc::driver::CudaEvent;
use std::sync::{Arc, OnceLock, Weak};

/// One snapshot on the device.
#[derive(Debug)]
pub struct DeviceSnapshot {
    /// The snapshot on the host. The reference keeps its address unique, by which snapshots are compared.
    pub(in crate::backend::cuda) host: Arc<Snapshot>,
    /// Encoded velocities, [`Storage::bytes`] per node.
    pub(in crate::backend::cuda) nodes: Buffer<u32>,
    pub(in crate::backend::cuda) storage: Storage,
    pub(in crate::backend::cuda) scale: f32,
    /// True if some nodes have no data.
    pub(in crate::backend::cuda) missing: bool,
    /// End of the upload.
    pub(in crate::backend::cuda) ready: CudaEvent,
    /// The next snapshot, to which the stored changes lead. It is set once, because tracers of earlier windows keep reading the changes.
    pub(in crate::backend::cuda) next: OnceLock<Weak<Snapshot>>,
}
