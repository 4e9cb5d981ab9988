//! Routes the log-stretch queries of a frame on the device by the rule of [`crate::QueryRouter`], and keeps a sample of the traced ones as
//! training labels.
//!
//! Each batch runs four steps: `answer_split` lists the points to predict and the points to trace, the predictor evaluates the first list, the
//! tracer the second, and `answer_join` writes the values back in the order of the queries.

use crate::cuda::driver::pinned::Pinned;
use crate::cuda::driver_error;
use crate::cuda::layout::{ChoiceArgument, ListsArgument, Outputs, UnitBoxArgument};
use crate::cuda::rendering::labels::{HELD_BACK, Labels};
use crate::cuda::{Buffer, DeviceError, DeviceMissingCells, DeviceTracer, Gpu, launch, threads};
use cudarc::driver::{CudaEvent, CudaFunction, PushKernelArg, result};
use ridgewatch_field::Domain;
use ridgewatch_flow::Extras;
use ridgewatch_surrogate::Samples;
use ridgewatch_trust::Gate;
use std::sync::Arc;

/// Evaluates log-stretch queries in device memory.
pub trait DeviceLogStretch {
    /// Enqueues on the work stream the evaluation of `count` points. All addresses are device addresses.
    ///
    /// - `points`: three f32 per point, domain coordinates.
    /// - `log_stretch`: output, one f32 per point; NaN in missing cells.
    /// - `by`: output, one byte per point: 0 predicted, 1 traced with RK4, 2 predicted in an untrusted cell because the tracing budget was spent.
    ///
    /// # Errors
    /// The device fails or lacks memory.
    fn evaluate(&mut self, points: u64, count: usize, log_stretch: u64, by: u64) -> Result<(), DeviceError>;

    /// Called after all waves of a frame, before its results are used.
    ///
    /// # Errors
    /// The device fails. The caller then discards the frame.
    fn end(&mut self) -> Result<(), DeviceError> {
        Ok(())
    }
}

/// A predictor on the device: table, network, or both.
pub trait DevicePredict {
    /// Enqueues on the work stream the prediction of the log-stretch at `count` points. `points` is the device address of the points (three f32 each,
    /// unit coordinates; points outside the domain are moved to its edge), `out` that of the output (one f32 each).
    ///
    /// # Errors
    /// The device fails or lacks memory.
    ///
    /// # Safety
    /// Both addresses are memory of this device with `count` entries, which lives until the work stream has executed the prediction.
    unsafe fn predict(&self, points: u64, count: usize, out: u64) -> Result<(), DeviceError>;
}

/// A sink for labels that were traced on the device and stay on it.
pub trait DeviceLearns {
    /// Enqueues on the work stream the storage of `count` traced points (device address `points`, three f32 each, domain coordinates). Points that
    /// the host may keep for validation get no target.
    ///
    /// # Errors
    /// The device fails or lacks memory.
    ///
    /// # Safety
    /// All addresses are memory of this device with `count` entries, which lives until the work stream has executed this.
    unsafe fn learn_from(&self, points: u64, traced: &Outputs, count: usize) -> Result<(), DeviceError>;
}

/// Traces every query.
pub struct TraceAll<'a>(pub &'a DeviceTracer);

impl DeviceLogStretch for TraceAll<'_> {
    fn evaluate(&mut self, points: u64, count: usize, log_stretch: u64, by: u64) -> Result<(), DeviceError> {
        let gpu = self.0.gpu();
        let doing = driver_error("filling device memory");
        gpu.context().bind_to_thread().map_err(&doing)?;
        // SAFETY: the renderer's queue holds `count` entries at each address until the next wave, which comes later on the stream.
        unsafe {
            result::memset_d8_async(by, 1, count, gpu.work().cu_stream()).map_err(&doing)?;
            self.0.trace(points, count, &Outputs { log_stretch, ..Outputs::default() })
        }
    }
}

/// Tracer, predictor and routing for the queries of one frame.
pub struct FrameQueries<'a> {
    /// RK4 tracer.
    pub tracer: &'a DeviceTracer,
    /// Domain of the seeds.
    pub domain: &'a Domain,
    /// Cells whose queries are NaN. `None` if every cell has data.
    pub missing_cells: Option<&'a DeviceMissingCells>,
    /// Predictor for trusted cells. `None`: every query is traced.
    pub surrogate: Option<&'a dyn DevicePredict>,
    /// Sink for labels on the device. `None` if the device does not train.
    pub label_sink: Option<&'a dyn DeviceLearns>,
    /// Cells in which the surrogate is trusted.
    pub gate: &'a Gate,
    /// Device seconds of tracing after which the surrogate predicts in untrusted cells too. `None`: no limit.
    pub trace_budget: Option<f64>,
    /// Upper bound (exclusive) on the labels that are read back to the host, at most 4,194,304.
    pub keep: usize,
    /// What labels have besides the log-stretch.
    pub extras: Extras,
}

/// Limit on the points of a batch.
const CHUNK: usize = 1 << 23;
/// Bytes per point in the lists.
const POINT: u64 = 20;

/// Splits the queries of each wave between surrogate and tracer. It reuses its memory between frames.
pub struct DeviceQueryRouter {
    gpu: Arc<Gpu>,
    split: CudaFunction,
    join: CudaFunction,
    memory: Option<Memory>,
}

struct Memory {
    capacity: usize,
    points: Buffer<[f32; 3]>,
    places: Buffer<u32>,
    values: Buffer<f32>,
    /// Arrival points of the traced queries. `None` until they are requested.
    arrivals: Option<Buffer<[f32; 3]>>,
    /// Their Jacobians. `None` until they are requested.
    jacobians: Option<Buffer<[f32; 9]>>,
    /// Lengths of the list to predict, of the list to trace, and of the labels.
    lengths: Buffer<u32>,
    pinned: Pinned<u32>,
}

impl Memory {
    fn new(gpu: &Gpu) -> Result<Self, DeviceError> {
        let capacity = gpu.batch(CHUNK, POINT);
        let what = "the lists of a gated frame";
        Ok(Self {
            capacity,
            points: gpu.alloc(what, capacity)?,
            places: gpu.alloc(what, capacity)?,
            values: gpu.alloc(what, capacity)?,
            arrivals: None,
            jacobians: None,
            lengths: gpu.alloc(what, 3)?,
            pinned: Pinned::new(gpu.context(), 3)?,
        })
    }

    /// Waits for the work so far and returns the lengths.
    fn lengths(&mut self, gpu: &Gpu) -> Result<[usize; 3], DeviceError> {
        let from = self.lengths.address();
        // SAFETY: `lengths` holds three values.
        unsafe { self.pinned.copy_from(gpu.work(), from, 3) }?;
        gpu.synchronize()?;
        let lengths = self.pinned.values();
        Ok([lengths[0] as usize, lengths[1] as usize, lengths[2] as usize])
    }
}

impl DeviceQueryRouter {
    /// Compiles the kernels or loads them from the cache.
    ///
    /// # Errors
    /// A kernel does not compile, or the device fails.
    pub fn new(gpu: &Arc<Gpu>) -> Result<Self, DeviceError> {
        let kernel = |name| gpu.kernel("answer.cu", &[], name);
        Ok(Self { split: kernel("answer_split")?, join: kernel("answer_join")?, gpu: gpu.clone(), memory: None })
    }

    /// For tests: fills the memory between frames with bytes that are NaN as floats and out of range as indices.
    ///
    /// # Errors
    /// A driver call fails.
    pub fn poison(&mut self) -> Result<(), DeviceError> {
        let Some(memory) = &mut self.memory else { return Ok(()) };
        memory.points.fill_bytes(0xFF)?;
        memory.places.fill_bytes(0xFF)?;
        memory.values.fill_bytes(0xFF)
    }

    /// Prepares the queries of one frame.
    ///
    /// # Errors
    /// The device fails or lacks memory.
    pub fn begin<'a>(&'a mut self, queries: FrameQueries<'a>) -> Result<RoutedQueries<'a>, DeviceError> {
        let gpu = self.gpu.clone();
        let memory = match self.memory.take() {
            Some(memory) => memory,
            None => Memory::new(&gpu)?,
        };
        let memory = self.memory.insert(memory);
        memory.lengths.fill_bytes(0)?;
        if queries.extras.arrival && memory.arrivals.is_none() {
            memory.arrivals = Some(gpu.alloc("the lists of a gated frame", memory.capacity)?);
        }
        if queries.extras.jacobian && memory.jacobians.is_none() {
            memory.jacobians = Some(gpu.alloc("the lists of a gated frame", memory.capacity)?);
        }
        let trusted: Vec<u8> = queries.gate.cells().iter().map(|&trusted| u8::from(trusted)).collect();
        let trusted = queries.surrogate.map(|_| gpu.upload("a gate", &trusted)).transpose()?;
        let choice = ChoiceArgument {
            domain: UnitBoxArgument::new(queries.domain),
            gate_shape: queries.gate.shape().map(|n| n as i32),
            gate_pad: 0,
            trusted: trusted.as_ref().map_or(0, Buffer::address),
            missing_cells: queries.missing_cells.map_or_else(bytemuck::Zeroable::zeroed, DeviceMissingCells::argument),
            budget_spent: 0,
            pad: 0,
        };
        Ok(RoutedQueries {
            labels: Labels::new(&gpu, queries.keep, if queries.label_sink.is_some() { HELD_BACK } else { 0 }, queries.extras)?,
            split: &self.split,
            join: &self.join,
            memory,
            gpu,
            queries,
            choice,
            _trusted: trusted,
            marks: None,
            trace_seconds: 0.0,
            predict_seconds: 0.0,
        })
    }
}

/// Evaluation of the queries of one frame, with its labels and times.
pub struct RoutedQueries<'a> {
    gpu: Arc<Gpu>,
    split: &'a CudaFunction,
    join: &'a CudaFunction,
    memory: &'a mut Memory,
    queries: FrameQueries<'a>,
    choice: ChoiceArgument,
    _trusted: Option<Buffer<u8>>,
    labels: Labels,
    /// Events of the latest batch, not yet added to the times: start and end of the split, start and end of the prediction, end of the tracing,
    /// end of the join.
    marks: Option<[CudaEvent; 6]>,
    trace_seconds: f64,
    predict_seconds: f64,
}

impl RoutedQueries<'_> {
    /// Device seconds of sorting and tracing so far.
    pub fn trace_seconds(&self) -> f64 {
        self.trace_seconds
    }

    /// Device seconds of split, prediction and join so far.
    pub fn predict_seconds(&self) -> f64 {
        self.predict_seconds
    }

    /// Returns the labels in unit coordinates. They include speculative points that no flight used.
    pub fn labels(&mut self) -> Samples {
        self.labels.finish(self.queries.domain)
    }

    /// Adds the times of the latest batch. Waits for its work.
    fn add_up(&mut self) -> Result<(), DeviceError> {
        let Some([begun, divided, asked, predicted, traced, joined]) = self.marks.take() else { return Ok(()) };
        let seconds = |from: &CudaEvent, to: &CudaEvent| self.gpu.milliseconds(from, to).map(|ms| f64::from(ms) * 1e-3);
        let predicting = seconds(&begun, &divided)? + seconds(&asked, &predicted)? + seconds(&traced, &joined)?;
        let tracing = seconds(&predicted, &traced)?;
        self.predict_seconds += predicting;
        self.trace_seconds += tracing;
        Ok(())
    }

    /// Evaluates a batch of points, at most as many as the lists hold.
    fn chunk(&mut self, points: u64, count: usize, log_stretch: u64, by: u64) -> Result<(), DeviceError> {
        self.add_up()?;
        let gpu = self.gpu.clone();
        let stream = gpu.work();
        let spent = self.queries.surrogate.is_some() && self.queries.trace_budget.is_some_and(|budget| self.trace_seconds >= budget);
        let choice = ChoiceArgument { budget_spent: i32::from(spent), ..self.choice };
        let (capacity, n) = (self.memory.capacity, count as u32);
        let lists = ListsArgument {
            points: self.memory.points.address(),
            places: self.memory.places.address(),
            values: self.memory.values.address(),
            arrivals: self.memory.arrivals.as_ref().filter(|_| self.queries.extras.arrival).map_or(0, Buffer::address),
            jacobians: self.memory.jacobians.as_ref().filter(|_| self.queries.extras.jacobian).map_or(0, Buffer::address),
            lengths: self.memory.lengths.address(),
            capacity: capacity as u32,
            pad: 0,
        };
        self.memory.lengths.zero_front(2)?;
        let begun = gpu.mark()?;
        let mut call = stream.launch_builder(self.split);
        call.arg(&choice).arg(&points).arg(&n).arg(&log_stretch).arg(&by).arg(&lists);
        // SAFETY: the arguments of `answer_split`; the renderer's arrays hold `count` entries, and the lists at least as many.
        unsafe { launch(&mut call, threads(count, 256)) }?;
        let divided = gpu.mark()?;
        let [predicted, traced, stored] = self.memory.lengths(&gpu)?;
        let asked = gpu.mark()?;
        if let Some(surrogate) = self.queries.surrogate {
            // SAFETY: the front of each list holds `predicted` entries; the next use of the memory comes later on the stream.
            unsafe { surrogate.predict(lists.points, predicted, lists.values) }?;
        }
        let answered = gpu.mark()?;
        let back = (capacity - traced) as u64;
        let arrival = if lists.arrivals == 0 { 0 } else { lists.arrivals + 12 * back };
        let jacobian = if lists.jacobians == 0 { 0 } else { lists.jacobians + 36 * back };
        let out = Outputs { log_stretch: lists.values + 4 * back, arrival, jacobian, ..Outputs::default() };
        // SAFETY: as above, with `traced` entries at the back of each list.
        unsafe { self.queries.tracer.trace(lists.points + 12 * back, traced, &out) }?;
        let tracing = gpu.mark()?;
        if let Some(label_sink) = self.queries.label_sink {
            // SAFETY: as above.
            unsafe { label_sink.learn_from(lists.points + 12 * back, &out, traced) }?;
        }
        let (labels, emptied) = self.labels.offer(traced, stored, lists.lengths + 8)?;
        if emptied {
            self.memory.lengths.zero_at(2, 1)?;
        }
        let (predicted, traced) = (predicted as u32, traced as u32);
        let mut call = stream.launch_builder(self.join);
        call.arg(&lists).arg(&predicted).arg(&traced).arg(&log_stretch).arg(&labels);
        // SAFETY: the arguments of `answer_join`; the lists have the given lengths, and their places are below `count`.
        unsafe { launch(&mut call, threads((predicted + traced) as usize, 256)) }?;
        self.marks = Some([begun, divided, asked, answered, tracing, gpu.mark()?]);
        Ok(())
    }
}

impl DeviceLogStretch for RoutedQueries<'_> {
    fn evaluate(&mut self, points: u64, count: usize, log_stretch: u64, by: u64) -> Result<(), DeviceError> {
        for first in (0..count).step_by(self.memory.capacity) {
            let (part, at) = ((count - first).min(self.memory.capacity), first as u64);
            self.chunk(points + 12 * at, part, log_stretch + 4 * at, by + at)?;
        }
        Ok(())
    }

    fn end(&mut self) -> Result<(), DeviceError> {
        let [_, _, stored] = self.memory.lengths(&self.gpu)?;
        self.add_up()?;
        self.labels.take(stored)
    }
}
