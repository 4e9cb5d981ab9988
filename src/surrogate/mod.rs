//! What remembers the log-stretch: a traced table, a network, or a network on a table.
//!
//! In: traced samples. Out: predictions with a known cost and size. Calls `flow` for its types only.

use serde::{Deserialize, Serialize};

pub mod network;

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
}

/// What one call of [`Surrogate::learn`] did.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Learned {
    /// Optimizer steps taken.
    pub steps: u64,
    /// Samples used, with repetition.
    pub samples: u64,
    /// Mean training loss over these steps (none when no step was taken).
    pub loss: Option<f64>,
    /// Non-finite samples dropped.
    pub dropped: u64,
    /// Times the weights were rolled back because the loss diverged.
    pub rollbacks: u64,
    /// Wall-clock seconds.
    pub seconds: f64,
}

/// A memory of the log-stretch over the domain. Predicts from many threads; learns between frames.
pub trait Surrogate: Send + Sync {
    /// `table`, `network` or `residual`.
    fn name(&self) -> &'static str;
    /// Writes the predicted log-stretch at each unit point into `out` (same length). Parallelises over rayon's current pool.
    fn predict(&self, points: &[[f32; 3]], out: &mut [f32]);
    /// Whether `learn` does anything.
    fn learns(&self) -> bool;
    /// Trains on `samples` for at most `seconds` of wall clock and at most `max_steps` optimizer steps.
    fn learn(&mut self, samples: &Samples, seconds: f64, max_steps: u64) -> Learned;
    /// Memory of what prediction reads, in bytes.
    fn bytes(&self) -> usize;
    /// Writes everything needed to go on (weights, optimizer state, base table) into the file.
    fn save(&self, path: &std::path::Path) -> Result<(), CheckpointError>;
    /// Restores what [`Surrogate::save`] wrote; a checkpoint of another shape is an error and changes nothing.
    fn load(&mut self, path: &std::path::Path) -> Result<(), CheckpointError>;
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

/// `[surrogate]` of a scene file.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SurrogateSettings {
    /// Which kind.
    pub kind: Kind,
    /// Nodes of the table along x, y, z (z ignored in two dimensions). None: the data's own nodes, or 256 along the longest edge.
    pub table_nodes: Option<[usize; 3]>,
}

impl Default for SurrogateSettings {
    fn default() -> Self {
        Self { kind: Kind::Network, table_nodes: None }
    }
}
