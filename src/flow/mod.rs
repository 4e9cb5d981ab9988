//! Ground truth: integrators, tangent flow map, Cauchy-Green, log-stretch and FTLE.
//!
//! In: a velocity (closed form or window) and seeds. Out: the log-stretch s = ln sigma_max(J) = |tau| FTLE at each seed. This room
//! calls only `field`; it knows nothing of networks, images or sockets.

use crate::field::{Domain, Window, analytic::Analytic};
use serde::{Deserialize, Serialize};
use std::sync::Arc;

mod assemble;
mod axis_map;
mod dormand_prince;
mod error;
mod grid_flow;
mod resolution;
mod rk4;
mod sampler;
mod settings;
mod sphere;
mod sphere_levels;
mod stencil;
mod steps;
mod stretch;
mod tracer;
mod velocity;
mod voids;

pub use assemble::{cpu_tracer, scalar_tracer, tracer_in_order};
#[cfg(feature = "cuda")]
pub(crate) use axis_map::AxisMap;
pub use error::FlowError;
pub use resolution::{TimeResolution, time_resolution};
pub use settings::{FlowSettings, StepsSetting};
#[cfg(feature = "cuda")]
pub(crate) use sphere::poles;
pub use steps::Chosen;
pub(crate) use stretch::log_stretch;
pub use tracer::Order;
#[cfg(feature = "cuda")]
pub(crate) use velocity::{angle_slack, bounds};
#[cfg(feature = "cuda")]
pub(crate) use voids::Voids;

/// Which way particles travel from the seed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Direction {
    /// From t0 to t0 + tau: ridges repel.
    Forward,
    /// From t0 to t0 - tau: ridges attract.
    Backward,
}

impl Direction {
    /// `forward` or `backward`.
    pub fn name(self) -> &'static str {
        match self {
            Direction::Forward => "forward",
            Direction::Backward => "backward",
        }
    }

    /// +1 or -1.
    pub fn sign(self) -> f64 {
        match self {
            Direction::Forward => 1.0,
            Direction::Backward => -1.0,
        }
    }
}

/// How the flow map's gradient is found.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Integrator {
    /// dJ/dt = (grad v) J along one path, Runge-Kutta of order 4.
    Tangent,
    /// Central differences of 2 particles an axis, `gap` apart from the seed, Runge-Kutta of order 4 (the published way).
    Differences,
    /// Tangent flow by the adaptive pair of Dormand and Prince in f64: the reference.
    #[serde(rename = "dormand_prince", alias = "dormandprince")]
    DormandPrince,
}

/// Floating-point type of the integration.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Precision {
    /// Single.
    F32,
    /// Double.
    F64,
}

/// What happens to a particle at the edge of the domain.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Boundary {
    /// It stops and keeps the stretch it had; it is counted.
    Stop,
    /// Velocity outside is the velocity at the nearest point of the edge.
    Clamp,
    /// The domain repeats along every axis.
    Periodic,
    /// Closed-form flows go on outside the box.
    Unbounded,
    /// It stops and its FTLE is 0 (the published small renderer).
    Zero,
}

/// What the log-stretch of a particle that stopped early is divided by.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Normalisation {
    /// |tau|: a particle stopped at a coast shows no ridge there.
    Tau,
    /// The time it lived (tends to the local strain rate).
    Lived,
}

/// Spatial interpolation of gridded velocity.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Interpolation {
    /// Linear along each axis.
    Linear,
    /// Catmull-Rom along each axis, continuously differentiable.
    Cubic,
}

/// How many Runge-Kutta steps a path gets.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Steps {
    /// The fewest whose log-stretch differs from twice as many by at most this root mean square, on a few thousand points; on grids at least
    /// two a snapshot interval and one a cell that is crossed (two where paths stop at edges and land).
    Auto {
        /// Root mean square of the log-stretch.
        tolerance: f64,
    },
    /// This many.
    Fixed(usize),
}

/// Everything that defines one flow map, but for its start time.
#[derive(Debug, Clone, PartialEq)]
pub struct FlowMap {
    /// |tau|, in time units.
    pub tau: f64,
    /// Forward or backward.
    pub direction: Direction,
    /// How J is found.
    pub integrator: Integrator,
    /// Floating-point type.
    pub precision: Precision,
    /// Number of steps.
    pub steps: Steps,
    /// Distance of the difference particles from the seed, in coordinate units.
    pub gap: f64,
    /// Edge policy.
    pub boundary: Boundary,
    /// Divisor for particles that stopped early.
    pub normalisation: Normalisation,
    /// Interpolation of gridded velocity.
    pub interpolation: Interpolation,
}

impl FlowMap {
    /// The production path with so many steps over `tau`: forward, tangent flow in single precision, unbounded, linear interpolation.
    pub fn tangent(tau: f64, steps: usize) -> Self {
        Self {
            tau,
            direction: Direction::Forward,
            integrator: Integrator::Tangent,
            precision: Precision::F32,
            steps: Steps::Fixed(steps),
            gap: 1e-4,
            boundary: Boundary::Unbounded,
            normalisation: Normalisation::Tau,
            interpolation: Interpolation::Linear,
        }
    }
}

/// The velocity that is integrated.
#[derive(Debug, Clone)]
pub enum VelocitySource {
    /// A closed form, anywhere and at any time, over this domain.
    Analytic(Analytic, Domain),
    /// Snapshots; the window covers [t0, t0 + tau].
    Window(Arc<Window>),
}

/// What a trace should return besides the log-stretch.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Extras {
    /// Arrival positions phi(x), in domain coordinates.
    pub arrival: bool,
    /// J = d phi / d x, row-major 3x3 (2-D flows: upper left 2x2).
    pub jacobian: bool,
}

/// One entry a seed, in the order of the seeds.
#[derive(Debug, Clone, Default)]
pub struct Traced {
    /// Log-stretch s = ln sigma_max(J), no unit; FTLE = s / |tau| (see [`Normalisation`], which is already applied).
    pub log_stretch: Vec<f32>,
    /// The same unrounded; filled when the integration is in double precision, otherwise empty.
    pub log_stretch_f64: Vec<f64>,
    /// Share of |tau| that the particle lived, in [0, 1].
    pub lived: Vec<f32>,
    /// Arrival positions; empty unless asked for.
    pub arrival: Vec<[f32; 3]>,
    /// Jacobians; empty unless asked for.
    pub jacobian: Vec<[f32; 9]>,
}

impl Traced {
    /// Room for so many seeds; entries that are new are unknown (NaN, lived 0). `double`: with unrounded log-stretches.
    pub(crate) fn set_len(&mut self, count: usize, extras: Extras, double: bool) {
        let wanted = |yes: bool| if yes { count } else { 0 };
        self.log_stretch.resize(count, f32::NAN);
        self.log_stretch_f64.resize(wanted(double), f64::NAN);
        self.lived.resize(count, 0.0);
        self.arrival.resize(wanted(extras.arrival), [f32::NAN; 3]);
        self.jacobian.resize(wanted(extras.jacobian), [f32::NAN; 9]);
    }
}

/// Traces seeds in large batches; shared by all threads. [`cpu_tracer`] makes the CPU's.
pub trait Tracer: Send + Sync {
    /// Where seeds may lie.
    fn domain(&self) -> &Domain;
    /// Seed time.
    fn start(&self) -> f64;
    /// |tau|.
    fn tau(&self) -> f64;
    /// Runge-Kutta steps a path gets.
    fn steps(&self) -> usize;
    /// How the number of steps was chosen; none where it was given.
    fn chosen(&self) -> Option<Chosen> {
        None
    }
    /// Whether a seed lies where the velocity is missing at its start time (land): it has no FTLE. Closed forms
    /// have velocity everywhere.
    fn is_void(&self, _seed: [f32; 3]) -> bool {
        false
    }
    /// Traces all seeds; sorts them by cell when that pays and parallelises over rayon's current pool. Replaces what `out` held.
    fn trace(&self, seeds: &[[f32; 3]], extras: Extras, out: &mut Traced);
}
