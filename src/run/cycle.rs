//! The cycle: slide the window, render with the weights of the previous cycle, test, then train.
//!
//! One group of threads renders frame n with frozen weights, while another trains the live weights on the samples of earlier frames. A GPU that
//! trains alternates between picture and training, which takes `training.share` of the device's time while the loss falls. Samples traced for
//! frame n are compared with the frozen weights, which were not trained on them, before they go to the replay buffer.

use super::checkpoints::set_aside;
use super::commands::Commands;
use super::decision::Decision;
use super::prepare::FLOW_MAP;
use super::race::{Pace, Races};
use super::refine::Frames;
use super::report::{Event, RunOptions, RunReport, ShownSlide, Sink};
use super::scene::settled_scene;
use super::setup::{Plan, Setup};
use super::slides::{LOOK_UP, Slide, Slides};
use super::state::{FramePlace, Run, RunGiven, Soon};
use super::steps::{Comparison, PictureSteps, fixed_steps};
use super::stop::{RunEnd, check_stop};
use super::storage::begin_with_half;
use super::training::Threads;
use super::transaction::{On, Recovering, Session, transaction, with};
use super::until::Refining;
use super::{ColorBar, RunError, TransferRecord, snapshots};
#[cfg(feature = "cuda")]
use crate::backend::cuda::Cuda;
use crate::backend::{Backend, BackendError, Cpu, Device, Surrogate, WhenLost};
use crate::flow::{FlowMap, StepChoice, Steps, VelocitySource, time_resolution};
use crate::progress::{self, Work};
use crate::render::{MAX_FRAMES_UNTIL, Method, Target};
use crate::source::SourceKind;
use crate::surrogate::Trace;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::time::{Duration, Instant};

/// Change of the FTLE without every second snapshot, as a share of its root mean square, above which a warning calls the scene coarse in time.
const COARSE_IN_TIME: f64 = 0.25;
/// The same share below which a message calls it fine in time: less than the steps of a grid may change the log-stretch.
const FINE_IN_TIME: f64 = 0.01;
/// Frames that refine a window that stands still, after each command.
const FRAMES_WHILE_PAUSED: usize = 32;
/// Interval at which a run that waits for a command looks for the end, and for the simulation.
const GLANCE: Duration = Duration::from_millis(2);

/// A run and the session that computes.
pub(super) struct Cycle<'a, B: Backend> {
    pub(super) run: Run<'a>,
    pub(super) session: Session<B>,
    /// Flow map with its number of steps: that of the first slide, so that frames are comparable, unless the picture decides on it.
    pub(super) map: FlowMap,
    /// Frames of the slide before, without warm-up; 0 in the first slide.
    pub(super) frames_before: usize,
    /// Choice of the steps for the log-stretch, and the steps of the picture, if the picture decides on them.
    pub(super) settled: Option<(StepChoice, PictureSteps)>,
    /// Points on which they were compared last, until the storage of the window is judged by them.
    pub(super) compared: Option<Comparison>,
}

/// Frames of a slide from which on the first one is drawn soon, with few samples.
const SOON_FROM: usize = 8;
/// Stated PSNR of a first frame of few samples below which the second one draws the rest of them and traces no nodes, which takes longer.
const NOISY: f64 = 32.0;

/// Runs the whole scene. `sink` receives every event. Setting `stop` ends the run after the current frame, which setting `options.abandon` ends
/// early. Between frames (while the window fills, tables are traced, or cells are probed) the run ends within about a second.
///
/// # Errors
/// A setting, the source, the device or the last checkpoint fails.
pub fn run(setup: Setup, options: &RunOptions, sink: &mut Sink<'_>, stop: &AtomicBool) -> Result<RunReport, RunError> {
    match &options.device {
        Device::Cpu { .. } => run_on(Cpu, setup, options, sink, stop),
        #[cfg(feature = "cuda")]
        Device::Cuda(device) => run_on(Cuda::new(device), setup, options, sink, stop),
    }
}

/// Runs the whole scene as [`run`] does, on a given backend. The device of the options is not used.
///
/// # Errors
/// As for [`run`].
pub fn run_on<B: Backend>(
    backend: B,
    setup: Setup,
    options: &RunOptions,
    sink: &mut Sink<'_>,
    stop: &AtomicBool,
) -> Result<RunReport, RunError> {
    let mut report = RunReport::default();
    match drive(backend, setup, options, sink, stop, &mut report) {
        Ok(()) => {}
        Err(RunEnd::TimeIsUp) => report.time_is_up = true,
        Err(RunEnd::Stopped) => report.interrupted = true,
        Err(RunEnd::Device(error)) => return Err(RunError::Device(Box::new(error))),
        Err(RunEnd::Failed(error)) => return Err(error),
    }
    Ok(report)
}

fn drive<B: Backend>(
    mut backend: B,
    setup: Setup,
    options: &RunOptions,
    sink: &mut Sink<'_>,
    stop: &AtomicBool,
    report: &mut RunReport,
) -> Result<(), RunEnd> {
    let began = Instant::now();
    let Setup { plan, mut slides, notes, decisions, earlier_race } = setup;
    report.decisions = decisions;
    let time = &plan.scene.time;
    report.slides_expected = slides.expected();
    let planned = report.slides_expected.filter(|_| plan.scene.render.until.is_none());
    let frames = planned.map(|s| s * time.frames_per_slide as u64 + time.warmup_frames as u64);
    sink(Event::Begin { frames, notes });
    let threads = Threads::new(options.threads, &plan.scene)?;
    if let Some(listener) = backend.prefetch() {
        slides.listen(listener);
    }
    let first = slides.next_slide(stop)?;
    check_stop(stop)?;
    let mut slide = first.ok_or(RunError::EndedEarly)?;
    let begun = Instant::now();
    let mut beginning = Beginning { threads: &threads, stop, warnings: Vec::new() };
    begin_with_half(&mut backend, &plan, &slide);
    let mut session = begin(backend, &plan, &slide, &mut beginning)?;
    check_stop(stop)?;
    // A flow map that is made again, after a failure, has its steps given.
    let chosen = with!(&session, on => on.tracer().flow().step_choice());
    let map = match with!(&session, on => fixed_steps(on.tracer().flow())) {
        Some(steps) => FlowMap { steps: Steps::Fixed(steps), ..plan.map.clone() },
        None => plan.map.clone(),
    };
    let settled = loop {
        let settled = with!(&session, on => {
            let tracer = on.tracer();
            threads.render().install(|| settled_scene(&plan, tracer, &slide, stop))
        });
        match settled {
            Err(RunEnd::Device(error)) => session.recover(error, &slide, &map, &mut beginning)?,
            settled => break settled?,
        }
    };
    slide.warnings.append(&mut beginning.warnings);
    let from = RunGiven { plan: &plan, options, threads, stop, began, earlier_race, report };
    let run = with!(&session, on => Run::new(from, settled, on.tracer().flow(), on.backend.is_gpu(), &slide))?;
    sink(Event::Note(run.colours()));
    if let VelocitySource::Window(window) = &slide.velocity
        && window.is_flat()
    {
        let key = if plan.scene.source.kind == SourceKind::Archive { " (archive.level)" } else { "" };
        sink(Event::Note(format!(
            "all levels of the first window have the same velocity, and none crosses them: one of them{key} gives the same FTLE, unless it is negative, \
             for less"
        )));
    }
    let mut cycle = Cycle { run, session, map, frames_before: 0, settled: None, compared: None };
    if let Some(chosen) = chosen {
        cycle.take_steps(chosen, None);
    }
    let differences = cycle.measure_integration(&slide, chosen)?;
    slide.warnings.extend(cycle.run.flow_warnings(with!(&cycle.session, on => on.tracer().flow()), chosen, differences));
    cycle.settle_steps(&slide, chosen)?;
    let ended = cycle.all_slides(&mut *slides, slide, begun, sink);
    cycle.run.end_commands();
    // The checkpoint is written even if the run was stopped.
    match ended {
        Err(RunEnd::Failed(error)) => Err(RunEnd::Failed(error)),
        ended => cycle.finish().map_err(RunEnd::Failed).and(ended),
    }
}

/// State that a recovery needs before [`Run`] exists.
struct Beginning<'a> {
    threads: &'a Threads,
    stop: &'a AtomicBool,
    warnings: Vec<String>,
}

impl Recovering for Beginning<'_> {
    fn warn(&mut self, warning: String) {
        self.warnings.push(warning);
    }
    fn pool(&self) -> &rayon::ThreadPool {
        self.threads.render()
    }
    fn stop(&self) -> &AtomicBool {
        self.stop
    }
}

/// Prepares the first slide on the backend, or on the CPU if the device fails and the options allow the fallback.
fn begin<B: Backend>(mut backend: B, plan: &Plan, slide: &Slide, beginning: &mut Beginning<'_>) -> Result<Session<B>, RunEnd> {
    let (pool, _work) = (beginning.threads.render(), Work::begin(FLOW_MAP));
    let error = match pool.install(|| backend.tracer(&slide.velocity, &plan.map, slide.time)) {
        Ok(tracer) => return Ok(Session::Device(On { backend, tracer: Some(tracer), surrogate: None, picture: B::Picture::default() })),
        Err(BackendError::Device(error)) => error,
        Err(error) => return Err(error.into()),
    };
    let goes_on = if error.is_fault() { backend.when_lost() == WhenLost::Cpu } else { backend.may_fall_back() };
    if !goes_on {
        return Err(RunError::Device(Box::new(error)).into());
    }
    let mut backend = Cpu;
    let tracer = pool.install(|| backend.tracer(&slide.velocity, &plan.map, slide.time))?;
    beginning.warnings.push(format!("traced on the CPU: {error}"));
    Ok(Session::Cpu(On { backend, tracer: Some(tracer), surrogate: None, picture: Default::default() }))
}

impl<B: Backend> Cycle<'_, B> {
    /// Renders all slides. The preparation of the first one began at `begun`.
    fn all_slides(&mut self, slides: &mut dyn Slides, mut slide: Slide, mut begun: Instant, sink: &mut Sink<'_>) -> Result<(), RunEnd> {
        self.prepare_first(&mut slide, sink)?;
        loop {
            self.frames(slides, &mut slide, begun, sink)?;
            // Tracer and slide both hold the window, on the host and on the device.
            with!(&mut self.session, on => {
                on.tracer = None;
                on.picture = Default::default();
            });
            drop(slide);
            let next = slides.next_slide(self.run.stop)?;
            if next.is_none() {
                self.run.progress.warnings.extend(slides.warnings());
            }
            check_stop(self.run.stop)?;
            let Some(next) = next else { return Ok(()) };
            (slide, begun) = (next, Instant::now());
            slide.waited += std::mem::take(&mut self.run.progress.waited);
            self.begin_slide(&slide)?;
            slide.warnings.extend(self.run.beyond_the_range(slide.time));
            transaction!(self, &slide, run, on => run.probe(on, slide.index));
        }
    }

    fn prepare_first(&mut self, slide: &mut Slide, sink: &mut Sink<'_>) -> Result<(), RunEnd> {
        if self.run.keeps_surrogate() {
            transaction!(self, slide, run, on => run.build_surrogate(on));
        }
        let named = &self.run.plan.scene.training.resume;
        if let Some(path) = named.as_ref().or(self.run.options.resume_if_fit.as_ref()) {
            let loaded = with!(&mut self.session, on => match &mut on.surrogate {
                Some(surrogate) if surrogate.learns() => surrogate.load(path).map(|()| true),
                _ => Ok(false),
            });
            let loaded = match loaded {
                Err(refused) if named.is_none() => {
                    slide.warnings.push(format!("training begins anew: {refused}{}", set_aside(path, &refused)));
                    false
                }
                loaded => loaded?,
            };
            if loaded {
                // The checkpoint's table may be of another window.
                transaction!(self, slide, run, on => run.slide_surrogate(on));
            }
        }
        if let VelocitySource::Window(window) = &slide.velocity {
            let resolution = self.run.threads.render().install(|| time_resolution(window, &self.map, slide.time))?;
            if let Some(change) = resolution.ftle_change.filter(|change| *change > COARSE_IN_TIME * resolution.ftle_rms) {
                slide.warnings.push(format!(
                    "coarse in time: without every second snapshot the FTLE changes by {:.0} % of its root mean square",
                    100.0 * change / resolution.ftle_rms
                ));
            }
            // Where the colours were compared, the decision tells what they lose.
            let is_told = Decision::is_entered(&self.run.report.decisions, snapshots::SETTING);
            if let Some(change) = resolution.ftle_change.filter(|change| !is_told && *change < FINE_IN_TIME * resolution.ftle_rms) {
                sink(Event::Note(format!(
                    "fine in time: without every second snapshot the FTLE changes by {:.2} % of its root mean square; half of the snapshots would do (time.every = {})",
                    100.0 * change / resolution.ftle_rms,
                    2 * self.run.plan.scene.time.every
                )));
            }
            self.run.report.time_resolution = Some(resolution);
        }
        slide.warnings.extend(self.run.beyond_the_range(slide.time));
        transaction!(self, slide, run, on => run.pilot(on));
        transaction!(self, slide, run, on => run.probe(on, slide.index));
        Ok(())
    }

    /// Moves the session to the next window: tables are traced again, weights are kept, and trust starts again from nothing. Old labels are tested
    /// (unless the network has the start time as an input).
    fn begin_slide(&mut self, slide: &Slide) -> Result<(), RunEnd> {
        if self.look_at_steps(slide)? {
            self.run.races.iter_mut().for_each(Races::begin_anew);
        }
        self.trace_anew(slide)
    }

    /// Makes the flow map of a slide, and all that was traced by the one before.
    pub(super) fn trace_anew(&mut self, slide: &Slide) -> Result<(), RunEnd> {
        transaction!(self, slide, run, on => run.next_tracer(on, slide, &self.map));
        self.settle_storage(slide, false)?;
        self.run.learning.peak = f32::NEG_INFINITY;
        self.run.progress.lacks_room_for_nodes = false;
        let rebuilds = self.run.learning.resize.is_some();
        transaction!(self, slide, run, on => if rebuilds { run.rebuild_surrogate(on) } else { run.slide_surrogate(on) });
        self.run.resized();
        if with!(&self.session, on => on.surrogate.is_some()) {
            transaction!(self, slide, run, on => run.slide_labels(on));
        }
        let Run { renderer, threads, .. } = &mut self.run;
        threads.render().install(|| renderer.window_slid());
        Ok(())
    }

    /// The frames of one slide, and what commands ask for besides.
    fn frames(&mut self, slides: &mut dyn Slides, slide: &mut Slide, mut begun: Instant, sink: &mut Sink<'_>) -> Result<(), RunEnd> {
        let time = &self.run.plan.scene.time;
        let warmups = if slide.index == 0 { time.warmup_frames } else { 0 };
        let planned = warmups + time.frames_per_slide;
        let (mut number, mut since_command) = (0, None);
        let (mut pace, mut refining) = (Pace::default(), Refining::default());
        // Whether the first frame had few samples, and is noisy.
        let mut is_noisy = false;
        loop {
            // The next window may never come, so this one's next frame tells of a loss.
            slide.warnings.extend(slides.loss());
            let commands = self.run.apply_commands();
            if commands > Commands::None {
                since_command = Some(0);
                self.run.steps_are_of_another_picture = true;
            }
            if commands >= Commands::Colours {
                self.run.report.is_steered = true;
                self.run.races.iter_mut().for_each(Races::begin_anew);
            }
            // The seeds of a map are those of any colours.
            let keeps_picture = commands == Commands::Colours && self.run.render.method == Method::Map;
            if commands >= Commands::Method && !keeps_picture {
                with!(&mut self.session, on => on.picture = Default::default());
                pace.begin_anew();
                refining = Refining::default();
            }
            // Only pictures that accumulate have a target.
            let target = self.run.render.until;
            let most = if target.is_some() { planned.max(warmups + MAX_FRAMES_UNTIL) } else { planned };
            if commands == Commands::Map {
                self.take_map(slides, slide)?;
            } else if commands == Commands::Colours && (self.look_at_steps(slide)? || self.settle_storage(slide, false)?) {
                with!(&mut self.session, on => {
                    on.tracer = None;
                    on.picture = Default::default();
                });
                self.trace_anew(slide)?;
                self.run.learning.trust.reset();
                self.probe_again(slide)?;
            }
            if self.run.keeps_surrogate() && with!(&self.session, on => on.surrogate.is_none()) {
                transaction!(self, slide, run, on => run.build_surrogate(on));
                self.run.learning.trust.reset();
                self.probe_again(slide)?;
            }
            slide.waited += std::mem::take(&mut self.run.progress.waited);
            let preparing = if number == 0 { begun.elapsed().as_secs_f64() } else { 0.0 };
            let mut place = FramePlace { is_warmup: number < warmups, preparing, refining: 0.0, soon: None };
            if self.run.learning.resize.is_some() {
                transaction!(self, slide, run, on => run.rebuild_surrogate(on));
                self.run.resized();
                self.run.learning.trust.reset();
                with!(&mut self.session, on => on.picture = Default::default());
                transaction!(self, slide, run, on => run.probe(on, slide.index));
            }
            if warmups > 0 && number == warmups {
                // The first frame does not show the samples of the warm-up.
                with!(&mut self.session, on => on.picture = Default::default());
            }
            let mut start = Instant::now();
            if !place.is_warmup {
                let shown = since_command.unwrap_or(number - warmups);
                let is_open = target.is_some() || slides.is_awaited().is_some();
                let left = match self.run.is_paused() {
                    true => Some(since_command.map_or(0, |frames| FRAMES_WHILE_PAUSED.saturating_sub(frames))),
                    false => (!is_open).then(|| planned.saturating_sub(number)),
                };
                // How many frames a simulation leaves time for is not known before the slide.
                let expected = match left {
                    Some(left) => shown + left,
                    None if slides.is_awaited().is_none() => usize::MAX,
                    None => self.frames_before,
                };
                let is_soon = since_command.is_none() && expected >= SOON_FROM && self.run.render.budget.is_none();
                if shown == 1 {
                    self.measure_steps(slide)?;
                }
                let is_only_slide = slide.index == 0 && slides.is_over();
                let is_put_off = is_noisy && is_soon && shown == 1;
                if !is_put_off {
                    let put_off = usize::from(is_noisy && is_soon && shown == 2);
                    place.refining = self.refine(slide, Frames { shown, left, before: self.frames_before, is_only_slide, put_off })?;
                }
                place.soon = is_soon.then_some(match shown {
                    0 => Soon::March,
                    1 => Soon::Rest,
                    2 if !(is_noisy && place.refining > 0.0) => Soon::Twice,
                    _ => Soon::Usual,
                });
            }
            transaction!(self, slide, run, on => run.learn_shorter(on, slide));
            let frame = transaction!(self, slide, run, on => run.frame(on, slide, place, start, sink));
            slide.warnings.clear();
            slide.waited = 0.0;
            let is_good = |target: Target| frame.record.picture_error.is_some_and(|error| target.is_met_by(&error));
            let is_done = target.is_some_and(is_good) && number >= warmups;
            pace.add(self.run.render.method, &frame.record);
            if place.soon == Some(Soon::March) && self.run.refines() {
                let render = &self.run.render;
                let has_few = render.method == Method::TwoLevel && frame.record.samples_per_pixel < render.samples;
                is_noisy = has_few && frame.record.picture_error.is_some_and(|error| error.psnr.value < NOISY);
            }
            let missed = target.zip(frame.record.picture_error).filter(|_| number >= warmups && !is_done);
            sink(Event::Frame(frame));
            transaction!(self, slide, run, on => run.checkpoint_if_due(on));
            self.run.check_end()?;
            if number == 0 || commands == Commands::Map {
                let (map, asked, next) = (self.map.clone(), self.run.asked.clone(), slides.next_window());
                let sunk = Instant::now();
                sink(Event::Slide(Box::new(ShownSlide { slide: slide.clone(), map, asked, is_new: number == 0, next })));
                // A map of the slide is no part of its frames, beside which a network may be trained as long.
                let apart = sunk.elapsed();
                (begun, start) = (begun + apart, start + apart);
            }
            match missed {
                Some((target, error)) => refining.tell(self.run.render.method, target, &error, start, most.saturating_sub(number + 1)),
                None => refining = Refining::default(),
            }
            number += 1;
            since_command = since_command.map(|frames: usize| frames + 1);
            if self.run.is_paused() {
                if is_done || since_command.is_none_or(|frames| frames >= FRAMES_WHILE_PAUSED) {
                    refining = Refining::default();
                    while !self.run.is_commanded_within(GLANCE) && !slides.is_lost() {
                        self.run.check_end()?;
                        transaction!(self, slide, run, on => run.checkpoint_if_due(on));
                    }
                }
                continue;
            }
            let is_due = number >= planned && slides.is_awaited() == Some(false);
            // A new view that comes while a simulation's next step is awaited gets as many frames as a slide.
            let is_new = !slides.is_over() && slides.is_awaited() == Some(true) && since_command.is_some_and(|frames| frames < planned);
            if !is_done && !is_due && (number < most || is_new) {
                continue;
            }
            refining = Refining::default();
            if let Some(target) = target.filter(|_| !is_done && number <= most) {
                let why = if is_due { "the next window is complete" } else { "no slide gets more frames" };
                self.run.progress.warnings.push(format!("slide {}: the stated error is not yet below {target}, but {why}", slide.index));
            }
            let seconds = if number > most { start.elapsed() } else { begun.elapsed() }.as_secs_f64();
            // While a simulation's next step is awaited, it costs no time.
            self.race(slides, slide, &pace, sink)?;
            transaction!(self, slide, run, on => run.train_meanwhile(on, slides, seconds));
            if !self.is_another_due(slides, slide.live.is_some())? {
                self.frames_before = number.min(most).saturating_sub(warmups);
                let drawn = self.run.render.method;
                self.run.races.iter_mut().for_each(|races| races.look_at(slide.index, drawn, &pace));
                return Ok(());
            }
        }
    }

    /// Probes at other points than at the begin of the slide, which the network was trained on.
    pub(super) fn probe_again(&mut self, slide: &Slide) -> Result<(), RunEnd> {
        let stream = slide.index + ((self.run.progress.frame + 1) << 32);
        transaction!(self, slide, run, on => run.probe(on, stream));
        Ok(())
    }

    /// Whether the slide gets another frame, since a command comes or the simulation is lost while its next window is incomplete.
    fn is_another_due(&mut self, slides: &dyn Slides, is_live: bool) -> Result<bool, RunEnd> {
        let is_steered = self.run.options.steering.is_some();
        if slides.is_over() || !(is_steered || is_live) {
            return Ok(false);
        }
        let begin = Instant::now();
        let mut is_due = false;
        while !is_due && slides.is_awaited() == Some(true) {
            if !is_steered {
                slides.wait_within(LOOK_UP);
            }
            is_due = slides.is_lost() || self.run.is_commanded_within(GLANCE);
            self.run.check_end()?;
        }
        self.run.progress.waited += begin.elapsed().as_secs_f64();
        Ok(is_due)
    }

    fn finish(&mut self) -> Result<(), RunError> {
        let run = &mut self.run;
        let learned = std::mem::take(&mut run.learning.unreported);
        run.report.train_steps += learned.steps;
        run.report.surrogate_bytes = with!(&self.session, on => on.surrogate.as_ref().map_or(0, |surrogate| surrogate.bytes()));
        let last_frame = run.progress.frame.checked_sub(1);
        let last = match &mut run.checkpoints {
            Some(checkpoints) => {
                let _work = Work::begin("writing the checkpoint");
                let last = with!(&self.session, on => match &on.surrogate {
                    Some(surrogate) => checkpoints.finish(last_frame, surrogate),
                    None => Ok(()),
                });
                run.report.checkpoints = Some(checkpoints.totals().clone());
                last
            }
            None => Ok(()),
        };
        run.report.warnings = [learned.warnings, std::mem::take(&mut run.progress.warnings)].concat();
        Ok(last?)
    }
}

impl Run<'_> {
    /// Ends the run if that was asked for, or its time is up.
    fn check_end(&self) -> Result<(), RunEnd> {
        progress::mark();
        check_stop(self.stop)?;
        let is_over = self.options.seconds.is_some_and(|seconds| self.began.elapsed().as_secs_f64() >= seconds);
        if is_over { Err(RunEnd::TimeIsUp) } else { Ok(()) }
    }

    fn is_paused(&self) -> bool {
        self.options.steering.as_ref().is_some_and(|steering| steering.is_paused())
    }

    /// Whether a command waits, or one comes within `limit`.
    pub(super) fn is_commanded_within(&self, limit: Duration) -> bool {
        self.options.steering.as_ref().is_some_and(|steering| steering.is_pending_within(limit))
    }

    pub(super) fn draw_color_bar(&mut self) {
        let TransferRecord { low, high, .. } = self.transfer;
        self.color_bar = Arc::new(ColorBar::new(&self.renderer, self.render.method, [low, high], &self.plan.time_unit));
    }

    /// Starts a checkpoint if one is due. A disk error fails the checkpoint, not the run.
    fn checkpoint_if_due<B: Backend>(&mut self, on: &mut On<B>) -> Result<(), RunEnd> {
        if let (Some(checkpoints), Some(surrogate)) = (&mut self.checkpoints, &mut on.surrogate) {
            let (pause, warning) = checkpoints.after_frame(self.progress.frame - 1, surrogate)?;
            self.progress.checkpoint_pause += pause;
            self.progress.warnings.extend(warning);
        }
        Ok(())
    }
}
