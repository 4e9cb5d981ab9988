//! The seam between the engine and a GPU: what is asked of one, and what happens when it breaks.
//!
//! CUDA implements it; so does a test's device that breaks at any call, on machines without a GPU.

use super::EngineError;
use super::answers::Answers;
use super::audit::{AuditFindings, AuditRequest};
use super::cuda::{CudaTracerError, DeviceError};
use super::device::WhenLost;
use crate::field::{Domain, Snapshot};
use crate::flow::{Extras, FlowMap, StepChoice, Traced, TracedNodes, Tracer, VelocitySource};
use crate::render::{Film, RenderStats, Renderer};
use crate::surrogate::{DeviceLost, NotTaken, Offload, Predict, Table};
use std::collections::BTreeMap;
use std::fmt;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError, Weak};

/// An opened GPU, as the engine sees it.
pub trait Accelerator: fmt::Debug + Send + Sync {
    /// For records, e.g. `cuda:0 NVIDIA H200`.
    fn name(&self) -> String;

    /// Whether it still works, and what follows when it does not.
    fn health(&self) -> &Arc<Health>;

    /// A tracer for seeds at `t0`, best a [`Backed`] one.
    ///
    /// # Errors
    /// What [`crate::flow::cpu_tracer`] refuses, and what the device cannot do.
    fn tracer(&self, source: VelocitySource, map: &FlowMap, t0: f64) -> Result<Box<dyn Tracer>, CudaTracerError>;

    /// What makes films on it.
    ///
    /// # Errors
    /// What the device says.
    fn renderer(&self) -> Result<Box<dyn DeviceRenderer>, DeviceError>;

    /// What trains networks on it; none where nothing does.
    fn offload(&self) -> Option<Arc<dyn Offload>> {
        None
    }

    /// A snapshot that a window will want soon: it may come over while other work goes on.
    fn expect(&self, snapshot: &Arc<Snapshot>);
}

/// Makes films on a GPU.
pub trait DeviceRenderer: Send + Sync {
    /// Renders samples 0 to `samples` of every pixel, with the answers that `answers` would give by asking `tracer`; none where it cannot.
    ///
    /// # Errors
    /// [`EngineError::Device`]; then `answers` has counted nothing and `renderer` learnt nothing of this frame, which can be rendered
    /// again by other means.
    fn render(
        &mut self,
        renderer: &mut Renderer,
        picture: u64,
        samples: usize,
        tracer: &dyn Tracer,
        answers: &mut Answers<'_>,
        progress: Option<&dyn Fn(f32)>,
        stop: &std::sync::atomic::AtomicBool,
    ) -> Result<Option<(Film, RenderStats)>, EngineError>;

    /// Gives copies of tables from the host back: they are about to be traced anew, and old and new had better not need memory together.
    fn let_go_of_tables(&mut self) {}

    /// A frame's audit, as [`audit`](super::audit()) does it; none where it cannot.
    ///
    /// # Errors
    /// What the device says; the audit can be made again by other means.
    fn audit(
        &mut self,
        _request: &AuditRequest<'_>,
        _tracer: &dyn Tracer,
        _surrogate: &dyn Predict,
    ) -> Result<Option<AuditFindings>, DeviceError> {
        Ok(None)
    }
}

/// Whether a device works. The first failure ends all work on it; memory that it lacks and what it does not do are none, and cost what wanted
/// them alone.
#[derive(Debug, Default)]
pub struct Health {
    failure: Mutex<Option<DeviceError>>,
    /// What was done instead of what was refused, and the warning for the first time that it was, until that is told.
    shortages: Mutex<BTreeMap<&'static str, Option<String>>>,
    /// Whether it has taken work.
    in_use: AtomicBool,
    when_lost: WhenLost,
}

impl Health {
    /// Works.
    pub fn new(when_lost: WhenLost) -> Self {
        Self { when_lost, ..Self::default() }
    }

    /// It has taken work: what it refuses from here on is a failure.
    pub fn take_up(&self) {
        self.in_use.store(true, Ordering::Relaxed);
    }

    /// Whether it has taken work.
    pub fn in_use(&self) -> bool {
        self.in_use.load(Ordering::Relaxed)
    }

    /// Remembers the first failure; later work is not tried.
    pub fn fail(&self, error: DeviceError) {
        self.failure.lock().unwrap_or_else(PoisonError::into_inner).get_or_insert(error);
    }

    /// Takes in why a call came to nothing: for want of memory, and where the device does not do that, it goes on, and the caller does
    /// `instead`, in words; all else is a failure.
    pub fn fail_unless_refused(&self, error: DeviceError, instead: &'static str) {
        if !error.is_refusal() {
            return self.fail(error);
        }
        let when = if error.is_out_of_memory() { "this time and whenever the GPU's memory is short" } else { "which the GPU does not do" };
        let mut shortages = self.shortages.lock().unwrap_or_else(PoisonError::into_inner);
        shortages.entry(instead).or_insert_with(|| Some(format!("{instead}, {when}: {error}")));
    }

    /// Warnings of what was done instead of what was refused, each once.
    pub fn shortages(&self) -> Vec<String> {
        self.shortages.lock().unwrap_or_else(PoisonError::into_inner).values_mut().filter_map(Option::take).collect()
    }

    /// The first failure.
    pub fn failure(&self) -> Option<DeviceError> {
        self.failure.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// Whether nothing has failed.
    pub fn works(&self) -> bool {
        self.failure.lock().unwrap_or_else(PoisonError::into_inner).is_none()
    }

    /// What the device says; none, and nothing is asked of it, once it has failed. The cycle looks for failures after each frame and records
    /// them.
    pub fn ask<T>(&self, call: impl FnOnce() -> Result<T, DeviceError>) -> Option<T> {
        if !self.works() {
            return None;
        }
        call().map_err(|error| self.fail(error)).ok()
    }

    /// The same; where it refuses, mostly for want of memory, the caller does `instead`, in words, which is told.
    ///
    /// # Errors
    /// Once the device has failed, and where it refuses.
    pub fn ask_or<T>(&self, instead: &'static str, call: impl FnOnce() -> Result<T, DeviceError>) -> Result<T, NotTaken> {
        self.ask_for_room(|| call().inspect_err(|error| self.fail_unless_refused(error.clone(), instead)))
    }

    /// The same; where it refuses the reason, and the caller says what is done instead.
    ///
    /// # Errors
    /// Once the device has failed, and where it refuses.
    pub fn ask_for_room<T>(&self, call: impl FnOnce() -> Result<T, DeviceError>) -> Result<T, NotTaken> {
        let refused = |error: DeviceError| if error.is_refusal() { Ok(Err(NotTaken::NoRoom(error.to_string()))) } else { Err(error) };
        self.ask(|| call().map(Ok).or_else(refused)).ok_or(DeviceLost)?
    }

    /// Whether the run is to go on without the device.
    ///
    /// # Errors
    /// The failure, where it is to end the run.
    pub fn check(&self) -> Result<(), DeviceError> {
        match self.when_lost {
            WhenLost::Cpu => Ok(()),
            WhenLost::Stop => self.failure().map_or(Ok(()), Err),
        }
    }
}

/// Traces on a device, where any call may be the last.
pub trait DeviceTrace: Send + Sync + 'static {
    /// What [`Tracer::trace`] does; `out` has the lengths that it should have.
    ///
    /// # Errors
    /// What the device says; `out` then holds anything.
    fn trace(&self, seeds: &[[f32; 3]], extras: Extras, out: &mut Traced) -> Result<(), DeviceError>;

    /// Whether [`Traced::log_stretch_f64`] is filled.
    fn double(&self) -> bool;

    /// What [`Tracer::trace_nodes`] does; none where the device does not.
    ///
    /// # Errors
    /// What the device says.
    fn trace_nodes(&self, _domain: &Domain, _nodes: [usize; 3]) -> Result<Option<Box<dyn DeviceNodes>>, DeviceError> {
        Ok(None)
    }
}

/// Values at nodes on a device, where any call may be the last: what [`TracedNodes`] is to the rest of the program.
pub trait DeviceNodes: fmt::Debug + Send + Sync + 'static {
    /// Nodes whose trace was not finite.
    fn not_finite(&self) -> usize;

    /// All values, x fastest.
    ///
    /// # Errors
    /// What the device says.
    fn values(&self) -> Result<Vec<f32>, DeviceError>;

    /// Interpolates at unit points.
    ///
    /// # Errors
    /// What the device says; `out` then holds anything.
    fn interpolate(&self, points: &[[f32; 3]], out: &mut [f32]) -> Result<(), DeviceError>;

    /// Itself.
    fn as_any(&self) -> &dyn std::any::Any;
}

/// Nodes on a device, with the CPU's tracer behind them, which traces them anew when the device is lost.
struct BackedNodes {
    device: Box<dyn DeviceNodes>,
    nodes: [usize; 3],
    /// Lives as long as the frames of its slide are made. Not held beyond, since it holds that slide's window.
    host: Weak<dyn Tracer>,
    health: Arc<Health>,
}

impl fmt::Debug for BackedNodes {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.device.fmt(f)
    }
}

impl TracedNodes for BackedNodes {
    fn not_finite(&self) -> usize {
        self.device.not_finite()
    }
    fn values(&self) -> Vec<f32> {
        let anew = || {
            let host = self.host.upgrade().filter(|_| self.health.check().is_ok());
            host.map(|host| Table::trace(&*host, self.nodes).values().to_vec())
        };
        let values = self.health.ask(|| self.device.values()).or_else(anew);
        values.unwrap_or_else(|| {
            // The run is about to end: by the failure, or behind its last frame, where a checkpoint alone asks, which is not written then.
            tracing::warn!("the values of a table went with the device");
            vec![f32::NAN; self.nodes.iter().product()]
        })
    }
    fn interpolate(&self, points: &[[f32; 3]], out: &mut [f32]) -> bool {
        self.health.ask_or("the CPU looked points up in a table of the GPU's", || self.device.interpolate(points, out)).is_ok()
    }
    fn as_any(&self) -> &dyn std::any::Any {
        self.device.as_any()
    }
}

/// A device's tracer with the CPU's behind it: that one checks the settings, chooses the number of steps, and goes on when the device
/// is lost. Where the run is to end then, what is asked afterwards is NaN, so that the run gets there soon.
pub struct Backed<T> {
    device: T,
    host: Arc<dyn Tracer>,
    health: Arc<Health>,
}

impl<T: DeviceTrace> Backed<T> {
    /// `host` traces the same flow map.
    pub fn with(device: T, host: Box<dyn Tracer>, health: Arc<Health>) -> Self {
        Self { device, host: host.into(), health }
    }

    /// The device's side.
    pub fn on_device(&self) -> &T {
        &self.device
    }
}

impl<T: DeviceTrace> Tracer for Backed<T> {
    fn domain(&self) -> &Domain {
        self.host.domain()
    }
    fn start(&self) -> f64 {
        self.host.start()
    }
    fn tau(&self) -> f64 {
        self.host.tau()
    }
    fn steps(&self) -> usize {
        self.host.steps()
    }
    fn step_choice(&self) -> Option<StepChoice> {
        self.host.step_choice()
    }
    fn is_missing(&self, seed: [f32; 3]) -> bool {
        self.host.is_missing(seed)
    }
    fn as_any(&self) -> Option<&dyn std::any::Any> {
        Some(self)
    }

    fn trace_nodes(&self, nodes: [usize; 3]) -> Option<Arc<dyn TracedNodes>> {
        // In parts, with memory for seeds and results of one alone.
        let instead = "a table was traced in parts and is kept on the CPU";
        let device = self.health.ask_or(instead, || self.device.trace_nodes(self.domain(), nodes)).ok()??;
        Some(Arc::new(BackedNodes { device, nodes, host: Arc::downgrade(&self.host), health: self.health.clone() }))
    }

    fn trace(&self, seeds: &[[f32; 3]], extras: Extras, out: &mut Traced) {
        let on_device = || {
            out.set_len(seeds.len(), extras, self.device.double());
            self.device.trace(seeds, extras, out)
        };
        // The cycle asks for failures and warnings after each frame and records them.
        if self.health.ask_or("the CPU traced seeds", on_device).is_ok() {
            return;
        }
        if self.health.check().is_ok() {
            self.host.trace(seeds, extras, out);
        } else {
            *out = Traced::default();
            out.set_len(seeds.len(), extras, self.device.double());
        }
    }
}
