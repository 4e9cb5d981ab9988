//! Commands to a run that waits for its simulation.

use crate::kit::ring::{Ring, grid, publish};
use crate::kit::scene::parse;
use ridgewatch::run::{Event, FrameRecord, RunOptions, RunReport, Setup, Steering, run};
use ridgewatch::source::live::Live;
use ridgewatch_wire::{Policy, Producer};
use serde_json::json;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::sync::mpsc::{Receiver, RecvTimeoutError, channel};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

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

/// A run of this many slides, with its producer and the commands to it.
type Following = (Producer, Arc<Steering>, Receiver<Arc<FrameRecord>>, JoinHandle<RunReport>, Ring);

fn follow(name: &str, keys: &[&str]) -> Following {
    let ring = Ring::new(name);
    let producer = Producer::open(&ring.0, grid(&[16, 16]), 8, Policy::NewestWins).unwrap();
    simulate(&producer, 0..4);
    let key = format!("live.ring=\"{}\"", Path::new(&ring.0).display());
    let scene = parse(SCENE, &[keys, &[&key]].concat()).unwrap();
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
    (producer, steering, frames, running, ring)
}

/// The simulation goes on, and nothing more is wanted of it.
#[test]
fn a_run_of_so_many_slides_ends_with_the_last_one() {
    let (producer, _steering, frames, running, _ring) = follow("steering-ends", &["time.slides=1"]);
    assert_eq!(frames.recv_timeout(Duration::from_secs(60)).unwrap().slide, 0);
    // Until it ends the channel is open.
    assert_eq!(frames.recv_timeout(Duration::from_secs(60)).unwrap_err(), RecvTimeoutError::Disconnected);
    assert_eq!(running.join().unwrap().slides, 1);
    drop(producer);
}

/// Training between two steps would go on for a minute.
#[test]
fn a_command_interrupts_the_training_between_two_steps() {
    let keys =
        ["surrogate.kind=network", "render.method=gated", "training.seconds_per_frame=60", "network.width=16", "network.log2_table=8"];
    let (producer, steering, frames, running, _ring) = follow("steering-trains", &keys);
    let next = || frames.recv_timeout(Duration::from_secs(120)).unwrap();
    next();
    std::thread::sleep(Duration::from_millis(500));
    let begin = Instant::now();
    steering.command(json!({"trust.tolerance": 0.2}).as_object().unwrap()).unwrap();
    assert_eq!(next().commands.len(), 1);
    assert!(begin.elapsed() < Duration::from_secs(20), "{:?}", begin.elapsed());
    drop(producer);
    drop(frames);
    // The channel is closed, so that a further frame ends the thread.
    let _ = running.join();
}

#[test]
fn a_command_gets_a_frame_while_the_simulation_is_awaited() {
    let (producer, steering, frames, running, _ring) = follow("steering", &[]);
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
    while let Ok(record) = frames.recv_timeout(Duration::from_millis(500)) {
        assert_eq!(record.slide, paused);
    }
    if paused < 2 {
        // The step of the next window is there.
        simulate(&producer, 6..7);
        assert!(frames.recv_timeout(Duration::from_millis(500)).is_err(), "the window stands still");
    }
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
