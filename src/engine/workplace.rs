//! Where a run's tracing and rendering is done: on the CPU, or on a GPU with the CPU behind it.

use super::answers::Answers;
#[cfg(feature = "cuda")]
use super::cuda::{CudaTracer, CudaTracerError, Gpu, GpuRenderer, SnapshotStore, Traced, Tuning};
use super::{Device, EngineError};
use crate::config::OnLoss;
use crate::flow::{FlowMap, Tracer, VelocitySource, cpu_tracer};
use crate::render::{Film, RenderStats, Renderer};
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

/// Makes a frame's film.
pub(super) trait FrameRenderer: Send {
    /// Renders samples 0 to `samples` of every pixel; `answers` answers the queries, or at least is told what was answered.
    fn render(
        &mut self,
        renderer: &mut Renderer,
        picture: u64,
        samples: usize,
        answers: &mut Answers<'_>,
        progress: Option<&dyn Fn(f32)>,
    ) -> Result<(Film, RenderStats), EngineError>;
}

/// The devices of a run.
pub(super) struct Workplace {
    name: String,
    #[cfg(feature = "cuda")]
    gpu: Option<GpuPlace>,
}

#[cfg(feature = "cuda")]
struct GpuPlace {
    gpu: Arc<Gpu>,
    store: SnapshotStore,
    renderer: GpuRenderer,
    /// The slide's flow map.
    tracer: Option<Arc<CudaTracer>>,
    on_loss: OnLoss,
}

impl Workplace {
    /// Gets ready to work on `device`.
    #[cfg(feature = "cuda")]
    pub(super) fn new(device: &Device, on_loss: OnLoss) -> Result<Self, EngineError> {
        let gpu = match device {
            Device::Cpu { .. } => None,
            Device::Cuda(gpu) => Some(GpuPlace {
                gpu: gpu.clone(),
                store: SnapshotStore::new(gpu),
                renderer: GpuRenderer::new(gpu)?,
                tracer: None,
                on_loss,
            }),
        };
        Ok(Self { name: device.name(), gpu })
    }

    /// Gets ready to work on `device`.
    #[cfg(not(feature = "cuda"))]
    pub(super) fn new(device: &Device, _: OnLoss) -> Result<Self, EngineError> {
        Ok(Self { name: device.name() })
    }

    /// For records: the device that works now.
    pub(super) fn name(&self) -> &str {
        &self.name
    }

    /// The tracer of a slide. What the GPU cannot do (the adaptive integrator, a window that does not fit) is an error, not a silent
    /// change of device; a GPU that has failed is not asked again.
    pub(super) fn tracer(&mut self, velocity: &VelocitySource, map: &FlowMap, time: f64) -> Result<Arc<dyn Tracer>, EngineError> {
        #[cfg(feature = "cuda")]
        if let Some(place) = &mut self.gpu {
            match CudaTracer::new(&place.store, &place.gpu, velocity.clone(), map, time, Tuning::default()) {
                Ok(tracer) => {
                    let tracer = Arc::new(tracer);
                    // Which seeds lie on land is known on the host alone.
                    let land = matches!(velocity, VelocitySource::Window(window) if window.snapshots().any(|s| s.missing() > 0));
                    place.tracer = (!land).then(|| tracer.clone());
                    return Ok(tracer);
                }
                Err(CudaTracerError::Flow(error)) => return Err(error.into()),
                Err(CudaTracerError::Device(error)) if error.is_lost() => place.gpu.fail(error),
                Err(CudaTracerError::Device(error)) => return Err(error.into()),
            }
        }
        Ok(cpu_tracer(velocity.clone(), map, time)?.into())
    }

    /// To be asked after each frame: a failed GPU ends the run or, once, gives a warning.
    ///
    /// # Errors
    /// With `on_loss = "stop"`.
    pub(super) fn check(&mut self, warnings: &mut Vec<String>) -> Result<(), EngineError> {
        #[cfg(feature = "cuda")]
        if let Some(place) = &self.gpu
            && let Some(error) = place.gpu.failure()
        {
            let device = std::mem::replace(&mut self.name, "cpu".into());
            if place.on_loss == OnLoss::Stop {
                return Err(EngineError::DeviceFailed { device, reason: error.to_string() });
            }
            warnings.push(format!("{device} failed ({error}): work goes on on the CPU"));
            self.gpu = None;
        }
        #[cfg(not(feature = "cuda"))]
        let _ = warnings;
        Ok(())
    }
}

impl FrameRenderer for Workplace {
    fn render(
        &mut self,
        renderer: &mut Renderer,
        picture: u64,
        samples: usize,
        answers: &mut Answers<'_>,
        progress: Option<&dyn Fn(f32)>,
    ) -> Result<(Film, RenderStats), EngineError> {
        let never = AtomicBool::new(false);
        #[cfg(feature = "cuda")]
        if let Some(GpuPlace { gpu, renderer: device, tracer: Some(tracer), .. }) = &mut self.gpu
            && gpu.failure().is_none()
            && answers.only_traces()
        {
            let end = u32::try_from(samples).unwrap_or(u32::MAX);
            match device.render_samples(renderer, picture, 0..end, &Traced(tracer.device()), progress, &never) {
                Ok((film, stats)) => {
                    answers.answered_elsewhere(&stats);
                    return Ok((film, stats));
                }
                // The same frame again on the CPU: same majorants, same random numbers.
                Err(EngineError::Device(error)) => gpu.fail(*error),
                Err(error) => return Err(error),
            }
        }
        Ok(renderer.render(picture, answers, samples, progress, &never)?)
    }
}
