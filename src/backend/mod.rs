//! Who computes: one trait for tracing, remembering, rendering and training, and its implementations.
//!
//! In: a slide's velocity and the requests of `run`. Out: frames, audits, weights. Calls `field`, `flow`, `surrogate`, `trust` and `render`. A device that
//! fails returns [`DeviceError`]; `run` then discards the frame and makes it again elsewhere.

pub mod audit;
mod cpu;
#[cfg(feature = "cuda")]
pub mod cuda;
mod device;
mod error;
mod interruptible;
mod placement;
mod router;

pub use audit::{Audit, AuditFindings, AuditRequest, residuals, stratified_points, trusted_error};
pub use cpu::{Cpu, HostFrame, render_on_cpu};
#[cfg(feature = "cuda")]
pub use device::CudaDevice;
pub use device::{Device, DeviceChoice, DeviceSettings, Storage, TracedOnce, UnknownDevice, WhenLost};
pub use error::DeviceError;
pub use interruptible::Interruptible;
pub use placement::{Needs, Place, Placement};
pub use router::{QueryRouter, Routing, Tally};

use crate::field::Domain;
use crate::flow::{FlowError, FlowMap, VelocitySource};
use crate::render::{Film, RenderStats, Renderer};
use crate::source::Listener;
use crate::surrogate::network::NetworkSettings;
use crate::surrogate::{
    CheckpointError, CheckpointState, HostSurrogate, Learned, NetworkFrom, Predict, ReplayBuffer, Samples, SurrogateError,
    SurrogateSettings, Trace,
};
use std::path::Path;
use std::sync::atomic::AtomicBool;
use thiserror::Error;

/// Traces, remembers, renders and trains.
pub trait Backend: Send + Sync + Sized {
    /// A slide's flow map.
    type Tracer: Trace;
    /// A memory of the log-stretch that learns.
    type Surrogate: Surrogate<Tracer = Self::Tracer>;
    /// The labels that a frame traced. They count once they are committed.
    type Samples: FrameSamples;

    /// The device for records, for example `cuda:0 NVIDIA H200`.
    fn name(&self) -> String;

    /// The listener that hears of snapshots as they are read, to upload them before the window needs them.
    fn prefetch(&self) -> Option<Listener>;

    /// Uploads a slide's velocity and prepares its flow map for seeds at `t0`.
    ///
    /// # Errors
    /// A flow map that no tracer accepts; a device that fails or lacks memory.
    fn tracer(&mut self, velocity: &VelocitySource, map: &FlowMap, t0: f64) -> Result<Self::Tracer, BackendError>;

    /// Plans where the surrogate lives, and builds it.
    ///
    /// # Errors
    /// Settings that are out of range; a device that fails or lacks memory.
    fn surrogate(&mut self, request: &SurrogateRequest<'_>, tracer: &Self::Tracer) -> Result<Self::Surrogate, BackendError>;

    /// Renders one frame. Nothing that outlives the frame changes until its samples are committed, apart from `renderer`.
    ///
    /// # Errors
    /// A device that fails or lacks memory.
    fn render(&mut self, job: &FrameJob<'_, Self>, renderer: &mut Renderer) -> Result<Rendered<Self::Samples>, DeviceError>;

    /// Draws and traces a frame's audit points and measures the surrogate on them.
    ///
    /// # Errors
    /// A device that fails or lacks memory.
    fn audit(
        &mut self,
        request: &AuditRequest<'_>,
        tracer: &Self::Tracer,
        surrogate: Option<&FrozenOf<Self>>,
    ) -> Result<AuditFindings, DeviceError>;

    /// Plans the slide anew after a shortage of memory: moves part of the work to the CPU, and says in words which. `None` if nothing can be moved.
    ///
    /// # Errors
    /// The device fails while the surrogate moves.
    fn replan(
        &mut self,
        shortage: &DeviceError,
        tracer: &Self::Tracer,
        surrogate: &mut Option<Self::Surrogate>,
    ) -> Result<Option<String>, DeviceError>;

    /// What happens when the device is lost.
    fn when_lost(&self) -> WhenLost {
        WhenLost::Cpu
    }

    /// Whether the CPU computes if the first slide does not fit the device.
    fn may_fall_back(&self) -> bool {
        true
    }

    /// Warnings about the placement since the last call.
    fn warnings(&mut self) -> Vec<String> {
        Vec::new()
    }
}

/// The frozen surrogate of a backend.
pub type FrozenOf<B> = <<B as Backend>::Surrogate as Surrogate>::Frozen;

/// A memory of the log-stretch over the domain, which learns between or beside frames. Every call may fail with the device.
#[allow(clippy::missing_errors_doc)] // said above
pub trait Surrogate: Send + Sync + Sized {
    /// Traces the tables.
    type Tracer;
    /// The surrogate at one moment.
    type Frozen: Predict + 'static;

    /// The surrogate as it answers now: frames are rendered with it while training goes on.
    fn freeze(&self) -> Result<Self::Frozen, DeviceError>;
    /// Whether [`Surrogate::learn`] does anything.
    fn learns(&self) -> bool;
    /// Whether a device other than the CPU takes the optimizer steps.
    fn trains_on_device(&self) -> bool;
    /// Trains for at most `seconds` of wall clock and at most `max_steps` optimizer steps.
    fn learn(&mut self, buffer: &ReplayBuffer, seconds: f64, max_steps: u64) -> Result<Learned, DeviceError>;
    /// Takes the surrogate to a new window. Setting `stop` may end the tracing of its table early; the surrogate is then unusable.
    fn window_slid(&mut self, tracer: &Self::Tracer, stop: &AtomicBool) -> Result<(), DeviceError>;
    /// Frees device memory before another surrogate takes this one's place.
    fn release(&mut self) -> Result<(), DeviceError> {
        Ok(())
    }
    /// The state at this moment, which is waited for.
    fn checkpoint(&self) -> Result<CheckpointState, DeviceError>;
    /// The state without waiting; `None` while an earlier one is still being downloaded.
    fn checkpoint_async(&mut self) -> Result<Option<CheckpointState>, DeviceError>;
    /// Restores a checkpoint.
    fn load(&mut self, path: &Path) -> Result<(), CheckpointError>;
    /// Memory that prediction reads, bytes.
    fn bytes(&self) -> usize;
    /// The surrogate on the CPU, still without its table.
    fn to_host(&mut self, from: NetworkFrom) -> Result<HostSurrogate, DeviceError>;
}

/// What a surrogate is built from.
pub struct SurrogateRequest<'a> {
    /// Kind and table.
    pub settings: &'a SurrogateSettings,
    /// The network.
    pub network: &'a NetworkSettings,
    /// Where seeds lie.
    pub domain: &'a Domain,
    /// Draws the first weights and the batches.
    pub seed: u64,
    /// Samples that the replay buffer holds at most.
    pub replay_buffer: usize,
    /// Setting it may end the tracing of the table early; the surrogate is then unusable.
    pub stop: &'a AtomicBool,
}

/// One frame to render.
pub struct FrameJob<'a, B: Backend> {
    /// The slide's flow map.
    pub tracer: &'a B::Tracer,
    /// The surrogate that answers where the gate trusts it; `None`: everything is traced.
    pub surrogate: Option<&'a FrozenOf<B>>,
    /// Who answers which query, and which labels are kept.
    pub routing: Routing<'a>,
    /// Number of the picture, which decides its random numbers.
    pub picture: u64,
    /// Samples a pixel.
    pub samples: usize,
    /// Told the share that is rendered.
    pub progress: Option<&'a (dyn Fn(f32) + Sync)>,
    /// Ends the frame after the wave in progress when it is set.
    pub stop: &'a AtomicBool,
}

/// A rendered frame.
pub struct Rendered<S> {
    /// The picture.
    pub film: Film,
    /// The renderer's counts and times.
    pub stats: RenderStats,
    /// The router's counts and times.
    pub tally: Tally,
    /// The traced queries that were kept as labels.
    pub samples: S,
}

/// Labels of one frame. Dropped without [`FrameSamples::commit`], they leave no trace on the device either.
pub trait FrameSamples: Send {
    /// The labels on the host, before they count.
    fn on_host(&self) -> &Samples;
    /// Makes the labels count. Returns those that are on the host.
    fn commit(self) -> Samples;
}

impl FrameSamples for Samples {
    fn on_host(&self) -> &Samples {
        self
    }

    fn commit(self) -> Samples {
        self
    }
}

/// Why a backend cannot prepare a slide.
#[derive(Debug, Error)]
pub enum BackendError {
    /// A flow map that no tracer accepts.
    #[error(transparent)]
    Flow(#[from] FlowError),
    /// Settings of the surrogate.
    #[error(transparent)]
    Surrogate(#[from] SurrogateError),
    /// The device fails or lacks memory.
    #[error(transparent)]
    Device(#[from] DeviceError),
}
