//! Meaning of the outputs, and the loss of training.
//!
//! Losses: the mean square of standardised outputs; the loss of Xi, Luan and Tao 2023 ([`Loss::Published`]) on signed logarithms; and for
//! flow maps, optionally, the squared error of their Jacobians (Sobolev training, Czarnecki et al. 2017).

use super::architecture::Architecture;
use super::memory::Outputs;
use super::settings::{Loss, NetworkSettings, Target};
use crate::Samples;
use rayon::prelude::*;
use ridgewatch_field::UnitPoint;
use ridgewatch_flow::log_stretch;
use serde::{Deserialize, Serialize};

/// Outputs are trained as (value - mean) / deviation, so that learning rates mean the same on every scene. Per output.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Scale {
    /// Mean.
    pub mean: [f32; 3],
    /// Standard deviation.
    pub deviation: [f32; 3],
}

impl Default for Scale {
    fn default() -> Self {
        Self { mean: [0.0; 3], deviation: [1.0; 3] }
    }
}

/// Target, loss and scale.
#[derive(Debug, Clone, PartialEq)]
pub struct Objective {
    /// Output of the network.
    pub target: Target,
    /// Loss.
    pub loss: Loss,
    /// Weight of the penalty on the difference of the batch means.
    pub mean_penalty: f32,
    /// Weight of the flow map's derivatives beside its values; 0 leaves them out.
    pub jacobian_weight: f32,
    /// |tau|, the ratio of log-stretch and FTLE.
    pub tau: f32,
    /// Edge lengths of the domain along the axes that are inputs.
    pub extent: [f32; 3],
    /// Standardisation.
    pub scale: Scale,
}

/// Scalar field over the unit domain.
pub trait Field: Sync {
    /// Writes the value at each unit point.
    fn values(&self, points: &[UnitPoint], out: &mut [f32]);
}

/// sign(y) ln(1 + |y|), which is defined for FTLE below -1 too.
pub fn signed_log(y: f32) -> f32 {
    y.abs().ln_1p().copysign(y)
}

/// The inverse of [`signed_log`].
pub fn signed_exp(y: f32) -> f32 {
    y.abs().exp_m1().copysign(y)
}

impl Objective {
    /// The objective of these settings; `extent` holds the edge lengths of the domain along x, y and z, `tau` the longest duration.
    pub fn new(settings: &NetworkSettings, shape: &Architecture, extent: [f64; 3], tau: f64) -> Self {
        let mut active = [1.0; 3];
        for (slot, &axis) in shape.space().iter().enumerate() {
            active[slot] = extent[axis] as f32;
        }
        Self {
            target: settings.target,
            loss: settings.loss,
            mean_penalty: settings.mean_penalty,
            jacobian_weight: if settings.target == Target::FlowMap { settings.jacobian_weight } else { 0.0 },
            tau: tau as f32,
            extent: active,
            scale: Scale::default(),
        }
    }

    /// Derivatives along the axes are part of the loss.
    pub fn derivatives(&self) -> bool {
        self.jacobian_weight > 0.0
    }

    /// The loss of [`Loss::Published`] applies.
    fn is_published(&self) -> bool {
        self.target == Target::Ftle && self.loss == Loss::Published
    }

    /// Weight of the penalty on the difference of the batch means; 0 for losses without it.
    pub(super) fn penalty(&self) -> f32 {
        if self.is_published() { self.mean_penalty } else { 0.0 }
    }

    /// Numbers of the samples that can be trained on; `None` if all can.
    pub fn usable_samples(&self, samples: &Samples) -> Option<Vec<u32>> {
        let all = (0..samples.len()).into_par_iter().with_min_len(1 << 14).all(|index| self.is_usable(samples, index));
        (!all).then(|| (0..samples.len() as u32).into_par_iter().filter(|&index| self.is_usable(samples, index as usize)).collect())
    }

    /// Sample `index` can be trained on: all labels that the loss reads exist and are finite.
    pub fn is_usable(&self, samples: &Samples, index: usize) -> bool {
        let finite = |values: &[f32]| values.iter().all(|v| v.is_finite());
        let is_labelled = match self.target {
            Target::Ftle => samples.log_stretch.get(index).is_some_and(|s| s.is_finite()),
            Target::FlowMap => {
                samples.arrival.get(index).is_some_and(|a| finite(&a.0))
                    && (!self.derivatives() || samples.jacobian.get(index).is_some_and(|j| finite(j)))
            }
        };
        is_labelled && finite(&samples.points[index].0)
    }

    /// The values of sample `index`, before standardisation.
    fn raw(&self, shape: &Architecture, samples: &Samples, index: usize) -> Outputs {
        let mut values = [0.0; 3];
        match (self.target, self.loss) {
            (Target::Ftle, Loss::MeanSquare) => values[0] = samples.log_stretch[index],
            (Target::Ftle, Loss::Published) => values[0] = signed_log(samples.log_stretch[index] / self.tau),
            (Target::FlowMap, _) => {
                for (value, &axis) in values.iter_mut().zip(shape.space()) {
                    *value = samples.arrival[index].0[axis] - samples.points[index].0[axis];
                }
            }
        }
        values
    }

    /// Sets mean and deviation from about 4096 usable samples, spread over all. The published loss keeps its own scale. With a `base`,
    /// targets are relative to it, and the mean stays 0, so that an output of 0 stays 0.
    pub fn standardise(&mut self, shape: &Architecture, samples: &Samples, base: Option<&dyn Field>) {
        if self.is_published() {
            return;
        }
        let (mut sum, mut square, mut count) = ([0.0_f64; 3], [0.0_f64; 3], 0_u32);
        let stride = (samples.len() / 4096).max(1);
        for index in (0..samples.len()).step_by(stride).filter(|&i| self.is_usable(samples, i)) {
            let mut raw = self.raw(shape, samples, index);
            if let Some(base) = base {
                let mut below = [0.0];
                base.values(&samples.points[index..=index], &mut below);
                raw[0] -= below[0];
            }
            for (output, value) in raw.into_iter().enumerate() {
                sum[output] += f64::from(value);
                square[output] += f64::from(value).powi(2);
            }
            count += 1;
        }
        if count == 0 {
            return;
        }
        for output in 0..shape.outputs() {
            let mean = if base.is_some() { 0.0 } else { sum[output] / f64::from(count) };
            let deviation = (square[output] / f64::from(count) - mean * mean).max(0.0).sqrt();
            self.scale.mean[output] = mean as f32;
            // The deviation of a constant field is rounding alone.
            self.scale.deviation[output] = if deviation > 1e-6 { deviation as f32 } else { 1.0 };
        }
    }

    /// Targets of one sample for a group of outputs: group 0 holds the values, group 1 + k their derivatives along axis k.
    pub(super) fn targets(&self, shape: &Architecture, samples: &Samples, index: usize, group: usize) -> Outputs {
        let Scale { mean, deviation } = self.scale;
        let mut targets = [0.0; 3];
        if group == 0 {
            let raw = self.raw(shape, samples, index);
            for output in 0..shape.outputs() {
                targets[output] = (raw[output] - mean[output]) / deviation[output];
            }
        } else {
            let along = shape.axes[group - 1];
            for (output, &axis) in shape.space().iter().enumerate() {
                let identity = if axis == along { 1.0 } else { 0.0 };
                targets[output] = (samples.jacobian[index][3 * axis + along] - identity) / deviation[output];
            }
        }
        targets
    }

    /// Weight of the squared errors of a group of outputs in the loss of a batch of `count`.
    pub(super) fn weight(&self, shape: &Architecture, group: usize, count: usize) -> f32 {
        let share = if group == 0 { 1.0 } else { self.jacobian_weight / shape.dimensions() as f32 };
        share / (count * shape.outputs()) as f32
    }

    /// Log-stretch from the output of the `ftle` target.
    pub(super) fn log_stretch(&self, output: f32) -> f32 {
        match self.loss {
            Loss::MeanSquare => output * self.scale.deviation[0] + self.scale.mean[0],
            Loss::Published => self.tau * signed_exp(output),
        }
    }

    /// Log-stretch from the derivatives of the `flow_map` target: ln sigma_max of d arrival / d point in domain coordinates (Shadden,
    /// Lekien and Marsden 2005). `derivative(along, output)` is that of the network.
    pub(super) fn log_stretch_of_map(&self, dimensions: usize, derivative: impl Fn(usize, usize) -> f32) -> f32 {
        let mut jacobian = [[0.0_f64; 3]; 3];
        for row in 0..dimensions {
            for along in 0..dimensions {
                let unit = derivative(along, row) * self.scale.deviation[row] + if row == along { 1.0 } else { 0.0 };
                jacobian[row][along] = f64::from(unit * self.extent[row] / self.extent[along]);
            }
        }
        // The largest of several eigenvalues ignores NaN.
        if jacobian.as_flattened().iter().any(|slope| slope.is_nan()) {
            return f32::NAN;
        }
        // A map to a single point has a log-stretch of -inf; a finite bound can be averaged.
        log_stretch(&jacobian).max(0.5 * f64::MIN_POSITIVE.ln()) as f32
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_signed_logarithm_is_odd_and_has_an_inverse() {
        for y in [-3.0_f32, -0.5, 0.0, 1e-3, 7.0] {
            assert!((signed_exp(signed_log(y)) - y).abs() <= 4.0 * f32::EPSILON * y.abs().max(1.0));
            assert_eq!(signed_log(-y), -signed_log(y));
        }
    }

    #[test]
    fn the_stretch_of_a_map_that_is_no_number_is_none() {
        let settings = NetworkSettings { target: Target::FlowMap, ..NetworkSettings::default() };
        let shape = Architecture::new(&settings, &[0, 1], [1.0; 3]).unwrap();
        let objective = Objective::new(&settings, &shape, [1.0; 3], 1.0);
        assert!(objective.log_stretch_of_map(2, |_, _| f32::NAN).is_nan());
        let to_one_point = objective.log_stretch_of_map(2, |along, row| if along == row { -1.0 } else { 0.0 });
        assert!(to_one_point.is_finite() && to_one_point < -300.0, "{to_one_point}");
    }

    /// Maps that hardly stretch, nearly alike along two axes: a log-stretch near 0 shows what an eigenvalue would lose.
    #[test]
    fn the_stretch_of_a_map_loses_nothing_where_singular_values_meet() {
        let settings = NetworkSettings { target: Target::FlowMap, ..NetworkSettings::default() };
        let shape = Architecture::new(&settings, &[0, 1, 2], [1.0; 3]).unwrap();
        let objective = Objective::new(&settings, &shape, [1.0; 3], 1.0);
        for e in [0.0_f32, 2.0_f32.powi(-20), 2.0_f32.powi(-12)] {
            let edges = [1.0 + e, 1.0, 0.5];
            // Rotated by 3-4-5 triangles about two axes, which f32 rounds; the reference library gets the same numbers.
            let turn = |k: usize, along: usize| [[0.6, -0.8, 0.0], [0.48, 0.36, -0.8], [0.64, 0.48, 0.6]][k][along] * edges[along];
            let derivative = |along: usize, row: usize| turn(row, along) - if row == along { 1.0 } else { 0.0 };
            let map = nalgebra::Matrix3::from_fn(|row, along| f64::from(derivative(along, row) + if row == along { 1.0 } else { 0.0 }));
            let expected = map.singular_values().max().ln();
            let found = objective.log_stretch_of_map(3, derivative);
            assert!((f64::from(found) - expected).abs() < 1e-12 + 1e-6 * expected.abs(), "{e}: {found} for {expected}");
        }
    }
}
