//! What comes before a slide's frames: sizes, tables, probes and the pilot.

use super::{Cycle, KEEP_A_FRAME, RENDER_RESIDUALS};
use crate::engine::answers::Answers;
use crate::engine::audit;
use crate::engine::feed::Slide;
use crate::engine::setup::{Plan, assemble};
use crate::engine::stop::{Halt, Interruptible, heed};
use crate::engine::{Device, EngineError, TransferRecord};
use crate::flow::{Extras, FlowMap, Steps, Traced, Tracer};
use crate::render::Scene;
use crate::surrogate::network::{Input, Target, uniform};
use crate::surrogate::{Kind, Samples, Sizing, Surrogate, SurrogateError, SurrogateSettings};
use crate::trust::{Audited, Gate, Strata};
use rayon::prelude::*;

/// Random stream of the first probe, apart from those of audit points.
const PROBE_STREAM: u64 = 1 << 62;
/// Random streams of points at which shorter durations are traced.
const SHORTER_STREAM: u64 = 1 << 61;
/// Range of the log-stretch below which colours that are scaled to it show next to nothing: neighbours part by less than five hundredths more
/// in one place than in another.
const UNIFORM: f64 = 0.05;
/// The same as a share of the FTLE's size.
const UNIFORM_SHARE: f64 = 0.01;
/// Number of the pilot's picture.
const PILOT_PICTURE: u64 = 1 << 41;

impl Cycle<'_> {
    /// Builds the surrogate anew where another size is due; whether it did. The samples in the ring train it.
    pub(super) fn resized(&mut self, tracer: &dyn Tracer) -> Result<bool, Halt> {
        let Some(resize) = self.resize.take() else { return Ok(false) };
        self.frames.let_go_of_tables();
        // So that two tables never need a device's memory together; kept until then, since it is what a stop would write.
        if let Some(live) = &mut self.live {
            live.leave_device();
        }
        let built = self.threads.render().install(|| build(self.plan, &self.surrogate, self.sizing.as_ref(), tracer, &self.options.device));
        heed(self.stop)?;
        let live = built?;
        let text = format!("frame {}: {} ({:.2} MB)", self.frame, resize.why, live.bytes() as f64 / 1e6);
        tracing::info!("{text}");
        self.report.sizes.push(text);
        self.live = Some(live);
        Ok(true)
    }

    /// The window moved: tables are traced anew, weights carry over, old labels must show that they still hold (unless the network knows of
    /// which window they are), trust must be earned again.
    pub(super) fn slid(&mut self, tracer: &dyn Tracer) -> Result<(), Halt> {
        let tracer = Interruptible::new(tracer, self.stop);
        self.peak = f32::NEG_INFINITY;
        self.frames.let_go_of_tables();
        let resized = self.resized(&tracer)?;
        if let Some(live) = &mut self.live {
            if !resized {
                self.threads.render().install(|| live.window_slid(&tracer));
                heed(self.stop)?;
            }
            self.trust.window_slid();
            let before = std::mem::replace(&mut self.start, tracer.start());
            if !self.times.hold(before, self.start) {
                self.ring.mark_stale();
                let holding = self.threads.render().install(|| self.share_of_labels_that_hold(&tracer));
                heed(self.stop)?;
                self.ring.revalidate(holding);
            }
            if !self.plan.scene.network.inputs.is_empty() {
                self.ring.set_now(self.times.unit(tracer.start(), tracer.tau()));
            }
        }
        let renderer = &mut self.renderer;
        self.threads.render().install(|| renderer.window_slid());
        Ok(())
    }

    /// What colours stand for, in words.
    pub(super) fn colours(&self) -> String {
        let TransferRecord { low, high, extinction } = self.transfer;
        let unit = &self.plan.time_unit;
        let per = if unit.is_empty() { "per time".to_owned() } else { format!("/{unit}") };
        let given = self.plan.scene.transfer.as_ref().is_some_and(|transfer| transfer.low.is_some() && transfer.high.is_some());
        let why = if given { "as set" } else { "as far as not set: median and 99.5th percentile over the domain at the first slide" };
        format!("colours from FTLE {low:.3e} to {high:.3e} {per} ({why}), extinction {extinction:.3e}")
    }

    /// What should be told where colours are scaled to an FTLE that hardly varies.
    pub(super) fn uniform(&self, tracer: &dyn Tracer) -> Option<String> {
        let given = self.plan.scene.transfer.clone().unwrap_or_default();
        if given.low.is_some() && given.high.is_some() {
            return None;
        }
        let TransferRecord { low, high, .. } = self.transfer;
        let range = (high - low) * tracer.tau();
        let error = self.report.integration_difference.unwrap_or(0.0);
        let size = low.abs().max(high.abs());
        (range <= error.max(UNIFORM) || high - low <= UNIFORM_SHARE * size).then(|| {
            format!(
                "FTLE is uniform: nothing to scale colours to. The log-stretch varies by {range:.1e} over the domain, and its integration error is {error:.1e}; transfer.low and transfer.high set the colours, a longer time.tau may show more"
            )
        })
    }

    /// What should be told of a window's start time.
    pub(super) fn beyond_the_range(&self, start: f64) -> Option<String> {
        let [first, last] = self.times.starts.filter(|_| self.live.is_some() && !self.times.tells(start))?;
        Some(format!(
            "start time {start} lies beyond network.start_range, {first} to {last}: the network takes it for the nearer end, and labels of other windows are not kept"
        ))
    }

    /// Traces some points a cell before the first frame of a slide. They tighten the majorants, and held against the surrogate they earn
    /// trust without tracing a whole frame. They decide the gate, so they say nothing about the error that is stated; audit points do.
    pub(super) fn probe(&mut self, tracer: &dyn Tracer, slide: u64) -> Result<(), Halt> {
        let scene = &self.plan.scene;
        let per_cell = scene.trust.min_samples.ceil() as usize;
        let strata = Strata::even(self.trust.shape(), per_cell as u32);
        let unit = audit::stratified_points(&strata, scene.seed, PROBE_STREAM + slide);
        let extras = self.label_extras();
        let interruptible = Interruptible::new(tracer, self.stop);
        let probe = self.threads.render().install(|| audit::trace(&interruptible, &unit, extras));
        heed(self.stop)?;
        let domain = tracer.domain();
        self.threads.render().install(|| {
            let points: Vec<[f32; 3]> = probe.samples.points.par_iter().with_min_len(1 << 12).map(|&unit| domain.from_unit(unit)).collect();
            self.renderer.observe(&points, &probe.samples.log_stretch);
        });
        self.preparation_traces += probe.drawn as u64;
        self.learn_of(tracer, &probe.samples, Some(&strata));
        Ok(())
    }

    /// A picture of one sample a pixel, by RK4 and for nobody's eyes: a renderer that has seen nothing walks with the largest majorant
    /// everywhere and makes several times the queries, so that the first frame had better not be its first.
    pub(super) fn pilot(&mut self, tracer: &dyn Tracer) -> Result<(), Halt> {
        let gate = Gate::uniform(false);
        let interruptible = Interruptible::new(tracer, self.stop);
        let mut answers = Answers::new(&interruptible, None, &gate, None, self.keep_a_frame()).with_extras(self.label_extras());
        let (renderer, frames, stop) = (&mut self.renderer, &mut self.frames, self.stop);
        self.threads.render().install(|| frames.render(renderer, PILOT_PICTURE, 1, tracer, &mut answers, None, stop))?;
        heed(stop)?;
        let (samples, traced) = (answers.samples, answers.tally.traced);
        self.preparation_traces += traced;
        self.learn_of(tracer, &samples, None);
        Ok(())
    }

    /// Traced samples that a frame keeps, at most: what training can use of them, or what trust can where nothing is trained here. (A device
    /// that trains learns from all that it traces.)
    pub(super) fn keep_a_frame(&self) -> usize {
        let ring = self.plan.scene.training.replay_buffer / KEEP_A_FRAME;
        let trains_here = |live: &dyn Surrogate| live.learns() && !live.is_offloaded();
        self.live.as_ref().map_or(0, |live| if trains_here(&**live) { ring } else { ring.min(RENDER_RESIDUALS) })
    }

    /// Holds traced samples, drawn over the domain as `strata` says or otherwise, against the surrogate, then keeps them for training.
    pub(super) fn learn_of(&mut self, tracer: &dyn Tracer, samples: &Samples, strata: Option<&Strata>) {
        let Some(live) = &self.live else { return };
        let front = live.freeze();
        let some = every(samples, samples.len().div_ceil(RENDER_RESIDUALS).max(1));
        let residuals = self.threads.render().install(|| audit::residuals(&*front, &some, self.renderer.transfer(), tracer.tau()));
        match strata {
            Some(strata) => self.trust.observe(Some(&Audited::of(&residuals, strata.clone())), &[]),
            None => self.trust.observe(None, &residuals),
        }
        if self.learns() {
            self.ring.push(samples);
        }
    }

    /// Whether the surrogate learns from samples.
    pub(super) fn learns(&self) -> bool {
        self.live.as_ref().is_some_and(|live| live.learns())
    }

    /// What the network learns from beside the log-stretch.
    pub(super) fn label_extras(&self) -> Extras {
        let network = &self.plan.scene.network;
        let arrival = network.target == Target::FlowMap && self.plan.scene.surrogate.kind != Kind::Table;
        Extras { arrival, jacobian: arrival && network.jacobian_weight > 0.0 }
    }

    /// Labels of durations below tau, where those are an input of the network: one from each of some even parts of (0, tau], drawn anew for every
    /// frame, at a point of each cell.
    /// They come before the frame, so that the first optimizer step, by whose loss later ones are judged, has seen some.
    pub(super) fn learn_shorter(&mut self, slide: &Slide, tracer: &dyn Tracer) -> Result<(), EngineError> {
        const DURATIONS: u64 = 16;
        if !self.learns() || !self.plan.scene.network.inputs.contains(&Input::Duration) {
            return Ok(());
        }
        let (tau, seed) = (tracer.tau(), self.plan.scene.seed);
        let strata = Strata::even(self.trust.shape(), 1);
        for part in 0..DURATIONS {
            let draw = DURATIONS * self.frame + part;
            let duration = tau * ((part + 1) as f64 - f64::from(uniform(seed, draw))) / DURATIONS as f64;
            let steps = match tracer.steps() {
                0 => self.plan.map.steps,
                steps => Steps::Fixed((steps as f64 * duration / tau).ceil() as usize),
            };
            let map = FlowMap { tau: duration, steps, ..self.plan.map.clone() };
            let unit = audit::stratified_points(&strata, seed, SHORTER_STREAM + draw);
            let extras = self.label_extras();
            let instead = "the CPU traced shorter durations";
            let (shorter, _) =
                self.threads.render().install(|| self.options.device.next_tracer(slide.velocity.clone(), &map, slide.time, instead))?;
            let interruptible = Interruptible::new(&*shorter, self.stop);
            let mut found = self.threads.render().install(|| audit::trace(&interruptible, &unit, extras));
            found.samples.times = vec![self.times.unit(slide.time, duration); found.samples.len()];
            self.preparation_traces += found.drawn as u64;
            self.ring.push(&found.samples);
        }
        Ok(())
    }

    /// Traces some of the old labels anew: the share whose ramp is within the tolerance of what the label says.
    pub(super) fn share_of_labels_that_hold(&self, tracer: &dyn Tracer) -> f64 {
        const PROBES: usize = 2048;
        let stale = self.ring.stale();
        let mut chosen = self.ring.probe(PROBES, self.plan.scene.seed, self.frame);
        // Those of shorter durations are not what this tracer finds; they hold as long as these do.
        chosen.retain(|&i| stale.times_of(i)[1] == 1.0);
        let points: Vec<[f32; 3]> = chosen.iter().map(|&i| tracer.domain().from_unit(stale.points[i])).collect();
        let mut traced = Traced::default();
        tracer.trace(&points, Extras::default(), &mut traced);
        let ramp = |s: f32| self.renderer.transfer().ramp(s / tracer.tau() as f32);
        let holds = |(&i, &s): (&usize, &f32)| f64::from((ramp(s) - ramp(stale.log_stretch[i])).abs()) <= self.plan.scene.trust.tolerance;
        let held = chosen.iter().zip(&traced.log_stretch).filter(|pair| holds(*pair)).count();
        held as f64 / chosen.len().max(1) as f64
    }
}

/// The surrogate at its size, trained on the device where that trains it.
pub(super) fn build(
    plan: &Plan,
    settings: &SurrogateSettings,
    sizing: Option<&Sizing>,
    tracer: &dyn Tracer,
    device: &Device,
) -> Result<Box<dyn Surrogate>, SurrogateError> {
    let scene = &plan.scene;
    let plain = || (settings.clone(), scene.network.clone());
    let (settings, network) = sizing.map_or_else(plain, |sizing| sizing.settings(settings, &scene.network));
    let mut surrogate = crate::surrogate::build(&settings, &network, &plan.domain, scene.seed, tracer)?;
    if let Some(offload) = device.offload() {
        surrogate.offload(&offload);
    }
    Ok(surrogate)
}

pub(super) fn every(samples: &Samples, stride: usize) -> Samples {
    Samples {
        points: samples.points.iter().copied().step_by(stride).collect(),
        log_stretch: samples.log_stretch.iter().copied().step_by(stride).collect(),
        ..Samples::default()
    }
}

/// The picture's scene. What the scene file leaves open of the transfer function is scaled to the FTLE of the first slide and kept
/// for the whole run, so that colours compare.
pub(super) fn settled_scene(plan: &Plan, tracer: &dyn Tracer, slide: &Slide) -> Result<Scene, EngineError> {
    let file = &plan.scene;
    let mut scene = assemble(file, &plan.domain);
    if scene.transfer.low.is_none() || scene.transfer.high.is_none() {
        const PROBES: usize = 64;
        let z = if plan.domain.dimensions == 3 { 16 } else { 1 };
        let unit = audit::stratified_points(&Strata::even([PROBES, PROBES, z], 1), file.seed, u64::MAX);
        let labels = audit::trace(tracer, &unit, Extras::default()).samples.log_stretch;
        let ftle: Vec<f32> = labels.iter().map(|s| s / tracer.tau() as f32).filter(|f| f.is_finite()).collect();
        if ftle.is_empty() {
            return Err(EngineError::AllMissing {
                points: unit.len(),
                when: slide.date.clone().unwrap_or_else(|| format!("time {}", slide.time)),
            });
        }
        scene.transfer = scene.transfer.scaled_to(&ftle);
    }
    Ok(scene)
}
