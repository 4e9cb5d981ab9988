//! Frames to publish, and subscribers that do harm.

use ridgewatch::render::Film;
use ridgewatch::run::{Frame, FrameRecord};
use std::sync::Arc;

/// Floods, and the first bytes of a subscriber.
#[path = "../../src/zmtp/tests/kit/mod.rs"]
pub mod zmtp;
pub use zmtp::{GREETING, READY};

pub fn frame(record: FrameRecord, film: impl Into<Arc<Film>>) -> Frame {
    Frame { record: Arc::new(record), film: film.into(), tone_map: [1.0, 0.5, 1.0], color_bar: None, gate: None }
}
