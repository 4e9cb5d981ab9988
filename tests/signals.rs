//! A signal at any moment of a replay: the run ends soon, and its folder is complete. Every scene here would go on for many minutes
//! in the stage that the signal meets.

#![allow(clippy::unwrap_used)]
#![cfg(unix)]

use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};
use std::time::{Duration, Instant};

/// Longest that a run may go on after the signal. It looks up about twice a second; the rest is a slow and busy machine.
const SOON: Duration = Duration::from_secs(120);

const GYRE: &str = "[source]\nkind = \"double_gyre\"\n[domain]\nmin = [0, 0, 0]\nmax = [2, 1, 0.2]\n[time]\ntau = 10\nslides = 3\n\
                    [transfer]\nlow = 0.05\nhigh = 0.45\n[surrogate]\nkind = \"network\"\n[flow]\nsteps = 20\n\
                    [render]\nwidth = 32\nheight = 16\nsamples = 1\n[training]\nsteps_per_frame = 20\n";

struct Run {
    child: Option<Child>,
    folder: PathBuf,
    _temporary: tempfile::TempDir,
}

impl Drop for Run {
    /// A failed test leaves no process behind.
    fn drop(&mut self) {
        if let Some(child) = &mut self.child {
            let _ = child.kill();
            let _ = child.wait();
        }
    }
}

impl Run {
    /// A replay that writes its checkpoint into [`Run::weights`].
    fn start(scene: &str, set: &[&str]) -> Self {
        let method = if set.contains(&"surrogate.kind=table") { None } else { Some("--checkpoint") };
        Self::spawn(scene, set, method, None)
    }

    fn resume(scene: &str, set: &[&str], weights: &Path) -> Self {
        Self::spawn(scene, set, None, Some(weights))
    }

    fn weights(&self) -> PathBuf {
        self.folder.with_file_name("weights.safetensors")
    }

    fn spawn(scene: &str, set: &[&str], checkpoint: Option<&str>, resume: Option<&Path>) -> Self {
        let temporary = tempfile::tempdir().unwrap();
        let path = temporary.path().join("scene.toml");
        std::fs::write(&path, scene).unwrap();
        let folder = temporary.path().join("run");
        let mut command = Command::new(env!("CARGO_BIN_EXE_ridgewatch"));
        command.arg("replay").arg(path).arg("--out").arg(&folder).args(set.iter().flat_map(|set| ["--set", set]));
        if let Some(option) = checkpoint {
            command.arg(option).arg(folder.with_file_name("weights.safetensors"));
        }
        if let Some(weights) = resume {
            command.arg("--resume").arg(weights);
        }
        let child = command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
        let run = Self { child: Some(child), folder, _temporary: temporary };
        run.wait_for("records.jsonl");
        run
    }

    fn wait_for(&self, name: &str) {
        let deadline = Instant::now() + Duration::from_secs(300);
        while !self.folder.join(name).exists() {
            assert!(Instant::now() < deadline, "no {name} within five minutes");
            std::thread::sleep(Duration::from_millis(10));
        }
    }

    fn signal(&self, name: &str) {
        let id = self.child.as_ref().unwrap().id().to_string();
        assert!(Command::new("kill").args([name, &id]).status().unwrap().success());
    }

    /// Waits for the end, which must come soon.
    fn ended(&mut self) -> Output {
        let deadline = Instant::now() + SOON;
        let mut child = self.child.take().unwrap();
        while child.try_wait().unwrap().is_none() {
            if Instant::now() > deadline {
                let _ = child.kill();
                panic!("still there {SOON:?} after the signal: {:?}", child.wait_with_output());
            }
            std::thread::sleep(Duration::from_millis(20));
        }
        child.wait_with_output().unwrap()
    }

    /// Ends in order with this exit status; the folder says so and holds as many records as frames.
    fn ended_in_order(&mut self, status: i32) -> u64 {
        let output = self.ended();
        let said = String::from_utf8_lossy(&output.stderr).into_owned();
        assert!(output.status.code() == Some(status) && !said.contains("panicked"), "{:?} {said}", output.status);
        let summary: serde_json::Value = serde_json::from_slice(&std::fs::read(self.folder.join("summary.json")).unwrap()).unwrap();
        assert_eq!(summary["run"]["interrupted"], true, "{summary}");
        let frames = summary["run"]["frames"].as_u64().unwrap();
        let records = std::fs::read_to_string(self.folder.join("records.jsonl")).unwrap();
        assert_eq!(records.lines().count() as u64, frames);
        let out = String::from_utf8_lossy(&output.stdout).into_owned();
        assert_eq!(out.contains("Runge-Kutta steps a path"), frames > 0, "of what was not traced nothing is told: {out}");
        assert!(records.lines().all(|line| serde_json::from_str::<serde_json::Value>(line).is_ok()));
        frames
    }
}

/// Starts, gives the run time to get into its first stage, and signals.
fn stopped_while_preparing(set: &[&str]) {
    let mut run = Run::start(GYRE, set);
    std::thread::sleep(Duration::from_millis(500));
    run.signal("-TERM");
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
    let scene = "[source]\nkind = \"turbulence\"\nnodes = [128, 128, 128]\nmodes = 4096\n[time]\ntau = 11\n";
    let mut run = Run::start(scene, &[]);
    run.signal("-INT");
    assert_eq!(run.ended_in_order(130), 0);
}

#[test]
fn while_training() {
    let mut run = Run::start(GYRE, &["training.steps_per_frame=100000000"]);
    // Rendering such a frame takes a moment, its training would take days.
    std::thread::sleep(Duration::from_millis(1500));
    run.signal("-TERM");
    assert!(run.ended_in_order(143) <= 1, "the frame in progress is finished, and no other begun");
}

#[test]
fn while_a_slide_is_prepared_what_was_learned_is_kept() {
    // The table of the first slide is small; later slides come every moment, and most of the time goes into tracing tables.
    let set = ["surrogate.kind=residual", "surrogate.table_nodes=[512, 256, 2]", "time.slides=100000", "trust.cells=[4, 4, 1]"];
    let mut run = Run::start(GYRE, &set);
    run.wait_for("frames/frame_000002.png");
    std::thread::sleep(Duration::from_millis(137));
    run.signal("-TERM");
    assert!(run.ended_in_order(143) >= 3);
    assert!(run.weights().exists(), "the checkpoint is written");
    let mut resumed = Run::resume(GYRE, &set[..2], &run.weights());
    let output = resumed.ended();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
}

#[test]
fn a_second_signal_ends_at_once() {
    // One frame of many minutes, prepared in a moment: the first signal lets it finish.
    let mut run = Run::start(GYRE, &["render.width=64", "render.height=32", "render.samples=16000000", "render.method=surrogate"]);
    // What is said before the slide is prepared, and behind each signal.
    let said = BufReader::new(run.child.as_mut().unwrap().stderr.take().unwrap()).lines().map(Result::unwrap);
    let (tell, told) = std::sync::mpsc::channel();
    std::thread::spawn(move || said.for_each(|line| drop(tell.send(line))));
    let hears = |words: &str| while !told.recv_timeout(SOON).unwrap_or_else(|_| panic!("it does not say: {words}")).contains(words) {};
    hears("colours from FTLE");
    std::thread::sleep(Duration::from_millis(3000));
    run.signal("-INT");
    hears("finishing the current frame; once more to stop at once");
    std::thread::sleep(Duration::from_millis(500));
    assert!(run.child.as_mut().unwrap().try_wait().unwrap().is_none(), "the current frame is finished first");
    run.signal("-INT");
    hears("stopped at once");
    assert_eq!(run.ended().status.code(), Some(130));
    assert!(!run.folder.join("summary.json").exists());
}
