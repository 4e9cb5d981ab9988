//! A value of the scene file that is not accepted. Every room checks its own settings with these; [`crate::config`] finds the line.

use serde::Serialize;
use std::fmt::{Debug, Display};

/// What is wrong with which setting.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[error("`{key}` {found}; accepted: {accepted}")]
pub struct Refused {
    /// Dotted key in the scene file, e.g. `render.width`.
    pub key: String,
    /// What was found, with a verb: `is -1`.
    pub found: String,
    /// What is accepted.
    pub accepted: String,
    /// Further keys that have their part in the fault, as the other end of a range: any of them may be the one to mend.
    pub beside: Vec<String>,
}

impl Refused {
    /// Puts the three together.
    pub fn new(key: impl Into<String>, found: impl Display, accepted: impl Into<String>) -> Self {
        Self { key: key.into(), found: found.to_string(), accepted: accepted.into(), beside: Vec::new() }
    }

    /// Names the data over which the value, perhaps a default, is not accepted.
    pub fn over(mut self, data: &str) -> Self {
        self.found = format!("{} over {data}", self.found);
        self
    }

    /// Names further keys that have their part in the fault.
    pub fn beside(mut self, keys: &[&str]) -> Self {
        self.beside.extend(keys.iter().map(|&key| key.to_owned()));
        self
    }
}

/// A value as it is written in a scene file.
pub fn shown(value: impl Serialize + Debug) -> String {
    toml::Value::try_from(&value).map_or_else(|_| format!("{value:?}"), |value| value.to_string())
}

/// The same without quotation marks, for sentences.
pub fn word(value: impl Serialize + Debug) -> String {
    shown(value).trim_matches('"').to_owned()
}

/// Refuses unless `holds`.
pub(crate) fn require(holds: bool, key: &str, value: impl Serialize + Debug, accepted: &str) -> Result<(), Refused> {
    if holds { Ok(()) } else { Err(Refused::new(key, format_args!("is {}", shown(value)), accepted)) }
}

/// Refuses what is not a finite number above 0.
pub(crate) fn positive(key: &str, value: f64) -> Result<(), Refused> {
    require(value.is_finite() && value > 0.0, key, value, "a number above 0")
}

/// Refuses what is not from `low` to `high`.
pub(crate) fn count(key: &str, value: usize, low: usize, high: usize) -> Result<(), Refused> {
    require((low..=high).contains(&value), key, value, &format!("a whole number from {low} to {high}"))
}
