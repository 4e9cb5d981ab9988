//! Reasons for the end of a run.

use super::RunError;
use crate::backend::{BackendError, DeviceError};
use std::sync::atomic::{AtomicBool, Ordering};

/// Reason why a step of a run did not complete.
pub(super) enum RunEnd {
    /// The time limit of the run has passed.
    TimeIsUp,
    /// A stop was requested.
    Stopped,
    /// The device failed or is out of memory: the step is repeated, or moved to the CPU.
    Device(DeviceError),
    /// The run failed.
    Failed(RunError),
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

impl<E: Into<RunError>> From<E> for RunEnd {
    fn from(error: E) -> Self {
        Self::Failed(error.into())
    }
}

/// Checks for a request to stop.
///
/// # Errors
/// [`RunEnd::Stopped`] if a stop was requested.
pub(super) fn check_stop(stop: &AtomicBool) -> Result<(), RunEnd> {
    if stop.load(Ordering::Relaxed) { Err(RunEnd::Stopped) } else { Ok(()) }
}
