//! Whole runs: the program as a user types it, with what it prints, writes and refuses, and runs in the test's own process.
#![allow(clippy::unwrap_used)] // Tests: a panic is the report.

mod archives;
mod checkpoints;
mod command_line;
mod default_tau;
mod export;
#[path = "../kit/mod.rs"]
mod kit;
mod maps;
mod messages;
mod movie;
mod need;
#[path = "../network_support/mod.rs"]
mod network_support;
mod notes;
mod race;
mod refine;
mod scene_file;
mod snapshots;
mod stated_error;
mod steps;
mod window_memory;

use kit::program::{Outcome, run};
use std::path::Path;
use std::process::Command;

/// The program in a folder, on the CPU.
fn in_folder(folder: &Path, arguments: &[&str]) -> Command {
    let mut command = kit::program::ridgewatch(arguments);
    command.args(["--device", "cpu"]).current_dir(folder);
    command
}

/// `--set` of the width, height and samples of the pictures.
fn picture(size: [usize; 3]) -> Vec<String> {
    let keys = ["render.width", "render.height", "render.samples"];
    keys.iter().zip(size).flat_map(|(key, value)| ["--set".to_owned(), format!("{key}={value}")]).collect()
}

/// Runs the program to its end.
fn ridgewatch<S: AsRef<std::ffi::OsStr>>(arguments: impl IntoIterator<Item = S>) -> Outcome {
    run(&mut kit::program::ridgewatch(arguments))
}
