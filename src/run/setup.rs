//! Setup of a run from its settings: opens the source, chooses open settings, and checks everything before work starts.

use super::decision::Decision;
use super::default_tau::default_tau;
use super::race::Race;
use super::settings::with_ends;
use super::slides::{Slides, closed_form, live_slides, no_domain, open_slides, open_snapshots};
use super::{MapSettings, RunError, Settings, TimeSettings, TimeSpan, TrainingSettings, memory};
use crate::field::Domain;
use crate::flow::{Boundary, Direction, FlowMap, Interpolation, Steps, StepsSetting};
use crate::render::{Combine, Method, ProjectionChoice, ProjectionKind, RenderSettings, Renderer, Scene, TransferSettings};
use crate::setting::{Refused, require, shown, word};
use crate::source::live::Live;
use crate::source::{
    DEFAULT_READ_AHEAD, Every, Georeference, Metric, SnapshotSource, SourceKind, Steady, VelocityUnit, duration, window_snapshots,
};
use crate::surrogate::network::{Input, NetworkSettings};
use crate::surrogate::{Kind, SurrogateSettings};
use crate::trust::TrustSettings;

/// A scene with all open settings (tau, direction, boundary, domain) chosen.
#[derive(Debug, Clone)]
pub struct Plan {
    /// Settings of the scene.
    pub scene: Settings,
    /// Settings of the flow map; the start time is that of a slide.
    pub map: FlowMap,
    /// Domain of the seeds.
    pub domain: Domain,
    /// Description of the velocity; names synthetic data as such.
    pub source: String,
    /// Unit of times: `s`, `snapshots`, or the simulation's; empty if they have none.
    pub time_unit: String,
    /// Names and meaning of the domain's coordinates; empty if they are in no file.
    pub georeference: Georeference,
    /// The method is chosen by races, and the one of the scene is the first (`render.method = "auto"`).
    pub races: bool,
}

/// A plan and its opened source.
pub struct Setup {
    /// The complete scene.
    pub plan: Plan,
    /// The slides of the window.
    pub slides: Box<dyn Slides>,
    /// Remarks for the user before work starts.
    pub notes: Vec<String>,
    /// Choices for settings that the scene leaves open.
    pub decisions: Vec<Decision>,
    /// The last race of an earlier run of the same scene: a run whose plan has races begins with the method that won it.
    pub earlier_race: Option<Race>,
}

/// The rule by which steps are chosen on a closed form or a grid.
pub(crate) fn auto_steps(is_gridded: bool, interpolation: Interpolation) -> Steps {
    match (is_gridded, interpolation) {
        (false, _) => Steps::Auto { tolerance: 0.01 },
        (true, Interpolation::Linear) => Steps::AutoByShare { tolerance: 0.1, share: 0.015 },
        (true, Interpolation::Cubic) => Steps::Auto { tolerance: 0.1 },
    }
}

impl Setup {
    /// The method of the first frame.
    pub fn first_method(&self) -> Method {
        let raced = self.earlier_race.as_ref().filter(|_| self.plan.races).map(|race| race.method);
        raced.unwrap_or(self.plan.scene.render.method)
    }

    /// Opens the source and chooses the settings that the scene leaves open. An archive is taken as it is now, and nothing is held for maps of the
    /// slides, `[maps]` of the scene.
    ///
    /// # Errors
    /// A setting is not accepted, or the source cannot be opened.
    pub fn new(mut scene: Settings) -> Result<Self, RunError> {
        (scene.archive.follow, scene.maps) = (None, MapSettings::default());
        Self::for_run(scene)
    }

    /// The same with what only runs have: maps of their slides, and an archive that is followed if the scene says so, whose slides may wait for
    /// snapshots that come.
    ///
    /// # Errors
    /// As for [`Self::new`].
    pub fn for_run(scene: Settings) -> Result<Self, RunError> {
        scene.check()?;
        let snapshots = if closed_form(&scene.source).is_some() { None } else { Some(open_snapshots(&scene)?) };
        Self::settle(scene, snapshots, None)
    }

    /// Sets up a run over the caller's snapshots (every `time.every`-th of them) instead of those that the scene describes; `None` for closed
    /// forms.
    ///
    /// # Errors
    /// A setting is not accepted, or the snapshots do not span tau.
    pub fn over(scene: Settings, snapshots: Option<Box<dyn SnapshotSource>>) -> Result<Self, RunError> {
        scene.check()?;
        let snapshots = snapshots.map(|source| Box::new(Every::new(source, scene.time.every)) as Box<dyn SnapshotSource>);
        Self::settle(scene, snapshots, None)
    }

    /// Sets up a run on a connected simulation, and starts to fill its window.
    ///
    /// # Errors
    /// A setting is not accepted, or the simulation cannot be followed.
    pub fn live(scene: Settings, live: Live) -> Result<Self, RunError> {
        scene.check()?;
        Self::settle(scene, None, Some(live))
    }

    fn settle(mut scene: Settings, mut snapshots: Option<Box<dyn SnapshotSource>>, live: Option<Live>) -> Result<Self, RunError> {
        let (mut notes, mut decisions) = (Vec::new(), Vec::new());
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
                return Err(Refused::new(
                    "time.tau",
                    "is missing",
                    "a duration, since a steady flow gives none: --set time.tau=\"5 days\" (archive.steady is true)",
                )
                .into());
            }
            // Chosen below, at most this.
            (None, Some(source)) => source.longest_default_tau()?,
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
        // After `Steady` is in place, which adds its own note.
        notes.extend(snapshots.iter().flat_map(|source| source.describe().notes));
        let boundary = scene.flow.boundary.unwrap_or(match scene.source.kind {
            SourceKind::Archive | SourceKind::Live => Boundary::Stop,
            SourceKind::Turbulence => Boundary::Clamp,
            _ => Boundary::Unbounded,
        });
        let interpolation = scene.flow.interpolation.unwrap_or(if archive && flat { Interpolation::Cubic } else { Interpolation::Linear });
        let mut map = FlowMap {
            tau,
            direction,
            integrator: scene.flow.integrator,
            precision: scene.flow.precision,
            steps: match scene.flow.steps {
                StepsSetting::Auto => match scene.flow.tolerance {
                    Some(tolerance) => Steps::Auto { tolerance },
                    None => auto_steps(closed.is_none(), interpolation),
                },
                StepsSetting::Fixed(n) => Steps::Fixed(n),
            },
            difference_step: scene.flow.difference_step,
            boundary,
            normalisation: scene.flow.normalisation,
            interpolation,
        };
        // Maps of both directions hold twice tau.
        let holds_both = scene.maps.both && flat;
        let held = |tau: f64| if holds_both { 2.0 * tau } else { tau };
        let domain = match (&closed, &scene.domain, &grid) {
            (Some(flow), Some(given), _) => Domain { dimensions: flow.dimensions(), ..Domain::cuboid(given.min, given.max) },
            (_, _, Some(grid)) => grid.domain(),
            _ => return Err(no_domain()),
        };
        let races = settle_method(&mut scene, &domain, &mut decisions)?;
        notes.extend(unused_by_maps(&scene));
        notes.extend(unused_by_volumes(&scene, &domain));
        if closed.is_some() {
            check_start(&scene.time, tau, direction.sign())?;
        }
        // Open settings follow from the grid, so the message names the source.
        check_picture(&scene, &domain, tau).map_err(|refused| match &snapshots {
            Some(source) => refused.over(&source.name()),
            None => refused,
        })?;
        decisions.extend(chosen_projection(&scene, &domain));
        scene.surrogate.check_nodes(domain.dimensions)?;
        let followed = scene.source.kind == SourceKind::Archive && scene.archive.follow.is_some();
        // After the checks that read nothing.
        if let (None, Some(source), Some(grid)) = (&scene.time.tau, &mut snapshots, &grid) {
            let (times, nodes) = (source.times().to_vec(), grid.nodes());
            let fits = |tau: f64| scene.archive.check_window(window_bytes(&times, held(tau), nodes, followed)).is_ok();
            let (tau, why) = default_tau(&mut **source, &map, fits)?;
            let unit = source.describe().time_unit;
            let words = duration(tau, &unit);
            notes.push(format!("time.tau is not given: {words}, {why}"));
            decisions.push(Decision::new("time.tau", words, why));
            (map.tau, scene.time.tau) = (tau, Some(TimeSpan::Number(tau)));
        }
        let tau = map.tau;
        if scene.training.resume.is_some() && (!scene.render.method.has_surrogate() || scene.surrogate.kind == Kind::Table) {
            notes.push("training.resume is ignored: methods reference and map, and tables, cannot resume from a checkpoint".to_owned());
        }
        notes.extend(snapshots.as_ref().filter(|_| !scene.archive.steady).and_then(|source| below_interval(&**source, tau)));
        let times = snapshots.as_ref().map(|s| s.times().to_vec());
        let georeference = snapshots.as_ref().map(|s| s.georeference()).unwrap_or_default();
        if scene.source.kind == SourceKind::Archive
            && let (Some(times), Some(grid)) = (&times, &grid)
        {
            // Before the first snapshot is read.
            scene.archive.check_window(window_bytes(times, held(tau), grid.nodes(), followed))?;
        }
        if let (true, false, Some([first, .., last])) = (holds_both, followed, times.as_deref())
            && last - first < 2.0 * tau * (1.0 - 1e-9)
        {
            notes.push("maps.both: no slide gets a map, since the snapshots span less than twice tau".to_owned());
        }
        let slides = match live {
            Some(live) => {
                let window = live.follow_beside(tau, scene.time.snapshots_per_slide, scene.time.every, u64::from(holds_both))?;
                live_slides(&scene, window, direction)
            }
            None => open_slides(&scene, snapshots, tau, direction)?,
        };
        if let (Some(times), Some(grid)) = (&times, &grid) {
            notes.extend(memory::short(window_bytes(times, held(tau), grid.nodes(), followed), ridgewatch_base::memory::available()));
        }
        notes.extend(settle_starts(&mut scene, times.as_deref(), tau, direction)?);
        let time_unit = unit.unwrap_or_default();
        Ok(Self { plan: Plan { scene, map, domain, source, time_unit, georeference, races }, slides, notes, decisions, earlier_race: None })
    }
}

/// Note on a tau that ends before the next snapshot: the number may have been meant in another unit.
fn below_interval(source: &dyn SnapshotSource, tau: f64) -> Option<String> {
    let unit = source.describe().time_unit;
    let (_, interval) = source.span_and_interval().ok()?;
    let with_unit = if unit == "s" { "; durations may have a unit, as \"5 days\"" } else { "" };
    (tau < interval).then(|| {
        let [tau, interval] = [tau, interval].map(|time| duration(time, &unit));
        format!("tau is {tau}, less than the {interval} between snapshots, and shows hardly more than one of them{with_unit}")
    })
}

/// Replaces `render.method = "default"` and `"auto"`: flows of two dimensions are drawn as maps, unless the scene sets what only volumes have. Returns
/// whether methods race.
fn settle_method(scene: &mut Settings, domain: &Domain, decisions: &mut Vec<Decision>) -> Result<bool, Refused> {
    let is_flat = domain.dimensions == 2;
    let wanted = scene.render.method;
    let mut races = false;
    if matches!(wanted, Method::Auto | Method::Default) {
        let of_volumes = of_volumes(scene);
        scene.render.method = Method::Default.or_default(is_flat && of_volumes.is_empty());
        let is_bound = scene.render.until.is_some() || scene.render.budget.is_some();
        races = wanted == Method::Auto && scene.render.method != Method::Map && !is_bound;
        let why = match of_volumes.first() {
            _ if races => "the first to draw: no race was run yet".to_owned(),
            _ if wanted == Method::Auto && is_bound => "only smooth methods have render.until and render.budget".to_owned(),
            _ if !is_flat => "the flow has three dimensions".to_owned(),
            None => "the flow has two dimensions; two_level draws it as a volume".to_owned(),
            Some(key) => format!("the scene sets {key}, which a map of the flow has not"),
        };
        decisions.push(Decision::new("render.method", scene.render.method.name(), why));
    }
    if scene.render.method == Method::Map && !is_flat {
        let accepted = "another method with a flow of three dimensions, of which the command map draws a level";
        return Err(Refused::new("render.method", "is \"map\"", accepted));
    }
    scene.render.check()?;
    Ok(races)
}

/// True if `render.method = "auto"` and the default draw a scene over a domain as a map.
pub(crate) fn auto_is_map(scene: &Settings, domain: &Domain) -> bool {
    domain.dimensions == 2 && of_volumes(scene).is_empty()
}

/// The keys of the scene that only a picture of a volume has.
fn of_volumes(scene: &Settings) -> Vec<&'static str> {
    let transfer = scene.transfer.clone().unwrap_or_default();
    let has_albedo = transfer.albedo != TransferSettings::default().albedo;
    let set = [
        (scene.camera.is_some(), "camera"),
        (scene.light.is_some(), "light"),
        (transfer.extinction.is_some(), "transfer.extinction"),
        (has_albedo, "transfer.albedo"),
        (scene.render.budget.is_some(), "render.budget"),
        (scene.render.combine != Combine::Shrink, "render.combine"),
        (scene.surrogate != SurrogateSettings::default(), "surrogate"),
        (scene.network != NetworkSettings::default(), "network"),
        (scene.training != TrainingSettings::default(), "training"),
        (scene.trust != TrustSettings::default(), "trust"),
    ];
    set.into_iter().filter(|(is_set, _)| *is_set).map(|(_, key)| key).collect()
}

/// What is said of the keys of the scene that a map ignores.
fn unused_by_maps(scene: &Settings) -> Option<String> {
    let (render, default) = (&scene.render, RenderSettings::default());
    if render.method != Method::Map {
        return None;
    }
    let mut keys = of_volumes(scene);
    // A map shows the part of the flow that the camera sees.
    keys.retain(|key| *key != "camera");
    keys.extend((render.tone_map != default.tone_map).then_some("render.tone_map"));
    keys.extend((render.majorant_cells != default.majorant_cells).then_some("render.majorant_cells"));
    (!keys.is_empty()).then(|| format!("without effect on a map: {}", keys.join(", ")))
}

/// What is said of keys of maps that a flow in three dimensions, or a picture of a volume, has not.
fn unused_by_volumes(scene: &Settings, domain: &Domain) -> Vec<String> {
    let is_idle = domain.dimensions == 3 && scene.maps != MapSettings::default();
    let maps = is_idle.then(|| "without effect on a flow of three dimensions: maps".to_owned());
    let is_volume = scene.render.method != Method::Map && scene.render.projection != ProjectionChoice::Auto;
    let projection =
        is_volume.then(|| format!("without effect with render.method = \"{}\": render.projection", scene.render.method.name()));
    maps.into_iter().chain(projection).collect()
}

/// The projection of a map, if the scene leaves it open and the data have longitudes and latitudes.
fn chosen_projection(scene: &Settings, domain: &Domain) -> Option<Decision> {
    if scene.render.method != Method::Map || scene.render.projection != ProjectionChoice::Auto || !domain.is_geographic {
        return None;
    }
    let (chosen, why) = match assemble(scene, domain).plane {
        Some(plane) => (plane.projection.kind(), "fits the region of the longitudes and latitudes"),
        None => (ProjectionKind::Plain, "the scene sets a camera, which is in degrees"),
    };
    Some(Decision::new("render.projection", word(chosen), why))
}

/// Bytes of the window, of the snapshots read ahead, and of the snapshot that is being read.
fn window_bytes(times: &[f64], tau: f64, nodes: usize, is_followed: bool) -> u64 {
    let known = (window_snapshots(times, tau) + DEFAULT_READ_AHEAD + 1).min(times.len());
    // More may come, as far apart as those that are there.
    let interval = match times {
        [first, .., last] => (last - first) / (times.len() - 1) as f64,
        _ => f64::INFINITY,
    };
    let coming = if is_followed { (tau / interval).ceil() as usize + 1 + DEFAULT_READ_AHEAD + 1 } else { 0 };
    let snapshots = known.max(coming);
    (snapshots as u64).saturating_mul(nodes as u64).saturating_mul(size_of::<[f32; 4]>() as u64)
}

/// Chooses the range of the network's start-time input, if it has one and the scene leaves the range open: all seed times that the source covers.
/// Removes the input and returns a note if there is only one seed time.
fn settle_starts(scene: &mut Settings, times: Option<&[f64]>, tau: f64, direction: Direction) -> Result<Option<String>, Refused> {
    if !scene.network.inputs.contains(&Input::Start) || scene.network.start_range.is_some() {
        return Ok(None);
    }
    let ends = match (times, scene.source.kind) {
        (_, SourceKind::Live) => {
            let found = "is missing, and a running simulation does not say when it will end";
            return Err(Refused::new("network.start_range", found, "two times, ascending").beside(&["network.inputs"]));
        }
        (Some(_), SourceKind::Archive) if scene.archive.follow.is_some() => {
            let found = "is missing, and an archive that is followed does not say when it will end";
            return Err(Refused::new("network.start_range", found, "two times, ascending").beside(&["network.inputs", "archive.follow"]));
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
    Ok(Some(format!("network.inputs: \"start\" is left out, since all frames have the same start time, {}", ends[0])))
}

/// Rejects start times so large that adding tau is lost to rounding: particles would not move, and the FTLE would be 0.
fn check_start(time: &TimeSettings, tau: f64, sign: f64) -> Result<(), Refused> {
    let last = time.start + time.seed_step * time.slides.unwrap_or(1).saturating_sub(1) as f64;
    for start in [time.start, last] {
        let moved = ((start + sign * tau) - start).abs();
        // A millionth of tau is far below the length of a step.
        require((moved - tau).abs() <= 1e-6 * tau, "time.start", start, "a time from which tau can be told apart in double precision")
            .map_err(|refused| refused.beside(&["time.seed_step", "time.slides", "time.tau"]))?;
    }
    Ok(())
}

/// Rejects invalid cameras, lights and transfer functions before any data is read.
fn check_picture(scene: &Settings, domain: &Domain, tau: f64) -> Result<(), Refused> {
    let mut picture = assemble(scene, domain);
    picture.transfer = with_ends(&picture.transfer);
    Renderer::new(picture, domain, tau)?;
    Ok(())
}

/// Scene of the picture, with the transfer function as far as the scene file sets it.
pub(super) fn assemble(scene: &Settings, domain: &Domain) -> Scene {
    Scene::assemble(domain, scene.camera.clone(), scene.light.clone(), scene.transfer.clone(), scene.render.clone(), scene.seed)
}
