//! `[network]` of a scene file.

use crate::SurrogateError;
use ridgewatch_flow::Extras;
use serde::{Deserialize, Serialize};

/// Fewest samples of an optimizer step.
pub const SMALLEST_BATCH: usize = 64;

/// Encoding of the inputs of the MLP.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Encoding {
    /// Multiresolution hash grid (Müller et al. 2022).
    HashGrid,
    /// sin and cos of 2^0 .. 2^(L-1) (Mildenhall et al. 2020).
    Frequency,
}

/// An input of the network besides the position.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Input {
    /// The seed time, so that one network answers for many windows.
    Start,
    /// |tau| up to the scene's.
    Duration,
}

/// Output of the network.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Target {
    /// The log-stretch.
    Ftle,
    /// The arrival position; the FTLE follows by differentiating the network.
    FlowMap,
}

/// Loss of training.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Loss {
    /// Mean square of the log-stretch.
    MeanSquare,
    /// Mean |sign(y) ln(1+|y|) - yhat|^2 with y = FTLE, plus a penalty on the difference of the batch means in linear scale (Xi, Luan and
    /// Tao, Neural Monte Carlo rendering of finite-time Lyapunov exponent fields, Visual Intelligence 1, 2023, doi
    /// 10.1007/s44267-023-00014-x). The sign is an addition, since ln(1+y) is undefined for FTLE below -1.
    Published,
}

/// Choice of the surrogate's size.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Size {
    /// The size in the scene.
    Fixed,
    /// A size found from the measured error, at most the size in the scene ([`crate::Sizing`]).
    Auto,
}

/// Nodes along the longest axis of a window from which on [`NetworkSettings::suited_to`] chooses sizes.
const FEW_NODES: usize = 96;

/// `[network]` of a scene file.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct NetworkSettings {
    /// Choice of `width`, `log2_table` and the nodes of a table.
    pub size: Size,
    /// Inputs besides the position.
    pub inputs: Vec<Input>,
    /// Seed times that become 0 and 1 of the input `start`; `None`: the first and the last seed time of the run.
    pub start_range: Option<[f64; 2]>,
    /// Encoding of the inputs.
    pub encoding: Encoding,
    /// Hash-grid levels; `None`: see [`Self::suited_to`].
    pub levels: Option<usize>,
    /// Features of a level.
    pub features: usize,
    /// Entries of a level at most, as a power of two; `None`: see [`Self::suited_to`].
    pub log2_table: Option<u32>,
    /// Nodes along each axis of the coarsest level; `None`: see [`Self::suited_to`].
    pub base_resolution: Option<usize>,
    /// Resolution ratio from level to level; `None`: see [`Self::suited_to`].
    pub growth: Option<f32>,
    /// Octaves of the frequency encoding.
    pub octaves: usize,
    /// Hidden layers.
    pub hidden_layers: usize,
    /// Neurons of a hidden layer.
    pub width: usize,
    /// Output.
    pub target: Target,
    /// Loss.
    pub loss: Loss,
    /// Weight of the penalty on the difference of the batch means in [`Loss::Published`].
    pub mean_penalty: f32,
    /// Learning rate of Adam; `None`: 1e-2 for hash grids, 1e-3 for frequency encodings (published: 1e-4, for a day of training).
    pub learning_rate: Option<f32>,
    /// Samples of an optimizer step; `None`: see [`Self::batch_on`].
    pub batch: Option<usize>,
    /// Samples of an optimizer step of a GPU where `batch` is open, which [`Self::suited_to`] chooses. No key of a scene.
    #[serde(skip)]
    pub gpu_batch: Option<usize>,
    /// Gives shorter axes of the domain fewer cells, so that cells are about as wide as high.
    pub scale_levels_by_aspect: bool,
    /// Weight of the flow map's derivatives in the loss (target `flow_map`). 0 trains on arrivals alone, which renders better after the
    /// same time: every derivative costs a pass, and the derivatives of a hash grid jump from cell to cell.
    pub jacobian_weight: f32,
    /// Share of the steps so far over which the weights for prediction are averaged; 0 predicts with the latest weights.
    pub averaging: f32,
}

impl Default for NetworkSettings {
    fn default() -> Self {
        Self {
            size: Size::Fixed,
            inputs: Vec::new(),
            start_range: None,
            encoding: Encoding::HashGrid,
            levels: None,
            features: 4,
            log2_table: None,
            base_resolution: None,
            growth: None,
            octaves: 10,
            hidden_layers: 2,
            width: 64,
            target: Target::Ftle,
            loss: Loss::MeanSquare,
            mean_penalty: 1.0,
            learning_rate: None,
            batch: None,
            gpu_batch: None,
            scale_levels_by_aspect: true,
            jacobian_weight: 0.0,
            averaging: 0.1,
        }
    }
}

impl NetworkSettings {
    /// Hash-grid levels: those given, or 6.
    pub fn levels(&self) -> usize {
        self.levels.unwrap_or(6)
    }

    /// Entries of a level at most, as a power of two: as given, or 21.
    pub fn log2_table(&self) -> u32 {
        self.log2_table.unwrap_or(21)
    }

    /// Nodes along each axis of the coarsest level: as given, or 16.
    pub fn base_resolution(&self) -> usize {
        self.base_resolution.unwrap_or(16)
    }

    /// Resolution ratio from level to level: as given, or 1.6.
    pub fn growth(&self) -> f32 {
        self.growth.unwrap_or(1.6)
    }

    /// Samples of an optimizer step that a GPU takes, or the CPU: as given, or what suits a GPU (see [`Self::suited_to`]), or 2^14.
    pub fn batch_on(&self, is_gpu: bool) -> usize {
        self.batch.or(self.gpu_batch.filter(|_| is_gpu)).unwrap_or(1 << 14)
    }

    /// With sizes for training on a GPU over a window of `shape` nodes along x, y, z, where they are open: a batch of 2^18 as long as the GPU takes
    /// the steps, and, if nothing of the hash grid is given, three levels that double nearly, of which the finest has two thirds as many cells as the window has nodes along its
    /// longest axis, and a table that holds its nodes. A few fine levels learnt 600x192x192 nodes, the only window tried, soonest. Windows of two
    /// dimensions or with fewer than 96 nodes along the longest axis keep the defaults, as do networks that the CPU trains or whose size is searched.
    #[must_use]
    pub fn suited_to(&self, shape: [usize; 3]) -> Self {
        const LEVELS: usize = 3;
        const GROWTH: f32 = 1.8;
        let longest = shape.into_iter().max().unwrap_or(1);
        let is_plain =
            self.encoding == Encoding::HashGrid && self.inputs.is_empty() && self.size == Size::Fixed && self.jacobian_weight == 0.0;
        if !is_plain || shape.contains(&1) || longest < FEW_NODES {
            return self.clone();
        }
        let suited = Self { gpu_batch: self.batch.is_none().then_some(1 << 18), ..self.clone() };
        if self.levels.is_some() || self.growth.is_some() || self.base_resolution.is_some() || self.log2_table.is_some() {
            return suited;
        }
        let finest = 2.0 / 3.0 * longest as f64;
        let base = finest / f64::from(GROWTH).powi(LEVELS as i32 - 1);
        let nodes: f64 = shape.iter().map(|&n| 2.0 / 3.0 * n as f64 + 1.0).product();
        Self {
            levels: Some(LEVELS),
            growth: Some(GROWTH),
            base_resolution: Some(base.round().clamp(1.0, 65_536.0) as usize),
            log2_table: Some((nodes.log2().ceil() as u32).clamp(4, 24)),
            ..suited
        }
    }

    /// Labels that the network needs besides the log-stretch.
    pub fn label_extras(&self) -> Extras {
        let arrival = self.target == Target::FlowMap;
        Extras { arrival, jacobian: arrival && self.jacobian_weight > 0.0 }
    }

    /// Checks every value that has a range.
    ///
    /// # Errors
    /// [`SurrogateError::Setting`] with the first key whose value is not accepted.
    pub fn validate(&self) -> Result<(), SurrogateError> {
        if (1..self.inputs.len()).any(|i| self.inputs[i..].contains(&self.inputs[i - 1])) {
            return Err(refused(
                "inputs",
                ridgewatch_base::setting::shown(&self.inputs),
                "each of \"start\" and \"duration\" once at most",
            ));
        }
        if let Some([first, last]) = self.start_range {
            let range = format!("[{first}, {last}]");
            if !(first.is_finite() && last.is_finite() && first < last) {
                return Err(refused("start_range", range, "two finite numbers, ascending"));
            }
            if !self.inputs.contains(&Input::Start) {
                return Err(refused("start_range", range, "with \"start\" among network.inputs"));
            }
        }
        check("levels", self.levels(), 1, 32)?;
        if ![1, 2, 4, 8].contains(&self.features) {
            return Err(refused("features", self.features.to_string(), "1, 2, 4 or 8"));
        }
        check("log2_table", self.log2_table(), 4, 24)?;
        check("base_resolution", self.base_resolution(), 1, 65_536)?;
        check("growth", self.growth(), 1.0, 4.0)?;
        check("octaves", self.octaves, 1, 16)?;
        check("hidden_layers", self.hidden_layers, 1, 64)?;
        check("width", self.width, 1, 2048)?;
        check("mean_penalty", self.mean_penalty, 0.0, 1e6)?;
        check("jacobian_weight", self.jacobian_weight, 0.0, 1e6)?;
        check("averaging", self.averaging, 0.0, 1.0)?;
        check("batch", self.batch_on(false), SMALLEST_BATCH, 1 << 22)?;
        self.learning_rate.map_or(Ok(()), |rate| check("learning_rate", rate, 1e-9, 1.0))
    }
}

fn check<T: PartialOrd + std::fmt::Display>(key: &str, value: T, low: T, high: T) -> Result<(), SurrogateError> {
    let is_accepted = value >= low && value <= high;
    is_accepted.then_some(()).ok_or_else(|| refused(key, value.to_string(), &format!("{low} to {high}")))
}

/// The error of a value of `[network]`.
pub(super) fn refused(key: &str, found: String, accepted: &str) -> SurrogateError {
    SurrogateError::Setting { key: format!("network.{key}"), found, accepted: accepted.into() }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sizes_that_are_open_suit_the_window() {
        let open = NetworkSettings::default();
        let sizes = |network: NetworkSettings| {
            (network.levels(), network.growth(), network.base_resolution(), network.log2_table(), network.batch_on(true))
        };
        assert_eq!(sizes(open.suited_to([600, 192, 192])), (3, 1.8, 123, 23, 1 << 18));
        assert_eq!(open.suited_to([600, 192, 192]).batch_on(false), 1 << 14, "the CPU takes steps of its own");
        let named = NetworkSettings { batch: Some(512), ..open.clone() }.suited_to([600, 192, 192]);
        assert_eq!([true, false].map(|is_gpu| named.batch_on(is_gpu)), [512; 2]);
        let given = NetworkSettings { log2_table: Some(19), ..open.clone() };
        assert_eq!(
            sizes(given.suited_to([600, 192, 192])),
            (6, 1.6, 16, 19, 1 << 18),
            "a grid of which a part is given keeps the defaults"
        );
        // Two dimensions, a small window, inputs besides the position, frequencies, a search, and training on the CPU keep the defaults.
        for (network, shape) in [
            (open.clone(), [600, 192, 1]),
            (open.clone(), [64, 64, 64]),
            (NetworkSettings { inputs: vec![Input::Start], ..open.clone() }, [600, 192, 192]),
            (NetworkSettings { encoding: Encoding::Frequency, ..open.clone() }, [600, 192, 192]),
            (NetworkSettings { size: Size::Auto, ..open.clone() }, [600, 192, 192]),
            (NetworkSettings { target: Target::FlowMap, jacobian_weight: 0.1, ..open.clone() }, [600, 192, 192]),
        ] {
            assert_eq!(network.suited_to(shape), network);
        }
    }
}
