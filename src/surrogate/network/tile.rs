//! One tile of samples through the network and back, with everything it touches held in the first two cache levels; and a batch of
//! tiles on all cores.

use super::architecture::{Architecture, Level, padded};
use super::dense::{self, BLOCK, Packed, packed_len};
use super::encode::{self, Corners};
use super::lanes::{Aligned, lanes};
use rayon::prelude::*;

/// Values an output row is padded to.
pub(super) const OUT: usize = 4;

/// Packed weights of all layers.
pub(super) struct Weights {
    hidden: Vec<Packed>,
    /// The output layer as rows `[output][padded width]`.
    head: Aligned,
    head_bias: [f32; OUT],
    head_stride: usize,
}

impl Weights {
    /// Packs the flat parameters; `transposed` when gradients will be asked for.
    pub(super) fn new(shape: &Architecture, flat: &[f32], transposed: bool) -> Self {
        let (head, hidden) = shape.layers.split_last().expect("a network has an output layer");
        let head_stride = padded(head.inputs);
        let hidden = hidden.iter().map(|layer| Packed::new(layer, transposed)).collect();
        let mut weights = Self { hidden, head: Aligned::zeros(OUT * head_stride), head_bias: [0.0; OUT], head_stride };
        weights.fill(shape, flat);
        weights
    }

    /// Takes over new parameters of the same shape.
    pub(super) fn fill(&mut self, shape: &Architecture, flat: &[f32]) {
        for (packed, layer) in self.hidden.iter_mut().zip(&shape.layers) {
            packed.fill(layer, flat);
        }
        let head = &shape.layers[shape.layers.len() - 1];
        for output in 0..head.outputs {
            for input in 0..head.inputs {
                self.head[output * self.head_stride + input] = flat[head.weights + input * head.outputs + output];
            }
            self.head_bias[output] = flat[head.biases + output];
        }
    }
}

/// Where each layer's gradient sits in a packed gradient; the head's comes last as `[output][padded width]`, then its biases.
pub(super) struct GradientLayout {
    starts: Vec<usize>,
    head: usize,
    len: usize,
}

impl GradientLayout {
    pub(super) fn new(shape: &Architecture) -> Self {
        let (last, hidden) = shape.layers.split_last().expect("a network has an output layer");
        let mut starts = Vec::new();
        let mut next = 0;
        for layer in hidden {
            starts.push(next);
            next += packed_len(layer);
        }
        Self { starts, head: next, len: next + OUT * padded(last.inputs) + OUT }
    }

    /// Adds a packed gradient to a flat one.
    pub(super) fn unpack(&self, shape: &Architecture, packed: &[f32], flat: &mut [f32]) {
        for (layer, &start) in shape.layers.iter().zip(&self.starts) {
            let packed = &packed[start..];
            dense::for_each_parameter(layer, |from, to| flat[to] += packed[from]);
        }
        let head = &shape.layers[shape.layers.len() - 1];
        let stride = padded(head.inputs);
        for output in 0..head.outputs {
            for input in 0..head.inputs {
                flat[head.weights + input * head.outputs + output] += packed[self.head + output * stride + input];
            }
            flat[head.biases + output] += packed[self.head + OUT * stride + output];
        }
    }
}

/// Samples of one tile, and the memory that it needs.
pub(super) struct Scratch {
    /// Samples a tile holds.
    pub(super) samples: usize,
    /// 1, or 1 + axes when derivatives along the axes go along.
    groups: usize,
    coordinates: Vec<f32>,
    corners: Corners,
    encoded: Aligned,
    /// Activations of the hidden layers: all of them for training, two in turn for prediction.
    activations: Vec<Aligned>,
    gradients: [Aligned; 2],
    /// Outputs, `[group * samples][OUT]`.
    pub(super) outputs: Vec<f32>,
    /// Gradient of the loss for the outputs.
    pub(super) d_outputs: Vec<f32>,
}

impl Scratch {
    pub(super) fn new(shape: &Architecture, derivatives: bool, training: bool) -> Self {
        let groups = if derivatives { 1 + shape.dimensions() } else { 1 };
        // 96 rows of 64 f32 are 24 KiB; wider networks get fewer rows so that two rows of layers stay in L2.
        let rows = if shape.widest() > 128 { 8 * BLOCK } else { 16 * BLOCK };
        let samples = (rows / groups / BLOCK).max(1) * BLOCK;
        let rows = samples * groups;
        let hidden = shape.layers.len() - 1;
        let buffer = |training: bool| Aligned::zeros(if training { rows * shape.widest() } else { 0 });
        Self {
            samples,
            groups,
            coordinates: vec![0.0; shape.dimensions() * samples.next_multiple_of(8)],
            corners: Corners::new(samples),
            encoded: Aligned::zeros(rows * padded(shape.encoded())),
            activations: (0..if training { hidden } else { hidden.min(2) })
                .map(|layer| Aligned::zeros(rows * if training { padded(shape.layers[layer].outputs) } else { shape.widest() }))
                .collect(),
            gradients: [buffer(training), buffer(training)],
            outputs: vec![0.0; rows * OUT],
            d_outputs: vec![0.0; rows * OUT],
        }
    }

    /// Distance of two values of one axis in `coordinates`.
    fn run(&self) -> usize {
        self.samples.next_multiple_of(8)
    }

    /// Takes the active axes of `count` points.
    fn place(&mut self, shape: &Architecture, count: usize, point: impl Fn(usize) -> [f32; 3]) {
        let run = self.run();
        for sample in 0..count {
            let point = point(sample);
            for (slot, &axis) in shape.axes.iter().enumerate() {
                self.coordinates[slot * run + sample] = point[axis];
            }
        }
    }

    /// Positions to outputs.
    pub(super) fn forward(&mut self, shape: &Architecture, weights: &Weights, tables: &[f32], count: usize, point: impl Fn(usize) -> [f32; 3]) {
        assert!(count <= self.samples);
        self.place(shape, count, point);
        let (run, stride) = (self.run(), padded(shape.encoded()));
        if count < self.samples {
            // Rows behind the last sample go through the products with weight 0; what an earlier tile left there could be NaN.
            self.encoded.fill(0.0);
        }
        let Self { corners, encoded, coordinates, .. } = self;
        encode::encode(shape, tables, coordinates, run, count, self.groups, self.samples, corners, encoded, stride);
        let rows = if self.groups == 1 { count.next_multiple_of(BLOCK) } else { self.samples * self.groups };
        let primal = if self.groups == 1 { rows } else { self.samples };
        let held = self.activations.len();
        for (number, layer) in weights.hidden.iter().enumerate() {
            let y_stride = padded(layer.outputs);
            if number == 0 {
                dense::forward(layer, &self.encoded, stride, &mut self.activations[0], y_stride, rows, primal);
            } else {
                let [x, y] = self.activations.get_disjoint_mut([(number - 1) % held, number % held]).expect("two different buffers");
                dense::forward(layer, x, padded(layer.inputs), y, y_stride, rows, primal);
            }
        }
        let last = &self.activations[(weights.hidden.len() - 1) % held];
        for row in 0..rows {
            let x = &last[row * weights.head_stride..][..weights.head_stride];
            for output in 0..shape.outputs() {
                let w = &weights.head[output * weights.head_stride..][..weights.head_stride];
                let sum = x.chunks_exact(8).zip(w.chunks_exact(8)).fold(wide::f32x8::splat(0.0), |sum, (x, w)| lanes(x).mul_add(lanes(w), sum));
                self.outputs[row * OUT + output] = sum.reduce_add() + if row < primal { weights.head_bias[output] } else { 0.0 };
            }
        }
    }

    /// The gradient of `sum(d_outputs * outputs)`: added to `gradient` for the layers, and left in `self.gradients[0]` for the encoding.
    /// Follows a `forward` of the same `count` samples.
    fn backward(&mut self, shape: &Architecture, weights: &Weights, layout: &GradientLayout, count: usize, gradient: &mut [f32]) {
        let rows = if self.groups == 1 { count.next_multiple_of(BLOCK) } else { self.samples * self.groups };
        let primal = if self.groups == 1 { rows } else { self.samples };
        for group in 0..self.groups {
            let start = (group * self.samples + count) * OUT;
            let end = (if self.groups == 1 { rows } else { (group + 1) * self.samples }) * OUT;
            self.d_outputs[start..end].fill(0.0);
        }
        let hidden = weights.hidden.len();
        let stride = weights.head_stride;
        let [current, next] = &mut self.gradients;
        // The output layer: rank-one updates, row by row.
        let active = &self.activations[hidden - 1];
        let (head, biases) = gradient[layout.head..layout.len].split_at_mut(OUT * stride);
        for row in 0..rows {
            let x = &active[row * stride..][..stride];
            let mask = &active[(row % primal) * stride..][..stride];
            let dx = &mut current[row * stride..][..stride];
            dx.fill(0.0);
            for output in 0..shape.outputs() {
                let d = self.d_outputs[row * OUT + output];
                let w = &weights.head[output * stride..][..stride];
                let dw = &mut head[output * stride..][..stride];
                for k in 0..stride {
                    dw[k] = d.mul_add(x[k], dw[k]);
                    dx[k] = d.mul_add(if mask[k] > 0.0 { w[k] } else { 0.0 }, dx[k]);
                }
                if row < primal {
                    biases[output] += d;
                }
            }
        }
        for number in (0..hidden).rev() {
            let layer = &weights.hidden[number];
            let (dz_stride, x_stride) = (padded(layer.outputs), padded(layer.inputs));
            let x = if number == 0 { &self.encoded } else { &self.activations[number - 1] };
            let packed = &mut gradient[layout.starts[number]..][..packed_len(&shape.layers[number])];
            dense::weight_gradient(layer.inputs, layer.outputs, x, x_stride, current, dz_stride, packed, rows, primal);
            if number > 0 || !shape.levels.is_empty() {
                let active = (number > 0).then_some(&x[..]);
                dense::input_gradient(layer, current, dz_stride, next, x_stride, active, rows, primal);
                std::mem::swap(current, next);
            }
        }
    }
}

/// A fixed share of the batch with its own gradient, so that sums do not depend on the number of threads.
struct Chunk {
    scratch: Scratch,
    /// `[axis][run]`.
    coordinates: Vec<f32>,
    /// Gradient for the encoded position, `[level][group][run][features]`.
    d_encoded: Vec<f32>,
    gradient: Aligned,
    loss: f64,
    count: usize,
}

/// Memory for the gradient of batches.
pub(super) struct Batch {
    chunks: Vec<Chunk>,
    layout: GradientLayout,
    groups: usize,
    run: usize,
}

impl Batch {
    /// For batches of at most `batch` samples; `derivatives` adds the derivatives of the outputs along the input axes.
    pub(super) fn new(shape: &Architecture, batch: usize, derivatives: bool) -> Self {
        let layout = GradientLayout::new(shape);
        // Every chunk holds a gradient of its own: at most 16 of them, at most 64 MiB together, but at least two.
        let most = (16 * 1024 * 1024 / layout.len).clamp(2, 16);
        let tile = Scratch::new(shape, derivatives, false).samples;
        let chunks = most.min(batch.div_ceil(tile)).max(1);
        let share = batch.div_ceil(chunks);
        let run = share.next_multiple_of(8);
        let groups = if derivatives { 1 + shape.dimensions() } else { 1 };
        let chunks = (0..chunks)
            .map(|_| Chunk {
                scratch: Scratch::new(shape, derivatives, true),
                coordinates: vec![0.0; run * shape.dimensions()],
                d_encoded: vec![0.0; shape.levels.len() * groups * run * shape.features],
                gradient: Aligned::zeros(layout.len),
                loss: 0.0,
                count: 0,
            })
            .collect();
        Self { chunks, layout, groups, run }
    }

    /// Forward and backward over `count` samples. `announce` is called for every sample one tile before `point` is. `loss` sees the first sample's number, the number of samples, the distance of two groups in
    /// rows, the outputs and the gradient to write (rows of [`OUT`]); it returns the tile's share of the loss. The sum of all shares comes back.
    pub(super) fn accumulate(
        &mut self,
        shape: &Architecture,
        weights: &Weights,
        tables: &[f32],
        count: usize,
        announce: impl Fn(usize) + Sync,
        point: impl Fn(usize) -> [f32; 3] + Sync,
        loss: impl Fn(usize, usize, usize, &[f32], &mut [f32]) -> f64 + Sync,
    ) -> f64 {
        let share = count.div_ceil(self.chunks.len());
        assert!(share <= self.run, "a batch of {count} samples in memory for {} a chunk", self.run);
        let (layout, groups, run) = (&self.layout, self.groups, self.run);
        self.chunks.par_iter_mut().enumerate().with_max_len(1).for_each(|(number, chunk)| {
            let begin = (number * share).min(count);
            chunk.count = ((number + 1) * share).min(count) - begin;
            chunk.loss = 0.0;
            chunk.gradient.fill(0.0);
            let scratch = &mut chunk.scratch;
            let end = begin + chunk.count;
            (begin..end.min(begin + scratch.samples)).for_each(&announce);
            for first in (0..chunk.count).step_by(scratch.samples) {
                let take = (chunk.count - first).min(scratch.samples);
                let next = begin + first + scratch.samples;
                (next..end.min(next + scratch.samples)).for_each(&announce);
                scratch.forward(shape, weights, tables, take, |sample| point(begin + first + sample));
                chunk.loss += loss(begin + first, take, scratch.samples, &scratch.outputs, &mut scratch.d_outputs);
                scratch.backward(shape, weights, layout, take, &mut chunk.gradient);
                if shape.levels.is_empty() {
                    continue;
                }
                for axis in 0..shape.dimensions() {
                    let from = &scratch.coordinates[axis * scratch.run()..][..take];
                    chunk.coordinates[axis * run + first..][..take].copy_from_slice(from);
                }
                let (stride, features) = (padded(shape.encoded()), shape.features);
                for level in 0..shape.levels.len() {
                    for group in 0..groups {
                        let to = &mut chunk.d_encoded[((level * groups + group) * run + first) * features..][..take * features];
                        let rows = &scratch.gradients[0][group * scratch.samples * stride..];
                        for (to, row) in to.chunks_exact_mut(features).zip(rows.chunks_exact(stride)) {
                            to.copy_from_slice(&row[level * features..][..features]);
                        }
                    }
                }
            }
        });
        self.chunks.iter().map(|chunk| chunk.loss).sum()
    }

    /// Adds the gradient of the layers to a flat vector, in a fixed order.
    pub(super) fn layer_gradient(&self, shape: &Architecture, flat: &mut [f32]) {
        for chunk in &self.chunks {
            self.layout.unpack(shape, &chunk.gradient, flat);
        }
    }

    /// Adds the gradient of level `number`'s entries to `table`.
    pub(super) fn table_gradient(&self, shape: &Architecture, number: usize, level: &Level, corners: &mut Corners, table: &mut [f32]) {
        for chunk in &self.chunks {
            let gradient = &chunk.d_encoded[number * self.groups * self.run * shape.features..];
            encode::scatter_level(shape, level, &chunk.coordinates, self.run, chunk.count, self.groups, gradient, corners, table);
        }
    }
}

/// Runs `take(first sample, count, scratch)` for every tile of a prediction, on all cores. `out` holds `width` values a sample.
pub(super) fn predict(
    shape: &Architecture,
    weights: &Weights,
    tables: &[f32],
    points: &[[f32; 3]],
    derivatives: bool,
    width: usize,
    out: &mut [f32],
    take: impl Fn(&[[f32; 3]], &Scratch, &mut [f32]) + Sync,
) {
    assert!(out.len() == points.len() * width);
    let tile = Scratch::new(shape, derivatives, false).samples;
    // Sixteen tiles a task: large enough to hide the scheduling, small enough to share out a frame's batch.
    let share = 16 * tile;
    points.par_chunks(share).zip(out.par_chunks_mut(share * width)).for_each_init(
        || Scratch::new(shape, derivatives, false),
        |scratch, (points, out)| {
            for (points, out) in points.chunks(tile).zip(out.chunks_mut(tile * width)) {
                scratch.forward(shape, weights, tables, points.len(), |sample| points[sample]);
                take(points, scratch, out);
            }
        },
    );
}
