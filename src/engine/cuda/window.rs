//! Snapshots on the device: each comes over once, from page-locked memory on the transfer stream, while kernels run on the work stream.
//! A window that slides keeps what it still needs; a snapshot's memory is free again once no tracer uses it.

use super::grid::Nodes;
use super::{Buffer, DeviceError, Gpu, Storage, launch, threads};
use crate::field::{Snapshot, Window};
use cudarc::driver::{CudaEvent, CudaFunction, PinnedHostSlice, PushKernelArg};
use rayon::prelude::*;
use std::sync::{Arc, Mutex, PoisonError};

impl Storage {
    /// Bytes of a node.
    pub fn bytes(self) -> u64 {
        match self {
            Self::F32 => 16,
            Self::F16 => 8,
        }
    }
    /// As written in settings.
    pub fn name(self) -> &'static str {
        match self {
            Self::F32 => "f32",
            Self::F16 => "f16",
        }
    }
}

/// Nodes of a page-locked piece: 8 MiB.
const PIECE: usize = 1 << 19;
/// Half-precision velocities of the first window are scaled to below this, which leaves later ones room to grow sixteenfold.
const HALF_PEAK: f32 = 4096.0;
/// Largest half-precision number that is used; beyond it the window is encoded anew.
const HALF_MOST: f32 = 60_000.0;

/// One snapshot on the device.
#[derive(Debug)]
pub struct DeviceSnapshot {
    /// Holding it keeps its address from being given to another one.
    host: Arc<Snapshot>,
    /// `f32`: 4 words a node, `f16`: 2.
    nodes: Buffer<u32>,
    storage: Storage,
    scale: f32,
    /// Whether some node is missing.
    missing: bool,
    ready: CudaEvent,
}

/// The snapshots of one window, oldest first.
#[derive(Debug, Clone)]
pub struct DeviceWindow {
    snapshots: Vec<Arc<DeviceSnapshot>>,
}

impl DeviceWindow {
    /// What kernels need to know of it.
    pub(super) fn nodes(&self) -> Nodes {
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
    gpu: Arc<Gpu>,
    state: Mutex<State>,
}

#[derive(Debug, Default)]
struct State {
    held: Vec<Arc<DeviceSnapshot>>,
    pieces: Option<Pieces>,
    to_half: Option<CudaFunction>,
    brought: u64,
}

/// Two page-locked pieces that take turns, and for half precision their images on the device.
#[derive(Debug)]
struct Pieces {
    pinned: [PinnedHostSlice<u32>; 2],
    /// When the transfer out of each was done.
    free: [Option<CudaEvent>; 2],
    images: Option<[Buffer<u32>; 2]>,
}

impl SnapshotStore {
    /// Nothing there yet.
    pub fn new(gpu: &Arc<Gpu>) -> Self {
        Self { gpu: gpu.clone(), state: Mutex::default() }
    }

    /// Snapshots brought over so far.
    pub fn brought(&self) -> u64 {
        self.state.lock().unwrap_or_else(PoisonError::into_inner).brought
    }

    /// The window on the device. Brings over what is not there yet and forgets what the window no longer holds. Kernels launched on the
    /// work stream afterwards see it.
    ///
    /// # Errors
    /// [`DeviceError::WindowTooLarge`] with the numbers and the ways out.
    pub fn window(&self, window: &Window, storage: Storage) -> Result<DeviceWindow, DeviceError> {
        let mut state = self.state.lock().unwrap_or_else(PoisonError::into_inner);
        let wanted: Vec<&Arc<Snapshot>> = window.snapshots().collect();
        state.held.retain(|s| s.storage == storage && wanted.iter().any(|w| Arc::ptr_eq(w, &s.host)));
        let fresh = |state: &State| -> Vec<Arc<Snapshot>> {
            wanted.iter().filter(|w| !state.held.iter().any(|s| Arc::ptr_eq(w, &s.host))).map(|w| Arc::clone(w)).collect()
        };
        let mut missing = fresh(&state);
        let mut scale = state.held.first().map_or(1.0, |s| s.scale);
        if storage == Storage::F16 {
            let peak = missing.iter().map(|s| peak(s)).fold(0.0, f32::max);
            if state.held.is_empty() || peak / scale > HALF_MOST {
                // A power of two, so that nothing but range is changed.
                state.held.clear();
                missing = fresh(&state);
                let peak = missing.iter().map(|s| self::peak(s)).fold(f32::MIN_POSITIVE, f32::max);
                scale = (peak / HALF_PEAK).log2().ceil().clamp(-100.0, 100.0).exp2();
            }
        }
        let needed = |bytes: u64| missing.iter().map(|s| s.nodes.len() as u64 * bytes).sum::<u64>();
        let left = self.gpu.memory_left();
        if needed(storage.bytes()) > left {
            return Err(DeviceError::WindowTooLarge {
                snapshots: missing.len(),
                nodes: window.grid().map_or([0; 3], |grid| grid.shape()),
                storage: storage.name(),
                needed: needed(storage.bytes()),
                needed_f16: needed(Storage::F16.bytes()),
                left,
            });
        }
        for snapshot in &missing {
            let there = self.bring(&mut state, snapshot, storage, scale)?;
            state.held.push(Arc::new(there));
        }
        let doing = DeviceError::driver("ordering the transfer of snapshots");
        let mut snapshots = Vec::with_capacity(wanted.len());
        for snapshot in wanted {
            let Some(there) = state.held.iter().find(|s| Arc::ptr_eq(snapshot, &s.host)) else { continue };
            self.gpu.work().wait(&there.ready).map_err(&doing)?;
            snapshots.push(there.clone());
        }
        Ok(DeviceWindow { snapshots })
    }

    fn bring(&self, state: &mut State, snapshot: &Arc<Snapshot>, storage: Storage, scale: f32) -> Result<DeviceSnapshot, DeviceError> {
        let gpu = &self.gpu;
        let doing = DeviceError::driver("bringing a snapshot over");
        let words = (storage.bytes() / 4) as usize;
        let mut nodes = Buffer::<u32>::new(gpu.transfer(), gpu.budget(), "a snapshot", snapshot.nodes.len() * words)?.read_by(gpu.work());
        if state.pieces.is_none() {
            // SAFETY: pieces are written before they are read.
            let pinned = || unsafe { gpu.context().alloc_pinned::<u32>(4 * PIECE) }.map_err(&doing);
            state.pieces = Some(Pieces { pinned: [pinned()?, pinned()?], free: [None, None], images: None });
        }
        if storage == Storage::F16 && state.to_half.is_none() {
            state.to_half = Some(gpu.kernel("window.cu", &[], "to_half_nodes")?);
        }
        let State { pieces: Some(pieces), to_half, brought, .. } = state else {
            return Err(DeviceError::Unsupported { what: "a transfer without page-locked memory".into() });
        };
        if storage == Storage::F16 && pieces.images.is_none() {
            let image = || Buffer::<u32>::new(gpu.transfer(), gpu.budget(), "half-precision encoding", 4 * PIECE);
            pieces.images = Some([image()?, image()?]);
        }
        for (turn, part) in snapshot.nodes.chunks(PIECE).enumerate() {
            let side = turn % 2;
            if let Some(event) = &pieces.free[side] {
                event.synchronize().map_err(&doing)?;
            }
            let piece = &mut pieces.pinned[side].as_mut_slice().map_err(&doing)?[..4 * part.len()];
            piece.par_chunks_mut(1 << 16).zip(part.par_chunks(1 << 14)).for_each(|(to, from)| {
                for (to, from) in to.chunks_exact_mut(4).zip(from) {
                    for (to, from) in to.iter_mut().zip(from) {
                        *to = from.to_bits();
                    }
                }
            });
            let piece = &*piece;
            let at = turn * PIECE * words;
            match (&mut pieces.images, &*to_half) {
                (Some(images), Some(kernel)) if storage == Storage::F16 => {
                    let (from, to) = (images[side].address(), nodes.address_of(at));
                    let (count, inverse) = (part.len() as u64, 1.0 / scale);
                    // SAFETY: the piece is not written before its event; the image holds a piece, and `nodes` the part from `at` on.
                    unsafe {
                        images[side].write_behind(0, piece)?;
                        let mut call = gpu.transfer().launch_builder(kernel);
                        launch(call.arg(&from).arg(&count).arg(&inverse).arg(&to), threads(part.len(), 256))?;
                    }
                }
                // SAFETY: the piece is not written before its event.
                _ => unsafe { nodes.write_behind(at, piece)? },
            }
            pieces.free[side] = Some(gpu.transfer().record_event(None).map_err(&doing)?);
        }
        *brought += 1;
        let ready = gpu.transfer().record_event(None).map_err(&doing)?;
        let missing = snapshot.nodes.par_iter().with_min_len(1 << 14).any(|node| node[3].is_nan());
        Ok(DeviceSnapshot {
            host: snapshot.clone(),
            nodes,
            storage,
            scale: if storage == Storage::F16 { scale } else { 1.0 },
            missing,
            ready,
        })
    }
}

/// Largest velocity component.
fn peak(snapshot: &Snapshot) -> f32 {
    let node = |n: &[f32; 4]| n[0].abs().max(n[1].abs()).max(n[2].abs());
    snapshot.nodes.par_iter().with_min_len(1 << 14).map(node).reduce(|| 0.0, f32::max)
}
