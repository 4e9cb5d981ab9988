//! The reference: path and variational equation by the embedded Runge-Kutta pair 5(4) of Dormand and Prince (1980) in double precision, with
//! adaptive steps. Steps end at the times of the snapshots, where the time derivative of the velocity jumps.

use super::rk4::TracedBatch;
use super::stretch::{log_stretch, max_abs, rescale};
use super::velocity::Velocity;
use ridgewatch_field::DomainPoint;

/// Nodes of the pair.
const C: [f64; 7] = [0.0, 0.2, 0.3, 0.8, 8.0 / 9.0, 1.0, 1.0];
/// Coefficients of the stages; those of the last stage are the weights of order 5.
const A: [[f64; 6]; 7] = [
    [0.0; 6],
    [0.2, 0.0, 0.0, 0.0, 0.0, 0.0],
    [3.0 / 40.0, 9.0 / 40.0, 0.0, 0.0, 0.0, 0.0],
    [44.0 / 45.0, -56.0 / 15.0, 32.0 / 9.0, 0.0, 0.0, 0.0],
    [19372.0 / 6561.0, -25360.0 / 2187.0, 64448.0 / 6561.0, -212.0 / 729.0, 0.0, 0.0],
    [9017.0 / 3168.0, -355.0 / 33.0, 46732.0 / 5247.0, 49.0 / 176.0, -5103.0 / 18656.0, 0.0],
    [35.0 / 384.0, 0.0, 500.0 / 1113.0, 125.0 / 192.0, -2187.0 / 6784.0, 11.0 / 84.0],
];
/// Weights of order 5 minus weights of order 4.
const E: [f64; 7] = [71.0 / 57600.0, 0.0, -71.0 / 16695.0, 71.0 / 1920.0, -17253.0 / 339200.0, 22.0 / 525.0, -1.0 / 40.0];

/// Local error tolerance, relative to the size of position (at least 1) and tangent.
pub const TOLERANCE: f64 = 1e-10;
/// Accepted and rejected steps after which a path is abandoned; its log-stretch is NaN.
const MAX_STEPS: usize = 1_000_000;
/// Share of |tau| below which a step is accepted regardless of its error, because the velocity has a kink in it.
const MIN_STEP_SHARE: f64 = 1e-12;
/// Share of |tau| of the step that locates the edge of the domain.
const EDGE_STEP_SHARE: f64 = 1e-9;

/// Position and tangent, or their time derivative.
type State<const D: usize, const N: usize> = ([f64; D], [[f64; N]; D]);

fn combine<const D: usize, const N: usize>(from: &State<D, N>, h: f64, weights: &[f64], k: &[State<D, N>]) -> State<D, N> {
    let mut to = *from;
    for (w, k) in weights.iter().zip(k) {
        if *w == 0.0 {
            continue;
        }
        for i in 0..D {
            to.0[i] += h * w * k.0[i];
            for c in 0..N {
                to.1[i][c] += h * w * k.1[i][c];
            }
        }
    }
    to
}

/// Integrates one particle from time `from` to time `to`.
pub fn trace<V: Velocity<f64, D, N>, const D: usize, const N: usize>(
    field: &V,
    from: f64,
    to: f64,
    tolerance: f64,
    points: &[DomainPoint],
) -> TracedBatch<f64, D, N> {
    let seed = points[0].0.map(f64::from);
    let span = to - from;
    let mut state: State<D, N> = (field.seed_state(seed), field.initial_tangent(seed));
    let mut exponent = 0.0;
    let (mut alive, mut left_domain) = (field.inside(&state.0), false);
    left_domain |= !alive;
    // Ends of the intervals in which the velocity is smooth in time, in the direction of travel.
    let mut ends: Vec<f64> = field
        .break_times()
        .iter()
        .copied()
        .filter(|b| (b - from) / span > MIN_STEP_SHARE && (b - from) / span < 1.0 - MIN_STEP_SHARE)
        .collect();
    if span < 0.0 {
        ends.reverse();
    }
    ends.push(to);

    let (mut time, mut step, mut tried) = (from, span * 1e-3, 0);
    let mut gave_up = false;
    'intervals: for end in ends {
        let mut k = [([0.0; D], [[0.0; N]; D]); 7];
        let mut mark = derivative(field, time, &state, &mut k[0]);
        while alive && (end - time) / span > MIN_STEP_SHARE {
            if !mark.is_finite() {
                alive = false;
                break 'intervals;
            }
            tried += 1;
            if tried > MAX_STEPS {
                gave_up = true;
                break 'intervals;
            }
            let last = (step / (end - time)) >= 1.0;
            let h = if last { end - time } else { step };
            let mut next = state;
            for s in 1..7 {
                next = combine(&state, h, &A[s][..s], &k[..s]);
                mark += derivative(field, time + C[s] * h, &next, &mut k[s]);
            }
            let error_estimate = combine(&([0.0; D], [[0.0; N]; D]), h, &E, &k);
            let mut error = max_abs(&error_estimate.1) / (tolerance * max_abs(&next.1).max(max_abs(&state.1)));
            for i in 0..D {
                error = error.max(error_estimate.0[i].abs() / (tolerance * state.0[i].abs().max(1.0)));
            }
            let share = (h / span).abs();
            if !(mark.is_finite() && field.inside(&next.0)) {
                // Approach the edge by shorter steps, then stop.
                if share < EDGE_STEP_SHARE {
                    (alive, left_domain) = (false, mark.is_finite());
                    break 'intervals;
                }
                step = h * 0.25;
                mark = 0.0;
                continue;
            }
            let factor = if error > 0.0 { (0.9 * error.powf(-0.2)).clamp(0.2, 5.0) } else { 5.0 };
            if error <= 1.0 || share < MIN_STEP_SHARE {
                (time, state) = (if last { end } else { time + h }, next);
                let before = exponent;
                field.renormalise_with_tangent(&mut state.0, &mut state.1);
                rescale(&mut state.1, &mut exponent);
                if exponent == before {
                    // The last stage is the first stage of the next step.
                    k[0] = k[6];
                } else {
                    derivative(field, time, &state, &mut k[0]);
                }
            }
            mark = 0.0;
            // The length of a step that a snapshot time cuts short is no estimate for the next step.
            if !last || factor < 1.0 {
                step = h * factor;
            }
        }
    }
    let gradient = field.gradient(&state.0, &state.1);
    let stretch = if gave_up { f64::NAN } else { exponent.mul_add(std::f64::consts::LN_2, log_stretch(&gradient)) };
    let lifetime_share = if alive { 1.0 } else { (time - from) / span };
    TracedBatch { log_stretch: stretch, lifetime_share, left_domain, state: state.0, gradient, exponent }
}

fn derivative<V: Velocity<f64, D, N>, const D: usize, const N: usize>(field: &V, time: f64, at: &State<D, N>, k: &mut State<D, N>) -> f64 {
    let (velocity, product, mark) = field.tangent(&field.stage(time), &at.0, &at.1);
    *k = (velocity, product);
    mark
}
