//! The error that a picture states, from sums over tiles.

use bytemuck::{Pod, Zeroable};
use serde::{Deserialize, Serialize};

/// Opacity above which a pixel counts as lit.
pub const LIT: f32 = 0.01;
/// Two-sided 95 % of the normal distribution.
const NORMAL: f64 = 1.96;

/// An estimate with its 95 % interval.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct ErrorEstimate {
    /// Estimate.
    pub value: f64,
    /// Lower end of the 95 % interval.
    pub low: f64,
    /// Upper end of the 95 % interval.
    pub high: f64,
}

impl ErrorEstimate {
    fn map(self, f: impl Fn(f64) -> f64) -> Self {
        Self { value: f(self.value), low: f(self.low), high: f(self.high) }
    }
}

/// Stated error of a picture, against the picture of the traced field without noise.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct PictureError {
    /// Root mean square over lit pixels and channels, linear radiance.
    pub rms: ErrorEstimate,
    /// Mean over lit pixels and channels of squared error / (radiance^2 + 0.01).
    pub relmse: ErrorEstimate,
    /// PSNR of the tone-mapped picture over lit pixels, in decibels, to first order in the error.
    pub psnr: ErrorEstimate,
    /// The same over all pixels.
    pub psnr_all: ErrorEstimate,
    /// Root mean square of the error of marching alone, linear radiance. It is part of the errors above.
    pub march_rms: f64,
    /// Coupled samples per pixel since the picture started anew.
    pub samples_per_pixel: f64,
    /// Marched rays per pixel since then.
    pub rays_per_pixel: u64,
}

/// Sums of squared errors over pixels of a tile. The outer index says which pairs they are from: all, or those of one quarter.
#[repr(C)]
#[derive(Debug, Clone, Copy, Default, PartialEq, Pod, Zeroable)]
pub struct TileErrors {
    /// Squared error, mean over the channels: without weight, divided by radiance^2 + 0.01, and times the squared slope of the tone map.
    pub squared: [[f32; 3]; 3],
    /// Pixels that have such pairs.
    pub pixels: [f32; 3],
}

/// Sums over a tile of 16x16 pixels.
#[repr(C)]
#[derive(Debug, Clone, Copy, Default, PartialEq, Pod, Zeroable)]
pub struct TileSums {
    /// Over all pixels.
    pub all: TileErrors,
    /// Over the lit pixels.
    pub lit: TileErrors,
    /// Variance of one sample (mean over the channels), summed over the pixels that have pairs, `all.pixels[0]`.
    pub variance: f32,
}

impl TileSums {
    /// Variance of one sample; `None` without pairs.
    pub fn sample_variance(&self) -> Option<f64> {
        (self.all.pixels[0] > 0.0).then(|| f64::from(self.variance / self.all.pixels[0]))
    }
}

/// Mean over the pixels of all tiles. Its standard error is that of the difference between the estimates of the two quarters in each tile, which
/// are independent.
fn estimate<'a>(tiles: impl Iterator<Item = &'a TileErrors>, weighting: usize) -> ErrorEstimate {
    let (mut sum, mut count, mut variance) = (0.0, 0.0, 0.0);
    for tile in tiles {
        let [all, first, second] = tile.pixels.map(f64::from);
        let squared = |which: usize| f64::from(tile.squared[which][weighting]);
        sum += squared(0);
        count += all;
        if first > 0.0 && second > 0.0 {
            variance += (0.5 * all * (squared(1) / first - squared(2) / second)).powi(2);
        }
    }
    if count == 0.0 {
        return ErrorEstimate { value: f64::INFINITY, low: 0.0, high: f64::INFINITY };
    }
    if variance == 0.0 {
        // One quarter alone says nothing about the scatter.
        variance = sum * sum;
    }
    let (mean, deviation) = (sum / f64::max(count, 1.0), f64::sqrt(variance) / f64::max(count, 1.0));
    // A mean below what the samples resolve says no more than that.
    let value = mean.max(0.5 * deviation);
    ErrorEstimate { value, low: (value - NORMAL * deviation).max(0.0), high: value + NORMAL * deviation }
}

impl PictureError {
    /// True if samples measured the error of lit pixels. Otherwise nothing is stated.
    pub fn is_known(&self) -> bool {
        [self.rms, self.relmse, self.psnr, self.psnr_all].iter().all(|e| e.value.is_finite() && e.low.is_finite() && e.high.is_finite())
    }

    /// Error of a picture from its tiles and the mean square error of its march.
    pub fn of(tiles: &[TileSums], march: f64, samples_per_pixel: f64, rays_per_pixel: u64) -> Self {
        let lit = |weighting: usize| estimate(tiles.iter().map(|tile| &tile.lit), weighting);
        let linear = lit(0);
        // The error of marching is measured without weights and counts in proportion.
        let with_march = |e: ErrorEstimate| {
            let known = linear.value > 0.0 && linear.value.is_finite();
            let share = if known { march * e.value / linear.value } else { march };
            e.map(|v| v + share)
        };
        let decibels = |e: ErrorEstimate| {
            let e = e.map(|mse| -10.0 * mse.max(1e-12).log10());
            ErrorEstimate { value: e.value, low: e.high, high: e.low }
        };
        Self {
            rms: with_march(linear).map(f64::sqrt),
            relmse: with_march(lit(1)),
            psnr: decibels(with_march(lit(2))),
            psnr_all: decibels(with_march(estimate(tiles.iter().map(|tile| &tile.all), 2))),
            march_rms: march.sqrt(),
            samples_per_pixel,
            rays_per_pixel,
        }
    }
}
