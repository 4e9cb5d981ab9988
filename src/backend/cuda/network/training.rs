//! Training on the device: [`DeviceTraining::train_steps`] takes optimizer steps with one wait at the end. A step draws a batch, and computes the
//! gradient, the Adam update (Kingma and Ba 2015) and the running mean of the parameters (Polyak and Juditsky 1992).
//!
//! Parameters, Adam's moments and the parameters' mean stay on the device, in single precision and in burn's layout. Gradients use
//! half-precision values and single-precision sums. Threads add gradients in any order, so runs agree up to rounding.

use crate::cuda::layout::UnitBoxArgument;
use crate::cuda::network::batched::GradientTo;
use crate::cuda::network::layout::{AdamArgument, DrawArgument, ReadingArgument};
use crate::cuda::network::network::{
    DeviceNetwork, LossTerms, NetworkKernels, TangentTerm, copied, copy, further_places, reading, sample_float4s,
};
use crate::cuda::network::samples::{DeviceLabels, DeviceSamples, Filled, SampleWriter, TracedBatch};
use crate::cuda::{Buffer, DeviceError, DeviceTable, Gpu, launch, threads};
use cudarc::driver::PushKernelArg;
use ridgewatch_field::Domain;
use ridgewatch_surrogate::Samples;
use ridgewatch_surrogate::network::{Adam, Architecture, Average, HELD_OUT, Model, Objective, PlannedStep};
use std::ops::Range;
use std::sync::Arc;

/// Steps per wait for their losses.
const STEPS: usize = 256;
/// Samples per upload. It bounds the memory besides the replay buffer.
const UPLOAD: usize = 1 << 20;

/// Parameters and Adam's moments, in burn's layout.
#[derive(Debug)]
struct Moments {
    parameters: Buffer<f32>,
    first: Buffer<f32>,
    second: Buffer<f32>,
    average: Buffer<f32>,
    gradient: Buffer<f32>,
    len: usize,
}

/// Copies of the buffers of [`Moments`] that steps change.
type Kept = [Buffer<f32>; 4];

impl Moments {
    fn upload(gpu: &Gpu, what: &str, [parameters, first, second]: &[Vec<f32>; 3], gradient: usize) -> Result<Self, DeviceError> {
        let mut zeros = gpu.alloc(what, gradient)?;
        zeros.fill_bytes(0)?;
        Ok(Self {
            parameters: gpu.upload(what, parameters)?,
            first: gpu.upload(what, first)?,
            second: gpu.upload(what, second)?,
            average: gpu.upload(what, parameters)?,
            gradient: zeros,
            len: parameters.len(),
        })
    }

    fn all(&self) -> [&Buffer<f32>; 4] {
        [&self.parameters, &self.first, &self.second, &self.average]
    }

    /// Copies all buffers that steps change to an earlier copy's memory, or to new memory.
    fn keep(&self, gpu: &Gpu, kept: Option<Kept>) -> Result<Kept, DeviceError> {
        let room = || gpu.alloc("a copy of a network", self.len);
        let kept = match kept {
            Some(kept) => kept,
            None => [room()?, room()?, room()?, room()?],
        };
        self.all().into_iter().zip(&kept).try_for_each(|(from, to)| copy(gpu, from, to))?;
        Ok(kept)
    }

    fn roll_back(&self, gpu: &Gpu, kept: &Kept) -> Result<(), DeviceError> {
        kept.iter().zip(self.all()).try_for_each(|(from, to)| copy(gpu, from, to))
    }

    fn read(&self) -> Result<[Vec<f32>; 3], DeviceError> {
        Ok([read(&self.parameters, self.len)?, read(&self.first, self.len)?, read(&self.second, self.len)?])
    }
}

fn read(buffer: &Buffer<f32>, len: usize) -> Result<Vec<f32>, DeviceError> {
    let mut values = vec![0.0; len];
    buffer.read(&mut values)?;
    Ok(values)
}

/// A network in training.
#[derive(Debug)]
pub struct DeviceTraining {
    gpu: Arc<Gpu>,
    writer: SampleWriter,
    epsilon: f32,
    /// Number of steps taken.
    time: usize,
    tables: Moments,
    layers: Moments,
    /// The tables, rounded and padded.
    halves: Buffer<u16>,
    losses: Buffer<f64>,
    /// `None` until a penalty on means needs it.
    batch: Option<WholeBatch>,
    kept: Option<NetworkCopy>,
}

/// Copy of everything that steps change in tables and layers, after `steps` steps.
#[derive(Debug)]
pub(super) struct NetworkCopy {
    steps: usize,
    parts: [Kept; 2],
    lens: [usize; 2],
}

impl NetworkCopy {
    /// Downloads the copy, asynchronously to the work stream, into a model of its shape and the running mean.
    pub(super) fn read_behind(&self, gpu: &Gpu, model: &mut Model, average: &mut Average) -> Result<(), DeviceError> {
        let read = |part: usize, of: usize| gpu.readback().read(&self.parts[part][of], self.lens[part]);
        let moments = |part: usize| Ok([read(part, 0)?, read(part, 1)?, read(part, 2)?]);
        model.set_state([moments(0)?, moments(1)?], self.steps);
        *average = Average { tables: read(0, 3)?, layers: read(1, 3)? };
        Ok(())
    }
}

/// Outputs of a whole batch, which the penalty on means needs before any gradient.
#[derive(Debug)]
struct WholeBatch {
    points: Buffer<[f32; 3]>,
    /// Times without a place in a point; most networks have none.
    further: Buffer<f32>,
    predicted: Buffer<f32>,
    /// `Means`.
    means: Buffer<f64>,
}

impl WholeBatch {
    fn new(gpu: &Gpu, shape: &Architecture, count: usize) -> Result<Self, DeviceError> {
        let what = "a batch's outputs";
        Ok(Self {
            points: gpu.alloc(what, count)?,
            further: gpu.alloc(what, count * further_places(shape))?,
            predicted: gpu.alloc(what, count)?,
            means: gpu.alloc(what, 2)?,
        })
    }

    /// Predicts at the samples of `draw` and stores the error of their mean. `layers` and `halves` as for [`NetworkKernels::predict`].
    fn measure(&mut self, writer: &SampleWriter, halves: u64, layers: u64, draw: &DrawArgument) -> Result<(), DeviceError> {
        let SampleWriter { kernels, objective } = writer;
        let stream = kernels.gpu.work();
        let (points, further) = (self.points.address(), self.further.address());
        let (predicted, means) = (self.predicted.address(), self.means.address());
        self.means.zero_front(2)?;
        let count = draw.batch as usize;
        // SAFETY: the arguments of `network_drawn`; there is room for the batch.
        unsafe { launch(stream.launch_builder(&kernels.drawn).arg(draw).arg(&points).arg(&further), threads(count, 256)) }?;
        // Points carry their times, and with a duration of 1 the log-stretch is the FTLE.
        let times = [f32::NAN; 5];
        let reading = ReadingArgument { further, tau: 1.0, ..reading(&kernels.shape, objective, times, None, 1.0) };
        // SAFETY: parameters are of this architecture, and there is room for the batch.
        unsafe { kernels.predict(halves, layers, &reading, points, count, predicted) }?;
        // SAFETY: the arguments of `network_means`.
        unsafe { launch(stream.launch_builder(&kernels.means).arg(draw).arg(&predicted).arg(&means), threads(count, 256)) }
    }
}

impl DeviceTraining {
    /// Uploads a model. The running mean of the parameters starts at their values.
    ///
    /// # Errors
    /// The architecture is not supported ([`DeviceNetwork::takes`]), a kernel does not compile, or out of memory.
    pub fn new(gpu: &Arc<Gpu>, model: &Model, objective: &Objective) -> Result<Self, DeviceError> {
        let kernels = NetworkKernels::new(gpu, &model.shape, objective)?;
        let [tables, layers] = model.state();
        let training = Self {
            gpu: gpu.clone(),
            epsilon: model.epsilon,
            time: model.steps(),
            tables: Moments::upload(gpu, "a network's tables", &tables, kernels.padded)?,
            layers: Moments::upload(gpu, "a network's layers", &layers, layers[0].len())?,
            halves: gpu.alloc("a network's rounded tables", kernels.padded)?,
            losses: gpu.alloc("losses", STEPS)?,
            batch: None,
            kept: None,
            writer: SampleWriter { kernels, objective: objective.clone() },
        };
        training.writer.kernels.round(&training.tables.parameters, &training.halves)?;
        Ok(training)
    }

    /// Allocates all memory that steps of at most `batch` samples need besides the samples, so that no step runs out of memory.
    ///
    /// # Errors
    /// Out of memory.
    pub fn reserve(&mut self, batch: usize) -> Result<(), DeviceError> {
        let SampleWriter { kernels, objective } = &self.writer;
        if LossTerms::of(objective).mean_penalty {
            self.batch = Some(WholeBatch::new(&self.gpu, &kernels.shape, batch)?);
        }
        kernels.reserve()
    }

    /// Device memory of a network in training with `capacity` samples, bytes: parameters, moments, mean and gradient, the state to roll back to,
    /// rounded tables, and two frozen copies.
    pub(in crate::cuda) fn bytes(shape: &Architecture, objective: &Objective, capacity: usize) -> u64 {
        const STATE: u64 = 9 * size_of::<f32>() as u64;
        const ROUNDED: u64 = 3 * size_of::<u16>() as u64;
        let samples = size_of::<[f32; 4]>() * sample_float4s(shape, objective) * capacity;
        (STATE + ROUNDED) * shape.parameters() as u64 + samples as u64
    }

    /// Architecture of the network.
    pub fn shape(&self) -> &Architecture {
        &self.writer.kernels.shape
    }

    /// Number of optimizer steps taken.
    pub fn steps(&self) -> usize {
        self.time
    }

    /// Downloads parameters and moments into burn's module.
    ///
    /// # Errors
    /// Error of the driver.
    ///
    /// # Panics
    /// If `model` has another shape.
    pub fn store(&self, model: &mut Model) -> Result<(), DeviceError> {
        assert!(model.shape == self.writer.kernels.shape, "a model of the uploaded shape");
        model.set_state([self.tables.read()?, self.layers.read()?], self.time);
        Ok(())
    }

    /// Downloads the running mean of the parameters.
    ///
    /// # Errors
    /// Error of the driver.
    pub fn average(&self) -> Result<Average, DeviceError> {
        Ok(Average { tables: read(&self.tables.average, self.tables.len)?, layers: read(&self.layers.average, self.layers.len)? })
    }

    /// Uploads a running mean.
    ///
    /// # Errors
    /// Error of the driver.
    ///
    /// # Panics
    /// If it has another shape.
    pub fn set_average(&mut self, average: &Average) -> Result<(), DeviceError> {
        assert!((average.tables.len(), average.layers.len()) == (self.tables.len, self.layers.len), "a mean of this shape");
        self.tables.average.write(&average.tables)?;
        self.layers.average.write(&average.layers)
    }

    /// Sets the running mean to the current parameters.
    ///
    /// # Errors
    /// Error of the driver.
    pub fn restart_average(&mut self) -> Result<(), DeviceError> {
        [&self.tables, &self.layers].into_iter().try_for_each(|moments| copy(&self.gpu, &moments.parameters, &moments.average))
    }

    /// Sets a range of the layers' parameters, their moments and their mean to 0.
    ///
    /// # Errors
    /// Error of the driver.
    ///
    /// # Panics
    /// If the range exceeds the layers.
    pub fn zero_layers(&mut self, range: Range<usize>) -> Result<(), DeviceError> {
        self.layers.all().into_iter().try_for_each(|values| values.zero_at(range.start, range.len()))
    }

    /// Copies everything that steps change, for [`Self::roll_back`].
    ///
    /// # Errors
    /// Out of memory.
    pub fn keep(&mut self) -> Result<(), DeviceError> {
        let room = self.kept.take();
        self.kept = Some(self.copy(room)?);
        Ok(())
    }

    /// Copies everything that steps change to `room` or to new memory, in the order of the work stream.
    pub(super) fn copy(&self, room: Option<NetworkCopy>) -> Result<NetworkCopy, DeviceError> {
        let [tables, layers] = room.map_or([None, None], |room| room.parts.map(Some));
        let parts = [self.tables.keep(&self.gpu, tables)?, self.layers.keep(&self.gpu, layers)?];
        Ok(NetworkCopy { steps: self.time, parts, lens: [self.tables.len, self.layers.len] })
    }

    /// Size of such a copy, in bytes.
    pub(super) fn copy_bytes(&self) -> u64 {
        4 * size_of::<f32>() as u64 * (self.tables.len + self.layers.len) as u64
    }

    /// Restores the state of the last [`Self::keep`]. Does nothing if there is none.
    ///
    /// # Errors
    /// Error of the driver.
    pub fn roll_back(&mut self) -> Result<(), DeviceError> {
        let Some(NetworkCopy { steps, parts: [tables, layers], .. }) = &self.kept else { return Ok(()) };
        self.tables.roll_back(&self.gpu, tables)?;
        self.layers.roll_back(&self.gpu, layers)?;
        self.time = *steps;
        self.writer.kernels.round(&self.tables.parameters, &self.halves)
    }

    /// Network that predicts with the current running mean, unaffected by later steps.
    ///
    /// # Errors
    /// Out of memory.
    pub fn frozen(&self) -> Result<DeviceNetwork, DeviceError> {
        let layers = copied(&self.gpu, "a network's layers", &self.layers.average)?;
        DeviceNetwork::of(&self.writer.kernels, &self.writer.objective, &self.tables.average, layers)
    }

    /// Empty replay buffer of `capacity` samples.
    ///
    /// # Errors
    /// Out of memory.
    pub fn replay_buffer(&self, capacity: usize) -> Result<DeviceSamples, DeviceError> {
        let float4s = sample_float4s(self.shape(), &self.writer.objective);
        Ok(DeviceSamples { samples: self.gpu.alloc("samples", float4s * capacity)?, float4s, filled: Filled::default() })
    }

    /// Uploads samples to a new buffer. The network learns their difference to `base`.
    ///
    /// # Errors
    /// Out of memory.
    pub fn upload(&self, samples: &Samples, base: Option<&DeviceTable>) -> Result<DeviceSamples, DeviceError> {
        let mut buffer = self.replay_buffer(samples.len())?;
        self.write(&mut buffer, 0..samples.len(), samples, base)?;
        Ok(buffer)
    }

    /// Uploads a range of samples, each to its index in `samples`. Samples before the range must be present already.
    ///
    /// # Errors
    /// Out of memory.
    ///
    /// # Panics
    /// If the range exceeds the buffer or the samples.
    pub fn write(
        &self,
        buffer: &mut DeviceSamples,
        range: Range<usize>,
        samples: &Samples,
        base: Option<&DeviceTable>,
    ) -> Result<(), DeviceError> {
        let unit = Domain::cuboid([0.0; 3], [1.0; 3]);
        for from in range.clone().step_by(UPLOAD) {
            let part = from..(from + UPLOAD).min(range.end);
            let (points, further) = self.writer.placed(samples, part.clone());
            let (points, further) = (self.gpu.upload("samples", &points)?, self.gpu.upload("samples", &further)?);
            let labels = self.gpu.upload("samples", &self.writer.labels(samples, part.clone()))?;
            let jacobians = self.writer.jacobians(samples, part.clone()).map(|all| self.gpu.upload("samples", all)).transpose()?;
            let labels = DeviceLabels { values: labels.address(), jacobians: jacobians.as_ref().map_or(0, Buffer::address) };
            let (points, count) = (points.address(), part.len());
            let batch = TracedBatch { domain: &unit, points, labels, count, base, times: None, held_back: 0 };
            // SAFETY: these buffers hold `count` entries and are freed in the order of the work stream.
            unsafe { self.writer.write(buffer, part.start, batch, further.address()) }?;
        }
        buffer.filled.len = buffer.filled.len.max(range.end);
        Ok(())
    }

    /// Numbers of samples with finite targets, which training uses.
    ///
    /// # Errors
    /// Error of the driver.
    pub fn usable(&self, buffers: [&DeviceSamples; 2]) -> Result<[usize; 2], DeviceError> {
        let count = self.gpu.upload("counters", &[0_u32; 2])?;
        for (number, buffer) in buffers.into_iter().enumerate().filter(|(_, buffer)| !buffer.is_empty()) {
            let to = count.address() + (number * size_of::<u32>()) as u64;
            let (samples, n) = (buffer.samples.address(), buffer.len() as u32);
            let mut call = self.gpu.work().launch_builder(&self.writer.kernels.usable);
            call.arg(&samples).arg(&n).arg(&to);
            // SAFETY: the arguments of `network_usable`; the buffer holds `n` samples.
            unsafe { launch(&mut call, threads(buffer.len(), 256)) }?;
        }
        let mut found = [0; 2];
        count.read(&mut found)?;
        Ok(found.map(|found| found as usize))
    }

    /// Appends traced points on the device: `count` points (three f32 each, coordinates of `domain`, with times at the places of unused axes)
    /// and their labels. Training skips samples that are not finite; with derivatives in the loss, those without Jacobians are not.
    ///
    /// # Errors
    /// Error of the driver.
    ///
    /// # Panics
    /// If `count` exceeds the buffer's capacity.
    ///
    /// # Safety
    /// The memory at all addresses is on this device, holds `count` entries, and lives until the work stream has passed this call.
    pub unsafe fn append(
        &self,
        buffer: &mut DeviceSamples,
        domain: &Domain,
        points: u64,
        labels: impl Into<DeviceLabels>,
        count: usize,
        base: Option<&DeviceTable>,
    ) -> Result<(), DeviceError> {
        let (capacity, labels) = (buffer.capacity(), labels.into());
        assert!(count <= capacity, "a buffer of {capacity} for {count} samples");
        // SAFETY: as required of the caller.
        unsafe { self.writer.append(buffer, TracedBatch { domain, points, labels, count, base, times: None, held_back: 0 }) }
    }

    /// As [`Self::append`] without a table, for a label (log-stretch or arrival) at these unit times; a point carries times that are NaN.
    ///
    /// # Errors
    /// Error of the driver.
    ///
    /// # Panics
    /// If `count` exceeds the buffer's capacity.
    ///
    /// # Safety
    /// As for [`Self::append`].
    pub unsafe fn append_at(
        &self,
        buffer: &mut DeviceSamples,
        domain: &Domain,
        [points, labels]: [u64; 2],
        count: usize,
        times: [f32; 2],
    ) -> Result<(), DeviceError> {
        let (capacity, labels) = (buffer.capacity(), labels.into());
        assert!(count <= capacity, "a buffer of {capacity} for {count} samples");
        // SAFETY: as required of the caller.
        unsafe { self.writer.append(buffer, TracedBatch { domain, points, labels, count, base: None, times: Some(times), held_back: 0 }) }
    }

    /// Fills `points` with uniform points of the domain, a function of `seed` and of their numbers from `first` on.
    ///
    /// # Errors
    /// Error of the driver.
    pub fn draw_points(&self, domain: &Domain, seed: u64, first: u64, points: &mut Buffer<[f32; 3]>) -> Result<(), DeviceError> {
        let (domain, n, to) = (UnitBoxArgument::new(domain), points.len() as u32, points.address());
        let mut call = self.gpu.work().launch_builder(&self.writer.kernels.points);
        call.arg(&domain).arg(&seed).arg(&first).arg(&n).arg(&to);
        // SAFETY: the arguments of `network_points`.
        unsafe { launch(&mut call, threads(points.len(), 256)) }
    }

    /// Writer of samples for this network, which does not keep the network's parameters.
    pub(super) fn writer(&self) -> SampleWriter {
        self.writer.clone()
    }

    /// Takes the steps in order and waits for the last one. Returns the loss before each step. Random steps draw from `samples` and `more`
    /// together.
    ///
    /// # Errors
    /// Error of the driver; the parameters are then lost.
    ///
    /// # Panics
    /// If there are no samples, or a step takes more samples in order than there are.
    pub fn train_steps(
        &mut self,
        samples: &DeviceSamples,
        more: Option<&DeviceSamples>,
        steps: &[PlannedStep],
    ) -> Result<Vec<f64>, DeviceError> {
        let mut losses = Vec::with_capacity(steps.len());
        for part in steps.chunks(STEPS) {
            self.losses.zero_front(part.len())?;
            for (number, step) in part.iter().enumerate() {
                self.enqueue(samples, more.filter(|more| !more.is_empty()), step, number)?;
            }
            let mut found = vec![0.0; part.len()];
            self.losses.read(&mut found)?;
            losses.append(&mut found);
        }
        Ok(losses)
    }

    fn enqueue(
        &mut self,
        samples: &DeviceSamples,
        more: Option<&DeviceSamples>,
        step: &PlannedStep,
        number: usize,
    ) -> Result<(), DeviceError> {
        assert!(!samples.is_empty() && step.count > 0 && (step.drawn.is_some() || step.count <= samples.len()), "samples for a batch");
        let Self { gpu, writer, tables, layers, batch, .. } = self;
        let SampleWriter { kernels, objective } = &*writer;
        let stream = gpu.work();
        let (seed, counter) = step.drawn.unwrap_or_default();
        let mut draw = DrawArgument {
            samples: samples.samples.address(),
            more: more.map_or(0, |more| more.samples.address()),
            seed,
            counter,
            count: (samples.len() + more.map_or(0, DeviceSamples::len)) as u32,
            first: samples.len() as u32,
            batch: step.count as u32,
            random: u32::from(step.drawn.is_some()),
            hold_out: if step.hold_out { HELD_OUT as u32 } else { 0 },
            penalty: objective.mean_penalty,
            means: 0,
        };
        let (halves, loss) = (self.halves.address(), self.losses.address_of(number));
        let addresses = |of: &Moments| [&of.parameters, &of.first, &of.second, &of.gradient].map(Buffer::address);
        let [table_parameters, table_first, table_second, table_gradient] = addresses(tables);
        let [layer_parameters, layer_first, layer_second, layer_gradient] = addresses(layers);
        if LossTerms::of(objective).mean_penalty {
            let batch = match batch.take().filter(|batch| batch.points.len() >= step.count) {
                Some(batch) => batch,
                None => WholeBatch::new(gpu, &kernels.shape, step.count)?,
            };
            let batch = self.batch.insert(batch);
            batch.measure(writer, halves, layer_parameters, &draw)?;
            draw.means = batch.means.address();
        }
        let to = GradientTo { tables: table_gradient, layers: layer_gradient, loss };
        // SAFETY: buffers are of this architecture, indices of samples below their number.
        unsafe { kernels.gradient(halves, layer_parameters, &draw, TangentTerm::of(&kernels.shape, objective), to) }?;

        self.time += 1;
        let adam = Adam::at(self.time, step.rate, self.epsilon);
        let adam = AdamArgument {
            rate: adam.rate,
            epsilon: adam.epsilon,
            correction: adam.correction,
            gradient: (1.0 / (step.count * kernels.shape.outputs()) as f64) as f32,
        };
        if kernels.padded > 0 {
            let (n, lazy) = (kernels.padded as u64, u32::from(step.lazy));
            let mut call = stream.launch_builder(&kernels.adam_tables);
            call.arg(&kernels.grid).arg(&adam).arg(&n).arg(&lazy).arg(&table_gradient);
            call.arg(&table_parameters).arg(&table_first).arg(&table_second).arg(&halves);
            // SAFETY: the arguments of `network_adam_tables`; gradient and halves are padded, the others as burn's.
            unsafe { launch(&mut call, threads(kernels.padded, 256)) }?;
        }
        let n = layers.len as u32;
        let mut call = stream.launch_builder(&kernels.adam_layers);
        call.arg(&adam).arg(&n).arg(&layer_gradient).arg(&layer_parameters).arg(&layer_first).arg(&layer_second);
        // SAFETY: the arguments of `network_adam_layers`.
        unsafe { launch(&mut call, threads(layers.len, 256)) }?;
        if step.average_share > 0.0 {
            for moments in [&*tables, &*layers] {
                let (n, from, to) = (moments.len as u64, moments.parameters.address(), moments.average.address());
                let mut call = stream.launch_builder(&kernels.average);
                call.arg(&step.average_share).arg(&n).arg(&from).arg(&to);
                // SAFETY: the arguments of `network_average`; both buffers hold `n` values.
                unsafe { launch(&mut call, threads(moments.len, 256)) }?;
            }
        }
        Ok(())
    }
}
