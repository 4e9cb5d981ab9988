//! Networks too wide or too deep for a warp's registers: a batch goes through them layer by layer, one product of matrices each, in parts
//! whose values the device's cache (prediction) or a bounded piece of its memory (training) holds. See `kernels/network_batched.cu`.

use super::network_layout::{DrawArgument, GridArgument, ReadingArgument};
use super::{Buffer, DeviceError, Gpu, launch, threads};
use crate::surrogate::network::Architecture;
use cudarc::driver::sys::CUfunction_attribute as Function;
use cudarc::driver::{CudaFunction, LaunchConfig, PushKernelArg};
use std::sync::{Arc, Mutex, PoisonError};

/// `TILE`, `DEPTH`, `THREADS` and `HEAD_ROWS` of `network_batched.cu`.
const TILE: usize = 128;
const DEPTH: usize = 64;
const THREADS: u32 = 256;
const HEAD_ROWS: usize = 64;
/// Shared memory of a stage of a product: two panels of 128 rows of 64 halves, and 8 that spread them over the banks.
const STAGE_BYTES: usize = 2 * TILE * (DEPTH + 8) * 2;
/// Stages, at most and at least: where there is room for three of two blocks, more is on the way while the rest is multiplied.
const STAGES: usize = 3;
const FEWEST_STAGES: usize = 2;
/// Values of a layer that prediction holds at once: two layers of them stay in the cache.
const PREDICTED: usize = 1 << 23;
/// Samples, and values of all layers, that training holds at once.
const TRAINED_ROWS: usize = 1 << 16;
const TRAINED: usize = 1 << 30;

/// Macros of `network_batched.cu` beside those of all networks, each way that it is compiled.
pub fn batched_defines() -> [[String; 2]; 2] {
    [STAGES, FEWEST_STAGES].map(|stages| [format!("RW_STAGES={stages}"), format!("RW_PRODUCT_BYTES={}", stages * STAGE_BYTES)])
}

/// The kernels, and memory between them.
#[derive(Debug)]
pub(super) struct Batched {
    gpu: Arc<Gpu>,
    grid: GridArgument,
    /// Values of an encoded point and of a hidden layer, in whole tiles.
    encoded: usize,
    width: usize,
    /// What of an encoded point is summed up.
    encoded_depth: usize,
    /// Inputs, first weight and first bias of each layer, the head last.
    layers: Vec<(usize, usize, usize)>,
    encode_points: CudaFunction,
    encode_samples: CudaFunction,
    round: CudaFunction,
    forward: CudaFunction,
    backward: CudaFunction,
    products: CudaFunction,
    answer: CudaFunction,
    head: CudaFunction,
    /// Where there are tables: the gradient with respect to encoded points, and its way to them.
    tables: Option<[CudaFunction; 2]>,
    /// Bytes of shared memory.
    product_shared: usize,
    memory: Mutex<Memory>,
}

/// Taken when first needed. Kernels of one stream use it in turn.
#[derive(Debug, Default)]
struct Memory {
    /// The layers but for the head, rounded and padded.
    weights: Option<Buffer<u16>>,
    predicting: Option<Predicting>,
    training: Option<Training>,
}

#[derive(Debug)]
struct Predicting {
    rows: usize,
    encoded: Buffer<u16>,
    values: [Buffer<u16>; 2],
}

#[derive(Debug)]
struct Training {
    rows: usize,
    encoded: Buffer<u16>,
    /// Of each hidden layer.
    values: Vec<Buffer<u16>>,
    deltas: [Buffer<u16>; 2],
    encoded_delta: Option<Buffer<u16>>,
    targets: Buffer<f32>,
}

/// Where a gradient is added to, as device addresses: tables (padded), layers (flat), and the loss.
#[derive(Debug, Clone, Copy)]
pub(super) struct GradientTo {
    pub(super) tables: u64,
    pub(super) layers: u64,
    pub(super) loss: u64,
}

impl Batched {
    pub(super) fn new(gpu: &Arc<Gpu>, shape: &Architecture, grid: GridArgument, defines: &[String]) -> Result<Self, DeviceError> {
        let doing = DeviceError::driver("asking for shared memory");
        let [more, fewer] = batched_defines();
        let (stages, chosen) = if gpu.shared_memory() >= STAGES * STAGE_BYTES { (STAGES, more) } else { (FEWEST_STAGES, fewer) };
        let product_shared = stages * STAGE_BYTES;
        let defines: Vec<String> = defines.iter().cloned().chain(chosen).collect();
        let kernel = |name| gpu.kernel("network_batched.cu", &defines, name);
        let product = |name| {
            let function = kernel(name)?;
            function.set_attribute(Function::CU_FUNC_ATTRIBUTE_MAX_DYNAMIC_SHARED_SIZE_BYTES, product_shared as i32).map_err(&doing)?;
            Ok::<_, DeviceError>(function)
        };
        let tables = match shape.levels.is_empty() {
            true => None,
            false => Some([product("batched_backward_encoded")?, kernel("batched_scatter")?]),
        };
        Ok(Self {
            grid,
            encoded: shape.encoded().next_multiple_of(TILE),
            width: shape.layers[0].outputs.next_multiple_of(TILE),
            encoded_depth: shape.encoded().next_multiple_of(DEPTH),
            layers: shape.layers.iter().map(|layer| (layer.inputs, layer.weights, layer.biases)).collect(),
            encode_points: kernel("batched_encode_points")?,
            encode_samples: kernel("batched_encode_samples")?,
            round: kernel("batched_weights")?,
            forward: product("batched_forward")?,
            backward: product("batched_backward")?,
            products: product("batched_products")?,
            answer: kernel("batched_answer")?,
            head: kernel("batched_head")?,
            tables,
            product_shared,
            memory: Mutex::default(),
            gpu: gpu.clone(),
        })
    }

    /// Hidden layers.
    fn hidden(&self) -> usize {
        self.layers.len() - 1
    }

    /// First value of a layer's rounded weights.
    fn rounded_start(&self, layer: usize) -> usize {
        if layer == 0 { 0 } else { (self.encoded + (layer - 1) * self.width) * self.width }
    }

    /// Values of a row that goes into a layer, and how many of them are summed up.
    fn row(&self, layer: usize) -> (u32, u32) {
        let (row, depth) = if layer == 0 { (self.encoded, self.encoded_depth) } else { (self.width, self.width) };
        (row as u32, depth as u32)
    }

    fn product(&self, columns: usize, rows: usize, shares: usize) -> LaunchConfig {
        let grid_dim = ((columns / TILE) as u32, (rows / TILE) as u32, shares as u32);
        LaunchConfig { grid_dim, block_dim: (THREADS, 1, 1), shared_mem_bytes: self.product_shared as u32 }
    }

    fn values(&self, what: &str, count: usize) -> Result<Buffer<u16>, DeviceError> {
        self.gpu.alloc(what, count)
    }

    /// Rounds the layers (device address of the flat vector); the address of what came out.
    fn rounded(&self, held: &mut Option<Buffer<u16>>, layers: u64) -> Result<u64, DeviceError> {
        let count = self.rounded_start(self.hidden());
        if held.is_none() {
            *held = Some(self.values("a network's rounded layers", count)?);
        }
        let to = held.as_ref().map_or(0, Buffer::address);
        let n = count as u64;
        let mut call = self.gpu.work().launch_builder(&self.round);
        call.arg(&layers).arg(&n).arg(&to);
        // SAFETY: the arguments of `batched_weights`; the flat vector is of this architecture.
        unsafe { launch(&mut call, threads(count, THREADS)) }?;
        Ok(to)
    }

    /// Values of a hidden layer from those before it, for `rows` samples.
    ///
    /// # Safety
    /// The memory at these addresses holds as many rows; `layers` is the flat vector.
    unsafe fn layer_forward(&self, layer: usize, rows: usize, from: u64, weights: u64, layers: u64, to: u64) -> Result<(), DeviceError> {
        let (row, depth) = self.row(layer);
        let (weights, biases) = (weights + 2 * self.rounded_start(layer) as u64, layers + 4 * self.layers[layer].2 as u64);
        let mut call = self.gpu.work().launch_builder(&self.forward);
        call.arg(&from).arg(&row).arg(&depth).arg(&weights).arg(&biases).arg(&to);
        // SAFETY: the arguments of `batched_forward`.
        unsafe { launch(&mut call, self.product(self.width, rows, 1)) }
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
        let Memory { weights, predicting, .. } = &mut *memory;
        let weights = self.rounded(weights, layers)?;
        if predicting.is_none() {
            let rows = (PREDICTED / self.width).next_multiple_of(TILE);
            let values = || self.values("a layer's values", rows * self.width);
            let encoded = self.values("encoded points", rows * self.encoded)?;
            *predicting = Some(Predicting { rows, encoded, values: [values()?, values()?] });
        }
        let Some(Predicting { rows: most, encoded, values }) = predicting else { return Ok(()) };
        let stream = self.gpu.work();
        let head = layers + 4 * self.layers[self.hidden()].1 as u64;
        for first in (0..count).step_by(*most) {
            let part = (count - first).min(*most);
            let rows = part.next_multiple_of(TILE);
            let (n, at, to) = (part as u32, points + 12 * first as u64, out + 4 * first as u64);
            let encoded = encoded.address();
            let mut call = stream.launch_builder(&self.encode_points);
            call.arg(&self.grid).arg(&halves).arg(reading).arg(&at).arg(&n).arg(&encoded);
            // SAFETY: the arguments of `batched_encode_points`, a thread two columns.
            unsafe { launch(&mut call, threads(rows * self.encoded / 2, THREADS)) }?;
            let mut from = encoded;
            for layer in 0..self.hidden() {
                let to = values[layer % 2].address();
                // SAFETY: both hold `rows` rows.
                unsafe { self.layer_forward(layer, rows, from, weights, layers, to) }?;
                from = to;
            }
            let mut call = stream.launch_builder(&self.answer);
            call.arg(&from).arg(&head).arg(reading).arg(&at).arg(&n).arg(&to);
            // SAFETY: the arguments of `batched_answer`, a warp a row.
            unsafe { launch(&mut call, threads(32 * part, THREADS)) }?;
        }
        Ok(())
    }

    /// Adds the gradient and the loss of a batch.
    ///
    /// # Safety
    /// Device addresses as for [`Self::predict`] and in [`GradientTo`]; the samples of `draw` are there.
    pub(super) unsafe fn gradient(&self, halves: u64, layers: u64, draw: &DrawArgument, to: GradientTo) -> Result<(), DeviceError> {
        let mut memory = self.memory.lock().unwrap_or_else(PoisonError::into_inner);
        let Memory { weights, training, .. } = &mut *memory;
        let weights = self.rounded(weights, layers)?;
        if training.is_none() {
            *training = Some(self.training()?);
        }
        let Some(training) = training else { return Ok(()) };
        for first in (0..draw.batch as usize).step_by(training.rows) {
            let rows = (draw.batch as usize - first).min(training.rows).next_multiple_of(TILE);
            // SAFETY: the caller's; memory holds as many rows.
            unsafe { self.part_gradient(training, rows, halves, layers, weights, draw, first as u32, to) }?;
        }
        Ok(())
    }

    fn training(&self) -> Result<Training, DeviceError> {
        let rows = (TRAINED / (self.width * self.hidden())).clamp(TILE, TRAINED_ROWS) / TILE * TILE;
        let values = || self.values("a layer's values", rows * self.width);
        Ok(Training {
            rows,
            encoded: self.values("encoded samples", rows * self.encoded)?,
            values: (0..self.hidden()).map(|_| values()).collect::<Result<_, _>>()?,
            deltas: [values()?, values()?],
            encoded_delta: self.tables.as_ref().map(|_| self.values("encoded samples", rows * self.encoded)).transpose()?,
            targets: self.gpu.alloc("targets", rows)?,
        })
    }

    /// # Safety
    /// As for [`Self::gradient`].
    unsafe fn part_gradient(
        &self,
        training: &Training,
        rows: usize,
        halves: u64,
        layers: u64,
        weights: u64,
        draw: &DrawArgument,
        first: u32,
        to: GradientTo,
    ) -> Result<(), DeviceError> {
        let stream = self.gpu.work();
        let (encoded, targets) = (training.encoded.address(), training.targets.address());
        let values: Vec<u64> = training.values.iter().map(Buffer::address).collect();
        let last = self.hidden() - 1;
        let mut call = stream.launch_builder(&self.encode_samples);
        call.arg(&self.grid).arg(&halves).arg(draw).arg(&first).arg(&encoded).arg(&targets);
        // SAFETY: the arguments of `batched_encode_samples`, a thread two columns.
        unsafe { launch(&mut call, threads(rows * self.encoded / 2, THREADS)) }?;
        let before = |layer: usize| if layer == 0 { encoded } else { values[layer - 1] };
        for layer in 0..=last {
            // SAFETY: both hold `rows` rows.
            unsafe { self.layer_forward(layer, rows, before(layer), weights, layers, values[layer]) }?;
        }

        let (_, head, _) = self.layers[last + 1];
        let (head_gradient, head) = (to.layers + 4 * head as u64, layers + 4 * head as u64);
        let biases = |layer: usize| to.layers + 4 * self.layers[layer].2 as u64;
        let mut delta = training.deltas[last % 2].address();
        let bias_gradient = biases(last);
        let mut call = stream.launch_builder(&self.head);
        call.arg(&values[last]).arg(&head).arg(&targets).arg(&draw.batch);
        call.arg(&delta).arg(&head_gradient).arg(&bias_gradient).arg(&to.loss);
        // SAFETY: the arguments of `batched_head`.
        unsafe { launch(&mut call, threads(rows / HEAD_ROWS * THREADS as usize, THREADS)) }?;
        for layer in (0..=last).rev() {
            let ((row, _), (inputs, start, _)) = (self.row(layer), self.layers[layer]);
            let tiles = (row as usize / TILE) * (self.width / TILE);
            // Two blocks a multiprocessor, each of at least eight steps.
            let shares = (2 * self.gpu.multiprocessors() as usize).div_ceil(tiles).clamp(1, (rows / (8 * DEPTH)).max(1));
            let share = rows.div_ceil(shares).next_multiple_of(DEPTH) as u32;
            let (from, n, inputs, gradient) = (before(layer), rows as u32, inputs as u32, to.layers + 4 * start as u64);
            let mut call = stream.launch_builder(&self.products);
            call.arg(&from).arg(&row).arg(&delta).arg(&n).arg(&share).arg(&inputs).arg(&gradient);
            // SAFETY: the arguments of `batched_products`.
            unsafe { launch(&mut call, self.product(self.width, row as usize, shares)) }?;
            let weights = weights + 2 * self.rounded_start(layer) as u64;
            if layer > 0 {
                let (below, gradient) = (training.deltas[(layer + 1) % 2].address(), biases(layer - 1));
                let mut call = stream.launch_builder(&self.backward);
                call.arg(&delta).arg(&weights).arg(&values[layer - 1]).arg(&below).arg(&gradient);
                // SAFETY: the arguments of `batched_backward`; the two buffers take turns.
                unsafe { launch(&mut call, self.product(self.width, rows, 1)) }?;
                delta = below;
            } else if let (Some([backward, scatter]), Some(below)) = (&self.tables, &training.encoded_delta) {
                let below = below.address();
                let mut call = stream.launch_builder(backward);
                call.arg(&delta).arg(&weights).arg(&below);
                // SAFETY: the arguments of `batched_backward_encoded`.
                unsafe { launch(&mut call, self.product(self.encoded, rows, 1)) }?;
                let mut call = stream.launch_builder(scatter);
                call.arg(&self.grid).arg(draw).arg(&first).arg(&below).arg(&to.tables);
                // SAFETY: the arguments of `batched_scatter`, a thread two columns.
                unsafe { launch(&mut call, threads(rows * self.encoded / 2, THREADS)) }?;
            }
        }
        Ok(())
    }
}
