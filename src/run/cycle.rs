//! The cycle: slide the window, render with the weights of the previous cycle, test, then train.
//!
//! One group of threads renders frame n with frozen weights, while another trains the live weights on the samples of earlier frames. A GPU that
//! trains alternates between picture and training, which takes `training.share` of the device's time while the loss falls. Samples traced for
//! frame n are compared with the frozen weights, which were not trained on them, before they go to the replay buffer.

use super::budget::FrameCost;
use super::checkpoints::{CheckpointTotals, Checkpoints};
use super::commands::Commands;
use super::decision::{Decision, enter_colours, suited_network, why_steps};
use super::frame::LastAudit;
use super::integration::integration_warnings;
use super::need::Need;
use super::prepare::FLOW_MAP;
use super::race::{Pace, Race, Races};
use super::record::Frame;
use super::refine::Frames;
use super::scene::settled_scene;
use super::setup::{Plan, Setup};
use super::slides::{LOOK_UP, Slide, Slides};
use super::steering::{Command, Steering, drawn_by};
use super::steps::{Comparison, PictureSteps, Shown, is_outdated, picture_steps, suit_the_picture};
use super::stop::{RunEnd, check_stop};
use super::storage::begin_with_half;
use super::training::{Threads, TrainingBudget};
use super::transaction::{On, Recovering, Session, transaction, with};
use super::until::Refining;
use super::{ColorBar, RunError, Settings, TransferRecord, snapshots};
#[cfg(feature = "cuda")]
use crate::backend::cuda::Cuda;
use crate::backend::{Backend, BackendError, Cpu, Device, Surrogate, WhenLost};
use crate::flow::{
    FlowError, FlowMap, IntegrationDifferences, StepChoice, Steps, TimeResolution, Tracer, VelocitySource, cpu_tracer, time_resolution,
};
use crate::progress::{self, Work};
use crate::render::smooth::AUDIT_PAIRS;
use crate::render::{MAX_FRAMES_UNTIL, Method, RenderSettings, Renderer, Scene, Target};
use crate::source::SourceKind;
use crate::source::live::NextWindow;
use crate::surrogate::network::{NetworkSettings, Size, Times};
use crate::surrogate::{
    CheckpointError, Kind, Learned, MAX_DEVICE_NODES, MAX_OWN_NODES, ReplayBuffer, Resize, Sizing, SurrogateSettings, Trace,
};
use crate::trust::TrustMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::time::{Duration, Instant};

/// Options of a run besides its scene.
#[derive(Debug, Clone, Default)]
pub struct RunOptions {
    /// Number of new uniform points on which each frame's stated error is checked afterwards; 0 disables the check.
    pub verify_points: usize,
    /// Wall-clock seconds after which no further frame starts.
    pub seconds: Option<f64>,
    /// Number of worker threads; 0: as many as the process may use.
    pub threads: usize,
    /// File for the trained surrogate, written at the end.
    pub checkpoint: Option<PathBuf>,
    /// Seconds between checkpoints during the run. A killed run can resume from the latest one.
    pub checkpoint_seconds: Option<f64>,
    /// File with weights to go on from if they fit; otherwise the run begins anew, with a warning. `training.resume` goes before it, and ends the
    /// run if it does not fit.
    pub resume_if_fit: Option<PathBuf>,
    /// The device that computes.
    pub device: Device,
    /// Commands to the run; `None`: nobody steers it.
    pub steering: Option<Arc<Steering>>,
    /// Setting it abandons the frame in progress. It has an effect once a stop is requested; the run then ends as if the frame had not begun.
    pub abandon: Arc<AtomicBool>,
}

/// Events of a run in progress.
pub enum Event {
    /// Before the first frame.
    Begin {
        /// Number of frames; `None` if unknown.
        frames: Option<u64>,
        /// Remarks on the settings and the source.
        notes: Vec<String>,
    },
    /// A remark after [`Event::Begin`].
    Note(String),
    /// A finished frame.
    Frame(Frame),
    /// Share of the current frame that is rendered.
    Progress(f32),
    /// After the first frame of a slide, and of another flow map: what was traced for it.
    Slide(Box<ShownSlide>),
}

/// A slide of which a frame is made.
pub struct ShownSlide {
    /// The slide.
    pub slide: Slide,
    /// The flow map of its frame, with the steps that were chosen.
    pub map: FlowMap,
    /// The flow map as the scene and commands ask for it, with the rule for its steps.
    pub asked: FlowMap,
    /// True after the slide's first frame.
    pub is_new: bool,
    /// The next window of a running simulation; `None` for other sources.
    pub next: Option<NextWindow>,
}

/// Summary of a run.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct RunReport {
    /// Number of frames.
    pub frames: u64,
    /// Number of slides.
    pub slides: u64,
    /// Slides that the source has, or the scene allows; `None` if that is not known.
    pub slides_expected: Option<u64>,
    /// True if the caller stopped the run.
    pub interrupted: bool,
    /// True if a command has changed tau, direction, colours or tolerance: races are no longer those of the scene.
    pub is_steered: bool,
    /// True if the run ended since its time was up ([`RunOptions::seconds`]).
    pub time_is_up: bool,
    /// Seconds spent waiting for input.
    pub waited: f64,
    /// Seconds spent on frames and on adding available snapshots to the window.
    pub worked: f64,
    /// Optimizer steps.
    pub train_steps: u64,
    /// Runge-Kutta steps per path in the last slide; `None` if each path chooses its own steps, or if there was no tracer yet.
    pub integration_steps: Option<usize>,
    /// Difference of the log-stretch from that of at least twice as many steps; `None` if it is not finite, or if each path chooses its own
    /// steps (see [`crate::flow::StepChoice`]).
    pub integration_difference: Option<f64>,
    /// Difference of the log-stretch in single from that in double precision; `None` in double precision (see [`IntegrationDifferences`]).
    pub precision_difference: Option<f64>,
    /// Difference of the log-stretch by central differences from that by the tangent; `None` for other integrators.
    pub tangent_difference: Option<f64>,
    /// Optical residual of the steps; `None` unless they were chosen by it.
    pub integration_residual: Option<f64>,
    /// Transfer function; `None` if the run ended before it was chosen.
    pub transfer: Option<TransferRecord>,
    /// Size of the surrogate, bytes.
    pub surrogate_bytes: usize,
    /// What was chosen for settings that the scene leaves open: one entry a setting, the last choice for it.
    pub decisions: Vec<Decision>,
    /// The last race of methods; `None` if there was none.
    pub race: Option<Race>,
    /// Changes of its size with `size = "auto"`, with reasons; a few dozen at most, since no rejected size is tried twice.
    pub sizes: Vec<String>,
    /// Resolution of the snapshots in time; `None` for closed forms.
    pub time_resolution: Option<TimeResolution>,
    /// Largest size of the window, bytes.
    pub window_bytes: usize,
    /// Totals of the checkpoints; `None` if the run writes none.
    pub checkpoints: Option<CheckpointTotals>,
    /// Warnings since the last frame; earlier ones are in the records.
    pub warnings: Vec<String>,
}

/// Reason for the nodes of a table of a flat flow.
const TWO_A_PIXEL: &str = "two a pixel along the longest edge, since the FTLE of a flow of two dimensions folds finer than data";
/// Change of the FTLE without every second snapshot, as a share of its root mean square, above which a warning calls the scene coarse in time.
const COARSE_IN_TIME: f64 = 0.25;
/// The same share below which a message calls it fine in time: less than the steps of a grid may change the log-stretch.
const FINE_IN_TIME: f64 = 0.01;
/// Frames that refine a window that stands still, after each command.
const FRAMES_WHILE_PAUSED: usize = 32;
/// Interval at which a run that waits for a command looks for the end, and for the simulation.
const GLANCE: Duration = Duration::from_millis(2);
/// Maximum number of residuals of rendered samples that go to the trust map each frame. More would not improve the estimates of their cells.
pub(super) const MAX_RENDER_RESIDUALS: usize = 1 << 16;

/// The receiver of a run's events.
pub(super) type Sink<'a> = dyn FnMut(Event) + Send + 'a;

/// State of a run on the host, independent of the backend.
pub(super) struct Run<'a> {
    pub(super) plan: &'a Plan,
    pub(super) options: &'a RunOptions,
    pub(super) threads: Threads,
    pub(super) stop: &'a AtomicBool,
    pub(super) began: Instant,
    pub(super) report: &'a mut RunReport,
    pub(super) renderer: Renderer,
    /// The flow map as the scene and commands ask for it; [`Cycle::map`] is what came of it.
    pub(super) asked: FlowMap,
    /// `[render]` with the method and the budget that commands set.
    pub(super) render: RenderSettings,
    /// The newest budget, also while the method has none.
    pub(super) budget: Option<f64>,
    pub(super) transfer: TransferRecord,
    /// A command set the range of the colours.
    pub(super) has_range: bool,
    pub(super) color_bar: Arc<ColorBar>,
    pub(super) learning: Learning,
    pub(super) progress: RunProgress,
    /// `None` if the run writes no checkpoints.
    pub(super) checkpoints: Option<Checkpoints>,
    /// `None` if the method is given.
    pub(super) races: Option<Races>,
}

/// State of learning, apart from the surrogate itself.
pub(super) struct Learning {
    pub(super) trust: TrustMap,
    pub(super) buffer: ReplayBuffer,
    /// Times that are inputs of the network, and the start time of the buffer's labels.
    pub(super) times: Times,
    pub(super) start: f64,
    /// Settings of the surrogate, with the nodes of the data if a table has no others.
    pub(super) settings: SurrogateSettings,
    /// Settings of the network, with sizes that suit the window where the scene leaves them open.
    pub(super) network: NetworkSettings,
    /// Reason for the nodes of a table of a new window.
    pub(super) why_nodes: String,
    /// Search for the size, with `size = "auto"`.
    pub(super) sizing: Option<Sizing>,
    /// Size for the next frame; `None` to keep the present one.
    pub(super) resize: Option<Resize>,
    /// Device time due to training beside a live simulation.
    pub(super) budget: TrainingBudget,
    /// How much training is needed.
    pub(super) need: Need,
    /// Training after the last frame went out, or in a frame that failed. It goes into the next record.
    pub(super) unreported: Learned,
    /// Largest log-stretch on the audit points of this slide.
    pub(super) peak: f32,
}

impl Learning {
    /// Adds training to the next record.
    pub(super) fn report(&mut self, learned: Learned) {
        self.unreported = std::mem::take(&mut self.unreported).and(learned);
    }

    /// Training since the last frame; `None` if nothing was trained.
    pub(super) fn unreported_since_last_frame(&mut self) -> Option<Learned> {
        Some(std::mem::take(&mut self.unreported)).filter(|learned| *learned != Learned::default())
    }
}

/// Progress of a run, and the contents of its next record.
#[derive(Default)]
pub(super) struct RunProgress {
    pub(super) frame: u64,
    /// Number of frames without the warm-up frames.
    pub(super) pictures: u64,
    /// Points traced since the last frame to prepare the next one.
    pub(super) preparation_traces: u64,
    /// True once the warning about short particle lifetimes was given.
    pub(super) has_warned_of_deaths: bool,
    /// True once the warning about few audit points was given.
    pub(super) has_warned_of_few_points: bool,
    pub(super) warnings: Vec<String>,
    /// Optimizer steps of the surrogate that the accumulating picture shows.
    pub(super) steps_shown: u64,
    /// Seconds that smooth frames take; `None` before the first one.
    pub(super) cost: Option<FrameCost>,
    /// Seconds that the loop paused since the last frame for a checkpoint.
    pub(super) checkpoint_pause: f64,
    /// Commands that took effect since the last frame.
    pub(super) commands: Vec<Command>,
    /// Seconds that the run waited for a step and looked for commands, since the last frame.
    pub(super) waited: f64,
    /// True if the device had no room for a finer table in this slide.
    pub(super) lacks_room_for_nodes: bool,
    /// Seconds of building the surrogate, or of moving it to the window, when that was last done.
    pub(super) surrogate_seconds: f64,
    /// Seconds of races since the last frame.
    pub(super) raced: f64,
    /// The latest audit of the present window and surrogate.
    pub(super) last_audit: Option<LastAudit>,
}

impl RunProgress {
    /// Forgets that commands asked for another tau or direction, since it could not be had.
    pub(super) fn take_back_map(&mut self) {
        for command in &mut self.commands {
            (command.set.tau, command.set.direction) = (None, None);
        }
        self.commands.retain(|command| !command.set.is_empty());
    }

    /// Samples a pixel of the next frame: those of the settings, or as many as the budget of a smooth frame allows, of which a part may have gone to a
    /// finer table. The first frame of many is the march, with the samples that measure its error, and the next two make up for it.
    pub(super) fn affordable_samples(&self, settings: &RenderSettings, place: &FramePlace) -> f64 {
        /// Samples a pixel of the first frame with a budget, whose cost is not known.
        const FIRST: f64 = 0.25;
        /// Those that measure the error of a march.
        const SOON: f64 = 2.0 * AUDIT_PAIRS;
        let Some(milliseconds) = settings.budget else {
            return match place.after.filter(|_| settings.method == Method::TwoLevel && settings.samples > SOON) {
                Some(0) => SOON,
                Some(1) => settings.samples - SOON,
                // A target is met by as many as it needs.
                Some(2) if settings.until.is_none() => 2.0 * settings.samples,
                _ => settings.samples,
            };
        };
        let affordable = self.cost.map_or(FIRST, |cost| cost.samples(1e-3 * milliseconds, place.refining));
        // An even sixteenth at least, so that every tile gets samples.
        affordable.clamp(1.0 / 16.0, 4096.0)
    }
}

impl Recovering for Run<'_> {
    fn warn(&mut self, warning: String) {
        self.progress.warnings.push(warning);
    }
    fn pool(&self) -> &rayon::ThreadPool {
        self.threads.render()
    }
    fn stop(&self) -> &AtomicBool {
        self.stop
    }
}

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

/// Place of a frame in its slide.
#[derive(Clone, Copy)]
pub(super) struct FramePlace {
    pub(super) is_warmup: bool,
    /// Seconds of preparing the slide, for its first frame; 0 for the others.
    pub(super) preparing: f64,
    /// Seconds of tracing nodes of a finer table before the frame.
    pub(super) refining: f64,
    /// Frames that its slide has had, if enough are expected for the first to be drawn soon; `None` with a budget or after a command.
    pub(super) after: Option<usize>,
}

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

/// What a run is given before its first slide.
struct RunGiven<'a> {
    plan: &'a Plan,
    options: &'a RunOptions,
    threads: Threads,
    stop: &'a AtomicBool,
    began: Instant,
    earlier_race: Option<Race>,
    report: &'a mut RunReport,
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

impl<'a> Run<'a> {
    fn new(frame: RunGiven<'a>, settled: Scene, flow: &dyn Tracer, is_gpu: bool, first: &Slide) -> Result<Self, RunEnd> {
        let RunGiven { plan, options, threads, stop, began, earlier_race, report } = frame;
        let scene = &plan.scene;
        let range = (settled.transfer.low.unwrap_or_default(), settled.transfer.high.unwrap_or_default());
        let renderer = Renderer::new(settled, &plan.domain, plan.map.tau)?;
        let transfer = TransferRecord { low: range.0, high: range.1, extinction: f64::from(renderer.transfer().extinction_max()) };
        let color_bar = Arc::new(ColorBar::new(&renderer, scene.render.method, [range.0, range.1], &plan.time_unit));
        let pixels = [scene.render.width, scene.render.height];
        let for_picture = scene.surrogate.for_picture(scene.render.method.is_smooth(), pixels, &plan.domain);
        let mut because = "256 along the longest edge, or 128 below a network".to_owned();
        if for_picture.table_nodes.is_some() {
            because = TWO_A_PIXEL.to_owned();
        }
        let settings = match &first.velocity {
            VelocitySource::Window(window) => {
                let own = if options.device.is_gpu() { MAX_DEVICE_NODES } else { MAX_OWN_NODES };
                let most = if first.live.is_some() { max_live_nodes(scene, &options.device).min(own) } else { own };
                window.grid().map(|grid| {
                    let [x, y, z] = grid.shape();
                    let [fine_x, fine_y, _] = for_picture.table_nodes.unwrap_or_default();
                    let wanted = [x.max(fine_x), y.max(fine_y), z];
                    because = match (fine_x > x, fine_y > y) {
                        (true, true) => TWO_A_PIXEL.to_owned(),
                        (false, false) => "those of the data".to_owned(),
                        _ => format!("those of the data, or {TWO_A_PIXEL}"),
                    };
                    if wanted.iter().product::<usize>() > most {
                        because += &format!(", in proportion down to {most} in all");
                    }
                    scene.surrogate.at_resolution_of(wanted, most)
                })
            }
            VelocitySource::Analytic(..) => None,
        };
        let settings = settings.unwrap_or(for_picture);
        let sized = scene.render.method.has_surrogate() && scene.network.size == Size::Auto;
        let learns = scene.render.method.has_surrogate() && scene.surrogate.kind != Kind::Table;
        let network = match &first.velocity {
            VelocitySource::Window(window) if learns && is_gpu => {
                window.grid().map(|grid| suited_network(&scene.network, grid.shape(), &mut report.decisions))
            }
            _ => None,
        };
        let network = network.unwrap_or_else(|| scene.network.clone());
        let sizing = sized.then(|| Sizing::new(&settings, &network, &plan.domain)).transpose()?;
        let times = Times::new(&scene.network, flow.tau());
        let mut buffer = ReplayBuffer::new(scene.training.replay_buffer);
        if !scene.network.inputs.is_empty() {
            buffer.set_now(times.unit(flow.start(), flow.tau()));
        }
        let has_table = scene.render.method.has_surrogate() && scene.surrogate.kind != Kind::Network;
        if has_table && scene.surrogate.table_nodes.is_none() && scene.network.size != Size::Auto {
            let nodes = settings.nodes(&plan.domain)?;
            let bytes = nodes.iter().product::<usize>() * size_of::<f32>();
            Decision::new("surrogate.table_nodes", format_args!("{nodes:?}"), format_args!("{because}; {:.2} MB", bytes as f64 / 1e6))
                .enter(&mut report.decisions);
        }
        enter_colours(&plan.scene, scene.render.method, transfer, &mut report.decisions);
        report.transfer = Some(transfer);
        report.integration_steps = fixed_steps(flow);
        let learning = Learning {
            trust: TrustMap::new(&scene.trust, &plan.domain),
            buffer,
            times,
            start: flow.start(),
            settings,
            network,
            why_nodes: because,
            sizing,
            resize: None,
            budget: TrainingBudget::new(scene.training.share),
            need: Need::default(),
            unreported: Learned::default(),
            peak: f32::NEG_INFINITY,
        };
        let checkpoints = options.checkpoint.clone().map(|path| Checkpoints::new(path, options.checkpoint_seconds));
        let races = plan.races.then(|| Races::new(earlier_race.as_ref()));
        let mut render = scene.render.clone();
        if let Some(race) = earlier_race.filter(|_| plan.races) {
            Decision::new("render.method", race.method.name(), format_args!("{}, in an earlier run", race.why()))
                .enter(&mut report.decisions);
            render = drawn_by(&render, race.method, render.budget);
            options.steering.iter().for_each(|steering| steering.keep_method(race.method));
        }
        if !render.method.has_surrogate() {
            Decision::withdraw_surrogate(&mut report.decisions);
        }
        let progress = RunProgress::default();
        Ok(Self {
            plan,
            options,
            threads,
            stop,
            began,
            report,
            renderer,
            asked: plan.map.clone(),
            budget: render.budget,
            render,
            transfer,
            has_range: false,
            color_bar,
            learning,
            progress,
            checkpoints,
            races,
        })
    }
}

impl<B: Backend> Cycle<'_, B> {
    /// Replaces the flow map of the first slide by one with the steps of the picture, if these are fewer, and by one of a window in single precision,
    /// if the picture needs it.
    pub(super) fn settle_steps(&mut self, slide: &Slide, chosen: Option<StepChoice>) -> Result<(), RunEnd> {
        let shown = self.run.shown();
        let Some(chosen) = chosen.filter(|_| suit_the_picture(shown.plan)) else { return Ok(()) };
        let (settled, compared) = self.run.threads.render().install(|| picture_steps(shown, slide, chosen))?;
        self.compared = compared;
        self.settled = Some((chosen, settled));
        if settled.steps < chosen.steps {
            tracing::info!("{settled:?} instead of {chosen:?}");
            self.take_steps(chosen, Some(settled));
            transaction!(self, slide, run, on => run.next_tracer(on, slide, &self.map));
        }
        self.tell_snapshots(slide, chosen)?;
        self.settle_storage(slide, true)?;
        Ok(())
    }

    /// Chooses the steps anew if they do not suit the picture of this slide. Returns whether the flow map is another one.
    pub(super) fn look_at_steps(&mut self, slide: &Slide) -> Result<bool, RunEnd> {
        let Some((chosen, settled)) = self.settled else { return Ok(false) };
        let (shown, begin) = (self.run.shown(), Instant::now());
        let (anew, compared) = self.run.threads.render().install(|| {
            let (is_outdated, compared) = is_outdated(shown, slide, chosen, settled)?;
            if !is_outdated {
                return Ok((None, compared));
            }
            match cpu_tracer(slide.velocity.clone(), shown.map, slide.time) {
                Ok(tracer) => {
                    let anew = tracer.step_choice().unwrap_or(chosen);
                    let (settled, compared) = picture_steps(shown, slide, anew)?;
                    Ok((Some(Ok((anew, settled))), compared))
                }
                // The run goes on with what it has.
                Err(error @ FlowError::StepsNotFound { .. }) => Ok((Some(Err(error)), compared)),
                Err(error) => Err(RunEnd::from(error)),
            }
        })?;
        self.compared = compared;
        tracing::debug!("looked at the steps of slide {} for {:.1} ms", slide.index, 1e3 * begin.elapsed().as_secs_f64());
        let (chosen, settled) = match anew {
            None => return Ok(false),
            Some(Ok(anew)) => anew,
            Some(Err(error)) => {
                self.run.progress.warnings.push(format!("slide {}: {error}; the picture keeps {} steps", slide.index, settled.steps));
                return Ok(false);
            }
        };
        if !chosen.within_tolerance {
            self.run.progress.warnings.push(format!(
                "slide {}: the log-stretch (FTLE times tau) with {} steps differs by {:.3} from that with twice as many",
                slide.index, chosen.steps, chosen.difference
            ));
        }
        tracing::info!("{settled:?} in slide {}; for the log-stretch {chosen:?}", slide.index);
        let before = self.map.steps;
        self.settled = Some((chosen, settled));
        self.take_steps(chosen, Some(settled).filter(|settled| settled.steps < chosen.steps));
        Ok(self.map.steps != before)
    }

    /// Takes the steps of the picture, or else those of the log-stretch.
    pub(super) fn take_steps(&mut self, chosen: StepChoice, settled: Option<PictureSteps>) {
        let (steps, difference) = settled.map_or((chosen.steps, chosen.difference), |settled| (settled.steps, settled.difference));
        self.map.steps = Steps::Fixed(steps);
        let report = &mut self.run.report;
        report.integration_steps = Some(steps);
        report.integration_difference = Some(difference).filter(|difference| difference.is_finite());
        report.integration_residual = settled.map(|settled| settled.residual);
        Decision::new("flow.steps", steps, why_steps(difference, report.integration_residual)).enter(&mut report.decisions);
    }

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
        loop {
            // The next window may never come, so this one's next frame tells of a loss.
            slide.warnings.extend(slides.loss());
            let commands = self.run.apply_commands();
            if commands > Commands::None {
                since_command = Some(0);
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
            let mut place = FramePlace { is_warmup: number < warmups, preparing, refining: 0.0, after: None };
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
                place.after = is_soon.then_some(shown);
                let is_only_slide = slide.index == 0 && slides.is_over();
                place.refining = self.refine(slide, Frames { shown, left, before: self.frames_before, is_only_slide })?;
            }
            transaction!(self, slide, run, on => run.learn_shorter(on, slide));
            let frame = transaction!(self, slide, run, on => run.frame(on, slide, place, start, sink));
            slide.warnings.clear();
            slide.waited = 0.0;
            let is_good = |target: Target| frame.record.picture_error.is_some_and(|error| target.is_met_by(&error));
            let is_done = target.is_some_and(is_good) && number >= warmups;
            pace.add(self.run.render.method, &frame.record);
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
    pub(super) fn shown(&self) -> Shown<'_> {
        Shown {
            plan: self.plan,
            map: &self.asked,
            transfer: self.renderer.transfer(),
            tolerance: self.learning.trust.tolerance(),
            stop: self.stop,
        }
    }

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

    /// Warnings about a flow map whose steps were `chosen` or given.
    pub(super) fn flow_warnings(
        &self,
        flow: &dyn Tracer,
        chosen: Option<StepChoice>,
        differences: Option<IntegrationDifferences>,
    ) -> Vec<String> {
        let mut warnings: Vec<String> = self.colourless(flow).into_iter().collect();
        if let Some(found) = &differences {
            warnings.extend(integration_warnings(found, &self.plan.map, flow.steps(), chosen.is_some()));
        }
        if let Some(chosen) = chosen.filter(|chosen| chosen.not_finite > 0) {
            warnings.push(format!(
                "{} of {} paths of the step choice have no finite log-stretch (FTLE times tau): the integration overflowed there",
                chosen.not_finite,
                StepChoice::POINTS
            ));
        }
        if let Some(chosen) = chosen.filter(|chosen| !chosen.within_tolerance) {
            warnings.push(format!(
                "{} steps a path, the maximum, still differ from twice as many by {:.3} in the log-stretch (FTLE times tau), root mean \
                 square of the better 98 %",
                chosen.steps, chosen.difference
            ));
        }
        warnings
    }
}

/// Largest number of checkpoints that are kept aside.
const MAX_UNFIT: usize = 99;

/// Keeps a checkpoint that does not fit from being replaced by the next one: it may be the work of another run. Returns where it is, in words.
fn set_aside(path: &Path, refused: &CheckpointError) -> String {
    if !matches!(refused, CheckpointError::Mismatch { .. } | CheckpointError::Io { .. }) {
        return String::new();
    }
    for number in 1..=MAX_UNFIT {
        let mut aside = path.as_os_str().to_owned();
        aside.push(if number == 1 { ".unfit".to_owned() } else { format!(".unfit-{number}") });
        // A link takes the name only if it is free.
        match std::fs::hard_link(path, &aside).and_then(|()| std::fs::remove_file(path)) {
            Ok(()) => return format!("; it is now {}", Path::new(&aside).display()),
            Err(error) if error.kind() == std::io::ErrorKind::AlreadyExists => {}
            Err(error) => return format!("; it cannot be set aside: {error}"),
        }
    }
    format!("; it cannot be set aside: {MAX_UNFIT} such files are there")
}

/// Maximum number of table nodes for a live simulation, since every slide traces the table again. On the CPU it is the number of camera paths of
/// the slide's frames: with more nodes, the table costs more than tracing every query.
fn max_live_nodes(scene: &Settings, device: &Device) -> usize {
    if device.is_gpu() {
        return usize::MAX;
    }
    let frames = [scene.render.width, scene.render.height, scene.render.samples.ceil() as usize, scene.time.frames_per_slide];
    frames.into_iter().fold(1, usize::saturating_mul)
}

/// Steps per path; `None` if each path chooses its own.
pub(super) fn fixed_steps(tracer: &dyn Tracer) -> Option<usize> {
    Some(tracer.steps()).filter(|steps| *steps > 0)
}
