//! `ridgewatch replay`.

use super::common::{Common, open_by, scene, seconds};
use super::session::{RunArguments, Session};
use anyhow::Result;
use ridgewatch::run::Setup;
use std::path::PathBuf;

/// Options of `replay`.
#[derive(Debug, clap::Args)]
pub struct Options {
    /// A scene file (.toml), or data files, globs and URLs of Zarr stores, which get the defaults.
    #[arg(required = true, value_name = "CONFIG | FILES")]
    paths: Vec<PathBuf>,
    /// At the end of the files, wait for further snapshots in them and in new files of the same folders and patterns (in quotes); end after so many
    /// seconds without one (without a number: 3600).
    #[arg(long, value_name = "SECONDS", num_args = 0..=1, require_equals = true, default_missing_value = "3600", value_parser = seconds)]
    follow: Option<f64>,
    #[command(flatten)]
    run: RunArguments,
}

/// Replays.
pub fn run(common: &Common, options: Options) -> Result<()> {
    let mut scene = scene(common, &options.paths)?;
    options.run.apply(&mut scene)?;
    if let Some(seconds) = options.follow {
        scene.archive.follow = Some(seconds);
        scene.set_by("archive.follow", format!("--follow={seconds}"));
    }
    let text = scene.to_toml()?;
    Session { common, options: &options.run, scene, text, follows: None, paths: &options.paths }
        .run(|scene, _| open_by(scene, Setup::for_run).map(Some))
}
