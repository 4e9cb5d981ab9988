//! Errors of compute devices. This module depends on no other, so that every module may use it.

use thiserror::Error;

/// Error of a GPU: it cannot be opened, it rejects a request, or it is lost.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum DeviceError {
    /// The library libcuda is not found.
    #[error("no NVIDIA driver library (libcuda) is found")]
    NoDriver,
    /// `cuInit`, or a query of the devices, fails.
    #[error("the NVIDIA driver does not start: {reason}")]
    DriverStart {
        /// The driver's error.
        reason: String,
    },
    /// The driver's CUDA version is too old.
    #[error("the NVIDIA driver supports CUDA {}.{}; {}.{} or later is needed", found / 1000, found % 1000 / 10, needed / 1000, needed % 1000 / 10)]
    DriverTooOld {
        /// Version of the driver, 1000 * major + 10 * minor.
        found: i32,
        /// Oldest supported version, in the same encoding.
        needed: i32,
    },
    /// The driver sees no device.
    #[error("the NVIDIA driver finds no device")]
    NoDevice,
    /// No device has this number.
    #[error("the device cuda:{asked} does not exist; the number of devices found is {present}")]
    NoSuchDevice {
        /// Requested device number.
        asked: u32,
        /// Number of devices found.
        present: u32,
    },
    /// The library libnvrtc is not found.
    #[error("no NVRTC library (libnvrtc, part of the CUDA toolkit) is found; it is needed to compile the kernels at start")]
    NoNvrtc,
    /// The compute capability is below the minimum of the kernels.
    #[error("cuda:{device} has compute capability {}.{}; 7.0 or later is needed", capability.0, capability.1)]
    TooOld {
        /// Device number.
        device: u32,
        /// (major, minor).
        capability: (i32, i32),
    },
    /// NVRTC rejects a kernel.
    #[error("kernel source `{source_name}` does not compile for {arch}: {log}")]
    Compile {
        /// Source file.
        source_name: String,
        /// Target architecture, sm_XX.
        arch: String,
        /// Compiler log, or the compiler's error code.
        log: String,
    },
    /// A driver call fails. The device is lost.
    #[error("{doing}: {reason}")]
    Driver {
        /// The operation that failed.
        doing: &'static str,
        /// The driver's error.
        reason: String,
    },
    /// An allocation exceeds the memory cap or the free memory of the device.
    #[error("{what} needs {} MiB on the device; {} of {} MiB that may be used are taken ({cap_from})", needed >> 20, used >> 20, cap >> 20)]
    OutOfMemory {
        /// Purpose of the allocation.
        what: String,
        /// Bytes needed.
        needed: u64,
        /// Bytes allocated by ridgewatch.
        used: u64,
        /// Limit for ridgewatch, bytes.
        cap: u64,
        /// Origin of the limit.
        cap_from: &'static str,
    },
    /// The driver runs out of memory for an object of unknown size: a module, or pinned host memory.
    #[error("{doing}: the driver is out of memory")]
    DriverOutOfMemory {
        /// The operation that failed.
        doing: &'static str,
    },
    /// The velocity window does not fit.
    #[error(
        "the window of {snapshots} snapshots of {nodes:?} nodes does not fit: {missing} of them are not on the device and need {} MiB in \
         {storage}; {} MiB are left. Possible remedies: storage f16 ({} MiB for the whole window), a region of interest, a coarser grid, a shorter \
         tau (fewer snapshots), or a larger memory cap",
        needed >> 20, left >> 20, needed_f16 >> 20
    )]
    WindowTooLarge {
        /// Number of snapshots in the window.
        snapshots: usize,
        /// Number of them that are not on the device.
        missing: usize,
        /// Nodes along x, y, z.
        nodes: [usize; 3],
        /// Name of the storage format.
        storage: &'static str,
        /// Bytes for the snapshots that are not on the device.
        needed: u64,
        /// Bytes that the whole window needs with f16 storage.
        needed_f16: u64,
        /// Bytes left.
        left: u64,
    },
    /// A GPU is requested in a build without CUDA.
    #[error("built without the feature `cuda`; accepted: --device auto, cpu")]
    NotBuilt,
    /// The GPU does not support a request.
    #[error("not supported on the GPU: {what}")]
    Unsupported {
        /// The request.
        what: String,
    },
}

impl DeviceError {
    /// Returns true if the device is lost because a driver call failed. Kernel faults, resets and disconnected cards leave the context unusable. They
    /// cannot be distinguished reliably from other failures, so the device is not used after any of them. All other errors reject one request only.
    pub fn is_fault(&self) -> bool {
        matches!(self, Self::Driver { .. })
    }

    /// Returns true if the device is out of memory. A later attempt may succeed, since frames, slides and other programs free their memory.
    pub fn is_out_of_memory(&self) -> bool {
        matches!(self, Self::OutOfMemory { .. } | Self::DriverOutOfMemory { .. })
    }

    /// Returns true if the device still works but rejects this request.
    pub fn is_refusal(&self) -> bool {
        self.is_out_of_memory() || matches!(self, Self::Unsupported { .. } | Self::Compile { .. })
    }
}
