//! Archives that must be refused, with a message that says which file, what was found and what is accepted.

use crate::kit::netcdf::*;
use crate::{DAYS, open, open_with, refused};
use ridgewatch::source::{FormatError, FormatFault, SnapshotSource, SourceError};
use std::path::Path;
use tempfile::tempdir;

const NO_FILES: [&Path; 0] = [];

/// Asserts that one file is refused with a message that holds each piece and the name of the file.
#[track_caller]
fn says(file: &Path, pieces: &[&str]) {
    refused(&[file], "", &[pieces, &[file.file_name().unwrap().to_str().unwrap()]].concat());
}

/// A file of 2 x 2 nodes at one time, without velocities.
fn square() -> Fixture {
    Fixture::on(CLASSIC, &[("time", DAYS, &[0.0]), ("y", "m", &[0.0, 1.0]), ("x", "m", &[0.0, 1.0])])
}

/// Zeros, or another value, at `count` nodes.
fn all(value: f32, count: usize) -> Data {
    Data::F32(vec![value; count])
}

#[test]
fn a_file_that_another_has_locked_is_not_called_damaged() {
    let dir = tempdir().unwrap();
    let hdf5 = dir.path().join("flame.h5");
    drop(hdf5_metno::File::create(&hdf5).unwrap());
    let netcdf = Fixture::new(NETCDF4, &[("y", 2), ("x", 2)]).write(&dir.path().join("plain.nc"));
    for path in [hdf5, netcdf] {
        let file = std::fs::File::open(&path).unwrap();
        file.lock().unwrap();
        says(&path, &["cannot be locked", "another process has locked it", "HDF5_USE_FILE_LOCKING=FALSE"]);
    }
}

#[test]
fn files_that_are_not_there_or_not_netcdf() {
    let dir = tempdir().unwrap();
    let at = |name: &str, bytes: &[u8]| {
        let path = dir.path().join(name);
        std::fs::write(&path, bytes).unwrap();
        path
    };
    says(&dir.path().join("absent.nc"), &["cannot be opened", "No such file"]);
    says(&at("empty.nc", b""), &["it is empty"]);
    says(&at("text.nc", b"time,lat,lon\n"), &["starts with \"time,lat\"", "NetCDF-4"]);
    says(&at("wind.nc.gz", &[0x1f, 0x8b, 8, 0, 0, 0, 0, 0, 0]), &["gzip"]);
    says(&at("cdf9.nc", b"CDF\x09aaaaaaaa"), &["version 9"]);
    assert!(matches!(refused(&NO_FILES, "", &[]), SourceError::NoFiles));
    refused(&[dir.path().join("*.nope")], "", &["*.nope"]);
    let folder = dir.path().join("folder");
    std::fs::create_dir(&folder).unwrap();
    assert!(matches!(refused(&[folder], "", &[]), SourceError::NoMatch { .. }));
}

#[test]
fn truncated_files() {
    let dir = tempdir().unwrap();
    for (name, options) in [("c.nc", CLASSIC), ("d.nc", DATA_64), ("h.nc", NETCDF4)] {
        let file = plane(options, &[0.0, 1.0], DAYS).write(&dir.path().join(name));
        let whole = std::fs::read(&file).unwrap();
        // libnetcdf reads zeros past the end of a classic file and says nothing.
        for keep in [whole.len() - 1, whole.len() * 3 / 4, whole.len() / 2, 40, 9] {
            std::fs::write(&file, &whole[..keep]).unwrap();
            says(&file, &["truncated"]);
        }
    }
}

#[test]
fn a_file_that_shrinks_after_opening() {
    let dir = tempdir().unwrap();
    let first = plane(CLASSIC, &[0.0], DAYS).write(&dir.path().join("a.nc"));
    let second = plane(CLASSIC, &[1.0], DAYS).write(&dir.path().join("b.nc"));
    let mut archive = open(&[&first, &second]);
    let whole = std::fs::read(&first).unwrap();
    std::fs::write(&first, &whole[..whole.len() - 20]).unwrap();
    assert!(matches!(archive.read(0), Err(SourceError::Format(FormatError { fault: FormatFault::Truncated { .. }, .. }))));
    std::fs::remove_file(&first).unwrap();
    assert!(matches!(archive.read(0), Err(SourceError::Format(FormatError { fault: FormatFault::Open(_), .. }))));
    assert!(archive.read(1).is_ok(), "the other file can still be read");
}

#[test]
fn no_velocity() {
    let dir = tempdir().unwrap();
    let units = [("u", "m/s"), ("sst", "K"), ("speed", "m/s"), ("V", "m3/s")];
    let fixture = units.into_iter().fold(square(), |fixture, (name, units)| fixture.fields(units, [(name, all(0.0, 4))]));
    let file = fixture.write(&dir.path().join("scalar.nc"));
    says(
        &file,
        &[
            "no northward or y component",
            "u (time, y, x): may be u",
            "sst (time, y, x): unit `K` is no velocity",
            "speed (time, y, x): unit `m/s`, but neither standard_name, name nor long_name says which component",
            "V (time, y, x): usual name `V`, but its unit `m3/s` is no velocity",
        ],
    );
}

#[test]
fn units_and_calendars_that_are_unknown() {
    let dir = tempdir().unwrap();
    let wind = |unit: &str| {
        let fixture = square().fields(unit, [("a", all(0.0, 4))]).with("standard_name", "eastward_wind");
        fixture.fields(unit, [("b", all(0.0, 4))]).with("standard_name", "northward_wind").write(&dir.path().join("unit.nc"))
    };
    says(&wind("furlong/fortnight"), &["`a` has unit `furlong/fortnight`", "accepted are m/s"]);
    says(&wind("Pa/s"), &["`eastward_wind`, but its unit `Pa/s` is no velocity"]);
    // Metres a second do not fit a pressure axis.
    let (time, level): (&[f64], &[f64]) = (&[0.0], &[1000.0, 500.0]);
    let axes = [("time", DAYS, time), ("plev", "hPa", level), ("y", "m", &[0.0, 1.0]), ("x", "m", &[0.0, 1.0])];
    let fixture = Fixture::on(CLASSIC, &axes).fields("m/s", ["u", "v", "w"].map(|name| (name, all(1.0, 8))));
    let file = fixture.write(&dir.path().join("mixed_unit.nc"));
    says(&file, &["`w`", "unit `m/s` does not fit the axis `plev` in `Pa`", "--set archive.w=none"]);
    assert_eq!(open_with(&[file], "w = \"none\"").read(0).unwrap().nodes[0][..3], [1.0, 1.0, 0.0]);
    says(&plane(CLASSIC, &[0.0], "moons since 2000-01-01").write(&dir.path().join("moon.nc")), &["moons since", "seconds|minutes|hours"]);
    let fixture = Fixture::on(CLASSIC, &[("time", DAYS, &[0.0]), ("y", "m", &[0.0, 1.0]), ("x", "furlong", &[0.0, 1.0])])
        .with("calendar", "mayan")
        .fields("", [("u", all(0.0, 4)), ("v", all(0.0, 4))]);
    let file = fixture.write(&dir.path().join("mayan.nc"));
    says(&file, &["mayan", "360_day"]);
    refused(&[file], "time = \"y\"", &["mayan.nc"]);
}

#[test]
fn axes_that_are_none() {
    let dir = tempdir().unwrap();
    let with_axes = |x: &[f64], y: &[f64]| {
        let still = || all(0.0, x.len() * y.len());
        let fixture = Fixture::on(CLASSIC, &[("time", DAYS, &[0.0]), ("y", "m", y), ("x", "m", x)]);
        fixture.fields("", [("u", still()), ("v", still())]).write(&dir.path().join("axis.nc"))
    };
    says(&with_axes(&[0.0, 1.0, 0.5], &[0.0, 1.0]), &["`x`: it turns back between its entries 1 and 2 (0.5 and 1 m)"]);
    says(&with_axes(&[0.0, 1.0], &[3.0, 2.0, 2.0]), &["`y`: its entries 1 and 2 are both 2"]);
    says(&with_axes(&[0.0, f64::NAN, 2.0], &[0.0, 1.0]), &["`x`: its entry 1 is missing"]);
    says(&with_axes(&[0.0], &[0.0, 1.0]), &["axis `x` has 1 node(s); at least 2 are needed"]);
    // No coordinates; and coordinates of two dimensions.
    let bare = Fixture::new(CLASSIC, &[("time", 1), ("j", 2), ("i", 3)])
        .axis("time", DAYS, &[0.0])
        .fields("", [("u", all(2.0, 6)), ("v", all(0.0, 6))])
        .variable("nav_lon", &["j", "i"], all(0.0, 6))
        .with("units", "degrees_east");
    let file = bare.write(&dir.path().join("bare.nc"));
    says(&file, &["dimension `i` has only coordinates of two dimensions (nav_lon)", "--set archive.velocity_unit=cells"]);
    let mut cells = open_with(&[file], "velocity_unit = \"cells\"");
    assert_eq!(cells.read(0).unwrap().nodes[0][0], 2.0, "velocities in cells need no coordinates");
    // An ensemble.
    let fixture = Fixture::new(CLASSIC, &[("time", 1), ("member", 5), ("y", 2), ("x", 2)])
        .axis("x", "m", &[0.0, 1.0])
        .axis("y", "m", &[0.0, 1.0])
        .axis("time", DAYS, &[0.0])
        .fields("", [("u", all(0.0, 20)), ("v", all(0.0, 20))]);
    says(&fixture.write(&dir.path().join("ensemble.nc")), &["dimension `member` has 5 entries"]);
}

#[test]
fn staggered_components() {
    let dir = tempdir().unwrap();
    let fixture = Fixture::new(CLASSIC, &[("time", 1), ("y", 2), ("x", 2), ("x_stag", 3), ("y_stag", 3)])
        .axis("time", DAYS, &[0.0])
        .variable("U", &["time", "y", "x_stag"], all(0.0, 6))
        .with("units", "m s-1")
        .variable("V", &["time", "y_stag", "x"], all(0.0, 6))
        .with("units", "m s-1");
    says(&fixture.write(&dir.path().join("stag.nc")), &["`U` lies on (time, y, x_stag) but `V` on (time, y_stag, x)", "staggered"]);
}

#[test]
fn times_that_repeat_turn_back_or_are_missing() {
    let dir = tempdir().unwrap();
    let at = |name: &str, times: &[f64]| plane(CLASSIC, times, DAYS).write(&dir.path().join(name));
    let overlap = [at("a.nc", &[0.0, 1.0]), at("b.nc", &[1.0, 2.0])];
    refused(&overlap, "", &["a.nc", "b.nc", "2000-01-02T00:00:00Z"]);
    says(&at("back.nc", &[0.0, 2.0, 1.0]), &["entry 2 of `time` is 2000-01-02T00:00:00Z, the one before it 2000-01-03T00:00:00Z"]);
    says(&at("twice.nc", &[0.0, 0.0]), &["must ascend"]);
    says(&at("nan.nc", &[0.0, f64::NAN]), &["entry 1 of `time` is missing"]);
    let timeless = Fixture::on(CLASSIC, &[("y", "m", &[0.0, 1.0]), ("x", "m", &[0.0, 1.0])]);
    let timeless = timeless.fields("", [("u", all(0.0, 4)), ("v", all(0.0, 4))]);
    says(&timeless.write(&dir.path().join("timeless.nc")), &["no time variable", "--set archive.time=NAME"]);
    // The same file twice is one file.
    let once = at("once.nc", &[0.0, 1.0]);
    assert_eq!(open(&[&once, &once]).times().len(), 2);
}

#[test]
fn mixed_files() {
    for format in [CLASSIC, NETCDF4] {
        mixed_files_of(format);
    }
}

fn mixed_files_of(format: Format) {
    let dir = tempdir().unwrap();
    let first = plane(format, &[0.0], DAYS).write(&dir.path().join("a.nc"));
    let mixed = |second: Fixture, piece: &str| {
        let error = refused(&[first.clone(), second.write(&dir.path().join("b.nc"))], "", &["a.nc", "b.nc", piece]);
        assert!(matches!(error, SourceError::Mixed { .. }), "{error}");
    };
    let other = |x: &[f64], names: [&str; 2], calendar: &str| {
        Fixture::on(format, &[("time", DAYS, &[1.0]), ("y", "m", &[0.0, 2.0, 4.0]), ("x", "m", x)])
            .with("calendar", calendar)
            .fields("", names.map(|name| (name, all(0.0, 3 * x.len()))))
    };
    mixed(other(&[0.0, 1.0, 2.0], ["u", "v"], "standard"), "`x` of 4 nodes from 0 to 3 m and `x` of 3 nodes from 0 to 2 m");
    mixed(other(&[0.0, 1.0, 2.5, 3.0], ["u", "v"], "standard"), "first at node 2: 2 and 2.5");
    mixed(other(&[0.0, 1.0, 2.0, 3.0], ["uo", "vo"], "standard"), "`u`, `v` and `uo`, `vo`");
    mixed(other(&[0.0, 1.0, 2.0, 3.0], ["u", "v"], "360_day"), "standard and 360_day");
}

#[test]
fn tau_against_the_archive() {
    let dir = tempdir().unwrap();
    let times: Vec<f64> = (0..11).map(f64::from).collect();
    let file = plane(CLASSIC, &times, DAYS).write(&dir.path().join("long.nc"));
    let archive = open(&[file]);
    let day = 86_400.0;
    assert_eq!(archive.longest_default_tau().unwrap(), 5.0 * day);
    assert!(archive.check_tau(10.0 * day).is_ok());
    let error = archive.check_tau(10.5 * day).unwrap_err();
    assert!(matches!(error, SourceError::TooShort { needed: 12, found: 11, .. }));
    assert!(error.to_string().contains("tau = 907200 s (10.5 days) needs 12 snapshots 86400 s (24.0 hours) apart"), "{error}");
    let message = archive.check_tau(30.0 * day).unwrap_err().to_string();
    assert!(message.contains("needs 31 snapshots") && message.contains("long.nc has 11"), "{message}");
    assert!(archive.check_tau(0.0).is_err() && archive.check_tau(f64::NAN).is_err());
    let short = plane(CLASSIC, &[0.0, 1.0], DAYS).write(&dir.path().join("short.nc"));
    let archive = open(&[short]);
    assert_eq!(archive.longest_default_tau().unwrap(), day);
    let one = plane(CLASSIC, &[1.0], DAYS).write(&dir.path().join("one.nc"));
    let archive = open(&[one]);
    for message in [archive.longest_default_tau().unwrap_err().to_string(), archive.check_tau(day).unwrap_err().to_string()] {
        for piece in ["one.nc holds one time (", "-02T00:00:00Z)", "--set archive.steady=true", "--set time.tau=DURATION"] {
            assert!(message.contains(piece), "{message}");
        }
    }
}

#[test]
fn packing_that_unpacks_nothing() {
    let dir = tempdir().unwrap();
    let packed = |attribute: &str, value: f64| {
        square()
            .fields("", ["u", "v"].map(|name| (name, Data::I16(vec![1; 4]))))
            .with(attribute, value)
            .write(&dir.path().join("packed.nc"))
    };
    for (attribute, value, found) in
        [("scale_factor", 0.0, "is 0"), ("scale_factor", f64::NAN, "is NaN"), ("add_offset", f64::INFINITY, "is inf")]
    {
        refused(&[packed(attribute, value)], "", &["packed.nc", "`v`", attribute, found, "accepted is a finite number"]);
    }
}

#[test]
fn settings_that_do_not_fit() {
    let dir = tempdir().unwrap();
    let file = [plane(CLASSIC, &[0.0], DAYS).write(&dir.path().join("plane.nc"))];
    for (toml, pieces) in [
        ("metric = \"sphere\"", ["`metric` = sphere", "index and cartesian"]),
        ("metric = \"cartesian\"\nvelocity_unit = \"cells\"", ["`metric` = cartesian", "index"]),
        ("level = 3.0", ["`level` = 3", "no level axis"]),
        ("region = [10.0, 20.0, 0.0, 4.0]", ["0 node(s) of axis `x`", "from 0 to 3"]),
        ("region = [0.0, 2.0, 4.0, 0.0]", ["`region`", "y0 < y1"]),
        ("region = [2.0, 0.0, 0.0, 4.0]", ["0 node(s) of axis `x`", "from 0 to 3"]),
        ("slab = [1.0, 0.0]", ["`slab`", "lower < upper"]),
        ("x = \"u\"", ["plane.nc", "`x` must name a coordinate of one dimension"]),
        ("y = \"why\"", ["`y = \"why\"`", "x, y, time, u, v"]),
    ] {
        refused(&file, toml, &pieces);
    }
}
