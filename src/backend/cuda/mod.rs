//! The CUDA backend: device, window ring, sorted tracing, tables and networks on a GPU.
//!
//! In: a slide's velocity, a flow map, and seeds or frames. Out: what the CPU backend gives, up to rounding. Kernels are in `kernels/`, compiled at start
//! for the device found. Everything here returns [`DeviceError`]; nothing panics where libraries or devices are missing.

mod device;
pub mod driver;
#[cfg(test)]
mod host_parity;
mod layout;
mod network;
mod rendering;
mod tracing;
mod window;

pub use super::device::Storage;
pub use super::error::DeviceError;
pub use device::{Cuda, CudaFrozen, CudaSurrogate};
pub use driver::{Budget, Buffer, FoundDevice, Gpu, GpuSettings, compile, launch, nvrtc_version, probe, threads};
pub use layout::Outputs;
pub use network::{
    CudaTable, CudaTraining, DeviceNetwork, DeviceSamples, DeviceTraining, NetworkAbove, OnGpu, Tiling, is_fused, network_defines,
};
pub use rendering::{
    Audits, CudaSamples, DeviceAnswers, DeviceLearns, DevicePredict, FrameQueries, GpuFrames, GpuRenderer, LookAhead, QueryRouter,
    RoutedQueries, Timeline, TraceAll, keeps_label,
};
pub use tracing::{CudaTracer, DeviceTable, DeviceTracer, SortCells, Sorter, Tuning};
pub use window::{DeviceMissingCells, DeviceSnapshot, DeviceWindow, SnapshotStore};
