//! The vectors of crate `wide`.

use super::scalar::{MAGIC_F32, MAGIC_F64};
use super::trigonometry::{Bits, HALF_PI_F64, PI_F32, half_turns, half_turns_pi, quarter_turns, trigonometry};
use super::{Lanes, Mask, array};
use std::ops::{BitAnd, BitOr, Not};
use wide::{f32x4, f32x8, f64x4};

/// Comparison result of a vector: all bits of a true lane are set.
#[derive(Debug, Clone, Copy)]
pub struct VectorMask<V>(V);

macro_rules! vector {
    ($vector:ident, $real:ident, $lanes:literal, $bits:ident, $shift:literal, $magic:expr) => {
        impl BitAnd for VectorMask<$vector> {
            type Output = Self;
            #[inline(always)]
            fn bitand(self, other: Self) -> Self {
                Self(self.0 & other.0)
            }
        }
        impl BitOr for VectorMask<$vector> {
            type Output = Self;
            #[inline(always)]
            fn bitor(self, other: Self) -> Self {
                Self(self.0 | other.0)
            }
        }
        impl Not for VectorMask<$vector> {
            type Output = Self;
            #[inline(always)]
            fn not(self) -> Self {
                Self(!self.0)
            }
        }
        impl Mask for VectorMask<$vector> {
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
            #[inline(always)]
            fn mul_add(self, a: Self, b: Self) -> Self {
                $vector::mul_add(self, a, b)
            }
            #[inline(always)]
            fn sqrt(self) -> Self {
                $vector::sqrt(self)
            }
            #[inline(always)]
            fn abs(self) -> Self {
                $vector::abs(self)
            }
            #[inline(always)]
            fn floor(self) -> Self {
                $vector::floor(self)
            }
            #[inline(always)]
            fn min(self, other: Self) -> Self {
                self.fast_min(other)
            }
            #[inline(always)]
            fn max(self, other: Self) -> Self {
                self.fast_max(other)
            }
            #[inline(always)]
            fn ln(self) -> Self {
                $vector::ln(self)
            }
            #[inline(always)]
            fn atan2(self, x: Self) -> Self {
                $vector::atan2(self, x)
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
        impl Bits for $vector {
            #[inline(always)]
            fn nearest(self) -> Self {
                self.round_ties_even()
            }
            #[inline(always)]
            fn flip_if_odd(self, count: Self) -> Self {
                let parity = wide::$bits::from_bits_of(count + $vector::splat($magic)) << $shift;
                self ^ parity.into_float()
            }
        }
    };
}

/// Bits of a float vector as an integer vector and back.
trait Cast<F> {
    fn from_bits_of(float: F) -> Self;
    fn into_float(self) -> F;
}
macro_rules! cast {
    ($int:ident, $float:ident) => {
        impl Cast<$float> for wide::$int {
            #[inline(always)]
            fn from_bits_of(float: $float) -> Self {
                // SAFETY: both are plain vectors of the same size in which every bit pattern is a value.
                unsafe { std::mem::transmute::<$float, Self>(float) }
            }
            #[inline(always)]
            fn into_float(self) -> $float {
                // SAFETY: as above.
                unsafe { std::mem::transmute::<Self, $float>(self) }
            }
        }
    };
}
cast!(u32x4, f32x4);
cast!(u32x8, f32x8);
cast!(u64x4, f64x4);
vector!(f32x4, f32, 4, u32x4, 31u32, MAGIC_F32);
vector!(f32x8, f32, 8, u32x8, 31u32, MAGIC_F32);
vector!(f64x4, f64, 4, u64x4, 63u32, MAGIC_F64);
