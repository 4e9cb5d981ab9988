//! A run holds the window, what is read ahead, and no other snapshot.

#![allow(clippy::unwrap_used)]

use ridgewatch::config::SceneFile;
use ridgewatch::field::Snapshot;
use ridgewatch::run::{Event, RunOptions, Setup, run};
use std::path::Path;
use std::sync::atomic::AtomicBool;
use std::sync::{Arc, Mutex, Weak};

const SCENE: &str = "
[source]
kind = \"turbulence\"
nodes = [12, 8, 8]
snapshots = 24
[time]
tau = 5
[flow]
steps = 4
[surrogate]
kind = \"table\"
[trust]
cells = [2, 2, 2]
[render]
width = 8
height = 4
samples = 1
";

#[test]
fn snapshots_that_have_left_the_window_are_let_go() {
    let scene = SceneFile::parse(Path::new("scene.toml"), SCENE, &[]).unwrap();
    let setup = Setup::new(scene.settings()).unwrap();
    let read: Arc<Mutex<Vec<Weak<Snapshot>>>> = Arc::default();
    let told = read.clone();
    setup.slides.listen(Box::new(move |snapshot| told.lock().unwrap().push(Arc::downgrade(snapshot))));
    let mut held = Vec::new();
    let mut sink = |event: Event| {
        if let Event::Frame(_) = event {
            held.push(read.lock().unwrap().iter().filter(|s| s.strong_count() > 0).count());
        }
    };
    run(setup, &RunOptions { threads: 1, ..RunOptions::default() }, &mut sink, &AtomicBool::new(false)).unwrap();
    assert_eq!(held.len(), 19);
    // Six in the window, two that wait, one in the reader's hands.
    assert!(held.iter().all(|held| *held <= 9), "{held:?}");
    assert_eq!(held.last(), Some(&6), "at the end the window alone: {held:?}");
}
