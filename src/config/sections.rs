//! The tables that belong to no single room.

use crate::flow::{Boundary, Direction, Integrator, Interpolation, Normalisation, Precision};
use serde::{Deserialize, Deserializer, Serialize};

/// Where velocity comes from.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum SourceKind {
    /// Double gyre.
    DoubleGyre,
    /// Arnold-Beltrami-Childress flow.
    Abc,
    /// Linear saddle.
    Saddle,
    /// Solid rotation.
    Rotation,
    /// Plane shear.
    Shear,
    /// The standard synthetic turbulence, sampled on a grid.
    Turbulence,
    /// NetCDF files (`[archive]`).
    Archive,
}

/// `[source]`. Parameters that the kind does not have are refused.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SourceSettings {
    /// Which.
    pub kind: SourceKind,
    /// Double gyre: A (0.1). Turbulence: root mean square of |v|, cells a snapshot at 192 cells along the short side (3).
    pub amplitude: Option<f64>,
    /// Double gyre: eps (0.25).
    pub epsilon: Option<f64>,
    /// Double gyre (2 pi / 10) and rotation (1): radians per time unit.
    pub omega: Option<f64>,
    /// Saddle and shear: rate (1).
    pub rate: Option<f64>,
    /// ABC: A (sqrt 3).
    pub a: Option<f64>,
    /// ABC: B (sqrt 2).
    pub b: Option<f64>,
    /// ABC: C (1).
    pub c: Option<f64>,
    /// ABC: growth of A in time (0; Haller's unsteady flow has 0.5).
    pub growth: Option<f64>,
    /// Turbulence: nodes along x, y and z (96, 48, 48).
    pub nodes: Option<[usize; 3]>,
    /// Turbulence: number of modes (48).
    pub modes: Option<usize>,
    /// Turbulence: largest wave number in cycles per short side (14).
    pub k_max: Option<f64>,
    /// Turbulence: number of snapshots (12).
    pub snapshots: Option<usize>,
}

/// `[domain]`: the box of a closed form.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DomainSettings {
    /// Lower corner.
    pub min: [f64; 3],
    /// Upper corner.
    pub max: [f64; 3],
}

/// A number in the source's time unit, or words such as `"30 days"` where that unit is the second.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(untagged)]
pub enum TimeSpan {
    /// In time units of the source.
    Number(f64),
    /// With a unit.
    Words(String),
}

impl TimeSpan {
    /// The span in seconds where it has a unit; the plain number otherwise. None where the words make no sense.
    pub fn value(&self) -> Option<f64> {
        let words = match self {
            TimeSpan::Number(n) => return Some(*n),
            TimeSpan::Words(words) => words.trim(),
        };
        let split = words.find(|c: char| c.is_ascii_alphabetic() && c != 'e' && c != 'E')?;
        let (number, unit) = words.split_at(split);
        let factor = match unit.trim().trim_end_matches('s') {
            "" | "sec" | "second" => 1.0,
            "min" | "minute" => 60.0,
            "h" | "hr" | "hour" => 3600.0,
            "d" | "day" => 86_400.0,
            "week" => 604_800.0,
            _ => return None,
        };
        number.trim().parse::<f64>().ok().map(|n| n * factor)
    }

    /// Whether the span names a unit.
    pub fn has_unit(&self) -> bool {
        matches!(self, TimeSpan::Words(_))
    }
}

/// `[time]`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct TimeSettings {
    /// |tau|; none: half of the archive's span, at least two intervals (closed forms need it).
    pub tau: Option<TimeSpan>,
    /// Forward or backward; none: backward for archives, forward for closed forms.
    pub direction: Option<Direction>,
    /// Closed forms: seed time of the first slide.
    pub start: f64,
    /// Closed forms: how far the seed time moves from slide to slide.
    pub step: f64,
    /// Closed forms: number of slides. Archives: an upper bound; none: as many as the archive gives.
    pub slides: Option<usize>,
    /// Archives: snapshots that the window moves from slide to slide.
    pub stride: usize,
    /// Frames rendered at each slide.
    pub frames_per_slide: usize,
    /// Further frames at the first slide, in which the surrogate is trained up.
    pub warmup_frames: usize,
}

impl Default for TimeSettings {
    fn default() -> Self {
        Self { tau: None, direction: None, start: 0.0, step: 1.0, slides: None, stride: 1, frames_per_slide: 1, warmup_frames: 0 }
    }
}

/// `steps = 40` or `steps = "auto"`.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
#[serde(untagged)]
pub enum StepsSetting {
    /// This many.
    Fixed(usize),
    /// By error.
    #[serde(serialize_with = "auto_word")]
    Auto,
}

fn auto_word<S: serde::Serializer>(serializer: S) -> Result<S::Ok, S::Error> {
    serializer.serialize_str("auto")
}

impl<'de> Deserialize<'de> for StepsSetting {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct Visitor;
        impl serde::de::Visitor<'_> for Visitor {
            type Value = StepsSetting;
            fn expecting(&self, f: &mut std::fmt::Formatter) -> std::fmt::Result {
                f.write_str("a whole number of steps above 0, or \"auto\"")
            }
            fn visit_i64<E: serde::de::Error>(self, n: i64) -> Result<StepsSetting, E> {
                usize::try_from(n)
                    .ok()
                    .filter(|&n| n > 0)
                    .map(StepsSetting::Fixed)
                    .ok_or_else(|| E::invalid_value(serde::de::Unexpected::Signed(n), &self))
            }
            fn visit_u64<E: serde::de::Error>(self, n: u64) -> Result<StepsSetting, E> {
                self.visit_i64(i64::try_from(n).unwrap_or(-1))
            }
            fn visit_str<E: serde::de::Error>(self, word: &str) -> Result<StepsSetting, E> {
                if word == "auto" { Ok(StepsSetting::Auto) } else { Err(E::invalid_value(serde::de::Unexpected::Str(word), &self)) }
            }
        }
        deserializer.deserialize_any(Visitor)
    }
}

/// `[flow]`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct FlowSettings {
    /// How J is found.
    pub integrator: Integrator,
    /// Floating-point type.
    pub precision: Precision,
    /// Runge-Kutta steps a path.
    pub steps: StepsSetting,
    /// With `steps = "auto"`: root mean square of the log-stretch that a doubling of the steps may change; none: 0.01 for closed forms
    /// and the synthetic turbulence, 0.5 for archives, whose interpolated gradient
    /// converges slowly. What was reached is in the summary.
    pub tolerance: Option<f64>,
    /// Distance of difference particles, in coordinate units.
    pub gap: f64,
    /// Edge policy; none: `unbounded` for closed forms, `stop` for archives, `clamp` for the synthetic turbulence.
    pub boundary: Option<Boundary>,
    /// Divisor for particles that stopped early.
    pub normalisation: Normalisation,
    /// Interpolation in space; none: cubic for two-dimensional archives, linear otherwise.
    pub interpolation: Option<Interpolation>,
}

impl Default for FlowSettings {
    fn default() -> Self {
        Self {
            integrator: Integrator::Tangent,
            precision: Precision::F32,
            steps: StepsSetting::Auto,
            tolerance: None,
            gap: 1e-4,
            boundary: None,
            normalisation: Normalisation::Tau,
            interpolation: None,
        }
    }
}

/// `[training]`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct TrainingSettings {
    /// Share of the threads that train while the others render (at least one thread each; with a single thread they take turns).
    pub share: f64,
    /// Wall-clock seconds of training that every frame gets at least: the next frame waits for them.
    pub seconds_per_frame: f64,
    /// Exactly so many optimizer steps a frame instead: slower, but the same on every run.
    pub steps_per_frame: Option<u64>,
    /// Samples that the ring holds.
    pub ring: usize,
    /// Checkpoint to go on from.
    pub resume: Option<std::path::PathBuf>,
}

impl Default for TrainingSettings {
    fn default() -> Self {
        Self { share: 0.5, seconds_per_frame: 1.0, steps_per_frame: None, ring: 1 << 20, resume: None }
    }
}
