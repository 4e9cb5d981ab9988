//! Two vectors side by side.

use super::{Lanes, Mask};
use std::ops::{Add, AddAssign, BitAnd, BitOr, Div, Mul, Neg, Not, Sub};

/// Twice the lanes. The two independent chains of instructions hide each other's latency.
#[derive(Debug, Clone, Copy)]
pub struct LanePair<L>(pub L, pub L);

macro_rules! operators {
    ($($trait:ident $method:ident($($other:ident)?)),*) => {$(
        impl<L: $trait<Output = L>> $trait for LanePair<L> {
            type Output = Self;
            #[inline(always)]
            fn $method(self $(, $other: Self)?) -> Self {
                LanePair(self.0.$method($($other.0)?), self.1.$method($($other.1)?))
            }
        }
    )*};
}
operators!(Add add(other), Sub sub(other), Mul mul(other), Div div(other), BitAnd bitand(other), BitOr bitor(other), Neg neg(), Not not());

impl<L: AddAssign> AddAssign for LanePair<L> {
    #[inline(always)]
    fn add_assign(&mut self, other: Self) {
        self.0 += other.0;
        self.1 += other.1;
    }
}

impl<M: Mask> Mask for LanePair<M> {
    const LANES: usize = 2 * M::LANES;
    #[inline(always)]
    fn splat(value: bool) -> Self {
        LanePair(M::splat(value), M::splat(value))
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
        if index < M::LANES { self.0.lane(index) } else { self.1.lane(index - M::LANES) }
    }
}

/// Methods that apply to each half.
macro_rules! halves {
    ($($method:ident($($other:ident),*) -> $result:ty),*) => {$(
        #[inline(always)]
        fn $method(self $(, $other: Self)*) -> $result {
            LanePair(self.0.$method($($other.0),*), self.1.$method($($other.1),*))
        }
    )*};
}

impl<L: Lanes> Lanes for LanePair<L> {
    type Real = L::Real;
    type Mask = LanePair<L::Mask>;
    const LANES: usize = 2 * L::LANES;
    #[inline(always)]
    fn splat(value: Self::Real) -> Self {
        LanePair(L::splat(value), L::splat(value))
    }
    #[inline(always)]
    fn from_fn(mut f: impl FnMut(usize) -> Self::Real) -> Self {
        LanePair(L::from_fn(&mut f), L::from_fn(|i| f(i + L::LANES)))
    }
    #[inline(always)]
    fn lane(self, index: usize) -> Self::Real {
        if index < L::LANES { self.0.lane(index) } else { self.1.lane(index - L::LANES) }
    }
    halves!(mul_add(a, b) -> Self, sqrt() -> Self, abs() -> Self, floor() -> Self, min(other) -> Self, max(other) -> Self);
    halves!(ln() -> Self, atan2(x) -> Self, lt(other) -> Self::Mask, le(other) -> Self::Mask, equal(other) -> Self::Mask);
    #[inline(always)]
    fn sin_cos(self) -> (Self, Self) {
        let (a, b) = (self.0.sin_cos(), self.1.sin_cos());
        (LanePair(a.0, b.0), LanePair(a.1, b.1))
    }
    #[inline(always)]
    fn sin_cos_pi(self) -> (Self, Self) {
        let (a, b) = (self.0.sin_cos_pi(), self.1.sin_cos_pi());
        (LanePair(a.0, b.0), LanePair(a.1, b.1))
    }
    #[inline(always)]
    fn select(mask: Self::Mask, on: Self, off: Self) -> Self {
        LanePair(L::select(mask.0, on.0, off.0), L::select(mask.1, on.1, off.1))
    }
}
