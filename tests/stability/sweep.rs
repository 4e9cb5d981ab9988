//! Sweeps, errors, and the rows that they print.

use crate::kit::flow::trace;
use ridgewatch::field::{Axis, Domain, Geometry, Grid, Snapshot, Window};
use ridgewatch::field::{DomainPoint, UnitPoint, analytic::Analytic};
use ridgewatch::flow::{Extras, FlowMap, Integrator, Precision, VelocitySource};
use ridgewatch::publish::compare_films;
use ridgewatch::render::{Film, MAP_TONE, map_radiance, map_range};
use std::f64::consts::TAU;
use std::sync::Arc;

/// The default `flow.tolerance` of closed forms: log-stretch, root mean square. A method has failed where its error is larger.
pub const TOLERANCE: f64 = 0.01;

/// A row of the table: what fails, where, the number that shows it, what the program does, the error meanwhile, the test.
pub fn row(cells: [&str; 6]) {
    println!("\n| {} |", cells.join(" | "));
    let page = include_str!("../../docs/accuracy.md");
    let (first, last) = (format!("| {} |", cells[0]), format!("| {} |", cells[5]));
    let is_there = page.lines().any(|line| line.starts_with(&first) && line.ends_with(&last));
    assert!(is_there, "docs/accuracy.md has no row `{}` of {}", cells[0], cells[5]);
}

/// Place where a condition begins to hold, to a relative accuracy of 1e-4: it must not hold at `low` and must hold at `high`.
pub fn bisect(mut low: f64, mut high: f64, mut fails: impl FnMut(f64) -> bool) -> f64 {
    assert!(!fails(low) && fails(high), "the sweep from {low} to {high} does not bracket the failure");
    while high / low > 1.0 + 1e-4 {
        let middle = (low * high).sqrt();
        if fails(middle) { high = middle } else { low = middle }
    }
    high
}

pub fn rms(values: impl IntoIterator<Item = f64>) -> f64 {
    let (sum, count) = values.into_iter().fold((0.0, 0), |(sum, count), v| (sum + v * v, count + 1));
    (sum / f64::from(count.max(1))).sqrt()
}

/// Root mean square difference; infinite if any is not finite.
pub fn rms_difference(a: &[f64], b: &[f64]) -> f64 {
    let found = rms(a.iter().zip(b).map(|(a, b)| a - b));
    if found.is_nan() { f64::INFINITY } else { found }
}

/// PSNR, in decibels, of the map that a run draws of these log-stretches, one a pixel, beside that of the exact ones and in its colours. Infinite if no
/// pixel differs.
pub fn map_psnr(found: &[f64], exact: &[f64]) -> f64 {
    let [low, high] = map_range(exact.iter().map(|&stretch| stretch as f32), false);
    let map = |stretches: &[f64]| {
        let mut film = Film::new(stretches.len(), 1);
        for (pixel, stretch) in film.rgba.iter_mut().zip(stretches) {
            // What has no value is drawn black.
            let [r, g, b] = if stretch.is_finite() { map_radiance((stretch - low) / (high - low)) } else { [0.0; 3] };
            *pixel = [r, g, b, 1.0];
        }
        film
    };
    compare_films(&map(found), &map(exact), MAP_TONE).unwrap().psnr.unwrap_or(f64::INFINITY)
}

/// A PSNR in words.
pub fn decibels(psnr: f64) -> String {
    if psnr.is_finite() { format!("{psnr:.1} dB") } else { "no difference".to_owned() }
}

/// Midpoints of a lattice over a domain, in the plane.
pub fn lattice(domain: &Domain, [nx, ny]: [usize; 2]) -> Vec<DomainPoint> {
    let unit = |n: usize| UnitPoint([((n % nx) as f32 + 0.5) / nx as f32, ((n / nx) as f32 + 0.5) / ny as f32, 0.5]);
    (0..nx * ny).map(|n| domain.from_unit(unit(n))).collect()
}

/// Log-stretches of seeds.
pub fn traced(source: &VelocitySource, map: &FlowMap, t0: f64, seeds: &[DomainPoint]) -> Vec<f64> {
    trace(source, map, t0, seeds, Extras::default()).unrounded()
}

pub fn map(tau: f64, steps: usize, precision: Precision) -> FlowMap {
    FlowMap { precision, ..FlowMap::tangent(tau, steps) }
}

/// Adaptive integration in double precision.
pub fn adaptive(tau: f64) -> FlowMap {
    FlowMap { integrator: Integrator::DormandPrince, ..map(tau, 1, Precision::F64) }
}

pub fn gyre() -> Analytic {
    Analytic::DoubleGyre { amplitude: 0.1, epsilon: 0.25, omega: TAU / 10.0 }
}

pub fn gyre_box() -> Domain {
    Domain::slab([0.0, 0.0], [2.0, 1.0], (0.0, 1.0))
}

pub fn double_gyre() -> VelocitySource {
    VelocitySource::Analytic(gyre(), gyre_box())
}

/// A closed form over the square from -1 to 1.
pub fn in_square(flow: Analytic) -> VelocitySource {
    VelocitySource::Analytic(flow, Domain::slab([-1.0, -1.0], [1.0, 1.0], (0.0, 1.0)))
}

/// A Cartesian grid of evenly spaced nodes from 0 to `edges`.
pub fn grid(edges: [f64; 2], nodes: [usize; 2]) -> Arc<Grid> {
    let axis = |k: usize| Axis::uniform(["x", "y"][k], "", 0.0, edges[k], nodes[k]).unwrap();
    Arc::new(Grid { axes: vec![axis(0), axis(1)], geometry: Geometry::Cartesian, slab: (0.0, 1.0) })
}

/// Snapshots `interval` apart over `tau`.
pub fn window(tau: f64, interval: f64, snapshot: impl Fn(f64) -> Snapshot) -> Arc<Window> {
    let mut window = Window::new(tau);
    for i in 0..=(tau / interval).round() as usize {
        window.push(Arc::new(snapshot(i as f64 * interval))).unwrap();
    }
    Arc::new(window)
}

/// The double gyre on `nodes` along x and about half as many along y.
pub fn gridded_gyre(nodes: usize, tau: f64, interval: f64) -> Arc<Window> {
    let grid = grid([2.0, 1.0], [nodes, nodes / 2 + 1]);
    window(tau, interval, |time| gyre().snapshot(time, &grid))
}
