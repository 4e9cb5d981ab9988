//! A tile of samples on its way through the network and back.
//!
//! Source: the fully fused MLP of Müller et al. 2021 (Real-time neural radiance caching for path tracing, ACM Transactions on Graphics 40),
//! for a CPU: about fifty samples pass through the encoding, all layers and back while everything that they touch stays in the first two
//! cache levels.

use super::architecture::Architecture;
use super::dense::{self, PackedLayer, Rows};
use super::encode::{Corners, Positions, encode};
use super::memory::{Aligned, BLOCK, Outputs, TILE_ROWS, row_stride};
use super::output::{self, OutputLayer};
use super::times::Row;

/// Packed weights of all layers.
pub(super) struct Weights {
    hidden: Vec<PackedLayer>,
    output: OutputLayer,
}

impl Weights {
    /// Packs the flat parameters; `transposed` adds the weights that gradients need.
    pub(super) fn new(shape: &Architecture, flat: &[f32], transposed: bool) -> Self {
        let hidden = shape.hidden_layers().iter().map(|layer| PackedLayer::new(layer, transposed)).collect();
        let mut weights = Self { hidden, output: OutputLayer::new(shape.output_layer()) };
        weights.fill(shape, flat);
        weights
    }

    /// Packs new parameters of the same shape.
    pub(super) fn fill(&mut self, shape: &Architecture, flat: &[f32]) {
        for (packed, layer) in self.hidden.iter_mut().zip(shape.hidden_layers()) {
            packed.fill(layer, flat);
        }
        self.output.fill(shape.output_layer(), flat);
    }
}

/// Gradient of the weights of all layers, one packed buffer per layer.
pub(super) struct WeightGradient(Vec<Aligned>);

impl WeightGradient {
    pub(super) fn zeros(shape: &Architecture) -> Self {
        let output = Aligned::zeros(output::packed_len(shape.output_layer()));
        Self(shape.hidden_layers().iter().map(|layer| Aligned::zeros(dense::packed_len(layer))).chain([output]).collect())
    }

    /// Number of values.
    pub(super) fn len(&self) -> usize {
        self.0.iter().map(|layer| layer.len()).sum()
    }

    pub(super) fn reset(&mut self) {
        self.0.iter_mut().for_each(|layer| layer.fill(0.0));
    }

    pub(super) fn add(&mut self, other: &Self) {
        for (layer, other) in self.0.iter_mut().zip(&other.0) {
            layer.iter_mut().zip(other.iter()).for_each(|(sum, part)| *sum += part);
        }
    }

    /// Adds the gradient to a flat vector.
    pub(super) fn add_to(&self, shape: &Architecture, flat: &mut [f32]) {
        for (layer, packed) in shape.hidden_layers().iter().zip(&self.0) {
            dense::for_each_parameter(layer, |from, to| flat[to] += packed[from]);
        }
        let packed = &self.0[self.0.len() - 1];
        output::for_each_parameter(shape.output_layer(), |from, to| flat[to] += packed[from]);
    }
}

/// Everything that an evaluation of the network reads.
#[derive(Clone, Copy)]
pub(super) struct Parameters<'a> {
    pub(super) shape: &'a Architecture,
    pub(super) weights: &'a Weights,
    /// Hash tables of all levels; empty for the frequency encoding.
    pub(super) tables: &'a [f32],
}

/// Memory of one tile. Its rows come in groups: the values of all samples, then their derivatives along each axis of the domain, if any.
pub(super) struct Tile {
    /// Samples that the tile has room for, which is also the number of rows of a group.
    pub(super) capacity: usize,
    /// Samples in use.
    pub(super) count: usize,
    groups: usize,
    /// Unit coordinates `[input][sample]`.
    pub(super) coordinates: Vec<[f32; TILE_ROWS]>,
    corners: Corners,
    encoded: Aligned,
    /// Activations of the hidden layers: all of them for training, two in turn for prediction.
    activations: Vec<Aligned>,
    /// Gradients for the activations of two layers in turn; empty for prediction.
    gradients: [Aligned; 2],
    /// Outputs of all rows.
    pub(super) outputs: Vec<Outputs>,
    /// Gradient of the loss for the outputs.
    pub(super) d_outputs: Vec<Outputs>,
}

impl Tile {
    /// Memory for the values and, with `derivatives`, their derivatives along the axes of the domain.
    pub(super) fn new(shape: &Architecture, derivatives: bool, training: bool) -> Self {
        let groups = if derivatives { 1 + shape.dimensions() } else { 1 };
        let capacity = (TILE_ROWS / groups / BLOCK).max(1) * BLOCK;
        let (rows, hidden) = (capacity * groups, shape.hidden_layers());
        let widest = hidden.iter().map(|layer| row_stride(layer.outputs)).max().unwrap_or(0);
        let activations: Vec<_> = match training {
            true => hidden.iter().map(|layer| Aligned::zeros(rows * row_stride(layer.outputs))).collect(),
            false => hidden.iter().take(2).map(|_| Aligned::zeros(rows * widest)).collect(),
        };
        let gradients = [(); 2].map(|()| Aligned::zeros(if training { rows * widest } else { 0 }));
        Self {
            capacity,
            count: 0,
            groups,
            coordinates: vec![[0.0; TILE_ROWS]; shape.inputs()],
            corners: Corners::new(shape),
            encoded: Aligned::zeros(rows * row_stride(shape.encoded())),
            activations,
            gradients,
            outputs: vec![[0.0; 3]; rows],
            d_outputs: vec![[0.0; 3]; rows],
        }
    }

    /// The positions of `count` samples with these coordinates.
    pub(super) fn positions<'a>(&self, coordinates: &'a [[f32; TILE_ROWS]], count: usize) -> Positions<'a> {
        Positions { coordinates, count, groups: self.groups, group_rows: self.capacity }
    }

    /// Rows to compute: whole blocks of the samples in use; whole groups if there are derivatives.
    fn rows(&self) -> Rows {
        match self.groups {
            1 => Rows { all: self.count.next_multiple_of(BLOCK), values: self.count.next_multiple_of(BLOCK) },
            groups => Rows { all: groups * self.capacity, values: self.capacity },
        }
    }

    /// Evaluates the network for `count` samples.
    pub(super) fn forward(&mut self, network: Parameters<'_>, count: usize, row: impl Fn(usize) -> Row) {
        let Parameters { shape, weights, tables } = network;
        assert!(count <= self.capacity);
        self.count = count;
        for sample in 0..count {
            let row = row(sample);
            for (coordinates, &column) in self.coordinates.iter_mut().zip(&shape.axes) {
                coordinates[sample] = row[column];
            }
        }
        if count < self.capacity {
            // The rows behind the last sample are computed too; an earlier tile may have left NaN in them.
            self.encoded.fill(0.0);
        }
        let (positions, rows) = (self.positions(&self.coordinates, count), self.rows());
        encode(shape, tables, positions, &mut self.corners, &mut self.encoded);
        let buffers = self.activations.len();
        for (number, layer) in weights.hidden.iter().enumerate() {
            if number == 0 {
                dense::forward(layer, &self.encoded, &mut self.activations[0], rows);
            } else {
                let pair = [(number - 1) % buffers, number % buffers];
                let [x, y] = self.activations.get_disjoint_mut(pair).expect("two different buffers");
                dense::forward(layer, x, y, rows);
            }
        }
        let last = &self.activations[(weights.hidden.len() - 1) % buffers];
        weights.output.forward(last, row_stride(shape.output_layer().inputs), rows, &mut self.outputs);
    }

    /// Gradient of `sum(d_outputs * outputs)` after a `forward`: added to `gradient` for the layers, and written to `d_encoded`, if given,
    /// for the features (rows [`row_stride`] apart).
    pub(super) fn backward(&mut self, network: Parameters<'_>, gradient: &mut WeightGradient, d_encoded: Option<&mut [f32]>) {
        let Parameters { shape, weights, .. } = network;
        for group in self.d_outputs.chunks_exact_mut(self.capacity) {
            group[self.count..].fill([0.0; 3]);
        }
        let (rows, hidden) = (self.rows(), weights.hidden.len());
        let [current, next] = &mut self.gradients;
        let stride = row_stride(shape.output_layer().inputs);
        weights.output.backward(&self.activations[hidden - 1], current, stride, rows, &self.d_outputs, &mut gradient.0[hidden]);
        for number in (1..hidden).rev() {
            let (layer, x) = (&weights.hidden[number], &self.activations[number - 1]);
            dense::weight_gradient(layer, x, current, &mut gradient.0[number], rows);
            dense::input_gradient(layer, current, next, Some(x), rows);
            std::mem::swap(current, next);
        }
        dense::weight_gradient(&weights.hidden[0], &self.encoded, current, &mut gradient.0[0], rows);
        if let Some(d_encoded) = d_encoded {
            dense::input_gradient(&weights.hidden[0], current, d_encoded, None, rows);
        }
    }
}
