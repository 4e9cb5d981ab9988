//! Snapshots on the device. Every snapshot is uploaded once, through one queue. A background thread uploads the snapshots of later windows while the
//! frames of the present slide are computed. A window uploads the snapshots that are still missing. When the window slides, snapshots that it
//! shares with the previous one stay on the device. The memory of a snapshot is freed when no tracer uses it any more.
//!
//! Half-precision velocities are stored as v / scale, with one power of two as the scale of the whole window.

use crate::cuda::driver_error;
use crate::cuda::window::grid::{Nodes, storage_define};
use crate::cuda::window::prefetch::PrefetchQueue;
use crate::cuda::window::snapshot::DeviceSnapshot;
use crate::cuda::window::uploader::SnapshotUploader;
use crate::cuda::{DeviceError, Gpu, Storage, launch, threads};
use cudarc::driver::PushKernelArg;
use rayon::prelude::*;
use ridgewatch_field::{Snapshot, Window};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

/// Peak of the scaled half-precision velocities when a window is encoded. Later snapshots may have a peak seven times as high.
const HALF_PEAK: f32 = 4096.0;
/// Largest scaled half-precision velocity. It leaves room for the difference of two; beyond it the window is encoded again.
const HALF_MAX: f32 = 30_000.0;
/// Limit on the snapshots that are uploaded before a window needs them.
const MAX_PREFETCHED: usize = 2;
/// A snapshot is prefetched only if it takes at most 1 / `PREFETCH_SHARE` of the free device memory, so that other allocations do not fail.
const PREFETCH_SHARE: u64 = 4;
/// Interval at which the thread checks whether it holds the last reference to an old snapshot, and the time after which it drops its own reference.
const RETRY: Duration = Duration::from_millis(20);
const RETRY_LIMIT: Duration = Duration::from_millis(100);
/// Limit on the threads that copy prefetched snapshots to pinned memory. Four saturate the bus.
const MAX_COPY_THREADS: usize = 4;

/// The snapshots of one window, oldest first.
#[derive(Debug, Clone)]
pub struct DeviceWindow {
    snapshots: Vec<Arc<DeviceSnapshot>>,
}

impl DeviceWindow {
    /// Description of the nodes for kernels.
    pub(in crate::cuda) fn nodes(&self) -> Nodes {
        let first = self.snapshots.first();
        Nodes {
            addresses: self.snapshots.iter().map(|s| s.nodes.address()).collect(),
            storage: first.map_or(Storage::F32, |s| s.storage),
            scale: first.map_or(1.0, |s| s.scale),
            missing: self.snapshots.iter().any(|s| s.missing),
        }
    }
    /// Bytes on the device.
    pub fn bytes(&self) -> u64 {
        self.snapshots.iter().map(|s| 4 * s.nodes.len() as u64).sum()
    }
}

/// Uploads snapshots and keeps those of the latest window.
#[derive(Debug)]
pub struct SnapshotStore {
    shared: Arc<Shared>,
    /// Uploads expected snapshots. Started with the first of them.
    thread: Mutex<Option<JoinHandle<()>>>,
}

#[derive(Debug)]
struct Shared {
    gpu: Arc<Gpu>,
    state: Mutex<State>,
    /// Notified of every change of `state`.
    changed: Condvar,
    /// Lock order: `state` before `uploader`.
    uploader: Mutex<SnapshotUploader>,
}

#[derive(Debug, Default)]
struct State {
    /// Snapshots of the latest window.
    held: Vec<Arc<DeviceSnapshot>>,
    queue: PrefetchQueue<DeviceSnapshot>,
    /// Storage and scale of the latest window. `None` before the first window.
    form: Option<(Storage, f32)>,
    /// Old snapshots on the host. Freeing one takes milliseconds, so the thread does it, once it holds the last reference.
    gone: Vec<(Arc<Snapshot>, Instant)>,
    uploaded: u64,
    prefetched: u64,
    /// True if the thread is running.
    helped: bool,
    ended: bool,
}

impl SnapshotStore {
    /// Creates an empty store.
    pub fn new(gpu: &Arc<Gpu>) -> Self {
        let shared =
            Shared { gpu: gpu.clone(), state: Mutex::default(), changed: Condvar::new(), uploader: Mutex::new(SnapshotUploader::new(gpu)) };
        Self { shared: Arc::new(shared), thread: Mutex::new(None) }
    }

    /// Number of snapshots uploaded so far.
    pub fn uploaded(&self) -> u64 {
        self.shared.state().uploaded
    }

    /// Number of snapshots that were on the device before a window needed them.
    pub fn prefetched(&self) -> u64 {
        self.shared.state().prefetched
    }

    /// Announces a snapshot that a later window will need, after all that are already expected. It is uploaded in the background, after the first
    /// window and if memory allows.
    pub fn expect(&self, snapshot: &Arc<Snapshot>) {
        let mut thread = self.thread.lock().unwrap_or_else(PoisonError::into_inner);
        if thread.is_none() {
            let shared = self.shared.clone();
            let started = std::thread::Builder::new().name("ridgewatch-upload".into()).spawn(move || shared.upload_expected());
            // Without the thread, windows upload their snapshots themselves.
            let Ok(started) = started else { return };
            *thread = Some(started);
        }
        let mut state = self.shared.state();
        state.helped = true;
        state.queue.expect(snapshot);
        self.shared.changed.notify_all();
    }

    /// Returns the window on the device. Uploads its missing snapshots and drops those of earlier windows. Kernels that are launched on the work
    /// stream afterwards run after the upload.
    ///
    /// # Errors
    /// [`DeviceError::WindowTooLarge`] if the window does not fit; other errors of the device.
    pub fn window(&self, window: &Window, storage: Storage) -> Result<DeviceWindow, DeviceError> {
        let result = self.shared.window(window, storage);
        self.shared.changed.notify_all();
        result
    }
}

impl Drop for SnapshotStore {
    fn drop(&mut self) {
        self.shared.state().ended = true;
        self.shared.changed.notify_all();
        let thread = self.thread.get_mut().unwrap_or_else(PoisonError::into_inner).take();
        // The thread ends after the upload in progress.
        let _ = thread.map(JoinHandle::join);
    }
}

impl Shared {
    fn state(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn wait<'a>(&self, state: MutexGuard<'a, State>) -> MutexGuard<'a, State> {
        self.changed.wait(state).unwrap_or_else(PoisonError::into_inner)
    }

    fn wait_at_most<'a>(&self, state: MutexGuard<'a, State>, time: Duration) -> MutexGuard<'a, State> {
        self.changed.wait_timeout(state, time).unwrap_or_else(PoisonError::into_inner).0
    }

    fn upload(&self, snapshot: &Arc<Snapshot>, storage: Storage, scale: f32) -> Result<Arc<DeviceSnapshot>, DeviceError> {
        let mut uploader = self.uploader.lock().unwrap_or_else(PoisonError::into_inner);
        uploader.upload(snapshot, storage, scale).map(Arc::new)
    }

    fn window(&self, window: &Window, storage: Storage) -> Result<DeviceWindow, DeviceError> {
        let wanted: Vec<&Arc<Snapshot>> = window.snapshots().collect();
        let mut state = self.state();
        while wanted.iter().any(|s| state.queue.is_uploading(s)) {
            state = self.wait(state);
        }
        if state.form.is_some_and(|(held, _)| held != storage) {
            state.held.clear();
            state.queue.release();
            state.form = None;
        }
        let taken = state.queue.take(&wanted);
        state.prefetched += taken.len() as u64;
        state.held.extend(taken);
        let (held, gone) = std::mem::take(&mut state.held).into_iter().partition(|s| wanted.iter().any(|w| Arc::ptr_eq(w, &s.host)));
        state.held = held;
        let mut gone: Vec<Arc<DeviceSnapshot>> = gone;
        if storage == Storage::F16Pairs {
            // A snapshot whose changes lead to another successor is uploaded again.
            let leads_here = |s: &Arc<DeviceSnapshot>| {
                let after = wanted.iter().skip_while(|w| !Arc::ptr_eq(w, &s.host)).nth(1);
                s.next.get().zip(after).is_none_or(|(next, after)| std::ptr::eq(next.as_ptr(), Arc::as_ptr(after)))
            };
            let (held, elsewhere): (Vec<_>, Vec<_>) = std::mem::take(&mut state.held).into_iter().partition(leads_here);
            state.held = held;
            gone.extend(elsewhere);
        }
        if state.helped {
            state.gone.extend(gone.iter().map(|s| (s.host.clone(), Instant::now())));
        }
        drop(gone);
        let fresh = |state: &State| -> Vec<Arc<Snapshot>> {
            wanted.iter().filter(|w| !state.held.iter().any(|s| Arc::ptr_eq(w, &s.host))).map(|w| Arc::clone(w)).collect()
        };
        let mut missing = fresh(&state);
        let mut scale = state.held.first().map_or(1.0, |s| s.scale);
        if storage != Storage::F32 {
            let peak = missing.iter().map(|s| peak(s)).fold(0.0, f32::max);
            if state.held.is_empty() || peak / scale > HALF_MAX {
                // The scale is a power of two, so that it changes the range but not the rounding.
                state.held.clear();
                state.queue.release();
                missing = fresh(&state);
                let peak = missing.iter().map(|s| self::peak(s)).fold(f32::MIN_POSITIVE, f32::max);
                scale = (peak / HALF_PEAK).log2().ceil().clamp(-100.0, 100.0).exp2();
            }
        }
        let needed = |bytes: u64| missing.iter().map(|s| s.nodes.len() as u64 * bytes).sum::<u64>();
        if needed(storage.bytes()) > self.gpu.memory_left() {
            // Prefetched snapshots make room for those needed now.
            state.queue.release();
        }
        let left = self.gpu.memory_left();
        if needed(storage.bytes()) > left {
            return Err(DeviceError::WindowTooLarge {
                snapshots: wanted.len(),
                missing: missing.len(),
                nodes: window.grid().map_or([0; 3], |grid| grid.shape()),
                storage: storage.name(),
                needed: needed(storage.bytes()),
                needed_f16: wanted.iter().map(|s| s.nodes.len() as u64).sum::<u64>() * Storage::F16.bytes(),
                left,
            });
        }
        // All later uploads have this form, even if this window fails.
        state.form = Some((storage, scale));
        missing.iter().for_each(|snapshot| state.queue.need(snapshot));
        while let Some(snapshot) = state.queue.next_needed() {
            let uploaded = self.upload(&snapshot, storage, scale);
            state.queue.end(&snapshot, None);
            state.uploaded += 1;
            state.held.push(uploaded?);
        }
        let doing = driver_error("ordering the transfer of snapshots");
        let mut snapshots = Vec::with_capacity(wanted.len());
        for snapshot in wanted {
            let Some(there) = state.held.iter().find(|s| Arc::ptr_eq(snapshot, &s.host)) else { continue };
            self.gpu.work().wait(&there.ready).map_err(&doing)?;
            snapshots.push(there.clone());
        }
        if storage == Storage::F16Pairs {
            self.pair(&snapshots, storage)?;
        }
        Ok(DeviceWindow { snapshots })
    }

    /// Writes the changes to the next snapshot, on the work stream, for snapshots that have none yet. Only tracers of windows that extend beyond a
    /// snapshot read its changes, so tracers of earlier windows are not affected.
    fn pair(&self, snapshots: &[Arc<DeviceSnapshot>], storage: Storage) -> Result<(), DeviceError> {
        for (this, next) in snapshots.iter().zip(snapshots.iter().skip(1)) {
            if this.next.get().is_some() {
                continue;
            }
            let kernel = self.gpu.kernel("window.cu", &[storage_define(storage)], "pair_nodes")?;
            let count = this.host.nodes.len();
            let (nodes, after, n) = (this.nodes.address(), next.nodes.address(), count as u64);
            // SAFETY: both hold `n` nodes in pairs, and the stream has waited for their uploads. The changes are read only after this launch.
            unsafe { launch(self.gpu.work().launch_builder(&kernel).arg(&nodes).arg(&after).arg(&n), threads(count, 256))? };
            // Only set here, under the lock, so it is still unset.
            let _ = this.next.set(Arc::downgrade(&next.host));
        }
        Ok(())
    }

    /// Body of the thread: uploads expected snapshots and frees the host memory of old ones.
    fn upload_expected(&self) {
        let copiers = (rayon::current_num_threads() / 4).clamp(1, MAX_COPY_THREADS);
        let pool = rayon::ThreadPoolBuilder::new().num_threads(copiers).thread_name(|i| format!("ridgewatch-copy-{i}")).build();
        let mut state = self.state();
        let Ok(pool) = pool else {
            state.helped = false;
            return;
        };
        while !state.ended {
            let over = |(snapshot, since): &(Arc<Snapshot>, Instant)| Arc::strong_count(snapshot) == 1 || since.elapsed() >= RETRY_LIMIT;
            let (gone, held): (Vec<_>, Vec<_>) = std::mem::take(&mut state.gone).into_iter().partition(over);
            state.gone = held;
            let next = state.form.and_then(|form| {
                let fits = |s: &Snapshot| s.nodes.len() as u64 * form.0.bytes() <= self.gpu.memory_left() / PREFETCH_SHARE;
                state.queue.next_early(MAX_PREFETCHED, fits).map(|snapshot| (snapshot, form))
            });
            if gone.is_empty() && next.is_none() {
                state = if state.gone.is_empty() { self.wait(state) } else { self.wait_at_most(state, RETRY) };
                continue;
            }
            drop(state);
            gone.into_iter().filter_map(|(snapshot, _)| Arc::into_inner(snapshot)).for_each(give_back);
            let bring = |(snapshot, form): &(Arc<Snapshot>, _)| pool.install(|| self.upload_early(snapshot, *form));
            // After a panic, a window must not wait forever for this upload.
            let there = next.as_ref().and_then(|next| catch_unwind(AssertUnwindSafe(|| bring(next))).ok().flatten());
            state = self.state();
            if let Some((snapshot, form)) = next {
                // A window may have been encoded again in the meantime.
                let there = there.filter(|_| state.form == Some(form));
                state.uploaded += u64::from(there.is_some());
                state.queue.end(&snapshot, there);
                self.changed.notify_all();
            }
        }
    }

    /// Uploads one expected snapshot; `None` if it cannot be uploaded now. The window that needs it then uploads it, and reports the error.
    fn upload_early(&self, snapshot: &Arc<Snapshot>, (storage, scale): (Storage, f32)) -> Option<Arc<DeviceSnapshot>> {
        if storage != Storage::F32 && peak(snapshot) / scale > HALF_MAX {
            return None;
        }
        // The error is reported when the window uploads the snapshot itself.
        self.upload(snapshot, storage, scale).ok()
    }
}

/// Frees the host memory of a snapshot. This takes about 20 ms of system time. `munmap` would block every other thread that maps or unmaps memory
/// during that time. `madvise(MADV_DONTNEED)` frees the pages first; recent Linux kernels lock only this mapping for it.
fn give_back(snapshot: Snapshot) {
    let mut nodes = snapshot.nodes;
    #[cfg(target_os = "linux")]
    {
        const PAGE: usize = 1 << 16; // a multiple of every page size in use
        let bytes = nodes.as_mut_ptr().cast::<u8>();
        let ahead = bytes.align_offset(PAGE);
        let whole = (nodes.capacity() * size_of::<[f32; 4]>()).saturating_sub(ahead) / PAGE * PAGE;
        if whole > 0 {
            // SAFETY: whole pages inside the vector's allocation. They read as zeros afterwards and are not read again. The result of the call does
            // not matter, since dropping the vector frees the memory in any case.
            unsafe { libc::madvise(bytes.add(ahead).cast(), whole, libc::MADV_DONTNEED) };
        }
    }
    drop(nodes);
}

/// Returns the largest absolute velocity component.
fn peak(snapshot: &Snapshot) -> f32 {
    // Missing nodes are NaN, which `f32::max` ignores.
    let node = |n: &[f32; 4]| n[0].abs().max(n[1].abs()).max(n[2].abs()).max(n[3].abs());
    snapshot.nodes.par_iter().with_min_len(1 << 14).map(node).reduce(|| 0.0, f32::max)
}
