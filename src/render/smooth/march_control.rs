//! How finely a picture is marched: its error is measured on random pixels and kept well below that of the picture.

use super::statement::{LIT, MarchError};
use super::tone::ToneMap;
use crate::rng::FrameRandom;

/// Two rays on opposite sides of the pixel's centre. Pictures of few samples begin with them: where pixels are no coarser than nodes, steps err more.
pub const PAIR: u64 = 2;
/// Rays through a point and its quarter turns around the centre. Beyond the first pair, pictures have whole ones.
pub(super) const QUARTER_TURNS: u64 = 4;
/// Most rays per pixel that a picture gets.
const MAX_RAYS: u64 = 64;
/// First step, as a share of the distance between nodes, and the smallest one.
const FIRST_STEP: f32 = 1.0;
const MIN_STEP: f32 = 1.0 / 16.0;
/// The mean square error of marching stays this share of the stated one (10 dB below it).
const SHARE: f64 = 0.1;
/// Once the error of the pixel filter is this share of what it may be, no more rays are marched.
const SPARE: f64 = 0.25;
/// Audits that a picture gets in any case with steps of one size, one a round.
const MIN_AUDITS: u64 = 4;
/// Pixels per audit, if there are as many. Most of the error is at edges, in few of them.
const AUDITED_PIXELS: u64 = 1024;
/// Numbers from which on the rays of audits count. No picture has as many.
pub const FIRST_AUDIT_RAY: u64 = 1 << 31;
/// Rays of each of the two nets of an audit.
pub const NET: u64 = 16;
/// Steps of an audit in one step of the march.
pub const AUDIT_STEPS: u64 = 4;
/// Number of lit pixels of an audit in which the depth to the light is marched, which takes long.
pub const LIT_BY_MARCH: usize = 24;
/// Steps to the light of an audit in one step of the march.
pub const LIGHT_STEPS: u64 = 2;
/// Counter word of the draw of these pixels, which no path reaches.
const AUDIT_DIMENSION: u32 = u32::MAX - 2;

/// An audited pixel: linear radiances, each the mean of some rays.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct AuditedPixel {
    /// Number of the pixel, row by row.
    pub pixel: u32,
    /// Radiance and opacity, the mean over all rays of the picture so far.
    pub shown: [f64; 4],
    /// Radiances of two nets of rays at independent random places: the product of the differences to them has the square of the pixel filter's error as
    /// its mean, since their own errors are independent (to first order in the tone-mapped weighting, whose slope is that towards their mean).
    pub nets: [[f64; 3]; 2],
    /// The first `PAIR` rays, as marched.
    pub pair: [f64; 3],
    /// The same with `AUDIT_STEPS` steps in one.
    pub fine: [f64; 3],
    /// The same, with the depth to the light marched instead of read from the light volume; `None` for most pixels.
    pub lit: Option<[f64; 3]>,
}

impl AuditedPixel {
    /// The march is made finer for errors over lit pixels alone.
    pub fn is_lit(&self) -> bool {
        self.shown[3] > f64::from(LIT)
    }
}

/// Mean over the channels of a product, in the weightings of [`super::TileErrors`] of a pixel that shows `shown` where `truth` is right.
pub(crate) fn weighted(a: [f64; 3], b: [f64; 3], tone_map: ToneMap, shown: [f64; 3], truth: [f64; 3]) -> [f64; 3] {
    let mut sums = [0.0; 3];
    for k in 0..3 {
        let (product, slope) = (a[k] * b[k] / 3.0, f64::from(tone_map.secant(shown[k] as f32, truth[k] as f32)));
        for (sum, weight) in sums.iter_mut().zip([1.0, 1.0 / (shown[k] * shown[k] + 0.01), slope * slope]) {
            *sum += product * weight;
        }
    }
    sums
}

/// A mean over audited pixels, in all weightings.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
struct Mean {
    sum: [f64; 3],
    squares: [f64; 3],
    count: f64,
}

impl Mean {
    fn add(&mut self, values: [f64; 3]) {
        for (w, value) in values.into_iter().enumerate() {
            self.sum[w] += value;
            self.squares[w] += value * value;
        }
        self.count += 1.0;
    }

    fn mean(&self, weighting: usize) -> f64 {
        self.sum[weighting] / self.count.max(1.0)
    }

    /// Standard error of the mean. A single value is its own standard error.
    fn deviation(&self, weighting: usize) -> f64 {
        let (n, mean) = (self.count, self.mean(weighting));
        if n > 1.0 { ((self.squares[weighting] / n - mean * mean).max(0.0) / (n - 1.0)).sqrt() } else { mean.abs() }
    }

    /// The mean. Below half of its standard error it says no more than that.
    fn value(&self, weighting: usize) -> f64 {
        self.mean(weighting).max(0.5 * self.deviation(weighting))
    }
}

/// State of the march of a picture.
#[derive(Debug, Clone, PartialEq)]
pub struct MarchControl {
    /// Rays per pixel so far.
    pub rays: u64,
    /// Rays per pixel to march next.
    pub next_rays: u64,
    /// Step, as a share of the distance between nodes.
    pub step: f32,
    /// Number of audits so far, and when the steps became what they are.
    audits: u64,
    audits_before: u64,
    /// The pixels of these audits.
    audited: Vec<AuditedPixel>,
    /// Squared errors of the pixel filter, of the steps and of the light volume, and twice the product of the last two.
    filter: Mean,
    steps: Mean,
    light: Mean,
    both: Mean,
    /// Squared error of the pixel filter where nothing is lit.
    unlit: Mean,
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
        let [filter, steps, light, both, unlit] = [Mean::default(); 5];
        Self {
            rays: 0,
            next_rays: PAIR,
            step: FIRST_STEP,
            audits: 0,
            audits_before: 0,
            audited: Vec::new(),
            filter,
            steps,
            light,
            both,
            unlit,
        }
    }
}

impl MarchControl {
    /// The control of another picture. The steps of the last one are likely to suit it.
    pub fn restarted(&self) -> Self {
        Self { step: self.step, ..Self::default() }
    }

    /// The control of the same view of other nodes. It gets as many rays at once, so that the picture becomes no coarser than it was, or as many as a
    /// budget has time for.
    pub fn on_other_nodes(&self) -> Self {
        Self { next_rays: self.rays.clamp(PAIR, MAX_RAYS), ..self.restarted() }
    }

    /// The first round of a picture has a pair of rays, or its quarter turns too if it has more than one sample a pixel, which take longer than they do.
    pub fn begin(&mut self, samples: f64) {
        if self.rays == 0 && samples > 1.0 {
            self.next_rays = self.next_rays.max(QUARTER_TURNS);
        }
    }

    /// Rays up to the next whole quarter turns.
    fn to_whole_turns(&self) -> u64 {
        QUARTER_TURNS - self.rays % QUARTER_TURNS
    }

    /// Leaves rays to later rounds, if there is time for no more than `rays` now.
    pub fn at_most(&mut self, rays: u64) {
        let whole = (self.rays + rays) / QUARTER_TURNS * QUARTER_TURNS;
        let least = if self.rays == 0 { PAIR } else { self.to_whole_turns() };
        self.next_rays = self.next_rays.min(whole.saturating_sub(self.rays).max(least));
    }

    /// Divisor of the distances in the light volume.
    pub fn refine(&self) -> usize {
        (FIRST_STEP / self.step).round().max(1.0) as usize
    }

    /// Returns true if rays are to be marched or pixels to be audited.
    pub fn is_due(&self) -> bool {
        self.next_rays > 0 || self.audits < self.audits_before + MIN_AUDITS
    }

    /// Pixels of the next audit, others in each: one in each of as many equal parts of the picture, so that none is drawn twice. In random order, since some
    /// quantities are measured on the first few.
    pub fn audit_pixels(&mut self, random: &FrameRandom, pixels: usize) -> Vec<u32> {
        let first = self.audits * AUDITED_PIXELS;
        self.audits += 1;
        let (pixels, count) = (pixels as u64, AUDITED_PIXELS.min(pixels as u64));
        let start = |part: u64| part * pixels / count;
        let draw = |part: u64| {
            let [within, order, ..] = random.words((first + part) as u32, u32::MAX, AUDIT_DIMENSION);
            (order, (start(part) + ((u64::from(within) * (start(part + 1) - start(part))) >> 32)) as u32)
        };
        let mut drawn: Vec<(u32, u32)> = (0..count).map(draw).collect();
        drawn.sort_unstable();
        drawn.into_iter().map(|(_, pixel)| pixel).collect()
    }

    /// The pixels that have been audited. Their `shown` follows the picture.
    pub fn audited_mut(&mut self) -> &mut [AuditedPixel] {
        &mut self.audited
    }

    /// First rays of the two nets of the latest audit, other ones in each: a pixel may be drawn again.
    pub fn nets(&self) -> [u64; 2] {
        let first = FIRST_AUDIT_RAY + 2 * NET * self.audits.saturating_sub(1);
        [first, first + NET]
    }

    /// Takes in audited pixels and what all of them show now. `tone_map` is that of the picture.
    pub fn audit(&mut self, pixels: impl IntoIterator<Item = AuditedPixel>, tone_map: ToneMap) {
        self.audited.extend(pixels);
        [self.filter, self.steps, self.light, self.both, self.unlit] = [Mean::default(); 5];
        let minus = |a: [f64; 3], b: [f64; 3]| std::array::from_fn(|k| a[k] - b[k]);
        for pixel in &self.audited {
            let [red, green, blue, _] = pixel.shown;
            let (shown, [one, other]) = ([red, green, blue], pixel.nets);
            let truth = std::array::from_fn(|k| 0.5 * (one[k] + other[k]));
            let filter = weighted(minus(shown, one), minus(shown, other), tone_map, shown, truth);
            if !pixel.is_lit() {
                self.unlit.add(filter);
                continue;
            }
            self.filter.add(filter);
            let (pair, fine, steps) = (pixel.pair, pixel.fine, minus(pixel.pair, pixel.fine));
            self.steps.add(weighted(steps, steps, tone_map, pair, fine));
            if let Some(lit) = pixel.lit {
                let light = minus(fine, lit);
                self.light.add(weighted(light, light, tone_map, pair, lit));
                self.both.add(weighted(steps, light, tone_map, pair, lit).map(|product| 2.0 * product));
            }
        }
    }

    /// Error of the steps and of the light volume together. That they cancel is not trusted, since it was seen on few pixels.
    fn quadrature(&self, weighting: usize) -> f64 {
        self.steps.value(weighting) + self.light.value(weighting) + self.both.mean(weighting).max(0.0)
    }

    /// Mean square error of marching, mean over channels.
    pub fn error(&self) -> f64 {
        self.quadrature(0) + self.filter.value(0)
    }

    /// Mean square errors of marching, in all weightings.
    pub fn errors(&self) -> MarchError {
        let deviation = |w: usize| {
            // Those of steps and light are of the same pixels and may add up.
            let both = if self.both.mean(w) > 0.0 { self.both.deviation(w) } else { 0.0 };
            (self.steps.deviation(w) + self.light.deviation(w) + both).hypot(self.filter.deviation(w))
        };
        let squared = std::array::from_fn(|w| self.quadrature(w) + self.filter.value(w));
        MarchError { squared, deviation: std::array::from_fn(deviation), unlit: [self.unlit.value(2), self.unlit.deviation(2)] }
    }

    /// Decides how to go on if the rest of the picture has the mean square error `others`. With `may_go_on` false the rest is left to later rounds.
    pub fn decide(&mut self, others: f64, may_go_on: bool) -> Marching {
        let allowed = SHARE * others.max(0.0);
        let wanted = self.filter.value(0) > SPARE * allowed;
        self.next_rays = if wanted && self.rays < MAX_RAYS { self.to_whole_turns() } else { 0 };
        if !may_go_on {
            return Marching::Enough;
        }
        if self.quadrature(0) > allowed && self.step > MIN_STEP {
            let next_rays = self.rays.max(PAIR);
            *self = Self { step: 0.5 * self.step, next_rays, audits: self.audits, audits_before: self.audits, ..Self::default() };
            return Marching::Anew;
        }
        if self.filter.value(0) > allowed && self.rays < MAX_RAYS {
            self.next_rays = self.rays.min(MAX_RAYS - self.rays);
            return Marching::More;
        }
        Marching::Enough
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn audits_draw_each_part_of_a_picture_once() {
        let random = FrameRandom::new(5, 3);
        let mut control = MarchControl::default();
        let mut first_ones = Vec::new();
        for pixels in [12_800_usize, 1500, 1024, 700, 1] {
            let [mut one, other] = [0; 2].map(|_| control.audit_pixels(&random, pixels));
            // Another order, and other pixels where a part has several.
            assert!(one != other || pixels == 1);
            first_ones.extend(one[..24.min(one.len())].iter().map(|&pixel| f64::from(pixel) / pixels as f64));
            one.sort_unstable();
            let count = pixels.min(1024);
            assert_eq!(one.len(), count);
            assert!(
                one.iter()
                    .enumerate()
                    .all(|(part, &pixel)| (part * pixels / count..(part + 1) * pixels / count).contains(&(pixel as usize)))
            );
        }
        // The first ones lie anywhere: in the upper half as often as in the lower, within four standard deviations.
        let upper = first_ones.iter().filter(|&&place| place < 0.5).count() as f64;
        let half = first_ones.len() as f64 / 2.0;
        assert!((upper - half).abs() < 4.0 * (half / 2.0).sqrt(), "{upper} of {}", first_ones.len());
    }

    #[test]
    fn pixels_that_are_not_lit_have_an_error_of_their_own() {
        let mut control = MarchControl::default();
        // The nets lie 0.1 beside what is shown: at the edge of land, and in a lit pixel.
        let pixel = |alpha: f64, net: f64| AuditedPixel { shown: [0.5, 0.5, 0.5, alpha], nets: [[net; 3]; 2], ..AuditedPixel::default() };
        control.audit([pixel(0.0, 0.6), pixel(0.0, 0.5), pixel(1.0, 0.8)], ToneMap::new([1.0, 0.5, 1.0]));
        let found = control.errors();
        assert!((found.unlit[0] - 0.005).abs() < 1e-6 && found.unlit[1] > 0.0, "{found:?}");
        assert!((found.squared[2] - 0.09).abs() < 1e-6, "{found:?}");
    }

    /// Beyond the first pair a picture has rays in fours, also if time allows few at once.
    #[test]
    fn rays_come_in_quarter_turns() {
        let pixel = AuditedPixel { shown: [1.0; 4], pair: [1.0; 3], fine: [1.0; 3], nets: [[0.5; 3]; 2], ..AuditedPixel::default() };
        for (may_go_on, most, expected) in [
            (false, 64, vec![2, 4, 8, 12, 16]),
            (true, 64, vec![2, 4, 8, 16, 32, 64]),
            (true, 6, vec![2, 4, 8, 12, 16]),
            (true, 0, vec![2, 4, 8, 12, 16]),
        ] {
            let mut control = MarchControl::default();
            let rays: Vec<u64> = (0..expected.len())
                .map(|_| {
                    control.at_most(most);
                    control.rays += control.next_rays;
                    control.audit([pixel], ToneMap::new([1.0, 0.5, 1.0]));
                    control.decide(1e-6, may_go_on);
                    control.rays
                })
                .collect();
            assert_eq!(rays, expected, "{may_go_on}, {most}");
        }
        // Other nodes begin with as many, or with a pair.
        let mut control = MarchControl { rays: 8, ..MarchControl::default() }.on_other_nodes();
        control.at_most(3);
        assert_eq!((control.rays, control.next_rays), (0, 2));
    }

    /// After steps were halved, the statement rests on as many audits as at first.
    #[test]
    fn smaller_steps_are_audited_as_often() {
        let random = FrameRandom::new(1, 0);
        let mut control = MarchControl::default();
        let pixel = AuditedPixel { shown: [1.0; 4], pair: [1.0; 3], fine: [0.5; 3], nets: [[1.0; 3]; 2], ..AuditedPixel::default() };
        let rounds = |control: &mut MarchControl, others: f64| {
            let mut count = 0;
            while control.is_due() {
                control.audit_pixels(&random, 5000);
                control.audit([pixel], ToneMap::new([1.0, 0.5, 1.0]));
                control.rays += control.next_rays;
                count += 1;
                if control.decide(others, true) == Marching::Anew {
                    return (count, true);
                }
            }
            (count, false)
        };
        // Nothing is asked of the march.
        assert_eq!(rounds(&mut control, 1e6), (MIN_AUDITS, false));
        control.next_rays = PAIR;
        assert_eq!(rounds(&mut control, 1e-6), (1, true));
        assert_eq!((control.step, rounds(&mut control, 1e6)), (0.5 * FIRST_STEP, (MIN_AUDITS, false)));
    }
}
