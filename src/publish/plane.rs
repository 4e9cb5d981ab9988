//! One layer of a picture in few bytes: a half float a pixel, with a scale that all share.

use crate::field::Domain;
use crate::render::{Camera, Method, SceneBox};
use crate::run::{Frame, FrameRecord};
use exr::prelude::f16;
use rayon::prelude::*;
use serde::Serialize;

/// Maximum number of values of a plane: 8.4 MB.
const MAX_PLANE_VALUES: usize = 1 << 22;

/// A layer that is sent as a plane.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Layer {
    /// Mean FTLE of what is seen through the pixel (1/time).
    Ftle,
    /// Stated error of the linear radiance; of a map, of the FTLE (1/time).
    Error,
    /// Share of the queries that were traced.
    Traced,
    /// Share of rays that saw nothing and met missing data.
    Missing,
    /// Share of the way through the domain in which the surrogate is trusted.
    Trusted,
}

impl Layer {
    /// All names that [`Self::named`] knows.
    pub const NAMES: &str = "ftle, error, traced, missing, trusted";

    /// The layer of this name.
    pub fn named(name: &str) -> Option<Self> {
        match name {
            "ftle" => Some(Self::Ftle),
            "error" => Some(Self::Error),
            "traced" => Some(Self::Traced),
            "missing" => Some(Self::Missing),
            "trusted" => Some(Self::Trusted),
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
    /// Method of the frame: the error of a `map` is that of its FTLE.
    pub method: String,
    /// Why there are no values.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub none: Option<String>,
}

/// Why a frame has no error of its pixels; `None` if it has.
pub fn no_error(frame: &Frame) -> Option<String> {
    frame.film.error.is_empty().then(|| format!("{} states no error of a pixel; map, marched and two_level do", frame.record.method))
}

/// A layer of the frame as f16, with what is to be known of it. At most 2^22 values.
pub fn plane(frame: &Frame, layer: Layer) -> (PlaneHead, Vec<u8>) {
    let (film, record) = (&frame.film, &frame.record);
    let [width, height] = [film.width, film.height];
    let trusted = if layer == Layer::Trusted { trusted_shares(frame, step(width, height)) } else { Vec::new() };
    let values = match layer {
        Layer::Ftle => &film.ftle_mean,
        Layer::Error => &film.error,
        Layer::Traced => &film.traced,
        Layer::Missing => &film.missing,
        Layer::Trusted => &trusted,
    };
    let is_ftle = layer == Layer::Ftle || layer == Layer::Error && record.method == Method::Map.name();
    let unit = if is_ftle { frame.color_bar.as_ref().map_or(String::new(), |bar| bar.unit.clone()) } else { String::new() };
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
        method: record.method.clone(),
        none: None,
    };
    if values.is_empty() || values.len() != width * height {
        let other = || "the frame has no such layer".to_owned();
        head.none = Some(match layer {
            Layer::Error => no_error(frame).unwrap_or_else(other),
            Layer::Trusted if frame.gate.is_none() => format!("{} has no surrogate to trust", record.method),
            _ => other(),
        });
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

/// For every `step`-th pixel of every `step`-th row, the share of its ray's way through the domain in which the surrogate is trusted; NaN for rays that miss
/// it, and for other pixels. Empty where the frame does not tell.
fn trusted_shares(frame: &Frame, step: usize) -> Vec<f32> {
    /// Points along a ray, several in each of the cells of a gate.
    const POINTS: usize = 64;
    let FrameRecord { size: [width, height], camera, scale, domain, .. } = &*frame.record;
    let (Some(gate), Some(camera), Some(domain)) = (&frame.gate, camera, domain) else { return Vec::new() };
    let (width, height) = (*width, *height);
    let Ok(camera) = Camera::new(camera, width as f64 / height as f64) else { return Vec::new() };
    let space = SceneBox::new(&Domain::cuboid(domain.min, domain.max), *scale, [1; 3]);
    let share = |pixel: usize| {
        let [x, y] = [pixel % width, pixel / width];
        if !x.is_multiple_of(step) || !y.is_multiple_of(step) {
            return f32::NAN;
        }
        let at = |place: usize, count: usize| 2.0 * (place as f64 + 0.5) / count as f64 - 1.0;
        let (origin, direction) = camera.ray(at(x, width), -at(y, height));
        let Some((enter, leave)) = space.intersect(origin, direction) else { return f32::NAN };
        let is_trusted = |point: &usize| {
            let along = enter + (leave - enter) * (*point as f64 + 0.5) / POINTS as f64;
            let scene = std::array::from_fn(|k| origin[k] + along * direction[k]);
            gate.trusts(space.unit_of_grid(space.grid_point(scene)))
        };
        (0..POINTS).filter(is_trusted).count() as f32 / POINTS as f32
    };
    (0..width * height).into_par_iter().map(share).collect()
}

/// Distance between the pixels of a plane: the smallest with at most so many values.
fn step(width: usize, height: usize) -> usize {
    let values = |step: usize| width.div_ceil(step).saturating_mul(height.div_ceil(step));
    (1..).find(|step| values(*step) <= MAX_PLANE_VALUES).unwrap_or(usize::MAX)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::render::CameraSettings;
    use crate::render::Film;
    use crate::run::DomainRecord;
    use crate::trust::Gate;
    use std::sync::Arc;

    fn frame(film: Film) -> Frame {
        let record = FrameRecord { frame: 5, slide: 1, method: "gated".into(), ..Default::default() };
        Frame { record: Arc::new(record), film: Arc::new(film), tone_map: [1.0, 0.5, 1.0], color_bar: None, gate: None }
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
        assert_eq!(head.none.unwrap(), "gated states no error of a pixel; map, marched and two_level do");
        assert!(bytes.is_empty() && head.columns == 0);
        let damaged = Film { ftle_mean: vec![1.0; 3], ..Film::new(2, 1) };
        assert_eq!(plane(&frame(damaged), Layer::Ftle).0.none.unwrap(), "the frame has no such layer");
    }

    #[test]
    fn a_ray_has_the_share_of_its_way_that_is_trusted() {
        // A unit cube from above, trusted in its upper half where x < 1/2 and nowhere else; pixels beyond it have no value.
        let gate = Gate::new([2, 1, 2], vec![false, false, true, false]);
        let camera = CameraSettings {
            eye: [0.5, 0.5, 3.0],
            look_at: [0.5, 0.5, 1.0],
            up: [0.0, 1.0, 0.0],
            field_of_view: 2.0 * f64::atan(0.5).to_degrees(),
            orthographic: true,
        };
        let axes = ["x", "y", "z"].map(|name| [name.to_owned(), String::new()]).to_vec();
        let domain = DomainRecord { min: [0.0; 3], max: [1.0; 3], axes };
        let seen = |gate: Option<Gate>| {
            let mut frame = frame(Film::new(4, 1));
            let record = FrameRecord { size: [4, 1], camera: Some(camera.clone()), scale: [1.0; 3], ..(*frame.record).clone() };
            frame.record = Arc::new(FrameRecord { domain: Some(domain.clone()), ..record });
            plane(&Frame { gate: gate.map(Arc::new), ..frame }, Layer::Trusted)
        };
        let (head, bytes) = seen(Some(gate));
        let found = values(&head, &bytes);
        assert!(found[0].is_nan() && found[3].is_nan() && found[1..3] == [0.5, 0.0], "{found:?}");
        assert_eq!(seen(None).0.none.unwrap(), "gated has no surrogate to trust");
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
