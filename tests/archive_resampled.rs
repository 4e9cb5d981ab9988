//! Grids that are resampled: WRF's staggered, terrain-following one, and longitudes and latitudes of two dimensions.
#![allow(clippy::unwrap_used, clippy::print_stdout)] // Tests: a panic is the report.

mod netcdf_fixture;

use netcdf_fixture::*;
use ridgewatch::field::{Geometry, Snapshot};
use ridgewatch::source::{Metric, NetCdfArchive, NetCdfSettings, SnapshotSource, Staggering, inspect};
use std::path::Path;
use tempfile::tempdir;

const CELLS: [usize; 3] = [6, 5, 4];
const STEP: f64 = 1000.0;
const GRAVITY: f64 = 9.81;

/// Ground rises along x.
fn ground(x: f64) -> f64 {
    0.02 * x
}

/// Velocities that are linear in all coordinates: no interpolation is wrong about them.
fn wind(x: f64, y: f64, z: f64, time: f64) -> [f64; 3] {
    [3.0 + 2e-3 * x - 1e-3 * y + 4e-3 * z + time, -1.0 + 1e-3 * x + 3e-3 * y, 0.1 + 1e-4 * z]
}

/// Cells of 1 km with centres at half kilometres and full levels 500 m apart over a ground that rises.
fn wrf(with_times: bool) -> Fixture {
    let [nx, ny, nz] = CELLS;
    let mut fixture = Fixture::new(
        NETCDF4,
        &[
            ("Time", 2),
            ("DateStrLen", 19),
            ("west_east", nx),
            ("south_north", ny),
            ("bottom_top", nz),
            ("west_east_stag", nx + 1),
            ("south_north_stag", ny + 1),
            ("bottom_top_stag", nz + 1),
        ],
    )
    .attribute("DX", STEP as f32)
    .attribute("DY", STEP as f32);
    if with_times {
        fixture = fixture.variable("Times", &["Time", "DateStrLen"], Data::Text("2005-08-28_12:00:002005-08-28_15:00:00"));
    }
    fixture = fixture.variable("XTIME", &["Time"], Data::F32(vec![720.0, 900.0])).with("units", "minutes since 2005-08-28 00:00:00");
    for (c, (name, dims)) in [
        ("U", ["Time", "bottom_top", "south_north", "west_east_stag"]),
        ("V", ["Time", "bottom_top", "south_north_stag", "west_east"]),
        ("W", ["Time", "bottom_top_stag", "south_north", "west_east"]),
    ]
    .into_iter()
    .enumerate()
    {
        let mut values = Vec::new();
        for t in 0..2 {
            for k in 0..nz + usize::from(c == 2) {
                for j in 0..ny + usize::from(c == 1) {
                    for i in 0..nx + usize::from(c == 0) {
                        let x = (i as f64 + if c == 0 { 0.0 } else { 0.5 }) * STEP;
                        let y = (j as f64 + if c == 1 { 0.0 } else { 0.5 }) * STEP;
                        let z = ground(x) + 500.0 * (k as f64 + if c == 2 { 0.0 } else { 0.5 });
                        values.push(wind(x, y, z, t as f64)[c] as f32);
                    }
                }
            }
        }
        fixture = fixture.variable(name, &dims, Data::F32(values)).with("units", "m s-1").with("stagger", ["X", "Y", "Z"][c]);
    }
    for (name, share) in [("PH", 0.25), ("PHB", 0.75)] {
        let mut values = Vec::new();
        for _ in 0..2 {
            for k in 0..nz + 1 {
                for _ in 0..ny {
                    values.extend((0..nx).map(|i| ((ground((i as f64 + 0.5) * STEP) + 500.0 * k as f64) * GRAVITY * share) as f32));
                }
            }
        }
        fixture =
            fixture.variable(name, &["Time", "bottom_top_stag", "south_north", "west_east"], Data::F32(values)).with("units", "m2 s-2");
    }
    fixture
}

/// Largest error of a snapshot's known nodes against `wind`, and their number.
fn error(snapshot: &Snapshot, time: f64) -> (f64, usize) {
    let grid = &snapshot.grid;
    let [nx, ny, _] = grid.shape();
    let (mut worst, mut known) = (0.0f64, 0);
    for (i, node) in snapshot.nodes.iter().enumerate().filter(|(_, n)| !n[3].is_nan()) {
        let at = [i % nx, i / nx % ny, i / (nx * ny)].iter().enumerate().map(|(k, &n)| grid.axes[k].coordinates()[n]).collect::<Vec<_>>();
        // Between the ground and the lowest half level winds are those of the latter.
        if at[2] < ground(at[0]) + 250.0 {
            continue;
        }
        let expected = wind(at[0], at[1], at[2], time);
        worst = (0..3).map(|c| (f64::from(node[c]) - expected[c]).abs()).fold(worst, f64::max);
        known += 1;
    }
    (worst, known)
}

#[test]
fn components_come_from_their_own_faces() {
    let dir = tempdir().unwrap();
    let file = wrf(true).write(&dir.path().join("wrfout_d01"));
    let mut archive = NetCdfArchive::open(std::slice::from_ref(&file), &NetCdfSettings::default()).unwrap();
    assert_eq!(archive.metric(), Metric::Cartesian);
    let grid = archive.grid().clone();
    // Faces and centres, from the first centre to the last; full and half levels.
    assert_eq!(grid.shape(), [11, 9, 8]);
    assert_eq!((grid.axes[0].first(), grid.axes[0].last(), grid.axes[0].uniform_step()), (500.0, 5500.0, Some(500.0)));
    assert_eq!(archive.date(archive.times()[1]).as_deref(), Some("2005-08-28T15:00:00Z"));
    for time in 0..2 {
        let snapshot = archive.read(time).unwrap();
        let (worst, known) = error(&snapshot, time as f64);
        // Heights of 2 km and winds of 20 m/s in f32.
        assert!(worst < 5e-5 && known > 300, "{worst} {known}");
        // The lowest corner of the grid lies in the ground where that has risen.
        assert!(snapshot.nodes[0][3] == 0.0 && snapshot.nodes[10][3].is_nan());
    }
    let inspection = inspect(std::slice::from_ref(&file), &NetCdfSettings::default(), None).unwrap();
    let resampling = inspection.resampling.as_ref().unwrap();
    // Linear fields survive but for the lowest half cells, where winds are held: 0.004 / s over up to 250 m there, in few points.
    assert!(resampling.error > 0.0 && resampling.error < 1e-2 * resampling.velocity, "{resampling:?}");
    assert!(inspection.to_string().contains("resampling\n  error"));
    // The same times as minutes, and where there are no characters.
    let minutes = wrf(false).write(&dir.path().join("minutes.nc"));
    let other = NetCdfArchive::open(&[minutes], &NetCdfSettings::default()).unwrap();
    assert_eq!(other.times(), archive.times());
    let settings = NetCdfSettings { time: Some("XTIME".into()), ..NetCdfSettings::default() };
    assert_eq!(NetCdfArchive::open(std::slice::from_ref(&file), &settings).unwrap().times(), archive.times());
    // Centres only; and heights of one's own.
    let settings =
        NetCdfSettings { staggering: Staggering::Centres, heights: Some(vec![600.0, 900.0, 1200.0]), ..NetCdfSettings::default() };
    let mut coarse = NetCdfArchive::open(std::slice::from_ref(&file), &settings).unwrap();
    assert_eq!(coarse.grid().shape(), [6, 5, 3]);
    let (worst, known) = error(&coarse.read(1).unwrap(), 1.0);
    assert!(worst < 5e-5 && known == 90, "{worst} {known}");
    for (toml, piece) in [("metric = \"sphere\"", "cartesian"), ("level = 3.0", "heights"), ("heights = [2.0, 1.0]", "strictly ascending")]
    {
        let message = NetCdfArchive::open(std::slice::from_ref(&file), &toml::from_str(toml).unwrap()).err().unwrap().to_string();
        assert!(message.contains(piece), "{toml}: {message}");
    }
}

/// Longitude and latitude of a mesh turned by 20 degrees about (30 E, 40 N).
fn mesh(i: usize, j: usize, n: usize) -> (f64, f64) {
    let (x, y) = ((i as f64 / (n - 1) as f64 - 0.5) * 12.0, (j as f64 / (n - 1) as f64 - 0.5) * 12.0);
    let (sine, cosine) = 20f64.to_radians().sin_cos();
    // Lengths on the ground, so that the mesh is turned there and not only on the map.
    (30.0 + (cosine * x - sine * y) / 40f64.to_radians().cos(), 40.0 + sine * x + cosine * y)
}

fn eastward(lon: f64, lat: f64) -> f64 {
    0.5 + 0.3 * (lon * 0.2).sin() + 0.02 * (lat - 40.0)
}

fn ocean(along_grid: bool) -> Fixture {
    ocean_at(along_grid, 0.0, 0.0)
}

/// The same `east` degrees further, `hours` later.
fn ocean_at(along_grid: bool, east: f64, hours: f64) -> Fixture {
    let n = 49;
    let points: Vec<(f64, f64)> = (0..n * n).map(|p| mesh(p % n, p / n, n)).map(|(lon, lat)| (lon + east, lat)).collect();
    // An island of nine points; along the grid the flow is (1, 0) everywhere.
    let island = |p: usize| (10..13).contains(&(p % n)) && (10..13).contains(&(p / n));
    let flow = |p: usize| if along_grid { 1.0 } else { eastward(points[p].0, points[p].1) };
    let u: Vec<f32> = (0..2 * n * n).map(|p| if island(p % (n * n)) { f32::NAN } else { flow(p % (n * n)) as f32 }).collect();
    let v: Vec<f32> = (0..2 * n * n).map(|_| 0.0).collect();
    let names = if along_grid {
        ["sea_water_x_velocity", "sea_water_y_velocity"]
    } else {
        ["eastward_sea_water_velocity", "northward_sea_water_velocity"]
    };
    Fixture::new(NETCDF4, &[("time", 2), ("y", n), ("x", n)])
        .axis("time", "hours since 2000-01-01", &[hours, hours + 1.0])
        .variable("nav_lon", &["y", "x"], Data::F64(points.iter().map(|p| p.0).collect()))
        .with("units", "degrees_east")
        .variable("nav_lat", &["y", "x"], Data::F64(points.iter().map(|p| p.1).collect()))
        .with("units", "degrees_north")
        .variable("uo", &["time", "y", "x"], Data::F32(u))
        .with("standard_name", names[0])
        .with("units", "m s-1")
        .with("coordinates", "nav_lat nav_lon")
        .variable("vo", &["time", "y", "x"], Data::F32(v))
        .with("standard_name", names[1])
        .with("units", "m s-1")
        .with("coordinates", "nav_lat nav_lon")
}

#[test]
fn curvilinear_grids_are_resampled_and_say_how_well() {
    let dir = tempdir().unwrap();
    let file = ocean(false).write(&dir.path().join("ocean.nc"));
    let mut archive = NetCdfArchive::open(std::slice::from_ref(&file), &NetCdfSettings::default()).unwrap();
    let grid = archive.grid().clone();
    assert!(matches!(grid.geometry, Geometry::Sphere { .. }) && grid.dimensions() == 2);
    let snapshot = archive.read(0).unwrap();
    let [nx, ny, _] = grid.shape();
    let (mut known, mut worst) = (0, 0.0f64);
    for i in 0..nx * ny {
        if snapshot.nodes[i][3].is_nan() {
            continue;
        }
        let [east, north] = east_north(&snapshot, i);
        let exact = eastward(grid.axes[0].coordinates()[i % nx], grid.axes[1].coordinates()[i / nx]);
        worst = worst.max((east - exact).abs()).max(north.abs());
        known += 1;
    }
    // A cell is 0.25 degrees; an eighth of its square times the second derivative 0.012 in each direction.
    assert!(worst < 3e-4 && known > nx * ny / 3, "{worst} {known} of {}", nx * ny);
    assert!(snapshot.missing() > 0, "corners outside of the turned square, and the island");
    let notes = archive.describe().notes.join("\n");
    assert!(notes.contains("resampled bilinearly from 49 x 49 points") && notes.contains("resampling error"), "{notes}");
    let inspection = inspect(std::slice::from_ref(&file), &NetCdfSettings::default(), None).unwrap();
    let resampling = inspection.resampling.unwrap();
    assert!(resampling.error > 0.0 && resampling.error < 1e-3 * resampling.velocity, "{resampling:?}");
    let settings = NetCdfSettings { resolution: Some([1.0, 1.0]), ..NetCdfSettings::default() };
    let coarse = NetCdfArchive::open(&[file], &settings).unwrap();
    assert!(coarse.grid().nodes() < grid.nodes() / 4);
}

#[test]
fn a_later_file_on_other_points_is_refused() {
    let dir = tempdir().unwrap();
    let first = ocean(false).write(&dir.path().join("first.nc"));
    let later = ocean_at(false, 0.0, 2.0).write(&dir.path().join("later.nc"));
    let moved = ocean_at(false, 30.0, 2.0).write(&dir.path().join("moved.nc"));
    let open = |second: &Path| NetCdfArchive::open(&[first.clone(), second.to_owned()], &NetCdfSettings::default());
    assert_eq!(open(&later).unwrap().times().len(), 4);
    let said = open(&moved).err().unwrap().to_string();
    assert!(said.contains("moved.nc") && said.contains("nav_lon") && said.contains("lie on one grid"), "{said}");
}

#[test]
fn velocities_along_a_turned_grid_are_turned_back() {
    let dir = tempdir().unwrap();
    let file = ocean(true).write(&dir.path().join("turned.nc"));
    let mut archive = NetCdfArchive::open(std::slice::from_ref(&file), &NetCdfSettings::default()).unwrap();
    let snapshot = archive.read(1).unwrap();
    let grid = snapshot.grid.clone();
    let nx = grid.shape()[0];
    let mut known = 0;
    for i in (0..grid.nodes()).filter(|&i| !snapshot.nodes[i][3].is_nan()) {
        let latitude = grid.axes[1].coordinates()[i / nx];
        let [east, north] = east_north(&snapshot, i);
        // Away from 40 degrees the map's stretch differs from the ground's.
        let turned = (20f64.to_radians().tan() * 40f64.to_radians().cos() / latitude.to_radians().cos()).atan();
        assert!((east.hypot(north) - 1.0).abs() < 1e-4 && (north.atan2(east) - turned).abs() < 0.06, "node {i}: {east} {north}");
        known += 1;
    }
    assert!(known > 500);
    let settings = NetCdfSettings { grid_relative: Some(false), ..NetCdfSettings::default() };
    let mut plain = NetCdfArchive::open(&[file], &settings).unwrap();
    let snapshot = plain.read(1).unwrap();
    let node = (0..grid.nodes()).find(|&i| !snapshot.nodes[i][3].is_nan()).unwrap();
    assert!(east_north(&snapshot, node)[1].abs() < 1e-6, "as set");
}
