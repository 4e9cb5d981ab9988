//! Components, meshes and masks in files of their own.

use crate::kit::netcdf::*;
use crate::{notes, open, open_with, refused};
use ridgewatch::source::SnapshotSource;
use std::path::{Path, PathBuf};
use tempfile::{TempDir, tempdir};

const NX: usize = 12;
const NY: usize = 10;

/// Points of a bent mesh, `shift` cells along x and y.
fn place(x: usize, y: usize, shift: [f64; 2]) -> [f64; 2] {
    let (x, y) = (x as f64 + shift[0], y as f64 + shift[1]);
    [10.0 + 0.5 * x + 0.02 * y, 40.0 + 0.5 * y + 0.02 * x]
}

/// Points of u and v.
const SHIFTS: [[f64; 2]; 2] = [[0.5, 0.0], [0.0, 0.5]];

fn coordinates(file: Fixture, names: [&str; 2], shift: [f64; 2]) -> Fixture {
    names.into_iter().enumerate().fold(file, |file, (k, name)| {
        let values = Data::F64(fill(1, NY, NX, |_, y, x| place(x, y, shift)[k]));
        file.variable(name, &["y", "x"], values).with("units", ["degrees_east", "degrees_north"][k])
    })
}

/// Velocity of component `k` at a point.
fn flow(k: usize, [lon, lat]: [f64; 2]) -> f64 {
    [0.2 * (lon - 10.0) + 0.1 * (lat - 40.0), 0.3 * (lon - 10.0) - 0.1 * (lat - 40.0)][k]
}

/// A file of component `k` at two hours, as NEMO writes it; with coordinates of its points or without.
fn nemo(k: usize, hour: f64, with_coordinates: bool) -> Fixture {
    let (name, depth) = ([["vozocrtx", "depthu"], ["vomecrty", "depthv"]][k][0], [["depthu"], ["depthv"]][k][0]);
    let mut file = Fixture::new(NETCDF4, &[("time_counter", 2), (depth, 1), ("y", NY), ("x", NX)]);
    file = file.axis("time_counter", "hours since 2000-01-01", &[hour, hour + 1.0]);
    if with_coordinates {
        file = coordinates(file, ["nav_lon", "nav_lat"], SHIFTS[k]);
    }
    let values = f32s(fill(2, NY, NX, |_, y, x| flow(k, place(x, y, SHIFTS[k]))));
    let standard = ["eastward_sea_water_velocity", "northward_sea_water_velocity"][k];
    file = file.variable(name, &["time_counter", depth, "y", "x"], values).with("units", "m/s").with("standard_name", standard);
    if with_coordinates { file.with("coordinates", "nav_lat nav_lon") } else { file }
}

/// Writes files of both components at these hours.
fn write(dir: &TempDir, hours: [&[f64]; 2], with_coordinates: bool) -> Vec<PathBuf> {
    let write =
        |k: usize, hour: f64| nemo(k, hour, with_coordinates).write(&dir.path().join(format!("run_{hour:02}_{}.nc", ["U", "V"][k])));
    (0..2).flat_map(|k| hours[k].iter().map(move |&hour| (k, hour))).map(|(k, hour)| write(k, hour)).collect()
}

/// Largest error of a snapshot's components, east and north.
fn error(files: &[impl AsRef<Path>]) -> f64 {
    let mut archive = open(files);
    let snapshot = archive.read(archive.times().len() - 1).unwrap();
    let (nx, axes) = (snapshot.grid.shape()[0], &snapshot.grid.axes);
    let known = (0..snapshot.nodes.len()).filter(|&i| !snapshot.nodes[i][3].is_nan());
    let errors: Vec<f64> = known
        .flat_map(|i| {
            let at = [axes[0].coordinates()[i % nx], axes[1].coordinates()[i / nx]];
            let found = east_north(&snapshot, i);
            [0, 1].map(|k| (found[k] - flow(k, at)).abs())
        })
        .collect();
    assert!(errors.len() > NX * NY, "{} values", errors.len());
    errors.into_iter().fold(0.0, f64::max)
}

#[test]
fn components_are_joined_by_their_times() {
    let dir = tempdir().unwrap();
    let files = write(&dir, [&[0.0, 2.0, 4.0], &[0.0, 2.0, 4.0]], true);
    let archive = open(&files);
    assert_eq!((archive.times().len(), archive.files().len()), (6, 3));
    assert!(notes(&archive).contains("run_00_U.nc, run_00_V.nc"), "{}", notes(&archive));
    // The velocity is linear, and cells are half a degree: an exchange of points would be an error of 0.05 m/s.
    let worst = error(&files);
    assert!(worst < 5e-3, "{worst}");
    let inspection = crate::inspected(&files);
    let roles: Vec<&str> = inspection.variables.iter().filter_map(|v| v.role.as_deref()).collect();
    assert!(roles.contains(&"u") && roles.contains(&"v"), "{inspection}");
    assert!(error(&[dir.path().join("*U.nc"), dir.path().join("*V.nc")]) == worst);
}

#[test]
fn a_mesh_and_a_mask_lie_beside_them() {
    let dir = tempdir().unwrap();
    let mut files = write(&dir, [&[0.0, 2.0], &[0.0, 2.0]], false);
    refused(&files, "", &["run_00_U.nc", "dimension `x`"]);
    let mesh = [("t", [0.0; 2]), ("u", SHIFTS[0]), ("v", SHIFTS[1])].into_iter();
    let mesh = mesh.fold(Fixture::new(NETCDF4, &[("y", NY), ("x", NX)]), |file, (point, shift)| {
        coordinates(file, [&format!("glam{point}"), &format!("gphi{point}")], shift)
    });
    files.push(mesh.write(&dir.path().join("mesh.nc")));
    let worst = error(&files);
    assert!(worst < 5e-3, "{worst}");
    let missing = |files: &[PathBuf]| open(files).read(0).unwrap().missing_nodes();
    let whole = missing(&files);
    let water = f32s(fill(1, NY, NX, |_, y, x| if x > 5 && y > 4 { 0.0 } else { 1.0 }));
    files.push(Fixture::new(CLASSIC, &[("y", NY), ("x", NX)]).variable("tmask", &["y", "x"], water).write(&dir.path().join("mask.nc")));
    assert!(missing(&files) > whole + 20, "{} and {whole}", missing(&files));
    assert_eq!(open_with(&files, "mask = \"none\"").read(0).unwrap().missing_nodes(), whole);
}

#[test]
fn a_wrong_or_missing_partner_is_named() {
    let dir = tempdir().unwrap();
    let lone = write(&dir, [&[0.0, 2.0], &[]], true);
    refused(&lone, "", &["run_00_U.nc", "it holds u", "no file holds v", "name its files too"]);
    refused(&lone[..1], "", &["run_00_U.nc", "no northward or y component", "name that file too"]);
    let late = write(&dir, [&[0.0, 2.0], &[0.0, 4.0]], true);
    refused(&late, "", &["run_02_U.nc", "2 times from 2000-01-01T02:00:00Z to 2000-01-01T03:00:00Z", "no file holds v at these times"]);
    let twice = [late.clone(), vec![nemo(1, 0.0, true).write(&dir.path().join("copy.nc"))]].concat();
    refused(&twice[..5], "", &["copy.nc", "run_00_V.nc", "both hold v at the same times"]);
    // Rows of coordinates that differ.
    let plain = |name: &str, y: &[f64]| {
        let axes: [(&str, &str, &[f64]); 3] = [("time", "s", &[0.0, 1.0]), ("y", "m", y), ("x", "m", &[0.0, 1.0])];
        let file = Fixture::on(CLASSIC, &axes).fields("m/s", [(name, f32s(vec![0.5; 4 * y.len()]))]);
        file.write(&dir.path().join(format!("plain_{name}.nc")))
    };
    assert_eq!(open(&[plain("u", &[0.0, 1.0]), plain("v", &[0.0, 1.0])]).times().len(), 2);
    let pieces = ["plain_u.nc", "plain_v.nc", "entry 1 of `y` is 1 and 2", "one grid"];
    refused(&[plain("u", &[0.0, 1.0]), plain("v", &[0.0, 2.0])], "", &pieces);
}
