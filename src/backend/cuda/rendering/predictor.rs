//! What answers trusted queries on the device.

use super::router::{DeviceLearns, DevicePredict};
use crate::DeviceError;
use crate::cuda::network::{LabelSink, NetworkAbove, OnGpu, frozen_parts};
use crate::cuda::tracing::{CudaTracer, DeviceTable};
use ridgewatch_surrogate::FrozenHybrid;

/// Device-side predictor of one frame.
pub(in crate::cuda) enum Predictor<'a> {
    Table(&'a DeviceTable),
    /// The network, above a table if the surrogate has one, and the sink for labels if the device trains the network.
    Network(NetworkAbove<'a>, Option<LabelSink<'a>>),
}

impl<'a> Predictor<'a> {
    pub(super) fn of(frozen: &'a FrozenHybrid<OnGpu>, tracer: &'a CudaTracer) -> Result<Self, DeviceError> {
        Ok(match frozen_parts(frozen)? {
            (base, Some(network)) => {
                let sink = network.label_sink(tracer.host().domain(), base, frozen.times);
                Self::Network(network.network().above(base.map(|base| (base, frozen.shrinkage))).at(frozen.times), sink)
            }
            (Some(table), None) => Self::Table(table),
            (None, None) => return Err(DeviceError::Unsupported { what: "a surrogate without table and network".into() }),
        })
    }

    pub(super) fn label_sink(&self) -> Option<&dyn DeviceLearns> {
        match self {
            Self::Network(_, Some(sink)) => Some(sink),
            _ => None,
        }
    }
}

impl DevicePredict for Predictor<'_> {
    unsafe fn predict(&self, points: u64, count: usize, out: u64) -> Result<(), DeviceError> {
        // SAFETY: guaranteed by the caller.
        unsafe {
            match self {
                Self::Table(table) => table.predict(points, count, out),
                Self::Network(network, _) => network.predict(points, count, out),
            }
        }
    }
}
