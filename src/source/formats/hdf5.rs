//! HDF5 without the structure of NetCDF, through libhdf5. Calls of libnetcdf take the same lock: one thread at a time uses either
//! library.

use super::guard::{guarded, open_guarded};
use super::limits::{Limits, MAX_DEPTH, MAX_OBJECTS};
use super::messages::{Attribute, Dimension, FormatError, Listing, NumberType, Variable};
use super::scan::{Chunks, look_at};
use super::store::Store;
use hdf5_metno::types::{FixedAscii, FixedUnicode, FloatSize, IntSize, TypeDescriptor, VarLenAscii, VarLenUnicode};
use hdf5_metno::{Group, Hyperslab, LinkType, SliceOrIndex};
use ndarray::ArrayD;
use std::collections::HashSet;
use std::path::PathBuf;

/// Values of an attribute that are read.
const MAX_ATTRIBUTE: usize = 4096;
/// Characters of a text attribute that are read.
const MAX_TEXT: usize = 1024;

/// An open HDF5 file.
pub struct Hdf5Store {
    file: hdf5_metno::File,
    path: PathBuf,
}

impl Hdf5Store {
    /// Opens the file of an empty listing and fills the listing. Datasets become variables, named by their path without the leading
    /// `/`. Their axes become dimensions, shared by axes of one place and length.
    pub fn open(mut listing: Listing, limits: &Limits) -> Result<(Listing, Self), FormatError> {
        let path = listing.path.clone();
        let file = open_guarded(&path, "the HDF5 library failed on it", || -> hdf5_metno::Result<_> {
            let file = hdf5_metno::File::open(&path)?;
            listing.attributes = attributes(&file);
            collect(&file, "", 0, limits.external, &mut listing)?;
            Ok(file)
        })?;
        Ok((listing, Self { file, path }))
    }

    /// Opens the file of an empty listing, which is expected to resemble another: only the variables of `expected` are looked up,
    /// by name, and their dimensions are assumed to have the same names. Also returns the bytes of their chunks. `None` if something differs.
    pub fn open_expected(mut listing: Listing, expected: &Listing, limits: &Limits) -> Option<(Listing, Self, Chunks)> {
        let path = listing.path.clone();
        let mut chunks = Chunks::new();
        let mut open = || {
            let file = hdf5_metno::File::open(&path).ok()?;
            // Whatever is unusual is left to the scan of the whole file: a link may leave the file, and it may hold too much.
            let mut own = HashSet::new();
            if file.len() > MAX_OBJECTS as u64 {
                return None;
            }
            file.iter_visit_default(|name, info| {
                if info.link_type == LinkType::Hard {
                    own.insert(name.to_owned());
                }
                Ok(())
            })
            .ok()?;
            for wanted in &expected.variables {
                let dataset = own.contains(&wanted.name).then(|| file.dataset(&wanted.name).ok()).flatten()?;
                if dataset.loc_info().ok()?.num_attrs > MAX_ATTRIBUTE {
                    return None;
                }
                chunks.insert(wanted.name.clone(), look_at(&dataset, &wanted.name, limits).ok()?.ok()?);
                let shape = dataset.shape();
                let number = number_type(&dataset.dtype().ok()?.to_descriptor().ok()?);
                if shape.len() != wanted.dimensions.len() || number != wanted.number {
                    return None;
                }
                let name = |d: usize| expected.dimensions[d].name.clone();
                let named = wanted.dimensions.iter().zip(shape).map(|(&d, len)| Dimension { name: name(d), len });
                let dimensions = named.map(|dimension| listing.dimension(dimension)).collect();
                listing.variables.push(Variable { name: wanted.name.clone(), number, dimensions, attributes: attributes(&dataset) });
            }
            Some(file)
        };
        let file = open_guarded(&path, "", || open().ok_or("it differs")).ok()?;
        Some((listing, Self { file, path }, chunks))
    }
}

impl Store for Hdf5Store {
    fn read(&self, _: usize, variable: &Variable, start: &[usize], count: &[usize], out: &mut Vec<f64>) -> Result<(), String> {
        let read = guarded(&self.path, || -> hdf5_metno::Result<()> {
            let dataset = self.file.dataset(&variable.name)?;
            if count.is_empty() {
                out.push(dataset.read_scalar::<f64>()?);
                return Ok(());
            }
            let slices: Vec<SliceOrIndex> = start.iter().zip(count).map(|(&s, &c)| SliceOrIndex::from(s..s + c)).collect();
            let values: ArrayD<f64> = dataset.read_slice(Hyperslab::from(slices))?;
            out.extend(values.iter());
            Ok(())
        });
        read.ok_or("the HDF5 library failed")?.map_err(|e| e.to_string())
    }
}

/// Lists the datasets of a group and of the groups in it. Follows hard links only, and those to other files where that is allowed:
/// soft ones may form circles. The scan has counted all of them.
fn collect(group: &Group, prefix: &str, depth: usize, external: bool, listing: &mut Listing) -> hdf5_metno::Result<()> {
    let mut names = Vec::new();
    group.iter_visit_default(|name, info| {
        if info.link_type == LinkType::Hard || (external && info.link_type == LinkType::External) {
            names.push(name.to_owned());
        }
        Ok(())
    })?;
    for name in names {
        if listing.variables.len() >= MAX_OBJECTS {
            return Ok(());
        }
        let path = if prefix.is_empty() { name.clone() } else { format!("{prefix}/{name}") };
        if let Ok(dataset) = group.dataset(&name) {
            let named = dataset.shape().into_iter().enumerate().map(|(place, len)| Dimension { name: format!("axis {place}"), len });
            let dimensions = named.map(|dimension| listing.dimension(dimension)).collect();
            let number = dataset.dtype().and_then(|t| t.to_descriptor()).map_or(NumberType::Other, |t| number_type(&t));
            listing.variables.push(Variable { name: path, number, dimensions, attributes: attributes(&dataset) });
        } else if depth < MAX_DEPTH
            && let Ok(inner) = group.group(&name)
        {
            collect(&inner, &path, depth + 1, external, listing)?;
        }
    }
    Ok(())
}

fn number_type(descriptor: &TypeDescriptor) -> NumberType {
    match descriptor {
        TypeDescriptor::Integer(IntSize::U1) => NumberType::Int8,
        TypeDescriptor::Integer(IntSize::U2) => NumberType::Int16,
        TypeDescriptor::Integer(IntSize::U4) => NumberType::Int32,
        TypeDescriptor::Integer(IntSize::U8) => NumberType::Int64,
        TypeDescriptor::Unsigned(IntSize::U1) => NumberType::Uint8,
        TypeDescriptor::Unsigned(IntSize::U2) => NumberType::Uint16,
        TypeDescriptor::Unsigned(IntSize::U4) => NumberType::Uint32,
        TypeDescriptor::Unsigned(IntSize::U8) => NumberType::Uint64,
        TypeDescriptor::Float(FloatSize::U4) => NumberType::Float32,
        TypeDescriptor::Float(FloatSize::U8) => NumberType::Float64,
        _ => NumberType::Other,
    }
}

/// Attributes that hold numbers or one text; others are not needed.
fn attributes(object: &hdf5_metno::Location) -> Vec<(String, Attribute)> {
    let names = object.attr_names().unwrap_or_default();
    names.into_iter().filter_map(|name| attribute(object, &name).map(|value| (name, value))).collect()
}

fn attribute(object: &hdf5_metno::Location, name: &str) -> Option<Attribute> {
    let attribute = object.attr(name).ok()?;
    if attribute.size() == 0 || attribute.size() > MAX_ATTRIBUTE {
        return None;
    }
    let descriptor = attribute.dtype().ok()?.to_descriptor().ok()?;
    let number = number_type(&descriptor);
    if number.is_number() {
        return attribute.read_raw::<f64>().ok().map(|values| Attribute::Numbers(number, values));
    }
    let text = match descriptor {
        TypeDescriptor::FixedAscii(n) if n <= MAX_TEXT => attribute.read_raw::<FixedAscii<MAX_TEXT>>().ok()?.first()?.to_string(),
        TypeDescriptor::FixedUnicode(n) if n <= MAX_TEXT => attribute.read_raw::<FixedUnicode<MAX_TEXT>>().ok()?.first()?.to_string(),
        TypeDescriptor::VarLenAscii => attribute.read_raw::<VarLenAscii>().ok()?.first()?.to_string(),
        TypeDescriptor::VarLenUnicode => attribute.read_raw::<VarLenUnicode>().ok()?.first()?.to_string(),
        _ => return None,
    };
    Some(Attribute::Text(text))
}
