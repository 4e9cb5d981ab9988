//! A memory of the log-stretch: a traced table, a network, or a network on a table.
//!
//! In: traced samples. Out: predictions with a known cost and size. Calls `flow` and `field`.

use crate::backend::DeviceError;
use crate::field::Domain;
use crate::setting::Refused;
use network::NetworkSettings;
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
mod trainer;

pub use checkpoint_state::CheckpointState;
pub use device::{DeviceTable, Download, HostNetwork, Labels, NetworkCopy, SurrogateDevice, SyncedSamples, Trace, Training};
pub use host::{FrozenNetwork, Host, HostSurrogate, HostTraining, build};
pub use hybrid::{FrozenHybrid, Hybrid, NetworkFrom};
pub use replay_buffer::{BufferMark, KEEP_STALE, ReplayBuffer};
pub use sizing::{Resize, Sizing};
pub use table::Table;

/// A number that was not given before.
pub(crate) fn fresh_stamp() -> u64 {
    static NEXT: AtomicU64 = AtomicU64::new(0);
    NEXT.fetch_add(1, Ordering::Relaxed)
}

/// Traced samples to learn from. Positions are unit coordinates ([`crate::field::Domain::to_unit`]).
#[derive(Debug, Clone, Default)]
pub struct Samples {
    /// Unit coordinates in [0, 1]^3.
    pub points: Vec<[f32; 3]>,
    /// Log-stretch of each.
    pub log_stretch: Vec<f32>,
    /// Arrival positions in unit coordinates (may lie outside [0, 1]); empty unless the target is the flow map.
    pub arrival: Vec<[f32; 3]>,
    /// d arrival / d point in unit coordinates, row-major; empty unless the target is the flow map.
    pub jacobian: Vec<[f32; 9]>,
    /// Start time and duration of each in unit intervals ([`network::Times`]); empty where that of all is the same.
    pub times: Vec<[f32; 2]>,
}

impl Samples {
    /// Number of samples.
    pub fn len(&self) -> usize {
        self.points.len()
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.points.is_empty()
    }

    /// What a network may be shown of sample `index`.
    pub(crate) fn row(&self, index: usize) -> network::Row {
        network::row(self.points[index], self.times_of(index))
    }

    /// Unit times of sample `index`.
    pub(crate) fn times_of(&self, index: usize) -> [f32; 2] {
        self.times.get(index).copied().unwrap_or(network::UNTIMED)
    }
}

/// What one call of [`Hybrid::learn`] did.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Learned {
    /// Optimizer steps taken, without those that the same call lost by roll-backs; a frame may have several calls, of which a later one may lose an earlier
    /// one's steps: these count here and in `lost_steps`.
    pub steps: u64,
    /// Optimizer steps taken and lost by roll-backs, or with a device: those of earlier calls too that had not come back from it.
    #[serde(default)]
    pub lost_steps: u64,
    /// Samples used, with repetition.
    pub samples: u64,
    /// Mean training loss over the steps taken, lost ones included, but for those at which it diverged (none where no step is left).
    pub loss: Option<f64>,
    /// Samples of the ring that were left out, since they are not finite; of several calls that of the one with the most, since each finds
    /// them anew. Labels that were traced on a device and stay there are left out there, and not counted.
    pub dropped: u64,
    /// Times the weights were rolled back because the loss diverged.
    pub rollbacks: u64,
    /// Wall-clock seconds.
    pub seconds: f64,
    /// Of them, seconds of a device that took the steps; none where the CPU took them.
    #[serde(default)]
    pub device_seconds: Option<f64>,
    /// What should be told of a device that works but lacks memory, in words, once each.
    #[serde(skip)]
    pub warnings: Vec<String>,
}

impl Learned {
    /// Both together: steps, samples and seconds add up, losses are averaged with the samples of their calls as weights.
    pub fn and(self, other: Learned) -> Learned {
        // Not over steps: those that a call lost may be an earlier one's.
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

/// Answers log-stretch queries and does not change.
pub trait Predict: Send + Sync {
    /// `table`, `network` or `residual`.
    fn name(&self) -> &'static str;

    /// Writes the predicted log-stretch at each unit point into `out` (same length). Parallelises over rayon's current pool.
    ///
    /// # Errors
    /// The device that predicts fails or lacks memory; `out` is then unspecified.
    fn predict(&self, points: &[[f32; 3]], out: &mut [f32]) -> Result<(), DeviceError>;

    /// Memory that prediction reads, bytes.
    fn bytes(&self) -> usize;
}

/// Why a surrogate cannot be built.
#[derive(Debug, Clone, thiserror::Error)]
pub enum SurrogateError {
    /// A setting out of range.
    #[error("setting {key} = {found} is not accepted; accepted: {accepted}")]
    Setting {
        /// Its key in the scene file.
        key: String,
        /// What was found.
        found: String,
        /// What is accepted.
        accepted: String,
    },
}

impl From<SurrogateError> for Refused {
    fn from(error: SurrogateError) -> Self {
        let SurrogateError::Setting { key, found, accepted } = error;
        Self::new(key, format_args!("is {found}"), accepted)
    }
}

/// Why a checkpoint was not written or read.
#[derive(Debug, thiserror::Error)]
pub enum CheckpointError {
    /// File trouble.
    #[error("checkpoint {path}: {source}")]
    Io {
        /// The file.
        path: std::path::PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// Not a checkpoint, or one of another network.
    #[error("checkpoint {path} does not fit: {found}; expected {expected}")]
    Mismatch {
        /// The file.
        path: std::path::PathBuf,
        /// What it holds.
        found: String,
        /// What is accepted.
        expected: String,
    },
    /// Nothing was written.
    #[error("checkpoint {path}: {source} before {what} had come back; nothing is written")]
    Lost {
        /// The file.
        path: std::path::PathBuf,
        /// Of the surrogate, in words.
        what: &'static str,
        /// What trained.
        source: DeviceError,
    },
    /// The disk did not take it in time; what was there before stays.
    #[error("checkpoint {path}: not written within {seconds} seconds")]
    Hangs {
        /// The file.
        path: std::path::PathBuf,
        /// How long it was waited for.
        seconds: u64,
    },
    /// What writes it has ended without a result.
    #[error("checkpoint {path}: {why}")]
    Writer {
        /// The file.
        path: std::path::PathBuf,
        /// In words.
        why: String,
    },
}

/// Which surrogate.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Kind {
    /// The log-stretch traced at grid nodes, interpolated.
    Table,
    /// The network alone.
    Network,
    /// A coarse traced table plus a learned residual, zero at first.
    Residual,
}

impl Kind {
    /// As written in settings.
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
}

impl Default for SurrogateSettings {
    fn default() -> Self {
        Self { kind: Kind::Residual, table_nodes: None }
    }
}

/// Nodes along the longest edge of a table for which none are set, where no data say how many: alone, and below a network.
const DEFAULT_NODES: [usize; 2] = [256, 128];
/// Most nodes of a table that was given the data's own: every slide traces them anew, which two cores do in some ten seconds.
const MOST_OWN_NODES: usize = 1 << 21;
/// Most nodes of a table: 4 GiB of f32.
const MOST_NODES: usize = 1 << 30;

impl SurrogateSettings {
    /// Checks what does not depend on the domain.
    pub fn check(&self, network: &NetworkSettings) -> Result<(), SurrogateError> {
        if self.table_nodes.is_some() {
            // No flow varies along fewer than two axes; the third is looked at when the domain is known.
            self.check_nodes(2)?;
        }
        if !network.inputs.is_empty() && self.kind != Kind::Network {
            return Err(SurrogateError::Setting {
                key: "network.inputs".into(),
                found: crate::setting::shown(&network.inputs),
                accepted: "none, or surrogate.kind = \"network\": a table knows one window and one duration".into(),
            });
        }
        if self.kind == Kind::Residual { hybrid::check_residual(network) } else { Ok(()) }
    }

    /// Checks the nodes along as many axes as the flow varies along.
    pub fn check_nodes(&self, dimensions: usize) -> Result<(), SurrogateError> {
        let Some(nodes) = self.table_nodes else { return Ok(()) };
        let refuse = |accepted: &str| {
            Err(SurrogateError::Setting { key: "surrogate.table_nodes".into(), found: format!("{nodes:?}"), accepted: accepted.into() })
        };
        let active = &nodes[..dimensions.clamp(1, 3)];
        if active.iter().any(|&n| n < 2) {
            return refuse("at least 2 along every axis that the flow varies along");
        }
        if active.iter().try_fold(1_usize, |product, &n| product.checked_mul(n)).is_none_or(|n| n > MOST_NODES) {
            return refuse("at most 2^30 in all");
        }
        Ok(())
    }

    /// The same with the nodes of gridded velocity (`shape`, along x, y, z) for a table whose nodes are not set; all axes are divided
    /// alike where that would be more than 2^21 nodes, or more than `most`.
    pub fn at_resolution_of(&self, shape: [usize; 3], most: usize) -> Self {
        let all: f64 = shape.iter().map(|&n| n as f64).product();
        let axes = shape.iter().filter(|&&n| n > 1).count().max(1);
        let share = (most.min(MOST_OWN_NODES) as f64 / all).min(1.0).powf(1.0 / axes as f64);
        let own = shape.map(|n| ((n as f64 * share) as usize).max(2));
        Self { table_nodes: self.table_nodes.or(Some(own)), ..self.clone() }
    }

    /// Nodes of the table: those set, else 256 along the longest edge (128 below a network) and in proportion along the others. In two dimensions there is
    /// one node along z.
    pub(crate) fn nodes(&self, domain: &Domain) -> Result<[usize; 3], SurrogateError> {
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
        let [x, y, z] = open.at_resolution_of([3000, 1500, 100], usize::MAX).table_nodes.unwrap();
        assert!(x * y * z <= MOST_OWN_NODES && x * y * z > MOST_OWN_NODES * 9 / 10, "{x} x {y} x {z}");
        assert!(x.abs_diff(2 * y) <= 2, "{x} x {y}: all axes are divided alike");
        assert_eq!(open.at_resolution_of([128, 128, 128], 64 * 64 * 64).table_nodes, Some([64, 64, 64]));
    }

    #[test]
    fn a_table_over_a_globe_has_nodes_along_its_longitudes() {
        let globe = Domain { scale: [1.0, 1.0, 90.0 / 28_000.0], ..Domain::cuboid([0.0, -90.0, 1e3], [360.0, 90.0, 29e3]) };
        let table = SurrogateSettings { kind: Kind::Table, table_nodes: None };
        assert_eq!(table.nodes(&globe).unwrap(), [256, 128, 64], "metres are no degrees");
    }
}
