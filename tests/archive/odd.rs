//! Archives as people have them: months, no times, members of an ensemble, units that are missing or wrong, coordinates that are 0.

use crate::kit::netcdf::*;
use crate::{HOURS, inspected, notes, open, open_with, refused};
use ridgewatch::field::Geometry;
use ridgewatch::source::SnapshotSource;
use std::path::Path;
use tempfile::tempdir;

const DAY: f64 = 86_400.0;
const X: [f64; 3] = [0.0, 1.0, 2.0];

/// Winds on three by three nodes; u counts the entries.
fn winds(fixture: Fixture, entries: usize) -> Fixture {
    fixture.winds(f32s((0..entries * 9).map(|i| i as f64).collect()), f32s(vec![0.5; entries * 9]))
}

#[test]
fn months_are_no_time() {
    let dir = tempdir().unwrap();
    let months: Vec<f64> = (1..=12).map(f64::from).collect();
    let climatology = |name: &str, units: &str, long_name: &str| {
        let mut fixture = Fixture::new(CLASSIC, &[(name, 12), ("y", 3), ("x", 3)]).axis("x", "m", &X).axis("y", "m", &X);
        fixture = fixture.axis(name, units, &months).with("long_name", long_name);
        winds(fixture, 12).write(&dir.path().join(format!("{name}.nc")))
    };
    for (name, units, long_name, counts) in [
        ("month", "", "month of the year", "months"),
        ("month", "1", "", "months"),
        ("time", "", "month", "months"),
        ("time", "months", "", "months"),
        ("time", "months since 1999-12-01", "", "months"),
        ("time", "years since 2000-01-01", "", "years"),
        ("dayofyear", "", "", "days of a year"),
    ] {
        let file = climatology(name, units, long_name);
        for toml in [String::new(), format!("time = \"{name}\"")] {
            let length = match counts {
                "months" => "30.4375 days",
                "years" => "365.2425 days",
                _ => "1 day",
            };
            let date = if units.contains("1999") { "since 1999-12-01\"" } else { "since 2000-01-01\"" };
            let stated = format!("--set archive.units.time=\"{length}\"");
            refused(&[&file], &toml, &[&format!("counts {counts}"), &stated, date]);
        }
        let mut archive = open_with(&[&file], "[units]\ntime = \"30.4375 days\"");
        assert_eq!((archive.times()[11] - archive.times()[0], archive.times().len()), (11.0 * 30.4375 * DAY, 12));
        assert_eq!(us(&archive.read(2).unwrap())[0], 18.0);
        let dated = open_with(&[&file], "[units]\ntime = \"30.4375 days since 2000-01-01\"");
        assert_eq!(dated.date(dated.times()[0]).as_deref(), Some("2000-01-31T10:30:00Z"));
    }
    // A day of the month is a day.
    let fixture = Fixture::on(CLASSIC, &[("time", "days", &[1.0, 2.0]), ("y", "m", &X), ("x", "m", &X)]).with("long_name", "day of month");
    assert_eq!(open(&[winds(fixture, 2).write(&dir.path().join("day.nc"))]).times(), [DAY, 2.0 * DAY]);
}

#[test]
fn no_time_or_one_of_several_is_steady() {
    let dir = tempdir().unwrap();
    let timeless = winds(Fixture::on(CLASSIC, &[("y", "m", &X), ("x", "m", &X)]), 1).write(&dir.path().join("timeless.nc"));
    refused(&[&timeless], "", &["timeless.nc", "no time variable", "--set archive.time=NAME", "--set archive.steady=true"]);
    let mut archive = open_with(&[&timeless], "steady = true");
    assert_eq!(archive.times(), [0.0]);
    assert_eq!(us(&archive.read(0).unwrap())[4], 4.0);
    let axes: [(&str, &str, &[f64]); 3] = [("time", HOURS, &[0.0, 1.0, 2.0]), ("y", "m", &X), ("x", "m", &X)];
    let several = winds(Fixture::on(CLASSIC, &axes), 3).write(&dir.path().join("several.nc"));
    let mut archive = open_with(&[&several], "steady = true\nselect = { time = 2 }");
    assert_eq!((archive.times().len(), us(&archive.read(0).unwrap())[0]), (1, 18.0));
    assert_eq!(archive.date(archive.times()[0]).as_deref(), Some("2000-01-01T02:00:00Z"));
}

#[test]
fn a_member_of_an_ensemble_is_selected() {
    let dir = tempdir().unwrap();
    let members = [10.0, 11.0, 12.0, 13.0];
    let axes: [(&str, &str, &[f64]); 4] = [("time", HOURS, &[0.0, 1.0]), ("member", "", &members), ("y", "m", &X), ("x", "m", &X)];
    let file = winds(Fixture::on(CLASSIC, &axes), 8).write(&dir.path().join("ensemble.nc"));
    let mut archive = open_with(&[&file], "select = { member = 3 }");
    assert_eq!((archive.grid().dimensions(), us(&archive.read(1).unwrap())[0]), (2, 7.0 * 9.0));
    assert!(notes(&archive).contains("entry 3 (13) of `member`, as set"), "{}", notes(&archive));
    // Members are no levels, whatever their numbers.
    refused(&[&file], "", &["dimension `member` has 4 entries", "--set archive.select.member=0"]);
    let bare = Fixture::new(CLASSIC, &[("time", 2), ("run", 4), ("y", 3), ("x", 3)]).axis("x", "m", &X).axis("y", "m", &X);
    let bare = winds(bare.axis("time", HOURS, &[0.0, 1.0]), 8).write(&dir.path().join("bare.nc"));
    refused(&[&bare], "", &["dimension `run` has 4 entries", "--set archive.select.run=0"]);
    assert_eq!(us(&open_with(&[&bare], "select = { run = 0 }").read(1).unwrap())[0], 4.0 * 9.0);
    refused(&[&bare], "select = { run = 4 }", &["`select` = { run = 4 }", "from 0 to 3"]);
    refused(&[&bare], "select = { jog = 1 }", &["`select` = { jog = 1 }", "time, run, y, x"]);
}

#[test]
fn units_are_stated() {
    let dir = tempdir().unwrap();
    let axes: [(&str, &str, &[f64]); 3] = [("time", HOURS, &[0.0, 1.0]), ("y", "blob", &X), ("x", "km", &X)];
    let file = Fixture::on(CLASSIC, &axes).fields("unknown", [("u", f32s(vec![50.0; 18])), ("v", f32s(vec![0.5; 18]))]);
    let file = file.write(&dir.path().join("unknown.nc"));
    let how = "its unit `unknown` is no velocity; if it is one, state it with --set archive.units.u=\"m s-1\"";
    refused(&[&file], "", &["usual name `u`", how]);
    refused(&[&file], "[units]\nu = \"cm/s\"\nv = \"m/s\"", &["`y` has unit `blob`", "--set archive.units.y=m"]);
    let mut archive = open_with(&[&file], "[units]\nu = \"cm/s\"\nv = \"m/s\"\ny = \"km\"");
    assert_eq!((archive.grid().axes[1].last(), archive.read(0).unwrap().nodes[0][..2].to_vec()), (2000.0, vec![0.5, 0.5]));
    refused(&[&file], "[units]\nspeed = \"cm/s\"", &["`units` = { speed = \"cm/s\" }", "u, v, w, x, y, z and time"]);
    refused(&[&file], "[units]\nu = \"furlong\"\nv = \"m/s\"", &["its unit `furlong` is no velocity"]);
    // Degrees make the axes those of a sphere.
    let globe = open_with(&[&file], "[units]\nu = \"m/s\"\nv = \"m/s\"\nx = \"degrees_east\"\ny = \"degrees_north\"");
    assert!(matches!(globe.grid().geometry, Geometry::Sphere { .. }));
    // Longitudes in metres are no longitudes.
    let axes: [(&str, &str, &[f64]); 3] = [("time", HOURS, &[0.0, 1.0]), ("lat", "m", &X), ("lon", "m", &X)];
    let flat = winds(Fixture::on(CLASSIC, &axes), 2).write(&dir.path().join("flat.nc"));
    // Nor are those of a turned mesh, which has no rows.
    let mut turned = Fixture::new(CLASSIC, &[("time", 2), ("y", 3), ("x", 3)]).axis("time", HOURS, &[0.0, 1.0]);
    for (k, name) in ["nav_lon", "nav_lat"].into_iter().enumerate() {
        let values = fill(1, 3, 3, |_, y, x| 1000.0 * [x as f64 - 0.5 * y as f64, y as f64 + 0.5 * x as f64][k]);
        turned = turned.variable(name, &["y", "x"], Data::F64(values)).with("units", "m");
    }
    let turned = turned.variable("u", &["time", "y", "x"], f32s(vec![1.0; 18])).with("units", "m/s");
    let turned = turned.variable("v", &["time", "y", "x"], f32s(vec![1.0; 18])).with("units", "m/s").write(&dir.path().join("turned.nc"));
    refused(&[turned], "", &["coordinates in metres of two dimensions (nav_lon, nav_lat)", "longitudes and latitudes in degrees alone"]);
    assert_eq!(open(&[flat]).grid().geometry, Geometry::Cartesian);
}

#[test]
fn a_fill_value_that_the_file_does_not_name_is_stated() {
    let dir = tempdir().unwrap();
    let axes: [(&str, &str, &[f64]); 3] = [("time", HOURS, &[0.0, 1.0]), ("y", "m", &X), ("x", "m", &X)];
    let mut u: Vec<f64> = (0..18).map(|i| f64::from(i) / 10.0).collect();
    (u[1], u[4], u[10]) = (-9999.9, -9999.9, -9999.9);
    let file = Fixture::on(CLASSIC, &axes).winds(f32s(u), f32s(vec![0.5; 18])).write(&dir.path().join("filled.nc"));
    let node = |more: &str, node: usize| open_with(&[&file], more).read(0).unwrap().nodes[node];
    assert_eq!(node("", 4)[0], -9999.9, "taken as it is, with a warning");
    assert!(node("fill_value = -9999.9", 4)[3].is_nan(), "missing");
    assert_eq!(node("fill_value = -9999.9", 3)[0], 0.3);
    // Only of velocities: the first coordinates are 0 too.
    assert!(node("fill_value = 0", 0)[3].is_nan() && node("fill_value = 0", 3)[0] == 0.3);
}

const NX: usize = 12;
const NY: usize = 10;

/// A bent mesh with half a degree a cell.
fn place(x: f64, y: f64) -> [f64; 2] {
    [10.0 + 0.5 * x + 0.02 * y, 40.0 + 0.5 * y + 0.02 * x]
}

/// Adds longitudes and latitudes of `nx` x `ny` points; `nowhere` are at (0, 0).
fn coordinates(file: Fixture, names: [&str; 2], on: [&str; 2], nx: usize, ny: usize, at: impl Fn(usize, usize) -> [f64; 2]) -> Fixture {
    names.into_iter().enumerate().fold(file, |file, (k, name)| {
        let values = Data::F64(fill(1, ny, nx, |_, y, x| at(x, y)[k]));
        file.variable(name, &on, values).with("units", ["degrees_east", "degrees_north"][k])
    })
}

fn ocean() -> Fixture {
    Fixture::new(NETCDF4, &[("time", 2), ("y", NY), ("x", NX)]).axis("time", HOURS, &[0.0, 1.0])
}

fn uniform(file: Fixture) -> Fixture {
    let values = || f32s(vec![0.5; 2 * NX * NY]);
    let file = file.fields("m/s", [("uo", values())]).with("standard_name", "eastward_sea_water_velocity");
    file.fields("m/s", [("vo", values())]).with("standard_name", "northward_sea_water_velocity")
}

#[test]
fn coordinates_that_are_zero_are_no_positions() {
    let dir = tempdir().unwrap();
    // A quarter of the domain was not computed.
    let nowhere = |x: usize, y: usize| x < 6 && y < 5;
    let at = |x: usize, y: usize| if nowhere(x, y) { [0.0; 2] } else { place(x as f64, y as f64) };
    let file = uniform(coordinates(ocean(), ["nav_lon", "nav_lat"], ["y", "x"], NX, NY, at));
    let later = file.write(&dir.path().join("b.nc"));
    let mut archive = open(&[&later]);
    let grid = archive.grid().clone();
    assert!(grid.axes[0].first() > 9.0 && grid.axes[1].first() > 39.0, "{:?}", grid.axes.iter().map(|a| a.first()).collect::<Vec<_>>());
    let share = archive.read(0).unwrap().missing_nodes() as f64 / grid.nodes() as f64;
    // The rows and columns beside the block as well, and the corners of the box around the bent mesh.
    assert!((0.25..0.5).contains(&share), "{share}");
    // Later files are compared with the first one.
    let day = |day: f64| {
        let file = Fixture::new(NETCDF4, &[("time", 2), ("y", NY), ("x", NX)]).axis("time", "days since 2000-01-01", &[day, day + 1.0]);
        uniform(coordinates(file, ["nav_lon", "nav_lat"], ["y", "x"], NX, NY, at)).write(&dir.path().join(format!("{day}.nc")))
    };
    assert_eq!(open(&[day(0.0), day(2.0)]).times().len(), 4);
    // One point may lie there.
    let gulf = |x: usize, y: usize| [x as f64 + 0.1 * y as f64, y as f64 + 0.1 * x as f64];
    let file = uniform(coordinates(ocean(), ["nav_lon", "nav_lat"], ["y", "x"], NX, NY, gulf)).write(&dir.path().join("gulf.nc"));
    let mut archive = open(&[file]);
    assert_eq!((archive.grid().axes[0].first(), archive.read(0).unwrap().nodes[0][3].is_nan()), (0.0, false));
}

#[test]
fn coordinates_that_are_all_zero_are_passed_over() {
    let dir = tempdir().unwrap();
    // u and v on faces; a subset whose coordinates of u and v were not kept.
    let write = |name: &str, kept: bool| {
        let mut file = Fixture::new(NETCDF4, &[("ocean_time", 2)]).axis("ocean_time", HOURS, &[0.0, 1.0]);
        for (point, ny, nx) in [("rho", NY, NX), ("u", NY, NX - 1), ("v", NY - 1, NX)] {
            let (eta, xi) = (format!("eta_{point}"), format!("xi_{point}"));
            let shift = [if nx < NX { 0.5 } else { 0.0 }, if ny < NY { 0.5 } else { 0.0 }];
            let at = |x: usize, y: usize| {
                if kept || point == "rho" { place(x as f64 + shift[0], y as f64 + shift[1]) } else { [0.0; 2] }
            };
            file = file.dimension(&eta, ny).dimension(&xi, nx);
            file = coordinates(file, [&format!("lon_{point}"), &format!("lat_{point}")], [&eta, &xi], nx, ny, at);
            if point != "rho" {
                let values = f32s(fill(2, ny, nx, |_, y, x| place(x as f64 + shift[0], y as f64 + shift[1])[0] - 0.1 * y as f64));
                file = file.variable(point, &["ocean_time", &eta, &xi], values).with("units", "m s-1");
                file = file.with("coordinates", format!("lon_{point} lat_{point} ocean_time").as_str());
            }
        }
        open(&[file.write(&dir.path().join(name))])
    };
    let (mut own, mut between) = (write("kept.nc", true), write("cut.nc", false));
    assert!(notes(&between).contains("its points lie between those of `lon_rho` and `lat_rho`"), "{}", notes(&between));
    let (a, b) = (own.read(0).unwrap(), between.read(0).unwrap());
    // The mesh is straight, so that the middle of two points is their mean, up to the curvature of half a degree of the sphere.
    assert!((own.grid().axes[0].first() - between.grid().axes[0].first()).abs() < 1e-3);
    assert_eq!((a.nodes.len(), a.missing_nodes()), (b.nodes.len(), b.missing_nodes()));
    let apart = a.nodes.iter().zip(&b.nodes).filter(|(a, _)| !a[3].is_nan());
    let apart = apart.flat_map(|(a, b)| (0..3).map(|k| (a[k] - b[k]).abs())).fold(0.0, f32::max);
    assert!(apart < 1e-2, "{apart}");
}

#[test]
fn coordinates_of_two_dimensions_are_named() {
    let dir = tempdir().unwrap();
    // Those of other points come first in the file, and nothing says which belong to the velocity.
    let file = coordinates(ocean(), ["ALON", "ALAT"], ["y", "x"], NX, NY, |x, y| place(x as f64, y as f64));
    let file = coordinates(file, ["BLON", "BLAT"], ["y", "x"], NX, NY, |x, y| place(x as f64 + 0.5, y as f64 + 0.5));
    let file = uniform(file).write(&dir.path().join("pop.nc"));
    let first = |toml: &str| open_with(&[&file], toml).grid().axes[0].first();
    assert!((first("") - place(0.0, 0.0)[0]).abs() < 1e-9);
    assert!((first("x = \"BLON\"\ny = \"BLAT\"") - place(0.5, 0.5)[0]).abs() < 1e-9);
    refused(&[&file], "x = \"BLON\"", &["`BLON`", "name both", "--set archive.y="]);
}

#[test]
fn a_refused_file_leads_with_the_reason() {
    let dir = tempdir().unwrap();
    let scalars = (0..40).fold(ocean(), |file, n| file.variable(&format!("namelist_{n:02}"), &[], Data::F64(vec![0.0])));
    let file = scalars.fields("unknown", [("u", f32s(vec![0.0; 2 * NX * NY]))]).write(&dir.path().join("namelist.nc"));
    let text = inspected(&[&file]).to_string();
    let lines: Vec<&str> = text.lines().collect();
    let line = |piece: &str| lines.iter().position(|l| l.contains(piece)).unwrap_or_else(|| panic!("{piece} is missing in:\n{text}"));
    assert!(line("no velocity found") < 5, "{text}");
    assert!(line("usual name `u`, but its unit `unknown`") < 10, "{text}");
    assert!(!text.contains("namelist_39"), "scalars are counted, not listed: {text}");
    assert!(text.contains("41 variables of fewer than two dimensions"), "{text}");
}

#[test]
fn a_link_that_leads_nowhere_is_told() {
    let dir = tempdir().unwrap();
    let file = winds(Fixture::on(CLASSIC, &[("time", HOURS, &[0.0]), ("y", "m", &X), ("x", "m", &X)]), 1);
    file.write(&dir.path().join("a.nc"));
    let link = dir.path().join("b.nc");
    std::os::unix::fs::symlink("annex/b.nc", &link).unwrap();
    for path in [dir.path().to_path_buf(), dir.path().join("*.nc"), link] {
        refused(&[path as std::path::PathBuf], "", &["b.nc", "is a link to annex/b.nc, which does not exist"]);
    }
    let others: &Path = &dir.path().join("notes.txt");
    std::os::unix::fs::symlink("nowhere", others).unwrap();
    std::fs::remove_file(dir.path().join("b.nc")).unwrap();
    assert_eq!(open(&[dir.path()]).times().len(), 1, "a link that is no data file does not matter");
}

/// Idealised models write longitudes in metres, or x and y of two dimensions, on meshes that are rectangles.
#[test]
fn coordinates_of_two_dimensions_in_metres_are_cartesian() {
    let dir = tempdir().unwrap();
    let mesh = |names: [&str; 2], unit: Option<&str>, tilt: f64| {
        let mut fixture = Fixture::new(CLASSIC, &[("time", 2), ("y", 3), ("x", 3)]).axis("time", HOURS, &[0.0, 1.0]);
        for (k, name) in names.into_iter().enumerate() {
            let at = |i: usize| 500.0 * if k == 0 { (i % 3) as f64 + tilt * (i / 3) as f64 } else { (i / 3) as f64 };
            fixture = fixture.variable(name, &["y", "x"], f32s((0..9).map(at).collect()));
            fixture = unit.into_iter().fold(fixture, |fixture, unit| fixture.with("units", unit));
        }
        fixture
    };
    for (number, (names, unit)) in
        [(["nav_lon", "nav_lat"], Some("m")), (["x_rho", "y_rho"], Some("meter")), (["x_rho", "y_rho"], None)].into_iter().enumerate()
    {
        let mut archive = open(&[winds(mesh(names, unit, 0.0), 2).write(&dir.path().join(format!("{number}.nc")))]);
        assert!(matches!(archive.grid().geometry, Geometry::Cartesian));
        assert_eq!(archive.grid().axes[1].coordinates(), [0.0, 500.0, 1000.0]);
        assert_eq!(us(&archive.read(1).unwrap())[1], 10.0);
    }
    let degrees = winds(mesh(["nav_lon", "nav_lat"], Some("degrees"), 0.0), 2).write(&dir.path().join("degrees.nc"));
    refused(&[&degrees], "", &["a latitude is 500 degrees", "--set archive.units.x=m --set archive.units.y=m"]);
    let stated = open_with(&[&degrees], "[units]\nx = \"m\"\ny = \"m\"");
    assert_eq!(stated.grid().axes[0].coordinates(), [0.0, 500.0, 1000.0]);
    let tilted = winds(mesh(["x_rho", "y_rho"], None, 0.3), 2).write(&dir.path().join("tilted.nc"));
    refused(&[&tilted], "", &["dimension `x` has no coordinate variable"]);
}

/// POP: both components lie on the corners of the cells, without an attribute that says so.
#[test]
fn coordinates_are_those_whose_names_are_of_the_component() {
    let dir = tempdir().unwrap();
    let mut fixture = Fixture::new(CLASSIC, &[("time", 2), ("nlat", 8), ("nlon", 8)]).axis("time", HOURS, &[0.0, 1.0]);
    for (name, unit, shift) in
        [("TLONG", "degrees_east", 0.0), ("TLAT", "degrees_north", 0.0), ("ULONG", "degrees_east", 0.5), ("ULAT", "degrees_north", 0.5)]
    {
        let at = |i: usize| if unit == "degrees_east" { 10.0 + (i % 8) as f64 } else { 20.0 + (i / 8) as f64 } + shift;
        fixture = fixture.variable(name, &["nlat", "nlon"], f32s((0..64).map(at).collect())).with("units", unit);
    }
    let fixture = fixture.fields("m/s", ["UVEL", "VVEL"].map(|name| (name, f32s(vec![0.25; 128]))));
    let archive = open(&[fixture.write(&dir.path().join("pop.nc"))]);
    let grid = archive.grid();
    assert_eq!((grid.axes[0].first(), grid.axes[1].first()), (10.5, 20.5), "{}", notes(&archive));
    assert!(notes(&archive).contains("`ULONG` and `ULAT`"), "{}", notes(&archive));
}

#[test]
fn levels_without_a_vertical_velocity_suggest_one_of_them() {
    let dir = tempdir().unwrap();
    let axes: [(&str, &str, &[f64]); 4] =
        [("time", HOURS, &[0.0, 1.0]), ("depth", "m", &[0.5, 10.0, 30.0]), ("y", "m", &X), ("x", "m", &X)];
    let archive = open(&[winds(Fixture::on(CLASSIC, &axes), 6).write(&dir.path().join("levels.nc"))]);
    let said = notes(&archive);
    assert!(said.contains("mostly the shear between them; one level alone is read with --set archive.level=0.5"), "{said}");
}

#[test]
fn vertical_motion_is_computed_where_it_is_asked_for() {
    let dir = tempdir().unwrap();
    let file = |name: &str, units: &str, levels: &[f64]| {
        let axes: [(&str, &str, &[f64]); 4] = [("time", HOURS, &[0.0, 1.0]), ("lev", units, levels), ("y", "m", &X), ("x", "m", &X)];
        let u = |i: usize| (1 + i / 27) as f64 * 0.25 * X[i % 3];
        let fixture = Fixture::on(CLASSIC, &axes).winds(f32s((0..54).map(u).collect()), f32s(vec![0.5; 54]));
        fixture.write(&dir.path().join(name))
    };
    let deep = file("deep.nc", "m", &[-30.0, -10.0, 0.0]);
    let mut archive = open_with(&[&deep], "w = \"continuity\"");
    assert!(notes(&archive).contains("computed from continuity, as set"), "{}", notes(&archive));
    let up: Vec<f32> = archive.read(1).unwrap().nodes.iter().step_by(9).map(|node| node[2]).collect();
    assert_eq!(up, [0.0, -10.0, -15.0]);
    let scaled: Vec<f32> =
        open_with(&[&deep], "w = \"continuity\"\nvertical_scale = 10.0").read(1).unwrap().nodes.iter().step_by(9).map(|n| n[2]).collect();
    assert_eq!(scaled, [0.0, -100.0, -150.0]);
    let pieces = ["`w`", "\"continuity\" with levels in metres"];
    refused(&[&deep], "w = \"continuity\"\nlevel = -10.0", &pieces);
    refused(&[&deep], "w = \"continuity\"\nmetric = \"index\"", &pieces);
    let degrees: [(&str, &str, &[f64]); 4] =
        [("time", HOURS, &[0.0, 1.0]), ("lev", "m", &X), ("lat", "degrees_north", &X), ("lon", "degrees_east", &X)];
    let globe = winds(Fixture::on(CLASSIC, &degrees), 6).write(&dir.path().join("globe.nc"));
    assert!(notes(&open_with(&[&globe], "w = \"continuity\"")).contains("computed from continuity"));
    refused(&[&globe], "w = \"continuity\"\nmetric = \"cartesian\"", &pieces);
    refused(&[&file("air.nc", "hPa", &[500.0, 700.0, 850.0])], "w = \"continuity\"", &pieces);
}
