//! The standard turbulence, written in the shapes of archives and read back: the FTLE is that of the closed form.

use crate::kit::flow::{direction, dot, quasi_random, trace, unit, window};
use ridgewatch::field::{DomainPoint, turbulence::Turbulence};
use ridgewatch::field::{EARTH_RADIUS, Geometry, Window};
use ridgewatch::flow::{Boundary, Direction, Extras, FlowMap, Interpolation, Precision, Traced, VelocitySource};
use ridgewatch::source::{Archive, ArchiveSettings, GlobeTurbulence, Metric, SnapshotSource, SyntheticSettings, SyntheticShape};
use std::path::Path;
use std::sync::Arc;
use tempfile::tempdir;

fn settings(shape: SyntheticShape, nodes: [usize; 3], k_max: f64, folder: &Path) -> ArchiveSettings {
    let synthetic =
        SyntheticSettings { nodes, snapshots: 5, k_max, amplitude: 6.0, folder: folder.to_path_buf(), ..SyntheticSettings::new(shape) };
    ArchiveSettings { synthetic: Some(synthetic), ..ArchiveSettings::default() }
}

fn traced(window: &Arc<Window>, seeds: &[DomainPoint]) -> Traced {
    let map = FlowMap {
        direction: Direction::Backward,
        precision: Precision::F64,
        boundary: Boundary::Clamp,
        interpolation: Interpolation::Cubic,
        ..FlowMap::tangent(window.span(), 64)
    };
    trace(&VelocitySource::Window(window.clone()), &map, window.newest().unwrap(), seeds, Extras::default())
}

/// Classical Runge-Kutta backwards over `tau`, `steps` steps, of any vector.
fn integrate<const N: usize>(mut x: [f64; N], from: f64, tau: f64, steps: usize, f: &impl Fn([f64; N], f64) -> [f64; N]) -> [f64; N] {
    let h = -tau / steps as f64;
    let along = |x: &[f64; N], k: &[f64; N], h: f64| -> [f64; N] { std::array::from_fn(|i| x[i] + h * k[i]) };
    for n in 0..steps {
        let t = from + h * n as f64;
        let k1 = f(x, t);
        let k2 = f(along(&x, &k1, h / 2.0), t + h / 2.0);
        let k3 = f(along(&x, &k2, h / 2.0), t + h / 2.0);
        let k4 = f(along(&x, &k3, h), t + h);
        x = std::array::from_fn(|i| x[i] + h / 6.0 * (k1[i] + 2.0 * k2[i] + 2.0 * k3[i] + k4[i]));
    }
    x
}

fn log_stretch(m: [[f64; 3]; 3]) -> f64 {
    nalgebra::Matrix3::from_fn(|i, j| m[i][j]).singular_values().max().ln()
}

/// Root mean square difference and root mean square of the second.
fn compare(found: &[f64], exact: &[f64]) -> (f64, f64) {
    let rms = |values: Vec<f64>| (values.iter().map(|v| v * v).sum::<f64>() / values.len() as f64).sqrt();
    (rms(found.iter().zip(exact).map(|(a, b)| a - b).collect()), rms(exact.to_vec()))
}

/// Seeds in the inner part of a box, far enough from its sides that no path reaches them.
fn seeds(low: [f64; 3], high: [f64; 3], count: usize) -> Vec<DomainPoint> {
    (0..count)
        .map(|i| {
            let unit = quasi_random(i);
            DomainPoint(std::array::from_fn(|k| (low[k] + (high[k] - low[k]) * (0.3 + 0.4 * unit[k])) as f32))
        })
        .collect()
}

#[test]
fn cells_of_flame_and_ecmwf_give_the_analytic_ftle() {
    let dir = tempdir().unwrap();
    let nodes = [64, 64, 48];
    let turbulence = Turbulence::new(nodes, 48, 5.0, 6.0, 0);
    let flow = |x: [f64; 3], t: f64| turbulence.velocity(x, t);
    let seeds = seeds([0.0; 3], [63.0, 63.0, 47.0], 200);
    let exact: Vec<f64> = seeds
        .iter()
        .map(|seed| {
            let gap = 1e-4;
            let columns: [[f64; 3]; 3] = std::array::from_fn(|k| {
                let end = |sign: f64| {
                    let mut x = seed.0.map(f64::from);
                    x[k] += sign * gap;
                    integrate(x, 4.0, 4.0, 200, &flow)
                };
                let (a, b) = (end(1.0), end(-1.0));
                std::array::from_fn(|i| (a[i] - b[i]) / (2.0 * gap))
            });
            log_stretch(std::array::from_fn(|i| std::array::from_fn(|k| columns[k][i])))
        })
        .collect();
    let mut found = Vec::new();
    for (shape, metric) in [(SyntheticShape::Flame, Metric::Cartesian), (SyntheticShape::Ecmwf, Metric::Index)] {
        let mut settings = settings(shape, nodes, 5.0, dir.path());
        settings.metric = Some(metric);
        settings.periodic = (metric == Metric::Index).then(|| "none".into());
        let mut archive = Archive::open(&[], &settings).unwrap();
        assert_eq!((archive.grid().shape(), archive.times().len(), archive.grid().axes[0].period()), (nodes, 5, None));
        assert_eq!(archive.times(), [0.0, 1.0, 2.0, 3.0, 4.0]);
        found.push(traced(&window(&mut archive), &seeds).log_stretch_f64);
        let (difference, size) = compare(&found[found.len() - 1], &exact);
        println!("{shape:?}, {metric:?}: log-stretch off by {difference:.1e} of {size:.2}, root mean square");
        // Cubic interpolation at ten cells a wave length, linear in time: 0.8 % of the gradient.
        assert!(difference < 0.015 * size, "{difference}");
    }
    // The grid's error is the same in both; what is left is the packing: 1 / 65532 of the range (10 root mean squares) a node, of
    // which gradients between neighbours feel a tenth more.
    let (packing, size) = compare(&found[1], &found[0]);
    println!("packed to 16 bits: off by {packing:.1e} of {size:.2} from unpacked");
    assert!(packing < 7e-4 * size, "{packing}");
}

/// Log-stretch along the sphere, from central differences of the arrival (p, z) along east, north and up.
fn globe_stretch(globe: &GlobeTurbulence, seed: DomainPoint, tau: f64) -> f64 {
    let flow = |x: [f64; 4], t: f64| {
        let p = unit([x[0], x[1], x[2]]);
        let (v, w) = globe.velocity(p, x[3], t);
        // Time in snapshots, a day each.
        [v[0] / EARTH_RADIUS, v[1] / EARTH_RADIUS, v[2] / EARTH_RADIUS, w].map(|d| d * 86_400.0)
    };
    let basis = |p: [f64; 3]| {
        let (sin_lat, cos_lat) = (p[2], p[0].hypot(p[1]));
        let (sin_lon, cos_lon) = (p[1] / cos_lat, p[0] / cos_lat);
        [[-sin_lon, cos_lon, 0.0], [-sin_lat * cos_lon, -sin_lat * sin_lon, cos_lat]]
    };
    let p = direction(f64::from(seed.0[0]), f64::from(seed.0[1]));
    let [east, north] = basis(p);
    // Metres; a hundred horizontally, ten vertically.
    let offsets = [(east, 0.0, 100.0), (north, 0.0, 100.0), ([0.0; 3], 1.0, 10.0)];
    let arrive = |k: usize, sign: f64| {
        let (direction, up, gap) = offsets[k];
        let mut x = [p[0], p[1], p[2], f64::from(seed.0[2]) + sign * up * gap];
        for i in 0..3 {
            x[i] += sign * direction[i] * gap / EARTH_RADIUS;
        }
        let x = integrate(x, tau, tau, 200, &flow);
        (unit([x[0], x[1], x[2]]), x[3])
    };
    let middle = arrive(2, 0.0).0;
    let [east, north] = basis(middle);
    let mut m = [[0.0; 3]; 3];
    for k in 0..3 {
        let (a, b) = (arrive(k, 1.0), arrive(k, -1.0));
        let change: [f64; 3] = std::array::from_fn(|i| (a.0[i] - b.0[i]) * EARTH_RADIUS);
        for (i, value) in [dot(east, change), dot(north, change), a.1 - b.1].into_iter().enumerate() {
            m[i][k] = value / (2.0 * offsets[k].2);
        }
    }
    log_stretch(m)
}

#[test]
fn metres_over_a_globe_give_the_analytic_ftle() {
    let dir = tempdir().unwrap();
    let nodes = [180, 91, 37];
    let mut settings = settings(SyntheticShape::Globe, nodes, 4.0, dir.path());
    settings.metric = Some(Metric::Sphere);
    let mut archive = Archive::open(&[], &settings).unwrap();
    let grid = archive.grid().clone();
    assert!(matches!(grid.geometry, Geometry::Sphere { .. }) && grid.axes[0].period() == Some(360.0));
    // 1000 hPa to 1 hPa at H = 7 km.
    assert!(grid.axes[2].first().abs() < 1e-9 && (grid.axes[2].last() - 7000.0 * 1000f64.ln()).abs() < 1e-6);
    let globe = GlobeTurbulence::new(settings.synthetic.as_ref().unwrap(), [grid.axes[2].first(), grid.axes[2].last()]);
    let mut seeds: Vec<DomainPoint> = (0..150)
        .map(|i| {
            let latitude = (2.0 * (i as f64 + 0.5) / 150.0 - 1.0).asin().to_degrees();
            DomainPoint([(i as f32 * 137.507_76) % 360.0, latitude as f32, (3000.0 + 20_000.0 * (i as f64 * 0.618_034).fract()) as f32])
        })
        .collect();
    seeds.extend([[12.0, 89.8, 8000.0], [230.0, -89.5, 8000.0]].map(DomainPoint));
    let exact: Vec<f64> = seeds.iter().map(|&s| globe_stretch(&globe, s, 4.0)).collect();
    let out = traced(&window(&mut archive), &seeds);
    assert!(out.lifetime_share.iter().all(|&l| l == 1.0));
    let (difference, size) = compare(&out.log_stretch_f64, &exact);
    println!("globe, sphere: log-stretch off by {difference:.1e} of {size:.2}, root mean square");
    // Uneven levels up to 5 km apart in a field whose vertical shear counts most: 0.5 %; and packing.
    assert!(difference < 0.0095 * size, "{difference} of {size}");
}

#[test]
fn an_archive_is_written_once() {
    let dir = tempdir().unwrap();
    let settings = settings(SyntheticShape::Flame, [8, 8, 8], 4.0, dir.path());
    let first = Archive::open(&[], &settings).unwrap().files().map(Path::to_path_buf).collect::<Vec<_>>();
    assert_eq!(first.len(), 5);
    let written = std::fs::metadata(&first[0]).unwrap().modified().unwrap();
    Archive::open(&[], &settings).unwrap();
    assert_eq!(std::fs::metadata(&first[0]).unwrap().modified().unwrap(), written);
    assert_eq!(std::fs::read_dir(dir.path()).unwrap().count(), 1, "nothing unfinished is left");
    let mut wrong = settings;
    wrong.synthetic.as_mut().unwrap().nodes = [2, 8, 8];
    assert!(Archive::open(&[], &wrong).err().unwrap().to_string().contains("synthetic.nodes"));
}
