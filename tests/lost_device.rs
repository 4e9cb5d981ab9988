//! A GPU that fails at any of the calls that are made of it, with a fault or by refusing what it took before: on machines without one, a device that computes on the
//! CPU and breaks when it is told to stands for it. (`tests/gpu/lost.rs` breaks a real one.)

#![cfg(feature = "cuda")]
#![allow(clippy::unwrap_used)]

use ridgewatch::config::SceneFile;
use ridgewatch::engine::cuda::{CudaTracerError, DeviceError};
use ridgewatch::engine::{
    Accelerator, Answers, AuditFindings, AuditRequest, Backed, Device, DeviceNodes, DeviceRenderer, DeviceTrace, EngineError, Event,
    FrameRecord, Health, RunOptions, Setup, StageSeconds, Tally, WhenLost, audit, run,
};
use ridgewatch::field::{Domain, Snapshot};
use ridgewatch::flow::{Extras, FlowMap, Traced, Tracer, VelocitySource, cpu_tracer};
use ridgewatch::render::{Film, LogStretch, RenderStats, Renderer};
use ridgewatch::surrogate::{Predict, Samples, Table};
use std::collections::BTreeSet;
use std::path::Path;
use std::sync::atomic::AtomicBool;
use std::sync::{Arc, Mutex, OnceLock};

/// The way to the device, which breaks at one of the calls and stays broken.
#[derive(Debug)]
struct Line {
    /// What was asked for, call by call.
    calls: Mutex<Vec<&'static str>>,
    breaks_at: usize,
    how: How,
    broke_in: OnceLock<&'static str>,
}

#[derive(Debug, Clone, Copy, PartialEq)]
enum How {
    /// A driver call fails.
    Fault,
    /// There is no memory left.
    Refusal,
}

impl Line {
    fn call(&self, what: &'static str) -> Result<(), DeviceError> {
        let mut calls = self.calls.lock().unwrap();
        calls.push(what);
        if calls.len() <= self.breaks_at {
            return Ok(());
        }
        self.broke_in.get_or_init(|| what);
        Err(match self.how {
            How::Fault => DeviceError::Driver { doing: what, reason: "broken by the test".into() },
            How::Refusal => {
                DeviceError::OutOfMemory { what: what.into(), needed: 1 << 20, used: 0, cap: 0, cap_from: "broken by the test" }
            }
        })
    }
}

#[derive(Debug)]
struct Breaking {
    line: Arc<Line>,
    health: Arc<Health>,
}

const NAME: &str = "a device that breaks";

impl Breaking {
    fn new(breaks_at: usize, how: How, when_lost: WhenLost) -> Arc<Self> {
        let line = Line { calls: Mutex::default(), breaks_at, how, broke_in: OnceLock::new() };
        Arc::new(Self { line: Arc::new(line), health: Arc::new(Health::new(when_lost)) })
    }
}

impl Accelerator for Breaking {
    fn name(&self) -> String {
        NAME.into()
    }
    fn health(&self) -> &Arc<Health> {
        &self.health
    }
    fn tracer(&self, source: VelocitySource, map: &FlowMap, t0: f64) -> Result<Box<dyn Tracer>, CudaTracerError> {
        let host = || cpu_tracer(source.clone(), map, t0);
        let trace = Trace { line: self.line.clone(), host: host()? };
        self.line.call("making a tracer")?;
        Ok(Box::new(Backed::with(trace, host()?, self.health.clone())))
    }
    fn renderer(&self) -> Result<Box<dyn DeviceRenderer>, DeviceError> {
        self.line.call("making a renderer")?;
        Ok(Box::new(Render { line: self.line.clone() }))
    }
    fn expect(&self, _: &Arc<Snapshot>) {
        if let Err(error) = self.line.call("bringing a snapshot over") {
            self.health.fail(error);
        }
    }
}

struct Trace {
    line: Arc<Line>,
    host: Box<dyn Tracer>,
}

impl DeviceTrace for Trace {
    fn double(&self) -> bool {
        false
    }
    fn trace_nodes(&self, _: &Domain, nodes: [usize; 3]) -> Result<Option<Box<dyn DeviceNodes>>, DeviceError> {
        self.line.call("tracing a table")?;
        Ok(Some(Box::new(Nodes { line: self.line.clone(), table: Table::trace(&*self.host, nodes) })))
    }
    fn trace(&self, seeds: &[[f32; 3]], extras: Extras, out: &mut Traced) -> Result<(), DeviceError> {
        self.line.call("starting a trace")?;
        // What a device leaves behind that stops half way.
        out.log_stretch.iter_mut().step_by(2).for_each(|s| *s = 7e7);
        out.lived.iter_mut().step_by(3).for_each(|s| *s = -1.0);
        self.line.call("reading a trace back")?;
        self.host.trace(seeds, extras, out);
        Ok(())
    }
}

/// A table that nobody reaches once the device is broken.
#[derive(Debug)]
struct Nodes {
    line: Arc<Line>,
    table: Table,
}

impl DeviceNodes for Nodes {
    fn not_finite(&self) -> usize {
        self.table.not_finite()
    }
    fn values(&self) -> Result<Vec<f32>, DeviceError> {
        self.line.call("reading a table back")?;
        Ok(self.table.values().to_vec())
    }
    fn interpolate(&self, points: &[[f32; 3]], out: &mut [f32]) -> Result<(), DeviceError> {
        out.iter_mut().step_by(2).for_each(|s| *s = 7e7);
        self.line.call("looking up in a table")?;
        self.table.predict(points, out);
        Ok(())
    }
    fn as_any(&self) -> &dyn std::any::Any {
        self
    }
}

struct Render {
    line: Arc<Line>,
}

struct ByHost<'a>(&'a dyn Tracer);

impl LogStretch for ByHost<'_> {
    fn evaluate(&mut self, points: &[[f32; 3]], log_stretch: &mut [f32], traced: &mut [bool]) {
        let mut out = Traced::default();
        self.0.trace(points, Extras::default(), &mut out);
        log_stretch.copy_from_slice(&out.log_stretch);
        traced.fill(true);
    }
}

impl DeviceRenderer for Render {
    fn audit(
        &mut self,
        request: &AuditRequest<'_>,
        tracer: &dyn Tracer,
        surrogate: &dyn Predict,
    ) -> Result<Option<AuditFindings>, DeviceError> {
        self.line.call("an audit")?;
        let traces = tracer.as_any().unwrap().downcast_ref::<Backed<Trace>>().unwrap();
        let table = surrogate.as_any().unwrap().downcast_ref::<Table>().unwrap();
        let nodes = table.on_device().unwrap().as_any().downcast_ref::<Nodes>().unwrap();
        Ok(Some(audit(request.clone(), &*traces.on_device().host, Some(&nodes.table))))
    }

    fn render(
        &mut self,
        renderer: &mut Renderer,
        picture: u64,
        samples: usize,
        tracer: &dyn Tracer,
        answers: &mut Answers<'_>,
        progress: Option<&dyn Fn(f32)>,
        stop: &AtomicBool,
    ) -> Result<Option<(Film, RenderStats)>, EngineError> {
        let asked = answers.asked();
        if asked.surrogate.is_some() || asked.keep > 1 {
            return Ok(None);
        }
        renderer.set_up(picture, 0..samples as u32)?;
        for wave in 0..3_u8 {
            self.line.call("a wave of a frame")?;
            if let Some(progress) = progress {
                progress(f32::from(wave) / 3.0);
            }
        }
        self.line.call("reading a film back")?;
        let traces = tracer.as_any().unwrap().downcast_ref::<Backed<Trace>>().unwrap();
        let (film, stats) = renderer.render(picture, &mut ByHost(&*traces.on_device().host), samples, progress, stop)?;
        let tally = Tally {
            queries: stats.queries,
            traced: stats.traced,
            missing: stats.missing,
            trace_seconds: stats.evaluate_seconds,
            ..Tally::default()
        };
        answers.answered_elsewhere(tally, Samples::default());
        Ok(Some((film, stats)))
    }
}

/// A run's frames: records without what differs from run to run, and the films' bits.
#[derive(Default)]
struct Made {
    records: Vec<FrameRecord>,
    films: Vec<Vec<u32>>,
    error: Option<EngineError>,
}

fn made(scene: &SceneFile, device: Device) -> Made {
    let options = RunOptions { device, threads: 2, ..RunOptions::default() };
    let mut made = Made::default();
    let mut sink = |event: Event| {
        if let Event::Frame(frame) = event {
            let film = &frame.film;
            let rgba = film.rgba.iter().flatten();
            let rest = [&film.ftle_mean, &film.traced, &film.variance, &film.samples, &film.missing, &film.queries];
            made.films.push(rgba.chain(rest.into_iter().flatten()).map(|v| v.to_bits()).collect());
            made.records.push((*frame.record).clone());
        }
    };
    made.error = run(Setup::new(scene.settings()).unwrap(), &options, &mut sink, &AtomicBool::new(false)).err();
    made
}

fn on(device: &Arc<Breaking>, scene: &SceneFile) -> Made {
    made(scene, Device::Gpu { gpu: device.clone(), may_fall_back: false })
}

/// What a record says of the work, whoever did it.
fn figures(record: &FrameRecord) -> FrameRecord {
    FrameRecord { device: String::new(), warnings: Vec::new(), seconds: StageSeconds::default(), ..record.clone() }
}

fn has_ended(record: &FrameRecord) -> usize {
    record.warnings.iter().filter(|w| w.contains("work on the GPU has ended") && w.contains("broken by the test")).count()
}

/// Breaks the device at every call of a run in turn.
fn break_everywhere(scene: &SceneFile, kinds: &[&str]) {
    let expected = made(scene, Device::CPU);
    assert!(expected.error.is_none() && expected.records.len() >= 4);
    for how in [How::Fault, How::Refusal] {
        break_at_every_call(scene, &expected, how, kinds);
    }
}

fn break_at_every_call(scene: &SceneFile, expected: &Made, how: How, kinds: &[&str]) {
    let whole = Breaking::new(usize::MAX, how, WhenLost::Cpu);
    let unbroken = on(&whole, scene);
    assert!(unbroken.error.is_none() && unbroken.films == expected.films);
    assert!(unbroken.records.iter().all(|r| r.device == NAME && has_ended(r) == 0));
    let asked = whole.line.calls.lock().unwrap().clone();
    let calls = asked.len();
    // Of every kind of call some, from the first to the last: a few dozen runs instead of thousands.
    let chosen = || kinds.iter().flat_map(|kind| some(&asked, kind));

    let mut broke_in = BTreeSet::new();
    for breaks_at in chosen() {
        let device = Breaking::new(breaks_at, how, WhenLost::Cpu);
        let found = on(&device, scene);
        // How often a trace is cut up depends on the machine's speed: the last calls may not come.
        let Some(what) = device.line.broke_in.get() else { continue };
        broke_in.insert(*what);
        let case = format!("{how:?} at call {breaks_at} of {calls}, {what}");
        if how == How::Refusal && *what == "making a tracer" && found.films.is_empty() {
            // What a device that was asked for by name refuses from the start is an error of the request.
            assert!(matches!(found.error, Some(EngineError::Device(_))), "{case}: {:?}", found.error);
            continue;
        }
        assert!(found.error.is_none(), "{case}: {:?}", found.error);
        assert!(found.films == expected.films, "{case}: the films are the CPU's");
        for (found, expected) in found.records.iter().zip(&expected.records) {
            assert_eq!(figures(found), figures(expected), "{case}: nothing is counted twice or not at all");
        }
        let told: Vec<usize> = (0..found.records.len()).filter(|&i| has_ended(&found.records[i]) > 0).collect();
        assert!(found.records.iter().map(has_ended).sum::<usize>() <= 1, "{case}: told once");
        for (i, record) in found.records.iter().enumerate() {
            match told.first() {
                Some(&told) if i > told => assert_eq!(record.device, "cpu", "{case}, frame {i}"),
                Some(&told) if i == told => {}
                _ => assert_eq!(record.device, NAME, "{case}, frame {i}"),
            }
        }
    }
    assert_eq!(broke_in, kinds.iter().copied().collect(), "kinds of calls that broke");

    if how == How::Refusal {
        return;
    }
    let mut ended = 0;
    for breaks_at in chosen() {
        let device = Breaking::new(breaks_at, how, WhenLost::Stop);
        let found = on(&device, scene);
        let Some(what) = device.line.broke_in.get() else { continue };
        let case = format!("{how:?} at call {breaks_at} of {calls}, {what}");
        match &found.error {
            Some(EngineError::Device(error)) => {
                assert!(error.to_string().contains("broken by the test"), "{case}: {error}");
                assert!(found.films.len() < expected.films.len(), "{case}");
                ended += 1;
            }
            Some(other) => panic!("{case}: {other}"),
            // Snapshots come over beside everything else, the end of the run included.
            None => assert!(*what == "bringing a snapshot over" && found.films.len() == expected.films.len(), "{case}"),
        }
        assert!(expected.films.starts_with(&found.films), "{case}: the frames before are whole, the broken one is not given");
        assert!(found.records.iter().all(|r| r.device == NAME && has_ended(r) == 0), "{case}");
    }
    assert!(ended > 0);
}

/// Places of up to a dozen calls of a kind, evenly spread.
fn some(asked: &[&str], kind: &str) -> Vec<usize> {
    const MOST: usize = 12;
    let places: Vec<usize> = (0..asked.len()).filter(|&i| asked[i] == kind).collect();
    let count = places.len().min(MOST);
    (0..count).map(|i| places[i * (places.len() - 1) / (count - 1).max(1)]).collect()
}

#[test]
fn reference_frames_of_a_closed_form() {
    let scene = SceneFile::parse(
        Path::new("scene.toml"),
        "
[source]
kind = \"double_gyre\"
[domain]
min = [0, 0, 0]
max = [2, 1, 0.2]
[time]
tau = 5
step = 0.1
slides = 2
frames_per_slide = 2
[flow]
steps = 10
[trust]
cells = [4, 2, 1]
[render]
method = \"reference\"
width = 16
height = 8
samples = 2
",
        &[],
    )
    .unwrap();
    let kinds =
        ["making a tracer", "making a renderer", "starting a trace", "reading a trace back", "a wave of a frame", "reading a film back"];
    break_everywhere(&scene, &kinds);
}

#[test]
fn gated_frames_with_a_table_over_a_sliding_window() {
    let scene = SceneFile::parse(
        Path::new("scene.toml"),
        "
[source]
kind = \"turbulence\"
nodes = [16, 8, 8]
snapshots = 9
[time]
tau = 4
[flow]
steps = 8
[surrogate]
kind = \"table\"
[trust]
cells = [2, 2, 2]
[render]
width = 16
height = 8
samples = 2
",
        &[],
    )
    .unwrap();
    break_everywhere(
        &scene,
        &[
            "making a tracer",
            "making a renderer",
            "tracing a table",
            "looking up in a table",
            "starting a trace",
            "reading a trace back",
            "an audit",
            "bringing a snapshot over",
        ],
    );
}
