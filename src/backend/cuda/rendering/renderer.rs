//! Wavefront volume path tracing on the GPU (Laine, Karras, Aila 2013, "Megakernels considered harmful"), with free flights sampled by delta
//! tracking (Woodcock et al. 1965).
//!
//! All paths of a band advance together, in waves. Each wave runs two steps:
//! 1. `render_start` or `render_advance` moves every flight to its next tentative collisions and appends their points to a queue.
//! 2. [`DeviceLogStretch`] evaluates the log-stretch at the queued points. The next wave uses the values to accept or reject the collisions.
//!
//! Only a few counters leave the device after each wave. `render_film` then sums the samples of each pixel. The picture equals that of
//! [`Renderer::render`] up to rounding if the evaluated values are equal: random numbers and states are the same, and the order of the sums depends
//! only on the numbers of pixels and samples. Between frames, the host updates the majorants from the observations of the device.

use crate::cuda::driver::pinned::copy_to_host;
use crate::cuda::rendering::films::{Filled, Films, PinnedFilm};
use crate::cuda::rendering::memory::{Control, Memory, Plan};
use crate::cuda::{DeviceError, DeviceLogStretch, Gpu, launch, threads};
use cudarc::driver::{CudaEvent, CudaFunction, DeviceRepr, PushKernelArg};
use ridgewatch_render::{CellObservations, Film, FrameParameters, RenderError, RenderStats, Renderer};
use std::ops::Range;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

/// Default limit on the collisions of a flight that one wave evaluates. On a camera flight, the first real collision makes the later ones useless. A
/// shadow flight uses most of its collisions.
const LOOK_AHEAD: LookAhead = LookAhead { camera: 4, shadow: 8 };
/// Rendering uses at most 1 / `MEMORY_SHARE` of the device memory that is free when the renderer is created, and, for each frame, at most its own
/// memory plus that share of the free memory.
pub(super) const MEMORY_SHARE: u64 = 2;

/// Limit on the collisions of a flight that one wave evaluates, some of them speculatively. The picture does not depend on it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct LookAhead {
    /// Limit for flights from the camera.
    pub camera: u32,
    /// Limit for shadow flights to the light.
    pub shadow: u32,
}

/// Device time of the stages of a frame, in seconds.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Timeline {
    /// `render_start`: starting the paths.
    pub start: f64,
    /// `render_advance`: accepting or rejecting collisions, continuing flights, queueing collisions.
    pub advance: f64,
    /// Evaluation of queries: routing, prediction, sorting and tracing.
    pub answer: f64,
    /// `render_film`: pixel values, and their copy to the host.
    pub film: f64,
    /// Number of waves.
    pub waves: u64,
    /// Number of evaluated points, including speculative ones that no flight used.
    pub points: u64,
}

#[repr(C)]
#[derive(Clone, Copy)]
pub(super) struct GridArgument {
    pub(super) majorants: u64,
    pub(super) may_miss: u64,
}
#[repr(C)]
#[derive(Clone, Copy)]
pub(super) struct WatchArgument {
    pub(super) count: u64,
    pub(super) highest: u64,
    pub(super) missing: u64,
}
#[repr(C)]
#[derive(Clone, Copy)]
struct BandArgument {
    first_pixel: u32,
    pixels: u32,
    parts: u32,
    first_sample: u32,
    samples: u32,
    pad: u32,
}
#[repr(C)]
#[derive(Clone, Copy)]
struct SlotsArgument {
    place: u64,
    way: u64,
    colour: u64,
    progress: u64,
    seen: u64,
    first: u64,
    sums: u64,
    count: u32,
    pad: u32,
}
#[repr(C)]
#[derive(Clone, Copy)]
struct QueueArgument {
    points: u64,
    hits: u64,
    length: u64,
    answered: u64,
    log_stretch: u64,
    by: u64,
}

// SAFETY: `repr(C)`, plain numbers and device addresses, laid out as the structs of `kernels/rendering/wavefront.cuh` and `kernels/rendering/majorant.cuh`.
unsafe impl DeviceRepr for GridArgument {}
// SAFETY: as above.
unsafe impl DeviceRepr for WatchArgument {}
// SAFETY: as above.
unsafe impl DeviceRepr for BandArgument {}
// SAFETY: as above.
unsafe impl DeviceRepr for SlotsArgument {}
// SAFETY: as above.
unsafe impl DeviceRepr for QueueArgument {}
/// [`FrameParameters`] as an argument of a kernel.
#[repr(transparent)]
#[derive(Clone, Copy)]
pub(super) struct ParametersArgument(pub(super) FrameParameters);

// SAFETY: `repr(C)`, plain numbers, laid out as `FrameScene` of `kernels/rendering/tracking.cuh`, whose size both sides assert.
unsafe impl DeviceRepr for ParametersArgument {}

/// Renders frames on a GPU. It reuses its memory between frames.
pub struct GpuRenderer {
    gpu: Arc<Gpu>,
    start: CudaFunction,
    advance: CudaFunction,
    film: CudaFunction,
    memory: Option<Memory>,
    /// Films show what [`constants`] tells.
    films: Films,
    /// Limit on the device memory of rendering, bytes.
    allowed: u64,
    look_ahead: LookAhead,
    timeline: Timeline,
    over_budget: u64,
}

/// Kernel arguments that all waves of a band share.
struct Wave {
    parameters: ParametersArgument,
    grid: GridArgument,
    watch: WatchArgument,
    band: BandArgument,
    slots: SlotsArgument,
    control: u64,
}

impl GpuRenderer {
    /// Compiles the kernels or loads them from the cache.
    ///
    /// # Errors
    /// A kernel does not compile, or the device fails.
    pub fn new(gpu: &Arc<Gpu>) -> Result<Self, DeviceError> {
        let kernel = |name: &str| gpu.kernel("render.cu", &[], name);
        Ok(Self {
            start: kernel("render_start")?,
            advance: kernel("render_advance")?,
            film: kernel("render_film")?,
            allowed: gpu.memory_left() / MEMORY_SHARE,
            gpu: gpu.clone(),
            memory: None,
            films: Films::new(Filled::Tracked),
            look_ahead: LOOK_AHEAD,
            timeline: Timeline::default(),
            over_budget: 0,
        })
    }

    /// Sets the look-ahead.
    pub fn with_look_ahead(mut self, look_ahead: LookAhead) -> Self {
        self.look_ahead = look_ahead;
        self
    }

    /// Sets the limit on device memory, bytes. A band of one pixel may exceed it.
    pub fn with_memory(mut self, bytes: u64) -> Self {
        self.allowed = bytes;
        self
    }

    /// For tests: fills the memory between frames with bytes that are NaN as floats and out of range as indices, so that reads of uninitialised
    /// memory show.
    ///
    /// # Errors
    /// A driver call fails.
    pub fn poison(&mut self) -> Result<(), DeviceError> {
        self.memory.as_mut().map_or(Ok(()), |memory| memory.block.fill_bytes(0xFF))
    }

    /// Device time of the stages of the latest frame.
    pub fn timeline(&self) -> Timeline {
        self.timeline
    }

    /// Number of queries of the latest frame that the surrogate predicted in untrusted cells, because the tracing budget was spent.
    pub fn over_budget(&self) -> u64 {
        self.over_budget
    }

    /// Renders a range of a frame's samples as [`Renderer::render_samples`] does, with queries evaluated on the device.
    ///
    /// # Errors
    /// The renderer rejects the range, or the device fails or lacks memory. The majorants are then not updated by this frame.
    pub fn render_samples(
        &mut self,
        renderer: &mut Renderer,
        frame: u64,
        samples: Range<u32>,
        answers: &mut dyn DeviceLogStretch,
        progress: Option<&dyn Fn(f32)>,
        stop: &AtomicBool,
    ) -> Result<(Arc<Film>, RenderStats), DeviceError> {
        let settings = &renderer.scene().settings;
        let (width, height) = (settings.width, settings.height);
        let pixels = width * height;
        let refused = |refused: RenderError| DeviceError::Unsupported { what: refused.to_string() };
        let setup = renderer.frame_setup(frame, samples.clone()).map_err(refused)?;
        let count = samples.end - samples.start;
        self.timeline = Timeline::default();
        let own = self.memory.as_ref().map_or(0, |memory| memory.block.len() as u64);
        let allowed = self.allowed.min(own + self.gpu.memory_left() / MEMORY_SHARE);
        let plan = Plan::new(pixels, count, setup.majorants.len(), allowed);
        self.reserve(plan)?.begin_frame(setup.majorants, setup.may_be_missing)?;
        let (parameters, shows) = (setup.parameters, constants(count, setup.may_be_missing));
        let mut stats = RenderStats::default();
        let band = |first: usize| BandArgument {
            first_pixel: first as u32,
            pixels: plan.band.min((pixels - first) as u32),
            parts: plan.parts,
            first_sample: samples.start,
            samples: count,
            pad: 0,
        };
        let paths = pixels as f64 * f64::from(count);
        let report = |done: u64| {
            if let Some(progress) = progress {
                progress((done as f64 / paths) as f32);
            }
        };
        let mut film = self.films.spare(&self.gpu, width, height);
        for first in (0..pixels).step_by(plan.band as usize) {
            if self.band(&parameters, band(first), answers, &report, stop)? {
                stats.stopped = true;
                break;
            }
            self.read_film(&parameters, band(first), &mut film, shows)?;
        }
        film.shows = shows;
        let seen = self.end_frame(&mut stats)?;
        answers.end()?;
        // The majorant grid has not changed, since the renderer is borrowed during the frame.
        let known = renderer.absorb(&seen);
        debug_assert!(known);
        let timeline = self.timeline;
        stats.speculative_queries = timeline.points.saturating_sub(stats.queries);
        stats.waves = timeline.waves;
        stats.walk_seconds = timeline.start + timeline.advance + timeline.film;
        stats.evaluate_seconds = timeline.answer;
        stats.device_seconds = stats.walk_seconds + stats.evaluate_seconds;
        // The kept ones have pixels of earlier frames.
        let film = if stats.stopped { Film::new(width, height).into() } else { self.films.put(film) };
        Ok((film, stats))
    }

    /// Returns the memory. Allocates it again only if it is too small for the plan.
    fn reserve(&mut self, plan: Plan) -> Result<&mut Memory, DeviceError> {
        if self.memory.as_ref().is_none_or(|memory| !memory.plan.covers(&plan)) {
            self.memory = None;
            self.memory = Some(Memory::new(&self.gpu, plan)?);
        }
        self.memory()
    }

    fn memory(&mut self) -> Result<&mut Memory, DeviceError> {
        self.memory.as_mut().ok_or(DeviceError::Unsupported { what: "rendering before memory was taken".into() })
    }

    /// Tracks the paths of a band. Returns true if `stop` ended it early.
    fn band(
        &mut self,
        parameters: &FrameParameters,
        band: BandArgument,
        answers: &mut dyn DeviceLogStretch,
        report: &dyn Fn(u64),
        stop: &AtomicBool,
    ) -> Result<bool, DeviceError> {
        let gpu = self.gpu.clone();
        let (start, advance, ahead) = (self.start.clone(), self.advance.clone(), self.look_ahead);
        let memory = self.memory()?;
        let wave = memory.wave(*parameters, band);
        let slots = wave.slots.count;
        let capacity = memory.plan.queue;
        let room = |live: u32, most: u32| (capacity / live.max(1)).clamp(1, most.max(1));
        let mut control = Control { live: slots, ..Control::default() };
        let (mut timeline, mut answered) = (Timeline::default(), None::<[CudaEvent; 2]>);
        for number in 0_usize.. {
            let began = gpu.mark()?;
            memory.begin_wave()?;
            let queue = memory.queue(number);
            let lists = [memory.layout.live[number % 2], memory.layout.live[1 - number % 2]].map(|offset| memory.at(offset));
            let (camera, shadow) = (room(control.live, ahead.camera), room(control.live, ahead.shadow));
            let config = threads(control.live as usize, 128);
            let stream = gpu.work();
            if number == 0 {
                let mut call = stream.launch_builder(&start);
                call.arg(&wave.parameters).arg(&wave.grid).arg(&wave.watch).arg(&wave.band).arg(&wave.slots).arg(&queue);
                call.arg(&lists[1]).arg(&camera).arg(&wave.control);
                // SAFETY: the arguments of `render_start`; the arrays hold `plan.slots()` slots, which is at least the number of the band's
                // slots, and `plan.queue` collisions, which bounds what all slots together append.
                unsafe { launch(&mut call, config) }?;
            } else {
                let mut call = stream.launch_builder(&advance);
                call.arg(&wave.parameters).arg(&wave.grid).arg(&wave.watch).arg(&wave.band).arg(&wave.slots).arg(&queue);
                call.arg(&lists[0]).arg(&control.live).arg(&lists[1]).arg(&camera).arg(&shadow).arg(&wave.control);
                // SAFETY: the arguments of `render_advance`; as above, and the list holds `control.live` slots.
                unsafe { launch(&mut call, config) }?;
            }
            let ended = gpu.mark()?;
            control = memory.end_wave(&gpu)?;
            let seconds = |from: &CudaEvent, to: &CudaEvent| gpu.milliseconds(from, to).map(|ms| f64::from(ms) * 1e-3);
            if let Some([from, to]) = &answered {
                timeline.answer += seconds(from, to)?;
            }
            *(if number == 0 { &mut timeline.start } else { &mut timeline.advance }) += seconds(&began, &ended)?;
            report(control.totals[4]);
            ridgewatch_base::progress::mark();
            let stopped = stop.load(Ordering::Relaxed);
            if control.live == 0 || stopped {
                self.timeline.add(&timeline);
                return Ok(stopped && control.live != 0);
            }
            answers.evaluate(queue.points, control.length as usize, queue.log_stretch, queue.by)?;
            answered = Some([ended, gpu.mark()?]);
            timeline.waves += 1;
            timeline.points += u64::from(control.length);
        }
        Ok(false)
    }

    /// Computes the pixel values of a band from its sums and copies them to the film, without the planes that it shows already ([`constants`]).
    fn read_film(
        &mut self,
        parameters: &FrameParameters,
        band: BandArgument,
        film: &mut PinnedFilm,
        shows: u64,
    ) -> Result<(), DeviceError> {
        let (gpu, kernel) = (self.gpu.clone(), self.film.clone());
        let is_shown = film.shows == shows;
        let memory = self.memory()?;
        let wave = memory.wave(*parameters, band);
        let began = gpu.mark()?;
        let out = memory.at(memory.layout.film);
        let mut call = gpu.work().launch_builder(&kernel);
        call.arg(&wave.band).arg(&wave.slots).arg(&out);
        // SAFETY: the arguments of `render_film`; every slot of the band has written its sums.
        unsafe { launch(&mut call, threads(band.pixels as usize, 256)) }?;
        let pixels = band.pixels as usize;
        let range = band.first_pixel as usize..band.first_pixel as usize + pixels;
        let at = |plane: usize| out + (plane * pixels * size_of::<f32>()) as u64;
        let one_sample = band.samples == 1;
        let is_constant = |plane: usize| match plane {
            MISSING => shows & NOTHING_MISSING != 0,
            SAMPLES => true,
            VARIANCE => one_sample,
            _ => false,
        };
        film.begins(&gpu);
        let Some(picture) = film.film_mut() else { return Err(DeviceError::Unsupported { what: "a film that is shown already".into() }) };
        // SAFETY: the kernel writes `pixels` pixels; the copies are waited for below, or else when the film is dropped.
        unsafe { copy_to_host(gpu.work(), at(0), picture.rgba[range.clone()].as_flattened_mut()) }?;
        for (plane, values) in Filled::Tracked.planes(picture).into_iter().enumerate() {
            if !(is_shown && is_constant(plane)) {
                // SAFETY: as above.
                unsafe { copy_to_host(gpu.work(), at(4 + plane), &mut values[range.clone()]) }?;
            }
        }
        let ended = gpu.mark()?;
        film.wait(&gpu)?;
        self.timeline.film += f64::from(gpu.milliseconds(&began, &ended)?) * 1e-3;
        Ok(())
    }

    /// Stores the counters of the frame in `stats` and returns the observations of the majorant cells.
    fn end_frame(&mut self, stats: &mut RenderStats) -> Result<CellObservations, DeviceError> {
        let gpu = self.gpu.clone();
        let (seen, control) = self.memory()?.end_frame(&gpu)?;
        [stats.queries, stats.traced, stats.missing, stats.majorant_exceeded, stats.paths, self.over_budget] = control.totals;
        Ok(seen)
    }
}

/// Planes of [`Filled::Tracked`] that are the same from frame to frame: where no cell may lack a velocity, with equal numbers of samples, and with one.
const MISSING: usize = 2;
const SAMPLES: usize = 4;
const VARIANCE: usize = 5;
/// Bit of [`constants`].
const NOTHING_MISSING: u64 = 1;

/// What decides these planes, as a number above 0.
fn constants(samples: u32, may_be_missing: &[bool]) -> u64 {
    u64::from(samples) << 1 | if may_be_missing.contains(&true) { 0 } else { NOTHING_MISSING }
}

impl Timeline {
    fn add(&mut self, other: &Self) {
        self.start += other.start;
        self.advance += other.advance;
        self.answer += other.answer;
        self.film += other.film;
        self.waves += other.waves;
        self.points += other.points;
    }
}

impl Memory {
    /// Uploads the majorants and resets the observations and counters.
    fn begin_frame(&mut self, majorants: &[f32], may_miss: &[bool]) -> Result<(), DeviceError> {
        self.write(self.layout.majorants, majorants)?;
        self.write(self.layout.may_miss, may_miss)?;
        self.zero(self.layout.watch, self.layout.control + size_of::<Control>() as u64 - self.layout.watch)
    }

    /// Sets the lengths of the lists to 0.
    fn begin_wave(&self) -> Result<(), DeviceError> {
        self.zero(self.layout.control, std::mem::offset_of!(Control, totals) as u64)
    }

    fn end_wave(&mut self, gpu: &Gpu) -> Result<Control, DeviceError> {
        let from = self.at(self.layout.control);
        // SAFETY: the block holds a `Control` at this offset.
        unsafe { self.control.copy_from(gpu.work(), from, 1) }?;
        gpu.synchronize()?;
        Ok(self.control.values()[0])
    }

    fn end_frame(&mut self, gpu: &Gpu) -> Result<(CellObservations, Control), DeviceError> {
        let (from, count) = (self.at(self.layout.watch), self.watch.len());
        // SAFETY: the block holds three values per cell at this offset.
        unsafe { self.watch.copy_from(gpu.work(), from, count) }?;
        let control = self.end_wave(gpu)?;
        let (count, rest) = self.watch.values().split_at(count / 3);
        let (highest, missing) = rest.split_at(count.len());
        Ok((CellObservations { count: count.into(), highest: highest.into(), missing: missing.into() }, control))
    }

    fn wave(&self, parameters: FrameParameters, band: BandArgument) -> Wave {
        let l = &self.layout;
        let cells = 4 * u64::from(self.plan.cells);
        let watch = self.at(l.watch);
        Wave {
            parameters: ParametersArgument(parameters),
            grid: GridArgument { majorants: self.at(l.majorants), may_miss: self.at(l.may_miss) },
            watch: WatchArgument { count: watch, highest: watch + cells, missing: watch + 2 * cells },
            band,
            slots: SlotsArgument {
                place: self.at(l.place),
                way: self.at(l.way),
                colour: self.at(l.colour),
                progress: self.at(l.progress),
                seen: self.at(l.seen),
                first: self.at(l.first),
                sums: self.at(l.sums),
                count: band.pixels * band.parts,
                pad: 0,
            },
            control: self.at(l.control),
        }
    }

    /// Returns the queue of wave `number`. Its records alternate between two arrays, because the kernel still reads those of the previous wave.
    fn queue(&self, number: usize) -> QueueArgument {
        let l = &self.layout;
        QueueArgument {
            points: self.at(l.points),
            hits: self.at(l.hits[number % 2]),
            length: self.at(l.control) + std::mem::offset_of!(Control, length) as u64,
            answered: self.at(l.hits[1 - number % 2]),
            log_stretch: self.at(l.log_stretch),
            by: self.at(l.by),
        }
    }
}
