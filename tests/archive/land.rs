//! Land in files whose velocity is 0 there: masks by convention, by name, in other files, and none.

use crate::kit::netcdf::*;
use crate::{HOURS, notes, open, open_with, refused};
use ridgewatch::source::SnapshotSource;
use std::path::Path;
use tempfile::tempdir;

const NX: usize = 8;
const NY: usize = 6;
/// Columns from here on are land.
const COAST: usize = 5;

/// 1 on land.
fn land() -> Vec<f64> {
    fill(1, NY, NX, |_, _, x| f64::from(u8::from(x >= COAST)))
}

/// Currents of this name that are 0 on land, at two times.
fn currents(names: [&str; 2], long_name: &str) -> Fixture {
    let x: Vec<f64> = (0..NX).map(|x| x as f64 * 0.1).collect();
    let y: Vec<f64> = (0..NY).map(|y| 40.0 + y as f64 * 0.1).collect();
    let fixture = Fixture::on(NETCDF4, &[("time", HOURS, &[0.0, 1.0]), ("lat", "degrees_north", &y), ("lon", "degrees_east", &x)]);
    names.into_iter().fold(fixture, |fixture, name| {
        let values = fill(2, NY, NX, |t, y, x| if x >= COAST { 0.0 } else { 0.1 + 0.01 * (t + y + x) as f64 });
        fixture.fields("m s-1", [(name, f32s(values))]).with("long_name", long_name)
    })
}

/// Indices along x of the columns that are missing in the second snapshot, all of their nodes.
#[track_caller]
fn missing_columns(files: &[impl AsRef<Path>], toml: &str) -> Vec<usize> {
    let snapshot = open_with(files, toml).read(1).unwrap();
    let missing = |x: usize| (0..NY).map(|y| snapshot.nodes[y * NX + x][3].is_nan()).collect::<Vec<_>>();
    let columns: Vec<usize> = (0..NX).filter(|&x| missing(x).contains(&true)).collect();
    assert!(columns.iter().all(|&x| !missing(x).contains(&false)), "a part of a column");
    columns
}

const DRY: [usize; 3] = [5, 6, 7];

#[test]
fn masks_by_convention_are_land() {
    let dir = tempdir().unwrap();
    let water = || f32s(land().into_iter().map(|v| 1.0 - v).collect());
    let bits = |flip: i16| Data::I16(land().into_iter().map(|v| v as i16 ^ flip).collect());
    let with = |name: &str, data: Data| currents(["uo", "vo"], "sea water velocity").variable(name, &["lat", "lon"], data);
    let files = [
        with("mask_rho", water()),
        with("tmask", water()),
        with("lsm", bits(0)).with("standard_name", "land_binary_mask"),
        with("wet_area", bits(1)).with("standard_name", "sea_binary_mask"),
        with("surface", bits(0)).with("flag_meanings", "water land").with("flag_values", vec![0i16, 1]),
    ];
    for (n, fixture) in files.into_iter().enumerate() {
        let file = fixture.write(&dir.path().join(format!("{n}.nc")));
        assert_eq!(missing_columns(&[&file], ""), DRY, "file {n}");
        let said = notes(&open(&[&file]));
        assert!(said.contains("37.5 % of `uo` by") && !said.contains("no velocities"), "file {n}: {said}");
        assert!(missing_columns(&[&file], "mask = \"none\"").is_empty(), "file {n}");
    }
    // The wind blows over land, and quality flags are no mask.
    let wind = currents(["u10", "v10"], "wind at 10 m").variable("lsm", &["lat", "lon"], bits(0)).with("standard_name", "land_binary_mask");
    let flags = with("quality", bits(0)).with("flag_meanings", "good bad").with("flag_values", vec![0i16, 1]);
    for (n, fixture) in [wind, flags].into_iter().enumerate() {
        assert!(missing_columns(&[fixture.write(&dir.path().join(format!("none_{n}.nc")))], "").is_empty(), "{n}");
    }
}

/// POP counts the levels of water in each column: at the velocities' own points, or at tracers, of which four lie around a velocity.
#[test]
fn numbers_of_levels_that_are_water() {
    let dir = tempdir().unwrap();
    let (levels, depths) = (4, [5.0, 15.0, 25.0, 35.0]);
    // Columns grow shallower to the east: 4, 4, 3, 3, 2, 2, 1, 0 levels.
    let counts = [4.0, 4.0, 3.0, 3.0, 2.0, 2.0, 1.0, 0.0];
    let write = |name: &str| {
        let x: Vec<f64> = (0..NX).map(|x| x as f64 * 0.1).collect();
        let y: Vec<f64> = (0..NY).map(|y| 40.0 + y as f64 * 0.1).collect();
        let axes: [(&str, &str, &[f64]); 4] =
            [("time", HOURS, &[0.0, 1.0]), ("z_t", "m", &depths), ("lat", "degrees_north", &y), ("lon", "degrees_east", &x)];
        let mut fixture = Fixture::on(NETCDF4, &axes);
        fixture.variables.iter_mut().filter(|v| v.name == "z_t").for_each(|v| v.attributes.push(("positive".into(), "down".into())));
        for component in ["UVEL", "VVEL"] {
            fixture = fixture.fields("m s-1", [(component, f32s(fill(2 * levels, NY, NX, |n, _, x| 0.1 + 0.01 * (n + x) as f64)))]);
        }
        fixture.variable(name, &["lat", "lon"], f32s(fill(1, NY, NX, |_, _, x| counts[x]))).write(&dir.path().join(format!("{name}.nc")))
    };
    let own = write("KMU");
    let mut archive = open(&[&own]);
    let snapshot = archive.read(0).unwrap();
    let z = snapshot.grid.axes[2].coordinates();
    for (i, node) in snapshot.nodes.iter().enumerate() {
        let (x, height) = (i % NX, z[i / (NX * NY)]);
        assert_eq!(node[3].is_nan(), -height > depths[0] + 10.0 * (counts[x] - 1.0), "column {x}, {height} m");
    }
    assert!(notes(&archive).contains("the number of levels that are water"), "{}", notes(&archive));
    assert_eq!(missing_columns(&[&own], "level = 25.0"), [4, 5, 6, 7]);
    assert_eq!(missing_columns(&[&own], "level = 25.0\nmask = \"KMU\""), [4, 5, 6, 7]);
    assert_eq!(missing_columns(&[&write("KMT")], "level = 25.0"), [3, 4, 5, 6, 7]);
}

#[test]
fn a_mask_is_named() {
    let dir = tempdir().unwrap();
    let named = |values: Vec<f64>| currents(["uo", "vo"], "").variable("shore", &["lat", "lon"], f32s(values));
    let dry = named(land()).write(&dir.path().join("dry.nc"));
    let wet = named(land().into_iter().map(|v| 1.0 - v).collect()).write(&dir.path().join("wet.nc"));
    assert!(missing_columns(&[&dry], "").is_empty(), "its name says nothing");
    assert_eq!(missing_columns(&[&dry], "mask = \"!shore\""), DRY);
    assert_eq!(missing_columns(&[&wet], "mask = \"shore\""), DRY);
    refused(&[&wet], "mask = \"coast\"", &["`mask` = \"coast\"", "no file holds", "\"zero\"", "\"none\""]);
    let odd = currents(["uo", "vo"], "").dimension("other", NX - 3).variable("umask", &["lat", "other"], f32s(vec![1.0; NY * (NX - 3)]));
    let said = notes(&open(&[odd.write(&dir.path().join("odd.nc"))]));
    assert!(said.contains("WARNING: the mask `umask` ([6, 5]) does not fit the points of `uo` ([2, 6, 8])"), "{said}");
    refused(&[&wet], "mask = \"lat\"", &["`mask` = \"lat\"", "shape is [6]", "[2, 6, 8]"]);
}

#[test]
fn a_mask_lies_in_a_file_of_its_own() {
    let dir = tempdir().unwrap();
    let file = currents(["uo", "vo"], "").write(&dir.path().join("data.nc"));
    // Other names of the dimensions, time and levels of one entry: by length.
    let water = Data::I16(land().into_iter().map(|v| 1 - v as i16).collect());
    let mask = |name: &str| {
        Fixture::new(NETCDF4, &[("t", 1), ("z", 1), ("y", NY), ("x", NX)])
            .variable(name, &["t", "z", "y", "x"], water.clone())
            .write(&dir.path().join(format!("a_{name}.nc")))
    };
    let (usual, own) = (mask("tmask"), mask("shore"));
    for files in [[&usual, &file], [&file, &usual]] {
        assert_eq!(missing_columns(&files, ""), DRY);
        assert!(missing_columns(&files, "mask = \"none\"").is_empty());
        let archive = open(&files);
        assert_eq!(archive.files().len(), 1);
        let said = notes(&archive);
        assert!(said.contains("no velocities, but a mask of land: ") && said.contains("a_tmask.nc"), "{said}");
    }
    assert_eq!(missing_columns(&[&own, &file], "mask = \"shore\""), DRY);
    refused(&[&own, &file], "", &["a_shore.nc", "no velocity"]);
    refused(&[&usual], "", &["a_tmask.nc", "no velocity", "beside it"]);
}

#[test]
fn zeros_at_all_times_are_told_and_can_be_land() {
    let dir = tempdir().unwrap();
    let file = currents(["uo", "vo"], "").write(&dir.path().join("zeros.nc"));
    let archive = open(&[&file]);
    // 2 of 7 columns of cells have land on both sides.
    for piece in ["exactly 0", "28.6 % of the cells", "archive.mask=zero", "archive.mask=NAME"] {
        assert!(notes(&archive).contains(piece), "{piece}: {}", notes(&archive));
    }
    assert_eq!(missing_columns(&[&file], "mask = \"zero\""), DRY);
    assert!(notes(&open_with(&[&file], "mask = \"zero\"")).contains("37.5 % of the points"));
    assert!(!notes(&open_with(&[&file], "mask = \"none\"")).contains("exactly 0"));
    // Water that rests at the first time only.
    let still = |t: usize| if t == 0 { 0.0 } else { 0.1 };
    let axes: [(&str, &str, &[f64]); 3] = [("time", HOURS, &[0.0, 1.0]), ("y", "m", &[0.0, 1.0, 2.0]), ("x", "m", &[0.0, 1.0, 2.0])];
    let fixture = Fixture::on(CLASSIC, &axes).winds(f32s(fill(2, 3, 3, |t, _, _| still(t))), f32s(fill(2, 3, 3, |t, _, _| still(t))));
    let begins = fixture.write(&dir.path().join("begins.nc"));
    assert!(!notes(&open(&[&begins])).contains("exactly 0"));
    assert_eq!(open_with(&[&begins], "mask = \"zero\"").read(0).unwrap().missing_nodes(), 0);
}

/// A C-grid as ROMS writes it: tracer points, and faces between them with longitudes and latitudes of their own.
fn roms(masks: &[&str]) -> Fixture {
    let points = [("rho", NY, NX), ("u", NY, NX - 1), ("v", NY - 1, NX)];
    let mut fixture = Fixture::new(NETCDF4, &[("ocean_time", 2)]).axis("ocean_time", HOURS, &[0.0, 1.0]);
    for (name, ny, nx) in points {
        let shift = [f64::from(u8::from(nx < NX)) / 2.0, f64::from(u8::from(ny < NY)) / 2.0];
        let (eta, xi) = (format!("eta_{name}"), format!("xi_{name}"));
        fixture = fixture.dimension(&eta, ny).dimension(&xi, nx);
        // Bent, so that rows are no coordinates.
        let bent = |y: usize, x: usize| 0.01 * (x as f64 + shift[0]) + 0.001 * (y as f64 + shift[1]);
        let lon = fill(1, ny, nx, |_, y, x| 0.1 * (x as f64 + shift[0]) + bent(y, x));
        let lat = fill(1, ny, nx, |_, y, x| 0.1 * (y as f64 + shift[1]) + bent(y, x));
        for (kind, units, values) in [("lon", "degrees_east", lon), ("lat", "degrees_north", lat)] {
            fixture = fixture.variable(&format!("{kind}_{name}"), &[&eta, &xi], Data::F64(values)).with("units", units);
        }
        let is_land = |x: usize| x >= COAST;
        let beside = |x: usize| is_land(x) || (name == "u" && is_land(x + 1));
        if masks.contains(&name) {
            let water = f32s(fill(1, ny, nx, |_, _, x| if beside(x) { 0.0 } else { 1.0 }));
            fixture = fixture.variable(&format!("mask_{name}"), &[&eta, &xi], water);
        }
        if name != "rho" {
            let values = f32s(fill(2, ny, nx, |_, _, x| if beside(x) { 0.0 } else { 0.5 }));
            fixture = fixture.variable(name, &["ocean_time", &eta, &xi], values).with("units", "meter second-1");
        }
    }
    fixture
}

#[test]
fn masks_at_faces() {
    let dir = tempdir().unwrap();
    let share = |masks: &[&str], toml: &str| {
        let file = roms(masks).write(&dir.path().join("roms.nc"));
        // By itself, the grid would be finer where the flow ends at a coast.
        let snapshot = open_with(&[file], &format!("resolution = [0.05, 0.05]\n{toml}")).read(0).unwrap();
        // A resampled value beside the coast that is a mean with 0 is no land, and no current of the model either.
        let slow = snapshot.nodes.iter().filter(|n| !n[3].is_nan() && n[..3].iter().map(|v| v * v).sum::<f32>().sqrt() < 0.45).count();
        (snapshot.missing_nodes(), slow)
    };
    let none = share(&[], "mask = \"none\"");
    assert!(none.1 > 0, "land is shown as water: {none:?}");
    let own = share(&["rho", "u", "v"], "");
    assert!(own.0 > none.0 && own.1 == 0, "{own:?}");
    assert_eq!(share(&["rho"], ""), own, "a face is water between two points of water");
    assert_eq!(share(&["u", "v"], ""), own);
    assert_eq!(share(&["rho"], "mask = \"mask_rho\""), own);
}
