//! The box that seeds and pictures cover.

/// A point in domain coordinates: those of the data (degrees on the sphere). What is traced, and where particles arrive.
#[repr(transparent)]
#[derive(Debug, Clone, Copy, PartialEq, Default, bytemuck::Pod, bytemuck::Zeroable)]
pub struct DomainPoint(pub [f32; 3]);

/// A point in unit coordinates: shares of the domain's edges, without a unit, in [0, 1] inside of the domain. What surrogates, nodes and the trust
/// map take. [`Domain`] converts.
#[repr(transparent)]
#[derive(Debug, Clone, Copy, PartialEq, Default, bytemuck::Pod, bytemuck::Zeroable)]
pub struct UnitPoint(pub [f32; 3]);

/// An axis-aligned box in the coordinates of the data (degrees on the sphere). Two-dimensional flows are extruded: no velocity depends on the
/// third axis, whose extent is the thickness of a slab.
#[derive(Debug, Clone, PartialEq)]
pub struct Domain {
    /// Lower corner.
    pub min: [f64; 3],
    /// Upper corner.
    pub max: [f64; 3],
    /// Number of axes along which the flow varies: 2 or 3.
    pub dimensions: usize,
    /// Length per coordinate unit along each axis, in one unit for all axes, so that edges compare. 1 if the axes have the same unit; see
    /// `Grid::domain` for other axes.
    pub scale: [f64; 3],
    /// True if axes 0 and 1 are longitudes and latitudes in degrees, on a sphere.
    pub is_geographic: bool,
}

impl Domain {
    /// A two-dimensional domain with a slab from `z.0` to `z.1`.
    pub fn slab(min: [f64; 2], max: [f64; 2], z: (f64, f64)) -> Self {
        Self { min: [min[0], min[1], z.0], max: [max[0], max[1], z.1], dimensions: 2, scale: [1.0; 3], is_geographic: false }
    }

    /// A three-dimensional domain.
    pub fn cuboid(min: [f64; 3], max: [f64; 3]) -> Self {
        Self { min, max, dimensions: 3, scale: [1.0; 3], is_geographic: false }
    }

    /// Upper minus lower corner, in coordinates. Edges in different units do not compare (see [`Self::lengths`]).
    pub fn extent(&self) -> [f64; 3] {
        std::array::from_fn(|k| self.max[k] - self.min[k])
    }

    /// Edge lengths in one unit, by which cells, nodes or seeds are distributed over the axes.
    pub fn lengths(&self) -> [f64; 3] {
        let extent = self.extent();
        std::array::from_fn(|k| extent[k] * self.scale[k])
    }

    /// Corners of the closed box in single precision, rounded inward: no point between them lies outside of it.
    pub fn inward_corners(&self) -> [[f32; 3]; 2] {
        let low = self.min.map(|value| if f64::from(value as f32) < value { (value as f32).next_up() } else { value as f32 });
        let high = self.max.map(|value| if f64::from(value as f32) > value { (value as f32).next_down() } else { value as f32 });
        [low, high]
    }

    /// Domain coordinates in single precision. Rounding does not lead out of the closed box if any number of single precision lies in it.
    pub fn inward(&self, point: [f64; 3]) -> DomainPoint {
        let [low, high] = self.inward_corners();
        DomainPoint(std::array::from_fn(|k| (point[k] as f32).max(low[k]).min(high[k])))
    }

    /// Converts unit coordinates in [0, 1] to domain coordinates, which lie in the box (see [`Self::inward`]).
    pub fn from_unit(&self, unit: UnitPoint) -> DomainPoint {
        let extent = self.extent();
        self.inward(std::array::from_fn(|k| self.min[k] + extent[k] * f64::from(unit.0[k])))
    }

    /// Converts domain coordinates to unit coordinates, clamped to [0, 1].
    pub fn to_unit(&self, point: DomainPoint) -> UnitPoint {
        UnitPoint(self.to_unit_unclamped(point).0.map(|x| x.clamp(0.0, 1.0)))
    }

    /// Converts domain coordinates to unit coordinates, beyond [0, 1] too: arrivals may lie outside of the domain.
    pub fn to_unit_unclamped(&self, point: DomainPoint) -> UnitPoint {
        let extent = self.extent();
        UnitPoint(std::array::from_fn(|k| ((f64::from(point.0[k]) - self.min[k]) / extent[k]) as f32))
    }

    /// True if the point lies in the closed box.
    pub fn contains(&self, point: DomainPoint) -> bool {
        (0..3).all(|k| f64::from(point.0[k]) >= self.min[k] && f64::from(point.0[k]) <= self.max[k])
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn points_of_the_unit_cube_lie_inside() {
        // Corners that single precision rounds either way, and an edge of a few of its steps.
        for (low, high) in [
            ([0.7, -0.1, 1e-3], [1.7, 0.3, 0.9]),
            ([-1.7, 100.1, -0.3], [-0.7, 200.3, 1.1]),
            ([1e7 + 0.3, -2.0, 0.0], [1e7 + 3.2, 0.1, 0.7]),
        ] {
            let domain = Domain::cuboid(low, high);
            for i in 0..27 {
                let unit = UnitPoint([i % 3, i / 3 % 3, i / 9].map(|at| at as f32 * 0.5));
                let point = domain.from_unit(unit);
                assert!(domain.contains(point), "{unit:?} of {domain:?}: {point:?}");
            }
        }
    }
}
