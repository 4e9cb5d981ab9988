//! `[archive]` of a scene file, for NetCDF archives.

use serde::{Deserialize, Deserializer, Serialize};
use std::path::PathBuf;

/// How coordinates become lengths.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Metric {
    /// Longitude and latitude on the sphere, metres and seconds. Default for longitude-latitude without levels.
    Sphere,
    /// Grid indices, and cells per snapshot interval; time counts snapshots. Default for longitude-latitude with levels.
    Index,
    /// Coordinates are lengths. Default for everything else. With longitude and latitude, velocities become degrees per second.
    Cartesian,
}

/// What velocities are in.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum VelocityUnit {
    /// What the variable's `units` say, converted to SI.
    #[default]
    Si,
    /// Cells per snapshot interval, taken as they are; wants the index metric.
    Cells,
}

/// Which files to read and, where the conventions do not say enough, how.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct NetCdfSettings {
    /// Files, folders and patterns: one or a list.
    #[serde(deserialize_with = "one_or_many")]
    pub files: Vec<PathBuf>,
    /// Variable of the velocity along x (eastward).
    pub u: Option<String>,
    /// Variable of the velocity along y (northward).
    pub v: Option<String>,
    /// Variable of the velocity along the level axis; `"none"` ignores vertical motion.
    pub w: Option<String>,
    /// Coordinate variable (or dimension) of x.
    pub x: Option<String>,
    /// Coordinate variable (or dimension) of y.
    pub y: Option<String>,
    /// Coordinate variable (or dimension) of the levels.
    pub z: Option<String>,
    /// Time variable.
    pub time: Option<String>,
    /// Metric; by default chosen from the axes.
    pub metric: Option<Metric>,
    /// What velocities are in.
    pub velocity_unit: VelocityUnit,
    /// Reads one level only, named by its coordinate in the file's unit: the flow is two-dimensional then.
    pub level: Option<f64>,
    /// Part to read: `[x0, x1, y0, y1]` in the file's coordinates (longitudes may be given 360 degrees off).
    pub region: Option<[f64; 4]>,
    /// Lower and upper end of the slab that a two-dimensional flow is extruded over; by default 0 and a tenth of the longer edge.
    pub slab: Option<[f64; 2]>,
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
