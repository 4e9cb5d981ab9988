//! A picture that accumulates: rays marched through the surrogate, and pairs of coupled samples where the variance is.

use super::combine::{Combined, Correction, PairSums, combine, smoothed};
use super::coupled::track;
use super::light_volume::LightVolume;
use super::march::{IsMissing, Medium, RaySum, ToLight};
use super::nodes::Nodes;
use crate::render::renderer::RenderStats;
use crate::render::tracking::FrameScene;
use crate::render::{Film, LogStretch, Method, Scene};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use std::sync::atomic::AtomicBool;
use std::time::Instant;

/// Edge of a tile, in pixels. Samples are distributed over tiles, and errors are averaged over them.
const TILE: usize = 16;
/// Rays per pixel of the first round; later rounds add one each, up to `MAX_RAYS` in all.
const FIRST_RAYS: u64 = 4;
const MAX_RAYS: u64 = 256;
/// First step of marching, as a share of the distance between nodes.
const FIRST_STEP: f32 = 0.5;
/// Smallest step: marching is not refined further.
const MIN_STEP: f32 = 1.0 / 64.0;
/// The error of marching stays this factor below the stated one (10 dB).
const MARCH_SHARE: f64 = 0.1;
/// Pixels per round whose march is compared with a finer one, while rays are added.
const MARCH_AUDIT: u64 = 24;
/// Counter word of the draw of these pixels, which no path reaches.
const AUDIT_DIMENSION: u32 = u32::MAX - 2;
/// Largest number of values of the light volume on the CPU.
const LIGHT_VALUES: usize = 1 << 24;
/// Share of the pairs that are spread evenly over all tiles.
const EVEN_SHARE: f64 = 0.25;
/// One pixel in this many gets a pair that only measures the error of a marched picture.
const AUDIT_STRIDE: f64 = 16.0;
/// Radius over which the squared error of a pixel is averaged, and its floor as a share of the frame's mean.
const ERROR_RADIUS: usize = 8;
const ERROR_FLOOR: f32 = 0.05;
/// Opacity above which a pixel counts as lit.
const LIT: f32 = 0.01;
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

/// One round of refinement.
pub struct Refinement<'a> {
    /// The surrogate.
    pub nodes: &'a Nodes,
    /// Missing cells; `None` if every cell has data.
    pub missing: Option<IsMissing<'a>>,
    /// [`Method::Marched`] or [`Method::TwoLevel`].
    pub method: Method,
    /// Add the correction as it is, without shrinkage.
    pub sum: bool,
    /// Coupled samples per pixel, on average.
    pub samples: f64,
    /// Number that selects the random stream when the picture starts anew.
    pub number: u64,
    /// Setting it ends the round early; the picture is unchanged then.
    pub stop: &'a AtomicBool,
}

/// An accumulating picture.
#[derive(Debug, Clone, Default)]
pub struct Picture {
    /// Scene and nodes that it shows; `None` before the first round.
    shows: Option<(Scene, f32, Nodes)>,
    /// Random stream: the number of the round at which it started.
    number: u64,
    rays: u64,
    /// Sums over all rays, per pixel.
    base: Vec<RaySum>,
    /// Rays per pixel of the next round.
    next_rays: u64,
    /// Step of marching, as a share of the distance between nodes.
    step: f32,
    light: Option<LightVolume>,
    march: MarchAudit,
    sums: Vec<PairSums>,
    pairs: u64,
    /// Rank of the next pixel of each tile.
    cursors: Vec<u8>,
    /// Variance of a single sample per tile, from all rounds.
    tile_variance: Vec<f64>,
}

/// Squared errors of marching with the present step, on random pixels. The values are sums over pixels of the mean over channels.
#[derive(Debug, Clone, Copy, Default)]
struct MarchAudit {
    pixels: f64,
    /// Of the quadrature along the ray and to the light, for the mean of `FIRST_RAYS` rays.
    quadrature: f64,
    /// Of the mean of `FIRST_RAYS` rays as an integral over the pixel.
    filter: f64,
}

impl MarchAudit {
    fn quadrature(&self) -> f64 {
        self.quadrature / self.pixels.max(1.0)
    }

    /// For the mean of `rays` rays, which converges at least as fast as that of independent rays.
    fn filter(&self, rays: u64) -> f64 {
        self.filter / self.pixels.max(1.0) * FIRST_RAYS as f64 / rays.max(1) as f64
    }
}

/// Rank of a pixel within its tile, in the order in which pixels get samples: bits of x ^ y and y interleaved (ordered dithering, Bayer 1973).
fn rank(x: usize, y: usize) -> u8 {
    let (a, b) = (x ^ y, y);
    (0..4).fold(0, |rank, bit| rank << 2 | ((a >> bit & 1) << 1 | (b >> bit & 1)) as u8)
}

impl Picture {
    /// Forgets everything.
    pub fn restart(&mut self) {
        *self = Self::default();
    }

    /// Starts anew if the picture shows anything else. Returns true if it did.
    fn settle(&mut self, scene: &Scene, inverse_tau: f32, nodes: &Nodes, number: u64) -> bool {
        let same = |(shown, tau, old): &(Scene, f32, Nodes)| {
            shown == scene && *tau == inverse_tau && std::ptr::eq(old.values(), nodes.values())
        };
        if self.shows.as_ref().is_some_and(same) {
            return false;
        }
        let pixels = scene.settings.width * scene.settings.height;
        let tiles = scene.settings.width.div_ceil(TILE) * scene.settings.height.div_ceil(TILE);
        *self = Self {
            shows: Some((scene.clone(), inverse_tau, nodes.clone())),
            number,
            base: vec![RaySum::default(); pixels],
            sums: vec![PairSums::default(); pixels],
            // The steps of the last picture are likely to suit this one.
            step: if self.step > 0.0 { self.step } else { FIRST_STEP },
            next_rays: FIRST_RAYS,
            cursors: vec![0; tiles],
            tile_variance: vec![0.0; tiles],
            ..Self::default()
        };
        true
    }

    /// Pixels that get a pair in this round.
    fn choose(&mut self, width: usize, height: usize, pairs_per_pixel: f64) -> Vec<u32> {
        let (across, down) = (width.div_ceil(TILE), height.div_ceil(TILE));
        let spread = self.tile_variance.iter().map(|v| v.max(0.0).sqrt()).sum::<f64>() / self.tile_variance.len() as f64;
        let wanted = pairs_per_pixel * (TILE * TILE) as f64;
        let mut chosen = Vec::new();
        for tile in 0..across * down {
            let relative = if spread > 0.0 { self.tile_variance[tile].max(0.0).sqrt() / spread } else { 1.0 };
            let share = wanted * (EVEN_SHARE + (1.0 - EVEN_SHARE) * relative);
            // Which of two whole numbers is taken follows the tile's own sequence.
            let mut count = share.floor() as usize + usize::from(share.fract() * 256.0 > f64::from(self.cursors[tile]));
            let first = self.cursors[tile];
            let corner = [tile % across * TILE, tile / across * TILE];
            self.cursors[tile] = first.wrapping_add(count as u8);
            while count > 0 {
                let now = count.min(TILE * TILE);
                for y in 0..TILE {
                    for x in 0..TILE {
                        let place = usize::from(rank(x, y).wrapping_sub(first));
                        let inside = corner[0] + x < width && corner[1] + y < height;
                        if place < now && inside {
                            chosen.push(((corner[1] + y) * width + corner[0] + x) as u32);
                        }
                    }
                }
                count -= now;
            }
        }
        chosen
    }

    /// One round: more rays, more pairs, and the picture with its error. `None` if `stop` ended it early.
    pub(in crate::render) fn refine(
        &mut self,
        frame: &FrameScene<'_>,
        scene: &Scene,
        round: &Refinement<'_>,
        wave_flights: usize,
        answers: &mut dyn LogStretch,
    ) -> Option<(Film, RenderStats, PictureError)> {
        let began = Instant::now();
        let (width, height) = (frame.width, frame.height);
        let medium = Medium { scene: frame, nodes: round.nodes, missing: round.missing };
        self.settle(scene, frame.inverse_tau, round.nodes, round.number);
        let frame = &FrameScene { random: crate::render::rng::FrameRandom::new(scene.seed, self.number), ..*frame };
        let medium = Medium { scene: frame, ..medium };
        self.march(&medium, round.sum);

        // The picture changes below only when the samples are complete.
        let pairs_per_pixel = match round.method {
            Method::Marched => 1.0 / AUDIT_STRIDE,
            _ => round.samples / 2.0,
        };
        let cursors = self.cursors.clone();
        let chosen = self.choose(width, height, pairs_per_pixel);
        // Number of each pair within its pixel, which selects its random numbers.
        let mut next: Vec<u32> = self.sums.iter().map(PairSums::pairs).collect();
        let starts: Vec<u32> = chosen
            .iter()
            .map(|&pixel| {
                let number = &mut next[pixel as usize];
                *number += 1;
                *number - 1
            })
            .collect();
        let paths: Vec<(u32, u32)> =
            chosen.iter().zip(&starts).flat_map(|(&pixel, &pair)| [(pixel, 2 * pair), (pixel, 2 * pair + 1)]).collect();
        let (found, counts) = track(&medium, &paths, wave_flights, answers, round.stop);
        let mut stats = RenderStats {
            paths: paths.len() as u64,
            majorant_exceeded: counts.exceeded,
            missing: counts.missing,
            waves: counts.waves,
            evaluate_seconds: counts.evaluate_seconds,
            ..RenderStats::default()
        };
        if counts.stopped {
            self.cursors = cursors;
            return None;
        }
        for ((&pixel, &pair), halves) in chosen.iter().zip(&starts).zip(found.chunks_exact(2)) {
            let sums = &mut self.sums[pixel as usize];
            let (x, y) = (pixel as usize % width, pixel as usize / width);
            let quarter = (pair as usize + x + y) & 1;
            for (half, difference) in halves.iter().enumerate() {
                (0..3).for_each(|k| sums.radiance[half][quarter][k] += difference.radiance[k]);
                sums.alpha += difference.alpha;
                sums.queries += difference.queries;
                sums.traced += difference.traced;
                stats.queries += u64::from(difference.queries);
                stats.traced += u64::from(difference.traced);
            }
            sums.pairs[quarter] += 1;
        }
        self.pairs += chosen.len() as u64;
        self.measure_variance(width, height);

        let how = match (round.method, round.sum) {
            (Method::Marched, _) => Correction::Left,
            (_, true) => Correction::Summed,
            (_, false) => Correction::Shrunk,
        };
        let combined = combine(&self.sums, width, how);
        let (mut film, mut error) = self.film(scene, width, height, how, &combined);
        while self.march.quadrature() > MARCH_SHARE * error.rms.value.powi(2) && self.step > MIN_STEP {
            self.step *= 0.5;
            (self.next_rays, self.rays, self.light, self.march) = (self.rays, 0, None, MarchAudit::default());
            self.base.fill(RaySum::default());
            self.march(&medium, round.sum);
            (film, error) = self.film(scene, width, height, how, &combined);
        }
        let enough = self.march.filter(self.rays) <= MARCH_SHARE * error.rms.value.powi(2);
        self.next_rays = if enough { 1 } else { self.rays }.min(MAX_RAYS - self.rays.min(MAX_RAYS));
        stats.walk_seconds = began.elapsed().as_secs_f64() - stats.evaluate_seconds;
        Some((film, stats, error))
    }

    /// Mean square error of marching.
    fn march_error(&self) -> f64 {
        self.march.quadrature() + self.march.filter(self.rays)
    }

    /// Marches more rays, and compares some pixels with a finer march.
    fn march(&mut self, medium: &Medium<'_>, shift: bool) {
        if self.next_rays == 0 {
            return;
        }
        let refine = (FIRST_STEP / self.step).round().max(1.0) as usize;
        let light = &*self.light.get_or_insert_with(|| LightVolume::new(medium, LIGHT_VALUES, refine));
        let step = medium.spacing() as f32 * self.step;
        let rays = self.rays..self.rays + self.next_rays;
        self.base.par_iter_mut().enumerate().with_min_len(64).for_each(|(pixel, sum)| {
            for j in rays.clone() {
                sum.add(&medium.ray(pixel as u32, j, step, ToLight::Volume(light), shift));
            }
        });
        self.rays = rays.end;
        let pixels = self.base.len() as u64;
        let audited: Vec<[f64; 2]> = (0..MARCH_AUDIT)
            .into_par_iter()
            .map(|i| {
                let word = medium.scene.random.words((rays.start * MARCH_AUDIT + i) as u32, u32::MAX, AUDIT_DIMENSION)[0];
                let pixel = (u64::from(word) * pixels >> 32) as u32;
                let mean = |rays: std::ops::Range<u64>, step: f32, light: ToLight<'_>| {
                    let mut sum = RaySum::default();
                    rays.for_each(|j| sum.add(&medium.ray(pixel, j, step, light, shift)));
                    sum.radiance.map(|c| f64::from(c) / FIRST_RAYS as f64)
                };
                let coarse = mean(0..FIRST_RAYS, step, ToLight::Volume(light));
                let other = mean(FIRST_RAYS..2 * FIRST_RAYS, step, ToLight::Volume(light));
                let fine = mean(0..FIRST_RAYS, 0.25 * step, ToLight::March(0.5 * step));
                let square = |other: [f64; 3]| (0..3).map(|k| (coarse[k] - other[k]).powi(2)).sum::<f64>() / 3.0;
                // Both means have the error of the filter.
                [square(fine), 0.5 * square(other)]
            })
            .collect();
        for [quadrature, filter] in audited {
            self.march.pixels += 1.0;
            self.march.quadrature += quadrature;
            self.march.filter += filter;
        }
    }

    /// Estimates the variance of one sample in each tile, from the differences between halves.
    fn measure_variance(&mut self, width: usize, height: usize) {
        let across = width.div_ceil(TILE);
        let sums = &self.sums;
        self.tile_variance.par_iter_mut().enumerate().for_each(|(tile, variance)| {
            let (left, top) = (tile % across * TILE, tile / across * TILE);
            let (mut sum, mut pixels) = (0.0, 0.0);
            for y in top..(top + TILE).min(height) {
                for pixel in &sums[y * width + left..y * width + (left + TILE).min(width)] {
                    let pairs = f64::from(pixel.pairs());
                    if pairs > 0.0 {
                        let difference: f64 =
                            (0..3).map(|k| (0..2).map(|q| f64::from(pixel.radiance[0][q][k] - pixel.radiance[1][q][k])).sum::<f64>().powi(2)).sum();
                        // The sums of the halves differ by twice the pairs times the variance of one sample.
                        sum += difference / (6.0 * pairs);
                        pixels += 1.0;
                    }
                }
            }
            if pixels > 0.0 {
                *variance = sum / pixels;
            }
        });
        // A tile that happened to show no difference is not free of variance.
        let mean = self.tile_variance.iter().sum::<f64>() / self.tile_variance.len() as f64;
        self.tile_variance.iter_mut().for_each(|variance| *variance = variance.max(0.02 * mean));
    }

    fn film(&self, scene: &Scene, width: usize, height: usize, how: Correction, combined: &Combined) -> (Film, PictureError) {
        let pixels = width * height;
        let mut film = Film::new(width, height);
        let per_ray = 1.0 / self.rays as f32;
        for i in 0..pixels {
            let (base, sums, r) = (&self.base[i], &self.sums[i], combined.correction[i]);
            let alpha = base.alpha * per_ray;
            let [red, green, blue] = [0, 1, 2].map(|k| base.radiance[k] * per_ray + r[k]);
            film.rgba[i] = [red, green, blue, alpha];
            if how == Correction::Summed {
                film.rgba[i][3] += sums.alpha / (2 * sums.pairs().max(1)) as f32;
            }
            film.ftle_mean[i] = if base.alpha > 0.0 { base.ftle / base.alpha } else { f32::NAN };
            film.missing[i] = base.missing * per_ray;
            film.samples[i] = 2.0 * sums.pairs() as f32;
            film.queries[i] = sums.queries as f32;
            film.traced[i] = if sums.queries > 0 { sums.traced as f32 / sums.queries as f32 } else { 0.0 };
        }
        let error = self.error(scene, width, height, &film, combined);
        let mean: Vec<f32> = combined.squared.iter().map(|e| e[0].iter().sum::<f32>() / 3.0).collect();
        let floor = ERROR_FLOOR * (error.rms.value.powi(2) as f32);
        let march = self.march_error() as f32;
        film.error = smoothed(&mean, width, ERROR_RADIUS).into_iter().map(|e| (e.max(floor) + march).sqrt()).collect();
        (film, error)
    }

    /// The stated error, with intervals from the difference of two independent estimates in every tile.
    fn error(&self, scene: &Scene, width: usize, height: usize, film: &Film, combined: &Combined) -> PictureError {
        let [contrast, brightness, gamma] = scene.settings.tone_map;
        let slope = |c: f32| {
            let value = (f64::from(c) - 0.5) * contrast + brightness;
            // The map is constant where it saturates, and steep without bound at black; one 8-bit step bounds it.
            if value <= 0.0 || value >= 1.0 { 0.0 } else { contrast / gamma * value.max(1.0 / 255.0).powf(1.0 / gamma - 1.0) }
        };
        let across = width.div_ceil(TILE);
        let tiles = across * height.div_ceil(TILE);
        // Per tile and weighting (linear, relative, tone map over lit pixels, tone map over all): sums and numbers for all pairs and both quarters.
        let per_tile: Vec<[[[f64; 2]; 3]; 4]> = (0..tiles)
            .into_par_iter()
            .map(|tile| {
                let (left, top) = (tile % across * TILE, tile / across * TILE);
                let mut sums = [[[0.0; 2]; 3]; 4];
                for y in top..(top + TILE).min(height) {
                    for i in y * width + left..y * width + (left + TILE).min(width) {
                        let colour = film.rgba[i];
                        for (which, e) in combined.squared[i].iter().enumerate() {
                            if !e[0].is_finite() {
                                continue;
                            }
                            let mut add = |weighting: usize, weight: &dyn Fn(usize) -> f64| {
                                let mean: f64 = (0..3).map(|k| f64::from(e[k]) * weight(k)).sum::<f64>() / 3.0;
                                sums[weighting][which][0] += mean;
                                sums[weighting][which][1] += 1.0;
                            };
                            let tone = |k: usize| slope(colour[k]).powi(2);
                            add(3, &tone);
                            if colour[3] > LIT {
                                add(0, &|_| 1.0);
                                add(1, &|k| 1.0 / (f64::from(colour[k]).powi(2) + 0.01));
                                add(2, &tone);
                            }
                        }
                    }
                }
                sums
            })
            .collect();
        let estimate = |weighting: usize| {
            let (mut sum, mut count, mut variance) = (0.0, 0.0, 0.0);
            for tile in &per_tile {
                let [all, first, second] = tile[weighting];
                if all[1] == 0.0 {
                    continue;
                }
                sum += all[0];
                count += all[1];
                if first[1] > 0.0 && second[1] > 0.0 {
                    let half = 0.5 * (first[0] / first[1] - second[0] / second[1]) * all[1];
                    variance += half * half;
                }
            }
            let (mean, deviation) = (sum / f64::max(count, 1.0), f64::sqrt(variance) / f64::max(count, 1.0));
            // A mean below what the samples resolve says only that much.
            let value = mean.max(0.5 * deviation);
            ErrorEstimate { value, low: (value - NORMAL * deviation).max(0.0), high: value + NORMAL * deviation }
        };
        let march = self.march_error();
        let with_march = |e: ErrorEstimate, share: f64| e.map(|v| v + share);
        let decibels = |e: ErrorEstimate| {
            let e = e.map(|mse| -10.0 * mse.max(1e-12).log10());
            ErrorEstimate { value: e.value, low: e.high, high: e.low }
        };
        let linear = with_march(estimate(0), march);
        // The error of marching is measured without weights; it counts in proportion.
        let ratio = |e: ErrorEstimate| if linear.value > 0.0 { march * e.value / linear.value } else { 0.0 };
        let weighted = |weighting: usize| {
            let e = estimate(weighting);
            with_march(e, ratio(e))
        };
        PictureError {
            rms: linear.map(f64::sqrt),
            relmse: weighted(1),
            psnr: decibels(weighted(2)),
            psnr_all: decibels(weighted(3)),
            march_rms: march.sqrt(),
            samples_per_pixel: 2.0 * self.pairs as f64 / (width * height) as f64,
            rays_per_pixel: self.rays,
        }
    }
}
