//! Slides that are read once and shown to many runs, each of which still opens the source.

use super::with_method;
use crate::flow::VelocitySource;
use crate::render::Method;
use crate::run::{RunError, Settings, Setup, Slide, Slides, TimeSpan};
use crate::surrogate::Kind;
use ridgewatch_base::memory;
use std::collections::VecDeque;
use std::sync::atomic::AtomicBool;

/// The first slides of a scene, which share their snapshots.
pub(super) struct FirstSlides {
    slides: Vec<Slide>,
    /// Why there are no more.
    end: String,
    /// |tau|, in time units of the source.
    tau: f64,
}

impl FirstSlides {
    /// Reads `count` slides, or as many as the source has and as half of the free memory holds.
    ///
    /// # Errors
    /// The source cannot be opened or has no slide.
    pub(super) fn read(settings: &Settings, count: usize, stop: &AtomicBool) -> Result<Self, RunError> {
        // The method plays no part, and `auto` is none.
        let mut settings = with_method(settings, Method::Reference, Kind::Table);
        settings.time.slides = Some(count);
        let mut setup = Setup::new(settings)?;
        let first = setup.slides.next_slide(stop)?.ok_or(RunError::EndedEarly)?;
        let per_slide = match &first.velocity {
            VelocitySource::Window(window) => {
                let snapshots = window.snapshots().count().max(1) as u64;
                window.bytes() as u64 / snapshots * setup.plan.scene.time.snapshots_per_slide as u64
            }
            VelocitySource::Analytic(..) => 0,
        };
        let (mut slides, mut end) = (vec![Slide { waited: 0.0, ..first }], "the source has no more".to_owned());
        while slides.len() < count {
            if memory::available().is_some_and(|free| per_slide > free / 2) {
                end = format!("another takes {:.1} GiB of memory, more than half of what is free", memory::gib(per_slide));
                break;
            }
            match setup.slides.next_slide(stop) {
                Ok(Some(slide)) => slides.push(Slide { waited: 0.0, ..slide }),
                Ok(None) => break,
                // The slides before it can be charted.
                Err(error) => {
                    end = error.to_string();
                    break;
                }
            }
        }
        Ok(Self { slides, end, tau: setup.plan.map.tau })
    }

    /// The settings with the tau of these slides, so that it is not chosen again.
    pub(super) fn settled(&self, settings: &Settings) -> Settings {
        let mut settings = settings.clone();
        settings.time.tau = Some(TimeSpan::Number(self.tau));
        settings
    }

    /// Why there are fewer slides than were asked for.
    pub(super) fn end(&self) -> &str {
        &self.end
    }

    /// The first slide.
    pub(super) fn first(&self) -> &Slide {
        &self.slides[0]
    }

    /// Number of slides.
    pub(super) fn count(&self) -> usize {
        self.slides.len()
    }

    /// Sets up a run over these slides, from number `from` on.
    ///
    /// # Errors
    /// A setting is not accepted, or the source cannot be opened.
    pub(super) fn setup(&self, settings: Settings, from: usize) -> Result<Setup, RunError> {
        let mut setup = Setup::new(settings)?;
        setup.slides = Box::new(Again(self.slides[from..].iter().cloned().collect()));
        Ok(setup)
    }
}

/// Slides that are still to be shown.
struct Again(VecDeque<Slide>);

impl Slides for Again {
    fn next_slide(&mut self, _: &AtomicBool) -> Result<Option<Slide>, RunError> {
        Ok(self.0.pop_front())
    }

    fn expected(&self) -> Option<u64> {
        Some(self.0.len() as u64)
    }
}
