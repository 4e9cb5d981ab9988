//! Record of a frame: a line of `records.jsonl`, and part of the header of a published frame.

use super::steering::Command;
use crate::render::smooth::PictureError;
use crate::render::{CameraSettings, MapPlane};
use crate::trust::TrustedError;
use serde::{Deserialize, Serialize};

/// Figures of one frame. All values are finite; unknown ones are `None` (`null`). Shares are in [0, 1]; residuals have no unit.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, Default)]
pub struct FrameRecord {
    /// Frame number in this run, from 0.
    pub frame: u64,
    /// Slide of the window, from 0.
    pub slide: u64,
    /// Seed time t0 of the FTLE, in time units of the source.
    pub time: f64,
    /// `time` as a date. `None` if the source has no calendar.
    pub date: Option<String>,
    /// Values of a running simulation. `None` for other sources.
    #[serde(default)]
    pub live: Option<crate::source::live::LiveRecord>,
    /// |tau|.
    pub tau: f64,
    /// Unit of `time`, `tau` and 1/FTLE: `s`, `snapshots`, or the simulation's; empty if they have none.
    #[serde(default)]
    pub time_unit: String,
    /// Description of the velocity; names synthetic data as such.
    #[serde(default)]
    pub source: String,
    /// Transfer function of the picture.
    #[serde(default)]
    pub transfer: TransferRecord,
    /// Polynomial coefficients of the albedo that a command set. `None`: those of the scene.
    #[serde(default)]
    pub albedo: Option<[Vec<f64>; 3]>,
    /// The view. `None` in records of earlier versions.
    #[serde(default)]
    pub camera: Option<CameraSettings>,
    /// Scene units of `camera` per unit of the domain's coordinates, along each axis.
    #[serde(default)]
    pub scale: [f64; 3],
    /// The plane that a map is drawn in. `None` for plain coordinates, as of volumes.
    #[serde(default)]
    pub projection: Option<MapPlane>,
    /// Box of the seeds, which the picture shows. `None` in records of earlier versions.
    #[serde(default)]
    pub domain: Option<DomainRecord>,
    /// Commands that this frame is the first to show.
    #[serde(default)]
    pub commands: Vec<Command>,
    /// `forward` or `backward`.
    pub direction: String,
    /// `map`, `reference`, `surrogate`, `gated`, `marched` or `two_level`.
    pub method: String,
    /// Device that traces: `cpu`, or `cuda:N` with its name.
    #[serde(default)]
    pub device: String,
    /// `table`, `network` or `residual`. `None` for `reference`.
    pub surrogate: Option<String>,
    /// Width and height in pixels.
    pub size: [usize; 2],
    /// Samples a pixel of this frame; for `two_level` the mean number of coupled samples, for `map` seeds, before they are rounded up to an even number.
    pub samples_per_pixel: f64,
    /// Log-stretch queries of the renderer.
    pub queries: u64,
    /// Queries answered by RK4.
    pub traced: u64,
    /// Queries without a value, at missing cells.
    pub missing: u64,
    /// Queries in untrusted cells answered by the surrogate, since the tracing budget was spent.
    pub over_budget: u64,
    /// `traced / (queries - missing)`.
    pub traced_share: f64,
    /// `trust.tolerance`: allowed optical residual.
    #[serde(default)]
    pub tolerance: f64,
    /// Estimated optical residual of the picture above the tolerance. `None` if within it. With a spent tracing budget it is measured on the
    /// untrusted points, and 0 if they are within the tolerance.
    pub tolerance_excess: Option<f64>,
    /// Error of the surrogate on audit points of the trusted region. `None` if nothing is trusted.
    pub trusted_error: Option<TrustedError>,
    /// Evidence, an e-value, against the hypothesis that the mean square optical residual of the trusted region was within the tolerance squared in
    /// every frame since the run began or the gate was last reset. At 20 or above the gate is reset. `None` if nothing is trusted, or if the gate
    /// decides nothing: it does for `gated`, and for `marched` and `two_level` with a network.
    pub gate_evidence: Option<f64>,
    /// Frames that `gate_evidence` rests on: 1 after each reset.
    #[serde(default)]
    pub gate_frames: Option<u64>,
    /// PSNR in decibels of the surrogate over the whole domain, on the audit points; peak: their largest traced log-stretch. `None` for
    /// `reference`.
    #[serde(default)]
    pub surrogate_psnr: Option<f64>,
    /// Share of the domain's volume that is trusted.
    pub trusted_volume: f64,
    /// Share of the nodes of a laid out network that lie in bricks which reach into cells that were not trusted when the picture started, and are not
    /// traced yet. `None` of other pictures.
    #[serde(default)]
    pub untraced_share: Option<f64>,
    /// `trusted_error` on new points with the same weights, measured after the frame (`--verify`).
    pub verified_error: Option<TrustedError>,
    /// Error of the picture, against that of the traced field without noise. `None` if none is stated.
    #[serde(default)]
    pub picture_error: Option<PictureError>,
    /// Runge-Kutta steps a path. `None` for Dormand-Prince.
    pub integration_steps: Option<u64>,
    /// Difference of the log-stretch from at least twice as many steps: the error of the traced field itself. `None` for Dormand-Prince.
    pub integration_difference: Option<f64>,
    /// Difference of the log-stretch in single precision from that in double precision with the same steps. `None` in double precision.
    #[serde(default)]
    pub precision_difference: Option<f64>,
    /// Difference of the log-stretch by central differences from that by the tangent. `None` for other integrators.
    #[serde(default)]
    pub tangent_difference: Option<f64>,
    /// Optical residual of the steps against twice as many as the log-stretch asks for. `None` unless the steps were chosen by it.
    #[serde(default)]
    pub integration_residual: Option<f64>,
    /// Points traced before the frame: to open the gate and tighten the majorants (first frame of a slide), and nodes of a network that is not trusted there.
    pub preparation_traces: u64,
    /// Audit points traced for the frame, except at missing cells.
    pub audited: u64,
    /// Mean lifetime of the audit particles as a share of tau.
    pub mean_lifetime_share: f64,
    /// Queries whose extinction exceeded the majorant.
    pub majorant_exceeded: u64,
    /// Training since the last frame.
    pub training: Option<crate::surrogate::Learned>,
    /// Factor on the time that training takes: 1, or less while its loss has stalled. `None` if nothing is trained, or for a time that is given.
    #[serde(default)]
    pub training_need: Option<f64>,
    /// Samples in the replay buffer (`training.replay_buffer`).
    pub replay_samples: u64,
    /// Points that a GPU traced for flights that ended before they reached them; not queries, and not among `traced`.
    #[serde(default)]
    pub speculative_traces: u64,
    /// Checkpoint in progress since the last frame. `None` without one.
    #[serde(default)]
    pub checkpoint: Option<CheckpointRecord>,
    /// Wall-clock seconds of each stage.
    pub seconds: StageSeconds,
    /// Warnings since the last frame.
    pub warnings: Vec<String>,
}

/// Box of the seeds, in the coordinates of the data.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, Default)]
pub struct DomainRecord {
    /// Lower corner; of two dimensions with the slab of the picture.
    pub min: [f64; 3],
    /// Upper corner.
    pub max: [f64; 3],
    /// Name and unit of each axis along which the flow varies; units are empty if there are none.
    pub axes: Vec<[String; 2]>,
}

/// Transfer function. By default `low` and `high` are the median and the 99.5th percentile of the FTLE on stratified points of the domain at the
/// first slide; of a map `low` is 0 or a low percentile.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, Default)]
pub struct TransferRecord {
    /// FTLE (1/time) at which extinction begins; of a map, the colours.
    pub low: f64,
    /// FTLE (1/time) from which extinction is full.
    pub high: f64,
    /// Full extinction, per unit of length of the scene.
    pub extinction: f64,
}

/// A checkpoint, in the record of every frame during which it is in progress.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, Default)]
pub struct CheckpointRecord {
    /// Last frame before the copy. `None` before the first frame.
    pub frame: Option<u64>,
    /// Pause of the loop for the copy, in seconds.
    pub copy_seconds: f64,
    /// True if frames continued during the readback.
    pub asynchronous: bool,
    /// Seconds from the start of the copy until the file was written, or until now.
    pub seconds: f64,
    /// Bytes of the file. `None` until it is written.
    pub bytes: Option<u64>,
    /// Why it was not written. The previous file remains.
    pub failed: Option<String>,
    /// Further checkpoints that became due meanwhile.
    pub postponed: u64,
}

/// Wall-clock seconds of the stages of a frame.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, Default)]
pub struct StageSeconds {
    /// Preparing the slide before its first frame: steps, tables, preparation traces.
    pub slide: f64,
    /// Waiting for snapshots.
    pub waiting: f64,
    /// Races of methods since the last frame, with `render.method = "auto"`.
    #[serde(default)]
    pub race: f64,
    /// Tracing nodes of a finer table, before the frame.
    #[serde(default)]
    pub refine: f64,
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
    /// GPU time of rendering, tracing and predicting; 0 on the CPU. The GPU time of training is
    /// [`crate::surrogate::Learned::device_seconds`].
    #[serde(default)]
    pub device: f64,
    /// Pause for a checkpoint's copy before the frame.
    #[serde(default)]
    pub checkpoint: f64,
    /// The frame without `waiting`, `slide` and `race`, with `checkpoint`.
    pub total: f64,
    /// Since the run began, including reading and preparation.
    #[serde(default)]
    pub elapsed: f64,
}

/// A finished frame on its way out.
#[derive(Debug, Clone)]
pub struct Frame {
    /// Its figures.
    pub record: std::sync::Arc<FrameRecord>,
    /// Its picture.
    pub film: std::sync::Arc<crate::render::Film>,
    /// `[contrast, brightness, gamma]` for previews.
    pub tone_map: [f64; 3],
    /// Colours of the transfer function.
    pub color_bar: Option<std::sync::Arc<super::ColorBar>>,
    /// Cells in which the surrogate was trusted; `None` without a surrogate.
    pub gate: Option<std::sync::Arc<crate::trust::Gate>>,
}
