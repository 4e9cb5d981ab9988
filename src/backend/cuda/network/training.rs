//! Training on the device: `train_steps(k)` takes k optimizer steps (batch, gradient, Adam, running mean) with one wait at their end.
//!
//! Parameters, moments and their mean stay on the device, in single precision and in burn's layout; the gradients are those of
//! half-precision values and single-precision sums. Threads add gradients up in any order, so runs agree up to rounding.

use crate::backend::cuda::network::batched::GradientTo;
use crate::backend::cuda::network::layout::{AdamArgument, DrawArgument, ReadingArgument};
use crate::backend::cuda::network::network::{
    DeviceNetwork, NetworkKernels, copied, copy, further_places, has_penalty, reading, sample_fours, unit_box,
};
use crate::backend::cuda::network::samples::{DeviceSamples, Filled, SampleWriter, TracedPoints};
use crate::backend::cuda::{Buffer, DeviceError, DeviceTable, Gpu, launch, threads};
use crate::field::Domain;
use crate::surrogate::Samples;
use crate::surrogate::network::{Adam, Architecture, Average, HELD_OUT, Model, Objective, PlannedStep};
use cudarc::driver::PushKernelArg;
use std::ops::Range;
use std::sync::Arc;

/// Steps whose losses are waited for together.
const STEPS: usize = 256;
/// Samples that come over at once: bounds the memory beside the ring.
const WRITTEN: usize = 1 << 20;

/// Parameters and Adam's moments, as burn lays them out.
#[derive(Debug)]
struct Moments {
    parameters: Buffer<f32>,
    first: Buffer<f32>,
    second: Buffer<f32>,
    average: Buffer<f32>,
    gradient: Buffer<f32>,
    len: usize,
}

/// What steps change of [`Moments`].
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

    /// Copies everything that steps change to what was kept before, or to new memory.
    fn keep(&self, gpu: &Gpu, kept: Option<Kept>) -> Result<Kept, DeviceError> {
        let kept = match kept {
            Some(kept) => kept,
            None => {
                let room = || gpu.alloc("a copy of a network", self.len);
                [room()?, room()?, room()?, room()?]
            }
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
    /// Steps taken.
    time: usize,
    tables: Moments,
    layers: Moments,
    /// The tables, rounded and padded.
    halves: Buffer<u16>,
    losses: Buffer<f64>,
    /// None until a penalty on means needs it.
    batch: Option<WholeBatch>,
    kept: Option<NetworkCopy>,
}

/// Everything that steps change of tables and layers, as it was after so many steps.
#[derive(Debug)]
pub(super) struct NetworkCopy {
    steps: usize,
    parts: [Kept; 2],
    lens: [usize; 2],
}

impl NetworkCopy {
    /// Brings it back behind the work stream, into a model of its shape and the running mean.
    pub(super) fn read_behind(&self, gpu: &Gpu, model: &mut Model, average: &mut Average) -> Result<(), DeviceError> {
        let read = |part: usize, of: usize| gpu.read_behind(&self.parts[part][of], self.lens[part]);
        let moments = |part: usize| Ok([read(part, 0)?, read(part, 1)?, read(part, 2)?]);
        model.set_state([moments(0)?, moments(1)?], self.steps);
        *average = Average { tables: read(0, 3)?, layers: read(1, 3)? };
        Ok(())
    }
}

/// What the penalty on means needs of a whole batch before any gradient.
#[derive(Debug)]
struct WholeBatch {
    points: Buffer<[f32; 3]>,
    /// Times that points have no place for; most networks have none.
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

    /// Predicts at the samples of `draw`, and leaves how far their mean is off; `layers` and `halves` as for [`NetworkKernels::predict`].
    fn measure(&mut self, writer: &SampleWriter, halves: u64, layers: u64, draw: &DrawArgument) -> Result<(), DeviceError> {
        let SampleWriter { kernels, objective } = writer;
        let stream = kernels.gpu.work();
        let (points, predicted, means) = (self.points.address(), self.predicted.address(), self.means.address());
        let further = self.further.address();
        self.means.zero_front(2)?;
        let count = draw.batch as usize;
        // SAFETY: the arguments of `network_drawn`; there is room for the batch.
        unsafe { launch(stream.launch_builder(&kernels.drawn).arg(draw).arg(&points).arg(&further), threads(count, 256)) }?;
        // Points bring their times along, and a duration of 1 leaves the FTLE.
        let times = [f32::NAN; 5];
        let reading = ReadingArgument { further, tau: 1.0, ..reading(&kernels.shape, objective, times, None, 1.0) };
        // SAFETY: parameters are of this architecture, and there is room for the batch.
        unsafe { kernels.predict(halves, layers, &reading, points, count, predicted) }?;
        // SAFETY: the arguments of `network_means`.
        unsafe { launch(stream.launch_builder(&kernels.means).arg(draw).arg(&predicted).arg(&means), threads(count, 256)) }
    }
}

impl DeviceTraining {
    /// Whether the kernels train networks of this architecture on this device.
    pub fn takes(gpu: &Gpu, shape: &Architecture, objective: &Objective) -> bool {
        DeviceNetwork::takes(gpu, shape) && !objective.derivatives()
    }

    /// Brings a model over; the mean of the parameters starts at them.
    ///
    /// # Errors
    /// What the kernels do not take: derivatives of the flow map. Memory that is not there.
    pub fn new(gpu: &Arc<Gpu>, model: &Model, objective: &Objective) -> Result<Self, DeviceError> {
        if objective.derivatives() {
            let what = "training on the derivatives of the flow map (network.jacobian_weight)".into();
            return Err(DeviceError::Unsupported { what });
        }
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

    /// Takes all the memory that steps of at most `batch` samples need beside the samples, so that none of them lacks it.
    ///
    /// # Errors
    /// Memory that is not there.
    pub fn reserve(&mut self, batch: usize) -> Result<(), DeviceError> {
        let SampleWriter { kernels, objective } = &self.writer;
        if has_penalty(objective) {
            self.batch = Some(WholeBatch::new(&self.gpu, &kernels.shape, batch)?);
        }
        kernels.reserve()
    }

    /// Device memory of a network in training with `capacity` samples, bytes: parameters, moments, mean and gradient, the state to roll back to,
    /// rounded tables, and two frozen copies.
    pub(in crate::backend::cuda) fn bytes(shape: &Architecture, capacity: usize) -> u64 {
        const STATE: u64 = 9 * size_of::<f32>() as u64;
        const ROUNDED: u64 = 3 * size_of::<u16>() as u64;
        let samples = size_of::<[f32; 4]>() * sample_fours(shape) * capacity;
        (STATE + ROUNDED) * shape.parameters() as u64 + samples as u64
    }

    /// What is stored where.
    pub fn shape(&self) -> &Architecture {
        &self.writer.kernels.shape
    }

    /// Optimizer steps taken so far.
    pub fn steps(&self) -> usize {
        self.time
    }

    /// Brings parameters and moments back into burn's module.
    ///
    /// # Errors
    /// What the device says.
    ///
    /// # Panics
    /// When `model` has another shape.
    pub fn store(&self, model: &mut Model) -> Result<(), DeviceError> {
        assert!(model.shape == self.writer.kernels.shape, "a model of the shape that was brought over");
        model.set_state([self.tables.read()?, self.layers.read()?], self.time);
        Ok(())
    }

    /// The running mean of the parameters.
    ///
    /// # Errors
    /// What the device says.
    pub fn average(&self) -> Result<Average, DeviceError> {
        Ok(Average { tables: read(&self.tables.average, self.tables.len)?, layers: read(&self.layers.average, self.layers.len)? })
    }

    /// Brings a running mean over.
    ///
    /// # Errors
    /// What the device says.
    ///
    /// # Panics
    /// When it is that of another shape.
    pub fn set_average(&mut self, average: &Average) -> Result<(), DeviceError> {
        assert!((average.tables.len(), average.layers.len()) == (self.tables.len, self.layers.len), "a mean of this shape");
        self.tables.average.write(&average.tables)?;
        self.layers.average.write(&average.layers)
    }

    /// Sets the running mean to the present parameters.
    ///
    /// # Errors
    /// What the device says.
    pub fn restart_average(&mut self) -> Result<(), DeviceError> {
        [&self.tables, &self.layers].into_iter().try_for_each(|moments| copy(&self.gpu, &moments.parameters, &moments.average))
    }

    /// Sets a range of the layers' parameters to 0, and their moments and mean.
    ///
    /// # Errors
    /// What the device says.
    ///
    /// # Panics
    /// When the range goes beyond the layers.
    pub fn zero_layers(&mut self, range: Range<usize>) -> Result<(), DeviceError> {
        self.layers.all().into_iter().try_for_each(|values| values.zero_at(range.start, range.len()))
    }

    /// Remembers everything that steps change as what to come back to.
    ///
    /// # Errors
    /// Memory that is not there.
    pub fn keep(&mut self) -> Result<(), DeviceError> {
        let room = self.kept.take();
        self.kept = Some(self.copy(room)?);
        Ok(())
    }

    /// Copies everything that steps change to `room`, or to new memory, in the order of the work stream.
    pub(super) fn copy(&self, room: Option<NetworkCopy>) -> Result<NetworkCopy, DeviceError> {
        let [tables, layers] = room.map_or([None, None], |room| room.parts.map(Some));
        let parts = [self.tables.keep(&self.gpu, tables)?, self.layers.keep(&self.gpu, layers)?];
        Ok(NetworkCopy { steps: self.time, parts, lens: [self.tables.len, self.layers.len] })
    }

    /// Memory of such a copy, in bytes.
    pub(super) fn copy_bytes(&self) -> u64 {
        4 * size_of::<f32>() as u64 * (self.tables.len + self.layers.len) as u64
    }

    /// Comes back to what was kept last; nothing changes where nothing was.
    ///
    /// # Errors
    /// What the device says.
    pub fn roll_back(&mut self) -> Result<(), DeviceError> {
        let Some(NetworkCopy { steps, parts: [tables, layers], .. }) = &self.kept else { return Ok(()) };
        self.tables.roll_back(&self.gpu, tables)?;
        self.layers.roll_back(&self.gpu, layers)?;
        self.time = *steps;
        self.writer.kernels.round(&self.tables.parameters, &self.halves)
    }

    /// What predicts now, for good: the running mean.
    ///
    /// # Errors
    /// Memory that is not there.
    pub fn frozen(&self) -> Result<DeviceNetwork, DeviceError> {
        let layers = copied(&self.gpu, "a network's layers", &self.layers.average)?;
        DeviceNetwork::of(&self.writer.kernels, &self.writer.objective, &self.tables.average, layers)
    }

    /// Room for `capacity` samples.
    ///
    /// # Errors
    /// Memory that is not there.
    pub fn ring(&self, capacity: usize) -> Result<DeviceSamples, DeviceError> {
        let fours = sample_fours(self.shape());
        Ok(DeviceSamples { samples: self.gpu.alloc("samples", fours * capacity)?, fours, filled: Filled::default() })
    }

    /// Brings samples over. The network learns what they have beyond `base`.
    ///
    /// # Errors
    /// Memory that is not there.
    pub fn upload(&self, samples: &Samples, base: Option<&DeviceTable>) -> Result<DeviceSamples, DeviceError> {
        let mut ring = self.ring(samples.len())?;
        self.write(&mut ring, 0..samples.len(), samples, base)?;
        Ok(ring)
    }

    /// Brings a range of samples over, each to the place that it has among `samples`. Those before must be there already.
    ///
    /// # Errors
    /// Memory that is not there.
    ///
    /// # Panics
    /// When the range goes beyond the ring or the samples.
    pub fn write(
        &self,
        ring: &mut DeviceSamples,
        range: Range<usize>,
        samples: &Samples,
        base: Option<&DeviceTable>,
    ) -> Result<(), DeviceError> {
        let unit = Domain::cuboid([0.0; 3], [1.0; 3]);
        for from in range.clone().step_by(WRITTEN) {
            let part = from..(from + WRITTEN).min(range.end);
            let (points, further) = self.writer.placed(samples, part.clone());
            let (points, further) = (self.gpu.upload("samples", &points)?, self.gpu.upload("samples", &further)?);
            let labels = self.gpu.upload("samples", &self.writer.labels(samples, part.clone()))?;
            let traced = TracedPoints { points: points.address(), labels: labels.address(), further: further.address() };
            // SAFETY: these buffers hold as many entries and are freed in the order of the work stream.
            unsafe { self.writer.place(ring, part, &unit, traced, base, None, 0) }?;
        }
        ring.filled.len = ring.filled.len.max(range.end);
        Ok(())
    }

    /// Number of samples that can be learned from: those that are finite.
    ///
    /// # Errors
    /// What the device says.
    pub fn usable(&self, ring: &DeviceSamples) -> Result<usize, DeviceError> {
        if ring.is_empty() {
            return Ok(0);
        }
        let count = self.gpu.upload("a counter", &[0_u32])?;
        let (samples, n, to) = (ring.samples.address(), ring.len() as u32, count.address());
        let stream = self.gpu.work();
        let mut call = stream.launch_builder(&self.writer.kernels.usable);
        call.arg(&samples).arg(&n).arg(&to);
        // SAFETY: the arguments of `network_usable`; the ring holds as many samples.
        unsafe { launch(&mut call, threads(ring.len(), 256)) }?;
        let mut found = [0];
        count.read(&mut found)?;
        Ok(found[0] as usize)
    }

    /// Takes traced points on the device in: `count` points (three f32 each, coordinates of `domain`, times at the places of axes that are no
    /// inputs) and their labels: log-stretch (f32 each), or for the flow map arrivals (three f32 each, coordinates of `domain`).
    /// What is not finite is never learned from.
    ///
    /// # Errors
    /// What the device says.
    ///
    /// # Panics
    /// When the ring has no room for as many.
    ///
    /// # Safety
    /// The memory at both addresses is on this device, holds `count` entries, and lives until the work stream has passed this.
    pub unsafe fn append(
        &self,
        ring: &mut DeviceSamples,
        domain: &Domain,
        points: u64,
        labels: u64,
        count: usize,
        base: Option<&DeviceTable>,
    ) -> Result<(), DeviceError> {
        let capacity = ring.capacity();
        assert!(count <= capacity, "a ring of {capacity} for {count} samples");
        // SAFETY: the caller's.
        unsafe { self.writer.append(ring, domain, points, labels, count, base, None, 0) }
    }

    /// Fills `points` with uniform points of the domain, a function of `seed` and their numbers, `first` and on.
    ///
    /// # Errors
    /// What the device says.
    pub fn draw_points(&self, domain: &Domain, seed: u64, first: u64, points: &mut Buffer<[f32; 3]>) -> Result<(), DeviceError> {
        let (domain, n, to) = (unit_box(domain), points.len() as u32, points.address());
        let stream = self.gpu.work();
        let mut call = stream.launch_builder(&self.writer.kernels.points);
        call.arg(&domain).arg(&seed).arg(&first).arg(&n).arg(&to);
        // SAFETY: the arguments of `network_points`.
        unsafe { launch(&mut call, threads(points.len(), 256)) }
    }

    /// What turns traced points into samples of this network, without the network.
    pub(super) fn writer(&self) -> SampleWriter {
        self.writer.clone()
    }

    /// Takes the steps in order and waits for the last; the loss of each, before it. Steps that draw do so from `samples` and `more` alike.
    ///
    /// # Errors
    /// What the device says; parameters are then lost.
    ///
    /// # Panics
    /// When a step takes more samples in order than there are, or there are none.
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
        let [table_parameters, table_first, table_second, table_gradient] =
            [&tables.parameters, &tables.first, &tables.second, &tables.gradient].map(Buffer::address);
        let [layer_parameters, layer_first, layer_second, layer_gradient] =
            [&layers.parameters, &layers.first, &layers.second, &layers.gradient].map(Buffer::address);
        if has_penalty(objective) {
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
        unsafe { kernels.gradient(halves, layer_parameters, &draw, to) }?;

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
