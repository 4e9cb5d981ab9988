//! Prediction of the log-stretch, fused: encoding and layers tile by tile on all cores.

use super::Target;
use super::architecture::Architecture;
use super::objective::Objective;
use super::tile::{self, OUT, Weights};
use super::times::row;

/// Layers packed for prediction.
pub(crate) struct Predictor {
    weights: Weights,
}

impl Predictor {
    /// Packs the flat vector of layers.
    pub(crate) fn new(shape: &Architecture, layers: &[f32]) -> Self {
        Self { weights: Weights::new(shape, layers, false) }
    }

    /// Log-stretch at each point, at these unit times; from the flow map by differentiating the network forwards.
    pub(crate) fn log_stretch(
        &self,
        shape: &Architecture,
        objective: &Objective,
        tables: &[f32],
        points: &[[f32; 3]],
        times: [f32; 2],
        out: &mut [f32],
    ) {
        let derivatives = objective.target == Target::FlowMap;
        let dimensions = shape.dimensions();
        let rows = |sample: usize| row(points[sample], times);
        tile::predict(shape, &self.weights, tables, points.len(), rows, derivatives, 1, out, |count, scratch, out| {
            for sample in 0..count {
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
