//! Names and meaning of a source's coordinates, for fields that are exported on its grid (CF conventions, chapters 4 and 5).

use crate::archive_settings::{ArchiveSettings, Metric};
use crate::cf::calendar::Calendar;
use crate::cf::coordinate::{Kind, classify};
use crate::cf::units::Unit;
use crate::formats::{Attribute, DataFile, Variable};
use crate::grids::{AxisPlan, Layout, Quantity, REFERENCE_PRESSURE, Resampling, SCALE_HEIGHT};
use crate::projection::Projection;
use ridgewatch_field::EARTH_RADIUS;
use serde::{Deserialize, Deserializer, Serialize};

/// Grid mappings of the CF conventions, appendix F.
const MAPPINGS: [&str; 16] = [
    "albers_conical_equal_area",
    "azimuthal_equidistant",
    "geostationary",
    "lambert_azimuthal_equal_area",
    "lambert_conformal_conic",
    "lambert_cylindrical_equal_area",
    "latitude_longitude",
    "mercator",
    "oblique_mercator",
    "orthographic",
    "polar_stereographic",
    "rotated_latitude_longitude",
    "sinusoidal",
    "stereographic",
    "transverse_mercator",
    "vertical_perspective",
];

/// One of the words that are known here. (By this name serde does not take it for a part of what it reads.)
type Word = &'static str;

/// What a source's coordinates are called and mean. Empty for sources without files. Told to others, it has no positions, which are as many as nodes.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Georeference {
    /// x, y and, in three dimensions, z.
    pub axes: Vec<Coordinate>,
    /// Where the horizontal coordinates lie on the globe.
    pub mapping: Option<GridMapping>,
    /// Longitudes and latitudes of a grid whose axes are neither.
    #[serde(skip)]
    pub positions: Option<Positions>,
    /// Name of the calendar in which times are seconds since 1970-01-01. `None` if times are no dates.
    #[serde(deserialize_with = "calendar")]
    pub calendar: Option<Word>,
}

/// A coordinate variable of the source.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Coordinate {
    /// Name in the file.
    pub name: String,
    /// Unit of [`Coordinate::value`].
    pub units: String,
    /// Standard name, if there is one.
    pub standard_name: Option<String>,
    /// Long name, if the file has one.
    pub long_name: Option<String>,
    /// `up` or `down`, of levels.
    #[serde(deserialize_with = "positive")]
    pub positive: Option<Word>,
    conversion: Conversion,
}

#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
enum Conversion {
    /// Factor from the grid's coordinate to the source's.
    Linear(f64),
    /// The grid's coordinate is a log-pressure height, counted this many times.
    Pressure(f64),
}

/// A grid mapping variable.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct GridMapping {
    /// Name of the variable.
    pub name: String,
    /// Its attributes, `grid_mapping_name` among them.
    pub attributes: Vec<(String, MappingValue)>,
}

/// Value of an attribute of a grid mapping.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(untagged)]
pub enum MappingValue {
    /// Text.
    Text(String),
    /// One number or several.
    Numbers(Vec<f64>),
}

/// Longitudes and latitudes at nodes over x and y, in degrees; NaN where they are unknown.
#[derive(Debug, Clone, PartialEq)]
pub struct Positions {
    /// Names of the variables in the file.
    pub names: [String; 2],
    x: Vec<f64>,
    y: Vec<f64>,
    /// Longitude and latitude, x fastest.
    pub(crate) degrees: Vec<[f64; 2]>,
}

/// A calendar that is known; `None` for others.
fn calendar<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Option<Word>, D::Error> {
    Ok(Option::<String>::deserialize(deserializer)?.and_then(|name| Calendar::parse(&name)).map(Calendar::name))
}

/// A direction that is known; `None` for others.
fn positive<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Option<Word>, D::Error> {
    let told = Option::<String>::deserialize(deserializer)?;
    Ok(["up", "down"].into_iter().find(|known| told.as_deref() == Some(*known)))
}

impl Coordinate {
    /// The source's own value of a coordinate of the grid: a pressure or a depth of a height.
    pub fn value(&self, coordinate: f64) -> f64 {
        match self.conversion {
            Conversion::Linear(factor) => factor * coordinate,
            Conversion::Pressure(scale) => REFERENCE_PRESSURE * (-coordinate / (SCALE_HEIGHT * scale)).exp(),
        }
    }

    fn of(plan: &AxisPlan, variable: Option<&Variable>, settings: &ArchiveSettings, metric: Metric) -> Self {
        let text = |name: &str| variable.and_then(|v| v.text(name)).filter(|text| !text.is_empty()).map(str::to_owned);
        let mut new = Self {
            name: plan.axis.name().to_owned(),
            units: plan.axis.units().to_owned(),
            standard_name: None,
            long_name: text("long_name"),
            positive: None,
            conversion: Conversion::Linear(1.0),
        };
        if metric == Metric::Index {
            new.units = "1".into();
            new.long_name = Some(format!("index of `{}`", new.name));
            return new;
        }
        let named = |accepted: &[&str], default: Option<&str>| {
            text("standard_name").filter(|name| accepted.contains(&name.as_str())).or(default.map(str::to_owned))
        };
        let scale = settings.vertical_scale.unwrap_or(1.0);
        match plan.kind {
            Kind::Longitude => new.standard_name = named(&["longitude", "grid_longitude"], Some("longitude")),
            Kind::Latitude => new.standard_name = named(&["latitude", "grid_latitude"], Some("latitude")),
            Kind::X => new.standard_name = named(&["projection_x_coordinate"], None),
            Kind::Y => new.standard_name = named(&["projection_y_coordinate"], None),
            _ => {
                let pressure =
                    variable.and_then(|v| settings.unit("z").or(v.units())).and_then(Unit::parse).is_some_and(|u| u.is_pressure());
                let down = text("positive").is_some_and(|p| p.eq_ignore_ascii_case("down"))
                    || (text("positive").is_none() && text("standard_name").as_deref() == Some("depth"));
                if pressure {
                    new.standard_name = named(&["air_pressure", "sea_water_pressure"], None);
                    new.units = "Pa".into();
                    new.positive = Some("down");
                    new.conversion = Conversion::Pressure(scale);
                } else if plan.quantity == Quantity::Length {
                    // Those of WRF are (PH + PHB) / g.
                    let made = variable.is_none() && plan.in_file.is_none();
                    let default = match new.name.as_str() {
                        "height" if made => Some("geopotential_height"),
                        "altitude" if made => Some("altitude"),
                        _ => None,
                    };
                    new.standard_name = named(&["depth", "height", "altitude", "geopotential_height"], default);
                    new.units = "m".into();
                    new.positive = Some(if down { "down" } else { "up" });
                    new.conversion = Conversion::Linear(if down { -1.0 } else { 1.0 } / scale);
                } else {
                    new.standard_name = named(&["model_level_number"], None);
                    new.conversion = Conversion::Linear(1.0 / scale);
                }
            }
        }
        if matches!(new.standard_name.as_deref(), Some("grid_longitude" | "grid_latitude")) {
            new.units = "degrees".into();
        }
        if new.units.is_empty() {
            new.units = "1".into();
        }
        if new.standard_name.is_none() && new.long_name.is_none() {
            new.long_name = Some(match plan.kind {
                Kind::X => "distance along x".into(),
                Kind::Y => "distance along y".into(),
                _ => new.name.clone(),
            });
        }
        new
    }
}

impl GridMapping {
    /// Numbers of an attribute.
    pub(crate) fn numbers(&self, name: &str) -> &[f64] {
        match self.attributes.iter().find(|(n, _)| n == name) {
            Some((_, MappingValue::Numbers(numbers))) => numbers,
            _ => &[],
        }
    }

    /// Name of the projection by the CF conventions.
    pub fn kind(&self) -> &str {
        match self.attributes.iter().find(|(n, _)| n == "grid_mapping_name") {
            Some((_, MappingValue::Text(text))) => text,
            _ => "",
        }
    }
}

impl Positions {
    /// Longitudes and latitudes at nodes over ascending x and y, x fastest; NaN where they are unknown.
    pub fn new(names: [&str; 2], x: Vec<f64>, y: Vec<f64>, degrees: Vec<[f64; 2]>) -> Self {
        Self { names: names.map(str::to_owned), x, y, degrees }
    }

    /// Longitude and latitude at a place between the nodes, bilinear; `None` beyond them, or where they are unknown. Longitudes may jump by 360
    /// degrees between nodes.
    pub fn at(&self, x: f64, y: f64) -> Option<[f64; 2]> {
        let ((i, s), (j, t)) = (between(&self.x, x)?, between(&self.y, y)?);
        let node = |i: usize, j: usize| self.degrees[j * self.x.len() + i];
        let weights = [(i, j, (1.0 - s) * (1.0 - t)), (i + 1, j, s * (1.0 - t)), (i, j + 1, (1.0 - s) * t), (i + 1, j + 1, s * t)];
        let (mut sum, base) = ([0.0; 2], node(i, j)[0]);
        for (i, j, weight) in weights.into_iter().filter(|w| w.2 != 0.0) {
            let [longitude, latitude] = node(i, j);
            let near = if base.is_finite() { base + (longitude - base + 180.0).rem_euclid(360.0) - 180.0 } else { longitude };
            sum = [sum[0] + weight * near, sum[1] + weight * latitude];
        }
        (sum[0].is_finite() && sum[1].is_finite()).then_some(sum)
    }

    /// Of a file whose axes are x and y of a projection or about a rotated pole, and whose longitudes and latitudes have both dimensions.
    pub(crate) fn of(file: &DataFile, layout: &Layout) -> Option<Self> {
        let listing = &file.listing;
        let component = &layout.frames[0].first()?;
        // Nodes between the points of the file are none of these.
        if component.own[..2].iter().any(Option::is_some) {
            return None;
        }
        let velocity = &listing.variables[listing.find(&component.name)?];
        let (&dx, &dy) = (velocity.dimensions.last()?, velocity.dimensions.iter().rev().nth(1)?);
        let find = |kind: Kind| {
            // Packed values are not unpacked here.
            let plain = |v: &Variable| v.attribute("scale_factor").is_none() && v.attribute("add_offset").is_none();
            let in_degrees = |v: &Variable| v.units().is_none_or(|unit| unit.to_ascii_lowercase().starts_with("degree"));
            let fits = |v: &Variable| v.dimensions == [dy, dx] && v.number.is_number() && classify(v) == kind && plain(v) && in_degrees(v);
            listing.variables.iter().position(fits)
        };
        let (longitude, latitude) = (find(Kind::Longitude)?, find(Kind::Latitude)?);
        let read = |index: usize| file.read_all(index).ok();
        let values = [read(longitude)?, read(latitude)?];
        let width = listing.dimensions[dx].len;
        let [x, y] = [&layout.axes[0], &layout.axes[1]];
        // Fill values are no degrees.
        let node = |i: &usize, j: &usize| {
            let degrees = [0, 1].map(|k| values[k].get(j * width + i).copied().unwrap_or(f64::NAN));
            if degrees[0].abs() <= 720.0 && degrees[1].abs() <= 90.0 { degrees } else { [f64::NAN; 2] }
        };
        Some(Self {
            names: [longitude, latitude].map(|index| listing.variables[index].name.clone()),
            x: x.axis.coordinates().to_vec(),
            y: y.axis.coordinates().to_vec(),
            degrees: y.order.iter().flat_map(|j| x.order.iter().map(move |i| (i, j))).map(|(i, j)| node(i, j)).collect(),
        })
    }
}

/// Interval of ascending nodes that holds a value, and the share of the interval below it.
fn between(nodes: &[f64], value: f64) -> Option<(usize, f64)> {
    let slack = 1e-9 * (nodes.last()? - nodes.first()?);
    if !(nodes[0] - slack..=nodes[nodes.len() - 1] + slack).contains(&value) {
        return None;
    }
    if nodes.len() == 1 {
        return Some((0, 0.0));
    }
    let i = nodes.partition_point(|&node| node <= value).clamp(1, nodes.len() - 1) - 1;
    Some((i, ((value - nodes[i]) / (nodes[i + 1] - nodes[i])).clamp(0.0, 1.0)))
}

impl Georeference {
    /// Of a plane in metres, by the CF name of its projection and the numbers of it, on a sphere. Times are those of `self`.
    pub fn in_plane(&self, mapping: &str, numbers: &[(&str, &[f64])], positions: Positions) -> Self {
        let axis = |k: usize| Coordinate {
            name: ["x", "y"][k].into(),
            units: "m".into(),
            standard_name: Some(["projection_x_coordinate", "projection_y_coordinate"][k].into()),
            long_name: None,
            positive: None,
            conversion: Conversion::Linear(1.0),
        };
        let radius = [("earth_radius", &[EARTH_RADIUS][..])];
        let numbers = numbers.iter().chain(&radius);
        let attributes = std::iter::once(("grid_mapping_name".to_owned(), MappingValue::Text(mapping.into())))
            .chain(numbers.map(|(name, values)| ((*name).to_owned(), MappingValue::Numbers(values.to_vec()))));
        Self {
            axes: vec![axis(0), axis(1)],
            mapping: Some(GridMapping { name: "crs".into(), attributes: attributes.collect() }),
            positions: Some(positions),
            calendar: self.calendar,
        }
    }

    /// Longitudes and latitudes at places (x, y) of axes that are neither, in degrees: by those of the file, else by its grid mapping; NaN where they are
    /// unknown. `None` if neither tells.
    pub fn degrees(&self, places: &[[f64; 2]]) -> Option<Vec<[f64; 2]>> {
        const UNKNOWN: [f64; 2] = [f64::NAN; 2];
        if let Some(positions) = &self.positions {
            return Some(places.iter().map(|&[x, y]| positions.at(x, y).unwrap_or(UNKNOWN)).collect());
        }
        let mapping = self.mapping.as_ref()?;
        let projection = Projection::of(mapping.kind(), |name| mapping.numbers(name), 1.0)?;
        Some(places.iter().map(|place| projection.position(*place).unwrap_or(UNKNOWN)).collect())
    }

    /// A time, in seconds, as a date (`2002-01-01T00:00:00Z`), whether or not a snapshot has it; `None` if times are no dates.
    pub fn date(&self, time: f64) -> Option<String> {
        Calendar::parse(self.calendar?)?.iso(time)
    }

    /// Of the first file of an archive.
    pub(crate) fn of(file: &DataFile, layout: &Layout, settings: &ArchiveSettings) -> Self {
        let listing = &file.listing;
        let variable = |plan: &AxisPlan| listing.find(plan.axis.name()).map(|index| &listing.variables[index]);
        let axes = layout.axes.iter().map(|plan| Coordinate::of(plan, variable(plan), settings, layout.metric)).collect();
        let mut new = Self { axes, mapping: None, positions: None, calendar: layout.time.calendar.map(|calendar| calendar.name()) };
        if layout.metric == Metric::Index {
            new.calendar = None;
            return new;
        }
        let kinds = [layout.axes[0].kind, layout.axes[1].kind];
        let in_file = mapping(file, layout);
        if kinds == [Kind::Longitude, Kind::Latitude] {
            let own = || GridMapping {
                name: "crs".into(),
                attributes: vec![
                    ("grid_mapping_name".into(), MappingValue::Text("latitude_longitude".into())),
                    ("earth_radius".into(), MappingValue::Numbers(vec![EARTH_RADIUS])),
                ],
            };
            new.mapping = in_file.or((layout.metric == Metric::Sphere).then(own));
            return new;
        }
        // Its coordinates became metres.
        new.mapping = in_file.filter(|_| unit_of_plane(layout) == Some(1.0));
        if new.mapping.is_some() {
            for (axis, name) in new.axes.iter_mut().zip(["projection_x_coordinate", "projection_y_coordinate"]) {
                axis.standard_name = Some(name.into());
            }
        }
        new.positions = match &layout.resampling {
            Some(Resampling::Staggered(staggered)) => staggered
                .positions(file, layout.time.seconds.len())
                .map(|(x, y, degrees)| Positions { names: ["XLONG".into(), "XLAT".into()], x, y, degrees }),
            _ => Positions::of(file, layout),
        };
        new
    }
}

/// Metres in the unit of x and y in the file, in which a false easting counts too. `None` if they are no lengths, or differ.
pub(crate) fn unit_of_plane(layout: &Layout) -> Option<f64> {
    let factor = |plan: &AxisPlan| Unit::parse(&plan.in_file.as_ref()?.units).filter(Unit::is_length).map(|unit| unit.factor);
    let [x, y] = [factor(&layout.axes[0])?, factor(&layout.axes[1])?];
    (x == y).then_some(x)
}

/// The grid mapping of the velocity, if the CF conventions know it. A universal transverse Mercator projection that is given in the words of PROJ is
/// put into theirs.
pub(crate) fn mapping(file: &DataFile, layout: &Layout) -> Option<GridMapping> {
    let listing = &file.listing;
    let velocity = &listing.variables[listing.find(&layout.frames[0].first()?.name)?];
    // The extended form names coordinates behind a colon.
    let name = velocity.text("grid_mapping")?.split([':', ' ']).next()?;
    let variable = &listing.variables[listing.find(name)?];
    let called = variable.text("grid_mapping_name").unwrap_or_default();
    let attributes = if MAPPINGS.contains(&called) {
        let value = |attribute: &Attribute| match attribute {
            Attribute::Text(text) => MappingValue::Text(text.clone()),
            Attribute::Numbers(_, numbers) => MappingValue::Numbers(numbers.clone()),
        };
        variable.attributes.iter().filter(|(name, _)| !name.starts_with('_')).map(|(name, v)| (name.clone(), value(v))).collect()
    } else {
        transverse_mercator(["proj_params", "proj4_params", "proj4", "proj4text"].iter().find_map(|name| variable.text(name))?)?
    };
    Some(GridMapping { name: name.to_owned(), attributes })
}

/// `+proj=utm +zone=32 +north`, with the constants of the projection.
fn transverse_mercator(proj: &str) -> Option<Vec<(String, MappingValue)>> {
    let value = |key: &str| proj.split_whitespace().find_map(|word| word.strip_prefix('+')?.strip_prefix(key)?.strip_prefix('='));
    if value("proj") != Some("utm") {
        return None;
    }
    let zone = value("zone")?.parse::<u8>().ok().filter(|zone| (1..=60).contains(zone))?;
    let south = proj.split_whitespace().any(|word| word == "+south");
    // WGS 84; GRS 80 differs by 0.1 mm in the shorter axis.
    let inverse_flattening = if value("ellps") == Some("GRS80") { 298.257_222_101 } else { 298.257_223_563 };
    let numbers = [
        ("longitude_of_central_meridian", f64::from(zone) * 6.0 - 183.0),
        ("latitude_of_projection_origin", 0.0),
        ("scale_factor_at_central_meridian", 0.9996),
        ("false_easting", 500_000.0),
        ("false_northing", if south { 10_000_000.0 } else { 0.0 }),
        ("semi_major_axis", 6_378_137.0),
        ("inverse_flattening", inverse_flattening),
    ];
    let mut attributes = vec![("grid_mapping_name".into(), MappingValue::Text("transverse_mercator".into()))];
    attributes.extend(numbers.map(|(name, number)| (name.into(), MappingValue::Numbers(vec![number]))));
    Some(attributes)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn positions_are_bilinear_over_the_date_line_and_unknown_beyond() {
        let degrees = vec![[179.0, 10.0], [-179.0, 10.0], [f64::NAN; 2], [179.0, 20.0], [-179.0, 20.0], [f64::NAN; 2]];
        let positions = Positions { names: ["lon".into(), "lat".into()], x: vec![0.0, 1.0, 2.0], y: vec![0.0, 4.0], degrees };
        assert_eq!(positions.at(0.5, 1.0), Some([180.0, 12.5]));
        assert_eq!(positions.at(1.0, 4.0), Some([-179.0, 20.0]));
        assert_eq!((positions.at(1.5, 1.0), positions.at(-0.1, 1.0), positions.at(0.0, f64::NAN)), (None, None, None));
    }

    #[test]
    fn any_time_of_a_calendar_has_a_date() {
        let of = |calendar| Georeference { calendar, ..Georeference::default() }.date(1_009_908_000.0);
        assert_eq!(of(Some("standard")).as_deref(), Some("2002-01-01T18:00:00Z"));
        assert_eq!(of(Some("360_day")).as_deref(), Some("2002-06-19T18:00:00Z"));
        assert_eq!(of(None), None, "times that are counted have none");
    }

    #[test]
    fn a_universal_transverse_mercator_projection_is_put_into_words() {
        let words = transverse_mercator("+proj=utm +zone=32 +north +datum=WGS84 +ellps=GRS80 +lat_0=0 +lon_0=9").unwrap();
        let number = |name: &str| words.iter().find(|(n, _)| n == name).map(|(_, v)| v.clone());
        assert_eq!(number("longitude_of_central_meridian"), Some(MappingValue::Numbers(vec![9.0])));
        assert_eq!(number("false_northing"), Some(MappingValue::Numbers(vec![0.0])));
        assert_eq!(transverse_mercator("+proj=lcc +lat_1=3"), None);
        assert_eq!(transverse_mercator("+proj=utm +zone=61"), None);
    }

    #[test]
    fn log_pressure_heights_are_pressures_again() {
        let level = |conversion| Coordinate {
            name: "plev".into(),
            units: "Pa".into(),
            standard_name: None,
            long_name: None,
            positive: None,
            conversion,
        };
        let height = 5.0 * 7000.0 * (100_000f64 / 25_000.0).ln();
        assert!((level(Conversion::Pressure(5.0)).value(height) - 25_000.0).abs() < 1e-6);
        assert_eq!(level(Conversion::Linear(-0.5)).value(-20.0), 10.0);
    }
}
