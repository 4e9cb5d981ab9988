//! Safe wrappers of the CUDA driver and NVRTC: context, streams, memory, kernel compilation and launches.

pub mod compile;
mod error;
mod gpu;
mod launch;
mod memory;
pub(super) mod pinned;
mod readback;

pub use compile::nvrtc_version;
pub use error::driver_error;
pub use gpu::{FoundDevice, Gpu, GpuSettings, probe};
pub(super) use launch::Resident;
pub use launch::{launch, threads};
pub use memory::{Budget, Buffer};
