//! One frame: rendered with frozen weights while the live ones train, held against what it traced, and recorded.

use super::{Cycle, Place, fixed_steps};
use crate::engine::answers::{Answers, Tally};
use crate::engine::audit::{AuditFindings, AuditRequest};
use crate::engine::checkpoints::Checkpoints;
use crate::engine::feed::{Feed, Slide};
use crate::engine::training::{Until, train};
use crate::engine::{EngineError, Event, Frame, FrameRecord, StageSeconds};
use crate::flow::{Tracer, VelocitySource};
use crate::render::{Film, Method, RenderStats};
use crate::surrogate::{Learned, Predict, SampleRing, Samples, Surrogate};
use crate::trust::{Gate, Strata};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

/// Lived share of the particles below which it is told.
const SHORT_LIVED: f64 = 0.75;

/// Number of the first warm-up picture, far beyond all others.
const WARMUP_PICTURES: u64 = 1 << 40;

/// Seconds of training after which the next window is looked for.
const MEANWHILE: f64 = 0.05;
/// Between two looks for it while a device rests.
const GLANCE: Duration = Duration::from_millis(2);

/// What the rendering threads hand back.
pub(super) struct Rendered {
    pub(super) film: Film,
    samples_per_pixel: usize,
    pub(super) stats: RenderStats,
    pub(super) tally: Tally,
    pub(super) samples: Samples,
    pub(super) audit: AuditFindings,
    pub(super) render_seconds: f64,
    pub(super) audit_seconds: f64,
}

impl Rendered {
    /// Seconds that the picture and its audit had the device: by its own clock where it rendered, otherwise by the wall's.
    fn turn(&self) -> f64 {
        let picture = if self.stats.device_seconds > 0.0 { self.stats.device_seconds } else { self.render_seconds };
        picture + self.audit_seconds
    }
}

enum Trainer<'scope, 'b> {
    Beside(std::thread::ScopedJoinHandle<'scope, Learned>),
    After(&'b mut Box<dyn Surrogate>, &'b SampleRing),
}

impl Cycle<'_> {
    pub(super) fn frame(
        &mut self,
        tracer: &dyn Tracer,
        slide: &mut Slide,
        place: Place,
        sink: &mut (dyn FnMut(Event) + Send),
    ) -> Result<Frame, EngineError> {
        let (stood_still, told) = std::mem::take(&mut self.stood_still);
        slide.warnings.extend(told);
        let start = Instant::now();
        self.learn_shorter(slide, tracer)?;
        let shorter_seconds = start.elapsed().as_secs_f64();
        let scene = &self.plan.scene;
        let gate = match scene.render.method {
            Method::Gated => self.trust.gate(),
            Method::Reference => Gate::uniform(false),
            Method::Surrogate => Gate::uniform(true),
        };
        // Frozen weights: what is rendered with has not seen this frame's samples.
        let front: Option<Arc<dyn Predict>> = self.live.as_ref().map(|live| live.freeze());
        let (work, learned) = self.picture(tracer, front.as_deref(), &gate, place, slide.live.is_some(), sink)?;
        let learned = match (self.learned_meanwhile.take(), learned) {
            (Some(before), Some(now)) => Some(before.and(now)),
            (before, now) => now.or(before),
        };
        let mut record = self.record(tracer, &work, slide);
        record.surrogate = front.as_ref().map(|s| s.name().to_owned());
        if work.audit.drawn > 0 && work.audit.points == 0 {
            record.warnings.push("no velocity anywhere: every audit point lies on missing cells".into());
        }
        let dying = record.audited > 0 && record.lived_share < SHORT_LIVED;
        if dying && !std::mem::replace(&mut self.told_of_deaths, true) {
            record.warnings.push(format!(
                "particles live {:.2} % of tau on average: the others meet land, leave the domain, or are too fast (an unknown fill value, another unit?), and their FTLE is that of the path so far",
                100.0 * record.lived_share
            ));
        }
        let auditing = Instant::now();
        if let Some(front) = front.as_deref() {
            self.assess(front, tracer, &gate, &work, &mut record);
        }
        let audit_seconds = shorter_seconds + work.audit_seconds + auditing.elapsed().as_secs_f64();
        let total = stood_still + start.elapsed().as_secs_f64();
        if let Some(front) = front.as_deref() {
            // The measurement's time, not the frame's.
            record.verified = self.verify(front, tracer, &gate);
        }
        self.options.device.check()?;
        if let Some(failure) = self.options.device.failure().filter(|_| !std::mem::replace(&mut self.told_of_failure, true)) {
            record.warnings.push(format!("work on the GPU has ended, the CPU goes on: {failure}"));
        }
        record.warnings.extend(self.options.device.shortages());
        let train_seconds = learned.as_ref().map_or(0.0, |l: &Learned| l.seconds);
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
        record.sample_ring = self.ring.len() as u64;
        record.checkpoint = self.checkpoints.as_mut().and_then(Checkpoints::look);
        if let Some(failed) = record.checkpoint.as_ref().and_then(|checkpoint| checkpoint.failed.as_ref()) {
            record.warnings.push(failed.clone());
        }
        record.seconds = StageSeconds {
            slide: place.preparing,
            waiting: std::mem::take(&mut slide.waited),
            render: work.render_seconds - work.tally.trace_seconds - work.tally.predict_seconds,
            trace: work.tally.trace_seconds,
            predict: work.tally.predict_seconds,
            audit: audit_seconds,
            train: train_seconds,
            device: work.stats.device_seconds,
            checkpoint: stood_still,
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
        self.frame += 1;
        self.pictures += u64::from(!place.warmup);
        Ok(Frame { record: Arc::new(record), film: Arc::new(work.film), tone_map: scene.render.tone_map })
    }

    /// Renders and draws the audit points, while other threads train; and what they learned. Training goes on after the picture for what is left
    /// of its seconds, but for a `live` run, whose frame goes out first (see [`Cycle::train_meanwhile`]).
    fn picture(
        &mut self,
        tracer: &dyn Tracer,
        front: Option<&dyn Predict>,
        gate: &Gate,
        place: Place,
        live: bool,
        sink: &mut (dyn FnMut(Event) + Send),
    ) -> Result<(Rendered, Option<Learned>), EngineError> {
        let scene = &self.plan.scene;
        let waits = !live || scene.training.steps_per_frame.is_some();
        let per_cell = scene.trust.audit_min_per_cell;
        let cells = self.trust.shape();
        let samples_per_pixel = scene.time.warmup_samples.filter(|_| place.warmup).unwrap_or(scene.render.samples);
        // Warm-up frames draw other random numbers than all others, so that the first frame after them is the same picture whatever
        // the warm-up was.
        let picture = if place.warmup { WARMUP_PICTURES + self.frame } else { self.pictures };
        let rendered = AtomicBool::new(false);
        self.threads.device_trains = self.live.as_ref().is_some_and(|live| live.is_offloaded());
        let (extras, keep) = (self.label_extras(), self.keep_a_frame());
        let samples = self.learns().then_some(extras);
        let (mut learned, mut work) = (None, None);
        {
            let (ring, live, threads) = (&mut self.ring, &mut self.live, &self.threads);
            let (renderer, trust, frame, seed, stop) = (&mut self.renderer, &self.trust, self.frame, scene.seed, self.stop);
            let frames = &mut self.frames;
            std::thread::scope(|scope| {
                let training = live.as_mut().filter(|l| l.learns() && !ring.is_empty()).map(|live| {
                    let (ring, rendered, settings) = (&*ring, &rendered, &scene.training);
                    match threads.beside() {
                        Some([beside, all]) => Trainer::Beside(scope.spawn(move || {
                            let learned = beside.install(|| train(&mut **live, ring, settings, Until::Rendered(rendered), stop));
                            let left = settings.seconds() - learned.seconds;
                            if settings.steps_per_frame.is_some() || left <= 0.0 || !waits {
                                return learned;
                            }
                            // The picture is done: its threads are free.
                            learned.and(all.install(|| train(&mut **live, ring, settings, Until::Seconds(left), stop)))
                        })),
                        None => Trainer::After(live, ring),
                    }
                });
                let mut render = || -> Result<Rendered, EngineError> {
                    let mut answers = Answers::new(tracer, front, gate, scene.trust.trace_budget, keep).with_extras(extras);
                    let progress = std::sync::Mutex::new(&mut *sink);
                    let report = |share: f32| {
                        if let Ok(mut sink) = progress.lock() {
                            (*sink)(Event::Progress(share));
                        }
                    };
                    let walk = Instant::now();
                    let (film, stats) = frames.render(
                        renderer,
                        picture,
                        samples_per_pixel,
                        tracer,
                        &mut answers,
                        Some(&report),
                        &AtomicBool::new(false),
                    )?;
                    let render_seconds = walk.elapsed().as_secs_f64();
                    let (tally, kept) = (answers.tally, answers.samples);
                    let auditing = Instant::now();
                    let strata = match front {
                        Some(_) => {
                            let wanted = (scene.trust.audit_share * tally.queries as f64).ceil() as usize;
                            trust.audit_strata(gate, per_cell.max(wanted.div_ceil(cells.iter().product())))
                        }
                        None => Strata::even(cells, 1),
                    };
                    let request = AuditRequest { strata, seed, stream: 2 * frame, transfer: renderer.transfer(), samples };
                    let audit = frames.audit(request, tracer, front)?;
                    Ok(Rendered {
                        film,
                        samples_per_pixel,
                        stats,
                        tally,
                        samples: kept,
                        audit,
                        render_seconds,
                        audit_seconds: auditing.elapsed().as_secs_f64(),
                    })
                };
                work = Some(threads.render().install(&mut render));
                rendered.store(true, Ordering::Release);
                learned = match training {
                    Some(Trainer::Beside(handle)) => Some(handle.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic))),
                    Some(Trainer::After(live, ring)) if waits => {
                        let settings = &scene.training;
                        let picture = work.as_ref().and_then(|work| work.as_ref().ok()).map_or(0.0, Rendered::turn);
                        let seconds = if threads.device_trains { settings.turn(picture) } else { settings.seconds() };
                        Some(threads.render().install(|| train(&mut **live, ring, settings, Until::Seconds(seconds), stop)))
                    }
                    Some(Trainer::After(..)) | None => None,
                };
            });
        }
        Ok((work.ok_or(EngineError::EndedEarly)??, learned))
    }

    /// What is left of a frame's training where a simulation is followed, after the frame has gone out: until the next window is there, but at
    /// least `training.share` of the `seconds` that the frame took, so that a fast simulation does not end all learning. A device trains for
    /// `training.share` of the time and no longer, since a solver may be on it.
    pub(super) fn train_meanwhile(&mut self, feed: &Feed, seconds: f64) {
        let settings = &self.plan.scene.training;
        let Feed::Live { window, .. } = feed else { return };
        let Some(live) = self.live.as_mut().filter(|live| live.learns() && !self.ring.is_empty()) else { return };
        if settings.steps_per_frame.is_some() {
            return;
        }
        let pool = self.threads.all();
        let (ring, stop, begin) = (&self.ring, self.stop, Instant::now());
        let (mut trained, mut empty) = (0.0, false);
        while trained < settings.seconds() && !stop.load(Ordering::Relaxed) {
            let mut slice = (settings.seconds() - trained).min(MEANWHILE);
            if live.is_offloaded() {
                match self.turns.due(self.began.elapsed().as_secs_f64()) {
                    Some(due) => slice = slice.min(due),
                    None if window.is_waited_for() => {
                        std::thread::sleep(GLANCE);
                        continue;
                    }
                    None => return,
                }
            } else if begin.elapsed().as_secs_f64() >= settings.share * seconds && !window.is_waited_for() {
                return;
            }
            let learned = pool.install(|| train(&mut **live, ring, settings, Until::Seconds(slice), stop));
            let before = std::mem::replace(&mut empty, learned.steps == 0);
            trained += learned.seconds;
            self.turns.took(learned.device_seconds.unwrap_or(learned.seconds));
            self.learned_meanwhile = Some(self.learned_meanwhile.take().unwrap_or_default().and(learned));
            // One turn may go into bringing over what there is to be learned from; after two there is nothing.
            if before && empty {
                return;
            }
        }
    }

    /// The figures that rendering alone decides.
    fn record(&mut self, tracer: &dyn Tracer, work: &Rendered, slide: &mut Slide) -> FrameRecord {
        FrameRecord {
            frame: self.frame,
            slide: slide.index,
            time: slide.time,
            date: slide.date.clone(),
            live: slide.live.clone(),
            tau: tracer.tau(),
            time_unit: self.plan.time_unit.clone(),
            source: self.plan.source.clone(),
            transfer: self.transfer,
            direction: self.plan.map.direction.name().into(),
            method: match self.plan.scene.render.method {
                Method::Reference => "reference".into(),
                Method::Surrogate => "surrogate".into(),
                Method::Gated => "gated".into(),
            },
            device: self.options.device.name(),
            size: [work.film.width, work.film.height],
            samples_per_pixel: work.samples_per_pixel,
            queries: work.tally.queries,
            traced: work.tally.traced,
            missing: work.tally.missing,
            over_budget: work.tally.over_budget,
            traced_share: work.tally.traced as f64 / (work.tally.queries - work.tally.missing).max(1) as f64,
            integration_steps: fixed_steps(tracer).map(|steps| steps as u64),
            integration_difference: self.report.integration_difference,
            probed: std::mem::take(&mut self.probed),
            audited: work.audit.points as u64,
            lived_share: work.audit.lived_share,
            majorant_exceeded: work.stats.majorant_exceeded,
            traced_ahead: work.stats.speculative_queries,
            warnings: std::mem::take(&mut slide.warnings),
            ..FrameRecord::default()
        }
    }
}
