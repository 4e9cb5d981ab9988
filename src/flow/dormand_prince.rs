//! The reference: path and tangent by the embedded pair 5(4) of Dormand and Prince (1980) in double precision, step by step of its
//! own size. Steps end at the snapshots' times, where the velocity has kinks.

use super::rk4::Paths;
use super::stretch::{largest, log_stretch, rescale};
use super::velocity::Velocity;

/// Nodes, weights and error weights of the pair.
const C: [f64; 7] = [0.0, 0.2, 0.3, 0.8, 8.0 / 9.0, 1.0, 1.0];
const A: [[f64; 6]; 7] = [
    [0.0; 6],
    [0.2, 0.0, 0.0, 0.0, 0.0, 0.0],
    [3.0 / 40.0, 9.0 / 40.0, 0.0, 0.0, 0.0, 0.0],
    [44.0 / 45.0, -56.0 / 15.0, 32.0 / 9.0, 0.0, 0.0, 0.0],
    [19372.0 / 6561.0, -25360.0 / 2187.0, 64448.0 / 6561.0, -212.0 / 729.0, 0.0, 0.0],
    [9017.0 / 3168.0, -355.0 / 33.0, 46732.0 / 5247.0, 49.0 / 176.0, -5103.0 / 18656.0, 0.0],
    [35.0 / 384.0, 0.0, 500.0 / 1113.0, 125.0 / 192.0, -2187.0 / 6784.0, 11.0 / 84.0],
];
/// Fifth order less fourth.
const E: [f64; 7] = [71.0 / 57600.0, 0.0, -71.0 / 16695.0, 71.0 / 1920.0, -17253.0 / 339200.0, 22.0 / 525.0, -1.0 / 40.0];

/// Local error allowed, relative to the size of position (at least 1) and tangent.
pub const TOLERANCE: f64 = 1e-10;
/// Steps, taken or not, after which a path is given up: its log-stretch is NaN.
const MOST_STEPS: usize = 1_000_000;
/// Shares of |tau|: a step this short is taken whatever its error (a kink lies in it); a particle whose step of this length still
/// leaves the domain has arrived at the edge.
const SHORTEST: f64 = 1e-12;
const EDGE: f64 = 1e-9;

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

/// Integrates one particle from `from` to `to`.
pub fn trace<V: Velocity<f64, D, N>, const D: usize, const N: usize>(
    field: &V,
    from: f64,
    to: f64,
    tolerance: f64,
    points: &[[f32; 3]],
) -> Paths<f64, D, N> {
    let seed = points[0].map(f64::from);
    let span = to - from;
    let mut state: State<D, N> = (field.start(seed), field.first_tangent(seed));
    let mut exponent = 0.0;
    let (mut alive, mut left) = (field.inside(&state.0), false);
    left |= !alive;
    // Ends of smooth stretches of time, in the direction of travel.
    let mut ends: Vec<f64> =
        field.breaks().iter().copied().filter(|b| (b - from) / span > SHORTEST && (b - from) / span < 1.0 - SHORTEST).collect();
    if span < 0.0 {
        ends.reverse();
    }
    ends.push(to);

    let (mut time, mut step, mut tried) = (from, span * 1e-3, 0);
    let mut gave_up = false;
    'stretches: for end in ends {
        let mut k = [([0.0; D], [[0.0; N]; D]); 7];
        let mut mark = derivative(field, time, &state, &mut k[0]);
        while alive && (end - time) / span > SHORTEST {
            if !mark.is_finite() {
                alive = false;
                break 'stretches;
            }
            tried += 1;
            if tried > MOST_STEPS {
                gave_up = true;
                break 'stretches;
            }
            let last = (step / (end - time)) >= 1.0;
            let h = if last { end - time } else { step };
            let mut next = state;
            for s in 1..7 {
                next = combine(&state, h, &A[s][..s], &k[..s]);
                mark += derivative(field, time + C[s] * h, &next, &mut k[s]);
            }
            let slip = combine(&([0.0; D], [[0.0; N]; D]), h, &E, &k);
            let mut error = largest(&slip.1) / (tolerance * largest(&next.1).max(largest(&state.1)));
            for i in 0..D {
                error = error.max(slip.0[i].abs() / (tolerance * state.0[i].abs().max(1.0)));
            }
            let share = (h / span).abs();
            if !(mark.is_finite() && field.inside(&next.0)) {
                // Come as near to the edge as wanted, then stop.
                if share < EDGE {
                    (alive, left) = (false, mark.is_finite());
                    break 'stretches;
                }
                step = h * 0.25;
                mark = 0.0;
                continue;
            }
            let factor = if error > 0.0 { (0.9 * error.powf(-0.2)).clamp(0.2, 5.0) } else { 5.0 };
            if error <= 1.0 || share < SHORTEST {
                (time, state) = (if last { end } else { time + h }, next);
                let before = exponent;
                field.settle_tangent(&mut state.0, &mut state.1);
                rescale(&mut state.1, &mut exponent);
                if exponent == before {
                    // The last stage is the next step's first one.
                    k[0] = k[6];
                } else {
                    derivative(field, time, &state, &mut k[0]);
                }
            }
            mark = 0.0;
            // A step cut short by a break says nothing about the next one's length.
            if !last || factor < 1.0 {
                step = h * factor;
            }
        }
    }
    let metric = field.metric(&state.0, &state.1);
    let stretch = if gave_up { f64::NAN } else { exponent.mul_add(std::f64::consts::LN_2, log_stretch(&metric)) };
    let lived = if alive { 1.0 } else { (time - from) / span };
    Paths { log_stretch: stretch, lived, left, state: state.0, metric, exponent }
}

fn derivative<V: Velocity<f64, D, N>, const D: usize, const N: usize>(field: &V, time: f64, at: &State<D, N>, k: &mut State<D, N>) -> f64 {
    let (velocity, product, mark) = field.tangent(&field.stage(time), &at.0, &at.1);
    *k = (velocity, product);
    mark
}
