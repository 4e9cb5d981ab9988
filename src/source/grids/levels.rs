//! Levels as heights, multiplied by `vertical_scale`. Pressures become heights by the hydrostatic equation of an isothermal
//! atmosphere: z = -H ln(p / p0).

use super::axes::{AxisPlan, Quantity};
use ridgewatch_field::{Axis, AxisFault};

/// Scale height of the atmosphere, metres.
pub const SCALE_HEIGHT: f64 = 7000.0;
/// Pressure at height 0, Pa.
pub const REFERENCE_PRESSURE: f64 = 100_000.0;

/// Height of a pressure (Pa), metres.
pub fn height_of(pressure: f64) -> f64 {
    SCALE_HEIGHT * (REFERENCE_PRESSURE / pressure).ln()
}

/// Pressure at a height (metres), Pa.
pub fn pressure_at(height: f64) -> f64 {
    REFERENCE_PRESSURE * (-height / SCALE_HEIGHT).exp()
}

/// Vertical velocity of a particle whose pressure changes at this rate (Pa/s): w = -H omega / p.
pub fn upward(omega: f64, pressure: f64) -> f64 {
    -SCALE_HEIGHT * omega / pressure
}

/// Turns a level axis into (scaled) heights in metres. Returns also the factor of each level from velocities along the file's axis to
/// velocities along the new one; for pressures w = -H omega / p.
///
/// # Errors
/// The heights make no axis.
pub fn to_heights(mut plan: AxisPlan, scale: f64) -> Result<(AxisPlan, Vec<f64>), AxisFault> {
    let (name, mut units, period) = (plan.axis.name().to_owned(), plan.axis.units().to_owned(), plan.axis.period());
    let mut coordinates = plan.axis.coordinates().to_vec();
    let mut factors = vec![scale; coordinates.len()];
    if plan.quantity == Quantity::Pressure {
        plan.order.reverse();
        coordinates.reverse();
        factors = coordinates.iter().map(|&p| upward(scale, p)).collect();
        coordinates.iter_mut().for_each(|p| *p = height_of(*p));
        plan.quantity = Quantity::Length;
        plan.notes.push(format!(
            "`{name}`: pressure p read as height z = -H ln(p / p0), omega as w = -H omega / p, with H = 7 km and p0 = 1000 hPa{}",
            counted(scale)
        ));
    } else if scale != 1.0 {
        plan.notes.push(format!("`{name}`: heights{}", counted(scale)));
    }
    if plan.quantity == Quantity::Length {
        units = if scale == 1.0 { "m".into() } else { format!("m x {scale}") };
    }
    let axis = Axis::new(name, units, coordinates.iter().map(|z| z * scale).collect())?;
    plan.axis = match period {
        Some(period) => axis.with_period(period * scale),
        None => axis,
    };
    Ok((plan, factors))
}

fn counted(scale: f64) -> String {
    if scale == 1.0 { String::new() } else { format!(", a vertical metre counted {scale} times (`vertical_scale`)") }
}
