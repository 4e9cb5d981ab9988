//! Monte Carlo volume rendering: camera, light, transfer function, majorant grid, tracking, film.
//!
//! In: a scene and something that answers log-stretch queries in batches. Out: a linear HDR film. Does not know who answers.

use serde::{Deserialize, Serialize};

/// Answers log-stretch queries. The renderer hands over the collision points of one wavefront step at a time.
pub trait LogStretch {
    /// Writes the log-stretch at each point (domain coordinates) into `log_stretch` and whether it was traced by RK4 (true) or
    /// predicted (false) into `traced`; all three have the same length.
    fn evaluate(&mut self, points: &[[f32; 3]], log_stretch: &mut [f32], traced: &mut [bool]);
}

/// Which answers a picture is made of.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Method {
    /// RK4 only.
    Reference,
    /// The surrogate only.
    #[serde(alias = "neural")]
    Surrogate,
    /// The surrogate where it is trusted, RK4 elsewhere.
    Gated,
}

/// `[camera]` of a scene file. `half_width = |look_at - eye| tan(field_of_view/2)`, `half_height = |look_at - eye| tan(field_of_view/(2 aspect))`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CameraSettings {
    /// Position.
    pub eye: [f64; 3],
    /// Point looked at.
    pub look_at: [f64; 3],
    /// Up.
    pub up: [f64; 3],
    /// Horizontal field of view, degrees.
    #[serde(default = "ninety")]
    pub field_of_view: f64,
    /// Parallel projection, whose film plane is `half_width` by `half_width / aspect` as above: a map without perspective.
    #[serde(default)]
    pub orthographic: bool,
}

fn ninety() -> f64 {
    90.0
}

/// `[light]` of a scene file.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LightSettings {
    /// Direction in which photons fly (directional light); exactly one of `direction` and `position` is given.
    pub direction: Option<[f64; 3]>,
    /// Position of a point light.
    pub position: Option<[f64; 3]>,
    /// Radiance (directional) or radiant intensity (point).
    pub radiance: [f64; 3],
}

/// `[transfer]` of a scene file: extinction = `extinction` * ramp(FTLE), ramp = saturate((FTLE - low) / (high - low)); albedo per
/// channel is a polynomial in t = 1 - ramp, lowest power first.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TransferSettings {
    /// FTLE at which extinction begins; None: median of the first frame's FTLE.
    pub low: Option<f64>,
    /// FTLE at which it saturates; None: 99.5th percentile of the first frame's FTLE.
    pub high: Option<f64>,
    /// Largest extinction, per unit of length; None: 50 over the domain's shortest visible edge.
    pub extinction: Option<f64>,
    /// Polynomial coefficients of the red, green and blue albedo, lowest power first.
    pub albedo: [Vec<f64>; 3],
}

/// `[render]` of a scene file.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct RenderSettings {
    /// Method.
    pub method: Method,
    /// Pixels across.
    pub width: usize,
    /// Pixels down.
    pub height: usize,
    /// Samples a pixel and frame.
    pub samples: usize,
    /// Background colour, linear.
    pub background: [f64; 3],
    /// Majorant cells along x, y, z; None: chosen from the domain.
    pub majorant_cells: Option<[usize; 3]>,
    /// Tone map: `((c - 0.5) * contrast + brightness)^(1/gamma)`: `[contrast, brightness, gamma]`.
    pub tone_map: [f64; 3],
}

impl Default for RenderSettings {
    fn default() -> Self {
        Self {
            method: Method::Gated,
            width: 320,
            height: 160,
            samples: 16,
            background: [1.0; 3],
            majorant_cells: None,
            tone_map: [1.85, 0.75, 1.4],
        }
    }
}

/// A finished picture: one entry a pixel, rows from the top, left to right.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Film {
    /// Pixels across.
    pub width: usize,
    /// Pixels down.
    pub height: usize,
    /// Mean linear radiance (R, G, B) and alpha (share of paths that scattered).
    pub rgba: Vec<[f32; 4]>,
    /// Mean FTLE at the real collisions seen through the pixel (NaN where there was none).
    pub ftle_mean: Vec<f32>,
    /// Share of the pixel's queries that RK4 answered.
    pub traced: Vec<f32>,
    /// Variance of the mean luminance.
    pub variance: Vec<f32>,
    /// Samples in the pixel.
    pub samples: Vec<f32>,
}

impl Film {
    /// Tone-mapped 8-bit RGB with `((c - 0.5) * contrast + brightness)^(1/gamma)`.
    pub fn tone_mapped(&self, [contrast, brightness, gamma]: [f64; 3]) -> Vec<u8> {
        let map = |c: f32| {
            let value = ((f64::from(c) - 0.5) * contrast + brightness).clamp(0.0, 1.0).powf(1.0 / gamma);
            (value * 255.0 + 0.5) as u8
        };
        self.rgba.iter().flat_map(|p| [map(p[0]), map(p[1]), map(p[2])]).collect()
    }
}
