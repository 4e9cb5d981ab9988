//! Writes files: NetCDF with 64-bit offsets, and HDF5.

use super::guard::silence;
use super::messages::{Attribute, NumberType};
use ndarray::ArrayD;
use std::error::Error;
use std::path::Path;

/// Values of a variable, by external type.
pub enum Values {
    Int16(Vec<i16>),
    Float32(Vec<f32>),
    Float64(Vec<f64>),
}

/// A variable to be written.
pub struct NewVariable<'a> {
    pub name: &'a str,
    /// Names and lengths, slowest first.
    pub dimensions: Vec<(&'a str, usize)>,
    /// NetCDF only.
    pub attributes: Vec<(&'a str, Attribute)>,
    pub values: Values,
}

/// Writes a NetCDF file. One of the variables must have all dimensions of the others.
///
/// # Errors
/// Those of the library.
pub fn write_netcdf(path: &Path, attributes: &[(&str, &str)], variables: &[NewVariable]) -> Result<(), Box<dyn Error>> {
    silence();
    let mut file = netcdf::create_with(path, netcdf::Options::_64BIT_OFFSET)?;
    for (name, text) in attributes {
        file.add_attribute(name, *text)?;
    }
    // The variable with the most dimensions has them all.
    let widest = variables.iter().max_by_key(|v| v.dimensions.len());
    for (name, len) in widest.iter().flat_map(|v| &v.dimensions) {
        file.add_dimension(name, *len)?;
    }
    for new in variables {
        let names: Vec<&str> = new.dimensions.iter().map(|d| d.0).collect();
        let mut variable = match new.values {
            Values::Int16(_) => file.add_variable::<i16>(new.name, &names)?,
            Values::Float32(_) => file.add_variable::<f32>(new.name, &names)?,
            Values::Float64(_) => file.add_variable::<f64>(new.name, &names)?,
        };
        for (name, value) in &new.attributes {
            match value {
                Attribute::Text(text) => variable.put_attribute(name, text.as_str())?,
                Attribute::Numbers(NumberType::Int16, values) => variable.put_attribute(name, values[0] as i16)?,
                Attribute::Numbers(_, values) => variable.put_attribute(name, values[0])?,
            };
        }
    }
    file.enddef()?;
    for new in variables {
        let mut variable = file.variable_mut(new.name).ok_or("a variable is gone")?;
        match &new.values {
            Values::Int16(values) => variable.put_values(values, ..)?,
            Values::Float32(values) => variable.put_values(values, ..)?,
            Values::Float64(values) => variable.put_values(values, ..)?,
        }
    }
    Ok(file.close()?)
}

/// Writes an HDF5 file whose attributes are one number and one text.
///
/// # Errors
/// Those of the library.
pub fn write_hdf5(path: &Path, number: (&str, f64), text: (&str, &str), variables: Vec<NewVariable>) -> Result<(), Box<dyn Error>> {
    silence();
    let file = hdf5_metno::File::create(path)?;
    for NewVariable { name, dimensions, values, .. } in variables {
        let shape: Vec<usize> = dimensions.iter().map(|d| d.1).collect();
        let dataset = file.new_dataset_builder();
        match values {
            Values::Int16(values) => dataset.with_data(&ArrayD::from_shape_vec(shape, values)?).create(name)?,
            Values::Float32(values) => dataset.with_data(&ArrayD::from_shape_vec(shape, values)?).create(name)?,
            Values::Float64(values) => dataset.with_data(&ArrayD::from_shape_vec(shape, values)?).create(name)?,
        };
    }
    file.new_attr::<f64>().create(number.0)?.write_scalar(&number.1)?;
    let value: hdf5_metno::types::VarLenUnicode = text.1.parse()?;
    file.new_attr::<hdf5_metno::types::VarLenUnicode>().create(text.0)?.write_scalar(&value)?;
    Ok(())
}
