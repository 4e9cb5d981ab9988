//! Sorts points by cell along a Morton curve (Morton 1966) with a counting sort, so that neighbouring threads read neighbouring memory.

use crate::cuda::layout::SortFrame;
use crate::cuda::{Buffer, DeviceError, Gpu, launch, threads};
use cudarc::driver::{CudaFunction, PushKernelArg};
use ridgewatch_field::{Domain, Grid};
use std::sync::Arc;

/// Maximum number of points that are sorted together. It bounds the scratch memory.
pub const MAX_POINTS: usize = 1 << 24;
/// Bytes per point in the scratch memory.
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
    /// The grid's cells; on an uneven axis the same number of even ones.
    pub fn of_grid(grid: &Grid) -> Self {
        Self::of_domain(&grid.domain(), std::array::from_fn(|k| grid.axes.get(k).map_or(1, |axis| axis.cells())))
    }

    /// The domain divided into `cells` parts along each axis. Axes beyond its dimensions are not used.
    pub fn of_domain(domain: &Domain, cells: [usize; 3]) -> Self {
        let cells = std::array::from_fn(|k| if k < domain.dimensions { cells[k].max(1) } else { 1 });
        let extent = domain.extent();
        Self {
            first: domain.min.map(|x| x as f32),
            per_cell: std::array::from_fn(|k| if cells[k] > 1 { (cells[k] as f64 / extent[k]) as f32 } else { 0.0 }),
            cells,
        }
    }

    /// Kernel argument for `count` points, and the number of buckets.
    fn frame(&self, count: usize) -> (SortFrame, usize) {
        // Two points per bucket on average if all keys were in use; about a third of them is.
        let wanted = (count / 2).max(1024).ilog2();
        let bits = self.cells.map(|n| n.next_power_of_two().trailing_zeros().min(10) as i32);
        // An axis with more than 2^10 cells is sorted by groups of cells.
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
    ///
    /// # Errors
    /// A kernel does not compile or load.
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
        // Freed first, so that old and new memory are never allocated together.
        let scratch = match self.scratch.take().filter(|s| s.capacity >= count && s.counts.len() >= buckets) {
            Some(scratch) => scratch,
            None => {
                let capacity = count.next_power_of_two().clamp(1 << 12, MAX_POINTS);
                let counts = buckets.max(capacity / 2);
                Scratch {
                    capacity,
                    counts: self.gpu.alloc("sorting", counts)?,
                    tiles: self.gpu.alloc("sorting", counts.div_ceil(TILE))?,
                    places: self.gpu.alloc("sorting", capacity)?,
                    sorted: self.gpu.alloc("sorting", capacity)?,
                }
            }
        };
        Ok(self.scratch.insert(scratch))
    }

    /// Number of points that should be sorted together: the capacity of the scratch memory, or the one that it may grow to.
    pub fn at_once(&self) -> usize {
        // The capacity is a power of two.
        let may_be = 1 << self.gpu.batch(MAX_POINTS, POINT).ilog2();
        self.scratch.as_ref().map_or(0, |scratch| scratch.capacity).max(may_be)
    }

    /// Frees the scratch memory until it is needed again.
    pub fn release(&mut self) {
        self.scratch = None;
    }

    /// Address of memory for at most `MAX_POINTS` entries `{x, y, z, index as bits}`, which the caller fills.
    ///
    /// # Errors
    /// Out of memory.
    pub fn buffer(&mut self, count: usize) -> Result<u64, DeviceError> {
        Ok(self.scratch(count, 1024)?.sorted.address())
    }

    /// Sorts `count` points (3 f32 each at the device address `points`), at most `MAX_POINTS`. Returns the address of `{x, y, z, index as
    /// bits}`, valid until the next call.
    ///
    /// # Errors
    /// Out of memory, or an error of the driver.
    ///
    /// # Safety
    /// `points` holds `count` points until the work stream has passed this call.
    pub unsafe fn sort(&mut self, points: u64, count: usize, cells: &SortCells) -> Result<u64, DeviceError> {
        assert!(count <= MAX_POINTS, "a batch of at most {MAX_POINTS} points");
        let (frame, buckets) = cells.frame(count);
        let scratch = self.scratch(count, buckets)?;
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
