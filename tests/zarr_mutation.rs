//! Damaged Zarr stores: each gives snapshots or an error that names the store. No panic, no hang, no more memory than `archive.memory_gib`
//! allows. The test measures the memory of its process, which therefore runs nothing else.
#![allow(clippy::unwrap_used, clippy::print_stdout)] // Tests: a panic is the report.
#![cfg(target_os = "linux")]

mod kit;

use kit::grids::{Ocean, Wrf, packed_levels};
use kit::mutants::{mutant, random};
use kit::netcdf::CLASSIC;
use kit::zarr::{Layout, Pack, V2, V3, parts, write_parts, zipped};
use ridgewatch::source::{Archive, ArchiveSettings, SnapshotSource, inspect};
use std::path::Path;
use std::time::{Duration, Instant};

/// Memory that reading may need, in MiB.
const MEMORY: u64 = 64;

#[test]
fn mutated_stores_are_answered() {
    // RIDGEWATCH_MUTATIONS=10000 for a long run.
    let count: u64 = std::env::var("RIDGEWATCH_MUTATIONS").ok().and_then(|n| n.parse().ok()).unwrap_or(3000);
    let dir = tempfile::tempdir().unwrap();
    let settings = ArchiveSettings { memory_gib: Some(MEMORY as f64 / 1024.0), ..ArchiveSettings::default() };
    let mut state = 1;
    let mut longest = Duration::ZERO;
    let before = peak();
    let cut: &[(&str, usize)] = &[("time", 1), ("level", 2), ("latitude", 3), ("longitude", 3), ("y", 5), ("bottom_top", 2)];
    let levels = || packed_levels(CLASSIC, &[850.0, 500.0, 700.0], 0.0);
    let staggered = || Wrf { format: CLASSIC, ..Wrf::default() }.fixture();
    let mesh = || Ocean { format: CLASSIC, n: 9, ..Ocean::default() }.fixture();
    let cases = [
        ("version 2, blosc", levels(), Layout { pack: Pack::Blosc, chunks: cut, ..V2 }),
        ("version 2, consolidated, zlib", mesh(), Layout { pack: Pack::Zlib, chunks: cut, consolidated: true, ..V2 }),
        ("version 2, gzip", staggered(), Layout { pack: Pack::Gzip, chunks: cut, ..V2 }),
        ("version 2, lz4", mesh(), Layout { pack: Pack::Lz4, chunks: cut, big_endian: true, turned: true, ..V2 }),
        ("version 3, zstd", staggered(), Layout { pack: Pack::Zstd, chunks: cut, ..V3 }),
        ("version 3, consolidated, shards", levels(), Layout { pack: Pack::Zstd, chunks: cut, shards: 2, consolidated: true, ..V3 }),
        ("version 3, shards", mesh(), Layout { pack: Pack::Blosc, chunks: cut, shards: 2, ..V3 }),
    ];
    let share = count.div_ceil(2 * cases.len() as u64);
    for (name, fixture, layout) in cases {
        let whole = parts(&fixture, &layout);
        for zip in [false, true] {
            let path = dir.path().join(if zip { "mutant.zip" } else { "mutant.zarr" });
            let packed = zipped(&whole, "", false);
            if zip {
                std::fs::write(&path, &packed).unwrap();
            } else {
                write_parts(&whole, &path);
            }
            assert!(Archive::open(std::slice::from_ref(&path), &settings).is_ok(), "{name}");
            let (mut read, mut failed, mut refused) = (0, 0, 0);
            for _ in 0..share {
                // Half of the mutants have damaged metadata, the others chunks.
                let metadata = random(&mut state).is_multiple_of(2);
                let chosen: Vec<usize> = (0..whole.len()).filter(|&i| whole[i].0.contains("z") == metadata).collect();
                let (part, data) = &whole[chosen[random(&mut state) as usize % chosen.len()]];
                let place = if zip { path.clone() } else { path.join(part) };
                let original = if zip { &packed } else { data };
                let every: Vec<usize> = (0..original.len()).collect();
                std::fs::remove_file(&place).unwrap();
                std::fs::write(&place, mutant(original, &every, &mut state)).unwrap();
                let begin = Instant::now();
                match answered(&path, &settings) {
                    Some(true) => read += 1,
                    Some(false) => failed += 1,
                    None => refused += 1,
                }
                longest = longest.max(begin.elapsed());
                assert!(begin.elapsed() < Duration::from_secs(60), "{name}: {part} took {:?}", begin.elapsed());
                std::fs::remove_file(&place).unwrap();
                std::fs::write(&place, original).unwrap();
            }
            let kind = if zip { "zip" } else { "folder" };
            println!("{name}, {kind}: {share} mutants: {read} read, {failed} with an unreadable snapshot, {refused} refused");
            assert!(read > 0 && refused > 0, "mutations must reach both ends");
            if zip { std::fs::remove_file(&path).unwrap() } else { std::fs::remove_dir_all(&path).unwrap() }
        }
    }
    // Metadata that take most memory for their length, almost as many as are accepted.
    let list = format!("{{\"zarr_format\": 3, \"node_type\": \"group\", \"attributes\": {{\"a\": [{}0]}}}}", "{\"\":0},".repeat(70_000));
    let store = write_parts(&parts(&levels(), &V3), &dir.path().join("objects.zarr"));
    std::fs::write(store.join("zarr.json"), list).unwrap();
    let mutants = peak() - before;
    assert_eq!(answered(&store, &settings), Some(true));
    println!("{} MB more for mutants, {} MB for metadata", mutants >> 20, (peak() - before) >> 20);
    let grown = (peak() - before) >> 20;
    println!("{longest:.1?} at most, {grown} MB more at most than before");
    assert!(grown < MEMORY + 14, "{grown}");
}

/// Whether all snapshots of a store can be read; `None` if it cannot be opened.
fn answered(path: &Path, settings: &ArchiveSettings) -> Option<bool> {
    let files = [path.to_owned()];
    let name = path.file_name().unwrap().to_str().unwrap();
    if let Ok(inspection) = inspect(&files, settings, 1, None) {
        assert!(inspection.to_string().contains(name));
    }
    match Archive::open(&files, settings) {
        Ok(mut archive) => {
            let mut whole = true;
            // Times of chunks that are not stored are the fill value, which repeats: there are no more than chunks.
            assert!(archive.times().len() < 100, "{} times", archive.times().len());
            for index in 0..archive.times().len() {
                match archive.read(index) {
                    Ok(snapshot) => assert_eq!(snapshot.nodes.len(), archive.grid().nodes()),
                    Err(error) => {
                        assert!(error.to_string().contains(name), "names no file: {error}");
                        whole = false;
                    }
                }
            }
            Some(whole)
        }
        Err(error) => {
            assert!(error.to_string().contains(name), "names no file: {error}");
            None
        }
    }
}

/// Peak memory of this process in bytes. `getrusage` would begin at the peak of the process that started this one.
fn peak() -> u64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap();
    let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:")).unwrap();
    line.trim().strip_suffix(" kB").unwrap().parse::<u64>().unwrap() * 1024
}
