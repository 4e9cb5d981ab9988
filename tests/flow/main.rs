//! FTLE of flows whose stretch is known, in boxes and on the sphere.
#![allow(clippy::unwrap_used, clippy::print_stdout)] // Tests: a panic is the report, and figures are printed for the record.

mod composition;
#[path = "../kit/mod.rs"]
mod kit;
mod numerics;
mod sphere;
mod work;
