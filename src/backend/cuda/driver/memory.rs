//! Device memory under a cap.

use crate::backend::cuda::DeviceError;
use cudarc::driver::{CudaSlice, CudaStream, DevicePtr, DevicePtrMut, DeviceRepr, result, sys};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

/// What ridgewatch may take of the device's memory, and what it has taken.
#[derive(Debug)]
pub struct Budget {
    cap: u64,
    cap_from: &'static str,
    used: AtomicU64,
    /// Byte that fresh memory is filled with; none: memory comes as it is.
    fill: Option<u8>,
}

impl Budget {
    /// `asked`, but not more than there is; without it nine tenths of what is free, since others (burn's pool, the driver) need some.
    pub fn new(asked: Option<u64>, free: u64, total: u64) -> Self {
        let (cap, cap_from) = match asked {
            Some(cap) if cap <= total => (cap, "the memory cap"),
            Some(_) => (total, "the device's memory"),
            None => (free / 10 * 9, "nine tenths of what was free at start"),
        };
        Self { cap, cap_from, used: AtomicU64::new(0), fill: None }
    }

    /// The same with fresh memory filled with a byte.
    pub fn filling(self, fill: Option<u8>) -> Self {
        Self { fill, ..self }
    }

    /// Bytes that may be taken.
    pub fn cap(&self) -> u64 {
        self.cap
    }

    /// Bytes taken.
    pub fn used(&self) -> u64 {
        self.used.load(Ordering::Relaxed)
    }

    fn take(&self, what: &str, needed: u64) -> Result<(), DeviceError> {
        let add = |used: u64| used.checked_add(needed).filter(|sum| *sum <= self.cap);
        let taken = self.used.fetch_update(Ordering::Relaxed, Ordering::Relaxed, add);
        taken.map(|_| ()).map_err(|used| self.refusal(what, needed, used, self.cap_from))
    }

    fn refusal(&self, what: &str, needed: u64, used: u64, cap_from: &'static str) -> DeviceError {
        DeviceError::OutOfMemory { what: what.to_owned(), needed, used, cap: self.cap, cap_from }
    }

    fn give_back(&self, bytes: u64) {
        self.used.fetch_sub(bytes, Ordering::Relaxed);
    }
}

/// Values on the device. Made, filled and freed in the order of one stream (mostly the work stream).
#[derive(Debug)]
pub struct Buffer<T> {
    slice: CudaSlice<T>,
    budget: Arc<Budget>,
    stream: Arc<CudaStream>,
    /// Another stream that reads it: memory is freed behind its work too.
    reader: Option<Arc<CudaStream>>,
    bytes: u64,
}

impl<T: DeviceRepr> Buffer<T> {
    pub(in crate::backend::cuda) fn new(
        stream: &Arc<CudaStream>,
        budget: &Arc<Budget>,
        what: &str,
        len: usize,
    ) -> Result<Self, DeviceError> {
        // An empty buffer still has an address.
        let len = len.max(1);
        let bytes = (len as u64).saturating_mul(size_of::<T>() as u64);
        budget.take(what, bytes)?;
        // SAFETY: the memory is unset; whoever reads it has written it before (each kernel says what it writes; tests fill it with NaN).
        let slice = unsafe { stream.alloc(len) }.map_err(|error| {
            budget.give_back(bytes);
            match error.0 {
                sys::CUresult::CUDA_ERROR_OUT_OF_MEMORY => {
                    budget.refusal(what, bytes, budget.used(), "but others hold the rest of the device")
                }
                _ => DeviceError::driver("allocating device memory")(error),
            }
        })?;
        let mut buffer = Self { slice, budget: budget.clone(), stream: stream.clone(), reader: None, bytes };
        if let Some(byte) = budget.fill {
            buffer.fill_bytes(byte)?;
        }
        Ok(buffer)
    }

    /// The same, read by another stream. Whoever reads waits for an event behind the last write.
    pub(in crate::backend::cuda) fn read_by(mut self, reader: &Arc<CudaStream>) -> Self {
        self.reader = Some(reader.clone());
        self
    }

    /// Copies page-locked values to `at` in the order of the buffer's stream, without waiting.
    ///
    /// # Safety
    /// `values` is unchanged until the stream has passed this.
    pub(in crate::backend::cuda) unsafe fn write_behind(&mut self, at: usize, values: &[T]) -> Result<(), DeviceError> {
        assert!(at + values.len() <= self.len(), "values fit the buffer");
        let doing = DeviceError::driver("copying to the device");
        self.stream.context().bind_to_thread().map_err(&doing)?;
        let address = self.address() + (at * size_of::<T>()) as u64;
        // SAFETY: the destination is within the buffer; the source is the caller's.
        unsafe { result::memcpy_htod_async(address, values, self.stream.cu_stream()) }.map_err(doing)
    }

    /// Number of values.
    #[allow(clippy::len_without_is_empty)]
    pub fn len(&self) -> usize {
        self.slice.len()
    }

    /// Address on the device.
    pub fn address(&self) -> u64 {
        self.slice.device_ptr(&self.stream).0
    }

    /// Address of value `index`, which must exist.
    ///
    /// # Panics
    /// When it does not.
    pub fn address_of(&self, index: usize) -> u64 {
        assert!(index < self.len(), "an index within the buffer");
        self.address() + (index * size_of::<T>()) as u64
    }

    /// Copies `values` to the front, in the order of the work stream. `values` may be reused at once.
    pub fn write(&mut self, values: &[T]) -> Result<(), DeviceError> {
        if values.is_empty() {
            return Ok(());
        }
        assert!(values.len() <= self.len(), "values fit the buffer");
        self.stream.memcpy_htod(values, &mut self.slice).map_err(DeviceError::driver("copying to the device"))
    }

    /// Copies `values` to where value `first` is, in the order of the work stream.
    pub fn write_at(&mut self, first: usize, values: &[T]) -> Result<(), DeviceError> {
        if values.is_empty() {
            return Ok(());
        }
        let mut view = self.slice.slice_mut(first..first + values.len());
        self.stream.memcpy_htod(values, &mut view).map_err(DeviceError::driver("copying to the device"))
    }

    /// Sets the bytes of `count` values from value `first` on to 0, in the order of the work stream.
    pub fn zero_at(&self, first: usize, count: usize) -> Result<(), DeviceError> {
        assert!(first + count <= self.len(), "the buffer holds as many");
        let doing = DeviceError::driver("filling device memory");
        self.stream.context().bind_to_thread().map_err(&doing)?;
        let at = self.address() + (first * size_of::<T>()) as u64;
        // SAFETY: within the buffer, which is freed behind this on the same stream.
        unsafe { result::memset_d8_async(at, 0, count * size_of::<T>(), self.stream.cu_stream()) }.map_err(doing)
    }

    /// Copies the front of the buffer back; waits for the work before it.
    pub fn read(&self, out: &mut [T]) -> Result<(), DeviceError> {
        if out.is_empty() {
            return Ok(());
        }
        assert!(out.len() <= self.len(), "the buffer holds as many");
        let doing = DeviceError::driver("copying from the device");
        let view = self.slice.slice(0..out.len());
        self.stream.memcpy_dtoh(&view, out).map_err(&doing)?;
        self.stream.synchronize().map_err(&doing)
    }

    /// Sets every byte, in the order of the work stream.
    pub fn fill_bytes(&mut self, byte: u8) -> Result<(), DeviceError> {
        self.set_bytes(byte, self.bytes as usize)
    }

    /// Sets the bytes of the first `count` values to 0, in the order of the work stream.
    pub fn zero_front(&mut self, count: usize) -> Result<(), DeviceError> {
        assert!(count <= self.len(), "the buffer holds as many");
        self.set_bytes(0, count * size_of::<T>())
    }

    fn set_bytes(&mut self, byte: u8, bytes: usize) -> Result<(), DeviceError> {
        let doing = DeviceError::driver("filling device memory");
        self.stream.context().bind_to_thread().map_err(&doing)?;
        let (address, _guard) = self.slice.device_ptr_mut(&self.stream);
        // SAFETY: `address` holds at least `bytes` bytes until `self` is dropped, which is ordered behind this on the same stream.
        unsafe { result::memset_d8_async(address, byte, bytes, self.stream.cu_stream()) }.map_err(doing)
    }
}

impl<T> Drop for Buffer<T> {
    fn drop(&mut self) {
        // The slice frees itself, in the order of its stream.
        if let Some(reader) = &self.reader {
            self.stream.context().record_err(self.stream.join(reader));
        }
        self.budget.give_back(self.bytes);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_cap_is_kept() {
        let budget = Budget::new(Some(100), 1000, 1000);
        budget.take("a", 60).unwrap();
        let refused = budget.take("b", 41).unwrap_err();
        assert!(matches!(&refused, DeviceError::OutOfMemory { needed: 41, used: 60, cap: 100, .. }), "{refused}");
        budget.give_back(60);
        budget.take("b", 100).unwrap();
        assert!(budget.take("c", u64::MAX).is_err(), "no overflow");
        assert_eq!(Budget::new(None, 1000, 2000).cap(), 900);
        assert_eq!(Budget::new(Some(5000), 1000, 2000).cap(), 2000);
    }
}
