//! Snapshots on the device. Every snapshot is uploaded once, through one queue: a thread uploads what later windows will need, while the frames of the
//! present slide are made, and a window uploads what is still missing. A window that slides keeps what it still needs; a snapshot's memory is free again
//! once no tracer uses it.

use crate::backend::cuda::window::grid::{Nodes, storage_define};
use crate::backend::cuda::window::prefetch::PrefetchQueue;
use crate::backend::cuda::window::uploader::SnapshotUploader;
use crate::backend::cuda::{Buffer, DeviceError, Gpu, Storage, launch, threads};
use crate::field::{Snapshot, Window};
use cudarc::driver::{CudaEvent, PushKernelArg};
use rayon::prelude::*;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, OnceLock, PoisonError, Weak};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

/// Half-precision velocities of the first window are scaled to below this, which leaves later ones room to grow sevenfold.
const HALF_PEAK: f32 = 4096.0;
/// Largest half-precision velocity that is used, so that changes fit too; beyond it the window is encoded anew.
const HALF_MAX: f32 = 30_000.0;
/// Snapshots that come over before a window wants them, at most.
const MAX_PREFETCHED: usize = 2;
/// And only where they take at most one part in so many of the memory that is left: others' work must not fail for it.
const PREFETCH_SHARE: u64 = 4;
/// How often memory that others still hold is asked for again, and how long at most: beyond it they give it back, or use it again.
const RETRY: Duration = Duration::from_millis(20);
const RETRY_LIMIT: Duration = Duration::from_millis(100);
/// Threads that copy expected snapshots to page-locked memory, at most: as many as keep the bus busy.
const MAX_COPY_THREADS: usize = 4;

/// One snapshot on the device.
#[derive(Debug)]
pub struct DeviceSnapshot {
    /// Holding it keeps its address from being given to another one.
    pub(in crate::backend::cuda) host: Arc<Snapshot>,
    /// [`Storage::bytes`] a node.
    pub(in crate::backend::cuda) nodes: Buffer<u32>,
    pub(in crate::backend::cuda) storage: Storage,
    pub(in crate::backend::cuda) scale: f32,
    /// Whether some node is missing.
    pub(in crate::backend::cuda) missing: bool,
    /// When it is there.
    pub(in crate::backend::cuda) ready: CudaEvent,
    /// The one that its pairs lead to, once: earlier windows go on reading them.
    pub(in crate::backend::cuda) next: OnceLock<Weak<Snapshot>>,
}

/// The snapshots of one window, oldest first.
#[derive(Debug, Clone)]
pub struct DeviceWindow {
    snapshots: Vec<Arc<DeviceSnapshot>>,
}

impl DeviceWindow {
    /// What kernels need to know of it.
    pub(in crate::backend::cuda) fn nodes(&self) -> Nodes {
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

/// Brings snapshots over and remembers those that are there.
#[derive(Debug)]
pub struct SnapshotStore {
    shared: Arc<Shared>,
    /// Brings expected ones; started with the first.
    thread: Mutex<Option<JoinHandle<()>>>,
}

#[derive(Debug)]
struct Shared {
    gpu: Arc<Gpu>,
    state: Mutex<State>,
    /// Told of every change that somebody may wait for.
    changed: Condvar,
    /// Locked behind `state`, never before it.
    uploader: Mutex<SnapshotUploader>,
}

#[derive(Debug, Default)]
struct State {
    /// Those of the latest window.
    held: Vec<Arc<DeviceSnapshot>>,
    queue: PrefetchQueue<DeviceSnapshot>,
    /// How the latest window is held: storage and scale. None before the first.
    form: Option<(Storage, f32)>,
    /// Host memory that no window needs: giving it back takes milliseconds, which are the thread's as soon as nobody else holds it.
    gone: Vec<(Arc<Snapshot>, Instant)>,
    uploaded: u64,
    prefetched: u64,
    /// Whether the thread is there.
    helped: bool,
    ended: bool,
}

impl SnapshotStore {
    /// Nothing there yet.
    pub fn new(gpu: &Arc<Gpu>) -> Self {
        let shared =
            Shared { gpu: gpu.clone(), state: Mutex::default(), changed: Condvar::new(), uploader: Mutex::new(SnapshotUploader::new(gpu)) };
        Self { shared: Arc::new(shared), thread: Mutex::new(None) }
    }

    /// Snapshots uploaded over so far.
    pub fn uploaded(&self) -> u64 {
        self.shared.state().uploaded
    }

    /// Of them, those that were there before a window wanted them.
    pub fn prefetched(&self) -> u64 {
        self.shared.state().prefetched
    }

    /// A snapshot that windows will want, after those expected before: it comes over beside other work, once there is a window and where
    /// memory allows.
    pub fn expect(&self, snapshot: &Arc<Snapshot>) {
        let mut thread = self.thread.lock().unwrap_or_else(PoisonError::into_inner);
        if thread.is_none() {
            let shared = self.shared.clone();
            let started = std::thread::Builder::new().name("ridgewatch-upload".into()).spawn(move || shared.upload_expected());
            // Without the thread, windows bring their snapshots themselves.
            let Ok(started) = started else { return };
            *thread = Some(started);
        }
        let mut state = self.shared.state();
        state.helped = true;
        state.queue.expect(snapshot);
        self.shared.changed.notify_all();
    }

    /// The window on the device. Brings over what is not there yet and forgets what the window no longer holds. Kernels launched on the
    /// work stream afterwards see it.
    ///
    /// # Errors
    /// [`DeviceError::WindowTooLarge`] with the numbers and the ways out.
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
        // It ends after the snapshot in its hands.
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
            // One that leads elsewhere comes over again.
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
                // A power of two, so that nothing but range is changed.
                state.held.clear();
                state.queue.release();
                missing = fresh(&state);
                let peak = missing.iter().map(|s| self::peak(s)).fold(f32::MIN_POSITIVE, f32::max);
                scale = (peak / HALF_PEAK).log2().ceil().clamp(-100.0, 100.0).exp2();
            }
        }
        let needed = |bytes: u64| missing.iter().map(|s| s.nodes.len() as u64 * bytes).sum::<u64>();
        if needed(storage.bytes()) > self.gpu.memory_left() {
            // What is here early makes room for what is wanted now.
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
        // What is uploaded from here on has this form, even if the window fails.
        state.form = Some((storage, scale));
        missing.iter().for_each(|snapshot| state.queue.need(snapshot));
        while let Some(snapshot) = state.queue.next_needed() {
            let uploaded = self.upload(&snapshot, storage, scale);
            state.queue.end(&snapshot, None);
            state.uploaded += 1;
            state.held.push(uploaded?);
        }
        let doing = DeviceError::driver("ordering the transfer of snapshots");
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

    /// Writes changes behind the nodes of those that have none yet, on the work stream. Only tracers of windows that go on past a snapshot
    /// read its changes, so that those of earlier windows, queued or to come, are not disturbed.
    fn pair(&self, snapshots: &[Arc<DeviceSnapshot>], storage: Storage) -> Result<(), DeviceError> {
        for (this, next) in snapshots.iter().zip(snapshots.iter().skip(1)) {
            if this.next.get().is_some() {
                continue;
            }
            let kernel = self.gpu.kernel("window.cu", &[storage_define(storage)], "pair_nodes")?;
            let count = this.host.nodes.len();
            let (nodes, after, n) = (this.nodes.address(), next.nodes.address(), count as u64);
            // SAFETY: both hold as many nodes, in pairs, and were waited for; this one's changes are read behind this launch alone.
            unsafe { launch(self.gpu.work().launch_builder(&kernel).arg(&nodes).arg(&after).arg(&n), threads(count, 256))? };
            // Told apart by the snapshot that it is; nobody else sets it, under the lock.
            let _ = this.next.set(Arc::downgrade(&next.host));
        }
        Ok(())
    }

    /// The thread: brings what is expected, and gives back the memory of what is gone.
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
            // A panic must not leave a window waiting for what will never come.
            let there = next.as_ref().and_then(|next| catch_unwind(AssertUnwindSafe(|| bring(next))).ok().flatten());
            state = self.state();
            if let Some((snapshot, form)) = next {
                // A window may have been encoded anew meanwhile.
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
        // A failure shows again when the window brings the snapshot itself.
        self.upload(snapshot, storage, scale).ok()
    }
}

/// Gives a snapshot's memory on the host back. The system is busy with that for some twenty milliseconds, and were it told by unmapping alone,
/// every thread that maps or unmaps memory meanwhile (the film of the frame before, say) would have to wait. So the pages go first, which a
/// recent Linux does under a lock of this mapping's own.
fn give_back(snapshot: Snapshot) {
    let mut nodes = snapshot.nodes;
    #[cfg(target_os = "linux")]
    {
        const PAGE: usize = 1 << 16; // a multiple of every page size in use
        let bytes = nodes.as_mut_ptr().cast::<u8>();
        let ahead = bytes.align_offset(PAGE);
        let whole = (nodes.capacity() * size_of::<[f32; 4]>()).saturating_sub(ahead) / PAGE * PAGE;
        if whole > 0 {
            // SAFETY: whole pages inside the vector's own allocation, which reads as zeros from here on and is not read again. What the call
            // returns does not matter: the memory goes with the vector in any case.
            unsafe { libc::madvise(bytes.add(ahead).cast(), whole, libc::MADV_DONTNEED) };
        }
    }
    drop(nodes);
}

/// Largest velocity component.
fn peak(snapshot: &Snapshot) -> f32 {
    // The mark of a missing node is no number, and counts for nothing.
    let node = |n: &[f32; 4]| n[0].abs().max(n[1].abs()).max(n[2].abs()).max(n[3].abs());
    snapshot.nodes.par_iter().with_min_len(1 << 14).map(node).reduce(|| 0.0, f32::max)
}
