//! Smooth frames on the GPU: marches the surrogate, tracks pairs of coupled paths where the variance is, combines both, and states the error of the
//! result. The algorithm and its reference are in [`ridgewatch_render::smooth`]; how finely to march and where to sample is decided there as well.

use super::bricks::{DeviceBricks, Wanted};
use super::combine::{CombineInput, GpuCombine};
use super::coupled::{CoupledTracker, PairTiles, SUM_PLANES, SurrogateNodes};
use super::films::{Filled, Films};
use super::march::{DeviceNodes, GpuMarch, Medium, NodeGrid, RayCheck};
use super::predictor::Predictor;
use super::router::DeviceLogStretch;
use crate::Smooth;
use crate::cuda::driver::Gpu;
use crate::cuda::tracing::{CudaTracer, DeviceTable};
use crate::cuda::{Buffer, DeviceError};
use ridgewatch_base::progress::Work;
use ridgewatch_render::rng::FrameRandom;
use ridgewatch_render::smooth::{
    AUDIT_PAIRS, AUDIT_STEPS, Allocation, AuditedPixel, LIGHT_STEPS, LIT, LIT_BY_MARCH, MarchControl, Marching, NET, PAIR, PictureError,
    TileSums, ToneMap, errors_of_tiles,
};
use ridgewatch_render::{Combine, Film, FrameParameters, Method, RenderStats, Renderer, Scene};
use ridgewatch_trust::Gate;
use std::ops::Range;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;

/// Largest number of values of the light volume, 512 MiB, and the share of the free memory that it takes at most.
const LIGHT_VALUES: u64 = 1 << 27;
const LIGHT_SHARE: u64 = 8;
/// Seconds of marching that a round may take at least. It may also take as long as its samples.
const MIN_MARCH_SECONDS: f64 = 0.005;
/// Pairs of a tile in one call of the tracker.
const MAX_PAIRS: usize = 256;

/// One picture that accumulates on the GPU. It reuses kernels and memory from picture to picture.
pub(in crate::cuda) struct GpuSmooth {
    gpu: Arc<Gpu>,
    march: GpuMarch,
    nodes: DeviceNodes,
    /// Nodes of a network that were traced, since it was not trusted there, and how many of them in this frame.
    bricks: Option<DeviceBricks>,
    traced_nodes: u64,
    tracker: CoupledTracker,
    combine: GpuCombine,
    sums: Option<Buffer<f32>>,
    /// Number of the picture and the scene that it shows. `None` before the first round.
    shows: Option<(u64, Scene)>,
    /// Random stream: the number of the frame at which the picture started.
    number: u64,
    control: MarchControl,
    allocation: Allocation,
    pairs: u64,
    /// Marches so far, of all pictures.
    marches: u64,
    /// Films show the number of their march.
    films: Films,
}

/// One round of refinement.
pub(super) struct SmoothRound<'a> {
    pub(super) smooth: Smooth,
    /// Number of the picture; another number starts anew.
    pub(super) picture: u64,
    /// Number of its window; another one has no traced nodes.
    pub(super) window: u64,
    /// Cells in which the surrogate is trusted.
    pub(super) gate: &'a Gate,
    /// Number of the frame.
    pub(super) frame: u64,
    /// Coupled samples per pixel.
    pub(super) samples: f64,
    pub(super) tracer: &'a CudaTracer,
    /// Table of the surrogate; `None`: `predictor` is laid out on nodes.
    pub(super) table: Option<&'a DeviceTable>,
    pub(super) predictor: &'a Predictor<'a>,
    pub(super) stop: &'a AtomicBool,
}

impl SmoothRound<'_> {
    /// Returns true for the sum: its rays are mended and its samples spread evenly, as on the CPU.
    fn is_sum(&self) -> bool {
        self.smooth.sum && self.smooth.method == Method::TwoLevel
    }
}

impl GpuSmooth {
    /// Compiles the kernels or loads them from the cache.
    ///
    /// # Errors
    /// A kernel does not compile, or the device fails.
    pub(super) fn new(gpu: &Arc<Gpu>) -> Result<Self, DeviceError> {
        Ok(Self {
            march: GpuMarch::new(gpu)?,
            nodes: DeviceNodes::new(gpu)?,
            bricks: None,
            traced_nodes: 0,
            tracker: CoupledTracker::new(gpu)?,
            combine: GpuCombine::new(gpu)?,
            gpu: gpu.clone(),
            sums: None,
            shows: None,
            number: 0,
            control: MarchControl::default(),
            allocation: Allocation::default(),
            pairs: 0,
            marches: 0,
            films: Films::new(Filled::Combined),
        })
    }

    /// Nodes of a network that were traced in the latest round, since it was not trusted there.
    pub(super) fn traced_nodes(&self) -> u64 {
        self.traced_nodes
    }

    /// Share of the nodes that show a network which is not trusted there; `None` without bricks.
    pub(super) fn untraced_share(&self) -> Option<f64> {
        self.bricks.as_ref().map(DeviceBricks::untraced_share)
    }

    /// Starts anew if the round shows anything else than the picture so far.
    fn settle(&mut self, round: &SmoothRound<'_>, renderer: &mut Renderer, answers: &mut dyn DeviceLogStretch) -> Result<(), DeviceError> {
        self.traced_nodes = 0;
        let scene = renderer.scene();
        if self.shows.as_ref().is_some_and(|(picture, shown)| *picture == round.picture && shown == scene) {
            return Ok(());
        }
        self.shows = None;
        let (width, height) = (scene.settings.width, scene.settings.height);
        if round.table.is_none() {
            let _work = Work::begin("laying the surrogate out on nodes");
            let domain = round.tracer.host().domain();
            self.nodes.lay_out(round.predictor, round.smooth.nodes, domain.dimensions)?;
            if round.smooth.traced_nodes > 0 {
                let wanted = Wanted { window: round.window, domain, gate: round.gate, most: round.smooth.traced_nodes, stop: round.stop };
                let bricks = match self.bricks.take() {
                    Some(bricks) => bricks,
                    None => DeviceBricks::new(&self.gpu)?,
                };
                self.traced_nodes = self.bricks.insert(bricks).fill(node_grid(&self.nodes, round)?, renderer, &wanted, answers)?;
            }
        }
        let planes = SUM_PLANES * width * height;
        match &mut self.sums {
            Some(sums) if sums.len() == planes => sums.fill_bytes(0)?,
            slot => {
                *slot = None;
                slot.insert(self.gpu.alloc("sums over coupled paths", planes)?).fill_bytes(0)?;
            }
        }
        (self.number, self.pairs) = (round.frame, 0);
        self.control = self.control.restarted();
        self.allocation = Allocation::new(width, height);
        let shown = (round.picture, scene.clone());
        self.prepare(round, renderer)?;
        self.shows = Some(shown);
        Ok(())
    }

    /// Computes the light volume for the present step. The march starts anew.
    fn prepare(&mut self, round: &SmoothRound<'_>, renderer: &mut Renderer) -> Result<(), DeviceError> {
        let parameters = renderer.round_setup(self.number).parameters;
        let most = LIGHT_VALUES.min(self.gpu.memory_left() / LIGHT_SHARE / size_of::<f32>() as u64);
        let medium = medium(&self.nodes, round, &parameters)?;
        self.march.prepare(renderer, &medium, most as usize, self.control.refine())
    }

    /// Adds rays and pairs to the picture and returns it with its error. `None` if `stop` ended the round early; the picture then starts anew.
    ///
    /// # Errors
    /// The device fails or lacks memory. The samples of the round may be lost then.
    pub(super) fn refine(
        &mut self,
        round: &SmoothRound<'_>,
        renderer: &mut Renderer,
        answers: &mut dyn DeviceLogStretch,
    ) -> Result<Option<(Arc<Film>, RenderStats, PictureError)>, DeviceError> {
        self.settle(round, renderer, answers)?;
        self.control.begin(round.samples);
        let parameters = renderer.round_setup(self.number).parameters;
        let mut marching = self.march(round, renderer, &parameters)?;
        let sampling = Instant::now();
        let mut stats = self.track(round, renderer, answers)?;
        stats.sample_seconds = sampling.elapsed().as_secs_f64();
        let allowed = (stats.walk_seconds + stats.evaluate_seconds).max(MIN_MARCH_SECONDS);
        let settings = &renderer.scene().settings;
        let (width, height, tone_map) = (settings.width, settings.height, settings.tone_map);
        let how = match (round.smooth.method, round.smooth.sum) {
            (Method::Marched, _) => None,
            (_, true) => Some(Combine::Sum),
            (_, false) => Some(Combine::Shrink),
        };
        let samples_per_pixel = 2.0 * self.pairs as f64 / (width * height) as f64;
        let mut film = self.films.spare(&self.gpu, width, height);
        let (error, of_tiles) = loop {
            if stats.stopped || round.stop.load(Ordering::Relaxed) {
                self.shows = None;
                return Ok(None);
            }
            let Some(pairs) = &self.sums else { return Err(unsupported("a picture without sums")) };
            let input = CombineInput { size: [width, height], pairs, march: &self.march, how, tone_map, lit: LIT };
            // The host works on the error meanwhile.
            let shows_march = film.shows == self.marches;
            let early = (!self.control.is_due()).then_some((&mut film, shows_march));
            let tiles = self.combine.combine(&input, early)?;
            let unbiased = round.is_sum() && self.allocation.covers_every_pixel();
            let of_steps = &round.smooth.steps_error;
            let error = PictureError {
                unbiased,
                ..PictureError::of(tiles, &self.control.errors(), of_steps, samples_per_pixel, self.control.rays)
            };
            if !round.is_sum() {
                self.allocation.learn(tiles.iter().map(TileSums::sample_variance));
            }
            match self.control.decide(error.rms.value.powi(2) - self.control.error(), marching < allowed) {
                Marching::Enough => break (error, errors_of_tiles(tiles)),
                Marching::Anew => {
                    // If the preparation fails, the picture starts anew.
                    let shows = self.shows.take();
                    self.prepare(round, renderer)?;
                    self.shows = shows;
                }
                Marching::More => {}
            }
            marching += self.march(round, renderer, &parameters)?;
        };
        let shows_march = film.shows == self.marches;
        let of_march = self.control.error() + round.smooth.steps_error.squared[0];
        self.combine.finish(&of_tiles, of_march as f32, &mut film, shows_march)?;
        film.shows = self.marches;
        let shown = self.films.put(film);
        stats.device_seconds = stats.walk_seconds + stats.evaluate_seconds;
        Ok(Some((shown, stats, error)))
    }

    /// Marches the rays that are due, and compares some pixels with a finer march. Returns the seconds that it took.
    fn march(&mut self, round: &SmoothRound<'_>, renderer: &Renderer, parameters: &FrameParameters) -> Result<f64, DeviceError> {
        if !self.control.is_due() {
            return Ok(0.0);
        }
        let due = self.control.next_rays;
        let (began, _work) = (Instant::now(), Work::begin("marching rays"));
        // If the device fails, the picture starts anew.
        let shows = self.shows.take();
        let medium = medium(&self.nodes, round, parameters)?;
        let step = renderer.node_spacing(medium.nodes.shape()) as f32 * self.control.step;
        self.marches += 1;
        self.march.march(&medium, step, due as u32, round.is_sum())?;
        let random = FrameRandom::new(renderer.scene().seed, self.number);
        let pixels = self.control.audit_pixels(&random, parameters.pixels());
        let before = self.control.rays;
        self.control.rays += due;
        let now = self.control.rays;
        let rays = |pixel: u32, rays: Range<u64>, step: f32, shadow_step: f32| {
            rays.map(move |ray| RayCheck { pixel, ray: ray as u32, step, shadow_step })
        };
        let (fine, to_light) = (step / AUDIT_STEPS as f32, step / LIGHT_STEPS as f32);
        // Pixels of earlier audits get the new rays, those of this one all rays and two nets. What steps and light volume err, mended rays scatter.
        let (mended, pair) = (round.is_sum(), if round.is_sum() { 0 } else { PAIR });
        let [first_net, second_net] = self.control.nets();
        let of_audit = [0..now, first_net..second_net + NET];
        let followed = self.control.audited_mut().iter().flat_map(|audited| rays(audited.pixel, before..now, step, 0.0));
        let mut checks: Vec<RayCheck> = followed.collect();
        let [of_followed, each] = [checks.len(), (now + 2 * NET) as usize];
        checks.extend(pixels.iter().flat_map(|&pixel| of_audit.clone().into_iter().flat_map(move |those| rays(pixel, those, step, 0.0))));
        checks.extend(pixels.iter().flat_map(|&pixel| rays(pixel, 0..pair, fine, 0.0)));
        let found = self.march.check(&medium, &checks, mended)?;
        fn mean<const N: usize>(rays: &[[f32; 4]]) -> [f64; N] {
            std::array::from_fn(|k| rays.iter().map(|ray| f64::from(ray[k])).sum::<f64>() / rays.len() as f64)
        }
        let (followed, found) = found.split_at(of_followed);
        let (coarse, finer) = found.split_at(each * pixels.len());
        if due > 0 {
            for (audited, new) in self.control.audited_mut().iter_mut().zip(followed.chunks_exact(due as usize)) {
                let new: [f64; 4] = mean(new);
                (0..4).for_each(|k| audited.shown[k] += (new[k] - audited.shown[k]) * due as f64 / now as f64);
            }
        }
        let (net, pair) = (NET as usize, pair as usize);
        let look = |(number, (&pixel, coarse)): (usize, (&u32, &[[f32; 4]]))| {
            let (shown, nets) = coarse.split_at(now as usize);
            let nets = [mean(&nets[..net]), mean(&nets[net..])];
            let found = AuditedPixel { pixel, shown: mean(shown), nets, ..AuditedPixel::default() };
            match mended {
                true => found,
                false => AuditedPixel { pair: mean(&shown[..pair]), fine: mean(&finer[number * pair..][..pair]), ..found },
            }
        };
        let mut compared: Vec<AuditedPixel> = pixels.iter().zip(coarse.chunks_exact(each)).enumerate().map(look).collect();
        if !mended {
            let mut lit: Vec<&mut AuditedPixel> = compared.iter_mut().filter(|audited| audited.is_lit()).take(LIT_BY_MARCH).collect();
            let checks: Vec<RayCheck> = lit.iter().flat_map(|audited| rays(audited.pixel, 0..PAIR, fine, to_light)).collect();
            let found = self.march.check(&medium, &checks, false)?;
            for (audited, rays) in lit.iter_mut().zip(found.chunks_exact(pair)) {
                audited.lit = Some(mean(rays));
            }
        }
        self.control.audit(compared, ToneMap::new(renderer.scene().settings.tone_map));
        self.shows = shows;
        Ok(began.elapsed().as_secs_f64())
    }

    /// Tracks the pairs of a round.
    fn track(
        &mut self,
        round: &SmoothRound<'_>,
        renderer: &mut Renderer,
        answers: &mut dyn DeviceLogStretch,
    ) -> Result<RenderStats, DeviceError> {
        let pairs_per_pixel = if round.smooth.method == Method::Marched { AUDIT_PAIRS } else { round.samples / 2.0 };
        // Counts once the samples are there.
        let mut allocation = self.allocation.clone();
        let plan = allocation.next(pairs_per_pixel);
        let grid = node_grid(&self.nodes, round)?;
        let argument = grid.argument();
        let nodes = SurrogateNodes { values: argument.values, shape: grid.shape(), dimensions: argument.dimensions as usize };
        let Some(sums) = &mut self.sums else { return Err(unsupported("a picture without sums")) };
        let cursors: Vec<u16> = plan.iter().map(|tile| u16::from(tile.cursor)).collect();
        let most = plan.iter().map(|tile| tile.pairs).max().unwrap_or(0);
        let mut stats = RenderStats::default();
        let up_to = |most: usize| plan.iter().map(|tile| tile.pairs.min(most)).sum::<usize>();
        let (work, all) = (Work::begin("drawing samples"), up_to(most));
        // A tile whose pixels all get a pair ends where it began.
        for first in (0..most).step_by(MAX_PAIRS) {
            work.reached(up_to(first), all);
            let pairs: Vec<u16> = plan.iter().map(|tile| tile.pairs.saturating_sub(first).min(MAX_PAIRS) as u16).collect();
            let tiles = PairTiles { pairs: &pairs, cursors: &cursors };
            let missing = round.tracer.missing_cells();
            // SAFETY: the nodes are those of the table, which `round` borrows, or of `self.nodes`; both live until the call returns.
            let found = unsafe { self.tracker.track(renderer, self.number, nodes, missing, tiles, answers, sums, round.stop) }?;
            self.pairs += found.pairs;
            stats.paths += found.paths;
            stats.queries += found.queries;
            stats.traced += found.traced;
            stats.missing += found.missing;
            stats.majorant_exceeded += found.majorant_exceeded;
            stats.speculative_queries += found.points.saturating_sub(found.traced);
            stats.waves += found.waves;
            stats.walk_seconds += found.walk_seconds;
            stats.evaluate_seconds += found.answer_seconds;
            stats.stopped |= found.stopped;
            if stats.stopped {
                return Ok(stats);
            }
        }
        self.allocation = allocation;
        Ok(stats)
    }
}

fn unsupported(what: &str) -> DeviceError {
    DeviceError::Unsupported { what: what.into() }
}

fn node_grid<'a>(nodes: &'a DeviceNodes, round: &SmoothRound<'a>) -> Result<NodeGrid<'a>, DeviceError> {
    nodes.grid(round.table).ok_or_else(|| unsupported("a surrogate that is not on nodes"))
}

fn medium<'a>(nodes: &'a DeviceNodes, round: &SmoothRound<'a>, parameters: &'a FrameParameters) -> Result<Medium<'a>, DeviceError> {
    Ok(Medium { parameters, nodes: node_grid(nodes, round)?, missing_cells: round.tracer.missing_cells() })
}
