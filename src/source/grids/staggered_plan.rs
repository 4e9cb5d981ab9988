//! Plan of WRF output.

use super::axes::{AxisPlan, Quantity};
use super::component::{ComponentPlan, Role};
use super::layout::{Layout, Resampling};
use super::nest::Nest;
use super::planner::Planner;
use super::staggered::{Cells, Reach, Staggered};
use super::times::TimePlan;
use crate::archive_settings::{Metric, Staggering, VelocityUnit};
use crate::cf::coordinate::{Kind, classify_name};
use crate::cf::units::Unit;
use crate::cf::velocity::Velocity;
use crate::error::SourceError;
use crate::formats::NumberType;
use ridgewatch_field::Axis;
use std::sync::Arc;

/// Names of the map scale factors at the points of u and v.
const SCALES: [[&str; 2]; 2] = [["MAPFAC_U", "MAPFAC_UX"], ["MAPFAC_V", "MAPFAC_VY"]];

/// Points along x, y or the levels (0, 1, 2) of a variable on (..., level, y, x).
fn along(plan: &ComponentPlan, axis: usize) -> usize {
    plan.shape.iter().rev().nth(axis).copied().unwrap_or(1)
}

impl Planner<'_> {
    /// True if the chosen components are staggered in the way of WRF.
    pub fn is_staggered(&self, velocity: &Velocity) -> bool {
        let listing = self.listing();
        let ends_staggered = |variable: usize, from_end: usize| {
            let dims = &self.variable(variable).dimensions;
            dims.len().checked_sub(from_end + 1).is_some_and(|k| listing.dimensions[dims[k]].name.ends_with("_stag"))
        };
        ends_staggered(velocity.u.variable, 0)
            && ends_staggered(velocity.v.variable, 1)
            && listing.find("PH").is_some()
            && listing.find("PHB").is_some()
    }

    /// A variable on (time, level, y, x), or fewer of these from the left.
    fn by_place(&self, variable: usize, factor: f64, why: &str) -> Result<ComponentPlan, SourceError> {
        let v = self.variable(variable);
        let rank = v.dimensions.len();
        let time = |d: usize| classify_name(&self.listing().dimensions[d].name) == Kind::Time;
        let role = |place: usize| match rank - 1 - place {
            _ if place == 0 && time(v.dimensions[0]) => Role::Time,
            axis @ 0..=2 => Role::Axis(axis),
            _ => Role::Fixed(0),
        };
        let (roles, packing) = ((0..rank).map(role).collect(), self.velocity_packing(variable)?);
        let (shape, dimensions) = (self.shape(variable), self.dimensions_of(variable));
        let name = v.name.clone();
        Ok(ComponentPlan {
            name,
            shape,
            dimensions,
            roles,
            packing,
            factor,
            why: why.into(),
            of_water: false,
            of_air: false,
            mask: None,
            columns: None,
            own: Default::default(),
        })
    }

    /// Plans WRF output. All files of an archive share the domain and the heights of the first.
    pub fn plan_staggered(mut self, velocity: &Velocity, first: Option<&Layout>) -> Result<Layout, SourceError> {
        let s = self.settings;
        if s.metric.is_some_and(|m| m != Metric::Cartesian) || s.velocity_unit == VelocityUnit::Cells {
            let accepted = "WRF output is read in metres: --set archive.metric=cartesian and velocities in SI";
            return Err(SourceError::setting("metric", "not cartesian", accepted));
        }
        if s.level.is_some() || s.region.is_some() {
            let key = if s.level.is_some() { "level" } else { "region" };
            let accepted = "WRF output is read whole and in three dimensions; choose heights with --set archive.heights=[...]";
            return Err(SourceError::setting(key, "given", accepted));
        }
        let components = self.staggered_components(velocity)?;
        let cells = [along(&components[0], 0).saturating_sub(1), along(&components[0], 1), along(&components[0], 2)];
        let find = |name: &str| self.listing().find(name);
        let geopotential = match (find("PH"), find("PHB")) {
            (Some(p), Some(b)) => [self.by_place(p, 1.0, "")?, self.by_place(b, 1.0, "")?],
            _ => return Err(self.not_found("heights", "PH")),
        };
        let expected = [0, 1, 2].map(|which| [0, 1, 2].map(|k| cells[k] + usize::from(which == k)));
        for (plan, expected) in components.iter().zip(expected).chain(geopotential.iter().map(|g| (g, expected[2]))) {
            let found = [0, 1, 2].map(|k| along(plan, k));
            if found != expected || plan.shape.len() < 3 || cells.iter().any(|&n| n < 2) {
                let what = format!(
                    "it has {found:?} points along x, y and its levels; {expected:?} would fit {cells:?} cells, of which 2 are needed at least"
                );
                return Err(SourceError::variable(self.path(), &plan.name, what));
            }
        }
        let mut scale = [None, None];
        for (k, names) in SCALES.into_iter().enumerate() {
            let plan = names.into_iter().find_map(find).map(|variable| self.by_place(variable, 1.0, "")).transpose()?;
            scale[k] = plan.filter(|p| along(p, 0) == expected[k][0] && along(p, 1) == expected[k][1]);
        }
        let (Some(dx), Some(dy)) = (self.listing().number("DX"), self.listing().number("DY")) else {
            let what = "the file has no attributes DX and DY, the distances between its points in metres";
            return Err(SourceError::variable(self.path(), &components[0].name, what));
        };
        let time = self.staggered_time(velocity.u.variable)?;
        let known = match first.and_then(|layout| layout.resampling.as_ref()) {
            Some(Resampling::Staggered(known)) => Some(known),
            _ => None,
        };
        let nest = match known {
            Some(known) => known.nest.clone(),
            None => Nest::of(self.file, [cells[0], cells[1]], dx.min(dy))?,
        };
        let mut own_reach = Reach::default();
        match &nest {
            Some(nest) => {
                for entry in 0..time.seconds.len() {
                    let shift = nest.shift(self.file, entry)?;
                    own_reach = own_reach.with(Reach { least: shift, greatest: shift });
                }
            }
            None => self.note("no XLONG and XLAT of its centres: the grid is assumed not to move"),
        }
        let fineness = if s.staggering == Staggering::Faces { 2 } else { 1 };
        let mut staggered = Staggered {
            geopotential,
            scale,
            cells: Cells { count: cells, fineness },
            heights: Vec::new(),
            step: [dx, dy],
            nest,
            reach: known.map_or(own_reach, |known| known.reach.with(own_reach)),
            what: String::new(),
        };
        staggered.heights = match (known, &s.heights) {
            (Some(known), _) => known.heights.clone(),
            (None, Some(heights)) => heights.clone(),
            (None, None) => staggered.mean_heights(&staggered.full_levels(self.file, 0)?),
        };
        staggered.what = format!(
            "components on faces: read on a grid of {}, each column interpolated between its own levels, whose heights are (PH + PHB) / g, \
             onto {} heights from {:.0} to {:.0} m ({})",
            if fineness == 2 { "faces and centres" } else { "centres" },
            staggered.heights.len(),
            staggered.heights.first().copied().unwrap_or(0.0),
            staggered.heights.last().copied().unwrap_or(0.0),
            if s.heights.is_some() { "as set" } else { "the mean heights of its full and half levels; others with archive.heights" }
        );
        self.note(staggered.what.clone());
        self.note(match staggered.scale {
            [Some(_), Some(_)] => "metres are those of the map projection: u and v are multiplied by its scale factors MAPFAC",
            _ => "no map scale factors (MAPFAC_U, MAPFAC_V): metres of the projection are taken for metres on the ground",
        });
        self.note("below the lowest half level, and above the highest, the wind is that of the half level; below the ground it is missing");
        self.notes.extend(staggered.movement());
        let mut axes = staggered.horizontal().map_err(|fault| self.fault(fault))?.to_vec();
        let levels = Axis::new("height", "m", staggered.heights.clone()).map_err(|fault| self.fault(fault))?;
        axes.push(AxisPlan::made(Kind::Level, levels, Quantity::Length));
        let (vertical, poles) = self.finish_axes(&mut axes, Metric::Cartesian)?;
        let resampling = Some(Resampling::Staggered(Arc::new(staggered)));
        Ok(Layout { frames: vec![components], axes, vertical, poles, time, metric: Metric::Cartesian, resampling, notes: self.notes })
    }

    fn staggered_components(&mut self, velocity: &Velocity) -> Result<Vec<ComponentPlan>, SourceError> {
        let mut components: Vec<ComponentPlan> = Vec::new();
        for candidate in [Some(&velocity.u), Some(&velocity.v), velocity.w.as_ref()] {
            let Some(candidate) = candidate else {
                self.note("no vertical velocity found: it is taken as 0");
                continue;
            };
            let factor = self.velocity_factor(candidate, None, &[Unit::is_velocity])?;
            let plan = self.by_place(candidate.variable, factor, &candidate.why)?;
            // A vertical velocity of fewer dimensions belongs to something else.
            if components.len() < 2 || plan.shape.len() == components[0].shape.len() {
                components.push(plan);
            }
        }
        Ok(components)
    }

    fn staggered_time(&self, u: usize) -> Result<TimePlan, SourceError> {
        let extents: Vec<_> =
            self.variable(u).dimensions.iter().map(|&d| self.measured(d)).filter(|extent| extent.kind == Kind::Time).collect();
        // Minutes are written in single precision, characters are exact.
        let text = |&i: &usize| self.settings.time.is_none() && self.variable(i).number == NumberType::Text;
        match (self.listing().find("Times").filter(text), extents.first()) {
            (Some(index), Some(extent)) => self.characters(index, self.listing().dimensions[extent.dimension].len),
            _ => self.time(&extents),
        }
    }
}
