//! The light: directional or point.

use super::LightSettings;
use super::error::{RenderError, require, require_finite};
use super::parameters::LightParameters;
use super::space::{length, scaled, subtract};

/// A checked light, in scene units.
#[derive(Debug, Clone, PartialEq)]
pub enum Light {
    /// Parallel photons.
    Directional {
        /// Unit vector toward the light.
        toward: [f64; 3],
        /// Radiance of the red, green and blue channel.
        radiance: [f32; 3],
    },
    /// An isotropic point light.
    Point {
        /// Position.
        position: [f64; 3],
        /// Radiant intensity of the red, green and blue channel.
        intensity: [f32; 3],
    },
}

impl LightSettings {
    /// Photons flying along `direction`, with the same radiance in each channel.
    pub fn directional(direction: [f64; 3], radiance: f64) -> Self {
        Self { direction: Some(direction), position: None, radiance: [radiance; 3] }
    }
}

impl Light {
    /// Checks the settings.
    ///
    /// # Errors
    /// The first key at fault and the values that it accepts.
    pub fn new(settings: &LightSettings) -> Result<Self, RenderError> {
        let radiance = settings.radiance;
        require(radiance.iter().all(|r| r.is_finite() && *r >= 0.0), "light.radiance", radiance, "three finite numbers, 0 or above")?;
        let radiance = radiance.map(|r| r as f32);
        match (settings.direction, settings.position) {
            (Some(direction), None) => {
                require_finite("light.direction", &direction)?;
                let norm = length(direction);
                require(norm > 0.0 && norm.is_finite(), "light.direction", direction, "a vector that is not zero")?;
                Ok(Self::Directional { toward: scaled(direction, -1.0 / norm), radiance })
            }
            (None, Some(position)) => {
                require_finite("light.position", &position)?;
                Ok(Self::Point { position, intensity: radiance })
            }
            (direction, _) => {
                let found = if direction.is_some() { "both `direction` and `position`" } else { "neither `direction` nor `position`" };
                Err(RenderError::Invalid { key: "light", found: format!("given {found}"), accepted: "exactly one of them" })
            }
        }
    }

    pub(super) fn parameters(&self) -> LightParameters {
        match *self {
            Self::Directional { toward, radiance } => LightParameters { vector: toward, radiance, is_point: 0 },
            Self::Point { position, intensity } => LightParameters { vector: position, radiance: intensity, is_point: 1 },
        }
    }

    /// Unit vector toward the light, distance to it, and the radiance that arrives at `point` through empty space.
    #[inline]
    pub(super) fn seen_from(&self, point: [f64; 3]) -> ([f64; 3], f64, [f32; 3]) {
        match self {
            Self::Directional { toward, radiance } => (*toward, f64::INFINITY, *radiance),
            Self::Point { position, intensity } => {
                let offset = subtract(*position, point);
                // A scattering event exactly at the light has probability 0; the floor keeps its numbers finite.
                let distance = length(offset).max(1e-12);
                let falloff = 1.0 / (distance * distance);
                (scaled(offset, 1.0 / distance), distance, intensity.map(|i| (f64::from(i) * falloff) as f32))
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn exactly_one_of_direction_and_position() {
        let mut settings = LightSettings::directional([0.0, 0.0, -2.0], 12.0);
        assert_eq!(Light::new(&settings).unwrap().seen_from([3.0; 3]).0, [0.0, 0.0, 1.0]);
        settings.position = Some([0.0; 3]);
        assert_eq!(
            Light::new(&settings).unwrap_err().to_string(),
            "`light` is given both `direction` and `position`; accepted: exactly one of them"
        );
        settings.direction = None;
        assert!(Light::new(&settings).is_ok());
        settings.position = None;
        assert!(Light::new(&settings).unwrap_err().to_string().contains("neither"));
        assert!(Light::new(&LightSettings::directional([0.0; 3], 1.0)).unwrap_err().to_string().contains("light.direction"));
        assert!(Light::new(&LightSettings::directional([1.0; 3], f64::NAN)).unwrap_err().to_string().contains("light.radiance"));
    }

    #[test]
    fn a_point_light_falls_off_with_the_square_of_distance() {
        let light = Light::Point { position: [0.0, 0.0, 2.0], intensity: [8.0; 3] };
        assert_eq!(light.seen_from([0.0; 3]), ([0.0, 0.0, 1.0], 2.0, [2.0; 3]));
    }
}
