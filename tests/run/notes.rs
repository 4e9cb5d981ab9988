//! What a run says of a window that holds more than the scene needs.

use crate::kit::scene;
use ridgewatch::field::{Snapshot, Window};
use ridgewatch::flow::VelocitySource;
use ridgewatch::run::{Event, RunError, RunOptions, Setup, Slide, Slides, run};
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

static NEVER: AtomicBool = AtomicBool::new(false);

/// One slide.
pub(super) struct Single(pub(super) Option<Slide>);

impl Slides for Single {
    fn next_slide(&mut self, _: &AtomicBool) -> Result<Option<Slide>, RunError> {
        Ok(self.0.take())
    }

    fn expected(&self) -> Option<u64> {
        Some(1)
    }
}

fn turbulence(keys: &str) -> Setup {
    turbulence_by("reference", keys)
}

fn turbulence_by(method: &str, keys: &str) -> Setup {
    let keys = format!("{keys}\nsource.nodes = [24, 12, 12]\ntime.slides = 1\ntime.frames_per_slide = 1\nrender.method = \"{method}\"\n");
    scene::setup(&scene::scene("turbulence", [16, 8, 1], &keys), &[])
}

fn notes(setup: Setup) -> Vec<String> {
    let mut notes = Vec::new();
    let mut sink = |event: Event| {
        if let Event::Note(text) = event {
            notes.push(text);
        }
    };
    run(setup, &RunOptions::default(), &mut sink, &NEVER).unwrap();
    notes
}

fn has(notes: &[String], words: &str) -> bool {
    notes.iter().any(|note| note.contains(words))
}

#[test]
fn half_of_the_snapshots_would_do_where_they_change_little() {
    const SLOW: &str = "source.amplitude = 0.2\nsource.snapshots = 61\ntime.tau = 60";
    let slow = notes(turbulence(SLOW));
    assert!(has(&slow, "fine in time: without every second snapshot the FTLE changes by 0."), "{slow:?}");
    let compared = notes(turbulence_by("two_level", SLOW));
    assert!(!has(&compared, "fine in time"), "the decision `time.every` tells what the picture loses: {compared:?}");
    let fast = notes(turbulence("source.amplitude = 3\nsource.snapshots = 9\ntime.tau = 8"));
    assert!(!has(&fast, "fine in time"), "{fast:?}");
}

#[test]
fn a_window_whose_levels_are_alike_is_told() {
    let keys = "source.snapshots = 9\ntime.tau = 8";
    let flat = |lifts: bool| {
        let mut setup = turbulence(keys);
        let mut slide = setup.slides.next_slide(&NEVER).unwrap().unwrap();
        let VelocitySource::Window(window) = &slide.velocity else { panic!("a window") };
        let mut alike = Window::new(window.span());
        for snapshot in window.snapshots() {
            let plane = 24 * 12;
            let lift = if lifts { 1e-3 } else { 0.0 };
            let nodes = (0..snapshot.nodes.len()).map(|i| snapshot.nodes[i % plane]).map(|[u, v, _, mark]| [u, v, lift, mark]).collect();
            alike.push(Arc::new(Snapshot::new(snapshot.time, snapshot.grid.clone(), nodes))).unwrap();
        }
        slide.velocity = VelocitySource::Window(Arc::new(alike));
        notes(Setup { slides: Box::new(Single(Some(slide))), ..setup })
    };
    let words = "all levels of the first window have the same velocity";
    assert!(has(&flat(false), words));
    assert!(!has(&flat(true), words), "something crosses them");
    assert!(!has(&notes(turbulence(keys)), words));
}
