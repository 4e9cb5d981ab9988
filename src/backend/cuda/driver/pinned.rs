//! Pinned (page-locked) host memory, the target of asynchronous copies from the device.

use crate::cuda::DeviceError;
use crate::cuda::driver_error;
use cudarc::driver::{CudaContext, CudaStream, result, sys};
use std::ffi::c_void;
use std::sync::Arc;

/// Pinned values. The device may write them at any time between [`Self::copy_from`] and the next synchronisation of its stream, so a caller
/// synchronises before it reads them.
pub(in crate::cuda) struct Pinned<T: Copy> {
    values: *mut T,
    len: usize,
    context: Arc<CudaContext>,
}

// SAFETY: the memory is owned, read through `&self` only and written through `&mut self` only.
unsafe impl<T: Copy + Send> Send for Pinned<T> {}
// SAFETY: as above; `&self` allows reading only.
unsafe impl<T: Copy + Sync> Sync for Pinned<T> {}

impl<T: Copy + Default> Pinned<T> {
    /// Allocates `len` values of `T::default()`.
    ///
    /// # Errors
    /// The driver cannot allocate pinned memory.
    pub(in crate::cuda) fn new(context: &Arc<CudaContext>, len: usize) -> Result<Self, DeviceError> {
        let doing = driver_error("allocating pinned host memory");
        context.bind_to_thread().map_err(&doing)?;
        // SAFETY: the context is current. Flags 0 select memory that the CPU caches, since the CPU reads it.
        let values = unsafe { result::malloc_host(len.max(1) * size_of::<T>(), 0) }.map_err(&doing)?.cast::<T>();
        for i in 0..len.max(1) {
            // SAFETY: within the allocation, which the driver aligns to a page.
            unsafe { values.add(i).write(T::default()) };
        }
        Ok(Self { values, len, context: context.clone() })
    }

    /// Number of values.
    pub(in crate::cuda) fn len(&self) -> usize {
        self.len
    }

    /// Enqueues on `stream` a copy of `count` values at the device address `from` to the front of this memory.
    ///
    /// # Errors
    /// A driver call fails.
    ///
    /// # Panics
    /// `count` is above [`Self::len`].
    ///
    /// # Safety
    /// The address `from` holds `count` values when the stream executes the copy.
    pub(in crate::cuda) unsafe fn copy_from(&mut self, stream: &CudaStream, from: u64, count: usize) -> Result<(), DeviceError> {
        // SAFETY: the allocation has `len` values, and `&mut self` is the only access to them.
        let to = unsafe { front(self.values, self.len, count) };
        // SAFETY: guaranteed by the caller; the host memory lives until `drop`, where the driver waits for copies in progress.
        unsafe { copy_to_host(stream, from, to) }
    }

    /// Returns the values. The caller has synchronised the stream of the last copy.
    pub(in crate::cuda) fn values(&self) -> &[T] {
        // SAFETY: initialised in `new`; the caller waits for copies in progress, as the type requires.
        unsafe { std::slice::from_raw_parts(self.values, self.len) }
    }
}

/// Memory of somebody else that is pinned while this lives.
pub(in crate::cuda) struct Registered {
    address: usize,
    context: Arc<CudaContext>,
}

impl Registered {
    /// Pins the pages of `values`.
    ///
    /// # Errors
    /// The driver does not pin them, such as pages that are pinned already.
    ///
    /// # Safety
    /// The result is dropped before the memory is freed.
    pub(in crate::cuda) unsafe fn new(context: &Arc<CudaContext>, values: &mut [f32]) -> Result<Self, DeviceError> {
        let doing = driver_error("pinning host memory");
        context.bind_to_thread().map_err(&doing)?;
        let first: *mut f32 = values.as_mut_ptr();
        // SAFETY: the range is memory of this process.
        unsafe { sys::cuMemHostRegister_v2(first.cast(), size_of_val(values), 0) }.result().map_err(doing)?;
        Ok(Self { address: first as usize, context: context.clone() })
    }
}

impl Drop for Registered {
    fn drop(&mut self) {
        // SAFETY: registered in `new`, and not unregistered yet.
        let _ = self.context.bind_to_thread().and_then(|()| unsafe { sys::cuMemHostUnregister(self.address as *mut c_void) }.result());
    }
}

/// Enqueues a copy from the device address `from`.
///
/// # Errors
/// A driver call fails.
///
/// # Safety
/// The address holds as many values when the stream executes the copy, and the host memory lives and is not accessed until then.
pub(in crate::cuda) unsafe fn copy_to_host<T>(stream: &CudaStream, from: u64, to: &mut [T]) -> Result<(), DeviceError> {
    // SAFETY: guaranteed by the caller.
    unsafe { result::memcpy_dtoh_async(to, from, stream.cu_stream()) }.map_err(driver_error("copying from the device"))
}

/// The first `count` of `len` values. The check is not left to debug builds: the device would write behind the allocation.
///
/// # Safety
/// The `len` values are initialised, and nothing else accesses them during the lifetime.
unsafe fn front<'a, T>(values: *mut T, len: usize, count: usize) -> &'a mut [T] {
    assert!(count <= len, "a copy of {count} values to pinned memory; accepted: at most {len}");
    // SAFETY: `count` of the caller's values.
    unsafe { std::slice::from_raw_parts_mut(values, count) }
}

impl<T: Copy> Drop for Pinned<T> {
    fn drop(&mut self) {
        // SAFETY: `values` was returned by `malloc_host` and is not used again. The driver waits for a copy in progress before it frees the
        // memory.
        let _ = self.context.bind_to_thread().and_then(|()| unsafe { result::free_host(self.values.cast()) });
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    #[should_panic(expected = "a copy of 4 values to pinned memory; accepted: at most 3")]
    fn no_copy_is_longer_than_its_memory() {
        let mut values = [1, 2, 3];
        // SAFETY: the array has three values.
        assert_eq!(unsafe { front(values.as_mut_ptr(), 3, 2) }, [1, 2]);
        // SAFETY: as above.
        unsafe { front(values.as_mut_ptr(), 3, 4) };
    }
}
