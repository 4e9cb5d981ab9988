//! A disk that fills up during a run.

use crate::kit::program::{records, until};
use crate::kit::publishing;
use ridgewatch::publish::{ExrFrames, Output, PublishSettings, RunFolder, read_exr};
use ridgewatch::render::Film;
use ridgewatch::run::{Frame, FrameRecord};
use std::process::Command;

/// A file system of one megabyte, removed at the end of the test.
struct SmallDisk(tempfile::TempDir);

impl SmallDisk {
    fn mount() -> Self {
        let folder = tempfile::tempdir().unwrap();
        let mounted = Command::new("mount").args(["-t", "tmpfs", "-o", "size=1m", "tmpfs"]).arg(folder.path()).status().unwrap();
        assert!(mounted.success(), "mounting needs root");
        Self(folder)
    }
}

impl Drop for SmallDisk {
    fn drop(&mut self) {
        let _ = Command::new("umount").arg("-l").arg(self.0.path()).status();
    }
}

/// 128 x 128 pixels of noise: 256 KiB that do not compress.
fn noise(number: u64) -> Frame {
    of_noise(number, 128)
}

fn of_noise(number: u64, edge: usize) -> Frame {
    let mut state = number.wrapping_mul(0x9e37_79b9_7f4a_7c15) | 1;
    let mut next = || {
        // xorshift64*, since its bits do not compress.
        state ^= state >> 12;
        state ^= state << 25;
        state ^= state >> 27;
        (state.wrapping_mul(0x2545_f491_4f6c_dd1d) >> 40) as f32
    };
    let rgba = (0..edge * edge).map(|_| [next(), next(), next(), next()]).collect();
    let film = Film { width: edge, height: edge, rgba, ..Default::default() };
    let record = FrameRecord { frame: number, warnings: vec!["x".repeat(2000)], ..Default::default() };
    publishing::frame(record, film)
}

#[test]
#[ignore = "mounts a small file system, which needs root"]
fn a_full_disk_is_counted_and_the_run_goes_on() {
    let disk = SmallDisk::mount();
    let run = disk.0.path().join("run");
    let ballast = disk.0.path().join("ballast");
    std::fs::write(&ballast, vec![1u8; 600 << 10]).unwrap();
    let settings = PublishSettings { endpoint: None, preview: false, exr: ExrFrames::Every, ..Default::default() };
    let mut output = Output::start(&settings, Some(RunFolder::create(&run, false).unwrap())).unwrap();
    // One fits beside the ballast, nineteen do not. The twenty-first is small enough. Its record, which is written before its picture, shows that
    // all frames before it have been tried.
    for number in 0..20 {
        output.frame(noise(number));
    }
    output.frame(of_noise(20, 2));
    let lines = || std::fs::read_to_string(run.join("records.jsonl")).unwrap_or_default().lines().count();
    until("the record of frame 20", || lines() == 21);
    std::fs::remove_file(&ballast).unwrap();
    output.frame(noise(21));
    until("the picture of frame 21", || run.join("frames/frame_000021.exr").exists());
    let summary = output.finish(serde_json::Map::new());
    println!("{:?}", summary.files);
    let files = summary.files.unwrap();
    assert_eq!((summary.frames, files.pictures_written, files.pictures_failed), (22, 3, 19));
    assert!(std::fs::read(run.join("records.jsonl")).unwrap().ends_with(b"\n"));
    assert_eq!(records(&run).len() as u64, files.records_written);
    assert_eq!(std::fs::read_dir(run.join("frames")).unwrap().count(), 3, "no half-written file stays");
    assert_eq!(read_exr(&run.join("frames/frame_000021.exr")).unwrap(), *noise(21).film);
    assert!(run.join("summary.json").exists());
}
