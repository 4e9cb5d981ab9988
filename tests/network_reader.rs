//! `examples/evaluate_network.py` reproduces the predictions of the program from the checkpoint alone. Needs Python with NumPy
//! (`make test-reader` has it).

#![allow(clippy::unwrap_used)]

mod network_support;

use network_support::{DoubleGyre, traced, uniform_points};
use ridgewatch::field::UnitPoint;
use ridgewatch::flow::Tracer;
use ridgewatch::surrogate::network::{Encoding, Input, Loss, NetworkSettings, Target, Times};
use ridgewatch::surrogate::{Kind, Predict, ReplayBuffer, SurrogateSettings, build};
use std::io::Write;
use std::path::Path;
use std::process::{Command, Stdio};

/// The example's predictions at unit points, or its error message.
fn evaluated(checkpoint: &Path, points: &[UnitPoint], times: &str) -> Result<Vec<f32>, String> {
    let python = std::env::var("PYTHON").unwrap_or_else(|_| "python3".into());
    let script = concat!(env!("CARGO_MANIFEST_DIR"), "/examples/evaluate_network.py");
    let mut child = Command::new(python)
        .args([script.as_ref(), checkpoint])
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    let text: String = points.iter().map(|UnitPoint([x, y, z])| format!("{x} {y} {z} {times}\n")).collect();
    // The script reads everything before it writes anything, or it fails and reads nothing.
    let written = child.stdin.take().unwrap().write_all(text.as_bytes());
    let output = child.wait_with_output().unwrap();
    if !output.status.success() {
        return Err(String::from_utf8(output.stderr).unwrap());
    }
    written.unwrap();
    Ok(String::from_utf8(output.stdout).unwrap().lines().map(|line| line.parse().unwrap()).collect())
}

#[test]
#[ignore = "needs Python with NumPy (`make test-reader` has it)"]
fn numpy_reproduces_predictions_from_a_checkpoint() {
    let folder = tempfile::tempdir().unwrap();
    let tracer = DoubleGyre::new(0.0, 3.0, 30);
    let later = DoubleGyre::new(3.0, 2.0, 30);
    let samples = traced(&tracer, uniform_points(3, 4000), false);
    let other = traced(&later, uniform_points(4, 4000), false);
    let hash = NetworkSettings { log2_table: Some(9), batch: Some(1024), ..NetworkSettings::default() };
    let frequency =
        NetworkSettings { encoding: Encoding::Frequency, hidden_layers: 3, width: 24, octaves: 4, batch: Some(1024), ..hash.clone() };
    let published = NetworkSettings { loss: Loss::Published, ..hash.clone() };
    let start = NetworkSettings { inputs: vec![Input::Start], start_range: Some([-1.0, 4.0]), ..hash.clone() };
    let both = NetworkSettings { inputs: vec![Input::Duration, Input::Start], ..start.clone() };
    let of_both = NetworkSettings { inputs: both.inputs.clone(), start_range: both.start_range, ..frequency.clone() };
    for (name, kind, network, times) in [
        ("hash", Kind::Network, &hash, ""),
        ("frequency", Kind::Network, &frequency, ""),
        ("residual", Kind::Residual, &hash, ""),
        ("published", Kind::Network, &published, ""),
        ("start", Kind::Network, &start, "2.5"),
        ("start and duration", Kind::Network, &both, "2.5 1.2"),
        ("start and duration, frequency", Kind::Network, &of_both, "2.5 1.2"),
    ] {
        let settings = SurrogateSettings { kind, table_nodes: Some([21, 11, 2]), ..SurrogateSettings::default() };
        let mut surrogate = build(&settings, network, tracer.domain(), 5, &tracer).unwrap();
        let mut buffer = ReplayBuffer::new(2 * samples.len());
        for (window, samples) in [(&tracer, &samples), (&later, &other)] {
            buffer.set_now(Times::new(network, tracer.tau).unit(window.start, window.tau));
            buffer.push(samples);
        }
        surrogate.learn(&buffer, f64::INFINITY, 200).unwrap();
        let path = folder.path().join(name);
        surrogate.save(&path).unwrap();
        let mut points = uniform_points(8, 500);
        points.extend([[0.0; 3], [1.0; 3], [1.0, 0.0, 0.5]].map(UnitPoint));
        if !times.is_empty() {
            surrogate.window_slid(&DoubleGyre::new(2.5, if times == "2.5" { 3.0 } else { 1.2 }, 30)).unwrap();
        }
        let mut expected = vec![0.0; points.len()];
        surrogate.predict(&points, &mut expected).unwrap();
        let found = evaluated(&path, &points, times).unwrap();
        assert_eq!(found.len(), expected.len());
        for ((point, found), expected) in points.iter().zip(&found).zip(&expected) {
            // The script computes in f64, the program in f32.
            assert!((found - expected).abs() < 2e-4 * expected.abs().max(1.0), "{name}: {point:?}: {found} for {expected}");
        }
    }
}

#[test]
#[ignore = "needs Python with NumPy (`make test-reader` has it)"]
fn the_reader_refuses_what_it_cannot_evaluate() {
    let folder = tempfile::tempdir().unwrap();
    let tracer = DoubleGyre::new(0.0, 3.0, 30);
    let hash = NetworkSettings { log2_table: Some(9), batch: Some(1024), ..NetworkSettings::default() };
    let start = NetworkSettings { inputs: vec![Input::Start], start_range: Some([-1.0, 4.0]), ..hash.clone() };
    let flow_map = NetworkSettings { target: Target::FlowMap, ..hash.clone() };
    for (name, network, kind, times, expected) in [
        ("no start", &start, Kind::Network, "", "points have 3 columns; this network takes 4: x y z start"),
        ("a time too many", &hash, Kind::Network, "2.5", "points have 4 columns; this network takes 3: x y z"),
        ("flow map", &flow_map, Kind::Network, "", "its target is not ftle"),
        ("table", &hash, Kind::Table, "", "no network"),
    ] {
        let settings = SurrogateSettings { kind, table_nodes: Some([21, 11, 2]), ..SurrogateSettings::default() };
        let surrogate = build(&settings, network, tracer.domain(), 5, &tracer).unwrap();
        let path = folder.path().join(name);
        surrogate.save(&path).unwrap();
        let message = evaluated(&path, &uniform_points(8, 5), times).unwrap_err();
        assert!(message.contains(expected) && !message.contains("Traceback"), "{name}: {message}");
    }
}
