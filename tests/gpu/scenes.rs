//! Flows that the tests trace, and the two ways to trace them.

use crate::kit::scene;
use ridgewatch::backend::cuda::{CudaTracer, CudaTraining, Gpu, GpuSettings, OnGpu, SnapshotStore, Storage, Tuning};
use ridgewatch::backend::{CudaDevice, Device, WhenLost};
use ridgewatch::field::turbulence::Turbulence;
use ridgewatch::field::{Axis, Domain, Geometry, Grid, Snapshot, Window};
use ridgewatch::field::{DomainPoint, UnitPoint, analytic::Analytic};
use ridgewatch::flow::{
    Boundary, Direction, Extras, FlowMap, Integrator, Interpolation, Normalisation, Precision, Steps, Traced, VelocitySource, cpu_tracer,
};
use ridgewatch::run::{Frame, FrameRecord, RunOptions, Setup};
use ridgewatch::surrogate::network::NetworkSettings;
use ridgewatch::surrogate::{HostNetwork, Hybrid, Kind, Trace};
use std::collections::hash_map::RandomState;
use std::hash::{BuildHasher, Hasher};
use std::sync::{Arc, OnceLock};

/// The device that tests share.
pub fn gpu() -> Arc<Gpu> {
    static GPU: OnceLock<Arc<Gpu>> = OnceLock::new();
    GPU.get_or_init(|| opened(GpuSettings::default())).clone()
}

/// A handle of its own, for tests that count memory. Fresh device memory makes NaN here, so that what nothing has written shows.
pub fn opened(settings: GpuSettings) -> Arc<Gpu> {
    Gpu::open(0, &GpuSettings { poison: true, ..settings }).unwrap()
}

/// A device for whole runs.
pub fn device(settings: GpuSettings) -> Device {
    device_when_lost(settings, WhenLost::Cpu)
}

/// A device for whole runs that may lose it.
pub fn device_when_lost(settings: GpuSettings, when_lost: WhenLost) -> Device {
    Device::Cuda(CudaDevice { gpu: opened(settings), storage: Some(Storage::F32), when_lost, may_fall_back: false })
}

/// A surrogate whose table and network are on the device.
pub fn resident(gpu: &Arc<Gpu>, kind: Kind, nodes: [usize; 3], network: &NetworkSettings, tracer: &CudaTracer) -> Hybrid<OnGpu> {
    let training = |model| CudaTraining::new(gpu, HostNetwork::fresh(model), true);
    Hybrid::<OnGpu>::new(kind, nodes, network, 5, tracer, training).unwrap().unwrap()
}

/// Warnings of a record, without that of few audit points, which small scenes have.
pub fn warnings(record: &FrameRecord) -> Vec<&str> {
    record.warnings.iter().map(String::as_str).filter(|warning| !warning.contains("audit points: where up to")).collect()
}

/// All frames of a scene with further `keys`.
pub fn frames(scene: &str, keys: &[String], options: &RunOptions) -> Vec<Frame> {
    let keys: Vec<&str> = keys.iter().map(String::as_str).collect();
    frames_of(scene::setup(scene, &keys), options)
}

/// All frames of a run.
pub fn frames_of(setup: Setup, options: &RunOptions) -> Vec<Frame> {
    let mut frames = Vec::new();
    scene::run_frames(setup, options, |frame| frames.push(frame));
    frames
}

/// Snapshots on it.
pub fn store() -> &'static SnapshotStore {
    static STORE: OnceLock<SnapshotStore> = OnceLock::new();
    STORE.get_or_init(|| SnapshotStore::new(&gpu()))
}

pub fn domain(source: &VelocitySource) -> Domain {
    match source {
        VelocitySource::Analytic(_, domain) => domain.clone(),
        VelocitySource::Window(window) => window.grid().unwrap().domain(),
    }
}

/// Other points in every run.
pub fn fresh(domain: &Domain, count: usize) -> Vec<DomainPoint> {
    let state = RandomState::new();
    let uniform = |i: usize| {
        let mut hasher = state.build_hasher();
        hasher.write_usize(i);
        (hasher.finish() >> 40) as f32 / (1u32 << 24) as f32
    };
    (0..count).map(|i| domain.from_unit(UnitPoint([uniform(3 * i), uniform(3 * i + 1), uniform(3 * i + 2)]))).collect()
}

/// Other unit points in every run, between these bounds along each axis.
pub fn fresh_unit(low: f64, high: f64, count: usize) -> Vec<UnitPoint> {
    fresh(&Domain::cuboid([low; 3], [high; 3]), count).into_iter().map(|p| UnitPoint(p.0)).collect()
}

const EVERYTHING: Extras = Extras { arrival: true, jacobian: true };

pub fn on_cpu(source: &VelocitySource, map: &FlowMap, t0: f64, seeds: &[DomainPoint]) -> Traced {
    let mut out = Traced::default();
    cpu_tracer(source.clone(), map, t0).unwrap().trace(seeds, EVERYTHING, &mut out).unwrap();
    out
}

/// Poisons what comes back, so that an entry that nothing wrote shows.
pub fn on_gpu(source: &VelocitySource, map: &FlowMap, t0: f64, tuning: Tuning, seeds: &[DomainPoint]) -> Traced {
    let n = seeds.len();
    let mut out = Traced {
        log_stretch: vec![f32::NAN; n],
        log_stretch_f64: vec![f64::NAN; n],
        lifetime_share: vec![f32::NAN; n],
        arrival: vec![DomainPoint([f32::NAN; 3]); n],
        jacobian: vec![[f32::NAN; 9]; n],
    };
    let tracer = CudaTracer::new(store(), &gpu(), source.clone(), map, t0, tuning).unwrap();
    tracer.trace(seeds, EVERYTHING, &mut out).unwrap();
    out
}

pub fn map(tau: f64, steps: usize) -> FlowMap {
    FlowMap {
        tau,
        direction: Direction::Forward,
        integrator: Integrator::Tangent,
        precision: Precision::F64,
        steps: Steps::Fixed(steps),
        difference_step: 1e-4,
        boundary: Boundary::Unbounded,
        normalisation: Normalisation::Tau,
        interpolation: Interpolation::Linear,
    }
}

pub fn gyre(low: [f64; 2], high: [f64; 2]) -> VelocitySource {
    VelocitySource::Analytic(Analytic::DoubleGyre { amplitude: 0.1, epsilon: 0.25, omega: 0.6 }, Domain::slab(low, high, (0.0, 1.0)))
}

pub fn even(shape: &[usize]) -> Vec<Axis> {
    shape.iter().enumerate().map(|(k, &n)| Axis::uniform(["x", "y", "z"][k], "", -1.0, 0.5 * n as f64, n).unwrap()).collect()
}

pub fn uneven(shape: &[usize]) -> Vec<Axis> {
    let coordinate = |k: usize, i: usize| 0.7 * i as f64 + 0.2 * (1.3 * i as f64 + k as f64).sin() - 1.0;
    shape
        .iter()
        .enumerate()
        .map(|(k, &n)| Axis::new(["x", "y", "z"][k], "m", (0..n).map(|i| coordinate(k, i)).collect()).unwrap())
        .collect()
}

pub fn cartesian(axes: Vec<Axis>) -> Arc<Grid> {
    Arc::new(Grid { axes, geometry: Geometry::Cartesian, slab: (0.0, 1.0) })
}

/// Smooth velocities of size `speed` at uneven times; with `hole`, a corner of the grid is missing in the later snapshots.
pub fn snapshot(grid: &Arc<Grid>, time: f64, speed: f32, hole: bool) -> Arc<Snapshot> {
    let [nx, ny, nz] = grid.shape();
    let value = |i: usize, c: usize| {
        let (x, y, z) = ((i % nx) as f32 / nx as f32, (i / nx % ny) as f32 / ny as f32, (i / nx / ny) as f32 / nz as f32);
        let turn = std::f32::consts::TAU * (x + [2.0, 1.0, 3.0][c] * y + [1.0, 2.0, 1.0][c] * z) + 0.5 * time as f32 + c as f32;
        if hole && time > 0.5 && x > 0.7 && y > 0.6 { f32::NAN } else { speed * turn.sin() }
    };
    let component = |c: usize| (0..grid.nodes()).map(|i| value(i, c)).collect::<Vec<_>>();
    let w = if grid.dimensions() == 3 { component(2) } else { Vec::new() };
    Arc::new(Snapshot::from_components(time, grid.clone(), &component(0), &component(1), &w))
}

pub fn smooth(grid: &Arc<Grid>, speed: f32, hole: bool) -> VelocitySource {
    let mut window = Window::new(3.2);
    for time in [0.0, 0.9, 2.0, 2.7, 3.5] {
        window.push(snapshot(grid, time, speed, hole)).unwrap();
    }
    VelocitySource::Window(Arc::new(window))
}

pub fn turbulence(shape: [usize; 3], snapshots: usize) -> VelocitySource {
    let grid = Turbulence::grid(shape).unwrap();
    VelocitySource::Window(Arc::new(Turbulence::easy(shape, 5).window(&grid, snapshots).unwrap()))
}

/// Longitude and latitude in degrees on a sphere of radius 10.
pub fn sphere(longitudes: (f64, f64, usize), latitudes: (f64, f64, usize), around: bool) -> Arc<Grid> {
    let lon = Axis::uniform("lon", "", longitudes.0, longitudes.1, longitudes.2).unwrap();
    let lon = if around { lon.with_period(360.0) } else { lon };
    let lat = Axis::uniform("lat", "", latitudes.0, latitudes.1, latitudes.2).unwrap();
    Arc::new(Grid { axes: vec![lon, lat], geometry: Geometry::Sphere { radius: 10.0 }, slab: (0.0, 1.0) })
}

/// The same with levels of height.
pub fn levels(longitudes: (f64, f64, usize), latitudes: (f64, f64, usize), heights: &[f64], around: bool) -> Arc<Grid> {
    let mut axes = sphere(longitudes, latitudes, around).axes.clone();
    axes.push(Axis::new("z", "", heights.to_vec()).unwrap());
    Arc::new(Grid { axes, geometry: Geometry::Sphere { radius: 10.0 }, slab: (0.0, 1.0) })
}
