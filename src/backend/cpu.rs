//! The CPU backend: tracing, prediction, training and rendering in Rust on all threads.
//!
//! It uses no device, so it returns no device errors. This makes it the fallback for every other backend.

use super::audit::{AuditFindings, AuditRequest, audit};
use super::interruptible::Interruptible;
use super::router::{QueryRouter, Tally};
use super::{
    Backend, BackendError, DeviceError, FrameJob, FrozenOf, Rendered, Routing, Smooth, StartsAnew, Surrogate, SurrogateRequest,
    TracedBricks,
};
use rayon::prelude::*;
use ridgewatch_base::progress::{self, Work};
use ridgewatch_field::{DomainPoint, UnitPoint};
use ridgewatch_flow::{Extras, FlowMap, Traced, Tracer, VelocitySource, cpu_tracer};
use ridgewatch_render::smooth::{Nodes, Picture, PictureError, Refinement, own_nodes};
use ridgewatch_render::{Film, LogStretch, MapPicture, RenderStats, Renderer};
use ridgewatch_source::Listener;
use ridgewatch_surrogate::{
    CheckpointError, CheckpointState, FrozenHybrid, Host, HostSurrogate, Learned, NetworkFrom, Predict, ReplayBuffer, Samples, Trace, build,
};
use ridgewatch_trust::Gate;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;

/// The CPU.
#[derive(Debug, Clone, Copy, Default)]
pub struct Cpu;

impl Backend for Cpu {
    type Tracer = Box<dyn Tracer>;
    type Surrogate = HostSurrogate;
    type Samples = Samples;
    type Picture = HostPicture;

    fn name(&self) -> String {
        "cpu".into()
    }

    fn is_gpu(&self) -> bool {
        false
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

    fn render(
        &mut self,
        job: &FrameJob<'_, Self>,
        renderer: &mut Renderer,
        picture: &mut HostPicture,
    ) -> Result<Rendered<Samples>, DeviceError> {
        let surrogate = job.surrogate.map(|surrogate| surrogate as &dyn Predict);
        render_on_cpu(&HostFrame::of(job, job.tracer, surrogate), renderer, picture)
    }

    fn audit(
        &mut self,
        request: &AuditRequest<'_>,
        tracer: &Self::Tracer,
        surrogate: Option<&FrozenOf<Self>>,
    ) -> Result<AuditFindings, DeviceError> {
        audit(request, &Interruptible::new(tracer, request.stop), surrogate.map(|surrogate| surrogate as &dyn Predict))
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
    samples: f64,
    smooth: Option<Smooth>,
    is_map: bool,
    progress: Option<&'a (dyn Fn(f32) + Sync)>,
    stop: &'a AtomicBool,
}

impl<'a> HostFrame<'a> {
    /// Takes the settings of a backend's job, with `tracer` and `surrogate` as the CPU calls them.
    pub fn of<B: Backend>(job: &FrameJob<'a, B>, tracer: &'a dyn Trace, surrogate: Option<&'a dyn Predict>) -> Self {
        let &FrameJob { routing, picture, samples, smooth, is_map, progress, stop, .. } = job;
        Self { tracer, surrogate, routing, picture, samples, smooth, is_map, progress, stop }
    }
}

/// A picture that the CPU accumulates, with the nodes of the surrogate that it shows.
#[derive(Debug, Default)]
pub struct HostPicture {
    nodes: Option<Nodes>,
    picture: Picture,
    map: MapPicture,
    /// Bricks that were traced instead, and the values of their own nodes, one after the other.
    traced: TracedBricks,
    traced_values: Vec<f32>,
}

impl StartsAnew for HostPicture {
    fn start_anew(&mut self) {
        (self.nodes, self.picture) = (None, Picture::default());
    }
}

impl HostPicture {
    /// Lays the surrogate out on nodes, once: predicted where it is trusted, and traced elsewhere as far as `smooth` allows. `None` if `stop` ended it early.
    fn nodes(
        &mut self,
        frame: &HostFrame<'_>,
        smooth: Smooth,
        renderer: &Renderer,
        router: &mut QueryRouter<'_>,
    ) -> Result<Option<Nodes>, DeviceError> {
        /// Nodes that are predicted at once, which bounds the memory beside the nodes.
        const AT_ONCE: usize = 1 << 20;
        /// Bricks that are traced at once: some tens of thousands of nodes.
        const BRICKS_AT_ONCE: usize = 128;
        if let Some(nodes) = &self.nodes {
            return Ok(Some(nodes.clone()));
        }
        let shape = smooth.nodes;
        let surrogate = frame.surrogate.ok_or_else(|| DeviceError::Unsupported { what: "a smooth frame without a surrogate".into() })?;
        let is_stopped = || {
            progress::mark();
            frame.stop.load(Ordering::Relaxed)
        };
        let all = shape.iter().product();
        let mut values = vec![0.0; all];
        let work = Work::begin("laying the surrogate out on nodes");
        for (part, values) in values.chunks_mut(AT_ONCE).enumerate() {
            if is_stopped() {
                return Ok(None);
            }
            let first = part * AT_ONCE;
            work.reached(first, all);
            let points: Vec<UnitPoint> = (first..first + values.len()).into_par_iter().map(|i| Nodes::unit(shape, i)).collect();
            surrogate.predict(&points, values)?;
        }
        drop(work);
        let mut nodes = Nodes::new(shape, Arc::new(values));
        if smooth.traced_nodes > 0 {
            if self.traced.settle(shape) {
                self.traced_values.clear();
            }
            let next = self.traced.next(nodes.brick_max(), frame.routing.gate, |s| renderer.ramp(s), smooth.traced_nodes);
            let domain = frame.tracer.flow().domain();
            let work = Work::begin("tracing nodes where the surrogate is not trusted");
            for (part, bricks) in next.chunks(BRICKS_AT_ONCE).enumerate() {
                work.reached(part * BRICKS_AT_ONCE, next.len());
                let points: Vec<DomainPoint> = indices(shape, bricks).map(|i| domain.from_unit(Nodes::unit(shape, i))).collect();
                let mut found = vec![0.0; points.len()];
                router.trace_nodes(&points, &mut found)?;
                if is_stopped() {
                    return Ok(None);
                }
                // As in a table, whose interpolation a NaN would spread.
                self.traced_values.extend(found.into_iter().map(|value| if value.is_finite() { value } else { 0.0 }));
                self.traced.add(bricks);
            }
            let mut values = nodes.into_values();
            indices(shape, self.traced.bricks()).zip(&self.traced_values).for_each(|(node, &value)| values[node] = value);
            nodes = Nodes::new(shape, Arc::new(values));
        }
        Ok(Some(self.nodes.insert(nodes).clone()))
    }
}

/// Own nodes of bricks, one after the other.
fn indices(shape: [usize; 3], bricks: &[u32]) -> impl Iterator<Item = usize> {
    bricks.iter().flat_map(move |&brick| {
        let [x, y, z] = own_nodes(shape, brick as usize);
        z.flat_map(move |z| {
            let x = x.clone();
            y.clone().flat_map(move |y| x.clone().map(move |x| (z * shape[1] + y) * shape[0] + x))
        })
    })
}

/// Renders a smooth frame on the CPU.
fn refine_on_cpu(
    frame: &HostFrame<'_>,
    smooth: Smooth,
    renderer: &mut Renderer,
    picture: &mut HostPicture,
) -> Result<Rendered<Samples>, DeviceError> {
    let flow = frame.tracer.flow();
    let is_missing = |point: DomainPoint| flow.is_missing(point);
    let nothing_trusted = Gate::uniform(false);
    let routing = Routing { gate: &nothing_trusted, trace_budget: None, ..frame.routing };
    let tracer = Interruptible::new(frame.tracer, frame.stop);
    let mut router = QueryRouter::new(&tracer, None, routing);
    let nodes = picture.nodes(frame, smooth, renderer, &mut router)?;
    let round = |nodes| Refinement {
        nodes,
        missing: flow.has_missing().then_some(&is_missing),
        method: smooth.method,
        sum: smooth.sum,
        samples: frame.samples,
        budget: smooth.budget,
        steps_error: smooth.steps_error,
        number: frame.picture,
        stop: frame.stop,
    };
    let refined = nodes.as_ref().and_then(|nodes| renderer.refine(&mut picture.picture, &round(nodes), &mut router));
    let (mut tally, samples) = router.finish()?;
    tally.untraced_share = (smooth.traced_nodes > 0).then(|| picture.traced.untraced_share());
    if let Some(report) = frame.progress {
        report(1.0);
    }
    Ok(match refined {
        Some((film, stats, error)) => {
            Rendered { film: film.into(), stats, tally, samples, error: Some(error).filter(PictureError::is_known) }
        }
        None => {
            let (film, stats) = stopped(renderer);
            Rendered { film: film.into(), stats, tally, samples, error: None }
        }
    })
}

/// Traces the seeds of a map. NaN, not traced, in missing cells.
struct MapSeeds<'a> {
    tracer: Interruptible<'a>,
    traced: Traced,
    tally: Tally,
    failure: Option<DeviceError>,
}

impl LogStretch for MapSeeds<'_> {
    fn evaluate(&mut self, points: &[DomainPoint], log_stretch: &mut [f32], traced: &mut [bool]) {
        let began = Instant::now();
        if self.failure.is_none() {
            self.failure = self.tracer.trace(points, Extras::default(), &mut self.traced).err();
        }
        if self.failure.is_some() {
            log_stretch.fill(f32::NAN);
            traced.fill(false);
            return;
        }
        let flow = self.tracer.flow();
        let values = log_stretch.par_iter_mut().zip(traced).zip(points).zip(&self.traced.log_stretch).with_min_len(1 << 12);
        let missing = values.map(|(((value, traced), &point), &found)| {
            let is_missing = flow.is_missing(point);
            (*value, *traced) = if is_missing { (f32::NAN, false) } else { (found, true) };
            u64::from(is_missing)
        });
        let (missing, all) = (missing.sum::<u64>(), points.len() as u64);
        let tally = &mut self.tally;
        (tally.queries, tally.traced, tally.missing) = (tally.queries + all, tally.traced + all - missing, tally.missing + missing);
        tally.trace_seconds += began.elapsed().as_secs_f64();
    }
}

/// Adds to a map. Its points are chosen and its pixels summed on the CPU, whatever device traces.
fn refine_map(frame: &HostFrame<'_>, renderer: &Renderer, picture: &mut HostPicture) -> Result<Rendered<Samples>, DeviceError> {
    let tracer = Interruptible::new(frame.tracer, frame.stop);
    let mut seeds = MapSeeds { tracer, traced: Traced::default(), tally: Tally::default(), failure: None };
    let progress = frame.progress.map(|report| report as &dyn Fn(f32));
    let refined = picture.map.refine(renderer, frame.samples, &mut seeds, progress, frame.stop);
    if let Some(failure) = seeds.failure {
        // It holds seeds without a value.
        picture.map = MapPicture::default();
        return Err(failure);
    }
    let (film, stats, error) = match refined {
        Some((film, stats, error)) => (film, stats, Some(error).filter(PictureError::is_known)),
        None => {
            let (film, stats) = stopped(renderer);
            (film, stats, None)
        }
    };
    Ok(Rendered { film: film.into(), stats, tally: seeds.tally, samples: Samples::default(), error })
}

/// What is left of a frame that was stopped.
fn stopped(renderer: &Renderer) -> (Film, RenderStats) {
    let settings = &renderer.scene().settings;
    (Film::new(settings.width, settings.height), RenderStats { stopped: true, ..RenderStats::default() })
}

/// Renders a frame on the CPU.
///
/// # Errors
/// The device of the tracer or of the surrogate fails, or the renderer rejects the number of samples. The state of `renderer` is then unspecified.
pub fn render_on_cpu(frame: &HostFrame<'_>, renderer: &mut Renderer, picture: &mut HostPicture) -> Result<Rendered<Samples>, DeviceError> {
    if frame.is_map {
        return refine_map(frame, renderer, picture);
    }
    if let Some(smooth) = frame.smooth {
        return refine_on_cpu(frame, smooth, renderer, picture);
    }
    // A wave of slow paths may take minutes.
    let tracer = Interruptible::new(frame.tracer, frame.stop);
    let mut router = QueryRouter::new(&tracer, frame.surrogate, frame.routing);
    let (film, stats) = renderer
        .render(frame.picture, &mut router, frame.samples.ceil() as usize, frame.progress.map(|report| report as &dyn Fn(f32)), frame.stop)
        .map_err(|refused| DeviceError::Unsupported { what: refused.to_string() })?;
    let (tally, samples) = router.finish()?;
    Ok(Rendered { film: film.into(), stats, tally, samples, error: None })
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
    fn refine_table(&mut self, tracer: &Box<dyn Tracer>, nodes: [usize; 3], most: usize, stop: &AtomicBool) -> Result<bool, DeviceError> {
        self.refine_table(&Interruptible::new(tracer, stop), nodes, most, stop)
    }
    fn finer_nodes(&self) -> Option<[usize; 3]> {
        self.finer_nodes()
    }
    fn table_nodes(&self) -> Option<[usize; 3]> {
        self.table_nodes()
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
