//! What is recorded of every frame. One line of `records.jsonl`, and the JSON header of a published frame.

use crate::trust::TrustedError;
use serde::{Deserialize, Serialize};

/// One frame's figures, all of them finite: what is not known is none (`null`), never a number that is none. Shares are in [0, 1]; residuals of `optical` kind have no unit, those of `log_stretch` kind neither.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, Default)]
pub struct FrameRecord {
    /// Frame number in this run, from 0.
    pub frame: u64,
    /// Window slide that the frame belongs to, from 0.
    pub slide: u64,
    /// Seed time t0 of the FTLE, in time units of the source.
    pub time: f64,
    /// The same as a date, where the source has a calendar.
    pub date: Option<String>,
    /// Of a simulation that runs now; none otherwise.
    #[serde(default)]
    pub live: Option<crate::source::live::LiveRecord>,
    /// |tau|.
    pub tau: f64,
    /// Unit of `time` and `tau`, and with a minus of the FTLE: `s`, `snapshots`, a simulation's own; empty where they have none.
    #[serde(default)]
    pub time_unit: String,
    /// What the velocities are, in words: what is made up says so.
    #[serde(default)]
    pub source: String,
    /// What the picture's colours and densities stand for.
    #[serde(default)]
    pub transfer: TransferRecord,
    /// `forward` or `backward`.
    pub direction: String,
    /// `reference`, `surrogate` or `gated`.
    pub method: String,
    /// What traced: `cpu`, or `cuda:N` with the device's name.
    #[serde(default)]
    pub device: String,
    /// `table`, `network` or `residual`; none for `reference`.
    pub surrogate: Option<String>,
    /// Pixels across and down.
    pub size: [usize; 2],
    /// Samples a pixel.
    pub samples_per_pixel: usize,
    /// Log-stretch queries that the renderer made.
    pub queries: u64,
    /// Of them, answered by RK4.
    pub traced: u64,
    /// Of them, without a value (land).
    pub missing: u64,
    /// Of them, answered by the surrogate in untrusted cells because the tracing budget was spent.
    pub over_budget: u64,
    /// `traced / (queries - missing)`.
    pub traced_share: f64,
    /// By how much the estimated optical residual of the picture exceeds the tolerance; none when within. Where the tracing budget
    /// was spent: measured on the untrusted points, and 0 when they are within.
    pub tolerance_excess: Option<f64>,
    /// Error measured on audit points of the trusted region; none when nothing is trusted.
    pub trusted_error: Option<TrustedError>,
    /// PSNR in decibels of the surrogate alone over the whole domain, trusted or not, on the audit points; peak: their largest traced
    /// log-stretch. None for `reference`.
    #[serde(default)]
    pub surrogate_psnr: Option<f64>,
    /// Share of the domain's volume that is trusted.
    pub trusted_volume: f64,
    /// The same error measured on fresh points with the same weights after the frame (`--verify`).
    pub verified_error: Option<TrustedError>,
    /// Runge-Kutta steps a path; none where each path chooses its own (Dormand-Prince).
    pub integration_steps: Option<u64>,
    /// Difference of the log-stretch from twice as many steps, where the steps were chosen by it: the error of "the truth" itself.
    pub integration_difference: Option<f64>,
    /// Points traced before this frame to open the gate and to tighten the majorants (first frame of a slide).
    pub preparation_traces: u64,
    /// Audit points traced for this frame, land left out.
    pub audited: u64,
    /// Mean lived share of the audit points (1 when every particle lived the whole tau).
    pub mean_lifetime_share: f64,
    /// Queries whose extinction exceeded the majorant in force.
    pub majorant_exceeded: u64,
    /// Training since the last frame.
    pub training: Option<crate::surrogate::Learned>,
    /// Samples in the ring of samples (`training.replay_buffer`).
    pub replay_samples: u64,
    /// Points that a GPU traced ahead of flights that ended before them: work, but no queries, and not among `traced`.
    #[serde(default)]
    pub speculative_traces: u64,
    /// The checkpoint that was under way since the last frame; none when there was none.
    #[serde(default)]
    pub checkpoint: Option<CheckpointRecord>,
    /// Wall-clock seconds of each stage.
    pub seconds: StageSeconds,
    /// Warnings that arose since the last frame, in words.
    pub warnings: Vec<String>,
}

/// The transfer function in force. Where the scene leaves them open, `low` and `high` are the median and the 99.5th percentile of the FTLE on
/// stratified points of the whole domain at the first slide.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, Default)]
pub struct TransferRecord {
    /// FTLE (1/time) at which extinction begins.
    pub low: f64,
    /// FTLE (1/time) from which extinction is full.
    pub high: f64,
    /// Full extinction, per unit of length of the scene.
    pub extinction: f64,
}

/// One checkpoint. It stands in the record of every frame during which it was under way, the last time with its end.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, Default)]
pub struct CheckpointRecord {
    /// The frame after which it was copied, with what was learned until then; none before the first.
    pub frame: Option<u64>,
    /// Seconds that the loop stood still for the copy.
    pub copy_seconds: f64,
    /// Whether the numbers were brought together behind the loop's back; otherwise it waited for all of them.
    pub asynchronous: bool,
    /// Seconds since the copy began: until it was written, or so far.
    pub seconds: f64,
    /// Bytes of the file; none where it is not written yet, or was not.
    pub bytes: Option<u64>,
    /// Why it was not written; what was there before stays.
    pub failed: Option<String>,
    /// Others that fell due meanwhile, and were left for the next time.
    pub postponed: u64,
}

/// Where a frame's time went.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, Default)]
pub struct StageSeconds {
    /// Preparing the slide before its first frame: steps, tables, probes.
    pub slide: f64,
    /// Waiting for snapshots.
    pub waiting: f64,
    /// Rendering without its traces.
    pub render: f64,
    /// Tracing inside rendering.
    pub trace: f64,
    /// Prediction inside rendering.
    pub predict: f64,
    /// Audit points and trust.
    pub audit: f64,
    /// Training.
    pub train: f64,
    /// Of rendering, tracing and predicting, by a GPU's own clock; 0 where the CPU rendered. Its time for training is
    /// [`crate::surrogate::Learned::device_seconds`].
    #[serde(default)]
    pub device: f64,
    /// The loop standing still for a checkpoint's copy before the frame.
    #[serde(default)]
    pub checkpoint: f64,
    /// The frame, without `waiting` and `slide`, with `checkpoint`.
    pub total: f64,
    /// Since the run began, reading and preparing included.
    #[serde(default)]
    pub elapsed: f64,
}
