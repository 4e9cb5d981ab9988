//! The cycle: slides of the window, each frame as one transaction on one backend, learning, assessing, checkpoints and records.
//!
//! In: [`Settings`]. Out: frames with their records. Calls `source`, `backend` and what that calls. A frame's results take effect when it is whole; if
//! the device fails, the frame is discarded and made again on the CPU.

mod assess;
mod checkpoints;
mod cycle;
mod error;
mod frame;
mod memory;
mod prepare;
mod record;
mod settings;
mod setup;
mod slides;
mod stop;
mod training;
mod transaction;

pub use crate::trust::TrustedError;
pub use checkpoints::CheckpointTotals;
pub use cycle::{Event, RunOptions, RunReport, run, run_on};
pub use error::EngineError;
pub use record::{CheckpointRecord, Frame, FrameRecord, StageSeconds, TransferRecord};
pub use settings::{Settings, TimeSettings, TimeSpan, TrainingSettings};
pub use setup::{Plan, Setup};
pub use slides::{Slide, Slides, open_snapshots};
