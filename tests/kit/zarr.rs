//! Small Zarr stores, written here chunk by chunk from the same fixtures as NetCDF files.

use super::netcdf::{Data, Fixture, Variable};
use netcdf::AttributeValue;
use serde_json::{Map, Value, json};
use std::io::Write;
use std::path::{Path, PathBuf};

/// How the bytes of a chunk are packed.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Pack {
    None,
    Gzip,
    Zlib,
    Zstd,
    Blosc,
    Lz4,
}

/// How a store is written.
#[derive(Debug, Clone, Copy)]
pub struct Layout {
    pub version: u8,
    pub pack: Pack,
    /// Extents of chunks along named dimensions; others are not cut.
    pub chunks: &'static [(&'static str, usize)],
    pub big_endian: bool,
    /// Whether chunks hold their dimensions in the opposite order.
    pub turned: bool,
    /// Version 3: inner chunks along each cut dimension of a shard, 1 for no shards.
    pub shards: usize,
    pub consolidated: bool,
    pub separator: char,
    /// Whether chunks of nothing but the fill value are left out, where there is one.
    pub sparse: bool,
}

pub const V2: Layout = Layout {
    version: 2,
    pack: Pack::None,
    chunks: &[],
    big_endian: false,
    turned: false,
    shards: 1,
    consolidated: false,
    separator: '.',
    sparse: false,
};
pub const V3: Layout = Layout { version: 3, separator: '/', ..V2 };

/// The parts of a store, by name.
pub type Parts = Vec<(String, Vec<u8>)>;

/// The parts of a store that holds the fixture.
pub fn parts(fixture: &Fixture, layout: &Layout) -> Parts {
    let mut parts = Parts::new();
    let mut metadata = Map::new();
    for variable in &fixture.variables {
        let (described, chunks) = array(fixture, variable, layout);
        for (name, value) in described {
            metadata.insert(if name.is_empty() { variable.name.clone() } else { format!("{}/{name}", variable.name) }, value);
        }
        parts.extend(chunks.into_iter().map(|(name, data)| (format!("{}/{name}", variable.name), data)));
    }
    let attributes = attributes(&fixture.attributes, &[]);
    let text = |value: &Value| serde_json::to_vec_pretty(value).unwrap();
    if layout.version == 2 {
        metadata.insert(".zgroup".into(), json!({ "zarr_format": 2 }));
        metadata.insert(".zattrs".into(), attributes.into());
        if layout.consolidated {
            parts.push((".zmetadata".into(), text(&json!({ "zarr_consolidated_format": 1, "metadata": metadata }))));
        }
        parts.extend(metadata.iter().map(|(name, value)| (name.clone(), text(value))));
    } else {
        let mut root = json!({ "zarr_format": 3, "node_type": "group", "attributes": attributes });
        if layout.consolidated {
            root["consolidated_metadata"] = json!({ "kind": "inline", "must_understand": false, "metadata": metadata });
        }
        parts.push(("zarr.json".into(), text(&root)));
        parts.extend(metadata.iter().map(|(name, value)| (format!("{name}/zarr.json"), text(value))));
    }
    parts
}

/// Writes a folder.
pub fn write(fixture: &Fixture, layout: &Layout, folder: &Path) -> PathBuf {
    write_parts(&parts(fixture, layout), folder)
}

pub fn write_parts(parts: &Parts, folder: &Path) -> PathBuf {
    for (name, data) in parts {
        let path = folder.join(name);
        std::fs::create_dir_all(path.parent().unwrap()).unwrap();
        std::fs::write(path, data).unwrap();
    }
    folder.to_path_buf()
}

/// Writes a zip file whose entries lie in `top`, such as `a.zarr/`.
pub fn zipped(parts: &Parts, top: &str, deflated: bool) -> Vec<u8> {
    let mut out = Vec::new();
    let mut archive = rawzip::ZipArchiveWriter::new(&mut out);
    for (name, data) in parts {
        let method = if deflated { rawzip::CompressionMethod::DEFLATE } else { rawzip::CompressionMethod::STORE };
        let (mut entry, config) = archive.new_file(format!("{top}{name}")).compression_method(method).start().unwrap();
        let descriptor = if deflated {
            let mut writer = config.wrap(flate2::write::DeflateEncoder::new(&mut entry, flate2::Compression::default()));
            writer.write_all(data).unwrap();
            let (encoder, descriptor) = writer.finish().unwrap();
            encoder.finish().unwrap();
            descriptor
        } else {
            let mut writer = config.wrap(&mut entry);
            writer.write_all(data).unwrap();
            writer.finish().unwrap().1
        };
        entry.finish(descriptor).unwrap();
    }
    archive.finish().unwrap();
    out
}

fn number(value: f64) -> Value {
    match value {
        v if v.is_nan() => "NaN".into(),
        v if v.fract() == 0.0 && v.abs() < 1e15 => (v as i64).into(),
        v => v.into(),
    }
}

fn attributes(of: &[(String, AttributeValue)], without: &[&str]) -> Map<String, Value> {
    let value = |value: &AttributeValue| match value {
        AttributeValue::Str(text) => text.as_str().into(),
        AttributeValue::Float(v) => f64::from(*v).into(),
        AttributeValue::Double(v) => (*v).into(),
        AttributeValue::Short(v) => (*v).into(),
        AttributeValue::Shorts(v) => v.clone().into(),
        other => panic!("{other:?}"),
    };
    of.iter().filter(|(name, _)| !without.contains(&name.as_str())).map(|(name, v)| (name.clone(), value(v))).collect()
}

/// Metadata of an array by their name within it, and its chunks.
fn array(fixture: &Fixture, variable: &Variable, layout: &Layout) -> (Vec<(String, Value)>, Parts) {
    let elements: Vec<Vec<u8>> = match &variable.data {
        Data::F32(d) => d.iter().map(|v| v.to_le_bytes().to_vec()).collect(),
        Data::F64(d) => d.iter().map(|v| v.to_le_bytes().to_vec()).collect(),
        Data::I16(d) => d.iter().map(|v| v.to_le_bytes().to_vec()).collect(),
        Data::Text(t) => t.bytes().map(|b| vec![b]).collect(),
    };
    let (number_2, number_3) = match &variable.data {
        Data::F32(_) => ("f4", "float32"),
        Data::F64(_) => ("f8", "float64"),
        Data::I16(_) => ("i2", "int16"),
        Data::Text(_) => ("S1", "uint8"),
    };
    let length = |name: &String| fixture.dimensions.iter().find(|d| d.0 == *name).unwrap().1;
    let mut shape: Vec<usize> = variable.dimensions.iter().map(length).collect();
    let known: usize = shape.iter().filter(|&&n| n > 0).product();
    shape.iter_mut().filter(|n| **n == 0).for_each(|n| *n = elements.len() / known);
    let mut dimensions = variable.dimensions.clone();
    let (mut shape, mut elements) = (shape, elements);
    let mut characters = 1;
    if let Data::Text(text) = &variable.data {
        // Rows of characters are texts of a fixed length, as xarray writes them.
        characters = shape.pop().unwrap();
        dimensions.pop();
        elements = text.as_bytes().chunks(characters).map(<[u8]>::to_vec).collect();
    }
    let width = elements[0].len();
    let chunk: Vec<usize> =
        dimensions.iter().zip(&shape).map(|(name, &n)| layout.chunks.iter().find(|c| c.0 == name).map_or(n, |c| c.1)).collect();
    let fill = variable.attributes.iter().find(|a| a.0 == "_FillValue").map(|(_, value)| match value {
        AttributeValue::Short(v) => f64::from(*v),
        AttributeValue::Float(v) => f64::from(*v),
        AttributeValue::Double(v) => *v,
        other => panic!("{other:?}"),
    });
    let fill_bytes = match (&variable.data, fill) {
        (Data::I16(_), fill) => (fill.unwrap_or(0.0) as i16).to_le_bytes().to_vec(),
        (Data::F32(_), fill) => (fill.unwrap_or(0.0) as f32).to_le_bytes().to_vec(),
        (Data::F64(_), fill) => fill.unwrap_or(0.0).to_le_bytes().to_vec(),
        (Data::Text(_), _) => vec![0; width],
    };
    let order: Vec<usize> = if layout.turned { (0..shape.len()).rev().collect() } else { (0..shape.len()).collect() };
    // The bytes of a chunk; beyond the end of the array lies the fill value.
    let chunk_bytes = |place: &[usize]| -> (Vec<u8>, bool) {
        let (mut bytes, mut empty) = (Vec::new(), true);
        let stored: Vec<usize> = order.iter().map(|&k| chunk[k]).collect();
        for n in 0..chunk.iter().product() {
            let mut index = vec![0; shape.len()];
            let mut rest = n;
            for (k, &extent) in order.iter().zip(&stored).rev() {
                index[*k] = place[*k] * chunk[*k] + rest % extent;
                rest /= extent;
            }
            let inside = (0..shape.len()).all(|k| index[k] < shape[k]);
            let at = (0..shape.len()).fold(0, |at, k| at * shape[k] + index[k]);
            let mut element = if inside { elements[at].clone() } else { fill_bytes.clone() };
            empty &= element == fill_bytes;
            if layout.big_endian && characters == 1 {
                element.reverse();
            }
            bytes.extend(element);
        }
        (packed(&bytes, layout.pack, width), empty && layout.sparse && (layout.version == 3 || fill.is_some()))
    };
    let grid: Vec<usize> = shape.iter().zip(&chunk).map(|(n, c)| n.div_ceil(*c)).collect();
    let places = |grid: &[usize]| -> Vec<Vec<usize>> {
        grid.iter().fold(vec![vec![]], |places, &n| {
            places.into_iter().flat_map(|place| (0..n).map(move |i| [&place[..], &[i]].concat())).collect()
        })
    };
    let name = |place: &[usize]| {
        let mut pieces: Vec<String> = place.iter().map(usize::to_string).collect();
        match layout.version {
            2 if pieces.is_empty() => pieces.push("0".into()),
            2 => {}
            _ => pieces.insert(0, "c".into()),
        }
        pieces.join(&layout.separator.to_string())
    };
    let mut chunks = Parts::new();
    let shard: Vec<usize> = chunk.iter().zip(&shape).map(|(c, n)| if c < n { c * layout.shards } else { *c }).collect();
    if layout.shards == 1 {
        for place in places(&grid) {
            let (bytes, empty) = chunk_bytes(&place);
            if !empty {
                chunks.push((name(&place), bytes));
            }
        }
    } else {
        let per: Vec<usize> = shard.iter().zip(&chunk).map(|(s, c)| s / c).collect();
        let outer: Vec<usize> = grid.iter().zip(&per).map(|(g, p)| g.div_ceil(*p)).collect();
        for place in places(&outer) {
            let (mut bytes, mut index) = (Vec::new(), Vec::new());
            for inner in places(&per) {
                let own: Vec<usize> = (0..per.len()).map(|k| place[k] * per[k] + inner[k]).collect();
                let (piece, empty) = chunk_bytes(&own);
                let missing = empty || own.iter().zip(&grid).any(|(o, g)| o >= g);
                let entry = if missing { [u64::MAX; 2] } else { [bytes.len() as u64, piece.len() as u64] };
                index.extend(entry.map(u64::to_le_bytes).concat());
                if !missing {
                    bytes.extend(piece);
                }
            }
            index.extend(crc32c::crc32c(&index.clone()).to_le_bytes());
            bytes.extend(index);
            chunks.push((name(&place), bytes));
        }
    }
    let own = attributes(&variable.attributes, if layout.version == 2 { &["_FillValue"] } else { &[] });
    let compressor = |id: &str| match layout.pack {
        Pack::None => Value::Null,
        _ => json!({ id: format!("{:?}", layout.pack).to_lowercase() }),
    };
    if layout.version == 2 {
        let dtype = if characters > 1 { format!("|S{width}") } else { format!("{}{number_2}", if layout.big_endian { ">" } else { "<" }) };
        let mut own = own;
        own.insert("_ARRAY_DIMENSIONS".into(), dimensions.into());
        let described = json!({
            "zarr_format": 2, "shape": shape, "chunks": chunk, "dtype": dtype, "order": if layout.turned { "F" } else { "C" },
            "fill_value": fill.map(number), "filters": null, "compressor": compressor("id"), "dimension_separator": layout.separator.to_string(),
        });
        return (vec![(".zarray".into(), described), (".zattrs".into(), own.into())], chunks);
    }
    let bytes = json!({ "name": "bytes", "configuration": { "endian": if layout.big_endian { "big" } else { "little" } } });
    let mut codecs = vec![bytes.clone()];
    if layout.turned {
        codecs.insert(0, json!({ "name": "transpose", "configuration": { "order": order } }));
    }
    if layout.pack != Pack::None {
        codecs.push(compressor("name"));
    }
    if layout.shards > 1 {
        let index = json!([{ "name": "bytes", "configuration": { "endian": "little" } }, { "name": "crc32c" }]);
        let inner = json!({ "chunk_shape": chunk, "codecs": codecs, "index_codecs": index, "index_location": "end" });
        codecs = vec![json!({ "name": "sharding_indexed", "configuration": inner })];
    }
    let data_type = if characters > 1 {
        json!({ "name": "null_terminated_bytes", "configuration": { "length_bytes": width } })
    } else {
        number_3.into()
    };
    let described = json!({
        "zarr_format": 3, "node_type": "array", "shape": shape, "data_type": data_type, "codecs": codecs, "attributes": own,
        "chunk_grid": { "name": "regular", "configuration": { "chunk_shape": shard } },
        "chunk_key_encoding": { "name": "default", "configuration": { "separator": layout.separator.to_string() } },
        "fill_value": number(fill.unwrap_or(0.0)), "dimension_names": dimensions,
    });
    (vec![(String::new(), described)], chunks)
}

fn packed(data: &[u8], pack: Pack, width: usize) -> Vec<u8> {
    match pack {
        Pack::None => data.to_vec(),
        Pack::Gzip => {
            let mut encoder = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::default());
            encoder.write_all(data).unwrap();
            encoder.finish().unwrap()
        }
        Pack::Zlib => {
            let mut encoder = flate2::write::ZlibEncoder::new(Vec::new(), flate2::Compression::default());
            encoder.write_all(data).unwrap();
            encoder.finish().unwrap()
        }
        Pack::Zstd => zrip::compress(data, 3).unwrap(),
        Pack::Blosc => {
            let mut parameters = blusc::BLOSC2_CPARAMS_DEFAULTS;
            (parameters.compcode, parameters.typesize, parameters.clevel) = (blusc::BLOSC_LZ4, width as i32, 5);
            let mut out = vec![0; data.len() + 64];
            let length = blusc::blosc1_compress_ctx(&blusc::blosc2_create_cctx(parameters), data, &mut out);
            out.truncate(usize::try_from(length).unwrap());
            out
        }
        Pack::Lz4 => {
            let mut out = (data.len() as u32).to_le_bytes().to_vec();
            out.extend(lz4_flex::block::compress(data));
            out
        }
    }
}
