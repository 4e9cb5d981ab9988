//! Errors of making a tracer.

use super::{Boundary, Precision};
use ridgewatch_base::setting::{Refused, shown, word};
use thiserror::Error;

/// Error of making a tracer.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum FlowError {
    /// A parameter of the flow map is out of range.
    #[error("`{key}` is {found}; accepted: {accepted}")]
    OutOfRange {
        /// Name of the parameter.
        key: &'static str,
        /// Its value.
        found: f64,
        /// Accepted values.
        accepted: &'static str,
    },
    /// The snapshots do not cover the integration.
    #[error(
        "tracing from {from} to {to} needs about {needed} snapshots that cover this span; the window holds {present}{}",
        covered.map_or(String::new(), |(first, last)| format!(", from {first} to {last}"))
    )]
    WindowTooShort {
        /// Earlier end of the integration.
        from: f64,
        /// Later end of the integration.
        to: f64,
        /// Snapshots needed at the spacing of those present; 2 if the spacing is unknown.
        needed: usize,
        /// Snapshots present.
        present: usize,
        /// First and last time present.
        covered: Option<(f64, f64)>,
    },
    /// Gridded velocity ends at its grid.
    #[error("boundary `{}` is for closed-form flows; gridded velocity accepts stop, clamp, periodic or zero", word(.boundary))]
    NotOnGrids {
        /// Boundary requested.
        boundary: Boundary,
    },
    /// Neighbouring particles would round to the same position.
    #[error("`difference_step` {step} vanishes in {} beside coordinates of {coordinate}; at least {min_step} or f64 is needed", word(.precision))]
    DifferenceStepVanishes {
        /// Step requested.
        step: f64,
        /// Floating-point type.
        precision: Precision,
        /// Largest coordinate of the domain.
        coordinate: f64,
        /// Smallest step that changes every coordinate.
        min_step: f64,
    },
    /// Flow and domain have different numbers of axes.
    #[error("the flow varies along {flow} axes, its domain along {domain}")]
    Dimensions {
        /// Axes of the flow.
        flow: usize,
        /// Axes of the domain.
        domain: usize,
    },
    /// The grid has a number of axes that the sphere does not support.
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
    /// The number of velocities of a snapshot differs from that of its grid's nodes.
    #[error("snapshot at time {time} has {found} velocities; its grid has {expected} nodes")]
    SnapshotShape {
        /// Its time.
        time: f64,
        /// Velocities found.
        found: usize,
        /// Nodes of the grid.
        expected: usize,
    },
    /// No number of steps meets the tolerance.
    #[error(
        "{steps} steps still differ from twice as many by {reached:.2e} (root mean square of the log-stretch, FTLE times tau); \
         tolerance {tolerance:.2e}"
    )]
    StepsNotFound {
        /// Largest number of steps tried.
        steps: usize,
        /// Difference reached.
        reached: f64,
        /// Difference requested.
        tolerance: f64,
    },
}

impl FlowError {
    /// The setting at fault; `None` if no setting is.
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
            FlowError::DifferenceStepVanishes { step, precision, coordinate, min_step } => Refused::new(
                "flow.difference_step",
                format_args!("is {step}, which vanishes in {} beside coordinates of {coordinate}", word(precision)),
                format!("at least {min_step}, or flow.precision = \"f64\""),
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
