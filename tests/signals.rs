//! A signal at any moment of a replay: the run ends soon, and its folder is complete. Without the signal, every scene here would remain for many
//! minutes in the stage that the signal interrupts.

#![allow(clippy::unwrap_used)]
#![cfg(unix)]

mod kit;

use kit::program::{self, Outcome, Running, records, set, start, summary, text, until};
use kit::scene::{self, double_gyre};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

/// Longest time that a run may go on after the signal. It checks about twice a second, but the machine may be slow and busy.
const SOON: Duration = Duration::from_secs(120);

fn gyre() -> String {
    let keys = "
        time.tau = 10
        time.slides = 3
        transfer.low = 0.05
        transfer.high = 0.45
        surrogate.kind = \"network\"
        flow.steps = 20
        training.steps_per_frame = 20
    ";
    double_gyre([32, 16, 1], keys)
}

struct Run {
    process: Option<Running>,
    folder: PathBuf,
    _temporary: tempfile::TempDir,
}

impl Run {
    /// A replay that resumes from a checkpoint, or else writes one into [`Run::weights`] if it trains.
    fn start(scene: &str, keys: &[&str], resume: Option<&Path>) -> Self {
        let temporary = tempfile::tempdir().unwrap();
        let folder = temporary.path().join("run");
        let mut command = program::ridgewatch(["replay", &scene::write(temporary.path(), scene), "--out", text(&folder)]);
        command.args(set(keys));
        let mut run = Self { process: None, folder, _temporary: temporary };
        if let Some(weights) = resume {
            command.arg("--resume").arg(weights);
        } else if !keys.contains(&"surrogate.kind=table") {
            command.arg("--checkpoint").arg(run.weights());
        }
        run.process = Some(start(&mut command));
        run.wait_for("records.jsonl");
        run
    }

    fn weights(&self) -> PathBuf {
        self.folder.with_file_name("weights.safetensors")
    }

    fn wait_for(&self, name: &str) {
        until(name, || self.folder.join(name).exists());
    }

    fn process(&mut self) -> &mut Running {
        self.process.as_mut().unwrap()
    }

    /// Waits for a message, which must come soon.
    fn prints(&mut self, words: &str) {
        let begin = Instant::now();
        until(words, || self.process().stderr().contains(words));
        assert!(begin.elapsed() < SOON, "{words}");
    }

    /// Waits for the end, which must come soon.
    fn ended(&mut self) -> Outcome {
        self.process.take().unwrap().wait_at_most(SOON)
    }

    /// Asserts an orderly end with this exit status, which the folder states. Returns the number of frames, which is that of the records.
    fn ended_in_order(&mut self, status: i32) -> u64 {
        let output = self.ended().refused(status, &[]);
        let summary = summary(&self.folder);
        assert_eq!(summary["run"]["interrupted"], true, "{summary}");
        let frames = summary["run"]["frames"].as_u64().unwrap();
        assert_eq!(records(&self.folder).len() as u64, frames);
        assert_eq!(output.stdout.contains("Runge-Kutta steps a path"), frames > 0, "only a run that traced reports it: {}", output.stdout);
        frames
    }
}

/// Signals a run that has had the time to enter its first stage.
fn stopped_while_preparing(keys: &[&str]) {
    let mut run = Run::start(&gyre(), keys, None);
    std::thread::sleep(Duration::from_millis(500));
    run.process().signal(libc::SIGTERM);
    assert_eq!(run.ended_in_order(143), 0, "no frame was in progress");
}

#[test]
fn while_tables_are_traced() {
    // 16 million seeds of 4000 steps.
    stopped_while_preparing(&["surrogate.kind=table", "surrogate.table_nodes=[4096, 4096, 2]", "flow.steps=4000"]);
}

#[test]
fn while_the_pilot_is_rendered() {
    // At least one query of 4000 steps a pixel.
    stopped_while_preparing(&["render.width=4096", "render.height=2048", "flow.steps=4000"]);
}

#[test]
fn while_cells_are_probed() {
    // Two million probes of 4000 steps.
    stopped_while_preparing(&["trust.cells=[64, 64, 1]", "trust.min_samples=512", "flow.steps=4000"]);
}

#[test]
fn while_the_first_window_fills() {
    // Each snapshot is a sum of 4096 modes at two million nodes.
    let scene = "source.kind = \"turbulence\"\nsource.nodes = [128, 128, 128]\nsource.modes = 4096\ntime.tau = 11\n";
    let mut run = Run::start(scene, &["surrogate.kind=table"], None);
    run.process().signal(libc::SIGINT);
    assert_eq!(run.ended_in_order(130), 0);
}

#[test]
fn while_training() {
    let mut run = Run::start(&gyre(), &["training.steps_per_frame=100000000"], None);
    // Rendering such a frame takes a moment; its training would take days.
    std::thread::sleep(Duration::from_millis(1500));
    run.process().signal(libc::SIGTERM);
    assert!(run.ended_in_order(143) <= 1, "the frame in progress is finished, and no other starts");
}

#[test]
fn while_a_slide_is_prepared_what_was_learned_is_kept() {
    // Slides follow each other quickly, and tracing their tables takes most of the time.
    let keys = ["surrogate.kind=residual", "surrogate.table_nodes=[512, 256, 2]", "time.slides=100000", "trust.cells=[4, 4, 1]"];
    let mut run = Run::start(&gyre(), &keys, None);
    run.wait_for("frames/frame_000002.png");
    std::thread::sleep(Duration::from_millis(137));
    run.process().signal(libc::SIGTERM);
    assert!(run.ended_in_order(143) >= 3);
    assert!(run.weights().exists(), "the checkpoint is written");
    Run::start(&gyre(), &keys[..2], Some(&run.weights())).ended().success();
}

#[test]
fn a_second_signal_ends_at_once() {
    // One frame of many minutes, prepared in a moment: the first signal lets it finish.
    let keys = ["render.width=64", "render.height=32", "render.samples=16000000", "render.method=surrogate"];
    let mut run = Run::start(&gyre(), &keys, None);
    run.prints("colours from FTLE");
    std::thread::sleep(Duration::from_millis(3000));
    run.process().signal(libc::SIGINT);
    run.prints("finishing the current frame; once more to stop at once");
    std::thread::sleep(Duration::from_millis(500));
    assert!(!run.process().has_ended(), "the current frame is finished first");
    run.process().signal(libc::SIGINT);
    run.prints("stopped at once");
    run.ended().refused(130, &[]);
    assert!(!run.folder.join("summary.json").exists());
}
