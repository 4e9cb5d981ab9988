//! Preparation of a slide before its frames: surrogate, tables, probes and the pilot picture.

use super::TransferRecord;
use super::doubts::{beyond_colours, uniform_ftle};
use super::slides::Slide;
use super::state::{MAX_RENDER_RESIDUALS, Run};
use super::stop::{RunEnd, check_stop};
use super::transaction::{On, present};
use crate::backend::{
    Backend, FrameJob, FrameSamples, Interruptible, Rendered, Routing, Surrogate, SurrogateRequest, audit, residuals, stratified_points,
};
use crate::field::DomainPoint;
use crate::flow::{Extras, FlowMap, Steps, Traced, Tracer};
use crate::progress::Work;
use crate::render::Method;
use crate::surrogate::network::{Input, uniform};
use crate::surrogate::{Kind, Samples, Trace};
use crate::trust::{Audited, Gate, Residual, Strata};
use rayon::prelude::*;
use std::time::Instant;

/// Number of frames whose samples the replay buffer can hold at least: a frame keeps at most this part of the capacity.
const FRAMES_IN_BUFFER: usize = 4;
/// Random stream of the first probe; audit points use other streams.
const PROBE_STREAM: u64 = 1 << 62;
/// First random stream of the points at which shorter durations are traced.
const SHORTER_STREAM: u64 = 1 << 61;
/// Work on a flow map: its steps may be chosen, and a device takes the window, and at first compiles kernels.
pub(super) const FLOW_MAP: &str = "preparing the flow map";
/// Picture number of the pilot.
const PILOT_PICTURE: u64 = 1 << 41;

impl Run<'_> {
    /// Builds the surrogate at the present size.
    pub(super) fn build_surrogate<B: Backend>(&mut self, on: &mut On<B>) -> Result<(), RunEnd> {
        let (scene, learning) = (&self.plan.scene, &self.learning);
        let plain = || (learning.settings.clone(), learning.network.clone());
        let (settings, network) =
            learning.sizing.as_ref().map_or_else(plain, |sizing| sizing.settings(&learning.settings, &learning.network));
        let request = SurrogateRequest {
            settings: &settings,
            network: &network,
            domain: &self.plan.domain,
            seed: scene.seed,
            replay_buffer: scene.training.replay_buffer,
            stop: self.stop,
        };
        let (On { backend, tracer, surrogate, .. }, begin) = (on, Instant::now());
        let tracer = present(tracer);
        let _work = Work::begin("building the surrogate");
        let built = self.threads.render().install(|| backend.surrogate(&request, tracer))?;
        check_stop(self.stop)?;
        *surrogate = Some(built);
        self.progress.last_audit = None;
        self.learning.need.restart();
        self.progress.surrogate_seconds = begin.elapsed().as_secs_f64();
        self.progress.warnings.extend(backend.warnings());
        Ok(())
    }

    /// Builds the surrogate at another size. The samples in the replay buffer train it.
    pub(super) fn rebuild_surrogate<B: Backend>(&mut self, on: &mut On<B>) -> Result<(), RunEnd> {
        // The device may have no room for two tables. The old surrogate stays until the new one is built, for a checkpoint after a stop.
        if let Some(surrogate) = &mut on.surrogate {
            surrogate.release()?;
        }
        self.build_surrogate(on)?;
        if let (Some(resize), Some(surrogate)) = (&self.learning.resize, &on.surrogate) {
            let text = format!("frame {}: {} ({:.2} MB)", self.progress.frame, resize.why, surrogate.bytes() as f64 / 1e6);
            tracing::info!("{text}");
            self.report.sizes.push(text);
        }
        Ok(())
    }

    /// Notes that the surrogate has its new size.
    pub(super) fn resized(&mut self) {
        self.learning.resize = None;
    }

    /// Uploads the window of a slide and prepares its flow map.
    pub(super) fn next_tracer<B: Backend>(&mut self, on: &mut On<B>, slide: &Slide, map: &FlowMap) -> Result<(), RunEnd> {
        let On { backend, tracer, .. } = on;
        let _work = Work::begin(FLOW_MAP);
        *tracer = Some(self.threads.render().install(|| backend.tracer(&slide.velocity, map, slide.time))?);
        Ok(())
    }

    /// Moves the surrogate to the session's window.
    pub(super) fn slide_surrogate<B: Backend>(&mut self, on: &mut On<B>) -> Result<(), RunEnd> {
        let (On { tracer, surrogate, .. }, begin) = (on, Instant::now());
        if let Some(surrogate) = surrogate {
            let _work = Work::begin("moving the surrogate to the window");
            let tracer = present(tracer);
            self.threads.render().install(|| surrogate.window_slid(tracer, self.stop))?;
            check_stop(self.stop)?;
            self.progress.surrogate_seconds = begin.elapsed().as_secs_f64();
            self.progress.last_audit = None;
        }
        Ok(())
    }

    /// Moves trust and labels to the session's window. Old labels remain in use if a test confirms them.
    pub(super) fn slide_labels<B: Backend>(&mut self, on: &mut On<B>) -> Result<(), RunEnd> {
        let flow = on.tracer().flow();
        let holds = self.learning.times.labels_stay_valid(self.learning.start, flow.start());
        let share = if holds { None } else { Some(self.share_of_labels_that_hold(on)?) };
        let learning = &mut self.learning;
        learning.trust.window_slid();
        learning.start = flow.start();
        if let Some(share) = share {
            learning.need.restart();
            learning.buffer.mark_stale();
            learning.buffer.revalidate(share);
        } else {
            learning.need.window_slid();
        }
        if !self.plan.scene.network.inputs.is_empty() {
            learning.buffer.set_now(learning.times.unit(flow.start(), flow.tau()));
        }
        Ok(())
    }

    /// Describes the colour scale.
    pub(super) fn colours(&self) -> String {
        let TransferRecord { low, high, extinction } = self.transfer;
        let unit = &self.plan.time_unit;
        let per = if unit.is_empty() { "per time".to_owned() } else { format!("/{unit}") };
        let given = self.plan.scene.transfer.as_ref().is_some_and(|transfer| transfer.low.is_some() && transfer.high.is_some());
        let is_map = self.render.method == Method::Map;
        let why = match (given, is_map) {
            (true, _) => "as set",
            (false, true) => "as far as not set: 0 or a low percentile, and the 99.5th over the domain at the first slide",
            (false, false) => "as far as not set: median and 99.5th percentile over the domain at the first slide",
        };
        let extinction = if is_map { String::new() } else { format!(", extinction {extinction:.3e}") };
        format!("colours from FTLE {low:.3e} to {high:.3e} {per} ({why}){extinction}")
    }

    /// Warning for colours that show no values, or are scaled to an FTLE that hardly varies; `None` otherwise.
    pub(super) fn colourless(&self, tracer: &dyn Tracer) -> Option<String> {
        let given = self.plan.scene.transfer.clone().unwrap_or_default();
        let TransferRecord { low, high, .. } = self.transfer;
        if given.low.is_some() && given.high.is_some() {
            return self.threads.render().install(|| beyond_colours(tracer, &self.transfer, &self.plan.time_unit));
        }
        uniform_ftle([low, high], tracer.tau(), self.report.integration_difference, "transfer.low and transfer.high")
    }

    /// Warning for a window that starts outside the range of the network's input; `None` otherwise.
    pub(super) fn beyond_the_range(&self, start: f64) -> Option<String> {
        let [first, last] = self
            .learning
            .times
            .starts
            .filter(|_| self.plan.scene.render.method.has_surrogate() && !self.learning.times.covers_start(start))?;
        Some(format!(
            "start time {start} lies beyond network.start_range, {first} to {last}: the network uses the nearer end, and labels of other windows are not kept"
        ))
    }

    /// Traces some points per cell before the first frame of a slide. They tighten the majorants, and their residuals build up trust without
    /// tracing a whole frame. Since they decide the gate, the stated error does not use them; it uses audit points only. A map has neither.
    pub(super) fn probe<B: Backend>(&mut self, on: &mut On<B>, slide: u64) -> Result<(), RunEnd> {
        self.progress.last_audit = None;
        if self.render.method == Method::Map {
            return Ok(());
        }
        let scene = &self.plan.scene;
        let per_cell = scene.trust.min_samples.ceil() as usize;
        let strata = Strata::even(self.learning.trust.shape(), per_cell as u32);
        let unit = stratified_points(&strata, scene.seed, PROBE_STREAM + slide);
        let extras = self.label_extras();
        let interruptible = Interruptible::new(on.tracer(), self.stop);
        let probe = self.threads.render().install(|| audit::trace(&interruptible, &unit, extras))?;
        check_stop(self.stop)?;
        let residuals = self.residuals_of(on, &probe.samples)?;
        // The steps below cannot fail.
        let domain = on.tracer().flow().domain();
        let renderer = &mut self.renderer;
        self.threads.render().install(|| {
            let points: Vec<DomainPoint> =
                probe.samples.points.par_iter().with_min_len(1 << 12).map(|&unit| domain.from_unit(unit)).collect();
            renderer.observe(&points, &probe.samples.log_stretch);
        });
        self.progress.preparation_traces += probe.drawn as u64;
        if let Some(residuals) = residuals {
            self.learning.trust.observe(Some(&Audited::of(&residuals, strata)), &[]);
            self.keep_samples(on, &probe.samples);
        }
        Ok(())
    }

    /// Renders a picture of one sample per pixel, traced and not shown, to tighten the majorants. A new renderer uses the largest majorant
    /// everywhere, which costs several times as many queries. A map has none.
    pub(super) fn pilot<B: Backend>(&mut self, on: &mut On<B>) -> Result<(), RunEnd> {
        if self.render.method == Method::Map {
            return Ok(());
        }
        let gate = Gate::uniform(false);
        let routing = Routing { gate: &gate, trace_budget: None, keep: self.labels_per_frame(on), extras: self.label_extras() };
        let On { backend, tracer, .. } = &mut *on;
        let work = Work::begin("rendering a first picture with one sample a pixel");
        let report = |share: f32| work.reached_share(f64::from(share));
        let job = FrameJob {
            tracer: present(tracer),
            surrogate: None,
            routing,
            picture: PILOT_PICTURE,
            samples: 1.0,
            smooth: None,
            is_map: false,
            progress: Some(&report),
            stop: self.stop,
        };
        let mut renderer = self.renderer.clone();
        let mut picture = B::Picture::default();
        let rendered = self.threads.render().install(|| backend.render(&job, &mut renderer, &mut picture))?;
        check_stop(self.stop)?;
        let Rendered { tally, samples, .. } = rendered;
        let residuals = self.residuals_of(on, samples.on_host())?;
        self.renderer = renderer;
        self.progress.preparation_traces += tally.traced;
        if let Some(residuals) = residuals {
            self.learning.trust.observe(None, &residuals);
            self.keep_samples(on, &samples.commit());
        }
        Ok(())
    }

    /// Maximum number of traced samples that a frame keeps on the host: as many as training can use. If the device trains, it learns from all its
    /// traces, and the host keeps as many as trust can use.
    pub(super) fn labels_per_frame<B: Backend>(&self, on: &On<B>) -> usize {
        let share = self.plan.scene.training.replay_buffer / FRAMES_IN_BUFFER;
        let trains_here = |surrogate: &B::Surrogate| surrogate.learns() && !surrogate.trains_on_device();
        on.surrogate.as_ref().map_or(0, |surrogate| if trains_here(surrogate) { share } else { share.min(MAX_RENDER_RESIDUALS) })
    }

    /// Residuals of the surrogate on some of the samples; `None` without a surrogate.
    fn residuals_of<B: Backend>(&self, on: &On<B>, samples: &Samples) -> Result<Option<Vec<Residual>>, RunEnd> {
        let Some(surrogate) = &on.surrogate else { return Ok(None) };
        let frozen = surrogate.freeze()?;
        let some = every(samples, samples.len().div_ceil(MAX_RENDER_RESIDUALS).max(1));
        let tau = on.tracer().flow().tau();
        Ok(Some(self.threads.render().install(|| residuals(&frozen, &some, self.renderer.transfer(), tau))?))
    }

    /// Keeps samples for training, if the surrogate learns.
    pub(super) fn keep_samples<B: Backend>(&mut self, on: &On<B>, samples: &Samples) {
        if on.surrogate.as_ref().is_some_and(Surrogate::learns) {
            self.learning.buffer.push(samples);
        }
    }

    /// Labels that the network needs besides the log-stretch.
    pub(super) fn label_extras(&self) -> Extras {
        let scene = &self.plan.scene;
        if scene.surrogate.kind == Kind::Table { Extras::default() } else { scene.network.label_extras() }
    }

    /// Traces labels of durations below tau, if the duration is an input of the network: stratified durations in (0, tau], drawn again for every
    /// frame, each at one point per cell. They precede the frame because later losses are judged against that of the first optimizer step.
    pub(super) fn learn_shorter<B: Backend>(&mut self, on: &mut On<B>, slide: &Slide) -> Result<(), RunEnd> {
        const DURATIONS: u64 = 16;
        let learns = on.surrogate.as_ref().is_some_and(Surrogate::learns);
        if !learns || !self.plan.scene.network.inputs.contains(&Input::Duration) {
            return Ok(());
        }
        let (flow, seed, extras) = (on.tracer().flow(), self.plan.scene.seed, self.label_extras());
        let tau = flow.tau();
        let strata = Strata::even(self.learning.trust.shape(), 1);
        let mut found = Vec::new();
        for part in 0..DURATIONS {
            let draw = DURATIONS * self.progress.frame + part;
            let duration = tau * ((part + 1) as f64 - f64::from(uniform(seed, draw))) / DURATIONS as f64;
            let steps = match on.tracer().flow().steps() {
                0 => self.asked.steps,
                steps => Steps::Fixed((steps as f64 * duration / tau).ceil() as usize),
            };
            let map = FlowMap { tau: duration, steps, ..self.asked.clone() };
            let unit = stratified_points(&strata, seed, SHORTER_STREAM + draw);
            let backend = &mut on.backend;
            let shorter = self.threads.render().install(|| backend.tracer(&slide.velocity, &map, slide.time))?;
            let interruptible = Interruptible::new(&shorter, self.stop);
            let mut traced = self.threads.render().install(|| audit::trace(&interruptible, &unit, extras))?;
            traced.samples.times = vec![self.learning.times.unit(slide.time, duration); traced.samples.len()];
            found.push(traced);
        }
        for traced in found {
            self.progress.preparation_traces += traced.drawn as u64;
            self.learning.buffer.push(&traced.samples);
        }
        Ok(())
    }

    /// Traces some labels again. Returns the share whose new value differs by at most the tolerance on the transfer function's ramp.
    fn share_of_labels_that_hold<B: Backend>(&self, on: &On<B>) -> Result<f64, RunEnd> {
        const PROBES: usize = 2048;
        let (labels, flow) = (self.learning.buffer.samples(), on.tracer().flow());
        let mut chosen = self.learning.buffer.probe(PROBES, self.plan.scene.seed, self.progress.frame);
        // This tracer cannot test labels of shorter durations; they are assumed to hold if the others do.
        chosen.retain(|&i| labels.times_of(i)[1] == 1.0);
        let points: Vec<DomainPoint> = chosen.iter().map(|&i| flow.domain().from_unit(labels.points[i])).collect();
        let mut traced = Traced::default();
        let interruptible = Interruptible::new(on.tracer(), self.stop);
        self.threads.render().install(|| interruptible.trace(&points, Extras::default(), &mut traced))?;
        check_stop(self.stop)?;
        let ramp = |s: f32| self.renderer.transfer().ramp(s / flow.tau() as f32);
        let holds = |(&i, &s): (&usize, &f32)| f64::from((ramp(s) - ramp(labels.log_stretch[i])).abs()) <= self.learning.trust.tolerance();
        let held = chosen.iter().zip(&traced.log_stretch).filter(|pair| holds(*pair)).count();
        Ok(held as f64 / chosen.len().max(1) as f64)
    }
}

/// Every `stride`-th sample, with its log-stretch only.
pub(super) fn every(samples: &Samples, stride: usize) -> Samples {
    Samples {
        points: samples.points.iter().copied().step_by(stride).collect(),
        log_stretch: samples.log_stretch.iter().copied().step_by(stride).collect(),
        ..Samples::default()
    }
}
