//! Cache-line aligned f32 buffers, and vector loads and stores.

use wide::f32x8;

/// One cache line. Rows that start on a line never split a vector load over two of them.
#[derive(Clone, Copy)]
#[repr(C, align(64))]
struct Line([f32; 16]);

/// A zeroed, 64-byte aligned buffer of f32.
#[derive(Clone)]
pub(super) struct Aligned {
    lines: Vec<Line>,
    len: usize,
}

impl Aligned {
    /// `len` zeros.
    pub(super) fn zeros(len: usize) -> Self {
        Self { lines: vec![Line([0.0; 16]); len.div_ceil(16)], len }
    }
}

impl std::ops::Deref for Aligned {
    type Target = [f32];

    fn deref(&self) -> &[f32] {
        // SAFETY: `lines` holds at least `len` initialised f32 without padding (`Line` is repr(C) and 64 bytes of f32).
        unsafe { std::slice::from_raw_parts(self.lines.as_ptr().cast(), self.len) }
    }
}

impl std::ops::DerefMut for Aligned {
    fn deref_mut(&mut self) -> &mut [f32] {
        // SAFETY: as in `deref`; the borrow of `self` is unique.
        unsafe { std::slice::from_raw_parts_mut(self.lines.as_mut_ptr().cast(), self.len) }
    }
}

/// Reads eight values.
///
/// # Safety
/// `at` points to eight readable f32.
#[inline(always)]
pub(super) unsafe fn load(at: *const f32) -> f32x8 {
    // SAFETY: promised by the caller; the read is unaligned.
    f32x8::from(unsafe { at.cast::<[f32; 8]>().read_unaligned() })
}

/// Writes eight values.
///
/// # Safety
/// `at` points to eight writable f32.
#[inline(always)]
pub(super) unsafe fn store(at: *mut f32, value: f32x8) {
    // SAFETY: promised by the caller; the write is unaligned.
    unsafe { at.cast::<[f32; 8]>().write_unaligned(value.to_array()) }
}

/// Eight values from the front of a slice.
#[inline(always)]
pub(super) fn lanes(from: &[f32]) -> f32x8 {
    let mut values = [0.0; 8];
    values.copy_from_slice(&from[..8]);
    f32x8::from(values)
}

/// Asks for `values[index]` to be brought into the cache.
#[inline(always)]
pub(super) fn prefetch<T>(values: &[T], index: usize) {
    #[cfg(target_arch = "x86_64")]
    if let Some(value) = values.get(index) {
        use std::arch::x86_64::{_MM_HINT_T0, _mm_prefetch};
        // SAFETY: a prefetch reads nothing and faults on nothing; the address is that of a live value.
        unsafe { _mm_prefetch::<_MM_HINT_T0>(std::ptr::from_ref(value).cast()) };
    }
    #[cfg(not(target_arch = "x86_64"))]
    let _ = (values, index);
}
