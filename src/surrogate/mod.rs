//! Surrogates of the log-stretch: a traced table, a network, or a table with a network for its residual.
//!
//! In: traced samples. Out: predictions with a known cost and size. Calls `flow` and `field`.

use network::NetworkSettings;
use ridgewatch_base::DeviceError;
use ridgewatch_base::setting::Refused;
use ridgewatch_field::{Domain, UnitPoint};
use serde::{Deserialize, Serialize};
use std::sync::atomic::{AtomicU64, Ordering};

mod checkpoint;
mod checkpoint_state;
mod device;
mod host;
mod hybrid;
pub mod network;
mod replay_buffer;
mod sizing;
mod table;
mod trace;
mod trainer;

pub use checkpoint_state::CheckpointState;
pub use device::{
    Download, FrozenHybrid, HostNetwork, Labels, NetworkCopy, NetworkFrom, SurrogateDevice, SurrogateTable, SyncedSamples, Training,
};
pub use host::{FrozenNetwork, Host, HostSurrogate, HostTraining, build};
pub use hybrid::Hybrid;
pub use replay_buffer::{BufferMark, KEEP_STALE, ReplayBuffer};
pub use sizing::{Resize, Sizing};
pub use table::Table;
pub use trace::Trace;

/// Returns a number that is unique in this process.
pub fn fresh_stamp() -> u64 {
    static NEXT: AtomicU64 = AtomicU64::new(0);
    NEXT.fetch_add(1, Ordering::Relaxed)
}

/// Traced samples to learn from.
#[derive(Debug, Clone, Default)]
pub struct Samples {
    /// Where they were traced, in [0, 1]^3.
    pub points: Vec<UnitPoint>,
    /// Log-stretch of each.
    pub log_stretch: Vec<f32>,
    /// Arrival positions (may lie outside [0, 1]); empty unless the target is the flow map.
    pub arrival: Vec<UnitPoint>,
    /// d arrival / d point in unit coordinates, row-major; empty unless the target is the flow map.
    pub jacobian: Vec<[f32; 9]>,
    /// Start time and duration of each in unit intervals ([`network::Times`]); empty if all samples have the same.
    pub times: Vec<[f32; 2]>,
}

impl Samples {
    /// Number of samples.
    pub fn len(&self) -> usize {
        self.points.len()
    }

    /// True if there are no samples.
    pub fn is_empty(&self) -> bool {
        self.points.is_empty()
    }

    /// Network input of sample `index`.
    pub fn row(&self, index: usize) -> network::Row {
        network::row(self.points[index], self.times_of(index))
    }

    /// Unit times of sample `index`.
    pub fn times_of(&self, index: usize) -> [f32; 2] {
        self.times.get(index).copied().unwrap_or(network::UNTIMED)
    }
}

/// Result of one or several calls of [`Hybrid::learn`].
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Learned {
    /// Optimizer steps, without those that the same call lost by roll-backs. If a later call of the frame loses steps of an earlier one, they
    /// count both here and in `lost_steps`.
    pub steps: u64,
    /// Optimizer steps lost by roll-backs or with a device, including steps of earlier calls that were not downloaded yet.
    #[serde(default)]
    pub lost_steps: u64,
    /// Samples used, with repetition.
    pub samples: u64,
    /// Mean training loss over all steps, lost ones included, except those at which training diverged. `None` without such steps.
    pub loss: Option<f64>,
    /// Samples of the replay buffer that were skipped because they are not finite. The maximum over several calls, since each call counts them again.
    /// Labels that stay on a device are skipped there and not counted.
    pub dropped: u64,
    /// Number of roll-backs of the weights because the loss diverged.
    pub rollbacks: u64,
    /// Wall-clock seconds.
    pub seconds: f64,
    /// Device time of the steps, in seconds; `None` if the CPU took them.
    #[serde(default)]
    pub device_seconds: Option<f64>,
    /// Warnings of a device that works but is short of memory, each given once.
    #[serde(skip)]
    pub warnings: Vec<String>,
}

impl Learned {
    /// Combines two results: steps, samples and seconds are added, losses are averaged with the numbers of samples as weights.
    pub fn and(self, other: Learned) -> Learned {
        // Weighted by samples and not by steps, since a call may lose steps of an earlier one.
        let [mine, theirs] = [&self, &other].map(|l| l.loss.map_or((0.0, 0), |loss| (loss, l.samples)));
        let weight = (mine.1 + theirs.1) as f64;
        let loss = mine.0 * mine.1 as f64 + theirs.0 * theirs.1 as f64;
        Learned {
            steps: self.steps + other.steps,
            lost_steps: self.lost_steps + other.lost_steps,
            samples: self.samples + other.samples,
            loss: (weight > 0.0).then(|| loss / weight),
            dropped: self.dropped.max(other.dropped),
            rollbacks: self.rollbacks + other.rollbacks,
            seconds: self.seconds + other.seconds,
            device_seconds: self.device_seconds.map(|mine| mine + other.device_seconds.unwrap_or(0.0)).or(other.device_seconds),
            warnings: [self.warnings, other.warnings].concat(),
        }
    }
}

/// Immutable predictor of the log-stretch.
pub trait Predict: Send + Sync {
    /// `table`, `network` or `residual`.
    fn name(&self) -> &'static str;

    /// Writes the predicted log-stretch at each unit point into `out` (same length). Parallelises over rayon's current pool.
    ///
    /// # Errors
    /// The device that predicts fails or is out of memory; `out` is then unspecified.
    fn predict(&self, points: &[UnitPoint], out: &mut [f32]) -> Result<(), DeviceError>;

    /// Predicts at unit points and returns the seconds that the processor takes. Copies to and from a device do not count.
    ///
    /// # Errors
    /// As [`Predict::predict`].
    fn seconds(&self, points: &[UnitPoint], out: &mut [f32]) -> Result<f64, DeviceError> {
        let began = std::time::Instant::now();
        self.predict(points, out)?;
        Ok(began.elapsed().as_secs_f64())
    }

    /// Memory that prediction reads, bytes.
    fn bytes(&self) -> usize;
}

/// Error of building a surrogate.
#[derive(Debug, Clone, thiserror::Error)]
pub enum SurrogateError {
    /// A setting is out of range.
    #[error("setting {key} = {found} is not accepted; accepted: {accepted}")]
    Setting {
        /// Its key in the scene file.
        key: String,
        /// The value found.
        found: String,
        /// Accepted values.
        accepted: String,
    },
}

impl From<SurrogateError> for Refused {
    fn from(error: SurrogateError) -> Self {
        let SurrogateError::Setting { key, found, accepted } = error;
        Self::new(key, format_args!("is {found}"), accepted)
    }
}

/// Error of writing or reading a checkpoint.
#[derive(Debug, thiserror::Error)]
pub enum CheckpointError {
    /// The file system fails.
    #[error("checkpoint {path}: {source}")]
    Io {
        /// The file.
        path: std::path::PathBuf,
        /// Error of the system.
        source: std::io::Error,
    },
    /// The file is not a checkpoint, or one of another surrogate.
    #[error("checkpoint {path} does not fit: {found}; expected {expected}")]
    Mismatch {
        /// The file.
        path: std::path::PathBuf,
        /// Contents of the file.
        found: String,
        /// What is accepted.
        expected: String,
    },
    /// The device was lost before the download was complete; nothing was written.
    #[error("checkpoint {path}: {source} before the download of {what} was complete; nothing is written")]
    Lost {
        /// The file.
        path: std::path::PathBuf,
        /// Missing part of the surrogate.
        what: &'static str,
        /// Error of the device.
        source: DeviceError,
    },
    /// The disk did not respond in time. The previous file remains.
    #[error("checkpoint {path}: not written within {seconds} seconds")]
    Hangs {
        /// The file.
        path: std::path::PathBuf,
        /// Time limit, in seconds.
        seconds: u64,
    },
    /// The thread that writes the file ended without a result.
    #[error("checkpoint {path}: {why}")]
    Writer {
        /// The file.
        path: std::path::PathBuf,
        /// The reason.
        why: String,
    },
}

/// Kind of surrogate.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Kind {
    /// A table of the log-stretch, traced at grid nodes and interpolated.
    Table,
    /// A network.
    Network,
    /// A coarse traced table plus a network for the residual, which starts at zero.
    Residual,
}

impl Kind {
    /// Name in settings.
    pub fn name(self) -> &'static str {
        match self {
            Self::Table => "table",
            Self::Network => "network",
            Self::Residual => "residual",
        }
    }
}

/// `[surrogate]` of a scene file.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SurrogateSettings {
    /// Which kind.
    pub kind: Kind,
    /// Nodes of the table along x, y, z (z ignored in two dimensions). None: the data's own nodes, at most 2^21 in all; for closed forms
    /// 256 along the longest edge, or 128 below a network.
    pub table_nodes: Option<[usize; 3]>,
    /// While a smooth picture stands still, a table whose nodes are not set gets twice as many along each axis.
    pub refine: bool,
}

impl Default for SurrogateSettings {
    fn default() -> Self {
        Self { kind: Kind::Table, table_nodes: None, refine: true }
    }
}

/// Default nodes along the longest edge of a table for closed forms: of a table alone, and of a table below a network.
const DEFAULT_NODES: [usize; 2] = [256, 128];
/// Maximum nodes of a table with the nodes of the data. Every slide traces them again, which takes two cores about ten seconds.
pub const MAX_OWN_NODES: usize = 1 << 21;
/// The same if a GPU traces them: 128 MiB.
pub const MAX_DEVICE_NODES: usize = 1 << 25;
/// Maximum nodes of a table: 4 GiB of f32.
const MAX_NODES: usize = 1 << 30;

impl SurrogateSettings {
    /// Checks the settings that do not depend on the domain.
    ///
    /// # Errors
    /// The first setting that is not accepted.
    pub fn check(&self, network: &NetworkSettings) -> Result<(), SurrogateError> {
        if self.table_nodes.is_some() {
            // Every flow varies along at least two axes. The third is checked when the domain is known.
            self.check_nodes(2)?;
        }
        if !network.inputs.is_empty() && self.kind != Kind::Network {
            return Err(SurrogateError::Setting {
                key: "network.inputs".into(),
                found: ridgewatch_base::setting::shown(&network.inputs),
                accepted: "none, or surrogate.kind = \"network\": a table knows one window and one duration".into(),
            });
        }
        if self.kind == Kind::Residual { hybrid::check_residual(network) } else { Ok(()) }
    }

    /// Checks the table nodes along the first `dimensions` axes.
    ///
    /// # Errors
    /// Fewer than 2 nodes along such an axis, or more than 2^30 nodes.
    pub fn check_nodes(&self, dimensions: usize) -> Result<(), SurrogateError> {
        let Some(nodes) = self.table_nodes else { return Ok(()) };
        let refuse = |accepted: &str| {
            Err(SurrogateError::Setting { key: "surrogate.table_nodes".into(), found: format!("{nodes:?}"), accepted: accepted.into() })
        };
        let active = &nodes[..dimensions.clamp(1, 3)];
        if active.iter().any(|&n| n < 2) {
            return refuse("at least 2 along every axis that the flow varies along");
        }
        if active.iter().try_fold(1_usize, |product, &n| product.checked_mul(n)).is_none_or(|n| n > MAX_NODES) {
            return refuse("at most 2^30 in all");
        }
        Ok(())
    }

    /// Returns the settings with the nodes of the gridded velocity (`shape`, along x, y, z) for a table whose nodes are not set. All axes are
    /// reduced by the same factor if that gives more than `most` nodes.
    pub fn at_resolution_of(&self, shape: [usize; 3], most: usize) -> Self {
        let all: f64 = shape.iter().map(|&n| n as f64).product();
        let axes = shape.iter().filter(|&&n| n > 1).count().max(1);
        let share = (most as f64 / all).min(1.0).powf(1.0 / axes as f64);
        let own = shape.map(|n| ((n as f64 * share) as usize).max(2));
        Self { table_nodes: self.table_nodes.or(Some(own)), ..self.clone() }
    }

    /// Returns the settings with nodes for a smooth picture of a two-dimensional flow, unless they are set: two per pixel along the longest edge. A
    /// table of such a flow takes no more traces than four samples a pixel, and removes more error than they do: the FTLE folds into filaments far finer
    /// than the nodes of data.
    pub fn for_picture(&self, is_smooth: bool, pixels: [usize; 2], domain: &Domain) -> Self {
        const MAX_ALONG_EDGE: usize = 4096;
        if !is_smooth || domain.dimensions > 2 || self.kind != Kind::Table || self.table_nodes.is_some() {
            return self.clone();
        }
        let lengths = domain.lengths();
        let longest = lengths[0].max(lengths[1]);
        let wanted = (2 * pixels[0].max(pixels[1])).min(MAX_ALONG_EDGE) as f64;
        let fine: [usize; 3] = std::array::from_fn(|k| ((lengths[k] / longest * wanted).ceil() as usize + 1).max(2));
        Self { table_nodes: Some(fine), ..self.clone() }
    }

    /// Nodes of the table: those set, or 256 along the longest edge (128 below a network) and in proportion along the others; one along z in two
    /// dimensions.
    pub fn nodes(&self, domain: &Domain) -> Result<[usize; 3], SurrogateError> {
        let dimensions = domain.dimensions.clamp(1, 3);
        self.check_nodes(dimensions)?;
        let longest = DEFAULT_NODES[usize::from(self.kind == Kind::Residual)];
        let lengths = domain.lengths();
        let most = lengths[..dimensions].iter().copied().fold(f64::MIN_POSITIVE, f64::max);
        let in_proportion = |axis: usize| ((lengths[axis] / most * longest as f64).round() as usize).clamp(2, longest);
        let nodes = self.table_nodes.unwrap_or_else(|| std::array::from_fn(in_proportion));
        Ok(std::array::from_fn(|axis| if axis < dimensions.max(2) { nodes[axis].max(2) } else { 1 }))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_table_has_the_datas_own_nodes_up_to_a_bound() {
        let open = SurrogateSettings::default();
        assert_eq!(open.at_resolution_of([81, 41, 1], usize::MAX).table_nodes, Some([81, 41, 2]));
        let set = SurrogateSettings { table_nodes: Some([5, 6, 7]), ..open.clone() };
        assert_eq!(set.at_resolution_of([81, 41, 1], usize::MAX), set);
        let [x, y, z] = open.at_resolution_of([3000, 1500, 100], MAX_OWN_NODES).table_nodes.unwrap();
        assert!(x * y * z <= MAX_OWN_NODES && x * y * z > MAX_OWN_NODES * 9 / 10, "{x} x {y} x {z}");
        assert!(x.abs_diff(2 * y) <= 2, "{x} x {y}: all axes are divided alike");
        assert_eq!(open.at_resolution_of([128, 128, 128], 64 * 64 * 64).table_nodes, Some([64, 64, 64]));
    }

    #[test]
    fn a_table_over_a_globe_has_nodes_along_its_longitudes() {
        let globe = Domain { scale: [1.0, 1.0, 90.0 / 28_000.0], ..Domain::cuboid([0.0, -90.0, 1e3], [360.0, 90.0, 29e3]) };
        let table = SurrogateSettings::default();
        assert_eq!(table.nodes(&globe).unwrap(), [256, 128, 64], "metres are no degrees");
    }
}
