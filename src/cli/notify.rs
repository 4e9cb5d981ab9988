//! Tells a service manager how the run is (sd_notify(3)): READY=1, STATUS=, WATCHDOG=1 and STOPPING=1. Without the environment variable
//! `NOTIFY_SOCKET` nothing is sent and no thread starts.
//!
//! A thread of its own sends, so that a manager that does not read never delays a frame.

use super::messages;
use ridgewatch::progress;
use sd_notify::NotifyState;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender, sync_channel};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

/// Interval at which the thread looks for something to tell.
const LOOK: Duration = Duration::from_millis(50);
/// Least time between two lines of status.
const STATUS_INTERVAL: Duration = Duration::from_secs(1);
/// Signs of life in one period of the watchdog.
const SIGNS: u32 = 4;
/// Longest wait, at the end, for the thread to say so.
const GOODBYE: Duration = Duration::from_millis(500);
/// Characters of a status that are sent. A datagram must hold it, and a reader one line.
const MAX_STATUS: usize = 300;

/// The latest line of progress, from its first one on.
static STATUS: Mutex<Option<String>> = Mutex::new(None);
/// Whether anyone is told.
static TELLS: AtomicBool = AtomicBool::new(false);

/// Says STOPPING=1 and ends the telling when dropped.
pub struct Notifying {
    end: Option<SyncSender<()>>,
    ended: Receiver<()>,
}

/// Begins to tell the service manager, if there is one. STOPPING=1 follows when `stop` is set.
pub fn begin(stop: Arc<AtomicBool>) -> Option<Notifying> {
    std::env::var_os("NOTIFY_SOCKET")?;
    let (end, ends) = sync_channel(0);
    let (last, ended) = sync_channel(1);
    let started = std::thread::Builder::new().name("ridgewatch-notify".into()).spawn(move || {
        tell(&stop, &ends);
        let _ = last.send(());
    });
    match started {
        Ok(_) => {
            TELLS.store(true, Ordering::Relaxed);
            Some(Notifying { end: Some(end), ended })
        }
        Err(error) => {
            messages::note(format_args!("the service manager is told nothing: {error}"));
            None
        }
    }
}

impl Drop for Notifying {
    fn drop(&mut self) {
        drop(self.end.take());
        // A manager that does not read must not hold the process.
        let _ = self.ended.recv_timeout(GOODBYE);
    }
}

/// The run has started, and this is its latest line of progress.
pub fn running(line: impl FnOnce() -> String) {
    if TELLS.load(Ordering::Relaxed) {
        *STATUS.lock().unwrap_or_else(PoisonError::into_inner) = Some(line());
    }
}

/// State of the thread that tells.
struct Teller {
    /// Time between two signs of life, if the manager watches for them.
    pace: Option<Duration>,
    is_ready: bool,
    is_stopping: bool,
    /// Line that was told last, and when.
    status: Option<(String, Instant)>,
    /// Marks of progress at the last sign of life, and when it was given.
    sign: (u64, Option<Instant>),
}

/// Tells until the other end of `ends` is dropped.
fn tell(stop: &AtomicBool, ends: &Receiver<()>) {
    let pace = sd_notify::watchdog_enabled().map(|period| period / SIGNS);
    let (mut teller, mut is_lost) = (Teller::new(pace), false);
    let mut goes_on = true;
    while goes_on {
        goes_on = ends.recv_timeout(pace.map_or(LOOK, |pace| LOOK.min(pace))) == Err(RecvTimeoutError::Timeout);
        let line = STATUS.lock().unwrap_or_else(PoisonError::into_inner).clone();
        let due = teller.due(Instant::now(), line, progress::marks(), !goes_on || stop.load(Ordering::Relaxed));
        let states: Vec<_> = due.iter().map(|line| NotifyState::Custom(line)).collect();
        if !states.is_empty()
            && let Err(error) = sd_notify::notify(&states)
            && !std::mem::replace(&mut is_lost, true)
        {
            messages::note(format_args!("the service manager cannot be told: {error}"));
        }
    }
}

impl Teller {
    fn new(pace: Option<Duration>) -> Self {
        Self { pace, is_ready: false, is_stopping: false, status: None, sign: (0, None) }
    }

    /// What is to be told now: the latest line, the number of marks of progress, and whether the run is to stop.
    fn due(&mut self, now: Instant, line: Option<String>, marks: u64, stops: bool) -> Vec<String> {
        let mut due = Vec::new();
        let is_new = |line: &String| {
            self.status.as_ref().is_none_or(|(told, at)| told != line && now.saturating_duration_since(*at) >= STATUS_INTERVAL)
        };
        if let Some(line) = line.filter(is_new) {
            if !std::mem::replace(&mut self.is_ready, true) {
                due.push(NotifyState::Ready.to_string());
            }
            let text: String = line.chars().take(MAX_STATUS).map(|c| if c.is_control() { ' ' } else { c }).collect();
            due.push(NotifyState::Status(&text).to_string());
            self.status = Some((line, now));
        }
        if let Some(pace) = self.pace
            && marks != self.sign.0
            && self.sign.1.is_none_or(|given| now.saturating_duration_since(given) >= pace)
        {
            due.push(NotifyState::Watchdog.to_string());
            self.sign = (marks, Some(now));
        }
        if stops && !std::mem::replace(&mut self.is_stopping, true) {
            due.push(NotifyState::Stopping.to_string());
        }
        due
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_run_that_makes_no_progress_gives_no_sign_of_life() {
        let begin = Instant::now();
        let at = |seconds: f64| begin + Duration::from_secs_f64(seconds);
        let mut teller = Teller::new(Some(Duration::from_secs(5)));
        assert!(teller.due(at(0.0), None, 0, false).is_empty());
        assert_eq!(teller.due(at(1.0), None, 1, false), ["WATCHDOG=1"]);
        assert!(teller.due(at(3.0), None, 2, false).is_empty(), "not oftener than needed");
        assert_eq!(teller.due(at(6.0), None, 2, false), ["WATCHDOG=1"], "the mark after the last sign");
        assert!(teller.due(at(600.0), None, 2, false).is_empty(), "no mark since");
        assert_eq!(teller.due(at(601.0), None, 3, true), ["WATCHDOG=1", "STOPPING=1"]);
        assert!(Teller::new(None).due(at(1.0), None, 1, false).is_empty(), "nobody watches");
    }

    #[test]
    fn lines_are_told_once_a_second_and_the_latest_is_not_lost() {
        let begin = Instant::now();
        let mut teller = Teller::new(None);
        let mut due = |milliseconds, line: &str| teller.due(begin + Duration::from_millis(milliseconds), Some(line.to_owned()), 0, false);
        assert_eq!(due(0, "first"), ["READY=1", "STATUS=first"]);
        assert!(due(500, "second").is_empty() && due(999, "third").is_empty());
        assert_eq!(due(1050, "third"), ["STATUS=third"]);
        assert!(due(5000, "third").is_empty(), "it is known");
        // A line break would begin another message.
        assert_eq!(due(6000, "a\nSTOPPING=1"), ["STATUS=a STOPPING=1"]);
        assert_eq!(due(9000, &"\u{e9}".repeat(1000)), [format!("STATUS={}", "\u{e9}".repeat(MAX_STATUS))]);
    }
}
