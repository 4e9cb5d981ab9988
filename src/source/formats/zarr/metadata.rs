//! Metadata of an array, of version 2 or 3.

use super::super::messages::{Attribute, NumberType};
use super::codecs::{ACCEPTED, Step};
use super::json::{number, text};
use serde_json::Value;

/// Most dimensions of an array.
const MAX_RANK: usize = 32;

/// An array. Texts of a fixed length have one dimension more, of their characters.
pub struct Array {
    pub number: NumberType,
    /// Type of an element in a chunk.
    pub stored: NumberType,
    /// Dimensions that are chunked, and named in the names of chunks.
    pub rank: usize,
    pub shape: Vec<usize>,
    /// Extents of what is one part of the store.
    pub chunk: Vec<usize>,
    pub fill: f64,
    pub names: ChunkNames,
    /// How chunks are stored, or why they cannot be read.
    pub codecs: Result<Codecs, String>,
    pub dimensions: Vec<Option<String>>,
    pub attributes: Vec<(String, Attribute)>,
}

/// How chunks are named.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ChunkNames {
    /// Whether they start with `c`.
    pub prefix: bool,
    pub separator: char,
}

impl ChunkNames {
    pub fn of(self, place: &[usize]) -> String {
        let mut pieces: Vec<String> = place.iter().map(usize::to_string).collect();
        if self.prefix {
            pieces.insert(0, "c".into());
        } else if pieces.is_empty() {
            pieces.push("0".into());
        }
        pieces.join(&self.separator.to_string())
    }
}

/// How a chunk is stored.
#[derive(Debug, Clone, PartialEq)]
pub struct Codecs {
    /// Order of the dimensions in a chunk, slowest first.
    pub order: Vec<usize>,
    pub big_endian: bool,
    /// In the order in which they are undone.
    pub steps: Vec<Step>,
    /// If a chunk holds chunks.
    pub shard: Option<Shard>,
}

/// Chunks within chunks.
#[derive(Debug, Clone, PartialEq)]
pub struct Shard {
    /// Extents of an inner chunk. The codecs are those of inner chunks.
    pub inner: Vec<usize>,
    pub index_big_endian: bool,
    pub index_steps: Vec<Step>,
    /// Whether the index lies at the start of the chunk, not at its end.
    pub index_first: bool,
}

impl Array {
    /// Extents of what is unpacked at once.
    pub fn block(&self) -> &[usize] {
        match &self.codecs {
            Ok(Codecs { shard: Some(shard), .. }) => &shard.inner,
            _ => &self.chunk,
        }
    }

    pub fn block_bytes(&self) -> u64 {
        volume(self.block()).saturating_mul(self.stored.bytes() as u64)
    }

    /// Bytes of the index of a shard, unpacked; 0 without shards.
    pub fn index_bytes(&self) -> u64 {
        match &self.codecs {
            Ok(Codecs { shard: Some(shard), .. }) => (volume(&self.chunk) / volume(&shard.inner)).saturating_mul(16),
            _ => 0,
        }
    }

    /// An array of version 2, from `.zarray` and `.zattrs`.
    ///
    /// # Errors
    /// What is wrong or missing.
    pub fn version_2(array: &Value, attributes: Option<&Value>, name: &str) -> Result<Self, String> {
        let shape = lengths(array, "shape", 0)?;
        let chunk = lengths(array, "chunks", 1)?;
        let element = array["dtype"].as_str().map_or(Element::OTHER, Element::version_2);
        let order = match array["order"].as_str() {
            Some("F") => (0..shape.len()).rev().collect(),
            _ => (0..shape.len()).collect(),
        };
        let separator = if array["dimension_separator"] == "/" { '/' } else { '.' };
        let filters = array["filters"].as_array().map_or(&[][..], Vec::as_slice).iter();
        let packed = filters.chain(Some(&array["compressor"]).filter(|c| !c.is_null()));
        let mut steps: Result<Vec<Step>, String> = Ok(Vec::new());
        for codec in packed {
            match (&mut steps, step(codec["id"].as_str().unwrap_or_default(), codec)) {
                (Ok(steps), Ok(Some(step))) => steps.insert(0, step),
                (Ok(_), Err(what)) => steps = Err(what),
                _ => {}
            }
        }
        let codecs = steps.map(|steps| Codecs { order, big_endian: element.big_endian, steps, shard: None });
        let named = attributes.and_then(|a| a["_ARRAY_DIMENSIONS"].as_array());
        let dimensions: Vec<Option<String>> = named.into_iter().flatten().map(|d| text(d).map(str::to_owned)).collect();
        let fill = fill(&array["fill_value"], element.stored);
        let mut attributes = attributes.map(collect).unwrap_or_default();
        // In this version the fill value says what is missing (xarray). No coordinate is missing (CF conventions, section 2.5.1).
        let coordinate = matches!(&dimensions[..], [Some(dimension)] if *dimension == name);
        if let Some(fill) = fill.filter(|_| !coordinate && element.number.is_number())
            && !attributes.iter().any(|(name, _)| name == "_FillValue")
        {
            attributes.push(("_FillValue".into(), Attribute::Numbers(element.number, vec![fill])));
        }
        let names = ChunkNames { prefix: false, separator };
        Self { fill: fill.unwrap_or(f64::NAN), names, codecs, ..Self::of(element, shape, chunk, dimensions, attributes) }.checked()
    }

    /// An array of version 3, from its part of `zarr.json`.
    ///
    /// # Errors
    /// What is wrong or missing.
    pub fn version_3(array: &Value) -> Result<Self, String> {
        let shape = lengths(array, "shape", 0)?;
        let grid = &array["chunk_grid"];
        let regular = grid["name"] == "regular";
        let chunk = if regular { lengths(&grid["configuration"], "chunk_shape", 1)? } else { vec![1; shape.len()] };
        let element = Element::version_3(&array["data_type"]);
        let keys = &array["chunk_key_encoding"];
        let prefix = keys["name"] != "v2";
        let separator = match keys["configuration"]["separator"].as_str() {
            Some(".") => '.',
            Some("/") => '/',
            _ => {
                if prefix {
                    '/'
                } else {
                    '.'
                }
            }
        };
        let codecs = match regular {
            true => codecs(&array["codecs"], &chunk),
            false => Err(format!("its grid of chunks is {}; accepted is `regular`", brief(&grid["name"]))),
        };
        let dimensions = array["dimension_names"].as_array().into_iter().flatten().map(|d| text(d).map(str::to_owned)).collect();
        let mut attributes = collect(&array["attributes"]);
        // xarray stores it in base64, since JSON has no NaN.
        for (name, value) in &mut attributes {
            if let ("_FillValue", Attribute::Text(text)) = (&name[..], &*value)
                && let Some(fill) = from_base64(text)
            {
                *value = Attribute::Numbers(NumberType::Float64, vec![fill]);
            }
        }
        let fill = fill(&array["fill_value"], element.stored).unwrap_or(f64::NAN);
        Self { fill, names: ChunkNames { prefix, separator }, codecs, ..Self::of(element, shape, chunk, dimensions, attributes) }.checked()
    }

    fn of(
        element: Element,
        shape: Vec<usize>,
        chunk: Vec<usize>,
        dimensions: Vec<Option<String>>,
        attributes: Vec<(String, Attribute)>,
    ) -> Self {
        let mut array = Self {
            number: element.number,
            stored: element.stored,
            rank: shape.len(),
            shape,
            chunk,
            fill: f64::NAN,
            names: ChunkNames { prefix: false, separator: '.' },
            codecs: Err(String::new()),
            dimensions,
            attributes,
        };
        // Names for some of the dimensions are none.
        if array.dimensions.len() != array.rank {
            array.dimensions = vec![None; array.rank];
        }
        if let Some(characters) = element.characters {
            array.shape.push(characters);
            array.chunk.push(characters);
            array.dimensions.push(Some(format!("string{characters}")));
        }
        array
    }

    /// Checks what reading relies on.
    fn checked(mut self) -> Result<Self, String> {
        if self.shape.len() != self.chunk.len() || self.rank > MAX_RANK {
            return Err(format!(
                "it has {} dimensions and its chunks {}; accepted are {MAX_RANK} at most",
                self.shape.len(),
                self.chunk.len()
            ));
        }
        for extents in [&self.shape, &self.chunk] {
            let bytes = extents.iter().try_fold(self.stored.bytes().max(8), |n, &k| n.checked_mul(k.max(1)));
            if bytes.is_none_or(|n| n > isize::MAX as usize) {
                return Err(format!("its extents overflow: {extents:?}"));
            }
        }
        let characters = self.chunk.get(self.rank).copied();
        if let (Ok(codecs), Some(characters)) = (&mut self.codecs, characters) {
            codecs.order.push(self.rank);
            if let Some(shard) = &mut codecs.shard {
                shard.inner.push(characters);
            }
        }
        Ok(self)
    }
}

/// Product of extents, which were checked not to overflow.
fn volume(extents: &[usize]) -> u64 {
    extents.iter().fold(1, |n, &k| n.saturating_mul(k as u64))
}

/// The start of what was found, for a message: metadata may hold megabytes of it.
fn brief(found: impl ToString) -> String {
    format!("{:.80}", found.to_string())
}

/// Whole numbers from `least` on.
fn lengths(of: &Value, key: &str, least: u64) -> Result<Vec<usize>, String> {
    let list = of[key].as_array().ok_or_else(|| format!("its metadata have no list `{key}`"))?;
    let length = |v: &Value| v.as_u64().filter(|&n| n >= least).and_then(|n| usize::try_from(n).ok());
    list.iter()
        .map(|v| length(v).ok_or_else(|| format!("`{key}` holds {}; accepted are whole numbers from {least} on", brief(v))))
        .collect()
}

/// A type of elements.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Element {
    number: NumberType,
    stored: NumberType,
    big_endian: bool,
    characters: Option<usize>,
}

impl Element {
    const OTHER: Self = Self { number: NumberType::Other, stored: NumberType::Other, big_endian: false, characters: None };

    /// Of NumPy: `<f4`.
    fn version_2(name: &str) -> Self {
        let (Some(order @ ('<' | '>' | '|')), Some(kind)) = (name.chars().next(), name.get(1..)) else { return Self::OTHER };
        let text = |stored, digits: &str| match digits.parse() {
            Ok(length @ 1..=4096) => Self { number: NumberType::Text, stored, big_endian: order == '>', characters: Some(length) },
            _ => Self::OTHER,
        };
        let number = match kind {
            "i1" => NumberType::Int8,
            "u1" | "b1" => NumberType::Uint8,
            "i2" => NumberType::Int16,
            "u2" => NumberType::Uint16,
            "i4" => NumberType::Int32,
            "u4" => NumberType::Uint32,
            "i8" => NumberType::Int64,
            "u8" => NumberType::Uint64,
            "f4" => NumberType::Float32,
            "f8" => NumberType::Float64,
            // Characters of one byte, or of four.
            _ if kind.starts_with('S') => return text(NumberType::Uint8, &kind[1..]),
            _ if kind.starts_with('U') => return text(NumberType::Uint32, &kind[1..]),
            _ => return Self::OTHER,
        };
        Self { number, stored: number, big_endian: order == '>', characters: None }
    }

    fn version_3(kind: &Value) -> Self {
        let (name, bytes) = (kind["name"].as_str().or(kind.as_str()).unwrap_or_default(), kind["configuration"]["length_bytes"].as_u64());
        let numpy = match (name, bytes) {
            ("bool", _) => "b1".into(),
            ("int8", _) => "i1".into(),
            ("uint8", _) => "u1".into(),
            ("int16", _) => "i2".into(),
            ("uint16", _) => "u2".into(),
            ("int32", _) => "i4".into(),
            ("uint32", _) => "u4".into(),
            ("int64", _) => "i8".into(),
            ("uint64", _) => "u8".into(),
            ("float32", _) => "f4".into(),
            ("float64", _) => "f8".into(),
            ("null_terminated_bytes", Some(n)) => format!("S{n}"),
            ("fixed_length_utf32", Some(n)) => format!("U{}", n / 4),
            _ => return Self::OTHER,
        };
        Self::version_2(&format!("<{numpy}"))
    }
}

/// Value of chunks that are not stored; `None` if it is not stated or no number.
fn fill(value: &Value, stored: NumberType) -> Option<f64> {
    if let Some((value, _)) = number(value) {
        // As it would be stored.
        return Some(if stored == NumberType::Float32 { f64::from(value as f32) } else { value });
    }
    match text(value) {
        Some("NaN") => Some(f64::NAN),
        Some("Infinity") => Some(f64::INFINITY),
        Some("-Infinity") => Some(f64::NEG_INFINITY),
        // The bits of a number.
        Some(bits) => {
            let bits = u64::from_str_radix(bits.strip_prefix("0x")?, 16).ok()?;
            match stored {
                NumberType::Float32 => u32::try_from(bits).ok().map(|bits| f64::from(f32::from_bits(bits))),
                NumberType::Float64 => Some(f64::from_bits(bits)),
                _ => None,
            }
        }
        None => value.as_bool().map(f64::from),
    }
}

/// The step that undoes a codec; `None` if nothing has to be undone.
fn step(name: &str, settings: &Value) -> Result<Option<Step>, String> {
    match name.strip_prefix("numcodecs.").unwrap_or(name) {
        "gzip" => Ok(Some(Step::Gzip)),
        "zlib" => Ok(Some(Step::Zlib)),
        "zstd" => Ok(Some(Step::Zstd)),
        "blosc" => Ok(Some(Step::Blosc)),
        "lz4" => Ok(Some(Step::Lz4)),
        "crc32c" => Ok(Some(Step::Crc32c)),
        "shuffle" => match settings["elementsize"].as_u64().unwrap_or(4) {
            width @ 1..=64 => Ok(Some(Step::Shuffle(width as usize))),
            width => Err(format!("its codec `shuffle` has elements of {width} bytes; accepted are 1 to 64")),
        },
        "bitround" => Ok(None),
        _ => Err(format!(
            "its values are stored with the codec `{name:.80}`; accepted are {ACCEPTED}: xarray writes the store anew with one of them (`encoding`)"
        )),
    }
}

/// Codecs of version 3.
fn codecs(list: &Value, chunk: &[usize]) -> Result<Codecs, String> {
    let mut codecs = Codecs { order: (0..chunk.len()).collect(), big_endian: false, steps: Vec::new(), shard: None };
    for codec in list.as_array().ok_or("its metadata have no list `codecs`")? {
        let name = codec["name"].as_str().or(codec.as_str()).unwrap_or_default();
        let settings = &codec["configuration"];
        match name {
            "bytes" => codecs.big_endian = settings["endian"] == "big",
            "transpose" => {
                let order: Vec<usize> = match settings["order"].as_str() {
                    Some("C") => (0..chunk.len()).collect(),
                    Some("F") => (0..chunk.len()).rev().collect(),
                    _ => lengths(settings, "order", 0)?,
                };
                let mut sorted = order.clone();
                sorted.sort_unstable();
                if !sorted.into_iter().eq(0..chunk.len()) {
                    return Err(format!(
                        "its codec `transpose` has the order {} for {} dimensions",
                        brief(&settings["order"]),
                        chunk.len()
                    ));
                }
                codecs.order = order.iter().map(|&k| codecs.order[k]).collect();
            }
            "sharding_indexed" => {
                let inner = lengths(settings, "chunk_shape", 1)?;
                if inner.len() != chunk.len() || inner.iter().zip(chunk).any(|(inner, outer)| outer % inner != 0) {
                    return Err(format!(
                        "its chunks of {} do not divide its shards of {}",
                        brief(&settings["chunk_shape"]),
                        brief(format!("{chunk:?}"))
                    ));
                }
                let index = self::codecs(&settings["index_codecs"], &[])?;
                let within = self::codecs(&settings["codecs"], &inner)?;
                if index.steps.iter().any(|&step| step != Step::Crc32c) {
                    return Err("the index of its shards is compressed; accepted are the codecs `bytes` and `crc32c`".into());
                }
                if within.shard.is_some() || index.shard.is_some() || list.as_array().is_some_and(|l| l.len() > 1) {
                    return Err("its shards hold shards, or have other codecs beside; accepted is `sharding_indexed` alone".into());
                }
                let index_first = settings["index_location"] == "start";
                let shard = Shard { inner, index_big_endian: index.big_endian, index_steps: index.steps, index_first };
                return Ok(Codecs { shard: Some(shard), ..within });
            }
            _ => {
                if let Some(step) = step(name, settings)? {
                    codecs.steps.insert(0, step);
                }
            }
        }
    }
    Ok(codecs)
}

/// Attributes that hold numbers or texts; others are not needed.
pub fn collect(attributes: &Value) -> Vec<(String, Attribute)> {
    let own = attributes.as_object().into_iter().flatten().filter(|(name, _)| *name != "_ARRAY_DIMENSIONS");
    own.filter_map(|(name, value)| attribute(value).map(|value| (name.clone(), value))).collect()
}

fn attribute(value: &Value) -> Option<Attribute> {
    let numbers = |values: Vec<(f64, bool)>| {
        let kind = if values.iter().all(|v| v.1) { NumberType::Int64 } else { NumberType::Float64 };
        Attribute::Numbers(kind, values.into_iter().map(|v| v.0).collect())
    };
    match value {
        Value::Bool(value) => Some(Attribute::Text(value.to_string())),
        Value::Array(list) => match list.iter().map(number).collect() {
            Some(values) => Some(numbers(values)),
            None => list.iter().map(text).collect::<Option<Vec<_>>>().map(|texts| Attribute::Text(texts.join(" "))),
        },
        _ => number(value).map(|value| numbers(vec![value])).or_else(|| text(value).map(|text| Attribute::Text(text.into()))),
    }
}

/// The eight bytes of a number in base64.
fn from_base64(text: &str) -> Option<f64> {
    const DIGITS: &[u8] = b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
    let digits = text.strip_suffix('=').filter(|digits| digits.len() == 11)?;
    let bits = digits.bytes().try_fold(0u128, |n, c| Some(n << 6 | DIGITS.iter().position(|&d| d == c)? as u128))?;
    Some(f64::from_bits(((bits >> 2) as u64).swap_bytes()))
}

#[cfg(test)]
mod tests {
    use super::super::json::parse;
    use super::*;

    fn version_2(array: &str, attributes: &str) -> Result<Array, String> {
        Array::version_2(&parse(array.as_bytes()).unwrap(), Some(&parse(attributes.as_bytes()).unwrap()), "u")
    }

    const PLAIN: &str = r#""shape": [3, 4], "chunks": [2, 4], "order": "C", "zarr_format": 2"#;

    fn with(rest: &str) -> Result<Array, String> {
        version_2(&format!("{{{PLAIN}, {rest}}}"), "{}")
    }

    #[test]
    fn fill_values_of_version_2_are_missing() {
        let fills = |array: &Array| array.attributes.iter().find(|(name, _)| name == "_FillValue").map(|(_, value)| value.clone());
        let array = with(r#""dtype": ">i2", "fill_value": -32767, "compressor": null, "filters": null"#).unwrap();
        assert_eq!((array.number, array.fill, array.rank), (NumberType::Int16, -32_767.0, 2));
        assert_eq!(fills(&array), Some(Attribute::Numbers(NumberType::Int16, vec![-32_767.0])));
        assert!(array.codecs.unwrap().big_endian);
        let array = with(r#""dtype": "<f4", "fill_value": 0.1"#).unwrap();
        assert_eq!(array.fill, f64::from(0.1f32), "as it would be stored");
        assert!(with(r#""dtype": "<f4", "fill_value": null"#).is_ok_and(|array| array.fill.is_nan() && fills(&array).is_none()));
        let own =
            version_2(r#"{"shape": [4], "chunks": [4], "dtype": "<f4", "fill_value": 0}"#, r#"{"_ARRAY_DIMENSIONS": ["u"]}"#).unwrap();
        assert_eq!((fills(&own), own.fill), (None, 0.0), "a coordinate");
    }

    #[test]
    fn codecs_of_version_2_are_undone_backwards() {
        let filters =
            r#""dtype": "<f4", "filters": [{"id": "bitround"}, {"id": "shuffle", "elementsize": 4}], "compressor": {"id": "zlib"}"#;
        assert_eq!(with(filters).unwrap().codecs.unwrap().steps, [Step::Zlib, Step::Shuffle(4)]);
        let unknown = with(r#""dtype": "<f4", "compressor": {"id": "jpeg2k"}"#).unwrap().codecs.unwrap_err();
        assert!(unknown.contains("`jpeg2k`") && unknown.contains("accepted are gzip"), "{unknown}");
        let turned = version_2(r#"{"shape": [3, 4], "chunks": [3, 4], "dtype": "<f8", "order": "F"}"#, "{}").unwrap();
        assert_eq!(turned.codecs.unwrap().order, [1, 0]);
    }

    #[test]
    fn texts_have_a_dimension_more() {
        let array = version_2(r#"{"shape": [3], "chunks": [1], "dtype": "|S19"}"#, r#"{"_ARRAY_DIMENSIONS": ["Time"]}"#).unwrap();
        assert_eq!((array.number, array.shape, array.chunk, array.rank), (NumberType::Text, vec![3, 19], vec![1, 19], 1));
        assert_eq!(array.dimensions, [Some("Time".into()), Some("string19".to_owned())]);
        assert_eq!(array.codecs.unwrap().order, [0, 1]);
    }

    #[test]
    fn what_overflows_or_is_missing_is_refused() {
        for (array, piece) in [
            (r#"{"shape": [9223372036854775807, 9], "chunks": [1, 1], "dtype": "<f4"}"#, "overflow"),
            (r#"{"shape": [9, 9], "chunks": [4294967296, 4294967296], "dtype": "<f4"}"#, "overflow"),
            (r#"{"shape": [9], "chunks": [0], "dtype": "<f4"}"#, "`chunks` holds 0"),
            (r#"{"shape": [9], "chunks": [1, 1], "dtype": "<f4"}"#, "1 dimensions and its chunks 2"),
            (r#"{"shape": [-1], "chunks": [1], "dtype": "<f4"}"#, "`shape` holds -1"),
            (r#"{"chunks": [1], "dtype": "<f4"}"#, "no list `shape`"),
        ] {
            let said = version_2(array, "{}").err().unwrap();
            assert!(said.contains(piece), "{said}");
        }
    }

    #[test]
    fn version_3_as_xarray_writes_it() {
        let json = r#"{"shape": [4, 6], "data_type": "float32", "node_type": "array", "zarr_format": 3, "fill_value": "0x7fc00000",
            "chunk_grid": {"name": "regular", "configuration": {"chunk_shape": [4, 6]}},
            "chunk_key_encoding": {"name": "default", "configuration": {"separator": "/"}},
            "codecs": [{"name": "sharding_indexed", "configuration": {"chunk_shape": [2, 3],
                "codecs": [{"name": "transpose", "configuration": {"order": [1, 0]}}, {"name": "bytes", "configuration": {"endian": "big"}}, {"name": "zstd"}],
                "index_codecs": [{"name": "bytes", "configuration": {"endian": "little"}}, {"name": "crc32c"}]}}],
            "attributes": {"_FillValue": "AAAAAAAA+H8=", "scale_factor": 0.5, "valid_range": [1, 2]}, "dimension_names": ["y", null]}"#;
        let array = Array::version_3(&parse(json.as_bytes()).unwrap()).unwrap();
        assert!(array.fill.is_nan());
        assert_eq!((array.block(), array.block_bytes(), array.index_bytes()), (&[2, 3][..], 24, 64));
        assert_eq!(array.names.of(&[0, 1]), "c/0/1");
        assert_eq!(array.dimensions, [Some("y".to_owned()), None]);
        let codecs = array.codecs.unwrap();
        assert_eq!((codecs.order, codecs.big_endian, codecs.steps), (vec![1, 0], true, vec![Step::Zstd]));
        let shard = codecs.shard.unwrap();
        assert_eq!((shard.index_steps, shard.index_big_endian, shard.index_first), (vec![Step::Crc32c], false, false));
        let Some((_, Attribute::Numbers(NumberType::Float64, fill))) = array.attributes.iter().find(|a| a.0 == "_FillValue") else {
            panic!("{:?}", array.attributes)
        };
        assert!(fill[0].is_nan());
        assert_eq!(from_base64("AAAAAAAA8D8="), Some(1.0));
        assert_eq!(ChunkNames { prefix: false, separator: '.' }.of(&[]), "0");
        assert_eq!(ChunkNames { prefix: true, separator: '/' }.of(&[]), "c");
    }
}
