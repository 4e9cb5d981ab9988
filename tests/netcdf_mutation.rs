//! Damaged classic files: each gives snapshots or an error that names the file. No panic, no hang, no memory for data that a file only claims
//! to hold. The test measures the memory of its process, which therefore runs nothing else.
//!
//! NetCDF-4 files are in archive_mutation.rs, since the C code of libhdf5 may crash on a damaged file.
#![allow(clippy::unwrap_used, clippy::print_stdout)] // Tests: a panic is the report.
#![cfg(target_os = "linux")]

mod kit;

use kit::grids::{Ocean, Wrf, packed_levels};
use kit::mutants::{mutant, used};
use kit::netcdf::*;
use ridgewatch::source::{Archive, ArchiveSettings, SnapshotSource, inspect};
use std::time::{Duration, Instant};

/// Points of the mesh along both axes.
const NODES: usize = 9;

/// Values in the triangles of an unstructured mesh.
fn triangles(format: Format) -> Fixture {
    let corners: Vec<f64> = (0..(NODES - 1) * (NODES - 1))
        .map(|cell| cell / (NODES - 1) * NODES + cell % (NODES - 1) + 1)
        .flat_map(|n| [n, n + 1, n + NODES + 1, n, n + NODES + 1, n + NODES])
        .map(|n| n as f64)
        .collect();
    let faces = corners.len() / 3;
    let wave = |n: usize| (n as f64 * 0.1).sin();
    // A flow that a coarse grid carries.
    let along_x = |face: usize| (face / 2 % (NODES - 1)) as f64 + [2.0, 1.0][face % 2] / 3.0;
    let places = |k: usize| (0..NODES * NODES).map(|n| [n % NODES, n / NODES][k] as f64 + 0.1 * wave(7 * n)).collect();
    Fixture::new(format, &[("time", 2), ("face", faces), ("node", NODES * NODES), ("three", 3)])
        .axis("time", "hours since 2000-01-01", &[0.0, 1.0])
        .variable("lon", &["node"], Data::F64(places(0)))
        .with("units", "degrees_east")
        .variable("lat", &["node"], Data::F64(places(1)))
        .with("units", "degrees_north")
        .variable("nv", &["face", "three"], Data::F64(corners))
        .variable("u", &["time", "face"], Data::F64((0..2 * faces).map(|n| along_x(n % faces)).collect()))
        .with("units", "m s-1")
        .variable("v", &["time", "face"], Data::F64(vec![0.5; 2 * faces]))
        .with("units", "m s-1")
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
    // With a record dimension, packing and text attributes; then the grids that are resampled, and packed levels.
    let records = |options| {
        Fixture::new(options, &[("time", 0), ("lat", 3), ("lon", 4)])
            .axis("lon", "degrees_east", &[0.0, 90.0, 180.0, 270.0])
            .axis("lat", "degrees_north", &[30.0, 20.0, 10.0])
            .axis("time", "days since 2000-01-01 00:00:00 +01:00", &[0.0, 1.0, 2.0])
            .fields("m s-1", [("u", Data::I16((0..36).collect()))])
            .with("scale_factor", 0.5)
            .with("valid_range", vec![-5i16, 30])
            .fields("m s-1", [("v", Data::I16((0..36).collect()))])
    };
    let cases = [
        ("version 1", records(CLASSIC)),
        ("version 2", records(OFFSET_64)),
        ("version 5", records(DATA_64)),
        ("packed levels", packed_levels(OFFSET_64, &[850.0, 500.0, 700.0], 0.0)),
        ("staggered", Wrf { format: OFFSET_64, ..Wrf::default() }.fixture()),
        ("unstructured", triangles(DATA_64)),
        ("curvilinear", Ocean { format: DATA_64, n: NODES, ..Ocean::default() }.fixture()),
    ];
    let settings = ArchiveSettings::default();
    let share = count.div_ceil(cases.len() as u64);
    for (name, fixture) in cases {
        let whole = std::fs::read(fixture.write(&file)).unwrap();
        assert!(Archive::open(std::slice::from_ref(&file), &settings).is_ok());
        let used = used(&whole);
        let (mut read, mut refused) = (0, 0);
        for _ in 0..share {
            let bytes = mutant(&whole, &used, &mut state);
            // A new file: some file systems flush one that is overwritten.
            std::fs::remove_file(&file).unwrap();
            std::fs::write(&file, &bytes).unwrap();
            let begin = Instant::now();
            match Archive::open(std::slice::from_ref(&file), &settings) {
                Ok(mut archive) => {
                    read += 1;
                    assert!(archive.times().len() <= whole.len(), "bounded by the file: {name}");
                    for index in 0..archive.times().len() {
                        if let Ok(snapshot) = archive.read(index) {
                            assert_eq!(snapshot.nodes.len(), archive.grid().nodes());
                        }
                        let _ = archive.date(archive.times()[index]);
                    }
                }
                Err(error) => {
                    refused += 1;
                    assert!(error.to_string().contains("mutant.nc"), "names no file: {name}: {error}");
                }
            }
            if let Ok(inspection) = inspect(std::slice::from_ref(&file), &settings, 1, None) {
                assert!(inspection.to_string().contains("mutant.nc"));
            }
            // A millisecond's work; the machine may be slow and busy.
            longest = longest.max(begin.elapsed());
            assert!(begin.elapsed() < Duration::from_secs(60), "took {:?}", begin.elapsed());
        }
        println!("{name}, {} bytes: {share} mutants: {read} read, {refused} refused", whole.len());
        assert!(read > 0 && refused > 0, "mutations must reach both ends");
        let grown = peak() - before;
        println!("{longest:.1?} at most, {} MB more at most than before", grown >> 20);
        // Grids that a mesh is resampled to have at most 256 nodes for each of its points (docs/archives.md); two are compared, and each node
        // takes some 220 bytes (9 MB were measured).
        let refined = if ["curvilinear", "unstructured"].contains(&name) { 2 * 256 * (NODES * NODES) as u64 * 256 } else { 0 };
        // 7 MB were measured, on 3000 and on 30,000 mutants of files of 7 kB at most: pages of the program itself. 2^20 values that a file only
        // claims to hold would take 8 MB more as f64 alone.
        assert!(grown < (14 << 20) + refined, "{grown}");
    }
}

/// Peak memory of this process in bytes. `getrusage` would begin at the peak of the process that started this one.
fn peak() -> u64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap();
    let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:")).unwrap();
    line.trim().strip_suffix(" kB").unwrap().parse::<u64>().unwrap() * 1024
}
