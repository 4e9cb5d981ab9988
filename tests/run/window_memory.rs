//! A run holds the window, the snapshots that are read ahead, and no other snapshot.

use crate::kit::scene;
use ridgewatch::field::Snapshot;
use ridgewatch::run::RunOptions;
use std::sync::{Arc, Mutex, Weak};

#[test]
fn snapshots_that_have_left_the_window_are_dropped() {
    let keys = "
        source.nodes = [12, 8, 8]
        source.snapshots = 24
        time.tau = 5
        flow.steps = 4
        surrogate.kind = \"table\"
        trust.cells = [2, 2, 2]
    ";
    let setup = scene::setup(&scene::scene("turbulence", [8, 4, 1], keys), &[]);
    let read: Arc<Mutex<Vec<Weak<Snapshot>>>> = Arc::default();
    let told = read.clone();
    setup.slides.listen(Box::new(move |snapshot| told.lock().unwrap().push(Arc::downgrade(snapshot))));
    let mut held = Vec::new();
    scene::run_frames(setup, &RunOptions { threads: 1, ..RunOptions::default() }, |_| {
        held.push(read.lock().unwrap().iter().filter(|s| s.strong_count() > 0).count());
    });
    assert_eq!(held.len(), 19);
    // Six in the window, two in the queue, one in the reader.
    assert!(held.iter().all(|held| *held <= 9), "{held:?}");
    assert_eq!(held.last(), Some(&6), "only the window at the end: {held:?}");
}
