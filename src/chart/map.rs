//! Time to error of the map of a flow in two dimensions: the FTLE of each pixel against that of two independent maps of many more seeds, as the
//! record of a map states it.

use super::ftle::Opened;
use super::picture::{LONGEST, PictureCurve, PictureErrors, RESOLVED, SLIDES, Truth, Windows, decibels, measure, sliding, truth};
use super::still::colours_of;
use super::{Charting, with_method};
use crate::flow::StepsSetting;
use crate::render::{Film, Method};
use crate::run::RunError;
use crate::surrogate::Kind;

/// Shares of the time that is left for the truth of the first window, and of the last one that slides.
const TRUTH_SHARES: [f64; 2] = [0.05, 0.02];
/// The same for the frames.
const FRAMES_SHARE: f64 = 0.1;

/// The curve of the flow's map, and the PSNR of its truth in decibels; `None` if there is no time for it, or it is refused.
pub(super) fn curve(charting: &mut Charting<'_>, opened: &Opened, windows: &Windows<'_>) -> Result<Option<(PictureCurve, f64)>, RunError> {
    let mut curve = PictureCurve::new(Method::Map, Kind::Table);
    if !charting.has_time_for("pictures by map") {
        return Ok(None);
    }
    let left = charting.left();
    let mut scene = with_method(charting.settings, Method::Map, Kind::Table);
    let transfer = colours_of(&scene, Method::Map, charting.device, windows.slides)?;
    let range = transfer.low.zip(transfer.high).map(|(low, high)| [low, high]);
    scene.transfer = Some(transfer);
    // More steps than the picture has, so that what these lose counts as an error.
    let mut finer = scene.clone();
    let given = if let StepsSetting::Fixed(steps) = scene.flow.steps { steps } else { 0 };
    match opened.chosen_steps(&charting.pool) {
        Ok(Some(steps)) => finer.flow.steps = StepsSetting::Fixed(2 * given.max(steps)),
        Ok(None) => {}
        Err(error) => return charting.refused("pictures by map", error).map(|()| None),
    }
    let truth = |slide: usize| {
        let (truth, _) = truth(windows, &finer, slide, TRUTH_SHARES[slide.min(1)] * left)?;
        Ok::<_, RunError>(Truth { range, ..truth })
    };
    let longest = LONGEST[usize::from(charting.device.is_gpu())].min(FRAMES_SHARE * left);
    let mut measured = || {
        let still = truth(0)?;
        if !still.mean.ftle_mean.iter().any(|ftle| ftle.is_finite()) {
            return Ok(None);
        }
        let truth_psnr = range.map_or(f64::INFINITY, |range| errors(&still.mean, &still.halves, range).psnr - RESOLVED);
        measure(windows, &scene, &still, 0.8 * longest, &mut curve.frames).map(|_| Some(truth_psnr))
    };
    let truth_psnr = match measured() {
        Ok(Some(truth_psnr)) => truth_psnr,
        Ok(None) => {
            charting.skip("pictures by map", "no pixel shows the flow");
            return Ok(None);
        }
        Err(error) => return charting.refused("pictures by map", error).map(|()| None),
    };
    if windows.slides.count() >= SLIDES {
        match truth(SLIDES - 1).and_then(|truth| sliding(windows, &scene, Some(&truth), 0.2 * longest)) {
            Ok(found) => curve.sliding = found,
            Err(error) => charting.refused("a sliding window by map", error)?,
        }
    }
    Ok(Some((curve, truth_psnr)))
}

/// Errors of a map's FTLE, as shares of the range of its colours, against two independent maps, over pixels with a value in all three.
pub(super) fn errors(film: &Film, [a, b]: &[Film; 2], [low, high]: [f64; 2]) -> PictureErrors {
    let share = |ftle: f32| (f64::from(ftle) - low) / (high - low);
    let (mut squares, mut relative, mut count) = ([0.0; 2], 0.0, 0.0);
    for ((value, a), b) in film.ftle_mean.iter().zip(&a.ftle_mean).zip(&b.ftle_mean) {
        let [value, a, b] = [*value, *a, *b].map(share);
        let square = (value - a) * (value - b);
        if square.is_finite() {
            squares = [squares[0] + square, squares[1] + 0.25 * (a - b).powi(2)];
            relative += square / ((0.5 * (a + b)).powi(2) + 0.01);
            count += 1.0;
        }
    }
    // Without a pixel in common there is none.
    let psnr = if count > 0.0 { decibels(squares, count) } else { f64::NAN };
    PictureErrors { rms: (squares[0] / count).max(0.0).sqrt(), psnr, psnr_all: psnr, relmse: (relative / count).max(0.0) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn errors_are_shares_of_the_range_without_the_noise_of_the_truth() {
        let film = |ftle: [f32; 4]| Film { width: 4, height: 1, ftle_mean: ftle.to_vec(), ..Film::default() };
        // Off by a tenth of the range 1 to 3 in three pixels; the halves lie on both sides of the truth, and one pixel of one has no value.
        let found = film([1.7, 1.7, 2.2, 1.0]);
        let halves = [film([1.52, 1.48, 2.0, f32::NAN]), film([1.48, 1.52, 2.0, 1.0])];
        let errors = errors(&found, &halves, [1.0, 3.0]);
        // (0.1 - 0.01) (0.1 + 0.01) in two pixels and 0.1^2 in the third.
        let wanted = ((2.0 * (0.01 - 1e-4) + 0.01) / 3.0_f64).sqrt();
        assert!((errors.rms - wanted).abs() < 1e-6 && (errors.psnr + 20.0 * wanted.log10()).abs() < 1e-4, "{errors:?}");
        let relative = (2.0 * (0.01 - 1e-4) / (0.0625 + 0.01) + 0.01 / (0.25 + 0.01)) / 3.0;
        assert!((errors.relmse - relative).abs() < 1e-6, "{errors:?}");
    }
}
