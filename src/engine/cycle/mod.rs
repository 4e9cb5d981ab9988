//! The cycle: slide, render with the weights of the cycle before, test, then train.
//!
//! While one group of threads renders frame n with frozen weights, another trains the live ones on the samples of the frames before. Where a
//! GPU trains, it takes turns: picture, then training, for `training.share` of the device's time. Samples traced for frame n are held against
//! the frozen weights, which have not seen them, before they go to the ring.

mod assess;
mod frame;
mod prepare;

use super::checkpoints::{CheckpointTotals, Checkpoints};
use super::feed::{Feed, Slide};
use super::frames::{FrameRenderer, frame_renderer};
use super::setup::{Plan, Setup};
use super::stop::{Halt, Interruptible, heed};
use super::training::{Threads, Turns};
use super::{Device, EngineError, Frame, Settings, TransferRecord};
use crate::flow::{FlowMap, StepChoice, Steps, TimeResolution, Tracer, VelocitySource, time_resolution};
use crate::render::{Method, Renderer};
use crate::surrogate::network::{Size, Times};
use crate::surrogate::{Learned, Resize, SampleRing, Sizing, Surrogate, SurrogateSettings};
use crate::trust::TrustMap;
use std::path::PathBuf;
use std::sync::atomic::AtomicBool;
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
    /// Writes it also while the run goes on, when so many seconds have gone by since the last time: what is killed goes on from there.
    pub checkpoint_seconds: Option<f64>,
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
    /// What was settled after that, before the first frame.
    Note(String),
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
    /// Seconds spent on frames and on taking in snapshots that were there.
    pub worked: f64,
    /// Optimizer steps.
    pub train_steps: u64,
    /// Runge-Kutta steps a path; none where each path chooses its own, or before there was a tracer.
    pub integration_steps: Option<usize>,
    /// Difference of the log-stretch from twice as many steps, where the steps were chosen by it (see [`crate::flow::StepChoice`]).
    pub integration_difference: Option<f64>,
    /// The transfer function in force; none before there was one.
    pub transfer: Option<TransferRecord>,
    /// Size of the surrogate, bytes.
    pub surrogate_bytes: usize,
    /// Changes of its size with `size = "auto"`, and why; a few dozen at most, since no size is tried in vain twice.
    pub sizes: Vec<String>,
    /// Whether the snapshots are close enough in time; none for closed forms.
    pub time_resolution: Option<TimeResolution>,
    /// Largest size of the window, bytes.
    pub window_bytes: usize,
    /// What became of the checkpoints; none where none was asked for.
    pub checkpoints: Option<CheckpointTotals>,
    /// What was met behind the last frame, whose record tells of all before.
    pub warnings: Vec<String>,
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
    transfer: TransferRecord,
    trust: TrustMap,
    ring: SampleRing,
    /// The times that are inputs of the network, and where the window of the ring's labels begins.
    times: Times,
    start: f64,
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
    /// Whether it was told that particles do not live.
    told_of_deaths: bool,
    /// What was learned after the last frame had gone out; the next one's record tells of it.
    learned_meanwhile: Option<Learned>,
    /// What training has of the device beside a simulation.
    turns: Turns,
    report: &'a mut RunReport,
    /// Set from outside when the run should end.
    stop: &'a AtomicBool,
    /// Largest log-stretch that audit points of this slide have met.
    peak: f32,
    began: Instant,
    /// Where checkpoints are asked for.
    checkpoints: Option<Checkpoints>,
    /// Seconds that the loop stood still since the last frame for one, and what the next record should say of it.
    stood_still: (f64, Option<String>),
}

/// Where a frame stands in the run.
#[derive(Clone, Copy)]
struct Place {
    warmup: bool,
    /// Seconds that preparing the slide took, for its first frame.
    preparing: f64,
}

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
    let (tracer, told) = threads.render().install(|| options.device.tracer(slide.velocity.clone(), &plan.map, slide.time))?;
    slide.warnings.extend(told);
    heed(stop)?;
    // The number of steps is settled once, on the first slide, so that frames compare.
    let map = match fixed_steps(&*tracer) {
        Some(steps) => FlowMap { steps: Steps::Fixed(steps), ..plan.map.clone() },
        None => plan.map.clone(),
    };
    let mut cycle = Cycle::new(&plan, options, threads, &Interruptible::new(&*tracer, stop), &slide, began, stop, report)?;
    sink(Event::Note(cycle.colours()));
    let ended = cycle.first_slide(&*tracer, &map, &mut slide, begun, sink).and_then(|()| {
        // They hold the first window, here and on the device.
        drop((tracer, slide));
        cycle.later_slides(&mut feed, &map, begun, sink)
    });
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
        let settled = threads.render().install(|| prepare::settled_scene(plan, tracer, first));
        heed(stop)?;
        let settled = settled?;
        let range = (settled.transfer.low.unwrap_or_default(), settled.transfer.high.unwrap_or_default());
        let renderer = Renderer::new(settled, &plan.domain, plan.map.tau)?;
        let transfer = TransferRecord { low: range.0, high: range.1, extinction: f64::from(renderer.transfer().extinction_max()) };
        report.transfer = Some(transfer);
        let surrogate = match &first.velocity {
            VelocitySource::Window(window) => {
                let most = if first.live.is_some() { most_live_nodes(scene, &options.device) } else { usize::MAX };
                window.grid().map(|grid| scene.surrogate.at_resolution_of(grid.shape(), most))
            }
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
            Some(threads.render().install(|| prepare::build(plan, &surrogate, sizing.as_ref(), tracer, &options.device))?)
        };
        heed(stop)?;
        if let (Some(path), Some(surrogate)) = (&scene.training.resume, &mut live)
            && surrogate.learns()
        {
            surrogate.load(path)?;
            // Its table is that of another window, for all that is known.
            threads.render().install(|| surrogate.window_slid(tracer));
            heed(stop)?;
        }
        let times = Times::new(&scene.network, tracer.tau());
        let mut ring = SampleRing::new(scene.training.ring);
        if !scene.network.inputs.is_empty() {
            ring.set_now(times.unit(tracer.start(), tracer.tau()));
        }
        report.integration_steps = fixed_steps(tracer);
        report.integration_difference = tracer.step_choice().map(|c| c.difference).filter(|difference| difference.is_finite());
        Ok(Self {
            plan,
            options,
            threads,
            frames: frame_renderer(&options.device),
            renderer,
            transfer,
            trust: TrustMap::new(&scene.trust, &plan.domain),
            ring,
            times,
            start: tracer.start(),
            surrogate,
            sizing,
            resize: None,
            live,
            frame: 0,
            probed: 0,
            pictures: 0,
            told_of_failure: false,
            told_of_deaths: false,
            learned_meanwhile: None,
            turns: Turns::new(scene.training.share),
            report,
            stop,
            peak: f32::NEG_INFINITY,
            began,
            checkpoints: options.checkpoint.clone().map(|path| Checkpoints::new(path, options.checkpoint_seconds)),
            stood_still: (0.0, None),
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
        slide.warnings.extend(self.uniform(tracer));
        if let Some(chosen) = tracer.step_choice().filter(|chosen| chosen.not_finite > 0) {
            slide.warnings.push(format!(
                "{} of {} paths that steps were chosen on have no finite log-stretch: the integration overflowed there",
                chosen.not_finite,
                StepChoice::POINTS
            ));
        }
        if let Some(chosen) = tracer.step_choice().filter(|chosen| !chosen.within_tolerance) {
            slide.warnings.push(format!(
                "{} steps a path, the most that are tried, still differ from twice as many by {:.3} (log-stretch, root mean square of the better 98 %)",
                chosen.steps, chosen.difference
            ));
        }
        if let VelocitySource::Window(window) = &slide.velocity {
            let resolution = self.threads.render().install(|| time_resolution(window, map, slide.time))?;
            if let Some(change) = resolution.ftle_change.filter(|change| *change > COARSE_IN_TIME * resolution.ftle_rms) {
                slide.warnings.push(format!(
                    "coarse in time: without every second snapshot the FTLE changes by {:.0} % of its root mean square",
                    100.0 * change / resolution.ftle_rms
                ));
            }
            self.report.time_resolution = Some(resolution);
        }
        let offered = self.options.device.offload().is_some();
        if offered && self.live.as_ref().is_some_and(|live| live.learns() && !live.is_offloaded()) {
            let what = "the network is trained on the CPU: a GPU takes no network.jacobian_weight above 0, layers that its shared memory holds, and what its memory has room for";
            slide.warnings.push(what.into());
        }
        slide.warnings.extend(self.beyond_the_range(slide.time));
        self.pilot(tracer)?;
        self.probe(tracer, slide.index)?;
        self.frames(tracer, slide, begun, sink)
    }

    /// Goes on until the source ends. The first slide, whose frames are made, was begun at `begun`.
    fn later_slides(
        &mut self,
        feed: &mut Feed,
        map: &FlowMap,
        mut begun: Instant,
        sink: &mut (dyn FnMut(Event) + Send),
    ) -> Result<(), Halt> {
        loop {
            self.train_meanwhile(feed, begun.elapsed().as_secs_f64());
            let next = feed.next_slide_unless(self.stop)?;
            heed(self.stop)?;
            let Some(mut slide) = next else { return Ok(()) };
            begun = Instant::now();
            let instead = "the CPU traced a slide";
            let (tracer, told) = self.options.device.next_tracer(slide.velocity.clone(), map, slide.time, instead)?;
            slide.warnings.extend(told);
            self.slid(&*tracer)?;
            slide.warnings.extend(self.beyond_the_range(slide.time));
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
            self.checkpoint_if_due();
            heed(self.stop)?;
            if self.options.seconds.is_some_and(|seconds| self.began.elapsed().as_secs_f64() >= seconds) {
                return Err(Halt::TimeIsUp);
            }
        }
        Ok(())
    }

    /// A disk that refuses costs the checkpoint, not the run.
    fn checkpoint_if_due(&mut self) {
        if let (Some(checkpoints), Some(live)) = (&mut self.checkpoints, &mut self.live) {
            self.stood_still = checkpoints.after_frame(self.frame - 1, &mut **live);
        }
    }

    fn finish(&mut self) -> Result<(), EngineError> {
        let learned = self.learned_meanwhile.take().unwrap_or_default();
        self.report.train_steps += learned.steps;
        self.report.surrogate_bytes = self.live.as_ref().map_or(0, |l| l.bytes());
        let last = match (&mut self.checkpoints, &self.live) {
            (Some(checkpoints), Some(live)) => {
                let last = checkpoints.finish(self.frame.checked_sub(1), &**live);
                self.report.checkpoints = Some(checkpoints.totals().clone());
                last
            }
            _ => Ok(()),
        };
        self.report.warnings = [learned.warnings, self.options.device.shortages()].concat();
        Ok(last?)
    }
}

/// Most nodes of a table that follows a simulation: every slide traces it anew while the simulation goes on. Where the CPU traces, one for each
/// camera path of the slide's frames: with more, answering from the table would cost more than tracing.
fn most_live_nodes(scene: &Settings, device: &Device) -> usize {
    match device {
        Device::Cpu { .. } => [scene.render.width, scene.render.height, scene.render.samples, scene.time.frames_per_slide]
            .into_iter()
            .fold(1, usize::saturating_mul),
        #[cfg(feature = "cuda")]
        Device::Gpu { .. } => usize::MAX,
    }
}

/// Steps a path, unless each path chooses its own.
fn fixed_steps(tracer: &dyn Tracer) -> Option<usize> {
    Some(tracer.steps()).filter(|steps| *steps > 0)
}
