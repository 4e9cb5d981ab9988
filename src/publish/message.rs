//! Published messages: topics, header, payload.

use super::exr::encode_exr;
use super::preview::{jpeg, png, raw};
use super::settings::Payload;
use crate::progress;
use crate::run::{ColorBar, Frame, FrameRecord};
use crate::trust::Gate;
use serde::{Deserialize, Serialize};
use serde_json::Value;

/// First part of a message with a picture.
pub const FRAME_TOPIC: &str = "frame";
/// First part of a message with a record alone.
pub const RECORD_TOPIC: &str = "record";
/// First part of a message with all layers of a frame, for those who subscribe to this very topic.
pub const LAYERS_TOPIC: &str = "layers";
/// Pixels up to which a frame is sent with all layers.
pub const MAX_LAYERED_PIXELS: usize = 1 << 22;
/// Maximum number of cells that are told to be trusted or not.
const MAX_CELLS: usize = 1 << 16;
/// First part of a message about work that takes long.
pub const WORK_TOPIC: &str = "work";
/// Version of the messages; raised when a client would have to change.
pub const PROTOCOL: u32 = 3;

/// Second part of a `frame` or `layers` message, as JSON.
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
    /// Cells in which the surrogate was trusted, with all layers.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub trusted: Option<TrustedCells>,
    /// What is to be known of the run for its files (a [`RunAbout`](super::RunAbout)), with all layers.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub about: Option<Value>,
}

/// Cells of the domain, and in which of them the surrogate was trusted.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct TrustedCells {
    /// Number along x, y and z.
    pub cells: [usize; 3],
    /// `1` for each cell that is trusted and `0` for others, x fastest.
    pub trusted: String,
}

impl TrustedCells {
    /// `None` if there are too many.
    fn of(gate: &Gate) -> Option<Self> {
        let trusted = || gate.cells().iter().map(|trusted| if *trusted { '1' } else { '0' }).collect();
        (gate.cells().len() <= MAX_CELLS).then(|| Self { cells: gate.shape(), trusted: trusted() })
    }

    /// As a gate; `None` unless there is one digit a cell.
    pub fn gate(&self) -> Option<Gate> {
        let count = self.cells.iter().try_fold(1_usize, |product, count| product.checked_mul(*count))?;
        let trusted: Vec<bool> = self.trusted.bytes().map(|digit| digit == b'1').collect();
        (count > 0 && trusted.len() == count).then(|| Gate::new(self.cells, trusted))
    }
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

/// Encodes the picture; returns its header as JSON, and the payload. With all layers it also has what is known of the run, `about`.
///
/// # Errors
/// A film that the encoder refuses.
pub fn encode_frame(frame: &Frame, payload: Payload, about: Option<&Value>) -> Result<(Vec<u8>, Vec<u8>), String> {
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
        trusted: frame.gate.as_deref().filter(|_| payload == Payload::Exr).and_then(TrustedCells::of),
        about: about.filter(|_| payload == Payload::Exr).cloned(),
    };
    Ok((serde_json::to_vec(&header).map_err(|e| e.to_string())?, bytes))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn trusted_cells_come_back_and_others_are_none() {
        let gate = Gate::new([2, 1, 2], vec![false, false, true, false]);
        let told = TrustedCells::of(&gate).unwrap();
        assert_eq!((told.cells, told.trusted.as_str()), ([2, 1, 2], "0010"));
        assert_eq!(told.gate().unwrap().cells(), gate.cells());
        assert!(TrustedCells::of(&Gate::new([MAX_CELLS + 1, 1, 1], vec![true; MAX_CELLS + 1])).is_none());
        for (cells, trusted) in [([2, 1, 2], "001"), ([0, 1, 1], ""), ([1 << 40, 1 << 40, 1], "1"), ([usize::MAX, 1, 1], "1")] {
            assert!(TrustedCells { cells, trusted: trusted.to_owned() }.gate().is_none(), "{cells:?}");
        }
    }
}
