//! The plane in which a map of longitudes and latitudes is drawn: a sheet through the scene, which the camera sees instead of the box.
//!
//! At the middle of the domain, or the place that the scene's camera looks at, the sheet has the place and the scale of the box: what is there, and a
//! degree of latitude, have the same scene coordinates and length. Elsewhere they differ by the projection.

use super::error::RenderError;
use super::projection::{Projection, ProjectionKind, Unprojectable};
use super::{CameraSettings, RenderSettings};
use ridgewatch_base::setting::shown;
use ridgewatch_field::Domain;
use serde::{Deserialize, Serialize};

/// A projection and where its plane lies in the scene: x and y are `origin` + `unit` times those of the plane.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct MapPlane {
    /// The projection.
    #[serde(flatten)]
    pub projection: Projection,
    /// Scene units per unit of the plane, the radius of the sphere.
    pub unit: f64,
    /// The plane's origin, in scene units.
    pub origin: [f64; 2],
}

/// West, south, east and north end of a domain.
fn region(domain: &Domain) -> [f64; 4] {
    [domain.min[0], domain.min[1], domain.max[0], domain.max[1]]
}

impl MapPlane {
    /// The plane of a domain scaled by `scale`, about the middle or, if the scene sets a camera, about the place that it looks at. `None` for plain
    /// coordinates, and for flows in three dimensions.
    ///
    /// # Errors
    /// `render.projection` is not one of the domain's.
    pub fn new(
        domain: &Domain,
        settings: &RenderSettings,
        camera: Option<&CameraSettings>,
        scale: [f64; 3],
    ) -> Result<Option<Self>, RenderError> {
        if domain.dimensions != 2 {
            return Ok(None);
        }
        let refused = |why: &str, accepted| {
            let found = format!("{} ({why})", shown(settings.projection));
            RenderError::Invalid { key: "render.projection", found, accepted }
        };
        let kind = match settings.projection.kind() {
            Some(ProjectionKind::Plain) => return Ok(None),
            Some(_) if !domain.is_geographic => return Err(refused("the coordinates are not longitudes and latitudes", "auto, plain")),
            // The camera is in degrees.
            None if !domain.is_geographic || camera.is_some() => return Ok(None),
            Some(kind) => kind,
            None => ProjectionKind::fitting(region(domain)),
        };
        let projection = Projection::new(kind, region(domain)).map_err(|Unprojectable { why, accepted }| refused(&why, accepted))?;
        let seen = camera.and_then(|camera| looked_at(camera, domain, scale));
        let about: [f64; 2] = std::array::from_fn(|k| {
            let [low, high] = [domain.min[k], domain.max[k]];
            seen.map_or(0.5 * (low + high), |place| place[k].clamp(low, high))
        });
        // Plane per degree of latitude, there.
        const STEP: f64 = 1e-4;
        // Nothing is beyond a pole.
        let beside = about[1].min(domain.max[1] - 0.5 * STEP).max(domain.min[1] + 0.5 * STEP);
        let [from, to] = [-0.5, 0.5].map(|share| projection.forward([about[0], beside + share * STEP]));
        let unit = scale[1] * STEP / (to[0] - from[0]).hypot(to[1] - from[1]);
        let middle = projection.forward(about);
        Ok(Some(Self { projection, unit, origin: [0, 1].map(|k| about[k] * scale[k] - unit * middle[k]) }))
    }

    /// Longitude and latitude at a place of the scene that shows the domain; `None` outside.
    pub fn place_in(&self, domain: &Domain, scene: [f64; 2]) -> Option<[f64; 2]> {
        self.projection.place_in(region(domain), self.plane(scene))
    }

    /// Coordinates in the plane of a place of the scene.
    pub fn plane(&self, scene: [f64; 2]) -> [f64; 2] {
        [0, 1].map(|k| (scene[k] - self.origin[k]) / self.unit)
    }

    /// Lower and upper ends of the domain in the scene.
    pub fn bounds(&self, domain: &Domain) -> [[f64; 2]; 2] {
        self.projection.bounds(region(domain)).map(|end| [0, 1].map(|k| self.origin[k] + self.unit * end[k]))
    }
}

/// Where the axis of a camera meets the middle of the domain, in coordinates of the domain.
fn looked_at(camera: &CameraSettings, domain: &Domain, scale: [f64; 3]) -> Option<[f64; 2]> {
    let middle = 0.5 * (domain.min[2] + domain.max[2]) * scale[2];
    let along = (middle - camera.eye[2]) / (camera.look_at[2] - camera.eye[2]);
    let place = [0, 1].map(|k| (camera.eye[k] + along * (camera.look_at[k] - camera.eye[k])) / scale[k]);
    (along >= 0.0 && place.iter().all(|x| x.is_finite())).then_some(place)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Method, ProjectionChoice, Scene};

    fn globe(min: [f64; 2], max: [f64; 2]) -> Domain {
        Domain { is_geographic: true, ..Domain::slab(min, max, (0.0, 1.0)) }
    }

    fn settings(projection: ProjectionChoice) -> RenderSettings {
        RenderSettings { width: 300, height: 200, method: Method::Map, projection, ..RenderSettings::default() }
    }

    #[test]
    fn the_sheet_has_place_and_scale_of_the_box_at_the_middle() {
        for (domain, kind) in [
            (globe([-25.0, 30.0], [45.0, 72.0]), ProjectionKind::Lambert),
            (globe([100.0, -60.0], [180.0, -20.0]), ProjectionKind::Lambert),
            (globe([0.0, 60.0], [360.0, 90.0]), ProjectionKind::Polar),
            (globe([-180.0, -90.0], [180.0, -50.0]), ProjectionKind::Polar),
            (globe([-60.0, -40.0], [60.0, 60.0]), ProjectionKind::Mercator),
            (globe([14.0, -40.0], [34.0, -30.0]), ProjectionKind::PlateCarree),
        ] {
            for scale in [[1.0; 3], [0.02, 0.02, 0.25]] {
                let plane = MapPlane::new(&domain, &settings(ProjectionChoice::Auto), None, scale).unwrap().unwrap();
                assert_eq!(plane.projection.kind(), kind);
                let middle = [0, 1].map(|k| 0.5 * (domain.min[k] + domain.max[k]));
                let at = |degrees: [f64; 2]| {
                    let plane_at = plane.projection.forward(degrees);
                    [0, 1].map(|k| plane.origin[k] + plane.unit * plane_at[k])
                };
                let small = 1e-3;
                let [x, y] = at(middle);
                let [_, above] = at([middle[0], middle[1] + small]);
                assert!((x - middle[0] * scale[0]).abs() < 1e-9 && (y - middle[1] * scale[1]).abs() < 1e-9, "{kind:?}: {x} {y}");
                assert!(((above - y) / (small * scale[1]) - 1.0).abs() < 1e-4, "{kind:?}: {above} {y}");
                let back = plane.place_in(&domain, [x, y]).unwrap();
                assert!((0..2).all(|k| (back[k] - middle[k]).abs() < 1e-9), "{kind:?}: {back:?}");
            }
        }
    }

    #[test]
    fn the_first_view_holds_all_of_the_domain() {
        let domain = globe([0.0, 60.0], [360.0, 90.0]);
        let scene = Scene::assemble(&domain, None, None, None, settings(ProjectionChoice::Auto), 0);
        let plane = scene.plane.unwrap();
        let [low, high] = plane.bounds(&domain);
        // A disc about the pole, whose rim is the parallel of 60 degrees.
        let rim = plane.unit * 2.0 * 15_f64.to_radians().tan();
        assert!((high[0] - low[0] - 2.0 * rim).abs() < 1e-3 * rim && (high[1] - low[1] - 2.0 * rim).abs() < 1e-3 * rim);
        // The height decides: 300 x 200 pixels.
        let distance = scene.camera.eye[2] - scene.camera.look_at[2];
        assert!((distance / 1.5 - rim).abs() < 1e-3 * rim, "{distance} {rim}");
        assert!((0..2).all(|k| (scene.camera.look_at[k] - plane.origin[k]).abs() < 1e-3 * rim), "the pole is the middle");
    }

    #[test]
    fn a_camera_in_degrees_keeps_its_target_and_plain_is_its_default() {
        let domain = globe([-25.0, 30.0], [45.0, 72.0]);
        let camera = CameraSettings {
            eye: [-10.0, 60.0, 6.0],
            look_at: [-10.0, 60.0, 1.0],
            up: [0.0, 1.0, 0.0],
            field_of_view: 90.0,
            orthographic: true,
        };
        let of = |choice| Scene::assemble(&domain, Some(camera.clone()), None, None, settings(choice), 0).plane;
        assert_eq!(of(ProjectionChoice::Auto), None);
        let plane = of(ProjectionChoice::Lambert).unwrap();
        let seen = plane.place_in(&domain, [-10.0, 60.0]).unwrap();
        assert!((seen[0] + 10.0).abs() < 1e-9 && (seen[1] - 60.0).abs() < 1e-9, "{seen:?}");
        // At a pole, beyond which there is nothing.
        let to_the_pole = globe([-25.0, 30.0], [45.0, 90.0]);
        let camera = CameraSettings { eye: [0.0, 95.0, 6.0], look_at: [0.0, 95.0, 1.0], ..camera.clone() };
        let plane = MapPlane::new(&to_the_pole, &settings(ProjectionChoice::Lambert), Some(&camera), [1.0; 3]).unwrap().unwrap();
        assert!(plane.unit > 0.0 && plane.unit.is_finite() && plane.origin.iter().all(|x| x.is_finite()), "{plane:?}");
    }

    #[test]
    fn what_cannot_be_projected_is_refused_with_the_key() {
        let fault = |domain: &Domain, choice| MapPlane::new(domain, &settings(choice), None, [1.0; 3]).unwrap_err().to_string();
        let flat = Domain::slab([0.0; 2], [2.0, 1.0], (0.0, 1.0));
        assert_eq!(
            fault(&flat, ProjectionChoice::PlateCarree),
            "`render.projection` is \"plate_carree\" (the coordinates are not longitudes and latitudes); accepted: auto, plain"
        );
        assert_eq!(
            fault(&globe([0.0, -10.0], [20.0, 89.0]), ProjectionChoice::Lambert),
            "`render.projection` is \"lambert\" (lambert shows one side of the equator and at most 180 degrees of longitude); accepted: \
             plate_carree, mercator"
        );
        for choice in [ProjectionChoice::Auto, ProjectionChoice::Plain] {
            assert_eq!(MapPlane::new(&flat, &settings(choice), None, [1.0; 3]), Ok(None));
        }
        let cube = Domain { is_geographic: true, ..Domain::cuboid([0.0; 3], [1.0; 3]) };
        assert_eq!(MapPlane::new(&cube, &settings(ProjectionChoice::Lambert), None, [1.0; 3]), Ok(None), "a volume has no projection");
    }
}
