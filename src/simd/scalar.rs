//! One lane: `f32` and `f64`.

use super::trigonometry::{
    HALF_PI_F64, PI_F32, RoundingBits, sin_cos_half_turns, sin_cos_half_turns_pi, sin_cos_quarter_turns, trigonometry,
};
use super::{Lanes, Mask, Real, inherent};

impl Mask for bool {
    const LANES: usize = 1;
    #[inline(always)]
    fn splat(value: bool) -> Self {
        value
    }
    #[inline(always)]
    fn any(self) -> bool {
        self
    }
    #[inline(always)]
    fn all(self) -> bool {
        self
    }
    #[inline(always)]
    fn lane(self, _: usize) -> bool {
        self
    }
}

macro_rules! scalar {
    ($real:ident, $bits:ident, $magic:expr) => {
        impl Lanes for $real {
            type Real = $real;
            type Mask = bool;
            const LANES: usize = 1;
            #[inline(always)]
            fn splat(value: $real) -> Self {
                value
            }
            #[inline(always)]
            fn from_fn(mut f: impl FnMut(usize) -> $real) -> Self {
                f(0)
            }
            #[inline(always)]
            fn lane(self, _: usize) -> $real {
                self
            }
            inherent!($real: mul_add(a, b), sqrt(), abs(), floor(), ln(), atan2(x));
            #[inline(always)]
            fn min(self, other: Self) -> Self {
                if self < other { self } else { other }
            }
            #[inline(always)]
            fn max(self, other: Self) -> Self {
                if self > other { self } else { other }
            }
            trigonometry!($real);
            #[inline(always)]
            fn lt(self, other: Self) -> bool {
                self < other
            }
            #[inline(always)]
            fn le(self, other: Self) -> bool {
                self <= other
            }
            #[inline(always)]
            fn equal(self, other: Self) -> bool {
                self == other
            }
            #[inline(always)]
            fn select(mask: bool, on: Self, off: Self) -> Self {
                if mask { on } else { off }
            }
        }
        impl Real for $real {
            #[inline(always)]
            fn from_f64(value: f64) -> Self {
                value as $real
            }
            #[inline(always)]
            fn to_f64(self) -> f64 {
                f64::from(self)
            }
            fn above(self) -> Self {
                self.next_up()
            }
            fn below(self) -> Self {
                self.next_down()
            }
        }
        impl RoundingBits for $real {
            #[inline(always)]
            fn nearest(self) -> Self {
                self.round_ties_even()
            }
            #[inline(always)]
            fn flip_if_odd(self, count: Self) -> Self {
                // Adding 1.5 * 2^(mantissa bits) leaves the integer in the low bits.
                let parity = (count + $magic).to_bits() << ($bits::BITS - 1);
                $real::from_bits(self.to_bits() ^ parity)
            }
        }
    };
}
pub(super) const MAGIC_F32: f32 = 12_582_912.0;
pub(super) const MAGIC_F64: f64 = 6_755_399_441_055_744.0;
scalar!(f32, u32, MAGIC_F32);
scalar!(f64, u64, MAGIC_F64);
