//! Archives of every format and grid: the snapshots that they give, the reasons for which they are refused, and fields traced in them.
#![allow(clippy::unwrap_used, clippy::print_stdout)] // Tests: a panic is the report.

mod curvilinear;
mod followed;
mod grib;
mod hdf5;
mod heights;
mod hemispheres;
mod http;
mod hybrid;
mod integrated;
#[path = "../kit/mod.rs"]
mod kit;
mod land;
mod netcdf;
mod odd;
mod own_axes;
mod parts;
mod real;
mod refined;
mod refused;
mod resampled;
mod round_trip;
mod terrain;
mod turned;
mod unstructured;
mod zarr;

use ridgewatch::source::{Archive, ArchiveSettings, Inspection, SnapshotSource, SourceError, inspect};
use std::path::{Path, PathBuf};

const DAYS: &str = "days since 2000-01-01";
const HOURS: &str = "hours since 2000-01-01";

fn settings(toml: &str) -> ArchiveSettings {
    toml::from_str(toml).unwrap()
}

fn try_open(files: &[impl AsRef<Path>], toml: &str) -> Result<Archive, SourceError> {
    let files: Vec<PathBuf> = files.iter().map(|file| file.as_ref().to_owned()).collect();
    Archive::open(&files, &settings(toml))
}

/// Opens files as one archive with these settings.
fn open_with(files: &[impl AsRef<Path>], toml: &str) -> Archive {
    try_open(files, toml).unwrap()
}

/// Opens files as one archive with the default settings.
fn open(files: &[impl AsRef<Path>]) -> Archive {
    open_with(files, "")
}

/// Asserts that files are refused, with a message that holds each piece.
#[track_caller]
fn refused(files: &[impl AsRef<Path>], toml: &str, pieces: &[&str]) -> SourceError {
    let error = match try_open(files, toml) {
        Ok(archive) => panic!("accepted with {toml:?}: {:?}", archive.describe()),
        Err(error) => error,
    };
    let message = error.to_string();
    for piece in pieces {
        assert!(message.contains(piece), "{toml:?}: `{piece}` is missing in: {message}");
    }
    error
}

/// Asserts that two archives are the same: grid, times, and each number of each snapshot.
#[track_caller]
fn same(found: &mut Archive, expected: &mut Archive, what: &str) {
    let coordinates = |archive: &Archive| archive.grid().axes.iter().map(|axis| axis.coordinates().to_vec()).collect::<Vec<_>>();
    assert_eq!(coordinates(found), coordinates(expected), "{what}");
    assert_eq!(found.grid().geometry, expected.grid().geometry, "{what}");
    assert_eq!(found.seconds(), expected.seconds(), "{what}");
    assert!(!expected.times().is_empty());
    for index in 0..expected.times().len() {
        let bits = |archive: &mut Archive| -> Vec<[u32; 4]> {
            archive.read(index).unwrap().nodes.iter().map(|node| node.map(f32::to_bits)).collect()
        };
        let (found, expected) = (bits(found), bits(expected));
        let other = found.iter().zip(&expected).position(|(found, expected)| found != expected);
        assert_eq!((found.len(), other), (expected.len(), None), "{what}, snapshot {index}");
    }
}

/// Inspects files with the default settings.
fn inspected(files: &[impl AsRef<Path>]) -> Inspection {
    let files: Vec<PathBuf> = files.iter().map(|file| file.as_ref().to_owned()).collect();
    inspect(&files, &ArchiveSettings::default(), 1, None).unwrap()
}

fn notes(archive: &Archive) -> String {
    archive.describe().notes.join("\n")
}
