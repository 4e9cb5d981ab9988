//! The tone map, and how far two radiances are apart in it.

/// Radiances closer than this are told apart by the slope of the tone map.
const CLOSE: f32 = 1e-3;

/// The tone map ((c - 0.5) contrast + brightness)^(1 / gamma), clamped to [0, 1].
#[derive(Debug, Clone, Copy)]
pub struct ToneMap {
    contrast: f32,
    brightness: f32,
    gamma: f32,
}

impl ToneMap {
    /// Takes `[contrast, brightness, gamma]`.
    pub fn new(parameters: [f64; 3]) -> Self {
        let [contrast, brightness, gamma] = parameters.map(|v| v as f32);
        Self { contrast, brightness, gamma }
    }

    fn value(self, radiance: f32) -> f32 {
        (radiance - 0.5) * self.contrast + self.brightness
    }

    /// The map is constant where it saturates, and steep without bound at black; one 8-bit step bounds it.
    pub fn slope(self, radiance: f32) -> f32 {
        let value = self.value(radiance);
        let slope = self.contrast / self.gamma * value.max(1.0 / 255.0).powf(1.0 / self.gamma - 1.0);
        if value <= 0.0 || value >= 1.0 { 0.0 } else { slope }
    }

    /// Slope between the radiances `at` and `from`; of the map `at` itself where they are the same.
    pub fn secant(self, at: f32, from: f32) -> f32 {
        let mapped = |radiance: f32| self.value(radiance).clamp(0.0, 1.0).powf(1.0 / self.gamma);
        let apart = at - from;
        if apart.abs() < CLOSE { self.slope(at) } else { (mapped(at) - mapped(from)) / apart }
    }
}

/// Squared slope of the tone map `[contrast, brightness, gamma]` at a radiance.
pub fn squared_slope(tone_map: [f64; 3], radiance: f32) -> f32 {
    ToneMap::new(tone_map).slope(radiance).powi(2)
}
