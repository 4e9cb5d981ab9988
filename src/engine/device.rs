//! Where to compute: what `--device` says, what it comes to on this machine, and the tracers there.

use super::EngineError;
#[cfg(feature = "cuda")]
use super::accelerator::Accelerator;
#[cfg(feature = "cuda")]
use super::cuda::{CudaAccelerator, CudaTracerError, DeviceError, Gpu, GpuSettings};
use crate::flow::{FlowMap, Tracer, VelocitySource, cpu_tracer};
use crate::setting::{Refused, require};
use crate::source::Listener;
use crate::surrogate::Offload;
use serde::{Deserialize, Serialize};
use std::fmt;
use std::str::FromStr;
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
#[error("--device {found}: accepted: auto, cpu, cuda:N")]
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

/// How node velocities are held on a GPU.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Storage {
    /// 16 bytes a node.
    #[default]
    F32,
    /// 8 bytes a node: velocities are rounded to 11 bits.
    F16,
    /// 16 bytes a node: rounded to 11 bits, with the change to the next snapshot beside it, so that a tracer asks once instead of twice.
    F16Pairs,
}

impl Storage {
    /// All of them.
    pub const ALL: [Self; 3] = [Self::F32, Self::F16, Self::F16Pairs];

    /// Bytes of a node.
    pub fn bytes(self) -> u64 {
        match self {
            Self::F32 | Self::F16Pairs => 16,
            Self::F16 => 8,
        }
    }

    /// As written in settings.
    pub fn name(self) -> &'static str {
        match self {
            Self::F32 => "f32",
            Self::F16 => "f16",
            Self::F16Pairs => "f16_pairs",
        }
    }
}

/// What happens when work on a GPU fails.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum WhenLost {
    /// The run goes on there, at a lower rate, and says so.
    #[default]
    Cpu,
    /// The run ends with an error.
    Stop,
}

/// `[device]`: how a GPU is used, where one is.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct DeviceSettings {
    /// How the velocity window is held.
    pub storage: Storage,
    /// Most device memory that is taken, MiB; none: nine tenths of what is free at start.
    pub memory_mib: Option<u64>,
    /// What happens when work on the device fails, for whatever reason: it is not tried again in this run. Memory that it lacks once it is at
    /// work is no failure: the CPU does what wanted it, with a warning. Only a window that no longer fits is one.
    pub when_lost: WhenLost,
    /// Lowest stream priority, for life beside a solver.
    pub low_priority: bool,
}

impl DeviceSettings {
    /// Checks ranges.
    pub fn check(&self) -> Result<(), Refused> {
        let fits = self.memory_mib.is_none_or(|mib| (1..=1 << 24).contains(&mib));
        require(fits, "device.memory_mib", self.memory_mib, "a whole number from 1 to 16777216")
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
    Gpu {
        /// The device.
        gpu: Arc<dyn Accelerator>,
        /// Whether the CPU does what this device cannot.
        may_fall_back: bool,
    },
}

impl Default for Device {
    fn default() -> Self {
        Self::CPU
    }
}

impl Device {
    /// The CPU, by choice.
    pub const CPU: Self = Self::Cpu { why: None };

    /// Opens what was asked for. `auto` never fails.
    ///
    /// # Errors
    /// `cuda:N` that cannot be used.
    #[cfg(feature = "cuda")]
    pub fn open(choice: DeviceChoice, settings: &DeviceSettings) -> Result<Self, EngineError> {
        let ordinal = match choice {
            DeviceChoice::Cpu => return Ok(Self::CPU),
            DeviceChoice::Auto => 0,
            DeviceChoice::Cuda(n) => n,
        };
        let wanted = GpuSettings {
            memory_cap: settings.memory_mib.map(|mib| mib << 20),
            cache: None,
            low_priority: settings.low_priority,
            when_lost: settings.when_lost,
            poison: false,
        };
        match Gpu::open(ordinal, &wanted) {
            Ok(gpu) => {
                let gpu = Arc::new(CudaAccelerator::new(gpu, settings.storage));
                Ok(Self::Gpu { gpu, may_fall_back: choice == DeviceChoice::Auto })
            }
            Err(why) if choice == DeviceChoice::Auto => Ok(Self::Cpu { why: Some(why.to_string()) }),
            Err(why) => Err(why.into()),
        }
    }

    /// Opens what was asked for. `auto` never fails.
    ///
    /// # Errors
    /// `cuda:N`, since this build has no GPU engine.
    #[cfg(not(feature = "cuda"))]
    pub fn open(choice: DeviceChoice, _: &DeviceSettings) -> Result<Self, EngineError> {
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
            Self::Gpu { gpu, .. } if !gpu.health().works() => "cpu".into(),
            #[cfg(feature = "cuda")]
            Self::Gpu { gpu, .. } => gpu.name(),
        }
    }

    /// What work on the device failed with, in words, since which the CPU does it.
    pub fn failure(&self) -> Option<String> {
        match self {
            Self::Cpu { .. } => None,
            #[cfg(feature = "cuda")]
            Self::Gpu { gpu, .. } => gpu.health().failure().map(|error| error.to_string()),
        }
    }

    /// Warnings of what the CPU did for want of the device's memory, each once.
    pub fn shortages(&self) -> Vec<String> {
        match self {
            Self::Cpu { .. } => Vec::new(),
            #[cfg(feature = "cuda")]
            Self::Gpu { gpu, .. } => gpu.health().shortages(),
        }
    }

    /// Ends a run whose device is lost, where that is wanted.
    ///
    /// # Errors
    /// What the device failed with.
    pub fn check(&self) -> Result<(), EngineError> {
        match self {
            #[cfg(feature = "cuda")]
            Self::Gpu { gpu, .. } => Ok(gpu.health().check()?),
            Self::Cpu { .. } => Ok(()),
        }
    }

    /// What trains networks on it; none where the CPU does.
    pub(super) fn offload(&self) -> Option<Arc<dyn Offload>> {
        match self {
            Self::Cpu { .. } => None,
            #[cfg(feature = "cuda")]
            Self::Gpu { gpu, .. } => gpu.offload().filter(|_| gpu.health().works()),
        }
    }

    /// Who should hear of snapshots as they are read, so that they are on the device when the window wants them.
    pub(super) fn listener(&self) -> Option<Listener> {
        match self {
            Self::Cpu { .. } => None,
            #[cfg(feature = "cuda")]
            Self::Gpu { gpu, .. } => {
                // The I/O thread may outlive the run, and must not keep the device open.
                let gpu = Arc::downgrade(gpu);
                Some(Box::new(move |snapshot| {
                    if let Some(gpu) = gpu.upgrade().filter(|gpu| gpu.health().works()) {
                        gpu.expect(snapshot);
                    }
                }))
            }
        }
    }

    /// A tracer for seeds at `t0`, and what should be told about it.
    ///
    /// # Errors
    /// What [`cpu_tracer`] refuses; what a GPU that was asked for by name cannot do.
    pub fn tracer(&self, source: VelocitySource, map: &FlowMap, t0: f64) -> Result<(Box<dyn Tracer>, Option<String>), EngineError> {
        match self {
            #[cfg(feature = "cuda")]
            Self::Gpu { gpu, may_fall_back } if gpu.health().works() => match gpu.tracer(source.clone(), map, t0) {
                Ok(tracer) => {
                    gpu.health().take_up();
                    Ok((tracer, None))
                }
                Err(CudaTracerError::Flow(error)) => Err(error.into()),
                Err(CudaTracerError::Device(error)) if error.is_fault() => {
                    gpu.health().fail(error);
                    self.check()?;
                    Ok((cpu_tracer(source, map, t0)?, None))
                }
                Err(CudaTracerError::Device(error)) if *may_fall_back && !gpu.health().in_use() => {
                    Ok((cpu_tracer(source, map, t0)?, Some(format!("traced on the CPU: {error}"))))
                }
                Err(CudaTracerError::Device(error)) => Err(error.into()),
            },
            _ => Ok((cpu_tracer(source, map, t0)?, None)),
        }
    }

    /// The same behind the first one: memory for it that a GPU lacks then makes it the CPU's, `instead` in words; a window that no longer
    /// fits ends work on the GPU, as every failure does, and [`WhenLost`] says what follows.
    ///
    /// # Errors
    /// What [`cpu_tracer`] refuses; the failure, where it is to end the run.
    #[cfg_attr(not(feature = "cuda"), allow(unused_variables))] // no other device refuses
    pub(super) fn next_tracer(
        &self,
        source: VelocitySource,
        map: &FlowMap,
        t0: f64,
        instead: &'static str,
    ) -> Result<(Box<dyn Tracer>, Option<String>), EngineError> {
        match self {
            #[cfg(feature = "cuda")]
            Self::Gpu { gpu, .. } => match self.tracer(source.clone(), map, t0) {
                Err(EngineError::Device(error)) => {
                    gpu.health().fail_unless_refused(*error, instead);
                    self.check()?;
                    Ok((cpu_tracer(source, map, t0)?, None))
                }
                result => result,
            },
            Self::Cpu { .. } => self.tracer(source, map, t0),
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

    #[test]
    fn auto_always_opens() {
        let device = Device::open(DeviceChoice::Auto, &DeviceSettings::default()).unwrap();
        assert!(!matches!(device, Device::Cpu { why: None }), "the reason is told");
        if matches!(device, Device::Cpu { .. }) {
            assert!(Device::open(DeviceChoice::Cuda(0), &DeviceSettings::default()).is_err());
        }
        assert_eq!(device.failure(), None);
    }
}
