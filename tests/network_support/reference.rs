//! Networks in f64, and labels for them.

use super::uniform_points;
use ridgewatch::surrogate::Samples;
use ridgewatch::surrogate::network::{Architecture, Encoding, Loss, Model, Objective, Row, Target, row};

/// Rounded to half precision (11 bits, 2^-24 at least apart), ties to even.
fn half(x: f64) -> f64 {
    let exponent = if x == 0.0 { -14.0 } else { x.abs().log2().floor().max(-14.0) };
    let spacing = (exponent - 10.0).exp2();
    (x / spacing).round_ties_even() * spacing
}

/// The same network in f64, written from the definition: no tiles, no panels, no burn.
pub struct Reference<'a> {
    pub shape: &'a Architecture,
    pub tables: Vec<f64>,
    pub layers: Vec<f64>,
    /// What is done to values between layers.
    between: fn(f64) -> f64,
}

impl<'a> Reference<'a> {
    /// Of the model's parameters as they are.
    pub fn new(model: &'a Model) -> Self {
        let wide = |values: Vec<f32>| values.into_iter().map(f64::from).collect();
        Self { shape: &model.shape, tables: wide(model.tables()), layers: wide(model.layers()), between: |x| x }
    }

    /// The same with tables, weights and the values between layers in half precision, biases and sums as they are.
    pub fn in_halves(model: &'a Model) -> Self {
        let mut halves = Self { between: half, ..Self::new(model) };
        halves.tables.iter_mut().for_each(|x| *x = half(*x));
        for layer in &model.shape.layers {
            halves.layers[layer.weights..layer.biases].iter_mut().for_each(|x| *x = half(*x));
        }
        halves
    }

    /// Outputs and their derivatives along the inputs: `[1 + inputs][outputs]`.
    pub fn outputs(&self, row: Row) -> Vec<Vec<f64>> {
        let shape = self.shape;
        let x: Vec<f32> = shape.axes.iter().map(|&a| row[a]).collect();
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
                                    let primes = [1_u32, 2_654_435_761, 805_459_861, 3_674_653_429];
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
            rows.iter_mut().flatten().for_each(|x| *x = (self.between)(*x));
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

    pub fn loss(&self, objective: &Objective, samples: &Samples) -> f64 {
        let count = samples.len() as f64;
        let outputs = self.shape.outputs();
        let (mut loss, mut linear) = (0.0, 0.0);
        for i in 0..samples.len() {
            let rows = self.outputs(row(samples.points[i], samples.times[i]));
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
                let axes = self.shape.space();
                for (o, &axis) in axes.iter().enumerate() {
                    let deviation = f64::from(objective.scale.deviation[o]);
                    let moved = f64::from(samples.arrival[i][axis] - samples.points[i][axis]);
                    let target = (moved - f64::from(objective.scale.mean[o])) / deviation;
                    loss += (rows[0][o] - target).powi(2) / (count * outputs as f64);
                    for (a, &along) in axes.iter().enumerate() {
                        let identity = if axis == along { 1.0 } else { 0.0 };
                        let target = (f64::from(samples.jacobian[i][3 * axis + along]) - identity) / deviation;
                        let weight = f64::from(objective.jacobian_weight) / axes.len() as f64;
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

/// Smooth labels, not those of any flow: the gradients do not care.
pub fn labels(count: usize, seed: u64) -> Samples {
    let points = uniform_points(seed, count);
    let value = |p: &[f32; 3]| 1.5 * (4.0 * p[0]).sin() + (3.0 * p[1]).cos() * p[2] - 0.4;
    let arrival = |p: &[f32; 3]| [p[0] + 0.2 * (3.0 * p[1]).sin(), p[1] - 0.3 * p[0] * p[2], p[2] + 0.1 * p[0]];
    let jacobian = |p: &[f32; 3]| [1.0, 0.6 * (3.0 * p[1]).cos(), 0.0, -0.3 * p[2], 1.0, -0.3 * p[0], 0.1, 0.0, 1.0];
    Samples {
        log_stretch: points.iter().map(value).collect(),
        arrival: points.iter().map(arrival).collect(),
        jacobian: points.iter().map(jacobian).collect(),
        times: uniform_points(seed + 1000, count).into_iter().map(|[start, duration, _]| [start, duration]).collect(),
        points,
    }
}

/// Euclidean.
pub fn norm(values: &[f64]) -> f64 {
    values.iter().map(|v| v * v).sum::<f64>().sqrt()
}
