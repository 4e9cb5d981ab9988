//! What a file holds, as far as the velocity needs it: components, axes, times.

use super::SourceError;
use super::axes::{AxisPlan, Coordinates, Quantity};
use super::cf::calendar::{CALENDARS, Calendar};
use super::cf::coordinate::{Kind, classify, classify_name};
use super::cf::packing::Packing;
use super::cf::time::{TIME_UNITS, TimeUnit};
use super::cf::units::{Unit, VELOCITY_UNITS};
use super::cf::velocity::{self, Candidate, Velocity};
use super::container::{Container, Header, NumberType};
use super::settings::{Metric, NetCdfSettings, VelocityUnit};
use crate::field::{Axis, AxisFault};
use std::path::Path;

/// Longest coordinate variable that is read: none is longer, and a damaged header must not fill the memory.
const LONGEST_AXIS: usize = 1 << 26;

/// What a dimension of a variable is for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Role {
    Time,
    /// Axis 0, 1 or 2 of the grid.
    Axis(usize),
    /// Always this entry.
    Fixed(usize),
}

/// A component in one file. Packing may differ from file to file.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct ComponentPlan {
    pub(super) name: String,
    pub(super) shape: Vec<usize>,
    pub(super) roles: Vec<Role>,
    pub(super) packing: Packing,
    /// Factor to SI.
    pub(super) factor: f64,
    /// Why it was chosen.
    pub(super) why: String,
}

/// Times of one file.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct TimePlan {
    pub(super) variable: String,
    pub(super) units: String,
    /// Seconds, strictly ascending.
    pub(super) seconds: Vec<f64>,
    pub(super) calendar: Option<Calendar>,
}

/// Everything.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Layout {
    /// u, v and, where there is one, w.
    pub(super) components: Vec<ComponentPlan>,
    /// x, y and, in three dimensions, z.
    pub(super) axes: Vec<AxisPlan>,
    pub(super) time: TimePlan,
    pub(super) metric: Metric,
    /// Choices and conversions, in words.
    pub(super) notes: Vec<String>,
}

/// A dimension of u on its way to a role.
struct Extent {
    dimension: usize,
    kind: Kind,
    coordinate: Option<usize>,
}

struct Planner<'a> {
    file: &'a Container,
    settings: &'a NetCdfSettings,
    notes: Vec<String>,
}

/// Plans how to read a file.
pub(super) fn plan(file: &Container, settings: &NetCdfSettings) -> Result<Layout, SourceError> {
    Planner { file, settings, notes: Vec::new() }.plan()
}

impl Planner<'_> {
    fn header(&self) -> &Header {
        &self.file.header
    }

    fn path(&self) -> &Path {
        &self.file.path
    }

    fn misfit(&self, variable: usize, what: String) -> SourceError {
        SourceError::Layout { path: self.path().into(), variable: self.header().variables[variable].name.clone(), what }
    }

    fn plan(mut self) -> Result<Layout, SourceError> {
        let velocity = self.velocity()?;
        let u = velocity.u.variable;
        let mut extents = self.extents(u)?;
        self.name_by_position(u, &mut extents)?;
        let level = self.pick_level(&mut extents)?;
        let time = self.time(&extents)?;

        let mut axes = Vec::new();
        let mut roles: Vec<(usize, Role)> = Vec::new();
        let place = |kind: Kind| match kind {
            Kind::Longitude | Kind::X => Some(0),
            Kind::Latitude | Kind::Y => Some(1),
            Kind::Level => Some(2),
            _ => None,
        };
        extents.sort_by_key(|e| place(e.kind).unwrap_or(3));
        let three = extents.iter().any(|e| e.kind == Kind::Level && Some(e.dimension) != level.map(|l| l.0));
        let metric = self.metric(&extents, three)?;
        for extent in &extents {
            let role = match (place(extent.kind), level) {
                (_, Some((dimension, index))) if dimension == extent.dimension => Role::Fixed(index),
                (Some(k), _) => Role::Axis(k),
                (None, _) => Role::Time,
            };
            if let Role::Axis(k) = role {
                axes.push(self.axis(u, extent, k)?);
            }
            roles.push((extent.dimension, role));
        }
        for axis in &axes {
            self.notes.extend(axis.notes.iter().cloned());
        }
        let mut components =
            vec![self.component(&velocity.u, &roles, Some(&axes[0]))?, self.component(&velocity.v, &roles, Some(&axes[1]))?];
        match (&velocity.w, three) {
            (Some(w), true) => components.push(self.component(w, &roles, axes.get(2))?),
            (Some(w), false) => {
                let name = &self.header().variables[w.variable].name;
                let note = format!("`{name}` is not used: the flow is read in two dimensions");
                self.notes.push(note);
            }
            (None, true) if self.settings.w.as_deref() == Some("none") => self.notes.push("vertical motion is ignored, as set".into()),
            (None, true) => self.notes.push("no vertical velocity found: it is taken as 0".into()),
            (None, false) => {}
        }
        Ok(Layout { components, axes, time, metric, notes: self.notes })
    }

    /// Variable that a setting names.
    fn named(&self, key: &str, name: &Option<String>) -> Result<Option<usize>, SourceError> {
        let Some(name) = name else { return Ok(None) };
        self.header().find(name).map(Some).ok_or_else(|| self.not_found(key, name))
    }

    fn not_found(&self, key: &str, name: &str) -> SourceError {
        let names: Vec<&str> = self.header().variables.iter().map(|v| v.name.as_str()).collect();
        let near = names.iter().map(|n| (strsim::jaro_winkler(n, name), n)).max_by(|a, b| a.0.total_cmp(&b.0));
        SourceError::VariableNotFound {
            path: self.path().into(),
            key: key.into(),
            variable: name.into(),
            nearest: near.filter(|n| n.0 > 0.8).map(|n| format!(" (is `{}` meant?)", n.1)).unwrap_or_default(),
            present: names.join(", "),
        }
    }

    fn velocity(&mut self) -> Result<Velocity, SourceError> {
        let s = self.settings;
        let ignore_w = s.w.as_deref() == Some("none");
        let w = if ignore_w { None } else { self.named("w", &s.w)? };
        let fixed = [self.named("u", &s.u)?, self.named("v", &s.v)?, w];
        let found = velocity::choose(self.header(), fixed, ignore_w).map_err(|lacking| SourceError::NoVelocity {
            path: self.path().into(),
            lacking: lacking.what,
            candidates: list_candidates(self.header()),
        })?;
        let header = self.header();
        for other in [Some(&found.v), found.w.as_ref()].into_iter().flatten() {
            if !velocity::same_dimensions(header, found.u.variable, other.variable) {
                let (a, b) = (&header.variables[found.u.variable], &header.variables[other.variable]);
                return Err(SourceError::Staggered {
                    path: self.path().into(),
                    first: a.name.clone(),
                    first_dimensions: header.dimension_names(a),
                    second: b.name.clone(),
                    second_dimensions: header.dimension_names(b),
                });
            }
        }
        let mut names: Vec<String> = found.others.iter().map(|o| format!("`{}`", header.variables[o.variable].name)).collect();
        if !names.is_empty() {
            names.dedup();
            self.notes.push(format!("also velocities, but passed over: {} ({})", names.join(", "), velocity::RULE));
        }
        Ok(found)
    }

    /// Dimension (and coordinate variable) that `x`, `y` or `z` of the settings names.
    fn named_axis(&self, key: &str, name: &Option<String>) -> Result<Option<(usize, Option<usize>)>, SourceError> {
        let Some(name) = name else { return Ok(None) };
        let header = self.header();
        if let Some(variable) = header.find(name) {
            return match header.variables[variable].dimensions[..] {
                [dimension] => Ok(Some((dimension, Some(variable)))),
                ref dims => {
                    Err(self.misfit(variable, format!("`{key}` must name a coordinate of one dimension, this one has {}", dims.len())))
                }
            };
        }
        match header.dimensions.iter().position(|d| d.name == *name) {
            Some(dimension) => Ok(Some((dimension, None))),
            None => Err(self.not_found(key, name)),
        }
    }

    /// The dimensions of `u` with more than one entry, and horizontal and time ones of any length.
    fn extents(&mut self, u: usize) -> Result<Vec<Extent>, SourceError> {
        let s = self.settings;
        let mut overrides = Vec::new();
        for (key, name, kind) in [("x", &s.x, Kind::X), ("y", &s.y, Kind::Y), ("z", &s.z, Kind::Level), ("time", &s.time, Kind::Time)] {
            // A scalar time variable is found later.
            let scalar = key == "time"
                && name.as_ref().and_then(|n| self.header().find(n)).is_some_and(|v| self.header().variables[v].dimensions.is_empty());
            if let Some((dimension, coordinate)) = if scalar { None } else { self.named_axis(key, name)? } {
                overrides.push((dimension, coordinate, kind));
            }
        }
        let header = self.header();
        let mut extents = Vec::new();
        let mut squeezed = Vec::new();
        for &dimension in &header.variables[u].dimensions {
            let Dim { kind, coordinate } = match overrides.iter().find(|o| o.0 == dimension) {
                Some(&(_, coordinate, kind)) => {
                    let measured = coordinate.map_or(Kind::Unknown, |c| classify(&header.variables[c]));
                    // The setting says which axis it is, the file whether it is an angle.
                    let kind = match (kind, measured) {
                        (Kind::X, Kind::Longitude) => Kind::Longitude,
                        (Kind::Y, Kind::Latitude) => Kind::Latitude,
                        _ => kind,
                    };
                    Dim { kind, coordinate }
                }
                None => self.measure(dimension),
            };
            if header.dimensions[dimension].len == 1 && !kind.is_horizontal() && kind != Kind::Time {
                squeezed.push(header.dimensions[dimension].name.clone());
                continue;
            }
            extents.push(Extent { dimension, kind, coordinate });
        }
        if !squeezed.is_empty() {
            self.notes.push(format!("dimensions of one entry left out: {}", squeezed.join(", ")));
        }
        Ok(extents)
    }

    /// Finds a dimension's coordinate variable and what it measures.
    fn measure(&self, dimension: usize) -> Dim {
        let header = self.header();
        let name = &header.dimensions[dimension].name;
        let own = |i: &usize| header.variables[*i].dimensions == [dimension] && header.variables[*i].number != NumberType::Other;
        let candidates: Vec<usize> = (0..header.variables.len()).filter(own).collect();
        let known = |&i: &usize| classify(&header.variables[i]) != Kind::Unknown;
        let coordinate = candidates
            .iter()
            .copied()
            .find(|&i| header.variables[i].name == *name)
            .or_else(|| candidates.iter().copied().find(known))
            .or_else(|| (candidates.len() == 1).then(|| candidates[0]));
        let kind = match coordinate.map(|c| classify(&header.variables[c])) {
            None | Some(Kind::Unknown) => classify_name(name),
            Some(kind) => kind,
        };
        Dim { kind, coordinate }
    }

    /// Gives dimensions that nothing is known about the place that their order suggests: x last, y before it, then levels.
    fn name_by_position(&mut self, u: usize, extents: &mut [Extent]) -> Result<(), SourceError> {
        let has = |extents: &[Extent], kinds: [Kind; 2]| extents.iter().any(|e| kinds.contains(&e.kind));
        for i in (0..extents.len()).rev() {
            if extents[i].kind != Kind::Unknown {
                continue;
            }
            let name = self.header().dimensions[extents[i].dimension].name.clone();
            let (kind, axis) = if !has(extents, [Kind::X, Kind::Longitude]) {
                (Kind::X, "x")
            } else if !has(extents, [Kind::Y, Kind::Latitude]) {
                (Kind::Y, "y")
            } else if !has(extents, [Kind::Level; 2]) && extents[i].coordinate.is_some() {
                (Kind::Level, "z")
            } else {
                let entries = self.header().dimensions[extents[i].dimension].len;
                let what = format!(
                    "dimension `{name}` has {entries} entries, but is neither time nor x, y or level; name the axes with `x`, `y`, `z`, `time`"
                );
                return Err(self.misfit(u, what));
            };
            extents[i].kind = kind;
            self.notes.push(format!("dimension `{name}` is taken as {axis} by its position"));
        }
        for (kinds, what) in
            [([Kind::X, Kind::Longitude], "x"), ([Kind::Y, Kind::Latitude], "y"), ([Kind::Level; 2], "z"), ([Kind::Time; 2], "time")]
        {
            let found: Vec<&str> =
                extents.iter().filter(|e| kinds.contains(&e.kind)).map(|e| self.header().dimensions[e.dimension].name.as_str()).collect();
            let optional = what == "z" || what == "time";
            if found.len() > 1 || (found.is_empty() && !optional) {
                let dims = self.header().dimension_names(&self.header().variables[u]);
                let which = if found.is_empty() { "no dimension".into() } else { found.join(" and ") };
                return Err(self.misfit(u, format!("of its dimensions ({dims}), {which} would be {what}; name it with `{what} = \"...\"`")));
            }
        }
        Ok(())
    }

    /// Dimension and index of the level that the settings pick.
    fn pick_level(&mut self, extents: &mut [Extent]) -> Result<Option<(usize, usize)>, SourceError> {
        let Some(wanted) = self.settings.level else { return Ok(None) };
        let fault = |found: String, accepted: String| SourceError::Setting { key: "level", found: format!("{wanted} ({found})"), accepted };
        let Some(extent) = extents.iter().find(|e| e.kind == Kind::Level) else {
            return Err(fault(format!("{} has no level axis", self.path().display()), "leave `level` out".into()));
        };
        let Some(coordinate) = extent.coordinate else {
            return Err(fault("the level axis has no coordinates".into(), "name them with `z`".into()));
        };
        let values = self.coordinate_values(coordinate)?;
        let scale = values.iter().fold(0.0f64, |m, v| m.max(v.abs()));
        // Four roundings of f32 are the same level.
        let hit = values.iter().position(|v| (v - wanted).abs() <= 4.0 * f64::from(f32::EPSILON) * scale);
        let Some(index) = hit else {
            let units = self.header().variables[coordinate].units().unwrap_or_default();
            let list = values.iter().map(f64::to_string).collect::<Vec<_>>().join(", ");
            return Err(fault("no such level".into(), format!("levels of {} are {list} {units}", self.path().display())));
        };
        self.notes.push(format!("level {wanted} picked (entry {index} of `{}`)", self.header().variables[coordinate].name));
        Ok(Some((extent.dimension, index)))
    }

    fn coordinate_values(&self, variable: usize) -> Result<Vec<f64>, SourceError> {
        let header = &self.header().variables[variable];
        let count: usize = self.header().shape(header).iter().product();
        if count > LONGEST_AXIS {
            return Err(self.misfit(variable, format!("{count} coordinates are too many; accepted are up to {LONGEST_AXIS}")));
        }
        let packing = Packing::of(header);
        Ok(self.file.read_all(variable)?.into_iter().map(|v| packing.unpack(v)).collect())
    }

    fn metric(&mut self, extents: &[Extent], three: bool) -> Result<Metric, SourceError> {
        let has = |kind| extents.iter().any(|e| e.kind == kind);
        let sphere = has(Kind::Longitude) && has(Kind::Latitude);
        let fault =
            |found: &str, accepted: &str| Err(SourceError::Setting { key: "metric", found: found.into(), accepted: accepted.into() });
        match (self.settings.metric, self.settings.velocity_unit) {
            (Some(Metric::Sphere), _) if !sphere => {
                fault("sphere", "the axes are not longitude and latitude; accepted are index and cartesian")
            }
            (Some(Metric::Sphere), _) if three => fault(
                "sphere",
                "with levels the sphere metric is not available yet; pick one with `level = ...` or set `metric = \"index\"`",
            ),
            (Some(metric), VelocityUnit::Cells) if metric != Metric::Index => {
                fault(&format!("{metric:?}").to_lowercase(), "velocities in cells want `metric = \"index\"`")
            }
            (Some(metric), _) => Ok(metric),
            (None, VelocityUnit::Cells) => Ok(Metric::Index),
            (None, VelocityUnit::Si) if sphere && three => {
                self.notes
                    .push("longitude, latitude and levels: metric index (cells and snapshots); `level = ...` gives the sphere".into());
                Ok(Metric::Index)
            }
            (None, VelocityUnit::Si) => Ok(if sphere { Metric::Sphere } else { Metric::Cartesian }),
        }
    }

    fn axis(&self, u: usize, extent: &Extent, k: usize) -> Result<AxisPlan, SourceError> {
        let header = self.header();
        let (name, len) = (&header.dimensions[extent.dimension].name, header.dimensions[extent.dimension].len);
        if len < 2 {
            return Err(SourceError::Axis { path: self.path().into(), fault: AxisFault::TooShort { name: name.clone(), found: len } });
        }
        let range = self.settings.region.and_then(|r| [Some([r[0], r[1]]), Some([r[2], r[3]]), None][k]);
        let in_cells = self.settings.velocity_unit == VelocityUnit::Cells;
        let Some(coordinate) = extent.coordinate else {
            if !in_cells {
                return Err(self.misfit(u, self.without_coordinates(extent.dimension)));
            }
            let fault = |fault| SourceError::Axis { path: self.path().into(), fault };
            let axis = Axis::uniform(name.as_str(), "", 0.0, (len - 1) as f64, len).map_err(fault)?;
            let notes = vec![format!("`{name}` has no coordinates: counted from 0")];
            return Ok(AxisPlan { kind: extent.kind, axis, order: (0..len).collect(), notes, quantity: Quantity::None, descending: false });
        };
        let variable = &header.variables[coordinate];
        let coordinates = Coordinates {
            path: self.path(),
            name: &variable.name,
            units: variable.units(),
            positive_down: variable.text("positive").is_some_and(|p| p.eq_ignore_ascii_case("down"))
                || (variable.text("positive").is_none() && variable.text("standard_name") == Some("depth")),
            kind: extent.kind,
            values: self.coordinate_values(coordinate)?,
        };
        coordinates.plan(range)
    }

    fn without_coordinates(&self, dimension: usize) -> String {
        let header = self.header();
        let name = &header.dimensions[dimension].name;
        let wide: Vec<&str> = header
            .variables
            .iter()
            .filter(|v| {
                v.dimensions.len() >= 2 && v.dimensions.contains(&dimension) && matches!(classify(v), Kind::Longitude | Kind::Latitude)
            })
            .map(|v| v.name.as_str())
            .collect();
        let why = if wide.is_empty() {
            "has no coordinate variable".into()
        } else {
            format!("has only coordinates of two dimensions ({}): curvilinear grids are not read yet", wide.join(", "))
        };
        format!(
            "dimension `{name}` {why}. Name a coordinate variable with `x`, `y` or `z`, or set `velocity_unit = \"cells\"` if its values are cells per snapshot interval"
        )
    }

    fn component(&mut self, candidate: &Candidate, roles: &[(usize, Role)], axis: Option<&AxisPlan>) -> Result<ComponentPlan, SourceError> {
        let variable = &self.header().variables[candidate.variable];
        let component = candidate.component.name();
        let role = |d: &usize| roles.iter().find(|r| r.0 == *d).map_or(Role::Fixed(0), |r| r.1);
        let factor = if self.settings.velocity_unit == VelocityUnit::Cells {
            1.0
        } else {
            let text = variable.units().unwrap_or_default();
            let unit = Unit::parse(text);
            let quantity = axis.map_or(Quantity::Length, |a| a.quantity);
            match unit {
                Some(u) if u.is_dimensionless() => {
                    let note = format!("{component}: `{}` has no unit: taken as SI", variable.name);
                    self.notes.push(note);
                    1.0
                }
                Some(u) if u.is_velocity() && quantity != Quantity::Pressure => u.factor,
                Some(u) if u.is_pressure_tendency() && quantity == Quantity::Pressure => u.factor,
                Some(u) if u.is_velocity() || u.is_pressure_tendency() => {
                    let (name, axis) =
                        (variable.name.clone(), axis.map(|a| (a.axis.name().to_owned(), a.axis.units().to_owned())).unwrap_or_default());
                    let what = format!(
                        "its unit `{text}` does not fit the axis `{}` in `{}`; name another with `{component} = \"...\"`{}",
                        axis.0,
                        axis.1,
                        if component == "w" { ", or ignore vertical motion with `w = \"none\"`" } else { "" }
                    );
                    return Err(SourceError::Layout { path: self.path().into(), variable: name, what });
                }
                _ => {
                    return Err(SourceError::UnknownUnit {
                        path: self.path().into(),
                        variable: variable.name.clone(),
                        unit: text.into(),
                        accepted: VELOCITY_UNITS.into(),
                    });
                }
            }
        };
        let variable = &self.header().variables[candidate.variable];
        Ok(ComponentPlan {
            name: variable.name.clone(),
            shape: self.header().shape(variable),
            roles: variable.dimensions.iter().map(role).collect(),
            packing: Packing::of(variable),
            factor,
            why: candidate.why.clone(),
        })
    }

    fn time(&mut self, extents: &[Extent]) -> Result<TimePlan, SourceError> {
        let header = self.header();
        let fault = |what: String| SourceError::Time { path: self.path().into(), what };
        let dimension = extents.iter().find(|e| e.kind == Kind::Time);
        let single =
            |i: &usize| header.shape(&header.variables[*i]).iter().product::<usize>() == 1 && classify(&header.variables[*i]) == Kind::Time;
        let variable = match (&self.settings.time, dimension) {
            (Some(name), _) if header.find(name).is_some() => header.find(name),
            (_, Some(extent)) => extent.coordinate,
            (_, None) => (0..header.variables.len()).find(single),
        };
        let Some(index) = variable else {
            let times: Vec<&str> = header.variables.iter().filter(|v| classify(v) == Kind::Time).map(|v| v.name.as_str()).collect();
            let found =
                if times.is_empty() { "no time variable".into() } else { format!("no numeric time variable, only {}", times.join(", ")) };
            return Err(fault(format!("{found}; name one with `time = \"...\"`, in {TIME_UNITS}")));
        };
        let variable = &header.variables[index];
        let name = variable.name.clone();
        let expected = dimension.map_or(1, |e| header.dimensions[e.dimension].len);
        let units = variable.units().unwrap_or_default().to_owned();
        let calendar_name = variable.text("calendar").unwrap_or_default();
        let Some(calendar) = Calendar::parse(calendar_name) else {
            return Err(fault(format!("calendar `{calendar_name}` of `{name}` is unknown; accepted are {CALENDARS}")));
        };
        let Some(unit) = TimeUnit::parse(&units, calendar) else {
            return Err(fault(format!(
                "unit `{units}` of `{name}` (calendar {}) is not understood; accepted are {TIME_UNITS}",
                calendar.name()
            )));
        };
        let seconds: Vec<f64> = self.coordinate_values(index)?.into_iter().map(|v| unit.seconds(v)).collect();
        if seconds.is_empty() || seconds.len() != expected {
            return Err(fault(format!("`{name}` holds {} times for {expected} snapshots", seconds.len())));
        }
        if let Some(i) = seconds.iter().position(|s| !s.is_finite()) {
            return Err(fault(format!("entry {i} of `{name}` is missing or not a number")));
        }
        if let Some(i) = (1..seconds.len()).find(|&i| seconds[i] <= seconds[i - 1]) {
            let show = |s: f64| unit.calendar.and_then(|c| c.iso(s)).unwrap_or_else(|| s.to_string());
            let (before, here) = (show(seconds[i - 1]), show(seconds[i]));
            return Err(fault(format!("entry {i} of `{name}` is {here}, the one before it {before}; times must ascend")));
        }
        Ok(TimePlan { variable: name, units, seconds, calendar: unit.calendar })
    }
}

struct Dim {
    kind: Kind,
    coordinate: Option<usize>,
}

/// One line a variable: what it is, or what it lacks.
pub(super) fn list_candidates(header: &Header) -> String {
    let line = |i: usize| {
        let variable = &header.variables[i];
        let verdict = match velocity::judge(header, i) {
            Ok(candidate) => format!("may be {} ({})", candidate.component.name(), candidate.why),
            Err(lacks) => lacks,
        };
        format!("  {} ({}): {verdict}", variable.name, header.dimension_names(variable))
    };
    (0..header.variables.len()).map(line).collect::<Vec<_>>().join("\n")
}
