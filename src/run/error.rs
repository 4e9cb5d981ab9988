//! Errors of a run.

use crate::backend::{BackendError, DeviceError};
use crate::flow::FlowError;
use crate::render::RenderError;
use crate::setting::Refused;
use crate::source::SourceError;
use crate::surrogate::{CheckpointError, SurrogateError};
use thiserror::Error;

/// Error that prevents a run from starting or continuing.
#[derive(Debug, Error)]
pub enum RunError {
    /// A setting is not accepted.
    #[error(transparent)]
    Setting(#[from] Refused),
    /// The source fails.
    #[error(transparent)]
    Source(#[from] SourceError),
    /// The flow map cannot be built.
    #[error(transparent)]
    Flow(#[from] FlowError),
    /// Settings of the picture are not accepted.
    #[error(transparent)]
    Render(#[from] RenderError),
    /// Settings of the surrogate are not accepted.
    #[error(transparent)]
    Surrogate(#[from] SurrogateError),
    /// A checkpoint cannot be read or written.
    #[error(transparent)]
    Checkpoint(#[from] CheckpointError),
    /// The device cannot be used, or was lost.
    #[error(transparent)]
    Device(Box<DeviceError>),
    /// The axis of a synthetic grid is not accepted.
    #[error(transparent)]
    Axis(#[from] crate::field::AxisFault),
    /// The source has fewer snapshots than listed times.
    #[error("the source ended before its window was full")]
    EndedEarly,
    /// Every probed point lies on missing cells.
    #[error(
        "no velocity anywhere at {when}: all {points} points probed lie on missing cells (fill values or NaN; `ridgewatch inspect` counts \
         them). Colours cannot be scaled to this slide; if the scene sets transfer.low and transfer.high, it is shown as missing and the run continues"
    )]
    AllMissing {
        /// Number of probed points.
        points: usize,
        /// Their date or time.
        when: String,
    },
    /// The thread pool cannot start.
    #[error("cannot start worker threads: {0}")]
    Threads(#[from] rayon::ThreadPoolBuildError),
}

impl RunError {
    /// Error of a backend that cannot prepare a slide.
    pub fn of(error: BackendError) -> Self {
        match error {
            BackendError::Flow(error) => error.into(),
            BackendError::Surrogate(error) => error.into(),
            BackendError::Device(error) => Self::Device(Box::new(error)),
        }
    }

    /// Returns the setting at fault; `None` for other errors.
    pub fn refused(&self) -> Option<Refused> {
        match self {
            RunError::Setting(refused) => Some(refused.clone()),
            RunError::Source(error) => error.refused(),
            RunError::Flow(error) => error.refused(),
            RunError::Render(error) => Some(error.clone().into()),
            RunError::Surrogate(error) => Some(error.clone().into()),
            _ => None,
        }
    }
}
