//! The colours of a picture by FTLE, for a colour bar beside it.

use super::Settings;
use super::record::{DomainRecord, FrameRecord};
use super::setup::assemble;
use crate::field::Domain;
use crate::render::{Film, Method, ProjectionChoice, Renderer, Scene, TransferSettings, map_radiance};
use serde::{Deserialize, Serialize};

/// Colours of a bar.
const COLORS: usize = 32;

/// Colours in the middle of the box if the whole box has one FTLE, in 8 bits, tone-mapped as the picture is. Where the FTLE varies, shadow and depth
/// change them.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ColorBar {
    /// R, G, B at FTLE values evenly spaced from `low` to `high`.
    pub colors: Vec<[u8; 3]>,
    /// FTLE at which extinction begins; below it nothing is seen.
    pub low: f64,
    /// FTLE from which extinction is full.
    pub high: f64,
    /// Unit of the FTLE, such as `1/s`; empty if the source's times have none.
    pub unit: String,
}

impl ColorBar {
    /// Colours between two values of the FTLE. `time_unit` may be empty.
    pub fn new(renderer: &Renderer, method: Method, [low, high]: [f64; 2], time_unit: &str) -> Self {
        let at = |i: usize| low + (high - low) * i as f64 / (COLORS - 1) as f64;
        let color = |i| {
            let [r, g, b] = match method {
                Method::Map => map_radiance(i as f64 / (COLORS - 1) as f64),
                _ => renderer.uniform_color(at(i) as f32),
            };
            [r, g, b, 1.0]
        };
        let film = Film { width: COLORS, height: 1, rgba: (0..COLORS).map(color).collect(), ..Film::default() };
        let colors = film.tone_mapped(renderer.scene().settings.tone_map_of(method)).as_chunks().0.to_vec();
        let unit = if time_unit.is_empty() { String::new() } else { format!("1/{time_unit}") };
        Self { colors, low, high, unit }
    }

    /// Colours of a frame by its record and the scene of its run.
    ///
    /// # Errors
    /// What the record lacks, since an earlier version wrote it, or why it does not fit the scene.
    pub fn of(settings: &Settings, record: &FrameRecord) -> Result<Self, String> {
        let FrameRecord { camera: Some(camera), domain: Some(DomainRecord { min, max, axes }), transfer, .. } = record else {
            return Err("lacks `camera` or `domain`, which earlier versions did not write".into());
        };
        let domain = Domain { dimensions: axes.len(), ..Domain::cuboid(*min, *max) };
        let mut scene = Scene { camera: camera.clone(), scale: record.scale, ..assemble(settings, &domain) };
        [scene.settings.width, scene.settings.height] = record.size;
        // Colours have none, and a record does not say whether its axes are those of a globe.
        scene.settings.projection = ProjectionChoice::Auto;
        let (low, high, extinction) = (Some(transfer.low), Some(transfer.high), Some(transfer.extinction));
        let albedo = record.albedo.clone().unwrap_or(scene.transfer.albedo);
        scene.transfer = TransferSettings { low, high, extinction, albedo };
        let renderer = Renderer::new(scene, &domain, record.tau).map_err(|error| format!("does not fit the scene: {error}"))?;
        let method = if record.method == Method::Map.name() { Method::Map } else { Method::Reference };
        Ok(Self::new(&renderer, method, [transfer.low, transfer.high], &record.time_unit))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::field::Domain;
    use crate::render::{CameraSettings, LightSettings, RenderSettings, Scene, TransferSettings};

    #[test]
    fn a_box_of_one_ftle_has_its_color_in_closed_form() {
        // Light from the camera, of radiance 4 pi, on a cube: albedo (1 - exp(-2 depth)) / 2 of the light, and exp(-depth) of the background.
        let albedo = [vec![1.0, -1.0], vec![0.0, 1.0], vec![0.5]];
        let transfer = TransferSettings { low: Some(2.0), high: Some(6.0), extinction: Some(3.0), albedo };
        let camera = CameraSettings {
            eye: [0.5, 0.5, 4.0],
            look_at: [0.5, 0.5, 0.5],
            up: [0.0, 1.0, 0.0],
            field_of_view: 40.0,
            orthographic: false,
        };
        let light = LightSettings::directional([0.0, 0.0, -1.0], 4.0 * std::f64::consts::PI);
        let domain = Domain::cuboid([0.0; 3], [1.0; 3]);
        let settings = RenderSettings { tone_map: [1.0, 0.5, 1.0], background: [0.25; 3], ..RenderSettings::default() };
        let scene = Scene::assemble(&domain, Some(camera), Some(light), Some(transfer), settings, 0);
        let bar = ColorBar::new(&Renderer::new(scene, &domain, 1.0).unwrap(), Method::Reference, [2.0, 6.0], "s");
        for (i, found) in bar.colors.iter().enumerate() {
            let ramp = i as f64 / (COLORS - 1) as f64;
            let depth = 3.0 * ramp;
            // The albedo is a polynomial of 1 - ramp.
            for (channel, albedo) in [ramp, 1.0 - ramp, 0.5].into_iter().enumerate() {
                let wanted = albedo * (1.0 - (-2.0 * depth).exp()) / 2.0 + 0.25 * (-depth).exp();
                assert!((f64::from(found[channel]) - 255.0 * wanted).abs() <= 1.0, "{i}, {channel}: {found:?}, not {wanted}");
            }
        }
        assert_eq!((bar.colors.len(), bar.low, bar.high, bar.unit.as_str()), (COLORS, 2.0, 6.0, "1/s"));
    }
}
