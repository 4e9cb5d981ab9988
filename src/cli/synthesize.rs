//! `ridgewatch synthesize`: archives of the standard turbulence.

use super::common::{Common, dimensions, print_json, print_text, refuse_settings, word};
use super::messages;
use anyhow::{Context, Result};
use ridgewatch::setting;
use ridgewatch::source::{SyntheticSettings, SyntheticShape};
use std::collections::HashSet;
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
    refuse_settings(common, "synthesize", "--nodes, --snapshots, --hard, --seed")?;
    let mut settings = SyntheticSettings::new(options.shape);
    settings.nodes = options.nodes;
    settings.snapshots = options.snapshots;
    settings.seed = common.seed.unwrap_or(0);
    if options.hard {
        (settings.k_max, settings.amplitude) = (30.0, 8.0);
    }
    std::fs::create_dir_all(&options.out).with_context(|| format!("cannot make the folder {}", options.out.display()))?;
    let spinner = messages::spinner(format!("writing {} snapshots", settings.snapshots));
    let names = |entries: std::fs::ReadDir| entries.flatten().map(|entry| entry.path()).collect::<HashSet<_>>();
    let before = std::fs::read_dir(&options.out).map(names).unwrap_or_default();
    let files = ridgewatch::source::synthesize(&settings, &options.out)?;
    spinner.finish_and_clear();
    if common.json {
        return print_json(&files);
    }
    let [x, y, z] = settings.nodes;
    messages::note(format_args!("{} turbulence of {x}x{y}x{z} nodes, seed {}", setting::word(settings.shape), settings.seed));
    let replaced = files.iter().filter(|file| before.contains(*file)).count();
    if replaced > 0 {
        messages::note(format_args!("{replaced} files of these names were there and are replaced"));
    }
    print_text(format_args!("{} files in {}", files.len(), options.out.display()));
    Ok(())
}
