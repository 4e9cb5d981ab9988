//! SIGINT and SIGTERM: the first asks the work to stop, the second ends the process.

use super::messages;
use anyhow::{Context, Result};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU8, Ordering};

/// Starts to watch for signals. The first sets `stop` and stores its exit status in `caught`. `None` if the system refuses.
pub fn watch(stop: Arc<AtomicBool>, caught: Arc<AtomicU8>) -> Option<impl Future<Output = ()>> {
    use tokio::signal::unix::{SignalKind, signal};
    let (Ok(mut interrupt), Ok(mut terminate)) = (signal(SignalKind::interrupt()), signal(SignalKind::terminate())) else {
        messages::note("cannot watch for signals: an interrupt will end the run at once");
        return None;
    };
    Some(async move {
        loop {
            let status = tokio::select! { _ = interrupt.recv() => 130u8, _ = terminate.recv() => 143 };
            caught.store(status, Ordering::Relaxed);
            if stop.swap(true, Ordering::Relaxed) {
                messages::note("stopped at once; unwritten output is lost");
                // SAFETY: ends the process and touches no memory of ours. Not `exit`, whose handlers wait for libraries that may be
                // waiting for a disk.
                unsafe { libc::_exit(status.into()) }
            }
            messages::note("finishing the current frame; once more to stop at once");
        }
    })
}

/// A runtime for signals and the work that they stop.
pub fn runtime(threads: usize) -> Result<tokio::runtime::Runtime> {
    tokio::runtime::Builder::new_multi_thread().worker_threads(threads).enable_all().build().context("cannot start the I/O threads")
}

/// Runs blocking work to which a signal gives the flag to stop.
pub fn until_stopped<T: Send + 'static>(work: impl FnOnce(&Arc<AtomicBool>) -> Result<T> + Send + 'static) -> Result<T> {
    let stop = Arc::new(AtomicBool::new(false));
    runtime(1)?.block_on(async {
        let signals = watch(stop.clone(), Arc::default()).map(tokio::spawn);
        let done = tokio::task::spawn_blocking(move || work(&stop)).await;
        if let Some(signals) = signals {
            signals.abort();
        }
        done.context("the work stopped unexpectedly")?
    })
}
