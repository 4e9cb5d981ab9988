//! A picture that accumulates on the CPU: rays marched through the surrogate, and pairs of coupled samples where the variance is.

use super::allocation::{Allocation, TILE, pixels, quarter, tiles};
use super::combine::{Combined, Correction, PairSums, combine};
use super::coupled::track;
use super::light_volume::LightVolume;
use super::march::{RaySum, ToLight};
use super::march_control::{AUDIT_STEPS, AuditedPixel, LIGHT_STEPS, LIT_BY_MARCH, MarchControl, Marching, NET, PAIR};
use super::medium::{IsMissing, Medium};
use super::nodes::Nodes;
use super::regression::Guides;
use super::statement::{LIT, PictureError, StepsError, TileErrors, TileSums, error_at, errors_of_tiles};
use super::tone::ToneMap;
use crate::renderer::RenderStats;
use crate::rng::FrameRandom;
use crate::tracking::FrameScene;
use crate::{Film, LogStretch, Method, Scene};
use rayon::prelude::*;
use ridgewatch_base::progress::{self, Work};
use std::ops::Range;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::time::Instant;

/// Largest number of values of the light volume on the CPU.
const LIGHT_VALUES: usize = 1 << 24;
/// Pairs per pixel that measure the error of a marched picture.
pub const AUDIT_PAIRS: f64 = 1.0 / 16.0;
/// Pairs of paths that are tracked at a time, which bounds the memory of a round.
const MAX_PAIRS: usize = 1 << 19;
/// Seconds of marching that a round may take at least, and the same as a share of the seconds that it has. It may also take as long as its samples.
const MIN_MARCH_SECONDS: f64 = 0.1;
const MIN_MARCH_SHARE: f64 = 0.1;
/// Pixels of which one leaves a mark of progress.
const MARKED: usize = 1 << 10;

/// One round of refinement.
pub struct Refinement<'a> {
    /// The surrogate.
    pub nodes: &'a Nodes,
    /// Missing cells; `None` if every cell has data.
    pub missing: Option<IsMissing<'a>>,
    /// [`Method::Marched`] or [`Method::TwoLevel`].
    pub method: Method,
    /// Add the correction as it is, without shrinkage.
    pub sum: bool,
    /// Coupled samples per pixel, on average.
    pub samples: f64,
    /// Seconds that the round should take, if they are limited.
    pub budget: Option<f64>,
    /// Error of the Runge-Kutta steps, which the picture states too.
    pub steps_error: StepsError,
    /// Number that selects the random stream when the picture starts anew.
    pub number: u64,
    /// Setting it ends the round early, without a film; the picture then starts anew.
    pub stop: &'a AtomicBool,
}

impl Refinement<'_> {
    /// Returns true if the mean of such pictures over seeds is to be that of the traced field.
    fn is_mended(&self) -> bool {
        self.sum && self.method == Method::TwoLevel
    }
}

/// An accumulating picture.
#[derive(Debug, Clone, Default)]
pub struct Picture {
    /// Scene, 1 / tau and nodes that it shows; `None` before the first round.
    shows: Option<(Scene, f32, Nodes)>,
    /// Random stream: the number of the round at which it started.
    number: u64,
    march: MarchControl,
    /// Seconds that marching may take before it waits for the time of further rounds: below 0 it has taken more.
    credit: f64,
    /// Seconds of the latest rays, for one a pixel.
    ray_seconds: Option<f64>,
    light: Option<LightVolume>,
    /// Sums over all rays, per pixel.
    base: Vec<RaySum>,
    sums: Vec<PairSums>,
    pairs: u64,
    allocation: Allocation,
}

impl Picture {
    /// Starts anew if the picture shows anything else.
    fn settle(&mut self, scene: &Scene, inverse_tau: f32, nodes: &Nodes, number: u64) {
        let march = match &self.shows {
            Some((shown, tau, old)) if shown == scene && *tau == inverse_tau => {
                if std::ptr::eq(old.values(), nodes.values()) {
                    return;
                }
                // A surrogate that has learned lies on the same ones.
                if old.shape() == nodes.shape() { self.march.restarted() } else { self.march.on_other_nodes() }
            }
            _ => self.march.restarted(),
        };
        let (width, height) = (scene.settings.width, scene.settings.height);
        *self = Self {
            shows: Some((scene.clone(), inverse_tau, nodes.clone())),
            number,
            march,
            credit: 0.0,
            ray_seconds: self.ray_seconds,
            light: None,
            base: vec![RaySum::default(); width * height],
            sums: vec![PairSums::default(); width * height],
            pairs: 0,
            allocation: Allocation::new(width, height),
        };
    }

    /// One round: more rays, more pairs, and the picture with its error. `None` if `stop` ended it early.
    pub fn refine(
        &mut self,
        frame: &FrameScene<'_>,
        scene: &Scene,
        round: &Refinement<'_>,
        wave_flights: usize,
        answers: &mut dyn LogStretch,
    ) -> Option<(Film, RenderStats, PictureError)> {
        let began = Instant::now();
        let (width, height) = (frame.width, frame.height);
        self.settle(scene, frame.inverse_tau, round.nodes, round.number);
        let frame = &FrameScene { random: FrameRandom::new(scene.seed, self.number), ..*frame };
        let medium = Medium { scene: frame, nodes: round.nodes, missing: round.missing };
        let tone_map = ToneMap::new(scene.settings.tone_map);
        let mut begins = self.march.rays == 0;
        self.march.begin(round.samples);
        if let (true, Some(budget)) = (begins, round.budget) {
            self.march_at_most(budget);
        }
        let mut marching = 0.0;
        if begins || round.budget.is_none() || self.credit >= 0.0 {
            marching += self.march(&medium, tone_map, round);
        }
        let sampling = Instant::now();
        let Some(mut stats) = self.sample(&medium, round, wave_flights, answers) else { return self.stopped() };
        stats.sample_seconds = sampling.elapsed().as_secs_f64();
        let least = round.budget.map_or(MIN_MARCH_SECONDS, |budget| MIN_MARCH_SECONDS.min(MIN_MARCH_SHARE * budget));
        // Without a budget each round is on its own. With one, it pays what earlier ones took.
        let before = round.budget.map_or(0.0, |_| self.credit.min(0.0));
        let allowed = before + stats.sample_seconds.max(least);
        let how = match (round.method, round.sum) {
            (Method::Marched, _) => Correction::Left,
            (_, true) => Correction::Summed,
            (_, false) => Correction::Shrunk,
        };
        let combined = combine(&self.sums, &Guides::new(&self.base, self.march.rays, width), how);
        let (film, error) = loop {
            let (film, error, tiles) = self.film(scene, [width, height], how, &combined, &round.steps_error);
            // Samples that go where earlier ones saw a difference would make their mean biased (Kirk and Arvo 1991).
            if !round.is_mended() {
                self.allocation.learn(tiles.iter().map(TileSums::sample_variance));
            }
            let others = error.rms.value.powi(2) - self.march.error();
            if round.stop.load(Ordering::Relaxed) {
                return self.stopped();
            }
            match self.march.decide(others, marching < allowed) {
                Marching::Enough => break (film, error),
                Marching::Anew => {
                    begins = true;
                    self.light = None;
                    self.base.fill(RaySum::default());
                }
                Marching::More => {}
            }
            if round.budget.is_some() {
                self.march_at_most(allowed - marching);
            }
            marching += self.march(&medium, tone_map, round);
        };
        if round.budget.is_some() {
            (stats.march_seconds, stats.march_goes_on) = (marching, self.march.is_due() || allowed < marching);
        }
        // What is needed for a picture at all is not paid back.
        self.credit = if begins || round.budget.is_none() { 0.0 } else { allowed - marching };
        stats.walk_seconds = began.elapsed().as_secs_f64() - stats.evaluate_seconds;
        Some((film, stats, error))
    }

    /// As many rays as it had on other nodes, or as many again, may take too long at once.
    fn march_at_most(&mut self, seconds: f64) {
        if let Some(each) = self.ray_seconds {
            self.march.at_most((seconds / each) as u64);
        }
    }

    /// Ends a round early: rays may be missing, so that nothing of the picture is kept.
    fn stopped<T>(&mut self) -> Option<T> {
        self.shows = None;
        None
    }

    /// Marches more rays, and compares some pixels with a finer march. Returns the seconds that it took. `stop` ends it early.
    fn march(&mut self, medium: &Medium<'_>, tone_map: ToneMap, round: &Refinement<'_>) -> f64 {
        if !self.march.is_due() {
            return 0.0;
        }
        let began = Instant::now();
        let (work, done) = (Work::begin("marching rays"), AtomicUsize::new(0));
        let refine = self.march.refine();
        let light = &*self.light.get_or_insert_with(|| LightVolume::new(medium, LIGHT_VALUES, refine));
        let step = medium.spacing() as f32 * self.march.step;
        let audited = self.march.audit_pixels(&medium.scene.random, self.base.len());
        let rays = self.march.rays..self.march.rays + self.march.next_rays;
        let mended = round.is_mended();
        let all = self.base.len();
        let marched = |pixel: u32, j: u64| match mended {
            true => medium.mended_ray(pixel, j, step, light),
            false => medium.ray(pixel, j, step, ToLight::Volume(light), false),
        };
        self.base.par_iter_mut().enumerate().with_min_len(64).for_each(|(pixel, sum)| {
            if pixel % MARKED == 0 {
                work.reached(done.fetch_add(MARKED, Ordering::Relaxed).min(all), all);
            }
            for j in rays.clone().take_while(|_| !round.stop.load(Ordering::Relaxed)) {
                sum.add(&marched(pixel as u32, j));
            }
        });
        let count = rays.end - rays.start;
        self.march.rays = rays.end;
        let mean = |rays: Range<u64>, ray: &dyn Fn(u64) -> RaySum| {
            let (mut sum, count) = (RaySum::default(), (rays.end - rays.start) as f64);
            rays.take_while(|_| !round.stop.load(Ordering::Relaxed)).for_each(|j| sum.add(&ray(j)));
            progress::mark();
            sum.radiance.map(|c| f64::from(c) / count)
        };
        let per_ray = 1.0 / self.march.rays as f64;
        let shown = |sum: &RaySum| {
            let [red, green, blue] = sum.radiance;
            [red, green, blue, sum.alpha].map(|c| f64::from(c) * per_ray)
        };
        let (fine, firsts) = (step / AUDIT_STEPS as f32, self.march.nets());
        let look = |&pixel: &u32| {
            let net = |first: u64| mean(first..first + NET, &|j| marched(pixel, j));
            let nets = firsts.map(net);
            let found = AuditedPixel { pixel, shown: shown(&self.base[pixel as usize]), nets, ..AuditedPixel::default() };
            if mended {
                // What steps and light volume err, mended rays scatter.
                return found;
            }
            let [pair, fine] = [step, fine].map(|step| mean(0..PAIR, &|j| medium.ray(pixel, j, step, ToLight::Volume(light), false)));
            AuditedPixel { pair, fine, ..found }
        };
        let mut compared: Vec<AuditedPixel> = audited.par_iter().map(look).collect();
        let mut lit: Vec<&mut AuditedPixel> = compared.iter_mut().filter(|pixel| pixel.is_lit() && !mended).take(LIT_BY_MARCH).collect();
        lit.par_iter_mut().for_each(|audited| {
            let to_light = ToLight::March(step / LIGHT_STEPS as f32);
            audited.lit = Some(mean(0..PAIR, &|j| medium.ray(audited.pixel, j, fine, to_light, false)));
        });
        for pixel in self.march.audited_mut() {
            pixel.shown = shown(&self.base[pixel.pixel as usize]);
        }
        self.march.audit(compared, tone_map);
        let seconds = began.elapsed().as_secs_f64();
        if count > 0 {
            self.ray_seconds = Some(seconds / count as f64);
        }
        seconds
    }

    /// Tracks pairs of coupled paths. `None` if `stop` ended it early.
    fn sample(
        &mut self,
        medium: &Medium<'_>,
        round: &Refinement<'_>,
        wave_flights: usize,
        answers: &mut dyn LogStretch,
    ) -> Option<RenderStats> {
        let (width, height) = (medium.scene.width, medium.scene.height);
        let pairs_per_pixel = if round.method == Method::Marched { AUDIT_PAIRS } else { round.samples / 2.0 };
        let mut allocation = self.allocation.clone();
        let plan = allocation.next(pairs_per_pixel);
        let mut chosen = pixels(&plan, width, height).peekable();
        // Number of each pair within its pixel, which selects its random numbers.
        let mut next: Vec<u32> = self.sums.iter().map(PairSums::pairs).collect();
        let mut stats = RenderStats::default();
        let (work, all) = (Work::begin("drawing samples"), 2 * plan.iter().map(|tile| tile.pairs).sum::<usize>());
        let mut paths = Vec::new();
        while chosen.peek().is_some() {
            paths.clear();
            for pixel in chosen.by_ref().take(MAX_PAIRS) {
                let number = &mut next[pixel as usize];
                paths.extend([(pixel, 2 * *number), (pixel, 2 * *number + 1)]);
                *number += 1;
            }
            let before = stats.paths as usize;
            let reached = |paths: usize| work.reached(before + paths, all);
            let (found, counts) = track(medium, &paths, wave_flights, answers, round.stop, &reached);
            if counts.stopped {
                return None;
            }
            stats.paths += paths.len() as u64;
            stats.majorant_exceeded += counts.exceeded;
            stats.missing += counts.missing;
            stats.waves += counts.waves;
            stats.evaluate_seconds += counts.evaluate_seconds;
            for (paths, halves) in paths.chunks_exact(2).zip(found.chunks_exact(2)) {
                let (pixel, pair) = (paths[0].0 as usize, paths[0].1 as usize / 2);
                let sums = &mut self.sums[pixel];
                let quarter = quarter(pixel % width, pixel / width, pair);
                for (half, difference) in halves.iter().enumerate() {
                    (0..3).for_each(|k| sums.radiance[half][quarter][k] += difference.radiance[k]);
                    sums.alpha += difference.alpha;
                    sums.queries += difference.queries;
                    sums.traced += difference.traced;
                    stats.queries += u64::from(difference.queries);
                    stats.traced += u64::from(difference.traced);
                }
                sums.pairs[quarter] += 1;
            }
        }
        self.pairs += stats.paths / 2;
        self.allocation = allocation;
        Some(stats)
    }

    fn film(
        &self,
        scene: &Scene,
        [width, height]: [usize; 2],
        how: Correction,
        combined: &Combined,
        steps: &StepsError,
    ) -> (Film, PictureError, Vec<TileSums>) {
        let mut film = Film::new(width, height);
        let per_ray = 1.0 / self.march.rays as f32;
        for i in 0..width * height {
            let (base, sums, r) = (&self.base[i], &self.sums[i], combined.correction[i]);
            let [red, green, blue] = [0, 1, 2].map(|k| base.radiance[k] * per_ray + r[k]);
            film.rgba[i] = [red, green, blue, base.alpha * per_ray];
            if how == Correction::Summed {
                film.rgba[i][3] += sums.alpha / (2 * sums.pairs().max(1)) as f32;
            }
            film.ftle_mean[i] = if base.alpha > 0.0 { base.ftle / base.alpha } else { f32::NAN };
            film.missing[i] = base.missing * per_ray;
            film.samples[i] = 2.0 * sums.pairs() as f32;
            film.queries[i] = sums.queries as f32;
            film.traced[i] = if sums.queries > 0 { sums.traced as f32 / sums.queries as f32 } else { 0.0 };
        }
        let tiles = self.tile_sums(scene, &film, combined);
        let samples_per_pixel = 2.0 * self.pairs as f64 / (width * height) as f64;
        let march = self.march.error();
        // A pixel without pairs shows the march of the surrogate.
        let unbiased = how == Correction::Summed && self.allocation.covers_every_pixel();
        let error = PictureError { unbiased, ..PictureError::of(&tiles, &self.march.errors(), steps, samples_per_pixel, self.march.rays) };
        let (of_tiles, across) = (errors_of_tiles(&tiles), width.div_ceil(TILE));
        let of_pixel = |(i, colour): (usize, &[f32; 4])| {
            let is_lit = colour[3] > LIT;
            // Those that are not lit have hardly any of it but at the edges of land, which are few.
            let marched = if is_lit { (march + steps.squared[0]) as f32 } else { 0.0 };
            (error_at(&of_tiles, across, [i % width, i / width], is_lit) + marched).sqrt()
        };
        film.error = film.rgba.par_iter().enumerate().with_min_len(1 << 12).map(of_pixel).collect();
        (film, error, tiles)
    }

    /// Sums of the squared errors of each tile.
    fn tile_sums(&self, scene: &Scene, film: &Film, combined: &Combined) -> Vec<TileSums> {
        let tone_map = ToneMap::new(scene.settings.tone_map);
        let per_ray = 1.0 / self.march.rays as f32;
        let (width, height) = (film.width, film.height);
        let [across, down] = tiles(width, height);
        let of_tile = |tile: usize| {
            let (left, top) = (tile % across * TILE, tile / across * TILE);
            let mut sums = TileSums::default();
            for i in (top..(top + TILE).min(height)).flat_map(|y| (y * width + left)..(y * width + (left + TILE).min(width))) {
                let colour = film.rgba[i];
                let [squared, scatter] = combined.squared[i];
                if squared[0].is_nan() {
                    continue;
                }
                let pairs = self.sums[i].pairs() as f32;
                let radiance: [f32; 3] = std::array::from_fn(|k| colour[k] * colour[k]);
                let toned = combined.squared_in(Some(tone_map), i, &self.sums[i], self.base[i].radiance.map(|c| c * per_ray));
                let mean = |e: [f32; 3], weight: &dyn Fn(f32) -> f32| (0..3).map(|k| e[k] * weight(colour[k])).sum::<f32>() / 3.0;
                let weighted = |e: [f32; 3], toned: f32| [mean(e, &|_| 1.0), mean(e, &|c| 1.0 / (c * c + 0.01)), toned];
                let found = [
                    weighted(squared, mean(toned[0], &|_| 1.0)),
                    weighted(scatter, mean(toned[1], &|_| 1.0)),
                    weighted(radiance, mean(radiance, &|c| tone_map.slope(c).powi(2))),
                ];
                let add = |errors: &mut TileErrors| {
                    for (sums, found) in [&mut errors.squared, &mut errors.scatter, &mut errors.radiance].into_iter().zip(found) {
                        (0..3).for_each(|weighting| sums[weighting] += found[weighting]);
                    }
                    errors.pixels += 1.0;
                    errors.pairs += pairs;
                };
                add(&mut sums.all);
                if colour[3] > LIT {
                    add(&mut sums.lit);
                }
                sums.variance += self.sums[i].sample_variance();
            }
            sums
        };
        (0..across * down).into_par_iter().map(of_tile).collect()
    }
}
