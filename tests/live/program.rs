//! `publish`, `attach` and `relay` as programs.

use crate::ALONE;
use crate::kit::program::{self, LONG, Outcome, Running, run, start, summary, text, until};
use crate::kit::ring::{self, Ring, grid};
use crate::kit::scene;
use serde_json::Value;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::RwLockWriteGuard;
use std::time::{Duration, Instant};

/// Paths of one test: scenes and results in a folder for files, and a ring.
struct Place {
    files: tempfile::TempDir,
    ring: Ring,
    archive: String,
    live: String,
    _alone: RwLockWriteGuard<'static, ()>,
}

impl Place {
    fn new(name: &str) -> Self {
        // A failed test leaves nothing behind that would disturb the next one.
        let alone = ALONE.write().unwrap_or_else(|broken| broken.into_inner());
        let files = tempfile::tempdir().unwrap();
        let write = |name: &str, kind: &str, keys: &str| {
            let common = "
                time.tau = 4.0
                time.direction = \"backward\"
                flow.steps = 16
                flow.boundary = \"clamp\"
                flow.interpolation = \"linear\"
                render.method = \"reference\"
                publish.exr = \"every\"
            ";
            let path = files.path().join(name);
            std::fs::write(&path, scene::scene(kind, [32, 24, 2], &(common.to_owned() + keys))).unwrap();
            text(&path).to_owned()
        };
        // The same scene twice: from the turbulence itself, and from the program that publishes it.
        let archive = write("archive.toml", "turbulence", "source.nodes = [16, 12, 8]\nsource.snapshots = 8");
        let live = write("live.toml", "live", "live.memory_gib = 0.25");
        Self { ring: Ring::new(&format!("attach-{name}")), archive, live, files, _alone: alone }
    }

    /// A path among the files.
    fn file(&self, name: &str) -> PathBuf {
        self.files.path().join(name)
    }

    fn ring(&self) -> &str {
        text(&self.ring.0)
    }

    fn connection(&self) -> PathBuf {
        self.file("connection")
    }

    /// A simulation that publishes its snapshots round and round.
    fn solver(&self, rate: &str, blocks: &str) -> Running {
        let arguments = ["publish", &self.archive, "--ring", self.ring(), "--rate", rate, "--steps", "100000", "--blocks", blocks];
        start(&mut ridgewatch(&arguments))
    }

    /// Publishes all snapshots once and waits for each to be taken.
    fn publish_once(&self, blocks: &str) {
        let arguments = ["publish", &self.archive, "--ring", self.ring(), "--wait", "60000", "--blocks", blocks];
        run(&mut ridgewatch(&arguments)).success();
    }

    /// The sidecar that follows a ring, or the relay of a connection file, into a run folder.
    fn attach(&self, way: &str, out: &Path, options: &[&str]) -> Running {
        start(ridgewatch(&["attach", &self.live, way, "--out", text(out)]).args(options))
    }

    /// A relay, after it wrote its connection file.
    fn relay(&self, options: &[&str]) -> Running {
        let relay = start(ridgewatch(&["relay", self.ring(), "--connection", text(&self.connection())]).args(options));
        until("the connection file", || self.connection().exists());
        relay
    }

    /// Waits for a follower of the ring.
    fn followed(&self) {
        until("the folder of the ring", || self.ring.0.join("followers.lock").exists());
    }
}

fn ridgewatch(arguments: &[&str]) -> Command {
    let mut command = program::ridgewatch(arguments);
    command.args(["--device", "cpu", "--threads", "2"]);
    command
}

/// Ends a process in order: SIGTERM, after it has installed a handler.
fn end(running: Running) -> Outcome {
    until("a handler for SIGTERM", || {
        let status = std::fs::read_to_string(format!("/proc/{}/status", running.id())).unwrap();
        let caught = status.lines().find_map(|line| line.strip_prefix("SigCgt:")).unwrap();
        u64::from_str_radix(caught.trim(), 16).unwrap() >> (libc::SIGTERM - 1) & 1 == 1
    });
    running.signal(libc::SIGTERM);
    running.wait().success()
}

/// Whole records of a run that may still write.
fn records(run: &Path) -> Vec<Value> {
    let lines = std::fs::read_to_string(run.join("records.jsonl")).unwrap_or_default();
    lines.lines().filter_map(|line| serde_json::from_str(line).ok()).collect()
}

fn first_frame(run: &Path) {
    until("the first frame", || !records(run).is_empty());
}

/// Bytes of the previews: pixels, independent of the clock.
fn pictures(run: &Path) -> Vec<Vec<u8>> {
    let count = records(run).len();
    (0..count).map(|n| std::fs::read(run.join(format!("frames/frame_{n:06}.png"))).unwrap()).collect()
}

#[test]
fn a_film_of_a_live_run_is_that_of_its_archive_whole_or_in_blocks() {
    let place = Place::new("film");
    let replayed = place.file("archive");
    run(&mut ridgewatch(&["replay", &place.archive, "--out", text(&replayed)])).success();
    let (expected, film) = (records(&replayed), pictures(&replayed));
    assert_eq!(expected.len(), 4);
    for (name, blocks) in [("whole", "1x1x1"), ("blocks", "2x2x1")] {
        let run = place.file(name);
        let attach = place.attach(place.ring(), &run, &["--exit-at-end", "--set", "live.follow=every"]);
        place.followed();
        place.publish_once(blocks);
        attach.wait().success();
        let records = records(&run);
        assert_eq!(records.len(), expected.len(), "{blocks}");
        for (found, expected) in records.iter().zip(&expected) {
            for key in ["time", "queries", "traced", "frame", "slide"] {
                assert_eq!(found[key], expected[key], "{blocks}: {key}");
            }
            assert_eq!(found["live"]["missed_blocks"], 0);
        }
        assert_eq!(pictures(&run), film, "{blocks}");
        let warnings = summary(&run)["run"]["warnings"].to_string();
        assert!(warnings.contains("the simulation has ended"), "{warnings}");
    }
    assert!(!place.ring.0.exists(), "nothing stays in /dev/shm");
}

#[test]
fn a_killed_simulation_and_a_killed_sidecar_are_survived() {
    let place = Place::new("killed");
    let run = place.file("run");
    let sidecar = place.attach(place.ring(), &run, &[]);
    let solver = place.solver("100", "1x1x1");
    first_frame(&run);
    // Dropping kills: SIGKILL.
    drop(solver);
    let before = records(&run).len();
    let solver = place.solver("100", "1x1x1");
    until("frames of the new run", || records(&run).last().is_some_and(|r| r["live"]["restarts"] == 1));
    assert!(records(&run).len() > before);
    drop(sidecar);
    // The same command again writes beside the results of the first.
    let again = place.file("run-2");
    let sidecar = place.attach(place.ring(), &run, &[]);
    until("frames of the new sidecar", || records(&again).len() >= 2);
    drop(solver);
    drop(sidecar);
    // The next sidecar removes what both left.
    let out = end(place.attach(place.ring(), &place.file("sweep"), &[]));
    assert!(out.stderr.contains("stopped before a simulation came"), "{}", out.stderr);
    // Half of the 15 s that `--stop-within` is by default.
    assert!(out.stderr.contains("for 7.5 s at most"), "{}", out.stderr);
    assert!(!place.ring.0.exists(), "{:?}", std::fs::read_dir(&place.ring.0).map(|d| d.flatten().map(|e| e.path()).collect::<Vec<_>>()));
}

/// Through a relay or not: the simulation is killed, and comes back in fewer blocks.
#[test]
fn frames_resume_when_the_simulation_comes_back_in_other_blocks() {
    for relayed in [false, true] {
        let place = Place::new(if relayed { "blocks-relay" } else { "blocks-ring" });
        let run = place.file("run");
        let _relay = relayed.then(|| place.relay(&[]));
        let connection = place.connection();
        let way = if relayed { text(&connection) } else { place.ring() };
        let _sidecar = place.attach(way, &run, &["--set", "live.block_timeout_seconds=0.5"]);
        for (restarts, blocks) in ["2x2x1", "1x2x1", "1x1x1"].into_iter().enumerate() {
            let solver = place.solver("50", blocks);
            let before = records(&run).len();
            let resumed = |r: &Value| r["live"]["restarts"] == restarts;
            until("frames of this start", || records(&run).iter().skip(before).filter(|r| resumed(r)).count() >= 3);
            // Dropping kills: SIGKILL.
            drop(solver);
        }
    }
}

/// Field `number` (counted from 1) of the kernel's `stat` line of each thread of a process.
fn of_threads<T: std::str::FromStr>(process: u32, number: usize) -> Vec<T> {
    let tasks = std::fs::read_dir(format!("/proc/{process}/task")).unwrap();
    let stat = |task: std::io::Result<std::fs::DirEntry>| std::fs::read_to_string(task.ok()?.path().join("stat")).ok();
    // From the third field on, after the name in parentheses.
    let field = |stat: String| stat.rsplit_once(") ")?.1.split(' ').nth(number - 3)?.parse().ok();
    tasks.filter_map(stat).filter_map(field).collect()
}

/// The nice values of a process's threads.
fn niceness(process: u32) -> Vec<i32> {
    of_threads(process, 19)
}

/// State of each thread of a process: runs (R), sleeps (S, D), is stopped (T) or has ended (Z, X).
fn states(process: u32) -> Vec<char> {
    of_threads(process, 3)
}

/// Preference of the kernel to end a process when it is out of memory: -1000 (never) to 1000 (before all others).
fn offered(process: u32) -> i32 {
    std::fs::read_to_string(format!("/proc/{process}/oom_score_adj")).unwrap().trim().parse().unwrap()
}

/// Soft and hard limit of the open files of a process.
fn open_files(process: u32) -> [u64; 2] {
    let limits = std::fs::read_to_string(format!("/proc/{process}/limits")).unwrap();
    let line = limits.lines().find_map(|line| line.strip_prefix("Max open files")).unwrap();
    let mut numbers = line.split_whitespace().map(|limit| limit.parse().unwrap_or(u64::MAX));
    [numbers.next().unwrap(), numbers.next().unwrap()]
}

#[test]
fn all_threads_step_back_for_the_simulation() {
    let place = Place::new("nice");
    let solver = place.solver("50", "1x1x1");
    // SAFETY: asks for the priority of this process.
    let own = unsafe { libc::getpriority(libc::PRIO_PROCESS, 0) };
    for (name, arguments, expected) in [("default", &[][..], 10), ("asked", &["--nice", "17"], 17), ("none", &["--nice", "0"], own)] {
        let run = place.file(name);
        let sidecar = place.attach(place.ring(), &run, arguments);
        first_frame(&run);
        let found = niceness(sidecar.id());
        // The threads that read, convert, write and render.
        assert!(found.len() > 4 && found.iter().all(|nice| *nice == expected.max(own)), "{name}: {found:?}");
        // Out of memory, the kernel ends the sidecar and not the simulation.
        assert_eq!(offered(sidecar.id()), 1000, "{name}");
        let connection = place.file(&format!("{name}.connection"));
        let few = ["-c", "ulimit -Sn 200 && exec \"$0\" \"$@\"", env!("CARGO_BIN_EXE_ridgewatch")];
        let relay = ["relay", place.ring(), "--connection", text(&connection)];
        let relay = start(Command::new("sh").args(few).args(relay).args(arguments));
        until("the connection file", || connection.exists());
        until("the priority of the relay", || {
            let found = niceness(relay.id());
            found.len() > 1 && found.iter().all(|nice| *nice == expected.max(own))
        });
        assert_eq!(offered(relay.id()), 1000, "{name}");
        // Rings need file descriptors; a relay needs them for each of its followers.
        let [soft, hard] = open_files(relay.id());
        assert_eq!(soft, hard.min(1 << 14), "{name}");
    }
    assert_eq!(offered(solver.id()), offered(std::process::id()));
}

/// A solver that waits for up to two minutes publishes beside a follower that is killed and one that is stopped: it waits until the follower
/// has been silent for five seconds (`SILENCE` of the ring), and then not again.
#[test]
fn a_solver_that_waits_gives_up_a_follower_that_is_gone() {
    use ridgewatch_wire::{Policy, Producer};
    const SLOTS: u64 = 3;
    let place = Place::new("silent");
    let plane = vec![0.1f32; 8 * 6 * 4];
    let producer = Producer::open(&place.ring.0, grid(&[8, 6, 4]), SLOTS as u32, Policy::Wait(Duration::from_secs(120))).unwrap();
    let mut step = 0;
    // Time for which the solver was held, and whether a step was lost.
    let mut publish = || {
        let begin = Instant::now();
        let published = ring::publish(&producer, step, step as f64, &[&plane[..]; 3]);
        step += 1;
        (begin.elapsed(), published.overwrote)
    };
    for (signal, run) in [(libc::SIGKILL, "killed"), (libc::SIGSTOP, "stopped")] {
        let run = place.file(run);
        let sidecar = place.attach(place.ring(), &run, &[]);
        // The sidecar follows: steps are taken as fast as they come.
        until("the first frame", || {
            std::thread::sleep(Duration::from_millis(20));
            publish();
            !records(&run).is_empty()
        });
        // The latter half of these waits until the follower has taken one of the former: its last sign of life is later than `heard`.
        let heard = Instant::now();
        assert!((0..2 * SLOTS).all(|_| !publish().1), "the solver waits while the follower lives");
        sidecar.signal(signal);
        // A signal does not reach all threads at once; until then they go on reading.
        until("the end of its threads' work", || states(sidecar.id()).iter().all(|state| matches!(state, 'T' | 'Z' | 'X')));
        let mut held: Vec<(Duration, bool)> = Vec::new();
        while held.last().is_none_or(|(_, lost)| !lost) {
            held.push(publish());
            assert!(held.len() as u64 <= SLOTS + 1, "{signal}: {held:?}: nobody takes them");
        }
        let silent = heard.elapsed();
        assert!(silent >= Duration::from_secs(5), "{signal}: {held:?}: the follower was given up after {silent:?}");
        held.extend((0..2 * SLOTS).map(|_| publish()));
        assert_eq!(held.iter().filter(|(_, lost)| *lost).count() as u64, 2 * SLOTS + 1, "{signal}: {held:?}");
        // At most five seconds: neither the two minutes of the policy, nor five seconds for each step.
        let waited: Duration = held.iter().map(|(held, _)| held).sum();
        assert!(waited < Duration::from_secs(30), "{signal}: {held:?}");
    }
}

/// Cores that this process may use.
fn cores() -> Vec<usize> {
    // SAFETY: the length is that of the set, for which all bits are valid.
    let set = unsafe {
        let mut set: libc::cpu_set_t = std::mem::zeroed();
        assert_eq!(libc::sched_getaffinity(0, size_of_val(&set), &mut set), 0);
        set
    };
    // SAFETY: reads a bit of that set.
    (0..libc::CPU_SETSIZE as usize).filter(|core| unsafe { libc::CPU_ISSET(*core, &set) }).collect()
}

/// Lets a command run on these cores alone, as `taskset` and Slurm do.
fn bound(command: &mut Command, cores: Vec<usize>) -> &mut Command {
    use std::os::unix::process::CommandExt;
    let bind = move || {
        // SAFETY: a local set, whose bits are those of existing cores.
        let done = unsafe {
            let mut set: libc::cpu_set_t = std::mem::zeroed();
            cores.iter().for_each(|core| libc::CPU_SET(*core, &mut set));
            libc::sched_setaffinity(0, size_of_val(&set), &set)
        };
        if done == 0 { Ok(()) } else { Err(std::io::Error::last_os_error()) }
    };
    // SAFETY: only system calls between fork and exec.
    unsafe { command.pre_exec(bind) }
}

#[test]
fn as_many_threads_render_as_the_simulation_leaves_cores() {
    let place = Place::new("cores");
    let _solver = place.solver("50", "1x1x1");
    let all = cores();
    // The limit of the cgroup counts as well.
    let most = std::thread::available_parallelism().unwrap().get();
    for (name, left) in [("one", &all[..1]), ("all", &all)] {
        let run = place.file(name);
        let mut command = program::ridgewatch(["attach", &place.live, place.ring(), "--device", "cpu", "--out", text(&run)]);
        let sidecar = start(bound(&mut command, left.to_vec()));
        first_frame(&run);
        let names = std::fs::read_dir(format!("/proc/{}/task", sidecar.id())).unwrap();
        let names = names.filter_map(|task| std::fs::read_to_string(task.ok()?.path().join("comm")).ok());
        // The system keeps 15 letters of a name.
        assert_eq!(names.filter(|name| name.starts_with("ridgewatch-rend")).count(), left.len().min(most));
    }
}

#[test]
fn every_step_is_taken_through_a_relay() {
    let place = Place::new("every");
    let run = place.file("run");
    let relay = place.relay(&[]);
    let attach = place.attach(text(&place.connection()), &run, &["--exit-at-end", "--set", "live.follow=every"]);
    place.publish_once("2x1x1");
    attach.wait().success();
    let records = records(&run);
    assert_eq!(records.len(), 4);
    for (n, record) in (4..).zip(&records) {
        assert_eq!((&record["live"]["step"], &record["live"]["missed_blocks"]), (&n.into(), &0.into()), "{record}");
    }
    drop(relay);
}

#[test]
fn a_run_that_ends_with_its_simulation_ends_with_its_relay_too() {
    let place = Place::new("once");
    let run = place.file("run");
    let relay = place.relay(&[]);
    let attach = place.attach(text(&place.connection()), &run, &["--exit-at-end", "--set", "live.relay_timeout_seconds=1"]);
    let _solver = place.solver("50", "1x1x1");
    first_frame(&run);
    // Dropping kills: SIGKILL. The simulation goes on, which the sidecar cannot know.
    drop(relay);
    attach.wait().success();
}

#[test]
fn a_relay_ships_the_ring_to_another_node() {
    let place = Place::new("relay");
    let run = place.file("run");
    let relay = place.relay(&["--json"]);
    let attach = place.attach(text(&place.connection()), &run, &[]);
    let solver = place.solver("50", "2x1x1");
    until("frames of ten steps", || records(&run).last().is_some_and(|last| last["live"]["steps"].as_u64().unwrap() >= 10));
    end(attach);
    drop(solver);
    let counts = end(relay).json();
    assert!(counts["steps"].as_u64().unwrap() >= 10 && counts["accepted"] == 1 && counts["refused"] == 0, "{counts}");
    assert!(!place.connection().exists() && !place.ring.0.exists());
}

#[test]
fn a_frame_goes_out_before_the_rest_of_its_training() {
    let place = Place::new("training");
    let run = place.file("run");
    // Training would take longer than the test waits: there are four frames. The steps are small, and one is done in any case.
    let seconds = format!("training.seconds_per_frame={}", LONG.as_secs());
    let keys = program::set(&["live.follow=every", &seconds, "network.batch=1024", "surrogate.kind=network"]);
    // The training until the next step depends on the cores that the sidecar gets.
    let options = [&["--exit-at-end", "--method", "gated", "--nice", "0"][..], &keys].concat();
    let attach = place.attach(place.ring(), &run, &options);
    place.followed();
    place.publish_once("1x1x1");
    attach.wait().success();
    let records = records(&run);
    assert_eq!(records.len(), 4);
    assert!(records.iter().skip(1).all(|r| r["training"]["steps"].as_u64().unwrap() > 0), "{records:?}");
}

/// Optimizer steps of the weights in a checkpoint.
fn trained_steps(checkpoint: &Path) -> u64 {
    let bytes = std::fs::read(checkpoint).unwrap();
    let length = u64::from_le_bytes(bytes[..8].try_into().unwrap()) as usize;
    let header: Value = serde_json::from_slice(&bytes[8..8 + length]).unwrap();
    header["__metadata__"]["network.steps"].as_str().unwrap().parse().unwrap()
}

#[test]
fn weights_outlive_the_sidecar() {
    let place = Place::new("weights");
    let checkpoint = place.file("weights");
    let _solver = place.solver("20", "1x1x1");
    let attach = |name: &str, frames: usize, training: &str| {
        let run = place.file(name);
        let keys = program::set(&[training, "network.batch=1024", "surrogate.kind=network"]);
        let options = [&["--checkpoint", text(&checkpoint), "--method", "gated", "--nice", "0"][..], &keys].concat();
        let sidecar = place.attach(place.ring(), &run, &options);
        until("its frames", || records(&run).len() >= frames);
        end(sidecar)
    };
    let first = attach("first", 8, "training.steps_per_frame=100");
    assert!(checkpoint.exists() && !first.stderr.contains("going on from"));
    let before = trained_steps(&checkpoint);
    let second = attach("second", 3, "training.steps_per_frame=1");
    assert!(second.stderr.contains("going on from the weights in"));
    // A step a frame, and one of a frame that the end may have interrupted: without the weights of the first run, there would be no more.
    let (steps, added) = (trained_steps(&checkpoint), records(&place.file("second")).len() as u64 + 1);
    assert!(before > added && (before..=before + added).contains(&steps), "{before}, {added}, {steps}");
}

#[test]
fn what_cannot_be_followed_is_said() {
    let place = Place::new("refused");
    let (archive, live, ring, connection) = (&place.archive[..], &place.live[..], place.ring(), place.connection());
    let publish = ["publish", archive, "--ring", ring];
    // A connection file that others may read holds no trustworthy key.
    std::fs::write(&connection, "ridgewatch-connection = 1\n").unwrap();
    for (arguments, status, part) in [
        (&["attach", archive, ring][..], 2, "for `ridgewatch replay`"),
        (&["replay", live], 2, "with `ridgewatch attach`"),
        (&["attach", live], 2, "live.ring"),
        (&["attach", ring], 2, "time.tau"),
        (&publish[..2], 2, "RIDGEWATCH_RING"),
        (&[&publish[..], &["--blocks", "99x1x1"]].concat(), 2, "16, 12, 8"),
        (&[&publish[..], &["--slots", "1"]].concat(), 1, "`slots` is 1"),
        (&["relay", "--connection", text(&place.file("new"))], 2, "RIDGEWATCH_RING"),
        (&["attach", live, text(&connection)], 1, "mode 0600"),
    ] {
        run(&mut ridgewatch(arguments)).refused(status, &[part]);
    }
}
