//! Lanes: one arithmetic for scalars and vectors, so that each integrator is written once.
//!
//! [`Lanes`] is implemented for `f32`, `f64` (one lane), [`f32x8`], [`f64x4`] and [`Two`] of any of them; a batch of samples is
//! integrated side by side, one sample a lane. [`Gather`] is for lanes that each read their own place of a node array.

use std::fmt::Debug;
use std::mem::MaybeUninit;
use std::ops::{Add, AddAssign, BitAnd, BitOr, Div, Mul, Neg, Not, Sub};
use wide::{f32x4, f32x8, f64x4, u32x8};

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

// Polynomials of sine and cosine, interpolated at Chebyshev nodes. Double precision: |r| <= pi/4; single: |r| <= pi/2.
const SIN_F64: [f64; 6] = [
    -0.16666666666666666,
    0.008333333333330948,
    -0.00019841269836758574,
    2.755731610255244e-06,
    -2.5051131845003624e-08,
    1.5918129294866608e-10,
];
const COS_F64: [f64; 6] = [
    0.041666666666666664,
    -0.0013888888888887398,
    2.480158729876569e-05,
    -2.7557317271729793e-07,
    2.08761462684032e-09,
    -1.1382632425521717e-11,
];
const SIN_F32: [f32; 4] = [-0.166_666_66, 0.008_333_242, -0.000_198_227_4, 2.634_756_4e-6];
const COS_F32: [f32; 5] = [-0.5, 0.041_666_66, -0.001_388_865_2, 2.477_458e-5, -2.629_751_6e-7];
// The same of pi r, |r| <= 1/2; the sine's first coefficient is pi in two parts.
const SIN_PI_F32: [f32; 4] = [-5.167_712_7, 2.550_136, -0.598_704_9, 0.078_539_714];
const COS_PI_F32: [f32; 5] = [-4.934_802, 4.058_711_5, -1.335_240_2, 0.235_074_37, -0.024_627_112];
/// Pi as a sum of two single-precision numbers.
const PI_F32: (f32, f32) = (std::f32::consts::PI, -8.742_278e-8);
/// Pi/2 as a sum of two double-precision numbers.
const HALF_PI_F64: (f64, f64) = (std::f64::consts::FRAC_PI_2, 6.123_233_995_736_766e-17);

/// What the trigonometric functions need beyond arithmetic.
trait Bits: Lanes {
    /// Nearest integer.
    fn nearest(self) -> Self;
    /// self with its sign flipped where `count` (an integer) is odd.
    fn flip_if_odd(self, count: Self) -> Self;
}

/// A polynomial of degree N - 1, by Horner's rule.
#[inline(always)]
fn polynomial<L: Lanes, const N: usize>(coefficients: [L::Real; N], t: L) -> L {
    coefficients[..N - 1].iter().rev().fold(L::splat(coefficients[N - 1]), |sum, &c| sum.mul_add(t, L::splat(c)))
}

/// sin(r) and cos(r) for |r| <= pi/2, times (-1)^n.
#[inline(always)]
fn half_turns<L: Bits<Real = f32>>(r: L, n: L) -> (L, L) {
    let t = r * r;
    let sin = (polynomial(SIN_F32, t) * t).mul_add(r, r);
    let cos = polynomial(COS_F32, t).mul_add(t, L::one());
    (sin.flip_if_odd(n), cos.flip_if_odd(n))
}

/// sin(pi r) and cos(pi r) for |r| <= 1/2, times (-1)^n.
#[inline(always)]
fn half_turns_pi<L: Bits<Real = f32>>(r: L, n: L) -> (L, L) {
    let t = r * r;
    let sin = L::splat(PI_F32.0).mul_add(r, polynomial(SIN_PI_F32, t).mul_add(t, L::splat(PI_F32.1)) * r);
    let cos = polynomial(COS_PI_F32, t).mul_add(t, L::one());
    (sin.flip_if_odd(n), cos.flip_if_odd(n))
}

/// sin and cos of r + n pi/2 for |r| <= pi/4.
#[inline(always)]
fn quarter_turns<L: Bits<Real = f64>>(r: L, n: L) -> (L, L) {
    let c = L::splat;
    let t = r * r;
    let sin = (polynomial(SIN_F64, t) * t).mul_add(r, r);
    let cos = (polynomial(COS_F64, t) * t).mul_add(t, (-t).mul_add(c(0.5), c(1.0)));
    // n = 2 h + q with q in {0, 1}: q swaps, h flips both signs, q flips the cosine's.
    let half = (n * c(0.5)).floor();
    let odd = L::lt(c(0.25), n * c(0.5) - half);
    let (s, k) = (L::select(odd, cos, sin), L::select(odd, -sin, cos));
    (s.flip_if_odd(half), k.flip_if_odd(half))
}

macro_rules! trigonometry {
    (f32) => {
        #[inline(always)]
        fn sin_cos(self) -> (Self, Self) {
            let n = (self * Self::splat(std::f32::consts::FRAC_1_PI)).nearest();
            let r = (-n).mul_add(Self::splat(PI_F32.1), (-n).mul_add(Self::splat(PI_F32.0), self));
            half_turns(r, n)
        }
        #[inline(always)]
        fn sin_cos_pi(self) -> (Self, Self) {
            let n = self.nearest();
            half_turns_pi(self - n, n)
        }
    };
    (f64) => {
        #[inline(always)]
        fn sin_cos(self) -> (Self, Self) {
            let n = (self * Self::splat(std::f64::consts::FRAC_2_PI)).nearest();
            let r = (-n).mul_add(Self::splat(HALF_PI_F64.1), (-n).mul_add(Self::splat(HALF_PI_F64.0), self));
            quarter_turns(r, n)
        }
        #[inline(always)]
        fn sin_cos_pi(self) -> (Self, Self) {
            let n = (self + self).nearest();
            quarter_turns((-n).mul_add(Self::splat(0.5), self) * Self::splat(std::f64::consts::PI), n)
        }
    };
}

impl Mask for bool {
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
            #[inline(always)]
            fn mul_add(self, a: Self, b: Self) -> Self {
                $real::mul_add(self, a, b)
            }
            #[inline(always)]
            fn sqrt(self) -> Self {
                $real::sqrt(self)
            }
            #[inline(always)]
            fn abs(self) -> Self {
                $real::abs(self)
            }
            #[inline(always)]
            fn floor(self) -> Self {
                $real::floor(self)
            }
            #[inline(always)]
            fn min(self, other: Self) -> Self {
                if self < other { self } else { other }
            }
            #[inline(always)]
            fn max(self, other: Self) -> Self {
                if self > other { self } else { other }
            }
            #[inline(always)]
            fn ln(self) -> Self {
                $real::ln(self)
            }
            #[inline(always)]
            fn atan2(self, x: Self) -> Self {
                $real::atan2(self, x)
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
        impl Bits for $real {
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
const MAGIC_F32: f32 = 12_582_912.0;
const MAGIC_F64: f64 = 6_755_399_441_055_744.0;
scalar!(f32, u32, MAGIC_F32);
scalar!(f64, u64, MAGIC_F64);

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

impl NodePair for f32x8 {
    #[inline(always)]
    unsafe fn adjacent(first: *const [f32; 4]) -> Self {
        // SAFETY: the caller vouches for both nodes, which are 8 contiguous numbers; the read need not be aligned.
        f32x8::new(unsafe { first.cast::<[f32; 8]>().read_unaligned() })
    }
    #[inline(always)]
    fn joined(a: [f32; 4], b: [f32; 4]) -> Self {
        f32x8::new([a[0], a[1], a[2], a[3], b[0], b[1], b[2], b[3]])
    }
    #[inline(always)]
    fn repeat(four: [f32; 4]) -> Self {
        Self::joined(four, four)
    }
    #[inline(always)]
    fn spread(first: f32, second: f32) -> Self {
        Self::joined([first; 4], [second; 4])
    }
}

impl NodePair for Two<f64x4> {
    #[inline(always)]
    unsafe fn adjacent(first: *const [f32; 4]) -> Self {
        // SAFETY: the caller vouches for both nodes.
        unsafe { Self::joined(first.read(), first.add(1).read()) }
    }
    #[inline(always)]
    fn joined(a: [f32; 4], b: [f32; 4]) -> Self {
        Two(f64x4::new(a.map(f64::from)), f64x4::new(b.map(f64::from)))
    }
    #[inline(always)]
    fn repeat(four: [f64; 4]) -> Self {
        Two(f64x4::new(four), f64x4::new(four))
    }
    #[inline(always)]
    fn spread(first: f64, second: f64) -> Self {
        Two(f64x4::splat(first), f64x4::splat(second))
    }
}

impl Gather for f32x8 {
    type Pair = f32x8;
    type Cells = u32x8;
    #[inline(always)]
    fn truncate(self, last: u32) -> (u32x8, Self) {
        // Out of range and NaN become 0x80000000, which the minimum takes down to `last`.
        let integer = u32x8::from_bits_of_signed(self.fast_trunc_int()).min(u32x8::splat(last));
        (integer, f32x8::from_i32x8(integer.into_signed()))
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
    fn gather<const K: usize>(rows: &impl Rows<f32x8, K>) -> [[Self; 8]; K] {
        let mut table = [const { MaybeUninit::<[f32x8; K]>::uninit() }; 8];
        for (lane, slot) in table.iter_mut().enumerate() {
            slot.write(rows.rows(lane));
        }
        // SAFETY: the loop wrote all.
        let table = unsafe { written(table) };
        array(|k| f32x8::transpose(array(|lane| table[lane][k])))
    }
}

/// Between signed and unsigned vectors.
trait Signed<S> {
    fn from_bits_of_signed(signed: S) -> Self;
    fn into_signed(self) -> S;
}
impl Signed<wide::i32x8> for u32x8 {
    #[inline(always)]
    fn from_bits_of_signed(signed: wide::i32x8) -> Self {
        // SAFETY: both are plain vectors of the same size in which every bit pattern is a value.
        unsafe { std::mem::transmute::<wide::i32x8, Self>(signed) }
    }
    #[inline(always)]
    fn into_signed(self) -> wide::i32x8 {
        // SAFETY: as above.
        unsafe { std::mem::transmute::<Self, wide::i32x8>(self) }
    }
}

impl Gather for f64x4 {
    type Pair = Two<f64x4>;
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
    fn gather<const K: usize>(rows: &impl Rows<Two<f64x4>, K>) -> [[Self; 8]; K] {
        let mut table = [const { MaybeUninit::<[Two<f64x4>; K]>::uninit() }; 4];
        for (lane, slot) in table.iter_mut().enumerate() {
            slot.write(rows.rows(lane));
        }
        // SAFETY: the loop wrote all.
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
            fn gather<const K: usize>(rows: &impl Rows<Self::Pair, K>) -> [[Self; 8]; K] {
                let pairs = rows.rows(0);
                array(|k| array(|i| pairs[k].lane(i)))
            }
        }
    };
}
scalar_gather!(f32, f32x8);
scalar_gather!(f64, Two<f64x4>);

#[cfg(test)]
mod tests {
    use super::*;

    /// Worst absolute error of sin_cos and sin_cos_pi over a few turns.
    fn worst<L: Lanes>() -> f64 {
        let mut worst = 0.0f64;
        for k in 0..40_000 {
            let x = L::from_fn(|lane| L::Real::from_f64(f64::from(k) * 5e-4 - 10.0 + lane as f64 * 1e-5));
            let (sin, cos) = x.sin_cos();
            let (sin_pi, cos_pi) = x.sin_cos_pi();
            for lane in 0..L::LANES {
                let exact = x.lane(lane).to_f64();
                // pi times the argument, reduced exactly before it is rounded.
                let turned = std::f64::consts::PI * (exact - 2.0 * (exact * 0.5).round());
                for (found, expected) in [(sin, exact.sin()), (cos, exact.cos()), (sin_pi, turned.sin()), (cos_pi, turned.cos())] {
                    worst = worst.max((found.lane(lane).to_f64() - expected).abs());
                }
            }
        }
        worst
    }

    #[test]
    fn sine_and_cosine() {
        // One and a half (in double precision three) ulps of 1; the reference itself rounds an argument of up to pi.
        assert!(worst::<f32>() < 1.8e-7, "{}", worst::<f32>());
        assert!(worst::<f32x8>() < 1.8e-7, "{}", worst::<f32x8>());
        assert!(worst::<f64>() < 6e-16, "{}", worst::<f64>());
        assert!(worst::<f64x4>() < 6e-16, "{}", worst::<f64x4>());
        assert!(worst::<Two<f64x4>>() < 6e-16);
    }

    #[test]
    fn truncation_stays_in_range() {
        let odd = [-1.0, -0.3, 0.0, 3.7, 9.9, 1e30, f32::NAN, f32::NEG_INFINITY];
        let (cells, real) = f32x8::new(odd).truncate(9);
        for lane in 0..8 {
            let cell = f32x8::cell(&cells, lane);
            assert!(cell <= 9);
            assert_eq!(real.to_array()[lane], cell as f32);
            assert!(f64::cell(&f64::from(odd[lane]).truncate(9).0, 0) <= 9);
        }
        assert_eq!(f32x8::cell(&cells, 3), 3);
    }

    #[test]
    fn gathered_components_are_where_they_belong() {
        struct Counting;
        impl<P: NodePair> Rows<P, 1> for Counting {
            fn rows(&self, lane: usize) -> [P; 1] {
                let at = |component: usize| (10 * lane + component) as f32;
                [P::joined([0, 1, 2, 3].map(at), [4, 5, 6, 7].map(at))]
            }
        }
        fn check<L: Gather>() {
            let [rows] = L::gather(&Counting);
            for lane in 0..L::LANES {
                for component in 0..8 {
                    assert_eq!(rows[component].lane(lane).to_f64(), (10 * lane + component) as f64);
                }
            }
        }
        check::<f32>();
        check::<f64>();
        check::<f32x8>();
        check::<f64x4>();
    }
}
