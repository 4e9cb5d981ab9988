//! Decides how a network is trained: which samples, at which rate, for how long, which weights predict, and what happens when the loss
//! diverges.
//!
//! The horizon is unknown (a frame gives what time it has left), so no schedule can count down to it. Instead the rate stays high, weights for
//! prediction are a running mean over the last share of the steps, which does the work of a decaying rate at every moment, and the rate falls
//! only when the loss has stopped falling.

use super::checkpoint::{Checkpoint, Entry};
use super::network::{Architecture, Average, Encoding, Field, Fused, Model, NetworkSettings, Objective, Pick, Predictor, Step};
use super::table::fresh_stamp;
use super::{CheckpointError, Learned, NetworkState, Predict, Samples, SurrogateError};
use crate::field::Domain;
use std::time::Instant;

/// Steps between two moves of the average: it changes slowly, and every move reads and writes all parameters.
const AVERAGE_EVERY: u64 = 8;
/// Steps between two copies of the last good weights.
const KEEP_EVERY: u64 = 512;
/// A loss above this many times the first one (or the first one of this call, where the window has just slid) counts as diverged.
const DIVERGED: f64 = 10.0;
/// A window that has slid makes old weights wrong, but not more so than this many times the first loss.
const HARDEST: f64 = 10.0;
/// A loss below this is never a divergence: where there is nothing to learn (solid rotation) the first loss may be 0.
const NEGLIGIBLE: f64 = 1e-3;
/// Factor on the rate below which more rollbacks make no sense in one call.
const LEAST_CAUTION: f64 = 1e-6;
/// Steps between two looks at whether the loss still falls.
const LOOK_EVERY: u64 = 512;
/// Fall of the smoothed loss between two looks, below which it counts as stalled.
const STALLED: f64 = 0.02;
/// Factor on the rate when stalled, and the least it may come to.
const STALL_FACTOR: f64 = 0.7;
/// See [`STALL_FACTOR`].
const LEAST_FACTOR: f64 = 0.1;

/// How far training has come; everything besides weights and moments that the next step depends on.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Progress {
    /// Samples drawn: the generator's counter.
    drawn: u64,
    /// Steps since the start or the last slide, which the average is a share of.
    averaged: u64,
    /// Factor on the rate for stalled losses.
    stall: f64,
    /// Factor on the rate for divergences; never rises again.
    caution: f64,
    /// Loss of the very first step; 0 before it.
    first_loss: f64,
    /// Smoothed loss, and its value at the last look; 0 before the first.
    smooth: f64,
    looked: f64,
}

/// Weights and moments to come back to.
struct Kept {
    state: [[Vec<f32>; 3]; 2],
    steps: usize,
    average: Average,
    progress: Progress,
}

/// A network, its optimizer and its schedule.
pub(super) struct Trainer {
    model: Model,
    objective: Objective,
    average: Average,
    predictor: Predictor,
    progress: Progress,
    settings: NetworkSettings,
    rate: f64,
    seed: u64,
    standardised: bool,
    fused: Option<Fused>,
    kept: Option<Kept>,
}

/// A network as it was.
pub(super) struct FrozenNetwork {
    shape: Architecture,
    objective: Objective,
    tables: Vec<f32>,
    layers: Vec<f32>,
    predictor: Predictor,
    stamp: u64,
}

impl Predict for FrozenNetwork {
    fn name(&self) -> &'static str {
        "network"
    }

    fn predict(&self, points: &[[f32; 3]], out: &mut [f32]) {
        self.predictor.log_stretch(&self.shape, &self.objective, &self.tables, points, out);
    }

    fn bytes(&self) -> usize {
        self.shape.parameters() * size_of::<f32>()
    }

    fn network(&self) -> Option<NetworkState<'_>> {
        let Self { shape, objective, tables, layers, stamp, .. } = self;
        Some(NetworkState { stamp: *stamp, shape, objective, tables, layers, base: None })
    }
}

impl Trainer {
    pub(super) fn new(settings: &NetworkSettings, domain: &Domain, tau: f64, seed: u64, centred: bool) -> Result<Self, SurrogateError> {
        let axes: Vec<usize> = (0..domain.dimensions.clamp(1, 3)).collect();
        let shape = Architecture::new(settings, &axes, domain.extent())?;
        let objective = Objective::new(settings, &shape, domain.extent(), tau);
        let model = Model::new(shape, seed, centred);
        let average = Average { tables: model.tables(), layers: model.layers() };
        let predictor = Predictor::new(&model.shape, &average.layers);
        // The published rate of 1e-4 is meant for a day of training; within minutes ten times as much reaches further.
        let default = match settings.encoding {
            Encoding::HashGrid => 1e-2,
            Encoding::Frequency => 1e-3,
        };
        let progress = Progress { drawn: 0, averaged: 0, stall: 1.0, caution: 1.0, first_loss: 0.0, smooth: 0.0, looked: 0.0 };
        let rate = f64::from(settings.learning_rate.unwrap_or(default));
        Ok(Self {
            model,
            objective,
            average,
            predictor,
            progress,
            settings: settings.clone(),
            rate,
            seed,
            standardised: false,
            fused: None,
            kept: None,
        })
    }

    /// Writes the log-stretch (or the residual's part of it) at each point.
    pub(super) fn predict(&self, points: &[[f32; 3]], out: &mut [f32]) {
        self.predictor.log_stretch(&self.model.shape, &self.objective, &self.average.tables, points, out);
    }

    /// What predicts now, for good.
    pub(super) fn frozen(&self) -> FrozenNetwork {
        FrozenNetwork {
            shape: self.model.shape.clone(),
            objective: self.objective.clone(),
            tables: self.average.tables.clone(),
            layers: self.average.layers.clone(),
            predictor: Predictor::new(&self.model.shape, &self.average.layers),
            stamp: fresh_stamp(),
        }
    }

    /// Parameters that prediction reads, in bytes.
    pub(super) fn bytes(&self) -> usize {
        self.model.shape.parameters() * size_of::<f32>()
    }

    /// The window slid: weights carry over, but the average forgets what it has seen, and the rate is the first one again.
    pub(super) fn window_slid(&mut self) {
        self.kept = None;
        self.progress.averaged = 0;
        self.progress.stall = 1.0;
        self.progress.smooth = 0.0;
        self.progress.looked = 0.0;
    }

    /// Sets the output layer back to 0, in the weights, the moments and the average: what the hidden layers have learned stays.
    pub(super) fn forget_output(&mut self) {
        self.kept = None;
        self.model.zero_output();
        let head = &self.model.shape.layers[self.model.shape.layers.len() - 1];
        self.average.layers[head.weights..head.biases + head.outputs].fill(0.0);
        self.predictor = Predictor::new(&self.model.shape, &self.average.layers);
    }

    /// Trains on the samples, or on what they have beyond `base`.
    pub(super) fn learn(&mut self, samples: &Samples, base: Option<&dyn Field>, seconds: f64, max_steps: u64) -> Learned {
        let start = Instant::now();
        let mut learned = Learned::default();
        let sieved = self.objective.sieve(samples);
        let among = sieved.as_deref();
        let usable = among.map_or(samples.len(), <[u32]>::len);
        learned.dropped = (samples.len() - usable) as u64;
        if usable == 0 {
            learned.seconds = start.elapsed().as_secs_f64();
            return learned;
        }
        if !self.standardised {
            self.objective.standardise(&self.model.shape, samples, base);
            self.standardised = true;
        }
        // Few samples need no large batch; they would only be drawn many times over.
        let count = self.settings.batch.min(usable.max(256));
        let mut fused = self.fused.take().unwrap_or_else(|| Fused::new(&self.model, &self.objective, self.settings.batch));
        let (mut losses, mut counted, mut first_of_call) = (0.0, 0_u64, None::<f64>);
        let began = self.model.steps() as u64;
        while learned.steps < max_steps && start.elapsed().as_secs_f64() < seconds {
            let steps = self.model.steps() as u64;
            // The first step of a call is the likeliest to meet something new; but a call of a few steps must not cost a copy.
            let apart = if learned.steps == 0 { KEEP_EVERY / 8 } else { KEEP_EVERY };
            if self.kept.as_ref().is_none_or(|kept| steps >= kept.steps as u64 + apart) {
                self.keep();
            }
            let most = (KEEP_EVERY - steps % KEEP_EVERY).min(max_steps - learned.steps);
            let (mut taken, mut sum, mut diverged) = (0, 0.0, false);
            let Self { model, objective, average, progress, settings, rate, seed, .. } = self;
            fused.steps(model, objective, average, |done, loss| {
                if let Some(loss) = loss {
                    taken = done;
                    let first = *first_of_call.get_or_insert(loss);
                    if progress.first_loss == 0.0 && loss.is_finite() {
                        progress.first_loss = loss;
                    }
                    let hardest = first.min(HARDEST * progress.first_loss);
                    let limit = DIVERGED * progress.first_loss.max(hardest).max(NEGLIGIBLE);
                    diverged = !loss.is_finite() || loss > limit;
                    if diverged {
                        return None;
                    }
                    sum += loss;
                    progress.observe(loss);
                }
                if done == most || start.elapsed().as_secs_f64() >= seconds {
                    return None;
                }
                let counter = progress.drawn;
                progress.drawn += count as u64;
                progress.averaged += 1;
                let share = if settings.averaging > 0.0 && progress.averaged.is_multiple_of(AVERAGE_EVERY) {
                    (AVERAGE_EVERY as f32 / (settings.averaging * progress.averaged as f32)).min(1.0)
                } else {
                    0.0
                };
                let pick = Pick::Random { seed: *seed, counter, among, hold_out: base.is_some() };
                let rate = *rate * progress.stall * progress.caution;
                Some(Step { samples, pick, count, rate, average_share: share, lazy: true, base })
            });
            if diverged {
                learned.rollbacks += 1;
                // The moments are part of what diverged; so the steps since the last copy are lost.
                let reached = steps + taken;
                self.roll_back();
                let kept = self.model.steps() as u64;
                learned.lost_steps += reached.saturating_sub(kept);
                learned.steps = kept.saturating_sub(began);
                (losses, counted) = (losses + sum, counted + taken);
                if self.progress.caution < LEAST_CAUTION {
                    break;
                }
                continue;
            }
            learned.steps += taken;
            (losses, counted) = (losses + sum, counted + taken);
        }
        self.fused = Some(fused);
        if self.settings.averaging == 0.0 || self.progress.averaged < AVERAGE_EVERY {
            self.average = Average { tables: self.model.tables(), layers: self.model.layers() };
        }
        self.predictor = Predictor::new(&self.model.shape, &self.average.layers);
        learned.samples = counted * count as u64;
        learned.loss = (counted > 0).then(|| losses / counted as f64);
        learned.seconds = start.elapsed().as_secs_f64();
        learned
    }

    /// Copies the present weights as what to come back to.
    fn keep(&mut self) {
        let (steps, average, progress) = (self.model.steps(), &self.average, self.progress);
        match &mut self.kept {
            Some(kept) => {
                self.model.copy_state(&mut kept.state);
                kept.average.tables.copy_from_slice(&average.tables);
                kept.average.layers.copy_from_slice(&average.layers);
                (kept.steps, kept.progress) = (steps, progress);
            }
            None => self.kept = Some(Kept { state: self.model.state(), steps, average: average.clone(), progress }),
        }
    }

    /// Back to the last good weights, at half the rate. The generator moves on, so that the same batches are not drawn again.
    fn roll_back(&mut self) {
        let (drawn, caution) = (self.progress.drawn, self.progress.caution * 0.5);
        if let Some(kept) = &self.kept {
            self.model.set_state(kept.state.clone(), kept.steps);
            self.average = kept.average.clone();
            self.progress = Progress { drawn, caution, ..kept.progress };
        }
    }

    pub(super) fn entries<'a>(&'a self, checkpoint: &mut Checkpoint<'a>) {
        checkpoint.note("network.shape", self.shape_text());
        let Progress { drawn, averaged, stall, caution, first_loss, smooth, looked } = self.progress;
        let scale = &self.objective.scale;
        let numbers = [("stall", stall), ("caution", caution), ("first_loss", first_loss), ("smooth", smooth), ("looked", looked)];
        for (key, value) in numbers {
            checkpoint.note(&format!("network.{key}"), value.to_string());
        }
        checkpoint.note("network.learning_rate", (self.rate * stall * caution).to_string());
        checkpoint.note("network.steps", self.model.steps().to_string());
        checkpoint.note("network.drawn", drawn.to_string());
        checkpoint.note("network.averaged", averaged.to_string());
        checkpoint.note("network.standardised", self.standardised.to_string());
        for output in 0..3 {
            checkpoint.note(&format!("network.mean.{output}"), scale.mean[output].to_string());
            checkpoint.note(&format!("network.deviation.{output}"), scale.deviation[output].to_string());
        }
        let (entries, features) = (self.model.shape.table_entries(), self.model.shape.features);
        let [tables, layers] = self.model.state();
        let shapes = [vec![entries, features], vec![self.model.shape.layer_parameters()]];
        for (name, shape, values) in [("tables", &shapes[0], tables), ("layers", &shapes[1], layers)] {
            if values[0].is_empty() {
                continue;
            }
            for (part, values) in ["", ".moment_1", ".moment_2"].into_iter().zip(values) {
                checkpoint.push(Entry::new(&format!("network.{name}{part}"), shape, values));
            }
        }
        if !self.average.tables.is_empty() {
            checkpoint.push(Entry::new("network.tables.average", &shapes[0], &self.average.tables));
        }
        checkpoint.push(Entry::new("network.layers.average", &shapes[1], &self.average.layers));
    }

    /// What must agree for a checkpoint to fit.
    fn shape_text(&self) -> String {
        let shape = serde_json::to_string(&self.model.shape).unwrap_or_default();
        format!("{shape} loss {:?} tau {} extent {:?}", self.objective.loss, self.objective.tau, self.objective.extent)
    }

    /// Reads everything, and only then changes anything.
    pub(super) fn restored(&mut self, checkpoint: &Checkpoint<'_>) -> Result<(), CheckpointError> {
        checkpoint.expect_note("network.shape", &self.shape_text())?;
        let progress = Progress {
            drawn: checkpoint.number("network.drawn")?,
            averaged: checkpoint.number("network.averaged")?,
            stall: checkpoint.number("network.stall")?,
            caution: checkpoint.number("network.caution")?,
            first_loss: checkpoint.number("network.first_loss")?,
            smooth: checkpoint.number("network.smooth")?,
            looked: checkpoint.number("network.looked")?,
        };
        let standardised = checkpoint.number("network.standardised")?;
        let steps = checkpoint.number("network.steps")?;
        let mut scale = self.objective.scale;
        for output in 0..3 {
            scale.mean[output] = checkpoint.number(&format!("network.mean.{output}"))?;
            scale.deviation[output] = checkpoint.number(&format!("network.deviation.{output}"))?;
        }
        let shape = &self.model.shape;
        let read = |name: &str, len: usize| -> Result<[Vec<f32>; 3], CheckpointError> {
            if len == 0 {
                return Ok(Default::default());
            }
            let part = |part: &str| checkpoint.values(&format!("network.{name}{part}"), len);
            Ok([part("")?, part(".moment_1")?, part(".moment_2")?])
        };
        let (table_values, layer_values) = (shape.table_entries() * shape.features, shape.layer_parameters());
        let state = [read("tables", table_values)?, read("layers", layer_values)?];
        let tables = if table_values == 0 { Vec::new() } else { checkpoint.values("network.tables.average", table_values)? };
        let layers = checkpoint.values("network.layers.average", layer_values)?;
        self.model.set_state(state, steps);
        self.objective.scale = scale;
        (self.progress, self.standardised, self.kept) = (progress, standardised, None);
        self.predictor = Predictor::new(&self.model.shape, &layers);
        self.average = Average { tables, layers };
        Ok(())
    }
}

impl Progress {
    /// Takes a step's loss in, and lowers the rate when the loss has stopped falling.
    fn observe(&mut self, loss: f64) {
        self.smooth = if self.smooth == 0.0 { loss } else { 0.99 * self.smooth + 0.01 * loss };
        if self.averaged.is_multiple_of(LOOK_EVERY) {
            if self.looked > 0.0 && self.smooth > (1.0 - STALLED) * self.looked {
                self.stall = (self.stall * STALL_FACTOR).max(LEAST_FACTOR);
            }
            self.looked = self.smooth;
        }
    }
}
