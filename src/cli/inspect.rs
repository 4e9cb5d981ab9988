//! `ridgewatch inspect`.

use super::{Common, print_json, print_text};
use anyhow::Result;
use std::path::PathBuf;

/// Options of `inspect`.
#[derive(Debug, clap::Args)]
pub struct Options {
    /// Data files or globs.
    #[arg(required = true)]
    files: Vec<PathBuf>,
}

/// Inspects.
pub fn run(common: &Common, options: &Options) -> Result<()> {
    let inspection = ridgewatch::source::inspect(&options.files)?;
    if common.json { print_json(&inspection) } else { Ok(print_text(inspection)) }
}
