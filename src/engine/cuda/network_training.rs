//! Training on the device: `train_steps(k)` takes k optimizer steps (batch, gradient, Adam, running mean) with one wait at their end.
//!
//! Parameters, moments and their mean stay on the device, in single precision and in burn's layout; the gradients are those of
//! half-precision values and single-precision sums. Threads add gradients up in any order, so runs agree up to rounding.

use super::network::{DeviceNetwork, NetworkKernels, copied, has_tables, reading, unit_box};
use super::network_batched::GradientTo;
use super::network_layout::{AdamArgument, DrawArgument};
use super::{Buffer, DeviceError, DeviceTable, Gpu, launch, threads};
use crate::field::Domain;
use crate::surrogate::Samples;
use crate::surrogate::network::{Adam, Architecture, Average, HELD_OUT, Loss, Model, Objective};
use cudarc::driver::PushKernelArg;
use std::sync::Arc;

/// Steps whose losses are waited for together.
const STEPS: usize = 256;

/// One optimizer step.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DeviceStep {
    /// Samples of the batch.
    pub count: usize,
    /// Drawn with repetition by this seed, after so many samples drawn before; none: the first ones, in order.
    pub drawn: Option<(u64, u64)>,
    /// Whether samples whose number is a multiple of [`HELD_OUT`] are left for validation.
    pub hold_out: bool,
    /// Adam's rate.
    pub rate: f64,
    /// Share by which the mean of the parameters moves towards them; 0 leaves it.
    pub average_share: f32,
    /// Whether lines of 16 values of the tables that got no gradient wait, as on the CPU. Otherwise every entry takes part in every step, as
    /// with burn's Adam.
    pub lazy: bool,
}

/// Samples to learn from: unit point and target. A ring: the newest take the place of the oldest.
#[derive(Debug)]
pub struct DeviceSamples {
    samples: Buffer<[f32; 4]>,
    len: usize,
    next: usize,
}

impl DeviceSamples {
    /// Number of samples.
    pub fn len(&self) -> usize {
        self.len
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.len == 0
    }

    /// Unit point and target of each.
    ///
    /// # Errors
    /// What the device says.
    pub fn values(&self) -> Result<Vec<[f32; 4]>, DeviceError> {
        let mut values = vec![[0.0; 4]; self.len];
        self.samples.read(&mut values)?;
        Ok(values)
    }
}

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
    kernels: Arc<NetworkKernels>,
    objective: Objective,
    epsilon: f32,
    /// Steps taken.
    time: usize,
    tables: Moments,
    layers: Moments,
    /// The tables, rounded and padded.
    halves: Buffer<u16>,
    losses: Buffer<f64>,
}

impl DeviceTraining {
    /// Brings a model over; the mean of the parameters starts at them.
    ///
    /// # Errors
    /// What the kernels do not take: several outputs, widths beyond 128, the published penalty on means. Memory that is not there.
    pub fn new(gpu: &Arc<Gpu>, model: &Model, objective: &Objective) -> Result<Self, DeviceError> {
        if objective.loss == Loss::Published && objective.mean_penalty != 0.0 {
            let what = "training with the published penalty on the difference of the batch means (network.mean_penalty)".into();
            return Err(DeviceError::Unsupported { what });
        }
        let kernels = NetworkKernels::new(gpu, &model.shape)?;
        let [tables, layers] = model.state();
        let training = Self {
            gpu: gpu.clone(),
            objective: objective.clone(),
            epsilon: model.epsilon,
            time: model.steps(),
            tables: Moments::upload(gpu, "a network's tables", &tables, kernels.padded)?,
            layers: Moments::upload(gpu, "a network's layers", &layers, layers[0].len())?,
            halves: gpu.alloc("a network's rounded tables", kernels.padded)?,
            losses: gpu.alloc("losses", STEPS)?,
            kernels,
        };
        training.kernels.round(&training.tables.parameters, &training.halves)?;
        Ok(training)
    }

    /// What is stored where.
    pub fn shape(&self) -> &Architecture {
        &self.kernels.shape
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
        assert!(model.shape == self.kernels.shape, "a model of the shape that was brought over");
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

    /// What predicts now, for good: the running mean.
    ///
    /// # Errors
    /// Memory that is not there.
    pub fn frozen(&self, base: Option<(Arc<DeviceTable>, f32)>) -> Result<DeviceNetwork, DeviceError> {
        let layers = copied(&self.gpu, "a network's layers", &self.layers.average)?;
        DeviceNetwork::of(&self.kernels, &self.objective, &self.tables.average, layers, base)
    }

    /// Room for `capacity` samples.
    ///
    /// # Errors
    /// Memory that is not there.
    pub fn ring(&self, capacity: usize) -> Result<DeviceSamples, DeviceError> {
        Ok(DeviceSamples { samples: self.gpu.alloc("samples", capacity)?, len: 0, next: 0 })
    }

    /// Brings samples over. The network learns what they have beyond `base`.
    ///
    /// # Errors
    /// Memory that is not there.
    pub fn upload(&self, samples: &Samples, base: Option<&DeviceTable>) -> Result<DeviceSamples, DeviceError> {
        let points = self.gpu.upload("samples", &samples.points)?;
        let log_stretch = self.gpu.upload("samples", &samples.log_stretch)?;
        let mut ring = self.ring(samples.len())?;
        let unit = Domain::cuboid([0.0; 3], [1.0; 3]);
        // SAFETY: both buffers hold `samples.len()` entries and are freed in the order of the work stream.
        unsafe { self.append(&mut ring, &unit, points.address(), log_stretch.address(), samples.len(), base) }?;
        Ok(ring)
    }

    /// Takes traced points on the device in: `count` points (three f32 each, coordinates of `domain`) and their log-stretch (f32 each).
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
        log_stretch: u64,
        count: usize,
        base: Option<&DeviceTable>,
    ) -> Result<(), DeviceError> {
        let capacity = ring.samples.len();
        assert!(count <= capacity, "a ring of {capacity} for {count} samples");
        let (domain, reading) = (unit_box(domain), reading(&self.objective, base, 1.0));
        let before_the_end = count.min(capacity - ring.next);
        for (from, part) in [(0, before_the_end), (before_the_end, count - before_the_end)] {
            if part == 0 {
                continue;
            }
            let (points, log_stretch) = (points + 12 * from as u64, log_stretch + 4 * from as u64);
            let (n, to) = (part as u32, ring.samples.address_of(ring.next));
            let stream = self.gpu.work();
            let mut call = stream.launch_builder(&self.kernels.samples);
            call.arg(&domain).arg(&reading).arg(&points).arg(&log_stretch).arg(&n).arg(&to);
            // SAFETY: the arguments of `network_samples`; the caller's addresses, and `part` samples fit behind `to`.
            unsafe { launch(&mut call, threads(part, 256)) }?;
            ring.next = (ring.next + part) % capacity;
        }
        ring.len = (ring.len + count).min(capacity);
        Ok(())
    }

    /// Fills `points` with uniform points of the domain, a function of `seed` and their numbers, `first` and on.
    ///
    /// # Errors
    /// What the device says.
    pub fn draw_points(&self, domain: &Domain, seed: u64, first: u64, points: &mut Buffer<[f32; 3]>) -> Result<(), DeviceError> {
        let (domain, n, to) = (unit_box(domain), points.len() as u32, points.address());
        let stream = self.gpu.work();
        let mut call = stream.launch_builder(&self.kernels.points);
        call.arg(&domain).arg(&seed).arg(&first).arg(&n).arg(&to);
        // SAFETY: the arguments of `network_points`.
        unsafe { launch(&mut call, threads(points.len(), 256)) }
    }

    /// Takes the steps in order and waits for the last; the loss of each, before it.
    ///
    /// # Errors
    /// What the device says; parameters are then lost.
    ///
    /// # Panics
    /// When a step takes more samples in order than there are, or there are none.
    pub fn train_steps(&mut self, samples: &DeviceSamples, steps: &[DeviceStep]) -> Result<Vec<f64>, DeviceError> {
        let mut losses = Vec::with_capacity(steps.len());
        for part in steps.chunks(STEPS) {
            self.losses.zero_front(part.len())?;
            for (number, step) in part.iter().enumerate() {
                self.enqueue(samples, step, number)?;
            }
            let mut found = vec![0.0; part.len()];
            self.losses.read(&mut found)?;
            losses.append(&mut found);
        }
        Ok(losses)
    }

    fn enqueue(&mut self, samples: &DeviceSamples, step: &DeviceStep, number: usize) -> Result<(), DeviceError> {
        assert!(!samples.is_empty() && step.count > 0 && (step.drawn.is_some() || step.count <= samples.len()), "samples for a batch");
        let Self { gpu, kernels, tables, layers, .. } = self;
        let stream = gpu.work();
        let (seed, counter) = step.drawn.unwrap_or_default();
        let draw = DrawArgument {
            samples: samples.samples.address(),
            seed,
            counter,
            count: samples.len as u32,
            batch: step.count as u32,
            random: u32::from(step.drawn.is_some()),
            hold_out: if step.hold_out { HELD_OUT as u32 } else { 0 },
        };
        let (halves, loss) = (self.halves.address(), self.losses.address_of(number));
        let [table_parameters, table_first, table_second, table_gradient] =
            [&tables.parameters, &tables.first, &tables.second, &tables.gradient].map(Buffer::address);
        let [layer_parameters, layer_first, layer_second, layer_gradient] =
            [&layers.parameters, &layers.first, &layers.second, &layers.gradient].map(Buffer::address);
        let to = GradientTo { tables: table_gradient, layers: layer_gradient, loss };
        // SAFETY: buffers are of this architecture, indices of samples below their number.
        unsafe { kernels.gradient(halves, layer_parameters, &draw, to) }?;

        self.time += 1;
        let adam = Adam::at(self.time, step.rate, self.epsilon);
        let adam = AdamArgument {
            rate: adam.rate,
            epsilon: adam.epsilon,
            correction: adam.correction,
            gradient: (1.0 / step.count as f64) as f32,
        };
        if has_tables(&kernels.shape) {
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
