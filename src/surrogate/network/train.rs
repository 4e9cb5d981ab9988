//! Training by the fused kernels: forward, backward and Adam in burn's own buffers.

use super::adam::{Adam, move_average};
use super::architecture::Architecture;
use super::batch::{Batch, predict};
use super::encode::Corners;
use super::memory::{Aligned, LINE, TILE_ROWS, prefetch};
use super::model::{Model, ModelBuffers};
use super::objective::{Field, Objective, signed_exp};
use super::random::draw;
use super::tile::{Parameters, Tile, Weights};
use crate::Samples;
use rayon::prelude::*;
use ridgewatch_field::UnitPoint;

/// Held-out samples are one in this many, if a step holds samples out.
pub const HELD_OUT: usize = 64;

/// Running mean of the parameters (Polyak and Juditsky 1992). Prediction uses it, since it takes the noise of a high learning rate out of
/// the weights.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Average {
    /// Tables.
    pub tables: Vec<f32>,
    /// Layers.
    pub layers: Vec<f32>,
}

/// Description of one optimizer step, independent of the device.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PlannedStep {
    /// Samples of the batch.
    pub count: usize,
    /// Seed, and number of samples drawn before, of samples drawn with repetition; `None`: the first samples, in order.
    pub drawn: Option<(u64, u64)>,
    /// Leaves samples whose number is a multiple of [`HELD_OUT`] for validation.
    pub hold_out: bool,
    /// Learning rate of Adam.
    pub rate: f64,
    /// Share by which the mean of the parameters moves towards them; 0 leaves it.
    pub average_share: f32,
    /// Leaves cache lines (16 values) of the tables without a gradient as they are. Otherwise every entry takes part in every step, as with
    /// burn's Adam.
    pub lazy: bool,
}

/// A planned step on samples of the host.
#[derive(Clone, Copy)]
pub struct Step<'a> {
    /// The step; its count is at most the size in [`Fused::new`].
    pub planned: PlannedStep,
    /// Samples to draw from.
    pub samples: &'a Samples,
    /// Numbers of the samples that may be drawn; `None`: all.
    pub among: Option<&'a [u32]>,
    /// Field that is subtracted from the log-stretch of the samples.
    pub base: Option<&'a dyn Field>,
}

impl<'a> Step<'a> {
    /// The planned step on `samples`, of which those numbered `among` may be drawn (`None`: all), relative to `base`.
    pub fn of(planned: &PlannedStep, samples: &'a Samples, among: Option<&'a [u32]>, base: Option<&'a dyn Field>) -> Self {
        Self { planned: *planned, samples, among, base }
    }

    /// The number of the sample at `position` of the batch.
    fn sample(&self, position: usize) -> usize {
        let Some((seed, counter)) = self.planned.drawn else { return position };
        let count = self.among.map_or(self.samples.len(), <[u32]>::len);
        let drawn = draw(seed, counter + position as u64, count);
        let at = |drawn: usize| self.among.map_or(drawn, |among| among[drawn] as usize);
        match at(drawn) {
            // The next sample replaces a held-out one. After the last sample, or in a list with gaps, it may be held out too: one draw of
            // very many.
            index if self.planned.hold_out && index % HELD_OUT == 0 => at((drawn + 1) % count),
            index => index,
        }
    }
}

/// Memory of the fused kernels for training.
pub struct Fused {
    batch: Batch,
    weights: Weights,
    table_gradient: Aligned,
    /// A mark for each cache line of each level's gradient.
    touched: Vec<Vec<u8>>,
    layer_gradient: Vec<f32>,
    /// Numbers of the samples of the present batch.
    drawn: Vec<usize>,
    size: usize,
}

impl Fused {
    /// Memory for batches of at most `size` samples.
    pub fn new(model: &Model, objective: &Objective, size: usize) -> Self {
        let shape = &model.shape;
        Self {
            batch: Batch::new(shape, size, objective.derivatives()),
            weights: Weights::new(shape, &model.layers(), true),
            table_gradient: Aligned::zeros(shape.table_entries() * shape.features),
            touched: shape.levels.iter().map(|level| vec![0; (level.entries * shape.features).div_ceil(LINE)]).collect(),
            layer_gradient: vec![0.0; shape.layer_parameters()],
            drawn: Vec::with_capacity(size),
            size,
        }
    }

    /// Takes steps until `next` returns `None`; it gets the number of steps taken and the loss before the last one. Between the first and
    /// the last step the buffers belong to the kernels; nothing is copied.
    pub fn steps<'a>(
        &mut self,
        model: &mut Model,
        objective: &Objective,
        average: &mut Average,
        mut next: impl FnMut(u64, Option<f64>) -> Option<Step<'a>>,
    ) {
        let mut buffers = model.lend();
        let (shape, epsilon) = (&model.shape, model.epsilon);
        let (mut done, mut loss) = (0, None);
        while let Some(step) = next(done, loss) {
            loss = Some(self.gradient(shape, objective, &buffers, &step));
            self.update(shape, epsilon, &mut buffers, average, &step.planned);
            done += 1;
        }
        buffers.give_back(model);
    }

    /// Loss and gradients of one batch at the present parameters.
    fn gradient(&mut self, shape: &Architecture, objective: &Objective, buffers: &ModelBuffers, step: &Step<'_>) -> f64 {
        let (samples, count) = (step.samples, step.planned.count);
        assert!(count <= self.size, "a batch of {count} in memory for {}", self.size);
        self.weights.fill(shape, buffers.layers.parameters());
        let tables = buffers.tables.as_ref().map_or(&[][..], |tables| tables.parameters());
        let network = Parameters { shape, weights: &self.weights, tables };
        self.drawn.clear();
        self.drawn.extend((0..count).map(|position| step.sample(position)));
        let drawn = &self.drawn[..];
        let (penalty, slope) = mean_penalty(network, objective, samples, drawn);
        let groups = if objective.derivatives() { 1 + shape.dimensions() } else { 1 };
        let loss = |first: usize, tile: &mut Tile| {
            let drawn = &drawn[first..first + tile.count];
            let mut sum = 0.0;
            let mut below = [0.0; TILE_ROWS];
            if let Some(base) = step.base {
                let mut points = [UnitPoint::default(); TILE_ROWS];
                for (point, &index) in points.iter_mut().zip(drawn) {
                    *point = samples.points[index];
                }
                base.values(&points[..tile.count], &mut below[..tile.count]);
            }
            for group in 0..groups {
                let weight = objective.weight(shape, group, count);
                for (sample, &index) in drawn.iter().enumerate() {
                    let mut targets = objective.targets(shape, samples, index, group);
                    targets[0] -= below[sample] / objective.scale.deviation[0];
                    let row = group * tile.capacity + sample;
                    let (outputs, gradient) = (&tile.outputs[row], &mut tile.d_outputs[row]);
                    for output in 0..shape.outputs() {
                        let difference = outputs[output] - targets[output];
                        sum += f64::from(weight * difference * difference);
                        gradient[output] = 2.0 * weight * difference;
                        if slope != 0.0 {
                            gradient[output] += slope * outputs[output].abs().exp();
                        }
                    }
                }
            }
            sum
        };
        // Drawn samples lie anywhere in a buffer far larger than the caches: without a prefetch, each is a cache miss.
        let prefetch_sample = |position: usize| {
            let index = drawn[position];
            prefetch(&samples.points, index);
            prefetch(&samples.times, index);
            prefetch(&samples.log_stretch, index);
            prefetch(&samples.arrival, index);
            prefetch(&samples.jacobian, index);
        };
        penalty + self.batch.accumulate(network, count, prefetch_sample, |position| samples.row(drawn[position]), loss)
    }

    /// Adds the gradient to the tables, level by level (each level belongs to one task, so nothing is shared), and applies Adam.
    fn update(&mut self, shape: &Architecture, epsilon: f32, buffers: &mut ModelBuffers, average: &mut Average, step: &PlannedStep) {
        let &PlannedStep { rate, average_share: share, lazy, .. } = step;
        let Self { batch, table_gradient, touched, layer_gradient, .. } = self;
        let Average { tables: average_tables, layers: average_layers } = average;
        let ModelBuffers { tables, layers } = buffers;
        let update_layers = || {
            batch.layer_gradient(shape, layer_gradient);
            layers.time += 1;
            let adam = Adam::at(layers.time, rate, epsilon);
            let [parameters, first, second] = layers.slices();
            adam.step(parameters, layer_gradient, first, second);
            if share > 0.0 {
                move_average(average_layers, parameters, share);
            }
        };
        let update_tables = || {
            let Some(tables) = tables else { return };
            tables.time += 1;
            let adam = Adam::at(tables.time, rate, epsilon);
            let [parameters, first, second] = tables.slices();
            let mut rest = [parameters, first, second, &mut table_gradient[..], &mut average_tables[..]];
            let split = |(number, touched): (usize, _)| {
                let len = shape.levels[number].entries * shape.features;
                let parts = rest.each_mut().map(|rest| rest.split_off_mut(..len).expect("every buffer holds all levels"));
                (number, touched, parts)
            };
            let mut work: Vec<_> = touched.iter_mut().enumerate().map(split).collect();
            // The largest levels come first, so that the small ones fill the gaps at the end.
            work.reverse();
            work.into_par_iter().with_max_len(1).for_each_init(
                || Corners::new(shape),
                |corners, (number, touched, [parameters, first, second, gradient, average])| {
                    batch.table_gradient(shape, number, corners, gradient, touched);
                    if lazy {
                        adam.lazy_step(parameters, gradient, first, second, touched);
                    } else {
                        adam.step(parameters, gradient, first, second);
                        touched.fill(0);
                    }
                    if share > 0.0 {
                        move_average(average, parameters, share);
                    }
                },
            );
        };
        rayon::join(update_tables, update_layers);
    }
}

/// The penalty on the difference of the batch means in linear scale (Xi, Luan and Tao 2023, see [`super::Loss::Published`]), and the factor
/// of exp|output| in its gradient. It needs the mean over the whole batch before any gradient, hence a separate forward pass.
fn mean_penalty(network: Parameters<'_>, objective: &Objective, samples: &Samples, drawn: &[usize]) -> (f64, f32) {
    let penalty = f64::from(objective.penalty());
    if penalty == 0.0 {
        return (0.0, 0.0);
    }
    let mut outputs = vec![0.0; drawn.len()];
    predict(
        network,
        |position| samples.row(drawn[position]),
        false,
        &mut outputs,
        1,
        |tile, out| {
            for (out, outputs) in out.iter_mut().zip(&tile.outputs) {
                *out = outputs[0];
            }
        },
    );
    let count = drawn.len() as f64;
    let difference = outputs.iter().map(|&p| f64::from(signed_exp(p))).sum::<f64>() / count
        - drawn.iter().map(|&i| f64::from(samples.log_stretch[i] / objective.tau)).sum::<f64>() / count;
    (penalty * difference * difference, (2.0 * penalty * difference / count) as f32)
}
