//! Where to compute: what `--device` says, and what it comes to on this machine.

use super::EngineError;
#[cfg(feature = "cuda")]
use super::cuda::{DeviceError, Gpu, GpuSettings};
use std::fmt;
use std::str::FromStr;
#[cfg(feature = "cuda")]
use std::sync::Arc;
use thiserror::Error;

/// What was asked for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum DeviceChoice {
    /// The first usable GPU, otherwise the CPU.
    #[default]
    Auto,
    /// The CPU.
    Cpu,
    /// This CUDA device, or an error.
    Cuda(u32),
}

/// A device by no name.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
#[error("device `{found}` is not known; accepted: auto, cpu, cuda:N")]
pub struct UnknownDevice {
    /// What was given.
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

/// A device, opened.
#[derive(Debug, Clone)]
pub enum Device {
    /// The CPU, with the reason why no GPU is used; none where the CPU was asked for.
    Cpu {
        /// In words.
        why: Option<String>,
    },
    /// A GPU.
    #[cfg(feature = "cuda")]
    Cuda(Arc<Gpu>),
}

impl Device {
    /// The CPU, by choice.
    pub const CPU: Self = Self::Cpu { why: None };

    /// Opens what was asked for. `auto` never fails.
    ///
    /// # Errors
    /// `cuda:N` that cannot be used.
    #[cfg(feature = "cuda")]
    pub fn open(choice: DeviceChoice, settings: &GpuSettings) -> Result<Self, EngineError> {
        match choice {
            DeviceChoice::Cpu => Ok(Self::CPU),
            DeviceChoice::Cuda(n) => Ok(Self::Cuda(Gpu::open(n, settings)?)),
            DeviceChoice::Auto => match Gpu::open(0, settings) {
                Ok(gpu) => Ok(Self::Cuda(gpu)),
                Err(why) => Ok(Self::Cpu { why: Some(why.to_string()) }),
            },
        }
    }

    /// Opens what was asked for. `auto` never fails.
    ///
    /// # Errors
    /// `cuda:N`, since this build has no GPU engine.
    #[cfg(not(feature = "cuda"))]
    pub fn open(choice: DeviceChoice) -> Result<Self, EngineError> {
        match choice {
            DeviceChoice::Cpu => Ok(Self::CPU),
            DeviceChoice::Auto => Ok(Self::Cpu { why: Some("built without the feature `cuda`".into()) }),
            DeviceChoice::Cuda(_) => Err(EngineError::NoCuda),
        }
    }

    /// For records: `cpu` or `cuda:0 NVIDIA H200`.
    pub fn name(&self) -> String {
        match self {
            Self::Cpu { .. } => "cpu".into(),
            #[cfg(feature = "cuda")]
            Self::Cuda(gpu) => format!("cuda:{} {}", gpu.ordinal(), gpu.name()),
        }
    }
}

#[cfg(feature = "cuda")]
impl From<DeviceError> for EngineError {
    fn from(error: DeviceError) -> Self {
        EngineError::Device(Box::new(error))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn choices_are_read_and_written() {
        for text in ["auto", "cpu", "cuda:0", "cuda:3"] {
            assert_eq!(text.parse::<DeviceChoice>().unwrap().to_string(), text);
        }
        for text in ["gpu", "cuda", "cuda:", "cuda:-1", "cuda:x"] {
            assert!(text.parse::<DeviceChoice>().unwrap_err().to_string().contains(text));
        }
    }
}
