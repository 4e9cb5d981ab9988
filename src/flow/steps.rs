//! Steps chosen by error, not by habit.

use super::{FlowError, Traced};
use crate::field::Domain;

/// Points on which a number of steps is judged.
const POINTS: usize = 2048;
/// Fewest steps tried on closed forms (on grids: one a snapshot interval, as far as this allows).
const FEWEST: usize = 4;
/// Most steps tried.
const MOST: usize = 16_384;
/// Fewest steps a snapshot interval, at whose ends the change in time has a corner.
const LEAST_AN_INTERVAL: usize = 2;
/// Most steps a snapshot interval, but where so many cells are crossed.
const MOST_AN_INTERVAL: usize = 32;
/// Most steps a snapshot interval for cells that are crossed: a velocity may be any number.
const MOST_FOR_CELLS: usize = 256;
/// Share of the points, the most different ones, that does not count on grids; of more without a finite log-stretch no difference is stated.
const TRIMMED: f64 = 0.02;
/// Points that must have lived the whole span for the judgement to rest on them alone.
const ENOUGH: usize = 64;

/// Quasi-random points of a domain: the additive recurrence of the generalised golden ratio (Roberts 2018).
pub fn points(domain: &Domain, count: usize) -> Vec<[f32; 3]> {
    // The real root of x^4 = x + 1.
    const RATIO: f64 = 1.220_744_084_605_759_5;
    (0..count)
        .map(|n| domain.from_unit(std::array::from_fn(|k| (0.5 + (n + 1) as f64 * RATIO.powi(-(k as i32) - 1)).fract() as f32)))
        .collect()
}

/// Root mean square difference of two traces, over the points that lived the whole span in both (where such are rare: over all):
/// a path that stops is cut to whole steps, an error of another kind and order that would hide the integrator's.
pub fn difference(a: &Traced, b: &Traced) -> f64 {
    trimmed_difference(a, b, 0.0).0
}

/// The same without the share `trimmed` of the points that differ most, and the number of points that have no finite difference; infinite
/// where these are more than [`TRIMMED`] of all.
fn trimmed_difference(a: &Traced, b: &Traced, trimmed: f64) -> (f64, usize) {
    let whole = |i: &usize| a.lived[*i] >= 1.0 && b.lived[*i] >= 1.0;
    let all = 0..a.lived.len();
    let lived = all.clone().filter(whole).count();
    let chosen: Vec<usize> = if lived >= ENOUGH { all.filter(whole).collect() } else { all.collect() };
    let value = |t: &Traced, i: usize| t.log_stretch_f64.get(i).copied().unwrap_or(f64::from(t.log_stretch[i]));
    let compared = chosen.len();
    let mut squares: Vec<f64> =
        chosen.into_iter().map(|i| (value(a, i) - value(b, i)).powi(2)).filter(|square| square.is_finite()).collect();
    let failed = compared - squares.len();
    if squares.is_empty() || failed as f64 > TRIMMED * compared as f64 {
        return (f64::INFINITY, failed);
    }
    squares.sort_unstable_by(f64::total_cmp);
    squares.truncate((compared as f64 * (1.0 - trimmed)).ceil() as usize);
    ((squares.iter().sum::<f64>() / squares.len() as f64).sqrt(), failed)
}

/// How the number of steps was chosen.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Chosen {
    /// Steps a path gets.
    pub steps: usize,
    /// Difference of the log-stretch from twice as many steps: root mean square; on grids without the most different 2 % of the points.
    pub difference: f64,
    /// Whether the difference is within the tolerance.
    pub met: bool,
    /// Points, of [`Self::POINTS`], whose log-stretch is no finite number.
    pub failed: usize,
}

impl Chosen {
    /// Points on which a number of steps is judged.
    pub const POINTS: usize = POINTS;
}

/// Where a ladder on a grid begins: what is known about it.
pub struct Gridded {
    /// Snapshot intervals in tau; 0 for a closed form.
    pub intervals: usize,
    /// Steps that the cells crossed in tau ask for.
    pub least: f64,
}

/// The fewest steps of a ladder (by halves upwards) whose log-stretch differs from that of twice as many by at most `tolerance`, root mean
/// square. On grids the ladder begins at two steps a snapshot interval and one a cell, two where paths stop at edges and land, which cuts
/// them to whole steps: fewer may agree with one another and be wrong.
///
/// On grids the gradient of the interpolant jumps at cell faces, and a few paths along a separatrix turn one way with n steps and the
/// other with 2n, at any n: there the most different [`TRIMMED`] of the points is left out, and the ladder ends at [`MOST_AN_INTERVAL`]
/// steps a snapshot interval, beyond which the data's own resolution decides. Not meeting the tolerance is then told, not refused.
pub fn choose(
    tolerance: f64,
    Gridded { intervals, least }: Gridded,
    domain: &Domain,
    mut trace: impl FnMut(usize, &[[f32; 3]], &mut Traced),
) -> Result<Chosen, FlowError> {
    let points = points(domain, POINTS);
    let (mut once, mut twice) = (Traced::default(), Traced::default());
    let gridded = intervals > 0;
    let trimmed = if gridded { TRIMMED } else { 0.0 };
    let first = (least.ceil() as usize).clamp(LEAST_AN_INTERVAL * intervals, MOST_FOR_CELLS * intervals).next_multiple_of(intervals.max(1));
    let mut steps = if gridded { first } else { FEWEST };
    let most = if gridded { first.max(MOST_AN_INTERVAL * intervals) } else { MOST };
    let mut last = Chosen { steps, difference: f64::INFINITY, met: false, failed: 0 };
    while steps <= most {
        trace(steps, &points, &mut once);
        trace(2 * steps, &points, &mut twice);
        let (difference, failed) = trimmed_difference(&once, &twice, trimmed);
        last = Chosen { steps, difference, met: difference <= tolerance, failed };
        if last.met {
            return Ok(last);
        }
        // On a grid a whole number of steps an interval, or of intervals, keeps stages on snapshots.
        steps = if gridded { next_on_grid(steps, intervals) } else { (steps * 3).div_ceil(2) };
    }
    if gridded { Ok(last) } else { Err(FlowError::StepsNotFound { steps: most, reached: last.difference, tolerance }) }
}

/// The next multiple of `intervals`, at least 1.5 times `steps` when that is large.
fn next_on_grid(steps: usize, intervals: usize) -> usize {
    (steps + (steps / 2).max(intervals) / intervals * intervals).next_multiple_of(intervals)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn points_fill_the_domain() {
        let domain = Domain::cuboid([-1.0, 0.0, 5.0], [1.0, 1.0, 7.0]);
        let points = points(&domain, 512);
        assert!(points.iter().all(|p| domain.contains(*p)));
        for octant in 0..8 {
            let inside = |p: &&[f32; 3]| (0..3).all(|k| (domain.to_unit(**p)[k] >= 0.5) == (octant >> k & 1 == 1));
            let count = points.iter().filter(inside).count();
            // An even share is 64, from which independent points would stray by 7.5 on average and by about 15 somewhere.
            assert!((54..=74).contains(&count), "{count}");
        }
    }

    #[test]
    fn paths_without_a_number_are_counted() {
        let traced = |failed: usize| Traced {
            log_stretch: (0..1000).map(|i| if i < failed { f32::NAN } else { 1.0 }).collect(),
            lived: vec![1.0; 1000],
            ..Traced::default()
        };
        for trimmed in [0.0, TRIMMED] {
            assert_eq!(trimmed_difference(&traced(0), &traced(20), trimmed), (0.0, 20));
            assert_eq!(trimmed_difference(&traced(0), &traced(21), trimmed), (f64::INFINITY, 21), "no choice rests on what is left");
        }
    }

    #[test]
    fn ladder_on_a_grid() {
        assert_eq!(next_on_grid(11, 11), 22);
        assert_eq!(next_on_grid(22, 11), 33);
        assert_eq!(next_on_grid(44, 11), 66);
    }
}
