//! The transfer function: extinction and albedo as functions of the FTLE.

use super::TransferSettings;
use super::error::{RenderError, require, require_finite};
use super::parameters::{MAX_ALBEDO_COEFFICIENTS, TransferParameters};

/// Largest distance of an albedo polynomial from [0, 1]; the published one reaches -0.0013.
const ALBEDO_SLACK: f64 = 0.05;

/// Default optical depth of the shortest edge at full extinction.
const DEFAULT_OPTICAL_DEPTH: f64 = 12.0;

impl TransferSettings {
    /// Returns these settings with `low` and `high`, unless given, set to the median and the 99.5th percentile of `ftle` (1/time). Non-finite
    /// values are ignored. A field without contrast gets a ramp that starts at its value.
    pub fn scaled_to(&self, ftle: &[f32]) -> Self {
        let mut sorted: Vec<f32> = ftle.iter().copied().filter(|f| f.is_finite()).collect();
        sorted.sort_unstable_by(f32::total_cmp);
        let quantile = |q: f64| sorted.get((q * sorted.len() as f64) as usize).map_or(0.0, |&f| f64::from(f));
        let low = self.low.unwrap_or_else(|| quantile(0.5));
        let min_high = low + (low.abs() * 1e-3).max(f64::from(f32::MIN_POSITIVE) * 1e6);
        let high = self.high.unwrap_or_else(|| quantile(0.995).max(min_high));
        Self { low: Some(low), high: Some(high), ..self.clone() }
    }

    /// The same for a map, which shows values below the median too ([`map_range`]).
    pub fn scaled_to_map(&self, ftle: &[f32]) -> Self {
        let [first, last] = map_range(ftle.iter().copied(), false);
        // An end that is given may lie beyond all values.
        let beside = |end: f64| end.abs().max(1e-9);
        let high = self.high.unwrap_or_else(|| self.low.filter(|low| *low >= last).map_or(last, |low| low + beside(low)));
        let low = self.low.unwrap_or(match first {
            first if first >= 0.0 && first < 0.5 * high => 0.0,
            first if first < high => first,
            _ => high - beside(high),
        });
        Self { low: Some(low), high: Some(high), ..self.clone() }
    }
}

/// Range of the colours of a map: from 0, or the first percentile if that is negative or far from 0, to percentile 99.5. `from_white`: from percentile 40,
/// so that white is what stretches little.
pub fn map_range(ftle: impl Iterator<Item = f32>, from_white: bool) -> [f64; 2] {
    let mut known: Vec<f64> = ftle.filter(|f| f.is_finite()).map(f64::from).collect();
    if known.is_empty() {
        return [0.0, 1.0];
    }
    known.sort_unstable_by(f64::total_cmp);
    let percentile = |percent: f64| known[((known.len() - 1) as f64 * percent / 100.0).round() as usize];
    let (low, high) = (percentile(if from_white { 40.0 } else { 1.0 }), percentile(99.5));
    let low = if !from_white && low >= 0.0 && low < 0.5 * high { 0.0 } else { low };
    if high > low + 1e-6 * high.abs() { [low, high] } else { [low - 0.5 * low.abs().max(1e-9), low + 0.5 * low.abs().max(1e-9)] }
}

/// Extinction and albedo as functions of the FTLE, checked and in f32.
#[derive(Debug, Clone, PartialEq)]
pub struct Transfer {
    low: f32,
    per_range: f32,
    extinction_max: f32,
    albedo: [Vec<f32>; 3],
}

impl Transfer {
    /// Checks the settings. `shortest_edge` of the box, in scene units, determines the extinction unless it is given.
    ///
    /// # Errors
    /// The first key at fault and the values that it accepts.
    pub fn new(settings: &TransferSettings, shortest_edge: f64) -> Result<Self, RenderError> {
        let number = "a number; it is set from the first frame's FTLE when left out of a scene file";
        let (Some(low), Some(high)) = (settings.low, settings.high) else {
            let key = if settings.low.is_none() { "transfer.low" } else { "transfer.high" };
            return Err(RenderError::Invalid { key, found: "not set".into(), accepted: number });
        };
        require((low as f32).is_finite(), "transfer.low", low, "a finite number")?;
        let range = (high - low) as f32;
        require(
            (high as f32).is_finite() && high > low && range > 0.0 && range.is_finite() && (1.0 / range).is_finite(),
            "transfer.high",
            high,
            "a finite number above transfer.low",
        )?;
        let extinction = settings.extinction.unwrap_or(DEFAULT_OPTICAL_DEPTH / shortest_edge);
        require(extinction.is_finite() && extinction >= 0.0, "transfer.extinction", extinction, "a finite number, 0 or above")?;
        for channel in &settings.albedo {
            require(
                (1..=MAX_ALBEDO_COEFFICIENTS).contains(&channel.len()),
                "transfer.albedo",
                channel,
                "1 to 16 coefficients per channel",
            )?;
            require_finite("transfer.albedo", channel)?;
            let worst =
                (0..=256).map(|i| polynomial(channel, f64::from(i) / 256.0)).find(|a| !(-ALBEDO_SLACK..=1.0 + ALBEDO_SLACK).contains(a));
            require(worst.is_none(), "transfer.albedo", worst, "polynomials with values in [0, 1] for t in [0, 1]")?;
        }
        let albedo = settings.albedo.each_ref().map(|channel| channel.iter().map(|&a| a as f32).collect());
        Ok(Self { low: low as f32, per_range: 1.0 / range, extinction_max: extinction as f32, albedo })
    }

    pub(super) fn parameters(&self) -> TransferParameters {
        let mut albedo = [[0.0; MAX_ALBEDO_COEFFICIENTS]; 3];
        for (padded, channel) in albedo.iter_mut().zip(&self.albedo) {
            padded[..channel.len()].copy_from_slice(channel);
        }
        let coefficients = self.albedo.each_ref().map(|channel| channel.len() as i32);
        TransferParameters { low: self.low, per_range: self.per_range, extinction_max: self.extinction_max, coefficients, albedo }
    }

    /// FTLE at which the extinction begins, and from which it is full.
    pub fn range(&self) -> [f64; 2] {
        [self.low.into(), f64::from(self.low) + 1.0 / f64::from(self.per_range)]
    }

    /// Parameters of the ramp of a log-stretch over `tau`: low, 1 / (high - low), and tau.
    pub fn ramp_parts(&self, tau: f64) -> (f32, f32, f32) {
        (self.low, self.per_range, tau as f32)
    }

    /// Normalised extinction saturate((FTLE - low) / (high - low)), in [0, 1], in which optical residuals are measured. NaN stays NaN.
    #[inline]
    pub fn ramp(&self, ftle: f32) -> f32 {
        ((ftle - self.low) * self.per_range).clamp(0.0, 1.0)
    }

    /// Extinction per unit of length.
    #[inline]
    pub fn extinction(&self, ftle: f32) -> f32 {
        self.extinction_max * self.ramp(ftle)
    }

    /// Largest extinction at any FTLE.
    pub fn extinction_max(&self) -> f32 {
        self.extinction_max
    }

    /// Scattering albedo of the red, green and blue channel.
    #[inline]
    pub fn albedo(&self, ftle: f32) -> [f32; 3] {
        let t = 1.0 - self.ramp(ftle);
        self.albedo.each_ref().map(|channel| channel.iter().rev().fold(0.0, |sum, &a| sum * t + a))
    }
}

fn polynomial(coefficients: &[f64], t: f64) -> f64 {
    coefficients.iter().rev().fold(0.0, |sum, a| sum * t + a)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ALBEDO_PRESETS;

    fn published() -> TransferSettings {
        TransferSettings { low: Some(0.05), high: Some(0.235), extinction: Some(100.0), ..TransferSettings::default() }
    }

    #[test]
    fn open_ends_of_a_map_lie_beside_those_that_are_given() {
        let ftle: Vec<f32> = (0..1000).map(|i| 1.0 + i as f32 * 1e-3).collect();
        let ends = |low, high| {
            let scaled = TransferSettings { low, high, ..TransferSettings::default() }.scaled_to_map(&ftle);
            [scaled.low.unwrap(), scaled.high.unwrap()].map(|end| (end * 1e3).round() / 1e3)
        };
        // The first percentile is above half of the last.
        assert_eq!(ends(None, None), [1.01, 1.994]);
        assert_eq!((ends(None, Some(4.0)), ends(Some(1.5), None)), ([0.0, 4.0], [1.5, 1.994]));
        assert_eq!((ends(None, Some(0.3)), ends(None, Some(-2.0)), ends(Some(3.0), None)), ([0.0, 0.3], [-4.0, -2.0], [3.0, 6.0]));
        assert!(TransferSettings::default().scaled_to_map(&[0.7; 9]).low < Some(0.7));
    }

    #[test]
    fn the_published_transfer_function() {
        let transfer = Transfer::new(&published(), 1.0).unwrap();
        assert_eq!(transfer.ramp(0.05), 0.0);
        assert_eq!(transfer.ramp(1.0), 1.0);
        // Two roundings of f32 in the ramp, at a slope of 100/0.185.
        assert!((transfer.extinction(0.1425) - 50.0).abs() < 1e-4);
        let at_half = [0.5_f64, 0.25, 0.125, 0.0625];
        let expected = [
            0.6639 + 1.4380 * at_half[0] + 1.1657 * at_half[1] - 8.0915 * at_half[2] + 5.0048 * at_half[3],
            -0.0013 + 1.2767 * at_half[0] + 7.4696 * at_half[1] - 15.9415 * at_half[2] + 7.4158 * at_half[3],
            0.1685 - 1.4886 * at_half[0] + 11.9910 * at_half[1] - 16.2287 * at_half[2] + 6.1246 * at_half[3],
        ];
        let found = transfer.albedo(0.1425);
        // Coefficients of 16 in f32.
        (0..3).for_each(|k| assert!((f64::from(found[k]) - expected[k]).abs() < 1e-5));
    }

    #[test]
    fn low_and_high_follow_the_field() {
        let ftle: Vec<f32> = (0..1000).map(|i| i as f32).chain([f32::NAN]).collect();
        let scaled = TransferSettings::default().scaled_to(&ftle);
        assert_eq!((scaled.low, scaled.high), (Some(500.0), Some(995.0)));
        assert_eq!(TransferSettings { low: Some(3.0), ..TransferSettings::default() }.scaled_to(&ftle).low, Some(3.0));
        for flat in [&[0.0_f32; 5][..], &[2.0; 5], &[]] {
            assert!(Transfer::new(&TransferSettings::default().scaled_to(flat), 1.0).is_ok(), "a field without contrast still renders");
        }
    }

    #[test]
    fn faults_name_the_key() {
        let fault = |edit: fn(&mut TransferSettings)| {
            let mut settings = published();
            edit(&mut settings);
            Transfer::new(&settings, 1.0).unwrap_err().to_string()
        };
        assert_eq!(fault(|s| s.high = Some(0.05)), "`transfer.high` is 0.05; accepted: a finite number above transfer.low");
        assert!(fault(|s| s.low = None).starts_with("`transfer.low` is not set"));
        assert!(fault(|s| s.low = Some(f64::NAN)).starts_with("`transfer.low` is nan;"));
        assert!(fault(|s| s.extinction = Some(-1.0)).starts_with("`transfer.extinction` is -1.0"));
        assert!(fault(|s| s.albedo[1] = vec![]).contains("1 to 16 coefficients"));
        assert!(fault(|s| s.albedo[2] = vec![0.0, 3.0]).contains("values in [0, 1]"));
    }

    #[test]
    fn presets_are_accepted_by_name() {
        for name in ALBEDO_PRESETS {
            let text = format!("low = 0.1\nhigh = 1.0\nalbedo = \"{name}\"");
            let settings: TransferSettings = toml::from_str(&text).unwrap();
            assert!(Transfer::new(&settings, 1.0).is_ok(), "{name}");
        }
        assert!(toml::from_str::<TransferSettings>("albedo = \"mauve\"").unwrap_err().to_string().contains("mauve"));
        assert_eq!(toml::from_str::<TransferSettings>("albedo = [[0.5], [0.5], [0.5, 0.1]]").unwrap().albedo[2], [0.5, 0.1]);
    }
}
