//! The tables `[camera]`, `[light]`, `[transfer]` and `[render]` of a scene file.

use super::albedo::{albedo_preset, published_albedo};
use super::error::{RenderError, require};
use super::map_picture::MAP_TONE;
use super::projection::ProjectionKind;
use super::smooth::PictureError;
use serde::{Deserialize, Deserializer, Serialize};

/// Factor by which the upper end of the interval of the mean square error may miss `until`: 0.8 dB.
pub const UNTIL_SLACK: f64 = 1.2;
/// Largest number of frames that `until` gives a slide.
pub const MAX_FRAMES_UNTIL: usize = 4096;
/// Largest picture edge, in pixels.
const MAX_EDGE: usize = 16_384;
/// Largest number of pixels; their film takes 3 GB.
const MAX_PIXELS: usize = 1 << 26;
/// Largest number of samples per pixel in one call.
pub const MAX_SAMPLES: usize = 1 << 24;
/// Largest number of majorant cells along one axis.
const MAX_CELLS: usize = 1024;

/// Source of the answers to log-stretch queries.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Method {
    /// RK4 only.
    Reference,
    /// The surrogate only.
    #[serde(alias = "neural")]
    Surrogate,
    /// The surrogate where it is trusted, RK4 elsewhere.
    Gated,
    /// The surrogate's expected picture, marched; traced samples measure its error.
    Marched,
    /// The marched picture, corrected by traced samples.
    #[serde(rename = "two_level")]
    TwoLevel,
    /// The FTLE itself of a flow of two dimensions, as a map: the mean over each pixel, traced.
    Map,
    /// As [`Method::Default`]; where that is `two_level`, `marched` or `reference` takes over if it wins a race in the run.
    Auto,
    /// `map` for flows of two dimensions, unless the scene sets what only volumes have ([`Method::or_default`]), and `two_level` for others. The default.
    /// A run itself has one of the others.
    Default,
}

impl Method {
    /// Name in scene files and records.
    pub fn name(self) -> &'static str {
        match self {
            Self::Reference => "reference",
            Self::Surrogate => "surrogate",
            Self::Gated => "gated",
            Self::Marched => "marched",
            Self::TwoLevel => "two_level",
            Self::Map => "map",
            Self::Auto => "auto",
            Self::Default => "default",
        }
    }

    /// True if a surrogate answers queries, or may do so.
    pub fn has_surrogate(self) -> bool {
        !matches!(self, Self::Reference | Self::Map)
    }

    /// True if the surrogate is marched ([`super::smooth`]), or may be.
    pub fn is_smooth(self) -> bool {
        matches!(self, Self::Marched | Self::TwoLevel | Self::Auto | Self::Default)
    }

    /// True if the picture accumulates and its error is stated, or may be.
    pub fn accumulates(self) -> bool {
        self.is_smooth() || self == Self::Map
    }

    /// The method, or what `default` stands for.
    pub fn or_default(self, is_map: bool) -> Self {
        match self {
            Self::Default if is_map => Self::Map,
            Self::Default => Self::TwoLevel,
            other => other,
        }
    }
}

/// Projection of a map of longitudes and latitudes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ProjectionChoice {
    /// The one that fits the region ([`ProjectionKind::fitting`]); plain if the scene sets a camera, whose lengths are degrees.
    Auto,
    /// [`ProjectionKind::PlateCarree`].
    PlateCarree,
    /// [`ProjectionKind::Mercator`].
    Mercator,
    /// [`ProjectionKind::Lambert`].
    Lambert,
    /// [`ProjectionKind::Polar`].
    Polar,
    /// [`ProjectionKind::Plain`].
    Plain,
}

impl ProjectionChoice {
    /// The kind that is named; `None` for `auto`.
    pub fn kind(self) -> Option<ProjectionKind> {
        match self {
            Self::Auto => None,
            Self::PlateCarree => Some(ProjectionKind::PlateCarree),
            Self::Mercator => Some(ProjectionKind::Mercator),
            Self::Lambert => Some(ProjectionKind::Lambert),
            Self::Polar => Some(ProjectionKind::Polar),
            Self::Plain => Some(ProjectionKind::Plain),
        }
    }
}

/// How the correction of a `two_level` picture is added.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Combine {
    /// Shrunk: the smallest error. Biased by what it takes for noise; the bias vanishes as samples come.
    Shrink,
    /// As it is: noisier, and unbiased (on a GPU but for what half precision loses of the field).
    Sum,
}

/// Stated error at which a smooth picture is good enough: `"40dB"` (PSNR over lit pixels) or `"relmse=1e-3"`.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub enum Target {
    /// PSNR of the tone-mapped picture over lit pixels, in decibels.
    Psnr(f64),
    /// Mean of squared error / (radiance^2 + 0.01) over lit pixels.
    Relmse(f64),
}

impl Target {
    /// True if a stated error is within the target, and the worse end of its interval at most `UNTIL_SLACK` beyond it. The estimate alone is within it
    /// too early: of many frames, a lucky one stops.
    pub fn is_met_by(self, error: &PictureError) -> bool {
        match self {
            Self::Psnr(decibels) => error.psnr.value >= decibels && error.psnr.low >= decibels - 10.0 * UNTIL_SLACK.log10(),
            Self::Relmse(most) => error.relmse.value <= most && error.relmse.high <= UNTIL_SLACK * most,
        }
    }
}

impl TryFrom<String> for Target {
    type Error = String;

    fn try_from(text: String) -> Result<Self, String> {
        text.parse()
    }
}

impl std::str::FromStr for Target {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let accepted =
            || format!("{text:?} is not accepted; accepted: decibels such as \"40dB\" (1 to 80), or \"relmse=1e-3\" (1e-9 to 1)");
        let number = |digits: &str, range: std::ops::RangeInclusive<f64>| {
            digits.trim().parse().ok().filter(|v| range.contains(v)).ok_or_else(accepted)
        };
        let lower = text.trim().to_ascii_lowercase();
        match (lower.strip_suffix("db"), lower.strip_prefix("relmse=")) {
            (Some(decibels), _) => Ok(Self::Psnr(number(decibels, 1.0..=80.0)?)),
            (_, Some(most)) => Ok(Self::Relmse(number(most, 1e-9..=1.0)?)),
            _ => Err(accepted()),
        }
    }
}

impl std::fmt::Display for Target {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Psnr(decibels) => write!(f, "{decibels}dB"),
            Self::Relmse(most) => write!(f, "relmse={most:e}"),
        }
    }
}

impl From<Target> for String {
    fn from(target: Target) -> Self {
        target.to_string()
    }
}

/// `[camera]` of a scene file. `half_width = |look_at - eye| tan(field_of_view/2)`, `half_height = |look_at - eye| tan(field_of_view/(2 aspect))`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CameraSettings {
    /// Position.
    pub eye: [f64; 3],
    /// Point looked at.
    pub look_at: [f64; 3],
    /// Up.
    pub up: [f64; 3],
    /// Horizontal field of view, degrees.
    #[serde(default = "ninety")]
    pub field_of_view: f64,
    /// Parallel projection. The film plane has the half-width above and the half-height `half_width / aspect`.
    #[serde(default)]
    pub orthographic: bool,
}

fn ninety() -> f64 {
    90.0
}

/// `[light]` of a scene file.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LightSettings {
    /// Direction in which photons fly (directional light). Exactly one of `direction` and `position` is given.
    pub direction: Option<[f64; 3]>,
    /// Position of a point light.
    pub position: Option<[f64; 3]>,
    /// Radiance (directional) or radiant intensity (point).
    pub radiance: [f64; 3],
}

/// `[transfer]` of a scene file: extinction = `extinction` * ramp(FTLE), ramp = saturate((FTLE - low) / (high - low)); albedo per
/// channel is a polynomial in t = 1 - ramp, lowest power first.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct TransferSettings {
    /// FTLE at which the extinction begins. `None`: median of the FTLE of the first frame.
    pub low: Option<f64>,
    /// FTLE at which the extinction saturates. `None`: 99.5th percentile of the FTLE of the first frame.
    pub high: Option<f64>,
    /// Largest extinction, per unit of length. `None`: 12 over the shortest visible edge of the domain.
    pub extinction: Option<f64>,
    /// Polynomial coefficients of the red, green and blue albedo, lowest power first. A scene file may name a preset instead
    /// ([`super::ALBEDO_PRESETS`]).
    #[serde(deserialize_with = "albedo_or_preset")]
    pub albedo: [Vec<f64>; 3],
}

impl Default for TransferSettings {
    /// Range of the first frame, colours of the published renderer.
    fn default() -> Self {
        Self { low: None, high: None, extinction: None, albedo: published_albedo() }
    }
}

/// A value of `transfer.albedo`: coefficients, or the name of a preset.
#[derive(Debug, Clone, PartialEq, Deserialize)]
pub struct Albedo(#[serde(deserialize_with = "albedo_or_preset")] pub [Vec<f64>; 3]);

fn albedo_or_preset<'de, D: Deserializer<'de>>(deserializer: D) -> Result<[Vec<f64>; 3], D::Error> {
    #[derive(Deserialize)]
    #[serde(untagged, expecting = "accepted: the name of a preset, or three lists of polynomial coefficients")]
    enum Given {
        Preset(String),
        Coefficients([Vec<f64>; 3]),
    }
    match Given::deserialize(deserializer)? {
        Given::Coefficients(albedo) => Ok(albedo),
        Given::Preset(name) => albedo_preset(&name).map_err(serde::de::Error::custom),
    }
}

/// `[render]` of a scene file.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct RenderSettings {
    /// Method.
    pub method: Method,
    /// Pixels across.
    pub width: usize,
    /// Pixels down.
    pub height: usize,
    /// `map`: projection of longitudes and latitudes.
    pub projection: ProjectionChoice,
    /// Samples per pixel and frame. Smooth methods accept fractions; `marched` takes twice [`super::smooth::AUDIT_PAIRS`] instead, and `map` the next even
    /// number.
    pub samples: f64,
    /// How the correction of `two_level` is added.
    pub combine: Combine,
    /// Smooth methods and `map`: stated error at which a slide needs no further frames (see [`Target::is_met_by`]). A slide gets frames until then, at most
    /// `MAX_FRAMES_UNTIL`.
    pub until: Option<Target>,
    /// `two_level`: milliseconds of coupled samples per frame, instead of `samples`.
    pub budget: Option<f64>,
    /// Background colour, linear.
    pub background: [f64; 3],
    /// Colour (linear) of missing cells, seen by camera paths that leave the box through them.
    pub missing_color: [f64; 3],
    /// Majorant cells along x, y, z. `None`: chosen from the domain.
    pub majorant_cells: Option<[usize; 3]>,
    /// Tone map: `((c - 0.5) * contrast + brightness)^(1/gamma)`: `[contrast, brightness, gamma]`.
    pub tone_map: [f64; 3],
}

impl Default for RenderSettings {
    fn default() -> Self {
        Self {
            method: Method::Default,
            width: 320,
            height: 160,
            projection: ProjectionChoice::Auto,
            samples: 8.0,
            combine: Combine::Shrink,
            until: None,
            budget: None,
            background: [1.0; 3],
            missing_color: [0.3; 3],
            majorant_cells: None,
            tone_map: [1.85, 0.75, 1.4],
        }
    }
}

impl RenderSettings {
    /// Width over height.
    pub fn aspect(&self) -> f64 {
        self.width as f64 / self.height as f64
    }

    /// Tone map of pictures of a method: a map has its own.
    pub fn tone_map_of(&self, method: Method) -> [f64; 3] {
        if method == Method::Map { MAP_TONE } else { self.tone_map }
    }

    /// Checks every range.
    ///
    /// # Errors
    /// The first key at fault and the values that it accepts.
    pub fn check(&self) -> Result<(), RenderError> {
        let settings = self;
        let size = "1 to 16384 pixels";
        require((1..=MAX_EDGE).contains(&settings.width), "render.width", settings.width, size)?;
        require((1..=MAX_EDGE).contains(&settings.height), "render.height", settings.height, size)?;
        let pixels = settings.width * settings.height;
        require(pixels <= MAX_PIXELS, "render.width", settings.width, "at most 67108864 pixels in all")?;
        let samples = settings.samples;
        if settings.method.accumulates() {
            let accepted = "1/64 to 4096 with this render.method";
            require((1.0 / 64.0..=4096.0).contains(&samples), "render.samples", samples, accepted)?;
        } else {
            let whole = samples.fract() == 0.0 && (1.0..=MAX_SAMPLES as f64).contains(&samples);
            require(whole, "render.samples", samples, "a whole number from 1 to 16777216 with this render.method")?;
        }
        if let Some(budget) = settings.budget {
            require((0.1..=600_000.0).contains(&budget), "render.budget", budget, "milliseconds, 0.1 to 600000")?;
        }
        if let Some(until) = settings.until {
            let accepted = "render.method = \"map\", \"marched\" or \"two_level\" with it";
            require(settings.method.accumulates(), "render.until", until.to_string(), accepted)?;
        }
        // A marched picture has a fixed number of samples.
        if let Some(budget) = settings.budget {
            let fits = matches!(settings.method, Method::TwoLevel | Method::Auto | Method::Default);
            require(fits, "render.budget", budget, "render.method = \"two_level\" with it")?;
        }
        let colour = |c: [f64; 3]| c.iter().all(|v| v.is_finite() && *v >= 0.0);
        require(colour(settings.background), "render.background", settings.background, "three finite numbers, 0 or above")?;
        require(colour(settings.missing_color), "render.missing_color", settings.missing_color, "three finite numbers, 0 or above")?;
        let [contrast, brightness, gamma] = settings.tone_map;
        let tone_map = "[contrast, brightness, gamma]: finite numbers, gamma above 0";
        require(contrast.is_finite() && brightness.is_finite(), "render.tone_map", settings.tone_map, tone_map)?;
        require(gamma.is_finite() && gamma > 0.0, "render.tone_map", settings.tone_map, tone_map)?;
        if let Some(cells) = settings.majorant_cells {
            require(cells.iter().all(|n| (1..=MAX_CELLS).contains(n)), "render.majorant_cells", cells, "1 to 1024 cells along each axis")?;
            require(cells.iter().product::<usize>() <= 1 << 24, "render.majorant_cells", cells, "at most 16777216 cells in all")?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::smooth::ErrorEstimate;

    #[test]
    fn a_marched_picture_has_no_budget() {
        let given = |method| RenderSettings { method, budget: Some(50.0), ..RenderSettings::default() }.check();
        assert!(given(Method::TwoLevel).is_ok());
        assert!(given(Method::Marched).unwrap_err().to_string().contains("render.budget"));
    }

    #[test]
    fn a_target_is_met_with_its_interval() {
        let stated = |value, low, high| ErrorEstimate { value, low, high };
        let met = |relmse, psnr| {
            let error = PictureError { relmse, psnr, ..PictureError::default() };
            [Target::Relmse(0.1), Target::Psnr(40.0)].map(|target| target.is_met_by(&error))
        };
        assert_eq!(met(stated(0.09, 0.07, 0.11), stated(40.5, 39.4, 41.5)), [true, true]);
        assert_eq!(met(stated(0.09, 0.05, 0.13), stated(40.5, 39.0, 42.0)), [false, false], "an interval that is too wide");
        assert_eq!(met(stated(0.11, 0.11, 0.11), stated(39.9, 39.9, 39.9)), [false, false]);
    }
}
