//! Components on other coordinates than each other (Arakawa's grids B and C with coordinates of one dimension, vertical velocities between levels),
//! interpolated linearly along each axis to nodes that they share.

use super::axes::{AxisPlan, Quantity};
use super::component::{ComponentPlan, Orders, read_component};
use crate::archive_settings::Staggering;
use crate::cf::coordinate::Kind;
use crate::error::SourceError;
use crate::formats::DataFile;
use ridgewatch_field::{Axis, AxisFault};
use std::sync::Arc;

/// Nodes closer than this share of the mean spacing are one: coordinates are often in single precision.
const SAME: f64 = 1e-4;

/// Linear interpolation along one axis: two entries and the weight of the second.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LinearWeight {
    first: usize,
    second: usize,
    weight: f32,
}

impl LinearWeight {
    /// At a position counted in entries, clamped to the ends.
    pub fn at(place: f64, count: usize) -> Self {
        let place = place.clamp(0.0, (count - 1) as f64);
        let first = (place.floor() as usize).min(count.saturating_sub(2));
        Self { first, second: (first + 1).min(count - 1), weight: (place - first as f64) as f32 }
    }

    /// At a place among ascending coordinates, clamped to their ends unless they are periodic.
    fn among(coordinates: &[f64], period: Option<f64>, place: f64) -> Self {
        let (count, first) = (coordinates.len(), coordinates[0]);
        let place = period.map_or(place, |period| first + (place - first).rem_euclid(period));
        let above = coordinates.partition_point(|c| *c <= place);
        match (above, period) {
            (0, _) => Self::at(0.0, count),
            (above, Some(period)) if above == count => {
                let last = coordinates[count - 1];
                Self { first: count - 1, second: 0, weight: ((place - last) / (first + period - last)) as f32 }
            }
            (above, _) if above == count => Self::at((count - 1) as f64, count),
            (above, _) => {
                let [a, b] = [coordinates[above - 1], coordinates[above]];
                // A node that is a coordinate but for rounding must not read its neighbour, which may be missing.
                let weight = match (place - a) / (b - a) {
                    weight if weight < SAME => 0.0,
                    weight if weight > 1.0 - SAME => 1.0,
                    weight => weight as f32,
                };
                Self { first: above - 1, second: above, weight }
            }
        }
    }

    /// The interpolated value.
    pub fn of(self, value: impl Fn(usize) -> f32) -> f32 {
        // A missing neighbour of weight 0 must not make the result missing.
        match self.weight {
            0.0 => value(self.first),
            1.0 => value(self.second),
            w => value(self.first) * (1.0 - w) + value(self.second) * w,
        }
    }

    /// The same, but a missing value beside a known one counts as 0.
    fn of_known(self, value: impl Fn(usize) -> f32) -> f32 {
        let [a, b] = [value(self.first), value(self.second)];
        let known = |v: f32| if v.is_nan() { 0.0 } else { v };
        if a.is_nan() && b.is_nan() { f32::NAN } else { self.of(|k| known(if k == self.first { a } else { b })) }
    }
}

/// A component's own coordinates along one axis, and the places of the grid's nodes among them.
#[derive(Debug, Clone, PartialEq)]
pub struct OwnAxis {
    /// Index in the file of each of the coordinates.
    order: Vec<usize>,
    /// Of each node of the grid.
    weights: Vec<LinearWeight>,
    /// True if a missing value beside a known one is 0.
    is_closed: bool,
}

impl OwnAxis {
    /// Nodes of the grid.
    pub fn nodes(&self) -> usize {
        self.weights.len()
    }

    /// Coordinates of the component.
    pub fn points(&self) -> usize {
        self.order.len()
    }
}

/// The axis that components with own coordinates `plans` share, and the places of its nodes among those of each. `None` if all have the same.
///
/// With [`Staggering::Faces`] it has the coordinates of all, so that linear interpolation on it is that of each component from its own points; with
/// [`Staggering::Centres`] those of the plan `centred`. Horizontally it ends where the first of them ends. Beyond its highest and lowest level a component is
/// that of the level. A missing third component (the vertical one) beside a known one along the levels is 0: nothing flows through the bottom.
///
/// # Errors
/// Coordinates that do not overlap.
pub fn shared(plans: &[AxisPlan], centred: usize, staggering: Staggering) -> Result<Option<(AxisPlan, Vec<Arc<OwnAxis>>)>, AxisFault> {
    let (base, kind) = (&plans[centred].axis, plans[centred].kind);
    let step = (base.last() - base.first()) / (base.len() - 1) as f64;
    let is_same = |a: f64, b: f64| (a - b).abs() < SAME * step;
    let alike = |plan: &AxisPlan| {
        let both = plan.axis.coordinates().iter().zip(base.coordinates());
        plan.axis.len() == base.len() && plan.order == plans[centred].order && both.into_iter().all(|(a, b)| is_same(*a, *b))
    };
    if plans.iter().all(alike) {
        return Ok(None);
    }
    // Longitudes of one component may be counted from another meridian.
    let turns = |axis: &Axis| match kind {
        Kind::Longitude => 360.0 * ((base.first() - axis.first()) / 360.0).round(),
        _ => 0.0,
    };
    let own: Vec<Vec<f64>> = plans.iter().map(|plan| plan.axis.coordinates().iter().map(|c| c + turns(&plan.axis)).collect()).collect();
    let period = plans.iter().map(|plan| plan.axis.period()).reduce(|a, b| if a == b { a } else { None }).flatten();
    let mut nodes: Vec<f64> = match staggering {
        Staggering::Centres => own[centred].clone(),
        Staggering::Faces => own.concat(),
    };
    match period {
        Some(period) => {
            let first = nodes.iter().copied().fold(f64::INFINITY, f64::min);
            nodes.iter_mut().for_each(|node| *node = first + (*node - first).rem_euclid(period));
        }
        None if kind == Kind::Level => {}
        None => {
            let mut low = own.iter().map(|c| c[0]).fold(f64::NEG_INFINITY, f64::max);
            let mut high = own.iter().map(|c| c[c.len() - 1]).fold(f64::INFINITY, f64::min);
            // Beside a pole, a component is that of its last row up to the pole, so that no hole is left there.
            let ends = nodes.iter().fold([f64::INFINITY, f64::NEG_INFINITY], |[a, b], node| [a.min(*node), b.max(*node)]);
            if kind == Kind::Latitude {
                low = if ends[0] < step - 90.0 && low < 1.5 * step - 90.0 { ends[0] } else { low };
                high = if ends[1] > 90.0 - step && high > 90.0 - 1.5 * step { ends[1] } else { high };
            }
            nodes.retain(|node| (low..=high).contains(node));
        }
    }
    nodes.sort_by(f64::total_cmp);
    nodes.dedup_by(|a, b| is_same(*a, *b));
    if let (Some(period), [first, .., last]) = (period, &nodes[..])
        && is_same(*last - period, *first)
    {
        nodes.pop();
    }
    let mut axis = Axis::new(base.name(), base.units(), nodes)?;
    if let Some(period) = period {
        axis = axis.with_period(period);
    }
    // The grid's height grows with the logarithm of the pressure.
    let scale = |place: f64| if plans[centred].quantity == Quantity::Pressure { place.ln() } else { place };
    let places = |(which, (plan, own)): (usize, (&AxisPlan, &Vec<f64>))| {
        let own: Vec<f64> = own.iter().map(|c| scale(*c)).collect();
        let weights = axis.coordinates().iter().map(|node| LinearWeight::among(&own, plan.axis.period(), scale(*node))).collect();
        Arc::new(OwnAxis { order: plan.order.clone(), weights, is_closed: which == 2 && kind == Kind::Level })
    };
    let places = plans.iter().zip(&own).enumerate().map(places).collect();
    Ok(Some((AxisPlan { order: (0..axis.len()).collect(), axis, ..plans[centred].clone() }, places)))
}

/// Reads a component like [`read_component`]; along axes on which it has own coordinates, `orders` are nodes of the grid, and along levels that follow the
/// bottom heights.
///
/// # Errors
/// The values cannot be read.
pub fn read_levels(file: &DataFile, component: &ComponentPlan, orders: &Orders, entry: usize) -> Result<Vec<f32>, SourceError> {
    let from = std::array::from_fn(|k| component.own[k].as_ref().map_or_else(|| orders[k].clone(), |own| own.order.clone()));
    let mut values = match &component.columns {
        Some(columns) => columns.read(file, component, &from, entry)?,
        None => read_component(file, component, &from, entry)?,
    };
    let mut counts = from.each_ref().map(Vec::len);
    for (k, own) in component.own.iter().enumerate() {
        let Some(own) = own else { continue };
        let weights: Vec<LinearWeight> = orders[k].iter().map(|&node| own.weights[node]).collect();
        let stride: usize = counts[..k].iter().product();
        let beside = stride * counts[k];
        let mut out = Vec::with_capacity(values.len() / counts[k] * weights.len());
        for block in values.chunks_exact(beside) {
            for weight in &weights {
                let value = |i: usize| move |entry: usize| block[entry * stride + i];
                let of = |i: usize| if own.is_closed { weight.of_known(value(i)) } else { weight.of(value(i)) };
                out.extend((0..stride).map(of));
            }
        }
        counts[k] = weights.len();
        values = out;
    }
    Ok(values)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn axis(values: &[f64], kind: Kind, quantity: Quantity) -> AxisPlan {
        AxisPlan::made(kind, Axis::new("x", "m", values.to_vec()).unwrap(), quantity)
    }

    fn on_nodes(own: &OwnAxis, values: &[f32]) -> Vec<f32> {
        own.weights.iter().map(|w| w.of(|i| values[i])).collect()
    }

    #[test]
    fn faces_and_centres_share_nodes_where_both_are_known() {
        let plans = [axis(&[0.0, 1.0, 2.0, 3.0], Kind::X, Quantity::Length), axis(&[0.5, 1.5, 2.5], Kind::X, Quantity::Length)];
        let (both, own) = shared(&plans, 1, Staggering::Faces).unwrap().unwrap();
        assert_eq!(both.axis.coordinates(), [0.5, 1.0, 1.5, 2.0, 2.5]);
        assert_eq!(on_nodes(&own[0], &[0.0, 10.0, 20.0, 40.0]), [5.0, 10.0, 15.0, 20.0, 30.0]);
        assert_eq!(on_nodes(&own[1], &[1.0, 3.0, 7.0]), [1.0, 2.0, 3.0, 5.0, 7.0]);
        let (centres, own) = shared(&plans, 1, Staggering::Centres).unwrap().unwrap();
        assert_eq!(centres.axis.coordinates(), [0.5, 1.5, 2.5]);
        assert_eq!(on_nodes(&own[0], &[0.0, 10.0, 20.0, 40.0]), [5.0, 15.0, 30.0]);
        assert_eq!(shared(&[plans[0].clone(), plans[0].clone()], 0, Staggering::Faces).unwrap(), None);
    }

    #[test]
    fn levels_reach_to_the_ends_of_all() {
        let plans = [axis(&[-30.0, -10.0], Kind::Level, Quantity::Length), axis(&[-40.0, -20.0, 0.0], Kind::Level, Quantity::Length)];
        let (both, own) = shared(&plans, 0, Staggering::Faces).unwrap().unwrap();
        assert_eq!(both.axis.coordinates(), [-40.0, -30.0, -20.0, -10.0, 0.0]);
        assert_eq!(on_nodes(&own[0], &[3.0, 1.0]), [3.0, 3.0, 2.0, 1.0, 1.0]);
        // Halfway in the logarithm.
        let plans = [axis(&[100.0, 400.0], Kind::Level, Quantity::Pressure), axis(&[200.0, 500.0], Kind::Level, Quantity::Pressure)];
        let (_, own) = shared(&plans, 0, Staggering::Faces).unwrap().unwrap();
        assert_eq!(on_nodes(&own[0], &[0.0, 1.0]), [0.0, 0.5, 1.0, 1.0]);
    }

    #[test]
    fn circles_are_closed_between_the_last_and_the_first() {
        let round = |values: &[f64]| {
            let axis = Axis::new("lon", "degrees_east", values.to_vec()).unwrap().with_period(360.0);
            AxisPlan::made(Kind::Longitude, axis, Quantity::Angle)
        };
        let plans = [round(&[0.0, 90.0, 180.0, 270.0]), round(&[-315.0, -225.0, -135.0, -45.0])];
        let (both, own) = shared(&plans, 0, Staggering::Faces).unwrap().unwrap();
        assert_eq!((both.axis.coordinates(), both.axis.period()), (&[0.0, 45.0, 90.0, 135.0, 180.0, 225.0, 270.0, 315.0][..], Some(360.0)));
        assert_eq!(on_nodes(&own[0], &[0.0, 2.0, 4.0, 8.0])[6..], [8.0, 4.0]);
        assert_eq!(on_nodes(&own[1], &[1.0, 3.0, 5.0, 9.0])[..2], [5.0, 1.0]);
    }

    #[test]
    fn rounding_reads_no_neighbour_and_a_row_beside_a_pole_reaches_it() {
        let weight = LinearWeight::among(&[0.0, 1.0, 2.0], None, 1.000_01);
        assert_eq!(weight.of(|k| [f32::NAN, 7.0, f32::NAN][k]), 7.0);
        let weight = LinearWeight::among(&[0.0, 1.0, 2.0], None, 0.999_99);
        assert_eq!(weight.of(|k| [f32::NAN, 7.0, f32::NAN][k]), 7.0);
        let rows = |first: f64, count: usize| {
            let axis = Axis::new("lat", "degrees_north", (0..count).map(|i| first + 10.0 * i as f64).collect()).unwrap();
            AxisPlan::made(Kind::Latitude, axis, Quantity::Angle)
        };
        let (both, own) = shared(&[rows(-85.0, 18), rows(-90.0, 19)], 0, Staggering::Faces).unwrap().unwrap();
        assert_eq!((both.axis.first(), both.axis.last(), own[0].weights[0].of(|k| k as f32)), (-90.0, 90.0, 0.0));
        let (part, _) = shared(&[rows(-45.0, 8), rows(-50.0, 9)], 0, Staggering::Faces).unwrap().unwrap();
        assert_eq!((part.axis.first(), part.axis.last()), (-45.0, 25.0));
    }

    #[test]
    fn nothing_flows_through_the_bottom() {
        let weight = LinearWeight::at(0.5, 2);
        assert_eq!(weight.of_known(|k| [f32::NAN, 4.0][k]), 2.0);
        assert_eq!(weight.of_known(|k| [2.0, 4.0][k]), 3.0);
        assert!(weight.of_known(|_| f32::NAN).is_nan() && weight.of(|k| [f32::NAN, 4.0][k]).is_nan());
    }
}
