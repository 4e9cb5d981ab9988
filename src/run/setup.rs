//! From a scene file to everything a run needs, checked before any work is done.

use super::slides::{Slides, closed_form, live_slides, no_domain, open_slides, open_snapshots};
use super::{EngineError, Settings, TimeSettings, memory};
use crate::field::Domain;
use crate::flow::{Boundary, Direction, FlowMap, Interpolation, Steps, StepsSetting};
use crate::render::{Method, Renderer, Scene};
use crate::setting::{Refused, require, shown, word};
use crate::source::live::Live;
use crate::source::{DEFAULT_READ_AHEAD, Metric, SnapshotSource, SourceKind, Steady, VelocityUnit, window_snapshots};
use crate::surrogate::Kind;
use crate::surrogate::network::Input;

/// A scene whose open questions (tau, direction, boundary, domain) are answered.
#[derive(Debug, Clone)]
pub struct Plan {
    /// What was asked for.
    pub scene: Settings,
    /// The flow map, but for its start time.
    pub map: FlowMap,
    /// Where seeds lie.
    pub domain: Domain,
    /// What the velocities are, in words: what is made up says so.
    pub source: String,
    /// Unit of times: `s`, `snapshots`, a simulation's own; empty where they have none.
    pub time_unit: String,
}

/// A plan and its opened source.
pub struct Setup {
    /// What is to be done.
    pub plan: Plan,
    /// The slides of the window.
    pub slides: Box<dyn Slides>,
    /// What should be told before work starts.
    pub notes: Vec<String>,
}

impl Setup {
    /// Opens the source and settles what the scene leaves open.
    pub fn new(scene: Settings) -> Result<Self, EngineError> {
        scene.check()?;
        let snapshots = if closed_form(&scene.source).is_some() { None } else { Some(open_snapshots(&scene)?) };
        Self::settle(scene, snapshots, None)
    }

    /// The same over snapshots of the caller's, which stand for those that the scene describes; none for closed forms.
    pub fn over(scene: Settings, snapshots: Option<Box<dyn SnapshotSource>>) -> Result<Self, EngineError> {
        scene.check()?;
        Self::settle(scene, snapshots, None)
    }

    /// The same for a simulation that was found running; its window begins to fill.
    pub fn live(scene: Settings, live: Live) -> Result<Self, EngineError> {
        scene.check()?;
        Self::settle(scene, None, Some(live))
    }

    fn settle(mut scene: Settings, mut snapshots: Option<Box<dyn SnapshotSource>>, live: Option<Live>) -> Result<Self, EngineError> {
        let mut notes = Vec::new();
        let closed = closed_form(&scene.source);
        let grid = snapshots.as_ref().map(|s| s.grid().clone()).or(live.as_ref().map(|l| l.grid().clone()));
        let unit = snapshots.as_ref().map(|s| s.describe().time_unit).or(live.as_ref().map(|l| l.time_unit().to_owned()));
        let source = match (&snapshots, &live) {
            (Some(snapshots), _) => snapshots.describe().line(),
            (None, Some(live)) => format!("a running simulation, {}", live.describe()),
            (None, None) => format!("closed form: {}", word(scene.source.kind)),
        };
        let flat = grid.as_ref().is_some_and(|grid| grid.dimensions() == 2);
        let archive = matches!(scene.source.kind, SourceKind::Archive | SourceKind::Live);
        let direction = scene.time.direction.unwrap_or(if archive { Direction::Backward } else { Direction::Forward });
        let tau = match (&scene.time.tau, &snapshots) {
            (Some(tau), _) => {
                if tau.has_unit() && unit.as_ref().is_some_and(|unit| unit != "s") {
                    let found = "has a unit, but the source's time is not in seconds (with the index metric it counts snapshots)";
                    return Err(Refused::new("time.tau", found, "a plain number").into());
                }
                tau.value()
                    .ok_or_else(|| Refused::new("time.tau", format_args!("is {}", shown(tau)), "a number, or words such as \"30 days\""))?
            }
            (None, Some(_)) if archive && scene.archive.steady => {
                return Err(Refused::new("time.tau", "is missing", "a duration: a steady flow gives none (archive.steady is true)").into());
            }
            (None, Some(source)) => {
                let tau = source.default_tau()?;
                notes.push(format!("time.tau is not given: {tau} {}, half of the archive's span", source.describe().time_unit));
                tau
            }
            (None, None) if scene.source.kind == SourceKind::Live => {
                return Err(Refused::new("time.tau", "is missing", "a duration in the simulation's time (attach --tau TIME)").into());
            }
            (None, None) => return Err(Refused::new("time.tau", "is missing", "a number above 0").into()),
        };
        if archive
            && scene.archive.steady
            && let Some(source) = snapshots
        {
            let counted = source.describe().metric == Metric::Index && scene.archive.velocity_unit == VelocityUnit::Si;
            if counted {
                let found = "is true, but the metric is index, which counts snapshots";
                return Err(
                    Refused::new("archive.steady", found, "metric = \"sphere\" or \"cartesian\", or velocity_unit = \"cells\"").into()
                );
            }
            snapshots = Some(Box::new(Steady::new(source, direction.sign() * tau)?));
        }
        // A steady flow says so itself.
        notes.extend(snapshots.iter().flat_map(|source| source.describe().notes));
        let boundary = scene.flow.boundary.unwrap_or(match scene.source.kind {
            SourceKind::Archive | SourceKind::Live => Boundary::Stop,
            SourceKind::Turbulence => Boundary::Clamp,
            _ => Boundary::Unbounded,
        });
        let map = FlowMap {
            tau,
            direction,
            integrator: scene.flow.integrator,
            precision: scene.flow.precision,
            steps: match scene.flow.steps {
                StepsSetting::Auto => Steps::Auto { tolerance: scene.flow.tolerance.unwrap_or(if archive { 0.1 } else { 0.01 }) },
                StepsSetting::Fixed(n) => Steps::Fixed(n),
            },
            difference_step: scene.flow.difference_step,
            boundary,
            normalisation: scene.flow.normalisation,
            interpolation: scene.flow.interpolation.unwrap_or(if archive && flat { Interpolation::Cubic } else { Interpolation::Linear }),
        };
        let domain = match (&closed, &scene.domain, &grid) {
            (Some(flow), Some(given), _) => Domain { dimensions: flow.dimensions(), ..Domain::cuboid(given.min, given.max) },
            (_, _, Some(grid)) => grid.domain(),
            _ => return Err(no_domain()),
        };
        if closed.is_some() {
            check_start(&scene.time, tau, direction.sign())?;
        }
        // What is left open follows from the grid: where that is odd, the message says whose it is.
        check_picture(&scene, &domain, tau).map_err(|refused| match &snapshots {
            Some(source) => refused.over(&source.name()),
            None => refused,
        })?;
        scene.surrogate.check_nodes(domain.dimensions)?;
        if scene.training.resume.is_some() && (scene.render.method == Method::Reference || scene.surrogate.kind == Kind::Table) {
            notes.push("training.resume is not read: neither method reference nor a table goes on from a checkpoint".to_owned());
        }
        let times = snapshots.as_ref().map(|s| s.times().to_vec());
        let slides = match live {
            Some(live) => live_slides(&scene, live.follow(tau, scene.time.snapshots_per_slide)?, direction),
            None => open_slides(&scene, snapshots, tau, direction)?,
        };
        if let (Some(times), Some(grid)) = (&times, &grid) {
            notes.extend(memory::short(window_bytes(times, tau, grid.nodes()), memory::available()));
        }
        notes.extend(settle_starts(&mut scene, times.as_deref(), tau, direction)?);
        let time_unit = unit.unwrap_or_default();
        Ok(Self { plan: Plan { scene, map, domain, source, time_unit }, slides, notes })
    }
}

/// Bytes of the window, of what is read ahead, and of the snapshot that is being read.
fn window_bytes(times: &[f64], tau: f64, nodes: usize) -> u64 {
    let snapshots = (window_snapshots(times, tau) + DEFAULT_READ_AHEAD + 1).min(times.len());
    (snapshots as u64).saturating_mul(nodes as u64).saturating_mul(size_of::<[f32; 4]>() as u64)
}

/// Settles over which seed times the network's input runs, where it has one and they are left open: those that the source can be asked for. Says
/// so where there is but one, and the input does nothing.
fn settle_starts(scene: &mut Settings, times: Option<&[f64]>, tau: f64, direction: Direction) -> Result<Option<String>, Refused> {
    if !scene.network.inputs.contains(&Input::Start) || scene.network.start_range.is_some() {
        return Ok(None);
    }
    let ends = match (times, scene.source.kind) {
        (_, SourceKind::Live) => {
            let found = "is missing, and a running simulation does not say when it will end";
            return Err(Refused::new("network.start_range", found, "two times, ascending").beside(&["network.inputs"]));
        }
        (Some(times), _) => {
            let (first, last) = (times.first().copied().unwrap_or(0.0), times.last().copied().unwrap_or(0.0));
            match direction {
                Direction::Forward => [first, last - tau],
                Direction::Backward => [first + tau, last],
            }
        }
        (None, _) => {
            let TimeSettings { start, seed_step: step, slides, .. } = scene.time;
            let last = start + step * slides.unwrap_or(1).saturating_sub(1) as f64;
            [start.min(last), start.max(last)]
        }
    };
    if ends[0] < ends[1] {
        scene.network.start_range = Some(ends);
        return Ok(None);
    }
    scene.network.inputs.retain(|input| *input != Input::Start);
    Ok(Some(format!("network.inputs: \"start\" is left out, since all frames are of one start time, {}", ends[0])))
}

/// Refuses times so far from 0 that adding tau to them is lost in their last place: nothing would move, and the FTLE would be 0.
fn check_start(time: &TimeSettings, tau: f64, sign: f64) -> Result<(), Refused> {
    let last = time.start + time.seed_step * time.slides.unwrap_or(1).saturating_sub(1) as f64;
    for start in [time.start, last] {
        let moved = ((start + sign * tau) - start).abs();
        // A millionth of tau is far below what a step resolves.
        require((moved - tau).abs() <= 1e-6 * tau, "time.start", start, "a time from which tau can be told apart in double precision")
            .map_err(|refused| refused.beside(&["time.seed_step", "time.slides", "time.tau"]))?;
    }
    Ok(())
}

/// Refuses a camera, light or transfer function before anything is read, rendered or written.
fn check_picture(scene: &Settings, domain: &Domain, tau: f64) -> Result<(), Refused> {
    let mut picture = assemble(scene, domain);
    // What is left open is scaled later, to values that are accepted.
    picture.transfer = picture.transfer.scaled_to(&[0.0, 1.0]);
    Renderer::new(picture, domain, tau)?;
    Ok(())
}

/// The picture's scene, its transfer function as far as the file gives it.
pub(super) fn assemble(scene: &Settings, domain: &Domain) -> Scene {
    Scene::assemble(domain, scene.camera.clone(), scene.light.clone(), scene.transfer.clone(), scene.render.clone(), scene.seed)
}
