//! Gridded flow on the sphere: a unit vector p is carried by velocity / radius, so that a pole is no singularity.
//!
//! Node velocities are geocentric Cartesian vectors, interpolated in longitude and latitude and projected onto the tangent plane at
//! p. The tangent is the exact derivative of that: d longitude = east . dp / cos(latitude), d latitude = north . dp. Singular values
//! are those between the orthonormal bases (east, north) at seed and arrival, that is, in the metric of the sphere.

use super::axis_map::AxisMap;
use super::sampler::{GridStage, Sampler};
use super::velocity::{Chart, Velocity, angle_slack, bounds, within};
use super::{Boundary, FlowError, Interpolation};
use crate::field::{Grid, Window, is_pole};
use crate::simd::{Gather, Lanes, Real, array};

/// Where a direction is on a longitude-latitude grid in degrees.
#[derive(Debug, Clone)]
pub(super) struct Globe<R> {
    /// Longitude in the middle of the axis, degrees.
    pub(super) middle: f64,
    /// State units (grid spacings) in a radian.
    pub(super) per_radian: [R; 2],
    /// State coordinates of `middle` and of the equator.
    origin: [R; 2],
    /// Rotation about the axis by -middle, which keeps the branch cut of the longitude opposite to the grid.
    turn: [R; 2],
    /// State coordinates between which particles stay, `[low, high]` along longitude and latitude. A grid does not end at a pole.
    pub(super) ends: [[f64; 2]; 2],
    /// State coordinates of the poles that are rows of the grid; infinite where they are not.
    pub(super) poles: [R; 2],
}

/// A window on a longitude-latitude grid in degrees.
#[derive(Debug, Clone)]
pub struct SphereFlow<R> {
    sampler: Sampler<R, 2>,
    bounds: [[R; 2]; 2],
    globe: Globe<R>,
}

impl<R: Real> SphereFlow<R> {
    /// Prepares a window.
    pub fn new(window: &Window, grid: &Grid, radius: f64, policy: Boundary, interpolation: Interpolation) -> Result<Self, FlowError> {
        let rate = 1.0 / radius;
        let sampler = Sampler::<R, 2>::new(window, grid, policy, interpolation, |_| [rate, rate, rate, 1.0])?;
        let globe = Globe::new(&sampler.axes[0], &sampler.axes[1]);
        let end = |i: usize| -> [R; 2] { array(|k| R::from_f64(globe.ends[k][i])) };
        let slack = globe.per_radian.map(angle_slack);
        let (low, high) = (array(|k| end(0)[k] - slack[k]), array(|k| end(1)[k] + slack[k]));
        Ok(Self { bounds: bounds(policy, low, high), globe, sampler })
    }
}

/// Below this cosine of the latitude, longitude has no meaning: 6e-7 degrees from a pole.
pub(super) const AT_POLE: f64 = 1e-8;
/// Within so many spacings of a row at a pole the circle of latitude has the length that belongs to the place on the grid: the slope along
/// it and its length vanish together, and rounding must not part them.
const NEAR_POLE: f64 = 0.125;

/// Spacings from a pole that a place keeps, so that both do not vanish: 16 units in the last place of a grid of 1024 rows.
pub(crate) fn least_colatitude<R: Real>() -> R {
    R::from_f64(if size_of::<R>() == size_of::<f32>() { 1.0 / 1024.0 } else { 1.0 / f64::from(1 << 30) })
}

/// State coordinates of the poles that are rows of the grid, minus and plus infinity where they are not.
pub(crate) fn poles<R: Real>(latitude: &AxisMap<R>) -> [f64; 2] {
    let ends = latitude.ends();
    array(|k| {
        let beyond = [f64::NEG_INFINITY, f64::INFINITY][k];
        if ends[k].is_finite() && is_pole(latitude.coordinate(ends[k])) { ends[k] } else { beyond }
    })
}

/// The direction of a state, and its place on the grid.
pub(super) struct Here<L> {
    /// Unit vector.
    pub(super) p: [L; 3],
    pub(super) inverse_length: L,
    pub(super) cosine: L,
    /// Radius of the circle of latitude through `place`: the cosine, but beside a pole that is a row of the grid.
    pub(super) circle: L,
    /// Longitude and latitude in grid spacings.
    pub(super) place: [L; 2],
}

#[inline(always)]
pub(super) fn dot<L: Lanes>(a: &[L; 3], b: &[L; 3]) -> L {
    a[0].mul_add(b[0], a[1].mul_add(b[1], a[2] * b[2]))
}

impl<R: Real> Globe<R> {
    pub(super) fn new(longitude: &AxisMap<R>, latitude: &AxisMap<R>) -> Self {
        let middle = longitude.coordinate(longitude.high.to_f64() / 2.0);
        let (sine, cosine) = middle.to_radians().sin_cos();
        let real = R::from_f64;
        let poles = poles(latitude);
        let mut ends = latitude.ends();
        for k in 0..2 {
            // Rounding must not put a particle that passes over the pole outside of the grid.
            if poles[k].is_finite() {
                ends[k] = [f64::NEG_INFINITY, f64::INFINITY][k];
            }
        }
        Self {
            middle,
            per_radian: [real(1f64.to_degrees() / longitude.spacing), real(1f64.to_degrees() / latitude.spacing)],
            origin: [real(longitude.state(middle)), real(latitude.state(0.0))],
            turn: [real(cosine), real(sine)],
            ends: [longitude.ends(), ends],
            poles: poles.map(real),
        }
    }

    #[inline(always)]
    pub(super) fn here<L: Gather<Real = R>>(&self, x: &[L; 3]) -> Here<L> {
        let inverse_length = L::one() / dot(x, x).sqrt();
        let p: [L; 3] = array(|i| x[i] * inverse_length);
        let cosine = p[0].mul_add(p[0], p[1] * p[1]).sqrt();
        let [c, s] = [L::splat(self.turn[0]), L::splat(self.turn[1])];
        let (ahead, aside) = (c.mul_add(p[0], s * p[1]), c.mul_add(p[1], -(s * p[0])));
        // At a pole any longitude will do.
        let ahead = L::select(L::lt(cosine, L::of(AT_POLE)), L::one(), ahead);
        let angles = [aside.atan2(ahead), p[2].atan2(cosine)];
        let mut place: [L; 2] = array(|k| angles[k].mul_add(L::splat(self.per_radian[k]), L::splat(self.origin[k])));
        let ([south, north], least) = (self.poles.map(L::splat), L::splat(least_colatitude()));
        place[1] = place[1].max(south + least).min(north - least);
        let beside = (place[1] - south).min(north - place[1]);
        let angle = beside / L::splat(self.per_radian[1]);
        // The sine of an angle of an eighth of a cell.
        let circle = angle * (angle * angle).mul_add(L::of(-1.0 / 6.0), L::one());
        let cosine = cosine.max(L::of(AT_POLE));
        Here { p, inverse_length, cosine, circle: L::select(L::lt(beside, L::of(NEAR_POLE)), circle, cosine), place }
    }

    /// East and north at a direction; at a pole those of the longitude that [`Globe::here`] takes there.
    #[inline(always)]
    pub(super) fn basis<L: Gather<Real = R>>(&self, p: &[L; 3], cosine: L) -> [[L; 3]; 2] {
        let inverse = L::one() / cosine;
        let at_pole = cosine.le(L::of(AT_POLE));
        let [c, s] = array(|k| L::select(at_pole, L::splat(self.turn[k]), p[k] * inverse));
        [[-s, c, L::zero()], [-(p[2] * c), -(p[2] * s), cosine]]
    }

    /// Longitude and latitude in degrees of a direction.
    pub(super) fn arrival(&self, p: &[f64]) -> [f64; 2] {
        let latitude = p[2].atan2(p[0].hypot(p[1])).to_degrees();
        let longitude = p[1].atan2(p[0]).to_degrees();
        [longitude + 360.0 * ((self.middle - longitude) / 360.0).round(), latitude]
    }
}

/// Sine and cosine of the longitude, sine and cosine of the latitude.
pub(super) fn trigonometry(point: [f64; 3]) -> [f64; 4] {
    let ((sin_lon, cos_lon), (sin_lat, cos_lat)) = (point[0].to_radians().sin_cos(), point[1].to_radians().sin_cos());
    [sin_lon, cos_lon, sin_lat, cos_lat]
}

impl<R: Real> Chart<3, 2> for SphereFlow<R> {
    fn sort_key(&self, point: [f32; 3]) -> Option<u32> {
        Some(self.sampler.sort_key(&array(|k| self.sampler.axes[k].state(f64::from(point[k])))))
    }
    fn start(&self, point: [f64; 3]) -> [f64; 3] {
        let [sin_lon, cos_lon, sin_lat, cos_lat] = trigonometry(point);
        [cos_lat * cos_lon, cos_lat * sin_lon, sin_lat]
    }
    fn first_tangent(&self, point: [f64; 3]) -> [[f64; 2]; 3] {
        let [sin_lon, cos_lon, sin_lat, cos_lat] = trigonometry(point);
        [[-sin_lon, -sin_lat * cos_lon], [cos_lon, -sin_lat * sin_lon], [0.0, cos_lat]]
    }
    fn separation(&self, point: [f64; 3], axis: usize, gap: f64) -> f64 {
        let arc = 2.0 * gap.to_radians();
        if axis == 0 { arc * point[1].to_radians().cos() } else { arc }
    }
    fn arrival(&self, state: &[f64; 3], seed: [f32; 3]) -> [f32; 3] {
        let [longitude, latitude] = self.globe.arrival(state);
        [longitude as f32, latitude as f32, seed[2]]
    }
    fn coordinate_jacobian(&self, seed: [f64; 3], state: &[f64; 3], metric: [[f64; 2]; 2]) -> [[f64; 2]; 2] {
        let (before, after) = (seed[1].to_radians().cos(), state[0].hypot(state[1]).max(AT_POLE));
        [[metric[0][0] * before / after, metric[0][1] / after], [metric[1][0] * before, metric[1][1]]]
    }
    fn breaks(&self) -> &[f64] {
        self.sampler.times()
    }
}

impl<L: Gather> Velocity<L, 3, 2> for SphereFlow<L::Real> {
    type Stage = GridStage<L::Real>;
    const MARKS: bool = true;

    fn stage(&self, time: f64) -> Self::Stage {
        self.sampler.stage(time)
    }
    #[inline(always)]
    fn velocity(&self, stage: &Self::Stage, x: &[L; 3]) -> ([L; 3], L) {
        let here = self.globe.here(x);
        let (velocity, mark) = self.sampler.value::<L, 3>(stage, &here.place);
        let radial = dot(&here.p, &velocity);
        (array(|i| (-radial).mul_add(here.p[i], velocity[i])), mark)
    }
    #[inline(always)]
    fn tangent(&self, stage: &Self::Stage, x: &[L; 3], m: &[[L; 2]; 3]) -> ([L; 3], [[L; 2]; 3], L) {
        let here = self.globe.here(x);
        let sample = self.sampler.sample::<L, 3>(stage, &here.place);
        let p = &here.p;
        let radial = dot(p, &sample.velocity);
        let [east, north] = self.globe.basis(p, here.cosine);
        let mut product = [[L::zero(); 2]; 3];
        for c in 0..2 {
            // Change of direction for a change of the state along the column.
            let column: [L; 3] = array(|i| m[i][c]);
            let outward = dot(p, &column);
            let change: [L; 3] = array(|i| (-outward).mul_add(p[i], column[i]) * here.inverse_length);
            let longitude = dot(&east, &change) / here.circle * L::splat(self.globe.per_radian[0]);
            let latitude = dot(&north, &change) * L::splat(self.globe.per_radian[1]);
            let interpolated: [L; 3] = array(|i| longitude.mul_add(sample.slopes[0][i], latitude * sample.slopes[1][i]));
            // Derivative of V - p (p . V).
            let turned = dot(&change, &sample.velocity) + dot(p, &interpolated);
            for i in 0..3 {
                product[i][c] = (-radial).mul_add(change[i], (-turned).mul_add(p[i], interpolated[i]));
            }
        }
        (array(|i| (-radial).mul_add(p[i], sample.velocity[i])), product, sample.mark)
    }
    #[inline(always)]
    fn inside(&self, x: &[L; 3]) -> L::Mask {
        within(&self.bounds, &self.globe.here(x).place)
    }
    #[inline(always)]
    fn settle(&self, x: &mut [L; 3]) {
        let inverse = L::one() / dot(x, x).sqrt();
        *x = array(|i| x[i] * inverse);
    }
    #[inline(always)]
    fn settle_tangent(&self, x: &mut [L; 3], m: &mut [[L; 2]; 3]) {
        let inverse = L::one() / dot(x, x).sqrt();
        *x = array(|i| x[i] * inverse);
        for c in 0..2 {
            let outward = dot(x, &array(|i| m[i][c]));
            for i in 0..3 {
                m[i][c] = (-outward).mul_add(x[i], m[i][c]) * inverse;
            }
        }
    }
    #[inline(always)]
    fn metric(&self, x: &[L; 3], m: &[[L; 2]; 3]) -> [[L; 2]; 2] {
        let cosine = x[0].mul_add(x[0], x[1] * x[1]).sqrt().max(L::of(AT_POLE));
        let basis = self.globe.basis(x, cosine);
        array(|i| array(|c| dot(&basis[i], &array(|k| m[k][c]))))
    }
}
