//! Combination of a marched picture with its correction on the GPU, and the error of the result (see `render::smooth::combine`, the reference).
//!
//! All pictures are planes of f32. The halves of the samples are shrunk one after the other in the same memory, so that the planes of one half stay
//! in L2 as far as possible. The film leaves the device as whole planes.

use super::coupled::SUM_PLANES;
use super::films::{Filled, PinnedFilm};
use super::march::{GpuMarch, RAY_FIELDS, pinned_room, room};
use crate::cuda::driver::pinned::{Pinned, copy_to_host};
use crate::cuda::layout::device_repr;
use crate::cuda::{Buffer, DeviceError, Gpu, driver_error, launch, threads};
use cudarc::driver::{CudaFunction, LaunchConfig, PushKernelArg};
use ridgewatch_render::Combine as Combination;
use ridgewatch_render::smooth::{TILE, TileError, TileSums};
use std::sync::Arc;

/// Scales of the transform.
const LEVELS: u32 = 5;
/// Radius over which energies are summed, and the largest one that the kernels can sum, in pixels.
const RADIUS: i32 = 32;
/// Pixels that a block of `combine_box` sums along a row, and columns and rows of a block of `combine_gains`.
const BOX_ROW: usize = 1024;
const BOX_COLUMNS: [usize; 2] = [16, 128];
/// First plane of the pairs by quarter in the sums (see [`SUM_PLANES`]).
const PAIR_COUNTS: usize = 12;
/// Of `regression.cuh`: features, sums of the normal equations.
const FEATURES: usize = 4;
const NORMAL_SUMS: usize = FEATURES * (FEATURES + 1) / 2 + 2 * FEATURES + 1;
/// Pixels that a block sums at a time.
const STRIP: usize = 256;
/// Blocks that sum the normal equations: some for each multiprocessor.
const NORMAL_BLOCKS: usize = 1024;
/// Spacings of the filter of the guides.
const SPACINGS: [i32; 2] = [1, 2];

/// `Quarters` of `combine.cuh`.
#[repr(C)]
#[derive(Clone, Copy)]
struct QuartersArgument {
    planes: [[u64; 4]; 2],
}

/// `Level` of `combine.cuh`.
#[repr(C)]
#[derive(Clone, Copy)]
struct LevelArgument {
    mean: u64,
    energy: u64,
    width: i32,
    height: i32,
}

/// `Combine` of `combine.cuh`.
#[repr(C)]
#[derive(Clone, Copy)]
struct CombineArgument {
    sums: u64,
    base: u64,
    halves: u64,
    film: u64,
    errors: u64,
    tiles: u64,
    per_ray: f64,
    width: i32,
    height: i32,
    how: i32,
    tone_map: [f32; 3],
    lit: f32,
    pad: i32,
}

/// `Regression` of `regression.cuh`.
#[repr(C)]
#[derive(Clone, Copy)]
struct RegressionArgument {
    sums: u64,
    base: u64,
    guides: u64,
    around: u64,
    scratch: u64,
    partial: u64,
    coefficients: u64,
    per_ray: f64,
    width: i32,
    height: i32,
    blocks: i32,
    pad: i32,
}

const _: () = assert!(size_of::<QuartersArgument>() == 64 && size_of::<LevelArgument>() == 24 && size_of::<CombineArgument>() == 88);
const _: () = assert!(size_of::<RegressionArgument>() == 80);

const TILE_FIELDS: usize = size_of::<TileSums>() / size_of::<f32>();
const _: () = assert!(TILE_FIELDS == 23);

device_repr!(QuartersArgument, LevelArgument, CombineArgument, RegressionArgument);

/// What is combined.
pub struct CombineInput<'a> {
    /// Pixels across and down.
    pub size: [usize; 2],
    /// Sums over pairs, [`SUM_PLANES`] planes.
    pub pairs: &'a Buffer<f32>,
    /// The marched picture, of the same size.
    pub march: &'a GpuMarch,
    /// How the correction is added. `None`: not at all; the pairs only measure the error.
    pub how: Option<Combination>,
    /// `[contrast, brightness, gamma]` of the tone map.
    pub tone_map: [f64; 3],
    /// Alpha above which a pixel is lit.
    pub lit: f32,
}

/// Offsets of the planes of the working memory. The film overwrites planes that only the shrinkage needs.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Planes {
    /// Levels are written to each in turn: reading and writing the same planes takes three times as long.
    coarse: [usize; 2],
    rows: usize,
    energy: usize,
    boxed: usize,
    mean: usize,
    halves: usize,
    film: usize,
    /// Guides of the regression, and what is left to be shrunk, which the first level reads before the second writes there.
    guides: usize,
    around: usize,
    rest: usize,
    count: usize,
}

const PLANES: Planes =
    Planes { coarse: [0, 29], rows: 8, energy: 16, boxed: 18, mean: 20, halves: 23, film: 0, guides: 37, around: 45, rest: 29, count: 53 };

/// Combines pictures. It reuses its memory between frames: 53 planes.
pub struct GpuCombine {
    gpu: Arc<Gpu>,
    guides: CudaFunction,
    filter: CudaFunction,
    normal: CudaFunction,
    solve: CudaFunction,
    rest: CudaFunction,
    rows: CudaFunction,
    columns: CudaFunction,
    last: CudaFunction,
    boxes: CudaFunction,
    gains: CudaFunction,
    tiles: CudaFunction,
    errors: CudaFunction,
    planes: Option<Buffer<f32>>,
    /// Partial sums of the normal equations, then the coefficients.
    normal_sums: Option<Buffer<f64>>,
    tile_sums: Option<Buffer<f32>>,
    tile_errors: Option<Buffer<TileError>>,
    tiles_read: Option<Pinned<f32>>,
    /// Argument of the picture that [`Self::finish`] completes, and whether its film is copied but for the error.
    begun: Option<(CombineArgument, bool)>,
}

impl GpuCombine {
    /// Compiles the kernels or loads them from the cache.
    ///
    /// # Errors
    /// A kernel does not compile, or the device fails.
    pub fn new(gpu: &Arc<Gpu>) -> Result<Self, DeviceError> {
        let kernel = |name| gpu.kernel("combine.cu", &[], name);
        Ok(Self {
            guides: kernel("combine_guides")?,
            filter: kernel("combine_filter")?,
            normal: kernel("combine_normal")?,
            solve: kernel("combine_solve")?,
            rest: kernel("combine_rest")?,
            rows: kernel("combine_rows")?,
            columns: kernel("combine_columns")?,
            last: kernel("combine_last")?,
            boxes: kernel("combine_box")?,
            gains: kernel("combine_gains")?,
            tiles: kernel("combine_tiles")?,
            errors: kernel("combine_errors")?,
            gpu: gpu.clone(),
            planes: None,
            normal_sums: None,
            tile_sums: None,
            tile_errors: None,
            tiles_read: None,
            begun: None,
        })
    }

    /// For tests: fills the memory between frames with bytes that are NaN as floats.
    ///
    /// # Errors
    /// A driver call fails.
    pub fn poison(&mut self) -> Result<(), DeviceError> {
        self.planes.as_mut().map_or(Ok(()), |planes| planes.fill_bytes(0xFF))
    }

    /// Adds the correction to the picture, and returns the sums of each tile, rows of tiles from the top. Waits for them. The film is then complete
    /// but for its error. With `early` it is copied to a film meanwhile, which goes to [`Self::finish`]; `true`: that shows the same march already.
    ///
    /// # Errors
    /// The picture has no rays or another size, the film is held elsewhere or has another size, or the device fails or lacks memory.
    pub fn combine(&mut self, input: &CombineInput<'_>, early: Option<(&mut PinnedFilm, bool)>) -> Result<&[TileSums], DeviceError> {
        self.begun = None;
        let [width, height] = input.size;
        let pixels = width * height;
        let refused = |what: &str| Err(DeviceError::Unsupported { what: what.into() });
        let Some(base) = input.march.sums().filter(|_| input.march.pixels() == pixels) else { return refused("a picture without rays") };
        if input.pairs.len() < SUM_PLANES * pixels {
            return refused("sums over pairs of a smaller picture");
        }
        const { assert!(RAY_FIELDS == 6) };
        let gpu = self.gpu.clone();
        let at = room(&gpu, &mut self.planes, "combining pictures", PLANES.count * pixels)?.address();
        let plane = |number: usize| at + (number * pixels * size_of::<f32>()) as u64;
        let blocks_of_sums = NORMAL_BLOCKS.min(pixels.div_ceil(STRIP));
        let partial = room(&gpu, &mut self.normal_sums, "regressing corrections", NORMAL_SUMS * blocks_of_sums + 2 * FEATURES)?.address();
        let regression = RegressionArgument {
            sums: input.pairs.address(),
            base,
            guides: plane(PLANES.guides),
            around: plane(PLANES.around),
            scratch: plane(PLANES.rows),
            partial,
            coefficients: partial + (NORMAL_SUMS * blocks_of_sums * size_of::<f64>()) as u64,
            per_ray: 1.0 / f64::from(input.march.rays()),
            width: width as i32,
            height: height as i32,
            blocks: blocks_of_sums as i32,
            pad: 0,
        };
        self.regress(&regression)?;
        // Whatever is shown: the error in tone-mapped values is that of the best estimate, and its way to the picture.
        for half in 0..2 {
            self.shrink(input, &regression, half, plane)?;
        }
        let tiles = [width.div_ceil(TILE), height.div_ceil(TILE)];
        let count = tiles[0] * tiles[1] * TILE_FIELDS;
        let tile_sums = room(&gpu, &mut self.tile_sums, "errors of tiles", count)?.address();
        let tile_errors = room(&gpu, &mut self.tile_errors, "errors of tiles", tiles[0] * tiles[1])?.address();
        let argument = CombineArgument {
            sums: input.pairs.address(),
            base,
            halves: plane(PLANES.halves),
            film: plane(PLANES.film),
            errors: tile_errors,
            tiles: tile_sums,
            per_ray: 1.0 / f64::from(input.march.rays()),
            width: width as i32,
            height: height as i32,
            how: match input.how {
                None => 0,
                Some(Combination::Shrink) => 1,
                Some(Combination::Sum) => 2,
            },
            tone_map: input.tone_map.map(|v| v as f32),
            lit: input.lit,
            pad: 0,
        };
        let mut call = gpu.work().launch_builder(&self.tiles);
        call.arg(&argument);
        // SAFETY: the argument of `combine_tiles`; pairs, base and planes are as large as checked above, `tile_sums` holds the fields of all tiles, and
        // all of them are freed in the order of the stream.
        unsafe { launch(&mut call, blocks(tiles[0], tiles[1])) }?;
        let read = pinned_room(&gpu, &mut self.tiles_read, count)?;
        // SAFETY: `tile_sums` holds `count` values.
        unsafe { read.copy_from(gpu.work(), tile_sums, count) }?;
        let (is_read, is_early) = (gpu.mark()?, early.is_some());
        if let Some((film, shows_march)) = early {
            film.begins(&gpu);
            // SAFETY: the kernel above has written the film; the copies are waited for by `finish`, or else when the film is dropped.
            unsafe { copy_film(&gpu, &argument, film, |plane| plane != ERROR && !(shows_march && OF_MARCH.contains(&plane))) }?;
        }
        is_read.synchronize().map_err(driver_error("waiting for the device"))?;
        self.begun = Some((argument, is_early));
        Ok(bytemuck::cast_slice(&read.values()[..count]))
    }

    /// Regresses both halves' corrections on the marched picture.
    fn regress(&self, regression: &RegressionArgument) -> Result<(), DeviceError> {
        let (across, down) = (regression.width, regression.height);
        let pixels = across as usize * down as usize;
        let stream = self.gpu.work();
        // SAFETY: the arguments of the kernels of combine.cu; each address is that of as many planes or sums as the kernel expects, in memory that is
        // freed in the order of the stream.
        unsafe {
            launch(stream.launch_builder(&self.guides).arg(regression), threads(pixels, 256))?;
            let planes = [regression.guides, regression.scratch, regression.around];
            for (planes, spacing) in planes.windows(2).zip(&SPACINGS) {
                let mut call = stream.launch_builder(&self.filter);
                call.arg(&planes[0]).arg(&planes[1]).arg(&across).arg(&down).arg(spacing);
                launch(&mut call, blocks((across as usize).div_ceil(32), (down as usize).div_ceil(8)))?;
            }
            launch(stream.launch_builder(&self.normal).arg(regression), blocks(regression.blocks as usize, 1))?;
            launch(stream.launch_builder(&self.solve).arg(regression), blocks(1, 1))
        }
    }

    /// Shrinks what the regression left of the correction of a half.
    fn shrink(
        &self,
        input: &CombineInput<'_>,
        regression: &RegressionArgument,
        half: usize,
        plane: impl Fn(usize) -> u64,
    ) -> Result<(), DeviceError> {
        let [width, height] = input.size;
        let pixels = width * height;
        let stream = self.gpu.work();
        let (across, down) = (width as i32, height as i32);
        let level = LevelArgument { mean: plane(PLANES.mean), energy: plane(PLANES.energy), width: across, height: down };
        let (rows, boxed) = (plane(PLANES.rows), plane(PLANES.boxed));
        let shrunk = plane(PLANES.halves + 3 * half);
        let pairs = |quarter: usize| input.pairs.address() + ((PAIR_COUNTS + quarter) * pixels * size_of::<f32>()) as u64;
        let (rest, number) = (plane(PLANES.rest), half as i32);
        let mut call = stream.launch_builder(&self.rest);
        call.arg(regression).arg(&number).arg(&rest).arg(&shrunk);
        // SAFETY: the arguments of `combine_rest`; the planes are as many as it expects.
        unsafe { launch(&mut call, threads(pixels, 256)) }?;
        let mut fine = QuartersArgument {
            planes: [0, 1].map(|q| std::array::from_fn(|k| if k == 3 { pairs(q) } else { plane(PLANES.rest + 3 * q + k) })),
        };
        for number in 0..=LEVELS {
            let first = PLANES.coarse[number as usize % 2];
            let coarse = plane(first);
            let spacing = 1_i32 << number;
            // SAFETY: the arguments of the kernels of combine.cu; each address is that of as many planes as the kernel expects, in memory that is freed
            // in the order of the stream.
            unsafe {
                if number == LEVELS {
                    launch(stream.launch_builder(&self.last).arg(&fine).arg(&level), threads(pixels, 256))?;
                } else {
                    let config = blocks(width.div_ceil(32), height.div_ceil(8));
                    let mut call = stream.launch_builder(&self.rows);
                    launch(call.arg(&fine).arg(&rows).arg(&across).arg(&down).arg(&spacing), config)?;
                    let mut call = stream.launch_builder(&self.columns);
                    launch(call.arg(&fine).arg(&rows).arg(&coarse).arg(&level).arg(&spacing), config)?;
                }
                self.box_rows(level.energy, boxed, input.size, RADIUS)?;
                let mut call = stream.launch_builder(&self.gains);
                launch(call.arg(&level).arg(&boxed).arg(&RADIUS).arg(&shrunk), box_columns(input.size))?;
            }
            fine = QuartersArgument { planes: [0, 1].map(|q| std::array::from_fn(|k| plane(first + 4 * q + k))) };
        }
        Ok(())
    }

    /// Sums two planes along their rows.
    ///
    /// # Safety
    /// Both addresses are those of two planes of this size.
    unsafe fn box_rows(&self, from: u64, to: u64, [width, height]: [usize; 2], radius: i32) -> Result<(), DeviceError> {
        let (across, down) = (width as i32, height as i32);
        let config = LaunchConfig { grid_dim: (width.div_ceil(BOX_ROW) as u32, height as u32, 2), ..blocks(1, 1) };
        let mut call = self.gpu.work().launch_builder(&self.boxes);
        // SAFETY: the arguments of `combine_box`, guaranteed by the caller.
        unsafe { launch(call.arg(&from).arg(&to).arg(&across).arg(&down).arg(&radius), config) }
    }

    /// Completes the film of the latest [`Self::combine`] and copies it to `film`; with `shows_march` without FTLE and missing cells, since `film` shows
    /// the same march already. The error of a pixel is that of the `tiles` around it (see `render::smooth::error_at`), with `marched`, a mean square,
    /// added where it is lit.
    ///
    /// # Errors
    /// Nothing was combined, `film` is held elsewhere or it or the tiles have another size, or the device fails.
    pub fn finish(&mut self, tiles: &[TileError], marched: f32, film: &mut PinnedFilm, shows_march: bool) -> Result<(), DeviceError> {
        let (Some((argument, is_copied)), Some(tile_errors)) = (self.begun.take(), &mut self.tile_errors) else {
            return Err(DeviceError::Unsupported { what: "a film before its pictures are combined".into() });
        };
        let size = [argument.width as usize, argument.height as usize];
        let gpu = self.gpu.clone();
        if tiles.len() != size[0].div_ceil(TILE) * size[1].div_ceil(TILE) {
            return Err(DeviceError::Unsupported { what: "errors of another picture's tiles".into() });
        }
        tile_errors.write(tiles)?;
        let mut call = gpu.work().launch_builder(&self.errors);
        call.arg(&argument).arg(&marched);
        // SAFETY: the arguments of `combine_errors`; the film and the errors of the tiles are those of `combine`, for the same picture.
        unsafe { launch(&mut call, blocks(size[0].div_ceil(32), size[1].div_ceil(8))) }?;
        film.begins(&gpu);
        // SAFETY: the planes hold the film; the copies are waited for below, or else when the film is dropped.
        unsafe { copy_film(&gpu, &argument, film, |plane| plane == ERROR || !(is_copied || shows_march && OF_MARCH.contains(&plane))) }?;
        film.wait(&gpu)
    }
}

/// Planes of [`Filled::Combined`]: the error, and those that the march alone decides.
const ERROR: usize = 1;
const OF_MARCH: [usize; 2] = [0, 2];
/// Stands for the colours, which come before the planes.
const COLOURS: usize = usize::MAX;

/// Enqueues copies of colours and planes to a film.
///
/// # Errors
/// The film is held elsewhere or has another size, or a driver call fails.
///
/// # Safety
/// The device holds the film of `argument`, and nothing reads or frees `film` before the copies have ended.
unsafe fn copy_film(
    gpu: &Gpu,
    argument: &CombineArgument,
    film: &mut PinnedFilm,
    wanted: impl Fn(usize) -> bool,
) -> Result<(), DeviceError> {
    let size = [argument.width as usize, argument.height as usize];
    let refused = |what: &str| Err(DeviceError::Unsupported { what: what.into() });
    let Some(film) = film.film_mut() else { return refused("a film that is shown already") };
    if [film.width, film.height] != size {
        return refused("a film of another size");
    }
    let at = |plane: usize| argument.film + (plane * size[0] * size[1] * size_of::<f32>()) as u64;
    if wanted(COLOURS) {
        // SAFETY: guaranteed by the caller.
        unsafe { copy_to_host(gpu.work(), at(0), film.rgba.as_flattened_mut()) }?;
    }
    let mut planes = Filled::Combined.planes(film).into_iter().enumerate().filter(|(plane, _)| wanted(*plane));
    // SAFETY: as above.
    planes.try_for_each(|(plane, values)| unsafe { copy_to_host(gpu.work(), at(4 + plane), values) })
}

/// A grid of blocks of 256 threads.
fn blocks(x: usize, y: usize) -> LaunchConfig {
    LaunchConfig { grid_dim: (x as u32, y as u32, 1), block_dim: (256, 1, 1), shared_mem_bytes: 0 }
}

fn box_columns([width, height]: [usize; 2]) -> LaunchConfig {
    blocks(width.div_ceil(BOX_COLUMNS[0]), height.div_ceil(BOX_COLUMNS[1]))
}
