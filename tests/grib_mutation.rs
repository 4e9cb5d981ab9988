//! Damaged GRIB files: each gives snapshots or an error that names the file. No panic, no hang, no more memory than `archive.memory_gib`
//! allows. The test measures the memory of its process, which therefore runs nothing else.
#![allow(clippy::unwrap_used, clippy::print_stdout)] // Tests: a panic is the report.
#![cfg(target_os = "linux")]

mod kit;

use kit::grib::{ISOBARIC, Message, U, V, cone, real};
use kit::mutants::mutant;
use ridgewatch::source::{Archive, ArchiveSettings, SnapshotSource, inspect};
use std::path::Path;
use std::time::{Duration, Instant};

/// Memory that reading may need, in MiB.
const MEMORY: u64 = 64;

#[test]
fn mutated_files_are_answered() {
    // RIDGEWATCH_MUTATIONS=100000 for a long run.
    let count: u64 = std::env::var("RIDGEWATCH_MUTATIONS").ok().and_then(|n| n.parse().ok()).unwrap_or(6000);
    let dir = tempfile::tempdir().unwrap();
    let file = dir.path().join("mutant.grib");
    let settings = ArchiveSettings { memory_gib: Some(MEMORY as f64 / 1024.0), ..ArchiveSettings::default() };
    let mut cases = vec![("edition 1", winds(1)), ("edition 2", winds(2))];
    cases.extend(real().into_iter().map(|(name, [u, v])| (name, [u, v].concat())));
    let share = count.div_ceil(cases.len() as u64);
    let mut state = 1;
    let mut longest = Duration::ZERO;
    let before = peak();
    for (name, whole) in cases {
        std::fs::write(&file, &whole).unwrap();
        assert_eq!(answered(&file, &settings), Some(true), "{name}");
        let (mut read, mut failed, mut refused) = (0, 0, 0);
        let every: Vec<usize> = (0..whole.len()).collect();
        for _ in 0..share {
            // A new file: some file systems flush one that is overwritten.
            std::fs::remove_file(&file).unwrap();
            std::fs::write(&file, mutant(&whole, &every, &mut state)).unwrap();
            let begin = Instant::now();
            match answered(&file, &settings) {
                Some(true) => read += 1,
                Some(false) => failed += 1,
                None => refused += 1,
            }
            longest = longest.max(begin.elapsed());
            // A millisecond's work; the machine may be slow and busy.
            assert!(begin.elapsed() < Duration::from_secs(60), "{name} took {:?}", begin.elapsed());
        }
        println!("{name}, {} bytes: {share} mutants: {read} read, {failed} with an unreadable snapshot, {refused} refused", whole.len());
        assert!(read > 0 && refused > 0, "mutations must reach both ends");
    }
    let grown = (peak() - before) >> 20;
    println!("{longest:.1?} at most, {grown} MB more at most than before");
    assert!(grown < MEMORY + 14, "{grown}");
}

/// Two components on two levels at two times; some values are missing.
fn winds(edition: u8) -> Vec<u8> {
    let field = |k: usize| Message {
        edition,
        parameter: [U, V][k % 2],
        level: (ISOBARIC, [500.0, 850.0][k / 2 % 2]),
        hour: k as u8 / 4,
        step: 6,
        member: None,
        longitudes: (0.0, 30.0, 4),
        latitudes: (50.0, 30.0, 3),
        order: if edition == 1 { 0x30 } else { 0 },
        values: (0..12).map(|i| if i == 7 && k > 3 { f64::NAN } else { ((i * 5 + k * 3) % 16) as f64 / 4.0 }).collect(),
        bits: 9,
        plane: (edition == 2).then(|| cone(k.is_multiple_of(2))),
    };
    (0..8).flat_map(|k| field(k).bytes()).collect()
}

/// Whether all snapshots of a file can be read; `None` if it cannot be opened.
fn answered(path: &Path, settings: &ArchiveSettings) -> Option<bool> {
    let files = [path.to_owned()];
    if let Ok(inspection) = inspect(&files, settings, 1, None) {
        assert!(inspection.to_string().contains("mutant.grib"));
    }
    match Archive::open(&files, settings) {
        Ok(mut archive) => {
            let mut whole = true;
            assert!(archive.times().len() <= 8, "{} times", archive.times().len());
            for index in 0..archive.times().len() {
                match archive.read(index) {
                    Ok(snapshot) => assert_eq!(snapshot.nodes.len(), archive.grid().nodes()),
                    Err(error) => {
                        assert!(error.to_string().contains("mutant.grib"), "names no file: {error}");
                        whole = false;
                    }
                }
            }
            Some(whole)
        }
        Err(error) => {
            assert!(error.to_string().contains("mutant.grib"), "names no file: {error}");
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
