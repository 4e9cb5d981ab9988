//! `[flow]` of a scene file.

use super::{Boundary, Integrator, Interpolation, Normalisation, Precision};
use crate::setting::{Refused, count, positive};
use serde::{Deserialize, Deserializer, Serialize};

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
    /// and the synthetic turbulence, 0.1 for archives, whose interpolated gradient
    /// converges slowly. What was reached is in the summary.
    pub tolerance: Option<f64>,
    /// Distance of difference particles, in coordinate units.
    pub difference_step: f64,
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
            difference_step: 1e-4,
            boundary: None,
            normalisation: Normalisation::Tau,
            interpolation: None,
        }
    }
}

impl FlowSettings {
    /// Checks ranges, and what does not go together; `gridded` tells whether the velocity ends at a grid.
    pub fn check(&self, gridded: bool) -> Result<(), Refused> {
        let flow = self;
        if let StepsSetting::Fixed(steps) = flow.steps {
            count("flow.steps", steps, 1, 10_000_000)?;
        }
        if let Some(tolerance) = flow.tolerance {
            positive("flow.tolerance", tolerance)?;
        }
        positive("flow.difference_step", flow.difference_step)?;
        if gridded && flow.boundary == Some(Boundary::Unbounded) {
            refuse("flow.boundary", "is \"unbounded\"", "stop, clamp, periodic or zero: gridded velocity ends at its grid")?;
        }
        if flow.integrator == Integrator::DormandPrince && flow.precision == Precision::F32 {
            refuse("flow.precision", "is \"f32\"", "\"f64\" with integrator = \"dormand_prince\", which is the reference")?;
        }
        Ok(())
    }
}

fn refuse(key: &str, found: &str, accepted: &str) -> Result<(), Refused> {
    Err(Refused::new(key, found, accepted))
}
