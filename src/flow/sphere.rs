//! Gridded flow on the sphere by pole-free Cartesian advection: the state is a unit vector p, and dp/dt = velocity / radius.
//!
//! Node velocities are geocentric Cartesian vectors. They are interpolated in longitude and latitude and projected onto the tangent plane
//! at p. The tangent is the exact derivative of that: d longitude = east . dp / cos(latitude), d latitude = north . dp. The gradient of the
//! flow map is taken between the orthonormal bases (east, north) at seed and arrival, that is, in the metric of the sphere.

use super::axis_map::AxisMap;
use super::sampler::{GridStage, Sampler};
use super::velocity::{Coordinates, Velocity, angle_slack, bounds, within};
use super::{Boundary, FlowError, Interpolation};
use ridgewatch_field::{DomainPoint, Grid, Window, is_pole};
use ridgewatch_simd::{Gather, Lanes, Real, array};

/// Converts directions to locations on a longitude-latitude grid in degrees.
#[derive(Debug, Clone)]
pub(super) struct Globe<R> {
    /// Longitude in the middle of the axis, in degrees.
    pub(super) central_longitude: f64,
    /// State units (grid spacings) per radian.
    pub(super) per_radian: [R; 2],
    /// State coordinates of `central_longitude` and of the equator.
    origin: [R; 2],
    /// Cosine and sine of the central longitude. A rotation by its negative moves the branch cut of the longitude opposite to the grid.
    rotation: [R; 2],
    /// State coordinates between which particles continue, `[low, high]` along longitude and latitude. A pole is no end of the grid.
    pub(super) ends: [[f64; 2]; 2],
    /// State coordinates of the south and north pole; infinite unless the pole is a row of the grid.
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
    pub fn new(window: &Window, grid: &Grid, radius: f64, boundary: Boundary, interpolation: Interpolation) -> Result<Self, FlowError> {
        let rate = 1.0 / radius;
        let sampler = Sampler::<R, 2>::new(window, grid, boundary, interpolation, |_| [rate, rate, rate, 1.0])?;
        let globe = Globe::new(&sampler.axes[0], &sampler.axes[1]);
        let end = |i: usize| -> [R; 2] { array(|k| R::from_f64(globe.ends[k][i])) };
        let slack = globe.per_radian.map(angle_slack);
        let (low, high) = (array(|k| end(0)[k] - slack[k]), array(|k| end(1)[k] + slack[k]));
        Ok(Self { bounds: bounds(boundary, low, high), globe, sampler })
    }
}

/// Cosine of the latitude below which the longitude has no meaning: 6e-7 degrees from a pole.
pub(super) const MIN_COSINE: f64 = 1e-8;
/// Spacings from a pole (a row of the grid) within which the radius of the circle of latitude is computed from the grid location. The slope
/// along the circle and its radius vanish together at the pole, and rounding must not make their ratio diverge.
const NEAR_POLE_SPACINGS: f64 = 0.125;

/// Smallest distance of a location from a pole, in spacings, so that slope and radius do not vanish: 16 units in the last place of a grid of
/// 1024 rows.
pub fn min_colatitude<R: Real>() -> R {
    R::from_f64(if size_of::<R>() == size_of::<f32>() { 1.0 / 1024.0 } else { 1.0 / f64::from(1 << 30) })
}

/// State coordinates of the south and north pole; minus and plus infinity unless the pole is a row of the grid.
pub fn poles<R: Real>(latitude: &AxisMap<R>) -> [f64; 2] {
    let ends = latitude.ends();
    array(|k| {
        let beyond = [f64::NEG_INFINITY, f64::INFINITY][k];
        if ends[k].is_finite() && is_pole(latitude.coordinate(ends[k])) { ends[k] } else { beyond }
    })
}

/// The direction of a state and its location on the grid.
pub(super) struct GlobeLocation<L> {
    /// Unit vector.
    pub(super) p: [L; 3],
    pub(super) inverse_length: L,
    pub(super) cosine: L,
    /// Radius of the circle of latitude through `location`: the cosine of the latitude, except near a pole that is a row of the grid.
    pub(super) parallel_radius: L,
    /// Longitude and latitude in grid spacings.
    pub(super) location: [L; 2],
}

#[inline(always)]
pub(super) fn dot<L: Lanes>(a: &[L; 3], b: &[L; 3]) -> L {
    a[0].mul_add(b[0], a[1].mul_add(b[1], a[2] * b[2]))
}

impl<R: Real> Globe<R> {
    pub(super) fn new(longitude: &AxisMap<R>, latitude: &AxisMap<R>) -> Self {
        let central_longitude = longitude.coordinate(longitude.high.to_f64() / 2.0);
        let (sine, cosine) = central_longitude.to_radians().sin_cos();
        let real = R::from_f64;
        let poles = poles(latitude);
        let mut ends = latitude.ends();
        for k in 0..2 {
            // Rounding must not move a particle that passes over the pole outside of the grid.
            if poles[k].is_finite() {
                ends[k] = [f64::NEG_INFINITY, f64::INFINITY][k];
            }
        }
        Self {
            central_longitude,
            per_radian: [real(1f64.to_degrees() / longitude.spacing), real(1f64.to_degrees() / latitude.spacing)],
            origin: [real(longitude.state(central_longitude)), real(latitude.state(0.0))],
            rotation: [real(cosine), real(sine)],
            ends: [longitude.ends(), ends],
            poles: poles.map(real),
        }
    }

    #[inline(always)]
    pub(super) fn locate<L: Gather<Real = R>>(&self, x: &[L; 3]) -> GlobeLocation<L> {
        let inverse_length = L::one() / dot(x, x).sqrt();
        let p: [L; 3] = array(|i| x[i] * inverse_length);
        let cosine = p[0].mul_add(p[0], p[1] * p[1]).sqrt();
        let [c, s] = [L::splat(self.rotation[0]), L::splat(self.rotation[1])];
        let (ahead, aside) = (c.mul_add(p[0], s * p[1]), c.mul_add(p[1], -(s * p[0])));
        // At a pole every longitude is right.
        let ahead = L::select(L::lt(cosine, L::splat_f64(MIN_COSINE)), L::one(), ahead);
        let angles = [aside.atan2(ahead), p[2].atan2(cosine)];
        let mut location: [L; 2] = array(|k| angles[k].mul_add(L::splat(self.per_radian[k]), L::splat(self.origin[k])));
        let ([south, north], margin) = (self.poles.map(L::splat), L::splat(min_colatitude()));
        location[1] = location[1].max(south + margin).min(north - margin);
        let beside = (location[1] - south).min(north - location[1]);
        let angle = beside / L::splat(self.per_radian[1]);
        // The sine of an angle of an eighth of a cell.
        let circle = angle * (angle * angle).mul_add(L::splat_f64(-1.0 / 6.0), L::one());
        let cosine = cosine.max(L::splat_f64(MIN_COSINE));
        GlobeLocation {
            p,
            inverse_length,
            cosine,
            parallel_radius: L::select(L::lt(beside, L::splat_f64(NEAR_POLE_SPACINGS)), circle, cosine),
            location,
        }
    }

    /// Unit vectors to the east and north; at a pole those of the longitude that [`Globe::locate`] uses there.
    #[inline(always)]
    pub(super) fn basis<L: Gather<Real = R>>(&self, p: &[L; 3], cosine: L) -> [[L; 3]; 2] {
        let inverse = L::one() / cosine;
        let at_pole = cosine.le(L::splat_f64(MIN_COSINE));
        let [c, s] = array(|k| L::select(at_pole, L::splat(self.rotation[k]), p[k] * inverse));
        [[-s, c, L::zero()], [-(p[2] * c), -(p[2] * s), cosine]]
    }

    /// Changes of the direction, and of longitude and latitude in grid spacings, for a change of the state.
    #[inline(always)]
    pub(super) fn differentials<L: Gather<Real = R>>(&self, here: &GlobeLocation<L>, basis: &[[L; 3]; 2], dx: [L; 3]) -> ([L; 3], [L; 2]) {
        let outward = dot(&here.p, &dx);
        let change = array(|i| (-outward).mul_add(here.p[i], dx[i]) * here.inverse_length);
        let longitude = dot(&basis[0], &change) / here.parallel_radius * L::splat(self.per_radian[0]);
        (change, [longitude, dot(&basis[1], &change) * L::splat(self.per_radian[1])])
    }

    /// Longitude and latitude in degrees of a direction.
    pub(super) fn arrival(&self, p: &[f64]) -> [f64; 2] {
        let latitude = p[2].atan2(p[0].hypot(p[1])).to_degrees();
        let longitude = p[1].atan2(p[0]).to_degrees();
        [longitude + 360.0 * ((self.central_longitude - longitude) / 360.0).round(), latitude]
    }
}

/// Projection of a vector onto the tangent plane at the unit vector p, and the component along p that it removes.
#[inline(always)]
pub(super) fn project<L: Lanes>(p: &[L; 3], v: &[L; 3]) -> ([L; 3], L) {
    let radial = dot(p, v);
    (array(|i| (-radial).mul_add(p[i], v[i])), radial)
}

/// Derivative of the projection v - p (p . v) for the changes dp and dv, with `radial` = p . v.
#[inline(always)]
pub(super) fn project_derivative<L: Lanes>(p: &[L; 3], v: &[L; 3], radial: L, dp: &[L; 3], dv: &[L; 3]) -> [L; 3] {
    let turned = dot(dp, v) + dot(p, dv);
    array(|i| (-radial).mul_add(dp[i], (-turned).mul_add(p[i], dv[i])))
}

/// The unit vector along x, and 1 / |x|.
#[inline(always)]
pub(super) fn normalised<L: Lanes>(x: &[L; 3]) -> ([L; 3], L) {
    let inverse = L::one() / dot(x, x).sqrt();
    (array(|i| x[i] * inverse), inverse)
}

/// Sine and cosine of the longitude, sine and cosine of the latitude.
pub(super) fn trigonometry(point: [f64; 3]) -> [f64; 4] {
    let ((sin_lon, cos_lon), (sin_lat, cos_lat)) = (point[0].to_radians().sin_cos(), point[1].to_radians().sin_cos());
    [sin_lon, cos_lon, sin_lat, cos_lat]
}

impl<R: Real> Coordinates<3, 2> for SphereFlow<R> {
    fn sort_key(&self, point: DomainPoint) -> Option<u32> {
        Some(self.sampler.sort_key(&array(|k| self.sampler.axes[k].state(f64::from(point.0[k])))))
    }
    fn seed_state(&self, point: [f64; 3]) -> [f64; 3] {
        let [sin_lon, cos_lon, sin_lat, cos_lat] = trigonometry(point);
        [cos_lat * cos_lon, cos_lat * sin_lon, sin_lat]
    }
    fn initial_tangent(&self, point: [f64; 3]) -> [[f64; 2]; 3] {
        let [sin_lon, cos_lon, sin_lat, cos_lat] = trigonometry(point);
        [[-sin_lon, -sin_lat * cos_lon], [cos_lon, -sin_lat * sin_lon], [0.0, cos_lat]]
    }
    fn separation(&self, point: [f64; 3], axis: usize, step: f64) -> f64 {
        let arc = 2.0 * step.to_radians();
        if axis == 0 { arc * point[1].to_radians().cos() } else { arc }
    }
    fn arrival_point(&self, state: &[f64; 3], seed: DomainPoint) -> DomainPoint {
        let [longitude, latitude] = self.globe.arrival(state);
        DomainPoint([longitude as f32, latitude as f32, seed.0[2]])
    }
    fn coordinate_jacobian(&self, seed: [f64; 3], state: &[f64; 3], gradient: [[f64; 2]; 2]) -> [[f64; 2]; 2] {
        let (before, after) = (seed[1].to_radians().cos(), state[0].hypot(state[1]).max(MIN_COSINE));
        [[gradient[0][0] * before / after, gradient[0][1] / after], [gradient[1][0] * before, gradient[1][1]]]
    }
    fn break_times(&self) -> &[f64] {
        self.sampler.times()
    }
}

impl<L: Gather> Velocity<L, 3, 2> for SphereFlow<L::Real> {
    type Stage = GridStage<L::Real>;
    const HAS_MISSING: bool = true;

    fn stage(&self, time: f64) -> Self::Stage {
        self.sampler.stage(time)
    }
    #[inline(always)]
    fn velocity(&self, stage: &Self::Stage, x: &[L; 3]) -> ([L; 3], L) {
        let here = self.globe.locate(x);
        let (velocity, mark) = self.sampler.value::<L, 3>(stage, &here.location);
        (project(&here.p, &velocity).0, mark)
    }
    #[inline(always)]
    fn tangent(&self, stage: &Self::Stage, x: &[L; 3], m: &[[L; 2]; 3]) -> ([L; 3], [[L; 2]; 3], L) {
        let here = self.globe.locate(x);
        let sample = self.sampler.sample::<L, 3>(stage, &here.location);
        let (velocity, radial) = project(&here.p, &sample.velocity);
        let basis = self.globe.basis(&here.p, here.cosine);
        let mut product = [[L::zero(); 2]; 3];
        for c in 0..2 {
            let (change, [longitude, latitude]) = self.globe.differentials(&here, &basis, array(|i| m[i][c]));
            let interpolated: [L; 3] = array(|i| longitude.mul_add(sample.slopes[0][i], latitude * sample.slopes[1][i]));
            let column = project_derivative(&here.p, &sample.velocity, radial, &change, &interpolated);
            for i in 0..3 {
                product[i][c] = column[i];
            }
        }
        (velocity, product, sample.mark)
    }
    #[inline(always)]
    fn inside(&self, x: &[L; 3]) -> L::Mask {
        within(&self.bounds, &self.globe.locate(x).location)
    }
    #[inline(always)]
    fn renormalise(&self, x: &mut [L; 3]) {
        *x = normalised(x).0;
    }
    #[inline(always)]
    fn renormalise_with_tangent(&self, x: &mut [L; 3], m: &mut [[L; 2]; 3]) {
        let (p, inverse) = normalised(x);
        *x = p;
        for c in 0..2 {
            let (column, _) = project(x, &array(|i| m[i][c]));
            for i in 0..3 {
                m[i][c] = column[i] * inverse;
            }
        }
    }
    #[inline(always)]
    fn gradient(&self, x: &[L; 3], m: &[[L; 2]; 3]) -> [[L; 2]; 2] {
        let cosine = x[0].mul_add(x[0], x[1] * x[1]).sqrt().max(L::splat_f64(MIN_COSINE));
        let basis = self.globe.basis(x, cosine);
        array(|i| array(|c| dot(&basis[i], &array(|k| m[k][c]))))
    }
}
