//! Flow map of a slide on the GPU, for seeds on the host (in batches) and for seeds on the device.

use crate::BackendError;
use crate::cuda::layout::Outputs;
use crate::cuda::tracing::trace::{DeviceTracer, Tuning};
use crate::cuda::{Buffer, DeviceError, DeviceMissingCells, Gpu, SnapshotStore};
use bytemuck::{cast_slice, cast_slice_mut};
use ridgewatch_field::DomainPoint;
use ridgewatch_flow::{Extras, FlowMap, MissingCells, Precision, Traced, Tracer, VelocitySource, cpu_tracer};
use ridgewatch_surrogate::Trace;
use std::sync::{Arc, Mutex, PoisonError};

/// Limit on the seeds of a batch, to bound the memory of a call.
const BATCH: usize = 1 << 22;
/// Bytes per seed, with all its results.
const SEED: u64 = 76;

/// A flow map on the GPU.
pub struct CudaTracer {
    device: DeviceTracer,
    /// The same flow map on the CPU. It validates the settings and selects the number of steps.
    host: Box<dyn Tracer>,
    missing_cells: Option<DeviceMissingCells>,
    double: bool,
    /// Memory of a batch. The lock admits one call at a time.
    room: Mutex<Option<Room>>,
}

/// Device memory for one batch.
struct Room {
    capacity: usize,
    extras: Extras,
    seeds: Buffer<[f32; 3]>,
    log_stretch: Buffer<f32>,
    lifetime_share: Buffer<f32>,
    double: Option<Buffer<f64>>,
    arrival: Option<Buffer<[f32; 3]>>,
    jacobian: Option<Buffer<[f32; 9]>>,
}

impl CudaTracer {
    /// Creates a tracer of `map` for seeds at the start time `t0`. Uploads the snapshots that are not on the device yet.
    ///
    /// # Errors
    /// The flow map is invalid, or the device fails or lacks memory.
    pub fn new(
        store: &SnapshotStore,
        gpu: &Arc<Gpu>,
        source: VelocitySource,
        map: &FlowMap,
        t0: f64,
        tuning: Tuning,
    ) -> Result<Self, BackendError> {
        let host = cpu_tracer(source.clone(), map, t0)?;
        let device = DeviceTracer::new(store, gpu, &source, map, t0, host.steps(), tuning)?;
        let missing_cells = match &source {
            VelocitySource::Analytic(..) => None,
            VelocitySource::Window(window) => DeviceMissingCells::new(gpu, &MissingCells::at(window, t0, map.interpolation))?,
        };
        Ok(Self { device, host, missing_cells, double: map.precision == Precision::F64, room: Mutex::new(None) })
    }

    /// The tracer for seeds on the device.
    pub fn device(&self) -> &DeviceTracer {
        &self.device
    }

    /// The same flow map on the CPU.
    pub fn host(&self) -> &dyn Tracer {
        &*self.host
    }

    /// Returns the flow map on the CPU and frees that on the GPU.
    pub fn into_host(self) -> Box<dyn Tracer> {
        self.host
    }

    /// The cells in which no particle can start, on the device. `None` if every cell has data.
    pub fn missing_cells(&self) -> Option<&DeviceMissingCells> {
        self.missing_cells.as_ref()
    }
}

impl Trace for CudaTracer {
    fn seconds(&self, seeds: &[DomainPoint], _: &mut Traced) -> Result<f64, DeviceError> {
        let gpu = self.device.gpu();
        let seeds = gpu.upload::<[f32; 3]>("seeds", cast_slice(seeds))?;
        let [log_stretch, lifetime_share] = [gpu.alloc::<f32>("results", seeds.len())?, gpu.alloc::<f32>("results", seeds.len())?];
        let double = self.double.then(|| gpu.alloc::<f64>("results", seeds.len())).transpose()?;
        let out = Outputs {
            log_stretch: log_stretch.address(),
            lifetime_share: lifetime_share.address(),
            log_stretch_f64: double.as_ref().map_or(0, Buffer::address),
            ..Outputs::default()
        };
        let begin = gpu.mark()?;
        // SAFETY: every buffer holds as many entries as there are seeds, and lives until the marks are compared, which waits for the stream.
        unsafe { self.device.trace(seeds.address(), seeds.len(), &out)? };
        Ok(1e-3 * f64::from(gpu.milliseconds(&begin, &gpu.mark()?)?))
    }

    fn flow(&self) -> &dyn Tracer {
        &*self.host
    }

    fn trace(&self, seeds: &[DomainPoint], extras: Extras, out: &mut Traced) -> Result<(), DeviceError> {
        out.set_len(seeds.len(), extras, self.double);
        let gpu = self.device.gpu();
        let mut room = self.room.lock().unwrap_or_else(PoisonError::into_inner);
        let batch = gpu.batch(BATCH, SEED);
        let most = seeds.len().min(batch);
        let fits = |r: &Room| r.capacity >= most && (r.extras.arrival || !extras.arrival) && (r.extras.jacobian || !extras.jacobian);
        if !room.as_ref().is_some_and(fits) {
            // Freed first, so that old and new memory are never allocated together.
            *room = None;
            let capacity = most.next_power_of_two().max(1 << 12);
            let what = "a batch of seeds";
            *room = Some(Room {
                capacity,
                extras,
                seeds: gpu.alloc(what, capacity)?,
                log_stretch: gpu.alloc(what, capacity)?,
                lifetime_share: gpu.alloc(what, capacity)?,
                double: self.double.then(|| gpu.alloc(what, capacity)).transpose()?,
                arrival: extras.arrival.then(|| gpu.alloc(what, capacity)).transpose()?,
                jacobian: extras.jacobian.then(|| gpu.alloc(what, capacity)).transpose()?,
            });
        }
        let Some(room) = room.as_mut() else { return Ok(()) };
        for start in (0..seeds.len()).step_by(room.capacity) {
            let part = start..(start + room.capacity).min(seeds.len());
            room.seeds.write(cast_slice(&seeds[part.clone()]))?;
            let arrival = room.arrival.as_ref().filter(|_| extras.arrival);
            let jacobian = room.jacobian.as_ref().filter(|_| extras.jacobian);
            let addresses = Outputs {
                log_stretch: room.log_stretch.address(),
                log_stretch_f64: room.double.as_ref().map_or(0, Buffer::address),
                lifetime_share: room.lifetime_share.address(),
                arrival: arrival.map_or(0, Buffer::address),
                jacobian: jacobian.map_or(0, Buffer::address),
            };
            // SAFETY: every buffer holds `capacity` entries, which is at least `part.len()`, and the reads below wait for the stream.
            unsafe { self.device.trace(room.seeds.address(), part.len(), &addresses)? };
            room.log_stretch.read(&mut out.log_stretch[part.clone()])?;
            room.lifetime_share.read(&mut out.lifetime_share[part.clone()])?;
            if let Some(buffer) = &room.double {
                buffer.read(&mut out.log_stretch_f64[part.clone()])?;
            }
            if let Some(buffer) = arrival {
                buffer.read(cast_slice_mut(&mut out.arrival[part.clone()]))?;
            }
            if let Some(buffer) = jacobian {
                buffer.read(&mut out.jacobian[part])?;
            }
        }
        Ok(())
    }
}
