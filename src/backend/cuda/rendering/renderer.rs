//! Wavefront rendering on the device: from a frame's parameters to its film, nothing leaves the device but a few counters a wave.
//!
//! The picture is that of [`Renderer::render`] with the same answers, up to rounding: same random numbers, same states, same sums in
//! an order that depends on the picture's size alone. The host derives majorants between frames, from what the device saw.

use crate::backend::cuda::rendering::memory::{Control, Memory, Plan};
use crate::backend::cuda::{DeviceAnswers, DeviceError, Gpu, launch, threads};
use crate::render::{CellObservations, Film, FrameParameters, RenderError, RenderStats, Renderer};
use cudarc::driver::{CudaEvent, CudaFunction, DeviceRepr, PushKernelArg};
use std::ops::Range;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

/// Collisions of a flight that are answered at once, at most: on its way from the camera, where the first real collision makes those
/// behind it worthless, and on its way to the light, where most are used.
const LOOK_AHEAD: LookAhead = LookAhead { camera: 4, shadow: 8 };
/// Of the memory that is left when it begins, and of what is left beside its own when a frame wants more, rendering takes at most one part in so
/// many.
const MEMORY_SHARE: u64 = 2;

/// How many collisions of a flight may be answered at once. The picture does not depend on it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct LookAhead {
    /// On the way from the camera.
    pub camera: u32,
    /// On the way to the light.
    pub shadow: u32,
}

/// Device seconds of a frame's stages.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Timeline {
    /// Starting paths.
    pub start: f64,
    /// Taking answers, flying on, queueing collisions.
    pub advance: f64,
    /// Answers: choosing who answers, prediction, sorting and tracing.
    pub answer: f64,
    /// Sums to pixels, and the copy to the host.
    pub film: f64,
    /// Waves.
    pub waves: u64,
    /// Points that were answered, those that a flight did not live to see included.
    pub points: u64,
}

#[repr(C)]
#[derive(Clone, Copy)]
struct GridArgument {
    majorants: u64,
    may_miss: u64,
}
#[repr(C)]
#[derive(Clone, Copy)]
struct WatchArgument {
    count: u64,
    highest: u64,
    missing: u64,
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

// SAFETY: `repr(C)`, plain numbers and device addresses, laid out as the structs of `kernels/wavefront.cuh` and `kernels/majorant.cuh`.
unsafe impl DeviceRepr for GridArgument {}
// SAFETY: as above.
unsafe impl DeviceRepr for WatchArgument {}
// SAFETY: as above.
unsafe impl DeviceRepr for BandArgument {}
// SAFETY: as above.
unsafe impl DeviceRepr for SlotsArgument {}
// SAFETY: as above.
unsafe impl DeviceRepr for QueueArgument {}
// SAFETY: `repr(C)`, plain numbers, laid out as `FrameScene` of `kernels/tracking.cuh`, whose size both sides assert.
unsafe impl DeviceRepr for FrameParameters {}

/// Renders frames on a GPU. Keeps its memory from frame to frame.
pub struct GpuRenderer {
    gpu: Arc<Gpu>,
    start: CudaFunction,
    advance: CudaFunction,
    film: CudaFunction,
    memory: Option<Memory>,
    /// Bytes of device memory that rendering may take, as far as others leave them.
    allowed: u64,
    look_ahead: LookAhead,
    timeline: Timeline,
    over_budget: u64,
}

/// The arguments that all waves of a band share.
struct Wave {
    parameters: FrameParameters,
    grid: GridArgument,
    watch: WatchArgument,
    band: BandArgument,
    slots: SlotsArgument,
    control: u64,
}

impl GpuRenderer {
    /// Compiles the kernels, or takes them from the cache.
    ///
    /// # Errors
    /// What the compiler or the device says.
    pub fn new(gpu: &Arc<Gpu>) -> Result<Self, DeviceError> {
        let kernel = |name: &str| gpu.kernel("render.cu", &[], name);
        Ok(Self {
            start: kernel("render_start")?,
            advance: kernel("render_advance")?,
            film: kernel("render_film")?,
            allowed: gpu.memory_left() / MEMORY_SHARE,
            gpu: gpu.clone(),
            memory: None,
            look_ahead: LOOK_AHEAD,
            timeline: Timeline::default(),
            over_budget: 0,
        })
    }

    /// The same with another look-ahead.
    pub fn with_look_ahead(mut self, look_ahead: LookAhead) -> Self {
        self.look_ahead = look_ahead;
        self
    }

    /// The same with at most so many bytes of device memory, as far as a frame can be cut up.
    pub fn with_memory(mut self, bytes: u64) -> Self {
        self.allowed = bytes;
        self
    }

    /// Overwrites the memory between frames with bytes that make NaN and far indices, so that a kernel that reads what it has not written
    /// shows. For tests.
    ///
    /// # Errors
    /// What the device says.
    pub fn poison(&mut self) -> Result<(), DeviceError> {
        self.memory.as_mut().map_or(Ok(()), |memory| memory.block.fill_bytes(0xFF))
    }

    /// Where the time of the latest frame went.
    pub fn timeline(&self) -> Timeline {
        self.timeline
    }

    /// Queries of the latest frame that the surrogate answered where it is not trusted, since the tracing budget was spent.
    pub fn over_budget(&self) -> u64 {
        self.over_budget
    }

    /// Renders a range of a frame's samples: what [`Renderer::render_samples`] does, with answers on the device.
    ///
    /// # Errors
    /// A range that the renderer refuses, or a device fault; majorants then know nothing of this frame.
    pub fn render_samples(
        &mut self,
        renderer: &mut Renderer,
        frame: u64,
        samples: Range<u32>,
        answers: &mut dyn DeviceAnswers,
        progress: Option<&dyn Fn(f32)>,
        stop: &AtomicBool,
    ) -> Result<(Film, RenderStats), DeviceError> {
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
        let parameters = setup.parameters;
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
        // The film's memory is made ready while the device works on the first band.
        let mut film = None;
        let tracked = rayon::in_place_scope(|scope| {
            scope.spawn(|_| film = Some(Film::resident(width, height)));
            self.band(&parameters, band(0), answers, &report, stop)
        });
        let mut film = film.unwrap_or_else(|| Film::new(width, height));
        let mut stopped = tracked?;
        for first in (0..pixels).step_by(plan.band as usize) {
            if first > 0 {
                stopped = self.band(&parameters, band(first), answers, &report, stop)?;
            }
            if stopped {
                stats.stopped = true;
                break;
            }
            self.read_film(&parameters, band(first), &mut film)?;
        }
        let seen = self.end_frame(&mut stats)?;
        answers.end()?;
        // The grid cannot have changed: the renderer was borrowed all the while.
        let known = renderer.absorb(&seen);
        debug_assert!(known);
        let timeline = self.timeline;
        stats.speculative_queries = timeline.points.saturating_sub(stats.queries);
        stats.waves = timeline.waves;
        stats.walk_seconds = timeline.start + timeline.advance + timeline.film;
        stats.evaluate_seconds = timeline.answer;
        stats.device_seconds = stats.walk_seconds + stats.evaluate_seconds;
        Ok((film, stats))
    }

    /// The memory, taken anew only where the present does not do.
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

    /// Tracks the paths of a band; true when `stop` ended it early.
    fn band(
        &mut self,
        parameters: &FrameParameters,
        band: BandArgument,
        answers: &mut dyn DeviceAnswers,
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
                // SAFETY: the arguments of `render_start`; the arrays hold `plan.slots()` slots, of which the band has at most as many,
                // and `plan.queue` collisions, of which each slot queues at most its room.
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
            let stopped = stop.load(Ordering::Relaxed);
            if control.live == 0 || stopped {
                self.timeline.add(&timeline);
                return Ok(stopped && control.live != 0);
            }
            answers.answer(queue.points, control.length as usize, queue.log_stretch, queue.by)?;
            answered = Some([ended, gpu.mark()?]);
            timeline.waves += 1;
            timeline.points += u64::from(control.length);
        }
        Ok(false)
    }

    /// Sums to pixels, and these to the host.
    fn read_film(&mut self, parameters: &FrameParameters, band: BandArgument, film: &mut Film) -> Result<(), DeviceError> {
        let (gpu, kernel) = (self.gpu.clone(), self.film.clone());
        let memory = self.memory()?;
        let wave = memory.wave(*parameters, band);
        let began = gpu.mark()?;
        let out = memory.at(memory.layout.film);
        let mut call = gpu.work().launch_builder(&kernel);
        call.arg(&wave.band).arg(&wave.slots).arg(&out);
        // SAFETY: the arguments of `render_film`; every slot of the band has written its sums.
        unsafe { launch(&mut call, threads(band.pixels as usize, 256)) }?;
        // SAFETY: the kernel has written as many pixels, and `film` holds a band.
        unsafe { memory.film.copy_from(&gpu, out, band.pixels as usize) }?;
        let ended = gpu.mark()?;
        gpu.synchronize()?;
        film.write_pixels(band.first_pixel as usize, &memory.film.values()[..band.pixels as usize]);
        self.timeline.film += f64::from(gpu.milliseconds(&began, &ended)?) * 1e-3;
        Ok(())
    }

    /// What the frame counted and saw.
    fn end_frame(&mut self, stats: &mut RenderStats) -> Result<CellObservations, DeviceError> {
        let gpu = self.gpu.clone();
        let (seen, control) = self.memory()?.end_frame(&gpu)?;
        [stats.queries, stats.traced, stats.missing, stats.majorant_exceeded, stats.paths, self.over_budget] = control.totals;
        Ok(seen)
    }
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
    /// Majorants in force; nothing seen, nothing counted.
    fn begin_frame(&mut self, majorants: &[f32], may_miss: &[bool]) -> Result<(), DeviceError> {
        self.write(self.layout.majorants, majorants)?;
        self.write(self.layout.may_miss, may_miss)?;
        self.zero(self.layout.watch, self.layout.control + size_of::<Control>() as u64 - self.layout.watch)
    }

    /// Empties the lists.
    fn begin_wave(&self) -> Result<(), DeviceError> {
        self.zero(self.layout.control, std::mem::offset_of!(Control, totals) as u64)
    }

    fn end_wave(&mut self, gpu: &Gpu) -> Result<Control, DeviceError> {
        let from = self.at(self.layout.control);
        // SAFETY: the block holds a `Control` there.
        unsafe { self.control.copy_from(gpu, from, 1) }?;
        gpu.synchronize()?;
        Ok(self.control.values()[0])
    }

    fn end_frame(&mut self, gpu: &Gpu) -> Result<(CellObservations, Control), DeviceError> {
        let (from, count) = (self.at(self.layout.watch), self.watch.len());
        // SAFETY: the block holds three values a cell there.
        unsafe { self.watch.copy_from(gpu, from, count) }?;
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
            parameters,
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

    /// The queue of wave `number`: its records beside those of the wave before, whose answers are still to be taken.
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
