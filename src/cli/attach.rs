//! `ridgewatch attach`.

use super::common::{Common, Usage, is_config, located};
use super::process::Nice;
use super::session::{Follows, RunArguments, Session};
use super::{messages, notify};
use anyhow::{Result, bail};
use ridgewatch::config::SceneFile;
use ridgewatch::publish::RunFolder;
use ridgewatch::run::{RunError, Setup};
use ridgewatch::source::live::Live;
use ridgewatch::source::{SourceError, SourceKind};
use ridgewatch::surrogate::network::Size;
use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;

/// Seconds between two checkpoints, since the run may be killed.
const CHECKPOINT_SECONDS: f64 = 30.0;

/// Seconds from a signal to the end, unless an option gives others: less than the 20 to 30 after which a batch system kills.
const STOP_WITHIN: f64 = 15.0;

/// Options of `attach`.
#[derive(Debug, clap::Args)]
pub struct Options {
    /// A scene file (.toml), and the simulation: its ring folder on this node, or connection files of relays. By default the scene file names
    /// the simulation, or the environment variable RIDGEWATCH_RING does.
    #[arg(value_name = "CONFIG | RING | CONNECTION")]
    paths: Vec<PathBuf>,
    /// Integration time, in the simulation's time unit; overrides the scene's.
    #[arg(long, value_name = "TIME")]
    tau: Option<String>,
    /// Exit when the simulation ends, instead of waiting for its restart.
    #[arg(long)]
    exit_at_end: bool,
    #[command(flatten)]
    nice: Nice,
    #[command(flatten)]
    run: RunArguments,
}

/// Attaches.
pub fn run(common: &Common, mut options: Options) -> Result<()> {
    let mut scene = scene(common, &options)?;
    let fixed = scene.network.size == Size::Fixed;
    if options.run.checkpoint.is_some() && !fixed {
        messages::note("network.size is \"auto\": weights of an earlier run are not used, since a checkpoint has one size");
    }
    options.run.apply(&mut scene)?;
    options.run.stop_within.get_or_insert(STOP_WITHIN);
    let text = scene.to_toml()?;
    let mut resume_if_fit = None;
    if fixed && scene.training.resume.is_none() {
        resume_if_fit = options.run.checkpoint.clone().filter(|path| path.exists());
        if let Some(path) = &resume_if_fit {
            messages::note(format_args!("going on from the weights in {}, if they fit", path.display()));
        }
    }
    let wanted = options.run.out.clone();
    if !options.run.overwrite {
        let out = RunFolder::vacant(&options.run.out)?;
        if out != options.run.out {
            messages::note(format_args!("{} holds an earlier run: this run is written to {}", options.run.out.display(), out.display()));
            options.run.out = out;
        }
    }
    options.nice.apply();
    let open = |scene: &SceneFile, stop: &AtomicBool| {
        let refused = |error| located(scene, error, SourceError::refused);
        let mut tell = |text: String| {
            notify::running(|| text.clone());
            messages::note(text);
        };
        let Some(live) = Live::connect(&scene.live, stop, &mut tell).map_err(refused)? else { return Ok(None) };
        messages::note(format_args!("found {}", live.describe()));
        Setup::live(scene.settings(), live).map(Some).map_err(|error| located(scene, error, RunError::refused))
    };
    let follows = Some(Follows { checkpoint_seconds: CHECKPOINT_SECONDS, resume_if_fit, wanted });
    let configs: Vec<PathBuf> = options.paths.iter().filter(|path| is_config(path)).cloned().collect();
    Session { common, options: &options.run, scene, text, follows, paths: &configs }.run(open)
}

/// Reads the scene, with the places of the simulation from the command line.
fn scene(common: &Common, options: &Options) -> Result<SceneFile> {
    let (configs, places): (Vec<&PathBuf>, Vec<&PathBuf>) = options.paths.iter().partition(|path| is_config(path));
    let mut overrides = common.overrides.clone();
    if let Some(tau) = &options.tau {
        // TOML: a plain number, or words in quotation marks.
        let value = if tau.parse::<f64>().is_ok() { tau.clone() } else { format!("{tau:?}") };
        overrides.push(format!("time.tau={value}"));
    }
    if let [one] = configs.as_slice()
        && SceneFile::read(one, &overrides)?.source.kind != SourceKind::Live
    {
        bail!(Usage("the scene's source.kind is not \"live\"; archives and closed forms are for `ridgewatch replay`".into()));
    }
    if options.exit_at_end {
        overrides.push("live.at_end=\"stop\"".into());
    }
    match places.as_slice() {
        [] => {}
        [ring] if is_ring(ring) => {
            let whole = std::path::absolute(ring)?;
            // Otherwise a mistyped name would be waited for silently.
            if !whole.exists() && whole.extension().is_some() {
                messages::note(format_args!("{} does not exist: taken for a ring folder, not for a connection file", whole.display()));
            }
            overrides.push(format!("live.ring={:?}", whole.display().to_string()));
        }
        files => {
            if let Some(ring) = files.iter().find(|path| is_ring(path)) {
                bail!(Usage(format!("{} is a ring, given with other paths: give one ring, or connection files", ring.display())));
            }
            let list: Vec<String> = files.iter().map(|path| format!("{:?}", path.display().to_string())).collect();
            overrides.push(format!("live.connections=[{}]", list.join(", ")));
        }
    }
    let mut scene = match configs.as_slice() {
        [] => SceneFile::for_live(&overrides)?,
        [one] => SceneFile::read(one, &overrides)?,
        [_, second, ..] => bail!(Usage(format!("{} is a second scene file: give one", second.display()))),
    };
    scene.seed = common.seed.unwrap_or(scene.seed);
    Ok(scene)
}

/// Whether the path names a ring, a folder that may not exist yet, and not a connection file.
fn is_ring(path: &Path) -> bool {
    !path.is_file()
}
