//! One frame: rendering with frozen weights while the live ones train, comparison with the traced samples, and the record.

use super::assess::{Work, assess};
use super::budget::FrameCost;
use super::checkpoints::Checkpoints;
use super::decision::cpu_batch;
use super::doubts::short_lived;
use super::record::{DomainRecord, Frame};
use super::report::{Event, Sink};
use super::setup::Plan;
use super::slides::{Slide, Slides};
use super::state::{FramePlace, Learning, Run};
use super::steps::fixed_steps;
use super::stop::{RunEnd, check_stop};
use super::training::{Until, train};
use super::transaction::{On, present};
use super::{FrameRecord, StageSeconds, TrustedError};
use crate::backend::{
    AuditFindings, AuditRequest, Backend, DeviceError, FrameJob, FrameSamples, FrozenOf, Rendered, Routing, Smooth, StartsAnew, Surrogate,
};
use crate::field::Domain;
use crate::flow::VelocitySource;
use crate::progress::{self, Work as InProgress};
use crate::render::smooth::AUDIT_PAIRS;
use crate::render::{Combine, Method};
use crate::surrogate::{Learned, Predict, Trace};
use crate::trust::{Gate, Strata};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

/// Picture number of the first warm-up frame, larger than all other picture numbers.
const WARMUP_PICTURES: u64 = 1 << 40;

/// Seconds of training between two checks for the next window.
const TURN: f64 = 0.05;
/// Interval between such checks while the device is idle.
const GLANCE: Duration = Duration::from_millis(2);

/// Inputs of rendering and audit besides the session.
struct Picture<'a> {
    gate: &'a Gate,
    place: FramePlace,
    is_live: bool,
    /// How much training is needed; `None` if the surrogate does not learn, or as long as is given.
    need: Option<f64>,
}

/// The latest audit of a smooth picture above a surrogate that does not learn. It holds for the frames behind it.
pub(super) struct LastAudit {
    trusted: Option<TrustedError>,
    tolerance_excess: Option<f64>,
    surrogate_psnr: Option<f64>,
    mean_lifetime_share: f64,
    /// Queries of the frames since.
    queries: u64,
}

impl Run<'_> {
    /// Makes one frame, whose preparation began at `start`. Its results take effect only when all of it is computed.
    pub(super) fn frame<B: Backend>(
        &mut self,
        on: &mut On<B>,
        slide: &Slide,
        place: FramePlace,
        start: Instant,
        sink: &mut Sink<'_>,
    ) -> Result<Frame, RunEnd> {
        let preparation_seconds = start.elapsed().as_secs_f64();
        let scene = &self.plan.scene;
        let method = self.render.method;
        let gate = self.gate(method);
        // The frame is rendered with frozen weights, which were not trained on its samples.
        let serves = on.surrogate.as_ref().filter(|_| method.has_surrogate());
        let frozen = serves.map(Surrogate::freeze).transpose()?;
        let renderer = self.renderer.clone();
        let need = self.training_need(on);
        let picture = Picture { gate: &gate, place, is_live: slide.live.is_some(), need };
        let computed = self.picture(on, frozen.as_ref(), &picture, sink).and_then(|work| {
            let assessing = Instant::now();
            let assessment = match &frozen {
                Some(frozen) => assess(self, frozen, on.tracer(), &gate, &work)?,
                None => None,
            };
            let seconds = assessing.elapsed().as_secs_f64();
            let total = self.progress.checkpoint_pause + start.elapsed().as_secs_f64();
            let verified = match &frozen {
                // Not part of the frame's time.
                Some(frozen) => self.verify(frozen, on.tracer(), &gate)?,
                None => None,
            };
            Ok((work, assessment, seconds, total, verified))
        });
        let (work, assessment, assess_seconds, total, verified) = match computed {
            Ok(computed) => computed,
            Err(error) => {
                // A repetition of the frame starts with the same majorants.
                self.renderer = renderer;
                return Err(error);
            }
        };
        // The steps below cannot fail.
        let mut record = self.record(on, slide, &work);
        record.surrogate = frozen.as_ref().map(|frozen| frozen.name().to_owned());
        record.verified_error = verified;
        record.picture_error = work.rendered.error;
        if method.is_smooth() {
            let Rendered { stats, tally, .. } = &work.rendered;
            let cost = FrameCost::new(work.render_seconds, work.samples_per_pixel, stats, tally);
            self.progress.cost = Some(cost.after(self.progress.cost));
        }
        let samples = work.rendered.samples.commit();
        if let Some(assessment) = assessment {
            self.take_in(on, assessment, &work.audit, samples, &mut record);
        }
        let stays = method.is_smooth() && frozen.is_some() && !on.surrogate.as_ref().is_some_and(Surrogate::learns);
        self.hold_audit(work.audit.drawn > 0, stays, work.rendered.tally.queries, &mut record);
        if frozen.is_some() {
            record.trusted_volume = gate.share();
        }
        let learned = self.learning.unreported_since_last_frame();
        let train_seconds = learned.as_ref().map_or(0.0, |learned| learned.seconds);
        if let Some(learned) = &learned {
            self.report.train_steps += learned.steps;
            record.warnings.extend_from_slice(&learned.warnings);
            if learned.rollbacks > 0 {
                record
                    .warnings
                    .push(format!("training diverged {} time(s): rolled back to the last good weights at a lower rate", learned.rollbacks));
            }
        }
        record.training = learned;
        record.training_need = need;
        record.replay_samples = self.learning.buffer.len() as u64;
        record.checkpoint = self.checkpoints.as_mut().and_then(Checkpoints::look);
        if let Some(failed) = record.checkpoint.as_ref().and_then(|checkpoint| checkpoint.failed.as_ref()) {
            record.warnings.push(failed.clone());
        }
        let (tally, stats) = (&work.rendered.tally, &work.rendered.stats);
        record.seconds = StageSeconds {
            slide: place.preparing,
            race: std::mem::take(&mut self.progress.raced),
            waiting: slide.waited,
            refine: place.refining,
            render: work.render_seconds - tally.trace_seconds - tally.predict_seconds,
            trace: tally.trace_seconds,
            predict: tally.predict_seconds,
            audit: preparation_seconds - place.refining + work.audit_seconds + assess_seconds,
            train: train_seconds,
            device: stats.device_seconds,
            checkpoint: std::mem::take(&mut self.progress.checkpoint_pause),
            total,
            elapsed: self.began.elapsed().as_secs_f64(),
        };
        if let VelocitySource::Window(window) = &slide.velocity {
            self.report.window_bytes = self.report.window_bytes.max(window.bytes());
        }
        self.report.frames += 1;
        self.report.waited += record.seconds.waiting;
        self.report.worked += record.seconds.slide + record.seconds.total;
        self.report.slides = slide.index + 1;
        self.progress.frame += 1;
        self.progress.pictures += u64::from(!place.is_warmup);
        Ok(Frame {
            record: Arc::new(record),
            film: work.rendered.film,
            tone_map: scene.render.tone_map_of(method),
            color_bar: Some(Arc::clone(&self.color_bar)),
            gate: frozen.is_some().then(|| Arc::new(gate)),
        })
    }

    /// Keeps what an audit found, as long as it `stays` so, and enters it in the records of the frames that have none.
    fn hold_audit(&mut self, is_audited: bool, stays: bool, queries: u64, record: &mut FrameRecord) {
        let last = &mut self.progress.last_audit;
        if is_audited {
            *last = stays.then_some(LastAudit {
                trusted: record.trusted_error,
                tolerance_excess: record.tolerance_excess,
                surrogate_psnr: record.surrogate_psnr,
                mean_lifetime_share: record.mean_lifetime_share,
                queries: 0,
            });
        } else if let Some(last) = last {
            last.queries += queries;
            (record.trusted_error, record.tolerance_excess) = (last.trusted, last.tolerance_excess);
            (record.surrogate_psnr, record.mean_lifetime_share) = (last.surrogate_psnr, last.mean_lifetime_share);
        }
    }

    /// Which queries the surrogate answers.
    pub(super) fn gate(&self, method: Method) -> Gate {
        match method {
            Method::Gated | Method::Marched | Method::TwoLevel | Method::Auto | Method::Default => self.learning.trust.gate(),
            Method::Reference | Method::Map => Gate::uniform(false),
            Method::Surrogate => Gate::uniform(true),
        }
    }

    /// Factor on the time of training. `None` if the surrogate does not learn, or if the scene gives the time.
    fn training_need<B: Backend>(&self, on: &On<B>) -> Option<f64> {
        let learns = |surrogate: &&B::Surrogate| self.render.method.has_surrogate() && surrogate.learns();
        let surrogate = on.surrogate.as_ref().filter(learns)?;
        let is_constant = self.plan.scene.training.is_constant(surrogate.trains_on_device());
        (!is_constant).then(|| self.learning.need.factor())
    }

    /// Settings of a frame of so many samples a pixel whose picture accumulates; `None` for other methods.
    pub(super) fn smooth<B: Backend>(
        &self,
        backend: &B,
        surrogate: Option<&B::Surrogate>,
        method: Method,
        samples_per_pixel: f64,
    ) -> Result<Option<Smooth>, DeviceError> {
        if !method.is_smooth() {
            return Ok(None);
        }
        let learns = surrogate.is_some_and(Surrogate::learns);
        let table_nodes = surrogate.and_then(Surrogate::table_nodes);
        let nodes = match table_nodes.filter(|_| !learns) {
            Some(nodes) => nodes,
            None => {
                let set = self.learning.settings.nodes(&self.plan.domain);
                set.map_err(|refused| DeviceError::Unsupported { what: refused.to_string() })?
            }
        };
        // As many as take as long as the samples.
        let a_sample = backend.nodes_per_sample()[1] * self.render.width * self.render.height;
        let samples = if method == Method::Marched { 1.0 } else { samples_per_pixel };
        let traced_nodes = if gate_decides(method, surrogate) { (a_sample as f64 * samples) as usize } else { 0 };
        let budget = self.render.budget.map(|milliseconds| 1e-3 * milliseconds);
        Ok(Some(Smooth {
            method,
            sum: self.plan.scene.render.combine == Combine::Sum,
            nodes,
            traced_nodes,
            budget,
            steps_error: self.steps_error,
        }))
    }

    /// Renders and audits while other threads train. After the picture, training continues for the rest of its seconds. In a live run the frame
    /// goes out first (see [`Run::train_meanwhile`]).
    fn picture<B: Backend>(
        &mut self,
        on: &mut On<B>,
        frozen: Option<&FrozenOf<B>>,
        picture: &Picture<'_>,
        sink: &mut Sink<'_>,
    ) -> Result<Work<B::Samples>, RunEnd> {
        let device_trains = on.surrogate.as_ref().is_some_and(Surrogate::trains_on_device);
        let factor = picture.need.unwrap_or(1.0);
        // Threads that would idle for most of the picture render it.
        self.threads.take_turns = device_trains || factor < 1.0;
        let method = self.render.method;
        let (serves, is_smooth) = (method.has_surrogate(), method.is_smooth());
        let learns = serves && on.surrogate.as_ref().is_some_and(Surrogate::learns);
        if learns && !device_trains {
            self.progress.warnings.extend(cpu_batch(&mut self.learning.network, &mut self.report.decisions));
        }
        // A smooth picture measures its own error, so that labels of a table have no use.
        let needs_labels = serves && (learns || !is_smooth);
        let (extras, keep) = (self.label_extras(), if needs_labels { self.labels_per_frame(on) } else { 0 });
        let On { backend, tracer, surrogate, picture: accumulated } = on;
        // A picture shows the surrogate as it was when the picture started. It starts anew whenever the training has doubled.
        let steps = self.report.train_steps + self.learning.unreported.steps;
        if is_smooth && learns && steps >= 2 * self.progress.steps_shown.max(1) {
            accumulated.start_anew();
            self.progress.steps_shown = steps;
        }
        let tracer = present(tracer);
        let scene = &self.plan.scene;
        let settings = &scene.training;
        let waits = !picture.is_live || settings.steps_per_frame.is_some();
        // Warm-up frames use separate random numbers, so that the first frame after them does not depend on their number.
        let number = if picture.place.is_warmup { WARMUP_PICTURES + self.progress.frame } else { self.progress.pictures };
        let samples_per_pixel = match scene.time.warmup_samples.filter(|_| picture.place.is_warmup) {
            // Its samples only measure the error.
            _ if method == Method::Marched => 2.0 * AUDIT_PAIRS,
            Some(samples) => samples as f64,
            None => self.progress.affordable_samples(&self.render, &picture.place),
        };
        // A first frame that is drawn soon gets the nodes of the others.
        let nodes_for = picture.place.soon.map_or(samples_per_pixel, |_| self.render.samples);
        let smooth = self.smooth(backend, surrogate.as_ref(), method, nodes_for)?;
        let routing = Routing { gate: picture.gate, trace_budget: scene.trust.trace_budget, keep, extras };
        let rendered = AtomicBool::new(false);
        let (buffer, trust, threads) = (&self.learning.buffer, &self.learning.trust, &self.threads);
        // A surrogate that does not learn stays as it was audited until the queries warrant another audit.
        let since_audit = self.progress.last_audit.as_ref().filter(|_| is_smooth && serves && !learns).map(|last| last.queries);
        let need = &mut self.learning.need;
        let (renderer, frame, stop, abandon) = (&mut self.renderer, self.progress.frame, self.stop, &*self.options.abandon);
        // Before training begins beside it.
        let mut drawing = Some(InProgress::begin("rendering the frame"));
        let mut render = || -> Result<Work<B::Samples>, DeviceError> {
            let (progress, drawing) = (Mutex::new(&mut *sink), drawing.take());
            let report = |share: f32| {
                drawing.iter().for_each(|drawing| drawing.reached_share(f64::from(share)));
                if let Ok(mut sink) = progress.lock() {
                    (*sink)(Event::Progress(share));
                }
            };
            let begin = Instant::now();
            let job = FrameJob {
                tracer,
                surrogate: frozen,
                routing,
                picture: number,
                samples: samples_per_pixel,
                smooth,
                is_map: method == Method::Map,
                progress: Some(&report),
                stop: abandon,
            };
            let rendered = backend.render(&job, renderer, accumulated)?;
            let render_seconds = begin.elapsed().as_secs_f64();
            drop(drawing);
            let (auditing, _audit) = (Instant::now(), InProgress::begin("measuring the error of the frame"));
            let (cells, least) = (trust.shape(), scene.trust.audit_min_per_cell);
            let wanted = |queries: u64| (scene.trust.audit_share * queries as f64).ceil() as usize;
            let queries = rendered.tally.queries;
            if since_audit.is_some_and(|before| wanted(before + queries) < least * cells.iter().product::<usize>()) {
                let audit = AuditFindings::none();
                return Ok(Work { rendered, audit, samples_per_pixel, render_seconds, audit_seconds: 0.0 });
            }
            let strata = match frozen {
                Some(_) => trust.audit_strata(picture.gate, least.max(wanted(queries).div_ceil(cells.iter().product()))),
                None => Strata::even(cells, 1),
            };
            let (seed, transfer, samples) = (scene.seed, renderer.transfer(), learns.then_some(extras));
            let request = AuditRequest { strata, seed, stream: 2 * frame, transfer, samples, stop: abandon };
            let audit = backend.audit(&request, tracer, frozen)?;
            Ok(Work { rendered, audit, samples_per_pixel, render_seconds, audit_seconds: auditing.elapsed().as_secs_f64() })
        };
        let (mut learned, mut refused) = (Learned::default(), None);
        let (work, trained) = match (surrogate.as_mut().filter(|_| learns && !buffer.is_empty()), threads.beside()) {
            (Some(surrogate), Some([beside, all])) => std::thread::scope(|scope| {
                let (rendered, learned) = (&rendered, &mut learned);
                let training = std::thread::Builder::new().spawn_scoped(scope, move || {
                    let mut learn = |seconds, steps| surrogate.learn(buffer, seconds, steps);
                    beside.install(|| train(&mut learn, settings, Until::Rendered(rendered), stop, learned, need))?;
                    let left = settings.seconds(factor) - learned.seconds;
                    if settings.steps_per_frame.is_some() || left <= 0.0 || !waits {
                        return Ok(());
                    }
                    // The picture is complete and its threads are idle.
                    all.install(|| train(&mut learn, settings, Until::Seconds(left), stop, learned, need))
                });
                let work = threads.render().install(&mut render);
                rendered.store(true, Ordering::Release);
                let trained = match training {
                    Ok(training) => training.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic)),
                    Err(error) => {
                        refused = Some(error);
                        Ok(())
                    }
                };
                (work, trained)
            }),
            (Some(surrogate), None) => {
                let work = threads.render().install(&mut render);
                let mut trained = Ok(());
                if let (true, Ok(work)) = (waits, &work) {
                    let due = if device_trains { settings.turn(work.device_share(), factor) } else { settings.seconds(factor) };
                    let turn = need.turn(due).max(settings.seconds_per_frame.unwrap_or(0.0));
                    if turn > 0.0 || settings.steps_per_frame.is_some() {
                        let learn = |seconds, steps| surrogate.learn(buffer, seconds, steps);
                        trained = threads.render().install(|| train(learn, settings, Until::Seconds(turn), stop, &mut learned, need));
                        need.took(learned.device_seconds.unwrap_or(learned.seconds), learned.steps);
                    }
                }
                (work, trained)
            }
            (None, _) => (threads.render().install(&mut render), Ok(())),
        };
        if let Some(error) = refused {
            self.progress.warnings.push(format!("nothing was trained beside this frame: cannot start a thread: {error}"));
        }
        // Reported even if the frame fails, since the weights have changed.
        self.learning.report(learned);
        // An abandoned frame, whose picture or audit may lack parts, is dropped with its samples.
        check_stop(abandon)?;
        trained?;
        Ok(work?)
    }

    /// Trains in a live run after the frame has gone out, until the next window is complete. The CPU trains for at least `training.share` of the
    /// `seconds` that the frame took, so that a fast simulation does not prevent training. A device trains for at most `training.share` of the
    /// time, since a solver may use it too. Both are less while the loss has stalled.
    pub(super) fn train_meanwhile<B: Backend>(&mut self, on: &mut On<B>, slides: &dyn Slides, seconds: f64) -> Result<(), RunEnd> {
        let (settings, factor) = (&self.plan.scene.training, self.training_need(on).unwrap_or(1.0));
        let (Some(_), None) = (slides.is_awaited(), settings.steps_per_frame) else { return Ok(()) };
        let is_awaited = || slides.is_awaited() == Some(true);
        let serves = self.render.method.has_surrogate();
        let Some(surrogate) = on.surrogate.as_mut().filter(|surrogate| serves && surrogate.learns() && !self.learning.buffer.is_empty())
        else {
            return Ok(());
        };
        let (begin, _work) = (Instant::now(), InProgress::begin("training until the next window is complete"));
        let (mut trained, mut was_idle) = (0.0, false);
        while trained < settings.seconds(factor)
            && !slides.is_lost()
            && !self.stop.load(Ordering::Relaxed)
            && !self.is_commanded_within(Duration::ZERO)
        {
            let mut slice = (settings.seconds(factor) - trained).min(TURN);
            if surrogate.trains_on_device() {
                match self.learning.budget.due(self.began.elapsed().as_secs_f64(), factor) {
                    Some(due) => slice = slice.min(due),
                    None if is_awaited() => {
                        progress::mark();
                        std::thread::sleep(GLANCE);
                        continue;
                    }
                    None => break,
                }
            } else if begin.elapsed().as_secs_f64() >= factor * settings.share * seconds && !is_awaited() {
                break;
            }
            let (mut learned, stop) = (Learned::default(), self.stop);
            let Learning { buffer, need, .. } = &mut self.learning;
            let learn = |seconds, steps| surrogate.learn(buffer, seconds, steps);
            let result = self.threads.all().install(|| train(learn, settings, Until::Seconds(slice), stop, &mut learned, need));
            trained += learned.seconds;
            self.learning.budget.took(learned.device_seconds.unwrap_or(learned.seconds));
            let is_idle = learned.steps == 0;
            self.learning.report(learned);
            result?;
            // A turn may only upload samples; after two turns without a step there is nothing to learn.
            if was_idle && is_idle {
                break;
            }
            was_idle = is_idle;
        }
        Ok(())
    }

    /// Record with the values that follow from rendering.
    fn record<B: Backend>(&mut self, on: &On<B>, slide: &Slide, work: &Work<B::Samples>) -> FrameRecord {
        let (flow, tally, film) = (on.tracer().flow(), &work.rendered.tally, &work.rendered.film);
        let mut warnings = slide.warnings.clone();
        warnings.append(&mut self.progress.warnings);
        if work.audit.drawn > 0 && work.audit.points == 0 {
            warnings.push("no velocity anywhere: every audit point lies on missing cells".into());
        }
        if let Some(warning) = short_lived(work.audit.mean_lifetime_share).filter(|_| work.audit.points > 0)
            && !std::mem::replace(&mut self.progress.has_warned_of_deaths, true)
        {
            warnings.push(warning);
        }
        FrameRecord {
            frame: self.progress.frame,
            slide: slide.index,
            time: slide.time,
            date: slide.date.clone(),
            live: slide.live.clone(),
            tau: flow.tau(),
            time_unit: self.plan.time_unit.clone(),
            source: self.plan.source.clone(),
            transfer: self.transfer,
            albedo: self.steered_albedo(),
            direction: self.asked.direction.name().into(),
            method: self.render.method.name().into(),
            device: on.backend.name(),
            size: [film.width, film.height],
            samples_per_pixel: work.samples_per_pixel,
            queries: tally.queries,
            traced: tally.traced,
            missing: tally.missing,
            over_budget: tally.over_budget,
            untraced_share: tally.untraced_share,
            tolerance: self.learning.trust.tolerance(),
            camera: Some(self.renderer.scene().camera.clone()),
            scale: self.renderer.scene().scale,
            projection: self.renderer.scene().plane.filter(|_| self.render.method == Method::Map),
            domain: Some(domain_record(self.plan, slide)),
            commands: std::mem::take(&mut self.progress.commands),
            traced_share: tally.traced as f64 / (tally.queries - tally.missing).max(1) as f64,
            integration_steps: fixed_steps(flow).map(|steps| steps as u64),
            integration_difference: self.report.integration_difference,
            precision_difference: self.report.precision_difference,
            tangent_difference: self.report.tangent_difference,
            integration_residual: self.report.integration_residual,
            preparation_traces: std::mem::take(&mut self.progress.preparation_traces) + tally.nodes,
            audited: work.audit.points as u64,
            mean_lifetime_share: work.audit.mean_lifetime_share,
            majorant_exceeded: work.rendered.stats.majorant_exceeded,
            speculative_traces: work.rendered.stats.speculative_queries,
            warnings,
            ..FrameRecord::default()
        }
    }
}

/// True if the gate decides what is traced: queries of `gated`, and nodes on which a smooth picture lays out a network. A surrogate with a
/// table is as good as that where it is not trusted.
pub(super) fn gate_decides<S: Surrogate>(method: Method, surrogate: Option<&S>) -> bool {
    let is_network = surrogate.is_some_and(|surrogate| surrogate.learns() && surrogate.table_nodes().is_none());
    method == Method::Gated || method.is_smooth() && is_network
}

/// Box of the seeds, with the axes of the data.
fn domain_record(plan: &Plan, slide: &Slide) -> DomainRecord {
    let Domain { min, max, dimensions, .. } = plan.domain;
    let axis = |k: usize| match &slide.velocity {
        VelocitySource::Window(window) => {
            window.grid().and_then(|grid| grid.axes.get(k)).map(|a| [a.name().to_owned(), a.units().to_owned()])
        }
        VelocitySource::Analytic(..) => None,
    };
    let axes = (0..dimensions).map(|k| axis(k).unwrap_or_else(|| [["x", "y", "z"][k].to_owned(), String::new()]));
    DomainRecord { min, max, axes: axes.collect() }
}
