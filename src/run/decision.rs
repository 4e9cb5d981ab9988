//! Settings that a scene leaves open, and what was chosen for them.

use super::{Settings, TransferRecord};
use crate::render::Method;
use crate::surrogate::network::NetworkSettings;
use serde::Serialize;

/// A choice for a setting that the scene leaves open. Giving the setting overrides it.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Decision {
    /// The setting, as in a scene file.
    pub setting: String,
    /// What was chosen.
    pub chosen: String,
    /// The reason, with the number that decided if there is one.
    pub why: String,
}

impl Decision {
    /// A choice of `chosen` for `setting`.
    pub fn new(setting: &str, chosen: impl std::fmt::Display, why: impl std::fmt::Display) -> Self {
        Self { setting: setting.into(), chosen: chosen.to_string(), why: why.to_string() }
    }

    /// Adds the decision to others, of which it replaces the one for the same setting.
    pub(crate) fn enter(self, decisions: &mut Vec<Self>) {
        tracing::info!("{self}");
        match decisions.iter_mut().find(|decision| decision.setting == self.setting) {
            Some(before) => *before = self,
            None => decisions.push(self),
        }
    }

    /// Whether one of the decisions is for this setting.
    pub(super) fn is_entered(decisions: &[Self], setting: &str) -> bool {
        decisions.iter().any(|decision| decision.setting == setting)
    }

    /// Removes the decisions for these settings, which a command has given.
    pub(super) fn withdraw(decisions: &mut Vec<Self>, settings: &[&str]) {
        decisions.retain(|decision| !settings.contains(&decision.setting.as_str()));
    }

    /// Removes the decisions about a surrogate, where the method has none.
    pub(super) fn withdraw_surrogate(decisions: &mut Vec<Self>) {
        Self::withdraw(decisions, &["surrogate.table_nodes"]);
        Self::withdraw(decisions, &NETWORK_SIZES);
    }
}

impl std::fmt::Display for Decision {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{} = {}: {}", self.setting, self.chosen, self.why)
    }
}

/// Enters the choices for the ends of the colour scale that the scene leaves open.
pub(super) fn enter_colours(scene: &Settings, method: Method, chosen: TransferRecord, decisions: &mut Vec<Decision>) {
    let given = scene.transfer.clone().unwrap_or_default();
    if given.low.is_none() {
        let why = match method {
            Method::Map => {
                "0, or the first percentile of the FTLE over the domain if that is negative or above half of the upper end, or below an FTLE that hardly varies"
            }
            _ => "median of the FTLE over the domain",
        };
        Decision::new("transfer.low", chosen.low, why).enter(decisions);
    }
    if given.high.is_none() {
        let why = "99.5th percentile of the FTLE over the domain, or just above transfer.low where the FTLE hardly varies";
        Decision::new("transfer.high", chosen.high, why).enter(decisions);
    }
}

/// Why a number of Runge-Kutta steps suffices: the optical residual of the picture's steps, or else the root mean square difference of the log-stretch from
/// that of twice as many.
pub fn why_steps(difference: f64, residual: Option<f64>) -> String {
    match residual {
        Some(residual) => format!("colours differ by {residual:.3} of their range, rms, from those of many more"),
        None if difference.is_finite() => {
            format!("the log-stretch (FTLE times tau) differs by {difference:.3} rms from that of twice as many")
        }
        None => "no number of steps had a finite difference from twice as many".to_owned(),
    }
}

/// Settings that [`suited_network`] chooses, and [`cpu_batch`].
const NETWORK_SIZES: [&str; 5] = ["network.levels", "network.growth", "network.base_resolution", "network.log2_table", "network.batch"];

/// The network with sizes that suit a window of `shape` nodes where they are open, and enters these choices.
pub(crate) fn suited_network(given: &NetworkSettings, shape: [usize; 3], decisions: &mut Vec<Decision>) -> NetworkSettings {
    let suited = given.suited_to(shape);
    let longest = shape.into_iter().max().unwrap_or(1);
    let few = "few fine levels, which a GPU learns soonest".to_owned();
    let finest = format!("so that the finest level has two thirds as many cells as the longest axis has nodes, {longest}");
    let chosen = [
        (given.levels == suited.levels, suited.levels().to_string(), few.clone()),
        (given.growth == suited.growth, suited.growth().to_string(), few),
        (given.base_resolution == suited.base_resolution, suited.base_resolution().to_string(), finest),
        (
            given.log2_table == suited.log2_table,
            suited.log2_table().to_string(),
            "holds the nodes of the finest level, up to 2^24".to_owned(),
        ),
        (suited.gpu_batch.is_none(), suited.batch_on(true).to_string(), "large batches keep a GPU busy".to_owned()),
    ];
    for (setting, (_, value, why)) in NETWORK_SIZES.into_iter().zip(chosen).filter(|(_, (is_given, ..))| !is_given) {
        Decision::new(setting, value, why).enter(decisions);
    }
    suited
}

/// Leaves batches that were chosen for a GPU, since the CPU trains the network; its shape stays, with its weights. Enters the choice, and returns it
/// in words. `None`: no batch was chosen for a GPU.
pub(crate) fn cpu_batch(network: &mut NetworkSettings, decisions: &mut Vec<Decision>) -> Option<String> {
    let on_gpu = network.gpu_batch.take()?;
    let batch = network.batch_on(false);
    let chosen =
        Decision::new("network.batch", batch, format_args!("the CPU trains the network, for which steps of {on_gpu} samples are long"));
    let words = chosen.to_string();
    chosen.enter(decisions);
    Some(words)
}
