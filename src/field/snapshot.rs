//! The velocity at one time.

use super::{Geometry, Grid};
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
    /// missing. On the sphere `u` is eastward, `v` northward and `w` along the third axis.
    ///
    /// # Panics
    /// When a component has not one value a node: readers check shapes before.
    pub fn from_components(time: f64, grid: Arc<Grid>, u: &[f32], v: &[f32], w: &[f32]) -> Self {
        let count = grid.nodes();
        assert!(u.len() == count && v.len() == count && (w.is_empty() || w.len() == count), "one value a node");
        let [nx, ny, _] = grid.shape();
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
                    let (sin_lon, cos_lon) = grid.axes[0].coordinates()[i % nx].to_radians().sin_cos();
                    let (sin_lat, cos_lat) = grid.axes[1].coordinates()[i / nx % ny].to_radians().sin_cos();
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
