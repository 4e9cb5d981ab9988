//! Slides that are read once and shown to many runs.

use super::picture::with_method;
use crate::render::Method;
use crate::run::{RunError, Settings, Setup, Slide, Slides};
use crate::surrogate::Kind;
use std::collections::VecDeque;
use std::sync::atomic::AtomicBool;

/// The first slides of a scene, which share their snapshots.
pub(super) struct FirstSlides(Vec<Slide>);

impl FirstSlides {
    /// Reads `count` slides, or as many as the source has.
    ///
    /// # Errors
    /// The source cannot be opened or has no slide.
    pub(super) fn read(settings: &Settings, count: usize, stop: &AtomicBool) -> Result<Self, RunError> {
        // The method plays no part, and `auto` is none.
        let mut settings = with_method(settings, Method::Reference, Kind::Table);
        settings.time.slides = Some(count);
        let mut setup = Setup::new(settings)?;
        let mut slides = Vec::new();
        while let Some(slide) = setup.slides.next_slide(stop)? {
            slides.push(Slide { waited: 0.0, ..slide });
        }
        if slides.is_empty() { Err(RunError::EndedEarly) } else { Ok(Self(slides)) }
    }

    /// The first slide.
    pub(super) fn first(&self) -> &Slide {
        &self.0[0]
    }

    /// Number of slides.
    pub(super) fn count(&self) -> usize {
        self.0.len()
    }

    /// Sets up a run over these slides, from number `from` on.
    ///
    /// # Errors
    /// A setting is not accepted, or the source cannot be opened.
    pub(super) fn setup(&self, settings: Settings, from: usize) -> Result<Setup, RunError> {
        let mut setup = Setup::new(settings)?;
        setup.slides = Box::new(Again(self.0[from..].iter().cloned().collect()));
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
