//! Published messages: topics, header, payload.

use super::exr::encode_exr;
use super::preview::{jpeg, png, raw};
use super::settings::Payload;
use crate::progress;
use crate::run::{ColorBar, Frame, FrameRecord};
use serde::{Deserialize, Serialize};

/// First part of a message with a picture.
pub const FRAME_TOPIC: &str = "frame";
/// First part of a message with a record alone.
pub const RECORD_TOPIC: &str = "record";
/// First part of a message about work that takes long.
pub const WORK_TOPIC: &str = "work";
/// Version of the messages; raised when a client would have to change.
pub const PROTOCOL: u32 = 3;

/// Second part of a `frame` message, as JSON.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct FrameHeader {
    /// [`PROTOCOL`].
    pub protocol: u32,
    /// Frame number in this run, from 0. Gaps are frames that were superseded.
    pub frame: u64,
    /// `jpeg`, `png`, `exr` or `raw`.
    pub encoding: Payload,
    /// Rows, columns and channels of the decoded picture.
    pub shape: [usize; 3],
    /// Type of the decoded channels: `uint8` (jpeg, png) or `float32` (exr, raw; raw is little-endian).
    pub dtype: String,
    /// Length of the payload, in bytes.
    pub payload_bytes: usize,
    /// `[contrast, brightness, gamma]` of 8-bit pictures, and the one to use for the others.
    pub tone_map: [f64; 3],
    /// Colours of the transfer function, in 8 bits.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub color_bar: Option<ColorBar>,
    /// Record of the frame.
    pub record: FrameRecord,
}

/// Second part of a `work` message, as JSON.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct WorkMark {
    /// [`PROTOCOL`].
    pub protocol: u32,
    /// What the run has been at for more than two seconds, in words. `None`: nothing.
    pub work: Option<String>,
    /// Signs of progress since the start: if there are no new ones, the run may hang.
    pub marks: u64,
}

impl WorkMark {
    /// Of this process, now.
    pub(super) fn now() -> Self {
        Self { protocol: PROTOCOL, work: progress::work(), marks: progress::marks() }
    }
}

/// Encodes the picture; returns its header as JSON, and the payload.
///
/// # Errors
/// A film that the encoder refuses.
pub fn encode_frame(frame: &Frame, payload: Payload) -> Result<(Vec<u8>, Vec<u8>), String> {
    let film = &frame.film;
    let (bytes, channels, dtype) = match payload {
        Payload::Jpeg => (jpeg(film, frame.tone_map).map_err(|e| e.to_string())?, 3, "uint8"),
        Payload::Png => (png(film, frame.tone_map).map_err(|e| e.to_string())?, 3, "uint8"),
        Payload::Exr => (encode_exr(film, Some(&frame.record))?, 4, "float32"),
        Payload::Raw => (raw(film), 4, "float32"),
    };
    let header = FrameHeader {
        protocol: PROTOCOL,
        frame: frame.record.frame,
        encoding: payload,
        shape: [film.height, film.width, channels],
        dtype: dtype.to_owned(),
        payload_bytes: bytes.len(),
        tone_map: frame.tone_map,
        color_bar: frame.color_bar.as_deref().cloned(),
        record: FrameRecord::clone(&frame.record),
    };
    Ok((serde_json::to_vec(&header).map_err(|e| e.to_string())?, bytes))
}
