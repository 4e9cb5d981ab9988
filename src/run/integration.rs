//! What a flow map loses by its steps, its precision and its differences.

use super::cycle::Cycle;
use super::setup::auto_steps;
use super::slides::Slide;
use super::state::Run;
use super::stop::{RunEnd, check_stop};
use crate::backend::Backend;
use crate::flow::{FlowMap, IntegrationDifferences, StepChoice, Steps, Tracer, VelocitySource, integration_differences};

impl<B: Backend> Cycle<'_, B> {
    /// Measures the differences of the flow map, for the report. `chosen`: how its steps were, if they were not given.
    ///
    /// # Errors
    /// As for [`integration_differences`], or a stop is requested.
    pub(super) fn measure_integration(
        &mut self,
        slide: &Slide,
        chosen: Option<StepChoice>,
    ) -> Result<Option<IntegrationDifferences>, RunEnd> {
        check_stop(self.run.stop)?;
        let rule = match self.run.plan.map.steps {
            Steps::Fixed(_) => auto_steps(matches!(slide.velocity, VelocitySource::Window(_)), self.map.interpolation),
            rule => rule,
        };
        let measure = || integration_differences(&slide.velocity, &self.map, slide.time, chosen, rule);
        let found = self.run.threads.render().install(measure)?;
        let finite = |of: fn(IntegrationDifferences) -> Option<f64>| found.and_then(of).filter(|difference| difference.is_finite());
        let report = &mut self.run.report;
        report.integration_difference = finite(|found| Some(found.steps));
        report.precision_difference = finite(|found| found.precision);
        report.tangent_difference = finite(|found| found.tangent);
        Ok(found)
    }
}

impl Run<'_> {
    /// Warnings about a flow map whose steps were `chosen` or given.
    pub(super) fn flow_warnings(
        &self,
        flow: &dyn Tracer,
        chosen: Option<StepChoice>,
        differences: Option<IntegrationDifferences>,
    ) -> Vec<String> {
        let mut warnings: Vec<String> = self.colourless(flow).into_iter().collect();
        if let Some(found) = &differences {
            warnings.extend(integration_warnings(found, &self.plan.map, flow.steps(), chosen.is_some()));
        }
        if let Some(chosen) = chosen.filter(|chosen| chosen.not_finite > 0) {
            warnings.push(format!(
                "{} of {} paths of the step choice have no finite log-stretch (FTLE times tau): the integration overflowed there",
                chosen.not_finite,
                StepChoice::POINTS
            ));
        }
        if let Some(chosen) = chosen.filter(|chosen| !chosen.within_tolerance) {
            warnings.push(format!(
                "{} steps a path, the maximum, still differ from twice as many by {:.3} in the log-stretch (FTLE times tau), root mean \
                 square of the better 98 %",
                chosen.steps, chosen.difference
            ));
        }
        warnings
    }
}

/// Warnings about differences with which a choice of steps would not end. Steps that were chosen have a warning of their own.
pub(super) fn integration_warnings(
    found: &IntegrationDifferences,
    map: &FlowMap,
    steps: usize,
    steps_are_chosen: bool,
) -> impl Iterator<Item = String> {
    let allowed = found.allowed;
    let of_steps = (!steps_are_chosen).then(|| (found.steps, format!("flow.steps = {steps}"), "that of twice as many steps"));
    let of_precision = found.precision.map(|by| (by, "flow.precision = \"f32\"".to_owned(), "that in f64 with the same steps"));
    let gap = format!("flow.integrator = \"differences\", flow.difference_step = {}", map.difference_step);
    let of_differences = found.tangent.map(|by| (by, gap, "that by the tangent"));
    [of_steps, of_precision, of_differences].into_iter().flatten().filter(move |(by, ..)| *by > allowed).map(move |(by, key, from)| {
        let differs = if by.is_finite() { format!("differs by {by:.1e} rms") } else { "has no finite difference".to_owned() };
        format!("{key}: the log-stretch {differs} from {from}; flow.steps = \"auto\" ends at {allowed:.1e}")
    })
}
