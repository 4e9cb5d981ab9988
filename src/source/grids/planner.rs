//! The planner of one file, and what all plans share.

use super::axes::{AxisPlan, Quantity};
use super::column_field::HeightField;
use super::column_plan::Terrain;
use super::component::{ComponentPlan, Role};
use super::levels::to_heights;
use super::mask::{is_of_air, is_of_water};
use super::poles::Poles;
use crate::archive_settings::{ArchiveSettings, Metric, VelocityUnit};
use crate::cf::coordinate::Kind;
use crate::cf::packing::Packing;
use crate::cf::units::{Unit, VELOCITY_UNITS};
use crate::cf::velocity::{Candidate, judge, named};
use crate::error::SourceError;
use crate::formats::{DataFile, Listing, UNREADABLE, Variable};
use std::fmt::Display;
use std::path::Path;

/// Levels of analyses, hPa.
const STANDARD_PRESSURES: [f64; 37] = [
    1.0, 2.0, 3.0, 5.0, 7.0, 10.0, 20.0, 30.0, 50.0, 70.0, 100.0, 125.0, 150.0, 175.0, 200.0, 225.0, 250.0, 300.0, 350.0, 400.0, 450.0,
    500.0, 550.0, 600.0, 650.0, 700.0, 750.0, 775.0, 800.0, 825.0, 850.0, 875.0, 900.0, 925.0, 950.0, 975.0, 1000.0,
];

/// Plans one file.
pub struct Planner<'a> {
    pub file: &'a DataFile,
    pub settings: &'a ArchiveSettings,
    /// See [`super::layout::Layout::notes`].
    pub notes: Vec<String>,
    /// Fields of heights that were looked at, by their variable.
    pub fields_of_heights: Vec<(usize, HeightField)>,
}

impl<'a> Planner<'a> {
    pub fn new(file: &'a DataFile, settings: &'a ArchiveSettings) -> Self {
        Self { file, settings, notes: Vec::new(), fields_of_heights: Vec::new() }
    }

    pub fn listing(&self) -> &'a Listing {
        &self.file.listing
    }

    pub fn variable(&self, index: usize) -> &'a Variable {
        &self.file.listing.variables[index]
    }

    pub fn shape(&self, index: usize) -> Vec<usize> {
        self.listing().shape(self.variable(index))
    }

    /// Entry that is read of a dimension that is no axis.
    pub fn entry_of(&self, dimension: usize) -> usize {
        self.settings.entry(&self.listing().dimensions[dimension].name).unwrap_or(0)
    }

    /// Unit of a coordinate along an axis: the one that the settings state, else the file's.
    pub fn axis_units(&self, kind: Kind, index: usize) -> Option<&'a str> {
        let stated = match kind {
            Kind::Longitude | Kind::X => self.settings.unit("x"),
            Kind::Latitude | Kind::Y => self.settings.unit("y"),
            Kind::Level => self.settings.unit("z"),
            _ => None,
        };
        let own = || self.variable(index).units().filter(|text| !text.is_empty());
        stated.or_else(own).or_else(|| (kind == Kind::Level && self.are_hectopascals(index)).then_some("hPa"))
    }

    /// True for levels without a unit on which a variable tells changes of pressure, if their numbers fit (as in ARCO-ERA5).
    fn are_hectopascals(&self, index: usize) -> bool {
        let level = self.variable(index);
        let [dimension] = level.dimensions[..] else { return false };
        let named = ["level", "lev", "plev", "pressure", "pressure_level", "isobaric"].contains(&level.name.to_ascii_lowercase().as_str());
        let tells = |v: &Variable| {
            let unit = v.units().and_then(Unit::parse);
            v.dimensions.contains(&dimension) && unit.is_some_and(|unit| unit.is_pressure_tendency())
        };
        // Numbers of a model's levels are no pressures.
        let words =
            ["long_name", "standard_name", "description"].map(|name| level.text(name).unwrap_or_default()).concat().to_ascii_lowercase();
        let is_of_model = ["model", "hybrid", "sigma", "eta", "number"].iter().any(|word| words.contains(word))
            || level.text("formula_terms").is_some()
            || ["hyam", "hybm", "lnsp", "ap", "hyai"].iter().any(|name| self.listing().find(name).is_some());
        let are_pressures = |values: Vec<f64>| {
            let standard = |p: &f64| STANDARD_PRESSURES.contains(p);
            2 * values.iter().filter(|p| standard(p)).count() > values.len()
                && values.windows(2).any(|pair| (pair[1] - pair[0]).abs() != 1.0)
        };
        named && !is_of_model && self.listing().variables.iter().any(tells) && self.coordinate_values(index).is_ok_and(are_pressures)
    }

    /// Names of the dimensions of a variable.
    pub fn dimensions_of(&self, index: usize) -> Vec<String> {
        self.variable(index).dimensions.iter().map(|&d| self.listing().dimensions[d].name.clone()).collect()
    }

    pub fn path(&self) -> &'a Path {
        &self.file.listing.path
    }

    pub fn note(&mut self, text: impl Into<String>) {
        self.notes.push(text.into());
    }

    /// Error about the file.
    pub fn fault(&self, what: impl ToString) -> SourceError {
        SourceError::file(self.path(), what)
    }

    /// Error about a variable.
    pub fn misfit(&self, variable: usize, what: impl Display) -> SourceError {
        SourceError::variable(self.path(), &self.variable(variable).name, what)
    }

    /// Error about a setting that names a variable which the file lacks.
    pub fn not_found(&self, key: &str, name: &str) -> SourceError {
        let names: Vec<&str> = self.listing().variables.iter().map(|v| v.name.as_str()).collect();
        let near = names.iter().map(|n| (strsim::jaro_winkler(n, name), n)).max_by(|a, b| a.0.total_cmp(&b.0));
        SourceError::VariableNotFound {
            path: self.path().into(),
            key: key.into(),
            variable: name.into(),
            nearest: near.filter(|n| n.0 > 0.8).map(|n| format!(" (is `{}` meant?)", n.1)).unwrap_or_default(),
            present: names.join(", "),
        }
    }

    /// Error about a file without a velocity.
    pub fn no_velocity(&self, lacking: &str) -> SourceError {
        let listing = self.listing();
        let line = |i: usize| {
            let variable = self.variable(i);
            let verdict = match judge(listing, i, self.settings.velocity_units()) {
                Ok(candidate) => format!("may be {} ({})", candidate.component.name(), candidate.why),
                Err(lacks) => lacks,
            };
            format!("  {} ({}): {verdict}", variable.name, listing.dimension_names(variable))
        };
        let mut shown: Vec<usize> = listing.matching(|v| v.dimensions.len() > 1 || v.text(UNREADABLE).is_some()).collect();
        let rank = |i: usize| (judge(listing, i, self.settings.velocity_units()).is_err(), named(self.variable(i)).is_none());
        shown.sort_by_key(|&i| rank(i));
        let mut candidates: Vec<String> = shown.iter().map(|&i| line(i)).collect();
        match listing.variables.len() - shown.len() {
            0 => {}
            others => candidates.push(format!("  and {others} variables of fewer than two dimensions")),
        }
        self.fault(format!(
            "no velocity found ({lacking}). Name its variables with --set archive.u=NAME --set archive.v=NAME or, if another file holds \
             the other component, name that file too.\n\
             Variables in the file:\n{}",
            candidates.join("\n")
        ))
    }

    /// Variable that a setting names.
    pub fn named(&self, key: &str, name: &Option<String>) -> Result<Option<usize>, SourceError> {
        let Some(name) = name else { return Ok(None) };
        let found = self.listing().find(name).ok_or_else(|| self.not_found(key, name))?;
        match self.variable(found).text(UNREADABLE) {
            Some(why) => Err(self.misfit(found, why)),
            None => Ok(Some(found)),
        }
    }

    /// Packing of a variable.
    pub fn packing(&self, variable: usize) -> Result<Packing, SourceError> {
        Packing::of(self.variable(variable)).map_err(|what| self.misfit(variable, what))
    }

    /// Packing of a component of the velocity, which may have a fill value that the file does not name.
    pub fn velocity_packing(&self, variable: usize) -> Result<Packing, SourceError> {
        Ok(self.packing(variable)?.with_missing(self.variable(variable).number, self.settings.fill_value))
    }

    /// True if longitudes that close the circle are periodic.
    pub fn wants_periodic(&self) -> bool {
        self.settings.periodic.as_deref() != Some("none")
    }

    /// Turns levels into heights and closes the poles, if the metric asks for it; collects the notes of all axes.
    pub fn finish_axes(&mut self, axes: &mut [AxisPlan], metric: Metric) -> Result<(Vec<f64>, Poles), SourceError> {
        let mut vertical = Vec::new();
        if metric != Metric::Index
            && let Some(level) = axes.get(2)
        {
            let lowest = level.axis.first();
            if level.quantity == Quantity::Pressure && lowest <= 0.0 {
                let what = format!(
                    "a pressure of {lowest} Pa has no height; use --set archive.metric=index, or another axis with --set archive.z=NAME"
                );
                return Err(SourceError::variable(self.path(), level.axis.name(), what));
            }
            let scale = self.settings.vertical_scale.unwrap_or(1.0);
            (axes[2], vertical) = to_heights(level.clone(), scale).map_err(|fault| self.fault(fault))?;
        }
        let mut poles = Poles::default();
        if metric == Metric::Sphere {
            let (longitude, rest) = axes.split_at_mut(1);
            poles = Poles::close(&longitude[0], &mut rest[0]).map_err(|fault| self.fault(fault))?;
        }
        self.notes.extend(axes.iter().flat_map(|axis| axis.notes.iter().cloned()));
        Ok((vertical, poles))
    }

    /// A component whose dimensions have `roles` and whose velocity runs along `axis`.
    pub fn component(
        &mut self,
        candidate: &Candidate,
        roles: &[(usize, Role)],
        axis: Option<&AxisPlan>,
    ) -> Result<ComponentPlan, SourceError> {
        let along_pressure = axis.is_some_and(|a| a.quantity == Quantity::Pressure);
        let factor =
            self.velocity_factor(candidate, axis, if along_pressure { &[Unit::is_pressure_tendency] } else { &[Unit::is_velocity] })?;
        self.component_in(candidate, roles, factor)
    }

    /// The same with a factor to SI.
    fn component_in(&mut self, candidate: &Candidate, roles: &[(usize, Role)], factor: f64) -> Result<ComponentPlan, SourceError> {
        let variable = self.variable(candidate.variable);
        let roles =
            variable.dimensions.iter().map(|&d| roles.iter().find(|r| r.0 == d).map_or(Role::Fixed(self.entry_of(d)), |r| r.1)).collect();
        Ok(ComponentPlan {
            factor,
            name: variable.name.clone(),
            shape: self.shape(candidate.variable),
            roles,
            packing: self.velocity_packing(candidate.variable)?,
            why: candidate.why.clone(),
            dimensions: self.dimensions_of(candidate.variable),
            of_water: is_of_water(self.listing(), variable),
            of_air: is_of_air(variable),
            mask: None,
            columns: None,
            own: Default::default(),
        })
    }

    /// Factor from the unit of a component to SI, if it is one of `quantities`.
    pub fn velocity_factor(
        &mut self,
        candidate: &Candidate,
        axis: Option<&AxisPlan>,
        quantities: &[fn(&Unit) -> bool],
    ) -> Result<f64, SourceError> {
        if self.settings.velocity_unit == VelocityUnit::Cells {
            return Ok(1.0);
        }
        let variable = self.variable(candidate.variable);
        let component = candidate.component.name();
        let text = self.settings.unit(component).or(variable.units()).unwrap_or_default();
        match Unit::parse(text) {
            Some(u) if u.is_dimensionless() => {
                self.note(format!("{component}: `{}` has no unit: taken as SI", variable.name));
                Ok(1.0)
            }
            Some(u) if quantities.iter().any(|is| is(&u)) => Ok(u.factor),
            Some(u) if u.is_velocity() || u.is_pressure_tendency() => {
                let (axis, axis_units) = axis.map_or(("", ""), |a| (a.axis.name(), a.axis.units()));
                let hint = match (component, axis_units.is_empty()) {
                    ("w", true) => {
                        ", state the unit of the levels (such as --set archive.units.z=hPa), or ignore vertical motion with --set archive.w=none"
                    }
                    ("w", false) => ", or ignore vertical motion with --set archive.w=none",
                    _ => "",
                };
                let what = format!(
                    "its unit `{text}` does not fit the axis `{axis}` in `{axis_units}`; name another with --set archive.{component}=NAME{hint}"
                );
                Err(self.misfit(candidate.variable, what))
            }
            _ => Err(self.fault(format!(
                "variable `{}` has unit `{text}`; accepted are {VELOCITY_UNITS}. If the file is wrong, state it with --set \
                 archive.units.{component}=\"m s-1\"",
                variable.name
            ))),
        }
    }

    /// Tells of levels without a vertical velocity. The level that is suggested is that nearest to the surface.
    fn note_no_vertical(&mut self, levels: Option<&AxisPlan>) {
        let level = levels.map(|levels| match &levels.in_file {
            Some(ends) if ends.last.abs() < ends.first.abs() => ends.last,
            Some(ends) => ends.first,
            // Heights that columns are interpolated to, of which any number may be read: in the sea the highest, above the ground the lowest one.
            None if levels.axis.last() > 0.0 => levels.axis.first().round(),
            None => levels.axis.last(),
        });
        let way = level.map_or_else(String::new, |level| {
            let computed = levels.is_some_and(|levels| levels.quantity == Quantity::Length);
            let computed = if computed { ", and --set archive.w=continuity computes it" } else { "" };
            format!("; one level alone is read with --set archive.level={level}{computed}")
        });
        self.note(format!(
            "no vertical velocity found: it is taken as 0, and where levels move apart the FTLE is mostly the shear between them{way}"
        ));
    }

    /// The third component, if it exists and is wanted. Levels that follow the ground take changes of pressure as well.
    pub fn vertical_component(
        &mut self,
        w: Option<&Candidate>,
        roles: &[(usize, Role)],
        axis: Option<&AxisPlan>,
        three: bool,
        terrain: Option<&Terrain>,
    ) -> Result<Option<ComponentPlan>, SourceError> {
        match (w, three) {
            (Some(w), true) if terrain.is_some_and(Terrain::is_of_air) => {
                let factor = self.velocity_factor(w, axis, &[Unit::is_velocity, Unit::is_pressure_tendency])?;
                return self.component_in(w, roles, factor).map(Some);
            }
            (Some(w), true) => return self.component(w, roles, axis).map(Some),
            (Some(w), false) => {
                self.note(format!("`{}` is not used: the flow is read in two dimensions", self.variable(w.variable).name));
            }
            (None, true) if self.settings.wants_continuity() => self.note(
                "vertical motion is computed from continuity, as set: 0 at the lowest known node of each column, and above it minus the integral of du/dx + dv/dy; the density falls as exp(-z / 7 km) if names say wind or air",
            ),
            (None, true) if self.settings.leaves_out_w() => self.note("vertical motion is ignored, as set"),
            (None, true) => self.note_no_vertical(axis),
            (None, false) => {}
        }
        Ok(None)
    }
}
