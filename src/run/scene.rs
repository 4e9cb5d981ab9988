//! The picture's scene of a run.

use super::RunError;
use super::setup::{Plan, assemble};
use super::slides::Slide;
use super::stop::{RunEnd, check_stop};
use crate::backend::{Interruptible, audit, stratified_points};
use crate::flow::Extras;
use crate::render::{Method, Scene, TransferSettings};
use crate::surrogate::Trace;
use crate::trust::Strata;
use std::sync::atomic::AtomicBool;

/// Scene of the picture, with the colours of [`settled_colours`].
pub(super) fn settled_scene(plan: &Plan, tracer: &dyn Trace, slide: &Slide, stop: &AtomicBool) -> Result<Scene, RunEnd> {
    Ok(Scene { transfer: colours(plan, plan.scene.render.method, tracer, slide, stop)?, ..assemble(&plan.scene, &plan.domain) })
}

/// Transfer function of a run. Values that the scene leaves open are scaled to the FTLE of the first slide and kept for the whole run, so that
/// colours are comparable.
///
/// # Errors
/// The device fails, or every probed point is missing.
pub fn settled_colours(plan: &Plan, tracer: &dyn Trace, slide: &Slide) -> Result<TransferSettings, RunError> {
    match colours(plan, plan.scene.render.method, tracer, slide, &AtomicBool::new(false)) {
        Ok(transfer) => Ok(transfer),
        Err(RunEnd::Failed(error)) => Err(error),
        Err(RunEnd::Device(error)) => Err(RunError::Device(Box::new(error))),
        Err(RunEnd::TimeIsUp | RunEnd::Stopped) => Err(RunError::EndedEarly),
    }
}

/// Colours of a slide that is drawn by `method`, as [`settled_colours`].
pub(super) fn colours(
    plan: &Plan,
    method: Method,
    tracer: &dyn Trace,
    slide: &Slide,
    stop: &AtomicBool,
) -> Result<TransferSettings, RunEnd> {
    let file = &plan.scene;
    let transfer = file.transfer.clone().unwrap_or_default();
    if transfer.low.is_none() || transfer.high.is_none() {
        const PROBES: usize = 64;
        let z = if plan.domain.dimensions == 3 { 16 } else { 1 };
        let unit = stratified_points(&Strata::even([PROBES, PROBES, z], 1), file.seed, u64::MAX);
        let labels = audit::trace(&Interruptible::new(tracer, stop), &unit, Extras::default())?.samples.log_stretch;
        check_stop(stop)?;
        let tau = tracer.flow().tau() as f32;
        let ftle: Vec<f32> = labels.iter().map(|s| s / tau).filter(|f| f.is_finite()).collect();
        if ftle.is_empty() {
            return Err(RunEnd::Failed(RunError::AllMissing {
                points: unit.len(),
                when: slide.date.clone().unwrap_or_else(|| format!("time {}", slide.time)),
            }));
        }
        return Ok(if method == Method::Map { transfer.scaled_to_map(&ftle) } else { transfer.scaled_to(&ftle) });
    }
    Ok(transfer)
}
