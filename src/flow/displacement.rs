//! Displacements of particles between snapshots, in cells.

use rayon::prelude::*;
use ridgewatch_field::{Geometry, Snapshot, Window};
use std::sync::Arc;

/// Degrees from a pole within which displacements are not measured in cells, whose width tends to 0.
const POLAR_CAP_DEGREES: f64 = 1.0;

/// Approximate number of nodes per snapshot that [`cells_crossed`] reads.
const MAX_PROBED_NODES: usize = 4096;

/// Cells that a fast particle crosses between two times: the upper quartile of the displacement over evenly spaced nodes, summed over the
/// snapshot intervals.
pub fn cells_crossed(window: &Window, from: f64, to: f64) -> f64 {
    let snapshots: Vec<&Arc<Snapshot>> = window.snapshots().collect();
    let (from, to) = (from.min(to), from.max(to));
    let crossed = |pair: &[&Arc<Snapshot>]| {
        let interval = pair[1].time.min(to) - pair[0].time.max(from);
        if interval <= 0.0 {
            return 0.0;
        }
        // Odd, so that all columns of a grid with an even row length are read.
        let stride = (pair[0].nodes.len() / MAX_PROBED_NODES) | 1;
        let cells = CellDisplacements { snapshot: pair[0], interval };
        let mut squares: Vec<f64> = (0..pair[0].nodes.len()).step_by(stride).filter_map(|i| cells.squared(i)).collect();
        let quartile = squares.len() * 3 / 4;
        if squares.is_empty() { 0.0 } else { squares.select_nth_unstable_by(quartile, f64::total_cmp).1.sqrt() }
    };
    snapshots.windows(2).map(crossed).sum()
}

/// Displacements of a snapshot's nodes during an interval.
struct CellDisplacements<'a> {
    snapshot: &'a Snapshot,
    interval: f64,
}

impl CellDisplacements<'_> {
    /// Squared displacement of a node in cells; `None` if the velocity is missing or the node is near a pole.
    fn squared(&self, i: usize) -> Option<f64> {
        let (node, grid) = (self.snapshot.nodes[i], &*self.snapshot.grid);
        if node[3].is_nan() {
            return None;
        }
        let [nx, ny, _] = grid.shape();
        let location = [i % nx, i / nx % ny, i / nx / ny];
        // The smaller of the two cells at a node.
        let cell = |axis: usize| {
            let (c, index) = (grid.axes[axis].coordinates(), location[axis]);
            let behind = if index > 0 { c[index] - c[index - 1] } else { f64::INFINITY };
            let ahead = if index + 1 < c.len() { c[index + 1] - c[index] } else { f64::INFINITY };
            behind.min(ahead)
        };
        let v = [0, 1, 2].map(|c| f64::from(node[c]) * self.interval);
        match grid.geometry {
            Geometry::Cartesian => Some((0..grid.dimensions()).map(|k| (v[k] / cell(k)).powi(2)).sum::<f64>()),
            Geometry::Sphere { radius } => {
                let (longitude, latitude) = (grid.axes[0].coordinates()[location[0]], grid.axes[1].coordinates()[location[1]]);
                let (sin_lon, cos_lon) = longitude.to_radians().sin_cos();
                let cos_lat = latitude.to_radians().cos();
                let east = v[1] * cos_lon - v[0] * sin_lon;
                let north_squared = (v.iter().map(|c| c * c).sum::<f64>() - east * east).max(0.0);
                let (width, height) = (cell(0).to_radians() * radius * cos_lat, cell(1).to_radians() * radius);
                // With levels the fourth component of a node is its vertical velocity.
                let up = if grid.dimensions() == 3 { f64::from(node[3]) * self.interval / cell(2) } else { 0.0 };
                (latitude.abs() < 90.0 - POLAR_CAP_DEGREES).then(|| (east / width).powi(2) + north_squared / (height * height) + up * up)
            }
        }
    }
}

/// Sum of the squared displacements in cells during `interval`, number of known nodes, largest squared displacement.
pub fn displacements(snapshot: &Snapshot, interval: f64) -> (f64, usize, f64) {
    let cells = CellDisplacements { snapshot, interval };
    (0..snapshot.nodes.len())
        .into_par_iter()
        .filter_map(|i| cells.squared(i))
        .map(|square| (square, 1, square))
        .reduce(|| (0.0, 0, 0.0), |a, b| (a.0 + b.0, a.1 + b.1, a.2.max(b.2)))
}
