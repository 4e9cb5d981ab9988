//! Ground truth: integrators, tangent flow map, Cauchy-Green, log-stretch and FTLE.
//!
//! In: a velocity (closed form or window) and seeds. Out: the log-stretch s = ln sigma_max(J) = |tau| FTLE at each seed. This room
//! calls only `field`, `simd` and `setting`.
//!
//! FTLE(x, t, tau) = 1/|tau| ln sqrt(lambda_max(J^T J)) with J = d phi / d x, the gradient of the flow map phi (Haller 2001; Shadden, Lekien
//! and Marsden 2005). J is the solution of the variational equation dJ/dt = (grad v) J, integrated together with the path (`rk4`).

use ridgewatch_field::{Domain, DomainPoint, Window, analytic::Analytic};
use serde::{Deserialize, Serialize};
use std::sync::Arc;

mod assemble;
mod axis_map;
mod composition;
mod displacement;
mod dormand_prince;
mod error;
mod grid_flow;
mod integration;
mod missing_cells;
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

pub use assemble::{cpu_tracer, dormand_prince_tracer, scalar_tracer, tracer_in_order};
pub use axis_map::AxisMap;
pub use composition::Composition;
pub use error::FlowError;
pub use integration::{IntegrationDifferences, integration_differences};
pub use missing_cells::MissingCells;
pub use resolution::{TimeResolution, time_resolution};
pub use settings::{FlowSettings, StepsSetting};
pub use sphere::poles;
pub use stretch::log_stretch;
pub use tracer::Order;
pub use velocity::{angle_slack, bounds};

/// Direction of time in which particles travel from the seed.
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

/// Method that finds the gradient of the flow map.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Integrator {
    /// dJ/dt = (grad v) J along one path, Runge-Kutta of order 4.
    Tangent,
    /// Central differences of two particles per axis, `difference_step` away from the seed, Runge-Kutta of order 4 (the published method).
    Differences,
    /// Tangent flow by the adaptive pair of Dormand and Prince (1980) in f64: the reference.
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

/// Policy for particles that reach the edge of the domain.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Boundary {
    /// The particle stops, keeps the stretch that it had, and is counted.
    Stop,
    /// The velocity outside is that at the nearest point of the edge.
    Clamp,
    /// The domain repeats along every axis.
    Periodic,
    /// The flow continues outside the box (closed forms only).
    Unbounded,
    /// The particle stops and its FTLE is 0 (the published small renderer).
    Zero,
}

/// Divisor of the log-stretch of a particle that stopped early.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Normalisation {
    /// |tau|: a particle stopped at a coast shows no ridge there.
    Tau,
    /// The time until it stopped; the quotient tends to the local strain rate.
    Lifetime,
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

/// Number of Runge-Kutta steps per path.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Steps {
    /// The smallest number whose log-stretch differs from that of twice as many steps by at most the tolerance, on a few thousand points.
    /// On grids at least two per snapshot interval and one per cell crossed (two if paths stop at edges and missing cells).
    Auto {
        /// Root mean square difference of the log-stretch, no unit.
        tolerance: f64,
    },
    /// As `Auto`, and at most this share of the root mean square log-stretch. The gradient of a linear interpolant jumps at the faces of
    /// cells, so that errors fall only with the first power of the step, and short integrations have little stretch.
    AutoByShare {
        /// As for `Auto`.
        tolerance: f64,
        /// Share of the log-stretch, above 0.
        share: f64,
    },
    /// A given number.
    Fixed(usize),
}

/// Definition of a flow map, except for its start time.
#[derive(Debug, Clone, PartialEq)]
pub struct FlowMap {
    /// |tau|, in time units.
    pub tau: f64,
    /// Forward or backward.
    pub direction: Direction,
    /// Method that finds J.
    pub integrator: Integrator,
    /// Floating-point type.
    pub precision: Precision,
    /// Number of steps.
    pub steps: Steps,
    /// Distance of the particles of [`Integrator::Differences`] from the seed, in coordinate units.
    pub difference_step: f64,
    /// Edge policy.
    pub boundary: Boundary,
    /// Divisor for particles that stopped early.
    pub normalisation: Normalisation,
    /// Interpolation of gridded velocity.
    pub interpolation: Interpolation,
}

impl FlowMap {
    /// The production settings with `steps` steps over `tau`: forward, tangent flow in single precision, unbounded, linear interpolation.
    pub fn tangent(tau: f64, steps: usize) -> Self {
        Self {
            tau,
            direction: Direction::Forward,
            integrator: Integrator::Tangent,
            precision: Precision::F32,
            steps: Steps::Fixed(steps),
            difference_step: 1e-4,
            boundary: Boundary::Unbounded,
            normalisation: Normalisation::Tau,
            interpolation: Interpolation::Linear,
        }
    }
}

/// The velocity that is integrated.
#[derive(Debug, Clone)]
pub enum VelocitySource {
    /// A closed form over a domain, defined everywhere and at any time.
    Analytic(Analytic, Domain),
    /// Snapshots; the window covers [t0, t0 + tau].
    Window(Arc<Window>),
}

impl VelocitySource {
    /// Names and units of the coordinates; empty where there are none.
    pub fn axes(&self) -> [[String; 2]; 3] {
        [0, 1, 2].map(|k| match self {
            Self::Window(window) => {
                let axis = window.grid().and_then(|grid| grid.axes.get(k));
                axis.map_or_else(Default::default, |axis| [axis.name().to_owned(), axis.units().to_owned()])
            }
            Self::Analytic(..) => [["x", "y", "z"][k].to_owned(), String::new()],
        })
    }
}

/// Results that a trace returns besides the log-stretch.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Extras {
    /// Arrival positions phi(x), in domain coordinates.
    pub arrival: bool,
    /// J = d phi / d x, row-major 3x3 (2-D flows: upper left 2x2).
    pub jacobian: bool,
}

/// Results of a trace: one entry per seed, in the order of the seeds.
#[derive(Debug, Clone, Default)]
pub struct Traced {
    /// Log-stretch s = ln sigma_max(J), no unit; FTLE = s / |tau|. The [`Normalisation`] is already applied.
    pub log_stretch: Vec<f32>,
    /// The log-stretch in double precision; empty unless the integration is in double precision.
    pub log_stretch_f64: Vec<f64>,
    /// Share of |tau| until the particle stopped, in [0, 1]; 1 if it never stopped.
    pub lifetime_share: Vec<f32>,
    /// Arrival positions; empty unless requested.
    pub arrival: Vec<DomainPoint>,
    /// Jacobians; empty unless requested.
    pub jacobian: Vec<[f32; 9]>,
}

impl Traced {
    /// Appends the seeds of `other`, which holds the same kinds of results, and leaves it empty.
    pub fn append(&mut self, other: &mut Self) {
        self.log_stretch.append(&mut other.log_stretch);
        self.log_stretch_f64.append(&mut other.log_stretch_f64);
        self.lifetime_share.append(&mut other.lifetime_share);
        self.arrival.append(&mut other.arrival);
        self.jacobian.append(&mut other.jacobian);
    }

    /// The log-stretch in the precision of its integration.
    pub fn unrounded(&self) -> Vec<f64> {
        if self.log_stretch_f64.is_empty() {
            self.log_stretch.iter().map(|s| f64::from(*s)).collect()
        } else {
            self.log_stretch_f64.clone()
        }
    }

    /// Resizes all arrays to `count` seeds; new entries are NaN, with a lifetime of 0. `double`: also those in double precision.
    pub fn set_len(&mut self, count: usize, extras: Extras, double: bool) {
        let wanted = |yes: bool| if yes { count } else { 0 };
        self.log_stretch.resize(count, f32::NAN);
        self.log_stretch_f64.resize(wanted(double), f64::NAN);
        self.lifetime_share.resize(count, 0.0);
        self.arrival.resize(wanted(extras.arrival), DomainPoint([f32::NAN; 3]));
        self.jacobian.resize(wanted(extras.jacobian), [f32::NAN; 9]);
    }
}

/// How the number of steps was chosen.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StepChoice {
    /// Steps per path.
    pub steps: usize,
    /// Root mean square difference of the log-stretch from twice as many steps; on grids without the 2 % of the points that differ most.
    pub difference: f64,
    /// True if the difference is within the tolerance.
    pub within_tolerance: bool,
    /// Points, of [`Self::POINTS`], whose log-stretch is not finite.
    pub not_finite: usize,
    /// Numbers of steps are multiples of this: the snapshot intervals in tau, so that stages lie at the times of snapshots; 1 for closed forms.
    pub multiple_of: usize,
}

impl StepChoice {
    /// Points on which the error of a number of steps is measured.
    pub const POINTS: usize = 2048;
}

/// Traces seeds in large batches; shared by all threads. [`cpu_tracer`] makes the tracer of the CPU.
pub trait Tracer: Send + Sync {
    /// Box in which seeds may lie.
    fn domain(&self) -> &Domain;
    /// Seed time.
    fn start(&self) -> f64;
    /// |tau|.
    fn tau(&self) -> f64;
    /// Runge-Kutta steps per path; 0 if the step size is adaptive.
    fn steps(&self) -> usize;
    /// How the number of steps was chosen; `None` if it was given.
    fn step_choice(&self) -> Option<StepChoice> {
        None
    }
    /// True if there are missing cells at the start time. Closed forms have none.
    fn has_missing(&self) -> bool {
        false
    }
    /// True if a seed lies in a missing cell at the start time: it has no FTLE.
    fn is_missing(&self, _seed: DomainPoint) -> bool {
        false
    }
    /// Traces all seeds in parallel on the current rayon pool, sorted by cell if that is faster. Replaces the contents of `out`.
    fn trace(&self, seeds: &[DomainPoint], extras: Extras, out: &mut Traced);
}

impl Tracer for Box<dyn Tracer> {
    fn domain(&self) -> &Domain {
        (**self).domain()
    }

    fn start(&self) -> f64 {
        (**self).start()
    }

    fn tau(&self) -> f64 {
        (**self).tau()
    }

    fn steps(&self) -> usize {
        (**self).steps()
    }

    fn step_choice(&self) -> Option<StepChoice> {
        (**self).step_choice()
    }

    fn has_missing(&self) -> bool {
        (**self).has_missing()
    }

    fn is_missing(&self, seed: DomainPoint) -> bool {
        (**self).is_missing(seed)
    }

    fn trace(&self, seeds: &[DomainPoint], extras: Extras, out: &mut Traced) {
        (**self).trace(seeds, extras, out);
    }
}
