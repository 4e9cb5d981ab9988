//! The option `--device` and the settings table `[device]`.

use ridgewatch_base::setting::{Refused, require};
use serde::{Deserialize, Serialize};
use std::fmt;
use std::str::FromStr;
use thiserror::Error;

/// Value of the option `--device`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum DeviceChoice {
    /// The first usable GPU, otherwise the CPU.
    #[default]
    Auto,
    /// The CPU.
    Cpu,
    /// The CUDA device of this number; an error if it cannot be used.
    Cuda(u32),
}

/// Error: the value of `--device` is not a device.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
#[error("--device {found}: accepted: auto, cpu, cuda:N")]
pub struct UnknownDevice {
    /// The value.
    pub found: String,
}

impl FromStr for DeviceChoice {
    type Err = UnknownDevice;
    fn from_str(text: &str) -> Result<Self, UnknownDevice> {
        match text {
            "auto" => Ok(Self::Auto),
            "cpu" => Ok(Self::Cpu),
            _ => text
                .strip_prefix("cuda:")
                .and_then(|n| n.parse().ok())
                .map(Self::Cuda)
                .ok_or_else(|| UnknownDevice { found: text.to_owned() }),
        }
    }
}

impl fmt::Display for DeviceChoice {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Auto => write!(f, "auto"),
            Self::Cpu => write!(f, "cpu"),
            Self::Cuda(n) => write!(f, "cuda:{n}"),
        }
    }
}

/// Storage format of node velocities on a GPU.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Storage {
    /// Four f32 per node: 16 bytes.
    #[default]
    F32,
    /// Four f16 per node: 8 bytes. Velocities are rounded to 11 bits.
    F16,
    /// Eight f16 per node: 16 bytes. The velocity and its change to the next snapshot, so that a tracer reads memory once instead of twice.
    F16Pairs,
}

impl Storage {
    /// All formats.
    pub const ALL: [Self; 3] = [Self::F32, Self::F16, Self::F16Pairs];

    /// Bytes per node.
    pub fn bytes(self) -> u64 {
        match self {
            Self::F32 | Self::F16Pairs => 16,
            Self::F16 => 8,
        }
    }

    /// Name in the settings.
    pub fn name(self) -> &'static str {
        match self {
            Self::F32 => "f32",
            Self::F16 => "f16",
            Self::F16Pairs => "f16_pairs",
        }
    }
}

/// Reaction to a lost device.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum WhenLost {
    /// The run continues on the CPU, at a lower frame rate, with a warning.
    #[default]
    Cpu,
    /// The run ends with an error.
    Stop,
}

/// Settings table `[device]`: use of a GPU. It has no effect on the CPU.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct DeviceSettings {
    /// Storage format of the velocity window. `None`: [`Storage::F16Pairs`] if a smooth picture with open steps does not tell it from
    /// [`Storage::F32`], which everything else takes.
    pub storage: Option<Storage>,
    /// Limit on device memory, MiB. `None`: 90 % of the memory that is free at start.
    pub memory_mib: Option<u64>,
    /// Reaction to a lost device. A lost device is not used again in this run. Running out of memory does not lose the device: the CPU then does the
    /// work that does not fit, with a warning. The exception is a velocity window that no longer fits, which counts as a lost device.
    pub when_lost: WhenLost,
    /// Uses the lowest stream priority, for a GPU that is shared with a solver.
    pub low_priority: bool,
}

impl DeviceSettings {
    /// Checks the ranges of the settings.
    ///
    /// # Errors
    /// `memory_mib` is out of range.
    pub fn check(&self) -> Result<(), Refused> {
        let fits = self.memory_mib.is_none_or(|mib| (1..=1 << 24).contains(&mib));
        require(fits, "device.memory_mib", self.memory_mib, "a whole number from 1 to 16777216")
    }
}
