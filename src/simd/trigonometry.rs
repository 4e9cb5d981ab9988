//! Sine and cosine of all lanes at once: Cody-Waite reduction of the argument, then a polynomial.

use super::Lanes;

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
// Polynomials of sin(pi r) and cos(pi r), |r| <= 1/2; the sine's first coefficient is pi in two parts.
const SIN_PI_F32: [f32; 4] = [-5.167_712_7, 2.550_136, -0.598_704_9, 0.078_539_714];
const COS_PI_F32: [f32; 5] = [-4.934_802, 4.058_711_5, -1.335_240_2, 0.235_074_37, -0.024_627_112];
/// Pi as a sum of two single-precision numbers.
pub(super) const PI_F32: (f32, f32) = (std::f32::consts::PI, -8.742_278e-8);
/// Pi/2 as a sum of two double-precision numbers.
pub(super) const HALF_PI_F64: (f64, f64) = (std::f64::consts::FRAC_PI_2, 6.123_233_995_736_766e-17);

/// Rounding and sign flips, which the trigonometric functions need beyond arithmetic.
pub(super) trait RoundingBits: Lanes {
    /// Nearest integer.
    fn nearest(self) -> Self;
    /// Flips the sign of each lane whose `count` (an integer) is odd.
    fn flip_if_odd(self, count: Self) -> Self;
}

/// A polynomial of degree N - 1, by Horner's rule.
#[inline(always)]
fn polynomial<L: Lanes, const N: usize>(coefficients: [L::Real; N], t: L) -> L {
    coefficients[..N - 1].iter().rev().fold(L::splat(coefficients[N - 1]), |sum, &c| sum.mul_add(t, L::splat(c)))
}

/// sin(r) and cos(r) for |r| <= pi/2, times (-1)^n.
#[inline(always)]
pub(super) fn sin_cos_half_turns<L: RoundingBits<Real = f32>>(r: L, n: L) -> (L, L) {
    let t = r * r;
    let sin = (polynomial(SIN_F32, t) * t).mul_add(r, r);
    let cos = polynomial(COS_F32, t).mul_add(t, L::one());
    (sin.flip_if_odd(n), cos.flip_if_odd(n))
}

/// sin(pi r) and cos(pi r) for |r| <= 1/2, times (-1)^n.
#[inline(always)]
pub(super) fn sin_cos_half_turns_pi<L: RoundingBits<Real = f32>>(r: L, n: L) -> (L, L) {
    let t = r * r;
    let sin = L::splat(PI_F32.0).mul_add(r, polynomial(SIN_PI_F32, t).mul_add(t, L::splat(PI_F32.1)) * r);
    let cos = polynomial(COS_PI_F32, t).mul_add(t, L::one());
    (sin.flip_if_odd(n), cos.flip_if_odd(n))
}

/// sin and cos of r + n pi/2 for |r| <= pi/4.
#[inline(always)]
pub(super) fn sin_cos_quarter_turns<L: RoundingBits<Real = f64>>(r: L, n: L) -> (L, L) {
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

/// The trigonometric methods of [`Lanes`], by precision.
macro_rules! trigonometry {
    (f32) => {
        #[inline(always)]
        fn sin_cos(self) -> (Self, Self) {
            let n = (self * Self::splat(std::f32::consts::FRAC_1_PI)).nearest();
            let r = (-n).mul_add(Self::splat(PI_F32.1), (-n).mul_add(Self::splat(PI_F32.0), self));
            sin_cos_half_turns(r, n)
        }
        #[inline(always)]
        fn sin_cos_pi(self) -> (Self, Self) {
            let n = self.nearest();
            sin_cos_half_turns_pi(self - n, n)
        }
    };
    (f64) => {
        #[inline(always)]
        fn sin_cos(self) -> (Self, Self) {
            let n = (self * Self::splat(std::f64::consts::FRAC_2_PI)).nearest();
            let r = (-n).mul_add(Self::splat(HALF_PI_F64.1), (-n).mul_add(Self::splat(HALF_PI_F64.0), self));
            sin_cos_quarter_turns(r, n)
        }
        #[inline(always)]
        fn sin_cos_pi(self) -> (Self, Self) {
            let n = (self + self).nearest();
            sin_cos_quarter_turns((-n).mul_add(Self::splat(0.5), self) * Self::splat(std::f64::consts::PI), n)
        }
    };
}
pub(super) use trigonometry;
