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
    pub over_tolerance: Option<f64>,
    /// Error measured on audit points of the trusted region; none when nothing is trusted.
    pub trusted: Option<TrustedError>,
    /// PSNR in decibels of the surrogate alone over the whole domain, trusted or not, on the audit points; peak: their largest traced
    /// log-stretch. None for `reference`.
    #[serde(default)]
    pub surrogate_psnr: Option<f64>,
    /// Share of the domain's volume that is trusted.
    pub trusted_share: f64,
    /// The same error measured on fresh points with the same weights after the frame (`--verify`).
    pub verified: Option<TrustedError>,
    /// Runge-Kutta steps a path; none where each path chooses its own (Dormand-Prince).
    pub integration_steps: Option<u64>,
    /// Difference of the log-stretch from twice as many steps, where the steps were chosen by it: the error of "the truth" itself.
    pub integration_difference: Option<f64>,
    /// Points traced before this frame to open the gate and to tighten the majorants (first frame of a slide).
    pub probed: u64,
    /// Audit points traced for this frame, land left out.
    pub audited: u64,
    /// Mean lived share of the audit points (1 when every particle lived the whole tau).
    pub lived_share: f64,
    /// Queries whose extinction exceeded the majorant in force.
    pub majorant_exceeded: u64,
    /// Training since the last frame.
    pub training: Option<crate::surrogate::Learned>,
    /// Samples in the ring of samples (`training.ring`).
    pub sample_ring: u64,
    /// Points that a GPU traced ahead of flights that ended before them: work, but no queries, and not among `traced`.
    #[serde(default)]
    pub traced_ahead: u64,
    /// Wall-clock seconds of each stage.
    pub seconds: StageSeconds,
    /// Warnings that arose since the last frame, in words.
    pub warnings: Vec<String>,
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
    /// The frame, without `waiting` and `slide`.
    pub total: f64,
    /// Since the run began, reading and preparing included.
    #[serde(default)]
    pub elapsed: f64,
}
