//! Compute backends: one trait for tracing, prediction, rendering, audits and training, with a CPU and a CUDA implementation.
//!
//! In: the velocity of a slide and the requests of `run`. Out: frames, audits, checkpoints. Uses `field`, `source`, `flow`, `surrogate`, `trust` and `render`.
//! If a device fails, the call returns [`DeviceError`]. `run` then discards the frame and computes it again on the CPU.

pub mod audit;
mod bricks;
mod cpu;
#[cfg(feature = "cuda")]
pub mod cuda;
mod device;
mod interruptible;
mod placement;
mod router;
mod settings;

pub use audit::{Audit, AuditFindings, AuditRequest, residuals, stratified_points, trusted_error};
pub use bricks::TracedBricks;
pub use cpu::{Cpu, HostFrame, HostPicture, render_on_cpu};
#[cfg(feature = "cuda")]
pub use device::CudaDevice;
pub use device::{Device, TracedOnce};
pub use interruptible::Interruptible;
pub use placement::{Needs, Place, Placement};
pub use ridgewatch_base::DeviceError;
pub use router::{QueryRouter, Routing, Tally, keeps_label};
pub use settings::{DeviceChoice, DeviceSettings, Storage, UnknownDevice, WhenLost};

use ridgewatch_field::Domain;
use ridgewatch_flow::{FlowError, FlowMap, VelocitySource};
use ridgewatch_render::smooth::{PictureError, StepsError};
use ridgewatch_render::{Film, Method, RenderStats, Renderer};
use ridgewatch_source::Listener;
use ridgewatch_surrogate::network::NetworkSettings;
use ridgewatch_surrogate::{
    CheckpointError, CheckpointState, HostSurrogate, Learned, NetworkFrom, Predict, ReplayBuffer, Samples, SurrogateError,
    SurrogateSettings, Trace,
};
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use thiserror::Error;

/// A processor that traces, renders, audits and trains.
pub trait Backend: Send + Sync + Sized {
    /// Flow map of a slide.
    type Tracer: Trace;
    /// Approximation of the log-stretch that learns from traced labels.
    type Surrogate: Surrogate<Tracer = Self::Tracer>;
    /// Labels that a frame traced. They take effect when they are committed.
    type Samples: FrameSamples;
    /// Picture that accumulates over frames. The default value has no samples; each window has its own.
    type Picture: Default + Send + StartsAnew;

    /// Device name in the records, for example `cuda:0 NVIDIA H200`.
    fn name(&self) -> String;

    /// Returns a listener that is called with each snapshot that is read, to upload it before the window needs it. `None` on the CPU.
    fn prefetch(&self) -> Option<Listener>;

    /// Form in which later windows are held, if the settings leave it to the run. `None`: they do not, or the backend has no forms (CPU).
    fn open_storage(&mut self) -> Option<&mut Storage> {
        None
    }

    /// Uploads the velocity of a slide and prepares its flow map for seeds at the start time `t0`.
    ///
    /// # Errors
    /// The flow map is invalid, or the device fails or lacks memory.
    fn tracer(&mut self, velocity: &VelocitySource, map: &FlowMap, t0: f64) -> Result<Self::Tracer, BackendError>;

    /// Plans the placement of the surrogate and builds it.
    ///
    /// # Errors
    /// A setting is out of range, or the device fails or lacks memory.
    fn surrogate(&mut self, request: &SurrogateRequest<'_>, tracer: &Self::Tracer) -> Result<Self::Surrogate, BackendError>;

    /// Renders one frame. Until its samples are committed, the frame changes no lasting state except `renderer` and, for smooth frames, `picture`,
    /// to which it adds its samples.
    ///
    /// # Errors
    /// The device fails or lacks memory. `picture` is then unspecified if the device is lost, and otherwise as before.
    fn render(
        &mut self,
        job: &FrameJob<'_, Self>,
        renderer: &mut Renderer,
        picture: &mut Self::Picture,
    ) -> Result<Rendered<Self::Samples>, DeviceError>;

    /// Draws and traces the audit points of a frame, and measures the surrogate on them.
    ///
    /// # Errors
    /// The device fails or lacks memory.
    fn audit(
        &mut self,
        request: &AuditRequest<'_>,
        tracer: &Self::Tracer,
        surrogate: Option<&FrozenOf<Self>>,
    ) -> Result<AuditFindings, DeviceError>;

    /// Plans the slide again after the device ran out of memory: moves part of the work to the CPU and returns a warning that says which part.
    /// `None` if nothing can be moved.
    ///
    /// # Errors
    /// The device fails while the surrogate moves to the CPU.
    fn replan(
        &mut self,
        shortage: &DeviceError,
        tracer: &Self::Tracer,
        surrogate: &mut Option<Self::Surrogate>,
    ) -> Result<Option<String>, DeviceError>;

    /// Largest number of nodes to which a table may be refined while its picture stands still.
    fn most_refined_nodes(&self) -> usize {
        MOST_REFINED_NODES
    }

    /// Nodes of a finer table that a sample of a frame is worth, and those that take as long as it does.
    fn nodes_per_sample(&self) -> [usize; 2] {
        NODES_PER_SAMPLE
    }

    /// Returns true if a device other than the CPU computes.
    fn is_gpu(&self) -> bool {
        true
    }

    /// Reaction to a lost device.
    fn when_lost(&self) -> WhenLost {
        WhenLost::Cpu
    }

    /// Returns true if the CPU takes over when the first slide does not fit the device.
    fn may_fall_back(&self) -> bool {
        true
    }

    /// Returns the warnings about the placement since the last call.
    fn warnings(&mut self) -> Vec<String> {
        Vec::new()
    }
}

/// Largest number of nodes of a refined table on the CPU: 64 MiB.
const MOST_REFINED_NODES: usize = 1 << 24;
/// [`Backend::nodes_per_sample`] of the CPU.
const NODES_PER_SAMPLE: [usize; 2] = [16, 16];

/// Frozen surrogate of a backend.
pub type FrozenOf<B> = <<B as Backend>::Surrogate as Surrogate>::Frozen;

/// An approximation of the log-stretch over the domain. It learns between frames or concurrently with them.
///
/// # Errors
/// All methods that return a `Result` fail if the device fails or lacks memory; [`Surrogate::load`] also fails if the checkpoint does not fit.
#[allow(clippy::missing_errors_doc)] // stated above
pub trait Surrogate: Send + Sync + Sized {
    /// Tracer that fills the table.
    type Tracer;
    /// Immutable copy of the surrogate for prediction.
    type Frozen: Predict + 'static;

    /// Returns an immutable copy of the present state. Frames are rendered with it while training continues.
    fn freeze(&self) -> Result<Self::Frozen, DeviceError>;
    /// Returns true if [`Surrogate::learn`] has an effect.
    fn learns(&self) -> bool;
    /// Returns true if a device other than the CPU computes the optimizer steps.
    fn trains_on_device(&self) -> bool;
    /// Trains for at most `seconds` of wall clock and at most `max_steps` optimizer steps.
    fn learn(&mut self, buffer: &ReplayBuffer, seconds: f64, max_steps: u64) -> Result<Learned, DeviceError>;
    /// Traces `count` uniform random points, a function of `seed` and of their numbers from `first` on, as labels of training that stay on its
    /// device. Returns false, without effect, if training is on the CPU or has not begun, or if the domain has missing cells.
    fn trace_labels(&mut self, tracer: &Self::Tracer, seed: u64, first: u64, count: usize) -> Result<bool, DeviceError> {
        let _ = (tracer, seed, first, count);
        Ok(false)
    }
    /// Moves the surrogate to a new window. Setting `stop` may end the tracing of its table early; the surrogate is then unusable.
    fn window_slid(&mut self, tracer: &Self::Tracer, stop: &AtomicBool) -> Result<(), DeviceError>;
    /// Traces about `most` further nodes of a finer table, as [`ridgewatch_surrogate::Hybrid::refine_table`] does.
    fn refine_table(&mut self, tracer: &Self::Tracer, nodes: [usize; 3], most: usize, stop: &AtomicBool) -> Result<bool, DeviceError>;
    /// Nodes of the finer table that is being traced; `None` if there is none.
    fn finer_nodes(&self) -> Option<[usize; 3]>;
    /// Nodes of the table along x, y, z; `None` without a table.
    fn table_nodes(&self) -> Option<[usize; 3]>;
    /// Frees device memory before another surrogate replaces this one.
    fn release(&mut self) -> Result<(), DeviceError> {
        Ok(())
    }
    /// Returns the present state. Waits for the device.
    fn checkpoint(&self) -> Result<CheckpointState, DeviceError>;
    /// Returns the present state without waiting for its download. `None` while an earlier download is in progress.
    fn checkpoint_async(&mut self) -> Result<Option<CheckpointState>, DeviceError>;
    /// Restores a checkpoint.
    fn load(&mut self, path: &Path) -> Result<(), CheckpointError>;
    /// Memory that prediction reads, in bytes.
    fn bytes(&self) -> usize;
    /// Returns the surrogate on the CPU. Its table is not traced yet.
    fn to_host(&mut self, from: NetworkFrom) -> Result<HostSurrogate, DeviceError>;
}

/// Inputs for building a surrogate.
pub struct SurrogateRequest<'a> {
    /// Kind of the surrogate and nodes of its table.
    pub settings: &'a SurrogateSettings,
    /// Architecture and training of the network.
    pub network: &'a NetworkSettings,
    /// Domain of the seeds.
    pub domain: &'a Domain,
    /// Random seed of the initial weights and of the batches.
    pub seed: u64,
    /// Capacity of the replay buffer, in samples.
    pub replay_buffer: usize,
    /// Setting it may end the tracing of the table early; the surrogate is then unusable.
    pub stop: &'a AtomicBool,
}

/// One frame to render.
pub struct FrameJob<'a, B: Backend> {
    /// Flow map of the slide.
    pub tracer: &'a B::Tracer,
    /// Surrogate for cells that the gate trusts. `None`: every query is traced.
    pub surrogate: Option<&'a FrozenOf<B>>,
    /// Routing of the queries, and which labels are kept.
    pub routing: Routing<'a>,
    /// Picture number; it selects the random stream.
    pub picture: u64,
    /// Samples per pixel.
    pub samples: f64,
    /// `Some` for methods that march the surrogate; `None`: the frame is tracked, unless it is a map.
    pub smooth: Option<Smooth>,
    /// The picture is a map, which accumulates and has no surrogate.
    pub is_map: bool,
    /// Called with the share of the frame that is rendered, from 0 to 1.
    pub progress: Option<&'a (dyn Fn(f32) + Sync)>,
    /// Setting it ends the frame soon, within a wave where the CPU traces and after the wave in progress where a device does. The frame is then
    /// of no use, whatever its counts say.
    pub stop: &'a AtomicBool,
}

/// Settings of a frame whose picture accumulates.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Smooth {
    /// `marched` or `two_level`.
    pub method: Method,
    /// Adds the correction without shrinkage.
    pub sum: bool,
    /// Nodes along x, y, z on which a surrogate without a table is laid out.
    pub nodes: [usize; 3],
    /// Most of these nodes that are traced when a picture starts, where the gate does not trust the surrogate.
    pub traced_nodes: usize,
    /// Seconds that the frame should take, if they are limited. On the CPU marching keeps to them over the frames; on a device it takes milliseconds.
    pub budget: Option<f64>,
    /// Error of the Runge-Kutta steps, which the picture states too.
    pub steps_error: StepsError,
}

/// A rendered frame.
pub struct Rendered<S> {
    /// The picture.
    pub film: Arc<Film>,
    /// Counts and times of the renderer.
    pub stats: RenderStats,
    /// Counts and times of the query router.
    pub tally: Tally,
    /// Traced queries that are kept as labels.
    pub samples: S,
    /// Stated error of a smooth frame.
    pub error: Option<PictureError>,
}

/// A picture that shows another surrogate of the same window.
pub trait StartsAnew {
    /// Forgets all samples and the surrogate, but not the nodes that were traced.
    fn start_anew(&mut self);
}

/// Labels of one frame. If they are dropped without [`FrameSamples::commit`], they are removed from the device as well.
pub trait FrameSamples: Send {
    /// Returns the labels on the host, before the commit.
    fn on_host(&self) -> &Samples;
    /// Commits the labels for training. Returns the labels on the host.
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

/// Error in preparing a slide.
#[derive(Debug, Error)]
pub enum BackendError {
    /// The flow map is invalid.
    #[error(transparent)]
    Flow(#[from] FlowError),
    /// A setting of the surrogate is out of range.
    #[error(transparent)]
    Surrogate(#[from] SurrogateError),
    /// The device fails or lacks memory.
    #[error(transparent)]
    Device(#[from] DeviceError),
}
