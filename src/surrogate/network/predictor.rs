//! Prediction of the log-stretch by the fused kernels: encoding and layers tile by tile, on all cores.

use super::architecture::Architecture;
use super::batch::predict;
use super::objective::Objective;
use super::settings::Target;
use super::tile::{Parameters, Weights};
use super::times::row;
use ridgewatch_field::UnitPoint;

/// Layers packed for prediction.
pub struct Predictor {
    weights: Weights,
}

impl Predictor {
    /// Packs the flat vector of layers.
    pub fn new(shape: &Architecture, layers: &[f32]) -> Self {
        Self { weights: Weights::new(shape, layers, false) }
    }

    /// Writes the log-stretch at each unit point, at these unit times. A flow map is differentiated forwards.
    pub fn log_stretch(
        &self,
        shape: &Architecture,
        objective: &Objective,
        tables: &[f32],
        points: &[UnitPoint],
        times: [f32; 2],
        out: &mut [f32],
    ) {
        assert_eq!(points.len(), out.len());
        let derivatives = objective.target == Target::FlowMap;
        let network = Parameters { shape, weights: &self.weights, tables };
        let rows = |sample: usize| row(points[sample], times);
        predict(network, rows, derivatives, out, 1, |tile, out| {
            for (sample, out) in out.iter_mut().enumerate() {
                *out = if derivatives {
                    let derivative = |along: usize, output: usize| tile.outputs[(along + 1) * tile.capacity + sample][output];
                    objective.log_stretch_of_map(shape.dimensions(), derivative)
                } else {
                    objective.log_stretch(tile.outputs[sample][0])
                };
            }
        });
    }
}
