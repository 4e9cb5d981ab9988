//! The vectors of crate `wide`.

use super::scalar::{MAGIC_F32, MAGIC_F64};
use super::trigonometry::{
    HALF_PI_F64, PI_F32, RoundingBits, sin_cos_half_turns, sin_cos_half_turns_pi, sin_cos_quarter_turns, trigonometry,
};
use super::{Lanes, Mask, SameBits, array, inherent};
use std::ops::{BitAnd, BitOr, Not};
use wide::{f32x8, f64x4, u32x8, u64x4};

/// Comparison result of a vector: all bits of a true lane are set.
#[derive(Debug, Clone, Copy)]
pub struct VectorMask<V>(V);

impl<V: BitAnd<Output = V>> BitAnd for VectorMask<V> {
    type Output = Self;
    #[inline(always)]
    fn bitand(self, other: Self) -> Self {
        Self(self.0 & other.0)
    }
}
impl<V: BitOr<Output = V>> BitOr for VectorMask<V> {
    type Output = Self;
    #[inline(always)]
    fn bitor(self, other: Self) -> Self {
        Self(self.0 | other.0)
    }
}
impl<V: Not<Output = V>> Not for VectorMask<V> {
    type Output = Self;
    #[inline(always)]
    fn not(self) -> Self {
        Self(!self.0)
    }
}

macro_rules! vector {
    ($vector:ident, $real:ident, $lanes:literal, $bits:ident, $shift:literal, $magic:expr) => {
        impl Mask for VectorMask<$vector> {
            const LANES: usize = $lanes;
            #[inline(always)]
            fn splat(value: bool) -> Self {
                Self($vector::splat($real::from_bits(if value { !0 } else { 0 })))
            }
            #[inline(always)]
            fn any(self) -> bool {
                self.0.any()
            }
            #[inline(always)]
            fn all(self) -> bool {
                self.0.all()
            }
            #[inline(always)]
            fn lane(self, index: usize) -> bool {
                self.0.to_bitmask() >> index & 1 == 1
            }
        }
        impl Lanes for $vector {
            type Real = $real;
            type Mask = VectorMask<$vector>;
            const LANES: usize = $lanes;
            #[inline(always)]
            fn splat(value: $real) -> Self {
                $vector::splat(value)
            }
            #[inline(always)]
            fn from_fn(f: impl FnMut(usize) -> $real) -> Self {
                $vector::new(array(f))
            }
            #[inline(always)]
            fn lane(self, index: usize) -> $real {
                self.to_array()[index]
            }
            inherent!($vector: mul_add(a, b), sqrt(), abs(), floor(), ln(), atan2(x));
            #[inline(always)]
            fn min(self, other: Self) -> Self {
                self.fast_min(other)
            }
            #[inline(always)]
            fn max(self, other: Self) -> Self {
                self.fast_max(other)
            }
            trigonometry!($real);
            #[inline(always)]
            fn lt(self, other: Self) -> Self::Mask {
                VectorMask(self.simd_lt(other))
            }
            #[inline(always)]
            fn le(self, other: Self) -> Self::Mask {
                VectorMask(self.simd_le(other))
            }
            #[inline(always)]
            fn equal(self, other: Self) -> Self::Mask {
                VectorMask(self.simd_eq(other))
            }
            #[inline(always)]
            fn select(mask: Self::Mask, on: Self, off: Self) -> Self {
                mask.0.select(on, off)
            }
        }
        // SAFETY: both are plain vectors of the same size in which every bit pattern is a value.
        unsafe impl SameBits<$bits> for $vector {}
        // SAFETY: as above.
        unsafe impl SameBits<$vector> for $bits {}
        impl RoundingBits for $vector {
            #[inline(always)]
            fn nearest(self) -> Self {
                self.round_ties_even()
            }
            #[inline(always)]
            fn flip_if_odd(self, count: Self) -> Self {
                let integer: $bits = (count + $vector::splat($magic)).same_bits();
                let sign: Self = (integer << $shift).same_bits();
                self ^ sign
            }
        }
    };
}
vector!(f32x8, f32, 8, u32x8, 31u32, MAGIC_F32);
vector!(f64x4, f64, 4, u64x4, 63u32, MAGIC_F64);
