//! Checks of settings. Every room checks its own; `config` finds the line of a fault.

use serde::Serialize;
use std::fmt::{Debug, Display};

/// A setting that is not accepted.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[error("`{key}` {found}; accepted: {accepted}")]
pub struct Refused {
    /// Dotted key in the scene file, e.g. `render.width`.
    pub key: String,
    /// The value found, with a verb: `is -1`.
    pub found: String,
    /// Accepted values.
    pub accepted: String,
    /// Further keys that share the fault, such as the other end of a range. Changing any of them may mend it.
    pub beside: Vec<String>,
}

impl Refused {
    /// A fault of one key.
    pub fn new(key: impl Into<String>, found: impl Display, accepted: impl Into<String>) -> Self {
        Self { key: key.into(), found: found.to_string(), accepted: accepted.into(), beside: Vec::new() }
    }

    /// Adds the data for which the value, possibly a default, is not accepted.
    pub fn over(mut self, data: &str) -> Self {
        self.found = format!("{} over {data}", self.found);
        self
    }

    /// Adds further keys that share the fault.
    pub fn beside(mut self, keys: &[&str]) -> Self {
        self.beside.extend(keys.iter().map(|&key| key.to_owned()));
        self
    }
}

/// Writes a value as a scene file does.
pub fn shown(value: impl Serialize + Debug) -> String {
    toml::Value::try_from(&value).map_or_else(|_| format!("{value:?}"), |value| value.to_string())
}

/// As [`shown`], without quotation marks.
pub fn word(value: impl Serialize + Debug) -> String {
    shown(value).trim_matches('"').to_owned()
}

/// Refuses unless `holds`.
pub fn require(holds: bool, key: &str, value: impl Serialize + Debug, accepted: &str) -> Result<(), Refused> {
    if holds { Ok(()) } else { Err(Refused::new(key, format_args!("is {}", shown(value)), accepted)) }
}

/// Refuses a value that is not a finite number above 0.
pub fn positive(key: &str, value: f64) -> Result<(), Refused> {
    require(value.is_finite() && value > 0.0, key, value, "a number above 0")
}

/// Refuses a value outside `low..=high`.
pub fn count(key: &str, value: usize, low: usize, high: usize) -> Result<(), Refused> {
    require((low..=high).contains(&value), key, value, &format!("a whole number from {low} to {high}"))
}
