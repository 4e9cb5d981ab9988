//! What the dimensions of the velocity are: by coordinate variables, by the settings, at last by position.

use super::SourceError;
use super::cf::coordinate::{Kind, classify, classify_name};
use super::container::NumberType;
use super::layout::Planner;

/// Longest coordinate variable that is read: none is longer, and a damaged header must not fill the memory.
const LONGEST_AXIS: usize = 1 << 26;

/// A dimension of u on its way to a role.
pub(super) struct Extent {
    pub(super) dimension: usize,
    pub(super) kind: Kind,
    pub(super) coordinate: Option<usize>,
}

/// What is known about a dimension.
struct Dim {
    kind: Kind,
    coordinate: Option<usize>,
}

impl Planner<'_> {
    /// Dimension (and coordinate variable) that `x`, `y` or `z` of the settings names.
    fn named_axis(&self, key: &str, name: &Option<String>) -> Result<Option<(usize, Option<usize>)>, SourceError> {
        let Some(name) = name else { return Ok(None) };
        let header = self.header();
        if let Some(variable) = header.find(name) {
            return match header.variables[variable].dimensions[..] {
                [dimension] => Ok(Some((dimension, Some(variable)))),
                // Rows of characters.
                [dimension, _] if header.variables[variable].number == NumberType::Text => Ok(Some((dimension, Some(variable)))),
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
    pub(super) fn extents(&mut self, u: usize) -> Result<Vec<Extent>, SourceError> {
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

    /// A dimension with its coordinate variable and what it measures, whatever the settings say.
    pub(super) fn measured(&self, dimension: usize) -> Extent {
        let Dim { kind, coordinate } = self.measure(dimension);
        Extent { dimension, kind, coordinate }
    }

    /// Finds a dimension's coordinate variable and what it measures.
    fn measure(&self, dimension: usize) -> Dim {
        let header = self.header();
        let name = &header.dimensions[dimension].name;
        let own = |i: &usize| header.variables[*i].dimensions == [dimension] && header.variables[*i].number.is_number();
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
    pub(super) fn name_by_position(&mut self, u: usize, extents: &mut [Extent]) -> Result<(), SourceError> {
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
    pub(super) fn pick_level(&mut self, extents: &mut [Extent]) -> Result<Option<(usize, usize)>, SourceError> {
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

    pub(super) fn coordinate_values(&self, variable: usize) -> Result<Vec<f64>, SourceError> {
        let header = &self.header().variables[variable];
        let count: usize = self.header().shape(header).iter().product();
        if count > LONGEST_AXIS {
            return Err(self.misfit(variable, format!("{count} coordinates are too many; accepted are up to {LONGEST_AXIS}")));
        }
        let packing = self.packing(variable)?;
        Ok(self.file.read_all(variable)?.into_iter().map(|v| packing.unpack(v)).collect())
    }
}
