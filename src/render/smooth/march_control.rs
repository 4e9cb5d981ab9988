//! How finely a picture is marched: its error is measured on random pixels and kept well below that of the picture.

use super::statement::{LIT, MarchError};
use super::tone::ToneMap;
use crate::rng::FrameRandom;

/// Rays come two by two, on opposite sides of the pixel's centre.
pub const PAIR: u64 = 2;
/// Rays per pixel of the first round and, at least, of others: two pairs, a quarter turn apart.
pub const MIN_RAYS: u64 = 4;
/// Most rays per pixel that a picture gets.
const MAX_RAYS: u64 = 64;
/// First step, as a share of the distance between nodes, and the smallest one.
const FIRST_STEP: f32 = 1.0;
const MIN_STEP: f32 = 1.0 / 16.0;
/// The mean square error of marching stays this share of the stated one (10 dB below it).
const SHARE: f64 = 0.1;
/// Once the error of the pixel filter is this share of what it may be, no more rays are marched.
const SPARE: f64 = 0.25;
/// Audits that a picture gets in any case, one a round.
const MIN_AUDITS: u64 = 4;
/// Pixels per audit. Most of the error is at edges, in few of them.
const AUDITED_PIXELS: u64 = 1024;
/// Rays of an audit that follow those it compares. They share no coordinate with them, so that edges along the axes show too.
pub const AUDIT_RAYS: u64 = 32;
/// Steps of an audit in one step of the march.
pub const AUDIT_STEPS: u64 = 4;
/// Number of lit pixels of an audit in which the depth to the light is marched, which takes long.
pub const LIT_BY_MARCH: usize = 24;
/// Steps to the light of an audit in one step of the march.
pub const LIGHT_STEPS: u64 = 2;
/// Counter word of the draw of these pixels, which no path reaches.
const AUDIT_DIMENSION: u32 = u32::MAX - 2;

/// An audited pixel: linear radiances, each the mean of some rays.
#[derive(Debug, Clone, Copy, Default)]
pub struct AuditedPixel {
    /// Opacity, the mean over all of its rays.
    pub alpha: f64,
    /// The first [`MarchControl::audited_rays`] rays, as marched.
    pub first: [f64; 3],
    /// The `AUDIT_RAYS` rays that follow.
    pub following: [f64; 3],
    /// The first `PAIR` rays, as marched.
    pub pair: [f64; 3],
    /// The same with `AUDIT_STEPS` steps in one.
    pub fine: [f64; 3],
    /// The same, with the depth to the light marched instead of read from the light volume; `None` for most pixels.
    pub lit: Option<[f64; 3]>,
}

impl AuditedPixel {
    /// Errors are stated over lit pixels, so that others do not count.
    pub fn is_lit(&self) -> bool {
        self.alpha > f64::from(LIT)
    }
}

/// A mean over audited pixels.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
struct Mean {
    sum: f64,
    squares: f64,
    count: f64,
}

impl Mean {
    fn add(&mut self, value: f64) {
        self.sum += value;
        self.squares += value * value;
        self.count += 1.0;
    }

    fn mean(&self) -> f64 {
        self.sum / self.count.max(1.0)
    }

    /// Standard error of the mean. A single value is its own standard error.
    fn deviation(&self) -> f64 {
        let (n, mean) = (self.count, self.mean());
        if n > 1.0 { ((self.squares / n - mean * mean).max(0.0) / (n - 1.0)).sqrt() } else { mean.abs() }
    }

    /// The mean and its standard error, added up: few pixels hold most of the error, so that the mean alone is often too low.
    fn bound(&self) -> f64 {
        self.mean() + self.deviation()
    }
}

/// Sums of squared differences in the weightings of [`super::TileErrors`]: their ratios turn a mean square error into a weighted one.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
struct WeightedSquares([f64; 3]);

impl WeightedSquares {
    fn add(&mut self, tone_map: ToneMap, factor: f64, shown: [f64; 3], truth: [f64; 3]) {
        for (shown, truth) in shown.into_iter().zip(truth) {
            let square = factor * (shown - truth).powi(2);
            let toned = square * f64::from(tone_map.secant(shown as f32, truth as f32)).powi(2);
            for (sum, value) in self.0.iter_mut().zip([square, square / (shown * shown + 0.01), toned]) {
                *sum += value;
            }
        }
    }

    /// A mean square error in all weightings.
    fn weighted(&self, mean_square: f64) -> [f64; 3] {
        if self.0[0] > 0.0 { self.0.map(|sum| mean_square * sum / self.0[0]) } else { [mean_square; 3] }
    }
}

/// State of the march of a picture.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MarchControl {
    /// Rays per pixel so far.
    pub rays: u64,
    /// Rays per pixel to march next.
    pub next_rays: u64,
    /// Step, as a share of the distance between nodes.
    pub step: f32,
    /// Squared errors of the pixel filter times its rays, of the steps and of the light volume, and twice the product of the last two.
    filter: Mean,
    steps: Mean,
    light: Mean,
    both: Mean,
    /// Weights of the error of the pixel filter, and of that of steps and light volume.
    filter_weights: WeightedSquares,
    quadrature_weights: WeightedSquares,
    /// Number of audits so far.
    audits: u64,
}

/// What to do after a round.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Marching {
    /// The march is fine enough.
    Enough,
    /// Forget the rays and the light volume, and march with the smaller step.
    Anew,
    /// March `next_rays` more rays.
    More,
}

impl Default for MarchControl {
    fn default() -> Self {
        let (none, unweighted) = (Mean::default(), WeightedSquares::default());
        Self {
            rays: 0,
            next_rays: MIN_RAYS,
            step: FIRST_STEP,
            filter: none,
            steps: none,
            light: none,
            both: none,
            filter_weights: unweighted,
            quadrature_weights: unweighted,
            audits: 0,
        }
    }
}

impl MarchControl {
    /// The control of another picture. The steps of the last one are likely to suit it.
    pub fn restarted(self) -> Self {
        Self { step: self.step, ..Self::default() }
    }

    /// The control of the same view of other nodes. It gets as many rays at once, so that the picture becomes no coarser than it was.
    pub fn on_other_nodes(self) -> Self {
        Self { next_rays: self.rays.clamp(MIN_RAYS, MAX_RAYS), ..self.restarted() }
    }

    /// Divisor of the distances in the light volume.
    pub fn refine(&self) -> usize {
        (FIRST_STEP / self.step).round().max(1.0) as usize
    }

    /// Returns true if rays are to be marched or pixels to be audited.
    pub fn is_due(&self) -> bool {
        self.next_rays > 0 || self.audits < MIN_AUDITS
    }

    /// Rays of the picture that an audit compares with those that follow.
    pub fn audited_rays(&self) -> u64 {
        self.rays.clamp(MIN_RAYS, AUDIT_RAYS)
    }

    /// Pixels of the next audit, others in each.
    pub fn audit_pixels(&mut self, random: &FrameRandom, pixels: usize) -> Vec<u32> {
        let first = self.audits * AUDITED_PIXELS;
        self.audits += 1;
        let pixel = |i: u64| {
            let word = random.words((first + i) as u32, u32::MAX, AUDIT_DIMENSION)[0];
            ((u64::from(word) * pixels as u64) >> 32) as u32
        };
        (0..AUDITED_PIXELS).map(pixel).collect()
    }

    /// Takes in an audited pixel, if it is lit. `tone_map` is that of the picture.
    pub fn audit(&mut self, pixel: &AuditedPixel, tone_map: ToneMap) {
        if !pixel.is_lit() {
            return;
        }
        let minus = |a: [f64; 3], b: [f64; 3]| std::array::from_fn(|k| a[k] - b[k]);
        let dot = |a: [f64; 3], b: [f64; 3]| (0..3).map(|k| a[k] * b[k]).sum::<f64>() / 3.0;
        // The rays that follow err too: by at least this share of the error of the first, if errors fall no faster than with the square of the number.
        let (filter, rays) = (minus(pixel.first, pixel.following), self.audited_rays() as f64);
        let factor = rays / (1.0 + (rays / AUDIT_RAYS as f64).powi(2));
        self.filter.add(factor * dot(filter, filter));
        self.filter_weights.add(tone_map, factor, pixel.first, pixel.following);
        self.quadrature_weights.add(tone_map, 1.0, pixel.pair, pixel.lit.unwrap_or(pixel.fine));
        let steps = minus(pixel.pair, pixel.fine);
        self.steps.add(dot(steps, steps));
        if let Some(lit) = pixel.lit {
            let light = minus(pixel.fine, lit);
            self.light.add(dot(light, light));
            self.both.add(2.0 * dot(steps, light));
        }
    }

    /// Error of the steps and of the light volume together. That they cancel is not trusted, since it was seen on few pixels.
    fn quadrature(&self) -> f64 {
        self.steps.bound() + self.light.bound() + self.both.bound().max(0.0)
    }

    /// Error of the pixel filter, which falls about as that of independent rays or faster.
    fn filter(&self) -> f64 {
        self.filter.bound() / self.rays.max(1) as f64
    }

    /// Mean square error of marching, mean over channels.
    pub fn error(&self) -> f64 {
        self.quadrature() + self.filter()
    }

    /// Mean square errors of marching, in all weightings.
    pub fn errors(&self) -> MarchError {
        let (quadrature, filter) = (self.quadrature_weights.weighted(self.quadrature()), self.filter_weights.weighted(self.filter()));
        // All are of the same pixels, so that their deviations may add up.
        let both = if self.both.bound() > 0.0 { self.both.deviation() } else { 0.0 };
        let deviation = self.steps.deviation() + self.light.deviation() + both + self.filter.deviation() / self.rays.max(1) as f64;
        MarchError { squared: std::array::from_fn(|w| quadrature[w] + filter[w]), deviation }
    }

    /// Decides how to go on if the rest of the picture has the mean square error `others`. With `may_go_on` false the rest is left to later rounds.
    pub fn decide(&mut self, others: f64, may_go_on: bool) -> Marching {
        let allowed = SHARE * others.max(0.0);
        let wanted = self.filter() > SPARE * allowed;
        self.next_rays = if wanted && self.rays < MAX_RAYS { MIN_RAYS } else { 0 };
        if !may_go_on {
            return Marching::Enough;
        }
        if self.quadrature() > allowed && self.step > MIN_STEP {
            let next_rays = self.rays.max(MIN_RAYS);
            *self = Self { step: 0.5 * self.step, next_rays, audits: self.audits, ..Self::default() };
            return Marching::Anew;
        }
        if self.filter() > allowed && self.rays < MAX_RAYS {
            self.next_rays = self.rays.min(MAX_RAYS - self.rays);
            return Marching::More;
        }
        Marching::Enough
    }
}
