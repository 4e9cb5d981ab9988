//! The tensor-product cubic B-spline through the nodes of a field, as its surrogate between them: twice continuously differentiable, its derivatives exact
//! at every point (Unser, Aldroubi and Eden, B-spline signal processing, IEEE Trans. Signal Processing 41, 1993). Tables and hash grids are linear between
//! their nodes: their second derivatives are 0 or none.

use rayon::prelude::*;

/// A spline over a regular grid, first axis fastest.
pub(super) struct Spline<const D: usize> {
    size: [usize; D],
    coefficients: Vec<f64>,
}

/// Value and derivatives by the numbers of nodes.
pub(super) struct Derivatives<const D: usize> {
    pub(super) value: f64,
    pub(super) gradient: [f64; D],
    pub(super) hessian: [[f64; D]; D],
}

impl<const D: usize> Spline<D> {
    /// The spline through these values. Missing ones (not finite) cut it: each row of known nodes ends there as at the edge of the grid.
    pub(super) fn through(values: &[f64], size: [usize; D]) -> Self {
        let mut coefficients = values.to_vec();
        for axis in 0..D {
            let stride: usize = size[..axis].iter().product();
            let length = size[axis];
            let row = |number: usize| {
                let first = number / stride * stride * length + number % stride;
                let mut row: Vec<f64> = (0..length).map(|n| coefficients[first + n * stride]).collect();
                row.split_mut(|value| !value.is_finite()).for_each(filter);
                row
            };
            let rows: Vec<Vec<f64>> = (0..coefficients.len() / length.max(1)).into_par_iter().map(row).collect();
            let of_row = |node: usize| rows[node / (stride * length) * stride + node % stride][node / stride % length];
            coefficients = (0..coefficients.len()).into_par_iter().map(of_row).collect();
        }
        Self { coefficients: extended(&coefficients, size), size }
    }

    /// Value and derivatives at `share` of the way from node to node in the cell after this node, which lies within the grid.
    pub(super) fn at(&self, node: [usize; D], share: [f64; D]) -> Derivatives<D> {
        let mut all = Derivatives { value: 0.0, gradient: [0.0; D], hessian: [[0.0; D]; D] };
        self.near(node, share, |coefficient, weights| {
            let product = |of: [usize; D]| coefficient * (0..D).map(|k| weights[k][of[k]]).product::<f64>();
            all.value += product([0; D]);
            for k in 0..D {
                all.gradient[k] += product(std::array::from_fn(|m| usize::from(m == k)));
                for l in k..D {
                    all.hessian[k][l] += product(std::array::from_fn(|m| usize::from(m == k) + usize::from(m == l)));
                }
            }
        });
        for k in 0..D {
            (0..k).for_each(|l| all.hessian[k][l] = all.hessian[l][k]);
        }
        all
    }

    /// The gradient of [`Spline::at`].
    pub(super) fn gradient(&self, node: [usize; D], share: [f64; D]) -> [f64; D] {
        let mut gradient = [0.0; D];
        self.near(node, share, |coefficient, weights| {
            for (k, slope) in gradient.iter_mut().enumerate() {
                *slope += coefficient * (0..D).map(|m| weights[m][usize::from(m == k)]).product::<f64>();
            }
        });
        gradient
    }

    /// Calls `add` with each coefficient that a point depends on, and the weights of value, first and second derivative along each axis.
    fn near(&self, node: [usize; D], share: [f64; D], mut add: impl FnMut(f64, [[f64; 3]; D])) {
        let weights = share.map(weights);
        // On a node the fourth basis function is 0, and may lie beyond the grid.
        let counts = share.map(|t| if t == 0.0 { 3 } else { 4 });
        for number in 0..counts.iter().product() {
            let (mut rest, mut place, mut stride) = (number, 0, 1);
            let of_axes = std::array::from_fn(|k| {
                let n = rest % counts[k];
                rest /= counts[k];
                place += (node[k] + n - 1) * stride;
                stride *= self.size[k];
                weights[k][n]
            });
            add(self.coefficients[place], of_axes);
        }
    }
}

/// Value, first and second derivative of the four cubic B-splines of a cell.
fn weights(t: f64) -> [[f64; 3]; 4] {
    let u = 1.0 - t;
    let outer = |t: f64| [t.powi(3) / 6.0, t * t / 2.0, t];
    let inner = |t: f64| [2.0 / 3.0 - t * t + t.powi(3) / 2.0, 1.5 * t * t - 2.0 * t, 3.0 * t - 2.0];
    // Those on the other side are mirrored.
    let mirrored = |[value, first, second]: [f64; 3]| [value, -first, second];
    [mirrored(outer(u)), inner(t), mirrored(inner(u)), outer(t)]
}

/// Coefficients of the spline through a row of values, in place: c[i - 1] + 4 c[i] + c[i + 1] = 6 f[i], and f - f'' / 6 at the ends.
fn filter(row: &mut [f64]) {
    let n = row.len();
    // Second differences at the ends, of third and, in rows of three, of first order.
    let [first, last] = match *row {
        [a, b, c] => [a - 2.0 * b + c; 2],
        [a, b, c, d, ..] => [2.0 * a - 5.0 * b + 4.0 * c - d, 2.0 * row[n - 1] - 5.0 * row[n - 2] + 4.0 * row[n - 3] - row[n - 4]],
        _ => return,
    };
    row[0] -= first / 6.0;
    row[n - 1] -= last / 6.0;
    // Gaussian elimination.
    let mut pivots = vec![0.0; n];
    for i in 1..n - 1 {
        pivots[i] = 1.0 / (4.0 - pivots[i - 1]);
        row[i] = (6.0 * row[i] - row[i - 1]) * pivots[i];
    }
    for i in (1..n - 1).rev() {
        row[i] -= pivots[i] * row[i + 1];
    }
}

/// Coefficients with those of missing nodes beside known ones, linearly from the known ones in a row, averaged: diagonals of cells reach nodes which
/// need not be known for derivatives at their ends.
fn extended<const D: usize>(coefficients: &[f64], size: [usize; D]) -> Vec<f64> {
    let beside = |node: usize| {
        let (mut sum, mut count, mut stride) = (0.0, 0.0, 1);
        for length in size {
            let at = node / stride % length;
            let low = (at >= 2).then(|| 2.0 * coefficients[node - stride] - coefficients[node - 2 * stride]);
            let high = (at + 2 < length).then(|| 2.0 * coefficients[node + stride] - coefficients[node + 2 * stride]);
            for value in [low, high].into_iter().flatten().filter(|value| value.is_finite()) {
                (sum, count) = (sum + value, count + 1.0);
            }
            stride *= length;
        }
        sum / count
    };
    (0..coefficients.len())
        .into_par_iter()
        .map(|node| if coefficients[node].is_finite() { coefficients[node] } else { beside(node) })
        .collect()
}

/// Zero in [0, 1] of a function with the values `low` and `high` at its ends, of opposite signs, by the Illinois method (Dowell and Jarratt, A modified
/// regula falsi method, BIT 11, 1971).
pub(super) fn zero(low: f64, high: f64, of: impl Fn(f64) -> f64) -> f64 {
    let (mut ends, mut values) = ([0.0, 1.0], [low, high]);
    let mut last = 2;
    let mut t = 0.5;
    for _ in 0..20 {
        t = (ends[0] * values[1] - ends[1] * values[0]) / (values[1] - values[0]);
        let value = of(t);
        let side = usize::from((value >= 0.0) == (high >= 0.0));
        let moved = (t - ends[side]).abs();
        (ends[side], values[side]) = (t, value);
        if value == 0.0 || moved < 1e-9 {
            break;
        }
        // An end that stays twice would slow it down.
        if side == last {
            values[1 - side] /= 2.0;
        }
        last = side;
    }
    t
}

#[cfg(test)]
mod tests {
    use super::{Spline, zero};

    /// A polynomial, cubic along each axis, with its derivatives, which the spline has exactly but for its ends.
    #[test]
    fn a_cubic_is_exact_with_its_derivatives() {
        let size = [24, 23];
        let of = |x: f64, y: f64| (0.001 * x.powi(3) - 0.02 * x * x) * (1.0 + 0.1 * y - 0.004 * y * y);
        let mut values: Vec<f64> = (0..size[0] * size[1]).map(|k| of((k % size[0]) as f64, (k / size[0]) as f64)).collect();
        let check = |values: &[f64], most: f64| {
            let (node, share) = ([11, 10], [0.3, 0.8]);
            let (found, x, y) = (Spline::through(values, size).at(node, share), 11.3, 10.8);
            let (p, dp, ddp) = (0.001 * x * x * x - 0.02 * x * x, 0.003 * x * x - 0.04 * x, 0.006 * x - 0.04);
            let (q, dq, ddq) = (1.0 + 0.1 * y - 0.004 * y * y, 0.1 - 0.008 * y, -0.008);
            let expected = [p * q, dp * q, p * dq, ddp * q, dp * dq, p * ddq];
            let h = found.hessian;
            let all = [found.value, found.gradient[0], found.gradient[1], h[0][0], h[0][1], h[1][1]];
            assert_eq!((h[1][0], Spline::through(values, size).gradient(node, share)), (h[0][1], found.gradient));
            let worst = all.iter().zip(expected).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
            assert!(worst < most, "{all:?}, {expected:?}");
        };
        check(&values, 1e-5);
        // Rows end at a missing node, and the cell beside it has all derivatives still.
        values[9 * 24 + 10] = f64::NAN;
        check(&values, 0.01);
    }

    #[test]
    fn the_spline_passes_through_the_nodes() {
        let values: Vec<f64> = (0..9 * 8 * 7).map(|k| (k as f64 * 12.9898).sin()).collect();
        let spline = Spline::through(&values, [9, 8, 7]);
        for node in [[1, 1, 1], [4, 3, 2], [7, 6, 5]] {
            assert!((spline.at(node, [0.0; 3]).value - values[node[0] + 9 * (node[1] + 8 * node[2])]).abs() < 1e-12, "{node:?}");
        }
    }

    #[test]
    fn a_zero_is_found() {
        for root in [0.0, 1e-3, 0.4, 0.99, 1.0] {
            let of = |t: f64| (t - root) * (1.0 + 20.0 * t * t);
            assert!((zero(of(0.0), of(1.0), of) - root).abs() < 1e-7, "{root}");
        }
    }
}
