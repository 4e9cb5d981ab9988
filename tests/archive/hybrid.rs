//! Levels that follow the ground, of CMIP, CAM and models with plain sigma levels: the wind is proportional to the height of the isothermal
//! atmosphere, so that a value tells the height from which it was read, and the change of pressure is that of a steady ascent.

use crate::kit::netcdf::*;
use crate::{HOURS, notes, open, open_with, refused};
use ridgewatch::source::{Archive, SnapshotSource};
use std::path::{Path, PathBuf};
use tempfile::tempdir;

const LON: [f64; 6] = [10.0, 11.0, 12.0, 13.0, 14.0, 15.0];
const LAT: [f64; 4] = [43.0, 42.0, 41.0, 40.0];
/// From the top downwards, as models count them.
const A: [f64; 5] = [0.05, 0.2, 0.18, 0.05, 0.0];
const B: [f64; 5] = [0.0, 0.1, 0.45, 0.85, 0.99];
/// m/s
const ASCENT: f64 = 0.03;

/// How the file says where its levels lie.
#[derive(Clone, Copy, PartialEq, Debug)]
enum Says {
    /// a, b and p0, in hPa.
    Shares,
    /// a in Pa.
    Pressures,
    /// Sigma below a pressure at the top.
    Sigma,
}

/// Pressure at the ground: a mountain in the east, and a change with time.
fn ground(time: usize, lon: f64) -> f64 {
    101_000.0 - 4000.0 * (lon - 10.0) - 150.0 * time as f64
}

fn pressure(says: Says, level: usize, ground: f64) -> f64 {
    match says {
        Says::Shares | Says::Pressures => A[level] * 1e5 + B[level] * ground,
        Says::Sigma => 2000.0 + B[level] * (ground - 2000.0),
    }
}

fn height(pressure: f64) -> f64 {
    -7000.0 * (pressure / 1e5).ln()
}

fn write(path: &Path, says: Says, vertical: &str) -> PathBuf {
    fixture(says, vertical, &|p| p, "Pa").write(path)
}

/// A file whose pressure at the ground is written by `form` in `units`.
fn fixture(says: Says, vertical: &str, form: &dyn Fn(f64) -> f64, units: &str) -> Fixture {
    let (levels, ny, nx) = (A.len(), LAT.len(), LON.len());
    let dims = ["time", "lev", "lat", "lon"];
    let (name, terms) = match says {
        Says::Shares => ("atmosphere_hybrid_sigma_pressure_coordinate", "p0: p0 a: a b: b ps: PS"),
        Says::Pressures => ("atmosphere_hybrid_sigma_pressure_coordinate", "ap: ap b: b ps: PS"),
        Says::Sigma => ("atmosphere_sigma_coordinate", "sigma: lev ps: PS ptop: top"),
    };
    let mut file = Fixture::new(NETCDF4, &[("time", 2), ("lev", levels), ("lat", ny), ("lon", nx)])
        .axis("time", HOURS, &[0.0, 3.0])
        .axis("lat", "degrees_north", &LAT)
        .axis("lon", "degrees_east", &LON)
        .axis("lev", "1", &B)
        .with("standard_name", name)
        .with("positive", "down")
        .with("formula_terms", terms);
    file = match says {
        Says::Shares => file
            .variable("a", &["lev"], Data::F64(A.to_vec()))
            .variable("b", &["lev"], Data::F64(B.to_vec()))
            .variable("p0", &[], Data::F64(vec![1000.0]))
            .with("units", "hPa"),
        Says::Pressures => {
            let fixed = A.iter().map(|a| a * 1e5).collect();
            file.variable("ap", &["lev"], Data::F64(fixed)).with("units", "Pa").variable("b", &["lev"], Data::F64(B.to_vec()))
        }
        Says::Sigma => file.variable("top", &[], Data::F64(vec![20.0])).with("units", "hPa"),
    };
    let plane = (0..2 * ny * nx).map(|n| form(ground(n / (ny * nx), LON[n % nx]))).collect();
    file = file.variable("PS", &["time", "lat", "lon"], Data::F64(plane)).with("units", units);
    let at = |n: usize| pressure(says, n / (ny * nx) % levels, ground(n / (levels * ny * nx), LON[n % nx]));
    let all = |of: &dyn Fn(f64) -> f64| f32s((0..2 * levels * ny * nx).map(|n| of(at(n))).collect());
    file = file.variable("U", &dims, all(&|p| height(p) / 1000.0)).with("units", "m/s");
    file = file.variable("V", &dims, all(&|_| 2.0)).with("units", "m/s");
    let rising: &dyn Fn(f64) -> f64 = if vertical == "Pa/s" { &|p| -ASCENT * p / 7000.0 } else { &|_| ASCENT };
    file.variable("OMEGA", &dims, all(rising)).with("units", vertical)
}

/// Checks all known nodes at a time; their share, and that of nodes above the ground.
fn shares(archive: &mut Archive, time: usize) -> [f64; 2] {
    let snapshot = archive.read(time).unwrap();
    let axes = &snapshot.grid.axes;
    let (nx, ny) = (axes[0].len(), axes[1].len());
    let (mut known, mut above) = (0, 0);
    for (n, node) in snapshot.nodes.iter().enumerate() {
        let (lon, z) = (axes[0].coordinates()[n % nx], axes.get(2).map_or(3000.0, |axis| axis.coordinates()[n / (nx * ny)]));
        let surface = height(ground(time, lon));
        above += usize::from(z > surface);
        if node[3].is_nan() {
            continue;
        }
        known += 1;
        let speed = (0..3).map(|k| f64::from(node[k]).powi(2)).sum::<f64>().sqrt();
        // Near the ground and the top the wind is that of the nearest level.
        let found = (speed * speed - 4.0).max(0.0).sqrt() * 1000.0;
        let lowest = height(pressure(Says::Shares, A.len() - 1, ground(time, lon))).min(height(pressure(
            Says::Sigma,
            A.len() - 1,
            ground(time, lon),
        )));
        assert!((found - z).abs() < 2.0 || z < lowest + 250.0 || z > 15_000.0, "{z} m: {found}");
        assert!(axes.len() < 3 || (f64::from(node[3]) - ASCENT).abs() < 1e-4, "{z} m: {}", node[3]);
        assert!(z > surface - 1.0, "{z} m is below the ground at {surface}");
    }
    [known, above].map(|count| f64::from(count as u32) / snapshot.nodes.len() as f64)
}

#[test]
fn winds_come_from_their_true_height() {
    let dir = tempdir().unwrap();
    for (says, vertical) in [(Says::Shares, "Pa/s"), (Says::Pressures, "m/s"), (Says::Sigma, "Pa/s")] {
        let file = write(&dir.path().join(format!("{says:?}.nc")), says, vertical);
        let mut archive = open(&[&file]);
        let z = archive.grid().axes[2].coordinates().to_vec();
        assert!(z.len() == 5 && z.windows(2).all(|w| w[0] < w[1]) && z[0] > 0.0 && z[4] > 15_000.0, "{says:?}: {z:?}");
        for time in 0..2 {
            let [known, above] = shares(&mut archive, time);
            println!("{says:?}: {known:.3} known, {above:.3} above the ground");
            assert!((known - above).abs() < 1e-9 && above < 1.0, "{says:?}: {known} {above}");
        }
        let all = notes(&archive);
        assert!(all.contains("`lev` follows the ground") && all.contains("pressure at the ground `PS`"), "{all}");
        // One height, and others.
        let mut one = open_with(&[&file], "level = 3000");
        assert_eq!(one.grid().axes.len(), 2);
        shares(&mut one, 1);
        let mut few = open_with(&[&file], "heights = [1500, 3000, 5000]");
        assert_eq!(few.grid().axes[2].coordinates(), [1500.0, 3000.0, 5000.0]);
        shares(&mut few, 0);
        refused(&[&file], "level = 90000", &["level", "heights in metres: from", "at the lowest ground"]);
    }
}

/// The level of the file, the levels as cells, and what is no pressure at the ground.
#[test]
fn what_is_no_height_is_refused_or_read_as_before() {
    let dir = tempdir().unwrap();
    let file = write(&dir.path().join("whole.nc"), Says::Shares, "Pa/s");
    refused(&[&file], "level = 0.85", &["level", "follows the ground", "archive.select.lev=3", "metric=index"]);
    let picked = open_with(&[&file], "select = { lev = 3 }");
    assert_eq!(picked.grid().axes.len(), 2);
    let cells = open_with(&[&file], "metric = \"index\"\nw = \"none\"");
    assert!(!notes(&cells).contains("follows the ground") && cells.grid().axes[2].len() == A.len(), "{}", notes(&cells));
    let logarithm = fixture(Says::Shares, "Pa/s", &|p| p.ln(), "1");
    refused(&[logarithm.write(&dir.path().join("lnsp.nc"))], "", &["PS", "its mean is", "200 to 1500 hPa"]);
    let hectopascals = fixture(Says::Pressures, "m/s", &|p| p / 100.0, "hPa");
    let mut archive = open(&[hectopascals.write(&dir.path().join("hpa.nc"))]);
    let [known, above] = shares(&mut archive, 1);
    assert!((known - above).abs() < 1e-9, "{known} {above}");
    // Part of it, and vertical metres that count more.
    let mut part = open_with(&[&file], "region = [11, 14, 41, 43]\nvertical_scale = 10.0");
    assert_eq!([part.grid().axes[0].first(), part.grid().axes[0].last(), part.grid().axes[1].first()], [11.0, 14.0, 41.0]);
    let snapshot = part.read(0).unwrap();
    let rising = snapshot.nodes.iter().filter(|node| !node[3].is_nan()).map(|node| f64::from(node[3]));
    assert!(rising.map(|w| (w / (10.0 * ASCENT) - 1.0).abs()).fold(0.0, f64::max) < 1e-2);
}

/// Half levels end where there is no air.
#[test]
fn vertical_motion_on_half_levels() {
    let dir = tempdir().unwrap();
    let mut file = fixture(Says::Pressures, "Pa/s", &|p| p, "Pa").dimension("ilev", A.len() + 1);
    file.variables.retain(|variable| variable.name != "OMEGA");
    let half = |k: usize, of: &[f64; 5], ends: [f64; 2]| match k {
        0 => ends[0],
        5 => ends[1],
        k => 0.5 * (of[k - 1] + of[k]),
    };
    let (a, b): (Vec<f64>, Vec<f64>) = (0..6).map(|k| (1e5 * half(k, &A, [0.0, 0.0]), half(k, &B, [0.0, 1.0]))).unzip();
    let (ny, nx) = (LAT.len(), LON.len());
    let values = (0..2 * 6 * ny * nx)
        .map(|n| {
            let (k, pressure) = (n / (ny * nx) % 6, ground(n / (6 * ny * nx), LON[n % nx]));
            -ASCENT * (a[k] + b[k] * pressure) / 7000.0
        })
        .collect();
    let file = file
        .axis("ilev", "1", &b)
        .with("standard_name", "atmosphere_hybrid_sigma_pressure_coordinate")
        .with("formula_terms", "ap: api b: bi ps: PS")
        .variable("api", &["ilev"], Data::F64(a))
        .with("units", "Pa")
        .variable("bi", &["ilev"], Data::F64(b))
        .variable("OMEGA", &["time", "ilev", "lat", "lon"], f32s(values))
        .with("units", "Pa/s");
    let mut archive = open(&[file.write(&dir.path().join("half.nc"))]);
    let snapshot = archive.read(0).unwrap();
    let known: Vec<f64> = snapshot.nodes.iter().filter(|node| !node[3].is_nan()).map(|node| f64::from(node[3])).collect();
    assert!(known.len() * 5 > snapshot.nodes.len() * 4, "{} of {}", known.len(), snapshot.nodes.len());
    // In the highest layer the ascent falls to that of no air.
    let exact = known.iter().filter(|w| (**w - ASCENT).abs() < 1e-6).count();
    assert!(
        exact * 4 > known.len() * 3 && known.iter().all(|w| (0.9..1.001).contains(&(w / ASCENT))),
        "{exact} of {}: {known:?}",
        known.len()
    );
}

/// CAM's names, in files that lost their `formula_terms`.
#[test]
fn hybrid_levels_are_known_by_the_names_of_cam() {
    let dir = tempdir().unwrap();
    let mut file = fixture(Says::Shares, "Pa/s", &|p| p, "Pa");
    for variable in &mut file.variables {
        variable.attributes.retain(|(name, _)| !["formula_terms", "standard_name"].contains(&name.as_str()));
        match variable.name.as_str() {
            "a" => variable.name = "hyam".into(),
            "b" => variable.name = "hybm".into(),
            "p0" => variable.name = "P0".into(),
            _ => {}
        }
    }
    let mut archive = open_with(&[file.write(&dir.path().join("cam.nc"))], "heights = [1500.0, 3000.0, 5000.0, 9000.0]");
    let [known, above] = shares(&mut archive, 0);
    assert!(known > 0.9 * above && notes(&archive).contains("pressure at the ground `PS`"), "{known} {above}: {}", notes(&archive));
}

#[test]
fn levels_without_the_pressure_at_the_ground_say_what_is_missing() {
    let dir = tempdir().unwrap();
    let file = write(&dir.path().join("whole.nc"), Says::Shares, "Pa/s");
    let whole = open(&[&file]);
    assert!(!notes(&whole).contains("not in the files"));
    let bare = Fixture::new(NETCDF4, &[("time", 2), ("lev", 3), ("lat", 2), ("lon", 2)])
        .axis("time", HOURS, &[0.0, 3.0])
        .axis("lat", "degrees_north", &[1.0, 2.0])
        .axis("lon", "degrees_east", &[1.0, 2.0])
        .axis("lev", "1", &[0.2, 0.5, 0.9])
        .with("standard_name", "atmosphere_hybrid_sigma_pressure_coordinate")
        .with("formula_terms", "p0: p0 a: a b: b ps: PS")
        .variable("U", &["time", "lev", "lat", "lon"], f32s(vec![1.0; 24]))
        .with("units", "m/s")
        .variable("V", &["time", "lev", "lat", "lon"], f32s(vec![1.0; 24]))
        .with("units", "m/s")
        .write(&dir.path().join("bare.nc"));
    let archive = open(&[&bare]);
    assert!(notes(&archive).contains("the pressure there, `PS`, is not in the file"), "{}", notes(&archive));
}
