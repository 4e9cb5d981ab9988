//! What a run publishes: frames through a socket and into a folder.
#![allow(clippy::unwrap_used, clippy::print_stdout)] // Tests: a panic is the report.

mod full_disk;
#[path = "../kit/mod.rs"]
mod kit;
mod layers;
mod past_run;
mod socket;
