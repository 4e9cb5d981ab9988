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
    /// Squares of residuals are skewed: a few ridges carry most of the mean. The interval is that of the mean square by Hall's
    /// transformation of Student's t, which takes the skewness out (Hall 1992, J. R. Stat. Soc. B 54, 221); strata make it wider
    /// than need be.
    pub fn of(residuals: &[Residual]) -> Option<Self> {
        if residuals.len() < 2 {
            return None;
        }
        let n = residuals.len() as f64;
        let mean = |f: fn(&Residual) -> f64| residuals.iter().map(f).sum::<f64>() / n;
        let square = mean(|r| f64::from(r.optical).powi(2));
        let central = |power: i32| residuals.iter().map(|r| (f64::from(r.optical).powi(2) - square).powi(power)).sum::<f64>() / n;
        let variance = central(2);
        let skewness = if variance > 0.0 { central(3) / variance.powf(1.5) } else { 0.0 };
        let standard_error = (variance / (n - 1.0)).sqrt();
        let bound = |z: f64| (square - standard_error * hall_inverse(z, skewness / n.sqrt())).max(0.0).sqrt();
        let rms = square.sqrt();
        // Residuals that are all alike say nothing of those not drawn: a share of 3 / n of the region may hold anything (rule of three).
        let interval = if variance > 0.0 { [bound(1.96), bound(-1.96)] } else { [0.0, (square + 3.0 / n).min(1.0).sqrt()] };
        let mut sorted: Vec<f32> = residuals.iter().map(|r| r.optical).collect();
        let rank = ((0.99 * n).ceil() as usize).clamp(1, sorted.len()) - 1;
        let (_, p99, _) = sorted.select_nth_unstable_by(rank, f32::total_cmp);
        Some(Self {
            points: residuals.len() as u64,
            optical_mean: mean(|r| f64::from(r.optical)),
            optical_rms: rms,
            optical_rms_interval: interval,
            optical_p99: f64::from(*p99),
            log_stretch_rms: mean(|r| f64::from(r.log_stretch).powi(2)).sqrt(),
        })
    }
}

/// Inverse of Hall's transformation g(t) = t + gamma t^2 / 3 + gamma^2 t^3 / 27 + gamma / 6, with gamma = skewness / sqrt(n).
fn hall_inverse(x: f64, gamma: f64) -> f64 {
    if gamma.abs() < 1e-6 {
        return x;
    }
    (3.0 / gamma) * ((1.0 + gamma * (x - gamma / 6.0)).cbrt() - 1.0)
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
    fn halls_transformation_is_inverted() {
        for (t, gamma) in [(1.96f64, 0.3f64), (-1.96, 0.3), (0.5, -0.2), (1.0, 0.0)] {
            let g = t + gamma * t * t / 3.0 + gamma * gamma * t.powi(3) / 27.0 + gamma / 6.0;
            assert!((hall_inverse(g, gamma) - t).abs() < 1e-9);
        }
    }

    #[test]
    fn figures_are_those_of_the_sample() {
        let sample: Vec<Residual> = (1..=100).map(|i| Residual { point: [0.0; 3], optical: i as f32, log_stretch: 2.0 }).collect();
        let e = TrustedError::of(&sample).unwrap();
        assert_eq!((e.points, e.optical_mean, e.optical_p99, e.log_stretch_rms), (100, 50.5, 99.0, 2.0));
        assert!((e.optical_rms - (338_350f64 / 100.0).sqrt()).abs() < 1e-9);
        assert!(TrustedError::of(&sample[..1]).is_none());
        let alike = [Residual { point: [0.0; 3], optical: 0.0, log_stretch: 0.0 }; 300];
        assert_eq!(TrustedError::of(&alike).unwrap().optical_rms_interval, [0.0, 0.1]);
    }
}
