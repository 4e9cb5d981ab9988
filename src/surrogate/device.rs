//! The types that hold a surrogate's table and network on one device, and compute with them there.
//!
//! [`Host`](super::Host) implements them on the CPU, the CUDA backend on a GPU. The schedule of training, the shrinkage and the checkpoints are
//! written once, over these traits.

use super::network::{Architecture, Average, Model, Objective, PlannedStep};
use super::trace::Trace;
use super::{Kind, Predict, ReplayBuffer, Table};
use ridgewatch_base::DeviceError;
use ridgewatch_field::UnitPoint;
use std::sync::Arc;

/// One device, with its types for the parts of a surrogate.
pub trait SurrogateDevice: Sized + Send + Sync + 'static {
    /// Traces the nodes of tables.
    type Tracer<'t>: Trace + ?Sized;
    /// Log-stretch at the nodes of a grid.
    type Table: SurrogateTable;
    /// A network in training.
    type Training: Training<Table = Self::Table>;

    /// Traces a table with `nodes` along x, y, z. `old` is the table that it replaces; its memory is free before the new one is traced.
    ///
    /// # Errors
    /// The device fails or lacks memory.
    fn trace_table(tracer: &Self::Tracer<'_>, nodes: [usize; 3], old: Option<Self::Table>) -> Result<Self::Table, DeviceError>;

    /// Creates a table with `nodes` along x, y, z, none of which is traced yet.
    ///
    /// # Errors
    /// The device fails or lacks memory.
    fn untraced_table(tracer: &Self::Tracer<'_>, nodes: [usize; 3]) -> Result<Self::Table, DeviceError>;

    /// Traces about `most` further nodes of a table that is not shared yet. True once every node is traced.
    ///
    /// # Errors
    /// The device fails or lacks memory.
    fn trace_more(tracer: &Self::Tracer<'_>, table: &mut Self::Table, most: usize) -> Result<bool, DeviceError>;

    /// Writes the log-stretch of a frozen surrogate at unit points into `out` (same length).
    ///
    /// # Errors
    /// The device fails or lacks memory; `out` is then unspecified.
    fn predict(frozen: &FrozenHybrid<Self>, points: &[UnitPoint], out: &mut [f32]) -> Result<(), DeviceError>;
}

/// An immutable copy of a surrogate. Frames are rendered with it while training continues.
pub struct FrozenHybrid<D: SurrogateDevice> {
    /// The table, if there is one.
    pub table: Option<D::Table>,
    /// The network, if there is one.
    pub network: Option<Arc<<D::Training as Training>::Network>>,
    /// Factor on the network above a table; 1 without a table.
    pub shrinkage: f32,
    /// Start time and duration of predictions, in unit intervals.
    pub times: [f32; 2],
    /// Unique number of this frozen surrogate in this process.
    pub stamp: u64,
    pub(super) kind: Kind,
    pub(super) bytes: usize,
}

impl<D: SurrogateDevice> Predict for FrozenHybrid<D> {
    fn name(&self) -> &'static str {
        self.kind.name()
    }

    fn predict(&self, points: &[UnitPoint], out: &mut [f32]) -> Result<(), DeviceError> {
        D::predict(self, points, out)
    }

    fn bytes(&self) -> usize {
        self.bytes
    }
}

impl<D: SurrogateDevice> FrozenHybrid<D> {
    /// Returns the surrogate with shrinkage 1, to evaluate its parts.
    pub(super) fn parts(&self) -> Self {
        let Self { table, network, times, stamp, kind, bytes, .. } = self;
        Self { table: table.clone(), network: network.clone(), shrinkage: 1.0, times: *times, stamp: *stamp, kind: *kind, bytes: *bytes }
    }
}

/// A table on a device. Clones share the values.
pub trait SurrogateTable: Clone + Send + Sync + 'static {
    /// The table on the host. The values are downloaded at most once.
    ///
    /// # Errors
    /// The device fails.
    fn to_host(&self) -> Result<Table, DeviceError>;

    /// A table of the same kind with the values that a checkpoint gives.
    ///
    /// # Errors
    /// The device fails or lacks memory.
    fn with_values(&self, values: Table) -> Result<Self, DeviceError>;
}

/// The samples and the table that a network is trained with.
pub struct Labels<'a, T> {
    /// Traced samples on the host.
    pub buffer: &'a ReplayBuffer,
    /// The table below the network, which is trained on the difference; `None`: it is trained on the samples themselves.
    pub base: Option<&'a T>,
}

impl<T> Clone for Labels<'_, T> {
    fn clone(&self) -> Self {
        *self
    }
}

impl<T> Copy for Labels<'_, T> {}

/// Samples where a network is trained.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct SyncedSamples {
    /// Samples that can be trained on. A device may hold more than the replay buffer: labels that were traced there stay there.
    pub usable: usize,
    /// Samples of the replay buffer that are left out because they are not finite.
    pub dropped: usize,
}

/// A network with its optimizer state on the host.
#[derive(Clone)]
pub struct HostNetwork {
    /// Parameters and moments.
    pub model: Model,
    /// Running mean of the parameters.
    pub average: Arc<Average>,
}

/// Downloads a copy of a network that a device has made.
pub type Download = Box<dyn FnOnce() -> Result<HostNetwork, DeviceError> + Send>;

/// A copy of a network in training.
#[allow(clippy::large_enum_variant)] // A run has a single one.
pub enum NetworkCopy {
    /// On the host. The reason is given if training had to wait for it.
    Ready(HostNetwork, Option<String>),
    /// On the device; another thread can download it while training continues.
    Downloadable(Download),
}

/// A network in training on one device. Every call may fail with the device.
#[allow(clippy::missing_errors_doc)] // said above
pub trait Training: Send + Sync + Sized {
    /// The table below the network.
    type Table: SurrogateTable;
    /// An immutable network, for prediction.
    type Network: Send + Sync;

    /// The layout of the parameters.
    fn shape(&self) -> &Architecture;

    /// Optimizer steps taken so far.
    fn steps_taken(&self) -> usize;

    /// True if a device other than the CPU takes the steps.
    fn is_on_device(&self) -> bool;

    /// Moves the network to where it is trained, if it is not there yet. The scale of `objective` is final.
    fn begin(&mut self, objective: &Objective, capacity: usize, batch: usize) -> Result<(), DeviceError>;

    /// Brings the samples up to date.
    fn sync(&mut self, objective: &Objective, labels: Labels<'_, Self::Table>) -> Result<SyncedSamples, DeviceError>;

    /// Takes optimizer steps on the synced samples. Returns the loss before each step.
    fn train(&mut self, objective: &Objective, labels: Labels<'_, Self::Table>, steps: &[PlannedStep]) -> Result<Vec<f64>, DeviceError>;

    /// Recommended number of steps before the next reading of the clock, with `seconds` left.
    fn group(&self, seconds: f64) -> u64;

    /// Saves parameters, moments and mean as the state to roll back to.
    fn keep(&mut self) -> Result<(), DeviceError>;

    /// Returns to the state that [`Training::keep`] saved last.
    fn roll_back(&mut self) -> Result<(), DeviceError>;

    /// Sets the running mean to the present parameters.
    fn restart_average(&mut self) -> Result<(), DeviceError>;

    /// Prepares prediction after the last step of a call.
    fn settle(&mut self);

    /// Sets the output layer, its moments and its mean to 0.
    fn zero_output(&mut self) -> Result<(), DeviceError>;

    /// Drops the labels that stay on the device: the window has slid.
    fn forget_labels(&mut self);

    /// The running mean, for prediction.
    fn frozen(&self, objective: &Objective) -> Result<Arc<Self::Network>, DeviceError>;

    /// Downloads the network and waits for it.
    fn download(&self) -> Result<HostNetwork, DeviceError>;

    /// Copies the network, to be downloaded by another thread.
    fn copy(&mut self) -> Result<NetworkCopy, DeviceError>;

    /// The latest host copy, without asking the device.
    fn host_copy(&self) -> &HostNetwork;

    /// Takes in a downloaded network as the latest host copy.
    fn set_host_copy(&mut self, network: HostNetwork);

    /// Replaces the network, as a checkpoint does. It moves to the device again with [`Training::begin`].
    fn restore(&mut self, network: HostNetwork);

    /// Device time of the steps since the last call, seconds; `None` if the CPU took them.
    fn device_seconds(&mut self) -> Option<f64>;
}

/// Origin of the network with which the CPU continues.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum NetworkFrom {
    /// The device, if it still works.
    Device,
    /// The latest host copy, if the device is lost.
    HostCopy,
}
