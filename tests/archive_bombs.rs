//! Files that claim or hold far more than their length, or that reach other files: each is refused before it costs memory or time.
//!
//! The tests run one after the other: a process that one of them starts inherits, for a moment, the locks of HDF5 files that others write.
#![allow(clippy::unwrap_used)] // Tests: a panic is the report.
#![cfg(target_os = "linux")]

mod kit;

use hdf5_metno::{File, Group};
use kit::netcdf::*;
use kit::program::{Outcome, ridgewatch, run};
use ndarray::{Array1, Array3};
use ridgewatch::source::{Archive, SnapshotSource, SourceError};
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};
use tempfile::tempdir;

static ALONE: Mutex<()> = Mutex::new(());

fn alone() -> MutexGuard<'static, ()> {
    ALONE.lock().unwrap_or_else(PoisonError::into_inner)
}

fn try_open(file: &Path, toml: &str) -> Result<Archive, SourceError> {
    Archive::open(&[file.to_owned()], &toml::from_str(toml).unwrap())
}

fn open_with(file: &Path, toml: &str) -> Archive {
    try_open(file, toml).unwrap()
}

/// Asserts that a file is refused with a message that holds each part.
#[track_caller]
fn refused(file: &Path, toml: &str, parts: &[&str]) {
    let Err(error) = try_open(file, toml) else { panic!("accepted with {toml:?}") };
    let message = error.to_string();
    for part in parts {
        assert!(message.contains(part), "{toml:?}: `{part}` is missing in: {message}");
    }
}

/// Address space of a program that inspects a bomb, kB: a third of it is the program itself.
const MEMORY: u64 = 1_500_000;

/// Inspects one file within [`MEMORY`].
fn inspected(path: &Path) -> (Outcome, Duration) {
    let command = format!("ulimit -v {MEMORY}; exec {} inspect {}", env!("CARGO_BIN_EXE_ridgewatch"), path.display());
    let begin = Instant::now();
    let outcome = run(Command::new("sh").args(["-c", &command]).env_remove("RIDGEWATCH_RING"));
    (outcome, begin.elapsed())
}

/// Three coordinates of two nodes, and datasets `v` and `w`.
fn without_u(path: &Path) -> File {
    let file = File::create(path).unwrap();
    for name in ["x", "y", "z"] {
        file.new_dataset_builder().with_data(&[0.0f64, 1.0]).create(name).unwrap();
    }
    file.new_attr::<f64>().create("time").unwrap().write_scalar(&0.0).unwrap();
    for name in ["v", "w"] {
        file.new_dataset_builder().with_data(&Array3::<f32>::zeros((2, 2, 2))).create(name).unwrap();
    }
    file
}

/// A file beside the archive, and its first eight numbers.
fn secret(folder: &Path) -> (PathBuf, Vec<f32>) {
    let path = folder.join("secret");
    let values: Vec<f32> = (0..8u8).map(|i| f32::from(i) + 0.5).collect();
    std::fs::write(&path, values.iter().flat_map(|v| v.to_le_bytes()).collect::<Vec<_>>()).unwrap();
    (path, values)
}

#[test]
fn external_storage_is_refused_unless_allowed() {
    let _alone = alone();
    let dir = tempdir().unwrap();
    let (other, values) = secret(dir.path());
    let path = dir.path().join("external.h5");
    let file = without_u(&path);
    file.new_dataset::<f32>().shape((2, 2, 2)).external(other.to_str().unwrap(), 0, 32).create("u").unwrap();
    drop(file);
    refused(&path, "", &["external.h5", "`u`", "secret", "external = true"]);
    assert_eq!(us(&open_with(&path, "external = true").read(0).unwrap()), values);
}

#[test]
fn virtual_datasets_are_refused_unless_allowed() {
    let _alone = alone();
    let dir = tempdir().unwrap();
    let other = dir.path().join("other.h5");
    let values = Array3::from_shape_fn((2, 2, 2), |(z, y, x)| (4 * z + 2 * y + x) as f32);
    File::create(&other).unwrap().new_dataset_builder().with_data(&values).create("there").unwrap();
    let path = dir.path().join("virtual.h5");
    let file = without_u(&path);
    let builder = file.new_dataset::<f32>().shape((2, 2, 2));
    builder.virtual_map(other.to_str().unwrap(), "there", (2, 2, 2), .., (2, 2, 2), ..).create("u").unwrap();
    drop(file);
    refused(&path, "", &["virtual.h5", "`u`", "other.h5", "external = true"]);
    assert_eq!(us(&open_with(&path, "external = true").read(0).unwrap()), values.into_iter().collect::<Vec<_>>());
}

#[test]
fn links_to_other_files_are_refused_unless_allowed() {
    let _alone = alone();
    let dir = tempdir().unwrap();
    let other = dir.path().join("other.h5");
    let values = Array3::from_shape_fn((2, 2, 2), |(z, y, x)| (4 * z + 2 * y + x) as f32);
    File::create(&other).unwrap().new_dataset_builder().with_data(&values).create("there").unwrap();
    let path = dir.path().join("linked.h5");
    let file = without_u(&path);
    file.link_external(other.to_str().unwrap(), "there", "u").unwrap();
    drop(file);
    refused(&path, "", &["linked.h5", "`u`", "links to another file", "external = true"]);
    assert_eq!(us(&open_with(&path, "external = true").read(0).unwrap()), values.into_iter().collect::<Vec<_>>());
    // A name that leads to the link by a way around is no way around.
    let path = dir.path().join("linked.nc");
    plane(NETCDF4, &[0.0], "days since 2000-01-01").write(&path);
    let file = File::append(&path).unwrap();
    file.link_external(other.to_str().unwrap(), "there", "u2").unwrap();
    file.link_soft("u2", "u3").unwrap();
    drop(file);
    refused(&path, "", &["linked.nc", "`u2`", "links to another file"]);
}

/// A NetCDF-4 file of `n` x `n` nodes at one time, of which no velocity was ever written.
fn unwritten(path: &Path, n: usize) {
    hdf5_metno::silence_errors(true);
    let mut file = netcdf::create_with(path, netcdf::Options::NETCDF4).unwrap();
    let lengths = [("time", 1), ("y", n), ("x", n)];
    for (name, length) in lengths {
        file.add_dimension(name, length).unwrap();
        let mut axis = file.add_variable::<f32>(name, &[name]).unwrap();
        axis.put_attribute("units", if name == "time" { "days since 2000-01-01" } else { "m" }).unwrap();
        axis.set_compression(9, true).unwrap();
        axis.put_values(&(0..length).map(|i| i as f32).collect::<Vec<_>>(), ..).unwrap();
    }
    for name in ["u", "v"] {
        let mut wind = file.add_variable::<f32>(name, &["time", "y", "x"]).unwrap();
        wind.set_chunking(&[1, 1000, 1000]).unwrap();
        wind.set_compression(1, false).unwrap();
        wind.put_attribute("units", "m/s").unwrap();
    }
    file.close().unwrap();
}

#[test]
fn fields_that_a_file_cannot_hold_cost_no_memory() {
    let _alone = alone();
    let dir = tempdir().unwrap();
    for n in [30_000, 100_000] {
        let path = dir.path().join(format!("claims_{n}.nc"));
        unwritten(&path, n);
        let (outcome, _) = inspected(&path);
        let total = n * n;
        outcome.refused(1, &[&format!("claims_{n}.nc"), "`u`", &format!("{total} values cannot come from a file of")]);
    }
}

/// Adds a dataset of 2 x 2 x 2 nodes with two deflate filters, which the binding would refuse.
fn compressed_twice(file: &File, name: &str) {
    unsafe extern "C" {
        fn H5Pset_deflate(plist: i64, level: u32) -> i32;
        fn H5Dcreate2(place: i64, name: *const std::ffi::c_char, kind: i64, space: i64, link: i64, created: i64, access: i64) -> i64;
        fn H5Dclose(dataset: i64) -> i32;
    }
    let created = hdf5_metno::plist::DatasetCreate::build().chunk((2, 2, 2)).deflate(9).finish().unwrap();
    let kind = hdf5_metno::Datatype::from_type::<f32>().unwrap();
    let space = hdf5_metno::Dataspace::try_new((2, 2, 2)).unwrap();
    let name = std::ffi::CString::new(name).unwrap();
    // SAFETY: open objects and a string that ends in NUL; no other test uses the library meanwhile.
    let made = unsafe {
        assert!(H5Pset_deflate(created.id(), 9) >= 0);
        H5Dclose(H5Dcreate2(file.id(), name.as_ptr(), kind.id(), space.id(), 0, created.id(), 0))
    };
    assert!(made >= 0);
}

#[test]
fn fields_larger_than_the_memory_allowed_are_refused() {
    let _alone = alone();
    let dir = tempdir().unwrap();
    // 64 MiB of zeros, a thousandth of that in the file.
    let path = dir.path().join("deep.h5");
    let file = File::create(&path).unwrap();
    for (name, n) in [("x", 256), ("y", 256), ("z", 64)] {
        file.new_dataset_builder().with_data(&Array1::<f32>::range(0.0, n as f32, 1.0)).create(name).unwrap();
    }
    file.new_attr::<f64>().create("time").unwrap().write_scalar(&0.0).unwrap();
    let still = Array3::<f32>::zeros((64, 256, 256));
    for name in ["u", "v", "w"] {
        file.new_dataset_builder().chunk((8, 256, 256)).deflate(9).with_data(&still).create(name).unwrap();
    }
    drop(file);
    assert!(std::fs::metadata(&path).unwrap().len() < 100_000);
    refused(&path, "memory_gib = 0.1", &["deep.h5", "4194304 nodes", "archive.memory_gib", "0.1"]);
    assert_eq!(open_with(&path, "memory_gib = 0.5").grid().nodes(), 1 << 22);
    // Compressed twice, a chunk of a few bytes may unpack to a million times as many.
    let path = dir.path().join("twice.h5");
    let file = without_u(&path);
    compressed_twice(&file, "u");
    drop(file);
    refused(&path, "", &["twice.h5", "`u`", "compressed 2 times"]);
    // A chunk is unpacked as a whole, however little of it is read.
    let path = dir.path().join("chunk.h5");
    let file = without_u(&path);
    let builder = file.new_dataset::<f32>().shape((2.., 2.., 2..)).chunk((1, 4096, 4096)).deflate(9);
    builder.create("u").unwrap().write(&Array3::<f32>::zeros((2, 2, 2))).unwrap();
    drop(file);
    let message = open_with(&path, "memory_gib = 0.1").read(0).unwrap_err().to_string();
    for part in ["chunk.h5", "`u`", "its chunks of 67108864 bytes", "archive.memory_gib"] {
        assert!(message.contains(part), "{message}");
    }
}

#[test]
fn dimensions_and_coordinates_are_bounded() {
    let _alone = alone();
    let dir = tempdir().unwrap();
    hdf5_metno::silence_errors(true);
    // A dimension of 2^40 entries that nothing was ever written along.
    let path = dir.path().join("dimension.nc");
    let mut file = netcdf::create_with(&path, netcdf::Options::NETCDF4).unwrap();
    for (name, length) in [("time", 1), ("y", 2), ("x", 1 << 40)] {
        file.add_dimension(name, length).unwrap();
    }
    file.add_variable::<f32>("time", &["time"]).unwrap().put_values(&[0.0f32], ..).unwrap();
    for name in ["u", "v"] {
        let mut wind = file.add_variable::<f32>(name, &["time", "y", "x"]).unwrap();
        wind.set_chunking(&[1, 1, 1000]).unwrap();
        wind.put_attribute("units", "m/s").unwrap();
    }
    file.close().unwrap();
    inspected(&path).0.refused(1, &["dimension.nc", "values cannot come from a file of"]);
    // Longitudes of two dimensions that were never written.
    let path = dir.path().join("mesh.nc");
    let n = 30_000;
    let mut file = netcdf::create_with(&path, netcdf::Options::NETCDF4).unwrap();
    for (name, length) in [("time", 1), ("y", n), ("x", n)] {
        file.add_dimension(name, length).unwrap();
    }
    file.add_variable::<f32>("time", &["time"]).unwrap().put_values(&[0.0f32], ..).unwrap();
    for (name, units) in [("lon", "degrees_east"), ("lat", "degrees_north"), ("u", "m/s"), ("v", "m/s")] {
        let mut variable = file.add_variable::<f32>(name, &["time", "y", "x"]).unwrap();
        variable.set_chunking(&[1, 1000, 1000]).unwrap();
        variable.put_attribute("units", units).unwrap();
    }
    file.close().unwrap();
    inspected(&path).0.refused(1, &["mesh.nc", "values cannot come from a file of"]);
}

/// Groups in each other, `depth` of them.
fn nested(path: &Path, depth: usize) {
    let file = File::create(path).unwrap();
    let mut group: Group = file.create_group("g").unwrap();
    for _ in 1..depth {
        group = group.create_group("g").unwrap();
    }
}

#[test]
fn groups_and_datasets_are_counted_before_a_library_reads_them() {
    let _alone = alone();
    let dir = tempdir().unwrap();
    let quick = |path: &Path, parts: &[&str]| {
        let (outcome, took) = inspected(path);
        outcome.refused(1, &[parts, &[path.file_name().unwrap().to_str().unwrap()]].concat());
        // A few milliseconds; the machine may be slow and busy.
        assert!(took < Duration::from_secs(5), "{took:?}");
    };
    let deep = dir.path().join("deep.h5");
    nested(&deep, 20_000);
    quick(&deep, &["nested more than 64 deep"]);
    let wide = dir.path().join("wide.h5");
    let file = File::create(&wide).unwrap();
    (0..10_001).for_each(|i| drop(file.create_group(&format!("g{i}")).unwrap()));
    drop(file);
    quick(&wide, &["more than 10000 groups and variables"]);
    // Ten names for the root in itself: 10^64 ways.
    let circle = dir.path().join("circle.h5");
    let file = File::create(&circle).unwrap();
    (0..10).for_each(|i| file.link_hard("/", &format!("again{i}")).unwrap());
    drop(file);
    quick(&circle, &["nested more than 64 deep"]);
    // A soft link to the root.
    let soft = dir.path().join("soft.h5");
    File::create(&soft).unwrap().link_soft("/", "again").unwrap();
    quick(&soft, &["nested more than 64 deep"]);
}

#[test]
fn attributes_are_bounded() {
    let _alone = alone();
    let dir = tempdir().unwrap();
    // Many names for one dataset of many attributes, which a library would read once for each name.
    for (length, said) in [(1, "more than 100000 attributes"), (7000, "more than 16 MiB of attributes")] {
        let path = dir.path().join(format!("many_{length}.nc"));
        plane(NETCDF4, &[0.0], "days since 2000-01-01").write(&path);
        let file = File::append(&path).unwrap();
        let dataset = file.dataset("u").unwrap();
        (0..200).for_each(|i| dataset.new_attr::<f64>().shape(length).create(format!("a{i}").as_str()).map(drop).unwrap());
        (0..1000).for_each(|i| file.link_hard("u", &format!("u{i}")).unwrap());
        drop((dataset, file));
        let (outcome, took) = inspected(&path);
        outcome.refused(1, &[&format!("many_{length}.nc"), said]);
        assert!(took < Duration::from_secs(5), "{took:?}");
    }
}

#[test]
fn windows_larger_than_the_memory_allowed_are_refused() {
    let _alone = alone();
    let dir = tempdir().unwrap();
    let path = plane(NETCDF4, &[0.0, 1.0, 2.0, 3.0, 4.0], "days since 2000-01-01").write(&dir.path().join("window.nc"));
    let outcome = |gib: &str| {
        let tau = ["--set", "time.tau=259200", "--grid", "5x5", "--set", &format!("archive.memory_gib={gib}")].map(str::to_owned);
        run(ridgewatch(["ftle", path.to_str().unwrap()]).args(tau))
    };
    outcome("0.01").success();
    // 751 bytes, more than a snapshot of 12 nodes needs and less than the five that are held.
    outcome("0.0000007").refused(2, &["archive.memory_gib", "for the window"]);
}
