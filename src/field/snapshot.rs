//! The velocity at one time.

use super::{Geometry, Grid, is_pole};
use rayon::prelude::*;
use std::sync::Arc;

/// Nodes per task of a thread.
const NODES_PER_TASK: usize = 1 << 14;

/// The velocity on a grid at one time.
#[derive(Debug, Clone)]
pub struct Snapshot {
    /// Time in the scene's unit (seconds for CF archives).
    pub time: f64,
    /// The grid.
    pub grid: Arc<Grid>,
    /// One entry `[u, v, w, mark]` per node, x fastest, then y, then z. `mark` is 0 if the velocity is known and NaN if it is missing (land,
    /// fill value, NaN), so that a missing node makes every interpolation that reads it NaN. Velocities of missing nodes are 0. On the sphere
    /// `u, v, w` are geocentric Cartesian components of the horizontal velocity (see [`Geometry::Sphere`]). With levels the mark of a known
    /// node is its vertical velocity, in units of the third axis per time.
    pub nodes: Vec<[f32; 4]>,
    /// Number of nodes without a velocity.
    missing_nodes: usize,
}

/// Node without a velocity.
pub const MISSING: [f32; 4] = [0.0, 0.0, 0.0, f32::NAN];

impl Snapshot {
    /// A snapshot of finished nodes, in the layout of [`Self::nodes`].
    pub fn new(time: f64, grid: Arc<Grid>, nodes: Vec<[f32; 4]>) -> Self {
        let missing_nodes = count_missing(&nodes);
        Self { time, grid, nodes, missing_nodes }
    }

    /// Builds the nodes from separate components (`w` empty in two dimensions). A component that is not finite makes its node missing. On the
    /// sphere `u` is eastward, `v` northward and `w` along the third axis. On periodic longitudes a row at a pole becomes one vector, the mean
    /// of its known nodes.
    ///
    /// # Panics
    /// If a component does not have one value per node; readers check shapes before.
    pub fn from_components(time: f64, grid: Arc<Grid>, u: &[f32], v: &[f32], w: &[f32]) -> Self {
        let components = Components::new(&grid, u, v, w);
        let mut nodes: Vec<[f32; 4]> = (0..grid.nodes()).map(|i| components.node(i)).collect();
        components.average_poles(&mut nodes);
        Self::new(time, grid, nodes)
    }

    /// [`Self::from_components`] in parallel on the current rayon pool, into the memory of `nodes`. Reusing memory is faster than the page faults
    /// of a new allocation.
    ///
    /// # Panics
    /// As [`Self::from_components`].
    pub fn from_components_into(mut nodes: Vec<[f32; 4]>, time: f64, grid: Arc<Grid>, u: &[f32], v: &[f32], w: &[f32]) -> Self {
        let components = Components::new(&grid, u, v, w);
        nodes.resize(grid.nodes(), MISSING);
        nodes.par_chunks_mut(NODES_PER_TASK).enumerate().for_each(|(task, nodes)| {
            nodes.iter_mut().enumerate().for_each(|(i, node)| *node = components.node(task * NODES_PER_TASK + i));
        });
        components.average_poles(&mut nodes);
        let missing_nodes = nodes.par_chunks(NODES_PER_TASK).map(count_missing).sum();
        Self { time, grid, nodes, missing_nodes }
    }

    /// Number of nodes whose velocity is missing.
    pub fn missing_nodes(&self) -> usize {
        self.missing_nodes
    }

    /// Memory of the nodes, in bytes.
    pub fn bytes(&self) -> usize {
        size_of_val(self.nodes.as_slice())
    }
}

fn count_missing(nodes: &[[f32; 4]]) -> usize {
    nodes.iter().filter(|n| n[3].is_nan()).count()
}

/// The components from which the nodes of a snapshot are built.
struct Components<'a> {
    grid: &'a Grid,
    u: &'a [f32],
    v: &'a [f32],
    w: &'a [f32],
    shape: [usize; 3],
    /// Sine and cosine of each coordinate, on the sphere.
    longitudes: Vec<(f64, f64)>,
    latitudes: Vec<(f64, f64)>,
}

impl<'a> Components<'a> {
    fn new(grid: &'a Grid, u: &'a [f32], v: &'a [f32], w: &'a [f32]) -> Self {
        let count = grid.nodes();
        assert!(u.len() == count && v.len() == count && (w.is_empty() || w.len() == count), "one value per node");
        let sin_cos = |axis: usize| -> Vec<(f64, f64)> {
            if grid.geometry == Geometry::Cartesian {
                Vec::new()
            } else {
                grid.axes[axis].coordinates().iter().map(|c| c.to_radians().sin_cos()).collect()
            }
        };
        Self { grid, u, v, w, shape: grid.shape(), longitudes: sin_cos(0), latitudes: sin_cos(1) }
    }

    /// Node `i`, x fastest.
    fn node(&self, i: usize) -> [f32; 4] {
        let up = if self.w.is_empty() { 0.0 } else { self.w[i] };
        let (u, v) = (self.u[i], self.v[i]);
        if !(u.is_finite() && v.is_finite() && up.is_finite()) {
            return MISSING;
        }
        match self.grid.geometry {
            Geometry::Cartesian => [u, v, up, 0.0],
            Geometry::Sphere { .. } => {
                let [nx, ny, _] = self.shape;
                let ((sin_lon, cos_lon), (sin_lat, cos_lat)) = (self.longitudes[i % nx], self.latitudes[i / nx % ny]);
                let (east, north) = (f64::from(u), f64::from(v));
                [
                    (-east * sin_lon - north * sin_lat * cos_lon) as f32,
                    (east * cos_lon - north * sin_lat * sin_lon) as f32,
                    (north * cos_lat) as f32,
                    if self.grid.dimensions() == 3 { up } else { 0.0 },
                ]
            }
        }
    }

    /// Averages the rows at poles, if longitudes are periodic.
    fn average_poles(&self, nodes: &mut [[f32; 4]]) {
        let axes = &self.grid.axes;
        if self.grid.geometry == Geometry::Cartesian || axes[0].period().is_none() {
            return;
        }
        let [nx, ny, _] = self.shape;
        for (y, _) in axes[1].coordinates().iter().enumerate().filter(|(_, latitude)| is_pole(**latitude)) {
            nodes.chunks_exact_mut(nx * ny).for_each(|level| average_known(&mut level[y * nx..(y + 1) * nx]));
        }
    }
}

/// Replaces all known nodes of a row by their mean. Differences along a row at a pole are divided by the tiny width of a cell there, which would
/// amplify even rounding errors.
fn average_known(row: &mut [[f32; 4]]) {
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
    use crate::{Axis, EARTH_RADIUS};

    #[test]
    fn a_pole_is_one_vector() {
        let longitude = Axis::uniform("lon", "degrees_east", 0.0, 270.0, 4).unwrap().with_period(360.0);
        let latitude = Axis::uniform("lat", "degrees_north", 0.0, 90.0, 3).unwrap();
        let grid =
            Arc::new(Grid { axes: vec![longitude, latitude], geometry: Geometry::Sphere { radius: EARTH_RADIUS }, slab: (0.0, 1.0) });
        // The same vector at the north pole from all longitudes, except for one different node and one missing node.
        let mut u = vec![1.0f32; 12];
        let mut v = vec![2.0f32; 12];
        u[8..].copy_from_slice(&[0.0, 3.0, 0.5, f32::NAN]);
        v[8..].copy_from_slice(&[-3.0, 0.0, 3.0, 0.0]);
        let snapshot = Snapshot::from_components(0.0, grid.clone(), &u, &v, &[]);
        // The same in reused memory that is too long.
        let again = Snapshot::from_components_into(vec![[7.0; 4]; 20], 0.0, grid, &u, &v, &[]);
        let bits = |s: &Snapshot| s.nodes.iter().flatten().map(|v| v.to_bits()).collect::<Vec<_>>();
        assert_eq!((bits(&again), again.missing_nodes()), (bits(&snapshot), 1));
        let pole = &snapshot.nodes[8..];
        // (3, 0), (-3, 0) and (3, 0.5): the mean is (1, -0.5 / 3).
        assert!((pole[0][0] - 1.0).abs() < 1e-6 && (pole[0][1] + 0.5 / 3.0).abs() < 1e-6, "{pole:?}");
        assert!(pole[1] == pole[0] && pole[2] == pole[0] && pole[3][3].is_nan(), "{pole:?}");
        assert!(snapshot.nodes[0] != snapshot.nodes[1], "other rows stay");
    }
}
