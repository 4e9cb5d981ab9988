//! CUDA as the engine's accelerator.

use super::frames::CudaFrames;
use super::{CudaOffload, CudaTracer, CudaTracerError, DeviceError, Gpu, SnapshotStore, Storage, Tuning};
use crate::engine::accelerator::{Accelerator, DeviceRenderer, Health};
use crate::field::Snapshot;
use crate::flow::{FlowMap, Tracer, VelocitySource};
use crate::surrogate::Offload;
use std::sync::Arc;

/// A GPU and what is on it of the velocity.
#[derive(Debug)]
pub struct CudaAccelerator {
    gpu: Arc<Gpu>,
    snapshots: SnapshotStore,
    storage: Storage,
}

impl CudaAccelerator {
    /// With windows held in `storage`.
    pub fn new(gpu: Arc<Gpu>, storage: Storage) -> Self {
        Self { snapshots: SnapshotStore::new(&gpu), gpu, storage }
    }

    /// What is on the device of the velocity.
    pub fn snapshots(&self) -> &SnapshotStore {
        &self.snapshots
    }
}

impl Accelerator for CudaAccelerator {
    fn name(&self) -> String {
        format!("cuda:{} {}", self.gpu.ordinal(), self.gpu.name())
    }

    fn health(&self) -> &Arc<Health> {
        self.gpu.health()
    }

    fn tracer(&self, source: VelocitySource, map: &FlowMap, t0: f64) -> Result<Box<dyn Tracer>, CudaTracerError> {
        let tuning = Tuning { storage: self.storage, ..Tuning::default() };
        Ok(Box::new(CudaTracer::new(&self.snapshots, &self.gpu, source, map, t0, tuning)?))
    }

    fn renderer(&self) -> Result<Box<dyn DeviceRenderer>, DeviceError> {
        Ok(Box::new(CudaFrames::new(&self.gpu)?))
    }

    fn offload(&self) -> Option<Arc<dyn Offload>> {
        Some(Arc::new(CudaOffload::new(&self.gpu)))
    }

    fn expect(&self, snapshot: &Arc<Snapshot>) {
        self.snapshots.expect(snapshot);
    }
}
