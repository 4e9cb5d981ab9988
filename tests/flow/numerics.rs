//! FTLE against closed forms, against the reference integrator, and between settings that must agree.

use crate::kit::flow::{EVERYTHING, trace};
use ridgewatch::field::turbulence::Turbulence;
use ridgewatch::field::{Axis, Domain, Geometry, Grid, Snapshot, Window};
use ridgewatch::field::{DomainPoint, UnitPoint, analytic::Analytic};
use ridgewatch::flow::{
    Boundary, Direction, Extras, FlowError, FlowMap, Integrator, Interpolation, Normalisation, Order, Precision, Steps, Traced, Tracer,
    VelocitySource, cpu_tracer, scalar_tracer, time_resolution, tracer_in_order,
};
use std::f64::consts::TAU;
use std::sync::Arc;

fn map(tau: f64, steps: usize, precision: Precision) -> FlowMap {
    FlowMap { precision, ..FlowMap::tangent(tau, steps) }
}

fn reference(tau: f64) -> FlowMap {
    FlowMap { integrator: Integrator::DormandPrince, ..map(tau, 1, Precision::F64) }
}

fn run(source: &VelocitySource, map: &FlowMap, t0: f64, seeds: &[DomainPoint]) -> Traced {
    trace(source, map, t0, seeds, Extras::default())
}

fn run_tracer(tracer: &dyn Tracer, seeds: &[DomainPoint]) -> Traced {
    let mut out = Traced::default();
    tracer.trace(seeds, Extras::default(), &mut out);
    out
}

/// Midpoints of a lattice over a domain.
fn lattice(domain: &Domain, counts: [usize; 3]) -> Vec<DomainPoint> {
    let index = |n: usize| [n % counts[0], n / counts[0] % counts[1], n / counts[0] / counts[1]];
    let unit = |n: usize| std::array::from_fn(|k| (index(n)[k] as f32 + 0.5) / counts[k] as f32);
    (0..counts.iter().product()).map(|n| domain.from_unit(UnitPoint(unit(n)))).collect()
}

fn rms_and_max(a: &[f64], b: &[f64]) -> (f64, f64) {
    let squares: Vec<f64> = a.iter().zip(b).map(|(a, b)| (a - b) * (a - b)).collect();
    ((squares.iter().sum::<f64>() / squares.len() as f64).sqrt(), squares.iter().copied().fold(0.0, f64::max).sqrt())
}

fn sorted_errors(a: &[f64], b: &[f64]) -> Vec<f64> {
    let mut errors: Vec<f64> = a.iter().zip(b).map(|(a, b)| (a - b).abs()).collect();
    errors.sort_by(f64::total_cmp);
    errors
}

fn square() -> Domain {
    Domain::slab([-1.0, -1.0], [1.0, 1.0], (0.0, 1.0))
}

fn gyre() -> Analytic {
    Analytic::DoubleGyre { amplitude: 0.1, epsilon: 0.25, omega: TAU / 10.0 }
}

pub fn double_gyre() -> (VelocitySource, Domain) {
    let domain = Domain::slab([0.0, 0.0], [2.0, 1.0], (0.0, 1.0));
    (VelocitySource::Analytic(gyre(), domain.clone()), domain)
}

fn abc(growth: f64) -> (VelocitySource, Domain) {
    let flow = Analytic::Abc { a: 3f64.sqrt(), b: 2f64.sqrt(), c: 1.0, growth };
    let domain = Domain::cuboid([0.0; 3], [TAU; 3]);
    (VelocitySource::Analytic(flow, domain.clone()), domain)
}

fn shear_stretch(rate: f64, tau: f64) -> f64 {
    let g = rate * tau;
    0.5 * (1.0 + g * g / 2.0 + g * (1.0 + g * g / 4.0).sqrt()).ln()
}

#[test]
fn a_particle_that_lives_all_steps_lives_the_whole_of_tau() {
    // In f32 41 * (1 / 41) is 0.99999994, as with one number of steps in eight.
    let (source, domain) = double_gyre();
    let seeds = lattice(&domain, [4, 4, 1]);
    for steps in [11, 41, 47, 55, 194] {
        for precision in [Precision::F32, Precision::F64] {
            let out = run(&source, &map(1.0, steps, precision), 0.0, &seeds);
            assert!(out.lifetime_share.iter().all(|&share| share == 1.0), "{steps} steps, {precision:?}: {:?}", out.lifetime_share);
        }
    }
}

#[test]
fn linear_flows_equal_their_closed_forms() {
    let seeds = lattice(&square(), [9, 7, 1]);
    for direction in [Direction::Forward, Direction::Backward] {
        for (precision, tolerance) in [(Precision::F32, 1e-5), (Precision::F64, 1e-10)] {
            for (flow, expected) in [
                (Analytic::Saddle { rate: 0.8 }, 0.8 * 5.0),
                (Analytic::Shear { rate: 0.8 }, shear_stretch(0.8, 5.0)),
                (Analytic::Rotation { omega: 0.8 }, 0.0),
            ] {
                // Step times rate is 0.01.
                let map = FlowMap { direction, ..map(5.0, 400, precision) };
                for s in run(&VelocitySource::Analytic(flow.clone(), square()), &map, 0.3, &seeds).unrounded() {
                    // Relative error for saddle and shear, absolute error for the rotation.
                    let error = (s - expected).abs() / if expected == 0.0 { 1.0 } else { expected };
                    assert!(error < tolerance, "{flow:?} {direction:?} {precision:?}: {s} {expected} {error:e}");
                }
            }
        }
    }
}

#[test]
fn long_windows_do_not_overflow() {
    // e^1000 is beyond double, e^88 beyond single precision.
    let source = VelocitySource::Analytic(Analytic::Saddle { rate: 10.0 }, square());
    let seeds = [[0.25, 0.5, 0.0], [0.0, 0.0, 0.0]].map(DomainPoint);
    // Step times rate 0.1: truncation z^4 / 120 = 8e-7 relative; in single precision half an ulp in every step of 0.1.
    for (precision, tolerance) in [(Precision::F32, 1e-5), (Precision::F64, 1e-6)] {
        for s in run(&source, &map(100.0, 10_000, precision), 0.0, &seeds).unrounded() {
            assert!((s / 1000.0 - 1.0).abs() < tolerance, "{precision:?} {s}");
        }
    }
    let s = run(&source, &reference(100.0), 0.0, &seeds[1..]).unrounded()[0];
    assert!((s / 1000.0 - 1.0).abs() < 1e-8, "{s}: local errors of 1e-10 add up over some thousand steps");
}

#[test]
fn double_gyre_and_abc_against_the_reference() {
    for (name, (source, domain), tau, steps, counts) in [
        ("double gyre", double_gyre(), 10.0, 200, [201, 101, 1]),
        ("ABC", abc(0.0), 5.0, 200, [13, 13, 13]),
        ("unsteady ABC", abc(0.5), 5.0, 300, [9, 9, 9]),
    ] {
        let seeds = lattice(&domain, counts);
        let exact = run(&source, &reference(tau), 0.0, &seeds).unrounded();
        // Truncation at these steps; in single precision rounding of the path, which grows with the stretch (up to e^8 here).
        for (precision, tolerance) in [(Precision::F64, 1e-5), (Precision::F32, 3e-4)] {
            let found = run(&source, &map(tau, steps, precision), 0.0, &seeds).unrounded();
            let (rms, max) = rms_and_max(&found, &exact);
            println!("{name}, tangent {precision:?}, {steps} steps: log-stretch rms {rms:.2e}, max {max:.2e}");
            assert!(rms < tolerance, "{name} {precision:?}: {rms:e}");
        }
        let differences = FlowMap { integrator: Integrator::Differences, difference_step: 1e-5, ..map(tau, steps, Precision::F64) };
        let errors = sorted_errors(&run(&source, &differences, 0.0, &seeds).unrounded(), &exact);
        let median = errors[errors.len() / 2];
        println!("{name}, differences F64, gap 1e-5: log-stretch median {median:.2e}, max {:.2e}", errors[errors.len() - 1]);
        // gap^2 times third over first derivatives of the flow map.
        assert!(median < 1e-5, "{name}: {median:e}");
    }
}

#[test]
fn fourth_order_in_the_step() {
    for (name, (source, domain), tau, counts, steps) in
        [("double gyre", double_gyre(), 10.0, [40, 20, 1], 40), ("unsteady ABC", abc(0.5), 4.0, [8, 8, 8], 80)]
    {
        let seeds = lattice(&domain, counts);
        let exact = run(&source, &reference(tau), 0.0, &seeds).unrounded();
        // The median: a few chaotic paths, which converge late, dominate the mean.
        let median = |factor: usize| {
            let errors = sorted_errors(&run(&source, &map(tau, factor * steps, Precision::F64), 0.0, &seeds).unrounded(), &exact);
            errors[errors.len() / 2]
        };
        let errors = [1, 2, 4].map(median);
        let orders = [(errors[0] / errors[1]).log2(), (errors[1] / errors[2]).log2()];
        println!("{name}: median errors {errors:?}, observed orders {orders:.2?}");
        assert!(orders[1] > 3.7 && orders[1] < 4.5, "{name}: {orders:?}");
    }
}

fn turbulence(shape: [usize; 3], snapshots: usize) -> Arc<Window> {
    Arc::new(Turbulence::easy(shape, 0).window(&Turbulence::grid(shape).unwrap(), snapshots).unwrap())
}

fn plane(x: Axis, y: Axis) -> Arc<Grid> {
    Arc::new(Grid { axes: vec![x, y], geometry: Geometry::Cartesian, slab: (0.0, 1.0) })
}

/// A window of snapshots at given times.
fn window_of(times: &[f64], snapshot: impl Fn(f64) -> Snapshot) -> Arc<Window> {
    let mut window = Window::new(times[times.len() - 1] - times[0]);
    for &time in times {
        window.push(Arc::new(snapshot(time))).unwrap();
    }
    Arc::new(window)
}

/// A window of a flow that does not change.
fn steady(grid: &Arc<Grid>, times: &[f64], u: &[f32], v: &[f32]) -> VelocitySource {
    VelocitySource::Window(window_of(times, |time| Snapshot::from_components(time, grid.clone(), u, v, &[])))
}

/// A two-dimensional window of the double gyre on given axes and times.
fn gridded_gyre(x: Axis, y: Axis, times: &[f64]) -> Arc<Window> {
    let grid = plane(x, y);
    window_of(times, |time| gyre().snapshot(time, &grid))
}

fn even(name: &str, first: f64, last: f64, nodes: usize) -> Axis {
    Axis::uniform(name, "", first, last, nodes).unwrap()
}

fn uneven(name: &str, length: f64, nodes: usize) -> Axis {
    let at = |i: usize| {
        let u = i as f64 / (nodes - 1) as f64;
        length * (u + 0.6 * (TAU * u).sin() / TAU)
    };
    Axis::new(name, "", (0..nodes).map(at).collect()).unwrap()
}

#[test]
fn gridded_tangent_is_the_derivative_of_the_gridded_flow() {
    let times = [0.0, 0.7, 1.0, 2.2, 3.0];
    let windows = [
        ("turbulence", turbulence([24, 16, 20], 4), 7),
        ("even axes, uneven times", gridded_gyre(even("x", 0.0, 2.0, 31), even("y", 0.0, 1.0, 21), &times), 1),
        ("uneven axes", gridded_gyre(uneven("x", 2.0, 31), uneven("y", 1.0, 21), &times), 1),
    ];
    for (name, window, layers) in windows {
        let source = VelocitySource::Window(window.clone());
        // No seed lies on the face of a cell, where the linear interpolant has two derivatives.
        let seeds = lattice(&window.grid().unwrap().domain(), [12, 8, layers]);
        for interpolation in [Interpolation::Linear, Interpolation::Cubic] {
            for (direction, t0) in [(Direction::Forward, 0.0), (Direction::Backward, 3.0)] {
                let tangent = FlowMap { boundary: Boundary::Clamp, interpolation, direction, ..map(3.0, 12, Precision::F64) };
                let differences = FlowMap { integrator: Integrator::Differences, difference_step: 1e-7, ..tangent.clone() };
                let exact = run(&source, &tangent, t0, &seeds).unrounded();
                let errors = sorted_errors(&exact, &run(&source, &differences, t0, &seeds).unrounded());
                let high = errors[errors.len() * 95 / 100];
                println!("{name}, {interpolation:?}, {direction:?}: median {:.1e}, 95 % {high:.1e}", errors[errors.len() / 2]);
                // The error of differences is rounding over the difference step, 1e-8 times the stretch. Pairs on both sides of a cell face
                // (linear) or of an edge at some stage see two derivatives; with a difference step of 1e-7 they are rare.
                assert!(high < 3e-6, "{name} {interpolation:?} {direction:?}: {high:e}");
            }
        }
    }
}

#[test]
fn a_fine_grid_comes_near_the_closed_form() {
    let times: Vec<f64> = (0..=80).map(|i| f64::from(i) * 0.125).collect();
    let window = gridded_gyre(even("x", 0.0, 2.0, 321), even("y", 0.0, 1.0, 161), &times);
    let seeds = lattice(&window.grid().unwrap().domain(), [60, 30, 1]);
    let exact = run(&double_gyre().0, &map(10.0, 160, Precision::F64), 0.0, &seeds).unrounded();
    let error = |interpolation| {
        let map = FlowMap { boundary: Boundary::Clamp, interpolation, ..map(10.0, 160, Precision::F32) };
        rms_and_max(&run(&VelocitySource::Window(window.clone()), &map, 0.0, &seeds).unrounded(), &exact).0
    };
    let (linear, cubic) = (error(Interpolation::Linear), error(Interpolation::Cubic));
    println!("gridded double gyre: linear {linear:.2e}, cubic {cubic:.2e} (log-stretch, rms) from the closed form");
    // The linear interpolant's gradient is off by up to half a cell's change, 1 % of the rate, with changing sign.
    assert!(linear < 0.05 && cubic < linear);
}

#[test]
fn vectors_equal_scalars_and_order_does_not_matter() {
    let window = turbulence([48, 24, 24], 6);
    let cells = window.grid().unwrap().domain();
    let cases = [
        (VelocitySource::Window(window), cells, Boundary::Clamp, 5.0),
        (abc(0.5).0, abc(0.5).1, Boundary::Unbounded, 3.0),
        (double_gyre().0, double_gyre().1, Boundary::Unbounded, 10.0),
    ];
    for (source, domain, boundary, tau) in cases {
        // More seeds than the limit for sorting, and not a multiple of the lanes.
        let seeds = lattice(&domain, [29, 17, 13]);
        for integrator in [Integrator::Tangent, Integrator::Differences] {
            for (precision, gap, tolerance) in [(Precision::F32, 1e-2, 2e-5), (Precision::F64, 1e-5, 1e-9)] {
                let map = FlowMap { boundary, integrator, difference_step: gap, ..map(tau, 20, precision) };
                let sorted = run(&source, &map, 0.0, &seeds);
                let given = run_tracer(&*tracer_in_order(source.clone(), &map, 0.0, Order::Given).unwrap(), &seeds);
                assert_eq!(sorted.log_stretch, given.log_stretch, "the same numbers, bit by bit");
                let scalar = run_tracer(&*scalar_tracer(source.clone(), &map, 0.0).unwrap(), &seeds);
                let errors = sorted_errors(&sorted.unrounded(), &scalar.unrounded());
                let high = errors[errors.len() * 99 / 100];
                // Only logarithms differ; the flow amplifies their different rounding (by up to 1e3).
                assert!(high < tolerance, "{integrator:?} {precision:?}: {high:e}");
            }
        }
    }
}

#[test]
fn missing_cells_and_edges_stop_particles() {
    // Uniform flow to the right at one cell a time unit; a missing node at x = 6, y = 2.
    let grid = plane(even("x", 0.0, 10.0, 11), even("y", 0.0, 4.0, 5));
    let mut u = vec![1.0; grid.nodes()];
    u[2 * 11 + 6] = f32::NAN;
    let source = steady(&grid, &[0.0, 8.0], &u, &vec![0.0; grid.nodes()]);
    let seeds = [[1.5, 2.5, 0.5], [1.5, 0.5, 0.5], [4.5, 0.5, 0.5], [6.5, 2.5, 0.5]].map(DomainPoint);
    // The cubic reads one node further in each direction: `coast` is the x of the first stop, `free` that of the second row.
    for (interpolation, coast, free) in [(Interpolation::Linear, 5.0, 9.5), (Interpolation::Cubic, 4.0, 4.0)] {
        let map = FlowMap { boundary: Boundary::Stop, interpolation, ..map(8.0, 80, Precision::F32) };
        let out = trace(&source, &map, 0.0, &seeds, EVERYTHING);
        // A path stops within the step of 0.1 that would cross.
        assert!((out.lifetime_share[0] - (coast - 1.5) / 8.0).abs() < 0.02, "stops before the missing corner: {:?}", out.lifetime_share);
        assert!((out.arrival[0].0[0] - coast).abs() < 0.11, "{:?}", out.arrival);
        assert!((out.arrival[1].0[0] - free).abs() < 0.11, "{:?}", out.arrival);
        assert_eq!(out.lifetime_share[3], 0.0, "starts in a cell with a missing corner");
        assert!(out.log_stretch.iter().all(|s| s.abs() < 1e-6), "uniform flow does not stretch: {:?}", out.log_stretch);
        assert!((out.jacobian[1][0] - 1.0).abs() < 1e-6 && out.jacobian[1][8] == 1.0);
        if interpolation == Interpolation::Linear {
            assert!((out.lifetime_share[2] - 5.5 / 8.0).abs() < 0.02, "stops at the edge of the domain");
            // The adaptive reference comes nearer to the edge.
            let exact = run(&source, &FlowMap { integrator: Integrator::DormandPrince, ..map }, 0.0, &seeds);
            assert!((f64::from(exact.lifetime_share[2]) - 5.5 / 8.0).abs() < 1e-6, "{:?}", exact.lifetime_share);
        }
    }
}

#[test]
fn particles_that_stop_keep_their_stretch_or_not() {
    // A saddle in a box: a particle at x0 leaves at ln(1 / x0).
    let source = VelocitySource::Analytic(Analytic::Saddle { rate: 1.0 }, square());
    let seeds = [[0.5, 0.5, 0.5], [0.01, 0.5, 0.5]].map(DomainPoint);
    let with = |boundary, normalisation| run(&source, &FlowMap { boundary, normalisation, ..map(2.0, 2000, Precision::F64) }, 0.0, &seeds);
    let stop = with(Boundary::Stop, Normalisation::Tau);
    let lifetime_share = 2f64.ln() / 2.0;
    // A path stops within a step, which is 1/2000 of the span.
    assert!((f64::from(stop.lifetime_share[0]) - lifetime_share).abs() < 6e-4);
    assert!((stop.log_stretch_f64[0] - 2.0 * lifetime_share).abs() < 1.2e-3);
    assert!((stop.log_stretch_f64[1] - 2.0).abs() < 1e-10 && stop.lifetime_share[1] == 1.0);
    let by_life = with(Boundary::Stop, Normalisation::Lifetime);
    assert!((by_life.log_stretch_f64[0] - 2.0).abs() < 1e-9, "stretch over life is the rate: {}", by_life.log_stretch_f64[0]);
    let zero = with(Boundary::Zero, Normalisation::Tau);
    assert_eq!(zero.log_stretch[0], 0.0);
    assert!((zero.log_stretch_f64[1] - 2.0).abs() < 1e-10);
    // Beyond the edge the clamped velocity is constant along x, so that the stretch ends.
    let clamp = with(Boundary::Clamp, Normalisation::Tau);
    assert_eq!(clamp.lifetime_share, [1.0, 1.0]);
    assert!((clamp.log_stretch_f64[0] - 2.0 * lifetime_share).abs() < 1.2e-3, "{}", clamp.log_stretch_f64[0]);
}

#[test]
fn a_periodic_seam_is_a_cell_like_others() {
    // The same periodic flow, once with paths across the seam and once shifted away from it.
    let nodes = 36;
    let make = |shift: usize| {
        let axis = even("x", 0.0, (nodes - 1) as f64, nodes).with_period(nodes as f64);
        let grid = plane(axis, even("y", -9.0, 9.0, 37));
        let phase = |i: usize| TAU * ((i % nodes + shift) % nodes) as f64 / nodes as f64;
        let u: Vec<f32> = (0..grid.nodes()).map(|i| 2.0 + 0.5 * phase(i).sin() as f32).collect();
        let v: Vec<f32> = (0..grid.nodes()).map(|i| 0.5 * phase(i).cos() as f32).collect();
        steady(&grid, &[0.0, 2.0, 6.0], &u, &v)
    };
    let at = |x: f32| -> Vec<DomainPoint> { (0..9).map(|i| DomainPoint([x + i as f32 * 0.25, 0.125 * i as f32, 0.5])).collect() };
    for interpolation in [Interpolation::Linear, Interpolation::Cubic] {
        let map = FlowMap { boundary: Boundary::Stop, interpolation, ..map(6.0, 60, Precision::F64) };
        let across = run(&make(0), &map, 0.0, &at(30.0));
        let beside = run(&make(18), &map, 0.0, &at(12.0));
        assert!(across.lifetime_share.iter().all(|&l| l == 1.0), "no edge there");
        let (_, max) = rms_and_max(&across.unrounded(), &beside.unrounded());
        assert!(max < 1e-12, "{interpolation:?} {max:e}: the same numbers at other places, except for rounding");
        assert!(across.unrounded()[4] > 0.05, "and there is stretch");
    }
}

#[test]
fn jacobian_and_arrival_are_those_of_the_flow_map() {
    // Cells are not square, so that lengths and cells must not be mixed up.
    let window = gridded_gyre(even("x", -0.5, 2.5, 61), even("y", -0.5, 1.5, 121), &[0.0, 0.5, 1.0, 1.5]);
    let map = FlowMap { boundary: Boundary::Clamp, interpolation: Interpolation::Cubic, ..map(1.5, 30, Precision::F64) };
    let (x, y, step) = (0.73125f32, 0.375f32, 1.0f32 / 64.0);
    let seeds = [[x, y, 0.5], [x + step, y, 0.5], [x - step, y, 0.5], [x, y + step, 0.5], [x, y - step, 0.5]].map(DomainPoint);
    let out = trace(&VelocitySource::Window(window), &map, 0.0, &seeds, EVERYTHING);
    for i in 0..2 {
        for j in 0..2 {
            let difference = (out.arrival[1 + 2 * j].0[i] - out.arrival[2 + 2 * j].0[i]) / (2.0 * step);
            // step^2 times third derivatives of about 20, over 6.
            assert!((difference - out.jacobian[0][3 * i + j]).abs() < 2e-3, "{i} {j}: {difference} {:?}", out.jacobian[0]);
        }
    }
}

#[test]
fn steps_are_chosen_by_error() {
    let (source, domain) = double_gyre();
    let automatic = |tolerance| {
        let map = FlowMap { steps: Steps::Auto { tolerance }, ..map(10.0, 1, Precision::F32) };
        cpu_tracer(source.clone(), &map, 0.0).unwrap().steps()
    };
    let (coarse, fine) = (automatic(1e-1), automatic(1e-3));
    println!("double gyre, tau 10: {coarse} steps for 1e-1, {fine} for 1e-3");
    assert!(coarse < fine);
    let seeds = lattice(&domain, [50, 25, 1]);
    let exact = run(&source, &reference(10.0), 0.0, &seeds).unrounded();
    let (rms, _) = rms_and_max(&run(&source, &map(10.0, fine, Precision::F64), 0.0, &seeds).unrounded(), &exact);
    // 16/15 of the difference to twice as many steps, measured on other points.
    assert!(rms < 1.5e-3, "{rms:e}");

    let gridded = FlowMap { boundary: Boundary::Clamp, steps: Steps::Auto { tolerance: 2e-2 }, ..map(11.0, 1, Precision::F32) };
    let steps = cpu_tracer(VelocitySource::Window(turbulence([32, 16, 16], 12)), &gridded, 0.0).unwrap().steps();
    println!("easy turbulence, tau 11: {steps} steps for 2e-2");
    assert_eq!(steps % 11, 0, "whole steps an interval");

    // In a uniform wind any number of steps is exact. There is at least one step a cell, and two an interval.
    let grid = plane(even("x", 0.0, 100.0, 101), even("y", 0.0, 100.0, 101));
    for (speed, steps) in [(0.1f32, 6), (8.4, 27), (40.0, 120), (1e30, 768)] {
        let source = steady(&grid, &[0.0, 1.0, 2.0, 3.0], &vec![speed; grid.nodes()], &vec![0.0; grid.nodes()]);
        let map = FlowMap { boundary: Boundary::Clamp, steps: Steps::Auto { tolerance: 0.1 }, ..map(3.0, 1, Precision::F32) };
        assert_eq!(cpu_tracer(source, &map, 0.0).unwrap().steps(), steps, "{speed} cells an interval");
    }
}

#[test]
fn steps_on_kinks_are_chosen_by_a_share_of_the_stretch() {
    // Waves shorter than four cells: the gradient of the linear interpolant jumps at every face. Little stretch in a short time.
    let shape = [48, 24, 24];
    let source = VelocitySource::Window(Arc::new(Turbulence::hard(shape, 0).window(&Turbulence::grid(shape).unwrap(), 2).unwrap()));
    let VelocitySource::Window(window) = &source else { unreachable!() };
    let seeds = lattice(&window.grid().unwrap().domain(), [24, 12, 12]);
    let with = |steps| FlowMap { boundary: Boundary::Clamp, steps, ..map(1.0, 1, Precision::F64) };
    let error = |steps| {
        let chosen = cpu_tracer(source.clone(), &with(steps), 0.0).unwrap().steps();
        let of = |steps| run(&source, &with(Steps::Fixed(steps)), 0.0, &seeds).unrounded();
        let fine = of(16 * chosen);
        let size = (fine.iter().map(|s| s * s).sum::<f64>() / fine.len() as f64).sqrt();
        (chosen, rms_and_max(&of(chosen), &fine).0 / size)
    };
    let (plain, by_share) = (error(Steps::Auto { tolerance: 0.1 }), error(Steps::AutoByShare { tolerance: 0.1, share: 0.015 }));
    println!("kinks, tau 1: {plain:?} by the tolerance alone, {by_share:?} by a share of the stretch");
    assert!(plain.1 > 0.03 && by_share.1 < 0.03, "{plain:?} {by_share:?}");
    // A flow without stretch takes no steps for it.
    let grid = plane(even("x", 0.0, 100.0, 101), even("y", 0.0, 100.0, 101));
    let still = steady(&grid, &[0.0, 1.0, 2.0, 3.0], &vec![0.1; grid.nodes()], &vec![0.0; grid.nodes()]);
    let still = cpu_tracer(still, &with(Steps::AutoByShare { tolerance: 0.1, share: 0.015 }), 0.0).unwrap();
    assert_eq!(still.steps(), 2);
}

#[test]
fn time_resolution_is_measured() {
    let gridded = FlowMap { boundary: Boundary::Clamp, ..map(11.0, 22, Precision::F32) };
    let found = time_resolution(&turbulence([48, 24, 24], 12), &gridded, 0.0).unwrap();
    println!("{found:?}");
    // The easy turbulence's root mean square speed, 3 cells on 192, is 0.375 on 24; a box holds few of its largest waves.
    assert!((found.displacement_rms / 0.375 - 1.0).abs() < 0.25);
    assert!(found.displacement_max > found.displacement_rms);
    let change = found.ftle_change.unwrap();
    assert!(change > 0.0 && change < found.ftle_rms);
}

#[test]
fn what_has_no_meaning_is_refused() {
    let refused = |source: &VelocitySource, map: FlowMap, t0: f64| cpu_tracer(source.clone(), &map, t0).err().expect("an error");
    let window = VelocitySource::Window(turbulence([8, 8, 8], 5));
    let clamp = FlowMap { boundary: Boundary::Clamp, ..map(6.0, 6, Precision::F32) };
    let error = refused(&window, clamp.clone(), 0.0);
    assert_eq!(error, FlowError::WindowTooShort { from: 0.0, to: 6.0, needed: 7, present: 5, covered: Some((0.0, 4.0)) });
    assert_eq!(error.to_string(), "tracing from 0 to 6 needs about 7 snapshots that cover this span; the window holds 5, from 0 to 4");
    let empty = VelocitySource::Window(Arc::new(Window::new(1.0)));
    assert!(matches!(refused(&empty, clamp, 0.0), FlowError::WindowTooShort { present: 0, .. }));
    let short = map(3.0, 6, Precision::F32);
    assert!(matches!(refused(&window, short.clone(), 0.0), FlowError::NotOnGrids { .. }));
    let backward = FlowMap { boundary: Boundary::Stop, direction: Direction::Backward, ..short.clone() };
    assert!(matches!(refused(&window, backward.clone(), 1.0), FlowError::WindowTooShort { .. }));
    assert!(cpu_tracer(window.clone(), &backward, 4.0).is_ok());
    let gap = |gap| FlowMap { integrator: Integrator::Differences, difference_step: gap, boundary: Boundary::Stop, ..short.clone() };
    assert!(matches!(refused(&window, gap(0.0), 0.0), FlowError::OutOfRange { key: "difference_step", .. }));
    assert!(matches!(refused(&window, gap(1e-8), 0.0), FlowError::DifferenceStepVanishes { .. }));
    assert!(cpu_tracer(window.clone(), &FlowMap { precision: Precision::F64, ..gap(1e-8) }, 0.0).is_ok());
    let gyre_map = |map: FlowMap| refused(&double_gyre().0, map, 0.0);
    assert!(matches!(gyre_map(FlowMap { tau: f64::NAN, ..short.clone() }), FlowError::OutOfRange { key: "tau", .. }));
    assert!(matches!(gyre_map(FlowMap { steps: Steps::Fixed(0), ..short.clone() }), FlowError::OutOfRange { key: "steps", .. }));
    let hopeless = FlowMap { steps: Steps::Auto { tolerance: 1e-300 }, tau: 0.1, ..short.clone() };
    assert!(matches!(gyre_map(hopeless), FlowError::StepsNotFound { .. }));
    let cube = VelocitySource::Analytic(gyre(), Domain::cuboid([0.0; 3], [1.0; 3]));
    assert_eq!(refused(&cube, short, 0.0), FlowError::Dimensions { flow: 2, domain: 3 });
}

#[test]
fn fine_steps_on_a_grid_converge_to_the_reference() {
    let window = turbulence([24, 16, 20], 4);
    let seeds = lattice(&window.grid().unwrap().domain(), [6, 5, 5]);
    let source = VelocitySource::Window(window);
    let with = |map: FlowMap| run(&source, &FlowMap { boundary: Boundary::Clamp, ..map }, 0.0, &seeds).unrounded();
    let exact = with(reference(3.0));
    let coarse = rms_and_max(&with(map(3.0, 24, Precision::F64)), &exact).0;
    let fine = rms_and_max(&with(map(3.0, 1536, Precision::F64)), &exact).0;
    println!("gridded turbulence against the reference: 24 steps {coarse:.1e}, 1536 steps {fine:.1e}");
    // The linear interpolant's derivative jumps at cell faces, which makes the tangent first order in the step: 64 times as many
    // steps leave a 64th. Half of that is required, since signs change from face to face.
    assert!(fine < coarse / 32.0, "{coarse:e} {fine:e}");
}
