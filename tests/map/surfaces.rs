//! Ridge surfaces against closed forms: planes, spherical shells, fields without ridges.

use crate::kit::flow::{Vector, dot, trace, unit};
use ridgewatch::field::{Axis, DomainPoint, Geometry, Grid, Snapshot, Window};
use ridgewatch::flow::{Boundary, Extras, FlowMap, Interpolation, Precision, VelocitySource};
use ridgewatch::map::{Strength, SurfacePoint, Surfaces, Volume};
use std::collections::HashMap;
use std::f64::consts::PI;
use std::sync::Arc;

/// A closed form at the nodes of a cube of `n` nodes along each edge.
fn volume(origin: f64, step: f64, n: usize, of: impl Fn(Vector) -> f64) -> Volume {
    let value = |k: usize| of([k % n, k / n % n, k / (n * n)].map(|i| origin + step * i as f64)) as f32;
    let values = (0..n * n * n).map(value).collect();
    Volume { origin: [origin; 3], step: [step; 3], size: [n; 3], values, scale: vec![[1.0; 3]; n], rounding: 0.0 }
}

const ALL: Strength = Strength { percentile: 0.0, sharpness: 0.0, extent: 20.0, smoothing: 0.0, cells: [0.0; 2] };

/// Vertices minus edges plus triangles, and the number of edges that belong to one triangle only. Asserts that no edge has more than two, and that
/// both pass it in opposite directions.
fn euler(found: &Surfaces) -> (i64, usize) {
    let mut edges: HashMap<[u32; 2], [usize; 2]> = HashMap::new();
    for [a, b, c] in &found.triangles {
        for [p, q] in [[a, b], [b, c], [c, a]] {
            edges.entry([*p.min(q), *p.max(q)]).or_default()[usize::from(p < q)] += 1;
        }
    }
    assert!(edges.values().all(|[there, back]| *there <= 1 && *back <= 1), "sides of triangles meet, and turn the same way round");
    let rim = edges.values().filter(|both| both.contains(&0)).count();
    (found.points.len() as i64 - edges.len() as i64 + found.triangles.len() as i64, rim)
}

/// FTLE of u = sin x, v = -y / 2, w = -z / 2 over tau: tan(X / 2) = e^tau tan(x / 2), so that dX/dx = e^tau / (cos^2 (x/2) + e^(2 tau) sin^2 (x/2)). Its
/// ridge is the plane x = 0.
fn nonlinear_saddle(x: f64, tau: f64) -> f64 {
    let (sine, cosine) = (x / 2.0).sin_cos();
    let stretch = tau.exp() / (cosine * cosine + (2.0 * tau).exp() * sine * sine);
    stretch.ln().max(-tau / 2.0) / tau
}

/// Normals of five planes, along an axis and turned against the grid, with distances from the origin that lie between nodes.
const PLANES: [(Vector, f64); 5] = [
    ([1.0, 0.0, 0.0], 0.0137),
    ([0.0, 0.0, 1.0], 0.0071),
    ([0.921, 0.389, 0.0], 0.003),
    ([0.3, -0.5, 0.8], -0.011),
    ([-1.0, 1.0, 1.0], 0.0049),
];

#[test]
fn planes_are_exact_to_a_hundredth_of_a_cell() {
    // exp(-1.5) = 0.22 is the width of the ridge: nine nodes of 0.025.
    let (tau, step) = (1.5, 0.025);
    for (normal, shift) in PLANES {
        let normal = unit(normal);
        let across = |p: Vector| dot(normal, p) - shift;
        let found = volume(-0.5, step, 41, |p| nonlinear_saddle(across(p), tau)).surfaces(&ALL);
        assert_eq!(found.surfaces.len(), 1, "{normal:?}: one surface, in one piece");
        let worst = found.points.iter().map(|p| across(p.place).abs()).fold(0.0, f64::max) / step;
        println!("normal {normal:.2?}: worst {worst:.1e} cells, area {:.1}, {} triangles", found.surfaces[0].area, found.triangles.len());
        assert!(worst < 0.01, "{normal:?}: {worst} cells");
        let (characteristic, rim) = euler(&found);
        assert!(characteristic == 1 && rim > 100, "a disk: {characteristic}, {rim}");
        // The largest FTLE is that of the fixed point: its rate.
        assert!(found.points.iter().all(|p| (p.value - 1.0).abs() < 0.01 && p.sharpness > 0.0));
        if normal[0] == 1.0 {
            // Nodes on faces have no second derivatives.
            assert!((found.surfaces[0].area - 38.0 * 38.0).abs() < 1e-3, "{:?}", found.surfaces[0]);
        }
    }
}

/// Sheets from which the field falls faster on one side: differences of nodes shift them by 0.04 to 0.08 cells.
#[test]
fn skewed_sheets_are_exact_to_a_hundredth_of_a_cell() {
    for (normal, shift) in PLANES {
        let normal = unit(normal);
        // In cells.
        let across = |p: Vector| (dot(normal, p) - shift) / 0.025;
        for width in [4.0, 8.0] {
            let of = |d: f64| (-(d.exp() - 1.0 - d)).exp();
            let found = volume(-0.5, 0.025, 41, |p| of(across(p) / width)).surfaces(&ALL);
            let worst = found.points.iter().map(|p| across(p.place).abs()).fold(0.0, f64::max);
            println!("normal {normal:.2?}, {width} nodes wide: worst {worst:.1e} cells");
            assert!(found.surfaces.len() == 1 && worst < 0.005, "{normal:?} {width}: {worst} cells");
        }
    }
}

/// The ridge falls to half within 0.7 to 1.2 nodes, and nodes about its inflections know no direction across it.
#[test]
fn sheets_as_narrow_as_a_node_hold_together() {
    let sheet = |normal: Vector, shift: f64, width: f64| volume(-0.5, 0.025, 41, |p| (-((dot(normal, p) - shift) / width).powi(2)).exp());
    for (normal, shift) in PLANES {
        let normal = unit(normal);
        let whole = sheet(normal, shift, 0.1).surfaces(&ALL).surfaces[0].area;
        for (width, smoothing) in [(0.02, 0.0), (0.02, 0.5), (0.035, 0.0), (0.035, 0.5)] {
            let found = sheet(normal, shift, width).surfaces(&Strength { smoothing, ..ALL });
            let worst = found.points.iter().map(|p| (dot(normal, p.place) - shift).abs()).fold(0.0, f64::max) / 0.025;
            let share = found.surfaces[0].area / whole;
            println!(
                "normal {normal:.2?}, width {width}, smoothing {smoothing}: {:.1} % of the area, worst {worst:.2} cells",
                100.0 * share
            );
            assert!(found.surfaces.len() == 1 && share > 0.99 && worst < 0.25, "{} pieces", found.surfaces.len());
        }
    }
}

/// Velocities on a grid from -1.25 to 1.25, and their log-stretch over `tau` at nodes around the origin, divided by it.
fn traced(velocity: impl Fn(Vector) -> Vector, map: &FlowMap) -> Volume {
    const NODES: usize = 101;
    let axis = |name| Axis::uniform(name, "m", -1.25, 1.25, NODES).unwrap();
    let grid = Arc::new(Grid { axes: vec![axis("x"), axis("y"), axis("z")], geometry: Geometry::Cartesian, slab: (0.0, 1.0) });
    let at = |k: usize| [k % NODES, k / NODES % NODES, k / (NODES * NODES)].map(|i| -1.25 + 0.025 * i as f64);
    let component = |c: usize| (0..NODES.pow(3)).map(|k| velocity(at(k))[c] as f32).collect::<Vec<f32>>();
    let [u, v, w] = [0, 1, 2].map(component);
    let mut window = Window::new(map.tau);
    for time in [0.0, map.tau] {
        window.push(Arc::new(Snapshot::from_components(time, grid.clone(), &u, &v, &w))).unwrap();
    }
    let mut volume = volume(-0.3011, 0.0257, 24, |_| 0.0);
    let seeds: Vec<DomainPoint> =
        (0..24 * 24 * 24).map(|k| DomainPoint([k % 24, k / 24 % 24, k / 576].map(|i| (-0.3011 + 0.0257 * i as f64) as f32))).collect();
    let stretch = trace(&VelocitySource::Window(Arc::new(window)), map, 0.0, &seeds, Extras::default()).unrounded();
    volume.values = stretch.iter().map(|s| (s / map.tau) as f32).collect();
    volume.rounding = 1e-5 / map.tau;
    volume
}

#[test]
fn the_plane_of_a_saddle_traced_through_data_is_known() {
    let map =
        FlowMap { precision: Precision::F64, boundary: Boundary::Clamp, interpolation: Interpolation::Cubic, ..FlowMap::tangent(1.0, 40) };
    let normal = unit([0.3, -0.5, 0.8]);
    // Along the normal as a sine, and toward the plane's fixed point within it.
    let velocity = |p: Vector| {
        let x = dot(normal, p);
        std::array::from_fn(|k| x.sin() * normal[k] - (p[k] - x * normal[k]) / 2.0)
    };
    let volume = traced(velocity, &map);
    // Without smoothing, kinks of the data's interpolation at each of their nodes, which are as near as the nodes here, shift the surface; smoothing
    // shifts it near faces of the grid instead.
    for (smoothing, from_faces, most) in [(0.0, 1.0, 0.025), (Strength::SURFACES.smoothing, 4.5, 0.003)] {
        let found = volume.surfaces(&Strength { smoothing, ..ALL });
        assert_eq!(found.surfaces.len(), 1);
        let is_within = |p: &Vector| p.iter().all(|c| ((c + 0.3011) / 0.0257 - 11.5).abs() <= 11.5 - from_faces);
        let places = found.points.iter().map(|p| p.place).filter(is_within);
        let worst = places.map(|p| dot(normal, p).abs()).fold(0.0, f64::max) / volume.step[0];
        println!("smoothing {smoothing}: worst {worst:.1e} cells of {} vertices", found.points.len());
        assert!(worst < most && found.surfaces[0].area > 400.0, "{smoothing}: {worst} {:?}", found.surfaces);
    }
}

#[test]
fn what_is_no_ridge_gives_none() {
    // Rotation about a tilted axis: the FTLE is 0 within rounding, of which ridges must not be made.
    for precision in [Precision::F32, Precision::F64] {
        let map = FlowMap { precision, boundary: Boundary::Clamp, interpolation: Interpolation::Linear, ..FlowMap::tangent(1.0, 40) };
        let rotation = traced(|[x, y, z]| [0.4 * z - 0.8 * y, 0.8 * x, -0.4 * x], &map);
        assert!(rotation.values.iter().all(|v| v.abs() < 1e-5), "a rotation stretches nothing");
        assert_eq!(rotation.surfaces(&Strength { extent: 0.0, ..ALL }), Surfaces::default());
    }
    let none = |of: &dyn Fn(Vector) -> f64| assert_eq!(volume(-1.0, 0.05, 40, of).surfaces(&ALL), Surfaces::default());
    none(&|[x, y, z]| 1.0 + 1e-7 * (1000.0 * x * y * z).sin());
    none(&|_| f64::NAN);
    // A valley.
    none(&|[x, ..]| 1.0 - (-4.0 * (x - 0.013).powi(2)).exp());
}

/// A shell by symmetry, closed, on a grid whose coordinates have different lengths.
#[test]
fn shells_close_and_filters_choose() {
    let profile = |r: f64, at: f64, width: f64| (-((r - at) / width).powi(2)).exp();
    let centre = [0.0123, -0.007, 0.0];
    let radius = |p: Vector| p.iter().zip(centre).map(|(c, o)| (c - o).powi(2)).sum::<f64>().sqrt();
    // x in half units.
    let squeezed = |of: &dyn Fn(f64) -> f64| {
        let mut squeezed = volume(-1.0, 0.04, 51, |p| of(radius(p)));
        squeezed.origin[0] /= 2.0;
        squeezed.step[0] /= 2.0;
        squeezed.scale = vec![[2.0, 1.0, 1.0]; 51];
        squeezed
    };
    let outer = squeezed(&|r| profile(r, 0.7, 0.2)).surfaces(&ALL);
    assert_eq!((outer.surfaces.len(), euler(&outer)), (1, (2, 0)), "one sphere, without holes");
    let worst = outer.points.iter().map(|p| (radius([2.0 * p.place[0], p.place[1], p.place[2]]) - 0.7).abs()).fold(0.0, f64::max) / 0.04;
    let area = outer.surfaces[0].area / (4.0 * PI * (0.7f64 / 0.04).powi(2));
    println!("radius of 17.5 cells: worst {worst:.1e} cells, area {:.2} %", 100.0 * (area - 1.0));
    assert!(worst < 0.004 && (area - 1.0).abs() < 0.0006, "{worst} {area}");

    let mut two = squeezed(&|r| profile(r, 0.7, 0.12) + 0.4 * profile(r, 0.3, 0.12));
    let count = |volume: &Volume, strength: Strength| volume.surfaces(&strength).surfaces.len();
    assert_eq!(count(&two, ALL), 2);
    assert_eq!(count(&two, Strength { percentile: 90.0, ..ALL }), 1, "the weaker one is below the percentile");
    // It has 16 % of the vertices. The stronger one has holes then.
    let sharp = two.surfaces(&Strength { sharpness: 30.0, ..ALL });
    let is_outer = |p: &SurfacePoint| radius([2.0 * p.place[0], p.place[1], p.place[2]]) > 0.6;
    assert!(sharp.surfaces[0].area > 2000.0 && sharp.points.iter().all(is_outer), "the weaker one is less sharp");
    assert_eq!(count(&two, Strength { extent: 1000.0, ..ALL }), 1, "the smaller one has 700 squares");
    assert_eq!(count(&two, Strength { extent: 4000.0, ..ALL }), 0);
    // A faint rest does not take a strong part along: of a shell whose strength falls from pole to pole, what is above the percentile counts.
    let uneven = volume(-1.0, 0.04, 51, |p| (1.0 + 0.2 * p[2]) * profile(radius(p), 0.7, 0.12));
    let strong = uneven.surfaces(&Strength { percentile: 97.0, ..ALL });
    let [area, strong_area] = [strong.surfaces[0].area, strong.surfaces[0].strong_area];
    assert!(strong.surfaces.len() == 1 && strong_area < 0.9 * area, "{area} {strong_area}");
    assert_eq!(count(&uneven, Strength { percentile: 97.0, extent: strong_area + 1.0, ..ALL }), 0);
    // A hole cuts the shell open.
    two.values[(25 * 51 + 25) * 51 + 25 + 17] = f32::NAN;
    let cut = two.surfaces(&Strength { percentile: 90.0, ..ALL });
    let (characteristic, rim) = euler(&cut);
    assert!(characteristic == 1 && rim > 4, "a sphere with one hole: {characteristic}, {rim}");
}

#[test]
fn smoothing_keeps_the_place_under_noise() {
    let mut plane = volume(-0.5, 0.025, 41, |p| nonlinear_saddle(p[0] - 0.0137, 1.5));
    let noise = |k: usize| 0.02 * ((k as f64 * 12.9898).sin() * 43_758.545).fract() as f32;
    plane.values.iter_mut().enumerate().for_each(|(k, value)| *value += noise(k));
    let error = |found: &Surfaces| {
        let square = found.points.iter().map(|p| (p.place[0] - 0.0137).powi(2)).sum::<f64>();
        (square / found.points.len() as f64).sqrt() / 0.025
    };
    let [rough, smooth] = [0.0, 2.0].map(|smoothing| error(&plane.surfaces(&Strength { smoothing, ..ALL })));
    println!("noise of 2 %: {rough:.2} cells, smoothed {smooth:.3} cells");
    assert!(smooth < 0.1 && smooth < rough / 4.0, "{rough} {smooth}");
}
