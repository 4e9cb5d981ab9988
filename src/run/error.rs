//! Why a run could not start or go on.

use crate::backend::{BackendError, DeviceError};
use crate::flow::FlowError;
use crate::render::RenderError;
use crate::setting::Refused;
use crate::source::SourceError;
use crate::surrogate::{CheckpointError, SurrogateError};
use thiserror::Error;

/// Why a run could not start or go on.
#[derive(Debug, Error)]
pub enum EngineError {
    /// A setting.
    #[error(transparent)]
    Setting(#[from] Refused),
    /// The source.
    #[error(transparent)]
    Source(#[from] SourceError),
    /// The flow map.
    #[error(transparent)]
    Flow(#[from] FlowError),
    /// The picture's settings.
    #[error(transparent)]
    Render(#[from] RenderError),
    /// The surrogate's settings.
    #[error(transparent)]
    Surrogate(#[from] SurrogateError),
    /// A checkpoint.
    #[error(transparent)]
    Checkpoint(#[from] CheckpointError),
    /// The device that was asked for, or that was lost.
    #[error(transparent)]
    Device(Box<DeviceError>),
    /// A synthetic grid.
    #[error(transparent)]
    Axis(#[from] crate::field::AxisFault),
    /// The source gave fewer snapshots than its times promised.
    #[error("the source ended before its window was full")]
    EndedEarly,
    /// Every point is land.
    #[error(
        "no velocity anywhere at {when}: all {points} points probed lie on missing cells (fill values or NaN; `ridgewatch inspect` counts \
         them). Colours are scaled to this slide; with transfer.low and transfer.high in the scene it is shown as missing, and the run goes on"
    )]
    AllMissing {
        /// Points probed.
        points: usize,
        /// Their date or time.
        when: String,
    },
    /// The thread pool.
    #[error("cannot start worker threads: {0}")]
    Threads(#[from] rayon::ThreadPoolBuildError),
}

impl EngineError {
    /// The error of a backend that cannot prepare a slide.
    pub fn of(error: BackendError) -> Self {
        match error {
            BackendError::Flow(error) => error.into(),
            BackendError::Surrogate(error) => error.into(),
            BackendError::Device(error) => Self::Device(Box::new(error)),
        }
    }

    /// The setting at fault, where it is one.
    pub fn refused(&self) -> Option<Refused> {
        match self {
            EngineError::Setting(refused) => Some(refused.clone()),
            EngineError::Source(error) => error.refused(),
            EngineError::Flow(error) => error.refused(),
            EngineError::Render(error) => Some(error.clone().into()),
            EngineError::Surrogate(error) => Some(error.clone().into()),
            _ => None,
        }
    }
}
