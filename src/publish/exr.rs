//! Films as OpenEXR: one part with the channels R, G, B, A and [`LAYERS`], all f32, sorted by name, ZIP compression (lossless).

use super::error::PublishError;
use crate::files::write_whole;
use crate::{render::Film, run::FrameRecord};
use exr::meta::MetaData;
use exr::meta::header::Header;
use exr::prelude::*;
use std::io::{Cursor, Read};
use std::path::Path;

/// Layers of a film beside its colours.
const LAYERS: [&str; 7] = ["ftle.mean", "trust.traced", "variance", "samples.count", "missing.share", "queries.count", "error"];

/// Maximum number of samples of all channels of a file that is read, so that a damaged header cannot ask for all memory.
const MAX_SAMPLES: usize = 1 << 30;

/// The layers of a film by name.
fn layers(film: &Film) -> [(&'static str, &Vec<f32>); 7] {
    let [ftle, traced, variance, samples, missing, queries, error] = LAYERS;
    [
        (ftle, &film.ftle_mean),
        (traced, &film.traced),
        (variance, &film.variance),
        (samples, &film.samples),
        (missing, &film.missing),
        (queries, &film.queries),
        (error, &film.error),
    ]
}

/// Values of the channels of a film's EXR at a pixel, by name. Outside of the film there are none.
pub fn channels_at(film: &Film, [x, y]: [usize; 2]) -> Vec<(&'static str, f32)> {
    let Some(pixel) = (x < film.width && y < film.height).then_some(y * film.width + x) else { return Vec::new() };
    let colours = film.rgba.get(pixel).into_iter().flat_map(|rgba| ["R", "G", "B", "A"].into_iter().zip(*rgba));
    let values = layers(film).into_iter().filter_map(|(name, layer)| Some((name, *layer.get(pixel)?)));
    colours.chain(values).collect()
}

/// Encodes the film as an EXR file. The record goes into the attributes `ridgewatch.frame`, `ridgewatch.time` and `ridgewatch.record` (JSON).
/// Layers without entries are left out.
///
/// # Errors
/// A film without pixels, or a layer of another length.
pub fn encode_exr(film: &Film, record: Option<&FrameRecord>) -> std::result::Result<Vec<u8>, String> {
    let pixels = film.width * film.height;
    if pixels == 0 || film.rgba.len() != pixels {
        return Err(format!("a film of {} x {} pixels has {} colours; one a pixel is accepted", film.width, film.height, film.rgba.len()));
    }
    let colour = |k: usize| film.rgba.iter().map(|p| p[k]).collect::<Vec<f32>>();
    let mut channels = vec![("R", colour(0)), ("G", colour(1)), ("B", colour(2)), ("A", colour(3))];
    for (name, layer) in layers(film) {
        match layer.len() {
            0 => {}
            n if n == pixels => channels.push((name, layer.clone())),
            n => return Err(format!("layer {name} has {n} entries for {pixels} pixels")),
        }
    }
    let mut attributes = LayerAttributes { software_name: Some(Text::from("ridgewatch")), ..Default::default() };
    if let Some(record) = record {
        let json = serde_json::to_string(record).map_err(|e| e.to_string())?;
        attributes.comments = Some(Text::from(
            "linear radiance; layers: mean FTLE, share traced, variance of the mean luminance, samples, share missing, queries, stated error",
        ));
        let frame = i32::try_from(record.frame).unwrap_or(i32::MAX);
        attributes.other.insert(Text::from("ridgewatch.frame"), AttributeValue::I32(frame));
        attributes.other.insert(Text::from("ridgewatch.time"), AttributeValue::F64(record.time));
        attributes.other.insert(Text::from("ridgewatch.record"), AttributeValue::Text(Text::from(json.as_str())));
    }
    let list = channels.into_iter().map(|(name, values)| AnyChannel::new(name, FlatSamples::F32(values))).collect();
    let encoding = Encoding { compression: Compression::ZIP16, blocks: Blocks::ScanLines, line_order: LineOrder::Increasing };
    let image = Image::from_layer(Layer::new((film.width, film.height), attributes, encoding, AnyChannels::sort(list)));
    let mut bytes = Cursor::new(Vec::new());
    // One thread: the other cores belong to the renderer and the solver.
    image.write().non_parallel().to_buffered(&mut bytes).map_err(|e| e.to_string())?;
    Ok(bytes.into_inner())
}

/// Writes the film. An unfinished file never has the name `path`.
///
/// # Errors
/// As [`encode_exr`], and errors of the system.
pub fn write_exr(path: &Path, film: &Film, record: Option<&FrameRecord>) -> std::result::Result<(), PublishError> {
    let problem = |problem: String| PublishError::File { path: path.to_owned(), problem };
    let bytes = encode_exr(film, record).map_err(problem)?;
    write_whole(path, &bytes).map_err(|e| problem(e.to_string()))
}

/// Reads the first part with R, G and B of an EXR file. Alpha is 1 if the file has none, missing layers stay empty, other channels are
/// ignored.
///
/// # Errors
/// A file that cannot be read or decoded, or has no colours.
pub fn read_exr(path: &Path) -> std::result::Result<Film, PublishError> {
    let problem = |problem: String| PublishError::File { path: path.to_owned(), problem };
    let unreadable = |e: std::io::Error| problem(format!("cannot be read: {e}"));
    let mut bytes = Vec::new();
    crate::files::open(path).and_then(|mut file| file.read_to_end(&mut bytes)).map_err(unreadable)?;
    decode_exr(&bytes).map_err(problem)
}

fn damaged(error: exr::error::Error) -> String {
    format!("not a readable EXR file: {error}")
}

/// Samples that a part claims.
fn samples(header: &Header) -> usize {
    header.layer_size.area().saturating_mul(header.channels.list.len())
}

/// Samples that the parts of an EXR file claim in all, and whether each part has this width and height. Nothing is decoded.
///
/// # Errors
/// A file that cannot be read.
pub fn exr_claims(bytes: &[u8], size: [usize; 2]) -> std::result::Result<(usize, bool), String> {
    let meta = MetaData::read_from_buffered(Cursor::new(bytes), false).map_err(damaged)?;
    let all = meta.headers.iter().map(samples).fold(0, usize::saturating_add);
    Ok((all, meta.headers.iter().all(|header| [header.layer_size.width(), header.layer_size.height()] == size)))
}

/// Decodes an EXR file; see [`read_exr`].
///
/// # Errors
/// A file that cannot be decoded, or has no colours.
pub fn decode_exr(bytes: &[u8]) -> std::result::Result<Film, String> {
    let meta = MetaData::read_from_buffered(Cursor::new(bytes), false).map_err(damaged)?;
    for samples in meta.headers.iter().map(samples) {
        if samples > MAX_SAMPLES {
            return Err(format!("its header claims {samples} samples; at most {MAX_SAMPLES} are accepted"));
        }
    }
    let image = read()
        .no_deep_data()
        .largest_resolution_level()
        .all_channels()
        .all_layers()
        .all_attributes()
        .non_parallel()
        .from_buffered(Cursor::new(bytes))
        .map_err(damaged)?;
    let layer = image
        .layer_data
        .iter()
        .find(|layer| ["R", "G", "B"].iter().all(|name| channel(layer, name).is_some()))
        .ok_or_else(|| format!("no part has channels R, G and B; found {}", names(&image.layer_data)))?;
    let (width, height) = (layer.size.width(), layer.size.height());
    let pixels = width * height;
    let values = |name: &str| channel(layer, name).map(|c| c.sample_data.values_as_f32().collect::<Vec<f32>>());
    let full = |name: &str| {
        let values = values(name).unwrap_or_else(|| vec![1.0; pixels]);
        if values.len() == pixels { Ok(values) } else { Err(format!("channel {name} is subsampled; one value a pixel is accepted")) }
    };
    let (red, green, blue, alpha) = (full("R")?, full("G")?, full("B")?, full("A")?);
    let [ftle_mean, traced, variance, samples, missing, queries, error] =
        LAYERS.map(|name| values(name).filter(|v| v.len() == pixels).unwrap_or_default());
    let rgba = (0..pixels).map(|i| [red[i], green[i], blue[i], alpha[i]]).collect();
    Ok(Film { width, height, rgba, ftle_mean, traced, variance, samples, missing, queries, error })
}

type Part = Layer<AnyChannels<FlatSamples>>;

fn channel<'a>(layer: &'a Part, name: &str) -> Option<&'a AnyChannel<FlatSamples>> {
    layer.channel_data.list.iter().find(|c| c.name == *name)
}

fn names(layers: &[Part]) -> String {
    let names: Vec<String> = layers.iter().flat_map(|l| l.channel_data.list.iter().map(|c| c.name.to_string())).take(32).collect();
    if names.is_empty() { "no channel".to_owned() } else { names.join(", ") }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn film() -> Film {
        let pixels = 7 * 3;
        let layer = |scale: f32| (0..pixels).map(|i| i as f32 * scale).collect::<Vec<f32>>();
        let mut ftle_mean = layer(0.1);
        ftle_mean[4] = f32::NAN;
        Film {
            width: 7,
            height: 3,
            rgba: (0..pixels).map(|i| [i as f32, 12.5 * i as f32, -0.25, 0.5]).collect(),
            ftle_mean,
            traced: layer(0.01),
            variance: layer(1e-6),
            samples: vec![16.0; pixels],
            missing: layer(0.02),
            queries: layer(3.0),
            error: layer(0.03),
        }
    }

    fn bits(values: &[f32]) -> Vec<u32> {
        values.iter().map(|v| v.to_bits()).collect()
    }

    #[test]
    fn comes_back_bit_for_bit() {
        let film = film();
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.exr");
        write_exr(&path, &film, Some(&FrameRecord { frame: 3, time: 1.5, ..Default::default() })).unwrap();
        let back = read_exr(&path).unwrap();
        assert_eq!((back.width, back.height, &back.rgba), (7, 3, &film.rgba));
        // Compares bits, since NaN marks pixels without a collision.
        assert_eq!(bits(&back.ftle_mean), bits(&film.ftle_mean));
        assert_eq!((&back.traced, &back.variance, &back.samples), (&film.traced, &film.variance, &film.samples));
        assert_eq!((&back.missing, &back.queries, &back.error), (&film.missing, &film.queries, &film.error));
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1, "no temporary file stays");
    }

    #[test]
    fn channels_are_sorted_in_one_part_and_the_record_rides_along() {
        let record = FrameRecord { frame: 3, time: 1.5, ..Default::default() };
        let bytes = encode_exr(&film(), Some(&record)).unwrap();
        let meta = MetaData::read_from_buffered(Cursor::new(&bytes), true).unwrap();
        assert_eq!(meta.headers.len(), 1);
        let names: Vec<String> = meta.headers[0].channels.list.iter().map(|c| c.name.to_string()).collect();
        assert_eq!(
            names,
            ["A", "B", "G", "R", "error", "ftle.mean", "missing.share", "queries.count", "samples.count", "trust.traced", "variance"]
        );
        let other = &meta.headers[0].own_attributes.other;
        assert_eq!(other.get(&Text::from("ridgewatch.time")), Some(&AttributeValue::F64(1.5)));
        let AttributeValue::Text(json) = &other[&Text::from("ridgewatch.record")] else { panic!("text") };
        assert_eq!(serde_json::from_str::<FrameRecord>(&json.to_string()).unwrap(), record);
    }

    #[test]
    fn plain_half_float_rgb_from_elsewhere_is_read() {
        let list = ["B", "G", "R"]
            .into_iter()
            .enumerate()
            .map(|(k, name)| AnyChannel::new(name, FlatSamples::F16(vec![f16::from_f32(k as f32); 4])))
            .collect();
        let layer = Layer::new((2, 2), LayerAttributes::default(), Encoding::FAST_LOSSLESS, AnyChannels::sort(list));
        let mut bytes = Cursor::new(Vec::new());
        Image::from_layer(layer).write().to_buffered(&mut bytes).unwrap();
        let film = decode_exr(bytes.get_ref()).unwrap();
        assert_eq!(film.rgba, [[2.0, 1.0, 0.0, 1.0]; 4]);
        assert!(film.variance.is_empty());
    }

    #[test]
    fn damage_is_an_error_never_a_panic() {
        let bytes = encode_exr(&film(), None).unwrap();
        for end in 0..bytes.len() {
            assert!(decode_exr(&bytes[..end]).is_err(), "cut at {end}");
        }
        for at in 0..bytes.len() {
            let mut damaged = bytes.clone();
            damaged[at] ^= 0x55;
            // Some damage only changes a value; none may panic.
            let _ = decode_exr(&damaged);
        }
        assert!(read_exr(Path::new("does/not/exist.exr")).unwrap_err().to_string().contains("does/not/exist.exr"));
    }

    #[test]
    fn a_picture_without_colour_names_what_it_has() {
        let list = std::iter::once(AnyChannel::new("depth", FlatSamples::F32(vec![0.0; 4]))).collect();
        let layer = Layer::new((2, 2), LayerAttributes::default(), Encoding::FAST_LOSSLESS, AnyChannels::sort(list));
        let mut bytes = Cursor::new(Vec::new());
        Image::from_layer(layer).write().to_buffered(&mut bytes).unwrap();
        assert!(decode_exr(bytes.get_ref()).unwrap_err().contains("depth"));
    }

    #[test]
    fn a_layer_of_the_wrong_length_is_refused() {
        let film = Film { variance: vec![0.0; 5], ..film() };
        assert!(encode_exr(&film, None).unwrap_err().contains("variance"));
    }
}
