//! Velocities to the east and north on axes that run elsewhere: rotated poles and projections.

use crate::kit::netcdf::*;
use crate::{HOURS, notes, open, open_with, refused};
use ridgewatch::source::SnapshotSource;
use std::path::{Path, PathBuf};
use tempfile::tempdir;

/// Two times of winds on x and y.
fn winds(axes: [(&str, &str, &[f64]); 2], standard: [&str; 2], at: impl Fn(f64, f64) -> [f64; 2]) -> Fixture {
    let [(x_name, x_units, x), (y_name, y_units, y)] = axes;
    let mut fixture = Fixture::on(NETCDF4, &[("time", HOURS, &[0.0, 1.0]), (y_name, y_units, y), (x_name, x_units, x)]);
    for (k, name) in ["ua", "va"].into_iter().enumerate() {
        let values = (0..2 * x.len() * y.len()).map(|i| at(x[i % x.len()], y[i / x.len() % y.len()])[k]).collect();
        fixture = fixture.variable(name, &["time", y_name, x_name], f32s(values)).with("units", "m s-1");
        fixture = fixture.with("standard_name", standard[k]).with("grid_mapping", "crs");
    }
    fixture
}

const EASTWARD: [&str; 2] = ["eastward_wind", "northward_wind"];

/// Winds of a sphere that rotates about the geographic poles, on longitudes and latitudes about a pole at 39.25 N, 162 W.
fn rotated(path: &Path, standard: [&str; 2], with_pole: bool) -> PathBuf {
    let (x, y): (Vec<f64>, Vec<f64>) = ((-20..=20).map(f64::from).collect(), (-15..=15).map(f64::from).collect());
    let tilt = 39.25f64.to_radians();
    let sin_latitude = |x: f64, y: f64| tilt.cos() * y.to_radians().cos() * x.to_radians().cos() + tilt.sin() * y.to_radians().sin();
    let mut fixture =
        winds([("rlon", "degrees", &x), ("rlat", "degrees", &y)], standard, |x, y| [10.0 * (1.0 - sin_latitude(x, y).powi(2)).sqrt(), 0.0]);
    if with_pole {
        fixture = fixture.variable("crs", &[], Data::F64(vec![0.0])).with("grid_mapping_name", "rotated_latitude_longitude");
        fixture = fixture.with("grid_north_pole_latitude", 39.25).with("grid_north_pole_longitude", -162.0);
    }
    fixture.write(path)
}

#[test]
fn winds_to_the_east_are_turned_onto_a_rotated_grid() {
    let dir = tempdir().unwrap();
    let file = rotated(&dir.path().join("rotated.nc"), EASTWARD, true);
    let mut archive = open(&[&file]);
    let said = notes(&archive);
    assert!(said.contains("standard_name `eastward_wind`) and are turned to x and y by the grid mapping, by up to"), "{said}");
    let snapshot = archive.read(0).unwrap();
    let grid = snapshot.grid.clone();
    // The geographic north pole lies on the rotated meridian 0, at 39.25 N.
    let tilt = 39.25f64.to_radians();
    let axis = [tilt.cos(), 0.0, tilt.sin()];
    let mut worst = 0.0f64;
    for (i, node) in snapshot.nodes.iter().enumerate() {
        let [x, y] = [grid.axes[0].coordinates()[i % 41], grid.axes[1].coordinates()[i / 41]].map(f64::to_radians);
        let place = [y.cos() * x.cos(), y.cos() * x.sin(), y.sin()];
        for k in 0..3 {
            let (a, b) = ((k + 1) % 3, (k + 2) % 3);
            worst = worst.max((10.0 * (axis[a] * place[b] - axis[b] * place[a]) - f64::from(node[k])).abs());
        }
    }
    assert!(worst < 1e-5, "{worst}");
    let plain = open_with(&[&file], "grid_relative = true").read(0).unwrap();
    assert!(east_north(&plain, 0)[1].abs() < 1e-6, "as set");
    // Names that say that the winds run along the grid.
    let along = rotated(&dir.path().join("along.nc"), ["grid_eastward_wind", "grid_northward_wind"], true);
    let mut archive = open(&[&along]);
    assert!(!notes(&archive).contains("turned"), "{}", notes(&archive));
    assert!(east_north(&archive.read(0).unwrap(), 0)[1].abs() < 1e-6);
    assert!(east_north(&open_with(&[&along], "grid_relative = false").read(0).unwrap(), 0)[1].abs() > 0.1);
    let lost = rotated(&dir.path().join("lost.nc"), EASTWARD, false);
    let said = notes(&open(&[&lost]));
    assert!(said.contains("WARNING") && said.contains("longitudes and latitudes of its points tell where east is"), "{said}");
    refused(&[&lost], "grid_relative = false", &["`ua`", "tell where east is, which archive.grid_relative=false needs"]);
}

#[test]
fn winds_to_the_east_are_turned_onto_a_projection() {
    let dir = tempdir().unwrap();
    let x: Vec<f64> = (0..21).map(|i| -1e6 + 1e5 * f64::from(i) + 5e4).collect();
    let y: Vec<f64> = (0..15).map(|i| -3e6 + 1e5 * f64::from(i)).collect();
    // Polar stereographic: meridian 0 runs down from the pole, which is the origin.
    let place = |x: f64, y: f64| [x.atan2(-y).to_degrees(), 90.0 - 2.0 * (x.hypot(y) / (2.0 * 6.371e6)).atan().to_degrees()];
    // Metres of the plane in a metre on the ground.
    let scale = |x: f64, y: f64| 1.0 + (x.hypot(y) / (2.0 * 6.371e6)).powi(2);
    let write = |standard: [&str; 2], with_places: bool, name: &str| {
        let mut fixture = winds([("x", "m", &x), ("y", "m", &y)], standard, |_, _| [3.0, 4.0]);
        let axis = fixture.variables.iter_mut().find(|v| v.name == "x").unwrap();
        axis.attributes.push(("standard_name".into(), "projection_x_coordinate".into()));
        for (k, (name, units)) in [("lon", "degrees_east"), ("lat", "degrees_north")].into_iter().enumerate().filter(|_| with_places) {
            let values = (0..21 * 15).map(|i| place(x[i % 21], y[i / 21])[k]).collect();
            fixture = fixture.variable(name, &["y", "x"], Data::F64(values)).with("units", units);
        }
        fixture.write(&dir.path().join(name))
    };
    let file = write(EASTWARD, true, "polar.nc");
    let mut archive = open_with(&[&file], "metric = \"cartesian\"");
    let snapshot = archive.read(1).unwrap();
    assert_eq!(snapshot.grid.shape(), [21, 15, 1]);
    for (i, node) in snapshot.nodes.iter().enumerate() {
        let (sine, cosine) = x[i % 21].atan2(-y[i / 21]).sin_cos();
        let expected = [3.0 * cosine - 4.0 * sine, 3.0 * sine + 4.0 * cosine].map(|v| v * scale(x[i % 21], y[i / 21]));
        let error = (0..2).map(|k| (f64::from(node[k]) - expected[k]).abs()).fold(0.0, f64::max);
        assert!(error < 5e-3, "node {i}: {error}");
    }
    assert!(notes(&archive).contains("by the longitudes and latitudes of the nodes"), "{}", notes(&archive));
    // Winds that run along x and y are stretched alone.
    let mut along = open_with(&[write(["x_wind", "y_wind"], true, "along.nc")], "metric = \"cartesian\"");
    for (i, node) in along.read(1).unwrap().nodes.iter().enumerate() {
        let expected = [3.0, 4.0].map(|v| v * scale(x[i % 21], y[i / 21]));
        let error = (0..2).map(|k| (f64::from(node[k]) - expected[k]).abs()).fold(0.0, f64::max);
        assert!(error < 5e-3, "node {i}: {error}");
    }
    assert!(notes(&along).contains("stretched to the metres of the projection by the longitudes and latitudes"), "{}", notes(&along));
    let lost = notes(&open_with(&[write(["x_wind", "y_wind"], false, "lost.nc")], "metric = \"cartesian\""));
    assert!(lost.contains("a metre along x and y is taken as a metre on the ground"), "{lost}");
}

/// A pole has no east: what lies beside it tells, and all other nodes are as they are.
#[test]
fn a_pole_among_the_nodes_of_a_plane_is_no_reason_to_turn_nothing() {
    let dir = tempdir().unwrap();
    let x: Vec<f64> = (-3..=3).map(|i| 1e5 * f64::from(i)).collect();
    let polar = |standard: [&str; 2], name: &str| {
        let mut fixture = winds([("x", "m", &x), ("y", "m", &x)], standard, |_, _| [3.0, 4.0]);
        fixture = fixture.variable("crs", &[], Data::F64(vec![0.0])).with("grid_mapping_name", "polar_stereographic");
        for (key, value) in [
            ("latitude_of_projection_origin", 90.0),
            ("straight_vertical_longitude_from_pole", 0.0),
            ("standard_parallel", 70.0),
            ("earth_radius", 6.371e6),
        ] {
            fixture = fixture.with(key, value);
        }
        fixture.write(&dir.path().join(name))
    };
    // At the pole, a plane that is true at 70 N is smaller by (1 + sin 70) / 2.
    let scale = |x: f64, y: f64| {
        let smaller = (1.0 + 70f64.to_radians().sin()) / 2.0;
        smaller * (1.0 + (x.hypot(y) / (2.0 * 6.371e6 * smaller)).powi(2))
    };
    let east = open(&[polar(EASTWARD, "east.nc")]).read(0).unwrap();
    let along = open(&[polar(["x_wind", "y_wind"], "along.nc")]).read(0).unwrap();
    for i in 0..49 {
        let (px, py) = (x[i % 7], x[i / 7]);
        let (k, (sine, cosine)) = (scale(px, py), px.atan2(-py).sin_cos());
        let near =
            |found: [f32; 4], expected: [f64; 2], tolerance: f64| (0..2).all(|c| (f64::from(found[c]) - expected[c]).abs() < tolerance);
        assert!(near(along.nodes[i], [3.0 * k, 4.0 * k], 1e-5), "{px} {py}: {:?} {k}", along.nodes[i]);
        let turned = [k * (3.0 * cosine - 4.0 * sine), k * (3.0 * sine + 4.0 * cosine)];
        let speed = f64::from(east.nodes[i][0].hypot(east.nodes[i][1]));
        assert!(
            if px == 0.0 && py == 0.0 { (speed - 5.0 * k).abs() < 1e-5 } else { near(east.nodes[i], turned, 1e-5) },
            "{px} {py}: {:?}",
            east.nodes[i]
        );
    }
}

/// Rows that are added at the rotated poles are no rows of the file.
#[test]
fn winds_are_turned_on_a_rotated_grid_around_the_globe() {
    let dir = tempdir().unwrap();
    let (x, y): (Vec<f64>, Vec<f64>) =
        ((0..36).map(|i| 10.0 * f64::from(i)).collect(), (0..18).map(|i| -85.0 + 10.0 * f64::from(i)).collect());
    let tilt = 39.25f64.to_radians();
    let mut fixture = winds([("rlon", "degrees", &x), ("rlat", "degrees", &y)], EASTWARD, |x, y| {
        let (x, y) = (x.to_radians(), y.to_radians());
        [10.0 * (1.0 - (tilt.cos() * y.cos() * x.cos() + tilt.sin() * y.sin()).powi(2)).sqrt(), 0.0]
    });
    fixture = fixture.variable("crs", &[], Data::F64(vec![0.0])).with("grid_mapping_name", "rotated_latitude_longitude");
    fixture = fixture.with("grid_north_pole_latitude", 39.25).with("grid_north_pole_longitude", -162.0);
    let snapshot = open(&[fixture.write(&dir.path().join("globe.nc"))]).read(0).unwrap();
    let grid = snapshot.grid.clone();
    assert_eq!(grid.shape(), [36, 20, 1]);
    for (i, node) in snapshot.nodes.iter().enumerate().filter(|(i, _)| (1..19).contains(&(i / 36))) {
        let [x, y] = [grid.axes[0].coordinates()[i % 36], grid.axes[1].coordinates()[i / 36]].map(f64::to_radians);
        let (place, axis) = ([y.cos() * x.cos(), y.cos() * x.sin(), y.sin()], [tilt.cos(), 0.0, tilt.sin()]);
        for k in 0..3 {
            let (a, b) = ((k + 1) % 3, (k + 2) % 3);
            let expected = 10.0 * (axis[a] * place[b] - axis[b] * place[a]);
            assert!((expected - f64::from(node[k])).abs() < 1e-4, "node {i}: {node:?} {expected}");
        }
    }
}
