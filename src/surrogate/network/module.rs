//! The burn module, and its evaluation by burn's stock operations: the readable reference for the fused kernels.
//!
//! Encodings as in `encode` (Müller et al. 2022, Mildenhall et al. 2020); initialisation of weights: He et al. 2015 (Delving deep into
//! rectifiers), of tables: Müller et al. 2022.

use super::architecture::{Architecture, HASH};
use super::random::uniform;
use burn::module::{Module, Param, ParamId};
use burn::tensor::{Int, Tensor, TensorData, activation::relu, backend::Backend};
use std::f32::consts::FRAC_PI_2;

/// Parameters of a network. burn owns them; the fused kernels work in the same buffers.
#[derive(Module, Debug)]
pub struct Network<B: Backend> {
    /// Hash-grid tables, `[entries of all levels, features]`; `None` for the frequency encoding.
    pub tables: Option<Param<Tensor<B, 2>>>,
    /// Weights and biases of all layers in one vector (see [`super::architecture::Layer`]).
    pub layers: Param<Tensor<B, 1>>,
}

impl<B: Backend> Network<B> {
    /// Draws the parameters: tables from +-1e-4, weights from He's uniform distribution, biases 0. `zero_output` sets the output layer to
    /// 0.
    pub fn new(shape: &Architecture, seed: u64, zero_output: bool, device: &B::Device) -> Self {
        let entries = shape.table_entries();
        let tables = (entries > 0).then(|| {
            let values = (0..entries * shape.features).map(|i| (2.0 * uniform(seed, i as u64) - 1.0) * 1e-4).collect();
            parameter(Tensor::from_data(TensorData::new(values, [entries, shape.features]), device))
        });
        let mut values = vec![0.0_f32; shape.layer_parameters()];
        let drawn = if zero_output { shape.hidden_layers() } else { &shape.layers };
        for layer in drawn {
            let bound = (6.0 / layer.inputs as f32).sqrt();
            for weight in layer.weights..layer.biases {
                values[weight] = (2.0 * uniform(seed ^ 0x6c61_7965_7273, weight as u64) - 1.0) * bound;
            }
        }
        let count = values.len();
        Self { tables, layers: parameter(Tensor::from_data(TensorData::new(values, [count]), device)) }
    }

    /// Outputs `[samples, outputs]` at unit coordinates `[samples, axes]`.
    pub fn forward(&self, shape: &Architecture, points: Tensor<B, 2>) -> Tensor<B, 2> {
        self.layers_forward(shape, self.encode(shape, points, false)).remove(0)
    }

    /// Outputs, then their derivatives along each axis of the domain, by forward differentiation.
    pub fn forward_with_derivatives(&self, shape: &Architecture, points: Tensor<B, 2>) -> Vec<Tensor<B, 2>> {
        self.layers_forward(shape, self.encode(shape, points, true))
    }

    /// The first tensor is the values, the rest their derivatives; each `[samples, width]`.
    fn layers_forward(&self, shape: &Architecture, mut rows: Vec<Tensor<B, 2>>) -> Vec<Tensor<B, 2>> {
        let flat = self.layers.val();
        for (number, layer) in shape.layers.iter().enumerate() {
            let weights = flat.clone().slice(layer.weights..layer.biases).reshape([layer.inputs, layer.outputs]);
            let biases = flat.clone().slice(layer.biases..layer.biases + layer.outputs).reshape([1, layer.outputs]);
            for (group, row) in rows.iter_mut().enumerate() {
                *row = row.clone().matmul(weights.clone());
                if group == 0 {
                    *row = row.clone() + biases.clone();
                }
            }
            if number + 1 < shape.layers.len() {
                let passed = rows[0].clone().greater_elem(0.0).float();
                rows[0] = relu(rows[0].clone());
                for row in &mut rows[1..] {
                    *row = row.clone() * passed.clone();
                }
            }
        }
        rows
    }

    fn encode(&self, shape: &Architecture, points: Tensor<B, 2>, derivatives: bool) -> Vec<Tensor<B, 2>> {
        let points = points.clamp(0.0, 1.0);
        match &self.tables {
            Some(tables) => hash_grid(shape, tables.val(), points, derivatives),
            None => frequencies(shape, points, derivatives),
        }
    }
}

fn parameter<B: Backend, const D: usize>(tensor: Tensor<B, D>) -> Param<Tensor<B, D>> {
    Param::initialized(ParamId::new(), tensor.require_grad())
}

/// Multilinear interpolation of table entries, all levels at once: indices and weights are `[samples, levels]`.
fn hash_grid<B: Backend>(shape: &Architecture, tables: Tensor<B, 2>, points: Tensor<B, 2>, derivatives: bool) -> Vec<Tensor<B, 2>> {
    let device = points.device();
    let (samples, levels, inputs) = (points.dims()[0], shape.levels.len(), shape.inputs());
    let row = |value: &dyn Fn(usize) -> i64| -> Tensor<B, 2, Int> {
        let values: Vec<i64> = (0..levels).map(value).collect();
        Tensor::from_data(TensorData::new(values, [1, levels]), &device)
    };
    let dense = shape.levels.iter().filter(|level| !level.hashed).count();
    let (mut cell, mut share, mut scale) = (Vec::new(), Vec::new(), Vec::new());
    for axis in 0..inputs {
        let cells = row(&|l| i64::from(shape.levels[l].cells[axis]));
        let position = points.clone().slice([0..samples, axis..axis + 1]) * cells.clone().float();
        let lower = position.clone().floor().min_pair((cells.clone() - 1).float());
        let fraction = position - lower.clone();
        cell.push(lower.int());
        share.push([fraction.clone().neg() + 1.0, fraction]);
        scale.push(cells.float());
    }
    let offset = row(&|l| shape.levels[l].offset as i64);
    let mut sums: Vec<Option<Tensor<B, 2>>> = vec![None; if derivatives { 1 + shape.dimensions() } else { 1 }];
    for corner in 0..1_usize << inputs {
        let side = |axis: usize| (corner >> axis) & 1;
        let node = |axis: usize| cell[axis].clone() + side(axis) as i32;
        let mut parts = Vec::new();
        if dense > 0 {
            let mut index = node(0);
            for axis in 1..inputs {
                let stride =
                    row(&|l| shape.levels[l].cells[..axis].iter().map(|&c| i64::from(c) + 1).fold(1, i64::wrapping_mul) & 0x3fff_ffff);
                index = index + node(axis) * stride;
            }
            parts.push(index.slice([0..samples, 0..dense]));
        }
        if dense < levels {
            // Only the low bits of the hash are kept, so the multipliers may be reduced first; this keeps the products inside 32 bits.
            let low = (shape.levels[levels - 1].entries - 1) as i64;
            let mut index = node(0);
            for axis in 1..inputs {
                index = index.bitwise_xor(node(axis) * row(&|_| i64::from(HASH[axis]) & low));
            }
            let mask = row(&|_| low).expand([samples, levels]);
            parts.push(index.bitwise_and(mask).slice([0..samples, dense..levels]));
        }
        let index = (Tensor::cat(parts, 1) + offset.clone()).reshape([samples * levels]);
        let entries = tables.clone().select(0, index);
        for (group, sum) in sums.iter_mut().enumerate() {
            let mut weight = Tensor::<B, 2>::ones([samples, levels], &device);
            for axis in 0..inputs {
                weight = if group == axis + 1 {
                    weight * (scale[axis].clone() * if side(axis) == 1 { 1.0 } else { -1.0 })
                } else {
                    weight * share[axis][side(axis)].clone()
                };
            }
            let term = entries.clone() * weight.reshape([samples * levels, 1]);
            *sum = Some(match sum.take() {
                Some(sum) => sum + term,
                None => term,
            });
        }
    }
    sums.into_iter().flatten().map(|sum| sum.reshape([samples, levels * shape.features])).collect()
}

/// sin and cos of 2^l (pi / 2) (2x - 1), ordered by axis, octave, (sin, cos).
fn frequencies<B: Backend>(shape: &Architecture, points: Tensor<B, 2>, derivatives: bool) -> Vec<Tensor<B, 2>> {
    let device = points.device();
    let (samples, inputs, octaves) = (points.dims()[0], shape.inputs(), shape.octaves);
    let frequencies: Vec<f32> = (0..octaves).map(|octave| FRAC_PI_2 * (1_u32 << octave) as f32).collect();
    let frequencies = Tensor::<B, 1>::from_data(TensorData::new(frequencies, [octaves]), &device).reshape([1, 1, octaves]);
    let angle = (points * 2.0 - 1.0).reshape([samples, inputs, 1]) * frequencies.clone();
    let (sin, cos) = (angle.clone().sin(), angle.cos());
    let pairs = |sin: Tensor<B, 3>, cos: Tensor<B, 3>| -> Tensor<B, 2> {
        Tensor::stack::<4>(vec![sin, cos], 3).reshape([samples, 2 * inputs * octaves])
    };
    let mut rows = vec![pairs(sin.clone(), cos.clone())];
    for axis in 0..if derivatives { shape.dimensions() } else { 0 } {
        let along: Vec<f32> = (0..inputs).map(|other| if other == axis { 2.0 } else { 0.0 }).collect();
        let along = Tensor::<B, 1>::from_data(TensorData::new(along, [inputs]), &device).reshape([1, inputs, 1]);
        let slope = frequencies.clone() * along;
        rows.push(pairs(cos.clone() * slope.clone(), sin.clone() * slope.neg()));
    }
    rows
}
