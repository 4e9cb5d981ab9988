//! Makes the tracer of a flow map: picks the kernel that is compiled for its flow, integrator and precision.

use super::displacement::cells_crossed;
use super::grid_flow::GridFlow;
use super::missing_cells::MissingCells;
use super::sphere::SphereFlow;
use super::sphere_levels::LayeredSphereFlow;
use super::tracer::{AdaptiveKernel, CpuTracer, DifferencesKernel, Kernel, Order, Stages, TangentKernel};
use super::velocity::{ClosedFormFlow, Coordinates, Velocity};
use super::{Boundary, FlowError, FlowMap, Integrator, Precision, StepChoice, Steps, Tracer, VelocitySource, dormand_prince, steps};
use ridgewatch_field::analytic::{ClosedForm, Form};
use ridgewatch_field::{Domain, Geometry, Window};
use ridgewatch_simd::{Gather, LanePair, Lanes};
use std::marker::PhantomData;
use wide::{f32x8, f64x4};

/// Makes the tracer of the CPU for seeds at time `t0`.
///
/// # Errors
/// A parameter out of range, a window that does not cover the integration, or a combination without meaning; see [`FlowError`].
pub fn cpu_tracer(source: VelocitySource, map: &FlowMap, t0: f64) -> Result<Box<dyn Tracer>, FlowError> {
    tracer_in_order(source, map, t0, Order::Auto)
}

/// [`cpu_tracer`] with a choice of order, for benchmarks.
///
/// # Errors
/// As [`cpu_tracer`].
pub fn tracer_in_order(source: VelocitySource, map: &FlowMap, t0: f64, order: Order) -> Result<Box<dyn Tracer>, FlowError> {
    TracerBuilder::new(source, map, t0, order)?.build::<f32x8, f64x4, LanePair<f32x8>>()
}

/// [`cpu_tracer`] without vectors, one sample at a time, for benchmarks.
///
/// # Errors
/// As [`cpu_tracer`].
pub fn scalar_tracer(source: VelocitySource, map: &FlowMap, t0: f64) -> Result<Box<dyn Tracer>, FlowError> {
    TracerBuilder::new(source, map, t0, Order::Auto)?.build::<f32, f64, f32>()
}

/// The parts that all kinds of tracer share.
struct TracerBuilder<'a> {
    source: VelocitySource,
    domain: Domain,
    map: &'a FlowMap,
    from: f64,
    to: f64,
    order: Order,
}

fn positive(key: &'static str, value: f64) -> Result<(), FlowError> {
    if value.is_finite() && value > 0.0 {
        Ok(())
    } else {
        Err(FlowError::OutOfRange { key, found: value, accepted: "a finite number above 0" })
    }
}

impl<'a> TracerBuilder<'a> {
    fn new(source: VelocitySource, map: &'a FlowMap, t0: f64, order: Order) -> Result<Self, FlowError> {
        positive("tau", map.tau)?;
        match map.steps {
            Steps::Auto { tolerance } | Steps::AutoByShare { tolerance, .. } => positive("steps.tolerance", tolerance)?,
            Steps::Fixed(0) => return Err(FlowError::OutOfRange { key: "steps", found: 0.0, accepted: "1 or more" }),
            Steps::Fixed(_) => {}
        }
        if !t0.is_finite() {
            return Err(FlowError::OutOfRange { key: "t0", found: t0, accepted: "a finite time" });
        }
        let to = t0 + map.direction.sign() * map.tau;
        let domain = match &source {
            VelocitySource::Analytic(_, domain) => domain.clone(),
            VelocitySource::Window(window) => covered_domain(window, t0.min(to), t0.max(to))?,
        };
        if map.integrator == Integrator::Differences {
            positive("difference_step", map.difference_step)?;
            if map.precision == Precision::F32 {
                let used = 0..domain.dimensions;
                let coordinate = used.flat_map(|k| [domain.min[k].abs(), domain.max[k].abs()]).fold(0.0, f64::max);
                let min_step = coordinate * f64::from(f32::EPSILON);
                if map.difference_step < min_step {
                    return Err(FlowError::DifferenceStepVanishes {
                        step: map.difference_step,
                        precision: map.precision,
                        coordinate,
                        min_step,
                    });
                }
            }
        }
        Ok(Self { source, domain, map, from: t0, to, order })
    }

    /// `S` and `D` are the single- and double-precision lanes. `P` are the single-precision lanes for closed forms in the plane: their state
    /// is so small that two chains of instructions fit into the registers, which is a quarter faster (and slower for other flows).
    fn build<S, D, P>(self) -> Result<Box<dyn Tracer>, FlowError>
    where
        S: Gather<Real = f32>,
        D: Gather<Real = f64>,
        P: Lanes<Real = f32>,
    {
        match &self.source {
            VelocitySource::Analytic(flow, domain) => {
                if flow.dimensions() != domain.dimensions {
                    return Err(FlowError::Dimensions { flow: flow.dimensions(), domain: domain.dimensions });
                }
                match flow.form() {
                    Form::DoubleGyre(form) => self.closed::<_, P, D, 2>(form),
                    Form::Abc(form) => self.closed::<_, S, D, 3>(form),
                    Form::Linear(form) => self.closed::<_, P, D, 2>(form),
                }
            }
            VelocitySource::Window(window) => {
                let window = window.clone();
                let grid = window.grid().ok_or_else(|| window_too_short(&window, self.from, self.to))?.clone();
                let (boundary, interpolation) = (self.map.boundary, self.map.interpolation);
                match (grid.geometry, grid.dimensions()) {
                    (Geometry::Cartesian, 2) => self.kernel::<_, _, S, D, 2, 2>(
                        || GridFlow::<f32, 2>::new(&window, &grid, boundary, interpolation),
                        || GridFlow::<f64, 2>::new(&window, &grid, boundary, interpolation),
                    ),
                    (Geometry::Cartesian, _) => self.kernel::<_, _, S, D, 3, 3>(
                        || GridFlow::<f32, 3>::new(&window, &grid, boundary, interpolation),
                        || GridFlow::<f64, 3>::new(&window, &grid, boundary, interpolation),
                    ),
                    (Geometry::Sphere { radius }, 2) => {
                        positive("radius", radius)?;
                        self.kernel::<_, _, S, D, 3, 2>(
                            || SphereFlow::<f32>::new(&window, &grid, radius, boundary, interpolation),
                            || SphereFlow::<f64>::new(&window, &grid, radius, boundary, interpolation),
                        )
                    }
                    (Geometry::Sphere { radius }, 3) => {
                        positive("radius", radius)?;
                        self.kernel::<_, _, S, D, 4, 3>(
                            || LayeredSphereFlow::<f32>::new(&window, &grid, radius, boundary, interpolation),
                            || LayeredSphereFlow::<f64>::new(&window, &grid, radius, boundary, interpolation),
                        )
                    }
                    (Geometry::Sphere { .. }, axes) => Err(FlowError::SphereAxes { axes }),
                }
            }
        }
    }

    fn closed<F: ClosedForm<N>, S: Lanes<Real = f32>, D: Lanes<Real = f64>, const N: usize>(
        &self,
        form: F,
    ) -> Result<Box<dyn Tracer>, FlowError> {
        self.kernel::<_, _, S, D, N, N>(
            || Ok(ClosedFormFlow::<F, f32, N>::new(form, &self.domain, self.map.boundary)),
            || Ok(ClosedFormFlow::<F, f64, N>::new(form, &self.domain, self.map.boundary)),
        )
    }

    /// Makes a tracer with the integrator, precision and number of steps of the map.
    fn kernel<V32, V64, S, D, const N: usize, const C: usize>(
        &self,
        single: impl FnOnce() -> Result<V32, FlowError>,
        double: impl Fn() -> Result<V64, FlowError>,
    ) -> Result<Box<dyn Tracer>, FlowError>
    where
        S: Lanes,
        D: Lanes<Real = f64>,
        V32: Velocity<S, N, C> + 'static,
        V64: Velocity<D, N, C> + Velocity<f64, N, C> + 'static,
    {
        let (from, to) = (self.from, self.to);
        if self.map.integrator == Integrator::DormandPrince {
            let kernel = AdaptiveKernel { from, to, tolerance: dormand_prince::TOLERANCE };
            return Ok(Box::new(self.tracer::<_, _, f64, N, C>(double()?, kernel)));
        }
        let (count, chosen) = match self.map.steps {
            Steps::Fixed(steps) => (steps, None),
            Steps::Auto { tolerance } | Steps::AutoByShare { tolerance, .. } => {
                let share = if let Steps::AutoByShare { share, .. } = self.map.steps { share } else { f64::INFINITY };
                // Steps are chosen in double precision, so that rounding does not affect the choice.
                let mut tracer = self.tracer::<_, _, D, N, C>(double()?, TangentKernel(Stages::empty()));
                let intervals = intervals(Coordinates::break_times(&tracer.field), from, to);
                // Paths that stop are cut to whole steps, so that they need shorter ones.
                let steps_per_cell = if matches!(self.map.boundary, Boundary::Stop | Boundary::Zero) { 2.0 } else { 1.0 };
                let cells = match &self.source {
                    VelocitySource::Window(window) => steps_per_cell * cells_crossed(window, from, to),
                    VelocitySource::Analytic(..) => 0.0,
                };
                let chosen = steps::choose_steps(
                    tolerance,
                    steps::GridConstraints { intervals, min_steps: cells, share },
                    &self.domain,
                    |steps, points, out| {
                        tracer.kernel = TangentKernel(Stages::new::<V64, D, N, C>(&tracer.field, from, to, steps));
                        tracer.trace(points, super::Extras::default(), out);
                    },
                )?;
                (chosen.steps, Some(chosen))
            }
        };
        match self.map.precision {
            Precision::F32 => Ok(self.fixed::<V32, S, N, C>(single()?, count, chosen)),
            Precision::F64 => Ok(self.fixed::<V64, D, N, C>(double()?, count, chosen)),
        }
    }

    fn fixed<V, L, const N: usize, const C: usize>(&self, field: V, steps: usize, chosen: Option<StepChoice>) -> Box<dyn Tracer>
    where
        L: Lanes,
        V: Velocity<L, N, C> + 'static,
    {
        let stages = Stages::new::<V, L, N, C>(&field, self.from, self.to, steps);
        if self.map.integrator == Integrator::Differences {
            Box::new(CpuTracer { chosen, ..self.tracer::<_, _, L, N, C>(field, DifferencesKernel(stages, self.map.difference_step)) })
        } else {
            Box::new(CpuTracer { chosen, ..self.tracer::<_, _, L, N, C>(field, TangentKernel(stages)) })
        }
    }

    fn tracer<V, K, L, const N: usize, const C: usize>(&self, field: V, kernel: K) -> CpuTracer<K, V, L, N, C>
    where
        L: Lanes,
        K: Kernel<V, L, N, C>,
    {
        CpuTracer {
            field,
            kernel,
            domain: self.domain.clone(),
            start: self.from,
            tau: self.map.tau,
            boundary: self.map.boundary,
            normalisation: self.map.normalisation,
            order: self.order,
            chosen: None,
            missing_cells: match &self.source {
                VelocitySource::Analytic(..) => MissingCells::none(),
                VelocitySource::Window(window) => MissingCells::at(window, self.from, self.map.interpolation),
            },
            lanes: PhantomData,
        }
    }
}

fn window_too_short(window: &Window, from: f64, to: f64) -> FlowError {
    let present = window.snapshots().len();
    let covered = window.oldest().zip(window.newest());
    let (from, to) = (from.min(to), from.max(to));
    let needed = match covered {
        Some((first, last)) if present > 1 => ((to - from) / ((last - first) / (present - 1) as f64)).ceil() as usize + 1,
        _ => 2,
    };
    FlowError::WindowTooShort { from, to, needed, present, covered }
}

/// The domain of the grid.
///
/// # Errors
/// [`FlowError::WindowTooShort`] unless the snapshots cover the time from `from` to `to`.
fn covered_domain(window: &Window, from: f64, to: f64) -> Result<Domain, FlowError> {
    let slack = (to - from) * 1e-9;
    match (window.grid(), window.oldest(), window.newest()) {
        (Some(grid), Some(first), Some(last)) if window.snapshots().len() > 1 && first <= from + slack && last >= to - slack => {
            Ok(grid.domain())
        }
        _ => Err(window_too_short(window, from, to)),
    }
}

/// Number of snapshot intervals that the integration touches; 0 for closed forms.
fn intervals(times: &[f64], from: f64, to: f64) -> usize {
    let (from, to) = (from.min(to), from.max(to));
    let slack = (to - from) * 1e-9;
    times.windows(2).filter(|w| w[1] > from + slack && w[0] < to - slack).count()
}
