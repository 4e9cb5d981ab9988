//! What a picture shows, and how.

use super::error::{RenderError, require};
use super::{CameraSettings, LightSettings, RenderSettings, TransferSettings, overview_scale};
use crate::field::Domain;

/// Largest picture edge, in pixels.
const MAX_EDGE: usize = 16_384;
/// Largest number of pixels: a film of them takes 3 GB.
const MAX_PIXELS: usize = 1 << 26;
/// Largest number of samples a pixel in one call.
const MAX_SAMPLES: usize = 1 << 24;
/// Largest number of majorant cells along one axis.
const MAX_CELLS: usize = 1024;

/// A scene to render. Camera, light and extinction are in scene units: domain coordinates times `scale`.
#[derive(Debug, Clone, PartialEq)]
pub struct Scene {
    /// View.
    pub camera: CameraSettings,
    /// Light.
    pub light: LightSettings,
    /// Transfer function; `low` and `high` must be set ([`TransferSettings::scaled_to`]).
    pub transfer: TransferSettings,
    /// Size of the picture and the rest.
    pub settings: RenderSettings,
    /// Seed of every random number.
    pub seed: u64,
    /// Scene units per domain unit, along each axis.
    pub scale: [f64; 3],
}

impl Scene {
    /// Puts a scene together from what a scene file gives; the rest are defaults. When it names a camera, a light's position or an
    /// extinction, the scale is 1 and its numbers are lengths in domain coordinates, exactly; otherwise [`overview_scale`].
    pub fn assemble(
        domain: &Domain,
        camera: Option<CameraSettings>,
        light: Option<LightSettings>,
        transfer: Option<TransferSettings>,
        settings: RenderSettings,
        seed: u64,
    ) -> Self {
        let transfer = transfer.unwrap_or_default();
        let exact = camera.is_some() || transfer.extinction.is_some() || light.as_ref().is_some_and(|l| l.position.is_some());
        let scale = if exact { [1.0; 3] } else { overview_scale(domain) };
        let aspect = settings.width.max(1) as f64 / settings.height.max(1) as f64;
        // From above, over the shoulder. Maps are seen with north up, boxes with z up from the corner of low x and y.
        let direction = if domain.dimensions == 2 { [-1.0, -1.0, -1.0] } else { [0.7, 0.5, -1.0] };
        Self {
            camera: camera.unwrap_or_else(|| CameraSettings::overview(domain, scale, aspect)),
            light: light.unwrap_or_else(|| LightSettings::directional(direction, 12.0)),
            transfer,
            settings,
            seed,
            scale,
        }
    }

    /// Width over height of the picture.
    pub(super) fn aspect(&self) -> f64 {
        self.settings.width as f64 / self.settings.height as f64
    }

    /// Shortest edge of the box, in scene units.
    pub(super) fn shortest_edge(&self, domain: &Domain) -> f64 {
        let extent = domain.extent();
        (0..3).map(|k| extent[k] * self.scale[k]).fold(f64::INFINITY, f64::min)
    }

    /// Diagonal of the box, in scene units.
    pub(super) fn diagonal(&self, domain: &Domain) -> f64 {
        let extent = domain.extent();
        super::space::length(std::array::from_fn(|k| extent[k] * self.scale[k]))
    }

    /// Checks what camera, light and transfer function do not check themselves.
    pub(super) fn check(&self, domain: &Domain) -> Result<(), RenderError> {
        let settings = &self.settings;
        let size = "1 to 16384 pixels";
        require((1..=MAX_EDGE).contains(&settings.width), "render.width", settings.width, size)?;
        require((1..=MAX_EDGE).contains(&settings.height), "render.height", settings.height, size)?;
        let pixels = settings.width * settings.height;
        require(pixels <= MAX_PIXELS, "render.width", settings.width, "at most 67108864 pixels in all")?;
        require((1..=MAX_SAMPLES).contains(&settings.samples), "render.samples", settings.samples, "1 to 16777216")?;
        let colour = |c: [f64; 3]| c.iter().all(|v| v.is_finite() && *v >= 0.0);
        require(colour(settings.background), "render.background", settings.background, "three finite numbers, 0 or above")?;
        require(colour(settings.missing), "render.missing", settings.missing, "three finite numbers, 0 or above")?;
        let [contrast, brightness, gamma] = settings.tone_map;
        let tone_map = "[contrast, brightness, gamma]: finite numbers, gamma above 0";
        require(contrast.is_finite() && brightness.is_finite(), "render.tone_map", settings.tone_map, tone_map)?;
        require(gamma.is_finite() && gamma > 0.0, "render.tone_map", settings.tone_map, tone_map)?;
        if let Some(cells) = settings.majorant_cells {
            require(cells.iter().all(|n| (1..=MAX_CELLS).contains(n)), "render.majorant_cells", cells, "1 to 1024 cells along each axis")?;
            require(cells.iter().product::<usize>() <= 1 << 24, "render.majorant_cells", cells, "at most 16777216 cells in all")?;
        }
        let finite = domain.min.iter().chain(&domain.max).all(|v| v.is_finite());
        require(finite && domain.extent().iter().all(|e| *e > 0.0), "domain", (domain.min, domain.max), "finite corners, max above min")?;
        require(self.scale.iter().all(|s| s.is_finite() && *s > 0.0), "scene scale", self.scale, "three finite numbers above 0")
    }
}
