//! Host copies of a network that a device trains: how they are downloaded while training goes on.
//!
//! burn's module stays on the host. For a checkpoint and every minute or so the device makes a copy, which another thread downloads. When the device
//! is lost, training goes on from the latest download.

use super::super::device::{Download, HostNetwork};
use super::Progress;
use crate::backend::DeviceError;
use std::sync::{Arc, Mutex, OnceLock, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

/// Shortest time between two downloads, seconds: a lost device costs at most that much training.
const MIN_INTERVAL: f64 = 60.0;
/// Time between two downloads as a multiple of the seconds that training waits for one, so that they cost a hundredth of the time.
const INTERVAL_PER_WAIT: f64 = 100.0;
/// Longest time that the end of training waits for a download in progress.
const DOWNLOAD_LIMIT: Duration = Duration::from_secs(5);

/// A copy that a device has made, and its numbers once they are downloaded.
pub(super) struct PendingCopy {
    /// How far training was.
    pub(super) progress: Progress,
    download: Mutex<Option<Download>>,
    network: OnceLock<Result<HostNetwork, DeviceError>>,
}

impl PendingCopy {
    pub(super) fn new(download: Download, progress: Progress) -> Arc<Self> {
        Arc::new(Self { progress, download: Mutex::new(Some(download)), network: OnceLock::new() })
    }

    /// Downloads the numbers, or waits for the thread that does.
    pub(super) fn fetch(&self) -> Result<&HostNetwork, DeviceError> {
        let download = || {
            let download = self.download.lock().unwrap_or_else(PoisonError::into_inner).take();
            let panicked = || DeviceError::Unsupported { what: "a download whose thread panicked".into() };
            download.ok_or_else(panicked)?()
        };
        self.network.get_or_init(download).as_ref().map_err(Clone::clone)
    }

    /// The numbers, if they are downloaded.
    pub(super) fn ready(&self) -> Option<&Result<HostNetwork, DeviceError>> {
        self.network.get()
    }
}

/// The downloads of one network.
pub(super) struct Copies {
    pub(super) pending: Option<Arc<PendingCopy>>,
    /// Whether the pending copy holds weights that were rolled back since.
    pub(super) is_rolled_back: bool,
    /// How far training was at the latest host copy.
    pub(super) progress: Progress,
    /// When the latest copy was made, and how long training waited for it.
    pub(super) made: Instant,
    pub(super) wait_seconds: f64,
    pub(super) thread: Option<JoinHandle<()>>,
    /// Whether the warning that training waits for downloads was given.
    pub(super) has_warned: bool,
}

impl Copies {
    pub(super) fn new(progress: Progress) -> Self {
        let (made, wait_seconds) = (Instant::now(), 0.0);
        Self { pending: None, is_rolled_back: false, progress, made, wait_seconds, thread: None, has_warned: false }
    }

    /// Seconds between two downloads.
    pub(super) fn interval(&self) -> f64 {
        MIN_INTERVAL.max(INTERVAL_PER_WAIT * self.wait_seconds)
    }

    /// Whether another download is due.
    pub(super) fn is_due(&self) -> bool {
        self.made.elapsed().as_secs_f64() >= self.interval()
    }
}

impl Drop for Copies {
    /// The device must not be closed during a download; one that hangs is not waited for.
    fn drop(&mut self) {
        let begin = Instant::now();
        while self.thread.as_ref().is_some_and(|thread| !thread.is_finished()) && begin.elapsed() < DOWNLOAD_LIMIT {
            std::thread::sleep(Duration::from_millis(1));
        }
    }
}
