//! Encoding and MLP as one differentiable burn operation, for any burn training code on the CPU.
//!
//! ```
//! use burn::backend::{Autodiff, Flex};
//! use burn::tensor::Tensor;
//! use ridgewatch_surrogate::network::{Architecture, FusedNetwork, Network, NetworkSettings};
//! use std::sync::Arc;
//!
//! type B = Autodiff<Flex>;
//! let settings = NetworkSettings { levels: Some(4), log2_table: Some(8), width: 16, ..NetworkSettings::default() };
//! let shape = Arc::new(Architecture::new(&settings, &[0, 1], [2.0, 1.0, 1.0]).unwrap());
//! let network = Network::<B>::new(&shape, 0, false, &Default::default());
//! let points = Tensor::<B, 2>::from_floats([[0.1, 0.2], [0.7, 0.4]], &Default::default());
//! let gradients = network.forward_fused(&shape, points).powi_scalar(2).mean().backward();
//! assert!(network.layers.grad(&gradients).is_some());
//! ```

use super::architecture::Architecture;
use super::batch::{Batch, predict};
use super::encode::Corners;
use super::memory::LINE;
use super::module::Network;
use super::tile::{Parameters, Tile, Weights};
use super::times::Row;
use burn::backend::autodiff::{
    Autodiff,
    checkpoint::{base::Checkpointer, strategy::CheckpointStrategy},
    grads::Gradients,
    ops::{Backward, Ops, OpsKind},
};
use burn::backend::{Flex, flex::FlexTensor};
use burn::tensor::{Tensor, TensorData, TensorMetadata, TensorPrimitive, backend::Backend, ops::FloatTensor};
use std::borrow::Cow;
use std::sync::Arc;

/// Tensors that the fused network reads.
#[derive(Debug, Clone)]
pub struct NetworkInputs<T> {
    /// Unit coordinates `[samples, inputs]`. They are data and get no gradient.
    pub points: T,
    /// Tables `[entries, features]`; any value for the frequency encoding.
    pub tables: T,
    /// The flat vector of layers.
    pub layers: T,
    /// Shape of the network.
    pub shape: Arc<Architecture>,
}

impl<T> NetworkInputs<T> {
    fn map<'a, U>(&'a self, convert: impl Fn(&'a T) -> U) -> NetworkInputs<U> {
        let Self { points, tables, layers, shape } = self;
        NetworkInputs { points: convert(points), tables: convert(tables), layers: convert(layers), shape: Arc::clone(shape) }
    }
}

/// Backend with the fused network.
pub trait FusedNetwork: Backend {
    /// Outputs `[samples, outputs]`.
    fn network(inputs: NetworkInputs<FloatTensor<Self>>) -> FloatTensor<Self>;

    /// Gradients for the tables and the layers, from the gradient for the outputs. The forward pass is repeated, since its activations
    /// would take hundreds of bytes per sample.
    fn network_backward(inputs: NetworkInputs<FloatTensor<Self>>, gradient: FloatTensor<Self>) -> [FloatTensor<Self>; 2];
}

impl<B: FusedNetwork> Network<B> {
    /// [`Network::forward`] as one operation.
    pub fn forward_fused(&self, shape: &Arc<Architecture>, points: Tensor<B, 2>) -> Tensor<B, 2> {
        let device = points.device();
        let tables = self.tables.as_ref().map_or_else(|| Tensor::zeros([1, 1], &device), |tables| tables.val());
        let (points, tables, layers) = (points.into_primitive(), tables.into_primitive(), self.layers.val().into_primitive());
        let (points, tables, layers) = (points.tensor(), tables.tensor(), layers.tensor());
        let outputs = B::network(NetworkInputs { points, tables, layers, shape: Arc::clone(shape) });
        Tensor::from_primitive(TensorPrimitive::Float(outputs))
    }
}

/// The values of a tensor, in order.
fn values(tensor: &FlexTensor) -> Cow<'_, [f32]> {
    match tensor.as_slice::<f32>() {
        Some(values) => values.into(),
        None => tensor.to_contiguous().storage::<f32>().to_vec().into(),
    }
}

/// Rows of points `[samples, inputs]`.
fn rows(points: &[f32], shape: &Architecture) -> Vec<Row> {
    let row = |point: &[f32]| {
        let mut row = Row::default();
        shape.axes.iter().zip(point).for_each(|(&column, &value)| row[column] = value);
        row
    };
    points.chunks_exact(shape.inputs()).map(row).collect()
}

fn tables_of<'a>(tables: &'a [f32], shape: &Architecture) -> &'a [f32] {
    if shape.levels.is_empty() { &[] } else { tables }
}

impl FusedNetwork for Flex {
    fn network(inputs: NetworkInputs<FlexTensor>) -> FlexTensor {
        let NetworkInputs { points, tables, layers, shape } = inputs.map(values);
        let (points, width) = (rows(&points, &shape), shape.outputs());
        let network = Parameters { shape: &shape, weights: &Weights::new(&shape, &layers, false), tables: tables_of(&tables, &shape) };
        let mut out = vec![0.0; points.len() * width];
        predict(
            network,
            |sample| points[sample],
            false,
            &mut out,
            width,
            |tile, out| {
                for (out, outputs) in out.chunks_exact_mut(width).zip(&tile.outputs) {
                    out.copy_from_slice(&outputs[..width]);
                }
            },
        );
        FlexTensor::from_data(TensorData::new(out, [points.len(), width]))
    }

    fn network_backward(inputs: NetworkInputs<FlexTensor>, gradient: FlexTensor) -> [FlexTensor; 2] {
        let (table_shape, layer_shape) = (inputs.tables.shape(), inputs.layers.shape());
        let NetworkInputs { points, tables, layers, shape } = inputs.map(values);
        let (shape, gradient) = (&*shape, values(&gradient));
        let (points, width) = (rows(&points, shape), shape.outputs());
        let network = Parameters { shape, weights: &Weights::new(shape, &layers, true), tables: tables_of(&tables, shape) };
        let given = |first: usize, tile: &mut Tile| {
            for (d_outputs, gradient) in tile.d_outputs[..tile.count].iter_mut().zip(gradient[first * width..].chunks_exact(width)) {
                d_outputs[..width].copy_from_slice(gradient);
            }
            0.0
        };
        let mut batch = Batch::new(shape, points.len(), false);
        batch.accumulate(network, points.len(), |_| {}, |sample| points[sample], given);
        let mut d_layers = vec![0.0; layers.len()];
        batch.layer_gradient(shape, &mut d_layers);
        let mut d_tables = vec![0.0; tables.len()];
        let mut corners = Corners::new(shape);
        for (number, level) in shape.levels.iter().enumerate() {
            let table = &mut d_tables[level.offset * shape.features..][..level.entries * shape.features];
            let mut touched = vec![0; table.len().div_ceil(LINE)];
            batch.table_gradient(shape, number, &mut corners, table, &mut touched);
        }
        [(d_tables, table_shape), (d_layers, layer_shape)].map(|(values, shape)| FlexTensor::from_data(TensorData::new(values, shape)))
    }
}

#[derive(Debug)]
struct NetworkBackward;

impl<B: FusedNetwork> Backward<B, 2> for NetworkBackward {
    type State = NetworkInputs<FloatTensor<B>>;

    fn backward(self, ops: Ops<Self::State, 2>, gradients: &mut Gradients, _: &mut Checkpointer) {
        let gradient = gradients.consume::<B>(&ops.node);
        for (node, gradient) in ops.parents.into_iter().zip(B::network_backward(ops.state, gradient)) {
            if let Some(node) = node {
                gradients.register::<B>(node.id, gradient);
            }
        }
    }
}

impl<B: FusedNetwork, C: CheckpointStrategy> FusedNetwork for Autodiff<B, C> {
    fn network(inputs: NetworkInputs<FloatTensor<Self>>) -> FloatTensor<Self> {
        let parents = [inputs.tables.node.clone(), inputs.layers.node.clone()];
        let inputs = inputs.map(|tensor| tensor.primitive.clone());
        let outputs = B::network(inputs.clone());
        match NetworkBackward.prepare::<C>(parents).compute_bound().stateful() {
            OpsKind::Tracked(preparation) => preparation.finish(inputs, outputs),
            OpsKind::UnTracked(preparation) => preparation.finish(outputs),
        }
    }

    fn network_backward(inputs: NetworkInputs<FloatTensor<Self>>, gradient: FloatTensor<Self>) -> [FloatTensor<Self>; 2] {
        // The operation has no second derivatives: the results are constants.
        B::network_backward(inputs.map(|tensor| tensor.primitive.clone()), gradient.primitive).map(|primitive| {
            Tensor::<Self, 1>::from_inner(Tensor::from_primitive(TensorPrimitive::Float(primitive))).into_primitive().tensor()
        })
    }
}
