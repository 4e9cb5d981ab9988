//! Routes the log-stretch queries of a frame on the CPU, and keeps a sample of the traced ones as training labels.
//!
//! The rule is the same on every backend; `kernels/rendering/answer.cu` applies it on a GPU:
//! 1. A query in a missing cell has the value NaN.
//! 2. The surrogate predicts in cells that the gate trusts.
//! 3. RK4 traces all other queries. After the tracing budget of the frame is spent, the surrogate predicts them instead, and they are counted.
//! 4. Without a surrogate, every query outside missing cells is traced.

use super::DeviceError;
use crate::field::Domain;
use crate::flow::{Extras, Traced};
use crate::render::LogStretch;
use crate::surrogate::{Predict, Samples, Trace};
use crate::trust::Gate;
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
    stride: usize,
    since_kept: usize,
    /// Labels: traced queries, spread evenly over the frame (fewer than `keep`).
    pub samples: Samples,
    /// Counts and times of the frame so far.
    pub tally: Tally,
    /// First device error. All later queries are NaN.
    failure: Option<DeviceError>,
    traced: Traced,
    scratch: Scratch,
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
    /// Seconds of tracing: wall clock on the CPU, device time on a GPU.
    pub trace_seconds: f64,
    /// Seconds of prediction, measured in the same way.
    pub predict_seconds: f64,
}

#[derive(Default)]
struct Scratch {
    to_trace: Vec<u32>,
    to_predict: Vec<u32>,
    points: Vec<[f32; 3]>,
    unit: Vec<[f32; 3]>,
    values: Vec<f32>,
}

impl<'a> QueryRouter<'a> {
    /// Creates a router. It traces every query if `surrogate` is `None`.
    pub fn new(tracer: &'a dyn Trace, surrogate: Option<&'a dyn Predict>, routing: Routing<'a>) -> Self {
        Self {
            tracer,
            surrogate,
            routing,
            stride: 1,
            since_kept: 0,
            samples: Samples::default(),
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

    fn domain(&self) -> &'a Domain {
        self.tracer.flow().domain()
    }

    fn budget_spent(&self) -> bool {
        self.routing.trace_budget.is_some_and(|budget| self.tally.trace_seconds >= budget)
    }

    /// Keeps every stride-th traced query. At the limit, every other label is dropped and the stride doubles, so that the labels stay spread
    /// evenly over the frame.
    fn keep_samples(&mut self, count: usize) {
        let domain = self.domain();
        let extras = self.routing.extras;
        for i in 0..count {
            self.since_kept += 1;
            if self.since_kept < self.stride {
                continue;
            }
            self.since_kept = 0;
            push_sample(&mut self.samples, domain, self.scratch.points[i], &self.traced, i, extras);
            if self.samples.len() >= self.routing.keep {
                halve(&mut self.samples);
                self.stride *= 2;
            }
        }
    }
}

/// Drops every other sample.
fn halve(samples: &mut Samples) {
    fn every_other<T>(values: &mut Vec<T>) {
        let mut keep = false;
        values.retain(|_| {
            keep = !keep;
            keep
        });
    }
    every_other(&mut samples.points);
    every_other(&mut samples.log_stretch);
    every_other(&mut samples.arrival);
    every_other(&mut samples.jacobian);
}

/// Converts an arrival point to unit coordinates, which may lie outside [0, 1].
pub(super) fn unit_arrival(domain: &Domain, arrival: [f32; 3]) -> [f32; 3] {
    let extent = domain.extent();
    std::array::from_fn(|k| ((f64::from(arrival[k]) - domain.min[k]) / extent[k]) as f32)
}

/// Appends traced seed `i` to `samples` in unit coordinates. The Jacobian is scaled to unit coordinates on both sides.
pub(super) fn push_sample(samples: &mut Samples, domain: &Domain, point: [f32; 3], traced: &Traced, i: usize, extras: Extras) {
    samples.points.push(domain.to_unit(point));
    samples.log_stretch.push(traced.log_stretch[i]);
    if extras.arrival {
        samples.arrival.push(unit_arrival(domain, traced.arrival[i]));
    }
    if extras.jacobian {
        let (j, extent) = (traced.jacobian[i], domain.extent());
        samples.jacobian.push(std::array::from_fn(|e| (f64::from(j[e]) * extent[e % 3] / extent[e / 3]) as f32));
    }
}

impl QueryRouter<'_> {
    fn route(&mut self, points: &[[f32; 3]], log_stretch: &mut [f32], traced: &mut [bool]) -> Result<(), DeviceError> {
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
    fn evaluate(&mut self, points: &[[f32; 3]], log_stretch: &mut [f32], traced: &mut [bool]) {
        if self.failure.is_none() {
            self.failure = self.route(points, log_stretch, traced).err();
        }
        if self.failure.is_some() {
            log_stretch.fill(f32::NAN);
            traced.fill(false);
        }
    }
}
