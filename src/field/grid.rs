//! The grid that the snapshots of one window share.

use super::{Axis, Domain};

/// Metric of a grid: relation of coordinates to lengths.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Geometry {
    /// Coordinates are lengths; node velocities are (u, v, w) in coordinate units per time unit.
    Cartesian,
    /// Axes 0 and 1 are longitude and latitude in degrees. Particles move on a sphere. Node velocities are horizontal vectors in geocentric
    /// Cartesian components (x to 0°E 0°N, z to the north pole), so that a pole is no singularity. An optional axis 2 is a height in the
    /// unit of the radius; horizontal lengths are those on the radius at every height.
    Sphere {
        /// Radius, in the unit of length of the velocity.
        radius: f64,
    },
}

/// Default edge of a third axis that has another unit than the others, as a share of the longest other edge.
pub const VERTICAL_EDGE: f64 = 0.25;

/// Largest distance of a row of a grid from a pole, in degrees, at which it counts as the pole.
const ROW_AT_POLE: f64 = 1e-6;

/// True if a latitude in degrees is that of a pole.
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
    /// Lower and upper end of the slab over which a two-dimensional grid is extruded (ignored in three dimensions).
    pub slab: (f64, f64),
}

impl Grid {
    /// Number of axes: 2 or 3.
    pub fn dimensions(&self) -> usize {
        self.axes.len()
    }

    /// Number of nodes along x, y and z (1 along z in two dimensions).
    pub fn shape(&self) -> [usize; 3] {
        std::array::from_fn(|k| self.axes.get(k).map_or(1, Axis::len))
    }

    /// Number of nodes.
    pub fn nodes(&self) -> usize {
        self.shape().iter().product()
    }

    /// The box that the grid covers. If the third axis has another unit than the first (heights in metres over degrees), its length does not
    /// compare with the others; its edge is set to [`VERTICAL_EDGE`] of the longest.
    pub fn domain(&self) -> Domain {
        let corner = |k: usize, slab: f64, end: fn(&Axis) -> f64| self.axes.get(k).map_or(slab, end);
        let mut domain = Domain {
            min: std::array::from_fn(|k| corner(k, self.slab.0, Axis::first)),
            max: std::array::from_fn(|k| corner(k, self.slab.1, Axis::last)),
            dimensions: self.dimensions(),
            scale: [1.0; 3],
            is_geographic: matches!(self.geometry, Geometry::Sphere { .. }),
        };
        if let [x, _, z] = &self.axes[..]
            && (domain.is_geographic || units_differ(x.units(), z.units()))
        {
            let extent = domain.extent();
            domain.scale[2] = VERTICAL_EDGE * extent[0].max(extent[1]) / extent[2];
        }
        domain
    }
}

/// True if two units are known to be different. An empty unit is that of the other axis.
fn units_differ(one: &str, other: &str) -> bool {
    let unit = |text: &str| {
        // Stretched metres ("m x 20") are metres.
        let text = text.split(" x ").next().unwrap_or_default().trim().to_lowercase();
        match text.as_str() {
            "metre" | "metres" | "meter" | "meters" => "m".to_owned(),
            "kilometre" | "kilometres" | "kilometer" | "kilometers" => "km".to_owned(),
            _ => text,
        }
    };
    let [one, other] = [one, other].map(unit);
    !one.is_empty() && !other.is_empty() && one != other
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn heights_over_degrees_are_a_quarter_of_the_longest_edge() {
        let axis = |units: &str, last: f64| Axis::uniform("a", units, 0.0, last, 5).unwrap();
        let grid = |z: Axis, geometry| Grid { axes: vec![axis("degrees", 360.0), axis("degrees", 180.0), z], geometry, slab: (0.0, 1.0) };
        let globe = grid(axis("m", 32_000.0), Geometry::Sphere { radius: super::super::EARTH_RADIUS }).domain();
        assert_eq!(globe.lengths(), [360.0, 180.0, 90.0]);
        assert_eq!(globe.extent(), [360.0, 180.0, 32_000.0], "coordinates are unchanged");
        assert_eq!(grid(axis("m", 32_000.0), Geometry::Cartesian).domain().lengths(), [360.0, 180.0, 90.0]);
        assert_eq!(grid(axis("degrees", 1000.0), Geometry::Cartesian).domain().lengths(), [360.0, 180.0, 1000.0], "one unit: as it is");
        assert_eq!(grid(axis("", 1000.0), Geometry::Cartesian).domain().lengths(), [360.0, 180.0, 1000.0], "unknown unit: as it is");
        assert!(!units_differ("m", "Metres") && !units_differ("m x 20", "meter") && units_differ("km", "m"));
    }
}
