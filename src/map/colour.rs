//! Colours of a map: ramps, and the range of values that they show.

use crate::render::{map_range, viridis};
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
            Self::Viridis => return viridis(share),
            Self::Reds => colorous::REDS,
            Self::Blues => colorous::BLUES,
        };
        let colour = gradient.eval_continuous(share.clamp(0.0, 1.0)).as_array();
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

/// Range of colours over several fields ([`map_range`]); with two ramps it begins at white.
pub fn range(means: &[&[f32]], two: bool) -> [f64; 2] {
    map_range(means.iter().flat_map(|mean| mean.iter().copied()), two)
}
