//! How finely a picture is marched: its error is measured on random pixels and kept well below that of the picture.

use crate::rng::FrameRandom;

/// Rays per pixel of the first round. They come two by two, on opposite sides of the pixel's centre.
pub const FIRST_RAYS: u64 = 2;
/// Rays per pixel that a picture gets in any case, one pair a round, and the most it gets.
const MIN_RAYS: u64 = 4;
const MAX_RAYS: u64 = 64;
/// First step, as a share of the distance between nodes, and the smallest one.
const FIRST_STEP: f32 = 1.0;
const MIN_STEP: f32 = 1.0 / 16.0;
/// The mean square error of marching stays this share of the stated one (10 dB below it).
const SHARE: f64 = 0.1;
/// Once the error of the pixel filter is this share of what it may be, no more rays are marched.
const SPARE: f64 = 0.25;
/// Audits that a picture gets in any case, one a round.
const MIN_AUDITS: u64 = 8;
/// Pixels per call whose rays are compared with others of the same pixel.
const AUDITED_PIXELS: u64 = 256;
/// Number of audited pixels whose rays are compared with a finer march as well.
pub const FINELY_AUDITED: usize = 24;
/// Counter word of the draw of these pixels, which no path reaches.
const AUDIT_DIMENSION: u32 = u32::MAX - 2;

/// State of the march of a picture.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MarchControl {
    /// Rays per pixel so far.
    pub rays: u64,
    /// Rays per pixel to march next.
    pub next_rays: u64,
    /// Step, as a share of the distance between nodes.
    pub step: f32,
    /// Sums of squared errors over the audited pixels: of quadrature, and of the pixel filter, for the mean of `FIRST_RAYS` rays.
    audited: [f64; 2],
    quadrature: f64,
    filter: f64,
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
        Self { rays: 0, next_rays: FIRST_RAYS, step: FIRST_STEP, audited: [0.0; 2], quadrature: 0.0, filter: 0.0, audits: 0 }
    }
}

impl MarchControl {
    /// The control of another picture. The steps of the last one are likely to suit it.
    pub fn restarted(self) -> Self {
        Self { step: self.step, ..Self::default() }
    }

    /// Divisor of the distances in the light volume.
    pub fn refine(&self) -> usize {
        (FIRST_STEP / self.step).round().max(1.0) as usize
    }

    /// Returns true if rays are to be marched or pixels to be audited.
    pub fn is_due(&self) -> bool {
        self.next_rays > 0 || self.audits < MIN_AUDITS
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

    /// Takes in an audited pixel: the means of rays 0 to `FIRST_RAYS` and of as many following ones as marched, and the former marched finely.
    pub fn audit(&mut self, coarse: [f64; 3], following: [f64; 3], fine: Option<[f64; 3]>) {
        let square = |a: [f64; 3], b: [f64; 3]| (0..3).map(|k| (a[k] - b[k]).powi(2)).sum::<f64>() / 3.0;
        // Pixels that show the background alone agree exactly. They do not count, since errors are stated over lit pixels.
        let filter = square(coarse, following);
        if filter > 0.0 {
            self.audited[0] += 1.0;
            // Both means have the error of the filter.
            self.filter += 0.5 * filter;
        }
        let quadrature = fine.map_or(0.0, |fine| square(coarse, fine));
        if quadrature > 0.0 {
            self.audited[1] += 1.0;
            self.quadrature += quadrature;
        }
    }

    fn quadrature(&self) -> f64 {
        self.quadrature / self.audited[1].max(1.0)
    }

    /// Error of the pixel filter, which falls at least as fast as with independent rays.
    fn filter(&self) -> f64 {
        self.filter / self.audited[0].max(1.0) * FIRST_RAYS as f64 / self.rays.max(1) as f64
    }

    /// Mean square error of marching, mean over channels.
    pub fn error(&self) -> f64 {
        self.quadrature() + self.filter()
    }

    /// Decides how to go on if the rest of the picture has the mean square error `others`. With `may_go_on` false the rest is left to later rounds.
    pub fn decide(&mut self, others: f64, may_go_on: bool) -> Marching {
        let allowed = SHARE * others.max(0.0);
        let wanted = self.rays < MIN_RAYS || self.filter() > SPARE * allowed;
        self.next_rays = if wanted && self.rays < MAX_RAYS { FIRST_RAYS } else { 0 };
        if !may_go_on {
            return Marching::Enough;
        }
        if self.quadrature() > allowed && self.step > MIN_STEP {
            let next_rays = self.rays.max(FIRST_RAYS);
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
