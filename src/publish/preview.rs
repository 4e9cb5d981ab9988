//! Tone-mapped 8-bit previews.

use super::error::PublishError;
use crate::files::write_whole;
use crate::render::Film;
use image::{ExtendedColorType, ImageEncoder, ImageError, codecs};
use std::path::Path;

/// Quality of JPEG previews, of 100: no visible blocks on smooth ridges at about a tenth of the PNG's bytes.
const JPEG_QUALITY: u8 = 88;

/// Encodes the film as a PNG, tone-mapped with `[contrast, brightness, gamma]`.
///
/// # Errors
/// A film without pixels or with another number of colours.
pub fn png(film: &Film, tone_map: [f64; 3]) -> Result<Vec<u8>, ImageError> {
    let mut bytes = Vec::new();
    encode(codecs::png::PngEncoder::new(&mut bytes), film, tone_map)?;
    Ok(bytes)
}

/// Writes the film as a PNG. An unfinished file never has the name `path`.
///
/// # Errors
/// As [`png`], and errors of the system.
pub fn write_png(path: &Path, film: &Film, tone_map: [f64; 3]) -> Result<(), PublishError> {
    let problem = |problem: String| PublishError::File { path: path.to_owned(), problem };
    write_whole(path, &png(film, tone_map).map_err(|e| problem(e.to_string()))?).map_err(|e| problem(e.to_string()))
}

/// Encodes the film as a JPEG, tone-mapped with `[contrast, brightness, gamma]`. An edge has at most 65,535 pixels.
///
/// # Errors
/// As [`png`], and a longer edge.
pub fn jpeg(film: &Film, tone_map: [f64; 3]) -> Result<Vec<u8>, ImageError> {
    let mut bytes = Vec::new();
    encode(codecs::jpeg::JpegEncoder::new_with_quality(&mut bytes, JPEG_QUALITY), film, tone_map)?;
    Ok(bytes)
}

/// Linear R, G, B, A as little-endian f32, rows from the top: `height * width * 16` bytes.
pub fn raw(film: &Film) -> Vec<u8> {
    let mut bytes = Vec::with_capacity(film.rgba.len() * 16);
    bytes.extend(film.rgba.iter().flatten().flat_map(|c| c.to_le_bytes()));
    bytes
}

/// Encodes R, G, B of 8 bits, rows from the top, as a PNG.
pub(super) fn png_of(rgb: &[u8], size: [usize; 2]) -> Result<Vec<u8>, ImageError> {
    let mut bytes = Vec::new();
    encode_rgb(codecs::png::PngEncoder::new(&mut bytes), rgb, size)?;
    Ok(bytes)
}

fn encode(encoder: impl ImageEncoder, film: &Film, tone_map: [f64; 3]) -> Result<(), ImageError> {
    encode_rgb(encoder, &film.tone_mapped(tone_map), [film.width, film.height])
}

fn encode_rgb(encoder: impl ImageEncoder, rgb: &[u8], size: [usize; 2]) -> Result<(), ImageError> {
    let [width, height] = size.map(|pixels| u32::try_from(pixels).unwrap_or(u32::MAX));
    // The encoders panic on a buffer of another length.
    if rgb.len() as u64 != u64::from(width) * u64::from(height) * 3 || rgb.is_empty() {
        return Err(ImageError::Parameter(image::error::ParameterError::from_kind(image::error::ParameterErrorKind::DimensionMismatch)));
    }
    encoder.write_image(rgb, width, height, ExtendedColorType::Rgb8)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn ramp(width: usize, height: usize) -> Film {
        let rgba = (0..width * height).map(|i| [(i % width) as f32 / width as f32, 0.25, 0.75, 1.0]).collect();
        Film { width, height, rgba, ..Default::default() }
    }

    const PLAIN: [f64; 3] = [1.0, 0.5, 1.0];

    #[test]
    fn png_holds_the_tone_mapped_pixels() {
        let film = ramp(33, 5);
        let decoded = image::load_from_memory(&png(&film, PLAIN).unwrap()).unwrap().to_rgb8();
        assert_eq!(decoded.dimensions(), (33, 5));
        assert_eq!(decoded.into_raw(), film.tone_mapped(PLAIN));
    }

    #[test]
    fn jpeg_is_near_the_tone_mapped_pixels() {
        let film = ramp(64, 32);
        let decoded = image::load_from_memory(&jpeg(&film, PLAIN).unwrap()).unwrap().to_rgb8().into_raw();
        let worst = decoded.iter().zip(film.tone_mapped(PLAIN)).map(|(a, b)| a.abs_diff(b)).max().unwrap();
        // Quantisation at quality 88 changes a smooth ramp by a few levels of 255.
        assert!(worst <= 12, "{worst}");
    }

    #[test]
    fn raw_is_little_endian_rows() {
        let film = ramp(3, 2);
        let bytes = raw(&film);
        assert_eq!(bytes.len(), 3 * 2 * 16);
        assert_eq!(bytes[16..20], (1.0f32 / 3.0).to_le_bytes());
    }

    #[test]
    fn a_film_of_the_wrong_length_is_an_error() {
        let film = Film { width: 4, height: 4, rgba: vec![[0.0; 4]; 3], ..Default::default() };
        assert!(png(&film, PLAIN).is_err() && jpeg(&film, PLAIN).is_err());
        assert!(png(&Film::default(), PLAIN).is_err());
    }
}
