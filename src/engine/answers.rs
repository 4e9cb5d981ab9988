//! Answers the renderer's queries: the surrogate where the gate trusts it, RK4 elsewhere.

use crate::field::Domain;
use crate::flow::{Extras, Traced, Tracer};
use crate::render::LogStretch;
use crate::surrogate::{Predict, Samples};
use crate::trust::Gate;
use std::time::Instant;

/// Whom to ask, and what was found out on the way.
pub struct Answers<'a> {
    tracer: &'a dyn Tracer,
    surrogate: Option<&'a dyn Predict>,
    gate: &'a Gate,
    /// Time after which even untrusted cells are answered by the surrogate.
    trace_budget: Option<f64>,
    keep: usize,
    stride: usize,
    since_kept: usize,
    extras: Extras,
    /// Traced queries, kept evenly over the frame (fewer than `keep`), with the log-stretch that was traced.
    pub samples: Samples,
    /// Figures of the frame so far.
    pub tally: Tally,
    traced: Traced,
    scratch: Scratch,
}

/// Whom [`Answers`] asks, beside the tracer.
#[derive(Clone, Copy)]
pub struct Asked<'a> {
    /// Where the gate trusts it; none: the tracer is asked everywhere.
    pub surrogate: Option<&'a dyn Predict>,
    /// Where the surrogate is trusted.
    pub gate: &'a Gate,
    /// Seconds of tracing after which the surrogate is asked everywhere.
    pub trace_budget: Option<f64>,
    /// Traced samples to keep: fewer than so many.
    pub keep: usize,
    /// What is kept with each of them.
    pub extras: Extras,
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

impl<'a> Answers<'a> {
    /// Answers by RK4 alone where `surrogate` is none. At most `keep` traced samples are kept for training.
    pub fn new(tracer: &'a dyn Tracer, surrogate: Option<&'a dyn Predict>, gate: &'a Gate, trace_budget: Option<f64>, keep: usize) -> Self {
        Self {
            tracer,
            surrogate,
            gate,
            trace_budget,
            keep,
            stride: 1,
            since_kept: 0,
            extras: Extras::default(),
            samples: Samples::default(),
            tally: Tally::default(),
            traced: Traced::default(),
            scratch: Scratch::default(),
        }
    }

    /// Keeps these with each sample, for surrogates that learn the flow map.
    pub fn with_extras(mut self, extras: Extras) -> Self {
        self.extras = extras;
        self
    }

    /// Whom to ask, for an engine that asks them itself.
    pub fn asked(&self) -> Asked<'a> {
        Asked { surrogate: self.surrogate, gate: self.gate, trace_budget: self.trace_budget, keep: self.keep, extras: self.extras }
    }

    /// Takes in the figures and samples of a frame whose queries were answered without this.
    pub fn answered_elsewhere(&mut self, tally: Tally, samples: Samples) {
        self.tally = tally;
        self.samples = samples;
    }

    fn domain(&self) -> &'a Domain {
        self.tracer.domain()
    }

    fn budget_spent(&self) -> bool {
        self.trace_budget.is_some_and(|budget| self.tally.trace_seconds >= budget)
    }

    /// Every stride-th traced query is kept; when there is no more room, every other one is let go and the stride doubles, so that
    /// what is kept is spread evenly over the frame.
    fn keep_samples(&mut self, count: usize) {
        let domain = self.domain();
        let extras = self.extras;
        for i in 0..count {
            self.since_kept += 1;
            if self.since_kept < self.stride {
                continue;
            }
            self.since_kept = 0;
            push_sample(&mut self.samples, domain, self.scratch.points[i], &self.traced, i, extras);
            if self.samples.len() >= self.keep {
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

impl LogStretch for Answers<'_> {
    fn evaluate(&mut self, points: &[[f32; 3]], log_stretch: &mut [f32], traced: &mut [bool]) {
        self.tally.queries += points.len() as u64;
        let domain = self.domain();
        let mut scratch = std::mem::take(&mut self.scratch);
        scratch.to_trace.clear();
        scratch.to_predict.clear();
        let spent = self.budget_spent();
        for (i, &point) in points.iter().enumerate() {
            if self.tracer.is_missing(point) {
                log_stretch[i] = f32::NAN;
                traced[i] = false;
                self.tally.missing += 1;
            } else if self.surrogate.is_none() {
                scratch.to_trace.push(i as u32);
            } else if self.gate.trusts(domain.to_unit(point)) {
                scratch.to_predict.push(i as u32);
            } else if spent {
                self.tally.over_budget += 1;
                scratch.to_predict.push(i as u32);
            } else {
                scratch.to_trace.push(i as u32);
            }
        }
        if let Some(surrogate) = self.surrogate.filter(|_| !scratch.to_predict.is_empty()) {
            let start = Instant::now();
            scratch.unit.clear();
            scratch.unit.extend(scratch.to_predict.iter().map(|&i| domain.to_unit(points[i as usize])));
            scratch.values.resize(scratch.unit.len(), 0.0);
            surrogate.predict(&scratch.unit, &mut scratch.values);
            for (&i, &value) in scratch.to_predict.iter().zip(&scratch.values) {
                log_stretch[i as usize] = value;
                traced[i as usize] = false;
            }
            self.tally.predict_seconds += start.elapsed().as_secs_f64();
        }
        if !scratch.to_trace.is_empty() {
            let start = Instant::now();
            scratch.points.clear();
            scratch.points.extend(scratch.to_trace.iter().map(|&i| points[i as usize]));
            self.tracer.trace(&scratch.points, self.extras, &mut self.traced);
            for (k, &i) in scratch.to_trace.iter().enumerate() {
                log_stretch[i as usize] = self.traced.log_stretch[k];
                traced[i as usize] = true;
            }
            self.tally.traced += scratch.to_trace.len() as u64;
            self.tally.trace_seconds += start.elapsed().as_secs_f64();
        }
        let any_traced = !scratch.to_trace.is_empty();
        self.scratch = scratch;
        if any_traced && self.keep > 1 {
            self.keep_samples(self.scratch.to_trace.len());
        }
    }
}
