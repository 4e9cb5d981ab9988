//! Prediction of the log-stretch, fused: encoding and layers tile by tile on all cores.

use super::Target;
use super::architecture::Architecture;
use super::objective::Objective;
use super::tile::{self, OUT, Weights};

/// Layers packed for prediction.
pub(crate) struct Predictor {
    weights: Weights,
}

impl Predictor {
    /// Packs the flat vector of layers.
    pub(crate) fn new(shape: &Architecture, layers: &[f32]) -> Self {
        Self { weights: Weights::new(shape, layers, false) }
    }

    /// Log-stretch at each point; from the flow map by differentiating the network forwards.
    pub(crate) fn log_stretch(&self, shape: &Architecture, objective: &Objective, tables: &[f32], points: &[[f32; 3]], out: &mut [f32]) {
        let derivatives = objective.target == Target::FlowMap;
        let dimensions = shape.dimensions();
        tile::predict(shape, &self.weights, tables, points, derivatives, 1, out, |points, scratch, out| {
            for sample in 0..points.len() {
                out[sample] = if derivatives {
                    objective.log_stretch_of_map(dimensions, |along, output| {
                        scratch.outputs[((along + 1) * scratch.samples + sample) * OUT + output]
                    })
                } else {
                    objective.log_stretch(scratch.outputs[sample * OUT])
                };
            }
        });
    }
}
