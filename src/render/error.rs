//! Errors of rendering.

use ridgewatch_base::setting::{Refused, shown};
use serde::Serialize;
use std::fmt::Debug;
use thiserror::Error;

/// A scene cannot be rendered, or two films cannot be merged.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum RenderError {
    /// A setting is out of range.
    #[error("`{key}` is {found}; accepted: {accepted}")]
    Invalid {
        /// Key in the scene file, e.g. `render.width`.
        key: &'static str,
        /// Value found.
        found: String,
        /// Accepted values.
        accepted: &'static str,
    },
    /// The films have different sizes.
    #[error("a film of {found:?} pixels cannot be merged into one of {expected:?}")]
    FilmSize {
        /// Width and height of the other film.
        found: [usize; 2],
        /// Width and height of this film.
        expected: [usize; 2],
    },
    /// The range of samples is empty or exceeds the limit of a frame.
    #[error("samples {first}..{end} were requested; accepted: a non-empty range that ends at most at {limit}")]
    Samples {
        /// First sample.
        first: u32,
        /// One after the last.
        end: u32,
        /// Largest end accepted.
        limit: u32,
    },
}

impl From<RenderError> for Refused {
    fn from(error: RenderError) -> Self {
        match error {
            RenderError::Invalid { key, found, accepted } => {
                let beside: &[&str] = match key {
                    "transfer.high" => &["transfer.low"],
                    "camera.look_at" | "camera.up" => &["camera.eye", "camera.look_at", "camera.up"],
                    "camera.field_of_view" | "render.width" => &["render.width", "render.height"],
                    _ => &[],
                };
                Self::new(key, format_args!("is {found}"), accepted).beside(beside)
            }
            RenderError::Samples { end, limit, .. } => Self::new("render.samples", format_args!("is {end}"), format!("at most {limit}")),
            RenderError::FilmSize { found, expected } => {
                Self::new("render.width", format_args!("gives {found:?}"), format!("{expected:?}"))
            }
        }
    }
}

/// Returns [`RenderError::Invalid`] unless `holds`.
pub(super) fn require(holds: bool, key: &'static str, found: impl Serialize + Debug, accepted: &'static str) -> Result<(), RenderError> {
    if holds { Ok(()) } else { Err(RenderError::Invalid { key, found: shown(found), accepted }) }
}

/// Returns [`RenderError::Invalid`] if a component of the vector is not finite.
pub(super) fn require_finite(key: &'static str, vector: &[f64]) -> Result<(), RenderError> {
    require(vector.iter().all(|v| v.is_finite()), key, vector, "finite numbers")
}
