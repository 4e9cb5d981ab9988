//! Layout of a tile in memory: aligned buffers, distances of rows, and vector loads.

use wide::f32x8;

/// Values of a cache line of 64 bytes.
pub(super) const LINE: usize = 16;
/// Columns of a panel of weights: one cache line.
pub(super) const PANEL: usize = LINE;
/// Rows of one register block of the dense products.
pub(super) const BLOCK: usize = 6;
/// Rows of a tile: 48 rows of 64 f32 are 12 KiB, so that the input and the output of a layer fit the first cache level.
pub(super) const TILE_ROWS: usize = 8 * BLOCK;

/// Outputs of one row; columns beyond those of the network are unused.
pub(super) type Outputs = [f32; 3];

/// Rounds up to whole panels.
pub(super) fn padded(width: usize) -> usize {
    width.next_multiple_of(PANEL)
}

/// Distance of two rows of activations: an odd number of cache lines, so that a column of rows spreads over all sets of the first cache
/// level instead of a quarter of them.
pub(super) fn row_stride(width: usize) -> usize {
    let lines = padded(width) / LINE;
    (lines + (lines + 1) % 2) * LINE
}

/// One cache line. A vector load never spans two lines if rows start on a line.
#[derive(Clone, Copy)]
#[repr(C, align(64))]
struct Line([f32; LINE]);

/// Buffer of f32, aligned to 64 bytes.
#[derive(Clone)]
pub(super) struct Aligned {
    lines: Vec<Line>,
    len: usize,
}

impl Aligned {
    /// `len` zeros.
    pub(super) fn zeros(len: usize) -> Self {
        Self { lines: vec![Line([0.0; LINE]); len.div_ceil(LINE)], len }
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

/// Loads the first eight values of a slice.
#[inline(always)]
pub(super) fn load(from: &[f32]) -> f32x8 {
    let mut values = [0.0; 8];
    values.copy_from_slice(&from[..8]);
    f32x8::from(values)
}

/// Prefetches `values[index]`, if it exists, into all cache levels.
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
