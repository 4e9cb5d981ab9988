//! The error that a picture states, from sums over tiles.

use super::super::Film;
use super::allocation::TILE;
use super::tone::squared_slope;
use bytemuck::{Pod, Zeroable};
use serde::{Deserialize, Serialize};

/// Opacity above which a pixel counts as lit.
pub const LIT: f32 = 0.01;
/// Degrees of freedom and the two-sided 95 % quantile of Student's t distribution.
const STUDENT: [(f64, f64); 6] = [(1.0, 12.706), (2.0, 4.303), (3.0, 3.182), (5.0, 2.571), (10.0, 2.228), (f64::INFINITY, 1.960)];

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

    /// Adds an independent mean square error, of which the mean and its standard error are given. Its own interval reaches two of these from the mean.
    fn plus(self, [squared, deviation]: [f64; 2]) -> Self {
        let value = self.value + squared;
        let (below, above) = ((self.value - self.low).hypot(2.0 * deviation), (self.high - self.value).hypot(2.0 * deviation));
        Self { value, low: (value - below).max(0.0), high: value + above }
    }
}

/// Mean square error of marching over channels, in the weightings of [`TileErrors`].
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct MarchError {
    /// Mean over audited lit pixels.
    pub squared: [f64; 3],
    /// Its standard error.
    pub deviation: [f64; 3],
    /// Mean and standard error of that of the pixel filter over the audited pixels that are not lit, tone-mapped: at the edges of missing cells and of the box.
    pub unlit: [f64; 2],
}

/// Mean square error of a picture's Runge-Kutta steps over lit pixels and channels, in the weightings of [`TileErrors`]; 0: not measured.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct StepsError {
    /// Mean over compared pixels.
    pub squared: [f64; 3],
    /// Its standard error.
    pub deviation: [f64; 3],
}

/// Stated error of a picture, against the picture of the traced field without noise. Of a map, radiance is the FTLE's place in the range of the colours
/// (0 to 1), lit pixels are those with a value, and samples are seeds.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct PictureError {
    /// Root mean square over lit pixels and channels, linear radiance.
    pub rms: ErrorEstimate,
    /// Mean over lit pixels and channels of squared error / (radiance^2 + 0.01).
    pub relmse: ErrorEstimate,
    /// PSNR of the tone-mapped picture over lit pixels, in decibels. First order in what is left of the error after the best correction.
    pub psnr: ErrorEstimate,
    /// The same over all pixels.
    pub psnr_all: ErrorEstimate,
    /// Root mean square of the error of marching alone, linear radiance. It is part of the errors above.
    pub march_rms: f64,
    /// Root mean square of the error of the Runge-Kutta steps alone, linear radiance. It is part of the errors above; 0 where it was not measured.
    #[serde(default)]
    pub steps_rms: f64,
    /// True if the mean of such pictures over seeds is that of the traced field: `combine = "sum"`, on a GPU but for what half precision loses. The FTLE of a map is unbiased.
    pub unbiased: bool,
    /// Coupled samples per pixel since the picture started anew.
    pub samples_per_pixel: f64,
    /// Marched rays per pixel since then.
    pub rays_per_pixel: u64,
}

/// Sums over pixels of a tile that have pairs. The index is the weight: none, 1 / (radiance^2 + 0.01), and
/// that of the tone map (see [`super::Combined::squared_in`]; of `radiance`: its squared slope).
#[repr(C)]
#[derive(Debug, Clone, Copy, Default, PartialEq, Pod, Zeroable)]
pub struct TileErrors {
    /// Squared error, mean over the channels.
    pub squared: [f32; 3],
    /// Scatter of the squared error (see [`super::Combined::squared`]). The square of the sum has the variance of `squared`.
    pub scatter: [f32; 3],
    /// Squared radiance, mean over the channels.
    pub radiance: [f32; 3],
    /// Pixels that have pairs.
    pub pixels: f32,
    /// Their pairs.
    pub pairs: f32,
}

/// Sums over a tile of 16x16 pixels.
#[repr(C)]
#[derive(Debug, Clone, Copy, Default, PartialEq, Pod, Zeroable)]
pub struct TileSums {
    /// Over all pixels.
    pub all: TileErrors,
    /// Over the lit pixels.
    pub lit: TileErrors,
    /// Variance of one sample (mean over the channels), summed over the pixels that have pairs, `all.pixels`.
    pub variance: f32,
}

impl TileSums {
    /// Variance of one sample; `None` without pairs.
    pub fn sample_variance(&self) -> Option<f64> {
        (self.all.pixels > 0.0).then(|| f64::from(self.variance / self.all.pixels))
    }
}

/// Two-sided 95 % quantile of Student's t distribution, linear between the table's entries in 1 / degrees and the logarithm; at most 3 % too large.
fn student(degrees: f64) -> f64 {
    let pair = STUDENT.windows(2).find(|pair| degrees <= pair[1].0).unwrap_or(&STUDENT[4..]);
    let [(few, most), (many, least)] = [pair[0], pair[1]];
    let share = ((1.0 / degrees.max(few) - 1.0 / many) / (1.0 / few - 1.0 / many)).clamp(0.0, 1.0);
    least * (most / least).powf(share)
}

/// Mean over the pixels of all tiles, with the interval value +- t s. With x the scatter of each tile, s^2 is the sum of x^2, and t the quantile for
/// (sum x^2)^2 / sum x^4 degrees of freedom (Satterthwaite 1946, components of one degree each): 1 for one tile, some third of the tiles for many.
/// Corrections of its bias at few degrees (von Davier 2026, arXiv:2602.20912) leave too many misses where few tiles have most of the variance.
///
/// The upper end is at least that of pairs none of which shows a difference: n of them miss a share of 1 - 0.05^(1/n) (the rule of three, 3 / n; Hanley
/// and Lippman-Hand 1983), and a difference is taken to be no larger than the radiance shown.
fn estimate<'a>(tiles: impl Iterator<Item = &'a TileErrors>, weighting: usize) -> ErrorEstimate {
    let ([mut sum, mut count, mut pairs, mut radiance], [mut variance, mut fourth]) = ([0.0; 4], [0.0; 2]);
    for tile in tiles {
        let square = f64::from(tile.scatter[weighting]).powi(2);
        (variance, fourth) = (variance + square, fourth + square * square);
        sum += f64::from(tile.squared[weighting]);
        radiance += f64::from(tile.radiance[weighting]);
        count += f64::from(tile.pixels);
        pairs += f64::from(tile.pairs);
    }
    if count == 0.0 {
        return ErrorEstimate { value: f64::INFINITY, low: 0.0, high: f64::INFINITY };
    }
    let deviation = variance.sqrt() / count;
    // A mean below what the samples resolve says no more than that.
    let value = f64::max(sum / count, 0.5 * deviation);
    let half = if variance > 0.0 { student(variance * (variance / fourth)) * deviation } else { 0.0 };
    let missed = radiance / count * (1.0 - 0.05_f64.powf(1.0 / pairs));
    ErrorEstimate { value, low: (value - half).max(0.0), high: value + half.max(missed) }
}

impl PictureError {
    /// True if samples measured the error of lit pixels. Otherwise nothing is stated.
    pub fn is_known(&self) -> bool {
        [self.rms, self.relmse, self.psnr, self.psnr_all].iter().all(|e| e.value.is_finite() && e.low.is_finite() && e.high.is_finite())
    }

    /// Error of a picture from its tiles and the errors of its march and its Runge-Kutta steps.
    pub fn of(tiles: &[TileSums], march: &MarchError, steps: &StepsError, samples_per_pixel: f64, rays_per_pixel: u64) -> Self {
        let lit = |weighting: usize| {
            estimate(tiles.iter().map(|tile| &tile.lit), weighting)
                .plus([march.squared[weighting], march.deviation[weighting]])
                .plus([steps.squared[weighting], steps.deviation[weighting]])
        };
        let pixels = |of: fn(&TileSums) -> f32| tiles.iter().map(|tile| f64::from(of(tile))).sum::<f64>();
        let share_lit = pixels(|tile| tile.lit.pixels) / pixels(|tile| tile.all.pixels).max(1.0);
        let of_lit = |of: [f64; 2]| of.map(|of| share_lit * of);
        let of_unlit = march.unlit.map(|of| (1.0 - share_lit) * of);
        let all = estimate(tiles.iter().map(|tile| &tile.all), 2)
            .plus(of_lit([march.squared[2], march.deviation[2]]))
            .plus(of_lit([steps.squared[2], steps.deviation[2]]))
            .plus(of_unlit);
        let decibels = |e: ErrorEstimate| {
            let e = e.map(|mse| -10.0 * mse.max(1e-12).log10());
            ErrorEstimate { value: e.value, low: e.high, high: e.low }
        };
        Self {
            rms: lit(0).map(f64::sqrt),
            relmse: lit(1),
            psnr: decibels(lit(2)),
            psnr_all: decibels(all),
            march_rms: march.squared[0].sqrt(),
            steps_rms: steps.squared[0].sqrt(),
            unbiased: false,
            samples_per_pixel,
            rays_per_pixel,
        }
    }
}

/// Mean square errors in a tile of the pixels that are not lit, and of those that are: linear radiance, mean over the channels.
pub type TileError = [f32; 2];

/// Least error of a tile, as a share of the mean square of all.
const LEAST_SHARE: f64 = 0.05;

/// The error of pixels, tile by tile, without that of marching; NaN if there are no pairs.
///
/// The pixels of one tile are too few to tell its error: of the heavy tails that errors have they mostly see nothing. So its mean square is drawn to that
/// of all tiles, as far as they differ by no more than their scatters explain (Efron and Morris 1975).
pub fn errors_of_tiles(tiles: &[TileSums]) -> Vec<TileError> {
    let dark = |tile: &TileSums| {
        let less = |of: fn(&TileErrors) -> f32| of(&tile.all) - of(&tile.lit);
        TileErrors {
            squared: std::array::from_fn(|k| tile.all.squared[k] - tile.lit.squared[k]),
            scatter: std::array::from_fn(|k| tile.all.scatter[k] - tile.lit.scatter[k]),
            radiance: std::array::from_fn(|k| tile.all.radiance[k] - tile.lit.radiance[k]),
            pixels: less(|errors| errors.pixels),
            pairs: less(|errors| errors.pairs),
        }
    };
    let all: Vec<TileErrors> = tiles.iter().map(|tile| tile.all).collect();
    let [dark, lit] = [tiles.iter().map(dark).collect::<Vec<_>>(), tiles.iter().map(|tile| tile.lit).collect()].map(|group| {
        let is_seen = group.iter().any(|tile| tile.pixels > 0.0);
        drawn_together(if is_seen { &group } else { &all })
    });
    dark.into_iter().zip(lit).map(|(dark, lit)| [dark, lit]).collect()
}

/// Mean square errors of tiles, drawn to their mean. NaN for a tile whose sums are not finite, which tells nothing about others.
fn drawn_together(tiles: &[TileErrors]) -> Vec<f32> {
    let is_finite = |tile: &&TileErrors| tile.squared[0].is_finite() && tile.scatter[0].is_finite();
    let found = estimate(tiles.iter().filter(is_finite), 0);
    // No difference seen is not none.
    let mean = if found.value > 0.0 { found.value } else { found.high };
    if !mean.is_finite() {
        return vec![f32::NAN; tiles.len()];
    }
    let (mut noise, mut apart, mut count, mut squares) = (0.0, 0.0, 0.0, 0.0);
    for tile in tiles.iter().filter(is_finite) {
        let pixels = f64::from(tile.pixels);
        noise += f64::from(tile.scatter[0]).powi(2);
        apart += (f64::from(tile.squared[0]) - mean * pixels).powi(2);
        count += pixels;
        squares += pixels * pixels;
    }
    // Variances of what tiles differ by, and of the noise of a pixel.
    let (own, noise) = ((apart - noise).max(0.0) / squares, noise / count);
    let of_tile = |tile: &TileErrors| {
        if !is_finite(&tile) {
            return f32::NAN;
        }
        let pixels = f64::from(tile.pixels);
        let trusted = if pixels > 0.0 && own > 0.0 { own * pixels / (own * pixels + noise) } else { 0.0 };
        let seen = f64::from(tile.squared[0]) / pixels.max(1.0);
        (mean + trusted * (seen - mean)).max(LEAST_SHARE * mean) as f32
    };
    tiles.iter().map(of_tile).collect()
}

/// Mean square error at a pixel: linear between the middles of the tiles of a picture that has `across` of them in a row.
pub fn error_at(tiles: &[TileError], across: usize, [x, y]: [usize; 2], is_lit: bool) -> f32 {
    let down = tiles.len() / across;
    let between = |pixel: usize, count: usize| {
        let place = ((pixel as f32 + 0.5) / TILE as f32 - 0.5).clamp(0.0, (count - 1) as f32);
        let first = (place as usize).min(count.max(2) - 2);
        (first, (first + 1).min(count - 1), place - first as f32)
    };
    let ((left, right, u), (top, bottom, v)) = (between(x, across), between(y, down));
    let at = |row: usize, column: usize| tiles[row * across + column][usize::from(is_lit)];
    let along = |row: usize| at(row, left) + u * (at(row, right) - at(row, left));
    along(top) + v * (along(bottom) - along(top))
}

/// PSNR over lit pixels, in decibels, of the mean of two independent pictures, from their difference. `tone_map` is `[contrast, brightness, gamma]`.
pub fn noise_psnr(a: &Film, b: &Film, tone_map: [f64; 3]) -> f64 {
    let (mut sum, mut lit) = (0.0, 0.0);
    for (a, b) in a.rgba.iter().zip(&b.rgba).filter(|(a, b)| a[3] + b[3] > 2.0 * LIT) {
        lit += 1.0;
        for (a, b) in a[..3].iter().zip(&b[..3]) {
            sum += f64::from(squared_slope(tone_map, 0.5 * (a + b))) * f64::from(0.5 * (a - b)).powi(2) / 3.0;
        }
    }
    -10.0 * (sum / lit).max(1e-12).log10()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rng::{philox, unit};

    const SEEDS: u32 = 20_000;

    /// Shares of intervals above and below the truth, 1, for tiles of these standard deviations.
    fn misses(deviations: &[f64], seed: u32) -> [f64; 2] {
        let normal = |number: u32, tile: usize| {
            let words = philox([number, tile as u32, 0, 0], [seed, 3]).map(|word| 1.0 - f64::from(unit(word)));
            let radius = (-2.0 * words[0].ln()).sqrt();
            [(std::f64::consts::TAU * words[1]).cos() * radius, (std::f64::consts::TAU * words[1]).sin() * radius]
        };
        let mut counts = [0.0; 2];
        for number in 0..SEEDS {
            let tiles: Vec<TileErrors> = (deviations.iter().enumerate())
                .map(|(tile, deviation)| {
                    let [error, scatter] = normal(number, tile).map(|x| (x * deviation) as f32);
                    TileErrors { squared: [1.0 + error; 3], scatter: [scatter; 3], pixels: 1.0, pairs: 1e6, ..TileErrors::default() }
                })
                .collect();
            let found = estimate(tiles.iter(), 0);
            counts[0] += f64::from(found.low > 1.0) / f64::from(SEEDS);
            counts[1] += f64::from(found.high < 1.0) / f64::from(SEEDS);
        }
        counts
    }

    /// With the quantile of the normal distribution, 30 % of the intervals of one tile miss.
    #[test]
    fn intervals_of_few_tiles_hold() {
        for tiles in [1, 2, 4, 16, 64] {
            // Equal tiles, and some with most of the variance.
            for uneven in [0.0, 1.0] {
                let deviations: Vec<f64> = (0..tiles).map(|tile| 0.1 * f64::powf(1.0 + f64::from(tile), -uneven)).collect();
                let [above, below] = misses(&deviations, tiles as u32);
                assert!((0.005..0.03).contains(&above) && (0.005..0.03).contains(&below), "{tiles} {uneven}: {above} {below}");
            }
        }
    }

    #[test]
    fn the_error_of_marching_counts_in_its_own_weighting() {
        let march = MarchError { squared: [4.0, 8.0, 2.0], deviation: [1.0, 2.0, 0.5], ..MarchError::default() };
        let none = ErrorEstimate::default();
        let found = [0, 1, 2].map(|weighting| none.plus([march.squared[weighting], march.deviation[weighting]]));
        let interval = |value, low, high| ErrorEstimate { value, low, high };
        assert_eq!(found, [interval(4.0, 2.0, 6.0), interval(8.0, 4.0, 12.0), interval(2.0, 1.0, 3.0)]);
        // Independent errors: half-widths are added in squares.
        let other = ErrorEstimate { value: 10.0, low: 8.5, high: 10.0 };
        assert_eq!(other.plus([march.squared[0], march.deviation[0]]), interval(14.0, 11.5, 16.0));
        assert_eq!(other.plus([0.0; 2]), other);
    }

    #[test]
    fn the_error_of_steps_adds_to_all_that_is_stated() {
        let of = |squared: [f64; 3]| {
            let steps = StepsError { squared, ..StepsError::default() };
            PictureError::of(&tiles_of(&[4e-4; 64], 1e-4), &MarchError::default(), &steps, 1.0, 4)
        };
        let (error, found) = (of([0.0; 3]), of([5e-4, 2e-3, 3e-4]));
        let square = |decibels: f64| 10f64.powf(-0.1 * decibels);
        for (before, after) in [(error.rms.value, found.rms.value), (error.rms.low, found.rms.low), (error.rms.high, found.rms.high)] {
            assert!((after * after - before * before - 5e-4).abs() < 1e-12, "{error:?} {found:?}");
        }
        for (before, after) in [(error.psnr.value, found.psnr.value), (error.psnr.low, found.psnr.low), (error.psnr.high, found.psnr.high)]
        {
            assert!((square(after) - square(before) - 3e-4).abs() < 1e-12, "{error:?} {found:?}");
        }
        assert!((found.relmse.value - error.relmse.value - 2e-3).abs() < 1e-12);
        // Half of the pixels are lit.
        assert!((square(found.psnr_all.value) - square(error.psnr_all.value) - 1.5e-4).abs() < 1e-12);
        assert_eq!((found.steps_rms, found.march_rms), (5e-4_f64.sqrt(), error.march_rms));
    }

    /// Half of the pixels are lit.
    #[test]
    fn all_pixels_have_the_march_of_their_own_kind() {
        let march = MarchError { squared: [0.0, 0.0, 2e-4], unlit: [6e-4, 0.0], ..MarchError::default() };
        let found = PictureError::of(&tiles_of(&[0.0; 4], 0.0), &march, &StepsError::default(), 1.0, 4);
        assert!((found.psnr.value + 10.0 * 2e-4_f64.log10()).abs() < 1e-6, "{found:?}");
        // The pixels themselves err by 1e-6 where they are not lit.
        assert!((found.psnr_all.value + 10.0 * (4e-4_f64 + 0.5e-6).log10()).abs() < 1e-6, "{found:?}");
    }

    /// Tiles of 256 pixels, half of them lit: mean square errors of the lit pixels, and deviation of the noise of their mean.
    fn tiles_of(errors: &[f32], noise: f32) -> Vec<TileSums> {
        let tile = |(number, &error): (usize, &f32)| {
            // As many above as below, and some that see nothing at all.
            let seen = [-1.0, 1.0, -0.5, 0.5][number % 4] * noise;
            let sums = |squared: f32, scatter: f32, pixels: f32| TileErrors {
                squared: [squared; 3],
                scatter: [scatter; 3],
                pixels,
                pairs: pixels,
                ..TileErrors::default()
            };
            let lit = sums(128.0 * (error + seen), 128.0 * seen, 128.0);
            TileSums { all: sums(lit.squared[0] + 128.0 * 1e-6, lit.scatter[0], 256.0), lit, variance: 0.0 }
        };
        errors.iter().enumerate().map(tile).collect()
    }

    #[test]
    fn tiles_state_what_all_show_unless_they_differ() {
        // Noise as large as the error: nothing tells the tiles apart.
        for error in errors_of_tiles(&tiles_of(&[1.0; 64], 1.0)) {
            assert!((error[1] - 1.0).abs() < 0.05 && (error[0] - 1e-6).abs() < 1e-7, "{error:?}");
        }
        // One is far more wrong than its noise, in which others see nothing.
        let mut errors = [1.0; 64];
        errors[40] = 100.0;
        let found = errors_of_tiles(&tiles_of(&errors, 1.0));
        assert!(found[40][1] > 70.0, "{:?}", found[40]);
        assert!(found.iter().enumerate().all(|(tile, error)| tile == 40 || (0.1..4.0).contains(&error[1])), "{found:?}");
        // Without noise each has its own.
        let errors: Vec<f32> = (1..64).map(|error| error as f32).collect();
        let found = errors_of_tiles(&tiles_of(&errors, 0.0));
        assert!(found.iter().zip(&errors).all(|(found, error)| (found[1] - error.max(0.05 * 32.0)).abs() < 1e-3), "{found:?}");
    }

    #[test]
    fn tiles_without_pairs_take_the_error_of_others() {
        let mut tiles = tiles_of(&[1.0; 16], 0.1);
        tiles[3] = TileSums::default();
        assert!((errors_of_tiles(&tiles)[3][1] - 1.0).abs() < 0.05);
        assert!(errors_of_tiles(&[TileSums::default(); 4]).iter().flatten().all(|error| error.is_nan()));
        // No pixel that is lit has pairs: the others tell.
        let dark = TileSums { lit: TileErrors::default(), ..tiles[0] };
        let found = errors_of_tiles(&[dark; 4]);
        assert!(found.iter().all(|error| error[0] > 0.0 && error[1] == error[0]), "{found:?}");
        // A tile that is no number is no other's fault.
        tiles[3].all.squared[0] = f32::NAN;
        tiles[3].lit.squared[0] = f32::NAN;
        let found = errors_of_tiles(&tiles);
        assert!(found.iter().enumerate().all(|(tile, error)| error[1].is_nan() == (tile == 3)), "{found:?}");
        // Dark pixels whose pairs show no difference.
        let mut seen = tiles_of(&[1.0; 4], 0.1);
        seen.iter_mut().for_each(|tile| {
            tile.all.squared = tile.lit.squared;
            tile.all.radiance = [2.56; 3];
        });
        assert!(errors_of_tiles(&seen).iter().all(|error| error[0] > 0.0), "none seen is not none");
    }

    #[test]
    fn the_error_of_a_pixel_lies_between_those_of_the_tiles_around_it() {
        let tiles = [[0.0, 1.0], [0.0, 3.0], [0.0, 5.0], [0.0, 7.0], [0.0, 9.0], [8.0, 11.0]];
        let at = |x: usize, y: usize| error_at(&tiles, 3, [x, y], true);
        assert_eq!([at(0, 0), at(7, 7), at(47, 31)], [1.0, 1.0, 11.0], "outside of all middles: the nearest");
        assert!((at(15, 3) - 1.9375).abs() < 1e-6 && (at(16, 3) - 2.0625).abs() < 1e-6, "{} {}", at(15, 3), at(16, 3));
        assert!((at(8, 16) - (1.0625 + 6.0 * 0.53125)).abs() < 1e-6, "{}", at(8, 16));
        assert_eq!(error_at(&tiles, 3, [47, 31], false), 8.0);
        assert_eq!(error_at(&[[2.0, 4.0]], 1, [9, 3], true), 4.0);
    }

    #[test]
    fn none_seen_is_not_none() {
        for pairs in [1, 4, 60, 10_000] {
            // Radiance 2, a share of which shows a difference as large: at the upper end 5 % of such pictures show none.
            let tile = TileErrors { radiance: [4.0; 3], pixels: 1.0, pairs: pairs as f32, ..TileErrors::default() };
            let found = estimate([tile].iter(), 0);
            assert!(found.value == 0.0 && found.low == 0.0, "{found:?}");
            assert!(((1.0 - found.high / 4.0).powi(pairs) - 0.05).abs() < 1e-6, "{pairs}: {found:?}");
        }
    }

    #[test]
    fn quantiles_of_student_are_close_from_above() {
        for (degrees, exact) in [(1.0, 12.706), (4.0, 2.776), (7.0, 2.365), (20.0, 2.086), (60.0, 2.000), (1e9, 1.960)] {
            assert!((0.999..1.03).contains(&(student(degrees) / exact)), "{degrees}: {}", student(degrees));
        }
    }
}
