//! Lanes: one arithmetic for scalars and vectors, so that each integrator is written once.
//!
//! [`Lanes`] is implemented for `f32`, `f64` (one lane), [`wide::f32x8`], [`wide::f64x4`] and [`Two`] of any of them; a batch of samples is
//! integrated side by side, one sample a lane. [`Gather`] is for lanes that each read their own place of a node array.

mod gather;
mod scalar;
#[cfg(test)]
mod tests;
mod trigonometry;
mod two;
mod vector;

pub use two::{Two, TwoMask};
pub use vector::VectorMask;

use std::fmt::Debug;
use std::mem::MaybeUninit;
use std::ops::{Add, AddAssign, BitAnd, BitOr, Div, Mul, Neg, Not, Sub};

/// `[f(0), f(1), ...]`. Kernels use this instead of `std::array::from_fn`, whose machinery the compiler leaves as calls once a kernel
/// is large.
#[inline(always)]
pub fn array<T, const N: usize>(mut f: impl FnMut(usize) -> T) -> [T; N] {
    let mut out = [const { MaybeUninit::uninit() }; N];
    for (i, slot) in out.iter_mut().enumerate() {
        slot.write(f(i));
    }
    // SAFETY: all N elements are written. (When `f` panics, what is written is leaked.)
    unsafe { written(out) }
}

/// # Safety
/// Every element must have been written.
#[inline(always)]
unsafe fn written<T, const N: usize>(array: [MaybeUninit<T>; N]) -> [T; N] {
    // SAFETY: the caller's; an array of `MaybeUninit<T>` has the layout of one of `T`.
    unsafe { (&raw const array).cast::<[T; N]>().read() }
}

/// A truth value a lane.
pub trait Mask: Copy + BitAnd<Output = Self> + BitOr<Output = Self> + Not<Output = Self> {
    /// Every lane the same.
    fn splat(value: bool) -> Self;
    /// Whether some lane is true.
    fn any(self) -> bool;
    /// Whether all lanes are true.
    fn all(self) -> bool;
    /// One lane.
    fn lane(self, index: usize) -> bool;
}

/// Several real numbers of one type, computed with side by side. Comparisons with NaN are false.
pub trait Lanes:
    Copy
    + Debug
    + Send
    + Sync
    + 'static
    + Add<Output = Self>
    + Sub<Output = Self>
    + Mul<Output = Self>
    + Div<Output = Self>
    + Neg<Output = Self>
    + AddAssign
{
    /// Type of one lane.
    type Real: Real;
    /// Result of a comparison.
    type Mask: Mask;
    /// Number of lanes.
    const LANES: usize;

    /// Every lane the same.
    fn splat(value: Self::Real) -> Self;
    /// Lane `i` is `f(i)`.
    fn from_fn(f: impl FnMut(usize) -> Self::Real) -> Self;
    /// One lane.
    fn lane(self, index: usize) -> Self::Real;
    /// self * a + b, rounded once where the machine can.
    fn mul_add(self, a: Self, b: Self) -> Self;
    /// Square root.
    fn sqrt(self) -> Self;
    /// |self|.
    fn abs(self) -> Self;
    /// Greatest integer not above.
    fn floor(self) -> Self;
    /// The smaller; `other` where either is NaN.
    fn min(self, other: Self) -> Self;
    /// The larger; `other` where either is NaN.
    fn max(self, other: Self) -> Self;
    /// Natural logarithm.
    fn ln(self) -> Self;
    /// Angle of the vector (x, self), in (-pi, pi].
    fn atan2(self, x: Self) -> Self;
    /// Sine and cosine of an angle in radians. Absolute error about 1.5e-7 in single, 3e-16 in double precision (plus half an ulp
    /// of the argument); arguments beyond 2^22 (single) or 2^50 (double) half turns have no meaning.
    fn sin_cos(self) -> (Self, Self);
    /// Sine and cosine of pi times self; the range reduction is exact.
    fn sin_cos_pi(self) -> (Self, Self);
    /// self < other.
    fn lt(self, other: Self) -> Self::Mask;
    /// self <= other.
    fn le(self, other: Self) -> Self::Mask;
    /// self == other.
    fn equal(self, other: Self) -> Self::Mask;
    /// `on` where the mask is true, `off` elsewhere.
    fn select(mask: Self::Mask, on: Self, off: Self) -> Self;

    /// Every lane the same, from double precision.
    #[inline(always)]
    fn of(value: f64) -> Self {
        Self::splat(Self::Real::from_f64(value))
    }
    /// Zero.
    #[inline(always)]
    fn zero() -> Self {
        Self::of(0.0)
    }
    /// One.
    #[inline(always)]
    fn one() -> Self {
        Self::of(1.0)
    }
    /// Which lanes are not NaN.
    #[inline(always)]
    fn is_number(self) -> Self::Mask {
        self.equal(self)
    }
}

/// One real number.
pub trait Real: Lanes<Real = Self, Mask = bool> + PartialOrd {
    /// Rounded from double precision.
    fn from_f64(value: f64) -> Self;
    /// To double precision, exactly.
    fn to_f64(self) -> f64;
    /// Next representable number above.
    fn above(self) -> Self;
    /// Next representable number below.
    fn below(self) -> Self;
}

/// Two nodes of a velocity array side by side: `[u, v, w, mark, u', v', w', mark']`.
pub trait NodePair: Lanes {
    /// The nodes at `first` and right behind it.
    ///
    /// # Safety
    /// Both nodes must be readable.
    unsafe fn adjacent(first: *const [f32; 4]) -> Self;
    /// Two nodes from different places.
    fn joined(first: [f32; 4], second: [f32; 4]) -> Self;
    /// The same four numbers for both nodes.
    fn repeat(four: [Self::Real; 4]) -> Self;
    /// One number for all of the first node, another for all of the second.
    fn spread(first: Self::Real, second: Self::Real) -> Self;
    /// The second node in both places.
    fn second_twice(self) -> Self;
}

/// Lanes that each read their own place of a node array.
pub trait Gather: Lanes {
    /// Two nodes in this precision.
    type Pair: NodePair<Real = Self::Real>;
    /// An index a lane.
    type Cells: Copy;
    /// Integer part, limited to [0, last] whatever the lane holds (also NaN), and the same as a real number.
    fn truncate(self, last: u32) -> (Self::Cells, Self);
    /// outer * stride + inner.
    fn flatten(outer: Self::Cells, stride: u32, inner: Self::Cells) -> Self::Cells;
    /// One lane's index.
    fn cell(cells: &Self::Cells, lane: usize) -> u32;
    /// Indices lane by lane.
    fn cells_from_fn(f: impl FnMut(usize) -> u32) -> Self::Cells;
    /// Reads K node pairs for each lane and turns them into lanes: `[k][component]`, components 0 to 3 of the first node and 4 to
    /// 7 of the second.
    fn gather<const K: usize>(rows: &impl Rows<Self::Pair, K>) -> [[Self; 8]; K];
}

/// The node pairs that one lane wants. (A trait, since a closure cannot be told to be inlined.)
pub trait Rows<P, const K: usize> {
    /// K node pairs for a lane.
    fn rows(&self, lane: usize) -> [P; K];
}
