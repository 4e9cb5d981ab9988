//! What is marched through: the surrogate's nodes, seen through a transfer function.

use super::nodes::Nodes;
use crate::GridPoint;
use crate::tracking::FrameScene;
use ridgewatch_field::{DomainPoint, UnitPoint};

/// Largest number of quadrature points on a ray.
pub(super) const MAX_POINTS: f32 = 65_536.0;

/// Whether a point lies in a missing cell.
pub type IsMissing<'a> = &'a (dyn Fn(DomainPoint) -> bool + Sync);

/// What is marched through.
#[derive(Clone, Copy)]
pub struct Medium<'a> {
    /// Camera, light, transfer function and box.
    pub scene: &'a FrameScene<'a>,
    /// Log-stretch on nodes.
    pub nodes: &'a Nodes,
    /// `None`: every cell has data.
    pub missing: Option<IsMissing<'a>>,
}

/// Smallest distance between nodes, in scene units.
pub fn node_spacing(edges: [f64; 3], shape: [usize; 3]) -> f64 {
    (0..3).filter(|&k| shape[k] > 1).map(|k| edges[k] / (shape[k] - 1) as f64).fold(f64::INFINITY, f64::min)
}

impl Medium<'_> {
    /// Smallest distance between nodes, in scene units.
    pub fn spacing(&self) -> f64 {
        node_spacing(self.scene.space.edges(), self.nodes.shape())
    }

    /// FTLE of the surrogate at a point; `None` in missing cells.
    #[inline]
    pub fn ftle(&self, unit: UnitPoint) -> Option<f32> {
        if self.missing.is_some_and(|missing| missing(self.scene.space.domain_point(self.scene.space.grid_of_unit(unit)))) {
            return None;
        }
        Some(self.nodes.at(unit) * self.scene.inverse_tau)
    }

    /// Extinction at a point, per scene length.
    #[inline]
    pub fn extinction(&self, unit: UnitPoint) -> f32 {
        self.ftle(unit).map_or(0.0, |ftle| self.scene.transfer.extinction(ftle))
    }

    /// Optical depth from a point to the light, by the midpoint rule.
    pub fn depth_to_light(&self, point: GridPoint, step: f32) -> f32 {
        let space = self.scene.space;
        let (direction, distance, _) = self.scene.light.seen_from(space.scene_point(point));
        let direction = space.grid_direction(direction);
        let length = space.exit(point, direction).min(distance as f32);
        let count = (length / step).ceil().clamp(1.0, MAX_POINTS);
        let step = length / count;
        let at = |i: usize| space.unit_of_grid(point.along(direction, (i as f32 + 0.5) * step));
        (0..count as usize).map(|i| self.extinction(at(i))).sum::<f32>() * step
    }
}
