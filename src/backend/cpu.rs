//! The CPU backend: tracing, prediction, training and rendering in Rust on all threads.
//!
//! It uses no device, so it returns no device errors. This makes it the fallback for every other backend.

use super::audit::{AuditFindings, AuditRequest, audit};
use super::interruptible::Interruptible;
use super::router::QueryRouter;
use super::{Backend, BackendError, DeviceError, FrameJob, FrozenOf, Rendered, Routing, Surrogate, SurrogateRequest};
use crate::flow::{FlowMap, Tracer, VelocitySource, cpu_tracer};
use crate::render::Renderer;
use crate::source::Listener;
use crate::surrogate::{
    CheckpointError, CheckpointState, FrozenHybrid, Host, HostSurrogate, Learned, NetworkFrom, Predict, ReplayBuffer, Samples, Trace, build,
};
use std::path::Path;
use std::sync::atomic::AtomicBool;

/// The CPU.
#[derive(Debug, Clone, Copy, Default)]
pub struct Cpu;

impl Backend for Cpu {
    type Tracer = Box<dyn Tracer>;
    type Surrogate = HostSurrogate;
    type Samples = Samples;

    fn name(&self) -> String {
        "cpu".into()
    }

    fn prefetch(&self) -> Option<Listener> {
        None
    }

    fn tracer(&mut self, velocity: &VelocitySource, map: &FlowMap, t0: f64) -> Result<Self::Tracer, BackendError> {
        Ok(cpu_tracer(velocity.clone(), map, t0)?)
    }

    fn surrogate(&mut self, request: &SurrogateRequest<'_>, tracer: &Self::Tracer) -> Result<HostSurrogate, BackendError> {
        let tracer = Interruptible::new(tracer, request.stop);
        Ok(build(request.settings, request.network, request.domain, request.seed, &tracer)?)
    }

    fn render(&mut self, job: &FrameJob<'_, Self>, renderer: &mut Renderer) -> Result<Rendered<Samples>, DeviceError> {
        let surrogate = job.surrogate.map(|surrogate| surrogate as &dyn Predict);
        render_on_cpu(&HostFrame::of(job, job.tracer, surrogate), renderer)
    }

    fn audit(
        &mut self,
        request: &AuditRequest<'_>,
        tracer: &Self::Tracer,
        surrogate: Option<&FrozenOf<Self>>,
    ) -> Result<AuditFindings, DeviceError> {
        audit(request, tracer, surrogate.map(|surrogate| surrogate as &dyn Predict))
    }

    fn replan(&mut self, _: &DeviceError, _: &Self::Tracer, _: &mut Option<HostSurrogate>) -> Result<Option<String>, DeviceError> {
        Ok(None)
    }
}

/// A frame that the CPU renders. The tracer and the surrogate may run on a device.
pub struct HostFrame<'a> {
    tracer: &'a dyn Trace,
    surrogate: Option<&'a dyn Predict>,
    routing: Routing<'a>,
    picture: u64,
    samples: usize,
    progress: Option<&'a (dyn Fn(f32) + Sync)>,
    stop: &'a AtomicBool,
}

impl<'a> HostFrame<'a> {
    /// Takes the settings of a backend's job, with `tracer` and `surrogate` as the CPU calls them.
    pub fn of<B: Backend>(job: &FrameJob<'a, B>, tracer: &'a dyn Trace, surrogate: Option<&'a dyn Predict>) -> Self {
        let &FrameJob { routing, picture, samples, progress, stop, .. } = job;
        Self { tracer, surrogate, routing, picture, samples, progress, stop }
    }
}

/// Renders a frame on the CPU.
///
/// # Errors
/// The device of the tracer or of the surrogate fails, or the renderer rejects the number of samples. The state of `renderer` is then unspecified.
pub fn render_on_cpu(frame: &HostFrame<'_>, renderer: &mut Renderer) -> Result<Rendered<Samples>, DeviceError> {
    let mut router = QueryRouter::new(frame.tracer, frame.surrogate, frame.routing);
    let (film, stats) = renderer
        .render(frame.picture, &mut router, frame.samples, frame.progress.map(|report| report as &dyn Fn(f32)), frame.stop)
        .map_err(|refused| DeviceError::Unsupported { what: refused.to_string() })?;
    let (tally, samples) = router.finish()?;
    Ok(Rendered { film, stats, tally, samples })
}

impl Surrogate for HostSurrogate {
    type Tracer = Box<dyn Tracer>;
    type Frozen = FrozenHybrid<Host>;

    fn freeze(&self) -> Result<Self::Frozen, DeviceError> {
        self.freeze()
    }
    fn learns(&self) -> bool {
        self.learns()
    }
    fn trains_on_device(&self) -> bool {
        false
    }
    fn learn(&mut self, buffer: &ReplayBuffer, seconds: f64, max_steps: u64) -> Result<Learned, DeviceError> {
        self.learn(buffer, seconds, max_steps)
    }
    fn window_slid(&mut self, tracer: &Box<dyn Tracer>, stop: &AtomicBool) -> Result<(), DeviceError> {
        self.window_slid(&Interruptible::new(tracer, stop))
    }
    fn checkpoint(&self) -> Result<CheckpointState, DeviceError> {
        self.checkpoint()
    }
    fn checkpoint_async(&mut self) -> Result<Option<CheckpointState>, DeviceError> {
        self.checkpoint_async()
    }
    fn load(&mut self, path: &Path) -> Result<(), CheckpointError> {
        self.load(path)
    }
    fn bytes(&self) -> usize {
        Predict::bytes(self)
    }
    fn to_host(&mut self, from: NetworkFrom) -> Result<HostSurrogate, DeviceError> {
        self.to_host(from)
    }
}
