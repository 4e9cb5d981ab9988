//! Maps: pixels against closed forms, projections, land, ridges, and what the command refuses.
#![allow(clippy::unwrap_used)] // Tests: a panic is the report.

mod command;
#[path = "../kit/mod.rs"]
mod kit;
mod pixels;
mod projections;
mod ridges;
