//! Grids that are resampled: WRF's staggered, terrain-following one, and longitudes and latitudes of two dimensions.

use crate::kit::grids::{Ocean, Wrf, eastward, ground, wind};
use crate::kit::netcdf::*;
use crate::{inspected, notes, open, open_with, refused};
use ridgewatch::field::{Geometry, Snapshot};
use ridgewatch::source::{Metric, SnapshotSource};
use tempfile::tempdir;

/// Largest error of a snapshot's known nodes against `wind`, and their number.
fn error(snapshot: &Snapshot, time: f64) -> (f64, usize) {
    let grid = &snapshot.grid;
    let [nx, ny, _] = grid.shape();
    let (mut worst, mut known) = (0.0f64, 0);
    for (i, node) in snapshot.nodes.iter().enumerate().filter(|(_, n)| !n[3].is_nan()) {
        let at = [i % nx, i / nx % ny, i / (nx * ny)].iter().enumerate().map(|(k, &n)| grid.axes[k].coordinates()[n]).collect::<Vec<_>>();
        // Winds are constant below the lowest half level and above the highest.
        if !(250.0..=1750.0).contains(&(at[2] - ground(at[0]))) {
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
    let file = Wrf::default().fixture().write(&dir.path().join("wrfout_d01"));
    let mut archive = open(&[&file]);
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
    let inspection = inspected(&[&file]);
    let resampling = inspection.resampling.as_ref().unwrap();
    // Linear fields are exact except in the lowest half cells, where winds are constant: 0.004 / s over up to 250 m, in few points.
    assert!(resampling.error > 0.0 && resampling.error < 1e-2 * resampling.velocity, "{resampling:?}");
    assert!(inspection.to_string().contains("resampling\n  error"));
    // The same times in minutes, and in a file without characters.
    let minutes = Wrf { characters: false, ..Wrf::default() }.fixture().write(&dir.path().join("minutes.nc"));
    let other = open(&[minutes]);
    assert_eq!(other.times(), archive.times());
    assert_eq!(open_with(&[&file], "time = \"XTIME\"").times(), archive.times());
    // Centres only, at given heights.
    let mut coarse = open_with(&[&file], "staggering = \"centres\"\nheights = [600.0, 900.0, 1200.0]");
    assert_eq!(coarse.grid().shape(), [6, 5, 3]);
    let (worst, known) = error(&coarse.read(1).unwrap(), 1.0);
    assert!(worst < 5e-5 && known == 90, "{worst} {known}");
    for (toml, piece) in [("metric = \"sphere\"", "cartesian"), ("level = 3.0", "heights"), ("heights = [2.0, 1.0]", "strictly ascending")]
    {
        refused(&[&file], toml, &[piece]);
    }
}

#[test]
fn files_of_one_wrf_domain_are_one_archive() {
    let dir = tempdir().unwrap();
    let first = Wrf::default().fixture().write(&dir.path().join("wrfout_d01_12"));
    let second = Wrf { hour: 18, ..Wrf::default() }.fixture().write(&dir.path().join("wrfout_d01_18"));
    let mut archive = open(&[second, first]);
    assert_eq!(archive.times().len(), 4);
    assert_eq!(archive.date(archive.times()[3]).as_deref(), Some("2005-08-28T21:00:00Z"));
    for time in 0..4 {
        let (worst, known) = error(&archive.read(time).unwrap(), time as f64);
        assert!(worst < 5e-5 && known > 300, "{worst} {known}");
    }
}

/// A nest that follows a storm is read at its place of each time.
#[test]
fn a_wrf_nest_that_moves_is_read_in_its_places() {
    let dir = tempdir().unwrap();
    let at = |name: &str, wrf: Wrf| wrf.fixture().write(&dir.path().join(name));
    let first = at("first.nc", Wrf { east: [0.0, 2.0], ..Wrf::default() });
    let later = at("later.nc", Wrf { hour: 18, east: [3.0, -1.0], ..Wrf::default() });
    let mut archive = open(&[&first, &later]);
    let grid = archive.grid().clone();
    // From a cell west to three cells east of the six of the first time.
    assert_eq!((grid.shape()[0], grid.axes[0].first(), grid.axes[0].last()), (19, -500.0, 8500.0));
    for (time, east) in [0.0, 2.0, 3.0, -1.0].into_iter().enumerate() {
        let snapshot = archive.read(time).unwrap();
        let (worst, known) = error(&snapshot, time as f64);
        assert!(worst < 5e-5 && known > 300, "{worst} {known}");
        // On a level that all columns reach, exactly the nodes of the nest are known.
        let [nx, ny, nz] = grid.shape();
        for node in (nz - 2) * nx * ny..(nz - 1) * nx * ny {
            let x = grid.axes[0].coordinates()[node % nx];
            let inside = x >= (0.5 + east) * 1000.0 && x <= (5.5 + east) * 1000.0;
            assert_eq!(!snapshot.nodes[node][3].is_nan(), inside, "time {time}, x = {x}");
        }
    }
    let notes = notes(&archive);
    assert!(notes.contains("the grid moves, by up to 4 and 0 cells") && notes.matches("the grid moves").count() == 1, "{notes}");
    // A thousandth of a cell is rounding.
    let still = at("still.nc", Wrf { hour: 18, east: [1e-3; 2], ..Wrf::default() });
    let whole = at("whole.nc", Wrf::default());
    assert_eq!(open(&[&whole, &still]).grid().shape()[0], 11);
    for (name, east, piece) in [("half.nc", 2.5, "time 1 of this file"), ("far.nc", 20.0, "overlap the first one")] {
        let odd = at(name, Wrf { hour: 18, east: [0.0, east], ..Wrf::default() });
        let pieces = [name, piece, "`XLONG`", "the grid has moved", "-87.000 E, 0.000 N", "moves by whole cells"];
        refused(&[&whole, &odd], "", &pieces);
    }
}

#[test]
fn curvilinear_grids_are_resampled_and_say_how_well() {
    let dir = tempdir().unwrap();
    let file = Ocean::default().fixture().write(&dir.path().join("ocean.nc"));
    let mut archive = open(&[&file]);
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
    assert!(snapshot.missing_nodes() > 0, "corners outside of the turned square, and the island");
    let notes = notes(&archive);
    assert!(notes.contains("resampled bilinearly from 49 x 49 points") && notes.contains("resampling error"), "{notes}");
    let inspection = inspected(&[&file]);
    let resampling = inspection.resampling.unwrap();
    assert!(resampling.error > 0.0 && resampling.error < 1e-3 * resampling.velocity, "{resampling:?}");
    let coarse = open_with(&[file], "resolution = [1.0, 1.0]");
    assert!(coarse.grid().nodes() < grid.nodes() / 4);
}

#[test]
fn a_later_file_on_other_points_is_refused() {
    let dir = tempdir().unwrap();
    let first = Ocean::default().fixture().write(&dir.path().join("first.nc"));
    let later = Ocean { hour: 2.0, ..Ocean::default() }.fixture().write(&dir.path().join("later.nc"));
    let moved = Ocean { east: 30.0, hour: 2.0, ..Ocean::default() }.fixture().write(&dir.path().join("moved.nc"));
    assert_eq!(open(&[&first, &later]).times().len(), 4);
    refused(&[first, moved], "", &["moved.nc", "nav_lon", "lie on one grid"]);
}

#[test]
fn velocities_along_a_turned_grid_are_turned_back() {
    let dir = tempdir().unwrap();
    let file = Ocean { along_grid: true, ..Ocean::default() }.fixture().write(&dir.path().join("turned.nc"));
    let mut archive = open(&[&file]);
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
    let snapshot = open_with(&[file], "grid_relative = false").read(1).unwrap();
    let node = (0..grid.nodes()).find(|&i| !snapshot.nodes[i][3].is_nan()).unwrap();
    assert!(east_north(&snapshot, node)[1].abs() < 1e-6, "as set");
}
