//! Steering: the command socket against clients with and without its key, and what commands do to a run.
#![allow(clippy::unwrap_used)] // Tests: a panic is the report.

#[path = "../kit/mod.rs"]
mod kit;
mod live;
mod runs;
mod socket;
