//! Who makes a frame's film: the CPU's renderer, or a GPU's where every query can be answered there.

#[cfg(feature = "cuda")]
use super::accelerator::{DeviceRenderer, Health};
use super::answers::Answers;
use super::audit::{AuditFindings, AuditRequest, audit};
use super::{Device, EngineError};
use crate::flow::Tracer;
use crate::render::{Film, RenderStats, Renderer};
use crate::surrogate::Predict;
use std::sync::atomic::AtomicBool;

/// Makes the films of a run.
pub(super) trait FrameRenderer: Send + Sync {
    /// Renders samples 0 to `samples` of every pixel. `answers`, which ask `tracer`, answer the queries, or at least are told how many were
    /// answered. Setting `stop` ends the frame after the wave in progress.
    fn render(
        &mut self,
        renderer: &mut Renderer,
        picture: u64,
        samples: usize,
        tracer: &dyn Tracer,
        answers: &mut Answers<'_>,
        progress: Option<&dyn Fn(f32)>,
        stop: &AtomicBool,
    ) -> Result<(Film, RenderStats), EngineError>;

    /// Gives copies of tables back that are about to be traced anew.
    fn let_go_of_tables(&mut self) {}

    /// Draws and traces a frame's audit points and holds the surrogate to them.
    fn audit(
        &mut self,
        request: AuditRequest<'_>,
        tracer: &dyn Tracer,
        surrogate: Option<&dyn Predict>,
    ) -> Result<AuditFindings, EngineError>;
}

/// What renders on `device`. A GPU on which the kernels do not load has failed, with the CPU behind it.
pub(super) fn frame_renderer(device: &Device) -> Box<dyn FrameRenderer> {
    match device {
        Device::Cpu { .. } => Box::new(OnCpu),
        #[cfg(feature = "cuda")]
        Device::Gpu { gpu, .. } => match gpu.renderer() {
            Ok(device) => Box::new(OnGpu { device, health: gpu.health().clone() }),
            Err(error) => {
                gpu.health().fail(error);
                Box::new(OnCpu)
            }
        },
    }
}

/// Walks on the CPU; traces wherever the tracer does.
struct OnCpu;

impl FrameRenderer for OnCpu {
    fn render(
        &mut self,
        renderer: &mut Renderer,
        picture: u64,
        samples: usize,
        _: &dyn Tracer,
        answers: &mut Answers<'_>,
        progress: Option<&dyn Fn(f32)>,
        stop: &AtomicBool,
    ) -> Result<(Film, RenderStats), EngineError> {
        Ok(renderer.render(picture, answers, samples, progress, stop)?)
    }

    fn audit(
        &mut self,
        request: AuditRequest<'_>,
        tracer: &dyn Tracer,
        surrogate: Option<&dyn Predict>,
    ) -> Result<AuditFindings, EngineError> {
        Ok(audit(request, tracer, surrogate))
    }
}

/// Makes films on the GPU where it can do so alone; otherwise, where its memory lacks, and once it fails, as on the CPU.
#[cfg(feature = "cuda")]
struct OnGpu {
    device: Box<dyn DeviceRenderer>,
    health: std::sync::Arc<Health>,
}

#[cfg(feature = "cuda")]
impl FrameRenderer for OnGpu {
    fn render(
        &mut self,
        renderer: &mut Renderer,
        picture: u64,
        samples: usize,
        tracer: &dyn Tracer,
        answers: &mut Answers<'_>,
        progress: Option<&dyn Fn(f32)>,
        stop: &AtomicBool,
    ) -> Result<(Film, RenderStats), EngineError> {
        if self.health.works() {
            match self.device.render(renderer, picture, samples, tracer, answers, progress, stop) {
                Ok(Some(done)) => return Ok(done),
                Ok(None) => {}
                // The same frame on the CPU: same majorants, same random numbers. The cycle hears why after it.
                Err(EngineError::Device(error)) => self.health.fail_unless_refused(*error, "the CPU walked a frame"),
                Err(error) => return Err(error),
            }
        }
        self.health.check()?;
        OnCpu.render(renderer, picture, samples, tracer, answers, progress, stop)
    }

    fn let_go_of_tables(&mut self) {
        self.device.let_go_of_tables();
    }

    fn audit(
        &mut self,
        request: AuditRequest<'_>,
        tracer: &dyn Tracer,
        surrogate: Option<&dyn Predict>,
    ) -> Result<AuditFindings, EngineError> {
        if let Some(surrogate) = surrogate.filter(|_| self.health.works()) {
            match self.device.audit(&request, tracer, surrogate) {
                Ok(Some(done)) => return Ok(done),
                Ok(None) => {}
                Err(error) => self.health.fail_unless_refused(error, "the CPU drew the points of an audit"),
            }
        }
        self.health.check()?;
        OnCpu.audit(request, tracer, surrogate)
    }
}
