//! Regression of the correction on the marched picture.
//!
//! What a surrogate errs depends on what it shows: nodes smooth a ridge, so its crest is missing where the picture is brighter than its surroundings.
//! Of the correction that is a linear function of the picture's details, whose coefficients all pixels give together (control variates with estimated
//! coefficients; Rousselle et al. 2016 do so for pictures). It has nearly no noise. Coarse parts of the correction, which samples show soon, are left to
//! the shrinkage: with them as features too, they decide the coefficients, and details get worse.
//! Coefficients are those of one half of the samples, so that the other half remains independent of what is shown.

use super::combine::{PairSums, b3};
use super::march::RaySum;
use nalgebra::{SMatrix, SVector};
use rayon::prelude::*;

/// Of a pixel of the marched picture: radiance, opacity, opacity times mean FTLE, and that times radiance.
type Guide = [f32; 8];
/// Per channel: those four, less those of the picture around the pixel.
const FEATURES: usize = 4;
/// Spacings of the filter that gives the picture around a pixel. One less and one more were worse where a node covers two and three pixels.
const SPACINGS: [usize; 2] = [1, 2];
/// Added to the diagonal of the normal equations, which is scaled to 1. Features may depend on each other; and as many pairs as `FEW` give half of the
/// coefficient of a single feature, since fewer than some hundred would fit their own noise. Between 3 and 30 it makes little difference.
const RIDGE: f64 = 1e-6;
const FEW: f64 = 10.0;

type Coefficients = SVector<f64, FEATURES>;
/// Matrix of the normal equations, right-hand sides of both halves, pairs.
type NormalSums = (SMatrix<f64, FEATURES, FEATURES>, [Coefficients; 2], f64);

/// The features of a marched picture.
pub struct Guides {
    own: Vec<Guide>,
    around: Vec<Guide>,
    pub(super) width: usize,
}

impl Guides {
    /// Of sums over `rays` rays a pixel, rows of `width` pixels.
    pub fn new(base: &[RaySum], rays: u64, width: usize) -> Self {
        let per_ray = 1.0 / rays.max(1) as f32;
        let guide = |sum: &RaySum| {
            let [red, green, blue] = sum.radiance;
            let ftle = sum.ftle * per_ray;
            [red, green, blue, sum.alpha, sum.ftle, ftle * red, ftle * green, ftle * blue].map(|value| value * per_ray)
        };
        let own: Vec<Guide> = base.par_iter().with_min_len(1 << 12).map(guide).collect();
        let mut around = own.clone();
        for spacing in SPACINGS {
            around = b3(&b3(&around, width, spacing, true), width, spacing, false);
        }
        Self { own, around, width }
    }

    /// Returns true if anything is shown around the pixel.
    fn shows(&self, pixel: usize) -> bool {
        self.around[pixel][3] > 0.0
    }

    /// Features of each channel; all of them 0 where nothing is shown around the pixel.
    fn features(&self, pixel: usize) -> [[f32; FEATURES]; 3] {
        if !self.shows(pixel) {
            return [[0.0; FEATURES]; 3];
        }
        let (own, around) = (&self.own[pixel], &self.around[pixel]);
        std::array::from_fn(|k| [k, 3, 4, 5 + k].map(|guide| own[guide] - around[guide]))
    }

    /// Coefficients of both halves: least squares over pixels and channels, each pixel weighted by its pairs.
    pub(super) fn fit(&self, sums: &[PairSums]) -> [Coefficients; 2] {
        let zero = || (SMatrix::zeros(), [Coefficients::zeros(); 2], 0.0);
        let row = |(row, sums): (usize, &[PairSums])| {
            let mut found: NormalSums = zero();
            let first = row * self.width;
            for (x, sums) in sums.iter().enumerate().filter(|(x, sums)| sums.pairs() > 0 && self.shows(first + x)) {
                found.2 += f64::from(sums.pairs());
                for (k, features) in self.features(first + x).iter().enumerate() {
                    let features = Coefficients::from_fn(|i, _| f64::from(features[i]));
                    found.0.ger(f64::from(sums.pairs()), &features, &features, 1.0);
                    for half in 0..2 {
                        let sum = sums.radiance[half][0][k] + sums.radiance[half][1][k];
                        found.1[half].axpy(f64::from(sum), &features, 1.0);
                    }
                }
            }
            found
        };
        // Sums of rows in their order are the same on any number of threads.
        let rows: Vec<NormalSums> = sums.par_chunks(self.width).enumerate().map(row).collect();
        let add = |sum: NormalSums, row: NormalSums| (sum.0 + row.0, [0, 1].map(|half| sum.1[half] + row.1[half]), sum.2 + row.2);
        let (mut matrix, right, pairs) = rows.into_iter().fold(zero(), add);
        // Features have units of their own.
        let scale = matrix.diagonal().map(|square| if square > 0.0 { square.sqrt().recip() } else { 0.0 });
        let ridge = RIDGE + FEW / pairs.max(1.0);
        matrix = SMatrix::from_fn(|i, j| matrix[(i, j)] * scale[i] * scale[j] + if i == j { ridge } else { 0.0 });
        // Positive definite by the ridge, unless sums overflow: then nothing is known of the correction.
        let Some(factors) = matrix.cholesky() else { return [Coefficients::zeros(); 2] };
        right.map(|right| factors.solve(&right.component_mul(&scale)).component_mul(&scale))
    }

    /// The correction that the coefficients of a half give a pixel.
    pub(super) fn correction(&self, pixel: usize, coefficients: &Coefficients) -> [f32; 3] {
        self.features(pixel).map(|features| (0..FEATURES).map(|i| features[i] * coefficients[i] as f32).sum())
    }
}
