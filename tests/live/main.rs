//! Simulations that run now: the window that follows them, and the program beside them.
#![allow(clippy::unwrap_used)] // Tests: a panic is the report.

#[path = "../kit/mod.rs"]
mod kit;
mod maps;
mod program;
mod window;

use std::sync::RwLock;

/// Tests of the program hold it for writing: each starts several processes with their own threads, and on few cores keeps to its times only
/// when it runs alone.
static ALONE: RwLock<()> = RwLock::new(());
