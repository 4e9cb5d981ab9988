//! A signal at any moment of a replay: the run ends soon, and its folder is complete. Without the signal, every scene here would remain for many
//! minutes in the stage that the signal interrupts.
//!
//! A stop that comes as several signals is one stop, and `--stop-within` bounds the time from the first of them to the end of the process.

#![allow(clippy::unwrap_used)]
#![cfg(unix)]

mod kit;

use kit::program::{self, Outcome, Running, records, set, start, summary, text, until};
use kit::scene::{self, double_gyre};
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::Command;
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
        Self::start_with(scene, keys, resume, |_| ())
    }

    /// As [`Run::start`], with changes to the command.
    fn start_with(scene: &str, keys: &[&str], resume: Option<&Path>, change: impl FnOnce(&mut Command)) -> Self {
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
        change(&mut command);
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

/// A scene whose first frame takes many minutes and is prepared in a moment.
const LONG_FRAME: [&str; 4] = ["render.width=64", "render.height=32", "render.samples=16000000", "render.method=surrogate"];

/// GNU `timeout` signals its child and then the group that the child is in; systemd may send SIGHUP after SIGTERM.
#[test]
fn a_stop_of_several_signals_is_one() {
    for signals in [[libc::SIGTERM, libc::SIGTERM, libc::SIGTERM], [libc::SIGTERM, libc::SIGHUP, libc::SIGINT]] {
        let mut run = Run::start(&gyre(), &["training.steps_per_frame=100000000"], None);
        std::thread::sleep(Duration::from_millis(1500));
        for signal in signals {
            run.process().signal(signal);
            std::thread::sleep(Duration::from_millis(5));
        }
        run.ended_in_order(143);
        assert!(run.weights().exists(), "the checkpoint is written");
    }
}

/// Sets what a command does when its terminal closes.
fn on_hangup(command: &mut Command, handler: libc::sighandler_t) {
    // SAFETY: between fork and exec, only `signal` is called, which is safe there.
    unsafe {
        command.pre_exec(move || {
            libc::signal(libc::SIGHUP, handler);
            Ok(())
        })
    };
}

#[test]
fn a_terminal_that_closes_ends_in_order() {
    // These tests may run under `nohup`, whose choice would be inherited.
    let mut run = Run::start_with(&gyre(), &["training.steps_per_frame=100000000"], None, |command| on_hangup(command, libc::SIG_DFL));
    std::thread::sleep(Duration::from_millis(1500));
    run.process().signal(libc::SIGHUP);
    run.ended_in_order(129);
    assert!(run.weights().exists(), "the checkpoint is written");
}

#[test]
fn a_run_under_nohup_outlives_its_terminal() {
    let mut run = Run::start_with(&gyre(), &["training.steps_per_frame=100000000"], None, |command| on_hangup(command, libc::SIG_IGN));
    run.process().signal(libc::SIGHUP);
    std::thread::sleep(Duration::from_millis(1500));
    assert!(!run.process().has_ended() && !run.process().stderr().contains("finishing"), "the signal is ignored");
    run.process().signal(libc::SIGTERM);
    run.ended_in_order(143);
}

/// Stops a run in its first frame with `--stop-within`. The frame is abandoned, and summary and checkpoint are written, all within the bound.
#[track_caller]
fn abandoned(keys: &[&str]) {
    const BOUND: Duration = Duration::from_secs(20);
    let within = BOUND.as_secs().to_string();
    let mut run = Run::start_with(&gyre(), keys, None, |command| {
        command.args(["--stop-within", &within]);
    });
    run.prints("colours from FTLE");
    // Pilot and probes come before the frame, and take a moment.
    std::thread::sleep(Duration::from_millis(4000));
    let begin = Instant::now();
    run.process().signal(libc::SIGTERM);
    run.prints("finishing the current frame, for 10 s at most");
    run.prints("the frame in progress is abandoned");
    assert_eq!(run.ended_in_order(143), 0, "{keys:?}");
    let took = begin.elapsed();
    assert!(took < BOUND + Duration::from_secs(1), "{keys:?}: {took:?}");
    assert!(run.weights().exists(), "the checkpoint is written");
}

#[test]
fn a_gated_frame_is_abandoned_in_time() {
    abandoned(&["render.width=64", "render.height=32", "render.samples=16000000", "render.method=gated"]);
}

/// A picture that is small enough for the pilot, with more samples than a wave can hold.
const SLOW_PATHS: [&str; 6] =
    ["flow.steps=4000", "trust.cells=[2, 1, 1]", "trust.min_samples=4", "render.width=16", "render.height=8", "render.samples=4000"];

#[test]
fn a_frame_whose_paths_are_slow_is_abandoned_in_time() {
    // A single wave of such paths takes minutes.
    abandoned(&[&SLOW_PATHS[..], &["render.method=gated"]].concat());
}

#[test]
fn a_smooth_frame_is_abandoned_in_time() {
    abandoned(&[&SLOW_PATHS[..], &["render.method=two_level"]].concat());
}

/// Whatever cannot be interrupted, the process ends in time.
#[test]
fn the_bound_holds_where_the_work_does_not_end() {
    // Training looks for a stop every 32 steps. How long these take depends on the machine, so the bound becomes shorter until they outlast it.
    let keys = ["training.steps_per_frame=1000", "network.batch=1048576", "network.width=128"];
    let ended_at_once = [2.0, 0.5, 0.1, 0.02].into_iter().any(|bound: f64| {
        let mut run = Run::start_with(&gyre(), &keys, None, |command| {
            command.args(["--threads", "1", "--stop-within", &bound.to_string()]);
        });
        run.prints("colours from FTLE");
        std::thread::sleep(Duration::from_millis(3000));
        let begin = Instant::now();
        run.process().signal(libc::SIGTERM);
        let output = run.ended().refused(143, &[]);
        assert!(begin.elapsed().as_secs_f64() < bound + 1.0, "{:?}: {}", begin.elapsed(), output.stderr);
        output.stderr.contains("stopped at once")
    });
    assert!(ended_at_once, "the work ended by itself within every bound");
}

#[test]
fn a_relay_that_is_stopped_leaves_no_key() {
    let folder = tempfile::tempdir_in("/dev/shm").unwrap();
    let key = folder.path().join("key");
    for pause in [0, 1, 20] {
        let (ring, key) = (folder.path().join("ring"), key.clone());
        let mut relay = start(&mut program::ridgewatch(["relay", text(&ring), "--connection", text(&key)]));
        until("the key", || key.exists() && relay.stderr().contains("relaying"));
        for _ in 0..3 {
            relay.signal(libc::SIGTERM);
            std::thread::sleep(Duration::from_millis(pause));
            if relay.has_ended() {
                break;
            }
        }
        relay.wait_at_most(SOON).success();
        assert!(!key.exists(), "signals {pause} ms apart");
    }
}

#[test]
fn a_second_signal_ends_at_once() {
    // The first signal lets the frame finish.
    let mut run = Run::start(&gyre(), &LONG_FRAME, None);
    run.prints("colours from FTLE");
    std::thread::sleep(Duration::from_millis(3000));
    run.process().signal(libc::SIGINT);
    run.prints("finishing the current frame; once more to stop at once");
    // Later than signals of one stop may come.
    std::thread::sleep(Duration::from_millis(1500));
    assert!(!run.process().has_ended(), "the current frame is finished first");
    run.process().signal(libc::SIGINT);
    run.prints("stopped at once");
    run.ended().refused(130, &[]);
    assert!(!run.folder.join("summary.json").exists());
}
