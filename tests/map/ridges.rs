//! Ridge lines against closed forms and against a finer grid.

use crate::kit::flow::trace;
use ridgewatch::field::{Axis, Domain, DomainPoint, Geometry, Grid, Snapshot, Window, analytic::Analytic};
use ridgewatch::flow::{Boundary, Extras, FlowMap, Interpolation, Precision, VelocitySource};
use ridgewatch::map::{Field, RidgePoint, Strength};
use std::f64::consts::TAU as TURN;
use std::sync::Arc;

/// A closed form at the nodes of a grid.
fn field(origin: [f64; 2], step: f64, size: [usize; 2], of: impl Fn(f64, f64) -> f64) -> Field {
    let value = |k: usize| of(origin[0] + step * (k % size[0]) as f64, origin[1] + step * (k / size[0]) as f64) as f32;
    Field { origin, step: [step; 2], size, values: (0..size[0] * size[1]).map(value).collect(), scale: vec![[1.0; 2]; size[1]] }
}

const ALL: Strength = Strength { percentile: 0.0, sharpness: 0.0, extent: 5.0, smoothing: 0.0, cells: [0.0; 2] };

/// FTLE of u = sin x, v = -y over tau: tan(X / 2) = e^tau tan(x / 2), so that dX/dx = e^tau / (cos^2 (x/2) + e^(2 tau) sin^2 (x/2)). Its ridge is x = 0.
fn nonlinear_saddle(x: f64, tau: f64) -> f64 {
    let (sine, cosine) = (x / 2.0).sin_cos();
    let stretch = tau.exp() / (cosine * cosine + (2.0 * tau).exp() * sine * sine);
    stretch.ln().max(-tau) / tau
}

/// The ridge of a saddle whose axes are turned against the grid, in units of cells.
#[test]
fn the_saddle_is_exact_to_a_hundredth_of_a_cell() {
    // exp(-1.5) = 0.22 is the width of the ridge: nine nodes of 0.025.
    let (tau, step) = (1.5, 0.025);
    for (angle, shift) in [(0.0, 0.0137), (0.0, 0.0071), (0.4, 0.003), (1.1, -0.011), (TURN / 8.0, 0.0049)] {
        let (sine, cosine) = f64::sin_cos(angle);
        let across = |x: f64, y: f64| cosine * x + sine * y - shift;
        let field = field([-1.0, -1.0], step, [81, 81], |x, y| nonlinear_saddle(across(x, y), tau));
        let lines = field.ridges(&ALL);
        assert_eq!(lines.len(), 1, "{angle}: one ridge, in one piece");
        let worst = lines[0].iter().map(|p| across(p.place[0], p.place[1]).abs()).fold(0.0, f64::max) / step;
        let length = (lines[0][0].place[0] - lines[0][lines[0].len() - 1].place[0])
            .hypot(lines[0][0].place[1] - lines[0][lines[0].len() - 1].place[1]);
        println!("angle {angle:.2}, shift {shift}: worst {worst:.1e} cells, {} points", lines[0].len());
        assert!(worst < 0.01 && length > 1.7, "{angle} {shift}: {worst} cells, length {length}");
        // The largest FTLE is that of the fixed point: its rate.
        assert!(lines[0].iter().all(|p| (p.value - 1.0).abs() < 0.01 && p.sharpness > 0.0));
    }
}

/// Ridges that fall faster on one side: differences of nodes shift them by 0.02 to 0.13 cells.
#[test]
fn skewed_ridges_are_exact_to_a_hundredth_of_a_cell() {
    let step = 0.025;
    for width in [2.0, 4.0, 16.0] {
        for (angle, shift) in [(0.0, 0.0137), (0.4, 0.003), (1.1, -0.011), (TURN / 8.0, 0.0049)] {
            let (sine, cosine) = f64::sin_cos(angle);
            // In cells.
            let across = |x: f64, y: f64| (cosine * x + sine * y - shift) / step;
            let lines = field([-1.0, -1.0], step, [81, 81], |x, y| {
                let d = across(x, y) / width;
                (-(d.exp() - 1.0 - d)).exp()
            })
            .ridges(&ALL);
            let worst = lines.iter().flatten().map(|p| across(p.place[0], p.place[1]).abs()).fold(0.0, f64::max);
            println!("{width} nodes wide, angle {angle:.2}: worst {worst:.1e} cells");
            assert!(lines.len() == 1 && worst < 0.01, "{width} {angle}: {} lines, {worst} cells", lines.len());
        }
    }
}

/// The ridge falls to half within 0.7 to 1.2 nodes, and nodes about its inflections know no direction across it.
#[test]
fn lines_as_narrow_as_a_node_hold_together() {
    let step = 0.025;
    for (angle, shift) in [(0.0, 0.0137), (0.4, 0.003), (1.1, -0.011), (TURN / 8.0, 0.0049)] {
        let (sine, cosine) = f64::sin_cos(angle);
        let across = |x: f64, y: f64| cosine * x + sine * y - shift;
        let lines = |width: f64, smoothing: f64| {
            field([-1.0, -1.0], step, [81, 81], |x, y| (-(across(x, y) / width).powi(2)).exp()).ridges(&Strength { smoothing, ..ALL })
        };
        let length = |line: &[RidgePoint]| {
            line.windows(2).map(|pair| (pair[1].place[0] - pair[0].place[0]).hypot(pair[1].place[1] - pair[0].place[1])).sum::<f64>()
        };
        let whole = length(&lines(0.1, 0.0)[0]);
        for (width, smoothing) in [(0.02, 0.0), (0.02, 0.5), (0.035, 0.0), (0.035, 0.5)] {
            let found = lines(width, smoothing);
            let worst = found.iter().flatten().map(|p| across(p.place[0], p.place[1]).abs()).fold(0.0, f64::max) / step;
            let share = length(&found[0]) / whole;
            println!(
                "angle {angle:.2}, width {width}, smoothing {smoothing}: {:.1} % of the length, worst {worst:.2} cells",
                100.0 * share
            );
            assert!(found.len() == 1 && share > 0.99 && worst < 0.25, "{} pieces", found.len());
        }
    }
}

/// The same saddle as data on a grid, through the integration of the program.
#[test]
fn the_saddle_of_a_traced_grid_is_exact_to_a_hundredth_of_a_cell() {
    let axis = |name| Axis::uniform(name, "m", -1.25, 1.25, 251).unwrap();
    let grid = Arc::new(Grid { axes: vec![axis("x"), axis("y")], geometry: Geometry::Cartesian, slab: (0.0, 1.0) });
    let at = |k: usize| -1.25 + 0.01 * k as f64;
    let u: Vec<f32> = (0..grid.nodes()).map(|k| at(k % 251).sin() as f32).collect();
    let v: Vec<f32> = (0..grid.nodes()).map(|k| -at(k / 251) as f32).collect();
    let mut window = Window::new(1.0);
    for time in [0.0, 1.0] {
        window.push(Arc::new(Snapshot::from_components(time, grid.clone(), &u, &v, &[]))).unwrap();
    }
    let map =
        FlowMap { precision: Precision::F64, boundary: Boundary::Clamp, interpolation: Interpolation::Cubic, ..FlowMap::tangent(1.0, 100) };
    // Nodes beside those of the data.
    let (origin, step, size) = ([-0.4037, -0.4011], 0.0257, [32, 32]);
    let seeds: Vec<DomainPoint> = (0..size[0] * size[1])
        .map(|k| DomainPoint([(origin[0] + step * (k % size[0]) as f64) as f32, (origin[1] + step * (k / size[0]) as f64) as f32, 0.5]))
        .collect();
    let traced = trace(&VelocitySource::Window(Arc::new(window)), &map, 0.0, &seeds, Extras::default()).unrounded();
    for (seed, s) in seeds.iter().zip(&traced) {
        assert!((s - nonlinear_saddle(f64::from(seed.0[0]), 1.0)).abs() < 1e-3, "{seed:?}: {s}");
    }
    let values = traced.iter().map(|s| *s as f32).collect();
    let lines = Field { origin, step: [step; 2], size, values, scale: vec![[1.0; 2]; size[1]] }.ridges(&ALL);
    assert_eq!(lines.len(), 1);
    let worst = lines[0].iter().map(|p| p.place[0].abs()).fold(0.0, f64::max) / step;
    println!("worst {worst:.1e} cells");
    assert!(worst < 0.01, "{worst}");
}

/// A uniform field has none, nor has a valley.
#[test]
fn what_is_no_ridge_gives_none() {
    let rounding = |x: f64, y: f64| 1.0 + 1e-7 * (1000.0 * x * y).sin();
    assert_eq!(field([0.0; 2], 0.02, [60, 60], rounding).ridges(&ALL), Vec::<Vec<RidgePoint>>::new());
    assert_eq!(field([-1.0; 2], 0.05, [40, 40], |x, _| 1.0 - (-4.0 * (x - 0.013) * (x - 0.013)).exp()).ridges(&ALL).len(), 0);
    assert_eq!(field([0.0; 2], 0.02, [60, 60], |_, _| f64::NAN).ridges(&ALL), Vec::<Vec<RidgePoint>>::new());
}

/// A circle by symmetry, closed, on a grid whose coordinates have different lengths; and what the filters do.
#[test]
fn curved_ridges_close_and_filters_choose() {
    let profile = |r: f64, at: f64| (-((r - at) / 0.12).powi(2)).exp();
    let of = |x: f64, y: f64| profile(x.hypot(y), 0.7) + 0.4 * profile(x.hypot(y), 0.25);
    // x in half units.
    let mut squeezed = field([-1.0, -1.0], 0.02, [101, 101], of);
    squeezed.origin[0] /= 2.0;
    squeezed.step[0] /= 2.0;
    squeezed.scale = vec![[2.0, 1.0]; 101];
    let mut lines = squeezed.ridges(&ALL);
    lines.sort_by_key(Vec::len);
    assert_eq!(lines.len(), 2);
    for (line, radius) in lines.iter().zip([0.25, 0.7]) {
        assert_eq!(line.first(), line.last(), "closed");
        let worst = line.iter().map(|p| ((2.0 * p.place[0]).hypot(p.place[1]) - radius).abs()).fold(0.0, f64::max) / 0.02;
        println!("radius {radius}: worst {worst:.1e} cells");
        // Circles of 0.25 have 12 nodes to their centre: the curvature is not small.
        assert!(worst < 0.003, "{worst}");
    }
    let count = |strength: Strength| squeezed.ridges(&strength).len();
    assert_eq!(count(Strength { percentile: 90.0, ..ALL }), 1, "the weaker one is below the percentile");
    assert_eq!(count(Strength { extent: 120.0, ..ALL }), 1, "the shorter one has 78 nodes");
    assert_eq!(count(Strength { extent: 400.0, ..ALL }), 0);
    // A faint rest does not take a strong part along: of a circle whose strength falls from one side to the other, what is above the percentile counts.
    let uneven = field([-1.0, -1.0], 0.02, [101, 101], |x, y| (1.0 + 0.2 * y) * profile(x.hypot(y), 0.7));
    let most = Strength { percentile: 96.0, ..ALL };
    let lengths = [60.0, 200.0].map(|extent| uneven.ridges(&Strength { extent, ..most }).len());
    assert_eq!(lengths, [1, 0], "of 220 nodes a part reaches the percentile");
    // A hole cuts the circle open.
    squeezed.values[50 * 101 + 50 + 35] = f32::NAN;
    let cut = squeezed.ridges(&ALL);
    assert!(cut.iter().any(|line| line.first() != line.last()));
}

/// Distance of a point from a line.
fn distance(point: [f64; 2], line: &[RidgePoint]) -> f64 {
    let from = |pair: &[RidgePoint]| {
        let (a, b) = (pair[0].place, pair[1].place);
        let (dx, dy) = (b[0] - a[0], b[1] - a[1]);
        let t = (((point[0] - a[0]) * dx + (point[1] - a[1]) * dy) / (dx * dx + dy * dy).max(1e-300)).clamp(0.0, 1.0);
        (point[0] - a[0] - t * dx).hypot(point[1] - a[1] - t * dy)
    };
    line.windows(2).map(from).fold(f64::INFINITY, f64::min)
}

/// Share of the length of lines that has no other line within a distance.
fn share_apart(lines: &[Vec<RidgePoint>], others: &[Vec<RidgePoint>], within: f64) -> f64 {
    let (mut all, mut apart) = (0.0, 0.0);
    for pair in lines.iter().flat_map(|line| line.windows(2)) {
        let [a, b] = [pair[0].place, pair[1].place];
        let length = (b[0] - a[0]).hypot(b[1] - a[1]);
        let middle = [(a[0] + b[0]) / 2.0, (a[1] + b[1]) / 2.0];
        all += length;
        apart += if others.iter().any(|line| distance(middle, line) <= within) { 0.0 } else { length };
    }
    apart / all
}

/// The double gyre on 201 x 101 nodes against 801 x 401, both ways, with the same smoothing in both. Without any, the coarse grid misses what is finer
/// than its nodes.
#[test]
fn the_double_gyre_agrees_with_a_grid_four_times_finer() {
    let domain = Domain::slab([0.0, 0.0], [2.0, 1.0], (0.0, 1.0));
    let flow = Analytic::DoubleGyre { amplitude: 0.1, epsilon: 0.25, omega: TURN / 10.0 };
    let velocity = VelocitySource::Analytic(flow, domain);
    let map = FlowMap { precision: Precision::F64, ..FlowMap::tangent(10.0, 200) };
    let field = |n: usize| {
        let size = [2 * n + 1, n + 1];
        let step = 1.0 / n as f64;
        let seeds: Vec<DomainPoint> = (0..size[0] * size[1])
            .map(|k| DomainPoint([(step * (k % size[0]) as f64) as f32, (step * (k / size[0]) as f64) as f32, 0.5]))
            .collect();
        let values = trace(&velocity, &map, 0.0, &seeds, Extras::default()).unrounded().iter().map(|s| (s / 10.0) as f32).collect();
        Field { origin: [0.0; 2], step: [step; 2], size, values, scale: vec![[1.0; 2]; size[1]] }
    };
    let (coarse, fine) = (field(100), field(400));
    let ridges = |field: &Field, smoothing: f64| {
        field.ridges(&Strength { percentile: 80.0, extent: 0.1 / field.step[0], smoothing: smoothing * 0.01 / field.step[0], ..ALL })
    };
    // Smoothing in coarse nodes; largest median and percentile 95 of the distance from coarse to fine, in coarse cells; largest share of the fine length
    // without a coarse line within a cell.
    for (smoothing, most) in [(0.0, [0.02, 0.8, 0.48]), (1.0, [0.005, 0.22, 0.08]), (2.0, [0.014, 0.09, 0.015])] {
        let (coarse, fine) = (ridges(&coarse, smoothing), ridges(&fine, smoothing));
        let mut distances: Vec<f64> = coarse
            .iter()
            .flatten()
            .map(|p| fine.iter().map(|line| distance(p.place, line)).fold(f64::INFINITY, f64::min) * 100.0)
            .collect();
        distances.sort_by(f64::total_cmp);
        let at = |share: f64| distances[((distances.len() - 1) as f64 * share) as usize];
        let found = [at(0.5), at(0.95), share_apart(&fine, &coarse, 0.01)];
        println!(
            "smoothing {smoothing}: {} lines, {} points: median, percentile 95 in cells, share missed {found:.4?}",
            coarse.len(),
            distances.len()
        );
        assert!(distances.len() > 300 && (0..3).all(|k| found[k] < most[k]), "smoothing {smoothing}: {found:?}, at most {most:?}");
    }
}

/// Velocity of the double gyre below, in f64 and apart from the tracer.
fn gyre([x, y]: [f64; 2], t: f64) -> [f64; 2] {
    const PI: f64 = std::f64::consts::PI;
    let wave = 0.25 * (TURN / 10.0 * t).sin();
    let (f, slope) = (wave * x * x + (1.0 - 2.0 * wave) * x, 2.0 * wave * x + 1.0 - 2.0 * wave);
    [-0.1 * PI * (PI * f).sin() * (PI * y).cos(), 0.1 * PI * (PI * f).cos() * (PI * y).sin() * slope]
}

/// Where the gyre carries a particle from one time to another, by the classical Runge-Kutta method.
fn carried(mut at: [f64; 2], from: f64, to: f64) -> [f64; 2] {
    let steps = (40.0 * (to - from).abs()).ceil();
    let h = (to - from) / steps;
    for n in 0..steps as usize {
        let t = from + h * n as f64;
        let moved = |k: [f64; 2], share: f64| [0, 1].map(|i| at[i] + share * h * k[i]);
        let a = gyre(at, t);
        let b = gyre(moved(a, 0.5), t + 0.5 * h);
        let c = gyre(moved(b, 0.5), t + 0.5 * h);
        let d = gyre(moved(c, 1.0), t + h);
        at = [0, 1].map(|i| at[i] + h / 6.0 * (a[i] + 2.0 * b[i] + 2.0 * c[i] + d[i]));
    }
    at
}

/// The stable manifold of the hyperbolic trajectory on the wall y = 0, at time 0: the particles that come within `near` of it by time `tau`.
fn stable_manifold(tau: f64, near: f64) -> Vec<[f64; 2]> {
    // Backward in time particles on the wall approach it.
    let foot = carried([1.0, 0.0], tau + 50.0, tau)[0];
    // Its direction there is that of y up to a part that shrinks on the way.
    let at = |height: f64| carried([foot, height], tau, 0.0);
    let mut line = vec![at(0.0)];
    let (mut low, mut ends) = (0.0, vec![near]);
    while let Some(&high) = ends.last() {
        let (last, next) = (line[line.len() - 1], at(high));
        if (next[0] - last[0]).hypot(next[1] - last[1]) > 0.002 && high - low > 1e-12 {
            ends.push(0.5 * (low + high));
        } else {
            line.push(next);
            (low, _) = (high, ends.pop());
        }
    }
    line
}

/// The strongest ridge of the forward FTLE lies on the stable manifold of the hyperbolic trajectory on the wall, the more so the longer tau is (Shadden,
/// Lekien and Marsden 2005). Other ridges beside it, which fold around it, are weaker.
#[test]
fn the_double_gyre_has_a_ridge_on_its_known_manifold() {
    let flow = Analytic::DoubleGyre { amplitude: 0.1, epsilon: 0.25, omega: TURN / 10.0 };
    let velocity = VelocitySource::Analytic(flow, Domain::slab([0.0, 0.0], [2.0, 1.0], (0.0, 1.0)));
    let (origin, step, size) = ([1.0, 0.02], 0.0005, [441, 881]);
    // At tau 10 the ridge is as narrow as a node.
    for (tau, most) in [(6.0, 2.0), (8.0, 0.2), (10.0, 0.5)] {
        let map = FlowMap { precision: Precision::F64, ..FlowMap::tangent(tau, 200) };
        let place = |k: usize| [origin[0] + step * (k % size[0]) as f64, origin[1] + step * (k / size[0]) as f64];
        let seeds: Vec<DomainPoint> = (0..size[0] * size[1]).map(place).map(|[x, y]| DomainPoint([x as f32, y as f32, 0.5])).collect();
        let traced = trace(&velocity, &map, 0.0, &seeds, Extras::default());
        let values = traced.unrounded().iter().map(|s| (s / tau) as f32).collect();
        let field = Field { origin, step: [step; 2], size, values, scale: vec![[1.0; 2]; size[1]] };
        let ridges = field.ridges(&Strength { percentile: 80.0, extent: 100.0, ..ALL });
        let mut manifold = stable_manifold(tau, 0.02);
        manifold.retain(|at| (0..2).all(|k| at[k] > origin[k] + step && at[k] < origin[k] + step * (size[k] - 2) as f64));
        let in_order = |mut cells: Vec<f64>| {
            cells.sort_by(f64::total_cmp);
            [0.5, 1.0].map(|share| cells[((cells.len() - 1) as f64 * share) as usize])
        };
        let to_ridge = |at: &[f64; 2]| ridges.iter().map(|line| distance(*at, line)).fold(f64::INFINITY, f64::min) / step;
        let found = in_order(manifold.iter().map(to_ridge).collect());
        let line: Vec<RidgePoint> = manifold.iter().map(|place| RidgePoint { place: *place, value: 0.0, sharpness: 0.0 }).collect();
        let mut strongest: Vec<RidgePoint> = ridges.iter().flatten().copied().collect();
        strongest.sort_by(|a, b| b.value.total_cmp(&a.value));
        strongest.truncate(strongest.len() / 4);
        let off = in_order(strongest.iter().map(|p| distance(p.place, &line) / step).collect());
        println!(
            "tau {tau}: the manifold is {found:.3?} cells from a ridge, the strongest ridge points are {off:.3?} cells from it (median, largest)"
        );
        assert!(manifold.len() > 200 && found[1] < most && off[0] < most, "tau {tau}: {found:?} {off:?}");
    }
}
