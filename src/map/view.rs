//! The window of a map: which place each pixel shows.

use crate::field::{Domain, DomainPoint, Geometry};
use crate::flow::VelocitySource;
use crate::render::{Projection, ProjectionKind, outline};

/// The box of the data, seen through a projection by a raster of pixels.
#[derive(Debug, Clone, PartialEq)]
pub struct View {
    /// The projection.
    pub projection: Projection,
    /// Pixels along x and y.
    pub size: [usize; 2],
    /// West (or left), south, east and north end of the data, in coordinates.
    pub region: [f64; 4],
    /// True if the coordinates are longitudes and latitudes in degrees.
    pub is_geographic: bool,
    /// Third coordinate of all seeds.
    pub level: f64,
    /// That of the data.
    domain: Domain,
    /// Left and upper end of the raster in the plane.
    corner: [f64; 2],
    /// Edge of a pixel in the plane.
    pixel: f64,
}

/// Largest number of pixels along an edge.
pub const LARGEST: usize = 4096;

/// Whether coordinates are degrees on a sphere.
pub fn is_geographic(velocity: &VelocitySource) -> bool {
    match velocity {
        VelocitySource::Window(window) => window.grid().is_some_and(|grid| matches!(grid.geometry, Geometry::Sphere { .. })),
        VelocitySource::Analytic(..) => false,
    }
}

impl View {
    /// The view of a whole domain at a level. The longer edge takes `pixels`. Without `kind` the projection is the one that fits the region.
    ///
    /// # Errors
    /// The projection cannot show the domain; the text names it, the reason and what is accepted.
    pub fn new(domain: &Domain, is_geographic: bool, kind: Option<ProjectionKind>, level: f64, pixels: usize) -> Result<Self, String> {
        let region = [domain.min[0], domain.min[1], domain.max[0], domain.max[1]];
        let kind = match kind {
            None if is_geographic => ProjectionKind::fitting(region),
            None => ProjectionKind::Plain,
            Some(kind) if !is_geographic && kind != ProjectionKind::Plain => {
                return Err("the coordinates are not longitudes and latitudes; accepted: plain".into());
            }
            Some(kind) => kind,
        };
        let projection = Projection::new(kind, region).map_err(|why| why.to_string())?;
        let [low, high] = projection.bounds(region);
        let extent = [high[0] - low[0], high[1] - low[1]];
        // Axes of different lengths, such as heights over distances, are stretched: a strip of a few pixels shows nothing.
        let longer = extent[0].max(extent[1]);
        if extent[0].min(extent[1]) * 32.0 < longer {
            return Err(format!("the domain is {} by {} in the plane, too narrow for a map; accepted: ratios to 32", extent[0], extent[1]));
        }
        let pixel = longer / pixels as f64;
        let size = extent.map(|e| ((e / pixel).round() as usize).max(1));
        Ok(Self { projection, size, region, is_geographic, level, domain: domain.clone(), corner: [low[0], high[1]], pixel })
    }

    /// Coordinates of a place in pixels, from the upper left corner. `None` outside of the data.
    pub fn place(&self, x: f64, y: f64) -> Option<[f64; 2]> {
        self.projection.place_in(self.region, [self.corner[0] + x * self.pixel, self.corner[1] - y * self.pixel])
    }

    /// Where coordinates lie, in pixels from the upper left corner.
    pub fn pixel(&self, place: [f64; 2]) -> [f64; 2] {
        let [x, y] = self.projection.forward(place);
        [(x - self.corner[0]) / self.pixel, (self.corner[1] - y) / self.pixel]
    }

    /// Lengths of the region along its two axes, in coordinates.
    pub fn region_extent(&self) -> [f64; 2] {
        let [west, south, east, north] = self.region;
        [east - west, north - south]
    }

    /// A seed at coordinates of the map, not outside of the data.
    pub fn seed(&self, [x, y]: [f64; 2]) -> DomainPoint {
        self.domain.inward([x, y, self.level])
    }

    /// The rim of the data, in pixels: a closed line, or circles of latitude where a polar map closes.
    pub fn rim(&self) -> Vec<Vec<[f64; 2]>> {
        let lines = |places: &[[f64; 2]]| places.iter().map(|place| self.pixel(*place)).collect();
        let whole = outline(self.region);
        let [west, south, east, north] = self.region;
        if matches!(self.projection, Projection::Polar { .. }) && east - west > 360.0 - 1e-6 {
            let circle = |latitude: f64| lines(&whole.iter().map(|[x, _]| [*x, latitude]).collect::<Vec<_>>());
            return [south, north].into_iter().filter(|latitude| latitude.abs() < 90.0).map(circle).collect();
        }
        vec![lines(&whole)]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn seeds_on_an_edge_lie_inside() {
        // Corners that single precision rounds outwards.
        let domain = Domain::cuboid([0.7, 0.1, -1.7], [1.7, 1.1, -0.7]);
        for level in [-1.7, -0.7] {
            let view = View::new(&domain, false, None, level, 64).unwrap();
            let [west, south, east, north] = view.region;
            for place in [[west, south], [east, north]] {
                assert!(domain.contains(view.seed(place)), "{place:?} at {level}: {:?}", view.seed(place));
            }
        }
    }
}
