//! NetCDF-4 through libnetcdf.

use super::SourceError;
use super::container::{Attribute, Dimension, Header, NumberType, Variable};
use super::crash::Reading;
use super::hdf5_store::locked;
use netcdf::AttributeValue;
use netcdf::types::{FloatType, IntType, NcVariableType};
use std::cell::Cell;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::{Path, PathBuf};

/// An open NetCDF-4 file.
pub(super) struct NetCdf4Store {
    file: netcdf::File,
    path: PathBuf,
}

impl NetCdf4Store {
    /// Opens a file; none where it is HDF5 without the structure of NetCDF.
    pub(super) fn open(path: &Path) -> Result<Option<(Header, Self)>, SourceError> {
        silence();
        let _reading = Reading::opening(path);
        let damaged = |what: String| SourceError::Damaged { path: path.into(), what };
        // The crate panics on names that are not UTF-8 and on types it does not know; a file must not take the program down.
        let opened = catch_unwind(AssertUnwindSafe(|| -> Result<_, netcdf::Error> {
            let file = netcdf::open(path)?;
            let header = read_header(&file)?;
            Ok((header, file))
        }));
        let (header, file) = match opened {
            Ok(Ok(pair)) => pair,
            Ok(Err(error)) => return Err(locked(path, &error.to_string()).unwrap_or_else(|| damaged(error.to_string()))),
            Err(_) => return Err(damaged("its header holds names or types that are not understood".into())),
        };
        // libnetcdf invents dimensions for HDF5 files that have none.
        let invented = |d: &Dimension| d.name.starts_with("phony_dim_");
        if header.variables.is_empty() || header.dimensions.iter().all(invented) {
            return Ok(None);
        }
        Ok(Some((header, Self { file, path: path.into() })))
    }

    pub(super) fn read(
        &self,
        name: &str,
        number: NumberType,
        start: &[usize],
        count: &[usize],
        total: usize,
        out: &mut Vec<f64>,
    ) -> Result<(), String> {
        silence();
        let _reading = Reading::of(&self.path);
        let read = catch_unwind(AssertUnwindSafe(|| {
            let variable = self.file.variable(name).ok_or("it is gone")?;
            if number == NumberType::Text {
                // The library converts no characters to numbers.
                let bytes = variable.get_raw_values((start, count)).map_err(|e| e.to_string())?;
                out.extend(bytes.into_iter().map(f64::from));
                return if out.len() == total { Ok(()) } else { Err("its text has another length than its header says".into()) };
            }
            out.resize(total, 0.0);
            if count.is_empty() {
                out[0] = variable.get_value::<f64, _>(..).map_err(|e| e.to_string())?;
                return Ok(());
            }
            variable.get_values_into(out, (start, count)).map_err(|e| e.to_string())
        }));
        read.unwrap_or_else(|_| Err("the NetCDF library failed".into()))
    }
}

/// libhdf5 prints its error stack on standard error unless told otherwise, once in each thread, even where libnetcdf only asks
/// whether an attribute is there.
pub(super) fn silence() {
    thread_local!(static SILENCED: Cell<bool> = const { Cell::new(false) });
    if !SILENCED.replace(true) {
        hdf5_metno::silence_errors(true);
    }
}

fn read_header(file: &netcdf::File) -> Result<Header, netcdf::Error> {
    let mut header = Header { attributes: attributes(file.attributes()), ..Header::default() };
    for variable in file.variables() {
        let mut dimensions = Vec::new();
        for dimension in variable.dimensions() {
            dimensions.push(header.dimension(Dimension { name: dimension.name(), len: dimension.len() }));
        }
        let attributes = attributes(variable.attributes());
        let number = match variable.vartype() {
            NcVariableType::Int(IntType::I8) => NumberType::I8,
            NcVariableType::Int(IntType::U8) => NumberType::U8,
            NcVariableType::Int(IntType::I16) => NumberType::I16,
            NcVariableType::Int(IntType::U16) => NumberType::U16,
            NcVariableType::Int(IntType::I32) => NumberType::I32,
            NcVariableType::Int(IntType::U32) => NumberType::U32,
            NcVariableType::Int(IntType::I64) => NumberType::I64,
            NcVariableType::Int(IntType::U64) => NumberType::U64,
            NcVariableType::Float(FloatType::F32) => NumberType::F32,
            NcVariableType::Float(FloatType::F64) => NumberType::F64,
            NcVariableType::Char => NumberType::Text,
            _ => NumberType::Other,
        };
        header.variables.push(Variable { name: variable.name(), number, dimensions, attributes });
    }
    Ok(header)
}

fn attributes<'a>(found: impl Iterator<Item = netcdf::Attribute<'a>>) -> Vec<(String, Attribute)> {
    // An attribute of a user-defined type says nothing that is needed here.
    found.filter_map(|a| a.value().ok().map(|value| (a.name().to_owned(), convert(value)))).collect()
}

fn convert(value: AttributeValue) -> Attribute {
    use AttributeValue as A;
    fn list<T: Copy>(number: NumberType, values: &[T], to: impl Fn(T) -> f64) -> Attribute {
        Attribute::Numbers(number, values.iter().map(|&v| to(v)).collect())
    }
    match value {
        A::Str(text) => Attribute::Text(text),
        A::Strs(texts) => Attribute::Text(texts.join(" ")),
        A::Uchar(v) => list(NumberType::U8, &[v], f64::from),
        A::Uchars(v) => list(NumberType::U8, &v, f64::from),
        A::Schar(v) => list(NumberType::I8, &[v], f64::from),
        A::Schars(v) => list(NumberType::I8, &v, f64::from),
        A::Ushort(v) => list(NumberType::U16, &[v], f64::from),
        A::Ushorts(v) => list(NumberType::U16, &v, f64::from),
        A::Short(v) => list(NumberType::I16, &[v], f64::from),
        A::Shorts(v) => list(NumberType::I16, &v, f64::from),
        A::Uint(v) => list(NumberType::U32, &[v], f64::from),
        A::Uints(v) => list(NumberType::U32, &v, f64::from),
        A::Int(v) => list(NumberType::I32, &[v], f64::from),
        A::Ints(v) => list(NumberType::I32, &v, f64::from),
        A::Ulonglong(v) => list(NumberType::U64, &[v], |v| v as f64),
        A::Ulonglongs(v) => list(NumberType::U64, &v, |v| v as f64),
        A::Longlong(v) => list(NumberType::I64, &[v], |v| v as f64),
        A::Longlongs(v) => list(NumberType::I64, &v, |v| v as f64),
        A::Float(v) => list(NumberType::F32, &[v], f64::from),
        A::Floats(v) => list(NumberType::F32, &v, f64::from),
        A::Double(v) => list(NumberType::F64, &[v], |v| v),
        A::Doubles(v) => list(NumberType::F64, &v, |v| v),
    }
}
