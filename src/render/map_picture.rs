//! The map of a flow of two dimensions: the mean of the FTLE over each pixel, in a perceptually uniform colour map, and its error.
//!
//! Every pixel has two halves of seeds. Each is a low-discrepancy sequence that is shifted at random, so that its mean is unbiased and independent of
//! the other. Seeds accumulate while the view stands still; other colours need none.

use super::renderer::{RenderStats, Renderer};
use super::smooth::{MarchError, PictureError, StepsError, TILE, TileSums, smoothed};
use super::{CameraSettings, Film, LogStretch, MapPlane};
use rayon::prelude::*;
use ridgewatch_field::DomainPoint;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;

/// Tone map of a map's linear colours, which gives their 8 bits back.
pub const MAP_TONE: [f64; 3] = [1.0, 0.5, 2.2];
/// Seeds that are traced at once, which bounds the memory beside the picture.
const AT_ONCE: usize = 1 << 21;
/// Radius over which the squared error of a pixel is averaged, in pixels.
const ERROR_RADIUS: usize = 8;
/// Floor of a pixel's squared error, as a share of the map's mean.
const ERROR_FLOOR: f64 = 0.05;
/// Pixels of a task of one thread.
const TASK: usize = 1 << 12;

/// A colour of 8 bits as linear radiance, which [`MAP_TONE`] turns back.
fn linear(colour: [u8; 3]) -> [f32; 3] {
    colour.map(|c| (f64::from(c) / 255.0).powf(MAP_TONE[2]) as f32)
}

/// Viridis (Smith and van der Walt 2015), perceptually uniform also with colour blindness: the colour at a share of the range, beyond 0 and 1 that of
/// the ends.
pub fn viridis(share: f64) -> [u8; 3] {
    colorous::VIRIDIS.eval_continuous(share.clamp(0.0, 1.0)).as_array()
}

/// Linear radiance of a map at a share of the range of its colours.
pub fn map_radiance(share: f64) -> [f32; 3] {
    linear(viridis(share))
}

/// A well-mixed hash (splitmix64).
fn mixed(value: u64) -> u64 {
    let z = value.wrapping_add(0x9e37_79b9_7f4a_7c15);
    let z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    let z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    z ^ (z >> 31)
}

/// Places of seeds of one half of a pixel, in [0, 1)^2, those of these `numbers`: Roberts' low-discrepancy sequence R2 (2018), shifted at random modulo 1,
/// so that each half is unbiased and independent of the other.
pub fn footprint(seed: u64, pixel: usize, half: usize, numbers: std::ops::Range<usize>) -> impl Iterator<Item = [f64; 2]> {
    // Reciprocals of the plastic number and its square.
    const STEP: [f64; 2] = [0.754_877_666_246_693, 0.569_840_290_998_053];
    let bits = mixed(mixed(seed) ^ (2 * pixel + half) as u64);
    let shift = [bits >> 32, bits & 0xffff_ffff].map(|b| b as f64 / 4_294_967_296.0);
    numbers.map(move |k| [0, 1].map(|axis| (shift[axis] + k as f64 * STEP[axis]).fract()))
}

/// Sums over the seeds of a pixel.
#[derive(Debug, Clone, Copy, Default)]
struct Pixel {
    /// Log-stretch, and the number of seeds that have one, of each half.
    sum: [f64; 2],
    known: [u32; 2],
    /// Seeds within the domain, and those without a velocity.
    within: u32,
    missing: u32,
}

impl Pixel {
    fn mean(&self) -> Option<f64> {
        let known = self.known[0] + self.known[1];
        (known > 0).then(|| (self.sum[0] + self.sum[1]) / f64::from(known))
    }

    /// Means of both halves.
    fn halves(&self) -> Option<[f64; 2]> {
        (self.known[0] > 0 && self.known[1] > 0).then(|| [0, 1].map(|half| self.sum[half] / f64::from(self.known[half])))
    }

    /// The mean where most of the pixel has a velocity.
    fn shown(&self) -> Option<f64> {
        self.mean().filter(|_| self.missing_share() < 0.5)
    }

    fn missing_share(&self) -> f32 {
        if self.within > 0 { self.missing as f32 / self.within as f32 } else { 0.0 }
    }
}

/// A map that accumulates seeds.
#[derive(Debug, Default)]
pub struct MapPicture {
    /// The view that the sums are of: camera, scale, plane, size and seed.
    shows: Option<(CameraSettings, [f64; 3], Option<MapPlane>, [usize; 2], u64)>,
    pixels: Vec<Pixel>,
    /// Seeds of a half of a pixel so far.
    seeds: usize,
}

impl MapPicture {
    /// Adds `samples` seeds a pixel (rounded up to an even number) and draws the picture. `None` if `stop` ended it early; all seeds are then forgotten.
    pub fn refine(
        &mut self,
        renderer: &Renderer,
        samples: f64,
        answers: &mut dyn LogStretch,
        progress: Option<&dyn Fn(f32)>,
        stop: &AtomicBool,
    ) -> Option<(Film, RenderStats, PictureError)> {
        let scene = renderer.scene();
        let size = [scene.settings.width, scene.settings.height];
        let shows = (scene.camera.clone(), scene.scale, scene.plane, size, scene.seed);
        if self.shows.as_ref() != Some(&shows) {
            *self = Self { shows: Some(shows), pixels: vec![Pixel::default(); size[0] * size[1]], seeds: 0 };
        }
        let began = Instant::now();
        let numbers = self.seeds..self.seeds + (samples / 2.0).ceil().max(1.0) as usize;
        let count = self.pixels.len();
        let mut stats = RenderStats { paths: (2 * numbers.len() * count) as u64, ..RenderStats::default() };
        let at_once = (AT_ONCE / (2 * numbers.len())).max(1);
        let (mut points, mut log_stretch, mut traced) = (Vec::new(), Vec::new(), Vec::new());
        for (part, pixels) in self.pixels.chunks_mut(at_once).enumerate() {
            ridgewatch_base::progress::mark();
            let first = part * at_once;
            // Points of a task's pixels, and how many of them each half of each pixel has.
            let seeds: Vec<(Vec<DomainPoint>, Vec<[u32; 2]>)> = (0..pixels.len().div_ceil(TASK))
                .into_par_iter()
                .map(|task| {
                    let own = first + task * TASK..first + pixels.len().min((task + 1) * TASK);
                    let (mut points, mut within) = (Vec::with_capacity(2 * numbers.len() * own.len()), Vec::with_capacity(own.len()));
                    for pixel in own {
                        let corner = [pixel % size[0], pixel / size[0]].map(|n| n as f64);
                        let at = |[u, v]: [f64; 2]| {
                            renderer.map_point([2.0 * (corner[0] + u) / size[0] as f64 - 1.0, 1.0 - 2.0 * (corner[1] + v) / size[1] as f64])
                        };
                        within.push([0, 1].map(|half| {
                            let before = points.len();
                            points.extend(footprint(scene.seed, pixel, half, numbers.clone()).filter_map(at));
                            (points.len() - before) as u32
                        }));
                    }
                    (points, within)
                })
                .collect();
            points.clear();
            seeds.iter().for_each(|(own, _)| points.extend_from_slice(own));
            log_stretch.resize(points.len(), 0.0);
            traced.resize(points.len(), false);
            let asked = Instant::now();
            answers.evaluate(&points, &mut log_stretch, &mut traced);
            stats.evaluate_seconds += asked.elapsed().as_secs_f64();
            stats.waves += 1;
            // A stop may have left seeds untraced.
            if stop.load(Ordering::Relaxed) {
                *self = Self::default();
                return None;
            }
            let begins: Vec<usize> = (seeds.iter())
                .scan(0, |end, (own, _)| {
                    *end += own.len();
                    Some(*end - own.len())
                })
                .collect();
            let (found, missing) = (pixels.par_chunks_mut(TASK).zip(&seeds).zip(&begins))
                .map(|((pixels, (_, within)), &begin)| {
                    let (mut next, mut counts) = (begin, (0, 0));
                    for (pixel, within) in pixels.iter_mut().zip(within) {
                        for (half, &count) in within.iter().enumerate() {
                            let own = next..next + count as usize;
                            next = own.end;
                            pixel.within += count;
                            for (&value, &traced) in log_stretch[own.clone()].iter().zip(&traced[own]) {
                                counts.0 += u64::from(traced);
                                if value.is_finite() {
                                    pixel.sum[half] += f64::from(value);
                                    pixel.known[half] += 1;
                                } else if !traced {
                                    pixel.missing += 1;
                                    counts.1 += 1;
                                }
                            }
                        }
                    }
                    counts
                })
                .reduce(|| (0, 0), |a, b| (a.0 + b.0, a.1 + b.1));
            (stats.traced, stats.missing) = (stats.traced + found, stats.missing + missing);
            stats.queries += points.len() as u64;
            if let Some(progress) = progress {
                progress((first + pixels.len()) as f32 / count as f32);
            }
        }
        self.seeds = numbers.end;
        let (film, error) = self.film(renderer);
        stats.walk_seconds = began.elapsed().as_secs_f64() - stats.evaluate_seconds;
        Some((film, stats, error))
    }

    /// The picture of the seeds so far, and its stated error. The layer `error` is that of the FTLE.
    fn film(&self, renderer: &Renderer) -> (Film, PictureError) {
        let settings = &renderer.scene().settings;
        let [width, height] = [settings.width, settings.height];
        let per_time = renderer.inverse_tau();
        let [low, high] = renderer.transfer().range();
        let share = |log_stretch: f64| (log_stretch * per_time - low) / (high - low);
        let (background, land) = (settings.background.map(|c| c as f32), settings.missing_color.map(|c| c as f32));
        let mut film = Film::resident(width, height);
        film.rgba.par_iter_mut().zip(&self.pixels).with_min_len(TASK).for_each(|(rgba, pixel)| {
            let (colour, alpha) = match pixel.shown() {
                Some(mean) => (map_radiance(share(mean)), 1.0),
                None if pixel.within > 0 => (land, 0.0),
                None => (background, 0.0),
            };
            *rgba = [colour[0], colour[1], colour[2], alpha];
        });
        let layer = |layer: &mut Vec<f32>, value: &(dyn Fn(&Pixel) -> f32 + Sync)| {
            layer.par_iter_mut().zip(&self.pixels).with_min_len(TASK).for_each(|(to, pixel)| *to = value(pixel));
        };
        layer(&mut film.ftle_mean, &|pixel| pixel.shown().map_or(f32::NAN, |mean| (mean * per_time) as f32));
        layer(&mut film.missing, &Pixel::missing_share);
        layer(&mut film.samples, &|_| 2.0 * self.seeds as f32);
        layer(&mut film.queries, &|pixel| pixel.within as f32);
        layer(&mut film.traced, &|pixel| if pixel.missing < pixel.within { 1.0 } else { 0.0 });
        let columns = width.div_ceil(TILE);
        let mut tiles = vec![TileSums::default(); columns * height.div_ceil(TILE)];
        let mut variances = vec![f32::NAN; self.pixels.len()];
        let rows = tiles.par_chunks_mut(columns).zip(self.pixels.par_chunks(width * TILE)).zip(variances.par_chunks_mut(width * TILE));
        rows.for_each(|((tiles, pixels), variances)| {
            for (i, (pixel, variance_of)) in pixels.iter().zip(variances).enumerate() {
                let tile = &mut tiles[i % width / TILE];
                tile.all.pixels += 1.0;
                let Some(halves) = pixel.halves().filter(|_| pixel.shown().is_some()) else { continue };
                // The mean (a + b) / 2 of independent, unbiased halves has the variance E[(a - b)^2] / 4. The ends of the colours hide some of it, of which
                // clipped halves would tell too little.
                let [a, b] = halves.map(share);
                let variance = 0.25 * (a - b).powi(2);
                let level = (0.5 * (a + b)).powi(2);
                let squared = [variance, variance / (level + 0.01), variance];
                let largest = [level, level / (level + 0.01), level];
                tile.lit.pixels += 1.0;
                for of in [&mut tile.all, &mut tile.lit] {
                    of.pairs += self.seeds as f32;
                    for k in 0..3 {
                        of.squared[k] += squared[k] as f32;
                        // Sums of squares; their roots are taken below.
                        of.scatter[k] += (squared[k] * squared[k]) as f32;
                        of.radiance[k] += largest[k] as f32;
                    }
                }
                *variance_of = (variance * (high - low).powi(2)) as f32;
            }
            for of in tiles.iter_mut().flat_map(|tile| [&mut tile.all, &mut tile.lit]) {
                of.scatter = of.scatter.map(f32::sqrt);
            }
        });
        let error = PictureError {
            unbiased: true,
            ..PictureError::of(&tiles, &MarchError::default(), &StepsError::default(), 2.0 * self.seeds as f64, 0)
        };
        let floor = if error.is_known() { (ERROR_FLOOR * error.rms.value.powi(2) * (high - low).powi(2)) as f32 } else { 0.0 };
        // Without a value there is no error of it.
        film.error = (smoothed(&variances, width, ERROR_RADIUS).into_par_iter().zip(&film.ftle_mean))
            .map(|(variance, value)| if value.is_finite() { variance.max(floor).sqrt() } else { f32::NAN })
            .collect();
        (film, error)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{LightSettings, RenderSettings, Scene, TransferSettings};
    use ridgewatch_field::Domain;

    const TAU: f64 = 2.0;
    static NEVER: AtomicBool = AtomicBool::new(false);

    /// Log-stretch as a function of the place; NaN, untraced, where the function is `None`.
    struct Field<F>(F);

    impl<F: Fn(f64, f64) -> Option<f64>> LogStretch for Field<F> {
        fn evaluate(&mut self, points: &[DomainPoint], log_stretch: &mut [f32], traced: &mut [bool]) {
            for ((point, value), traced) in points.iter().zip(log_stretch).zip(traced) {
                let found = (self.0)(point.0[0].into(), point.0[1].into());
                (*value, *traced) = (found.map_or(f32::NAN, |s| s as f32), found.is_some());
            }
        }
    }

    fn renderer(seed: u64, [width, height]: [usize; 2], camera: Option<CameraSettings>) -> Renderer {
        let domain = Domain::slab([10.0, -4.0], [14.0, -2.0], (0.0, 1.0));
        let settings = RenderSettings { width, height, ..RenderSettings::default() };
        let transfer = TransferSettings { low: Some(0.0), high: Some(4.0), ..TransferSettings::default() };
        let light = LightSettings::directional([0.0, 0.0, -1.0], 1.0);
        let mut scene = Scene::assemble(&domain, camera, Some(light), Some(transfer), settings, seed);
        scene.seed = seed;
        Renderer::new(scene, &domain, TAU).unwrap()
    }

    fn above(x: f64, y: f64, half_width: f64) -> CameraSettings {
        let [eye, look_at] = [[x, y, 1.0 + half_width], [x, y, 1.0]];
        CameraSettings { eye, look_at, up: [0.0, 1.0, 0.0], field_of_view: 90.0, orthographic: true }
    }

    #[test]
    fn a_pixel_is_the_mean_over_its_footprint() {
        // 8 x 4 pixels of half a unit; ln 2 x is linear, so that its mean is that of the centre.
        let renderer = renderer(3, [8, 4], None);
        let mut picture = MapPicture::default();
        let mut field = Field(|x, y| Some(0.5 * (x - 10.0) + (y + 4.0)));
        let (film, stats, error) = picture.refine(&renderer, 4096.0, &mut field, None, &NEVER).unwrap();
        for (i, found) in film.ftle_mean.iter().enumerate() {
            let [x, y] = [10.25 + 0.5 * (i % 8) as f64, -2.25 - 0.5 * (i / 8) as f64];
            let wanted = (0.5 * (x - 10.0) + (y + 4.0)) / TAU;
            // A low-discrepancy mean of n seeds errs by some 1 / n of the slope over a pixel.
            assert!((f64::from(*found) - wanted).abs() < 1e-3, "{i}: {found}, not {wanted}");
            assert_eq!(film.rgba[i][3], 1.0);
            assert!((f64::from(film.rgba[i][1]) - f64::from(map_radiance(wanted / 4.0)[1])).abs() < 0.02);
        }
        assert_eq!((stats.queries, stats.traced, stats.missing), (8 * 4 * 4096, 8 * 4 * 4096, 0));
        assert!(error.rms.value < 1e-3 && error.samples_per_pixel == 4096.0 && error.unbiased, "{error:?}");
    }

    #[test]
    fn tones_give_the_colours_back() {
        for share in [0.0, 0.1, 0.5, 0.77, 1.0, 7.0] {
            let [r, g, b] = map_radiance(share);
            let film = Film { width: 1, height: 1, rgba: vec![[r, g, b, 1.0]], ..Film::default() };
            assert_eq!(film.tone_mapped(MAP_TONE), viridis(share));
        }
    }

    /// Ridges thinner than a pixel, and a step. The truth is the mean of many seeds of another seed of the shifts.
    fn ridges(x: f64, y: f64) -> Option<f64> {
        let ridge = |d: f64, width: f64| (-(d / width).powi(2)).exp();
        Some(0.5 + 5.0 * ridge(x - 12.0 - 0.3 * y, 0.01) + 3.0 * ridge(y + 3.1 - 0.2 * x.sin(), 0.03) + if x > 13.1 { 1.0 } else { 0.0 })
    }

    #[test]
    #[allow(clippy::print_stdout)] // figures of docs/maps.md
    fn the_stated_error_holds_as_seeds_accumulate() {
        let size = [48, 24];
        let truth = MapPicture::default().refine(&renderer(999, size, None), 16384.0, &mut Field(ridges), None, &NEVER).unwrap().0;
        const SEEDS: u64 = 100;
        const ROUNDS: usize = 3;
        let (mut held, mut above, mut stated, mut decibels) = ([0; ROUNDS], [0; ROUNDS], [[0.0; 2]; ROUNDS], [0; ROUNDS]);
        for seed in 0..SEEDS {
            let renderer = renderer(seed, size, None);
            let mut picture = MapPicture::default();
            for round in 0..ROUNDS {
                let (film, _, error) = picture.refine(&renderer, 4.0, &mut Field(ridges), None, &NEVER).unwrap();
                assert_eq!(error.samples_per_pixel, 4.0 * (round + 1) as f64);
                let squared = film.ftle_mean.iter().zip(&truth.ftle_mean).map(|(a, b)| f64::from((a - b) / 4.0).powi(2)).sum::<f64>();
                let rms = (squared / film.ftle_mean.len() as f64).sqrt();
                held[round] += u64::from((error.rms.low..=error.rms.high).contains(&rms));
                above[round] += u64::from(error.rms.low > rms);
                decibels[round] += u64::from((error.psnr.low..=error.psnr.high).contains(&(-20.0 * rms.log10())));
                stated[round] = [stated[round][0] + error.rms.value.powi(2), stated[round][1] + rms * rms];
            }
        }
        for round in 0..ROUNDS {
            let ratio = (stated[round][0] / stated[round][1]).sqrt();
            println!("{} seeds: {} of {SEEDS} held, {} above, stated over true {ratio:.3}", 4 * (round + 1), held[round], above[round]);
            // The product of two halves is unbiased; 93 of 100 is what intervals of 95 % must hold.
            assert!((0.95..1.05).contains(&ratio), "{round}: {ratio}");
            assert!(held[round] >= 93 && decibels[round] >= 93, "{round}: {} and {} of {SEEDS}", held[round], decibels[round]);
        }
        assert!(stated[2][0] < stated[0][0] / 3.0, "12 seeds have less than a third of the mean square of 4");
    }

    #[test]
    fn a_new_view_starts_anew_and_new_colours_do_not() {
        let near = renderer(1, [16, 8], Some(above(12.0, -3.0, 1.0)));
        let mut picture = MapPicture::default();
        let mut seeds = |renderer: &Renderer| picture.refine(renderer, 2.0, &mut Field(ridges), None, &NEVER).unwrap().2.samples_per_pixel;
        assert_eq!([seeds(&near), seeds(&near)], [2.0, 4.0]);
        let mut scene = near.scene().clone();
        scene.transfer.high = Some(2.0);
        let mut other = near.clone();
        other.set_scene(scene).unwrap();
        assert_eq!(seeds(&other), 6.0);
        assert_eq!(seeds(&renderer(1, [16, 8], Some(above(12.5, -3.0, 1.0)))), 2.0);
    }

    #[test]
    fn land_and_the_outside_have_no_value() {
        // Twice the domain, the west of which is land.
        let renderer = renderer(1, [16, 8], Some(above(12.0, -3.0, 4.0)));
        let mut field = Field(|x, _| (x > 11.0).then_some(1.0));
        let (film, stats, error) = MapPicture::default().refine(&renderer, 16.0, &mut field, None, &NEVER).unwrap();
        let pixel = |x: usize, y: usize| (film.ftle_mean[8 * 2 * y + x], film.missing[16 * y + x], film.rgba[16 * y + x]);
        assert!(pixel(0, 0).0.is_nan() && pixel(0, 0).2 == [1.0, 1.0, 1.0, 0.0], "outside: {:?}", pixel(0, 0));
        assert!(pixel(4, 3).0.is_nan() && pixel(4, 3).1 == 1.0 && pixel(4, 3).2 == [0.3, 0.3, 0.3, 0.0], "land: {:?}", pixel(4, 3));
        assert_eq!((pixel(8, 4).0, pixel(8, 4).1), (0.5, 0.0));
        assert_eq!(stats.missing, 2 * 4 * 16, "two columns of four pixels");
        // No difference seen is not no error.
        assert!(error.rms.value == 0.0 && error.rms.high > 0.0, "{error:?}");
        assert!(film.error.iter().zip(&film.ftle_mean).all(|(error, value)| error.is_nan() == value.is_nan()));
    }

    #[test]
    fn what_was_stopped_is_not_shown() {
        let renderer = renderer(1, [16, 8], None);
        let mut picture = MapPicture::default();
        assert!(picture.refine(&renderer, 2.0, &mut Field(ridges), None, &AtomicBool::new(true)).is_none());
        assert_eq!(picture.refine(&renderer, 2.0, &mut Field(ridges), None, &NEVER).unwrap().2.samples_per_pixel, 2.0);
    }
}
