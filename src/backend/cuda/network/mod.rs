//! Networks on the GPU: prediction, training, and the surrogates that use them.

mod batched;
#[cfg(test)]
mod host_parity;
mod layout;
#[allow(clippy::module_inception)] // the network itself
mod network;
mod resident;
mod samples;
mod training;

pub use batched::Tiling;
pub use network::{DeviceNetwork, LossTerms, NetworkAbove, is_fused, network_defines};
pub use resident::{CudaTable, CudaTraining, OnGpu};
pub(super) use resident::{LabelPool, LabelSink, frozen_parts, seconds_of_prediction, trace_labels};
pub(super) use samples::Filled;
pub use samples::{DeviceLabels, DeviceSamples};
pub use training::DeviceTraining;
