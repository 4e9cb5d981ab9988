//! NetCDF classic (versions 1, 2 and 5), read without a library.
//!
//! libnetcdf reads zeros past the end of a truncated classic file and reports no error, so the header must be checked here in any
//! case. Once the header is known, a value is one seek away, reading needs no global lock, and a damaged byte cannot crash C code.
//! Source: "NetCDF Classic Format Specification", NetCDF User's Guide, appendix B.

use super::limits::{MAX_ATTRIBUTE_BYTES, MAX_ATTRIBUTES, MAX_OBJECTS};
use super::messages::{Attribute, Dimension, FormatError, FormatFault, Listing, NumberType, Variable};
use super::store::{Store, advance};
use std::fs::File;
use std::io::{self, BufReader, Read, Seek, SeekFrom};

/// Largest piece that is read at once if only parts of it are wanted.
const PIECE: usize = 1 << 20;
/// Most dimensions of a variable that libnetcdf writes.
const MAX_RANK: usize = 1024;

/// An open classic file.
pub struct ClassicStore {
    file: File,
    places: Vec<Place>,
    record_bytes: u64,
}

/// Place of a variable's values.
struct Place {
    begin: u64,
    shape: Vec<usize>,
    record: bool,
}

impl ClassicStore {
    /// Fills an empty listing from the header.
    pub fn open(listing: Listing, file: File, version: u8) -> Result<(Listing, Self), FormatError> {
        let (path, bytes) = (listing.path.clone(), listing.bytes);
        let damaged = |what| FormatFault::Damaged(what).of(&path);
        let mut parser = Parser {
            input: BufReader::new(&file),
            left: bytes,
            wide: version == 5,
            wide_offsets: version != 1,
            attributes: 0,
            attribute_bytes: 0,
        };
        let parsed = parser.header().map_err(|fault| match fault {
            Fault::Ended => damaged(format!("its header does not end within {bytes} bytes")),
            Fault::Io(cause) => FormatFault::Open(cause.to_string()).of(&path),
            Fault::Nonsense(what) => damaged(what),
            Fault::TooMany(what) => FormatFault::Refused(what).of(&path),
        })?;
        let (listing, places, record_bytes, needed) = parsed.lay_out(listing).map_err(damaged)?;
        if needed > bytes {
            return Err(FormatFault::Truncated { expected: needed, found: bytes }.of(&path));
        }
        Ok((listing, Self { file, places, record_bytes }))
    }
}

impl Store for ClassicStore {
    /// The header was checked to lie inside the file.
    fn read(&self, index: usize, variable: &Variable, start: &[usize], count: &[usize], out: &mut Vec<f64>) -> Result<(), String> {
        let Place { begin, ref shape, record } = self.places[index];
        let (number, width) = (variable.number, variable.number.bytes() as u64);
        let rank = shape.len();
        // Bytes between neighbours along each dimension.
        let mut strides = vec![width; rank];
        for k in (0..rank.saturating_sub(1)).rev() {
            strides[k] = strides[k + 1] * shape[k + 1] as u64;
        }
        if record {
            strides[0] = self.record_bytes;
        }
        // The inner dimensions from `split` on are read as one piece, gaps included, from which the values are picked.
        let span = |k: usize| (k..rank).map(|d| (count[d] as u64 - 1) * strides[d]).sum::<u64>() + width;
        let split = (usize::from(record)..rank).find(|&k| span(k) <= PIECE as u64).unwrap_or(rank);
        let mut piece = vec![0u8; span(split) as usize];
        let mut outer = vec![0usize; split];
        let inner_start: u64 = (split..rank).map(|k| start[k] as u64 * strides[k]).sum();
        loop {
            let offset = (0..split).map(|k| (start[k] + outer[k]) as u64 * strides[k]).sum::<u64>();
            let mut input = &self.file;
            input.seek(SeekFrom::Start(begin + offset + inner_start)).map_err(|e| e.to_string())?;
            input.read_exact(&mut piece).map_err(|e| e.to_string())?;
            pick(&piece, number, &count[split..], &strides[split..], out);
            if !advance(&mut outer, &count[..split]) {
                return Ok(());
            }
        }
    }
}

/// Decodes the elements of a block from a piece of bytes.
fn pick(piece: &[u8], number: NumberType, count: &[usize], strides: &[u64], out: &mut Vec<f64>) {
    fn decode<const N: usize>(piece: &[u8], count: &[usize], strides: &[u64], to: impl Fn([u8; N]) -> f64, out: &mut Vec<f64>) {
        let row = count.last().copied().unwrap_or(1);
        let (rows, step) = (&count[..count.len().saturating_sub(1)], strides.last().map_or(N, |&s| s as usize));
        let mut index = vec![0usize; rows.len()];
        loop {
            let at = index.iter().zip(strides).map(|(&i, &s)| i * s as usize).sum::<usize>();
            out.extend((0..row).map(|i| {
                let mut bytes = [0u8; N];
                bytes.copy_from_slice(&piece[at + i * step..at + i * step + N]);
                to(bytes)
            }));
            if !advance(&mut index, rows) {
                return;
            }
        }
    }
    match number {
        NumberType::Int8 => decode::<1>(piece, count, strides, |b| f64::from(b[0] as i8), out),
        NumberType::Uint8 | NumberType::Text | NumberType::Other => decode::<1>(piece, count, strides, |b| f64::from(b[0]), out),
        NumberType::Int16 => decode(piece, count, strides, |b| f64::from(i16::from_be_bytes(b)), out),
        NumberType::Uint16 => decode(piece, count, strides, |b| f64::from(u16::from_be_bytes(b)), out),
        NumberType::Int32 => decode(piece, count, strides, |b| f64::from(i32::from_be_bytes(b)), out),
        NumberType::Uint32 => decode(piece, count, strides, |b| f64::from(u32::from_be_bytes(b)), out),
        NumberType::Float32 => decode(piece, count, strides, |b| f64::from(f32::from_be_bytes(b)), out),
        NumberType::Float64 => decode(piece, count, strides, f64::from_be_bytes, out),
        NumberType::Int64 => decode(piece, count, strides, |b| i64::from_be_bytes(b) as f64, out),
        NumberType::Uint64 => decode(piece, count, strides, |b| u64::from_be_bytes(b) as f64, out),
    }
}

enum Fault {
    Ended,
    Io(io::Error),
    Nonsense(String),
    TooMany(String),
}

/// Header of the file, before shapes are resolved.
struct Parsed {
    /// `None` if the file was still being written ("streaming").
    records: Option<u64>,
    dimensions: Vec<(String, u64)>,
    variables: Vec<(Variable, u64)>,
    attributes: Vec<(String, Attribute)>,
}

struct Parser<'a> {
    input: BufReader<&'a File>,
    left: u64,
    wide: bool,
    wide_offsets: bool,
    /// Attributes so far, and their bytes.
    attributes: usize,
    attribute_bytes: u64,
}

impl Parser<'_> {
    fn header(&mut self) -> Result<Parsed, Fault> {
        self.bytes::<4>()?;
        let records = self.count()?;
        let streaming = if self.wide { u64::MAX } else { u64::from(u32::MAX) };
        let dimensions = self.list(0x0a, "dimensions", MAX_OBJECTS, |p| Ok((p.name()?, p.count()?)))?;
        let attributes = self.attributes()?;
        let variables = self.list(0x0b, "variables", MAX_OBJECTS, |p| {
            let name = p.name()?;
            let rank = p.length("dimensions")?;
            if rank > MAX_RANK {
                return Err(Fault::Nonsense(format!("variable `{name}` has {rank} dimensions")));
            }
            let mut ids = Vec::with_capacity(rank);
            for _ in 0..rank {
                ids.push(p.count()? as usize);
            }
            let attributes = p.attributes()?;
            let number = p.number_type()?;
            p.count()?; // The size is computed from the shape: it overflows here for large variables.
            let begin = if p.wide_offsets { u64::from_be_bytes(p.bytes()?) } else { u64::from(u32::from_be_bytes(p.bytes()?)) };
            Ok((Variable { name, number, dimensions: ids, attributes }, begin))
        })?;
        Ok(Parsed { records: (records != streaming).then_some(records), dimensions, variables, attributes })
    }

    fn bytes<const N: usize>(&mut self) -> Result<[u8; N], Fault> {
        let mut bytes = [0u8; N];
        self.fill(&mut bytes)?;
        Ok(bytes)
    }

    fn fill(&mut self, bytes: &mut [u8]) -> Result<(), Fault> {
        self.left = self.left.checked_sub(bytes.len() as u64).ok_or(Fault::Ended)?;
        self.input.read_exact(bytes).map_err(Fault::Io)
    }

    fn count(&mut self) -> Result<u64, Fault> {
        Ok(if self.wide { u64::from_be_bytes(self.bytes()?) } else { u64::from(u32::from_be_bytes(self.bytes()?)) })
    }

    /// A number of items of at least a byte each, so that it cannot exceed the rest of the file.
    fn length(&mut self, of: &str) -> Result<usize, Fault> {
        let count = self.count()?;
        if count > self.left {
            return Err(Fault::Nonsense(format!("{count} {of} in its remaining {} bytes", self.left)));
        }
        Ok(count as usize)
    }

    fn padded(&mut self, length: usize) -> Result<Vec<u8>, Fault> {
        let mut bytes = vec![0u8; length];
        self.fill(&mut bytes)?;
        let mut rest = [0u8; 3];
        self.fill(&mut rest[..(4 - length % 4) % 4])?;
        Ok(bytes)
    }

    fn name(&mut self) -> Result<String, Fault> {
        let length = self.length("characters of a name")?;
        Ok(String::from_utf8_lossy(&self.padded(length)?).into_owned())
    }

    fn list<T>(&mut self, tag: u32, of: &str, most: usize, mut item: impl FnMut(&mut Self) -> Result<T, Fault>) -> Result<Vec<T>, Fault> {
        let found = u32::from_be_bytes(self.bytes()?);
        let length = self.length(of)?;
        if found != tag && (found, length) != (0, 0) {
            return Err(Fault::Nonsense(format!("its list of {of} starts with tag {found}, not {tag}")));
        }
        if length > most {
            return Err(Fault::TooMany(format!("it holds {length} {of}; accepted are {most} at most")));
        }
        (0..length).map(|_| item(self)).collect()
    }

    fn number_type(&mut self) -> Result<NumberType, Fault> {
        use NumberType::*;
        const TYPES: [NumberType; 11] = [Int8, Text, Int16, Int32, Float32, Float64, Uint8, Uint16, Uint32, Int64, Uint64];
        let code = u32::from_be_bytes(self.bytes()?);
        let known = (code as usize).checked_sub(1).and_then(|place| TYPES.get(place));
        known.copied().ok_or_else(|| Fault::Nonsense(format!("number type {code} is unknown")))
    }

    fn attributes(&mut self) -> Result<Vec<(String, Attribute)>, Fault> {
        self.list(0x0c, "attributes", MAX_ATTRIBUTES, |p| {
            let name = p.name()?;
            let number = p.number_type()?;
            let length = p.length("values of an attribute")?;
            let bytes = length.checked_mul(number.bytes()).filter(|&b| b as u64 <= p.left).ok_or(Fault::Ended)?;
            p.attributes += 1;
            p.attribute_bytes += bytes as u64;
            if p.attributes > MAX_ATTRIBUTES || p.attribute_bytes > MAX_ATTRIBUTE_BYTES {
                let megabytes = MAX_ATTRIBUTE_BYTES >> 20;
                return Err(Fault::TooMany(format!("it holds more than {MAX_ATTRIBUTES} attributes, or {megabytes} MiB of them")));
            }
            let bytes = p.padded(bytes)?;
            if number == NumberType::Text {
                let text = bytes.split(|&b| b == 0).next().unwrap_or_default();
                return Ok((name, Attribute::Text(String::from_utf8_lossy(text).into_owned())));
            }
            let mut values = Vec::with_capacity(length);
            if length > 0 {
                pick(&bytes, number, &[length], &[number.bytes() as u64], &mut values);
            }
            Ok((name, Attribute::Numbers(number, values)))
        })
    }
}

impl Parsed {
    /// Resolves shapes and places. Returns also the bytes of a record and the bytes that the file must have.
    fn lay_out(self, listing: Listing) -> Result<(Listing, Vec<Place>, u64, u64), String> {
        let record_dimension = self.dimensions.iter().position(|(_, len)| *len == 0);
        if self.dimensions.iter().filter(|(_, len)| *len == 0).count() > 1 {
            return Err("it has more than one record dimension".into());
        }
        // Begin, bytes (of one record), and whether the variable has records.
        let mut extents = Vec::new();
        for (variable, begin) in &self.variables {
            let mut bytes = variable.number.bytes() as u64;
            let mut record = false;
            for (k, &id) in variable.dimensions.iter().enumerate() {
                let Some((name, len)) = self.dimensions.get(id) else {
                    return Err(format!("variable `{}` refers to dimension {id}, which does not exist", variable.name));
                };
                if Some(id) != record_dimension {
                    bytes = bytes.checked_mul(*len).ok_or_else(|| format!("the size of variable `{}` overflows", variable.name))?;
                } else if k > 0 {
                    return Err(format!("variable `{}` has the record dimension `{name}` in place {k}, not 0", variable.name));
                } else {
                    record = true;
                }
            }
            extents.push((*begin, bytes, record));
        }
        // Records are padded to four bytes for each variable, unless they hold one variable only.
        let of_records: Vec<u64> = extents.iter().filter(|e| e.2).map(|e| e.1).collect();
        let record_bytes = match of_records[..] {
            [only] => only,
            _ => of_records
                .iter()
                .try_fold(0u64, |sum, b| sum.checked_add(b.checked_next_multiple_of(4)?))
                .ok_or("the size of a record overflows")?,
        };
        let first_record = extents.iter().filter(|e| e.2).map(|e| e.0).min();
        let records = match (self.records, first_record) {
            (Some(records), _) => records,
            (None, Some(begin)) if record_bytes > 0 => listing.bytes.saturating_sub(begin) / record_bytes,
            (None, _) => 0,
        };
        let mut needed = 0u64;
        for &(begin, bytes, record) in &extents {
            let before = match record {
                true if records == 0 => continue,
                true => (records - 1).checked_mul(record_bytes).ok_or("the size of all records overflows")?,
                false => 0,
            };
            let end = begin.checked_add(before).and_then(|b| b.checked_add(bytes)).ok_or("the end of a variable overflows")?;
            needed = needed.max(end);
        }
        let dimensions = self.dimensions.into_iter().map(|(name, len)| {
            let len = if len == 0 { records } else { len };
            usize::try_from(len).map(|len| Dimension { name, len }).map_err(|e| e.to_string())
        });
        let listing = Listing {
            dimensions: dimensions.collect::<Result<_, _>>()?,
            variables: self.variables.into_iter().map(|(v, _)| v).collect(),
            attributes: self.attributes,
            ..listing
        };
        let place = |(variable, (begin, _, record))| Place { begin, shape: listing.shape(variable), record };
        let places = listing.variables.iter().zip(extents).map(place).collect();
        Ok((listing, places, record_bytes, needed))
    }
}
