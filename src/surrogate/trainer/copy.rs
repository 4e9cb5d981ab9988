//! Host copies of a network on a device, downloaded while training continues.
//!
//! burn's module stays on the host. For a checkpoint, and about once a minute, the device makes a copy, which another thread downloads. After a
//! device loss, training continues from the latest download.

use super::super::device::{Download, HostNetwork};
use super::Progress;
use ridgewatch_base::DeviceError;
use std::sync::{Arc, Mutex, OnceLock, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

/// Shortest time between two downloads, seconds: the training lost with a device is not much longer.
const MIN_INTERVAL: f64 = 60.0;
/// Time between two downloads as a multiple of the seconds that training waits for one, so that they cost a hundredth of the time.
const INTERVAL_PER_WAIT: f64 = 100.0;
/// Longest time that the end of training waits for a download in progress.
const DOWNLOAD_LIMIT: Duration = Duration::from_secs(5);

/// A copy on a device, and its values after the download.
pub(super) struct PendingCopy {
    /// Progress of training at the copy.
    pub(super) progress: Progress,
    download: Mutex<Option<Download>>,
    network: OnceLock<Result<HostNetwork, DeviceError>>,
}

impl PendingCopy {
    pub(super) fn new(download: Download, progress: Progress) -> Arc<Self> {
        Arc::new(Self { progress, download: Mutex::new(Some(download)), network: OnceLock::new() })
    }

    /// Downloads the values, or waits for the thread that downloads them.
    pub(super) fn fetch(&self) -> Result<&HostNetwork, DeviceError> {
        let download = || {
            let download = self.download.lock().unwrap_or_else(PoisonError::into_inner).take();
            let panicked = || DeviceError::Unsupported { what: "a download whose thread panicked".into() };
            download.ok_or_else(panicked)?()
        };
        self.network.get_or_init(download).as_ref().map_err(Clone::clone)
    }

    /// Returns the values if the download is complete.
    pub(super) fn ready(&self) -> Option<&Result<HostNetwork, DeviceError>> {
        self.network.get()
    }
}

/// The downloads of one network.
pub(super) struct Copies {
    pub(super) pending: Option<Arc<PendingCopy>>,
    /// True if the weights of the pending copy were rolled back later.
    pub(super) is_rolled_back: bool,
    /// Progress of training at the latest host copy.
    pub(super) progress: Progress,
    /// Time of the latest copy, and the seconds that training waited for it.
    pub(super) made: Instant,
    pub(super) wait_seconds: f64,
    pub(super) thread: Option<JoinHandle<()>>,
    /// True once the warning that training waits for downloads was given.
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

    /// True if another download is due.
    pub(super) fn is_due(&self) -> bool {
        self.made.elapsed().as_secs_f64() >= self.interval()
    }
}

impl Drop for Copies {
    /// Waits for a download in progress, since the device must not be closed during it. The wait is limited.
    fn drop(&mut self) {
        let begin = Instant::now();
        while self.thread.as_ref().is_some_and(|thread| !thread.is_finished()) && begin.elapsed() < DOWNLOAD_LIMIT {
            std::thread::sleep(Duration::from_millis(1));
        }
    }
}
