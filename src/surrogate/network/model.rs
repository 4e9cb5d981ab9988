//! A network with its optimizer state, and the loan of burn's buffers to the fused kernels.

use super::architecture::Architecture;
use super::module::Network;
use burn::backend::{Flex, flex::FlexTensor};
use burn::module::{Param, ParamId, ParamMapper};
use burn::optim::{AdamState, AdaptiveMomentumState};
use burn::tensor::{Tensor, TensorData, TensorPrimitive};

/// Parameters, Adam's moments as burn keeps them, and the number of steps taken.
#[derive(Clone)]
pub struct Model {
    /// Shape of the network.
    pub shape: Architecture,
    /// Parameters.
    pub module: Network<Flex>,
    /// Adam's state for the tables; `None` before the first step and for the frequency encoding.
    pub table_moments: Option<AdamState<Flex, 2>>,
    /// Adam's state for the layers; `None` before the first step.
    pub layer_moments: Option<AdamState<Flex, 1>>,
    /// Adam's epsilon.
    pub epsilon: f32,
}

impl Model {
    /// Fresh parameters (see [`Network::new`]).
    pub fn new(shape: Architecture, seed: u64, zero_output: bool) -> Self {
        // The gradients of tables are far below burn's default epsilon of 1e-5; 1e-15 is that of Müller et al. 2022.
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
        self.module.tables.as_ref().map_or_else(Vec::new, |tables| primitive(tables.val()).storage().to_vec())
    }

    /// The layers' values.
    pub fn layers(&self) -> Vec<f32> {
        primitive(self.module.layers.val()).storage().to_vec()
    }

    /// Parameters, first and second moments of tables and layers; moments are 0 before the first step.
    pub fn state(&self) -> [[Vec<f32>; 3]; 2] {
        let lengths = [self.shape.table_entries() * self.shape.features, self.shape.layer_parameters()];
        let mut state = lengths.map(|len| [(); 3].map(|()| vec![0.0; len]));
        self.copy_state(&mut state);
        state
    }

    /// Copies the state into the result of an earlier [`Model::state`].
    pub fn copy_state(&self, [tables, layers]: &mut [[Vec<f32>; 3]; 2]) {
        if let Some(parameter) = &self.module.tables {
            copy(parameter.val(), self.table_moments.as_ref(), tables);
        }
        copy(self.module.layers.val(), self.layer_moments.as_ref(), layers);
    }

    /// Sets the result of [`Model::state`] after `steps` steps. Lengths must be those of the shape.
    pub fn set_state(&mut self, [tables, layers]: [[Vec<f32>; 3]; 2], steps: usize) {
        if let Some(parameter) = self.module.tables.take() {
            let (values, moments) = from_values(tables, [self.shape.table_entries(), self.shape.features], steps);
            self.module.tables = Some(Param::initialized(parameter.id, values));
            self.table_moments = moments;
        }
        let (values, moments) = from_values(layers, [self.shape.layer_parameters()], steps);
        self.module.layers = Param::initialized(self.module.layers.id, values);
        self.layer_moments = moments;
    }

    /// Sets the output layer and its moments to 0.
    pub fn zero_output(&mut self) {
        let output = self.shape.output_layer();
        let range = output.weights..output.biases + output.outputs;
        let mut buffers = self.lend();
        for buffer in buffers.layers.slices() {
            buffer[range.clone()].fill(0.0);
        }
        buffers.give_back(self);
    }

    /// Takes all buffers out of the module and the moments until [`ModelBuffers::give_back`]. Copies only shared tensors.
    pub(super) fn lend(&mut self) -> ModelBuffers {
        let tables = self.module.tables.take().map(|parameter| ParameterBuffers::new(parameter, self.table_moments.take()));
        // burn's module cannot be without layers: a tensor that nothing reads stands in for them.
        let unread = Param::initialized(ParamId::from(0), Tensor::zeros([1], &Default::default()));
        let layers = std::mem::replace(&mut self.module.layers, unread);
        ModelBuffers { tables, layers: ParameterBuffers::new(layers, self.layer_moments.take()) }
    }
}

fn copy<const D: usize>(parameter: Tensor<Flex, D>, moments: Option<&AdamState<Flex, D>>, to: &mut [Vec<f32>; 3]) {
    let moments = moments.map(|state| [state.momentum.moment_1.clone(), state.momentum.moment_2.clone()]);
    for (to, tensor) in to.iter_mut().zip([parameter].into_iter().chain(moments.into_iter().flatten())) {
        to.copy_from_slice(primitive(tensor).storage());
    }
}

/// The contiguous tensor of exactly the values.
fn primitive<const D: usize>(tensor: Tensor<Flex, D>) -> FlexTensor {
    // Parameters are contiguous; only a view, which burn's own operations may leave, is copied.
    let tensor = tensor.into_primitive().tensor();
    if tensor.as_slice::<f32>().is_some_and(|values| values.len() == tensor.storage::<f32>().len()) {
        tensor
    } else {
        tensor.to_contiguous()
    }
}

fn from_values<const D: usize>(values: [Vec<f32>; 3], shape: [usize; D], steps: usize) -> (Tensor<Flex, D>, Option<AdamState<Flex, D>>) {
    let [values, first, second] = values.map(|values| Tensor::from_data(TensorData::new(values, shape), &Default::default()));
    (values, (steps > 0).then(|| AdamState::new(AdaptiveMomentumState::new(steps, first, second))))
}

fn tensor<const D: usize>(primitive: FlexTensor) -> Tensor<Flex, D> {
    Tensor::from_primitive(TensorPrimitive::Float(primitive))
}

/// One parameter and its two moments, as raw tensors.
pub(super) struct ParameterBuffers<const D: usize> {
    id: ParamId,
    mapper: ParamMapper<Tensor<Flex, D>>,
    parameter: FlexTensor,
    first: FlexTensor,
    second: FlexTensor,
    /// Steps that the moments have seen.
    pub(super) time: usize,
}

impl<const D: usize> ParameterBuffers<D> {
    fn new(parameter: Param<Tensor<Flex, D>>, moments: Option<AdamState<Flex, D>>) -> Self {
        let (id, value, mapper) = parameter.consume();
        let (first, second, time) = match moments {
            Some(state) => (state.momentum.moment_1, state.momentum.moment_2, state.momentum.time),
            None => (value.zeros_like(), value.zeros_like(), 0),
        };
        Self { id, mapper, parameter: primitive(value), first: primitive(first), second: primitive(second), time }
    }

    /// Parameters, first and second moments.
    pub(super) fn slices(&mut self) -> [&mut [f32]; 3] {
        [self.parameter.storage_mut(), self.first.storage_mut(), self.second.storage_mut()]
    }

    /// Parameters.
    pub(super) fn parameters(&self) -> &[f32] {
        self.parameter.storage()
    }

    fn give_back(self) -> (Param<Tensor<Flex, D>>, Option<AdamState<Flex, D>>) {
        let parameter = Param::from_mapped_value(self.id, tensor(self.parameter), self.mapper);
        let moments = AdaptiveMomentumState::new(self.time, tensor(self.first), tensor(self.second));
        (parameter, (self.time > 0).then(|| AdamState::new(moments)))
    }
}

/// The buffers of a [`Model`] while the fused kernels work in them.
pub(super) struct ModelBuffers {
    pub(super) tables: Option<ParameterBuffers<2>>,
    pub(super) layers: ParameterBuffers<1>,
}

impl ModelBuffers {
    /// Returns the buffers to burn.
    pub(super) fn give_back(self, model: &mut Model) {
        if let Some(tables) = self.tables {
            let (parameter, moments) = tables.give_back();
            model.module.tables = Some(parameter);
            model.table_moments = moments;
        }
        (model.module.layers, model.layer_moments) = self.layers.give_back();
    }
}
