//! ridgewatch shows the Lagrangian coherent structures of a flow while it runs.
//!
//! The rooms, and the one way of the arrows (a room calls only those to its left):
//!
//! [`field`] ← [`source`], [`flow`] ← [`surrogate`], [`trust`], [`render`] ← [`backend`] ← [`run`] ← [`publish`] ← [`config`] ← the command line.
//!
//! Each room defines and checks its own settings, with the words of [`setting`]; [`config`] reads them from one scene file and finds the
//! line of a fault. [`files`], [`setting`] and [`simd`] lie below all rooms.
//!
//! One cycle: take the newest snapshots, slide the window, render with the weights of the previous cycle, test every traced
//! sample against the surrogate (this feeds the trust map), then train on it.

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
