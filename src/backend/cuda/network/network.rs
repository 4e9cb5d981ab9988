//! The network on the device: its kernels, compiled for one architecture, and prediction. The network is a multiresolution hash grid (Mueller et al.
//! 2022) followed by a multilayer perceptron, fully fused (Mueller et al. 2021) if it is small enough.
//!
//! Tables are in half precision, each level padded to a multiple of 64 entries. Layers are in burn's layout; a block rounds them when it reads
//! them (fused), or a kernel does once per call (batched).

use crate::cuda::driver::Resident;
use crate::cuda::driver_error;
use crate::cuda::layout::TableArgument;
use crate::cuda::network::batched::{Batched, GradientTo, Tiling};
use crate::cuda::network::layout::{DrawArgument, GridArgument, LevelArgument, PlacedTimes, ReadingArgument};
use crate::cuda::{Buffer, DeviceError, DevicePredict, DeviceTable, Gpu, launch, threads};
use cudarc::driver::{CudaFunction, PushKernelArg, result};
use ridgewatch_field::UnitPoint;
use ridgewatch_surrogate::network::{Architecture, Encoding, HASH, Loss, Objective, Row, Target, UNTIMED, row};
use std::sync::Arc;

/// Threads of a block, and samples of a block's tile, in `network_predict` and `network_gradient`.
const THREADS: u32 = 256;
const TILE: usize = 128;
/// The padded tables start each level at a multiple of this many entries.
const PADDING: usize = 64;
/// Largest encoding and layer, and largest number of hidden layers, that a warp's registers hold.
const MAX_WIDTH: usize = 128;
const MAX_DEPTH: usize = 4;
/// Lowest compute capability with the matrix instruction.
const MIN_CAPABILITY: (i32, i32) = (8, 0);

/// Returns true if a warp's registers hold samples of this architecture and `shared_memory` bytes hold its layers (`network_fused.cu`). Other
/// architectures use `network_batched.cu`.
pub fn is_fused(shape: &Architecture, shared_memory: usize) -> bool {
    let (width, hidden) = (shape.layers[0].outputs, shape.layers.len() - 1);
    let (_, workspace) = shared_bytes(shape);
    hidden <= MAX_DEPTH && width <= MAX_WIDTH && shape.encoded() <= MAX_WIDTH && workspace <= shared_memory
}

/// Terms of a loss besides the squared errors of the outputs, for which kernels are compiled.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct LossTerms {
    /// A penalty on the difference of the batch means.
    pub mean_penalty: bool,
    /// The squared errors of the flow map's derivatives.
    pub derivatives: bool,
}

impl LossTerms {
    /// The terms of this objective.
    pub fn of(objective: &Objective) -> Self {
        let is_published = objective.target == Target::Ftle && objective.loss == Loss::Published;
        Self { mean_penalty: is_published && objective.mean_penalty != 0.0, derivatives: objective.derivatives() }
    }
}

/// Macros of `network*.cu` for an architecture and a loss. `None` if the architecture has no hidden layer or is the flow map of a single axis.
pub fn network_defines(shape: &Architecture, terms: LossTerms) -> Option<Vec<String>> {
    let (width, hidden) = (shape.layers[0].outputs, shape.layers.len() - 1);
    let flow_map = shape.target == Target::FlowMap;
    if hidden == 0 || (flow_map && shape.dimensions() < 2) {
        return None;
    }
    let axes: Vec<String> = places(shape).iter().map(usize::to_string).collect();
    let (weights, workspace) = shared_bytes(shape);
    Some(vec![
        format!("RW_AXES={}", axes.join(",")),
        format!("RW_DIMS={}", shape.inputs()),
        format!("RW_SPACE={}", shape.dimensions()),
        format!("RW_FLOW_MAP={}", u8::from(flow_map)),
        format!("RW_DERIVATIVES={}", u8::from(terms.derivatives)),
        format!("RW_PENALTY={}", u8::from(terms.mean_penalty)),
        format!("RW_LEVELS={}", shape.levels.len()),
        format!("RW_FEATURES={}", shape.features),
        format!("RW_OCTAVES={}", shape.octaves),
        format!("RW_WIDTH={width}"),
        format!("RW_HIDDEN={hidden}"),
        format!("RW_WEIGHTS_BYTES={weights}"),
        format!("RW_WORKSPACE_BYTES={workspace}"),
    ])
}

/// Numbers of a unit point.
pub(super) const POINT: usize = 3;

/// Place of each input in a sample. Axes have their own among the three of the point; times take the places of unused axes, then further ones.
fn places(shape: &Architecture) -> Vec<usize> {
    let free = (0..).filter(|place| !shape.space().contains(place));
    shape.space().iter().copied().chain(free.take(shape.times().len())).collect()
}

/// `PLACES` of `network.cuh`.
fn sample_places(shape: &Architecture) -> usize {
    shape.inputs().max(POINT)
}

/// Places of a sample beyond its point.
pub(super) fn further_places(shape: &Architecture) -> usize {
    sample_places(shape) - POINT
}

/// `Float4`s of a sample: places, targets, and targets of the derivatives if the loss has them.
pub(super) fn sample_float4s(shape: &Architecture, objective: &Objective) -> usize {
    let groups = if objective.derivatives() { 1 + shape.dimensions() } else { 1 };
    (sample_places(shape) + groups * shape.outputs()).div_ceil(4)
}

/// Unit times at their places; NaN at the other places. Without `times` a point supplies its own values at its three places.
pub(super) fn placed_times(shape: &Architecture, times: Option<[f32; 2]>) -> PlacedTimes {
    let mut placed = [f32::NAN; 5];
    let row: Row = row(UnitPoint([f32::NAN; 3]), times.unwrap_or(UNTIMED));
    for (place, &column) in places(shape).into_iter().zip(&shape.axes) {
        if times.is_some() || place >= POINT {
            placed[place] = row[column];
        }
    }
    placed
}

/// Length of tangents: the geometric mean of the encoding's finest and coarsest length, so that half precision holds both slopes.
fn tangent_step(shape: &Architecture) -> f32 {
    let step = match shape.encoding {
        Encoding::HashGrid => {
            let cells = || shape.levels.iter().flat_map(|level| &level.cells[..shape.dimensions()]).map(|&cells| cells as f32);
            1.0 / (cells().fold(1.0, f32::max) * cells().fold(f32::MAX, f32::min)).sqrt()
        }
        Encoding::Frequency => 1.0 / (std::f32::consts::PI * (0.5 * (shape.octaves as f32 - 1.0)).exp2()),
    };
    // A power of two does not round.
    step.log2().round().exp2()
}

/// Tangents of a loss with derivatives: their length, and the factor of their squared errors beside those of the values.
#[derive(Debug, Clone, Copy)]
pub(super) struct TangentTerm {
    pub(super) step: f32,
    pub(super) factor: f32,
}

impl TangentTerm {
    /// `None` if the loss has no derivatives.
    pub(super) fn of(shape: &Architecture, objective: &Objective) -> Option<Self> {
        let step = tangent_step(shape);
        let factor = objective.jacobian_weight / (shape.dimensions() as f32 * step * step);
        objective.derivatives().then_some(Self { step, factor })
    }
}

/// Sizes of `Weights` of `network.cuh` and `Workspace` of `network_fused.cu`, which asserts them.
fn shared_bytes(shape: &Architecture) -> (usize, usize) {
    let hidden = shape.layers.len() - 1;
    let [encoded, width] = [shape.encoded(), shape.layers[0].outputs].map(|n| n.next_multiple_of(16));
    let (row, head_row) = (width + 8, 16);
    let halves = encoded * row + (hidden - 1).max(1) * width * row + width * head_row;
    let weights = (2 * halves + 4 * (hidden * width + shape.outputs())).next_multiple_of(16);
    (weights, weights + 2 * TILE * (encoded.max(width) + 8 + row))
}

/// Kernels of prediction and gradient. `tangents`: the gradient of the derivatives, if the loss has them.
#[derive(Debug)]
enum Path {
    Fused { predict: Resident, gradient: Resident, tangents: Option<Resident> },
    Batched(Box<Batched>),
}

/// Kernels and layouts that depend on the architecture only.
#[derive(Debug)]
pub(super) struct NetworkKernels {
    pub(super) gpu: Arc<Gpu>,
    pub(super) shape: Architecture,
    pub(super) grid: GridArgument,
    /// Values of the padded tables.
    pub(super) padded: usize,
    path: Path,
    pub(super) adam_tables: CudaFunction,
    pub(super) adam_layers: CudaFunction,
    pub(super) average: CudaFunction,
    halves: CudaFunction,
    pub(super) samples: CudaFunction,
    pub(super) usable: CudaFunction,
    pub(super) points: CudaFunction,
    pub(super) drawn: CudaFunction,
    pub(super) means: CudaFunction,
}

impl NetworkKernels {
    /// Compiles the kernels, or takes them from the cache.
    pub(super) fn new(gpu: &Arc<Gpu>, shape: &Architecture, objective: &Objective) -> Result<Arc<Self>, DeviceError> {
        let refuse = |what: String| Err(DeviceError::Unsupported { what });
        if gpu.capability() < MIN_CAPABILITY {
            let (major, minor) = gpu.capability();
            return refuse(format!("a network on compute capability {major}.{minor}; networks need 8.0 or later"));
        }
        let terms = LossTerms::of(objective);
        let Some(defines) = network_defines(shape, terms) else {
            return refuse(format!(
                "a network of {} hidden layers with inputs {} and target {:?}; the GPU needs at least one hidden layer, and two or three axes for a flow map",
                shape.layers.len() - 1,
                shape.input_names().join(", "),
                shape.target
            ));
        };
        let (grid, padded) = grid(shape)?;
        let kernel = |name| gpu.kernel("network.cu", &defines, name);
        let (weights, workspace) = shared_bytes(shape);
        let fused = |name, shared| Resident::new(gpu, gpu.kernel("network_fused.cu", &defines, name)?, THREADS, shared);
        let path = if is_fused(shape, gpu.shared_memory()) {
            Path::Fused {
                predict: fused("network_predict", weights)?,
                gradient: fused("network_gradient", workspace)?,
                tangents: terms.derivatives.then(|| fused("network_tangent_gradient", workspace)).transpose()?,
            }
        } else if let Some(tiling) = Tiling::of(shape, gpu.shared_memory()) {
            Path::Batched(Box::new(Batched::new(gpu, shape, grid, (&defines, terms), tiling)?))
        } else {
            let (width, most) = (shape.layers[0].outputs, gpu.shared_memory());
            return refuse(format!("a network of width {width}: a tile of its values exceeds {most} bytes of shared memory"));
        };
        Ok(Arc::new(Self {
            path,
            adam_tables: kernel("network_adam_tables")?,
            adam_layers: kernel("network_adam_layers")?,
            average: kernel("network_average")?,
            halves: kernel("network_halves")?,
            samples: kernel("network_samples")?,
            usable: kernel("network_usable")?,
            points: kernel("network_points")?,
            drawn: kernel("network_drawn")?,
            means: kernel("network_means")?,
            gpu: gpu.clone(),
            shape: shape.clone(),
            grid,
            padded,
        }))
    }

    /// Log-stretch at unit points. `points` and `out` are device addresses.
    ///
    /// # Safety
    /// As for [`DevicePredict::predict`]; `halves` are the padded tables and `layers` the flat vector of this architecture.
    pub(super) unsafe fn predict(
        &self,
        halves: u64,
        layers: u64,
        reading: &ReadingArgument,
        points: u64,
        count: usize,
        out: u64,
    ) -> Result<(), DeviceError> {
        match &self.path {
            // SAFETY: as required of the caller.
            Path::Batched(batched) => unsafe { batched.predict(halves, layers, reading, points, count, out) },
            Path::Fused { predict, .. } => {
                let n = count as u32;
                let mut call = self.gpu.work().launch_builder(&predict.function);
                call.arg(&self.grid).arg(&halves).arg(&layers).arg(reading).arg(&points).arg(&n).arg(&out);
                // SAFETY: as required of the caller; the arguments are those of `network_predict`.
                unsafe { launch(&mut call, predict.config(count.div_ceil(TILE))) }
            }
        }
    }

    /// Adds the gradient and the loss of a batch. `term`: tangents of the objective for which the kernels were compiled.
    ///
    /// # Safety
    /// Device addresses as for [`Self::predict`]; the samples of `draw` are there, and room for the gradients.
    pub(super) unsafe fn gradient(
        &self,
        halves: u64,
        layers: u64,
        draw: &DrawArgument,
        term: Option<TangentTerm>,
        to: GradientTo,
    ) -> Result<(), DeviceError> {
        match &self.path {
            // SAFETY: as required of the caller.
            Path::Batched(batched) => unsafe { batched.gradient(halves, layers, draw, term, to) },
            Path::Fused { gradient, tangents, .. } => {
                let blocks = (draw.batch as usize).div_ceil(TILE);
                let mut call = self.gpu.work().launch_builder(&gradient.function);
                call.arg(&self.grid).arg(&halves).arg(&layers).arg(draw).arg(&to.tables).arg(&to.layers).arg(&to.loss);
                // SAFETY: as required of the caller; the arguments are those of `network_gradient`.
                unsafe { launch(&mut call, gradient.config(blocks)) }?;
                let (Some(tangents), Some(TangentTerm { step, factor })) = (tangents, term) else { return Ok(()) };
                let mut call = self.gpu.work().launch_builder(&tangents.function);
                call.arg(&self.grid).arg(&halves).arg(&layers).arg(draw).arg(&step).arg(&factor);
                call.arg(&to.tables).arg(&to.layers).arg(&to.loss);
                // SAFETY: as above; the arguments are those of `network_tangent_gradient`.
                unsafe { launch(&mut call, tangents.config(blocks)) }
            }
        }
    }

    /// Allocates the memory that prediction and gradients need between their kernels. It is kept.
    pub(super) fn reserve(&self) -> Result<(), DeviceError> {
        match &self.path {
            Path::Batched(batched) => batched.reserve(),
            // Fused kernels use registers and shared memory only.
            Path::Fused { .. } => Ok(()),
        }
    }

    /// Rounds burn's tables to half precision and pads them.
    pub(super) fn round(&self, tables: &Buffer<f32>, halves: &Buffer<u16>) -> Result<(), DeviceError> {
        if self.padded == 0 {
            return Ok(());
        }
        let mut call = self.gpu.work().launch_builder(&self.halves);
        let (n, from, to) = (self.padded as u64, tables.address(), halves.address());
        call.arg(&self.grid).arg(&n).arg(&from).arg(&to);
        // SAFETY: the arguments of `network_halves`; `halves` holds `padded` values and `tables` all of burn's.
        unsafe { launch(&mut call, threads(self.padded, 256)) }
    }
}

/// Levels as kernel argument, and number of values of the padded tables.
///
/// # Errors
/// The tables have more entries than 32 bits can count.
pub(super) fn grid(shape: &Architecture) -> Result<(GridArgument, usize), DeviceError> {
    let mut levels = Vec::new();
    let mut offset = 0;
    for level in &shape.levels {
        let mut stride = 1_u32;
        let factor = std::array::from_fn(|axis| {
            let dense = stride;
            stride = stride.wrapping_mul(level.cells[axis] + 1);
            if level.hashed { HASH[axis] } else { dense }
        });
        levels.push(LevelArgument {
            cells: level.cells.map(|n| n as f32),
            last_cell: level.cells.map(|n| n - 1),
            factor,
            mask: (level.entries - 1) as u32,
            hashed: u32::from(level.hashed),
            entries: level.entries as u32,
            offset: offset as u32,
            start: level.offset as u32,
        });
        offset += level.entries.next_multiple_of(PADDING);
    }
    if u32::try_from(offset).is_err() {
        return Err(DeviceError::Unsupported { what: format!("tables of {offset} entries") });
    }
    Ok((GridArgument::new(&levels, shape.inputs()), offset * shape.features))
}

/// Kernel argument for the map from outputs to log-stretch: `base`, if any, plus `share` times the network, at points with these times
/// ([`placed_times`]).
pub(super) fn reading(
    shape: &Architecture,
    objective: &Objective,
    times: PlacedTimes,
    base: Option<&DeviceTable>,
    share: f32,
) -> ReadingArgument {
    let table = base.map_or(TableArgument { nodes: [0; 3], dimensions: 0, values: 0 }, |base| {
        let nodes = base.nodes().map(|n| n as i32);
        TableArgument { nodes, dimensions: if nodes[2] > 1 { 3 } else { 2 }, values: base.address() }
    });
    let (step, Objective { scale, extent, .. }) = (tangent_step(shape), objective);
    ReadingArgument {
        mean: scale.mean,
        deviation: scale.deviation,
        tau: objective.tau,
        published: i32::from(objective.target == Target::Ftle && objective.loss == Loss::Published),
        share,
        times,
        step,
        factor: std::array::from_fn(|output| {
            std::array::from_fn(|along| scale.deviation[output] * extent[output] / (extent[along] * step))
        }),
        further: 0,
        base: table,
    }
}

/// A network that predicts.
#[derive(Debug)]
pub struct DeviceNetwork {
    kernels: Arc<NetworkKernels>,
    halves: Buffer<u16>,
    layers: Buffer<f32>,
    objective: Objective,
}

/// A network above a table: table + share * network.
#[derive(Debug, Clone, Copy)]
pub struct NetworkAbove<'a> {
    network: &'a DeviceNetwork,
    base: Option<(&'a DeviceTable, f32)>,
    times: Option<[f32; 2]>,
}

impl DeviceNetwork {
    /// Returns true if this device supports networks of this architecture.
    pub fn takes(gpu: &Gpu, shape: &Architecture) -> bool {
        let most = gpu.shared_memory();
        gpu.capability() >= MIN_CAPABILITY
            && network_defines(shape, LossTerms::default()).is_some()
            && (is_fused(shape, most) || Tiling::of(shape, most).is_some())
    }

    /// Uploads parameters in the layout of burn's tensors.
    ///
    /// # Errors
    /// The architecture is not supported, or out of memory.
    pub fn upload(
        gpu: &Arc<Gpu>,
        shape: &Architecture,
        objective: &Objective,
        tables: &[f32],
        layers: &[f32],
    ) -> Result<Self, DeviceError> {
        let kernels = NetworkKernels::new(gpu, shape, objective)?;
        let tables = gpu.upload("a network's tables", tables)?;
        let layers = gpu.upload("a network's layers", layers)?;
        Self::of(&kernels, objective, &tables, layers)
    }

    /// Network with parameters on the device.
    pub(super) fn of(
        kernels: &Arc<NetworkKernels>,
        objective: &Objective,
        tables: &Buffer<f32>,
        layers: Buffer<f32>,
    ) -> Result<Self, DeviceError> {
        let halves = kernels.gpu.alloc("a network's rounded tables", kernels.padded)?;
        kernels.round(tables, &halves)?;
        Ok(Self { kernels: kernels.clone(), halves, layers, objective: objective.clone() })
    }

    /// Size of the memory that prediction reads, in bytes.
    pub fn bytes(&self) -> usize {
        2 * self.kernels.padded + 4 * self.layers.len()
    }

    /// Adds a share of the network to a table. If times are inputs, points carry them at the places of unused axes; times without such a place
    /// are those of samples without times.
    pub fn above<'a>(&'a self, base: Option<(&'a DeviceTable, f32)>) -> NetworkAbove<'a> {
        NetworkAbove { network: self, base, times: None }
    }
}

impl NetworkAbove<'_> {
    /// Predicts at these unit times and ignores the times that points carry.
    pub fn at(self, times: [f32; 2]) -> Self {
        Self { times: Some(times), ..self }
    }
}

impl DevicePredict for DeviceNetwork {
    unsafe fn predict(&self, points: u64, count: usize, out: u64) -> Result<(), DeviceError> {
        // SAFETY: as required of the caller.
        unsafe { self.above(None).predict(points, count, out) }
    }
}

impl DevicePredict for NetworkAbove<'_> {
    unsafe fn predict(&self, points: u64, count: usize, out: u64) -> Result<(), DeviceError> {
        if count == 0 {
            return Ok(());
        }
        let DeviceNetwork { kernels, halves, layers, objective } = self.network;
        let times = placed_times(&kernels.shape, self.times);
        let (base, share) = self.base.map_or((None, 1.0), |(table, share)| (Some(table), share));
        let reading = reading(&kernels.shape, objective, times, base, share);
        // SAFETY: as required of the caller; the parameters are of these kernels' architecture.
        unsafe { kernels.predict(halves.address(), layers.address(), &reading, points, count, out) }
    }
}

/// Copies `from` to the front of `to` in the order of the work stream.
pub(super) fn copy(gpu: &Gpu, from: &Buffer<f32>, to: &Buffer<f32>) -> Result<(), DeviceError> {
    assert!(from.len() <= to.len(), "room for a copy");
    let doing = driver_error("copying on the device");
    gpu.context().bind_to_thread().map_err(&doing)?;
    // SAFETY: both buffers hold as many values, and neither is freed before the work stream has passed this call.
    unsafe { result::memcpy_dtod_async(to.address(), from.address(), 4 * from.len(), gpu.work().cu_stream()) }.map_err(doing)
}

/// Copies a buffer on the device in the order of the work stream.
pub(super) fn copied(gpu: &Gpu, what: &str, from: &Buffer<f32>) -> Result<Buffer<f32>, DeviceError> {
    let to = gpu.alloc(what, from.len())?;
    copy(gpu, from, &to)?;
    Ok(to)
}

#[cfg(test)]
mod tests {
    use super::*;
    use half::f16;

    /// burn's tables of padded ones in half precision; [`grid`] says where each level lies.
    fn unpadded(shape: &Architecture, halves: &[u16]) -> Vec<f32> {
        let mut tables = vec![0.0; shape.table_entries() * shape.features];
        let mut from = 0;
        for level in &shape.levels {
            let to = &mut tables[level.offset * shape.features..][..level.entries * shape.features];
            to.iter_mut().zip(&halves[from..]).for_each(|(to, &half)| *to = f16::from_bits(half).to_f32());
            from += level.entries.next_multiple_of(PADDING) * shape.features;
        }
        tables
    }
    use ridgewatch_surrogate::network::{Encoding, NetworkSettings};

    /// Each level is at the position that [`grid`] passes to the kernels.
    #[test]
    fn padded_tables_come_back_in_burn_s_order() {
        let settings =
            NetworkSettings { levels: Some(4), log2_table: Some(9), base_resolution: Some(3), features: 2, ..NetworkSettings::default() };
        let shape = Architecture::new(&settings, &[0, 1, 2], [1.0; 3]).unwrap();
        assert!(shape.levels.iter().any(|level| level.entries % PADDING != 0) && shape.levels.iter().any(|level| level.hashed));
        let (_, padded) = grid(&shape).unwrap();
        // Integers that half precision represents exactly.
        let tables: Vec<f32> = (0..shape.table_entries() * shape.features).map(|i| (i % 2048) as f32).collect();
        let mut halves = vec![f16::NAN.to_bits(); padded];
        let mut entry = 0;
        for level in &shape.levels {
            for i in 0..level.entries * shape.features {
                halves[entry * shape.features + i] = f16::from_f32(tables[level.offset * shape.features + i]).to_bits();
            }
            entry = (entry + level.entries).next_multiple_of(PADDING);
        }
        assert_eq!(unpadded(&shape, &halves), tables);
    }

    #[test]
    fn what_does_not_fit_into_shared_memory_goes_in_batches() {
        // Shared memory of H200, A100 and the RTX cards since Ampere.
        let [h200, a100, rtx] = [227, 163, 99].map(|kibibytes| kibibytes << 10);
        let fused = |settings: NetworkSettings, on: usize| is_fused(&Architecture::new(&settings, &[0, 1, 2], [1.0; 3]).unwrap(), on);
        let small = NetworkSettings::default();
        assert!([h200, a100, rtx].into_iter().all(|on| fused(small.clone(), on)));
        let wider = NetworkSettings { width: 128, ..small.clone() };
        assert!(fused(wider.clone(), h200) && fused(wider.clone(), a100) && !fused(wider, rtx));
        let published = NetworkSettings { encoding: Encoding::Frequency, width: 256, hidden_layers: 8, ..small };
        assert!(!fused(published, h200));
    }
}
