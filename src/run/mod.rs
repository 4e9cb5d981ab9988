//! The cycle: slides of the window, frames, training, error estimates, checkpoints and records.
//!
//! In: [`Settings`], and commands while it goes on ([`Steering`]). Out: frames with their records. Calls `source`, `backend` and the rooms below it. Each frame is a transaction on one backend:
//! its results take effect when it is complete. If the device fails, the frame is discarded and rendered again on the CPU.

mod another_map;
mod assess;
mod budget;
mod checkpoints;
mod color_bar;
mod commands;
mod cycle;
mod decision;
mod default_tau;
mod doubts;
mod error;
mod frame;
mod integration;
mod memory;
mod need;
mod prepare;
mod race;
mod record;
mod refine;
mod report;
mod scene;
mod settings;
mod setup;
mod slides;
mod snapshots;
mod state;
mod steering;
mod steps;
mod stop;
mod storage;
mod training;
mod transaction;
mod until;

pub use crate::trust::TrustedError;
pub use checkpoints::CheckpointTotals;
pub use color_bar::ColorBar;
pub use cycle::{run, run_on};
pub use decision::{Decision, why_steps};
pub(crate) use decision::{cpu_batch, suited_network};
pub use doubts::{short_lived, uniform_ftle};
pub use error::RunError;
pub use race::Race;
pub use record::{CheckpointRecord, DomainRecord, Frame, FrameRecord, StageSeconds, TransferRecord};
pub use report::{Event, RunOptions, RunReport, ShownSlide};
pub use scene::settled_colours;
pub use settings::{MapSettings, Settings, TimeSettings, TimeSpan, TrainingSettings};
pub use setup::{Plan, Setup};
pub(crate) use setup::{auto_is_map, auto_steps};
pub use slides::{Slide, Slides, open_snapshots};
pub use steering::{Change, Command, Range, Steering, SteeringState};
