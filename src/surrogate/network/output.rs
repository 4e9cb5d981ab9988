//! The output layer: at most three dot products per row, for which a panel of sixteen columns would be mostly padding.

use super::architecture::Layer;
use super::dense::Rows;
use super::memory::{Aligned, BLOCK, Outputs, load, padded};
use wide::f32x8;

/// Number of outputs that there is memory for.
const MAX_OUTPUTS: usize = size_of::<Outputs>() / size_of::<f32>();

/// Packed parameters of the output layer: rows `[output][padded inputs]`, then the biases. Gradients have the same layout.
pub(super) struct OutputLayer {
    packed: Aligned,
    /// Inputs, padded.
    width: usize,
    outputs: usize,
}

/// Length of the packed parameters.
pub(super) fn packed_len(layer: &Layer) -> usize {
    MAX_OUTPUTS * (padded(layer.inputs) + 1)
}

/// Calls `place(packed index, flat index)` for every parameter of the layer.
pub(super) fn for_each_parameter(layer: &Layer, mut place: impl FnMut(usize, usize)) {
    let width = padded(layer.inputs);
    for output in 0..layer.outputs {
        for input in 0..layer.inputs {
            place(output * width + input, layer.weights + input * layer.outputs + output);
        }
        place(MAX_OUTPUTS * width + output, layer.biases + output);
    }
}

impl OutputLayer {
    /// Memory for a layer, filled with zeros.
    pub(super) fn new(layer: &Layer) -> Self {
        Self { packed: Aligned::zeros(packed_len(layer)), width: padded(layer.inputs), outputs: layer.outputs }
    }

    /// Copies the layer's parameters out of the flat vector.
    pub(super) fn fill(&mut self, layer: &Layer, flat: &[f32]) {
        for_each_parameter(layer, |to, from| self.packed[to] = flat[from]);
    }

    /// Outputs of all rows of `x`, which lie `stride` apart. Tangent rows have no bias.
    pub(super) fn forward(&self, x: &[f32], stride: usize, rows: Rows, outputs: &mut [Outputs]) {
        let (weights, biases) = self.packed.split_at(MAX_OUTPUTS * self.width);
        for output in 0..self.outputs {
            let weights = &weights[output * self.width..][..self.width];
            for row in (0..rows.all).step_by(BLOCK) {
                // The sums of six rows hide each other's latency.
                let x: [&[f32]; BLOCK] = std::array::from_fn(|m| &x[(row + m) * stride..][..self.width]);
                let mut sums = [f32x8::splat(0.0); BLOCK];
                for k in (0..self.width).step_by(8) {
                    let weights = load(&weights[k..]);
                    for (sum, x) in sums.iter_mut().zip(x) {
                        *sum = load(&x[k..]).mul_add(weights, *sum);
                    }
                }
                let bias = if row < rows.values { biases[output] } else { 0.0 };
                for (m, sum) in sums.into_iter().enumerate() {
                    outputs[row + m][output] = sum.reduce_add() + bias;
                }
            }
        }
    }

    /// Adds to the packed gradient, and writes the gradient for `x`, kept only where the value row of `x` is above 0, to `dx`. Rows of both
    /// lie `stride` apart.
    pub(super) fn backward(&self, x: &[f32], dx: &mut [f32], stride: usize, rows: Rows, d_outputs: &[Outputs], gradient: &mut [f32]) {
        let (gradient, biases) = gradient.split_at_mut(MAX_OUTPUTS * self.width);
        let zero = f32x8::splat(0.0);
        for row in (0..rows.all).step_by(BLOCK) {
            let value_row = row % rows.values;
            for output in 0..self.outputs {
                let d: [f32; BLOCK] = std::array::from_fn(|m| d_outputs[row + m][output]);
                if row < rows.values {
                    biases[output] += d.iter().sum::<f32>();
                }
                let weights = &self.packed[output * self.width..][..self.width];
                let gradient = &mut gradient[output * self.width..][..self.width];
                // Six rows share one load and one store of the gradient.
                for k in (0..self.width).step_by(8) {
                    let (weights, mut sum) = (load(&weights[k..]), load(&gradient[k..]));
                    for (m, d) in d.map(f32x8::splat).into_iter().enumerate() {
                        sum = d.mul_add(load(&x[(row + m) * stride + k..]), sum);
                        let is_active = load(&x[(value_row + m) * stride + k..]).simd_gt(zero);
                        let dx = &mut dx[(row + m) * stride + k..][..8];
                        let before = if output == 0 { zero } else { load(dx) };
                        dx.copy_from_slice(&d.mul_add(is_active & weights, before).to_array());
                    }
                    gradient[k..k + 8].copy_from_slice(&sum.to_array());
                }
            }
        }
    }
}
