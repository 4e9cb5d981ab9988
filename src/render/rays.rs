//! How far the pictures of two fields are apart, from a few rays: neither is drawn.

use super::map_picture::footprint;
use super::smooth::{LIT, ToneMap, weighted};
use super::tracking::PHASE;
use super::{Light, Renderer};
use ridgewatch_field::DomainPoint;

/// Fewest lit rays that tell how far two pictures are apart.
const FEWEST_LIT: usize = 16;

/// Points on rays through a picture: on each ray two nets, the one in the middle between the points of the other.
#[derive(Debug, Clone)]
pub struct RayPoints {
    /// Points of the nets, from front to back, one net after the other.
    pub points: Vec<DomainPoint>,
    per_net: usize,
    /// Distance between the points of each net, in scene units.
    spacing: Vec<f32>,
    /// Light that comes to each point if nothing is in its way.
    light: Vec<[f32; 3]>,
}

impl Renderer {
    /// Nets of `per_net` points on those of `rays` rays, spread evenly over the picture, that meet the box. The same for every seed.
    pub fn ray_points(&self, rays: usize, per_net: usize) -> RayPoints {
        const GOLDEN: f64 = 0.618_033_988_749_894_8;
        let scene = self.frame_scene(0);
        let mut found = RayPoints { points: Vec::new(), per_net, spacing: Vec::new(), light: Vec::new() };
        for (number, [u, v]) in footprint(0, 0, 0, 0..rays).enumerate() {
            let (eye, toward) = scene.camera.ray(2.0 * u - 1.0, 1.0 - 2.0 * v);
            let Some((enter, leave)) = scene.space.intersect(eye, toward) else { continue };
            let spacing = (leave - enter) / per_net as f64;
            for net in [0.0, 0.5] {
                let shift = (number as f64 * GOLDEN + net).fract();
                for i in 0..per_net {
                    let along = enter + (i as f64 + shift) * spacing;
                    let point: [f64; 3] = std::array::from_fn(|k| eye[k] + along * toward[k]);
                    found.points.push(scene.space.domain_point(scene.space.grid_point(point)));
                    found.light.push(match scene.light {
                        Light::Directional { radiance, .. } => *radiance,
                        Light::Point { .. } => scene.light.seen_from(point).2,
                    });
                }
                found.spacing.push(spacing as f32);
            }
        }
        found
    }

    /// Mean square difference over lit rays between pictures of two fields, given by their log-stretch at the points of `rays`, with its standard error added:
    /// few rays hold most of it. In the weightings of [`super::smooth::TileErrors`]; the second field is the true one. NaN is empty space.
    ///
    /// The product of what both nets of a ray differ by leaves out differences that change between their points, which average out along the ray. Nothing
    /// casts a shadow, so that where the light is dim the true difference is smaller. `None` if hardly a ray is lit.
    pub fn pictures_apart(&self, rays: &RayPoints, shown: &[f32], truth: &[f32]) -> Option<[f64; 3]> {
        let tone_map = ToneMap::new(self.scene().settings.tone_map);
        let of_net = |net: usize| {
            let points = net * rays.per_net..(net + 1) * rays.per_net;
            let [(shown, _), (truth, opacity)] =
                [shown, truth].map(|field| self.seen(&field[points.clone()], rays.spacing[net], &rays.light[points.clone()]));
            (shown, truth, opacity)
        };
        let of_ray = |ray: usize| {
            let [one, other] = [2 * ray, 2 * ray + 1].map(of_net);
            let apart = |(shown, truth, _): ([f64; 3], [f64; 3], f32)| std::array::from_fn(|k| shown[k] - truth[k]);
            let mean = |a: [f64; 3], b: [f64; 3]| std::array::from_fn(|k| 0.5 * (a[k] + b[k]));
            let is_lit = one.2 + other.2 > 2.0 * LIT;
            is_lit.then(|| weighted(apart(one), apart(other), tone_map, mean(one.0, other.0), mean(one.1, other.1)))
        };
        let squares: Vec<[f64; 3]> = (0..rays.spacing.len() / 2).filter_map(of_ray).collect();
        let count = squares.len() as f64;
        (squares.len() >= FEWEST_LIT).then(|| {
            std::array::from_fn(|weighting| {
                let of = || squares.iter().map(|square| square[weighting]);
                let mean = of().sum::<f64>() / count;
                mean.max(0.0) + (of().map(|square| (square - mean).powi(2)).sum::<f64>() / count / count).sqrt()
            })
        })
    }

    /// Radiance and opacity of a ray (emission and absorption, Max 1995), without shadows.
    fn seen(&self, log_stretch: &[f32], spacing: f32, light: &[[f32; 3]]) -> ([f64; 3], f32) {
        let (mut radiance, mut transmittance) = ([0.0; 3], 1.0_f32);
        for (s, light) in log_stretch.iter().zip(light).filter(|(s, _)| s.is_finite()) {
            let ftle = s * self.inverse_tau() as f32;
            let passed = (-self.transfer().extinction(ftle) * spacing).exp();
            let (scattered, albedo) = (PHASE * transmittance * (1.0 - passed), self.transfer().albedo(ftle));
            (0..3).for_each(|k| radiance[k] += f64::from(scattered * albedo[k] * light[k]));
            transmittance *= passed;
        }
        let background = self.scene().settings.background;
        (std::array::from_fn(|k| radiance[k] + f64::from(transmittance) * background[k]), 1.0 - transmittance)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{CameraSettings, LightSettings, RenderSettings, Scene, TransferSettings};
    use ridgewatch_field::Domain;

    fn renderer() -> Renderer {
        let domain = Domain::slab([0.0; 2], [2.0, 1.0], (0.0, 1.0));
        let settings =
            RenderSettings { width: 64, height: 32, background: [0.2; 3], tone_map: [1.0, 0.5, 1.0], ..RenderSettings::default() };
        let transfer = TransferSettings { low: Some(0.0), high: Some(1.0), extinction: Some(2.0), ..TransferSettings::default() };
        let light = LightSettings::directional([0.0, 0.0, -1.0], 1.0);
        let camera =
            CameraSettings { eye: [1.0, 0.5, 3.0], look_at: [1.0, 0.5, 0.0], up: [0.0, 1.0, 0.0], field_of_view: 90.0, orthographic: true };
        let scene = Scene::assemble(&domain, Some(camera), Some(light), Some(transfer), settings, 1);
        Renderer::new(scene, &domain, 1.0).unwrap()
    }

    #[test]
    fn uniform_fields_differ_as_their_closed_forms_do() {
        let renderer = renderer();
        let rays = renderer.ray_points(64, 12);
        let field = |ftle: f32| vec![ftle; rays.points.len()];
        assert!(rays.points.len() >= 24 * FEWEST_LIT && rays.points.len().is_multiple_of(24), "{}", rays.points.len());
        let seen = |ftle: f32| {
            let passed = f64::from(-renderer.transfer().extinction(ftle)).exp();
            let albedo = renderer.transfer().albedo(ftle);
            let light = rays.light[0];
            [0, 1, 2].map(|k| f64::from(PHASE * albedo[k] * light[k]) * (1.0 - passed) + passed * 0.2)
        };
        let (shown, truth) = (seen(0.4), seen(0.5));
        let wanted = (0..3).map(|k| (shown[k] - truth[k]).powi(2)).sum::<f64>() / 3.0;
        let found = renderer.pictures_apart(&rays, &field(0.4), &field(0.5)).unwrap();
        assert!((found[0] / wanted - 1.0).abs() < 1e-3 && (found[2] / wanted - 1.0).abs() < 1e-2, "{found:?}, not {wanted}");
        assert_eq!(renderer.pictures_apart(&rays, &field(0.5), &field(0.5)), Some([0.0; 3]));
        // Nothing is lit.
        assert_eq!(renderer.pictures_apart(&rays, &field(0.5), &field(f32::NAN)), None);
    }

    /// What errs up and down along a ray averages out in its picture, also where its points are too far apart to show it, and what errs one way does not.
    #[test]
    fn errors_of_one_sign_count_for_more() {
        let renderer = renderer();
        let rays = renderer.ray_points(256, 8);
        let truth = vec![0.5; rays.points.len()];
        let noise = |i: usize| if crate::rng::philox([i as u32, 0, 0, 0], [7, 0])[0] % 2 == 0 { 0.52 } else { 0.48 };
        let [one_way, both_ways] = [vec![0.52; truth.len()], (0..truth.len()).map(noise).collect()]
            .map(|shown| renderer.pictures_apart(&rays, &shown, &truth).unwrap()[0]);
        // Of eight points a net the mean has an eighth of the square, which a single net would count.
        assert!(both_ways < 0.03 * one_way, "{both_ways} {one_way}");
    }
}
