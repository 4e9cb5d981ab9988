//! Commands to a run in progress: checked as they come, applied between two frames, and kept in the record of the frame that shows them first.

use super::setup::{Plan, assemble};
use super::slides::closed_form;
use crate::field::Domain;
use crate::flow::{Direction, Steps};
use crate::render::{ALBEDO_PRESETS, Albedo, Camera, CameraSettings, Method, RenderSettings, Transfer, TransferSettings, check_depth};
use crate::setting::{Refused, require, shown};
use crate::trust::TrustSettings;
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};
use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

/// What a command may change, by the names of the scene file. Values that are not given stay as they are.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct Change {
    /// The view, in scene units (see `scale` of [`super::FrameRecord`]).
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub camera: Option<CameraSettings>,
    /// Allowed optical residual.
    #[serde(rename = "trust.tolerance", default, skip_serializing_if = "Option::is_none")]
    pub tolerance: Option<f64>,
    /// FTLE (1/time) at which extinction begins and is full.
    #[serde(rename = "transfer", default, skip_serializing_if = "Option::is_none")]
    pub range: Option<Range>,
    /// Full extinction, 1/length.
    #[serde(rename = "transfer.extinction", default, skip_serializing_if = "Option::is_none")]
    pub extinction: Option<f64>,
    /// Polynomial coefficients of the red, green and blue albedo.
    #[serde(rename = "transfer.albedo", default, skip_serializing_if = "Option::is_none")]
    pub albedo: Option<[Vec<f64>; 3]>,
    /// Source of the answers to queries.
    #[serde(rename = "render.method", default, skip_serializing_if = "Option::is_none")]
    pub method: Option<Method>,
    /// Milliseconds for the samples of a `two_level` frame.
    #[serde(rename = "render.budget", default, skip_serializing_if = "Option::is_none")]
    pub budget: Option<f64>,
    /// |tau|, in the time unit of the run.
    #[serde(rename = "time.tau", default, skip_serializing_if = "Option::is_none")]
    pub tau: Option<f64>,
    /// From which end of the window particles travel.
    #[serde(rename = "time.direction", default, skip_serializing_if = "Option::is_none")]
    pub direction: Option<Direction>,
    /// True: the window stands still.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub paused: Option<bool>,
}

/// Ramp of the transfer function.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Range {
    /// FTLE (1/time) at which extinction begins.
    pub low: f64,
    /// FTLE (1/time) from which extinction is full.
    pub high: f64,
}

impl Change {
    pub(super) fn is_empty(&self) -> bool {
        *self == Self::default()
    }

    /// Removes what a later change sets.
    fn remove(&mut self, later: &Self) {
        self.camera = self.camera.take().filter(|_| later.camera.is_none());
        self.tolerance = self.tolerance.filter(|_| later.tolerance.is_none());
        self.range = self.range.filter(|_| later.range.is_none());
        self.extinction = self.extinction.filter(|_| later.extinction.is_none());
        self.albedo = self.albedo.take().filter(|_| later.albedo.is_none());
        self.method = self.method.filter(|_| later.method.is_none());
        self.budget = self.budget.filter(|_| later.budget.is_none());
        self.tau = self.tau.filter(|_| later.tau.is_none());
        self.direction = self.direction.filter(|_| later.direction.is_none());
        self.paused = self.paused.filter(|_| later.paused.is_none());
    }
}

/// Most steps of a given length that a command may ask for.
const MAX_STEPS: f64 = 1e6;
const METHODS: &str = "map (two dimensions), reference, surrogate, gated, marched or two_level";

/// A command that took effect.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Command {
    /// Number of the command in this run, from 1.
    pub number: u64,
    /// What it changed, without what a later command changed before the next frame.
    pub set: Change,
}

/// State of a run for those who steer it.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct SteeringState {
    /// Number of accepted commands that changed something.
    pub commands: u64,
    /// Whether the window stands still.
    pub paused: bool,
    /// 2 or 3.
    pub dimensions: usize,
    /// `render.method` of the next frame.
    pub method: Method,
    /// `render.budget` of the next frame, in milliseconds. `None` without one, or if the method has none.
    pub budget: Option<f64>,
    /// |tau| of the next frame, in the time unit of the run.
    pub tau: f64,
    /// Direction of the next frame.
    pub direction: Direction,
    /// Longest |tau| that is accepted: that of the window. `None` for closed forms, which have no window.
    pub longest_tau: Option<f64>,
}

/// The commands to a run. Its memory does not grow with them: a later value replaces an earlier one that has not taken effect.
#[derive(Debug)]
pub struct Steering {
    /// The view at the start, of the box and of the plane of a map.
    homes: [CameraSettings; 2],
    aspect: f64,
    /// Edges of the box, in scene units.
    edges: [f64; 3],
    trust: TrustSettings,
    transfer: TransferSettings,
    /// As the run began.
    render: RenderSettings,
    dimensions: usize,
    longest_tau: Option<f64>,
    /// Of the steps that the scene gives, those in a unit of time; 0 if it gives none.
    steps_per_time: f64,
    /// The network has times as inputs, whose range follows from tau and direction.
    learns_times: bool,
    state: Mutex<State>,
    changed: Condvar,
}

#[derive(Debug)]
struct State {
    commands: u64,
    paused: bool,
    /// In effect once the pending commands are.
    method: Method,
    budget: Option<f64>,
    tau: f64,
    direction: Direction,
    /// The run makes no further frame.
    ended: bool,
    /// For the next frame.
    pending: Vec<Command>,
}

impl State {
    fn new(render: &RenderSettings, tau: f64, direction: Direction) -> Self {
        let (method, budget) = (render.method, render.budget);
        Self { commands: 0, paused: false, method, budget, tau, direction, ended: false, pending: Vec::new() }
    }
}

impl Steering {
    /// For a run of this plan.
    pub fn new(plan: &Plan) -> Self {
        let scene = &plan.scene;
        let Domain { dimensions, .. } = plan.domain;
        let assembled = |method: Method| {
            let mut scene = scene.clone();
            scene.render.method = method;
            assemble(&scene, &plan.domain)
        };
        Self {
            edges: assembled(scene.render.method).edges(&plan.domain),
            homes: [Method::Reference, Method::Map].map(|method| assembled(method).camera),
            aspect: scene.render.aspect(),
            trust: scene.trust.clone(),
            transfer: scene.transfer.clone().unwrap_or_default(),
            dimensions,
            longest_tau: closed_form(&scene.source).is_none().then_some(plan.map.tau),
            steps_per_time: match plan.map.steps {
                Steps::Fixed(steps) => steps as f64 / plan.map.tau,
                _ => 0.0,
            },
            learns_times: scene.render.method.has_surrogate() && !scene.network.inputs.is_empty(),
            state: Mutex::new(State::new(&scene.render, plan.map.tau, plan.map.direction)),
            render: scene.render.clone(),
            changed: Condvar::new(),
        }
    }

    /// Takes a command, which the next frame will show. All of it is accepted, or nothing.
    ///
    /// # Errors
    /// The first key that is unknown or cannot change during a run, or whose value is not accepted.
    pub fn command(&self, set: &Map<String, Value>) -> Result<SteeringState, Refused> {
        let mut state = self.lock();
        let change = self.check(set, state.method)?;
        if state.ended {
            return Err(Refused::new("command", "comes after the last frame", "commands while the run makes frames"));
        }
        if !change.is_empty() {
            state.commands += 1;
            state.paused = change.paused.unwrap_or(state.paused);
            state.method = change.method.unwrap_or(state.method);
            state.budget = change.budget.or(state.budget);
            state.tau = change.tau.unwrap_or(state.tau);
            state.direction = change.direction.unwrap_or(state.direction);
            state.pending.iter_mut().for_each(|earlier| earlier.set.remove(&change));
            state.pending.retain(|earlier| !earlier.set.is_empty());
            let number = state.commands;
            state.pending.push(Command { number, set: change });
            self.changed.notify_all();
        }
        let State { commands, paused, method, budget, tau, direction, .. } = *state;
        let budget = budget.filter(|_| method == Method::TwoLevel);
        let Self { dimensions, longest_tau, .. } = *self;
        Ok(SteeringState { commands, paused, dimensions, method, budget, tau, direction, longest_tau })
    }

    /// What a command changes. `method` is the one that is in effect without it.
    fn check(&self, set: &Map<String, Value>, method: Method) -> Result<Change, Refused> {
        let mut change = Change::default();
        for (key, value) in set {
            match key.as_str() {
                // Below, since it is that of the method.
                "camera" if value.is_null() => {}
                "camera" => {
                    let camera: CameraSettings = read(key, value, "eye, look_at, up, field_of_view and orthographic, as in a scene file")?;
                    Camera::new(&camera, self.aspect).map_err(Refused::from)?;
                    change.camera = Some(camera);
                }
                "trust.tolerance" => {
                    let tolerance = read(key, value, "a number above 0")?;
                    TrustSettings { tolerance, ..self.trust.clone() }.check()?;
                    change.tolerance = Some(tolerance);
                }
                "transfer" => {
                    let range: Range = read(key, value, "low and high, two numbers")?;
                    check_transfer(&TransferSettings { low: Some(range.low), high: Some(range.high), ..self.transfer.clone() })?;
                    change.range = Some(range);
                }
                "transfer.extinction" => {
                    let extinction = read(key, value, "a number from 0 up, per unit of length")?;
                    check_transfer(&TransferSettings { extinction: Some(extinction), ..any_range() })?;
                    check_depth(extinction, self.edges).map_err(Refused::from)?;
                    change.extinction = Some(extinction);
                }
                "transfer.albedo" => {
                    let accepted = format!("{}, or three lists of coefficients", ALBEDO_PRESETS.join(", "));
                    let Albedo(albedo) = read(key, value, &accepted)?;
                    check_transfer(&TransferSettings { albedo: albedo.clone(), ..any_range() })?;
                    change.albedo = Some(albedo);
                }
                "render.method" => {
                    let method = read(key, value, METHODS)?;
                    require(!matches!(method, Method::Auto | Method::Default), key, value, METHODS)?;
                    self.check_method(method)?;
                    change.method = Some(method);
                }
                "render.budget" => change.budget = Some(read(key, value, "milliseconds, 0.1 to 600000")?),
                "paused" => change.paused = Some(read(key, value, "true or false")?),
                "time.tau" => change.tau = Some(self.check_tau(key, value)?),
                "time.direction" => {
                    change.direction = Some(read(key, value, "\"forward\" or \"backward\"")?);
                    self.check_times(key, value)?;
                }
                other => {
                    let accepted = "camera, trust.tolerance, transfer, transfer.extinction, transfer.albedo, render.method, render.budget, \
                        time.tau, time.direction and paused: all else stays as the run began";
                    return Err(Refused::new(other, "cannot change during a run", accepted));
                }
            }
        }
        let [before, after] = [method, change.method.unwrap_or(method)].map(|method| &self.homes[usize::from(method == Method::Map)]);
        // A map in a projection and the box are different places of the scene.
        if set.get("camera").is_some_and(Value::is_null) || (before != after && change.camera.is_none()) {
            change.camera = Some(after.clone());
        }
        if let Some(budget) = change.budget {
            // Of the method that comes with it, if one does.
            let method = change.method.unwrap_or(method);
            let found = format!("is {budget} with render.method = \"{}\"", method.name());
            if method != Method::TwoLevel {
                return Err(Refused::new("render.budget", found, "a budget with render.method = \"two_level\""));
            }
            RenderSettings { method, budget: Some(budget), ..self.render.clone() }.check().map_err(Refused::from)?;
        }
        Ok(change)
    }

    /// A duration that the window holds.
    fn check_tau(&self, key: &str, value: &Value) -> Result<f64, Refused> {
        let accepted = match self.longest_tau {
            Some(longest) => format!("a number above 0, at most {longest}: the window of this run is that long"),
            None => "a number above 0".to_owned(),
        };
        let tau: f64 = read(key, value, &accepted)?;
        require(tau > 0.0 && tau <= self.longest_tau.unwrap_or(f64::MAX), key, tau, &accepted)?;
        let steps = (self.steps_per_time * tau).round();
        if steps > MAX_STEPS {
            let found = format!("is {tau}, which takes {steps:e} steps of the length that flow.steps gives");
            return Err(Refused::new(key, found, format!("a tau of at most {MAX_STEPS:e} steps")));
        }
        self.check_times(key, value)?;
        Ok(tau)
    }

    /// Refuses other times if the network has times as inputs.
    fn check_times(&self, key: &str, value: &Value) -> Result<(), Refused> {
        if self.learns_times {
            let found = format!("is {}, and the network has times as inputs (network.inputs)", shown(value));
            return Err(Refused::new(key, found, "the value that the run began with, and no other"));
        }
        Ok(())
    }

    /// Goes on with an earlier tau and direction, since those of a command could not be taken.
    pub(super) fn keep(&self, tau: f64, direction: Direction) {
        let mut state = self.lock();
        // What waits is in effect next.
        if state.pending.iter().all(|command| command.set.tau.is_none()) {
            state.tau = tau;
        }
        if state.pending.iter().all(|command| command.set.direction.is_none()) {
            state.direction = direction;
        }
    }

    /// The run draws by another method, unless a command asks for one.
    pub(super) fn keep_method(&self, method: Method) {
        let mut state = self.lock();
        if state.pending.iter().all(|command| command.set.method.is_none()) {
            state.method = method;
        }
    }

    /// Refuses a method that this run cannot take.
    fn check_method(&self, method: Method) -> Result<(), Refused> {
        let began = self.render.method;
        if !began.has_surrogate() && method.has_surrogate() {
            let found = format!("is \"{}\", and this run has no surrogate, since it began with \"{}\"", method.name(), began.name());
            let accepted = if self.dimensions == 2 { "\"map\" or \"reference\"" } else { "\"reference\"" };
            return Err(Refused::new("render.method", found, format!("{accepted}; another run may begin with another method")));
        }
        if method == Method::Map && self.dimensions != 2 {
            return Err(Refused::new("render.method", "is \"map\", and the flow has three dimensions", "another method"));
        }
        drawn_by(&self.render, method, None).check().map_err(Refused::from)
    }

    /// The commands since the last call.
    pub(super) fn take(&self) -> Vec<Command> {
        std::mem::take(&mut self.lock().pending)
    }

    /// Refuses what comes from now on, and returns the commands that no frame has shown.
    pub(super) fn end(&self) -> Vec<Command> {
        let mut state = self.lock();
        state.ended = true;
        std::mem::take(&mut state.pending)
    }

    pub(super) fn is_paused(&self) -> bool {
        self.lock().paused
    }

    /// Whether a command waits, or one comes within `limit`.
    pub(super) fn is_pending_within(&self, limit: Duration) -> bool {
        let waited = self.changed.wait_timeout_while(self.lock(), limit, |state| state.pending.is_empty());
        !waited.unwrap_or_else(PoisonError::into_inner).0.pending.is_empty()
    }

    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Settings of the picture with another method: without what only other methods have.
pub(super) fn drawn_by(render: &RenderSettings, method: Method, budget: Option<f64>) -> RenderSettings {
    let (budget, until) = (budget.filter(|_| method == Method::TwoLevel), render.until.filter(|_| method.accumulates()));
    RenderSettings { method, budget, until, ..render.clone() }
}

/// A transfer function for what does not depend on its range.
fn any_range() -> TransferSettings {
    TransferSettings { low: Some(0.0), high: Some(1.0), ..TransferSettings::default() }
}

fn check_transfer(settings: &TransferSettings) -> Result<(), Refused> {
    Transfer::new(settings, 1.0).map(|_| ()).map_err(Refused::from)
}

/// Reads a value; a fault names the key inside it.
fn read<'a, T: Deserialize<'a>>(key: &str, value: &'a Value, accepted: &str) -> Result<T, Refused> {
    serde_path_to_error::deserialize(value).map_err(|error| {
        let inner = error.path().to_string();
        let key = if inner == "." { key.to_owned() } else { format!("{key}.{inner}") };
        let found =
            if inner == "." && !value.is_object() { format!("is {}", shown(value)) } else { format!("cannot be read ({})", error.inner()) };
        Refused::new(key, found, accepted)
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    fn steering() -> Steering {
        steering_of(&RenderSettings { method: Method::TwoLevel, ..RenderSettings::default() })
    }

    fn home(z: f64) -> CameraSettings {
        CameraSettings { eye: [0.0, 0.0, z], look_at: [0.0; 3], up: [0.0, 1.0, 0.0], field_of_view: 90.0, orthographic: true }
    }

    fn steering_of(render: &RenderSettings) -> Steering {
        Steering {
            homes: [home(2.0), home(2.0)],
            aspect: 2.0,
            edges: [2.0, 1.0, 0.2],
            trust: TrustSettings::default(),
            transfer: TransferSettings::default(),
            render: render.clone(),
            dimensions: 2,
            longest_tau: Some(10.0),
            steps_per_time: 2.0,
            learns_times: false,
            state: Mutex::new(State::new(render, 10.0, Direction::Forward)),
            changed: Condvar::new(),
        }
    }

    fn command(steering: &Steering, set: Value) -> Result<SteeringState, String> {
        steering.command(set.as_object().unwrap()).map_err(|refused| refused.to_string())
    }

    #[test]
    fn what_is_refused_is_named_and_changes_nothing() {
        let steering = steering();
        let eye = json!([0.0, 0.0, 1.0]);
        let camera = |key: &str, value: Value| {
            let mut camera = json!({"eye": eye, "look_at": [0, 0, 0], "up": [0, 1, 0]});
            camera[key] = value;
            json!({ "camera": camera })
        };
        for (set, hint) in [
            (camera("up", json!([0, 0, 1])), "`camera.up` is [0.0, 0.0, 1.0]; accepted: a vector that is not parallel"),
            (camera("look_at", eye.clone()), "`camera.look_at` is [0.0, 0.0, 1.0]; accepted: a point other than"),
            (camera("field_of_view", json!(180)), "`camera.field_of_view` is 180.0; accepted: degrees above 0"),
            (camera("eye", json!([0, 0])), "`camera.eye"),
            (camera("eye", json!("left")), "`camera.eye` cannot be read (invalid type: string \"left\""),
            (camera("zoom", json!(2)), "`camera.zoom` cannot be read (unknown field `zoom`"),
            (json!({"camera": {}}), "`camera` cannot be read (missing field `eye`)"),
            (json!({"camera": 3}), "`camera` is 3; accepted: eye, look_at"),
            (json!({"trust.tolerance": 0}), "`trust.tolerance` is 0.0; accepted: a number above 0"),
            (json!({"trust.tolerance": "low"}), "`trust.tolerance` is \"low\"; accepted: a number above 0"),
            (json!({"transfer": {"low": 2, "high": 1}}), "`transfer.high` is 1.0"),
            (json!({"transfer": {"low": 2}}), "`transfer` cannot be read (missing field `high`)"),
            (json!({"transfer.extinction": -1}), "`transfer.extinction` is -1.0; accepted:"),
            (json!({"transfer.extinction": 1e5}), "`transfer.extinction` is 100000.0; accepted: at most an optical depth of 100000 over"),
            (json!({"transfer.extinction": "thick"}), "`transfer.extinction` is \"thick\"; accepted: a number from 0 up"),
            (
                json!({"transfer.albedo": "rainbow"}),
                "`transfer.albedo` is \"rainbow\"; accepted: published, grey, ember, deep, or three lists",
            ),
            (json!({"transfer.albedo": [[2.0], [0.0], [0.0]]}), "`transfer.albedo`"),
            (json!({"paused": 1}), "`paused` is 1; accepted: true or false"),
            (json!({"time.direction": "sideways"}), "`time.direction` is \"sideways\"; accepted: \"forward\" or \"backward\""),
            (json!({"time.tau": 10.5}), "`time.tau` is 10.5; accepted: a number above 0, at most 10: the window"),
            (json!({"time.tau": 0}), "`time.tau` is 0.0; accepted: a number above 0"),
            (json!({"time.tau": "1 day"}), "`time.tau` is \"1 day\"; accepted: a number above 0"),
            (json!({"render.width": 64}), "`render.width` cannot change during a run; accepted: camera"),
            (
                json!({"render.method": "auto"}),
                "`render.method` is \"auto\"; accepted: map (two dimensions), reference, surrogate, gated, marched or two_level",
            ),
            (json!({"render.method": "exact"}), "`render.method` is \"exact\"; accepted: map (two dimensions), reference, surrogate"),
            (json!({"render.budget": 0.01}), "`render.budget` is 0.01; accepted: milliseconds, 0.1 to 600000"),
            (json!({"render.budget": "fast"}), "`render.budget` is \"fast\"; accepted: milliseconds"),
            (
                json!({"render.budget": 50, "render.method": "gated"}),
                "`render.budget` is 50 with render.method = \"gated\"; accepted: a budget",
            ),
            // One of two keys is wrong.
            (json!({"paused": true, "trust.tolerance": -1}), "`trust.tolerance` is -1.0"),
        ] {
            let error = command(&steering, set).unwrap_err();
            assert!(error.starts_with(hint), "{error}\n{hint}");
        }
        assert!(steering.take().is_empty() && !steering.is_paused());
        let (method, direction, longest_tau) = (Method::TwoLevel, Direction::Forward, Some(10.0));
        let state = SteeringState { commands: 0, paused: false, dimensions: 2, method, budget: None, tau: 10.0, direction, longest_tau };
        assert_eq!(command(&steering, json!({})), Ok(state));
        let direction = Direction::Backward;
        let set = json!({"time.direction": "backward", "time.tau": 2.5});
        assert_eq!(command(&steering, set), Ok(SteeringState { commands: 1, tau: 2.5, direction, ..state }));
    }

    #[test]
    fn a_closed_form_takes_a_tau_of_so_many_steps() {
        let steering = Steering { longest_tau: None, ..steering() };
        assert_eq!(command(&steering, json!({"time.tau": 5e5})).unwrap().tau, 5e5);
        let error = command(&steering, json!({"time.tau": 1e300})).unwrap_err();
        assert!(error.contains("takes 2e300 steps of the length that flow.steps gives; accepted: a tau of at most 1e6 steps"), "{error}");
    }

    #[test]
    fn a_network_of_times_keeps_its_times() {
        let steering = Steering { learns_times: true, ..steering() };
        for set in [json!({"time.tau": 5}), json!({"time.direction": "backward"})] {
            let error = command(&steering, set).unwrap_err();
            assert!(error.contains("and the network has times as inputs (network.inputs)"), "{error}");
        }
    }

    #[test]
    fn a_method_needs_what_the_run_has() {
        let traced = steering_of(&RenderSettings { method: Method::Reference, ..RenderSettings::default() });
        for method in ["surrogate", "gated", "marched", "two_level"] {
            let error = command(&traced, json!({ "render.method": method })).unwrap_err();
            let hint = format!("`render.method` is \"{method}\", and this run has no surrogate, since it began with \"reference\"");
            assert!(error.starts_with(&hint), "{error}");
        }
        assert_eq!(command(&traced, json!({"render.method": "reference"})).unwrap().commands, 1);
        assert_eq!(command(&traced, json!({"render.method": "map"})).unwrap().method, Method::Map);
        let mut map = steering_of(&RenderSettings { method: Method::Map, ..RenderSettings::default() });
        let error = command(&map, json!({"render.method": "gated"})).unwrap_err();
        assert!(
            error.ends_with("since it began with \"map\"; accepted: \"map\" or \"reference\"; another run may begin with another method"),
            "{error}"
        );
        assert!(command(&map, json!({"render.budget": 20})).unwrap_err().contains("with render.method = \"map\""));
        map.dimensions = 3;
        assert!(command(&map, json!({"render.method": "map"})).unwrap_err().contains("and the flow has three dimensions"));
        // A share of a sample is something for smooth pictures only; their target is left out.
        let (method, until) = (Method::TwoLevel, Some("40dB".to_owned().try_into().unwrap()));
        let render = RenderSettings { method, samples: 0.5, until, ..RenderSettings::default() };
        let error = command(&steering_of(&render), json!({"render.method": "gated"})).unwrap_err();
        assert!(error.contains("`render.samples` is 0.5; accepted: a whole number"), "{error}");
        let smooth = steering_of(&RenderSettings { samples: 2.0, budget: Some(40.0), ..render });
        let state = |set| command(&smooth, set).map(|state| (state.method, state.budget));
        assert_eq!(state(json!({})), Ok((Method::TwoLevel, Some(40.0))));
        assert_eq!(state(json!({"render.method": "gated"})), Ok((Method::Gated, None)));
        assert!(state(json!({"render.budget": 20})).unwrap_err().contains("is 20 with render.method = \"gated\""));
        assert_eq!(state(json!({"render.method": "two_level"})), Ok((Method::TwoLevel, Some(40.0))));
        assert_eq!(state(json!({"render.method": "two_level", "render.budget": 20.5})), Ok((Method::TwoLevel, Some(20.5))));
        let taken = serde_json::to_value(smooth.take()).unwrap();
        assert_eq!(taken, json!([{"number": 3, "set": {"render.method": "two_level", "render.budget": 20.5}}]));
    }

    #[test]
    fn a_method_in_another_plane_begins_with_its_own_view() {
        let mut steering = steering_of(&RenderSettings { method: Method::TwoLevel, ..RenderSettings::default() });
        let camera = |steering: &Steering, set| {
            command(steering, set).unwrap();
            steering.take().pop().and_then(|command| command.set.camera)
        };
        assert_eq!(camera(&steering, json!({"render.method": "map"})), None, "the same plane");
        steering.homes[1] = home(3.0);
        assert_eq!(camera(&steering, json!({"render.method": "two_level"})), Some(home(2.0)));
        assert_eq!(camera(&steering, json!({"render.method": "gated", "paused": false})), None);
        assert_eq!(camera(&steering, json!({"render.method": "map", "camera": home(5.0)})), Some(home(5.0)));
        assert_eq!(camera(&steering, json!({"camera": null})), Some(home(3.0)), "of the method in effect");
        assert_eq!(camera(&steering, json!({"camera": null, "render.method": "gated"})), Some(home(2.0)));
        assert_eq!(camera(&steering, json!({"render.method": "map"})), Some(home(3.0)));
        assert_eq!(camera(&steering, json!({"trust.tolerance": 0.1})), None);
    }

    #[test]
    fn a_later_value_replaces_one_that_has_not_taken_effect() {
        let steering = steering();
        for n in 1..=1000 {
            let set = json!({"trust.tolerance": f64::from(n), "paused": n == 1000});
            assert_eq!(command(&steering, set).unwrap().commands, n as u64);
        }
        command(&steering, json!({"camera": null, "paused": false})).unwrap();
        assert!(steering.is_pending_within(Duration::ZERO) && !steering.is_paused());
        let taken = steering.take();
        assert_eq!(serde_json::to_value(&taken[0]).unwrap(), json!({"number": 1000, "set": {"trust.tolerance": 1000.0}}));
        assert_eq!((taken.len(), taken[1].number, &taken[1].set.camera, taken[1].set.paused), (2, 1001, &Some(home(2.0)), Some(false)));
        assert!(!steering.is_pending_within(Duration::from_millis(1)));
        command(&steering, json!({"paused": true})).unwrap();
        assert_eq!(steering.end().len(), 1, "no frame has shown it");
        assert!(command(&steering, json!({"paused": true})).unwrap_err().contains("comes after the last frame"));
    }
}
