//! The CUDA implementation of [`Backend`]: plans the placement of a slide, and calls the GPU or the CPU accordingly.

use super::driver::Gpu;
use super::network::{CudaTraining, DeviceNetwork, DeviceTraining, OnGpu, seconds_of_prediction, trace_labels};
use super::rendering::{CudaSamples, GpuFrames};
use super::tracing::{CudaTracer, Tuning};
use super::window::SnapshotStore;
use crate::cpu::{HostFrame, HostPicture, render_on_cpu};
use crate::{
    AuditFindings, AuditRequest, Backend, BackendError, CudaDevice, DeviceError, FrameJob, Interruptible, Needs, Place, Placement,
    Rendered, StartsAnew, Storage, Surrogate, SurrogateRequest, WhenLost, audit,
};
use ridgewatch_field::UnitPoint;
use ridgewatch_flow::{FlowMap, VelocitySource};
use ridgewatch_render::Renderer;
use ridgewatch_source::Listener;
use ridgewatch_surrogate::network::{Architecture, Objective};
use ridgewatch_surrogate::{
    CheckpointError, CheckpointState, FrozenHybrid, Host, HostNetwork, HostSurrogate, Hybrid, Kind, Learned, NetworkFrom, Predict,
    ReplayBuffer, build, fresh_stamp,
};
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

/// Largest number of nodes of a refined table, 1 GiB, and the share of the free memory that it takes at most.
const MOST_REFINED_NODES: usize = 1 << 28;
const REFINED_SHARE: u64 = 4;
/// [`crate::Backend::nodes_per_sample`]. A sample is traced in the time of 9 nodes (easy turbulence on an H100); 64 of them for each make a frame, which
/// is more than tracing, four times as long.
const NODES_PER_SAMPLE: [usize; 2] = [64, 8];

/// A picture of the CUDA backend.
pub struct CudaPicture {
    /// Accumulates where the placement puts frames on the CPU.
    host: HostPicture,
    /// Number of the window, and of its picture that the GPU accumulates.
    numbers: [u64; 2],
}

impl StartsAnew for CudaPicture {
    fn start_anew(&mut self) {
        self.host.start_anew();
        self.numbers[1] = fresh_stamp();
    }
}

impl Default for CudaPicture {
    fn default() -> Self {
        Self { host: HostPicture::default(), numbers: [fresh_stamp(), fresh_stamp()] }
    }
}

/// A GPU as a backend, with the snapshots in its memory.
pub struct Cuda {
    device: CudaDevice,
    /// Form in which windows are held.
    storage: Storage,
    gpu: Arc<Gpu>,
    snapshots: Arc<SnapshotStore>,
    placement: Placement,
    /// Renderer, router and audits. `None` before the first frame on the GPU.
    frames: Option<GpuFrames>,
    warnings: Vec<String>,
}

impl Cuda {
    /// Creates the backend of an opened device.
    pub fn new(device: &CudaDevice) -> Self {
        let (gpu, device) = (device.gpu.clone(), device.clone());
        let snapshots = Arc::new(SnapshotStore::new(&gpu));
        let storage = device.storage.unwrap_or_default();
        Self { device, storage, gpu, snapshots, placement: Placement::DEVICE, frames: None, warnings: Vec::new() }
    }

    /// Returns the snapshots on the device.
    pub fn snapshots(&self) -> &SnapshotStore {
        &self.snapshots
    }

    fn frames(&mut self) -> Result<&mut GpuFrames, DeviceError> {
        if self.frames.is_none() {
            self.frames = Some(GpuFrames::new(&self.gpu)?);
        }
        self.frames.as_mut().ok_or_else(|| DeviceError::Unsupported { what: "rendering without kernels".into() })
    }

    /// Lowers the placement to the work that the kernels support and the memory can hold.
    fn plan(&mut self, request: &SurrogateRequest<'_>) -> Result<(), BackendError> {
        let (settings, network, domain) = (request.settings, request.network, request.domain);
        let mut needs = Needs::default();
        if settings.kind != Kind::Network {
            needs.table = settings.nodes(domain)?.iter().map(|&n| n as u64).product::<u64>() * size_of::<f32>() as u64;
        }
        if settings.kind != Kind::Table {
            let axes: Vec<usize> = (0..domain.dimensions.clamp(1, 3)).collect();
            let shape = Architecture::new(network, &axes, domain.lengths())?;
            let objective = Objective::new(network, &shape, domain.extent(), 1.0);
            if !DeviceNetwork::takes(&self.gpu, &shape) {
                self.placement = Placement::TRACING_ONLY;
                let what = "the network is trained on the CPU: the GPU does not support layers that its shared memory does not hold";
                self.warnings.push(what.into());
            }
            let parameters = shape.parameters() as u64 * size_of::<f32>() as u64;
            needs.network = parameters;
            if self.placement.training == Place::Device {
                needs.training = DeviceTraining::bytes(&shape, &objective, request.replay_buffer);
            }
        }
        let why;
        (self.placement, why) = self.placement.within(needs, self.gpu.memory_left());
        self.warnings.extend(why);
        Ok(())
    }
}

impl Backend for Cuda {
    type Tracer = CudaTracer;
    type Surrogate = CudaSurrogate;
    type Samples = CudaSamples;
    type Picture = CudaPicture;

    fn name(&self) -> String {
        format!("cuda:{} {}", self.gpu.ordinal(), self.gpu.name())
    }

    fn prefetch(&self) -> Option<Listener> {
        // A weak reference: the I/O thread may outlive the run and must not keep the device open.
        let snapshots = Arc::downgrade(&self.snapshots);
        Some(Box::new(move |snapshot| {
            if let Some(snapshots) = snapshots.upgrade() {
                snapshots.expect(snapshot);
            }
        }))
    }

    fn open_storage(&mut self) -> Option<&mut Storage> {
        self.device.storage.is_none().then_some(&mut self.storage)
    }

    fn tracer(&mut self, velocity: &VelocitySource, map: &FlowMap, t0: f64) -> Result<CudaTracer, BackendError> {
        let tuning = Tuning { storage: self.storage, ..Tuning::default() };
        CudaTracer::new(&self.snapshots, &self.gpu, velocity.clone(), map, t0, tuning)
    }

    fn surrogate(&mut self, request: &SurrogateRequest<'_>, tracer: &CudaTracer) -> Result<CudaSurrogate, BackendError> {
        self.plan(request)?;
        if self.placement.frames == Place::Host {
            let SurrogateRequest { settings, network, domain, seed, stop, .. } = *request;
            return Ok(CudaSurrogate::OnHost(build(settings, network, domain, seed, &Interruptible::new(tracer, stop))?));
        }
        let nodes = if request.settings.kind == Kind::Network { [2; 3] } else { request.settings.nodes(request.domain)? };
        let (gpu, may_move) = (&self.gpu, self.placement.training == Place::Device);
        let training = |model| CudaTraining::new(gpu, HostNetwork::fresh(model), may_move);
        Ok(CudaSurrogate::Resident(Hybrid::new(request.settings.kind, nodes, request.network, request.seed, tracer, training)??))
    }

    fn render(
        &mut self,
        job: &FrameJob<'_, Self>,
        renderer: &mut Renderer,
        picture: &mut CudaPicture,
    ) -> Result<Rendered<CudaSamples>, DeviceError> {
        let resident = match job.surrogate {
            None => None,
            Some(CudaFrozen::Resident(frozen)) => Some(frozen),
            Some(CudaFrozen::OnHost(_)) => return self.render_on_cpu(job, renderer, &mut picture.host),
        };
        if self.placement.frames == Place::Host || job.is_map {
            return self.render_on_cpu(job, renderer, &mut picture.host);
        }
        self.frames()?.render(job, resident, renderer, picture.numbers)
    }

    fn audit(
        &mut self,
        request: &AuditRequest<'_>,
        tracer: &CudaTracer,
        surrogate: Option<&CudaFrozen>,
    ) -> Result<AuditFindings, DeviceError> {
        match surrogate {
            Some(CudaFrozen::Resident(frozen)) => self.frames()?.audit(request, tracer, frozen),
            surrogate => audit::audit(request, tracer, surrogate.map(|surrogate| surrogate as &dyn Predict)),
        }
    }

    fn replan(
        &mut self,
        shortage: &DeviceError,
        tracer: &CudaTracer,
        surrogate: &mut Option<CudaSurrogate>,
    ) -> Result<Option<String>, DeviceError> {
        let trains = surrogate.as_ref().is_some_and(Surrogate::trains_on_device);
        let Some(placement) = self.placement.lower(trains) else { return Ok(None) };
        self.placement = placement;
        if placement.frames == Place::Device {
            if let Some(CudaSurrogate::Resident(hybrid)) = surrogate
                && let Some(training) = hybrid.training_mut()
            {
                training.move_to_host()?;
            }
            return Ok(Some(format!("the network is trained on the CPU from now on: {shortage}")));
        }
        self.frames = None;
        if let Some(present) = surrogate {
            let mut moved = present.to_host(NetworkFrom::Device)?;
            // Traced in parts, so that the device holds the seeds and results of only one part.
            moved.trace_table(tracer)?;
            *present = CudaSurrogate::OnHost(moved);
        }
        Ok(Some(format!("the CPU renders the frames from now on and the GPU traces for them: {shortage}")))
    }

    fn most_refined_nodes(&self) -> usize {
        let share = self.gpu.memory_left() / REFINED_SHARE / size_of::<f32>() as u64;
        match self.placement.frames {
            Place::Device => MOST_REFINED_NODES.min(share as usize),
            Place::Host => crate::MOST_REFINED_NODES,
        }
    }

    fn nodes_per_sample(&self) -> [usize; 2] {
        if self.placement.frames == Place::Device { NODES_PER_SAMPLE } else { crate::NODES_PER_SAMPLE }
    }

    fn when_lost(&self) -> WhenLost {
        self.device.when_lost
    }

    fn may_fall_back(&self) -> bool {
        self.device.may_fall_back
    }

    fn warnings(&mut self) -> Vec<String> {
        std::mem::take(&mut self.warnings)
    }
}

impl Cuda {
    /// Renders a frame on the CPU; the GPU traces its queries.
    fn render_on_cpu(
        &mut self,
        job: &FrameJob<'_, Self>,
        renderer: &mut Renderer,
        picture: &mut HostPicture,
    ) -> Result<Rendered<CudaSamples>, DeviceError> {
        let surrogate = job.surrogate.map(|surrogate| surrogate as &dyn Predict);
        let Rendered { film, stats, tally, samples, error } = render_on_cpu(&HostFrame::of(job, job.tracer, surrogate), renderer, picture)?;
        Ok(Rendered { film, stats, tally, samples: CudaSamples::on_host(samples), error })
    }
}

/// Surrogate of the CUDA backend, on the processor that the placement selects.
#[allow(clippy::large_enum_variant)] // A run has a single one.
pub enum CudaSurrogate {
    /// Table and network on the GPU.
    Resident(Hybrid<OnGpu>),
    /// Table and network on the CPU. The GPU traces the table.
    OnHost(HostSurrogate),
}

/// Immutable copy of a [`CudaSurrogate`] for prediction.
pub enum CudaFrozen {
    /// On the GPU.
    Resident(FrozenHybrid<OnGpu>),
    /// On the CPU.
    OnHost(FrozenHybrid<Host>),
}

/// Evaluates the same expression for either variant.
macro_rules! either {
    ($type:ident, $value:expr, $inner:ident => $call:expr) => {
        match $value {
            $type::Resident($inner) => $call,
            $type::OnHost($inner) => $call,
        }
    };
}

impl Predict for CudaFrozen {
    fn name(&self) -> &'static str {
        either!(CudaFrozen, self, frozen => frozen.name())
    }
    fn predict(&self, points: &[UnitPoint], out: &mut [f32]) -> Result<(), DeviceError> {
        either!(CudaFrozen, self, frozen => frozen.predict(points, out))
    }
    fn seconds(&self, points: &[UnitPoint], out: &mut [f32]) -> Result<f64, DeviceError> {
        match self {
            Self::Resident(frozen) => seconds_of_prediction(frozen, points),
            Self::OnHost(frozen) => frozen.seconds(points, out),
        }
    }
    fn bytes(&self) -> usize {
        either!(CudaFrozen, self, frozen => frozen.bytes())
    }
}

impl Surrogate for CudaSurrogate {
    type Tracer = CudaTracer;
    type Frozen = CudaFrozen;

    fn freeze(&self) -> Result<CudaFrozen, DeviceError> {
        Ok(match self {
            Self::Resident(hybrid) => CudaFrozen::Resident(hybrid.freeze()?),
            Self::OnHost(hybrid) => CudaFrozen::OnHost(hybrid.freeze()?),
        })
    }
    fn learns(&self) -> bool {
        either!(CudaSurrogate, self, hybrid => hybrid.learns())
    }
    fn trains_on_device(&self) -> bool {
        either!(CudaSurrogate, self, hybrid => hybrid.trains_on_device())
    }
    fn learn(&mut self, buffer: &ReplayBuffer, seconds: f64, max_steps: u64) -> Result<Learned, DeviceError> {
        either!(CudaSurrogate, self, hybrid => hybrid.learn(buffer, seconds, max_steps))
    }
    fn trace_labels(&mut self, tracer: &CudaTracer, seed: u64, first: u64, count: usize) -> Result<bool, DeviceError> {
        match self {
            Self::Resident(hybrid) => trace_labels(hybrid, tracer, seed, first, count),
            Self::OnHost(_) => Ok(false),
        }
    }
    fn window_slid(&mut self, tracer: &CudaTracer, stop: &AtomicBool) -> Result<(), DeviceError> {
        match self {
            Self::Resident(hybrid) => hybrid.window_slid(tracer),
            Self::OnHost(hybrid) => hybrid.window_slid(&Interruptible::new(tracer, stop)),
        }
    }
    fn refine_table(&mut self, tracer: &CudaTracer, nodes: [usize; 3], most: usize, stop: &AtomicBool) -> Result<bool, DeviceError> {
        match self {
            Self::Resident(hybrid) => hybrid.refine_table(tracer, nodes, most, stop),
            Self::OnHost(hybrid) => hybrid.refine_table(&Interruptible::new(tracer, stop), nodes, most, stop),
        }
    }
    fn finer_nodes(&self) -> Option<[usize; 3]> {
        either!(CudaSurrogate, self, hybrid => hybrid.finer_nodes())
    }
    fn table_nodes(&self) -> Option<[usize; 3]> {
        either!(CudaSurrogate, self, hybrid => hybrid.table_nodes())
    }
    fn release(&mut self) -> Result<(), DeviceError> {
        match self {
            Self::Resident(hybrid) => {
                hybrid.forget_finer();
                hybrid.table_mut().map_or(Ok(()), |table| table.leave_device())
            }
            Self::OnHost(_) => Ok(()),
        }
    }
    fn checkpoint(&self) -> Result<CheckpointState, DeviceError> {
        either!(CudaSurrogate, self, hybrid => hybrid.checkpoint())
    }
    fn checkpoint_async(&mut self) -> Result<Option<CheckpointState>, DeviceError> {
        either!(CudaSurrogate, self, hybrid => hybrid.checkpoint_async())
    }
    fn load(&mut self, path: &Path) -> Result<(), CheckpointError> {
        either!(CudaSurrogate, self, hybrid => hybrid.load(path))
    }
    fn bytes(&self) -> usize {
        either!(CudaSurrogate, self, hybrid => Predict::bytes(hybrid))
    }
    fn to_host(&mut self, from: NetworkFrom) -> Result<HostSurrogate, DeviceError> {
        either!(CudaSurrogate, self, hybrid => hybrid.to_host(from))
    }
}
