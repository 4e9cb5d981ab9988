//! Real archives (`RIDGEWATCH_DATA`, by default `../shared/data`): `make test-data`.
#![allow(clippy::unwrap_used, clippy::print_stdout)] // Tests: a panic is the report.

use ridgewatch::field::Geometry;
use ridgewatch::source::{Metric, NetCdfArchive, NetCdfSettings, SnapshotSource, inspect};
use std::path::{Path, PathBuf};

/// A file of the collection, which must be there: `make test` leaves these tests out, and says so, where it is not.
fn data(name: &str) -> PathBuf {
    let root =
        std::env::var_os("RIDGEWATCH_DATA").map_or_else(|| Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data"), PathBuf::from);
    let path = root.join(name);
    assert!(path.exists(), "{} is not there; set RIDGEWATCH_DATA to the folder of the collection", path.display());
    path
}

#[test]
#[ignore = "needs real archives: make test-data"]
fn globcurrent() {
    let folder = data("globcurrent");
    let mut archive = NetCdfArchive::open(&[folder.join("*.nc")], &NetCdfSettings::default()).unwrap();
    let grid = archive.grid().clone();
    assert_eq!((grid.shape(), archive.times().len()), ([81, 41, 1], 60));
    assert!(matches!(grid.geometry, Geometry::Sphere { .. }));
    assert_eq!((grid.axes[0].first(), grid.axes[1].first(), grid.axes[0].period()), (14.875, -40.125, None));
    assert_eq!(archive.date(archive.times()[0]).as_deref(), Some("2002-01-01T00:00:00Z"));
    assert_eq!(archive.date(archive.times()[59]).as_deref(), Some("2002-03-01T00:00:00Z"));
    assert_eq!((archive.default_tau().unwrap(), archive.gaps().len()), (29.5 * 86_400.0, 0));
    let snapshot = archive.read(0).unwrap();
    // Counted with another tool: 769 of 3321 values are NaN.
    assert_eq!(snapshot.missing(), 769);
    let fastest = snapshot.nodes.iter().map(|n| n[..3].iter().map(|v| v * v).sum::<f32>().sqrt()).fold(0.0, f32::max);
    assert!(fastest > 1.0 && fastest < 3.0, "the Agulhas current runs at {fastest} m/s");
    println!("{}", inspect(&[folder], &NetCdfSettings::default(), None).unwrap());
}

#[test]
#[ignore = "needs real archives: make test-data"]
fn era5_on_a_projected_grid() {
    let first = data("era5_utm32_2025_05_01_00.nc");
    let pattern = first.with_file_name("era5_utm32_*.nc");
    let mut archive = NetCdfArchive::open(std::slice::from_ref(&pattern), &NetCdfSettings::default()).unwrap();
    assert_eq!((archive.grid().shape(), archive.times().len()), ([17, 30, 37], 3));
    assert_eq!((archive.metric(), archive.grid().axes[2].first()), (Metric::Cartesian, 100.0));
    let share = archive.read(1).unwrap().missing() as f64 / archive.grid().nodes() as f64;
    // Counted with another tool: 14.1 %.
    assert!((share - 0.141).abs() < 1e-3, "{share}");
    println!("{}", inspect(&[pattern], &NetCdfSettings::default(), None).unwrap());
}

#[test]
#[ignore = "needs real archives: make test-data"]
fn what_is_not_read_yet_is_said() {
    for (name, pieces) in [
        ("wrf_katrina_uvw_4t.nc", &["west_east_stag", "staggered"][..]),
        ("jhtdb_iso1024coarse_pressure_64.h5", &["HDF5 archives are not read yet"]),
        ("jhtdb_legacy_cutout_10x10.h5", &["HDF5 archives are not read yet"]),
    ] {
        let message = NetCdfArchive::open(&[data(name)], &NetCdfSettings::default()).err().unwrap().to_string();
        for piece in pieces.iter().chain([&name]) {
            assert!(message.contains(piece), "{message}");
        }
    }
}
