//! ridgewatch renders the Lagrangian coherent structures of a flow while its simulation runs.
//!
//! The rooms; a room calls only those to its left:
//!
//! [`field`] ← [`source`], [`flow`] ← [`surrogate`], [`trust`], [`render`] ← [`backend`] ← [`run`] ← [`publish`] ← [`config`] ← the command line.
//!
//! Each room defines its settings and checks them with [`setting`]; [`config`] reads them from a scene file and finds the line of a fault.
//! All rooms may call [`files`], [`setting`] and [`simd`].
//!
//! A cycle takes the newest snapshots, slides the window, renders with the weights of the previous cycle, compares every traced sample with
//! the surrogate, which updates the trust map, and then trains on it.

pub mod backend;
pub mod config;
pub mod field;
pub mod files;
pub mod flow;
pub mod publish;
pub mod render;
pub mod run;
pub mod setting;
pub mod simd;
pub mod source;
pub mod surrogate;
pub mod trust;
