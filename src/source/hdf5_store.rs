//! HDF5 without the structure of NetCDF, through libhdf5. Its lock is the one that libnetcdf's calls take: both libraries are used by one
//! thread at a time.

use super::SourceError;
use super::container::{Attribute, Dimension, Header, NumberType, Variable};
use super::crash::Reading;
use super::netcdf4::silence;
use hdf5_metno::types::{FixedAscii, FixedUnicode, FloatSize, IntSize, TypeDescriptor, VarLenAscii, VarLenUnicode};
use hdf5_metno::{Group, Hyperslab, LinkType, SliceOrIndex};
use ndarray::ArrayD;
use std::fs::TryLockError;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::{Path, PathBuf};

/// Groups within groups, and datasets in all, that are looked at: more than any archive has, and a bound for a damaged one.
const DEEPEST: usize = 8;
const MOST_DATASETS: usize = 100_000;
/// Values of an attribute that are read.
const LONGEST_ATTRIBUTE: usize = 4096;
/// Characters of a text attribute that are read.
const LONGEST_TEXT: usize = 1024;

/// Whether a file that could not be opened only could not be locked. The libraries say no more than that they failed.
pub(super) fn locked(path: &Path, what: &str) -> Option<SourceError> {
    // As libhdf5 reads it.
    if std::env::var_os("HDF5_USE_FILE_LOCKING").is_some_and(|value| value == "FALSE" || value == "0") {
        return None;
    }
    let why = match std::fs::File::open(path).ok()?.try_lock_shared() {
        Ok(()) => return None,
        Err(TryLockError::WouldBlock) => "another process has locked it, perhaps since it is still being written".to_owned(),
        Err(TryLockError::Error(error)) => format!("its file system says {error}"),
    };
    Some(SourceError::Locked { path: path.into(), why, what: what.into() })
}

/// An open HDF5 file.
pub(super) struct Hdf5Store {
    file: hdf5_metno::File,
    path: PathBuf,
}

impl Hdf5Store {
    /// Opens a file. Datasets become variables named by their path without the leading `/`; their axes become dimensions, shared by axes
    /// of one place and length.
    pub(super) fn open(path: &Path) -> Result<(Header, Self), SourceError> {
        silence();
        let _reading = Reading::opening(path);
        let damaged = |what: String| SourceError::Damaged { path: path.into(), what };
        let opened = catch_unwind(AssertUnwindSafe(|| -> hdf5_metno::Result<_> {
            let file = hdf5_metno::File::open(path)?;
            let mut header = Header { attributes: attributes(&file), ..Header::default() };
            collect(&file, "", 0, &mut header)?;
            Ok((header, file))
        }));
        match opened {
            Ok(Ok((header, file))) => Ok((header, Self { file, path: path.into() })),
            Ok(Err(error)) => Err(locked(path, &error.to_string()).unwrap_or_else(|| damaged(error.to_string()))),
            Err(_) => Err(damaged("the HDF5 library failed on it".into())),
        }
    }

    /// Opens a file that is expected to be like another, whose header is `like`: only its variables are looked for, by name, and their
    /// dimensions are taken to have the same names. None where something is not as expected.
    pub(super) fn open_like(path: &Path, like: &Header) -> Option<(Header, Self)> {
        silence();
        let _reading = Reading::opening(path);
        let open = || -> Option<(Header, Self)> {
            let file = hdf5_metno::File::open(path).ok()?;
            let mut header = Header::default();
            for expected in &like.variables {
                let dataset = file.dataset(&expected.name).ok()?;
                let shape = dataset.shape();
                let number = number_type(&dataset.dtype().ok()?.to_descriptor().ok()?);
                if shape.len() != expected.dimensions.len() || number != expected.number {
                    return None;
                }
                let named = expected.dimensions.iter().zip(shape).map(|(&d, len)| Dimension { name: like.dimensions[d].name.clone(), len });
                let dimensions = named.map(|dimension| header.dimension(dimension)).collect();
                header.variables.push(Variable { name: expected.name.clone(), number, dimensions, attributes: attributes(&dataset) });
            }
            Some((header, Self { file, path: path.into() }))
        };
        catch_unwind(AssertUnwindSafe(open)).ok().flatten()
    }

    /// Reads a hyperslab as `f64`.
    pub(super) fn read(&self, name: &str, start: &[usize], count: &[usize], out: &mut Vec<f64>) -> Result<(), String> {
        silence();
        let _reading = Reading::of(&self.path);
        let read = catch_unwind(AssertUnwindSafe(|| -> hdf5_metno::Result<()> {
            let dataset = self.file.dataset(name)?;
            if count.is_empty() {
                out.push(dataset.read_scalar::<f64>()?);
                return Ok(());
            }
            let slices: Vec<SliceOrIndex> = start.iter().zip(count).map(|(&s, &c)| SliceOrIndex::from(s..s + c)).collect();
            let values: ArrayD<f64> = dataset.read_slice(Hyperslab::from(slices))?;
            out.extend(values.iter());
            Ok(())
        }));
        match read {
            Ok(result) => result.map_err(|e| e.to_string()),
            Err(_) => Err("the HDF5 library failed".into()),
        }
    }
}

/// Datasets of a group and of the groups in it, by hard links only: others may lead out of the file or round in circles.
fn collect(group: &Group, prefix: &str, depth: usize, header: &mut Header) -> hdf5_metno::Result<()> {
    let mut names = Vec::new();
    group.iter_visit_default(|name, info| {
        if info.link_type == LinkType::Hard {
            names.push(name.to_owned());
        }
        Ok(())
    })?;
    for name in names {
        if header.variables.len() >= MOST_DATASETS {
            return Ok(());
        }
        let path = if prefix.is_empty() { name.clone() } else { format!("{prefix}/{name}") };
        if let Ok(dataset) = group.dataset(&name) {
            let named = dataset.shape().into_iter().enumerate().map(|(place, len)| Dimension { name: format!("axis {place}"), len });
            let dimensions = named.map(|dimension| header.dimension(dimension)).collect();
            let number = dataset.dtype().and_then(|t| t.to_descriptor()).map_or(NumberType::Other, |t| number_type(&t));
            header.variables.push(Variable { name: path, number, dimensions, attributes: attributes(&dataset) });
        } else if depth < DEEPEST
            && let Ok(inner) = group.group(&name)
        {
            collect(&inner, &path, depth + 1, header)?;
        }
    }
    Ok(())
}

fn number_type(descriptor: &TypeDescriptor) -> NumberType {
    match descriptor {
        TypeDescriptor::Integer(IntSize::U1) => NumberType::I8,
        TypeDescriptor::Integer(IntSize::U2) => NumberType::I16,
        TypeDescriptor::Integer(IntSize::U4) => NumberType::I32,
        TypeDescriptor::Integer(IntSize::U8) => NumberType::I64,
        TypeDescriptor::Unsigned(IntSize::U1) => NumberType::U8,
        TypeDescriptor::Unsigned(IntSize::U2) => NumberType::U16,
        TypeDescriptor::Unsigned(IntSize::U4) => NumberType::U32,
        TypeDescriptor::Unsigned(IntSize::U8) => NumberType::U64,
        TypeDescriptor::Float(FloatSize::U4) => NumberType::F32,
        TypeDescriptor::Float(FloatSize::U8) => NumberType::F64,
        _ => NumberType::Other,
    }
}

/// Attributes that hold numbers or one text; others say nothing that is needed here.
fn attributes(object: &hdf5_metno::Location) -> Vec<(String, Attribute)> {
    let names = object.attr_names().unwrap_or_default();
    names.into_iter().filter_map(|name| attribute(object, &name).map(|value| (name, value))).collect()
}

fn attribute(object: &hdf5_metno::Location, name: &str) -> Option<Attribute> {
    let attribute = object.attr(name).ok()?;
    if attribute.size() == 0 || attribute.size() > LONGEST_ATTRIBUTE {
        return None;
    }
    let descriptor = attribute.dtype().ok()?.to_descriptor().ok()?;
    let number = number_type(&descriptor);
    if number.is_number() {
        return attribute.read_raw::<f64>().ok().map(|values| Attribute::Numbers(number, values));
    }
    let text = match descriptor {
        TypeDescriptor::FixedAscii(n) if n <= LONGEST_TEXT => attribute.read_raw::<FixedAscii<LONGEST_TEXT>>().ok()?.first()?.to_string(),
        TypeDescriptor::FixedUnicode(n) if n <= LONGEST_TEXT => {
            attribute.read_raw::<FixedUnicode<LONGEST_TEXT>>().ok()?.first()?.to_string()
        }
        TypeDescriptor::VarLenAscii => attribute.read_raw::<VarLenAscii>().ok()?.first()?.to_string(),
        TypeDescriptor::VarLenUnicode => attribute.read_raw::<VarLenUnicode>().ok()?.first()?.to_string(),
        _ => return None,
    };
    Some(Attribute::Text(text))
}
