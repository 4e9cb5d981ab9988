//! Checkpoints that are written while a run goes on: what is in them, what goes on from them, and what a kill in the middle leaves.

#![allow(clippy::unwrap_used)]

mod network_support;

use network_support::{DoubleGyre, traced, uniform_points};
use ridgewatch::config::SceneFile;
use ridgewatch::flow::Tracer;
use ridgewatch::run::{Event, FrameRecord, RunOptions, RunReport, Setup, run};
use ridgewatch::surrogate::network::NetworkSettings;
use ridgewatch::surrogate::{HostSurrogate, Kind, ReplayBuffer, SurrogateSettings, build};
use std::os::unix::fs::MetadataExt;
use std::path::Path;
use std::process::Command;
use std::sync::atomic::AtomicBool;
use std::time::{Duration, Instant};

const SCENE: &str = "
[source]
kind = \"double_gyre\"
[domain]
min = [0, 0, 0]
max = [2, 1, 0.2]
[time]
tau = 5
[flow]
steps = 10
[surrogate]
kind = \"residual\"
table_nodes = [33, 17, 2]
[network]
levels = 4
log2_table = 12
width = 16
batch = 512
[training]
steps_per_frame = 5
[render]
width = 16
height = 8
samples = 2
";

fn frames(count: usize, keys: &[String], options: &RunOptions, seen: &mut (dyn FnMut(&FrameRecord) + Send)) -> RunReport {
    let keys: Vec<String> = keys.iter().cloned().chain([format!("time.frames_per_slide={count}")]).collect();
    let scene = SceneFile::parse(Path::new("a test"), SCENE, &keys).unwrap();
    let mut sink = |event: Event| {
        if let Event::Frame(frame) = event {
            seen(&frame.record);
        }
    };
    run(Setup::new(scene.settings()).unwrap(), options, &mut sink, &AtomicBool::new(false)).unwrap()
}

fn ending_in(checkpoint: &Path) -> RunOptions {
    RunOptions { checkpoint: Some(checkpoint.to_owned()), threads: 2, ..RunOptions::default() }
}

/// What a checkpoint says of the frame after which it was copied is so: it is the last checkpoint of a run that ends with that frame, byte for
/// byte, though training went on while it was written; and who goes on from it comes to where the run came.
#[test]
fn a_checkpoint_holds_the_weights_after_its_frame() {
    const FRAMES: usize = 10;
    let folder = tempfile::tempdir().unwrap();
    let file = |name: &str| folder.path().join(name);
    let options = RunOptions { checkpoint_seconds: Some(0.0), ..ending_in(&file("weights")) };
    let mut written = Vec::new();
    let mut steps = Vec::new();
    // The file under the checkpoint's name.
    let mut shown = None;
    let report = frames(FRAMES, &[], &options, &mut |record| {
        steps.push(record.training.as_ref().map_or(0, |learned| learned.steps));
        let Some(checkpoint) = record.checkpoint.clone() else { return };
        if checkpoint.bytes.is_none() {
            // The disk has its time.
            let (begin, before) = (Instant::now(), shown);
            while shown == before && begin.elapsed() < Duration::from_secs(300) {
                std::thread::sleep(Duration::from_millis(1));
                shown = std::fs::metadata(file("weights")).ok().map(|metadata| metadata.ino());
            }
        }
        assert_eq!((&checkpoint.failed, checkpoint.asynchronous), (&None, true));
        if let Some(bytes) = checkpoint.bytes {
            let frame = checkpoint.frame.unwrap();
            // The next one begins after this.
            std::fs::copy(file("weights"), file(&frame.to_string())).unwrap();
            assert_eq!(bytes, std::fs::metadata(file("weights")).unwrap().len());
            assert!(
                record.frame > frame && checkpoint.seconds >= checkpoint.copy_seconds && record.seconds.total >= record.seconds.checkpoint
            );
            written.push(frame);
        }
    });
    assert_eq!(steps.iter().sum::<u64>(), report.train_steps);
    assert!(steps[1..].iter().all(|steps| *steps == 5), "training went on: {steps:?}");
    let totals = report.checkpoints.unwrap();
    let last = totals.last.unwrap();
    assert!(totals.failed == 0 && totals.written > written.len() as u64 && last.frame == Some(FRAMES as u64 - 1) && last.bytes.is_some());
    assert!(written.len() >= 2, "{written:?}");

    for frame in [written[0], written[written.len() - 1]] {
        let alone = file(&format!("ends with {frame}"));
        frames(frame as usize + 1, &[], &ending_in(&alone), &mut |_| ());
        assert!(std::fs::read(alone).unwrap() == std::fs::read(file(&frame.to_string())).unwrap(), "after frame {frame}");
    }
    // What a run goes on from knows as much as what it was copied from: the first frame says so, which the network answers before it learns.
    let (first, known) = (written[0], file(&written[0].to_string()));
    let mut psnr = Vec::new();
    let keys = [format!("training.resume={:?}", known.display().to_string())];
    frames(1, &keys, &RunOptions { threads: 2, ..RunOptions::default() }, &mut |record| psnr.push(record.surrogate_psnr.unwrap()));
    let mut fresh = Vec::new();
    frames(first as usize + 2, &[], &RunOptions { threads: 2, ..RunOptions::default() }, &mut |record| {
        fresh.push(record.surrogate_psnr.unwrap());
    });
    let (gone_on, expected) = (psnr[0], fresh[first as usize + 1]);
    // Audit points differ.
    assert!((gone_on - expected).abs() < 1.5, "{gone_on} dB, where the run had {expected} dB");
}

/// What the process that is killed is told by.
const TARGET: &str = "RIDGEWATCH_TEST_CHECKPOINT";

fn network() -> HostSurrogate {
    let tracer = DoubleGyre::new(0.0, 5.0, 10);
    // 24 MB a checkpoint, so that it takes a while.
    let network = NetworkSettings { levels: 6, log2_table: 17, ..NetworkSettings::default() };
    let settings = SurrogateSettings { kind: Kind::Network, table_nodes: None };
    let mut surrogate = build(&settings, &network, tracer.domain(), 5, &tracer).unwrap();
    surrogate.learn(&ReplayBuffer::holding(&traced(&tracer, uniform_points(1, 500), false)), f64::INFINITY, 2).unwrap();
    surrogate
}

#[test]
fn a_kill_in_the_middle_leaves_the_old_file_whole() {
    let folder = tempfile::tempdir().unwrap();
    let target = folder.path().join("weights");
    let mut known = network();
    let mut half_written = 0;
    for turn in 0..6 {
        let mut writer = Command::new(std::env::current_exe().unwrap())
            .args(["--ignored", "--exact", "in_a_process_of_its_own"])
            .env(TARGET, &target)
            .stdout(std::process::Stdio::null())
            .spawn()
            .unwrap();
        let files = || std::fs::read_dir(folder.path()).unwrap().map(|entry| entry.unwrap().path());
        let before = files().count();
        // In the middle of a write, once there is a whole file.
        for _ in 0..300_000 {
            if target.exists() && files().count() > before.max(1) {
                break;
            }
            std::thread::sleep(Duration::from_millis(1));
        }
        std::thread::sleep(Duration::from_millis(turn));
        writer.kill().unwrap();
        writer.wait().unwrap();
        known.load(&target).unwrap();
        for rest in files().filter(|path| *path != target).collect::<Vec<_>>() {
            half_written += 1;
            std::fs::remove_file(rest).unwrap();
        }
    }
    assert!(half_written > 0, "no kill fell into a write");
}

#[test]
#[ignore = "started, and killed, by the test above"]
fn in_a_process_of_its_own() {
    let Ok(target) = std::env::var(TARGET) else { return };
    let surrogate = network();
    // Until it is killed, but not for good.
    for _ in 0..2000 {
        surrogate.save(Path::new(&target)).unwrap();
    }
}
