//! Routes a frame's log-stretch queries on the device, by the rule of [`crate::backend::QueryRouter`], and keeps labels of the traced ones.

use crate::backend::cuda::driver::pinned::Pinned;
use crate::backend::cuda::layout::{ChoiceArgument, ListsArgument, Outputs};
use crate::backend::cuda::rendering::labels::{HELD_BACK, Labels};
use crate::backend::cuda::{Buffer, DeviceError, DeviceMissingCells, DeviceTracer, Gpu, launch, threads};
use crate::field::Domain;
use crate::surrogate::Samples;
use crate::trust::Gate;
use cudarc::driver::{CudaEvent, CudaFunction, PushKernelArg, result};
use std::sync::Arc;

/// Answers log-stretch queries that lie on the device.
pub trait DeviceAnswers {
    /// Enqueues on the work stream: the log-stretch of `count` points (device address `points`, three f32 each, domain coordinates) goes
    /// to `log_stretch` (f32 each; NaN where there is no value), and who answered to `by` (a byte each: 0 the surrogate, 1 RK4, 2 the
    /// surrogate where it is not trusted, since the tracing budget was spent).
    ///
    /// # Errors
    /// What the device says.
    fn answer(&mut self, points: u64, count: usize, log_stretch: u64, by: u64) -> Result<(), DeviceError>;

    /// Called once all waves of a frame are done, before anything is made of it.
    ///
    /// # Errors
    /// What the device says; the frame then counts for nothing.
    fn end(&mut self) -> Result<(), DeviceError> {
        Ok(())
    }
}

/// A surrogate whose memory is on the device.
pub trait DevicePredict {
    /// Enqueues on the work stream: the predicted log-stretch at `count` points (device address `points`, 3 f32 each, unit coordinates;
    /// those outside the domain are moved to its edge) goes to `out` (f32 each).
    ///
    /// # Safety
    /// The memory at both addresses is on this device, holds `count` entries, and lives until the work stream has passed this.
    unsafe fn predict(&self, points: u64, count: usize, out: u64) -> Result<(), DeviceError>;
}

/// A network on the device that learns from what is traced there.
pub trait DeviceLearns {
    /// Enqueues on the work stream: takes in `count` points (device address `points`, three f32 each, domain coordinates) and what was traced of
    /// them, but for those that the host may keep.
    ///
    /// # Safety
    /// The memory at all addresses is on this device, holds `count` entries, and lives until the work stream has passed this.
    unsafe fn learn_from(&self, points: u64, traced: &Outputs, count: usize) -> Result<(), DeviceError>;
}

/// Every query traced.
pub struct TraceAll<'a>(pub &'a DeviceTracer);

impl DeviceAnswers for TraceAll<'_> {
    fn answer(&mut self, points: u64, count: usize, log_stretch: u64, by: u64) -> Result<(), DeviceError> {
        let gpu = self.0.gpu();
        let doing = DeviceError::driver("filling device memory");
        gpu.context().bind_to_thread().map_err(&doing)?;
        // SAFETY: the renderer's queue holds `count` entries at each address until the next wave, which is behind this on the stream.
        unsafe {
            result::memset_d8_async(by, 1, count, gpu.work().cu_stream()).map_err(&doing)?;
            self.0.trace(points, count, &Outputs { log_stretch, ..Outputs::default() })
        }
    }
}

/// What answers the queries of one frame.
pub struct FrameQueries<'a> {
    /// RK4.
    pub tracer: &'a DeviceTracer,
    /// Seeds' domain.
    pub domain: &'a Domain,
    /// Where there is no value; none: nowhere.
    pub missing_cells: Option<&'a DeviceMissingCells>,
    /// Who answers where the gate trusts it; none: RK4 answers everywhere.
    pub surrogate: Option<&'a dyn DevicePredict>,
    /// Who learns from what is traced, on the device; none: nobody does.
    pub label_sink: Option<&'a dyn DeviceLearns>,
    /// Where the surrogate is trusted.
    pub gate: &'a Gate,
    /// Device seconds of tracing from which the surrogate answers everywhere.
    pub trace_budget: Option<f64>,
    /// Traced answers that come back as labels: fewer than so many (4,194,304 at most).
    pub keep: usize,
    /// Whether arrivals are labels too.
    pub arrivals: bool,
}

/// Points that are answered together, at most.
const CHUNK: usize = 1 << 23;
/// Bytes of a point in the lists.
const POINT: u64 = 20;

/// Divides waves between surrogate and RK4. Keeps its memory from frame to frame.
pub struct QueryRouter {
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
    /// Where the tracer's points arrive; none until that is asked for.
    arrivals: Option<Buffer<[f32; 3]>>,
    /// Lengths of the surrogate's list, of the tracer's list, and of the labels.
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
            lengths: gpu.alloc(what, 3)?,
            pinned: Pinned::new(gpu, 3)?,
        })
    }

    /// The lengths, once the work so far is done.
    fn lengths(&mut self, gpu: &Gpu) -> Result<[usize; 3], DeviceError> {
        let from = self.lengths.address();
        // SAFETY: three lengths lie there.
        unsafe { self.pinned.copy_from(gpu, from, 3) }?;
        gpu.synchronize()?;
        let lengths = self.pinned.values();
        Ok([lengths[0] as usize, lengths[1] as usize, lengths[2] as usize])
    }
}

impl QueryRouter {
    /// Compiles the kernels, or takes them from the cache.
    ///
    /// # Errors
    /// What the compiler or the device says.
    pub fn new(gpu: &Arc<Gpu>) -> Result<Self, DeviceError> {
        let kernel = |name| gpu.kernel("answer.cu", &[], name);
        Ok(Self { split: kernel("answer_split")?, join: kernel("answer_join")?, gpu: gpu.clone(), memory: None })
    }

    /// Overwrites the memory between frames with bytes that make NaN and far indices. For tests.
    ///
    /// # Errors
    /// What the device says.
    pub fn poison(&mut self) -> Result<(), DeviceError> {
        let Some(memory) = &mut self.memory else { return Ok(()) };
        memory.points.fill_bytes(0xFF)?;
        memory.places.fill_bytes(0xFF)?;
        memory.values.fill_bytes(0xFF)
    }

    /// The answers of one frame.
    ///
    /// # Errors
    /// Memory that is not there, or a device fault.
    pub fn begin<'a>(&'a mut self, queries: FrameQueries<'a>) -> Result<RoutedQueries<'a>, DeviceError> {
        let gpu = self.gpu.clone();
        let memory = match self.memory.take() {
            Some(memory) => memory,
            None => Memory::new(&gpu)?,
        };
        let memory = self.memory.insert(memory);
        memory.lengths.fill_bytes(0)?;
        if queries.arrivals && memory.arrivals.is_none() {
            memory.arrivals = Some(gpu.alloc("the lists of a gated frame", memory.capacity)?);
        }
        let trusted: Vec<u8> = queries.gate.cells().iter().map(|&trusted| u8::from(trusted)).collect();
        let trusted = queries.surrogate.map(|_| gpu.upload("a gate", &trusted)).transpose()?;
        let choice = ChoiceArgument {
            min: queries.domain.min,
            extent: queries.domain.extent(),
            gate_shape: queries.gate.shape().map(|n| n as i32),
            gate_pad: 0,
            trusted: trusted.as_ref().map_or(0, Buffer::address),
            missing_cells: queries.missing_cells.map_or_else(bytemuck::Zeroable::zeroed, DeviceMissingCells::argument),
            budget_spent: 0,
            pad: 0,
        };
        Ok(RoutedQueries {
            labels: Labels::new(&gpu, queries.keep, if queries.label_sink.is_some() { HELD_BACK } else { 0 }, queries.arrivals)?,
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

/// The answers of one frame, and what was found out on the way.
pub struct RoutedQueries<'a> {
    gpu: Arc<Gpu>,
    split: &'a CudaFunction,
    join: &'a CudaFunction,
    memory: &'a mut Memory,
    queries: FrameQueries<'a>,
    choice: ChoiceArgument,
    _trusted: Option<Buffer<u8>>,
    labels: Labels,
    /// Begin and end of dividing, then of predicting, of tracing and of putting together, not yet added up.
    marks: Option<[CudaEvent; 6]>,
    trace_seconds: f64,
    predict_seconds: f64,
}

impl RoutedQueries<'_> {
    /// Device seconds of sorting and tracing so far.
    pub fn trace_seconds(&self) -> f64 {
        self.trace_seconds
    }

    /// Device seconds of everything else: dividing the waves, predicting, putting the answers together.
    pub fn predict_seconds(&self) -> f64 {
        self.predict_seconds
    }

    /// The labels that were kept, in unit coordinates: of queries, and of points traced ahead of flights that ended before them.
    pub fn labels(&mut self) -> Samples {
        self.labels.finish(self.queries.domain)
    }

    /// Adds the latest chunk's times up, whose work is waited for.
    fn add_up(&mut self) -> Result<(), DeviceError> {
        let Some([begun, divided, asked, predicted, traced, joined]) = self.marks.take() else { return Ok(()) };
        let seconds = |from: &CudaEvent, to: &CudaEvent| self.gpu.milliseconds(from, to).map(|ms| f64::from(ms) * 1e-3);
        let predicting = seconds(&begun, &divided)? + seconds(&asked, &predicted)? + seconds(&traced, &joined)?;
        let tracing = seconds(&predicted, &traced)?;
        self.predict_seconds += predicting;
        self.trace_seconds += tracing;
        Ok(())
    }

    /// Answers at most as many points as the lists hold.
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
            arrivals: self.memory.arrivals.as_ref().filter(|_| self.queries.arrivals).map_or(0, Buffer::address),
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
            // SAFETY: the lists hold as many entries at their front; what uses their memory next is behind this on the stream.
            unsafe { surrogate.predict(lists.points, predicted, lists.values) }?;
        }
        let answered = gpu.mark()?;
        let back = (capacity - traced) as u64;
        let arrival = if lists.arrivals == 0 { 0 } else { lists.arrivals + 12 * back };
        let out = Outputs { log_stretch: lists.values + 4 * back, arrival, ..Outputs::default() };
        // SAFETY: as above, at their back.
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
        // SAFETY: the arguments of `answer_join`; the lists are as long as it is told, the places within `count`.
        unsafe { launch(&mut call, threads((predicted + traced) as usize, 256)) }?;
        self.marks = Some([begun, divided, asked, answered, tracing, gpu.mark()?]);
        Ok(())
    }
}

impl DeviceAnswers for RoutedQueries<'_> {
    fn answer(&mut self, points: u64, count: usize, log_stretch: u64, by: u64) -> Result<(), DeviceError> {
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
