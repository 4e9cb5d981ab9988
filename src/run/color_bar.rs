//! The colours of the transfer function, for a colour bar beside the picture.

use crate::render::{Film, Transfer};
use serde::{Deserialize, Serialize};

/// Colours of a bar.
const COLORS: usize = 32;

/// Colours that the FTLE has under white light of radiance 1, in 8 bits, tone-mapped as the picture is.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ColorBar {
    /// R, G, B at FTLE values evenly spaced from `low` to `high`.
    pub colors: Vec<[u8; 3]>,
    /// FTLE at which extinction begins; below it nothing is seen.
    pub low: f64,
    /// FTLE from which extinction is full.
    pub high: f64,
    /// Unit of the FTLE, such as `1/s`; empty if the source's times have none.
    pub unit: String,
}

impl ColorBar {
    /// Colours between two values of the FTLE. `time_unit` may be empty.
    pub fn new(transfer: &Transfer, [low, high]: [f64; 2], tone_map: [f64; 3], time_unit: &str) -> Self {
        let at = |i: usize| low + (high - low) * i as f64 / (COLORS - 1) as f64;
        let colour = |i| {
            let [r, g, b] = transfer.albedo(at(i) as f32);
            [r, g, b, 1.0]
        };
        let film = Film { width: COLORS, height: 1, rgba: (0..COLORS).map(colour).collect(), ..Film::default() };
        let colors = film.tone_mapped(tone_map).as_chunks().0.to_vec();
        let unit = if time_unit.is_empty() { String::new() } else { format!("1/{time_unit}") };
        Self { colors, low, high, unit }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::render::TransferSettings;

    #[test]
    fn the_ends_have_the_albedo_at_low_and_high() {
        // Red rises with the FTLE, green falls, blue is constant.
        let albedo = [vec![1.0, -1.0], vec![0.0, 1.0], vec![0.5]];
        let settings = TransferSettings { low: Some(2.0), high: Some(6.0), extinction: Some(1.0), albedo };
        let bar = ColorBar::new(&Transfer::new(&settings, 1.0).unwrap(), [2.0, 6.0], [1.0, 0.5, 1.0], "s");
        assert_eq!((bar.colors[0], bar.colors[COLORS - 1]), ([0, 255, 128], [255, 0, 128]));
        assert!(bar.colors.is_sorted_by(|a, b| a[0] < b[0] && a[1] > b[1]));
        assert_eq!((bar.colors.len(), bar.low, bar.high, bar.unit.as_str()), (COLORS, 2.0, 6.0, "1/s"));
    }
}
