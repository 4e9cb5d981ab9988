//! Pictures: media whose radiative transfer is known, and the promises that every frame keeps.
#![allow(clippy::unwrap_used)] // Tests: a panic is the report.

mod closed_forms;
mod frames;
mod smooth;

use std::sync::atomic::AtomicBool;

static NEVER: AtomicBool = AtomicBool::new(false);
