//! Height ridges of a field in the plane: points at which the field is largest across the ridge (Eberly, Ridges in image and data analysis, 1996;
//! for the FTLE Shadden, Lekien and Marsden, Definition and properties of Lagrangian coherent structures, Physica D 212, 2005).
//!
//! With g the gradient, H the Hessian and e its unit eigenvector of the smaller eigenvalue: g . e = 0, and that eigenvalue is negative and the larger
//! one by magnitude (Lindeberg, Edge detection and ridge detection with automatic scale selection, 1998). Cells are cut into triangles whose corners agree on the
//! sign of e (Furst and Pizer, Marching ridges, 2001).

use super::contour::{Edge, Segments};
use super::smoothing::smoothed;
use rayon::prelude::*;

/// A field on a regular grid, x fastest. Values that are not finite are missing.
#[derive(Debug, Clone, PartialEq)]
pub struct Field {
    /// Coordinates of the first node.
    pub origin: [f64; 2],
    /// Distance of nodes, in coordinates.
    pub step: [f64; 2],
    /// Nodes along x and y.
    pub size: [usize; 2],
    /// Values.
    pub values: Vec<f32>,
    /// Length of a coordinate unit along x and y in each row, in one unit: metres for degrees on a sphere, 1 for Cartesian coordinates.
    pub scale: Vec<[f64; 2]>,
}

/// What counts as a ridge.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Strength {
    /// Percentile of the field, 0 to 100, that the mean over a ridge reaches. Points below three quarters of it belong to no ridge.
    pub percentile: f64,
    /// Percentile of the sharpness of all ridge points that are not cut off by their value, below which points belong to no ridge.
    pub sharpness: f64,
    /// Least length of a line, in nodes; least area of a surface, in squares of nodes.
    pub extent: f64,
    /// Standard deviation of the Gaussian that smooths the field before it is differentiated, in nodes; 0 for none.
    pub smoothing: f64,
}

impl Strength {
    /// Default of ridge lines.
    pub const LINES: Self = Self { percentile: 80.0, sharpness: 0.0, extent: 30.0, smoothing: 2.0 };
    /// Default of ridge surfaces, whose grids are coarser.
    pub const SURFACES: Self = Self { percentile: 80.0, sharpness: 0.0, extent: 100.0, smoothing: 1.0 };
}

/// A point of a ridge.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RidgePoint {
    /// Coordinates.
    pub place: [f64; 2],
    /// The (smoothed) field.
    pub value: f64,
    /// Minus the second derivative across the ridge, per square of the unit of [`Field::scale`].
    pub sharpness: f64,
}

/// Gradient, eigenvector and eigenvalue at a node.
#[derive(Clone, Copy)]
struct Shape {
    /// Unit eigenvector of the smaller eigenvalue.
    across: [f64; 2],
    /// Derivative along it.
    slope: f64,
    /// The smaller eigenvalue.
    curvature: f64,
    /// Sum of both.
    trace: f64,
}

impl Field {
    /// Ridge lines.
    pub fn ridges(&self, strength: &Strength) -> Vec<Vec<RidgePoint>> {
        let smooth = smoothed(&self.values, &self.size, strength.smoothing);
        let mut known: Vec<f64> = smooth.iter().copied().filter(|v| v.is_finite()).collect();
        if known.is_empty() {
            return Vec::new();
        }
        known.par_sort_unstable_by(f64::total_cmp);
        let largest = known[known.len() - 1].abs().max(known[0].abs());
        let [least, faint] = [1.0, 0.75].map(|share| percentile(&known, share * strength.percentile));
        let shapes: Vec<Option<Shape>> = (0..smooth.len()).into_par_iter().map(|node| self.shape(&smooth, node, largest)).collect();
        let [nx, ny] = self.size;
        let mut found = Vec::new();
        for j in 0..ny.saturating_sub(1) {
            for i in 0..nx.saturating_sub(1) {
                for triangle in [[[i, j], [i + 1, j], [i, j + 1]], [[i + 1, j], [i, j + 1], [i + 1, j + 1]]] {
                    found.extend(self.cut(triangle, &shapes, &smooth, faint));
                }
            }
        }
        let sharp = least_sharpness(found.iter().flatten().map(|(_, point)| point.sharpness), strength.sharpness);
        let mut segments = Segments::new();
        found.into_iter().filter(|ends| ends.iter().all(|(_, point)| point.sharpness >= sharp)).for_each(|ends| segments.add(ends));
        let long = |line: &Vec<RidgePoint>| self.nodes_along(line) >= strength.extent;
        let strong = |line: &Vec<RidgePoint>| line.iter().map(|p| p.value).sum::<f64>() / line.len() as f64 >= least;
        segments.lines().into_iter().filter(|line| long(line) && strong(line)).collect()
    }

    /// Length of a line, in nodes.
    fn nodes_along(&self, line: &[RidgePoint]) -> f64 {
        let step = |k: usize, pair: &[RidgePoint]| (pair[1].place[k] - pair[0].place[k]) / self.step[k];
        line.windows(2).map(|pair| step(0, pair).hypot(step(1, pair))).sum()
    }

    /// Derivatives at a node by central differences. `None` at edges, beside missing nodes, and where the field is flat within rounding.
    fn shape(&self, field: &[f64], node: usize, largest: f64) -> Option<Shape> {
        let [nx, ny] = self.size;
        let (i, j) = (node % nx, node / nx);
        if i == 0 || j == 0 || i + 1 >= nx || j + 1 >= ny {
            return None;
        }
        let at = |di: isize, dj: isize| field[(node as isize + di + dj * nx as isize) as usize];
        let near = [-1, 0, 1].map(|dj| [-1, 0, 1].map(|di| at(di, dj)));
        if !near.iter().flatten().all(|v| v.is_finite()) {
            return None;
        }
        let [hx, hy] = [0, 1].map(|k| self.step[k] * self.scale[j][k]);
        let gradient = [(near[1][2] - near[1][0]) / (2.0 * hx), (near[2][1] - near[0][1]) / (2.0 * hy)];
        let xx = (near[1][2] - 2.0 * near[1][1] + near[1][0]) / (hx * hx);
        let yy = (near[2][1] - 2.0 * near[1][1] + near[0][1]) / (hy * hy);
        let xy = (near[2][2] - near[2][0] - near[0][2] + near[0][0]) / (4.0 * hx * hy);
        let (mean, half) = ((xx + yy) / 2.0, (xx - yy) / 2.0);
        let curvature = mean - half.hypot(xy);
        // Rounding of integrations in f32, whose second difference is no curvature.
        let rounding = 1e-5 * largest / hx.max(hy).powi(2);
        if !(curvature < -rounding && hx > 0.0) {
            return None;
        }
        // Both rows of H - curvature are orthogonal to the eigenvector; the longer one is exact to rounding.
        let (a, b) = ([xy, curvature - xx], [curvature - yy, xy]);
        let longer = if a[0].hypot(a[1]) > b[0].hypot(b[1]) { a } else { b };
        let length = longer[0].hypot(longer[1]);
        // Equal eigenvalues: a peak has no direction across.
        if length <= rounding {
            return None;
        }
        let across = longer.map(|c| c / length);
        Some(Shape { across, slope: gradient[0] * across[0] + gradient[1] * across[1], curvature, trace: xx + yy })
    }

    /// The segment of a triangle of nodes, whose ends are the crossings of two of its sides.
    fn cut(&self, triangle: [[usize; 2]; 3], shapes: &[Option<Shape>], smooth: &[f64], faint: f64) -> Option<[(Edge, RidgePoint); 2]> {
        let nx = self.size[0];
        let at = |[i, j]: [usize; 2]| shapes[j * nx + i];
        let [Some(a), Some(b), Some(c)] = triangle.map(at) else { return None };
        // Sides on which directions differ by 60 degrees or more belong to no common ridge. Below, the three signs cannot contradict each other.
        if [(a, b), (b, c), (c, a)].iter().any(|(p, q)| dot(p.across, q.across).abs() <= 0.5) {
            return None;
        }
        let mut ends = [(0, 1), (1, 2), (0, 2)].into_iter().filter_map(|(p, q)| self.crossing(triangle[p], triangle[q], shapes, smooth));
        let pair = [ends.next()?, ends.next()?];
        pair.iter().all(|(_, point)| point.value >= faint).then_some(pair)
    }

    /// Zero of the slope on a side, by the cubic through four nodes in a row, else linear.
    fn crossing(&self, from: [usize; 2], to: [usize; 2], shapes: &[Option<Shape>], smooth: &[f64]) -> Option<(Edge, RidgePoint)> {
        let nx = self.size[0];
        let (first, second) = ((from[1] * nx + from[0]), (to[1] * nx + to[0]));
        let (a, b) = (shapes[first]?, shapes[second]?);
        // In the direction of the first node.
        let slope = |shape: &Shape| shape.slope * dot(shape.across, a.across).signum();
        let (low, high) = (a.slope, slope(&b));
        if (low >= 0.0) == (high >= 0.0) {
            return None;
        }
        let stride = second as isize - first as isize;
        let beyond = |node: isize| {
            let shape = usize::try_from(node).ok().and_then(|node| shapes.get(node)).copied().flatten()?;
            (dot(shape.across, a.across).abs() > 0.5).then(|| slope(&shape))
        };
        let t = match (beyond(first as isize - stride), beyond(second as isize + stride)) {
            (Some(before), Some(after)) => cubic_zero([before, low, high, after]),
            _ => low / (low - high),
        };
        let between = |a: f64, b: f64| a + t * (b - a);
        if between(a.trace, b.trace) > 0.0 {
            return None;
        }
        let place = [0, 1].map(|k| self.origin[k] + self.step[k] * between(from[k] as f64, to[k] as f64));
        let point = RidgePoint { place, value: between(smooth[first], smooth[second]), sharpness: -between(a.curvature, b.curvature) };
        // Along x, along y, and the diagonal.
        let kind = if from[1] == to[1] {
            0
        } else if from[0] == to[0] {
            1
        } else {
            2
        };
        Some((3 * first.min(second) as Edge + kind, point))
    }
}

fn dot(a: [f64; 2], b: [f64; 2]) -> f64 {
    a[0] * b[0] + a[1] * b[1]
}

/// Value below which `percent` of the sorted values lie.
pub(super) fn percentile(sorted: &[f64], percent: f64) -> f64 {
    sorted[((sorted.len() - 1) as f64 * (percent / 100.0).clamp(0.0, 1.0)).round() as usize]
}

/// Sharpness below which `percent` of the ridge points lie; minus infinity for 0.
pub(super) fn least_sharpness(of: impl Iterator<Item = f64>, percent: f64) -> f64 {
    let mut sharpness: Vec<f64> = if percent > 0.0 { of.collect() } else { Vec::new() };
    sharpness.par_sort_unstable_by(f64::total_cmp);
    if sharpness.is_empty() { f64::NEG_INFINITY } else { percentile(&sharpness, percent) }
}

/// Zero in [0, 1] of the cubic through values at -1, 0, 1 and 2, which has opposite signs at 0 and 1.
pub(super) fn cubic_zero([before, low, high, after]: [f64; 4]) -> f64 {
    let cubic = |t: f64| {
        -before * t * (t - 1.0) * (t - 2.0) / 6.0 + low * (t + 1.0) * (t - 1.0) * (t - 2.0) / 2.0 - high * (t + 1.0) * t * (t - 2.0) / 2.0
            + after * (t + 1.0) * t * (t - 1.0) / 6.0
    };
    let (mut left, mut right) = (0.0, 1.0);
    for _ in 0..40 {
        let middle = (left + right) / 2.0;
        if (cubic(middle) >= 0.0) == (low >= 0.0) { left = middle } else { right = middle }
    }
    (left + right) / 2.0
}
