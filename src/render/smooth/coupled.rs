//! Coupled paths: tracking of the traced field less tracking of the surrogate, on the same random numbers.
//!
//! Both fields see the same tentative collisions, the same acceptance numbers and the same light rays, under one majorant, until one of them
//! scatters where the other does not. The mean of the difference is the error of the surrogate's expected picture; its variance is small where
//! the fields agree. This is a two-level estimator (Giles 2015) with delta and ratio tracking (see [`crate::render`]) as the path sampler. Each
//! field has weights of its own where its extinction exceeds the majorant, so that the estimate stays unbiased; from there on the path takes the
//! largest extinction for its majorant (see [`crate::tracking`]).

use super::medium::{IsMissing, Medium};
use super::nodes::Nodes;
use crate::rng::unit;
use crate::tracking::{FrameScene, Hit, PHASE, ROULETTE, walk};
use crate::{GridPoint, LogStretch};
use rayon::prelude::*;
use ridgewatch_base::progress;
use ridgewatch_field::DomainPoint;
use std::sync::atomic::{AtomicBool, Ordering};

/// Index of the traced field; the other is the surrogate, which counts negative.
const TRACED: usize = 0;
const SIGN: [f32; 2] = [1.0, -1.0];
/// Flights per parallel task.
const TASK: usize = 512;

/// Result of one coupled path: the traced field less the surrogate.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct CoupledPath {
    /// Difference of the radiances.
    pub radiance: [f32; 3],
    /// Difference of the weights of the scattering events.
    pub alpha: f32,
    /// Queries of the traced field.
    pub queries: u32,
    /// Queries that were traced by RK4.
    pub traced: u32,
}

/// One field's share of a path.
#[derive(Debug, Clone, Copy)]
struct Particle {
    /// The camera flight still goes on.
    flies: bool,
    weight: f32,
    /// The shadow flight in progress belongs to this field.
    shines: bool,
    transmittance: f32,
    /// Contribution at full transmittance.
    colour: [f32; 3],
}

/// A ray segment that is walked.
#[derive(Debug, Clone, Copy, Default)]
struct Segment {
    origin: GridPoint,
    direction: [f32; 3],
    t: f32,
    end: f32,
}

impl Segment {
    #[inline]
    fn point(&self) -> GridPoint {
        self.origin.along(self.direction, self.t)
    }
}

/// A coupled path in flight.
#[derive(Debug, Clone)]
pub(super) struct CoupledFlight {
    camera: Segment,
    /// The way to the light, while `in_shadow`.
    shadow: Segment,
    in_shadow: bool,
    particles: [Particle; 2],
    /// Least majorant: 0, and the largest extinction once a field was above the majorant.
    least_majorant: f32,
    hit: Hit,
    decision: f32,
    roulette: f32,
    pixel: u32,
    sample: u32,
    dimension: u32,
    found: CoupledPath,
}

impl CoupledFlight {
    /// Starts a path and advances it to the first tentative collision that needs the traced field. False if there is none.
    pub(super) fn start(medium: &Medium<'_>, pixel: u32, sample: u32) -> (Self, bool) {
        let scene = medium.scene;
        let [jitter_x, jitter_y, ..] = scene.random.words(pixel, sample, 0).map(|w| f64::from(unit(w)));
        let (column, row) = (pixel as usize % scene.width, pixel as usize / scene.width);
        let x = (column as f64 + jitter_x) / scene.width as f64 * 2.0 - 1.0;
        let y = 1.0 - (row as f64 + jitter_y) / scene.height as f64 * 2.0;
        let (origin, direction) = scene.camera.ray(x, y);
        let particle = Particle { flies: true, weight: 1.0, shines: false, transmittance: 0.0, colour: [0.0; 3] };
        let mut flight = Self {
            camera: Segment { direction: scene.space.grid_direction(direction), ..Segment::default() },
            shadow: Segment::default(),
            in_shadow: false,
            particles: [particle; 2],
            least_majorant: 0.0,
            hit: Hit::default(),
            decision: 0.0,
            roulette: 0.0,
            pixel,
            sample,
            dimension: 1,
            found: CoupledPath::default(),
        };
        let Some((enter, leave)) = scene.space.intersect(origin, direction) else { return (flight, false) };
        flight.camera.origin = scene.space.grid_point(std::array::from_fn(|k| origin[k] + enter * direction[k]));
        flight.camera.end = (leave - enter) as f32;
        let pending = flight.advance(medium);
        (flight, pending)
    }

    fn segment(&mut self) -> &mut Segment {
        if self.in_shadow { &mut self.shadow } else { &mut self.camera }
    }

    /// The pending collision.
    pub(super) fn point(&self, medium: &Medium<'_>) -> DomainPoint {
        medium.scene.space.domain_point(if self.in_shadow { self.shadow.point() } else { self.camera.point() })
    }

    /// The difference, once the path is over.
    pub(super) fn found(&self) -> CoupledPath {
        self.found
    }

    /// True if a field takes part in the present segment.
    fn takes_part(&self, field: usize) -> bool {
        if self.in_shadow { self.particles[field].shines } else { self.particles[field].flies }
    }

    /// Advances to the next tentative collision that needs the traced field. False if the path is over.
    fn advance(&mut self, medium: &Medium<'_>) -> bool {
        let scene = medium.scene;
        loop {
            let words = scene.random.words(self.pixel, self.sample, self.dimension);
            self.dimension += 1;
            (self.decision, self.roulette) = (unit(words[1]), unit(words[2]));
            let depth = -(1.0 - unit(words[0])).ln();
            let Segment { origin, direction, t, end } = *self.segment();
            match walk(scene.majorants, self.least_majorant, origin, direction, t, end, depth) {
                Some(hit) => {
                    self.segment().t = hit.t;
                    self.hit = hit;
                    if self.takes_part(TRACED) {
                        return true;
                    }
                    self.collide(medium, None);
                }
                None if self.in_shadow => self.end_shadow(),
                None => {
                    self.leave(medium, unit(words[3]));
                    return false;
                }
            }
            if !self.in_shadow && self.particles.iter().all(|particle| !particle.flies) {
                return false;
            }
        }
    }

    /// Ends the camera flight of a path that leaves the box.
    fn leave(&mut self, medium: &Medium<'_>, position: f32) {
        let scene = medium.scene;
        let weight: f32 = (0..2).filter(|&x| self.particles[x].flies).map(|x| SIGN[x] * self.particles[x].weight).sum();
        if weight == 0.0 {
            return;
        }
        self.camera.t = position * self.camera.end;
        let is_missing = medium.missing.is_some_and(|missing| missing(scene.space.domain_point(self.camera.point())));
        let colour = if is_missing { scene.missing } else { scene.background };
        (0..3).for_each(|k| self.found.radiance[k] += weight * colour[k]);
    }

    /// Adds what the shadow flight brings. The camera flight of the other field, if any, goes on.
    fn end_shadow(&mut self) {
        for (particle, sign) in self.particles.iter_mut().zip(SIGN) {
            if std::mem::take(&mut particle.shines) {
                (0..3).for_each(|k| self.found.radiance[k] += sign * particle.colour[k] * particle.transmittance);
            }
        }
        self.in_shadow = false;
    }

    /// Processes the answer of the traced field and advances. False if the path is over.
    #[inline]
    pub(super) fn resolve(&mut self, medium: &Medium<'_>, log_stretch: f32, traced: bool, exceeded: &mut u64) -> bool {
        self.found.queries += 1;
        self.found.traced += u32::from(traced);
        let scene = medium.scene;
        if log_stretch.is_finite() {
            let ftle = log_stretch * scene.inverse_tau;
            scene.majorants.observe(self.hit.cell as usize, ftle);
            *exceeded += u64::from(scene.transfer.extinction(ftle) > self.hit.majorant);
            self.collide(medium, Some(ftle));
        } else {
            scene.majorants.observe_missing(self.hit.cell as usize);
        }
        if !self.in_shadow && self.particles.iter().all(|particle| !particle.flies) {
            return false;
        }
        self.advance(medium)
    }

    /// Decides what happens at the pending collision. `traced` is the FTLE of the traced field, if it takes part.
    fn collide(&mut self, medium: &Medium<'_>, traced: Option<f32>) {
        let scene = medium.scene;
        let grid = if self.in_shadow { self.shadow.point() } else { self.camera.point() };
        let ask = |x: usize| if x == TRACED { traced } else { medium.ftle(scene.space.unit_of_grid(grid)) };
        let ftle: [Option<f32>; 2] = std::array::from_fn(|x| if self.takes_part(x) { ask(x) } else { None });
        let ratio = ftle.map(|ftle| ftle.map(|ftle| scene.transfer.extinction(ftle) / self.hit.majorant));
        if ratio.iter().flatten().any(|&ratio| ratio > 1.0) {
            self.least_majorant = scene.transfer.extinction_max();
        }
        if self.in_shadow {
            self.attenuate(ratio);
            return;
        }
        let mut scattered = false;
        for x in 0..2 {
            let (Some(ftle), Some(ratio)) = (ftle[x], ratio[x]) else { continue };
            let particle = &mut self.particles[x];
            let real = if ratio <= 1.0 { ratio } else { ratio / (2.0 * ratio - 1.0) };
            if self.decision >= real {
                if ratio > 1.0 {
                    particle.weight *= 1.0 - 2.0 * ratio;
                }
                continue;
            }
            if ratio > 1.0 {
                particle.weight *= 2.0 * ratio - 1.0;
            }
            let (_, _, radiance) = scene.light.seen_from(scene.space.scene_point(grid));
            let albedo = scene.transfer.albedo(ftle);
            particle.colour = std::array::from_fn(|k| albedo[k] * radiance[k] * (PHASE * particle.weight));
            self.found.alpha += SIGN[x] * particle.weight;
            (particle.flies, particle.shines, particle.transmittance) = (false, true, 1.0);
            scattered = true;
        }
        if scattered {
            let (direction, distance, _) = scene.light.seen_from(scene.space.scene_point(grid));
            let direction = scene.space.grid_direction(direction);
            let end = scene.space.exit(grid, direction).min(distance as f32);
            self.shadow = Segment { origin: grid, direction, t: 0.0, end };
            self.in_shadow = true;
        }
    }

    /// Ratio tracking of the shadow flight, with one roulette for both fields.
    fn attenuate(&mut self, ratio: [Option<f32>; 2]) {
        let mut size = 0.0_f32;
        for (particle, ratio) in self.particles.iter_mut().zip(ratio) {
            if particle.shines {
                particle.transmittance *= 1.0 - ratio.unwrap_or(0.0);
                size = size.max(particle.transmittance.abs());
            }
        }
        if size >= ROULETTE {
            return;
        }
        let ends = self.roulette * ROULETTE >= size;
        let factor = if ends { 0.0 } else { ROULETTE / size };
        self.particles.iter_mut().for_each(|particle| particle.transmittance *= factor);
        if ends {
            self.end_shadow();
        }
    }
}

/// Counts of a call of [`track`].
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct CoupledCounts {
    pub(super) exceeded: u64,
    pub(super) missing: u64,
    pub(super) waves: u64,
    pub(super) evaluate_seconds: f64,
    pub(super) stopped: bool,
}

/// Tracks one path per (pixel, sample) and returns the differences in this order. All flights advance together, in waves. `reached` gets the number of
/// paths that are complete.
pub(super) fn track(
    medium: &Medium<'_>,
    paths: &[(u32, u32)],
    wave_flights: usize,
    answers: &mut dyn LogStretch,
    stop: &AtomicBool,
    reached: &dyn Fn(usize),
) -> (Vec<CoupledPath>, CoupledCounts) {
    let mut found = Vec::with_capacity(paths.len());
    let mut counts = CoupledCounts::default();
    for paths in paths.chunks(wave_flights.max(TASK)) {
        let started: Vec<(CoupledFlight, bool)> =
            paths.par_iter().with_min_len(TASK).map(|&(pixel, sample)| CoupledFlight::start(medium, pixel, sample)).collect();
        let (mut flights, pending): (Vec<CoupledFlight>, Vec<bool>) = started.into_iter().unzip();
        let mut live: Vec<u32> = (0..flights.len() as u32).filter(|&i| pending[i as usize]).collect();
        let (mut points, mut log_stretch, mut traced) = (Vec::new(), Vec::new(), Vec::new());
        while !live.is_empty() && !stop.load(Ordering::Relaxed) {
            progress::mark();
            points.clear();
            points.extend(live.iter().map(|&i| flights[i as usize].point(medium)));
            log_stretch.resize(points.len(), 0.0);
            traced.resize(points.len(), false);
            let began = std::time::Instant::now();
            answers.evaluate(&points, &mut log_stretch, &mut traced);
            counts.evaluate_seconds += began.elapsed().as_secs_f64();
            counts.waves += 1;
            counts.missing += log_stretch.iter().filter(|s| !s.is_finite()).count() as u64;
            // Answers are in the order of `live`, which is ascending.
            let mut pending = live.iter().zip(log_stretch.iter().zip(&traced)).peekable();
            let mut work: Vec<(&mut CoupledFlight, f32, bool)> = Vec::with_capacity(live.len());
            for (i, flight) in flights.iter_mut().enumerate() {
                if let Some((_, (&s, &t))) = pending.next_if(|(live, _)| **live as usize == i) {
                    work.push((flight, s, t));
                }
            }
            let results: Vec<(bool, u64)> = work
                .into_par_iter()
                .with_min_len(TASK)
                .map(|(flight, log_stretch, traced)| {
                    let mut exceeded = 0;
                    (flight.resolve(medium, log_stretch, traced, &mut exceeded), exceeded)
                })
                .collect();
            counts.exceeded += results.iter().map(|(_, exceeded)| exceeded).sum::<u64>();
            let mut next = results.iter();
            live.retain(|_| next.next().is_some_and(|(goes_on, _)| *goes_on));
        }
        if !live.is_empty() {
            counts.stopped = true;
            break;
        }
        found.extend(flights.iter().map(CoupledFlight::found));
        reached(found.len());
    }
    (found, counts)
}

/// Coupled tracking in a medium of these parts, to the end.
pub fn coupled_paths(
    scene: &FrameScene<'_>,
    nodes: &Nodes,
    missing: Option<IsMissing<'_>>,
    paths: &[(u32, u32)],
    wave_flights: usize,
    answers: &mut dyn LogStretch,
) -> Vec<CoupledPath> {
    track(&Medium { scene, nodes, missing }, paths, wave_flights, answers, &AtomicBool::new(false), &|_| ()).0
}
