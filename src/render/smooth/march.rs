//! Marching: the expected picture of the surrogate, by quadrature along camera rays (emission and absorption, Max 1995).
//!
//! The picture is the mean over the pixel's area, as it is for tracking. The rays of a pixel go through the same points in every pixel, in fours: a point
//! and its quarter turns around the centre, so that no such number of rays shifts the picture or blurs one direction more than another. The first two of
//! four lie on opposite sides of the centre, so that they do not shift it either. The first point is that of Gauss's rule, the others are those of an
//! additive recurrence in two dimensions, which fills the pixel evenly.

use super::light_volume::LightVolume;
use super::march_control::{FIRST_AUDIT_RAY, NET};
use super::medium::{MAX_POINTS, Medium};
use crate::Light;
use crate::rng::unit;
use crate::tracking::PHASE;
use ridgewatch_field::UnitPoint;

/// Transmittance below which the rest of a ray is not marched.
const OPAQUE: f32 = 1e-4;
/// Third counter word of the random shift of a pixel's rays, which no path reaches.
const SHIFT_DIMENSION: u32 = u32::MAX - 1;

/// Third counter word of the draw of the rays that [`Medium::mended_ray`] refines.
const MEND_DIMENSION: u32 = u32::MAX - 3;
/// Share of the rays whose steps are halved once, and share of those that are halved again: 2^-1.5, between the cost of a halving, 2, and what it leaves of
/// the squared error, 1/4 or less.
const HALVED: f32 = 0.25;
const HALVED_AGAIN: f32 = 0.353_553_4;
/// Largest number of halvings, which leave 2^-16 of the error of smooth fields, unless a ray has as many points as it may before.
const MOST_HALVINGS: u32 = 8;

/// How the transmittance to the light is found.
#[derive(Clone, Copy)]
pub enum ToLight<'a> {
    /// From the swept light volume.
    Volume(&'a LightVolume),
    /// By marching from the point with this step, in scene units.
    March(f32),
    /// From the light volume; where the opacity in front passes `draw`, what marching with `step` finds more is added with the weight of a path that
    /// scatters there, so that the mean over draws in (0, 1) is that of marching everywhere.
    Checked {
        /// The light volume.
        volume: &'a LightVolume,
        /// Step of marching to the light, in scene units.
        step: f32,
        /// Opacity, in [0, 1).
        draw: f32,
    },
}

/// One ray, or a sum of rays.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct RaySum {
    /// Linear radiance.
    pub radiance: [f32; 3],
    /// Opacity.
    pub alpha: f32,
    /// Sum of weight times FTLE.
    pub ftle: f32,
    /// Share of the ray that lies in missing cells.
    pub missing: f32,
}

impl RaySum {
    /// Adds a ray.
    pub fn add(&mut self, ray: &Self) {
        (0..3).for_each(|k| self.radiance[k] += ray.radiance[k]);
        self.alpha += ray.alpha;
        self.ftle += ray.ftle;
        self.missing += ray.missing;
    }

    /// Adds `weight` times the difference between the radiances of two rays. The other fields, shares and a mean that may not leave their ranges, stay.
    fn add_difference(&mut self, weight: f32, ray: &Self, less: &Self) {
        (0..3).for_each(|k| self.radiance[k] += weight * (ray.radiance[k] - less.radiance[k]));
    }
}

/// Offsets of ray `j`: across the pixel, down the pixel, and of the quadrature points in their steps (the midpoint rule). `random`, in [0, 1), shifts the
/// nets of audits.
fn offsets(j: u64, random: [f32; 4]) -> [f32; 3] {
    /// Distance of Gauss's two points from the middle of the unit interval, 1 / sqrt 12.
    const GAUSS: f64 = 0.288_675_134_594_812_9;
    /// The recurrence's first point and its steps, sqrt 2 and sqrt 3. Of 10,000 first points this one has the smallest error of edges and ridges after its
    /// worst number of rays.
    const START: [f64; 2] = [0.57, 0.81];
    const STEPS: [f64; 2] = [std::f64::consts::SQRT_2, 1.732_050_807_568_877_2];
    /// The four points of a net that are turned, in quarters: one in each row and column.
    const FOUR: [[f64; 2]; 4] = [[0.0, 0.0], [1.0, 2.0], [2.0, 1.0], [3.0, 3.0]];
    let point = match j / 4 {
        0 => [-GAUSS, -GAUSS],
        _ if j >= FIRST_AUDIT_RAY => {
            let place = FOUR[(j % NET / 4) as usize];
            std::array::from_fn(|k| (0.25 * place[k] + f64::from(random[k])).fract() - 0.5)
        }
        number => std::array::from_fn(|k| (START[k] + (number - 1) as f64 * STEPS[k]).fract() - 0.5),
    };
    let [x, y] = if (j / 2).is_multiple_of(2) { point } else { [-point[1], point[0]] };
    let [x, y] = [x, y].map(|x| (if j.is_multiple_of(2) { 0.5 + x } else { 0.5 - x }) as f32);
    [x, y, 0.5]
}

impl Medium<'_> {
    /// An unbiased estimate of the surrogate's expected picture, from ray `j` of a pixel in a random place: [`Self::ray`], and on a random share of the rays,
    /// with the inverse of that share as weight, what halving the steps and checking the light volume changes, and what the next halving does (Rhee and Glynn
    /// 2015, the coupled sum; for the transmittance alone see Kettunen et al. 2021).
    pub fn mended_ray(&self, pixel: u32, j: u64, step: f32, volume: &LightVolume) -> RaySum {
        let mut sum = self.ray(pixel, j, step, ToLight::Volume(volume), true);
        let [halved, draw, ..] = self.scene.random.words(pixel, j as u32, MEND_DIMENSION).map(unit);
        let (mut coarse, mut step, mut share) = (sum, step, HALVED);
        for _ in 0..MOST_HALVINGS {
            if halved >= share {
                break;
            }
            step *= 0.5;
            let fine = self.ray(pixel, j, step, ToLight::Checked { volume, step, draw }, true);
            sum.add_difference(1.0 / share, &fine, &coarse);
            (coarse, share) = (fine, share * HALVED_AGAIN);
        }
        sum
    }

    /// Ray `j` of a pixel with steps of at most `step` scene units. `shift` draws a random shift of the ray for each pixel, and follows opaque rays to the end.
    /// The nets of audits are shifted in any case, all rays of one by the same random numbers.
    pub fn ray(&self, pixel: u32, j: u64, step: f32, light: ToLight<'_>, shift: bool) -> RaySum {
        let (scene, space) = (self.scene, self.scene.space);
        let of_audit = j >= FIRST_AUDIT_RAY;
        let number = if of_audit { j - j % NET } else { j };
        let random = if shift || of_audit { scene.random.words(pixel, number as u32, SHIFT_DIMENSION).map(unit) } else { [0.0; 4] };
        let mut offset = offsets(j, random);
        if shift {
            let moved = if of_audit { 2 } else { 0 };
            (moved..3).for_each(|k| offset[k] = (offset[k] + random[k]).fract());
        }
        let (column, row) = (pixel as usize % scene.width, pixel as usize / scene.width);
        let x = (column as f64 + f64::from(offset[0])) / scene.width as f64 * 2.0 - 1.0;
        let y = 1.0 - (row as f64 + f64::from(offset[1])) / scene.height as f64 * 2.0;
        let (eye, toward) = scene.camera.ray(x, y);
        let Some((enter, leave)) = space.intersect(eye, toward) else {
            return RaySum { radiance: scene.background, ..RaySum::default() };
        };
        let origin = space.grid_point(std::array::from_fn(|k| eye[k] + enter * toward[k]));
        let direction = space.grid_direction(toward);
        let length = (leave - enter) as f32;
        let count = (length / step).ceil().clamp(1.0, MAX_POINTS);
        let (step, count) = (length / count, count as usize);
        let (start, along) = (space.unit_of_grid(origin), space.unit_direction(direction));
        let (mut sum, mut transmittance, mut in_missing, mut i) = (RaySum::default(), 1.0_f32, 0_usize, 0);
        let opaque = if shift { 0.0 } else { OPAQUE };
        while i < count && transmittance >= opaque {
            let t = (i as f32 + offset[2]) * step;
            let unit = UnitPoint(std::array::from_fn(|k| start.0[k] + t * along[k]));
            if self.missing.is_none()
                && let Some((low, high)) = self.nodes.empty_brick(unit, scene.transfer, scene.inverse_tau)
            {
                let mut exit = f32::INFINITY;
                for k in 0..3 {
                    if along[k] != 0.0 {
                        exit = exit.min(((if along[k] > 0.0 { high.0[k] } else { low.0[k] }) - start.0[k]) / along[k]);
                    }
                }
                i = (i + 1).max(((exit / step - offset[2]).ceil().max(0.0) as usize).min(count));
                continue;
            }
            i += 1;
            let Some(ftle) = self.ftle(unit) else {
                in_missing += 1;
                continue;
            };
            let extinction = scene.transfer.extinction(ftle);
            if extinction <= 0.0 {
                continue;
            }
            let absorbed = 1.0 - (-extinction * step).exp();
            let weight = transmittance * absorbed;
            let grid = origin.along(direction, t);
            let radiance = match scene.light {
                Light::Directional { radiance, .. } => *radiance,
                Light::Point { .. } => scene.light.seen_from(space.scene_point(grid)).2,
            };
            let depth = match light {
                ToLight::Volume(volume) | ToLight::Checked { volume, .. } => volume.at(unit),
                ToLight::March(step) => self.depth_to_light(grid, step),
            };
            let mut arriving = weight * (-depth).exp();
            if let ToLight::Checked { step, draw, .. } = light
                && sum.alpha <= draw
                && draw < sum.alpha + weight
            {
                arriving += (-self.depth_to_light(grid, step)).exp() - (-depth).exp();
            }
            let scattered = PHASE * arriving;
            let albedo = scene.transfer.albedo(ftle);
            (0..3).for_each(|k| sum.radiance[k] += scattered * albedo[k] * radiance[k]);
            sum.alpha += weight;
            sum.ftle += weight * ftle;
            transmittance *= 1.0 - absorbed;
        }
        let share = in_missing as f32 / i.max(1) as f32;
        sum.missing = transmittance * share;
        (0..3).for_each(|k| sum.radiance[k] += transmittance * ((1.0 - share) * scene.background[k] + share * scene.missing[k]));
        sum
    }
}

#[cfg(test)]
mod tests {
    use super::offsets;
    use crate::rng::{philox, unit};
    use crate::smooth::march_control::QUARTER_TURNS;
    use crate::smooth::{AuditedPixel, FIRST_AUDIT_RAY, MarchControl, NET, PAIR, ToneMap};

    /// Mean square errors of the picture and what an audit of it states, after each `rays` and up to `most` rays of a pattern that lies across the pixel.
    /// `shown` gives the colour at a distance from an edge or ridge.
    fn stated_and_found(shown: impl Fn(f32) -> f32, angle: f32, rays: u64, most: u64) -> Vec<[f64; 2]> {
        const PLACES: usize = 960;
        let mut audits = vec![Vec::new(); (most / rays) as usize];
        let mut found = vec![0.0; audits.len()];
        for place in 0..PLACES {
            let at = -1.2 + 2.4 * (place as f32 + 0.5) / PLACES as f32;
            let colour = |[x, y, _]: [f32; 3]| f64::from(shown((x - 0.5) * angle.cos() + (y - 0.5) * angle.sin() - at));
            let truth = (0..1600).map(|i| colour([i % 40, i / 40, 0].map(|n| (n as f32 + 0.5) / 40.0))).sum::<f64>() / 1600.0;
            let net = |number: u64| {
                let shift = philox([place as u32, number as u32, 0, 0], [5, angle.to_bits()]).map(unit);
                let point = |j: u64| offsets(FIRST_AUDIT_RAY + j, shift);
                [(0..NET).map(|j| colour(point(j))).sum::<f64>() / NET as f64; 3]
            };
            let nets = [net(0), net(1)];
            for (number, (audit, square)) in audits.iter_mut().zip(&mut found).enumerate() {
                let rays = rays * (number as u64 + 1);
                let mean = (0..rays).map(|j| colour(offsets(j, [0.0; 4]))).sum::<f64>() / rays as f64;
                *square += (mean - truth).powi(2) / PLACES as f64;
                audit.push(AuditedPixel { shown: [mean, mean, mean, 1.0], nets, ..AuditedPixel::default() });
            }
        }
        let stated = |audit: Vec<AuditedPixel>| {
            let mut control = MarchControl::default();
            control.audit(audit, ToneMap::new([1.0, 0.5, 1.0]));
            control.error()
        };
        audits.into_iter().map(stated).zip(found).map(|(stated, found)| [stated, found]).collect()
    }

    /// Edges across a pixel, also along its axes.
    #[test]
    fn edges_of_all_directions_are_audited() {
        for angle in [0.0, 0.02, 0.1, 0.4, 0.785, 1.2, 1.5508, std::f32::consts::FRAC_PI_2] {
            for [stated, found] in stated_and_found(|distance| f32::from(distance < 0.0), angle, PAIR, QUARTER_TURNS) {
                assert!((stated / found - 1.0).abs() < 0.2, "angle {angle}: {stated} stated, {found} found");
            }
        }
    }

    /// Edges, and ridges of a fraction of a pixel as small pictures have them, in all directions: after any number of fours the stated error is the true one,
    /// and it falls about as that of independent rays or faster.
    #[test]
    fn more_rays_have_a_smaller_error() {
        const ANGLES: usize = 24;
        let mut all = [0.0; 16];
        for width in [0.0_f32, 0.1, 0.2, 0.3] {
            let shown = |distance: f32| if width > 0.0 { (-0.5 * (distance / width).powi(2)).exp() } else { f32::from(distance < 0.0) };
            let mut sums = [[0.0; 2]; 16];
            for angle in 0..ANGLES {
                let errors = stated_and_found(shown, std::f32::consts::PI * (angle as f32 + 0.3) / ANGLES as f32, QUARTER_TURNS, 64);
                sums.iter_mut().zip(errors).for_each(|(sum, error)| (0..2).for_each(|k| sum[k] += error[k]));
            }
            assert!(sums.iter().all(|[stated, found]| (stated / found - 1.0).abs() < 0.2), "width {width}: {sums:?}");
            all.iter_mut().zip(sums).for_each(|(all, [_, found])| *all += found);
        }
        let times_rays: Vec<f64> = all.iter().zip(1..).map(|(square, fours)| square / all[0] * f64::from(fours)).collect();
        assert!(times_rays.iter().all(|share| *share < 1.2) && times_rays[15] < 0.6, "{times_rays:.2?}");
    }
}
