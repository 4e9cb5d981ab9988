//! Flows on the sphere and over its poles, with and without levels, whose stretch is known.

use crate::kit::flow::{DAY, EVERYTHING, cross, direction, dot, rotation, trace};
use ridgewatch::field::{Axis, DomainPoint, EARTH_RADIUS, Geometry, Grid, Snapshot, UnitPoint, Window};
use ridgewatch::flow::{Boundary, Composition, Direction, FlowMap, Integrator, Interpolation, Precision, Traced, VelocitySource};
use std::f64::consts::TAU;
use std::sync::Arc;

const TOP: f64 = 20_000.0;

pub(crate) fn map(tau: f64, steps: usize, precision: Precision, interpolation: Interpolation) -> FlowMap {
    FlowMap { precision, difference_step: 1e-3, boundary: Boundary::Stop, interpolation, ..FlowMap::tangent(tau, steps) }
}

/// A steady flow `(u, v, w)` of longitude, latitude (radians) and height, on a globe in cells of `cell` degrees. With one level it has two
/// dimensions.
fn globe(cell: f64, levels: usize, tau: f64, flow: impl Fn(f64, f64, f64) -> [f64; 3]) -> VelocitySource {
    let (nx, ny) = ((360.0 / cell) as usize, (180.0 / cell) as usize + 1);
    let longitude = Axis::uniform("lon", "degrees_east", 0.0, 360.0 - cell, nx).unwrap().with_period(360.0);
    let latitude = Axis::uniform("lat", "degrees_north", -90.0, 90.0, ny).unwrap();
    // Unevenly spaced, like levels of pressure.
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

/// Seeds evenly spread over the globe and the heights; the last ones lie at and beside the poles.
fn seeds(count: usize) -> Vec<DomainPoint> {
    let mut seeds: Vec<DomainPoint> = (0..count)
        .map(|i| {
            let latitude = (2.0 * (i as f64 + 0.5) / count as f64 - 1.0).asin().to_degrees();
            DomainPoint([(i as f32 * 137.507_76) % 360.0, latitude as f32, (TOP * (0.1 + 0.8 * (i as f64 * 0.618_034).fract())) as f32])
        })
        .collect();
    // From the poles, straight to them and past them, if a quarter of a turn about an axis through 0 and 180 degrees east takes 100 steps.
    for latitude in [90.0f32, 89.99999, 89.999, 89.99, 89.9, 89.7, 89.1, 89.55, 72.0] {
        for aside in [0.0, 1e-5, 1e-3, 0.01, 0.1, 3.0, 80.0] {
            seeds.extend([[90.0 + aside, latitude, 5000.0], [270.0 - aside, -latitude, 5000.0]].map(DomainPoint));
        }
    }
    seeds
}

fn traced(source: &VelocitySource, map: &FlowMap, seeds: &[DomainPoint]) -> Traced {
    trace(source, map, 0.0, seeds, EVERYTHING)
}

pub(crate) fn greatest(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| (a - b).abs()).fold(0.0, |worst, error| if error > worst || error.is_nan() { error } else { worst })
}

/// Direction of a point.
fn vector(point: DomainPoint) -> [f64; 3] {
    direction(f64::from(point.0[0]), f64::from(point.0[1]))
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
            let [u, v] = rotation(rate, TILT, lon, lat);
            [u, v, 0.0]
        });
        let out = traced(&source, &map(tau, 100, precision, interpolation), &seeds);
        assert!(out.lifetime_share.iter().all(|&l| l == 1.0), "a globe has no edge");
        let worst = greatest(&out.unrounded(), &vec![0.0; seeds.len()]);
        println!("solid rotation, {cell} degrees, {levels} level(s), {precision:?}, {interpolation:?}: |FTLE| at most {worst:.1e} / |tau|");
        assert!(worst < tolerance, "{worst:e}");
        // Rodrigues' formula for a quarter of a turn about a: p' = a x p + (p . a) a.
        let a = [TILT.sin(), 0.0, TILT.cos()];
        for (seed, arrival) in seeds.iter().zip(&out.arrival) {
            let (p, q) = (vector(*seed), vector(*arrival));
            let (along, across) = (dot(p, a), cross(a, p));
            let distance = (0..3).map(|i| (across[i] + along * a[i] - q[i]).powi(2)).sum::<f64>().sqrt();
            // Linear interpolation shortens vectors by up to (half a cell)^2 / 2 = 4e-5 of themselves, over a way of pi / 2.
            assert!(distance < 1e-4 && (arrival.0[2] - seed.0[2]).abs() < 1e-2, "{seed:?} {arrival:?} {distance:e}");
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
            let [u, v] = rotation(rate, TILT, lon, lat).map(|v| (v / step).round() * step);
            [u, v, 0.0]
        });
        let mut stretch = traced(&source, &map(tau, 100, Precision::F64, Interpolation::Cubic), &seeds).unrounded();
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
        let [u, v] = rotation(b + c * (z - middle), TILT, lon, lat);
        [u, v, r * (z - middle)]
    });
    let seeds = seeds(300);
    let axis = [TILT.sin(), 0.0, TILT.cos()];
    let expected: Vec<f64> = seeds
        .iter()
        .map(|&seed| {
            let p = vector(seed);
            let along = dot(p, axis);
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
        let out = traced(&source, &map, &seeds);
        // The seeds after the first 300 lie beside a pole, where a difference in longitude has no length.
        let count = if integrator == Integrator::Differences { 300 } else { seeds.len() };
        let worst = greatest(&out.unrounded()[..count], &expected[..count]);
        println!(
            "turning faster above, {integrator:?}, {precision:?}: off by at most {worst:.1e} of up to {:.2}",
            sheared(EARTH_RADIUS * c * k, e)
        );
        assert!(worst < tolerance, "{worst:e}");
        for (seed, arrival) in seeds.iter().zip(&out.arrival) {
            let z = middle + e * (f64::from(seed.0[2]) - middle);
            // Heights of 1e4 in f32.
            assert!((f64::from(arrival.0[2]) - z).abs() < 0.05, "{seed:?} {arrival:?} {z}");
        }
    }
}

#[test]
fn jacobians_are_those_of_the_coordinates() {
    let tau = 5.0 * DAY;
    let source = globe(2.0, 9, tau, |lon, lat, z| {
        let [u, v] = rotation((0.5 + z / TOP) / tau, 0.6, lon, lat);
        [u, v, 2e-3 * (z / TOP * TAU).sin()]
    });
    let map = map(tau, 100, Precision::F64, Interpolation::Cubic);
    let (step, seed) = ([0.5f32, 0.5, 64.0], DomainPoint([50.0f32, 20.0, 8000.0]));
    let mut seeds = vec![seed];
    for axis in 0..3 {
        for sign in [1.0, -1.0] {
            let mut moved = seed;
            moved.0[axis] += sign * step[axis];
            seeds.push(moved);
        }
    }
    let out = traced(&source, &map, &seeds);
    for i in 0..3 {
        for j in 0..3 {
            let difference = (out.arrival[1 + 2 * j].0[i] - out.arrival[2 + 2 * j].0[i]) / (2.0 * step[j]);
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
    let out = traced(
        &source,
        &map(tau, 100, Precision::F32, Interpolation::Linear),
        &[DomainPoint([0.0, 0.0, 6000.0]), DomainPoint([0.0, 0.0, 19_000.0])],
    );
    // The lowest cell ends at 2500 m.
    assert!(out.lifetime_share[0] > 0.3 && out.lifetime_share[0] < 0.5 && out.lifetime_share[1] == 1.0, "{:?}", out.lifetime_share);
}

#[test]
fn solid_rotation_of_the_sphere_does_not_stretch() {
    // About an axis tilted by 50 degrees, half a turn in 10 days; some paths pass close to a pole.
    let (tau, tilt) = (10.0 * DAY, 50f64.to_radians());
    let source = globe(0.5, 1, tau, |lon, lat, _| {
        let [u, v] = rotation(TAU / 2.0 / tau, tilt, lon, lat);
        [u, v, 0.0]
    });
    let seeds: Vec<DomainPoint> = (0..400)
        .map(|i| DomainPoint([(i as f32 * 137.507_76) % 360.0, ((i as f32 + 0.5) / 200.0 - 1.0).asin().to_degrees(), 0.5]))
        .collect();
    for (precision, interpolation, tolerance) in [
        // Linear gradients on cells of half a degree are off by up to half a cell (4e-3) of the rate times pi, with changing sign.
        (Precision::F64, Interpolation::Linear, 5e-3),
        // Cubic ones by the square of a cell; single precision adds the rounding of node velocities and angles.
        (Precision::F64, Interpolation::Cubic, 2e-4),
        (Precision::F32, Interpolation::Cubic, 4e-4),
    ] {
        let out = traced(&source, &map(tau, 200, precision, interpolation), &seeds);
        assert!(out.lifetime_share.iter().all(|&l| l == 1.0), "a globe has no edge");
        let stretch = out.unrounded();
        let rms = (stretch.iter().map(|s| s * s).sum::<f64>() / stretch.len() as f64).sqrt();
        println!(
            "solid rotation, {precision:?}, {interpolation:?}: rms {rms:.1e}, max {:.1e}",
            greatest(&stretch, &vec![0.0; seeds.len()])
        );
        assert!(rms < tolerance, "{rms:e}");
        // Half a turn about the axis a: p' = 2 (p . a) a - p.
        let axis = [tilt.sin(), 0.0, tilt.cos()];
        for (seed, arrival) in seeds.iter().zip(&out.arrival) {
            let (p, q) = (vector(*seed), vector(*arrival));
            let along = dot(p, axis);
            let distance = (0..3).map(|i| (2.0 * along * axis[i] - p[i] - q[i]).powi(2)).sum::<f64>().sqrt();
            // Interpolation shortens vectors by up to (half a cell)^2 / 2 = 1e-5 of themselves, over a way of pi.
            assert!(distance < 1e-4, "{seed:?} {arrival:?} {distance:e}");
        }
    }
}

#[test]
fn zonal_shear_on_the_sphere_has_a_closed_form() {
    // u = U cos(lat) sin(lat) turns circles of latitude by k sin(lat) with k = U / R: lon' = lon + k sin(lat) tau. Between (east,
    // north) at seed and arrival J = [[1, g], [0, 1]] with g = k tau cos(lat)^2: a shear.
    let (speed, tau) = (40.0, 10.0 * DAY);
    let source = globe(0.5, 1, tau, |_, lat, _| [speed * lat.cos() * lat.sin(), 0.0, 0.0]);
    let seeds: Vec<DomainPoint> = (0..160).map(|i| DomainPoint([i as f32 * 2.25, i as f32 - 80.0, 0.5])).collect();
    let rate = |s: &DomainPoint| speed / EARTH_RADIUS * f64::from(s.0[1]).to_radians().cos().powi(2);
    let expected: Vec<f64> = seeds.iter().map(|s| sheared(rate(s) * tau, 1.0)).collect();
    for (integrator, precision) in
        [(Integrator::Tangent, Precision::F32), (Integrator::Tangent, Precision::F64), (Integrator::Differences, Precision::F64)]
    {
        let map = FlowMap { integrator, ..map(tau, 100, precision, Interpolation::Cubic) };
        let max = greatest(&traced(&source, &map, &seeds).unrounded(), &expected);
        println!("zonal shear, {integrator:?}, {precision:?}: max {max:.1e}");
        // Interpolation in cells of half a degree: derivatives are off by the square of a cell, 8e-5, of a g of up to 5.
        assert!(max < 5e-4, "{max:e}");
    }
}

/// Root mean square errors of composed flow maps, plain and hierarchical, at seeds of a globe.
fn composed(source: &VelocitySource, (t0, map): (f64, &FlowMap), nodes: [usize; 3], seeds: &[DomainPoint], expected: &[f64]) -> [f64; 2] {
    let plain = Composition::trace(source, map, t0, nodes, 4, 25).unwrap().unwrap();
    let unit: Vec<UnitPoint> =
        seeds.iter().map(|DomainPoint([x, y, z])| UnitPoint([x / 360.0, (y + 90.0) / 180.0, z / TOP as f32])).collect();
    [plain.clone(), plain.joined()].map(|composition| {
        let mut found = vec![0.0; unit.len()];
        composition.log_stretch(&unit, &mut found);
        let square: f64 = found.iter().zip(expected).map(|(a, b)| (a - b).powi(2)).sum();
        (square / expected.len() as f64).sqrt()
    })
}

#[test]
fn composed_maps_go_over_poles_and_the_dateline() {
    let tau = 10.0 * DAY;
    // Solid rotation over the poles, a shear of circles of latitude, and rotation that turns faster above and rises.
    let (b, c, r, middle) = (1.0 / tau, 3.0 / tau / EARTH_RADIUS, -0.4 / tau, TOP / 2.0);
    let (e, k) = ((r * tau).exp(), ((r * tau).exp() - 1.0) / r);
    let speed = 40.0;
    let solid = globe(1.0, 1, tau, |lon, lat, _| {
        let [u, v] = rotation(TAU / 4.0 / tau, TILT, lon, lat);
        [u, v, 0.0]
    });
    let zonal = globe(1.0, 1, tau, |_, lat, _| [speed * lat.cos() * lat.sin(), 0.0, 0.0]);
    let rising = globe(1.0, 9, tau, |lon, lat, z| {
        let [u, v] = rotation(b + c * (z - middle), TILT, lon, lat);
        [u, v, r * (z - middle)]
    });
    let seeds = seeds(400);
    let axis = [TILT.sin(), 0.0, TILT.cos()];
    let of = |stretch: &dyn Fn(&DomainPoint) -> f64| seeds.iter().map(stretch).collect::<Vec<f64>>();
    let in_zones = |seed: &DomainPoint| sheared(speed / EARTH_RADIUS * f64::from(seed.0[1]).to_radians().cos().powi(2) * tau, 1.0);
    let in_heights = |seed: &DomainPoint| sheared(EARTH_RADIUS * c * k * (1.0 - dot(vector(*seed), axis).powi(2)).sqrt(), e);
    let forward = (0.0, &map(tau, 100, Precision::F64, Interpolation::Cubic));
    let backward = (tau, &FlowMap { direction: Direction::Backward, ..forward.1.clone() });
    for (name, source, way, levels, expected) in [
        ("solid", &solid, forward, 1, of(&|_| 0.0)),
        ("zonal", &zonal, forward, 1, of(&in_zones)),
        ("zonal, backward", &zonal, backward, 1, of(&in_zones)),
        ("rising", &rising, forward, 9, of(&in_heights)),
    ] {
        let [coarse, fine] = [2usize, 1].map(|cell| composed(source, way, [360 / cell + 1, 180 / cell + 1, levels], &seeds, &expected));
        println!("composed, {name}: rms off by {coarse:?} with nodes of 2 degrees, {fine:?} with 1");
        for kind in 0..2 {
            // Gradients of linear interpolation are of first order.
            assert!(fine[kind] < 0.65 * coarse[kind] && fine[kind] < 0.01, "{name}: {coarse:?} {fine:?}");
        }
    }
}
