//! The device that a run computes on: the option `--device`, the table `[device]`, and the device that they select on this machine.

#[cfg(feature = "cuda")]
use super::cuda::{CudaTracer, Gpu, GpuSettings, SnapshotStore, Tuning};
use super::{BackendError, DeviceError};
use crate::flow::{Extras, FlowMap, Traced, Tracer, VelocitySource, cpu_tracer};
use crate::setting::{Refused, require};
#[cfg(feature = "cuda")]
use crate::surrogate::Trace;
use serde::{Deserialize, Serialize};
use std::fmt;
use std::str::FromStr;
#[cfg(feature = "cuda")]
use std::sync::Arc;
use std::time::Instant;
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

/// The device that was selected.
#[derive(Debug, Clone)]
pub enum Device {
    /// The CPU, with the reason why no GPU is used; `None` if the CPU was asked for.
    Cpu {
        /// In words.
        why: Option<String>,
    },
    /// A GPU.
    #[cfg(feature = "cuda")]
    Cuda(CudaDevice),
}

/// An opened GPU, and how a run uses it.
#[cfg(feature = "cuda")]
#[derive(Debug, Clone)]
pub struct CudaDevice {
    /// The device.
    pub gpu: Arc<Gpu>,
    /// How the velocity window is held.
    pub storage: Storage,
    /// What happens when the device is lost.
    pub when_lost: WhenLost,
    /// Whether the CPU computes if the first slide does not fit the device: the device was chosen automatically.
    pub may_fall_back: bool,
}

impl Default for Device {
    fn default() -> Self {
        Self::CPU
    }
}

impl Device {
    /// The CPU, by choice.
    pub const CPU: Self = Self::Cpu { why: None };

    /// Opens the device that was asked for. `auto` never fails.
    ///
    /// # Errors
    /// `cuda:N` cannot be used.
    #[cfg(feature = "cuda")]
    pub fn open(choice: DeviceChoice, settings: &DeviceSettings) -> Result<Self, DeviceError> {
        let ordinal = match choice {
            DeviceChoice::Cpu => return Ok(Self::CPU),
            DeviceChoice::Auto => 0,
            DeviceChoice::Cuda(n) => n,
        };
        let memory_cap = settings.memory_mib.map(|mib| mib << 20);
        match Gpu::open(ordinal, &GpuSettings { memory_cap, cache: None, low_priority: settings.low_priority, poison: false }) {
            Ok(gpu) => {
                let may_fall_back = choice == DeviceChoice::Auto;
                Ok(Self::Cuda(CudaDevice { gpu, storage: settings.storage, when_lost: settings.when_lost, may_fall_back }))
            }
            Err(why) if choice == DeviceChoice::Auto => Ok(Self::Cpu { why: Some(why.to_string()) }),
            Err(why) => Err(why),
        }
    }

    /// Opens the device that was asked for. `auto` never fails.
    ///
    /// # Errors
    /// `cuda:N`, since this build has no CUDA backend.
    #[cfg(not(feature = "cuda"))]
    pub fn open(choice: DeviceChoice, _: &DeviceSettings) -> Result<Self, DeviceError> {
        match choice {
            DeviceChoice::Cpu => Ok(Self::CPU),
            DeviceChoice::Auto => Ok(Self::Cpu { why: Some("built without the feature `cuda`".into()) }),
            DeviceChoice::Cuda(_) => Err(DeviceError::NotBuilt),
        }
    }

    /// Whether it is a GPU.
    pub fn is_gpu(&self) -> bool {
        !matches!(self, Self::Cpu { .. })
    }

    /// Traces seeds at `t0` once. If the device cannot and the settings allow it, the CPU does, and a note says why.
    ///
    /// # Errors
    /// A flow map that no tracer accepts; a device that fails, if the CPU must not take over.
    pub fn trace(&self, velocity: &VelocitySource, map: &FlowMap, t0: f64, seeds: &[[f32; 3]]) -> Result<TracedOnce, BackendError> {
        let (mut traced, mut note) = (Traced::default(), None);
        let mut begun = Instant::now();
        match self {
            Self::Cpu { .. } => {}
            #[cfg(feature = "cuda")]
            Self::Cuda(CudaDevice { gpu, storage, when_lost, may_fall_back }) => {
                let tuning = Tuning { storage: *storage, ..Tuning::default() };
                let tracer = CudaTracer::new(&SnapshotStore::new(gpu), gpu, velocity.clone(), map, t0, tuning);
                begun = Instant::now();
                match tracer.and_then(|tracer| Ok(tracer.trace(seeds, Extras::default(), &mut traced).map(|()| tracer)?)) {
                    Ok(tracer) => return Ok(TracedOnce { flow: tracer.into_host(), traced, seconds: begun.elapsed().as_secs_f64(), note }),
                    Err(BackendError::Device(error)) if if error.is_fault() { *when_lost == WhenLost::Cpu } else { *may_fall_back } => {
                        note = Some(format!("traced on the CPU: {error}"));
                    }
                    Err(error) => return Err(error),
                }
            }
        }
        let flow = cpu_tracer(velocity.clone(), map, t0)?;
        begun = begun.max(Instant::now());
        Tracer::trace(&*flow, seeds, Extras::default(), &mut traced);
        Ok(TracedOnce { flow, traced, seconds: begun.elapsed().as_secs_f64(), note })
    }
}

/// Seeds that were traced.
pub struct TracedOnce {
    /// The flow map on the CPU.
    pub flow: Box<dyn Tracer>,
    /// The results.
    pub traced: Traced,
    /// Wall-clock seconds of tracing.
    pub seconds: f64,
    /// Why the CPU traced in place of the device.
    pub note: Option<String>,
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
    }
}
