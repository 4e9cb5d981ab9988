//! Cells in which a velocity is missing, so that no particle can start there.

use super::Interpolation;
use rayon::prelude::*;
use ridgewatch_field::{Axis, DomainPoint, Grid, Snapshot, Window};
use std::sync::{Arc, OnceLock};

/// The missing cells of a window at one time.
pub struct MissingCells {
    /// Snapshots that bracket the time and have missing nodes.
    snapshots: Vec<Arc<Snapshot>>,
    /// Nodes that the interpolation reads beyond a cell on either side.
    extra_nodes: usize,
    /// Number of cells along x, y and z, and of each whether it is missing. Found by the first question: a picture asks once a step of every ray.
    known: OnceLock<([usize; 3], Vec<bool>)>,
}

impl MissingCells {
    /// No cell is missing.
    pub fn none() -> Self {
        Self { snapshots: Vec::new(), extra_nodes: 0, known: OnceLock::new() }
    }

    /// Missing cells of a window for seeds at `time`.
    pub fn at(window: &Window, time: f64, interpolation: Interpolation) -> Self {
        let times: Vec<f64> = window.snapshots().map(|s| s.time).collect();
        let after = times.partition_point(|t| *t < time);
        let exact = times.get(after).is_some_and(|t| *t == time);
        let bracket = if exact { after..after + 1 } else { after.saturating_sub(1)..(after + 1).min(times.len()) };
        let count = bracket.len();
        let snapshots = window.snapshots().skip(bracket.start).take(count).filter(|s| s.missing_nodes() > 0).cloned().collect();
        Self { snapshots, extra_nodes: usize::from(interpolation == Interpolation::Cubic), known: OnceLock::new() }
    }

    /// True if no cell is missing.
    pub fn is_empty(&self) -> bool {
        self.snapshots.is_empty()
    }

    /// True if a node that the interpolation reads at the seed has no velocity.
    pub fn is_missing(&self, seed: DomainPoint) -> bool {
        let Some(grid) = self.grid() else { return false };
        let [x, y, z] = std::array::from_fn(|k| grid.axes.get(k).map_or(0, |axis| cell_at(axis, f64::from(seed.0[k]))));
        let ([across, along, _], missing) = self.known(grid);
        missing[(z * along + y) * across + x]
    }

    /// The grid and, for each of its cells (x fastest), whether the cell is missing; `None` if no cell is. A periodic axis has a cell
    /// between its last node and the image of the first.
    pub fn cells(&self) -> Option<(Arc<Grid>, Vec<bool>)> {
        let grid = self.grid()?;
        let count = cell_counts(grid);
        let cells =
            (0..count.iter().product()).into_par_iter().with_min_len(1 << 12).map(|i| self.is_cell_missing(cell(i, count))).collect();
        Some((grid.clone(), cells))
    }

    fn known(&self, grid: &Grid) -> &([usize; 3], Vec<bool>) {
        self.known.get_or_init(|| {
            let count = cell_counts(grid);
            // On this thread alone: a pool might run another question here, which would wait for this one.
            (count, (0..count.iter().product()).map(|i| self.is_cell_missing(cell(i, count))).collect())
        })
    }

    fn grid(&self) -> Option<&Arc<Grid>> {
        self.snapshots.first().map(|snapshot| &snapshot.grid)
    }

    /// True if a node that the interpolation reads in a cell has no velocity.
    fn is_cell_missing(&self, cell: [usize; 3]) -> bool {
        self.snapshots.iter().any(|snapshot| {
            let axes = &snapshot.grid.axes;
            let [nx, ny, _] = snapshot.grid.shape();
            let width = 2 + 2 * self.extra_nodes;
            let nodes: [[usize; 4]; 3] =
                std::array::from_fn(|k| axes.get(k).map_or([0; 4], |axis| nodes_read(axis, cell[k], self.extra_nodes)));
            let along = |k: usize| if k < axes.len() { width } else { 1 };
            (0..along(0) * along(1) * along(2)).any(|i| {
                let (x, y, z) = (i % along(0), i / along(0) % along(1), i / (along(0) * along(1)));
                snapshot.nodes[(nodes[2][z] * ny + nodes[1][y]) * nx + nodes[0][x]][3].is_nan()
            })
        })
    }
}

/// Number of cells along x, y and z.
fn cell_counts(grid: &Grid) -> [usize; 3] {
    std::array::from_fn(|k| grid.axes.get(k).map_or(1, Axis::cells))
}

/// Place along x, y and z of cell `i`, x fastest.
fn cell(i: usize, [across, along, _]: [usize; 3]) -> [usize; 3] {
    [i % across, i / across % along, i / (across * along)]
}

/// Indices of the two nodes of a cell and of `extra_nodes` further ones on either side; the last node repeats past an end of the axis.
fn nodes_read(axis: &Axis, cell: usize, extra_nodes: usize) -> [usize; 4] {
    let n = axis.len();
    let (low, high) = (cell, (cell + 1) % n);
    if extra_nodes == 0 {
        return [low, high, high, high];
    }
    match axis.period() {
        Some(_) => [(low + n - 1) % n, low, high, (high + 1) % n],
        None => [low.saturating_sub(1), low, high, (high + 1).min(n - 1)],
    }
}

/// Index of the cell around a coordinate, which is that of its lower node; the nearest cell outside of the axis.
fn cell_at(axis: &Axis, x: f64) -> usize {
    let nodes = axis.coordinates();
    let x = axis.period().map_or(x, |period| axis.first() + (x - axis.first()).rem_euclid(period));
    // On even axes, the place by the mean spacing is off by rounding at most.
    let guess = ((x - nodes[0]) / (nodes[nodes.len() - 1] - nodes[0]) * (nodes.len() - 1) as f64) as usize;
    let guess = guess.min(nodes.len() - 1) + 1;
    let is_above = |at: usize| at.checked_sub(1).is_none_or(|below| nodes[below] <= x) && nodes.get(at).is_none_or(|c| *c > x);
    let above = [guess, guess + 1, guess.saturating_sub(1)].into_iter().find(|&at| at <= nodes.len() && is_above(at));
    let above = above.unwrap_or_else(|| nodes.partition_point(|c| *c <= x));
    match axis.period() {
        Some(_) => (above + nodes.len() - 1) % nodes.len(),
        None => above.clamp(1, nodes.len() - 1) - 1,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use ridgewatch_field::Geometry;

    #[test]
    fn a_missing_corner_makes_its_four_cells_missing() {
        let lon = Axis::uniform("lon", "", 0.0, 270.0, 4).unwrap().with_period(360.0);
        let lat = Axis::uniform("lat", "", 0.0, 3.0, 4).unwrap();
        let grid = Arc::new(Grid { axes: vec![lon, lat], geometry: Geometry::Cartesian, slab: (0.0, 1.0) });
        let mut u = vec![0.0; 16];
        u[4] = f32::NAN; // longitude 0, latitude 1
        let mut window = Window::new(1.0);
        for time in [0.0, 1.0] {
            window.push(Arc::new(Snapshot::from_components(time, grid.clone(), &u, &[0.0; 16], &[]))).unwrap();
        }
        let missing_cells = MissingCells::at(&window, 1.0, Interpolation::Linear);
        assert!(
            missing_cells.is_missing(DomainPoint([10.0, 0.5, 0.0])) && missing_cells.is_missing(DomainPoint([350.0, 1.5, 0.0])),
            "on both sides of the seam"
        );
        let wider = MissingCells::at(&window, 1.0, Interpolation::Cubic);
        assert!(
            wider.is_missing(DomainPoint([100.0, 0.5, 0.0])) && wider.is_missing(DomainPoint([10.0, 2.5, 0.0])),
            "cubic reads one node further"
        );
        assert!(!missing_cells.is_missing(DomainPoint([100.0, 0.5, 0.0])) && !missing_cells.is_missing(DomainPoint([10.0, 2.5, 0.0])));
        for missing_cells in [&missing_cells, &wider] {
            let (_, cells) = missing_cells.cells().unwrap();
            let held = |i: usize| missing_cells.is_missing(DomainPoint([90.0 * (i % 4) as f32 + 45.0, (i / 4) as f32 + 0.5, 0.0]));
            assert_eq!(cells, (0..12).map(held).collect::<Vec<_>>(), "four cells around, three along the latitude");
        }
        assert!(MissingCells::none().cells().is_none());
        u[4] = 0.0;
        window.push(Arc::new(Snapshot::from_components(2.0, grid, &u, &[0.0; 16], &[]))).unwrap();
        assert!(
            !MissingCells::at(&window, 2.0, Interpolation::Linear).is_missing(DomainPoint([10.0, 0.5, 0.0])),
            "the newest snapshot has it"
        );
        assert!(
            MissingCells::at(&window, 1.5, Interpolation::Linear).is_missing(DomainPoint([10.0, 0.5, 0.0])),
            "between snapshots both count"
        );
    }
}
