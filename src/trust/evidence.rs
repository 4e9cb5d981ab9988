//! Evidence against the gate over a whole run, which may be read after every frame.
//!
//! The hypothesis: in every frame, given the frames before, the expected mean square optical residual over the trusted region is at most the tolerance
//! squared. Audit points are drawn after the gate is fixed, so their mean square is an unbiased, non-negative measurement of it. Bets on larger
//! values then gain nothing on average while the hypothesis holds (Waudby-Smith and Ramdas 2024, "Estimating means of bounded random variables by
//! betting"), and the capital exceeds 1 / alpha at any time of the run with probability alpha at most (Ville 1939). A share 1 / (t (t + 1)) of the
//! capital waits until frame t, so that a fault late in the run is found nearly as fast as an early one.

/// Capital at which the hypothesis is rejected: 1 / 5 %.
pub const REJECTED: f64 = 20.0;
/// Shares of the capital that a frame without any error loses. The capital is divided equally between them.
const BETS: [f64; 4] = [0.1, 0.3, 0.6, 0.9];
/// Capital is not counted beyond this, so that it stays finite.
const MAX_CAPITAL: f64 = 1e12;

/// Capital of the bets against the gate since the run began or the gate was reset.
#[derive(Debug, Clone, PartialEq)]
pub struct GateEvidence {
    /// Tolerance squared.
    limit: f64,
    /// Capital of each bet, of the frames that have begun to bet.
    capital: [f64; BETS.len()],
    frames: u64,
}

impl GateEvidence {
    /// No evidence yet. `tolerance`: the largest root mean square optical residual that the gate allows.
    pub fn new(tolerance: f64) -> Self {
        Self { limit: tolerance * tolerance, capital: [0.0; BETS.len()], frames: 0 }
    }

    /// Adds a frame with this mean square optical residual on its audit points, and returns the capital (an e-value): at [`REJECTED`] or above the
    /// gate has promised too much.
    pub fn observe(&mut self, mean_square: f64) -> f64 {
        self.frames += 1;
        let t = self.frames as f64;
        let excess = mean_square / self.limit - 1.0;
        for (capital, bet) in self.capital.iter_mut().zip(BETS) {
            *capital = ((*capital + 1.0 / (t * (t + 1.0))) * (1.0 + bet * excess)).min(MAX_CAPITAL);
        }
        // What waits for later frames has neither lost nor gained.
        self.capital.iter().sum::<f64>() / BETS.len() as f64 + 1.0 / (t + 1.0)
    }

    /// Frames since it began.
    pub fn frames(&self) -> u64 {
        self.frames
    }

    /// Begins anew, after a recorded change: another surrogate, or a gate that was closed.
    pub fn restart(&mut self) {
        *self = Self { capital: [0.0; BETS.len()], frames: 0, ..self.clone() };
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const TOLERANCE: f64 = 0.03;

    /// Mean squares of frames: skewed residuals as ridges give them, resampled (Efron 1979). Their mean is `scale` times the tolerance squared.
    struct Stream {
        pool: Vec<f64>,
        state: u64,
    }

    impl Stream {
        fn new(seed: u64, scale: f64) -> Self {
            let mut stream = Self { pool: Vec::new(), state: seed };
            let residuals: Vec<f64> =
                (0..4000).map(|_| if stream.uniform() < 0.02 { stream.uniform() } else { 0.02 * stream.uniform() }).collect();
            let mean = residuals.iter().map(|r| r * r).sum::<f64>() / residuals.len() as f64;
            stream.pool = residuals.iter().map(|r| r * r / mean * scale * TOLERANCE * TOLERANCE).collect();
            stream
        }

        fn uniform(&mut self) -> f64 {
            self.state = self.state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (self.state >> 11) as f64 / (1u64 << 53) as f64
        }

        /// Mean square over `points` audit points.
        fn frame(&mut self, points: usize) -> f64 {
            (0..points)
                .map(|_| {
                    let index = (self.uniform() * self.pool.len() as f64) as usize;
                    self.pool[index]
                })
                .sum::<f64>()
                / points as f64
        }
    }

    #[test]
    fn a_gate_that_just_keeps_its_promise_is_rejected_in_at_most_5_percent_of_runs() {
        let rejected = |scale: f64| {
            (0..1000)
                .filter(|run| {
                    let (mut stream, mut evidence) = (Stream::new(run * 7919 + 1, scale), GateEvidence::new(TOLERANCE));
                    (0..400).any(|_| evidence.observe(stream.frame(20)) >= REJECTED)
                })
                .count()
        };
        // The bound is loose, so that the share lies below it without a margin for chance. Seeds are fixed.
        let valid = rejected(1.0);
        assert!(valid <= 50, "{valid} of 1000");
        // The test could fail: a gate that errs by a tenth of the tolerance too much is found in nearly all runs of this length.
        let invalid = rejected(1.1_f64.powi(2));
        assert!(invalid > 3 * 50, "{invalid} of 1000");
    }

    #[test]
    fn a_corrupted_surrogate_is_found_within_frames_wherever_in_the_run() {
        for healthy in [0, 10, 1000] {
            let (mut good, mut bad, mut evidence) = (Stream::new(3, 0.2), Stream::new(4, 4.0), GateEvidence::new(TOLERANCE));
            assert!((0..healthy).all(|_| evidence.observe(good.frame(500)) < REJECTED));
            // Twice the tolerance, in root mean square.
            let found = (1..100).find(|_| evidence.observe(bad.frame(500)) >= REJECTED).unwrap();
            assert!(found <= 18, "after {healthy} healthy frames: {found}");
        }
    }

    #[test]
    fn evidence_restarts_and_stays_finite() {
        let mut evidence = GateEvidence::new(TOLERANCE);
        assert!((0..5000).all(|_| evidence.observe(1.0).is_finite()));
        assert!(evidence.observe(1.0) > REJECTED);
        evidence.restart();
        assert_eq!(evidence, GateEvidence::new(TOLERANCE));
        assert!(evidence.observe(0.0) < 1.0);
    }
}
