//! `ridgewatch replay`.

use super::common::{Common, device, open, scene, settle_method};
use super::session::{RunArguments, Session};
use anyhow::Result;
use std::path::PathBuf;

/// Options of `replay`.
#[derive(Debug, clap::Args)]
pub struct Options {
    /// A scene file (.toml), or data files, globs and URLs of Zarr stores, which get the defaults.
    #[arg(required = true, value_name = "CONFIG | FILES")]
    paths: Vec<PathBuf>,
    #[command(flatten)]
    run: RunArguments,
}

/// Replays.
pub fn run(common: &Common, options: Options) -> Result<()> {
    let mut scene = scene(common, &options.paths)?;
    options.run.apply(&mut scene)?;
    let device = device(common, &scene)?;
    let method = settle_method(common, &mut scene, &options.paths, &device)?;
    let text = scene.to_toml()?;
    Session { common, options: &options.run, scene, text, follows: None }.run(|scene, _| {
        let mut setup = open(scene)?;
        setup.decisions.extend(method);
        Ok(Some(setup))
    })
}
