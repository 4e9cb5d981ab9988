//! The network: encoding of positions, MLP, loss and training on the CPU.
//!
//! In: samples. Out: trained parameters and predictions. Calls `flow` for the log-stretch of a Jacobian, and burn.
//!
//! burn owns the parameters ([`Network`]) and Adam's moments ([`Model`]); the fused kernels (`tile`, `dense`, `encode`, `adam`) read and
//! write the same buffers. A tile of about fifty samples passes through encoding, layers, loss and back within the first two cache levels;
//! then each level of the hash grid sums its gradient and takes its Adam step as one task. `module` and `autodiff` hold the same network in
//! burn's stock operations, as the reference.

mod adam;
mod architecture;
mod autodiff;
mod batch;
mod dense;
mod encode;
mod memory;
mod model;
mod module;
mod objective;
mod operation;
mod output;
mod predictor;
mod random;
mod settings;
mod tile;
mod times;
mod train;

pub use adam::Adam;
pub use architecture::{Architecture, Layer, Level};
pub use architecture::{GRID_INPUTS, HASH};
pub use autodiff::{autodiff_gradient, operation_step, stock_step};
pub use model::Model;
pub use module::Network;
pub use objective::{Field, Objective, Scale, signed_exp, signed_log};
pub use operation::{FusedNetwork, NetworkInputs};
pub use predictor::Predictor;
pub use random::{draw, uniform};
pub use settings::{Encoding, Input, Loss, NetworkSettings, SMALLEST_BATCH, Size, Target};
pub use times::{Row, Times, UNTIMED, row};
pub use train::{Average, Fused, HELD_OUT, PlannedStep, Step};
