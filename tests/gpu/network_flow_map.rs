//! Networks of the flow map, and with more inputs than a point has places for, on the device: against the same network in f64, against finite
//! differences, against burn's gradients, and in runs against the CPU.

use super::network::{check_gradients, few_entries, is_plain, predict, prepare, settled};
use super::network_support::reference::{Reference, norm};
use super::network_support::{self, Case};
use super::scenes::*;
use super::small;
use crate::kit::scene;
use nalgebra::DMatrix;
use ridgewatch::backend::Device;
use ridgewatch::backend::cuda::{DeviceNetwork, GpuSettings};
use ridgewatch::field::UnitPoint;
use ridgewatch::run::{Frame, RunOptions};
use ridgewatch::surrogate::network::{Encoding, Input, NetworkSettings, Objective, Target, row};

/// Of the cases that the CPU trains, those that are not plain; and what fills registers, and goes through the kernels in tiles.
fn cases() -> Vec<Case> {
    let without_derivatives = |case: Case| Case { settings: NetworkSettings { jacobian_weight: 0.0, ..case.settings }, ..case };
    let mut cases: Vec<Case> = network_support::cases().into_iter().filter(|case| !is_plain(case)).map(without_derivatives).collect();
    let (plane, space) = (&[0, 1][..], &[0, 1, 2][..]);
    let flow_map = NetworkSettings { target: Target::FlowMap, ..few_entries() };
    let frequency = NetworkSettings { encoding: Encoding::Frequency, ..flow_map.clone() };
    let (start, both) = (vec![Input::Start], vec![Input::Start, Input::Duration]);
    let ftle = |settings: &NetworkSettings| NetworkSettings { target: Target::Ftle, ..settings.clone() };
    cases.extend([
        Case { name: "flow map, width 128", settings: NetworkSettings { width: 128, ..flow_map.clone() }, axes: space },
        Case { name: "flow map, 8 features", settings: NetworkSettings { features: 8, ..flow_map.clone() }, axes: plane },
        Case { name: "flow map, 256 wide", settings: NetworkSettings { width: 256, hidden_layers: 3, ..frequency.clone() }, axes: space },
        Case {
            name: "flow map, deep, tables",
            settings: NetworkSettings { width: 100, hidden_layers: 5, ..flow_map.clone() },
            axes: plane,
        },
        Case { name: "flow map and start", settings: NetworkSettings { inputs: start.clone(), ..flow_map.clone() }, axes: space },
        Case { name: "flow map and both times", settings: NetworkSettings { inputs: both.clone(), ..frequency.clone() }, axes: space },
        Case { name: "space and start", settings: NetworkSettings { inputs: start.clone(), ..ftle(&flow_map) }, axes: space },
        Case { name: "plane and both times", settings: NetworkSettings { inputs: both.clone(), ..ftle(&flow_map) }, axes: plane },
        Case { name: "space and both times", settings: NetworkSettings { inputs: both, ..ftle(&frequency) }, axes: space },
        Case { name: "space and start, 256 wide", settings: NetworkSettings { inputs: start, width: 256, ..ftle(&flow_map) }, axes: space },
    ]);
    cases
}

/// Log-stretch from the reference's outputs and their derivatives: that of the flow map by the singular values of its Jacobian.
fn log_stretch(objective: &Objective, rows: &[Vec<f64>]) -> f64 {
    let deviation = |output: usize| f64::from(objective.scale.deviation[output]);
    if objective.target == Target::Ftle {
        return rows[0][0] * deviation(0) + f64::from(objective.scale.mean[0]);
    }
    let dimensions = rows[0].len();
    let jacobian = DMatrix::from_fn(dimensions, dimensions, |output, along| {
        let unit = rows[1 + along][output] * deviation(output) + if output == along { 1.0 } else { 0.0 };
        unit * f64::from(objective.extent[output]) / f64::from(objective.extent[along])
    });
    jacobian.singular_values().max().ln()
}

#[test]
#[ignore = "needs a GPU"]
fn flow_maps_are_differentiated_as_the_reference_s() {
    for case in cases() {
        let (model, objective, _) = prepare(&case);
        // Where no neuron switches by rounding, which a derivative would show.
        let model = settled(&model);
        let network = DeviceNetwork::upload(&gpu(), &model.shape, &objective, &model.tables(), &model.layers()).unwrap();
        // Not a multiple of any tile, with corners.
        let mut points = fresh_unit(0.0, 1.0, 3003);
        points.extend([[0.0; 3], [1.0; 3], [1.0, 0.0, 1.0]].map(UnitPoint));
        let times = [0.3, 0.85];
        let found = predict(&network.above(None).at(times), &points);
        for (name, reference) in [("in halves", Reference::in_halves(&model)), ("exact", Reference::new(&model))] {
            let expected: Vec<f64> = points.iter().map(|&p| log_stretch(&objective, &reference.outputs(row(p, times)))).collect();
            let apart: Vec<f64> = found.iter().zip(&expected).map(|(a, b)| f64::from(*a) - b).collect();
            let worst = apart.iter().fold(0.0, |m: f64, e| if e.is_nan() { f64::INFINITY } else { m.max(e.abs()) });
            let error = norm(&apart) / norm(&expected);
            measured!("{}: log-stretch off f64 ({name}) by {error:.1e} of its root mean square, {worst:.1e} at most", case.name);
            assert!(worst.is_finite(), "{}: {name}", case.name);
            if name == "in halves" {
                // What is left is the order of sums in single precision, and halves that this rounds to the other side. How far halves are
                // from the exact network depends on how much of what is summed is left, here little beside the biases.
                assert!(error < 4e-4, "{}: {error}", case.name);
                assert!(worst < 8e-3 * norm(&expected) / (expected.len() as f64).sqrt(), "{}: {worst}", case.name);
            }
        }
    }
}

#[test]
#[ignore = "needs a GPU"]
fn gradients_of_flow_maps_and_further_inputs() {
    cases().iter().for_each(check_gradients);
}

#[test]
#[ignore = "needs a GPU"]
fn gradients_with_derivatives_in_the_loss() {
    for case in cases().into_iter().filter(|case| case.settings.target == Target::FlowMap) {
        check_gradients(&Case { settings: NetworkSettings { jacobian_weight: 0.3, ..case.settings }, ..case });
    }
}

/// A small run whose frames are answered by a network that learns, in space.
fn turbulence() -> String {
    scene::gated_turbulence(
        "
        time.tau = 6
        time.frames_per_slide = 5
        flow.steps = 12
        surrogate.kind = \"network\"
        network.width = 32
        training.steps_per_frame = 150
        ",
    )
}

/// The same in the plane.
fn gyre() -> String {
    scene::double_gyre(
        [48, 24, 8],
        "
        time.tau = 5
        time.seed_step = 0.5
        time.slides = 2
        time.frames_per_slide = 3
        flow.steps = 25
        surrogate.kind = \"network\"
        network.log2_table = 14
        network.levels = 4
        network.width = 32
        network.batch = 4096
        training.steps_per_frame = 150
        render.method = \"gated\"
        ",
    )
}

/// Of the first slide.
fn frames_of_a_slide(frames: &[Frame]) -> usize {
    frames.iter().take_while(|frame| frame.record.slide == 0).count()
}

/// Frames, audits, labels and training stay on the device, and what it learns is worth what the CPU learns.
#[test]
#[ignore = "needs a GPU"]
fn runs_learn_on_the_device_what_the_cpu_learns() {
    let gpu = device(GpuSettings::default());
    let (turbulence, gyre) = (turbulence(), gyre());
    let runs: [(&str, &str, &[&str]); 7] = [
        ("flow map in space", &turbulence, &["network.target=\"flow_map\""]),
        ("flow map and derivatives in space", &turbulence, &["network.target=\"flow_map\"", "network.jacobian_weight=1e-4"]),
        ("flow map in the plane", &gyre, &["network.target=\"flow_map\""]),
        ("flow map in the plane and start", &gyre, &["network.target=\"flow_map\"", "network.inputs=[\"start\"]"]),
        ("space and start", &turbulence, &["network.inputs=[\"start\"]", "time.slides=2"]),
        ("plane and both times", &gyre, &["network.inputs=[\"start\", \"duration\"]"]),
        ("published loss", &gyre, &["network.loss=\"published\"", "network.mean_penalty=1.0"]),
    ];
    let few: &[&str] = if small() { &["training.steps_per_frame=10", "time.frames_per_slide=2", "network.batch=512"] } else { &[] };
    for (name, scene, keys) in runs {
        let keys: Vec<String> = keys.iter().chain(few).map(ToString::to_string).collect();
        let made = |device: &Device| frames(scene, &keys, &RunOptions { device: device.clone(), ..RunOptions::default() });
        let (found, expected) = (made(&gpu), made(&Device::CPU));
        for (frames, there) in [(&found, true), (&expected, false)] {
            for frame in frames {
                let record = &frame.record;
                assert!(warnings(record).is_empty(), "{name}: {:?}", record.warnings);
                assert_eq!(record.training.as_ref().unwrap().device_seconds.is_some(), there, "{name}");
                // A GPU that walks answers points ahead of their flights; one that only traces does not.
                assert_eq!(record.speculative_traces > 0, there, "{name}");
            }
        }
        if small() {
            println!("{name}: not held against the CPU's: so few steps say nothing");
            continue;
        }
        let psnr = |frames: &[Frame]| -> Vec<f64> { frames.iter().map(|frame| frame.record.surrogate_psnr.unwrap()).collect() };
        let (ours, theirs) = (psnr(&found), psnr(&expected));
        let [our_loss, their_loss] =
            [&found, &expected].map(|frames| frames[frames.len() - 1].record.training.as_ref().unwrap().loss.unwrap());
        measured!("{name}: what the network knows, dB: GPU {ours:.1?}, CPU {theirs:.1?}; last losses {our_loss:.2e} and {their_loss:.2e}");
        // Labels of windows that have passed would not be fitted together with this one's: losses were 60 and 190 times the CPU's.
        assert!(our_loss < 10.0 * their_loss, "{name}: losses {our_loss} and {their_loss}");
        let last = frames_of_a_slide(&found) - 1;
        // The first frame is answered by what the run began with.
        assert!(ours[last] > ours[0] + 5.0 && theirs[last] > theirs[0] + 5.0, "{name}: both learn: {ours:?} and {theirs:?}");
        // On the CPU, runs of other seeds end up to 3 dB apart.
        assert!(ours[last] > theirs[last] - 4.0, "{name}: as much: {ours:?} and {theirs:?}");
        assert!(ours[ours.len() - 1] > ours[0] + 5.0, "{name}: after a slide too: {ours:?}");
        // Behind a slide, where a frame of training may be worth 9 dB, the frame before the CPU's last is what it must reach.
        assert!(ours[ours.len() - 1] > theirs[theirs.len() - 2] - 4.0, "{name}: after a slide as much: {ours:?} and {theirs:?}");
    }
}
