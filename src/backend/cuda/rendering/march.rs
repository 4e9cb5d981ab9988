//! Marched pictures on the GPU: surrogates laid out on nodes, light volumes, and rays. The algorithm and its reference are in
//! [`ridgewatch_render::smooth`].
//!
//! A picture of 1920x1080 pixels through 600x192x192 nodes reads at most the 88 MB of nodes and about as much light volume from memory, 40 us on an
//! H200. Its hundreds of millions of quadrature points with 16 loads each take longer: neighbouring rays run in one warp, so that their loads share
//! cache lines, and bricks that the transfer function does not show are skipped.

use super::renderer::ParametersArgument;
use super::router::DevicePredict;
use crate::cuda::driver::pinned::Pinned;
use crate::cuda::layout::{MissingCellsArgument, TableArgument, device_repr};
use crate::cuda::{Buffer, DeviceError, DeviceMissingCells, DeviceTable, Gpu, launch, threads};
use bytemuck::Zeroable;
use cudarc::driver::{CudaFunction, DeviceRepr, LaunchConfig, PushKernelArg};
use ridgewatch_render::smooth::{LightGrid, MARGIN, brick_shape};
use ridgewatch_render::{FrameParameters, Renderer};
use std::marker::PhantomData;
use std::sync::Arc;

/// Sums over the rays of a pixel (`RAY_FIELDS` of the kernels): red, green, blue, alpha, FTLE, missing.
pub(in crate::cuda) const RAY_FIELDS: usize = 6;
/// Nodes of a network that are predicted at once; their points take 12 MB.
const NODES_AT_ONCE: usize = 1 << 20;
/// Columns of a block of `march_columns`.
const COLUMN_BLOCK: [usize; 2] = [16, 8];
/// Width of a block of `march_pixels`, and its height if a pixel has one thread, in pixels.
const PIXEL_BLOCK: usize = 16;
/// Threads of a block of `march_checks`.
const CHECK_BLOCK: u32 = 1024;
/// Threads of a block if there are at least `MANY_CHECKS`: several blocks share a multiprocessor then, and one composes its ray while others look up.
const SMALL_CHECK_BLOCK: u32 = 128;
const MANY_CHECKS: usize = 1024;
/// Threads of the blocks that mend rays, and blocks for each multiprocessor: several share one, and rays differ in length.
const MEND_BLOCK: u32 = 128;
const MEND_BLOCKS_EACH: u32 = 32;

/// `Bricks` of `march.cuh`.
#[repr(C)]
#[derive(Debug, Clone, Copy, Zeroable)]
pub(crate) struct BricksArgument {
    highest: u64,
    count: [i32; 3],
    usable: i32,
}

/// `LightVolume` of `march.cuh`.
#[repr(C)]
#[derive(Debug, Clone, Copy, Zeroable)]
pub(crate) struct LightArgument {
    depth: u64,
    nodes: [i32; 3],
    axes: [i32; 3],
    width: [i32; 2],
    margin: i32,
    reversed: i32,
    shift: [f32; 2],
    last: [f32; 2],
    step: f32,
    parts: i32,
    first: [i32; 2],
    columns: [i32; 2],
}

impl LightArgument {
    /// The volume on this grid, with its values at the device address `depth`.
    pub(crate) fn new(grid: &LightGrid, depth: u64) -> Self {
        let size = grid.size.map(|n| n as i32);
        let common = Self {
            depth,
            nodes: grid.nodes.map(|n| n as i32),
            width: [size[0], size[1]],
            parts: grid.samples as i32,
            step: grid.step,
            ..Self::zeroed()
        };
        let Some(shear) = &grid.shear else {
            return Self { axes: [2, 0, 1], last: [0, 1].map(|side| (size[side] - 2) as f32), ..common };
        };
        let columns = [0, 1].map(|side| grid.columns(shear, side));
        Self {
            axes: [shear.major, shear.lateral[0], shear.lateral[1]].map(|k| k as i32),
            margin: MARGIN,
            reversed: i32::from(shear.from_above),
            shift: shear.slope,
            // Any column may begin an interpolation; the bound keeps the conversion to integers defined.
            last: [1e6; 2],
            step: shear.length,
            first: columns.each_ref().map(|columns| *columns.start()),
            columns: columns.each_ref().map(|columns| columns.end() - columns.start() + 1),
            ..common
        }
    }
}

/// `March` of `march.cuh`.
#[repr(C)]
#[derive(Debug, Clone, Copy)]
struct MarchArgument {
    nodes: TableArgument,
    missing_cells: MissingCellsArgument,
    bricks: BricksArgument,
    light: LightArgument,
    step: f32,
    first_ray: u32,
    rays: u32,
    shifted: i32,
}

/// A ray that [`GpuMarch::check`] marches apart from the picture (`Check` of `march.cuh`).
#[repr(C)]
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct RayCheck {
    /// Pixel, row by row.
    pub pixel: u32,
    /// Number of the ray in its pixel.
    pub ray: u32,
    /// Longest step, scene units.
    pub step: f32,
    /// Longest step to the light, scene units. 0: the light volume is used. Ignored for mended rays.
    pub shadow_step: f32,
}

const _: () = assert!(size_of::<BricksArgument>() == 24 && size_of::<LightArgument>() == 88 && size_of::<MarchArgument>() == 248);

device_repr!(BricksArgument, MarchArgument, RayCheck);

// SAFETY: `repr(C)`, plain numbers without padding, as the assertion on the size shows.
unsafe impl bytemuck::NoUninit for LightArgument {}

/// Returns memory for at least `len` values, of which `slot` keeps the ownership. Allocates only if `slot` holds less.
pub(super) fn room<'a, T: DeviceRepr>(
    gpu: &Gpu,
    slot: &'a mut Option<Buffer<T>>,
    what: &str,
    len: usize,
) -> Result<&'a mut Buffer<T>, DeviceError> {
    if slot.as_ref().is_none_or(|held| held.len() < len) {
        // The old memory is freed first, so that both need not fit.
        *slot = None;
    }
    match slot {
        Some(held) => Ok(held),
        none => Ok(none.insert(gpu.alloc(what, len)?)),
    }
}

/// The same for pinned memory.
pub(super) fn pinned_room<'a, T: Copy + Default>(
    gpu: &Gpu,
    slot: &'a mut Option<Pinned<T>>,
    len: usize,
) -> Result<&'a mut Pinned<T>, DeviceError> {
    if slot.as_ref().is_none_or(|held| held.len() < len) {
        *slot = None;
    }
    match slot {
        Some(held) => Ok(held),
        none => Ok(none.insert(Pinned::new(gpu.context(), len)?)),
    }
}

/// A surrogate on nodes, in device memory that is borrowed for `'a`.
#[derive(Debug, Clone, Copy)]
pub struct NodeGrid<'a> {
    argument: TableArgument,
    _memory: PhantomData<&'a ()>,
}

impl BricksArgument {
    /// Bricks of nodes, with room for a value of each at `highest`; `usable` as in `march.cuh`.
    pub(super) fn of(nodes: NodeGrid<'_>, highest: u64, usable: bool) -> Self {
        Self { highest, count: brick_shape(nodes.shape()).map(|n| n as i32), usable: i32::from(usable) }
    }
}

impl NodeGrid<'_> {
    /// Nodes along x, y, z; one along z for a two-dimensional flow.
    pub fn shape(&self) -> [usize; 3] {
        self.argument.nodes.map(|n| n as usize)
    }

    /// Kernel argument, the struct `Table` of `table.cuh`.
    pub(in crate::cuda) fn argument(&self) -> TableArgument {
        self.argument
    }
}

/// Nodes on which networks are laid out. Tables are on nodes already and are borrowed.
pub struct DeviceNodes {
    gpu: Arc<Gpu>,
    points: CudaFunction,
    mend: CudaFunction,
    unit: Option<Buffer<f32>>,
    values: Option<Buffer<f32>>,
    not_finite: Option<Buffer<u32>>,
    laid: Option<TableArgument>,
}

impl DeviceNodes {
    /// Compiles the kernels or loads them from the cache.
    ///
    /// # Errors
    /// A kernel does not compile, or the device fails.
    pub fn new(gpu: &Arc<Gpu>) -> Result<Self, DeviceError> {
        let points = gpu.kernel("march.cu", &variant(true, true), "node_points")?;
        let mend = gpu.kernel("table.cu", &[], "table_mend")?;
        Ok(Self { gpu: gpu.clone(), points, mend, unit: None, values: None, not_finite: None, laid: None })
    }

    /// Lays out a network on `nodes` nodes along x, y, z (one along z for a two-dimensional flow), for [`Self::grid`] until the next call. Values that
    /// are not finite become 0.
    ///
    /// # Errors
    /// The grid has more nodes than 32 bits can count, or the device fails or lacks memory.
    pub fn lay_out(&mut self, network: &dyn DevicePredict, nodes: [usize; 3], dimensions: usize) -> Result<(), DeviceError> {
        self.laid = None;
        let dimensions = dimensions.clamp(2, 3);
        let nodes: [usize; 3] = std::array::from_fn(|k| if k < dimensions { nodes[k].max(2) } else { 1 });
        let all = nodes.iter().try_fold(1_usize, |all, n| all.checked_mul(*n)).filter(|all| *all < u32::MAX as usize);
        let Some(all) = all else { return Err(DeviceError::Unsupported { what: format!("a surrogate on {nodes:?} nodes") }) };
        let gpu = self.gpu.clone();
        let what = "a network on nodes";
        let values = room(&gpu, &mut self.values, what, all)?.address();
        let at_once = NODES_AT_ONCE.min(all);
        let unit = room(&gpu, &mut self.unit, what, 3 * at_once)?.address();
        let not_finite = room(&gpu, &mut self.not_finite, what, 1)?;
        not_finite.zero_front(1)?;
        let (counter, total) = (not_finite.address(), all as u64);
        let argument = TableArgument { nodes: nodes.map(|n| n as i32), dimensions: dimensions as i32, values };
        let stream = gpu.work();
        for first in (0..all).step_by(at_once) {
            let count = at_once.min(all - first);
            let (from, n) = (first as u64, count as u32);
            let mut call = stream.launch_builder(&self.points);
            call.arg(&argument).arg(&from).arg(&n).arg(&unit);
            // SAFETY: the arguments of `node_points`; `unit` holds `at_once` points and `values` all nodes. Both live in `self`, which frees them in
            // the order of the stream.
            unsafe {
                launch(&mut call, threads(count, 256))?;
                network.predict(unit, count, values + (first * size_of::<f32>()) as u64)?;
            }
        }
        let mut call = stream.launch_builder(&self.mend);
        call.arg(&values).arg(&total).arg(&counter);
        // SAFETY: the arguments of `table_mend`; `values` holds `all` values.
        unsafe { launch(&mut call, threads(all, 256)) }?;
        self.laid = Some(argument);
        Ok(())
    }

    /// The nodes of `table`, which are borrowed; without a table those of the latest [`Self::lay_out`], if any.
    pub fn grid<'a>(&'a self, table: Option<&'a DeviceTable>) -> Option<NodeGrid<'a>> {
        let argument = table.map(DeviceTable::argument).or(self.laid);
        argument.map(|argument| NodeGrid { argument, _memory: PhantomData })
    }
}

/// Macros of `march.cu`.
pub(super) fn variant(holes: bool, point_light: bool) -> Vec<String> {
    vec![format!("RW_HOLES={}", u8::from(holes)), format!("RW_POINT_LIGHT={}", u8::from(point_light))]
}

/// Kernels of one variant.
struct Kernels {
    variant: [bool; 2],
    bricks: CudaFunction,
    columns: CudaFunction,
    points: CudaFunction,
    pixels: CudaFunction,
    checks: CudaFunction,
}

impl Kernels {
    fn new(gpu: &Gpu, holes: bool, point_light: bool) -> Result<Self, DeviceError> {
        let kernel = |name| gpu.kernel("march.cu", &variant(holes, point_light), name);
        Ok(Self {
            variant: [holes, point_light],
            bricks: kernel("march_bricks")?,
            columns: kernel("march_columns")?,
            points: kernel("march_points")?,
            pixels: kernel("march_pixels")?,
            checks: kernel("march_checks")?,
        })
    }
}

/// Kernels of `mend.cu` in one variant, with their memory.
struct Mending {
    variant: [bool; 2],
    list: CudaFunction,
    pixels: CudaFunction,
    checks: CudaFunction,
    /// Pixels whose ray is mended.
    listed: Option<Buffer<u32>>,
    length: Buffer<u32>,
}

impl Mending {
    /// Those of a variant, of which `slot` keeps the ownership. Few pictures need them, so that they are compiled when they do.
    fn of<'a>(gpu: &Gpu, slot: &'a mut Option<Self>, variant: [bool; 2]) -> Result<&'a mut Self, DeviceError> {
        *slot = slot.take().filter(|mending| mending.variant == variant);
        let kernel = |name| gpu.kernel("mend.cu", &self::variant(variant[0], variant[1]), name);
        match slot {
            Some(mending) => Ok(mending),
            none => Ok(none.insert(Self {
                variant,
                list: kernel("mend_list")?,
                pixels: kernel("mend_pixels")?,
                checks: kernel("mend_checks")?,
                listed: None,
                length: gpu.alloc("pixels with mended rays", 1)?,
            })),
        }
    }
}

/// What is marched through: the same in all calls between two calls of [`GpuMarch::prepare`].
#[derive(Clone, Copy)]
pub struct Medium<'a> {
    /// The frame's scene.
    pub parameters: &'a FrameParameters,
    /// The surrogate.
    pub nodes: NodeGrid<'a>,
    /// Missing cells. `None` if every cell has data.
    pub missing_cells: Option<&'a DeviceMissingCells>,
}

/// Marches rays and accumulates them on the device. It reuses its memory between frames.
pub struct GpuMarch {
    gpu: Arc<Gpu>,
    kernels: Kernels,
    mending: Option<Mending>,
    highest: Option<Buffer<f32>>,
    depth: Option<Buffer<f32>>,
    /// `RAY_FIELDS` planes.
    sums: Option<Buffer<f64>>,
    checks: Option<Buffer<RayCheck>>,
    checked: Option<Buffer<f32>>,
    ready: Option<(BricksArgument, LightArgument)>,
    rays: u32,
    pixels: usize,
}

impl GpuMarch {
    /// Compiles the kernels of usual scenes or loads them from the cache.
    ///
    /// # Errors
    /// A kernel does not compile, or the device fails.
    pub fn new(gpu: &Arc<Gpu>) -> Result<Self, DeviceError> {
        let kernels = Kernels::new(gpu, false, false)?;
        let (highest, depth, sums, checks, checked) = (None, None, None, None, None);
        Ok(Self { gpu: gpu.clone(), kernels, mending: None, highest, depth, sums, checks, checked, ready: None, rays: 0, pixels: 0 })
    }

    /// Computes bricks and light volume, on the work stream. To be called when nodes, missing cells, light, transfer function or `refine` have
    /// changed. The light volume gets at most about `max_values` values; `refine` multiplies its quadrature points. The picture starts anew.
    ///
    /// # Errors
    /// The device fails or lacks memory.
    pub fn prepare(&mut self, renderer: &Renderer, medium: &Medium<'_>, max_values: usize, refine: usize) -> Result<(), DeviceError> {
        (self.ready, self.rays) = (None, 0);
        let gpu = self.gpu.clone();
        // Values are addressed with 32 bits.
        let grid = renderer.light_grid(medium.nodes.shape(), max_values.min(u32::MAX as usize), refine);
        if grid.values() > u32::MAX as usize {
            return Err(DeviceError::Unsupported { what: format!("a light volume of {:?} values", grid.size) });
        }
        let variant = [medium.missing_cells.is_some(), grid.shear.is_none()];
        if self.kernels.variant != variant {
            self.kernels = Kernels::new(&gpu, variant[0], variant[1])?;
        }
        let bricks = brick_shape(medium.nodes.shape()).iter().product::<usize>();
        let highest = room(&gpu, &mut self.highest, "bricks of nodes", bricks)?.address();
        let bricks_argument = BricksArgument::of(medium.nodes, highest, medium.missing_cells.is_none());
        let depth = room(&gpu, &mut self.depth, "the light volume", grid.values())?.address();
        let light = LightArgument::new(&grid, depth);
        let stream = gpu.work();
        let (nodes, n) = (medium.nodes.argument(), bricks as u32);
        let mut call = stream.launch_builder(&self.kernels.bricks);
        call.arg(&nodes).arg(&bricks_argument).arg(&n).arg(&highest);
        // SAFETY: the arguments of `march_bricks`, whose blocks do eight bricks; `highest` holds `bricks` values.
        unsafe { launch(&mut call, threads(bricks * 32, 256)) }?;
        let (parameters, argument) = (ParametersArgument(*medium.parameters), Self::argument(medium, bricks_argument, light));
        let values = grid.values() as u32;
        if grid.shear.is_none() {
            let mut call = stream.launch_builder(&self.kernels.points);
            call.arg(&parameters).arg(&argument).arg(&values);
            // SAFETY: the arguments of `march_points`; `depth` holds `values` values, and `medium` borrows the nodes and missing cells, which their
            // owners free in the order of the stream.
            unsafe { launch(&mut call, threads(grid.values(), 128)) }?;
        } else {
            let blocks = |side: usize| (light.columns[side] as usize).div_ceil(COLUMN_BLOCK[side]) as u32;
            let config = LaunchConfig { grid_dim: (blocks(0), blocks(1), 1), block_dim: (128, 1, 1), shared_mem_bytes: 0 };
            let mut call = stream.launch_builder(&self.kernels.columns);
            call.arg(&parameters).arg(&argument);
            // SAFETY: the arguments of `march_columns`, as above.
            unsafe { launch(&mut call, config) }?;
        }
        self.ready = Some((bricks_argument, light));
        Ok(())
    }

    fn argument(medium: &Medium<'_>, bricks: BricksArgument, light: LightArgument) -> MarchArgument {
        MarchArgument {
            nodes: medium.nodes.argument(),
            missing_cells: medium.missing_cells.map_or_else(Zeroable::zeroed, DeviceMissingCells::argument),
            bricks,
            light,
            step: 0.0,
            first_ray: 0,
            rays: 0,
            shifted: 0,
        }
    }

    fn ready(&self, medium: &Medium<'_>) -> Result<MarchArgument, DeviceError> {
        let Some((bricks, light)) = self.ready else { return Err(DeviceError::Unsupported { what: "marching before preparation".into() }) };
        Ok(Self::argument(medium, bricks, light))
    }

    /// Forgets the rays so far, for another camera or step.
    pub fn restart(&mut self) {
        self.rays = 0;
    }

    /// Rays of each pixel since the restart.
    pub fn rays(&self) -> u32 {
        self.rays
    }

    /// Marches `rays` more rays of each pixel, on the work stream, in steps of at most `step` scene units. `mended`: they are unbiased estimates of the
    /// surrogate's expected picture ([`ridgewatch_render::smooth::Medium::mended_ray`]).
    ///
    /// # Errors
    /// Nothing was prepared, or the device fails or lacks memory.
    pub fn march(&mut self, medium: &Medium<'_>, step: f32, rays: u32, mended: bool) -> Result<(), DeviceError> {
        let gpu = self.gpu.clone();
        let pixels = medium.parameters.pixels();
        if self.pixels != pixels {
            (self.pixels, self.rays) = (pixels, 0);
        }
        if rays == 0 {
            return Ok(());
        }
        let parameters = ParametersArgument(*medium.parameters);
        let argument = MarchArgument { step, first_ray: self.rays, rays, shifted: i32::from(mended), ..self.ready(medium)? };
        let sums = room(&gpu, &mut self.sums, "sums over rays", RAY_FIELDS * pixels)?.address();
        let fresh = i32::from(self.rays == 0);
        let [width, height] = medium.parameters.size();
        let lanes = [4, 2].into_iter().find(|lanes| rays.is_multiple_of(*lanes)).unwrap_or(1);
        let blocks = |n: usize, pixels: usize| n.div_ceil(pixels) as u32;
        let grid_dim = (blocks(width, PIXEL_BLOCK), blocks(height, PIXEL_BLOCK / lanes as usize), 1);
        let config = LaunchConfig { grid_dim, block_dim: (256, 1, 1), shared_mem_bytes: 0 };
        let mut call = gpu.work().launch_builder(&self.kernels.pixels);
        call.arg(&parameters).arg(&argument).arg(&sums).arg(&fresh).arg(&lanes);
        // SAFETY: the arguments of `march_pixels`; `sums` holds `RAY_FIELDS` planes of the pixels, which an earlier call has written unless this one
        // is fresh; `medium` borrows nodes and missing cells.
        unsafe { launch(&mut call, config) }?;
        if mended {
            self.mend(&parameters, &argument, sums)?;
        }
        self.rays += rays;
        Ok(())
    }

    /// Mends the rays of a pass, which `sums` hold.
    fn mend(&mut self, parameters: &ParametersArgument, argument: &MarchArgument, sums: u64) -> Result<(), DeviceError> {
        let (gpu, pixels) = (&self.gpu, self.pixels as u32);
        let mending = Mending::of(gpu, &mut self.mending, self.kernels.variant)?;
        let list = room(gpu, &mut mending.listed, "pixels with mended rays", self.pixels)?.address();
        let length = mending.length.address();
        let config =
            LaunchConfig { grid_dim: (MEND_BLOCKS_EACH * gpu.multiprocessors(), 1, 1), block_dim: (MEND_BLOCK, 1, 1), shared_mem_bytes: 0 };
        for number in argument.first_ray..argument.first_ray + argument.rays {
            mending.length.zero_front(1)?;
            let mut call = gpu.work().launch_builder(&mending.list);
            call.arg(parameters).arg(&number).arg(&pixels).arg(&length).arg(&list);
            // SAFETY: the arguments of `mend_list`; the list holds all pixels, each of which is listed at most once.
            unsafe { launch(&mut call, threads(self.pixels, 256)) }?;
            let mut call = gpu.work().launch_builder(&mending.pixels);
            call.arg(parameters).arg(argument).arg(&number).arg(&length).arg(&list).arg(&sums);
            // SAFETY: the arguments of `mend_pixels`; `sums` holds `RAY_FIELDS` planes of the pixels, which `march_pixels` has written.
            unsafe { launch(&mut call, config) }?;
        }
        Ok(())
    }

    /// Device address of the sums over rays, `RAY_FIELDS` planes of f64. `None` before the first ray.
    pub(in crate::cuda) fn sums(&self) -> Option<u64> {
        self.sums.as_ref().filter(|_| self.rays > 0).map(Buffer::address)
    }

    /// Number of pixels of the sums.
    pub(in crate::cuda) fn pixels(&self) -> usize {
        self.pixels
    }

    /// Marches single rays apart from the picture and returns their radiances and opacities. `mended`: as those of [`Self::march`]. Waits for the result.
    ///
    /// # Errors
    /// Nothing was prepared, or the device fails or lacks memory.
    pub fn check(&mut self, medium: &Medium<'_>, checks: &[RayCheck], mended: bool) -> Result<Vec<[f32; 4]>, DeviceError> {
        if checks.is_empty() {
            return Ok(Vec::new());
        }
        let gpu = self.gpu.clone();
        let parameters = ParametersArgument(*medium.parameters);
        let argument = MarchArgument { shifted: i32::from(mended), ..self.ready(medium)? };
        let what = "checks of the march";
        let from = room(&gpu, &mut self.checks, what, checks.len())?;
        from.write(checks)?;
        let out = room(&gpu, &mut self.checked, what, 4 * checks.len())?;
        let (given, found) = (from.address(), out.address());
        let (kernel, block) = match mended {
            true => (&Mending::of(&gpu, &mut self.mending, self.kernels.variant)?.checks, MEND_BLOCK),
            false => (&self.kernels.checks, if checks.len() < MANY_CHECKS { CHECK_BLOCK } else { SMALL_CHECK_BLOCK }),
        };
        let config = LaunchConfig { grid_dim: (checks.len() as u32, 1, 1), block_dim: (block, 1, 1), shared_mem_bytes: 0 };
        let mut call = gpu.work().launch_builder(kernel);
        call.arg(&parameters).arg(&argument).arg(&given).arg(&found);
        // SAFETY: the arguments of `march_checks` and of `mend_checks`; both arrays have an entry for each block.
        unsafe { launch(&mut call, config) }?;
        let mut found = vec![0.0; 4 * checks.len()];
        out.read(&mut found)?;
        Ok(found.chunks_exact(4).map(|c| [c[0], c[1], c[2], c[3]]).collect())
    }
}
