//! Monte Carlo volume rendering: camera, light, transfer function, majorant grid, tracking, film.
//!
//! In: a scene and a [`LogStretch`] that answers queries in batches. Out: a linear HDR film. Calls only `field` (the domain) and `setting`.
//!
//! A tracked picture is an unbiased estimate of single scattering in a box: free flights by delta tracking (Woodcock et al. 1965), transmittance to
//! the light by ratio tracking (Novak et al. 2014), both through a grid of majorants. All flights advance together as a wavefront, so that
//! queries come in large batches.

use ridgewatch_field::DomainPoint;

mod albedo;
mod camera;
mod error;
mod film;
mod light;
mod majorant;
mod map_picture;
mod map_plane;
mod parameters;
mod projection;
mod rays;
mod renderer;
mod scene;
mod settings;
pub mod smooth;
mod space;
mod tracking;
mod transfer;
mod wavefront;

pub mod rng;

pub use albedo::{ALBEDO_PRESETS, albedo_preset};
pub use camera::Camera;
pub use error::RenderError;
pub use film::Film;
pub use light::Light;
pub use majorant::{CellObservations, MajorantGrid};
pub use map_picture::{MAP_TONE, MapPicture, footprint, map_radiance, viridis};
pub use map_plane::MapPlane;
pub use parameters::FrameParameters;
pub use projection::{Projection, ProjectionKind, Unprojectable, outline};
pub use rays::RayPoints;
pub use renderer::{FrameSetup, RenderStats, Renderer, check_depth};
pub use scene::Scene;
pub use settings::{Albedo, CameraSettings, Combine, LightSettings, Method, ProjectionChoice, RenderSettings, Target, TransferSettings};
pub use settings::{MAX_FRAMES_UNTIL, MAX_SAMPLES, UNTIL_SLACK};
pub use space::{GridPoint, SceneBox, overview_scale};
pub use tracking::FrameScene;
pub use transfer::{Transfer, map_range};

/// Answers log-stretch queries. The renderer passes the collision points of one wavefront step per call.
pub trait LogStretch {
    /// Writes the log-stretch at each point to `log_stretch`, and to `traced` whether RK4 traced it (true) or a surrogate
    /// predicted it (false). All three slices have the same length. NaN marks a point in a missing cell, which is empty space and is counted.
    fn evaluate(&mut self, points: &[DomainPoint], log_stretch: &mut [f32], traced: &mut [bool]);
}
