//! The cycle: slide, render with the weights of the cycle before, test, then train.
//!
//! While one group of threads renders frame n with frozen weights, another trains the live ones on the samples of the frames
//! before. Samples traced for frame n are held against the frozen weights, which have not seen them, before they go to the ring.

use super::answers::Answers;
use super::audit;
use super::feed::{Feed, Slide};
use super::frames::{FrameRenderer, frame_renderer};
use super::setup::{Plan, Setup, assemble};
use super::stop::{Halt, Interruptible, heed};
use super::training::{Threads, Until, train};
use super::{Device, EngineError, Frame, FrameRecord, StageSeconds};
use crate::flow::{Extras, FlowMap, Steps, TimeResolution, Traced, Tracer, VelocitySource, time_resolution};
use crate::render::{Method, Renderer, Scene};
use crate::surrogate::network::{Size, Target};
use crate::surrogate::{Kind, Learned, Predict, Resize, SampleRing, Samples, Sizing, Surrogate, SurrogateError, SurrogateSettings};
use crate::trust::{Gate, Strata, TrustMap};
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;

/// What a run may be told besides its scene.
#[derive(Debug, Clone, Default)]
pub struct RunOptions {
    /// Fresh uniform points on which each frame's stated error is checked afterwards; 0: none.
    pub verify_points: usize,
    /// Wall-clock seconds after which no further frame is begun.
    pub seconds: Option<f64>,
    /// Worker threads; 0: all that the process may use.
    pub threads: usize,
    /// Where to write the trained surrogate at the end.
    pub checkpoint: Option<PathBuf>,
    /// Samples a pixel of warm-up frames; none: the scene's.
    pub warmup_samples: Option<usize>,
    /// What traces.
    pub device: Device,
}

/// What a run tells while it goes.
pub enum Event {
    /// Before the first frame: frames to come, where known.
    Begin {
        /// How many.
        frames: Option<u64>,
        /// What should be known.
        notes: Vec<String>,
    },
    /// A finished frame.
    Frame(Frame),
    /// Share of the current frame that is rendered.
    Progress(f32),
}

/// What a run came to.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct RunReport {
    /// Frames made.
    pub frames: u64,
    /// Slides seen.
    pub slides: u64,
    /// Whether it was stopped from outside.
    pub interrupted: bool,
    /// Seconds spent waiting for input.
    pub waited: f64,
    /// Optimizer steps.
    pub train_steps: u64,
    /// Runge-Kutta steps a path; none where each path chooses its own, or before there was a tracer.
    pub integration_steps: Option<usize>,
    /// Difference of the log-stretch from twice as many steps, where the steps were chosen by it (see [`crate::flow::Chosen`]).
    pub integration_difference: Option<f64>,
    /// Size of the surrogate, bytes.
    pub surrogate_bytes: usize,
    /// Changes of its size with `size = "auto"`, and why; a few dozen at most, since no size is tried in vain twice.
    pub sizes: Vec<String>,
    /// Whether the snapshots are close enough in time; none for closed forms.
    pub time_resolution: Option<TimeResolution>,
    /// Largest size of the window, bytes.
    pub window_bytes: usize,
}

/// Change of the FTLE when every second snapshot is dropped, as a share of its root mean square, from which a scene is called coarse.
const COARSE_IN_TIME: f64 = 0.25;
/// A frame keeps at most one in so many of the ring's places, so that the ring remembers several frames.
const KEEP_A_FRAME: usize = 4;
/// Residuals of rendered samples that go to the trust map each frame at most: beyond it their cells are known well enough.
const RENDER_RESIDUALS: usize = 1 << 16;

/// The state that goes from frame to frame.
struct Cycle<'a> {
    plan: &'a Plan,
    options: &'a RunOptions,
    threads: Threads,
    frames: Box<dyn FrameRenderer>,
    renderer: Renderer,
    trust: TrustMap,
    ring: SampleRing,
    live: Option<Box<dyn Surrogate>>,
    /// What it is built from, with the data's own nodes.
    surrogate: SurrogateSettings,
    /// Finds its size, with `size = "auto"`.
    sizing: Option<Sizing>,
    /// The size that the next frame should have.
    resize: Option<Resize>,
    frame: u64,
    /// Points traced since the last frame to prepare the next.
    probed: u64,
    /// Frames that were no warm-up.
    pictures: u64,
    /// Whether a lost device was told of.
    told_of_failure: bool,
    report: &'a mut RunReport,
    /// Set from outside when the run should end.
    stop: &'a AtomicBool,
    /// Largest log-stretch that audit points of this slide have met.
    peak: f32,
    began: Instant,
}

/// Where a frame stands in the run.
#[derive(Clone, Copy)]
struct Place {
    warmup: bool,
    /// Seconds that preparing the slide took, for its first frame.
    preparing: f64,
}

/// Random stream of the first probe, apart from those of audit points.
const PROBE_STREAM: u64 = 1 << 62;
/// Number of the pilot's picture.
const PILOT_PICTURE: u64 = 1 << 41;
/// Number of the first warm-up picture, far beyond all others.
const WARMUP_PICTURES: u64 = 1 << 40;

/// Runs the whole scene. `sink` gets every event. Setting `stop` ends the run after the current frame; where none is in progress
/// (while the window fills, tables are traced, or cells are probed) within about a second.
pub fn run(setup: Setup, options: &RunOptions, sink: &mut (dyn FnMut(Event) + Send), stop: &AtomicBool) -> Result<RunReport, EngineError> {
    let mut report = RunReport::default();
    match drive(setup, options, sink, stop, &mut report) {
        Ok(()) | Err(Halt::TimeIsUp) => {}
        Err(Halt::Stopped) => report.interrupted = true,
        Err(Halt::Failed(error)) => {
            // A lost device is the cause of what failed behind it.
            options.device.check()?;
            return Err(error);
        }
    }
    Ok(report)
}

fn drive(
    setup: Setup,
    options: &RunOptions,
    sink: &mut (dyn FnMut(Event) + Send),
    stop: &AtomicBool,
    report: &mut RunReport,
) -> Result<(), Halt> {
    let began = Instant::now();
    let Setup { plan, mut feed, slides, notes } = setup;
    let time = &plan.scene.time;
    let frames = slides.map(|s| s * time.frames_per_slide as u64 + time.warmup_frames as u64);
    sink(Event::Begin { frames, notes });
    let threads = Threads::new(options.threads, &plan.scene)?;
    if let Some(listener) = options.device.listener() {
        feed.tell(listener);
    }
    let first = feed.next_slide_unless(stop)?;
    heed(stop)?;
    let mut slide = first.ok_or(EngineError::EndedEarly)?;
    let begun = Instant::now();
    let (tracer, told) = threads.render.install(|| options.device.tracer(slide.velocity.clone(), &plan.map, slide.time))?;
    slide.warnings.extend(told);
    heed(stop)?;
    // The number of steps is settled once, on the first slide, so that frames compare.
    let map = match fixed_steps(&*tracer) {
        Some(steps) => FlowMap { steps: Steps::Fixed(steps), ..plan.map.clone() },
        None => plan.map.clone(),
    };
    let mut cycle = Cycle::new(&plan, options, threads, &Interruptible::new(&*tracer, stop), &slide, began, stop, report)?;
    let ended = cycle.first_slide(&*tracer, &map, &mut slide, begun, sink).and_then(|()| cycle.later_slides(&mut feed, &map, sink));
    // What was learned is kept whether or not the run was stopped.
    match ended {
        Err(Halt::Failed(error)) => Err(Halt::Failed(error)),
        ended => cycle.finish().map_err(Halt::Failed).and(ended),
    }
}

impl<'a> Cycle<'a> {
    fn new(
        plan: &'a Plan,
        options: &'a RunOptions,
        threads: Threads,
        tracer: &dyn Tracer,
        first: &Slide,
        began: Instant,
        stop: &'a AtomicBool,
        report: &'a mut RunReport,
    ) -> Result<Self, Halt> {
        let scene = &plan.scene;
        let settled = threads.render.install(|| settled_scene(plan, tracer, first.time));
        heed(stop)?;
        let renderer = Renderer::new(settled?, &plan.domain, plan.map.tau)?;
        let surrogate = match &first.velocity {
            VelocitySource::Window(window) => window.grid().map(|grid| scene.surrogate.at_resolution_of(grid.shape())),
            VelocitySource::Analytic(..) => None,
        };
        let surrogate = surrogate.unwrap_or_else(|| scene.surrogate.clone());
        let method = scene.render.method;
        let mut sizing = None;
        let mut live = if method == Method::Reference {
            None
        } else {
            if scene.network.size == Size::Auto {
                sizing = Some(Sizing::new(&surrogate, &scene.network, &plan.domain)?);
            }
            Some(threads.render.install(|| build(plan, &surrogate, sizing.as_ref(), tracer))?)
        };
        heed(stop)?;
        if let (Some(path), Some(surrogate)) = (&scene.training.resume, &mut live)
            && surrogate.learns()
        {
            surrogate.load(path)?;
            // Its table is that of another window, for all that is known.
            threads.render.install(|| surrogate.window_slid(tracer));
            heed(stop)?;
        }
        report.integration_steps = fixed_steps(tracer);
        report.integration_difference = tracer.chosen().map(|c| c.difference).filter(|difference| difference.is_finite());
        Ok(Self {
            plan,
            options,
            threads,
            frames: frame_renderer(&options.device),
            renderer,
            trust: TrustMap::new(&scene.trust, &plan.domain),
            ring: SampleRing::new(scene.training.ring),
            surrogate,
            sizing,
            resize: None,
            live,
            frame: 0,
            probed: 0,
            pictures: 0,
            told_of_failure: false,
            report,
            stop,
            peak: f32::NEG_INFINITY,
            began,
        })
    }

    /// Prepares the first slide, which was begun at `begun`, and renders its frames.
    fn first_slide(
        &mut self,
        tracer: &dyn Tracer,
        map: &FlowMap,
        slide: &mut Slide,
        begun: Instant,
        sink: &mut (dyn FnMut(Event) + Send),
    ) -> Result<(), Halt> {
        if let Some(chosen) = tracer.chosen().filter(|chosen| !chosen.met) {
            slide.warnings.push(format!(
                "{} steps a path, the most that are tried, still differ from twice as many by {:.3} (log-stretch, root mean square of the better 98 %)",
                chosen.steps, chosen.difference
            ));
        }
        if let VelocitySource::Window(window) = &slide.velocity {
            let resolution = self.threads.render.install(|| time_resolution(window, map, slide.time))?;
            if let Some(change) = resolution.ftle_change.filter(|change| *change > COARSE_IN_TIME * resolution.ftle_rms) {
                slide.warnings.push(format!(
                    "coarse in time: without every second snapshot the FTLE changes by {:.0} % of its root mean square",
                    100.0 * change / resolution.ftle_rms
                ));
            }
            self.report.time_resolution = Some(resolution);
        }
        self.pilot(tracer)?;
        self.probe(tracer, slide.index)?;
        self.frames(tracer, slide, begun, sink)
    }

    /// Goes on until the source ends.
    fn later_slides(&mut self, feed: &mut Feed, map: &FlowMap, sink: &mut (dyn FnMut(Event) + Send)) -> Result<(), Halt> {
        loop {
            let next = feed.next_slide_unless(self.stop)?;
            heed(self.stop)?;
            let Some(mut slide) = next else { return Ok(()) };
            let begun = Instant::now();
            let (tracer, told) = self.options.device.tracer(slide.velocity.clone(), map, slide.time)?;
            slide.warnings.extend(told);
            self.slid(&*tracer)?;
            self.probe(&*tracer, slide.index)?;
            self.frames(&*tracer, &mut slide, begun, sink)?;
        }
    }

    /// The frames of one slide.
    fn frames(&mut self, tracer: &dyn Tracer, slide: &mut Slide, begun: Instant, sink: &mut (dyn FnMut(Event) + Send)) -> Result<(), Halt> {
        let time = &self.plan.scene.time;
        let warmups = if slide.index == 0 { time.warmup_frames } else { 0 };
        for number in 0..warmups + time.frames_per_slide {
            let place = Place { warmup: number < warmups, preparing: if number == 0 { begun.elapsed().as_secs_f64() } else { 0.0 } };
            if self.resized(&Interruptible::new(tracer, self.stop))? {
                self.trust.reset();
                self.probe(tracer, slide.index)?;
            }
            let frame = self.frame(tracer, slide, place, sink)?;
            sink(Event::Frame(frame));
            heed(self.stop)?;
            if self.options.seconds.is_some_and(|seconds| self.began.elapsed().as_secs_f64() >= seconds) {
                return Err(Halt::TimeIsUp);
            }
        }
        Ok(())
    }

    /// Builds the surrogate anew where another size is due; whether it did. The samples in the ring train it.
    fn resized(&mut self, tracer: &dyn Tracer) -> Result<bool, Halt> {
        let Some(resize) = self.resize.take() else { return Ok(false) };
        let built = self.threads.render.install(|| build(self.plan, &self.surrogate, self.sizing.as_ref(), tracer));
        heed(self.stop)?;
        let live = built?;
        let text = format!("frame {}: {} ({:.2} MB)", self.frame, resize.why, live.bytes() as f64 / 1e6);
        tracing::info!("{text}");
        self.report.sizes.push(text);
        self.live = Some(live);
        Ok(true)
    }

    /// The window moved: tables are traced anew, weights carry over, old labels must show that they still hold, trust must be earned
    /// again.
    fn slid(&mut self, tracer: &dyn Tracer) -> Result<(), Halt> {
        let tracer = Interruptible::new(tracer, self.stop);
        self.peak = f32::NEG_INFINITY;
        let resized = self.resized(&tracer)?;
        if let Some(live) = &mut self.live {
            if !resized {
                self.threads.render.install(|| live.window_slid(&tracer));
                heed(self.stop)?;
            }
            self.trust.window_slid();
            self.ring.mark_stale();
            let holding = self.threads.render.install(|| self.share_of_labels_that_hold(&tracer));
            heed(self.stop)?;
            self.ring.revalidate(holding);
        }
        self.renderer.window_slid();
        Ok(())
    }

    /// Traces some points a cell before the first frame of a slide. They tighten the majorants, and held against the surrogate they earn
    /// trust without tracing a whole frame. They decide the gate, so they say nothing about the error that is stated; audit points do.
    fn probe(&mut self, tracer: &dyn Tracer, slide: u64) -> Result<(), Halt> {
        let scene = &self.plan.scene;
        let per_cell = scene.trust.min_samples.ceil() as usize;
        let strata = Strata::even(self.trust.shape(), per_cell as u32);
        let unit = audit::stratified_points(&strata, scene.seed, PROBE_STREAM + slide);
        let flow_map = self.wants_flow_map();
        let interruptible = Interruptible::new(tracer, self.stop);
        let probe = self.threads.render.install(|| audit::trace(&interruptible, &unit, flow_map));
        heed(self.stop)?;
        let points: Vec<[f32; 3]> = probe.samples.points.iter().map(|&unit| tracer.domain().from_unit(unit)).collect();
        self.renderer.observe(&points, &probe.samples.log_stretch);
        self.probed += probe.drawn as u64;
        self.learn_of(tracer, &probe.samples, Some(&strata));
        Ok(())
    }

    /// A picture of one sample a pixel, by RK4 and for nobody's eyes: a renderer that has seen nothing walks with the largest majorant
    /// everywhere and makes several times the queries, so that the first frame had better not be its first.
    fn pilot(&mut self, tracer: &dyn Tracer) -> Result<(), Halt> {
        let gate = Gate::uniform(false);
        let interruptible = Interruptible::new(tracer, self.stop);
        let keep = if self.live.is_some() { self.plan.scene.training.ring / KEEP_A_FRAME } else { 0 };
        let mut answers = Answers::new(&interruptible, None, &gate, None, keep).with_flow_map(self.wants_flow_map());
        let (renderer, frames, stop) = (&mut self.renderer, &mut self.frames, self.stop);
        self.threads.render.install(|| frames.render(renderer, PILOT_PICTURE, 1, tracer, &mut answers, None, stop))?;
        heed(stop)?;
        let (samples, traced) = (answers.samples, answers.tally.traced);
        self.probed += traced;
        self.learn_of(tracer, &samples, None);
        Ok(())
    }

    /// Holds traced samples, drawn over the domain as `strata` says or otherwise, against the surrogate, then keeps them for training.
    fn learn_of(&mut self, tracer: &dyn Tracer, samples: &Samples, strata: Option<&Strata>) {
        let Some(live) = &self.live else { return };
        let front = live.freeze();
        let some = every(samples, samples.len().div_ceil(RENDER_RESIDUALS).max(1));
        let residuals = self.threads.render.install(|| audit::residuals(&*front, &some, self.renderer.transfer(), tracer.tau()));
        match strata {
            Some(strata) => self.trust.observe(&residuals, strata, &[]),
            None => self.trust.observe(&[], &Strata::even(self.trust.shape(), 0), &residuals),
        }
        self.ring.push(samples);
    }

    fn wants_flow_map(&self) -> bool {
        self.plan.scene.network.target == Target::FlowMap && self.plan.scene.surrogate.kind != Kind::Table
    }

    /// Traces some of the old labels anew: the share whose ramp is within the tolerance of what the label says.
    fn share_of_labels_that_hold(&self, tracer: &dyn Tracer) -> f64 {
        const PROBES: usize = 2048;
        let stale = self.ring.stale();
        let chosen = self.ring.probe(PROBES, self.plan.scene.seed, self.frame);
        let points: Vec<[f32; 3]> = chosen.iter().map(|&i| tracer.domain().from_unit(stale.points[i])).collect();
        let mut traced = Traced::default();
        tracer.trace(&points, Extras::default(), &mut traced);
        let ramp = |s: f32| self.renderer.transfer().ramp(s / tracer.tau() as f32);
        let holds = |(&i, &s): (&usize, &f32)| f64::from((ramp(s) - ramp(stale.log_stretch[i])).abs()) <= self.plan.scene.trust.tolerance;
        let held = chosen.iter().zip(&traced.log_stretch).filter(|pair| holds(*pair)).count();
        held as f64 / chosen.len().max(1) as f64
    }

    fn frame(
        &mut self,
        tracer: &dyn Tracer,
        slide: &mut Slide,
        place: Place,
        sink: &mut (dyn FnMut(Event) + Send),
    ) -> Result<Frame, EngineError> {
        let start = Instant::now();
        let scene = &self.plan.scene;
        let method = scene.render.method;
        let gate = match method {
            Method::Gated => self.trust.gate(),
            Method::Reference => Gate::uniform(false),
            Method::Surrogate => Gate::uniform(true),
        };
        // Frozen weights: what is rendered with has not seen this frame's samples.
        let front: Option<Arc<dyn Predict>> = self.live.as_ref().map(|live| live.freeze());
        let per_cell = scene.trust.audit_per_cell;
        let cells = self.trust.shape();
        let samples_per_pixel = self.options.warmup_samples.filter(|_| place.warmup).unwrap_or(scene.render.samples);
        // Warm-up frames draw other random numbers than all others, so that the first frame after them is the same picture whatever
        // the warm-up was.
        let picture = if place.warmup { WARMUP_PICTURES + self.frame } else { self.pictures };
        let rendered = AtomicBool::new(false);
        let flow_map = self.wants_flow_map();
        let (mut learned, mut work) = (None, None);
        {
            let (ring, live, threads) = (&mut self.ring, &mut self.live, &self.threads);
            let (renderer, trust, frame, seed, stop) = (&mut self.renderer, &self.trust, self.frame, scene.seed, self.stop);
            let frames = &mut self.frames;
            std::thread::scope(|scope| {
                let training = live.as_mut().filter(|l| l.learns() && !ring.is_empty()).map(|live| {
                    let (ring, rendered, settings) = (&*ring, &rendered, &scene.training);
                    match &threads.train {
                        Some([beside, all]) => Trainer::Beside(scope.spawn(move || {
                            let learned = beside.install(|| train(&mut **live, ring.samples(), settings, Until::Rendered(rendered), stop));
                            let left = settings.seconds_per_frame - learned.seconds;
                            if settings.steps_per_frame.is_some() || left <= 0.0 {
                                return learned;
                            }
                            // The picture is done: its threads are free.
                            learned.and(all.install(|| train(&mut **live, ring.samples(), settings, Until::Seconds(left), stop)))
                        })),
                        None => Trainer::After(live, ring),
                    }
                });
                let mut render = || -> Result<Rendered, EngineError> {
                    let mut answers = Answers::new(
                        tracer,
                        front.as_deref(),
                        &gate,
                        scene.trust.trace_budget,
                        if front.is_some() { scene.training.ring / KEEP_A_FRAME } else { 0 },
                    )
                    .with_flow_map(flow_map);
                    let progress = std::sync::Mutex::new(&mut *sink);
                    let report = |share: f32| {
                        if let Ok(mut sink) = progress.lock() {
                            (*sink)(Event::Progress(share));
                        }
                    };
                    let walk = Instant::now();
                    let (film, stats) = frames.render(
                        renderer,
                        picture,
                        samples_per_pixel,
                        tracer,
                        &mut answers,
                        Some(&report),
                        &AtomicBool::new(false),
                    )?;
                    let render_seconds = walk.elapsed().as_secs_f64();
                    let (tally, samples) = (answers.tally, answers.samples);
                    let auditing = Instant::now();
                    let strata = match front {
                        Some(_) => {
                            let wanted = (scene.trust.audit_share * tally.queries as f64).ceil() as usize;
                            trust.audit_strata(&gate, per_cell.max(wanted.div_ceil(cells.iter().product())))
                        }
                        None => Strata::even(cells, 1),
                    };
                    let unit = audit::stratified_points(&strata, seed, 2 * frame);
                    let audit = audit::trace(tracer, &unit, flow_map);
                    let residuals =
                        front.as_deref().map(|front| audit::residuals(front, &audit.samples, renderer.transfer(), tracer.tau()));
                    Ok(Rendered {
                        film,
                        stats,
                        tally,
                        samples,
                        audit,
                        strata,
                        residuals,
                        render_seconds,
                        audit_seconds: auditing.elapsed().as_secs_f64(),
                    })
                };
                work = Some(threads.render.install(&mut render));
                rendered.store(true, Ordering::Release);
                learned = match training {
                    Some(Trainer::Beside(handle)) => Some(handle.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic))),
                    Some(Trainer::After(live, ring)) => Some(threads.render.install(|| {
                        train(&mut **live, ring.samples(), &scene.training, Until::Seconds(scene.training.seconds_per_frame), stop)
                    })),
                    None => None,
                };
            });
        }
        let work = work.ok_or(EngineError::EndedEarly)??;
        let auditing = Instant::now();
        let transfer = self.renderer.transfer();
        let mut record = FrameRecord {
            frame: self.frame,
            slide: slide.index,
            time: slide.time,
            date: slide.date.clone(),
            tau: tracer.tau(),
            direction: self.plan.map.direction.name().into(),
            method: match method {
                Method::Reference => "reference".into(),
                Method::Surrogate => "surrogate".into(),
                Method::Gated => "gated".into(),
            },
            device: self.options.device.name(),
            surrogate: front.as_ref().map(|s| s.name().to_owned()),
            size: [work.film.width, work.film.height],
            samples_per_pixel,
            queries: work.tally.queries,
            traced: work.tally.traced,
            missing: work.tally.missing,
            over_budget: work.tally.over_budget,
            traced_share: work.tally.traced as f64 / (work.tally.queries - work.tally.missing).max(1) as f64,
            integration_steps: fixed_steps(tracer).map(|steps| steps as u64),
            integration_difference: self.report.integration_difference,
            probed: std::mem::take(&mut self.probed),
            audited: work.audit.samples.len() as u64,
            lived_share: work.audit.lived_share,
            majorant_exceeded: work.stats.majorant_exceeded,
            traced_ahead: work.stats.ahead,
            warnings: std::mem::take(&mut slide.warnings),
            ..FrameRecord::default()
        };
        if let (Some(front), Some(audited)) = (front.as_deref(), &work.residuals) {
            record.trusted_share = gate.share();
            record.trusted = audit::trusted_error(audited, &work.strata, &gate);
            self.peak = work.audit.samples.log_stretch.iter().copied().filter(|s| s.is_finite()).fold(self.peak, f32::max);
            record.surrogate_psnr = audit::psnr(audited, self.peak, &work.strata);
            record.over_tolerance = if work.tally.over_budget > 0 {
                // The surrogate answered where it is not trusted: the points there speak for that, and the frame is flagged whatever they say.
                let untrusted: Vec<_> = audited.iter().copied().filter(|r| !gate.trusts(r.point)).collect();
                Some(
                    crate::trust::TrustedError::of(&untrusted, &work.strata)
                        .map_or(0.0, |e| (e.optical_rms - scene.trust.tolerance).max(0.0)),
                )
            } else {
                record.trusted.map(|e| e.optical_rms - scene.trust.tolerance).filter(|over| *over > 0.0)
            };
            if work.tally.over_budget > 0 {
                record.warnings.push(format!(
                    "the tracing budget was spent: {} queries of untrusted cells were answered by the surrogate",
                    work.tally.over_budget
                ));
            }
            if self.options.verify_points > 0 {
                let per_cell = self.options.verify_points.div_ceil(cells.iter().product());
                let strata = Strata::even(cells, per_cell as u32);
                let unit = audit::stratified_points(&strata, scene.seed, 2 * self.frame + 1);
                let interruptible = Interruptible::new(tracer, self.stop);
                let verified = self.threads.render.install(|| {
                    let fresh = audit::trace(&interruptible, &unit, false);
                    audit::trusted_error(&audit::residuals(front, &fresh.samples, transfer, tracer.tau()), &strata, &gate)
                });
                // Cut short by a stop it would stand on the points that come first.
                record.verified = verified.filter(|_| !self.stop.load(Ordering::Relaxed));
            }
            let some = every(&work.samples, work.samples.len().div_ceil(RENDER_RESIDUALS).max(1));
            let rendered = self.threads.render.install(|| audit::residuals(front, &some, transfer, tracer.tau()));
            self.trust.decay();
            self.trust.observe(audited, &work.strata, &rendered);
            if let Some(sizing) = &mut self.sizing {
                // Over the whole domain: where nothing is trusted, the size is what is to be blamed.
                let everywhere = audit::trusted_error(audited, &work.strata, &Gate::uniform(true));
                self.resize = everywhere.and_then(|error| sizing.observe(error.optical_rms, scene.trust.tolerance));
            }
            self.ring.push(&work.samples);
            self.ring.push(&work.audit.samples);
        }
        self.options.device.check()?;
        if let Some(failure) = self.options.device.failure().filter(|_| !std::mem::replace(&mut self.told_of_failure, true)) {
            record.warnings.push(format!("work on the GPU has ended, the CPU goes on: {failure}"));
        }
        let train_seconds = learned.as_ref().map_or(0.0, |l: &Learned| l.seconds);
        if let Some(learned) = &learned {
            self.report.train_steps += learned.steps;
            if learned.rollbacks > 0 {
                record
                    .warnings
                    .push(format!("training diverged {} time(s): rolled back to the last good weights at a lower rate", learned.rollbacks));
            }
        }
        record.training = learned;
        record.ring = self.ring.len() as u64;
        record.seconds = StageSeconds {
            slide: place.preparing,
            waiting: std::mem::take(&mut slide.waited),
            render: work.render_seconds - work.tally.trace_seconds - work.tally.predict_seconds,
            trace: work.tally.trace_seconds,
            predict: work.tally.predict_seconds,
            audit: work.audit_seconds + auditing.elapsed().as_secs_f64(),
            train: train_seconds,
            total: start.elapsed().as_secs_f64(),
            elapsed: self.began.elapsed().as_secs_f64(),
        };
        if let VelocitySource::Window(window) = &slide.velocity {
            self.report.window_bytes = self.report.window_bytes.max(window.bytes());
        }
        self.report.frames += 1;
        self.report.waited += record.seconds.waiting;
        self.report.slides = slide.index + 1;
        self.frame += 1;
        self.pictures += u64::from(!place.warmup);
        Ok(Frame { record: Arc::new(record), film: Arc::new(work.film), tone_map: scene.render.tone_map })
    }

    fn finish(&mut self) -> Result<(), EngineError> {
        if let (Some(path), Some(live)) = (&self.options.checkpoint, &self.live) {
            live.save(path)?;
        }
        self.report.surrogate_bytes = self.live.as_ref().map_or(0, |l| l.bytes());
        Ok(())
    }
}

/// What the rendering threads hand back.
struct Rendered {
    film: crate::render::Film,
    stats: crate::render::RenderStats,
    tally: super::answers::Tally,
    samples: Samples,
    audit: audit::Audit,
    strata: Strata,
    residuals: Option<Vec<crate::trust::Residual>>,
    render_seconds: f64,
    audit_seconds: f64,
}

enum Trainer<'scope, 'b> {
    Beside(std::thread::ScopedJoinHandle<'scope, Learned>),
    After(&'b mut Box<dyn Surrogate>, &'b SampleRing),
}

/// The surrogate at its size.
fn build(
    plan: &Plan,
    settings: &SurrogateSettings,
    sizing: Option<&Sizing>,
    tracer: &dyn Tracer,
) -> Result<Box<dyn Surrogate>, SurrogateError> {
    let scene = &plan.scene;
    let plain = || (settings.clone(), scene.network.clone());
    let (settings, network) = sizing.map_or_else(plain, |sizing| sizing.settings(settings, &scene.network));
    crate::surrogate::build(&settings, &network, &plan.domain, scene.seed, tracer)
}

/// Steps a path, unless each path chooses its own.
fn fixed_steps(tracer: &dyn Tracer) -> Option<usize> {
    Some(tracer.steps()).filter(|steps| *steps > 0)
}

fn every(samples: &Samples, stride: usize) -> Samples {
    Samples {
        points: samples.points.iter().copied().step_by(stride).collect(),
        log_stretch: samples.log_stretch.iter().copied().step_by(stride).collect(),
        ..Samples::default()
    }
}

/// The picture's scene. What the scene file leaves open of the transfer function is scaled to the FTLE of the first slide and kept
/// for the whole run, so that colours compare.
fn settled_scene(plan: &Plan, tracer: &dyn Tracer, time: f64) -> Result<Scene, EngineError> {
    let file = &plan.scene;
    let mut scene = assemble(file, &plan.domain);
    if scene.transfer.low.is_none() || scene.transfer.high.is_none() {
        const PROBES: usize = 64;
        let z = if plan.domain.dimensions == 3 { 16 } else { 1 };
        let unit = audit::stratified_points(&Strata::even([PROBES, PROBES, z], 1), file.seed, u64::MAX);
        let labels = audit::trace(tracer, &unit, false).samples.log_stretch;
        let ftle: Vec<f32> = labels.iter().map(|s| s / tracer.tau() as f32).filter(|f| f.is_finite()).collect();
        if ftle.is_empty() {
            return Err(EngineError::AllMissing { points: unit.len(), time });
        }
        scene.transfer = scene.transfer.scaled_to(&ftle);
    }
    Ok(scene)
}
