//! Gridded flow in Cartesian coordinates. A state is the distance from the first node in mean grid spacings.

use super::sampler::{GridStage, Sampler};
use super::velocity::{Coordinates, Velocity, bounds, identity, within};
use super::{Boundary, FlowError, Interpolation};
use ridgewatch_field::{DomainPoint, Grid, Window};
use ridgewatch_simd::{Gather, Real, array};

/// A window on a Cartesian grid of D axes.
#[derive(Debug, Clone)]
pub struct GridFlow<R, const D: usize> {
    sampler: Sampler<R, D>,
    bounds: [[R; D]; 2],
    /// Mean spacings.
    spacing: [f64; D],
    /// spacing[i] / spacing[j]; `None` if all spacings are equal.
    ratios: Option<[[R; D]; D]>,
}

impl<R: Real, const D: usize> GridFlow<R, D> {
    /// Prepares a window.
    pub fn new(window: &Window, grid: &Grid, boundary: Boundary, interpolation: Interpolation) -> Result<Self, FlowError> {
        let sampler = Sampler::new(window, grid, boundary, interpolation, |axes| {
            array(|c| if c == 3 { 1.0 } else { axes.get(c).map_or(0.0, |axis| 1.0 / axis.spacing) })
        })?;
        let spacing = array(|k| sampler.axes[k].spacing);
        let ends: [[f64; 2]; D] = array(|k| sampler.axes[k].ends());
        let end = |i: usize| array(|k| R::from_f64(ends[k][i]));
        let equal = spacing.iter().all(|&s| s == spacing[0]);
        let ratios = array(|i| array(|j| R::from_f64(spacing[i] / spacing[j])));
        Ok(Self { bounds: bounds(boundary, end(0), end(1)), spacing, ratios: (!equal).then_some(ratios), sampler })
    }
}

impl<R: Real, const D: usize> Coordinates<D, D> for GridFlow<R, D> {
    fn sort_key(&self, point: DomainPoint) -> Option<u32> {
        Some(self.sampler.sort_key(&self.seed_state(point.0.map(f64::from))))
    }
    fn seed_state(&self, point: [f64; 3]) -> [f64; D] {
        array(|k| self.sampler.axes[k].state(point[k]))
    }
    fn initial_tangent(&self, _: [f64; 3]) -> [[f64; D]; D] {
        identity()
    }
    fn separation(&self, _: [f64; 3], axis: usize, step: f64) -> f64 {
        2.0 * step / self.spacing[axis]
    }
    fn arrival_point(&self, state: &[f64; D], seed: DomainPoint) -> DomainPoint {
        DomainPoint(array(|k| state.get(k).map_or(seed.0[k], |&x| self.sampler.axes[k].coordinate(x) as f32)))
    }
    fn coordinate_jacobian(&self, _: [f64; 3], _: &[f64; D], gradient: [[f64; D]; D]) -> [[f64; D]; D] {
        gradient
    }
    fn break_times(&self) -> &[f64] {
        self.sampler.times()
    }
}

impl<L: Gather, const D: usize> Velocity<L, D, D> for GridFlow<L::Real, D> {
    type Stage = GridStage<L::Real>;
    const HAS_MISSING: bool = true;

    fn stage(&self, time: f64) -> Self::Stage {
        self.sampler.stage(time)
    }
    #[inline(always)]
    fn velocity(&self, stage: &Self::Stage, x: &[L; D]) -> ([L; D], L) {
        let (velocity, mark) = self.sampler.value::<L, 3>(stage, x);
        (array(|i| velocity[i]), mark)
    }
    #[inline(always)]
    fn tangent(&self, stage: &Self::Stage, x: &[L; D], m: &[[L; D]; D]) -> ([L; D], [[L; D]; D], L) {
        let sample = self.sampler.sample::<L, 3>(stage, x);
        let product = array(|i| {
            array(|c| {
                let mut sum = sample.slopes[0][i] * m[0][c];
                for k in 1..D {
                    sum = sample.slopes[k][i].mul_add(m[k][c], sum);
                }
                sum
            })
        });
        (array(|i| sample.velocity[i]), product, sample.mark)
    }
    #[inline(always)]
    fn inside(&self, x: &[L; D]) -> L::Mask {
        within(&self.bounds, x)
    }
    #[inline(always)]
    fn gradient(&self, _: &[L; D], m: &[[L; D]; D]) -> [[L; D]; D] {
        match &self.ratios {
            None => *m,
            Some(ratios) => array(|i| array(|j| m[i][j] * L::splat(ratios[i][j]))),
        }
    }
}
