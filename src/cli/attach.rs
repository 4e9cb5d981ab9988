//! `ridgewatch attach`.

use super::nice::Nice;
use super::replay::{RunArguments, conduct};
use super::{Common, Usage, located, messages};
use anyhow::{Result, bail};
use ridgewatch::config::SceneFile;
use ridgewatch::engine::{EngineError, Setup};
use ridgewatch::publish::RunFolder;
use ridgewatch::source::live::Live;
use ridgewatch::source::{SourceError, SourceKind};
use ridgewatch::surrogate::network::Size;
use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;

/// Seconds between two checkpoints of a run that may be killed.
const CHECKPOINT_SECONDS: f64 = 30.0;

/// Options of `attach`.
#[derive(Debug, clap::Args)]
pub struct Options {
    /// A scene file (.toml), and where the simulation is: the ring's folder on this node, or connection files of relays. Without them: what
    /// the scene file says, or the environment variable RIDGEWATCH_RING.
    #[arg(value_name = "CONFIG | RING | CONNECTION")]
    paths: Vec<PathBuf>,
    /// Length of the integration, in the simulation's time; overrides the scene's.
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
    // What was trained before a restart is gone on from.
    let fixed = scene.network.size == Size::Fixed;
    if options.run.checkpoint.is_some() && !fixed {
        messages::note("network.size is \"auto\": weights of an earlier run are not gone on from, since a checkpoint has one size");
    }
    options.run.apply(&mut scene)?;
    // Whoever runs it again has weights of his own to go on from.
    let scene_text = scene.to_toml()?;
    if fixed && scene.training.resume.is_none() {
        scene.training.resume = options.run.checkpoint.clone().filter(|path| path.exists());
        if let Some(path) = &scene.training.resume {
            messages::note(format_args!("going on from the weights in {}", path.display()));
        }
    }
    if !options.run.overwrite {
        let out = RunFolder::vacant(&options.run.out)?;
        if out != options.run.out {
            messages::note(format_args!("{} holds an earlier run: this one goes to {}", options.run.out.display(), out.display()));
            options.run.out = out;
        }
    }
    options.nice.step_back();
    super::open_files::allow_many();
    let open = |scene: &SceneFile, stop: &AtomicBool| {
        let refused = |error| located(scene, error, SourceError::refused);
        let Some(live) = Live::connect(&scene.live, stop, &mut messages::note).map_err(refused)? else { return Ok(None) };
        messages::note(format_args!("found {}", live.describe()));
        Setup::live(scene.settings(), live).map(Some).map_err(|error| located(scene, error, EngineError::refused))
    };
    conduct(common, &options.run, scene, &scene_text, Some(CHECKPOINT_SECONDS), open)
}

/// The scene that the paths mean.
fn scene(common: &Common, options: &Options) -> Result<SceneFile> {
    let is_config = |p: &&PathBuf| p.extension().is_some_and(|e| e == "toml");
    let (configs, places): (Vec<&PathBuf>, Vec<&PathBuf>) = options.paths.iter().partition(is_config);
    let mut overrides = common.overrides.clone();
    if let Some(tau) = &options.tau {
        // A number as such, words in quotes.
        let value = if tau.parse::<f64>().is_ok() { tau.clone() } else { format!("{tau:?}") };
        overrides.push(format!("time.tau={value}"));
    }
    if let [one] = configs.as_slice()
        && SceneFile::read(one, &overrides)?.source.kind != SourceKind::Live
    {
        // Before anything is said of a simulation that the scene does not follow.
        bail!(Usage("the scene's source.kind is not \"live\"; archives and closed forms are for `ridgewatch replay`".into()));
    }
    if options.exit_at_end {
        overrides.push("live.at_end=\"stop\"".into());
    }
    match places.as_slice() {
        [] => {}
        [ring] if is_ring(ring) => {
            let whole = std::path::absolute(ring)?;
            // A name that is mistyped would be waited for in silence.
            if !whole.exists() && whole.extension().is_some() {
                messages::note(format_args!("{} is not there: taken for a ring's folder, not for a connection file", whole.display()));
            }
            overrides.push(format!("live.ring={:?}", whole.display().to_string()));
        }
        files => {
            if let Some(ring) = files.iter().find(|path| is_ring(path)) {
                bail!(Usage(format!("{} is a ring beside other paths: give one ring, or connection files", ring.display())));
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
    if let Some(seed) = common.seed {
        scene.seed = seed;
    }
    Ok(scene)
}

/// A ring is a folder, which may not be there yet; a connection file is a file.
fn is_ring(path: &Path) -> bool {
    !path.is_file()
}
