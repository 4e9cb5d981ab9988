//! The record of a map.

use super::footprint::{RasterError, Sampling};
use crate::flow::Direction;
use crate::render::ProjectionKind;
use serde::Serialize;

/// Record of a map, as JSON beside the picture.
#[derive(Debug, Clone, Serialize)]
pub struct MapRecord {
    /// Version of ridgewatch.
    pub version: &'static str,
    /// Title of the scene.
    pub title: String,
    /// Source of the velocity.
    pub source: String,
    /// Seed time, in time units of the source.
    pub time: f64,
    /// Seed time as a date.
    pub date: Option<String>,
    /// Unit of `time` and `tau`; empty if they have none.
    pub time_unit: String,
    /// Third coordinate of the seeds; `None` in two dimensions.
    pub level: Option<f64>,
    /// Projection.
    pub projection: ProjectionKind,
    /// West, south, east and north end of the data, in coordinates.
    pub region: [f64; 4],
    /// Pixels of a panel along x and y.
    pub pixels: [usize; 2],
    /// Seeds per pixel, and the seed of their shifts.
    pub sampling: Sampling,
    /// Unit of all FTLE values below.
    pub ftle_unit: String,
    /// Range of the colours.
    pub range: [f64; 2],
    /// Largest speed of the arrows; `None` without arrows.
    pub fastest: Option<f64>,
    /// What counts as a ridge; `None` without ridges.
    pub ridges: Option<RidgeRecord>,
    /// One for each tau and direction.
    pub panels: Vec<PanelRecord>,
}

/// What counts as a ridge.
#[derive(Debug, Clone, Copy, Serialize)]
pub struct RidgeRecord {
    /// Nodes along x and y.
    pub grid: [usize; 2],
    /// Percentile of the FTLE that part of a line reaches.
    pub percentile: f64,
}

/// Record of the FTLE of one tau and direction.
#[derive(Debug, Clone, Serialize)]
pub struct PanelRecord {
    /// Direction of the integration.
    pub direction: Direction,
    /// |tau|.
    pub tau: f64,
    /// Runge-Kutta steps per path; 0 if adaptive.
    pub steps: usize,
    /// Difference of the log-stretch from twice as many steps; `None` if the steps were given.
    pub integration_difference: Option<f64>,
    /// Error of the pixels; `None` if no pixel has a velocity.
    pub error: Option<RasterError>,
    /// `error.rms` as a share of the range of colours.
    pub error_share: Option<f64>,
    /// Smallest, mean and largest pixel; `None` if no pixel has a velocity.
    pub ftle: Option<[f64; 3]>,
    /// Share of the pixels within the data that is land or missing.
    pub missing_share: f64,
    /// Seeds whose integration gave no finite number.
    pub failed_seeds: usize,
    /// Ridge lines; `None` without ridges.
    pub ridge_lines: Option<usize>,
    /// Roughness of the field that ridges are found in, as in [`super::RidgesRecord`]; `None` without ridges.
    pub ridge_roughness: Option<f64>,
    /// Standard deviation of the smoothing before ridges are found, in nodes; `None` without ridges.
    pub ridge_smoothing: Option<f64>,
    /// Least length of a line on which the FTLE reaches the percentile, in nodes; `None` without ridges.
    pub ridge_length: Option<f64>,
    /// Colour map.
    pub colours: &'static str,
}
