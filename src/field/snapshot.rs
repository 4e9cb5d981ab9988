//! The velocity at one time.

use super::{Geometry, Grid, is_pole};
use std::sync::Arc;

/// The velocity on a grid at one time.
#[derive(Debug, Clone)]
pub struct Snapshot {
    /// Time in the scene's unit (seconds for CF archives).
    pub time: f64,
    /// The grid.
    pub grid: Arc<Grid>,
    /// One node each: `[u, v, w, mark]`, x fastest, then y, then z. `mark` is 0 where the velocity is known and NaN where it is
    /// missing (land, fill value, NaN), so that a missing corner shows in every interpolation that touches it. Velocities
    /// of missing nodes are 0. On the sphere `u, v, w` are geocentric Cartesian components of the horizontal velocity (see
    /// [`Geometry::Sphere`]); with levels the mark of a known node is its vertical velocity, in units of the third axis per time.
    pub nodes: Vec<[f32; 4]>,
    /// Nodes without a velocity, counted once by whoever reads: a window that slides asks several times.
    missing: usize,
}

/// Where a velocity is unknown.
pub const MISSING: [f32; 4] = [0.0, 0.0, 0.0, f32::NAN];

impl Snapshot {
    /// A snapshot of finished nodes, one for each of the grid, as [`Self::nodes`] describes them.
    pub fn new(time: f64, grid: Arc<Grid>, nodes: Vec<[f32; 4]>) -> Self {
        let missing = nodes.iter().filter(|n| n[3].is_nan()).count();
        Self { time, grid, nodes, missing }
    }

    /// Builds the node array from separate components (`w` empty in two dimensions); any non-finite component makes the node
    /// missing. On the sphere `u` is eastward, `v` northward and `w` along the third axis; a row at a pole, where longitudes go round,
    /// becomes one vector, the mean of its known nodes.
    ///
    /// # Panics
    /// When a component has not one value a node: readers check shapes before.
    pub fn from_components(time: f64, grid: Arc<Grid>, u: &[f32], v: &[f32], w: &[f32]) -> Self {
        let count = grid.nodes();
        assert!(u.len() == count && v.len() == count && (w.is_empty() || w.len() == count), "one value a node");
        let [nx, ny, _] = grid.shape();
        let turns = |axis: usize| -> Vec<(f64, f64)> {
            if grid.geometry == Geometry::Cartesian {
                Vec::new()
            } else {
                grid.axes[axis].coordinates().iter().map(|c| c.to_radians().sin_cos()).collect()
            }
        };
        let (longitudes, latitudes) = (turns(0), turns(1));
        let mut nodes = Vec::with_capacity(count);
        for i in 0..count {
            let up = if w.is_empty() { 0.0 } else { w[i] };
            if !(u[i].is_finite() && v[i].is_finite() && up.is_finite()) {
                nodes.push(MISSING);
                continue;
            }
            nodes.push(match grid.geometry {
                Geometry::Cartesian => [u[i], v[i], up, 0.0],
                Geometry::Sphere { .. } => {
                    let ((sin_lon, cos_lon), (sin_lat, cos_lat)) = (longitudes[i % nx], latitudes[i / nx % ny]);
                    let (east, north) = (f64::from(u[i]), f64::from(v[i]));
                    [
                        (-east * sin_lon - north * sin_lat * cos_lon) as f32,
                        (east * cos_lon - north * sin_lat * sin_lon) as f32,
                        (north * cos_lat) as f32,
                        if grid.dimensions() == 3 { up } else { 0.0 },
                    ]
                }
            });
        }
        if grid.geometry != Geometry::Cartesian && grid.axes[0].period().is_some() {
            for (y, _) in grid.axes[1].coordinates().iter().enumerate().filter(|(_, latitude)| is_pole(**latitude)) {
                nodes.chunks_exact_mut(nx * ny).for_each(|level| make_one(&mut level[y * nx..(y + 1) * nx]));
            }
        }
        Self::new(time, grid, nodes)
    }

    /// Number of nodes whose velocity is missing.
    pub fn missing(&self) -> usize {
        self.missing
    }

    /// Memory of the nodes, in bytes.
    pub fn bytes(&self) -> usize {
        size_of_val(self.nodes.as_slice())
    }
}

/// Gives all known nodes of a row their mean. What longitudes beside a pole differ by is divided by the width of a cell there, so that even
/// rounding would show.
fn make_one(row: &mut [[f32; 4]]) {
    let known = || |node: &&mut [f32; 4]| !node[3].is_nan();
    let (mut sum, mut count) = ([0.0; 4], 0.0);
    for node in row.iter_mut().filter(known()) {
        sum.iter_mut().zip(*node).for_each(|(sum, value)| *sum += f64::from(value));
        count += 1.0;
    }
    row.iter_mut().filter(known()).for_each(|node| *node = sum.map(|s| (s / count) as f32));
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::field::{Axis, EARTH_RADIUS};

    #[test]
    fn a_pole_is_one_vector() {
        let longitude = Axis::uniform("lon", "degrees_east", 0.0, 270.0, 4).unwrap().with_period(360.0);
        let latitude = Axis::uniform("lat", "degrees_north", 0.0, 90.0, 3).unwrap();
        let grid =
            Arc::new(Grid { axes: vec![longitude, latitude], geometry: Geometry::Sphere { radius: EARTH_RADIUS }, slab: (0.0, 1.0) });
        // At the north pole along 0 degrees east, but for one node that says something else and one that is missing.
        let mut u = vec![1.0f32; 12];
        let mut v = vec![2.0f32; 12];
        u[8..].copy_from_slice(&[0.0, 3.0, 0.5, f32::NAN]);
        v[8..].copy_from_slice(&[-3.0, 0.0, 3.0, 0.0]);
        let snapshot = Snapshot::from_components(0.0, grid, &u, &v, &[]);
        let pole = &snapshot.nodes[8..];
        // (3, 0), (-3, 0) and (3, 0.5): the mean is (1, -0.5 / 3).
        assert!((pole[0][0] - 1.0).abs() < 1e-6 && (pole[0][1] + 0.5 / 3.0).abs() < 1e-6, "{pole:?}");
        assert!(pole[1] == pole[0] && pole[2] == pole[0] && pole[3][3].is_nan(), "{pole:?}");
        assert!(snapshot.nodes[0] != snapshot.nodes[1], "other rows stay");
    }
}
