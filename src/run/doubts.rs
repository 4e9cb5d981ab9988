//! Warnings about an FTLE field: particles that stop early, values that hardly vary, and colours that show none of them.

use super::TransferRecord;
use crate::backend::stratified_points;
use crate::field::DomainPoint;
use crate::flow::{Extras, Traced, Tracer};
use crate::trust::Strata;

/// Mean lifetime share of the particles below which a warning is given.
const SHORT_LIVED: f64 = 0.75;
/// Range of the log-stretch below which the FTLE counts as uniform: neighbouring particles separate by factors that differ by at most 5 % over
/// the domain.
const UNIFORM: f64 = 0.05;
/// Range of the FTLE, as a share of its magnitude, below which it counts as uniform.
const UNIFORM_SHARE: f64 = 0.01;
/// Cells of the domain along x, y and z that get a point each.
const CELLS: [usize; 3] = [16, 16, 8];
/// Share of these points that is next to none.
const FEW: f64 = 0.001;
/// Random stream of these points.
const STREAM: u64 = u64::MAX - 3;

/// Warning about particles that stop early; `None` if they live for most of tau. `mean_share`: the mean of their lifetimes over tau.
pub fn short_lived(mean_share: f64) -> Option<String> {
    (mean_share < SHORT_LIVED).then(|| {
        format!(
            "particles live {:.2} % of tau on average: they meet land, leave the domain, or are too fast (unknown fill value or wrong unit?), and their FTLE covers only the path until then",
            100.0 * mean_share
        )
    })
}

/// Warning for an FTLE that hardly varies, which colours would show as rounding; `None` otherwise. `range`: its ends, in 1 / time unit. `error`: that of the
/// log-stretch by the integration. `colours`: the settings of the colours.
pub fn uniform_ftle([low, high]: [f64; 2], tau: f64, error: Option<f64>, colours: &str) -> Option<String> {
    let (range, error) = ((high - low) * tau, error.unwrap_or(0.0));
    let is_uniform = range <= error.max(UNIFORM) || high - low <= UNIFORM_SHARE * low.abs().max(high.abs());
    is_uniform.then(|| {
        format!(
            "FTLE is uniform: colours have no range to scale to. The log-stretch (FTLE times tau) varies by {range:.1e} \
             over the domain, and its integration error is {error:.1e}; {colours} set the colours, a longer tau may show more"
        )
    })
}

/// Warning for colours of which nearly the whole domain has one end, since its FTLE lies beyond; `None` otherwise, and where all is missing.
pub(super) fn beyond_colours(tracer: &dyn Tracer, colours: &TransferRecord, time_unit: &str) -> Option<String> {
    let domain = tracer.domain();
    let [x, y, z] = CELLS;
    let cells = if domain.dimensions == 3 { CELLS } else { [x * z, y, 1] };
    let points = stratified_points(&Strata::even(cells, 1), 0, STREAM).into_iter().map(|unit| domain.from_unit(unit));
    let points: Vec<DomainPoint> = points.filter(|&point| !tracer.is_missing(point)).collect();
    let mut traced = Traced::default();
    tracer.trace(&points, Extras::default(), &mut traced);
    let mut ftle: Vec<f64> = traced.log_stretch.iter().map(|s| f64::from(*s) / tracer.tau()).filter(|f| f.is_finite()).collect();
    ftle.sort_unstable_by(f64::total_cmp);
    let (first, last) = (ftle.first()?, ftle.last()?);
    let TransferRecord { low, high, .. } = *colours;
    let few = |count: usize| (count as f64) < FEW * ftle.len() as f64;
    let from_low = ftle.iter().filter(|f| **f >= low).count();
    let below_high = ftle.iter().filter(|f| **f < high).count();
    let what = match (few(from_low), few(below_high)) {
        (true, _) => format!("above transfer.low = {low:.3e}"),
        (_, true) => format!("below transfer.high = {high:.3e}"),
        _ => return None,
    };
    let per = if time_unit.is_empty() { "per time".to_owned() } else { format!("/{time_unit}") };
    let points = ftle.len();
    Some(format!(
        "next to no FTLE lies {what} {per}: at {points} points of the domain it is {first:.3e} to {last:.3e} {per}, so that all has one colour"
    ))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::field::{Domain, analytic::Analytic};
    use crate::flow::{FlowMap, VelocitySource, cpu_tracer};

    #[test]
    fn colours_beyond_all_values_are_told() {
        let domain = Domain { dimensions: 2, ..Domain::cuboid([-1.0; 3], [1.0; 3]) };
        let saddle = VelocitySource::Analytic(Analytic::Saddle { rate: 0.7 }, domain);
        let tracer = cpu_tracer(saddle, &FlowMap::tangent(1.0, 4), 0.0).unwrap();
        let warned = |low, high| beyond_colours(&tracer, &TransferRecord { low, high, extinction: 1.0 }, "s");
        assert_eq!(warned(0.5, 0.9), None);
        // A day's rate, taken for that of a second.
        let said = warned(86.4, 864.0).unwrap();
        assert!(said.starts_with("next to no FTLE lies above transfer.low = 8.640e1 /s: at 2048 points of the domain it is 7.0"), "{said}");
        assert!(warned(-9.0, -5.0).unwrap().contains("lies below transfer.high = -5.000e0 /s"));
    }

    #[test]
    fn short_lives_and_uniform_values_are_told() {
        assert!(short_lived(0.74).unwrap().starts_with("particles live 74.00 % of tau") && short_lived(0.76).is_none());
        assert!(uniform_ftle([1.0, 1.2], 0.1, None, "a and b").unwrap().contains("; a and b set the colours"));
        assert!(uniform_ftle([1.0, 1.2], 10.0, Some(3.0), "").is_some() && uniform_ftle([1.0, 1.2], 10.0, Some(0.1), "").is_none());
    }
}
