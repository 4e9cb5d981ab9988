//! Start time and duration as inputs of the network: prediction for several windows, and their use in a run.

#![allow(clippy::unwrap_used)]

mod kit;
mod network_support;

use kit::scene;
use network_support::{DoubleGyre, rms, traced, uniform_points};
use ridgewatch::field::Domain;
use ridgewatch::field::analytic::Analytic;
use ridgewatch::flow::{FlowMap, Tracer, VelocitySource, cpu_tracer};
use ridgewatch::run::{FrameRecord, RunOptions, Setup};
use ridgewatch::surrogate::network::{Input, NetworkSettings, Times};
use ridgewatch::surrogate::{Kind, Predict, ReplayBuffer, SurrogateSettings, build};

const SETTINGS: SurrogateSettings = SurrogateSettings { kind: Kind::Network, table_nodes: None, refine: true };

/// Labels of two windows contradict each other, unless the network is told of which window each is. Half a period apart the double gyre is its
/// own mirror image.
#[test]
fn one_network_knows_two_windows() {
    let windows = [0.0, 5.0].map(|start| DoubleGyre::new(start, 10.0, 40));
    let held_out = windows.each_ref().map(|window| traced(window, uniform_points(2, 2_000), false));
    let errors = |network: &NetworkSettings| {
        let mut surrogate = build(&SETTINGS, network, windows[0].domain(), 5, &windows[0]).unwrap();
        let mut buffer = ReplayBuffer::new(1 << 16);
        for (seed, window) in (7..).zip(&windows) {
            buffer.set_now(Times::new(network, 10.0).unit(window.start, 10.0));
            buffer.push(&traced(window, uniform_points(seed, 20_000), false));
        }
        let learned = surrogate.learn(&buffer, f64::INFINITY, 300).unwrap();
        assert_eq!((learned.steps, learned.dropped), (300, 0));
        let frozen = surrogate.freeze().unwrap();
        let errors: Vec<f64> = windows
            .iter()
            .zip(&held_out)
            .map(|(window, held_out)| {
                surrogate.window_slid(window).unwrap();
                rms(&surrogate.freeze().unwrap(), held_out)
            })
            .collect();
        assert!((rms(&frozen, &held_out[0]) - errors[0]).abs() < 1e-6, "what is frozen is asked for the window of its time");
        errors
    };
    let without = NetworkSettings { log2_table: Some(14), width: 32, batch: Some(2048), ..NetworkSettings::default() };
    let with_start = NetworkSettings { inputs: vec![Input::Start], start_range: Some([0.0, 5.0]), ..without.clone() };
    let (with, without) = (errors(&with_start), errors(&without));
    for (with, without) in with.iter().zip(&without) {
        assert!(*with < 0.5 * without, "with the start {with}, without {without}");
    }
}

/// Runs a scene and returns its records.
fn records(text: &str, keys: &[&str], options: &RunOptions) -> Vec<FrameRecord> {
    let mut records = Vec::new();
    scene::run_frames(scene::setup(text, keys), options, |frame| records.push(FrameRecord::clone(&frame.record)));
    records
}

const NETWORK: &str = "
    surrogate.kind = \"network\"
    network.levels = 4
    network.log2_table = 12
    network.width = 16
    network.batch = 1024
    training.steps_per_frame = 60
";

/// In the flow of a saddle, the log-stretch is rate * duration for every duration; frames use tau alone.
#[test]
fn durations_below_tau_are_learned() {
    let keys = "
        source.rate = 0.7
        domain.min = [-1, -1, 0]
        domain.max = [1, 1, 0.2]
        time.tau = 4
        time.frames_per_slide = 4
        flow.steps = 40
        transfer.low = 0
        transfer.high = 1
    ";
    let scene = scene::scene("saddle", [24, 12, 2], &format!("{keys}{NETWORK}"));
    let folder = tempfile::tempdir().unwrap();
    let error = |inputs: &str, network: &NetworkSettings| {
        let checkpoint = folder.path().join(inputs.len().to_string());
        let options = RunOptions { checkpoint: Some(checkpoint.clone()), ..RunOptions::default() };
        // Every cell of so coarse a grid gets labels.
        let coarse = ["network.levels=2", "network.base_resolution=8", "training.steps_per_frame=150"];
        let made = records(&scene, &[&[format!("network.inputs={inputs}").as_str()][..], &coarse].concat(), &options);
        assert_eq!(made.len(), 4);
        let flow = VelocitySource::Analytic(Analytic::Saddle { rate: 0.7 }, Domain::slab([-1.0; 2], [1.0; 2], (0.0, 0.2)));
        let tracer = |tau| cpu_tracer(flow.clone(), &FlowMap::tangent(tau, 40), 0.0).unwrap();
        let mut surrogate = build(&SETTINGS, network, tracer(4.0).domain(), 5, &tracer(4.0)).unwrap();
        surrogate.load(&checkpoint).unwrap();
        let points = uniform_points(3, 500);
        let mut worst = 0.0_f32;
        for duration in [0.8, 1.5, 2.9, 4.0] {
            surrogate.window_slid(&tracer(duration)).unwrap();
            let mut found = vec![0.0; points.len()];
            surrogate.predict(&points, &mut found).unwrap();
            worst = found.iter().fold(worst, |worst, s| worst.max((s - 0.7 * duration as f32).abs()));
        }
        worst
    };
    let network = NetworkSettings {
        levels: Some(2),
        log2_table: Some(12),
        base_resolution: Some(8),
        width: 16,
        batch: Some(1024),
        ..NetworkSettings::default()
    };
    let with = error("[\"duration\"]", &NetworkSettings { inputs: vec![Input::Duration], ..network.clone() });
    let without = error("[]", &network);
    // Without the input, the network predicts 2.8 for all durations.
    assert!(with < 0.2 && without > 2.0, "{with} and {without}");
}

/// Four windows of the double gyre.
fn four_windows() -> String {
    let keys = "
        time.tau = 5
        time.seed_step = 1
        time.slides = 4
        time.frames_per_slide = 3
        flow.steps = 25
    ";
    scene::double_gyre([24, 12, 2], &format!("{keys}{NETWORK}"))
}

/// With the start as an input, labels stay valid after a slide and are kept. The trusted error is inflated nevertheless.
#[test]
fn labels_outlive_a_slide_where_the_start_is_an_input() {
    let scene = four_windows();
    let run = |keys: &[&str]| records(&scene, keys, &RunOptions::default());
    let (with, without) = (run(&["network.inputs=[\"start\"]", "trust.tolerance=0.15"]), run(&["trust.tolerance=0.15"]));
    assert_eq!((with.len(), without.len()), (12, 12));
    for first in [3, 6, 9] {
        assert_eq!((with[first].slide, with[first - 1].slide), (first as u64 / 3, first as u64 / 3 - 1));
        assert!(
            with[first].replay_samples > with[first - 1].replay_samples,
            "frame {first}: {} samples, then {}",
            with[first - 1].replay_samples,
            with[first].replay_samples
        );
        assert!(
            without[first].replay_samples < without[first - 1].replay_samples,
            "frame {first}: {} samples, then {}",
            without[first - 1].replay_samples,
            without[first].replay_samples
        );
        assert!(with[first].trusted_volume <= with[first - 1].trusted_volume, "frame {first} is not trusted more for the slide");
    }
    assert!(with.iter().chain(&without).all(|record| record.warnings.is_empty()));
    // Outside the scene's range of starts, labels are dropped as without the input, with a warning in the record.
    let past = run(&["network.inputs=[\"start\"]", "network.start_range=[0, 2]"]);
    let warns = |record: &FrameRecord| record.warnings.iter().any(|w| w.contains("start time 3 lies beyond network.start_range, 0 to 2"));
    assert!(past[6].replay_samples > past[5].replay_samples && past[9].replay_samples < past[8].replay_samples);
    assert!(warns(&past[9]) && past.iter().filter(|record| warns(record)).count() == 1);
    // The same holds for the first window: its labels are not those at the beginning of the range.
    let before = run(&["network.inputs=[\"start\"]", "network.start_range=[0.5, 3]"]);
    assert!(before[3].replay_samples < before[2].replay_samples && before[6].replay_samples > before[5].replay_samples);
    assert!(before[0].warnings.iter().any(|w| w.contains("start time 0 lies beyond network.start_range, 0.5 to 3")));
}

#[test]
fn wrong_inputs_are_refused_with_the_reason() {
    let refused = |keys: &[&str]| {
        let scene = scene::parse(&four_windows(), keys);
        scene.map(|scene| Setup::new(scene.settings()).err().map(|e| e.to_string())).map_err(|e| e.to_string())
    };
    let (start, both) = ("network.inputs=[\"start\"]", "network.inputs=[\"start\", \"duration\"]");
    for (keys, words) in [
        (&[start, "surrogate.kind=\"residual\""][..], "a table knows one window and one duration"),
        (&["network.inputs=[\"start\", \"start\"]"], "each of \"start\" and \"duration\" once at most"),
        (&["network.inputs=[\"end\"]"], "network.inputs"),
        (&[start, "network.start_range=[3, 1]"], "two finite numbers, ascending"),
        (&["network.start_range=[0, 1]"], "with \"start\" among network.inputs"),
    ] {
        let found = refused(keys).unwrap_err();
        assert!(found.contains(words), "{keys:?}: {found}");
    }
    assert_eq!(refused(&[both]), Ok(None));
    // Three dimensions and both times would be five inputs.
    let cube = NetworkSettings { inputs: vec![Input::Start, Input::Duration], ..NetworkSettings::default() };
    let abc = VelocitySource::Analytic(Analytic::Abc { a: 1.0, b: 1.0, c: 1.0, growth: 0.0 }, Domain::cuboid([0.0; 3], [1.0; 3]));
    let tracer = cpu_tracer(abc, &FlowMap::tangent(1.0, 4), 0.0).unwrap();
    let fault = build(&SETTINGS, &cube, tracer.domain(), 0, &tracer).err().unwrap().to_string();
    assert!(fault.contains("network.inputs") && fault.contains("4 inputs in all"), "{fault}");
    // A single start time needs no input.
    let setup = scene::setup(&four_windows(), &[start, "time.slides=1"]);
    assert!(setup.plan.scene.network.inputs.is_empty() && setup.notes.iter().any(|note| note.contains("\"start\" is left out")));
}
