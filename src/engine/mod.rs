//! The work on a device, and the cycle that drives it.
//!
//! In: a scene. Out: frames with their records. Calls every room but `publish`.

mod record;

pub use crate::trust::TrustedError;
pub use record::{FrameRecord, StageSeconds};

/// A finished frame on its way out.
#[derive(Debug, Clone)]
pub struct Frame {
    /// Its figures.
    pub record: std::sync::Arc<FrameRecord>,
    /// Its picture.
    pub film: std::sync::Arc<crate::render::Film>,
    /// `[contrast, brightness, gamma]` for previews.
    pub tone_map: [f64; 3],
}
