//! Stability where methods fail: every test sweeps a setting until a method fails, asserts the failing point and how the program reacts, and
//! prints its row of the table in `docs/accuracy.md`. The rows: `cargo test --release --test stability -- --nocapture | grep '^|'`.
#![allow(clippy::unwrap_used, clippy::print_stdout)] // Tests: a panic is the report, and rows are printed for the record.

mod data;
mod edges;
mod integration;
#[path = "../kit/mod.rs"]
mod kit;
mod network;
#[path = "../network_support/mod.rs"]
mod network_support;
mod pictures;
mod sweep;
mod trust;
