//! A scene: camera, light, transfer function and picture settings.

use super::error::{RenderError, require};
use super::{CameraSettings, LightSettings, MapPlane, Method, RenderSettings, TransferSettings, overview_scale};
use ridgewatch_field::Domain;

/// A scene to render. Camera, light and extinction are in scene units: domain coordinates times `scale`.
#[derive(Debug, Clone, PartialEq)]
pub struct Scene {
    /// View.
    pub camera: CameraSettings,
    /// Light.
    pub light: LightSettings,
    /// Transfer function; `low` and `high` must be set ([`TransferSettings::scaled_to`]).
    pub transfer: TransferSettings,
    /// Size of the picture and other settings.
    pub settings: RenderSettings,
    /// Seed of all random numbers.
    pub seed: u64,
    /// Scene units per domain unit, along each axis.
    pub scale: [f64; 3],
    /// The plane of maps of longitudes and latitudes, which they show instead of the box. `None`: plain coordinates.
    pub plane: Option<MapPlane>,
}

impl Scene {
    /// Makes a scene from the tables of a scene file, with defaults for missing ones. If a camera, the position of a light or an extinction is
    /// given, the scale is 1 and their lengths are in domain coordinates; otherwise it is [`overview_scale`].
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
        // One that is refused is told by `check`.
        let plane = MapPlane::new(domain, &settings, camera.as_ref(), scale).unwrap_or(None);
        let aspect = settings.width.max(1) as f64 / settings.height.max(1) as f64;
        // The light shines from above and behind the camera. Maps are seen with north up, boxes with z up from the corner of low x and y.
        let direction = if domain.dimensions == 2 { [-1.0, -1.0, -1.0] } else { [0.7, 0.5, -1.0] };
        let overview = || match plane.filter(|_| settings.method == Method::Map) {
            Some(plane) => CameraSettings::above(plane.bounds(domain), domain.max[2] * scale[2], aspect),
            None => CameraSettings::overview(domain, scale, aspect),
        };
        Self {
            camera: camera.unwrap_or_else(overview),
            light: light.unwrap_or_else(|| LightSettings::directional(direction, 12.0)),
            transfer,
            settings,
            seed,
            scale,
            plane,
        }
    }

    /// Edges of the box, in scene units.
    pub fn edges(&self, domain: &Domain) -> [f64; 3] {
        let extent = domain.extent();
        std::array::from_fn(|k| extent[k] * self.scale[k])
    }

    /// Checks everything that camera, light and transfer function do not check themselves.
    pub(super) fn check(&self, domain: &Domain) -> Result<(), RenderError> {
        self.settings.check()?;
        if self.plane.is_none() {
            MapPlane::new(domain, &self.settings, None, self.scale)?;
        }
        let finite = domain.min.iter().chain(&domain.max).all(|v| v.is_finite());
        require(finite && domain.extent().iter().all(|e| *e > 0.0), "domain", (domain.min, domain.max), "finite corners, max above min")?;
        require(self.scale.iter().all(|s| s.is_finite() && *s > 0.0), "scene scale", self.scale, "three finite numbers above 0")
    }
}
