//! Asynchronous readback: copies device memory to the host on a separate stream, while kernels run on the work stream.
//!
//! Two pinned buffers alternate (double buffering): one receives a piece from the device while the CPU copies the other to its destination.

use crate::cuda::DeviceError;
use crate::cuda::driver::memory::Buffer;
use crate::cuda::driver::pinned::Pinned;
use crate::cuda::driver_error;
use cudarc::driver::CudaStream;
use std::sync::{Arc, Mutex, PoisonError};

/// Values of a pinned buffer: 4 MiB.
const PIECE: usize = 1 << 20;

/// Stream and pinned buffers of the readback. The lock admits one reader at a time.
pub(in crate::cuda) struct AsyncReadback {
    stream: Arc<CudaStream>,
    /// The stream whose results are read.
    work: Arc<CudaStream>,
    /// The two alternating buffers, allocated at the first readback.
    pieces: Mutex<Option<[Pinned<f32>; 2]>>,
}

impl AsyncReadback {
    pub(in crate::cuda) fn new(stream: Arc<CudaStream>, work: Arc<CudaStream>) -> Self {
        Self { stream, work, pieces: Mutex::new(None) }
    }

    /// Returns the first `len` values of a buffer, after the work that is already enqueued. Later work runs concurrently and must not change them
    /// before this returns.
    ///
    /// # Errors
    /// The device fails or lacks pinned memory.
    ///
    /// # Panics
    /// If `len` exceeds the length of the buffer.
    pub(in crate::cuda) fn read(&self, from: &Buffer<f32>, len: usize) -> Result<Vec<f32>, DeviceError> {
        assert!(len <= from.len(), "the buffer holds as many");
        let mut pieces = self.pieces.lock().unwrap_or_else(PoisonError::into_inner);
        let pieces = match &mut *pieces {
            Some(pieces) => pieces,
            none => {
                let context = self.work.context();
                none.insert([Pinned::new(context, PIECE)?, Pinned::new(context, PIECE)?])
            }
        };
        let read = self.read_in(pieces, from, len);
        if read.is_err() {
            // Neither the buffer nor the pinned memory may be freed during a copy in progress. A second error adds no information.
            let _ = self.stream.synchronize();
        }
        read
    }

    fn read_in(&self, pieces: &mut [Pinned<f32>; 2], from: &Buffer<f32>, len: usize) -> Result<Vec<f32>, DeviceError> {
        let doing = driver_error("reading values back");
        let stream = &self.stream;
        stream.join(&self.work).map_err(&doing)?;
        let mut values = vec![0.0; len];
        let mut coming = None;
        // While the CPU copies one piece to its destination, the device sends the next one.
        for turn in 0..=len.div_ceil(PIECE) {
            let at = turn * PIECE;
            let sent = if at < len {
                let count = PIECE.min(len - at);
                // SAFETY: the buffer holds `count` values from `at` on, and the previous copy to this piece was waited for in the previous turn.
                unsafe { pieces[turn % 2].copy_from(stream, from.address_of(at), count) }?;
                Some((at, count, stream.record_event(None).map_err(&doing)?))
            } else {
                None
            };
            if let Some((at, count, there)) = std::mem::replace(&mut coming, sent) {
                there.synchronize().map_err(&doing)?;
                values[at..at + count].copy_from_slice(&pieces[(turn + 1) % 2].values()[..count]);
            }
        }
        Ok(values)
    }
}
