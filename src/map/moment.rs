//! The moment that a map shows: one seed time, with the velocity that all its integrations need.

use super::MapError;
use crate::field::Window;
use crate::flow::{FlowMap, VelocitySource};
use crate::render::Method;
use crate::run::{Plan, Settings, Setup, TimeSpan};
use crate::source::SourceKind;
use crate::surrogate::Kind;
use std::sync::atomic::AtomicBool;

/// A seed time and its velocity.
pub struct Moment {
    /// The scene with all settings chosen; `plan.map.tau` is the longest tau.
    pub plan: Plan,
    /// The velocity, over the longest tau; over twice that if both directions are shown.
    pub velocity: VelocitySource,
    /// Seed time.
    pub time: f64,
    /// `time` as a date; `None` if the source has no calendar, or counts snapshots and has none at that time.
    pub date: Option<String>,
    /// |tau| of each panel, in time units.
    pub taus: Vec<f64>,
    /// Remarks for the user.
    pub notes: Vec<String>,
}

impl Moment {
    /// Reads slide `number` of a scene. `taus`: durations of the panels; none for that of the scene. `both`: the window spans tau on both sides of
    /// the seed time, which is the time of the snapshot nearest to its middle.
    ///
    /// # Errors
    /// A duration is not accepted, the source cannot be opened, has fewer slides, or is shorter than the window.
    pub fn read(mut settings: Settings, taus: &[TimeSpan], both: bool, number: u64) -> Result<Self, MapError> {
        // A map has no surrogate, and `auto` is no method.
        (settings.render.method, settings.render.until, settings.render.budget) = (Method::Reference, None, None);
        settings.render.samples = settings.render.samples.ceil().max(1.0);
        (settings.surrogate.kind, settings.surrogate.table_nodes, settings.training.resume) = (Kind::Table, None, None);
        (settings.network.inputs, settings.network.start_range) = (Vec::new(), None);
        let mut values = Vec::new();
        for tau in taus {
            let value = tau.value().filter(|value| value.is_finite() && *value > 0.0);
            values.push(value.ok_or_else(|| {
                let shown = match tau {
                    TimeSpan::Number(n) => n.to_string(),
                    TimeSpan::Words(words) => words.clone(),
                };
                MapError::Usage(format!("--tau {shown}: accepted: durations above 0, such as 7200 or \"30 days\", divided by commas"))
            })?);
        }
        if let Some(longest) = (0..taus.len()).max_by(|a, b| values[*a].total_cmp(&values[*b])) {
            settings.time.tau = Some(taus[longest].clone());
        }
        let mut setup = Setup::new(settings.clone())?;
        let tau = setup.plan.map.tau;
        let notes = std::mem::take(&mut setup.notes);
        let gridded = matches!(setup.plan.scene.source.kind, SourceKind::Archive | SourceKind::Turbulence);
        let mut slides = if both && gridded {
            settings.time.tau = Some(TimeSpan::Number(2.0 * tau));
            Setup::new(settings).map_err(|error| MapError::Both { tau, error })?.slides
        } else {
            setup.slides
        };
        let mut slide = None;
        let few = |there: u64| {
            MapError::Usage(format!("--slide {number}: the source has fewer slides: {there}, counted from 0 (time.slides limits them)"))
        };
        // Before any work.
        if let Some(there) = slides.expected().filter(|there| number >= *there) {
            return Err(few(there));
        }
        for index in 0..=number {
            slide = slides.next_slide(&AtomicBool::new(false))?;
            if slide.is_none() {
                return Err(few(index));
            }
        }
        let slide = slide.ok_or_else(|| MapError::Usage("the source gave no slide".into()))?;
        let (mut time, mut date) = (slide.time, slide.date);
        if let VelocitySource::Window(window) = &slide.velocity
            && both
            && let Some(seed) = seed_of_both(window, tau)
        {
            time = seed;
            date = slides.date(time).or_else(|| setup.plan.georeference.date(time));
        }
        let taus = if values.is_empty() { vec![tau] } else { values };
        Ok(Self { plan: setup.plan, velocity: slide.velocity, time, date, taus, notes })
    }

    /// The flow map of a panel.
    pub fn map(&self, tau: f64) -> FlowMap {
        FlowMap { tau, ..self.plan.map.clone() }
    }
}

/// Seed time of both directions in a window over twice tau: that of the snapshot nearest to its middle. `None` if the window is empty.
pub(super) fn seed_of_both(window: &Window, tau: f64) -> Option<f64> {
    let (oldest, newest) = (window.oldest()?, window.newest()?);
    let slack = 1e-9 * tau;
    let middle = (newest - tau).max(oldest + tau);
    let inside = |t: &f64| *t >= oldest + tau - slack && *t <= newest - tau + slack;
    let near = window.snapshots().map(|s| s.time).filter(inside).min_by(|a, b| (a - middle).abs().total_cmp(&(b - middle).abs()));
    Some(near.unwrap_or(middle))
}
