//! Gridded flow on the sphere with levels: a unit vector p as in [`super::sphere`], and a height.
//!
//! The shallow-atmosphere approximation holds: a horizontal metre is a metre on the radius of the sphere at every height. A node stores its
//! horizontal velocity as a geocentric vector and its vertical velocity in place of the mark (see [`ridgewatch_field::Snapshot::nodes`]). The
//! interpolation therefore never mixes them: vertical winds are a thousand times weaker than horizontal ones. Lengths of the tangent are in
//! radii, along (east, north, up).

use super::sampler::{GridStage, Sampler};
use super::sphere::{Globe, MIN_COSINE, dot, normalised, project, project_derivative, trigonometry};
use super::velocity::{Coordinates, Velocity, angle_slack, bounds, within};
use super::{Boundary, FlowError, Interpolation};
use ridgewatch_field::{DomainPoint, Grid, Window};
use ridgewatch_simd::{Gather, Real, array};

/// A window on a grid of longitude, latitude (degrees) and height (the unit of the radius).
#[derive(Debug, Clone)]
pub struct LayeredSphereFlow<R> {
    sampler: Sampler<R, 3>,
    bounds: [[R; 3]; 2],
    globe: Globe<R>,
    /// Mean distance between levels, in radii.
    level: f64,
    radius: f64,
}

impl<R: Real> LayeredSphereFlow<R> {
    /// Prepares a window.
    pub fn new(window: &Window, grid: &Grid, radius: f64, boundary: Boundary, interpolation: Interpolation) -> Result<Self, FlowError> {
        let rate = 1.0 / radius;
        let sampler = Sampler::<R, 3>::new(window, grid, boundary, interpolation, |axes| [rate, rate, rate, 1.0 / axes[2].spacing])?;
        let [longitude, latitude, height] = &sampler.axes;
        let globe = Globe::new(longitude, latitude);
        let level_ends = height.ends();
        let end = |i: usize| -> [R; 3] { array(|k| R::from_f64(if k < 2 { globe.ends[k][i] } else { level_ends[i] })) };
        let [longitude, latitude] = globe.per_radian.map(angle_slack);
        let (low, high) = (end(0), end(1));
        let low = [low[0] - longitude, low[1] - latitude, low[2]];
        let high = [high[0] + longitude, high[1] + latitude, high[2]];
        Ok(Self { bounds: bounds(boundary, low, high), level: height.spacing / radius, radius, globe, sampler })
    }

    /// Lengths, in radii, of a degree of longitude, a degree of latitude and a unit of height.
    fn scales(&self, cosine: f64) -> [f64; 3] {
        let degree = 1f64.to_radians();
        [degree * cosine.max(MIN_COSINE), degree, 1.0 / self.radius]
    }
}

impl<R: Real> Coordinates<4, 3> for LayeredSphereFlow<R> {
    fn sort_key(&self, point: DomainPoint) -> Option<u32> {
        Some(self.sampler.sort_key(&array(|k| self.sampler.axes[k].state(f64::from(point.0[k])))))
    }
    fn seed_state(&self, point: [f64; 3]) -> [f64; 4] {
        let [sin_lon, cos_lon, sin_lat, cos_lat] = trigonometry(point);
        [cos_lat * cos_lon, cos_lat * sin_lon, sin_lat, self.sampler.axes[2].state(point[2])]
    }
    fn initial_tangent(&self, point: [f64; 3]) -> [[f64; 3]; 4] {
        let [sin_lon, cos_lon, sin_lat, cos_lat] = trigonometry(point);
        [[-sin_lon, -sin_lat * cos_lon, 0.0], [cos_lon, -sin_lat * sin_lon, 0.0], [0.0, cos_lat, 0.0], [0.0, 0.0, 1.0 / self.level]]
    }
    fn separation(&self, point: [f64; 3], axis: usize, step: f64) -> f64 {
        2.0 * step * self.scales(point[1].to_radians().cos())[axis]
    }
    fn arrival_point(&self, state: &[f64; 4], _: DomainPoint) -> DomainPoint {
        let [longitude, latitude] = self.globe.arrival(&state[..3]);
        DomainPoint([longitude as f32, latitude as f32, self.sampler.axes[2].coordinate(state[3]) as f32])
    }
    fn coordinate_jacobian(&self, seed: [f64; 3], state: &[f64; 4], gradient: [[f64; 3]; 3]) -> [[f64; 3]; 3] {
        let (before, after) = (self.scales(seed[1].to_radians().cos()), self.scales(state[0].hypot(state[1])));
        array(|i| array(|j| gradient[i][j] * before[j] / after[i]))
    }
    fn break_times(&self) -> &[f64] {
        self.sampler.times()
    }
}

/// The three components of the direction.
#[inline(always)]
fn direction<L: Copy>(x: &[L; 4]) -> [L; 3] {
    [x[0], x[1], x[2]]
}

impl<L: Gather> Velocity<L, 4, 3> for LayeredSphereFlow<L::Real> {
    type Stage = GridStage<L::Real>;
    const HAS_MISSING: bool = true;

    fn stage(&self, time: f64) -> Self::Stage {
        self.sampler.stage(time)
    }
    #[inline(always)]
    fn velocity(&self, stage: &Self::Stage, x: &[L; 4]) -> ([L; 4], L) {
        let here = self.globe.locate(&direction(x));
        let (v, mark) = self.sampler.value::<L, 4>(stage, &[here.location[0], here.location[1], x[3]]);
        let ([vx, vy, vz], _) = project(&here.p, &direction(&v));
        ([vx, vy, vz, v[3]], mark)
    }
    #[inline(always)]
    fn tangent(&self, stage: &Self::Stage, x: &[L; 4], m: &[[L; 3]; 4]) -> ([L; 4], [[L; 3]; 4], L) {
        let here = self.globe.locate(&direction(x));
        let sample = self.sampler.sample::<L, 4>(stage, &[here.location[0], here.location[1], x[3]]);
        let horizontal = direction(&sample.velocity);
        let ([vx, vy, vz], radial) = project(&here.p, &horizontal);
        let basis = self.globe.basis(&here.p, here.cosine);
        let mut product = [[L::zero(); 3]; 4];
        for c in 0..3 {
            let (change, [longitude, latitude]) = self.globe.differentials(&here, &basis, array(|i| m[i][c]));
            let interpolated: [L; 4] = array(|i| {
                let along_level = m[3][c] * sample.slopes[2][i];
                longitude.mul_add(sample.slopes[0][i], latitude.mul_add(sample.slopes[1][i], along_level))
            });
            let column = project_derivative(&here.p, &horizontal, radial, &change, &direction(&interpolated));
            for i in 0..3 {
                product[i][c] = column[i];
            }
            product[3][c] = interpolated[3];
        }
        ([vx, vy, vz, sample.velocity[3]], product, sample.mark)
    }
    #[inline(always)]
    fn inside(&self, x: &[L; 4]) -> L::Mask {
        let here = self.globe.locate(&direction(x));
        within(&self.bounds, &[here.location[0], here.location[1], x[3]])
    }
    #[inline(always)]
    fn renormalise(&self, x: &mut [L; 4]) {
        let (p, _) = normalised(&direction(x));
        x[..3].copy_from_slice(&p);
    }
    #[inline(always)]
    fn renormalise_with_tangent(&self, x: &mut [L; 4], m: &mut [[L; 3]; 4]) {
        let (p, inverse) = normalised(&direction(x));
        x[..3].copy_from_slice(&p);
        for c in 0..3 {
            let (column, _) = project(&p, &array(|i| m[i][c]));
            for i in 0..3 {
                m[i][c] = column[i] * inverse;
            }
        }
    }
    #[inline(always)]
    fn gradient(&self, x: &[L; 4], m: &[[L; 3]; 4]) -> [[L; 3]; 3] {
        let cosine = x[0].mul_add(x[0], x[1] * x[1]).sqrt().max(L::splat_f64(MIN_COSINE));
        let [east, north] = self.globe.basis(&direction(x), cosine);
        let column = |c: usize| array(|k| m[k][c]);
        [array(|c| dot(&east, &column(c))), array(|c| dot(&north, &column(c))), array(|c| m[3][c] * L::splat_f64(self.level))]
    }
}
