//! Damaged classic files: whatever the bytes, an answer or an error, no panic, no hang, no memory beyond the file's size.
//!
//! NetCDF-4 is left out: there the bytes are read by libhdf5, whose C code may crash on a damaged file by itself.
#![allow(clippy::unwrap_used, clippy::print_stdout)] // Tests: a panic is the report.

mod netcdf_fixture;

use netcdf_fixture::*;
use ridgewatch::source::{NetCdfArchive, NetCdfSettings, SnapshotSource, inspect};
use std::time::{Duration, Instant};

/// SplitMix64.
fn random(state: &mut u64) -> u64 {
    *state = state.wrapping_add(0x9e37_79b9_7f4a_7c15);
    let z = (*state ^ (*state >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    let z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    z ^ (z >> 31)
}

#[test]
fn mutated_files_are_answered() {
    // RIDGEWATCH_MUTATIONS=100000 for a long run.
    let count: u64 = std::env::var("RIDGEWATCH_MUTATIONS").ok().and_then(|n| n.parse().ok()).unwrap_or(3000);
    let dir = tempfile::tempdir().unwrap();
    let file = dir.path().join("mutant.nc");
    let mut state = 1;
    let mut longest = Duration::ZERO;
    let before = peak();
    for options in [CLASSIC, OFFSET_64, DATA_64] {
        // With a record dimension, packing and text attributes.
        let whole = Fixture::new(options, &[("time", 0), ("lat", 3), ("lon", 4)])
            .axis("lon", "degrees_east", &[0.0, 90.0, 180.0, 270.0])
            .axis("lat", "degrees_north", &[30.0, 20.0, 10.0])
            .axis("time", "days since 2000-01-01 00:00:00 +01:00", &[0.0, 1.0, 2.0])
            .variable("u", &["time", "lat", "lon"], Data::I16((0..36).collect()))
            .with("scale_factor", 0.5)
            .with("valid_range", vec![-5i16, 30])
            .with("units", "m s-1")
            .variable("v", &["time", "lat", "lon"], Data::I16((0..36).collect()))
            .with("units", "m s-1")
            .write(&file);
        let whole = std::fs::read(whole).unwrap();
        assert!(NetCdfArchive::open(std::slice::from_ref(&file), &NetCdfSettings::default()).is_ok());
        let (mut read, mut refused) = (0, 0);
        for _ in 0..count / 3 {
            let mut bytes = whole.clone();
            for _ in 0..1 + random(&mut state) % 4 {
                let at = random(&mut state) as usize % bytes.len();
                bytes[at] = match random(&mut state) % 4 {
                    0 => 0,
                    1 => 0xff,
                    2 => bytes[at] ^ (1 << (random(&mut state) % 8)),
                    _ => random(&mut state) as u8,
                };
            }
            if random(&mut state).is_multiple_of(8) {
                bytes.truncate(random(&mut state) as usize % (bytes.len() + 1));
            }
            // A new file: some file systems flush one that is overwritten.
            std::fs::remove_file(&file).unwrap();
            std::fs::write(&file, &bytes).unwrap();
            let begin = Instant::now();
            match NetCdfArchive::open(std::slice::from_ref(&file), &NetCdfSettings::default()) {
                Ok(mut archive) => {
                    read += 1;
                    assert!(archive.times().len() <= whole.len(), "bounded by the file");
                    for index in 0..archive.times().len() {
                        if let Ok(snapshot) = archive.read(index) {
                            assert_eq!(snapshot.nodes.len(), archive.grid().nodes());
                        }
                        let _ = archive.date(archive.times()[index]);
                    }
                }
                Err(error) => {
                    refused += 1;
                    assert!(!error.to_string().is_empty());
                }
            }
            if let Ok(inspection) = inspect(std::slice::from_ref(&file), &NetCdfSettings::default(), None) {
                assert!(inspection.to_string().contains("mutant.nc"));
            }
            // A millisecond's work; the machine may be busy.
            longest = longest.max(begin.elapsed());
            assert!(begin.elapsed() < Duration::from_secs(10), "took {:?}", begin.elapsed());
        }
        println!("{} mutants: {read} read, {refused} refused", count / 3);
        assert!(read > 0 && refused > 0, "mutations must reach both ends");
    }
    let grown = peak() - before;
    println!("{longest:.1?} at most, {} MB more at most than before", grown >> 20);
    // 2^20 values may be read from any file (see `Container::read`), of three components as f64, f32 and nodes.
    assert!(grown < 200 << 20, "{grown}");
}

/// Bytes that this process had in memory at most.
fn peak() -> u64 {
    // SAFETY: plain numbers, of which zeros are values, filled in by the call.
    let usage = unsafe {
        let mut usage: libc::rusage = std::mem::zeroed();
        assert_eq!(libc::getrusage(libc::RUSAGE_SELF, &raw mut usage), 0);
        usage
    };
    usage.ru_maxrss as u64 * 1024
}
