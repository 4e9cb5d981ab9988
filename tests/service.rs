//! What the program tells a service manager, whose place a datagram socket takes (sd_notify(3)).

#![allow(clippy::unwrap_used)]
#![cfg(unix)]

mod kit;

use kit::program::{self, LONG, Running, start, text, until};
use kit::ring::Ring;
use kit::scene::{self, double_gyre};
use std::io::ErrorKind;
use std::os::unix::net::UnixDatagram;
use std::process::Command;
use std::time::{Duration, Instant};

/// A service manager, and a folder for a run.
struct Manager {
    socket: UnixDatagram,
    folder: tempfile::TempDir,
    /// All lines so far.
    lines: Vec<String>,
}

impl Manager {
    fn new() -> Self {
        let folder = tempfile::tempdir().unwrap();
        let socket = UnixDatagram::bind(folder.path().join("notify")).unwrap();
        socket.set_read_timeout(Some(Duration::from_millis(20))).unwrap();
        Self { socket, folder, lines: Vec::new() }
    }

    /// A command that this manager starts, without a watchdog.
    fn service(&self, arguments: &[&str]) -> Command {
        let mut command = program::ridgewatch(arguments);
        command.args(["--device", "cpu", "--threads", "1", "--out", text(&self.folder.path().join("run"))]);
        command.env("NOTIFY_SOCKET", self.folder.path().join("notify")).env_remove("WATCHDOG_USEC").env_remove("WATCHDOG_PID");
        command
    }

    /// A replay of quick frames.
    fn replay(&self, slides: usize) -> Command {
        let keys = format!("time.tau = 10\ntime.slides = {slides}\nflow.steps = 20\nrender.method = \"reference\"\n");
        self.service(&["replay", &scene::write(self.folder.path(), &double_gyre([16, 8, 1], &keys))])
    }

    /// Takes the lines that have come; each must be of a known kind.
    fn listen(&mut self) {
        let mut datagram = [0; 4096];
        loop {
            match self.socket.recv(&mut datagram) {
                Ok(length) => self.lines.extend(std::str::from_utf8(&datagram[..length]).unwrap().lines().map(str::to_owned)),
                Err(error) if matches!(error.kind(), ErrorKind::WouldBlock | ErrorKind::TimedOut) => break,
                Err(error) => panic!("{error}"),
            }
        }
        for line in &self.lines {
            assert!(["READY=1", "WATCHDOG=1", "STOPPING=1"].contains(&line.as_str()) || line.starts_with("STATUS="), "{line:?}");
        }
    }

    fn count(&self, line: &str) -> usize {
        self.lines.iter().filter(|told| *told == line).count()
    }

    /// Listens until it is told a line that holds these words.
    fn hears(&mut self, words: &str) {
        let begin = Instant::now();
        while !self.lines.iter().any(|line| line.contains(words)) {
            assert!(begin.elapsed() < LONG, "{words:?} is not among {:?}", self.lines);
            self.listen();
        }
    }

    fn ends(&mut self, running: Running, status: i32) {
        running.signal(libc::SIGTERM);
        self.hears("STOPPING=1");
        running.wait().refused(status, &[]);
        self.listen();
        assert_eq!((self.count("READY=1"), self.count("STOPPING=1")), (1, 1), "{:?}", self.lines);
    }
}

#[test]
fn a_replay_tells_that_it_has_started_what_it_does_and_that_it_stops() {
    let mut manager = Manager::new();
    let running = start(manager.replay(1_000_000).env("WATCHDOG_USEC", "400000"));
    manager.hears("READY=1");
    assert!(manager.lines[0] == "READY=1" && manager.lines[1].starts_with("STATUS="), "{:?}", manager.lines);
    let begin = Instant::now();
    manager.hears("traced 100.0 %");
    // A line a second at most, although there are many frames a second.
    until("some seconds", || {
        manager.listen();
        begin.elapsed() > Duration::from_secs(4)
    });
    let told = manager.lines.iter().filter(|line| line.starts_with("STATUS=frame ")).count();
    assert!((1..=begin.elapsed().as_secs() as usize + 2).contains(&told), "{told} lines: {:?}", manager.lines);
    assert!(manager.count("WATCHDOG=1") >= 2, "{:?}", manager.lines);
    assert!(manager.count("STOPPING=1") == 0);
    manager.ends(running, 143);
}

#[test]
fn a_run_that_waits_for_its_simulation_has_started_and_lives() {
    let mut manager = Manager::new();
    let ring = Ring::new("service");
    let running = start(manager.service(&["attach", text(&ring.0), "--tau", "4"]).env("WATCHDOG_USEC", "400000"));
    manager.hears("STATUS=waiting for a simulation");
    assert_eq!(manager.lines[0], "READY=1");
    let before = manager.count("WATCHDOG=1");
    until("further signs of life", || {
        manager.listen();
        manager.count("WATCHDOG=1") >= before + 5
    });
    manager.ends(running, 0);
}

#[test]
fn a_run_that_ends_by_itself_says_so_and_one_that_is_not_watched_gives_no_signs() {
    let mut manager = Manager::new();
    start(&mut manager.replay(3)).wait().success();
    manager.listen();
    assert_eq!((manager.lines.first().unwrap().as_str(), manager.lines.last().unwrap().as_str()), ("READY=1", "STOPPING=1"));
    assert_eq!((manager.count("READY=1"), manager.count("STOPPING=1"), manager.count("WATCHDOG=1")), (1, 1, 0), "{:?}", manager.lines);
    // The period belongs to another process.
    let mut other = Manager::new();
    start(other.replay(3).env("WATCHDOG_USEC", "1000").env("WATCHDOG_PID", "1")).wait().success();
    other.listen();
    assert_eq!(other.count("WATCHDOG=1"), 0);
}

#[test]
fn a_command_that_is_refused_never_was_ready() {
    let mut manager = Manager::new();
    start(&mut manager.service(&["replay", "/no/such/scene.toml"])).wait().refused(2, &["scene.toml"]);
    start(&mut manager.service(&["attach", text(&manager.folder.path().join("ring"))])).wait().refused(2, &["tau"]);
    manager.listen();
    assert_eq!(manager.count("READY=1"), 0, "{:?}", manager.lines);
}

#[test]
fn a_manager_that_does_not_read_or_is_gone_delays_nothing() {
    let manager = Manager::new();
    // More signs than a socket holds.
    start(manager.replay(300).env("WATCHDOG_USEC", "4000")).wait().success();
    let gone = Manager::new();
    std::fs::remove_file(gone.folder.path().join("notify")).unwrap();
    let output = start(&mut gone.replay(3)).wait().success();
    assert_eq!(output.stderr.matches("the service manager cannot be told").count(), 1, "{}", output.stderr);
}

#[test]
fn without_a_manager_no_thread_tells() {
    let manager = Manager::new();
    let threads = |command: &mut Command| {
        let running = start(command);
        until("frames", || manager.folder.path().join("run/frames/frame_000001.png").exists());
        let tasks = std::fs::read_dir(format!("/proc/{}/task", running.id())).unwrap();
        let names = tasks.map(|task| std::fs::read_to_string(task.unwrap().path().join("comm")).unwrap_or_default());
        names.filter(|name| name.trim() == "ridgewatch-noti").count()
    };
    assert_eq!(threads(manager.replay(1_000_000).env_remove("NOTIFY_SOCKET")), 0);
    std::fs::remove_dir_all(manager.folder.path().join("run")).unwrap();
    assert_eq!(threads(&mut manager.replay(1_000_000)), 1);
}
