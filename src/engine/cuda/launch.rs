//! Launching kernels.

use super::DeviceError;
use cudarc::driver::{LaunchArgs, LaunchConfig};

/// Enough blocks of `block` threads for `count` threads.
pub fn threads(count: usize, block: u32) -> LaunchConfig {
    LaunchConfig { grid_dim: ((count.div_ceil(block as usize)).max(1) as u32, 1, 1), block_dim: (block, 1, 1), shared_mem_bytes: 0 }
}

/// Launches what was put together with `stream.launch_builder(&kernel)` and its `.arg(..)`.
///
/// # Safety
/// The arguments are those of the kernel, in number, order and type; the memory that they point to is as large as the kernel
/// presumes and lives until the work stream has passed the launch.
pub unsafe fn launch(arguments: &mut LaunchArgs<'_>, config: LaunchConfig) -> Result<(), DeviceError> {
    // SAFETY: the caller's.
    unsafe { arguments.launch(config) }.map(|_| ()).map_err(DeviceError::driver("launching a kernel"))
}
