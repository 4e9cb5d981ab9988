//! Films of a run, made on the GPU alone where every query can be answered there.

use super::{CudaTracer, DeviceError, DevicePredict, DeviceTable, Division, Gpu, GpuRenderer, Panel, Traced};
use crate::engine::accelerator::DeviceRenderer;
use crate::engine::{Answers, EngineError, Tally};
use crate::flow::Tracer;
use crate::render::{Film, RenderStats, Renderer};
use crate::surrogate::{Samples, Table};
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

/// Walks, traces and predicts on the GPU.
pub struct CudaFrames {
    gpu: Arc<Gpu>,
    renderer: GpuRenderer,
    division: Division,
    /// The table that frames were last answered from, by its stamp.
    table: Option<(u64, DeviceTable)>,
}

impl CudaFrames {
    /// Compiles the kernels, or takes them from the cache.
    ///
    /// # Errors
    /// What the compiler or the device says.
    pub fn new(gpu: &Arc<Gpu>) -> Result<Self, DeviceError> {
        Ok(Self { gpu: gpu.clone(), renderer: GpuRenderer::new(gpu)?, division: Division::new(gpu)?, table: None })
    }

    /// The device's copy of `table`, brought over where it is not there yet.
    fn copy_of(&mut self, table: &Table, tracer: &CudaTracer) -> Result<(), DeviceError> {
        if self.table.as_ref().is_none_or(|(stamp, _)| *stamp != table.stamp()) {
            // The old one goes first, so that both never need memory together.
            self.table = None;
            self.table = Some((table.stamp(), DeviceTable::upload(&self.gpu, tracer.domain(), table)?));
        }
        Ok(())
    }
}

/// What the renderer counted of the answers.
fn tally(stats: &RenderStats) -> Tally {
    Tally { queries: stats.queries, traced: stats.traced, missing: stats.missing, ..Tally::default() }
}

impl DeviceRenderer for CudaFrames {
    /// With RK4 alone, or with a table; networks, and labels that are a flow map, need the CPU.
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
        let asked = answers.asked();
        let table = asked.surrogate.and_then(|surrogate| surrogate.as_any()).and_then(|any| any.downcast_ref::<Table>());
        if asked.flow_map || table.is_some() != asked.surrogate.is_some() {
            return Ok(None);
        }
        let samples = 0..u32::try_from(samples).unwrap_or(u32::MAX);
        if table.is_none() && tracer.land().is_none() && asked.keep <= 1 {
            let mut every = Traced(tracer.device());
            let (film, stats) = self.renderer.render_samples(renderer, picture, samples, &mut every, progress, stop)?;
            answers.answered_elsewhere(Tally { trace_seconds: stats.evaluate_seconds, ..tally(&stats) }, Samples::default());
            return Ok(Some((film, stats)));
        }
        if let Some(table) = table {
            self.copy_of(table, tracer)?;
        }
        let mut divided = self.division.begin(Panel {
            tracer: tracer.device(),
            domain: tracer.domain(),
            land: tracer.land(),
            surrogate: table.and(self.table.as_ref()).map(|(_, table)| table as &dyn DevicePredict),
            gate: asked.gate,
            trace_budget: asked.trace_budget,
            keep: asked.keep,
        })?;
        let (film, stats) = self.renderer.render_samples(renderer, picture, samples, &mut divided, progress, stop)?;
        let tally = Tally {
            over_budget: self.renderer.over_budget(),
            trace_seconds: divided.trace_seconds(),
            predict_seconds: divided.predict_seconds(),
            ..tally(&stats)
        };
        answers.answered_elsewhere(tally, divided.labels());
        Ok(Some((film, stats)))
    }
}
