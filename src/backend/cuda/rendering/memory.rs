//! Splits a frame into bands of pixels and parts of samples, and lays out its device memory, which is one allocation.
//!
//! A slot holds the state of one flight of a light path (delta tracking from collision to collision). Each band runs `band * parts` slots at once.

use crate::cuda::driver::pinned::Pinned;
use crate::cuda::{Buffer, DeviceError, Gpu};
use cudarc::driver::DeviceRepr;

/// Target number of slots: enough to fill the device and to make sorting worthwhile.
const WANTED_SLOTS: u64 = 1 << 21;
/// Limit on the slots; larger pictures are rendered band by band.
const MAX_SLOTS: u64 = 1 << 22;
/// Minimum length of the collision queue if memory allows: room for speculative queries beyond one collision per slot.
const MIN_QUEUE: u64 = 1 << 23;
/// Number of sums per pixel (`PIXEL_SUM_FIELDS` of the kernels).
const SUM_FIELDS: u64 = 11;
/// Floats per pixel of the film: four of its colour, and its other planes.
const FILM_FLOATS: u64 = 10;

/// Sizes of a frame's arrays on the device.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(in crate::cuda) struct Plan {
    /// Pixels that are tracked together.
    pub(in crate::cuda) band: u32,
    /// Parts of a pixel's samples that run concurrently.
    pub(in crate::cuda) parts: u32,
    /// Capacity of the collision queue.
    pub(in crate::cuda) queue: u32,
    /// Number of majorant cells.
    pub(in crate::cuda) cells: u32,
}

impl Plan {
    /// Plans a frame that uses at most `memory` bytes, if one pixel per band suffices for that. The number of parts sets the order of the sums, and
    /// therefore the last bits of the picture. So it depends only on the number of pixels and samples. The size of a band depends on `memory` and
    /// affects only the speed.
    pub(in crate::cuda) fn new(pixels: usize, samples: u32, cells: usize, memory: u64) -> Self {
        let pixels = pixels.max(1) as u64;
        let parts = (WANTED_SLOTS / pixels).clamp(1, u64::from(samples));
        let mut band = pixels.min(MAX_SLOTS / parts).max(1);
        let mut queue = MIN_QUEUE.max(band * parts);
        let plan = |band: u64, queue: u64| Self { band: band as u32, parts: parts as u32, queue: queue as u32, cells: cells as u32 };
        while plan(band, queue).bytes() > memory && band > 1 {
            if queue > band * parts {
                queue = (queue / 2).max(band * parts);
            } else {
                band = band.div_ceil(2);
                queue = band * parts;
            }
        }
        plan(band, queue)
    }

    pub(in crate::cuda) fn slots(&self) -> u64 {
        u64::from(self.band) * u64::from(self.parts)
    }

    fn bytes(&self) -> u64 {
        Layout::new(self).end
    }

    /// Returns true if the memory of `self` is large enough for `other`.
    pub(in crate::cuda) fn covers(&self, other: &Self) -> bool {
        self.slots() >= other.slots() && self.band >= other.band && self.queue >= other.queue && self.cells == other.cells
    }
}

/// Offset of each array in the allocation, bytes.
#[derive(Debug, Clone, Copy, Default)]
pub(in crate::cuda) struct Layout {
    pub(in crate::cuda) place: u64,
    pub(in crate::cuda) way: u64,
    pub(in crate::cuda) colour: u64,
    pub(in crate::cuda) progress: u64,
    pub(in crate::cuda) seen: u64,
    pub(in crate::cuda) first: u64,
    pub(in crate::cuda) sums: u64,
    pub(in crate::cuda) live: [u64; 2],
    pub(in crate::cuda) points: u64,
    pub(in crate::cuda) hits: [u64; 2],
    pub(in crate::cuda) log_stretch: u64,
    pub(in crate::cuda) by: u64,
    pub(in crate::cuda) film: u64,
    pub(in crate::cuda) majorants: u64,
    pub(in crate::cuda) may_miss: u64,
    /// Observations of each majorant cell: counts, highest values, missing values. Set to 0 at the start of a frame, together with `control`.
    pub(in crate::cuda) watch: u64,
    pub(in crate::cuda) control: u64,
    end: u64,
}

impl Layout {
    fn new(plan: &Plan) -> Self {
        let (slots, queue, cells) = (plan.slots(), u64::from(plan.queue), u64::from(plan.cells));
        let mut end = 0;
        let mut take = |count: u64, size: u64| {
            let begin = end;
            end = (begin + count * size).next_multiple_of(256);
            begin
        };
        let mut layout = Self {
            place: take(slots, 16),
            way: take(slots, 16),
            colour: take(slots, 16),
            progress: take(slots, 16),
            seen: take(slots, 8),
            first: take(slots, 4),
            sums: take(slots, 8 * SUM_FIELDS),
            live: [take(slots, 4), take(slots, 4)],
            points: take(queue, 12),
            hits: [take(queue, 16), take(queue, 16)],
            log_stretch: take(queue, 4),
            by: take(queue, 1),
            film: take(u64::from(plan.band), FILM_FLOATS * 4),
            majorants: take(cells, 4),
            may_miss: take(cells, 1),
            watch: take(3 * cells, 4),
            control: take(1, size_of::<Control>() as u64),
            end: 0,
        };
        layout.end = end;
        layout
    }
}

/// Counters of the kernels (`Control` of `kernels/rendering/render.cu`).
#[repr(C)]
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(in crate::cuda) struct Control {
    pub(in crate::cuda) live: u32,
    pub(in crate::cuda) length: u32,
    /// Queries, traced queries, queries in missing cells, exceeded majorants, finished paths, queries over the tracing budget.
    pub(in crate::cuda) totals: [u64; 6],
}

// SAFETY: `repr(C)`, plain numbers, laid out as in `kernels/rendering/render.cu`.
unsafe impl DeviceRepr for Control {}

/// Device memory of a plan, and pinned memory for its readback.
pub(in crate::cuda) struct Memory {
    pub(in crate::cuda) plan: Plan,
    pub(in crate::cuda) layout: Layout,
    pub(in crate::cuda) block: Buffer<u8>,
    pub(in crate::cuda) control: Pinned<Control>,
    pub(in crate::cuda) watch: Pinned<u32>,
}

impl Memory {
    /// Allocates the memory of a plan.
    ///
    /// # Errors
    /// The device fails or lacks memory.
    pub(in crate::cuda) fn new(gpu: &Gpu, plan: Plan) -> Result<Self, DeviceError> {
        let layout = Layout::new(&plan);
        Ok(Self {
            plan,
            layout,
            block: gpu.alloc("rendering", layout.end as usize)?,
            control: Pinned::new(gpu.context(), 1)?,
            watch: Pinned::new(gpu.context(), 3 * plan.cells as usize)?,
        })
    }

    /// Copies values to an offset of the layout.
    ///
    /// # Errors
    /// A driver call fails.
    pub(in crate::cuda) fn write<T: Copy>(&mut self, offset: u64, values: &[T]) -> Result<(), DeviceError> {
        let bytes = size_of_val(values);
        // SAFETY: numbers and bools, whose bytes are all initialised.
        let bytes = unsafe { std::slice::from_raw_parts(values.as_ptr().cast::<u8>(), bytes) };
        self.block.write_at(offset as usize, bytes)
    }

    /// Sets `bytes` bytes from an offset on to 0.
    ///
    /// # Errors
    /// A driver call fails.
    pub(in crate::cuda) fn zero(&self, offset: u64, bytes: u64) -> Result<(), DeviceError> {
        self.block.zero_at(offset as usize, bytes as usize)
    }

    /// Device address of an offset of the layout.
    pub(in crate::cuda) fn at(&self, offset: u64) -> u64 {
        self.block.address() + offset
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parts_do_not_depend_on_memory_and_bands_fit_it() {
        for (pixels, samples) in [(1920 * 1080, 1), (320 * 160, 64), (200 * 100, 4096), (8192 * 8192, 4), (1, 1)] {
            let ample = Plan::new(pixels, samples, 4096, u64::MAX);
            assert!(ample.slots() <= MAX_SLOTS && ample.parts <= samples && u64::from(ample.queue) >= ample.slots());
            for memory in [1 << 31, 1 << 28, 1 << 24] {
                let plan = Plan::new(pixels, samples, 4096, memory);
                assert_eq!(plan.parts, ample.parts, "{pixels} pixels, {memory} bytes");
                assert!(plan.bytes() <= memory || plan.band == 1, "{plan:?} takes {} bytes", plan.bytes());
                assert!(u64::from(plan.queue) >= plan.slots());
                assert!(ample.covers(&plan));
            }
        }
        let hd = Plan::new(1920 * 1080, 1, 4096, u64::MAX);
        assert_eq!((hd.band, hd.parts), (1920 * 1080, 1));
        assert_eq!(Plan::new(320 * 160, 64, 1, u64::MAX).parts, 40);
    }

    #[test]
    fn arrays_do_not_overlap() {
        let plan = Plan { band: 1000, parts: 3, queue: 5000, cells: 77 };
        let l = Layout::new(&plan);
        let ends = [
            (l.place, 48_000),
            (l.way, 48_000),
            (l.colour, 48_000),
            (l.progress, 48_000),
            (l.seen, 24_000),
            (l.first, 12_000),
            (l.sums, 264_000),
            (l.live[0], 12_000),
            (l.live[1], 12_000),
            (l.points, 60_000),
            (l.hits[0], 80_000),
            (l.hits[1], 80_000),
            (l.log_stretch, 20_000),
            (l.by, 5000),
            (l.film, 40_000),
            (l.majorants, 308),
            (l.may_miss, 77),
            (l.watch, 924),
            (l.control, 56),
        ];
        for pair in ends.windows(2) {
            assert!(pair[0].0 + pair[0].1 <= pair[1].0, "{pair:?}");
            assert_eq!(pair[1].0 % 256, 0);
        }
        assert!(l.control + 56 <= l.end);
    }
}
