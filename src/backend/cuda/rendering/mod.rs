//! Frames on the GPU: wavefront path tracing, query routing, labels and audits.

mod audit;
mod combine;
mod frames;
mod labels;
mod march;
mod memory;
mod renderer;
mod router;

pub use audit::Audits;
pub use combine::{CombineInput, FilmPlanes, GpuCombine, TileErrors, TileSums};
pub use frames::{CudaSamples, GpuFrames};
pub(super) use labels::HELD_BACK;
pub use labels::keeps_label;
#[cfg(test)]
pub(crate) use march::LightArgument;
pub use march::{DeviceNodes, GpuMarch, Medium, NodeGrid, RayCheck};
pub use renderer::{GpuRenderer, LookAhead, Timeline};
pub use router::{DeviceAnswers, DeviceLearns, DevicePredict, FrameQueries, QueryRouter, RoutedQueries, TraceAll};
