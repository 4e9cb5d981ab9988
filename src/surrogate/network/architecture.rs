//! The shape of a network: what its settings and the scene fix, and where each parameter is stored.

use super::settings::{Encoding, NetworkSettings, Target, refused};
use super::times::{COLUMN_NAMES, FIRST_TIME};
use crate::SurrogateError;
use serde::{Deserialize, Serialize};

/// Inputs of a hash grid at most: every input doubles the corners of a cell.
pub const GRID_INPUTS: usize = 4;
/// Multipliers of the spatial hash for each input (the first three: Teschner et al. 2003, as in Müller et al. 2022; the fourth:
/// tiny-cuda-nn).
pub const HASH: [u32; GRID_INPUTS] = [1, 2_654_435_761, 805_459_861, 3_674_653_429];

/// One level of the hash grid.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Level {
    /// Cells along each input; 1 for unused inputs.
    pub cells: [u32; GRID_INPUTS],
    /// First entry of this level in the tables.
    pub offset: usize,
    /// Entries of this level.
    pub entries: usize,
    /// Nodes are hashed because they outnumber the entries.
    pub hashed: bool,
}

/// One fully connected layer inside the flat parameter vector: `inputs * outputs` weights, input-major, then `outputs` biases.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Layer {
    /// Number of inputs.
    pub inputs: usize,
    /// Number of outputs.
    pub outputs: usize,
    /// Position of the first weight.
    pub weights: usize,
    /// Position of the first bias.
    pub biases: usize,
}

/// Everything that fixes the number and the order of the parameters.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Architecture {
    /// Columns of a [`super::Row`] that are inputs, ascending: axes of the unit domain, then times.
    pub axes: Vec<usize>,
    /// Encoding of the position.
    pub encoding: Encoding,
    /// Levels of the hash grid; empty for the frequency encoding.
    pub levels: Vec<Level>,
    /// Features of an entry.
    pub features: usize,
    /// Octaves of the frequency encoding.
    pub octaves: usize,
    /// Layers, the output layer last; ReLU after the hidden layers.
    pub layers: Vec<Layer>,
    /// Output.
    pub target: Target,
}

impl Architecture {
    /// Resolves `settings` for inputs along `axes` of the domain and the times in the settings. `lengths` are the lengths of the domain's
    /// edges along x, y and z, in one unit ([`ridgewatch_field::Domain::lengths`]).
    ///
    /// # Errors
    /// [`SurrogateError::Setting`] if a setting is out of range, the axes are not ascending, or a hash grid would get too many inputs.
    pub fn new(settings: &NetworkSettings, axes: &[usize], lengths: [f64; 3]) -> Result<Self, SurrogateError> {
        settings.validate()?;
        if axes.is_empty() || axes.len() > 3 || axes.windows(2).any(|w| w[0] >= w[1]) || axes.iter().any(|&a| a > 2) {
            return Err(SurrogateError::Setting {
                key: "domain.dimensions".into(),
                found: format!("axes {axes:?}"),
                accepted: "one to three of the axes 0, 1, 2, ascending".into(),
            });
        }
        let mut times: Vec<usize> = settings.inputs.iter().map(|input| input.column()).collect();
        times.sort_unstable();
        let inputs = [axes, &times].concat();
        if settings.encoding == Encoding::HashGrid && inputs.len() > GRID_INPUTS {
            let found = format!("{} times for a flow that varies along {} axes", times.len(), axes.len());
            let accepted = format!("{GRID_INPUTS} inputs in all with encoding = \"hash_grid\"; any with \"frequency\"");
            return Err(refused("inputs", found, &accepted));
        }
        let (levels, encoded) = match settings.encoding {
            Encoding::HashGrid => (levels(settings, &inputs, lengths), settings.levels() * settings.features),
            Encoding::Frequency => (Vec::new(), 2 * settings.octaves * inputs.len()),
        };
        let outputs = match settings.target {
            Target::Ftle => 1,
            Target::FlowMap => axes.len(),
        };
        let hidden = vec![settings.width; settings.hidden_layers];
        let widths = [&[encoded][..], &hidden, &[outputs]].concat();
        let mut next = 0;
        let layer = |pair: &[usize]| {
            let (inputs, outputs, weights) = (pair[0], pair[1], next);
            next += (inputs + 1) * outputs;
            Layer { inputs, outputs, weights, biases: weights + inputs * outputs }
        };
        let layers = widths.windows(2).map(layer).collect();
        let NetworkSettings { encoding, features, octaves, target, .. } = *settings;
        Ok(Self { axes: inputs, encoding, levels, features, octaves, layers, target })
    }

    /// Axes of the domain that are inputs.
    pub fn space(&self) -> &[usize] {
        &self.axes[..self.dimensions()]
    }

    /// Columns of times that are inputs.
    pub fn times(&self) -> &[usize] {
        &self.axes[self.dimensions()..]
    }

    /// Number of axes of the domain that are inputs.
    pub fn dimensions(&self) -> usize {
        self.axes.partition_point(|&axis| axis < FIRST_TIME)
    }

    /// Names of the inputs, in their order.
    pub fn input_names(&self) -> Vec<&'static str> {
        self.axes.iter().map(|&axis| COLUMN_NAMES[axis]).collect()
    }

    /// Number of inputs.
    pub fn inputs(&self) -> usize {
        self.axes.len()
    }

    /// Number of features after encoding.
    pub fn encoded(&self) -> usize {
        self.layers[0].inputs
    }

    /// Number of outputs: 1, or the number of axes for the flow map.
    pub fn outputs(&self) -> usize {
        self.output_layer().outputs
    }

    /// All layers but the last.
    pub(super) fn hidden_layers(&self) -> &[Layer] {
        &self.layers[..self.layers.len() - 1]
    }

    /// The last layer.
    pub(super) fn output_layer(&self) -> &Layer {
        &self.layers[self.layers.len() - 1]
    }

    /// Entries of all levels.
    pub fn table_entries(&self) -> usize {
        self.levels.iter().map(|level| level.entries).sum()
    }

    /// Parameters of the layers.
    pub fn layer_parameters(&self) -> usize {
        self.layers.iter().map(|layer| (layer.inputs + 1) * layer.outputs).sum()
    }

    /// Parameters of the output layer, in the flat vector of layers.
    pub fn output_parameters(&self) -> std::ops::Range<usize> {
        let head = self.output_layer();
        head.weights..head.biases + head.outputs
    }

    /// All parameters.
    pub fn parameters(&self) -> usize {
        self.table_entries() * self.features + self.layer_parameters()
    }
}

/// The levels of a hash grid. Level `l` has base * growth^l cells along the longest axis and along times; shorter axes get fewer in
/// proportion, down to an eighth, so that cells are about as wide as high. A level whose nodes fit into the table is stored densely.
fn levels(settings: &NetworkSettings, axes: &[usize], lengths: [f64; 3]) -> Vec<Level> {
    let longest = axes.iter().filter_map(|&axis| lengths.get(axis)).copied().fold(0.0, f64::max);
    let capacity = 1_usize << settings.log2_table();
    let mut offset = 0;
    (0..settings.levels())
        .map(|l| {
            let resolution = settings.base_resolution() as f64 * f64::from(settings.growth()).powi(l as i32);
            let mut cells = [1_u32; GRID_INPUTS];
            for (slot, &axis) in axes.iter().enumerate() {
                let share = match lengths.get(axis) {
                    Some(edge) if settings.scale_levels_by_aspect && longest > 0.0 => (edge / longest).clamp(0.125, 1.0),
                    _ => 1.0,
                };
                // 2^20 cells are finer than f32 can place a point.
                cells[slot] = (resolution * share).round().clamp(1.0, 1_048_576.0) as u32;
            }
            let nodes = cells[..axes.len()].iter().try_fold(1_usize, |n, &c| n.checked_mul(c as usize + 1));
            let hashed = nodes.is_none_or(|n| n > capacity);
            let entries = if hashed { capacity } else { nodes.unwrap_or(capacity) };
            let level = Level { cells, offset, entries, hashed };
            offset += entries;
            level
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn levels_are_dense_until_the_table_is_full() {
        let settings = NetworkSettings {
            levels: Some(4),
            base_resolution: Some(8),
            growth: Some(2.0),
            log2_table: Some(10),
            ..NetworkSettings::default()
        };
        let shape = Architecture::new(&settings, &[0, 1], [2.0, 1.0, 1.0]).unwrap();
        let cells: Vec<_> = shape.levels.iter().map(|l| (l.cells[0], l.cells[1], l.entries, l.hashed)).collect();
        assert_eq!(cells, [(8, 4, 45, false), (16, 8, 153, false), (32, 16, 561, false), (64, 32, 1024, true)]);
        assert_eq!(shape.levels[3].offset, 45 + 153 + 561);
    }

    #[test]
    fn a_bad_setting_is_named() {
        let settings = NetworkSettings { features: 3, ..NetworkSettings::default() };
        let fault = Architecture::new(&settings, &[0, 1], [1.0; 3]).unwrap_err();
        assert_eq!(fault.to_string(), "setting network.features = 3 is not accepted; accepted: 1, 2, 4 or 8");
        let settings = NetworkSettings { growth: Some(f32::NAN), ..NetworkSettings::default() };
        assert!(Architecture::new(&settings, &[0, 1], [1.0; 3]).is_err());
    }
}
