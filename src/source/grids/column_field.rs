//! Levels whose heights are a field of the file: partial cells, layers that follow the density, models of the atmosphere.

use super::column::{Columns, Places, read_level};
use super::component::ComponentPlan;
use super::mask::is_of_water;
use super::planner::Planner;
use crate::archive_settings::ArchiveSettings;
use crate::cf::coordinate::Kind;
use crate::cf::units::Unit;
use crate::error::SourceError;
use crate::formats::Listing;

/// The field of heights that `archive.z` names.
pub fn named_heights(listing: &Listing, settings: &ArchiveSettings) -> Option<usize> {
    listing.find(settings.z.as_ref()?).filter(|&field| listing.variables[field].dimensions.len() >= 3)
}

impl Planner<'_> {
    /// See [`named_heights`].
    pub fn named_heights(&self) -> Option<usize> {
        named_heights(self.listing(), self.settings)
    }

    /// Why a field of heights does not fit a variable.
    pub fn of_other_levels(&self, of: usize) -> String {
        let [name, dimensions] = [&self.variable(of).name, &self.listing().dimension_names(self.variable(of))].map(Clone::clone);
        format!(
            "`z` must name a coordinate of one dimension, or, in metres and not in cells, heights whose dimensions are levels, y and x as those of `{name}` ({dimensions})"
        )
    }

    /// A field that tells the height of each point along the levels of a variable: the one that `archive.z` names, else, if the levels have no coordinates in
    /// metres or pressures, the one among the variable's `coordinates`. `of_u` are the levels of u, if those of the variable may be others (w).
    pub fn field_of_heights(&self, variable: usize, dimension: usize, of_u: Option<usize>) -> Option<usize> {
        let levels = |i: usize| self.variable(i).dimensions.iter().rev().nth(2).copied();
        let along = |&i: &usize| levels(i) == Some(dimension) && self.variable(i).number.is_number();
        // A mesh may have other names for its dimensions. Levels of w lie elsewhere, although they may be as many.
        let as_many = |&i: &usize| {
            let len = |d: usize| self.listing().dimensions[d].len;
            let is_level = |d: usize| len(d) == len(dimension) && !self.variable(variable).dimensions.contains(&d);
            along(&i)
                || (of_u.is_none_or(|of_u| of_u == dimension) && self.variable(i).number.is_number() && levels(i).is_some_and(is_level))
        };
        let unit = |i: usize| self.axis_units(Kind::Level, i).and_then(Unit::parse);
        let len_of = |d: usize| self.listing().dimensions[d].len;
        let named = self.named_heights();
        if let Some(named) = named.filter(as_many) {
            return Some(named);
        }
        let is_measured = |unit: Unit| unit.is_length() || unit.is_pressure();
        if named.is_none() && self.measured(dimension).coordinate.and_then(unit).is_some_and(is_measured) {
            return None;
        }
        // In NEMO's meshes `gdepw_0` lies between `gdept_0`.
        let between =
            named.and_then(|named| self.listing().find(&self.variable(named).name.replace("gdept", "gdepw"))).filter(|i| Some(*i) != named);
        if let Some(between) =
            between.filter(|_| of_u.is_some()).filter(|i| along(i) || levels(*i).is_some_and(|d| len_of(d) == len_of(dimension)))
        {
            return Some(between);
        }
        let names = self.variable(variable).text("coordinates")?;
        // Levels whose kind of height is named may be told by other fields of this kind.
        let is_height = |unit: Unit| unit.is_length() || (named.is_some() && (unit.is_geopotential() || unit.is_pressure()));
        names.split_whitespace().filter_map(|name| self.listing().find(name)).filter(along).find(|&i| unit(i).is_some_and(is_height))
    }

    /// Levels whose heights a field tells.
    pub fn by_field(&mut self, field: usize, [x, y]: [usize; 2], time: Option<usize>, of: usize) -> Result<Columns, SourceError> {
        let plane = [x, y].map(|d| self.listing().dimensions[d].len);
        let levels = self.variable(field).dimensions.iter().rev().nth(2).copied();
        let mut heights = self.field_of_columns(field, levels, plane, time, of)?;
        let told = match self.fields_of_heights.iter().find(|(known, _)| *known == field) {
            Some((_, told)) => *told,
            None => {
                let told = self.height_field(field, &heights, is_of_water(self.listing(), self.variable(of)))?;
                self.fields_of_heights.push((field, told));
                told
            }
        };
        let HeightField { factor, is_pressure, ascends, is_of_air } = told;
        heights.factor = factor;
        let count = heights.along(2);
        let order = if ascends { (0..count).collect() } else { (0..count).rev().collect() };
        Ok(Columns {
            places: Places::Field { heights: Box::new(heights), is_pressure, is_of_air },
            order,
            is_tendency: false,
            heights: Vec::new(),
        })
    }

    /// Reads the first time of a field, to know what it tells.
    fn height_field(&mut self, field: usize, heights: &ComponentPlan, is_of_water: bool) -> Result<HeightField, SourceError> {
        let (factor, is_pressure) = match self.axis_units(Kind::Level, field) {
            None => {
                self.note(format!("`{}` has no unit: taken as metres", heights.name));
                (1.0, false)
            }
            Some(text) => match Unit::parse(text) {
                Some(unit) if unit.is_length() => (unit.factor, false),
                Some(unit) if unit.is_geopotential() => (unit.factor / STANDARD_GRAVITY, false),
                Some(unit) if unit.is_pressure() && !is_of_water => (unit.factor, true),
                _ => {
                    let accepted = if is_of_water { "length or geopotential" } else { "length, geopotential or pressure" };
                    let what = format!(
                        "its unit `{text}` is no {accepted}, but `z` names it as the heights of levels; --set archive.units.z=m states another"
                    );
                    return Err(self.misfit(field, what));
                }
            },
        };
        let named = |text: &str| text.to_ascii_lowercase().contains("thickness");
        let variable = self.variable(field);
        if named(&variable.name)
            || ["standard_name", "long_name"].iter().any(|name| variable.text(name).is_some_and(named))
            || is_scale_factor(&variable.name)
        {
            return Err(self.misfit(field, "it holds thicknesses of layers; `z` must name their heights or depths (in NEMO `gdept_0`)"));
        }
        let count = heights.along(2);
        let (mut sum, mut below) = (0.0, Vec::new());
        // Of each pair of levels: in how many columns more the numbers ascend than descend.
        let mut votes: Vec<i64> = Vec::new();
        for level in 0..count {
            let here = read_level(self.file, heights, level, 0)?;
            sum += here.iter().filter(|z| z.is_finite()).map(|&z| f64::from(z)).sum::<f64>();
            if level > 0 {
                let steps = here.iter().zip(&below).map(|(here, below): (&f32, &f32)| here - below).filter(|step| step.is_finite());
                votes.push(steps.map(|step| i64::from(step > 0.0) - i64::from(step < 0.0)).sum());
            }
            below = here;
        }
        if below.is_empty() {
            return Err(self.misfit(field, "it holds no points"));
        }
        let [grows, shrinks] = [votes.iter().any(|vote| *vote > 0), votes.iter().any(|vote| *vote < 0)];
        if grows == shrinks {
            let what = match grows {
                true => "its levels go up and down: accepted are heights that ascend or descend from level to level",
                false => "it gives the levels no heights at the first time: its values are missing, or all the same",
            };
            return Err(self.misfit(field, what));
        }
        if is_pressure {
            return Ok(HeightField { factor, is_pressure, ascends: shrinks, is_of_air: true });
        }
        let variable = self.variable(field);
        let says_depth = |text: &str| text.to_ascii_lowercase().contains("dep");
        let is_down = match variable.text("positive").map(str::to_ascii_lowercase).as_deref() {
            Some("down") => true,
            Some("up") => false,
            _ => (says_depth(&variable.name) || variable.text("standard_name").is_some_and(says_depth) || is_of_water) && sum > 0.0,
        };
        let sign = if is_down { -1.0 } else { 1.0 };
        Ok(HeightField { factor: sign * factor, is_pressure, ascends: grows != is_down, is_of_air: sign * sum > 0.0 })
    }
}

/// True for NEMO's thicknesses: `e3t_0`, `e3u` and the like.
fn is_scale_factor(name: &str) -> bool {
    let name = name.to_ascii_lowercase();
    name.starts_with("e3") && name.len() > 2
}

/// What a field tells of its levels.
#[derive(Debug, Clone, Copy)]
pub struct HeightField {
    /// To heights in metres, or pressures in Pa.
    factor: f64,
    is_pressure: bool,
    /// True if each level lies above the one before.
    ascends: bool,
    is_of_air: bool,
}

/// Standard acceleration of gravity, m/s2, which divides a geopotential into geopotential metres.
const STANDARD_GRAVITY: f64 = 9.80665;
