//! Networks that train on the device, for the surrogates that own them: the device's side of [`crate::surrogate::Offload`].

use super::predictor::{TableCopy, predict_from_host};
use super::{DeviceError, DeviceNetwork, DeviceSamples, DeviceTraining, Gpu};
use crate::field::Domain;
use crate::surrogate::network::{Architecture, Average, Model, Objective, PlannedStep};
use crate::surrogate::{DeviceLost, Offload, OffloadedNetwork, OffloadedTraining, RingMark, SampleRing, Table};
use std::sync::Arc;

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

    fn training(&self, model: &Model, objective: &Objective, average: &Average) -> Option<Box<dyn OffloadedTraining>> {
        let gpu = &self.0;
        let training = gpu.health().ask(|| {
            let mut training = DeviceTraining::new(gpu, model, objective)?;
            training.set_average(average)?;
            Ok(training)
        })?;
        Some(Box::new(CudaTraining { gpu: gpu.clone(), training, held: None, below: TableCopy::default(), seconds: 0.0 }))
    }
}

/// What was brought over of a ring.
#[derive(Debug)]
struct Held {
    samples: DeviceSamples,
    capacity: usize,
    mark: RingMark,
    /// The table that targets are relative to.
    base: Option<u64>,
    usable: usize,
}

/// A network in training.
struct CudaTraining {
    gpu: Arc<Gpu>,
    training: DeviceTraining,
    held: Option<Held>,
    below: TableCopy,
    /// Device seconds of steps, not yet asked for.
    seconds: f64,
}

impl CudaTraining {
    /// What the device says; nothing more is asked of it once it has failed.
    fn ask<T>(&mut self, call: impl FnOnce(&mut Self) -> Result<T, DeviceError>) -> Result<T, DeviceLost> {
        let gpu = self.gpu.clone();
        gpu.health().ask(|| call(self)).ok_or(DeviceLost)
    }

    /// The samples on the device are those of the ring.
    fn follow(&mut self, ring: &SampleRing, base: Option<&Table>) -> Result<usize, DeviceError> {
        let stamp = base.map(Table::stamp);
        let held = self.held.take().filter(|held| held.capacity == ring.capacity());
        let known = held.as_ref().filter(|held| held.base == stamp).map(|held| held.mark);
        let ranges = ring.written_since(known);
        let nothing_new = ranges.iter().all(|range| range.is_empty());
        let mut samples = match held {
            Some(held) if known.is_some() && nothing_new => return Ok(self.held.insert(held).usable),
            Some(held) if known.is_some() => held.samples,
            // All comes over anew; the memory stays.
            Some(held) => held.samples.emptied(),
            None => self.training.ring(ring.capacity())?,
        };
        // In two dimensions tables have one node along z.
        let domain = match base.map(Table::nodes) {
            Some([.., 1]) => Domain::slab([0.0; 2], [1.0; 2], (0.0, 1.0)),
            _ => Domain::cuboid([0.0; 3], [1.0; 3]),
        };
        let below = base.map(|table| self.below.of(&self.gpu, &domain, table)).transpose()?;
        // What lies before what was written comes first.
        let [newest, wrapped] = ranges;
        for range in [wrapped, newest].into_iter().filter(|range| !range.is_empty()) {
            self.training.write(&mut samples, range, ring.samples(), below)?;
        }
        let usable = self.training.usable(&samples)?;
        self.held = Some(Held { samples, capacity: ring.capacity(), mark: ring.mark(), base: stamp, usable });
        Ok(usable)
    }
}

impl OffloadedTraining for CudaTraining {
    fn bring(&mut self, ring: &SampleRing, base: Option<&Table>) -> Result<usize, DeviceLost> {
        self.ask(|training| training.follow(ring, base))
    }

    fn steps(&mut self, steps: &[PlannedStep]) -> Result<Vec<f64>, DeviceLost> {
        self.ask(|Self { gpu, training, held, seconds, .. }| {
            let Some(Held { samples, usable, .. }) = held else { return Ok(Vec::new()) };
            let begin = gpu.mark()?;
            let mut losses = training.train_steps(samples, steps)?;
            *seconds += 1e-3 * f64::from(gpu.milliseconds(&begin, &gpu.mark()?)?);
            // Those without a target are drawn too, and count for nothing in the mean over the batch.
            let drawn = samples.len() as f64 / *usable as f64;
            losses.iter_mut().for_each(|loss| *loss *= drawn);
            Ok(losses)
        })
    }

    fn keep(&mut self) -> Result<(), DeviceLost> {
        self.ask(|this| this.training.keep())
    }

    fn roll_back(&mut self) -> Result<(), DeviceLost> {
        self.ask(|this| this.training.roll_back())
    }

    fn restart_average(&mut self) -> Result<(), DeviceLost> {
        self.ask(|this| this.training.restart_average())
    }

    fn frozen(&self) -> Result<Arc<dyn OffloadedNetwork>, DeviceLost> {
        let network = self.gpu.health().ask(|| self.training.frozen()).ok_or(DeviceLost)?;
        Ok(Arc::new(CudaNetwork { gpu: self.gpu.clone(), network }))
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

    fn device_seconds(&mut self) -> f64 {
        std::mem::take(&mut self.seconds)
    }
}

/// A network that was trained here, as it was.
pub(super) struct CudaNetwork {
    gpu: Arc<Gpu>,
    network: DeviceNetwork,
}

impl CudaNetwork {
    pub(super) fn network(&self) -> &DeviceNetwork {
        &self.network
    }
}

impl OffloadedNetwork for CudaNetwork {
    fn predict(&self, points: &[[f32; 3]], out: &mut [f32]) -> Result<(), DeviceLost> {
        self.gpu.health().ask(|| predict_from_host(&self.gpu, &self.network, points, out)).ok_or(DeviceLost)
    }

    fn as_any(&self) -> &dyn std::any::Any {
        self
    }
}
