//! TOML scene files: what they may say, and errors that point at the line.
//!
//! In: a file, `--set table.key=value`. Out: a [`SceneFile`] whose every value lies in its accepted range. The settings of a room
//! are defined in that room; this file puts them together.

mod error;

pub use error::ConfigError;

use crate::engine::{DeviceSettings, Settings, TimeSettings, TrainingSettings};
use crate::flow::{FlowSettings, Integrator, StepsSetting};
use crate::publish::PublishSettings;
use crate::render::{CameraSettings, LightSettings, RenderSettings, TransferSettings};
use crate::setting::Refused;
use crate::source::live::LiveSettings;
use crate::source::{ArchiveSettings, DomainSettings, SourceKind, SourceSettings};
use crate::surrogate::network::{Encoding, Loss, NetworkSettings, Size, Target};
use crate::surrogate::{Kind, SurrogateSettings};
use crate::trust::TrustSettings;
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};
use toml_edit::TableLike;

/// A whole scene file. Every table but `[source]` may be left out.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SceneFile {
    /// A line for people.
    #[serde(default)]
    pub title: String,
    /// Seed of every random number.
    #[serde(default)]
    pub seed: u64,
    /// Where velocity comes from.
    pub source: SourceSettings,
    /// Which files, variables and metric, for `source.kind = "archive"`.
    #[serde(default)]
    pub archive: ArchiveSettings,
    /// Which simulation, for `source.kind = "live"`.
    #[serde(default)]
    pub live: LiveSettings,
    /// The box in which seeds lie; needed by closed forms.
    pub domain: Option<DomainSettings>,
    /// Integration time, direction and the slides of the window.
    #[serde(default)]
    pub time: TimeSettings,
    /// Integration.
    #[serde(default)]
    pub flow: FlowSettings,
    /// Which surrogate.
    #[serde(default)]
    pub surrogate: SurrogateSettings,
    /// Its network.
    #[serde(default)]
    pub network: NetworkSettings,
    /// How much training a frame gets.
    #[serde(default)]
    pub training: TrainingSettings,
    /// When the surrogate is believed.
    #[serde(default)]
    pub trust: TrustSettings,
    /// The picture.
    #[serde(default)]
    pub render: RenderSettings,
    /// View; none: an overview of the domain.
    pub camera: Option<CameraSettings>,
    /// Light; none: from above, over the shoulder.
    pub light: Option<LightSettings>,
    /// Extinction and albedo; none: scaled to the first frame's FTLE.
    pub transfer: Option<TransferSettings>,
    /// Frames out.
    #[serde(default)]
    pub publish: PublishSettings,
    /// How a GPU is used.
    #[serde(default)]
    pub device: DeviceSettings,
    /// Where all this was said.
    #[serde(skip)]
    origin: Origin,
}

/// Where a scene was said, so that a fault found later can be located.
#[derive(Debug, Clone, PartialEq, Default)]
struct Origin {
    path: PathBuf,
    text: String,
    /// Keys set elsewhere, with the place to name, oldest first.
    elsewhere: Vec<(String, String)>,
}

impl Origin {
    fn new(path: &Path, text: &str, overrides: &[String]) -> Self {
        let key = |given: &String| given.split('=').next().unwrap_or_default().trim().to_owned();
        let elsewhere = overrides.iter().map(|given| (key(given), format!("--set {given}"))).collect();
        Self { path: path.to_path_buf(), text: text.to_owned(), elsewhere }
    }

    fn sets(&self, key: &str) -> bool {
        self.elsewhere.iter().any(|(set, _)| set == key)
    }
}

/// What stands for the scene file where there is none.
const COMMAND_LINE: &str = "(command line)";

/// The one path of a scene at which something is written.
const WRITTEN: &str = "archive.synthetic.folder";

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
    /// Paths in `archive.files`, `live.ring`, `live.connections` and `training.resume` are relative to the scene file's folder.
    pub fn read(path: &Path, overrides: &[String]) -> Result<Self, ConfigError> {
        let text = crate::files::open(path)
            .and_then(std::io::read_to_string)
            .map_err(|source| ConfigError::Unreadable { path: path.to_path_buf(), message: source.to_string() })?;
        let mut scene = Self::parse(path, &text, overrides)?;
        let folder = path.parent().unwrap_or(Path::new("."));
        let origin = scene.origin.clone();
        for (key, file) in scene.paths() {
            // What is named by `--set` is relative to where the command runs, as on any command line, and so is what is written.
            if file.is_relative() && key != WRITTEN && !origin.sets(key) {
                *file = folder.join(&*file);
            }
        }
        Ok(scene)
    }

    /// Checks the text of a scene file; `path` appears in errors only.
    pub fn parse(path: &Path, text: &str, overrides: &[String]) -> Result<Self, ConfigError> {
        let plain: Self = toml::from_str(text).map_err(|e| ConfigError::from_toml(path, text, &e))?;
        let table: toml::Table = text.parse().map_err(|e| ConfigError::from_toml(path, text, &e))?;
        Self::complete(plain, Origin::new(path, text, overrides), &keys_of(&table), overrides)
    }

    /// A scene for files given by name alone: every default.
    pub fn for_archive(files: Vec<PathBuf>, overrides: &[String]) -> Result<Self, ConfigError> {
        let mut plain = Self::bare("archive")?;
        plain.archive.files = files;
        Self::complete(plain, Origin::new(Path::new(COMMAND_LINE), "", overrides), &[], overrides)
    }

    /// A scene for a simulation that runs now, of which only the place is known: every default.
    pub fn for_live(overrides: &[String]) -> Result<Self, ConfigError> {
        Self::complete(Self::bare("live")?, Origin::new(Path::new(COMMAND_LINE), "", overrides), &[], overrides)
    }

    fn bare(kind: &str) -> Result<Self, ConfigError> {
        let text = format!("[source]\nkind = \"{kind}\"\n");
        toml::from_str(&text).map_err(|e| ConfigError::from_toml(Path::new(COMMAND_LINE), &text, &e))
    }

    /// Applies the overrides and checks all. `keys` are those that the file of `plain` sets.
    fn complete(mut plain: Self, origin: Origin, keys: &[String], overrides: &[String]) -> Result<Self, ConfigError> {
        plain.origin = origin.clone();
        let mut scene = if overrides.is_empty() { plain.clone() } else { Self::overridden(&plain, overrides)? };
        scene.origin = origin;
        scene.check()?;
        // An option that makes a part of the file idle is no fault of the file; one that gives a part of it work mends it.
        let of_file = keys.iter().map(String::as_str).filter(|key| plain.why_idle(key).is_some());
        let given = scene.origin.elsewhere.iter().map(|(key, _)| key.as_str());
        if let Some((key, accepted)) = of_file.chain(given).find_map(|key| Some((key, scene.why_idle(key)?))) {
            return Err(scene.locate(Refused::new(key, "does nothing here", accepted)));
        }
        Ok(scene)
    }

    /// Paths that the scene names, with their keys.
    fn paths(&mut self) -> impl Iterator<Item = (&'static str, &mut PathBuf)> {
        let files = self.archive.files.iter_mut().map(|path| ("archive.files", path));
        let written = self.archive.synthetic.iter_mut().map(|synthetic| (WRITTEN, &mut synthetic.folder));
        let ring = self.live.ring.iter_mut().map(|path| ("live.ring", path));
        let connections = self.live.connections.iter_mut().map(|path| ("live.connections", path));
        let resume = self.training.resume.iter_mut().map(|path| ("training.resume", path));
        files.chain(written).chain(ring).chain(connections).chain(resume)
    }

    /// Keys and tables that would be read and do nothing in this scene, each with what is accepted. What only `render.method = "reference"` has no
    /// use for is not among them, since the method is changed by an option. (Keys of `[source]` are refused by their room, those of `[archive]`
    /// that do not fit the files when these are open.)
    fn idle(&self) -> impl Iterator<Item = (&'static str, &'static str)> {
        use SourceKind::{Archive, Live, Turbulence};
        const LEARNS: &str = "only with surrogate.kind = \"network\" or \"residual\"; a table learns nothing";
        const HASHED: &str = "only with network.encoding = \"hash_grid\"";
        let Self { source: SourceSettings { kind, .. }, flow, network, training, .. } = self;
        let gridded = matches!(kind, Archive | Live | Turbulence);
        let adaptive = flow.integrator == Integrator::DormandPrince;
        let (learns, hashed) = (self.surrogate.kind != Kind::Table, network.encoding == Encoding::HashGrid);
        let keys = [
            ("archive", *kind == Archive, "only with source.kind = \"archive\""),
            ("archive.synthetic", self.archive.files.is_empty(), "only without archive.files"),
            ("live", *kind == Live, "only with source.kind = \"live\""),
            ("time.start", !gridded, "only with closed forms; snapshots have times of their own"),
            ("time.step", !gridded, "only with closed forms; time.stride says how far the window of snapshots moves"),
            ("time.stride", gridded, "only with snapshots; time.step says how far the seed time of a closed form moves"),
            ("flow.difference_step", flow.integrator == Integrator::Differences, "only with flow.integrator = \"differences\""),
            ("flow.steps", !adaptive, "left out with flow.integrator = \"dormand_prince\", which chooses its own"),
            ("flow.tolerance", !adaptive && flow.steps == StepsSetting::Auto, "only with flow.steps = \"auto\""),
            ("flow.interpolation", gridded, "only with snapshots; a closed form is known everywhere"),
            ("surrogate.table_nodes", self.surrogate.kind != Kind::Network, "only with surrogate.kind = \"table\" or \"residual\""),
            ("network", learns || network.size == Size::Auto, LEARNS),
            ("network.levels", hashed, HASHED),
            ("network.features", hashed, HASHED),
            ("network.log2_table", hashed, HASHED),
            ("network.base_resolution", hashed, HASHED),
            ("network.growth", hashed, HASHED),
            ("network.follow_aspect", hashed, HASHED),
            ("network.octaves", !hashed, "only with network.encoding = \"frequency\""),
            ("network.mean_penalty", network.loss == Loss::Published, "only with network.loss = \"published\""),
            ("network.jacobian_weight", network.target == Target::FlowMap, "only with network.target = \"flow_map\""),
            ("training.share", learns, LEARNS),
            ("training.seconds_per_frame", learns, LEARNS),
            ("training.steps_per_frame", learns, LEARNS),
            ("training.resume", learns, LEARNS),
            ("training.seconds_per_frame", training.steps_per_frame.is_none(), "only without training.steps_per_frame"),
        ];
        keys.into_iter().filter(|(_, works, _)| !works).map(|(key, _, accepted)| (key, accepted))
    }

    /// What is accepted in place of a key that does nothing in this scene; none where it does something.
    fn why_idle(&self, key: &str) -> Option<&'static str> {
        let below = |idle: &str| key.strip_prefix(idle).is_some_and(|rest| rest.is_empty() || rest.starts_with('.'));
        self.idle().find(|(idle, _)| below(idle)).map(|(_, accepted)| accepted)
    }

    /// The text of a scene file that says the same from any folder: options and `--set` applied, defaults filled in (but those that the
    /// data decide), paths absolute, and without what does nothing in this scene.
    ///
    /// # Errors
    /// A value out of its range, and what no TOML file can hold: a path that is no UTF-8.
    pub fn to_toml(&self) -> Result<String, ConfigError> {
        self.check()?;
        let unwritable = |message: String| ConfigError::Unwritable { message };
        let mut scene = self.clone();
        for (key, path) in scene.paths() {
            let refused = |why: &str| unwritable(format!("`{key}` is {path:?}: {why}"));
            let whole = std::path::absolute(&*path).map_err(|e| refused(&e.to_string()))?;
            whole.to_str().ok_or_else(|| refused("no UTF-8"))?;
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

    /// What the cycle is told.
    pub fn settings(&self) -> Settings {
        let Self {
            title,
            seed,
            source,
            archive,
            live,
            domain,
            time,
            flow,
            surrogate,
            network,
            training,
            trust,
            render,
            camera,
            light,
            transfer,
            ..
        } = self.clone();
        Settings {
            title,
            seed,
            source,
            archive,
            live,
            domain,
            time,
            flow,
            surrogate,
            network,
            training,
            trust,
            render,
            camera,
            light,
            transfer,
        }
    }

    /// What the output is told.
    pub fn publish_settings(&self) -> PublishSettings {
        let publish = self.publish.clone();
        if self.source.kind == SourceKind::Live { publish.of_live_run() } else { publish }
    }

    /// Notes that a key was set by an option of the command line, which is named in its faults (`--spp 0`).
    pub fn set_by(&mut self, key: &str, option: impl Into<String>) {
        self.origin.elsewhere.push((key.to_owned(), option.into()));
    }

    /// Checks every room's settings.
    ///
    /// # Errors
    /// The first fault, located.
    pub fn check(&self) -> Result<(), ConfigError> {
        self.settings()
            .check()
            .and_then(|()| self.publish.check())
            .and_then(|()| self.device.check())
            .map_err(|refused| self.locate(refused))
    }

    /// The place that set the key: the option or the `--set` that named it last, else the line of the file. Some faults are found only
    /// when the source is open.
    pub fn locate(&self, refused: Refused) -> ConfigError {
        let Origin { path, text, elsewhere } = &self.origin;
        // Of several keys at fault together, the one set last on the command line is what the user has in hand.
        let named = |set: &str| {
            let at_fault = std::iter::once(&refused.key).chain(&refused.beside);
            at_fault.into_iter().any(|key| key == set || key.strip_prefix(set).is_some_and(|rest| rest.starts_with('.')))
        };
        let set = elsewhere.iter().rev().find(|(key, _)| named(key)).map(|(_, place)| place.clone());
        ConfigError::locate(refused, path, text, set)
    }

    /// The scene with `table.key=value` applied.
    fn overridden(scene: &Self, overrides: &[String]) -> Result<Self, ConfigError> {
        let mut tree = toml::Table::try_from(scene).map_err(|e| ConfigError::Override { given: String::new(), message: e.to_string() })?;
        for given in overrides {
            let fail = |message: String| ConfigError::Override { given: given.clone(), message };
            let (key, value) = given.split_once('=').ok_or_else(|| fail("accepted: table.key=value".into()))?;
            let value: toml::Value = format!("value = {value}")
                .parse::<toml::Table>()
                .ok()
                .and_then(|mut t| t.remove("value"))
                .unwrap_or_else(|| toml::Value::String(value.to_owned()));
            let mut path: Vec<&str> = key.trim().split('.').collect();
            let last = path.pop().filter(|k| !k.is_empty()).ok_or_else(|| fail("the key is empty".into()))?;
            let mut table = &mut tree;
            for part in path {
                let entry = table.entry(part).or_insert_with(|| toml::Value::Table(toml::Table::new()));
                table = entry.as_table_mut().ok_or_else(|| fail(format!("`{part}` is a value, not a table")))?;
            }
            table.insert(last.to_owned(), value);
            // Deserialise after each, so that the error names the one at fault.
            let _: Self = tree.clone().try_into().map_err(|e: toml::de::Error| fail(error::in_plain_words(e.message())))?;
        }
        tree.try_into().map_err(|e: toml::de::Error| ConfigError::Override { given: overrides.join(" "), message: e.message().to_owned() })
    }
}

#[cfg(test)]
mod tests;
