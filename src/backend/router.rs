//! Routes the log-stretch queries of a frame on the CPU, and keeps a sample of the traced ones as training labels.
//!
//! The routing rule is the same on every backend; `kernels/rendering/answer.cu` applies it on a GPU:
//! 1. A query in a missing cell has the value NaN.
//! 2. The surrogate predicts in cells that the gate trusts.
//! 3. RK4 traces all other queries. After the tracing budget of the frame is spent, the surrogate predicts them instead, and they are counted.
//! 4. Without a surrogate, every query outside missing cells is traced.
//!
//! So is the label rule ([`keeps_label`], `keeps_label` of `kernels/common/domain.cuh`): a traced query is a label if the hash of its point is among
//! the lowest 2^-shift of all hashes (adaptive sampling by hash value as in Wegman; Flajolet 1990). The shift grows until three quarters of the
//! bound hold the expected number of labels and the bound holds the labels themselves. So the set of the labels is a function of the set of traced
//! queries, whatever their order, and a uniform sample of it.

use super::DeviceError;
use ridgewatch_field::{Domain, DomainPoint, UnitPoint};
use ridgewatch_flow::{Extras, Traced};
use ridgewatch_render::LogStretch;
use ridgewatch_render::rng::philox;
use ridgewatch_surrogate::{Predict, Samples, Trace};
use ridgewatch_trust::Gate;
use std::time::Instant;

/// Inputs of the routing rule, and which labels are kept.
#[derive(Clone, Copy)]
pub struct Routing<'a> {
    /// Cells in which the surrogate is trusted.
    pub gate: &'a Gate,
    /// Seconds of tracing after which the surrogate predicts in untrusted cells too. `None`: no limit.
    pub trace_budget: Option<f64>,
    /// Upper bound (exclusive) on the traced queries that are kept as labels.
    pub keep: usize,
    /// Arrival points and Jacobians to keep with each label.
    pub extras: Extras,
}

/// Evaluates the log-stretch queries of one frame.
pub struct QueryRouter<'a> {
    tracer: &'a dyn Trace,
    surrogate: Option<&'a dyn Predict>,
    routing: Routing<'a>,
    share: LabelShare,
    /// Labels, in the order of the queries (fewer than `keep`).
    pub samples: Samples,
    /// Where the labels are, whose hash the label rule takes.
    label_points: Vec<DomainPoint>,
    /// Counts and times of the frame so far.
    pub tally: Tally,
    /// First device error. All later queries are NaN.
    failure: Option<DeviceError>,
    traced: Traced,
    scratch: Scratch,
}

/// Returns true if the label at a point is in the sample of 1 in 2^shift.
pub fn keeps_label(point: DomainPoint, shift: u32) -> bool {
    let [x, y, z] = point.0.map(f32::to_bits);
    shift == 0 || (shift < 32 && philox([x, y, z, 0], [0, 0])[0] >> (32 - shift) == 0)
}

/// Share of the traced queries of a frame that are kept as labels, one in 2^shift.
#[derive(Debug, Clone, Copy)]
pub(super) struct LabelShare {
    /// Upper bound (exclusive) on the labels, at least 2.
    bound: usize,
    pub(super) shift: u32,
    /// Queries traced so far.
    traced: u64,
}

impl LabelShare {
    /// A share of at most one in 2^shift for fewer than `bound` labels.
    pub(super) fn new(bound: usize, shift: u32) -> Self {
        Self { bound: bound.max(2), shift, traced: 0 }
    }

    pub(super) fn keeps(&self, point: DomainPoint) -> bool {
        keeps_label(point, self.shift)
    }

    /// Takes in the number of further traced queries. Returns true if the share shrinks; the caller then drops the labels outside it.
    pub(super) fn expect(&mut self, traced: usize) -> bool {
        self.traced += traced as u64;
        let before = self.shift;
        // Three quarters of the bound: a random excess over the bound would halve the labels.
        while self.traced >> self.shift > (self.bound - self.bound / 4) as u64 {
            self.shift += 1;
        }
        self.shift > before
    }

    /// Halves the share if so many labels reach the bound. If true, the caller drops the labels outside the share and asks again.
    pub(super) fn halve_if_full(&mut self, labels: usize) -> bool {
        let full = labels >= self.bound;
        self.shift += u32::from(full);
        full
    }
}

/// Query counts and times of one frame.
#[derive(Debug, Clone, Copy, Default)]
pub struct Tally {
    /// All queries.
    pub queries: u64,
    /// Queries traced with RK4.
    pub traced: u64,
    /// Queries in missing cells.
    pub missing: u64,
    /// Queries in untrusted cells that the surrogate predicted because the tracing budget was spent.
    pub over_budget: u64,
    /// Nodes of a laid out network that were traced, since it was not trusted there, those in missing cells included. They are no queries.
    pub nodes: u64,
    /// Share of all its nodes in bricks that reach into cells where it was not trusted when the picture started, and are not traced yet. `None` of other
    /// pictures.
    pub untraced_share: Option<f64>,
    /// Seconds of tracing: wall clock on the CPU, device time on a GPU.
    pub trace_seconds: f64,
    /// Seconds of prediction, measured in the same way.
    pub predict_seconds: f64,
}

#[derive(Default)]
struct Scratch {
    to_trace: Vec<u32>,
    to_predict: Vec<u32>,
    points: Vec<DomainPoint>,
    unit: Vec<UnitPoint>,
    values: Vec<f32>,
}

impl<'a> QueryRouter<'a> {
    /// Creates a router. It traces every query if `surrogate` is `None`.
    pub fn new(tracer: &'a dyn Trace, surrogate: Option<&'a dyn Predict>, routing: Routing<'a>) -> Self {
        Self {
            tracer,
            surrogate,
            routing,
            share: LabelShare::new(routing.keep, 0),
            samples: Samples::default(),
            label_points: Vec::new(),
            tally: Tally::default(),
            failure: None,
            traced: Traced::default(),
            scratch: Scratch::default(),
        }
    }

    /// Returns the counts, times and labels of the frame.
    ///
    /// # Errors
    /// The first device error of the frame.
    pub fn finish(self) -> Result<(Tally, Samples), DeviceError> {
        self.failure.map_or(Ok((self.tally, self.samples)), Err)
    }

    /// Traces nodes, which are no queries of the frame. NaN in missing cells.
    ///
    /// # Errors
    /// The device fails.
    pub fn trace_nodes(&mut self, points: &[DomainPoint], log_stretch: &mut [f32]) -> Result<(), DeviceError> {
        let Tally { queries, traced, missing, nodes, .. } = self.tally;
        self.route(points, log_stretch, &mut vec![false; points.len()])?;
        (self.tally.queries, self.tally.traced, self.tally.missing) = (queries, traced, missing);
        self.tally.nodes = nodes + points.len() as u64;
        Ok(())
    }

    fn domain(&self) -> &'a Domain {
        self.tracer.flow().domain()
    }

    fn budget_spent(&self) -> bool {
        self.routing.trace_budget.is_some_and(|budget| self.tally.trace_seconds >= budget)
    }

    /// Keeps the labels among the `count` queries traced last.
    fn keep_samples(&mut self, count: usize) {
        let domain = self.domain();
        let extras = self.routing.extras;
        if self.share.expect(count) {
            self.thin();
        }
        for i in 0..count {
            let point = self.scratch.points[i];
            if self.share.keeps(point) {
                push_sample(&mut self.samples, domain, point, &self.traced, i, extras);
                self.label_points.push(point);
                while self.share.halve_if_full(self.samples.len()) {
                    self.thin();
                }
            }
        }
    }

    /// Drops the labels outside the share.
    fn thin(&mut self) {
        fn retain<T>(values: &mut Vec<T>, kept: &[bool]) {
            let mut kept = kept.iter();
            values.retain(|_| kept.next() == Some(&true));
        }
        let kept: Vec<bool> = self.label_points.iter().map(|&point| self.share.keeps(point)).collect();
        retain(&mut self.label_points, &kept);
        retain(&mut self.samples.points, &kept);
        retain(&mut self.samples.log_stretch, &kept);
        retain(&mut self.samples.arrival, &kept);
        retain(&mut self.samples.jacobian, &kept);
    }
}

/// Appends traced seed `i` to `samples` in unit coordinates.
pub(super) fn push_sample(samples: &mut Samples, domain: &Domain, point: DomainPoint, traced: &Traced, i: usize, extras: Extras) {
    samples.points.push(domain.to_unit(point));
    samples.log_stretch.push(traced.log_stretch[i]);
    if extras.arrival {
        samples.arrival.push(domain.to_unit_unclamped(traced.arrival[i]));
    }
    if extras.jacobian {
        samples.jacobian.push(unit_jacobian(domain, &traced.jacobian[i]));
    }
}

/// A Jacobian in domain coordinates, row-major, in unit coordinates.
pub(super) fn unit_jacobian(domain: &Domain, jacobian: &[f32; 9]) -> [f32; 9] {
    let extent = domain.extent();
    std::array::from_fn(|e| (f64::from(jacobian[e]) * extent[e % 3] / extent[e / 3]) as f32)
}

impl QueryRouter<'_> {
    fn route(&mut self, points: &[DomainPoint], log_stretch: &mut [f32], traced: &mut [bool]) -> Result<(), DeviceError> {
        self.tally.queries += points.len() as u64;
        let domain = self.domain();
        let spent = self.budget_spent();
        let Self { tracer, surrogate, routing, tally, scratch, .. } = self;
        scratch.to_trace.clear();
        scratch.to_predict.clear();
        for (i, &point) in points.iter().enumerate() {
            if tracer.flow().is_missing(point) {
                log_stretch[i] = f32::NAN;
                traced[i] = false;
                tally.missing += 1;
            } else if surrogate.is_none() {
                scratch.to_trace.push(i as u32);
            } else if routing.gate.trusts(domain.to_unit(point)) {
                scratch.to_predict.push(i as u32);
            } else if spent {
                tally.over_budget += 1;
                scratch.to_predict.push(i as u32);
            } else {
                scratch.to_trace.push(i as u32);
            }
        }
        if let Some(surrogate) = surrogate.filter(|_| !scratch.to_predict.is_empty()) {
            let start = Instant::now();
            scratch.unit.clear();
            scratch.unit.extend(scratch.to_predict.iter().map(|&i| domain.to_unit(points[i as usize])));
            scratch.values.resize(scratch.unit.len(), 0.0);
            surrogate.predict(&scratch.unit, &mut scratch.values)?;
            for (&i, &value) in scratch.to_predict.iter().zip(&scratch.values) {
                log_stretch[i as usize] = value;
                traced[i as usize] = false;
            }
            tally.predict_seconds += start.elapsed().as_secs_f64();
        }
        if !scratch.to_trace.is_empty() {
            let start = Instant::now();
            scratch.points.clear();
            scratch.points.extend(scratch.to_trace.iter().map(|&i| points[i as usize]));
            tracer.trace(&scratch.points, routing.extras, &mut self.traced)?;
            for (k, &i) in scratch.to_trace.iter().enumerate() {
                log_stretch[i as usize] = self.traced.log_stretch[k];
                traced[i as usize] = true;
            }
            tally.traced += scratch.to_trace.len() as u64;
            tally.trace_seconds += start.elapsed().as_secs_f64();
            if self.routing.keep > 1 {
                self.keep_samples(self.scratch.to_trace.len());
            }
        }
        Ok(())
    }
}

impl LogStretch for QueryRouter<'_> {
    fn evaluate(&mut self, points: &[DomainPoint], log_stretch: &mut [f32], traced: &mut [bool]) {
        if self.failure.is_none() {
            self.failure = self.route(points, log_stretch, traced).err();
        }
        if self.failure.is_some() {
            log_stretch.fill(f32::NAN);
            traced.fill(false);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use ridgewatch_field::analytic::Analytic;
    use ridgewatch_flow::{FlowMap, Tracer, VelocitySource, cpu_tracer};
    use ridgewatch_render::{RenderSettings, Renderer, Scene, TransferSettings};
    use std::sync::atomic::AtomicBool;

    fn saddle() -> Box<dyn Tracer> {
        let domain = Domain::slab([-1.0; 2], [1.0; 2], (-1.0, 1.0));
        cpu_tracer(VelocitySource::Analytic(Analytic::Saddle { rate: 0.7 }, domain), &FlowMap::tangent(1.0, 4), 0.0).unwrap()
    }

    fn routing(gate: &Gate, keep: usize) -> Routing<'_> {
        Routing { gate, trace_budget: None, keep, extras: Extras { arrival: true, jacobian: true } }
    }

    fn bits(samples: &Samples) -> Vec<[u32; 3]> {
        samples.points.iter().map(|point| point.0.map(f32::to_bits)).collect()
    }

    fn sorted<T: Ord>(mut values: Vec<T>) -> Vec<T> {
        values.sort_unstable();
        values
    }

    #[test]
    fn each_shift_halves_what_is_kept() {
        let point = |i: u32| DomainPoint([i as f32 * 0.001, (i % 97) as f32, 0.5]);
        let kept = |shift| (0..1 << 16).filter(|&i| keeps_label(point(i), shift)).count() as f64;
        for shift in 0..6 {
            let expected = f64::from(1 << 16) / f64::from(1 << shift);
            // Four standard deviations of a binomial count.
            assert!((kept(shift) - expected).abs() <= 4.0 * expected.sqrt(), "{} of {expected} at {shift}", kept(shift));
        }
        assert!((0..1000).all(|i| !keeps_label(point(i), 4) || keeps_label(point(i), 3)), "a larger share holds the smaller");
        assert_eq!(kept(32), 0.0);
    }

    #[test]
    fn labels_are_an_even_share_below_the_bound_in_any_order() {
        const TRACED: usize = 20_000;
        let (tracer, gate) = (saddle(), Gate::uniform(false));
        let mut points: Vec<DomainPoint> = (0..TRACED as u32)
            .map(|i| philox([i, 0, 0, 0], [7, 0]))
            .map(|w| DomainPoint([0, 1, 2].map(|k| 2.0 * ridgewatch_render::rng::unit(w[k]) - 1.0)))
            .collect();
        for keep in [0, 1, 2, 10, 1000, 4096, TRACED, 2 * TRACED] {
            let mut labels = |batch: usize| {
                points.reverse();
                let mut router = QueryRouter::new(&tracer, None, routing(&gate, keep));
                for points in points.chunks(batch) {
                    router.evaluate(points, &mut vec![0.0; points.len()], &mut vec![false; points.len()]);
                    assert!(router.samples.len() < keep.max(1), "{} for {keep}", router.samples.len());
                }
                let (tally, samples) = router.finish().unwrap();
                assert_eq!(tally.traced, TRACED as u64);
                let lengths = [samples.log_stretch.len(), samples.arrival.len(), samples.jacobian.len()];
                assert_eq!(lengths, [samples.len(); 3]);
                samples
            };
            let first = labels(TRACED);
            assert_eq!(sorted(bits(&first)), sorted(bits(&labels(777))), "{keep}");
            // Each arrival belongs to its point: x grows by e^0.7 about the middle, while the path is in the domain.
            for (point, arrival) in first.points.iter().zip(&first.arrival).filter(|(point, _)| (point.0[0] - 0.5).abs() < 0.2) {
                assert!((arrival.0[0] - 0.5 - 0.7_f32.exp() * (point.0[0] - 0.5)).abs() < 1e-3, "{point:?} arrives at {arrival:?}");
            }
            let share = (0..32).map(|shift| TRACED >> shift).find(|&share| share <= keep - keep / 4);
            if let Some(share) = share.filter(|_| keep >= 1000) {
                let most = if share == TRACED { 0.0 } else { 4.0 * (share as f64).sqrt() };
                assert!((first.len() as f64 - share as f64).abs() <= most, "{} of {share} for {keep}", first.len());
                let left = first.points.iter().filter(|point| point.0[0] < 0.5).count() as f64;
                assert!((left - first.len() as f64 / 2.0).abs() <= 2.0 * (first.len() as f64).sqrt() + most, "{left} lie left");
            }
        }
        // Copies of a point have one hash: no share keeps some of them.
        let mut router = QueryRouter::new(&tracer, None, routing(&gate, 100));
        router.evaluate(&[DomainPoint([0.25; 3]); 1000], &mut [0.0; 1000], &mut [false; 1000]);
        assert_eq!(router.samples.len(), 0);
    }

    #[test]
    fn labels_of_a_frame_do_not_depend_on_threads_and_waves() {
        let (tracer, gate) = (saddle(), Gate::uniform(false));
        let labels = |threads: usize, flights: usize| {
            let settings = RenderSettings { width: 40, height: 30, ..RenderSettings::default() };
            let transfer = TransferSettings { low: Some(0.2), high: Some(0.9), extinction: Some(20.0), ..TransferSettings::default() };
            let scene = Scene::assemble(tracer.domain(), None, None, Some(transfer), settings, 1);
            let mut renderer = Renderer::new(scene, tracer.domain(), tracer.tau()).unwrap().with_wave_flights(flights);
            let mut router = QueryRouter::new(&tracer, None, routing(&gate, 1000));
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| renderer.render(0, &mut router, 4, None, &AtomicBool::new(false))).unwrap();
            bits(&router.finish().unwrap().1)
        };
        let one = labels(1, 1 << 17);
        assert!(one.len() > 300 && one.len() < 1000, "{}", one.len());
        assert_eq!(one, labels(4, 1 << 17));
        assert_eq!(sorted(one), sorted(labels(2, 700)));
    }
}
