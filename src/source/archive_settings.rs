//! `[archive]` of a scene file.

use crate::error::SourceError;
use crate::formats::Limits;
use ridgewatch_base::memory::gib;
use serde::{Deserialize, Deserializer, Serialize};
use std::collections::BTreeMap;
use std::path::PathBuf;

/// Conversion of coordinates to lengths.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Metric {
    /// Longitude and latitude on the sphere, metres and seconds; levels become heights. Default for longitude-latitude, unless its
    /// levels are neither pressures nor lengths.
    Sphere,
    /// Grid indices, and cells per snapshot interval; time counts snapshots. Default for levels without a unit, and for velocities in
    /// cells.
    Index,
    /// Coordinates are lengths; pressures become heights. Default for everything else. With longitude and latitude, velocities become
    /// degrees per second.
    Cartesian,
}

/// Unit of the velocities.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum VelocityUnit {
    /// The variable's `units`, converted to SI.
    #[default]
    Si,
    /// Cells per snapshot interval, not converted; needs the index metric.
    Cells,
}

/// Grid for components on the faces of cells (Arakawa C).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Staggering {
    /// A grid of faces and centres, twice as fine horizontally: linear interpolation on it is that of each component from its own faces.
    #[default]
    Faces,
    /// Centres only, to which the components are averaged: an eighth of the memory, but smoothed over a cell.
    Centres,
}

/// Layout of an archive of synthetic turbulence.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum SyntheticShape {
    /// Longitude, latitude and pressure levels, packed to 16 bits, CF conventions: one NetCDF file per day. The turbulence is defined on
    /// the grid: its cells are nodes of the archive, for the index metric.
    Ecmwf,
    /// Files as for `ecmwf`, with a turbulence defined on the sphere and smooth over the poles, for the sphere metric.
    Globe,
    /// Three components on (z, y, x) with their coordinates: one HDF5 file per snapshot, as from a direct numerical simulation of a flame.
    Flame,
}

/// `[archive.synthetic]`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SyntheticSettings {
    /// Layout.
    pub shape: SyntheticShape,
    /// Nodes along x, y and z.
    #[serde(default = "SyntheticSettings::nodes")]
    pub nodes: [usize; 3],
    /// Number of snapshots.
    #[serde(default = "SyntheticSettings::snapshots")]
    pub snapshots: usize,
    /// Number of modes of the turbulence.
    #[serde(default = "SyntheticSettings::modes")]
    pub modes: usize,
    /// Largest wave number, cycles per short side.
    #[serde(default = "SyntheticSettings::k_max")]
    pub k_max: f64,
    /// Root mean square speed, cells per snapshot at 192 cells along the short side.
    #[serde(default = "SyntheticSettings::amplitude")]
    pub amplitude: f64,
    /// Seed of the turbulence.
    #[serde(default)]
    pub seed: u64,
    /// Folder that holds a folder for these settings.
    #[serde(default = "SyntheticSettings::folder")]
    pub folder: PathBuf,
}

impl SyntheticSettings {
    fn nodes() -> [usize; 3] {
        [96, 48, 24]
    }
    fn snapshots() -> usize {
        12
    }
    fn modes() -> usize {
        48
    }
    fn k_max() -> f64 {
        14.0
    }
    fn amplitude() -> f64 {
        3.0
    }
    fn folder() -> PathBuf {
        PathBuf::from("out/synthetic")
    }

    /// Description of the velocities.
    pub(super) fn described(&self) -> String {
        ridgewatch_field::turbulence::Turbulence::described(self.modes, self.k_max, self.amplitude, self.seed)
    }

    /// The defaults of a shape.
    pub fn new(shape: SyntheticShape) -> Self {
        Self {
            shape,
            nodes: Self::nodes(),
            snapshots: Self::snapshots(),
            modes: Self::modes(),
            k_max: Self::k_max(),
            amplitude: Self::amplitude(),
            seed: 0,
            folder: Self::folder(),
        }
    }
}

/// Files to read and, if the conventions do not say enough, how to read them.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct ArchiveSettings {
    /// Files, folders, patterns and URLs of Zarr stores: one or a list.
    #[serde(deserialize_with = "one_or_many")]
    pub files: Vec<PathBuf>,
    /// Variable of the velocity along x (eastward).
    pub u: Option<String>,
    /// Variable of the velocity along y (northward).
    pub v: Option<String>,
    /// Variable of the velocity along the level axis; `"none"` ignores vertical motion, `"continuity"` computes it.
    pub w: Option<String>,
    /// Coordinate variable (or dimension) of x.
    pub x: Option<String>,
    /// Coordinate variable (or dimension) of y.
    pub y: Option<String>,
    /// Coordinate variable (or dimension) of the levels, or a field of the heights of their points.
    pub z: Option<String>,
    /// Time variable.
    pub time: Option<String>,
    /// Takes an archive of one time as a steady flow; needs `time.tau`.
    pub steady: bool,
    /// Metric; by default chosen from the axes.
    pub metric: Option<Metric>,
    /// Unit of the velocities.
    pub velocity_unit: VelocityUnit,
    /// Reads only the level at this coordinate, in the file's unit (a height in metres if levels follow the bottom of the sea): the flow becomes
    /// two-dimensional.
    pub level: Option<f64>,
    /// Part to read: `[x0, x1, y0, y1]` in the file's coordinates (longitudes may differ by 360 degrees).
    pub region: Option<[f64; 4]>,
    /// Factor of vertical lengths, in the sphere and cartesian metrics with levels; 1 by default.
    pub vertical_scale: Option<f64>,
    /// HDF5: one dataset that holds all components; a `*` stands for the number of a snapshot (`Velocity_*`).
    pub velocity: Option<String>,
    /// HDF5: letters of the axes of the velocity datasets, slowest first: x, y, z, t (time), c (component), `-` (one entry).
    pub order: Option<String>,
    /// HDF5 without coordinates: distances between nodes along x, y and z.
    pub spacing: Option<[f64; 3]>,
    /// HDF5 without coordinates: coordinates of the first node.
    pub origin: Option<[f64; 3]>,
    /// `"none"`: longitudes that close the circle end at their last node. HDF5: letters of the axes that repeat one spacing behind their
    /// last node (`"xyz"`).
    pub periodic: Option<String>,
    /// HDF5: time between the numbers in dataset or file names, 1 by default.
    pub time_step: Option<f64>,
    /// Levels that follow the terrain (WRF) or the bottom of the sea: heights of the grid in metres, negative below the surface of the sea; by default
    /// the mean heights of the levels.
    pub heights: Option<Vec<f64>>,
    /// Value of the velocities' variables, as it is stored, where there is no velocity, beside those that the file names.
    pub fill_value: Option<f64>,
    /// WRF: grid for the components on faces.
    pub staggering: Staggering,
    /// Curvilinear longitudes and latitudes: spacing in degrees of the resampled grid; by default chosen by its error.
    pub resolution: Option<[f64; 2]>,
    /// Curvilinear longitudes and latitudes, projections, rotated poles: whether velocities run along the grid's own directions, not east and
    /// north; by default decided by their standard names.
    pub grid_relative: Option<bool>,
    /// Mask of land: a variable (0 is land unless its attributes say otherwise; `!NAME`: 0 is water), `"zero"` (nodes whose velocity is 0 at
    /// all sampled times) or `"none"`; by default found by convention.
    pub mask: Option<String>,
    /// Entry, counted from 0, of a dimension that is neither time nor an axis, such as the member of an ensemble; of time, the only time that
    /// is read.
    pub select: Option<BTreeMap<String, usize>>,
    /// Units of `u`, `v`, `w`, `x`, `y`, `z` or `time` where those of the files are missing or wrong.
    pub units: Option<BTreeMap<String, String>>,
    /// `replay` waits for further snapshots at the end of the files, and ends after so many seconds without one; by default it ends at once.
    pub follow: Option<f64>,
    /// Reads values that the files keep in other files: external storage, virtual datasets and links of HDF5.
    pub external: bool,
    /// Most memory that reading may need, in GiB; by default nine tenths of what is free.
    pub memory_gib: Option<f64>,
    /// If no files are named: an archive of the standard turbulence, which is written unless it exists, and read.
    pub synthetic: Option<SyntheticSettings>,
    /// Lower and upper end of the slab over which a two-dimensional flow is extruded; by default 0 and a tenth of the longer edge.
    pub slab: Option<[f64; 2]>,
}

/// Quantities whose unit can be stated.
pub const WITH_UNITS: [&str; 7] = ["u", "v", "w", "x", "y", "z", "time"];

/// Value of `archive.w` that ignores vertical motion.
const NO_W: &str = "none";
/// Value of `archive.w` that computes vertical motion from the horizontal one.
const CONTINUITY: &str = "continuity";

impl ArchiveSettings {
    /// True if vertical motion is computed from the horizontal one.
    pub(super) fn wants_continuity(&self) -> bool {
        self.w.as_deref() == Some(CONTINUITY)
    }

    /// True if no vertical velocity of the files is read.
    pub(super) fn leaves_out_w(&self) -> bool {
        self.wants_continuity() || self.w.as_deref() == Some(NO_W)
    }

    /// Variable of w that is named.
    pub(super) fn named_w(&self) -> Option<&str> {
        self.w.as_deref().filter(|_| !self.leaves_out_w())
    }

    /// Unit that is stated for one of [`WITH_UNITS`].
    pub(super) fn unit(&self, of: &str) -> Option<&str> {
        self.units.as_ref()?.get(of).map(String::as_str)
    }

    /// Units that are stated for u, v and w.
    pub(super) fn velocity_units(&self) -> [Option<&str>; 3] {
        ["u", "v", "w"].map(|of| self.unit(of))
    }

    /// Entry that is picked of a dimension.
    pub(super) fn entry(&self, dimension: &str) -> Option<usize> {
        self.select.as_ref()?.get(dimension).copied()
    }

    /// Compares the bytes of a window with the memory that reading may need.
    ///
    /// # Errors
    /// The window needs more.
    pub fn check_window(&self, bytes: u64) -> Result<(), SourceError> {
        let limits = Limits::new(self.memory_gib, self.external);
        let found = format!("{:.2}", gib(limits.memory));
        let needed =
            format!("{:.2} GiB for the window at least: or reduce tau, or read a part (`archive.region`, `archive.level`)", gib(bytes));
        if bytes <= limits.memory { Ok(()) } else { Err(SourceError::setting("memory_gib", found, needed)) }
    }
}

fn one_or_many<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Vec<PathBuf>, D::Error> {
    #[derive(Deserialize)]
    #[serde(untagged, expecting = "a file name or a list of file names")]
    enum Files {
        One(PathBuf),
        Many(Vec<PathBuf>),
    }
    Ok(match Files::deserialize(deserializer)? {
        Files::One(path) => vec![path],
        Files::Many(paths) => paths,
    })
}
