//! Options, checks and output that several commands share.

use super::messages;
use anyhow::{Context, Result, bail};
use ridgewatch::backend::{Device, DeviceChoice};
use ridgewatch::chart::device_name;
use ridgewatch::config::{ConfigError, SceneFile};
use ridgewatch::dashboard::DashboardError;
use ridgewatch::publish::PublishError;
use ridgewatch::render::Method;
use ridgewatch::run::{Plan, Race, RunError, Settings, Setup, why_steps};
use ridgewatch::setting::Refused;
use ridgewatch::source::{SourceError, SourceKind, expand};
use ridgewatch::steer::SteerError;
use ridgewatch::surrogate::Kind;
use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};

/// Options of every command.
#[derive(Debug, clap::Args)]
pub struct Common {
    /// Device that computes: auto (a GPU if one is usable), cpu, or cuda:N.
    #[arg(long, global = true, default_value_t = DeviceChoice::Auto, value_name = "DEVICE")]
    pub device: DeviceChoice,
    /// Number of worker threads, at most 1024; 0: as many as this process may use.
    #[arg(long, global = true, default_value_t = 0, value_name = "N", value_parser = threads)]
    pub threads: usize,
    /// Set one key of the scene, e.g. `--set render.samples=64`; may be repeated.
    #[arg(long = "set", global = true, value_name = "TABLE.KEY=VALUE")]
    pub overrides: Vec<String>,
    /// Seed of every random number; overrides the scene's.
    #[arg(long, global = true, value_name = "N", value_parser = clap::value_parser!(u64).range(..=i64::MAX as u64))]
    pub seed: Option<u64>,
    /// Print a machine-readable result on standard output; everything else is printed on standard error.
    #[arg(long, global = true)]
    pub json: bool,
    /// Print more on standard error; twice for details.
    #[arg(short, long, global = true, action = clap::ArgAction::Count)]
    pub verbose: u8,
}

/// A request that is not accepted: exit status 2.
#[derive(Debug, thiserror::Error)]
#[error("{0}")]
pub struct Usage(pub String);

/// A command that a signal ended before its work was done. The exit status is that of a process ended by the signal.
#[derive(Debug, thiserror::Error)]
#[error("stopped by a signal; {done}")]
pub struct Interrupted {
    pub status: u8,
    pub done: &'static str,
}

/// Exit status of an error: 2 for usage and settings, 128 plus the signal's number for a signal, else 1.
pub fn exit_status(error: &anyhow::Error) -> u8 {
    if let Some(interrupted) = error.downcast_ref::<Interrupted>() {
        return interrupted.status;
    }
    let configuration = error.chain().any(|cause| {
        let run = cause.downcast_ref().is_some_and(|error: &RunError| error.refused().is_some());
        let publish = cause.downcast_ref().is_some_and(|error: &PublishError| error.refused().is_some());
        let source = cause.downcast_ref().is_some_and(|error: &SourceError| error.refused().is_some());
        let dashboard = cause.downcast_ref().is_some_and(DashboardError::is_usage);
        let steer = cause.downcast_ref().is_some_and(SteerError::is_usage);
        run || publish || dashboard || steer || source || cause.is::<ConfigError>() || cause.is::<Usage>()
    });
    if configuration { 2 } else { 1 }
}

/// Opens the device. With `--verbose`, prints why `auto` chose the CPU.
pub fn device(common: &Common, scene: &SceneFile) -> Result<Device> {
    let device = Device::open(common.device, &scene.device)?;
    if let Device::Cpu { why: Some(why) } = &device {
        tracing::info!("on the CPU: {why}");
    }
    Ok(device)
}

/// Whether a path names a scene file.
pub fn is_config(path: &Path) -> bool {
    path.extension().is_some_and(|e| e == "toml")
}

/// Reads the scene of a command: one TOML file, or data files.
pub fn scene(common: &Common, paths: &[PathBuf]) -> Result<SceneFile> {
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
    scene.seed = common.seed.unwrap_or(scene.seed);
    Ok(scene)
}

/// Ending of the chart that `chart` leaves beside a scene file for the dashboard.
pub const CHART: &str = "chart.svg";

/// A file beside a scene file, with its name and another ending; `None` for data files.
pub fn beside_scene(paths: &[PathBuf], ending: &str) -> Option<PathBuf> {
    match paths {
        [one] if is_config(one) => Some(one.with_extension(ending)),
        _ => None,
    }
}

/// The last race of methods of `render.method = "auto"`, kept beside a scene file for its next run on the same data and device.
pub struct RaceFile {
    path: PathBuf,
    /// What a race is of: version, device, threads, names, lengths and times of the data files, and scene.
    of: String,
}

#[derive(serde::Serialize, serde::Deserialize)]
struct Remembered {
    of: String,
    race: Race,
}

impl RaceFile {
    /// `None` without races, for data files alone, and for data in folders, which do not tell of changes inside.
    pub fn of(common: &Common, scene: &SceneFile, paths: &[PathBuf], device: &Device) -> Result<Option<Self>> {
        let path = beside_scene(paths, "auto.json").filter(|_| scene.render.method == Method::Auto);
        let Some(path) = path else { return Ok(None) };
        let files = if scene.archive.files.is_empty() {
            Vec::new()
        } else {
            expand(&scene.archive.files).map_err(|error| located(scene, RunError::from(error), RunError::refused))?
        };
        let data: Vec<_> = files.iter().filter_map(|file| std::fs::metadata(file).ok().filter(std::fs::Metadata::is_file)).collect();
        if data.len() != files.len() {
            return Ok(None);
        }
        let data: Vec<_> = files.iter().zip(&data).map(|(file, found)| (file, found.len(), found.modified().ok())).collect();
        // What does not change the time from a slide to a picture.
        let mut racing = scene.clone();
        (racing.time.slides, racing.time.frames_per_slide, racing.time.warmup_frames) = (None, 1, 0);
        (racing.publish, racing.title) = (Default::default(), String::new());
        let version = env!("CARGO_PKG_VERSION");
        let of = format!("{version} {} {} threads {data:?} {}", device_name(device), common.threads, racing.to_toml()?);
        Ok(Some(Self { path, of }))
    }

    /// The race of an earlier run over the same domain and tau.
    pub fn read(&self, plan: &Plan) -> Option<Race> {
        let remembered: Remembered = serde_json::from_slice(&std::fs::read(&self.path).ok()?).ok()?;
        Some(remembered.race).filter(|race| remembered.of == self.over(plan) && race.is_sound())
    }

    /// What a race is of, with what the source decides: another simulation may be found at the same place.
    fn over(&self, plan: &Plan) -> String {
        format!("{} {:?} {}", self.of, plan.domain, plan.map.tau)
    }

    /// Keeps a race. A folder that cannot be written costs the next run its own race, and nothing else.
    pub fn write(&self, plan: &Plan, race: Race) -> Result<()> {
        let text = serde_json::to_vec_pretty(&Remembered { of: self.over(plan), race })?;
        if let Err(error) = ridgewatch::files::write_whole(&self.path, &text) {
            messages::note(format_args!("the race of methods is not remembered: {}: {error}", self.path.display()));
        }
        Ok(())
    }
}

/// Adds the place of the setting at fault, if a setting is at fault.
pub fn located<E>(scene: &SceneFile, error: E, refused: impl FnOnce(&E) -> Option<Refused>) -> anyhow::Error
where
    E: std::error::Error + Send + Sync + 'static,
{
    match refused(&error) {
        Some(refused) => scene.locate(refused).into(),
        None => error.into(),
    }
}

/// `text` of a scene, with the integration time that was chosen if the scene leaves it open: another trial, of more snapshots, may choose another one.
pub fn text_with_tau(scene: &SceneFile, setup: &Setup, text: String) -> Result<String> {
    let chosen = &setup.plan.scene.time.tau;
    if &scene.time.tau == chosen {
        return Ok(text);
    }
    let mut scene = scene.clone();
    scene.time.tau.clone_from(chosen);
    Ok(scene.to_toml()?)
}

/// Opens the scene's source. First writes its synthetic archive if that does not exist, which may take minutes.
pub fn open(scene: &SceneFile) -> Result<Setup> {
    open_by(scene, Setup::new)
}

/// The same by [`Setup::new`] or [`Setup::for_run`].
pub fn open_by(scene: &SceneFile, set_up: fn(Settings) -> Result<Setup, RunError>) -> Result<Setup> {
    let _spinner = opening(scene);
    set_up(scene.settings()).map_err(|error| located(scene, error, RunError::refused))
}

/// Spinner shown while a source is opened.
pub fn opening(scene: &SceneFile) -> indicatif::ProgressBar {
    let writes = scene.archive.synthetic.is_some() && scene.archive.files.is_empty();
    messages::spinner(if writes { "opening a synthetic archive, written first if it does not exist" } else { "opening the source" }.into())
}

/// Ring folder of an option, or of the environment.
pub fn ring_folder(option: Option<&Path>) -> Result<PathBuf> {
    let missing = || Usage(format!("no ring: name its folder, or set {}", ridgewatch_wire::RING_VARIABLE));
    Ok(option.map(Path::to_owned).or_else(ridgewatch_wire::ring_from_environment).ok_or_else(missing)?)
}

/// Describes a number of steps that was chosen by its error.
pub fn chosen_steps(steps: u64, difference: f64, residual: Option<f64>) -> String {
    format!("{steps} steps a path: {}", why_steps(difference, residual))
}

/// Refuses a checkpoint option if nothing is trained.
pub fn check_learns(scene: &SceneFile, option: &str, path: Option<&Path>) -> Result<()> {
    let Some(path) = path else { return Ok(()) };
    let refuse = |why: &str| bail!(Usage(format!("{option} {}: {why}", path.display())));
    if !scene.render.method.has_surrogate() {
        return refuse("methods reference and map have no surrogate; accepted with methods two_level, marched, surrogate and gated");
    }
    if scene.surrogate.kind == Kind::Table {
        return refuse("a table is traced anew for every window and is not trained; accepted with surrogate.kind network and residual");
    }
    Ok(())
}

/// Why `--verify` checks nothing, if it is given with a method that states no error of a surrogate.
pub fn verifies_nothing(setup: &Setup, points: u64) -> Option<Usage> {
    let method = setup.first_method();
    (points > 0 && !method.has_surrogate()).then(|| {
        let accepted = "accepted with methods two_level, marched, surrogate and gated";
        Usage(format!("--verify {points}: method {} has no surrogate whose error could be checked; {accepted}", method.name()))
    })
}

/// Refuses a running simulation, for a command that makes `what` of one moment.
pub fn refuse_live(scene: &SceneFile, what: &str) -> Result<()> {
    if scene.source.kind == SourceKind::Live {
        let why = "--publish and dashboard show it; accepted: archives and closed forms";
        bail!(Usage(format!("a running simulation has no {what} yet: {why}")));
    }
    Ok(())
}

/// Refuses `--set` for a command without a scene. `accepted`: its own options.
pub fn refuse_settings(common: &Common, command: &str, accepted: &str) -> Result<()> {
    if common.overrides.is_empty() {
        return Ok(());
    }
    bail!(Usage(format!("--set: {command} has no scene; accepted: {accepted}")))
}

/// Checks before the work that a file can be written.
pub fn check_folder(out: &Path) -> Result<()> {
    // A rename would replace a pipe or a device.
    if std::fs::metadata(out).is_ok_and(|there| !there.is_file()) {
        bail!(Usage(format!("{} exists and is not a regular file", out.display())));
    }
    let folder = out.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."));
    std::fs::create_dir_all(folder).with_context(|| format!("cannot make the folder {}", folder.display()))?;
    tempfile::NamedTempFile::new_in(folder).with_context(|| format!("cannot write into {}", folder.display()))?;
    Ok(())
}

/// Parses a word of a scene file.
pub fn word<T: serde::de::DeserializeOwned>(word: &str, accepted: &str) -> Result<T, String> {
    let word: serde::de::value::StrDeserializer<serde::de::value::Error> = serde::de::IntoDeserializer::into_deserializer(word);
    T::deserialize(word).map_err(|_| format!("accepted: {accepted}"))
}

/// Parses a method.
pub fn method(text: &str) -> Result<Method, String> {
    word(text, "default, map, auto, reference, surrogate, neural, gated, marched, two_level")
}

/// Parses a number of threads.
fn threads(word: &str) -> Result<usize, String> {
    word.parse().ok().filter(|n| *n <= 1024).ok_or_else(|| "accepted: a whole number from 0 to 1024".to_owned())
}

/// Parses a number of seconds.
pub fn seconds(word: &str) -> Result<f64, String> {
    word.parse().ok().filter(|s: &f64| s.is_finite() && *s > 0.0).ok_or_else(|| "accepted: a number above 0".to_owned())
}

/// Parses `NXxNY` or `NXxNYxNZ`. `None` if a part is not a number.
pub fn dimensions<T: std::str::FromStr>(text: &str) -> Option<Vec<T>> {
    text.split(['x', 'X']).map(|n| n.trim().parse().ok()).collect()
}

/// Prints the machine-readable result. Ignores a closed pipe (`| head`).
///
/// # Errors
/// Standard output does not take it, as on a full disk.
pub fn print_json(value: &impl serde::Serialize) -> Result<()> {
    let text = serde_json::to_string_pretty(value)?;
    match print(text) {
        Err(error) if error.kind() != std::io::ErrorKind::BrokenPipe => {
            Err(error).context("the result cannot be written to standard output")
        }
        _ => Ok(()),
    }
}

/// The first error of [`print_text`].
static LOST_TEXT: Mutex<Option<std::io::Error>> = Mutex::new(None);

/// Prints the result for people. Work goes on if standard output does not take it; [`lost_text`] tells.
pub fn print_text(text: impl std::fmt::Display) {
    if let Err(error) = print(text)
        && error.kind() != std::io::ErrorKind::BrokenPipe
    {
        LOST_TEXT.lock().unwrap_or_else(PoisonError::into_inner).get_or_insert(error);
    }
}

/// Fails if a text could not be printed, as on a full disk; a closed pipe (`| head`) is none.
///
/// # Errors
/// That of the first such text.
pub fn lost_text() -> Result<()> {
    match LOST_TEXT.lock().unwrap_or_else(PoisonError::into_inner).take() {
        Some(error) => Err(error).context("the result cannot be written to standard output"),
        None => Ok(()),
    }
}

fn print(text: impl std::fmt::Display) -> std::io::Result<()> {
    use std::io::Write;
    let mut out = std::io::stdout();
    writeln!(out, "{text}")?;
    out.flush()
}
