//! Why a flow map cannot be traced.

use super::{Boundary, Precision};
use crate::setting::{Refused, shown, word};
use thiserror::Error;

/// Why no tracer was made.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum FlowError {
    /// A number of the flow map is out of range.
    #[error("`{key}` is {found}; accepted: {accepted}")]
    OutOfRange {
        /// Its name.
        key: &'static str,
        /// What it is.
        found: f64,
        /// What is accepted.
        accepted: &'static str,
    },
    /// The snapshots do not reach far enough.
    #[error(
        "tracing from {from} to {to} needs about {needed} snapshots that cover this span; there are {present}{}",
        covered.map_or(String::new(), |(first, last)| format!(", from {first} to {last}"))
    )]
    WindowTooShort {
        /// Earlier end of the integration.
        from: f64,
        /// Later end of the integration.
        to: f64,
        /// Snapshots needed at the spacing of those present (2 where that is unknown).
        needed: usize,
        /// Snapshots present.
        present: usize,
        /// First and last time present.
        covered: Option<(f64, f64)>,
    },
    /// Snapshots end where the grid ends.
    #[error("boundary `{}` is for closed-form flows; gridded velocity accepts stop, clamp, periodic or zero", word(.boundary))]
    NotOnGrids {
        /// What was asked for.
        boundary: Boundary,
    },
    /// Neighbouring particles would fall on the same number.
    #[error("`gap` {gap} vanishes in {} beside coordinates of {coordinate}; at least {least} or f64 is needed", word(.precision))]
    GapVanishes {
        /// What was asked for.
        gap: f64,
        /// Floating-point type.
        precision: Precision,
        /// Largest coordinate of the domain.
        coordinate: f64,
        /// Smallest gap that survives.
        least: f64,
    },
    /// The closed form and the box disagree.
    #[error("the flow varies along {flow} axes, its domain along {domain}")]
    Dimensions {
        /// Axes of the flow.
        flow: usize,
        /// Axes of the domain.
        domain: usize,
    },
    /// A number of axes that the sphere does not have.
    #[error("sphere metric is for two or three axes (longitude, latitude, height); the grid has {axes}")]
    SphereAxes {
        /// Axes found.
        axes: usize,
    },
    /// Node indices are 32-bit.
    #[error("the grid has {nodes} nodes; at most {} are accepted", u32::MAX)]
    GridTooLarge {
        /// Nodes found.
        nodes: usize,
    },
    /// A snapshot does not fit its grid.
    #[error("snapshot at time {time} has {found} velocities; its grid has {expected} nodes")]
    SnapshotShape {
        /// Its time.
        time: f64,
        /// Velocities found.
        found: usize,
        /// Nodes of the grid.
        expected: usize,
    },
    /// No number of steps was enough.
    #[error(
        "{steps} steps still differ from twice as many by {reached:.2e} (root mean square of the log-stretch); tolerance {tolerance:.2e}"
    )]
    StepsNotFound {
        /// Most steps tried.
        steps: usize,
        /// Difference reached.
        reached: f64,
        /// Difference asked for.
        tolerance: f64,
    },
}

impl FlowError {
    /// The setting at fault, where it is one.
    pub fn refused(&self) -> Option<Refused> {
        Some(match self {
            FlowError::OutOfRange { key, found, accepted } => {
                let key = match *key {
                    "tau" => "time.tau".to_owned(),
                    "t0" => "time.start".to_owned(),
                    "steps.tolerance" => "flow.tolerance".to_owned(),
                    other => format!("flow.{other}"),
                };
                Refused::new(key, format_args!("is {found}"), *accepted)
            }
            FlowError::NotOnGrids { boundary } => {
                Refused::new("flow.boundary", format_args!("is {}", shown(boundary)), "stop, clamp, periodic or zero on gridded velocity")
            }
            FlowError::GapVanishes { gap, precision, coordinate, least } => Refused::new(
                "flow.difference_step",
                format_args!("is {gap}, which vanishes in {} beside coordinates of {coordinate}", word(precision)),
                format!("at least {least}, or flow.precision = \"f64\""),
            )
            .beside(&["flow.precision"]),
            FlowError::SphereAxes { axes } => Refused::new(
                "archive.metric",
                format_args!("is sphere, for a grid of {axes} axes"),
                "sphere for longitude and latitude alone (archive.level picks one level); index or cartesian otherwise",
            ),
            FlowError::StepsNotFound { steps, reached, tolerance } => Refused::new(
                "flow.tolerance",
                format_args!("is {tolerance}, but {steps} steps still differ from twice as many by {reached:.2e}"),
                "a larger tolerance, flow.precision = \"f64\", or flow.steps as a number",
            ),
            _ => return None,
        })
    }
}
