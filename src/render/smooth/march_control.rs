//! How finely a picture is marched: its error is measured on random pixels and kept well below that of the picture.

use crate::rng::FrameRandom;

/// Rays per pixel of the first round. Later rounds add one each.
pub const FIRST_RAYS: u64 = 2;
const MAX_RAYS: u64 = 64;
/// First step, as a share of the distance between nodes, and the smallest one.
const FIRST_STEP: f32 = 1.0;
const MIN_STEP: f32 = 1.0 / 16.0;
/// The mean square error of marching stays this share of the stated one (10 dB below it).
const SHARE: f64 = 0.1;
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
        Self { rays: 0, next_rays: FIRST_RAYS, step: FIRST_STEP, audited: [0.0; 2], quadrature: 0.0, filter: 0.0 }
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

    /// Pixels to audit after the rays from `rays` on.
    pub fn audit_pixels(&self, random: &FrameRandom, pixels: usize) -> Vec<u32> {
        let pixel = |i: u64| {
            let word = random.words((self.rays * AUDITED_PIXELS + i) as u32, u32::MAX, AUDIT_DIMENSION)[0];
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
        if !may_go_on {
            self.next_rays = u64::from(self.rays < MAX_RAYS);
            return Marching::Enough;
        }
        let allowed = SHARE * others.max(0.0);
        if self.quadrature() > allowed && self.step > MIN_STEP {
            *self = Self { step: 0.5 * self.step, next_rays: self.rays.max(FIRST_RAYS), ..Self::default() };
            return Marching::Anew;
        }
        if self.filter() > allowed && self.rays < MAX_RAYS {
            self.next_rays = self.rays;
            return Marching::More;
        }
        self.next_rays = u64::from(self.rays < MAX_RAYS);
        Marching::Enough
    }
}
