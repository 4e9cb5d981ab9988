//! The work on a device, and the cycle that drives it.
//!
//! In: [`Settings`]. Out: frames with their records. Calls `field`, `source`, `flow`, `surrogate`, `trust` and `render`.

#[cfg(feature = "cuda")]
mod accelerator;
mod answers;
mod audit;
mod checkpoints;
#[cfg(feature = "cuda")]
pub mod cuda;
mod cycle;
mod device;
mod error;
mod feed;
mod frames;
mod memory;
mod record;
mod settings;
mod setup;
mod stop;
mod training;

pub use crate::trust::TrustedError;
#[cfg(feature = "cuda")]
pub use accelerator::{Accelerator, Backed, DeviceNodes, DeviceRenderer, DeviceTrace, Health};
pub use answers::{Answers, Asked, Tally};
pub use audit::{Audit, AuditFindings, AuditRequest, audit, residuals, stratified_points, trace, trusted_error};
pub use checkpoints::CheckpointTotals;
pub use cycle::{Event, RunOptions, RunReport, run};
pub use device::{Device, DeviceChoice, DeviceSettings, Storage, UnknownDevice, WhenLost};
pub use error::EngineError;
pub use feed::{Feed, Slide, open_snapshots};
pub use record::{CheckpointRecord, FrameRecord, StageSeconds, TransferRecord};
pub use settings::{Settings, TimeSettings, TimeSpan, TrainingSettings};
pub use setup::{Plan, Setup};

/// A finished frame on its way out.
#[derive(Debug, Clone)]
pub struct Frame {
    /// Its figures.
    pub record: std::sync::Arc<FrameRecord>,
    /// Its picture.
    pub film: std::sync::Arc<crate::render::Film>,
    /// `[contrast, brightness, gamma]` for previews.
    pub tone_map: [f64; 3],
}
