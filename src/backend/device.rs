//! Device selection: the device of this machine that the option `--device` and the settings table `[device]` select.

#[cfg(feature = "cuda")]
use super::cuda::{CudaTracer, Gpu, GpuSettings, SnapshotStore, Tuning};
use super::settings::{DeviceChoice, DeviceSettings};
#[cfg(feature = "cuda")]
use super::settings::{Storage, WhenLost};
use super::{BackendError, DeviceError, Interruptible};
use ridgewatch_field::DomainPoint;
use ridgewatch_flow::{Extras, FlowMap, Traced, Tracer, VelocitySource, cpu_tracer};
use ridgewatch_surrogate::Trace;
#[cfg(feature = "cuda")]
use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::time::Instant;

/// The selected device.
#[derive(Debug, Clone)]
pub enum Device {
    /// The CPU.
    Cpu {
        /// Reason why no GPU is used. `None` if the CPU was requested.
        why: Option<String>,
    },
    /// A GPU.
    #[cfg(feature = "cuda")]
    Cuda(CudaDevice),
}

/// An opened GPU with its settings.
#[cfg(feature = "cuda")]
#[derive(Debug, Clone)]
pub struct CudaDevice {
    /// The GPU.
    pub gpu: Arc<Gpu>,
    /// Storage format of the velocity window; `None`: chosen by the run, and f32 for work that is no run.
    pub storage: Option<Storage>,
    /// Reaction to a lost device.
    pub when_lost: WhenLost,
    /// True if the CPU takes over when the first slide does not fit the device. This is so if the device was selected by `auto`.
    pub may_fall_back: bool,
}

impl Default for Device {
    fn default() -> Self {
        Self::CPU
    }
}

impl Device {
    /// The CPU, as requested by `--device cpu`.
    pub const CPU: Self = Self::Cpu { why: None };

    /// Opens the requested device. `auto` never fails.
    ///
    /// # Errors
    /// `cuda:N` is requested and cannot be used.
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

    /// Opens the requested device. `auto` never fails.
    ///
    /// # Errors
    /// `cuda:N` is requested; this build has no CUDA backend.
    #[cfg(not(feature = "cuda"))]
    pub fn open(choice: DeviceChoice, _: &DeviceSettings) -> Result<Self, DeviceError> {
        match choice {
            DeviceChoice::Cpu => Ok(Self::CPU),
            DeviceChoice::Auto => Ok(Self::Cpu { why: Some("built without the feature `cuda`".into()) }),
            DeviceChoice::Cuda(_) => Err(DeviceError::NotBuilt),
        }
    }

    /// Returns true for a GPU.
    pub fn is_gpu(&self) -> bool {
        !matches!(self, Self::Cpu { .. })
    }

    /// Flow map for seeds at the start time `t0`. If the device cannot and the settings allow the CPU to take over, it is that of the CPU and a
    /// note says why.
    ///
    /// # Errors
    /// The flow map is invalid, or the device fails and the settings do not allow the CPU to take over.
    pub fn tracer(&self, velocity: &VelocitySource, map: &FlowMap, t0: f64) -> Result<(Box<dyn Trace>, Option<String>), BackendError> {
        #[cfg_attr(not(feature = "cuda"), allow(unused_mut))] // no other device fails
        let mut note = None;
        match self {
            Self::Cpu { .. } => {}
            #[cfg(feature = "cuda")]
            Self::Cuda(CudaDevice { gpu, storage, .. }) => {
                let tuning = Tuning { storage: storage.unwrap_or_default(), ..Tuning::default() };
                match CudaTracer::new(&SnapshotStore::new(gpu), gpu, velocity.clone(), map, t0, tuning) {
                    Ok(tracer) => return Ok((Box::new(tracer), None)),
                    Err(BackendError::Device(error)) if self.may_fall_back(&error) => note = Some(format!("traced on the CPU: {error}")),
                    Err(error) => return Err(error),
                }
            }
        }
        Ok((Box::new(cpu_tracer(velocity.clone(), map, t0)?), note))
    }

    /// True if the settings allow the CPU to take over after this error.
    pub fn may_fall_back(&self, #[cfg_attr(not(feature = "cuda"), allow(unused_variables))] error: &DeviceError) -> bool {
        match self {
            Self::Cpu { .. } => false,
            #[cfg(feature = "cuda")]
            Self::Cuda(CudaDevice { when_lost, may_fall_back, .. }) => {
                if error.is_fault() {
                    *when_lost == WhenLost::Cpu
                } else {
                    *may_fall_back
                }
            }
        }
    }

    /// Traces one set of seeds at the start time `t0`. If the device cannot and the settings allow the CPU to take over, the CPU
    /// traces them and a note says why. Setting `stop` ends the work early; the results of the seeds that are left are then NaN.
    ///
    /// # Errors
    /// The flow map is invalid, or the device fails and the settings do not allow the CPU to take over.
    pub fn trace(
        &self,
        velocity: &VelocitySource,
        map: &FlowMap,
        t0: f64,
        seeds: &[DomainPoint],
        stop: &AtomicBool,
    ) -> Result<TracedOnce, BackendError> {
        let mut traced = Traced::default();
        #[cfg_attr(not(feature = "cuda"), allow(unused_mut))] // no other device fails
        let mut note = None;
        let mut begun = Instant::now();
        match self {
            Self::Cpu { .. } => {}
            #[cfg(feature = "cuda")]
            Self::Cuda(CudaDevice { gpu, storage, .. }) => {
                let tuning = Tuning { storage: storage.unwrap_or_default(), ..Tuning::default() };
                let tracer = CudaTracer::new(&SnapshotStore::new(gpu), gpu, velocity.clone(), map, t0, tuning);
                begun = Instant::now();
                let mut trace = |tracer: &CudaTracer| Interruptible::new(tracer, stop).trace(seeds, Extras::default(), &mut traced);
                match tracer.and_then(|tracer| Ok(trace(&tracer).map(|()| tracer)?)) {
                    Ok(tracer) => return Ok(TracedOnce { flow: tracer.into_host(), traced, seconds: begun.elapsed().as_secs_f64(), note }),
                    Err(BackendError::Device(error)) if self.may_fall_back(&error) => {
                        note = Some(format!("traced on the CPU: {error}"));
                    }
                    Err(error) => return Err(error),
                }
            }
        }
        let flow = cpu_tracer(velocity.clone(), map, t0)?;
        begun = begun.max(Instant::now());
        Interruptible::new(&flow, stop).trace(seeds, Extras::default(), &mut traced)?;
        Ok(TracedOnce { flow, traced, seconds: begun.elapsed().as_secs_f64(), note })
    }
}

/// Result of [`Device::trace`].
pub struct TracedOnce {
    /// The flow map on the CPU.
    pub flow: Box<dyn Tracer>,
    /// The results.
    pub traced: Traced,
    /// Wall-clock seconds of tracing.
    pub seconds: f64,
    /// Reason why the CPU traced instead of the device. `None` if the selected device traced.
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
