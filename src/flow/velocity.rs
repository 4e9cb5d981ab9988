//! What an integrator asks of a flow, and closed-form flows as such.

use super::Boundary;
use crate::field::{Domain, analytic::ClosedForm};
use crate::simd::{Lanes, Mask, Real, array};

/// How seeds become states and states become arrival points. A state has `D` components, its tangent `C` columns.
pub trait Chart<const D: usize, const C: usize>: Send + Sync {
    /// Seeds of neighbouring keys read neighbouring memory; none where no memory is read.
    fn sort_key(&self, point: [f32; 3]) -> Option<u32>;
    /// State of a particle at a point in domain coordinates.
    fn start(&self, point: [f64; 3]) -> [f64; D];
    /// d state / d seed along an orthonormal basis at the seed.
    fn first_tangent(&self, point: [f64; 3]) -> [[f64; C]; D];
    /// Length, in the unit of [`Chart::first_tangent`], between the points `gap` coordinate units before and behind along `axis`.
    fn separation(&self, point: [f64; 3], axis: usize, gap: f64) -> f64;
    /// Domain coordinates of a state; extruded axes keep the seed's.
    fn arrival(&self, state: &[f64; D], seed: [f32; 3]) -> [f32; 3];
    /// From lengths to domain coordinates.
    fn coordinate_jacobian(&self, seed: [f64; 3], state: &[f64; D], metric: [[f64; C]; C]) -> [[f64; C]; C];
    /// Times at which the velocity's time derivative jumps, ascending.
    fn breaks(&self) -> &[f64];
}

/// A velocity for lanes of one kind.
pub trait Velocity<L: Lanes, const D: usize, const C: usize>: Chart<D, C> {
    /// All that depends on time alone, computed once for all particles.
    type Stage: Send + Sync;
    /// Whether `mark`s can be NaN.
    const MARKS: bool;
    /// At a time.
    fn stage(&self, time: f64) -> Self::Stage;
    /// d state / dt, and a mark that is NaN where the velocity is missing.
    fn velocity(&self, stage: &Self::Stage, x: &[L; D]) -> ([L; D], L);
    /// The same, and its derivative times `m`.
    fn tangent(&self, stage: &Self::Stage, x: &[L; D], m: &[[L; C]; D]) -> ([L; D], [[L; C]; D], L);
    /// Whether a particle there may go on. False for NaN.
    fn inside(&self, x: &[L; D]) -> L::Mask;
    /// Takes rounding out of a state after a step.
    fn settle(&self, _x: &mut [L; D]) {}
    /// The same for state and tangent.
    fn settle_tangent(&self, _x: &mut [L; D], _m: &mut [[L; C]; D]) {}
    /// The tangent between orthonormal bases at seed and arrival: the matrix whose largest singular value is the stretch.
    fn metric(&self, x: &[L; D], m: &[[L; C]; D]) -> [[L; C]; C];
}

/// A closed-form flow in a box.
#[derive(Debug, Clone)]
pub struct Closed<F, R, const D: usize> {
    form: F,
    policy: Boundary,
    low: [R; D],
    high: [R; D],
    /// Where particles may go on.
    bounds: [[R; D]; 2],
}

impl<F, R: Real, const D: usize> Closed<F, R, D> {
    /// The flow in the domain's first D axes.
    pub fn new(form: F, domain: &Domain, policy: Boundary) -> Self {
        let low = array(|k| R::from_f64(domain.min[k]));
        let high = array(|k| R::from_f64(domain.max[k]));
        Self { form, policy, low, high, bounds: bounds(policy, low, high) }
    }

    #[inline(always)]
    fn confine<L: Lanes<Real = R>>(&self, axis: usize, x: L) -> L {
        let (low, high) = (L::splat(self.low[axis]), L::splat(self.high[axis]));
        match self.policy {
            Boundary::Clamp => x.max(low).min(high),
            Boundary::Periodic => x - (high - low) * ((x - low) / (high - low)).floor(),
            Boundary::Stop | Boundary::Zero | Boundary::Unbounded => x,
        }
    }
}

/// Share of a turn by which a longitude or latitude that was computed in `R` from a unit vector may miss: a few units in the last place.
/// A seed on the very edge of its grid must not be lost to that.
pub(crate) fn angle_slack<R: Real>(radian: R) -> R {
    let unit = R::one().above() - R::one();
    R::from_f64(8.0 * std::f64::consts::PI) * unit * radian
}

/// The closed interval of states that may go on, for each axis.
pub fn bounds<R: Real, const D: usize>(policy: Boundary, low: [R; D], high: [R; D]) -> [[R; D]; 2] {
    match policy {
        Boundary::Stop => [low, high],
        Boundary::Zero => [low.map(R::above), high.map(R::below)],
        Boundary::Clamp | Boundary::Periodic | Boundary::Unbounded => {
            [[R::from_f64(f64::NEG_INFINITY); D], [R::from_f64(f64::INFINITY); D]]
        }
    }
}

/// Whether each component lies in the closed interval.
#[inline(always)]
pub fn within<L: Lanes, const D: usize>(bounds: &[[L::Real; D]; 2], x: &[L; D]) -> L::Mask {
    let mut inside = L::Mask::splat(true);
    for k in 0..D {
        inside = inside & L::splat(bounds[0][k]).le(x[k]) & x[k].le(L::splat(bounds[1][k]));
    }
    inside
}

impl<F: ClosedForm<D>, R: Real, const D: usize> Chart<D, D> for Closed<F, R, D> {
    fn sort_key(&self, _: [f32; 3]) -> Option<u32> {
        None
    }
    fn start(&self, point: [f64; 3]) -> [f64; D] {
        array(|k| point[k])
    }
    fn first_tangent(&self, _: [f64; 3]) -> [[f64; D]; D] {
        identity()
    }
    fn separation(&self, _: [f64; 3], _: usize, gap: f64) -> f64 {
        2.0 * gap
    }
    fn arrival(&self, state: &[f64; D], seed: [f32; 3]) -> [f32; 3] {
        array(|k| state.get(k).map_or(seed[k], |&x| x as f32))
    }
    fn coordinate_jacobian(&self, _: [f64; 3], _: &[f64; D], metric: [[f64; D]; D]) -> [[f64; D]; D] {
        metric
    }
    fn breaks(&self) -> &[f64] {
        &[]
    }
}

/// The unit matrix.
pub fn identity<const D: usize>() -> [[f64; D]; D] {
    array(|i| array(|j| f64::from(u8::from(i == j))))
}

impl<F: ClosedForm<D>, L: Lanes, const D: usize> Velocity<L, D, D> for Closed<F, L::Real, D> {
    type Stage = [L::Real; 4];
    const MARKS: bool = false;

    fn stage(&self, time: f64) -> [L::Real; 4] {
        self.form.constants(time).map(L::Real::from_f64)
    }
    #[inline(always)]
    fn velocity(&self, stage: &Self::Stage, x: &[L; D]) -> ([L; D], L) {
        (F::velocity(stage, &array(|k| self.confine(k, x[k]))), L::zero())
    }
    #[inline(always)]
    fn tangent(&self, stage: &Self::Stage, x: &[L; D], m: &[[L; D]; D]) -> ([L; D], [[L; D]; D], L) {
        if self.policy == Boundary::Clamp {
            // The clamped velocity does not change along an axis beyond whose end the particle is.
            let held: [L; D] = array(|k| self.confine(k, x[k]));
            let m = array(|k| array(|c| L::select(held[k].equal(x[k]), m[k][c], L::zero())));
            let (v, product) = F::tangent(stage, &held, &m);
            return (v, product, L::zero());
        }
        let (v, product) = F::tangent(stage, &array(|k| self.confine(k, x[k])), m);
        (v, product, L::zero())
    }
    #[inline(always)]
    fn inside(&self, x: &[L; D]) -> L::Mask {
        within(&self.bounds, x)
    }
    #[inline(always)]
    fn metric(&self, _: &[L; D], m: &[[L; D]; D]) -> [[L; D]; D] {
        *m
    }
}
