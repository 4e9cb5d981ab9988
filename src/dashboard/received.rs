//! Frames that are published with all layers (topic `layers`, and `publish.payload = "exr"`): decoded for the pages, which show JPEG, and for those who ask
//! about pixels.

use super::hub::understood;
use crate::publish::{FrameHeader, Payload, RunAbout, decode_exr, exr_claims, jpeg};
use crate::run::Frame;
use std::sync::Arc;

/// Most samples in all layers: 1 GiB once they are decoded.
const MAX_SAMPLES: usize = 1 << 28;

/// A frame as pages get it, and with all layers.
pub(super) struct Received {
    pub header: String,
    pub jpeg: Vec<u8>,
    pub frame: Frame,
    pub about: RunAbout,
}

/// Decodes the header and the picture of a message, without a picture for browsers.
pub(super) fn decode_layers(header: &[u8], picture: &[u8]) -> Result<(Frame, RunAbout), String> {
    let header = read(header)?;
    if header.encoding != Payload::Exr || header.payload_bytes != picture.len() {
        return Err(format!("layers of {} bytes that are no EXR or of another length than their header says", picture.len()));
    }
    let frame = frame(&header, picture)?;
    Ok((frame, RunAbout::told(header.about.as_ref())))
}

fn read(header: &[u8]) -> Result<FrameHeader, String> {
    serde_json::from_str(understood(header)?).map_err(|error| format!("a message that is not understood: {error}"))
}

fn frame(header: &FrameHeader, picture: &[u8]) -> Result<Frame, String> {
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
    let record = header.record.clone();
    // The rays of another picture would be traced through them.
    let gate = header.trusted.as_ref().filter(|_| record.size == [columns, rows]).and_then(|cells| cells.gate());
    Ok(Frame {
        record: Arc::new(record),
        film: Arc::new(film),
        tone_map: header.tone_map,
        color_bar: header.color_bar.clone().map(Arc::new),
        gate: gate.map(Arc::new),
    })
}

/// Decodes the header and the picture of a message.
pub(super) fn decode(header: &[u8], picture: &[u8]) -> Result<Received, String> {
    let header = read(header)?;
    let frame = frame(&header, picture)?;
    let jpeg = jpeg(&frame.film, header.tone_map).map_err(|error| error.to_string())?;
    let about = RunAbout::told(header.about.as_ref());
    let [rows, columns, _] = header.shape;
    let told = FrameHeader {
        encoding: Payload::Jpeg,
        shape: [rows, columns, 3],
        dtype: "uint8".to_owned(),
        payload_bytes: jpeg.len(),
        trusted: None,
        about: None,
        ..header
    };
    Ok(Received { header: serde_json::to_string(&told).map_err(|error| error.to_string())?, jpeg, frame, about })
}
