//! Meaning of the dimensions of the velocity: by coordinate variables, then by the settings, then by position.

use super::planner::Planner;
use crate::cf::coordinate::{Kind, classify, classify_name};
use crate::cf::units::Unit;
use crate::error::SourceError;
use crate::formats::{NumberType, Variable};

/// Longest coordinate variable that is read: a damaged header must not exhaust the memory.
const MAX_COORDINATES: usize = 1 << 26;
/// Levels that differ by less than this share of the largest are the same: four roundings of f32.
const SAME_LEVEL: f64 = 4.0 * f32::EPSILON as f64;
/// Most nodes along an axis: single precision tells no more apart.
const MAX_NODES: usize = 1 << 24;

/// A dimension, what it measures and its coordinate variable.
#[derive(Clone, Copy, PartialEq)]
pub struct Extent {
    pub dimension: usize,
    pub kind: Kind,
    pub coordinate: Option<usize>,
}

impl Planner<'_> {
    /// Dimension (and coordinate variable) that `x`, `y` or `z` of the settings names.
    fn named_axis(&self, key: &str, name: &Option<String>) -> Result<Option<(usize, Option<usize>)>, SourceError> {
        let Some(name) = name else { return Ok(None) };
        if let Some(variable) = self.listing().find(name) {
            return match self.variable(variable).dimensions[..] {
                [dimension] => Ok(Some((dimension, Some(variable)))),
                // Rows of characters.
                [dimension, _] if self.variable(variable).number == NumberType::Text => Ok(Some((dimension, Some(variable)))),
                ref dims => {
                    Err(self.misfit(variable, format!("`{key}` must name a coordinate of one dimension, this one has {}", dims.len())))
                }
            };
        }
        match self.listing().dimensions.iter().position(|d| d.name == *name) {
            Some(dimension) => Ok(Some((dimension, None))),
            None => Err(self.not_found(key, name)),
        }
    }

    /// The dimensions of `u` with more than one entry, and horizontal and time dimensions of any length.
    pub fn extents(&mut self, u: usize) -> Result<Vec<Extent>, SourceError> {
        let s = self.settings;
        let mut overrides = Vec::new();
        let is_pair = self.named_points().is_some() || self.named_pair()?.is_some();
        for (key, name, kind) in [("x", &s.x, Kind::X), ("y", &s.y, Kind::Y), ("z", &s.z, Kind::Level), ("time", &s.time, Kind::Time)] {
            // A scalar time variable is found later.
            let variable = name.as_ref().and_then(|n| self.listing().find(n));
            let scalar = key == "time" && variable.is_some_and(|v| self.variable(v).dimensions.is_empty());
            let aside = scalar || (is_pair && matches!(key, "x" | "y")) || (key == "z" && self.named_heights().is_some());
            if let Some((dimension, coordinate)) = if aside { None } else { self.named_axis(key, name)? } {
                // The setting says which axis it is, the file whether it is an angle.
                let kind = match (kind, coordinate.map(|c| classify(self.variable(c)))) {
                    (Kind::X, Some(Kind::Longitude)) => Kind::Longitude,
                    (Kind::Y, Some(Kind::Latitude)) => Kind::Latitude,
                    _ => kind,
                };
                overrides.push(Extent { dimension, kind, coordinate });
            }
        }
        for (name, &entry) in s.select.iter().flatten() {
            let found = self.variable(u).dimensions.iter().map(|&d| &self.listing().dimensions[d]).find(|d| d.name == *name);
            if found.is_none_or(|d| entry >= d.len) {
                let accepted = match found {
                    Some(d) => format!("entries of `{name}` are counted from 0 to {}", d.len.saturating_sub(1)),
                    None => format!("dimensions of `{}` are {}", self.variable(u).name, self.dimensions_of(u).join(", ")),
                };
                return Err(SourceError::setting("select", format!("{{ {name} = {entry} }}"), accepted));
            }
        }
        let mut extents = Vec::new();
        let mut squeezed = Vec::new();
        for &dimension in &self.variable(u).dimensions {
            let known = overrides.iter().find(|o| o.dimension == dimension);
            let mut extent = known.copied().unwrap_or_else(|| self.measured(dimension));
            let found = &self.listing().dimensions[dimension];
            if let (Some(entry), false) = (s.entry(&found.name), extent.kind == Kind::Time) {
                let value = extent.coordinate.map(|c| self.coordinate_values(c)).transpose()?.and_then(|values| values.get(entry).copied());
                let value = value.map_or_else(String::new, |value| format!(" ({value})"));
                self.note(format!("entry {entry}{value} of `{}`, as set", found.name));
                continue;
            }
            extent.kind = self.stated_kind(extent);
            if found.len == 1 && !extent.kind.is_horizontal() && extent.kind != Kind::Time {
                squeezed.push(found.name.as_str());
            } else {
                extents.push(extent);
            }
        }
        if !squeezed.is_empty() {
            self.note(format!("dimensions of one entry left out: {}", squeezed.join(", ")));
        }
        Ok(extents)
    }

    /// What a dimension measures if the settings state its unit: degrees make a longitude or latitude, metres do not.
    fn stated_kind(&self, extent: Extent) -> Kind {
        let Some(unit) = extent.coordinate.and_then(|c| self.axis_units(extent.kind, c)) else { return extent.kind };
        let angle = unit.to_ascii_lowercase().starts_with("degree") || unit.to_ascii_lowercase().starts_with("radian");
        let length = Unit::parse(unit).is_some_and(|u| u.is_length());
        match extent.kind {
            Kind::X if angle => Kind::Longitude,
            Kind::Y if angle => Kind::Latitude,
            Kind::Longitude if length => Kind::X,
            Kind::Latitude if length => Kind::Y,
            other => other,
        }
    }

    /// A dimension with its coordinate variable and what it measures, regardless of the settings.
    pub fn measured(&self, dimension: usize) -> Extent {
        let name = &self.listing().dimensions[dimension].name;
        // The number of a column tells no place.
        let counts = |v: &Variable| v.text("standard_name").is_some_and(|name| name.contains("grid_index"));
        let fits = |v: &Variable| v.dimensions == [dimension] && v.number.is_number() && !counts(v);
        let candidates: Vec<usize> = self.listing().matching(fits).collect();
        let first = |fits: &dyn Fn(usize) -> bool| candidates.iter().copied().find(|&i| fits(i));
        let coordinate = first(&|i| self.variable(i).name == *name)
            .or_else(|| first(&|i| classify(self.variable(i)) != Kind::Unknown))
            .or_else(|| (candidates.len() == 1).then(|| candidates[0]));
        let kind = match coordinate.map(|c| classify(self.variable(c))) {
            None | Some(Kind::Unknown) => classify_name(name),
            Some(kind) => kind,
        };
        Extent { dimension, kind, coordinate }
    }

    /// Gives unknown dimensions the meaning that their order suggests: x last, y before it, then levels.
    pub fn name_by_position(&mut self, u: usize, extents: &mut [Extent]) -> Result<(), SourceError> {
        let has = |extents: &[Extent], kinds: [Kind; 2]| extents.iter().any(|e| kinds.contains(&e.kind));
        for i in (0..extents.len()).rev().filter(|&i| extents[i].kind == Kind::Unknown).collect::<Vec<_>>() {
            let dimension = &self.listing().dimensions[extents[i].dimension];
            let (kind, axis) = if !has(extents, [Kind::X, Kind::Longitude]) {
                (Kind::X, "x")
            } else if !has(extents, [Kind::Y, Kind::Latitude]) {
                (Kind::Y, "y")
            } else if !has(extents, [Kind::Level; 2])
                && extents[i].coordinate.is_some_and(|c| !self.counts_members(extents[i].dimension, c))
            {
                (Kind::Level, "z")
            } else {
                let what = format!(
                    "dimension `{}` has {} entries, but is neither time nor x, y or level; pick one entry with --set archive.select.{}=0, or \
                     name the axes with --set archive.x=NAME, archive.y, archive.z, archive.time",
                    dimension.name, dimension.len, dimension.name
                );
                return Err(self.misfit(u, what));
            };
            extents[i].kind = kind;
            self.note(format!("dimension `{}` is taken as {axis} by its position", dimension.name));
        }
        for (kinds, what) in
            [([Kind::X, Kind::Longitude], "x"), ([Kind::Y, Kind::Latitude], "y"), ([Kind::Level; 2], "z"), ([Kind::Time; 2], "time")]
        {
            let found = extents.iter().filter(|e| kinds.contains(&e.kind));
            let found: Vec<&str> = found.map(|e| self.listing().dimensions[e.dimension].name.as_str()).collect();
            let optional = what == "z" || what == "time";
            if found.len() > 1 || (found.is_empty() && !optional) {
                let dims = self.listing().dimension_names(self.variable(u));
                let which = if found.is_empty() { "no dimension".into() } else { found.join(" and ") };
                let mesh = match (what, &found[..]) {
                    ("y", []) => "; of points on an unstructured mesh, name the file of their longitudes and latitudes too",
                    _ => "",
                };
                return Err(self.misfit(
                    u,
                    format!("of its dimensions ({dims}), {which} would be {what}; name it with --set archive.{what}=NAME{mesh}"),
                ));
            }
        }
        Ok(())
    }

    /// True if the entries of a dimension are members of an ensemble.
    fn counts_members(&self, dimension: usize, coordinate: usize) -> bool {
        let name = self.listing().dimensions[dimension].name.to_ascii_lowercase();
        self.variable(coordinate).text("standard_name") == Some("realization")
            || ["number", "member", "realization", "realisation", "ensemble", "ens"]
                .iter()
                .any(|word| name == *word || name == format!("{word}s"))
            || name.starts_with("ensemble_")
            || name.ends_with("_member")
    }

    /// Dimension and index of the level that the settings pick.
    pub fn pick_level(&mut self, extents: &[Extent]) -> Result<Option<(usize, usize)>, SourceError> {
        let Some(wanted) = self.settings.level else { return Ok(None) };
        let file = self.path().display();
        let fault = |found: String, accepted: String| SourceError::setting("level", format!("{wanted} ({found})"), accepted);
        let Some(extent) = extents.iter().find(|e| e.kind == Kind::Level) else {
            return Err(fault(format!("{file} has no level axis"), "left out".into()));
        };
        let Some(coordinate) = extent.coordinate else {
            return Err(fault("the level axis has no coordinates".into(), "the axis named with --set archive.z=NAME".into()));
        };
        let values = self.coordinate_values(coordinate)?;
        let variable = self.variable(coordinate);
        let scale = values.iter().fold(0.0f64, |m, v| m.max(v.abs()));
        let Some(index) = values.iter().position(|v| (v - wanted).abs() <= SAME_LEVEL * scale) else {
            let list = values.iter().map(f64::to_string).collect::<Vec<_>>().join(", ");
            let units = variable.units().unwrap_or_default();
            return Err(fault("no such level".into(), format!("levels of {file} are {list} {units}")));
        };
        self.note(format!("level {wanted} picked (entry {index} of `{}`)", variable.name));
        Ok(Some((extent.dimension, index)))
    }

    /// The level of u that is read alone: by `level`, or by an entry that is selected along its levels.
    pub fn level_of_u(&self, u: usize, level: Option<(usize, usize)>) -> Option<(usize, usize)> {
        let selected = |&d: &usize| Some((d, self.settings.entry(&self.listing().dimensions[d].name)?));
        let levels = self.variable(u).dimensions.iter().filter(|&&d| self.measured(d).kind == Kind::Level);
        level.or_else(|| levels.filter_map(selected).next())
    }

    /// Entry along the levels of another component that is the level of u which is read alone.
    ///
    /// # Errors
    /// It has no such level.
    pub fn same_level(&self, variable: usize, dimension: usize, (of_u, entry): (usize, usize)) -> Result<usize, SourceError> {
        let name = |d: usize| &self.listing().dimensions[d].name;
        if let Some(selected) = self.settings.entry(name(dimension)) {
            return Ok(selected);
        }
        if dimension == of_u {
            return Ok(entry);
        }
        let values = |d: usize| self.measured(d).coordinate.map(|c| self.coordinate_values(c)).transpose();
        let (Some(own), Some(levels)) = (values(dimension)?, values(of_u)?) else {
            let what = format!("nothing tells which of its levels `{}` is entry {entry} of `{}`", name(dimension), name(of_u));
            return Err(self.misfit(variable, what));
        };
        let (wanted, scale) = (levels[entry], own.iter().fold(0.0f64, |m, v| m.max(v.abs())));
        own.iter().position(|v| (v - wanted).abs() <= SAME_LEVEL * scale).ok_or_else(|| {
            let list = own.iter().map(f64::to_string).collect::<Vec<_>>().join(", ");
            self.misfit(
                variable,
                format!("it has no level at {wanted} (entry {entry} of `{}`): its levels `{}` are {list}", name(of_u), name(dimension)),
            )
        })
    }

    /// Refuses a variable whose dimensions its file cannot hold, before coordinates are made for them: each, and the last two, of
    /// which a snapshot has every entry. The first one may be time.
    pub fn check_extents(&self, variable: usize) -> Result<(), SourceError> {
        let shape = self.shape(variable);
        self.listing().check_count(self.variable(variable), &shape[shape.len().saturating_sub(2)..])?;
        for (place, len) in shape.into_iter().enumerate() {
            self.listing().check_count(self.variable(variable), &[len])?;
            // Points of an unstructured mesh are no axis.
            if place > 0 && len > MAX_NODES && !self.is_along_mesh(self.variable(variable).dimensions[place]) {
                return Err(self.misfit(variable, format!("{len} nodes along a dimension are too many; accepted are up to {MAX_NODES}")));
            }
        }
        Ok(())
    }

    /// All values of a coordinate variable, unpacked.
    pub fn coordinate_values(&self, variable: usize) -> Result<Vec<f64>, SourceError> {
        let count = self.shape(variable).into_iter().fold(1, usize::saturating_mul);
        if count > MAX_COORDINATES {
            return Err(self.misfit(variable, format!("{count} coordinates are too many; accepted are up to {MAX_COORDINATES}")));
        }
        let packing = self.packing(variable)?;
        Ok(self.file.read_all(variable)?.into_iter().map(|v| packing.unpack(v)).collect())
    }
}
