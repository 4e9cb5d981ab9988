//! Networks too wide or too deep for a warp's registers: a block takes a tile of samples through all layers, and weight gradients are products
//! over all samples. See `kernels/network/network_batched.cu`.

use crate::cuda::driver::Resident;
use crate::cuda::network::layout::{DrawArgument, GridArgument, ReadingArgument};
use crate::cuda::network::network::{LossTerms, TangentTerm};
use crate::cuda::{Buffer, DeviceError, Gpu, launch, threads};
use cudarc::driver::{CudaFunction, LaunchConfig, PushKernelArg};
use ridgewatch_surrogate::network::{Architecture, Target};
use std::ops::Range;
use std::sync::{Arc, Mutex, PoisonError};

/// `DEPTH`, `THREADS`, `PANEL` and `SKEW` of `network_batched.cu`.
const DEPTH: usize = 32;
const THREADS: u32 = 256;
const PANEL: usize = 128;
const SKEW: usize = 8;
/// Maximum number of neurons of a pass.
const MAX_PASS_WIDTH: usize = 256;
/// Samples of a tile, and slices of the layers in shared memory or in flight. The first pair that fits is used.
const TILINGS: [(usize, usize); 3] = [(128, 4), (64, 4), (32, 3)];
/// Maximum number of values of a tile whose sums a block's registers hold.
const MAX_TILE_VALUES: usize = 1 << 16;
/// Maximum number of samples in memory during training, and of values and of gradients of all their layers, tangents included.
const MAX_TRAINING_ROWS: usize = 1 << 16;
const MAX_TRAINING_VALUES: usize = 1 << 30;

/// Division of samples and layers into tiles and slices by `network_batched.cu`, for one architecture and size of shared memory.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Tiling {
    rows: usize,
    stages: usize,
    /// Passes over a layer, and neurons of each.
    passes: usize,
    columns: usize,
    /// Values of an encoded point in whole slices, and passes over them in backpropagation.
    encoded: usize,
    encoded_passes: usize,
    /// Shared memory of a tile, and of a product.
    tile_bytes: usize,
    product_bytes: usize,
}

impl Tiling {
    /// `None` if the smallest tile does not fit into `shared_memory` bytes.
    pub fn of(shape: &Architecture, shared_memory: usize) -> Option<Self> {
        let width = shape.layers[0].outputs;
        let passes = width.div_ceil(MAX_PASS_WIDTH);
        let columns = width.next_multiple_of(64 * passes) / passes;
        let encoded_passes = shape.encoded().div_ceil(columns);
        let row = passes.max(encoded_passes) * columns;
        let slice = 2 * DEPTH * (columns + SKEW);
        let levels = GridArgument::level_bytes(shape.inputs()) * shape.levels.len().max(1);
        // Places and targets of a sample, and slopes.
        let sample = 4 * (shape.inputs().max(3) + 2 * shape.outputs());
        let all = TILINGS.map(|(rows, stages)| Self {
            rows,
            stages,
            passes,
            columns,
            encoded: shape.encoded().next_multiple_of(DEPTH),
            encoded_passes,
            tile_bytes: (2 * rows * (row + SKEW) + stages * slice + sample * rows + levels).next_multiple_of(16),
            product_bytes: stages * (2 * DEPTH * (PANEL + SKEW) + slice),
        });
        all.into_iter().find(|t| t.rows * row <= MAX_TILE_VALUES && t.tile_bytes.max(t.product_bytes) <= shared_memory)
    }

    /// Macros of `network_batched.cu` in addition to those of all networks.
    pub fn defines(&self) -> [String; 4] {
        let Self { rows, stages, tile_bytes, product_bytes, .. } = self;
        [
            format!("RW_ROWS={rows}"),
            format!("RW_STAGES={stages}"),
            format!("RW_TILE_BYTES={tile_bytes}"),
            format!("RW_PRODUCT_BYTES={product_bytes}"),
        ]
    }

    /// Values of a hidden layer, in whole passes.
    fn width(&self) -> usize {
        self.passes * self.columns
    }

    /// Number of values of the slices for prediction, and for training.
    fn slices(&self, hidden: usize, tables: bool) -> [usize; 2] {
        let others = (hidden - 1) * self.width();
        let forward = (self.encoded + others) * self.width();
        let back = if tables { self.encoded_passes * self.columns } else { 0 };
        [forward, forward + (others + back) * self.width()]
    }

    /// Words of the ReLU's bits of a tile in `layers` layers.
    fn passed(&self, layers: usize) -> usize {
        layers * self.passes * (self.rows / 32) * THREADS as usize
    }
}

/// The kernels and the memory between them.
#[derive(Debug)]
pub(super) struct Batched {
    gpu: Arc<Gpu>,
    grid: GridArgument,
    tiling: Tiling,
    /// Inputs of the first layer, neurons, and number of the hidden ones.
    inputs: usize,
    neurons: usize,
    hidden: usize,
    /// First value of the head in the flat vector.
    head: usize,
    tables: bool,
    flow_map: bool,
    /// Groups of rows per sample in training: values, and tangents along each axis if the loss has derivatives.
    groups: usize,
    round: CudaFunction,
    predict: Resident,
    gradient: Resident,
    products: Resident,
    memory: Mutex<Memory>,
}

/// Allocated when first needed. Kernels of one stream use it in turn.
#[derive(Debug, Default)]
struct Memory {
    rounded: Option<Rounded>,
    /// ReLU bits, for the prediction of a flow map.
    passed: Option<Buffer<u32>>,
    training: Option<Training>,
}

/// The layers without the head: slices of weights, and padded biases.
#[derive(Debug)]
struct Rounded {
    slices: Buffer<u16>,
    biases: Buffer<f32>,
}

/// Returns the value, after creating it if there is none.
fn get_or_try_insert<T>(held: &mut Option<T>, create: impl FnOnce() -> Result<T, DeviceError>) -> Result<&T, DeviceError> {
    Ok(match held {
        Some(held) => held,
        None => held.insert(create()?),
    })
}

/// Results of the gradient kernel for `rows` rows of values and tangents.
#[derive(Debug)]
struct Training {
    rows: usize,
    encoded: Buffer<u16>,
    /// Of each hidden layer.
    values: Buffer<u16>,
    deltas: Buffer<u16>,
    passed: Buffer<u32>,
}

/// Device addresses to which a gradient is added: tables (padded), layers (flat), and the loss.
#[derive(Debug, Clone, Copy)]
pub(super) struct GradientTo {
    pub(super) tables: u64,
    pub(super) layers: u64,
    pub(super) loss: u64,
}

impl Batched {
    /// Compiles the kernels. `defines`: macros of all networks for a loss of these terms.
    pub(super) fn new(
        gpu: &Arc<Gpu>,
        shape: &Architecture,
        grid: GridArgument,
        (defines, terms): (&[String], LossTerms),
        tiling: Tiling,
    ) -> Result<Self, DeviceError> {
        let defines: Vec<String> = defines.iter().cloned().chain(tiling.defines()).collect();
        let kernel = |name| gpu.kernel("network_batched.cu", &defines, name);
        let resident = |name, shared| Resident::new(gpu, kernel(name)?, THREADS, shared);
        let (head, hidden) = (&shape.layers[shape.layers.len() - 1], shape.layers.len() - 1);
        Ok(Self {
            grid,
            tiling,
            inputs: shape.encoded(),
            neurons: head.inputs,
            hidden,
            head: head.weights,
            tables: !shape.levels.is_empty(),
            flow_map: shape.target == Target::FlowMap,
            groups: if terms.derivatives { 1 + shape.dimensions() } else { 1 },
            round: kernel("batched_slices")?,
            predict: resident("batched_predict", tiling.tile_bytes)?,
            gradient: resident("batched_gradient", tiling.tile_bytes)?,
            products: resident("batched_products", tiling.product_bytes)?,
            memory: Mutex::default(),
            gpu: gpu.clone(),
        })
    }

    /// Allocates the memory for predictions and for gradients.
    pub(super) fn reserve(&self) -> Result<(), DeviceError> {
        let mut memory = self.memory.lock().unwrap_or_else(PoisonError::into_inner);
        self.for_predictions(&mut memory)?;
        self.for_gradients(&mut memory)?;
        Ok(())
    }

    /// Memory for predictions; ReLU bits for a flow map only.
    fn for_predictions<'a>(&self, memory: &'a mut Memory) -> Result<(&'a Rounded, Option<&'a Buffer<u32>>), DeviceError> {
        let Memory { rounded, passed, .. } = memory;
        if self.flow_map && passed.is_none() {
            *passed = Some(self.relu_bits(&self.predict, self.hidden)?);
        }
        Ok((get_or_try_insert(rounded, || self.alloc_rounded())?, passed.as_ref()))
    }

    /// Memory for gradients.
    fn for_gradients<'a>(&self, memory: &'a mut Memory) -> Result<(&'a Rounded, &'a Training), DeviceError> {
        let Memory { rounded, training, .. } = memory;
        Ok((get_or_try_insert(rounded, || self.alloc_rounded())?, get_or_try_insert(training, || self.alloc_training())?))
    }

    fn alloc_rounded(&self) -> Result<Rounded, DeviceError> {
        let [_, all] = self.tiling.slices(self.hidden, self.tables);
        let slices = self.gpu.alloc("a network's rounded layers", all)?;
        let biases = self.gpu.alloc("a network's padded biases", self.hidden * self.tiling.width())?;
        Ok(Rounded { slices, biases })
    }

    /// Rounds the layers (device address of the flat vector) into `count` values of the slices, and pads the biases. Returns the addresses of
    /// both.
    fn round(&self, rounded: &Rounded, layers: u64, count: usize) -> Result<(u64, u64), DeviceError> {
        let (n, slices, biases) = (count as u32, rounded.slices.address(), rounded.biases.address());
        let mut call = self.gpu.work().launch_builder(&self.round);
        call.arg(&layers).arg(&n).arg(&slices).arg(&biases);
        // SAFETY: the arguments of `batched_slices`; the flat vector is of this architecture.
        unsafe { launch(&mut call, threads(count, THREADS)) }?;
        Ok((slices, biases))
    }

    /// Log-stretch at `count` unit points.
    ///
    /// # Safety
    /// Device addresses: `halves` the padded tables, `layers` the flat vector of layers, `points` and `out` with `count` entries.
    pub(super) unsafe fn predict(
        &self,
        halves: u64,
        layers: u64,
        reading: &ReadingArgument,
        points: u64,
        count: usize,
        out: u64,
    ) -> Result<(), DeviceError> {
        let mut memory = self.memory.lock().unwrap_or_else(PoisonError::into_inner);
        let [forward, _] = self.tiling.slices(self.hidden, self.tables);
        let (rounded, passed) = self.for_predictions(&mut memory)?;
        let (slices, biases) = self.round(rounded, layers, forward)?;
        let (head, n, passed) = (layers + 4 * self.head as u64, count as u32, passed.map_or(0, Buffer::address));
        let mut call = self.gpu.work().launch_builder(&self.predict.function);
        call.arg(&self.grid).arg(&halves).arg(&slices).arg(&biases).arg(&head).arg(reading).arg(&points).arg(&n);
        call.arg(&passed).arg(&out);
        // SAFETY: as required of the caller; the arguments are those of `batched_predict`.
        unsafe { launch(&mut call, self.predict.config(count.div_ceil(self.tiling.rows))) }
    }

    /// Adds the gradient and the loss of a batch. `term`: tangents of a loss with derivatives.
    ///
    /// # Safety
    /// Device addresses as for [`Self::predict`] and in [`GradientTo`]; the samples of `draw` are there.
    pub(super) unsafe fn gradient(
        &self,
        halves: u64,
        layers: u64,
        draw: &DrawArgument,
        term: Option<TangentTerm>,
        to: GradientTo,
    ) -> Result<(), DeviceError> {
        let mut memory = self.memory.lock().unwrap_or_else(PoisonError::into_inner);
        let [_, all] = self.tiling.slices(self.hidden, self.tables);
        let (rounded, training) = self.for_gradients(&mut memory)?;
        let (slices, biases) = self.round(rounded, layers, all)?;
        let (encoded, values, deltas) = (training.encoded.address(), training.values.address(), training.deltas.address());
        let (head, held, passed) = (layers + 4 * self.head as u64, training.rows as u32, training.passed.address());
        let TangentTerm { step, factor } = term.unwrap_or(TangentTerm { step: 1.0, factor: 0.0 });
        let most = training.rows / self.groups / self.tiling.rows * self.tiling.rows;
        for first in (0..draw.batch as usize).step_by(most) {
            let rows = (draw.batch as usize - first).min(most).next_multiple_of(self.tiling.rows);
            let (n, first) = (rows as u32, first as u32);
            let mut call = self.gpu.work().launch_builder(&self.gradient.function);
            call.arg(&self.grid).arg(&halves).arg(&slices).arg(&biases).arg(&head).arg(draw).arg(&first).arg(&n).arg(&held);
            call.arg(&encoded).arg(&values).arg(&deltas).arg(&passed).arg(&to.tables).arg(&to.layers).arg(&to.loss);
            call.arg(&step).arg(&factor);
            // SAFETY: the arguments of `batched_gradient`; the memory holds `rows` rows of each group.
            unsafe { launch(&mut call, self.gradient.config(rows / self.tiling.rows)) }?;
            // SAFETY: the kernel above wrote these rows.
            unsafe { self.add_products(training, 0..rows, 1.0, to.layers) }?;
            if self.groups > 1 {
                // SAFETY: as above.
                unsafe { self.add_products(training, rows..self.groups * rows, factor, to.layers) }?;
            }
        }
        Ok(())
    }

    /// Adds `factor` times the weight gradients over a range of rows to the flat vector at `to`.
    ///
    /// # Safety
    /// `batched_gradient` has written these rows, and the flat vector is of this architecture.
    unsafe fn add_products(&self, training: &Training, range: Range<usize>, factor: f32, to: u64) -> Result<(), DeviceError> {
        let (rows, width) = (range.len(), self.tiling.width());
        let panels = |inputs: usize| inputs.div_ceil(PANEL) * self.tiling.passes;
        let tiles = panels(self.inputs) + (self.hidden - 1) * panels(self.neurons);
        // Four rounds of blocks keep most multiprocessors busy in the last one; each block has at least eight steps.
        let shares = (4 * self.products.blocks as usize / tiles).clamp(1, (rows / (8 * DEPTH)).max(1));
        let (n, held, share) = (rows as u32, training.rows as u32, rows.div_ceil(shares).next_multiple_of(DEPTH) as u32);
        let encoded = training.encoded.address_of(range.start * self.tiling.encoded);
        let (values, deltas) = (training.values.address_of(range.start * width), training.deltas.address_of(range.start * width));
        let config = LaunchConfig { grid_dim: (tiles as u32, shares as u32, 1), ..self.products.config(1) };
        let mut call = self.gpu.work().launch_builder(&self.products.function);
        call.arg(&encoded).arg(&values).arg(&deltas).arg(&n).arg(&held).arg(&share).arg(&to).arg(&factor);
        // SAFETY: the arguments of `batched_products`, with one block per share of a panel.
        unsafe { launch(&mut call, config) }
    }

    fn alloc_training(&self) -> Result<Training, DeviceError> {
        let (width, tile) = (self.tiling.width(), self.groups * self.tiling.rows);
        let rows = (MAX_TRAINING_VALUES / (2 * width * self.hidden)).clamp(tile, self.groups * MAX_TRAINING_ROWS) / tile * tile;
        let passed_layers = if self.groups > 1 { self.hidden } else { self.hidden - 1 };
        Ok(Training {
            rows,
            encoded: self.gpu.alloc("encoded samples", rows * self.tiling.encoded)?,
            values: self.gpu.alloc("the layers' values", self.hidden * rows * width)?,
            deltas: self.gpu.alloc("gradients of the layers' values", self.hidden * rows * width)?,
            passed: self.relu_bits(&self.gradient, passed_layers)?,
        })
    }

    /// Memory for the ReLU's bits of `layers` layers in all blocks of a kernel.
    fn relu_bits(&self, kernel: &Resident, layers: usize) -> Result<Buffer<u32>, DeviceError> {
        self.gpu.alloc("ReLU bits", kernel.blocks as usize * self.tiling.passed(layers))
    }
}
