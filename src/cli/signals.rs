//! SIGINT, SIGTERM and SIGHUP: the first asks the work to stop, a later one ends the process, and so does a bound.
//!
//! A handler writes each signal into a pipe, from which one thread reads. The work stays on the calling thread, so that it needs no other
//! thread to run or to end.

use super::messages;
use anyhow::{Result, anyhow};
use std::io::Read;
use std::os::fd::{AsRawFd, IntoRawFd};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicI32, AtomicU8, Ordering};
use std::time::{Duration, Instant};

/// Signals that ask for a stop.
const SIGNALS: [i32; 3] = [libc::SIGINT, libc::SIGTERM, libc::SIGHUP];
/// Time after the first signal in which further ones belong to the same stop. GNU `timeout` signals its child and then the child's group, Slurm
/// the steps and the batch script, and systemd sends SIGHUP after SIGTERM.
const ONE_STOP: Duration = Duration::from_secs(1);
/// Longest wait for the last action of a process that is ended at once: it may need a disk that does not answer.
const LAST_ACTION: Duration = Duration::from_millis(500);

/// What the signals so far ask of the work.
#[derive(Debug, Clone, Default)]
pub struct Stop {
    /// Set by the first signal: the work ends after the part that it is at, as a frame.
    pub requested: Arc<AtomicBool>,
    /// Set when half of the bound has passed: the part in progress is abandoned, and what was finished before is saved.
    pub abandoned: Arc<AtomicBool>,
    caught: Arc<AtomicU8>,
}

impl Stop {
    /// Exit status that stands for the first signal; 0 before it.
    pub fn status(&self) -> u8 {
        self.caught.load(Ordering::Relaxed)
    }

    /// Starts to watch for signals, until the process ends. `within` bounds the time from the first signal to the end of the process; `last` is
    /// called before the process is ended at once. If the system refuses, that is a note, and a signal ends the process.
    pub fn watch(&self, within: Option<Duration>, last: impl FnOnce() + Send + 'static) {
        let watched = pipe_of_signals().and_then(|signals| {
            let stop = self.clone();
            std::thread::Builder::new().name("ridgewatch-signals".into()).spawn(move || stop.hear(signals, within, last))?;
            // Only with a thread that reads the pipe: otherwise a signal would do nothing.
            handle_signals()
        });
        if let Err(error) = watched {
            messages::note(format_args!("cannot watch for signals, which will end the run at once: {error}"));
        }
    }

    /// Never waits for anything but signals and the bound.
    fn hear(&self, mut signals: std::io::PipeReader, within: Option<Duration>, last: impl FnOnce() + Send + 'static) {
        let mut first: Option<Instant> = None;
        loop {
            let mut due = None;
            if let (Some(bound), Some(first)) = (within, first) {
                let left = bound.saturating_sub(first.elapsed());
                if left.is_zero() {
                    self.leave(&format!("after the {} s of --stop-within", bound.as_secs_f64()), last);
                }
                if left <= bound / 2 && !self.abandoned.swap(true, Ordering::Relaxed) {
                    messages::note_aside("the frame in progress is abandoned, to save what was finished before");
                }
                due = Some(if left > bound / 2 { left - bound / 2 } else { left });
            }
            if !is_readable(&signals, due) {
                continue;
            }
            let mut signal = [0];
            // The handler keeps the other end open, so that there is no end of the stream.
            if signals.read_exact(&mut signal).is_err() {
                return;
            }
            let Some(first) = first else {
                first = Some(Instant::now());
                self.caught.store(128 + signal[0], Ordering::Relaxed);
                // Said first: a run that waits ends at once.
                match within {
                    Some(bound) => messages::note_aside(format_args!(
                        "finishing the current frame, for {} s at most; once more to stop at once",
                        bound.as_secs_f64() / 2.0
                    )),
                    None => messages::note_aside("finishing the current frame; once more to stop at once"),
                }
                self.requested.store(true, Ordering::Relaxed);
                continue;
            };
            if first.elapsed() >= ONE_STOP {
                self.leave("by a further signal", last);
            }
        }
    }

    /// Ends the process.
    fn leave(&self, why: &str, last: impl FnOnce() + Send + 'static) -> ! {
        let (done, wait) = std::sync::mpsc::channel();
        let text = format!("stopped at once {why}; unwritten output is lost");
        let act = move || {
            last();
            // Standard error may be on a disk that does not answer either.
            messages::note(text);
            let _ = done.send(());
        };
        if std::thread::Builder::new().spawn(act).is_ok() {
            // Past the limit, the process ends without it.
            let _ = wait.recv_timeout(LAST_ACTION);
        }
        // SAFETY: ends the process and touches no memory of ours. Not `exit`, whose handlers wait for libraries that may be waiting for a disk.
        unsafe { libc::_exit(self.status().into()) }
    }
}

/// End of the pipe that the handler writes into; -1 before there is one.
static PIPE: AtomicI32 = AtomicI32::new(-1);

/// Opens the pipe of signals. The writing end stays open until the process ends.
fn pipe_of_signals() -> std::io::Result<std::io::PipeReader> {
    let (reader, writer) = std::io::pipe()?;
    // SAFETY: changes the flags of a descriptor of ours. A full pipe must not stop the handler; the signals in it say enough.
    if unsafe { libc::fcntl(writer.as_raw_fd(), libc::F_SETFL, libc::O_NONBLOCK) } != 0 {
        return Err(std::io::Error::last_os_error());
    }
    PIPE.store(writer.into_raw_fd(), Ordering::Relaxed);
    Ok(reader)
}

extern "C" fn on_signal(signal: libc::c_int) {
    let number = signal as u8;
    // SAFETY: `write` and the place of `errno` may be used in a handler; `number` is one byte. The interrupted code gets its `errno` back.
    unsafe {
        let errno = *libc::__errno_location();
        libc::write(PIPE.load(Ordering::Relaxed), (&raw const number).cast(), 1);
        *libc::__errno_location() = errno;
    }
}

/// Sets the handler of each signal. A SIGHUP that is ignored, as under `nohup`, stays ignored.
fn handle_signals() -> std::io::Result<()> {
    for signal in SIGNALS {
        // SAFETY: the structures are plain data, for which zeros are valid, and live until the calls return; the handler calls only what a
        // handler may.
        let done = unsafe {
            let (mut now, mut action): (libc::sigaction, libc::sigaction) = (std::mem::zeroed(), std::mem::zeroed());
            libc::sigaction(signal, std::ptr::null(), &raw mut now);
            if signal == libc::SIGHUP && now.sa_sigaction == libc::SIG_IGN {
                continue;
            }
            action.sa_sigaction = on_signal as *const () as libc::sighandler_t;
            // Calls of libraries that a signal interrupts go on.
            action.sa_flags = libc::SA_RESTART;
            libc::sigaction(signal, &raw const action, std::ptr::null_mut())
        };
        if done != 0 {
            return Err(std::io::Error::last_os_error());
        }
    }
    Ok(())
}

/// Waits until a signal can be read, for this time or without end. Returns whether one can.
fn is_readable(signals: &std::io::PipeReader, within: Option<Duration>) -> bool {
    // Rounded up, so that the time has passed afterwards.
    let milliseconds = within.map_or(-1, |time| i32::try_from(time.as_micros().div_ceil(1000)).unwrap_or(i32::MAX));
    let mut poll = libc::pollfd { fd: signals.as_raw_fd(), events: libc::POLLIN, revents: 0 };
    // SAFETY: one structure, which lives until the call returns.
    unsafe { libc::poll(&raw mut poll, 1, milliseconds) > 0 }
}

/// Runs work to which a signal gives the flag to stop. `last` is called if a further signal ends the process at once.
pub fn until_stopped<T>(last: impl FnOnce() + Send + 'static, work: impl FnOnce(&Arc<AtomicBool>) -> Result<T>) -> Result<T> {
    let stop = Stop::default();
    stop.watch(None, last);
    unless_panicked("the work stopped unexpectedly", || work(&stop.requested))
}

/// Makes an error of a panic, which has been printed by then.
pub fn unless_panicked<T>(what: &'static str, work: impl FnOnce() -> Result<T>) -> Result<T> {
    std::panic::catch_unwind(std::panic::AssertUnwindSafe(work)).map_err(|_| anyhow!("{what} (see above)")).and_then(|done| done)
}
