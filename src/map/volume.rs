//! A field in space and its second-order shape, by which ridge surfaces are found.

use super::smoothing::smoothed;
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

/// Gradient, eigenvector and eigenvalue at a node.
#[derive(Clone, Copy)]
pub(super) struct Shape {
    /// Unit eigenvector of the smallest eigenvalue of the Hessian.
    pub(super) across: [f64; 3],
    /// Derivative along it; never 0, so that its sign turns with the direction.
    pub(super) slope: f64,
    /// The smallest eigenvalue.
    pub(super) curvature: f64,
    /// Sum of the smallest and the largest eigenvalue: negative where the smallest is the largest by magnitude.
    pub(super) balance: f64,
}

/// The smoothed field, and its shape at each node. `None` at faces of the grid, beside missing nodes, and where the field is flat within rounding.
pub(super) struct Shapes {
    pub(super) smooth: Vec<f64>,
    pub(super) at: Vec<Option<Shape>>,
}

impl Volume {
    pub(super) fn shapes(&self, smoothing: f64) -> Shapes {
        let smooth = smoothed(&self.values, &self.size, smoothing);
        let largest = smooth.par_iter().map(|v| v.abs()).filter(|v| v.is_finite()).reduce(|| 0.0, f64::max);
        let rounding = (1e-5 * largest).max(self.rounding);
        let at = (0..smooth.len()).into_par_iter().map(|node| self.shape(&smooth, node, rounding)).collect();
        Shapes { smooth, at }
    }

    /// Derivatives at a node by central differences.
    fn shape(&self, field: &[f64], node: usize, rounding: f64) -> Option<Shape> {
        let [nx, ny, _] = self.size;
        let at = [node % nx, node / nx % ny, node / (nx * ny)];
        if (0..3).any(|k| at[k] == 0 || at[k] + 1 >= self.size[k]) {
            return None;
        }
        let strides = [1, nx, nx * ny];
        // 27 nodes: all that the derivatives take, and those between them, so that no missing node is near.
        let known = |k: usize| field[node + k % 3 + (k / 3 % 3) * nx + (k / 9) * nx * ny - (1 + nx + nx * ny)].is_finite();
        if !(0..27).all(known) {
            return None;
        }
        let h: [f64; 3] = std::array::from_fn(|k| self.step[k] * self.scale[at[1]][k]);
        if !h.iter().all(|h| *h > 0.0) {
            return None;
        }
        let gradient: [f64; 3] = std::array::from_fn(|k| (field[node + strides[k]] - field[node - strides[k]]) / (2.0 * h[k]));
        let hessian: [[f64; 3]; 3] = std::array::from_fn(|k| {
            std::array::from_fn(|l| {
                let (p, q) = (strides[k], strides[l]);
                if k == l {
                    (field[node + p] - 2.0 * field[node] + field[node - p]) / (h[k] * h[k])
                } else {
                    let (same, opposite) = (field[node + p + q] + field[node - p - q], field[node + p - q] + field[node + q - p]);
                    (same - opposite) / (4.0 * h[k] * h[l])
                }
            })
        });
        let (values, vectors) = eigen(hessian);
        let mut order = [0, 1, 2];
        order.sort_by(|a, b| values[*a].total_cmp(&values[*b]));
        let [smallest, middle, largest] = order.map(|k| values[k]);
        let across: [f64; 3] = std::array::from_fn(|k| vectors[k][order[0]]);
        // What rounding of the values makes of the second difference along this direction is no curvature. Equal eigenvalues have no direction: the
        // middle of a tube, and a peak.
        let noise = rounding * (0..3).map(|k| (across[k] / h[k]).powi(2)).sum::<f64>();
        if !(smallest < -noise && middle - smallest > noise) {
            return None;
        }
        let slope: f64 = (0..3).map(|k| gradient[k] * across[k]).sum();
        let slope = if slope == 0.0 { f64::MIN_POSITIVE } else { slope };
        Some(Shape { across, slope, curvature: smallest, balance: smallest + largest })
    }
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
