//! From coordinate values in a file to an ascending axis, and the order in which to read the file for it.

use super::SourceError;
use super::cf::coordinate::Kind;
use super::cf::units::{AXIS_UNITS, Unit};
use crate::field::{Axis, AxisFault};
use std::ops::Range;
use std::path::Path;

/// An axis of the grid and where its nodes are in the file.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct AxisPlan {
    pub(super) kind: Kind,
    pub(super) axis: Axis,
    /// Index in the file of each node.
    pub(super) order: Vec<usize>,
    /// What was done to the file's coordinates, in words.
    pub(super) notes: Vec<String>,
    /// Unit of velocities along it: `m/s` or `Pa/s`; none where the axis has no unit.
    pub(super) quantity: Quantity,
    /// Whether the file's coordinates descend.
    pub(super) descending: bool,
}

impl AxisPlan {
    /// An axis that is not one of the file.
    pub(super) fn made(kind: Kind, axis: Axis, quantity: Quantity) -> Self {
        Self { kind, order: (0..axis.len()).collect(), axis, notes: Vec::new(), quantity, descending: false }
    }
}

/// What an axis measures.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Quantity {
    Angle,
    Length,
    Pressure,
    None,
}

/// A coordinate variable, or a dimension without one.
pub(super) struct Coordinates<'a> {
    pub(super) path: &'a Path,
    pub(super) name: &'a str,
    pub(super) units: Option<&'a str>,
    pub(super) positive_down: bool,
    pub(super) kind: Kind,
    pub(super) values: Vec<f64>,
}

impl Coordinates<'_> {
    fn fault(&self, fault: AxisFault) -> SourceError {
        SourceError::Axis { path: self.path.into(), fault }
    }

    /// Makes the axis, cropped to `range` when there is one.
    pub(super) fn plan(mut self, range: Option<[f64; 2]>) -> Result<AxisPlan, SourceError> {
        let mut notes = Vec::new();
        let (quantity, units) = self.convert_units(&mut notes)?;
        if self.kind == Kind::Longitude {
            unwrap_longitudes(&mut self.values, &mut notes);
        }
        let count = self.values.len();
        let mut order: Vec<usize> = (0..count).collect();
        // A depth is read as a height, so that up is up.
        let downward = self.positive_down && quantity == Quantity::Length;
        if downward {
            self.values.iter_mut().for_each(|v| *v = -*v);
            notes.push(format!("`{}` counts downwards: read as height = -{}", self.name, self.name));
        }
        let descending = count > 1 && self.values[count - 1] < self.values[0];
        if descending {
            order.reverse();
            self.values.reverse();
        }
        // The fault counts nodes in ascending order; say so where the file descends.
        Axis::new(self.name, units, self.values.clone()).map_err(|f| self.fault(in_file_order(f, descending, count)))?;
        snap_to_uniform(&mut self.values);
        let mut period = None;
        if self.kind == Kind::Longitude {
            period = self.close_circle(&mut order, &mut notes);
        } else if self.kind == Kind::Latitude && self.values.iter().any(|v| v.abs() > 90.001) {
            let what = format!("latitudes run from {} to {} degrees; accepted are -90 to 90", self.values[0], self.values[count - 1]);
            return Err(SourceError::Layout { path: self.path.into(), variable: self.name.into(), what });
        }
        if let Some(range) = range {
            period = self.crop(range, &mut order, period)?;
        }
        let mut axis = Axis::new(self.name, units, std::mem::take(&mut self.values)).map_err(|f| self.fault(f))?;
        if let Some(period) = period {
            axis = axis.with_period(period);
            notes.push(format!("`{}` goes round: periodic with {period}", self.name));
        }
        Ok(AxisPlan { kind: self.kind, axis, order, notes, quantity, descending: descending != downward })
    }

    /// Converts to degrees, metres or pascal.
    fn convert_units(&mut self, notes: &mut Vec<String>) -> Result<(Quantity, &'static str), SourceError> {
        let text = self.units.unwrap_or_default();
        if matches!(self.kind, Kind::Longitude | Kind::Latitude) {
            if text.to_ascii_lowercase().starts_with("radian") {
                self.values.iter_mut().for_each(|v| *v = v.to_degrees());
                notes.push(format!("`{}` converted from radians to degrees", self.name));
            } else if !text.is_empty() && !text.to_ascii_lowercase().starts_with("degree") {
                return Err(self.unknown_unit(text));
            }
            return Ok((Quantity::Angle, if self.kind == Kind::Longitude { "degrees_east" } else { "degrees_north" }));
        }
        let unit = Unit::parse(text);
        let (quantity, name) = match unit {
            Some(u) if u.is_length() => (Quantity::Length, "m"),
            Some(u) if u.is_pressure() => (Quantity::Pressure, "Pa"),
            Some(u) if u.is_dimensionless() => (Quantity::None, ""),
            // Levels of a model are counted in all sorts of words.
            _ if self.kind == Kind::Level => (Quantity::None, ""),
            _ => return Err(self.unknown_unit(text)),
        };
        if let Some(u) = unit.filter(|u| quantity != Quantity::None && u.factor != 1.0) {
            self.values.iter_mut().for_each(|v| *v *= u.factor);
            notes.push(format!("`{}` converted from {text} to {name}", self.name));
        }
        Ok((quantity, name))
    }

    fn unknown_unit(&self, unit: &str) -> SourceError {
        SourceError::UnknownUnit { path: self.path.into(), variable: self.name.into(), unit: unit.into(), accepted: AXIS_UNITS.into() }
    }

    /// Finds whether longitudes go round the earth; drops a last node that repeats the first.
    fn close_circle(&mut self, order: &mut Vec<usize>, notes: &mut Vec<String>) -> Option<f64> {
        let count = self.values.len();
        let step = (self.values[count - 1] - self.values[0]) / (count - 1) as f64;
        let slack = step * 1e-3;
        if count > 3 && (self.values[count - 1] - self.values[0] - 360.0).abs() < slack {
            self.values.pop();
            order.pop();
            notes.push(format!("the last node of `{}` repeats the first: dropped", self.name));
            return Some(360.0);
        }
        let even = self.values.windows(2).all(|w| (w[1] - w[0] - step).abs() < slack);
        (count > 2 && even && (step * count as f64 - 360.0).abs() < slack).then_some(360.0)
    }

    /// Keeps the nodes in `range`; a periodic axis is rolled so that the range is in one piece.
    fn crop(&mut self, [low, high]: [f64; 2], order: &mut Vec<usize>, period: Option<f64>) -> Result<Option<f64>, SourceError> {
        let angle = self.kind == Kind::Longitude;
        let high = if angle && high <= low { high + 360.0 } else { high };
        let shifted = |v: f64| if angle { low + (v - low).rem_euclid(360.0) } else { v };
        let (first, last) = (self.values[0], self.values[self.values.len() - 1]);
        let mut kept: Vec<(f64, usize)> = self.values.iter().zip(order.iter()).map(|(&v, &i)| (shifted(v), i)).collect();
        kept.retain(|(v, _)| *v >= low && *v <= high);
        kept.sort_by(|a, b| a.0.total_cmp(&b.0));
        let whole = kept.len() == self.values.len();
        if kept.len() < 2 {
            return Err(SourceError::Setting {
                key: "region",
                found: format!("[.., {low}, {high}, ..] holds {} node(s) of axis `{}`", kept.len(), self.name),
                accepted: format!("at least 2 nodes are needed, and the axis runs from {first} to {last}"),
            });
        }
        // The two sides of a hole must not become neighbours.
        if angle && period.is_none() && !kept.windows(2).all(|w| w[0].1.abs_diff(w[1].1) == 1) {
            return Err(SourceError::Setting {
                key: "region",
                found: format!("[{low}, {high}, ..] reaches beyond both ends of axis `{}`", self.name),
                accepted: format!("the axis runs from {first} to {last} and does not go round"),
            });
        }
        *order = kept.iter().map(|k| k.1).collect();
        self.values = kept.into_iter().map(|k| k.0).collect();
        snap_to_uniform(&mut self.values);
        Ok(period.filter(|_| whole))
    }
}

/// Translates the node of a fault to the file's order.
fn in_file_order(fault: AxisFault, descending: bool, count: usize) -> AxisFault {
    match fault {
        AxisFault::NotAscending { name, index, here, before } if descending => {
            AxisFault::NotAscending { name: format!("{name} (descending, read backwards)"), index: count - 1 - index, here, before }
        }
        other => other,
    }
}

/// Makes longitudes that jump by a turn (350, 355, 0, 5 or 175, 180, -175) run on.
fn unwrap_longitudes(values: &mut [f64], notes: &mut Vec<String>) {
    let mut turn = 0.0;
    for i in 1..values.len() {
        let step = values[i] + turn - values[i - 1];
        if step.abs() > 180.0 && step.abs() < 540.0 {
            turn -= step.signum() * 360.0;
        }
        values[i] += turn;
    }
    if turn != 0.0 {
        notes.push("longitudes jump by a turn: made to run on".into());
    }
}

/// Replaces coordinates that are evenly spaced but for the rounding of `f32` or of a decimal by exactly even ones.
fn snap_to_uniform(values: &mut [f64]) {
    let count = values.len();
    if count < 3 {
        return;
    }
    let (first, last) = (values[0], values[count - 1]);
    let step = (last - first) / (count - 1) as f64;
    // Four roundings of f32, but never more than a hundredth of a cell.
    let slack = (first.abs().max(last.abs()) * 4.0 * f64::from(f32::EPSILON)).max(step * 1e-6).min(step * 1e-2);
    if values.iter().enumerate().all(|(i, v)| (v - (first + step * i as f64)).abs() <= slack) {
        for (i, v) in values.iter_mut().enumerate() {
            *v = first + step * i as f64;
        }
    }
}

/// A stretch of nodes that lie side by side in the file.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Run {
    /// Nodes of the grid.
    pub(super) nodes: Range<usize>,
    /// Lowest index in the file.
    pub(super) start: usize,
    /// Whether the file runs the other way.
    pub(super) reversed: bool,
}

/// Splits an order into runs.
pub(super) fn runs(order: &[usize]) -> Vec<Run> {
    let mut runs = Vec::new();
    let mut from = 0;
    while from < order.len() {
        let reversed = from + 1 < order.len() && order[from + 1] + 1 == order[from];
        let mut to = from + 1;
        while to < order.len() && (if reversed { order[to] + 1 == order[to - 1] } else { order[to] == order[to - 1] + 1 }) {
            to += 1;
        }
        runs.push(Run { nodes: from..to, start: order[from].min(order[to - 1]), reversed });
        from = to;
    }
    runs
}

#[cfg(test)]
mod tests {
    use super::*;

    fn longitudes(values: Vec<f64>) -> Coordinates<'static> {
        Coordinates {
            path: Path::new("a.nc"),
            name: "lon",
            units: Some("degrees_east"),
            positive_down: false,
            kind: Kind::Longitude,
            values,
        }
    }

    #[test]
    fn global_longitudes_are_periodic_and_regional_ones_are_not() {
        let global = longitudes((0..360).map(f64::from).collect()).plan(None).unwrap();
        assert_eq!((global.axis.period(), global.axis.len()), (Some(360.0), 360));
        let repeated = longitudes((0..=360).map(f64::from).collect()).plan(None).unwrap();
        assert_eq!((repeated.axis.period(), repeated.axis.len()), (Some(360.0), 360));
        // A twelfth of a degree in f32.
        let fine = longitudes((0..4320).map(|i| f64::from((f64::from(i) / 12.0 - 180.0) as f32)).collect()).plan(None).unwrap();
        assert_eq!((fine.axis.period(), fine.axis.uniform_step().is_some()), (Some(360.0), true));
        assert_eq!(longitudes((0..359).map(f64::from).collect()).plan(None).unwrap().axis.period(), None);
    }

    #[test]
    fn jumping_longitudes_run_on() {
        for (values, first, last) in [
            (vec![350.0, 355.0, 0.0, 5.0], 350.0, 365.0),
            (vec![170.0, 175.0, -180.0, -175.0], 170.0, 185.0),
            (vec![5.0, 0.0, 355.0, 350.0], -10.0, 5.0),
        ] {
            let plan = longitudes(values).plan(None).unwrap();
            assert_eq!((plan.axis.first(), plan.axis.last()), (first, last));
        }
    }

    #[test]
    fn regions_cross_the_seam() {
        let plan = longitudes((0..36).map(|i| f64::from(i * 10)).collect()).plan(Some([-20.0, 15.0])).unwrap();
        assert_eq!(plan.axis.coordinates(), [-20.0, -10.0, 0.0, 10.0]);
        assert_eq!(plan.order, [34, 35, 0, 1]);
        assert_eq!(plan.axis.period(), None);
        let expected = [Run { nodes: 0..2, start: 34, reversed: false }, Run { nodes: 2..4, start: 0, reversed: false }];
        assert_eq!(runs(&plan.order), expected);
        let turned = longitudes((0..36).map(|i| f64::from(i * 10)).collect()).plan(Some([-180.0, 180.0])).unwrap();
        assert_eq!((turned.axis.first(), turned.axis.period()), (-180.0, Some(360.0)));
        let regional = || longitudes(vec![340.0, 345.0, 350.0, 355.0]);
        assert_eq!(regional().plan(Some([-16.0, -4.0])).unwrap().axis.coordinates(), [-15.0, -10.0, -5.0]);
        let message = regional().plan(Some([10.0, 20.0])).unwrap_err().to_string();
        assert!(message.contains("0 node(s)") && message.contains("from 340 to 355"), "{message}");
        assert!(regional().plan(Some([352.0, 343.0])).is_err(), "both ends without the middle");
    }

    #[test]
    fn runs_know_their_direction() {
        assert_eq!(runs(&[3, 2, 1]), [Run { nodes: 0..3, start: 1, reversed: true }]);
        assert_eq!(runs(&[1, 0, 5, 4]).len(), 2);
        assert_eq!(runs(&[]), []);
    }
}
