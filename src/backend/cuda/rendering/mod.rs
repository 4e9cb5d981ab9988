//! Frames on the GPU: wavefront path tracing, query routing, labels and audits.

mod audit;
mod bricks;
mod combine;
mod coupled;
mod films;
mod frames;
#[cfg(test)]
mod host_parity;
mod labels;
mod march;
mod memory;
mod predictor;
mod renderer;
mod router;
mod smooth;

pub use audit::Audits;
pub use combine::{CombineInput, GpuCombine};
pub use coupled::{CoupledStats, CoupledTracker, PairTiles, SUM_PLANES, SurrogateNodes};
pub use films::{Filled, PinnedFilm};
pub use frames::{CudaSamples, GpuFrames};
pub(super) use labels::HELD_BACK;
pub use march::{DeviceNodes, GpuMarch, Medium, NodeGrid, RayCheck};
pub use renderer::{GpuRenderer, LookAhead, Timeline};
pub use router::{DeviceLearns, DeviceLogStretch, DevicePredict, DeviceQueryRouter, FrameQueries, RoutedQueries, TraceAll};
