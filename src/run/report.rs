//! What a run is asked for, and what it tells while it goes on and at its end.

use super::TransferRecord;
use super::checkpoints::CheckpointTotals;
use super::decision::Decision;
use super::race::Race;
use super::record::Frame;
use super::slides::Slide;
use super::steering::Steering;
use crate::backend::Device;
use crate::flow::{FlowMap, TimeResolution};
use crate::source::live::NextWindow;
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

/// Options of a run besides its scene.
#[derive(Debug, Clone, Default)]
pub struct RunOptions {
    /// Number of new uniform points on which each frame's stated error is checked afterwards; 0 disables the check.
    pub verify_points: usize,
    /// Wall-clock seconds after which no further frame starts.
    pub seconds: Option<f64>,
    /// Number of worker threads; 0: as many as the process may use.
    pub threads: usize,
    /// File for the trained surrogate, written at the end.
    pub checkpoint: Option<PathBuf>,
    /// Seconds between checkpoints during the run. A killed run can resume from the latest one.
    pub checkpoint_seconds: Option<f64>,
    /// File with weights to go on from if they fit; otherwise the run begins anew, with a warning. `training.resume` goes before it, and ends the
    /// run if it does not fit.
    pub resume_if_fit: Option<PathBuf>,
    /// The device that computes.
    pub device: Device,
    /// Commands to the run; `None`: nobody steers it.
    pub steering: Option<Arc<Steering>>,
    /// Setting it abandons the frame in progress. It has an effect once a stop is requested; the run then ends as if the frame had not begun.
    pub abandon: Arc<AtomicBool>,
}

/// Events of a run in progress.
pub enum Event {
    /// Before the first frame.
    Begin {
        /// Number of frames; `None` if unknown.
        frames: Option<u64>,
        /// Remarks on the settings and the source.
        notes: Vec<String>,
    },
    /// A remark after [`Event::Begin`].
    Note(String),
    /// A finished frame.
    Frame(Frame),
    /// Share of the current frame that is rendered.
    Progress(f32),
    /// After the first frame of a slide, and of another flow map: what was traced for it.
    Slide(Box<ShownSlide>),
}

/// The receiver of a run's events.
pub(super) type Sink<'a> = dyn FnMut(Event) + Send + 'a;

/// A slide of which a frame is made.
pub struct ShownSlide {
    /// The slide.
    pub slide: Slide,
    /// The flow map of its frame, with the steps that were chosen.
    pub map: FlowMap,
    /// The flow map as the scene and commands ask for it, with the rule for its steps.
    pub asked: FlowMap,
    /// True after the slide's first frame.
    pub is_new: bool,
    /// The next window of a running simulation; `None` for other sources.
    pub next: Option<NextWindow>,
}

/// Summary of a run.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct RunReport {
    /// Number of frames.
    pub frames: u64,
    /// Number of slides.
    pub slides: u64,
    /// Slides that the source has, or the scene allows; `None` if that is not known.
    pub slides_expected: Option<u64>,
    /// True if the caller stopped the run.
    pub interrupted: bool,
    /// True if a command has changed tau, direction, colours or tolerance: races are no longer those of the scene.
    pub is_steered: bool,
    /// True if the run ended since its time was up ([`RunOptions::seconds`]).
    pub time_is_up: bool,
    /// Seconds spent waiting for input.
    pub waited: f64,
    /// Seconds spent on frames and on adding available snapshots to the window.
    pub worked: f64,
    /// Optimizer steps.
    pub train_steps: u64,
    /// Runge-Kutta steps per path in the last slide; `None` if each path chooses its own steps, or if there was no tracer yet.
    pub integration_steps: Option<usize>,
    /// Difference of the log-stretch from that of at least twice as many steps; `None` if it is not finite, or if each path chooses its own
    /// steps (see [`crate::flow::StepChoice`]).
    pub integration_difference: Option<f64>,
    /// Difference of the log-stretch in single from that in double precision; `None` in double precision (see [`IntegrationDifferences`](crate::flow::IntegrationDifferences)).
    pub precision_difference: Option<f64>,
    /// Difference of the log-stretch by central differences from that by the tangent; `None` for other integrators.
    pub tangent_difference: Option<f64>,
    /// Optical residual of the steps; `None` unless they were chosen by it.
    pub integration_residual: Option<f64>,
    /// Transfer function; `None` if the run ended before it was chosen.
    pub transfer: Option<TransferRecord>,
    /// Size of the surrogate, bytes.
    pub surrogate_bytes: usize,
    /// What was chosen for settings that the scene leaves open: one entry a setting, the last choice for it.
    pub decisions: Vec<Decision>,
    /// The last race of methods; `None` if there was none.
    pub race: Option<Race>,
    /// Changes of its size with `size = "auto"`, with reasons; a few dozen at most, since no rejected size is tried twice.
    pub sizes: Vec<String>,
    /// Resolution of the snapshots in time; `None` for closed forms.
    pub time_resolution: Option<TimeResolution>,
    /// Largest size of the window, bytes.
    pub window_bytes: usize,
    /// Totals of the checkpoints; `None` if the run writes none.
    pub checkpoints: Option<CheckpointTotals>,
    /// Warnings since the last frame; earlier ones are in the records.
    pub warnings: Vec<String>,
}
