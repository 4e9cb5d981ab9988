//! Damaged NetCDF-4 and HDF5 files of every supported kind. The C code of libhdf5, which reads them, may crash, hang or ask for any amount of
//! memory: each file goes to a child process with limits, which must end by itself with an answer or one message.
#![allow(clippy::unwrap_used, clippy::print_stdout)] // Tests: a panic is the report.
#![cfg(target_os = "linux")]

mod kit;

use hdf5_metno::File;
use kit::grids::{Ocean, Wrf, packed_levels};
use kit::mutants::{mutant, random, used};
use kit::netcdf::*;
use ndarray::{Array4, Array5};
use ridgewatch::source::{SyntheticSettings, SyntheticShape, synthesize};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

/// Address space of a child, kB: the program and its libraries take half of it.
const MEMORY: u64 = 2_000_000;
/// Bytes in memory: 1.5 times the 30 MB of the largest of 20,000 mutants, which the program and its libraries also need for a whole file.
/// 2^20 values that a file only claims to hold would take 16 MB more as f64, in the copies of the library and of the program. (Values that a
/// file really holds, up to 2^20 or 1032 / 4 a byte, take 108 bytes each in a window; no mutant reached that.)
const LARGEST: u64 = 45 << 20;
/// Seconds after which the program gives up opening a file. It takes milliseconds, but the machine may be slow and busy.
const OPENING_LIMIT: &str = "30";
/// Time after which a child counts as hanging.
const LONGEST: Duration = Duration::from_secs(120);

/// End of a child.
#[derive(Debug, PartialEq, Eq, PartialOrd, Ord, Clone, Copy)]
enum End {
    Answered,
    Refused,
    /// The library crashed, and the file was named.
    Crashed,
    /// The library did not return within the limit of the program.
    GivenUp,
    /// It did not end by itself.
    Hung,
}

/// Inspects files or, if `traced`, computes an FTLE from snapshots of all of them. Also returns the peak memory of the child in bytes.
#[allow(clippy::zombie_processes)] // `ended` waits for the child, to read its peak memory.
fn read(files: &[&Path], traced: bool, options: &str) -> (End, u64) {
    let files: Vec<String> = files.iter().map(|f| f.display().to_string()).collect();
    let work = if traced { "ftle" } else { "inspect" };
    let options = if traced { options } else { options.split("--grid").next().unwrap_or_default() };
    let command = format!("ulimit -v {MEMORY}; exec {} {work} {} {options}", env!("CARGO_BIN_EXE_ridgewatch"), files.join(" "));
    let mut child = Command::new("sh")
        .args(["-c", &command])
        .env("RIDGEWATCH_OPENING_LIMIT", OPENING_LIMIT)
        // The symbols of a backtrace take 100 MB.
        .env("RUST_BACKTRACE", "0")
        .stdout(Stdio::null())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    let begin = Instant::now();
    let (status, peak) = loop {
        if let Some(ended) = ended(child.id()) {
            break ended;
        }
        if begin.elapsed() > LONGEST {
            child.kill().unwrap();
            child.wait().unwrap();
            return (End::Hung, 0);
        }
        std::thread::sleep(Duration::from_millis(1));
    };
    let said = std::io::read_to_string(child.stderr.take().unwrap()).unwrap();
    assert!(!said.contains("panicked"), "{command}: {said}");
    let end = match status {
        0 => End::Answered,
        // 2 if the damage makes the options, or defaults of the scene, invalid for the file.
        1 | 2 => {
            // The damaged file comes last. A message that names a whole one before it would be wrong.
            let damaged = files.last().unwrap();
            assert!(said.contains(damaged), "does not name {damaged}: {command}: {said}");
            match () {
                () if said.contains(&format!("not opened within {OPENING_LIMIT} s")) => End::GivenUp,
                () if said.contains("crashed") => End::Crashed,
                () => End::Refused,
            }
        }
        other => panic!("{command}: ended with {other}: {said}"),
    };
    (end, peak)
}

/// Exit status (or minus the signal) and peak memory in bytes of a child, once it has ended.
fn ended(child: u32) -> Option<(i32, u64)> {
    let mut status = 0;
    // SAFETY: `usage` consists of plain numbers, for which zeros are valid; the call fills them in.
    let usage = unsafe {
        let mut usage: libc::rusage = std::mem::zeroed();
        let found = libc::wait4(child as libc::pid_t, &raw mut status, libc::WNOHANG, &raw mut usage);
        if found == 0 {
            return None;
        }
        assert_eq!(found, child as libc::pid_t, "{}", std::io::Error::last_os_error());
        usage
    };
    let code = if libc::WIFEXITED(status) { libc::WEXITSTATUS(status) } else { -libc::WTERMSIG(status) };
    Some((code, usage.ru_maxrss as u64 * 1024))
}

/// A file to damage, and the options with which it is read.
struct Case {
    name: &'static str,
    whole: PathBuf,
    /// A whole file of an earlier time: a damaged file after another one is read in another way.
    before: Option<PathBuf>,
    options: &'static str,
}

/// Two times of `Velocity_*` with coordinates, or of `u*` without.
fn turbulence_database(path: &Path, current: bool) {
    let file = File::create(path).unwrap();
    for t in 1..3 {
        let values = Array4::from_shape_fn((3, 4, 5, 3), |(z, y, x, c)| (x + 2 * y + 3 * z + c * t) as f32);
        let name = if current { format!("Velocity_{t:04}") } else { format!("u{:05}", 10 * t) };
        file.new_dataset_builder().with_data(&values).create(name.as_str()).unwrap();
    }
    for (name, n) in [("xcoor", 5), ("ycoor", 4), ("zcoor", 3)].into_iter().filter(|_| current) {
        let values: Vec<f32> = (0..n).map(|i| 0.5 * i as f32).collect();
        file.new_dataset_builder().with_data(&values).create(name).unwrap();
    }
}

/// All components and times in one compressed dataset of a group, and the rest beside it.
fn grouped(path: &Path) {
    let file = File::create(path).unwrap();
    let group = file.create_group("fields").unwrap();
    let values = Array5::from_shape_fn((3, 4, 5, 6, 3), |(t, z, y, x, c)| (x + 2 * y + 3 * z + c * t) as f32);
    group.new_dataset_builder().deflate(4).chunk((1, 4, 5, 6, 3)).with_data(&values).create("velocity").unwrap();
    group.new_dataset_builder().with_data(&[0.0f64, 1.0, 2.0]).create("time").unwrap();
    for (name, n) in [("x", 6), ("y", 5), ("z", 4)] {
        let values: Vec<f64> = (0..n).map(f64::from).collect();
        group.new_dataset_builder().with_data(&values).create(name).unwrap();
    }
}

/// NetCDF-4.
fn netcdf4(folder: &Path) -> Vec<Case> {
    let hours = "hours since 2000-01-01";
    let era = |hour: f64| packed_levels(NETCDF4, &[850.0, 500.0, 700.0], hour);
    let ocean = |hour: f64| Ocean { n: 9, hour, ..Ocean::default() }.fixture();
    let wrf = |hour: usize| Wrf { hour, ..Wrf::default() }.fixture();
    let case = |name, before: Fixture, damaged: Fixture, options| {
        let write = |fixture: Fixture, which: &str| fixture.write(&folder.join(format!("{name}_{which}.nc")));
        Case { name, whole: write(damaged, "whole"), before: Some(write(before, "before")), options }
    };
    let (plane_options, space_options) = ("--set time.tau=3600 --grid 5x5", "--set time.tau=3600 --grid 5x5x5");
    vec![
        case("plane", plane(NETCDF4, &[0.0], hours), plane(NETCDF4, &[2.0, 3.0, 4.0], hours), plane_options),
        case("packed_levels", era(0.0), era(2.0), space_options),
        case("staggered", wrf(12), wrf(18), space_options),
        case("curvilinear", ocean(0.0), ocean(2.0), plane_options),
    ]
}

/// HDF5.
fn hdf5(folder: &Path) -> Vec<Case> {
    let small = SyntheticSettings { nodes: [4, 4, 4], snapshots: 2, ..SyntheticSettings::new(SyntheticShape::Flame) };
    let mut flame = synthesize(&small, folder).unwrap();
    let [current, legacy, group] = ["current.h5", "legacy.h5", "grouped.h5"].map(|name| folder.join(name));
    turbulence_database(&current, true);
    turbulence_database(&legacy, false);
    grouped(&group);
    let traced = "--set time.tau=1 --grid 5x5x5";
    vec![
        Case { name: "flame", whole: flame.remove(1), before: Some(flame.remove(0)), options: traced },
        Case { name: "JHTDB", whole: current, before: None, options: traced },
        Case {
            name: "JHTDB, older",
            whole: legacy,
            before: None,
            options: "--set archive.spacing=[0.1,0.1,0.1] --set time.tau=1 --grid 5x5x5",
        },
        Case {
            name: "grouped, deflated",
            whole: group,
            before: None,
            options: "--set archive.velocity=fields/velocity --set archive.order=tzyxc --set time.tau=1 --grid 5x5x5",
        },
    ]
}

#[test]
fn mutated_files_end_in_an_answer_or_a_message() {
    // RIDGEWATCH_MUTATIONS=10000 (of each format) for a long run.
    let count: u64 = std::env::var("RIDGEWATCH_MUTATIONS").ok().and_then(|n| n.parse().ok()).unwrap_or(80);
    let dir = tempfile::tempdir().unwrap();
    let mut state = 7;
    for (format, ending, cases) in [("NetCDF-4", "nc", netcdf4(dir.path())), ("HDF5", "h5", hdf5(dir.path()))] {
        let mut of_format = BTreeMap::new();
        let share = count.div_ceil(cases.len() as u64);
        for Case { name, whole, before, options } in &cases {
            let both: Vec<&Path> = before.iter().map(PathBuf::as_path).chain([whole.as_path()]).collect();
            assert_eq!(read(&both, true, options).0, End::Answered, "{name}: {both:?}");
            let whole = std::fs::read(whole).unwrap();
            let file = dir.path().join("mutant").with_extension(ending);
            let used = used(&whole);
            let (mut ends, mut longest, mut largest) = (BTreeMap::new(), Duration::ZERO, 0);
            for _ in 0..share {
                let _ = std::fs::remove_file(&file);
                std::fs::write(&file, mutant(&whole, &used, &mut state)).unwrap();
                // Alone and after a whole file, headers only and the field.
                let (behind, traced) = (random(&mut state).is_multiple_of(2), random(&mut state).is_multiple_of(2));
                let files: Vec<&Path> = before.iter().filter(|_| behind).map(PathBuf::as_path).chain([file.as_path()]).collect();
                let begin = Instant::now();
                let (end, peak) = read(&files, traced, options);
                longest = longest.max(begin.elapsed());
                largest = largest.max(peak);
                *ends.entry(end).or_insert(0u64) += 1;
                *of_format.entry(end).or_insert(0u64) += 1;
                if matches!(end, End::Hung | End::Crashed | End::GivenUp)
                    && let Some(keep) = std::env::var_os("RIDGEWATCH_KEEP_MUTANTS")
                {
                    std::fs::copy(&file, Path::new(&keep).join(format!("{end:?}_{name}_{}.{ending}", ends[&end]))).unwrap();
                }
            }
            println!("{format}, {name}, {} bytes: {share} mutants: {ends:?}, {longest:.1?} and {} MB at most", whole.len(), largest >> 20);
            assert!(largest < LARGEST, "{name}: {largest} bytes");
        }
        println!("{format}: {of_format:?}");
        assert!(of_format[&End::Answered] > 0 && of_format[&End::Refused] > 0, "mutations must reach both ends");
        assert!(!of_format.contains_key(&End::Hung), "no hang");
    }
}
