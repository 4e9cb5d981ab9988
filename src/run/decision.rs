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
    pub(super) fn enter(self, decisions: &mut Vec<Self>) {
        tracing::info!("{self}");
        match decisions.iter_mut().find(|decision| decision.setting == self.setting) {
            Some(before) => *before = self,
            None => decisions.push(self),
        }
    }

    /// Removes the decisions for these settings, which a command has given.
    pub(super) fn withdraw(decisions: &mut Vec<Self>, settings: &[&str]) {
        decisions.retain(|decision| !settings.contains(&decision.setting.as_str()));
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

/// The network with sizes that suit a window of `shape` nodes where they are open, and enters these choices.
pub(super) fn suited_network(given: &NetworkSettings, shape: [usize; 3], decisions: &mut Vec<Decision>) -> NetworkSettings {
    let suited = given.suited_to(shape);
    if suited != *given {
        let longest = shape.into_iter().max().unwrap_or(1);
        let chosen = [
            ("network.levels", given.levels.is_none(), suited.levels().to_string()),
            ("network.growth", given.growth.is_none(), suited.growth().to_string()),
            ("network.base_resolution", given.base_resolution.is_none(), suited.base_resolution().to_string()),
            ("network.log2_table", given.log2_table.is_none(), suited.log2_table().to_string()),
            ("network.batch", given.batch.is_none(), suited.batch().to_string()),
        ];
        for (setting, _, value) in chosen.into_iter().filter(|(_, is_open, _)| *is_open) {
            let why = format!("a GPU trains on a window of {longest} nodes: few levels, of which the finest has two thirds as many cells");
            Decision::new(setting, value, why).enter(decisions);
        }
    }
    suited
}
