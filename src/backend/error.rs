//! Reasons why a device cannot be used, or cannot be used any longer. A leaf: every room may name it.

use thiserror::Error;

/// Why a GPU cannot be used, or no longer.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum DeviceError {
    /// No libcuda.
    #[error("no NVIDIA driver library (libcuda) is found")]
    NoDriver,
    /// The library is there but does not start.
    #[error("the NVIDIA driver does not start: {reason}")]
    DriverStart {
        /// What it says.
        reason: String,
    },
    /// CUDA version of the driver is below the oldest one supported.
    #[error("the NVIDIA driver supports CUDA {}.{}; {}.{} or later is needed", found / 1000, found % 1000 / 10, needed / 1000, needed % 1000 / 10)]
    DriverTooOld {
        /// 1000 * major + 10 * minor.
        found: i32,
        /// The same.
        needed: i32,
    },
    /// The driver sees no device.
    #[error("the NVIDIA driver finds no device")]
    NoDevice,
    /// A device of this number does not exist.
    #[error("there is no device cuda:{asked}; the driver finds {present}")]
    NoSuchDevice {
        /// Number asked for.
        asked: u32,
        /// Devices found.
        present: u32,
    },
    /// No NVRTC.
    #[error("no NVRTC library (libnvrtc, part of the CUDA toolkit) is found; kernels are compiled by it at start")]
    NoNvrtc,
    /// Older than what the kernels are written for.
    #[error("cuda:{device} has compute capability {}.{}; 7.0 or later is needed", capability.0, capability.1)]
    TooOld {
        /// Its number.
        device: u32,
        /// (major, minor).
        capability: (i32, i32),
    },
    /// A kernel did not compile.
    #[error("kernel source `{source_name}` does not compile for {arch}: {log}")]
    Compile {
        /// File.
        source_name: String,
        /// sm_XX.
        arch: String,
        /// The compiler's log, or its error.
        log: String,
    },
    /// A driver call failed.
    #[error("{doing}: {reason}")]
    Driver {
        /// What was being done.
        doing: &'static str,
        /// What the driver says.
        reason: String,
    },
    /// The memory cap, or the device's memory, would be exceeded.
    #[error("{what} needs {} MiB on the device; {} of {} MiB that may be used are taken ({cap_from})", needed >> 20, used >> 20, cap >> 20)]
    OutOfMemory {
        /// For what.
        what: String,
        /// Bytes needed.
        needed: u64,
        /// Bytes taken by ridgewatch.
        used: u64,
        /// Bytes that it may take.
        cap: u64,
        /// Where the cap comes from.
        cap_from: &'static str,
    },
    /// The driver has no memory for something that has no size of its own to tell: a module, page-locked memory of the host.
    #[error("{doing}: the driver has no memory left")]
    DriverOutOfMemory {
        /// What was being done.
        doing: &'static str,
    },
    /// The velocity window does not fit.
    #[error(
        "the window of {snapshots} snapshots of {nodes:?} nodes does not fit: {missing} of them are not on the device and need {} MiB in \
         {storage}; {} MiB are left. Ways out: storage f16 ({} MiB for the whole window) where it is another, a region of interest, a coarser grid, a shorter \
         tau (fewer snapshots), or a larger memory cap",
        needed >> 20, left >> 20, needed_f16 >> 20
    )]
    WindowTooLarge {
        /// Snapshots of the window.
        snapshots: usize,
        /// Of them, those that are not on the device.
        missing: usize,
        /// Nodes along x, y, z.
        nodes: [usize; 3],
        /// Its name.
        storage: &'static str,
        /// Bytes that the missing ones need.
        needed: u64,
        /// Bytes that the whole window needs with f16 storage.
        needed_f16: u64,
        /// Bytes left.
        left: u64,
    },
    /// A GPU was asked for.
    #[error("built without the feature `cuda`; accepted: --device auto, cpu")]
    NotBuilt,
    /// Not on the GPU.
    #[error("not on the GPU: {what}")]
    Unsupported {
        /// What.
        what: String,
    },
}

impl DeviceError {
    /// Whether the device is lost: a driver call failed. Faults of kernels, resets and lost cards leave the context unusable and cannot be told from
    /// other failures with certainty, so the device is not used after any of them. All other errors refuse one request.
    pub fn is_fault(&self) -> bool {
        matches!(self, Self::Driver { .. })
    }

    /// Whether memory is short now. It may be free later: frames, slides and other programs give theirs back.
    pub fn is_out_of_memory(&self) -> bool {
        matches!(self, Self::OutOfMemory { .. } | Self::DriverOutOfMemory { .. })
    }

    /// Whether the device works but cannot do this one thing, now or at all.
    pub fn is_refusal(&self) -> bool {
        self.is_out_of_memory() || matches!(self, Self::Unsupported { .. } | Self::Compile { .. })
    }
}
