//! What a smooth picture would lose with every second snapshot. It is told and left to the user: one window promises nothing for later ones, and to
//! look at these, all snapshots would have to be read.

use super::cycle::Cycle;
use super::decision::Decision;
use super::slides::Slide;
use super::stop::RunEnd;
use crate::backend::Backend;
use crate::flow::{Precision, StepChoice, VelocitySource};
use crate::progress::Work;
use std::sync::Arc;

pub(super) const SETTING: &str = "time.every";
/// Snapshots of the smallest window that is asked about: of fewer, hardly any are left.
const FEWEST: usize = 5;

impl<B: Backend> Cycle<'_, B> {
    /// Traces the points on which the steps of the first window were compared without every second of its snapshots, and enters the difference. The
    /// snapshots at both ends are kept, and the steps are those of the paths that the points are compared with, so that nothing else differs.
    ///
    /// # Errors
    /// The flow map cannot be built, or a stop is requested.
    pub(super) fn tell_snapshots(&mut self, slide: &Slide, chosen: StepChoice) -> Result<(), RunEnd> {
        let shown = self.run.shown();
        let (Some(comparison), VelocitySource::Window(window)) = (&self.compared, &slide.velocity) else { return Ok(()) };
        // Who asks for double precision, or for fewer snapshots, has decided; a command that changes tau asks nothing again.
        let is_open = shown.plan.map.precision == Precision::F32 && shown.plan.scene.time.every == 1;
        let is_known = Decision::is_entered(&self.run.report.decisions, SETTING);
        if !is_open || is_known || slide.index > 0 || window.snapshots().len() < FEWEST {
            return Ok(());
        }
        let _work = Work::begin("comparing every second snapshot with all");
        let half = window.thinned(2, window.span().max(shown.map.tau));
        let half = Slide { velocity: VelocitySource::Window(Arc::new(half)), ..slide.clone() };
        let found = self.run.threads.render().install(|| comparison.of(shown, &half, 2 * chosen.steps))?;
        let (residual, most) = (found.residual, shown.most());
        let verdict =
            if residual <= most { "time.every = 2 reads half, and is within that where later windows are alike" } else { "all are needed" };
        let why = format!(
            "without every second snapshot colours would differ by {residual:.4} of their range, rms, in the first window; allowed: {most:.4}; \
             {verdict}"
        );
        Decision::new(SETTING, 1, why).enter(&mut self.run.report.decisions);
        Ok(())
    }
}
