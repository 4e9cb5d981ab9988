//! Lanes: one arithmetic for scalars and vectors, so that each integrator is written once.
//!
//! [`Lanes`] is implemented for `f32`, `f64` (one lane), [`wide::f32x8`], [`wide::f64x4`] and [`LanePair`] of any of them. A batch of samples
//! is integrated side by side, one sample per lane. [`Gather`] is for lanes that each read their own nodes of a node array.

mod gather;
mod lane_pair;
mod scalar;
#[cfg(test)]
mod tests;
mod trigonometry;
mod vector;

pub use lane_pair::LanePair;
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
    // SAFETY: all N elements are written. (If `f` panics, the elements written so far are leaked.)
    unsafe { written(out) }
}

/// # Safety
/// Every element must have been written.
#[inline(always)]
unsafe fn written<T, const N: usize>(array: [MaybeUninit<T>; N]) -> [T; N] {
    // SAFETY: the caller's; an array of `MaybeUninit<T>` has the layout of one of `T`.
    unsafe { (&raw const array).cast::<[T; N]>().read() }
}

/// Implements methods of [`Lanes`] by the type's inherent methods of the same name.
macro_rules! inherent {
    ($type:ident: $($method:ident($($argument:ident),*)),*) => {$(
        #[inline(always)]
        fn $method(self $(, $argument: Self)*) -> Self {
            $type::$method(self $(, $argument)*)
        }
    )*};
}
use inherent;

/// Reinterprets the bits of a value as another type.
///
/// # Safety
/// Both types have the same size, and every bit pattern is a value of `T`.
unsafe trait SameBits<T>: Copy {
    #[inline(always)]
    fn same_bits(self) -> T {
        const { assert!(size_of::<Self>() == size_of::<T>()) };
        // SAFETY: the implementor guarantees it.
        unsafe { std::mem::transmute_copy(&self) }
    }
}

/// One truth value per lane.
pub trait Mask: Copy + BitAnd<Output = Self> + BitOr<Output = Self> + Not<Output = Self> {
    /// Number of lanes.
    const LANES: usize;
    /// The same value in every lane.
    fn splat(value: bool) -> Self;
    /// True if some lane is true.
    fn any(self) -> bool;
    /// True if all lanes are true.
    fn all(self) -> bool;
    /// Value of one lane.
    fn lane(self, index: usize) -> bool;
}

/// Several real numbers of one type, on which every operation acts lane by lane. Comparisons with NaN are false.
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

    /// The same value in every lane.
    fn splat(value: Self::Real) -> Self;
    /// Lane `i` is `f(i)`.
    fn from_fn(f: impl FnMut(usize) -> Self::Real) -> Self;
    /// Value of one lane.
    fn lane(self, index: usize) -> Self::Real;
    /// self * a + b, rounded once where the processor can do so.
    fn mul_add(self, a: Self, b: Self) -> Self;
    /// Square root.
    fn sqrt(self) -> Self;
    /// |self|.
    fn abs(self) -> Self;
    /// Greatest integer not above.
    fn floor(self) -> Self;
    /// Minimum; `other` if either is NaN.
    fn min(self, other: Self) -> Self;
    /// Maximum; `other` if either is NaN.
    fn max(self, other: Self) -> Self;
    /// Natural logarithm.
    fn ln(self) -> Self;
    /// Angle of the vector (x, self), in (-pi, pi].
    fn atan2(self, x: Self) -> Self;
    /// Sine and cosine of an angle in radians. The absolute error is about 1.5e-7 in single and 3e-16 in double precision, plus half
    /// an ulp of the argument. The result has no meaning beyond 2^22 (single) or 2^50 (double) half turns.
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

    /// The same value in every lane, rounded from double precision.
    #[inline(always)]
    fn splat_f64(value: f64) -> Self {
        Self::splat(Self::Real::from_f64(value))
    }
    /// Zero.
    #[inline(always)]
    fn zero() -> Self {
        Self::splat_f64(0.0)
    }
    /// One.
    #[inline(always)]
    fn one() -> Self {
        Self::splat_f64(1.0)
    }
    /// True in lanes that are not NaN.
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
    /// Loads the node at `first` and the next one.
    ///
    /// # Safety
    /// Both nodes must be readable.
    unsafe fn load_adjacent(first: *const [f32; 4]) -> Self;
    /// Two nodes that need not be adjacent in memory.
    fn from_nodes(first: [f32; 4], second: [f32; 4]) -> Self;
    /// The same four numbers for both nodes.
    fn repeat(four: [Self::Real; 4]) -> Self;
    /// Fills the first node with `first` and the second with `second`.
    fn splat_nodes(first: Self::Real, second: Self::Real) -> Self;
    /// The second node twice.
    fn repeat_second(self) -> Self;
}

/// Lanes that each read their own nodes of a node array.
pub trait Gather: Lanes {
    /// Two nodes in the precision of the lanes.
    type Pair: NodePair<Real = Self::Real>;
    /// One index per lane.
    type Cells: Copy;
    /// Integer part, limited to [0, last] for every input including NaN, as an index and as a real number.
    fn truncate(self, last: u32) -> (Self::Cells, Self);
    /// outer * stride + inner.
    fn flatten(outer: Self::Cells, stride: u32, inner: Self::Cells) -> Self::Cells;
    /// Index of one lane.
    fn cell(cells: &Self::Cells, lane: usize) -> u32;
    /// Index of lane `i` is `f(i)`.
    fn cells_from_fn(f: impl FnMut(usize) -> u32) -> Self::Cells;
    /// Reads K node pairs per lane and transposes them into lanes: `[k][component]`. Components 0 to 3 belong to the first node, 4 to
    /// 7 to the second.
    fn gather<const K: usize>(reader: &impl NodePairReader<Self::Pair, K>) -> [[Self; 8]; K];
}

/// Reads the node pairs of one lane. A trait, because `inline(always)` cannot be applied to a closure.
pub trait NodePairReader<P, const K: usize> {
    /// K node pairs of a lane.
    fn read_pairs(&self, lane: usize) -> [P; K];
}
