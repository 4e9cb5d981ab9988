//! Levels as heights: pressure by the hydrostatic scale height, lengths as they are, both counted `vertical_scale` times.

use super::axes::{AxisPlan, Quantity};
use crate::field::{Axis, AxisFault};

/// Scale height of the atmosphere, metres.
const SCALE_HEIGHT: f64 = 7000.0;
/// Pressure at height 0, Pa.
const REFERENCE_PRESSURE: f64 = 100_000.0;

/// Turns a level axis into (scaled) heights in metres. Returns also the factors, a level each, from velocities along the file's axis to
/// those along the new one: z = -H ln(p / p0) and w = -H omega / p.
pub(super) fn to_heights(plan: AxisPlan, scale: f64) -> Result<(AxisPlan, Vec<f64>), AxisFault> {
    let mut plan = plan;
    let name = plan.axis.name().to_owned();
    let units = |metres: &str| if scale == 1.0 { metres.to_owned() } else { format!("m x {scale}") };
    match plan.quantity {
        Quantity::Pressure => {
            let pressures: Vec<f64> = plan.axis.coordinates().iter().rev().copied().collect();
            let heights = pressures.iter().map(|p| SCALE_HEIGHT * (REFERENCE_PRESSURE / p).ln() * scale).collect();
            let factors = pressures.iter().map(|p| -SCALE_HEIGHT / p * scale).collect();
            plan.notes.push(format!(
                "`{name}`: pressure p read as height z = -H ln(p / p0), omega as w = -H omega / p, with H = 7 km and p0 = 1000 hPa{}",
                counted(scale)
            ));
            plan.order.reverse();
            plan.axis = Axis::new(name, units("m"), heights)?;
            plan.quantity = Quantity::Length;
            Ok((plan, factors))
        }
        _ => {
            let heights = plan.axis.coordinates().iter().map(|z| z * scale).collect();
            if scale != 1.0 {
                plan.notes.push(format!("`{name}`: heights{}", counted(scale)));
            }
            let units = if plan.quantity == Quantity::Length { units("m") } else { plan.axis.units().to_owned() };
            let period = plan.axis.period();
            let axis = Axis::new(name, units, heights)?;
            plan.axis = match period {
                Some(period) => axis.with_period(period * scale),
                None => axis,
            };
            let factors = vec![scale; plan.axis.len()];
            Ok((plan, factors))
        }
    }
}

fn counted(scale: f64) -> String {
    if scale == 1.0 { String::new() } else { format!(", a vertical metre counted {scale} times (`vertical_scale`)") }
}
