//! Flows in closed form: velocity and exact gradient, for any lanes.

use super::{Geometry, Grid, Snapshot};
use rayon::prelude::*;
use ridgewatch_simd::{Lanes, Real, array};
use std::f64::consts::PI;
use std::sync::Arc;

/// A flow in closed form, with its parameters.
#[derive(Debug, Clone, PartialEq)]
pub enum Analytic {
    /// u = -pi A sin(pi f) cos(pi y), v = pi A cos(pi f) sin(pi y) df/dx, f = a x^2 + b x, a = eps sin(omega t), b = 1 - 2a
    /// (Shadden, Lekien, Marsden 2005); extruded along z.
    DoubleGyre {
        /// A.
        amplitude: f64,
        /// eps.
        epsilon: f64,
        /// omega, radians per time unit.
        omega: f64,
    },
    /// Arnold-Beltrami-Childress flow: u = A' sin z + C cos y, v = B sin x + A' cos z, w = C sin y + B cos x with
    /// A' = A + growth * sin(pi t) * t in the unsteady form (Haller 2001: growth 0.5).
    Abc {
        /// A.
        a: f64,
        /// B.
        b: f64,
        /// C.
        c: f64,
        /// Growth of A; 0 is the steady flow.
        growth: f64,
    },
    /// u = rate x, v = -rate y: FTLE = rate, forward and backward.
    Saddle {
        /// rate.
        rate: f64,
    },
    /// Solid rotation about the origin: FTLE = 0.
    Rotation {
        /// Radians per time unit.
        omega: f64,
    },
    /// u = rate y: sigma_max^2 = 1 + g^2/2 + g sqrt(1 + g^2/4), g = rate tau.
    Shear {
        /// rate.
        rate: f64,
    },
}

impl Analytic {
    /// Number of axes along which the flow varies: 2 or 3.
    pub fn dimensions(&self) -> usize {
        match self {
            Analytic::Abc { .. } => 3,
            _ => 2,
        }
    }
}

/// The constants of a closed form at one time, computed once for all samples.
pub type Constants<R> = [R; 4];

/// A closed form as a type, for which kernels are compiled. `D` is the number of axes.
pub trait ClosedForm<const D: usize>: Copy + Send + Sync + 'static {
    /// Constants at a time.
    fn constants(&self, time: f64) -> Constants<f64>;
    /// Velocity at `x`.
    fn velocity<L: Lanes>(constants: &Constants<L::Real>, x: &[L; D]) -> [L; D];
    /// Velocity at `x`, and its gradient times `m`.
    fn tangent<L: Lanes, const C: usize>(constants: &Constants<L::Real>, x: &[L; D], m: &[[L; C]; D]) -> ([L; D], [[L; C]; D]);
}

/// [`Analytic::DoubleGyre`].
#[derive(Debug, Clone, Copy)]
pub struct DoubleGyre {
    amplitude: f64,
    epsilon: f64,
    omega: f64,
}

impl DoubleGyre {
    /// Phase in radians per unit of time. The flow depends on time through its phase alone.
    pub fn rate(&self) -> f64 {
        self.omega
    }

    /// The first two constants, and epsilon times sine and cosine of the phase `time` after a start. With sine and cosine of the phase at the
    /// start they give the constants at that time (sin(a + b) = sin a cos b + cos a sin b).
    pub fn constants_since(&self, time: f64) -> Constants<f64> {
        let [scale, scale_pi, ..] = self.constants(time);
        let (sine, cosine) = (self.omega * time).sin_cos();
        [scale, scale_pi, self.epsilon * sine, self.epsilon * cosine]
    }
}

impl ClosedForm<2> for DoubleGyre {
    fn constants(&self, time: f64) -> Constants<f64> {
        let a = self.epsilon * (self.omega * time).sin();
        [PI * self.amplitude, PI * PI * self.amplitude, a, 1.0 - 2.0 * a]
    }
    #[inline(always)]
    fn velocity<L: Lanes>(constants: &Constants<L::Real>, x: &[L; 2]) -> [L; 2] {
        let [scale, _, a, b] = array(|i| L::splat(constants[i]));
        let ax = a * x[0];
        let slope = ax + ax + b;
        let (sin_f, cos_f) = ((ax + b) * x[0]).sin_cos_pi();
        let (sin_y, cos_y) = x[1].sin_cos_pi();
        [-(scale * sin_f) * cos_y, (scale * cos_f) * (sin_y * slope)]
    }
    #[inline(always)]
    fn tangent<L: Lanes, const C: usize>(constants: &Constants<L::Real>, x: &[L; 2], m: &[[L; C]; 2]) -> ([L; 2], [[L; C]; 2]) {
        let [scale, scale_pi, a, b] = array(|i| L::splat(constants[i]));
        let ax = a * x[0];
        let slope = ax + ax + b;
        let (sin_f, cos_f) = ((ax + b) * x[0]).sin_cos_pi();
        let (sin_y, cos_y) = x[1].sin_cos_pi();
        let (along, across) = (scale * cos_f * sin_y, sin_f * sin_y);
        let velocity = [-(scale * sin_f) * cos_y, along * slope];
        // -u_x = v_y = q, u_y = r, v_x = p
        let q = scale_pi * slope * (cos_f * cos_y);
        let r = scale_pi * across;
        let p = (-r * slope).mul_add(slope, along * (a + a));
        let product = [array(|k| r.mul_add(m[1][k], -(q * m[0][k]))), array(|k| p.mul_add(m[0][k], q * m[1][k]))];
        (velocity, product)
    }
}

/// [`Analytic::Abc`].
#[derive(Debug, Clone, Copy)]
pub struct Abc {
    a: f64,
    b: f64,
    c: f64,
    growth: f64,
}

impl ClosedForm<3> for Abc {
    fn constants(&self, time: f64) -> Constants<f64> {
        let growth = if self.growth == 0.0 { 0.0 } else { self.growth * (PI * time).sin() * time };
        [self.a + growth, self.b, self.c, 0.0]
    }
    #[inline(always)]
    fn velocity<L: Lanes>(constants: &Constants<L::Real>, x: &[L; 3]) -> [L; 3] {
        let [a, b, c, _] = array(|i| L::splat(constants[i]));
        let [(sx, cx), (sy, cy), (sz, cz)] = array(|i| x[i].sin_cos());
        [a.mul_add(sz, c * cy), b.mul_add(sx, a * cz), c.mul_add(sy, b * cx)]
    }
    #[inline(always)]
    fn tangent<L: Lanes, const C: usize>(constants: &Constants<L::Real>, x: &[L; 3], m: &[[L; C]; 3]) -> ([L; 3], [[L; C]; 3]) {
        let [a, b, c, _] = array(|i| L::splat(constants[i]));
        let [(sx, cx), (sy, cy), (sz, cz)] = array(|i| x[i].sin_cos());
        let (asz, acz, bsx, bcx, csy, ccy) = (a * sz, a * cz, b * sx, b * cx, c * sy, c * cy);
        let velocity = [asz + ccy, bsx + acz, csy + bcx];
        let product = [
            array(|k| acz.mul_add(m[2][k], -(csy * m[1][k]))),
            array(|k| bcx.mul_add(m[0][k], -(asz * m[2][k]))),
            array(|k| ccy.mul_add(m[1][k], -(bsx * m[0][k]))),
        ];
        (velocity, product)
    }
}

/// v = G x with a constant G: saddle, rotation and shear.
#[derive(Debug, Clone, Copy)]
pub struct Linear {
    gradient: [f64; 4],
}

impl ClosedForm<2> for Linear {
    fn constants(&self, _: f64) -> Constants<f64> {
        self.gradient
    }
    #[inline(always)]
    fn velocity<L: Lanes>(constants: &Constants<L::Real>, x: &[L; 2]) -> [L; 2] {
        // A coordinate that overflowed times a coefficient of 0 would be NaN.
        let term = |row: usize, column: usize| {
            let g = constants[2 * row + column];
            if g == L::Real::from_f64(0.0) { L::zero() } else { L::splat(g) * x[column] }
        };
        [term(0, 0) + term(0, 1), term(1, 0) + term(1, 1)]
    }
    #[inline(always)]
    fn tangent<L: Lanes, const C: usize>(constants: &Constants<L::Real>, x: &[L; 2], m: &[[L; C]; 2]) -> ([L; 2], [[L; C]; 2]) {
        let g: [L; 4] = array(|i| L::splat(constants[i]));
        let row = |i: usize| array(|k| g[2 * i].mul_add(m[0][k], g[2 * i + 1] * m[1][k]));
        (Self::velocity(constants, x), [row(0), row(1)])
    }
}

/// An [`Analytic`] as the type for which its kernel is compiled.
#[derive(Debug, Clone, Copy)]
pub enum Form {
    /// Double gyre.
    DoubleGyre(DoubleGyre),
    /// ABC.
    Abc(Abc),
    /// Constant gradient.
    Linear(Linear),
}

impl Analytic {
    /// The type of the closed form.
    pub fn form(&self) -> Form {
        let linear = |gradient| Form::Linear(Linear { gradient });
        match *self {
            Analytic::DoubleGyre { amplitude, epsilon, omega } => Form::DoubleGyre(DoubleGyre { amplitude, epsilon, omega }),
            Analytic::Abc { a, b, c, growth } => Form::Abc(Abc { a, b, c, growth }),
            Analytic::Saddle { rate } => linear([rate, 0.0, 0.0, -rate]),
            Analytic::Rotation { omega } => linear([0.0, -omega, omega, 0.0]),
            Analytic::Shear { rate } => linear([0.0, rate, 0.0, 0.0]),
        }
    }

    /// Velocity at a point and time, in coordinate units per time unit.
    pub fn velocity(&self, point: [f64; 3], time: f64) -> [f64; 3] {
        let plane = [point[0], point[1]];
        let flat = |v: [f64; 2]| [v[0], v[1], 0.0];
        match self.form() {
            Form::DoubleGyre(form) => flat(DoubleGyre::velocity(&form.constants(time), &plane)),
            Form::Abc(form) => Abc::velocity(&form.constants(time), &point),
            Form::Linear(form) => flat(Linear::velocity(&form.constants(time), &plane)),
        }
    }

    /// Exact gradient: row i, column j is d v_i / d x_j.
    pub fn gradient(&self, point: [f64; 3], time: f64) -> [[f64; 3]; 3] {
        fn flat<F: ClosedForm<2>>(form: F, point: [f64; 3], time: f64) -> [[f64; 3]; 3] {
            let (_, g) = F::tangent(&form.constants(time), &[point[0], point[1]], &[[1.0, 0.0], [0.0, 1.0]]);
            [[g[0][0], g[0][1], 0.0], [g[1][0], g[1][1], 0.0], [0.0; 3]]
        }
        match self.form() {
            Form::DoubleGyre(form) => flat(form, point, time),
            Form::Abc(form) => {
                let identity: [[f64; 3]; 3] = array(|i| array(|j| f64::from(u8::from(i == j))));
                Abc::tangent(&form.constants(time), &point, &identity).1
            }
            Form::Linear(form) => flat(form, point, time),
        }
    }

    /// The flow sampled at the nodes of a Cartesian grid.
    pub fn snapshot(&self, time: f64, grid: &Arc<Grid>) -> Snapshot {
        debug_assert_eq!(grid.geometry, Geometry::Cartesian);
        let [nx, ny, _] = grid.shape();
        let at = |axis: usize, index: usize| grid.axes.get(axis).map_or(0.0, |a| a.coordinates()[index]);
        let nodes = (0..grid.nodes())
            .into_par_iter()
            .map(|i| {
                let v = self.velocity([at(0, i % nx), at(1, i / nx % ny), at(2, i / nx / ny)], time);
                [v[0] as f32, v[1] as f32, v[2] as f32, 0.0]
            })
            .collect();
        Snapshot::new(time, grid.clone(), nodes)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn gradients_are_the_derivatives() {
        let flows = [
            Analytic::DoubleGyre { amplitude: 0.1, epsilon: 0.25, omega: 0.6 },
            Analytic::Abc { a: 3f64.sqrt(), b: 2f64.sqrt(), c: 1.0, growth: 0.5 },
            Analytic::Saddle { rate: 0.7 },
            Analytic::Rotation { omega: 0.7 },
            Analytic::Shear { rate: 0.7 },
        ];
        let (point, time, step) = ([0.63, 0.21, 1.3], 2.4, 1e-5);
        for flow in flows {
            let gradient = flow.gradient(point, time);
            for j in 0..flow.dimensions() {
                let shifted = |sign: f64| {
                    let mut p = point;
                    p[j] += sign * step;
                    flow.velocity(p, time)
                };
                let (plus, minus) = (shifted(1.0), shifted(-1.0));
                for i in 0..3 {
                    let difference = (plus[i] - minus[i]) / (2.0 * step);
                    // Truncation, step^2 times a third derivative over 6, is below 2e-9; rounding is 1e-16 / step = 1e-11.
                    assert!((difference - gradient[i][j]).abs() < 3e-9, "{flow:?} {i} {j}: {difference} {}", gradient[i][j]);
                }
            }
        }
    }

    #[test]
    fn double_gyre_is_the_published_one() {
        let flow = Analytic::DoubleGyre { amplitude: 0.1, epsilon: 0.25, omega: 2.0 * PI / 10.0 };
        let ([x, y], t) = ([1.3, 0.4], 1.7);
        let a = 0.25 * (2.0 * PI / 10.0 * t).sin();
        let (f, slope) = (a * x * x + (1.0 - 2.0 * a) * x, 2.0 * a * x + 1.0 - 2.0 * a);
        let v = flow.velocity([x, y, 0.5], t);
        assert!((v[0] + PI * 0.1 * (PI * f).sin() * (PI * y).cos()).abs() < 1e-15);
        assert!((v[1] - PI * 0.1 * (PI * f).cos() * (PI * y).sin() * slope).abs() < 1e-15);
    }
}
