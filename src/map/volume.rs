//! A field in space and its second-order shape, by which ridge surfaces are found.

use super::ridges::NEIGHBOUR;
use super::smoothing::smoothed;
use super::spline::{Derivatives, Spline, zero};
use rayon::prelude::*;

/// A field on a regular grid in space, x fastest. Values that are not finite are missing.
#[derive(Debug, Clone, PartialEq)]
pub struct Volume {
    /// Coordinates of the first node.
    pub origin: [f64; 3],
    /// Distance of nodes, in coordinates.
    pub step: [f64; 3],
    /// Nodes along x, y and z.
    pub size: [usize; 3],
    /// Values.
    pub values: Vec<f32>,
    /// Length of a coordinate unit along x, y and z in each row of y, in one unit: kilometres for degrees and metres on a sphere, 1 for Cartesian
    /// coordinates.
    pub scale: Vec<[f64; 3]>,
    /// Rounding of the values beyond that of f32, such as that of an integration.
    pub rounding: f64,
}

/// The direction across a ridge at a node.
#[derive(Clone, Copy)]
pub(super) struct Shape {
    /// Unit eigenvector of the eigenvalue of the Hessian that is the largest by magnitude, with a share of the neighbours' (see [`NEIGHBOUR`]).
    pub(super) across: [f64; 3],
    /// Derivative along it; never 0, so that its sign turns with the direction.
    pub(super) slope: f64,
}

/// The smoothed field, the spline through it, and its shape at each node. `None` at faces of the grid, beside missing nodes, and where the field is flat within rounding.
pub(super) struct Shapes {
    pub(super) smooth: Vec<f64>,
    spline: Spline<3>,
    pub(super) at: Vec<Option<Shape>>,
    /// Rounding of the smoothed field.
    rounding: f64,
}

impl Volume {
    pub(super) fn shapes(&self, smoothing: f64) -> Shapes {
        let smooth = smoothed(&self.values, &self.size, smoothing);
        let largest = smooth.par_iter().map(|v| v.abs()).filter(|v| v.is_finite()).reduce(|| 0.0, f64::max);
        let rounding = (1e-5 * largest).max(self.rounding);
        let spline = Spline::through(&smooth, self.size);
        let at = (0..smooth.len()).into_par_iter().map(|node| self.shape(&smooth, &spline, node, rounding)).collect();
        Shapes { smooth, spline, at, rounding }
    }

    /// Minus the smallest eigenvalue of a Hessian between two nodes with shapes. `None` unless that eigenvalue is negative beyond rounding, and the
    /// largest by magnitude, and the field has no minimum across.
    fn sharpness(&self, hessian: [[f64; 3]; 3], across: [f64; 3], h: [f64; 3], rounding: f64) -> Option<f64> {
        if (0..9).map(|n| across[n / 3] * hessian[n / 3][n % 3] * across[n % 3]).sum::<f64>() >= 0.0 {
            return None;
        }
        let (values, vectors) = eigen(hessian);
        let smallest = (0..3).min_by(|k, l| values[*k].total_cmp(&values[*l]))?;
        let noise = noise(rounding, column(&vectors, smallest), h);
        let is_ridge = values[smallest] < -noise && values.iter().all(|value| *value <= -values[smallest]);
        is_ridge.then_some(-values[smallest])
    }

    /// Zero of the slope of the spline between two nodes with shapes, in a direction between those of the nodes: the share of the way, the value and the
    /// sharpness there. `axes`: those along which the nodes differ, as bits. `None` if it is no ridge of the spline, or none of second differences: beside
    /// ridges as narrow as a node the spline swings, and would have ridges that the nodes have not.
    pub(super) fn crossing(&self, shapes: &Shapes, [from, to]: [usize; 2], axes: usize) -> Option<[f64; 3]> {
        let (a, b) = (shapes.at[from].as_ref()?, shapes.at[to].as_ref()?);
        let (h, sign) = (self.lengths(from), (0..3).map(|k| a.across[k] * b.across[k]).sum::<f64>().signum());
        let (low, high) = (a.slope, sign * b.slope);
        // Differences first, since most crossings are those of valleys.
        let (about, ends) = (low / (low - high), [from, to].map(|node| self.hessian(&shapes.smooth, node, h)));
        let between = |k: usize, l: usize| ends[0][k][l] + about * (ends[1][k][l] - ends[0][k][l]);
        self.sharpness(std::array::from_fn(|k| std::array::from_fn(|l| between(k, l))), a.across, h, shapes.rounding)?;
        let cell = self.place(from);
        let within = |t: f64| std::array::from_fn(|k| if axes >> k & 1 == 1 { t } else { 0.0 });
        let t = zero(low, high, |t| {
            let gradient = shapes.spline.gradient(cell, within(t));
            (0..3).map(|k| gradient[k] / h[k] * (a.across[k] + t * (sign * b.across[k] - a.across[k]))).sum()
        });
        let Derivatives { value, hessian, .. } = shapes.spline.at(cell, within(t));
        let exact = std::array::from_fn(|k| std::array::from_fn(|l| hessian[k][l] / (h[k] * h[l])));
        Some([t, value, self.sharpness(exact, a.across, h, shapes.rounding)?])
    }

    /// Numbers of a node along x, y and z.
    pub(super) fn place(&self, node: usize) -> [usize; 3] {
        let [nx, ny, _] = self.size;
        [node % nx, node / nx % ny, node / (nx * ny)]
    }

    /// Distances of nodes in the row of a node.
    fn lengths(&self, node: usize) -> [f64; 3] {
        let row = node / self.size[0] % self.size[1];
        std::array::from_fn(|k| self.step[k] * self.scale[row][k])
    }

    /// The direction across at a node by second differences, and the slope of the spline.
    fn shape(&self, field: &[f64], spline: &Spline<3>, node: usize, rounding: f64) -> Option<Shape> {
        let [nx, ny, _] = self.size;
        let at = self.place(node);
        if (0..3).any(|k| at[k] == 0 || at[k] + 1 >= self.size[k]) {
            return None;
        }
        // 27 nodes: all that the derivatives take, and those between them, so that no missing node is near.
        let known = |k: usize| field[node + k % 3 + (k / 3 % 3) * nx + (k / 9) * nx * ny - (1 + nx + nx * ny)].is_finite();
        let h = self.lengths(node);
        if !(0..27).all(known) || !h.iter().all(|h| *h > 0.0) {
            return None;
        }
        let mut sum = square(self.hessian(field, node, h));
        for k in 0..3 {
            let [low, high] = [at[k] > 1, at[k] + 2 < self.size[k]];
            for (_, neighbour) in
                [(low, node - self.stride(k)), (high, node + self.stride(k))].into_iter().filter(|(is_within, _)| *is_within)
            {
                let near = square(self.hessian(field, neighbour, h));
                if near.as_flattened().iter().all(|v| v.is_finite()) {
                    (0..9).for_each(|n| sum[n / 3][n % 3] += NEIGHBOUR * near[n / 3][n % 3]);
                }
            }
        }
        let (values, vectors) = eigen(sum);
        let largest = (0..3).max_by(|k, l| values[*k].total_cmp(&values[*l]))?;
        let across = column(&vectors, largest);
        if values[largest] <= noise(rounding, across, h).powi(2) {
            return None;
        }
        let gradient = spline.gradient(at, [0.0; 3]);
        let slope: f64 = (0..3).map(|k| gradient[k] / h[k] * across[k]).sum();
        Some(Shape { across, slope: if slope == 0.0 { f64::MIN_POSITIVE } else { slope } })
    }

    /// Second derivatives at a node within the grid.
    fn hessian(&self, field: &[f64], node: usize, h: [f64; 3]) -> [[f64; 3]; 3] {
        let second = |k: usize, l: usize| {
            let (p, q) = (self.stride(k), self.stride(l));
            if k == l {
                (field[node + p] - 2.0 * field[node] + field[node - p]) / (h[k] * h[k])
            } else {
                let (same, opposite) = (field[node + p + q] + field[node - p - q], field[node + p - q] + field[node + q - p]);
                (same - opposite) / (4.0 * h[k] * h[l])
            }
        };
        let [xy, xz, yz] = [second(0, 1), second(0, 2), second(1, 2)];
        [[second(0, 0), xy, xz], [xy, second(1, 1), yz], [xz, yz, second(2, 2)]]
    }

    fn stride(&self, axis: usize) -> usize {
        self.size[..axis].iter().product()
    }
}

/// What rounding of the values makes of the second difference along a direction, which is no curvature.
fn noise(rounding: f64, direction: [f64; 3], h: [f64; 3]) -> f64 {
    rounding * (0..3).map(|k| (direction[k] / h[k]).powi(2)).sum::<f64>()
}

/// Square of a symmetric matrix: its eigenvectors, and squares of its eigenvalues.
fn square(a: [[f64; 3]; 3]) -> [[f64; 3]; 3] {
    std::array::from_fn(|k| std::array::from_fn(|l| (0..3).map(|m| a[k][m] * a[m][l]).sum()))
}

fn column(vectors: &[[f64; 3]; 3], k: usize) -> [f64; 3] {
    [vectors[0][k], vectors[1][k], vectors[2][k]]
}

/// Eigenvalues of a symmetric matrix, and its unit eigenvectors as columns, by cyclic Jacobi rotations (Golub and Van Loan, Matrix Computations, 8.5).
fn eigen(mut a: [[f64; 3]; 3]) -> ([f64; 3], [[f64; 3]; 3]) {
    let mut vectors = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];
    let size: f64 = a.iter().flatten().map(|v| v * v).sum();
    // Convergence is quadratic: five sweeps do.
    for _ in 0..8 {
        if a[0][1].powi(2) + a[0][2].powi(2) + a[1][2].powi(2) <= 1e-32 * size {
            break;
        }
        for (p, q) in [(0, 1), (0, 2), (1, 2)] {
            if a[p][q] == 0.0 {
                continue;
            }
            let theta = (a[q][q] - a[p][p]) / (2.0 * a[p][q]);
            let tangent = 1f64.copysign(theta) / (theta.abs() + theta.hypot(1.0));
            let cosine = 1.0 / tangent.hypot(1.0);
            let sine = tangent * cosine;
            let turn = |x: &mut f64, y: &mut f64| (*x, *y) = (cosine * *x - sine * *y, sine * *x + cosine * *y);
            for row in &mut a {
                let [mut x, mut y] = [row[p], row[q]];
                turn(&mut x, &mut y);
                (row[p], row[q]) = (x, y);
            }
            for k in 0..3 {
                let [mut x, mut y] = [a[p][k], a[q][k]];
                turn(&mut x, &mut y);
                (a[p][k], a[q][k]) = (x, y);
            }
            for row in &mut vectors {
                let [mut x, mut y] = [row[p], row[q]];
                turn(&mut x, &mut y);
                (row[p], row[q]) = (x, y);
            }
        }
    }
    ([a[0][0], a[1][1], a[2][2]], vectors)
}
