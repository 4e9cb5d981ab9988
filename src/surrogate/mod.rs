//! What remembers the log-stretch: a traced table, a network, or a network on a table.
//!
//! In: traced samples. Out: predictions with a known cost and size. Calls `flow` for its types only.

use crate::field::Domain;
use crate::flow::Tracer;
use network::NetworkSettings;
use serde::{Deserialize, Serialize};
use std::sync::Arc;
use trainer::Trainer;

mod checkpoint;
pub mod network;
mod residual;
mod ring;
mod table;
mod trainer;

pub use residual::Residual;
pub use ring::{KEEP_STALE, SampleRing};
pub use table::Table;

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

/// Something that answers log-stretch queries and does not change: a surrogate, or what one was when it was frozen.
pub trait Predict: Send + Sync {
    /// `table`, `network` or `residual`.
    fn name(&self) -> &'static str;
    /// Writes the predicted log-stretch at each unit point into `out` (same length). Parallelises over rayon's current pool.
    fn predict(&self, points: &[[f32; 3]], out: &mut [f32]);
    /// Memory of what prediction reads, in bytes.
    fn bytes(&self) -> usize;
}

/// A memory of the log-stretch over the domain, which learns between or beside frames.
pub trait Surrogate: Predict {
    /// What it would answer now, for good: frames are rendered with it while training goes on.
    fn freeze(&self) -> Arc<dyn Predict>;
    /// Whether `learn` does anything.
    fn learns(&self) -> bool;
    /// Trains on `samples` for at most `seconds` of wall clock and at most `max_steps` optimizer steps.
    fn learn(&mut self, samples: &Samples, seconds: f64, max_steps: u64) -> Learned;
    /// The window slid: `tracer` traces the new one. Tables are traced anew, weights carry over.
    fn window_slid(&mut self, tracer: &dyn Tracer);
    /// Writes everything needed to go on (weights, optimizer state, base table) into the file.
    fn save(&self, path: &std::path::Path) -> Result<(), CheckpointError>;
    /// Restores what [`Surrogate::save`] wrote; a checkpoint of another shape is an error and changes nothing.
    fn load(&mut self, path: &std::path::Path) -> Result<(), CheckpointError>;
}

/// Why a surrogate cannot be built.
#[derive(Debug, thiserror::Error)]
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
        Self { kind: Kind::Residual, table_nodes: None }
    }
}

/// Nodes along the longest edge of a table for which none are set.
const DEFAULT_NODES: usize = 256;
/// Most nodes of a table: 4 GiB of f32.
const MOST_NODES: usize = 1 << 30;

/// Builds the surrogate that the settings ask for; tables are traced at once. `seed` draws the network's first weights and its batches.
pub fn build(
    settings: &SurrogateSettings,
    network: &NetworkSettings,
    domain: &Domain,
    seed: u64,
    tracer: &dyn Tracer,
) -> Result<Box<dyn Surrogate>, SurrogateError> {
    Ok(match settings.kind {
        Kind::Table => Box::new(Table::trace(tracer, nodes(settings, domain, DEFAULT_NODES)?)),
        Kind::Network => Box::new(Network { trainer: Trainer::new(network, domain, tracer.tau(), seed, false)? }),
        // Half as fine as the table alone would be: the network is there for the rest.
        Kind::Residual => Box::new(Residual::new(network, nodes(settings, domain, DEFAULT_NODES / 2)?, seed, tracer)?),
    })
}

/// Nodes that were set, or `longest` along the longest active edge and in proportion along the others.
fn nodes(settings: &SurrogateSettings, domain: &Domain, longest: usize) -> Result<[usize; 3], SurrogateError> {
    let refuse = |nodes: [usize; 3], accepted: &str| {
        Err(SurrogateError::Setting { key: "surrogate.table_nodes".into(), found: format!("{nodes:?}"), accepted: accepted.into() })
    };
    if let Some(nodes) = settings.table_nodes {
        let active = &nodes[..domain.dimensions.clamp(1, 3)];
        if active.iter().any(|&n| n < 2) {
            return refuse(nodes, "at least 2 along every axis that the flow varies along");
        }
        if active.iter().try_fold(1_usize, |product, &n| product.checked_mul(n)).is_none_or(|n| n > MOST_NODES) {
            return refuse(nodes, "at most 2^30 in all");
        }
        return Ok(nodes);
    }
    let extent = domain.extent();
    let most = extent[..domain.dimensions.clamp(1, 3)].iter().copied().fold(f64::MIN_POSITIVE, f64::max);
    Ok(std::array::from_fn(|axis| ((extent[axis] / most * longest as f64).round() as usize).clamp(2, longest)))
}

/// The network alone.
struct Network {
    trainer: Trainer,
}

impl Predict for Network {
    fn name(&self) -> &'static str {
        "network"
    }

    fn predict(&self, points: &[[f32; 3]], out: &mut [f32]) {
        self.trainer.predict(points, out);
    }

    fn bytes(&self) -> usize {
        self.trainer.bytes()
    }
}

impl Surrogate for Network {
    fn freeze(&self) -> Arc<dyn Predict> {
        Arc::new(self.trainer.frozen())
    }

    fn learns(&self) -> bool {
        true
    }

    fn learn(&mut self, samples: &Samples, seconds: f64, max_steps: u64) -> Learned {
        self.trainer.learn(samples, None, seconds, max_steps)
    }

    fn window_slid(&mut self, _: &dyn Tracer) {
        self.trainer.window_slid();
    }

    fn save(&self, path: &std::path::Path) -> Result<(), CheckpointError> {
        let mut checkpoint = checkpoint::Checkpoint::new("network");
        self.trainer.entries(&mut checkpoint);
        checkpoint.write(path)
    }

    fn load(&mut self, path: &std::path::Path) -> Result<(), CheckpointError> {
        let checkpoint = checkpoint::Checkpoint::read(path, "network")?;
        self.trainer.restored(&checkpoint)
    }
}
