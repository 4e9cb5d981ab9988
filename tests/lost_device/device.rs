//! A device that computes on the CPU, and breaks at one of the calls that are made of it.

use burn::backend::Flex;
use burn::module::{Param, ParamId};
use burn::tensor::{Tensor, TensorData};
use ridgewatch::engine::cuda::{CudaTracerError, DeviceError};
use ridgewatch::engine::{
    Accelerator, Answers, AuditFindings, AuditRequest, Backed, DeviceNodes, DeviceRenderer, DeviceTrace, EngineError, Health, Tally,
    WhenLost, audit,
};
use ridgewatch::field::{Domain, Snapshot};
use ridgewatch::flow::{Extras, FlowMap, Traced, Tracer, VelocitySource, cpu_tracer};
use ridgewatch::render::{Film, LogStretch, RenderStats, Renderer};
use ridgewatch::surrogate::network::{Architecture, Average, Field, Fused, Model, Objective, PlannedStep, Step};
use ridgewatch::surrogate::{
    Brought, Copied, DeviceLost, NotTaken, Offload, OffloadedCopy, OffloadedNetwork, OffloadedTraining, Predict, RingMark, SampleRing,
    Samples, Table,
};
use std::ops::Range;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, OnceLock};
use std::time::{Duration, Instant};

/// The way to the device, which breaks at one of the calls and stays broken.
#[derive(Debug)]
pub struct Line {
    /// What was asked for, call by call.
    pub calls: Mutex<Vec<&'static str>>,
    /// Calls that it does before, of this kind or of all: how many there are in all depends on the machine's speed, by which a trace is cut up.
    breaks_at: usize,
    breaks_in: Option<&'static str>,
    how: How,
    pub broke_in: OnceLock<&'static str>,
    /// A copied network comes back once so many frames were made and tables traced since it was asked for; whether there is room for a copy.
    pub slowness: AtomicUsize,
    pub room: AtomicBool,
    /// Frames that were made, as the test says, and tables that were traced.
    pub moments: AtomicUsize,
    /// Copies that came back since nothing happened any more: whoever was to go on meanwhile waited for them.
    pub waited_for: AtomicUsize,
    /// Whether there is memory to train a network.
    pub takes: AtomicBool,
    /// Whether there is memory for a table that is traced.
    pub tables_fit: AtomicBool,
    /// How many calls are refused before memory is there again.
    pub refusals: AtomicUsize,
    /// Tables that are there, and the most that were when another one was traced, and did not go within [`LONG`].
    tables: AtomicUsize,
    pub tables_before: AtomicUsize,
    /// Steps that it took.
    pub steps: AtomicUsize,
    /// Set once it is broken, for runs that are to stop there.
    pub stop: AtomicBool,
}

/// A table that a device holds.
#[derive(Debug)]
struct Held(Arc<Line>);

impl Held {
    fn new(line: &Arc<Line>) -> Self {
        line.tables.fetch_add(1, Ordering::Relaxed);
        Self(line.clone())
    }
}

impl Drop for Held {
    fn drop(&mut self) {
        self.0.tables.fetch_sub(1, Ordering::Relaxed);
    }
}

/// After so long whatever is waited for does not come: a moment's work, on a machine that may be busy.
const LONG: Duration = Duration::from_secs(60);

#[derive(Debug, Clone, Copy, PartialEq)]
pub enum How {
    /// A driver call fails.
    Fault,
    /// There is no memory left.
    Refusal,
    /// There is no memory left for this one kind of call.
    RefusalOf(&'static str),
    /// It does not do this one kind of call.
    LackOf(&'static str),
}

impl Line {
    fn call(&self, what: &'static str) -> Result<(), DeviceError> {
        let mut calls = self.calls.lock().unwrap();
        calls.push(what);
        let is_other = matches!(self.how, How::RefusalOf(kind) | How::LackOf(kind) if kind != what);
        let refuses = |left: usize| left.checked_sub(1);
        let count = self.breaks_in.map_or(calls.len(), |kind| calls.iter().filter(|call| **call == kind).count());
        if count <= self.breaks_at || is_other || self.refusals.fetch_update(Ordering::Relaxed, Ordering::Relaxed, refuses).is_err() {
            return Ok(());
        }
        self.broke_in.get_or_init(|| what);
        self.stop.store(true, Ordering::Relaxed);
        Err(match self.how {
            How::Fault => DeviceError::Driver { doing: what, reason: "broken by the test".into() },
            How::Refusal | How::RefusalOf(_) => Self::full(what),
            How::LackOf(_) => DeviceError::Unsupported { what: format!("{what}, broken by the test") },
        })
    }

    /// A frame was made; when it was the last one, all that is on its way comes back.
    pub fn frame_made(&self, last: bool) {
        self.moments.fetch_add(1, Ordering::Relaxed);
        if last {
            self.slowness.store(0, Ordering::Relaxed);
        }
    }

    fn full(what: &str) -> DeviceError {
        DeviceError::OutOfMemory { what: what.into(), needed: 1 << 20, used: 0, cap: 0, cap_from: "broken by the test" }
    }
}

#[derive(Debug)]
pub struct Breaking {
    pub line: Arc<Line>,
    health: Arc<Health>,
}

pub const NAME: &str = "a device that breaks";

impl Breaking {
    /// Breaks behind so many calls.
    pub fn new(breaks_at: usize, how: How, when_lost: WhenLost) -> Arc<Self> {
        Self::behind(breaks_at, None, how, when_lost)
    }

    /// Breaks in a call of this kind, behind so many of them.
    pub fn at(kind: &'static str, breaks_at: usize, how: How, when_lost: WhenLost) -> Arc<Self> {
        Self::behind(breaks_at, Some(kind), how, when_lost)
    }

    fn behind(breaks_at: usize, breaks_in: Option<&'static str>, how: How, when_lost: WhenLost) -> Arc<Self> {
        let (broke_in, room, takes) = (OnceLock::new(), AtomicBool::new(true), AtomicBool::new(true));
        let (slowness, moments, waited_for) = (AtomicUsize::new(0), AtomicUsize::new(0), AtomicUsize::new(0));
        let (calls, tables, tables_before) = (Mutex::default(), AtomicUsize::new(0), AtomicUsize::new(0));
        let (tables_fit, refusals) = (AtomicBool::new(true), AtomicUsize::new(usize::MAX));
        let (steps, stop) = (AtomicUsize::new(0), AtomicBool::new(false));
        let line = Line {
            calls,
            breaks_at,
            breaks_in,
            how,
            broke_in,
            slowness,
            room,
            moments,
            waited_for,
            takes,
            tables_fit,
            refusals,
            tables,
            tables_before,
            steps,
            stop,
        };
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
        Ok(Box::new(Render { line: self.line.clone(), below: None }))
    }
    fn offload(&self) -> Option<Arc<dyn Offload>> {
        Some(Arc::new(Training { line: self.line.clone(), health: self.health.clone() }))
    }
    fn expect(&self, _: &Arc<Snapshot>) {
        // The window that wants it brings it, where there is no memory to have it early.
        if let Err(error) = self.line.call("bringing a snapshot over")
            && error.is_fault()
        {
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
        let begin = Instant::now();
        while self.line.tables.load(Ordering::Relaxed) > 0 && begin.elapsed() < LONG {
            std::thread::sleep(Duration::from_millis(1));
        }
        self.line.tables_before.fetch_max(self.line.tables.load(Ordering::Relaxed), Ordering::Relaxed);
        self.line.moments.fetch_add(1, Ordering::Relaxed);
        self.line.call("tracing a table")?;
        if !self.line.tables_fit.load(Ordering::Relaxed) {
            return Err(Line::full("a table"));
        }
        let held = Held::new(&self.line);
        Ok(Some(Box::new(Nodes { line: self.line.clone(), table: Table::trace(&*self.host, nodes), _held: held })))
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
    _held: Held,
}

/// A table of the device's own; none where the host keeps it.
fn nodes_of(table: &Table) -> Option<&Nodes> {
    table.on_device().and_then(|there| there.as_any().downcast_ref())
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

    /// The same for what takes memory.
    fn call_for_room(&self, what: &'static str) -> Result<(), NotTaken> {
        self.health.ask_for_room(|| self.line.call(what))
    }
}

impl Offload for Training {
    fn takes(&self, _: &Architecture, _: &Objective) -> bool {
        true
    }
    fn training(
        &self,
        model: &Model,
        objective: &Objective,
        average: &Average,
        _: usize,
        batch: usize,
    ) -> Result<Box<dyn OffloadedTraining>, NotTaken> {
        self.call_for_room("taking a network over")?;
        assert_eq!(batch, BATCH);
        if !self.line.takes.load(Ordering::Relaxed) {
            return Err(NotTaken::NoRoom("no room, by the test".into()));
        }
        Ok(Box::new(Network {
            there: Training { line: self.line.clone(), health: self.health.clone() },
            fused: Fused::new(model, objective, BATCH),
            model: model.clone(),
            objective: objective.clone(),
            average: average.clone(),
            samples: Samples::default(),
            mark: None,
            base: None,
            below: None,
            seconds: 0.0,
            kept: None,
        }))
    }
}

/// Device seconds of a step.
pub const STEP_SECONDS: f64 = 1e-3;

/// Samples of a batch, and steps a frame, of the scene that it trains in.
pub const BATCH: usize = 512;
pub const STEPS: u64 = 20;

struct Network {
    there: Training,
    fused: Fused,
    model: Model,
    objective: Objective,
    average: Average,
    samples: Samples,
    mark: Option<RingMark>,
    base: Option<Table>,
    /// The copy of that, where the host keeps it, by its stamp.
    below: Option<(u64, Held)>,
    seconds: f64,
    kept: Option<(Model, Average)>,
}

impl OffloadedTraining for Network {
    fn forget_labels(&mut self) {}

    fn let_go_of_base(&mut self) {
        self.below = None;
    }

    fn bring(&mut self, ring: &SampleRing, base: Option<&Table>) -> Result<Brought, NotTaken> {
        match base.filter(|base| nodes_of(base).is_none()) {
            Some(base) if self.below.as_ref().is_none_or(|(stamp, _)| *stamp != base.stamp()) => {
                let line = &self.there.line;
                let room = self.there.health.ask_for_room(|| line.call("bringing a table over"));
                room.map_err(|why| if let NotTaken::NoRoom(why) = why { NotTaken::NoRoomForBase(why) } else { why })?;
                self.below = Some((base.stamp(), Held::new(line)));
            }
            Some(_) => {}
            None => self.below = None,
        }
        self.there.call_for_room("bringing samples over")?;
        self.samples.points.resize(ring.len(), [f32::NAN; 3]);
        self.samples.log_stretch.resize(ring.len(), f32::NAN);
        for range in ring.written_since(self.mark) {
            self.samples.points[range.clone()].copy_from_slice(&ring.samples().points[range.clone()]);
            self.samples.log_stretch[range.clone()].copy_from_slice(&ring.samples().log_stretch[range]);
        }
        // The values alone: a slide wants the memory of what the device holds.
        let nodes = base.and_then(nodes_of);
        (self.mark, self.base) = (Some(ring.mark()), nodes.map(|nodes| &nodes.table).or(base).cloned());
        let usable = self.objective.sieve(&self.samples).map_or(self.samples.len(), |usable| usable.len());
        Ok(Brought { usable, dropped: self.samples.len() - usable })
    }
    fn steps(&mut self, steps: &[PlannedStep]) -> Result<Vec<f64>, NotTaken> {
        self.there.call_for_room("taking steps")?;
        self.there.line.steps.fetch_add(steps.len(), Ordering::Relaxed);
        self.seconds += STEP_SECONDS * steps.len() as f64;
        let Self { fused, model, objective, average, samples, base, .. } = self;
        let (among, base) = (objective.sieve(samples), base.as_ref().map(|base| base as &dyn Field));
        let mut losses = Vec::new();
        fused.steps(model, objective, average, |done, loss| {
            losses.extend(loss);
            steps.get(done as usize).map(|step| Step::of(step, samples, among.as_deref(), base))
        });
        Ok(losses)
    }
    fn keep(&mut self) -> Result<(), NotTaken> {
        self.there.call_for_room("keeping a network")?;
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
    fn frozen(&self) -> Result<Arc<dyn OffloadedNetwork>, NotTaken> {
        self.there.call_for_room("freezing a network")?;
        let (mut model, average) = (self.model.clone(), &self.average);
        let tensor = |values: &Vec<f32>, shape: Vec<usize>| TensorData::new(values.clone(), shape);
        let tables = vec![model.shape.table_entries(), model.shape.features];
        model.module.tables =
            Some(Param::initialized(ParamId::new(), Tensor::from_data(tensor(&average.tables, tables), &Default::default())));
        let layers = tensor(&average.layers, vec![average.layers.len()]);
        model.module.layers = Param::initialized(ParamId::new(), Tensor::from_data(layers, &Default::default()));
        let there = Training { line: self.there.line.clone(), health: self.there.health.clone() };
        Ok(Arc::new(Frozen { there, model, average: average.clone(), objective: self.objective.clone() }))
    }
    fn fetch(&self, model: &mut Model, average: &mut Average) -> Result<(), DeviceLost> {
        self.there.call("fetching a network")?;
        (*model, *average) = (self.model.clone(), self.average.clone());
        Ok(())
    }
    fn copy(&mut self) -> Result<Copied, DeviceLost> {
        self.there.call("copying a network")?;
        if !self.there.line.room.load(Ordering::Relaxed) {
            return Ok(Copied::NoRoom("refused by the test".into()));
        }
        let there = Training { line: self.there.line.clone(), health: self.there.health.clone() };
        Ok(Copied::There(Box::new(Copy { there, model: self.model.clone(), average: self.average.clone() })))
    }
    fn device_seconds(&mut self) -> f64 {
        std::mem::take(&mut self.seconds)
    }
}

struct Copy {
    there: Training,
    model: Model,
    average: Average,
}

impl OffloadedCopy for Copy {
    fn read(self: Box<Self>, model: &mut Model, average: &mut Average) -> Result<(), DeviceLost> {
        let Line { slowness, moments, waited_for, .. } = &*self.there.line;
        let (before, begin) = (moments.load(Ordering::Relaxed), Instant::now());
        while moments.load(Ordering::Relaxed) < before + slowness.load(Ordering::Relaxed) {
            if begin.elapsed() > 2 * LONG {
                waited_for.fetch_add(1, Ordering::Relaxed);
                break;
            }
            std::thread::sleep(Duration::from_millis(1));
        }
        self.there.call("reading a copy")?;
        (*model, *average) = (self.model, self.average);
        Ok(())
    }
}

struct Frozen {
    there: Training,
    model: Model,
    average: Average,
    objective: Objective,
}

impl OffloadedNetwork for Frozen {
    fn predict(&self, points: &[[f32; 3]], _: [f32; 2], out: &mut [f32]) -> Result<(), NotTaken> {
        out.iter_mut().step_by(2).for_each(|s| *s = 7e7);
        let there = &self.there;
        there.health.ask_or("the CPU asked a network of the GPU's", || there.line.call("asking a network"))?;
        let (shape, scale) = (Arc::new(self.model.shape.clone()), &self.objective.scale);
        let flat: Vec<f32> = points.iter().flatten().copied().collect();
        let points = Tensor::<Flex, 2>::from_data(TensorData::new(flat, [points.len(), 3]), &Default::default());
        let outputs = self.model.module.forward_fused(&shape, points).into_data().to_vec::<f32>().unwrap();
        out.iter_mut().zip(outputs).for_each(|(out, output)| *out = output * scale.deviation[0] + scale.mean[0]);
        Ok(())
    }
    fn fetch(&self, into: &mut Average) -> Result<(), DeviceLost> {
        self.there.call("fetching a frozen network")?;
        *into = self.average.clone();
        Ok(())
    }
    fn as_any(&self) -> &dyn std::any::Any {
        self
    }
}

struct Render {
    line: Arc<Line>,
    /// The copy of a table below a network, where the host keeps it.
    below: Option<Held>,
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

/// The tracer, where it is one of this device's.
fn own(tracer: &dyn Tracer) -> Option<&Backed<Trace>> {
    tracer.as_any()?.downcast_ref()
}

impl DeviceRenderer for Render {
    fn let_go_of_tables(&mut self) {
        self.below = None;
    }

    fn audit(
        &mut self,
        request: &AuditRequest<'_>,
        tracer: &dyn Tracer,
        surrogate: &dyn Predict,
    ) -> Result<Option<AuditFindings>, DeviceError> {
        self.line.call("an audit")?;
        let Some(traces) = own(tracer) else { return Ok(None) };
        let Some(table) = surrogate.as_any().and_then(|any| any.downcast_ref::<Table>()) else { return Ok(None) };
        let Some(nodes) = nodes_of(table) else { return Ok(None) };
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
        let Some(traces) = own(tracer) else { return Ok(None) };
        let asked = answers.asked();
        let below = asked.surrogate.and_then(|surrogate| surrogate.network()?.base).filter(|(table, _)| nodes_of(table).is_none());
        self.below = below.map(|_| Held::new(&self.line));
        if asked.surrogate.is_some() || asked.keep > 1 {
            return Ok(None);
        }
        renderer.frame_setup(picture, 0..samples as u32)?;
        for wave in 0..3_u8 {
            self.line.call("a wave of a frame")?;
            if let Some(progress) = progress {
                progress(f32::from(wave) / 3.0);
            }
        }
        self.line.call("reading a film back")?;
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
