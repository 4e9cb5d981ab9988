//! Who makes a frame's film: the CPU's renderer, or a GPU's where every query is traced there.

use super::answers::Answers;
#[cfg(feature = "cuda")]
use super::cuda::{CudaTracer, GpuRenderer, Traced};
use super::{Device, EngineError};
use crate::flow::Tracer;
use crate::render::{Film, RenderStats, Renderer};
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
}

/// What renders on `device`. A GPU on which the kernels do not load has failed, with the CPU behind it.
pub(super) fn frame_renderer(device: &Device) -> Box<dyn FrameRenderer> {
    match device {
        Device::Cpu { .. } => Box::new(OnCpu),
        #[cfg(feature = "cuda")]
        Device::Cuda { gpu, .. } => match GpuRenderer::new(gpu) {
            Ok(device) => Box::new(OnGpu(device)),
            Err(error) => {
                gpu.fail(error);
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
}

/// Walks and traces on the GPU when nothing else is to be asked; otherwise, and when the GPU fails, as on the CPU.
#[cfg(feature = "cuda")]
struct OnGpu(GpuRenderer);

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
        let on_device = tracer.as_any().and_then(|any| any.downcast_ref::<CudaTracer>());
        // Which seeds lie on land is known on the host alone.
        if let Some(traced) =
            on_device.filter(|t| !t.device().meets_land() && t.device().gpu().failure().is_none() && answers.only_traces())
        {
            let end = u32::try_from(samples).unwrap_or(u32::MAX);
            match self.0.render_samples(renderer, picture, 0..end, &Traced(traced.device()), progress, stop) {
                Ok((film, stats)) => {
                    answers.answered_elsewhere(&stats);
                    return Ok((film, stats));
                }
                // The same frame on the CPU: same majorants, same random numbers. The cycle hears of the failure after it.
                Err(EngineError::Device(error)) => traced.device().gpu().fail(*error),
                Err(error) => return Err(error),
            }
        }
        OnCpu.render(renderer, picture, samples, tracer, answers, progress, stop)
    }
}
