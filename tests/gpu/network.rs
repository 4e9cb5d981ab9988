//! The network on the device against the same network in f64 and against finite differences. How it is trained: `network_training.rs`.

use super::network_support::reference::{Reference, Rounding, labels, norm};
use super::network_support::{self, Case, uniform_points};
use super::scenes::*;
use super::small;
use burn::backend::Flex;
use burn::module::Param;
use burn::tensor::{Tensor, TensorData};
use ridgewatch::backend::cuda::{CudaTraining, DeviceError, DeviceNetwork, DevicePredict, DeviceTable, DeviceTraining, is_fused};
use ridgewatch::field::{Domain, DomainPoint, UnitPoint};
use ridgewatch::flow::{Boundary, FlowMap, Precision, cpu_tracer};
use ridgewatch::surrogate::network::{
    Architecture, Encoding, Input, Loss, Model, NetworkSettings, Objective, PlannedStep, Row, Target, row, stock_step,
};
use ridgewatch::surrogate::{HostNetwork, Labels, ReplayBuffer, Samples, SyncedSamples, Table, Training};

/// Whether all inputs have their places in a point, and there is one output; the others are tested in `network_flow_map`.
pub(super) fn is_plain(case: &Case) -> bool {
    case.settings.target == Target::Ftle && case.axes.len() + case.settings.inputs.len() <= 3
}

/// Of the cases that the CPU trains, the plain ones; and wider ones, that go through the kernels in one pass or two.
pub(super) fn cases() -> Vec<Case> {
    let mut cases: Vec<Case> = network_support::cases().into_iter().filter(is_plain).collect();
    let frequency = NetworkSettings { encoding: Encoding::Frequency, ..few_entries() };
    cases.extend([
        Case { name: "256 wide", settings: NetworkSettings { width: 256, hidden_layers: 3, ..frequency.clone() }, axes: &[0, 1, 2] },
        Case { name: "two passes", settings: NetworkSettings { width: 512, ..frequency }, axes: &[0, 1] },
    ]);
    cases
}

pub(super) fn few_entries() -> NetworkSettings {
    NetworkSettings {
        log2_table: Some(7),
        base_resolution: Some(4),
        growth: Some(1.2),
        octaves: 4,
        batch: Some(300),
        ..NetworkSettings::default()
    }
}

/// What has so many parameters that a test cannot afford its loss hundreds of times.
pub(super) fn larger_cases() -> [Case; 5] {
    let published = NetworkSettings { encoding: Encoding::Frequency, width: 256, ..NetworkSettings::default() };
    [
        Case { name: "three passes, tables", settings: NetworkSettings { width: 600, ..few_entries() }, axes: &[0, 1, 2] },
        Case { name: "wider encoding", settings: NetworkSettings { levels: Some(32), features: 8, ..few_entries() }, axes: &[0, 1, 2] },
        Case {
            name: "three passes, wider encoding",
            settings: NetworkSettings { width: 600, levels: Some(32), features: 8, ..few_entries() },
            axes: &[0, 1, 2],
        },
        Case { name: "2x256, as published", settings: NetworkSettings { hidden_layers: 2, ..published.clone() }, axes: &[0, 1, 2] },
        Case { name: "6x256, as published", settings: NetworkSettings { hidden_layers: 6, ..published }, axes: &[0, 1, 2] },
    ]
}

/// The networks of the paper, 8x256 to 16x512.
pub(super) fn published_cases() -> [Case; 4] {
    let case = |name, hidden_layers, width| Case {
        name,
        settings: NetworkSettings { encoding: Encoding::Frequency, hidden_layers, width, ..NetworkSettings::default() },
        axes: &[0, 1, 2],
    };
    [
        case("8x256, as published", 8, 256),
        case("16x256, as published", 16, 256),
        case("8x512, as published", 8, 512),
        case("16x512, as published", 16, 512),
    ]
}

pub(super) const SAMPLES: usize = 1000;
/// Fewer for the published networks, which the reference is slow with; not a multiple of any tile.
pub(super) const PUBLISHED_SAMPLES: usize = 67;

/// Samples whose loss a test can have from the reference hundreds of times.
fn afforded(model: &Model) -> usize {
    SAMPLES.min(5_000_000 / model.shape.layer_parameters())
}

/// A network whose values are of order 1, and samples for it.
pub(super) fn prepare(case: &Case) -> (Model, Objective, Samples) {
    trained(case, SAMPLES, afforded, 1e-2)
}

/// A published one, at a rate that so many layers bear.
pub(super) fn prepare_published(case: &Case) -> (Model, Objective, Samples) {
    trained(case, PUBLISHED_SAMPLES, |_| PUBLISHED_SAMPLES, 1e-3)
}

/// All plain cases, one after another.
pub(super) fn prepared() -> impl Iterator<Item = (Case, (Model, Objective, Samples))> {
    let plain = cases().into_iter().chain(larger_cases()).map(|case| (prepare(&case), case));
    let published = published_cases().into_iter().take(if small() { 0 } else { 4 }).map(|case| (prepare_published(&case), case));
    plain.chain(published).map(|(made, case)| (case, made))
}

/// 20 steps of training on as many of `samples` samples as `batch` says.
fn trained(case: &Case, samples: usize, batch: fn(&Model) -> usize, rate: f64) -> (Model, Objective, Samples) {
    let extent = [2.0, 1.0, 1.5];
    let shape = Architecture::new(&case.settings, case.axes, extent).unwrap();
    let mut objective = Objective::new(&case.settings, &shape, extent, 2.5);
    let samples = labels(samples, 11);
    objective.standardise(&shape, &samples, None);
    let mut model = Model::new(shape, 3, false);
    for _ in 0..20 {
        let count = batch(&model);
        stock_step(&mut model, &objective, &samples, count, rate);
    }
    (model, objective, samples)
}

/// Biases of either sign that decide alone which neurons pass, smaller weights: rounding then switches none, and gradients compare.
pub(super) fn settled(model: &Model) -> Model {
    let mut values = model.layers();
    let (_, hidden) = model.shape.layers.split_last().unwrap();
    for layer in hidden {
        values[layer.weights..layer.biases].iter_mut().for_each(|w| *w *= 0.25);
        for (neuron, bias) in values[layer.biases..layer.biases + layer.outputs].iter_mut().enumerate() {
            *bias = if neuron % 3 == 1 { -1.5 } else { 1.5 };
        }
    }
    let mut model = Model { table_moments: None, layer_moments: None, ..model.clone() };
    let count = values.len();
    model.module.layers =
        Param::initialized(model.module.layers.id, Tensor::<Flex, 1>::from_data(TensorData::new(values, [count]), &Default::default()));
    model
}

pub(super) fn step(count: usize, rate: f64) -> PlannedStep {
    PlannedStep { count, drawn: None, hold_out: false, rate, average_share: 0.0, lazy: false }
}

pub(super) fn training(model: &Model, objective: &Objective) -> DeviceTraining {
    DeviceTraining::new(&gpu(), model, objective).unwrap()
}

pub(super) fn stored(training: &DeviceTraining, like: &Model) -> Model {
    let mut model = like.clone();
    training.store(&mut model).unwrap();
    model
}

pub(super) fn predict(network: &dyn DevicePredict, points: &[UnitPoint]) -> Vec<f32> {
    let gpu = gpu();
    let flat = gpu.upload::<[f32; 3]>("points", bytemuck::cast_slice(points)).unwrap();
    let out = gpu.upload("values", &vec![f32::NAN; points.len()]).unwrap();
    // SAFETY: both buffers hold as many entries as there are points.
    unsafe { network.predict(flat.address(), points.len(), out.address()) }.unwrap();
    let mut found = vec![f32::NAN; points.len()];
    out.read(&mut found).unwrap();
    found
}

/// What the kernels take a point of three numbers for: a time stands where the network is shown no axis.
fn row_of(shape: &Architecture, point: UnitPoint) -> Row {
    let free = (0..3).find(|axis| !shape.space().contains(axis)).map_or(0.0, |axis| point.0[axis]);
    row(point, [free; 2])
}

/// Log-stretch from the reference's output.
fn read(objective: &Objective, output: f64) -> f64 {
    match objective.loss {
        Loss::MeanSquare => output * f64::from(objective.scale.deviation[0]) + f64::from(objective.scale.mean[0]),
        Loss::Published => f64::from(objective.tau) * (output.abs().exp() - 1.0).copysign(output),
    }
}

#[test]
#[ignore = "needs a GPU"]
fn predictions_are_the_references() {
    for (case, (model, objective, _)) in prepared() {
        let network = DeviceNetwork::upload(&gpu(), &model.shape, &objective, &model.tables(), &model.layers()).unwrap();
        // Not a multiple of any tile, with corners, and points outside, which are moved to the edge.
        let mut points = fresh_unit(0.0, 1.0, if small() || case.settings.hidden_layers > 6 { 203 } else { 5003 });
        points.extend([[0.0; 3], [1.0; 3], [1.0, 0.0, 1.0], [-0.5, 0.3, 2.0]].map(UnitPoint));
        let found = predict(&network, &points);
        let inside = |p: &UnitPoint| UnitPoint(p.0.map(|x| x.clamp(0.0, 1.0)));
        let rows: Vec<Row> = points.iter().map(|p| row_of(&model.shape, inside(p))).collect();
        let (halves, exact) = (Reference::in_halves(&model), Reference::new(&model));
        let values = |outputs: Vec<f64>| outputs.into_iter().map(|output| read(&objective, output)).collect::<Vec<f64>>();
        let of = |reference: &Reference<'_>| values(reference.rounded_outputs(&rows, Rounding::NONE));
        let (in_halves, exactly) = (of(&halves), of(&exact));
        let off = |found: &[f64], expected: &[f64]| {
            let apart: Vec<f64> = found.iter().zip(expected).map(|(a, b)| a - b).collect();
            (norm(&apart) / norm(expected), apart.iter().fold(0.0, |m: f64, e| if e.is_nan() { f64::INFINITY } else { m.max(e.abs()) }))
        };
        // What is left is the order of sums in single precision, and halves that this rounds to the other side; halves carry 11 bits.
        let mut tolerances = [4e-4, 2e-3];
        if model.shape.layers.len() > 8 {
            // The more layers, the more halves, and each that is rounded to the other side turns others in the layers behind it.
            let turned = roundings().map(|r| off(&values(halves.rounded_outputs(&rows, r)), &in_halves).0).fold(0.0, f64::max) * 2.0;
            tolerances = [turned, turned + off(&in_halves, &exactly).0];
        }
        let found: Vec<f64> = found.into_iter().map(f64::from).collect();
        for (name, expected, tolerance) in [("in halves", in_halves, tolerances[0]), ("exact", exactly, tolerances[1])] {
            let (error, worst) = off(&found, &expected);
            measured!(
                "{}: predictions off f64 ({name}) by {error:.1e} of their root mean square (at most {tolerance:.1e}), {worst:.1e} at most",
                case.name
            );
            assert!(error < tolerance, "{}: {name}: {error}", case.name);
            assert!(worst < 20.0 * tolerance * norm(&expected) / (expected.len() as f64).sqrt(), "{}: {name}: {worst}", case.name);
        }
    }
}

/// What the device's sums may be off by, six times at random: see `gradients_in_training_are_the_references`.
pub(super) fn roundings() -> impl Iterator<Item = Rounding> {
    (0..6).map(|seed| Rounding { part: 2_f64.powi(-20), seed })
}

/// One weight that is no number makes all predictions none, as on the CPU, and none looks like a value.
#[test]
#[ignore = "needs a GPU"]
fn a_network_that_is_no_number_predicts_none() {
    for number in 0..2 {
        let case = cases().into_iter().find(|case| (case.settings.width < 256) == (number == 0) && case.axes.len() == 3).unwrap();
        let (model, objective, _) = prepare(&case);
        assert_eq!(is_fused(&model.shape, gpu().shared_memory()), number == 0, "{}", case.name);
        let mut layers = model.layers();
        layers[0] = f32::NAN;
        let network = DeviceNetwork::upload(&gpu(), &model.shape, &objective, &model.tables(), &layers).unwrap();
        let found = predict(&network, &fresh_unit(0.0, 1.0, 203));
        assert!(found.iter().all(|value| value.is_nan()), "{}: {found:?}", case.name);
    }
}

/// After one step from no moments the first one is a tenth of the gradient.
pub(super) fn gradients(model: &Model) -> Vec<f64> {
    let moment = |values: TensorData| values.iter::<f64>().map(|m| m / 0.1).collect::<Vec<_>>();
    let tables = model.table_moments.as_ref().map(|state| moment(state.momentum.moment_1.clone().into_data()));
    let layers = moment(model.layer_moments.as_ref().unwrap().momentum.moment_1.clone().into_data());
    tables.into_iter().flatten().chain(layers).collect()
}

#[test]
#[ignore = "needs a GPU"]
fn gradients_equal_finite_differences_and_burns() {
    cases().iter().for_each(check_gradients);
}

/// Loss and gradient of a batch against burn's and against finite differences in f64.
pub(super) fn check_gradients(case: &Case) {
    let (model, objective, _) = prepare(case);
    let model = settled(&model);
    let count = afforded(&model);
    let samples = labels(count, 11);
    let mut device = training(&model, &objective);
    let pool = device.upload(&samples, None).unwrap();
    let loss = device.train_steps(&pool, None, &[step(count, 1e-9)]).unwrap()[0];
    let found = gradients(&stored(&device, &model));
    let mut stock = model.clone();
    let stock_loss = stock_step(&mut stock, &objective, &samples, count, 1e-9);
    assert!((loss / stock_loss - 1.0).abs() < 2e-3, "{}: loss {loss}, burn's {stock_loss}", case.name);
    let burns = gradients(&stock);
    let apart: Vec<f64> = found.iter().zip(&burns).map(|(a, b)| a - b).collect();
    let from_burn = norm(&apart) / norm(&burns);

    let mut reference = Reference::new(&model);
    let tables = reference.tables.len();
    let all = tables + reference.layers.len();
    let (mut differences, mut apart) = (Vec::new(), Vec::new());
    for parameter in (0..all).step_by((all / 100).max(1)) {
        let mut at = |step: f64| {
            let value = if parameter < tables { &mut reference.tables[parameter] } else { &mut reference.layers[parameter - tables] };
            let kept = std::mem::replace(value, *value + step);
            let loss = reference.loss(&objective, &samples);
            let value = if parameter < tables { &mut reference.tables[parameter] } else { &mut reference.layers[parameter - tables] };
            *value = kept;
            loss
        };
        differences.push((at(1e-6) - at(-1e-6)) / 2e-6);
        apart.push(found[parameter] - differences[differences.len() - 1]);
    }
    let from_differences = norm(&apart) / norm(&differences);
    measured!("{}: gradients off burn's by {from_burn:.1e}, off finite differences by {from_differences:.1e}", case.name);
    // Halves carry 11 bits, and their roundings average out; one of 64,000 neurons that switches is 2e-3, and more in derivatives, which jump there.
    let most = if objective.derivatives() { 1e-2 } else { 3e-3 };
    assert!(from_burn < most && from_differences < most, "{}: {from_burn} {from_differences}", case.name);
}

/// What does not fit into a warp's registers goes through the network in parts: these batches are of several (but for small ones).
#[test]
#[ignore = "needs a GPU"]
fn parts_of_a_batch_add_up() {
    let many = if small() { 3_000 } else { 150_000 };
    for name in ["wide, tables", "deep, frequency", "two passes"] {
        let case = cases().into_iter().find(|case| case.name == name).unwrap();
        let (model, objective, _) = prepare(&case);
        assert!(!is_fused(&model.shape, gpu().shared_memory()), "{name}");
        let (model, samples) = (settled(&model), labels(many, 12));
        let network = DeviceNetwork::upload(&gpu(), &model.shape, &objective, &model.tables(), &model.layers()).unwrap();
        let found = predict(&network, &samples.points);
        let reference = Reference::in_halves(&model);
        for i in (0..many).step_by(97).chain([many - 1]) {
            let expected = read(&objective, reference.outputs(row(samples.points[i], samples.times[i]))[0][0]);
            assert!((f64::from(found[i]) - expected).abs() < 1e-2, "{name}, {i}: {} and {expected}", found[i]);
        }
        let mut device = training(&model, &objective);
        let pool = device.upload(&samples, None).unwrap();
        device.train_steps(&pool, None, &[step(many, 1e-9)]).unwrap();
        let found = gradients(&stored(&device, &model));
        let mut stock = model.clone();
        stock_step(&mut stock, &objective, &samples, many, 1e-9);
        let burns = gradients(&stock);
        let apart: Vec<f64> = found.iter().zip(&burns).map(|(a, b)| a - b).collect();
        let from_burn = norm(&apart) / norm(&burns);
        measured!("{name}: gradients of {many} samples off burn's by {from_burn:.1e}");
        assert!(from_burn < 3e-3, "{name}: {from_burn}");
    }
}

#[test]
#[ignore = "needs a GPU"]
fn lines_without_a_gradient_wait() {
    // Two samples reach a few entries of a large table.
    let settings = NetworkSettings { levels: Some(2), features: 2, base_resolution: Some(40), ..NetworkSettings::default() };
    let shape = Architecture::new(&settings, &[0, 1, 2], [1.0; 3]).unwrap();
    let objective = Objective::new(&settings, &shape, [1.0; 3], 1.0);
    let model = Model::new(shape, 5, false);
    let mut device = training(&model, &objective);
    let pool = device.upload(&labels(2, 3), None).unwrap();
    let lazy = PlannedStep { lazy: true, ..step(2, 1e-2) };
    device.train_steps(&pool, None, &[lazy, lazy]).unwrap();
    let others = device.upload(&labels(2, 4), None).unwrap();
    device.train_steps(&others, None, &[lazy]).unwrap();
    let (before, after) = (model.tables(), stored(&device, &model).tables());
    let mut moved = 0;
    for (level, lines) in model.shape.levels.iter().map(|l| (l, (l.entries * 2).div_ceil(16))) {
        for line in 0..lines {
            let range = level.offset * 2 + 16 * line..(level.offset * 2 + 16 * line + 16).min((level.offset + level.entries) * 2);
            moved += usize::from(before[range.clone()] != after[range]);
        }
    }
    // Four samples, two levels, eight corners, of which pairs often share a line.
    assert!((16..=64).contains(&moved), "{moved} lines moved");
}

#[test]
#[ignore = "needs a GPU"]
fn a_table_below_adds_up() {
    let (gpu, source) = (gpu(), turbulence([40, 24, 24], 4));
    let map = FlowMap { boundary: Boundary::Clamp, precision: Precision::F32, ..map(3.0, 9) };
    let tracer = cpu_tracer(source.clone(), &map, 0.0).unwrap();
    let table = Table::trace(&tracer, [20, 12, 12]).unwrap();
    let base = DeviceTable::upload(&gpu, &domain(&source), &table).unwrap();
    let (model, objective, _) = prepare(&cases()[1]);
    let points = fresh_unit(0.0, 1.0, 4001);
    let network = DeviceNetwork::upload(&gpu, &model.shape, &objective, &model.tables(), &model.layers()).unwrap();
    let alone = predict(&network, &points);
    let sum = predict(&network.above(Some((&base, 0.7))), &points);
    let mut below = vec![0.0; points.len()];
    table.interpolate(&points, &mut below);
    for ((sum, alone), below) in sum.iter().zip(&alone).zip(&below) {
        assert!((sum - (below + 0.7 * alone)).abs() < 1e-5, "{sum} = {below} + 0.7 * {alone}");
    }
    // Trained on what the labels have beyond the table: where they are the table's own values, nothing is left to learn.
    let zero = Model::new(model.shape.clone(), 2, true);
    let mut device = training(&zero, &Objective { scale: Default::default(), ..objective.clone() });
    let labels = Samples { log_stretch: below.clone(), points, ..Samples::default() };
    let pool = device.upload(&labels, Some(&base)).unwrap();
    let loss = device.train_steps(&pool, None, &[step(4000, 1e-3)]).unwrap()[0];
    assert!(loss < 1e-10, "{loss}");
    let pool = device.upload(&labels, None).unwrap();
    let loss = device.train_steps(&pool, None, &[step(4000, 1e-3)]).unwrap()[0];
    let expected = below[..4000].iter().map(|s| f64::from(s * s)).sum::<f64>() / 4000.0;
    assert!((loss / expected - 1.0).abs() < 0.01, "{loss} {expected}");
}

#[test]
#[ignore = "needs a GPU"]
fn held_out_and_broken_samples_are_not_learned_from() {
    let (model, objective, mut samples) = prepare(&cases()[0]);
    for index in (0..SAMPLES).step_by(64) {
        samples.log_stretch[index] = 1e6;
    }
    samples.log_stretch[5] = f32::NAN;
    samples.log_stretch[6] = f32::INFINITY;
    samples.points[7].0[1] = f32::NAN;
    let mut device = training(&model, &objective);
    let pool = device.upload(&samples, None).unwrap();
    let drawn = |hold_out| PlannedStep { drawn: Some((1, 0)), hold_out, ..step(5000, 1e-3) };
    let losses = device.train_steps(&pool, None, &[drawn(true); 3]).unwrap();
    assert!(losses.iter().all(|loss| *loss < 1.0), "{losses:?}");
    assert!(stored(&device, &model).tables().iter().all(|x| x.is_finite()));
    let losses = device.train_steps(&pool, None, &[drawn(false)]).unwrap();
    assert!(losses[0] > 1e3, "the held-out ones are there: {losses:?}");
}

#[test]
#[ignore = "needs a GPU"]
fn what_the_kernels_do_not_take_is_refused() {
    let settings = NetworkSettings { log2_table: Some(10), target: Target::FlowMap, ..NetworkSettings::default() };
    let shape = Architecture::new(&settings, &[1], [1.0; 3]).unwrap();
    let objective = Objective::new(&settings, &shape, [1.0; 3], 1.0);
    let refused = DeviceTraining::new(&gpu(), &Model::new(shape, 1, false), &objective).unwrap_err();
    assert!(matches!(refused, DeviceError::Unsupported { .. }), "{refused}");
}

/// Points that bring no times along are answered for those that the network is asked for, on the device and from the host.
#[test]
#[ignore = "needs a GPU"]
fn times_stand_where_no_axis_does() {
    for case in cases().into_iter().filter(|case| !case.settings.inputs.is_empty()) {
        let (model, objective, _) = prepare(&case);
        let network = DeviceNetwork::upload(&gpu(), &model.shape, &objective, &model.tables(), &model.layers()).unwrap();
        let free = (0..3).find(|axis| !case.axes.contains(axis)).unwrap();
        let points = uniform_points(4, 700);
        let brought: Vec<UnitPoint> =
            points.iter().map(|point| UnitPoint(std::array::from_fn(|k| if k == free { 0.3 } else { point.0[k] }))).collect();
        let times = if case.settings.inputs == [Input::Start] { [0.3, 0.9] } else { [0.9, 0.3] };
        assert_eq!(predict(&network.above(None).at(times), &points), predict(&network, &brought), "{}", case.name);
    }
}

#[test]
#[ignore = "needs a GPU"]
fn a_ring_keeps_the_newest() {
    let (model, objective, _) = prepare(&cases()[0]);
    let device = training(&model, &objective);
    let unit = Domain::cuboid([0.0; 3], [1.0; 3]);
    let mut buffer = device.replay_buffer(1000).unwrap();
    let mut expected = vec![[f32::NAN; 4]; 1000];
    let mut written = 0;
    for (seed, count) in [(1, 300), (2, 500), (3, 300), (4, 1000), (5, 1)] {
        let samples = labels(count, seed);
        let (points, values) = (
            gpu().upload::<[f32; 3]>("points", bytemuck::cast_slice(&samples.points)).unwrap(),
            gpu().upload("values", &samples.log_stretch).unwrap(),
        );
        // SAFETY: both buffers hold `count` entries and are freed in the order of the work stream.
        unsafe { device.append(&mut buffer, &unit, points.address(), values.address(), count, None) }.unwrap();
        for (p, s) in samples.points.iter().zip(&samples.log_stretch) {
            expected[written % 1000] = [p.0[0], p.0[1], p.0[2], (s - objective.scale.mean[0]) / objective.scale.deviation[0]];
            written += 1;
        }
        assert_eq!(buffer.len(), written.min(1000));
        for (found, expected) in buffer.values().unwrap().iter().zip(&expected) {
            assert!(found.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-6), "{found:?} {expected:?}");
        }
    }
}

#[test]
#[ignore = "needs a GPU"]
fn what_is_kept_comes_back() {
    let (model, objective, samples) = prepare(&cases()[1]);
    let mut device = training(&model, &objective);
    let pool = device.upload(&samples, None).unwrap();
    let steps = |count| vec![PlannedStep { average_share: 0.3, ..step(SAMPLES, 1e-2) }; count];
    let all = |device: &DeviceTraining| {
        let model = stored(device, &model);
        let moments = model.layer_moments.map(|state| state.momentum.moment_2.into_data().to_vec::<f32>().unwrap());
        (model.module.layers.val().into_data().to_vec::<f32>().unwrap(), moments, device.average().unwrap(), device.steps())
    };
    device.train_steps(&pool, None, &steps(3)).unwrap();
    device.keep().unwrap();
    let (kept, points) = (all(&device), uniform_points(3, 100));
    let predicted = predict(&device.frozen().unwrap(), &points);
    let losses = device.train_steps(&pool, None, &steps(4)).unwrap();
    assert!(all(&device) != kept && predict(&device.frozen().unwrap(), &points) != predicted);
    device.roll_back().unwrap();
    assert!(all(&device) == kept && predict(&device.frozen().unwrap(), &points) == predicted);
    // The rounded tables come back too: the first loss is the same up to the order of sums.
    let again = device.train_steps(&pool, None, &steps(1)).unwrap();
    assert!((again[0] / losses[0] - 1.0).abs() < 1e-5, "{} and {}", again[0], losses[0]);
    device.restart_average().unwrap();
    let (now, ..) = all(&device);
    assert_eq!(device.average().unwrap().layers, now);
    device.set_average(&kept.2).unwrap();
    assert_eq!(device.average().unwrap(), kept.2);
    let layers = kept.0.len();
    device.zero_layers(layers - 65..layers).unwrap();
    let (values, _, mean, _) = all(&device);
    assert!(values[layers - 65..].iter().chain(&mean.layers[layers - 65..]).all(|v| *v == 0.0));
    assert!(values[..layers - 65] == now[..layers - 65] && mean.layers[..layers - 65] == kept.2.layers[..layers - 65]);
}

/// Samples come over from a replay buffer that fills up, goes round, and is moved: a step on all of them has the CPU's loss on the buffer.
#[test]
#[ignore = "needs a GPU"]
fn a_ring_is_followed_wherever_it_writes() {
    let (model, objective, _) = prepare(&cases()[1]);
    assert!(DeviceNetwork::takes(&gpu(), &model.shape));
    let mut device = CudaTraining::new(&gpu(), HostNetwork::fresh(model.clone()), true);
    device.begin(&objective, 1 << 16, 1 << 10).unwrap();
    let mut buffer = ReplayBuffer::new(1000);
    let mut follow = |buffer: &ReplayBuffer, broken: usize| {
        let labels = Labels { buffer, base: None };
        assert_eq!(device.sync(&objective, labels).unwrap(), SyncedSamples { usable: buffer.len() - broken, dropped: broken });
        let found = device.train(&objective, labels, &[step(buffer.len(), 1e-12)]).unwrap()[0];
        let finite: Vec<usize> = (0..buffer.len()).filter(|&i| buffer.samples().log_stretch[i].is_finite()).collect();
        let samples = Samples {
            points: finite.iter().map(|&i| buffer.samples().points[i]).collect(),
            log_stretch: finite.iter().map(|&i| buffer.samples().log_stretch[i]).collect(),
            ..Samples::default()
        };
        let expected = stock_step(&mut model.clone(), &objective, &samples, samples.len(), 1e-12);
        assert!((found / expected - 1.0).abs() < 2e-3, "{} samples: {found} and {expected}", buffer.len());
    };
    for (seed, count) in [(1, 300), (2, 500), (3, 300), (4, 1), (5, 1000), (6, 999), (7, 2500)] {
        let mut samples = labels(count, seed);
        // What is left of other pushes shows in the loss.
        samples.log_stretch.iter_mut().for_each(|s| *s += seed as f32);
        buffer.push(&samples);
        follow(&buffer, 0);
    }
    buffer.mark_stale();
    let mut samples = labels(10, 9);
    samples.log_stretch[4] = f32::NAN;
    buffer.push(&samples);
    // Those set aside are not there, though the device has them.
    follow(&buffer, 1);
    buffer.revalidate(1.0);
    follow(&buffer, 1);
    follow(&ReplayBuffer::holding(&labels(700, 10)), 0);
    assert!(device.device_seconds().unwrap() > 0.0 && device.device_seconds() == Some(0.0), "asked for once");
}

#[test]
#[ignore = "needs a GPU"]
fn drawn_points_fill_the_domain() {
    let (model, objective, _) = prepare(&cases()[0]);
    let device = training(&model, &objective);
    let domain = Domain::cuboid([-1.0, 0.0, 10.0], [1.0, 0.5, 40.0]);
    let mut buffer = gpu().upload("points", &[[f32::NAN; 3]; 1 << 16]).unwrap();
    device.draw_points(&domain, 5, 1 << 40, &mut buffer).unwrap();
    let mut points = vec![[0.0; 3]; 1 << 16];
    buffer.read(&mut points).unwrap();
    assert!(points.iter().all(|&p| domain.contains(DomainPoint(p))));
    for axis in 0..3 {
        // Sixteen even parts; six standard deviations of their counts.
        let mut counts = [0_i32; 16];
        points.iter().for_each(|&p| counts[(domain.to_unit(DomainPoint(p)).0[axis] * 16.0).min(15.0) as usize] += 1);
        assert!(counts.iter().all(|c| (c - 4096).abs() < 6 * 64), "{counts:?}");
    }
}
