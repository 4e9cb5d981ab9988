//! Frames to publish, and the first bytes of a subscriber.

use ridgewatch::render::Film;
use ridgewatch::run::{Frame, FrameRecord};
use std::sync::Arc;

pub fn frame(record: FrameRecord, film: impl Into<Arc<Film>>) -> Frame {
    Frame { record: Arc::new(record), film: film.into(), tone_map: [1.0, 0.5, 1.0] }
}

/// Greeting of ZMTP 3.0 (RFC 23) with the NULL mechanism.
pub const GREETING: [u8; 64] = {
    let mut greeting = [0; 64];
    greeting[0] = 0xff;
    greeting[9] = 0x7f;
    greeting[10] = 3;
    [greeting[12], greeting[13], greeting[14], greeting[15]] = *b"NULL";
    greeting
};
