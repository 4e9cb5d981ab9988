//! What a file holds, as far as the velocity needs it: components, axes, times.

use super::SourceError;
use super::axes::{AxisPlan, Coordinates, Quantity};
use super::cf::calendar::Calendar;
use super::cf::coordinate::{Kind, classify};
use super::cf::packing::Packing;
use super::cf::units::{Unit, VELOCITY_UNITS};
use super::cf::velocity::{self, Candidate, Velocity};
use super::container::{Container, Format, Header};
use super::curvilinear::Curvilinear;
use super::dimensions::Extent;
use super::poles::Poles;
use super::settings::{ArchiveSettings, Metric, VelocityUnit};
use super::staggered::Staggered;
use super::times::TimePlan;
use super::vertical::to_heights;
use crate::field::{Axis, AxisFault};
use std::path::Path;
use std::sync::Arc;

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

#[cfg(test)]
impl ComponentPlan {
    /// Something to fill a field with.
    pub(super) fn test() -> Self {
        let variable = super::container::Variable {
            name: String::new(),
            number: super::container::NumberType::F32,
            dimensions: Vec::new(),
            attributes: Vec::new(),
        };
        let packing = Packing::of(&variable).unwrap_or_else(|fault| panic!("{fault}"));
        Self { name: String::new(), shape: Vec::new(), roles: Vec::new(), packing, factor: 1.0, why: String::new() }
    }
}

/// Everything.
#[derive(Debug, Clone)]
pub(super) struct Layout {
    /// u, v and, where there is one, w: one frame, or as many as there are datasets whose names carry a time.
    pub(super) frames: Vec<Vec<ComponentPlan>>,
    /// x, y and, in three dimensions, z, as the grid has them.
    pub(super) axes: Vec<AxisPlan>,
    /// Factors, a level each, from w in the file's SI to that along the grid's third axis; empty where they are 1.
    pub(super) vertical: Vec<f64>,
    pub(super) poles: Poles,
    pub(super) time: TimePlan,
    pub(super) metric: Metric,
    /// Where nodes of the grid are no nodes of the file.
    pub(super) resampling: Option<Arc<Resampling>>,
    /// Choices and conversions, in words.
    pub(super) notes: Vec<String>,
}

impl Layout {
    /// Names of the variables that the plan rests on.
    pub(super) fn used(&self, header: &Header) -> Vec<String> {
        let named = |name: &str| header.find(name).is_some();
        let mut names: Vec<String> = self.frames.iter().flatten().map(|c| c.name.clone()).collect();
        names.extend(self.axes.iter().map(|a| a.axis.name().to_owned()).filter(|n| named(n)));
        names.push(self.time.variable.clone());
        names
    }
}

/// How velocities come onto a grid whose nodes are not those of the file.
#[derive(Debug)]
pub(super) enum Resampling {
    Staggered(Box<Staggered>),
    Curvilinear(Box<Curvilinear>),
}

impl Resampling {
    /// Reads one time onto the grid; `levels` are the file's entries of the grid's levels, where it keeps them.
    pub(super) fn read(
        &self,
        file: &Container,
        frame: &[ComponentPlan],
        entry: usize,
        levels: &[usize],
    ) -> Result<Vec<Vec<f32>>, SourceError> {
        match self {
            Self::Staggered(s) => s.read(file, frame, entry),
            Self::Curvilinear(c) => c.read(file, frame, entry, levels),
        }
    }

    /// What is done, in words.
    pub(super) fn what(&self) -> &str {
        match self {
            Self::Staggered(s) => s.what(),
            Self::Curvilinear(c) => c.what(),
        }
    }

    /// Root mean square, over the nodes of the file, of what interpolation on the grid gives less what the file has; and of what it has.
    pub(super) fn error(&self, file: &Container, frame: &[ComponentPlan], entry: usize) -> Result<[f64; 2], SourceError> {
        match self {
            Self::Staggered(s) => s.error(file, frame, entry),
            Self::Curvilinear(c) => c.error(file, frame, entry),
        }
    }
}

/// The planning of one file, step by step.
pub(super) struct Planner<'a> {
    pub(super) file: &'a Container,
    pub(super) settings: &'a ArchiveSettings,
    pub(super) notes: Vec<String>,
}

/// Plans how to read a file. What is dear to plan is taken from the archive's first file, where there is one.
pub(super) fn plan(file: &Container, settings: &ArchiveSettings, first: Option<&Layout>) -> Result<Layout, SourceError> {
    let planner = Planner { file, settings, notes: Vec::new() };
    if file.format == Format::Hdf5 { planner.plan_hdf5() } else { planner.plan(first) }
}

impl Planner<'_> {
    pub(super) fn header(&self) -> &Header {
        &self.file.header
    }

    pub(super) fn path(&self) -> &Path {
        &self.file.path
    }

    pub(super) fn misfit(&self, variable: usize, what: String) -> SourceError {
        SourceError::Layout { path: self.path().into(), variable: self.header().variables[variable].name.clone(), what }
    }

    /// How a variable's numbers become values.
    pub(super) fn packing(&self, variable: usize) -> Result<Packing, SourceError> {
        Packing::of(&self.header().variables[variable]).map_err(|what| self.misfit(variable, what))
    }

    fn plan(mut self, first: Option<&Layout>) -> Result<Layout, SourceError> {
        let velocity = self.velocity()?;
        if self.is_staggered(&velocity) {
            return self.plan_staggered(&velocity, first);
        }
        if let Some(coordinates) = self.curvilinear_coordinates(&velocity)? {
            return self.plan_curvilinear(&velocity, coordinates, first);
        }
        self.one_grid(&velocity)?;
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
        let mut components =
            vec![self.component(&velocity.u, &roles, Some(&axes[0]))?, self.component(&velocity.v, &roles, Some(&axes[1]))?];
        components.extend(self.vertical_component(velocity.w.as_ref(), &roles, &axes, three)?);
        let (vertical, poles) = self.finish_axes(&mut axes, metric)?;
        let frames = vec![components];
        Ok(Layout { frames, axes, vertical, poles, time, metric, resampling: None, notes: self.notes })
    }

    /// The third component, where there is one and it is wanted.
    pub(super) fn vertical_component(
        &mut self,
        w: Option<&Candidate>,
        roles: &[(usize, Role)],
        axes: &[AxisPlan],
        three: bool,
    ) -> Result<Option<ComponentPlan>, SourceError> {
        match (w, three) {
            (Some(w), true) => return self.component(w, roles, axes.get(2)).map(Some),
            (Some(w), false) => {
                let name = &self.header().variables[w.variable].name;
                let note = format!("`{name}` is not used: the flow is read in two dimensions");
                self.notes.push(note);
            }
            (None, true) if self.settings.w.as_deref() == Some("none") => self.notes.push("vertical motion is ignored, as set".into()),
            (None, true) => self.notes.push("no vertical velocity found: it is taken as 0".into()),
            (None, false) => {}
        }
        Ok(None)
    }

    /// Turns levels into heights and closes the poles, where the metric wants it; gathers the notes of all axes.
    pub(super) fn finish_axes(&mut self, axes: &mut [AxisPlan], metric: Metric) -> Result<(Vec<f64>, Poles), SourceError> {
        let fault = |fault| SourceError::Axis { path: self.path().into(), fault };
        let mut vertical = Vec::new();
        if metric != Metric::Index
            && let Some(level) = axes.get(2)
        {
            let lowest = level.axis.first();
            if level.quantity == Quantity::Pressure && lowest <= 0.0 {
                let what = format!("a pressure of {lowest} Pa has no height; use `metric = \"index\"`, or another axis with `z`");
                return Err(SourceError::Layout { path: self.path().into(), variable: level.axis.name().into(), what });
            }
            let (level, factors) = to_heights(level.clone(), self.settings.vertical_scale.unwrap_or(1.0)).map_err(fault)?;
            axes[2] = level;
            vertical = factors;
        }
        let mut poles = Poles::default();
        if metric == Metric::Sphere {
            let (longitude, rest) = axes.split_at_mut(1);
            poles = Poles::close(&longitude[0], &mut rest[0]).map_err(fault)?;
        }
        for axis in axes.iter() {
            self.notes.extend(axis.notes.iter().cloned());
        }
        let kinds = (axes[0].kind, axes[1].kind);
        if kinds == (Kind::X, Kind::Y) && self.geographic_winds() {
            self.notes.push(
                "eastward and northward velocities are taken along x and y of the projection: its grid convergence is not applied".into(),
            );
        }
        Ok((vertical, poles))
    }

    /// Whether some standard name promises geographic directions.
    fn geographic_winds(&self) -> bool {
        let names =
            |v: &super::container::Variable| v.text("standard_name").is_some_and(|n| n == "eastward_wind" || n.starts_with("eastward_sea"));
        self.header().variables.iter().any(names)
    }

    /// Variable that a setting names.
    fn named(&self, key: &str, name: &Option<String>) -> Result<Option<usize>, SourceError> {
        let Some(name) = name else { return Ok(None) };
        self.header().find(name).map(Some).ok_or_else(|| self.not_found(key, name))
    }

    pub(super) fn not_found(&self, key: &str, name: &str) -> SourceError {
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
        let mut names: Vec<String> = found.others.iter().map(|o| format!("`{}`", header.variables[o.variable].name)).collect();
        if !names.is_empty() {
            names.dedup();
            self.notes.push(format!("also velocities, but passed over: {} ({})", names.join(", "), velocity::RULE));
        }
        Ok(found)
    }

    /// Refuses components on different points.
    fn one_grid(&self, found: &Velocity) -> Result<(), SourceError> {
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
        Ok(())
    }

    pub(super) fn metric(&mut self, extents: &[Extent], three: bool) -> Result<Metric, SourceError> {
        let has = |kind| extents.iter().any(|e| e.kind == kind);
        let sphere = has(Kind::Longitude) && has(Kind::Latitude);
        let level = extents.iter().find(|e| e.kind == Kind::Level).and_then(|e| e.coordinate);
        let unit = level.and_then(|c| Unit::parse(self.header().variables[c].units().unwrap_or_default()));
        let measured = unit.is_some_and(|u| u.is_length() || u.is_pressure());
        let fault =
            |found: &str, accepted: &str| Err(SourceError::Setting { key: "metric", found: found.into(), accepted: accepted.into() });
        match (self.settings.metric, self.settings.velocity_unit) {
            (Some(Metric::Sphere), _) if !sphere => {
                fault("sphere", "the axes are not longitude and latitude; accepted are index and cartesian")
            }
            (Some(Metric::Sphere), _) if three && !measured => {
                fault("sphere", "the levels are neither pressures nor lengths; pick one with `level = ...` or set `metric = \"index\"`")
            }
            (Some(metric), VelocityUnit::Cells) if metric != Metric::Index => {
                fault(&format!("{metric:?}").to_lowercase(), "velocities in cells want `metric = \"index\"`")
            }
            (Some(metric), _) => Ok(metric),
            (None, VelocityUnit::Cells) => Ok(Metric::Index),
            (None, VelocityUnit::Si) if sphere && three && !measured => {
                self.notes.push(
                    "the levels are neither pressures nor lengths: metric index (cells and snapshots); `level = ...` gives the sphere"
                        .into(),
                );
                Ok(Metric::Index)
            }
            (None, VelocityUnit::Si) => Ok(if sphere { Metric::Sphere } else { Metric::Cartesian }),
        }
    }

    pub(super) fn axis(&self, u: usize, extent: &Extent, k: usize) -> Result<AxisPlan, SourceError> {
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
            return Ok(AxisPlan { kind: extent.kind, axis, order: (0..len).collect(), notes, quantity: Quantity::None, in_file: None });
        };
        let variable = &header.variables[coordinate];
        Coordinates::of(self.path(), variable, extent.kind, self.coordinate_values(coordinate)?).plan(range, self.goes_round())
    }

    /// Whether longitudes that go round are to be periodic.
    pub(super) fn goes_round(&self) -> bool {
        self.settings.periodic.as_deref() != Some("none")
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
            format!("has only coordinates of two dimensions ({}), of which no longitude and latitude are a pair", wide.join(", "))
        };
        format!(
            "dimension `{name}` {why}. Name a coordinate variable with `x`, `y` or `z`, or set `velocity_unit = \"cells\"` if its values are cells per snapshot interval"
        )
    }

    pub(super) fn component(
        &mut self,
        candidate: &Candidate,
        roles: &[(usize, Role)],
        axis: Option<&AxisPlan>,
    ) -> Result<ComponentPlan, SourceError> {
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
            packing: self.packing(candidate.variable)?,
            factor,
            why: candidate.why.clone(),
        })
    }
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

/// First difference between two files that matters.
pub(super) fn difference(a: &Layout, b: &Layout) -> Option<String> {
    let names = |l: &Layout| l.frames[0].iter().map(|c| format!("`{}`", c.name)).collect::<Vec<_>>().join(", ");
    // Names of datasets may carry the time.
    if names(a) != names(b) && a.frames.len() == 1 && !a.time.variable.is_empty() {
        return Some(format!("their velocities are {} and {}", names(a), names(b)));
    }
    if a.axes.len() != b.axes.len() {
        return Some(format!("they have {} and {} axes", a.axes.len(), b.axes.len()));
    }
    for (x, y) in a.axes.iter().zip(&b.axes) {
        if x.axis == y.axis && x.order == y.order {
            continue;
        }
        let (one, two) = (&x.axis, &y.axis);
        if one == two {
            return Some(format!("axis `{}` is in another order", one.name()));
        }
        let show = |a: &Axis| format!("`{}` of {} nodes from {} to {} {}", a.name(), a.len(), a.first(), a.last(), a.units());
        let detail = match one.coordinates().iter().zip(two.coordinates()).position(|(p, q)| p != q) {
            Some(i) if one.len() == two.len() => format!(", first at node {i}: {} and {}", one.coordinates()[i], two.coordinates()[i]),
            _ => String::new(),
        };
        return Some(format!("their axes are {} and {}{detail}", show(one), show(two)));
    }
    let calendar = |l: &Layout| l.time.calendar.map_or("none", Calendar::name);
    (calendar(a) != calendar(b)).then(|| format!("their calendars are {} and {}", calendar(a), calendar(b)))
}
