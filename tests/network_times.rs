//! Start time and duration as inputs of the network: what it then knows, and what a run does with it.

#![allow(clippy::unwrap_used)]

mod network_support;

use network_support::{DoubleGyre, traced, uniform_points};
use ridgewatch::config::SceneFile;
use ridgewatch::engine::{Event, FrameRecord, RunOptions, Setup, run};
use ridgewatch::field::Domain;
use ridgewatch::field::analytic::Analytic;
use ridgewatch::flow::{FlowMap, Tracer, VelocitySource, cpu_tracer};
use ridgewatch::surrogate::network::{Input, NetworkSettings, Times};
use ridgewatch::surrogate::{Kind, Predict, SampleRing, Samples, SurrogateSettings, build};
use std::path::Path;
use std::sync::atomic::AtomicBool;

const SETTINGS: SurrogateSettings = SurrogateSettings { kind: Kind::Network, table_nodes: None };

fn rms(surrogate: &dyn Predict, samples: &Samples) -> f64 {
    let mut predicted = vec![0.0; samples.len()];
    surrogate.predict(&samples.points, &mut predicted);
    let sum: f64 = predicted.iter().zip(&samples.log_stretch).map(|(p, t)| f64::from(p - t).powi(2)).sum();
    (sum / samples.len() as f64).sqrt()
}

/// Labels of two windows contradict each other, unless the network is told of which window each is. Half a period apart the double gyre is its
/// own mirror image.
#[test]
fn one_network_knows_two_windows() {
    let windows = [0.0, 5.0].map(|start| DoubleGyre::new(start, 10.0, 40));
    let held_out = windows.each_ref().map(|window| traced(window, uniform_points(2, 2_000), false));
    let errors = |network: &NetworkSettings| {
        let mut surrogate = build(&SETTINGS, network, windows[0].domain(), 5, &windows[0]).unwrap();
        let mut ring = SampleRing::new(1 << 16);
        for (seed, window) in (7..).zip(&windows) {
            ring.set_now(Times::new(network, 10.0).unit(window.start, 10.0));
            ring.push(&traced(window, uniform_points(seed, 20_000), false));
        }
        let learned = surrogate.learn(&ring, f64::INFINITY, 300);
        assert_eq!((learned.steps, learned.dropped), (300, 0));
        let frozen = surrogate.freeze();
        let errors: Vec<f64> = windows
            .iter()
            .zip(&held_out)
            .map(|(window, held_out)| {
                surrogate.window_slid(window);
                rms(&*surrogate, held_out)
            })
            .collect();
        assert!((rms(&*frozen, &held_out[0]) - errors[0]).abs() < 1e-6, "what is frozen is asked for the window of its time");
        errors
    };
    let blind = NetworkSettings { log2_table: 14, width: 32, batch: 2048, ..NetworkSettings::default() };
    let told = NetworkSettings { inputs: vec![Input::Start], start_range: Some([0.0, 5.0]), ..blind.clone() };
    let (told, blind) = (errors(&told), errors(&blind));
    for (told, blind) in told.iter().zip(&blind) {
        assert!(*told < 0.5 * blind, "told {told}, blind {blind}");
    }
}

/// Runs a scene; its records.
fn records(text: &str, keys: &[&str], options: &RunOptions) -> Vec<FrameRecord> {
    let keys: Vec<String> = keys.iter().map(|&key| key.to_owned()).collect();
    let scene = SceneFile::parse(Path::new("a test"), text, &keys).unwrap();
    let mut records = Vec::new();
    let mut sink = |event: Event| {
        if let Event::Frame(frame) = event {
            records.push(FrameRecord::clone(&frame.record));
        }
    };
    run(Setup::new(scene.settings()).unwrap(), options, &mut sink, &AtomicBool::new(false)).unwrap();
    records
}

const COMMON: &str = "
[render]
width = 24
height = 12
samples = 2
[training]
steps_per_frame = 60
[network]
levels = 4
log2_table = 12
width = 16
batch = 1024
[surrogate]
kind = \"network\"
";

/// Every duration of a saddle's flow has the log-stretch rate * duration; frames only ask for tau.
#[test]
fn durations_below_tau_are_learned() {
    let scene = format!(
        "[source]\nkind = \"saddle\"\nrate = 0.7\n[domain]\nmin = [-1, -1, 0]\nmax = [1, 1, 0.2]\n[time]\ntau = 4\nframes_per_slide = 4\n[flow]\nsteps = 40\n[transfer]\nlow = 0\nhigh = 1\n{COMMON}"
    );
    let folder = tempfile::tempdir().unwrap();
    let error = |inputs: &str, network: &NetworkSettings| {
        let checkpoint = folder.path().join(inputs.len().to_string());
        let options = RunOptions { checkpoint: Some(checkpoint.clone()), ..RunOptions::default() };
        // So coarse that every cell of the grid gets labels.
        let coarse = ["network.levels=2", "network.base_resolution=8", "training.steps_per_frame=150"];
        let made = records(&scene, &[&[format!("network.inputs={inputs}").as_str()][..], &coarse].concat(), &options);
        assert_eq!(made.len(), 4);
        let flow = VelocitySource::Analytic(Analytic::Saddle { rate: 0.7 }, Domain::slab([-1.0; 2], [1.0; 2], (0.0, 0.2)));
        let tracer = |tau| cpu_tracer(flow.clone(), &FlowMap::tangent(tau, 40), 0.0).unwrap();
        let mut surrogate = build(&SETTINGS, network, tracer(4.0).domain(), 5, &*tracer(4.0)).unwrap();
        surrogate.load(&checkpoint).unwrap();
        let points = uniform_points(3, 500);
        let mut worst = 0.0_f32;
        for duration in [0.8, 1.5, 2.9, 4.0] {
            surrogate.window_slid(&*tracer(duration));
            let mut found = vec![0.0; points.len()];
            surrogate.predict(&points, &mut found);
            worst = found.iter().fold(worst, |worst, s| worst.max((s - 0.7 * duration as f32).abs()));
        }
        worst
    };
    let network = NetworkSettings { levels: 2, log2_table: 12, base_resolution: 8, width: 16, batch: 1024, ..NetworkSettings::default() };
    let told = error("[\"duration\"]", &NetworkSettings { inputs: vec![Input::Duration], ..network.clone() });
    let blind = error("[]", &network);
    // Without the input it says 2.8 whatever the duration.
    assert!(told < 0.2 && blind > 2.0, "{told} and {blind}");
}

const GYRE: &str = "
[source]
kind = \"double_gyre\"
[domain]
min = [0, 0, 0]
max = [2, 1, 0.2]
[time]
tau = 5
seed_step = 1
slides = 4
frames_per_slide = 3
[flow]
steps = 25
";

/// A slide leaves labels right where the start is an input: they stay. Trust is inflated all the same.
#[test]
fn labels_outlive_a_slide_where_the_start_is_an_input() {
    let scene = format!("{GYRE}{COMMON}");
    let run = |keys: &[&str]| records(&scene, keys, &RunOptions::default());
    let (told, blind) = (run(&["network.inputs=[\"start\"]", "trust.tolerance=0.15"]), run(&["trust.tolerance=0.15"]));
    assert_eq!((told.len(), blind.len()), (12, 12));
    for first in [3, 6, 9] {
        assert_eq!((told[first].slide, told[first - 1].slide), (first as u64 / 3, first as u64 / 3 - 1));
        assert!(
            told[first].replay_samples > told[first - 1].replay_samples,
            "frame {first}: {} samples, then {}",
            told[first - 1].replay_samples,
            told[first].replay_samples
        );
        assert!(
            blind[first].replay_samples < blind[first - 1].replay_samples,
            "frame {first}: {} samples, then {}",
            blind[first - 1].replay_samples,
            blind[first].replay_samples
        );
        assert!(told[first].trusted_volume <= told[first - 1].trusted_volume, "frame {first} is not trusted more for the slide");
    }
    assert!(told.iter().chain(&blind).all(|record| record.warnings.is_empty()));
    // Beyond a range that the scene gives, labels are set aside as without the input, and the record says so.
    let past = run(&["network.inputs=[\"start\"]", "network.start_range=[0, 2]"]);
    let said = |record: &FrameRecord| record.warnings.iter().any(|w| w.contains("start time 3 lies beyond network.start_range, 0 to 2"));
    assert!(past[6].replay_samples > past[5].replay_samples && past[9].replay_samples < past[8].replay_samples);
    assert!(said(&past[9]) && past.iter().filter(|record| said(record)).count() == 1);
    // The first window too: its labels are not those of the range's begin.
    let before = run(&["network.inputs=[\"start\"]", "network.start_range=[0.5, 3]"]);
    assert!(before[3].replay_samples < before[2].replay_samples && before[6].replay_samples > before[5].replay_samples);
    assert!(before[0].warnings.iter().any(|w| w.contains("start time 0 lies beyond network.start_range, 0.5 to 3")));
}

#[test]
fn what_inputs_cannot_be_is_said() {
    let refused = |keys: &[&str]| {
        let keys: Vec<String> = keys.iter().map(|&key| key.to_owned()).collect();
        let scene = SceneFile::parse(Path::new("a test"), &format!("{GYRE}{COMMON}"), &keys);
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
    // A flow of three dimensions and both times are five inputs.
    let cube = NetworkSettings { inputs: vec![Input::Start, Input::Duration], ..NetworkSettings::default() };
    let abc = VelocitySource::Analytic(Analytic::Abc { a: 1.0, b: 1.0, c: 1.0, growth: 0.0 }, Domain::cuboid([0.0; 3], [1.0; 3]));
    let tracer = cpu_tracer(abc, &FlowMap::tangent(1.0, 4), 0.0).unwrap();
    let fault = build(&SETTINGS, &cube, tracer.domain(), 0, &*tracer).err().unwrap().to_string();
    assert!(fault.contains("network.inputs") && fault.contains("4 inputs in all"), "{fault}");
    // One start time needs no input.
    let scene = SceneFile::parse(Path::new("a test"), &format!("{GYRE}{COMMON}"), &[start.to_owned(), "time.slides=1".to_owned()]).unwrap();
    let setup = Setup::new(scene.settings()).unwrap();
    assert!(setup.plan.scene.network.inputs.is_empty() && setup.notes.iter().any(|note| note.contains("\"start\" is left out")));
}
