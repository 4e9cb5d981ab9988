//! Smooth frames: the surrogate's expected picture, marched, plus a shrunk correction from coupled samples, with the error of the sum.
//!
//! In: nodes of the surrogate and a [`LogStretch`](super::LogStretch) that traces. Out: films whose error is stated. A [`Picture`] accumulates
//! while window, camera, light and transfer function stand still.

mod allocation;
mod combine;
mod coupled;
#[cfg(test)]
mod coverage_tests;
mod light_volume;
mod march;
mod march_control;
mod medium;
mod nodes;
mod picture;
mod regression;
mod statement;
mod tone;

pub use allocation::bayer_rank;
pub use combine::{Combined, Correction, PairSums, combine, smoothed};
pub use coupled::{CoupledPath, coupled_paths};
pub use light_volume::{LightGrid, LightVolume, MARGIN};
pub use march::{RaySum, ToLight};
pub(crate) use march_control::weighted;
pub use medium::{IsMissing, Medium, node_spacing};
pub use nodes::{BRICK, Nodes, brick_shape, own_nodes};
pub use picture::{Picture, Refinement};
pub use regression::Guides;
pub use statement::{ErrorEstimate, MarchError, PictureError, StepsError, TileErrors, TileSums, noise_psnr};
pub use {
    allocation::{Allocation, TILE},
    march_control::{AUDIT_STEPS, AuditedPixel, FIRST_AUDIT_RAY, LIGHT_STEPS, LIT_BY_MARCH, MarchControl, Marching, NET, PAIR},
    picture::AUDIT_PAIRS,
    statement::{LIT, TileError, error_at, errors_of_tiles},
    tone::{ToneMap, squared_slope},
};
