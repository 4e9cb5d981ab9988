//! One tile of samples through the network and back, with everything it touches held in the first two cache levels; and a batch of
//! tiles on all cores.

use super::architecture::{Architecture, Level, padded, row_stride};
use super::dense::{self, BLOCK, Packed, packed_len};
use super::encode::{self, Corners};
use super::lanes::{Aligned, lanes};
use super::times::Row;
use rayon::prelude::*;
use wide::f32x8;

/// Values an output row is padded to.
pub(super) const OUT: usize = 4;

/// Most samples of a tile.
pub(super) const MOST_SAMPLES: usize = 8 * BLOCK;

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
        // 48 rows of 64 f32 are 12 KiB: what a layer reads and writes fits the first cache level.
        let rows = MOST_SAMPLES;
        let samples = (rows / groups / BLOCK).max(1) * BLOCK;
        let rows = samples * groups;
        let hidden = shape.layers.len() - 1;
        let buffer = |training: bool| Aligned::zeros(if training { rows * shape.widest() } else { 0 });
        Self {
            samples,
            groups,
            coordinates: vec![0.0; shape.inputs() * samples.next_multiple_of(8)],
            corners: Corners::new(shape, samples),
            encoded: Aligned::zeros(rows * row_stride(shape.encoded())),
            activations: (0..if training { hidden } else { hidden.min(2) })
                .map(|layer| Aligned::zeros(rows * if training { row_stride(shape.layers[layer].outputs) } else { shape.widest() }))
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

    /// Takes the inputs of `count` rows.
    fn place(&mut self, shape: &Architecture, count: usize, row: impl Fn(usize) -> Row) {
        let run = self.run();
        for sample in 0..count {
            let row = row(sample);
            for (slot, &axis) in shape.axes.iter().enumerate() {
                self.coordinates[slot * run + sample] = row[axis];
            }
        }
    }

    /// Inputs to outputs.
    pub(super) fn forward(&mut self, shape: &Architecture, weights: &Weights, tables: &[f32], count: usize, row: impl Fn(usize) -> Row) {
        assert!(count <= self.samples);
        self.place(shape, count, row);
        let (run, stride) = (self.run(), row_stride(shape.encoded()));
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
            let y_stride = row_stride(layer.outputs);
            if number == 0 {
                dense::forward(layer, &self.encoded, stride, &mut self.activations[0], y_stride, rows, primal);
            } else {
                let [x, y] = self.activations.get_disjoint_mut([(number - 1) % held, number % held]).expect("two different buffers");
                dense::forward(layer, x, row_stride(layer.inputs), y, y_stride, rows, primal);
            }
        }
        let last = &self.activations[(weights.hidden.len() - 1) % held];
        let (len, stride) = (weights.head_stride, row_stride(weights.head_stride));
        for output in 0..shape.outputs() {
            let w = &weights.head[output * len..][..len];
            for row in (0..rows).step_by(BLOCK) {
                // Six rows side by side hide the latency of each other's sums.
                let x: [&[f32]; BLOCK] = std::array::from_fn(|m| &last[(row + m) * stride..][..len]);
                let mut sums = [f32x8::splat(0.0); BLOCK];
                for k in (0..len).step_by(8) {
                    let w = lanes(&w[k..]);
                    for (sum, x) in sums.iter_mut().zip(x) {
                        *sum = lanes(&x[k..]).mul_add(w, *sum);
                    }
                }
                let bias = if row < primal { weights.head_bias[output] } else { 0.0 };
                for (m, sum) in sums.into_iter().enumerate() {
                    self.outputs[(row + m) * OUT + output] = sum.reduce_add() + bias;
                }
            }
        }
    }

    /// The gradient of `sum(d_outputs * outputs)`: added to `gradient` for the layers, and written to `d_encoded` (a row a row of the tile) for the encoding.
    /// Follows a `forward` of the same `count` samples.
    fn backward(
        &mut self,
        shape: &Architecture,
        weights: &Weights,
        layout: &GradientLayout,
        count: usize,
        gradient: &mut [f32],
        d_encoded: &mut [f32],
    ) {
        let rows = if self.groups == 1 { count.next_multiple_of(BLOCK) } else { self.samples * self.groups };
        let primal = if self.groups == 1 { rows } else { self.samples };
        for group in 0..self.groups {
            let start = (group * self.samples + count) * OUT;
            let end = (if self.groups == 1 { rows } else { (group + 1) * self.samples }) * OUT;
            self.d_outputs[start..end].fill(0.0);
        }
        let hidden = weights.hidden.len();
        let (len, stride) = (weights.head_stride, row_stride(weights.head_stride));
        let [current, next] = &mut self.gradients;
        // The output layer: rank-one updates, row by row.
        let active = &self.activations[hidden - 1];
        let (head, biases) = gradient[layout.head..layout.len].split_at_mut(OUT * len);
        for row in (0..rows).step_by(BLOCK) {
            // Groups are whole blocks: the block's value rows are together.
            let value = row % primal;
            for output in 0..shape.outputs() {
                let d: [f32; BLOCK] = std::array::from_fn(|m| self.d_outputs[(row + m) * OUT + output]);
                if row < primal {
                    biases[output] += d.iter().sum::<f32>();
                }
                let w = &weights.head[output * len..][..len];
                let dw = &mut head[output * len..][..len];
                // Six rows side by side share one reading and writing of the gradient.
                for k in (0..len).step_by(8) {
                    let (weight, mut sum) = (lanes(&w[k..]), lanes(&dw[k..]));
                    for (m, &d) in d.iter().enumerate() {
                        let d = f32x8::splat(d);
                        sum = d.mul_add(lanes(&active[(row + m) * stride + k..]), sum);
                        let mask = lanes(&active[(value + m) * stride + k..]).simd_gt(f32x8::splat(0.0));
                        let dx = &mut current[(row + m) * stride + k..][..8];
                        let before = if output == 0 { f32x8::splat(0.0) } else { lanes(dx) };
                        dx.copy_from_slice(&d.mul_add(mask & weight, before).to_array());
                    }
                    dw[k..k + 8].copy_from_slice(&sum.to_array());
                }
            }
        }
        for number in (0..hidden).rev() {
            let layer = &weights.hidden[number];
            let (dz_stride, x_stride) = (row_stride(layer.outputs), row_stride(layer.inputs));
            let x = if number == 0 { &self.encoded } else { &self.activations[number - 1] };
            let packed = &mut gradient[layout.starts[number]..][..packed_len(&shape.layers[number])];
            dense::weight_gradient(layer.inputs, layer.outputs, x, x_stride, current, dz_stride, packed, rows, primal);
            if number > 0 {
                dense::input_gradient(layer, current, dz_stride, next, x_stride, Some(x), rows, primal);
                std::mem::swap(current, next);
            } else if !shape.levels.is_empty() {
                dense::input_gradient(layer, current, dz_stride, d_encoded, x_stride, None, rows, primal);
            }
        }
    }
}

/// A fixed share of the batch with its own gradient, so that sums do not depend on the number of threads.
struct Chunk {
    scratch: Scratch,
    /// Per tile `[axis][run]`.
    coordinates: Vec<f32>,
    /// Gradient for the encoded position, per tile `[group][sample][row stride]`.
    d_encoded: Aligned,
    gradient: Aligned,
    loss: f64,
    count: usize,
}

/// Memory for the gradient of batches.
pub(super) struct Batch {
    chunks: Vec<Chunk>,
    layout: GradientLayout,
    groups: usize,
    /// Tiles of a chunk.
    tiles: usize,
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
        let tiles = share.div_ceil(tile);
        let groups = if derivatives { 1 + shape.dimensions() } else { 1 };
        let encoded = if shape.levels.is_empty() { 0 } else { tiles * tile * groups * row_stride(shape.encoded()) };
        let chunks = (0..chunks)
            .map(|_| Chunk {
                scratch: Scratch::new(shape, derivatives, true),
                coordinates: vec![0.0; tiles * tile.next_multiple_of(8) * shape.inputs()],
                d_encoded: Aligned::zeros(encoded),
                gradient: Aligned::zeros(layout.len),
                loss: 0.0,
                count: 0,
            })
            .collect();
        Self { chunks, layout, groups, tiles }
    }

    /// Forward and backward over `count` samples. `announce` is called for every sample one tile before `row` is. `loss` sees the first sample's number, the number of samples, the distance of two groups in
    /// rows, the outputs and the gradient to write (rows of [`OUT`]); it returns the tile's share of the loss. The sum of all shares comes back.
    pub(super) fn accumulate(
        &mut self,
        shape: &Architecture,
        weights: &Weights,
        tables: &[f32],
        count: usize,
        announce: impl Fn(usize) + Sync,
        row: impl Fn(usize) -> Row + Sync,
        loss: impl Fn(usize, usize, usize, &[f32], &mut [f32]) -> f64 + Sync,
    ) -> f64 {
        let share = count.div_ceil(self.chunks.len());
        let tile = self.chunks[0].scratch.samples;
        assert!(share <= self.tiles * tile, "a batch of {count} samples in memory for {} tiles a chunk", self.tiles);
        let (layout, groups, stride) = (&self.layout, self.groups, row_stride(shape.encoded()));
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
                scratch.forward(shape, weights, tables, take, |sample| row(begin + first + sample));
                chunk.loss += loss(begin + first, take, scratch.samples, &scratch.outputs, &mut scratch.d_outputs);
                let number = first / scratch.samples;
                let d_encoded = if shape.levels.is_empty() {
                    &mut []
                } else {
                    let rows = scratch.samples * groups * stride;
                    let held = scratch.coordinates.len();
                    chunk.coordinates[number * held..][..held].copy_from_slice(&scratch.coordinates);
                    &mut chunk.d_encoded[number * rows..][..rows]
                };
                scratch.backward(shape, weights, layout, take, &mut chunk.gradient, d_encoded);
            }
        });
        // The first chunk's gradient becomes the sum, in a fixed order.
        let (sum, rest) = self.chunks.split_at_mut(1);
        for chunk in rest {
            for (sum, part) in sum[0].gradient.iter_mut().zip(chunk.gradient.iter()) {
                *sum += part;
            }
        }
        self.chunks.iter().map(|chunk| chunk.loss).sum()
    }

    /// Adds the gradient of the layers to a flat vector.
    pub(super) fn layer_gradient(&self, shape: &Architecture, flat: &mut [f32]) {
        self.layout.unpack(shape, &self.chunks[0].gradient, flat);
    }

    /// Adds the gradient of level `number`'s entries to `table`, and marks the cache lines of it that were written to in `touched`.
    pub(super) fn table_gradient(
        &self,
        shape: &Architecture,
        number: usize,
        level: &Level,
        corners: &mut Corners,
        table: &mut [f32],
        touched: &mut [u8],
    ) {
        let stride = row_stride(shape.encoded());
        for chunk in &self.chunks {
            let tile = chunk.scratch.samples;
            let (rows, held) = (tile * self.groups * stride, chunk.scratch.coordinates.len());
            for first in (0..chunk.count).step_by(tile) {
                let at = first / tile;
                let coordinates = &chunk.coordinates[at * held..][..held];
                let gradient = &chunk.d_encoded[at * rows..][..rows];
                let count = (chunk.count - first).min(tile);
                let run = chunk.scratch.run();
                encode::scatter_level(
                    shape,
                    number,
                    level,
                    coordinates,
                    run,
                    count,
                    self.groups,
                    tile,
                    gradient,
                    stride,
                    corners,
                    table,
                    touched,
                );
            }
        }
    }

    /// Room for the corners of a tile.
    pub(super) fn corners(&self, shape: &Architecture) -> Corners {
        Corners::new(shape, self.chunks[0].scratch.samples)
    }
}

/// Runs `take(count, scratch, its part of out)` for every tile of a prediction, on all cores. `out` holds `width` values a sample.
pub(super) fn predict(
    shape: &Architecture,
    weights: &Weights,
    tables: &[f32],
    rows: usize,
    row: impl Fn(usize) -> Row + Sync,
    derivatives: bool,
    width: usize,
    out: &mut [f32],
    take: impl Fn(usize, &Scratch, &mut [f32]) + Sync,
) {
    assert!(out.len() == rows * width);
    let tile = Scratch::new(shape, derivatives, false).samples;
    // Sixteen tiles a task: large enough to hide the scheduling, small enough to share out a frame's batch.
    let share = 16 * tile;
    out.par_chunks_mut(share * width).enumerate().for_each_init(
        || Scratch::new(shape, derivatives, false),
        |scratch, (task, out)| {
            for (number, out) in out.chunks_mut(tile * width).enumerate() {
                let (first, count) = (task * share + number * tile, out.len() / width);
                scratch.forward(shape, weights, tables, count, |sample| row(first + sample));
                take(count, scratch, out);
            }
        },
    );
}
