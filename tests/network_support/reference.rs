//! Networks in f64, written from the definition, and labels for them.

use super::uniform_points;
use rayon::prelude::*;
use ridgewatch::field::UnitPoint;
use ridgewatch::surrogate::Samples;
use ridgewatch::surrogate::network::{Architecture, Encoding, Level, Loss, Model, Objective, Row, Target, row};

/// Rounds to half precision (11 bits, spacing at least 2^-24), ties to even.
fn half(x: f64) -> f64 {
    let exponent = if x == 0.0 { -14.0 } else { x.abs().log2().floor().max(-14.0) };
    let spacing = (exponent - 10.0).exp2();
    (x / spacing).round_ties_even() * spacing
}

/// A network in f64, without tiles, panels or burn.
pub struct Reference<'a> {
    pub shape: &'a Architecture,
    pub tables: Vec<f64>,
    pub layers: Vec<f64>,
    /// Rounding of values between layers.
    between: fn(f64) -> f64,
}

impl<'a> Reference<'a> {
    /// The network of the model's parameters, unrounded.
    pub fn new(model: &'a Model) -> Self {
        let wide = |values: Vec<f32>| values.into_iter().map(f64::from).collect();
        Self { shape: &model.shape, tables: wide(model.tables()), layers: wide(model.layers()), between: |x| x }
    }

    /// The network with tables, weights and values between layers in half precision; biases and sums are unrounded.
    pub fn in_halves(model: &'a Model) -> Self {
        let mut halves = Self { between: half, ..Self::new(model) };
        halves.tables.iter_mut().for_each(|x| *x = half(*x));
        for layer in &model.shape.layers {
            halves.layers[layer.weights..layer.biases].iter_mut().for_each(|x| *x = half(*x));
        }
        halves
    }

    /// Inputs of the network.
    fn inputs(&self, row: Row) -> Vec<f32> {
        self.shape.axes.iter().map(|&a| row[a]).collect()
    }

    /// Entries around a point, with their factors for the value and for the derivative along each input.
    fn corners(level: &Level, x: &[f32]) -> Vec<(usize, Vec<f64>)> {
        let d = x.len();
        let mut cell = vec![0_u32; d];
        let mut share = vec![0.0_f64; d];
        for a in 0..d {
            // The cell is found in f32, as in the kernels, so that a point on an edge falls to the same side.
            let position = x[a] * level.cells[a] as f32;
            cell[a] = (position as u32).min(level.cells[a] - 1);
            share[a] = f64::from(position - cell[a] as f32);
        }
        let corner = |corner: u32| {
            let side = |a: usize| (corner >> a) & 1;
            let node: Vec<u32> = (0..d).map(|a| cell[a] + side(a)).collect();
            let index = if level.hashed {
                let primes = [1_u32, 2_654_435_761, 805_459_861, 3_674_653_429];
                let hash = (0..d).fold(0, |h, a| h ^ node[a].wrapping_mul(primes[a]));
                hash as usize % level.entries
            } else {
                (0..d).rev().fold(0, |i, a| i * (level.cells[a] as usize + 1) + node[a] as usize)
            };
            let along = |group: usize| -> f64 {
                (0..d)
                    .map(|a| match (group == a + 1, side(a)) {
                        (true, 1) => f64::from(level.cells[a]),
                        (true, _) => -f64::from(level.cells[a]),
                        (false, 1) => share[a],
                        (false, _) => 1.0 - share[a],
                    })
                    .product()
            };
            (level.offset + index, (0..=d).map(along).collect())
        };
        (0..1_u32 << d).map(corner).collect()
    }

    /// The encoded point and its derivatives along the inputs.
    fn encoded(&self, x: &[f32]) -> Vec<Vec<f64>> {
        let (shape, d) = (self.shape, x.len());
        let mut rows = vec![Vec::new(); 1 + d];
        match shape.encoding {
            Encoding::HashGrid => {
                for level in &shape.levels {
                    let corners = Self::corners(level, x);
                    for f in 0..shape.features {
                        for (group, row) in rows.iter_mut().enumerate() {
                            row.push(corners.iter().map(|(entry, share)| share[group] * self.tables[entry * shape.features + f]).sum());
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
        rows
    }

    /// Outputs and their derivatives along the inputs: `[1 + inputs][outputs]`.
    pub fn outputs(&self, row: Row) -> Vec<Vec<f64>> {
        let shape = self.shape;
        let mut rows = self.encoded(&self.inputs(row));
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
        let of_one = |i: usize| {
            let (mut loss, mut linear) = (0.0, 0.0);
            let rows = self.outputs(row(samples.points[i], samples.times[i]));
            if objective.target == Target::Ftle {
                if objective.loss == Loss::Published {
                    let y = f64::from(samples.log_stretch[i]) / f64::from(objective.tau);
                    linear = (rows[0][0].abs().exp() - 1.0).copysign(rows[0][0]) - y;
                }
                loss = (rows[0][0] - target(objective, samples.log_stretch[i])).powi(2) / count;
            } else {
                let axes = self.shape.space();
                for (o, &axis) in axes.iter().enumerate() {
                    let deviation = f64::from(objective.scale.deviation[o]);
                    let moved = f64::from(samples.arrival[i].0[axis] - samples.points[i].0[axis]);
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
            (loss, linear)
        };
        // Added up in order: finite differences must not see the order change.
        let all: Vec<(f64, f64)> = (0..samples.len()).into_par_iter().map(of_one).collect();
        let (mut loss, linear) = all.iter().fold((0.0, 0.0), |sum, one| (sum.0 + one.0, sum.1 + one.1));
        if objective.loss == Loss::Published && objective.target == Target::Ftle {
            loss += f64::from(objective.mean_penalty) * (linear / count).powi(2);
        }
        loss
    }

    /// Gradient of [`Self::loss`] for the target `ftle` without the penalty on means, tables first. In half precision, the factors of
    /// products with gradients of the layers' sums are rounded too.
    pub fn gradient(&self, objective: &Objective, samples: &Samples, kernel: Kernel, rounding: Rounding) -> Vec<f64> {
        assert!(objective.target == Target::Ftle && (objective.loss == Loss::MeanSquare || objective.mean_penalty == 0.0));
        let zeros = || vec![0.0; self.tables.len() + self.layers.len()];
        let sum = |mut to: Vec<f64>, from: Vec<f64>| {
            to.iter_mut().zip(&from).for_each(|(to, from)| *to += from);
            to
        };
        let of_one = |mut to: Vec<f64>, i: usize| {
            let target = target(objective, samples.log_stretch[i]);
            self.add_gradient(&mut to, row(samples.points[i], samples.times[i]), target, kernel, &mut rounding.of(i));
            to
        };
        let mut all = (0..samples.len()).into_par_iter().with_min_len(samples.len().div_ceil(16)).fold(zeros, of_one).reduce(zeros, sum);
        all.iter_mut().for_each(|g| *g /= samples.len() as f64);
        all
    }

    /// Inputs of each layer, then the outputs. ReLU is active if its rounded result is not 0.
    fn values(&self, x: &[f32], rounding: &mut Rounding) -> Vec<Vec<f64>> {
        let (shape, between) = (self.shape, self.between);
        let mut values = vec![self.encoded(x).swap_remove(0)];
        values[0].iter_mut().for_each(|v| *v = between(*v + rounding.off(v.abs())));
        for (number, layer) in shape.layers.iter().enumerate() {
            let mut sums = self.layers[layer.biases..layer.biases + layer.outputs].to_vec();
            let mut sizes: Vec<f64> = sums.iter().map(|s| s.abs()).collect();
            for (value, weights) in values[number].iter().zip(self.layers[layer.weights..layer.biases].chunks(layer.outputs)) {
                for ((sum, size), weight) in sums.iter_mut().zip(&mut sizes).zip(weights) {
                    *sum += value * weight;
                    *size += (value * weight).abs();
                }
            }
            sums.iter_mut().zip(&sizes).for_each(|(sum, &size)| *sum += rounding.off(size));
            if number + 1 < shape.layers.len() {
                sums.iter_mut().for_each(|z| *z = between(z.max(0.0)));
            }
            values.push(sums);
        }
        values
    }

    /// The single output at each point, with sums perturbed by `rounding`.
    pub fn rounded_outputs(&self, rows: &[Row], rounding: Rounding) -> Vec<f64> {
        let of_one = |(i, row): (usize, &Row)| self.values(&self.inputs(*row), &mut rounding.of(i))[self.shape.layers.len()][0];
        rows.par_iter().enumerate().map(of_one).collect()
    }

    /// Adds the gradient of the squared error of one sample.
    fn add_gradient(&self, to: &mut [f64], row: Row, target: f64, kernel: Kernel, rounding: &mut Rounding) {
        let (shape, between, x) = (self.shape, self.between, self.inputs(row));
        let values = self.values(&x, rounding);
        let slope = 2.0 * (values[shape.layers.len()][0] - target);
        let (tables, layers) = to.split_at_mut(self.tables.len());
        // With respect to the sums of the layer: unrounded, and as a factor of the products.
        let mut delta = vec![slope];
        for (number, layer) in shape.layers.iter().enumerate().rev() {
            let is_head = number + 1 == shape.layers.len();
            let halves: Vec<f64> = delta.iter().map(|&d| between(d)).collect();
            let multiplied = if is_head && kernel == Kernel::Batched { &delta } else { &halves };
            let added = if kernel == Kernel::Fused { &halves } else { &delta };
            layers[layer.biases..layer.biases + layer.outputs].iter_mut().zip(added).for_each(|(to, d)| *to += d);
            for (to, value) in layers[layer.weights..layer.biases].chunks_mut(layer.outputs).zip(&values[number]) {
                to.iter_mut().zip(multiplied).for_each(|(to, d)| *to += value * d);
            }
            let back = if is_head { &delta } else { &halves };
            let of_input = |(value, weights): (&f64, &[f64])| {
                let (sum, size) = weights.iter().zip(back).fold((0.0, 0.0), |(sum, size), (w, d)| (sum + w * d, size + (w * d).abs()));
                if number == 0 || *value != 0.0 { sum + rounding.off(size) } else { 0.0 }
            };
            delta = values[number].iter().zip(self.layers[layer.weights..layer.biases].chunks(layer.outputs)).map(of_input).collect();
        }
        for (number, level) in shape.levels.iter().enumerate() {
            for (entry, share) in Self::corners(level, &x) {
                for f in 0..shape.features {
                    let d = delta[number * shape.features + f];
                    tables[entry * shape.features + f] += share[0] * if kernel == Kernel::Batched { between(d) } else { d };
                }
            }
        }
    }
}

/// Kernels of the device that a gradient is compared with; they round at different places.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kernel {
    /// `network_fused.cu`: sums over samples add halves; gradients of the tables are not rounded.
    Fused,
    /// `network_batched.cu`: the other way round.
    Batched,
}

/// Random perturbation of sums by up to `part` of the sum of their terms' magnitudes.
#[derive(Debug, Clone, Copy)]
pub struct Rounding {
    pub part: f64,
    pub seed: u64,
}

impl Rounding {
    pub const NONE: Self = Self { part: 0.0, seed: 0 };

    /// Rounding of one sample's sums.
    fn of(self, sample: usize) -> Self {
        Self { seed: (self.seed << 32) + sample as u64, ..self }
    }

    fn off(&mut self, size: f64) -> f64 {
        self.seed = self.seed.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        self.part * size * ((self.seed >> 11) as f64 / (1_u64 << 52) as f64 - 1.0)
    }
}

/// Target of the output.
pub fn target(objective: &Objective, log_stretch: f32) -> f64 {
    let s = f64::from(log_stretch);
    match objective.loss {
        Loss::MeanSquare => (s - f64::from(objective.scale.mean[0])) / f64::from(objective.scale.deviation[0]),
        Loss::Published => {
            let y = s / f64::from(objective.tau);
            (1.0 + y.abs()).ln().copysign(y)
        }
    }
}

/// Smooth labels, of no real flow: gradients do not depend on that.
pub fn labels(count: usize, seed: u64) -> Samples {
    let points = uniform_points(seed, count);
    let value = |UnitPoint(p): &UnitPoint| 1.5 * (4.0 * p[0]).sin() + (3.0 * p[1]).cos() * p[2] - 0.4;
    let arrival = |UnitPoint(p): &UnitPoint| UnitPoint([p[0] + 0.2 * (3.0 * p[1]).sin(), p[1] - 0.3 * p[0] * p[2], p[2] + 0.1 * p[0]]);
    let jacobian = |UnitPoint(p): &UnitPoint| [1.0, 0.6 * (3.0 * p[1]).cos(), 0.0, -0.3 * p[2], 1.0, -0.3 * p[0], 0.1, 0.0, 1.0];
    Samples {
        log_stretch: points.iter().map(value).collect(),
        arrival: points.iter().map(arrival).collect(),
        jacobian: points.iter().map(jacobian).collect(),
        times: uniform_points(seed + 1000, count).into_iter().map(|UnitPoint([start, duration, _])| [start, duration]).collect(),
        points,
    }
}

/// Euclidean norm.
pub fn norm(values: &[f64]) -> f64 {
    values.iter().map(|v| v * v).sum::<f64>().sqrt()
}
