//! Films of a run, made on the GPU alone where every query can be answered there.

use super::audit::Audits;
use super::predictor::{self, Predictor, Predictors};
use super::{CudaTracer, DeviceError, DevicePredict, Division, Gpu, GpuRenderer, Panel, Traced};
use crate::engine::accelerator::DeviceRenderer;
use crate::engine::{Answers, AuditFindings, AuditRequest, EngineError, Tally};
use crate::flow::Tracer;
use crate::render::{Film, RenderStats, Renderer};
use crate::surrogate::{Predict, Samples};
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

/// Walks, traces, predicts and audits on the GPU.
pub struct CudaFrames {
    renderer: GpuRenderer,
    division: Division,
    audits: Audits,
    predictors: Predictors,
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
            predictors: Predictors::new(gpu),
        })
    }
}

/// The tracer, where it is one of this engine's.
fn own(tracer: &dyn Tracer) -> Option<&CudaTracer> {
    tracer.as_any()?.downcast_ref()
}

/// What the renderer counted of the answers.
fn tally(stats: &RenderStats) -> Tally {
    Tally { queries: stats.queries, traced: stats.traced, missing: stats.missing, ..Tally::default() }
}

impl DeviceRenderer for CudaFrames {
    /// With RK4 alone, with a table, or with a network that the kernels take; the others, and Jacobians as labels, need the CPU.
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
        let pool = answers.asked().surrogate.and_then(predictor::pool);
        let before = pool.as_ref().map(|pool| pool.mark());
        let rendered = self.rendered(renderer, picture, samples, tracer, answers, progress, stop);
        // The CPU makes the frame again, and its labels go to the ring, those that are held out among them.
        if let (Err(_), Some(pool), Some(before)) = (&rendered, pool, before) {
            pool.go_back(before);
        }
        rendered
    }

    fn let_go_of_tables(&mut self) {
        self.predictors.let_go_of_tables();
    }

    /// Where the surrogate predicts on the device, unless Jacobians are to come back.
    fn audit(
        &mut self,
        request: &AuditRequest<'_>,
        tracer: &dyn Tracer,
        surrogate: &dyn Predict,
    ) -> Result<Option<AuditFindings>, DeviceError> {
        let jacobian = request.samples.is_some_and(|extras| extras.jacobian);
        let Some(tracer) = own(tracer).filter(|_| !jacobian) else { return Ok(None) };
        let Some(predictor) = self.predictors.of(surrogate, tracer)? else { return Ok(None) };
        self.audits.audit(request, tracer, &predictor).map(Some)
    }
}

impl CudaFrames {
    fn rendered(
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
        if asked.extras.jacobian {
            return Ok(None);
        }
        let predictor = match asked.surrogate {
            None => None,
            Some(surrogate) => match self.predictors.of(surrogate, tracer)? {
                None => return Ok(None),
                found => found,
            },
        };
        let samples = 0..u32::try_from(samples).unwrap_or(u32::MAX);
        if asked.surrogate.is_none() && tracer.land().is_none() && asked.keep <= 1 {
            let mut every = Traced(tracer.device());
            let (film, stats) = self.renderer.render_samples(renderer, picture, samples, &mut every, progress, stop)?;
            answers.answered_elsewhere(Tally { trace_seconds: stats.evaluate_seconds, ..tally(&stats) }, Samples::default());
            return Ok(Some((film, stats)));
        }
        let mut divided = self.division.begin(Panel {
            tracer: tracer.device(),
            domain: tracer.domain(),
            land: tracer.land(),
            surrogate: predictor.as_ref().map(|predictor| predictor as &dyn DevicePredict),
            label_sink: predictor.as_ref().and_then(Predictor::label_sink),
            gate: asked.gate,
            trace_budget: asked.trace_budget,
            keep: asked.keep,
            arrivals: asked.extras.arrival,
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
