//! Chooses the number of Runge-Kutta steps by its error: step doubling on quasi-random points (Roberts 2018).

use super::{FlowError, StepChoice, Traced};
use ridgewatch_base::progress::Work;
use ridgewatch_field::{Domain, DomainPoint, UnitPoint};

/// Smallest number of steps tried on closed forms.
const MIN_STEPS: usize = 4;
/// Largest number of steps tried on closed forms.
const MAX_STEPS: usize = 16_384;
/// Fewest steps per snapshot interval; the time derivative of the velocity jumps at its ends.
const MIN_STEPS_PER_INTERVAL: usize = 2;
/// Most steps per snapshot interval, unless particles cross more cells.
const MAX_STEPS_PER_INTERVAL: usize = 32;
/// Most steps over those that the crossed cells require.
const MAX_OVER_CROSSED: usize = 8;
/// Smallest bound by a share of the log-stretch, as a part of the tolerance: a flow without stretch needs no steps for it.
const MIN_BOUND: f64 = 0.01;
/// Limit of the steps per snapshot interval for the cells that particles cross: velocities of input data are unbounded.
const MAX_STEPS_PER_INTERVAL_FOR_CELLS: usize = 256;
/// Share of the points with the largest differences that is left out on grids. If more points have no finite log-stretch, the difference is
/// infinite.
const TRIMMED_SHARE: f64 = 0.02;
/// Number of paths over the whole span from which on only these are compared.
const MIN_COMPLETE_PATHS: usize = 64;

/// Quasi-random points of a domain: the additive recurrence of the generalised golden ratio (Roberts 2018).
pub fn quasi_random_points(domain: &Domain, count: usize) -> Vec<DomainPoint> {
    // The real root of x^4 = x + 1.
    const RATIO: f64 = 1.220_744_084_605_759_5;
    (0..count)
        .map(|n| domain.from_unit(UnitPoint(std::array::from_fn(|k| (0.5 + (n + 1) as f64 * RATIO.powi(-(k as i32) - 1)).fract() as f32))))
        .collect()
}

/// Root mean square difference of two traces over the paths that span the whole time in both, or over all paths if those are rare. A path
/// that stops is cut to whole steps, which is an error of another order that would hide that of the integrator.
pub fn rms_difference(a: &Traced, b: &Traced) -> f64 {
    trimmed_difference(a, b, false).0
}

/// [`rms_difference`], on grids without the [`TRIMMED_SHARE`] of the points that differ most, and the number of points without a finite
/// difference. The difference is infinite if the latter are more than that share of all.
pub fn trimmed_difference(a: &Traced, b: &Traced, gridded: bool) -> (f64, usize) {
    let trimmed = if gridded { TRIMMED_SHARE } else { 0.0 };
    let whole = |i: &usize| a.lifetime_share[*i] >= 1.0 && b.lifetime_share[*i] >= 1.0;
    let all = 0..a.lifetime_share.len();
    let complete = all.clone().filter(whole).count();
    let chosen: Vec<usize> = if complete >= MIN_COMPLETE_PATHS { all.filter(whole).collect() } else { all.collect() };
    let value = |t: &Traced, i: usize| t.log_stretch_f64.get(i).copied().unwrap_or(f64::from(t.log_stretch[i]));
    let compared = chosen.len();
    let mut squares: Vec<f64> =
        chosen.into_iter().map(|i| (value(a, i) - value(b, i)).powi(2)).filter(|square| square.is_finite()).collect();
    let failed = compared - squares.len();
    if squares.is_empty() || failed as f64 > TRIMMED_SHARE * compared as f64 {
        return (f64::INFINITY, failed);
    }
    squares.sort_unstable_by(f64::total_cmp);
    squares.truncate((compared as f64 * (1.0 - trimmed)).ceil() as usize);
    ((squares.iter().sum::<f64>() / squares.len() as f64).sqrt(), failed)
}

/// Root mean square log-stretch over the paths that span the whole time; infinite if there are none.
fn rms_of_whole(traced: &Traced) -> f64 {
    let whole = traced.log_stretch.iter().zip(&traced.lifetime_share).filter(|(s, share)| **share >= 1.0 && s.is_finite());
    let (sum, count) = whole.fold((0.0, 0usize), |(sum, count), (s, _)| (sum + f64::from(*s).powi(2), count + 1));
    if count < MIN_COMPLETE_PATHS { f64::INFINITY } else { (sum / count as f64).sqrt() }
}

/// The largest difference with which a choice of steps ends, on paths whose log-stretch was `traced`.
pub fn allowed(tolerance: f64, share: f64, traced: &Traced) -> f64 {
    tolerance.min((share * rms_of_whole(traced)).max(MIN_BOUND * tolerance))
}

/// Bounds on the number of steps.
pub struct GridConstraints {
    /// Snapshot intervals in tau; 0 for a closed form.
    pub intervals: usize,
    /// Steps that the cells crossed in tau require.
    pub min_steps: f64,
    /// Largest difference as a share of the log-stretch; infinite if there is none.
    pub share: f64,
}

/// Returns the first number of steps, each about 1.5 times the one before, whose log-stretch differs from that of twice as many steps by at
/// most `tolerance` (root mean square).
///
/// On grids the numbers begin at `grid.min_steps`: fewer steps may agree with one another and be wrong. The gradient of the interpolant
/// jumps at cell faces, so that a few paths along a separatrix turn one way with n steps and the other way with 2n, for every n. Therefore
/// the [`TRIMMED_SHARE`] of the points that differ most is left out. The numbers end at [`MAX_STEPS_PER_INTERVAL`] steps per snapshot
/// interval or [`MAX_OVER_CROSSED`] times the first number, beyond which the resolution of the data limits the accuracy.
///
/// # Errors
/// [`FlowError::StepsNotFound`] if no number of steps meets the tolerance on a closed form. On grids the last choice is returned instead,
/// with [`StepChoice::within_tolerance`] false.
pub fn choose_steps(
    tolerance: f64,
    GridConstraints { intervals, min_steps, share }: GridConstraints,
    domain: &Domain,
    mut trace: impl FnMut(usize, &[DomainPoint], &mut Traced),
) -> Result<StepChoice, FlowError> {
    let points = quasi_random_points(domain, StepChoice::POINTS);
    let (mut once, mut twice) = (Traced::default(), Traced::default());
    let gridded = intervals > 0;
    let first = (min_steps.ceil() as usize)
        .clamp(MIN_STEPS_PER_INTERVAL * intervals, MAX_STEPS_PER_INTERVAL_FOR_CELLS * intervals)
        .next_multiple_of(intervals.max(1));
    let mut steps = if gridded { first } else { MIN_STEPS };
    let max_steps = if gridded {
        (MAX_OVER_CROSSED * first).min(MAX_STEPS_PER_INTERVAL_FOR_CELLS * intervals).max(MAX_STEPS_PER_INTERVAL * intervals)
    } else {
        MAX_STEPS
    };
    let multiple_of = intervals.max(1);
    let work = Work::begin("choosing the steps of a path");
    let mut last = StepChoice { steps, difference: f64::INFINITY, within_tolerance: false, not_finite: 0, multiple_of };
    while steps <= max_steps {
        trace(steps, &points, &mut once);
        trace(2 * steps, &points, &mut twice);
        let (difference, not_finite) = trimmed_difference(&once, &twice, gridded);
        let allowed = allowed(tolerance, share, &twice);
        let within_tolerance = difference <= allowed;
        if difference.is_finite() {
            // How many more are needed is not known.
            work.stands(format!("with {steps} the log-stretch differs by {difference:.1e}, allowed are {allowed:.1e}"));
        }
        last = StepChoice { steps, difference, within_tolerance, not_finite, multiple_of };
        if last.within_tolerance {
            return Ok(last);
        }
        // On a grid, whole numbers of steps per interval put stages at the times of snapshots.
        steps = if gridded { next_on_grid(steps, intervals) } else { (steps * 3).div_ceil(2) };
    }
    if gridded { Ok(last) } else { Err(FlowError::StepsNotFound { steps: max_steps, reached: last.difference, tolerance }) }
}

/// The next multiple of `intervals`, at least about 1.5 times `steps` if `steps` is large.
fn next_on_grid(steps: usize, intervals: usize) -> usize {
    (steps + (steps / 2).max(intervals) / intervals * intervals).next_multiple_of(intervals)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn points_fill_the_domain() {
        let domain = Domain::cuboid([-1.0, 0.0, 5.0], [1.0, 1.0, 7.0]);
        let points = quasi_random_points(&domain, 512);
        assert!(points.iter().all(|p| domain.contains(*p)));
        for octant in 0..8 {
            let inside = |p: &&DomainPoint| (0..3).all(|k| (domain.to_unit(**p).0[k] >= 0.5) == (octant >> k & 1 == 1));
            let count = points.iter().filter(inside).count();
            // An even share is 64. Independent points would deviate by 7.5 on average and by about 15 in some octant.
            assert!((54..=74).contains(&count), "{count}");
        }
    }

    #[test]
    fn paths_without_a_number_are_counted() {
        let traced = |failed: usize| Traced {
            log_stretch: (0..1000).map(|i| if i < failed { f32::NAN } else { 1.0 }).collect(),
            lifetime_share: vec![1.0; 1000],
            ..Traced::default()
        };
        for gridded in [false, true] {
            assert_eq!(trimmed_difference(&traced(0), &traced(20), gridded), (0.0, 20));
            assert_eq!(trimmed_difference(&traced(0), &traced(21), gridded), (f64::INFINITY, 21), "no choice rests on what is left");
        }
    }

    #[test]
    fn ladder_on_a_grid() {
        assert_eq!(next_on_grid(11, 11), 22);
        assert_eq!(next_on_grid(22, 11), 33);
        assert_eq!(next_on_grid(44, 11), 66);
    }
}
