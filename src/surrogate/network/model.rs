//! A network with its optimizer state, and burn's buffers lent to the fused kernels.

use super::architecture::Architecture;
use super::module::Network;
use burn::backend::{Flex, flex::FlexTensor};
use burn::module::{Param, ParamId, ParamMapper};
use burn::optim::{AdamState, AdaptiveMomentumState};
use burn::tensor::{Tensor, TensorData, TensorPrimitive};

/// Parameters, Adam's moments as burn keeps them, and the number of steps taken.
#[derive(Clone)]
pub struct Model {
    /// What is stored where.
    pub shape: Architecture,
    /// Parameters.
    pub module: Network<Flex>,
    /// Adam's state for the tables; none before the first step and for the frequency encoding.
    pub table_moments: Option<AdamState<Flex, 2>>,
    /// Adam's state for the layers; none before the first step.
    pub layer_moments: Option<AdamState<Flex, 1>>,
    /// Adam's epsilon.
    pub epsilon: f32,
}

impl Model {
    /// Fresh parameters. The tables' gradients are far below burn's default epsilon of 1e-5, so it is 1e-15 there.
    pub fn new(shape: Architecture, seed: u64, zero_output: bool) -> Self {
        let epsilon = if shape.levels.is_empty() { 1e-8 } else { 1e-15 };
        let module = Network::new(&shape, seed, zero_output, &Default::default());
        Self { shape, module, table_moments: None, layer_moments: None, epsilon }
    }

    /// Optimizer steps taken so far.
    pub fn steps(&self) -> usize {
        self.layer_moments.as_ref().map_or(0, |state| state.momentum.time)
    }

    /// The tables' values; empty for the frequency encoding.
    pub fn tables(&self) -> Vec<f32> {
        self.module.tables.as_ref().map_or_else(Vec::new, |tables| contents(&tables.val()))
    }

    /// The layers' values.
    pub fn layers(&self) -> Vec<f32> {
        contents(&self.module.layers.val())
    }

    /// Parameters, first and second moments of tables and layers; moments are 0 before the first step.
    pub(crate) fn state(&self) -> [[Vec<f32>; 3]; 2] {
        let zeros = |len: usize| vec![0.0; len];
        let tables = self.tables();
        let layers = self.layers();
        let [table_1, table_2] = match &self.table_moments {
            Some(state) => [contents(&state.momentum.moment_1), contents(&state.momentum.moment_2)],
            None => [zeros(tables.len()), zeros(tables.len())],
        };
        let [layer_1, layer_2] = match &self.layer_moments {
            Some(state) => [contents(&state.momentum.moment_1), contents(&state.momentum.moment_2)],
            None => [zeros(layers.len()), zeros(layers.len())],
        };
        [[tables, table_1, table_2], [layers, layer_1, layer_2]]
    }

    /// Copies what [`Model::state`] gives into buffers that it gave before.
    pub(crate) fn copy_state(&self, [tables, layers]: &mut [[Vec<f32>; 3]; 2]) {
        if let Some(parameter) = &self.module.tables {
            copy(&parameter.val(), self.table_moments.as_ref(), tables);
        }
        copy(&self.module.layers.val(), self.layer_moments.as_ref(), layers);
    }

    /// Sets what [`Model::state`] gave, after `steps` steps. Lengths must be those of the shape.
    pub(crate) fn set_state(&mut self, [tables, layers]: [[Vec<f32>; 3]; 2], steps: usize) {
        let shape = [self.shape.table_entries(), self.shape.features];
        if let Some(parameter) = self.module.tables.take() {
            let [values, first, second] = tables.map(|values| from_values::<2>(values, shape));
            self.module.tables = Some(Param::initialized(parameter.id, values));
            self.table_moments = (steps > 0).then(|| AdamState::new(AdaptiveMomentumState::new(steps, first, second)));
        }
        let shape = [self.shape.layer_parameters()];
        let [values, first, second] = layers.map(|values| from_values::<1>(values, shape));
        self.module.layers = Param::initialized(self.module.layers.id, values);
        self.layer_moments = (steps > 0).then(|| AdamState::new(AdaptiveMomentumState::new(steps, first, second)));
    }

    /// Sets the last layer and its moments to 0.
    pub fn zero_output(&mut self) {
        let head = &self.shape.layers[self.shape.layers.len() - 1];
        let range = head.weights..head.biases + head.outputs;
        let mut loan = self.lend();
        for buffer in loan.layers.buffers() {
            buffer[range.clone()].fill(0.0);
        }
        loan.back(self);
    }

    /// Takes every buffer out of the module and the moments; [`Loan::back`] returns them. No value is copied, unless a tensor is shared.
    pub(super) fn lend(&mut self) -> Loan {
        let tables = self.module.tables.take().map(|parameter| {
            let moments = self.table_moments.take();
            Lent::new(parameter, moments)
        });
        // burn's module cannot be without layers: while they are lent out it holds a tensor that nothing reads.
        let unread = Param::initialized(ParamId::from(0), Tensor::zeros([1], &Default::default()));
        let layers = std::mem::replace(&mut self.module.layers, unread);
        Loan { tables, layers: Lent::new(layers, self.layer_moments.take()) }
    }
}

pub(super) fn contents<const D: usize>(tensor: &Tensor<Flex, D>) -> Vec<f32> {
    let primitive = tensor.clone().into_primitive().tensor();
    primitive.to_contiguous().storage::<f32>().to_vec()
}

fn copy<const D: usize>(parameter: &Tensor<Flex, D>, moments: Option<&AdamState<Flex, D>>, to: &mut [Vec<f32>; 3]) {
    let mut part = |at: usize, tensor: &Tensor<Flex, D>| {
        let tensor = primitive(tensor.clone());
        to[at].copy_from_slice(tensor.storage());
    };
    part(0, parameter);
    if let Some(state) = moments {
        part(1, &state.momentum.moment_1);
        part(2, &state.momentum.moment_2);
    }
}

fn primitive<const D: usize>(tensor: Tensor<Flex, D>) -> FlexTensor {
    // Fresh parameters are contiguous; only a view (which burn's own operations may leave) is copied here.
    let tensor = tensor.into_primitive().tensor();
    if tensor.as_slice::<f32>().is_some_and(|values| values.len() == tensor.storage::<f32>().len()) {
        tensor
    } else {
        tensor.to_contiguous()
    }
}

fn from_values<const D: usize>(values: Vec<f32>, shape: [usize; D]) -> Tensor<Flex, D> {
    Tensor::from_data(TensorData::new(values, shape), &Default::default())
}

fn tensor<const D: usize>(primitive: FlexTensor) -> Tensor<Flex, D> {
    Tensor::from_primitive(TensorPrimitive::Float(primitive))
}

/// One parameter and its two moments, as raw tensors.
pub(super) struct Lent<const D: usize> {
    id: ParamId,
    mapper: ParamMapper<Tensor<Flex, D>>,
    parameter: FlexTensor,
    first: FlexTensor,
    second: FlexTensor,
    /// Steps that the moments have seen.
    pub(super) time: usize,
}

impl<const D: usize> Lent<D> {
    fn new(parameter: Param<Tensor<Flex, D>>, moments: Option<AdamState<Flex, D>>) -> Self {
        let (id, value, mapper) = parameter.consume();
        let (first, second, time) = match moments {
            Some(state) => (state.momentum.moment_1, state.momentum.moment_2, state.momentum.time),
            None => (value.zeros_like(), value.zeros_like(), 0),
        };
        Self { id, mapper, parameter: primitive(value), first: primitive(first), second: primitive(second), time }
    }

    /// Parameters, first and second moments.
    pub(super) fn buffers(&mut self) -> [&mut [f32]; 3] {
        [self.parameter.storage_mut(), self.first.storage_mut(), self.second.storage_mut()]
    }

    /// Parameters.
    pub(super) fn parameters(&self) -> &[f32] {
        self.parameter.storage()
    }

    fn back(self) -> (Param<Tensor<Flex, D>>, Option<AdamState<Flex, D>>) {
        let parameter = Param::from_mapped_value(self.id, tensor(self.parameter), self.mapper);
        let moments = AdaptiveMomentumState::new(self.time, tensor(self.first), tensor(self.second));
        (parameter, (self.time > 0).then(|| AdamState::new(moments)))
    }
}

/// The buffers of a [`Model`] while the fused kernels work in them.
pub(super) struct Loan {
    pub(super) tables: Option<Lent<2>>,
    pub(super) layers: Lent<1>,
}

impl Loan {
    /// Hands the buffers back to burn.
    pub(super) fn back(self, model: &mut Model) {
        if let Some(tables) = self.tables {
            let (parameter, moments) = tables.back();
            model.module.tables = Some(parameter);
            model.table_moments = moments;
        }
        (model.module.layers, model.layer_moments) = self.layers.back();
    }
}
