//! How fast the CPU traces FTLE samples, and against what. Pairs are run in turns and compared by their medians, so that a busy
//! machine slows both. `cargo bench --bench tracing`; about a minute.

// A benchmark talks to its user on standard output.
#![allow(clippy::print_stdout)]

use ridgewatch::field::turbulence::Turbulence;
use ridgewatch::field::{Axis, Domain, Geometry, Grid, Window};
use ridgewatch::field::{DomainPoint, UnitPoint, analytic::Analytic};
use ridgewatch::flow::{
    Boundary, Extras, FlowMap, Integrator, Order, Precision, Traced, Tracer, VelocitySource, cpu_tracer, scalar_tracer, tracer_in_order,
};
use std::error::Error;
use std::f64::consts::TAU;
use std::sync::Arc;
use std::time::Instant;

const ROUNDS: usize = 5;

fn map(tau: f64, steps: usize, precision: Precision, boundary: Boundary) -> FlowMap {
    FlowMap { precision, difference_step: 1e-3, boundary, ..FlowMap::tangent(tau, steps) }
}

/// Uniform points in no order.
fn scattered(domain: &Domain, count: usize) -> Vec<DomainPoint> {
    let mut state = 0x2545_f491_4f6c_dd1du64;
    let mut uniform = || {
        state ^= state << 13;
        state ^= state >> 7;
        state ^= state << 17;
        (state >> 40) as f32 / (1u32 << 24) as f32
    };
    (0..count).map(|_| domain.from_unit(UnitPoint([uniform(), uniform(), uniform()]))).collect()
}

/// Samples a second of each tracer: medians over rounds in which all take their turn.
fn rates(tracers: &[&dyn Tracer], seeds: &[&[DomainPoint]]) -> Vec<f64> {
    let mut seconds = vec![Vec::new(); tracers.len()];
    let mut out = Traced::default();
    for round in 0..=ROUNDS {
        for (i, tracer) in tracers.iter().enumerate() {
            let start = Instant::now();
            tracer.trace(seeds[i], Extras::default(), &mut out);
            // The first round warms up.
            if round > 0 {
                seconds[i].push(start.elapsed().as_secs_f64());
            }
        }
    }
    seconds
        .iter_mut()
        .zip(seeds)
        .map(|(s, seeds)| {
            s.sort_by(f64::total_cmp);
            seeds.len() as f64 / s[s.len() / 2]
        })
        .collect()
}

fn main() -> Result<(), Box<dyn Error>> {
    if std::env::args().any(|argument| argument == "--test") {
        return Ok(());
    }
    let omega = TAU / 10.0;
    let gyre = Analytic::DoubleGyre { amplitude: 0.1, epsilon: 0.25, omega };
    let plane = Domain::slab([0.0, 0.0], [2.0, 1.0], (0.0, 1.0));
    let cube = Domain::cuboid([0.0; 3], [TAU; 3]);
    let abc = Analytic::Abc { a: 3f64.sqrt(), b: 2f64.sqrt(), c: 1.0, growth: 0.0 };

    let axis = |name: &str, length: f64, nodes: usize| Axis::uniform(name, "", 0.0, length, nodes);
    let grid = Arc::new(Grid { axes: vec![axis("x", 2.0, 401)?, axis("y", 1.0, 201)?], geometry: Geometry::Cartesian, slab: (0.0, 1.0) });
    let mut window = Window::new(10.0);
    for t in 0..=20 {
        window.push(Arc::new(gyre.snapshot(f64::from(t) * 0.5, &grid)))?;
    }
    let gridded_gyre = VelocitySource::Window(Arc::new(window));

    let shape = [96, 48, 48];
    let start = Instant::now();
    let window = Turbulence::easy(shape, 0).window(&Turbulence::grid(shape)?, 12)?;
    println!("easy turbulence 96x48x48, 12 snapshots: made in {:.2} s", start.elapsed().as_secs_f64());
    let cells = Domain::cuboid([0.0; 3], [95.0, 47.0, 47.0]);
    let turbulence = VelocitySource::Window(Arc::new(window));

    let closed = |flow: &Analytic, domain: &Domain| VelocitySource::Analytic(flow.clone(), domain.clone());
    let scenes = [
        (
            "double gyre, tau 10, 100 steps",
            closed(&gyre, &plane),
            plane.clone(),
            map(10.0, 100, Precision::F32, Boundary::Unbounded),
            100_000,
        ),
        (
            "gridded double gyre 401x201, 21 snapshots, tau 10, 100 steps",
            gridded_gyre,
            plane.clone(),
            map(10.0, 100, Precision::F32, Boundary::Clamp),
            30_000,
        ),
        ("ABC, tau 5, 50 steps", closed(&abc, &cube), cube, map(5.0, 50, Precision::F32, Boundary::Unbounded), 100_000),
        (
            "easy turbulence 96x48x48x12, tau 11, 22 steps",
            turbulence.clone(),
            cells.clone(),
            map(11.0, 22, Precision::F32, Boundary::Clamp),
            75_000,
        ),
    ];
    println!(
        "\n{:<62} {:>10} {:>10} {:>10} {:>9} {:>9}",
        "M samples/s (all threads)", "tangent", "differences", "scalar", "x differ.", "x scalar"
    );
    let filter = std::env::args().skip(1).find(|argument| !argument.starts_with('-'));
    let chosen = |name: &str| filter.as_ref().is_none_or(|filter| name.contains(filter.as_str()));
    for (name, source, domain, map, count) in scenes.iter().filter(|scene| chosen(scene.0)) {
        let seeds = scattered(domain, *count);
        for precision in [Precision::F32, Precision::F64] {
            let map = FlowMap { precision, ..map.clone() };
            let tangent = cpu_tracer(source.clone(), &map, 0.0)?;
            let differences = cpu_tracer(source.clone(), &FlowMap { integrator: Integrator::Differences, ..map.clone() }, 0.0)?;
            let scalar = scalar_tracer(source.clone(), &map, 0.0)?;
            let rates = rates(&[&*tangent, &*differences, &*scalar], &[&seeds[..]; 3]);
            let m = |i: usize| rates[i] / 1e6;
            println!(
                "{:<62} {:>10.3} {:>10.3} {:>10.3} {:>9.2} {:>9.2}",
                format!("{name}, {precision:?}"),
                m(0),
                m(1),
                m(2),
                rates[0] / rates[1],
                rates[0] / rates[2]
            );
        }
    }

    println!();
    for (name, shape, count) in [("96x48x48x12 (42 MB)", shape, 1 << 18), ("240x96x96x12 (425 MB)", [240, 96, 96], 1 << 20)] {
        if !chosen("sorted") {
            continue;
        }
        let window = Turbulence::easy(shape, 0).window(&Turbulence::grid(shape)?, 12)?;
        let domain = Domain::cuboid([0.0; 3], shape.map(|n| n as f64 - 1.0));
        let source = VelocitySource::Window(Arc::new(window));
        let map = map(11.0, 11, Precision::F32, Boundary::Clamp);
        let seeds = scattered(&domain, count);
        let sorted = cpu_tracer(source.clone(), &map, 0.0)?;
        let given = tracer_in_order(source, &map, 0.0, Order::Given)?;
        let rates = rates(&[&*sorted, &*given], &[&seeds, &seeds]);
        println!(
            "turbulence {name}, 11 steps, {count} random seeds: sorted {:.2} M/s, as given {:.2} M/s, ratio {:.2}",
            rates[0] / 1e6,
            rates[1] / 1e6,
            rates[0] / rates[1]
        );
    }

    if !chosen("reference scene") {
        return Ok(());
    }
    let reference = cpu_tracer(closed(&gyre, &plane), &map(40.0, 400, Precision::F32, Boundary::Zero), 0.0)?;
    let seeds = scattered(&plane, 1 << 17);
    let rate = rates(&[&*reference], &[&seeds])[0];
    let mut out = Traced::default();
    reference.trace(&seeds, Extras::default(), &mut out);
    let lifetime_share = out.lifetime_share.iter().map(|&l| f64::from(l)).sum::<f64>() / seeds.len() as f64;
    println!(
        "\nreference scene (double gyre, tau 40, 400 steps, box [0,2]x[0,1]): {:.0} thousand FTLE samples/s on {} threads, mean steps completed {:.1}",
        rate / 1e3,
        rayon::current_num_threads(),
        400.0 * lifetime_share
    );
    Ok(())
}
