//! One snapshot from host to device: through page-locked pieces on the transfer stream, while kernels run on the work stream.

use crate::backend::cuda::window::grid::storage_define;
use crate::backend::cuda::window::store::DeviceSnapshot;
use crate::backend::cuda::{Buffer, DeviceError, Gpu, Storage, launch, threads};
use crate::field::Snapshot;
use cudarc::driver::{CudaEvent, CudaFunction, PinnedHostSlice, PushKernelArg};
use rayon::prelude::*;
use std::sync::{Arc, OnceLock};

/// Nodes of a page-locked piece: 8 MiB.
const PIECE: usize = 1 << 19;

/// Brings snapshots over, one after the other.
#[derive(Debug)]
pub(in crate::backend::cuda) struct SnapshotUploader {
    gpu: Arc<Gpu>,
    pieces: Option<Pieces>,
    encode: Option<(Storage, CudaFunction)>,
}

/// Two page-locked pieces that take turns, and for other storage than f32 their images on the device.
#[derive(Debug)]
struct Pieces {
    pinned: [PinnedHostSlice<u32>; 2],
    /// When the transfer out of each was done.
    free: [Option<CudaEvent>; 2],
    images: Option<[Buffer<u32>; 2]>,
}

impl SnapshotUploader {
    /// Memory is taken when it is first needed.
    pub(in crate::backend::cuda) fn new(gpu: &Arc<Gpu>) -> Self {
        Self { gpu: gpu.clone(), pieces: None, encode: None }
    }

    /// Enqueues the whole snapshot; [`DeviceSnapshot::ready`] tells when it is there. Velocities are divided by `scale`.
    pub(in crate::backend::cuda) fn upload(
        &mut self,
        snapshot: &Arc<Snapshot>,
        storage: Storage,
        scale: f32,
    ) -> Result<DeviceSnapshot, DeviceError> {
        let gpu = self.gpu.clone();
        let doing = DeviceError::driver("bringing a snapshot over");
        let words = (storage.bytes() / 4) as usize;
        let mut nodes = Buffer::<u32>::new(gpu.transfer(), gpu.budget(), "a snapshot", snapshot.nodes.len() * words)?.read_by(gpu.work());
        if self.pieces.is_none() {
            // SAFETY: pieces are written before they are read.
            let pinned = || unsafe { gpu.context().alloc_pinned::<u32>(4 * PIECE) }.map_err(&doing);
            self.pieces = Some(Pieces { pinned: [pinned()?, pinned()?], free: [None, None], images: None });
        }
        let encoded = storage != Storage::F32;
        if encoded && self.encode.as_ref().is_none_or(|(held, _)| *held != storage) {
            self.encode = Some((storage, gpu.kernel("window.cu", &[storage_define(storage)], "encode_nodes")?));
        }
        let Self { pieces: Some(pieces), encode, .. } = self else {
            return Err(DeviceError::Unsupported { what: "a transfer without page-locked memory".into() });
        };
        if encoded && pieces.images.is_none() {
            let image = || Buffer::<u32>::new(gpu.transfer(), gpu.budget(), "the encoding of snapshots", 4 * PIECE);
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
            match (&mut pieces.images, &*encode) {
                (Some(images), Some((_, kernel))) if encoded => {
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
        let ready = gpu.transfer().record_event(None).map_err(&doing)?;
        Ok(DeviceSnapshot {
            host: snapshot.clone(),
            nodes,
            storage,
            scale,
            missing: snapshot.missing_nodes() > 0,
            next: OnceLock::new(),
            ready,
        })
    }
}
