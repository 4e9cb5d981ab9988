//! Small NetCDF files, written by libnetcdf.

use netcdf::types::NcVariableType;
use netcdf::{AttributeValue, NcTypeDescriptor, Options};
use ridgewatch::field::Snapshot;
use std::path::{Path, PathBuf};

#[derive(Clone)]
pub enum Data {
    F32(Vec<f32>),
    F64(Vec<f64>),
    I16(Vec<i16>),
    /// Bytes of characters.
    Text(String),
}

/// NC_CHAR.
#[repr(transparent)]
#[derive(Clone, Copy)]
struct Character(u8);

// SAFETY: a byte has the layout of NC_CHAR.
unsafe impl NcTypeDescriptor for Character {
    fn type_descriptor() -> NcVariableType {
        NcVariableType::Char
    }
}

pub struct Variable {
    name: String,
    dimensions: Vec<String>,
    data: Data,
    attributes: Vec<(String, AttributeValue)>,
    deflated: bool,
}

/// A file to be written.
pub struct Fixture {
    format: Format,
    dimensions: Vec<(String, usize)>,
    pub variables: Vec<Variable>,
    attributes: Vec<(String, AttributeValue)>,
}

#[derive(Clone, Copy, PartialEq)]
pub enum Format {
    Classic,
    Offset64,
    Data64,
    NetCdf4,
}
pub use Format::{Classic as CLASSIC, Data64 as DATA_64, NetCdf4 as NETCDF4, Offset64 as OFFSET_64};

impl Fixture {
    /// A dimension of length 0 is the record dimension.
    pub fn new(format: Format, dimensions: &[(&str, usize)]) -> Self {
        Self { format, dimensions: dimensions.iter().map(|(n, l)| (n.to_string(), *l)).collect(), variables: vec![], attributes: vec![] }
    }

    /// A file of these axes: names, units and coordinates. The first axis becomes the last variable.
    pub fn on(format: Format, axes: &[(&str, &str, &[f64])]) -> Self {
        let dimensions: Vec<(&str, usize)> = axes.iter().map(|(name, _, values)| (*name, values.len())).collect();
        axes.iter().rev().fold(Self::new(format, &dimensions), |file, (name, units, values)| file.axis(name, units, values))
    }

    pub fn dimension(mut self, name: &str, len: usize) -> Self {
        self.dimensions.push((name.into(), len));
        self
    }

    /// Adds an attribute to the file.
    pub fn attribute(mut self, name: &str, value: impl Into<AttributeValue>) -> Self {
        self.attributes.push((name.into(), value.into()));
        self
    }

    pub fn variable(mut self, name: &str, dimensions: &[&str], data: Data) -> Self {
        let dimensions = dimensions.iter().map(|d| d.to_string()).collect();
        self.variables.push(Variable { name: name.into(), dimensions, data, attributes: vec![], deflated: false });
        self
    }

    /// Adds an attribute to the last variable.
    pub fn with(mut self, name: &str, value: impl Into<AttributeValue>) -> Self {
        self.variables.last_mut().unwrap().attributes.push((name.into(), value.into()));
        self
    }

    /// Compresses the last variable if the format can.
    pub fn deflated(mut self) -> Self {
        self.variables.last_mut().unwrap().deflated = true;
        self
    }

    /// Adds variables of one unit on all dimensions.
    pub fn fields<'a>(self, units: &str, fields: impl IntoIterator<Item = (&'a str, Data)>) -> Self {
        let dimensions: Vec<String> = self.dimensions.iter().map(|(name, _)| name.clone()).collect();
        let dimensions: Vec<&str> = dimensions.iter().map(String::as_str).collect();
        fields.into_iter().fold(self, |file, (name, data)| {
            let file = file.variable(name, &dimensions, data);
            if units.is_empty() { file } else { file.with("units", units) }
        })
    }

    /// Adds `u` and `v` in m/s on all dimensions.
    pub fn winds(self, u: Data, v: Data) -> Self {
        self.fields("m/s", [("u", u), ("v", v)])
    }

    /// Adds a coordinate variable named like its dimension.
    pub fn axis(self, name: &str, units: &str, values: &[f64]) -> Self {
        let this = self.variable(name, &[name], Data::F64(values.to_vec()));
        if units.is_empty() { this } else { this.with("units", units) }
    }

    pub fn write(&self, path: &Path) -> PathBuf {
        // In each thread, libhdf5 prints errors that libnetcdf expects.
        hdf5_metno::silence_errors(true);
        let options = match self.format {
            Format::Classic => Options::empty(),
            Format::Offset64 => Options::_64BIT_OFFSET,
            Format::Data64 => Options::_64BIT_DATA,
            Format::NetCdf4 => Options::NETCDF4,
        };
        let mut file = netcdf::create_with(path, options).unwrap();
        for (name, value) in &self.attributes {
            file.add_attribute(name, value.clone()).unwrap();
        }
        for (name, len) in &self.dimensions {
            file.add_dimension(name, *len).unwrap();
        }
        for v in &self.variables {
            let dims: Vec<&str> = v.dimensions.iter().map(String::as_str).collect();
            let mut variable = match v.data {
                Data::F32(_) => file.add_variable::<f32>(&v.name, &dims),
                Data::F64(_) => file.add_variable::<f64>(&v.name, &dims),
                Data::I16(_) => file.add_variable::<i16>(&v.name, &dims),
                Data::Text(_) => file.add_variable_with_type(&v.name, &dims, &NcVariableType::Char),
            }
            .unwrap();
            if v.deflated && self.format == NETCDF4 {
                variable.set_compression(4, true).unwrap();
            }
            for (name, value) in &v.attributes {
                variable.put_attribute(name, value.clone()).unwrap();
            }
        }
        if self.format != NETCDF4 {
            file.enddef().unwrap();
        }
        for v in &self.variables {
            let shape: Vec<usize> = v.dimensions.iter().map(|d| self.dimensions.iter().find(|x| x.0 == *d).unwrap().1).collect();
            let len = match &v.data {
                Data::F32(d) => d.len(),
                Data::F64(d) => d.len(),
                Data::I16(d) => d.len(),
                Data::Text(t) => t.len(),
            };
            let fixed: usize = shape.iter().filter(|&&n| n > 0).product();
            let count: Vec<usize> = shape.iter().map(|&n| if n == 0 { len / fixed } else { n }).collect();
            let start = vec![0; count.len()];
            let mut variable = file.variable_mut(&v.name).unwrap();
            match &v.data {
                Data::F32(d) => variable.put_values(d, (start, count)),
                Data::F64(d) => variable.put_values(d, (start, count)),
                Data::I16(d) => variable.put_values(d, (start, count)),
                Data::Text(t) => variable.put_values(&t.bytes().map(Character).collect::<Vec<_>>(), (start, count)),
            }
            .unwrap();
        }
        file.close().unwrap();
        // A process that another test started in the meantime inherits the file and its lock, until it executes its program.
        let begin = std::time::Instant::now();
        while std::fs::File::open(path).unwrap().try_lock_shared().is_err() {
            assert!(begin.elapsed().as_secs() < 300, "{} stays locked", path.display());
            std::thread::sleep(std::time::Duration::from_millis(10));
        }
        path.to_path_buf()
    }
}

/// Values of `f(t, y, x)` in row-major order.
pub fn fill(nt: usize, ny: usize, nx: usize, f: impl Fn(usize, usize, usize) -> f64) -> Vec<f64> {
    (0..nt * ny * nx).map(|i| f(i / (nx * ny), i / nx % ny, i % nx)).collect()
}

/// Values in single precision.
pub fn f32s(values: Vec<f64>) -> Data {
    Data::F32(values.into_iter().map(|v| v as f32).collect())
}

/// A plane of 4 x 3 nodes in metres with `u = 100 t + 10 y + x` and `v = -u` at node indices, in m/s.
pub fn plane(format: Format, times: &[f64], units: &str) -> Fixture {
    let value = |t: usize, y: usize, x: usize| 100.0 * times[t] + 10.0 * y as f64 + x as f64;
    Fixture::on(format, &[("time", units, times), ("y", "m", &[0.0, 2.0, 4.0]), ("x", "m", &[0.0, 1.0, 2.0, 3.0])])
        .winds(f32s(fill(times.len(), 3, 4, value)), f32s(fill(times.len(), 3, 4, |t, y, x| -value(t, y, x))))
}

/// First component of each node.
pub fn us(snapshot: &Snapshot) -> Vec<f32> {
    snapshot.nodes.iter().map(|n| n[0]).collect()
}

/// Eastward and northward components at node `i` of a snapshot on the sphere.
pub fn east_north(snapshot: &Snapshot, i: usize) -> [f64; 2] {
    let [nx, ny, _] = snapshot.grid.shape();
    let (sin_lon, cos_lon) = snapshot.grid.axes[0].coordinates()[i % nx].to_radians().sin_cos();
    let (sin_lat, cos_lat) = snapshot.grid.axes[1].coordinates()[i / nx % ny].to_radians().sin_cos();
    let [x, y, z, _] = snapshot.nodes[i].map(f64::from);
    [-sin_lon * x + cos_lon * y, -sin_lat * (cos_lon * x + sin_lon * y) + cos_lat * z]
}
