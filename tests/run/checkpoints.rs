//! Checkpoints that are written during a run: their content, runs that resume from them, and the file that a kill in the middle leaves.

use crate::kit::program::until;
use crate::kit::scene::{self, SMALL_NETWORK, double_gyre};
use crate::network_support::{DoubleGyre, traced, uniform_points};
use ridgewatch::flow::Tracer;
use ridgewatch::run::{FrameRecord, RunOptions, RunReport};
use ridgewatch::surrogate::network::NetworkSettings;
use ridgewatch::surrogate::{HostSurrogate, Kind, ReplayBuffer, SurrogateSettings, build};
use std::path::Path;
use std::process::{Command, Stdio};
use std::time::Duration;

fn frames(count: usize, keys: &[&str], options: &RunOptions, mut seen: impl FnMut(&FrameRecord) + Send) -> RunReport {
    let common = "
        time.tau = 5
        flow.steps = 10
        surrogate.kind = \"residual\"
        surrogate.table_nodes = [33, 17, 2]
        training.steps_per_frame = 5
    ";
    let scene = double_gyre([16, 8, 2], &format!("{common}{SMALL_NETWORK}time.frames_per_slide = {count}"));
    scene::run_frames(scene::setup(&scene, keys), options, |frame| seen(&frame.record))
}

fn ending_in(checkpoint: &Path) -> RunOptions {
    RunOptions { checkpoint: Some(checkpoint.to_owned()), threads: 2, ..RunOptions::default() }
}

/// A checkpoint that was copied after a frame equals the last checkpoint of a run that ends with that frame, byte for byte, although training
/// went on while it was written. A run that resumes from it continues like the first run.
#[test]
fn a_checkpoint_holds_the_weights_after_its_frame() {
    const FRAMES: usize = 10;
    let folder = tempfile::tempdir().unwrap();
    let file = |name: &str| folder.path().join(name);
    let options = RunOptions { checkpoint_seconds: Some(0.0), ..ending_in(&file("weights")) };
    let (mut first, mut told) = (None, false);
    let mut steps = Vec::new();
    let report = frames(FRAMES, &[], &options, |record| {
        steps.push(record.training.as_ref().map_or(0, |learned| learned.steps));
        let Some(checkpoint) = record.checkpoint.clone() else { return };
        assert_eq!((&checkpoint.failed, checkpoint.asynchronous), (&None, true));
        // The second one begins after this frame, at the earliest. A later one may begin before its forerunner is told.
        let frame = *first.get_or_insert_with(|| {
            until("the write of the checkpoint", || file("weights").exists());
            std::fs::copy(file("weights"), file("copied")).unwrap();
            checkpoint.frame.unwrap()
        });
        if let Some(bytes) = checkpoint.bytes.filter(|_| checkpoint.frame == Some(frame)) {
            assert_eq!(bytes, std::fs::metadata(file("copied")).unwrap().len());
            assert!(
                record.frame > frame && checkpoint.seconds >= checkpoint.copy_seconds && record.seconds.total >= record.seconds.checkpoint
            );
            told = true;
        }
    });
    assert_eq!(steps.iter().sum::<u64>(), report.train_steps);
    assert!(steps[1..].iter().all(|steps| *steps == 5), "training went on: {steps:?}");
    let totals = report.checkpoints.unwrap();
    let last = totals.last.unwrap();
    assert!(told && totals.failed == 0 && totals.written > 1 && last.frame == Some(FRAMES as u64 - 1) && last.bytes.is_some());
    let (first, known) = (first.unwrap(), file("copied"));
    let alone = file("alone");
    frames(first as usize + 1, &[], &ending_in(&alone), |_| ());
    assert!(std::fs::read(alone).unwrap() == std::fs::read(&known).unwrap(), "after frame {first}");
    // The resumed network knows as much as the copied one: the first frame shows it, which the network answers before it learns.
    let mut psnr = Vec::new();
    let resume = format!("training.resume={known:?}");
    frames(1, &[&resume], &RunOptions { threads: 2, ..RunOptions::default() }, |record| psnr.push(record.surrogate_psnr.unwrap()));
    let mut fresh = Vec::new();
    frames(first as usize + 2, &[], &RunOptions { threads: 2, ..RunOptions::default() }, |record| {
        fresh.push(record.surrogate_psnr.unwrap());
    });
    let (gone_on, expected) = (psnr[0], fresh[first as usize + 1]);
    // Audit points differ.
    assert!((gone_on - expected).abs() < 1.5, "{gone_on} dB, where the run had {expected} dB");
}

/// Weights that were found, and not named for this run, need not fit: they are set aside, and the run begins anew.
#[test]
fn weights_that_were_found_need_not_fit() {
    let folder = tempfile::tempdir().unwrap();
    let file = |name: &str| folder.path().join(name);
    frames(1, &["time.tau=4"], &ending_in(&file("of another tau")), |_| ());
    std::fs::write(file("damaged"), "no weights").unwrap();
    for (name, why) in [("of another tau", "network.tau 4; expected network.tau 5"), ("damaged", "no safetensors header")] {
        let (found, content) = (file(name), std::fs::read(file(name)).unwrap());
        let options = RunOptions { resume_if_fit: Some(found.clone()), ..ending_in(&found) };
        let mut warnings = Vec::new();
        frames(1, &[], &options, |record| warnings.extend(record.warnings.clone()));
        let aside = file(&format!("{name}.unfit"));
        let warning = warnings.iter().find(|warning| warning.contains("training begins anew")).unwrap();
        assert!(warning.contains(why) && warning.contains(&format!("it is now {}", aside.display())), "{warning}");
        assert_eq!(std::fs::read(aside).unwrap(), content);
        // The run's own weights are in its place, and fit.
        let mut warnings = Vec::new();
        frames(1, &[], &options, |record| warnings.extend(record.warnings.clone()));
        assert!(!warnings.iter().any(|warning| warning.contains("anew")), "{warnings:?}");
    }
}

/// Environment variable that names the checkpoint of the process that is killed.
const TARGET: &str = "RIDGEWATCH_TEST_CHECKPOINT";

fn network() -> HostSurrogate {
    let tracer = DoubleGyre::new(0.0, 5.0, 10);
    // 24 MB a checkpoint, so that it takes a while.
    let network = NetworkSettings { levels: Some(6), log2_table: Some(17), ..NetworkSettings::default() };
    let settings = SurrogateSettings { kind: Kind::Network, table_nodes: None, ..SurrogateSettings::default() };
    let mut surrogate = build(&settings, &network, tracer.domain(), 5, &tracer).unwrap();
    surrogate.learn(&ReplayBuffer::holding(&traced(&tracer, uniform_points(1, 500), false)), f64::INFINITY, 2).unwrap();
    surrogate
}

#[test]
fn a_kill_in_the_middle_leaves_the_old_file_whole() {
    let folder = tempfile::tempdir().unwrap();
    let (target, part) = (folder.path().join("weights"), folder.path().join(".weights.part"));
    let files = || std::fs::read_dir(folder.path()).unwrap().map(|entry| entry.unwrap().file_name()).collect::<Vec<_>>();
    // Time of the last write into the unfinished file.
    let begun = || part.metadata().ok().filter(|about| about.len() > 0).map(|about| about.modified().unwrap());
    let mut known = network();
    let mut half_written = 0;
    for turn in 0..6 {
        let before = begun();
        let mut writer = Command::new(std::env::current_exe().unwrap())
            .args(["--ignored", "--exact", "checkpoints::in_a_process_of_its_own"])
            .env(TARGET, &target)
            .stdout(Stdio::null())
            .spawn()
            .unwrap();
        // In the middle of a write, after a whole file exists.
        for _ in 0..300_000 {
            if target.exists() && begun().is_some_and(|time| Some(time) != before) {
                break;
            }
            std::thread::sleep(Duration::from_millis(1));
        }
        std::thread::sleep(Duration::from_millis(turn));
        writer.kill().unwrap();
        writer.wait().unwrap();
        known.load(&target).unwrap();
        half_written += usize::from(part.exists());
        assert!(files().len() <= 2, "{:?}", files());
    }
    assert!(half_written > 0, "no kill fell into a write");
    // The next writer uses it again.
    std::fs::write(&part, "half").unwrap();
    known.save(&target).unwrap();
    known.load(&target).unwrap();
    assert_eq!(files(), ["weights"]);
}

#[test]
#[ignore = "started, and killed, by the test above"]
fn in_a_process_of_its_own() {
    let Ok(target) = std::env::var(TARGET) else { return };
    let surrogate = network();
    // Until it is killed; the count is a bound for the case that it is not.
    for _ in 0..2000 {
        surrogate.save(Path::new(&target)).unwrap();
    }
}
