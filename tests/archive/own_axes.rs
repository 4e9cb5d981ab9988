//! Components on coordinates of their own: Arakawa's C grid in rows, and vertical velocities between the levels of the others.

use crate::integrated::Compared;
use crate::kit::netcdf::*;
use crate::{HOURS, inspected, notes, open, open_with, refused};
use ridgewatch::field::{Geometry, Snapshot};
use ridgewatch::source::SnapshotSource;
use tempfile::tempdir;

/// Points of a component along x, y and z.
type Points<'a> = [(&'a str, &'a [f64]); 3];

const XG: [f64; 5] = [0.0, 100.0, 200.0, 300.0, 400.0];
const XC: [f64; 4] = [50.0, 150.0, 250.0, 350.0];
const YG: [f64; 4] = [0.0, 200.0, 400.0, 600.0];
const YC: [f64; 3] = [100.0, 300.0, 500.0];
const Z: [f64; 3] = [-5.0, -15.0, -25.0];
const ZL: [f64; 4] = [0.0, -10.0, -20.0, -30.0];

fn linear(which: usize, [x, y, z]: [f64; 3], time: f64) -> f64 {
    (which as f64 + 1.0) * (0.5 + time + 1e-3 * x - 2e-3 * y + 0.01 * z)
}

fn values(which: usize, points: Points, field: impl Fn(usize, [f64; 3], f64) -> f64) -> Data {
    let [x, y, z] = points.map(|p| p.1);
    let at = |i: usize| [x[i % x.len()], y[i / x.len() % y.len()], z[i / (x.len() * y.len()) % z.len()]];
    let nodes = x.len() * y.len() * z.len();
    f32s((0..2 * nodes).map(|i| field(which, at(i), (i / nodes) as f64)).collect())
}

/// As MITgcm writes it: u on western, v on southern, w on upper faces.
fn staggered(field: impl Fn(usize, [f64; 3], f64) -> f64) -> Fixture {
    let axes: [(&str, &str, &[f64]); 7] = [
        ("T", HOURS, &[0.0, 1.0]),
        ("XG", "m", &XG),
        ("XC", "m", &XC),
        ("YG", "m", &YG),
        ("YC", "m", &YC),
        ("Z", "m", &Z),
        ("Zl", "m", &ZL),
    ];
    let mut fixture = Fixture::new(CLASSIC, &[]);
    for (name, unit, values) in axes {
        fixture = fixture.dimension(name, values.len()).axis(name, unit, values);
        fixture = match name.as_bytes()[0] {
            b'T' => fixture,
            letter => fixture.with("axis", (letter as char).to_string()),
        };
    }
    let points: [Points; 3] =
        [[("XG", &XG), ("YC", &YC), ("Z", &Z)], [("XC", &XC), ("YG", &YG), ("Z", &Z)], [("XC", &XC), ("YC", &YC), ("Zl", &ZL)]];
    for (which, name) in ["UVEL", "VVEL", "WVEL"].into_iter().enumerate() {
        let [x, y, z] = points[which].map(|p| p.0);
        fixture = fixture.variable(name, &["T", z, y, x], values(which, points[which], &field)).with("units", "m s-1");
    }
    fixture
}

/// Largest error against `linear` where all components lie between their own points.
fn worst(snapshot: &Snapshot, time: f64, lowest: f64) -> f64 {
    let grid = &snapshot.grid;
    let [nx, ny, _] = grid.shape();
    let mut worst = 0.0f64;
    for (i, node) in snapshot.nodes.iter().enumerate() {
        let at = [i % nx, i / nx % ny, i / (nx * ny)];
        let at: [f64; 3] = std::array::from_fn(|k| grid.axes[k].coordinates()[at[k]]);
        if (lowest..=-5.0).contains(&at[2]) {
            worst = (0..3).map(|c| (f64::from(node[c]) - linear(c, at, time)).abs()).fold(worst, f64::max);
        }
    }
    worst
}

#[test]
fn each_component_is_interpolated_from_its_own_points() {
    let dir = tempdir().unwrap();
    let file = staggered(linear).write(&dir.path().join("mitgcm.nc"));
    let mut archive = open(&[&file]);
    let grid = archive.grid().clone();
    assert_eq!(grid.axes[0].coordinates(), [50.0, 100.0, 150.0, 200.0, 250.0, 300.0, 350.0]);
    assert_eq!(grid.axes[1].coordinates(), [100.0, 200.0, 300.0, 400.0, 500.0]);
    assert_eq!(grid.axes[2].coordinates(), [-30.0, -25.0, -20.0, -15.0, -10.0, -5.0, 0.0]);
    for time in 0..2 {
        let snapshot = archive.read(time).unwrap();
        assert!(worst(&snapshot, time as f64, -25.0) < 1e-6, "{}", worst(&snapshot, time as f64, -25.0));
        // Above its highest level u is that of the level, and w its own.
        let top = &snapshot.nodes[6 * 35];
        let expected = [linear(0, [50.0, 100.0, -5.0], time as f64), linear(2, [50.0, 100.0, 0.0], time as f64)];
        assert!((f64::from(top[0]) - expected[0]).abs() < 1e-6 && (f64::from(top[2]) - expected[1]).abs() < 1e-6, "{top:?}");
    }
    for piece in ["own coordinates along x: `XG`, `XC`", "along y: `YC`, `YG`", "along z: `Z`, `Zl`"] {
        assert!(notes(&archive).contains(piece), "{piece}: {}", notes(&archive));
    }
    assert!(inspected(&[&file]).to_string().contains("each component is interpolated from its own points"));
    let mut centres = open_with(&[&file], "staggering = \"centres\"");
    assert_eq!(centres.grid().shape(), [4, 3, 3]);
    assert!(worst(&centres.read(1).unwrap(), 1.0, -25.0) < 1e-6);
    let mut level = open_with(&[&file], "level = -15.0");
    assert_eq!(level.grid().shape(), [7, 5, 1]);
    assert!((level.read(0).unwrap().nodes[0][0] as f64 - linear(0, [50.0, 100.0, -15.0], 0.0)).abs() < 1e-6);
    refused(&[&file], "metric = \"index\"", &["`metric`", "`UVEL` and `VVEL` lie on points of their own", "--set archive.level=VALUE"]);
}

#[test]
fn nothing_flows_through_the_bottom_and_land_is_missing() {
    let dir = tempdir().unwrap();
    let land = |x: f64, y: f64| x > 220.0 && y > 320.0;
    let field = |which: usize, [x, y, z]: [f64; 3], time: f64| match which {
        _ if land(x, y) => f64::NAN,
        // Below the last but one face is rock.
        2 if z < -15.0 => f64::NAN,
        _ if z < -20.0 => f64::NAN,
        _ => linear(which, [x, y, z], time),
    };
    let mut archive = open(&[staggered(field).write(&dir.path().join("land.nc"))]);
    let snapshot = archive.read(0).unwrap();
    let [nx, ny, _] = snapshot.grid.shape();
    let node = |i: usize, j: usize, k: usize| snapshot.nodes[(k * ny + j) * nx + i];
    // At -15 m w lies between the face at -10 m and the bottom.
    let expected = 0.5 * linear(2, [50.0, 100.0, -10.0], 0.0);
    assert!((f64::from(node(0, 0, 3)[2]) - expected).abs() < 1e-6, "{:?} {expected}", node(0, 0, 3));
    assert!(node(0, 0, 1)[3].is_nan(), "rock");
    assert!(node(6, 4, 4)[3].is_nan() && !node(0, 4, 4)[3].is_nan() && !node(6, 0, 4)[3].is_nan());
}

#[test]
fn circles_of_faces_and_centres_are_closed() {
    let dir = tempdir().unwrap();
    let faces: Vec<f64> = (0..36).map(|i| f64::from(i) * 10.0).collect();
    let centres: Vec<f64> = faces.iter().map(|x| x - 175.0).collect();
    let (yc, yg) = ([-5.0, 5.0, 15.0], [-10.0, 0.0, 10.0]);
    let axes: [(&str, &str, &[f64]); 5] = [
        ("time", HOURS, &[0.0, 1.0]),
        ("lon_u", "degrees_east", &faces),
        ("lon_v", "degrees_east", &centres),
        ("lat_u", "degrees_north", &yc),
        ("lat_v", "degrees_north", &yg),
    ];
    let mut fixture = Fixture::new(CLASSIC, &[]);
    for (name, unit, values) in axes {
        fixture = fixture.dimension(name, values.len()).axis(name, unit, values);
    }
    let wave = |x: f64| x.to_radians().cos();
    let of = |points: &[f64]| f32s((0..2 * 3 * 36).map(|i| wave(points[i % 36])).collect());
    fixture = fixture.variable("u", &["time", "lat_u", "lon_u"], of(&faces)).with("units", "m/s");
    fixture = fixture.variable("v", &["time", "lat_v", "lon_v"], of(&centres)).with("units", "m/s");
    let mut archive = open(&[fixture.write(&dir.path().join("round.nc"))]);
    let grid = archive.grid().clone();
    assert_eq!((grid.shape(), grid.axes[0].period()), ([72, 4, 1], Some(360.0)));
    assert_eq!(grid.axes[1].coordinates(), [-5.0, 0.0, 5.0, 10.0]);
    let snapshot = archive.read(0).unwrap();
    for i in 0..72 {
        let (x, [east, north]) = (grid.axes[0].coordinates()[i], east_north(&snapshot, i));
        let near = |first: f64| {
            let cell = ((x - first) / 10.0).floor();
            let share = (x - first) / 10.0 - cell;
            (1.0 - share) * wave(first + 10.0 * cell) + share * wave(first + 10.0 * (cell + 1.0))
        };
        assert!((east - near(0.0)).abs() < 1e-6 && (north - near(-175.0)).abs() < 1e-6, "{x}: {east} {north}");
    }
}

/// NEMO: as many levels of w as of u, but above them.
#[test]
fn w_between_the_levels_of_a_mesh_is_interpolated_to_them() {
    let dir = tempdir().unwrap();
    let [nx, ny] = [49usize; 2];
    let mut fixture = Fixture::new(CLASSIC, &[("time_counter", 2), ("depthu", 3), ("depthw", 3), ("y", ny), ("x", nx)]);
    fixture = fixture.axis("time_counter", HOURS, &[0.0, 1.0]);
    fixture = fixture.axis("depthu", "m", &[5.0, 15.0, 25.0]).with("positive", "down");
    fixture = fixture.axis("depthw", "m", &[0.0, 10.0, 20.0]).with("positive", "down");
    let place = |i: usize| [(i % nx) as f64 * 0.25 + 0.01 * (i / nx) as f64, 40.0 + (i / nx) as f64 * 0.2];
    for (k, (name, unit)) in [("nav_lon", "degrees_east"), ("nav_lat", "degrees_north")].into_iter().enumerate() {
        fixture = fixture.variable(name, &["y", "x"], f32s((0..nx * ny).map(|i| place(i)[k]).collect())).with("units", unit);
    }
    let depths = [5.0, 15.0, 25.0, 0.0, 10.0, 20.0];
    for (name, level, first, standard) in [
        ("vozocrtx", "depthu", 0, "eastward_sea_water_velocity"),
        ("vomecrty", "depthu", 0, "northward_sea_water_velocity"),
        ("vovecrtz", "depthw", 3, "upward_sea_water_velocity"),
    ] {
        let values = f32s((0..2 * 3 * nx * ny).map(|i| 1.0 + depths[first + i / (nx * ny) % 3]).collect());
        fixture = fixture.variable(name, &["time_counter", level, "y", "x"], values).with("units", "m/s").with("standard_name", standard);
    }
    let mut archive = open(&[fixture.write(&dir.path().join("nemo.nc"))]);
    let grid = archive.grid().clone();
    assert_eq!(grid.axes[2].coordinates(), [-25.0, -20.0, -15.0, -10.0, -5.0, 0.0]);
    assert!(matches!(grid.geometry, Geometry::Sphere { .. }));
    assert!(notes(&archive).contains("along z: `depthu`, `depthw`"), "{}", notes(&archive));
    let snapshot = archive.read(0).unwrap();
    let plane = grid.shape()[0] * grid.shape()[1];
    let up = |level: usize| {
        let node = (0..plane).map(|i| level * plane + i).find(|&i| !snapshot.nodes[i][3].is_nan()).unwrap();
        // Beside the horizontal velocity.
        f64::from(snapshot.nodes[node][3])
    };
    // w between its own levels, and below them that of the lowest.
    for (level, expected) in [(0, 21.0), (1, 21.0), (2, 16.0), (3, 11.0), (4, 6.0), (5, 1.0)] {
        assert!((up(level) - expected).abs() < 1e-3, "level {level}: {} {expected}", up(level));
    }
}

/// CROCO and ROMS on a plane: numbers of columns as coordinates of one dimension, places of the centres alone in two, levels that follow the bottom.
#[test]
fn faces_between_centres_of_a_plane_follow_the_bottom() {
    let dir = tempdir().unwrap();
    let (nx, ny, nz) = (6usize, 5usize, 3usize);
    let mut fixture =
        Fixture::new(CLASSIC, &[("time", 2), ("s_rho", nz), ("eta_rho", ny), ("eta_v", ny - 1), ("xi_rho", nx), ("xi_u", nx - 1)]);
    fixture = fixture.axis("time", HOURS, &[0.0, 1.0]);
    for (name, count) in [("xi_rho", nx), ("xi_u", nx - 1), ("eta_rho", ny), ("eta_v", ny - 1)] {
        let numbers: Vec<f64> = (1..=count).map(|n| n as f64).collect();
        fixture = fixture
            .axis(name, "", &numbers)
            .with("standard_name", "x_grid_index")
            .with("axis", if name.starts_with('x') { "X" } else { "Y" });
    }
    for (k, name) in ["x_rho", "y_rho"].into_iter().enumerate() {
        let at = |i: usize| 1000.0 * [i % nx, i / nx][k] as f64;
        fixture = fixture.variable(name, &["eta_rho", "xi_rho"], f32s((0..nx * ny).map(at).collect())).with("units", "meter");
    }
    let s = [-0.75, -0.5, -0.25];
    fixture = fixture.variable("s_rho", &["s_rho"], f32s(s.to_vec())).with("standard_name", "ocean_sigma_coordinate");
    fixture = fixture.with("formula_terms", "sigma: s_rho eta: zeta depth: h");
    fixture = fixture.variable("h", &["eta_rho", "xi_rho"], f32s(vec![100.0; nx * ny])).with("units", "meter");
    fixture = fixture.variable("zeta", &["time", "eta_rho", "xi_rho"], f32s(vec![0.0; 2 * nx * ny])).with("units", "meter");
    for (which, (name, [eta, xi], [ny, nx], shift)) in [
        ("u", ["eta_rho", "xi_u"], [ny, nx - 1], [500.0, 0.0]),
        ("v", ["eta_v", "xi_rho"], [ny - 1, nx], [0.0, 500.0]),
        ("w", ["eta_rho", "xi_rho"], [ny, nx], [0.0; 2]),
    ]
    .into_iter()
    .enumerate()
    {
        let at = |i: usize| [1000.0 * (i % nx) as f64 + shift[0], 1000.0 * (i / nx % ny) as f64 + shift[1], 100.0 * s[i / (nx * ny) % nz]];
        let values = (0..2 * nx * ny * nz).map(|i| linear(which, at(i), (i / (nx * ny * nz)) as f64)).collect();
        fixture = fixture.variable(name, &["time", "s_rho", eta, xi], f32s(values)).with("units", "meter second-1");
    }
    let mut archive = open_with(&[fixture.write(&dir.path().join("croco.nc"))], "heights = [-70.0, -50.0, -30.0]");
    let grid = archive.grid().clone();
    assert!(matches!(grid.geometry, Geometry::Cartesian));
    assert_eq!((grid.shape(), grid.axes[0].first(), grid.axes[0].last()), ([9, 7, 3], 500.0, 4500.0));
    let snapshot = archive.read(1).unwrap();
    for (i, node) in snapshot.nodes.iter().enumerate() {
        let at = [i % 9, i / 9 % 7, i / 63];
        let at: [f64; 3] = std::array::from_fn(|k| grid.axes[k].coordinates()[at[k]]);
        for c in 0..3 {
            assert!((f64::from(node[c]) - linear(c, at, 1.0)).abs() < 2e-5, "{at:?} {node:?}");
        }
    }
    assert!(notes(&archive).contains("along x: `xi_u`, `xi_rho`"), "{}", notes(&archive));
}

/// A flow without symmetry on faces, beside an integration by other tools.
#[test]
#[ignore = "needs Python: make test-data"]
fn faces_agree_with_an_independent_integration() {
    let dir = tempdir().unwrap();
    let field = |which: usize, [x, y, z]: [f64; 3], time: f64| {
        let (a, b, c) = (x / 60.0 + 0.4 * time, y / 90.0 - 0.3 * time, z / 8.0);
        0.02 * [a.sin() * b.cos() + 0.4 * c.sin(), 0.7 * (a.cos() - b).sin() + 0.2 * c.cos(), 0.03 * (a + b).sin() * c.cos()][which]
    };
    let files = [staggered(field).write(&dir.path().join("faces.nc"))];
    let compared = Compared::new("rows", &files, "", 3600.0);
    let (relative, correlation) = compared.exactly().report("faces");
    // The same interpolant.
    assert!(relative < 1e-6 && correlation > 0.999_999, "{relative} {correlation}");
    let (relative, correlation) = compared.by_default().report("faces, by default");
    assert!(relative < 0.03 && correlation > 0.99, "{relative} {correlation}");
}

/// NEMO: u and v have dimensions of their own for the same levels. One level is the same in both.
#[test]
fn a_level_is_read_of_each_component() {
    let dir = tempdir().unwrap();
    let depths = [5.0, 15.0, 25.0];
    for is_mesh in [false, true] {
        let of_v = |depths: &[f64; 3], name: &str| {
            let (nx, ny) = (6usize, 5usize);
            let mut fixture = Fixture::new(CLASSIC, &[("time", 2), ("depthu", 3), ("depthv", 3), ("y", ny), ("x", nx)]);
            fixture = fixture.axis("time", HOURS, &[0.0, 1.0]).axis("depthu", "m", &[5.0, 15.0, 25.0]).with("positive", "down");
            fixture = fixture.axis("depthv", "m", depths).with("positive", "down");
            let place = |i: usize| [(i % nx) as f64, 40.0 + (i / nx) as f64];
            for (k, (name, axis, unit)) in [("nav_lon", "x", "degrees_east"), ("nav_lat", "y", "degrees_north")].into_iter().enumerate() {
                fixture = match is_mesh {
                    true => fixture.variable(name, &["y", "x"], f32s((0..nx * ny).map(|i| place(i)[k]).collect())).with("units", unit),
                    false => fixture.axis(axis, unit, &(0..[nx, ny][k]).map(|i| [0.0, 40.0][k] + i as f64).collect::<Vec<_>>()),
                };
            }
            for (name, level) in [("uo", "depthu"), ("vo", "depthv")] {
                let values = f32s((0..2 * 3 * nx * ny).map(|i| depths[i / (nx * ny) % 3]).collect());
                let standard = if name == "uo" { "eastward_sea_water_velocity" } else { "northward_sea_water_velocity" };
                fixture = fixture.variable(name, &["time", level, "y", "x"], values).with("units", "m/s").with("standard_name", standard);
            }
            fixture.write(&dir.path().join(format!("{name}-{is_mesh}.nc")))
        };
        let file = of_v(&depths, "same");
        let read = |toml: &str| {
            let snapshot = open_with(&[&file], toml).read(1).unwrap();
            let node = (0..snapshot.nodes.len()).find(|&i| !snapshot.nodes[i][3].is_nan()).unwrap();
            east_north(&snapshot, node).map(|v| (v * 1e3).round() / 1e3)
        };
        assert_eq!(read("level = 25.0"), [25.0, 25.0], "mesh: {is_mesh}");
        if is_mesh {
            assert_eq!(read("select = { depthu = 1 }"), [15.0, 15.0]);
        }
        let other = of_v(&[4.0, 14.0, 24.0], "other");
        refused(&[&other], "level = 25.0", &["`vo`", "it has no level at 25 (entry 2 of `depthu`)", "its levels `depthv` are 4, 14, 24"]);
        if is_mesh {
            refused(&[&other], "", &["`vo`", "level 0 of it lies at 4, that of `uo` at 5"]);
        }
    }
}
