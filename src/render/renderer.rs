//! The renderer: a checked scene, its majorants, and the loop over the steps of the wavefront (see [`super::tracking`] for the estimators).

use super::error::{RenderError, require};
use super::film::Film;
use super::majorant::{CellObservations, MajorantGrid};
use super::parameters::FrameParameters;
use super::rng::FrameRandom;
use super::smooth::{CoupledPath, IsMissing, Nodes, Picture, PictureError, Refinement, coupled_paths};
use super::smooth::{LightGrid, node_spacing};
use super::space::{SceneBox, length};
use super::tracking::{FrameScene, PHASE};
use super::wavefront::{FlightGroup, PathCounts, Schedule, collect};
use super::{Camera, Light, LogStretch, Scene, Transfer};
use rayon::prelude::*;
use ridgewatch_field::{Domain, DomainPoint};
use std::ops::Range;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;

/// Flights per group, which fit into the cache of a core.
const GROUP_FLIGHTS: usize = 1024;
/// Default number of flights per wave.
const WAVE_FLIGHTS: usize = 1 << 17;

/// Counts and times of a frame.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct RenderStats {
    /// Finished paths.
    pub paths: u64,
    /// Log-stretch queries.
    pub queries: u64,
    /// Queries that were traced by RK4.
    pub traced: u64,
    /// Queries in missing cells.
    pub missing: u64,
    /// Queries whose extinction exceeded the majorant.
    pub majorant_exceeded: u64,
    /// Additional points that were answered in advance for flights that ended before them.
    pub speculative_queries: u64,
    /// Calls of [`LogStretch::evaluate`].
    pub waves: u64,
    /// Wall-clock seconds of walking, accepting and summing.
    pub walk_seconds: f64,
    /// Wall-clock seconds inside [`LogStretch::evaluate`].
    pub evaluate_seconds: f64,
    /// Seconds of both by the clock of the device that tracked the frame; 0 for the CPU.
    pub device_seconds: f64,
    /// Wall-clock seconds of the coupled samples of a smooth frame; 0 for other frames.
    pub sample_seconds: f64,
    /// Wall-clock seconds of the march of a smooth frame on the CPU, within a budget; 0 for other frames.
    pub march_seconds: f64,
    /// True if that march goes on, or has taken time of frames to come.
    pub march_goes_on: bool,
    /// True if `stop` ended the frame early. Unfinished pixels have 0 samples.
    pub stopped: bool,
}

/// Input of a device that tracks the paths of a frame itself.
#[derive(Debug)]
pub struct FrameSetup<'a> {
    /// The scene.
    pub parameters: FrameParameters,
    /// The current majorants, x fastest.
    pub majorants: &'a [f32],
    /// For each cell, whether it may contain missing values.
    pub may_be_missing: &'a [bool],
}

/// Renders the frames of one scene and keeps the majorants from frame to frame.
#[derive(Debug, Clone)]
pub struct Renderer {
    scene: Scene,
    domain: Domain,
    inverse_tau: f32,
    camera: Camera,
    light: Light,
    transfer: Transfer,
    space: SceneBox,
    majorants: MajorantGrid,
    last_frame: Option<u64>,
    wave_flights: usize,
}

/// Checks a full extinction in a box with these edges, in scene units.
///
/// # Errors
/// f32 does not resolve the distance between tentative collisions, and a flight might never end.
pub fn check_depth(extinction: f64, edges: [f64; 3]) -> Result<(), RenderError> {
    require(
        extinction * length(edges) <= 1e5,
        "transfer.extinction",
        extinction,
        "at most an optical depth of 100000 over the box's diagonal",
    )
}

impl Renderer {
    /// A renderer for FTLE = s / `tau` over `domain`. Checks everything in the scene.
    ///
    /// # Errors
    /// The first key at fault and the values that it accepts.
    pub fn new(scene: Scene, domain: &Domain, tau: f64) -> Result<Self, RenderError> {
        require(tau.is_finite() && tau > 0.0, "time.tau", tau, "a finite number above 0")?;
        scene.check(domain)?;
        let camera = Camera::new(&scene.camera, scene.settings.aspect())?;
        let light = Light::new(&scene.light)?;
        let edges = scene.edges(domain);
        let transfer = Transfer::new(&scene.transfer, edges.into_iter().fold(f64::INFINITY, f64::min))?;
        check_depth(f64::from(transfer.extinction_max()), edges)?;
        let cells = scene.settings.majorant_cells.unwrap_or_else(|| MajorantGrid::default_cells(domain, scene.scale));
        let space = SceneBox::new(domain, scene.scale, cells);
        let majorants = MajorantGrid::new(cells, &transfer);
        Ok(Self {
            domain: domain.clone(),
            inverse_tau: (1.0 / tau) as f32,
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

    /// Limits the number of flights per wave, and thus of points per batch (rounded up to whole groups of 1024). The picture does not depend on
    /// it.
    pub fn with_wave_flights(mut self, flights: usize) -> Self {
        self.wave_flights = flights.clamp(1, 1 << 22);
        self
    }

    /// The scene.
    pub fn scene(&self) -> &Scene {
        &self.scene
    }

    /// True if the flow has two dimensions.
    pub(super) fn is_flat(&self) -> bool {
        self.domain.dimensions == 2
    }

    /// The current transfer function.
    pub fn transfer(&self) -> &Transfer {
        &self.transfer
    }

    /// 1 / tau, by which a log-stretch becomes an FTLE.
    pub fn inverse_tau(&self) -> f64 {
        self.inverse_tau.into()
    }

    /// Domain point in the middle of a slab that is seen through a point of the film (`x` from -1, left, to 1; `y` from -1, bottom, to 1), in the plane of
    /// the scene if there is one. `None` outside of the domain.
    pub fn map_point(&self, [x, y]: [f64; 2]) -> Option<DomainPoint> {
        let (origin, direction) = self.camera.ray(x, y);
        let along = (self.space.centre()[2] - origin[2]) / direction[2];
        let point: [f64; 3] = std::array::from_fn(|k| origin[k] + along * direction[k]);
        if !(along >= 0.0 && along.is_finite()) {
            return None;
        }
        match &self.scene.plane {
            Some(plane) => {
                let [longitude, latitude] = plane.place_in(&self.domain, [point[0], point[1]])?;
                let middle = 0.5 * (self.domain.min[2] + self.domain.max[2]);
                Some(self.space.inward([longitude, latitude, middle]))
            }
            None => self.space.point_within(point),
        }
    }

    /// Optical ramp of a log-stretch under the current transfer function: 0 where nothing is shown.
    pub fn ramp(&self, log_stretch: f32) -> f32 {
        self.transfer.ramp(log_stretch * self.inverse_tau)
    }

    /// The current majorants.
    pub fn majorants(&self) -> &MajorantGrid {
        &self.majorants
    }

    /// Changes the scene between frames. Majorants are derived anew from the FTLE observed so far; they are reset only if their cells change.
    ///
    /// # Errors
    /// As [`Self::new`]; the renderer is unchanged then.
    pub fn set_scene(&mut self, scene: Scene) -> Result<(), RenderError> {
        let mut next = Self::new(scene, &self.domain, f64::from(1.0 / self.inverse_tau))?;
        next.wave_flights = self.wave_flights;
        next.inverse_tau = self.inverse_tau;
        next.last_frame = self.last_frame;
        if next.space.cells() == self.space.cells() {
            std::mem::swap(&mut next.majorants, &mut self.majorants);
            next.majorants.commit(&next.transfer);
        }
        *self = next;
        Ok(())
    }

    /// Records log-stretch values known from elsewhere (a traced table, audit points) in the majorants, from the next frame
    /// on. Without observations the first frame needs several times as many queries.
    pub fn observe(&self, points: &[DomainPoint], log_stretch: &[f32]) {
        points.par_iter().with_min_len(1 << 12).zip(log_stretch).for_each(|(point, &s)| {
            let cell = self.majorants.cell_at(self.space.grid_of_domain(*point));
            if s.is_finite() { self.majorants.observe(cell, s * self.inverse_tau) } else { self.majorants.observe_missing(cell) }
        });
    }

    /// Loosens the majorants after a slide of the window.
    pub fn window_slid(&mut self) {
        self.majorants.slide(&self.transfer);
    }

    /// Renders samples 0 to `samples` of every pixel. The film depends on scene, frame number, answers and majorants (observations of earlier
    /// frames), not on the number of threads. Flights advance on the current rayon pool; `answers` is called on this thread. `progress` gets
    /// the share of finished paths after each wave. Setting `stop` ends the frame after the current wave.
    ///
    /// # Errors
    /// [`RenderError::Samples`] if there are no samples or too many.
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

    /// Checks the range of samples and, if the frame is new, applies the observations of earlier frames to the majorants.
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

    /// The scene of a frame, with the current majorants.
    pub fn frame_scene(&self, frame: u64) -> FrameScene<'_> {
        let settings = &self.scene.settings;
        FrameScene {
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
            inverse_tau: self.inverse_tau,
        }
    }

    /// Linear radiance of the middle of the box, in the direction of the view, if the whole box has one FTLE (1/time): what a colour bar shows.
    pub fn uniform_color(&self, ftle: f32) -> [f32; 3] {
        const SLICES: usize = 256;
        let background = self.scene.settings.background.map(|c| c as f32);
        // Whatever part of the box the view shows.
        let (_, toward) = self.camera.ray(0.0, 0.0);
        let (centre, edges) = (self.space.centre(), self.space.edges());
        let eye = std::array::from_fn(|k| centre[k] - edges.iter().sum::<f64>() * toward[k]);
        let Some((enter, leave)) = self.space.intersect(eye, toward) else { return background };
        let (extinction, albedo) = (self.transfer.extinction(ftle), self.transfer.albedo(ftle));
        let slice = (leave - enter) / SLICES as f64;
        let passed = (-extinction * slice as f32).exp();
        let (mut color, mut transmittance) = ([0.0; 3], 1.0);
        for i in 0..SLICES {
            let along = enter + (i as f64 + 0.5) * slice;
            let point = std::array::from_fn(|k| eye[k] + along * toward[k]);
            let (to_light, distance, radiance) = self.light.seen_from(point);
            let depth =
                extinction * self.space.exit(self.space.grid_point(point), self.space.grid_direction(to_light)).min(distance as f32);
            let scattered = transmittance * (1.0 - passed) * PHASE * (-depth).exp();
            (0..3).for_each(|k| color[k] += scattered * albedo[k] * radiance[k]);
            transmittance *= passed;
        }
        std::array::from_fn(|k| color[k] + transmittance * background[k])
    }

    /// Refines a picture by one round of rays and coupled samples, whose traced queries `answers` takes. The film is that of the whole picture.
    /// `None` if the round was stopped.
    pub fn refine(
        &mut self,
        picture: &mut Picture,
        round: &Refinement<'_>,
        answers: &mut dyn LogStretch,
    ) -> Option<(Film, RenderStats, PictureError)> {
        self.majorants.commit(&self.transfer);
        let scene = self.frame_scene(round.number);
        picture.refine(&scene, &self.scene, round, self.wave_flights, answers)
    }

    /// Begins a round of a picture whose coupled paths a device tracks itself and returns its input. `number` is that of the random stream, which
    /// stays the same while the picture accumulates; majorants take up the observations of earlier rounds.
    pub fn round_setup(&mut self, number: u64) -> FrameSetup<'_> {
        self.majorants.commit(&self.transfer);
        FrameSetup {
            parameters: self.frame_scene(number).parameters(),
            majorants: self.majorants.majorants(),
            may_be_missing: self.majorants.may_be_missing_all(),
        }
    }

    /// Coupled paths of a round, one for each pair of pixel and sample: the reference for a device that tracks them itself.
    pub fn coupled_paths(
        &mut self,
        number: u64,
        nodes: &Nodes,
        missing: Option<IsMissing<'_>>,
        paths: &[(u32, u32)],
        answers: &mut dyn LogStretch,
    ) -> Vec<CoupledPath> {
        self.majorants.commit(&self.transfer);
        coupled_paths(&self.frame_scene(number), nodes, missing, paths, self.wave_flights, answers)
    }

    /// Begins a frame whose paths a device tracks itself and returns its input. The device passes its observations to [`Self::absorb`].
    ///
    /// # Errors
    /// [`RenderError::Samples`] if the range is empty or too large.
    pub fn frame_setup(&mut self, frame: u64, samples: Range<u32>) -> Result<FrameSetup<'_>, RenderError> {
        self.begin(frame, &samples)?;
        Ok(FrameSetup {
            parameters: self.frame_scene(frame).parameters(),
            majorants: self.majorants.majorants(),
            may_be_missing: self.majorants.may_be_missing_all(),
        })
    }

    /// Where the light volume of a surrogate with `shape` nodes lies, with at most about `max_values` values.
    pub fn light_grid(&self, shape: [usize; 3], max_values: usize, refine: usize) -> LightGrid {
        LightGrid::new(self.space.edges(), shape, &self.light, max_values, refine)
    }

    /// Smallest distance between nodes of a surrogate, in scene units.
    pub fn node_spacing(&self, shape: [usize; 3]) -> f64 {
        node_spacing(self.space.edges(), shape)
    }

    /// Adds the observations of a device that tracked a frame; they take effect in the next. Returns false if they belong to another grid.
    #[must_use]
    pub fn absorb(&self, seen: &CellObservations) -> bool {
        self.majorants.absorb(seen)
    }

    /// Renders a range of the samples of a frame, to be merged with others by [`Film::accumulate`] (later passes or other ranks). All ranges of
    /// a frame use the same majorants. Their observations take effect when another frame begins.
    ///
    /// # Errors
    /// [`RenderError::Samples`] if the range is empty or too large.
    pub fn render_samples(
        &mut self,
        frame: u64,
        samples: Range<u32>,
        answers: &mut dyn LogStretch,
        progress: Option<&dyn Fn(f32)>,
        stop: &AtomicBool,
    ) -> Result<(Film, RenderStats), RenderError> {
        self.begin(frame, &samples)?;
        let scene = self.frame_scene(frame);
        let mut film = Film::new(scene.width, scene.height);
        let mut stats = RenderStats::default();
        let count = samples.end - samples.start;
        let paths = film.samples.len() as u64 * u64::from(count);
        let group_flights = GROUP_FLIGHTS.min(self.wave_flights);
        let group_count = self.wave_flights.div_ceil(group_flights).min(paths.div_ceil(group_flights as u64) as usize);
        let mut groups: Vec<FlightGroup> = std::iter::repeat_with(|| FlightGroup::new(group_flights)).take(group_count).collect();
        let mut schedule = Schedule::new(film.samples.len() as u32, count);
        let (mut points, mut log_stretch, mut traced) = (Vec::new(), Vec::new(), Vec::new());
        loop {
            ridgewatch_base::progress::mark();
            let began = Instant::now();
            schedule.assign_tiles(&mut groups, count);
            advance(&mut groups, &scene, &log_stretch, &traced, &samples);
            collect(&mut groups, &mut film);
            gather(&groups, &mut points);
            stats.walk_seconds += began.elapsed().as_secs_f64();
            if let Some(progress) = progress {
                let done: u64 = groups.iter().map(|group| group.counts.paths).sum();
                progress((done as f64 / paths as f64) as f32);
            }
            if schedule.is_over(&groups) {
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
        for PathCounts { queries, traced, exceeded, missing, paths } in groups.iter().map(|group| group.counts) {
            stats.paths += paths;
            stats.queries += queries;
            stats.traced += traced;
            stats.missing += missing;
            stats.majorant_exceeded += exceeded;
        }
        Ok((film, stats))
    }
}

/// Advances each group with its part of the answers.
fn advance(groups: &mut [FlightGroup], scene: &FrameScene, log_stretch: &[f32], traced: &[bool], samples: &Range<u32>) {
    let mut end = 0;
    let parts: Vec<Range<usize>> = groups
        .iter()
        .map(|group| {
            let first = end;
            end += group.points.len();
            first..end
        })
        .collect();
    groups.par_iter_mut().zip(parts).for_each(|(group, own)| group.advance(scene, &log_stretch[own.clone()], &traced[own], samples));
}

/// Collects the points of all groups in one batch.
fn gather(groups: &[FlightGroup], points: &mut Vec<DomainPoint>) {
    points.clear();
    groups.iter().for_each(|group| points.extend_from_slice(&group.points));
}
