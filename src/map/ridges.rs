//! Height ridges of a field in the plane: points at which the field is largest across the ridge (Eberly, Ridges in image and data analysis, 1996;
//! for the FTLE Shadden, Lekien and Marsden, Definition and properties of Lagrangian coherent structures, Physica D 212, 2005).
//!
//! With g the gradient, H the Hessian and e its unit eigenvector of the smaller eigenvalue: g . e = 0, and that eigenvalue is negative and the larger
//! one by magnitude (Lindeberg, Edge detection and ridge detection with automatic scale selection, 1998). Cells are cut into triangles whose corners agree on the
//! sign of the direction across (Furst and Pizer, Marching ridges, 2001): e, but on the flanks of a ridge, where H has no such eigenvalue, that of H squared
//! with a share of the neighbours'. The crossing is that of the spline through the nodes, whose eigenvalues are tested there, and those of second differences
//! too: beside ridges as narrow as a node the spline swings, and would have ridges that the nodes have not.

use super::contour::{Edge, Segments};
use super::smoothing::{is_resolved, smoothed};
use super::spline::{Spline, zero};
use crate::progress::Work;
use rayon::prelude::*;
use std::sync::atomic::{AtomicUsize, Ordering};

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
    /// Percentile of the field, 0 to 100, that `extent` of a ridge reaches. Points below three quarters of the percentile belong to no ridge.
    pub percentile: f64,
    /// Percentile of the sharpness of all ridge points that are not cut off by their value, below which points belong to no ridge.
    pub sharpness: f64,
    /// Least length of a line, in nodes, or area of a surface, in squares of nodes, on which the field reaches the percentile.
    pub extent: f64,
    /// Standard deviation of the Gaussian that smooths the field before it is differentiated, in nodes; 0 for none.
    pub smoothing: f64,
    /// Least smoothing, and least length of a line, in cells of the data where these resolve the field: what is finer there is that of the interpolation. 0
    /// for none. Lines only.
    pub cells: [f64; 2],
}

impl Strength {
    /// Default of ridge lines.
    pub const LINES: Self = Self { percentile: 80.0, sharpness: 0.0, extent: 30.0, smoothing: 2.0, cells: [0.4, 1.0] };
    /// Default of ridge surfaces, whose grids are coarser.
    pub const SURFACES: Self = Self { percentile: 80.0, sharpness: 0.0, extent: 100.0, smoothing: 1.0, cells: [0.0; 2] };

    /// With another smoothing, or another least length or area, which then hold whatever the data resolve.
    pub fn with(self, smoothing: Option<f64>, extent: Option<f64>) -> Self {
        let kept = |given: Option<f64>, cells: f64| if given.is_some() { 0.0 } else { cells };
        let cells = [kept(smoothing, self.cells[0]), kept(extent, self.cells[1])];
        Self { smoothing: smoothing.unwrap_or(self.smoothing), extent: extent.unwrap_or(self.extent), cells, ..self }
    }

    /// What counts as a ridge of a field with so many nodes in a cell of the data along x and y.
    pub(super) fn over(self, field: &Field, nodes_in_cell: Option<[f64; 2]>) -> Self {
        let Some(nodes) = nodes_in_cell.filter(|nodes| is_resolved(&field.values, field.size, *nodes)) else { return self };
        let cell = (nodes[0] * nodes[1]).sqrt();
        let [smoothing, extent] = self.cells.map(|cells| cells * cell);
        Self { smoothing: self.smoothing.max(smoothing), extent: self.extent.max(extent), ..self }
    }

    /// Whether a ridge is kept of which this length or area reaches the percentile. Some of it must, however little is asked for.
    pub(super) fn suffices(&self, strong: f64) -> bool {
        strong > 0.0 && strong >= self.extent
    }
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

/// Weight of the squared Hessians of a node's neighbours in its direction across a ridge, beside 1 for its own. At an inflection they alone know it;
/// elsewhere they change little.
pub(super) const NEIGHBOUR: f64 = 0.05;

/// The direction across a ridge at a node.
#[derive(Clone, Copy)]
struct Shape {
    /// Unit eigenvector of the eigenvalue of the Hessian that is the larger one by magnitude, with a share of the neighbours' (see [`NEIGHBOUR`]).
    across: [f64; 2],
    /// Derivative along it.
    slope: f64,
}

/// The smoothed field, the spline through it, its largest magnitude, and its shape at each node. `None` at edges, beside missing nodes, and where the
/// field is flat within rounding.
struct Shapes {
    smooth: Vec<f64>,
    spline: Spline<2>,
    largest: f64,
    at: Vec<Option<Shape>>,
}

/// Second derivatives, along x and x, x and y, y and y.
type Hessian = [f64; 3];

impl Field {
    /// Ridge lines.
    pub fn ridges(&self, strength: &Strength) -> Vec<Vec<RidgePoint>> {
        let (work, done) = (Work::begin("finding ridges"), AtomicUsize::new(0));
        let smooth = smoothed(&self.values, &self.size, strength.smoothing);
        let mut known: Vec<f64> = smooth.iter().copied().filter(|v| v.is_finite()).collect();
        if known.is_empty() {
            return Vec::new();
        }
        known.par_sort_unstable_by(f64::total_cmp);
        let largest = known[known.len() - 1].abs().max(known[0].abs());
        let [least, faint] = [1.0, 0.75].map(|share| percentile(&known, share * strength.percentile));
        let spline = Spline::through(&smooth, self.size);
        let at = (0..smooth.len()).into_par_iter().map(|node| self.shape(&smooth, &spline, node, largest)).collect();
        let shapes = Shapes { smooth, spline, largest, at };
        let [columns, rows] = self.size.map(|nodes| nodes.saturating_sub(1));
        let row = |j: usize| {
            let triangles = (0..columns).flat_map(|i| [[[i, j], [i + 1, j], [i, j + 1]], [[i + 1, j], [i, j + 1], [i + 1, j + 1]]]);
            let found: Vec<[(Edge, RidgePoint); 2]> = triangles.filter_map(|triangle| self.cut(triangle, &shapes, faint)).collect();
            work.reached(done.fetch_add(1, Ordering::Relaxed) + 1, rows);
            found
        };
        let found: Vec<[(Edge, RidgePoint); 2]> = (0..rows).into_par_iter().flat_map_iter(row).collect();
        let sharp = least_sharpness(found.iter().flatten().map(|(_, point)| point.sharpness), strength.sharpness);
        let mut segments = Segments::new();
        found.into_iter().filter(|ends| ends.iter().all(|(_, point)| point.sharpness >= sharp)).for_each(|ends| segments.add(ends));
        segments.lines().into_iter().filter(|line| strength.suffices(self.strong_length(line, least))).collect()
    }

    /// Length of a line where the field is `least` or more, in nodes.
    fn strong_length(&self, line: &[RidgePoint], least: f64) -> f64 {
        let step = |k: usize, pair: &[RidgePoint]| (pair[1].place[k] - pair[0].place[k]) / self.step[k];
        let is_strong = |pair: &&[RidgePoint]| (pair[0].value + pair[1].value) / 2.0 >= least;
        line.windows(2).filter(is_strong).map(|pair| step(0, pair).hypot(step(1, pair))).sum()
    }

    /// The direction across at a node by second differences, and the slope of the spline.
    fn shape(&self, field: &[f64], spline: &Spline<2>, node: usize, largest: f64) -> Option<Shape> {
        let [nx, ny] = self.size;
        let (i, j) = (node % nx, node / nx);
        if i == 0 || j == 0 || i + 1 >= nx || j + 1 >= ny {
            return None;
        }
        let is_known = [node - nx, node, node + nx].iter().all(|row| field[row - 1..=row + 1].iter().all(|v| v.is_finite()));
        let [hx, hy] = self.lengths(node);
        if !(is_known && hx > 0.0) {
            return None;
        }
        let mut sum = square(self.hessian(field, node));
        let neighbours = [(i > 1, node - 1), (i + 2 < nx, node + 1), (j > 1, node - nx), (j + 2 < ny, node + nx)];
        for (_, neighbour) in neighbours.into_iter().filter(|(is_within, _)| *is_within) {
            let near = square(self.hessian(field, neighbour));
            if near.iter().all(|v| v.is_finite()) {
                (0..3).for_each(|k| sum[k] += NEIGHBOUR * near[k]);
            }
        }
        let [xx, xy, yy] = sum;
        let [_, larger] = eigenvalues(sum);
        let rounding = self.rounding(node, largest).powi(2);
        // Both rows of the sum minus the eigenvalue are orthogonal to the eigenvector; the longer one is exact to rounding.
        let (a, b) = ([xy, larger - xx], [larger - yy, xy]);
        let longer = if a[0].hypot(a[1]) > b[0].hypot(b[1]) { a } else { b };
        let length = longer[0].hypot(longer[1]);
        // Equal eigenvalues: a peak has no direction across.
        if larger <= rounding || length <= rounding {
            return None;
        }
        let across = longer.map(|c| c / length);
        let [x, y] = spline.gradient([i, j], [0.0; 2]);
        // A zero would have the same sign in both directions.
        let slope = dot([x / hx, y / hy], across);
        Some(Shape { across, slope: if slope == 0.0 { f64::MIN_POSITIVE } else { slope } })
    }

    /// Distances of nodes in the row of a node.
    fn lengths(&self, node: usize) -> [f64; 2] {
        [0, 1].map(|k| self.step[k] * self.scale[node / self.size[0]][k])
    }

    /// What rounding of integrations in f32 makes of second differences, which is no curvature.
    fn rounding(&self, node: usize, largest: f64) -> f64 {
        let [hx, hy] = self.lengths(node);
        1e-5 * largest / hx.max(hy).powi(2)
    }

    /// Second derivatives at a node within the grid.
    fn hessian(&self, field: &[f64], node: usize) -> Hessian {
        let ([hx, hy], nx) = (self.lengths(node), self.size[0]);
        let second = |stride: usize, h: f64| (field[node + stride] - 2.0 * field[node] + field[node - stride]) / (h * h);
        let (same, opposite) = (field[node + nx + 1] + field[node - nx - 1], field[node + nx - 1] + field[node - nx + 1]);
        [second(1, hx), (same - opposite) / (4.0 * hx * hy), second(nx, hy)]
    }

    /// The segment of a triangle of nodes, whose ends are the crossings of two of its sides.
    fn cut(&self, triangle: [[usize; 2]; 3], shapes: &Shapes, faint: f64) -> Option<[(Edge, RidgePoint); 2]> {
        let nx = self.size[0];
        let at = |[i, j]: [usize; 2]| shapes.at[j * nx + i];
        let [Some(a), Some(b), Some(c)] = triangle.map(at) else { return None };
        // Sides on which directions differ by 60 degrees or more belong to no common ridge. Below, the three signs cannot contradict each other.
        if [(a, b), (b, c), (c, a)].iter().any(|(p, q)| dot(p.across, q.across).abs() <= 0.5) {
            return None;
        }
        let mut ends = [(0, 1), (1, 2), (0, 2)].into_iter().filter_map(|(p, q)| self.crossing(triangle[p], triangle[q], shapes));
        let pair = [ends.next()?, ends.next()?];
        pair.iter().all(|(_, point)| point.value >= faint).then_some(pair)
    }

    /// Zero of the slope of the spline on a side, in a direction between those of its ends. `None` if it is no ridge.
    fn crossing(&self, from: [usize; 2], to: [usize; 2], shapes: &Shapes) -> Option<(Edge, RidgePoint)> {
        let Shapes { smooth, spline, largest, at } = shapes;
        let nx = self.size[0];
        let (first, second) = ((from[1] * nx + from[0]), (to[1] * nx + to[0]));
        let (a, b) = (at[first]?, at[second]?);
        let sign = dot(b.across, a.across).signum();
        let (low, high) = (a.slope, sign * b.slope);
        if (low >= 0.0) == (high >= 0.0) {
            return None;
        }
        let between = |t: f64, a: f64, b: f64| a + t * (b - a);
        // Differences first, since most crossings are those of valleys.
        let (about, rounding) = (low / (low - high), self.rounding(first, *largest));
        let [near, far] = [first, second].map(|node| self.hessian(smooth, node));
        sharpness([0, 1, 2].map(|k| between(about, near[k], far[k])), a.across, rounding)?;
        let at = |t: f64| [0, 1].map(|k| between(t, from[k] as f64, to[k] as f64));
        // Two corners of one cell.
        let cell = [0, 1].map(|k| from[k].min(to[k]));
        let within = |t: f64| [0, 1].map(|k| at(t)[k] - cell[k] as f64);
        let [hx, hy] = self.lengths(first);
        let t = zero(low, high, |t| {
            let [x, y] = spline.gradient(cell, within(t));
            dot([x / hx, y / hy], [0, 1].map(|k| between(t, a.across[k], sign * b.across[k])))
        });
        let exact = spline.at(cell, within(t));
        let [[xx, xy], [_, yy]] = exact.hessian;
        let sharpness = sharpness([xx / (hx * hx), xy / (hx * hy), yy / (hy * hy)], a.across, rounding)?;
        let place = [0, 1].map(|k| self.origin[k] + self.step[k] * at(t)[k]);
        // Along x, along y, and the diagonal.
        let kind = if from[1] == to[1] {
            0
        } else if from[0] == to[0] {
            1
        } else {
            2
        };
        Some((3 * first.min(second) as Edge + kind, RidgePoint { place, value: exact.value, sharpness }))
    }
}

/// Minus the smaller eigenvalue, if it is negative beyond rounding, and the larger one by magnitude, and there is no minimum across: nodes take their
/// directions from their neighbours too.
fn sharpness(hessian: Hessian, [x, y]: [f64; 2], rounding: f64) -> Option<f64> {
    let [smaller, larger] = eigenvalues(hessian);
    let [xx, xy, yy] = hessian;
    let is_highest = x * x * xx + 2.0 * x * y * xy + y * y * yy < 0.0;
    (is_highest && smaller < -rounding && smaller + larger <= 0.0).then_some(-smaller)
}

/// Square of a symmetric matrix: its eigenvectors, and squares of its eigenvalues.
fn square([xx, xy, yy]: Hessian) -> Hessian {
    [xx * xx + xy * xy, xy * (xx + yy), yy * yy + xy * xy]
}

/// The smaller eigenvalue and the larger one.
fn eigenvalues([xx, xy, yy]: Hessian) -> [f64; 2] {
    let (mean, half) = ((xx + yy) / 2.0, ((xx - yy) / 2.0).hypot(xy));
    [mean - half, mean + half]
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
