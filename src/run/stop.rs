//! Why a run ends.

use super::EngineError;
use crate::backend::{BackendError, DeviceError};
use std::sync::atomic::{AtomicBool, Ordering};

/// Why a step of a run did not come to its end.
pub(super) enum RunEnd {
    /// The run's own time is over.
    TimeIsUp,
    /// A stop was requested.
    Stopped,
    /// The device failed or lacks memory: the step is repeated elsewhere.
    Device(DeviceError),
    /// The run failed.
    Failed(EngineError),
}

impl From<DeviceError> for RunEnd {
    fn from(error: DeviceError) -> Self {
        Self::Device(error)
    }
}

impl From<BackendError> for RunEnd {
    fn from(error: BackendError) -> Self {
        match error {
            BackendError::Device(error) => Self::Device(error),
            BackendError::Flow(error) => Self::Failed(error.into()),
            BackendError::Surrogate(error) => Self::Failed(error.into()),
        }
    }
}

impl<E: Into<EngineError>> From<E> for RunEnd {
    fn from(error: E) -> Self {
        Self::Failed(error.into())
    }
}

/// # Errors
/// [`RunEnd::Stopped`] once a stop is requested.
pub(super) fn check_stop(stop: &AtomicBool) -> Result<(), RunEnd> {
    if stop.load(Ordering::Relaxed) { Err(RunEnd::Stopped) } else { Ok(()) }
}
