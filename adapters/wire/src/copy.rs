//! Copies a solver's arrays into a slot: separate or interleaved components, any strides, f32 or f64.

use crate::WireError;

/// Element type of the solver's arrays.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Element {
    /// 4 bytes.
    F32,
    /// 8 bytes; rounded to f32.
    F64,
}

impl Element {
    fn bytes(self) -> usize {
        match self {
            Element::F32 => 4,
            Element::F64 => 8,
        }
    }
}

/// A step in the solver's memory. Value (i, j, k) of component c is `components[c][i * strides[0] + j * strides[1] + k * strides[2]]`.
#[derive(Debug, Clone, Copy)]
pub struct Field<'a> {
    /// Addresses of the first values of u, v and, in three dimensions, w.
    pub components: &'a [*const u8],
    /// Element type of all components.
    pub element: Element,
    /// Strides in elements along x, y, z; may be negative.
    pub strides: [isize; 3],
}

impl<'a> Field<'a> {
    /// Packed components, x fastest: C's `u[k][j][i]`, Fortran's `u(i, j, k)`.
    pub fn packed(components: &'a [*const u8], element: Element, extent: [u64; 3]) -> Self {
        Self { components, element, strides: [1, extent[0] as isize, (extent[0] * extent[1]) as isize] }
    }

    /// Checks the number of components, null pointers and alignment.
    pub(crate) fn check(&self, components: usize) -> Result<(), WireError> {
        if self.components.len() != components {
            return Err(WireError::Components { found: self.components.len(), accepted: components });
        }
        let divisor = self.element.bytes();
        match self.components.iter().map(|pointer| pointer.addr()).find(|address| *address == 0 || !address.is_multiple_of(divisor)) {
            Some(address) => Err(WireError::Address { address, divisor }),
            None => Ok(()),
        }
    }

    /// Copies all components to `to`, one after another, x fastest.
    ///
    /// # Safety
    /// Every value that components, strides and `extent` describe is readable. `to` is aligned, has 4 bytes for each, and overlaps none of them.
    pub(crate) unsafe fn copy_to(&self, extent: [u64; 3], to: *mut f32) {
        let extent = extent.map(|n| n as usize);
        let nodes: usize = extent.iter().product();
        for (c, from) in self.components.iter().enumerate() {
            // SAFETY: guaranteed by the caller, component by component.
            unsafe {
                let to = to.add(c * nodes);
                match self.element {
                    Element::F32 => copy(from.cast::<f32>(), self.strides, extent, to, |v| v),
                    Element::F64 => copy(from.cast::<f64>(), self.strides, extent, to, |v| v as f32),
                }
            }
        }
    }
}

/// # Safety
/// As for [`Field::copy_to`], for one component.
unsafe fn copy<T: Copy + 'static>(from: *const T, strides: [isize; 3], [nx, ny, nz]: [usize; 3], to: *mut f32, convert: impl Fn(T) -> f32) {
    let packed = strides[0] == 1 && (ny == 1 || strides[1] == nx as isize) && (nz == 1 || strides[2] == (nx * ny) as isize);
    // Packed arrays are one row.
    let (nx, ny, nz) = if packed { (nx * ny * nz, 1, 1) } else { (nx, ny, nz) };
    let mut to = to;
    for k in 0..nz {
        for j in 0..ny {
            // SAFETY: the caller guarantees (0, j, k) and the values along x.
            unsafe {
                let row = from.offset(j as isize * strides[1] + k as isize * strides[2]);
                if strides[0] == 1 && size_of::<T>() == 4 {
                    // f32 is the only element type of four bytes.
                    stream(row.cast::<f32>(), to, nx);
                } else if strides[0] == 1 {
                    for i in 0..nx {
                        to.add(i).write(convert(row.add(i).read()));
                    }
                } else {
                    for i in 0..nx {
                        to.add(i).write(convert(row.offset(i as isize * strides[0]).read()));
                    }
                }
                to = to.add(nx);
            }
        }
    }
}

/// Number of values from which a copy bypasses the caches: it would evict the solver's data, and overwritten lines need not be read first.
#[cfg(any(test, target_arch = "x86_64"))]
const STREAMED: usize = 1 << 18;

/// Copies `count` values.
///
/// # Safety
/// The values are readable, the target has room for them, and the two do not overlap.
#[cfg(target_arch = "x86_64")]
unsafe fn stream(from: *const f32, to: *mut f32, count: usize) {
    use std::arch::x86_64::{__m128i, _mm_loadu_si128, _mm_sfence, _mm_stream_si128};
    if count < STREAMED {
        // SAFETY: guaranteed by the caller.
        return unsafe { std::ptr::copy_nonoverlapping(from, to, count) };
    }
    // Cache lines of the target, 16 values each, are streamed; the values before and after them are copied normally.
    let before = (to as usize).wrapping_neg() % 64 / 4;
    let lines = (count - before) / 16;
    // SAFETY: all addresses are inside the `count` values, and the target of the streaming stores is a multiple of 64.
    unsafe {
        // Streaming stores are not ordered after earlier stores either, and a release fence compiles to no instruction on x86: the odd sequence number must be
        // visible before any of them.
        _mm_sfence();
        std::ptr::copy_nonoverlapping(from, to, before);
        let (mut source, mut target) = (from.add(before).cast::<__m128i>(), to.add(before).cast::<__m128i>());
        for _ in 0..lines {
            let line =
                [_mm_loadu_si128(source), _mm_loadu_si128(source.add(1)), _mm_loadu_si128(source.add(2)), _mm_loadu_si128(source.add(3))];
            for (k, part) in line.into_iter().enumerate() {
                _mm_stream_si128(target.add(k), part);
            }
            (source, target) = (source.add(4), target.add(4));
        }
        // Streaming stores are not ordered before later stores: all of them must be visible before the even sequence number.
        _mm_sfence();
        let done = before + 16 * lines;
        std::ptr::copy_nonoverlapping(from.add(done), to.add(done), count - done);
    }
}

/// Copies `count` values.
///
/// # Safety
/// The values are readable, the target has room for them, and the two do not overlap.
#[cfg(not(target_arch = "x86_64"))]
unsafe fn stream(from: *const f32, to: *mut f32, count: usize) {
    // SAFETY: guaranteed by the caller.
    unsafe { std::ptr::copy_nonoverlapping(from, to, count) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn long_copies_arrive_whole_wherever_they_begin() {
        let from: Vec<f32> = (0..STREAMED + 100).map(|i| i as f32).collect();
        for (skip, start, count) in [(0, 0, STREAMED), (1, 3, STREAMED + 5), (7, 16, STREAMED + 64), (3, 15, STREAMED + 17)] {
            let mut to = vec![-1.0f32; STREAMED + 200];
            // SAFETY: both ranges lie inside their vectors.
            unsafe { stream(from[skip..].as_ptr(), to[start..].as_mut_ptr(), count) };
            assert_eq!(to[start..start + count], from[skip..skip + count]);
            assert!(to[..start].iter().chain(&to[start + count..]).all(|v| *v == -1.0), "no other value changes");
        }
    }
}
