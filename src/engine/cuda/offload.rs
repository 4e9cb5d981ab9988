//! Networks that train on the device, for the surrogates that own them: the device's side of [`crate::surrogate::Offload`].

use super::answers::DeviceLearns;
use super::labels::HELD_BACK;
use super::layout::Outputs;
use super::network_samples::{Filled, SampleWriter, TracedBatch};
use super::network_training::NetworkCopy;
use super::predictor::{TableCopy, predict_from_host};
use super::{DeviceError, DeviceNetwork, DeviceSamples, DeviceTable, DeviceTraining, Gpu};
use crate::field::Domain;
use crate::surrogate::network::{Architecture, Average, Model, Objective, PlannedStep, Target};
use crate::surrogate::{
    Brought, Copied, DeviceLost, NotTaken, Offload, OffloadedCopy, OffloadedNetwork, OffloadedTraining, RingMark, SampleRing, Table,
};
use std::ops::Range;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

/// Labels that were traced on the device and stay there: so many times the ring's, but at most one part of the memory that is left.
const TIMES_THE_RING: usize = 4;
const MEMORY_SHARE: u64 = 8;
/// A copy of the network for checkpoints takes at most one part of the memory that is left: frames may still want the rest.
const COPY_SHARE: u64 = 2;

/// Trains networks on a GPU.
#[derive(Debug)]
pub struct CudaOffload(Arc<Gpu>);

impl CudaOffload {
    /// On this device.
    pub fn new(gpu: &Arc<Gpu>) -> Self {
        Self(gpu.clone())
    }
}

impl Offload for CudaOffload {
    fn takes(&self, shape: &Architecture, objective: &Objective) -> bool {
        DeviceTraining::takes(&self.0, shape, objective)
    }

    fn training(
        &self,
        model: &Model,
        objective: &Objective,
        average: &Average,
        ring: usize,
        batch: usize,
    ) -> Result<Box<dyn OffloadedTraining>, NotTaken> {
        // Frames need less, and may go on here where training has no memory.
        let taken = self.0.health().ask_for_room(|| CudaTraining::new(&self.0, model, objective, average, ring, batch))?;
        Ok(Box::new(taken))
    }
}

/// What was brought over of a ring.
#[derive(Debug)]
struct Held {
    samples: DeviceSamples,
    capacity: usize,
    /// None before the first.
    mark: Option<RingMark>,
    /// The table that targets are relative to.
    base: Option<u64>,
    usable: usize,
    /// And of the labels that were traced on the device.
    more_usable: usize,
}

/// Labels of the frames that were traced on the device and stay there, since the last slide that made them wrong; frames write, training reads, in turns.
#[derive(Debug)]
pub(super) struct LabelPool {
    writer: SampleWriter,
    samples: Mutex<DeviceSamples>,
}

impl LabelPool {
    /// What it holds, to [go back](Self::go_back) to.
    pub(super) fn mark(&self) -> Filled {
        self.samples().filled()
    }

    /// Forgets the labels that were taken in behind a mark: those of a frame that broke off come from elsewhere, and less of them may be learned from.
    pub(super) fn go_back(&self, to: Filled) {
        self.samples().go_back(to);
    }

    fn samples(&self) -> MutexGuard<'_, DeviceSamples> {
        self.samples.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// What learns from the labels of one frame.
pub(super) struct LabelSink<'a> {
    pool: &'a LabelPool,
    domain: &'a Domain,
    base: Option<&'a DeviceTable>,
    times: [f32; 2],
}

impl DeviceLearns for LabelSink<'_> {
    unsafe fn learn_from(&self, points: u64, traced: &Outputs, count: usize) -> Result<(), DeviceError> {
        let (writer, mut samples) = (&self.pool.writer, self.pool.samples());
        let labels = match writer.target() {
            Target::Ftle => traced.log_stretch,
            Target::FlowMap => traced.arrival,
        };
        if labels == 0 {
            return Ok(());
        }
        let (base, times) = (self.base, Some(self.times));
        let batch = TracedBatch { domain: self.domain, points, labels, count, base, times, held_back: HELD_BACK };
        // SAFETY: the caller's.
        unsafe { writer.append(&mut samples, batch) }
    }
}

/// A network in training.
struct CudaTraining {
    gpu: Arc<Gpu>,
    training: DeviceTraining,
    held: Option<Held>,
    pool: Option<Arc<LabelPool>>,
    /// The stamp of the table, if any, that the pool's targets are relative to; the outer none: whichever is next.
    pool_base: Option<Option<u64>>,
    below: TableCopy,
    /// Device seconds of steps, not yet asked for.
    seconds: f64,
    /// Where the network is copied to: taken at the first copy, and not here while that is read.
    room: Room,
}

type Room = Arc<Mutex<Option<NetworkCopy>>>;

/// A copy of a network, which goes back to its room.
struct CudaCopy {
    gpu: Arc<Gpu>,
    copy: Option<NetworkCopy>,
    room: Room,
}

impl Drop for CudaCopy {
    fn drop(&mut self) {
        *self.room.lock().unwrap_or_else(PoisonError::into_inner) = self.copy.take();
    }
}

impl OffloadedCopy for CudaCopy {
    fn read(self: Box<Self>, model: &mut Model, average: &mut Average) -> Result<(), DeviceLost> {
        let read = || self.copy.as_ref().map_or(Ok(()), |copy| copy.read_behind(&self.gpu, model, average));
        self.gpu.health().ask(read).ok_or(DeviceLost)
    }
}

impl CudaTraining {
    /// With all that training needs for good, and room for what predicts of it, so that what does not fit is refused before it begins.
    fn new(
        gpu: &Arc<Gpu>,
        model: &Model,
        objective: &Objective,
        average: &Average,
        ring: usize,
        batch: usize,
    ) -> Result<Self, DeviceError> {
        let mut training = DeviceTraining::new(gpu, model, objective)?;
        training.set_average(average)?;
        training.reserve(batch)?;
        // To come back to; overwritten with the first step.
        training.keep()?;
        let samples = training.ring(ring)?;
        let held = Some(Held { samples, capacity: ring, mark: None, base: None, usable: 0, more_usable: 0 });
        let (gpu, below) = (gpu.clone(), TableCopy::default());
        let mut taken = Self { gpu, training, held, pool: None, pool_base: None, below, seconds: 0.0, room: Arc::default() };
        taken.pool(ring)?;
        // What a frame is rendered with, and what has learned since.
        let _tried = [taken.training.frozen()?, taken.training.frozen()?];
        Ok(taken)
    }

    /// What the device says; nothing more is asked of it once it has failed.
    fn ask<T>(&mut self, call: impl FnOnce(&mut Self) -> Result<T, DeviceError>) -> Result<T, DeviceLost> {
        let gpu = self.gpu.clone();
        gpu.health().ask(|| call(self)).ok_or(DeviceLost)
    }

    /// The same for what takes memory.
    fn ask_for_room<T>(&mut self, call: impl FnOnce(&mut Self) -> Result<T, DeviceError>) -> Result<T, NotTaken> {
        let gpu = self.gpu.clone();
        gpu.health().ask_for_room(|| call(self))
    }

    /// The samples on the device are those of the ring.
    fn follow(&mut self, ring: &SampleRing, base: Option<&Table>) -> Result<Result<Brought, NotTaken>, DeviceError> {
        let pool = self.pool(ring.capacity())?;
        // In two dimensions tables have one node along z.
        let domain = match base.map(Table::nodes) {
            Some([.., 1]) => Domain::slab([0.0; 2], [1.0; 2], (0.0, 1.0)),
            _ => Domain::cuboid([0.0; 3], [1.0; 3]),
        };
        let below = match base.map(|table| self.below.of(&self.gpu, &domain, table)).transpose() {
            // What the ring has comes over once there is a table to hold it against.
            Err(error) if error.is_refusal() => return Ok(Err(NotTaken::NoRoomForBase(error.to_string()))),
            below => below?,
        };
        let stamp = base.map(Table::stamp);
        let held = self.held.take().filter(|held| held.capacity == ring.capacity());
        // Where samples were moved, those of the window before lie behind what the ring holds now.
        let known = held.as_ref().filter(|held| held.base == stamp).and_then(|held| held.mark).filter(|&mark| ring.continues(mark));
        let ranges = ring.written_since(known);
        let mut samples = match held {
            Some(held) => held.samples,
            None => self.training.ring(ring.capacity())?,
        };
        if known.is_none() {
            // All comes over anew; the memory stays.
            samples.clear();
        }
        if self.pool_base.replace(stamp).is_some_and(|of| of != stamp) {
            pool.samples().clear();
        }
        // What lies before what was written comes first.
        let [newest, wrapped] = ranges;
        for range in [wrapped, newest].into_iter().filter(|range| !range.is_empty()) {
            self.training.write(&mut samples, range, ring.samples(), below)?;
        }
        let usable = self.training.usable(&samples)?;
        let more_usable = self.training.usable(&pool.samples())?;
        self.held = Some(Held { samples, capacity: ring.capacity(), mark: Some(ring.mark()), base: stamp, usable, more_usable });
        Ok(Ok(Brought { usable: usable + more_usable, dropped: ring.len() - usable }))
    }

    /// The labels that stay here.
    fn pool(&mut self, ring: usize) -> Result<Arc<LabelPool>, DeviceError> {
        if let Some(pool) = &self.pool {
            return Ok(pool.clone());
        }
        let writer = self.training.writer();
        let most = self.gpu.memory_left() / MEMORY_SHARE / writer.sample_bytes() as u64;
        // The kernels count samples, those of the ring included, in 32 bits.
        let capacity = TIMES_THE_RING.saturating_mul(ring).min(most as usize).clamp(1, 1 << 31);
        let pool = LabelPool { writer, samples: Mutex::new(self.training.ring(capacity)?) };
        Ok(self.pool.insert(Arc::new(pool)).clone())
    }
}

impl OffloadedTraining for CudaTraining {
    fn bring(&mut self, ring: &SampleRing, base: Option<&Table>) -> Result<Brought, NotTaken> {
        self.ask_for_room(|training| training.follow(ring, base))?
    }

    fn forget_labels(&mut self) {
        if let Some(pool) = &self.pool {
            pool.samples().clear();
        }
        self.pool_base = None;
    }

    fn let_go_of_base(&mut self) {
        self.below.let_go();
    }

    fn steps(&mut self, steps: &[PlannedStep]) -> Result<Vec<f64>, NotTaken> {
        self.ask_for_room(|Self { gpu, training, held, pool, seconds, .. }| {
            let (Some(Held { samples, usable, more_usable, .. }), Some(pool)) = (held, pool) else { return Ok(Vec::new()) };
            let more = pool.samples();
            let begin = gpu.mark()?;
            let mut losses = training.train_steps(samples, Some(&more), steps)?;
            *seconds += 1e-3 * f64::from(gpu.milliseconds(&begin, &gpu.mark()?)?);
            // Those without a target are drawn too, and count for nothing in the mean over the batch.
            let drawn = (samples.len() + more.len()) as f64 / (*usable + *more_usable) as f64;
            losses.iter_mut().for_each(|loss| *loss *= drawn);
            Ok(losses)
        })
    }

    fn keep(&mut self) -> Result<(), NotTaken> {
        self.ask_for_room(|this| this.training.keep())
    }

    fn roll_back(&mut self) -> Result<(), DeviceLost> {
        self.ask(|this| this.training.roll_back())
    }

    fn restart_average(&mut self) -> Result<(), DeviceLost> {
        self.ask(|this| this.training.restart_average())
    }

    fn zero_layers(&mut self, range: Range<usize>) -> Result<(), DeviceLost> {
        self.ask(|this| this.training.zero_layers(range))
    }

    fn frozen(&self) -> Result<Arc<dyn OffloadedNetwork>, NotTaken> {
        let network = self.gpu.health().ask_for_room(|| self.training.frozen())?;
        Ok(Arc::new(CudaNetwork { gpu: self.gpu.clone(), network, pool: self.pool.clone() }))
    }

    fn fetch(&self, model: &mut Model, average: &mut Average) -> Result<(), DeviceLost> {
        let fetch = || {
            let fetched = self.training.average()?;
            self.training.store(model)?;
            *average = fetched;
            Ok(())
        };
        self.gpu.health().ask(fetch).ok_or(DeviceLost)
    }

    fn copy(&mut self) -> Result<Copied, DeviceLost> {
        self.ask(|Self { gpu, training, room, .. }| {
            let taken = room.lock().unwrap_or_else(PoisonError::into_inner).take();
            let (needed, left) = (training.copy_bytes(), gpu.memory_left());
            if taken.is_none() && needed > left / COPY_SHARE {
                let [needed, left] = [needed, left].map(|bytes| bytes.div_ceil(1 << 20));
                let why =
                    format!("a copy of the network takes {needed} MiB of the device, and of {left} MiB that are left frames may want half");
                return Ok(Copied::NoRoom(why));
            }
            match training.copy(taken) {
                Ok(copy) => Ok(Copied::There(Box::new(CudaCopy { gpu: gpu.clone(), copy: Some(copy), room: room.clone() }))),
                // Under the cap, but others hold the rest.
                Err(error) if error.is_out_of_memory() => Ok(Copied::NoRoom(error.to_string())),
                Err(error) => Err(error),
            }
        })
    }

    fn device_seconds(&mut self) -> f64 {
        std::mem::take(&mut self.seconds)
    }
}

/// A network that was trained here, as it was.
pub(super) struct CudaNetwork {
    gpu: Arc<Gpu>,
    network: DeviceNetwork,
    /// Whose training takes labels.
    pool: Option<Arc<LabelPool>>,
}

impl CudaNetwork {
    /// Where labels that stay here go.
    pub(super) fn pool(&self) -> Option<&Arc<LabelPool>> {
        self.pool.as_ref()
    }

    /// Who learns from what a frame traces at these unit times, beyond `base`.
    pub(super) fn label_sink<'a>(&'a self, domain: &'a Domain, base: Option<&'a DeviceTable>, times: [f32; 2]) -> Option<LabelSink<'a>> {
        self.pool.as_ref().map(|pool| LabelSink { pool, domain, base, times })
    }

    pub(super) fn network(&self) -> &DeviceNetwork {
        &self.network
    }
}

impl OffloadedNetwork for CudaNetwork {
    fn predict(&self, points: &[[f32; 3]], times: [f32; 2], out: &mut [f32]) -> Result<(), NotTaken> {
        let network = self.network.above(None).at(times);
        self.gpu.health().ask_or("the CPU asked a network of the GPU's", || predict_from_host(&self.gpu, &network, points, out))
    }

    fn fetch(&self, into: &mut Average) -> Result<(), DeviceLost> {
        self.gpu.health().ask(|| self.network.fetch(into)).ok_or(DeviceLost)
    }

    fn as_any(&self) -> &dyn std::any::Any {
        self
    }
}
