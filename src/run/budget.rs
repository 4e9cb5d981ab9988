//! What the budget of a smooth frame buys: samples, and nodes of a finer table.

use crate::backend::Tally;
use crate::render::RenderStats;

/// Share of the time that goes to nodes while a table is refined; the samples get what is left.
const NODES_SHARE: f64 = 0.5;

/// Seconds that the parts of a smooth frame take.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct FrameCost {
    /// All but the samples: march, light volume, combination, film. Without the march if it keeps to a budget.
    rest: f64,
    /// Share of the time of the samples in what they and the march take.
    of_samples: f64,
    /// A coupled sample a pixel.
    sample: f64,
    /// A traced point; `None` if none was traced.
    point: Option<f64>,
}

impl FrameCost {
    /// Of a frame of so many samples a pixel that was rendered in `seconds`.
    pub(super) fn new(seconds: f64, samples: f64, stats: &RenderStats, tally: &Tally) -> Self {
        let points = tally.traced + stats.speculative_queries;
        let is_measured = points > 0 && tally.trace_seconds > 0.0;
        Self {
            rest: (seconds - stats.sample_seconds - stats.march_seconds).max(0.0),
            // A march that keeps to the budget takes as long as the samples while it goes on.
            of_samples: if stats.march_goes_on { 0.5 } else { 1.0 },
            sample: (stats.sample_seconds / samples).max(f64::MIN_POSITIVE),
            point: is_measured.then(|| tally.trace_seconds / points as f64),
        }
    }

    /// The cost to expect after this frame and what was expected `before`. The first frame of a picture marches most, so that less is believed
    /// at once. On a device the march, which is part of the rest there, may also take as long as the samples, so that more is believed by half:
    /// otherwise few and many samples would take turns.
    pub(super) fn after(self, before: Option<Self>) -> Self {
        let rest = before.map_or(self.rest, |before| self.rest.min(0.5 * (before.rest + self.rest)));
        Self { rest, ..self }
    }

    /// Samples a pixel of a frame of `budget` seconds, of which `refining` went to nodes of a finer table. Below 0 if nothing is left.
    pub(super) fn samples(&self, budget: f64, refining: f64) -> f64 {
        self.of_samples * (budget - self.rest - refining) / self.sample
    }

    /// Nodes of a finer table to trace before such a frame.
    pub(super) fn nodes(&self, budget: f64) -> f64 {
        self.point.map_or(0.0, |point| NODES_SHARE * (budget - self.rest).max(0.0) / point)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// 60 of 100 milliseconds for two samples a pixel, 50 of them for 10,000 points.
    fn frame() -> FrameCost {
        let stats = RenderStats { sample_seconds: 0.06, ..RenderStats::default() };
        FrameCost::new(0.1, 2.0, &stats, &Tally { traced: 10_000, trace_seconds: 0.05, ..Tally::default() })
    }

    #[test]
    fn nodes_and_samples_fill_the_budget() {
        let cost = frame();
        assert!((cost.samples(0.1, 0.0) - 2.0).abs() < 1e-9, "the frame that was measured");
        for budget in [0.05, 0.1, 0.4] {
            // 40 milliseconds are for the rest, half of the others for nodes of 5 microseconds, and 30 make a sample.
            let nodes = cost.nodes(budget);
            assert!((nodes / (0.5 * (budget - 0.04) / 5e-6) - 1.0).abs() < 1e-9, "{budget}: {nodes}");
            let refining = 5e-6 * nodes;
            let samples = cost.samples(budget, refining);
            assert!((0.04 + refining + 0.03 * samples - budget).abs() < 1e-9, "{budget}: {samples}");
        }
        assert_eq!(cost.nodes(0.03), 0.0, "the rest takes longer");
        assert!(cost.samples(0.03, 0.0) < 0.0);
    }

    /// What a march that keeps to the budget has taken does not count twice, and gets as much again as the samples.
    #[test]
    fn a_march_shares_the_time_with_the_samples() {
        let stats = |goes_on| RenderStats { sample_seconds: 0.06, march_seconds: 0.5, march_goes_on: goes_on, ..RenderStats::default() };
        let [marches, ready] = [true, false].map(|goes_on| FrameCost::new(0.6, 2.0, &stats(goes_on), &Tally::default()));
        assert!((ready.samples(0.1, 0.0) - 2.0).abs() < 1e-9 && (marches.samples(0.1, 0.0) - 1.0).abs() < 1e-9);
    }

    #[test]
    fn without_a_traced_point_nothing_is_known_of_nodes() {
        assert_eq!(FrameCost::new(0.1, 2.0, &RenderStats::default(), &Tally::default()).nodes(1.0), 0.0);
    }

    /// As long as the march takes as long as the samples, in a budget of 20 samples.
    #[test]
    fn samples_settle_while_the_march_takes_as_long() {
        let (mut cost, mut samples, mut found) = (None, 0.25, Vec::new());
        for _ in 0..6 {
            let seconds = 0.01 * samples;
            let stats = RenderStats { sample_seconds: seconds, ..RenderStats::default() };
            let now = FrameCost::new(2.0 * seconds, samples, &stats, &Tally::default()).after(cost);
            samples = now.samples(0.2, 0.0);
            cost = Some(now);
            found.push(samples);
        }
        assert!(found[1..].iter().all(|samples| (samples - 10.0).abs() < 1e-9), "{found:?}");
        // The first march of a picture, once it is over.
        let first = FrameCost { rest: 5.0, ..frame() };
        assert_eq!(frame().after(Some(first)), frame());
    }
}
