//! Upload of a snapshot through pinned memory, on the transfer stream, while kernels run on the work stream.
//!
//! Two pinned buffers alternate (double buffering): the CPU fills one while the device copies the other. For half-precision storage, a kernel on the
//! same stream encodes each piece.

use crate::cuda::driver_error;
use crate::cuda::window::grid::storage_define;
use crate::cuda::window::snapshot::DeviceSnapshot;
use crate::cuda::{Buffer, DeviceError, Gpu, Storage, launch, threads};
use cudarc::driver::{CudaEvent, CudaFunction, PinnedHostSlice, PushKernelArg};
use rayon::prelude::*;
use ridgewatch_field::Snapshot;
use std::sync::{Arc, OnceLock};

/// Nodes of a pinned buffer: 8 MiB.
const PIECE: usize = 1 << 19;

/// Uploads snapshots one after the other.
#[derive(Debug)]
pub(in crate::cuda) struct SnapshotUploader {
    gpu: Arc<Gpu>,
    pieces: Option<Pieces>,
    encode: Option<(Storage, CudaFunction)>,
}

/// Two alternating pinned buffers and, for half-precision storage, their unencoded copies on the device.
#[derive(Debug)]
struct Pieces {
    pinned: [PinnedHostSlice<u32>; 2],
    /// End of the last copy from each buffer.
    free: [Option<CudaEvent>; 2],
    images: Option<[Buffer<u32>; 2]>,
}

impl SnapshotUploader {
    /// Creates an uploader. It allocates its memory at the first upload.
    pub(in crate::cuda) fn new(gpu: &Arc<Gpu>) -> Self {
        Self { gpu: gpu.clone(), pieces: None, encode: None }
    }

    /// Enqueues the upload of a snapshot, which ends at the event [`DeviceSnapshot::ready`]. Half-precision velocities are divided by `scale`.
    ///
    /// # Errors
    /// The device fails or lacks memory.
    pub(in crate::cuda) fn upload(
        &mut self,
        snapshot: &Arc<Snapshot>,
        storage: Storage,
        scale: f32,
    ) -> Result<DeviceSnapshot, DeviceError> {
        let gpu = self.gpu.clone();
        let doing = driver_error("uploading a snapshot");
        let words = (storage.bytes() / 4) as usize;
        let mut nodes = Buffer::<u32>::new(gpu.transfer(), gpu.budget(), "a snapshot", snapshot.nodes.len() * words)?.read_by(gpu.work());
        if self.pieces.is_none() {
            // SAFETY: the buffers are written before they are read.
            let pinned = || unsafe { gpu.context().alloc_pinned::<u32>(4 * PIECE) }.map_err(&doing);
            self.pieces = Some(Pieces { pinned: [pinned()?, pinned()?], free: [None, None], images: None });
        }
        let encoded = storage != Storage::F32;
        if encoded && self.encode.as_ref().is_none_or(|(held, _)| *held != storage) {
            self.encode = Some((storage, gpu.kernel("window.cu", &[storage_define(storage)], "encode_nodes")?));
        }
        let Self { pieces: Some(pieces), encode, .. } = self else {
            return Err(DeviceError::Unsupported { what: "a transfer without pinned memory".into() });
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
                    // SAFETY: the pinned buffer is not written before its event; the device copy holds one piece, and `nodes` the part from `at` on.
                    unsafe {
                        images[side].write_behind(0, piece)?;
                        let mut call = gpu.transfer().launch_builder(kernel);
                        launch(call.arg(&from).arg(&count).arg(&inverse).arg(&to), threads(part.len(), 256))?;
                    }
                }
                // SAFETY: the pinned buffer is not written before its event.
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
