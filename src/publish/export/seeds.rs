//! The FTLE of seeds on a grid, and of the slide that a run shows.

use super::{Field, FieldExport, FieldFormat, FieldFrame, NoField};
use crate::field::{Domain, DomainPoint, UnitPoint, Window};
use crate::flow::{Extras, Traced, Tracer, VelocitySource, cpu_tracer};
use crate::run::{Plan, ShownSlide, Slide};
use crate::source::utc;
use ridgewatch_base::memory::{available, gib};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, Weak};
use std::time::{Duration, Instant};

/// Most seeds of a field that is traced beside a run, in all and along an axis.
const MOST_SEEDS: usize = 1 << 22;
const MOST_ALONG: usize = 1 << 16;
/// Seeds of a closed form.
const CLOSED_FORM_SEEDS: f64 = 524_288.0;
/// Time for which the windows of new slides are kept for who has asked between two slides.
const ASKED_FOR: Duration = Duration::from_secs(15);
/// Most seeds traced at once, after which progress is told.
const AT_ONCE: usize = 1 << 14;

/// Seeds on a grid from edge to edge of the domain, x fastest; in its middle along an axis of one seed.
pub fn seeds(domain: &Domain, [nx, ny, nz]: [usize; 3]) -> Vec<DomainPoint> {
    let at = |i: usize, n: usize| if n > 1 { i as f32 / (n - 1) as f32 } else { 0.5 };
    (0..nx * ny * nz).map(|i| domain.from_unit(UnitPoint([at(i % nx, nx), at(i / nx % ny, ny), at(i / (nx * ny), nz)]))).collect()
}

/// What was traced from seeds, as a field; arrays have one value a seed.
#[derive(Debug)]
pub struct SeedField {
    /// FTLE in 1/time, in the precision of its integration; NaN without a velocity.
    pub ftle: Vec<f64>,
    /// Share of tau until the particle stopped.
    pub lifetime_share: Vec<f32>,
    /// Whether the seed has no velocity.
    pub missing: Vec<bool>,
    /// Difference of the log-stretch from twice as many steps; `None` if the steps were given.
    pub difference_of_steps: Option<f64>,
    time: f64,
    tau: f64,
    steps: usize,
}

impl SeedField {
    /// Of what `tracer` found.
    pub fn new(tracer: &dyn Tracer, seeds: &[DomainPoint], traced: Traced) -> Self {
        let tau = tracer.tau();
        let missing: Vec<bool> = seeds.iter().map(|seed| tracer.is_missing(*seed)).collect();
        let stretch = traced.unrounded();
        let ftle = stretch.iter().zip(&missing).map(|(s, &missing)| if missing { f64::NAN } else { s / tau }).collect();
        Self {
            ftle,
            lifetime_share: traced.lifetime_share,
            missing,
            difference_of_steps: tracer.step_choice().map(|chosen| chosen.difference).filter(|difference| difference.is_finite()),
            time: tracer.start(),
            tau,
            steps: tracer.steps(),
        }
    }

    /// As it is written, with the error of each seed where it is known.
    pub fn field<'a>(&'a self, error: Option<&'a [f64]>) -> Field<'a> {
        Field {
            time: self.time,
            ftle: &self.ftle,
            lifetime_share: &self.lifetime_share,
            missing: &self.missing,
            error,
            error_of_steps: self.difference_of_steps.map(|difference| difference / self.tau),
            steps: self.steps,
        }
    }
}

/// The slide that a run shows, for those who want its field. Its window is kept as long as the run has it, or somebody waits for it.
#[derive(Debug)]
pub struct NewestSlide {
    plan: Plan,
    state: Mutex<State>,
}

#[derive(Debug, Default)]
struct State {
    kept: Option<Kept>,
    /// When somebody last asked between two slides.
    asked: Option<Instant>,
}

#[derive(Debug)]
struct Kept {
    index: u64,
    time: f64,
    date: Option<String>,
    velocity: KeptVelocity,
    plan: Plan,
}

#[derive(Debug)]
enum KeptVelocity {
    /// A window that the run gives up when it reads the next one.
    Borrowed(Weak<Window>),
    /// A closed form, or a window that is kept for who asked.
    Owned(VelocitySource),
}

impl NewestSlide {
    /// Of a run that has none yet.
    pub fn new(plan: &Plan) -> Self {
        Self { plan: plan.clone(), state: Mutex::default() }
    }

    /// Keeps this slide in place of the one before, with its window if somebody has asked for one meanwhile.
    pub fn put(&self, shown: &ShownSlide) {
        let ShownSlide { slide, asked, .. } = shown;
        let plan = Plan { map: asked.clone(), ..self.plan.clone() };
        let mut state = self.lock();
        let velocity = match &slide.velocity {
            VelocitySource::Window(window)
                if state.asked.is_none_or(|asked| asked.elapsed() > ASKED_FOR) || check_room(window).is_err() =>
            {
                KeptVelocity::Borrowed(Arc::downgrade(window))
            }
            velocity => KeptVelocity::Owned(velocity.clone()),
        };
        state.kept = Some(Kept { index: slide.index, time: slide.time, date: slide.date.clone(), velocity, plan });
    }

    /// Number of the slide that is kept.
    pub fn index(&self) -> Option<u64> {
        self.lock().kept.as_ref().map(|kept| kept.index)
    }

    /// The slide of this number, or the newest one, to be traced. Its window is kept as long as what is returned. `Ok(None)`: the run reads its next
    /// slide, which is kept for who asks again within 15 seconds.
    ///
    /// # Errors
    /// The run shows another slide or none, or there is no memory for a window beside those of the run.
    pub fn get(&self, wanted: Option<u64>) -> Result<Option<SlideField>, NoField> {
        let mut state = self.lock();
        let state = &mut *state;
        let kept = state.kept.as_mut().ok_or_else(|| NoField::Missing("no frame is complete yet".to_owned()))?;
        let index = kept.index;
        if let Some(wanted) = wanted.filter(|wanted| *wanted != index) {
            return Err(NoField::Gone(format!("slide {wanted} is no longer kept: the run shows slide {index}")));
        }
        let velocity = match &kept.velocity {
            KeptVelocity::Owned(velocity) => velocity.clone(),
            KeptVelocity::Borrowed(window) => match window.upgrade() {
                Some(window) => VelocitySource::Window(window),
                None if wanted.is_none() => {
                    state.asked = Some(Instant::now());
                    return Ok(None);
                }
                None => return Err(NoField::Gone(format!("slide {index} is no longer kept: the run reads the next one"))),
            },
        };
        state.asked = None;
        if let VelocitySource::Window(window) = &velocity {
            kept.velocity = KeptVelocity::Borrowed(Arc::downgrade(window));
            check_room(window)?;
        }
        let slide = Slide { index, time: kept.time, date: kept.date.clone(), live: None, velocity, warnings: Vec::new(), waited: 0.0 };
        Ok(Some(SlideField { plan: kept.plan.clone(), slide }))
    }

    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Checks that a window can be kept beside those of the run.
fn check_room(window: &Window) -> Result<(), NoField> {
    match available() {
        Some(free) if window.bytes() as u64 > free / 2 => {
            let (window, free) = (gib(window.bytes() as u64), gib(free));
            let why = format!(
                "its window may have to be kept beside those of the run: {window:.2} GiB, and {free:.2} GiB are free; accepted: half"
            );
            Err(NoField::NoRoom(why))
        }
        _ => Ok(()),
    }
}

/// A slide whose field can be traced.
pub struct SlideField {
    plan: Plan,
    slide: Slide,
}

impl SlideField {
    /// Number of the slide.
    pub fn index(&self) -> u64 {
        self.slide.index
    }

    /// Seeds along each axis: the nodes of the data, or fewer in proportion, and evenly spaced ones of a closed form.
    fn grid(&self) -> [usize; 3] {
        let domain = &self.plan.domain;
        let dimensions = domain.dimensions;
        let shape = match &self.slide.velocity {
            VelocitySource::Window(window) => window.grid().map(|grid| grid.shape()),
            VelocitySource::Analytic(..) => None,
        };
        let in_proportion = |lengths: [f64; 3], most: f64| {
            let share = (most / lengths[..dimensions].iter().product::<f64>()).powf(1.0 / dimensions as f64);
            std::array::from_fn(|k| if k < dimensions { ((lengths[k] * share) as usize).clamp(2, MOST_ALONG) } else { 1 })
        };
        match shape {
            Some(shape) if shape.iter().product::<usize>() <= MOST_SEEDS => shape,
            Some(shape) => in_proportion(shape.map(|n| n as f64), MOST_SEEDS as f64),
            None => in_proportion(domain.lengths(), CLOSED_FORM_SEEDS),
        }
    }

    /// Traces the field on the threads of the caller, and returns the NetCDF file. Calls `progress` with the seeds traced and those in all; once it
    /// returns false, the work ends.
    ///
    /// # Errors
    /// The flow map cannot be integrated, the work was ended, or the system refuses.
    pub fn netcdf(&self, run: &str, progress: &mut dyn FnMut(usize, usize) -> bool) -> Result<Vec<u8>, NoField> {
        let Self { plan, slide } = self;
        let system = |error: &dyn std::fmt::Display| NoField::System(error.to_string());
        let grid = self.grid();
        let seeds = seeds(&plan.domain, grid);
        let tracer = cpu_tracer(slide.velocity.clone(), &plan.map, slide.time).map_err(|error| system(&error))?;
        let (mut traced, mut part) = (Traced::default(), Traced::default());
        for some in seeds.chunks(AT_ONCE) {
            if !progress(traced.log_stretch.len(), seeds.len()) {
                return Err(NoField::Gone("nobody asks for it any more".to_owned()));
            }
            tracer.trace(some, Extras::default(), &mut part);
            traced.append(&mut part);
        }
        progress(seeds.len(), seeds.len());
        let history = format!("{} ridgewatch: slide {} of {run}", utc(std::time::SystemTime::now()), slide.index);
        let frame = FieldFrame::new(plan, slide, grid, history, None);
        let folder = tempfile::tempdir().map_err(|error| system(&error))?;
        let path = folder.path().join("field.nc");
        let write = || {
            let mut export = FieldExport::create(&path, FieldFormat::NetCdf, frame, false)?;
            export.add(&SeedField::new(&*tracer, &seeds, traced).field(None))?;
            export.finish()
        };
        write().map_err(|error| system(&error))?;
        std::fs::read(&path).map_err(|error| system(&error))
    }
}
