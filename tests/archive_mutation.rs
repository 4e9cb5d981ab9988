//! Damaged NetCDF-4 and HDF5 files. Their bytes are read by libhdf5, whose C code may crash, hang or ask for any memory: each file goes to a
//! child process with limits, which must end by itself with an answer or one message.
#![allow(clippy::unwrap_used, clippy::print_stdout)] // Tests: a panic is the report.
#![cfg(target_os = "linux")]

mod netcdf_fixture;

use netcdf_fixture::*;
use ridgewatch::source::{NetCdfArchive, NetCdfSettings, SyntheticSettings, SyntheticShape, synthesize};
use std::path::Path;
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

/// SplitMix64.
fn random(state: &mut u64) -> u64 {
    *state = state.wrapping_add(0x9e37_79b9_7f4a_7c15);
    let z = (*state ^ (*state >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    let z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    z ^ (z >> 31)
}

/// Address space of a child, kB: the program and its libraries take half of it.
const MEMORY: u64 = 2_000_000;
/// Milliseconds' work; the machine may be busy.
const LONGEST: Duration = Duration::from_secs(20);

/// How a child ended.
#[derive(Debug, PartialEq, Eq, PartialOrd, Ord, Clone, Copy)]
enum End {
    Answered,
    Refused,
    /// The library crashed, and the file was named.
    Crashed,
    /// The library looped, and was given up.
    GivenUp,
    /// It did not end by itself.
    Hung,
}

fn read(files: &[&Path]) -> End {
    let files = files.iter().map(|f| f.display().to_string()).collect::<Vec<_>>().join(" ");
    // Two are traced, so that snapshots of the second are read.
    let (work, then) = if files.contains(' ') { ("ftle", "--grid 5x5 --set time.tau=7200") } else { ("inspect", "") };
    let command = format!("ulimit -v {MEMORY}; exec {} {work} {files} {then}", env!("CARGO_BIN_EXE_ridgewatch"));
    let mut child = Command::new("sh")
        .args(["-c", &command])
        .env("RIDGEWATCH_OPENING_LIMIT", "5")
        .stdout(Stdio::null())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    let begin = Instant::now();
    let status = loop {
        if let Some(status) = child.try_wait().unwrap() {
            break status;
        }
        if begin.elapsed() > LONGEST {
            child.kill().unwrap();
            child.wait().unwrap();
            return End::Hung;
        }
        std::thread::sleep(Duration::from_millis(1));
    };
    let said = std::io::read_to_string(child.stderr.take().unwrap()).unwrap();
    assert!(!said.contains("panicked"), "{said}");
    match status.code() {
        Some(0) => End::Answered,
        Some(1) => {
            if said.contains("was not opened within 5 s") {
                return End::GivenUp;
            }
            assert!(said.contains("mutant"), "names the file: {said}");
            if said.contains("crashed") { End::Crashed } else { End::Refused }
        }
        other => panic!("ended with {other:?} ({status:?}): {said}"),
    }
}

#[test]
fn mutated_files_end_in_an_answer_or_a_message() {
    // RIDGEWATCH_MUTATIONS=10000 (of each format) for a long run.
    let count: u64 = std::env::var("RIDGEWATCH_MUTATIONS").ok().and_then(|n| n.parse().ok()).unwrap_or(75);
    let dir = tempfile::tempdir().unwrap();
    let netcdf = plane(NETCDF4, &[0.0, 1.0, 2.0], "hours since 2000-01-01").write(&dir.path().join("whole.nc"));
    let small = SyntheticSettings { nodes: [4, 4, 4], snapshots: 2, ..SyntheticSettings::new(SyntheticShape::Flame) };
    let hdf5 = synthesize(&small, dir.path()).unwrap().remove(0);
    let mut state = 7;
    let mut largest = 0;
    let later = plane(NETCDF4, &[7.0], "hours since 2000-01-01").write(&dir.path().join("later.nc"));
    for (whole, mutant, other) in [(netcdf, "mutant.nc", vec![later.as_path()]), (hdf5, "mutant.h5", vec![])] {
        assert!(NetCdfArchive::open(std::slice::from_ref(&whole), &NetCdfSettings::default()).is_ok());
        let whole = std::fs::read(whole).unwrap();
        largest = largest.max(whole.len() as u64);
        let file = dir.path().join(mutant);
        // Where the file holds structure: most of it is zeros and values.
        let used: Vec<usize> = (0..whole.len()).filter(|&i| whole[i] != 0).collect();
        let mut ends = std::collections::BTreeMap::new();
        let mut longest = Duration::ZERO;
        for _ in 0..count {
            let mut bytes = whole.clone();
            for _ in 0..1 + random(&mut state) % 4 {
                let near = used[random(&mut state) as usize % used.len()] + random(&mut state) as usize % 4;
                let at = near.min(bytes.len() - 1);
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
            let _ = std::fs::remove_file(&file);
            std::fs::write(&file, &bytes).unwrap();
            let begin = Instant::now();
            // Alone and behind a whole one, which is not read in the same way.
            let before = if random(&mut state).is_multiple_of(2) { &other[..] } else { &[] };
            let end = read(&[before, &[&file]].concat());
            longest = longest.max(begin.elapsed());
            *ends.entry(end).or_insert(0u64) += 1;
            if matches!(end, End::Hung | End::Crashed | End::GivenUp)
                && let Some(keep) = std::env::var_os("RIDGEWATCH_KEEP_MUTANTS")
            {
                std::fs::copy(&file, Path::new(&keep).join(format!("{end:?}_{}_{mutant}", ends[&end]))).unwrap();
            }
        }
        println!("{mutant}: {count} mutants: {ends:?}, {longest:.1?} at most, {} MB at most so far", peak_of_children() >> 20);
        assert!(ends[&End::Answered] > 0 && ends[&End::Refused] > 0, "mutations must reach both ends");
        assert!(!ends.contains_key(&End::Hung), "no hang");
    }
    // 2^20 values may be read from any file, or of f32 1032 / 4 a byte of it (see `Container::read`): once by the library, once by us, both as
    // f64, kept as three components in f32, and as nodes of 16 bytes. A whole file takes less than 30 MB.
    let bound = (30 << 20) + (8 + 8 + 3 * 4 + 16) * (1 << 20).max(largest * 1032 / 4);
    println!("memory: {} of {} MB that are allowed", peak_of_children() >> 20, bound >> 20);
    assert!(peak_of_children() < bound, "{}", peak_of_children());
}

/// Bytes that the largest child so far had in memory.
fn peak_of_children() -> u64 {
    // SAFETY: plain numbers, of which zeros are values, filled in by the call.
    let usage = unsafe {
        let mut usage: libc::rusage = std::mem::zeroed();
        assert_eq!(libc::getrusage(libc::RUSAGE_CHILDREN, &raw mut usage), 0);
        usage
    };
    usage.ru_maxrss as u64 * 1024
}
