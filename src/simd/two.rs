//! Two vectors side by side.

use super::{Lanes, Mask};
use std::ops::{Add, AddAssign, BitAnd, BitOr, Div, Mul, Neg, Not, Sub};
use wide::{f32x8, f64x4};

/// Twice the lanes; two independent chains of instructions hide each other's latency.
#[derive(Debug, Clone, Copy)]
pub struct Two<L>(pub L, pub L);

macro_rules! two_operators {
    ($($trait:ident $method:ident),*) => {$(
        impl<L: $trait<Output = L>> $trait for Two<L> {
            type Output = Self;
            #[inline(always)]
            fn $method(self, other: Self) -> Self {
                Two(self.0.$method(other.0), self.1.$method(other.1))
            }
        }
    )*};
}
two_operators!(Add add, Sub sub, Mul mul, Div div, BitAnd bitand, BitOr bitor);
impl<L: Neg<Output = L>> Neg for Two<L> {
    type Output = Self;
    #[inline(always)]
    fn neg(self) -> Self {
        Two(-self.0, -self.1)
    }
}
impl<L: Not<Output = L>> Not for Two<L> {
    type Output = Self;
    #[inline(always)]
    fn not(self) -> Self {
        Two(!self.0, !self.1)
    }
}
impl<L: AddAssign> AddAssign for Two<L> {
    #[inline(always)]
    fn add_assign(&mut self, other: Self) {
        self.0 += other.0;
        self.1 += other.1;
    }
}
/// Masks of [`Two`]; the trait cannot know the lane count of its half.
#[derive(Debug, Clone, Copy)]
pub struct TwoMask<M, const HALF: usize>(M, M);
macro_rules! two {
    ($half:ident) => {
        const _: () = {
            type M = TwoMask<<$half as Lanes>::Mask, { <$half as Lanes>::LANES }>;
            impl BitAnd for M {
                type Output = Self;
                #[inline(always)]
                fn bitand(self, other: Self) -> Self {
                    TwoMask(self.0 & other.0, self.1 & other.1)
                }
            }
            impl BitOr for M {
                type Output = Self;
                #[inline(always)]
                fn bitor(self, other: Self) -> Self {
                    TwoMask(self.0 | other.0, self.1 | other.1)
                }
            }
            impl Not for M {
                type Output = Self;
                #[inline(always)]
                fn not(self) -> Self {
                    TwoMask(!self.0, !self.1)
                }
            }
            impl Mask for M {
                #[inline(always)]
                fn splat(value: bool) -> Self {
                    TwoMask(Mask::splat(value), Mask::splat(value))
                }
                #[inline(always)]
                fn any(self) -> bool {
                    (self.0 | self.1).any()
                }
                #[inline(always)]
                fn all(self) -> bool {
                    (self.0 & self.1).all()
                }
                #[inline(always)]
                fn lane(self, index: usize) -> bool {
                    if index < <$half as Lanes>::LANES { self.0.lane(index) } else { self.1.lane(index - <$half as Lanes>::LANES) }
                }
            }
        };
        impl Lanes for Two<$half> {
            type Real = <$half as Lanes>::Real;
            type Mask = TwoMask<<$half as Lanes>::Mask, { <$half as Lanes>::LANES }>;
            const LANES: usize = 2 * <$half as Lanes>::LANES;
            #[inline(always)]
            fn splat(value: Self::Real) -> Self {
                Two(<$half as Lanes>::splat(value), <$half as Lanes>::splat(value))
            }
            #[inline(always)]
            fn from_fn(mut f: impl FnMut(usize) -> Self::Real) -> Self {
                Two(<$half as Lanes>::from_fn(&mut f), <$half as Lanes>::from_fn(|i| f(i + <$half as Lanes>::LANES)))
            }
            #[inline(always)]
            fn lane(self, index: usize) -> Self::Real {
                if index < <$half as Lanes>::LANES { self.0.lane(index) } else { self.1.lane(index - <$half as Lanes>::LANES) }
            }
            #[inline(always)]
            fn mul_add(self, a: Self, b: Self) -> Self {
                Two(Lanes::mul_add(self.0, a.0, b.0), Lanes::mul_add(self.1, a.1, b.1))
            }
            #[inline(always)]
            fn sqrt(self) -> Self {
                Two(Lanes::sqrt(self.0), Lanes::sqrt(self.1))
            }
            #[inline(always)]
            fn abs(self) -> Self {
                Two(Lanes::abs(self.0), Lanes::abs(self.1))
            }
            #[inline(always)]
            fn floor(self) -> Self {
                Two(Lanes::floor(self.0), Lanes::floor(self.1))
            }
            #[inline(always)]
            fn min(self, other: Self) -> Self {
                Two(Lanes::min(self.0, other.0), Lanes::min(self.1, other.1))
            }
            #[inline(always)]
            fn max(self, other: Self) -> Self {
                Two(Lanes::max(self.0, other.0), Lanes::max(self.1, other.1))
            }
            #[inline(always)]
            fn ln(self) -> Self {
                Two(Lanes::ln(self.0), Lanes::ln(self.1))
            }
            #[inline(always)]
            fn atan2(self, x: Self) -> Self {
                Two(Lanes::atan2(self.0, x.0), Lanes::atan2(self.1, x.1))
            }
            #[inline(always)]
            fn sin_cos(self) -> (Self, Self) {
                let (a, b) = (Lanes::sin_cos(self.0), Lanes::sin_cos(self.1));
                (Two(a.0, b.0), Two(a.1, b.1))
            }
            #[inline(always)]
            fn sin_cos_pi(self) -> (Self, Self) {
                let (a, b) = (self.0.sin_cos_pi(), self.1.sin_cos_pi());
                (Two(a.0, b.0), Two(a.1, b.1))
            }
            #[inline(always)]
            fn lt(self, other: Self) -> Self::Mask {
                TwoMask(Lanes::lt(self.0, other.0), Lanes::lt(self.1, other.1))
            }
            #[inline(always)]
            fn le(self, other: Self) -> Self::Mask {
                TwoMask(Lanes::le(self.0, other.0), Lanes::le(self.1, other.1))
            }
            #[inline(always)]
            fn equal(self, other: Self) -> Self::Mask {
                TwoMask(self.0.equal(other.0), self.1.equal(other.1))
            }
            #[inline(always)]
            fn select(mask: Self::Mask, on: Self, off: Self) -> Self {
                Two(<$half as Lanes>::select(mask.0, on.0, off.0), <$half as Lanes>::select(mask.1, on.1, off.1))
            }
        }
    };
}
two!(f32x8);
two!(f64x4);
