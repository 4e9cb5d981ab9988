//! Gridded flow on the sphere with levels: a unit vector p as in [`super::sphere`], and a height.
//!
//! The atmosphere is taken as shallow: a horizontal metre is a metre on the sphere's radius at every height. A node holds its horizontal
//! velocity as a geocentric vector and, where other nodes hold the mark, its vertical one (see [`crate::field::Snapshot::nodes`]), so
//! that the two never mix in the interpolation: vertical winds are a thousand times weaker than horizontal ones. Lengths of the tangent
//! are in radii, along (east, north, up).

use super::sampler::{GridStage, Sampler};
use super::sphere::{AT_POLE, Globe, dot, trigonometry};
use super::velocity::{Chart, Velocity, angle_slack, bounds, within};
use super::{Boundary, FlowError, Interpolation};
use crate::field::{Grid, Window};
use crate::simd::{Gather, Real, array};

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
    pub fn new(window: &Window, grid: &Grid, radius: f64, policy: Boundary, interpolation: Interpolation) -> Result<Self, FlowError> {
        let rate = 1.0 / radius;
        let sampler = Sampler::<R, 3>::new(window, grid, policy, interpolation, |axes| [rate, rate, rate, 1.0 / axes[2].spacing])?;
        let [longitude, latitude, height] = &sampler.axes;
        let globe = Globe::new(longitude, latitude);
        let level_ends = height.ends();
        let end = |i: usize| -> [R; 3] { array(|k| R::from_f64(if k < 2 { globe.ends[k][i] } else { level_ends[i] })) };
        let [longitude, latitude] = globe.per_radian.map(angle_slack);
        let (low, high) = (end(0), end(1));
        let low = [low[0] - longitude, low[1] - latitude, low[2]];
        let high = [high[0] + longitude, high[1] + latitude, high[2]];
        Ok(Self { bounds: bounds(policy, low, high), level: height.spacing / radius, radius, globe, sampler })
    }

    /// Radii in a degree of longitude, a degree of latitude and a unit of height.
    fn scales(&self, cosine: f64) -> [f64; 3] {
        let degree = 1f64.to_radians();
        [degree * cosine.max(AT_POLE), degree, 1.0 / self.radius]
    }
}

impl<R: Real> Chart<4, 3> for LayeredSphereFlow<R> {
    fn sort_key(&self, point: [f32; 3]) -> Option<u32> {
        Some(self.sampler.sort_key(&array(|k| self.sampler.axes[k].state(f64::from(point[k])))))
    }
    fn start(&self, point: [f64; 3]) -> [f64; 4] {
        let [sin_lon, cos_lon, sin_lat, cos_lat] = trigonometry(point);
        [cos_lat * cos_lon, cos_lat * sin_lon, sin_lat, self.sampler.axes[2].state(point[2])]
    }
    fn first_tangent(&self, point: [f64; 3]) -> [[f64; 3]; 4] {
        let [sin_lon, cos_lon, sin_lat, cos_lat] = trigonometry(point);
        [[-sin_lon, -sin_lat * cos_lon, 0.0], [cos_lon, -sin_lat * sin_lon, 0.0], [0.0, cos_lat, 0.0], [0.0, 0.0, 1.0 / self.level]]
    }
    fn separation(&self, point: [f64; 3], axis: usize, gap: f64) -> f64 {
        2.0 * gap * self.scales(point[1].to_radians().cos())[axis]
    }
    fn arrival(&self, state: &[f64; 4], _: [f32; 3]) -> [f32; 3] {
        let [longitude, latitude] = self.globe.arrival(&state[..3]);
        [longitude as f32, latitude as f32, self.sampler.axes[2].coordinate(state[3]) as f32]
    }
    fn coordinate_jacobian(&self, seed: [f64; 3], state: &[f64; 4], metric: [[f64; 3]; 3]) -> [[f64; 3]; 3] {
        let (before, after) = (self.scales(seed[1].to_radians().cos()), self.scales(state[0].hypot(state[1])));
        array(|i| array(|j| metric[i][j] * before[j] / after[i]))
    }
    fn breaks(&self) -> &[f64] {
        self.sampler.times()
    }
}

/// The direction of a state.
#[inline(always)]
fn direction<L: Copy>(x: &[L; 4]) -> [L; 3] {
    [x[0], x[1], x[2]]
}

impl<L: Gather> Velocity<L, 4, 3> for LayeredSphereFlow<L::Real> {
    type Stage = GridStage<L::Real>;
    const MARKS: bool = true;

    fn stage(&self, time: f64) -> Self::Stage {
        self.sampler.stage(time)
    }
    #[inline(always)]
    fn velocity(&self, stage: &Self::Stage, x: &[L; 4]) -> ([L; 4], L) {
        let here = self.globe.here(&direction(x));
        let (v, mark) = self.sampler.value::<L, 4>(stage, &[here.place[0], here.place[1], x[3]]);
        let p = &here.p;
        let radial = dot(p, &direction(&v));
        ([(-radial).mul_add(p[0], v[0]), (-radial).mul_add(p[1], v[1]), (-radial).mul_add(p[2], v[2]), v[3]], mark)
    }
    #[inline(always)]
    fn tangent(&self, stage: &Self::Stage, x: &[L; 4], m: &[[L; 3]; 4]) -> ([L; 4], [[L; 3]; 4], L) {
        let here = self.globe.here(&direction(x));
        let sample = self.sampler.sample::<L, 4>(stage, &[here.place[0], here.place[1], x[3]]);
        let (p, v) = (&here.p, &sample.velocity);
        let horizontal = direction(v);
        let radial = dot(p, &horizontal);
        let [east, north] = self.globe.basis(p, here.cosine);
        let mut product = [[L::zero(); 3]; 4];
        for c in 0..3 {
            // Change of direction for a change of the state along the column.
            let column: [L; 3] = array(|i| m[i][c]);
            let outward = dot(p, &column);
            let change: [L; 3] = array(|i| (-outward).mul_add(p[i], column[i]) * here.inverse_length);
            let longitude = dot(&east, &change) / here.circle * L::splat(self.globe.per_radian[0]);
            let latitude = dot(&north, &change) * L::splat(self.globe.per_radian[1]);
            let interpolated: [L; 4] = array(|i| {
                let along_level = m[3][c] * sample.slopes[2][i];
                longitude.mul_add(sample.slopes[0][i], latitude.mul_add(sample.slopes[1][i], along_level))
            });
            // Derivative of V - p (p . V).
            let turned = dot(&change, &horizontal) + dot(p, &direction(&interpolated));
            for i in 0..3 {
                product[i][c] = (-radial).mul_add(change[i], (-turned).mul_add(p[i], interpolated[i]));
            }
            product[3][c] = interpolated[3];
        }
        let velocity = [(-radial).mul_add(p[0], v[0]), (-radial).mul_add(p[1], v[1]), (-radial).mul_add(p[2], v[2]), v[3]];
        (velocity, product, sample.mark)
    }
    #[inline(always)]
    fn inside(&self, x: &[L; 4]) -> L::Mask {
        let here = self.globe.here(&direction(x));
        within(&self.bounds, &[here.place[0], here.place[1], x[3]])
    }
    #[inline(always)]
    fn settle(&self, x: &mut [L; 4]) {
        let p = direction(x);
        let inverse = L::one() / dot(&p, &p).sqrt();
        for i in 0..3 {
            x[i] = p[i] * inverse;
        }
    }
    #[inline(always)]
    fn settle_tangent(&self, x: &mut [L; 4], m: &mut [[L; 3]; 4]) {
        let p = direction(x);
        let inverse = L::one() / dot(&p, &p).sqrt();
        let p: [L; 3] = array(|i| p[i] * inverse);
        x[..3].copy_from_slice(&p);
        for c in 0..3 {
            let outward = dot(&p, &array(|i| m[i][c]));
            for i in 0..3 {
                m[i][c] = (-outward).mul_add(p[i], m[i][c]) * inverse;
            }
        }
    }
    #[inline(always)]
    fn metric(&self, x: &[L; 4], m: &[[L; 3]; 4]) -> [[L; 3]; 3] {
        let cosine = x[0].mul_add(x[0], x[1] * x[1]).sqrt().max(L::of(AT_POLE));
        let [east, north] = self.globe.basis(&direction(x), cosine);
        let column = |c: usize| array(|k| m[k][c]);
        [array(|c| dot(&east, &column(c))), array(|c| dot(&north, &column(c))), array(|c| m[3][c] * L::of(self.level))]
    }
}
