//! Encoding and MLP as one differentiable burn operation, for any burn training code on the CPU.
//!
//! ```
//! use burn::backend::{Autodiff, Flex};
//! use burn::tensor::Tensor;
//! use ridgewatch::surrogate::network::{Architecture, FusedNetwork, Network, NetworkSettings};
//! use std::sync::Arc;
//!
//! type B = Autodiff<Flex>;
//! let settings = NetworkSettings { levels: 4, log2_table: 8, width: 16, ..NetworkSettings::default() };
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

/// Backend with the fused network.
pub trait FusedNetwork: Backend {
    /// Outputs `[samples, outputs]` at `points` `[samples, inputs]`. `tables` is `[entries, features]` (any value for the frequency
    /// encoding), `layers` the flat vector. The points are data and get no gradient.
    fn network(
        points: FloatTensor<Self>,
        tables: FloatTensor<Self>,
        layers: FloatTensor<Self>,
        shape: &Arc<Architecture>,
    ) -> FloatTensor<Self>;

    /// Gradients for `tables` and `layers`, from the gradient for the outputs. The forward pass is repeated, since its activations would take
    /// hundreds of bytes a sample.
    fn network_backward(
        points: FloatTensor<Self>,
        tables: FloatTensor<Self>,
        layers: FloatTensor<Self>,
        gradient: FloatTensor<Self>,
        shape: &Arc<Architecture>,
    ) -> (FloatTensor<Self>, FloatTensor<Self>);
}

impl<B: FusedNetwork> Network<B> {
    /// [`Network::forward`] as one operation.
    pub fn forward_fused(&self, shape: &Arc<Architecture>, points: Tensor<B, 2>) -> Tensor<B, 2> {
        let device = points.device();
        let tables = self.tables.as_ref().map_or_else(|| Tensor::zeros([1, 1], &device), |tables| tables.val());
        let float = |primitive: TensorPrimitive<B>| primitive.tensor();
        let outputs =
            B::network(float(points.into_primitive()), float(tables.into_primitive()), float(self.layers.val().into_primitive()), shape);
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
    fn network(points: FlexTensor, tables: FlexTensor, layers: FlexTensor, shape: &Arc<Architecture>) -> FlexTensor {
        let (points, tables, layers) = (values(&points), values(&tables), values(&layers));
        let (points, width) = (rows(&points, shape), shape.outputs());
        let network = Parameters { shape, weights: &Weights::new(shape, &layers, false), tables: tables_of(&tables, shape) };
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

    fn network_backward(
        points: FlexTensor,
        tables: FlexTensor,
        layers: FlexTensor,
        gradient: FlexTensor,
        shape: &Arc<Architecture>,
    ) -> (FlexTensor, FlexTensor) {
        let (table_shape, layer_shape) = (tables.shape(), layers.shape());
        let (points, tables, layers, gradient) = (values(&points), values(&tables), values(&layers), values(&gradient));
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
        (FlexTensor::from_data(TensorData::new(d_tables, table_shape)), FlexTensor::from_data(TensorData::new(d_layers, layer_shape)))
    }
}

/// State of the backward pass.
#[derive(Debug, Clone)]
struct Inputs<P> {
    points: P,
    tables: P,
    layers: P,
    shape: Arc<Architecture>,
}

#[derive(Debug)]
struct NetworkBackward;

impl<B: FusedNetwork> Backward<B, 2> for NetworkBackward {
    type State = Inputs<FloatTensor<B>>;

    fn backward(self, ops: Ops<Self::State, 2>, gradients: &mut Gradients, _: &mut Checkpointer) {
        let [tables, layers] = ops.parents;
        let gradient = gradients.consume::<B>(&ops.node);
        let Inputs { points, tables: table_values, layers: layer_values, shape } = ops.state;
        let (d_tables, d_layers) = B::network_backward(points, table_values, layer_values, gradient, &shape);
        if let Some(node) = tables {
            gradients.register::<B>(node.id, d_tables);
        }
        if let Some(node) = layers {
            gradients.register::<B>(node.id, d_layers);
        }
    }
}

impl<B: FusedNetwork, C: CheckpointStrategy> FusedNetwork for Autodiff<B, C> {
    fn network(
        points: FloatTensor<Self>,
        tables: FloatTensor<Self>,
        layers: FloatTensor<Self>,
        shape: &Arc<Architecture>,
    ) -> FloatTensor<Self> {
        let outputs = B::network(points.primitive.clone(), tables.primitive.clone(), layers.primitive.clone(), shape);
        match NetworkBackward.prepare::<C>([tables.node.clone(), layers.node.clone()]).compute_bound().stateful() {
            OpsKind::Tracked(preparation) => {
                let state =
                    Inputs { points: points.primitive, tables: tables.primitive, layers: layers.primitive, shape: Arc::clone(shape) };
                preparation.finish(state, outputs)
            }
            OpsKind::UnTracked(preparation) => preparation.finish(outputs),
        }
    }

    fn network_backward(
        points: FloatTensor<Self>,
        tables: FloatTensor<Self>,
        layers: FloatTensor<Self>,
        gradient: FloatTensor<Self>,
        shape: &Arc<Architecture>,
    ) -> (FloatTensor<Self>, FloatTensor<Self>) {
        // The operation has no second derivatives: the results are constants.
        let (tables, layers) = B::network_backward(points.primitive, tables.primitive, layers.primitive, gradient.primitive, shape);
        let constant = |primitive| Tensor::<Self, 1>::from_inner(Tensor::from_primitive(TensorPrimitive::Float(primitive)));
        (constant(tables).into_primitive().tensor(), constant(layers).into_primitive().tensor())
    }
}
