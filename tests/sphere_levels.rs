//! Longitude, latitude and height: flows over the poles whose stretch is known.
#![allow(clippy::unwrap_used, clippy::print_stdout)] // Tests: a panic is the report.

use ridgewatch::field::{Axis, EARTH_RADIUS, Geometry, Grid, Snapshot, Window};
use ridgewatch::flow::{
    Boundary, Direction, Extras, FlowMap, Integrator, Interpolation, Normalisation, Precision, Steps, Traced, VelocitySource, cpu_tracer,
};
use std::f64::consts::TAU;
use std::sync::Arc;

const DAY: f64 = 86_400.0;
const TOP: f64 = 20_000.0;

fn map(tau: f64, steps: usize, precision: Precision, interpolation: Interpolation) -> FlowMap {
    FlowMap {
        tau,
        direction: Direction::Forward,
        integrator: Integrator::Tangent,
        precision,
        steps: Steps::Fixed(steps),
        difference_step: 1e-3,
        boundary: Boundary::Stop,
        normalisation: Normalisation::Tau,
        interpolation,
    }
}

/// A steady flow `(u, v, w)` of longitude, latitude (radians) and height, on a globe in cells of `cell` degrees with `levels` levels; one
/// level is none.
fn globe(cell: f64, levels: usize, tau: f64, flow: impl Fn(f64, f64, f64) -> [f64; 3]) -> VelocitySource {
    let (nx, ny) = ((360.0 / cell) as usize, (180.0 / cell) as usize + 1);
    let longitude = Axis::uniform("lon", "degrees_east", 0.0, 360.0 - cell, nx).unwrap().with_period(360.0);
    let latitude = Axis::uniform("lat", "degrees_north", -90.0, 90.0, ny).unwrap();
    // Unevenly spaced, as levels of pressure are.
    let heights: Vec<f64> = (0..levels).map(|k| TOP * (k as f64 / (levels - 1) as f64).powf(1.5)).collect();
    let height = (levels > 1).then(|| Axis::new("z", "m", heights).unwrap());
    let axes = [longitude, latitude].into_iter().chain(height).collect();
    let grid = Arc::new(Grid { axes, geometry: Geometry::Sphere { radius: EARTH_RADIUS }, slab: (0.0, TOP) });
    let at = |k: usize, i: usize| grid.axes.get(k).map_or(0.0, |a| a.coordinates()[i]);
    let all: Vec<[f64; 3]> =
        (0..grid.nodes()).map(|i| flow(at(0, i % nx).to_radians(), at(1, i / nx % ny).to_radians(), at(2, i / (nx * ny)))).collect();
    let component = |c: usize| all.iter().map(|v| v[c] as f32).collect::<Vec<f32>>();
    let mut snapshot = Snapshot::from_components(0.0, grid.clone(), &component(0), &component(1), &component(2));
    let mut window = Window::new(tau);
    window.push(Arc::new(snapshot.clone())).unwrap();
    snapshot.time = tau;
    window.push(Arc::new(snapshot)).unwrap();
    VelocitySource::Window(Arc::new(window))
}

/// East and north components of `rate` radians a second about the axis (sin tilt, 0, cos tilt).
fn turning(rate: f64, tilt: f64, lon: f64, lat: f64) -> [f64; 2] {
    let speed = rate * EARTH_RADIUS;
    [speed * (tilt.cos() * lat.cos() - tilt.sin() * lon.cos() * lat.sin()), speed * tilt.sin() * lon.sin()]
}

/// Seeds even over the globe and the heights; the last ones lie at and beside the poles.
fn seeds(count: usize) -> Vec<[f32; 3]> {
    let mut seeds: Vec<[f32; 3]> = (0..count)
        .map(|i| {
            let latitude = (2.0 * (i as f64 + 0.5) / count as f64 - 1.0).asin().to_degrees();
            [(i as f32 * 137.507_76) % 360.0, latitude as f32, (TOP * (0.1 + 0.8 * (i as f64 * 0.618_034).fract())) as f32]
        })
        .collect();
    // From the poles, and, about an axis through 0 and 180 degrees east in 100 steps a quarter of a turn, straight to them and past them.
    for latitude in [90.0f32, 89.99999, 89.999, 89.99, 89.9, 89.7, 89.1, 89.55, 72.0] {
        for aside in [0.0, 1e-5, 1e-3, 0.01, 0.1, 3.0, 80.0] {
            seeds.extend([[90.0 + aside, latitude, 5000.0], [270.0 - aside, -latitude, 5000.0]]);
        }
    }
    seeds
}

fn trace(source: &VelocitySource, map: &FlowMap, seeds: &[[f32; 3]]) -> Traced {
    let mut out = Traced::default();
    cpu_tracer(source.clone(), map, 0.0).unwrap().trace(seeds, Extras { arrival: true, jacobian: true }, &mut out);
    out
}

fn stretch(out: &Traced) -> Vec<f64> {
    if out.log_stretch_f64.is_empty() { out.log_stretch.iter().map(|&s| f64::from(s)).collect() } else { out.log_stretch_f64.clone() }
}

fn greatest(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max)
}

/// Vector of a point in degrees.
fn vector(p: [f32; 3]) -> [f64; 3] {
    let (lon, lat) = (f64::from(p[0]).to_radians(), f64::from(p[1]).to_radians());
    [lat.cos() * lon.cos(), lat.cos() * lon.sin(), lat.sin()]
}

/// Tilt of the axis: it lies in the plane of the equator, so that paths cross the poles.
const TILT: f64 = TAU / 4.0;

#[test]
fn solid_rotation_about_a_tilted_axis_has_ftle_0() {
    // A quarter of a turn in 10 days.
    let tau = 10.0 * DAY;
    let rate = TAU / 4.0 / tau;
    let seeds = seeds(400);
    // Cubic slopes are off by a cell's square (1.5e-4 rad^2 / 6 at 1 degree) of the rate, over an angle of pi / 2. A cell of c radians
    // beside a pole is c^2 wide: rounding nodes to f32 (6e-8) changes its slope by 6e-8 / c^2 of the rate, 3e-3 at 0.25 degrees, for one or
    // two of the stages of 100 steps: 3e-5. In f32 rounding along the path adds a few 1e-7 a step.
    let all = [1.0, 0.5, 0.25].into_iter().flat_map(|cell| [Precision::F64, Precision::F32].map(|precision| (cell, precision)));
    for (cell, precision, levels, interpolation, tolerance) in all
        .flat_map(|(cell, precision)| [1, 3].map(|levels| (cell, precision, levels, Interpolation::Cubic, 1e-4)))
        // Linear slopes are off by up to half a cell (8.7e-3 at 1 degree) of the rate, to both sides along a path.
        .chain(
            [1.0, 0.5, 0.25]
                .into_iter()
                .flat_map(|cell| [1, 3].map(|levels| (cell, Precision::F64, levels, Interpolation::Linear, 9e-3 * cell))),
        )
    {
        let source = globe(cell, levels, tau, |lon, lat, _| {
            let [u, v] = turning(rate, TILT, lon, lat);
            [u, v, 0.0]
        });
        let out = trace(&source, &map(tau, 100, precision, interpolation), &seeds);
        assert!(out.lived.iter().all(|&l| l == 1.0), "no edge on a globe");
        let worst = greatest(&stretch(&out), &vec![0.0; seeds.len()]);
        println!("solid rotation, {cell} degrees, {levels} level(s), {precision:?}, {interpolation:?}: |FTLE| at most {worst:.1e} / |tau|");
        assert!(worst < tolerance, "{worst:e}");
        // Rodrigues' formula for a quarter of a turn about a: p' = a x p + (p . a) a.
        let a = [TILT.sin(), 0.0, TILT.cos()];
        for (seed, arrival) in seeds.iter().zip(&out.arrival) {
            let (p, q) = (vector(*seed), vector(*arrival));
            let along: f64 = (0..3).map(|i| p[i] * a[i]).sum();
            let cross = [a[1] * p[2] - a[2] * p[1], a[2] * p[0] - a[0] * p[2], a[0] * p[1] - a[1] * p[0]];
            let distance = (0..3).map(|i| (cross[i] + along * a[i] - q[i]).powi(2)).sum::<f64>().sqrt();
            // Linear interpolation shortens vectors by up to (half a cell)^2 / 2 = 4e-5 of themselves, over a way of pi / 2.
            assert!(distance < 1e-4 && (arrival[2] - seed[2]).abs() < 1e-2, "{seed:?} {arrival:?} {distance:e}");
        }
    }
}

/// Velocities of a file are rounded: to 16 bits, 1 / 65532 of their range. Beside a pole a cell is so narrow that this makes slopes.
#[test]
fn packed_rotation_has_an_ftle_beside_the_poles() {
    let tau = 10.0 * DAY;
    let rate = TAU / 4.0 / tau;
    let step = 2.0 * rate * EARTH_RADIUS / 65_532.0;
    let seeds = seeds(400);
    // Twice what was measured.
    for (cell, most, usual) in [(1.0, 3e-3, 1.6e-4), (0.5, 1.5e-2, 3.2e-4), (0.25, 2.2e-2, 6.4e-4)] {
        let source = globe(cell, 1, tau, |lon, lat, _| {
            let [u, v] = turning(rate, TILT, lon, lat).map(|v| (v / step).round() * step);
            [u, v, 0.0]
        });
        let mut stretch = stretch(&trace(&source, &map(tau, 100, Precision::F64, Interpolation::Cubic), &seeds));
        stretch.iter_mut().for_each(|s| *s = s.abs());
        stretch.sort_by(f64::total_cmp);
        let (median, worst) = (stretch[stretch.len() / 2], stretch[stretch.len() - 1]);
        println!("packed rotation, {cell} degrees: |FTLE| {median:.1e} median, {worst:.1e} at most / |tau|");
        assert!(worst < most && median < usual, "{cell}: {worst:e} {median:e}");
    }
}

/// ln of the largest singular value of [[1, g], [0, e]].
fn sheared(g: f64, e: f64) -> f64 {
    (((1.0 + e).hypot(g) + (1.0 - e).hypot(g)) / 2.0).ln()
}

#[test]
fn rotation_that_turns_faster_above_and_rises_has_a_closed_form() {
    // p turns about a tilted axis by b + c (z - m) radians a second, z rises by r (z - m): with E = exp(r tau) and k = (E - 1) / r,
    // z' = m + E (z - m), the angle is b tau + c k (z - m), and between (east, north, up) at seed and arrival J is a rotation of the
    // horizontal, a shear R c k sin(distance to the axis) of it by the height, and E.
    let (tau, middle) = (10.0 * DAY, TOP / 2.0);
    let (b, c, r) = (1.0 / tau, 3.0 / tau / EARTH_RADIUS, -0.4 / tau);
    let (e, k) = ((r * tau).exp(), ((r * tau).exp() - 1.0) / r);
    let source = globe(1.0, 9, tau, |lon, lat, z| {
        let [u, v] = turning(b + c * (z - middle), TILT, lon, lat);
        [u, v, r * (z - middle)]
    });
    let seeds = seeds(300);
    let axis = [TILT.sin(), 0.0, TILT.cos()];
    let expected: Vec<f64> = seeds
        .iter()
        .map(|&seed| {
            let p = vector(seed);
            let along: f64 = (0..3).map(|i| p[i] * axis[i]).sum();
            sheared(EARTH_RADIUS * c * k * (1.0 - along * along).sqrt(), e)
        })
        .collect();
    for (integrator, precision, tolerance) in [
        // Slopes are off by a cell's square, 5e-5 of a shear of up to 2.5.
        (Integrator::Tangent, Precision::F64, 3e-4),
        (Integrator::DormandPrince, Precision::F64, 3e-4),
        (Integrator::Differences, Precision::F64, 3e-4),
        // As above: rounding of angles beside the poles.
        (Integrator::Tangent, Precision::F32, 3e-4),
    ] {
        let map = FlowMap { integrator, ..map(tau, 100, precision, Interpolation::Cubic) };
        let out = trace(&source, &map, &seeds);
        // The seeds behind the first 300 lie beside a pole, where a difference in longitude has no length.
        let count = if integrator == Integrator::Differences { 300 } else { seeds.len() };
        let worst = greatest(&stretch(&out)[..count], &expected[..count]);
        println!(
            "turning faster above, {integrator:?}, {precision:?}: off by at most {worst:.1e} of up to {:.2}",
            sheared(EARTH_RADIUS * c * k, e)
        );
        assert!(worst < tolerance, "{worst:e}");
        for (seed, arrival) in seeds.iter().zip(&out.arrival) {
            let z = middle + e * (f64::from(seed[2]) - middle);
            // Heights of 1e4 in f32.
            assert!((f64::from(arrival[2]) - z).abs() < 0.05, "{seed:?} {arrival:?} {z}");
        }
    }
}

#[test]
fn jacobians_are_those_of_the_coordinates() {
    let tau = 5.0 * DAY;
    let source = globe(2.0, 9, tau, |lon, lat, z| {
        let [u, v] = turning((0.5 + z / TOP) / tau, 0.6, lon, lat);
        [u, v, 2e-3 * (z / TOP * TAU).sin()]
    });
    let map = map(tau, 100, Precision::F64, Interpolation::Cubic);
    let (step, seed) = ([0.5f32, 0.5, 64.0], [50.0f32, 20.0, 8000.0]);
    let mut seeds = vec![seed];
    for axis in 0..3 {
        for sign in [1.0, -1.0] {
            let mut moved = seed;
            moved[axis] += sign * step[axis];
            seeds.push(moved);
        }
    }
    let out = trace(&source, &map, &seeds);
    for i in 0..3 {
        for j in 0..3 {
            let difference = (out.arrival[1 + 2 * j][i] - out.arrival[2 + 2 * j][i]) / (2.0 * step[j]);
            let size = step[i] / step[j];
            // Arrivals in f32 (1e-5 degrees, 5e-4 m over steps), and third derivatives of a flow map of a few tenths a radian.
            assert!((difference - out.jacobian[0][3 * i + j]).abs() < 1e-3 * size.max(1.0), "{i} {j}: {difference} {:?}", out.jacobian[0]);
        }
    }
}

#[test]
fn missing_levels_stop_particles() {
    // Sinking into a level without velocity, as into a mountain.
    let tau = 10.0 * DAY;
    let source = globe(5.0, 5, tau, |_, _, z| [0.0, 0.0, if z < 1.0 { f64::NAN } else { -0.01 }]);
    let out = trace(&source, &map(tau, 100, Precision::F32, Interpolation::Linear), &[[0.0, 0.0, 6000.0], [0.0, 0.0, 19_000.0]]);
    // The lowest cell ends at 2500 m.
    assert!(out.lived[0] > 0.3 && out.lived[0] < 0.5 && out.lived[1] == 1.0, "{:?}", out.lived);
}
