//! Maps: pixels against closed forms, projections, land, ridges, and what the command refuses.
#![allow(clippy::unwrap_used, clippy::print_stdout)] // Tests: a panic is the report, and figures are printed.

mod annotate;
mod command;
mod figure;
mod frames;
mod geometry;
#[path = "../kit/mod.rs"]
mod kit;
mod pixels;
mod projections;
mod ridges;
mod slides;
mod surfaces;
