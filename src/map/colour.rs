//! Colours of a map: ramps, and the range of values that they show.

use super::ridges::percentile;
use serde::Serialize;

/// Colour map. All three come from the crate `colorous`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Ramp {
    /// Viridis (Smith and van der Walt 2015): perceptually uniform, also with colour blindness.
    Viridis,
    /// ColorBrewer's Reds, from white: forward FTLE beside backward.
    Reds,
    /// ColorBrewer's Blues, from white: backward FTLE beside forward.
    Blues,
}

impl Ramp {
    /// Name for the record and the picture.
    pub fn name(self) -> &'static str {
        match self {
            Self::Viridis => "viridis",
            Self::Reds => "ColorBrewer Reds",
            Self::Blues => "ColorBrewer Blues",
        }
    }

    /// Colour at a share of the range; beyond 0 and 1 that of the ends.
    pub fn colour(self, share: f64) -> [u8; 3] {
        let gradient = match self {
            Self::Viridis => colorous::VIRIDIS,
            Self::Reds => colorous::REDS,
            Self::Blues => colorous::BLUES,
        };
        let colour = gradient.eval_continuous(share.clamp(0.0, 1.0)).as_array();
        if self == Self::Viridis {
            return colour;
        }
        // ColorBrewer's ramps begin slightly tinted; two of them together begin at white.
        let first = gradient.eval_continuous(0.0).as_array();
        std::array::from_fn(|k| (f64::from(colour[k]) * 255.0 / f64::from(first[k])).min(255.0).round() as u8)
    }
}

/// Two colours printed over each other.
pub fn overprinted(a: [u8; 3], b: [u8; 3]) -> [u8; 3] {
    std::array::from_fn(|k| (u16::from(a[k]) * u16::from(b[k]) / 255) as u8)
}

/// Land and missing cells.
pub const LAND: [u8; 3] = [190, 190, 190];
/// Outside of the data.
pub const OUTSIDE: [u8; 3] = [255, 255, 255];

/// Range of colours: from 0, or the first percentile if that is negative or far from 0, to percentile 99.5. With two ramps it begins at the median, so
/// that white is what stretches little.
pub fn range(means: &[&[f32]], two: bool) -> [f64; 2] {
    let mut known: Vec<f64> = means.iter().flat_map(|m| m.iter()).filter(|v| v.is_finite()).map(|v| f64::from(*v)).collect();
    if known.is_empty() {
        return [0.0, 1.0];
    }
    known.sort_unstable_by(f64::total_cmp);
    let (low, high) = (percentile(&known, if two { 40.0 } else { 1.0 }), percentile(&known, 99.5));
    let low = if !two && low >= 0.0 && low < 0.5 * high { 0.0 } else { low };
    if high > low + 1e-6 * high.abs() { [low, high] } else { [low - 0.5 * low.abs().max(1e-9), low + 0.5 * low.abs().max(1e-9)] }
}
