//! Runge-Kutta steps of a smooth picture: as few as its colours do not tell from more.

use super::setup::Plan;
use super::slides::Slide;
use crate::backend::stratified_points;
use crate::flow::{Extras, FlowError, FlowMap, Precision, StepChoice, Steps, StepsSetting, Traced, cpu_tracer};
use crate::render::Transfer;
use crate::trust::Strata;

/// Largest optical residual of the steps, as a part of `trust.tolerance`, in flows of three dimensions, whose errors average along a ray: pictures of
/// turbulence differ by 57 dB then (`docs/accuracy.md`).
const SHARE: f64 = 2.0 / 3.0;
/// The same in two dimensions, where a ray sees one value: a residual of 0.007 left a picture 40 dB.
const FLAT_SHARE: f64 = 1.0 / 15.0;
/// Smallest number of points on which something is to be seen.
const MIN_SHOWN: usize = 64;
/// Random stream of the points on which steps are compared.
const STREAM: u64 = u64::MAX - 1;

/// A number of steps, and how far it is from twice as many as the log-stretch asks for. Root mean squares over points of the domain.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct PictureSteps {
    pub(super) steps: usize,
    /// Difference of the log-stretch.
    pub(super) difference: f64,
    /// Optical residual: difference of the ramp of the transfer function.
    pub(super) residual: f64,
}

/// Returns the first number of steps, each at most 1.25 times the one before or one snapshot interval more, whose optical residual is at most [`SHARE`]
/// or [`FLAT_SHARE`] of the tolerance. `None` if there is none below those `chosen` for the log-stretch, if the method or the scene asks for these, or if too few points
/// show anything to judge by.
///
/// # Errors
/// As for [`cpu_tracer`].
pub(super) fn picture_steps(
    plan: &Plan,
    slide: &Slide,
    transfer: &Transfer,
    chosen: Option<StepChoice>,
) -> Result<Option<PictureSteps>, FlowError> {
    let scene = &plan.scene;
    let is_open = scene.flow.steps == StepsSetting::Auto && scene.flow.tolerance.is_none() && scene.render.method.is_smooth();
    let Some(chosen) = chosen.filter(|choice| is_open && choice.within_tolerance) else { return Ok(None) };
    let (share, cells) = if plan.domain.dimensions == 3 { (SHARE, [16, 16, 8]) } else { (FLAT_SHARE, [64, 32, 1]) };
    // Not the seed of the picture, which would change the flow map.
    let unit = stratified_points(&Strata::even(cells, 1), 0, STREAM);
    let mut points: Vec<[f32; 3]> = unit.into_iter().map(|unit| plan.domain.from_unit(unit)).collect();
    // In double precision, as the steps of the log-stretch are chosen.
    let tracer = |steps: usize| {
        let map = FlowMap { steps: Steps::Fixed(steps), precision: Precision::F64, ..plan.map.clone() };
        cpu_tracer(slide.velocity.clone(), &map, slide.time)
    };
    let reference = tracer(2 * chosen.steps)?;
    points.retain(|&point| !reference.is_missing(point));
    let (mut truth, mut traced) = (Traced::default(), Traced::default());
    reference.trace(&points, Extras::default(), &mut truth);
    let ramp = |s: f32| f64::from(transfer.ramp(s / plan.map.tau as f32));
    if truth.log_stretch.iter().filter(|&&s| ramp(s) > 0.0).count() < MIN_SHOWN {
        return Ok(None);
    }
    let mut multiple = 1;
    while multiple * chosen.multiple_of < chosen.steps {
        let steps = multiple * chosen.multiple_of;
        tracer(steps)?.trace(&points, Extras::default(), &mut traced);
        let pairs = || traced.log_stretch.iter().copied().zip(truth.log_stretch.iter().copied());
        let residual = upper_rms(pairs().map(|(a, b)| match (a.is_finite(), b.is_finite()) {
            (true, true) => ramp(a) - ramp(b),
            (false, false) => 0.0,
            // The colours may differ as much as they can.
            _ => 1.0,
        }));
        if residual <= share * scene.trust.tolerance {
            let difference = upper_rms(pairs().map(|(a, b)| f64::from(a - b)).filter(|difference| difference.is_finite()));
            return Ok(Some(PictureSteps { steps, difference, residual }));
        }
        multiple = (multiple + 1).max(multiple * 5 / 4);
    }
    Ok(None)
}

/// Root mean square, from the mean square and its standard error added up: few points hold most of a difference.
fn upper_rms(differences: impl Iterator<Item = f64>) -> f64 {
    let squares: Vec<f64> = differences.map(|difference| difference * difference).collect();
    let n = squares.len().max(1) as f64;
    let mean = squares.iter().sum::<f64>() / n;
    let variance = squares.iter().map(|square| (square - mean).powi(2)).sum::<f64>() / n;
    (mean + (variance / n).sqrt()).sqrt()
}
