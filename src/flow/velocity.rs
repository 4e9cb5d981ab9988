//! The traits that an integrator needs of a flow, and their implementation for closed forms.

use super::Boundary;
use ridgewatch_field::{Domain, DomainPoint, analytic::ClosedForm};
use ridgewatch_simd::{Lanes, Mask, Real, array};

/// Coordinates of the integration: seeds become states, states become arrival points. A state has `D` components, its tangent `C` columns.
pub trait Coordinates<const D: usize, const C: usize>: Send + Sync {
    /// Sort key: seeds with neighbouring keys read neighbouring memory. `None` if the flow reads no memory.
    fn sort_key(&self, point: DomainPoint) -> Option<u32>;
    /// State of a particle that starts at a point in domain coordinates.
    fn seed_state(&self, point: [f64; 3]) -> [f64; D];
    /// d state / d seed along an orthonormal basis at the seed.
    fn initial_tangent(&self, point: [f64; 3]) -> [[f64; C]; D];
    /// Distance, in the unit of [`Coordinates::initial_tangent`], between the points `step` coordinate units to either side along `axis`.
    fn separation(&self, point: [f64; 3], axis: usize, step: f64) -> f64;
    /// Domain coordinates of a state; extruded axes keep the coordinate of the seed.
    fn arrival_point(&self, state: &[f64; D], seed: DomainPoint) -> DomainPoint;
    /// Converts a flow map gradient between orthonormal bases to domain coordinates.
    fn coordinate_jacobian(&self, seed: [f64; 3], state: &[f64; D], gradient: [[f64; C]; C]) -> [[f64; C]; C];
    /// Times at which the time derivative of the velocity jumps, ascending.
    fn break_times(&self) -> &[f64];
}

/// A velocity for lanes of one kind.
pub trait Velocity<L: Lanes, const D: usize, const C: usize>: Coordinates<D, C> {
    /// Everything that depends on time alone, computed once for all particles.
    type Stage: Send + Sync;
    /// True if velocities can be missing, so that marks can be NaN.
    const HAS_MISSING: bool;
    /// Prepares a time.
    fn stage(&self, time: f64) -> Self::Stage;
    /// d state / dt, and a mark that is NaN if the velocity is missing.
    fn velocity(&self, stage: &Self::Stage, x: &[L; D]) -> ([L; D], L);
    /// d state / dt, its derivative times `m` (the right-hand side of the variational equation), and the mark.
    fn tangent(&self, stage: &Self::Stage, x: &[L; D], m: &[[L; C]; D]) -> ([L; D], [[L; C]; D], L);
    /// True where a particle may continue. False for NaN.
    fn inside(&self, x: &[L; D]) -> L::Mask;
    /// Removes rounding errors that leave the manifold of states, after a step.
    fn renormalise(&self, _x: &mut [L; D]) {}
    /// [`Self::renormalise`] for state and tangent.
    fn renormalise_with_tangent(&self, _x: &mut [L; D], _m: &mut [[L; C]; D]) {}
    /// Gradient of the flow map between orthonormal bases at seed and arrival. Its largest singular value is the stretch.
    fn gradient(&self, x: &[L; D], m: &[[L; C]; D]) -> [[L; C]; C];
}

/// A closed-form flow in a box.
#[derive(Debug, Clone)]
pub struct ClosedFormFlow<F, R, const D: usize> {
    form: F,
    boundary: Boundary,
    low: [R; D],
    high: [R; D],
    /// Closed interval of states from which particles continue.
    bounds: [[R; D]; 2],
}

impl<F, R: Real, const D: usize> ClosedFormFlow<F, R, D> {
    /// A flow in the first D axes of a domain.
    pub fn new(form: F, domain: &Domain, boundary: Boundary) -> Self {
        let low = array(|k| R::from_f64(domain.min[k]));
        let high = array(|k| R::from_f64(domain.max[k]));
        Self { form, boundary, low, high, bounds: bounds(boundary, low, high) }
    }

    #[inline(always)]
    fn apply_boundary<L: Lanes<Real = R>>(&self, axis: usize, x: L) -> L {
        let (low, high) = (L::splat(self.low[axis]), L::splat(self.high[axis]));
        match self.boundary {
            Boundary::Clamp => x.max(low).min(high),
            Boundary::Periodic => x - (high - low) * ((x - low) / (high - low)).floor(),
            Boundary::Stop | Boundary::Zero | Boundary::Unbounded => x,
        }
    }
}

/// Rounding error, in state units, of a longitude or latitude computed in `R` from a unit vector: a few units in the last place. A seed on
/// the edge of its grid must count as inside despite this error. `radian` is the length of a radian in state units.
pub fn angle_slack<R: Real>(radian: R) -> R {
    let unit = R::one().above() - R::one();
    R::from_f64(8.0 * std::f64::consts::PI) * unit * radian
}

/// The closed interval of states from which particles continue, for each axis.
pub fn bounds<R: Real, const D: usize>(boundary: Boundary, low: [R; D], high: [R; D]) -> [[R; D]; 2] {
    match boundary {
        Boundary::Stop => [low, high],
        Boundary::Zero => [low.map(R::above), high.map(R::below)],
        Boundary::Clamp | Boundary::Periodic | Boundary::Unbounded => {
            [[R::from_f64(f64::NEG_INFINITY); D], [R::from_f64(f64::INFINITY); D]]
        }
    }
}

/// True where every component lies in the closed interval.
#[inline(always)]
pub fn within<L: Lanes, const D: usize>(bounds: &[[L::Real; D]; 2], x: &[L; D]) -> L::Mask {
    let mut inside = L::Mask::splat(true);
    for k in 0..D {
        inside = inside & L::splat(bounds[0][k]).le(x[k]) & x[k].le(L::splat(bounds[1][k]));
    }
    inside
}

impl<F: ClosedForm<D>, R: Real, const D: usize> Coordinates<D, D> for ClosedFormFlow<F, R, D> {
    fn sort_key(&self, _: DomainPoint) -> Option<u32> {
        None
    }
    fn seed_state(&self, point: [f64; 3]) -> [f64; D] {
        array(|k| point[k])
    }
    fn initial_tangent(&self, _: [f64; 3]) -> [[f64; D]; D] {
        identity()
    }
    fn separation(&self, _: [f64; 3], _: usize, step: f64) -> f64 {
        2.0 * step
    }
    fn arrival_point(&self, state: &[f64; D], seed: DomainPoint) -> DomainPoint {
        DomainPoint(array(|k| state.get(k).map_or(seed.0[k], |&x| x as f32)))
    }
    fn coordinate_jacobian(&self, _: [f64; 3], _: &[f64; D], gradient: [[f64; D]; D]) -> [[f64; D]; D] {
        gradient
    }
    fn break_times(&self) -> &[f64] {
        &[]
    }
}

/// The unit matrix.
pub fn identity<const D: usize>() -> [[f64; D]; D] {
    array(|i| array(|j| f64::from(u8::from(i == j))))
}

impl<F: ClosedForm<D>, L: Lanes, const D: usize> Velocity<L, D, D> for ClosedFormFlow<F, L::Real, D> {
    type Stage = [L::Real; 4];
    const HAS_MISSING: bool = false;

    fn stage(&self, time: f64) -> [L::Real; 4] {
        self.form.constants(time).map(L::Real::from_f64)
    }
    #[inline(always)]
    fn velocity(&self, stage: &Self::Stage, x: &[L; D]) -> ([L; D], L) {
        (F::velocity(stage, &array(|k| self.apply_boundary(k, x[k]))), L::zero())
    }
    #[inline(always)]
    fn tangent(&self, stage: &Self::Stage, x: &[L; D], m: &[[L; D]; D]) -> ([L; D], [[L; D]; D], L) {
        if self.boundary == Boundary::Clamp {
            // Beyond the end of an axis the clamped velocity does not change along that axis.
            let held: [L; D] = array(|k| self.apply_boundary(k, x[k]));
            let m = array(|k| array(|c| L::select(held[k].equal(x[k]), m[k][c], L::zero())));
            let (v, product) = F::tangent(stage, &held, &m);
            return (v, product, L::zero());
        }
        let (v, product) = F::tangent(stage, &array(|k| self.apply_boundary(k, x[k])), m);
        (v, product, L::zero())
    }
    #[inline(always)]
    fn inside(&self, x: &[L; D]) -> L::Mask {
        within(&self.bounds, x)
    }
    #[inline(always)]
    fn gradient(&self, _: &[L; D], m: &[[L; D]; D]) -> [[L; D]; D] {
        *m
    }
}
