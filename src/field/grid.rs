//! The grid that the snapshots of one window share.

use super::{Axis, Domain};

/// How coordinates become lengths.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Geometry {
    /// Coordinates are lengths; node velocities are (u, v, w) in coordinate units per time unit.
    Cartesian,
    /// Axes 0 and 1 are longitude and latitude in degrees; particles move on a sphere of this radius (in the velocity's unit of
    /// length). Node velocities are horizontal vectors in geocentric Cartesian components (x to 0°E 0°N, z to the north pole),
    /// so that a pole is no singularity. Axis 2, where there is one, is a height in the unit of the radius; a horizontal length is one on
    /// the radius at every height.
    Sphere {
        /// Radius.
        radius: f64,
    },
}

/// Degrees from a pole within which a row of a grid is the pole.
const ROW_AT_POLE: f64 = 1e-6;

/// Whether a latitude in degrees is that of a pole.
pub fn is_pole(latitude: f64) -> bool {
    90.0 - latitude.abs() < ROW_AT_POLE
}

/// A rectilinear grid of two or three axes, x fastest.
#[derive(Debug, Clone, PartialEq)]
pub struct Grid {
    /// Two or three axes: x, y and, in three dimensions, z.
    pub axes: Vec<Axis>,
    /// Metric.
    pub geometry: Geometry,
    /// Slab that a two-dimensional grid is extruded over (ignored in three dimensions).
    pub slab: (f64, f64),
}

impl Grid {
    /// Number of axes: 2 or 3.
    pub fn dimensions(&self) -> usize {
        self.axes.len()
    }

    /// Nodes along x, y and z (1 where there is no z).
    pub fn shape(&self) -> [usize; 3] {
        std::array::from_fn(|k| self.axes.get(k).map_or(1, Axis::len))
    }

    /// Number of nodes.
    pub fn nodes(&self) -> usize {
        self.shape().iter().product()
    }

    /// The box that the grid covers.
    pub fn domain(&self) -> Domain {
        let corner = |k: usize, slab: f64, end: fn(&Axis) -> f64| self.axes.get(k).map_or(slab, end);
        Domain {
            min: std::array::from_fn(|k| corner(k, self.slab.0, Axis::first)),
            max: std::array::from_fn(|k| corner(k, self.slab.1, Axis::last)),
            dimensions: self.dimensions(),
        }
    }
}
