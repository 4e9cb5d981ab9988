//! The camera: rays through points of the film (pinhole or parallel projection).

use super::CameraSettings;
use super::error::{RenderError, require, require_finite};
use super::space::{cross, dot, length, scaled, subtract};
use ridgewatch_field::Domain;

/// A checked camera, in scene units, in the layout that kernels read.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Camera {
    eye: [f64; 3],
    /// W = look_at - eye.
    forward: [f64; 3],
    /// Half of the film's width, to the right.
    right: [f64; 3],
    /// Half of the film's height, upward.
    up: [f64; 3],
    /// 1 for parallel projection, otherwise 0.
    orthographic: i32,
    pad: i32,
}

impl CameraSettings {
    /// Default camera for a domain scaled by `scale` and a picture of aspect ratio `aspect` (width / height). Two-dimensional flows are seen
    /// from above in parallel projection and fill the picture; three-dimensional ones are seen from above a corner.
    pub fn overview(domain: &Domain, scale: [f64; 3], aspect: f64) -> Self {
        let extent: [f64; 3] = std::array::from_fn(|k| domain.extent()[k] * scale[k]);
        let centre: [f64; 3] = std::array::from_fn(|k| 0.5 * (domain.min[k] + domain.max[k]) * scale[k]);
        if domain.dimensions == 2 {
            let [low, high] = [domain.min, domain.max].map(|end| [end[0] * scale[0], end[1] * scale[1]]);
            return Self::above([low, high], domain.max[2] * scale[2], aspect);
        }
        // The published camera divides the angle by the aspect ratio, so that tall pictures need a small angle.
        let field_of_view = 45.0 * aspect.min(1.0);
        let toward_eye = [-0.46, -0.72, 0.52];
        let toward_eye = scaled(toward_eye, 1.0 / length(toward_eye));
        let right = cross(scaled(toward_eye, -1.0), [0.0, 0.0, 1.0]);
        let right = scaled(right, 1.0 / length(right));
        let up = cross(toward_eye, right);
        let half = field_of_view.to_radians() / 2.0;
        let (across, down) = (half.tan(), (half / aspect).tan());
        // The distance at which every corner is inside the film.
        let mut distance = 0.0_f64;
        for corner in 0..8 {
            let offset: [f64; 3] = std::array::from_fn(|k| if corner >> k & 1 == 1 { 0.5 * extent[k] } else { -0.5 * extent[k] });
            let needed = (dot(offset, right).abs() / across).max(dot(offset, up).abs() / down);
            distance = distance.max(dot(offset, toward_eye) + needed);
        }
        let eye = std::array::from_fn(|k| centre[k] + 1.1 * distance * toward_eye[k]);
        Self { eye, look_at: centre, up: [0.0, 0.0, 1.0], field_of_view, orthographic: false }
    }
}

impl CameraSettings {
    /// The camera that sees a rectangle from above, `top` being the height of what it looks at: the rectangle fills a picture of aspect ratio `aspect`.
    pub fn above([low, high]: [[f64; 2]; 2], top: f64, aspect: f64) -> Self {
        let [x, y] = [0, 1].map(|k| 0.5 * (low[k] + high[k]));
        // At 90 degrees the distance to the film plane is half of its width.
        let distance = 0.5 * (high[0] - low[0]).max((high[1] - low[1]) * aspect);
        Self { eye: [x, y, top + distance], look_at: [x, y, top], up: [0.0, 1.0, 0.0], field_of_view: 90.0, orthographic: true }
    }
}

impl Camera {
    /// Checks the settings for a picture of aspect ratio `aspect` (width / height).
    ///
    /// # Errors
    /// The first key at fault and the values that it accepts.
    pub fn new(settings: &CameraSettings, aspect: f64) -> Result<Self, RenderError> {
        require_finite("camera.eye", &settings.eye)?;
        require_finite("camera.look_at", &settings.look_at)?;
        require_finite("camera.up", &settings.up)?;
        let forward = subtract(settings.look_at, settings.eye);
        let distance = length(forward);
        require(distance > 0.0, "camera.look_at", settings.look_at, "a point other than camera.eye")?;
        let right = cross(forward, settings.up);
        let norm = length(right);
        let parallel = norm <= 1e-9 * distance * length(settings.up);
        require(!parallel && norm > 0.0, "camera.up", settings.up, "a vector that is not parallel to the view")?;
        let fov = settings.field_of_view;
        require(fov > 0.0 && fov < 180.0, "camera.field_of_view", fov, "degrees above 0 and below 180")?;
        let half = fov.to_radians() / 2.0;
        let half_width = distance * half.tan();
        let half_height = if settings.orthographic {
            half_width / aspect
        } else {
            // The published camera divides the angle, not the width, by the aspect ratio.
            require(
                half / aspect < std::f64::consts::FRAC_PI_2,
                "camera.field_of_view",
                fov,
                "less than 180 degrees times width / height",
            )?;
            distance * (half / aspect).tan()
        };
        let right = scaled(right, 1.0 / norm);
        let up = cross(right, scaled(forward, 1.0 / distance));
        Ok(Self {
            eye: settings.eye,
            forward,
            right: scaled(right, half_width),
            up: scaled(up, half_height),
            orthographic: i32::from(settings.orthographic),
            pad: 0,
        })
    }

    /// Origin and unit direction of the ray through a point of the film: `x` from -1 (left) to 1, `y` from -1 (bottom) to 1.
    pub fn ray(&self, x: f64, y: f64) -> ([f64; 3], [f64; 3]) {
        let offset: [f64; 3] = std::array::from_fn(|k| x * self.right[k] + y * self.up[k]);
        let unit = |v: [f64; 3]| scaled(v, 1.0 / length(v));
        if self.orthographic != 0 {
            (std::array::from_fn(|k| self.eye[k] + offset[k]), unit(self.forward))
        } else {
            (self.eye, unit(std::array::from_fn(|k| self.forward[k] + offset[k])))
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn published() -> CameraSettings {
        CameraSettings { eye: [1.0, 0.5, 2.3], look_at: [1.0, 0.5, 0.5], up: [0.0, 1.0, 0.0], field_of_view: 90.0, orthographic: false }
    }

    #[test]
    fn the_published_film_plane() {
        let camera = Camera::new(&published(), 2.0).unwrap();
        let (origin, direction) = camera.ray(1.0, 1.0);
        assert_eq!(origin, [1.0, 0.5, 2.3]);
        // |W| = 1.8, half-width 1.8 tan 45 deg, half-height 1.8 tan 22.5 deg; x is right, y is up. f64 rounding.
        let (x, y) = (direction[0] / -direction[2], direction[1] / -direction[2]);
        assert!((x - 1.0).abs() < 1e-12 && (y - 22.5_f64.to_radians().tan()).abs() < 1e-12);
        assert!((length(direction) - 1.0).abs() < 1e-12);
    }

    #[test]
    fn parallel_projection_shifts_the_origin() {
        let camera = Camera::new(&CameraSettings { orthographic: true, ..published() }, 2.0).unwrap();
        let (origin, direction) = camera.ray(1.0, -1.0);
        assert_eq!(direction, [0.0, 0.0, -1.0]);
        // Half-width 1.8, half-height 0.9; f64 rounding.
        assert!((origin[0] - 2.8).abs() < 1e-12 && (origin[1] + 0.4).abs() < 1e-12);
    }

    #[test]
    fn overviews_hold_the_whole_box() {
        let slab = Domain::slab([-10.0, 30.0], [20.0, 40.0], (0.0, 1.0));
        let camera = Camera::new(&CameraSettings::overview(&slab, [1.0; 3], 2.0), 2.0).unwrap();
        // The width decides: 30 wide at aspect 2 is 15 high, over 10. f64 rounding.
        let (corner, _) = camera.ray(-1.0, -1.0);
        assert!((corner[0] + 10.0).abs() < 1e-9 && (corner[1] - 27.5).abs() < 1e-9);

        let cube = Domain::cuboid([1.0, 2.0, 3.0], [3.0, 3.0, 3.5]);
        let settings = CameraSettings::overview(&cube, [1.0; 3], 2.0);
        let half = settings.field_of_view.to_radians() / 2.0;
        let forward = subtract(settings.look_at, settings.eye);
        let right = cross(forward, settings.up);
        let up = cross(right, forward);
        for corner in 0..8 {
            let point = std::array::from_fn(|k| if corner >> k & 1 == 1 { cube.max[k] } else { cube.min[k] });
            let seen = subtract(point, settings.eye);
            let depth = dot(seen, forward) / length(forward);
            assert!(dot(seen, right).abs() / length(right) < depth * half.tan());
            assert!(dot(seen, up).abs() / length(up) < depth * (half / 2.0).tan());
        }
    }

    #[test]
    fn faults_name_the_key() {
        let fault = |edit: fn(&mut CameraSettings)| {
            let mut settings = published();
            edit(&mut settings);
            Camera::new(&settings, 2.0).unwrap_err().to_string()
        };
        assert_eq!(fault(|c| c.look_at = c.eye), "`camera.look_at` is [1.0, 0.5, 2.3]; accepted: a point other than camera.eye");
        assert!(fault(|c| c.up = [0.0, 0.0, 3.0]).starts_with("`camera.up` is [0.0, 0.0, 3.0]"));
        assert!(fault(|c| c.up = [0.0; 3]).starts_with("`camera.up`"));
        assert!(fault(|c| c.eye[1] = f64::NAN).starts_with("`camera.eye`"));
        assert!(fault(|c| c.field_of_view = 180.0).starts_with("`camera.field_of_view` is 180"));
        assert!(
            Camera::new(&published(), 0.4).unwrap_err().to_string().contains("width / height"),
            "tall pictures overflow the published angle"
        );
    }
}
