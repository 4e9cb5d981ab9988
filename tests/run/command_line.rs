//! The command line: what a user types, and what comes back. Every refusal is one clear message with exit status 1 or 2, without a
//! half-written file and without a panic.

use crate::kit::program::{config, records, run, start, summary, text, until};
use crate::kit::{program, scene};
use crate::ridgewatch;
use std::os::unix::process::CommandExt;
use std::path::Path;

/// Asserts the status and that standard error holds all `parts`.
#[track_caller]
fn refused(arguments: &[&str], status: i32, parts: &[&str]) {
    // Defaults such as `out/run` are relative: they must not touch the folder of the project.
    let elsewhere = tempfile::tempdir().unwrap();
    run(program::ridgewatch(arguments).current_dir(elsewhere.path())).refused(status, parts);
}

/// A small scene of the double gyre, written into a folder, with more tables.
fn small_scene(folder: &Path, more: &str) -> String {
    let keys = "
        time.tau = 2
        time.seed_step = 0.1
        time.slides = 2
        flow.steps = 20
        training.steps_per_frame = 20
        surrogate.kind = \"network\"
    ";
    scene::write(folder, &(scene::double_gyre([32, 16, 2], keys) + more))
}

#[test]
fn bad_usage_is_status_2() {
    refused(&["replay"], 2, &["CONFIG | FILES"]);
    refused(&["dance"], 2, &["dance"]);
    refused(&["attach", "--once"], 2, &["`--once` has a new name; accepted: `--exit-at-end`"]);
    refused(&["replay", &config("saddle.toml"), "--threads", "99999999999"], 2, &["--threads", "0 to 1024"]);
    for rate in ["1e-300", "0", "-1", "nan", "inf"] {
        refused(&["publish", &config("turbulence_easy.toml"), &format!("--rate={rate}")], 2, &["--rate", "from 0.000001"]);
    }
    refused(&["render", &config("saddle.toml"), "--device", "tpu"], 2, &["--device tpu", "auto, cpu"]);
    refused(&["render", &config("saddle.toml"), "--method", "magic"], 2, &["reference, surrogate, neural, gated"]);
    refused(&["render", &config("saddle.toml"), "--out", "picture.tiff"], 2, &[".exr or .png"]);
}

#[test]
fn options_without_effect_are_refused_or_told() {
    let gyre = config("double_gyre.toml");
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("map.png");
    for method in ["reference", "map"] {
        let small = ["--method", method, "--set", "render.width=8", "--set", "render.height=4"];
        let wanted = format!("--verify 100: method {method} has no surrogate");
        refused(&[&["render", &gyre, "--verify", "100"], &small[..]].concat(), 2, &[&wanted, "two_level, marched"]);
        refused(&[&["replay", &gyre, "--verify", "100"], &small[..]].concat(), 2, &[&wanted, "two_level, marched"]);
    }
    let base = ["render", &gyre, "--device", "cpu", "--method", "map", "--set", "render.width=8", "--set", "render.height=4"];
    let keys = ["--set", "render.tone_map=[1,0.5,1]", "--set", "render.combine=\"sum\"", "--set", "trust.tolerance=0.2"];
    let said = |keys: &[&str]| run(&mut program::ridgewatch([&base[..], keys, &["--out", text(&out)]].concat())).success().stderr;
    let told = said(&keys);
    assert!(told.contains("without effect on a map: light, transfer.extinction, render.combine, trust, render.tone_map"), "{told}");
    // What the scene sets for its volume is told as well.
    let told = said(&[]);
    assert!(told.contains("without effect on a map: light, transfer.extinction\n"), "{told}");
}

/// A result that nobody got is no success, unlike one whose reader has left.
#[test]
fn a_result_that_cannot_be_written_is_an_error() {
    let folder = tempfile::tempdir().unwrap();
    let mut command = program::ridgewatch(["doctor", "--json"]);
    let full = || std::fs::OpenOptions::new().write(true).open("/dev/full").unwrap();
    assert_eq!(command.stdout(full()).stderr(std::process::Stdio::null()).status().unwrap().code(), Some(1));
    let scene = small_scene(folder.path(), "");
    let mut command = program::ridgewatch(["replay", &scene, "--json", "--out", "run"]);
    let done = command.current_dir(folder.path()).stdout(full()).output().unwrap();
    let said = String::from_utf8_lossy(&done.stderr);
    assert!(done.status.code() == Some(1) && said.contains("the result cannot be written to standard output: No space left"), "{said}");
    assert!(folder.path().join("run/summary.json").exists());
    // What is for people is no less a result.
    let mut command = program::ridgewatch(["doctor"]);
    assert_eq!(command.stdout(full()).stderr(std::process::Stdio::null()).status().unwrap().code(), Some(1));
    let (reader, writer) = std::io::pipe().unwrap();
    drop(reader);
    assert_eq!(program::ridgewatch(["doctor", "--json"]).stdout(writer).status().unwrap().code(), Some(0));
}

#[test]
fn settings_without_a_scene_and_files_of_unknown_endings_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let scene = small_scene(folder.path(), "");
    refused(&["doctor", "--set", "render.width=9"], 2, &["--set: doctor has no scene"]);
    refused(&["compare", "a.exr", "b.exr", "--set", "render.width=9"], 2, &["--set: compare has no scene"]);
    refused(&["ftle", &scene, "--out", "field.png"], 2, &["--out field.png", ".nc, .vti, .vtr or .vts", "--format"]);
    refused(&["render", &scene, "--spp", "4", "--budget", "10"], 2, &["--spp", "--budget"]);
    refused(&["render", &scene, "--method", "reference", "--until", "40dB"], 2, &["--until", "40dB", "marched"]);
}

#[test]
fn a_run_that_its_time_ended_says_so() {
    let folder = tempfile::tempdir().unwrap();
    let scene = small_scene(folder.path(), "");
    let mut command = program::ridgewatch(["replay", &scene, "--seconds", "0.001", "--out", "run", "--set", "time.slides=4000"]);
    let told = run(command.current_dir(folder.path())).success().stdout;
    assert!(told.contains("; --seconds ended the run, which has 4000 slides"), "{told}");
    let summary: serde_json::Value = serde_json::from_slice(&std::fs::read(folder.path().join("run/summary.json")).unwrap()).unwrap();
    let of = |key: &str| summary["run"][key].clone();
    assert_eq!((of("time_is_up"), of("slides_expected"), of("interrupted")), (true.into(), 4000.into(), false.into()));
}

/// However few threads the system grants, a run ends, with an error or without the help of those that are missing.
#[test]
fn threads_that_are_refused_end_no_run_in_a_panic() {
    /// A user without other processes, whom a limit counts alone; another user than root can only be refused every thread.
    const USER: u32 = 54_321;
    let folder = tempfile::tempdir().unwrap();
    let scene = small_scene(folder.path(), "");
    let program = folder.path().join("ridgewatch");
    std::fs::copy(env!("CARGO_BIN_EXE_ridgewatch"), &program).unwrap();
    // SAFETY: has no arguments and cannot fail.
    let is_root = unsafe { libc::geteuid() } == 0;
    if is_root {
        std::os::unix::fs::chown(folder.path(), Some(USER), None).unwrap();
    }
    for limit in (1..12).chain([16, 24]) {
        let out = format!("run-{limit}");
        let mut command = std::process::Command::new(&program);
        command.args(["replay", &scene, "--threads", "2", "--stop-within", "30", "--out", &out]).current_dir(folder.path());
        if is_root {
            command.uid(USER);
        }
        // SAFETY: between fork and exec, only `setrlimit` is called, which is safe there.
        unsafe {
            command.pre_exec(move || {
                let limit = libc::rlimit { rlim_cur: limit, rlim_max: limit };
                if libc::setrlimit(libc::RLIMIT_NPROC, &raw const limit) == 0 { Ok(()) } else { Err(std::io::Error::last_os_error()) }
            })
        };
        let done = start(&mut command).wait_at_most(std::time::Duration::from_secs(120));
        assert!(matches!(done.status, Some(0 | 1)) && !done.stderr.contains("panicked"), "{limit} threads: {done:?}");
    }
}

/// Two runs in one folder would mix their frames.
#[test]
fn a_folder_takes_one_run_at_a_time() {
    let folder = tempfile::tempdir().unwrap();
    let scene = small_scene(folder.path(), "");
    let command = |more: &[&str]| {
        let mut command = program::ridgewatch([&["replay", &scene, "--out", "run"], more].concat());
        command.current_dir(folder.path());
        command
    };
    let first = start(&mut command(&["--set", "training.steps_per_frame=100000000"]));
    until("the first run", || folder.path().join("run/records.jsonl").exists());
    let holder = format!("run folder run is in use by process {}", first.id());
    for more in [&[][..], &["--overwrite"]] {
        run(&mut command(more)).refused(1, &[&holder]);
    }
    first.signal(libc::SIGTERM);
    first.wait().refused(143, &[]);
    run(&mut command(&["--overwrite"])).success();
    assert_eq!(summary(&folder.path().join("run"))["run"]["interrupted"], false);
}

/// A scene of somebody else may have files written inside `out/` only.
#[test]
fn a_scene_file_chooses_no_folder_outside_of_out() {
    let folder = tempfile::tempdir().unwrap();
    let target = folder.path().join("elsewhere");
    let write = |written: &str| {
        let archive = format!("[archive.synthetic]\nshape = \"flame\"\nnodes = [8, 8, 8]\nsnapshots = 3\nfolder = {written:?}\n");
        scene::write(folder.path(), &format!("[source]\nkind = \"archive\"\n[time]\ntau = 1\n{archive}"))
    };
    let inspect = |scene: &str, more: &[&str]| {
        let mut command = program::ridgewatch([&["inspect", scene], more].concat());
        run(command.current_dir(folder.path()))
    };
    for written in [text(&target), "elsewhere", "../elsewhere", "out/../elsewhere"] {
        inspect(&write(written), &[])
            .refused(2, &["scene.toml:", "archive.synthetic.folder", "inside out/ of the working directory", "--set"]);
        assert!(!target.exists());
    }
    inspect(&write("out/mine"), &[]).success();
    assert!(folder.path().join("out/mine").exists());
    inspect(&write(text(&target)), &["--set", &format!("archive.synthetic.folder={:?}", text(&target))]).success();
    assert!(target.exists());
    let socket = format!("[publish]\nendpoint = \"ipc://{}\"\n", text(&folder.path().join("socket")));
    let scene = scene::write(folder.path(), &(scene::double_gyre([8, 4, 1], "time.tau = 1") + &socket));
    let mut command = program::ridgewatch(["replay", &scene, "--out", "out/run"]);
    run(command.current_dir(folder.path())).refused(2, &["scene.toml:", "publish.endpoint", "--set publish.endpoint"]);
}

/// Standard error on a full disk changes no exit status, and a run goes to its end.
#[test]
fn what_cannot_be_said_ends_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let scene = small_scene(folder.path(), "");
    let full = || std::fs::OpenOptions::new().write(true).open("/dev/full").unwrap();
    let status = |arguments: &[&str]| {
        let mut command = program::ridgewatch(arguments);
        // Without a GPU, the log says so as well.
        command.current_dir(folder.path()).env("RIDGEWATCH_LOG", "ridgewatch=trace");
        command.stdout(std::process::Stdio::null()).stderr(full()).status().unwrap().code()
    };
    assert_eq!(status(&["replay", "nowhere.toml"]), Some(2));
    assert_eq!(status(&["replay", &scene, "--publish", "tcp://127.0.0.1:0", "--out", "run"]), Some(0));
    assert!(folder.path().join("run/summary.json").exists());
}

#[test]
fn bad_scenes_are_status_2_and_point_at_the_line() {
    let folder = tempfile::tempdir().unwrap();
    for (more, parts) in [
        ("[trust]\ntolerence = 1\n", ["scene.toml:", "tolerence", "Did you mean `tolerance`?"]),
        ("[trust]\ntolerance = -1\n", ["scene.toml:", "`trust.tolerance` is -1", "above 0"]),
        ("[camera]\neye=[1,1,1]\nlook_at=[1,1,1]\nup=[0,1,0]\n", ["scene.toml:", "`camera.look_at`", ""]),
    ] {
        refused(&["replay", &small_scene(folder.path(), more)], 2, &parts);
    }
    refused(&["replay", &small_scene(folder.path(), ""), "--set", "render.width=0"], 2, &["--set render.width=0", "1 to 16384"]);
    refused(&["replay", text(&folder.path().join("none.toml"))], 2, &["cannot read", "none.toml"]);
}

#[test]
fn settings_that_only_the_data_show_to_be_wrong_are_status_2_and_point_at_the_line() {
    let folder = tempfile::tempdir().unwrap();
    let scene = |more: &str| small_scene(folder.path(), more);
    // Collisions closer than f32 can resolve: 1e6 along the diagonal of the box.
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
    refused(&["inspect", text(&broken)], 1, &["broken.nc"]);
    refused(&["inspect", text(&folder.path().join("absent.nc"))], 1, &["absent.nc"]);
    refused(&["replay", text(&folder.path().join("none-*.nc"))], 1, &["none-*.nc"]);
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

/// Without an endpoint, frames are offered where only this user reaches them.
#[test]
fn frames_are_published_at_a_private_socket() {
    use std::os::unix::fs::PermissionsExt;
    let folder = tempfile::tempdir().unwrap();
    let (scene, runtime) = (small_scene(folder.path(), ""), folder.path().join("runtime"));
    std::fs::create_dir(&runtime).unwrap();
    std::fs::set_permissions(&runtime, std::fs::Permissions::from_mode(0o700)).unwrap();
    let publish = || {
        let mut command = program::ridgewatch(["replay", &scene, "--publish", "--overwrite", "--out"]);
        let output = command.arg(folder.path().join("run")).env("XDG_RUNTIME_DIR", &runtime).output().unwrap();
        (output.status.code(), String::from_utf8(output.stderr).unwrap())
    };
    let socket = runtime.join("ridgewatch/frames");
    let (status, said) = publish();
    assert_eq!(status, Some(0), "{said}");
    assert!(said.contains(&format!("publishing at ipc://{}", socket.display())), "{said}");
    assert!(!socket.exists(), "its file is removed at the end");
    assert_eq!(runtime.join("ridgewatch").metadata().unwrap().permissions().mode() & 0o777, 0o700);
    let _taken = std::os::unix::net::UnixListener::bind(&socket).unwrap();
    let (status, said) = publish();
    assert!(status == Some(1) && said.contains(socket.to_str().unwrap()) && said.contains("in use"), "{said}");
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
    let run = folder.path().join("run");
    let out = text(&run);
    let output = ridgewatch(["replay", &scene, "--out", out, "--json", "--verify", "512"]).success();
    assert_eq!(output.json(), summary(&run), "--json prints the summary");
    let records = records(&run);
    assert_eq!(records.len(), 2);
    for record in &records {
        assert!((record.traced_share - record.traced as f64 / record.queries as f64).abs() < 1e-12);
        assert!(record.trusted_volume < 1.0, "an untrained network is not trusted everywhere: {record:?}");
        assert!(record.queries > 0);
    }
    for name in ["frame_000000.exr", "frame_000001.exr", "frame_000000.png", "frame_000001.png"] {
        assert!(run.join("frames").join(name).exists(), "{name}");
    }
    refused(&["replay", &scene, "--out", out], 1, &["--overwrite"]);
    ridgewatch(["replay", &scene, "--out", out, "--overwrite", "--keep", "1"]).success();
    assert!(!run.join("frames/frame_000000.exr").exists() && run.join("frames/frame_000001.exr").exists());
}

#[test]
fn the_same_scene_gives_the_same_picture_on_any_number_of_threads() {
    let folder = tempfile::tempdir().unwrap();
    let scene = small_scene(folder.path(), "");
    let out = |n: &str| folder.path().join(format!("{n}.exr")).display().to_string();
    for threads in ["1", "2", "5"] {
        ridgewatch(["render", &scene, "--method", "reference", "--threads", threads, "--out", &out(threads)]).success();
    }
    for other in ["2", "5"] {
        let comparison = ridgewatch(["compare", &out("1"), &out(other), "--json"]).json();
        assert_eq!(comparison["max_abs_difference"], 0.0, "{comparison}");
    }
}

#[test]
fn a_signal_ends_the_run_after_the_current_frame() {
    let folder = tempfile::tempdir().unwrap();
    let scene = small_scene(folder.path(), "");
    let run = folder.path().join("run");
    let child = start(&mut program::ridgewatch(["replay", &scene, "--set", "time.slides=100000", "--out", text(&run)]));
    until("the third frame", || run.join("frames/frame_000002.exr").exists());
    child.signal(libc::SIGTERM);
    child.wait().refused(143, &[]);
    let summary = summary(&run);
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
    for path in crate::scene_file::shipped() {
        ridgewatch::config::SceneFile::read(&path, &[]).unwrap_or_else(|e| panic!("{e}"));
    }
    let out = folder.path().join("t.exr").display().to_string();
    let tiny = ["--set", "source.nodes=[16,8,8]", "--set", "render.width=16", "--set", "render.height=8", "--spp", "1", "--warmup", "1"];
    let render = ["render", &config("turbulence_easy.toml"), "--out", &out];
    ridgewatch([&render[..], &tiny].concat()).success();
}
