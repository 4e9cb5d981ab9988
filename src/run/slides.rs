//! Slides of the window: a sequence of velocities, from a closed form, an archive or a running simulation.

use super::{RunError, Settings};
use crate::field::analytic::Analytic;
use crate::field::turbulence::Turbulence;
use crate::field::{Domain, Window};
use crate::flow::{Direction, VelocitySource};
use crate::progress::{self, Work};
use crate::setting::{Refused, shown};
use crate::source::live::{Follow, LiveRecord, LiveWindow, NextWindow};
use crate::source::{
    Archive, DEFAULT_READ_AHEAD, Every, Listener, MemorySource, ReadAhead, SnapshotSource, SourceKind, SourceSettings, StillReading,
    follow, read_ahead,
};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

/// Interval at which a wait for a snapshot checks for a request to stop.
pub(super) const LOOK_UP: Duration = Duration::from_millis(100);

/// A position of the window in time, with the velocity to integrate.
#[derive(Clone)]
pub struct Slide {
    /// Number of the slide, from 0.
    pub index: u64,
    /// Seed time t0.
    pub time: f64,
    /// `time` as a date; `None` if the source has no calendar.
    pub date: Option<String>,
    /// Figures of a running simulation; `None` for other sources.
    pub live: Option<LiveRecord>,
    /// Velocity to integrate.
    pub velocity: VelocitySource,
    /// Warnings since the previous slide.
    pub warnings: Vec<String>,
    /// Seconds spent waiting for snapshots.
    pub waited: f64,
}

/// A source of slides.
pub trait Slides: Send {
    /// Returns the next slide; `None` if the source has ended or `stop` is set. A wait for snapshots checks `stop` as well.
    ///
    /// # Errors
    /// The source fails.
    fn next_slide(&mut self, stop: &AtomicBool) -> Result<Option<Slide>, RunError>;

    /// Sets a listener that receives each snapshot as it is read. An archive is read some slides ahead; a simulation is read as it publishes.
    fn listen(&self, _listener: Listener) {}

    /// Total number of slides; `None` if unknown.
    fn expected(&self) -> Option<u64>;

    /// A time of the source as a date; `None` if the source has no calendar or no snapshot at that time.
    fn date(&self, _time: f64) -> Option<String> {
        None
    }

    /// For a running simulation and an archive that is followed, true until the next window is complete. `None` for other sources.
    fn is_awaited(&self) -> Option<bool> {
        None
    }

    /// The next window of a running simulation; `None` for other sources.
    fn next_window(&self) -> Option<NextWindow> {
        None
    }

    /// Warnings since the last slide, after which the source has ended.
    fn warnings(&mut self) -> Vec<String> {
        Vec::new()
    }

    /// Warnings since the last slide, if the source was lost since then and may come back. They are not given again.
    fn loss(&mut self) -> Vec<String> {
        Vec::new()
    }

    /// Whether [`Self::loss`] has something to tell.
    fn is_lost(&self) -> bool {
        false
    }

    /// Waits for news of a running simulation, no longer than this.
    fn wait_within(&self, limit: Duration) {
        std::thread::sleep(limit);
    }

    /// Whether no further slide is given, whatever the source does.
    fn is_over(&self) -> bool {
        false
    }

    /// Seeds later slides at the end of the window from which particles travel in this direction. Closed forms have no window.
    fn turn(&mut self, _direction: Direction) {}
}

impl Slide {
    /// Moves the seed time to the end of the window from which particles travel in this direction.
    ///
    /// # Errors
    /// The window is empty.
    pub(super) fn turn(&mut self, direction: Direction) -> Result<(), RunError> {
        if let VelocitySource::Window(window) = &self.velocity {
            self.time = seed_time(window, direction)?;
        }
        Ok(())
    }
}

/// Counts slides up to a limit.
struct Count {
    given: u64,
    most: u64,
}

impl Count {
    fn new(scene: &Settings, default: u64) -> Self {
        Self { given: 0, most: scene.time.slides.map_or(default, |n| n as u64) }
    }

    /// The number of the next slide.
    fn next(&mut self) -> u64 {
        self.given += 1;
        self.given - 1
    }

    fn is_over(&self) -> bool {
        self.given == self.most
    }
}

/// Returns the next item of a source that another thread reads; `None` if the source has ended or `stop` is set.
fn wait_for<T>(stop: &AtomicBool, mut next: impl FnMut(Duration) -> Result<Option<T>, StillReading>) -> Option<T> {
    while !stop.load(Ordering::Relaxed) {
        progress::mark();
        if let Ok(item) = next(LOOK_UP) {
            return item;
        }
    }
    None
}

/// Seed time of a window: its oldest time for forward integration, its newest for backward integration.
fn seed_time(window: &Window, direction: Direction) -> Result<f64, RunError> {
    let end = match direction {
        Direction::Forward => window.oldest(),
        Direction::Backward => window.newest(),
    };
    end.ok_or(RunError::EndedEarly)
}

/// Slides of a closed form: only the seed time changes.
struct ClosedForm {
    flow: Analytic,
    domain: Domain,
    start: f64,
    step: f64,
    count: Count,
}

impl Slides for ClosedForm {
    fn next_slide(&mut self, _: &AtomicBool) -> Result<Option<Slide>, RunError> {
        if self.count.is_over() {
            return Ok(None);
        }
        let index = self.count.next();
        Ok(Some(Slide {
            index,
            time: self.start + self.step * index as f64,
            date: None,
            live: None,
            velocity: VelocitySource::Analytic(self.flow.clone(), self.domain.clone()),
            warnings: Vec::new(),
            waited: 0.0,
        }))
    }

    fn expected(&self) -> Option<u64> {
        Some(self.count.most)
    }
}

/// Slides of an archive: the window moves over its snapshots.
struct ArchiveSlides {
    /// Read ahead by one I/O thread.
    reader: ReadAhead,
    /// Further snapshots may come.
    follows: bool,
    /// Dates by time.
    dates: Vec<(f64, Option<String>)>,
    window: Window,
    direction: Direction,
    /// Snapshots per slide.
    stride: usize,
    count: Count,
    /// Snapshots that moved the window since the last slide.
    taken: usize,
}

/// Date of a time, if it is known.
fn date_of(dates: &[(f64, Option<String>)], time: f64) -> Option<&String> {
    dates.iter().find(|(known, _)| *known == time).and_then(|(_, date)| date.as_ref())
}

impl Slides for ArchiveSlides {
    fn next_slide(&mut self, stop: &AtomicBool) -> Result<Option<Slide>, RunError> {
        if self.count.is_over() {
            return Ok(None);
        }
        let start = Instant::now();
        let mut warnings = Vec::new();
        let Self { reader, window, taken, .. } = self;
        // What is not there yet is waited for, and has no time left.
        let work = (!self.follows).then(|| Work::begin("reading the window"));
        while !(window.is_full() && (self.count.given == 0 || *taken >= self.stride)) {
            let Some(snapshot) = wait_for(stop, |limit| reader.next_within(limit)) else { return Ok(None) };
            let news = reader.news();
            self.dates.extend(news.dates);
            warnings.extend(news.warnings);
            let newest = window.newest();
            match window.push(snapshot?) {
                Ok(pushed) => warnings.extend(pushed.warning.map(|warning| match date_of(&self.dates, warning.time()) {
                    Some(date) => format!("{date}: {warning}"),
                    None => warning.to_string(),
                })),
                Err(fault) => warnings.push(fault.to_string()),
            }
            *taken += usize::from(window.newest() != newest);
            match (&work, window.oldest(), window.newest()) {
                (Some(work), Some(oldest), Some(newest)) if !window.is_full() => work.reached_share((newest - oldest) / window.span()),
                (Some(work), ..) => work.reached(*taken, self.stride),
                _ => {}
            }
        }
        *taken = 0;
        drop(work);
        let time = seed_time(window, self.direction)?;
        let velocity = VelocitySource::Window(Arc::new(window.clone()));
        Ok(Some(Slide {
            index: self.count.next(),
            time,
            date: self.date(time),
            live: None,
            velocity,
            warnings,
            waited: start.elapsed().as_secs_f64(),
        }))
    }

    fn date(&self, time: f64) -> Option<String> {
        date_of(&self.dates, time).cloned()
    }

    fn listen(&self, listener: Listener) {
        self.reader.tell(listener);
    }

    fn turn(&mut self, direction: Direction) {
        self.direction = direction;
    }

    fn warnings(&mut self) -> Vec<String> {
        self.reader.news().warnings
    }

    fn is_awaited(&self) -> Option<bool> {
        // Between two slides the window is full.
        self.follows.then(|| self.reader.is_waiting_for(self.stride))
    }

    fn is_over(&self) -> bool {
        self.count.is_over()
    }

    fn expected(&self) -> Option<u64> {
        let times = &self.dates;
        if self.follows {
            return Some(self.count.most).filter(|n| *n < u64::MAX);
        }
        let first = times.iter().position(|(t, _)| t - times[0].0 >= self.window.span() * (1.0 - 1e-9))?;
        Some(self.count.most.min(((times.len() - 1 - first) / self.stride + 1) as u64))
    }
}

/// Slides of a running simulation, whose window moves by itself.
struct LiveSlides {
    window: LiveWindow,
    direction: Direction,
    count: Count,
    /// The simulation waits until each of its steps is in a slide.
    is_waited_for: bool,
}

impl Slides for LiveSlides {
    fn next_slide(&mut self, stop: &AtomicBool) -> Result<Option<Slide>, RunError> {
        if self.count.is_over() {
            return Ok(None);
        }
        let start = Instant::now();
        // Later windows are awaited, and have no time left.
        let work = (self.count.given == 0).then(|| Work::begin("receiving the window"));
        let next = |limit| {
            work.iter().for_each(|work| work.reached_share(self.window.filled()));
            self.window.next_within(limit)
        };
        let Some(taken) = wait_for(stop, next) else { return Ok(None) };
        drop(work);
        let taken = taken?;
        Ok(Some(Slide {
            index: self.count.next(),
            time: seed_time(&taken.window, self.direction)?,
            date: None,
            live: Some(taken.live),
            velocity: VelocitySource::Window(Arc::new(taken.window)),
            warnings: taken.warnings,
            waited: start.elapsed().as_secs_f64(),
        }))
    }

    fn listen(&self, listener: Listener) {
        self.window.tell(listener);
    }

    fn turn(&mut self, direction: Direction) {
        self.direction = direction;
    }

    fn expected(&self) -> Option<u64> {
        Some(self.count.most).filter(|n| *n < u64::MAX)
    }

    fn is_awaited(&self) -> Option<bool> {
        Some(self.window.is_waited_for())
    }

    fn next_window(&self) -> Option<NextWindow> {
        // After the last slide none is delayed, but a simulation may wait.
        (!self.count.is_over() || self.is_waited_for).then(|| self.window.next_window())
    }

    fn warnings(&mut self) -> Vec<String> {
        self.window.warnings()
    }

    fn loss(&mut self) -> Vec<String> {
        self.window.loss()
    }

    fn is_lost(&self) -> bool {
        self.window.is_lost()
    }

    fn wait_within(&self, limit: Duration) {
        self.window.wait_within(limit);
    }

    fn is_over(&self) -> bool {
        self.count.is_over()
    }
}

/// Opens the slides of a scene whose |tau| is known.
///
/// # Errors
/// A closed form without a domain, or a source that does not span tau.
pub(super) fn open_slides(
    scene: &Settings,
    snapshots: Option<Box<dyn SnapshotSource>>,
    tau: f64,
    direction: Direction,
) -> Result<Box<dyn Slides>, RunError> {
    match (closed_form(&scene.source), snapshots) {
        (Some(flow), _) => {
            let box_ = scene.domain.as_ref().ok_or_else(no_domain)?;
            let domain = Domain { dimensions: flow.dimensions(), ..Domain::cuboid(box_.min, box_.max) };
            Ok(Box::new(ClosedForm { flow, domain, start: scene.time.start, step: scene.time.seed_step, count: Count::new(scene, 1) }))
        }
        (None, Some(source)) => {
            let longest = scene.archive.follow.filter(|_| scene.source.kind == SourceKind::Archive).map(Duration::from_secs_f64);
            if longest.is_none() {
                source.check_tau(tau)?;
            }
            let dates: Vec<_> = source.times().iter().map(|&t| (t, source.date(t))).collect();
            let range = 0..dates.len();
            Ok(Box::new(ArchiveSlides {
                reader: match longest {
                    Some(longest) => follow(source, DEFAULT_READ_AHEAD, longest),
                    None => read_ahead(source, range, DEFAULT_READ_AHEAD),
                },
                follows: longest.is_some(),
                dates,
                window: Window::new(tau),
                direction,
                stride: scene.time.snapshots_per_slide,
                count: Count::new(scene, u64::MAX),
                taken: 0,
            }))
        }
        (None, None) => Err(no_domain()),
    }
}

/// The slides of a running simulation.
pub(super) fn live_slides(scene: &Settings, window: LiveWindow, direction: Direction) -> Box<dyn Slides> {
    let is_waited_for = scene.live.follow == Follow::Every;
    Box::new(LiveSlides { window, direction, count: Count::new(scene, u64::MAX), is_waited_for })
}

/// Closed form that `[source]` describes; `None` for gridded kinds.
pub fn closed_form(source: &SourceSettings) -> Option<Analytic> {
    let or = |given: Option<f64>, default: f64| given.unwrap_or(default);
    Some(match source.kind {
        SourceKind::DoubleGyre => Analytic::DoubleGyre {
            amplitude: or(source.amplitude, 0.1),
            epsilon: or(source.epsilon, 0.25),
            omega: or(source.omega, std::f64::consts::TAU / 10.0),
        },
        SourceKind::Abc => Analytic::Abc {
            a: or(source.a, 3f64.sqrt()),
            b: or(source.b, 2f64.sqrt()),
            c: or(source.c, 1.0),
            growth: or(source.growth, 0.0),
        },
        SourceKind::Saddle => Analytic::Saddle { rate: or(source.rate, 1.0) },
        SourceKind::Rotation => Analytic::Rotation { omega: or(source.omega, 1.0) },
        SourceKind::Shear => Analytic::Shear { rate: or(source.rate, 1.0) },
        SourceKind::Turbulence | SourceKind::Archive | SourceKind::Live => return None,
    })
}

/// Opens a gridded source, of which every `time.every`-th snapshot is read.
///
/// # Errors
/// The source is live or a closed form, or the archive cannot be opened.
pub fn open_snapshots(scene: &Settings) -> Result<Box<dyn SnapshotSource>, RunError> {
    let source = &scene.source;
    match source.kind {
        SourceKind::Archive => {
            let archive = Archive::open(&scene.archive.files, &scene.archive)?;
            return Ok(Box::new(Every::new(Box::new(archive), scene.time.every)));
        }
        SourceKind::Live => {
            let accepted = "with `ridgewatch attach`: this command needs a source that it can read again";
            return Err(Refused::new("source.kind", "is \"live\"", accepted).into());
        }
        SourceKind::Turbulence => {}
        SourceKind::DoubleGyre | SourceKind::Abc | SourceKind::Saddle | SourceKind::Rotation | SourceKind::Shear => {
            let found = format_args!("is {}, a closed form, which has no snapshots", shown(source.kind));
            return Err(Refused::new("source.kind", found, "\"archive\" or \"turbulence\"").into());
        }
    }
    let nodes = source.nodes.unwrap_or([96, 48, 48]);
    let (modes, k_max, amplitude) = (source.modes.unwrap_or(48), source.k_max.unwrap_or(14.0), source.amplitude.unwrap_or(3.0));
    // The field belongs to the scene: --seed changes only the sampling of the picture.
    let turbulence = Turbulence::new(nodes, modes, k_max, amplitude, TURBULENCE_SEED);
    let grid = Turbulence::grid(nodes)?;
    let times = (0..source.snapshots.unwrap_or(12)).map(|t| t as f64).collect();
    let [x, y, z] = nodes;
    let source = MemorySource::new(format!("{x} x {y} x {z} nodes"), grid.clone(), times, move |_, time| turbulence.snapshot(time, &grid))?;
    let source = source.synthetic(Turbulence::described(modes, k_max, amplitude, TURBULENCE_SEED));
    Ok(Box::new(Every::new(Box::new(source), scene.time.every)))
}

/// Error of a closed form without `[domain]`.
pub(super) fn no_domain() -> RunError {
    Refused::new("domain", "is missing", "[domain] with min and max, since a closed form has no grid").into()
}

/// Seed of the standard turbulence.
const TURBULENCE_SEED: u64 = 0;
