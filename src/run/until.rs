//! How far a picture is that is refined until its stated error is within a target.

use crate::progress::Work;
use crate::render::smooth::PictureError;
use crate::render::{Method, Target, UNTIL_SLACK};
use std::time::Instant;

/// Tells how far such a picture is.
#[derive(Debug, Default)]
pub(super) struct Refining {
    /// `None` before the first frame. With the samples per pixel and the frames so far.
    work: Option<(Work, f64, usize)>,
}

impl Refining {
    /// Tells of a frame by `method` that began at `start`. The slide gets `left` more at most.
    pub(super) fn tell(&mut self, method: Method, target: Target, error: &PictureError, start: Instant, left: usize) {
        let samples = error.samples_per_pixel;
        // A picture that has started anew has fewer.
        let before = self.work.take().filter(|(_, before, _)| *before < samples);
        let (work, frames) = match before {
            Some((work, _, frames)) => (work, frames + 1),
            None => (Work::begun(format!("refining to {target}"), start), 1),
        };
        let (state, share) = outlook(method, target, error, frames, left);
        work.stands(state);
        work.reached_share(share);
        self.work = Some((work, samples, frames));
    }
}

/// How far a picture is after so many frames, in words and as a share of the frames.
fn outlook(method: Method, target: Target, error: &PictureError, frames: usize, left: usize) -> (String, f64) {
    let stated = match target {
        Target::Psnr(_) => format!("{:.1} dB", error.psnr.value),
        Target::Relmse(_) => format!("relmse {:.1e}", error.relmse.value),
    };
    // Frames of `marched` do not become better.
    let share = if method == Method::Marched { 0.0 } else { share_of_samples(target, error) };
    let wanted = ((frames as f64 / share).ceil() as usize).max(frames + 1);
    let (about, all) = if wanted <= frames + left { ("about", wanted) } else { ("at most", frames + left) };
    (format!("{stated} after {frames} of {about} {all} frames"), frames as f64 / all.max(1) as f64)
}

/// Share of the samples that a target needs: the squared error falls in proportion to their number. 0 if it is not known.
fn share_of_samples(target: Target, error: &PictureError) -> f64 {
    // Both conditions of `Target::is_met_by`.
    let share = match target {
        Target::Psnr(decibels) => {
            let worse = decibels - 10.0 * UNTIL_SLACK.log10();
            10f64.powf(-0.1 * (decibels - error.psnr.value).max(worse - error.psnr.low))
        }
        Target::Relmse(most) => (most / error.relmse.value).min(UNTIL_SLACK * most / error.relmse.high),
    };
    if share.is_finite() { share.min(1.0) } else { 0.0 }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::render::smooth::ErrorEstimate;

    fn stated(psnr: [f64; 3], relmse: [f64; 3]) -> PictureError {
        let of = |[value, low, high]: [f64; 3]| ErrorEstimate { value, low, high };
        PictureError { psnr: of(psnr), relmse: of(relmse), samples_per_pixel: 1.0, ..PictureError::default() }
    }

    #[test]
    fn frames_to_a_target_are_extrapolated_as_the_squared_error_falls() {
        let error = stated([30.0, 29.9, 30.1], [4e-3, 3.9e-3, 4.1e-3]);
        let told = |target, frames, left| outlook(Method::TwoLevel, target, &error, frames, left);
        assert_eq!(told(Target::Psnr(40.0), 3, 4000), ("30.0 dB after 3 of about 30 frames".to_owned(), 0.1));
        assert_eq!(told(Target::Relmse(1e-3), 3, 4000), ("relmse 4.0e-3 after 3 of about 12 frames".to_owned(), 0.25));
        assert_eq!(told(Target::Psnr(40.0), 3, 7), ("30.0 dB after 3 of at most 10 frames".to_owned(), 0.3), "no slide gets more");
        let marched = outlook(Method::Marched, Target::Psnr(40.0), &error, 3, 7);
        assert_eq!(marched.0, "30.0 dB after 3 of at most 10 frames", "it does not improve");
        // The estimate is within the target, the worse end of its interval is not yet.
        let wide = stated([40.5, 36.0, 45.0], [1e-3; 3]);
        let (text, share) = outlook(Method::Map, Target::Psnr(40.0), &wide, 10, 4000);
        assert!(text.starts_with("40.5 dB after 10 of about ") && share < 0.5, "{text}, {share}");
        let unknown = stated([f64::NAN; 3], [f64::NAN; 3]);
        assert_eq!(outlook(Method::Map, Target::Relmse(1e-3), &unknown, 2, 8).1, 0.2);
    }

    #[test]
    fn a_picture_that_starts_anew_counts_its_frames_anew() {
        let (mut refining, start) = (Refining::default(), Instant::now());
        let mut frames_at = |samples_per_pixel| {
            let error = PictureError { samples_per_pixel, ..stated([30.0; 3], [4e-3; 3]) };
            refining.tell(Method::TwoLevel, Target::Psnr(40.0), &error, start, 100);
            refining.work.as_ref().map(|(.., frames)| *frames)
        };
        assert_eq!([1.0, 2.0, 3.0, 1.0, 2.0].map(|samples| frames_at(samples).unwrap()), [1, 2, 3, 1, 2]);
    }
}
