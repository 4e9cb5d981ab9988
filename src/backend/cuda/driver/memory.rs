//! Device memory: buffers in stream order, counted against a limit.

use crate::cuda::DeviceError;
use crate::cuda::driver_error;
use cudarc::driver::{CudaSlice, CudaStream, DevicePtr, DevicePtrMut, DeviceRepr, result, sys};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

/// Limit and use of device memory by ridgewatch.
#[derive(Debug)]
pub struct Budget {
    cap: u64,
    cap_from: &'static str,
    used: AtomicU64,
    /// Byte that fills new memory. `None`: new memory is uninitialised.
    fill: Option<u8>,
}

impl Budget {
    /// Creates a budget of `asked` bytes, at most `total`. Without `asked` it is 90 % of `free`, since other users (burn's pool, the driver) need
    /// some.
    pub fn new(asked: Option<u64>, free: u64, total: u64) -> Self {
        let (cap, cap_from) = match asked {
            Some(cap) if cap <= total => (cap, "the memory cap"),
            Some(_) => (total, "the device's memory"),
            None => (free / 10 * 9, "nine tenths of what was free at start"),
        };
        Self { cap, cap_from, used: AtomicU64::new(0), fill: None }
    }

    /// Fills new memory with a byte.
    pub fn filling(self, fill: Option<u8>) -> Self {
        Self { fill, ..self }
    }

    /// Limit, bytes.
    pub fn cap(&self) -> u64 {
        self.cap
    }

    /// Bytes in use.
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

/// Values on the device. They are allocated, filled and freed in the order of one stream, usually the work stream.
#[derive(Debug)]
pub struct Buffer<T> {
    slice: CudaSlice<T>,
    budget: Arc<Budget>,
    stream: Arc<CudaStream>,
    /// Another stream that reads the buffer. The memory is freed after the work of this stream too.
    reader: Option<Arc<CudaStream>>,
    bytes: u64,
}

impl<T: DeviceRepr> Buffer<T> {
    /// Allocates uninitialised memory for `len` values in the order of `stream`. `what` names the purpose in errors.
    ///
    /// # Errors
    /// [`DeviceError::OutOfMemory`], or a driver call fails.
    pub(in crate::cuda) fn new(stream: &Arc<CudaStream>, budget: &Arc<Budget>, what: &str, len: usize) -> Result<Self, DeviceError> {
        // At least one value, so that an empty buffer has an address too.
        let len = len.max(1);
        let bytes = (len as u64).saturating_mul(size_of::<T>() as u64);
        budget.take(what, bytes)?;
        // SAFETY: the memory is uninitialised. Every reader writes it before (each kernel documents its outputs; tests fill it with NaN).
        let slice = unsafe { stream.alloc(len) }.map_err(|error| {
            budget.give_back(bytes);
            match error.0 {
                sys::CUresult::CUDA_ERROR_OUT_OF_MEMORY => {
                    budget.refusal(what, bytes, budget.used(), "but other programs use the rest of the device")
                }
                _ => driver_error("allocating device memory")(error),
            }
        })?;
        let mut buffer = Self { slice, budget: budget.clone(), stream: stream.clone(), reader: None, bytes };
        if let Some(byte) = budget.fill {
            buffer.fill_bytes(byte)?;
        }
        Ok(buffer)
    }

    /// Declares another stream that reads the buffer. That stream must wait for an event after the last write.
    pub(in crate::cuda) fn read_by(mut self, reader: &Arc<CudaStream>) -> Self {
        self.reader = Some(reader.clone());
        self
    }

    /// Enqueues a copy of pinned values to position `at`, on the stream of the buffer.
    ///
    /// # Errors
    /// A driver call fails.
    ///
    /// # Panics
    /// If the values do not fit the buffer.
    ///
    /// # Safety
    /// `values` does not change until the stream has executed the copy.
    pub(in crate::cuda) unsafe fn write_behind(&mut self, at: usize, values: &[T]) -> Result<(), DeviceError> {
        assert!(at + values.len() <= self.len(), "values fit the buffer");
        let doing = driver_error("copying to the device");
        self.stream.context().bind_to_thread().map_err(&doing)?;
        let address = self.address() + (at * size_of::<T>()) as u64;
        // SAFETY: the destination is within the buffer; the caller guarantees the source.
        unsafe { result::memcpy_htod_async(address, values, self.stream.cu_stream()) }.map_err(doing)
    }

    /// Number of values.
    #[allow(clippy::len_without_is_empty)]
    pub fn len(&self) -> usize {
        self.slice.len()
    }

    /// Device address of the first value.
    pub fn address(&self) -> u64 {
        self.slice.device_ptr(&self.stream).0
    }

    /// Device address of value `index`.
    ///
    /// # Panics
    /// If `index` is out of range.
    pub fn address_of(&self, index: usize) -> u64 {
        assert!(index < self.len(), "an index within the buffer");
        self.address() + (index * size_of::<T>()) as u64
    }

    /// Copies `values` to the front of the buffer, in stream order. `values` may change after the return.
    ///
    /// # Errors
    /// A driver call fails.
    ///
    /// # Panics
    /// If the values do not fit the buffer.
    pub fn write(&mut self, values: &[T]) -> Result<(), DeviceError> {
        if values.is_empty() {
            return Ok(());
        }
        assert!(values.len() <= self.len(), "values fit the buffer");
        self.stream.memcpy_htod(values, &mut self.slice).map_err(driver_error("copying to the device"))
    }

    /// Copies `values` to position `first`, in stream order.
    ///
    /// # Errors
    /// A driver call fails.
    ///
    /// # Panics
    /// If the values do not fit the buffer.
    pub fn write_at(&mut self, first: usize, values: &[T]) -> Result<(), DeviceError> {
        if values.is_empty() {
            return Ok(());
        }
        let mut view = self.slice.slice_mut(first..first + values.len());
        self.stream.memcpy_htod(values, &mut view).map_err(driver_error("copying to the device"))
    }

    /// Sets the bytes of `count` values from position `first` on to 0, in stream order.
    ///
    /// # Errors
    /// A driver call fails.
    ///
    /// # Panics
    /// If the range exceeds the buffer.
    pub fn zero_at(&self, first: usize, count: usize) -> Result<(), DeviceError> {
        assert!(first + count <= self.len(), "the buffer holds as many");
        let doing = driver_error("filling device memory");
        self.stream.context().bind_to_thread().map_err(&doing)?;
        let at = self.address() + (first * size_of::<T>()) as u64;
        // SAFETY: the range is within the buffer, which is freed later on the same stream.
        unsafe { result::memset_d8_async(at, 0, count * size_of::<T>(), self.stream.cu_stream()) }.map_err(doing)
    }

    /// Copies the front of the buffer to the host. Waits for the work before it.
    ///
    /// # Errors
    /// A driver call or earlier work on the stream fails.
    ///
    /// # Panics
    /// If the buffer holds fewer values than `out`.
    pub fn read(&self, out: &mut [T]) -> Result<(), DeviceError> {
        if out.is_empty() {
            return Ok(());
        }
        assert!(out.len() <= self.len(), "the buffer holds as many");
        let doing = driver_error("copying from the device");
        let view = self.slice.slice(0..out.len());
        self.stream.memcpy_dtoh(&view, out).map_err(&doing)?;
        self.stream.synchronize().map_err(&doing)
    }

    /// Sets every byte of the buffer, in stream order.
    ///
    /// # Errors
    /// A driver call fails.
    pub fn fill_bytes(&mut self, byte: u8) -> Result<(), DeviceError> {
        self.set_bytes(byte, self.bytes as usize)
    }

    /// Sets the bytes of the first `count` values to 0, in stream order.
    ///
    /// # Errors
    /// A driver call fails.
    ///
    /// # Panics
    /// If the buffer holds fewer values.
    pub fn zero_front(&mut self, count: usize) -> Result<(), DeviceError> {
        assert!(count <= self.len(), "the buffer holds as many");
        self.set_bytes(0, count * size_of::<T>())
    }

    fn set_bytes(&mut self, byte: u8, bytes: usize) -> Result<(), DeviceError> {
        let doing = driver_error("filling device memory");
        self.stream.context().bind_to_thread().map_err(&doing)?;
        let (address, _guard) = self.slice.device_ptr_mut(&self.stream);
        // SAFETY: `address` holds at least `bytes` bytes until `self` is dropped, which comes later on the same stream.
        unsafe { result::memset_d8_async(address, byte, bytes, self.stream.cu_stream()) }.map_err(doing)
    }
}

impl<T> Drop for Buffer<T> {
    fn drop(&mut self) {
        // The slice frees itself in the order of its stream, which therefore waits for the reader first.
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
