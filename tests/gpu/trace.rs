//! Tracing kernels against the CPU in f64.

use super::scenes::*;
use ridgewatch::backend::cuda::{CudaTracer, DeviceTracer, Outputs, Storage, Tuning};
use ridgewatch::field::analytic::Analytic;
use ridgewatch::field::{Domain, DomainPoint};
use ridgewatch::flow::{Boundary, Direction, FlowMap, Integrator, Interpolation, Normalisation, Precision, Traced, VelocitySource};

/// Paths that the CPU and the kernel judge differently at an edge, as a share: rounding decides them.
const UNDECIDED: f64 = 0.002;
/// More than a batch that is sorted, and no multiple of a block.
const SEEDS: usize = 20_011;

/// Errors of log-stretch, arrival (in lengths of the farthest) and Jacobian (in sizes of its largest entry) that all but the worst percent stay
/// below: those are paths along a cell face or an edge, where rounding decides which side counts.
fn most(exact: &Traced, found: &Traced, same: &[usize]) -> [f64; 3] {
    let largest = |values: &[f32]| values.iter().fold(1f32, |m, x| m.max(x.abs()));
    let apart = |a: &[f32], b: &[f32]| a.iter().zip(b).fold(0f32, |m, (a, b)| m.max((a - b).abs())) / largest(a);
    let percentile = |error: &dyn Fn(usize) -> f64| {
        let mut errors: Vec<f64> = same.iter().map(|&i| error(i)).collect();
        errors.sort_by(f64::total_cmp);
        errors[errors.len() * 99 / 100]
    };
    [
        percentile(&|i| (f64::from(found.log_stretch[i]) - exact.log_stretch_f64[i]).abs()),
        percentile(&|i| apart(&exact.arrival[i].0, &found.arrival[i].0).into()),
        percentile(&|i| apart(&exact.jacobian[i], &found.jacobian[i]).into()),
    ]
}

fn check(name: &str, source: &VelocitySource, map: &FlowMap, t0: f64) {
    let seeds = fresh(&domain(source), SEEDS);
    let exact = on_cpu(source, map, t0, &seeds);
    let double = on_gpu(source, map, t0, Tuning::default(), &seeds);
    let same: Vec<usize> = (0..seeds.len()).filter(|&i| (exact.lifetime_share[i] - double.lifetime_share[i]).abs() < 1e-6).collect();
    assert!(same.len() as f64 >= (1.0 - UNDECIDED) * seeds.len() as f64, "{name}: {} of {} of equal lifetime", same.len(), seeds.len());
    // Rounding of 1e-16 a step, amplified along the path; where a path runs along a cell face, rounding decides which of two gradients
    // counts: a few such paths are let go. Central differences divide rounding by the difference step.
    let tolerance = if map.integrator == Integrator::Differences { 1e-6 } else { 2e-9 };
    let odd = same.iter().filter(|&&i| {
        let (a, b) = (exact.log_stretch_f64[i], double.log_stretch_f64[i]);
        let largest = exact.jacobian[i].iter().fold(1f32, |m, x| m.max(x.abs()));
        let close = |a: f32, b: f32, size: f32| (a - b).abs() <= 1e-5f32.max(tolerance as f32) * size;
        let arrived = (0..3).all(|k| close(exact.arrival[i].0[k], double.arrival[i].0[k], exact.arrival[i].0[k].abs().max(1.0)));
        let jacobian = (0..9).all(|k| close(exact.jacobian[i][k], double.jacobian[i][k], largest));
        !((a - b).abs() < tolerance * a.abs().max(1.0) && arrived && jacobian)
    });
    let odd = odd.count();
    assert!(odd as f64 <= UNDECIDED * seeds.len() as f64, "{name}: {odd} of {} differ from the CPU", seeds.len());
    let died = exact.lifetime_share.iter().filter(|l| **l < 1.0).count();
    if matches!(map.boundary, Boundary::Stop | Boundary::Zero) {
        assert!(died > 0, "{name}: some particle should leave, or the edge is not tested");
    }
    // Every variant of the kernel in single precision: no worse than the CPU's single precision, but for the order of rounding.
    let single = FlowMap {
        precision: Precision::F32,
        difference_step: if map.integrator == Integrator::Differences { 1e-2 } else { map.difference_step },
        ..map.clone()
    };
    let wide = FlowMap { precision: Precision::F64, ..single.clone() };
    let exact = on_cpu(source, &wide, t0, &seeds);
    let theirs = on_cpu(source, &single, t0, &seeds);
    for (sorted, keep, spread) in [(true, true, true), (true, false, true), (true, true, false), (false, true, true), (false, false, false)]
    {
        let found = on_gpu(source, &single, t0, Tuning { storage: Storage::F32, sorted, keep, spread }, &seeds);
        let alike: Vec<usize> = (0..seeds.len()).filter(|&i| (exact.lifetime_share[i] - found.lifetime_share[i]).abs() < 1e-6).collect();
        // Single precision decides more paths the other way: a step's rounding is 1e-7 of the domain.
        assert!(alike.len() as f64 >= 0.99 * seeds.len() as f64, "{name}: {} of {} of equal lifetime", alike.len(), seeds.len());
        assert!(found.log_stretch.iter().all(|s| !s.is_nan()), "{name}: something was not written");
        let (ours, theirs) = (most(&exact, &found, &alike), most(&exact, &theirs, &alike));
        println!(
            "{name}, sorted {sorted}, keep {keep}, spread {spread}: log-stretch, arrival and Jacobian in single precision off by {ours:?}, \
             the CPU's by {theirs:?}; {odd} odd, {died} stopped"
        );
        for (what, (ours, theirs)) in ["log-stretch", "arrival", "Jacobian"].into_iter().zip(ours.into_iter().zip(theirs)) {
            assert!(ours < 3.0 * theirs + 2e-6, "{name}: {what} in single precision is off by {ours:e}, the CPU's by {theirs:e}");
        }
    }
}

/// Each seed at a start of its own, against the CPU's tracer at that start.
#[test]
#[ignore = "needs a GPU"]
fn seeds_with_starts_of_their_own() {
    let VelocitySource::Analytic(flow, plane) = gyre([0.0, 0.0], [2.0, 1.0]) else { panic!("a closed form") };
    let seeds = fresh(&Domain::cuboid([0.0, 0.0, -3.0], [2.0, 1.0, 10.0]), 500);
    for (precision, tolerance) in [(Precision::F64, 2e-9), (Precision::F32, 2e-3)] {
        let map = FlowMap { precision, ..map(10.0, 40) };
        let tracer = DeviceTracer::with_starts(&gpu(), &flow, &plane, &map, 40).unwrap();
        let found = traced_there(&tracer, &seeds);
        for (seed, found) in seeds.iter().zip(&found) {
            let exact = on_cpu(&gyre([0.0, 0.0], [2.0, 1.0]), &super::scenes::map(10.0, 40), f64::from(seed.0[2]), &[*seed]);
            let exact = exact.log_stretch_f64[0];
            assert!((found - exact).abs() < tolerance * exact.abs().max(1.0), "{precision:?} {seed:?}: {found} for {exact}");
        }
    }
    let saddle = Analytic::Saddle { rate: 1.0 };
    assert!(DeviceTracer::with_starts(&gpu(), &saddle, &plane, &map(10.0, 40), 40).is_err());
}

fn traced_there(tracer: &DeviceTracer, seeds: &[DomainPoint]) -> Vec<f64> {
    let points = gpu().upload::<[f32; 3]>("seeds", bytemuck::cast_slice(seeds)).unwrap();
    let single = gpu().upload("values", &vec![f32::NAN; seeds.len()]).unwrap();
    let double = gpu().upload("values", &vec![f64::NAN; seeds.len()]).unwrap();
    let out = Outputs { log_stretch: single.address(), log_stretch_f64: double.address(), ..Outputs::default() };
    // SAFETY: all buffers hold as many entries, and reading waits for the stream.
    unsafe { tracer.trace(points.address(), seeds.len(), &out) }.unwrap();
    let mut found = vec![f64::NAN; seeds.len()];
    double.read(&mut found).unwrap();
    found
}

#[test]
#[ignore = "needs a GPU"]
fn closed_forms() {
    let plane = || gyre([0.0, 0.0], [2.0, 1.0]);
    let inner = || gyre([0.4, 0.2], [1.7, 0.9]);
    check("double gyre", &plane(), &map(10.0, 40), 0.3);
    let stop = FlowMap { boundary: Boundary::Stop, normalisation: Normalisation::Lifetime, ..map(5.0, 40) };
    check("double gyre that stops", &inner(), &stop, 0.3);
    let zero = FlowMap { boundary: Boundary::Zero, direction: Direction::Backward, ..map(5.0, 40) };
    check("double gyre with zeros", &inner(), &zero, 0.3);
    check("double gyre clamped", &inner(), &FlowMap { boundary: Boundary::Clamp, ..map(5.0, 40) }, 0.3);
    check("double gyre by differences", &plane(), &FlowMap { integrator: Integrator::Differences, ..map(10.0, 40) }, 0.3);
    let abc = Analytic::Abc { a: 3f64.sqrt(), b: 2f64.sqrt(), c: 1.0, growth: 0.5 };
    check("ABC", &VelocitySource::Analytic(abc, Domain::cuboid([0.0; 3], [6.0; 3])), &map(2.0, 30), 0.0);
    for flow in [Analytic::Saddle { rate: 0.7 }, Analytic::Rotation { omega: 0.7 }, Analytic::Shear { rate: 0.7 }] {
        check("linear", &VelocitySource::Analytic(flow, domain(&plane())), &map(4.0, 20), 0.0);
    }
}

#[test]
#[ignore = "needs a GPU"]
fn windows_in_the_plane() {
    let stop = FlowMap { boundary: Boundary::Stop, ..map(3.2, 16) };
    let cubic = FlowMap { interpolation: Interpolation::Cubic, ..stop.clone() };
    let grid = || cartesian(even(&[19, 13]));
    check("linear", &smooth(&grid(), 0.6, false), &stop, 0.1);
    check("cubic", &smooth(&grid(), 0.6, false), &cubic, 0.1);
    check(
        "cubic, uneven",
        &smooth(&cartesian(uneven(&[19, 13])), 0.6, false),
        &FlowMap { boundary: Boundary::Clamp, ..cubic.clone() },
        0.1,
    );
    check("cubic, holes", &smooth(&grid(), 0.6, true), &FlowMap { normalisation: Normalisation::Lifetime, ..cubic.clone() }, 0.1);
    let mut around = even(&[19, 13]);
    around[0] = around[0].clone().with_period(11.0);
    check("cubic, around", &smooth(&cartesian(around), 0.6, false), &cubic, 0.1);
    let backward = FlowMap { direction: Direction::Backward, boundary: Boundary::Periodic, ..stop };
    check("linear, periodic, backward", &smooth(&grid(), 0.6, false), &backward, 3.4);
    check("cubic, zeros", &smooth(&grid(), 0.6, false), &FlowMap { boundary: Boundary::Zero, ..cubic }, 0.1);
    let differences = FlowMap { integrator: Integrator::Differences, ..backward };
    check("differences, backward", &smooth(&grid(), 0.6, false), &FlowMap { boundary: Boundary::Stop, ..differences }, 3.4);
}

#[test]
#[ignore = "needs a GPU"]
fn windows_in_space() {
    let stop = FlowMap { boundary: Boundary::Stop, ..map(3.2, 16) };
    let grid = || cartesian(even(&[11, 12, 10]));
    check("linear", &smooth(&grid(), 0.5, false), &stop, 0.1);
    check("linear, holes", &smooth(&grid(), 0.5, true), &stop, 0.1);
    check("linear, uneven", &smooth(&cartesian(uneven(&[11, 9, 8])), 0.5, false), &stop, 0.1);
    let cubic = FlowMap { interpolation: Interpolation::Cubic, ..stop.clone() };
    check("cubic, uneven", &smooth(&cartesian(uneven(&[11, 9, 8])), 0.5, false), &cubic, 0.1);
    let mut around = even(&[11, 12, 10]);
    around[1] = around[1].clone().with_period(7.5);
    check("linear, around", &smooth(&cartesian(around), 0.5, false), &stop, 0.1);
    let zero = FlowMap { boundary: Boundary::Zero, direction: Direction::Backward, ..stop.clone() };
    check("linear, zeros, holes", &smooth(&grid(), 0.5, true), &zero, 3.4);
    let differences = FlowMap { integrator: Integrator::Differences, ..stop };
    check("differences", &smooth(&grid(), 0.5, false), &differences, 0.1);
    check("differences, holes", &smooth(&grid(), 0.5, true), &differences, 0.1);
    check("turbulence", &turbulence([40, 24, 24], 6), &FlowMap { boundary: Boundary::Clamp, ..map(5.0, 10) }, 0.0);
}

#[test]
#[ignore = "needs a GPU"]
fn windows_on_the_sphere() {
    // A particle at a pole, where the grid's cells meet, would be decided by rounding: Clamp lets all live.
    let around = FlowMap { boundary: Boundary::Clamp, interpolation: Interpolation::Cubic, difference_step: 1e-3, ..map(3.2, 16) };
    check("globe, cubic", &smooth(&sphere((-180.0, 170.0, 36), (-90.0, 90.0, 37), true), 1.0, false), &around, 0.1);
    let region = || sphere((-30.0, 10.0, 21), (20.0, 60.0, 21), false);
    let stop = FlowMap { boundary: Boundary::Stop, direction: Direction::Backward, difference_step: 1e-3, ..map(3.2, 16) };
    check("region, linear, holes", &smooth(&region(), 0.8, true), &stop, 3.4);
}

#[test]
#[ignore = "needs a GPU"]
fn levels_on_the_sphere() {
    let heights = [0.0, 0.3, 0.7, 1.2, 1.8, 2.5, 3.4];
    let globe = levels((-180.0, 170.0, 36), (-90.0, 90.0, 37), &heights, true);
    let around = FlowMap { boundary: Boundary::Clamp, difference_step: 1e-3, ..map(3.2, 16) };
    check("levels, globe", &smooth(&globe, 0.8, false), &around, 0.1);
    let region = levels((-30.0, 10.0, 21), (20.0, 60.0, 21), &heights, false);
    let stop = FlowMap { boundary: Boundary::Stop, direction: Direction::Backward, difference_step: 1e-3, ..map(3.2, 16) };
    check("levels, region, holes", &smooth(&region, 0.5, true), &stop, 3.4);
    check("levels, cubic", &smooth(&region, 0.5, false), &FlowMap { interpolation: Interpolation::Cubic, ..stop.clone() }, 3.4);
    check("levels, differences", &smooth(&region, 0.5, false), &FlowMap { integrator: Integrator::Differences, ..stop }, 3.4);
}

#[test]
#[ignore = "needs a GPU"]
fn batches_of_every_size_are_written_whole() {
    let source = turbulence([24, 16, 16], 4);
    let map = FlowMap { boundary: Boundary::Clamp, precision: Precision::F32, ..map(3.0, 6) };
    for count in [1, 2, 127, 4095, 4096, 4097, 100_003] {
        let seeds = fresh(&domain(&source), count);
        let sorted = on_gpu(&source, &map, 0.0, Tuning::default(), &seeds);
        let given = on_gpu(&source, &map, 0.0, Tuning { sorted: false, ..Tuning::default() }, &seeds);
        assert!(sorted.log_stretch.iter().all(|s| s.is_finite()), "{count} seeds: something was not written");
        assert_eq!(sorted.log_stretch, given.log_stretch, "{count} seeds: the order of tracing changes nothing");
        assert_eq!(sorted.jacobian, given.jacobian, "{count} seeds");
    }
    assert!(on_gpu(&source, &map, 0.0, Tuning::default(), &[]).log_stretch.is_empty());
}

/// More seeds than f32 can count, traced and sorted in one batch.
#[test]
#[ignore = "needs a GPU"]
fn more_than_2_to_the_24_seeds_at_once() {
    let source = turbulence([24, 16, 16], 4);
    let map = FlowMap { boundary: Boundary::Clamp, precision: Precision::F32, ..map(3.0, 6) };
    let some = fresh(&domain(&source), 20_011);
    let seeds: Vec<DomainPoint> = some.iter().copied().cycle().take((1 << 24) + 4_099).collect();
    let apart = on_gpu(&source, &map, 0.0, Tuning::default(), &some);
    let gpu = gpu();
    let tracer = CudaTracer::new(store(), &gpu, source, &map, 0.0, Tuning::default()).unwrap();
    let points = gpu.upload::<[f32; 3]>("seeds", bytemuck::cast_slice(&seeds)).unwrap();
    let values = gpu.upload("values", &vec![f32::NAN; seeds.len()]).unwrap();
    let out = Outputs { log_stretch: values.address(), ..Outputs::default() };
    // SAFETY: both buffers hold as many entries, and reading waits for the stream.
    unsafe { tracer.device().trace(points.address(), seeds.len(), &out) }.unwrap();
    let mut found = vec![f32::NAN; seeds.len()];
    values.read(&mut found).unwrap();
    for (i, found) in found.iter().enumerate() {
        assert_eq!(*found, apart.log_stretch[i % some.len()], "seed {i}");
    }
}
