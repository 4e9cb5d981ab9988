//! `[flow]` of a scene file.

use super::{Boundary, Integrator, Interpolation, Normalisation, Precision};
use ridgewatch_base::setting::{Refused, count, positive};
use serde::{Deserialize, Deserializer, Serialize};

/// `steps = 40` or `steps = "auto"`.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
#[serde(untagged)]
pub enum StepsSetting {
    /// A given number.
    Fixed(usize),
    /// Chosen by error.
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
    /// Method that finds J.
    pub integrator: Integrator,
    /// Floating-point type.
    pub precision: Precision,
    /// Runge-Kutta steps per path.
    pub steps: StepsSetting,
    /// With `steps = "auto"`: root mean square by which the log-stretch may change if the steps are doubled. `None`: 0.01 for closed forms,
    /// 0.1 for grids, whose interpolated gradient converges slowly, and with linear interpolation also 1.5 % of the log-stretch. The summary
    /// contains the value reached. Smooth pictures then take fewer steps if their colours do not tell them apart.
    pub tolerance: Option<f64>,
    /// Distance of the particles of `differences` from the seed, in coordinate units.
    pub difference_step: f64,
    /// Boundary policy; `None`: `unbounded` for closed forms, `stop` for archives, `clamp` for the synthetic turbulence.
    pub boundary: Option<Boundary>,
    /// Divisor for particles that stopped early.
    pub normalisation: Normalisation,
    /// Interpolation in space; `None`: cubic for two-dimensional archives, linear otherwise.
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
    /// Checks ranges and combinations. `gridded`: the velocity ends at a grid.
    ///
    /// # Errors
    /// The key at fault and the values that it accepts.
    pub fn check(&self, gridded: bool) -> Result<(), Refused> {
        if let StepsSetting::Fixed(steps) = self.steps {
            count("flow.steps", steps, 1, 10_000_000)?;
        }
        if let Some(tolerance) = self.tolerance {
            positive("flow.tolerance", tolerance)?;
        }
        positive("flow.difference_step", self.difference_step)?;
        if gridded && self.boundary == Some(Boundary::Unbounded) {
            let accepted = "stop, clamp, periodic or zero: gridded velocity ends at its grid";
            return Err(Refused::new("flow.boundary", "is \"unbounded\"", accepted));
        }
        if self.integrator == Integrator::DormandPrince && self.precision == Precision::F32 {
            let accepted = "\"f64\" with integrator = \"dormand_prince\", which is the reference";
            return Err(Refused::new("flow.precision", "is \"f32\"", accepted));
        }
        Ok(())
    }
}
