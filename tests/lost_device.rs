//! A GPU that fails at any of the calls that are made of it, with a fault or by refusing what it took before: on machines without one, a device that computes on the
//! CPU and breaks when it is told to stands for it. (`tests/gpu/lost.rs` breaks a real one.)

#![cfg(feature = "cuda")]
#![allow(clippy::unwrap_used)]

use burn::backend::Flex;
use burn::module::{Param, ParamId};
use burn::tensor::{Tensor, TensorData};
use ridgewatch::config::SceneFile;
use ridgewatch::engine::cuda::{CudaTracerError, DeviceError};
use ridgewatch::engine::{
    Accelerator, Answers, AuditFindings, AuditRequest, Backed, Device, DeviceNodes, DeviceRenderer, DeviceTrace, EngineError, Event,
    FrameRecord, Health, RunOptions, Setup, StageSeconds, Tally, WhenLost, audit, run,
};
use ridgewatch::field::analytic::Analytic;
use ridgewatch::field::{Domain, Snapshot};
use ridgewatch::flow::{
    Boundary, Direction, Extras, FlowMap, Integrator, Interpolation, Normalisation, Precision, Steps, Traced, Tracer, VelocitySource,
    cpu_tracer,
};
use ridgewatch::render::{Film, LogStretch, RenderStats, Renderer};
use ridgewatch::surrogate::network::{Architecture, Average, Field, Fused, Model, Objective, PlannedStep, Step};
use ridgewatch::surrogate::{
    Brought, DeviceLost, Learned, Offload, OffloadedNetwork, OffloadedTraining, Predict, RingMark, SampleRing, Samples, Table,
};
use std::collections::BTreeSet;
use std::ops::Range;
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
    fn offload(&self) -> Option<Arc<dyn Offload>> {
        Some(Arc::new(Training { line: self.line.clone(), health: self.health.clone() }))
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

/// Trains with the CPU's kernels, on its own copy of network and samples.
struct Training {
    line: Arc<Line>,
    health: Arc<Health>,
}

impl Training {
    fn call(&self, what: &'static str) -> Result<(), DeviceLost> {
        self.health.ask(|| self.line.call(what)).ok_or(DeviceLost)
    }
}

impl Offload for Training {
    fn takes(&self, _: &Architecture, _: &Objective) -> bool {
        true
    }
    fn training(&self, model: &Model, objective: &Objective, average: &Average) -> Option<Box<dyn OffloadedTraining>> {
        self.call("taking a network over").ok()?;
        Some(Box::new(Network {
            there: Training { line: self.line.clone(), health: self.health.clone() },
            fused: Fused::new(model, objective, BATCH),
            model: model.clone(),
            objective: objective.clone(),
            average: average.clone(),
            samples: Samples::default(),
            mark: None,
            base: None,
            kept: None,
        }))
    }
}

/// Of the scene below.
const BATCH: usize = 512;
const STEPS: u64 = 20;

struct Network {
    there: Training,
    fused: Fused,
    model: Model,
    objective: Objective,
    average: Average,
    samples: Samples,
    mark: Option<RingMark>,
    base: Option<Table>,
    kept: Option<(Model, Average)>,
}

impl OffloadedTraining for Network {
    fn bring(&mut self, ring: &SampleRing, base: Option<&Table>) -> Result<Brought, DeviceLost> {
        self.there.call("bringing samples over")?;
        self.samples.points.resize(ring.len(), [f32::NAN; 3]);
        self.samples.log_stretch.resize(ring.len(), f32::NAN);
        for range in ring.written_since(self.mark) {
            self.samples.points[range.clone()].copy_from_slice(&ring.samples().points[range.clone()]);
            self.samples.log_stretch[range.clone()].copy_from_slice(&ring.samples().log_stretch[range]);
        }
        (self.mark, self.base) = (Some(ring.mark()), base.cloned());
        let usable = self.objective.sieve(&self.samples).map_or(self.samples.len(), |usable| usable.len());
        Ok(Brought { usable, dropped: self.samples.len() - usable })
    }
    fn steps(&mut self, steps: &[PlannedStep]) -> Result<Vec<f64>, DeviceLost> {
        self.there.call("taking steps")?;
        let Self { fused, model, objective, average, samples, base, .. } = self;
        let (among, base) = (objective.sieve(samples), base.as_ref().map(|base| base as &dyn Field));
        let mut losses = Vec::new();
        fused.steps(model, objective, average, |done, loss| {
            losses.extend(loss);
            steps.get(done as usize).map(|step| Step::of(step, samples, among.as_deref(), base))
        });
        Ok(losses)
    }
    fn keep(&mut self) -> Result<(), DeviceLost> {
        self.there.call("keeping a network")?;
        self.kept = Some((self.model.clone(), self.average.clone()));
        Ok(())
    }
    fn roll_back(&mut self) -> Result<(), DeviceLost> {
        (self.model, self.average) = self.kept.clone().unwrap();
        Ok(())
    }
    fn restart_average(&mut self) -> Result<(), DeviceLost> {
        self.average = Average { tables: self.model.tables(), layers: self.model.layers() };
        Ok(())
    }
    fn zero_layers(&mut self, range: Range<usize>) -> Result<(), DeviceLost> {
        self.there.call("forgetting an output")?;
        self.model.zero_output();
        self.average.layers[range].fill(0.0);
        Ok(())
    }
    fn frozen(&self) -> Result<Arc<dyn OffloadedNetwork>, DeviceLost> {
        self.there.call("freezing a network")?;
        let (mut model, average) = (self.model.clone(), &self.average);
        let tensor = |values: &Vec<f32>, shape: Vec<usize>| TensorData::new(values.clone(), shape);
        let tables = vec![model.shape.table_entries(), model.shape.features];
        model.module.tables =
            Some(Param::initialized(ParamId::new(), Tensor::from_data(tensor(&average.tables, tables), &Default::default())));
        let layers = tensor(&average.layers, vec![average.layers.len()]);
        model.module.layers = Param::initialized(ParamId::new(), Tensor::from_data(layers, &Default::default()));
        let there = Training { line: self.there.line.clone(), health: self.there.health.clone() };
        Ok(Arc::new(Frozen { there, model, objective: self.objective.clone() }))
    }
    fn fetch(&self, model: &mut Model, average: &mut Average) -> Result<(), DeviceLost> {
        self.there.call("fetching a network")?;
        (*model, *average) = (self.model.clone(), self.average.clone());
        Ok(())
    }
    fn device_seconds(&mut self) -> f64 {
        0.0
    }
}

struct Frozen {
    there: Training,
    model: Model,
    objective: Objective,
}

impl OffloadedNetwork for Frozen {
    fn predict(&self, points: &[[f32; 3]], out: &mut [f32]) -> Result<(), DeviceLost> {
        out.iter_mut().step_by(2).for_each(|s| *s = 7e7);
        self.there.call("asking a network")?;
        let (shape, scale) = (Arc::new(self.model.shape.clone()), &self.objective.scale);
        let flat: Vec<f32> = points.iter().flatten().copied().collect();
        let points = Tensor::<Flex, 2>::from_data(TensorData::new(flat, [points.len(), 3]), &Default::default());
        let outputs = self.model.module.forward_fused(&shape, points).into_data().to_vec::<f32>().unwrap();
        out.iter_mut().zip(outputs).for_each(|(out, output)| *out = output * scale.deviation[0] + scale.mean[0]);
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
        let Some(table) = surrogate.as_any().and_then(|any| any.downcast_ref::<Table>()) else { return Ok(None) };
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
    made_with(scene, RunOptions { device, threads: 2, ..RunOptions::default() })
}

fn made_with(scene: &SceneFile, options: RunOptions) -> Made {
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
    let training = record.training.clone().map(|learned| Learned { seconds: 0.0, device_seconds: None, ..learned });
    FrameRecord { device: String::new(), warnings: Vec::new(), seconds: StageSeconds::default(), training, ..record.clone() }
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

/// What `--device auto` may do without from the start, and not once it was taken up.
#[test]
fn a_device_chosen_by_itself_may_refuse_its_first_work_alone() {
    let flow = Analytic::Saddle { rate: 1.0 };
    let source = VelocitySource::Analytic(flow, Domain::slab([-1.0; 2], [1.0; 2], (0.0, 1.0)));
    let map = FlowMap {
        tau: 1.0,
        direction: Direction::Forward,
        integrator: Integrator::Tangent,
        precision: Precision::F32,
        steps: Steps::Fixed(8),
        gap: 1e-3,
        boundary: Boundary::Unbounded,
        normalisation: Normalisation::Tau,
        interpolation: Interpolation::Linear,
    };
    let tracer = |device: &Device| device.tracer(source.clone(), &map, 0.0).map(|(_, told)| told);
    let device = |breaks_at| Device::Gpu { gpu: Breaking::new(breaks_at, How::Refusal, WhenLost::Stop), may_fall_back: true };

    let refusing = device(0);
    for _ in 0..2 {
        let told = tracer(&refusing).unwrap().unwrap();
        assert!(told.contains("on the CPU") && told.contains("broken by the test"), "{told}");
    }
    let taken_up = device(1);
    assert_eq!(tracer(&taken_up).unwrap(), None);
    assert!(matches!(tracer(&taken_up), Err(EngineError::Device(_))));
}

/// A network that a device trains: as long as it works all is as on the CPU; once it is lost, the CPU goes on from what came back last.
#[test]
fn training_of_a_residual_over_a_sliding_window() {
    let scene = SceneFile::parse(
        Path::new("scene.toml"),
        &format!(
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
kind = \"residual\"
[network]
levels = 4
log2_table = 8
width = 16
batch = {BATCH}
[training]
steps_per_frame = {STEPS}
[trust]
cells = [2, 2, 2]
[render]
width = 16
height = 8
samples = 2
"
        ),
        &[],
    )
    .unwrap();
    let expected = made(&scene, Device::CPU);
    let folder = tempfile::tempdir().unwrap();
    let run = |device: &Arc<Breaking>| {
        let device = Device::Gpu { gpu: device.clone(), may_fall_back: false };
        let options = RunOptions { device, threads: 2, checkpoint: Some(folder.path().join("checkpoint")), ..RunOptions::default() };
        made_with(&scene, options)
    };
    let whole = Breaking::new(usize::MAX, How::Fault, WhenLost::Cpu);
    let unbroken = run(&whole);
    assert!(unbroken.error.is_none() && unbroken.films == expected.films && expected.films.len() >= 4);
    for (found, expected) in unbroken.records.iter().zip(&expected.records) {
        assert_eq!(figures(found), figures(expected));
        assert!(found.training.as_ref().is_some_and(|learned| learned.device_seconds.is_some()), "trained there");
        assert!(expected.training.as_ref().is_some_and(|learned| learned.device_seconds.is_none() && learned.steps == STEPS));
    }
    let asked = whole.line.calls.lock().unwrap().clone();
    for kind in [
        "taking a network over",
        "bringing samples over",
        "taking steps",
        "keeping a network",
        "freezing a network",
        "asking a network",
        "fetching a network",
    ] {
        let places = some(&asked, kind);
        assert!(!places.is_empty(), "{kind}");
        for breaks_at in places {
            for when_lost in [WhenLost::Cpu, WhenLost::Stop] {
                let device = Breaking::new(breaks_at, How::Fault, when_lost);
                let found = run(&device);
                // How often a trace is cut up depends on the machine's speed.
                let what = device.line.broke_in.get();
                let case = format!("{when_lost:?} at call {breaks_at}, {what:?}");
                let told: Vec<usize> = (0..found.records.len()).filter(|&i| has_ended(&found.records[i]) > 0).collect();
                let lost = told.first().copied().unwrap_or(found.records.len());
                assert!(expected.films[..lost] == found.films[..lost], "{case}: as on the CPU up to frame {lost}");
                if when_lost == WhenLost::Stop {
                    assert!(told.is_empty() && (found.error.is_some() || found.films.len() == expected.films.len()), "{case}");
                    continue;
                }
                assert!(found.error.is_none() && found.films.len() == expected.films.len(), "{case}: {:?}", found.error);
                assert!(told.len() <= 1, "{case}: told once");
                for (i, record) in found.records.iter().enumerate() {
                    let learned = record.training.as_ref().unwrap();
                    // The frame in which it is lost may end with fewer steps, and says how many were lost.
                    assert!(learned.steps == STEPS || i == lost || i == lost + 1, "{case}, frame {i}: {learned:?}");
                    assert!(learned.loss.is_none_or(f64::is_finite) && learned.rollbacks == 0, "{case}, frame {i}: {learned:?}");
                    assert!(i >= lost || learned.lost_steps == 0, "{case}, frame {i}: {learned:?}");
                }
                // Where no path met anything some layers hold no number.
                let values = found.films.iter().flatten().map(|bits| f32::from_bits(*bits));
                assert!(values.filter(|value| !value.is_nan()).all(|value| value.abs() < 1e6), "{case}: nothing of a broken answer");
            }
        }
    }
}
