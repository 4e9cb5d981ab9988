//! Races of methods, for `render.method = "auto"`.
//!
//! A run begins with `two_level`, so that no picture waits for a race, or with the method that won an earlier run. After the frames of a slide each draws
//! pictures that are not shown. A race is run as soon as it takes at most a tenth of the time since the one before, and again when the character of the
//! window has changed.

use super::cycle::Cycle;
use super::decision::Decision;
use super::report::Sink;
use super::slides::{Slide, Slides};
use super::state::Run;
use super::steering::drawn_by;
use super::stop::{RunEnd, check_stop};
use super::transaction::{On, present, with};
use super::{Event, FrameRecord};
use crate::backend::{Backend, FrameJob, Rendered, Routing, Surrogate};
use crate::progress::Work;
use crate::render::Method;
use crate::render::smooth::{PictureError, noise_psnr};
use crate::surrogate::Kind;
use serde::{Deserialize, Serialize};
use std::time::Instant;

/// PSNR over lit pixels, in decibels, to which the methods race.
const TARGET: f64 = 40.0;
/// Times that differ by less than this factor count as equal.
const MARGIN: f64 = 1.1;
/// Largest share of the time that goes into races.
const SHARE: f64 = 0.1;
/// Factor by which the time to the target changes if the character of the window does, and slides in a row that show it.
const CHANGED: f64 = 2.0;
const IN_A_ROW: usize = 3;
/// Seconds by which a frame may take longer for other reasons.
const NOISE: f64 = 0.01;
/// The methods that race, in the order in which they are taken if they are equally fast: `two_level` goes on from there.
const METHODS: [Method; 3] = [Method::TwoLevel, Method::Marched, Method::Reference];
/// Samples a pixel of a picture in a race.
const SAMPLES: f64 = 2.0;
/// Pictures of a method in a race. Two tell the noise of a method that states no error.
const PICTURES: usize = 2;
/// Decibels by which a picture is noisier than the mean of two.
const OF_TWO: f64 = 3.0103;
/// Number of the first picture of a race.
const RACE_PICTURE: u64 = 1 << 42;

/// Result of a race.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Race {
    /// The method that reaches the target first; one that stands before it in the order `two_level`, `marched`, `reference` if that takes at most 10 %
    /// longer.
    pub method: Method,
    /// Seconds since a slide to the target, by method; extrapolated if fewer pictures were drawn. `None` for methods that never reach it: frames of
    /// `marched` and of `reference` do not become better, so that one of them must.
    pub seconds: Vec<(Method, Option<f64>)>,
    /// The target, in decibels over lit pixels.
    pub target: f64,
    /// The slide at whose end it was run.
    pub slide: u64,
}

/// What a method takes for a slide.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(super) struct Pace {
    method: Option<Method>,
    /// Seconds of preparing the slide.
    prepared: f64,
    frames: usize,
    /// Seconds of all frames, and of the last one.
    drawn: f64,
    last: f64,
    /// PSNR of the last frame, in decibels; `None` if none is known.
    psnr: Option<f64>,
}

/// The races of a run.
#[derive(Debug)]
pub(super) struct Races {
    is_due: bool,
    /// End of the last race, or begin of the run.
    since: Instant,
    /// Figure of the drawn method in the slide after the last race, and slides in a row that differ from it.
    then: Option<f64>,
    differ: usize,
    /// Races so far, and the slide of the last one.
    count: u64,
    slide: Option<u64>,
    /// Seconds that the last one took, or twice those after which it was given up.
    cost: f64,
}

impl Race {
    /// Of the seconds from a slide to a PSNR in decibels, by method; `None` if no method reaches the target.
    pub fn of_times(seconds_to: impl Fn(Method, f64) -> Option<f64>) -> Option<Self> {
        let seconds: Vec<_> = METHODS.into_iter().map(|method| (method, seconds_to(method, TARGET))).collect();
        seconds.iter().any(|(_, seconds)| seconds.is_some()).then(|| Self::of(seconds, 0))
    }

    /// Of the times of all methods.
    fn of(seconds: Vec<(Method, Option<f64>)>, slide: u64) -> Self {
        let best = seconds.iter().filter_map(|(_, seconds)| *seconds).fold(f64::INFINITY, f64::min);
        let as_fast = |(_, seconds): &&(Method, Option<f64>)| seconds.is_some_and(|seconds| seconds <= MARGIN * best);
        let method = seconds.iter().find(as_fast).map_or(Method::TwoLevel, |(method, _)| *method);
        Self { method, seconds, target: TARGET, slide }
    }

    /// Whether this program may have run it.
    pub fn is_sound(&self) -> bool {
        METHODS.contains(&self.method)
    }

    /// The times that decided.
    pub fn why(&self) -> String {
        let time = |seconds: &Option<f64>| match seconds.filter(|seconds| seconds.is_finite()) {
            Some(seconds) if seconds < 10.0 => format!("{seconds:.2} s"),
            Some(seconds) => format!("{seconds:.0} s"),
            None => "never".to_owned(),
        };
        let times: Vec<String> = self.seconds.iter().map(|(method, seconds)| format!("{} {}", method.name(), time(seconds))).collect();
        format!("first to {} dB after a slide ({})", self.target, times.join(", "))
    }
}

impl Pace {
    /// Adds a frame. What was drawn by another method does not count.
    pub(super) fn add(&mut self, method: Method, record: &FrameRecord) {
        if self.method.is_some_and(|before| before != method) {
            self.begin_anew();
        }
        self.method = Some(method);
        self.prepared += record.seconds.slide;
        self.draw(record.seconds.total, record.picture_error.as_ref().map(|error| stated(method, error)));
    }

    /// The picture starts anew.
    pub(super) fn begin_anew(&mut self) {
        *self = Self { prepared: self.prepared, ..Self::default() };
    }

    fn draw(&mut self, seconds: f64, psnr: Option<f64>) {
        (self.frames, self.drawn, self.last, self.psnr) = (self.frames + 1, self.drawn + seconds, seconds, psnr);
    }

    /// Seconds since the slide to a PSNR: those taken, or extrapolated as if the squared error fell in proportion to the number of frames. `None` below it
    /// for methods whose frames do not become better, and without a PSNR.
    fn seconds_to(&self, target: f64, method: Method) -> Option<f64> {
        let psnr = self.psnr.filter(|psnr| method == Method::TwoLevel || *psnr >= target)?;
        let more = self.frames as f64 * (10f64.powf((target - psnr) / 10.0) - 1.0).max(0.0);
        Some(self.prepared + self.drawn + more * self.last)
    }

    /// What tells that the character of the window changed: the time to the target, or that of a frame of a method that states no error.
    fn figure(&self, method: Method) -> f64 {
        self.seconds_to(TARGET, method).unwrap_or(self.last)
    }
}

impl Races {
    /// Races of a run that begins now, after an earlier run's race.
    pub(super) fn new(earlier: Option<&Race>) -> Self {
        Self { is_due: earlier.is_none(), since: Instant::now(), then: None, differ: 0, count: 0, slide: None, cost: 0.0 }
    }

    /// The flow map or the colours are other ones.
    pub(super) fn begin_anew(&mut self) {
        self.is_due = true;
    }

    /// Looks at a slide, by the method that draws. One with a race has frames of two methods, or of one that draws no longer.
    pub(super) fn look_at(&mut self, slide: u64, method: Method, pace: &Pace) {
        if self.slide == Some(slide) || pace.method != Some(method) {
            return;
        }
        let figure = pace.figure(method) + NOISE;
        let then = *self.then.get_or_insert(figure);
        self.differ = if figure > CHANGED * then || then > CHANGED * figure { self.differ + 1 } else { 0 };
        self.is_due |= self.differ >= IN_A_ROW;
    }

    /// Seconds for a race, if one is due and takes no longer than these.
    fn allow(&self, seconds: f64) -> Option<f64> {
        let room = SHARE * self.since.elapsed().as_secs_f64();
        (self.is_due && seconds.max(self.cost) <= room).then_some(room)
    }
}

/// PSNR that a frame states. A march does not become better, so that it must be sure to be there.
fn stated(method: Method, error: &PictureError) -> f64 {
    if method == Method::Marched { error.psnr.low } else { error.psnr.value }
}

impl Run<'_> {
    /// Whether a surrogate is kept for the method, or for those that a command may choose.
    pub(super) fn keeps_surrogate(&self) -> bool {
        let scene = &self.plan.scene;
        // What was learned is kept; a table is traced again within a slide.
        let may_go = self.races.is_some() && scene.surrogate.kind == Kind::Table;
        scene.render.method.has_surrogate() && (self.render.method.has_surrogate() || !may_go)
    }

    /// Draws pictures by a method that are not shown. `told` gets how many of them are drawn.
    fn try_method<B: Backend>(&mut self, on: &mut On<B>, method: Method, told: &(dyn Fn(f64) + Sync)) -> Result<Pace, RunEnd> {
        let gate = self.gate(method);
        let serves = on.surrogate.as_ref().filter(|_| method.has_surrogate());
        let frozen = serves.map(Surrogate::freeze).transpose()?;
        let smooth = self.smooth(&on.backend, serves, method, SAMPLES)?;
        let routing = Routing { gate: &gate, trace_budget: self.plan.scene.trust.trace_budget, keep: 0, extras: self.label_extras() };
        let first = RACE_PICTURE + (self.races.as_ref().map_or(0, |races| races.count) << 8);
        let On { backend, tracer, .. } = on;
        let (mut renderer, mut picture) = (self.renderer.clone(), B::Picture::default());
        let (mut pace, mut before) = (Pace::default(), None);
        for number in 0..PICTURES as u64 {
            let report = |share: f32| told(number as f64 + f64::from(share));
            let job = FrameJob {
                tracer: present(tracer),
                surrogate: frozen.as_ref(),
                routing,
                picture: first + number,
                samples: SAMPLES,
                smooth,
                is_map: false,
                progress: Some(&report),
                stop: self.stop,
            };
            let begin = Instant::now();
            let rendered = self.threads.render().install(|| backend.render(&job, &mut renderer, &mut picture))?;
            let seconds = begin.elapsed().as_secs_f64();
            check_stop(self.stop)?;
            report(1.0);
            let Rendered { film, error, .. } = rendered;
            // Of a frame with the samples of the run, as the noise falls.
            let more = 10.0 * (self.render.samples / SAMPLES).log10() - OF_TWO;
            let tone_map = self.render.tone_map_of(method);
            let told = before.replace(film.clone()).map(|before| noise_psnr(&before, &film, tone_map) + more);
            pace.draw(seconds, error.map(|error| stated(method, &error)).or(told));
            if method == Method::Marched {
                break;
            }
        }
        if method == Method::Reference {
            let seconds = pace.last * (self.render.samples / SAMPLES).max(1.0);
            (pace.frames, pace.drawn, pace.last) = (1, seconds, seconds);
        }
        Ok(pace)
    }
}

impl<B: Backend> Cycle<'_, B> {
    /// Lets the methods race after the frames of a slide, if a race is due and another slide comes. It is given up if it takes longer than its share.
    pub(super) fn race(&mut self, slides: &dyn Slides, slide: &Slide, pace: &Pace, sink: &mut Sink<'_>) -> Result<(), RunEnd> {
        let run = &mut self.run;
        let Some(races) = &run.races else { return Ok(()) };
        let has_surrogate = with!(&self.session, on => on.surrogate.is_some());
        let tracing = if has_surrogate { 0.0 } else { run.progress.surrogate_seconds };
        // Of `marched` one picture tells all.
        let pictures_of = |method| if method == Method::Marched { 1 } else { PICTURES };
        let pictures: usize = METHODS.into_iter().map(pictures_of).sum();
        let wanted = tracing + pictures as f64 * pace.last;
        let Some(room) = races.allow(wanted).filter(|_| !slides.is_over()) else { return Ok(()) };
        let (begin, count) = (Instant::now(), races.count + 1);
        let (work, mut drawn) = (Work::begin("racing the methods"), 0);
        let mut seconds = Vec::new();
        for method in METHODS {
            // What a method takes is known afterwards only.
            if begin.elapsed().as_secs_f64() > room {
                break;
            }
            let told = |more: f64| work.reached_share((drawn as f64 + more) / pictures as f64);
            match self.time_of(method, pace, &told) {
                Ok(time) => seconds.push((method, time)),
                Err(RunEnd::Device(error)) => {
                    // What was measured is of another device.
                    self.session.recover(error, slide, &self.map, &mut self.run)?;
                    break;
                }
                Err(end) => return Err(end),
            }
            drawn += pictures_of(method);
        }
        let race = (seconds.len() == METHODS.len()).then(|| Race::of(seconds, slide.index));
        race.iter().for_each(|race| self.take_method(race, sink));
        let (run, took) = (&mut self.run, begin.elapsed().as_secs_f64());
        if !run.keeps_surrogate() {
            with!(&mut self.session, on => on.surrogate = None);
            run.learning.resize = None;
            Decision::withdraw_surrogate(&mut run.report.decisions);
        } else if !has_surrogate {
            // Its residuals are those of windows before `reference` drew.
            run.learning.trust.reset();
        }
        let (is_due, cost) = if race.is_some() { (false, took) } else { (true, 2.0 * took) };
        run.races = Some(Races { is_due, count, slide: Some(slide.index), cost, ..Races::new(None) });
        run.progress.raced += took;
        run.report.race = race.or(run.report.race.take());
        Ok(())
    }

    /// Goes on with the method that won.
    fn take_method(&mut self, race: &Race, sink: &mut Sink<'_>) {
        let run = &mut self.run;
        Decision::new("render.method", race.method.name(), race.why()).enter(&mut run.report.decisions);
        if race.method == run.render.method {
            return;
        }
        sink(Event::Note(format!("render.method = \"auto\": {} from slide {} on, {}", race.method.name(), race.slide + 1, race.why())));
        with!(&mut self.session, on => on.picture = Default::default());
        run.render = drawn_by(&run.plan.scene.render, race.method, run.render.budget);
        (run.progress.cost, run.progress.last_audit) = (None, None);
        run.draw_color_bar();
        run.options.steering.iter().for_each(|steering| steering.keep_method(race.method));
    }

    /// Seconds from a slide to the target by a method, which draws pictures of its own: those of the slide may be single ones, whose first costs most.
    /// `None` if it never reaches it, or the device has no room for it.
    fn time_of(&mut self, method: Method, drawn: &Pace, told: &(dyn Fn(f64) + Sync)) -> Result<Option<f64>, RunEnd> {
        let serves = method.has_surrogate();
        let tried = with!(&mut self.session, on => {
            let built = if serves && on.surrogate.is_none() { self.run.build_surrogate(on) } else { Ok(()) };
            built.and_then(|()| self.run.try_method(on, method, told))
        });
        match tried {
            Ok(pace) => {
                // All but the surrogate is prepared alike.
                let surrogate = self.run.progress.surrogate_seconds;
                let others = if self.run.render.method.has_surrogate() { (drawn.prepared - surrogate).max(0.0) } else { drawn.prepared };
                let prepared = if serves { others + surrogate } else { others };
                Ok(Pace { prepared, ..pace }.seconds_to(TARGET, method))
            }
            Err(RunEnd::Device(error)) if error.is_refusal() => {
                tracing::info!("{} does not race: {error}", method.name());
                Ok(None)
            }
            Err(end) => Err(end),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn times_are_extrapolated_as_noise_falls() {
        let mut pace = Pace { prepared: 1.0, ..Pace::default() };
        assert_eq!(pace.seconds_to(40.0, Method::TwoLevel), None, "without a frame");
        for _ in 0..4 {
            pace.draw(0.5, Some(30.0));
        }
        let seconds = pace.seconds_to(40.0, Method::TwoLevel).unwrap();
        assert!((seconds - (1.0 + 2.0 + 36.0 * 0.5)).abs() < 1e-9, "ten times as many frames: {seconds}");
        assert_eq!(pace.seconds_to(30.0, Method::TwoLevel), Some(3.0), "those taken");
        assert_eq!(
            (pace.seconds_to(40.0, Method::Marched), pace.seconds_to(30.0, Method::Marched)),
            (None, Some(3.0)),
            "it does not improve"
        );
    }

    #[test]
    fn equal_times_keep_the_order() {
        let race = |times: [Option<f64>; 3]| Race::of(METHODS.into_iter().zip(times).collect(), 0).method;
        assert_eq!(race([Some(1.09), Some(1.0), Some(1.0)]), Method::TwoLevel);
        assert_eq!(race([Some(1.2), Some(1.05), Some(1.0)]), Method::Marched);
        assert_eq!(race([Some(1.2), None, Some(1.0)]), Method::Reference);
        assert_eq!(race([None; 3]), Method::TwoLevel);
        let race = Race::of(vec![(Method::TwoLevel, Some(0.5)), (Method::Marched, None), (Method::Reference, Some(120.0))], 0);
        assert_eq!(race.why(), "first to 40 dB after a slide (two_level 0.50 s, marched never, reference 120 s)");
    }

    #[test]
    fn a_race_by_measured_times_needs_one_that_reached_the_target() {
        let race = Race::of_times(|method, target| (target == 40.0 && method == Method::Reference).then_some(2.0));
        assert!(race.is_some_and(|race| race.method == Method::Reference && race.slide == 0));
        assert_eq!(Race::of_times(|_, _| None), None);
    }

    #[test]
    fn a_race_takes_a_tenth_of_the_time_and_comes_again_when_the_window_changes() {
        let method = Some(Method::TwoLevel);
        let pace = |seconds: f64| Pace { method, prepared: 0.0, frames: 1, drawn: seconds, last: seconds, psnr: Some(40.0) };
        let mut races = Races { since: Instant::now() - std::time::Duration::from_secs(100), ..Races::new(None) };
        races.look_at(0, Method::TwoLevel, &pace(1.0));
        assert_eq!((races.allow(9.9).is_some(), races.allow(10.2)), (true, None));
        races.cost = 11.0;
        assert_eq!(races.allow(1.0), None, "the last one took longer");
        (races.is_due, races.then, races.cost, races.slide) = (false, None, 0.0, Some(1));
        races.look_at(1, Method::TwoLevel, &pace(9.0));
        assert_eq!(races.then, None, "a slide with a race tells nothing");
        for (seconds, is_due) in
            [(1.0, false), (1.9, false), (2.1, false), (0.4, false), (1.9, false), (2.1, false), (2.1, false), (0.4, true)]
        {
            races.look_at(2, Method::TwoLevel, &pace(seconds));
            assert_eq!(races.is_due, is_due, "{seconds}");
        }
        let mut slower = Races { is_due: false, then: Some(1.0), differ: 0, ..races };
        (0..3).for_each(|_| slower.look_at(2, Method::Reference, &pace(0.4)));
        assert!(!slower.is_due, "what another method took tells nothing");
        (0..3).for_each(|_| slower.look_at(2, Method::Reference, &Pace { method: Some(Method::Reference), psnr: None, ..pace(0.4) }));
        assert!(slower.is_due, "a method without a stated error is judged by its frames");
        let earlier = Race::of(vec![(Method::TwoLevel, Some(1.0))], 0);
        assert!(!Races::new(Some(&earlier)).is_due, "an earlier run's race counts");
    }
}
