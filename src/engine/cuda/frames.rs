//! Films of a run, made on the GPU alone where every query can be answered there.

use super::audit::Audits;
use super::{CudaTracer, DeviceError, DeviceNetwork, DevicePredict, DeviceTable, Division, Gpu, GpuRenderer, Panel, Traced};
use crate::engine::accelerator::DeviceRenderer;
use crate::engine::{Answers, AuditFindings, AuditRequest, EngineError, Tally};
use crate::flow::Tracer;
use crate::render::{Film, RenderStats, Renderer};
use crate::surrogate::{NetworkState, Predict, Samples, Table};
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

/// Walks, traces, predicts and audits on the GPU.
pub struct CudaFrames {
    gpu: Arc<Gpu>,
    renderer: GpuRenderer,
    division: Division,
    audits: Audits,
    /// The network that frames were last answered from, and the table below it, by their stamps.
    network: Option<(u64, DeviceNetwork)>,
    below: Option<(u64, Arc<DeviceTable>)>,
}

impl CudaFrames {
    /// Compiles the kernels, or takes them from the cache.
    ///
    /// # Errors
    /// What the compiler or the device says.
    pub fn new(gpu: &Arc<Gpu>) -> Result<Self, DeviceError> {
        Ok(Self {
            renderer: GpuRenderer::new(gpu)?,
            division: Division::new(gpu)?,
            audits: Audits::new(gpu)?,
            network: None,
            below: None,
            gpu: gpu.clone(),
        })
    }

    /// Brings a network over, and the table below it, where they are not there yet.
    fn bring(&mut self, state: &NetworkState<'_>, tracer: &CudaTracer) -> Result<(), DeviceError> {
        if self.network.as_ref().is_some_and(|(stamp, _)| *stamp == state.stamp) {
            return Ok(());
        }
        // The old ones go first, so that old and new never need memory together.
        self.network = None;
        let base = state.base.map(|(table, share)| Ok::<_, DeviceError>((self.below(table, tracer)?, share))).transpose()?;
        let network = DeviceNetwork::upload(&self.gpu, state.shape, state.objective, state.tables, state.layers, base)?;
        self.network = Some((state.stamp, network));
        Ok(())
    }

    /// The copy of a table that a network stands on.
    fn below(&mut self, table: &Table, tracer: &CudaTracer) -> Result<Arc<DeviceTable>, DeviceError> {
        if let Some((_, copy)) = self.below.as_ref().filter(|(stamp, _)| *stamp == table.stamp()) {
            return Ok(copy.clone());
        }
        self.below = None;
        let copy = Arc::new(DeviceTable::upload(&self.gpu, tracer.domain(), table)?);
        self.below = Some((table.stamp(), copy.clone()));
        Ok(copy)
    }
}

/// The tracer, where it is one of this engine's.
fn own(tracer: &dyn Tracer) -> Option<&CudaTracer> {
    tracer.as_any()?.downcast_ref()
}

/// What predicts on the device what a surrogate predicts; none where nothing does.
fn predictor(surrogate: &dyn Predict) -> Option<&dyn DevicePredict> {
    let table = surrogate.as_any()?.downcast_ref::<Table>()?;
    Some(DeviceTable::of(table)?)
}

/// What the renderer counted of the answers.
fn tally(stats: &RenderStats) -> Tally {
    Tally { queries: stats.queries, traced: stats.traced, missing: stats.missing, ..Tally::default() }
}

impl DeviceRenderer for CudaFrames {
    /// With RK4 alone, with a table, or with a network that the kernels take; the others, and labels that are a flow map, need the CPU.
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
        let Some(tracer) = own(tracer) else { return Ok(None) };
        let asked = answers.asked();
        let table = asked.surrogate.and_then(predictor);
        let network = asked.surrogate.and_then(Predict::network).filter(|state| DeviceNetwork::takes(&self.gpu, state.shape));
        if asked.flow_map || (table.is_some() || network.is_some()) != asked.surrogate.is_some() {
            return Ok(None);
        }
        let samples = 0..u32::try_from(samples).unwrap_or(u32::MAX);
        if asked.surrogate.is_none() && tracer.land().is_none() && asked.keep <= 1 {
            let mut every = Traced(tracer.device());
            let (film, stats) = self.renderer.render_samples(renderer, picture, samples, &mut every, progress, stop)?;
            answers.answered_elsewhere(Tally { trace_seconds: stats.evaluate_seconds, ..tally(&stats) }, Samples::default());
            return Ok(Some((film, stats)));
        }
        if let Some(state) = &network {
            self.bring(state, tracer)?;
        }
        let network = network.and(self.network.as_ref()).map(|(_, network)| network as &dyn DevicePredict);
        let mut divided = self.division.begin(Panel {
            tracer: tracer.device(),
            domain: tracer.domain(),
            land: tracer.land(),
            surrogate: network.or(table),
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

    /// Where the surrogate predicts on the device, unless flow maps are to come back.
    fn audit(
        &mut self,
        request: &AuditRequest<'_>,
        tracer: &dyn Tracer,
        surrogate: &dyn Predict,
    ) -> Result<Option<AuditFindings>, DeviceError> {
        let flow_map = request.samples.is_some_and(|extras| extras.arrival || extras.jacobian);
        match (own(tracer), predictor(surrogate)) {
            (Some(tracer), Some(predictor)) if !flow_map => self.audits.audit(request, tracer, predictor).map(Some),
            _ => Ok(None),
        }
    }
}
