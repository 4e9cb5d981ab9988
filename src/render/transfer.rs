//! Transfer function: FTLE to extinction and albedo.

use super::TransferSettings;
use super::error::{RenderError, require, require_finite};

/// Names that `transfer.albedo` accepts in place of coefficients.
pub const ALBEDO_PRESETS: [&str; 4] = ["published", "grey", "ember", "deep"];

/// How far an albedo polynomial may leave [0, 1]: the published one touches -0.0013.
const ALBEDO_SLACK: f64 = 0.05;

/// Optical depth of the shortest edge at full extinction, when no extinction is given.
const DEFAULT_OPTICAL_DEPTH: f64 = 12.0;

/// Coefficients a0..a4 of the small renderer published with Günther, Kuhn and Theisel, "MCFTLE" (2016): dark red ridges, pale
/// yellow flanks, blue rims.
pub(super) fn published_albedo() -> [Vec<f64>; 3] {
    [
        vec![0.6639, 1.4380, 1.1657, -8.0915, 5.0048],
        vec![-0.0013, 1.2767, 7.4696, -15.9415, 7.4158],
        vec![0.1685, -1.4886, 11.9910, -16.2287, 6.1246],
    ]
}

/// Albedo polynomials by name: `published`; `grey` (0.9 everywhere); `ember` (dark red ridges to pale flanks); `deep` (dark blue
/// ridges to pale flanks).
pub fn albedo_preset(name: &str) -> Result<[Vec<f64>; 3], RenderError> {
    match name {
        "published" => Ok(published_albedo()),
        "grey" => Ok([vec![0.9], vec![0.9], vec![0.9]]),
        "ember" => Ok([vec![0.55, 0.42], vec![0.05, 0.85], vec![0.03, 0.15, 0.62]]),
        "deep" => Ok([vec![0.03, 0.15, 0.62], vec![0.18, 0.72], vec![0.45, 0.50]]),
        _ => Err(RenderError::Invalid {
            key: "transfer.albedo",
            found: format!("{name:?}"),
            accepted: "\"published\", \"grey\", \"ember\", \"deep\", or three lists of polynomial coefficients",
        }),
    }
}

impl TransferSettings {
    /// The same with `low` and `high`, where they are not given, set to the median and the 99.5th percentile of `ftle`.
    /// Non-finite values are left out. A field without contrast gets a ramp that starts at its value.
    pub fn scaled_to(&self, ftle: &[f32]) -> Self {
        let mut sorted: Vec<f32> = ftle.iter().copied().filter(|f| f.is_finite()).collect();
        sorted.sort_unstable_by(f32::total_cmp);
        let quantile = |q: f64| sorted.get((q * sorted.len() as f64) as usize).map_or(0.0, |&f| f64::from(f));
        let low = self.low.unwrap_or_else(|| quantile(0.5));
        let least = low + (low.abs() * 1e-3).max(f64::from(f32::MIN_POSITIVE) * 1e6);
        let high = self.high.unwrap_or_else(|| quantile(0.995).max(least));
        Self { low: Some(low), high: Some(high), ..self.clone() }
    }
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
    /// Checks the settings. `shortest_edge` of the box, in scene units, stands in for a missing extinction.
    pub fn new(settings: &TransferSettings, shortest_edge: f64) -> Result<Self, RenderError> {
        let number = "a number; it is set from the first frame's FTLE when left out of a scene file";
        let (Some(low), Some(high)) = (settings.low, settings.high) else {
            let key = if settings.low.is_none() { "transfer.low" } else { "transfer.high" };
            return Err(RenderError::Invalid { key, found: "not set".into(), accepted: number });
        };
        require(low.is_finite(), "transfer.low", low, "a finite number")?;
        let range = (high - low) as f32;
        require(
            high.is_finite() && high > low && range > 0.0 && (1.0 / range).is_finite(),
            "transfer.high",
            high,
            "a finite number above transfer.low",
        )?;
        let extinction = settings.extinction.unwrap_or(DEFAULT_OPTICAL_DEPTH / shortest_edge);
        require(extinction.is_finite() && extinction >= 0.0, "transfer.extinction", extinction, "a finite number, 0 or above")?;
        for channel in &settings.albedo {
            require((1..=16).contains(&channel.len()), "transfer.albedo", channel, "1 to 16 coefficients a channel")?;
            require_finite("transfer.albedo", channel)?;
            let worst =
                (0..=256).map(|i| polynomial(channel, f64::from(i) / 256.0)).find(|a| !(-ALBEDO_SLACK..=1.0 + ALBEDO_SLACK).contains(a));
            require(worst.is_none(), "transfer.albedo", worst, "polynomials with values in [0, 1] for t in [0, 1]")?;
        }
        let albedo = settings.albedo.each_ref().map(|channel| channel.iter().map(|&a| a as f32).collect());
        Ok(Self { low: low as f32, per_range: 1.0 / range, extinction_max: extinction as f32, albedo })
    }

    /// Low, 1 / (high - low), largest extinction, albedo coefficients.
    pub(super) fn parts(&self) -> (f32, f32, f32, &[Vec<f32>; 3]) {
        (self.low, self.per_range, self.extinction_max, &self.albedo)
    }

    /// What the ramp of a log-stretch over `tau` needs: low, 1 / (high - low), and tau.
    #[cfg(feature = "cuda")]
    pub(crate) fn ramp_parts(&self, tau: f64) -> (f32, f32, f32) {
        (self.low, self.per_range, tau as f32)
    }

    /// saturate((FTLE - low) / (high - low)), in [0, 1]: the normalised extinction, in which optical residuals are measured. NaN
    /// stays NaN.
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

    /// Extinction's bound over the FTLE interval `[low, high]`. The ramp never falls, so the upper end decides; an empty interval
    /// (low above high) bounds nothing and gives 0.
    pub fn majorant(&self, low: f32, high: f32) -> f32 {
        if low > high { 0.0 } else { self.extinction(high) }
    }
}

fn polynomial(coefficients: &[f64], t: f64) -> f64 {
    coefficients.iter().rev().fold(0.0, |sum, a| sum * t + a)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn published() -> TransferSettings {
        TransferSettings { low: Some(0.05), high: Some(0.235), extinction: Some(100.0), ..TransferSettings::default() }
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
    fn majorants_bound_the_interval() {
        let transfer = Transfer::new(&published(), 1.0).unwrap();
        for i in 0..=100 {
            let ftle = 0.02 + 0.15 * i as f32 / 100.0;
            assert!(transfer.extinction(ftle) <= transfer.majorant(0.02, 0.17));
        }
        assert_eq!(transfer.majorant(f32::INFINITY, f32::NEG_INFINITY), 0.0);
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
