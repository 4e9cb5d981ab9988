//! NetCDF-4 through libnetcdf.

use super::guard::{guarded, open_guarded};
use super::messages::{Attribute, Dimension, FormatError, Listing, NumberType, Variable};
use super::store::Store;
use netcdf::AttributeValue;
use netcdf::types::{FloatType, IntType, NcVariableType};
use std::path::PathBuf;

/// An open NetCDF-4 file.
pub struct NetCdf4Store {
    file: netcdf::File,
    path: PathBuf,
}

impl NetCdf4Store {
    /// Opens the file of an empty listing and fills the listing. `None` if it is HDF5 without the structure of NetCDF.
    pub fn open(mut listing: Listing) -> Result<Option<(Listing, Self)>, FormatError> {
        let path = listing.path.clone();
        // The binding panics on names that are not UTF-8 and on types that it does not know.
        let file = open_guarded(&path, "its header holds names or types that are not understood", || {
            let file = netcdf::open(&path)?;
            list(&file, &mut listing)?;
            Ok::<_, netcdf::Error>(file)
        })?;
        // libnetcdf invents dimensions for HDF5 files that have none.
        let invented = |d: &Dimension| d.name.starts_with("phony_dim_");
        if listing.variables.is_empty() || listing.dimensions.iter().all(invented) {
            return Ok(None);
        }
        Ok(Some((listing, Self { file, path })))
    }
}

impl Store for NetCdf4Store {
    fn read(&self, _: usize, variable: &Variable, start: &[usize], count: &[usize], out: &mut Vec<f64>) -> Result<(), String> {
        let total: usize = count.iter().product();
        let read = guarded(&self.path, || {
            let number = variable.number;
            let variable = self.file.variable(&variable.name).ok_or("it is gone")?;
            if number == NumberType::Text {
                // The library does not convert characters to numbers.
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
        });
        read.unwrap_or_else(|| Err("the NetCDF library failed".into()))
    }
}

fn list(file: &netcdf::File, listing: &mut Listing) -> Result<(), netcdf::Error> {
    listing.attributes = attributes(file.attributes());
    for variable in file.variables() {
        let mut dimensions = Vec::new();
        for dimension in variable.dimensions() {
            dimensions.push(listing.dimension(Dimension { name: dimension.name(), len: dimension.len() }));
        }
        let attributes = attributes(variable.attributes());
        let number = match variable.vartype() {
            NcVariableType::Int(IntType::I8) => NumberType::Int8,
            NcVariableType::Int(IntType::U8) => NumberType::Uint8,
            NcVariableType::Int(IntType::I16) => NumberType::Int16,
            NcVariableType::Int(IntType::U16) => NumberType::Uint16,
            NcVariableType::Int(IntType::I32) => NumberType::Int32,
            NcVariableType::Int(IntType::U32) => NumberType::Uint32,
            NcVariableType::Int(IntType::I64) => NumberType::Int64,
            NcVariableType::Int(IntType::U64) => NumberType::Uint64,
            NcVariableType::Float(FloatType::F32) => NumberType::Float32,
            NcVariableType::Float(FloatType::F64) => NumberType::Float64,
            NcVariableType::Char => NumberType::Text,
            _ => NumberType::Other,
        };
        listing.variables.push(Variable { name: variable.name(), number, dimensions, attributes });
    }
    Ok(())
}

fn attributes<'a>(found: impl Iterator<Item = netcdf::Attribute<'a>>) -> Vec<(String, Attribute)> {
    // Attributes of user-defined types are not needed.
    found.filter_map(|a| a.value().ok().map(|value| (a.name().to_owned(), convert(value)))).collect()
}

fn convert(value: AttributeValue) -> Attribute {
    macro_rules! convert {
        ($($one:ident $many:ident $number:ident),*) => {
            match value {
                AttributeValue::Str(text) => Attribute::Text(text),
                AttributeValue::Strs(texts) => Attribute::Text(texts.join(" ")),
                $(AttributeValue::$one(v) => Attribute::Numbers(NumberType::$number, vec![v as f64]),
                AttributeValue::$many(v) => Attribute::Numbers(NumberType::$number, v.into_iter().map(|v| v as f64).collect()),)*
            }
        };
    }
    convert!(
        Uchar Uchars Uint8, Schar Schars Int8, Ushort Ushorts Uint16, Short Shorts Int16, Uint Uints Uint32, Int Ints Int32,
        Ulonglong Ulonglongs Uint64, Longlong Longlongs Int64, Float Floats Float32, Double Doubles Float64
    )
}
