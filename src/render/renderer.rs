//! The renderer: a checked scene, its majorants, and the loop over waves.

use super::error::{RenderError, require};
use super::film::Film;
use super::majorant::MajorantGrid;
use super::parameters::{FrameParameters, FrameSetup, SeenInCells};
use super::rng::FrameRandom;
use super::space::SceneBox;
use super::tracking::FrameScene;
use super::wavefront::{Lane, Schedule, Tally, collect};
use super::{Camera, Light, LogStretch, Scene, Transfer};
use crate::field::Domain;
use rayon::prelude::*;
use std::ops::Range;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;

/// Flights of a lane: small enough for a core's cache.
const LANE_FLIGHTS: usize = 1024;
/// Flights of a wave, unless chosen otherwise.
const WAVE_FLIGHTS: usize = 1 << 17;

/// What a frame took.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct RenderStats {
    /// Paths that ended.
    pub paths: u64,
    /// Log-stretch queries.
    pub queries: u64,
    /// Of them, answered by RK4.
    pub traced: u64,
    /// Of them, without a value (land).
    pub missing: u64,
    /// Queries whose extinction exceeded the majorant in force.
    pub majorant_exceeded: u64,
    /// Points that were answered besides, ahead of flights that ended before them.
    pub ahead: u64,
    /// Calls of [`LogStretch::evaluate`].
    pub waves: u64,
    /// Wall-clock seconds of walking, accepting and summing.
    pub walk_seconds: f64,
    /// Wall-clock seconds inside [`LogStretch::evaluate`].
    pub evaluate_seconds: f64,
    /// Both by a device's own clock, where it did them; 0 otherwise.
    pub device_seconds: f64,
    /// Whether `stop` ended the frame early: pixels that were not finished have 0 samples.
    pub stopped: bool,
}

/// Renders frames of one scene. Keeps the majorants from frame to frame.
#[derive(Debug, Clone)]
pub struct Renderer {
    scene: Scene,
    domain: Domain,
    per_tau: f32,
    camera: Camera,
    light: Light,
    transfer: Transfer,
    space: SceneBox,
    majorants: MajorantGrid,
    last_frame: Option<u64>,
    wave_flights: usize,
}

impl Renderer {
    /// A renderer for FTLE = s / `tau` over `domain`. Everything in the scene is checked.
    pub fn new(scene: Scene, domain: &Domain, tau: f64) -> Result<Self, RenderError> {
        require(tau.is_finite() && tau > 0.0, "time.tau", tau, "a finite number above 0")?;
        scene.check(domain)?;
        let camera = Camera::new(&scene.camera, scene.aspect())?;
        let light = Light::new(&scene.light)?;
        let transfer = Transfer::new(&scene.transfer, scene.shortest_edge(domain))?;
        // Beyond this, f32 cannot tell one tentative collision from the next, and a flight might never end.
        let depth = f64::from(transfer.extinction_max()) * scene.diagonal(domain);
        let deep = "at most an optical depth of 100000 over the box's diagonal";
        require(depth <= 1e5, "transfer.extinction", transfer.extinction_max(), deep)?;
        let cells = scene.settings.majorant_cells.unwrap_or_else(|| MajorantGrid::default_cells(domain, scene.scale));
        let space = SceneBox::new(domain, scene.scale, cells);
        let majorants = MajorantGrid::new(cells, &transfer);
        Ok(Self {
            domain: domain.clone(),
            per_tau: (1.0 / tau) as f32,
            camera,
            light,
            transfer,
            space,
            majorants,
            last_frame: None,
            wave_flights: WAVE_FLIGHTS,
            scene,
        })
    }

    /// The same with at most this many flights (rounded up to whole lanes of 1024) in a wave, and so points in a batch. The picture
    /// does not depend on it.
    pub fn with_wave_flights(mut self, flights: usize) -> Self {
        self.wave_flights = flights.clamp(1, 1 << 22);
        self
    }

    /// The scene.
    pub fn scene(&self) -> &Scene {
        &self.scene
    }

    /// The transfer function in force.
    pub fn transfer(&self) -> &Transfer {
        &self.transfer
    }

    /// The majorants in force.
    pub fn majorants(&self) -> &MajorantGrid {
        &self.majorants
    }

    /// Changes the scene between frames. Majorants are re-derived from the FTLE seen so far; they start anew only when their cells
    /// change. On error everything is as before.
    pub fn set_scene(&mut self, scene: Scene) -> Result<(), RenderError> {
        let mut next = Self::new(scene, &self.domain, f64::from(1.0 / self.per_tau))?;
        next.wave_flights = self.wave_flights;
        next.per_tau = self.per_tau;
        next.last_frame = self.last_frame;
        if next.space.cells() == self.space.cells() {
            std::mem::swap(&mut next.majorants, &mut self.majorants);
            next.majorants.commit(&next.transfer);
        }
        *self = next;
        Ok(())
    }

    /// Tells the majorants of log-stretch values known from elsewhere (a traced table, audit points; domain coordinates), from the next
    /// frame on. A renderer that has seen nothing makes several times the queries in its first frame.
    pub fn observe(&self, points: &[[f32; 3]], log_stretch: &[f32]) {
        points.par_iter().with_min_len(1 << 12).zip(log_stretch).for_each(|(point, &s)| {
            let cell = self.majorants.cell_at(self.space.grid_of_domain(*point));
            if s.is_finite() { self.majorants.observe(cell, s * self.per_tau) } else { self.majorants.observe_missing(cell) }
        });
    }

    /// To be called when the window slides: majorants loosen, since the field has changed.
    pub fn window_slid(&mut self) {
        self.majorants.slide(&self.transfer);
    }

    /// Renders samples 0 to `samples` of every pixel. The film depends on scene, frame number, answers and majorants (what earlier
    /// frames have seen), not on the number of threads. Walks on rayon's current pool; `answers` is called on this thread.
    /// `progress` hears the share of paths done after each wave; setting `stop` ends the frame after the wave in progress.
    pub fn render(
        &mut self,
        frame: u64,
        answers: &mut dyn LogStretch,
        samples: usize,
        progress: Option<&dyn Fn(f32)>,
        stop: &AtomicBool,
    ) -> Result<(Film, RenderStats), RenderError> {
        let end = u32::try_from(samples).unwrap_or(u32::MAX);
        self.render_samples(frame, 0..end, answers, progress, stop)
    }

    /// Checks the range of samples and, when the frame is a new one, puts into force what the frames before have seen.
    fn begin(&mut self, frame: u64, samples: &Range<u32>) -> Result<(), RenderError> {
        const LIMIT: u32 = 1 << 24;
        if samples.end > LIMIT || samples.start >= samples.end {
            return Err(RenderError::Samples { first: samples.start, end: samples.end, limit: LIMIT });
        }
        if self.last_frame != Some(frame) {
            self.majorants.commit(&self.transfer);
        }
        self.last_frame = Some(frame);
        Ok(())
    }

    /// What an engine needs that tracks the paths of these samples itself; it hands what it saw to [`Self::absorb`].
    pub fn set_up(&mut self, frame: u64, samples: Range<u32>) -> Result<FrameSetup<'_>, RenderError> {
        self.begin(frame, &samples)?;
        let settings = &self.scene.settings;
        let colours = [settings.background, settings.missing_color].map(|colour| colour.map(|c| c as f32));
        Ok(FrameSetup {
            parameters: FrameParameters::new(
                &self.camera,
                &self.light,
                &self.transfer,
                &self.space,
                &FrameRandom::new(self.scene.seed, frame),
                [settings.width, settings.height],
                colours,
                self.per_tau,
            ),
            majorants: self.majorants.majorants(),
            may_miss: self.majorants.may_miss_all(),
        })
    }

    /// Takes in what an engine saw while it tracked a frame; takes effect with the next. False when it is not of this grid.
    #[must_use]
    pub fn absorb(&self, seen: &SeenInCells) -> bool {
        self.majorants.absorb(seen)
    }

    /// Renders a range of a frame's samples, to be merged with others by [`Film::accumulate`]: later passes, or other ranks. All
    /// ranges of a frame see the same majorants; what they observe takes effect when another frame begins.
    pub fn render_samples(
        &mut self,
        frame: u64,
        samples: Range<u32>,
        answers: &mut dyn LogStretch,
        progress: Option<&dyn Fn(f32)>,
        stop: &AtomicBool,
    ) -> Result<(Film, RenderStats), RenderError> {
        self.begin(frame, &samples)?;
        let settings = &self.scene.settings;
        let scene = FrameScene {
            camera: &self.camera,
            light: &self.light,
            transfer: &self.transfer,
            space: &self.space,
            majorants: &self.majorants,
            random: FrameRandom::new(self.scene.seed, frame),
            width: settings.width,
            height: settings.height,
            background: settings.background.map(|c| c as f32),
            missing: settings.missing_color.map(|c| c as f32),
            per_tau: self.per_tau,
        };
        let mut film = Film::new(settings.width, settings.height);
        let mut stats = RenderStats::default();
        let count = samples.end - samples.start;
        let paths = film.samples.len() as u64 * u64::from(count);
        let lane_flights = LANE_FLIGHTS.min(self.wave_flights);
        let lane_count = self.wave_flights.div_ceil(lane_flights).min(paths.div_ceil(lane_flights as u64) as usize);
        let mut lanes: Vec<Lane> = std::iter::repeat_with(|| Lane::new(lane_flights)).take(lane_count).collect();
        let mut schedule = Schedule::new(film.samples.len() as u32, count);
        let (mut points, mut log_stretch, mut traced) = (Vec::new(), Vec::new(), Vec::new());
        loop {
            let began = Instant::now();
            schedule.deal(&mut lanes, count);
            advance(&mut lanes, &scene, &log_stretch, &traced, &samples);
            collect(&mut lanes, &mut film);
            gather(&lanes, &mut points);
            stats.walk_seconds += began.elapsed().as_secs_f64();
            if let Some(progress) = progress {
                let done: u64 = lanes.iter().map(|lane| lane.tally.paths).sum();
                progress((done as f64 / paths as f64) as f32);
            }
            if schedule.is_over(&lanes) {
                break;
            }
            if stop.load(Ordering::Relaxed) {
                stats.stopped = true;
                break;
            }
            log_stretch.resize(points.len(), 0.0);
            traced.resize(points.len(), false);
            if points.is_empty() {
                continue;
            }
            let began = Instant::now();
            answers.evaluate(&points, &mut log_stretch, &mut traced);
            stats.evaluate_seconds += began.elapsed().as_secs_f64();
            stats.waves += 1;
        }
        let total = lanes.iter().fold(Tally::default(), |a, lane| a + lane.tally);
        stats.paths = total.paths;
        stats.queries = total.queries;
        stats.traced = total.traced;
        stats.missing = total.missing;
        stats.majorant_exceeded = total.exceeded;
        Ok((film, stats))
    }
}

/// Hands each lane its part of the answers.
fn advance(lanes: &mut [Lane], scene: &FrameScene, log_stretch: &[f32], traced: &[bool], samples: &Range<u32>) {
    let mut end = 0;
    let parts: Vec<Range<usize>> = lanes
        .iter()
        .map(|lane| {
            let first = end;
            end += lane.points.len();
            first..end
        })
        .collect();
    lanes.par_iter_mut().zip(parts).for_each(|(lane, own)| lane.advance(scene, &log_stretch[own.clone()], &traced[own], samples));
}

/// Puts the lanes' points into one batch.
fn gather(lanes: &[Lane], points: &mut Vec<[f32; 3]>) {
    points.clear();
    lanes.iter().for_each(|lane| points.extend_from_slice(&lane.points));
}
