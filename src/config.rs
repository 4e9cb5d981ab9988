//! TOML scene files: the accepted keys, and errors that point at the line.
//!
//! In: a file, `--set table.key=value`. Out: a [`SceneFile`] whose every value lies in its accepted range. Each room defines its own settings;
//! this file puts them together.

mod error;
mod origin;
mod renamed;

pub use error::ConfigError;
pub use renamed::{RENAMED, renamed};

use crate::backend::DeviceSettings;
use crate::flow::{FlowSettings, Integrator, StepsSetting};
use crate::publish::PublishSettings;
use crate::render::{CameraSettings, LightSettings, RenderSettings, TransferSettings};
use crate::run::{MapSettings, Settings, TimeSettings, TrainingSettings};
use crate::setting::Refused;
use crate::source::live::LiveSettings;
use crate::source::{ArchiveSettings, DomainSettings, SourceKind, SourceSettings, is_url};
use crate::surrogate::network::{Encoding, Loss, NetworkSettings, Size, Target};
use crate::surrogate::{Kind, SurrogateSettings};
use crate::trust::TrustSettings;
use origin::Origin;
use serde::{Deserialize, Serialize};
use std::path::{Component, Path, PathBuf};
use toml_edit::TableLike;

/// A scene file. Only the table `[source]` is required.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SceneFile {
    /// Title for people.
    #[serde(default)]
    pub title: String,
    /// Seed of every random number.
    #[serde(default)]
    pub seed: u64,
    /// Source of the velocity.
    pub source: SourceSettings,
    /// Files, variables and metric, for `source.kind = "archive"`.
    #[serde(default)]
    pub archive: ArchiveSettings,
    /// The simulation, for `source.kind = "live"`.
    #[serde(default)]
    pub live: LiveSettings,
    /// Box of the seeds; required by closed forms.
    pub domain: Option<DomainSettings>,
    /// Integration time, direction and the slides of the window.
    #[serde(default)]
    pub time: TimeSettings,
    /// Integration.
    #[serde(default)]
    pub flow: FlowSettings,
    /// Kind of surrogate.
    #[serde(default)]
    pub surrogate: SurrogateSettings,
    /// Network of the surrogate.
    #[serde(default)]
    pub network: NetworkSettings,
    /// Amount of training a frame.
    #[serde(default)]
    pub training: TrainingSettings,
    /// Error up to which the surrogate answers.
    #[serde(default)]
    pub trust: TrustSettings,
    /// Picture.
    #[serde(default)]
    pub render: RenderSettings,
    /// View; `None`: an overview of the domain.
    pub camera: Option<CameraSettings>,
    /// Light; `None`: from above, over the shoulder.
    pub light: Option<LightSettings>,
    /// Extinction and albedo; `None`: scaled to the FTLE of the first slide.
    pub transfer: Option<TransferSettings>,
    /// Maps of the slides.
    #[serde(default)]
    pub maps: MapSettings,
    /// Output of frames.
    #[serde(default)]
    pub publish: PublishSettings,
    /// Use of a GPU.
    #[serde(default)]
    pub device: DeviceSettings,
    /// Where each key was set.
    #[serde(skip)]
    origin: Origin,
}

/// Stands for the scene file if there is none.
const COMMAND_LINE: &str = "(command line)";

/// The only path of a scene that is written to, but for a Unix socket.
const WRITTEN: &str = "archive.synthetic.folder";
/// The endpoint of frames, which may be a Unix socket.
const ENDPOINT: &str = "publish.endpoint";
/// Folder of the working directory inside which a scene file may have files written; elsewhere only an option may.
const OUTPUT: &str = "out";

/// Whether a path leads into [`OUTPUT`] of the working directory.
fn is_output(path: &Path) -> bool {
    let here = std::env::current_dir().unwrap_or_default();
    let relative = if path.is_absolute() { path.strip_prefix(here).unwrap_or(path) } else { path };
    let mut parts = relative.components().filter(|part| *part != Component::CurDir);
    parts.next() == Some(Component::Normal(OUTPUT.as_ref())) && parts.all(|part| matches!(part, Component::Normal(_)))
}

/// Dotted keys of all values.
fn keys_of(table: &toml::Table) -> Vec<String> {
    let below = |(key, value): (&String, &toml::Value)| match value {
        toml::Value::Table(inner) => keys_of(inner).into_iter().map(|rest| format!("{key}.{rest}")).collect(),
        _ => vec![key.clone()],
    };
    table.iter().flat_map(below).collect()
}

impl SceneFile {
    /// Reads and checks a scene file; `overrides` are `table.key=value` with values in TOML (a bare word is a string).
    ///
    /// Relative paths start at the folder of the scene file; URLs stay as they are. Paths of `overrides`, and the one path that is written to, start at the working
    /// directory.
    ///
    /// # Errors
    /// A file that cannot be read, an unknown key, a value of the wrong type or out of its range, or a key without effect.
    pub fn read(path: &Path, overrides: &[String]) -> Result<Self, ConfigError> {
        let text = crate::files::open(path)
            .and_then(std::io::read_to_string)
            .map_err(|source| ConfigError::Unreadable { path: path.to_path_buf(), message: source.to_string() })?;
        let mut scene = Self::parse(path, &text, overrides)?;
        let by_option = |set: &str| WRITTEN == set || WRITTEN.strip_prefix(set).is_some_and(|rest| rest.starts_with('.'));
        if let Some(synthetic) = &scene.archive.synthetic
            && !is_output(&synthetic.folder)
            && !scene.origin.options().any(by_option)
        {
            // The scene may be a stranger's.
            let accepted = format!("a folder inside {OUTPUT}/ of the working directory, or any with --set {WRITTEN}=FOLDER");
            return Err(scene.locate(Refused::new(WRITTEN, format_args!("is {:?}", synthetic.folder), &accepted)));
        }
        // A Unix socket is a file too, and one that is left there is replaced.
        if let Some(endpoint) = &scene.publish.endpoint
            && let Some(socket) = endpoint.strip_prefix("ipc://")
            && !is_output(Path::new(socket))
            && !scene.origin.options().any(|set| set == ENDPOINT || set == "publish")
        {
            let accepted = format!("tcp://HOST:PORT, \"private\", a path inside {OUTPUT}/, or any with --set {ENDPOINT}={endpoint}");
            return Err(scene.locate(Refused::new(ENDPOINT, format_args!("is {endpoint:?}"), &accepted)));
        }
        let folder = path.parent().unwrap_or(Path::new("."));
        let origin = scene.origin.clone();
        for (key, file) in scene.paths() {
            if file.is_relative() && !is_url(file) && key != WRITTEN && !origin.sets(key) {
                *file = folder.join(&*file);
            }
        }
        Ok(scene)
    }

    /// Checks the text of a scene file; `path` appears in errors only.
    ///
    /// # Errors
    /// As [`SceneFile::read`].
    pub fn parse(path: &Path, text: &str, overrides: &[String]) -> Result<Self, ConfigError> {
        let origin = Origin::new(path, text, overrides);
        let syntax = |error: toml::de::Error| origin.syntax_error(&error);
        let plain = error::read(toml::Deserializer::parse(text).map_err(syntax)?).map_err(|fault| origin.of_file(fault))?;
        let keys = keys_of(&text.parse().map_err(syntax)?);
        Self::complete(plain, origin, &keys, overrides)
    }

    /// A scene for data files: every other key has its default.
    ///
    /// # Errors
    /// As [`SceneFile::read`].
    pub fn for_archive(files: Vec<PathBuf>, overrides: &[String]) -> Result<Self, ConfigError> {
        let (mut plain, origin) = Self::bare("archive", overrides)?;
        plain.archive.files = files;
        Self::complete(plain, origin, &[], overrides)
    }

    /// A scene for a running simulation: every other key has its default.
    ///
    /// # Errors
    /// As [`SceneFile::read`].
    pub fn for_live(overrides: &[String]) -> Result<Self, ConfigError> {
        let (plain, origin) = Self::bare("live", overrides)?;
        Self::complete(plain, origin, &[], overrides)
    }

    fn bare(kind: &str, overrides: &[String]) -> Result<(Self, Origin), ConfigError> {
        let origin = Origin::new(Path::new(COMMAND_LINE), "", overrides);
        let scene = toml::from_str(&format!("source.kind = \"{kind}\"")).map_err(|error| origin.syntax_error(&error))?;
        Ok((scene, origin))
    }

    /// Applies the overrides and checks the result. `keys` are those that the file of `plain` sets.
    fn complete(mut plain: Self, origin: Origin, keys: &[String], overrides: &[String]) -> Result<Self, ConfigError> {
        plain.origin = origin;
        let scene = if overrides.is_empty() { plain.clone() } else { plain.overridden(overrides)? };
        scene.check()?;
        // An option that leaves a part of the file without effect is no fault of the file; one that gives a part effect mends it.
        let of_file = keys.iter().map(String::as_str).filter(|key| plain.why_idle(key).is_some());
        if let Some((key, accepted)) = of_file.chain(scene.origin.options()).find_map(|key| Some((key, scene.why_idle(key)?))) {
            return Err(scene.locate(Refused::new(key, "does nothing here", accepted)));
        }
        Ok(scene)
    }

    /// Paths in the scene, with their keys.
    fn paths(&mut self) -> impl Iterator<Item = (&'static str, &mut PathBuf)> {
        let files = self.archive.files.iter_mut().map(|path| ("archive.files", path));
        let written = self.archive.synthetic.iter_mut().map(|synthetic| (WRITTEN, &mut synthetic.folder));
        let ring = self.live.ring.iter_mut().map(|path| ("live.ring", path));
        let connections = self.live.connections.iter_mut().map(|path| ("live.connections", path));
        let resume = self.training.resume.iter_mut().map(|path| ("training.resume", path));
        files.chain(written).chain(ring).chain(connections).chain(resume)
    }

    /// Keys and tables without effect in this scene, each with what is accepted. Keys that are idle only with `render.method = "reference"` are not
    /// among them, since an option changes the method. `SourceSettings` checks the keys of `[source]`; those of `[archive]` are checked when the
    /// files are open.
    fn idle(&self) -> impl Iterator<Item = (&'static str, &'static str)> {
        use SourceKind::{Archive, Live, Turbulence};
        const LEARNS: &str = "only with surrogate.kind = \"network\" or \"residual\"; a table is not trained";
        const HASHED: [&str; 6] = [
            "network.levels",
            "network.features",
            "network.log2_table",
            "network.base_resolution",
            "network.growth",
            "network.scale_levels_by_aspect",
        ];
        let Self { source: SourceSettings { kind, .. }, flow, network, training, .. } = self;
        let gridded = matches!(kind, Archive | Live | Turbulence);
        let adaptive = flow.integrator == Integrator::DormandPrince;
        let (learns, hashed) = (self.surrogate.kind != Kind::Table, network.encoding == Encoding::HashGrid);
        let rules: [(bool, &'static str, &'static [&'static str]); 21] = [
            (*kind == Archive, "only with source.kind = \"archive\"", &["archive"]),
            (self.archive.files.is_empty(), "only without archive.files", &["archive.synthetic"]),
            (*kind == Live, "only with source.kind = \"live\"", &["live"]),
            (!gridded, "only with closed forms; snapshots have their own times", &["time.start"]),
            (!gridded, "only with closed forms; time.snapshots_per_slide is the step of snapshots", &["time.seed_step"]),
            (gridded, "only with snapshots; a closed form has a velocity at all times", &["time.every"]),
            (gridded, "only with snapshots; time.seed_step is the step of closed forms", &["time.snapshots_per_slide"]),
            (flow.integrator == Integrator::Differences, "only with flow.integrator = \"differences\"", &["flow.difference_step"]),
            (!adaptive, "only without flow.integrator = \"dormand_prince\", which chooses its steps", &["flow.steps"]),
            (!adaptive && flow.steps == StepsSetting::Auto, "only with flow.steps = \"auto\"", &["flow.tolerance"]),
            (gridded, "only with snapshots; a closed form is known everywhere", &["flow.interpolation"]),
            (self.surrogate.kind != Kind::Network, "only with surrogate.kind = \"table\" or \"residual\"", &["surrogate.table_nodes"]),
            (
                self.surrogate.kind == Kind::Table && self.surrogate.table_nodes.is_none() && network.size != Size::Auto,
                "only with surrogate.kind = \"table\", without surrogate.table_nodes and with network.size = \"fixed\"",
                &["surrogate.refine"],
            ),
            (learns || network.size == Size::Auto, LEARNS, &["network"]),
            (hashed, "only with network.encoding = \"hash_grid\"", &HASHED),
            (!hashed, "only with network.encoding = \"frequency\"", &["network.octaves"]),
            (network.loss == Loss::Published, "only with network.loss = \"published\"", &["network.mean_penalty"]),
            (network.target == Target::FlowMap, "only with network.target = \"flow_map\"", &["network.jacobian_weight"]),
            (learns, LEARNS, &["training.share", "training.seconds_per_frame", "training.steps_per_frame", "training.resume"]),
            (training.steps_per_frame.is_none(), "only without training.steps_per_frame", &["training.seconds_per_frame"]),
            (self.publish.maps, "only with publish.maps = true", &["maps"]),
        ];
        rules.into_iter().filter(|(works, ..)| !works).flat_map(|(_, accepted, keys)| keys.iter().map(move |key| (*key, accepted)))
    }

    /// Returns what is accepted instead of a key without effect in this scene. `None` if the key has an effect.
    fn why_idle(&self, key: &str) -> Option<&'static str> {
        let below = |idle: &str| key.strip_prefix(idle).is_some_and(|rest| rest.is_empty() || rest.starts_with('.'));
        self.idle().find(|(idle, _)| below(idle)).map(|(_, accepted)| accepted)
    }

    /// Text of a scene file that means the same from any folder: options and `--set` applied, defaults filled in (except those that depend on
    /// the data), paths absolute, keys without effect left out.
    ///
    /// # Errors
    /// A value out of its range, or a path that is not UTF-8, which TOML cannot hold.
    pub fn to_toml(&self) -> Result<String, ConfigError> {
        self.check()?;
        let unwritable = |message: String| ConfigError::Unwritable { message };
        let mut scene = self.clone();
        for (key, path) in scene.paths() {
            let refused = |why: &str| unwritable(format!("`{key}` is {path:?}: {why}"));
            let whole = if is_url(path) { path.clone() } else { std::path::absolute(&*path).map_err(|e| refused(&e.to_string()))? };
            whole.to_str().ok_or_else(|| refused("not UTF-8"))?;
            *path = whole;
        }
        let text = toml::to_string(&scene).map_err(|e| unwritable(e.to_string()))?;
        let mut document: toml_edit::DocumentMut = text.parse().map_err(|e: toml_edit::TomlError| unwritable(e.to_string()))?;
        for (idle, _) in scene.idle() {
            let (tables, key) = idle.rsplit_once('.').unwrap_or(("", idle));
            let mut tables = tables.split('.').filter(|name| !name.is_empty());
            let table = tables.try_fold(document.as_table_mut() as &mut dyn TableLike, |at, name| at.get_mut(name)?.as_table_like_mut());
            if let Some(table) = table {
                table.remove(key);
            }
        }
        Ok(document.to_string())
    }

    /// Settings of the cycle.
    pub fn settings(&self) -> Settings {
        let scene = self.clone();
        Settings {
            title: scene.title,
            seed: scene.seed,
            source: scene.source,
            archive: scene.archive,
            live: scene.live,
            domain: scene.domain,
            time: scene.time,
            flow: scene.flow,
            surrogate: scene.surrogate,
            network: scene.network,
            training: scene.training,
            trust: scene.trust,
            render: scene.render,
            camera: scene.camera,
            light: scene.light,
            transfer: scene.transfer,
            maps: scene.maps,
        }
    }

    /// Settings of the output, with the defaults of a live run if it is one.
    pub fn publish_settings(&self) -> PublishSettings {
        let publish = self.publish.clone();
        if self.source.kind == SourceKind::Live { publish.of_live_run() } else { publish }
    }

    /// Notes that an option of the command line set a key; errors about the key then name the option (`--spp 0`).
    pub fn set_by(&mut self, key: &str, option: impl Into<String>) {
        self.origin.set_by(key, option.into());
    }

    /// Checks every room's settings.
    ///
    /// # Errors
    /// The first fault, located.
    pub fn check(&self) -> Result<(), ConfigError> {
        let checked = self.settings().check().and_then(|()| self.publish.check()).and_then(|()| self.device.check());
        checked.map_err(|refused| self.locate(refused))
    }

    /// Adds the place that set the key: the last option or `--set` that named it, else the line of the file. Also for faults that show only
    /// when the source is open.
    pub fn locate(&self, refused: Refused) -> ConfigError {
        self.origin.locate(refused)
    }

    /// Applies `table.key=value`.
    fn overridden(&self, overrides: &[String]) -> Result<Self, ConfigError> {
        let fail = |given: &str, message: String| ConfigError::Fault { place: format!("--set {given}"), message, line: None };
        let mut tree = toml::Table::try_from(self).map_err(|e| fail("", e.to_string()))?;
        let mut changed = self.clone();
        for given in overrides {
            let fail = |message: String| fail(given, message);
            let (key, value) = given.split_once('=').ok_or_else(|| fail("accepted: table.key=value".into()))?;
            let value =
                format!("value = {value}").parse().ok().and_then(|mut table: toml::Table| table.remove("value")).unwrap_or(value.into());
            let mut path: Vec<&str> = key.trim().split('.').collect();
            let last = path.pop().filter(|k| !k.is_empty()).ok_or_else(|| fail("the key is empty".into()))?;
            let mut table = &mut tree;
            for part in path {
                let entry = table.entry(part).or_insert_with(|| toml::Table::new().into());
                table = entry.as_table_mut().ok_or_else(|| fail(format!("`{part}` is a value, not a table")))?;
            }
            table.insert(last.to_owned(), value);
            // After each override, so that the error names the one at fault.
            changed = error::read(tree.clone()).map_err(|fault| fail(fault.message))?;
        }
        Ok(Self { origin: self.origin.clone(), ..changed })
    }
}

#[cfg(test)]
mod tests;
