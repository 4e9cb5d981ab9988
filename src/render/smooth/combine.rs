//! Combination of the marched picture with its noisy correction, and the error of the result.
//!
//! First goes the part that the marched picture tells (see `regression`). The rest is shrunk before it is added, as Stein-type estimators combine a
//! biased estimate with an unbiased one (James and Stein 1961; Back et al. 2020), here in the scales of an a-trous B3-spline transform (Starck and
//! Murtagh 2006). The samples form two halves, and each half two quarters. The product of two quarters' details estimates the energy of the correction itself without noise, their squares that of correction
//! and noise together; the ratio is the gain. Each half is shrunk by its own gains, so that the other half is independent of it and scores it:
//! with d_A and d_B the means of the halves at a pixel, r = (a + b) / 2 the correction shown and c its expectation,
//! r^2 - (a d_B + b d_A) + d_A d_B is an unbiased estimate of (r - c)^2. As samples come, gains go to 1 wherever there is anything to correct.

use super::regression::Guides;
use super::tone::ToneMap;
use rayon::prelude::*;

/// Scales of the transform.
const LEVELS: usize = 5;
/// Radius over which energies are averaged, in pixels. A smaller one leaves gains that follow the noise: with radii of 4 to 32 pixels, growing with the
/// scale, pictures of one sample a pixel got worse with the second.
const RADIUS: usize = 32;
/// Rec. 709 luminance.
const LUMINANCE: [f32; 3] = [0.2126, 0.7152, 0.0722];

/// Sums over the coupled samples of a pixel. Samples come in pairs, one of either half.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct PairSums {
    /// By half and quarter.
    pub radiance: [[[f32; 3]; 2]; 2],
    /// Sum of the opacity.
    pub alpha: f32,
    /// Pairs by quarter.
    pub pairs: [u32; 2],
    /// Queries of both trackers.
    pub queries: u32,
    /// Queries that Runge-Kutta answered.
    pub traced: u32,
}

impl PairSums {
    /// Pairs of both quarters.
    pub fn pairs(&self) -> u32 {
        self.pairs[0] + self.pairs[1]
    }

    /// Mean of a half over all its samples.
    fn half(&self, half: usize) -> [f32; 3] {
        let (count, [first, second]) = (self.pairs().max(1) as f32, &self.radiance[half]);
        std::array::from_fn(|k| (first[k] + second[k]) / count)
    }

    /// Variance of one sample, mean over the channels, from the difference between the halves; 0 without pairs.
    pub fn sample_variance(&self) -> f32 {
        let difference = |k: usize| (0..2).map(|q| self.radiance[0][q][k] - self.radiance[1][q][k]).sum::<f32>();
        // The sums of the halves differ by twice the pairs times the variance of one sample.
        (0..3).map(|k| difference(k).powi(2)).sum::<f32>() / (6.0 * self.pairs().max(1) as f32)
    }

    fn quarter(&self, half: usize, quarter: usize) -> [f32; 3] {
        self.radiance[half][quarter].map(|sum| sum / self.pairs[quarter].max(1) as f32)
    }
}

/// Weighted colour: radiance times weight, and the weight.
type Weighted = [f32; 4];

/// Reflects an index at the borders of 0..n.
fn reflected(mut i: isize, n: usize) -> usize {
    let last = n as isize - 1;
    if last == 0 {
        return 0;
    }
    loop {
        if i < 0 {
            i = -i;
        } else if i > last {
            i = 2 * last - i;
        } else {
            return i as usize;
        }
    }
}

/// B3-spline filter with the given spacing along one axis of a picture with rows of `width`.
pub(super) fn b3<const N: usize>(from: &[[f32; N]], width: usize, spacing: usize, along_rows: bool) -> Vec<[f32; N]> {
    const KERNEL: [f32; 5] = [0.0625, 0.25, 0.375, 0.25, 0.0625];
    let height = from.len() / width;
    let mut to = vec![[0.0; N]; from.len()];
    to.par_chunks_mut(width).enumerate().for_each(|(y, row)| {
        let rows: [usize; 5] = std::array::from_fn(|i| reflected(y as isize + (i as isize - 2) * spacing as isize, height) * width);
        for (x, value) in row.iter_mut().enumerate() {
            let mut sum = [0.0; N];
            for (i, weight) in KERNEL.iter().enumerate() {
                let at =
                    if along_rows { y * width + reflected(x as isize + (i as isize - 2) * spacing as isize, width) } else { rows[i] + x };
                (0..N).for_each(|k| sum[k] += weight * from[at][k]);
            }
            *value = sum;
        }
    });
    to
}

/// Sums over a square of the given radius, cut at the borders.
fn box_sum(from: &[[f32; 2]], width: usize, radius: usize) -> Vec<[f32; 2]> {
    let height = from.len() / width;
    let mut rows = vec![[0.0; 2]; from.len()];
    rows.par_chunks_mut(width).zip(from.par_chunks(width)).for_each(|(to, from)| {
        let mut sums = vec![[0.0_f64; 2]; width + 1];
        (0..width).for_each(|x| sums[x + 1] = std::array::from_fn(|k| sums[x][k] + f64::from(from[x][k])));
        for (x, value) in to.iter_mut().enumerate() {
            let (low, high) = (x.saturating_sub(radius), (x + radius + 1).min(width));
            *value = std::array::from_fn(|k| (sums[high][k] - sums[low][k]) as f32);
        }
    });
    let mut to = vec![[0.0; 2]; from.len()];
    to.par_chunks_mut(width).enumerate().for_each(|(y, row)| {
        let range = y.saturating_sub(radius)..(y + radius + 1).min(height);
        for (x, value) in row.iter_mut().enumerate() {
            *value = range.clone().fold([0.0; 2], |sum, y| std::array::from_fn(|k| sum[k] + rows[y * width + x][k]));
        }
    });
    to
}

fn luminance(colour: [f32; 3]) -> f32 {
    (0..3).map(|k| LUMINANCE[k] * colour[k]).sum()
}

/// Gains of the mean of two quarters: the share of its energy that is not noise.
fn gains(details: &[Vec<[f32; 3]>; 2], width: usize, radius: usize) -> Vec<f32> {
    let energies: Vec<[f32; 2]> = (details[0].par_iter())
        .zip(&details[1])
        .map(|(&a, &b)| {
            let (a, b) = (luminance(a), luminance(b));
            [a * b, 0.5 * (a * a + b * b)]
        })
        .collect();
    let gain = |[signal, energy]: [f32; 2]| if energy > 0.0 { (2.0 * signal / (energy + signal)).clamp(0.0, 1.0) } else { 0.0 };
    box_sum(&energies, width, radius).into_par_iter().map(gain).collect()
}

fn value(weighted: &Weighted) -> [f32; 3] {
    if weighted[3] > 0.0 { std::array::from_fn(|k| weighted[k] / weighted[3]) } else { [0.0; 3] }
}

/// Shrinks the mean of two quarters of the samples.
fn shrunk(mut quarters: [Vec<Weighted>; 2], width: usize) -> Vec<[f32; 3]> {
    let mut result = vec![[0.0_f32; 3]; quarters[0].len()];
    let add = |result: &mut [[f32; 3]], parts: &[Vec<[f32; 3]>; 2], weights: &[Vec<Weighted>; 2], gains: &[f32]| {
        result.par_iter_mut().enumerate().with_min_len(1 << 12).for_each(|(i, result)| {
            let [v, w] = [weights[0][i][3], weights[1][i][3]];
            if v + w > 0.0 {
                (0..3).for_each(|k| result[k] += gains[i] * (v * parts[0][i][k] + w * parts[1][i][k]) / (v + w));
            }
        });
    };
    for level in 0..LEVELS {
        let spacing = 1 << level;
        let coarse = quarters.each_ref().map(|quarter| b3(&b3(quarter, width, spacing, true), width, spacing, false));
        let details: [Vec<[f32; 3]>; 2] = std::array::from_fn(|q| {
            let detail = |(fine, coarse): (&Weighted, &Weighted)| {
                let (fine_value, coarse_value) = (value(fine), value(coarse));
                if fine[3] > 0.0 { std::array::from_fn(|k| fine_value[k] - coarse_value[k]) } else { [0.0; 3] }
            };
            quarters[q].par_iter().zip(&coarse[q]).with_min_len(1 << 12).map(detail).collect()
        });
        let gains = gains(&details, width, RADIUS);
        add(&mut result, &details, &quarters, &gains);
        quarters = coarse;
    }
    let coarsest = quarters.each_ref().map(|quarter| quarter.par_iter().map(value).collect::<Vec<_>>());
    let gains = gains(&coarsest, width, RADIUS);
    add(&mut result, &coarsest, &quarters, &gains);
    result
}

/// How the correction is added.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Correction {
    /// Not at all; the samples only measure the error.
    Left,
    /// Shrunk.
    Shrunk,
    /// As it is.
    Summed,
}

/// The correction that is shown, and its error.
pub struct Combined {
    /// Radiance to add to the marched picture, per pixel.
    pub correction: Vec<[f32; 3]>,
    /// Per pixel and channel, an estimate of the squared error, and its scatter: a number of about the variance of that estimate, of either sign.
    /// NaN where there are no pairs.
    ///
    /// With e_A and e_B the noise of d_A and d_B, the estimate is wrong by (c - a) e_B + (c - b) e_A + e_A e_B. Halved differences between the quarters
    /// are noise of the same variance; with them in place of e_A and e_B and d_A, d_B in place of c this is the scatter of a pixel that has both
    /// quarters, at least as large on average. The product is in d_A and d_B already, except where the sum is shown, a = d_A. In a pixel with one
    /// quarter it is the estimate itself (for a sum its part that has noise, of the size of d_A d_B), with the sign of the quarter, so that a tile's sum is the difference between its quarters.
    pub squared: Vec<[[f32; 3]; 2]>,
    /// Corrections of the halves, each shrunk by itself.
    shrunk: [Vec<[f32; 3]>; 2],
    how: Correction,
}

/// The correction of `sums` (row by row from the top) of the marched picture of `guides`, and its squared error, from the products of differences
/// between halves.
pub fn combine(sums: &[PairSums], guides: &Guides, how: Correction) -> Combined {
    let coefficients = guides.fit(sums);
    let shrunk = [0, 1].map(|half: usize| {
        let regressed = |i: usize| guides.correction(i, &coefficients[half]);
        let quarter = |quarter: usize| -> Vec<Weighted> {
            let rest = |(i, sums): (usize, &PairSums)| {
                let (regressed, pairs) = (regressed(i), sums.pairs[quarter] as f32);
                let [r, g, b] = std::array::from_fn(|k| sums.radiance[half][quarter][k] - pairs * regressed[k]);
                [r, g, b, pairs]
            };
            sums.par_iter().enumerate().with_min_len(1 << 12).map(rest).collect()
        };
        let mut shrunk = shrunk([quarter(0), quarter(1)], guides.width);
        shrunk.par_iter_mut().enumerate().with_min_len(1 << 12).for_each(|(i, shrunk)| {
            let regressed = regressed(i);
            (0..3).for_each(|k| shrunk[k] += regressed[k]);
        });
        shrunk
    });
    let mut combined = Combined { correction: Vec::new(), squared: Vec::new(), shrunk, how };
    let at = |i: usize| {
        let [a, b] = combined.shown(i, &sums[i]);
        (std::array::from_fn(|k| 0.5 * (a[k] + b[k])), combined.squared_in(None, i, &sums[i], [0.0; 3]))
    };
    (combined.correction, combined.squared) = (0..sums.len()).into_par_iter().with_min_len(1 << 10).map(at).unzip();
    combined
}

impl Combined {
    /// Corrections of the halves, of which the mean is shown.
    fn shown(&self, pixel: usize, sums: &PairSums) -> [[f32; 3]; 2] {
        match self.how {
            Correction::Left => [[0.0; 3]; 2],
            Correction::Shrunk => [0, 1].map(|half: usize| self.shrunk[half][pixel]),
            Correction::Summed => [0, 1].map(|half| sums.half(half)),
        }
    }

    /// The squared error of a pixel and its scatter, as in [`Self::squared`], in tone-mapped values if there is a tone map. `base`: its marched radiance.
    ///
    /// The tone map T takes the shown radiance s to that of the best estimate p = base + g exactly, with g = (a + b) / 2 of the shrunk halves, and on to the
    /// truth y to first order: T(s) - T(y) = k (s - p) + t (p - y), where k is the slope between s and p and t that at p. In its square, products with
    /// the unknown correction are those of a half and the mean of the other.
    pub fn squared_in(&self, tone_map: Option<ToneMap>, pixel: usize, sums: &PairSums, base: [f32; 3]) -> [[f32; 3]; 2] {
        if sums.pairs() == 0 {
            return [[f32::NAN; 3]; 2];
        }
        let [a, b] = [0, 1].map(|half: usize| self.shrunk[half][pixel]);
        let ([shown_a, shown_b], [d_a, d_b]) = (self.shown(pixel, sums), [0, 1].map(|half| sums.half(half)));
        let mut found = [[0.0; 3]; 2];
        for channel in 0..3 {
            let of = |colour: [f32; 3]| colour[channel];
            let (a, b, d_a, d_b) = (of(a), of(b), of(d_a), of(d_b));
            let (r, g, product) = (0.5 * (of(shown_a) + of(shown_b)), 0.5 * (a + b), d_a * d_b);
            let (p, s) = (of(base) + g, of(base) + r);
            let (k, t) = tone_map.map_or((1.0, 1.0), |tone_map| (tone_map.secant(p, s), tone_map.slope(p)));
            // r and g times the correction.
            let guessed = 0.5 * (a * d_b + b * d_a);
            let corrected = 0.5 * (of(shown_a) * d_b + of(shown_b) * d_a);
            let (first, second) = ((r - g) * g + guessed - corrected, g * g - 2.0 * guessed + product);
            let squared = (k * (r - g)).powi(2) + 2.0 * k * t * first + t * t * second;
            let scatter = if sums.pairs.contains(&0) {
                let estimate = if self.how == Correction::Summed { t * (t - k) * second - t * k * product } else { squared };
                if sums.pairs[0] > 0 { estimate } else { -estimate }
            } else {
                let apart = |half: usize| 0.5 * (of(sums.quarter(half, 0)) - of(sums.quarter(half, 1)));
                let (e_a, e_b) = (apart(0), apart(1));
                // What the estimate loses or gains with e_A and e_B.
                let left = (d_a - a) * e_b + (d_b - b) * e_a;
                match self.how {
                    Correction::Summed => t * (t - k) * left + t * (2.0 * k - t) * e_a * e_b,
                    Correction::Shrunk => t * t * left,
                    Correction::Left => t * t * left + t * k * (a * e_b + b * e_a),
                }
            };
            (found[0][channel], found[1][channel]) = (squared, scatter);
        }
        found
    }
}

/// Mean of the known values over a square around each pixel; NaN where none is known.
pub fn smoothed(values: &[f32], width: usize, radius: usize) -> Vec<f32> {
    let known: Vec<[f32; 2]> = values.iter().map(|v| if v.is_finite() { [*v, 1.0] } else { [0.0; 2] }).collect();
    box_sum(&known, width, radius).into_iter().map(|[sum, count]| if count > 0.5 { sum / count } else { f32::NAN }).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rng::{philox, unit};
    use crate::smooth::RaySum;

    /// Pairs of a picture whose correction is `truth`, with uniform noise of standard deviation `noise`.
    fn sampled(truth: &[f32], noise: f32, pairs: u32, seed: u32) -> Vec<PairSums> {
        let draw = |i: usize, pair: u32, half: u32| {
            let words = philox([i as u32, pair, half, 0], [seed, 1]);
            (unit(words[0]) - 0.5) * 12.0_f32.sqrt() * noise
        };
        let sums = |(i, &truth): (usize, &f32)| {
            let mut sums = PairSums::default();
            for pair in 0..pairs {
                let quarter = ((i as u32 + pair) & 1) as usize;
                for half in 0..2 {
                    let value = truth + draw(i, pair, half as u32);
                    sums.radiance[half][quarter].iter_mut().for_each(|sum| *sum += value);
                }
                sums.pairs[quarter] += 1;
            }
            sums
        };
        truth.iter().enumerate().map(sums).collect()
    }

    fn bump(width: usize, height: usize) -> Vec<f32> {
        let at = |i: usize| {
            let (x, y) = ((i % width) as f32 - width as f32 / 2.0, (i / width) as f32 - height as f32 / 2.0);
            0.2 * (-(x * x + y * y) / 400.0).exp()
        };
        (0..width * height).map(at).collect()
    }

    fn mean_square(values: impl Iterator<Item = f32>) -> f64 {
        let (mut sum, mut count) = (0.0, 0);
        for value in values {
            (sum, count) = (sum + f64::from(value).powi(2), count + 1);
        }
        sum / f64::from(count)
    }

    /// A march that shows nothing, which gives no features.
    fn dark(width: usize, height: usize) -> Guides {
        Guides::new(&vec![RaySum::default(); width * height], 1, width)
    }

    fn error_of(combined: &Combined, truth: &[f32]) -> f64 {
        mean_square(combined.correction.iter().zip(truth).map(|(r, t)| r[0] - t))
    }

    #[test]
    fn shrinking_removes_noise_and_keeps_what_is_there() {
        let (width, height) = (128, 96);
        let truth = bump(width, height);
        let left = mean_square(truth.iter().copied());
        let guides = dark(width, height);
        let mut last = f64::INFINITY;
        for pairs in [2, 8, 32, 128] {
            let sums = sampled(&truth, 0.5, pairs, 3);
            let shrunk = error_of(&combine(&sums, &guides, Correction::Shrunk), &truth);
            let summed = error_of(&combine(&sums, &guides, Correction::Summed), &truth);
            // 0.25 / samples is the variance of the plain mean.
            assert!((summed / (0.25 / (2.0 * f64::from(pairs))) - 1.0).abs() < 0.1, "{pairs}: {summed}");
            assert!(shrunk < 0.2 * summed && shrunk < left && shrunk < last, "{pairs}: {shrunk}, sum {summed}, none {left}");
            last = shrunk;
        }
    }

    /// A correction that the marched picture's details tell is found at once, where shrinkage leaves most of it away; and its error is stated right.
    #[test]
    fn what_the_marched_picture_tells_is_regressed() {
        let (width, height) = (128, 96);
        // Detail of single pixels, which shrinkage takes for noise.
        let rays: Vec<RaySum> = (0..(width * height) as u32)
            .map(|i| {
                let [radiance, alpha, ftle, _] = philox([i, 0, 0, 0], [7, 2]).map(unit);
                RaySum { radiance: [radiance; 3], alpha: 0.5 + 0.5 * alpha, ftle, missing: 0.0 }
            })
            .collect();
        let correction = |ray: &RaySum| 0.3 * ray.radiance[0] - 0.4 * ray.alpha + 0.2 * ray.ftle - 0.5 * ray.ftle * ray.radiance[0];
        let truth: Vec<f32> = rays.iter().map(correction).collect();
        let guides = Guides::new(&rays, 1, width);
        let dark = dark(width, height);
        let (mut stated, mut found, mut without) = (0.0, 0.0, 0.0);
        for seed in 0..8 {
            let sums = sampled(&truth, 0.5, 2, 40 + seed);
            let combined = combine(&sums, &guides, Correction::Shrunk);
            stated += combined.squared.iter().map(|e| f64::from(e[0][0])).sum::<f64>() / truth.len() as f64;
            found += error_of(&combined, &truth);
            without += error_of(&combine(&sums, &dark, Correction::Shrunk), &truth);
        }
        assert!(found < 0.1 * without, "{found} {without}");
        // Its scatter is that of the products of noise, 0.25 / 4 a pixel and half.
        let scatter = 3.0 * 8.0 * 0.25 / 2.0 / ((8 * truth.len()) as f64).sqrt();
        assert!((stated - found).abs() < scatter, "{stated} {found} {scatter}");
    }

    #[test]
    fn noise_without_a_correction_is_shrunk_to_almost_nothing() {
        let sums = sampled(&vec![0.0; 128 * 96], 0.5, 4, 9);
        let error = mean_square(combine(&sums, &dark(128, 96), Correction::Shrunk).correction.iter().map(|r| r[0]));
        // The plain mean has 0.25 / 8, of which less than a twentieth may stay.
        assert!(error < 0.05 * 0.25 / 8.0, "{error}");
    }

    #[test]
    fn the_stated_tone_mapped_error_is_that_of_the_picture_shown() {
        let (width, height, base) = (256, 192, 0.3);
        let detail = |i: usize| 0.04 * (unit(philox([i as u32, 0, 0, 0], [7, 2])[0]) - 0.5);
        let truth: Vec<f32> = bump(width, height).iter().enumerate().map(|(i, bump)| bump + detail(i)).collect();
        let map = ToneMap::new([1.85, 0.75, 1.4]);
        let mapped = |c: f32| ((c - 0.5) * 1.85 + 0.75).clamp(0.0, 1.0).powf(1.0 / 1.4);
        for how in [Correction::Left, Correction::Shrunk, Correction::Summed] {
            let (mut stated, mut found) = (0.0, 0.0);
            for seed in 0..8 {
                let sums = sampled(&truth, 0.05, 8, 200 + seed);
                let combined = combine(&sums, &dark(width, height), how);
                let squared = |i: usize| f64::from(combined.squared_in(Some(map), i, &sums[i], [base; 3])[0][0]);
                stated += (0..sums.len()).map(squared).sum::<f64>() / sums.len() as f64;
                let apart = |i: usize| mapped(base + combined.correction[i][0]) - mapped(base + truth[i]);
                found += mean_square((0..sums.len()).map(apart));
            }
            assert!((stated / found - 1.0).abs() < 0.05, "{how:?}: stated {stated}, found {found}");
        }
    }

    #[test]
    fn the_stated_error_is_that_of_the_picture_shown() {
        let (width, height) = (256, 192);
        // Fine detail, which shrinkage cannot tell from noise, so that its error stands above the scatter of the statements.
        let detail = |i: usize| 0.15 * (unit(philox([i as u32, 0, 0, 0], [7, 2])[0]) - 0.5);
        let truth: Vec<f32> = bump(width, height).iter().enumerate().map(|(i, bump)| bump + detail(i)).collect();
        for how in [Correction::Left, Correction::Shrunk, Correction::Summed] {
            let (mut stated, mut found) = (0.0, 0.0);
            for seed in 0..24 {
                let combined = combine(&sampled(&truth, 0.3, 8, 100 + seed), &dark(width, height), how);
                stated += combined.squared.iter().map(|e| f64::from(e[0][0])).sum::<f64>() / truth.len() as f64;
                found += error_of(&combined, &truth);
            }
            // The mean of 24 statements scatters by some 1 %.
            assert!((stated / found - 1.0).abs() < 0.05, "{how:?}: stated {stated}, found {found}");
        }
    }
}
