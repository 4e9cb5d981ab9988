//! Test of the Fortran module, compiled with gfortran: the values that arrive are those of the column-major arrays.

#![allow(clippy::unwrap_used, clippy::print_stdout)]

use ridgewatch_wire::{Following, Geometry, Limits, Read, RingReader};
use std::path::{Path, PathBuf};
use std::process::Command;

#[test]
#[ignore = "needs gfortran; make test-adapters installs it"]
fn fortran_arrays_arrive_as_they_are() {
    let build = std::env::temp_dir().join(format!("rw-fortran-{}", std::process::id()));
    std::fs::create_dir_all(&build).unwrap();
    let ring = PathBuf::from("/dev/shm").join(format!("rw-fortran-{}", std::process::id()));
    let library = std::env::current_exe().unwrap().parent().unwrap().to_owned();
    // The library's SONAME.
    let _ = std::os::unix::fs::symlink("libridgewatch_adapter.so", library.join("libridgewatch_adapter.so.2"));
    let source = Path::new(env!("CARGO_MANIFEST_DIR")).join("../fortran");
    let program = build.join("test");
    let out = Command::new("gfortran")
        .current_dir(&build)
        .args(["-std=f2018", "-O1", "-fcheck=all", "-Wall", "-Wextra", "-Werror", "-Wno-error=unused-parameter"])
        .arg(source.join("ridgewatch.f90"))
        .arg(source.join("test.f90"))
        .arg("-o")
        .arg(&program)
        .arg("-L")
        .arg(&library)
        .arg("-lridgewatch_adapter")
        .output()
        .expect("gfortran");
    assert!(out.status.success(), "{}", String::from_utf8_lossy(&out.stderr));
    let following = Following::begin(&ring).unwrap();
    let following_globe = Following::begin(&ring.join("globe")).unwrap();
    let following_blocks = Following::begin(&ring.join("blocks")).unwrap();
    let out = Command::new(&program).env("LD_LIBRARY_PATH", &library).env("RIDGEWATCH_RING", &ring).output().unwrap();
    assert!(out.status.success(), "{}{}", String::from_utf8_lossy(&out.stdout), String::from_utf8_lossy(&out.stderr));
    let mut reader = RingReader::open(&ring, 0, &Limits::default()).unwrap();
    assert_eq!(reader.header().description.start, 20_261_122);
    let axes = &reader.header().description.axes;
    assert_eq!((axes[1].coordinates.as_slice(), axes[2].period), (&[0.0, 1.0, 4.0][..], Some(5.0)));
    let mut values = Vec::new();
    for (step, time) in [(1, 0.5), (2, 1.5)] {
        let Read::Step(info) = reader.read(&mut values).unwrap() else { panic!("no step {step}") };
        assert_eq!((info.step, info.time), (step, time));
        for c in 0..3usize {
            for (i, j, k) in (0..24usize).map(|n| (n % 4, n / 4 % 3, n / 12)) {
                let expected = (c + 1) * ((i + 1) + 10 * (j + 1) + 100 * (k + 1));
                assert_eq!(values[c * 24 + i + 4 * (j + 3 * k)], expected as f32, "step {step}, component {c} at {i} {j} {k}");
            }
        }
    }
    assert_eq!(reader.read(&mut values).unwrap(), Read::Ended);
    let globe = ring.join("globe");
    let mut reader = RingReader::open(&globe, 0, &Limits::default()).unwrap();
    let description = &reader.header().description;
    assert_eq!((description.geometry, description.shape()), (Geometry::Sphere { radius: 6.371e6 }, [4, 3, 1]));
    assert_eq!((description.axes[0].period, description.axes[1].coordinates.as_slice()), (Some(360.0), &[-60.0, 0.0, 60.0][..]));
    let Read::Step(info) = reader.read(&mut values).unwrap() else { panic!("no step on the globe") };
    assert_eq!((info.step, info.time, values.as_slice()), (7_000_000_000, 2.0, (1..=24).map(|n| n as f32).collect::<Vec<_>>().as_slice()));
    let blocks = ring.join("blocks");
    for block in 0..2u32 {
        let mut reader = RingReader::open(&blocks, block, &Limits::default()).unwrap();
        let description = &reader.header().description;
        assert_eq!((description.time_unit.as_str(), description.block.count), ("h", 2));
        assert_eq!((description.block.offset, description.block.extent), ([2 * u64::from(block), 0, 0], [2, 3, 1]));
        // Of the first block two steps were overwritten.
        let (step, sign) = if block == 0 { (3, 1.0) } else { (1, -1.0) };
        let Read::Step(info) = reader.read(&mut values).unwrap() else { panic!("no step of block {block}") };
        assert_eq!((info.step, info.time), (step, step as f64));
        let east: Vec<f32> = (0..6).map(|n| (1 + n % 2 + 2 * block as usize + 4 * (n / 2)) as f32).collect();
        let expected: Vec<f32> = east.iter().copied().chain(east.iter().map(|u| sign * u)).collect();
        assert_eq!(values, expected);
    }
    drop((following_blocks, following_globe, following));
    std::fs::remove_dir_all(&build).unwrap();
    assert!(!ring.exists());
}
