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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn slopes_are_those_of_the_map() {
        let map = ToneMap::new([1.85, 0.75, 1.4]);
        let exact = |c: f64| ((c - 0.5) * 1.85 + 0.75).clamp(0.0, 1.0).powf(1.0 / 1.4);
        // Black lies at 0.095 and white at 0.635.
        for (at, from) in [(0.2, 0.5), (0.5, 0.2), (0.05, 0.4), (0.4, 0.05), (0.3, 0.9), (0.9, 0.3), (0.7, 0.8)] {
            let secant = (exact(at) - exact(from)) / (at - from);
            assert!((f64::from(map.secant(at as f32, from as f32)) - secant).abs() < 1e-5, "{at}, {from}");
        }
        for at in [0.12, 0.3, 0.6] {
            let slope = (exact(at + 1e-5) - exact(at - 1e-5)) / 2e-5;
            for found in [map.slope(at as f32), map.secant(at as f32, at as f32), map.secant(at as f32, at as f32 + 5e-4)] {
                assert!((f64::from(found) / slope - 1.0).abs() < 1e-3, "{at}: {found}, {slope}");
            }
        }
        assert_eq!([map.slope(0.05), map.slope(0.7), map.secant(0.7, 0.7)], [0.0; 3]);
    }
}
