//! One coordinate axis of a grid.

use std::cmp::Ordering;
use thiserror::Error;

/// A strictly ascending coordinate axis. Readers flip descending axes (latitude, pressure) before they make an [`Axis`].
#[derive(Debug, Clone, PartialEq)]
pub struct Axis {
    name: String,
    units: String,
    coordinates: Vec<f64>,
    /// Spacing if all intervals are equal to within 1e-5 of their mean.
    uniform_step: Option<f64>,
    /// The length after which the axis repeats, e.g. 360 for global longitudes.
    period: Option<f64>,
}

/// Error of making an axis from coordinates.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum AxisFault {
    /// Fewer than two nodes.
    #[error("axis `{name}` has {found} node(s); at least 2 are needed")]
    TooShort {
        /// Axis name.
        name: String,
        /// Nodes found.
        found: usize,
    },
    /// The coordinates descend, repeat or are not finite.
    #[error("axis `{name}` is not strictly ascending: node {index} is {here}, the one before it is {before}")]
    NotAscending {
        /// Axis name.
        name: String,
        /// Index of the offending node.
        index: usize,
        /// Its coordinate.
        here: f64,
        /// The coordinate before it.
        before: f64,
    },
}

impl Axis {
    /// An axis with the given coordinates.
    ///
    /// # Errors
    /// Fewer than two coordinates, or coordinates that do not ascend strictly.
    pub fn new(name: impl Into<String>, units: impl Into<String>, coordinates: Vec<f64>) -> Result<Self, AxisFault> {
        let name = name.into();
        if coordinates.len() < 2 {
            return Err(AxisFault::TooShort { name, found: coordinates.len() });
        }
        if let Some(i) = (1..coordinates.len()).find(|&i| coordinates[i].partial_cmp(&coordinates[i - 1]) != Some(Ordering::Greater)) {
            return Err(AxisFault::NotAscending { name, index: i, here: coordinates[i], before: coordinates[i - 1] });
        }
        if !(coordinates[0].is_finite() && coordinates[coordinates.len() - 1].is_finite()) {
            return Err(AxisFault::NotAscending { name, index: coordinates.len() - 1, here: f64::NAN, before: f64::NAN });
        }
        let intervals = (coordinates.len() - 1) as f64;
        let step = (coordinates[coordinates.len() - 1] - coordinates[0]) / intervals;
        let even = coordinates.windows(2).all(|w| ((w[1] - w[0]) / step - 1.0).abs() < 1e-5);
        Ok(Self { name, units: units.into(), coordinates, uniform_step: even.then_some(step), period: None })
    }

    /// An axis of `nodes` evenly spaced nodes from `first` to `last`.
    ///
    /// # Errors
    /// As [`Self::new`].
    pub fn uniform(name: impl Into<String>, units: impl Into<String>, first: f64, last: f64, nodes: usize) -> Result<Self, AxisFault> {
        let name = name.into();
        if nodes < 2 {
            return Err(AxisFault::TooShort { name, found: nodes });
        }
        let step = (last - first) / (nodes - 1) as f64;
        Self::new(name, units, (0..nodes).map(|i| first + step * i as f64).collect())
    }

    /// Makes the axis periodic. The interval between the last node and the image of the first is a cell too.
    pub fn with_period(mut self, period: f64) -> Self {
        self.period = Some(period);
        self
    }

    /// The axis with every `stride`-th of its nodes, from the first on.
    pub(super) fn thinned(&self, stride: usize) -> Self {
        let coordinates = self.coordinates.iter().copied().step_by(stride).collect();
        Self { coordinates, uniform_step: self.uniform_step.map(|step| step * stride as f64), ..self.clone() }
    }

    /// Name in the source, e.g. `longitude`.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Units in the source, e.g. `degrees_east`.
    pub fn units(&self) -> &str {
        &self.units
    }

    /// Node coordinates, ascending.
    pub fn coordinates(&self) -> &[f64] {
        &self.coordinates
    }

    /// Number of nodes (never 0).
    #[allow(clippy::len_without_is_empty)]
    pub fn len(&self) -> usize {
        self.coordinates.len()
    }

    /// First coordinate.
    pub fn first(&self) -> f64 {
        self.coordinates[0]
    }

    /// Last coordinate, or the image of the first if the axis is periodic.
    pub fn last(&self) -> f64 {
        self.period.map_or(self.coordinates[self.coordinates.len() - 1], |p| self.first() + p)
    }

    /// Spacing; `None` unless the axis is uniform.
    pub fn uniform_step(&self) -> Option<f64> {
        self.uniform_step
    }

    /// Length after which the axis repeats; `None` unless it is periodic.
    pub fn period(&self) -> Option<f64> {
        self.period
    }

    /// Number of cells: that of the nodes if the axis is periodic, otherwise one less.
    pub fn cells(&self) -> usize {
        if self.period.is_some() { self.len() } else { self.len() - 1 }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_axis_that_turns_back_is_named() {
        let fault = Axis::new("lat", "degrees_north", vec![0.0, 1.0, 0.5]).unwrap_err();
        assert_eq!(fault.to_string(), "axis `lat` is not strictly ascending: node 2 is 0.5, the one before it is 1");
        assert!(Axis::new("lat", "", vec![0.0, f64::NAN]).is_err());
        assert!(Axis::new("lat", "", vec![0.0]).is_err());
    }

    #[test]
    fn spacing_is_found() {
        assert_eq!(Axis::uniform("x", "", 0.0, 2.0, 5).unwrap().uniform_step(), Some(0.5));
        assert_eq!(Axis::new("x", "", vec![0.0, 1.0, 3.0]).unwrap().uniform_step(), None);
        let round = Axis::uniform("lon", "", 0.0, 270.0, 4).unwrap().with_period(360.0);
        assert_eq!((round.cells(), round.last()), (4, 360.0));
    }
}
