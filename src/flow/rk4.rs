//! The classical Runge-Kutta method of order 4 with fixed steps.
//!
//! [`tangent`] integrates the path dx/dt = v and the variational equation dJ/dt = (grad v) J together, so that J is the exact gradient of the
//! discrete flow map. [`differences`] integrates neighbouring paths and takes central differences (Haller 2001; Shadden, Lekien and Marsden
//! 2005).

use super::stretch::{log_stretch, rescale};
use super::velocity::Velocity;
use ridgewatch_field::DomainPoint;
use ridgewatch_simd::{Lanes, Mask, Real, array};

/// Result of a batch of particles, one per lane.
pub struct TracedBatch<L: Lanes, const D: usize, const C: usize> {
    /// ln of the largest singular value.
    pub log_stretch: L,
    /// Share of |tau| until the particle stopped.
    pub lifetime_share: L,
    /// True for particles that left the domain.
    pub left_domain: L::Mask,
    /// Final state.
    pub state: [L; D],
    /// Gradient of the flow map between orthonormal bases, times 2^-exponent.
    pub gradient: [[L; C]; C],
    /// See `metric`.
    pub exponent: L,
}

/// Largest number of lanes of a kernel.
pub const MAX_LANES: usize = 16;

/// Returns lanes with one value per point; the last point fills the remaining lanes.
#[inline(always)]
pub fn lanes_of<L: Lanes, const N: usize, P: Copy>(points: &[P], f: impl Fn(P) -> [f64; N]) -> [L; N] {
    let mut rows = [[0.0; N]; MAX_LANES];
    for lane in 0..L::LANES {
        rows[lane] = if lane < points.len() { f(points[lane]) } else { rows[lane - 1] };
    }
    array(|n| L::from_fn(|lane| L::Real::from_f64(rows[lane][n])))
}

/// Returns h k + x for every component.
#[inline(always)]
fn along<L: Lanes, const D: usize>(h: L, k: &[L; D], x: &[L; D]) -> [L; D] {
    array(|i| h.mul_add(k[i], x[i]))
}

#[inline(always)]
fn along_tangent<L: Lanes, const C: usize, const D: usize>(h: L, k: &[[L; C]; D], m: &[[L; C]; D]) -> [[L; C]; D] {
    array(|i| along(h, &k[i], &m[i]))
}

/// Which particles continue, and after how many steps the others stopped.
struct ParticleStatus<L: Lanes> {
    alive: L::Mask,
    left_domain: L::Mask,
    steps: L,
}

impl<L: Lanes> ParticleStatus<L> {
    fn new(inside: L::Mask, steps: usize) -> Self {
        Self { alive: inside, left_domain: !inside, steps: L::select(inside, L::splat_f64(steps as f64), L::zero()) }
    }

    /// Share of `steps` taken. It is a quotient, since a product with a rounded inverse is not exactly 1 after all steps.
    fn lifetime_share(&self, steps: usize) -> L {
        self.steps / L::splat_f64(steps as f64)
    }

    /// Stops the particles that left the domain or met a missing cell in `step`. Returns true if all particles continue.
    #[inline(always)]
    fn update(&mut self, step: usize, inside: L::Mask, known: L::Mask) -> bool {
        let on = inside & known;
        if on.all() & self.alive.all() {
            return true;
        }
        let died = self.alive & !on;
        self.steps = L::select(died, L::splat_f64(step as f64), self.steps);
        self.left_domain = self.left_domain | (died & !inside);
        self.alive = self.alive & on;
        false
    }
}

/// Integrates path and tangent. `stages` holds the times t0, t0 + h/2, t0 + h, ...: two per step and one more. A step that ends outside of
/// the domain or meets a missing cell is not taken: the particle stops and keeps its stretch.
#[inline(never)]
pub fn tangent<L: Lanes, V: Velocity<L, D, C>, const D: usize, const C: usize>(
    field: &V,
    stages: &[V::Stage],
    step: f64,
    points: &[DomainPoint],
) -> TracedBatch<L, D, C> {
    let steps = stages.len() / 2;
    let (h, half, sixth, two) = (L::splat_f64(step), L::splat_f64(step / 2.0), L::splat_f64(step / 6.0), L::splat_f64(2.0));
    let mut x: [L; D] = lanes_of(points, |p| field.seed_state(p.0.map(f64::from)));
    let mut m: [[L; C]; D] = {
        let columns: [[L; D]; C] = array(|c| {
            lanes_of(points, |p| {
                let tangent = field.initial_tangent(p.0.map(f64::from));
                array(|i| tangent[i][c])
            })
        });
        array(|i| array(|c| columns[c][i]))
    };
    let mut exponent = L::zero();
    let mut status = ParticleStatus::<L>::new(field.inside(&x), steps);
    for n in 0..steps {
        let (first, middle, last) = (&stages[2 * n], &stages[2 * n + 1], &stages[2 * n + 2]);
        let (k, g, mark1) = field.tangent(first, &x, &m);
        let (mut sum, mut sums) = (k, g);
        let (k, g, mark2) = field.tangent(middle, &along(half, &k, &x), &along_tangent(half, &g, &m));
        sum = along(two, &k, &sum);
        sums = along_tangent(two, &g, &sums);
        let (k, g, mark3) = field.tangent(middle, &along(half, &k, &x), &along_tangent(half, &g, &m));
        sum = along(two, &k, &sum);
        sums = along_tangent(two, &g, &sums);
        let (k, g, mark4) = field.tangent(last, &along(h, &k, &x), &along_tangent(h, &g, &m));
        let mut end = array(|i| sixth.mul_add(sum[i] + k[i], x[i]));
        let mut tangent = array(|i| array(|c| sixth.mul_add(sums[i][c] + g[i][c], m[i][c])));
        field.renormalise_with_tangent(&mut end, &mut tangent);

        let known = if V::HAS_MISSING { (mark1 + mark2 + (mark3 + mark4)).is_number() } else { L::Mask::splat(true) };
        if status.update(n, field.inside(&end), known) {
            (x, m) = (end, tangent);
        } else {
            if !status.alive.any() {
                break;
            }
            x = array(|i| L::select(status.alive, end[i], x[i]));
            m = array(|i| array(|c| L::select(status.alive, tangent[i][c], m[i][c])));
        }
        rescale(&mut m, &mut exponent);
    }
    let gradient = field.gradient(&x, &m);
    let log_stretch = exponent.mul_add(L::splat_f64(std::f64::consts::LN_2), log_stretch(&gradient));
    TracedBatch { log_stretch, lifetime_share: status.lifetime_share(steps), left_domain: status.left_domain, state: x, gradient, exponent }
}

/// One step of one particle: returns its new state and its mark.
#[inline(always)]
fn advance<L: Lanes, V: Velocity<L, D, C>, const D: usize, const C: usize>(
    field: &V,
    stages: &[V::Stage],
    step: [L; 4],
    x: &[L; D],
) -> ([L; D], L) {
    let [h, half, sixth, two] = step;
    let (k, mark1) = field.velocity(&stages[0], x);
    let mut sum = k;
    let (k, mark2) = field.velocity(&stages[1], &along(half, &k, x));
    sum = along(two, &k, &sum);
    let (k, mark3) = field.velocity(&stages[1], &along(half, &k, x));
    sum = along(two, &k, &sum);
    let (k, mark4) = field.velocity(&stages[2], &along(h, &k, x));
    let mut end = array(|i| sixth.mul_add(sum[i] + k[i], x[i]));
    field.renormalise(&mut end);
    (end, mark1 + mark2 + (mark3 + mark4))
}

/// Integrates two particles per axis, `difference_step` coordinate units to either side of the seed, and takes central differences. All stop
/// as soon as one of them does.
#[inline(never)]
pub fn differences<L: Lanes, V: Velocity<L, D, C>, const D: usize, const C: usize>(
    field: &V,
    stages: &[V::Stage],
    step: f64,
    difference_step: f64,
    points: &[DomainPoint],
) -> TracedBatch<L, D, C> {
    let steps = stages.len() / 2;
    let factors = [L::splat_f64(step), L::splat_f64(step / 2.0), L::splat_f64(step / 6.0), L::splat_f64(2.0)];
    let mut pairs: [[[L; D]; 2]; C] = array(|axis| {
        [difference_step, -difference_step].map(|offset| {
            lanes_of(points, |p| {
                let mut p = p.0.map(f64::from);
                p[axis] += offset;
                field.seed_state(p)
            })
        })
    });
    let all_inside = |pairs: &[[[L; D]; 2]; C]| pairs.iter().flatten().fold(L::Mask::splat(true), |inside, x| inside & field.inside(x));
    let mut status = ParticleStatus::<L>::new(all_inside(&pairs), steps);
    for n in 0..steps {
        let mut mark = L::zero();
        let mut ends = pairs;
        for end in ends.iter_mut().flatten() {
            let (there, its_mark) = advance(field, &stages[2 * n..2 * n + 3], factors, end);
            *end = there;
            mark += its_mark;
        }
        let known = if V::HAS_MISSING { mark.is_number() } else { L::Mask::splat(true) };
        if status.update(n, all_inside(&ends), known) {
            pairs = ends;
        } else {
            if !status.alive.any() {
                break;
            }
            for (x, end) in pairs.iter_mut().flatten().zip(ends.iter().flatten()) {
                *x = array(|i| L::select(status.alive, end[i], x[i]));
            }
        }
    }
    let [inverse]: [[L; C]; 1] = [lanes_of(points, |p| array(|axis| 1.0 / field.separation(p.0.map(f64::from), axis, difference_step)))];
    let m: [[L; C]; D] = array(|i| array(|c| (pairs[c][0][i] - pairs[c][1][i]) * inverse[c]));
    let half = L::splat_f64(0.5 / C as f64);
    let mut state = array(|i| pairs.iter().flatten().fold(L::zero(), |sum, x| half.mul_add(x[i], sum)));
    field.renormalise(&mut state);
    let gradient = field.gradient(&state, &m);
    TracedBatch {
        log_stretch: log_stretch(&gradient),
        lifetime_share: status.lifetime_share(steps),
        left_domain: status.left_domain,
        state,
        gradient,
        exponent: L::zero(),
    }
}
