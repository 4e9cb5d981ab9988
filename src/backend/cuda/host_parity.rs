//! Compares the tracing kernels' numerics, compiled as host C++ with the macros and arguments of a launch, with the Rust reference in f64. Needs
//! no GPU.

use crate::cuda::layout::{DeviceReal, Outputs, ResultPolicy};
use crate::cuda::tracing::trace::{ClosedArguments, result_policy};
use crate::cuda::window::grid::{GridArguments, Nodes, WindowFlowMap};
use crate::cuda::{DeviceError, Storage};
use ridgewatch_field::turbulence::Turbulence;
use ridgewatch_field::{Axis, Domain, Geometry, Grid, Snapshot, Window};
use ridgewatch_field::{DomainPoint, UnitPoint, analytic::Analytic};
use ridgewatch_flow::{
    Boundary, Direction, Extras, FlowMap, Integrator, Interpolation, Normalisation, Precision, Steps, Traced, VelocitySource, cpu_tracer,
};
use std::collections::hash_map::RandomState;
use std::ffi::c_void;
use std::hash::{BuildHasher, Hasher};
use std::path::Path;
use std::process::Command;
use std::sync::Arc;

type HostTrace =
    unsafe extern "C" fn(*const c_void, *const c_void, *const c_void, f64, *const ResultPolicy, *const f32, u32, *const Outputs);

/// Compiles `source` of `kernels/` with these macros.
pub(super) fn library(folder: &Path, source: &str, defines: &[String]) -> libloading::Library {
    let kernels = concat!(env!("CARGO_MANIFEST_DIR"), "/../../kernels");
    let out = folder.join("kernel.so");
    let mut command = Command::new("g++");
    command.args(["-std=c++17", "-O1", "-shared", "-fPIC", "-Wall", "-Wextra", "-Werror", "-Wno-unknown-pragmas", "-I", kernels, "-o"]);
    command.arg(&out).args(defines.iter().map(|d| format!("-D{d}"))).arg(format!("{kernels}/{source}"));
    let done = command.output().expect("g++ is installed (`make packages` sees to it)");
    assert!(done.status.success(), "{command:?}\n{}", String::from_utf8_lossy(&done.stderr));
    // SAFETY: the library has no initialisers.
    unsafe { libloading::Library::new(&out) }.unwrap()
}

/// Runs the kernel's code on the host, with outputs set to NaN before. `t0`: `None` if every seed has its own start time.
fn host(source: &VelocitySource, map: &FlowMap, t0: impl Into<Option<f64>>, storage: Storage, seeds: &[DomainPoint]) -> Traced {
    let t0 = t0.into();
    match map.precision {
        Precision::F32 => host_in::<f32>(source, map, t0, storage, seeds),
        Precision::F64 => host_in::<f64>(source, map, t0, storage, seeds),
    }
}

fn host_in<R: DeviceReal>(source: &VelocitySource, map: &FlowMap, start: Option<f64>, storage: Storage, seeds: &[DomainPoint]) -> Traced {
    let Steps::Fixed(steps) = map.steps else { panic!("fixed steps") };
    let t0 = start.unwrap_or(0.0);
    let to = t0 + map.direction.sign() * map.tau;
    // Blocks stay in place until the end. Words of eight bytes align them.
    let mut memory: Vec<Box<[u64]>> = Vec::new();
    let mut put = |bytes: &[u8]| -> Result<u64, DeviceError> {
        let mut block = vec![0u64; bytes.len().div_ceil(8) + 1].into_boxed_slice();
        bytemuck::cast_slice_mut(&mut block)[..bytes.len()].copy_from_slice(bytes);
        memory.push(block);
        Ok(memory.last().unwrap().as_ptr() as u64)
    };
    let folder = tempfile::tempdir().unwrap();
    let (data, times, mut defines) = match source {
        VelocitySource::Analytic(flow, domain) => {
            let ClosedArguments { data, stages, mut defines } = ClosedArguments::new::<R>(flow, domain, map, start, steps);
            defines.push("RW_CLOSED=1".into());
            (data, put(&stages).unwrap(), defines)
        }
        VelocitySource::Window(window) => {
            let grid = window.grid().unwrap().clone();
            let snapshots: Vec<_> = window.snapshots().collect();
            // The last snapshot has no next one.
            let held = (0..snapshots.len()).map(|i| encoded(snapshots[i], snapshots.get(i + 1).map(|s| s.as_ref()), storage));
            let addresses = held.map(|bytes| put(&bytes).unwrap()).collect();
            let nodes = Nodes {
                addresses,
                storage,
                scale: if storage != Storage::F32 { HALF_SCALE } else { 1.0 },
                missing: window.snapshots().any(|s| s.missing_nodes() > 0),
            };
            let times: Vec<f64> = window.snapshots().map(|s| s.time).collect();
            let keep = map.precision == Precision::F32;
            let flow = WindowFlowMap { nodes: &nodes, times: &times, grid: &grid, map, span: (t0, to), steps, keep };
            let arguments = GridArguments::new::<R>(&mut put, flow).unwrap();
            (arguments.data, arguments.steps, arguments.defines)
        }
    };
    defines.sort();
    let library = library(folder.path(), "tracing/host.cpp", &defines);
    let n = seeds.len();
    let mut out = Traced {
        log_stretch: vec![f32::NAN; n],
        log_stretch_f64: vec![f64::NAN; n],
        lifetime_share: vec![f32::NAN; n],
        arrival: vec![DomainPoint([f32::NAN; 3]); n],
        jacobian: vec![[f32::NAN; 9]; n],
    };
    let outputs = Outputs {
        log_stretch: out.log_stretch.as_mut_ptr() as u64,
        log_stretch_f64: out.log_stretch_f64.as_mut_ptr() as u64,
        lifetime_share: out.lifetime_share.as_mut_ptr() as u64,
        arrival: out.arrival.as_mut_ptr() as u64,
        jacobian: out.jacobian.as_mut_ptr() as u64,
    };
    let step = R::from_f64((to - t0) / steps as f64);
    // SAFETY: the function has this signature; all memory is live and as large as the function expects.
    unsafe {
        let trace: libloading::Symbol<HostTrace> = library.get(b"host_trace").unwrap();
        let step = (&raw const step).cast();
        trace(
            data.as_ptr().cast(),
            times as *const c_void,
            step,
            map.difference_step,
            &result_policy(map, steps),
            seeds.as_ptr().cast(),
            n as u32,
            &outputs,
        );
    }
    out
}

/// Power of two by which half-precision velocities are multiplied here.
const HALF_SCALE: f32 = 1.0 / 256.0;

/// Rounds to half precision (nearest, ties to even).
pub(super) fn half(x: f32) -> u16 {
    half::f16::from_f32(x).to_bits()
}

/// Nodes as `window.cu` writes them. Changes are those of the given field, exact if half precision holds both.
fn encoded(snapshot: &Snapshot, next: Option<&Snapshot>, storage: Storage) -> Vec<u8> {
    let mut bytes = Vec::new();
    let mut put = |node: [f32; 4]| match storage {
        Storage::F32 => node.iter().for_each(|x| bytes.extend(x.to_le_bytes())),
        _ => node.iter().for_each(|x| bytes.extend(half(x / HALF_SCALE).to_le_bytes())),
    };
    for (i, node) in snapshot.nodes.iter().enumerate() {
        put(*node);
        if storage == Storage::F16Pairs {
            let after = next.map_or([f32::NAN; 4], |next| next.nodes[i]);
            put(std::array::from_fn(|c| if node[c].is_nan() { after[c] } else { after[c] - node[c] }));
        }
    }
    bytes
}

/// Random points, different in every run.
fn fresh(domain: &Domain, count: usize) -> Vec<DomainPoint> {
    let state = RandomState::new();
    let uniform = |i: usize| {
        let mut hasher = state.build_hasher();
        hasher.write_usize(i);
        (hasher.finish() >> 40) as f32 / (1u32 << 24) as f32
    };
    (0..count).map(|i| domain.from_unit(UnitPoint([uniform(3 * i), uniform(3 * i + 1), uniform(3 * i + 2)]))).collect()
}

fn cpu(source: &VelocitySource, map: &FlowMap, t0: f64, seeds: &[DomainPoint]) -> Traced {
    let mut out = Traced::default();
    cpu_tracer(source.clone(), map, t0).unwrap().trace(seeds, Extras { arrival: true, jacobian: true }, &mut out);
    out
}

fn map(tau: f64, steps: usize) -> FlowMap {
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

/// Maximum share of paths that rounding lets the CPU and the kernel end differently at an edge.
const UNDECIDED: f64 = 0.005;

/// Compares both precisions of the kernel's code with the CPU in f64.
fn check(name: &str, source: &VelocitySource, map: &FlowMap, t0: f64) {
    let domain = match source {
        VelocitySource::Analytic(_, domain) => domain.clone(),
        VelocitySource::Window(window) => window.grid().unwrap().domain(),
    };
    let seeds = fresh(&domain, 600);
    let exact = cpu(source, map, t0, &seeds);
    let double = host(source, map, t0, Storage::F32, &seeds);
    let same: Vec<usize> = (0..seeds.len()).filter(|&i| (exact.lifetime_share[i] - double.lifetime_share[i]).abs() < 1e-6).collect();
    assert!(same.len() as f64 >= (1.0 - UNDECIDED) * seeds.len() as f64, "{name}: {} of {} of equal lifetime", same.len(), seeds.len());
    let mut died = 0;
    for &i in &same {
        let (a, b) = (exact.log_stretch_f64[i], double.log_stretch_f64[i]);
        // Rounding of 1e-16 a step, amplified by the stretch along the path (e^s below 1e4 here) and, near cell faces, by a jump of the
        // gradient across them. Central differences divide it by the difference step.
        let tolerance = if map.integrator == Integrator::Differences { 1e-6 } else { 2e-9 };
        assert!((a - b).abs() < tolerance * a.abs().max(1.0), "{name}: seed {:?}: {a} {b}", seeds[i]);
        died += usize::from(exact.lifetime_share[i] < 1.0);
        for k in 0..3 {
            let (a, b) = (exact.arrival[i].0[k], double.arrival[i].0[k]);
            // Both are rounded to single precision.
            assert!((a - b).abs() <= 4.0 * f32::EPSILON * a.abs().max(1.0), "{name}: arrival {a} {b}");
        }
        let largest = exact.jacobian[i].iter().fold(0f32, |m, x| m.max(x.abs()));
        for k in 0..9 {
            let (a, b) = (exact.jacobian[i][k], double.jacobian[i][k]);
            assert!((a - b).abs() <= 1e-5f32.max(tolerance as f32) * largest.max(1.0), "{name}: jacobian {k}: {a} {b}");
        }
    }
    if matches!(map.boundary, Boundary::Stop | Boundary::Zero) {
        assert!(died > 0, "{name}: some particle should leave, or the edge is not tested");
    }
    if map.integrator == Integrator::Differences {
        return;
    }
    // Single precision: about as far from the exact result as the CPU's single precision, up to the order of rounding.
    let single = FlowMap { precision: Precision::F32, ..map.clone() };
    let (ours, theirs) = (host(source, &single, t0, Storage::F32, &seeds), cpu(source, &single, t0, &seeds));
    let error = |found: &Traced| {
        let mut errors: Vec<f64> = same.iter().map(|&i| (f64::from(found.log_stretch[i]) - exact.log_stretch_f64[i]).abs()).collect();
        errors.sort_by(f64::total_cmp);
        // The worst percent are paths along a cell face or an edge, where rounding decides the side.
        errors[errors.len() * 99 / 100]
    };
    let (ours, theirs) = (error(&ours), error(&theirs));
    assert!(ours < 3.0 * theirs + 2e-6, "{name}: single precision is off by {ours:e}, the CPU's by {theirs:e}");
}

#[test]
fn closed_forms() {
    let plane = Domain::slab([0.0, 0.0], [2.0, 1.0], (0.0, 1.0));
    let cube = Domain::cuboid([0.0; 3], [6.0; 3]);
    let gyre =
        |domain: &Domain| VelocitySource::Analytic(Analytic::DoubleGyre { amplitude: 0.1, epsilon: 0.25, omega: 0.6 }, domain.clone());
    let abc = VelocitySource::Analytic(Analytic::Abc { a: 3f64.sqrt(), b: 2f64.sqrt(), c: 1.0, growth: 0.5 }, cube);
    check("double gyre", &gyre(&plane), &map(10.0, 40), 0.3);
    let inner = Domain::slab([0.4, 0.2], [1.7, 0.9], (0.0, 1.0));
    check(
        "double gyre that stops",
        &gyre(&inner),
        &FlowMap { boundary: Boundary::Stop, normalisation: Normalisation::Lifetime, ..map(5.0, 40) },
        0.3,
    );
    check(
        "double gyre with zeros",
        &gyre(&inner),
        &FlowMap { boundary: Boundary::Zero, direction: Direction::Backward, ..map(5.0, 40) },
        0.3,
    );
    check("double gyre clamped", &gyre(&inner), &FlowMap { boundary: Boundary::Clamp, ..map(5.0, 40) }, 0.3);
    check("double gyre by differences", &gyre(&plane), &FlowMap { integrator: Integrator::Differences, ..map(10.0, 40) }, 0.3);
    check("ABC", &abc, &FlowMap { boundary: Boundary::Unbounded, ..map(2.0, 30) }, 0.0);
    for flow in [Analytic::Saddle { rate: 0.7 }, Analytic::Rotation { omega: 0.7 }, Analytic::Shear { rate: 0.7 }] {
        check("linear", &VelocitySource::Analytic(flow, plane.clone()), &map(4.0, 20), 0.0);
    }
}

/// Compares seeds with individual start times with the CPU's tracer at each start.
#[test]
fn closed_forms_with_starts() {
    let plane = Domain::slab([0.0, 0.0], [2.0, 1.0], (0.0, 1.0));
    let gyre = VelocitySource::Analytic(Analytic::DoubleGyre { amplitude: 0.1, epsilon: 0.25, omega: 0.6 }, plane);
    let seeds = fresh(&Domain::cuboid([0.0, 0.0, -3.0], [2.0, 1.0, 10.0]), 150);
    for (direction, integrator, tolerance) in [
        (Direction::Forward, Integrator::Tangent, 2e-9),
        (Direction::Backward, Integrator::Tangent, 2e-9),
        // Rounding divided by the difference step.
        (Direction::Forward, Integrator::Differences, 1e-6),
    ] {
        let map = FlowMap { direction, integrator, ..map(10.0, 40) };
        let found = host(&gyre, &map, None, Storage::F32, &seeds);
        let single = host(&gyre, &FlowMap { precision: Precision::F32, ..map.clone() }, None, Storage::F32, &seeds);
        for (i, &seed) in seeds.iter().enumerate() {
            let exact = cpu(&gyre, &map, f64::from(seed.0[2]), &[seed]);
            let (a, b) = (exact.log_stretch_f64[0], found.log_stretch_f64[i]);
            assert!((a - b).abs() < tolerance * a.abs().max(1.0), "{direction:?} {integrator:?} {seed:?}: {a} {b}");
            // In single precision, differences over a step of 1e-4 keep about three of seven digits.
            let tolerance = if integrator == Integrator::Tangent { 2e-3 } else { 0.1 };
            assert!(
                (f64::from(single.log_stretch[i]) - a).abs() < tolerance,
                "{direction:?} {integrator:?} {seed:?}: {a} in single precision"
            );
        }
    }
}

/// Uneven axes of a given shape.
fn uneven(shape: &[usize]) -> Vec<Axis> {
    let coordinate = |k: usize, i: usize| 0.7 * i as f64 + 0.2 * (1.3 * i as f64 + k as f64).sin() - 1.0;
    shape
        .iter()
        .enumerate()
        .map(|(k, &n)| Axis::new(["x", "y", "z"][k], "m", (0..n).map(|i| coordinate(k, i)).collect()).unwrap())
        .collect()
}

/// Smooth velocities of size `speed` at the nodes, at uneven times; with `hole`, a corner of the grid is missing in the later snapshots.
fn smooth(grid: &Arc<Grid>, speed: f32, hole: bool) -> VelocitySource {
    smooth_with(grid, speed, hole.then_some(1))
}

/// As [`smooth`], with the hole from snapshot number `hole` on.
fn smooth_with(grid: &Arc<Grid>, speed: f32, hole: Option<usize>) -> VelocitySource {
    let mut window = Window::new(3.2);
    let [nx, ny, nz] = grid.shape();
    for (s, time) in [0.0, 0.9, 2.0, 2.7, 3.5].into_iter().enumerate() {
        let value = |i: usize, c: usize| {
            let (x, y, z) = ((i % nx) as f32 / nx as f32, (i / nx % ny) as f32 / ny as f32, (i / nx / ny) as f32 / nz as f32);
            let turn = std::f32::consts::TAU * (x + [2.0, 1.0, 3.0][c] * y + [1.0, 2.0, 1.0][c] * z) + 0.5 * time as f32 + c as f32;
            if hole.is_some_and(|first| s >= first) && x > 0.7 && y > 0.6 { f32::NAN } else { speed * turn.sin() }
        };
        let component = |c: usize| (0..grid.nodes()).map(|i| value(i, c)).collect::<Vec<_>>();
        let w = if grid.dimensions() == 3 { component(2) } else { Vec::new() };
        window.push(Arc::new(Snapshot::from_components(time, grid.clone(), &component(0), &component(1), &w))).unwrap();
    }
    VelocitySource::Window(Arc::new(window))
}

fn cartesian(axes: Vec<Axis>) -> Arc<Grid> {
    Arc::new(Grid { axes, geometry: Geometry::Cartesian, slab: (0.0, 1.0) })
}

fn sphere(axes: Vec<Axis>) -> Arc<Grid> {
    Arc::new(Grid { axes, geometry: Geometry::Sphere { radius: 10.0 }, slab: (0.0, 1.0) })
}

fn globe_axes() -> Vec<Axis> {
    let lon = Axis::uniform("lon", "", -180.0, 170.0, 36).unwrap().with_period(360.0);
    vec![lon, Axis::uniform("lat", "", -90.0, 90.0, 37).unwrap()]
}

fn region_axes() -> Vec<Axis> {
    vec![Axis::uniform("lon", "", -30.0, 10.0, 21).unwrap(), Axis::uniform("lat", "", 20.0, 60.0, 21).unwrap()]
}

/// Even axes of a cube.
fn even_axes(dimensions: usize) -> Vec<Axis> {
    ["x", "y", "z"][..dimensions].iter().map(|name| Axis::uniform(*name, "", 0.0, 5.0, 11).unwrap()).collect()
}

#[test]
fn windows_in_the_plane() {
    let even = || vec![Axis::uniform("x", "", 0.0, 9.0, 19).unwrap(), Axis::uniform("y", "", 1.0, 5.0, 13).unwrap()];
    let stop = FlowMap { boundary: Boundary::Stop, ..map(3.2, 16) };
    let cubic = FlowMap { interpolation: Interpolation::Cubic, ..stop.clone() };
    check("linear", &smooth(&cartesian(even()), 0.6, false), &stop, 0.1);
    check("cubic", &smooth(&cartesian(even()), 0.6, false), &cubic, 0.1);
    check(
        "cubic, uneven",
        &smooth(&cartesian(uneven(&[19, 13])), 0.6, false),
        &FlowMap { boundary: Boundary::Clamp, ..cubic.clone() },
        0.1,
    );
    check(
        "cubic, holes",
        &smooth(&cartesian(even()), 0.6, true),
        &FlowMap { normalisation: Normalisation::Lifetime, ..cubic.clone() },
        0.1,
    );
    let mut around = even();
    around[0] = around[0].clone().with_period(9.5);
    check("cubic, around", &smooth(&cartesian(around), 0.6, false), &cubic, 0.1);
    let backward = FlowMap { direction: Direction::Backward, boundary: Boundary::Periodic, ..stop.clone() };
    check("linear, periodic, backward", &smooth(&cartesian(even()), 0.6, false), &backward, 3.4);
    let zero = FlowMap { boundary: Boundary::Zero, ..cubic };
    check("cubic, zeros", &smooth(&cartesian(even()), 0.6, false), &zero, 0.1);
}

#[test]
fn windows_in_space() {
    let stop = FlowMap { boundary: Boundary::Stop, ..map(3.2, 16) };
    let even = || even_axes(3);
    check("linear", &smooth(&cartesian(even()), 0.5, false), &stop, 0.1);
    check("linear, holes", &smooth(&cartesian(even()), 0.5, true), &stop, 0.1);
    check("linear, uneven", &smooth(&cartesian(uneven(&[11, 9, 8])), 0.5, false), &stop, 0.1);
    check(
        "cubic, uneven",
        &smooth(&cartesian(uneven(&[11, 9, 8])), 0.5, false),
        &FlowMap { interpolation: Interpolation::Cubic, ..stop.clone() },
        0.1,
    );
    let mut around = even();
    around[1] = around[1].clone().with_period(5.5);
    check("linear, around", &smooth(&cartesian(around), 0.5, false), &stop, 0.1);
    let zero = FlowMap { boundary: Boundary::Zero, direction: Direction::Backward, ..stop.clone() };
    check("linear, zeros, holes", &smooth(&cartesian(even()), 0.5, true), &zero, 3.4);
    check("differences", &smooth(&cartesian(even()), 0.5, false), &FlowMap { integrator: Integrator::Differences, ..stop.clone() }, 0.1);
    // Unit spacing: no factor between stored and used velocities.
    let turbulence = Turbulence::easy([40, 24, 24], 5);
    let grid = Turbulence::grid([40, 24, 24]).unwrap();
    let window = Arc::new(turbulence.window(&grid, 6).unwrap());
    check("turbulence", &VelocitySource::Window(window), &FlowMap { boundary: Boundary::Clamp, ..map(5.0, 10) }, 0.0);
}

#[test]
fn windows_on_the_sphere() {
    let (globe, region) = (sphere(globe_axes()), sphere(region_axes()));
    // Rounding would decide the end of a particle at a pole, where the grid's cells meet. With Clamp none ends.
    let around = FlowMap { boundary: Boundary::Clamp, interpolation: Interpolation::Cubic, difference_step: 1e-3, ..map(3.2, 16) };
    check("globe, cubic", &smooth(&globe, 1.0, false), &around, 0.1);
    let stop = FlowMap { boundary: Boundary::Stop, direction: Direction::Backward, difference_step: 1e-3, ..map(3.2, 16) };
    check("region, linear, holes", &smooth(&region, 0.8, true), &stop, 3.4);
    check("region, differences", &smooth(&region, 0.8, false), &FlowMap { integrator: Integrator::Differences, ..stop }, 3.4);
}

#[test]
fn levels_on_the_sphere() {
    let even = [0.0, 0.5, 1.0, 1.5, 2.0, 2.5, 3.0];
    let uneven = [0.0, 0.3, 0.7, 1.2, 1.8, 2.5, 3.4];
    let levels = |mut axes: Vec<Axis>, heights: &[f64]| {
        axes.push(Axis::new("z", "", heights.to_vec()).unwrap());
        sphere(axes)
    };
    let region = |heights: &[f64]| levels(region_axes(), heights);
    let around = FlowMap { boundary: Boundary::Clamp, difference_step: 1e-3, ..map(3.2, 16) };
    check("globe", &smooth(&levels(globe_axes(), &even), 0.8, false), &around, 0.1);
    let stop = FlowMap { boundary: Boundary::Stop, direction: Direction::Backward, difference_step: 1e-3, ..map(3.2, 16) };
    check("region, uneven levels, holes", &smooth(&region(&uneven), 0.5, true), &stop, 3.4);
    let cubic = FlowMap { interpolation: Interpolation::Cubic, ..stop.clone() };
    check("region, cubic", &smooth(&region(&uneven), 0.5, false), &cubic, 3.4);
    check(
        "region, differences",
        &smooth(&region(&even), 0.5, false),
        &FlowMap { integrator: Integrator::Differences, ..stop.clone() },
        3.4,
    );
    check_storage("levels", &smooth(&region(&even), 0.5, true), &FlowMap { direction: Direction::Forward, ..stop.clone() }, 0.1);
    // Steps that end on the last snapshot at which their nodes are known.
    let late = smooth_with(&region(&even), 0.5, Some(2));
    let ends = FlowMap { direction: Direction::Forward, tau: 1.8, steps: Steps::Fixed(18), ..stop };
    check("region, nodes that go missing", &late, &ends, 0.0);
    check_storage("nodes that go missing", &late, &ends, 0.0);
}

#[test]
fn windows_in_half_precision_and_in_pairs() {
    let even = even_axes;
    let stop = FlowMap { boundary: Boundary::Stop, ..map(3.2, 16) };
    let cubic = FlowMap { interpolation: Interpolation::Cubic, ..stop.clone() };
    check_storage("linear, holes", &smooth(&cartesian(even(3)), 0.5, true), &stop, 0.1);
    check_storage("cubic in the plane, holes", &smooth(&cartesian(even(2)), 0.5, true), &cubic, 0.1);
    check_storage("cubic in space", &smooth(&cartesian(even(3)), 0.5, false), &cubic, 0.1);
    let region = sphere(region_axes());
    check_storage("sphere", &smooth(&region, 0.8, true), &stop, 0.1);
    check_storage("sphere, cubic", &smooth(&region, 0.8, false), &cubic, 0.1);
}

/// Compares the kernel's code on a window in half precision and in pairs with the CPU on the same, rounded field. Only the arithmetic differs.
fn check_storage(name: &str, source: &VelocitySource, map: &FlowMap, t0: f64) {
    check_rounded(name, source, map, t0, Storage::F16, |x| half::f16::from_f32(x / HALF_SCALE).to_f32() * HALF_SCALE);
    // Fixed point: half precision holds the changes exactly too.
    check_rounded(name, source, map, t0, Storage::F16Pairs, |x| {
        let steps = (x * 128.0).round_ties_even();
        assert!(steps.abs() <= 1024.0, "{name}: {x}");
        steps / 128.0
    });
}

fn check_rounded(name: &str, source: &VelocitySource, map: &FlowMap, t0: f64, storage: Storage, round: impl Fn(f32) -> f32) {
    let VelocitySource::Window(window) = source else { panic!("a window") };
    let mut rounded = Window::new(3.2);
    for snapshot in window.snapshots() {
        let round = |x: f32| if x.is_nan() { x } else { round(x) };
        let nodes = snapshot.nodes.iter().map(|n| n.map(round)).collect();
        rounded.push(Arc::new(Snapshot::new(snapshot.time, snapshot.grid.clone(), nodes))).unwrap();
    }
    let seeds = fresh(&window.grid().unwrap().domain(), 500);
    let rounded = VelocitySource::Window(Arc::new(rounded));
    let (exact, found) = (cpu(&rounded, map, t0, &seeds), host(&rounded, map, t0, storage, &seeds));
    let odd = (0..seeds.len()).filter(|&i| (exact.log_stretch_f64[i] - found.log_stretch_f64[i]).abs() > 2e-9).count();
    assert!(odd as f64 <= UNDECIDED * seeds.len() as f64, "{name}, {storage:?}: {odd} of {} differ", seeds.len());
}

#[test]
fn halves_round_to_nearest() {
    let folder = tempfile::tempdir().unwrap();
    let defines = ["RW_CLOSED=1", "RW_REAL=float", "RW_FORM=0", "RW_BOUNDARY=3", "RW_DIFFERENCES=0", "RW_STARTS=0"].map(String::from);
    let library = library(folder.path(), "tracing/host.cpp", &defines);
    // SAFETY: the function has this signature.
    let half: libloading::Symbol<unsafe extern "C" fn(f32) -> f32> = unsafe { library.get(b"host_half") }.unwrap();
    // SAFETY: as above.
    let half = |x: f32| unsafe { half(x) };
    for (x, expected) in [(1.0, 1.0), (-0.5, -0.5), (65504.0, 65504.0), (1e6, f32::INFINITY), (5.96e-8, 5.960_464_5e-8), (1e-9, 0.0)] {
        assert_eq!(half(x), expected, "{x}");
    }
    // Between 1 and 1 + 2^-10, ties go to the even one.
    assert_eq!(half(1.0 + 2f32.powi(-11)), 1.0);
    assert_eq!(half(1.0 + 3.0 * 2f32.powi(-11)), 1.0 + 2.0 * 2f32.powi(-10));
    assert!(half(f32::NAN).is_nan());
}
