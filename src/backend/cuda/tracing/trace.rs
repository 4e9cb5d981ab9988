//! Tracing on the device: RK4 of each path and its variational equation, or central differences (Shadden et al. 2005).
//!
//! Seeds and results are at device addresses. In a window of snapshots, seeds are sorted by cell first ([`Sorter`]).

use crate::cuda::driver_error;
use crate::cuda::layout::{ClosedData, DeviceReal, Outputs, ResultPolicy, Words, words};
use crate::cuda::tracing::sort::{MAX_POINTS, SortCells, Sorter};
use crate::cuda::window::DeviceWindow;
use crate::cuda::window::grid::{GridArguments, WindowFlowMap};
use crate::cuda::{Buffer, DeviceError, Gpu, SnapshotStore, Storage, launch, threads};
use cudarc::driver::{CudaFunction, PushKernelArg};
use ridgewatch_field::analytic::{Analytic, ClosedForm, Constants, Form};
use ridgewatch_field::{Domain, Geometry};
use ridgewatch_flow::{Boundary, FlowMap, Integrator, Normalisation, Precision, VelocitySource};
use std::sync::{Arc, Mutex, PoisonError};

/// Order in which seeds are traced, and format in which velocities are read. Other values than the default are for measurements.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Tuning {
    /// Format of the window.
    pub storage: Storage,
    /// True if batches are sorted by cell.
    pub sorted: bool,
    /// True if the current cell stays in registers when it fits; otherwise every stage reads its corners.
    pub keep: bool,
    /// True if each particle of a seed's differences has its own lane (sorted seeds in a window only); otherwise one thread traces them in turn.
    pub spread: bool,
}

impl Default for Tuning {
    fn default() -> Self {
        Self { storage: Storage::F32, sorted: true, keep: true, spread: true }
    }
}

/// Size of the smallest batch that is sorted.
const SORT_FROM: usize = 1 << 12;

/// One flow map on the device, ready for seeds.
#[derive(Debug)]
pub struct DeviceTracer {
    gpu: Arc<Gpu>,
    plain: CudaFunction,
    sorted: CudaFunction,
    /// Seeds per warp of the sorted kernel.
    seeds_a_warp: usize,
    block: u32,
    data: Words,
    /// Address of the steps (windows) or the stage constants (closed forms).
    times: u64,
    step: [u64; 1],
    difference_step: f64,
    result_policy: ResultPolicy,
    cells: Option<SortCells>,
    sorter: Mutex<Option<Sorter>>,
    // Owners of the memory that the kernels read.
    _window: Option<DeviceWindow>,
    _memory: Vec<Buffer<u8>>,
}

impl DeviceTracer {
    /// Tracer of seeds at time `t0`, with this many steps. Settings that [`ridgewatch_flow::cpu_tracer`] refuses are not checked again.
    ///
    /// # Errors
    /// The adaptive integrator is not supported, the window does not fit into memory, or a kernel does not compile.
    pub fn new(
        store: &SnapshotStore,
        gpu: &Arc<Gpu>,
        source: &VelocitySource,
        map: &FlowMap,
        t0: f64,
        steps: usize,
        tuning: Tuning,
    ) -> Result<Self, DeviceError> {
        if map.integrator == Integrator::DormandPrince {
            return Err(DeviceError::Unsupported { what: "the adaptive reference integrator, which runs on the CPU only".into() });
        }
        match map.precision {
            Precision::F32 => Self::of_real::<f32>(store, gpu, source, map, t0, steps, tuning),
            Precision::F64 => Self::of_real::<f64>(store, gpu, source, map, t0, steps, tuning),
        }
    }

    /// Tracer of seeds with individual start times: x, y and start. Only the double gyre is supported, whose dependence on time is a phase.
    ///
    /// # Errors
    /// Other flows and the adaptive integrator are not supported; a kernel does not compile.
    pub fn with_starts(gpu: &Arc<Gpu>, flow: &Analytic, domain: &Domain, map: &FlowMap, steps: usize) -> Result<Self, DeviceError> {
        if !matches!(flow.form(), Form::DoubleGyre(_)) || map.integrator == Integrator::DormandPrince {
            let what = format!("individual start times of seeds with {:?} and the flow {flow:?}", map.integrator);
            return Err(DeviceError::Unsupported { what });
        }
        match map.precision {
            Precision::F32 => Self::of_closed::<f32>(gpu, flow, domain, map, None, steps),
            Precision::F64 => Self::of_closed::<f64>(gpu, flow, domain, map, None, steps),
        }
    }

    /// `t0`: `None` if every seed has its own start time.
    fn of_closed<R: DeviceReal>(
        gpu: &Arc<Gpu>,
        flow: &Analytic,
        domain: &Domain,
        map: &FlowMap,
        t0: Option<f64>,
        steps: usize,
    ) -> Result<Self, DeviceError> {
        let ClosedArguments { data, stages, defines } = ClosedArguments::new::<R>(flow, domain, map, t0, steps);
        let stages = gpu.upload("the stages of a closed form", &stages)?;
        Ok(Self {
            plain: gpu.kernel("trace_closed.cu", &defines, "trace")?,
            sorted: gpu.kernel("trace_closed.cu", &defines, "trace_sorted")?,
            seeds_a_warp: 32,
            block: 256,
            data,
            times: stages.address(),
            step: step_word::<R>(map, steps),
            difference_step: map.difference_step,
            result_policy: result_policy(map, steps),
            cells: None,
            sorter: Mutex::new(None),
            _window: None,
            _memory: vec![stages],
            gpu: gpu.clone(),
        })
    }

    fn of_real<R: DeviceReal>(
        store: &SnapshotStore,
        gpu: &Arc<Gpu>,
        source: &VelocitySource,
        map: &FlowMap,
        t0: f64,
        steps: usize,
        tuning: Tuning,
    ) -> Result<Self, DeviceError> {
        let to = t0 + map.direction.sign() * map.tau;
        match source {
            VelocitySource::Analytic(flow, domain) => Self::of_closed::<R>(gpu, flow, domain, map, Some(t0), steps),
            VelocitySource::Window(window) => {
                let grid = window.grid().ok_or_else(|| DeviceError::Unsupported { what: "an empty window".into() })?.clone();
                let held = store.window(window, tuning.storage)?;
                let times: Vec<f64> = window.snapshots().map(|s| s.time).collect();
                let mut memory = Vec::new();
                let mut put = |bytes: &[u8]| {
                    let buffer = gpu.upload("a flow map", bytes)?;
                    let address = buffer.address();
                    memory.push(buffer);
                    Ok(address)
                };
                let spread = tuning.spread && tuning.sorted && map.integrator == Integrator::Differences;
                // In double precision, and with levels on the sphere, caching the cell takes registers from other warps and is slower
                // (docs/performance.md).
                let layered = matches!(grid.geometry, Geometry::Sphere { .. }) && grid.dimensions() == 3;
                let keep = tuning.keep && map.precision == Precision::F32 && !layered;
                let nodes = held.nodes();
                let flow = WindowFlowMap { nodes: &nodes, times: &times, grid: &grid, map, span: (t0, to), steps, keep };
                let arguments = GridArguments::new::<R>(&mut put, flow)?;
                let kernel = |name| gpu.kernel("trace_grid.cu", &arguments.defines, name);
                Ok(Self {
                    plain: kernel("trace")?,
                    sorted: kernel(if spread { "trace_particles" } else { "trace_sorted" })?,
                    seeds_a_warp: if spread { 32 / (2 * grid.dimensions()) } else { 32 },
                    block: 128,
                    data: arguments.data,
                    times: arguments.steps,
                    step: step_word::<R>(map, steps),
                    difference_step: map.difference_step,
                    result_policy: result_policy(map, steps),
                    cells: tuning.sorted.then(|| SortCells::of_grid(&grid)),
                    sorter: Mutex::new(None),
                    _window: Some(held),
                    _memory: memory,
                    gpu: gpu.clone(),
                })
            }
        }
    }

    /// The device.
    pub fn gpu(&self) -> &Arc<Gpu> {
        &self.gpu
    }

    /// Registers and bytes of local memory per thread of the kernel in use.
    ///
    /// # Errors
    /// Error of the driver.
    pub fn resources(&self) -> Result<(i32, i32), DeviceError> {
        let doing = driver_error("querying the resources of a kernel");
        let kernel = if self.cells.is_some() { &self.sorted } else { &self.plain };
        Ok((kernel.num_regs().map_err(&doing)?, kernel.local_size_bytes().map_err(&doing)?))
    }

    /// Traces `count` seeds on the device: `seeds` is the address of 3 f32 each, in domain coordinates; results go to `out` in the order of
    /// the seeds. Returns as soon as the work is queued on the work stream.
    ///
    /// # Errors
    /// Out of memory for sorting, or an error of the driver.
    ///
    /// # Safety
    /// The memory at these addresses is on this device, holds `count` entries, and lives until the work stream has passed this call.
    pub unsafe fn trace(&self, seeds: u64, count: usize, out: &Outputs) -> Result<(), DeviceError> {
        let Some(cells) = self.cells.as_ref().filter(|_| count >= SORT_FROM) else {
            // SAFETY: as required of the caller.
            return unsafe { self.in_given_order(seeds, count, out) };
        };
        let mut sorter = self.sorter.lock().unwrap_or_else(PoisonError::into_inner);
        let sorter = match &mut *sorter {
            Some(sorter) => sorter,
            none => none.insert(Sorter::new(&self.gpu)?),
        };
        let most = sorter.at_once();
        for first in (0..count).step_by(most) {
            let part = (count - first).min(most);
            // SAFETY: as required of the caller; the launch that reads the sorted points is next on the same stream.
            unsafe {
                let sorted = sorter.sort(seeds + 12 * first as u64, part, cells)?;
                self.launch(&self.sorted, self.seeds_a_warp, sorted, part, &shifted(out, first))?;
            }
        }
        Ok(())
    }

    /// Traces `count` seeds that are in an order of good locality already: `{x, y, z, index as bits}`. Results go to their index; index
    /// 0xffffffff marks an entry without a seed.
    ///
    /// # Safety
    /// As for [`Self::trace`], with room for every index.
    pub(in crate::cuda) unsafe fn in_sequence(&self, sorted: u64, count: usize, out: &Outputs) -> Result<(), DeviceError> {
        // SAFETY: as required of the caller.
        unsafe { self.launch(&self.sorted, self.seeds_a_warp, sorted, count, out) }
    }

    /// # Safety
    /// As for [`Self::trace`].
    unsafe fn in_given_order(&self, seeds: u64, count: usize, out: &Outputs) -> Result<(), DeviceError> {
        for first in (0..count).step_by(MAX_POINTS) {
            // SAFETY: as required of the caller.
            unsafe { self.launch(&self.plain, 32, seeds + 12 * first as u64, (count - first).min(MAX_POINTS), &shifted(out, first))? };
        }
        Ok(())
    }

    /// # Safety
    /// `seeds` holds `count` seeds in the kernel's format, and `out` has room for their results.
    unsafe fn launch(
        &self,
        kernel: &CudaFunction,
        seeds_a_warp: usize,
        seeds: u64,
        count: usize,
        out: &Outputs,
    ) -> Result<(), DeviceError> {
        if count == 0 {
            return Ok(());
        }
        let n = count as u32;
        let mut call = self.gpu.work().launch_builder(kernel);
        call.arg(&self.data)
            .arg(&self.times)
            .arg(&self.step)
            .arg(&self.difference_step)
            .arg(&self.result_policy)
            .arg(&seeds)
            .arg(&n)
            .arg(out);
        // SAFETY: as required of the caller; `self` owns all memory that the data points to.
        unsafe { launch(&mut call, threads(32 * count.div_ceil(seeds_a_warp), self.block)) }
    }
}

/// Outputs from entry `first` on.
fn shifted(out: &Outputs, first: usize) -> Outputs {
    let by = |address: u64, bytes: usize| if address == 0 { 0 } else { address + (first * bytes) as u64 };
    Outputs {
        log_stretch: by(out.log_stretch, 4),
        log_stretch_f64: by(out.log_stretch_f64, 8),
        lifetime_share: by(out.lifetime_share, 4),
        arrival: by(out.arrival, 12),
        jacobian: by(out.jacobian, 36),
    }
}

/// Signed length of a step, as a kernel parameter.
fn step_word<R: DeviceReal>(map: &FlowMap, steps: usize) -> [u64; 1] {
    [words(&R::from_f64(map.direction.sign() * map.tau / steps as f64))[0]]
}

/// Launch arguments and macros of `trace_closed.cu`.
pub(in crate::cuda) struct ClosedArguments {
    pub(in crate::cuda) data: Words,
    /// Constants of every stage, as bytes.
    pub(in crate::cuda) stages: Vec<u8>,
    pub(in crate::cuda) defines: Vec<String>,
}

impl ClosedArguments {
    /// `t0`: `None` if every seed of a double gyre has its own start time.
    pub(in crate::cuda) fn new<R: DeviceReal>(flow: &Analytic, domain: &Domain, map: &FlowMap, t0: Option<f64>, steps: usize) -> Self {
        let from = t0.unwrap_or(0.0);
        let to = from + map.direction.sign() * map.tau;
        let (stages, form, rate) = match (flow.form(), t0) {
            (Form::DoubleGyre(form), None) => (stages::<R>(|time| form.constants_since(time), from, to, steps), 0, form.rate()),
            (Form::DoubleGyre(form), _) => (stages::<R>(|time| form.constants(time), from, to, steps), 0, 0.0),
            (Form::Abc(form), _) => (stages::<R>(|time| form.constants(time), from, to, steps), 1, 0.0),
            (Form::Linear(form), _) => (stages::<R>(|time| form.constants(time), from, to, steps), 2, 0.0),
        };
        let defines = closed_defines::<R>(map, form, t0.is_none());
        Self { data: words(&closed_data::<R>(domain, map.boundary, rate)), stages, defines }
    }
}

/// Macros of `trace_closed.cu`.
fn closed_defines<R: DeviceReal>(map: &FlowMap, form: u8, starts: bool) -> Vec<String> {
    vec![
        format!("RW_REAL={}", R::NAME),
        format!("RW_FORM={form}"),
        format!("RW_BOUNDARY={}", boundary_number(map.boundary)),
        format!("RW_DIFFERENCES={}", u8::from(map.integrator == Integrator::Differences)),
        format!("RW_STARTS={}", u8::from(starts)),
    ]
}

/// Edge policy and normalisation of results.
pub(in crate::cuda) fn result_policy(map: &FlowMap, steps: usize) -> ResultPolicy {
    ResultPolicy {
        zero_if_left: i32::from(map.boundary == Boundary::Zero),
        by_lifetime: i32::from(map.normalisation == Normalisation::Lifetime),
        steps: steps as i32,
    }
}

/// `Boundary` of `closed.cuh`.
fn boundary_number(boundary: Boundary) -> u8 {
    match boundary {
        Boundary::Stop => 0,
        Boundary::Clamp => 1,
        Boundary::Periodic => 2,
        Boundary::Unbounded => 3,
        Boundary::Zero => 4,
    }
}

fn closed_data<R: DeviceReal>(domain: &Domain, boundary: Boundary, rate: f64) -> ClosedData<R> {
    let (low, high) = (domain.min.map(R::from_f64), domain.max.map(R::from_f64));
    let (inner_low, inner_high) = match boundary {
        Boundary::Zero => (low.map(R::above), high.map(R::below)),
        _ => (low, high),
    };
    ClosedData { low: inner_low, high: inner_high, box_low: low, box_high: high, rate }
}

/// Constants of every stage as bytes.
fn stages<R: DeviceReal>(constants: impl Fn(f64) -> Constants<f64>, from: f64, to: f64, steps: usize) -> Vec<u8> {
    let halves = 2 * steps;
    let mut bytes = Vec::new();
    for i in 0..=halves {
        for constant in constants(from + (to - from) * (i as f64 / halves as f64)) {
            bytes.extend_from_slice(bytemuck::bytes_of(&R::from_f64(constant)));
        }
    }
    bytes
}
