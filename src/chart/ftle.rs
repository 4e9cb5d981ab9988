//! Errors and costs of FTLE samples: tracing over steps, gaps and tolerances, composed flow maps, tables, and networks.

use super::networks::networks;
use super::slides::FirstSlides;
use super::{Charting, device_name, failed, front, pick, with_method};
use crate::backend::{Backend, Cpu, Device, Surrogate, SurrogateRequest};
#[cfg(feature = "cuda")]
use crate::backend::{CudaDevice, Storage, cuda::Cuda};
use crate::field::{DomainPoint, UnitPoint};
use crate::flow::{
    Composition, Extras, FlowMap, Integrator, Precision, Steps, Traced, Tracer, VelocitySource, cpu_tracer, dormand_prince_tracer,
};
use crate::render::Method;
use crate::render::rng::{philox, unit};
use crate::run::{Plan, RunError, Settings, Setup, Slide, auto_steps};
use crate::surrogate::network::NetworkSettings;
use crate::surrogate::{Kind, MAX_DEVICE_NODES, MAX_OWN_NODES, Predict, SurrogateSettings, Trace};
use serde::{Deserialize, Serialize};
use std::ops::Range;
use std::sync::atomic::AtomicBool;
use std::time::Instant;

static NEVER: AtomicBool = AtomicBool::new(false);

/// Numbers of samples for which building is charged.
pub(super) const CHARGED: [f64; 3] = [1e6, 1e9, 1e11];
/// Most points on which errors are measured.
const MAX_POINTS: usize = 1 << 20;
/// Fewest of them.
const MIN_POINTS: usize = 1 << 10;
/// Share of the panel's time for the truth.
const TRUTH_SHARE: f64 = 0.2;
/// Share of what is left of a GPU's time for networks, before what runs on the CPU.
#[cfg(feature = "cuda")]
const NETWORKS_SHARE: f64 = 0.75;
/// Seconds over which the speed of a method is measured.
const TIMED: f64 = 0.25;
/// Fewest points of a timed batch, and most on the CPU and on a GPU.
pub(super) const MIN_BATCH: usize = 1 << 12;
const MAX_BATCH: [usize; 2] = [1 << 20, 1 << 23];
/// What is said of methods that ran on the CPU in a chart of a GPU.
#[cfg(feature = "cuda")]
const ON_THE_CPU: &str = ", on the CPU";

/// A method with a setting.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct FtlePoint {
    /// Family, as in the legend.
    pub method: String,
    /// Setting within the family.
    pub setting: String,
    /// Root mean square error of the FTLE, 1/time.
    #[serde(deserialize_with = "super::number_or_nan")]
    pub rms: f64,
    /// 99th percentile of the absolute error, 1/time.
    #[serde(deserialize_with = "super::number_or_nan")]
    pub p99: f64,
    /// PSNR in decibels with the largest true FTLE as peak; `None` if the error or the peak is 0.
    pub psnr: Option<f64>,
    /// FTLE samples per second in large batches, building not counted.
    pub samples_per_second: f64,
    /// Seconds to build, including the tracing of labels and training.
    pub build_seconds: f64,
    /// Bytes that a sample may read: the window of velocities, the table, the weights. 0 for closed forms.
    pub bytes: u64,
    /// Points whose FTLE is finite in the truth and not here; they are left out of the errors.
    pub failed: usize,
}

impl FtlePoint {
    /// True if at most a thousandth of the points failed. Others are on no front, whatever the error at the points that are left.
    pub fn is_sound(&self, points: usize) -> bool {
        self.failed * 1000 <= points
    }

    /// Seconds of `samples` samples, building included.
    pub fn seconds(&self, samples: f64) -> f64 {
        self.build_seconds + samples / self.samples_per_second
    }
}

/// Errors and costs of FTLE samples.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct FtlePanel {
    /// Points on which errors are measured.
    pub points: usize,
    /// Integrator of the truth.
    pub truth: String,
    /// Root mean square of the true FTLE, 1/time.
    pub truth_rms: f64,
    /// Error of the FTLE that the tolerance allows: `trust.tolerance` of the colour ramp, 1/time.
    pub tolerance: f64,
    /// Steps that the program chooses; `None` if the scene gives them.
    pub chosen_steps: Option<usize>,
    /// All methods and settings.
    pub methods: Vec<FtlePoint>,
    /// Pareto fronts of error and seconds, building included.
    pub fronts: Vec<Front>,
}

/// The methods that no other beats in error and seconds at once.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct Front {
    /// Number of samples.
    pub samples: f64,
    /// Places in the list of methods, from the cheapest to the most exact.
    pub methods: Vec<usize>,
    /// Place of the cheapest within the tolerance; `None` if none is.
    pub pick: Option<usize>,
}

impl FtlePanel {
    /// Places of the methods on the front of error and cost, and that of the cheapest within the tolerance.
    pub(super) fn front(&self, cost: impl Fn(&FtlePoint) -> f64) -> (Vec<usize>, Option<usize>) {
        // Points that fail are on no front.
        let error = |point: &FtlePoint| if point.is_sound(self.points) { point.rms } else { f64::INFINITY };
        let at: Vec<[f64; 2]> = self.methods.iter().map(|point| [cost(point), error(point)]).collect();
        (front(&at), pick(&at, self.tolerance))
    }
}

/// The first slide of a scene.
pub(super) struct Opened {
    pub(super) plan: Plan,
    pub(super) slide: Slide,
    pub(super) device_name: String,
    /// Snapshot intervals in tau, or 10 for closed forms.
    pub(super) intervals: usize,
    /// Bytes of the window of velocities.
    window_bytes: u64,
}

impl Opened {
    /// The same with another velocity.
    pub(super) fn over(&self, velocity: VelocitySource) -> Self {
        let (plan, slide, device_name) = (self.plan.clone(), Slide { velocity, ..self.slide.clone() }, self.device_name.clone());
        Self { plan, slide, device_name, ..*self }
    }

    pub(super) fn new(settings: &Settings, device: &Device, slides: &FirstSlides) -> Result<Self, RunError> {
        /// Intervals of a composed flow map of a closed form.
        const CLOSED: usize = 10;
        // The method of the scene plays no part.
        let plan = Setup::new(with_method(&slides.settled(settings), Method::TwoLevel, settings.surrogate.kind))?.plan;
        let slide = slides.first().clone();
        let (intervals, window_bytes) = match &slide.velocity {
            VelocitySource::Analytic(..) => (CLOSED, 0),
            VelocitySource::Window(window) => {
                let [from, to] = [slide.time, slide.time + plan.map.direction.sign() * plan.map.tau];
                let slack = 1e-9 * plan.map.tau;
                let within = |time: f64| time > from.min(to) + slack && time < from.max(to) - slack;
                let inner = window.snapshots().filter(|snapshot| within(snapshot.time)).count();
                (inner + 1, window.bytes() as u64)
            }
        };
        Ok(Self { plan, slide, device_name: device_name(device), intervals, window_bytes })
    }

    /// Nodes of the grid of the velocity; `None` for closed forms.
    pub(super) fn shape(&self) -> Option<[usize; 3]> {
        match &self.slide.velocity {
            VelocitySource::Window(window) => window.grid().map(|grid| grid.shape()),
            VelocitySource::Analytic(..) => None,
        }
    }

    /// Nodes of a table at the resolution of the data, or as the program chooses for closed forms.
    pub(super) fn own_nodes(&self, is_gpu: bool) -> [usize; 3] {
        let most = if is_gpu { MAX_DEVICE_NODES } else { MAX_OWN_NODES };
        let open = SurrogateSettings { kind: Kind::Table, ..SurrogateSettings::default() };
        let shaped = self.shape().map_or(open.clone(), |shape| open.at_resolution_of(shape, most));
        shaped.nodes(&self.plan.domain).unwrap_or([64; 3])
    }

    /// Steps chosen by their error, also if the scene gives their number.
    pub(super) fn auto_steps(&self) -> Steps {
        match self.plan.map.steps {
            Steps::Fixed(_) => auto_steps(self.shape().is_some(), self.plan.map.interpolation),
            auto => auto,
        }
    }

    /// Steps that the log-stretch asks for, also if the scene gives their number; `None` if the flow is integrated without a choice.
    pub(super) fn chosen_steps(&self, pool: &rayon::ThreadPool) -> Result<Option<usize>, RunError> {
        let auto = FlowMap { steps: self.auto_steps(), ..self.plan.map.clone() };
        Ok(pool.install(|| self.on_cpu(&auto))?.step_choice().map(|choice| choice.steps))
    }

    /// Uniform random points in unit and in domain coordinates; in two dimensions all lie in the middle of the slab.
    pub(super) fn random_points(&self, count: usize) -> (Vec<UnitPoint>, Vec<DomainPoint>) {
        let Points { unit, domain } = Points::random(self, count, 5);
        (unit, domain)
    }

    /// A tracer of the CPU.
    pub(super) fn on_cpu(&self, map: &FlowMap) -> Result<Box<dyn Tracer>, RunError> {
        cpu_tracer(self.slide.velocity.clone(), map, self.slide.time).map_err(RunError::Flow)
    }
}

/// Points in unit and in domain coordinates.
pub(super) struct Points {
    pub(super) unit: Vec<UnitPoint>,
    domain: Vec<DomainPoint>,
}

impl Points {
    /// The first uniform random points of a stream; in two dimensions all lie in the middle of the slab.
    pub(super) fn random(opened: &Opened, count: usize, stream: u32) -> Self {
        Self::numbered(opened, 0..count as u32, stream)
    }

    pub(super) fn numbered(opened: &Opened, numbers: Range<u32>, stream: u32) -> Self {
        let (seed, domain) = (opened.plan.scene.seed, &opened.plan.domain);
        let unit: Vec<UnitPoint> = numbers
            .map(|i| {
                let words = philox([i, stream, 0, 0], [seed as u32, (seed >> 32) as u32]);
                UnitPoint(std::array::from_fn(|axis| if axis < domain.dimensions { unit(words[axis]) } else { 0.5 }))
            })
            .collect();
        let domain = unit.iter().map(|&point| domain.from_unit(point)).collect();
        Self { unit, domain }
    }

    fn first(&self, count: usize) -> (&[UnitPoint], &[DomainPoint]) {
        let count = count.min(self.unit.len());
        (&self.unit[..count], &self.domain[..count])
    }
}

/// Points with their true FTLE, and what is measured on them.
pub(super) struct Bench<'a, 'b> {
    pub(super) charting: &'a mut Charting<'b>,
    pub(super) opened: &'a Opened,
    points: Points,
    truth: Vec<f64>,
    timed: Points,
    /// Bytes of the window as the backend in use stores it.
    window_bytes: u64,
    /// Nodes that are traced a second; `None`: as many as the chosen steps trace samples.
    nodes_per_second: Option<f64>,
    found: Vec<FtlePoint>,
}

/// What is known of a method before it is measured.
struct Built {
    seconds: f64,
    bytes: u64,
}

impl Bench<'_, '_> {
    /// Nodes are traced by this tracer of the CPU from now on.
    #[cfg(feature = "cuda")]
    fn time_nodes_by(&mut self, tracer: &dyn Tracer) {
        let (_, seeds) = self.timed.first(MIN_BATCH);
        let mut traced = Traced::default();
        let began = Instant::now();
        self.charting.pool.install(|| tracer.trace(seeds, Extras::default(), &mut traced));
        self.nodes_per_second = Some(seeds.len() as f64 / began.elapsed().as_secs_f64());
    }

    /// Measures error and speed of a method. `answer` gives the log-stretch at points, `seconds` the time that points take.
    fn measure(
        &mut self,
        method: &str,
        setting: String,
        built: Built,
        answer: impl FnOnce(&Points) -> Result<Vec<f64>, RunError> + Send,
        seconds: impl FnMut(&[UnitPoint], &[DomainPoint]) -> Result<f64, RunError> + Send,
    ) -> Result<(), RunError> {
        let tau = self.opened.plan.map.tau;
        let Self { charting, points, truth, timed, .. } = self;
        let (values, samples_per_second) = charting.pool.install(|| Ok::<_, RunError>((answer(points)?, speed(timed, seconds)?)))?;
        let mut errors: Vec<f64> = Vec::with_capacity(truth.len());
        let (mut failed, mut peak) = (0, 0.0_f64);
        for (value, truth) in values.iter().zip(truth.iter()) {
            let error = (value / tau - truth).abs();
            if error.is_finite() {
                errors.push(error);
                peak = peak.max(*truth);
            } else if truth.is_finite() {
                failed += 1;
            }
        }
        if errors.is_empty() {
            self.charting.skip(format_args!("{method}, {setting}"), "no point has a finite value");
            return Ok(());
        }
        errors.sort_unstable_by(f64::total_cmp);
        let rms = (errors.iter().map(|error| error * error).sum::<f64>() / errors.len() as f64).sqrt();
        self.found.push(FtlePoint {
            method: method.to_owned(),
            setting,
            rms,
            p99: errors[(errors.len() - 1) * 99 / 100],
            psnr: (rms > 0.0 && peak > 0.0).then(|| 20.0 * (peak / rms).log10()),
            samples_per_second,
            build_seconds: built.seconds,
            bytes: built.bytes,
            failed,
        });
        Ok(())
    }

    /// Measures a tracer of any device.
    fn measure_tracer(&mut self, method: &str, setting: String, tracer: &dyn Trace) -> Result<(), RunError> {
        let built = Built { seconds: 0.0, bytes: self.window_bytes };
        let answer = |points: &Points| {
            let mut traced = Traced::default();
            tracer.trace(&points.domain, Extras::default(), &mut traced).map_err(failed)?;
            Ok(traced.unrounded())
        };
        let mut traced = Traced::default();
        self.measure(method, setting, built, answer, |_, seeds| tracer.seconds(seeds, &mut traced).map_err(failed))
    }

    pub(super) fn measure_predictor(
        &mut self,
        method: &str,
        setting: String,
        seconds: f64,
        surrogate: &dyn Predict,
    ) -> Result<(), RunError> {
        let built = Built { seconds, bytes: surrogate.bytes() as u64 };
        let answer = |points: &Points| {
            let mut values = vec![0.0; points.unit.len()];
            surrogate.predict(&points.unit, &mut values).map_err(failed)?;
            Ok(values.into_iter().map(f64::from).collect())
        };
        let mut values = vec![0.0; self.timed.unit.len()];
        self.measure(method, setting, built, answer, |unit, _| surrogate.seconds(unit, &mut values[..unit.len()]).map_err(failed))
    }
}

/// Samples per second: the median of three batches, after batches that grow until one takes long enough to be timed.
fn speed(timed: &Points, mut seconds: impl FnMut(&[UnitPoint], &[DomainPoint]) -> Result<f64, RunError>) -> Result<f64, RunError> {
    let mut batch = MIN_BATCH;
    let mut time = |batch: usize| {
        let (unit, domain) = timed.first(batch);
        Ok::<_, RunError>(seconds(unit, domain)? / unit.len() as f64)
    };
    let mut seconds = time(batch)?;
    while seconds * (batch as f64) < TIMED / 3.0 && batch < timed.unit.len() {
        batch *= 2;
        seconds = time(batch)?;
    }
    let mut three = [seconds, time(batch)?, time(batch)?];
    three.sort_unstable_by(f64::total_cmp);
    Ok(1.0 / three[1])
}

/// Makes the truth and measures everything that there is time for.
pub(super) fn panel(charting: &mut Charting<'_>, opened: &Opened) -> Result<FtlePanel, RunError> {
    (charting.tell)("the truth: Dormand-Prince in f64");
    let truth_map = FlowMap { integrator: Integrator::DormandPrince, precision: Precision::F64, ..opened.plan.map.clone() };
    let truth_tracer = opened.on_cpu(&truth_map)?;
    let (points, truth) = charting.pool.install(|| truth(opened, &*truth_tracer, TRUTH_SHARE * charting.left()));
    let known: Vec<f64> = truth.iter().copied().filter(|f| f.is_finite()).collect();
    let truth_rms = (known.iter().map(|f| f * f).sum::<f64>() / known.len().max(1) as f64).sqrt();
    let ramp = ramp(opened, &known);
    let chosen_steps = opened.chosen_steps(&charting.pool)?;
    let timed = Points::random(opened, MAX_BATCH[usize::from(charting.device.is_gpu())], 1);
    let mut bench =
        Bench { charting, opened, points, truth, timed, window_bytes: opened.window_bytes, nodes_per_second: None, found: Vec::new() };
    let steps = chosen_steps.or(match opened.plan.map.steps {
        Steps::Fixed(steps) => Some(steps),
        Steps::Auto { .. } | Steps::AutoByShare { .. } => None,
    });
    let steps = steps.unwrap_or(100);
    match bench.charting.device {
        Device::Cpu { .. } => {
            tracing(&mut bench, &mut Cpu, steps, "")?;
            tables(&mut bench, &mut Cpu)?;
            differences(&mut bench, &mut Cpu, steps)?;
            composed(&mut bench, steps, "")?;
            adaptive(&mut bench, "")?;
            networks(&mut bench, &mut Cpu)?;
        }
        #[cfg(feature = "cuda")]
        Device::Cuda(device) => {
            let mut backend = Cuda::new(&CudaDevice { storage: Some(Storage::F32), ..device.clone() });
            tracing(&mut bench, &mut backend, steps, "")?;
            // A closed form has no snapshots to store.
            if opened.window_bytes > 0 {
                for (storage, name) in [(Storage::F16, ", f16 storage"), (Storage::F16Pairs, ", f16 pairs")] {
                    let mut half = Cuda::new(&CudaDevice { storage: Some(storage), ..device.clone() });
                    bench.window_bytes = opened.window_bytes / Storage::F32.bytes() * storage.bytes();
                    tracing(&mut bench, &mut half, steps, name)?;
                }
                bench.window_bytes = opened.window_bytes;
            }
            tables(&mut bench, &mut backend)?;
            differences(&mut bench, &mut backend, steps)?;
            let whole = bench.charting.begin_share(NETWORKS_SHARE);
            networks(&mut bench, &mut backend)?;
            bench.charting.ends = whole;
            // They have no kernels.
            let chosen = FlowMap { steps: Steps::Fixed(steps), ..opened.plan.map.clone() };
            bench.time_nodes_by(&*opened.on_cpu(&chosen)?);
            composed(&mut bench, steps, ON_THE_CPU)?;
            adaptive(&mut bench, ON_THE_CPU)?;
        }
    }
    let mut panel = FtlePanel {
        points: bench.points.unit.len(),
        truth: "Dormand-Prince 5(4), f64, tolerance 1e-10".into(),
        truth_rms,
        tolerance: opened.plan.scene.trust.tolerance * ramp,
        chosen_steps,
        methods: bench.found,
        fronts: Vec::new(),
    };
    for samples in CHARGED {
        let (methods, pick) = panel.front(|point| point.seconds(samples));
        panel.fronts.push(Front { samples, methods, pick });
    }
    Ok(panel)
}

/// Range of the FTLE over the colour ramp: that of the scene, or as the program would choose it.
fn ramp(opened: &Opened, ftle: &[f64]) -> f64 {
    let values: Vec<f32> = ftle.iter().map(|f| *f as f32).collect();
    let scaled = opened.plan.scene.transfer.clone().unwrap_or_default().scaled_to(&values);
    scaled.high.unwrap_or(1.0) - scaled.low.unwrap_or(0.0)
}

/// Points and their true FTLE: as many as the truth integrates in `seconds`. NaN at points without a velocity.
fn truth(opened: &Opened, tracer: &dyn Tracer, seconds: f64) -> (Points, Vec<f64>) {
    let mut traced = Traced::default();
    let probe = Points::random(opened, MIN_POINTS, 2);
    let began = Instant::now();
    tracer.trace(&probe.domain, Extras::default(), &mut traced);
    let affordable = seconds * MIN_POINTS as f64 / began.elapsed().as_secs_f64();
    let points = Points::random(opened, (affordable as usize).clamp(MIN_POINTS, MAX_POINTS), 0);
    tracer.trace(&points.domain, Extras::default(), &mut traced);
    let ftle = |(s, seed): (&f64, &DomainPoint)| if tracer.is_missing(*seed) { f64::NAN } else { s / tracer.tau() };
    let truth = traced.log_stretch_f64.iter().zip(&points.domain).map(ftle).collect();
    (points, truth)
}

/// A tracer of the backend. Combinations that it does not have are noted, and give `None`.
pub(super) fn tracer_of<B: Backend>(
    bench: &mut Bench<'_, '_>,
    backend: &mut B,
    what: &str,
    map: &FlowMap,
) -> Result<Option<B::Tracer>, RunError> {
    if !bench.charting.has_time_for(what) {
        return Ok(None);
    }
    let (velocity, time) = (&bench.opened.slide.velocity, bench.opened.slide.time);
    match bench.charting.pool.install(|| backend.tracer(velocity, map, time)) {
        Ok(tracer) => Ok(Some(tracer)),
        Err(error) => bench.charting.refused(what, failed(error)).map(|()| None),
    }
}

/// The tangent flow over numbers of steps.
fn tracing<B: Backend>(bench: &mut Bench<'_, '_>, backend: &mut B, steps: usize, storage: &str) -> Result<(), RunError> {
    let plan = &bench.opened.plan.map;
    let sweep = |precision: Precision, factors: &[f64]| -> Vec<FlowMap> {
        let mut numbers = Vec::new();
        for factor in factors {
            let n = ((steps as f64 * factor).round() as usize).max(1);
            if !numbers.contains(&n) {
                numbers.push(n);
            }
        }
        let map = |n| FlowMap { integrator: Integrator::Tangent, precision, steps: Steps::Fixed(n), ..plan.clone() };
        numbers.into_iter().map(map).collect()
    };
    let mut maps = sweep(Precision::F32, &[1.0, 0.5, 2.0, 0.25, 4.0, 0.125]);
    maps.extend(sweep(Precision::F64, &[1.0, 4.0]));
    for map in maps {
        let Steps::Fixed(n) = map.steps else { continue };
        let (precision, name) = if map.precision == Precision::F32 { ("f32", "tangent RK4, f32") } else { ("f64", "tangent RK4, f64") };
        let what = format!("tangent RK4, {precision}{storage}, {n} steps");
        if let Some(tracer) = tracer_of(bench, backend, &what, &map)? {
            bench.measure_tracer(&format!("{name}{storage}"), format!("{n} steps"), &tracer)?;
        }
    }
    Ok(())
}

/// Central differences over gaps, the published method.
fn differences<B: Backend>(bench: &mut Bench<'_, '_>, backend: &mut B, steps: usize) -> Result<(), RunError> {
    let plan = bench.opened.plan.map.clone();
    let extent = bench.opened.plan.domain.extent();
    let longest = extent[..bench.opened.plan.domain.dimensions.min(3)].iter().copied().fold(0.0, f64::max);
    for (precision, name) in [(Precision::F32, "differences, f32"), (Precision::F64, "differences, f64")] {
        for exponent in [-4, -3, -5, -2, -6, -8] {
            let gap = longest * 10f64.powi(exponent);
            let what = format!("{name}, gap 1e{exponent} of the domain");
            let map = FlowMap {
                integrator: Integrator::Differences,
                precision,
                difference_step: gap,
                steps: Steps::Fixed(steps),
                ..plan.clone()
            };
            if let Some(tracer) = tracer_of(bench, backend, &what, &map)? {
                bench.measure_tracer(name, format!("gap 1e{exponent}"), &tracer)?;
            }
        }
    }
    Ok(())
}

/// Dormand-Prince over tolerances, on the CPU.
fn adaptive(bench: &mut Bench<'_, '_>, place: &str) -> Result<(), RunError> {
    for tolerance in [1e-4, 1e-2, 1e-6, 1e-8] {
        if bench.charting.has_time_for(&format!("Dormand-Prince, tolerance {tolerance:e}")) {
            let (velocity, map, time) = (bench.opened.slide.velocity.clone(), &bench.opened.plan.map, bench.opened.slide.time);
            let tracer = dormand_prince_tracer(velocity, map, time, tolerance).map_err(RunError::Flow)?;
            bench.measure_tracer(&format!("Dormand-Prince, f64{place}"), format!("tolerance {tolerance:e}"), &tracer)?;
        }
    }
    Ok(())
}

/// Composed flow maps, plain and joined, over resolutions, on the CPU.
fn composed(bench: &mut Bench<'_, '_>, steps: usize, place: &str) -> Result<(), RunError> {
    let own = bench.opened.own_nodes(false);
    let intervals = bench.opened.intervals;
    let (velocity, map, time) = (&bench.opened.slide.velocity, &bench.opened.plan.map, bench.opened.slide.time);
    let Some(values) = Composition::values_per_node(velocity, map) else {
        bench.charting.skip("composition", "not with axes that wrap, flow.boundary = \"zero\", or flow.normalisation = \"lifetime\"");
        return Ok(());
    };
    for factor in [0.5, 1.0, 2.0] {
        let nodes = scaled(own, factor);
        let what = format!("composition, {} nodes", shape(nodes));
        let count = nodes.iter().product::<usize>();
        // Joining keeps half as many tables beside the others, and then a quarter.
        let tables = intervals + intervals.div_ceil(2) + intervals.div_ceil(4);
        if !fits(bench, &what, count, values * count * tables) {
            continue;
        }
        let began = Instant::now();
        let per_interval = steps.div_ceil(intervals);
        let built = bench.charting.pool.install(|| Composition::trace(velocity, map, time, nodes, intervals, per_interval));
        let Some(plain) = built.map_err(RunError::Flow)? else { continue };
        let plain_seconds = began.elapsed().as_secs_f64();
        let joined = bench.charting.pool.install(|| plain.joined());
        let joined_seconds = began.elapsed().as_secs_f64();
        for (name, composition, seconds) in [("composition", &plain, plain_seconds), ("composition, hierarchical", &joined, joined_seconds)]
        {
            let built = Built { seconds, bytes: composition.bytes() as u64 };
            let of = |unit: &[UnitPoint]| {
                let mut values = vec![0.0; unit.len()];
                composition.log_stretch(unit, &mut values);
                values
            };
            let seconds = |unit: &[UnitPoint], _: &[DomainPoint]| {
                let began = Instant::now();
                of(unit);
                Ok(began.elapsed().as_secs_f64())
            };
            bench.measure(&format!("{name}{place}"), format!("{} nodes", shape(nodes)), built, |points| Ok(of(&points.unit)), seconds)?;
        }
    }
    Ok(())
}

/// Tables over resolutions.
fn tables<B: Backend>(bench: &mut Bench<'_, '_>, backend: &mut B) -> Result<(), RunError> {
    let map = bench.opened.plan.map.clone();
    let Some(tracer) = tracer_of(bench, backend, "the tracer of tables", &map)? else { return Ok(()) };
    let own = bench.opened.own_nodes(bench.charting.device.is_gpu());
    // The first table compiles kernels.
    let small = SurrogateSettings { kind: Kind::Table, table_nodes: Some(own.map(|n| n.min(8))), ..SurrogateSettings::default() };
    surrogate_of(bench, backend, "a small table", &small, &NetworkSettings::default(), &tracer)?;
    for factor in [1.0, 0.5, 2.0, 0.25, 4.0] {
        let nodes = scaled(own, factor);
        let what = format!("table of {} nodes", shape(nodes));
        let count = nodes.iter().product();
        if !fits(bench, &what, count, count) {
            continue;
        }
        let settings = SurrogateSettings { kind: Kind::Table, table_nodes: Some(nodes), ..SurrogateSettings::default() };
        let network = NetworkSettings::default();
        let began = Instant::now();
        if let Some(surrogate) = surrogate_of(bench, backend, &what, &settings, &network, &tracer)? {
            let frozen = surrogate.freeze().map_err(failed)?;
            bench.measure_predictor("table", format!("{} nodes", shape(nodes)), began.elapsed().as_secs_f64(), &frozen)?;
        }
    }
    Ok(())
}

/// Builds a surrogate on the backend; settings that it refuses are noted.
pub(super) fn surrogate_of<B: Backend>(
    bench: &mut Bench<'_, '_>,
    backend: &mut B,
    what: &str,
    settings: &SurrogateSettings,
    network: &NetworkSettings,
    tracer: &B::Tracer,
) -> Result<Option<B::Surrogate>, RunError> {
    let plan = &bench.opened.plan;
    let request = SurrogateRequest {
        settings,
        network,
        domain: &plan.domain,
        seed: plan.scene.seed,
        replay_buffer: plan.scene.training.replay_buffer,
        stop: &NEVER,
    };
    match bench.charting.pool.install(|| backend.surrogate(&request, tracer)) {
        Ok(surrogate) => Ok(Some(surrogate)),
        Err(error) => bench.charting.refused(what, failed(error)).map(|()| None),
    }
}

pub(super) fn scaled(nodes: [usize; 3], factor: f64) -> [usize; 3] {
    nodes.map(|n| if n > 1 { ((n as f64 * factor) as usize).max(2) } else { 1 })
}

fn shape(nodes: [usize; 3]) -> String {
    let used: Vec<String> = nodes.iter().filter(|n| **n > 1).map(ToString::to_string).collect();
    used.join("x")
}

/// True if so many nodes can be traced in a quarter of the time that is left, and so many values fit into memory.
pub(super) fn fits(bench: &mut Bench<'_, '_>, what: &str, nodes: usize, values: usize) -> bool {
    /// 2 GiB of f32.
    const MAX_VALUES: usize = 1 << 29;
    if !bench.charting.has_time_for(what) {
        return false;
    }
    // The first one has the chosen steps.
    let chosen = bench.found.iter().find(|point| point.method.starts_with("tangent")).map_or(1e4, |point| point.samples_per_second);
    let traced = bench.nodes_per_second.unwrap_or(chosen);
    let seconds = nodes as f64 / traced;
    if values > MAX_VALUES {
        bench.charting.skip(what, format_args!("it would take {:.1} GiB", values as f64 / f64::from(1 << 28)));
        return false;
    }
    if seconds > 0.25 * bench.charting.left() {
        bench.charting.skip(what, format_args!("it would take {seconds:.0} s to trace, of {:.0} s left", bench.charting.left()));
        return false;
    }
    true
}
