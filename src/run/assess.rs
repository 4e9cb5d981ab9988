//! The error of a frame's surrogate on its audit points, and the consequences for trust, size and replay buffer.

use super::frame::gate_decides;
use super::prepare::every;
use super::state::{MAX_RENDER_RESIDUALS, Run};
use super::stop::RunEnd;
use super::transaction::On;
use super::{FrameRecord, TrustedError};
use crate::backend::{
    AuditFindings, Backend, FrameSamples, Interruptible, Rendered, Tally, audit, residuals, stratified_points, trusted_error,
};
use crate::flow::Extras;
use crate::render::Method;
use crate::surrogate::{Predict, Samples, Trace};
use crate::trust::{Audited, Gate, REJECTED, Residual, Strata};
use std::sync::atomic::Ordering;

/// Audit points in the trusted region below which a warning tells what they may miss.
const FEW_POINTS: u64 = 100;

/// A rendered and audited frame whose results have not taken effect.
pub(super) struct Work<S> {
    pub(super) rendered: Rendered<S>,
    pub(super) audit: AuditFindings,
    pub(super) samples_per_pixel: f64,
    pub(super) render_seconds: f64,
    pub(super) audit_seconds: f64,
}

impl<S> Work<S> {
    /// Seconds of device time for the picture and its audit; wall-clock time if the CPU rendered.
    pub(super) fn device_share(&self) -> f64 {
        let either = |device: f64, wall: f64| if device > 0.0 { device } else { wall };
        either(self.rendered.stats.device_seconds, self.render_seconds) + either(self.audit.device_seconds, self.audit_seconds)
    }
}

/// Errors of a frame's surrogate, before they take effect.
pub(super) struct Assessment {
    trusted: Option<TrustedError>,
    trusted_volume: f64,
    tolerance_excess: Option<f64>,
    /// Queries of untrusted cells that the surrogate answered.
    over_budget: u64,
    /// Residuals of the rendered samples.
    rendered: Vec<Residual>,
}

/// Measures the error of `frozen` on the audit points, which did not influence this frame.
pub(super) fn assess<S: FrameSamples>(
    run: &Run<'_>,
    frozen: &dyn Predict,
    tracer: &dyn Trace,
    gate: &Gate,
    work: &Work<S>,
) -> Result<Option<Assessment>, RunEnd> {
    let Some(audited) = &work.audit.errors else { return Ok(None) };
    let (samples, tally) = (work.rendered.samples.on_host(), &work.rendered.tally);
    let trusted = trusted_error(audited, gate);
    let some = every(samples, samples.len().div_ceil(MAX_RENDER_RESIDUALS).max(1));
    let (transfer, tau) = (run.renderer.transfer(), tracer.flow().tau());
    Ok(Some(Assessment {
        trusted,
        trusted_volume: gate.share(),
        tolerance_excess: tolerance_excess(tally, trusted, audited, gate, run.learning.trust.tolerance()),
        over_budget: tally.over_budget,
        rendered: run.threads.render().install(|| residuals(frozen, &some, transfer, tau))?,
    }))
}

impl Run<'_> {
    /// Records the assessment, and lets the audit points and the rendered samples decide the next frame.
    pub(super) fn take_in<B: Backend>(
        &mut self,
        on: &On<B>,
        assessment: Assessment,
        findings: &AuditFindings,
        samples: Samples,
        record: &mut FrameRecord,
    ) {
        let Some(audited) = &findings.errors else { return };
        let Assessment { trusted, trusted_volume, tolerance_excess, over_budget, rendered } = assessment;
        let learning = &mut self.learning;
        learning.peak = learning.peak.max(findings.peak);
        (record.trusted_error, record.trusted_volume, record.tolerance_excess) = (trusted, trusted_volume, tolerance_excess);
        record.surrogate_psnr = audit::psnr(audited, learning.peak);
        if over_budget > 0 {
            record
                .warnings
                .push(format!("the tracing budget was spent: {over_budget} queries of untrusted cells were answered by the surrogate"));
        }
        if gate_decides(self.render.method, on.surrogate.as_ref())
            && let Some(error) = trusted
        {
            let (evidence, frames) = learning.trust.weigh(&error);
            (record.gate_evidence, record.gate_frames) = (Some(evidence), Some(frames));
            if evidence >= REJECTED {
                learning.need.restart();
                record.warnings.push(format!(
                    "the error of the colours (optical residual) where the surrogate is trusted was above `trust.tolerance` over the last \
                     frames (evidence {evidence:.0}, limit {REJECTED}): every cell must earn trust again"
                ));
            }
        }
        let few = trusted.filter(|error| matches!(self.render.method, Method::Gated | Method::Surrogate) && error.points < FEW_POINTS);
        if let Some(TrustedError { points, .. }) = few
            && !std::mem::replace(&mut self.progress.has_warned_of_few_points, true)
        {
            // A share of the points that all miss it with a probability of 5 %.
            let unseen = 100.0 * (1.0 - 0.05f64.powf(1.0 / points as f64));
            record.warnings.push(format!(
                "the stated error rests on {points} audit points: where up to {unseen:.0} % of the trusted region errs more, they may miss it; \
                 trust.audit_min_per_cell and trust.audit_share draw more"
            ));
        }
        learning.need.trusts(trusted_volume);
        learning.trust.decay();
        learning.trust.observe(Some(audited), &rendered);
        if let Some(sizing) = &mut learning.sizing {
            // Over the whole domain, since untrusted regions may need a larger size.
            let everywhere = trusted_error(audited, &Gate::uniform(true));
            learning.resize = everywhere.and_then(|error| sizing.observe(error.optical_rms, learning.trust.tolerance()));
        }
        self.keep_samples(on, &samples);
        self.keep_samples(on, &findings.samples);
    }

    /// Error of `frozen` in the trusted region on new points. `None` if not requested, or if a stop interrupted the measurement, which would then
    /// cover only a part of the domain.
    pub(super) fn verify(&self, frozen: &dyn Predict, tracer: &dyn Trace, gate: &Gate) -> Result<Option<TrustedError>, RunEnd> {
        if self.options.verify_points == 0 {
            return Ok(None);
        }
        let cells = self.learning.trust.shape();
        let per_cell = self.options.verify_points.div_ceil(cells.iter().product());
        let strata = Strata::even(cells, per_cell as u32);
        let unit = stratified_points(&strata, self.plan.scene.seed, 2 * self.progress.frame + 1);
        let interruptible = Interruptible::new(tracer, self.stop);
        let verified = self.threads.render().install(|| {
            let fresh = audit::trace(&interruptible, &unit, Extras::default())?;
            let residuals = residuals(frozen, &fresh.samples, self.renderer.transfer(), tracer.flow().tau())?;
            Ok::<_, RunEnd>(trusted_error(&Audited::of(&residuals, strata), gate))
        })?;
        Ok(verified.filter(|_| !self.stop.load(Ordering::Relaxed)))
    }
}

/// Excess of the optical residual of a frame over `tolerance`; `None` if within it. If the tracing budget was spent, the surrogate also answered in
/// untrusted cells: then the excess is measured on the untrusted points, and always given.
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
    use crate::field::UnitPoint;
    use crate::trust::Residual;

    /// Ten points left of the middle, trusted or not, whose residual is 0.01, ten right of it with 0.05.
    fn points() -> Vec<Residual> {
        let at = |i: usize| Residual {
            point: UnitPoint([(i as f32 + 0.5) / 20.0, 0.5, 0.5]),
            optical: if i < 10 { 0.01 } else { 0.05 },
            log_stretch: 0.0,
        };
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
