//! The shape of a network, resolved from its settings and the scene: what is stored where.

use super::times::{COLUMNS, FIRST_TIME};
use super::{Encoding, Input, NetworkSettings, Target};
use crate::surrogate::SurrogateError;
use serde::{Deserialize, Serialize};

/// Lanes that weight rows are padded to: two AVX registers of f32.
pub(super) const PANEL: usize = 16;
/// Most inputs of a hash grid: a cell has twice the corners with each.
pub(crate) const GRID_INPUTS: usize = 4;
/// Multipliers of the spatial hash for each input (the first three: Teschner et al. 2003, as in Müller et al. 2022; the fourth is theirs
/// too, in tiny-cuda-nn).
pub(crate) const HASH: [u32; GRID_INPUTS] = [1, 2_654_435_761, 805_459_861, 3_674_653_429];

/// One level of the hash grid.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Level {
    /// Cells along each input (1 where there are fewer).
    pub cells: [u32; GRID_INPUTS],
    /// First entry of this level in the tables.
    pub offset: usize,
    /// Entries of this level.
    pub entries: usize,
    /// Whether nodes are hashed because they outnumber the entries.
    pub hashed: bool,
}

/// One fully connected layer inside the flat parameter vector: `inputs * outputs` weights, input-major, then `outputs` biases.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Layer {
    /// Values in.
    pub inputs: usize,
    /// Values out.
    pub outputs: usize,
    /// First weight.
    pub weights: usize,
    /// First bias.
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
    /// Features an entry.
    pub features: usize,
    /// Octaves of the frequency encoding.
    pub octaves: usize,
    /// Layers, the output layer last; ReLU after all but the last.
    pub layers: Vec<Layer>,
    /// What the outputs are.
    pub target: Target,
}

fn check<T: PartialOrd + std::fmt::Display>(key: &str, value: T, low: T, high: T) -> Result<(), SurrogateError> {
    if value >= low && value <= high {
        return Ok(());
    }
    Err(SurrogateError::Setting { key: format!("network.{key}"), found: value.to_string(), accepted: format!("{low} to {high}") })
}

impl Architecture {
    /// Resolves `settings` for inputs along `axes` of the domain and the times of the settings; `lengths` are those of the domain's
    /// edges along x, y and z, in one unit ([`crate::field::Domain::lengths`]).
    pub fn new(settings: &NetworkSettings, axes: &[usize], lengths: [f64; 3]) -> Result<Self, SurrogateError> {
        settings.validate()?;
        if axes.is_empty() || axes.len() > 3 || axes.windows(2).any(|w| w[0] >= w[1]) || axes.iter().any(|&a| a > 2) {
            return Err(SurrogateError::Setting {
                key: "domain.dimensions".into(),
                found: format!("axes {axes:?}"),
                accepted: "one to three of the axes 0, 1, 2, ascending".into(),
            });
        }
        let outputs = match settings.target {
            Target::Ftle => 1,
            Target::FlowMap => axes.len(),
        };
        let mut further: Vec<usize> = settings.inputs.iter().map(|input| input.column()).collect();
        further.sort_unstable();
        let axes = [axes, &further].concat();
        if settings.encoding == Encoding::HashGrid && axes.len() > GRID_INPUTS {
            return Err(SurrogateError::Setting {
                key: "network.inputs".into(),
                found: format!("{} further ones for a flow that varies along {} axes", further.len(), axes.len() - further.len()),
                accepted: format!("{GRID_INPUTS} inputs in all with encoding = \"hash_grid\"; any with \"frequency\""),
            });
        }
        let (levels, encoded) = match settings.encoding {
            Encoding::HashGrid => (levels(settings, &axes, lengths), settings.levels * settings.features),
            Encoding::Frequency => (Vec::new(), 2 * settings.octaves * axes.len()),
        };
        let mut layers = Vec::new();
        let (mut inputs, mut next) = (encoded, 0);
        for index in 0..=settings.hidden_layers {
            let outputs = if index == settings.hidden_layers { outputs } else { settings.width };
            layers.push(Layer { inputs, outputs, weights: next, biases: next + inputs * outputs });
            next += (inputs + 1) * outputs;
            inputs = outputs;
        }
        Ok(Self {
            axes,
            encoding: settings.encoding,
            levels,
            features: settings.features,
            octaves: settings.octaves,
            layers,
            target: settings.target,
        })
    }

    /// Axes of the domain that are inputs; times come behind them.
    pub fn space(&self) -> &[usize] {
        &self.axes[..self.axes.partition_point(|&axis| axis < FIRST_TIME)]
    }

    /// Columns of times that are inputs.
    pub fn times(&self) -> &[usize] {
        &self.axes[self.dimensions()..]
    }

    /// Number of axes of the domain that are inputs.
    pub fn dimensions(&self) -> usize {
        self.space().len()
    }

    /// Names of the inputs, in their order.
    pub fn input_names(&self) -> Vec<&'static str> {
        const NAMES: [&str; COLUMNS] = ["x", "y", "z", "start", "duration"];
        self.axes.iter().map(|&axis| NAMES[axis]).collect()
    }

    /// Number of inputs.
    pub fn inputs(&self) -> usize {
        self.axes.len()
    }

    /// Width of the encoded inputs.
    pub fn encoded(&self) -> usize {
        self.layers[0].inputs
    }

    /// Number of outputs: 1, or one an axis for the flow map.
    pub fn outputs(&self) -> usize {
        self.layers[self.layers.len() - 1].outputs
    }

    /// Entries of all levels together.
    pub fn table_entries(&self) -> usize {
        self.levels.iter().map(|level| level.entries).sum()
    }

    /// Parameters of the layers.
    pub fn layer_parameters(&self) -> usize {
        self.layers.iter().map(|layer| (layer.inputs + 1) * layer.outputs).sum()
    }

    /// All parameters.
    pub fn parameters(&self) -> usize {
        self.table_entries() * self.features + self.layer_parameters()
    }

    /// Longest row of activations.
    pub(super) fn widest(&self) -> usize {
        self.layers.iter().map(|layer| row_stride(layer.inputs)).max().unwrap_or(PANEL)
    }
}

/// Rounded up to whole panels.
pub(super) fn padded(width: usize) -> usize {
    width.next_multiple_of(PANEL)
}

/// Distance of two rows of activations: an odd number of cache lines, so that a column of rows spreads over all sets of the first-level
/// cache instead of fighting for a quarter of them.
pub(super) fn row_stride(width: usize) -> usize {
    let lines = padded(width) / PANEL;
    (lines + (lines + 1) % 2) * PANEL
}

/// Cells of level `l`: base * growth^l along the longest axis and along times; shorter axes get fewer in proportion, down to an eighth, so
/// that cells are about as wide as high. A level whose nodes fit into the table is stored densely.
fn levels(settings: &NetworkSettings, axes: &[usize], lengths: [f64; 3]) -> Vec<Level> {
    let longest = axes.iter().filter_map(|&axis| lengths.get(axis)).copied().fold(0.0, f64::max);
    let capacity = 1_usize << settings.log2_table;
    let mut offset = 0;
    (0..settings.levels)
        .map(|l| {
            let resolution = settings.base_resolution as f64 * f64::from(settings.growth).powi(l as i32);
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

impl NetworkSettings {
    /// Checks every value that has a range.
    pub fn validate(&self) -> Result<(), SurrogateError> {
        let refuse = |key: &str, found: String, accepted: &str| {
            Err(SurrogateError::Setting { key: format!("network.{key}"), found, accepted: accepted.into() })
        };
        if (1..self.inputs.len()).any(|i| self.inputs[i..].contains(&self.inputs[i - 1])) {
            return refuse("inputs", crate::setting::shown(&self.inputs), "each of \"start\" and \"duration\" once at most");
        }
        if let Some([first, last]) = self.start_range {
            if !(first.is_finite() && last.is_finite() && first < last) {
                return refuse("start_range", format!("[{first}, {last}]"), "two finite numbers, ascending");
            }
            if !self.inputs.contains(&Input::Start) {
                return refuse("start_range", format!("[{first}, {last}]"), "with \"start\" among network.inputs");
            }
        }
        check("levels", self.levels, 1, 32)?;
        if ![1, 2, 4, 8].contains(&self.features) {
            return refuse("features", self.features.to_string(), "1, 2, 4 or 8");
        }
        check("log2_table", self.log2_table, 4, 24)?;
        check("base_resolution", self.base_resolution, 1, 65_536)?;
        check("growth", self.growth, 1.0, 4.0)?;
        check("octaves", self.octaves, 1, 16)?;
        check("hidden_layers", self.hidden_layers, 1, 64)?;
        check("width", self.width, 1, 2048)?;
        check("mean_penalty", self.mean_penalty, 0.0, 1e6)?;
        check("jacobian_weight", self.jacobian_weight, 0.0, 1e6)?;
        check("averaging", self.averaging, 0.0, 1.0)?;
        check("batch", self.batch, 64, 1 << 22)?;
        if let Some(rate) = self.learning_rate {
            check("learning_rate", rate, 1e-9, 1.0)?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn levels_are_dense_until_the_table_is_full() {
        let settings = NetworkSettings { levels: 4, base_resolution: 8, growth: 2.0, log2_table: 10, ..NetworkSettings::default() };
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
        let settings = NetworkSettings { growth: f32::NAN, ..NetworkSettings::default() };
        assert!(Architecture::new(&settings, &[0, 1], [1.0; 3]).is_err());
    }
}
