//! Commands to a run that waits for its simulation.

use crate::kit::ring::{Ring, grid, publish};
use crate::kit::scene::parse;
use ridgewatch::run::{Event, RunOptions, Setup, Steering, run};
use ridgewatch::source::live::Live;
use ridgewatch_wire::{Policy, Producer};
use serde_json::json;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::sync::mpsc::channel;
use std::time::Duration;

const SCENE: &str = "
    source.kind = \"live\"
    live.at_end = \"stop\"
    live.follow = \"every\"
    time.tau = 3
    flow.steps = 8
    surrogate.kind = \"table\"
    render.method = \"reference\"
    render.width = 32
    render.height = 32
    render.samples = 1
    transfer.low = 0.1
    transfer.high = 1
";

/// Steps of a flow that turns.
fn simulate(producer: &Producer, steps: std::ops::Range<u64>) {
    for step in steps {
        let at = |i: usize| ((i % 16) as f32 - 7.5, (i / 16) as f32 - 7.5);
        let [u, v]: [Vec<f32>; 2] = [(0..256).map(|i| -0.1 * at(i).1).collect(), (0..256).map(|i| 0.1 * at(i).0).collect()];
        publish(producer, step, step as f64, &[&u, &v]);
    }
}

#[test]
fn a_command_gets_a_frame_while_the_simulation_is_awaited() {
    let ring = Ring::new("steering");
    let producer = Producer::open(&ring.0, grid(&[16, 16]), 8, Policy::NewestWins).unwrap();
    simulate(&producer, 0..4);
    let key = format!("live.ring=\"{}\"", Path::new(&ring.0).display());
    let scene = parse(SCENE, &[&key]).unwrap();
    let live = Live::connect(&scene.live, &AtomicBool::new(false), &mut |_| {}).unwrap().unwrap();
    let setup = Setup::live(scene.settings(), live).unwrap();
    let steering = Arc::new(Steering::new(&setup.plan));
    let options = RunOptions { steering: Some(Arc::clone(&steering)), threads: 2, ..RunOptions::default() };
    let (made, frames) = channel();
    let running = std::thread::spawn(move || {
        let mut sink = |event: Event| {
            if let Event::Frame(frame) = event {
                made.send(frame.record).unwrap();
            }
        };
        run(setup, &options, &mut sink, &AtomicBool::new(false)).unwrap()
    });
    let next = || frames.recv_timeout(Duration::from_secs(60)).unwrap();
    let command = |set: serde_json::Value| {
        steering.command(set.as_object().unwrap()).unwrap();
    };
    let first = next();
    assert_eq!((first.slide, first.commands.len()), (0, 0));
    // No step comes: without a command there is no frame, and with one there is.
    assert!(frames.recv_timeout(Duration::from_millis(500)).is_err());
    for number in 1..4u32 {
        command(json!({"trust.tolerance": 0.01 * f64::from(number)}));
        let record = next();
        assert_eq!((record.slide, record.frame, record.commands[0].number), (0, u64::from(number), u64::from(number)));
    }
    // A step comes, and the window moves on by itself; paused it does not.
    simulate(&producer, 4..5);
    assert_eq!(next().slide, 1);
    command(json!({"paused": true}));
    simulate(&producer, 5..6);
    let record = next();
    assert!(record.slide <= 2);
    let paused = record.slide;
    command(json!({"paused": false}));
    let last = loop {
        let record = next();
        if record.slide > paused || record.live.as_ref().is_some_and(|live| live.step == 5) {
            break record;
        }
    };
    assert_eq!(last.live.as_ref().unwrap().step, 5);
    drop(producer);
    assert!(running.join().unwrap().frames >= 6);
}
