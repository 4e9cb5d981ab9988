//! One layer of a picture in few bytes: a half float a pixel, with a scale that all share.

use crate::run::Frame;
use exr::prelude::f16;
use serde::Serialize;

/// Maximum number of values of a plane: 8.4 MB.
const MAX_PLANE_VALUES: usize = 1 << 22;

/// A layer that is sent as a plane.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Layer {
    /// Mean FTLE of what is seen through the pixel (1/time).
    Ftle,
    /// Stated error of the linear radiance.
    Error,
    /// Share of the queries that were traced.
    Traced,
    /// Share of rays that saw nothing and met missing data.
    Missing,
}

impl Layer {
    /// All names that [`Self::named`] knows.
    pub const NAMES: &str = "ftle, error, traced, missing";

    /// The layer of this name.
    pub fn named(name: &str) -> Option<Self> {
        match name {
            "ftle" => Some(Self::Ftle),
            "error" => Some(Self::Error),
            "traced" => Some(Self::Traced),
            "missing" => Some(Self::Missing),
            _ => None,
        }
    }
}

/// What a plane is. Its values are f16, little-endian, row by row from the top; NaN: no value.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct PlaneHead {
    /// The layer.
    pub plane: Layer,
    /// Number of the frame.
    pub frame: u64,
    /// Its slide.
    pub slide: u64,
    /// Width and height of the picture in pixels.
    pub size: [usize; 2],
    /// The plane has every so many-th pixel of every so many-th row, from the corner on: 1 up to 2^22 pixels.
    pub step: usize,
    /// Values in a row, 0 without values.
    pub columns: usize,
    /// Rows.
    pub rows: usize,
    /// Each value times this is that of the pixel. A power of two, so that it rounds nothing.
    pub scale: f64,
    /// Unit, as 1/s; empty if there is none.
    pub unit: String,
    /// Why there are no values.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub none: Option<String>,
}

/// Why a frame has no error of its pixels; `None` if it has.
pub fn no_error(frame: &Frame) -> Option<String> {
    frame.film.error.is_empty().then(|| format!("{} states no error of a pixel; marched and two_level do", frame.record.method))
}

/// A layer of the frame as f16, with what is to be known of it. At most 2^22 values.
pub fn plane(frame: &Frame, layer: Layer) -> (PlaneHead, Vec<u8>) {
    let (film, record) = (&frame.film, &frame.record);
    let [width, height] = [film.width, film.height];
    let values = match layer {
        Layer::Ftle => &film.ftle_mean,
        Layer::Error => &film.error,
        Layer::Traced => &film.traced,
        Layer::Missing => &film.missing,
    };
    let unit = if layer == Layer::Ftle { frame.color_bar.as_ref().map_or(String::new(), |bar| bar.unit.clone()) } else { String::new() };
    let mut head = PlaneHead {
        plane: layer,
        frame: record.frame,
        slide: record.slide,
        size: [width, height],
        step: 1,
        columns: 0,
        rows: 0,
        scale: 1.0,
        unit,
        none: None,
    };
    if values.is_empty() || values.len() != width * height {
        let other = || "the frame has no such layer".to_owned();
        head.none = Some(if layer == Layer::Error { no_error(frame).unwrap_or_else(other) } else { other() });
        return (head, Vec::new());
    }
    let step = step(width, height);
    let at = |pixel: usize| match layer {
        // A share of nothing.
        Layer::Traced if film.queries.get(pixel) == Some(&0.0) => f32::NAN,
        _ => values[pixel],
    };
    let pixels = || (0..height).step_by(step).flat_map(|y| (0..width).step_by(step).map(move |x| y * width + x));
    let largest = pixels().map(|pixel| at(pixel).abs()).filter(|value| value.is_finite()).fold(0.0, f32::max);
    let scale = if largest > 0.0 { f64::from(largest).log2().ceil().exp2() } else { 1.0 };
    let bytes = pixels().flat_map(|pixel| f16::from_f64(f64::from(at(pixel)) / scale).to_le_bytes()).collect();
    (PlaneHead { step, columns: width.div_ceil(step), rows: height.div_ceil(step), scale, ..head }, bytes)
}

/// Distance between the pixels of a plane: the smallest with at most so many values.
fn step(width: usize, height: usize) -> usize {
    let values = |step: usize| width.div_ceil(step).saturating_mul(height.div_ceil(step));
    (1..).find(|step| values(*step) <= MAX_PLANE_VALUES).unwrap_or(usize::MAX)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::render::Film;
    use crate::run::FrameRecord;
    use std::sync::Arc;

    fn frame(film: Film) -> Frame {
        let record = FrameRecord { frame: 5, slide: 1, method: "gated".into(), ..Default::default() };
        Frame { record: Arc::new(record), film: Arc::new(film), tone_map: [1.0, 0.5, 1.0], color_bar: None }
    }

    fn values(head: &PlaneHead, bytes: &[u8]) -> Vec<f64> {
        bytes.chunks_exact(2).map(|pair| f16::from_le_bytes([pair[0], pair[1]]).to_f64() * head.scale).collect()
    }

    #[test]
    fn values_keep_eleven_bits_whatever_their_unit() {
        for unit in [1e-30, 1e-6, 1.0, 1e20_f32] {
            let mut film = Film::new(7, 3);
            film.ftle_mean = (0..21).map(|i| (i as f32 - 4.0) * 0.37 * unit).collect();
            film.ftle_mean[9] = f32::NAN;
            let (head, bytes) = plane(&frame(film.clone()), Layer::Ftle);
            assert_eq!((head.step, head.columns, head.rows, head.frame, &head.none), (1, 7, 3, 5, &None));
            for (found, wanted) in values(&head, &bytes).iter().zip(&film.ftle_mean) {
                // Half of the last of 11 bits.
                let bound = f64::from(wanted.abs()) * f64::from(2_f32.powi(-11));
                assert!((found - f64::from(*wanted)).abs() <= bound || (found.is_nan() && wanted.is_nan()), "{found} {wanted}");
            }
        }
    }

    #[test]
    fn a_share_of_no_queries_is_no_value_and_a_layer_that_is_not_there_is_said() {
        let film = Film { traced: vec![0.0, 0.25], queries: vec![0.0, 4.0], ..Film::new(2, 1) };
        let (head, bytes) = plane(&frame(film), Layer::Traced);
        let found = values(&head, &bytes);
        assert!(found[0].is_nan() && found[1] == 0.25);
        let (head, bytes) = plane(&frame(Film::new(2, 1)), Layer::Error);
        assert_eq!(head.none.unwrap(), "gated states no error of a pixel; marched and two_level do");
        assert!(bytes.is_empty() && head.columns == 0);
        let damaged = Film { ftle_mean: vec![1.0; 3], ..Film::new(2, 1) };
        assert_eq!(plane(&frame(damaged), Layer::Ftle).0.none.unwrap(), "the frame has no such layer");
    }

    #[test]
    fn large_pictures_are_thinned() {
        for (size, wanted) in [([2048, 2048], 1), ([2049, 2048], 2), ([3840, 2160], 2), ([7680, 4320], 3), ([1 << 30, 1], 256)] {
            let [width, height]: [usize; 2] = size;
            assert_eq!(step(width, height), wanted, "{size:?}");
        }
        let mut film = Film { width: 2049, height: 2049, ..Film::default() };
        film.missing = (0..2049 * 2049).map(|pixel| if pixel == 2 * 2049 + 4 { 1.0 } else { 0.0 }).collect();
        let (head, bytes) = plane(&frame(film), Layer::Missing);
        assert_eq!((head.step, head.columns, head.rows, bytes.len()), (2, 1025, 1025, 2 * 1025 * 1025));
        assert_eq!(values(&head, &bytes).iter().position(|value| *value == 1.0), Some(1025 + 2));
    }
}
