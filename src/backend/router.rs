//! Routes a frame's log-stretch queries on the CPU, and keeps labels of the traced ones.
//!
//! The rule, on every backend: a query on missing cells has no value. A query in a cell that the gate trusts is answered by the surrogate, any other
//! query by tracing. Once the frame's tracing budget is spent, the surrogate answers everywhere, and these answers are counted. Without a surrogate
//! every query is traced. `kernels/rendering/answer.cu` applies the same rule on a GPU.

use super::DeviceError;
use crate::field::Domain;
use crate::flow::{Extras, Traced};
use crate::render::LogStretch;
use crate::surrogate::{Predict, Samples, Trace};
use crate::trust::Gate;
use std::time::Instant;

/// What decides who answers a frame's queries, and which labels are kept.
#[derive(Clone, Copy)]
pub struct Routing<'a> {
    /// Where the surrogate is trusted.
    pub gate: &'a Gate,
    /// Seconds of tracing after which the surrogate answers everywhere.
    pub trace_budget: Option<f64>,
    /// Fewer than so many traced queries are kept as labels.
    pub keep: usize,
    /// What is kept with each label.
    pub extras: Extras,
}

/// Answers the queries of one frame.
pub struct QueryRouter<'a> {
    tracer: &'a dyn Trace,
    surrogate: Option<&'a dyn Predict>,
    routing: Routing<'a>,
    stride: usize,
    since_kept: usize,
    /// Traced queries, kept evenly over the frame (fewer than `keep`).
    pub samples: Samples,
    /// Counts and times of the frame so far.
    pub tally: Tally,
    /// The first failure of a device. Later queries have no value.
    failure: Option<DeviceError>,
    traced: Traced,
    scratch: Scratch,
}

/// Counts and times of one frame's answers.
#[derive(Debug, Clone, Copy, Default)]
pub struct Tally {
    /// Queries answered.
    pub queries: u64,
    /// Of them by RK4.
    pub traced: u64,
    /// Of them without a value (land).
    pub missing: u64,
    /// Queries of untrusted cells that the surrogate answered because the tracing budget was spent.
    pub over_budget: u64,
    /// Seconds spent tracing: wall clock on the CPU, device time where a GPU answers.
    pub trace_seconds: f64,
    /// Seconds spent predicting, likewise.
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
    /// A router that traces everything if `surrogate` is `None`.
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

    /// Counts, times and labels of the frame.
    ///
    /// # Errors
    /// The device failed during the frame.
    pub fn finish(self) -> Result<(Tally, Samples), DeviceError> {
        self.failure.map_or(Ok((self.tally, self.samples)), Err)
    }

    fn domain(&self) -> &'a Domain {
        self.tracer.flow().domain()
    }

    fn budget_spent(&self) -> bool {
        self.routing.trace_budget.is_some_and(|budget| self.tally.trace_seconds >= budget)
    }

    /// Every stride-th traced query is kept; when there is no more room, every other one is let go and the stride doubles, so that
    /// what is kept is spread evenly over the frame.
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

/// Lets go of every other sample.
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

/// An arrival in unit coordinates; it may lie outside [0, 1].
pub(super) fn unit_arrival(domain: &Domain, arrival: [f32; 3]) -> [f32; 3] {
    let extent = domain.extent();
    std::array::from_fn(|k| ((f64::from(arrival[k]) - domain.min[k]) / extent[k]) as f32)
}

/// Appends traced seed `i` to `samples`, in unit coordinates.
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
