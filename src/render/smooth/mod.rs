//! Smooth frames: the surrogate's expected picture, marched, plus a shrunk correction from coupled samples, with the error of the sum.
//!
//! In: nodes of the surrogate and a [`LogStretch`](super::LogStretch) that traces. Out: films whose error is stated. A [`Picture`] accumulates
//! while window, camera, light and transfer function stand still.

mod combine;
mod coupled;
mod light_volume;
mod march;
mod nodes;
mod picture;

pub use march::IsMissing;
pub use nodes::{BRICK, Nodes};
pub use picture::{ErrorEstimate, Picture, PictureError, Refinement};
