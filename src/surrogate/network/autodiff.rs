//! Training by burn's autodiff and burn's Adam: the reference for the fused kernels, with burn's stock operations or the fused operation.

use super::adam::{BETA_1, BETA_2};
use super::architecture::Architecture;
use super::model::Model;
use super::module::Network;
use super::objective::Objective;
use crate::Samples;
use burn::backend::{Autodiff, Flex};
use burn::module::{Param, ParamId};
use burn::optim::{AdamConfig, GradientsParams, SimpleOptimizer};
use burn::tensor::{Tensor, TensorData};
use std::sync::Arc;

type Differentiable = Autodiff<Flex>;

/// Takes one step by burn's stock operations on the first `count` samples. Returns the loss before it.
pub fn stock_step(model: &mut Model, objective: &Objective, samples: &Samples, count: usize, rate: f64) -> f64 {
    step(model, objective, samples, count, rate, |network, shape, points, derivatives| {
        if derivatives { network.forward_with_derivatives(shape, points) } else { vec![network.forward(shape, points)] }
    })
}

/// As [`stock_step`], by the fused operation. It has no derivatives along the axes, so flow maps are trained on arrivals alone.
pub fn operation_step(model: &mut Model, objective: &Objective, samples: &Samples, count: usize, rate: f64) -> f64 {
    let plain = Objective { jacobian_weight: 0.0, ..objective.clone() };
    step(model, &plain, samples, count, rate, |network, shape, points, _| vec![network.forward_fused(shape, points)])
}

/// Loss, module and gradients of the first `count` samples by burn's autodiff. `forward` evaluates the network at unit coordinates
/// `[samples, inputs]`; it returns the outputs and, if its last argument is true, their derivatives along each axis.
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
    if objective.penalty() != 0.0 {
        let linear = rows[0].clone().sign() * (rows[0].clone().abs().exp() - 1.0);
        let mean = samples.log_stretch[..count].iter().map(|&s| f64::from(s / objective.tau)).sum::<f64>() / count as f64;
        loss = loss + (linear.mean() - mean).powi_scalar(2) * objective.penalty();
    }
    let value = f64::from(loss.clone().into_scalar());
    let gradients = GradientsParams::from_grads(loss.backward(), &network);
    (value, network, gradients)
}

fn track<const D: usize>(id: ParamId, tensor: Tensor<Flex, D>) -> Param<Tensor<Differentiable, D>> {
    Param::initialized(id, Tensor::from_inner(tensor).require_grad())
}

fn step(
    model: &mut Model,
    objective: &Objective,
    samples: &Samples,
    count: usize,
    rate: f64,
    forward: impl Fn(&Network<Differentiable>, &Arc<Architecture>, Tensor<Differentiable, 2>, bool) -> Vec<Tensor<Differentiable, 2>>,
) -> f64 {
    let (loss, _, mut gradients) = autodiff_gradient(model, objective, samples, count, forward);
    let adam = AdamConfig::new().with_beta_1(BETA_1).with_beta_2(BETA_2).with_epsilon(model.epsilon).build();
    if let Some(parameter) = model.module.tables.take() {
        let (id, value, mapper) = parameter.consume();
        let gradient = gradients.remove::<Flex, 2>(id).unwrap_or_else(|| value.zeros_like());
        let (value, state) = SimpleOptimizer::<Flex>::step(&adam, rate, value, gradient, model.table_moments.take());
        model.module.tables = Some(Param::from_mapped_value(id, value, mapper));
        model.table_moments = state;
    }
    let (id, value) = (model.module.layers.id, model.module.layers.val());
    let gradient = gradients.remove::<Flex, 1>(id).unwrap_or_else(|| value.zeros_like());
    let (value, state) = SimpleOptimizer::<Flex>::step(&adam, rate, value, gradient, model.layer_moments.take());
    model.module.layers = Param::initialized(id, value);
    model.layer_moments = state;
    loss
}
