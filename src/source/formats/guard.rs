//! Calls of the C libraries: their panics and crashes become messages.
//!
//! libhdf5 and libnetcdf may crash on a damaged file. Rust cannot catch a crash. While a library reads a file, the name of the
//! file is stored for a signal handler, which prints it and ends the process with a failure status.

use super::messages::{FormatError, FormatFault};
use std::cell::Cell;
use std::ffi::{CString, c_char, c_int};
use std::fmt::Display;
use std::fs::{File, Metadata, TryLockError};
use std::os::fd::AsRawFd;
use std::os::unix::fs::MetadataExt;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::Path;
use std::ptr::null;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Mutex, OnceLock, PoisonError};
use std::time::{Duration, Instant};

/// Reads from a file through a C library. `None` if a binding panicked.
pub fn guarded<T>(path: &Path, read: impl FnOnce() -> T) -> Option<T> {
    run(Reading::of(path), read)
}

/// Opens a file through a C library, within a time limit.
///
/// # Errors
/// The library fails or panics (`panicked` is the message then), or cannot lock the file; another process has locked it.
pub fn open_guarded<T, E: Display>(path: &Path, panicked: &str, open: impl FnOnce() -> Result<T, E>) -> Result<T, FormatError> {
    if READS_WITHOUT_LOCKS.load(Ordering::Relaxed) && is_locked_for_writing(path) {
        return Err(FormatFault::Locked(WRITTEN.into()).of(path));
    }
    let damaged = |what: String| FormatFault::Damaged(what).of(path);
    match run(Reading::opening(path), open) {
        Some(opened) => opened.map_err(|error| locked(path, &error.to_string()).unwrap_or_else(|| damaged(error.to_string()))),
        None => Err(damaged(panicked.into())),
    }
}

fn run<T>(_reading: Reading, call: impl FnOnce() -> T) -> Option<T> {
    silence();
    catch_unwind(AssertUnwindSafe(call)).ok()
}

/// Keeps libhdf5 from printing its error stack on standard error, which it does even where libnetcdf only asks whether an
/// attribute exists. The setting belongs to a thread.
pub fn silence() {
    thread_local!(static SILENCED: Cell<bool> = const { Cell::new(false) });
    if !SILENCED.replace(true) {
        hdf5_metno::silence_errors(true);
    }
}

/// The variable that tells libhdf5 whether to lock the files that it opens.
const FILE_LOCKING: &str = "HDF5_USE_FILE_LOCKING";
/// Why a lock is not to be had.
const WRITTEN: &str = "another process has locked it, perhaps since it is still being written";
/// True after [`read_without_locks`], unless the environment decides.
static READS_WITHOUT_LOCKS: AtomicBool = AtomicBool::new(false);

/// Reads files without locking them from now on, unless `HDF5_USE_FILE_LOCKING` is set: a solver that opens a file to append fails while a reader
/// holds a lock. Files that another process has locked for writing are still refused, where the system lists locks. For programs, before they start
/// threads.
///
/// # Safety
/// No other thread reads or changes the environment meanwhile.
pub unsafe fn read_without_locks() {
    if std::env::var_os(FILE_LOCKING).is_none() {
        // SAFETY: the caller's.
        unsafe { std::env::set_var(FILE_LOCKING, "FALSE") };
        READS_WITHOUT_LOCKS.store(true, Ordering::Relaxed);
    }
}

/// True if Linux lists a lock of another process for writing on this file. It lists none of processes of other machines, or outside of the container.
/// Asking for the lock instead could make the writer's own attempt fail.
fn is_locked_for_writing(path: &Path) -> bool {
    let (Some(place), Ok(locks)) = (place_of_locks(path), std::fs::read_to_string("/proc/locks")) else { return false };
    let own = std::process::id().to_string();
    // Number, kind, "ADVISORY", "WRITE" or "READ", process, place, first and last byte.
    locks.lines().map(|line| line.split_whitespace().collect::<Vec<_>>()).any(|lock| match lock[..] {
        [_, "FLOCK" | "POSIX" | "OFDLCK", _, "WRITE", process, at, ..] => at == place && process != own,
        _ => false,
    })
}

/// Device and inode of a file as `/proc/locks` has them. The device is that of its mount: btrfs gives files another one.
fn place_of_locks(path: &Path) -> Option<String> {
    let inode = path.metadata().ok().filter(Metadata::is_file)?.ino();
    let file = File::open(path).ok()?;
    let about = std::fs::read_to_string(format!("/proc/self/fdinfo/{}", file.as_raw_fd())).ok()?;
    let mount = about.lines().find_map(|line| line.strip_prefix("mnt_id:"))?.trim();
    let mounts = std::fs::read_to_string("/proc/self/mountinfo").ok()?;
    // Number of the mount, that of the one that it is in, device.
    let mut fields = mounts.lines().map(str::split_whitespace).find(|fields| fields.clone().next() == Some(mount))?;
    let (major, minor) = fields.nth(2)?.split_once(':')?;
    let [major, minor] = [major, minor].map(|number| number.parse::<u32>());
    Some(format!("{:02x}:{:02x}:{inode}", major.ok()?, minor.ok()?))
}

/// Checks whether a file failed to open because it could not be locked, which the libraries do not say.
fn locked(path: &Path, what: &str) -> Option<FormatError> {
    // As libhdf5 reads it.
    if std::env::var_os(FILE_LOCKING).is_some_and(|value| value == "FALSE" || value == "0") {
        return None;
    }
    let why = match File::open(path).ok()?.try_lock_shared() {
        Ok(()) => return None,
        Err(TryLockError::WouldBlock) => WRITTEN.to_owned(),
        Err(TryLockError::Error(error)) => format!("its file system says {error}"),
    };
    Some(FormatFault::Locked(format!("{why} (the library: {what})")).of(path))
}

thread_local! {
    /// The file that a library reads on this thread; null outside such calls.
    static READING: Cell<*const c_char> = const { Cell::new(null()) };
}

/// When [`report_crashes`] was called.
static START: OnceLock<Instant> = OnceLock::new();
/// Start of the current opening: milliseconds since [`report_crashes`], plus 1. 0 if no file is being opened.
static OPENING: AtomicU64 = AtomicU64::new(0);
/// The file that is being opened.
static OPENED: Mutex<String> = Mutex::new(String::new());
/// Seconds that a library may take to open a file: some damaged files put it into an endless loop.
const MAX_OPENING: u64 = 120;

/// Begins the time limit of an opening anew. For readers that come to an end with the file, however long it is.
pub fn more_is_read() {
    if let Some(start) = START.get()
        && OPENING.load(Ordering::Relaxed) > 0
    {
        OPENING.store(start.elapsed().as_millis() as u64 + 1, Ordering::Relaxed);
    }
}

/// Attributes crashes on this thread to a file while it lives.
struct Reading {
    _name: CString,
    before: *const c_char,
    opening: bool,
}

impl Reading {
    fn of(path: &Path) -> Self {
        let name = CString::new(path.to_string_lossy().replace('\0', "?")).unwrap_or_default();
        let before = READING.replace(name.as_ptr());
        Self { _name: name, before, opening: false }
    }

    /// For opening a file, which has a time limit.
    fn opening(path: &Path) -> Self {
        let mut reading = Self::of(path);
        if let Some(start) = START.get() {
            *OPENED.lock().unwrap_or_else(PoisonError::into_inner) = path.display().to_string();
            OPENING.store(start.elapsed().as_millis() as u64 + 1, Ordering::Relaxed);
            reading.opening = true;
        }
        reading
    }
}

impl Drop for Reading {
    fn drop(&mut self) {
        READING.set(self.before);
        if self.opening {
            OPENING.store(0, Ordering::Relaxed);
        }
    }
}

/// Signals of a crash.
const CRASHES: [c_int; 5] = [libc::SIGSEGV, libc::SIGBUS, libc::SIGFPE, libc::SIGILL, libc::SIGABRT];

/// Turns a crash of a C library on a damaged file into one line on standard error and exit status 1, from now on. For programs,
/// not for libraries: the handlers belong to the process.
pub fn report_crashes() {
    // Panics of the bindings are caught and become errors: printing them too would report them twice.
    let previous = std::panic::take_hook();
    std::panic::set_hook(Box::new(move |panic| {
        if READING.get().is_null() {
            previous(panic);
        }
    }));
    let start = *START.get_or_init(Instant::now);
    // `RIDGEWATCH_OPENING_LIMIT` is for slower file systems and for tests.
    let limit = std::env::var("RIDGEWATCH_OPENING_LIMIT").ok().and_then(|s| s.parse().ok()).unwrap_or(MAX_OPENING);
    let watch = move || {
        loop {
            std::thread::sleep(Duration::from_millis(500));
            let since = OPENING.load(Ordering::Relaxed);
            if since > 0 && start.elapsed().as_millis() as u64 + 1 > since + 1000 * limit {
                let name = OPENED.lock().unwrap_or_else(PoisonError::into_inner);
                let text = format!("ridgewatch: {name}: not opened within {limit} s: it is damaged, or its disk does not answer\n");
                // SAFETY: the pointer and the length describe `text`. The library cannot be stopped, the process can.
                unsafe {
                    let _ = libc::write(2, text.as_ptr().cast(), text.len());
                    libc::_exit(1);
                }
            }
        }
    };
    // If the thread cannot start, only the time limit is lost.
    let _ = std::thread::Builder::new().name("ridgewatch-watch".into()).spawn(watch);
    for signal in CRASHES {
        // SAFETY: the action is fully initialised. The handler calls only async-signal-safe functions (`write`, `_exit`, `signal`,
        // `raise`) and reads a thread-local cell that needs neither initialisation nor destruction. SA_ONSTACK runs it on the
        // alternative stack that the standard library gives each thread, so that a stack overflow is reported too.
        unsafe {
            let mut action: libc::sigaction = std::mem::zeroed();
            action.sa_sigaction = crashed as *const () as usize;
            action.sa_flags = libc::SA_ONSTACK;
            libc::sigemptyset(&mut action.sa_mask);
            libc::sigaction(signal, &action, std::ptr::null_mut());
        }
    }
}

extern "C" fn crashed(signal: c_int) {
    let name = READING.get();
    // SAFETY: all calls are async-signal-safe. `name` is null or a C string that outlives the library call that crashed.
    unsafe {
        if name.is_null() {
            // Not a crash of the libraries: take the default action.
            libc::signal(signal, libc::SIG_DFL);
            libc::raise(signal);
            return;
        }
        let say = |text: *const c_char, length: usize| {
            let _ = libc::write(2, text.cast(), length);
        };
        let (before, after) = (c"ridgewatch: ", c": damaged: the library that reads it crashed\n");
        say(before.as_ptr(), before.count_bytes());
        say(name, libc::strlen(name));
        say(after.as_ptr(), after.count_bytes());
        libc::_exit(1);
    }
}
