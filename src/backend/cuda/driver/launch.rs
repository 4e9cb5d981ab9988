//! Launches kernels.

use crate::cuda::driver_error;
use crate::cuda::{DeviceError, Gpu};
use cudarc::driver::sys::CUfunction_attribute as Function;
use cudarc::driver::{CudaFunction, LaunchArgs, LaunchConfig};

/// Launch configuration with enough blocks of `block` threads for `count` threads.
pub fn threads(count: usize, block: u32) -> LaunchConfig {
    LaunchConfig { grid_dim: ((count.div_ceil(block as usize)).max(1) as u32, 1, 1), block_dim: (block, 1, 1), shared_mem_bytes: 0 }
}

/// Launches a kernel whose arguments were collected by `stream.launch_builder(&kernel)` and `.arg(..)`.
///
/// # Errors
/// Error of the driver.
///
/// # Safety
/// The arguments are those of the kernel, in number, order and type. The memory that they point to is as large as the kernel expects and lives
/// until the work stream has passed the launch.
pub unsafe fn launch(arguments: &mut LaunchArgs<'_>, config: LaunchConfig) -> Result<(), DeviceError> {
    // SAFETY: as required of the caller.
    unsafe { arguments.launch(config) }.map(|_| ()).map_err(driver_error("launching a kernel"))
}

/// A persistent kernel: its blocks stay on the device and take one tile after another. It uses more shared memory than the default limit.
#[derive(Debug)]
pub(in crate::cuda) struct Resident {
    pub(in crate::cuda) function: CudaFunction,
    threads: u32,
    shared: u32,
    /// Number of blocks that are resident at once.
    pub(in crate::cuda) blocks: u32,
}

impl Resident {
    /// Blocks of `threads` threads and `shared` bytes, which the device must have.
    ///
    /// # Errors
    /// Error of the driver.
    pub(in crate::cuda) fn new(gpu: &Gpu, function: CudaFunction, threads: u32, shared: usize) -> Result<Self, DeviceError> {
        let doing = driver_error("requesting shared memory");
        gpu.context().bind_to_thread().map_err(&doing)?;
        function.set_attribute(Function::CU_FUNC_ATTRIBUTE_MAX_DYNAMIC_SHARED_SIZE_BYTES, shared as i32).map_err(&doing)?;
        let together = function.occupancy_max_active_blocks_per_multiprocessor(threads, shared, None).map_err(&doing)?;
        Ok(Self { function, threads, shared: shared as u32, blocks: together.max(1) * gpu.multiprocessors() })
    }

    /// As many blocks as are resident at once, at most one per tile.
    pub(in crate::cuda) fn config(&self, tiles: usize) -> LaunchConfig {
        let blocks = tiles.clamp(1, self.blocks as usize) as u32;
        LaunchConfig { grid_dim: (blocks, 1, 1), block_dim: (self.threads, 1, 1), shared_mem_bytes: self.shared }
    }
}
