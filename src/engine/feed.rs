//! One velocity after another: the slides of the window.

use super::{EngineError, Settings};
use crate::field::analytic::Analytic;
use crate::field::turbulence::Turbulence;
use crate::field::{Domain, Window};
use crate::flow::{Direction, VelocitySource};
use crate::setting::{Refused, shown};
use crate::source::live::{LiveRecord, LiveWindow};
use crate::source::{
    Archive, DEFAULT_READ_AHEAD, Listener, MemorySource, ReadAhead, SnapshotSource, SourceKind, SourceSettings, StillReading, read_ahead,
};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

/// How often a wait for a snapshot looks up for a request to stop.
const LOOK_UP: Duration = Duration::from_millis(100);

/// One position of the window.
pub struct Slide {
    /// From 0.
    pub index: u64,
    /// Seed time t0.
    pub time: f64,
    /// The same as a date, where the source has a calendar.
    pub date: Option<String>,
    /// Of a simulation that runs now.
    pub live: Option<LiveRecord>,
    /// What is integrated.
    pub velocity: VelocitySource,
    /// What was odd on the way here.
    pub warnings: Vec<String>,
    /// Seconds spent waiting for snapshots.
    pub waited: f64,
}

/// Where slides come from.
pub enum Feed {
    /// Closed form: the seed time moves.
    Closed {
        /// The flow.
        flow: Analytic,
        /// Its box.
        domain: Domain,
        /// Seed time of the first slide.
        start: f64,
        /// How far it moves.
        step: f64,
        /// Slides given so far.
        given: u64,
        /// Slides to give.
        slides: u64,
    },
    /// Snapshots: the window moves.
    Archive {
        /// Read ahead by one I/O thread.
        reader: ReadAhead,
        /// Dates by time.
        dates: Vec<(f64, Option<String>)>,
        /// The sliding window.
        window: Window,
        /// Forward seeds start at the oldest time, backward ones at the newest.
        direction: Direction,
        /// Snapshots a slide.
        stride: usize,
        /// Slides given so far.
        given: u64,
        /// Slides to give at most.
        slides: u64,
        /// Snapshots taken in since the last slide.
        taken: usize,
        /// Warnings since the last slide.
        warnings: Vec<String>,
    },
    /// A simulation that runs now: its window moves by itself.
    Live {
        /// The window.
        window: LiveWindow,
        /// Forward seeds start at the oldest time, backward ones at the newest.
        direction: Direction,
        /// Slides given so far.
        given: u64,
        /// Slides to give at most.
        slides: u64,
    },
}

/// The closed form that `[source]` describes; none for gridded kinds.
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

/// A gridded source, opened.
pub fn open_snapshots(scene: &Settings) -> Result<Box<dyn SnapshotSource>, EngineError> {
    let source = &scene.source;
    match source.kind {
        SourceKind::Archive => return Ok(Box::new(Archive::open(&scene.archive.files, &scene.archive)?)),
        SourceKind::Live => {
            let accepted = "with `ridgewatch attach`: this command wants what it can read again";
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
    // The field is the scene's, not the run's: --seed changes the sampling of the picture only.
    let turbulence = Turbulence::new(nodes, modes, k_max, amplitude, TURBULENCE_SEED);
    let grid = Turbulence::grid(nodes)?;
    let times = (0..source.snapshots.unwrap_or(12)).map(|t| t as f64).collect();
    let [x, y, z] = nodes;
    let source = MemorySource::new(format!("{x} x {y} x {z} nodes"), grid.clone(), times, move |_, time| turbulence.snapshot(time, &grid))?;
    Ok(Box::new(source.synthetic(Turbulence::described(modes, k_max, amplitude, TURBULENCE_SEED))))
}

/// A closed form without a box.
pub(super) fn no_domain() -> EngineError {
    Refused::new("domain", "is missing", "[domain] with min and max, since a closed form has no grid").into()
}

/// Seed of the standard turbulence (design: 0 for development).
const TURBULENCE_SEED: u64 = 0;

impl Feed {
    /// The feed of a scene whose |tau| is known.
    pub fn open(scene: &Settings, snapshots: Option<Box<dyn SnapshotSource>>, tau: f64, direction: Direction) -> Result<Self, EngineError> {
        let slides = scene.time.slides.map(|n| n as u64);
        match (closed_form(&scene.source), snapshots) {
            (Some(flow), _) => {
                let box_ = scene.domain.as_ref().ok_or_else(no_domain)?;
                let domain = Domain { dimensions: flow.dimensions(), ..Domain::cuboid(box_.min, box_.max) };
                Ok(Feed::Closed {
                    flow,
                    domain,
                    start: scene.time.start,
                    step: scene.time.seed_step,
                    given: 0,
                    slides: slides.unwrap_or(1),
                })
            }
            (None, Some(source)) => {
                let times = source.times();
                source.check_tau(tau)?;
                let dates = times.iter().map(|&t| (t, source.date(t))).collect();
                let range = 0..times.len();
                Ok(Feed::Archive {
                    reader: read_ahead(source, range, DEFAULT_READ_AHEAD),
                    dates,
                    window: Window::new(tau),
                    direction,
                    stride: scene.time.snapshots_per_slide,
                    given: 0,
                    slides: slides.unwrap_or(u64::MAX),
                    taken: 0,
                    warnings: Vec::new(),
                })
            }
            (None, None) => Err(no_domain()),
        }
    }

    /// `listener` hears of snapshots as they are read: of an archive some slides before they are needed, of a simulation as soon as they are
    /// there.
    pub fn tell(&self, listener: Listener) {
        match self {
            Feed::Closed { .. } => {}
            Feed::Archive { reader, .. } => reader.tell(listener),
            Feed::Live { window, .. } => window.tell(listener),
        }
    }

    /// The next slide; none when the source has ended.
    pub fn next_slide(&mut self) -> Result<Option<Slide>, EngineError> {
        self.next_slide_unless(&AtomicBool::new(false))
    }

    /// The same; also none when `stop` is set, which is looked at while snapshots are waited for.
    pub fn next_slide_unless(&mut self, stop: &AtomicBool) -> Result<Option<Slide>, EngineError> {
        match self {
            Feed::Closed { flow, domain, start, step, given, slides } => {
                if *given == *slides {
                    return Ok(None);
                }
                let time = *start + *step * *given as f64;
                *given += 1;
                Ok(Some(Slide {
                    index: *given - 1,
                    time,
                    date: None,
                    live: None,
                    velocity: VelocitySource::Analytic(flow.clone(), domain.clone()),
                    warnings: Vec::new(),
                    waited: 0.0,
                }))
            }
            Feed::Archive { reader, dates, window, direction, stride, given, slides, taken, warnings } => {
                if *given == *slides {
                    return Ok(None);
                }
                let start = Instant::now();
                while !(window.is_full() && (*given == 0 || *taken >= *stride)) {
                    let snapshot = loop {
                        if stop.load(Ordering::Relaxed) {
                            return Ok(None);
                        }
                        match reader.next_within(LOOK_UP) {
                            Ok(Some(snapshot)) => break snapshot,
                            Ok(None) => return Ok(None),
                            Err(StillReading) => {}
                        }
                    };
                    let newest = window.newest();
                    match window.push(snapshot?) {
                        Ok(pushed) => warnings.extend(pushed.warning.map(|w| w.to_string())),
                        Err(fault) => warnings.push(fault.to_string()),
                    }
                    // Only what moves the window counts toward its stride.
                    *taken += usize::from(window.newest() != newest);
                }
                *taken = 0;
                *given += 1;
                let ends = match direction {
                    Direction::Forward => window.oldest(),
                    Direction::Backward => window.newest(),
                };
                let time = ends.ok_or(EngineError::EndedEarly)?;
                Ok(Some(Slide {
                    index: *given - 1,
                    time,
                    date: dates.iter().find(|(t, _)| *t == time).and_then(|(_, date)| date.clone()),
                    live: None,
                    velocity: VelocitySource::Window(Arc::new(window.clone())),
                    warnings: std::mem::take(warnings),
                    waited: start.elapsed().as_secs_f64(),
                }))
            }
            Feed::Live { window, direction, given, slides } => {
                if *given == *slides {
                    return Ok(None);
                }
                let start = Instant::now();
                let taken = loop {
                    if stop.load(Ordering::Relaxed) {
                        return Ok(None);
                    }
                    match window.next_within(LOOK_UP) {
                        Ok(Some(taken)) => break taken?,
                        Ok(None) => return Ok(None),
                        Err(StillReading) => {}
                    }
                };
                *given += 1;
                let ends = match direction {
                    Direction::Forward => taken.window.oldest(),
                    Direction::Backward => taken.window.newest(),
                };
                Ok(Some(Slide {
                    index: *given - 1,
                    time: ends.ok_or(EngineError::EndedEarly)?,
                    date: None,
                    live: Some(taken.live),
                    velocity: VelocitySource::Window(Arc::new(taken.window)),
                    warnings: taken.warnings,
                    waited: start.elapsed().as_secs_f64(),
                }))
            }
        }
    }

    /// The feed of a simulation that runs now.
    pub fn live(scene: &Settings, window: LiveWindow, direction: Direction) -> Self {
        Feed::Live { window, direction, given: 0, slides: scene.time.slides.map_or(u64::MAX, |n| n as u64) }
    }

    /// Slides that will come in all, where that is known.
    pub fn expected_slides(&self, times: Option<&[f64]>, tau: f64) -> Option<u64> {
        match self {
            Feed::Closed { slides, .. } => Some(*slides),
            Feed::Live { slides, .. } => Some(*slides).filter(|n| *n < u64::MAX),
            Feed::Archive { slides, stride, .. } => {
                let times = times?;
                let first = times.iter().position(|t| t - times[0] >= tau * (1.0 - 1e-9))?;
                Some((*slides).min(((times.len() - 1 - first) / *stride + 1) as u64))
            }
        }
    }
}
