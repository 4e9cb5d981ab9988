//! Runs the program, and other processes, under a time limit.

use ridgewatch::run::FrameRecord;
use serde_json::Value;
use std::ffi::OsStr;
use std::io::{Read, Write};
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::{Arc, Mutex};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

/// Longest time that a test waits for anything. A test that hangs fails, also on a slow and busy machine.
pub const LONG: Duration = Duration::from_secs(600);

/// A file or folder of the project.
pub fn project(path: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join(path)
}

/// Path of a shipped scene.
pub fn config(name: &str) -> String {
    project("configs").join(name).display().to_string()
}

/// A path as an argument.
pub fn text(path: &Path) -> &str {
    path.to_str().unwrap()
}

/// The program with these arguments, without the user's own ring and log level, and without a service manager.
pub fn ridgewatch<S: AsRef<OsStr>>(arguments: impl IntoIterator<Item = S>) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_ridgewatch"));
    command.args(arguments).env_remove("RIDGEWATCH_RING").env_remove("RIDGEWATCH_LOG").env_remove("NOTIFY_SOCKET");
    command
}

/// Exit status and output of a process.
#[derive(Debug)]
pub struct Outcome {
    command: String,
    /// `None` if a signal ended it.
    pub status: Option<i32>,
    pub stdout: String,
    pub stderr: String,
}

impl Outcome {
    /// Asserts exit status 0.
    #[track_caller]
    pub fn success(self) -> Self {
        assert_eq!(self.status, Some(0), "{}: {}", self.command, self.stderr);
        self
    }

    /// Asserts this exit status, and that standard error holds each part and no panic.
    #[track_caller]
    pub fn refused(self, status: i32, parts: &[&str]) -> Self {
        let Self { command, stderr, .. } = &self;
        assert_eq!(self.status, Some(status), "{command}: {stderr}");
        assert!(!stderr.contains("panicked"), "{stderr}");
        for part in parts {
            assert!(stderr.contains(part), "{command} prints {stderr:?}, without {part:?}");
        }
        self
    }

    /// Standard output as JSON.
    pub fn json(&self) -> Value {
        serde_json::from_str(&self.stdout).unwrap()
    }
}

/// Bytes of a pipe, read as they come.
struct Collected {
    bytes: Arc<Mutex<Vec<u8>>>,
    reader: JoinHandle<()>,
}

impl Collected {
    fn from(mut pipe: impl Read + Send + 'static) -> Self {
        let bytes = Arc::new(Mutex::new(Vec::new()));
        let sink = bytes.clone();
        let reader = std::thread::spawn(move || {
            let mut part = [0; 4096];
            while let Ok(count @ 1..) = pipe.read(&mut part) {
                sink.lock().unwrap().extend_from_slice(&part[..count]);
            }
        });
        Self { bytes, reader }
    }

    fn so_far(&self) -> String {
        String::from_utf8_lossy(&self.bytes.lock().unwrap()).into_owned()
    }

    fn whole(self) -> String {
        self.reader.join().unwrap();
        String::from_utf8_lossy(&Arc::into_inner(self.bytes).unwrap().into_inner().unwrap()).into_owned()
    }
}

/// A process that does not outlive its test.
pub struct Running {
    child: Child,
    command: String,
    output: Option<[Collected; 2]>,
}

impl Running {
    pub fn id(&self) -> u32 {
        self.child.id()
    }

    pub fn has_ended(&mut self) -> bool {
        self.child.try_wait().unwrap().is_some()
    }

    /// Standard error up to now.
    pub fn stderr(&self) -> String {
        self.output.as_ref().unwrap()[1].so_far()
    }

    /// Standard output up to now.
    pub fn stdout(&self) -> String {
        self.output.as_ref().unwrap()[0].so_far()
    }

    pub fn signal(&self, signal: i32) {
        // SAFETY: a signal to a child of this test.
        assert_eq!(unsafe { libc::kill(self.id() as i32, signal) }, 0);
    }

    pub fn wait(self) -> Outcome {
        self.wait_at_most(LONG)
    }

    /// Waits for the end; the test fails if it takes longer.
    pub fn wait_at_most(mut self, limit: Duration) -> Outcome {
        let begin = Instant::now();
        while !self.has_ended() {
            assert!(begin.elapsed() < limit, "{} still runs after {limit:?}: {}", self.command, self.stderr());
            std::thread::sleep(Duration::from_millis(5));
        }
        let status = self.child.wait().unwrap().code();
        let [stdout, stderr] = self.output.take().unwrap().map(Collected::whole);
        Outcome { command: std::mem::take(&mut self.command), status, stdout, stderr }
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// Starts a process.
pub fn start(command: &mut Command) -> Running {
    let close = || {
        // Files that another test writes: the process would hold their locks. Systems that cannot (before Linux 5.11) leave them open.
        // SAFETY: a system call without pointers.
        unsafe { libc::syscall(libc::SYS_close_range, 3, libc::c_uint::MAX, libc::CLOSE_RANGE_CLOEXEC) };
        Ok(())
    };
    // SAFETY: only a system call between fork and exec.
    unsafe { command.pre_exec(close) };
    let mut child = command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap_or_else(|error| panic!("{command:?}: {error}"));
    let output = [Collected::from(child.stdout.take().unwrap()), Collected::from(child.stderr.take().unwrap())];
    Running { child, command: format!("{:?}", command.get_args()), output: Some(output) }
}

/// Runs a process to its end.
pub fn run(command: &mut Command) -> Outcome {
    start(command).wait()
}

/// Runs a process to its end with this standard input.
pub fn run_with_input(command: &mut Command, input: &str) -> Outcome {
    let mut running = start(command.stdin(Stdio::piped()));
    // A process that refuses its arguments reads nothing; its exit status tells.
    let _ = running.child.stdin.take().unwrap().write_all(input.as_bytes());
    running.wait()
}

/// Waits for a condition.
#[track_caller]
pub fn until(what: &str, mut holds: impl FnMut() -> bool) {
    let begin = Instant::now();
    while !holds() {
        assert!(begin.elapsed() < LONG, "{what} did not happen");
        std::thread::sleep(Duration::from_millis(5));
    }
}

/// Every record of a run. Each must read back: JSON turns a number that is not finite into null.
pub fn records(run: &Path) -> Vec<FrameRecord> {
    let text = std::fs::read_to_string(run.join("records.jsonl")).unwrap();
    text.lines().map(|line| serde_json::from_str(line).unwrap_or_else(|error| panic!("{error}: {line}"))).collect()
}

pub fn json(path: &Path) -> Value {
    serde_json::from_slice(&std::fs::read(path).unwrap()).unwrap()
}

pub fn summary(run: &Path) -> Value {
    json(&run.join("summary.json"))
}

/// `--set` before each key.
pub fn set<'a>(keys: &[&'a str]) -> Vec<&'a str> {
    keys.iter().flat_map(|key| ["--set", key]).collect()
}
