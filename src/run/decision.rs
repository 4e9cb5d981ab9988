//! Settings that a scene leaves open, and what was chosen for them.

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
        Self::withdraw(decisions, &[&self.setting]);
        decisions.push(self);
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
