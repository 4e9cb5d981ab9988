//! Through the front door: what a user types, and what comes back. Every refusal is one clear message with exit status 1 or 2,
//! nothing half-written, no panic.

#![allow(clippy::unwrap_used)]

use std::path::{Path, PathBuf};
use std::process::{Command, Output};

fn ridgewatch(arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_ridgewatch")).args(arguments).output().unwrap()
}

fn config(name: &str) -> String {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("configs").join(name).display().to_string()
}

fn standard_error(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).into_owned()
}

/// Asserts the status and that one message of standard error holds all `parts`.
fn refused(arguments: &[&str], status: i32, parts: &[&str]) {
    // Defaults such as `out/run` are relative: nothing of this may touch the project's own folder.
    let elsewhere = tempfile::tempdir().unwrap();
    let output = Command::new(env!("CARGO_BIN_EXE_ridgewatch")).args(arguments).current_dir(elsewhere.path()).output().unwrap();
    let said = standard_error(&output);
    assert_eq!(output.status.code(), Some(status), "{arguments:?}: {said}");
    assert!(!said.contains("panicked"), "{said}");
    for part in parts {
        assert!(said.contains(part), "{arguments:?} says {said:?}, without {part:?}");
    }
}

/// A small double gyre scene in a folder of its own.
fn small_scene(folder: &Path, more: &str) -> String {
    let path = folder.join("scene.toml");
    let text = format!(
        "[source]\nkind = \"double_gyre\"\n[domain]\nmin = [0, 0, 0]\nmax = [2, 1, 0.2]\n[time]\ntau = 2\nseed_step = 0.1\nslides = 2\n\
         [flow]\nsteps = 20\n[render]\nwidth = 32\nheight = 16\nsamples = 2\n[training]\nsteps_per_frame = 20\n[surrogate]\nkind = \"network\"\n{more}"
    );
    std::fs::write(&path, text).unwrap();
    path.display().to_string()
}

#[test]
fn bad_usage_is_status_2() {
    refused(&["replay"], 2, &["CONFIG | FILES"]);
    refused(&["dance"], 2, &["dance"]);
    refused(&["attach", "--exit-at-end"], 2, &["`--exit-at-end` has a new name; accepted: `--exit-at-end`"]);
    refused(&["replay", &config("saddle.toml"), "--threads", "99999999999"], 2, &["--threads", "0 to 1024"]);
    for rate in ["1e-300", "0", "-1", "nan", "inf"] {
        refused(&["publish", &config("turbulence_easy.toml"), &format!("--rate={rate}")], 2, &["--rate", "from 0.000001"]);
    }
    refused(&["render", &config("saddle.toml"), "--device", "tpu"], 2, &["--device tpu", "auto, cpu"]);
    refused(&["render", &config("saddle.toml"), "--method", "magic"], 2, &["reference, surrogate, neural, gated"]);
    refused(&["render", &config("saddle.toml"), "--out", "picture.tiff"], 2, &[".exr or .png"]);
}

/// A full disk behind standard error: exit statuses stay what they are, and a run goes to its end.
#[test]
fn what_cannot_be_said_ends_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let scene = small_scene(folder.path(), "");
    let full = || std::fs::OpenOptions::new().write(true).open("/dev/full").unwrap();
    let status = |arguments: &[&str]| {
        let mut command = Command::new(env!("CARGO_BIN_EXE_ridgewatch"));
        // Where there is no GPU, the log says so too.
        command.args(arguments).current_dir(folder.path()).env("RIDGEWATCH_LOG", "ridgewatch=trace");
        command.stdout(std::process::Stdio::null()).stderr(full()).status().unwrap().code()
    };
    assert_eq!(status(&["replay", "nowhere.toml"]), Some(2));
    assert_eq!(status(&["replay", &scene, "--publish", "tcp://127.0.0.1:0", "--out", "run"]), Some(0));
    assert!(folder.path().join("run/summary.json").exists());
}

#[test]
fn bad_scenes_are_status_2_and_point_at_the_line() {
    let folder = tempfile::tempdir().unwrap();
    refused(
        &["replay", &small_scene(folder.path(), "[trust]\ntolerence = 1\n")],
        2,
        &["scene.toml:", "tolerence", "Did you mean `tolerance`?"],
    );
    refused(
        &["replay", &small_scene(folder.path(), "[trust]\ntolerance = -1\n")],
        2,
        &["scene.toml:", "`trust.tolerance` is -1", "above 0"],
    );
    refused(&["replay", &small_scene(folder.path(), ""), "--set", "render.width=0"], 2, &["--set render.width=0", "1 to 16384"]);
    refused(
        &["replay", &small_scene(folder.path(), "[camera]\neye=[1,1,1]\nlook_at=[1,1,1]\nup=[0,1,0]\n")],
        2,
        &["scene.toml:", "`camera.look_at`"],
    );
    refused(&["replay", &folder.path().join("none.toml").display().to_string()], 2, &["cannot read", "none.toml"]);
}

#[test]
fn settings_that_only_the_data_show_to_be_wrong_are_status_2_and_point_at_the_line() {
    let folder = tempfile::tempdir().unwrap();
    let scene = |more: &str| small_scene(folder.path(), more);
    // More than the f32 walk can resolve: 1e6 times the box's diagonal.
    refused(
        &["replay", &scene("[transfer]\nlow = 0\nhigh = 1\nextinction = 1e6\n")],
        2,
        &["scene.toml:", "`transfer.extinction`", "| extinction = 1e6"],
    );
    let gap = ["--set", "flow.integrator=differences", "--set", "flow.difference_step=1e-9"];
    refused(&[&["ftle", &scene("")][..], &gap].concat(), 2, &["--set flow.difference_step=1e-9", "`flow.difference_step`", "at least"]);
    refused(&["replay", &scene("[publish]\nendpoint = \"udp://x\"\n")], 2, &["scene.toml:", "`publish.endpoint`", "tcp://HOST:PORT"]);
    refused(&["replay", &scene(""), "--publish", "udp://x"], 2, &["--publish udp://x", "`publish.endpoint`"]);
    refused(&["render", &scene(""), "--spp", "0"], 2, &["--spp 0", "`render.samples`"]);
}

#[test]
fn checkpoints_are_refused_where_nothing_learns() {
    let folder = tempfile::tempdir().unwrap();
    let scene = small_scene(folder.path(), "");
    for option in ["--checkpoint", "--resume"] {
        refused(&["replay", &scene, "--method", "reference", option, "w.safetensors"], 2, &[option, "no surrogate", "gated"]);
        refused(&["replay", &scene, "--set", "surrogate.kind=table", option, "w.safetensors"], 2, &[option, "table", "residual"]);
    }
    refused(&["render", &scene, "--method", "reference", "--resume", "w.safetensors"], 2, &["--resume", "no surrogate"]);
    let absent = folder.path().join("absent.safetensors").display().to_string();
    refused(&["replay", &scene, "--resume", &absent], 1, &["absent.safetensors"]);
}

#[test]
fn missing_and_broken_files_are_named() {
    let folder = tempfile::tempdir().unwrap();
    let broken = folder.path().join("broken.nc");
    std::fs::write(&broken, b"CDF\x01 and then nothing").unwrap();
    refused(&["inspect", &broken.display().to_string()], 1, &["broken.nc"]);
    refused(&["inspect", &folder.path().join("absent.nc").display().to_string()], 1, &["absent.nc"]);
    refused(&["replay", &folder.path().join("*.nc").display().to_string().replace("*.nc", "none-*.nc")], 1, &["none-*.nc"]);
    refused(&["compare", "absent_a.exr", "absent_b.exr"], 1, &["absent_a.exr"]);
}

#[test]
fn a_folder_that_cannot_be_written_is_refused_before_work_starts() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("file");
    std::fs::write(&file, "").unwrap();
    let scene = small_scene(folder.path(), "");
    let below = file.join("run").display().to_string();
    refused(&["replay", &scene, "--out", &below], 1, &[&below]);
}

#[test]
fn a_port_in_use_is_refused_before_work_starts() {
    let folder = tempfile::tempdir().unwrap();
    let taken = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    let endpoint = format!("tcp://127.0.0.1:{}", taken.local_addr().unwrap().port());
    let out = folder.path().join("run").display().to_string();
    refused(&["replay", &small_scene(folder.path(), ""), "--out", &out, "--publish", &endpoint], 1, &[&endpoint]);
}

#[test]
fn a_replay_leaves_a_complete_folder_and_refuses_to_mix_runs() {
    let folder = tempfile::tempdir().unwrap();
    let scene = small_scene(folder.path(), "");
    let run: PathBuf = folder.path().join("run");
    let out = run.display().to_string();
    let output = ridgewatch(&["replay", &scene, "--out", &out, "--json", "--verify", "512"]);
    assert!(output.status.success(), "{}", standard_error(&output));
    let summary: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
    let on_disk: serde_json::Value = serde_json::from_slice(&std::fs::read(run.join("summary.json")).unwrap()).unwrap();
    assert_eq!(summary, on_disk, "--json prints the summary");
    let records = std::fs::read_to_string(run.join("records.jsonl")).unwrap();
    let records: Vec<serde_json::Value> = records.lines().map(|l| serde_json::from_str(l).unwrap()).collect();
    assert_eq!(records.len(), 2);
    for record in &records {
        let number = |key: &str| record[key].as_f64().unwrap();
        assert!((number("traced_share") - number("traced") / number("queries")).abs() < 1e-12);
        assert!(number("trusted_volume") < 1.0, "an untrained network is not trusted everywhere: {record}");
    }
    assert!(records.iter().all(|r| r["queries"].as_u64() > Some(0)));
    for name in ["frame_000000.exr", "frame_000001.exr", "frame_000000.png", "frame_000001.png"] {
        assert!(run.join("frames").join(name).exists(), "{name}");
    }
    refused(&["replay", &scene, "--out", &out], 1, &["--overwrite"]);
    let again = ridgewatch(&["replay", &scene, "--out", &out, "--overwrite", "--keep", "1"]);
    assert!(again.status.success(), "{}", standard_error(&again));
    assert!(!run.join("frames/frame_000000.exr").exists() && run.join("frames/frame_000001.exr").exists());
}

#[test]
fn the_same_scene_gives_the_same_picture_on_any_number_of_threads() {
    let folder = tempfile::tempdir().unwrap();
    let scene = small_scene(folder.path(), "");
    let out = |n: &str| folder.path().join(format!("{n}.exr")).display().to_string();
    for threads in ["1", "2", "5"] {
        let output = ridgewatch(&["render", &scene, "--method", "reference", "--threads", threads, "--out", &out(threads)]);
        assert!(output.status.success(), "{}", standard_error(&output));
    }
    for other in ["2", "5"] {
        let output = ridgewatch(&["compare", &out("1"), &out(other), "--json"]);
        let comparison: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
        assert_eq!(comparison["max_abs_difference"], 0.0, "{comparison}");
    }
}

#[test]
fn a_signal_ends_the_run_after_the_current_frame() {
    let folder = tempfile::tempdir().unwrap();
    let scene = small_scene(folder.path(), "");
    let run = folder.path().join("run");
    let child = Command::new(env!("CARGO_BIN_EXE_ridgewatch"))
        .args(["replay", &scene, "--set", "time.slides=100000", "--out", &run.display().to_string()])
        .stderr(std::process::Stdio::piped())
        .spawn()
        .unwrap();
    let deadline = std::time::Instant::now() + std::time::Duration::from_secs(300);
    while !run.join("frames/frame_000002.exr").exists() {
        assert!(std::time::Instant::now() < deadline, "no frame within five minutes");
        std::thread::sleep(std::time::Duration::from_millis(50));
    }
    assert!(Command::new("kill").args(["-TERM", &child.id().to_string()]).status().unwrap().success());
    let output = child.wait_with_output().unwrap();
    assert_eq!(output.status.code(), Some(143), "{}", standard_error(&output));
    let summary: serde_json::Value = serde_json::from_slice(&std::fs::read(run.join("summary.json")).unwrap()).unwrap();
    assert_eq!(summary["run"]["interrupted"], true);
    let frames = summary["run"]["frames"].as_u64().unwrap() as usize;
    assert_eq!(std::fs::read_to_string(run.join("records.jsonl")).unwrap().lines().count(), frames);
    let leftovers = std::fs::read_dir(run.join("frames")).unwrap().filter(|e| {
        let name = e.as_ref().unwrap().file_name().into_string().unwrap();
        !(name.starts_with("frame_") && (name.ends_with(".exr") || name.ends_with(".png")))
    });
    assert_eq!(leftovers.count(), 0, "no half-written file");
}

#[test]
fn an_archive_shorter_than_tau_says_how_many_snapshots_are_needed() {
    let scene = config("turbulence_easy.toml");
    refused(&["render", &scene, "--set", "source.snapshots=6", "--set", "source.nodes=[16,8,8]"], 1, &["needs 12 snapshots", "has 6"]);
}

#[test]
fn every_shipped_scene_is_accepted() {
    let folder = tempfile::tempdir().unwrap();
    for entry in std::fs::read_dir(Path::new(env!("CARGO_MANIFEST_DIR")).join("configs")).unwrap() {
        let path = entry.unwrap().path();
        ridgewatch::config::SceneFile::read(&path, &[]).unwrap_or_else(|e| panic!("{e}"));
    }
    let out = folder.path().join("t.exr").display().to_string();
    let tiny = ["--set", "source.nodes=[16,8,8]", "--set", "render.width=16", "--set", "render.height=8", "--spp", "1", "--warmup", "1"];
    let mut arguments = vec!["render", "--out", &out];
    let scene = config("turbulence_easy.toml");
    arguments.push(&scene);
    arguments.extend(tiny);
    let output = ridgewatch(&arguments);
    assert!(output.status.success(), "{}", standard_error(&output));
}
