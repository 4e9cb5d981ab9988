//! A device that fails at a random point of a run, with a fault or for want of memory. It computes on the CPU, so that machines without a GPU run these tests.
//! (`tests/gpu/lost.rs` breaks a real GPU.)

#![allow(clippy::unwrap_used, clippy::print_stdout)]

mod kit;

use kit::scene;
use ridgewatch::backend::{
    AuditFindings, AuditRequest, Backend, BackendError, DeviceError, FrameJob, FrozenOf, HostFrame, HostPicture, Rendered, Storage,
    Surrogate, SurrogateRequest, WhenLost, audit, render_on_cpu,
};
use ridgewatch::config::SceneFile;
use ridgewatch::field::{DomainPoint, Snapshot, UnitPoint, Window};
use ridgewatch::flow::{Extras, FlowMap, Traced, Tracer, VelocitySource, cpu_tracer};
use ridgewatch::render::Renderer;
use ridgewatch::run::{Decision, Event, FrameRecord, RunError, RunOptions, Setup, StageSeconds, run_on};
use ridgewatch::source::Listener;
use ridgewatch::surrogate::network::{Architecture, Objective, PlannedStep};
use ridgewatch::surrogate::{
    CheckpointError, CheckpointState, FrozenHybrid, FrozenNetwork, HostNetwork, HostSurrogate, HostTraining, Hybrid, Kind, Labels, Learned,
    NetworkCopy, NetworkFrom, Predict, ReplayBuffer, Samples, SurrogateDevice, SurrogateTable, SyncedSamples, Table, Trace, Training,
};
use std::collections::hash_map::RandomState;
use std::hash::{BuildHasher, Hasher};
use std::path::Path;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

/// Optimizer steps a frame.
const STEPS: u64 = 20;

/// How the device fails.
#[derive(Debug, Clone, Copy, PartialEq)]
enum How {
    /// A driver call fails, and all after it.
    Fault,
    /// There is no memory, for so many calls.
    Shortage(usize),
}

/// The connection to the device.
#[derive(Debug)]
struct Line {
    /// The calls that were made.
    calls: Mutex<Vec<&'static str>>,
    /// The call that fails first; all, or only those of one kind, count.
    breaks_at: usize,
    kind: Option<&'static str>,
    how: How,
    /// Whether a copy of the network finds memory.
    has_room: AtomicBool,
    /// Whether downloads of copies are held up.
    is_slow: AtomicBool,
    /// Tables on the device, and the most that were there when another one was traced.
    tables: AtomicUsize,
    tables_before: AtomicUsize,
}

impl Line {
    fn new(breaks_at: usize, how: How) -> Arc<Self> {
        Self::of_kind(None, breaks_at, how)
    }

    fn of_kind(kind: Option<&'static str>, breaks_at: usize, how: How) -> Arc<Self> {
        let (has_room, is_slow) = (AtomicBool::new(true), AtomicBool::new(false));
        let (tables, tables_before) = (AtomicUsize::new(0), AtomicUsize::new(0));
        Arc::new(Self { calls: Mutex::default(), breaks_at, kind, how, has_room, is_slow, tables, tables_before })
    }

    fn call(&self, what: &'static str) -> Result<(), DeviceError> {
        let mut calls = self.calls.lock().unwrap();
        calls.push(what);
        let count = self.kind.map_or(calls.len(), |kind| calls.iter().filter(|call| **call == kind).count());
        let is_counted = self.kind.is_none_or(|kind| kind == what);
        match self.how {
            How::Fault if count > self.breaks_at => Err(DeviceError::Driver { doing: what, reason: "broken by the test".into() }),
            How::Shortage(length) if is_counted && count > self.breaks_at && count <= self.breaks_at.saturating_add(length) => {
                Err(DeviceError::OutOfMemory { what: what.into(), needed: 1 << 20, used: 0, cap: 0, cap_from: "broken by the test" })
            }
            _ => Ok(()),
        }
    }

    fn has_failed(&self) -> bool {
        let calls = self.calls.lock().unwrap();
        self.kind.map_or(calls.len(), |kind| calls.iter().filter(|call| **call == kind).count()) > self.breaks_at
    }
}

const NAME: &str = "a device that breaks";

/// A backend whose every call may fail.
struct Breaking {
    line: Arc<Line>,
    when_lost: WhenLost,
    may_fall_back: bool,
    /// Shortages that can be planned around.
    plans: usize,
    /// How windows are held, if that is left to the run.
    half: Option<Half>,
}

/// Half precision has so many bits of velocities in a window that begins at a time.
struct Half {
    storage: Storage,
    bits: fn(f64) -> i32,
}

impl Half {
    fn of(bits: fn(f64) -> i32) -> Option<Self> {
        Some(Self { storage: Storage::F32, bits })
    }

    fn rounded(&self, velocity: &VelocitySource, t0: f64) -> VelocitySource {
        let VelocitySource::Window(window) = velocity else { panic!("a window") };
        let bits = (self.bits)(t0);
        let round = |x: f32| {
            let step = (x.abs().max(1e-20).log2().floor() + 1.0 - bits as f32).exp2();
            (x / step).round() * step
        };
        let mut rounded = Window::new(window.span());
        for snapshot in window.snapshots() {
            let nodes = snapshot.nodes.iter().map(|node| node.map(round)).collect();
            rounded.push(Arc::new(Snapshot::new(snapshot.time, snapshot.grid.clone(), nodes))).unwrap();
        }
        VelocitySource::Window(Arc::new(rounded))
    }
}

impl Breaking {
    fn on(line: &Arc<Line>) -> Self {
        Self { line: line.clone(), when_lost: WhenLost::Cpu, may_fall_back: false, plans: 2, half: None }
    }
}

struct BreakingTracer {
    line: Arc<Line>,
    host: Box<dyn Tracer>,
}

impl Trace for BreakingTracer {
    fn flow(&self) -> &dyn Tracer {
        &*self.host
    }
    fn trace(&self, seeds: &[DomainPoint], extras: Extras, out: &mut Traced) -> Result<(), DeviceError> {
        self.line.call("tracing seeds")?;
        Tracer::trace(&*self.host, seeds, extras, out);
        self.line.call("reading a trace").inspect_err(|_| out.log_stretch.fill(1e30))
    }
}

/// The device, as surrogates see it.
struct OnLine;

impl SurrogateDevice for OnLine {
    type Tracer<'t> = BreakingTracer;
    type Table = BreakingTable;
    type Training = BreakingTraining;

    fn trace_table(tracer: &BreakingTracer, nodes: [usize; 3], old: Option<BreakingTable>) -> Result<BreakingTable, DeviceError> {
        drop(old);
        let line = &tracer.line;
        // The thread that writes a checkpoint downloads the old table first, which is a moment's work.
        let begin = Instant::now();
        while line.tables.load(Ordering::Relaxed) > 0 && begin.elapsed() < Duration::from_secs(60) {
            std::thread::sleep(Duration::from_millis(1));
        }
        line.tables_before.fetch_max(line.tables.load(Ordering::Relaxed), Ordering::Relaxed);
        line.call("tracing a table")?;
        Ok(BreakingTable::new(line, Table::trace(&tracer.host, nodes)?))
    }

    fn untraced_table(tracer: &BreakingTracer, nodes: [usize; 3]) -> Result<BreakingTable, DeviceError> {
        tracer.line.call("allocating a finer table")?;
        Ok(BreakingTable::new(&tracer.line, Table::untraced(tracer.host.domain(), nodes)))
    }

    fn trace_more(tracer: &BreakingTracer, table: &mut BreakingTable, most: usize) -> Result<bool, DeviceError> {
        tracer.line.call("tracing more nodes")?;
        Arc::get_mut(&mut table.0).unwrap().values.trace_more(&tracer.host, most)
    }

    fn predict(frozen: &FrozenHybrid<Self>, points: &[UnitPoint], out: &mut [f32]) -> Result<(), DeviceError> {
        if let Some(table) = &frozen.table {
            table.0.line.call("looking up in a table")?;
            table.0.values.interpolate(points, out);
        }
        if let Some((line, network)) = frozen.network.as_deref() {
            line.call("asking a network")?;
            let mut above = vec![0.0; points.len()];
            network.predict(points, frozen.times, &mut above);
            let has_table = frozen.table.is_some();
            for (out, above) in out.iter_mut().zip(above) {
                *out = if has_table { frozen.shrinkage.mul_add(above, *out) } else { above };
            }
        }
        Ok(())
    }
}

struct HeldTable {
    line: Arc<Line>,
    values: Table,
}

impl Drop for HeldTable {
    fn drop(&mut self) {
        self.line.tables.fetch_sub(1, Ordering::Relaxed);
    }
}

#[derive(Clone)]
struct BreakingTable(Arc<HeldTable>);

impl BreakingTable {
    fn new(line: &Arc<Line>, values: Table) -> Self {
        line.tables.fetch_add(1, Ordering::Relaxed);
        Self(Arc::new(HeldTable { line: line.clone(), values }))
    }
}

impl SurrogateTable for BreakingTable {
    fn to_host(&self) -> Result<Table, DeviceError> {
        self.0.line.call("downloading a table")?;
        Ok(self.0.values.clone())
    }
    fn with_values(&self, values: Table) -> Result<Self, DeviceError> {
        self.0.line.call("uploading a table")?;
        Ok(Self::new(&self.0.line, values))
    }
}

/// Takes the CPU's steps; the host knows only what was downloaded.
struct BreakingTraining {
    line: Arc<Line>,
    device: HostTraining,
    host: HostNetwork,
}

impl Training for BreakingTraining {
    type Table = BreakingTable;
    type Network = (Arc<Line>, Arc<FrozenNetwork>);

    fn shape(&self) -> &Architecture {
        self.device.shape()
    }
    fn steps_taken(&self) -> usize {
        self.device.steps_taken()
    }
    fn is_on_device(&self) -> bool {
        true
    }
    fn begin(&mut self, objective: &Objective, capacity: usize, batch: usize) -> Result<(), DeviceError> {
        self.line.call("taking a network over")?;
        self.device.begin(objective, capacity, batch)
    }
    fn sync(&mut self, objective: &Objective, labels: Labels<'_, BreakingTable>) -> Result<SyncedSamples, DeviceError> {
        self.line.call("uploading samples")?;
        self.device.sync(objective, Labels { buffer: labels.buffer, base: None })
    }
    fn train(&mut self, objective: &Objective, labels: Labels<'_, BreakingTable>, steps: &[PlannedStep]) -> Result<Vec<f64>, DeviceError> {
        self.line.call("taking steps")?;
        let base = labels.base.map(|base| &base.0.values);
        self.device.train(objective, Labels { buffer: labels.buffer, base }, steps)
    }
    fn group(&self, seconds: f64) -> u64 {
        self.device.group(seconds)
    }
    fn keep(&mut self) -> Result<(), DeviceError> {
        self.line.call("keeping a network")?;
        self.device.keep()
    }
    fn roll_back(&mut self) -> Result<(), DeviceError> {
        self.device.roll_back()
    }
    fn restart_average(&mut self) -> Result<(), DeviceError> {
        self.device.restart_average()
    }
    fn settle(&mut self) {
        self.device.settle();
    }
    fn zero_output(&mut self) -> Result<(), DeviceError> {
        self.line.call("zeroing layers")?;
        self.device.zero_output()
    }
    fn forget_labels(&mut self) {}
    fn frozen(&self, objective: &Objective) -> Result<Arc<Self::Network>, DeviceError> {
        self.line.call("freezing a network")?;
        Ok(Arc::new((self.line.clone(), self.device.frozen(objective)?)))
    }
    fn download(&self) -> Result<HostNetwork, DeviceError> {
        self.line.call("downloading a network")?;
        self.device.download()
    }
    fn copy(&mut self) -> Result<NetworkCopy, DeviceError> {
        self.line.call("copying a network")?;
        let copy = self.device.download()?;
        if !self.line.has_room.load(Ordering::Relaxed) {
            return Ok(NetworkCopy::Ready(copy, Some("no room, by the test".into())));
        }
        let line = self.line.clone();
        Ok(NetworkCopy::Downloadable(Box::new(move || {
            let begin = Instant::now();
            while line.is_slow.load(Ordering::Relaxed) && begin.elapsed() < Duration::from_secs(60) {
                std::thread::sleep(Duration::from_millis(1));
            }
            line.call("downloading a copy")?;
            Ok(copy)
        })))
    }
    fn host_copy(&self) -> &HostNetwork {
        &self.host
    }
    fn set_host_copy(&mut self, network: HostNetwork) {
        self.host = network;
    }
    fn restore(&mut self, network: HostNetwork) {
        self.host = network.clone();
        self.device.restore(network);
    }
    fn device_seconds(&mut self) -> Option<f64> {
        Some(1e-3)
    }
}

struct BreakingSurrogate(Hybrid<OnLine>);

impl Surrogate for BreakingSurrogate {
    type Tracer = BreakingTracer;
    type Frozen = FrozenHybrid<OnLine>;

    fn freeze(&self) -> Result<Self::Frozen, DeviceError> {
        self.0.freeze()
    }
    fn learns(&self) -> bool {
        self.0.learns()
    }
    fn trains_on_device(&self) -> bool {
        self.0.trains_on_device()
    }
    fn learn(&mut self, buffer: &ReplayBuffer, seconds: f64, max_steps: u64) -> Result<Learned, DeviceError> {
        self.0.learn(buffer, seconds, max_steps)
    }
    fn window_slid(&mut self, tracer: &BreakingTracer, _: &AtomicBool) -> Result<(), DeviceError> {
        self.0.window_slid(tracer)
    }
    fn refine_table(&mut self, tracer: &BreakingTracer, nodes: [usize; 3], most: usize, stop: &AtomicBool) -> Result<bool, DeviceError> {
        self.0.refine_table(tracer, nodes, most, stop)
    }
    fn finer_nodes(&self) -> Option<[usize; 3]> {
        self.0.finer_nodes()
    }
    fn table_nodes(&self) -> Option<[usize; 3]> {
        self.0.table_nodes()
    }
    fn checkpoint(&self) -> Result<CheckpointState, DeviceError> {
        self.0.checkpoint()
    }
    fn checkpoint_async(&mut self) -> Result<Option<CheckpointState>, DeviceError> {
        self.0.checkpoint_async()
    }
    fn load(&mut self, path: &Path) -> Result<(), CheckpointError> {
        self.0.load(path)
    }
    fn bytes(&self) -> usize {
        Predict::bytes(&self.0)
    }
    fn to_host(&mut self, from: NetworkFrom) -> Result<HostSurrogate, DeviceError> {
        self.0.to_host(from)
    }
}

impl Backend for Breaking {
    type Tracer = BreakingTracer;
    type Surrogate = BreakingSurrogate;
    type Samples = Samples;
    type Picture = HostPicture;

    fn name(&self) -> String {
        NAME.into()
    }
    fn prefetch(&self) -> Option<Listener> {
        None
    }
    fn open_storage(&mut self) -> Option<&mut Storage> {
        self.half.as_mut().map(|half| &mut half.storage)
    }
    fn tracer(&mut self, velocity: &VelocitySource, map: &FlowMap, t0: f64) -> Result<BreakingTracer, BackendError> {
        let held = self.half.as_ref().filter(|half| half.storage != Storage::F32).map(|half| half.rounded(velocity, t0));
        let velocity = held.as_ref().unwrap_or(velocity);
        let tracer = BreakingTracer { line: self.line.clone(), host: cpu_tracer(velocity.clone(), map, t0)? };
        self.line.call("uploading a window")?;
        Ok(tracer)
    }
    fn surrogate(&mut self, request: &SurrogateRequest<'_>, tracer: &BreakingTracer) -> Result<BreakingSurrogate, BackendError> {
        let SurrogateRequest { settings, network, seed, .. } = *request;
        let nodes = settings.table_nodes.unwrap_or([5; 3]);
        let training = |model| {
            let network = HostNetwork::fresh(model);
            BreakingTraining { line: self.line.clone(), device: HostTraining::new(network.clone()), host: network }
        };
        Ok(BreakingSurrogate(Hybrid::new(settings.kind, nodes, network, seed, tracer, training)??))
    }
    fn render(
        &mut self,
        job: &FrameJob<'_, Self>,
        renderer: &mut Renderer,
        picture: &mut HostPicture,
    ) -> Result<Rendered<Samples>, DeviceError> {
        self.line.call("starting a frame")?;
        let surrogate = job.surrogate.map(|surrogate| surrogate as &dyn Predict);
        let rendered = render_on_cpu(&HostFrame::of(job, job.tracer, surrogate), renderer, picture)?;
        self.line.call("downloading a film")?;
        Ok(rendered)
    }
    fn audit(
        &mut self,
        request: &AuditRequest<'_>,
        tracer: &BreakingTracer,
        surrogate: Option<&FrozenOf<Self>>,
    ) -> Result<AuditFindings, DeviceError> {
        self.line.call("an audit")?;
        audit::audit(request, tracer, surrogate.map(|surrogate| surrogate as &dyn Predict))
    }
    fn replan(
        &mut self,
        shortage: &DeviceError,
        _: &BreakingTracer,
        _: &mut Option<BreakingSurrogate>,
    ) -> Result<Option<String>, DeviceError> {
        Ok(self.plans.checked_sub(1).map(|left| {
            self.plans = left;
            format!("planned anew: {shortage}")
        }))
    }
    fn when_lost(&self) -> WhenLost {
        self.when_lost
    }
    fn may_fall_back(&self) -> bool {
        self.may_fall_back
    }
}

/// A run's frames: records, the films' bits, and the error that ended it.
#[derive(Default)]
struct Made {
    records: Vec<FrameRecord>,
    films: Vec<Vec<u32>>,
    error: Option<RunError>,
    warnings: Vec<String>,
    decisions: Vec<Decision>,
}

impl Made {
    fn warnings(&self) -> impl Iterator<Item = &String> {
        self.records.iter().flat_map(|record| &record.warnings).chain(&self.warnings)
    }

    fn count(&self, warning: &str) -> usize {
        self.warnings().filter(|told| told.contains(warning)).count()
    }
}

const ENDED: &str = "work on the GPU has ended, the CPU goes on";

fn made_on<B: Backend>(backend: B, scene: &SceneFile, options: &RunOptions, after: &mut (dyn FnMut(u64) + Send)) -> Made {
    let mut made = Made::default();
    let mut sink = |event: Event| {
        if let Event::Frame(frame) = event {
            let film = &frame.film;
            let rest = [&film.ftle_mean, &film.traced, &film.variance, &film.samples, &film.missing, &film.queries];
            made.films.push(film.rgba.iter().flatten().chain(rest.into_iter().flatten()).map(|v| v.to_bits()).collect());
            made.records.push((*frame.record).clone());
            after(frame.record.frame);
        }
    };
    let options = RunOptions { threads: 2, ..options.clone() };
    match run_on(backend, Setup::new(scene.settings()).unwrap(), &options, &mut sink, &AtomicBool::new(false)) {
        Ok(report) => (made.warnings, made.decisions) = (report.warnings, report.decisions),
        Err(error) => made.error = Some(error),
    }
    made
}

fn made<B: Backend>(backend: B, scene: &SceneFile) -> Made {
    made_on(backend, scene, &RunOptions::default(), &mut |_| ())
}

/// A record without what differs from run to run and from device to device.
fn figures(record: &FrameRecord) -> FrameRecord {
    let training = record.training.clone().map(|learned| Learned { seconds: 0.0, device_seconds: None, warnings: Vec::new(), ..learned });
    let (device, seconds, warnings) = (String::new(), StageSeconds::default(), Vec::new());
    FrameRecord { device, seconds, warnings, training, checkpoint: None, ..record.clone() }
}

/// Random numbers below `below`, other ones in every run, and the first and the last.
fn points(count: usize, below: usize) -> Vec<usize> {
    let state = RandomState::new();
    let drawn = |i: usize| {
        let mut hasher = state.build_hasher();
        hasher.write_usize(i);
        hasher.finish() as usize % below
    };
    let points = [0, below - 1].into_iter().chain((0..count).map(drawn)).collect();
    println!("breaks at {points:?} of {below} calls");
    points
}

fn reference() -> SceneFile {
    let keys = "
        time.tau = 5
        time.seed_step = 0.1
        time.slides = 2
        time.frames_per_slide = 2
        flow.steps = 10
        trust.cells = [4, 2, 1]
        render.method = \"reference\"
    ";
    scene::parse(&scene::double_gyre([16, 8, 2], keys), &[]).unwrap()
}

/// A network whose steps take little of the many runs.
const TINY_NETWORK: &str = "
    network.levels = 4
    network.log2_table = 8
    network.width = 16
    network.batch = 256
";

fn sliding(kind: Kind, frames_per_slide: usize) -> SceneFile {
    let surrogate = format!("surrogate.kind = \"{}\"", kind.name());
    let table = if kind == Kind::Network { "" } else { "surrogate.table_nodes = [16, 8, 8]" };
    let network = if kind == Kind::Table { String::new() } else { format!("{TINY_NETWORK}\n        training.steps_per_frame = {STEPS}") };
    let keys = format!(
        "
        source.nodes = [16, 8, 8]
        source.snapshots = 8
        time.tau = 4
        time.frames_per_slide = {frames_per_slide}
        flow.steps = 8
        trust.cells = [2, 2, 2]
        {surrogate}
        {table}
        {network}"
    );
    scene::parse(&scene::scene("turbulence", [16, 8, 2], &keys), &[]).unwrap()
}

/// Breaks the device at random points of the run. The frame in progress is discarded and made again by the CPU, so that every film and every figure is
/// the CPU's.
fn break_at_random(scene: &SceneFile) {
    let expected = made(ridgewatch::backend::Cpu, scene);
    let whole = Line::new(usize::MAX, How::Fault);
    let unbroken = made(Breaking::on(&whole), scene);
    assert!(unbroken.error.is_none() && unbroken.films == expected.films, "{:?}", unbroken.error);
    let calls = whole.calls.lock().unwrap().len();
    for breaks_at in points(12, calls) {
        let line = Line::new(breaks_at, How::Fault);
        let found = made(Breaking::on(&line), scene);
        let case = format!("broken at call {breaks_at}, {:?}", line.calls.lock().unwrap().get(breaks_at));
        assert!(found.error.is_none(), "{case}: {:?}", found.error);
        assert!(found.films == expected.films, "{case}: every film is the CPU's");
        for (found, expected) in found.records.iter().zip(&expected.records) {
            assert_eq!(figures(found), figures(expected), "{case}");
        }
        let told = found.count(ENDED) + found.count("traced on the CPU");
        assert_eq!(told, usize::from(line.has_failed()), "{case}: told once: {:?}", found.warnings().collect::<Vec<_>>());
        let on_cpu = found.records.iter().position(|record| record.device == "cpu").unwrap_or(found.records.len());
        assert!(found.records[on_cpu..].iter().all(|record| record.device == "cpu"), "{case}: it stays there");

        let stopping = Line::new(breaks_at, How::Fault);
        let stopped = made(Breaking { when_lost: WhenLost::Stop, ..Breaking::on(&stopping) }, scene);
        let frames = stopped.films.len();
        assert!(stopped.films[..] == expected.films[..frames] && stopped.count(ENDED) == 0, "{case}: the frames before it are whole");
        match &stopped.error {
            Some(RunError::Device(error)) => assert!(error.to_string().contains("broken by the test"), "{case}: {error}"),
            error => assert!(error.is_none() && !stopping.has_failed(), "{case}: {error:?}"),
        }
    }
}

/// Memory that lacks at random points, once or for long: the slide is planned anew, and the run goes on even where it was to end with the device.
fn lack_memory_at_random(scene: &SceneFile) {
    let expected = made(ridgewatch::backend::Cpu, scene);
    let whole = Line::new(usize::MAX, How::Fault);
    made(Breaking::on(&whole), scene);
    let (begin, calls) = (1, whole.calls.lock().unwrap().len());
    for breaks_at in points(6, calls - begin).into_iter().map(|point| point + begin) {
        for (length, plans) in [(1, 1), (2, 2), (usize::MAX, 2)] {
            let line = Line::new(breaks_at, How::Shortage(length));
            let found = made(Breaking { when_lost: WhenLost::Stop, ..Breaking::on(&line) }, scene);
            let case = format!("{length} calls from {breaks_at} on, {:?}", line.calls.lock().unwrap().get(breaks_at));
            assert!(found.error.is_none() && found.films == expected.films, "{case}: {:?}", found.error);
            if line.has_failed() {
                let (planned, ended) = (found.count("planned anew"), found.count(ENDED));
                // A window that does not fit leaves nothing to plan.
                assert!(planned <= plans && planned + ended >= 1 && ended <= 1, "{case}: {:?}", found.warnings().collect::<Vec<_>>());
            }
        }
    }
}

#[test]
fn reference_frames_of_a_closed_form() {
    break_at_random(&reference());
    lack_memory_at_random(&reference());
}

#[test]
fn gated_frames_with_a_table_over_a_sliding_window() {
    break_at_random(&sliding(Kind::Table, 1));
    lack_memory_at_random(&sliding(Kind::Table, 1));
}

/// A device chosen automatically may refuse its first window, and the CPU computes; one that was asked for by name may not.
#[test]
fn a_device_chosen_automatically_may_refuse_the_first_window() {
    let scene = reference();
    let expected = made(ridgewatch::backend::Cpu, &scene);
    let by_name = made(Breaking::on(&Line::new(0, How::Shortage(usize::MAX))), &scene);
    assert!(matches!(by_name.error, Some(RunError::Device(_))) && by_name.films.is_empty(), "{:?}", by_name.error);
    let automatic = Breaking { may_fall_back: true, ..Breaking::on(&Line::new(0, How::Shortage(usize::MAX))) };
    let found = made(automatic, &scene);
    assert!(found.error.is_none() && found.films == expected.films && found.records[0].device == "cpu");
    assert_eq!(found.count("traced on the CPU: uploading a window"), 1, "{:?}", found.records[0].warnings);
}

/// A network that a device trains: as long as it works all is as on the CPU; once it is lost, the CPU goes on from the latest host copy, and the steps
/// since then are reported as lost.
#[test]
fn training_over_a_sliding_window_goes_on_from_the_host_copy() {
    for kind in [Kind::Network, Kind::Residual] {
        let scene = sliding(kind, 2);
        let expected = made(ridgewatch::backend::Cpu, &scene);
        let whole = Line::new(usize::MAX, How::Fault);
        let unbroken = made(Breaking::on(&whole), &scene);
        assert!(unbroken.error.is_none() && expected.films.len() >= 6, "{:?}", unbroken.error);
        for (found, expected) in unbroken.records.iter().zip(&expected.records) {
            assert_eq!((found.training.as_ref().unwrap().steps, expected.training.as_ref().unwrap().steps), (STEPS, STEPS));
            assert!(found.training.as_ref().unwrap().device_seconds.is_some(), "trained there");
        }
        let calls = whole.calls.lock().unwrap().len();
        for breaks_at in points(12, calls) {
            let line = Line::new(breaks_at, How::Fault);
            let found = made(Breaking::on(&line), &scene);
            let case = format!("{kind:?} broken at call {breaks_at}, {:?}", line.calls.lock().unwrap().get(breaks_at));
            assert!(found.error.is_none() && found.films.len() == expected.films.len(), "{case}: {:?}", found.error);
            let lost = found.records.iter().position(|record| record.device == "cpu").unwrap_or(found.records.len());
            assert!(found.films[..lost] == unbroken.films[..lost], "{case}: nothing changes before frame {lost}");
            assert!(found.count(ENDED) + found.count("traced on the CPU") <= 1, "{case}: told once");
            let learned: Vec<&Learned> = found.records.iter().filter_map(|record| record.training.as_ref()).collect();
            let lost_steps: u64 = learned.iter().map(|learned| learned.lost_steps).sum();
            let before: u64 = found.records[..lost].iter().filter_map(|record| record.training.as_ref()).map(|learned| learned.steps).sum();
            // No host copy was made within so short a time.
            assert!(
                lost_steps >= before && lost_steps <= before + STEPS || lost == found.records.len(),
                "{case}: {lost_steps} of {before}"
            );
            assert!(learned.iter().all(|learned| learned.loss.is_none_or(f64::is_finite) && learned.rollbacks == 0), "{case}");
            let values = found.films.iter().flatten().map(|bits| f32::from_bits(*bits));
            assert!(values.filter(|value| !value.is_nan()).all(|value| value.abs() < 1e6), "{case}: nothing of a broken answer");
        }
    }
}

/// A shortage while a device trains does not lose what it learned.
#[test]
fn a_shortage_keeps_what_was_learned() {
    let scene = sliding(Kind::Residual, 2);
    let whole = made(Breaking::on(&Line::new(usize::MAX, How::Fault)), &scene);
    for kind in ["taking steps", "uploading samples", "freezing a network", "tracing seeds"] {
        for (length, plans) in [(1, 1), (usize::MAX, 0)] {
            let line = Line::of_kind(Some(kind), 5, How::Shortage(length));
            let found = made(Breaking { plans, ..Breaking::on(&line) }, &scene);
            assert!(found.error.is_none() && found.films.len() == whole.films.len(), "{kind}: {:?}", found.error);
            assert_eq!(found.count("planned anew") + found.count(ENDED), 1, "{kind}: {:?}", found.warnings().collect::<Vec<_>>());
            let lost: u64 = found.records.iter().filter_map(|record| record.training.as_ref()).map(|learned| learned.lost_steps).sum();
            assert_eq!(lost, 0, "{kind}: the device works, so its network moves");
        }
    }
}

/// A network that was fitted to the device keeps its shape on the CPU, which takes steps of its own batches.
#[test]
fn a_fitted_network_goes_on_in_batches_of_the_cpu() {
    const ON_CPU: u64 = 1 << 14;
    // Each frame's audit draws more labels than a batch of the CPU takes.
    let scene = |batch: &str| {
        let keys = format!(
            "
            source.nodes = [96, 8, 8]
            source.snapshots = 6
            time.tau = 4
            time.slides = 1
            time.frames_per_slide = 4
            flow.steps = 8
            trust.cells = [2, 2, 2]
            trust.audit_min_per_cell = 4096
            trust.audit_max_per_cell = 4096
            surrogate.kind = \"network\"
            network.width = 16
            {batch}
            training.steps_per_frame = 2"
        );
        scene::parse(&scene::scene("turbulence", [16, 8, 2], &keys), &[]).unwrap()
    };
    let decision = |made: &Made, of: &str| made.decisions.iter().find(|d| d.setting == of).map(|d| (d.chosen.clone(), d.why.clone()));
    // Samples of a step while the last frame was made.
    let last_batch = |made: &Made| {
        let learned = made.records.last().unwrap().training.clone().unwrap();
        learned.samples / learned.steps
    };
    let whole = made(Breaking::on(&Line::new(usize::MAX, How::Fault)), &scene(""));
    assert!(whole.error.is_none() && last_batch(&whole) > ON_CPU, "{:?}: {}", whole.error, last_batch(&whole));
    assert_eq!((decision(&whole, "network.batch").unwrap().0, whole.count("network.batch")), ((1 << 18).to_string(), 0));

    for how in [How::Fault, How::Shortage(1)] {
        // In the third frame: a step of the CPU is a call.
        let line = Line::of_kind(Some("taking steps"), 5, how);
        let found = made(Breaking { plans: 0, ..Breaking::on(&line) }, &scene(""));
        assert!(found.error.is_none() && found.count(ENDED) == 1, "{how:?}: {:?}", found.error);
        assert_eq!(last_batch(&found), ON_CPU, "{how:?}");
        let (chosen, why) = decision(&found, "network.batch").unwrap();
        assert!(chosen == ON_CPU.to_string() && why.contains("the CPU trains the network"), "{how:?}: {chosen}, {why}");
        assert_eq!(found.count(&format!("network.batch = {ON_CPU}: the CPU trains the network")), 1, "{how:?}: told once");
        for size in ["network.levels", "network.growth", "network.base_resolution", "network.log2_table"] {
            assert_eq!(decision(&found, size), decision(&whole, size), "{how:?}: weights keep their shape");
        }
    }

    // A batch that is given stays, and a device that refuses the first window leaves a network of the CPU.
    let given = made(Breaking::on(&Line::of_kind(Some("taking steps"), 5, How::Fault)), &scene("network.batch = 20000"));
    assert_eq!((last_batch(&given), given.count("network.batch"), decision(&given, "network.batch")), (20_000, 0, None));
    let never = made(Breaking { may_fall_back: true, ..Breaking::on(&Line::new(0, How::Shortage(usize::MAX))) }, &scene(""));
    assert_eq!((last_batch(&never), decision(&never, "network.batch"), decision(&never, "network.levels")), (ON_CPU, None, None));
}

/// The table of a window is gone before the next one is traced, and so under a checkpoint that takes long.
#[test]
fn a_slide_finds_the_old_table_gone() {
    let folder = tempfile::tempdir().unwrap();
    let options = RunOptions { checkpoint: Some(folder.path().join("weights")), checkpoint_seconds: Some(0.0), ..RunOptions::default() };
    let line = Line::new(usize::MAX, How::Fault);
    let found = made_on(Breaking::on(&line), &sliding(Kind::Table, 1), &options, &mut |_| std::thread::sleep(Duration::from_millis(30)));
    assert!(found.error.is_none(), "{:?}", found.error);
    assert_eq!(line.tables_before.load(Ordering::Relaxed), 0, "tables that were there when another was traced");
}

/// Pictures that stand still, so that their table is refined before the second frame.
fn standing() -> SceneFile {
    let keys = "
        source.nodes = [12, 6, 6]
        source.snapshots = 8
        time.tau = 4
        time.slides = 1
        time.frames_per_slide = 4
        flow.steps = 8
        trust.cells = [2, 2, 2]
        render.method = \"two_level\"
        surrogate.kind = \"table\"
    ";
    scene::parse(&scene::scene("turbulence", [16, 8, 2], keys), &[]).unwrap()
}

/// Samples per pixel of each frame's picture: two more in each, from two on where it started anew.
fn samples(made: &Made) -> Vec<f64> {
    made.records.iter().map(|record| record.picture_error.unwrap().samples_per_pixel.round()).collect()
}

/// A device without room for a finer table goes on with the table that it has; one that is lost meanwhile leaves both to the CPU.
#[test]
fn a_table_that_cannot_be_refined_stays() {
    let whole = Line::new(usize::MAX, How::Fault);
    let unbroken = made(Breaking::on(&whole), &standing());
    assert_eq!(samples(&unbroken), [2.0, 2.0, 4.0, 6.0], "{:?}", unbroken.error);

    let short = Line::of_kind(Some("allocating a finer table"), 0, How::Shortage(1));
    let found = made(Breaking::on(&short), &standing());
    assert!(found.error.is_none() && short.has_failed());
    assert_eq!((samples(&found), found.count("planned anew")), (vec![2.0, 4.0, 6.0, 8.0], 0));
    assert!(found.records.iter().all(|record| record.device == NAME));

    let lost = Line::of_kind(Some("tracing more nodes"), 0, How::Fault);
    let found = made(Breaking::on(&lost), &standing());
    assert!(found.error.is_none() && found.count(ENDED) == 1, "{:?}", found.error);
    assert_eq!(samples(&found), samples(&unbroken));
    let devices: Vec<bool> = found.records.iter().map(|record| record.device == "cpu").collect();
    assert_eq!(devices, [false, true, true, true]);
}

/// Checkpoints of a network that a device trains: a copy whose download takes long does not hold the frames up; without room for a copy frames wait and a
/// record says so; a copy that is lost costs one checkpoint.
#[test]
fn checkpoints_while_a_device_trains() {
    let scene = sliding(Kind::Residual, 5);
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("checkpoint");
    let run = |line: &Arc<Line>, checkpoint_seconds, slow_until: Option<u64>| {
        drop(std::fs::remove_file(&path));
        let options = RunOptions { checkpoint: Some(path.clone()), checkpoint_seconds, ..RunOptions::default() };
        let (watched, path) = (line.clone(), path.clone());
        let found = made_on(Breaking::on(line), &scene, &options, &mut |frame| {
            // The first checkpoint is waited for: the disk has its time for it.
            let begin = Instant::now();
            while checkpoint_seconds.is_some() && frame == 1 && !path.exists() && begin.elapsed() < Duration::from_secs(60) {
                std::thread::sleep(Duration::from_millis(1));
            }
            watched.is_slow.store(slow_until.is_some_and(|until| frame >= 1 && frame < until), Ordering::Relaxed);
        });
        assert!(found.error.is_none(), "{:?}", found.error);
        found
    };
    let (whole, tensors) = (Line::new(usize::MAX, How::Fault), || {
        let file = std::fs::read(&path).unwrap();
        file[8 + u64::from_le_bytes(file[..8].try_into().unwrap()) as usize..].to_vec()
    });
    let expected = run(&whole, None, None);
    let last = tensors();
    assert!(expected.records.iter().all(|record| record.checkpoint.is_none()));

    let slow = Line::new(usize::MAX, How::Fault);
    let found = run(&slow, Some(0.0), Some(8));
    assert!(found.films == expected.films && tensors() == last, "checkpoints change nothing");
    let under_way: Vec<_> = found.records.iter().filter_map(|record| record.checkpoint.as_ref()).filter(|c| c.frame > Some(0)).collect();
    assert!(under_way.len() >= 3 && under_way.iter().all(|checkpoint| checkpoint.asynchronous), "{under_way:?}");
    assert!(under_way.iter().any(|checkpoint| checkpoint.postponed >= 1), "one at a time: {under_way:?}");

    let full = Line::new(usize::MAX, How::Fault);
    full.has_room.store(false, Ordering::Relaxed);
    let found = run(&full, Some(0.0), None);
    assert!(found.films == expected.films && tensors() == last);
    assert!(found.count("no room, by the test") >= 1, "a record says that frames waited");

    for kind in ["copying a network", "downloading a copy"] {
        // The second: the first checkpoint is on the disk.
        let line = Line::of_kind(Some(kind), 1, How::Fault);
        let found = run(&line, Some(0.0), None);
        assert!(line.has_failed() && found.films.len() == expected.films.len(), "{kind}");
        let mut resumed = sliding(Kind::Residual, 5);
        resumed.training.resume = Some(path.clone());
        let goes_on = made(ridgewatch::backend::Cpu, &resumed);
        assert!(goes_on.error.is_none(), "{kind}: the last one is whole: {:?}", goes_on.error);
    }
}

/// A window is held in half precision as long as the picture does not show it.
#[test]
fn half_precision_is_given_up_where_the_picture_shows_it() {
    let text = "
        source.nodes = [24, 12, 12]
        source.snapshots = 8
        time.tau = 4
        time.frames_per_slide = 1
        transfer.low = 0.1
        transfer.high = 0.4
        render.method = \"two_level\"
        surrogate.kind = \"table\"
    ";
    let scene = scene::parse(&scene::scene("turbulence", [24, 12, 4], text), &[]).unwrap();
    let whole = Line::new(usize::MAX, How::Fault);
    let on = |line: &Arc<Line>, bits: fn(f64) -> i32| made(Breaking { half: Half::of(bits), ..Breaking::on(line) }, &scene);
    let decision = |made: &Made| made.decisions.iter().find(|d| d.setting == "device.storage").map(|d| (d.chosen.clone(), d.why.clone()));
    let single = made(ridgewatch::backend::Cpu, &scene);
    assert_eq!(decision(&single), None, "a processor has one form");

    let (half, coarse) = (on(&whole, |_| 11), on(&whole, |_| 1));
    let (chosen, why) = decision(&half).unwrap();
    println!("{why}");
    assert!(chosen == "f16_pairs" && why.contains("colours differ by 0.0"), "{why}");
    assert!(half.films != single.films, "it was held so");
    let (chosen, why) = decision(&coarse).unwrap();
    println!("{why}");
    assert!(chosen == "f32" && why.contains("with f16_pairs colours differ by") && why.contains("allowed: 0.02"), "{why}");
    assert!(coarse.films == single.films, "nothing is left of it");

    // Later slides are looked at as well.
    let later = on(&whole, |t0| if t0 < 2.5 { 11 } else { 1 });
    let (chosen, _) = decision(&later).unwrap();
    assert!(chosen == "f32" && later.films[..3] == half.films[..3] && later.films[3..] != half.films[3..], "{chosen}");

    // Where steps are given, nothing is compared.
    for keys in [&["flow.steps=8"][..], &["flow.tolerance=0.1"], &["flow.precision=\"f64\""]] {
        let given = scene::parse(&scene::scene("turbulence", [24, 12, 4], text), keys).unwrap();
        let found = made(Breaking { half: Half::of(|_| 1), ..Breaking::on(&whole) }, &given);
        assert_eq!(decision(&found), None, "{keys:?}");
        assert!(found.films == made(ridgewatch::backend::Cpu, &given).films, "{keys:?}");
    }

    // Steps whose own error a later slide makes larger are no error of the storage.
    for tolerance in ["0.003", "0.006", "0.01", "0.02"] {
        let keys = [&format!("trust.tolerance={tolerance}")[..]];
        let rough = scene::parse(&scene::scene("turbulence", [24, 12, 4], text), &keys).unwrap();
        let (chosen, why) = decision(&made(Breaking { half: Half::of(|_| 20), ..Breaking::on(&whole) }, &rough)).unwrap();
        assert_eq!(chosen, "f16_pairs", "{tolerance}: {why}");
    }

    let calls = whole.calls.lock().unwrap().len();
    for breaks_at in points(6, calls / 8).into_iter().chain([2, 3, 4]) {
        let line = Line::new(breaks_at, How::Fault);
        let lost = on(&line, |_| 1);
        assert!(lost.error.is_none() && lost.films.len() == single.films.len(), "{breaks_at}: {:?}", lost.error);
        // Nothing is said of half precision for paths of the CPU; films are those of single precision in any case.
        let is_said = decision(&lost).is_some();
        assert!(lost.films == single.films && (!is_said || line.calls.lock().unwrap().len() > 3), "{breaks_at}: {is_said}");
    }
}
