//! The three training paths compared with one another and with finite differences in f64, and Adam compared with burn's.

#![allow(clippy::unwrap_used)]

mod network_support;

use network_support::reference::{Kernel, Reference, Rounding, labels, norm};
use network_support::{Case, cases, uniform_points};
use ridgewatch::field::UnitPoint;
use ridgewatch::surrogate::Samples;
use ridgewatch::surrogate::network::{
    Architecture, Average, Fused, Model, Objective, PlannedStep, Row, Step, Target, autodiff_gradient, operation_step, row, stock_step,
};

fn prepare(case: &Case) -> (Model, Objective, Samples) {
    let extent = [2.0, 1.0, 1.5];
    let shape = Architecture::new(&case.settings, case.axes, extent).unwrap();
    let mut objective = Objective::new(&case.settings, &shape, extent, 2.5);
    let samples = labels(300, 11);
    objective.standardise(&shape, &samples, None);
    let mut model = Model::new(shape, 3, false);
    // A few steps move the tables away from zero, where their gradients would be tiny, and the ReLUs off their starting pattern.
    for _ in 0..20 {
        stock_step(&mut model, &objective, &samples, 300, 1e-2);
    }
    (model, objective, samples)
}

fn fused_steps(model: &mut Model, objective: &Objective, samples: &Samples, rates: &[f64]) -> Vec<f64> {
    let mut fused = Fused::new(model, objective, samples.len());
    let mut average = Average { tables: model.tables(), layers: model.layers() };
    let mut losses = Vec::new();
    fused.steps(model, objective, &mut average, |done, loss| {
        losses.extend(loss);
        let rate = *rates.get(done as usize)?;
        let planned = PlannedStep { count: samples.len(), drawn: None, hold_out: false, rate, average_share: 1.0, lazy: false };
        Some(Step::of(&planned, samples, None, None))
    });
    losses
}

/// The model without moments: after one step, its first moment is the gradient / 10.
fn fresh(model: &Model) -> Model {
    Model { table_moments: None, layer_moments: None, ..model.clone() }
}

fn gradients(model: &Model) -> Vec<f64> {
    let mut all = Vec::new();
    if let Some(state) = &model.table_moments {
        all.extend(state.momentum.moment_1.clone().into_data().iter::<f64>().map(|m| m / 0.1));
    }
    let state = model.layer_moments.as_ref().unwrap();
    all.extend(state.momentum.moment_1.clone().into_data().iter::<f64>().map(|m| m / 0.1));
    all
}

#[test]
fn gradients_equal_finite_differences_in_f64() {
    for case in cases() {
        let (model, objective, samples) = prepare(&case);
        let (mut fused, mut stock) = (fresh(&model), fresh(&model));
        let loss = fused_steps(&mut fused, &objective, &samples, &[1e-9])[0];
        let stock_loss = stock_step(&mut stock, &objective, &samples, 300, 1e-9);
        let (fused, stock) = (gradients(&fused), gradients(&stock));

        let mut reference = Reference::new(&model);
        // The gradient by hand is the reference of the device's kernels.
        let known = objective.target == Target::Ftle && objective.mean_penalty == 0.0;
        let by_hand = known.then(|| reference.gradient(&objective, &samples, Kernel::Fused, Rounding::NONE));
        let expected = reference.loss(&objective, &samples);
        // f32 sums of a few hundred terms.
        assert!((loss / expected - 1.0).abs() < 1e-4, "{}: fused loss {loss}, f64 {expected}", case.name);
        assert!((stock_loss / expected - 1.0).abs() < 1e-4, "{}: stock loss {stock_loss}, f64 {expected}", case.name);

        let tables = reference.tables.len();
        let all = tables + reference.layers.len();
        let mut checked = Vec::new();
        for parameter in (0..all).step_by((all / 150).max(1)) {
            let mut at = |step: f64| {
                let value = if parameter < tables { &mut reference.tables[parameter] } else { &mut reference.layers[parameter - tables] };
                let kept = *value;
                *value += step;
                let loss = reference.loss(&objective, &samples);
                let value = if parameter < tables { &mut reference.tables[parameter] } else { &mut reference.layers[parameter - tables] };
                *value = kept;
                loss
            };
            // Small enough that hardly any ReLU switches inside the step, large enough for f64.
            checked.push((parameter, (at(1e-6) - at(-1e-6)) / 2e-6));
        }
        let expected: Vec<f64> = checked.iter().map(|c| c.1).collect();
        for (name, found) in [("fused", &fused), ("stock", &stock)].into_iter().chain(by_hand.as_ref().map(|found| ("f64", found))) {
            let difference: Vec<f64> = checked.iter().map(|&(p, g)| found[p] - g).collect();
            // f32 rounding over three hundred samples is 1e-6 to 1e-5; one ReLU that switches inside the difference step is 1e-4.
            let error = norm(&difference) / norm(&expected);
            assert!(error < 1e-3, "{}: {name} gradients are off by {error} (relative norm)", case.name);
        }
    }
}

#[test]
fn three_ways_give_the_same_gradient() {
    for case in cases() {
        let (model, objective, samples) = prepare(&case);
        let plain = Objective { jacobian_weight: 0.0, ..objective.clone() };
        let (mut stock, mut operation, mut fused) = (fresh(&model), fresh(&model), fresh(&model));
        stock_step(&mut stock, &plain, &samples, 300, 1e-9);
        operation_step(&mut operation, &plain, &samples, 300, 1e-9);
        fused_steps(&mut fused, &plain, &samples, &[1e-9]);
        let (stock, operation, fused) = (gradients(&stock), gradients(&operation), gradients(&fused));
        for (name, other) in [("operation", operation), ("train_steps", fused)] {
            let difference: Vec<f64> = stock.iter().zip(&other).map(|(a, b)| a - b).collect();
            let error = norm(&difference) / norm(&stock);
            // The same f32 sums in another order.
            assert!(error < 2e-5, "{}: {name} differs from stock by {error}", case.name);
        }
    }
}

#[test]
fn three_ways_stay_together_over_many_steps() {
    for case in cases() {
        let (model, objective, samples) = prepare(&case);
        let plain = Objective { jacobian_weight: 0.0, ..objective };
        let (mut stock, mut operation, mut fused) = (model.clone(), model.clone(), model.clone());
        let rates: Vec<f64> = (0..25).map(|i| 1e-3 / f64::from(1 + i)).collect();
        let stock_losses: Vec<f64> = rates.iter().map(|&rate| stock_step(&mut stock, &plain, &samples, 300, rate)).collect();
        for &rate in &rates {
            operation_step(&mut operation, &plain, &samples, 300, rate);
        }
        let fused_losses = fused_steps(&mut fused, &plain, &samples, &rates);
        for (a, b) in stock_losses.iter().zip(&fused_losses) {
            assert!((a / b - 1.0).abs() < 1e-3, "{}: losses {a} and {b}", case.name);
        }
        assert_eq!((stock.steps(), operation.steps(), fused.steps()), (45, 45, 45));
        let moved: Vec<f64> = stock.layers().iter().zip(model.layers()).map(|(a, b)| f64::from(a - b)).collect();
        for other in [&operation, &fused] {
            let apart: Vec<f64> = stock.layers().iter().zip(other.layers()).map(|(a, b)| f64::from(a - b)).collect();
            // Adam divides by tiny second moments, which amplifies rounding of vanishing gradients; it must stay small beside the way
            // travelled.
            assert!(norm(&apart) < 2e-2 * norm(&moved), "{}: {} apart after {}", case.name, norm(&apart), norm(&moved));
        }
    }
}

#[test]
fn adam_equals_burns_step_for_step() {
    let case = &cases()[0];
    let (model, objective, samples) = prepare(case);
    let (mut stock, mut fused) = (model.clone(), model);
    for step in 0..6 {
        // Both start each step from the same state, so that only Adam's own arithmetic is compared.
        fused_steps(&mut fused, &objective, &samples, &[1e-2]);
        stock_step(&mut stock, &objective, &samples, 300, 1e-2);
        let moments = |m: &Model| m.layer_moments.as_ref().unwrap().momentum.moment_2.clone().into_data().to_vec::<f32>().unwrap();
        let largest = stock.layers().iter().zip(fused.layers()).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
        // A step moves a weight by about the rate, 1e-2; large gradients agree to about 1e-5, small ones less well.
        assert!(largest < 2e-4, "step {step}: {largest}");
        for (a, b) in moments(&stock).iter().zip(moments(&fused)) {
            assert!((a - b).abs() <= 1e-4 * a.abs() + 1e-12, "step {step}: second moments {a} and {b}");
        }
        fused = stock.clone();
    }
}

#[test]
fn predictions_of_all_ways_agree() {
    use burn::backend::Flex;
    use burn::tensor::{Tensor, TensorData};
    for case in cases() {
        let (model, ..) = prepare(&case);
        let shape = std::sync::Arc::new(model.shape.clone());
        // Not a multiple of any tile, with the corners of the domain.
        let mut points = uniform_points(8, 1237);
        points.extend([[0.0; 3], [1.0; 3], [1.0, 0.0, 1.0]].map(UnitPoint));
        let rows: Vec<Row> = points.iter().map(|&point| row(point, [point.0[2], point.0[0]])).collect();
        let flat: Vec<f32> = rows.iter().flat_map(|row| shape.axes.iter().map(|&a| row[a])).collect();
        let tensor = Tensor::<Flex, 2>::from_data(TensorData::new(flat, [rows.len(), shape.inputs()]), &Default::default());
        let stock = model.module.forward(&shape, tensor.clone()).into_data().to_vec::<f32>().unwrap();
        let fused = model.module.forward_fused(&shape, tensor).into_data().to_vec::<f32>().unwrap();
        let reference = Reference::new(&model);
        for (i, &row) in rows.iter().enumerate() {
            for (o, expected) in reference.outputs(row)[0].iter().enumerate() {
                let at = i * model.shape.outputs() + o;
                // Frequencies up to 2^3 pi/2 and weights of order 1 lose two digits of f32.
                assert!((f64::from(stock[at]) - expected).abs() < 2e-5 * expected.abs().max(1.0), "{}: stock {row:?}", case.name);
                assert!((f64::from(fused[at]) - expected).abs() < 2e-5 * expected.abs().max(1.0), "{}: fused {row:?}", case.name);
            }
        }
    }
}

#[test]
fn gradients_do_not_depend_on_the_number_of_threads() {
    let case = &cases()[1];
    let (model, objective, samples) = prepare(case);
    let with = |threads: usize| {
        let mut model = model.clone();
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| fused_steps(&mut model, &objective, &samples, &[1e-2; 8]));
        (model.tables(), model.layers())
    };
    assert_eq!(with(1), with(3));
}

#[test]
fn burns_autodiff_sees_the_whole_module() {
    let case = &cases()[0];
    let (model, objective, samples) = prepare(case);
    let (_, network, mut gradients) =
        autodiff_gradient(&model, &objective, &samples, 300, |network, shape, points, _| vec![network.forward_fused(shape, points)]);
    let tables = gradients.remove::<burn::backend::Flex, 2>(network.tables.as_ref().unwrap().id);
    assert_eq!(tables.unwrap().dims(), [model.shape.table_entries(), 2]);
}
