//! Page-locked host memory: what the device copies to while the host does other things.

use crate::backend::cuda::{DeviceError, Gpu};
use cudarc::driver::{CudaContext, CudaStream, result};
use std::sync::Arc;

/// Values that the device may write at any time between a copy and the next synchronisation of the stream that makes it.
pub(in crate::backend::cuda) struct Pinned<T: Copy> {
    values: *mut T,
    len: usize,
    context: Arc<CudaContext>,
}

// SAFETY: owned memory, reached through `&self` for reading and `&mut self` for writing only.
unsafe impl<T: Copy + Send> Send for Pinned<T> {}
// SAFETY: as above; through `&self` values are only read.
unsafe impl<T: Copy + Sync> Sync for Pinned<T> {}

impl<T: Copy + Default> Pinned<T> {
    /// `len` values of `T::default()`.
    pub(in crate::backend::cuda) fn new(gpu: &Gpu, len: usize) -> Result<Self, DeviceError> {
        let doing = DeviceError::driver("allocating page-locked memory");
        let context = gpu.context().clone();
        context.bind_to_thread().map_err(&doing)?;
        // SAFETY: the context is current. Flags 0: cached by the CPU, which reads what the device writes.
        let values = unsafe { result::malloc_host(len.max(1) * size_of::<T>(), 0) }.map_err(&doing)?.cast::<T>();
        for i in 0..len.max(1) {
            // SAFETY: within the allocation, which the driver aligns to a page.
            unsafe { values.add(i).write(T::default()) };
        }
        Ok(Self { values, len, context })
    }

    /// Values.
    pub(in crate::backend::cuda) fn len(&self) -> usize {
        self.len
    }

    /// Enqueues a copy of the `count` values at the device address `from` to the front.
    ///
    /// # Safety
    /// As for [`Self::copy_on`], of the work stream.
    pub(in crate::backend::cuda) unsafe fn copy_from(&mut self, gpu: &Gpu, from: u64, count: usize) -> Result<(), DeviceError> {
        // SAFETY: the caller's.
        unsafe { self.copy_on(gpu.work(), from, count) }
    }

    /// The same on another stream.
    ///
    /// # Safety
    /// The device holds as many values there when the stream comes to it, and `count` is at most `len`.
    pub(in crate::backend::cuda) unsafe fn copy_on(&mut self, stream: &CudaStream, from: u64, count: usize) -> Result<(), DeviceError> {
        debug_assert!(count <= self.len);
        // SAFETY: `count` values of `T` lie within the allocation.
        let to = unsafe { std::slice::from_raw_parts_mut(self.values, count) };
        // SAFETY: the caller's; the host memory lives until `drop`, which waits for the stream's context.
        unsafe { result::memcpy_dtoh_async(to, from, stream.cu_stream()) }.map_err(DeviceError::driver("copying from the device"))
    }

    /// The values, once the copies have been waited for.
    pub(in crate::backend::cuda) fn values(&self) -> &[T] {
        // SAFETY: initialised in `new`; copies in progress are the caller's to wait for, as the type says.
        unsafe { std::slice::from_raw_parts(self.values, self.len) }
    }
}

impl<T: Copy> Drop for Pinned<T> {
    fn drop(&mut self) {
        // SAFETY: `values` came from `malloc_host` and is not used again. A copy still in flight holds the driver in the free until it is
        // done.
        let _ = self.context.bind_to_thread().and_then(|()| unsafe { result::free_host(self.values.cast()) });
    }
}
