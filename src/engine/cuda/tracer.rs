//! The tracer that the engine uses: seeds on the host in, results on the host out.

use super::layout::Outputs;
use super::trace::{DeviceTracer, Tuning};
use super::{Buffer, DeviceError, DeviceLand, DeviceTable, Gpu, SnapshotStore};
use crate::engine::accelerator::{Backed, DeviceNodes, DeviceTrace};
use crate::field::Domain;
use crate::flow::{Extras, FlowError, FlowMap, MissingCells, Precision, Traced, VelocitySource, cpu_tracer};
use std::sync::{Arc, Mutex, PoisonError};
use thiserror::Error;

/// Seeds that go over at once, at most: bounds the memory of a call.
const BATCH: usize = 1 << 22;
/// Bytes of one, with all that comes back of it.
const SEED: u64 = 76;

/// Why no tracer was made.
#[derive(Debug, Error)]
pub enum CudaTracerError {
    /// The flow map is refused, on any device.
    #[error(transparent)]
    Flow(#[from] FlowError),
    /// The device.
    #[error(transparent)]
    Device(#[from] DeviceError),
}

/// A flow map on the GPU, with the CPU's tracer behind it.
pub type CudaTracer = Backed<CudaTrace>;

/// A flow map on the GPU, for seeds on the host.
pub struct CudaTrace {
    device: DeviceTracer,
    land: Option<DeviceLand>,
    double: bool,
    /// One call at a time.
    room: Mutex<Option<Room>>,
}

/// Memory for one batch.
struct Room {
    capacity: usize,
    extras: Extras,
    seeds: Buffer<[f32; 3]>,
    log_stretch: Buffer<f32>,
    lived: Buffer<f32>,
    double: Option<Buffer<f64>>,
    arrival: Option<Buffer<[f32; 3]>>,
    jacobian: Option<Buffer<[f32; 9]>>,
}

impl CudaTracer {
    /// For seeds at `t0`.
    ///
    /// # Errors
    /// What the CPU's tracer refuses, and what the device cannot do.
    pub fn new(
        store: &SnapshotStore,
        gpu: &Arc<Gpu>,
        source: VelocitySource,
        map: &FlowMap,
        t0: f64,
        tuning: Tuning,
    ) -> Result<Self, CudaTracerError> {
        let host = cpu_tracer(source.clone(), map, t0)?;
        let device = DeviceTracer::new(store, gpu, &source, map, t0, host.steps(), tuning)?;
        let land = match &source {
            VelocitySource::Analytic(..) => None,
            VelocitySource::Window(window) => DeviceLand::new(gpu, &MissingCells::at(window, t0, map.interpolation))?,
        };
        let trace = CudaTrace { device, land, double: map.precision == Precision::F64, room: Mutex::new(None) };
        Ok(Self::with(trace, host, gpu.health().clone()))
    }

    /// The device's side, for callers whose seeds are there.
    pub fn device(&self) -> &DeviceTracer {
        &self.on_device().device
    }

    /// Where no particle can start, on the device; none where every one can.
    pub fn land(&self) -> Option<&DeviceLand> {
        self.on_device().land.as_ref()
    }
}

impl DeviceTrace for CudaTrace {
    fn double(&self) -> bool {
        self.double
    }

    fn trace_nodes(&self, domain: &Domain, nodes: [usize; 3]) -> Result<Option<Box<dyn DeviceNodes>>, DeviceError> {
        Ok(Some(Box::new(DeviceTable::trace(&self.device, domain, nodes)?)))
    }

    fn trace(&self, seeds: &[[f32; 3]], extras: Extras, out: &mut Traced) -> Result<(), DeviceError> {
        let gpu = self.device.gpu();
        let mut room = self.room.lock().unwrap_or_else(PoisonError::into_inner);
        let batch = gpu.batch(BATCH, SEED);
        let most = seeds.len().min(batch);
        let fits = |r: &Room| r.capacity >= most && (r.extras.arrival || !extras.arrival) && (r.extras.jacobian || !extras.jacobian);
        if !room.as_ref().is_some_and(fits) {
            // The old one goes first, so that both never need memory together.
            *room = None;
            let capacity = most.next_power_of_two().max(1 << 12);
            let what = "a batch of seeds";
            *room = Some(Room {
                capacity,
                extras,
                seeds: gpu.alloc(what, capacity)?,
                log_stretch: gpu.alloc(what, capacity)?,
                lived: gpu.alloc(what, capacity)?,
                double: self.double.then(|| gpu.alloc(what, capacity)).transpose()?,
                arrival: extras.arrival.then(|| gpu.alloc(what, capacity)).transpose()?,
                jacobian: extras.jacobian.then(|| gpu.alloc(what, capacity)).transpose()?,
            });
        }
        let Some(room) = room.as_mut() else { return Ok(()) };
        for start in (0..seeds.len()).step_by(room.capacity) {
            let part = start..(start + room.capacity).min(seeds.len());
            room.seeds.write(&seeds[part.clone()])?;
            let arrival = room.arrival.as_ref().filter(|_| extras.arrival);
            let jacobian = room.jacobian.as_ref().filter(|_| extras.jacobian);
            let addresses = Outputs {
                log_stretch: room.log_stretch.address(),
                log_stretch_f64: room.double.as_ref().map_or(0, Buffer::address),
                lived: room.lived.address(),
                arrival: arrival.map_or(0, Buffer::address),
                jacobian: jacobian.map_or(0, Buffer::address),
            };
            // SAFETY: every buffer holds `capacity` entries, at least as many as the part, and reading them below waits for the stream.
            unsafe { self.device.trace(room.seeds.address(), part.len(), &addresses)? };
            room.log_stretch.read(&mut out.log_stretch[part.clone()])?;
            room.lived.read(&mut out.lived[part.clone()])?;
            if let Some(buffer) = &room.double {
                buffer.read(&mut out.log_stretch_f64[part.clone()])?;
            }
            if let Some(buffer) = arrival {
                buffer.read(&mut out.arrival[part.clone()])?;
            }
            if let Some(buffer) = jacobian {
                buffer.read(&mut out.jacobian[part])?;
            }
        }
        Ok(())
    }
}
