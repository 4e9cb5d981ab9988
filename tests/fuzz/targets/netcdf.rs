//! A classic NetCDF file of any bytes gives snapshots or an error: no panic, no memory for data that it only claims to hold. NetCDF-4 files are left out,
//! since the C code of libhdf5 reads them.
#![no_main]

mod support;

use libfuzzer_sys::fuzz_target;
use ridgewatch::source::{Archive, ArchiveSettings, SnapshotSource, inspect};
use std::path::PathBuf;
use std::sync::OnceLock;

const DIMENSION: u32 = 10;
const VARIABLE: u32 = 11;
const ATTRIBUTE: u32 = 12;
const CHAR: u32 = 2;
const DOUBLE: u32 = 6;

fn word(to: &mut Vec<u8>, number: u32) {
    to.extend(number.to_be_bytes());
}

/// A text with its length, padded to whole words.
fn text(to: &mut Vec<u8>, text: &str) {
    word(to, text.len() as u32);
    to.extend(text.as_bytes());
    to.resize(to.len().next_multiple_of(4), 0);
}

/// A file of version 1 with u and v on times, latitudes and longitudes.
fn good() -> Vec<u8> {
    let dimensions = [("time", 2u32), ("lat", 3), ("lon", 4)];
    let axis = |first: f64, step: f64, count: u32| (0..count).map(|i| first + step * f64::from(i)).collect::<Vec<_>>();
    let variables = [
        ("time", vec![0u32], "days since 2000-01-01", axis(0.0, 1.0, 2)),
        ("lat", vec![1], "degrees_north", axis(10.0, 10.0, 3)),
        ("lon", vec![2], "degrees_east", axis(0.0, 90.0, 4)),
        ("u", vec![0, 1, 2], "m s-1", axis(0.0, 0.5, 24)),
        ("v", vec![0, 1, 2], "m s-1", axis(5.0, -0.25, 24)),
    ];
    // Twice: the first header shows how long it is.
    let mut begin = 0;
    loop {
        let mut bytes = b"CDF\x01".to_vec();
        word(&mut bytes, 0);
        for number in [DIMENSION, dimensions.len() as u32] {
            word(&mut bytes, number);
        }
        for (name, length) in dimensions {
            text(&mut bytes, name);
            word(&mut bytes, length);
        }
        // No global attributes.
        for number in [0, 0, VARIABLE, variables.len() as u32] {
            word(&mut bytes, number);
        }
        let mut place = begin;
        for (name, axes, unit, values) in &variables {
            text(&mut bytes, name);
            word(&mut bytes, axes.len() as u32);
            axes.iter().for_each(|axis| word(&mut bytes, *axis));
            for number in [ATTRIBUTE, 1] {
                word(&mut bytes, number);
            }
            text(&mut bytes, "units");
            word(&mut bytes, CHAR);
            text(&mut bytes, unit);
            for number in [DOUBLE, 8 * values.len() as u32, place] {
                word(&mut bytes, number);
            }
            place += 8 * values.len() as u32;
        }
        if begin as usize == bytes.len() {
            bytes.extend(variables.iter().flat_map(|(.., values)| values).flat_map(|value| value.to_be_bytes()));
            return bytes;
        }
        begin = bytes.len() as u32;
    }
}

/// The file that each input is written to; `make fuzz` chooses its folder.
fn place() -> PathBuf {
    std::env::temp_dir().join(format!("rw-fuzz-{}.nc", std::process::id()))
}

fuzz_target!(|input: &[u8]| {
    static GOOD: OnceLock<(Vec<u8>, PathBuf)> = OnceLock::new();
    let (good, path) = GOOD.get_or_init(|| {
        let (good, path) = (good(), place());
        std::fs::write(&path, &good).expect("a temporary file");
        let opened = Archive::open(std::slice::from_ref(&path), &ArchiveSettings::default());
        assert_eq!(opened.expect("the good file").times().len(), 2);
        (good, path)
    });
    let bytes = support::file(good, input);
    if !bytes.starts_with(b"CDF") {
        return;
    }
    std::fs::write(path, &bytes).expect("a temporary file");
    let settings = ArchiveSettings::default();
    if let Ok(mut archive) = Archive::open(std::slice::from_ref(path), &settings) {
        assert!(archive.times().len() <= bytes.len());
        for index in 0..archive.times().len().min(64) {
            if let Ok(snapshot) = archive.read(index) {
                assert_eq!(snapshot.nodes.len(), archive.grid().nodes());
            }
            let _ = archive.date(archive.times()[index]);
        }
    }
    if let Ok(inspection) = inspect(std::slice::from_ref(path), &settings, 1, None) {
        assert!(!inspection.to_string().is_empty());
    }
});
