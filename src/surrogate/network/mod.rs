//! The network: encoding, MLP in burn, loss; stock path, fused autodiff operation and `train_steps(k)`.
//!
//! burn owns the parameters ([`Network`]) and Adam's moments ([`Model`]). The fused kernels (`tile`, `dense`, `encode`, `adam`) read and write the
//! same buffers: a tile of about a hundred samples goes through encoding, layers, loss and back while it lies in the first two cache
//! levels; then each level of the hash grid collects its gradient and takes its Adam step as one task.

use serde::{Deserialize, Serialize};

mod adam;
mod architecture;
mod dense;
#[cfg(target_arch = "x86_64")]
mod dense512;
mod encode;
mod lanes;
mod model;
mod module;
mod objective;
mod operation;
mod predictor;
mod tile;
mod times;
mod train;

#[cfg(feature = "cuda")]
pub(crate) use adam::Adam;
pub use architecture::{Architecture, Layer, Level};
#[cfg(feature = "cuda")]
pub(crate) use architecture::{GRID_INPUTS, HASH};
pub use model::Model;
pub use module::Network;
pub(crate) use module::{draw, uniform};
pub use objective::{Objective, Scale, signed_exp, signed_log};
pub use operation::FusedNetwork;
pub(crate) use predictor::Predictor;
pub use times::{Row, Times, UNTIMED, row};
pub use train::{Average, Field, Fused, HELD_OUT, Pick, PlannedStep, Step, autodiff_gradient, operation_step, stock_step};

/// How a position is shown to the MLP.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Encoding {
    /// Multiresolution hash grid (Müller et al. 2022).
    HashGrid,
    /// sin and cos of 2^0 .. 2^(L-1) (Mildenhall et al. 2020).
    Frequency,
}

/// What the network is shown beside the position.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Input {
    /// The seed time, so that one network answers for many windows.
    Start,
    /// |tau| up to the scene's.
    Duration,
}

/// What the network outputs.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Target {
    /// The log-stretch.
    Ftle,
    /// The arrival position; the FTLE follows by differentiating the network.
    FlowMap,
}

/// What training minimises.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Loss {
    /// Mean square of the log-stretch.
    MeanSquare,
    /// Mean |sign(y) ln(1+|y|) - yhat|^2 with y = FTLE, plus the penalty on the difference of the batch means in linear scale (Xi, Luan and
    /// Tao, Neural Monte Carlo rendering of finite-time Lyapunov exponent fields, Visual Intelligence 1, 2023, doi
    /// 10.1007/s44267-023-00014-x; the sign is ours, since FTLE below -1 have no ln(1+y)).
    Published,
}

/// Who decides how large the surrogate is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Size {
    /// The scene.
    Fixed,
    /// The measured error, from small to at most what the scene says ([`crate::surrogate::Sizing`]).
    Auto,
}

/// `[network]` of a scene file.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct NetworkSettings {
    /// Whether `width`, `log2_table` and the nodes of a table are taken as they are, or found by the error that is measured.
    pub size: Size,
    /// Further inputs beside the position.
    pub inputs: Vec<Input>,
    /// Seed times that become 0 and 1 of the input `start`; None: the first and the last that the run asks for.
    pub start_range: Option<[f64; 2]>,
    /// Encoding of the inputs.
    pub encoding: Encoding,
    /// Hash-grid levels.
    pub levels: usize,
    /// Features a level.
    pub features: usize,
    /// Entries a level at most, as a power of two.
    pub log2_table: u32,
    /// Nodes along each axis of the coarsest level.
    pub base_resolution: usize,
    /// Resolution ratio from level to level.
    pub growth: f32,
    /// Octaves of the frequency encoding.
    pub octaves: usize,
    /// Hidden layers.
    pub hidden_layers: usize,
    /// Neurons a hidden layer.
    pub width: usize,
    /// Output.
    pub target: Target,
    /// Loss.
    pub loss: Loss,
    /// Weight of the penalty on the difference of the batch means, of [`Loss::Published`].
    pub mean_penalty: f32,
    /// Adam's rate; None: 1e-2 for hash grids, 1e-3 for frequency encodings (published: 1e-4, for a day of training).
    pub learning_rate: Option<f32>,
    /// Samples an optimizer step.
    pub batch: usize,
    /// Whether shorter axes of the domain get fewer cells, so that cells are about as wide as high.
    pub scale_levels_by_aspect: bool,
    /// Weight of the flow map's derivatives in the loss (target `flow_map`); 0 trains on arrivals alone, which has rendered better in the
    /// same time: derivatives of the network cost a pass each, and those of a hash grid jump from cell to cell.
    pub jacobian_weight: f32,
    /// Share of the steps so far over which the weights used for prediction are averaged; 0 predicts with the latest weights.
    pub averaging: f32,
}

impl Default for NetworkSettings {
    fn default() -> Self {
        Self {
            size: Size::Fixed,
            inputs: Vec::new(),
            start_range: None,
            encoding: Encoding::HashGrid,
            levels: 6,
            features: 4,
            log2_table: 21,
            base_resolution: 16,
            growth: 1.6,
            octaves: 10,
            hidden_layers: 2,
            width: 64,
            target: Target::Ftle,
            loss: Loss::MeanSquare,
            mean_penalty: 1.0,
            learning_rate: None,
            batch: 1 << 14,
            scale_levels_by_aspect: true,
            jacobian_weight: 0.0,
            averaging: 0.1,
        }
    }
}
