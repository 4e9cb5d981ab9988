//! `ridgewatch synthesize`: archives of the standard turbulence.

use super::common::{Common, Usage, dimensions, print_json, print_text, word};
use super::messages;
use anyhow::{Context, Result, bail};
use ridgewatch::source::{SyntheticSettings, SyntheticShape};
use std::path::PathBuf;

/// Options of `synthesize`.
#[derive(Debug, clap::Args)]
pub struct Options {
    /// ecmwf (packed NetCDF, longitude-latitude-level, turbulence on the grid), globe (as ecmwf, turbulence on the sphere) or flame
    /// (HDF5, x-y-z).
    #[arg(value_parser = shape)]
    shape: SyntheticShape,
    /// Folder; created if it does not exist.
    #[arg(long, short)]
    out: PathBuf,
    /// Nodes: NXxNYxNZ. Published: 360x181x37 (ecmwf), 600x192x192 (flame).
    #[arg(long, default_value = "96x48x24", value_parser = nodes)]
    nodes: [usize; 3],
    /// Number of snapshots.
    #[arg(long, default_value_t = 12)]
    snapshots: usize,
    /// The hard turbulence (wave numbers to 30, 8 cells a snapshot) instead of the easy one (14, 3).
    #[arg(long)]
    hard: bool,
}

fn nodes(text: &str) -> Result<[usize; 3], String> {
    dimensions(text).and_then(|numbers| numbers.try_into().ok()).ok_or_else(|| "accepted: NXxNYxNZ".into())
}

fn shape(text: &str) -> Result<SyntheticShape, String> {
    word(text, "ecmwf, globe, flame")
}

/// Writes.
pub fn run(common: &Common, options: &Options) -> Result<()> {
    if !common.overrides.is_empty() {
        bail!(Usage("--set: synthesize has no scene; accepted: --nodes, --snapshots, --hard, --seed".into()));
    }
    let mut settings = SyntheticSettings::new(options.shape);
    settings.nodes = options.nodes;
    settings.snapshots = options.snapshots;
    settings.seed = common.seed.unwrap_or(0);
    if options.hard {
        (settings.k_max, settings.amplitude) = (30.0, 8.0);
    }
    std::fs::create_dir_all(&options.out).with_context(|| format!("cannot make the folder {}", options.out.display()))?;
    let spinner = messages::spinner(format!("writing {} snapshots", settings.snapshots));
    let files = ridgewatch::source::synthesize(&settings, &options.out)?;
    spinner.finish_and_clear();
    if common.json {
        return print_json(&files);
    }
    messages::note(format_args!("{:?} turbulence of {:?} nodes, seed {}", settings.shape, settings.nodes, settings.seed));
    print_text(format_args!("{} files in {}", files.len(), options.out.display()));
    Ok(())
}
