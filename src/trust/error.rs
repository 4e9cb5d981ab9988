//! What is said about the surrogate's error in the trusted region.

use super::Residual;
use serde::{Deserialize, Serialize};

/// Residuals of the surrogate over points that lie in trusted cells and decided nothing about which cells those are.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, Default)]
pub struct TrustedError {
    /// Points measured.
    pub points: u64,
    /// Mean |ramp(predicted) - ramp(traced)|.
    pub optical_mean: f64,
    /// Root mean square of it.
    pub optical_rms: f64,
    /// 95 % interval of the root mean square.
    pub optical_rms_interval: [f64; 2],
    /// 99th percentile of it.
    pub optical_p99: f64,
    /// Root mean square residual of the log-stretch.
    pub log_stretch_rms: f64,
}

impl TrustedError {
    /// Statistics of `residuals`; none when there are fewer than two.
    ///
    /// The interval is that of the mean square by the central limit theorem on its logarithm (delta method), which keeps it above 0
    /// and fits the right-skewed distribution of squares; strata make it conservative.
    pub fn of(residuals: &[Residual]) -> Option<Self> {
        if residuals.len() < 2 {
            return None;
        }
        let n = residuals.len() as f64;
        let mean = |f: fn(&Residual) -> f64| residuals.iter().map(f).sum::<f64>() / n;
        let square = mean(|r| f64::from(r.optical).powi(2));
        let fourth = mean(|r| f64::from(r.optical).powi(4));
        let relative_error = if square > 0.0 { ((fourth - square * square).max(0.0) / (n - 1.0)).sqrt() / square } else { 0.0 };
        let factor = (0.5 * 1.96 * relative_error).exp();
        let rms = square.sqrt();
        let mut sorted: Vec<f32> = residuals.iter().map(|r| r.optical).collect();
        let rank = ((0.99 * n).ceil() as usize).clamp(1, sorted.len()) - 1;
        let (_, p99, _) = sorted.select_nth_unstable_by(rank, f32::total_cmp);
        Some(Self {
            points: residuals.len() as u64,
            optical_mean: mean(|r| f64::from(r.optical)),
            optical_rms: rms,
            optical_rms_interval: [rms / factor, rms * factor],
            optical_p99: f64::from(*p99),
            log_stretch_rms: mean(|r| f64::from(r.log_stretch).powi(2)).sqrt(),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A small deterministic generator: the interval's coverage must not depend on luck.
    fn uniform(state: &mut u64) -> f64 {
        *state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (*state >> 11) as f64 / (1u64 << 53) as f64
    }

    fn skewed(state: &mut u64) -> Residual {
        // Most points have a tiny residual, one in twenty a large one: the shape that ridges give.
        let optical = if uniform(state) < 0.05 { 0.3 * uniform(state) } else { 0.01 * uniform(state) };
        Residual { point: [0.5; 3], optical: optical as f32, log_stretch: optical as f32 }
    }

    #[test]
    fn the_interval_holds_the_truth_in_about_95_percent() {
        let mut state = 1;
        let truth = (0.05 * 0.09 / 3.0 + 0.95 * 0.0001f64 / 3.0).sqrt();
        let held = (0..400)
            .filter(|_| {
                let sample: Vec<Residual> = (0..2000).map(|_| skewed(&mut state)).collect();
                let [low, high] = TrustedError::of(&sample).unwrap().optical_rms_interval;
                (low..=high).contains(&truth)
            })
            .count();
        // 400 trials of 0.95: three standard errors are 3.3 %.
        assert!((367..=393).contains(&held), "{held} of 400");
    }

    #[test]
    fn figures_are_those_of_the_sample() {
        let sample: Vec<Residual> = (1..=100).map(|i| Residual { point: [0.0; 3], optical: i as f32, log_stretch: 2.0 }).collect();
        let e = TrustedError::of(&sample).unwrap();
        assert_eq!((e.points, e.optical_mean, e.optical_p99, e.log_stretch_rms), (100, 50.5, 99.0, 2.0));
        assert!((e.optical_rms - (338_350f64 / 100.0).sqrt()).abs() < 1e-9);
        assert!(TrustedError::of(&sample[..1]).is_none());
    }
}
