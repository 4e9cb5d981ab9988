//! Training on the device: gradients of networks in the middle of training, Adam, what is learned, and what happens when a loss is no number.

use super::network::{SAMPLES, cases, gradients, predict, prepare, prepared, roundings, step, stored, training};
use super::network_support::reference::{Kernel, Reference, Rounding, labels, norm, target};
use super::network_support::{traced, uniform_points};
use super::scenes::*;
use super::small;
use burn::backend::Flex;
use burn::module::Param;
use burn::optim::{Adam, AdamConfig, AdamState, SimpleOptimizer};
use burn::tensor::Tensor;
use ridgewatch::backend::cuda::{CudaTracer, DeviceNetwork, Tuning, is_fused};
use ridgewatch::field::UnitPoint;
use ridgewatch::surrogate::network::{
    Architecture, Average, Fused, Input, Model, NetworkSettings, Objective, PlannedStep, Row, Step, Target, row,
};
use ridgewatch::surrogate::{Kind, Predict, ReplayBuffer, Samples};
use std::ops::Range;

/// Weights as training leaves them: halves then decide which neurons near 0 pass. How far that takes a gradient from the exact one is no
/// property of the kernels (2e-3 of it with 1,000 samples; where 13 are all there is, one neuron of one sample is up to 7e-2), so they are
/// held to the network in halves, its masks included, part by part.
///
/// The tolerance is the arithmetic's: what comes of it when every sum of the reference is off by up to 2^-20 of its terms' magnitudes, eight
/// units in the last place of single precision, at random. It is at least 1e-5, since sums over samples are in single precision too.
#[test]
#[ignore = "needs a GPU"]
fn gradients_in_training_are_the_references() {
    for (case, (model, objective, samples)) in prepared() {
        // The reference's gradient is of each sample alone.
        let objective = Objective { mean_penalty: 0.0, ..objective };
        let model = Model { table_moments: None, layer_moments: None, ..model };
        let kernel = if is_fused(&model.shape, gpu().shared_memory()) { Kernel::Fused } else { Kernel::Batched };
        let mut device = training(&model, &objective);
        let pool = device.upload(&samples, None).unwrap();
        let loss = device.train_steps(&pool, None, &[step(samples.points.len(), 1e-9)]).unwrap()[0];
        let found = gradients(&stored(&device, &model));

        let reference = Reference::in_halves(&model);
        let rows: Vec<Row> = (0..samples.len()).map(|i| row(samples.points[i], samples.times[i])).collect();
        let loss_of = |rounding| {
            let outputs = reference.rounded_outputs(&rows, rounding);
            let squares = outputs.iter().zip(&samples.log_stretch).map(|(output, &s)| (output - target(&objective, s)).powi(2));
            squares.sum::<f64>() / rows.len() as f64
        };
        let expected_loss = loss_of(Rounding::NONE);
        let turned = roundings().map(|r| (loss_of(r) / expected_loss - 1.0).abs()).fold(0.5e-4, f64::max) * 2.0;
        assert!((loss / expected_loss - 1.0).abs() < turned, "{}: loss {loss}, in f64 {expected_loss}, off by {turned} at most", case.name);
        let expected = reference.gradient(&objective, &samples, kernel, Rounding::NONE);
        let rounded: Vec<Vec<f64>> = roundings().map(|r| reference.gradient(&objective, &samples, kernel, r)).collect();
        let exact = Reference::new(&model).gradient(&objective, &samples, kernel, Rounding::NONE);
        let off = |values: &[f64], part: &Range<usize>| {
            let apart: Vec<f64> = values[part.clone()].iter().zip(&expected[part.clone()]).map(|(a, b)| a - b).collect();
            norm(&apart) / norm(&expected[part.clone()])
        };
        let mut worst = (0.0, 0.0);
        for part in parts(&model.shape, reference.tables.len()) {
            let tolerance = rounded.iter().map(|values| off(values, &part)).fold(1e-5, f64::max) * 2.0;
            let error = off(&found, &part);
            assert!(error < tolerance, "{}, parameters {part:?}: off by {error}, which rounding makes {tolerance} at most", case.name);
            if error >= worst.0 {
                worst = (error, tolerance);
            }
        }
        let all = 0..expected.len();
        measured!(
            "{}, in training: gradients off those in halves by {:.1e} (worst part {:.1e} of at most {:.1e}), which are off exact ones by {:.1e}",
            case.name,
            off(&found, &all),
            worst.0,
            worst.1,
            off(&exact, &all)
        );
    }
}

/// Where the tables, and each layer's weights and biases, are in a gradient.
fn parts(shape: &Architecture, tables: usize) -> Vec<Range<usize>> {
    let at = |from: usize, to: usize| tables + from..tables + to;
    let layers = shape.layers.iter().flat_map(|layer| [at(layer.weights, layer.biases), at(layer.biases, layer.biases + layer.outputs)]);
    layers.chain((tables > 0).then_some(0..tables)).collect()
}

#[test]
#[ignore = "needs a GPU"]
fn adam_is_burns() {
    let (model, objective, samples) = prepare(&cases()[1]);
    let model = Model { table_moments: None, layer_moments: None, ..model };
    let mut device = training(&model, &objective);
    let pool = device.upload(&samples, None).unwrap();
    let mut before = model.clone();
    let adam = AdamConfig::new().with_beta_1(0.9).with_beta_2(0.999).with_epsilon(model.epsilon).build();
    for number in 0..5 {
        device.train_steps(&pool, None, &[step(SAMPLES, 1e-2)]).unwrap();
        let after = stored(&device, &model);
        assert_eq!(after.steps(), number + 1);
        let values = |model: &Model| (model.module.layers.val(), model.layer_moments.clone());
        step_is_burns(&format!("layers, step {number}"), &adam, values(&before), values(&after));
        let values = |model: &Model| (model.module.tables.as_ref().map(Param::val).unwrap(), model.table_moments.clone());
        step_is_burns(&format!("tables, step {number}"), &adam, values(&before), values(&after));
        before = after;
    }
}

/// Values and moments before a step and after it: given the gradient that the moments speak of, burn's Adam takes the same one.
fn step_is_burns<const D: usize>(
    name: &str,
    adam: &Adam,
    before: (Tensor<Flex, D>, Option<AdamState<Flex, D>>),
    after: (Tensor<Flex, D>, Option<AdamState<Flex, D>>),
) {
    let flat = |tensor: Tensor<Flex, D>| tensor.into_data().to_vec::<f32>().unwrap();
    let moments = after.1.unwrap().momentum;
    let gradient = match &before.1 {
        Some(state) => (moments.moment_1.clone() - state.momentum.moment_1.clone() * 0.9) / 0.1,
        None => moments.moment_1.clone() / 0.1,
    };
    let moved = (after.0.clone() - before.0.clone()).abs().max().into_scalar();
    assert!(moved > 1e-3, "{name}: nothing moves, {moved}");
    let (value, state) = SimpleOptimizer::<Flex>::step(adam, 1e-2, before.0, gradient, before.1);
    // The gradient got back by a difference is good to a few units in the last place of the moment.
    for (what, a, b, tolerance) in [
        ("parameters", flat(after.0), flat(value), 2e-5),
        ("second moments", flat(moments.moment_2), flat(state.unwrap().momentum.moment_2), 0.0),
    ] {
        for (a, b) in a.iter().zip(&b) {
            assert!((a - b).abs() <= tolerance + 2e-4 * b.abs(), "{name}: {what} {a} and {b}");
        }
    }
}

#[test]
#[ignore = "needs a GPU"]
fn training_learns_what_the_cpu_learns() {
    learns_what_the_cpu_learns("x, y and z", &[0, 1, 2], None);
}

#[test]
#[ignore = "needs a GPU"]
fn training_learns_of_the_start_time_what_the_cpu_learns() {
    learns_what_the_cpu_learns("x, y and start", &[0, 1], Some(Input::Start));
}

#[test]
#[ignore = "needs a GPU"]
fn training_learns_of_the_duration_what_the_cpu_learns() {
    learns_what_the_cpu_learns("x, z and duration", &[0, 2], Some(Input::Duration));
}

/// Of a flow map with its derivatives in the loss, by kernels that keep samples in registers and by those that take tiles.
#[test]
#[ignore = "needs a GPU"]
fn training_learns_of_derivatives_what_the_cpu_learns() {
    let usual = NetworkSettings {
        levels: Some(8),
        features: 2,
        log2_table: Some(15),
        growth: Some(1.5),
        target: Target::FlowMap,
        jacobian_weight: 0.01,
        ..NetworkSettings::default()
    };
    // At a rate of 1e-2 the loss of the wide network leaps: a thousandth of its first parameters changes its last losses by 40 % on the CPU, and by 1 % at 1e-3.
    let cases = [
        ("plane", usual.clone(), &[0, 1][..], 1e-2),
        ("space", usual.clone(), &[0, 1, 2], 1e-2),
        ("space, 256 wide", NetworkSettings { width: 256, ..usual }, &[0, 1, 2], 1e-3),
    ];
    for (name, settings, axes, rate) in cases {
        let extent = [2.0, 1.0, 1.5];
        let shape = Architecture::new(&settings, axes, extent).unwrap();
        let samples = labels(1 << 15, 7);
        let mut objective = Objective::new(&settings, &shape, extent, 1.0);
        objective.standardise(&shape, &samples, None);
        let mut model = Model::new(shape, 9, false);
        let mut device = training(&model, &objective);
        let pool = device.upload(&samples, None).unwrap();
        let (count, all) = (4096, 150);
        let steps: Vec<PlannedStep> = drawn_steps(count, all).into_iter().map(|step| PlannedStep { rate, ..step }).collect();
        let found = device.train_steps(&pool, None, &steps).unwrap();
        let (expected, _) = trained_by_cpu(&mut model, &objective, &samples, &steps);
        let mean = |losses: &[f64]| losses[losses.len() - 30..].iter().sum::<f64>() / 30.0;
        let (ours, theirs) = (mean(&found), mean(&expected));
        measured!("{name}: losses of {all} steps with derivatives: GPU {:.2e} to {ours:.3e}, CPU to {theirs:.3e}", found[0]);
        // As without derivatives.
        assert!((found[0] / expected[0] - 1.0).abs() < 1e-3, "{name}: first losses {} and {}", found[0], expected[0]);
        assert!((ours / theirs - 1.0).abs() < 0.15, "{name}: last losses {ours} and {theirs}");
        assert!(ours < 0.5 * found[0], "{name}: it learns: {} to {ours}", found[0]);
    }
}

/// Losses of steps that the CPU takes, and the mean of the parameters.
fn trained_by_cpu(model: &mut Model, objective: &Objective, samples: &Samples, steps: &[PlannedStep]) -> (Vec<f64>, Average) {
    let mut average = Average { tables: model.tables(), layers: model.layers() };
    let mut losses = Vec::new();
    Fused::new(model, objective, steps[0].count).steps(model, objective, &mut average, |done, loss| {
        losses.extend(loss);
        steps.get(done as usize).map(|step| Step::of(step, samples, None, None))
    });
    (losses, average)
}

/// Steps on batches of `count` samples, of which some move the mean of the parameters.
fn drawn_steps(count: usize, all: u64) -> Vec<PlannedStep> {
    let share = |number: u64| if number % 8 == 7 { 0.5 } else { 0.0 };
    let planned = |i: u64| PlannedStep {
        drawn: Some((21, i * count as u64)),
        hold_out: true,
        average_share: share(i),
        lazy: true,
        ..step(count, 1e-2)
    };
    (0..all).map(planned).collect()
}

/// A function of the inputs, whichever they are: who does not see one of them cannot learn it.
fn learns_what_the_cpu_learns(name: &str, axes: &[usize], time: Option<Input>) {
    let inputs = time.into_iter().collect();
    let settings =
        NetworkSettings { levels: Some(8), features: 2, log2_table: Some(15), growth: Some(1.5), inputs, ..NetworkSettings::default() };
    let extent = [1.0; 3];
    let shape = Architecture::new(&settings, axes, extent).unwrap();
    let value = |row: Row| {
        let [a, b, c] = std::array::from_fn(|k| row[shape.axes[k]]);
        1.5 * (4.0 * a).sin() + (3.0 * b).cos() * c - 0.4
    };
    let with_values = |mut samples: Samples| {
        samples.log_stretch = samples.points.iter().zip(&samples.times).map(|(&point, &times)| value(row(point, times))).collect();
        samples
    };
    let samples = with_values(labels(1 << 15, 7));
    let mut objective = Objective::new(&settings, &shape, extent, 1.0);
    objective.standardise(&shape, &samples, None);
    let (mut model, count, all) = (Model::new(shape.clone(), 9, false), 4096, 150);
    let mut device = training(&model, &objective);
    let pool = device.upload(&samples, None).unwrap();
    let steps = drawn_steps(count, all);
    let found = device.train_steps(&pool, None, &steps).unwrap();
    let (expected, average) = trained_by_cpu(&mut model, &objective, &samples, &steps);
    // The same batches: the first loss is the same up to halves, later ones drift apart like two runs of one training.
    assert!((found[0] / expected[0] - 1.0).abs() < 1e-3, "{name}: first losses {} and {}", found[0], expected[0]);
    let mean = |losses: &[f64]| losses[losses.len() - 30..].iter().sum::<f64>() / 30.0;
    measured!(
        "{name}: losses of 150 steps on the same batches: GPU {:.2e} to {:.3e}, CPU to {:.3e}",
        found[0],
        mean(&found),
        mean(&expected)
    );
    assert!((mean(&found) / mean(&expected) - 1.0).abs() < 0.15, "{name}: last losses {} and {}", mean(&found), mean(&expected));
    assert!(mean(&found) < 0.02 * found[0], "{name}: it learns");

    // What predicts is the mean, brought back or not. Points bring their times along where there is no axis.
    let held_out = with_values(labels(3001, 31));
    let of_time = |k: usize, times: &[f32; 2]| match time {
        Some(Input::Start) if !axes.contains(&k) => Some(times[0]),
        Some(Input::Duration) if !axes.contains(&k) => Some(times[1]),
        _ => None,
    };
    let place = |(point, times): (&UnitPoint, &[f32; 2])| UnitPoint(std::array::from_fn(|k| of_time(k, times).unwrap_or(point.0[k])));
    let points: Vec<UnitPoint> = held_out.points.iter().zip(&held_out.times).map(place).collect();
    let frozen = predict(&device.frozen().unwrap(), &points);
    let back = device.average().unwrap();
    let again = DeviceNetwork::upload(&gpu(), device.shape(), &objective, &back.tables, &back.layers).unwrap();
    assert_eq!(frozen, predict(&again, &points), "{name}");
    let cpu = DeviceNetwork::upload(&gpu(), device.shape(), &objective, &average.tables, &average.layers).unwrap();
    let cpu = predict(&cpu, &points);
    let spread = f64::from(objective.scale.deviation[0]) * (points.len() as f64).sqrt();
    for (whose, values) in [("the CPU's", &cpu), ("the truth", &held_out.log_stretch)] {
        let apart: Vec<f64> = frozen.iter().zip(values).map(|(a, b)| f64::from(a - b)).collect();
        assert!(norm(&apart) < 0.05 * spread, "{name}: {} of {spread} off {whose}", norm(&apart));
    }
}

/// Labels whose squares no number holds, in the loop that a run trains in: the device comes back to what it had, to the bit.
#[test]
#[ignore = "needs a GPU"]
fn a_loss_that_is_no_number_is_rolled_back() {
    let source = gyre([0.0, 0.0], [2.0, 1.0]);
    let tracer = CudaTracer::new(store(), &gpu(), source, &map(10.0, 20), 0.0, Tuning::default()).unwrap();
    let samples = traced(tracer.host(), uniform_points(1, 5_000), false);
    let settings = NetworkSettings { levels: Some(6), log2_table: Some(12), width: 32, batch: Some(2048), ..NetworkSettings::default() };
    let mut network = resident(&gpu(), Kind::Network, [2; 3], &settings, &tracer);
    let points = uniform_points(2, 2_000);
    let mut predictions = |learned: &ReplayBuffer, seconds, steps| {
        let learned = network.learn(learned, seconds, steps).unwrap();
        assert!(network.trains_on_device() && learned.device_seconds.is_some_and(|seconds| seconds > 0.0), "{learned:?}");
        let mut values = vec![f32::NAN; points.len()];
        network.predict(&points, &mut values).unwrap();
        (learned, values)
    };
    // As many at least as lie between two copies of what is good.
    let steps = if small() { 64 } else { 100 };
    let (learned, before) = predictions(&ReplayBuffer::holding(&samples), 600.0, steps);
    assert_eq!((learned.steps, learned.rollbacks, learned.lost_steps), (steps, 0, 0));
    let poison = Samples { log_stretch: vec![1e30; samples.len()], ..samples };
    let (learned, after) = predictions(&ReplayBuffer::holding(&poison), 2.0, 20);
    assert!(learned.rollbacks > 0 && learned.steps == 0 && learned.lost_steps > 0, "{learned:?}");
    assert!(before.iter().all(|value| value.is_finite()) && after == before, "what predicts is what it was");
}
