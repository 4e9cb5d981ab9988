//! How a frame is cut into bands of pixels and parts of samples, and the device memory that this takes: one block, taken once.

use crate::backend::cuda::driver::pinned::Pinned;
use crate::backend::cuda::{Buffer, DeviceError, Gpu};
use crate::render::PixelValue;
use cudarc::driver::DeviceRepr;

/// Flights that a wave should have, so that sorting pays and the device is full.
const WANTED_SLOTS: u64 = 1 << 21;
/// Most flights of a wave; larger pictures are rendered band by band.
const MOST_SLOTS: u64 = 1 << 22;
/// Collisions that a queue holds for every slot that it must hold: room to look ahead.
const LEAST_QUEUE: u64 = 1 << 23;
/// Fields of a pixel's sums (`PIXEL_SUM_FIELDS` of the kernels).
const SUM_FIELDS: u64 = 11;

/// A frame's shape on the device.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(in crate::backend::cuda) struct Plan {
    /// Pixels that are tracked together.
    pub(in crate::backend::cuda) band: u32,
    /// Parts of a pixel's samples that run side by side.
    pub(in crate::backend::cuda) parts: u32,
    /// Collisions that fit the queue.
    pub(in crate::backend::cuda) queue: u32,
    /// Majorant cells.
    pub(in crate::backend::cuda) cells: u32,
}

impl Plan {
    /// The sums, and so the picture's last bits, depend on the parts, therefore these on the picture's size and its samples alone. How
    /// many pixels are tracked together follows `memory` (bytes that may be used) and changes nothing but the speed.
    pub(in crate::backend::cuda) fn new(pixels: usize, samples: u32, cells: usize, memory: u64) -> Self {
        let pixels = pixels.max(1) as u64;
        let parts = (WANTED_SLOTS / pixels).clamp(1, u64::from(samples));
        let mut band = pixels.min(MOST_SLOTS / parts).max(1);
        let mut queue = LEAST_QUEUE.max(band * parts);
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

    pub(in crate::backend::cuda) fn slots(&self) -> u64 {
        u64::from(self.band) * u64::from(self.parts)
    }

    fn bytes(&self) -> u64 {
        Layout::new(self).end
    }

    /// Whether memory that was taken for `self` does for `other`.
    pub(in crate::backend::cuda) fn covers(&self, other: &Self) -> bool {
        self.slots() >= other.slots() && self.band >= other.band && self.queue >= other.queue && self.cells == other.cells
    }
}

/// Where each array begins, in bytes.
#[derive(Debug, Clone, Copy, Default)]
pub(in crate::backend::cuda) struct Layout {
    pub(in crate::backend::cuda) place: u64,
    pub(in crate::backend::cuda) way: u64,
    pub(in crate::backend::cuda) colour: u64,
    pub(in crate::backend::cuda) progress: u64,
    pub(in crate::backend::cuda) seen: u64,
    pub(in crate::backend::cuda) first: u64,
    pub(in crate::backend::cuda) sums: u64,
    pub(in crate::backend::cuda) live: [u64; 2],
    pub(in crate::backend::cuda) points: u64,
    pub(in crate::backend::cuda) hits: [u64; 2],
    pub(in crate::backend::cuda) log_stretch: u64,
    pub(in crate::backend::cuda) by: u64,
    pub(in crate::backend::cuda) film: u64,
    pub(in crate::backend::cuda) majorants: u64,
    pub(in crate::backend::cuda) may_miss: u64,
    /// Counts, highest, missing: what is set to 0 at the start of a frame, together with `control`.
    pub(in crate::backend::cuda) watch: u64,
    pub(in crate::backend::cuda) control: u64,
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
            film: take(u64::from(plan.band), size_of::<PixelValue>() as u64),
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

/// What the kernels count (`Control` of `kernels/render.cu`).
#[repr(C)]
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(in crate::backend::cuda) struct Control {
    pub(in crate::backend::cuda) live: u32,
    pub(in crate::backend::cuda) length: u32,
    /// Queries, traced, missing, exceeded, paths, over budget.
    pub(in crate::backend::cuda) totals: [u64; 6],
}

// SAFETY: `repr(C)`, plain numbers, laid out as in `kernels/render.cu`.
unsafe impl DeviceRepr for Control {}

/// The memory of a plan.
pub(in crate::backend::cuda) struct Memory {
    pub(in crate::backend::cuda) plan: Plan,
    pub(in crate::backend::cuda) layout: Layout,
    pub(in crate::backend::cuda) block: Buffer<u8>,
    pub(in crate::backend::cuda) control: Pinned<Control>,
    pub(in crate::backend::cuda) watch: Pinned<u32>,
    pub(in crate::backend::cuda) film: Pinned<PixelValue>,
}

impl Memory {
    pub(in crate::backend::cuda) fn new(gpu: &Gpu, plan: Plan) -> Result<Self, DeviceError> {
        let layout = Layout::new(&plan);
        Ok(Self {
            plan,
            layout,
            block: gpu.alloc("rendering", layout.end as usize)?,
            control: Pinned::new(gpu, 1)?,
            watch: Pinned::new(gpu, 3 * plan.cells as usize)?,
            film: Pinned::new(gpu, plan.band as usize)?,
        })
    }

    /// Copies values to an offset of the layout that has room for them.
    pub(in crate::backend::cuda) fn write<T: Copy>(&mut self, offset: u64, values: &[T]) -> Result<(), DeviceError> {
        let bytes = size_of_val(values);
        // SAFETY: numbers and bools, whose bytes are all initialised.
        let bytes = unsafe { std::slice::from_raw_parts(values.as_ptr().cast::<u8>(), bytes) };
        self.block.write_at(offset as usize, bytes)
    }

    /// Sets bytes to 0.
    pub(in crate::backend::cuda) fn zero(&self, offset: u64, bytes: u64) -> Result<(), DeviceError> {
        self.block.zero_at(offset as usize, bytes as usize)
    }

    /// Device address of an offset of the layout.
    pub(in crate::backend::cuda) fn at(&self, offset: u64) -> u64 {
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
            assert!(ample.slots() <= MOST_SLOTS && ample.parts <= samples && u64::from(ample.queue) >= ample.slots());
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
