//! What comes back from the device while kernels run: through page-locked pieces, on a stream of its own.

use crate::backend::cuda::driver::pinned::Pinned;
use crate::backend::cuda::{Buffer, DeviceError, Gpu};
use cudarc::driver::CudaStream;
use std::sync::{Arc, Mutex, PoisonError};

/// Values of a page-locked piece: 4 MiB.
const PIECE: usize = 1 << 20;

/// The way back, for one reader at a time.
pub(in crate::backend::cuda) struct AsyncReadback {
    stream: Arc<CudaStream>,
    /// Two that take turns; taken when they are first needed.
    pieces: Mutex<Option<[Pinned<f32>; 2]>>,
}

impl AsyncReadback {
    pub(in crate::backend::cuda) fn new(stream: Arc<CudaStream>) -> Self {
        Self { stream, pieces: Mutex::new(None) }
    }
}

impl Gpu {
    /// Values at the front of a buffer as they are after the work so far, while later work goes on. Nobody may change them before this returns.
    ///
    /// # Errors
    /// What the device says.
    pub(in crate::backend::cuda) fn read_behind(&self, from: &Buffer<f32>, len: usize) -> Result<Vec<f32>, DeviceError> {
        assert!(len <= from.len(), "the buffer holds as many");
        let mut pieces = self.behind().pieces.lock().unwrap_or_else(PoisonError::into_inner);
        let pieces = match &mut *pieces {
            Some(pieces) => pieces,
            none => none.insert([Pinned::new(self, PIECE)?, Pinned::new(self, PIECE)?]),
        };
        let read = self.read_in(pieces, from, len);
        if read.is_err() {
            // Neither buffer nor pieces may go under a copy in progress. What it says adds nothing to the error.
            let _ = self.behind().stream.synchronize();
        }
        read
    }

    fn read_in(&self, pieces: &mut [Pinned<f32>; 2], from: &Buffer<f32>, len: usize) -> Result<Vec<f32>, DeviceError> {
        let doing = DeviceError::driver("bringing values back");
        let stream = &self.behind().stream;
        stream.wait(&self.mark()?).map_err(&doing)?;
        let mut values = vec![0.0; len];
        let mut coming = None;
        // While a piece is put in its place, the next one is on its way.
        for turn in 0..=len.div_ceil(PIECE) {
            let at = turn * PIECE;
            let sent = if at < len {
                let count = PIECE.min(len - at);
                // SAFETY: the buffer holds as many from `at` on, and this piece's last copy was waited for two turns ago.
                unsafe { pieces[turn % 2].copy_on(stream, from.address_of(at), count) }?;
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
