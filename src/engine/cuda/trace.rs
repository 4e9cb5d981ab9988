//! Tracing on the device: from addresses of seeds to addresses of results, sorted by cell where velocities are read from memory.

use super::grid::GridArguments;
use super::layout::{ClosedData, DeviceReal, Outputs, Verdict, Words, words};
use super::sort::{MOST, SortCells, Sorter};
use super::window::DeviceWindow;
use super::{Buffer, DeviceError, Gpu, SnapshotStore, Storage, launch, threads};
use crate::field::analytic::{Analytic, ClosedForm, Constants, Form};
use crate::field::{Domain, Geometry};
use crate::flow::{Boundary, FlowMap, Integrator, Normalisation, Precision, VelocitySource};
use crate::simd::Real;
use cudarc::driver::{CudaFunction, PushKernelArg};
use std::sync::{Arc, Mutex, PoisonError};

/// In which order seeds are traced, and how velocities are read: for measurements.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Tuning {
    /// How the window is held.
    pub storage: Storage,
    /// Whether batches are sorted by cell.
    pub sorted: bool,
    /// Whether the current cell stays in registers, where it fits; otherwise every stage reads its corners (the plain kernel).
    pub keep: bool,
    /// Whether the particles of a seed's differences, sorted and in a window, are traced by a lane each; otherwise by one thread in turn.
    pub spread: bool,
}

impl Default for Tuning {
    fn default() -> Self {
        Self { storage: Storage::F32, sorted: true, keep: true, spread: true }
    }
}

/// Batches below this are not worth sorting.
const SORT_FROM: usize = 1 << 12;

/// One flow map on the device, ready for seeds.
#[derive(Debug)]
pub struct DeviceTracer {
    gpu: Arc<Gpu>,
    plain: CudaFunction,
    sorted: CudaFunction,
    /// Seeds that a warp of the sorted kernel traces.
    seeds_a_warp: usize,
    block: u32,
    data: Words,
    /// Address of the steps (windows) or the stage constants (closed forms).
    times: u64,
    step: [u64; 1],
    gap: f64,
    verdict: Verdict,
    cells: Option<SortCells>,
    sorter: Mutex<Option<Sorter>>,
    // Memory that the kernels read.
    _window: Option<DeviceWindow>,
    _memory: Vec<Buffer<u8>>,
}

impl DeviceTracer {
    /// For seeds at `t0`, with this many steps. What [`crate::flow::cpu_tracer`] refuses is not checked again.
    ///
    /// # Errors
    /// The adaptive integrator; a window that does not fit; kernels that do not compile.
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
            return Err(DeviceError::Unsupported { what: "the adaptive reference integrator; it runs on the CPU".into() });
        }
        match map.precision {
            Precision::F32 => Self::of_real::<f32>(store, gpu, source, map, t0, steps, tuning),
            Precision::F64 => Self::of_real::<f64>(store, gpu, source, map, t0, steps, tuning),
        }
    }

    /// For seeds with start times of their own: x, y and start. Only a closed form of two dimensions that depends on time by a phase, the double
    /// gyre, can be traced so.
    ///
    /// # Errors
    /// Other flows, the adaptive integrator; kernels that do not compile.
    pub fn with_starts(gpu: &Arc<Gpu>, flow: &Analytic, domain: &Domain, map: &FlowMap, steps: usize) -> Result<Self, DeviceError> {
        if !matches!(flow.form(), Form::DoubleGyre(_)) || map.integrator == Integrator::DormandPrince {
            let what = format!("start times of each seed's own with {:?} and the flow {flow:?}", map.integrator);
            return Err(DeviceError::Unsupported { what });
        }
        match map.precision {
            Precision::F32 => Self::of_closed::<f32>(gpu, flow, domain, map, None, steps),
            Precision::F64 => Self::of_closed::<f64>(gpu, flow, domain, map, None, steps),
        }
    }

    /// `t0`: none where every seed has its own.
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
            gap: map.difference_step,
            verdict: verdict(map, steps),
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
                // In double precision, and with levels on the sphere, the kept cell takes registers that other warps need, and is slower
                // (docs/performance.md).
                let layered = matches!(grid.geometry, Geometry::Sphere { .. }) && grid.dimensions() == 3;
                let keep = tuning.keep && map.precision == Precision::F32 && !layered;
                let arguments = GridArguments::new::<R>(&mut put, &held.nodes(), &times, &grid, map, (t0, to), steps, keep)?;
                let kernel = |name| gpu.kernel("trace_grid.cu", &arguments.defines, name);
                Ok(Self {
                    plain: kernel("trace")?,
                    sorted: kernel(if spread { "trace_particles" } else { "trace_sorted" })?,
                    seeds_a_warp: if spread { 32 / (2 * grid.dimensions()) } else { 32 },
                    block: 128,
                    data: arguments.data,
                    times: arguments.steps,
                    step: step_word::<R>(map, steps),
                    gap: map.difference_step,
                    verdict: verdict(map, steps),
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

    /// Registers a thread and bytes of local memory a thread of the kernel in use.
    pub fn resources(&self) -> Result<(i32, i32), DeviceError> {
        let doing = DeviceError::driver("asking for a kernel's resources");
        let kernel = if self.cells.is_some() { &self.sorted } else { &self.plain };
        Ok((kernel.num_regs().map_err(&doing)?, kernel.local_size_bytes().map_err(&doing)?))
    }

    /// Traces `count` seeds on the device: `seeds` is the address of 3 f32 each, in domain coordinates; results go to `out` in the order of
    /// the seeds. Returns as soon as the work is queued on the work stream.
    ///
    /// # Safety
    /// The memory at these addresses is on this device, holds `count` entries, and lives until the work stream has passed this.
    pub unsafe fn trace(&self, seeds: u64, count: usize, out: &Outputs) -> Result<(), DeviceError> {
        let Some(cells) = self.cells.as_ref().filter(|_| count >= SORT_FROM) else {
            // SAFETY: the caller's.
            return unsafe { self.in_given_order(seeds, count, out) };
        };
        let mut sorter = self.sorter.lock().unwrap_or_else(PoisonError::into_inner);
        if sorter.is_none() {
            *sorter = Some(Sorter::new(&self.gpu)?);
        }
        let Some(sorter) = sorter.as_mut() else { return Err(DeviceError::Unsupported { what: "sorting".into() }) };
        let most = sorter.at_once();
        for first in (0..count).step_by(most) {
            let part = (count - first).min(most);
            // SAFETY: the caller's; the sorted points are read by the launch behind it on the same stream.
            unsafe {
                let sorted = sorter.sort(seeds + 12 * first as u64, part, cells)?;
                self.launch(&self.sorted, self.seeds_a_warp, sorted, part, &shifted(out, first))?;
            }
        }
        Ok(())
    }

    /// Traces `count` seeds that are in a good order already: `{x, y, z, index as bits}`; results go to their index, and index 0xffffffff
    /// is no seed.
    ///
    /// # Safety
    /// As for [`Self::trace`], with room for every index.
    pub(super) unsafe fn in_sequence(&self, sorted: u64, count: usize, out: &Outputs) -> Result<(), DeviceError> {
        // SAFETY: the caller's.
        unsafe { self.launch(&self.sorted, self.seeds_a_warp, sorted, count, out) }
    }

    /// # Safety
    /// As for [`Self::trace`].
    unsafe fn in_given_order(&self, seeds: u64, count: usize, out: &Outputs) -> Result<(), DeviceError> {
        for first in (0..count).step_by(MOST) {
            // SAFETY: the caller's.
            unsafe { self.launch(&self.plain, 32, seeds + 12 * first as u64, (count - first).min(MOST), &shifted(out, first))? };
        }
        Ok(())
    }

    /// # Safety
    /// `seeds` is what the kernel reads, for `count` seeds; `out` has room.
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
        call.arg(&self.data).arg(&self.times).arg(&self.step).arg(&self.gap).arg(&self.verdict).arg(&seeds).arg(&n).arg(out);
        // SAFETY: the caller's; all that the data points to is held by `self`.
        unsafe { launch(&mut call, threads(32 * count.div_ceil(seeds_a_warp), self.block)) }
    }
}

/// The same outputs from entry `first` on.
fn shifted(out: &Outputs, first: usize) -> Outputs {
    let by = |address: u64, bytes: usize| if address == 0 { 0 } else { address + (first * bytes) as u64 };
    Outputs {
        log_stretch: by(out.log_stretch, 4),
        log_stretch_f64: by(out.log_stretch_f64, 8),
        lived: by(out.lived, 4),
        arrival: by(out.arrival, 12),
        jacobian: by(out.jacobian, 36),
    }
}

/// The length of a step, with its sign, as the kernels take it.
fn step_word<R: DeviceReal>(map: &FlowMap, steps: usize) -> [u64; 1] {
    [words(&R::from_f64(map.direction.sign() * map.tau / steps as f64))[0]]
}

/// What `trace_closed.cu` is compiled with and launched with.
pub(super) struct ClosedArguments {
    pub(super) data: Words,
    /// Constants of every stage, as bytes.
    pub(super) stages: Vec<u8>,
    pub(super) defines: Vec<String>,
}

impl ClosedArguments {
    /// `t0`: none where every seed of a double gyre has its own.
    pub(super) fn new<R: DeviceReal>(flow: &Analytic, domain: &Domain, map: &FlowMap, t0: Option<f64>, steps: usize) -> Self {
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

/// What `give` does with a path.
pub(super) fn verdict(map: &FlowMap, steps: usize) -> Verdict {
    Verdict {
        zero_where_left: i32::from(map.boundary == Boundary::Zero),
        by_lived: i32::from(map.normalisation == Normalisation::Lived),
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

fn closed_data<R: Real>(domain: &Domain, boundary: Boundary, rate: f64) -> ClosedData<R> {
    let (low, high) = (domain.min.map(R::from_f64), domain.max.map(R::from_f64));
    let (inner_low, inner_high) = match boundary {
        Boundary::Zero => (low.map(R::above), high.map(R::below)),
        _ => (low, high),
    };
    ClosedData { low: inner_low, high: inner_high, box_low: low, box_high: high, rate }
}

/// Constants of every stage as bytes.
fn stages<R: Real>(constants: impl Fn(f64) -> Constants<f64>, from: f64, to: f64, steps: usize) -> Vec<u8> {
    let halves = 2 * steps;
    let mut bytes = Vec::new();
    for i in 0..=halves {
        for constant in constants(from + (to - from) * (i as f64 / halves as f64)) {
            let constant = R::from_f64(constant);
            bytes.extend_from_slice(&words(&constant)[0].to_le_bytes()[..size_of::<R>()]);
        }
    }
    bytes
}
