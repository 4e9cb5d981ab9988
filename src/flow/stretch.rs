//! The log-stretch of a flow map's gradient J: ln of its largest singular value, which is |tau| FTLE (Shadden, Lekien and Marsden 2005).

use ridgewatch_simd::{Lanes, Mask, array};

/// Returns ln sigma_max of a 2x2 or 3x3 matrix; minus infinity for the zero matrix.
#[inline(always)]
pub fn log_stretch<L: Lanes, const C: usize>(m: &[[L; C]; C]) -> L {
    // Squares stay in range if the largest entry is scaled to 1.
    let size = max_abs(m);
    let scale = L::one() / L::select(L::lt(L::zero(), size), size, L::one());
    let scaled: [[L; C]; C] = array(|i| array(|j| m[i][j] * scale));
    let sigma = if C == 2 { sigma_max_2(&scaled) } else { sigma_max_3(&scaled) };
    sigma.ln() - scale.ln()
}

/// Largest absolute value of the entries.
#[inline(always)]
pub fn max_abs<L: Lanes, const C: usize, const D: usize>(m: &[[L; C]; D]) -> L {
    let mut size = L::zero();
    for row in m {
        for entry in row {
            size = entry.abs().max(size);
        }
    }
    size
}

/// sigma_max = (|(a + d, b - c)| + |(a - d, b + c)|) / 2, since a matrix is the sum of a scaled rotation and a scaled reflection. The formula
/// has no cancellation.
#[inline(always)]
fn sigma_max_2<L: Lanes, const C: usize>(m: &[[L; C]; C]) -> L {
    let ([a, b], [c, d]) = ([m[0][0], m[0][1]], [m[1][0], m[1][1]]);
    let length = |x: L, y: L| x.mul_add(x, y * y).sqrt();
    (length(a + d, b - c) + length(a - d, b + c)) * L::splat_f64(0.5)
}

/// Cyclic Jacobi sweeps over the Cauchy-Green tensor J^T J. They converge quadratically. Unlike the trigonometric solution of the
/// characteristic polynomial they stay accurate if the two largest eigenvalues are close.
#[inline(always)]
fn sigma_max_3<L: Lanes, const C: usize>(m: &[[L; C]; C]) -> L {
    const SWEEPS: usize = 5;
    let product = |i: usize, j: usize| m[0][i].mul_add(m[0][j], m[1][i].mul_add(m[1][j], m[2][i] * m[2][j]));
    let mut diagonal = [product(0, 0), product(1, 1), product(2, 2)];
    // Entry k is the off-diagonal entry that lies in neither row k nor column k.
    let mut off = [product(1, 2), product(0, 2), product(0, 1)];
    let tiny = L::splat_f64(1e-30);
    for _ in 0..SWEEPS {
        for (p, q, r) in [(0, 1, 2), (0, 2, 1), (1, 2, 0)] {
            // t is the tangent of the smaller angle that makes entry (p, q) vanish.
            let twice = off[r] + off[r];
            let difference = diagonal[q] - diagonal[p];
            let root = difference.mul_add(difference, twice * twice).sqrt();
            let sign = L::select(L::lt(difference, L::zero()), -L::one(), L::one());
            let t = sign * twice / (difference.abs() + root + tiny);
            let cosine = L::one() / t.mul_add(t, L::one()).sqrt();
            let sine = t * cosine;
            diagonal[p] = (-t).mul_add(off[r], diagonal[p]);
            diagonal[q] = t.mul_add(off[r], diagonal[q]);
            off[r] = L::zero();
            // Entries (r, p) and (r, q) are stored as off[q] and off[p].
            let (rp, rq) = (off[q], off[p]);
            off[q] = cosine.mul_add(rp, -(sine * rq));
            off[p] = sine.mul_add(rp, cosine * rq);
        }
    }
    diagonal[0].max(diagonal[1]).max(diagonal[2]).max(L::zero()).sqrt()
}

/// Factor (2^40) by which tangents are rescaled before they overflow.
const RESCALE: f64 = 1_099_511_627_776.0;

/// Rescales tangents beyond [`RESCALE`] and adds the binary logarithm of the factor to `exponent`.
#[inline(always)]
pub fn rescale<L: Lanes, const C: usize, const D: usize>(m: &mut [[L; C]; D], exponent: &mut L) {
    let size = max_abs(m);
    let (low, high) = (L::splat_f64(1.0 / RESCALE), L::splat_f64(RESCALE));
    let (small, large) = (L::lt(size, low), L::lt(high, size));
    if (small | large).any() {
        let factor = L::select(large, low, L::select(small, high, L::one()));
        for row in m.iter_mut() {
            for entry in row.iter_mut() {
                *entry = *entry * factor;
            }
        }
        let log_factor = L::splat_f64(RESCALE.log2());
        *exponent += L::select(large, log_factor, L::select(small, -log_factor, L::zero()));
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use ridgewatch_simd::Real;
    use wide::{f32x8, f64x4};

    /// Deterministic numbers in (-1, 1).
    fn numbers(count: usize) -> Vec<f64> {
        (0..count).map(|i| ((i as f64 + 1.0) * 0.754_877_666_246_69).fract() * 2.0 - 1.0).collect()
    }

    fn library<const C: usize>(m: [[f64; C]; C]) -> f64 {
        nalgebra::DMatrix::from_fn(C, C, |i, j| m[i][j]).singular_values().max().ln()
    }

    fn check<L: Lanes, const C: usize>(tolerance: f64) {
        let random = numbers(40 * 9);
        let mut cases: Vec<[[f64; C]; C]> = (0..40)
            .map(|n| {
                // Stretched by up to 2^20, so that eigenvalues of C are far apart.
                std::array::from_fn(|i| std::array::from_fn(|j| random[9 * n + 3 * i + j] * f64::from(1 << (n / 2)).powi(i as i32)))
            })
            .collect();
        cases.push(std::array::from_fn(|i| std::array::from_fn(|j| f64::from(u8::from(i == j)))));
        cases.push(std::array::from_fn(|i| std::array::from_fn(|j| if i == j { [7.0, 7.0, 0.02][i] } else { 0.0 })));
        cases.push(std::array::from_fn(|i| std::array::from_fn(|j| if i == j { [7.0, 7.0 + 1e-9, 0.02][i] } else { 1e-9 })));
        cases.push([[1.0; C]; C]);
        for case in cases {
            let lanes: [[L; C]; C] = case.map(|row| row.map(L::splat_f64));
            let expected = library(lanes.map(|row| row.map(|entry| entry.lane(0).to_f64())));
            let found = log_stretch(&lanes).lane(L::LANES - 1).to_f64();
            assert!((found - expected).abs() < tolerance * expected.abs().max(1.0), "{case:?}: {found} {expected}");
        }
    }

    #[test]
    fn equals_a_library() {
        // A few ulps.
        check::<f64, 2>(2e-15);
        check::<f64x4, 2>(2e-15);
        check::<f64, 3>(4e-15);
        check::<f64x4, 3>(4e-15);
        check::<f32, 3>(2e-6);
        check::<f32x8, 2>(1e-6);
        check::<f32x8, 3>(2e-6);
    }

    #[test]
    fn extremes_stay_finite() {
        for size in [1e-30f32, 1e30] {
            let m = [[size, 0.0, 0.0], [0.0, -size, size], [0.0, 0.0, size]].map(|row| row.map(f32x8::splat));
            let expected = f64::from(size).ln() + ((1.0 + 5f64.sqrt()) / 2.0).ln();
            assert!((f64::from(log_stretch(&m).to_array()[3]) - expected).abs() < 1e-5, "an ulp of 70 is 8e-6");
        }
        assert_eq!(log_stretch(&[[0.0f64; 3]; 3]), f64::NEG_INFINITY);
    }
}
