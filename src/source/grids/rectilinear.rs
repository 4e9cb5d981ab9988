//! Files whose components share one grid of coordinates in rows.

use super::axes::{AxisPlan, Coordinates, Quantity};
use super::column_plan::Terrain;
use super::component::Role;
use super::dimensions::Extent;
use super::layout::Layout;
use super::planner::Planner;
use crate::archive_settings::{Metric, VelocityUnit};
use crate::cf::coordinate::{Kind, classify};
use crate::cf::units::Unit;
use crate::cf::velocity::{self, Candidate, Component, Velocity};
use crate::error::SourceError;
use crate::formats::{UNREADABLE, Variable};
use ridgewatch_base::setting::word;
use ridgewatch_field::{Axis, AxisFault};

impl Planner<'_> {
    /// Finds the components of the velocity.
    pub fn velocity(&mut self) -> Result<Velocity, SourceError> {
        let s = self.settings;
        let ignore_w = s.w.as_deref() == Some("none");
        let w = if ignore_w { None } else { self.named("w", &s.w)? };
        let fixed = [self.named("u", &s.u)?, self.named("v", &s.v)?, w];
        let found = velocity::choose(self.listing(), fixed, ignore_w, s.velocity_units()).map_err(|lacking| self.no_velocity(&lacking))?;
        let mut names: Vec<String> = found.others.iter().map(|o| format!("`{}`", self.variable(o.variable).name)).collect();
        if !names.is_empty() {
            names.dedup();
            self.note(format!("also velocities, but passed over: {} ({})", names.join(", "), velocity::RULE));
        }
        let lacks_w = !ignore_w && found.w.is_none();
        self.tell_unread(lacks_w.then_some(found.u.variable))?;
        Ok(found)
    }

    /// Tells of velocities that cannot be read. Refuses them if they are the vertical motion that belongs to `u`.
    fn tell_unread(&mut self, u: Option<usize>) -> Result<(), SourceError> {
        for index in self.listing().matching(|v| v.text(UNREADABLE).is_some()).collect::<Vec<_>>() {
            let variable = self.variable(index);
            let why = variable.text(UNREADABLE).unwrap_or_default();
            match (velocity::named(variable), u) {
                (None, _) => {}
                // One whose grid cannot be read lacks the dimensions of the plane.
                (Some(Component::W), Some(u))
                    if [0, 2].iter().any(|fewer| variable.dimensions.len() + fewer == self.variable(u).dimensions.len()) =>
                {
                    return Err(self.misfit(index, format!("{why}; or leave vertical motion out with --set archive.w=none")));
                }
                _ => self.note(format!("`{}` cannot be read: {why}", variable.name)),
            }
        }
        Ok(())
    }

    /// Plans a file whose components lie on the same points.
    pub fn plan_rectilinear(mut self, velocity: &Velocity, first: Option<&Layout>) -> Result<Layout, SourceError> {
        let u = velocity.u.variable;
        let mut extents = self.extents(u)?;
        let terrain = self.terrain(velocity, &mut extents, first)?;
        let w = self.vertical_candidate(velocity, terrain.as_ref());
        self.check_same_points(velocity, w, terrain.as_ref())?;
        self.name_by_position(u, &mut extents)?;
        let level = if terrain.is_some() { None } else { self.pick_level(&extents)? };
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
        let levels = extents.iter().any(|e| e.kind == Kind::Level && Some(e.dimension) != level.map(|l| l.0));
        let three = terrain.as_ref().map_or(levels, Terrain::is_three);
        let metric = self.metric(&extents, three, terrain.is_some())?;
        for extent in &extents {
            let role = match (place(extent.kind), level) {
                (_, Some((dimension, index))) if dimension == extent.dimension => Role::Fixed(index),
                (Some(k), _) => Role::Axis(k),
                (None, _) => Role::Time,
            };
            match (role, &terrain) {
                (Role::Axis(2), Some(terrain)) => axes.extend(self.height_axis(terrain)?),
                (Role::Axis(k), _) => axes.push(self.axis(u, extent, k)?),
                _ => {}
            }
            roles.push((extent.dimension, role));
        }
        // w may lie between the levels of u.
        if let (Some(terrain), Some(w)) = (&terrain, w) {
            let own = self.variable(w.variable).dimensions.iter().filter(|&&d| terrain.is_along(2, d));
            roles.extend(own.map(|&d| (d, Role::Axis(2))));
        }
        let mut components =
            vec![self.component(&velocity.u, &roles, Some(&axes[0]))?, self.component(&velocity.v, &roles, Some(&axes[1]))?];
        components.extend(self.vertical_component(w, &roles, axes.get(2), three, terrain.as_ref())?);
        self.give_columns(&mut components, terrain.as_ref())?;
        let (vertical, poles) = self.finish_axes(&mut axes, metric)?;
        Ok(Layout { frames: vec![components], axes, vertical, poles, time, metric, resampling: None, notes: self.notes })
    }

    fn check_same_points(&self, found: &Velocity, w: Option<&Candidate>, terrain: Option<&Terrain>) -> Result<(), SourceError> {
        let listing = self.listing();
        let but_levels = |which: usize, variable: usize| {
            let dims = &self.variable(variable).dimensions;
            dims.iter().copied().filter(|&d| terrain.is_none_or(|t| !t.is_along(which, d))).collect::<Vec<_>>()
        };
        let u = found.u.variable;
        let differs = |&(which, other): &(usize, usize)| match terrain {
            Some(_) => but_levels(which, other) != but_levels(0, u),
            None => !velocity::same_dimensions(listing, u, other),
        };
        let others = [Some((1, found.v.variable)), w.map(|w| (2, w.variable))];
        let Some((_, other)) = others.into_iter().flatten().find(differs) else { return Ok(()) };
        let [a, b] = [found.u.variable, other].map(|i| self.variable(i));
        Err(self.fault(format!(
            "`{}` lies on ({}) but `{}` on ({}): staggered components are read only if they are WRF's (dimensions `..._stag`, with PH and \
             PHB) or have longitudes and latitudes of two dimensions, their own or of the points between which they lie; those are named with \
             --set archive.x=NAME --set archive.y=NAME",
            a.name,
            listing.dimension_names(a),
            b.name,
            listing.dimension_names(b)
        )))
    }

    /// The metric in force; `three` says whether the flow has three dimensions, `in_metres` that its levels are heights whatever the file calls them.
    pub fn metric(&mut self, extents: &[Extent], three: bool, in_metres: bool) -> Result<Metric, SourceError> {
        let has = |kind| extents.iter().any(|e| e.kind == kind);
        let sphere = has(Kind::Longitude) && has(Kind::Latitude);
        let level = extents.iter().find(|e| e.kind == Kind::Level).and_then(|e| e.coordinate);
        let unit = level.and_then(|c| Unit::parse(self.axis_units(Kind::Level, c).unwrap_or_default()));
        let measured = in_metres || unit.is_some_and(|u| u.is_length() || u.is_pressure());
        let fault = |found: &str, accepted: &str| Err(SourceError::setting("metric", found, accepted));
        match (self.settings.metric, self.settings.velocity_unit) {
            (Some(Metric::Sphere), _) if !sphere => {
                fault("sphere", "the axes are not longitude and latitude; accepted are index and cartesian")
            }
            (Some(Metric::Sphere), _) if three && !measured => fault(
                "sphere",
                "the levels are neither pressures nor lengths; pick one with --set archive.level=VALUE, or --set archive.metric=index",
            ),
            (Some(metric), VelocityUnit::Cells) if metric != Metric::Index => {
                fault(&word(metric), "velocities in cells need --set archive.metric=index")
            }
            (Some(metric), _) => Ok(metric),
            (None, VelocityUnit::Cells) => Ok(Metric::Index),
            (None, VelocityUnit::Si) if sphere && three && !measured => {
                self.note(
                    "the levels are neither pressures nor lengths: metric index (cells and snapshots); --set archive.level=VALUE gives the sphere",
                );
                Ok(Metric::Index)
            }
            (None, VelocityUnit::Si) => Ok(if sphere { Metric::Sphere } else { Metric::Cartesian }),
        }
    }

    /// Axis `k` of the grid, along a dimension of `u`.
    pub fn axis(&self, u: usize, extent: &Extent, k: usize) -> Result<AxisPlan, SourceError> {
        let dimension = &self.listing().dimensions[extent.dimension];
        let (name, len) = (&dimension.name, dimension.len);
        if len < 2 {
            return Err(self.fault(AxisFault::TooShort { name: name.clone(), found: len }));
        }
        let range = self.settings.region.and_then(|r| [Some([r[0], r[1]]), Some([r[2], r[3]]), None][k]);
        let Some(coordinate) = extent.coordinate else {
            if self.settings.velocity_unit != VelocityUnit::Cells {
                return Err(self.misfit(u, self.without_coordinates(extent.dimension)));
            }
            let axis = Axis::uniform(name.as_str(), "", 0.0, (len - 1) as f64, len).map_err(|fault| self.fault(fault))?;
            let notes = vec![format!("`{name}` has no coordinates: counted from 0")];
            return Ok(AxisPlan { notes, ..AxisPlan::made(extent.kind, axis, Quantity::None) });
        };
        let values = self.coordinate_values(coordinate)?;
        let units = self.axis_units(extent.kind, coordinate);
        let coordinates = Coordinates { units, ..Coordinates::of(self.path(), self.variable(coordinate), extent.kind, values) };
        coordinates.plan(range, self.wants_periodic())
    }

    fn without_coordinates(&self, dimension: usize) -> String {
        let listing = self.listing();
        let name = &listing.dimensions[dimension].name;
        let angle = |v: &Variable| matches!(classify(v), Kind::Longitude | Kind::Latitude);
        let wide = listing.matching(|v| v.dimensions.len() >= 2 && v.dimensions.contains(&dimension) && angle(v));
        let wide: Vec<&str> = wide.map(|i| self.variable(i).name.as_str()).collect();
        let why = if wide.is_empty() {
            "has no coordinate variable".into()
        } else {
            format!("has only coordinates of two dimensions ({}), of which no longitude and latitude are a pair", wide.join(", "))
        };
        format!(
            "dimension `{name}` {why}. Name coordinates with --set archive.x=NAME (archive.y, archive.z), or set --set archive.velocity_unit=cells if the velocities are cells per snapshot interval"
        )
    }
}
