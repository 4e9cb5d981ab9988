//! Frames that are published with all layers (`publish.payload = "exr"`): decoded for the pages, which show JPEG, and for those who ask about pixels.

use super::hub::checked;
use crate::publish::{FrameHeader, Payload, decode_exr, exr_claims, jpeg};
use crate::run::Frame;
use std::sync::Arc;

/// Most samples in all layers: 1 GiB once they are decoded.
const MAX_SAMPLES: usize = 1 << 28;

/// A frame as pages get it, and with all layers.
pub(super) struct Received {
    pub header: String,
    pub jpeg: Vec<u8>,
    pub frame: Frame,
}

/// Decodes the header and the picture of a message.
pub(super) fn decode(header: &[u8], picture: &[u8]) -> Result<Received, String> {
    let (_, header): (_, FrameHeader) = checked(header)?;
    let [rows, columns, _] = header.shape;
    let (samples, fits) = exr_claims(picture, [columns, rows])?;
    if !fits {
        return Err(format!("a picture of another size than its header says, {columns} x {rows}"));
    }
    if samples > MAX_SAMPLES {
        return Err(format!(
            "a picture of {samples} samples in all layers; accepted: {MAX_SAMPLES} (publish.payload = \"jpeg\" is smaller)"
        ));
    }
    let film = decode_exr(picture)?;
    let jpeg = jpeg(&film, header.tone_map).map_err(|error| error.to_string())?;
    let told = FrameHeader {
        encoding: Payload::Jpeg,
        shape: [rows, columns, 3],
        dtype: "uint8".to_owned(),
        payload_bytes: jpeg.len(),
        ..header.clone()
    };
    let FrameHeader { tone_map, color_bar, record, .. } = header;
    // Cells that are trusted are not published.
    let frame = Frame { record: Arc::new(record), film: Arc::new(film), tone_map, color_bar: color_bar.map(Arc::new), gate: None };
    Ok(Received { header: serde_json::to_string(&told).map_err(|error| error.to_string())?, jpeg, frame })
}
