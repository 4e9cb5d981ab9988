//! Optimizer steps, three ways over the same model: burn's stock operations ([`stock_step`]), the fused operation inside burn's autodiff
//! ([`operation_step`]), and the production path ([`Fused::steps`]): forward, backward and Adam in burn's own buffers.

use super::adam::{Adam, BETA_1, BETA_2, move_average};
use super::architecture::Architecture;
use super::encode::LINE;
use super::lanes::{Aligned, prefetch};
use super::model::{Loan, Model};
use super::module::{Network, draw};
use super::objective::{Objective, signed_exp};
use super::tile::{self, Batch, MOST_SAMPLES, OUT, Weights};
use super::{Loss, Target};
use crate::surrogate::Samples;
use burn::backend::{Autodiff, Flex};
use burn::optim::{AdamConfig, GradientsParams, SimpleOptimizer};
use burn::tensor::{Tensor, TensorData};
use rayon::prelude::*;
use std::sync::Arc;

/// One sample of this many is held out where that is asked for.
pub const HELD_OUT: usize = 64;

/// Which samples make up a batch.
#[derive(Debug, Clone, Copy)]
pub enum Pick<'a> {
    /// The first ones, in order.
    InOrder,
    /// Drawn with repetition from `among` (all samples, where none), by a generator that is a function of seed and counter only.
    Random {
        /// Seed of the run.
        seed: u64,
        /// Samples drawn before this batch.
        counter: u64,
        /// Numbers of the samples that may be drawn.
        among: Option<&'a [u32]>,
        /// Whether samples whose number is a multiple of [`HELD_OUT`] are left for validation.
        hold_out: bool,
    },
}

impl Pick<'_> {
    fn index(self, position: usize, samples: usize) -> usize {
        match self {
            Pick::InOrder => position,
            Pick::Random { seed, counter, among, hold_out } => {
                let count = among.map_or(samples, <[u32]>::len);
                let drawn = draw(seed, counter + position as u64, count);
                let at = |drawn: usize| among.map_or(drawn, |among| among[drawn] as usize);
                match at(drawn) {
                    // The next one stands in; after the last, or in a list with gaps, that may be a held-out one too: one draw of very many.
                    index if hold_out && index % HELD_OUT == 0 => at((drawn + 1) % count),
                    index => index,
                }
            }
        }
    }
}

/// Running mean of the parameters, used for prediction: it takes the noise of a high rate out of the weights.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Average {
    /// Tables.
    pub tables: Vec<f32>,
    /// Layers.
    pub layers: Vec<f32>,
}

/// Memory of the production path.
pub struct Fused {
    batch: Batch,
    weights: Weights,
    table_gradient: Aligned,
    /// A mark for each cache line of each level's gradient.
    touched: Vec<Vec<u8>>,
    layer_gradient: Vec<f32>,
    /// Numbers of the samples of the present batch.
    drawn: Vec<u32>,
    size: usize,
}

/// One step's inputs, apart from the model.
#[derive(Clone, Copy)]
pub struct Step<'a> {
    /// Samples to draw from.
    pub samples: &'a Samples,
    /// Which of them.
    pub pick: Pick<'a>,
    /// How many; at most the size that [`Fused::new`] was given.
    pub count: usize,
    /// Adam's rate.
    pub rate: f64,
    /// Share by which the average moves towards the new parameters; 0 leaves it.
    pub average_share: f32,
    /// Whether cache lines of the tables that got no gradient wait. Otherwise every entry takes part in every step, as with burn's Adam.
    pub lazy: bool,
    /// A field below the network: it is trained on what the log-stretch has beyond it.
    pub base: Option<&'a dyn Field>,
}

/// One optimizer step, told to whoever has the samples.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PlannedStep {
    /// Samples of the batch.
    pub count: usize,
    /// Drawn with repetition by this seed, after so many samples drawn before; none: the first ones, in order.
    pub drawn: Option<(u64, u64)>,
    /// Whether samples whose number is a multiple of [`HELD_OUT`] are left for validation.
    pub hold_out: bool,
    /// Adam's rate.
    pub rate: f64,
    /// Share by which the mean of the parameters moves towards them; 0 leaves it.
    pub average_share: f32,
    /// Whether lines of 16 values of the tables that got no gradient wait. Otherwise every entry takes part in every step, as with burn's
    /// Adam.
    pub lazy: bool,
}

impl<'a> Step<'a> {
    /// The planned step on these samples, of which those numbered `among` may be drawn (all, where none).
    pub fn of(planned: &PlannedStep, samples: &'a Samples, among: Option<&'a [u32]>, base: Option<&'a dyn Field>) -> Self {
        let &PlannedStep { count, drawn, hold_out, rate, average_share, lazy } = planned;
        let pick = drawn.map_or(Pick::InOrder, |(seed, counter)| Pick::Random { seed, counter, among, hold_out });
        Self { samples, pick, count, rate, average_share, lazy, base }
    }
}

/// Something with a value at every unit point.
pub trait Field: Sync {
    /// Writes the value at each point.
    fn values(&self, points: &[[f32; 3]], out: &mut [f32]);
}

impl Fused {
    /// For batches of at most `size` samples.
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

    /// Takes steps until `next` (called with the number of steps done and the last one's loss) returns none. Between the first and the last
    /// step the buffers belong to the kernels; nothing is copied.
    pub fn steps<'a>(
        &mut self,
        model: &mut Model,
        objective: &Objective,
        average: &mut Average,
        mut next: impl FnMut(u64, Option<f64>) -> Option<Step<'a>>,
    ) {
        let mut loan = model.lend();
        let (shape, epsilon) = (&model.shape, model.epsilon);
        let (mut done, mut loss) = (0, None);
        while let Some(step) = next(done, loss) {
            loss = Some(self.gradient(shape, objective, &loan, &step));
            self.update(shape, epsilon, &mut loan, average, &step);
            done += 1;
        }
        loan.back(model);
    }

    /// Loss and gradients of one batch at the present parameters.
    fn gradient(&mut self, shape: &Architecture, objective: &Objective, loan: &Loan, step: &Step<'_>) -> f64 {
        assert!(step.count <= self.size, "a batch of {} in memory for {}", step.count, self.size);
        self.weights.fill(shape, loan.layers.parameters());
        let tables = loan.tables.as_ref().map_or(&[][..], |tables| tables.parameters());
        let (samples, pick, count) = (step.samples, step.pick, step.count);
        self.drawn.clear();
        self.drawn.extend((0..count).map(|position| pick.index(position, samples.len()) as u32));
        let drawn = &self.drawn[..];
        let index = |position: usize| drawn[position] as usize;
        let scale = objective.scale;
        let (penalty, slope) = mean_penalty(shape, objective, &self.weights, tables, count, samples, index);
        let outputs = shape.outputs();
        let groups = if objective.derivatives() { 1 + shape.dimensions() } else { 1 };
        let loss = |first: usize, take: usize, group_rows: usize, out: &[f32], gradient: &mut [f32]| {
            let mut sum = 0.0;
            let mut below = [0.0; MOST_SAMPLES];
            if let Some(base) = step.base {
                let mut points = [[0.0; 3]; MOST_SAMPLES];
                for (sample, point) in points[..take].iter_mut().enumerate() {
                    *point = samples.points[index(first + sample)];
                }
                base.values(&points[..take], &mut below[..take]);
            }
            for group in 0..groups {
                let weight = objective.weight(shape, group, count);
                for sample in 0..take {
                    let mut targets = objective.targets(shape, samples, index(first + sample), group);
                    targets[0] -= below[sample] / scale.deviation[0];
                    let row = (group * group_rows + sample) * OUT;
                    for output in 0..outputs {
                        let difference = out[row + output] - targets[output];
                        sum += f64::from(weight * difference * difference);
                        gradient[row + output] = 2.0 * weight * difference;
                        if slope != 0.0 {
                            gradient[row + output] += slope * out[row + output].abs().exp();
                        }
                    }
                }
            }
            sum
        };
        // Drawn samples lie anywhere in a pool far larger than the caches: each would be waited for.
        let announce = |position: usize| {
            prefetch(&samples.points, index(position));
            prefetch(&samples.times, index(position));
            prefetch(&samples.log_stretch, index(position));
            prefetch(&samples.arrival, index(position));
            prefetch(&samples.jacobian, index(position));
        };
        let row = |position: usize| samples.row(index(position));
        penalty + self.batch.accumulate(shape, &self.weights, tables, count, announce, row, loss)
    }

    /// Scatters the gradient into the tables, level by level (each level belongs to one task, so nothing is shared), and applies Adam.
    fn update(&mut self, shape: &Architecture, epsilon: f32, loan: &mut Loan, average: &mut Average, step: &Step<'_>) {
        let (share, lazy) = (step.average_share, step.lazy);
        let Self { batch, table_gradient, touched, layer_gradient, .. } = self;
        let Average { tables: average_tables, layers: average_layers } = average;
        let Loan { tables, layers } = loan;
        let update_layers = || {
            batch.layer_gradient(shape, layer_gradient);
            layers.time += 1;
            let time = layers.time;
            let [parameters, first, second] = layers.buffers();
            Adam::at(time, step.rate, epsilon).step(parameters, layer_gradient, first, second);
            if share > 0.0 {
                move_average(average_layers, parameters, share);
            }
        };
        let update_tables = || {
            let Some(tables) = tables else { return };
            tables.time += 1;
            let adam = Adam::at(tables.time, step.rate, epsilon);
            let [mut parameters, mut first, mut second] = tables.buffers();
            let mut gradient = &mut table_gradient[..];
            let mut average = &mut average_tables[..];
            let mut work = Vec::with_capacity(shape.levels.len());
            for (number, (level, touched)) in shape.levels.iter().zip(touched).enumerate() {
                let len = level.entries * shape.features;
                let moments = [split(&mut first, len), split(&mut second, len)];
                work.push((number, touched, split(&mut gradient, len), split(&mut parameters, len), moments, split(&mut average, len)));
            }
            // The largest levels first, so that the small ones fill the gaps at the end.
            work.reverse();
            work.into_par_iter().with_max_len(1).for_each_init(
                || batch.corners(shape),
                |corners, (number, touched, gradient, parameters, [first, second], average)| {
                    batch.table_gradient(shape, number, &shape.levels[number], corners, gradient, touched);
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

/// Cuts `len` values off the front.
fn split<'a>(rest: &mut &'a mut [f32], len: usize) -> &'a mut [f32] {
    let (front, back) = std::mem::take(rest).split_at_mut(len);
    *rest = back;
    front
}

/// The penalty on the difference of the batch means in linear scale (Xi, Luan and Tao 2023, see [`Loss::Published`]), and the factor of exp|output|
/// in its gradient. It needs the mean over the whole batch before any gradient, hence a forward pass of its own; only this loss pays for it.
fn mean_penalty(
    shape: &Architecture,
    objective: &Objective,
    weights: &Weights,
    tables: &[f32],
    count: usize,
    samples: &Samples,
    index: impl Fn(usize) -> usize,
) -> (f64, f32) {
    if objective.loss != Loss::Published || objective.target != Target::Ftle || objective.mean_penalty == 0.0 {
        return (0.0, 0.0);
    }
    let drawn: Vec<usize> = (0..count).map(index).collect();
    let mut outputs = vec![0.0; count];
    let rows = |position: usize| samples.row(drawn[position]);
    tile::predict(shape, weights, tables, count, rows, false, 1, &mut outputs, |count, scratch, out| {
        for (row, out) in scratch.outputs.chunks_exact(OUT).zip(out).take(count) {
            *out = row[0];
        }
    });
    let difference = outputs.iter().map(|&p| f64::from(signed_exp(p))).sum::<f64>() / count as f64
        - drawn.iter().map(|&i| f64::from(samples.log_stretch[i] / objective.tau)).sum::<f64>() / count as f64;
    let penalty = f64::from(objective.mean_penalty);
    (penalty * difference * difference, (2.0 * penalty * difference / count as f64) as f32)
}

type Differentiable = Autodiff<Flex>;

/// One step by burn's stock operations and burn's Adam on the first `count` samples. Returns the loss.
pub fn stock_step(model: &mut Model, objective: &Objective, samples: &Samples, count: usize, rate: f64) -> f64 {
    autodiff_step(model, objective, samples, count, rate, |network, shape, points, derivatives| {
        if derivatives { network.forward_with_derivatives(shape, points) } else { vec![network.forward(shape, points)] }
    })
}

/// The same with the fused operation (which has no derivatives along the axes: the flow map is then trained on arrivals alone).
pub fn operation_step(model: &mut Model, objective: &Objective, samples: &Samples, count: usize, rate: f64) -> f64 {
    let plain = Objective { jacobian_weight: 0.0, ..objective.clone() };
    autodiff_step(model, &plain, samples, count, rate, |network, shape, points, _| vec![network.forward_fused(shape, points)])
}

/// Loss and gradients (tables, layers) by burn's autodiff over `forward`.
pub fn autodiff_gradient(
    model: &Model,
    objective: &Objective,
    samples: &Samples,
    count: usize,
    forward: impl Fn(&Network<Differentiable>, &Arc<Architecture>, Tensor<Differentiable, 2>, bool) -> Vec<Tensor<Differentiable, 2>>,
) -> (f64, Network<Differentiable>, GradientsParams) {
    let shape = Arc::new(model.shape.clone());
    let network = Network::<Differentiable> {
        tables: model.module.tables.as_ref().map(|tables| track(tables.id, tables.val())),
        layers: track(model.module.layers.id, model.module.layers.val()),
    };
    let device = Default::default();
    let points = (0..count).flat_map(|i| shape.axes.iter().map(move |&axis| samples.row(i)[axis])).collect::<Vec<_>>();
    let points = Tensor::from_data(TensorData::new(points, [count, shape.inputs()]), &device);
    let rows = forward(&network, &shape, points, objective.derivatives());
    let outputs = shape.outputs();
    let mut loss = Tensor::<Differentiable, 1>::zeros([1], &device);
    for (group, row) in rows.iter().enumerate() {
        let targets = (0..count).flat_map(|i| objective.targets(&shape, samples, i, group).into_iter().take(outputs)).collect::<Vec<_>>();
        let targets = Tensor::from_data(TensorData::new(targets, [count, outputs]), &device);
        loss = loss + (row.clone() - targets).powi_scalar(2).sum() * objective.weight(&shape, group, count);
    }
    if objective.target == Target::Ftle && objective.loss == Loss::Published {
        let linear = rows[0].clone().sign() * (rows[0].clone().abs().exp() - 1.0);
        let mean = samples.log_stretch[..count].iter().map(|&s| f64::from(s / objective.tau)).sum::<f64>() / count as f64;
        loss = loss + (linear.mean() - mean).powi_scalar(2) * objective.mean_penalty;
    }
    let value = f64::from(loss.clone().into_scalar());
    let gradients = GradientsParams::from_grads(loss.backward(), &network);
    (value, network, gradients)
}

fn track<const D: usize>(id: burn::module::ParamId, tensor: Tensor<Flex, D>) -> burn::module::Param<Tensor<Differentiable, D>> {
    burn::module::Param::initialized(id, Tensor::from_inner(tensor).require_grad())
}

fn autodiff_step(
    model: &mut Model,
    objective: &Objective,
    samples: &Samples,
    count: usize,
    rate: f64,
    forward: impl Fn(&Network<Differentiable>, &Arc<Architecture>, Tensor<Differentiable, 2>, bool) -> Vec<Tensor<Differentiable, 2>>,
) -> f64 {
    let (loss, network, mut gradients) = autodiff_gradient(model, objective, samples, count, forward);
    drop(network);
    let adam = AdamConfig::new().with_beta_1(BETA_1).with_beta_2(BETA_2).with_epsilon(model.epsilon).build();
    if let Some(parameter) = model.module.tables.take() {
        let (id, value, mapper) = parameter.consume();
        let gradient = gradients.remove::<Flex, 2>(id).unwrap_or_else(|| value.zeros_like());
        let (value, state) = SimpleOptimizer::<Flex>::step(&adam, rate, value, gradient, model.table_moments.take());
        model.module.tables = Some(burn::module::Param::from_mapped_value(id, value, mapper));
        model.table_moments = state;
    }
    let id = model.module.layers.id;
    let value = model.module.layers.val();
    let gradient = gradients.remove::<Flex, 1>(id).unwrap_or_else(|| value.zeros_like());
    let (value, state) = SimpleOptimizer::<Flex>::step(&adam, rate, value, gradient, model.layer_moments.take());
    model.module.layers = burn::module::Param::initialized(id, value);
    model.layer_moments = state;
    loss
}
