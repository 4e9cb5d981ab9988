//! `publish`, `attach` and `relay` through the front door.

#![allow(clippy::unwrap_used)]

use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};
use std::sync::{Mutex, MutexGuard};
use std::time::{Duration, Instant};

/// After so long a test that hangs fails. Nothing here takes a tenth of it, on a slow and busy machine either.
const LONG: Duration = Duration::from_secs(300);

/// Each test starts several processes with threads of their own: one test at a time, so that they keep to their times on few cores.
static ALONE: Mutex<()> = Mutex::new(());

/// Folders of one test: one for files, one for the ring.
struct Place {
    files: PathBuf,
    ring: PathBuf,
    _alone: MutexGuard<'static, ()>,
}

impl Place {
    fn new(name: &str) -> Self {
        let name = format!("rw-attach-{name}-{}", std::process::id());
        // A test that failed has left nothing behind that would hurt the next.
        let alone = ALONE.lock().unwrap_or_else(|broken| broken.into_inner());
        let place = Self { files: std::env::temp_dir().join(&name), ring: PathBuf::from("/dev/shm").join(&name), _alone: alone };
        let _ = std::fs::remove_dir_all(&place.files);
        let _ = std::fs::remove_dir_all(&place.ring);
        std::fs::create_dir_all(&place.files).unwrap();
        // The same scene twice: from the turbulence itself, and from whoever publishes it.
        let common = "[time]\ntau = 4.0\ndirection = \"backward\"\n[flow]\nsteps = 16\nboundary = \"clamp\"\ninterpolation = \"linear\"\n\
                      [render]\nwidth = 32\nheight = 24\nsamples = 2\nmethod = \"reference\"\n[publish]\nexr = \"every\"\n";
        std::fs::write(place.archive(), format!("[source]\nkind = \"turbulence\"\nnodes = [16, 12, 8]\nsnapshots = 8\n{common}")).unwrap();
        std::fs::write(place.live(), format!("[source]\nkind = \"live\"\n[live]\nmemory_gib = 0.25\n{common}")).unwrap();
        place
    }

    fn archive(&self) -> PathBuf {
        self.files.join("archive.toml")
    }

    fn live(&self) -> PathBuf {
        self.files.join("live.toml")
    }
}

impl Drop for Place {
    fn drop(&mut self) {
        let _ = std::fs::remove_dir_all(&self.files);
        let _ = std::fs::remove_dir_all(&self.ring);
    }
}

/// A process that does not outlive its test.
struct Running(Child);

impl Drop for Running {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

fn ridgewatch(arguments: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_ridgewatch"));
    command.args(arguments).args(["--device", "cpu", "--threads", "2"]).env_remove("RIDGEWATCH_RING").env_remove("RIDGEWATCH_LOG");
    command
}

fn start(command: &mut Command) -> Running {
    Running(command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap())
}

fn text(path: &Path) -> &str {
    path.to_str().unwrap()
}

fn wait(mut running: Running) -> Output {
    let begin = Instant::now();
    while running.0.try_wait().unwrap().is_none() {
        assert!(begin.elapsed() < LONG, "it does not end");
        std::thread::sleep(Duration::from_millis(20));
    }
    let read = |from: &mut dyn std::io::Read| {
        let mut bytes = Vec::new();
        from.read_to_end(&mut bytes).unwrap();
        bytes
    };
    let status = running.0.wait().unwrap();
    let stdout = read(running.0.stdout.as_mut().unwrap());
    let stderr = read(running.0.stderr.as_mut().unwrap());
    Output { status, stdout, stderr }
}

fn good(output: &Output) {
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
}

fn until(what: &str, mut holds: impl FnMut() -> bool) {
    let begin = Instant::now();
    while !holds() {
        assert!(begin.elapsed() < LONG, "{what} did not happen");
        std::thread::sleep(Duration::from_millis(20));
    }
}

/// Ends a process in order: SIGTERM, once it has a handler for it.
fn end(running: Running) -> Output {
    let id = running.0.id();
    until("a handler for SIGTERM", || {
        let status = std::fs::read_to_string(format!("/proc/{id}/status")).unwrap();
        let caught = status.lines().find_map(|line| line.strip_prefix("SigCgt:")).unwrap();
        u64::from_str_radix(caught.trim(), 16).unwrap() >> (libc::SIGTERM - 1) & 1 == 1
    });
    // SAFETY: a signal to a child of this test.
    assert_eq!(unsafe { libc::kill(id as i32, libc::SIGTERM) }, 0);
    wait(running)
}

fn records(run: &Path) -> Vec<serde_json::Value> {
    let lines = std::fs::read_to_string(run.join("records.jsonl")).unwrap_or_default();
    lines.lines().filter_map(|line| serde_json::from_str(line).ok()).collect()
}

/// Bytes of the previews: pixels without anything of the clock.
fn pictures(run: &Path) -> Vec<Vec<u8>> {
    let count = records(run).len();
    (0..count).map(|n| std::fs::read(run.join(format!("frames/frame_{n:06}.png"))).unwrap()).collect()
}

/// Attaches with every step taken, publishes in blocks, and returns the run folder's records and pictures.
fn attached(place: &Place, name: &str, blocks: &str) -> (Vec<serde_json::Value>, Vec<Vec<u8>>) {
    let run = place.files.join(name);
    let ring = text(&place.ring);
    let live = place.live();
    let attach = start(&mut ridgewatch(&["attach", text(&live), ring, "--once", "--set", "live.follow=every", "--out", text(&run)]));
    until("the ring's folder", || place.ring.join("followers.lock").exists());
    let publish = ridgewatch(&["publish", text(&place.archive()), "--ring", ring, "--wait", "60000", "--blocks", blocks]).output().unwrap();
    good(&publish);
    good(&wait(attach));
    (records(&run), pictures(&run))
}

#[test]
fn a_film_of_a_live_run_is_that_of_its_archive_whole_or_in_blocks() {
    let place = Place::new("film");
    let run = place.files.join("archive");
    good(&ridgewatch(&["replay", text(&place.archive()), "--out", text(&run)]).output().unwrap());
    let (expected, film) = (records(&run), pictures(&run));
    assert_eq!(expected.len(), 4);
    for (name, blocks) in [("whole", "1x1x1"), ("blocks", "2x2x1")] {
        let (records, pictures) = attached(&place, name, blocks);
        assert_eq!(records.len(), expected.len(), "{blocks}");
        for (found, expected) in records.iter().zip(&expected) {
            for key in ["time", "queries", "traced", "frame", "slide"] {
                assert_eq!(found[key], expected[key], "{blocks}: {key}");
            }
            assert_eq!(found["live"]["missed_blocks"], 0);
        }
        assert_eq!(pictures, film, "{blocks}");
    }
    assert!(!place.ring.exists(), "nothing stays in /dev/shm");
}

#[test]
fn a_killed_simulation_and_a_killed_sidecar_are_survived() {
    let place = Place::new("killed");
    let (run, ring) = (place.files.join("run"), text(&place.ring).to_owned());
    let (archive, live) = (place.archive(), place.live());
    let publish = || start(&mut ridgewatch(&["publish", text(&archive), "--ring", &ring, "--rate", "100", "--steps", "100000"]));
    let attach = |out: &Path| start(&mut ridgewatch(&["attach", text(&live), &ring, "--out", text(out)]));
    let sidecar = attach(&run);
    let solver = publish();
    until("the first frame", || !records(&run).is_empty());
    // Dropping kills: SIGKILL.
    drop(solver);
    let before = records(&run).len();
    let solver = publish();
    until("frames of the new run", || records(&run).last().is_some_and(|r| r["live"]["restarts"] == 1));
    assert!(records(&run).len() > before);
    drop(sidecar);
    // The same command once more: beside what it made before.
    let again = place.files.join("run-2");
    let sidecar = attach(&run);
    until("frames of the new sidecar", || records(&again).len() >= 2);
    drop(solver);
    drop(sidecar);
    // What both left is swept up by the next who comes and goes.
    let again = place.files.join("sweep");
    let out = end(attach(&again));
    good(&out);
    assert!(String::from_utf8_lossy(&out.stderr).contains("stopped before a simulation came"));
    assert!(!place.ring.exists(), "{:?}", std::fs::read_dir(&place.ring).map(|d| d.flatten().map(|e| e.path()).collect::<Vec<_>>()));
}

/// Through a relay or not: the simulation is killed, and comes back in fewer blocks.
#[test]
fn frames_resume_when_the_simulation_comes_back_in_other_blocks() {
    for relayed in [false, true] {
        let place = Place::new(if relayed { "blocks-relay" } else { "blocks-ring" });
        let (run, connection, ring) = (place.files.join("run"), place.files.join("connection"), text(&place.ring).to_owned());
        let (archive, live) = (place.archive(), place.live());
        let _relay = relayed.then(|| start(&mut ridgewatch(&["relay", &ring, "--connection", text(&connection)])));
        let way = if relayed { text(&connection) } else { ring.as_str() };
        if relayed {
            until("the connection file", || connection.exists());
        }
        let incomplete = ["--set", "live.block_timeout_seconds=0.5"];
        let _sidecar = start(ridgewatch(&["attach", text(&live), way, "--out", text(&run)]).args(incomplete));
        for (restarts, blocks) in ["2x2x1", "1x2x1", "1x1x1"].into_iter().enumerate() {
            let publish = ["publish", text(&archive), "--ring", &ring, "--rate", "50", "--steps", "100000", "--blocks", blocks];
            let solver = start(&mut ridgewatch(&publish));
            let before = records(&run).len();
            let resumed = |r: &serde_json::Value| r["live"]["restarts"] == restarts;
            until("frames of this start", || records(&run).iter().skip(before).filter(|r| resumed(r)).count() >= 3);
            // Dropping kills: SIGKILL.
            drop(solver);
        }
    }
}

/// Field `number` (counted from 1) of what the kernel says of each thread of a process.
fn of_threads<T: std::str::FromStr>(process: u32, number: usize) -> Vec<T> {
    let tasks = std::fs::read_dir(format!("/proc/{process}/task")).unwrap();
    let stat = |task: std::io::Result<std::fs::DirEntry>| std::fs::read_to_string(task.ok()?.path().join("stat")).ok();
    // Behind the name, which is in parentheses, from the third field on.
    let field = |stat: String| stat.rsplit_once(") ")?.1.split(' ').nth(number - 3)?.parse().ok();
    tasks.filter_map(stat).filter_map(field).collect()
}

/// The nice values of a process's threads.
fn niceness(process: u32) -> Vec<i32> {
    of_threads(process, 19)
}

/// Whether each thread of a process runs (R), sleeps (S, D), stands still (T) or has ended (Z, X).
fn states(process: u32) -> Vec<char> {
    of_threads(process, 3)
}

/// How readily the kernel ends a process when memory is out: -1000 (never) to 1000 (before all others).
fn offered(process: u32) -> i32 {
    std::fs::read_to_string(format!("/proc/{process}/oom_score_adj")).unwrap().trim().parse().unwrap()
}

/// How many files a process may have open: the soft and the hard limit.
fn open_files(process: u32) -> [u64; 2] {
    let limits = std::fs::read_to_string(format!("/proc/{process}/limits")).unwrap();
    let line = limits.lines().find_map(|line| line.strip_prefix("Max open files")).unwrap();
    let mut numbers = line.split_whitespace().map(|limit| limit.parse().unwrap_or(u64::MAX));
    [numbers.next().unwrap(), numbers.next().unwrap()]
}

#[test]
fn all_threads_step_back_for_the_simulation() {
    let place = Place::new("nice");
    let (archive, live, ring) = (place.archive(), place.live(), text(&place.ring).to_owned());
    let solver = start(&mut ridgewatch(&["publish", text(&archive), "--ring", &ring, "--rate", "50", "--steps", "100000"]));
    // SAFETY: asks for this process's own.
    let own = unsafe { libc::getpriority(libc::PRIO_PROCESS, 0) };
    for (name, arguments, expected) in [("default", &[][..], 10), ("asked", &["--nice", "17"], 17), ("none", &["--nice", "0"], own)] {
        let run = place.files.join(name);
        let sidecar = start(ridgewatch(&["attach", text(&live), &ring, "--out", text(&run)]).args(arguments));
        until("the first frame", || !records(&run).is_empty());
        let found = niceness(sidecar.0.id());
        // Those that read, convert, write and make frames.
        assert!(found.len() > 4 && found.iter().all(|nice| *nice == expected.max(own)), "{name}: {found:?}");
        // Where memory is out, the kernel ends the sidecar and not the simulation.
        assert_eq!(offered(sidecar.0.id()), 1000, "{name}");
        let connection = place.files.join(format!("{name}.connection"));
        let few = ["-c", "ulimit -Sn 200 && exec \"$0\" \"$@\"", env!("CARGO_BIN_EXE_ridgewatch")];
        let relay = start(Command::new("sh").args(few).args(["relay", &ring, "--connection", text(&connection)]).args(arguments));
        until("the connection file", || connection.exists());
        until("the relay's priority", || {
            let found = niceness(relay.0.id());
            found.len() > 1 && found.iter().all(|nice| *nice == expected.max(own))
        });
        assert_eq!(offered(relay.0.id()), 1000, "{name}");
        // Rings take descriptors, those of a relay for each of its followers.
        let [soft, hard] = open_files(relay.0.id());
        assert_eq!(soft, hard.min(1 << 14), "{name}");
    }
    assert_eq!(offered(solver.0.id()), offered(std::process::id()));
}

/// A solver that waits for as long as two minutes publishes beside a follower that is killed and one that is stopped: it waits until the follower has been silent
/// for five seconds (`SILENCE` of the ring), and then not again.
#[test]
fn a_solver_that_waits_gives_up_a_follower_that_is_gone() {
    use ridgewatch_wire::{AxisDescription, Description, Element, Field, Geometry, Policy, Producer};
    const SLOTS: u64 = 3;
    let place = Place::new("silent");
    let (live, plane) = (place.live(), vec![0.1f32; 8 * 6 * 4]);
    let axes = [("x", 8), ("y", 6), ("z", 4)].map(|(name, nodes)| AxisDescription::uniform(name, "", 0.0, 1.0, nodes));
    let description = Description::whole(Geometry::Cartesian, axes.into(), "");
    let producer = Producer::open(&place.ring, description, SLOTS as u32, Policy::Wait(Duration::from_secs(120))).unwrap();
    let components = [plane.as_ptr().cast(); 3];
    let mut step = 0;
    // How long the solver was held, and whether a step was lost.
    let mut publish = || {
        let field = Field::packed(&components, Element::F32, [8, 6, 4]);
        let begin = Instant::now();
        // SAFETY: three components of as many values as the grid has nodes.
        let published = unsafe { producer.publish(step, step as f64, &field) }.unwrap();
        step += 1;
        (begin.elapsed(), published.overwrote)
    };
    for (signal, run) in [(libc::SIGKILL, "killed"), (libc::SIGSTOP, "stopped")] {
        let run = place.files.join(run);
        let sidecar = start(&mut ridgewatch(&["attach", text(&live), text(&place.ring), "--out", text(&run)]));
        // It follows: steps are taken as fast as they come.
        until("the first frame", || {
            std::thread::sleep(Duration::from_millis(20));
            publish();
            !records(&run).is_empty()
        });
        // The latter half of these waits until the follower has taken one of the former: it is heard of later than here.
        let heard = Instant::now();
        assert!((0..2 * SLOTS).all(|_| !publish().1), "a step is waited for while the follower lives");
        // SAFETY: a signal to a child of this test.
        assert_eq!(unsafe { libc::kill(sidecar.0.id() as i32, signal) }, 0);
        // A signal comes to each thread in its time, until when it reads on.
        until("the end of its threads' work", || states(sidecar.0.id()).iter().all(|state| matches!(state, 'T' | 'Z' | 'X')));
        let mut held: Vec<(Duration, bool)> = Vec::new();
        while held.last().is_none_or(|(_, lost)| !lost) {
            held.push(publish());
            assert!(held.len() as u64 <= SLOTS + 1, "{signal}: {held:?}: nobody takes them");
        }
        let silent = heard.elapsed();
        assert!(silent >= Duration::from_secs(5), "{signal}: {held:?}: it was given up after {silent:?}");
        held.extend((0..2 * SLOTS).map(|_| publish()));
        assert_eq!(held.iter().filter(|(_, lost)| *lost).count() as u64, 2 * SLOTS + 1, "{signal}: {held:?}");
        // Five seconds at most: not the two minutes of the policy, nor five seconds for each step.
        let waited: Duration = held.iter().map(|(held, _)| held).sum();
        assert!(waited < Duration::from_secs(30), "{signal}: {held:?}");
    }
}

/// Cores that this process may use.
fn cores() -> Vec<usize> {
    // SAFETY: the set is as long as is said, and all of its bits are a value.
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
        // SAFETY: a set of this frame, whose bits are those of cores that are there.
        let done = unsafe {
            let mut set: libc::cpu_set_t = std::mem::zeroed();
            cores.iter().for_each(|core| libc::CPU_SET(*core, &mut set));
            libc::sched_setaffinity(0, size_of_val(&set), &set)
        };
        if done == 0 { Ok(()) } else { Err(std::io::Error::last_os_error()) }
    };
    // SAFETY: only calls of the system between fork and exec.
    unsafe { command.pre_exec(bind) }
}

#[test]
fn as_many_threads_render_as_the_simulation_leaves_cores() {
    let place = Place::new("cores");
    let (archive, live, ring) = (place.archive(), place.live(), text(&place.ring).to_owned());
    let _solver = start(&mut ridgewatch(&["publish", text(&archive), "--ring", &ring, "--rate", "50", "--steps", "100000"]));
    let all = cores();
    // What the cgroup leaves counts too.
    let most = std::thread::available_parallelism().unwrap().get();
    for (name, left) in [("one", &all[..1]), ("all", &all)] {
        let run = place.files.join(name);
        let mut command = Command::new(env!("CARGO_BIN_EXE_ridgewatch"));
        command.args(["attach", text(&live), &ring, "--device", "cpu", "--out", text(&run)]).env_remove("RIDGEWATCH_RING");
        let sidecar = start(bound(&mut command, left.to_vec()));
        until("the first frame", || !records(&run).is_empty());
        let names = std::fs::read_dir(format!("/proc/{}/task", sidecar.0.id())).unwrap();
        let names = names.filter_map(|task| std::fs::read_to_string(task.ok()?.path().join("comm")).ok());
        // The system keeps 15 letters of a name.
        assert_eq!(names.filter(|name| name.starts_with("ridgewatch-rend")).count(), left.len().min(most));
    }
}

#[test]
fn every_step_is_taken_through_a_relay() {
    let place = Place::new("every");
    let (run, connection, ring) = (place.files.join("run"), place.files.join("connection"), text(&place.ring).to_owned());
    let (archive, live) = (place.archive(), place.live());
    let relay = start(&mut ridgewatch(&["relay", &ring, "--connection", text(&connection)]));
    until("the connection file", || connection.exists());
    let every = ["--once", "--set", "live.follow=every"];
    let attach = start(ridgewatch(&["attach", text(&live), text(&connection), "--out", text(&run)]).args(every));
    good(&ridgewatch(&["publish", text(&archive), "--ring", &ring, "--wait", "60000", "--blocks", "2x1x1"]).output().unwrap());
    good(&wait(attach));
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
    let (run, connection, ring) = (place.files.join("run"), place.files.join("connection"), text(&place.ring).to_owned());
    let (archive, live) = (place.archive(), place.live());
    let relay = start(&mut ridgewatch(&["relay", &ring, "--connection", text(&connection)]));
    until("the connection file", || connection.exists());
    let once = ["--once", "--set", "live.relay_timeout_seconds=1"];
    let attach = start(ridgewatch(&["attach", text(&live), text(&connection), "--out", text(&run)]).args(once));
    let _solver = start(&mut ridgewatch(&["publish", text(&archive), "--ring", &ring, "--rate", "50", "--steps", "100000"]));
    until("the first frame", || !records(&run).is_empty());
    // Dropping kills: SIGKILL. The simulation goes on, and nobody can tell.
    drop(relay);
    good(&wait(attach));
}

#[test]
fn a_relay_ships_the_ring_to_another_node() {
    let place = Place::new("relay");
    let (run, connection, ring) = (place.files.join("run"), place.files.join("connection"), text(&place.ring).to_owned());
    let relay = start(&mut ridgewatch(&["relay", &ring, "--connection", text(&connection), "--json"]));
    until("the connection file", || connection.exists());
    let live = place.live();
    let attach = start(&mut ridgewatch(&["attach", text(&live), text(&connection), "--out", text(&run)]));
    let archive = place.archive();
    let solver =
        start(&mut ridgewatch(&["publish", text(&archive), "--ring", &ring, "--rate", "50", "--steps", "100000", "--blocks", "2x1x1"]));
    until("frames of ten steps", || records(&run).last().is_some_and(|last| last["live"]["steps"].as_u64().unwrap() >= 10));
    good(&end(attach));
    drop(solver);
    let out = end(relay);
    good(&out);
    let counts: serde_json::Value = serde_json::from_slice(&out.stdout).unwrap();
    assert!(counts["steps"].as_u64().unwrap() >= 10 && counts["accepted"] == 1 && counts["refused"] == 0, "{counts}");
    assert!(!connection.exists() && !place.ring.exists());
}

#[test]
fn a_frame_goes_out_before_the_rest_of_its_training() {
    let place = Place::new("training");
    let (run, ring) = (place.files.join("run"), text(&place.ring));
    let (archive, live) = (place.archive(), place.live());
    // More than is waited for a frame, were its training: there are four. Small steps, of which one is done in any case.
    let scene = ["live.follow=every", "training.seconds_per_frame=600", "network.batch=1024", "surrogate.kind=network"];
    let overrides = scene.iter().flat_map(|one| ["--set", one]);
    // What is trained until the next step is there hangs on the cores it gets.
    let attach = ["attach", text(&live), ring, "--once", "--method", "gated", "--out", text(&run), "--nice", "0"];
    let attach = start(ridgewatch(&attach).args(overrides));
    until("the ring's folder", || place.ring.join("followers.lock").exists());
    good(&ridgewatch(&["publish", text(&archive), "--ring", ring, "--wait", "60000"]).output().unwrap());
    good(&wait(attach));
    let records = records(&run);
    assert_eq!(records.len(), 4);
    assert!(records.iter().skip(1).all(|r| r["training"]["steps"].as_u64().unwrap() > 0), "{records:?}");
}

/// Optimizer steps behind the weights of a checkpoint.
fn trained_steps(checkpoint: &Path) -> u64 {
    let bytes = std::fs::read(checkpoint).unwrap();
    let length = u64::from_le_bytes(bytes[..8].try_into().unwrap()) as usize;
    let header: serde_json::Value = serde_json::from_slice(&bytes[8..8 + length]).unwrap();
    header["__metadata__"]["network.steps"].as_str().unwrap().parse().unwrap()
}

#[test]
fn weights_outlive_the_sidecar() {
    let place = Place::new("weights");
    let (checkpoint, ring) = (place.files.join("weights"), text(&place.ring).to_owned());
    let (archive, live) = (place.archive(), place.live());
    let _solver = start(&mut ridgewatch(&["publish", text(&archive), "--ring", &ring, "--rate", "20", "--steps", "100000"]));
    let attach = |name: &str, frames: usize, training: &str| {
        let run = place.files.join(name);
        let arguments = ["attach", text(&live), &ring, "--out", text(&run), "--checkpoint", text(&checkpoint)];
        let more =
            ["--method", "gated", "--set", training, "--set", "network.batch=1024", "--set", "surrogate.kind=network", "--nice", "0"];
        let sidecar = start(ridgewatch(&arguments).args(more));
        until("its frames", || records(&run).len() >= frames);
        end(sidecar)
    };
    let first = attach("first", 8, "training.steps_per_frame=100");
    good(&first);
    assert!(checkpoint.exists() && !String::from_utf8_lossy(&first.stderr).contains("going on from"));
    let before = trained_steps(&checkpoint);
    let second = attach("second", 3, "training.steps_per_frame=1");
    good(&second);
    assert!(String::from_utf8_lossy(&second.stderr).contains("going on from the weights in"));
    // A step a frame, and one of a frame that the end may have cut off: without the first's weights it would have got no further.
    let (steps, of_its_own) = (trained_steps(&checkpoint), records(&place.files.join("second")).len() as u64 + 1);
    assert!(before > of_its_own && (before..=before + of_its_own).contains(&steps), "{before}, {of_its_own}, {steps}");
}

#[test]
fn what_cannot_be_followed_is_said() {
    let place = Place::new("refused");
    let told = |arguments: &[&str], status: i32, text: &str| {
        let out = ridgewatch(arguments).output().unwrap();
        let error = String::from_utf8_lossy(&out.stderr).into_owned();
        assert!(out.status.code() == Some(status) && error.contains(text), "{arguments:?}: {:?} {error}", out.status);
    };
    let (archive, live, ring) = (place.archive(), place.live(), text(&place.ring));
    told(&["attach", text(&archive), ring], 2, "for `ridgewatch replay`");
    told(&["replay", text(&live)], 2, "with `ridgewatch attach`");
    told(&["attach", text(&live)], 2, "live.ring");
    told(&["attach", ring], 2, "time.tau");
    told(&["publish", text(&archive)], 2, "RIDGEWATCH_RING");
    told(&["publish", text(&archive), "--ring", ring, "--blocks", "99x1x1"], 2, "16, 12, 8");
    told(&["publish", text(&archive), "--ring", ring, "--slots", "1"], 1, "`slots` is 1");
    // A connection file that others may read holds no key to be trusted.
    let connection = place.files.join("connection");
    told(&["relay", "--connection", text(&connection)], 2, "RIDGEWATCH_RING");
    std::fs::write(&connection, "ridgewatch-connection = 1\n").unwrap();
    told(&["attach", text(&live), text(&connection)], 1, "mode 0600");
}
