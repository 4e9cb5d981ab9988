//! Integration: difference gaps, steps beyond the stability limit, long integration times, vanishing velocity.

use crate::kit::flow::{EVERYTHING, trace};
use crate::kit::scene;
use crate::sweep::{
    TOLERANCE, adaptive, bisect, decibels, double_gyre, gyre_box, in_square, lattice, map, map_psnr, rms_difference, row, traced, window,
};
use ridgewatch::field::{Axis, Domain, DomainPoint, Geometry, Grid, Snapshot, analytic::Analytic};
use ridgewatch::flow::{
    Boundary, Extras, FlowError, FlowMap, IntegrationDifferences, Integrator, Interpolation, Precision, Steps, VelocitySource, cpu_tracer,
    integration_differences,
};
use ridgewatch::run::{FrameRecord, RunOptions};
use std::sync::Arc;

const TAU: f64 = 10.0;
const SQUARE: &str = "domain.min = [-1, -1, 0]\ndomain.max = [1, 1, 0.2]\ntransfer.low = 0\ntransfer.high = 2\n";

/// What a run measures of a flow map with a given number of steps.
fn measured(source: &VelocitySource, map: &FlowMap) -> IntegrationDifferences {
    integration_differences(source, map, 0.0, None, Steps::Auto { tolerance: TOLERANCE }).unwrap().unwrap()
}

/// The record of the first frame of a scene.
fn record(kind: &str, keys: &str) -> FrameRecord {
    let (mut records, keys) = (Vec::new(), format!("{keys}\nrender.method = \"reference\""));
    let setup = scene::setup(&scene::scene(kind, [8, 4, 1], &keys), &[]);
    scene::run_frames(setup, &RunOptions::default(), |frame| records.push((*frame.record).clone()));
    records.swap_remove(0)
}

fn warns(record: &FrameRecord, of: &str) -> bool {
    record.warnings.iter().any(|warning| warning.starts_with(of))
}

#[test]
fn difference_gap() {
    let (source, seeds) = (double_gyre(), lattice(&gyre_box(), [60, 30]));
    let exact = traced(&source, &adaptive(TAU), 0.0, &seeds);
    let of_a_run = |keys: &str| record("double_gyre", &format!("{}time.tau = {TAU}\nflow.steps = 200\n{keys}", scene::GYRE_BOX));
    let wide = of_a_run("flow.integrator = \"differences\"\nflow.difference_step = 0.01");
    assert!(wide.tangent_difference.unwrap() > TOLERANCE && warns(&wide, "flow.integrator = \"differences\""), "{:?}", wide.warnings);
    let tangent = of_a_run("");
    assert!(tangent.tangent_difference.is_none() && !warns(&tangent, "flow."), "{:?}", tangent.warnings);
    for precision in [Precision::F32, Precision::F64] {
        let tangent = rms_difference(&traced(&source, &map(TAU, 200, precision), 0.0, &seeds), &exact);
        // Gap, error, and the number in the record.
        let mut curve: Vec<(f64, f64, f64)> = Vec::new();
        let mut refused = None;
        for half_decades in 2..=16 {
            let gap = 10f64.powf(-0.5 * f64::from(half_decades));
            let map = FlowMap { integrator: Integrator::Differences, difference_step: gap, ..map(TAU, 200, precision) };
            match cpu_tracer(source.clone(), &map, 0.0) {
                Err(FlowError::DifferenceStepVanishes { min_step, .. }) => refused = refused.or(Some((gap, min_step))),
                Err(error) => panic!("{error}"),
                Ok(_) => {
                    let error = rms_difference(&traced(&source, &map, 0.0, &seeds), &exact);
                    curve.push((gap, error, measured(&source, &map).tangent.unwrap()));
                }
            }
        }
        for (gap, error, recorded) in &curve {
            println!("{precision:?}, gap {gap:.1e}: {error:.1e}, recorded {recorded:.1e}; tangent {tangent:.1e}");
        }
        assert!(curve.iter().all(|c| c.1 < 1.5 * TOLERANCE || c.2 > TOLERANCE), "every gap that fails is warned of: {curve:?}");
        let (best, least, _) = curve.iter().copied().min_by(|a, b| a.1.total_cmp(&b.1)).unwrap();
        let within: Vec<f64> = curve.iter().filter(|c| c.1 <= TOLERANCE).map(|c| c.0).collect();
        let (first, last) = (curve[0].1, curve[curve.len() - 1].1);
        // A U: truncation (gap squared) on one side, rounding (its inverse) on the other.
        assert!(first > 10.0 * least, "a wide gap fails");
        if precision == Precision::F32 {
            assert!(last > 10.0 * least, "and a narrow one");
            // Two particles at the largest coordinate, 2, must differ: its ulp is 2.4e-7.
            let (gap, min_step) = refused.expect("gaps that vanish are refused");
            assert!(gap < min_step && min_step == 2.0 * f64::from(f32::EPSILON), "{gap} {min_step}");
        } else {
            assert!(refused.is_none() && best < 1e-4);
        }
        assert!(tangent < 1.01 * least, "no gap reaches the tangent: {tangent:e} {least:e}");
        let name = format!("differences, {precision:?}").replace("F", "f");
        let smallest = curve[curve.len() - 1].0;
        let range = match (within.last(), within.first()) {
            (Some(low), Some(high)) if *low > smallest => format!("gap above {high:.0e} or below {low:.0e}"),
            (_, Some(high)) => format!("gap above {high:.0e}; none of those down to {smallest:.0e}"),
            _ => "at every gap".to_owned(),
        };
        let wide = curve.iter().take_while(|c| c.1 > TOLERANCE).last().expect("a wide gap fails");
        let number =
            format!("`tangent_difference`: {:.0e} at a gap of {:.0e}, {:.0e} at the smallest", wide.2, wide.0, curve[curve.len() - 1].2);
        let always = format!("warns above {TOLERANCE}; the default is the tangent, which has no gap");
        let does = match refused {
            Some((_, least)) => format!("refuses gaps below {least:.1e}, where pairs coincide; {always}"),
            None => always,
        };
        let picture = |gap: f64| {
            let map = FlowMap { integrator: Integrator::Differences, difference_step: gap, ..map(TAU, 200, precision) };
            map_psnr(&traced(&source, &map, 0.0, &seeds), &exact)
        };
        let pictures = [wide.0, best, smallest].map(picture);
        // In f64 the smallest gap is as good as the best.
        assert!(pictures[0] < pictures[1] && (precision == Precision::F64 || pictures[2] < pictures[1]), "{pictures:?}");
        let [of_wide, of_best, of_smallest] = pictures.map(decibels);
        let error = format!(
            "at best {least:.1e} (gap {best:.0e}), {last:.1e} at the smallest; tangent {tangent:.1e}; map {of_wide} at a gap of {:.0e}, {of_best} at the \
             best, {of_smallest} at the smallest",
            wide.0
        );
        row([&name, &range, &number, &does, &error, "difference_gap"]);
    }
}

#[test]
fn steps_beyond_the_stability_limit() {
    const COUNT: usize = 64;
    // A rate of 1, so that the step is |lambda h|. Rotation: ln |R(iz)| a step. Saddle: its contracting coordinate, R(-z).
    let grows = |flow: &Analytic, z: f64| {
        let map = map(z * COUNT as f64, COUNT, Precision::F64);
        let out = trace(&in_square(flow.clone()), &map, 0.0, &[DomainPoint([0.0, 0.5, 0.5])], EVERYTHING);
        if matches!(flow, Analytic::Rotation { .. }) { out.log_stretch_f64[0] > 0.0 } else { out.arrival[0].0[1].abs() > 0.5 }
    };
    let chosen = |flow: &Analytic, tau: f64| {
        let map = FlowMap { steps: Steps::Auto { tolerance: TOLERANCE }, ..map(tau, 1, Precision::F64) };
        let tracer = cpu_tracer(in_square(flow.clone()), &map, 0.0).unwrap();
        let error = trace(&in_square(flow.clone()), &map, 0.0, &[DomainPoint([0.0, 0.5, 0.5])], Extras::default()).log_stretch_f64[0];
        (tau / tracer.steps() as f64, error, tracer.step_choice().unwrap())
    };
    let limits = [
        // |R(iz)|^2 = 1 - z^6 / 72 + z^8 / 576.
        ("RK4 steps, fast rotation", "rotation", Analytic::Rotation { omega: 1.0 }, 8f64.sqrt(), 0.0),
        // The real root of 1 - z / 2 + z^2 / 6 - z^3 / 24.
        ("RK4 steps, stiff contraction", "saddle", Analytic::Saddle { rate: 1.0 }, 2.785_293_563, 1.0),
    ];
    for (name, kind, flow, limit, rate) in limits {
        let found = bisect(1.0, 4.0, |z| grows(&flow, z));
        assert!((found / limit - 1.0).abs() < 2e-4, "{name}: {found} {limit}");
        // The error of the FTLE where it just fails, in shares of the rate.
        let tau = 1.2 * found * COUNT as f64;
        let wrong = traced(&in_square(flow.clone()), &map(tau, COUNT, Precision::F64), 0.0, &[DomainPoint([0.0, 0.5, 0.5])])[0] / tau;
        let (z, stretch, choice) = chosen(&flow, 100.0);
        assert!(choice.within_tolerance && z < 0.5 * limit, "auto stays clear of the limit: {z}");
        // The difference to twice as many steps is 15/16 of the error (rotation 31/32: its leading term is damping).
        let error = (stretch - rate * 100.0).abs();
        assert!(error < 1.2 * TOLERANCE, "{error}");
        // The same numbers of steps, given to a run.
        let given = |tau: f64, steps: usize| record(kind, &format!("{SQUARE}time.tau = {tau}\nflow.steps = {steps}"));
        let (failed, fine) = (given(tau, COUNT), given(100.0, choice.steps));
        let [told, told_fine] = [&failed, &fine].map(|record| record.integration_difference.unwrap());
        assert!(told > TOLERANCE && warns(&failed, &format!("flow.steps = {COUNT}: ")), "{told} {:?}", failed.warnings);
        assert!(told_fine <= TOLERANCE && !warns(&fine, "flow.steps"), "{told_fine} {:?}", fine.warnings);
        row([
            name,
            &format!("rate x step above {found:.3}"),
            &format!("`integration_difference`: {told:.0} at 1.2 times the limit"),
            &format!("`steps = \"auto\"` takes rate x step {z:.2}; a given number is obeyed, with a warning above {TOLERANCE}"),
            &format!(
                "auto {error:.1e} of the log-stretch; at 1.2 times the limit FTLE {wrong:.2} of the rate instead of {rate:.0}, in every pixel"
            ),
            "steps_beyond_the_stability_limit",
        ]);
    }
    // The gradient of a shear is nilpotent, so that RK4 is exact: g = rate x tau stretches by asinh(g / 2).
    let sheared = |z: f64| {
        let tau = z * COUNT as f64;
        let stretch =
            traced(&in_square(Analytic::Shear { rate: 1.0 }), &map(tau, COUNT, Precision::F64), 0.0, &[DomainPoint([0.0, 0.5, 0.5])])[0];
        (stretch / (0.5 * tau).asinh() - 1.0).abs()
    };
    let worst = [0.1, 1.0, 10.0, 100.0, 1000.0].map(sheared).into_iter().fold(0.0, f64::max);
    assert!(worst < 1e-12, "{worst:e}");
    row([
        "RK4 steps, uniform shear",
        "nowhere up to rate x step 1,000",
        "none is needed",
        "RK4 is exact: the gradient of a uniform shear is nilpotent",
        &format!("at most {worst:.0e} of the log-stretch"),
        "steps_beyond_the_stability_limit",
    ]);
}

/// `flow.tolerance` of archives in two dimensions.
const TOLERANCE_ON_GRIDS: f64 = 0.1;

/// Waves of shear of this rate, whose direction turns once a unit of time: v = (cos(2 pi t) sin(2 pi y), sin(2 pi t) sin(2 pi x)) rate / 2 pi.
fn turning_shear(rate: f64, tau: f64) -> VelocitySource {
    use std::f64::consts::TAU;
    const NODES: usize = 128;
    let axis = |name: &str| Axis::uniform(name, "", 0.0, 1.0 - 1.0 / NODES as f64, NODES).unwrap().with_period(1.0);
    let grid = Arc::new(Grid { axes: vec![axis("x"), axis("y")], geometry: Geometry::Cartesian, slab: (0.0, 1.0) });
    let wave = |node: usize| rate / TAU * (TAU * node as f64 / NODES as f64).sin();
    VelocitySource::Window(window(tau, 1.0 / 16.0, |time| {
        let (sin, cos) = (TAU * time).sin_cos();
        let u: Vec<f32> = (0..grid.nodes()).map(|i| (cos * wave(i / NODES)) as f32).collect();
        let v: Vec<f32> = (0..grid.nodes()).map(|i| (sin * wave(i % NODES)) as f32).collect();
        Snapshot::from_components(time, grid.clone(), &u, &v, &[])
    }))
}

#[test]
fn steps_too_long_for_a_shear_that_turns() {
    const RATE: f64 = std::f64::consts::TAU;
    const TURNS: usize = 2;
    let source = turning_shear(RATE, TURNS as f64);
    let with =
        |steps| FlowMap { steps, boundary: Boundary::Clamp, interpolation: Interpolation::Cubic, ..map(TURNS as f64, 1, Precision::F64) };
    let seeds = lattice(&Domain::slab([0.0, 0.0], [1.0, 1.0], (0.0, 1.0)), [40, 40]);
    let exact = traced(&source, &with(Steps::Fixed(2048 * TURNS)), 0.0, &seeds);
    let adaptive = traced(&source, &FlowMap { integrator: Integrator::DormandPrince, ..with(Steps::Fixed(1)) }, 0.0, &seeds);
    assert!(rms_difference(&exact, &adaptive) < 0.1 * TOLERANCE, "two integrators agree");
    let error = |map: &FlowMap| rms_difference(&traced(&source, map, 0.0, &seeds), &exact);
    let found: Vec<(usize, f64, f64)> = [1, 2, 4, 8, 16, 32, 64]
        .map(|a_turn| {
            let map = with(Steps::Fixed(a_turn * TURNS));
            (a_turn, error(&map), measured(&source, &map).steps)
        })
        .to_vec();
    found.iter().for_each(|(a_turn, error, recorded)| println!("{a_turn} steps a turn: {error:.1e}, recorded {recorded:.1e}"));
    assert!(found.iter().all(|f| f.1 <= TOLERANCE_ON_GRIDS || f.2 > TOLERANCE_ON_GRIDS), "what fails is warned of: {found:?}");
    let fails = found.iter().rposition(|f| f.1 > TOLERANCE).expect("few steps fail");
    let (last, first) = (found[fails], *found.get(fails + 1).expect("many do not"));
    let auto = with(Steps::Auto { tolerance: TOLERANCE_ON_GRIDS });
    let (taken, by_auto) = (cpu_tracer(source.clone(), &auto, 0.0).unwrap().steps() / TURNS, error(&auto));
    assert!(taken >= first.0 && by_auto < TOLERANCE, "{taken} steps a turn: {by_auto:e}");
    let pictures = [last.0, first.0].map(|a_turn| map_psnr(&traced(&source, &with(Steps::Fixed(a_turn * TURNS)), 0.0, &seeds), &exact));
    assert!(pictures[0] < pictures[1], "{pictures:?}");
    row([
        "RK4 steps, shear that turns",
        &format!("{} steps a turn (rate x step {:.2}); {} hold", last.0, RATE / last.0 as f64, first.0),
        &format!("`integration_difference`: {:.2} there, {:.0e} with {}", last.2, first.2, first.0),
        &format!(
            "`steps = \"auto\"` takes {taken} a turn: two a snapshot interval or more; a given number is obeyed, with a warning above \
             {TOLERANCE_ON_GRIDS}"
        ),
        &format!(
            "{:.2} of the log-stretch there, {:.0e} with {}; auto {by_auto:.0e}; map {} there, {} with {}",
            last.1,
            first.1,
            first.0,
            decibels(pictures[0]),
            decibels(pictures[1]),
            first.0
        ),
        "steps_too_long_for_a_shear_that_turns",
    ]);
}

/// Fails without the rescaling of J.
#[test]
fn long_tau_overflows_the_jacobian() {
    let source = in_square(Analytic::Saddle { rate: 1.0 });
    let seed = [DomainPoint([0.25, 0.5, 0.5])];
    // Ten steps a unit: the truncation of the stretch is z^4 / 120 = 8e-7 of it.
    let out = |map: FlowMap| trace(&source, &map, 0.0, &seed, EVERYTHING);
    let with = |tau: f64, integrator, precision| FlowMap { integrator, ..map(tau, (10.0 * tau) as usize, precision) };
    let differences =
        |precision| bisect(10.0, 2000.0, |tau| !out(with(tau, Integrator::Differences, precision)).log_stretch[0].is_finite());
    let jacobian = bisect(10.0, 2000.0, |tau| !out(with(tau, Integrator::Tangent, Precision::F64)).jacobian[0][0].is_finite());
    let [single, double] = [differences(Precision::F32), differences(Precision::F64)];
    // ln of the largest number of each type.
    assert!((jacobian - f64::from(f32::MAX).ln()).abs() < 1.0 && (single - jacobian).abs() < 3.0, "{jacobian} {single}");
    assert!((double - f64::MAX.ln()).abs() < 3.0, "{double}");
    let mut worst: f64 = 0.0;
    for tau in [50.0, 100.0, 700.0, 800.0, 10_000.0] {
        for precision in [Precision::F32, Precision::F64] {
            let s = traced(&source, &with(tau, Integrator::Tangent, precision), 0.0, &seed)[0];
            worst = worst.max((s / tau - 1.0).abs());
            assert!((s / tau - 1.0).abs() < 2e-5, "rescaled, {precision:?}, tau {tau}: {s}");
        }
    }
    row([
        "long tau, overflow of J",
        &format!("log-stretch above {single:.1} (differences, f32), {double:.0} (f64)"),
        "no finite FTLE: the points count as missing",
        "rescales the tangent and carries its logarithm",
        &format!("at most {worst:.0e} of the log-stretch, up to 10,000"),
        "long_tau_overflows_the_jacobian",
    ]);
}

/// Means over squares of a lattice of this width: what pixels of several rays show of it.
fn blocks(values: &[f64], width: usize, edge: usize) -> Vec<f64> {
    let across = width / edge;
    let mut means = vec![0.0; values.len() / (edge * edge)];
    for (i, value) in values.iter().enumerate() {
        means[i / width / edge * across + i % width / edge] += value / (edge * edge) as f64;
    }
    means
}

/// Kolmogorov's distance of two samples.
fn distribution_distance(a: &[f64], b: &[f64]) -> f64 {
    let sorted = |values: &[f64]| {
        let mut values = values.to_vec();
        values.sort_by(f64::total_cmp);
        values
    };
    let (a, b) = (sorted(a), sorted(b));
    let below = |values: &[f64], x: f64| values.partition_point(|v| *v <= x) as f64 / values.len() as f64;
    a.iter().chain(&b).map(|&x| (below(&a, x) - below(&b, x)).abs()).fold(0.0, f64::max)
}

fn correlation(a: &[f64], b: &[f64]) -> f64 {
    let mean = |v: &[f64]| v.iter().sum::<f64>() / v.len() as f64;
    let (ma, mb) = (mean(a), mean(b));
    let sum = |f: &dyn Fn(f64, f64) -> f64| a.iter().zip(b).map(|(a, b)| f(a - ma, b - mb)).sum::<f64>();
    sum(&|a, b| a * b) / (sum(&|a, _| a * a) * sum(&|_, b| b * b)).sqrt()
}

#[test]
fn chaos_parts_single_from_double_precision() {
    let (source, seeds) = (double_gyre(), lattice(&gyre_box(), [40, 20]));
    let mut found = Vec::new();
    for tau in [10.0, 20.0, 40.0, 60.0, 80.0, 120.0, 160.0, 240.0, 320.0] {
        // The same steps, so that only rounding differs.
        let [single, double] = [Precision::F32, Precision::F64]
            .map(|precision| trace(&source, &map(tau, (20.0 * tau) as usize, precision), 0.0, &seeds, EVERYTHING));
        let apart = |i: &usize| (0..2).map(|k| (single.arrival[*i].0[k] - double.arrival[*i].0[k]).powi(2)).sum::<f32>().sqrt() > 0.1;
        let parted = (0..seeds.len()).filter(apart).count() as f64 / seeds.len() as f64;
        let a: Vec<f64> = single.log_stretch.iter().map(|&s| f64::from(s) / tau).collect();
        let b: Vec<f64> = double.log_stretch_f64.iter().map(|&s| s / tau).collect();
        let mean = |v: &[f64]| v.iter().sum::<f64>() / v.len() as f64;
        let drift = mean(&a) / mean(&b) - 1.0;
        let pixels = [&a, &b].map(|values| blocks(values, 40, 4));
        let picture = correlation(&pixels[0], &pixels[1]);
        let recorded = measured(&source, &map(tau, (20.0 * tau) as usize, Precision::F32)).precision.unwrap();
        let maps = map_psnr(&pixels[0], &pixels[1]);
        found.push((tau, parted, correlation(&a, &b), drift, distribution_distance(&a, &b), picture, recorded, maps));
    }
    for (tau, parted, correlation, drift, distance, picture, recorded, maps) in &found {
        let parted = 100.0 * parted;
        println!(
            "tau {tau}: {parted:.1} % parted, correlation {correlation:.4}, of 4x4 {picture:.4}, mean {drift:+.1e}, distribution {distance:.3}, \
             recorded {recorded:.1e}, maps {}",
            decibels(*maps)
        );
    }
    let parts = found.iter().find(|f| f.1 > 0.1).expect("paths part");
    let before = found.iter().rev().find(|f| f.0 < parts.0).unwrap();
    let last = found.last().unwrap();
    // Rounding of 6e-8 grows to 0.1 at a rate of some 0.2: ln(1.6e6) / 0.2 = 70.
    assert!((40.0..=160.0).contains(&parts.0), "{parts:?}");
    assert!(last.1 > 0.5 && last.2 < 0.95, "points lose their value: {last:?}");
    // Two samples of 800 differ by 0.068 (Kolmogorov, 5 %) if they have the same distribution.
    assert!(found.iter().all(|f| f.3.abs() < 0.01 && f.4 < 0.068), "mean and distribution do not: {found:?}");
    assert!(last.7 < found[0].7, "nor does the map keep its pixels: {found:?}");
    assert!(found[0].6 < TOLERANCE && found.iter().all(|f| f.1 < 0.01 || f.6 > TOLERANCE), "paths that part are warned of: {found:?}");
    let told = found.iter().find(|f| f.6 > TOLERANCE).expect("a warning");
    let warned = |tau: f64| {
        let keys = format!("{}time.tau = {tau}\nflow.steps = {}", scene::GYRE_BOX, 20.0 * tau);
        warns(&record("double_gyre", &keys), "flow.precision = \"f32\"")
    };
    assert!(!warned(found[0].0) && warned(parts.0), "a run says so");
    let refused = [40.0, 80.0, 160.0, 320.0].into_iter().find(|&tau| {
        let map = FlowMap { steps: Steps::Auto { tolerance: TOLERANCE }, ..map(tau, 1, Precision::F32) };
        matches!(cpu_tracer(source.clone(), &map, 0.0), Err(FlowError::StepsNotFound { .. }))
    });
    println!("steps = \"auto\" is refused from tau {refused:?}");
    row([
        "long tau, chaos, f32 against f64",
        &format!("tau {} ({:.0} % of the paths part by 0.1; at {}: {:.0} %)", parts.0, 100.0 * parts.1, before.0, 100.0 * before.1),
        &format!("`precision_difference`: {:.1} there, {:.0e} at tau {}", parts.6, found[0].6, found[0].0),
        &format!(
            "warns above {TOLERANCE}, here from tau {} on; `steps = \"auto\"` is refused at tau {}: no number of steps agrees with twice as \
             many",
            told.0,
            refused.map_or("-".into(), |t| t.to_string())
        ),
        &format!(
            "at tau {}: correlation of single FTLEs {:.2}, of pixels of 16 rays {:.2}; the mean {:+.1} %, distributions {:.3} apart (Kolmogorov); map of such \
             pixels {}, at tau {} {}",
            last.0,
            last.2,
            last.5,
            100.0 * last.3,
            last.4,
            decibels(last.7),
            parts.0,
            decibels(parts.7)
        ),
        "chaos_parts_single_from_double_precision",
    ]);
}

#[test]
fn vanishing_velocity() {
    let seeds = [DomainPoint([0.25, 0.5, 0.5])];
    let lost = |precision| {
        bisect(1.0, 1e20, |inverse| {
            let rate = 1.0 / inverse;
            let s = traced(&VelocitySource::clone(&in_square(Analytic::Saddle { rate })), &map(1.0, 16, precision), 0.0, &seeds)[0];
            (s / rate - 1.0).abs() > 0.1
        })
    };
    let [single, double] = [Precision::F32, Precision::F64].map(|precision| 1.0 / lost(precision));
    // J = 1 + s: half an ulp of 1, 6e-8 and 1.1e-16, in each of 16 steps.
    assert!((6e-8..1e-4).contains(&single) && (1.1e-16..1e-12).contains(&double), "{single:e} {double:e}");
    // The velocity of the double gyre, scaled down until the picture says that it shows nothing.
    let warns = |inverse: f64| {
        let keys = format!("render.method = \"reference\"\ntime.tau = 10\nflow.steps = 50\nsource.amplitude = {:e}\n", 0.1 / inverse);
        let mut said = false;
        scene::run_frames(scene::setup(&scene::double_gyre([8, 4, 1], &keys), &[]), &RunOptions::default(), |frame| {
            said |= frame.record.warnings.iter().any(|w| w.starts_with("FTLE is uniform"));
        });
        said
    };
    let mut inverse = 1.0;
    while !warns(inverse) {
        inverse *= 10.0;
        assert!(inverse < 1e12, "no warning");
    }
    row([
        "vanishing velocity",
        &format!("log-stretch below {single:.0e} (f32), {double:.0e} (f64)"),
        "warning in the record: FTLE is uniform",
        &format!("warns when the double gyre is slower by {inverse:.0e}"),
        "FTLE off by 10 % there",
        "vanishing_velocity",
    ]);
}
