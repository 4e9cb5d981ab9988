//! Composed flow maps in boxes, with particles that stop.

use crate::sphere::{greatest, map};
use ridgewatch::field::{Axis, Geometry, Grid, Snapshot, UnitPoint, Window};
use ridgewatch::flow::{Boundary, Composition, FlowMap, Interpolation, Normalisation, Precision, VelocitySource, cpu_tracer};
use ridgewatch::surrogate::Table;
use std::sync::Arc;

/// A box of nodes in which `flow` holds at the given times; linear between them.
fn in_a_box(axes: Vec<Axis>, times: [f64; 2], flow: impl Fn([f64; 3], f64) -> [f32; 3]) -> VelocitySource {
    let grid = Arc::new(Grid { axes, geometry: Geometry::Cartesian, slab: (0.0, 1.0) });
    let [nx, ny, _] = grid.shape();
    let at = |k: usize, i: usize| grid.axes.get(k).map_or(0.0, |axis| axis.coordinates()[i]);
    let mut window = Window::new(times[1] - times[0]);
    for time in times {
        let all: Vec<[f32; 3]> = (0..grid.nodes()).map(|i| flow([at(0, i % nx), at(1, i / nx % ny), at(2, i / (nx * ny))], time)).collect();
        let component = |c: usize| all.iter().map(|v| v[c]).collect::<Vec<f32>>();
        window.push(Arc::new(Snapshot::from_components(time, grid.clone(), &component(0), &component(1), &component(2)))).unwrap();
    }
    VelocitySource::Window(Arc::new(window))
}

fn metres(name: &str, low: f64, high: f64, nodes: usize) -> Axis {
    Axis::uniform(name, "m", low, high, nodes).unwrap()
}

/// Greatest error of composed flow maps, plain and hierarchical, at unit points.
fn composed_in_a_box(source: &VelocitySource, map: &FlowMap, nodes: [usize; 3], unit: &[UnitPoint], expected: &[f64]) -> [f64; 2] {
    let plain = Composition::trace(source, map, 0.0, nodes, 8, 25).unwrap().unwrap();
    [plain.clone(), plain.joined()].map(|composition| {
        let mut found = vec![0.0; unit.len()];
        composition.log_stretch(unit, &mut found);
        greatest(&found, expected)
    })
}

#[test]
fn composed_maps_keep_what_stops() {
    // x grows as exp(a t). Particles rise by 2 t - 2 t^2, up and down again, and those of the upper half stop at the top on the way: where x is 0,
    // ln stretch is a t at that time, a quadratic equation, and a tau for the others. (Elsewhere the gradient of the map that stops has the time in it.)
    let (a, tau) = (2.0, 1.0);
    let axes = vec![metres("x", -1.0, 1.0, 33), metres("y", 0.0, 1.0, 3), metres("z", 0.0, 1.0, 17)];
    let source = in_a_box(axes, [0.0, tau], |[x, _, _], time| [(a * x) as f32, 0.0, (2.0 - 4.0 * time) as f32]);
    let map = map(tau, 200, Precision::F64, Interpolation::Linear);
    // In the cell between them the stretch jumps.
    let heights = (0..80).map(|i| (i as f32 + 0.5) / 80.0).filter(|z| (z - 0.5).abs() > 0.016);
    let unit: Vec<UnitPoint> = heights.map(|z| UnitPoint([0.5, 0.5, z])).collect();
    let until = |z: f64| if z < 0.5 { tau } else { 0.5 * (1.0 - (2.0 * z - 1.0).sqrt()) };
    let expected: Vec<f64> = unit.iter().map(|point| a * until(f64::from(point.0[2]))).collect();
    let worst = composed_in_a_box(&source, &map, [129, 3, 65], &unit, &expected);
    assert!(worst.iter().all(|&worst| worst < 0.05), "{worst:?}");
}

#[test]
fn what_starts_on_an_edge_starts_inside() {
    // Particles move away from an edge that f32 rounds outwards, along a line from which others part as exp(a t).
    let (a, tau) = (1.0, 1.0);
    let axes = vec![metres("x", 0.7, 1.7, 9), metres("y", 0.1, 1.1, 9)];
    let source = in_a_box(axes, [0.0, tau], |[_, y, _], _| [0.2, (a * (y - 0.6)) as f32, 0.0]);
    let map = map(tau, 200, Precision::F64, Interpolation::Linear);
    let unit: Vec<UnitPoint> = (0..40).map(|i| UnitPoint([i as f32 / 100.0, 0.5, 0.5])).collect();
    let worst = composed_in_a_box(&source, &map, [33, 129, 1], &unit, &vec![a * tau; unit.len()]);
    assert!(worst.iter().all(|&worst| worst < 0.05), "{worst:?}");
    // Nodes of tables, too, along the same line.
    let table = Table::trace(&cpu_tracer(source, &map, 0.0).unwrap(), [33, 129, 1]).unwrap();
    let middle = &table.values()[64 * 33..][..33];
    assert!(middle.iter().take(26).all(|value| (f64::from(*value) - a * tau).abs() < 1e-3), "{middle:?}");
}

#[test]
fn composed_maps_refuse_what_displacements_do_not_tell() {
    let axes = || vec![metres("x", 0.0, 1.0, 9), metres("y", 0.0, 1.0, 9)];
    let still = |axes| in_a_box(axes, [0.0, 1.0], |_, _| [0.0; 3]);
    let [x, y] = <[Axis; 2]>::try_from(axes()).unwrap();
    let (open, wraps) = (still(axes()), still(vec![x.with_period(1.125), y]));
    let usual = map(1.0, 10, Precision::F64, Interpolation::Linear);
    let values = |source: &VelocitySource, map: &FlowMap| Composition::values_per_node(source, map);
    assert_eq!(values(&open, &usual), Some(3), "two components, and whether it stops");
    assert_eq!(values(&open, &FlowMap { boundary: Boundary::Clamp, ..usual.clone() }), Some(2));
    assert_eq!(values(&wraps, &usual), None, "an axis that wraps");
    for refused in [
        FlowMap { boundary: Boundary::Periodic, ..usual.clone() },
        FlowMap { boundary: Boundary::Zero, ..usual.clone() },
        FlowMap { normalisation: Normalisation::Lifetime, ..usual.clone() },
    ] {
        assert_eq!(values(&open, &refused), None, "{refused:?}");
        assert!(Composition::trace(&open, &refused, 0.0, [9, 9, 1], 2, 5).unwrap().is_none());
    }
    // Without a velocity a particle stops under any policy: here where the cells end that have one, 0.75 - x after the begin.
    let a = 2.0;
    let flow = |[x, y, _]: [f64; 3], _| [if x > 0.8 { f32::NAN } else { 1.0 }, (a * (y - 0.5)) as f32, 0.0];
    let (holed, clamp) =
        (in_a_box(axes(), [0.0, 1.0], flow), FlowMap { boundary: Boundary::Clamp, ..map(1.0, 200, usual.precision, usual.interpolation) });
    assert_eq!(values(&holed, &clamp), Some(3));
    let unit: Vec<UnitPoint> = (0..20).map(|i| UnitPoint([(i as f32 + 0.5) / 20.0, 0.5, 0.5])).collect();
    let expected: Vec<f64> = unit.iter().map(|point| a * (0.75 - f64::from(point.0[0])).max(0.0)).collect();
    let worst = composed_in_a_box(&holed, &clamp, [129, 65, 1], &unit, &expected);
    assert!(worst.iter().all(|&worst| worst < 0.1), "beside missing cells: {worst:?}");
}
