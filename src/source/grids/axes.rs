//! Ascending axes from the coordinates in a file, and the order in which to read the file for them.

use crate::cf::coordinate::Kind;
use crate::cf::units::{AXIS_UNITS, Unit};
use crate::error::SourceError;
use crate::formats::Variable;
use ridgewatch_field::{Axis, AxisFault};
use serde::Serialize;
use std::ops::Range;
use std::path::Path;

/// An axis of the grid and the places of its nodes in the file.
#[derive(Debug, Clone, PartialEq)]
pub struct AxisPlan {
    pub kind: Kind,
    pub axis: Axis,
    /// Index in the file of each node.
    pub order: Vec<usize>,
    /// Changes to the file's coordinates, as sentences.
    pub notes: Vec<String>,
    pub quantity: Quantity,
    /// The coordinate in the file; `None` if the axis does not come from the file.
    pub in_file: Option<InFile>,
}

/// A coordinate in a file.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct InFile {
    /// First coordinate.
    pub first: f64,
    /// Last coordinate.
    pub last: f64,
    /// Unit.
    pub units: String,
    /// Direction.
    pub order: FileOrder,
}

/// Order of coordinates in a file.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum FileOrder {
    /// Upwards.
    Ascending,
    /// Downwards.
    Descending,
    /// Neither (longitudes that jump by 360 degrees are continued first).
    Unsorted,
}

impl FileOrder {
    /// From the order in which the coordinates ascend.
    fn of(order: &[usize]) -> Self {
        let by = |step: isize| order.windows(2).all(|w| w[0].checked_add_signed(step) == Some(w[1]));
        match () {
            () if by(1) => Self::Ascending,
            () if by(-1) => Self::Descending,
            () => Self::Unsorted,
        }
    }
}

impl AxisPlan {
    /// An axis that does not come from the file.
    pub fn made(kind: Kind, axis: Axis, quantity: Quantity) -> Self {
        Self { kind, order: (0..axis.len()).collect(), axis, notes: Vec::new(), quantity, in_file: None }
    }
}

/// Quantity along an axis.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Quantity {
    Angle,
    Length,
    Pressure,
    None,
}

/// A coordinate variable, or a dimension without one.
pub struct Coordinates<'a> {
    pub path: &'a Path,
    pub name: &'a str,
    pub units: Option<&'a str>,
    pub positive_down: bool,
    pub kind: Kind,
    pub values: Vec<f64>,
}

impl<'a> Coordinates<'a> {
    /// Coordinates of a variable with `values` along `kind`.
    pub fn of(path: &'a Path, variable: &'a Variable, kind: Kind, values: Vec<f64>) -> Self {
        let positive = variable.text("positive");
        let positive_down = positive.is_some_and(|p| p.eq_ignore_ascii_case("down"))
            || (positive.is_none() && variable.text("standard_name") == Some("depth"));
        Self { path, name: &variable.name, units: variable.units(), positive_down, kind, values }
    }

    fn misfit(&self, what: String) -> SourceError {
        SourceError::variable(self.path, self.name, what)
    }

    fn fault(&self, fault: AxisFault) -> SourceError {
        SourceError::file(self.path, fault)
    }

    /// Makes the axis, cropped to `range` if one is given. Longitudes that close the circle become periodic if `periodic` is set;
    /// otherwise they end at their last node.
    pub fn plan(mut self, range: Option<[f64; 2]>, periodic: bool) -> Result<AxisPlan, SourceError> {
        let mut notes = Vec::new();
        let ends = self.values.first().copied().zip(self.values.last().copied());
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
        if self.kind == Kind::Level && self.values.iter().all(|v| v.is_finite()) {
            // Levels may come in any order: sorting them does not tear the horizontal plane.
            order.sort_by(|&a, &b| self.values[a].total_cmp(&self.values[b]));
            self.values.sort_by(f64::total_cmp);
        } else if count > 1 && self.values[count - 1] < self.values[0] {
            order.reverse();
            self.values.reverse();
        }
        self.check_ascent(units, &order)?;
        let in_order = match FileOrder::of(&order) {
            FileOrder::Ascending if downward => FileOrder::Descending,
            FileOrder::Descending if downward => FileOrder::Ascending,
            FileOrder::Unsorted => {
                notes.push(format!("`{}` neither ascends nor descends in the file: sorted", self.name));
                FileOrder::Unsorted
            }
            as_it_is => as_it_is,
        };
        let in_file = ends.map(|(first, last)| InFile { first, last, units: self.units.unwrap_or_default().into(), order: in_order });
        snap_to_uniform(&mut self.values);
        let mut period = None;
        if self.kind == Kind::Longitude {
            // A region may cross the seam, whether or not the axis repeats.
            period = self.close_circle(&mut order, &mut notes, periodic || range.is_some());
        } else if self.kind == Kind::Latitude && self.values.iter().any(|v| v.abs() > 90.001) {
            let what = format!("latitudes run from {} to {} degrees; accepted are -90 to 90", self.values[0], self.values[count - 1]);
            return Err(self.misfit(what));
        }
        if let Some(range) = range {
            period = self.crop(range, &mut order, period)?;
        }
        let mut axis = Axis::new(self.name, units, std::mem::take(&mut self.values)).map_err(|f| self.fault(f))?;
        match period {
            Some(period) if periodic => {
                axis = axis.with_period(period);
                notes.push(format!("`{}` goes round: periodic with {period}", self.name));
            }
            Some(_) => notes.push(format!("`{}` goes round, but ends where its nodes do, as set", self.name)),
            None => {}
        }
        Ok(AxisPlan { kind: self.kind, axis, order, notes, quantity, in_file })
    }

    /// Refuses coordinates that turn back, repeat or are missing. They were brought into `order`; messages count as the file does.
    fn check_ascent(&self, units: &str, order: &[usize]) -> Result<(), SourceError> {
        let refuse = |what| Err(self.misfit(what));
        if let Some(odd) = self.values.iter().position(|v| !v.is_finite()) {
            return refuse(format!("its entry {} is missing or not a number; every node needs a coordinate", order[odd]));
        }
        let odd = match Axis::new(self.name, units, self.values.clone()) {
            Ok(_) => return Ok(()),
            Err(AxisFault::NotAscending { index, .. }) => index,
            Err(other) => return Err(self.fault(other)),
        };
        let (here, before) = (order[odd].max(order[odd - 1]), order[odd].min(order[odd - 1]));
        let (a, b) = (self.values[odd].max(self.values[odd - 1]), self.values[odd].min(self.values[odd - 1]));
        refuse(if a == b {
            format!("its entries {before} and {here} are both {a} {units}; accepted are coordinates that differ")
        } else {
            format!(
                "it turns back between its entries {before} and {here} ({b} and {a} {units}); accepted are coordinates that ascend or descend \
                 throughout, in any order for levels"
            )
        })
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
            // Levels of a model have many kinds of units.
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
        let (key, usual) = match self.kind {
            Kind::Longitude => ("x", "degrees_east"),
            Kind::Latitude => ("y", "degrees_north"),
            Kind::X => ("x", "m"),
            Kind::Y => ("y", "m"),
            _ => ("z", "m"),
        };
        let how = format!("if the file is wrong, state it with --set archive.units.{key}={usual}");
        SourceError::file(self.path, format!("variable `{}` has unit `{unit}`; accepted are {AXIS_UNITS}; {how}", self.name))
    }

    /// Period of longitudes that close the circle. Drops a last node that repeats the first, if `once` is set.
    fn close_circle(&mut self, order: &mut Vec<usize>, notes: &mut Vec<String>, once: bool) -> Option<f64> {
        let count = self.values.len();
        let step = (self.values[count - 1] - self.values[0]) / (count - 1) as f64;
        let slack = step * 1e-3;
        if count > 3 && (self.values[count - 1] - self.values[0] - 360.0).abs() < slack {
            if once {
                self.values.pop();
                order.pop();
                notes.push(format!("the last node of `{}` repeats the first: dropped", self.name));
            }
            return Some(360.0);
        }
        let even = self.values.windows(2).all(|w| (w[1] - w[0] - step).abs() < slack);
        (count > 2 && even && (step * count as f64 - 360.0).abs() < slack).then_some(360.0)
    }

    /// Keeps the nodes in `range`. Rolls a periodic axis so that the range is in one piece.
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
            let found = format!("[.., {low}, {high}, ..] holds {} node(s) of axis `{}`", kept.len(), self.name);
            let accepted = format!("at least 2 nodes are needed, and the axis runs from {first} to {last}");
            return Err(SourceError::setting("region", found, accepted));
        }
        // The two sides of a hole must not become neighbours.
        if angle && period.is_none() && !kept.windows(2).all(|w| w[0].1.abs_diff(w[1].1) == 1) {
            let found = format!("[{low}, {high}, ..] reaches beyond both ends of axis `{}`", self.name);
            return Err(SourceError::setting("region", found, format!("the axis runs from {first} to {last} and does not go round")));
        }
        *order = kept.iter().map(|k| k.1).collect();
        self.values = kept.into_iter().map(|k| k.0).collect();
        snap_to_uniform(&mut self.values);
        Ok(period.filter(|_| whole))
    }
}

/// Continues longitudes that jump by 360 degrees (350, 355, 0, 5 or 175, 180, -175).
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
        notes.push("longitudes jump by 360 degrees: continued".into());
    }
}

/// Replaces coordinates that are evenly spaced, up to the rounding of `f32` or of a decimal, by exactly even ones.
fn snap_to_uniform(values: &mut [f64]) {
    let count = values.len();
    if count < 3 {
        return;
    }
    let (first, last) = (values[0], values[count - 1]);
    let step = (last - first) / (count - 1) as f64;
    // Four roundings of f32, and at most a hundredth of a cell.
    let slack = (first.abs().max(last.abs()) * 4.0 * f64::from(f32::EPSILON)).max(step * 1e-6).min(step * 1e-2);
    if values.iter().enumerate().all(|(i, v)| (v - (first + step * i as f64)).abs() <= slack) {
        for (i, v) in values.iter_mut().enumerate() {
            *v = first + step * i as f64;
        }
    }
}

/// A range of nodes that are neighbours in the file.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Run {
    /// Nodes of the grid.
    pub nodes: Range<usize>,
    /// Lowest index in the file.
    pub start: usize,
    /// True if the file has them in the opposite order.
    pub reversed: bool,
}

/// Splits an order into runs.
pub fn runs(order: &[usize]) -> Vec<Run> {
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

/// Slab over which a flow in a plane is extruded: from 0 to a tenth of the longer edge.
pub fn slab_of(axes: &[Axis]) -> (f64, f64) {
    let edge = axes[..2].iter().map(|a| a.last() - a.first()).fold(0.0, f64::max);
    (0.0, edge / 10.0)
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
        let global = longitudes((0..360).map(f64::from).collect()).plan(None, true).unwrap();
        assert_eq!((global.axis.period(), global.axis.len()), (Some(360.0), 360));
        let repeated = longitudes((0..=360).map(f64::from).collect()).plan(None, true).unwrap();
        assert_eq!((repeated.axis.period(), repeated.axis.len()), (Some(360.0), 360));
        // A twelfth of a degree in f32.
        let fine = longitudes((0..4320).map(|i| f64::from((f64::from(i) / 12.0 - 180.0) as f32)).collect()).plan(None, true).unwrap();
        assert_eq!((fine.axis.period(), fine.axis.uniform_step().is_some()), (Some(360.0), true));
        assert_eq!(longitudes((0..359).map(f64::from).collect()).plan(None, true).unwrap().axis.period(), None);
    }

    #[test]
    fn jumping_longitudes_run_on() {
        for (values, first, last) in [
            (vec![350.0, 355.0, 0.0, 5.0], 350.0, 365.0),
            (vec![170.0, 175.0, -180.0, -175.0], 170.0, 185.0),
            (vec![5.0, 0.0, 355.0, 350.0], -10.0, 5.0),
        ] {
            let plan = longitudes(values).plan(None, true).unwrap();
            assert_eq!((plan.axis.first(), plan.axis.last()), (first, last));
        }
    }

    #[test]
    fn regions_cross_the_seam() {
        let plan = longitudes((0..36).map(|i| f64::from(i * 10)).collect()).plan(Some([-20.0, 15.0]), true).unwrap();
        assert_eq!(plan.axis.coordinates(), [-20.0, -10.0, 0.0, 10.0]);
        assert_eq!(plan.order, [34, 35, 0, 1]);
        assert_eq!(plan.axis.period(), None);
        let expected = [Run { nodes: 0..2, start: 34, reversed: false }, Run { nodes: 2..4, start: 0, reversed: false }];
        assert_eq!(runs(&plan.order), expected);
        let turned = longitudes((0..36).map(|i| f64::from(i * 10)).collect()).plan(Some([-180.0, 180.0]), true).unwrap();
        assert_eq!((turned.axis.first(), turned.axis.period()), (-180.0, Some(360.0)));
        let regional = || longitudes(vec![340.0, 345.0, 350.0, 355.0]);
        assert_eq!(regional().plan(Some([-16.0, -4.0]), true).unwrap().axis.coordinates(), [-15.0, -10.0, -5.0]);
        let message = regional().plan(Some([10.0, 20.0]), true).unwrap_err().to_string();
        assert!(message.contains("0 node(s)") && message.contains("from 340 to 355"), "{message}");
        assert!(regional().plan(Some([352.0, 343.0]), true).is_err(), "both ends without the middle");
    }

    #[test]
    fn longitudes_that_are_to_end_keep_their_last_node() {
        let round = || longitudes((0..=36).map(|i| f64::from(i * 10)).collect());
        let plan = round().plan(None, false).unwrap();
        assert_eq!((plan.axis.period(), plan.axis.len(), plan.axis.last()), (None, 37, 360.0));
        assert!(plan.notes.iter().any(|n| n.contains("ends where its nodes do")), "{:?}", plan.notes);
        assert!(plan.notes.iter().all(|n| !n.contains("periodic") && !n.contains("dropped")), "{:?}", plan.notes);
        // A region across the seam meets the first node once.
        let plan = round().plan(Some([-20.0, 15.0]), false).unwrap();
        assert_eq!((plan.axis.coordinates(), plan.axis.period()), (&[-20.0, -10.0, 0.0, 10.0][..], None));
    }

    #[test]
    fn levels_come_in_any_order() {
        let levels = |values: &[f64], down| Coordinates {
            units: Some("hPa"),
            positive_down: down,
            kind: Kind::Level,
            ..longitudes(values.to_vec())
        };
        for (values, order, in_order) in [
            ([1000.0, 500.0, 850.0], [1, 2, 0], FileOrder::Unsorted),
            ([500.0, 850.0, 1000.0], [0, 1, 2], FileOrder::Ascending),
            ([1000.0, 850.0, 500.0], [2, 1, 0], FileOrder::Descending),
        ] {
            let plan = levels(&values, false).plan(None, true).unwrap();
            assert_eq!((plan.axis.coordinates(), &plan.order[..]), (&[5e4, 8.5e4, 1e5][..], &order[..]));
            let in_file = plan.in_file.unwrap();
            assert_eq!((in_file.first, in_file.last, in_file.order), (values[0], values[2], in_order));
            assert_eq!(plan.notes.iter().any(|n| n.contains("sorted")), in_order == FileOrder::Unsorted);
        }
        // A depth ascends although the height that is made of it descends.
        let depth = Coordinates { units: Some("m"), ..levels(&[0.0, 10.0, 30.0], true) }.plan(None, true).unwrap();
        assert_eq!((depth.axis.first(), depth.in_file.unwrap().order), (-30.0, FileOrder::Ascending));
        for (values, piece) in
            [([1000.0, 500.0, 1000.0], "entries 0 and 2 are both 100000"), ([1000.0, f64::NAN, 500.0], "entry 1 is missing")]
        {
            let message = levels(&values, false).plan(None, true).unwrap_err().to_string();
            assert!(message.contains(piece), "{message}");
        }
    }

    #[test]
    fn runs_know_their_direction() {
        assert_eq!(runs(&[3, 2, 1]), [Run { nodes: 0..3, start: 1, reversed: true }]);
        assert_eq!(runs(&[1, 0, 5, 4]).len(), 2);
        assert_eq!(runs(&[]), []);
    }
}
