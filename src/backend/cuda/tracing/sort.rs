//! Points in the order of their cells.

use crate::backend::cuda::layout::SortFrame;
use crate::backend::cuda::{Buffer, DeviceError, Gpu, launch, threads};
use crate::field::{Domain, Grid};
use cudarc::driver::{CudaFunction, PushKernelArg};
use std::sync::Arc;

/// Most points sorted at once: bounds the scratch memory.
pub const MOST: usize = 1 << 24;
/// Bytes of a point in the scratch memory.
const POINT: u64 = 26;
/// `SCAN_TILE` of `sort.cu`.
const TILE: usize = 4096;
const BLOCK: u32 = 256;

/// Sorts points by cell along a Morton curve.
#[derive(Debug)]
pub struct Sorter {
    gpu: Arc<Gpu>,
    count: CudaFunction,
    tiles: CudaFunction,
    sums: CudaFunction,
    apply: CudaFunction,
    place: CudaFunction,
    scratch: Option<Scratch>,
}

#[derive(Debug)]
struct Scratch {
    capacity: usize,
    counts: Buffer<u32>,
    tiles: Buffer<u32>,
    places: Buffer<[u32; 2]>,
    sorted: Buffer<[f32; 4]>,
}

/// Cells by which points are sorted.
#[derive(Debug, Clone, Copy)]
pub struct SortCells {
    first: [f32; 3],
    per_cell: [f32; 3],
    cells: [usize; 3],
}

impl SortCells {
    /// The grid's cells; on uneven axes as many even ones.
    pub fn of_grid(grid: &Grid) -> Self {
        Self::of_domain(&grid.domain(), std::array::from_fn(|k| grid.axes.get(k).map_or(1, |axis| axis.cells())))
    }

    /// The domain in `cells` parts along each axis; axes beyond its dimensions play no part.
    pub fn of_domain(domain: &Domain, cells: [usize; 3]) -> Self {
        let cells = std::array::from_fn(|k| if k < domain.dimensions { cells[k].max(1) } else { 1 });
        let extent = domain.extent();
        Self {
            first: domain.min.map(|x| x as f32),
            per_cell: std::array::from_fn(|k| if cells[k] > 1 { (cells[k] as f64 / extent[k]) as f32 } else { 0.0 }),
            cells,
        }
    }

    /// Bits of each axis, and how many of the key are dropped for `count` points; then the number of buckets.
    fn frame(&self, count: usize) -> (SortFrame, usize) {
        // Two points a bucket on average, were the key's values all taken; about a third of them is.
        let wanted = (count / 2).max(1024).ilog2();
        let bits = self.cells.map(|n| n.next_power_of_two().trailing_zeros().min(10) as i32);
        // An axis with more cells than 10 bits can name is sorted by groups of cells.
        let shrink = |k: usize| self.cells[k].div_ceil(1 << bits[k]) as f32;
        let all = bits.iter().sum::<i32>() as u32;
        let shift = all.saturating_sub(wanted);
        let frame = SortFrame {
            first: self.first,
            per_cell: std::array::from_fn(|k| self.per_cell[k] / shrink(k)),
            bits,
            shift: shift as i32,
            last_cell: std::array::from_fn(|k| ((self.cells[k] as f32 / shrink(k)).ceil() - 1.0).max(0.0)),
        };
        (frame, 1 << (all - shift))
    }
}

impl Sorter {
    /// Compiles the kernels.
    pub fn new(gpu: &Arc<Gpu>) -> Result<Self, DeviceError> {
        let kernel = |name| gpu.kernel("sort.cu", &[], name);
        Ok(Self {
            count: kernel("sort_count")?,
            tiles: kernel("scan_tiles")?,
            sums: kernel("scan_sums")?,
            apply: kernel("scan_apply")?,
            place: kernel("sort_place")?,
            gpu: gpu.clone(),
            scratch: None,
        })
    }

    fn scratch(&mut self, count: usize, buckets: usize) -> Result<&mut Scratch, DeviceError> {
        let fits = |s: &Scratch| s.capacity >= count && s.counts.len() >= buckets;
        if !self.scratch.as_ref().is_some_and(fits) {
            // The old one goes first, so that both never need room together.
            self.scratch = None;
            let capacity = count.next_power_of_two().clamp(1 << 12, MOST);
            let most = buckets.max(capacity / 2);
            self.scratch = Some(Scratch {
                capacity,
                counts: self.gpu.alloc("sorting", most)?,
                tiles: self.gpu.alloc("sorting", most.div_ceil(TILE))?,
                places: self.gpu.alloc("sorting", capacity)?,
                sorted: self.gpu.alloc("sorting", capacity)?,
            });
        }
        self.scratch.as_mut().ok_or_else(|| DeviceError::Unsupported { what: "sorting without scratch memory".into() })
    }

    /// Points that are best sorted together: as many as there is scratch memory for, or may be.
    pub fn at_once(&self) -> usize {
        // The scratch memory is for a power of two.
        let may_be = 1 << self.gpu.batch(MOST, POINT).ilog2();
        self.scratch.as_ref().map_or(0, |scratch| scratch.capacity).max(may_be)
    }

    /// Lets go of the scratch memory until it is needed again.
    pub fn release(&mut self) {
        self.scratch = None;
    }

    /// Memory for at most `MOST` points `{x, y, z, index as bits}` in an order of the caller's making.
    pub fn buffer(&mut self, count: usize) -> Result<u64, DeviceError> {
        Ok(self.scratch(count, 1024)?.sorted.address())
    }

    /// Sorts `count` points (3 f32 each at the device address `points`), at most `MOST`. Returns the address of `{x, y, z, index as
    /// bits}`, valid until the next call.
    ///
    /// # Safety
    /// `points` holds `count` points until the work stream has passed this.
    pub unsafe fn sort(&mut self, points: u64, count: usize, cells: &SortCells) -> Result<u64, DeviceError> {
        assert!(count <= MOST, "a batch of at most {MOST} points");
        let (frame, buckets) = cells.frame(count);
        self.scratch(count, buckets)?;
        let Some(scratch) = &mut self.scratch else {
            return Err(DeviceError::Unsupported { what: "sorting without scratch memory".into() });
        };
        let (n, buckets_n, tiles_n) = (count as u32, buckets as u32, buckets.div_ceil(TILE) as u32);
        scratch.counts.zero_front(buckets)?;
        let (counts, tiles, places, sorted) =
            (scratch.counts.address(), scratch.tiles.address(), scratch.places.address(), scratch.sorted.address());
        let stream = self.gpu.work();
        let over = threads(count, BLOCK);
        let tiled = threads(buckets.div_ceil(TILE) * BLOCK as usize, BLOCK);
        // SAFETY: arguments as declared in sort.cu; scratch memory is as large as it presumes (`capacity`, `buckets`); `points` is the
        // caller's.
        unsafe {
            launch(stream.launch_builder(&self.count).arg(&points).arg(&n).arg(&frame).arg(&counts).arg(&places), over)?;
            launch(stream.launch_builder(&self.tiles).arg(&counts).arg(&buckets_n).arg(&tiles), tiled)?;
            launch(stream.launch_builder(&self.sums).arg(&tiles).arg(&tiles_n), threads(1, BLOCK))?;
            launch(stream.launch_builder(&self.apply).arg(&counts).arg(&buckets_n).arg(&tiles), tiled)?;
            launch(stream.launch_builder(&self.place).arg(&points).arg(&n).arg(&counts).arg(&places).arg(&sorted), over)?;
        }
        Ok(sorted)
    }
}
