//! How far the log-stretch of a flow map is from that of more steps, of double precision and of the tangent, on a few points.

use super::steps::{allowed, quasi_random_points, trimmed_difference};
use super::{Extras, FlowError, FlowMap, Integrator, Precision, StepChoice, Steps, Traced, VelocitySource, assemble::cpu_tracer};
use ridgewatch_base::progress::Work;
use std::cell::Cell;

/// Root mean square differences of the log-stretch, no unit; on grids without the 2 % of the points that differ most. Infinite if more than
/// 2 % of the points have no finite log-stretch.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct IntegrationDifferences {
    /// From twice as many steps, both by the tangent in double precision.
    pub steps: f64,
    /// Of single from double precision, with the same steps; `None` in double precision.
    pub precision: Option<f64>,
    /// Of [`Integrator::Differences`] from the tangent, with the same steps and precision; `None` for the tangent.
    pub tangent: Option<f64>,
    /// The largest difference from twice as many steps with which a choice of steps ends.
    pub allowed: f64,
}

impl IntegrationDifferences {
    /// Points on which they are measured: the first of those of a [`StepChoice`].
    pub const POINTS: usize = 512;
}

/// Measures the differences of a flow map whose number of steps is fixed. `chosen`: how it was chosen, unless it was given; `rule`: how it
/// would be. `None` if the step size is adaptive.
///
/// # Errors
/// As [`cpu_tracer`].
pub fn integration_differences(
    source: &VelocitySource,
    map: &FlowMap,
    t0: f64,
    chosen: Option<StepChoice>,
    rule: Steps,
) -> Result<Option<IntegrationDifferences>, FlowError> {
    let Steps::Fixed(steps) = map.steps else { return Ok(None) };
    if map.integrator == Integrator::DormandPrince {
        return Ok(None);
    }
    let is_exact = (map.integrator, map.precision) == (Integrator::Tangent, Precision::F64);
    let is_single_by_differences = (map.integrator, map.precision) == (Integrator::Differences, Precision::F32);
    // In units of tracing with `steps`.
    let all = 1 + usize::from(!is_exact) + 2 * usize::from(chosen.is_none()) + 2 * usize::from(is_single_by_differences);
    let (work, done) = (Work::begin("measuring what steps and precision lose"), Cell::new(0));
    let trace = |integrator, precision, times: usize| {
        let map = FlowMap { integrator, precision, steps: Steps::Fixed(times * steps), ..map.clone() };
        let tracer = cpu_tracer(source.clone(), &map, t0)?;
        let mut traced = Traced::default();
        tracer.trace(&quasi_random_points(tracer.domain(), IntegrationDifferences::POINTS), Extras::default(), &mut traced);
        done.set(done.get() + times);
        work.reached(done.get(), all);
        Ok::<_, FlowError>(traced)
    };
    let gridded = matches!(source, VelocitySource::Window(_));
    let difference = |a: &Traced, b: &Traced| trimmed_difference(a, b, gridded).0;
    let own = trace(map.integrator, map.precision, 1)?;
    let exact = if is_exact { own.clone() } else { trace(Integrator::Tangent, Precision::F64, 1)? };
    let (tolerance, share) = match rule {
        Steps::Auto { tolerance } => (tolerance, f64::INFINITY),
        Steps::AutoByShare { tolerance, share } => (tolerance, share),
        Steps::Fixed(_) => (f64::INFINITY, f64::INFINITY),
    };
    Ok(Some(IntegrationDifferences {
        steps: match chosen {
            Some(chosen) => chosen.difference,
            None => difference(&exact, &trace(Integrator::Tangent, Precision::F64, 2)?),
        },
        precision: match (map.precision, map.integrator) {
            (Precision::F64, _) => None,
            (Precision::F32, Integrator::Tangent) => Some(difference(&own, &exact)),
            (Precision::F32, integrator) => Some(difference(&own, &trace(integrator, Precision::F64, 1)?)),
        },
        tangent: match (map.integrator, map.precision) {
            (Integrator::Differences, Precision::F64) => Some(difference(&own, &exact)),
            (Integrator::Differences, precision) => Some(difference(&own, &trace(Integrator::Tangent, precision, 1)?)),
            _ => None,
        },
        allowed: allowed(tolerance, share, &exact),
    }))
}
