//! Coupled paths on the GPU: tracking of the traced field less tracking of the surrogate, for the pixels of a list.
//!
//! Waves are those of [`super::renderer`]: `coupled_advance` moves every path to its next collisions that need the traced field,
//! [`DeviceLogStretch`] evaluates them. The surrogate guides how far a path looks ahead: as long as both fields decide alike, one wave answers a
//! whole path. The host waits once per wave, for the number of collisions, and there are few waves.
//!
//! Results of the paths stay apart until the frame is complete; `coupled_add` then adds them to the sums.

use super::renderer::ParametersArgument;
use crate::cuda::driver::pinned::Pinned;
use crate::cuda::layout::{MissingCellsArgument, TableArgument};
use crate::cuda::rendering::renderer::{GridArgument, MEMORY_SHARE, WatchArgument};
use crate::cuda::{Buffer, DeviceError, DeviceLogStretch, DeviceMissingCells, Gpu, launch, threads};
use bytemuck::Zeroable;
use cudarc::driver::{CudaEvent, CudaFunction, DeviceRepr, PushKernelArg};
use ridgewatch_base::progress;
use ridgewatch_render::smooth::{TILE, bayer_rank};
use ridgewatch_render::{CellObservations, FrameParameters, Renderer};
use std::mem::offset_of;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

/// Default limit on the collisions of a path that one wave evaluates. In the test scene it saves seven in eight waves for 8 % more points.
const LOOK_AHEAD: u32 = 16;
/// Limit on the paths that advance together.
const MAX_SLOTS: u64 = 1 << 22;
/// Collisions in the queue per slot, on average, if memory allows, and at least.
const QUEUE_PER_SLOT: u64 = 8;
const MIN_QUEUE_PER_SLOT: u64 = 2;
/// Pixels in a tile.
const TILE_PIXELS: usize = TILE * TILE;
/// Planes of the sums, one value per pixel each: summed differences by half, quarter and channel (the channel fastest), pairs in quarters 0 and
/// 1, summed differences of alpha.
pub const SUM_PLANES: usize = 15;

/// The surrogate's log-stretch on the device, at nodes i / (n - 1) of the unit domain, x fastest.
#[derive(Debug, Clone, Copy)]
pub struct SurrogateNodes {
    /// Device address of the values.
    pub values: u64,
    /// Nodes along x, y, z; 1 along z if the flow is two-dimensional.
    pub shape: [usize; 3],
    /// 2 or 3.
    pub dimensions: usize,
}

/// The pixels that get one pair of paths in a frame. Both slices have one value per tile of 16 x 16 pixels, row by row. In a tile these are the
/// pixels whose [`bayer_rank`] lies in `cursor..cursor + pairs`, modulo 256.
#[derive(Debug, Clone, Copy)]
pub struct PairTiles<'a> {
    /// At most 256.
    pub pairs: &'a [u16],
    /// Below 256.
    pub cursors: &'a [u16],
}

/// Counts and times of a call of [`CoupledTracker::track`].
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct CoupledStats {
    /// Pairs of paths in the list.
    pub pairs: u64,
    /// Finished paths.
    pub paths: u64,
    /// Queries of the traced field, including those in missing cells.
    pub queries: u64,
    /// Queries that were traced by RK4.
    pub traced: u64,
    /// Queries in missing cells.
    pub missing: u64,
    /// Queries whose extinction exceeded the majorant.
    pub majorant_exceeded: u64,
    /// Queries that the surrogate answered outside of its trusted cells.
    pub over_budget: u64,
    /// Evaluated points, including those that no path used.
    pub points: u64,
    /// Waves of all bands.
    pub waves: u64,
    /// Device seconds of advancing paths and adding up.
    pub walk_seconds: f64,
    /// Device seconds of answering.
    pub answer_seconds: f64,
    /// True if `stop` ended the frame early. The sums are unchanged then.
    pub stopped: bool,
}

#[repr(C)]
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
struct PairTile {
    offset: u32,
    count: u16,
    cursor: u16,
}
#[repr(C)]
#[derive(Clone, Copy)]
struct SurrogateArgument {
    nodes: TableArgument,
    missing_cells: MissingCellsArgument,
}
#[repr(C)]
#[derive(Clone, Copy)]
struct WorkArgument {
    list: u64,
    sums: u64,
    found: u64,
    width: u32,
    pixels: u32,
    entries: u32,
    first: u32,
    count: u32,
    pad: u32,
}
#[repr(C)]
#[derive(Clone, Copy)]
struct SlotsArgument {
    place: u64,
    way: u64,
    kept_place: u64,
    kept_way: u64,
    factors: u64,
    colour: u64,
    colour_rest: u64,
    found: u64,
    progress: u64,
}
#[repr(C)]
#[derive(Clone, Copy)]
struct QueueArgument {
    points: u64,
    records: u64,
    length: u64,
    guesses: u64,
    most_guesses: u32,
    ahead: u32,
    answered: u64,
    log_stretch: u64,
    by: u64,
}
/// Counters of the kernels.
#[repr(C)]
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
struct Control {
    live: u32,
    length: u32,
    guesses: u32,
    pad: u32,
    /// Queries, traced queries, queries in missing cells, exceeded majorants, finished paths, queries over the tracing budget.
    totals: [u64; 6],
}

// Sizes that the kernels assert.
const _: () = assert!(size_of::<PairTile>() == 8 && size_of::<SurrogateArgument>() == 120 && size_of::<Control>() == 64);
const _: () = assert!(size_of::<WorkArgument>() == 48 && size_of::<SlotsArgument>() == 72 && size_of::<QueueArgument>() == 64);

// SAFETY: `repr(C)`, plain numbers and device addresses, laid out as the structs of `kernels/rendering/coupled.cuh` and `coupled.cu`.
unsafe impl DeviceRepr for PairTile {}
// SAFETY: as above.
unsafe impl DeviceRepr for SurrogateArgument {}
// SAFETY: as above.
unsafe impl DeviceRepr for WorkArgument {}
// SAFETY: as above.
unsafe impl DeviceRepr for SlotsArgument {}
// SAFETY: as above.
unsafe impl DeviceRepr for QueueArgument {}
// SAFETY: as above.
unsafe impl DeviceRepr for Control {}

/// Tracks coupled paths on a GPU. It reuses its memory between frames.
pub struct CoupledTracker {
    gpu: Arc<Gpu>,
    list: CudaFunction,
    advance: CudaFunction,
    add: CudaFunction,
    memory: Option<Memory>,
    /// Limit on device memory, bytes.
    allowed: u64,
    look_ahead: u32,
}

/// Kernel arguments that all waves of a frame share.
struct Frame {
    parameters: ParametersArgument,
    grid: GridArgument,
    watch: WatchArgument,
    surrogate: SurrogateArgument,
    slots: SlotsArgument,
    work: WorkArgument,
    control: u64,
}

impl CoupledTracker {
    /// Compiles the kernels or loads them from the cache.
    ///
    /// # Errors
    /// A kernel does not compile, or the device fails.
    pub fn new(gpu: &Arc<Gpu>) -> Result<Self, DeviceError> {
        let kernel = |name: &str| gpu.kernel("coupled.cu", &[], name);
        Ok(Self {
            list: kernel("coupled_list")?,
            advance: kernel("coupled_advance")?,
            add: kernel("coupled_add")?,
            allowed: gpu.memory_left() / MEMORY_SHARE,
            gpu: gpu.clone(),
            memory: None,
            look_ahead: LOOK_AHEAD,
        })
    }

    /// Sets the limit on the collisions of a path that one wave evaluates. The sums do not depend on it.
    pub fn with_look_ahead(mut self, collisions: u32) -> Self {
        self.look_ahead = collisions.max(1);
        self
    }

    /// Sets the limit on device memory, bytes. The list and a band of one pair may exceed it.
    pub fn with_memory(mut self, bytes: u64) -> Self {
        self.allowed = bytes;
        self
    }

    /// For tests: fills the memory between frames with bytes that are NaN as floats and out of range as indices.
    ///
    /// # Errors
    /// A driver call fails.
    pub fn poison(&mut self) -> Result<(), DeviceError> {
        self.memory.as_mut().map_or(Ok(()), |memory| memory.block.fill_bytes(0xFF))
    }

    /// Tracks one pair of paths for each listed pixel and adds the results to `sums`, which hold [`SUM_PLANES`] planes of the picture's pixels.
    /// The pair of a pixel (x, y) that has had v pairs are its samples 2 v (half A) and 2 v + 1 (half B) of the random stream `number`, which
    /// stays the same while a picture accumulates; they go to quarter (v + bits of x + bits of y) mod 2. If this fails or stops, the sums are unchanged.
    ///
    /// No query lies in a missing cell, so [`super::TraceAll`] answers all of them unless traced values are wanted as labels.
    ///
    /// # Errors
    /// The tiles or sums do not fit the picture, or the device fails or lacks memory. The majorants are then not updated by this frame.
    ///
    /// # Safety
    /// `nodes.values` is memory of this device with as many values as nodes, which lives until this returns.
    #[allow(clippy::too_many_arguments)] // one call per frame, each of them another thing
    pub unsafe fn track(
        &mut self,
        renderer: &mut Renderer,
        number: u64,
        nodes: SurrogateNodes,
        missing_cells: Option<&DeviceMissingCells>,
        tiles: PairTiles<'_>,
        answers: &mut dyn DeviceLogStretch,
        sums: &mut Buffer<f32>,
        stop: &AtomicBool,
    ) -> Result<CoupledStats, DeviceError> {
        let settings = &renderer.scene().settings;
        let (width, height) = (settings.width, settings.height);
        let pixels = width * height;
        let (tiles, entries) = placed(width, height, tiles)?;
        if sums.len() < SUM_PLANES * pixels {
            return Err(DeviceError::Unsupported { what: format!("coupled sums of {} values for {pixels} pixels", sums.len()) });
        }
        let mut stats = CoupledStats { pairs: entries as u64, ..CoupledStats::default() };
        if entries == 0 {
            answers.end()?;
            return Ok(stats);
        }
        let setup = renderer.round_setup(number);
        let own = self.memory.as_ref().map_or(0, |memory| memory.block.len() as u64);
        let allowed = self.allowed.min(own + self.gpu.memory_left() / MEMORY_SHARE);
        // Powers of two, so that lists of similar length share memory.
        let room = entries.next_power_of_two().min(pixels);
        let plan = Plan::new(room, tiles.len(), setup.majorants.len(), allowed);
        if self.memory.as_ref().is_none_or(|memory| !memory.plan.covers(&plan)) {
            self.memory = None;
            self.memory = Some(Memory::new(&self.gpu, plan)?);
        }
        let Some(memory) = &mut self.memory else { return Ok(stats) };
        memory.write(memory.layout.majorants, setup.majorants)?;
        memory.write(memory.layout.may_miss, setup.may_be_missing)?;
        memory.write(memory.layout.tiles, &tiles)?;
        memory.zero(memory.layout.watch, memory.layout.control + size_of::<Control>() as u64 - memory.layout.watch)?;
        let surrogate = SurrogateArgument {
            nodes: TableArgument { nodes: nodes.shape.map(|n| n as i32), dimensions: nodes.dimensions as i32, values: nodes.values },
            missing_cells: missing_cells.map_or_else(Zeroable::zeroed, DeviceMissingCells::argument),
        };
        let mut frame = memory.frame(setup.parameters, surrogate, entries, sums.address());
        let (across, down, at) = (width as u32, height as u32, memory.at(memory.layout.tiles));
        let mut call = self.gpu.work().launch_builder(&self.list);
        call.arg(&across).arg(&down).arg(&at).arg(&frame.work.list);
        // SAFETY: the arguments of `coupled_list`; the list holds `entries` pixels, which is what the tiles list.
        unsafe { launch(&mut call, threads(tiles.len() * TILE_PIXELS, TILE_PIXELS as u32)) }?;
        let paths = 2 * entries;
        let slots = memory.plan.slots as usize;
        for first in (0..paths).step_by(slots) {
            (frame.work.first, frame.work.count) = (first as u32, slots.min(paths - first) as u32);
            if self.band(&frame, answers, stop, &mut stats)? {
                stats.stopped = true;
                break;
            }
        }
        let seen = self.end_frame(&mut stats)?;
        answers.end()?;
        if !stats.stopped {
            self.add(&frame, &mut stats)?;
        }
        // The majorant grid has not changed, since the renderer is borrowed during the frame.
        let known = renderer.absorb(&seen);
        debug_assert!(known);
        Ok(stats)
    }

    /// Tracks the paths of a band. Returns true if `stop` ended it early.
    fn band(
        &mut self,
        frame: &Frame,
        answers: &mut dyn DeviceLogStretch,
        stop: &AtomicBool,
        stats: &mut CoupledStats,
    ) -> Result<bool, DeviceError> {
        let gpu = &self.gpu;
        let Some(memory) = &mut self.memory else { return Ok(false) };
        let seconds = |from: &CudaEvent, to: &CudaEvent| gpu.milliseconds(from, to).map(|ms| f64::from(ms) * 1e-3);
        let mut live = frame.work.count;
        let mut answered = None::<[CudaEvent; 2]>;
        for number in 0_usize.. {
            let began = gpu.mark()?;
            memory.zero(memory.layout.control, offset_of!(Control, totals) as u64)?;
            let queue = memory.queue(number, live, self.look_ahead);
            let [before, next] = [memory.layout.live[number % 2], memory.layout.live[1 - number % 2]].map(|offset| memory.at(offset));
            // In the first wave there is no list: every slot begins.
            let before = if number == 0 { 0 } else { before };
            let mut call = gpu.work().launch_builder(&self.advance);
            call.arg(&frame.parameters).arg(&frame.grid).arg(&frame.watch).arg(&frame.surrogate).arg(&frame.work).arg(&frame.slots);
            call.arg(&queue).arg(&before).arg(&live).arg(&next).arg(&frame.control);
            // SAFETY: the arguments of `coupled_advance`. The arrays hold `plan.slots` slots, of which `live` are listed. The queue holds a
            // collision for each of them and `most_guesses` more.
            unsafe { launch(&mut call, threads(live as usize, 128)) }?;
            let ended = gpu.mark()?;
            let control = memory.read_control(gpu)?;
            if let Some([from, to]) = &answered {
                stats.answer_seconds += seconds(from, to)?;
            }
            stats.walk_seconds += seconds(&began, &ended)?;
            live = control.live;
            if live == 0 {
                return Ok(false);
            }
            progress::mark();
            if stop.load(Ordering::Relaxed) {
                return Ok(true);
            }
            answers.evaluate(queue.points, control.length as usize, queue.log_stretch, queue.by)?;
            answered = Some([ended, gpu.mark()?]);
            stats.waves += 1;
            stats.points += u64::from(control.length);
        }
        Ok(false)
    }

    /// Adds the results of all paths to the sums.
    fn add(&self, frame: &Frame, stats: &mut CoupledStats) -> Result<(), DeviceError> {
        let began = self.gpu.mark()?;
        let mut call = self.gpu.work().launch_builder(&self.add);
        call.arg(&frame.work).arg(&frame.work.sums);
        // SAFETY: the arguments of `coupled_add`; all paths of the list have written their results, and no pixel is listed twice.
        unsafe { launch(&mut call, threads(frame.work.entries as usize, 256)) }?;
        let ended = self.gpu.mark()?;
        stats.walk_seconds += f64::from(self.gpu.milliseconds(&began, &ended)?) * 1e-3;
        Ok(())
    }

    /// Stores the counters of the frame in `stats` and returns the observations of the majorant cells.
    fn end_frame(&mut self, stats: &mut CoupledStats) -> Result<CellObservations, DeviceError> {
        let Some(memory) = &mut self.memory else { return Ok(CellObservations::default()) };
        let (from, count) = (memory.at(memory.layout.watch), memory.watch.len());
        // SAFETY: the block holds three values per cell at this offset.
        unsafe { memory.watch.copy_from(self.gpu.work(), from, count) }?;
        let control = memory.read_control(&self.gpu)?;
        [stats.queries, stats.traced, stats.missing, stats.majorant_exceeded, stats.paths, stats.over_budget] = control.totals;
        let (count, rest) = memory.watch.values().split_at(count / 3);
        let (highest, missing) = rest.split_at(count.len());
        Ok(CellObservations { count: count.into(), highest: highest.into(), missing: missing.into() })
    }
}

/// The tiles with the places of their pixels in the list, and the length of the list.
fn placed(width: usize, height: usize, tiles: PairTiles<'_>) -> Result<(Vec<PairTile>, usize), DeviceError> {
    let [across, down] = [width, height].map(|n| n.div_ceil(TILE));
    let fits = |values: &[u16], most: usize| values.len() == across * down && values.iter().all(|&n| usize::from(n) <= most);
    if !fits(tiles.pairs, TILE_PIXELS) || !fits(tiles.cursors, TILE_PIXELS - 1) {
        return Err(DeviceError::Unsupported {
            what: format!("coupled pairs of other than {across} x {down} tiles, or too many in a tile"),
        });
    }
    let mut end = 0;
    let place = |number: usize| {
        let (count, cursor) = (tiles.pairs[number], tiles.cursors[number]);
        let tile = PairTile { offset: end as u32, count, cursor };
        let inside = [width - number % across * TILE, height - number / across * TILE].map(|n| n.min(TILE));
        end += if inside == [TILE; 2] {
            usize::from(count)
        } else {
            let listed = |x, y| u16::from(bayer_rank(x, y).wrapping_sub(cursor as u8)) < count;
            (0..inside[1]).map(|y| (0..inside[0]).filter(|&x| listed(x, y)).count()).sum()
        };
        tile
    };
    let tiles = (0..across * down).map(place).collect();
    Ok((tiles, end))
}

/// Sizes of the arrays on the device.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Plan {
    /// Paths that advance together; even.
    slots: u64,
    /// Capacity of the queue.
    queue: u64,
    /// Capacity of the list.
    entries: u64,
    tiles: u64,
    cells: u64,
}

impl Plan {
    /// Plans lists of `entries` pixels, within `memory` bytes if a band of one pair suffices for that.
    fn new(entries: usize, tiles: usize, cells: usize, memory: u64) -> Self {
        let (entries, tiles, cells) = (entries.max(1) as u64, tiles as u64, cells as u64);
        let slots = MAX_SLOTS.min(2 * entries);
        let mut plan = Self { slots, queue: slots * QUEUE_PER_SLOT, entries, tiles, cells };
        while Layout::new(&plan).end > memory && plan.slots > 2 {
            if plan.queue > MIN_QUEUE_PER_SLOT * plan.slots {
                plan.queue = (plan.queue / 2).max(MIN_QUEUE_PER_SLOT * plan.slots);
            } else {
                plan.slots = (plan.slots / 4 * 2).max(2);
                plan.queue = MIN_QUEUE_PER_SLOT * plan.slots;
            }
        }
        plan
    }

    /// Returns true if the memory of `self` is large enough for `other`.
    fn covers(&self, other: &Self) -> bool {
        self.slots >= other.slots
            && self.queue >= other.queue
            && self.entries >= other.entries
            && self.tiles >= other.tiles
            && self.cells == other.cells
    }
}

/// Offset of each array in the allocation, bytes.
#[derive(Debug, Clone, Copy, Default)]
struct Layout {
    /// In the order of [`SlotsArgument`].
    slots: [u64; 9],
    live: [u64; 2],
    points: u64,
    records: [u64; 2],
    log_stretch: u64,
    by: u64,
    list: u64,
    found: u64,
    tiles: u64,
    majorants: u64,
    may_miss: u64,
    /// Observations of each majorant cell: counts, highest values, missing values. Set to 0 at the start of a frame, together with `control`.
    watch: u64,
    control: u64,
    end: u64,
}

impl Layout {
    fn new(plan: &Plan) -> Self {
        let mut end = 0;
        let mut take = |count: u64, size: u64| {
            let begin = end;
            end = (begin + count * size).next_multiple_of(256);
            begin
        };
        let mut layout = Self {
            slots: [16, 16, 16, 16, 16, 16, 8, 16, 16].map(|size| take(plan.slots, size)),
            live: [take(plan.slots, 4), take(plan.slots, 4)],
            points: take(plan.queue, 12),
            records: [take(plan.queue, 16), take(plan.queue, 16)],
            log_stretch: take(plan.queue, 4),
            by: take(plan.queue, 1),
            list: take(plan.entries, 4),
            found: take(2 * plan.entries, 16),
            tiles: take(plan.tiles, size_of::<PairTile>() as u64),
            majorants: take(plan.cells, 4),
            may_miss: take(plan.cells, 1),
            watch: take(3 * plan.cells, 4),
            control: take(1, size_of::<Control>() as u64),
            end: 0,
        };
        layout.end = end;
        layout
    }
}

/// Device memory of a plan, and pinned memory for its readback.
struct Memory {
    plan: Plan,
    layout: Layout,
    block: Buffer<u8>,
    control: Pinned<Control>,
    watch: Pinned<u32>,
}

impl Memory {
    fn new(gpu: &Gpu, plan: Plan) -> Result<Self, DeviceError> {
        let layout = Layout::new(&plan);
        Ok(Self {
            plan,
            layout,
            block: gpu.alloc("coupled paths", layout.end as usize)?,
            control: Pinned::new(gpu.context(), 1)?,
            watch: Pinned::new(gpu.context(), 3 * plan.cells as usize)?,
        })
    }

    /// Copies values to an offset of the layout.
    fn write<T: Copy>(&mut self, offset: u64, values: &[T]) -> Result<(), DeviceError> {
        let bytes = size_of_val(values);
        // SAFETY: numbers, bools and structs of numbers without padding, whose bytes are all initialised.
        let bytes = unsafe { std::slice::from_raw_parts(values.as_ptr().cast::<u8>(), bytes) };
        self.block.write_at(offset as usize, bytes)
    }

    fn zero(&self, offset: u64, bytes: u64) -> Result<(), DeviceError> {
        self.block.zero_at(offset as usize, bytes as usize)
    }

    fn at(&self, offset: u64) -> u64 {
        self.block.address() + offset
    }

    /// Waits for the work so far and returns the counters.
    fn read_control(&mut self, gpu: &Gpu) -> Result<Control, DeviceError> {
        let from = self.at(self.layout.control);
        // SAFETY: the block holds a `Control` at this offset.
        unsafe { self.control.copy_from(gpu.work(), from, 1) }?;
        gpu.synchronize()?;
        Ok(self.control.values()[0])
    }

    fn frame(&self, parameters: FrameParameters, surrogate: SurrogateArgument, entries: usize, sums: u64) -> Frame {
        let l = &self.layout;
        let [place, way, kept_place, kept_way, factors, colour, colour_rest, found, progress] = l.slots.map(|offset| self.at(offset));
        let (watch, cells) = (self.at(l.watch), 4 * self.plan.cells);
        Frame {
            parameters: ParametersArgument(parameters),
            grid: GridArgument { majorants: self.at(l.majorants), may_miss: self.at(l.may_miss) },
            watch: WatchArgument { count: watch, highest: watch + cells, missing: watch + 2 * cells },
            surrogate,
            slots: SlotsArgument { place, way, kept_place, kept_way, factors, colour, colour_rest, found, progress },
            work: WorkArgument {
                list: self.at(l.list),
                sums,
                found: self.at(l.found),
                width: parameters.size()[0] as u32,
                pixels: parameters.pixels() as u32,
                entries: entries as u32,
                first: 0,
                count: 0,
                pad: 0,
            },
            control: self.at(l.control),
        }
    }

    /// Returns the queue of wave `number`, which has `live` slots. Its records alternate between two arrays, because the kernel still reads those
    /// of the previous wave.
    fn queue(&self, number: usize, live: u32, ahead: u32) -> QueueArgument {
        let l = &self.layout;
        QueueArgument {
            points: self.at(l.points),
            records: self.at(l.records[number % 2]),
            length: self.at(l.control) + offset_of!(Control, length) as u64,
            guesses: self.at(l.control) + offset_of!(Control, guesses) as u64,
            most_guesses: (self.plan.queue - u64::from(live)) as u32,
            ahead,
            answered: self.at(l.records[1 - number % 2]),
            log_stretch: self.at(l.log_stretch),
            by: self.at(l.by),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_rank_is_one_pixel_and_any_share_is_spread_evenly() {
        let mut at = [[0_usize; 2]; TILE_PIXELS];
        let mut seen = [0; TILE_PIXELS];
        for (x, y) in (0..16).flat_map(|y| (0..16).map(move |x| (x, y))) {
            at[bayer_rank(x, y) as usize] = [x, y];
            seen[bayer_rank(x, y) as usize] += 1;
        }
        assert_eq!(seen, [1; TILE_PIXELS]);
        // Each 4^k ranks from a multiple of 4^k on lie in as many different squares.
        for (ranks, edge) in [(4, 8), (16, 4), (64, 2)] {
            for pixels in at.chunks(ranks) {
                let mut squares: Vec<_> = pixels.iter().map(|p| p.map(|n| n / edge)).collect();
                squares.sort_unstable();
                squares.dedup();
                assert_eq!(squares.len(), ranks);
            }
        }
        assert_eq!([[0, 0], [1, 0], [0, 1], [1, 1]].map(|[x, y]| bayer_rank(x, y) / 64), [0, 2, 3, 1]);
    }

    #[test]
    fn tiles_at_the_border_list_what_lies_inside() {
        // 3 x 2 tiles, the last column one pixel wide, the last row two pixels high.
        let pairs = [256, 0, 256, 7, 256, 256];
        let cursors = [0, 9, 200, 255, 1, 3];
        let (tiles, entries) = placed(33, 18, PairTiles { pairs: &pairs, cursors: &cursors }).unwrap();
        let offsets: Vec<u32> = tiles.iter().map(|tile| tile.offset).collect();
        let few = (0..32).filter(|i| bayer_rank(i % 16, i / 16).wrapping_add(1) < 7).count() as u32;
        assert_eq!(offsets, [0, 256, 256, 272, 272 + few, 272 + few + 32]);
        assert_eq!(entries as u32, 272 + few + 32 + 2);
        let refused = |pairs: &[u16], cursors: &[u16]| placed(33, 18, PairTiles { pairs, cursors }).is_err();
        assert!(refused(&pairs[1..], &cursors[1..]) && refused(&[257; 6], &cursors) && refused(&pairs, &[256; 6]));
    }

    #[test]
    fn bands_fit_the_memory() {
        for entries in [1, 1000, 1920 * 1080, 1 << 26] {
            let ample = Plan::new(entries, 8160, 4096, u64::MAX);
            let fixed = Layout::new(&Plan { slots: 2, queue: 4, ..ample }).end;
            for memory in [1 << 31, 1 << 28, 1 << 20] {
                let plan = Plan::new(entries, 8160, 4096, memory);
                let end = Layout::new(&plan).end;
                assert!(end <= memory.max(fixed), "{plan:?} takes {end} bytes");
                assert!(plan.slots.is_multiple_of(2) && plan.slots >= 2 && plan.queue >= 2 * plan.slots, "{plan:?}");
                assert!(ample.covers(&plan));
            }
        }
    }

    #[test]
    fn arrays_do_not_overlap() {
        let l = Layout::new(&Plan { slots: 3000, queue: 7000, entries: 2000, tiles: 77, cells: 50 });
        let [a, b, c, d, e, f, g, h, i] = l.slots;
        let slots = [(a, 16), (b, 16), (c, 16), (d, 16), (e, 16), (f, 16), (g, 8), (h, 16), (i, 16), (l.live[0], 4), (l.live[1], 4)];
        let queue = [(l.points, 12), (l.records[0], 16), (l.records[1], 16), (l.log_stretch, 4), (l.by, 1)];
        let rest = [(l.list, 8000), (l.found, 64_000), (l.tiles, 616), (l.majorants, 200), (l.may_miss, 50)];
        let ends = slots.map(|(at, size)| (at, 3000 * size)).into_iter().chain(queue.map(|(at, size)| (at, 7000 * size))).chain(rest);
        let ends: Vec<(u64, u64)> = ends.chain([(l.watch, 600), (l.control, 64), (l.end, 0)]).collect();
        for pair in ends.windows(2) {
            assert!(pair[0].0 + pair[0].1 <= pair[1].0, "{pair:?}");
            assert_eq!(pair[1].0 % 256, 0);
        }
    }
}
