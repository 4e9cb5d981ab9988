//! The GPU as the device of a surrogate ([`SurrogateDevice`]): table, network and labels stay in device memory.
//!
//! Training draws from two sets of samples on the device: a copy of the host's replay buffer, and the label pool, which frames fill on the device.

use super::samples::{DeviceLabels, Filled, SampleWriter, TracedBatch};
use super::training::NetworkCopy as DeviceCopy;
use super::{DeviceNetwork, DeviceSamples, DeviceTraining};
use crate::DeviceError;
use crate::cuda::driver::{Buffer, Gpu};
use crate::cuda::layout::Outputs;
use crate::cuda::rendering::{DeviceLearns, DevicePredict, HELD_BACK};
use crate::cuda::tracing::{CudaTracer, DeviceTable};
use bytemuck::cast_slice;
use ridgewatch_field::{Domain, UnitPoint};
use ridgewatch_surrogate::network::{Architecture, Average, Objective, PlannedStep, Target};
use ridgewatch_surrogate::{
    BufferMark, Download, FrozenHybrid, HostNetwork, HostTraining, Hybrid, Labels, NetworkCopy, SurrogateDevice, SurrogateTable,
    SyncedSamples, Table, Training, fresh_stamp,
};
use std::sync::{Arc, Mutex, MutexGuard, OnceLock, PoisonError};
use std::time::Instant;

/// Capacity of the label pool as a multiple of the replay buffer's. The pool uses at most 1 / `MEMORY_SHARE` of the free device memory.
const POOL_PER_BUFFER: usize = 4;
const MEMORY_SHARE: u64 = 8;
/// A copy of the network for a checkpoint uses at most 1 / `COPY_SHARE` of the free device memory, since frames may need the rest.
const COPY_SHARE: u64 = 2;
/// Limit on the optimizer steps between two checks of the clock, and their number before the duration of a step is measured.
const MAX_GROUP: u64 = 64;
const FIRST_GROUP: u64 = 8;
/// Limit on the host points of a prediction batch, to bound the memory of a call.
const BATCH: usize = 1 << 22;
/// Bytes per point, with its prediction.
const POINT_BYTES: u64 = 16;

/// The GPU as the device of a surrogate.
pub struct OnGpu;

impl SurrogateDevice for OnGpu {
    type Tracer<'t> = CudaTracer;
    type Table = CudaTable;
    type Training = CudaTraining;

    fn trace_table(tracer: &CudaTracer, nodes: [usize; 3], old: Option<CudaTable>) -> Result<CudaTable, DeviceError> {
        // Freed first, so that old and new table are never allocated together.
        drop(old);
        Ok(CudaTable::new(DeviceTable::trace(tracer.device(), tracer.host().domain(), nodes)?))
    }

    fn untraced_table(tracer: &CudaTracer, nodes: [usize; 3]) -> Result<CudaTable, DeviceError> {
        Ok(CudaTable::new(DeviceTable::untraced(tracer.device().gpu(), tracer.host().domain(), nodes)?))
    }

    fn trace_more(tracer: &CudaTracer, table: &mut CudaTable, most: usize) -> Result<bool, DeviceError> {
        let shared = || DeviceError::Unsupported { what: "tracing more nodes of a table that is in use".into() };
        table.device.as_mut().and_then(Arc::get_mut).ok_or_else(shared)?.trace_more(tracer.device(), most)
    }

    fn predict(frozen: &FrozenHybrid<Self>, points: &[UnitPoint], out: &mut [f32]) -> Result<(), DeviceError> {
        match frozen_parts(frozen)? {
            (Some(table), None) => predict_from_host(table.gpu(), table, points, out),
            (base, Some(network)) => {
                let above = network.network.above(base.map(|base| (base, frozen.shrinkage))).at(frozen.times);
                predict_from_host(&network.gpu, &above, points, out)
            }
            (None, None) => {
                out.fill(0.0);
                Ok(())
            }
        }
    }
}

/// Returns the table and the network of a frozen surrogate, on the device.
///
/// # Errors
/// The memory of the table on the device is already freed.
pub(in crate::cuda) fn frozen_parts(frozen: &FrozenHybrid<OnGpu>) -> Result<(Option<&DeviceTable>, Option<&CudaNetwork>), DeviceError> {
    Ok((frozen.table.as_ref().map(CudaTable::device).transpose()?, frozen.network.as_deref()))
}

/// Device time of a prediction, in seconds; copies do not count.
///
/// # Errors
/// The device fails or lacks memory.
pub(in crate::cuda) fn seconds_of_prediction(frozen: &FrozenHybrid<OnGpu>, points: &[UnitPoint]) -> Result<f64, DeviceError> {
    let time = |gpu: &Gpu, by: &dyn DevicePredict| {
        let points = gpu.upload::<[f32; 3]>("points", cast_slice(points))?;
        let out = gpu.alloc::<f32>("predictions", points.len())?;
        let begin = gpu.mark()?;
        // SAFETY: both buffers hold as many entries as there are points, and live until the marks are compared, which waits for the stream.
        unsafe { by.predict(points.address(), points.len(), out.address())? };
        Ok(1e-3 * f64::from(gpu.milliseconds(&begin, &gpu.mark()?)?))
    };
    match frozen_parts(frozen)? {
        (Some(table), None) => time(table.gpu(), table),
        (base, Some(network)) => time(&network.gpu, &network.network.above(base.map(|base| (base, frozen.shrinkage))).at(frozen.times)),
        (None, None) => Ok(0.0),
    }
}

/// Predicts at points on the host, in unit coordinates.
///
/// # Errors
/// The device fails or lacks memory.
pub(in crate::cuda) fn predict_from_host(
    gpu: &Gpu,
    by: &dyn DevicePredict,
    points: &[UnitPoint],
    out: &mut [f32],
) -> Result<(), DeviceError> {
    let batch = gpu.batch(BATCH, POINT_BYTES);
    for (points, out) in points.chunks(batch).zip(out.chunks_mut(batch)) {
        let unit = gpu.upload::<[f32; 3]>("points to predict at", cast_slice(points))?;
        let values = gpu.alloc::<f32>("points to predict at", points.len())?;
        // SAFETY: both buffers hold `points.len()` entries, and the read waits for the stream.
        unsafe { by.predict(unit.address(), points.len(), values.address()) }?;
        values.read(out)?;
    }
    Ok(())
}

/// Traces uniform random points on the device and adds them to the labels there, as [`crate::Surrogate::trace_labels`] does. Waits for them, so that
/// who trains on a clock does not charge them to the training.
///
/// # Errors
/// The device fails or lacks memory.
pub(in crate::cuda) fn trace_labels(
    hybrid: &Hybrid<OnGpu>,
    tracer: &CudaTracer,
    seed: u64,
    first: u64,
    count: usize,
) -> Result<bool, DeviceError> {
    let frozen = hybrid.freeze()?;
    let (base, network) = frozen_parts(&frozen)?;
    let domain = tracer.host().domain();
    let sink = network.and_then(|network| network.label_sink(domain, base, frozen.times));
    let resident = hybrid.training().and_then(|training| training.resident.as_ref());
    let (Some(sink), Some(resident), None) = (sink, resident, tracer.missing_cells()) else { return Ok(false) };
    let gpu = tracer.device().gpu();
    let mut points = gpu.alloc::<[f32; 3]>("points of labels", count)?;
    let log_stretch = gpu.alloc::<f32>("labels", count)?;
    let writer = &sink.pool.writer;
    let arrival = (writer.target() == Target::FlowMap).then(|| gpu.alloc::<[f32; 3]>("labels", count)).transpose()?;
    let jacobian = writer.objective.derivatives().then(|| gpu.alloc::<[f32; 9]>("labels", count)).transpose()?;
    resident.training.draw_points(domain, seed, first, &mut points)?;
    let out = Outputs {
        log_stretch: log_stretch.address(),
        arrival: arrival.as_ref().map_or(0, Buffer::address),
        jacobian: jacobian.as_ref().map_or(0, Buffer::address),
        ..Outputs::default()
    };
    // SAFETY: every buffer holds `count` entries and is freed in the order of the work stream.
    unsafe {
        tracer.device().trace(points.address(), count, &out)?;
        sink.learn_from(points.address(), &out, count)?;
    }
    gpu.synchronize()?;
    Ok(true)
}

/// A table on the GPU, with a copy on the host after the first download.
#[derive(Clone)]
pub struct CudaTable {
    /// `None` after its device memory is freed for a table of another size.
    device: Option<Arc<DeviceTable>>,
    host: Arc<OnceLock<Table>>,
    /// Identifies the values: two tables of this process have the same stamp only if they have the same values.
    stamp: u64,
}

impl CudaTable {
    fn new(table: DeviceTable) -> Self {
        Self { device: Some(Arc::new(table)), host: Arc::default(), stamp: fresh_stamp() }
    }

    /// Returns the table on the device.
    ///
    /// # Errors
    /// Its device memory is already freed.
    pub fn device(&self) -> Result<&DeviceTable, DeviceError> {
        self.device.as_deref().ok_or_else(|| DeviceError::Unsupported { what: "a table whose device memory is freed".into() })
    }

    /// Downloads the values. The device memory is freed when no frame uses it any more.
    ///
    /// # Errors
    /// The device fails.
    pub(in crate::cuda) fn leave_device(&mut self) -> Result<(), DeviceError> {
        self.to_host()?;
        self.device = None;
        Ok(())
    }
}

impl SurrogateTable for CudaTable {
    fn to_host(&self) -> Result<Table, DeviceError> {
        if let Some(table) = self.host.get() {
            return Ok(table.clone());
        }
        let device = self.device()?;
        let table = Table::from_values(device.nodes(), device.values()?, device.not_finite());
        Ok(self.host.get_or_init(|| table).clone())
    }

    fn with_values(&self, values: Table) -> Result<Self, DeviceError> {
        Ok(Self::new(self.device()?.with_values(&values)?))
    }
}

/// Labels that frames trace on the device and that stay on it. A slide that invalidates them clears the pool. The lock serialises writes by frames
/// and reads by training.
#[derive(Debug)]
pub(in crate::cuda) struct LabelPool {
    writer: SampleWriter,
    samples: Mutex<DeviceSamples>,
}

impl LabelPool {
    /// Returns a mark of the present content, for [`Self::go_back`].
    pub(in crate::cuda) fn mark(&self) -> Filled {
        self.samples().filled()
    }

    /// Removes the labels that were added after a mark.
    pub(in crate::cuda) fn go_back(&self, to: Filled) {
        self.samples().go_back(to);
    }

    fn samples(&self) -> MutexGuard<'_, DeviceSamples> {
        self.samples.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Sink that adds the labels of one frame to the pool.
pub(in crate::cuda) struct LabelSink<'a> {
    pool: &'a LabelPool,
    domain: &'a Domain,
    base: Option<&'a DeviceTable>,
    times: [f32; 2],
}

impl DeviceLearns for LabelSink<'_> {
    unsafe fn learn_from(&self, points: u64, traced: &Outputs, count: usize) -> Result<(), DeviceError> {
        let (writer, mut samples) = (&self.pool.writer, self.pool.samples());
        let values = match writer.target() {
            Target::Ftle => traced.log_stretch,
            Target::FlowMap => traced.arrival,
        };
        if values == 0 || (writer.objective.derivatives() && traced.jacobian == 0) {
            return Ok(());
        }
        let labels = DeviceLabels { values, jacobians: traced.jacobian };
        let (base, times) = (self.base, Some(self.times));
        let batch = TracedBatch { domain: self.domain, points, labels, count, base, times, held_back: HELD_BACK };
        // SAFETY: guaranteed by the caller.
        unsafe { writer.append(&mut samples, batch) }
    }
}

/// An immutable network on the GPU, for prediction.
pub struct CudaNetwork {
    gpu: Arc<Gpu>,
    network: DeviceNetwork,
    /// Label pool of its training. `None` if the CPU trains the network.
    pool: Option<Arc<LabelPool>>,
}

impl CudaNetwork {
    /// The network for prediction.
    pub fn network(&self) -> &DeviceNetwork {
        &self.network
    }

    pub(in crate::cuda) fn pool(&self) -> Option<&Arc<LabelPool>> {
        self.pool.as_ref()
    }

    /// Returns the sink for the labels of a frame at these unit times. Targets are differences from `base`. `None` if the CPU trains the network.
    pub(in crate::cuda) fn label_sink<'a>(
        &'a self,
        domain: &'a Domain,
        base: Option<&'a DeviceTable>,
        times: [f32; 2],
    ) -> Option<LabelSink<'a>> {
        self.pool.as_ref().map(|pool| LabelSink { pool, domain, base, times })
    }
}

/// A network in training. It moves to the GPU in `begin`, once the scale of its targets is known, unless the placement assigns training to the CPU.
pub struct CudaTraining {
    gpu: Arc<Gpu>,
    /// Training on the CPU. After the move to the GPU, the latest host copy of the network.
    host: HostTraining,
    /// Training on the GPU. `None` before the move, and with training on the CPU.
    resident: Option<Resident>,
    /// True if training may move to the GPU.
    may_move: bool,
    /// Latest upload of a network that the CPU trains, with the parameters that it was made from.
    uploaded: Mutex<Option<(Arc<Average>, Arc<CudaNetwork>)>>,
}

/// Training state on the GPU.
struct Resident {
    training: DeviceTraining,
    samples: DeviceSamples,
    /// Position of the replay buffer at the latest sync. `None` before the first.
    mark: Option<BufferMark>,
    /// Stamps of the tables to which the targets of `samples` and of the pool are relative. `pool_base` is `None` before the first sync.
    base: Option<u64>,
    pool_base: Option<Option<u64>>,
    usable: usize,
    usable_in_pool: usize,
    pool: Arc<LabelPool>,
    /// Device seconds of the steps since the last [`Training::device_seconds`].
    seconds: f64,
    /// Wall-clock seconds per step, measured over the latest steps; 0 before the first.
    step_seconds: f64,
    /// Copy for prediction of the present parameters. Empty until it is requested.
    frozen: OnceLock<Arc<CudaNetwork>>,
    /// Memory for checkpoint copies. `None` before the first copy and during a download.
    copy_memory: CopyMemory,
}

type CopyMemory = Arc<Mutex<Option<DeviceCopy>>>;

/// A checkpoint copy. Dropping it returns its memory to `memory`.
struct HeldCopy {
    copy: Option<DeviceCopy>,
    memory: CopyMemory,
}

impl Drop for HeldCopy {
    fn drop(&mut self) {
        *self.memory.lock().unwrap_or_else(PoisonError::into_inner) = self.copy.take();
    }
}

impl CudaTraining {
    /// Creates the training of a network. It moves to the GPU before the first steps if `may_move` is true.
    pub fn new(gpu: &Arc<Gpu>, network: HostNetwork, may_move: bool) -> Self {
        Self { gpu: gpu.clone(), host: HostTraining::new(network), resident: None, may_move, uploaded: Mutex::default() }
    }

    /// Moves training to the CPU for the rest of the run.
    ///
    /// # Errors
    /// The device fails.
    pub fn move_to_host(&mut self) -> Result<(), DeviceError> {
        if let Some(resident) = &self.resident {
            self.host = HostTraining::new(resident.download(&self.host.host_copy().model)?);
            self.resident = None;
        }
        self.may_move = false;
        Ok(())
    }

    /// Allocates the label pool that belongs to a replay buffer of `capacity` samples.
    ///
    /// # Errors
    /// The device fails or lacks memory.
    fn pool(gpu: &Gpu, training: &DeviceTraining, capacity: usize) -> Result<Arc<LabelPool>, DeviceError> {
        let writer = training.writer();
        let most = gpu.memory_left() / MEMORY_SHARE / writer.sample_bytes() as u64;
        // The kernels index the samples of pool and replay buffer together with 32 bits.
        let capacity = POOL_PER_BUFFER.saturating_mul(capacity).min(most as usize).clamp(1, 1 << 31);
        Ok(Arc::new(LabelPool { writer, samples: Mutex::new(training.replay_buffer(capacity)?) }))
    }
}

impl Resident {
    fn new(gpu: &Arc<Gpu>, network: &HostNetwork, objective: &Objective, capacity: usize, batch: usize) -> Result<Self, DeviceError> {
        let mut training = DeviceTraining::new(gpu, &network.model, objective)?;
        training.set_average(&network.average)?;
        training.reserve(batch)?;
        // The first call allocates the memory of the state for a rollback.
        training.keep()?;
        let samples = training.replay_buffer(capacity)?;
        let pool = CudaTraining::pool(gpu, &training, capacity)?;
        Ok(Self {
            training,
            samples,
            mark: None,
            base: None,
            pool_base: None,
            usable: 0,
            usable_in_pool: 0,
            pool,
            seconds: 0.0,
            step_seconds: 0.0,
            frozen: OnceLock::new(),
            copy_memory: Arc::default(),
        })
    }

    fn download(&self, shaped: &ridgewatch_surrogate::network::Model) -> Result<HostNetwork, DeviceError> {
        let mut model = shaped.clone();
        let average = Arc::new(self.training.average()?);
        self.training.store(&mut model)?;
        Ok(HostNetwork { model, average })
    }
}

impl Training for CudaTraining {
    type Table = CudaTable;
    type Network = CudaNetwork;

    fn shape(&self) -> &Architecture {
        self.host.shape()
    }

    fn steps_taken(&self) -> usize {
        self.resident.as_ref().map_or_else(|| self.host.steps_taken(), |resident| resident.training.steps())
    }

    fn is_on_device(&self) -> bool {
        self.may_move
    }

    fn begin(&mut self, objective: &Objective, capacity: usize, batch: usize) -> Result<(), DeviceError> {
        self.host.begin(objective, capacity, batch)?;
        if self.may_move && self.resident.is_none() {
            self.resident = Some(Resident::new(&self.gpu, self.host.host_copy(), objective, capacity, batch)?);
        }
        Ok(())
    }

    fn sync(&mut self, objective: &Objective, labels: Labels<'_, CudaTable>) -> Result<SyncedSamples, DeviceError> {
        let Some(resident) = &mut self.resident else {
            return self.host.sync(objective, Labels { buffer: labels.buffer, base: None });
        };
        let Labels { buffer, base } = labels;
        let stamp = base.map(|base| base.stamp);
        let known = resident.mark.filter(|&mark| resident.base == stamp && buffer.continues(mark));
        if known.is_none() {
            resident.samples.clear();
        }
        if resident.pool_base.replace(stamp).is_some_and(|of| of != stamp) {
            resident.pool.samples().clear();
        }
        let below = base.map(CudaTable::device).transpose()?;
        // The older range comes first.
        let [newest, wrapped] = buffer.written_since(known);
        for range in [wrapped, newest].into_iter().filter(|range| !range.is_empty()) {
            resident.training.write(&mut resident.samples, range, buffer.samples(), below)?;
        }
        let pool = resident.pool.samples();
        [resident.usable, resident.usable_in_pool] = resident.training.usable([&resident.samples, &pool])?;
        drop(pool);
        (resident.mark, resident.base) = (Some(buffer.mark()), stamp);
        Ok(SyncedSamples { usable: resident.usable + resident.usable_in_pool, dropped: buffer.len() - resident.usable })
    }

    fn train(&mut self, objective: &Objective, labels: Labels<'_, CudaTable>, steps: &[PlannedStep]) -> Result<Vec<f64>, DeviceError> {
        let Some(resident) = &mut self.resident else {
            let base = labels.base.map(SurrogateTable::to_host).transpose()?;
            return self.host.train(objective, Labels { buffer: labels.buffer, base: base.as_ref() }, steps);
        };
        let begin = Instant::now();
        resident.frozen = OnceLock::new();
        let pool = resident.pool.samples();
        let mark = self.gpu.mark()?;
        let mut losses = resident.training.train_steps(&resident.samples, Some(&pool), steps)?;
        resident.seconds += 1e-3 * f64::from(self.gpu.milliseconds(&mark, &self.gpu.mark()?)?);
        // Samples without a target are drawn too and add 0 to the batch mean. This factor corrects the mean for them.
        let drawn = (resident.samples.len() + pool.len()) as f64 / (resident.usable + resident.usable_in_pool) as f64;
        losses.iter_mut().for_each(|loss| *loss *= drawn);
        resident.step_seconds = begin.elapsed().as_secs_f64() / steps.len() as f64;
        Ok(losses)
    }

    fn group(&self, seconds: f64) -> u64 {
        match &self.resident {
            None => self.host.group(seconds),
            Some(resident) if resident.step_seconds == 0.0 => FIRST_GROUP,
            Some(resident) => ((seconds / resident.step_seconds) as u64).clamp(1, MAX_GROUP),
        }
    }

    fn keep(&mut self) -> Result<(), DeviceError> {
        self.resident.as_mut().map_or_else(|| self.host.keep(), |resident| resident.training.keep())
    }

    fn roll_back(&mut self) -> Result<(), DeviceError> {
        let Some(resident) = &mut self.resident else { return self.host.roll_back() };
        resident.frozen = OnceLock::new();
        resident.training.roll_back()
    }

    fn restart_average(&mut self) -> Result<(), DeviceError> {
        let Some(resident) = &mut self.resident else { return self.host.restart_average() };
        resident.frozen = OnceLock::new();
        resident.training.restart_average()
    }

    fn settle(&mut self) {
        if self.resident.is_none() {
            self.host.settle();
        }
    }

    fn zero_output(&mut self) -> Result<(), DeviceError> {
        let output = self.shape().output_parameters();
        let Some(resident) = &mut self.resident else { return self.host.zero_output() };
        resident.frozen = OnceLock::new();
        resident.training.zero_layers(output)
    }

    fn forget_labels(&mut self) {
        if let Some(resident) = &mut self.resident {
            resident.pool.samples().clear();
            resident.pool_base = None;
        }
    }

    fn frozen(&self, objective: &Objective) -> Result<Arc<CudaNetwork>, DeviceError> {
        let gpu = self.gpu.clone();
        if let Some(resident) = &self.resident {
            if let Some(frozen) = resident.frozen.get() {
                return Ok(frozen.clone());
            }
            let network = CudaNetwork { gpu, network: resident.training.frozen()?, pool: Some(resident.pool.clone()) };
            return Ok(resident.frozen.get_or_init(|| Arc::new(network)).clone());
        }
        let average = &self.host.host_copy().average;
        let mut uploaded = self.uploaded.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some((_, network)) = uploaded.as_ref().filter(|(of, _)| Arc::ptr_eq(of, average)) {
            return Ok(network.clone());
        }
        // Freed first, so that old and new network are never allocated together.
        *uploaded = None;
        let network = DeviceNetwork::upload(&gpu, self.shape(), objective, &average.tables, &average.layers)?;
        let network = Arc::new(CudaNetwork { gpu, network, pool: None });
        *uploaded = Some((average.clone(), network.clone()));
        Ok(network)
    }

    fn download(&self) -> Result<HostNetwork, DeviceError> {
        self.resident.as_ref().map_or_else(|| self.host.download(), |resident| resident.download(&self.host.host_copy().model))
    }

    fn copy(&mut self) -> Result<NetworkCopy, DeviceError> {
        let Some(resident) = &self.resident else { return self.host.copy() };
        let memory = resident.copy_memory.clone();
        let taken = memory.lock().unwrap_or_else(PoisonError::into_inner).take();
        let (needed, left) = (resident.training.copy_bytes(), self.gpu.memory_left());
        let waited = |why: String| Ok(NetworkCopy::Ready(resident.download(&self.host.host_copy().model)?, Some(why)));
        if taken.is_none() && needed > left / COPY_SHARE {
            let [needed, left] = [needed, left].map(|bytes| bytes.div_ceil(1 << 20));
            return waited(format!(
                "a copy of the network needs {needed} MiB on the GPU; {left} MiB are left, half of which is reserved for frames"
            ));
        }
        match resident.training.copy(taken) {
            Ok(copy) => {
                let (gpu, mut model) = (self.gpu.clone(), self.host.host_copy().model.clone());
                let held = HeldCopy { copy: Some(copy), memory };
                let download: Download = Box::new(move || {
                    let mut average = Average::default();
                    if let Some(copy) = &held.copy {
                        copy.read_behind(&gpu, &mut model, &mut average)?;
                    }
                    Ok(HostNetwork { model, average: Arc::new(average) })
                });
                Ok(NetworkCopy::Downloadable(download))
            }
            // The copy is within the cap, but other programs use the rest of the memory.
            Err(error) if error.is_out_of_memory() => waited(error.to_string()),
            Err(error) => Err(error),
        }
    }

    fn host_copy(&self) -> &HostNetwork {
        self.host.host_copy()
    }

    fn set_host_copy(&mut self, network: HostNetwork) {
        self.host.set_host_copy(network);
    }

    fn restore(&mut self, network: HostNetwork) {
        self.resident = None;
        self.host.restore(network);
    }

    fn device_seconds(&mut self) -> Option<f64> {
        self.resident.as_mut().map(|resident| std::mem::take(&mut resident.seconds))
    }
}
