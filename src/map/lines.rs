//! Ridge lines as files for other tools: GeoJSON, NetCDF (CF geometries) and VTK.

use super::ridges::RidgePoint;
use super::words::Rate;
use crate::publish::add_mapping;
use crate::publish::vtk_xml::{of_what, unit_texts};
use crate::source::GridMapping;
use netcdf::VariableMut;
use serde_json::json;
use std::fmt::Write as _;
use std::path::Path;

/// A ridge line with what it is a ridge of.
#[derive(Debug, Clone, PartialEq)]
pub struct RidgeLine {
    /// `attracting` (backward FTLE) or `repelling` (forward FTLE).
    pub kind: &'static str,
    /// |tau|, in time units of the source.
    pub tau: f64,
    /// Its points; values in 1 / time unit of the source.
    pub points: Vec<RidgePoint>,
}

/// What files say of all ridges of a moment.
#[derive(Debug, Clone, PartialEq)]
pub struct RidgesAbout {
    /// Title of the scene.
    pub title: String,
    /// Source of the velocity.
    pub source: String,
    /// Seed time, as a date or a number.
    pub when: String,
    /// Unit of tau; empty if it has none.
    pub time_unit: String,
    /// Unit of the FTLE in GeoJSON and NetCDF, that of the map.
    pub rate: Rate,
    /// True if coordinates are longitudes and latitudes in degrees.
    pub is_geographic: bool,
    /// Names and units of the coordinates.
    pub axes: [[String; 2]; 3],
    /// Where the horizontal coordinates lie on the globe, if the source tells.
    pub mapping: Option<GridMapping>,
    /// Third coordinate of lines; `None` in two dimensions.
    pub level: Option<f64>,
}

impl RidgesAbout {
    /// Unit of the sharpness of a FTLE in `rate`; without a unit of length if the coordinates have none.
    fn sharpness_unit(&self, rate: &str) -> String {
        let length = if self.is_geographic { "km" } else { self.axes[0][1].as_str() };
        let square = if length.is_empty() { String::new() } else { format!(" {length}-2") };
        format!("{rate}{square}").trim_start().to_owned()
    }

    /// Names of facts and their texts, for files of VTK and PLY. Their FTLE is in 1 / time unit of the source, as that of fields in VTK files.
    pub(super) fn texts(&self) -> impl Iterator<Item = (&'static str, String)> {
        let rate = if self.time_unit.is_empty() { String::new() } else { format!("1/{}", self.time_unit) };
        let axes = self.axes.iter().map(|[name, unit]| [name.as_str(), unit]);
        let sharpness = Some(self.sharpness_unit(&rate)).filter(|unit| !unit.is_empty()).map(|unit| ("sharpness_unit", unit));
        unit_texts(axes, &self.time_unit).chain(sharpness)
    }
}

/// Kind of a file of lines, by its ending.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum LinesFormat {
    /// RFC 7946.
    GeoJson,
    /// CF 1.8, lines as geometries.
    NetCdf,
    /// Legacy VTK polydata.
    Vtk,
}

impl LinesFormat {
    /// The format of a file name.
    ///
    /// # Errors
    /// The ending is unknown, or the format cannot hold these coordinates; the text says what is accepted.
    pub fn of(path: &Path, is_geographic: bool) -> Result<Self, String> {
        match path.extension().and_then(|e| e.to_str()).map(str::to_ascii_lowercase).as_deref() {
            Some("geojson" | "json") if is_geographic => Ok(Self::GeoJson),
            Some("geojson" | "json") => {
                Err("GeoJSON holds longitudes and latitudes only; accepted here: names that end in .nc or .vtk".into())
            }
            Some("nc") => Ok(Self::NetCdf),
            Some("vtk") => Ok(Self::Vtk),
            _ => Err("accepted: names that end in .geojson, .nc or .vtk".into()),
        }
    }
}

/// A longitude between -180 and 180, as GeoJSON wants it.
fn wrapped(longitude: f64) -> f64 {
    let east = (longitude + 180.0).rem_euclid(360.0) - 180.0;
    if east == -180.0 && longitude > 0.0 { 180.0 } else { east }
}

/// Lines as a GeoJSON FeatureCollection. A line that crosses the antimeridian is cut there.
pub fn geojson(lines: &[RidgeLine], about: &RidgesAbout) -> String {
    let features = lines.iter().enumerate().flat_map(|(number, line)| {
        let mut parts: Vec<Vec<[f64; 2]>> = vec![Vec::new()];
        for point in &line.points {
            let place = [wrapped(point.place[0]), point.place[1]];
            if let Some(part) = parts.last_mut() {
                match part.last() {
                    Some(before) if (place[0] - before[0]).abs() > 180.0 => parts.push(vec![place]),
                    _ => part.push(place),
                }
            }
        }
        let [mean, largest, sharpness] = figures(line, about);
        parts.into_iter().filter(|part| part.len() > 1).map(move |coordinates| {
            json!({
                "type": "Feature",
                "geometry": { "type": "LineString", "coordinates": coordinates },
                "properties": {
                    "line": number, "kind": line.kind, "tau": line.tau, "ftle_mean": mean, "ftle_max": largest, "sharpness_mean": sharpness,
                },
            })
        })
    });
    let features: Vec<_> = features.collect();
    let about = json!({
        "title": about.title, "source": about.source, "seed_time": about.when, "tau_unit": about.time_unit, "ftle_unit": about.rate.unit,
        "sharpness_unit": about.sharpness_unit(&about.rate.unit),
    });
    json!({ "type": "FeatureCollection", "ridgewatch": about, "features": features }).to_string()
}

/// Mean and largest FTLE and mean sharpness, in the unit of the map.
fn figures(line: &RidgeLine, about: &RidgesAbout) -> [f64; 3] {
    let mean = |of: &dyn Fn(&RidgePoint) -> f64| line.points.iter().map(of).sum::<f64>() / line.points.len().max(1) as f64;
    let largest = line.points.iter().map(|p| p.value).fold(f64::NEG_INFINITY, f64::max);
    [mean(&|p| p.value), largest, mean(&|p| p.sharpness)].map(|v| v * about.rate.factor)
}

/// Lines as legacy VTK polydata. On the sphere, coordinates are degrees. The FTLE is in 1 / time unit of the source.
pub fn vtk(lines: &[RidgeLine], about: &RidgesAbout) -> String {
    let points: Vec<&RidgePoint> = lines.iter().flat_map(|line| &line.points).collect();
    let facts = about.texts().map(|(name, text)| format!("{name} {text}")).chain([about.when.clone(), about.title.clone()]);
    let facts: Vec<_> = std::iter::once("ridgewatch FTLE ridges".to_owned()).chain(facts).filter(|fact| !fact.is_empty()).collect();
    // A line of at most 256 bytes.
    let line = facts.join(", ").replace('\n', " ");
    let title = &line[..line.floor_char_boundary(250)];
    let mut text = format!("# vtk DataFile Version 3.0\n{title}\nASCII\nDATASET POLYDATA\nPOINTS {} double\n", points.len());
    // Writing to a string does not fail.
    for point in &points {
        let _ = writeln!(text, "{} {} {}", point.place[0], point.place[1], about.level.unwrap_or(0.0));
    }
    let _ = writeln!(text, "LINES {} {}", lines.len(), lines.len() + points.len());
    let mut next = 0;
    for line in lines {
        let _ = write!(text, "{}", line.points.len());
        for _ in &line.points {
            let _ = write!(text, " {next}");
            next += 1;
        }
        text.push('\n');
    }
    let _ = writeln!(text, "CELL_DATA {}\nSCALARS repelling int 1\nLOOKUP_TABLE default", lines.len());
    for line in lines {
        let _ = writeln!(text, "{}", i32::from(line.kind == "repelling"));
    }
    let _ = writeln!(text, "SCALARS tau double 1\nLOOKUP_TABLE default");
    for line in lines {
        let _ = writeln!(text, "{}", line.tau);
    }
    for (number, name) in ["ftle", "sharpness"].into_iter().enumerate() {
        let head = if number == 0 { format!("POINT_DATA {}\n", points.len()) } else { String::new() };
        let _ = writeln!(text, "{head}SCALARS {name} double 1\nLOOKUP_TABLE default");
        for point in &points {
            let _ = writeln!(text, "{}", if number == 0 { point.value } else { point.sharpness });
        }
    }
    text
}

/// Writes lines as NetCDF with CF geometries (CF 1.8, section 7.5).
///
/// # Errors
/// libnetcdf fails.
pub fn write_netcdf(path: &Path, lines: &[RidgeLine], about: &RidgesAbout) -> Result<(), netcdf::Error> {
    let points: Vec<&RidgePoint> = lines.iter().flat_map(|line| &line.points).collect();
    let mut file = netcdf::create(path)?;
    file.add_attribute("Conventions", "CF-1.8")?;
    file.add_attribute("title", format!("ridges of the finite-time Lyapunov exponent: {}", of_what(&about.title, &about.source)))?;
    file.add_attribute("source", format!("ridgewatch {} from {}", env!("CARGO_PKG_VERSION"), about.source))?;
    file.add_attribute("seed_time", about.when.as_str())?;
    if let Some(level) = about.level {
        file.add_attribute("level", level)?;
    }
    file.add_dimension("line", lines.len())?;
    file.add_dimension("node", points.len())?;
    let unit = |unit: &str| if unit.is_empty() { "1".to_owned() } else { unit.to_owned() };
    let placed = |variable: &mut VariableMut| -> Result<(), netcdf::Error> {
        about.mapping.iter().try_for_each(|mapping| variable.put_attribute("grid_mapping", mapping.name.as_str()).map(drop))
    };
    {
        let mut container = file.add_variable::<i32>("geometry", &[])?;
        container.put_attribute("geometry_type", "line")?;
        container.put_attribute("node_count", "node_count")?;
        container.put_attribute("node_coordinates", "x y")?;
        placed(&mut container)?;
    }
    if let Some(mapping) = &about.mapping {
        add_mapping(&mut file, mapping)?;
    }
    {
        let mut counts = file.add_variable::<i32>("node_count", &["line"])?;
        counts.put_values(&lines.iter().map(|line| line.points.len() as i32).collect::<Vec<_>>(), ..)?;
        counts.put_attribute("long_name", "points of the line")?;
    }
    for (axis, name) in ["x", "y"].into_iter().enumerate() {
        let mut variable = file.add_variable::<f64>(name, &["node"])?;
        variable.put_values(&points.iter().map(|p| p.place[axis]).collect::<Vec<_>>(), ..)?;
        variable.put_attribute("axis", ["X", "Y"][axis])?;
        variable.put_attribute("long_name", about.axes[axis][0].as_str())?;
        if about.is_geographic {
            variable.put_attribute("standard_name", ["longitude", "latitude"][axis])?;
        } else if about.mapping.as_ref().is_some_and(|mapping| mapping.kind() != "latitude_longitude") {
            variable.put_attribute("standard_name", ["projection_x_coordinate", "projection_y_coordinate"][axis])?;
        }
        variable.put_attribute(
            "units",
            if about.is_geographic { ["degrees_east", "degrees_north"][axis].to_owned() } else { unit(&about.axes[axis][1]) },
        )?;
    }
    let tau_unit = unit(&about.time_unit);
    let per_line: [(&str, &str, &str, Vec<f64>); 2] = [
        (
            "repelling",
            "1 for ridges of forward FTLE, 0 for those of backward FTLE",
            "1",
            lines.iter().map(|l| f64::from(u8::from(l.kind == "repelling"))).collect(),
        ),
        ("tau", "duration of the integration", &tau_unit, lines.iter().map(|l| l.tau).collect()),
    ];
    for (name, long_name, units, values) in per_line {
        let mut variable = file.add_variable::<f64>(name, &["line"])?;
        variable.put_values(&values, ..)?;
        variable.put_attribute("long_name", long_name)?;
        variable.put_attribute("units", units)?;
        variable.put_attribute("geometry", "geometry")?;
        placed(&mut variable)?;
    }
    let rate = about.rate.unit.strip_prefix("1/").map_or(String::new(), |unit| format!("{unit}-1"));
    let across = "minus the second derivative of the FTLE across the ridge";
    let sharpness_unit = unit(&about.sharpness_unit(&rate));
    for (name, long_name, units, of) in [
        ("ftle", "finite-time Lyapunov exponent", unit(&rate), (|p: &RidgePoint| p.value) as fn(&RidgePoint) -> f64),
        ("sharpness", across, sharpness_unit, |p| p.sharpness),
    ] {
        let mut variable = file.add_variable::<f64>(name, &["node"])?;
        variable.put_values(&points.iter().map(|p| of(p) * about.rate.factor).collect::<Vec<_>>(), ..)?;
        variable.put_attribute("long_name", long_name)?;
        variable.put_attribute("units", units)?;
    }
    Ok(())
}
