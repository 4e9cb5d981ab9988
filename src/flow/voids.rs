//! Cells in which no particle can start.

use super::Interpolation;
use crate::field::{Axis, Snapshot, Window};
use std::sync::Arc;

/// The snapshots that bracket the start time, where any of their velocities is missing, and how many nodes an interpolation reads
/// beyond a cell on either side.
pub struct Voids {
    snapshots: Vec<Arc<Snapshot>>,
    beyond: usize,
}

impl Voids {
    /// Velocity everywhere.
    pub fn none() -> Self {
        Self { snapshots: Vec::new(), beyond: 0 }
    }

    /// Of a window, for seeds at `time`.
    pub fn at(window: &Window, time: f64, interpolation: Interpolation) -> Self {
        let times: Vec<f64> = window.snapshots().map(|s| s.time).collect();
        let after = times.partition_point(|t| *t < time);
        let exact = times.get(after).is_some_and(|t| *t == time);
        let bracket = if exact { after..after + 1 } else { after.saturating_sub(1)..(after + 1).min(times.len()) };
        let count = bracket.len();
        let snapshots = window.snapshots().skip(bracket.start).take(count).filter(|s| s.missing() > 0).cloned().collect();
        Self { snapshots, beyond: usize::from(interpolation == Interpolation::Cubic) }
    }

    /// Whether a node that the interpolation reads at the seed has no velocity.
    pub fn hold(&self, seed: [f32; 3]) -> bool {
        self.snapshots.iter().any(|snapshot| {
            let axes = &snapshot.grid.axes;
            let [nx, ny, _] = snapshot.grid.shape();
            let width = 2 + 2 * self.beyond;
            let mut nodes = [[0; 4]; 3];
            for (k, axis) in axes.iter().enumerate() {
                nodes[k] = stencil(axis, f64::from(seed[k]), self.beyond);
            }
            let along = |k: usize| if k < axes.len() { width } else { 1 };
            (0..along(0) * along(1) * along(2)).any(|i| {
                let (x, y, z) = (i % along(0), i / along(0) % along(1), i / (along(0) * along(1)));
                snapshot.nodes[(nodes[2][z] * ny + nodes[1][y]) * nx + nodes[0][x]][3].is_nan()
            })
        })
    }
}

/// Indices of the nodes around a coordinate, `beyond` further ones on either side (the last ones again past an end of the axis).
fn stencil(axis: &Axis, x: f64, beyond: usize) -> [usize; 4] {
    let [low, high] = cell(axis, x);
    if beyond == 0 {
        return [low, high, high, high];
    }
    let n = axis.len();
    match axis.period() {
        Some(_) => [(low + n - 1) % n, low, high, (high + 1) % n],
        None => [low.saturating_sub(1), low, high, (high + 1).min(n - 1)],
    }
}

/// Indices of the nodes on either side of a coordinate; the nearest cell's outside the axis.
fn cell(axis: &Axis, x: f64) -> [usize; 2] {
    let nodes = axis.coordinates();
    let x = axis.period().map_or(x, |period| axis.first() + (x - axis.first()).rem_euclid(period));
    let above = nodes.partition_point(|c| *c <= x);
    match axis.period() {
        Some(_) => [(above + nodes.len() - 1) % nodes.len(), above % nodes.len()],
        None => {
            let above = above.clamp(1, nodes.len() - 1);
            [above - 1, above]
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::field::{Geometry, Grid};

    #[test]
    fn a_missing_corner_makes_its_four_cells_void() {
        let lon = Axis::uniform("lon", "", 0.0, 270.0, 4).unwrap().with_period(360.0);
        let lat = Axis::uniform("lat", "", 0.0, 3.0, 4).unwrap();
        let grid = Arc::new(Grid { axes: vec![lon, lat], geometry: Geometry::Cartesian, slab: (0.0, 1.0) });
        let mut u = vec![0.0; 16];
        u[4] = f32::NAN; // longitude 0, latitude 1
        let mut window = Window::new(1.0);
        for time in [0.0, 1.0] {
            window.push(Arc::new(Snapshot::from_components(time, grid.clone(), &u, &[0.0; 16], &[]))).unwrap();
        }
        let voids = Voids::at(&window, 1.0, Interpolation::Linear);
        assert!(voids.hold([10.0, 0.5, 0.0]) && voids.hold([350.0, 1.5, 0.0]), "on both sides of the seam");
        let wider = Voids::at(&window, 1.0, Interpolation::Cubic);
        assert!(wider.hold([100.0, 0.5, 0.0]) && wider.hold([10.0, 2.5, 0.0]), "cubic reads one node further");
        assert!(!voids.hold([100.0, 0.5, 0.0]) && !voids.hold([10.0, 2.5, 0.0]));
        u[4] = 0.0;
        window.push(Arc::new(Snapshot::from_components(2.0, grid, &u, &[0.0; 16], &[]))).unwrap();
        assert!(!Voids::at(&window, 2.0, Interpolation::Linear).hold([10.0, 0.5, 0.0]), "the newest snapshot has it");
        assert!(Voids::at(&window, 1.5, Interpolation::Linear).hold([10.0, 0.5, 0.0]), "between snapshots both count");
    }
}
