//! NetCDF classic (versions 1, 2 and 5), read directly.
//!
//! libnetcdf reads zeros past the end of a truncated classic file and says nothing, so the header must be checked here
//! anyway; with the header known, the values are a seek away, need no global lock, and no damaged byte can crash C code.
//! Format: "NetCDF Classic Format Specification", NetCDF User's Guide, appendix B.

use super::SourceError;
use super::container::{Attribute, Dimension, Header, NumberType, Variable};
use std::fs::File;
use std::io::{self, BufReader, Read, Seek, SeekFrom};
use std::path::Path;

/// Largest piece that is read at once when only parts of it are wanted.
const PIECE: usize = 1 << 20;

/// An open classic file.
pub(super) struct ClassicStore {
    file: File,
    places: Vec<Place>,
    record_bytes: u64,
}

/// Where the values of a variable are.
struct Place {
    begin: u64,
    width: usize,
    number: NumberType,
    record: bool,
}

impl ClassicStore {
    pub(super) fn open(path: &Path, file: File, length: u64, version: u8) -> Result<(Header, Self), SourceError> {
        let mut parser = Parser { input: BufReader::new(&file), left: length, wide: version == 5, wide_offsets: version != 1 };
        let parsed = parser.header().map_err(|fault| match fault {
            Fault::Ended => SourceError::Damaged { path: path.into(), what: format!("its header does not end within {length} bytes") },
            Fault::Io(cause) => SourceError::Open { path: path.into(), cause },
            Fault::Nonsense(what) => SourceError::Damaged { path: path.into(), what },
        })?;
        let (header, places, record_bytes, needed) =
            parsed.lay_out(length).map_err(|what| SourceError::Damaged { path: path.into(), what })?;
        if needed > length {
            return Err(SourceError::Truncated { path: path.into(), expected: needed, found: length });
        }
        Ok((header, Self { file, places, record_bytes }))
    }

    /// Appends a hyperslab. The caller has checked that it lies inside `shape`, and the header that it lies inside the file.
    pub(super) fn read(&self, variable: usize, shape: &[usize], start: &[usize], count: &[usize], out: &mut Vec<f64>) -> io::Result<()> {
        let place = &self.places[variable];
        let rank = shape.len();
        let first = usize::from(place.record);
        // Bytes between neighbours along each dimension.
        let mut strides = vec![place.width as u64; rank];
        for k in (0..rank.saturating_sub(1)).rev() {
            strides[k] = strides[k + 1] * shape[k + 1] as u64;
        }
        if place.record {
            strides[0] = self.record_bytes;
        }
        // The inner dimensions from `split` on are read as one piece, gaps included, and picked from.
        let span = |k: usize| (k..rank).map(|d| (count[d] as u64 - 1) * strides[d]).sum::<u64>() + place.width as u64;
        let split = (first..rank).find(|&k| span(k) <= PIECE as u64).unwrap_or(rank);
        let mut piece = vec![0u8; span(split) as usize];
        let mut outer = vec![0usize; split];
        let inner_start: u64 = (split..rank).map(|k| start[k] as u64 * strides[k]).sum();
        loop {
            let offset = (0..split).map(|k| (start[k] + outer[k]) as u64 * strides[k]).sum::<u64>();
            let mut input = &self.file;
            input.seek(SeekFrom::Start(place.begin + offset + inner_start))?;
            input.read_exact(&mut piece)?;
            pick(&piece, place.number, &count[split..], &strides[split..], out);
            if !advance(&mut outer, &count[..split]) {
                return Ok(());
            }
        }
    }
}

/// Next index in row-major order; false after the last.
fn advance(index: &mut [usize], count: &[usize]) -> bool {
    for k in (0..index.len()).rev() {
        index[k] += 1;
        if index[k] < count[k] {
            return true;
        }
        index[k] = 0;
    }
    false
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
        NumberType::I8 => decode::<1>(piece, count, strides, |b| f64::from(b[0] as i8), out),
        NumberType::U8 | NumberType::Text | NumberType::Other => decode::<1>(piece, count, strides, |b| f64::from(b[0]), out),
        NumberType::I16 => decode(piece, count, strides, |b| f64::from(i16::from_be_bytes(b)), out),
        NumberType::U16 => decode(piece, count, strides, |b| f64::from(u16::from_be_bytes(b)), out),
        NumberType::I32 => decode(piece, count, strides, |b| f64::from(i32::from_be_bytes(b)), out),
        NumberType::U32 => decode(piece, count, strides, |b| f64::from(u32::from_be_bytes(b)), out),
        NumberType::F32 => decode(piece, count, strides, |b| f64::from(f32::from_be_bytes(b)), out),
        NumberType::F64 => decode(piece, count, strides, f64::from_be_bytes, out),
        NumberType::I64 => decode(piece, count, strides, |b| i64::from_be_bytes(b) as f64, out),
        NumberType::U64 => decode(piece, count, strides, |b| u64::from_be_bytes(b) as f64, out),
    }
}

enum Fault {
    Ended,
    Io(io::Error),
    Nonsense(String),
}

/// Header as it stands in the file.
struct Parsed {
    /// None while the file was being written ("streaming").
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
}

impl Parser<'_> {
    fn header(&mut self) -> Result<Parsed, Fault> {
        self.bytes::<4>()?;
        let records = self.count()?;
        let streaming = if self.wide { u64::MAX } else { u64::from(u32::MAX) };
        let dimensions = self.list(0x0a, "dimensions", |p| Ok((p.name()?, p.count()?)))?;
        let attributes = self.attributes()?;
        let variables = self.list(0x0b, "variables", |p| {
            let name = p.name()?;
            let rank = p.length("dimensions")?;
            let mut ids = Vec::with_capacity(rank);
            for _ in 0..rank {
                ids.push(p.count()? as usize);
            }
            let attributes = p.attributes()?;
            let (number, _) = p.number_type()?;
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

    /// A number of things that take at least a byte each, so that it cannot exceed what is left of the file.
    fn length(&mut self, of: &str) -> Result<usize, Fault> {
        let count = self.count()?;
        if count > self.left {
            return Err(Fault::Nonsense(format!("{count} {of} in the {} bytes that are left of it", self.left)));
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

    fn list<T>(&mut self, tag: u32, of: &str, mut item: impl FnMut(&mut Self) -> Result<T, Fault>) -> Result<Vec<T>, Fault> {
        let found = u32::from_be_bytes(self.bytes()?);
        let length = self.length(of)?;
        if found != tag && (found, length) != (0, 0) {
            return Err(Fault::Nonsense(format!("its list of {of} starts with tag {found}, not {tag}")));
        }
        (0..length).map(|_| item(self)).collect()
    }

    /// Type and width in bytes.
    fn number_type(&mut self) -> Result<(NumberType, usize), Fault> {
        let code = u32::from_be_bytes(self.bytes()?);
        Ok(match code {
            1 => (NumberType::I8, 1),
            2 => (NumberType::Text, 1),
            3 => (NumberType::I16, 2),
            4 => (NumberType::I32, 4),
            5 => (NumberType::F32, 4),
            6 => (NumberType::F64, 8),
            7 => (NumberType::U8, 1),
            8 => (NumberType::U16, 2),
            9 => (NumberType::U32, 4),
            10 => (NumberType::I64, 8),
            11 => (NumberType::U64, 8),
            _ => return Err(Fault::Nonsense(format!("number type {code} is unknown"))),
        })
    }

    fn attributes(&mut self) -> Result<Vec<(String, Attribute)>, Fault> {
        self.list(0x0c, "attributes", |p| {
            let name = p.name()?;
            let (number, width) = p.number_type()?;
            let length = p.length("values of an attribute")?;
            let bytes = length.checked_mul(width).filter(|&b| b as u64 <= p.left).ok_or(Fault::Ended)?;
            let bytes = p.padded(bytes)?;
            Ok((
                name,
                if number == NumberType::Text {
                    let text = bytes.split(|&b| b == 0).next().unwrap_or_default();
                    Attribute::Text(String::from_utf8_lossy(text).into_owned())
                } else {
                    let mut values = Vec::with_capacity(length);
                    if length > 0 {
                        pick(&bytes, number, &[length], &[width as u64], &mut values);
                    }
                    Attribute::Numbers(number, values)
                },
            ))
        })
    }
}

impl Parsed {
    /// Resolves shapes and places. Returns also the bytes of a record and the bytes that the file must have.
    fn lay_out(self, length: u64) -> Result<(Header, Vec<Place>, u64, u64), String> {
        let record_dimension = self.dimensions.iter().position(|(_, len)| *len == 0);
        if self.dimensions.iter().filter(|(_, len)| *len == 0).count() > 1 {
            return Err("it has more than one record dimension".into());
        }
        let (mut places, mut fixed_bytes) = (Vec::new(), Vec::new());
        for (variable, begin) in &self.variables {
            let width = width(variable.number);
            let mut bytes = width as u64;
            let mut record = false;
            for (k, &id) in variable.dimensions.iter().enumerate() {
                let Some((name, len)) = self.dimensions.get(id) else {
                    return Err(format!("variable `{}` refers to dimension {id}, which is not there", variable.name));
                };
                if Some(id) == record_dimension {
                    if k > 0 {
                        return Err(format!("variable `{}` has the record dimension `{name}` in place {k}, not 0", variable.name));
                    }
                    record = true;
                } else {
                    bytes = bytes.checked_mul(*len).ok_or_else(|| format!("the size of variable `{}` overflows", variable.name))?;
                }
            }
            places.push(Place { begin: *begin, width, number: variable.number, record });
            fixed_bytes.push(bytes);
        }
        // Records are padded to four bytes a variable, unless there is only one variable in them.
        let of_records: Vec<u64> = places.iter().zip(&fixed_bytes).filter(|(p, _)| p.record).map(|(_, &b)| b).collect();
        let record_bytes = match of_records[..] {
            [only] => only,
            _ => of_records
                .iter()
                .try_fold(0u64, |sum, b| sum.checked_add(b.checked_next_multiple_of(4)?))
                .ok_or("the size of a record overflows")?,
        };
        let first_record = places.iter().filter(|p| p.record).map(|p| p.begin).min();
        let records = match (self.records, first_record) {
            (Some(records), _) => records,
            (None, Some(begin)) if record_bytes > 0 => length.saturating_sub(begin) / record_bytes,
            (None, _) => 0,
        };
        let mut needed = 0u64;
        for (place, &bytes) in places.iter().zip(&fixed_bytes) {
            let before = match place.record {
                true if records == 0 => continue,
                true => (records - 1).checked_mul(record_bytes).ok_or("the size of all records overflows")?,
                false => 0,
            };
            let end = place.begin.checked_add(before).and_then(|b| b.checked_add(bytes)).ok_or("the end of a variable overflows")?;
            needed = needed.max(end);
        }
        let dimensions = self.dimensions.into_iter().map(|(name, len)| {
            let len = if len == 0 { records } else { len };
            usize::try_from(len).map(|len| Dimension { name, len }).map_err(|e| e.to_string())
        });
        let header = Header {
            dimensions: dimensions.collect::<Result<_, _>>()?,
            variables: self.variables.into_iter().map(|(v, _)| v).collect(),
            attributes: self.attributes,
        };
        Ok((header, places, record_bytes, needed))
    }
}

fn width(number: NumberType) -> usize {
    match number {
        NumberType::I8 | NumberType::U8 | NumberType::Text | NumberType::Other => 1,
        NumberType::I16 | NumberType::U16 => 2,
        NumberType::I32 | NumberType::U32 | NumberType::F32 => 4,
        NumberType::I64 | NumberType::U64 | NumberType::F64 => 8,
    }
}
