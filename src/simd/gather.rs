//! Gathers: each lane reads its own nodes of a node array.

use super::{Gather, LanePair, Lanes, NodePair, NodePairReader, SameBits, array, written};
use std::mem::MaybeUninit;
use wide::{f32x8, f64x4, i32x8, u32x8};

impl NodePair for f32x8 {
    #[inline(always)]
    unsafe fn load_adjacent(first: *const [f32; 4]) -> Self {
        // SAFETY: the caller guarantees that both nodes exist; they are 8 contiguous numbers, and the read is unaligned.
        f32x8::new(unsafe { first.cast::<[f32; 8]>().read_unaligned() })
    }
    #[inline(always)]
    fn from_nodes(a: [f32; 4], b: [f32; 4]) -> Self {
        f32x8::new([a[0], a[1], a[2], a[3], b[0], b[1], b[2], b[3]])
    }
    #[inline(always)]
    fn repeat(four: [f32; 4]) -> Self {
        Self::from_nodes(four, four)
    }
    #[inline(always)]
    fn splat_nodes(first: f32, second: f32) -> Self {
        Self::from_nodes([first; 4], [second; 4])
    }
    #[inline(always)]
    fn repeat_second(self) -> Self {
        let a = self.to_array();
        f32x8::new([a[4], a[5], a[6], a[7], a[4], a[5], a[6], a[7]])
    }
}

impl NodePair for LanePair<f64x4> {
    #[inline(always)]
    unsafe fn load_adjacent(first: *const [f32; 4]) -> Self {
        // SAFETY: the caller guarantees that both nodes exist.
        unsafe { Self::from_nodes(first.read(), first.add(1).read()) }
    }
    #[inline(always)]
    fn from_nodes(a: [f32; 4], b: [f32; 4]) -> Self {
        LanePair(f64x4::new(a.map(f64::from)), f64x4::new(b.map(f64::from)))
    }
    #[inline(always)]
    fn repeat(four: [f64; 4]) -> Self {
        LanePair(f64x4::new(four), f64x4::new(four))
    }
    #[inline(always)]
    fn splat_nodes(first: f64, second: f64) -> Self {
        LanePair(f64x4::splat(first), f64x4::splat(second))
    }
    #[inline(always)]
    fn repeat_second(self) -> Self {
        LanePair(self.1, self.1)
    }
}

impl Gather for f32x8 {
    type Pair = f32x8;
    type Cells = u32x8;
    #[inline(always)]
    fn truncate(self, last: u32) -> (u32x8, Self) {
        // Values out of range and NaN become 0x80000000, which the minimum limits to `last`.
        let integer = SameBits::<u32x8>::same_bits(self.fast_trunc_int()).min(u32x8::splat(last));
        (integer, f32x8::from_i32x8(integer.same_bits()))
    }
    #[inline(always)]
    fn flatten(outer: u32x8, stride: u32, inner: u32x8) -> u32x8 {
        outer * u32x8::splat(stride) + inner
    }
    #[inline(always)]
    fn cell(cells: &u32x8, lane: usize) -> u32 {
        cells.as_array()[lane]
    }
    #[inline(always)]
    fn cells_from_fn(f: impl FnMut(usize) -> u32) -> u32x8 {
        u32x8::new(array(f))
    }
    #[inline(always)]
    fn gather<const K: usize>(reader: &impl NodePairReader<f32x8, K>) -> [[Self; 8]; K] {
        let mut table = [const { MaybeUninit::<[f32x8; K]>::uninit() }; 8];
        for (lane, slot) in table.iter_mut().enumerate() {
            slot.write(reader.read_pairs(lane));
        }
        // SAFETY: the loop wrote every element.
        let table = unsafe { written(table) };
        array(|k| f32x8::transpose(array(|lane| table[lane][k])))
    }
}

// SAFETY: both are plain vectors of the same size in which every bit pattern is a value.
unsafe impl SameBits<u32x8> for i32x8 {}
// SAFETY: as above.
unsafe impl SameBits<i32x8> for u32x8 {}

impl Gather for f64x4 {
    type Pair = LanePair<f64x4>;
    type Cells = [u32; 4];
    #[inline(always)]
    fn truncate(self, last: u32) -> ([u32; 4], Self) {
        let integer = self.to_array().map(|x| (x as u32).min(last));
        (integer, f64x4::new(integer.map(f64::from)))
    }
    #[inline(always)]
    fn flatten(outer: [u32; 4], stride: u32, inner: [u32; 4]) -> [u32; 4] {
        array(|i| outer[i].wrapping_mul(stride).wrapping_add(inner[i]))
    }
    #[inline(always)]
    fn cell(cells: &[u32; 4], lane: usize) -> u32 {
        cells[lane]
    }
    #[inline(always)]
    fn cells_from_fn(f: impl FnMut(usize) -> u32) -> [u32; 4] {
        array(f)
    }
    #[inline(always)]
    fn gather<const K: usize>(reader: &impl NodePairReader<LanePair<f64x4>, K>) -> [[Self; 8]; K] {
        let mut table = [const { MaybeUninit::<[LanePair<f64x4>; K]>::uninit() }; 4];
        for (lane, slot) in table.iter_mut().enumerate() {
            slot.write(reader.read_pairs(lane));
        }
        // SAFETY: the loop wrote every element.
        let table = unsafe { written(table) };
        array(|k| {
            let first = f64x4::transpose(array(|lane| table[lane][k].0));
            let second = f64x4::transpose(array(|lane| table[lane][k].1));
            [first[0], first[1], first[2], first[3], second[0], second[1], second[2], second[3]]
        })
    }
}

macro_rules! scalar_gather {
    ($real:ident, $pair:ty) => {
        impl Gather for $real {
            type Pair = $pair;
            type Cells = u32;
            #[inline(always)]
            fn truncate(self, last: u32) -> (u32, Self) {
                let integer = (self as u32).min(last);
                (integer, integer as $real)
            }
            #[inline(always)]
            fn flatten(outer: u32, stride: u32, inner: u32) -> u32 {
                outer.wrapping_mul(stride).wrapping_add(inner)
            }
            #[inline(always)]
            fn cell(cells: &u32, _: usize) -> u32 {
                *cells
            }
            #[inline(always)]
            fn cells_from_fn(mut f: impl FnMut(usize) -> u32) -> u32 {
                f(0)
            }
            #[inline(always)]
            fn gather<const K: usize>(reader: &impl NodePairReader<Self::Pair, K>) -> [[Self; 8]; K] {
                let pairs = reader.read_pairs(0);
                array(|k| array(|i| pairs[k].lane(i)))
            }
        }
    };
}
scalar_gather!(f32, f32x8);
scalar_gather!(f64, LanePair<f64x4>);
