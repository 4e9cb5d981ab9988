//! Archives of the standard turbulence in the layouts of common models, so that a replay runs anywhere and has a known result.

use crate::archive_settings::{SyntheticSettings, SyntheticShape};
use crate::cf::coordinate::Kind;
use crate::error::SourceError;
use crate::formats::{Attribute, Listing, NewVariable, NumberType, Values, write_hdf5, write_netcdf};
use crate::grids::{AxisPlan, Quantity, VelocityScale, to_heights};
use ridgewatch_base::folder::Folder;
use ridgewatch_base::progress::Work;
use ridgewatch_base::setting::word;
use ridgewatch_field::turbulence::Turbulence;
use ridgewatch_field::{Axis, AxisFault, EARTH_RADIUS};
use std::error::Error;
use std::os::fd::AsRawFd;
use std::path::{Path, PathBuf};

/// Seconds between snapshots of the longitude-latitude shapes.
const DAY: f64 = 86_400.0;
/// The pressure levels of ERA5, hPa.
const ERA5_LEVELS: [f64; 37] = [
    1.0, 2.0, 3.0, 5.0, 7.0, 10.0, 20.0, 30.0, 50.0, 70.0, 100.0, 125.0, 150.0, 175.0, 200.0, 225.0, 250.0, 300.0, 350.0, 400.0, 450.0,
    500.0, 550.0, 600.0, 650.0, 700.0, 750.0, 775.0, 800.0, 825.0, 850.0, 875.0, 900.0, 925.0, 950.0, 975.0, 1000.0,
];
/// Largest number of nodes and of snapshots of an archive: a larger one is more likely a typing error.
const MAX_NODES: usize = 1 << 28;
const MAX_SNAPSHOTS: usize = 100_000;

/// Turbulence on the sphere: the standard turbulence in a cube around the globe, evaluated on its surface. The horizontal velocity is
/// the part along the surface. The vertical velocity is the part across it, and fades at the lowest and the highest level, so that
/// nothing leaves.
#[derive(Debug, Clone)]
pub struct GlobeTurbulence {
    turbulence: Turbulence,
    /// Cells along the cube's edge, which is the globe's diameter.
    edge: f64,
    /// Heights of the lowest and the highest level, metres.
    heights: [f64; 2],
    /// Seconds between snapshots.
    interval: f64,
}

/// Attribute of a file that names the origin of its data (CF conventions).
const SOURCE: &str = "source";
/// Prefix of that attribute in files that are written here.
const WRITTEN_HERE: &str = "ridgewatch: ";

/// Origin of the velocities that a file written here declares; `None` for other files.
pub fn declared(listing: &Listing) -> Option<&str> {
    match listing.attribute(SOURCE) {
        Some(Attribute::Text(text)) => text.trim().strip_prefix(WRITTEN_HERE),
        _ => None,
    }
}

fn turbulence(settings: &SyntheticSettings, nodes: [usize; 3]) -> Turbulence {
    Turbulence::new(nodes, settings.modes, settings.k_max, settings.amplitude, settings.seed)
}

/// Shift of the cube from the lowest to the highest level, as a share of its edge, so that levels differ.
const SHIFT: f64 = 0.15;

impl GlobeTurbulence {
    /// `heights` are those of the lowest and the highest level, in metres.
    pub fn new(settings: &SyntheticSettings, heights: [f64; 2]) -> Self {
        let edge = settings.nodes[1];
        Self { turbulence: turbulence(settings, [edge; 3]), edge: edge as f64, heights, interval: DAY }
    }

    /// Geocentric horizontal velocity (m/s) and vertical velocity (m/s) at a unit vector, a height in metres and a time in snapshots.
    pub fn velocity(&self, p: [f64; 3], z: f64, time: f64) -> ([f64; 3], f64) {
        let share = ((z - self.heights[0]) / (self.heights[1] - self.heights[0])).clamp(0.0, 1.0);
        let place = p.map(|x| (0.5 + 0.5 * x + SHIFT * share) * self.edge);
        let v = self.turbulence.velocity(place, time);
        let radial: f64 = (0..3).map(|i| v[i] * p[i]).sum();
        let metres = 2.0 * EARTH_RADIUS / self.edge / self.interval;
        // One cell of the cube is as large a share of the levels as of the globe's radius.
        let upward = (self.heights[1] - self.heights[0]) * 2.0 / self.edge / self.interval;
        (std::array::from_fn(|i| (v[i] - radial * p[i]) * metres), radial * upward * (share * std::f64::consts::PI).sin())
    }
}

/// The folder of an archive, which is written unless it exists.
///
/// # Errors
/// Settings out of range; a file that cannot be written.
pub fn synthesized(settings: &SyntheticSettings) -> Result<PathBuf, SourceError> {
    let [nx, ny, nz] = settings.nodes;
    let shape = word(settings.shape);
    let name = format!(
        "{shape}_{nx}x{ny}x{nz}_{}_modes{}_k{}_a{}_seed{}",
        settings.snapshots, settings.modes, settings.k_max, settings.amplitude, settings.seed
    );
    let folder = settings.folder.join(name);
    if folder.is_dir() {
        return Ok(folder);
    }
    let failed = |e: std::io::Error| SourceError::write(&settings.folder, e);
    std::fs::create_dir_all(&settings.folder).map_err(failed)?;
    // A folder of this name is always a complete archive, even if writing is interrupted or another process writes it too.
    let unfinished = tempfile::Builder::new().prefix(".unfinished").tempdir_in(&settings.folder).map_err(failed)?;
    synthesize(settings, unfinished.path())?;
    match std::fs::rename(unfinished.path(), &folder) {
        Ok(()) => drop(unfinished.keep()),
        Err(_) if folder.is_dir() => {}
        Err(e) => return Err(failed(e)),
    }
    Ok(folder)
}

/// Writes an archive into an existing folder. Returns its files. Links of their names are replaced, not followed.
///
/// # Errors
/// Settings out of range; a folder into which other users may write; a file that cannot be written.
pub fn synthesize(settings: &SyntheticSettings, folder: &Path) -> Result<Vec<PathBuf>, SourceError> {
    let fault = |key, found: String, accepted: &str| Err(SourceError::setting(key, found, accepted));
    let nodes = settings.nodes.iter().try_fold(1usize, |n, &k| n.checked_mul(k)).unwrap_or(usize::MAX);
    if settings.nodes.iter().any(|&n| n < 4) || nodes > MAX_NODES {
        return fault("synthetic.nodes", format!("{:?}", settings.nodes), "three numbers from 4 on, with a product up to 268435456");
    }
    if !(2..=MAX_SNAPSHOTS).contains(&settings.snapshots) {
        return fault("synthetic.snapshots", settings.snapshots.to_string(), "a whole number from 2 to 100000");
    }
    if !(1..=4096).contains(&settings.modes) {
        return fault("synthetic.modes", settings.modes.to_string(), "a whole number from 1 to 4096");
    }
    if !(settings.k_max.is_finite() && settings.k_max > 2.0) {
        return fault("synthetic.k_max", settings.k_max.to_string(), "a number above 2, the smallest wave number");
    }
    if !(settings.amplitude.is_finite() && settings.amplitude > 0.0) {
        return fault("synthetic.amplitude", settings.amplitude.to_string(), "a number above 0");
    }
    let checked = Folder::open(folder).and_then(|opened| opened.check_owner().map(|()| opened));
    let folder = checked.map_err(|error| SourceError::write(folder, error))?;
    match settings.shape {
        SyntheticShape::Flame => flame(settings, &folder),
        SyntheticShape::Ecmwf | SyntheticShape::Globe => ecmwf(settings, &folder),
    }
}

/// Writes a file through a library that takes a path. Returns the file.
fn write(folder: &Folder, name: &str, by_path: impl FnOnce(&Path) -> Result<(), Box<dyn Error>>) -> Result<PathBuf, SourceError> {
    let path = folder.path().join(name);
    // The path of the open file, so that the library opens this file and no other.
    let written = folder.write_with(name, |file| by_path(Path::new(&format!("/proc/self/fd/{}", file.as_raw_fd()))));
    written.map_err(|error| SourceError::write(&path, error))?;
    Ok(path)
}

fn flame(settings: &SyntheticSettings, folder: &Folder) -> Result<Vec<PathBuf>, SourceError> {
    let [nx, ny, nz] = settings.nodes;
    let grid = Turbulence::grid(settings.nodes).map_err(|fault| SourceError::file(folder.path(), fault))?;
    let turbulence = turbulence(settings, settings.nodes);
    let what = format!("{WRITTEN_HERE}{}", settings.described());
    let mut files = Vec::new();
    let work = Work::begin("writing the archive");
    for index in 0..settings.snapshots {
        work.reached(index, settings.snapshots);
        let snapshot = turbulence.snapshot(index as f64, &grid);
        let dataset = |name, dimensions, values| NewVariable { name, dimensions, attributes: Vec::new(), values };
        let mut datasets = Vec::new();
        for (c, name) in ["u", "v", "w"].into_iter().enumerate() {
            let values = Values::Float32(snapshot.nodes.iter().map(|n| n[c]).collect());
            datasets.push(dataset(name, vec![("z", nz), ("y", ny), ("x", nx)], values));
        }
        for (axis, name) in grid.axes.iter().zip(["x", "y", "z"]) {
            datasets.push(dataset(name, vec![(name, axis.len())], Values::Float64(axis.coordinates().to_vec())));
        }
        let hdf5 = |path: &Path| write_hdf5(path, ("time", index as f64), (SOURCE, what.as_str()), datasets);
        files.push(write(folder, &format!("flame_{index:04}.h5"), hdf5)?);
    }
    Ok(files)
}

/// Longitudes, latitudes and pressures (Pa), ascending, as the reader has them.
fn globe_axes(nodes: [usize; 3]) -> Result<[AxisPlan; 3], AxisFault> {
    let [nx, ny, nz] = nodes;
    let levels: Vec<f64> = if nz == ERA5_LEVELS.len() {
        ERA5_LEVELS.map(|p| p * 100.0).to_vec()
    } else {
        // Evenly in the logarithm from 10 hPa to 1000 hPa, in whole Pa.
        (0..nz).map(|k| (1e3 * 100f64.powf(k as f64 / (nz - 1) as f64)).round()).collect()
    };
    let longitude = Axis::uniform("longitude", "degrees_east", 0.0, 360.0 * (nx - 1) as f64 / nx as f64, nx)?.with_period(360.0);
    let latitude = Axis::uniform("latitude", "degrees_north", -90.0, 90.0, ny)?;
    Ok([
        AxisPlan::made(Kind::Longitude, longitude, Quantity::Angle),
        AxisPlan::made(Kind::Latitude, latitude, Quantity::Angle),
        AxisPlan::made(Kind::Level, Axis::new("level", "Pa", levels)?, Quantity::Pressure),
    ])
}

fn ecmwf(settings: &SyntheticSettings, folder: &Folder) -> Result<Vec<PathBuf>, SourceError> {
    let fault = |fault| SourceError::file(folder.path(), fault);
    let axes = globe_axes(settings.nodes).map_err(fault)?;
    let (level, factors) = to_heights(axes[2].clone(), 1.0).map_err(fault)?;
    let [nx, ny, nz] = settings.nodes;
    let globe = GlobeTurbulence::new(settings, [level.axis.first(), level.axis.last()]);
    let grid = Turbulence::grid(settings.nodes).map_err(fault)?;
    let turbulence = turbulence(settings, settings.nodes);
    let what = format!("{WRITTEN_HERE}{}", settings.described());
    let attributes = [("Conventions", "CF-1.6"), (SOURCE, what.as_str())];
    let coordinates: [&[f64]; 3] = std::array::from_fn(|k| axes[k].axis.coordinates());
    let mut files = Vec::new();
    let work = Work::begin("writing the archive");
    for index in 0..settings.snapshots {
        work.reached(index, settings.snapshots);
        let time = index as f64;
        let mut components: Vec<Vec<f32>> = match settings.shape {
            SyntheticShape::Globe => {
                // Levels descend in height.
                let mut out: Vec<Vec<f32>> = (0..3).map(|_| Vec::with_capacity(nx * ny * nz)).collect();
                for k in 0..nz {
                    for latitude in coordinates[1] {
                        for longitude in coordinates[0] {
                            let ((sin_lon, cos_lon), (sin_lat, cos_lat)) =
                                (longitude.to_radians().sin_cos(), latitude.to_radians().sin_cos());
                            let p = [cos_lat * cos_lon, cos_lat * sin_lon, sin_lat];
                            let (v, w) = globe.velocity(p, level.axis.coordinates()[nz - 1 - k], time);
                            out[0].push((-sin_lon * v[0] + cos_lon * v[1]) as f32);
                            out[1].push((-sin_lat * (cos_lon * v[0] + sin_lon * v[1]) + cos_lat * v[2]) as f32);
                            // Heights descend along ascending pressures.
                            out[2].push((w / factors[nz - 1 - k]) as f32);
                        }
                    }
                }
                out
            }
            _ => {
                let snapshot = turbulence.snapshot(time, &grid);
                let mut out: Vec<Vec<f32>> = (0..3).map(|c| snapshot.nodes.iter().map(|n| n[c]).collect()).collect();
                // From cells an interval to m/s and Pa/s.
                VelocityScale::to_cells(&axes).inverse().apply(&mut out, [nx, ny, nz], 1.0 / DAY);
                out
            }
        };
        // Latitudes descend in most ECMWF files.
        for component in &mut components {
            for plane in component.chunks_exact_mut(nx * ny) {
                for j in 0..ny / 2 {
                    let (low, high) = plane.split_at_mut((ny - 1 - j) * nx);
                    low[j * nx..(j + 1) * nx].swap_with_slice(&mut high[..nx]);
                }
            }
        }
        let variables = ecmwf_variables(&coordinates, &components, time * 24.0);
        files.push(write(folder, &format!("ecmwf_{index:04}.nc"), |path| write_netcdf(path, &attributes, &variables))?);
    }
    Ok(files)
}

/// The variables of a NetCDF file, velocities packed to 16 bits. Latitudes descend.
fn ecmwf_variables(coordinates: &[&[f64]; 3], components: &[Vec<f32>], hours: f64) -> Vec<NewVariable<'static>> {
    let text = |name, text: &str| (name, Attribute::Text(text.into()));
    let number = |name, value: f64| (name, Attribute::Numbers(NumberType::Float64, vec![value]));
    let names = ["longitude", "latitude", "level"];
    let in_file = [
        coordinates[0].to_vec(),
        coordinates[1].iter().rev().copied().collect(),
        coordinates[2].iter().map(|p| p / 100.0).collect::<Vec<f64>>(),
    ];
    let mut variables = Vec::new();
    for ((name, units), values) in names.into_iter().zip(["degrees_east", "degrees_north", "hPa"]).zip(in_file) {
        let (dimensions, attributes) = (vec![(name, values.len())], vec![text("units", units)]);
        variables.push(NewVariable { name, dimensions, attributes, values: Values::Float64(values) });
    }
    variables.push(NewVariable {
        name: "time",
        dimensions: vec![("time", 1)],
        attributes: vec![text("units", "hours since 2000-01-01 00:00:00"), text("calendar", "gregorian")],
        values: Values::Float64(vec![hours]),
    });
    let described =
        [("u", "eastward_wind", "m s**-1"), ("v", "northward_wind", "m s**-1"), ("w", "lagrangian_tendency_of_air_pressure", "Pa s**-1")];
    for ((name, standard, units), values) in described.into_iter().zip(components) {
        let (low, high) = values.iter().fold((f64::INFINITY, f64::NEG_INFINITY), |(a, b), &v| (a.min(f64::from(v)), b.max(f64::from(v))));
        // 65534 steps from the least to the greatest value; the lowest number is the fill value.
        let (scale, offset) = (((high - low) / 65_532.0).max(f64::MIN_POSITIVE), (low + high) / 2.0);
        let mut dimensions = vec![("time", 1)];
        dimensions.extend((0..3).rev().map(|k| (names[k], coordinates[k].len())));
        variables.push(NewVariable {
            name,
            dimensions,
            attributes: vec![
                text("standard_name", standard),
                text("units", units),
                number("scale_factor", scale),
                number("add_offset", offset),
                ("_FillValue", Attribute::Numbers(NumberType::Int16, vec![-32_767.0])),
            ],
            values: Values::Int16(values.iter().map(|&v| ((f64::from(v) - offset) / scale).round() as i16).collect()),
        });
    }
    variables
}
