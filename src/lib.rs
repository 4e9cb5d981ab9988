//! ridgewatch renders the Lagrangian coherent structures of a flow while its simulation runs.
//!
//! The rooms; a room calls only those to its left:
//!
//! [`field`] ← [`source`], [`flow`] ← [`surrogate`], [`trust`], [`render`] ← [`backend`] ← [`run`] ← [`publish`], [`steer`] ← [`dashboard`], [`chart`], [`map`] ← [`config`] ← the command line.
//!
//! Each room defines its settings and checks them with [`setting`]; [`config`] reads them from a scene file and finds the line of a fault.
//! All rooms may call [`files`], [`progress`], [`setting`] and [`simd`]. Every room up to [`backend`] is a crate of its own.
//!
//! A cycle takes the newest snapshots, slides the window, renders with the weights of the previous cycle, compares every traced sample with
//! the surrogate, which updates the trust map, and then trains on it.

pub mod chart;
pub mod config;
pub mod dashboard;
pub mod map;
pub mod publish;
pub mod run;
pub mod steer;

pub use ridgewatch_backend as backend;
pub use ridgewatch_base::{files, folder, progress, setting};
pub use ridgewatch_field as field;
pub use ridgewatch_flow as flow;
pub use ridgewatch_render as render;
pub use ridgewatch_simd as simd;
pub use ridgewatch_source as source;
pub use ridgewatch_surrogate as surrogate;
pub use ridgewatch_trust as trust;
