//! Training offline on a still window: the loss on points that the network never sees, epoch by epoch, and pictures on the way.

use super::failed;
use super::ftle::{Opened, Points};
use super::slides::FirstSlides;
use super::still::colours_of;
#[cfg(feature = "cuda")]
use crate::backend::cuda::Cuda;
use crate::backend::{Backend, Cpu, Device, FrameJob, Interruptible, Rendered, Routing, Surrogate as _, SurrogateRequest};
use crate::flow::Extras;
use crate::render::{Film, Method, Renderer, Scene};
use crate::run::{Decision, RunError, Settings, cpu_batch, suited_network};
use crate::surrogate::network::SMALLEST_BATCH;
use crate::surrogate::{Predict, ReplayBuffer, Samples};
use crate::trust::Gate;
use serde::Serialize;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;

/// Fewest steps of an epoch, if the scene leaves the batch of a GPU open.
const LEAST_STEPS: usize = 64;

/// How long a network is trained, and on what.
#[derive(Debug, Clone, PartialEq)]
pub struct TrainOptions {
    /// Passes over the labels.
    pub epochs: u64,
    /// Traced labels.
    pub labels: usize,
    /// Points of the validation, traced apart.
    pub validation: usize,
    /// Epochs after which a picture is rendered, besides the last one.
    pub pictures: Vec<u64>,
}

impl Default for TrainOptions {
    fn default() -> Self {
        Self { epochs: 100, labels: 1 << 20, validation: 1 << 15, pictures: vec![1, 100] }
    }
}

/// An epoch.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Epoch {
    /// Its number, from 1.
    pub epoch: u64,
    /// Optimizer steps so far.
    pub steps: u64,
    /// Seconds of training so far; labels and validation are not counted.
    pub seconds: f64,
    /// Mean loss of training; `None` if no step was taken.
    pub loss: Option<f64>,
    /// Root mean square error of the log-stretch on the validation points.
    pub rms: f64,
    /// PSNR in decibels on the validation points; peak: their largest traced log-stretch. `None` if the error is 0.
    pub psnr: Option<f64>,
    /// Roll-backs of the weights because the loss diverged.
    pub rollbacks: u64,
}

/// Result of a training.
#[derive(Debug, Clone, Serialize)]
pub struct TrainReport {
    /// All epochs.
    pub epochs: Vec<Epoch>,
    /// Seconds of tracing the labels.
    pub label_seconds: f64,
    /// Bytes of the surrogate.
    pub bytes: usize,
    /// The device, as in the records.
    pub device: String,
    /// Sizes of the network that the scene leaves open, as a run on this device chooses them.
    pub decisions: Vec<Decision>,
    /// True if a stop ended it early.
    pub interrupted: bool,
}

/// Trains the scene's surrogate on its first slide. `epoch` is called after each epoch, with a picture of the surrogate alone where one is due.
/// Setting `stop` ends the training after the epoch in progress.
///
/// # Errors
/// The source cannot be opened, a setting is refused, or the device fails.
pub fn train(
    settings: &Settings,
    options: &TrainOptions,
    device: &Device,
    threads: usize,
    epoch: &mut (dyn FnMut(&Epoch, Option<&Film>) + Send),
    stop: &AtomicBool,
) -> Result<TrainReport, RunError> {
    let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build()?;
    let slides = FirstSlides::read(settings, 1, stop)?;
    let opened = Opened::new(settings, device, &slides)?;
    let colours = colours_of(settings, Method::Reference, device, &slides)?;
    let mut settings = Settings { transfer: Some(colours), ..slides.settled(settings) };
    let mut decisions = Vec::new();
    if let Some(shape) = opened.shape().filter(|_| device.is_gpu()) {
        settings.network = suited_network(&settings.network, shape, &mut decisions);
        // A run draws labels without an end; here they are given.
        let most = 1 << (options.labels / LEAST_STEPS).max(SMALLEST_BATCH).ilog2();
        if settings.network.gpu_batch.is_some_and(|batch| batch > most) {
            settings.network.gpu_batch = Some(most);
            let why = format_args!("at least {LEAST_STEPS} steps an epoch of {} labels", options.labels);
            Decision::new("network.batch", most, why).enter(&mut decisions);
        }
    }
    let training = Training { settings: &settings, options, opened: &opened, stop };
    pool.install(|| match device {
        Device::Cpu { .. } => training.on(Cpu, decisions, epoch),
        #[cfg(feature = "cuda")]
        Device::Cuda(device) => training.on(Cuda::new(device), decisions, epoch),
    })
}

struct Training<'a> {
    settings: &'a Settings,
    options: &'a TrainOptions,
    opened: &'a Opened,
    stop: &'a AtomicBool,
}

impl Training<'_> {
    fn on<B: Backend>(
        &self,
        mut backend: B,
        mut decisions: Vec<Decision>,
        epoch: &mut (dyn FnMut(&Epoch, Option<&Film>) + Send),
    ) -> Result<TrainReport, RunError> {
        let Self { settings, options, opened, stop } = self;
        let (plan, slide) = (&opened.plan, &opened.slide);
        let tracer = backend.tracer(&slide.velocity, &plan.map, slide.time).map_err(failed)?;
        let extras = settings.network.label_extras();
        let began = Instant::now();
        // In parts, which tell how far they are; never stopped early.
        let never = AtomicBool::new(false);
        let in_parts = Interruptible::new(&tracer, &never);
        let labels =
            crate::backend::audit::trace(&in_parts, &Points::random(opened, options.labels, 6).unit, extras).map_err(failed)?.samples;
        let label_seconds = began.elapsed().as_secs_f64();
        let validation = crate::backend::audit::trace(&in_parts, &Points::random(opened, options.validation, 7).unit, Extras::default())
            .map_err(failed)?
            .samples;
        let request = SurrogateRequest {
            settings: &settings.surrogate,
            network: &settings.network,
            domain: &plan.domain,
            seed: settings.seed,
            replay_buffer: labels.len().max(1),
            stop,
        };
        let mut surrogate = backend.surrogate(&request, &tracer).map_err(failed)?;
        let buffer = ReplayBuffer::holding(&labels);
        let on_device = surrogate.trains_on_device();
        let mut network = settings.network.clone();
        if !on_device {
            cpu_batch(&mut network, &mut decisions);
        }
        let steps_per_epoch = (labels.len() / network.batch_on(on_device)).max(1) as u64;
        let (bytes, device) = (surrogate.bytes(), backend.name());
        let mut report = TrainReport { epochs: Vec::new(), label_seconds, bytes, device, decisions, interrupted: false };
        let (mut steps, mut seconds, mut rollbacks) = (0, 0.0, 0);
        for number in 1..=options.epochs {
            let learned = surrogate.learn(&buffer, f64::INFINITY, steps_per_epoch).map_err(failed)?;
            steps += learned.steps;
            seconds += learned.seconds;
            rollbacks += learned.rollbacks;
            let frozen = surrogate.freeze().map_err(failed)?;
            let (rms, psnr) = error(&frozen, &validation)?;
            let done = Epoch { epoch: number, steps, seconds, loss: learned.loss, rms, psnr, rollbacks };
            report.interrupted = stop.load(Ordering::Relaxed);
            let is_last = number == options.epochs || report.interrupted;
            let film =
                if is_last || options.pictures.contains(&number) { Some(self.picture(&mut backend, &tracer, &frozen)?) } else { None };
            epoch(&done, film.as_deref());
            report.epochs.push(done);
            if report.interrupted {
                break;
            }
        }
        Ok(report)
    }

    /// A picture in which the surrogate answers everything.
    fn picture<B: Backend>(
        &self,
        backend: &mut B,
        tracer: &B::Tracer,
        frozen: &crate::backend::FrozenOf<B>,
    ) -> Result<Arc<Film>, RunError> {
        let Self { settings, opened, stop, .. } = self;
        let domain = &opened.plan.domain;
        let scene = Scene::assemble(
            domain,
            settings.camera.clone(),
            settings.light.clone(),
            settings.transfer.clone(),
            settings.render.clone(),
            settings.seed,
        );
        let mut renderer = Renderer::new(scene, domain, opened.plan.map.tau)?;
        let gate = Gate::uniform(true);
        let job = FrameJob {
            tracer,
            surrogate: Some(frozen),
            routing: Routing { gate: &gate, trace_budget: None, keep: 0, extras: Extras::default() },
            picture: 0,
            samples: settings.render.samples.ceil().max(1.0),
            smooth: None,
            is_map: false,
            progress: None,
            stop,
        };
        let Rendered { film, .. } = backend.render(&job, &mut renderer, &mut B::Picture::default()).map_err(failed)?;
        Ok(film)
    }
}

/// Root mean square error of the log-stretch, and its PSNR.
fn error(surrogate: &dyn Predict, validation: &Samples) -> Result<(f64, Option<f64>), RunError> {
    let mut predicted = vec![0.0; validation.len()];
    surrogate.predict(&validation.points, &mut predicted).map_err(failed)?;
    let (mut square, mut peak) = (0.0, 0.0_f64);
    for (predicted, traced) in predicted.iter().zip(&validation.log_stretch) {
        square += f64::from(predicted - traced).powi(2);
        peak = peak.max(f64::from(*traced));
    }
    let rms = (square / validation.len().max(1) as f64).sqrt();
    Ok((rms, (rms > 0.0 && peak > 0.0).then(|| 20.0 * (peak / rms).log10())))
}
