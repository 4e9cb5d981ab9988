//! The three ways to train, against one another, against finite differences in f64, and Adam against burn's.

#![allow(clippy::unwrap_used)]

mod network_support;

use network_support::uniform_points;
use ridgewatch::surrogate::Samples;
use ridgewatch::surrogate::network::{
    Architecture, Average, Encoding, Fused, Loss, Model, NetworkSettings, Objective, Pick, Step, Target, autodiff_gradient, operation_step,
    stock_step,
};

/// The same network in f64, written from the definition: no tiles, no panels, no burn.
struct Reference<'a> {
    shape: &'a Architecture,
    tables: Vec<f64>,
    layers: Vec<f64>,
}

impl Reference<'_> {
    /// Outputs and their derivatives along the axes: `[1 + axes][outputs]`.
    fn outputs(&self, point: [f32; 3]) -> Vec<Vec<f64>> {
        let shape = self.shape;
        let x: Vec<f32> = shape.axes.iter().map(|&a| point[a]).collect();
        let d = x.len();
        let mut rows = vec![Vec::new(); 1 + d];
        match shape.encoding {
            Encoding::HashGrid => {
                for level in &shape.levels {
                    let mut cell = vec![0_u32; d];
                    let mut share = vec![0.0_f64; d];
                    for a in 0..d {
                        // The cell is found in f32 as everywhere: a point on an edge must not fall to the other side.
                        let position = x[a] * level.cells[a] as f32;
                        cell[a] = (position as u32).min(level.cells[a] - 1);
                        share[a] = f64::from(position - cell[a] as f32);
                    }
                    for f in 0..shape.features {
                        for (group, row) in rows.iter_mut().enumerate() {
                            let mut sum = 0.0;
                            for corner in 0..1_u32 << d {
                                let side = |a: usize| (corner >> a) & 1;
                                let node: Vec<u32> = (0..d).map(|a| cell[a] + side(a)).collect();
                                let index = if level.hashed {
                                    let primes = [1_u32, 2_654_435_761, 805_459_861];
                                    let hash = (0..d).fold(0, |h, a| h ^ node[a].wrapping_mul(primes[a]));
                                    hash as usize % level.entries
                                } else {
                                    (0..d).rev().fold(0, |i, a| i * (level.cells[a] as usize + 1) + node[a] as usize)
                                };
                                let weight: f64 = (0..d)
                                    .map(|a| match (group == a + 1, side(a)) {
                                        (true, 1) => f64::from(level.cells[a]),
                                        (true, _) => -f64::from(level.cells[a]),
                                        (false, 1) => share[a],
                                        (false, _) => 1.0 - share[a],
                                    })
                                    .product();
                                sum += weight * self.tables[(level.offset + index) * shape.features + f];
                            }
                            row.push(sum);
                        }
                    }
                }
            }
            Encoding::Frequency => {
                for a in 0..d {
                    for octave in 0..shape.octaves {
                        let k = std::f64::consts::FRAC_PI_2 * f64::from(1 << octave);
                        let angle = k * (2.0 * f64::from(x[a]) - 1.0);
                        rows[0].extend([angle.sin(), angle.cos()]);
                        for along in 0..d {
                            let slope = if along == a { 2.0 * k } else { 0.0 };
                            rows[1 + along].extend([slope * angle.cos(), -slope * angle.sin()]);
                        }
                    }
                }
            }
        }
        for (number, layer) in shape.layers.iter().enumerate() {
            let linear = |row: &[f64], bias: bool| -> Vec<f64> {
                (0..layer.outputs)
                    .map(|o| {
                        let start = if bias { self.layers[layer.biases + o] } else { 0.0 };
                        (0..layer.inputs).fold(start, |sum, i| sum + row[i] * self.layers[layer.weights + i * layer.outputs + o])
                    })
                    .collect()
            };
            rows = rows.iter().enumerate().map(|(group, row)| linear(row, group == 0)).collect();
            if number + 1 < shape.layers.len() {
                let passed: Vec<bool> = rows[0].iter().map(|&z| z > 0.0).collect();
                for row in &mut rows {
                    row.iter_mut().zip(&passed).for_each(|(z, &p)| *z = if p { *z } else { 0.0 });
                }
            }
        }
        rows
    }

    fn loss(&self, objective: &Objective, samples: &Samples) -> f64 {
        let count = samples.len() as f64;
        let outputs = self.shape.outputs();
        let (mut loss, mut linear) = (0.0, 0.0);
        for i in 0..samples.len() {
            let rows = self.outputs(samples.points[i]);
            if objective.target == Target::Ftle {
                let y = f64::from(samples.log_stretch[i]);
                let target = match objective.loss {
                    Loss::MeanSquare => (y - f64::from(objective.scale.mean[0])) / f64::from(objective.scale.deviation[0]),
                    Loss::Published => {
                        let y = y / f64::from(objective.tau);
                        linear += (rows[0][0].abs().exp() - 1.0).copysign(rows[0][0]) - y;
                        (1.0 + y.abs()).ln().copysign(y)
                    }
                };
                loss += (rows[0][0] - target).powi(2) / count;
            } else {
                for (o, &axis) in self.shape.axes.iter().enumerate() {
                    let deviation = f64::from(objective.scale.deviation[o]);
                    let moved = f64::from(samples.arrival[i][axis] - samples.points[i][axis]);
                    let target = (moved - f64::from(objective.scale.mean[o])) / deviation;
                    loss += (rows[0][o] - target).powi(2) / (count * outputs as f64);
                    for (a, &along) in self.shape.axes.iter().enumerate() {
                        let identity = if axis == along { 1.0 } else { 0.0 };
                        let target = (f64::from(samples.jacobian[i][3 * axis + along]) - identity) / deviation;
                        let weight = f64::from(objective.jacobian_weight) / self.shape.axes.len() as f64;
                        loss += weight * (rows[1 + a][o] - target).powi(2) / (count * outputs as f64);
                    }
                }
            }
        }
        if objective.loss == Loss::Published && objective.target == Target::Ftle {
            loss += f64::from(objective.mean_penalty) * (linear / count).powi(2);
        }
        loss
    }
}

struct Case {
    name: &'static str,
    settings: NetworkSettings,
    axes: &'static [usize],
}

fn cases() -> Vec<Case> {
    let small = NetworkSettings {
        levels: 3,
        features: 2,
        log2_table: 7,
        base_resolution: 4,
        growth: 2.0,
        octaves: 4,
        width: 16,
        batch: 300,
        learning_rate: Some(1e-2),
        ..NetworkSettings::default()
    };
    let flow_map = NetworkSettings { target: Target::FlowMap, jacobian_weight: 0.3, ..small.clone() };
    vec![
        Case { name: "hash grid, 2 axes", settings: small.clone(), axes: &[0, 1] },
        Case { name: "hash grid, 3 axes, 4 features", settings: NetworkSettings { features: 4, ..small.clone() }, axes: &[0, 1, 2] },
        Case { name: "hash grid, x and z", settings: small.clone(), axes: &[0, 2] },
        Case { name: "hash grid, 1 axis, odd width", settings: NetworkSettings { width: 21, features: 1, ..small.clone() }, axes: &[1] },
        Case {
            name: "frequency, 4 layers of 40",
            settings: NetworkSettings { encoding: Encoding::Frequency, hidden_layers: 4, width: 40, ..small.clone() },
            axes: &[0, 1],
        },
        Case { name: "one hidden layer", settings: NetworkSettings { hidden_layers: 1, ..small.clone() }, axes: &[0, 1] },
        Case {
            name: "published loss",
            settings: NetworkSettings { loss: Loss::Published, mean_penalty: 0.7, ..small.clone() },
            axes: &[0, 1],
        },
        Case { name: "flow map, 2 axes", settings: flow_map.clone(), axes: &[0, 1] },
        Case { name: "flow map, 3 axes", settings: flow_map.clone(), axes: &[0, 1, 2] },
        Case {
            name: "flow map, frequency",
            settings: NetworkSettings { encoding: Encoding::Frequency, octaves: 2, ..flow_map },
            axes: &[0, 1],
        },
    ]
}

/// Smooth labels, not those of any flow: the gradients do not care.
fn labels(count: usize, seed: u64) -> Samples {
    let points = uniform_points(seed, count);
    let value = |p: &[f32; 3]| 1.5 * (4.0 * p[0]).sin() + (3.0 * p[1]).cos() * p[2] - 0.4;
    let arrival = |p: &[f32; 3]| [p[0] + 0.2 * (3.0 * p[1]).sin(), p[1] - 0.3 * p[0] * p[2], p[2] + 0.1 * p[0]];
    let jacobian = |p: &[f32; 3]| [1.0, 0.6 * (3.0 * p[1]).cos(), 0.0, -0.3 * p[2], 1.0, -0.3 * p[0], 0.1, 0.0, 1.0];
    Samples {
        log_stretch: points.iter().map(value).collect(),
        arrival: points.iter().map(arrival).collect(),
        jacobian: points.iter().map(jacobian).collect(),
        points,
    }
}

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
        Some(Step { samples, pick: Pick::InOrder, count: samples.len(), rate, average_share: 1.0, lazy: false, base: None })
    });
    losses
}

/// Forgets the moments, so that after one step the first moment is the gradient / 10.
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

fn norm(values: &[f64]) -> f64 {
    values.iter().map(|v| v * v).sum::<f64>().sqrt()
}

#[test]
fn gradients_equal_finite_differences_in_f64() {
    for case in cases() {
        let (model, objective, samples) = prepare(&case);
        let (mut fused, mut stock) = (fresh(&model), fresh(&model));
        let loss = fused_steps(&mut fused, &objective, &samples, &[1e-9])[0];
        let stock_loss = stock_step(&mut stock, &objective, &samples, 300, 1e-9);
        let (fused, stock) = (gradients(&fused), gradients(&stock));

        let wide = |values: Vec<f32>| -> Vec<f64> { values.into_iter().map(f64::from).collect() };
        let mut reference = Reference { shape: &model.shape, tables: wide(model.tables()), layers: wide(model.layers()) };
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
        for (name, found) in [("fused", &fused), ("stock", &stock)] {
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
            // Adam divides by tiny second moments, so roundings of vanishing gradients show; they must stay small against the way travelled.
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
        // A step moves a weight by about the rate, 1e-2; the gradients behind it agree to about 1e-5 of it, the small ones to less.
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
        points.extend([[0.0; 3], [1.0; 3], [1.0, 0.0, 1.0]]);
        let flat: Vec<f32> = points.iter().flat_map(|p| case.axes.iter().map(|&a| p[a])).collect();
        let tensor = Tensor::<Flex, 2>::from_data(TensorData::new(flat, [points.len(), case.axes.len()]), &Default::default());
        let stock = model.module.forward(&shape, tensor.clone()).into_data().to_vec::<f32>().unwrap();
        let fused = model.module.forward_fused(&shape, tensor).into_data().to_vec::<f32>().unwrap();
        let wide = |values: Vec<f32>| -> Vec<f64> { values.into_iter().map(f64::from).collect() };
        let reference = Reference { shape: &model.shape, tables: wide(model.tables()), layers: wide(model.layers()) };
        for (i, &point) in points.iter().enumerate() {
            for (o, expected) in reference.outputs(point)[0].iter().enumerate() {
                let at = i * model.shape.outputs() + o;
                // Frequencies up to 2^3 pi/2 and weights of order 1 lose two digits of f32.
                assert!((f64::from(stock[at]) - expected).abs() < 2e-5 * expected.abs().max(1.0), "{}: stock {point:?}", case.name);
                assert!((f64::from(fused[at]) - expected).abs() < 2e-5 * expected.abs().max(1.0), "{}: fused {point:?}", case.name);
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
