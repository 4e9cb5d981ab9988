//! How far the pictures of two fields are apart, from rays of a few pixels: neither is drawn.

use super::map_picture::footprint;
use super::rng::{philox, unit};
use super::smooth::{LIT, Medium, Nodes, StepsError, ToneMap, weighted};
use super::tracking::PHASE;
use super::{GridPoint, Light, Renderer};
use rayon::prelude::*;
use ridgewatch_field::DomainPoint;
use std::sync::Arc;

/// About as many nodes show what is between a point and the light.
const LIGHT_NODES: f64 = 4096.0;
/// Share of a ray's light below which a point is dark.
const FAINT: f32 = 1e-3;
/// Fewest lit pixels that tell how far two pictures are apart.
const FEWEST_LIT: usize = 16;

/// Points on rays through a picture: two nets a pixel, on rays through random places of it, at even distances from random depths on.
#[derive(Debug, Clone)]
pub struct RayPoints {
    /// Points of the nets, from front to back, one net after the other; behind them coarse nodes of the whole box, through which light comes.
    pub points: Vec<DomainPoint>,
    /// Places of the nets' points.
    places: Vec<GridPoint>,
    per_net: usize,
    /// Distance between the points of each net, in scene units, two nets a pixel.
    spacing: Vec<f32>,
    /// Shape of the nodes.
    shape: [usize; 3],
}

impl Renderer {
    /// Nets of `per_net` points in those of `pixels` pixels, spread evenly over the picture, whose rays meet the box. The same for every seed.
    pub fn ray_points(&self, pixels: usize, per_net: usize) -> RayPoints {
        let scene = self.frame_scene(0);
        let size = [scene.width, scene.height].map(|count| count as f64);
        let edges = scene.space.edges();
        let is_flat = self.is_flat();
        let volume: f64 = edges[..if is_flat { 2 } else { 3 }].iter().product();
        let mut apart = (volume / LIGHT_NODES).powf(if is_flat { 0.5 } else { 1.0 / 3.0 });
        let shape = loop {
            let shape = [0, 1, 2].map(|axis| if axis == 2 && is_flat { 1 } else { (edges[axis] / apart).round().max(1.0) as usize + 1 });
            // A thin box has two nodes across.
            if shape.into_iter().map(|nodes| nodes as f64).product::<f64>() <= 2.0 * LIGHT_NODES {
                break shape;
            }
            apart *= 1.25;
        };
        let mut found = RayPoints { points: Vec::new(), places: Vec::new(), per_net, spacing: Vec::new(), shape };
        for (number, place) in footprint(0, 0, 0, 0..pixels).enumerate() {
            let [within, depths] = [0, 1].map(|which| philox([number as u32, which, 0, 0], [0, 0]).map(|word| f64::from(unit(word))));
            let rays: [_; 2] = std::array::from_fn(|net| {
                let [u, v] = [0, 1].map(|axis| ((place[axis] * size[axis]).floor() + within[2 * net + axis]) / size[axis]);
                let (eye, toward) = scene.camera.ray(2.0 * u - 1.0, 1.0 - 2.0 * v);
                scene.space.intersect(eye, toward).map(|ends| (eye, toward, ends))
            });
            let [Some(one), Some(other)] = rays else { continue };
            for ((eye, toward, (enter, leave)), shift) in [one, other].into_iter().zip(depths) {
                let spacing = (leave - enter) / per_net as f64;
                for i in 0..per_net {
                    let along = enter + (i as f64 + shift) * spacing;
                    let point: [f64; 3] = std::array::from_fn(|k| eye[k] + along * toward[k]);
                    found.places.push(scene.space.grid_point(point));
                }
                found.spacing.push(spacing as f32);
            }
        }
        let nodes = (0..shape.iter().product()).map(|node| scene.space.grid_of_unit(Nodes::unit(shape, node)));
        found.points = found.places.iter().copied().chain(nodes).map(|place| scene.space.domain_point(place)).collect();
        found
    }

    /// Mean square difference over lit pixels between pictures of two fields, given by their log-stretch at the points of `rays`. The second one is that of
    /// the true steps. NaN is a missing cell.
    ///
    /// The product of what both nets of a pixel differ by has the square of the pixel's difference as its mean, since they are independent (to first order in
    /// all but the linear weighting): what averages out along a ray or over the pixel does not count. `None` if hardly a pixel is lit.
    pub fn pictures_apart(&self, rays: &RayPoints, shown: &[f32], truth: &[f32]) -> Option<StepsError> {
        let tone_map = ToneMap::new(self.scene().settings.tone_map);
        let lowest = self.transfer().range()[0] as f32 / self.inverse_tau() as f32;
        let fields = [shown, truth].map(|field| {
            let (of_rays, of_nodes) = field.split_at(rays.places.len());
            let nodes: Vec<f32> = of_nodes.iter().map(|s| if s.is_finite() { *s } else { lowest }).collect();
            (of_rays, Nodes::new(rays.shape, Arc::new(nodes)))
        });
        let of_net = |net: usize| {
            let [(shown, _), (truth, opacity)] = fields.each_ref().map(|(field, nodes)| self.seen(rays, net, field, nodes));
            (shown, truth, opacity)
        };
        let of_pixel = |pixel: usize| {
            let [one, other] = [2 * pixel, 2 * pixel + 1].map(of_net);
            let apart = |(shown, truth, _): ([f64; 3], [f64; 3], f32)| std::array::from_fn(|k| shown[k] - truth[k]);
            let mean = |a: [f64; 3], b: [f64; 3]| std::array::from_fn(|k| 0.5 * (a[k] + b[k]));
            let is_lit = one.2 + other.2 > 2.0 * LIT;
            is_lit.then(|| weighted(apart(one), apart(other), tone_map, mean(one.0, other.0), mean(one.1, other.1)))
        };
        let squares: Vec<[f64; 3]> = (0..rays.spacing.len() / 2).into_par_iter().filter_map(of_pixel).collect();
        let count = squares.len() as f64;
        (squares.len() >= FEWEST_LIT).then(|| {
            let mean: [f64; 3] = std::array::from_fn(|weighting| squares.iter().map(|square| square[weighting]).sum::<f64>() / count);
            let scatter = |weighting: usize| squares.iter().map(|square| (square[weighting] - mean[weighting]).powi(2)).sum::<f64>();
            let deviation: [f64; 3] = std::array::from_fn(|weighting| scatter(weighting).sqrt() / count);
            // As with the march, a mean below half of its standard error says no more than that.
            StepsError { squared: std::array::from_fn(|w| mean[w].max(0.5 * deviation[w])), deviation }
        })
    }

    /// Radiance and opacity of a net's ray (emission and absorption, Max 1995).
    fn seen(&self, rays: &RayPoints, net: usize, log_stretch: &[f32], nodes: &Nodes) -> ([f64; 3], f32) {
        let scene = self.frame_scene(0);
        let medium = Medium { scene: &scene, nodes, missing: None };
        let step = medium.spacing() as f32;
        let (mut radiance, mut transmittance, mut in_missing) = ([0.0; 3], 1.0_f32, 0);
        for point in net * rays.per_net..(net + 1) * rays.per_net {
            if !log_stretch[point].is_finite() {
                in_missing += 1;
                continue;
            }
            let ftle = log_stretch[point] * scene.inverse_tau;
            let passed = (-scene.transfer.extinction(ftle) * rays.spacing[net]).exp();
            let weight = transmittance * (1.0 - passed);
            transmittance *= passed;
            if weight < FAINT {
                continue;
            }
            let (place, albedo) = (rays.places[point], scene.transfer.albedo(ftle));
            let light = match scene.light {
                Light::Directional { radiance, .. } => *radiance,
                Light::Point { .. } => scene.light.seen_from(scene.space.scene_point(place)).2,
            };
            let scattered = PHASE * weight * (-medium.depth_to_light(place, step)).exp();
            (0..3).for_each(|k| radiance[k] += f64::from(scattered * albedo[k] * light[k]));
        }
        let share = in_missing as f32 / rays.per_net as f32;
        let behind = |k: usize| (1.0 - share) * scene.background[k] + share * scene.missing[k];
        (std::array::from_fn(|k| radiance[k] + f64::from(transmittance * behind(k))), 1.0 - transmittance)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{CameraSettings, LightSettings, RenderSettings, Scene, TransferSettings};
    use ridgewatch_field::Domain;

    fn renderer() -> Renderer {
        lit_by(LightSettings::directional([0.0, 0.0, -1.0], 1.0))
    }

    fn lit_by(light: LightSettings) -> Renderer {
        let domain = Domain::slab([0.0; 2], [2.0, 1.0], (0.0, 1.0));
        let settings =
            RenderSettings { width: 64, height: 32, background: [0.2; 3], tone_map: [1.0, 0.5, 1.0], ..RenderSettings::default() };
        let transfer = TransferSettings { low: Some(0.0), high: Some(1.0), extinction: Some(2.0), ..TransferSettings::default() };
        let camera =
            CameraSettings { eye: [1.0, 0.5, 3.0], look_at: [1.0, 0.5, 0.0], up: [0.0, 1.0, 0.0], field_of_view: 90.0, orthographic: true };
        let scene = Scene::assemble(&domain, Some(camera), Some(light), Some(transfer), settings, 1);
        Renderer::new(scene, &domain, 1.0).unwrap()
    }

    #[test]
    fn uniform_fields_differ_as_their_closed_forms_do() {
        let renderer = renderer();
        let rays = renderer.ray_points(256, 12);
        let field = |ftle: f32| vec![ftle; rays.points.len()];
        assert!(rays.places.len() >= 24 * FEWEST_LIT && rays.places.len().is_multiple_of(24), "{}", rays.places.len());
        // The light comes the way of the camera, so that what is in its way is what was passed.
        let seen = |ftle: f32| {
            let passed = f64::from(-renderer.transfer().extinction(ftle)).exp();
            let albedo = renderer.transfer().albedo(ftle);
            let Light::Directional { radiance, .. } = renderer.frame_scene(0).light else { panic!("another light") };
            [0, 1, 2].map(|k| f64::from(PHASE * albedo[k] * radiance[k]) * 0.5 * (1.0 - passed * passed) + passed * 0.2)
        };
        let (shown, truth) = (seen(0.4), seen(0.5));
        let wanted = (0..3).map(|k| (shown[k] - truth[k]).powi(2)).sum::<f64>() / 3.0;
        let found = renderer.pictures_apart(&rays, &field(0.4), &field(0.5)).unwrap();
        let [linear, _, toned] = found.squared;
        assert!((linear / wanted - 1.0).abs() < 0.02 && (toned / wanted - 1.0).abs() < 0.02, "{found:?}, not {wanted}");
        assert_eq!(renderer.pictures_apart(&rays, &field(0.5), &field(0.5)), Some(StepsError::default()));
        // Nothing is lit.
        assert_eq!(renderer.pictures_apart(&rays, &field(0.5), &field(f32::NAN)), None);
    }

    /// What errs up and down along a ray averages out in its picture, also where its points are too far apart to show it, and what errs one way does not.
    #[test]
    fn errors_of_one_sign_count_for_more() {
        let renderer = renderer();
        let rays = renderer.ray_points(256, 8);
        let truth = vec![0.5; rays.points.len()];
        let noise = |i: usize| if philox([i as u32, 0, 0, 0], [7, 0])[0].is_multiple_of(2) { 0.52 } else { 0.48 };
        let [one_way, both_ways] = [vec![0.52; truth.len()], (0..truth.len()).map(noise).collect()]
            .map(|shown| renderer.pictures_apart(&rays, &shown, &truth).unwrap().squared[0]);
        // Of eight points a net the mean has an eighth of the square, which a single net would count.
        assert!(both_ways < 0.03 * one_way, "{both_ways} {one_way}");
    }

    #[test]
    fn a_distant_point_light_is_a_directional_one() {
        let far = 1e4;
        let light = LightSettings { direction: None, position: Some([1.0, 0.5, far]), radiance: [far * far; 3] };
        let [point, directional] = [lit_by(light), renderer()].map(|renderer| {
            let rays = renderer.ray_points(256, 12);
            let field = |ftle: f32| vec![ftle; rays.points.len()];
            renderer.pictures_apart(&rays, &field(0.4), &field(0.5)).unwrap().squared
        });
        for (a, b) in point.into_iter().zip(directional) {
            assert!((a / b - 1.0).abs() < 1e-2, "{point:?} {directional:?}");
        }
    }

    /// Where land hides half of the picture, the other half errs as before.
    #[test]
    fn missing_cells_are_not_compared() {
        let renderer = renderer();
        let rays = renderer.ray_points(1024, 12);
        let field = |ftle: f32, is_land: &dyn Fn(f32) -> bool| -> Vec<f32> {
            rays.points.iter().map(|point| if is_land(point.0[0]) { f32::NAN } else { ftle }).collect()
        };
        let squared =
            |is_land: &dyn Fn(f32) -> bool| renderer.pictures_apart(&rays, &field(0.4, is_land), &field(0.5, is_land)).unwrap().squared[0];
        let (whole, half) = (squared(&|_| false), squared(&|x| x < 1.0));
        assert!((half / whole - 1.0).abs() < 0.02, "{half} {whole}");
        // Land that only one of the fields has is a difference: its colour in place of the flow's.
        let torn = renderer.pictures_apart(&rays, &field(0.5, &|x| x < 1.0), &field(0.5, &|_| false)).unwrap().squared[0];
        assert!(torn > 10.0 * whole, "{torn} {whole}");
    }
}
