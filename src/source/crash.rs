//! A crash of the C libraries becomes a message.
//!
//! libhdf5 and libnetcdf may crash on a damaged file. Rust cannot catch that, but while they read a file, its name lies ready for a signal
//! handler, which says which file it was and ends the process with the status of a failure.

use std::cell::Cell;
use std::ffi::{CString, c_char, c_int};
use std::path::Path;
use std::ptr::null;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Mutex, OnceLock, PoisonError};
use std::time::{Duration, Instant};

thread_local! {
    /// The file that this thread has a library read; null outside of such calls.
    static READING: Cell<*const c_char> = const { Cell::new(null()) };
}

/// When [`report_crashes`] was called.
static START: OnceLock<Instant> = OnceLock::new();
/// When a file began to be opened, milliseconds since [`report_crashes`] and one more; 0 while none is.
static OPENING: AtomicU64 = AtomicU64::new(0);
/// Which file that was.
static OPENED: Mutex<String> = Mutex::new(String::new());
/// Seconds that a library may take to open a file: some damaged ones send it round for ever.
const LONGEST_OPENING: u64 = 120;

/// While it lives, a crash on this thread is put down to a file.
pub(super) struct Reading {
    _name: CString,
    before: *const c_char,
    opening: bool,
}

impl Reading {
    pub(super) fn of(path: &Path) -> Self {
        let name = CString::new(path.to_string_lossy().replace('\0', "?")).unwrap_or_default();
        let before = READING.replace(name.as_ptr());
        Self { _name: name, before, opening: false }
    }

    /// The same for opening a file, which has a limit in time.
    pub(super) fn opening(path: &Path) -> Self {
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

/// From now on a crash of a C library on a damaged file is one line on standard error and exit status 1. For programs, not for libraries:
/// the handlers are the process's.
pub fn report_crashes() {
    // The binding of libnetcdf panics where that fails; the panic is caught and becomes an error, so that it need not be told twice.
    let told = std::panic::take_hook();
    std::panic::set_hook(Box::new(move |panic| {
        if READING.get().is_null() {
            told(panic);
        }
    }));
    let start = *START.get_or_init(Instant::now);
    // `RIDGEWATCH_OPENING_LIMIT` is for file systems that are slower, and for tests.
    let limit = std::env::var("RIDGEWATCH_OPENING_LIMIT").ok().and_then(|s| s.parse().ok()).unwrap_or(LONGEST_OPENING);
    let watch = move || {
        loop {
            std::thread::sleep(Duration::from_millis(500));
            let since = OPENING.load(Ordering::Relaxed);
            if since > 0 && start.elapsed().as_millis() as u64 + 1 > since + 1000 * limit {
                let name = OPENED.lock().unwrap_or_else(PoisonError::into_inner);
                let text = format!("ridgewatch: {name}: not opened within {limit} s: it is damaged, or its disk does not answer\n");
                // SAFETY: `write` gets a pointer to as many bytes as it is told; the library cannot be stopped, the process can.
                unsafe {
                    let _ = libc::write(2, text.as_ptr().cast(), text.len());
                    libc::_exit(1);
                }
            }
        }
    };
    // Without the thread there is no limit, and nothing else is lost.
    let _ = std::thread::Builder::new().name("ridgewatch-watch".into()).spawn(watch);
    for signal in CRASHES {
        // SAFETY: the action is fully initialised, and the handler calls only what is safe in one: `write`, `_exit`, `signal`, `raise`, and
        // reads a thread-local cell that needs neither initialisation nor destruction. SA_ONSTACK runs it on the alternative stack that the
        // standard library gives each thread, so that an overflow of the stack is told too.
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
    // SAFETY: all calls are async-signal-safe; `name` is null or a C string that lives as long as the call in which the crash came.
    unsafe {
        if name.is_null() {
            // Not theirs: as if there were no handler.
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
