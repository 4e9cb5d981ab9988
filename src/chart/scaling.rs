//! Cost of a sample against the size of the task: tau, snapshots and nodes of the window, threads.

use super::ftle::Opened;
use super::slides::FirstSlides;
use super::{Charting, failed};
#[cfg(feature = "cuda")]
use crate::backend::cuda::Cuda;
use crate::backend::{Backend, BackendError, Cpu, Device, DeviceError, Surrogate as _, SurrogateRequest};
use crate::field::Window;
use crate::flow::{Extras, FlowMap, Steps, Traced, Tracer, VelocitySource};
use crate::run::RunError;
use crate::source::SourceKind;
use crate::surrogate::network::NetworkSettings;
use crate::surrogate::{Kind, Predict, SurrogateSettings, Trace};
use serde::{Deserialize, Serialize};
use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::time::Instant;

/// Points of a timed batch.
const BATCH: [usize; 2] = [1 << 16, 1 << 21];
/// Points on which windows, and tables and tracing, are compared.
const COMPARED: usize = 1 << 13;
/// Most bytes of a window of turbulence on finer grids, which is made for the chart alone.
const MOST_MADE: usize = 1 << 28;

/// What makes a task larger.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Axis {
    /// Duration of the integration.
    Tau,
    /// Snapshots in it.
    Snapshots,
    /// Nodes of the grid.
    Nodes,
    /// Threads of the CPU.
    Threads,
}

impl Axis {
    /// Its name.
    pub fn name(self) -> &'static str {
        match self {
            Self::Tau => "tau",
            Self::Snapshots => "snapshots",
            Self::Nodes => "nodes",
            Self::Threads => "threads",
        }
    }
}

/// Costs at one size of the task.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct ScalingPoint {
    /// What varies.
    pub axis: Axis,
    /// Value on the axis; of `nodes` the number of all nodes.
    pub value: f64,
    /// Steps that meet the tolerance.
    pub steps: usize,
    /// Nanoseconds of a traced sample.
    pub trace_ns: f64,
    /// Nanoseconds of a sample from a table.
    pub table_ns: f64,
    /// Seconds to trace the table.
    pub table_seconds: f64,
    /// Root mean square error of the FTLE from it, against that of the same tracing, 1/time; `None` in earlier charts, and if no
    /// point has a finite value.
    #[serde(default)]
    pub table_rms: Option<f64>,
    /// Samples from which on the table is cheaper, its tracing included; `None` if it never is.
    pub table_pays_from: Option<f64>,
    /// Of `snapshots`, and of `nodes` of one flow: root mean square difference of the FTLE from that of all of them, 1/time. `None` for all of them.
    pub rms: Option<f64>,
}

/// Costs against the size of the task.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct ScalingPanel {
    /// All sizes.
    pub points: Vec<ScalingPoint>,
}

/// Measures everything that there is time for.
pub(super) fn panel(charting: &mut Charting<'_>, opened: &Opened) -> Result<ScalingPanel, RunError> {
    let mut points = Vec::new();
    let tau = opened.plan.map.tau;
    // A window of snapshots ends after tau.
    let longest: &[f64] = if opened.shape().is_none() { &[0.25, 0.5, 1.0, 2.0] } else { &[0.25, 0.5, 1.0] };
    let mut whole = None;
    for factor in longest {
        let map = FlowMap { tau: tau * factor, ..opened.plan.map.clone() };
        let measured = point(charting, opened, &map, Axis::Tau, tau * factor)?;
        if *factor == 1.0 {
            whole.clone_from(&measured);
        }
        points.extend(measured);
    }
    // The scene as it is, on the other axes.
    let at = |axis, value| whole.clone().map(|point| ScalingPoint { axis, value, ..point });
    if let VelocitySource::Window(window) = &opened.slide.velocity {
        let count = window.snapshots().len();
        for stride in [4, 2].into_iter().filter(|stride| 2 * stride < count) {
            let thinned = window.thinned(stride, window.span().max(tau));
            let snapshots = thinned.snapshots().len() as f64;
            let other = opened.over(VelocitySource::Window(Arc::new(thinned)));
            let rms = Some(charting.pool.install(|| difference(opened, &other))?);
            points
                .extend(point(charting, &other, &opened.plan.map, Axis::Snapshots, snapshots)?.map(|point| ScalingPoint { rms, ..point }));
        }
        points.extend(at(Axis::Snapshots, count as f64));
        let nodes = opened.shape().unwrap_or([1; 3]);
        if charting.settings.source.kind == SourceKind::Turbulence {
            of_turbulence(charting, opened, nodes, count, &mut points)?;
        } else {
            of_coarser(charting, opened, window, &mut points)?;
        }
        points.extend(at(Axis::Nodes, nodes.iter().product::<usize>() as f64));
    }
    if !charting.device.is_gpu() {
        let all = charting.pool.current_num_threads();
        let mut numbers: Vec<usize> = (0..).map(|power| 1 << power).take_while(|n| *n < all).collect();
        numbers.push(all);
        for threads in numbers {
            let own = std::mem::replace(&mut charting.pool, rayon::ThreadPoolBuilder::new().num_threads(threads).build()?);
            let measured = point(charting, opened, &opened.plan.map, Axis::Threads, threads as f64);
            charting.pool = own;
            points.extend(measured?);
        }
    }
    Ok(ScalingPanel { points })
}

/// Turbulence on coarser and finer grids. Each is another flow, whose particles cross as many cells.
fn of_turbulence(
    charting: &mut Charting<'_>,
    opened: &Opened,
    nodes: [usize; 3],
    snapshots: usize,
    points: &mut Vec<ScalingPoint>,
) -> Result<(), RunError> {
    for factor in [0.25, 0.5, 2.0] {
        let other = nodes.map(|n| ((n as f64 * factor) as usize).max(4));
        let count = other.iter().product::<usize>();
        if factor > 1.0 && count.saturating_mul(snapshots * size_of::<[f32; 4]>()) > MOST_MADE {
            continue;
        }
        let mut settings = charting.settings.clone();
        settings.source.nodes = Some(other);
        let other = Opened::new(&settings, charting.device, &FirstSlides::read(&settings, 1, charting.stop)?)?;
        points.extend(point(charting, &other, &opened.plan.map, Axis::Nodes, count as f64)?);
    }
    Ok(())
}

/// The same flow with every fourth and every second node along each axis.
fn of_coarser(charting: &mut Charting<'_>, opened: &Opened, window: &Window, points: &mut Vec<ScalingPoint>) -> Result<(), RunError> {
    for stride in [4, 2] {
        let coarser = window.coarsened(stride);
        let Some(grid) = coarser.grid().cloned().filter(|grid| Some(grid.shape()) != opened.shape()) else { continue };
        let mut pair = [opened.over(opened.slide.velocity.clone()), opened.over(VelocitySource::Window(Arc::new(coarser)))];
        // Nodes that are left out may lie at an edge.
        pair.iter_mut().for_each(|opened| opened.plan.domain = grid.domain());
        let [whole, other] = pair;
        let rms = Some(charting.pool.install(|| difference(&whole, &other))?);
        let measured = point(charting, &other, &opened.plan.map, Axis::Nodes, grid.nodes() as f64)?;
        points.extend(measured.map(|point| ScalingPoint { rms, ..point }));
    }
    Ok(())
}

/// Root mean square difference of the FTLE in two windows, with as many steps, where both have one.
fn difference(whole: &Opened, thinned: &Opened) -> Result<f64, RunError> {
    let first = whole.on_cpu(&FlowMap { steps: whole.auto_steps(), ..whole.plan.map.clone() })?;
    let steps = if first.steps() > 0 { Steps::Fixed(first.steps()) } else { whole.plan.map.steps };
    let second = thinned.on_cpu(&FlowMap { steps, ..whole.plan.map.clone() })?;
    let (_, seeds) = whole.random_points(COMPARED);
    let stretch = |tracer: &dyn Tracer| {
        let mut traced = Traced::default();
        tracer.trace(&seeds, Extras::default(), &mut traced);
        traced.unrounded()
    };
    let (a, b) = (stretch(&*first), stretch(&*second));
    let squares: Vec<f64> = a.iter().zip(&b).map(|(a, b)| (a - b).powi(2)).filter(|square| square.is_finite()).collect();
    Ok((squares.iter().sum::<f64>() / squares.len().max(1) as f64).sqrt() / first.tau())
}

fn point(charting: &mut Charting<'_>, opened: &Opened, map: &FlowMap, axis: Axis, value: f64) -> Result<Option<ScalingPoint>, RunError> {
    let what = format!("cost at {} {value}", axis.name());
    if !charting.has_time_for(&what) {
        return Ok(None);
    }
    let affordable = 0.25 * charting.left();
    let measured = match charting.device {
        Device::Cpu { .. } => charting.pool.install(|| on(&mut Cpu, opened, map, false, affordable)),
        #[cfg(feature = "cuda")]
        Device::Cuda(device) => charting.pool.install(|| on(&mut Cuda::new(device), opened, map, true, affordable)),
    };
    match measured {
        Ok(Some(costs)) => Ok(Some(costs.at(axis, value))),
        Ok(None) => {
            charting.skip(what, format_args!("its table would take more than {affordable:.0} s"));
            Ok(None)
        }
        Err(error) => charting.refused(what, failed(error)).map(|()| None),
    }
}

struct Costs {
    steps: usize,
    trace: f64,
    table: f64,
    table_seconds: f64,
    table_rms: Option<f64>,
}

impl Costs {
    fn at(&self, axis: Axis, value: f64) -> ScalingPoint {
        let saved = self.trace - self.table;
        ScalingPoint {
            axis,
            value,
            steps: self.steps,
            trace_ns: 1e9 * self.trace,
            table_ns: 1e9 * self.table,
            table_seconds: self.table_seconds,
            table_rms: self.table_rms,
            table_pays_from: (saved > 0.0).then(|| self.table_seconds / saved),
            rms: None,
        }
    }
}

/// Seconds of a sample, the median of three batches.
fn median(samples: usize, mut seconds: impl FnMut() -> Result<f64, DeviceError>) -> Result<f64, BackendError> {
    let mut three = [seconds()?, seconds()?, seconds()?];
    three.sort_unstable_by(f64::total_cmp);
    Ok(three[1] / samples as f64)
}

/// `None` if the table would take longer than `affordable` seconds.
fn on<B: Backend>(backend: &mut B, opened: &Opened, map: &FlowMap, is_gpu: bool, affordable: f64) -> Result<Option<Costs>, BackendError> {
    static NEVER: AtomicBool = AtomicBool::new(false);
    let chosen = FlowMap { steps: opened.auto_steps(), ..map.clone() };
    let tracer = backend.tracer(&opened.slide.velocity, &chosen, opened.slide.time)?;
    let batch = BATCH[usize::from(is_gpu)];
    let (unit, seeds) = opened.random_points(batch);
    let mut traced = Traced::default();
    let trace = median(batch, || tracer.seconds(&seeds, &mut traced))?;
    let nodes = opened.own_nodes(is_gpu);
    if trace * nodes.iter().product::<usize>() as f64 > affordable {
        return Ok(None);
    }
    let request = SurrogateRequest {
        settings: &SurrogateSettings { kind: Kind::Table, table_nodes: Some(nodes), ..SurrogateSettings::default() },
        network: &NetworkSettings::default(),
        domain: &opened.plan.domain,
        seed: opened.plan.scene.seed,
        replay_buffer: 1 << 10,
        stop: &NEVER,
    };
    let began = Instant::now();
    let surrogate = backend.surrogate(&request, &tracer)?;
    let table_seconds = began.elapsed().as_secs_f64();
    let frozen = surrogate.freeze()?;
    let mut values = vec![0.0; batch];
    let table = median(batch, || frozen.seconds(&unit, &mut values))?;
    // Batches that were timed stay on a device.
    tracer.trace(&seeds[..COMPARED], Extras::default(), &mut traced)?;
    frozen.predict(&unit[..COMPARED], &mut values[..COMPARED])?;
    let squares = traced.log_stretch.iter().zip(&values).map(|(a, b)| f64::from(a - b).powi(2)).filter(|square| square.is_finite());
    let (sum, count) = squares.fold((0.0, 0_usize), |(sum, count), square| (sum + square, count + 1));
    let table_rms = (count > 0).then(|| (sum / count as f64).sqrt() / tracer.flow().tau());
    Ok(Some(Costs { steps: tracer.flow().steps(), trace, table, table_seconds, table_rms }))
}
