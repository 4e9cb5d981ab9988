//! State of a run on the host.

use super::budget::FrameCost;
use super::checkpoints::Checkpoints;
use super::decision::{Decision, enter_colours, suited_network};
use super::frame::LastAudit;
use super::need::Need;
use super::race::{Race, Races};
use super::report::{RunOptions, RunReport};
use super::setup::Plan;
use super::slides::Slide;
use super::steering::{Command, drawn_by};
use super::steps::fixed_steps;
use super::stop::RunEnd;
use super::training::{Threads, TrainingBudget};
use super::transaction::Recovering;
use super::{ColorBar, Settings, TransferRecord};
use crate::backend::Device;
use crate::flow::{FlowMap, Tracer, VelocitySource};
use crate::render::smooth::{AUDIT_PAIRS, StepsError};
use crate::render::{Method, RenderSettings, Renderer, Scene};
use crate::surrogate::network::{NetworkSettings, Size, Times};
use crate::surrogate::{Kind, Learned, MAX_DEVICE_NODES, MAX_OWN_NODES, ReplayBuffer, Resize, Sizing, SurrogateSettings};
use crate::trust::TrustMap;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::time::Instant;

/// Reason for the nodes of a table of a flat flow.
const TWO_A_PIXEL: &str = "two a pixel along the longest edge, since the FTLE of a flow of two dimensions folds finer than data";
/// Maximum number of residuals of rendered samples that go to the trust map each frame. More would not improve the estimates of their cells.
pub(super) const MAX_RENDER_RESIDUALS: usize = 1 << 16;

/// State of a run on the host, independent of the backend.
pub(super) struct Run<'a> {
    pub(super) plan: &'a Plan,
    pub(super) options: &'a RunOptions,
    pub(super) threads: Threads,
    pub(super) stop: &'a AtomicBool,
    pub(super) began: Instant,
    pub(super) report: &'a mut RunReport,
    pub(super) renderer: Renderer,
    /// The flow map as the scene and commands ask for it; [`super::cycle::Cycle::map`] is what came of it.
    pub(super) asked: FlowMap,
    /// `[render]` with the method and the budget that commands set.
    pub(super) render: RenderSettings,
    /// The newest budget, also while the method has none.
    pub(super) budget: Option<f64>,
    pub(super) transfer: TransferRecord,
    /// What the steps leave in smooth pictures, and whether that was measured for another picture than the one that is shown.
    pub(super) steps_error: StepsError,
    pub(super) steps_are_of_another_picture: bool,
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
    /// finer table. The first frame of many is the march, with the samples that measure its error, and later ones make up for it ([`Soon`]).
    pub(super) fn affordable_samples(&self, settings: &RenderSettings, place: &FramePlace) -> f64 {
        /// Samples a pixel of the first frame with a budget, whose cost is not known.
        const FIRST: f64 = 0.25;
        /// Those that measure the error of a march.
        const SOON: f64 = 2.0 * AUDIT_PAIRS;
        let Some(milliseconds) = settings.budget else {
            return match place.soon.filter(|_| settings.method == Method::TwoLevel && settings.samples > SOON) {
                Some(Soon::March) => SOON,
                Some(Soon::Rest) => settings.samples - SOON,
                // A target is met by as many as it needs.
                Some(Soon::Twice) if settings.until.is_none() => 2.0 * settings.samples,
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

/// A frame of a slide whose first one is drawn soon.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(super) enum Soon {
    /// The first: the march, with the samples that measure its error.
    March,
    /// The second: the rest of the samples of one frame.
    Rest,
    /// One that makes up for both.
    Twice,
    /// A later one.
    Usual,
}

/// Place of a frame in its slide.
#[derive(Clone, Copy)]
pub(super) struct FramePlace {
    pub(super) is_warmup: bool,
    /// Seconds of preparing the slide, for its first frame; 0 for the others.
    pub(super) preparing: f64,
    /// Seconds of tracing nodes of a finer table before the frame.
    pub(super) refining: f64,
    /// `None` with a budget, after a command, or if too few frames are expected.
    pub(super) soon: Option<Soon>,
}

/// What a run is given before its first slide.
pub(super) struct RunGiven<'a> {
    pub(super) plan: &'a Plan,
    pub(super) options: &'a RunOptions,
    pub(super) threads: Threads,
    pub(super) stop: &'a AtomicBool,
    pub(super) began: Instant,
    pub(super) earlier_race: Option<Race>,
    pub(super) report: &'a mut RunReport,
}

impl<'a> Run<'a> {
    pub(super) fn new(frame: RunGiven<'a>, settled: Scene, flow: &dyn Tracer, is_gpu: bool, first: &Slide) -> Result<Self, RunEnd> {
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
            steps_error: StepsError::default(),
            steps_are_of_another_picture: false,
            has_range: false,
            color_bar,
            learning,
            progress,
            checkpoints,
            races,
        })
    }
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
