//! Runge-Kutta steps of a smooth picture: as few as its colours do not tell from more.

use super::cycle::Cycle;
use super::decision::{Decision, why_steps};
use super::setup::Plan;
use super::slides::Slide;
use super::state::Run;
use super::stop::{RunEnd, check_stop};
use super::transaction::{transaction, with};
use crate::backend::{Backend, stratified_points};
use crate::field::DomainPoint;
use crate::flow::{Extras, FlowError, FlowMap, Precision, StepChoice, Steps, StepsSetting, Traced, Tracer, cpu_tracer};
use crate::progress::{self, Work};
use crate::render::smooth::StepsError;
use crate::render::{RayPoints, Renderer, Target};
use crate::trust::Strata;
use std::ops::RangeInclusive;
use std::sync::atomic::AtomicBool;
use std::time::Instant;

/// Largest optical residual of the steps, as a part of `trust.tolerance`, in flows of three dimensions, whose errors average along a ray: pictures of
/// turbulence differ by 57 dB then (`docs/accuracy.md`).
const SHARE: f64 = 2.0 / 3.0;
/// The same in two dimensions, where a ray sees one value: a residual of 0.007 left a picture 40 dB.
const FLAT_SHARE: f64 = 1.0 / 15.0;
/// Largest root mean square difference in the tone-mapped picture from that of the steps that the log-stretch asks for, as a part of `trust.tolerance` (46 dB
/// by default), and its largest share of the mean square of a target (10 dB below it). Residuals of one sign, as where paths end at a coast or an edge, do not
/// average along a ray.
const PICTURE: f64 = 1.0 / 6.0;
const TARGET_SHARE: f64 = 0.1;
/// Pixels by which pictures are compared at first, and most if these do not tell; points of each of the two nets of a pixel.
const PIXELS: usize = 512;
const MOST_PIXELS: usize = 4 * PIXELS;
const PER_NET: usize = 12;
/// Points that are traced at once, after which a stop is looked for.
const AT_ONCE: usize = 1 << 12;
/// Smallest share of the points on which something is to be seen.
const MIN_SHOWN: f64 = 1.0 / 32.0;
/// The residual at which steps are chosen again on a later slide, in units of the largest one of a choice: at more, pictures suffer, and at less,
/// half the steps would do (the error of RK4 falls with their fourth power). The margins keep noise from choosing anew.
const AGAIN: RangeInclusive<f64> = 0.01..=1.5;
/// Random stream of the points on which steps are compared.
const STREAM: u64 = u64::MAX - 1;

/// What a picture shows of a flow.
#[derive(Clone, Copy)]
pub(super) struct Shown<'a> {
    pub(super) plan: &'a Plan,
    /// The flow map as it is asked for.
    pub(super) map: &'a FlowMap,
    pub(super) renderer: &'a Renderer,
    /// Allowed optical residual of the picture.
    pub(super) tolerance: f64,
    pub(super) stop: &'a AtomicBool,
}

impl Shown<'_> {
    /// The largest optical residual of the steps.
    pub(super) fn most(&self) -> f64 {
        self.tolerance * if self.plan.domain.dimensions == 3 { SHARE } else { FLAT_SHARE }
    }

    /// Whether steps that leave this error in the picture are few enough; `None`: its standard error leaves that open.
    fn suits(&self, picture: &StepsError) -> Option<bool> {
        let [relative, toned] = [1, 2].map(|w| [picture.squared[w] - picture.deviation[w], picture.squared[w] + picture.deviation[w]]);
        let of_target = match self.plan.scene.render.until {
            Some(Target::Psnr(decibels)) => Some((toned, TARGET_SHARE * 10f64.powf(-0.1 * decibels))),
            Some(Target::Relmse(most)) => Some((relative, TARGET_SHARE * most)),
            None => None,
        };
        let of_tolerance = (toned, (PICTURE * self.tolerance).powi(2));
        let all = || of_target.into_iter().chain([of_tolerance]);
        match (all().any(|([low, _], most)| low > most), all().all(|([_, high], most)| high <= most)) {
            (true, _) => Some(false),
            (_, true) => Some(true),
            _ => None,
        }
    }

    /// In double precision, as the steps of the log-stretch are chosen.
    fn tracer(&self, slide: &Slide, steps: usize) -> Result<Box<dyn Tracer>, FlowError> {
        let map = FlowMap { steps: Steps::Fixed(steps), precision: Precision::F64, ..self.map.clone() };
        cpu_tracer(slide.velocity.clone(), &map, slide.time)
    }

    fn ramp(&self, log_stretch: f32) -> f64 {
        f64::from(self.renderer.transfer().ramp(log_stretch / self.map.tau as f32))
    }
}

/// A number of steps, and how far it is from twice as many as the log-stretch asks for. Root mean squares over points of the domain.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(super) struct PictureSteps {
    pub(super) steps: usize,
    /// Difference of the log-stretch.
    pub(super) difference: f64,
    /// Optical residual: difference of the ramp of the transfer function.
    pub(super) residual: f64,
    /// How far the picture is from that of the steps that the log-stretch asks for; 0: these are the steps, or it was not measured.
    pub(super) picture: StepsError,
    /// Fewer steps had colours that suit, but showed in the picture.
    pub(super) by_picture: bool,
}

impl PictureSteps {
    /// The error in a picture whose points have another optical residual: its square goes with that of the points, until it is measured.
    fn scaled_to(&self, residual: f64) -> StepsError {
        let share = if self.residual > 0.0 { (residual / self.residual).powi(2) } else { 1.0 };
        let StepsError { squared, deviation } = self.picture;
        StepsError { squared: squared.map(|of| share * of), deviation: deviation.map(|of| share * of) }
    }
}

/// Returns the first number of steps, each at most 1.25 times the one before or one snapshot interval more, whose optical residual is at most
/// [`SHARE`] or [`FLAT_SHARE`] of the tolerance and whose error in the picture is small enough; or those `chosen` for the log-stretch if it has none below
/// them, if these are not within their own tolerance, or if too few points show anything to judge by (and there is no comparison).
///
/// # Errors
/// As for [`cpu_tracer`], or a stop is requested.
pub(super) fn picture_steps(shown: Shown<'_>, slide: &Slide, chosen: StepChoice) -> Result<(PictureSteps, Option<Comparison>), RunEnd> {
    let cells = if shown.plan.domain.dimensions == 3 { [16, 16, 8] } else { [64, 32, 1] };
    let work = Work::begin("choosing the steps of the picture");
    let Some(mut comparison) = Comparison::new(shown, slide, cells, 0, 2 * chosen.steps)? else {
        return Ok((PictureSteps { steps: chosen.steps, difference: chosen.difference, residual: 0.0, ..PictureSteps::default() }, None));
    };
    let mut by_picture = false;
    let mut multiple = if chosen.within_tolerance { 1 } else { chosen.steps / chosen.multiple_of };
    while multiple * chosen.multiple_of < chosen.steps {
        // Where it ends is not known.
        work.stands(format!("{} of at most {} a path", multiple * chosen.multiple_of, chosen.steps));
        let mut found = comparison.of(shown, slide, multiple * chosen.multiple_of)?;
        comparison.of_steps = found.residual;
        if found.residual <= shown.most() {
            let (picture, suits) = comparison.in_picture(shown, slide, [found.steps, chosen.steps])?;
            if suits {
                (found.picture, found.by_picture) = (picture, by_picture);
                return Ok((found, Some(comparison)));
            }
            by_picture = true;
        }
        multiple = (multiple + 1).max(multiple * 5 / 4);
    }
    let found = PictureSteps { by_picture, ..comparison.of(shown, slide, chosen.steps)? };
    comparison.of_steps = found.residual;
    Ok((found, Some(comparison)))
}

/// Whether steps that were `settled` for an earlier slide suit the picture of this one no more: its flow, its colours or its tolerance may be others.
/// `chosen` was the choice for the log-stretch. No comparison: too few points show anything to judge by.
///
/// # Errors
/// As for [`picture_steps`].
pub(super) fn is_outdated(
    shown: Shown<'_>,
    slide: &Slide,
    chosen: StepChoice,
    settled: PictureSteps,
) -> Result<(bool, Option<Comparison>), RunEnd> {
    // A quarter of the points of a choice, and others on each slide.
    let cells = if shown.plan.domain.dimensions == 3 { [8, 8, 8] } else { [32, 16, 1] };
    let _work = Work::begin("comparing the steps of the picture with more");
    let Some(mut comparison) = Comparison::new(shown, slide, cells, slide.index, 2 * chosen.steps)? else { return Ok((false, None)) };
    // Where the choice had no more steps to give, their residual may be larger.
    let most = if settled.steps < chosen.steps { shown.most() } else { shown.most().max(settled.residual) };
    comparison.of_steps = comparison.of(shown, slide, settled.steps)?.residual;
    let shows = settled.steps < chosen.steps && shown.suits(&settled.scaled_to(comparison.of_steps)) == Some(false);
    let is_too_much = comparison.of_steps > *AGAIN.end() * most || shows;
    // Outside its tolerance a choice has no fewer steps to give either.
    let is_least = settled.steps <= chosen.multiple_of || !chosen.within_tolerance;
    // What the picture decided is compared with itself.
    let usual = if settled.by_picture { settled.residual } else { most };
    Ok((is_too_much || comparison.of_steps < *AGAIN.start() * usual && !is_least, Some(comparison)))
}

/// Whether the scene leaves the number of steps to the picture.
pub(super) fn suit_the_picture(plan: &Plan) -> bool {
    let scene = &plan.scene;
    scene.flow.steps == StepsSetting::Auto && scene.flow.tolerance.is_none() && scene.render.method.is_smooth()
}

/// Points of a slide, and their log-stretch with many steps in double precision.
pub(super) struct Comparison {
    pub(super) points: Vec<DomainPoint>,
    truth: Traced,
    /// Rays of the picture, once pictures are compared.
    rays: Option<Rays>,
    /// Optical residual of the steps that the picture takes, in double precision too.
    pub(super) of_steps: f64,
}

/// Rays through so many pixels: points on them, and their log-stretch with the steps that it asks for.
struct Rays {
    pixels: usize,
    points: RayPoints,
    truth: Vec<f32>,
}

impl Rays {
    fn new(shown: Shown<'_>, slide: &Slide, pixels: usize, steps: usize) -> Result<Self, RunEnd> {
        let points = shown.renderer.ray_points(pixels, PER_NET);
        Ok(Self { pixels, truth: along_rays(shown, slide, &points, steps)?, points })
    }

    /// How far the picture of other steps is from the true one; `None` if hardly a pixel is lit.
    fn apart(&self, shown: Shown<'_>, slide: &Slide, steps: usize) -> Result<Option<StepsError>, RunEnd> {
        let found = along_rays(shown, slide, &self.points, steps)?;
        Ok(shown.renderer.pictures_apart(&self.points, &found, &self.truth))
    }
}

impl Comparison {
    /// One point in each of the `cells` of the domain. `None` if too few of them show anything.
    fn new(shown: Shown<'_>, slide: &Slide, cells: [usize; 3], number: u64, steps: usize) -> Result<Option<Self>, RunEnd> {
        // Not the seed of the picture, which would change the flow map.
        let unit = stratified_points(&Strata::even(cells, 1), number, STREAM);
        let mut points: Vec<DomainPoint> = unit.into_iter().map(|unit| shown.plan.domain.from_unit(unit)).collect();
        let reference = shown.tracer(slide, steps)?;
        points.retain(|&point| !reference.is_missing(point));
        let mut truth = Traced::default();
        reference.trace(&points, Extras::default(), &mut truth);
        let seen = truth.log_stretch.iter().filter(|&&s| shown.ramp(s) > 0.0).count();
        let cells: usize = cells.iter().product();
        Ok(Some(Self { points, truth, rays: None, of_steps: 0.0 }).filter(|_| seen as f64 >= MIN_SHOWN * cells as f64))
    }

    /// How far `steps` steps through this slide are from the truth.
    pub(super) fn of(&self, shown: Shown<'_>, slide: &Slide, steps: usize) -> Result<PictureSteps, RunEnd> {
        check_stop(shown.stop)?;
        progress::mark();
        let mut traced = Traced::default();
        shown.tracer(slide, steps)?.trace(&self.points, Extras::default(), &mut traced);
        let pairs = traced.log_stretch.iter().zip(&self.truth.log_stretch);
        let difference = upper_rms(pairs.map(|(a, b)| f64::from(a - b)).filter(|difference| difference.is_finite()));
        Ok(PictureSteps { steps, difference, residual: self.residual(shown, &traced), ..PictureSteps::default() })
    }

    /// How far the picture of `few` steps is from that of `many`, and whether that is little enough. Where hardly anything is lit, nothing is told, and
    /// any are.
    fn in_picture(&mut self, shown: Shown<'_>, slide: &Slide, [few, many]: [usize; 2]) -> Result<(StepsError, bool), RunEnd> {
        let mut rays = match self.rays.take() {
            Some(rays) => rays,
            None => Rays::new(shown, slide, PIXELS, many)?,
        };
        let mut found = rays.apart(shown, slide, few)?;
        let is_open = found.as_ref().is_none_or(|found| shown.suits(found).is_none());
        if is_open && rays.pixels < MOST_PIXELS {
            rays = Rays::new(shown, slide, MOST_PIXELS, many)?;
            found = rays.apart(shown, slide, few)?;
        }
        self.rays = Some(rays);
        // Where the standard error leaves it open, the mean decides.
        let by_mean = |found: &StepsError| shown.suits(&StepsError { deviation: [0.0; 3], ..*found }) == Some(true);
        Ok(found.map_or((StepsError::default(), true), |found| (found, shown.suits(&found).unwrap_or_else(|| by_mean(&found)))))
    }

    /// Optical residual of what was traced at the points.
    pub(super) fn residual(&self, shown: Shown<'_>, traced: &Traced) -> f64 {
        let pairs = traced.log_stretch.iter().copied().zip(self.truth.log_stretch.iter().copied());
        upper_rms(pairs.map(|(a, b)| match (a.is_finite(), b.is_finite()) {
            (true, true) => shown.ramp(a) - shown.ramp(b),
            (false, false) => 0.0,
            // The colours may differ as much as they can.
            _ => 1.0,
        }))
    }
}

impl Run<'_> {
    /// What the picture shows of the flow that is asked for.
    pub(super) fn shown(&self) -> Shown<'_> {
        Shown { plan: self.plan, map: &self.asked, renderer: &self.renderer, tolerance: self.learning.trust.tolerance(), stop: self.stop }
    }
}

impl<B: Backend> Cycle<'_, B> {
    /// Replaces the flow map of the first slide by one with the steps of the picture, if these are fewer, and by one of a window in single precision,
    /// if the picture needs it.
    pub(super) fn settle_steps(&mut self, slide: &Slide, chosen: Option<StepChoice>) -> Result<(), RunEnd> {
        let shown = self.run.shown();
        let Some(chosen) = chosen.filter(|_| suit_the_picture(shown.plan)) else { return Ok(()) };
        let (settled, compared) = self.run.threads.render().install(|| picture_steps(shown, slide, chosen))?;
        self.compared = compared;
        self.settled = Some((chosen, settled));
        (self.run.steps_error, self.run.steps_are_of_another_picture) = (settled.picture, false);
        if settled.steps < chosen.steps {
            tracing::info!("{settled:?} instead of {chosen:?}");
            self.take_steps(chosen, Some(settled));
            transaction!(self, slide, run, on => run.next_tracer(on, slide, &self.map));
        }
        self.tell_snapshots(slide, chosen)?;
        self.settle_storage(slide, true)?;
        Ok(())
    }

    /// Chooses the steps anew if they do not suit the picture of this slide. Returns whether the flow map is another one.
    pub(super) fn look_at_steps(&mut self, slide: &Slide) -> Result<bool, RunEnd> {
        let Some((chosen, settled)) = self.settled else { return Ok(false) };
        let (shown, begin) = (self.run.shown(), Instant::now());
        let (anew, compared) = self.run.threads.render().install(|| {
            let (is_outdated, compared) = is_outdated(shown, slide, chosen, settled)?;
            if !is_outdated {
                return Ok((None, compared));
            }
            match cpu_tracer(slide.velocity.clone(), shown.map, slide.time) {
                Ok(tracer) => {
                    let anew = tracer.step_choice().unwrap_or(chosen);
                    let (settled, compared) = picture_steps(shown, slide, anew)?;
                    Ok((Some(Ok((anew, settled))), compared))
                }
                // The run goes on with what it has.
                Err(error @ FlowError::StepsNotFound { .. }) => Ok((Some(Err(error)), compared)),
                Err(error) => Err(RunEnd::from(error)),
            }
        })?;
        let residual = compared.as_ref().map(|compared| compared.of_steps);
        self.compared = compared;
        tracing::debug!("looked at the steps of slide {} for {:.1} ms", slide.index, 1e3 * begin.elapsed().as_secs_f64());
        let (chosen, settled) = match anew {
            None => {
                self.run.steps_error = residual.map_or(settled.picture, |residual| settled.scaled_to(residual));
                self.run.steps_are_of_another_picture = true;
                return Ok(false);
            }
            Some(Ok(anew)) => anew,
            Some(Err(error)) => {
                self.run.progress.warnings.push(format!("slide {}: {error}; the picture keeps {} steps", slide.index, settled.steps));
                self.run.steps_are_of_another_picture = true;
                return Ok(false);
            }
        };
        if !chosen.within_tolerance {
            self.run.progress.warnings.push(format!(
                "slide {}: the log-stretch (FTLE times tau) with {} steps differs by {:.3} from that with twice as many",
                slide.index, chosen.steps, chosen.difference
            ));
        }
        tracing::info!("{settled:?} in slide {}; for the log-stretch {chosen:?}", slide.index);
        let before = self.map.steps;
        self.settled = Some((chosen, settled));
        (self.run.steps_error, self.run.steps_are_of_another_picture) = (settled.picture, false);
        self.take_steps(chosen, Some(settled).filter(|settled| settled.steps < chosen.steps));
        Ok(self.map.steps != before)
    }

    /// Measures what the steps leave in the picture, if that was last done for another one. For each view that a drag passes it would take too long.
    pub(super) fn measure_steps(&mut self, slide: &Slide) -> Result<(), RunEnd> {
        let is_due = std::mem::take(&mut self.run.steps_are_of_another_picture) && self.run.render.method.is_smooth();
        let Some((chosen, settled)) = self.settled.filter(|(chosen, settled)| is_due && settled.steps < chosen.steps) else {
            return Ok(());
        };
        let _work = Work::begin("measuring what the steps leave in the picture");
        let shown = self.run.shown();
        let measure = || Rays::new(shown, slide, PIXELS, chosen.steps)?.apart(shown, slide, settled.steps);
        self.run.steps_error = self.run.threads.render().install(measure)?.unwrap_or_default();
        Ok(())
    }

    /// Takes the steps of the picture, or else those of the log-stretch.
    pub(super) fn take_steps(&mut self, chosen: StepChoice, settled: Option<PictureSteps>) {
        let (steps, difference) = settled.map_or((chosen.steps, chosen.difference), |settled| (settled.steps, settled.difference));
        self.map.steps = Steps::Fixed(steps);
        let report = &mut self.run.report;
        report.integration_steps = Some(steps);
        report.integration_difference = Some(difference).filter(|difference| difference.is_finite());
        report.integration_residual = settled.map(|settled| settled.residual);
        let mut why = why_steps(difference, report.integration_residual);
        if settled.is_some_and(|settled| settled.by_picture) {
            why += "; fewer show in the picture";
        }
        Decision::new("flow.steps", steps, why).enter(&mut report.decisions);
    }
}

/// Steps per path; `None` if each path chooses its own.
pub(super) fn fixed_steps(tracer: &dyn Tracer) -> Option<usize> {
    Some(tracer.steps()).filter(|steps| *steps > 0)
}

/// Log-stretch at points of rays; NaN in missing cells.
fn along_rays(shown: Shown<'_>, slide: &Slide, rays: &RayPoints, steps: usize) -> Result<Vec<f32>, RunEnd> {
    let tracer = shown.tracer(slide, steps)?;
    let mut found = Vec::with_capacity(rays.points.len());
    let mut traced = Traced::default();
    for points in rays.points.chunks(AT_ONCE) {
        check_stop(shown.stop)?;
        progress::mark();
        let is_known: Vec<bool> = points.iter().map(|&point| !tracer.is_missing(point)).collect();
        let known: Vec<DomainPoint> = points.iter().zip(&is_known).filter_map(|(&point, known)| known.then_some(point)).collect();
        tracer.trace(&known, Extras::default(), &mut traced);
        let mut values = traced.log_stretch.iter().copied();
        found.extend(is_known.into_iter().map(|known| if known { values.next().unwrap_or(f32::NAN) } else { f32::NAN }));
    }
    Ok(found)
}

/// Root mean square, from the mean square and its standard error added up: few points hold most of a difference.
fn upper_rms(differences: impl Iterator<Item = f64>) -> f64 {
    let squares: Vec<f64> = differences.map(|difference| difference * difference).collect();
    let n = squares.len().max(1) as f64;
    let mean = squares.iter().sum::<f64>() / n;
    let variance = squares.iter().map(|square| (square - mean).powi(2)).sum::<f64>() / n;
    (mean + (variance / n).sqrt()).sqrt()
}
