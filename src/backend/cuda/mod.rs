//! The GPU engine: device, window ring, sorted tracing, tables and networks on CUDA.
//!
//! In: a velocity source, a flow map and seeds, on the host (as a [`crate::flow::Tracer`]) or on the device. Out: what the CPU's tracer
//! gives. Kernels are in `kernels/`, compiled at start for the device found. Everything here returns [`DeviceError`]; nothing panics where
//! libraries or devices are missing.

mod accelerator;
mod ahead;
mod answers;
mod audit;
mod behind;
pub mod compile;
mod device;
mod error;
mod frames;
mod grid;
#[cfg(test)]
mod host_parity;
mod labels;
mod land;
mod launch;
mod layout;
mod memory;
mod network;
mod network_batched;
#[cfg(test)]
mod network_host_parity;
mod network_layout;
mod network_samples;
mod network_training;
mod offload;
mod pinned;
mod predictor;
mod render;
mod render_memory;
mod sort;
mod table;
mod trace;
mod tracer;
mod transfer;
mod window;

pub use super::device::Storage;
pub use accelerator::CudaAccelerator;
pub use answers::{DeviceAnswers, DeviceLearns, DevicePredict, Divided, Division, Panel, Traced};
pub use audit::Audits;
pub use compile::nvrtc_version;
pub use device::{FoundDevice, Gpu, GpuSettings, probe};
pub use error::DeviceError;
pub use labels::keeps_label;
pub use land::DeviceLand;
pub use launch::{launch, threads};
pub use layout::Outputs;
pub use memory::{Budget, Buffer};
pub use network::{DeviceNetwork, NetworkAbove, is_fused, network_defines};
pub use network_batched::Tiling;
pub use network_samples::DeviceSamples;
pub use network_training::DeviceTraining;
pub use offload::CudaOffload;
pub use render::{GpuRenderer, LookAhead, Timeline};
pub use sort::{SortCells, Sorter};
pub use table::DeviceTable;
pub use trace::{DeviceTracer, Tuning};
pub use tracer::{CudaTrace, CudaTracer, CudaTracerError};
pub use window::{DeviceSnapshot, DeviceWindow, SnapshotStore};
