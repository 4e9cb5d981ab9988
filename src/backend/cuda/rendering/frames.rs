//! Frames that are rendered and audited entirely on the GPU: connects renderer, query router, predictors and audits.

use super::audit::Audits;
use super::predictor::Predictor;
use super::renderer::GpuRenderer;
use super::router::{DevicePredict, DeviceQueryRouter, FrameQueries, TraceAll};
use super::smooth::{GpuSmooth, SmoothRound};
use crate::cuda::driver::Gpu;
use crate::cuda::network::{Filled, LabelPool, OnGpu};
use crate::cuda::tracing::CudaTracer;
use crate::{AuditFindings, AuditRequest, Backend, DeviceError, FrameJob, FrameSamples, Rendered, Smooth, Tally};
use ridgewatch_render::smooth::PictureError;
use ridgewatch_render::{Film, RenderStats, Renderer};
use ridgewatch_surrogate::{FrozenHybrid, Samples};
use ridgewatch_trust::Gate;
use std::sync::Arc;

/// Renders and audits frames. It reuses kernels and memory between frames.
pub struct GpuFrames {
    renderer: GpuRenderer,
    router: DeviceQueryRouter,
    audits: Audits,
    /// The picture that accumulates. `None` before the first smooth frame.
    smooth: Option<GpuSmooth>,
    gpu: Arc<Gpu>,
}

/// Labels of a frame: a part on the host, the rest in the label pool on the device. Dropping them without a commit removes them from the pool.
pub struct CudaSamples {
    host: Samples,
    uncommitted: Option<(Arc<LabelPool>, Filled)>,
}

impl CudaSamples {
    /// Creates labels that are on the host only.
    pub(in crate::cuda) fn on_host(host: Samples) -> Self {
        Self { host, uncommitted: None }
    }
}

impl FrameSamples for CudaSamples {
    fn on_host(&self) -> &Samples {
        &self.host
    }

    fn commit(mut self) -> Samples {
        self.uncommitted = None;
        std::mem::take(&mut self.host)
    }
}

impl Drop for CudaSamples {
    fn drop(&mut self) {
        if let Some((pool, before)) = self.uncommitted.take() {
            pool.go_back(before);
        }
    }
}

impl GpuFrames {
    /// Compiles the kernels or loads them from the cache.
    ///
    /// # Errors
    /// A kernel does not compile, or the device fails.
    pub fn new(gpu: &Arc<Gpu>) -> Result<Self, DeviceError> {
        Ok(Self {
            renderer: GpuRenderer::new(gpu)?,
            router: DeviceQueryRouter::new(gpu)?,
            audits: Audits::new(gpu)?,
            smooth: None,
            gpu: gpu.clone(),
        })
    }

    /// Renders a frame. Every query is traced if `surrogate` is `None`. A smooth frame refines the picture of these numbers of the window and itself.
    ///
    /// # Errors
    /// The device fails or lacks memory, or the renderer rejects the number of samples.
    pub fn render<B: Backend<Tracer = CudaTracer>>(
        &mut self,
        job: &FrameJob<'_, B>,
        surrogate: Option<&FrozenHybrid<OnGpu>>,
        renderer: &mut Renderer,
        [window, picture]: [u64; 2],
    ) -> Result<Rendered<CudaSamples>, DeviceError> {
        let (tracer, routing) = (job.tracer, job.routing);
        let progress = job.progress.map(|report| report as &dyn Fn(f32));
        let samples = 0..(job.samples.ceil() as u32);
        let counts =
            |stats: &RenderStats| Tally { queries: stats.queries, traced: stats.traced, missing: stats.missing, ..Tally::default() };
        if surrogate.is_none() && tracer.missing_cells().is_none() && routing.keep <= 1 {
            let mut all = TraceAll(tracer.device());
            let (film, stats) = self.renderer.render_samples(renderer, job.picture, samples, &mut all, progress, job.stop)?;
            let tally = Tally { trace_seconds: stats.evaluate_seconds, ..counts(&stats) };
            return Ok(Rendered { film, stats, tally, samples: CudaSamples::on_host(Samples::default()), error: None });
        }
        let predictor = surrogate.map(|frozen| Predictor::of(frozen, tracer)).transpose()?;
        if let (Some(smooth), Some(frozen), Some(predictor)) = (job.smooth, surrogate, &predictor) {
            return self.refine(job, smooth, frozen, predictor, renderer, [window, picture]);
        }
        let pool = surrogate.and_then(|frozen| frozen.network.as_ref()?.pool().cloned());
        let mut labels = CudaSamples { host: Samples::default(), uncommitted: pool.map(|pool| (pool.clone(), pool.mark())) };
        let mut answers = self.router.begin(FrameQueries {
            tracer: tracer.device(),
            domain: tracer.host().domain(),
            missing_cells: tracer.missing_cells(),
            surrogate: predictor.as_ref().map(|predictor| predictor as &dyn DevicePredict),
            label_sink: predictor.as_ref().and_then(Predictor::label_sink),
            gate: routing.gate,
            trace_budget: routing.trace_budget,
            keep: routing.keep,
            extras: routing.extras,
        })?;
        let (film, stats) = self.renderer.render_samples(renderer, job.picture, samples, &mut answers, progress, job.stop)?;
        let tally = Tally {
            over_budget: self.renderer.over_budget(),
            trace_seconds: answers.trace_seconds(),
            predict_seconds: answers.predict_seconds(),
            ..counts(&stats)
        };
        labels.host = answers.labels();
        Ok(Rendered { film, stats, tally, samples: labels, error: None })
    }

    /// Renders a smooth frame.
    fn refine<B: Backend<Tracer = CudaTracer>>(
        &mut self,
        job: &FrameJob<'_, B>,
        smooth: Smooth,
        frozen: &FrozenHybrid<OnGpu>,
        predictor: &Predictor<'_>,
        renderer: &mut Renderer,
        [window, picture]: [u64; 2],
    ) -> Result<Rendered<CudaSamples>, DeviceError> {
        let (tracer, routing) = (job.tracer, job.routing);
        let own = match self.smooth.take() {
            Some(own) => own,
            None => GpuSmooth::new(&self.gpu)?,
        };
        let own = self.smooth.insert(own);
        let table = match predictor {
            Predictor::Table(table) => Some(*table),
            Predictor::Network(..) => None,
        };
        let (frame, samples, gate, stop) = (job.picture, job.samples, routing.gate, job.stop);
        let round = SmoothRound { smooth, picture, window, gate, frame, samples, tracer, table, predictor, stop };
        let pool = frozen.network.as_ref().and_then(|network| network.pool().cloned());
        let mut labels = CudaSamples { host: Samples::default(), uncommitted: pool.map(|pool| (pool.clone(), pool.mark())) };
        let nothing_trusted = Gate::uniform(false);
        let (refined, trace_seconds) = if routing.keep <= 1 && predictor.label_sink().is_none() {
            let refined = own.refine(&round, renderer, &mut TraceAll(tracer.device()))?;
            let seconds = refined.as_ref().map_or(0.0, |(_, stats, _)| stats.evaluate_seconds);
            (refined, seconds)
        } else {
            let mut answers = self.router.begin(FrameQueries {
                tracer: tracer.device(),
                domain: tracer.host().domain(),
                missing_cells: tracer.missing_cells(),
                surrogate: None,
                label_sink: predictor.label_sink(),
                gate: &nothing_trusted,
                trace_budget: None,
                keep: routing.keep,
                extras: routing.extras,
            })?;
            let refined = own.refine(&round, renderer, &mut answers)?;
            labels.host = answers.labels();
            (refined, answers.trace_seconds())
        };
        if let Some(report) = job.progress {
            report(1.0);
        }
        let Some((film, stats, error)) = refined else {
            let settings = &renderer.scene().settings;
            let (film, stats) =
                (Film::new(settings.width, settings.height).into(), RenderStats { stopped: true, ..RenderStats::default() });
            return Ok(Rendered { film, stats, tally: Tally::default(), samples: labels, error: None });
        };
        let tally = Tally {
            queries: stats.queries,
            traced: stats.traced,
            missing: stats.missing,
            nodes: own.traced_nodes(),
            untraced_share: own.untraced_share().filter(|_| job.smooth.is_some_and(|smooth| smooth.traced_nodes > 0)),
            trace_seconds,
            ..Tally::default()
        };
        Ok(Rendered { film, stats, tally, samples: labels, error: Some(error).filter(PictureError::is_known) })
    }

    /// Audits a frame.
    ///
    /// # Errors
    /// The device fails or lacks memory.
    pub fn audit(
        &mut self,
        request: &AuditRequest<'_>,
        tracer: &CudaTracer,
        surrogate: &FrozenHybrid<OnGpu>,
    ) -> Result<AuditFindings, DeviceError> {
        self.audits.audit(request, tracer, &Predictor::of(surrogate, tracer)?)
    }
}
