//! Monte Carlo volume rendering: camera, light, transfer function, majorant grid, tracking, film.
//!
//! In: a scene and something that answers log-stretch queries in batches. Out: a linear HDR film. Does not know who answers.
//! Calls `field` for the domain only.
//!
//! A picture is an estimate of single scattering in a box: free flights by delta tracking, transmittance toward the light by ratio
//! tracking, both through a grid of majorants. All flights advance together (a wavefront), so that whoever answers gets large batches.

mod camera;
mod error;
mod film;
mod light;
mod majorant;
mod parameters;
mod renderer;
mod scene;
mod settings;
mod space;
mod tracking;
mod transfer;
mod wavefront;

pub mod rng;

pub use camera::Camera;
pub use error::RenderError;
pub use film::Film;
pub use light::Light;
pub use majorant::MajorantGrid;
pub use parameters::{FrameParameters, FrameSetup, PixelValue, SeenInCells};
pub use renderer::{RenderStats, Renderer};
pub use scene::Scene;
pub(crate) use settings::MAX_SAMPLES;
pub use settings::{CameraSettings, LightSettings, Method, RenderSettings, TransferSettings};
pub use space::overview_scale;
pub use transfer::{ALBEDO_PRESETS, Transfer, albedo_preset};

/// Answers log-stretch queries. The renderer hands over the collision points of one wavefront step at a time.
pub trait LogStretch {
    /// Writes the log-stretch at each point (domain coordinates) into `log_stretch` and whether it was traced by RK4 (true) or
    /// predicted (false) into `traced`; all three have the same length. NaN means "no value here" (land): such a point is empty
    /// space, and is counted.
    fn evaluate(&mut self, points: &[[f32; 3]], log_stretch: &mut [f32], traced: &mut [bool]);
}
