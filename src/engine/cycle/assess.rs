//! What a frame's audit points say of the surrogate it was rendered with, and what follows for trust, size and ring.

use super::frame::Rendered;
use super::prepare::every;
use super::{Cycle, RENDER_RESIDUALS};
use crate::engine::answers::Tally;
use crate::engine::audit;
use crate::engine::stop::Interruptible;
use crate::engine::{FrameRecord, TrustedError};
use crate::flow::{Extras, Tracer};
use crate::surrogate::Predict;
use crate::trust::{Audited, Gate, Strata};
use std::sync::atomic::Ordering;

impl Cycle<'_> {
    /// States the error of `front` from the audit points, which decided nothing in this frame, and only then lets them and the rendered
    /// samples decide the next one.
    pub(super) fn assess(&mut self, front: &dyn Predict, tracer: &dyn Tracer, gate: &Gate, work: &Rendered, record: &mut FrameRecord) {
        let Some(audited) = &work.audit.errors else { return };
        let tolerance = self.plan.scene.trust.tolerance;
        record.trusted_volume = gate.share();
        record.trusted_error = audit::trusted_error(audited, gate);
        self.peak = self.peak.max(work.audit.peak);
        record.surrogate_psnr = audit::psnr(audited, self.peak);
        record.tolerance_excess = tolerance_excess(&work.tally, record.trusted_error, audited, gate, tolerance);
        if work.tally.over_budget > 0 {
            record.warnings.push(format!(
                "the tracing budget was spent: {} queries of untrusted cells were answered by the surrogate",
                work.tally.over_budget
            ));
        }
        let some = every(&work.samples, work.samples.len().div_ceil(RENDER_RESIDUALS).max(1));
        let transfer = self.renderer.transfer();
        let rendered = self.threads.render().install(|| audit::residuals(front, &some, transfer, tracer.tau()));
        self.trust.decay();
        self.trust.observe(Some(audited), &rendered);
        if let Some(sizing) = &mut self.sizing {
            // Over the whole domain: where nothing is trusted, the size is what is to be blamed.
            let everywhere = audit::trusted_error(audited, &Gate::uniform(true));
            self.resize = everywhere.and_then(|error| sizing.observe(error.optical_rms, tolerance));
        }
        if self.learns() {
            self.ring.push(&work.samples);
            self.ring.push(&work.audit.samples);
        }
    }

    /// The error of `front` in the trusted region on fresh points, where it was asked for; none when a stop cut it short, since it would
    /// stand on the points that come first.
    pub(super) fn verify(&self, front: &dyn Predict, tracer: &dyn Tracer, gate: &Gate) -> Option<TrustedError> {
        if self.options.verify_points == 0 {
            return None;
        }
        let cells = self.trust.shape();
        let per_cell = self.options.verify_points.div_ceil(cells.iter().product());
        let strata = Strata::even(cells, per_cell as u32);
        let unit = audit::stratified_points(&strata, self.plan.scene.seed, 2 * self.frame + 1);
        let interruptible = Interruptible::new(tracer, self.stop);
        let verified = self.threads.render().install(|| {
            let fresh = audit::trace(&interruptible, &unit, Extras::default());
            let residuals = audit::residuals(front, &fresh.samples, self.renderer.transfer(), tracer.tau());
            audit::trusted_error(&Audited::of(&residuals, strata), gate)
        });
        verified.filter(|_| !self.stop.load(Ordering::Relaxed))
    }
}

/// By how much the optical residual of a frame exceeds `tolerance`, or none when it does not. A frame whose tracing budget was spent is
/// flagged whatever the points say: the surrogate answered where it is not trusted, so that those points speak for it.
fn tolerance_excess(tally: &Tally, trusted: Option<TrustedError>, audited: &Audited, gate: &Gate, tolerance: f64) -> Option<f64> {
    if tally.over_budget == 0 {
        return trusted.map(|e| e.optical_rms - tolerance).filter(|over| *over > 0.0);
    }
    let untrusted = TrustedError::of(audited, |cell| !gate.trusts(audited.strata().centre(cell)));
    Some(untrusted.map_or(0.0, |e| (e.optical_rms - tolerance).max(0.0)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::trust::Residual;

    /// Ten points left of the middle, trusted or not, whose residual is 0.01, ten right of it with 0.05.
    fn points() -> Vec<Residual> {
        let at =
            |i: usize| Residual { point: [(i as f32 + 0.5) / 20.0, 0.5, 0.5], optical: if i < 10 { 0.01 } else { 0.05 }, log_stretch: 0.0 };
        (0..20).map(at).collect()
    }

    fn flagged(over_budget: u64, gate: &Gate, tolerance: f64) -> Option<f64> {
        let points = Audited::of(&points(), Strata::even([1; 3], 20));
        let trusted = audit::trusted_error(&points, gate);
        tolerance_excess(&Tally { over_budget, ..Tally::default() }, trusted, &points, gate, tolerance)
    }

    #[test]
    fn a_frame_within_tolerance_is_not_flagged_unless_its_budget_was_spent() {
        // Root mean square over all points: sqrt((0.01^2 + 0.05^2) / 2) = 0.0360555.
        let (all, none) = (Gate::uniform(true), Gate::uniform(false));
        assert_eq!(flagged(0, &all, 0.04), None);
        assert!((flagged(0, &all, 0.03).unwrap() - 0.006_055_5).abs() < 1e-6);
        assert_eq!(flagged(0, &none, 0.03), None, "all was traced");
        assert!((flagged(1, &none, 0.03).unwrap() - 0.006_055_5).abs() < 1e-6);
        assert_eq!(flagged(1, &none, 0.04), Some(0.0), "flagged all the same");
    }
}
