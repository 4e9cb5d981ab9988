//! Maps of the slides of a simulation in two dimensions.

use crate::ALONE;
use crate::kit::program::{self, LONG, Outcome, Running, json, set, start, summary, text, until};
use crate::kit::ring::{self, Ring, grid};
use ridgewatch_wire::{Policy, Producer};
use serde_json::Value;
use std::path::PathBuf;
use std::sync::RwLockWriteGuard;

/// Nodes along x and y, over one metre each.
const NODES: [u64; 2] = [24, 16];

/// A saddle of rate 1/10 around the middle of the plane, and the sidecar that follows it with tau = 2 and ends with it.
struct Saddle {
    solver: Producer,
    sidecar: Running,
    out: PathBuf,
    _ring: Ring,
    _files: tempfile::TempDir,
    _alone: RwLockWriteGuard<'static, ()>,
}

impl Saddle {
    fn follow(name: &str, keys: &[&str]) -> Self {
        let alone = ALONE.write().unwrap_or_else(|broken| broken.into_inner());
        let (files, ring) = (tempfile::tempdir().unwrap(), Ring::new(&format!("maps-{name}")));
        let out = files.path().join("run");
        let attach = ["attach", text(&ring.0), "--tau", "2", "--exit-at-end", "--out", text(&out), "--device", "cpu", "--threads", "2"];
        let common = set(&["render.width=48", "render.height=32", "flow.steps=16", "flow.interpolation=linear", "live.memory_gib=0.01"]);
        let sidecar = start(&mut program::ridgewatch([&attach[..], &common, &set(keys)].concat()));
        until("the folder of the ring", || ring.0.join("followers.lock").exists());
        let solver = Producer::open(&ring.0, grid(&NODES), 8, Policy::Wait(LONG)).unwrap();
        Self { solver, sidecar, out, _ring: ring, _files: files, _alone: alone }
    }

    /// Publishes a step of each second.
    fn publish(&self, steps: std::ops::Range<u64>) {
        let [nx, ny] = NODES;
        let along = |at: u64, nodes: u64| 0.1 * (at as f32 / (nodes - 1) as f32 - 0.5);
        let nodes = || (0..nx * ny).map(|node| [node % nx, node / nx]);
        let u: Vec<f32> = nodes().map(|[i, _]| along(i, nx)).collect();
        let v: Vec<f32> = nodes().map(|[_, j]| -along(j, ny)).collect();
        for step in steps {
            ring::publish(&self.solver, step, step as f64, &[&u, &v]);
        }
    }

    /// The record of the map of a slide, once it is there.
    fn map(&self, slide: u64) -> Value {
        let file = self.out.join(format!("maps/slide_{slide:06}.json"));
        until("a map", || file.exists());
        assert!(file.with_extension("png").exists());
        json(&file)
    }

    /// Ends the simulation, and with it the run. Its outcome, the slides with maps, and the summary's counts of maps written and dropped.
    fn end(self) -> (Outcome, Vec<String>, [u64; 2]) {
        let Self { solver, sidecar, out, _files, .. } = self;
        drop(solver);
        let outcome = sidecar.wait().success();
        let entries = std::fs::read_dir(out.join("maps")).unwrap().map(|entry| entry.unwrap().file_name().into_string().unwrap());
        let mut slides: Vec<String> = entries.filter_map(|name| name.strip_suffix(".png").map(str::to_owned)).collect();
        slides.sort();
        let files = &summary(&out)["files"];
        (outcome, slides, ["maps_written", "maps_dropped"].map(|key| files[key].as_u64().unwrap()))
    }
}

#[test]
fn each_slide_of_a_slow_simulation_has_a_map() {
    let saddle = Saddle::follow("slow", &[]);
    saddle.publish(0..3);
    let first = saddle.map(0);
    saddle.publish(3..4);
    let second = saddle.map(1);
    for (record, time) in [(&first, 2.0), (&second, 3.0)] {
        assert_eq!((&record["time"], &record["date"], &record["ftle_unit"]), (&time.into(), &Value::Null, &"1/s".into()));
        assert!(record["source"].as_str().unwrap().contains("running simulation"), "{record}");
        let panel = &record["panels"][0];
        assert_eq!((&panel["direction"], &panel["tau"], &panel["ridge_lines"]), (&"backward".into(), &2.0.into(), &Value::Null));
        // The rate of the saddle, wherever particles do not leave the plane.
        assert!((panel["ftle"][2].as_f64().unwrap() - 0.1).abs() < 1e-3, "{panel}");
    }
    assert_eq!(first["range"], second["range"]);
    let (outcome, slides, counts) = saddle.end();
    assert!(outcome.stdout.contains("a map of each slide in"), "{}", outcome.stdout);
    assert_eq!((slides, counts), (vec!["slide_000000".to_owned(), "slide_000001".to_owned()], [2, 0]));
}

/// The next step is read while the frame of the first slide is drawn, for a second or so, and is held until its slide is taken.
#[test]
fn a_simulation_that_waits_for_slides_waits_for_no_map() {
    let saddle = Saddle::follow("held", &["live.follow=every", "render.samples=64", "render.width=96", "render.height=64"]);
    saddle.publish(0..4);
    saddle.map(1);
    let (outcome, slides, counts) = saddle.end();
    assert_eq!((slides, counts), (vec!["slide_000001".to_owned()], [1, 1]), "the last slide has nothing to wait for");
    assert!(outcome.stderr.contains("the next window was complete before theirs was drawn"), "{}", outcome.stderr);
    assert!(outcome.stdout.contains("maps of 1 of 2 slides in"), "{}", outcome.stdout);
}

#[test]
fn both_directions_of_a_simulation_are_shown_once_twice_tau_is_known() {
    let saddle = Saddle::follow("both", &["live.follow=every", "maps.both=true", "maps.arrows=true", "maps.contour=[0.05]"]);
    saddle.publish(0..5);
    let record = saddle.map(2);
    assert_eq!(record["time"], 2.0, "tau before the newest step");
    let directions: Vec<&Value> = record["panels"].as_array().unwrap().iter().map(|panel| &panel["direction"]).collect();
    assert_eq!(directions, ["forward", "backward"]);
    for panel in record["panels"].as_array().unwrap() {
        assert!((panel["ftle"][2].as_f64().unwrap() - 0.1).abs() < 1e-3, "{panel}");
    }
    // Arrows are drawn at some of the nodes; the speed is 0.0707 m/s in the corners.
    let fastest = record["fastest"].as_f64().unwrap();
    assert!(fastest > 0.025 && fastest < 0.0708, "{fastest}");
    let (outcome, slides, counts) = saddle.end();
    assert_eq!((slides, counts), (vec!["slide_000002".to_owned()], [1, 0]));
    assert!(outcome.stderr.contains("begin when twice tau of snapshots are known"), "{}", outcome.stderr);
}
