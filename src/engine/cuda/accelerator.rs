//! CUDA as the engine's accelerator.

use super::{CudaTracer, CudaTracerError, DeviceError, Gpu, GpuRenderer, SnapshotStore, Storage, Traced, Tuning};
use crate::engine::accelerator::{Accelerator, DeviceRenderer, Health};
use crate::engine::{Answers, EngineError};
use crate::field::Snapshot;
use crate::flow::{FlowMap, Tracer, VelocitySource};
use crate::render::{Film, RenderStats, Renderer};
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

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
        Ok(Box::new(GpuRenderer::new(&self.gpu)?))
    }

    fn expect(&self, snapshot: &Arc<Snapshot>) {
        self.snapshots.expect(snapshot);
    }
}

impl DeviceRenderer for GpuRenderer {
    /// Walks and traces on the GPU when nothing else is to be asked.
    fn render(
        &mut self,
        renderer: &mut Renderer,
        picture: u64,
        samples: usize,
        tracer: &dyn Tracer,
        answers: &mut Answers<'_>,
        progress: Option<&dyn Fn(f32)>,
        stop: &AtomicBool,
    ) -> Result<Option<(Film, RenderStats)>, EngineError> {
        let Some(tracer) = tracer.as_any().and_then(|any| any.downcast_ref::<CudaTracer>()) else { return Ok(None) };
        // Which seeds lie on land is known on the host alone.
        if tracer.device().meets_land() || !answers.only_traces() {
            return Ok(None);
        }
        let end = u32::try_from(samples).unwrap_or(u32::MAX);
        let (film, stats) = self.render_samples(renderer, picture, 0..end, &Traced(tracer.device()), progress, stop)?;
        answers.answered_elsewhere(&stats);
        Ok(Some((film, stats)))
    }
}
