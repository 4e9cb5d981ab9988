//! `ridgewatch inspect`.

use super::common::{Common, Usage, is_config, located, print_json, print_text};
use super::messages;
use anyhow::{Result, bail};
use ridgewatch::config::SceneFile;
use ridgewatch::run::TimeSpan;
use ridgewatch::setting::word;
use ridgewatch::source::{SourceError, SourceKind};
use std::path::PathBuf;

/// Options of `inspect`.
#[derive(Debug, clap::Args)]
pub struct Options {
    /// Data files, globs or URLs of Zarr stores, or a scene file (.toml) of kind archive.
    #[arg(required = true)]
    files: Vec<PathBuf>,
    /// Integration time for which the memory of the window is stated, in seconds or with a unit, e.g. "30 days"; default: the scene's
    /// `time.tau`, else the longest default, half of the span.
    #[arg(long)]
    tau: Option<String>,
}

/// Inspects. Fails after the report if the files cannot be read.
pub fn run(common: &Common, options: &Options) -> Result<()> {
    let scene = match &options.files[..] {
        [one] if is_config(one) => SceneFile::read(one, &common.overrides)?,
        files => SceneFile::for_archive(files.to_vec(), &common.overrides)?,
    };
    if scene.source.kind != SourceKind::Archive {
        return Err(Usage(format!("the scene's source is {}; inspect accepts archives", word(scene.source.kind))).into());
    }
    let tau = match &options.tau {
        None => scene.time.tau.as_ref().and_then(TimeSpan::value),
        Some(text) => {
            let span = text.parse().map_or_else(|_| TimeSpan::Words(text.clone()), TimeSpan::Number);
            let value = span.value().filter(|v| v.is_finite() && *v > 0.0);
            Some(value.ok_or_else(|| Usage(format!("--tau {text}: accepted: a number above 0, or words such as \"30 days\"")))?)
        }
    };
    let spinner = messages::spinner("opening the files".into());
    let inspection = ridgewatch::source::inspect(&scene.archive.files, &scene.archive, scene.time.every, tau)
        .map_err(|error| located(&scene, error, SourceError::refused))?;
    spinner.finish_and_clear();
    if common.json {
        print_json(&inspection)?;
    } else {
        print_text(&inspection);
    }
    match (&inspection.refused, &inspection.problem) {
        (Some(refused), _) => Err(scene.locate(refused.clone()).into()),
        // The report has the further lines.
        (None, Some(problem)) => bail!("cannot be read as an archive: {}", problem.lines().next().unwrap_or_default()),
        (None, None) => Ok(()),
    }
}
