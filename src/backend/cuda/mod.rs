//! The CUDA backend: velocity window, tracing, tables, networks and rendering on one GPU.
//!
//! In: the velocity of a slide, a flow map, and seeds or frames. Out: the results of the CPU backend, up to rounding. NVRTC compiles the kernels in
//! `kernels/` at start for the architecture of the device. Errors are [`DeviceError`]; a missing library or device is an error and never a panic.

mod device;
pub mod driver;
#[cfg(test)]
mod host_parity;
mod layout;
mod network;
mod rendering;
mod tracing;
mod window;

pub use super::settings::Storage;
pub use device::{Cuda, CudaFrozen, CudaSurrogate};
pub use driver::{Budget, Buffer, FoundDevice, Gpu, GpuSettings, compile, driver_error, launch, nvrtc_version, probe, threads};
pub use layout::Outputs;
pub use network::{
    CudaTable, CudaTraining, DeviceLabels, DeviceNetwork, DeviceSamples, DeviceTraining, LossTerms, NetworkAbove, OnGpu, Tiling, is_fused,
    network_defines,
};
pub use rendering::{
    Audits, CombineInput, CoupledStats, CoupledTracker, CudaSamples, DeviceLearns, DeviceLogStretch, DeviceNodes, DevicePredict,
    DeviceQueryRouter, Filled, FrameQueries, GpuCombine, GpuFrames, GpuMarch, GpuRenderer, LookAhead, Medium, NodeGrid, PairTiles,
    PinnedFilm, RayCheck, RoutedQueries, SUM_PLANES, SurrogateNodes, Timeline, TraceAll,
};
pub use ridgewatch_base::DeviceError;
pub use tracing::{CudaTracer, DeviceTable, DeviceTracer, SortCells, Sorter, Tuning};
pub use window::{DeviceMissingCells, DeviceSnapshot, DeviceWindow, SnapshotStore};
