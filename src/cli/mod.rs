//! What can be asked on the command line, one file a command.

mod attach;
mod compare;
mod doctor;
mod ftle;
mod inspect;
pub mod messages;
mod nice;
mod open_files;
mod publish;
mod relay;
mod render;
mod replay;
mod synthesize;

use anyhow::{Context, Result, bail};
use clap::error::{ContextKind, ContextValue, ErrorKind};
use clap::{Args, CommandFactory, Parser, Subcommand};
use ridgewatch::config::{ConfigError, SceneFile, renamed};
use ridgewatch::engine::{Device, DeviceChoice, EngineError, Setup};
use ridgewatch::publish::PublishError;
use ridgewatch::render::Method;
use ridgewatch::setting::Refused;
use ridgewatch::source::SourceError;
use ridgewatch::surrogate::Kind;
use std::path::{Path, PathBuf};

/// Shows the Lagrangian coherent structures of a flow simulation while it runs.
#[derive(Debug, Parser)]
#[command(name = "ridgewatch", version, max_term_width = 110, propagate_version = true)]
pub struct Arguments {
    #[command(subcommand)]
    command: Command,
    #[command(flatten)]
    pub common: Common,
}

/// Options that every command has.
#[derive(Debug, Args)]
pub struct Common {
    /// Where to trace: auto (a GPU where one is usable), cpu, or cuda:N.
    #[arg(long, global = true, default_value_t = DeviceChoice::Auto, value_name = "DEVICE")]
    pub device: DeviceChoice,
    /// Worker threads, at most 1024; 0: as many as this process may use.
    #[arg(long, global = true, default_value_t = 0, value_name = "N", value_parser = threads)]
    pub threads: usize,
    /// Overrides one key of the scene, e.g. `--set render.samples=64`; may be repeated.
    #[arg(long = "set", global = true, value_name = "TABLE.KEY=VALUE")]
    pub overrides: Vec<String>,
    /// Seed of every random number; overrides the scene's, which holds no larger ones.
    #[arg(long, global = true, value_name = "N", value_parser = clap::value_parser!(u64).range(..=i64::MAX as u64))]
    pub seed: Option<u64>,
    /// Prints a machine-readable result on standard output; everything else goes to standard error.
    #[arg(long, global = true)]
    pub json: bool,
    /// Says more on standard error; twice for details.
    #[arg(short, long, global = true, action = clap::ArgAction::Count)]
    pub verbose: u8,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// Runs the whole loop over an archive or a closed-form flow: frames, records and a summary into a folder.
    Replay(replay::Options),
    /// Runs the loop beside a simulation: waits for it, follows it, survives its end and restart.
    Attach(attach::Options),
    /// Plays an archive into a ring, as if it were a simulation.
    Publish(publish::Options),
    /// Ships the rings of this node to ridgewatch on another one.
    Relay(relay::Options),
    /// Renders one picture.
    Render(render::Options),
    /// Computes the FTLE field on a grid, as NetCDF; `--check` holds it against the truth.
    Ftle(ftle::Options),
    /// Compares two EXR pictures: PSNR, SSIM, relative error.
    Compare(compare::Options),
    /// Says what would be read from files, and why.
    Inspect(inspect::Options),
    /// Writes an archive of the standard turbulence in the shape of ECMWF's or of a flame simulation.
    Synthesize(synthesize::Options),
    /// Says which devices and libraries are found.
    Doctor,
}

impl Arguments {
    /// Parses the process's command line.
    ///
    /// # Errors
    /// clap's, which also stands for `--help` and `--version`. An option that was renamed is refused with its new name.
    pub fn read() -> Result<Self, clap::Error> {
        Self::try_parse().map_err(|error| {
            let Some(ContextValue::String(option)) = error.get(ContextKind::InvalidArg) else { return error };
            match renamed(option).filter(|_| error.kind() == ErrorKind::UnknownArgument) {
                Some(new) => Self::command().error(ErrorKind::UnknownArgument, format!("`{option}` has a new name; accepted: `{new}`")),
                None => error,
            }
        })
    }
}

/// Runs a command.
pub fn run(arguments: Arguments) -> Result<()> {
    let common = arguments.common;
    // The pool of everything that has none of its own: conversions, copies and what runs beside a cycle. 0 means one a core.
    rayon::ThreadPoolBuilder::new().num_threads(common.threads).build_global()?;
    match arguments.command {
        Command::Replay(options) => replay::run(&common, options),
        Command::Attach(options) => attach::run(&common, options),
        Command::Publish(options) => publish::run(&common, &options),
        Command::Relay(options) => relay::run(&common, &options),
        Command::Render(options) => render::run(&common, options),
        Command::Ftle(options) => ftle::run(&common, &options),
        Command::Compare(options) => compare::run(&common, &options),
        Command::Inspect(options) => inspect::run(&common, &options),
        Command::Synthesize(options) => synthesize::run(&common, &options),
        Command::Doctor => doctor::run(&common),
    }
}

/// A request that cannot be met as put: exit status 2.
#[derive(Debug, thiserror::Error)]
#[error("{0}")]
pub struct Usage(pub String);

/// The device that was asked for, opened; why `auto` came to the CPU is told with `--verbose`.
fn device(common: &Common, scene: &SceneFile) -> Result<Device> {
    let device = Device::open(common.device, &scene.device)?;
    if let Device::Cpu { why: Some(why) } = &device {
        tracing::info!("on the CPU: {why}");
    }
    Ok(device)
}

/// 2 for usage and config errors, 128 and the signal's number where one ended the work, 1 for everything else.
pub fn exit_status(error: &anyhow::Error) -> u8 {
    if let Some(interrupted) = error.downcast_ref::<Interrupted>() {
        return interrupted.status;
    }
    let configuration = error.chain().any(|cause| {
        cause.is::<ConfigError>()
            || cause.is::<Usage>()
            || cause.downcast_ref::<EngineError>().is_some_and(|error| error.refused().is_some())
            || cause.downcast_ref::<PublishError>().is_some_and(|error| error.refused().is_some())
            || cause.downcast_ref::<SourceError>().is_some_and(|error| error.refused().is_some())
    });
    if configuration { 2 } else { 1 }
}

/// The scene that paths on the command line mean: one TOML file, or data files by name.
fn scene(common: &Common, paths: &[PathBuf]) -> Result<SceneFile> {
    let is_config = |p: &Path| p.extension().is_some_and(|e| e == "toml");
    let mut scene = match paths {
        [] => bail!(Usage("a scene file (.toml) or data files are needed".into())),
        [one] if is_config(one) => SceneFile::read(one, &common.overrides)?,
        many => {
            if let Some(config) = many.iter().find(|p| is_config(p)) {
                bail!(Usage(format!("{} is a scene file: give one scene file, or data files, not both", config.display())));
            }
            SceneFile::for_archive(many.to_vec(), &common.overrides)?
        }
    };
    if let Some(seed) = common.seed {
        scene.seed = seed;
    }
    Ok(scene)
}

/// The scene's error with the place of the setting at fault, where it is one.
fn located<E>(scene: &SceneFile, error: E, refused: impl FnOnce(&E) -> Option<Refused>) -> anyhow::Error
where
    E: std::error::Error + Send + Sync + 'static,
{
    match refused(&error) {
        Some(refused) => scene.locate(refused).into(),
        None => error.into(),
    }
}

/// The scene's source, opened; a synthetic archive is written first where there is none, which may take minutes.
fn open(scene: &SceneFile) -> Result<Setup> {
    let _spinner = opening(scene);
    Setup::new(scene.settings()).map_err(|error| located(scene, error, EngineError::refused))
}

/// Turns while a source is opened.
fn opening(scene: &SceneFile) -> indicatif::ProgressBar {
    let writes = scene.archive.synthetic.is_some() && scene.archive.files.is_empty();
    messages::spinner(
        if writes { "opening a synthetic archive, which is written first where it is not there" } else { "opening the source" }.into(),
    )
}

/// What is said of steps that were chosen by their error.
fn steps_told(steps: u64, difference: f64) -> String {
    format!("{steps} steps a path: the log-stretch differs by {difference:.3} rms from that of twice as many")
}

/// A command that a signal ended before its work was done; the exit status is that of a process which the signal ended.
#[derive(Debug, thiserror::Error)]
#[error("stopped by a signal; {done}")]
pub struct Interrupted {
    status: u8,
    done: &'static str,
}

/// What a checkpoint option asks for must exist.
fn check_learns(scene: &SceneFile, option: &str, path: Option<&Path>) -> Result<()> {
    let Some(path) = path else { return Ok(()) };
    let refuse = |why: &str| bail!(Usage(format!("{option} {}: {why}", path.display())));
    if scene.render.method == Method::Reference {
        return refuse("method reference has no surrogate; accepted with methods surrogate and gated");
    }
    if scene.surrogate.kind == Kind::Table {
        return refuse("a table is traced anew for every window and learns nothing; accepted with surrogate.kind network and residual");
    }
    Ok(())
}

/// Fails before the work rather than after it.
fn check_folder(out: &Path) -> Result<()> {
    // What is not a regular file would be replaced by one.
    if std::fs::metadata(out).is_ok_and(|there| !there.is_file()) {
        bail!(Usage(format!("{} is there and is no regular file", out.display())));
    }
    let folder = out.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."));
    std::fs::create_dir_all(folder).with_context(|| format!("cannot make the folder {}", folder.display()))?;
    tempfile::NamedTempFile::new_in(folder).with_context(|| format!("cannot write into {}", folder.display()))?;
    Ok(())
}

/// A method by its name in scene files.
fn method(word: &str) -> Result<Method, String> {
    use serde::Deserialize;
    use serde::de::{IntoDeserializer, value::Error};
    Method::deserialize(IntoDeserializer::<Error>::into_deserializer(word))
        .map_err(|_| "accepted: reference, surrogate, neural, gated".to_owned())
}

/// A number of threads that a machine may have: each takes memory and a place in the system's table.
fn threads(word: &str) -> Result<usize, String> {
    word.parse().ok().filter(|n| *n <= 1024).ok_or_else(|| "accepted: a whole number from 0 to 1024".to_owned())
}

/// A number of seconds above 0.
fn seconds(word: &str) -> Result<f64, String> {
    word.parse().ok().filter(|s: &f64| s.is_finite() && *s > 0.0).ok_or_else(|| "accepted: a number above 0".to_owned())
}

/// Prints the machine-readable result.
fn print_json(value: &impl serde::Serialize) -> Result<()> {
    print_text(serde_json::to_string_pretty(value)?);
    Ok(())
}

/// Prints the result for people.
fn print_text(text: impl std::fmt::Display) {
    use std::io::Write;
    // A reader that has gone away (`| head`) is no failure of ours.
    let _ = writeln!(std::io::stdout(), "{text}");
}
