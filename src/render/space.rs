//! The frames of reference: domain and unit (see [`Domain`]), grid (majorant cells), and scene (lengths in f64, for camera, light and extinction).

use ridgewatch_field::{Domain, DomainPoint, UnitPoint, VERTICAL_EDGE};

/// A point in grid coordinates: majorant cells from the lower corner of the box, along each axis from 0 to the number of cells. [`SceneBox`] converts.
#[repr(transparent)]
#[derive(Debug, Clone, Copy, PartialEq, Default, bytemuck::Pod, bytemuck::Zeroable)]
pub struct GridPoint(pub [f32; 3]);

impl GridPoint {
    /// The point at distance `t` along a direction in cells per scene length.
    #[inline]
    pub fn along(self, direction: [f32; 3], t: f32) -> Self {
        Self(std::array::from_fn(|k| self.0[k] + t * direction[k]))
    }
}

/// Factors per axis from domain to scene coordinates for default views: the longer of the edges along x and y becomes 1, and their ratio is
/// kept. The third axis keeps its ratio too ([`Domain::lengths`]), unless the flow is two-dimensional (the thickness of the slab has no
/// meaning) or the edge would be shorter than a twentieth or longer than the others; then it becomes a quarter.
///
/// A scene with a camera, the position of a light or an extinction is rendered at scale 1, with lengths in domain coordinates.
pub fn overview_scale(domain: &Domain) -> [f64; 3] {
    let lengths = domain.lengths();
    let horizontal = 1.0 / lengths[0].max(lengths[1]);
    let edge = lengths[2] * horizontal;
    let own = domain.dimensions == 3 && (0.05..=1.0).contains(&edge);
    let vertical = if own { horizontal * domain.scale[2] } else { VERTICAL_EDGE / domain.extent()[2] };
    [horizontal * domain.scale[0], horizontal * domain.scale[1], vertical]
}

/// The rendered box, in the layout that kernels read.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SceneBox {
    /// Corners in scene units.
    min: [f64; 3],
    max: [f64; 3],
    /// Domain coordinates of the lower corner.
    domain_min: [f64; 3],
    /// Scene units per majorant cell.
    cell_edge: [f64; 3],
    /// Domain units per majorant cell.
    cell_extent: [f64; 3],
    /// [`Domain::inward_corners`], so that no query lies outside of the box.
    inward_min: [f32; 3],
    inward_max: [f32; 3],
    cells: [i32; 3],
    pad: i32,
}

impl SceneBox {
    /// A box around `domain` (edges times `scale` in scene units) with this number of majorant cells per axis.
    pub fn new(domain: &Domain, scale: [f64; 3], cells: [usize; 3]) -> Self {
        let extent = domain.extent();
        let [inward_min, inward_max] = domain.inward_corners();
        Self {
            min: std::array::from_fn(|k| domain.min[k] * scale[k]),
            max: std::array::from_fn(|k| domain.max[k] * scale[k]),
            domain_min: domain.min,
            inward_min,
            inward_max,
            cell_edge: std::array::from_fn(|k| extent[k] * scale[k] / cells[k] as f64),
            cell_extent: std::array::from_fn(|k| extent[k] / cells[k] as f64),
            cells: cells.map(|n| n as i32),
            pad: 0,
        }
    }

    /// Majorant cells per axis.
    pub fn cells(&self) -> [usize; 3] {
        self.cells.map(|n| n as usize)
    }

    /// Edges in scene units.
    pub fn edges(&self) -> [f64; 3] {
        std::array::from_fn(|k| self.max[k] - self.min[k])
    }

    /// Middle of the box in scene units.
    pub fn centre(&self) -> [f64; 3] {
        std::array::from_fn(|k| 0.5 * (self.min[k] + self.max[k]))
    }

    /// Unit coordinates of grid coordinates.
    #[inline]
    pub fn unit_of_grid(&self, grid: GridPoint) -> UnitPoint {
        UnitPoint(self.unit_direction(grid.0))
    }

    /// Grid coordinates of unit coordinates.
    #[inline]
    pub fn grid_of_unit(&self, unit: UnitPoint) -> GridPoint {
        GridPoint(std::array::from_fn(|k| unit.0[k] * self.cells[k] as f32))
    }

    /// Distances at which a ray enters and leaves the box; `None` if it misses the box or the box lies behind.
    pub fn intersect(&self, origin: [f64; 3], direction: [f64; 3]) -> Option<(f64, f64)> {
        let (mut enter, mut leave) = (0.0_f64, f64::INFINITY);
        for k in 0..3 {
            if direction[k] == 0.0 {
                if origin[k] < self.min[k] || origin[k] > self.max[k] {
                    return None;
                }
                continue;
            }
            let (a, b) = ((self.min[k] - origin[k]) / direction[k], (self.max[k] - origin[k]) / direction[k]);
            enter = enter.max(a.min(b));
            leave = leave.min(a.max(b));
        }
        (enter < leave).then_some((enter, leave))
    }

    /// Grid coordinates of a scene point, clamped to the grid.
    pub fn grid_point(&self, point: [f64; 3]) -> GridPoint {
        GridPoint(std::array::from_fn(|k| (((point[k] - self.min[k]) / self.cell_edge[k]) as f32).clamp(0.0, self.cells[k] as f32)))
    }

    /// Domain coordinates of a scene point; `None` outside of the box.
    pub fn point_within(&self, point: [f64; 3]) -> Option<DomainPoint> {
        let inside = (0..3).all(|k| (self.min[k]..=self.max[k]).contains(&point[k]));
        inside.then(|| {
            self.inward(std::array::from_fn(|k| self.domain_min[k] + (point[k] - self.min[k]) / self.cell_edge[k] * self.cell_extent[k]))
        })
    }

    /// Domain coordinates in single precision, clamped to the box.
    pub fn inward(&self, domain: [f64; 3]) -> DomainPoint {
        DomainPoint(std::array::from_fn(|k| (domain[k] as f32).clamp(self.inward_min[k], self.inward_max[k])))
    }

    /// Grid coordinates of a domain point, clamped to the grid.
    pub fn grid_of_domain(&self, point: DomainPoint) -> GridPoint {
        GridPoint(std::array::from_fn(|k| {
            (((f64::from(point.0[k]) - self.domain_min[k]) / self.cell_extent[k]) as f32).clamp(0.0, self.cells[k] as f32)
        }))
    }

    /// Converts a scene direction to cells per scene length.
    #[inline]
    pub fn grid_direction(&self, direction: [f64; 3]) -> [f32; 3] {
        std::array::from_fn(|k| (direction[k] / self.cell_edge[k]) as f32)
    }

    /// Scene point of grid coordinates.
    #[inline]
    pub fn scene_point(&self, grid: GridPoint) -> [f64; 3] {
        std::array::from_fn(|k| self.min[k] + f64::from(grid.0[k]) * self.cell_edge[k])
    }

    /// Domain point of grid coordinates, clamped to the box.
    #[inline]
    pub fn domain_point(&self, grid: GridPoint) -> DomainPoint {
        DomainPoint(std::array::from_fn(|k| {
            ((self.domain_min[k] + f64::from(grid.0[k]) * self.cell_extent[k]) as f32).max(self.inward_min[k]).min(self.inward_max[k])
        }))
    }

    /// Converts a grid direction (cells per scene length) to unit coordinates per scene length.
    #[inline]
    pub fn unit_direction(&self, direction: [f32; 3]) -> [f32; 3] {
        std::array::from_fn(|k| direction[k] / self.cells[k] as f32)
    }

    /// Scene length along `direction` (cells per scene length) from `from` to the end of the grid.
    #[inline]
    pub fn exit(&self, from: GridPoint, direction: [f32; 3]) -> f32 {
        let mut leave = f32::INFINITY;
        for k in 0..3 {
            if direction[k] != 0.0 {
                let wall = if direction[k] > 0.0 { self.cells[k] as f32 } else { 0.0 };
                leave = leave.min((wall - from.0[k]) / direction[k]);
            }
        }
        leave.max(0.0)
    }
}

pub fn subtract(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    std::array::from_fn(|k| a[k] - b[k])
}

pub fn scaled(a: [f64; 3], factor: f64) -> [f64; 3] {
    a.map(|v| v * factor)
}

pub fn dot(a: [f64; 3], b: [f64; 3]) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

pub fn cross(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

pub fn length(a: [f64; 3]) -> f64 {
    dot(a, a).sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rays_meet_the_box_where_they_should() {
        let space = SceneBox::new(&Domain::cuboid([0.0; 3], [2.0, 1.0, 1.0]), [1.0; 3], [4, 2, 2]);
        assert_eq!(space.intersect([1.0, 0.5, 3.0], [0.0, 0.0, -1.0]), Some((2.0, 3.0)));
        assert_eq!(space.intersect([1.0, 0.5, 0.25], [0.0, 0.0, -1.0]), Some((0.0, 0.25)), "an eye inside starts at itself");
        assert_eq!(space.intersect([1.0, 0.5, -1.0], [0.0, 0.0, -1.0]), None, "behind");
        assert_eq!(space.intersect([1.0, 1.5, 3.0], [0.0, 0.0, -1.0]), None, "beside, parallel to a face");
        let oblique = space.intersect([-1.0, -1.0, 0.5], [0.6, 0.8, 0.0]).unwrap();
        // Enters x = 0 at 1/0.6, leaves y = 1 at 2/0.8; f64 rounding.
        assert!((oblique.0 - 1.0 / 0.6).abs() < 1e-12 && (oblique.1 - 2.5).abs() < 1e-12);
    }

    #[test]
    fn queries_never_leave_the_domain() {
        // 0.1 and 0.7 round up and down in f32.
        let domain = Domain::cuboid([0.1, 0.7, -0.3], [0.7, 1.1, 0.1]);
        let space = SceneBox::new(&domain, [3.0; 3], [3, 5, 7]);
        for grid in [[0.0, 0.0, 0.0], [3.0, 5.0, 7.0]].map(GridPoint) {
            assert!(domain.contains(space.domain_point(grid)), "{grid:?}");
        }
        let middle = space.domain_point(space.grid_point([1.2, 2.7, -0.3]));
        (0..3).for_each(|k| assert!((middle.0[k] - [0.4, 0.9, -0.1][k]).abs() < 1e-6, "f32 rounding: {middle:?}"));
    }

    #[test]
    fn overviews_keep_shapes_and_tame_units() {
        assert_eq!(overview_scale(&Domain::cuboid([0.0; 3], [2.0, 1.0, 0.5])), [0.5; 3]);
        assert_eq!(overview_scale(&Domain::cuboid([0.0; 3], [360.0, 180.0, 30_000.0]))[2], 0.25 / 30_000.0);
        assert_eq!(overview_scale(&Domain::slab([0.0; 2], [50.0, 100.0], (0.0, 1.0))), [0.01, 0.01, 0.25]);
    }
}
