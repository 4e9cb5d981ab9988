//! Statistics of the surrogate's error in the trusted region: stratified sampling (Cochran 1977) with a confidence interval for skewed data
//! (Hall 1992).

#[cfg(test)]
use super::Residual;
use super::Strata;
use super::audited::{Audited, CellErrors};
#[cfg(test)]
use super::strata::PreviousAudit;
use serde::{Deserialize, Serialize};

/// Residuals of the surrogate at points in trusted cells that had no influence on the choice of these cells.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, Default)]
pub struct TrustedError {
    /// Number of points.
    pub points: u64,
    /// Mean |ramp(predicted) - ramp(traced)|.
    pub optical_mean: f64,
    /// Root mean square of the optical residual.
    pub optical_rms: f64,
    /// 95 % confidence interval of the root mean square.
    pub optical_rms_interval: [f64; 2],
    /// 99th percentile of the optical residual.
    pub optical_p99: f64,
    /// Root mean square residual of the log-stretch.
    pub log_stretch_rms: f64,
}

impl TrustedError {
    /// Statistics of the points in the cells for which `counts` is true; `None` with fewer than two points.
    ///
    /// The weight of a residual is the volume of its cell over the number of points drawn there, so that cells may have different numbers of
    /// points (stratified sampling, Cochran 1977, chapter 5). Squared residuals are skewed: a few ridges carry most of the mean. The interval
    /// is that of the mean square by Hall's transformation of Student's t, which removes the skewness (Hall 1992, J. R. Stat. Soc. B 54, 221).
    ///
    /// Points that miss the few large residuals of a cell give too small a mean and too small a variance. Therefore the variance of a cell is
    /// pooled with that of the audit points of the previous frame there, which count for at most as many points as were drawn now. It is also
    /// pooled with one point that has the variance of the whole region, which matters most in cells with few points. The pooled variance may
    /// widen the interval but not narrow it.
    pub fn of(audited: &Audited, counts: impl Fn(usize) -> bool) -> Option<Self> {
        let Strata { drawn, previous, .. } = audited.strata();
        // Volume that one point of a cell represents, in cells.
        let weight = |cell: usize| 1.0 / f64::from(drawn[cell].max(1));
        let cells: Vec<(usize, &CellErrors)> =
            audited.cells().iter().enumerate().filter(|&(number, cell)| cell.count > 0.0 && counts(number)).collect();
        let n: f64 = cells.iter().map(|(_, cell)| cell.count).sum();
        if n < 2.0 {
            return None;
        }
        let weighted = |f: fn(&CellErrors) -> f64| cells.iter().map(|&(number, cell)| weight(number) * f(cell)).sum::<f64>();
        let whole = weighted(|cell| cell.count);
        let square = weighted(|cell| cell.square) / whole;
        // Second and third moment of the estimate: sums over the points of the deviation from the mean of their cell, each weighted with its
        // share of the whole. In a cell with a single point the mean over all cells replaces its own.
        let moments = |number: usize, cell: &CellErrors| {
            let share = weight(number) / whole;
            if cell.count > 1.0 {
                (share.powi(2) * cell.second * cell.count / (cell.count - 1.0), share.powi(3) * cell.third)
            } else {
                let deviation = share * (cell.square - square);
                (deviation.powi(2), deviation.powi(3))
            }
        };
        // The skewness is that of the points alone; pooling below can only increase the variance.
        let (own, third) = cells.iter().map(|&(number, cell)| moments(number, cell)).fold((0.0, 0.0), |a, b| (a.0 + b.0, a.1 + b.1));
        let gamma = if own > 0.0 { third / own.powf(1.5) } else { 0.0 };
        let of_region = (weighted(|cell| cell.fourth) / whole - square * square).max(0.0);
        let pooled = |&(number, cell): &(usize, &CellErrors)| {
            let previous = previous.get(number).copied().unwrap_or_default();
            let pooled = previous.weight.min(cell.count);
            let share = cell.count * (weight(number) / whole).powi(2);
            (cell.count * moments(number, cell).0 + share * (pooled * previous.variance + of_region)) / (cell.count + pooled + 1.0)
        };
        let variance = cells.iter().map(pooled).sum::<f64>().max(own);
        let bound = |z: f64| (square - variance.sqrt() * hall_inverse(z, gamma)).max(0.0).sqrt();
        // If all residuals are equal, a share of 3 / n of the region may still have any residual (rule of three).
        let interval = if variance > 0.0 { [bound(1.96), bound(-1.96)] } else { [0.0, (square + 3.0 / n).min(1.0).sqrt()] };
        let optical = || cells.iter().flat_map(|&(number, _)| audited.optical(number).map(move |optical| (optical, weight(number))));
        Some(Self {
            points: n as u64,
            optical_mean: weighted(|cell| cell.optical) / whole,
            optical_rms: square.sqrt(),
            optical_rms_interval: interval,
            optical_p99: quantile(optical, 0.99 * whole * (1.0 - 1e-12)),
            log_stretch_rms: (weighted(|cell| cell.log_square) / whole).sqrt(),
        })
    }
}

/// Weighted quantile: the smallest value of non-negative `(value, weight)` pairs up to which the weights sum to `share`, or the largest value if
/// they never do; 0 without pairs. The bit patterns of non-negative floats have the order of their values. A histogram over the leading bits
/// therefore finds the bin of the quantile, and only the values in that bin are sorted.
fn quantile<I: Iterator<Item = (f32, f64)>>(pairs: impl Fn() -> I, share: f64) -> f64 {
    const LEADING: u32 = 12;
    let pattern = |value: f32| (value.to_bits() >> (32 - LEADING)) as usize;
    let mut weights = vec![0.0; 1 << LEADING];
    pairs().for_each(|(value, weight)| weights[pattern(value)] += weight);
    let mut below = 0.0;
    let filled = || weights.iter().enumerate().filter(|(_, weight)| **weight > 0.0);
    let reached = filled().find(|(_, weight)| {
        let reached = below + **weight >= share;
        below += if reached { 0.0 } else { **weight };
        reached
    });
    let Some((wanted, _)) = reached.or_else(|| filled().next_back()) else { return 0.0 };
    let mut values: Vec<(f32, f64)> = pairs().filter(|(value, _)| pattern(*value) == wanted).collect();
    values.sort_unstable_by(|a, b| a.0.total_cmp(&b.0));
    let at = values.iter().position(|(_, weight)| {
        below += weight;
        below >= share
    });
    at.map_or(values.last(), |at| values.get(at)).map_or(0.0, |pair| f64::from(pair.0))
}

/// Inverse of Hall's transformation g(t) = t + gamma t^2 / 3 + gamma^2 t^3 / 27 + gamma / 6 with gamma = skewness / sqrt(n) (Hall 1992).
fn hall_inverse(x: f64, gamma: f64) -> f64 {
    if gamma.abs() < 1e-6 {
        return x;
    }
    (3.0 / gamma) * ((1.0 + gamma * (x - gamma / 6.0)).cbrt() - 1.0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use ridgewatch_field::UnitPoint;

    /// A small deterministic generator: the interval's coverage must not depend on luck.
    fn uniform(state: &mut u64) -> f64 {
        *state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (*state >> 11) as f64 / (1u64 << 53) as f64
    }

    fn skewed(state: &mut u64) -> Residual {
        // Most points have a tiny residual, one in twenty a large one: the shape that ridges give.
        let optical = if uniform(state) < 0.05 { 0.3 * uniform(state) } else { 0.01 * uniform(state) };
        Residual { point: UnitPoint([0.5; 3]), optical: optical as f32, log_stretch: optical as f32 }
    }

    fn of(residuals: &[Residual], strata: &Strata) -> Option<TrustedError> {
        TrustedError::of(&Audited::of(residuals, strata.clone()), |_| true)
    }

    #[test]
    fn the_interval_holds_the_truth_in_about_95_percent() {
        let mut state = 1;
        let truth = (0.05 * 0.09 / 3.0 + 0.95 * 0.0001f64 / 3.0).sqrt();
        let held = (0..400)
            .filter(|_| {
                let sample: Vec<Residual> = (0..2000).map(|_| skewed(&mut state)).collect();
                let [low, high] = of(&sample, &Strata::even([1; 3], sample.len() as u32)).unwrap().optical_rms_interval;
                (low..=high).contains(&truth)
            })
            .count();
        // 400 trials of 0.95: three standard errors are 3.3 %.
        assert!((367..=393).contains(&held), "{held} of 400");
    }

    #[test]
    fn quantiles_are_those_of_the_sorted_pairs() {
        let mut state = 9;
        for n in [1, 2, 3, 10, 101] {
            let pairs: Vec<(f32, f64)> = (0..n).map(|_| ((uniform(&mut state) * 20.0) as f32 as i32 as f32, uniform(&mut state))).collect();
            let whole: f64 = pairs.iter().map(|pair| pair.1).sum();
            let mut sorted = pairs.clone();
            sorted.sort_by(|a, b| a.0.total_cmp(&b.0));
            for share in [0.0, 0.3 * whole, 0.99 * whole, 2.0 * whole] {
                let mut below = 0.0;
                let rank = sorted.iter().find(|pair| {
                    below += pair.1;
                    below >= share
                });
                let expected = f64::from(rank.or(sorted.last()).unwrap().0);
                assert_eq!(quantile(|| pairs.iter().copied(), share), expected, "{n} pairs, {share} of {whole}");
            }
        }
        assert_eq!(quantile(std::iter::empty, 1.0), 0.0);
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
        let sample: Vec<Residual> =
            (1..=100).map(|i| Residual { point: UnitPoint([0.0; 3]), optical: i as f32, log_stretch: 2.0 }).collect();
        let e = of(&sample, &Strata::even([1; 3], sample.len() as u32)).unwrap();
        assert_eq!((e.points, e.optical_p99), (100, 99.0));
        // A hundred weighted terms are summed up in f64.
        assert!((e.optical_mean - 50.5).abs() < 1e-9 && (e.log_stretch_rms - 2.0).abs() < 1e-9);
        assert!((e.optical_rms - (338_350f64 / 100.0).sqrt()).abs() < 1e-9);
        assert!(of(&sample[..1], &Strata::even([1; 3], 1)).is_none());
        let alike = [Residual { point: UnitPoint([0.0; 3]), optical: 0.0, log_stretch: 0.0 }; 300];
        assert_eq!(of(&alike, &Strata::even([1; 3], 300)).unwrap().optical_rms_interval, [0.0, 0.1]);
    }

    /// A quarter of the cells has nearly all of the error and gets most of the points. The statistics stay those of the whole region.
    #[test]
    fn cells_with_more_points_do_not_count_for_more() {
        let cells = [16, 1, 1];
        let strata = Strata { drawn: (0..16).map(|c| if c < 4 { 200 } else { 20 }).collect(), ..Strata::even(cells, 0) };
        let mut state = 5;
        // Optical residual u in the first four cells, u / 100 elsewhere: mean square (1/3) (1/4 + 3/4 * 1e-4).
        let truth = ((0.25 + 0.75e-4) / 3.0f64).sqrt();
        let (mut held, mut square, mut width, trials) = (0, 0.0, 0.0, 300);
        for _ in 0..trials {
            let mut sample = Vec::new();
            for (cell, &count) in strata.drawn.iter().enumerate() {
                for _ in 0..count {
                    let optical = uniform(&mut state) * if cell < 4 { 1.0 } else { 0.01 };
                    sample.push(Residual {
                        point: UnitPoint([(cell as f32 + 0.5) / 16.0, 0.5, 0.5]),
                        optical: optical as f32,
                        log_stretch: 1.0,
                    });
                }
            }
            let error = of(&sample, &strata).unwrap();
            square += error.optical_rms.powi(2) / f64::from(trials);
            let [low, high] = error.optical_rms_interval;
            held += i32::from((low..=high).contains(&truth));
            width += high - low;
        }
        // The standard error of one mean square is 0.25 * 0.298 / sqrt(800), of the mean of 300 a seventeenth: four of them.
        assert!((square - truth * truth).abs() < 4.0 * 0.25 * 0.298 / 800f64.sqrt() / 300f64.sqrt(), "{square} {}", truth * truth);
        // 300 trials of 0.95 less three standard errors: 273. More than 95 % hold, since each quiet cell is given a point that varies like
        // the whole region; the price is a width of at most twice that of the estimate's own spread.
        assert!(held >= 273, "{held} of 300");
        let spread = 0.25 * 0.298 / 800f64.sqrt() / truth;
        assert!(width / f64::from(trials) < 2.0 * 1.96 * spread, "{} {spread}", width / f64::from(trials));
    }

    /// One residual in two hundred is large. With twenty points per cell, many cells show none, and their variance is too small whenever
    /// their mean is. The residuals of earlier frames correct this.
    #[test]
    fn a_spread_seen_before_keeps_the_interval_wide() {
        let cells = [16, 1, 1];
        let (mean, fourth) = (0.005 * 0.09 / 3.0, 0.005 * 0.0081 / 5.0);
        let held = |previous: Vec<PreviousAudit>| {
            let strata = Strata { previous, ..Strata::even(cells, 20) };
            let mut state = 11;
            let covered = (0..400).filter(|_| {
                let mut sample = Vec::new();
                for cell in 0..320 {
                    let large = uniform(&mut state) < 0.005;
                    let optical = if large { 0.3 * uniform(&mut state) } else { 0.0 };
                    sample.push(Residual {
                        point: UnitPoint([(cell / 20) as f32 / 16.0 + 0.01, 0.5, 0.5]),
                        optical: optical as f32,
                        log_stretch: 0.0,
                    });
                }
                let [low, high] = of(&sample, &strata).unwrap().optical_rms_interval;
                (low..=high).contains(&f64::sqrt(mean))
            });
            covered.count()
        };
        let (alone, with) = (held(Vec::new()), held(vec![PreviousAudit { weight: 20.0, variance: fourth - mean * mean }; 16]));
        // 400 trials of 0.95 less three standard errors: 367.
        assert!(alone < 367 && with >= 367, "{alone} without, {with} with");
    }
}
