//! Files whose components have coordinates of one dimension.

use super::axes::{AxisPlan, Coordinates, Quantity};
use super::column_plan::Terrain;
use super::component::Role;
use super::dimensions::Extent;
use super::layout::Layout;
use super::own_axes::{OwnAxis, shared};
use super::planner::Planner;
use crate::archive_settings::{Metric, Staggering, VelocityUnit};
use crate::cf::coordinate::{Kind, classify};
use crate::cf::units::Unit;
use crate::cf::velocity::{self, Candidate, Component, Velocity};
use crate::error::SourceError;
use crate::formats::{UNREADABLE, Variable};
use ridgewatch_base::setting::word;
use ridgewatch_field::{Axis, AxisFault};
use std::sync::Arc;

/// Axis of the grid along which a coordinate runs.
fn place(kind: Kind) -> Option<usize> {
    match kind {
        Kind::Longitude | Kind::X => Some(0),
        Kind::Latitude | Kind::Y => Some(1),
        Kind::Level => Some(2),
        Kind::Time | Kind::Unknown => None,
    }
}

impl Planner<'_> {
    /// Finds the components of the velocity.
    pub fn velocity(&mut self) -> Result<Velocity, SourceError> {
        let s = self.settings;
        let ignore_w = s.leaves_out_w();
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

    /// Plans a file whose components have coordinates of one dimension, the same ones or their own.
    pub fn plan_rectilinear(mut self, velocity: &Velocity, first: Option<&Layout>) -> Result<Layout, SourceError> {
        let u = velocity.u.variable;
        let mut extents = self.extents(u)?;
        let terrain = self.terrain(velocity, &mut extents, first)?;
        let w = self.vertical_candidate(velocity, terrain.as_ref());
        self.name_by_position(u, &mut extents)?;
        let level = if terrain.is_some() { None } else { self.pick_level(&extents)? };
        let time = self.time(&extents)?;

        extents.sort_by_key(|e| place(e.kind).unwrap_or(3));
        let levels = extents.iter().any(|e| e.kind == Kind::Level && Some(e.dimension) != level.map(|l| l.0));
        let three = terrain.as_ref().map_or(levels, Terrain::is_three);
        let metric = self.metric(&extents, three, terrain.is_some())?;
        let w_in_use = w.filter(|_| three);
        let candidates: Vec<&Candidate> = [Some(&velocity.u), Some(&velocity.v), w_in_use].into_iter().flatten().collect();
        let mut own = vec![extents.clone(); candidates.len()];
        for (which, candidate) in candidates.iter().enumerate().skip(1) {
            let found = self.own_extents(candidate.variable, &extents).ok_or_else(|| self.apart(u, candidate.variable))?;
            if metric == Metric::Index && found != extents {
                let names = [u, candidate.variable].map(|i| &self.variable(i).name);
                let accepted = "metres, or points that all components share: pick a level with --set archive.level=VALUE, or state the unit of the \
                                levels with --set archive.units.z=m";
                let found = format!("index, while `{}` and `{}` lie on points of their own", names[0], names[1]);
                return Err(SourceError::setting("metric", found, accepted));
            }
            own[which] = found;
        }

        let mut axes = Vec::new();
        let mut places: Vec<[Option<Arc<OwnAxis>>; 3]> = vec![Default::default(); candidates.len()];
        let role = |extent: &Extent| match (place(extent.kind), level) {
            (Some(2), Some((_, index))) => Role::Fixed(index),
            (Some(k), _) => Role::Axis(k),
            (None, _) => Role::Time,
        };
        for (n, extent) in extents.iter().enumerate() {
            match (role(extent), &terrain) {
                (Role::Axis(2), Some(terrain)) => axes.extend(self.height_axis(terrain)?),
                (Role::Axis(k), _) => {
                    let along: Vec<(usize, Extent)> = candidates.iter().zip(&own).map(|(c, own)| (c.variable, own[n])).collect();
                    let (axis, own) = self.axis_of_all(&along, k)?;
                    places.iter_mut().zip(own).for_each(|(places, own)| places[k] = Some(own));
                    axes.push(axis);
                }
                _ => {}
            }
        }
        let mut roles: Vec<Vec<(usize, Role)>> = Vec::new();
        for (candidate, extents) in candidates.iter().zip(&own) {
            let own_role = |extent: &Extent| -> Result<Role, SourceError> {
                Ok(match (role(extent), level) {
                    (Role::Fixed(_), Some(of_u)) => Role::Fixed(self.same_level(candidate.variable, extent.dimension, of_u)?),
                    (role, _) => role,
                })
            };
            let of_component = extents.iter().map(|extent| Ok((extent.dimension, own_role(extent)?)));
            roles.push(of_component.collect::<Result<_, SourceError>>()?);
        }
        let mut components =
            vec![self.component(&velocity.u, &roles[0], Some(&axes[0]))?, self.component(&velocity.v, &roles[1], Some(&axes[1]))?];
        let of_w = roles.get(2).map_or(&[][..], Vec::as_slice);
        components.extend(self.vertical_component(w, of_w, axes.get(2), three, terrain.as_ref())?);
        components.iter_mut().zip(places).for_each(|(component, own)| component.own = own);
        self.give_columns(&mut components, terrain.as_ref(), first.is_none())?;
        let (vertical, poles) = self.finish_axes(&mut axes, metric)?;
        Ok(Layout { frames: vec![components], axes, vertical, poles, time, metric, resampling: None, notes: self.notes })
    }

    /// Extents of another component in the order of those of u, which differ in their horizontal dimensions and levels at most. `None` if they differ in more.
    fn own_extents(&self, variable: usize, extents: &[Extent]) -> Option<Vec<Extent>> {
        let dims = &self.variable(variable).dimensions;
        let known = |d: usize| extents.iter().find(|e| e.dimension == d).copied();
        let wide = |d: usize| {
            known(d).is_some()
                || (self.listing().dimensions[d].len > 1 && self.settings.entry(&self.listing().dimensions[d].name).is_none())
        };
        let mut own: Vec<Extent> =
            dims.iter().copied().filter(|&d| wide(d)).map(|d| known(d).unwrap_or_else(|| self.measured(d))).collect();
        // As for u: x last, y before it, then levels.
        let kinds = extents.iter().map(|e| e.kind);
        let mut missing: Vec<Kind> = kinds.filter(|&kind| own.iter().all(|own| place(own.kind) != place(kind))).collect();
        missing.sort_by_key(|&kind| place(kind));
        let unknown: Vec<&mut Extent> = own.iter_mut().rev().filter(|own| own.kind == Kind::Unknown).collect();
        if unknown.len() == missing.len() {
            unknown.into_iter().zip(missing).for_each(|(own, kind)| own.kind = kind);
        }
        let of = |extent: &Extent| {
            let mut found = own.iter().filter(|own| place(own.kind) == place(extent.kind));
            let one = found.next().filter(|_| found.next().is_none())?;
            (place(extent.kind).is_some() || one.dimension == extent.dimension).then_some(Extent { kind: extent.kind, ..*one })
        };
        let found: Option<Vec<Extent>> = extents.iter().map(of).collect();
        found.filter(|found| found.len() == own.len())
    }

    /// Axis `k` of the grid, which components with dimensions `along` share, and the places of its nodes among their own coordinates, if these differ.
    pub fn axis_of_all(&mut self, along: &[(usize, Extent)], k: usize) -> Result<(AxisPlan, Vec<Arc<OwnAxis>>), SourceError> {
        let (u, first) = along[0];
        let other = along.iter().find(|(_, extent)| extent.dimension != first.dimension);
        if let (Some(&(other, _)), true) = (other, k < 2) {
            for (_, extent) in along {
                if extent.coordinate.is_none() && self.separable(extent.dimension, k)?.is_none() {
                    return Err(self.apart(u, other));
                }
            }
        }
        let base = self.axis(u, &first, k)?;
        if other.is_none() {
            return Ok((base, Vec::new()));
        }
        let mut plans = vec![base];
        for &(variable, extent) in &along[1..] {
            let plan = match extent.dimension == first.dimension {
                true => plans[0].clone(),
                false if k == 2 => self.own_levels(variable, &extent, &plans[0])?,
                false => self.axis(variable, &extent, k)?,
            };
            if plan.quantity != plans[0].quantity {
                let [a, b] = [&plan, &plans[0]].map(|plan| format!("`{}` ({})", plan.axis.name(), plan.axis.units()));
                return Err(self.misfit(variable, format!("its coordinate {a} measures another quantity than {b} of u")));
            }
            plans.push(plan);
        }
        // On Arakawa's C grid, v lies between the faces of x.
        let centred = usize::from(k == 0);
        let Some((axis, own)) = shared(&plans, centred, self.settings.staggering).map_err(|fault| self.fault(fault))? else {
            return Ok((plans.swap_remove(0), Vec::new()));
        };
        let mut names: Vec<String> =
            along.iter().map(|(_, extent)| format!("`{}`", self.listing().dimensions[extent.dimension].name)).collect();
        names.dedup();
        let (names, nodes) = (names.join(", "), axis.axis.len());
        let step = (axis.axis.last() - axis.axis.first()) / (nodes - 1) as f64;
        let lost = plans.iter().map(|plan| (axis.axis.first() - plan.axis.first()).max(plan.axis.last() - axis.axis.last()));
        let lost = if axis.axis.period().is_some() { 0.0 } else { lost.fold(0.0, f64::max) };
        if lost > 3.0 * step {
            let (low, high, units) = (axis.axis.first(), axis.axis.last(), axis.axis.units());
            self.note(format!(
                "WARNING: only the part along {} that all components have is read: {low} to {high} {units}",
                ["x", "y", "z"][k]
            ));
        }
        self.note(match self.settings.staggering {
            Staggering::Faces => format!(
                "the components have own coordinates along {}: {names}; read on the {nodes} of all, between which each is interpolated linearly from its own \
                 points (--set archive.staggering=centres takes fewer, and smooths)",
                ["x", "y", "z"][k]
            ),
            Staggering::Centres => format!(
                "the components have own coordinates along {}: {names}; interpolated to the {nodes} of `{}`, as set",
                ["x", "y", "z"][k],
                axis.axis.name()
            ),
        });
        Ok((axis, own))
    }

    /// Levels of another component than u. Those without coordinates are taken for the levels of u if they are as many.
    fn own_levels(&mut self, variable: usize, extent: &Extent, of_u: &AxisPlan) -> Result<AxisPlan, SourceError> {
        let found = extent.coordinate.map(|_| self.axis(variable, extent, 2)).transpose()?;
        let count = self.listing().dimensions[extent.dimension].len;
        let name = &self.variable(variable).name;
        match found {
            Some(own) if own.quantity == of_u.quantity => Ok(own),
            _ if count == of_u.order.len() => {
                let [own, levels] = [&self.listing().dimensions[extent.dimension].name, of_u.axis.name()];
                self.note(format!("`{name}`: nothing tells where the levels `{own}` lie: taken as those of `{levels}`"));
                Ok(of_u.clone())
            }
            _ => {
                let dimension = &self.listing().dimensions[extent.dimension].name;
                let what = format!(
                    "nothing tells where its {count} levels `{dimension}` lie beside the {} of `{}`; leave vertical motion out with --set \
                     archive.w=none",
                    of_u.order.len(),
                    of_u.axis.name()
                );
                Err(self.misfit(variable, what))
            }
        }
    }

    /// Error about components on points that are not understood together.
    fn apart(&self, u: usize, other: usize) -> SourceError {
        let listing = self.listing();
        let [a, b] = [u, other].map(|i| self.variable(i));
        self.fault(format!(
            "`{}` lies on ({}) but `{}` on ({}): staggered components are read if each has coordinates of its own along x, y and z, if they are WRF's \
             (dimensions `..._stag`, with PH and PHB), or if they have longitudes and latitudes of two dimensions, their own or of the points between \
             which they lie; those are named with --set archive.x=NAME --set archive.y=NAME",
            a.name,
            listing.dimension_names(a),
            b.name,
            listing.dimension_names(b)
        ))
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
        let (coordinate, values) = if let Some(coordinate) = extent.coordinate {
            (coordinate, self.coordinate_values(coordinate)?)
        } else if let Some(found) = self.separable(extent.dimension, k)? {
            found
        } else {
            if self.settings.velocity_unit != VelocityUnit::Cells {
                return Err(self.misfit(u, self.without_coordinates(extent.dimension)));
            }
            let axis = Axis::uniform(name.as_str(), "", 0.0, (len - 1) as f64, len).map_err(|fault| self.fault(fault))?;
            let notes = vec![format!("`{name}` has no coordinates: counted from 0")];
            return Ok(AxisPlan { notes, ..AxisPlan::made(extent.kind, axis, Quantity::None) });
        };
        let units = self.axis_units(extent.kind, coordinate);
        let coordinates = Coordinates { units, ..Coordinates::of(self.path(), self.variable(coordinate), extent.kind, values) };
        coordinates.plan(range, self.wants_periodic())
    }

    /// A coordinate of two dimensions in metres that varies along `dimension` only, and its values there: of idealised models, whose meshes are rectangles.
    /// Else the middles of one whose dimension has one point more, as faces lie between centres.
    fn separable(&self, dimension: usize, k: usize) -> Result<Option<(usize, Vec<f64>)>, SourceError> {
        let listing = self.listing();
        let Some(kinds) = [[Kind::X, Kind::Longitude], [Kind::Y, Kind::Latitude]].get(k) else { return Ok(None) };
        let count = listing.dimensions[dimension].len;
        let wide = |v: &Variable| v.dimensions.len() >= 2 && v.number.is_number() && kinds.contains(&classify(v));
        for more in [0, 1] {
            for index in listing.matching(wide).collect::<Vec<_>>() {
                let variable = self.variable(index);
                // x runs along the last dimension.
                let along = variable.dimensions[variable.dimensions.len() - 1 - k];
                // `xi_u` lies between the points of `xi_rho`.
                let stem = |d: usize| listing.dimensions[d].name.split_once('_').map(|(stem, _)| stem);
                let fits = match more {
                    0 => along == dimension,
                    _ => listing.dimensions[along].len == count + 1 && stem(along).is_some() && stem(along) == stem(dimension),
                };
                if !fits || !self.is_in_metres(classify(variable), index) {
                    continue;
                }
                let shape = self.shape(index);
                let [rows, width] = [shape[shape.len() - 2], shape[shape.len() - 1]];
                listing.check_count(variable, &[rows, width])?;
                let plane = self.plane(index, None)?;
                let values: Vec<f64> = if k == 0 { plane[..width].to_vec() } else { plane.iter().step_by(width).copied().collect() };
                let range = values.iter().fold(0.0f64, |m, v| m.max((v - values[0]).abs()));
                let is_alike = |(i, v): (usize, &f64)| (v - values[if k == 0 { i % width } else { i / width }]).abs() <= 1e-6 * range;
                if range > 0.0 && plane.iter().enumerate().all(is_alike) {
                    let between = values.windows(2).map(|pair| 0.5 * (pair[0] + pair[1])).collect();
                    return Ok(Some((index, if more == 0 { values } else { between })));
                }
            }
        }
        Ok(None)
    }

    /// True if a coordinate is in metres: by its unit, or by its name if it has none.
    pub fn is_in_metres(&self, kind: Kind, index: usize) -> bool {
        match self.axis_units(kind, index).and_then(Unit::parse) {
            Some(unit) if unit.is_length() => true,
            Some(unit) => unit.is_dimensionless() && matches!(kind, Kind::X | Kind::Y),
            None => self.axis_units(kind, index).is_none() && matches!(kind, Kind::X | Kind::Y),
        }
    }

    fn without_coordinates(&self, dimension: usize) -> String {
        let listing = self.listing();
        let name = &listing.dimensions[dimension].name;
        let angle = |v: &Variable| matches!(classify(v), Kind::Longitude | Kind::Latitude);
        let wide = listing.matching(|v| v.dimensions.len() >= 2 && v.dimensions.contains(&dimension) && angle(v));
        let wide: Vec<usize> = wide.collect();
        let are_metres = !wide.is_empty() && wide.iter().all(|&i| self.is_in_metres(classify(self.variable(i)), i));
        let wide: Vec<&str> = wide.iter().map(|&i| self.variable(i).name.as_str()).collect();
        if are_metres {
            return format!(
                "dimension `{name}` has only coordinates in metres of two dimensions ({}), along which its rows do not run: a turned or bent mesh is read by \
                 longitudes and latitudes in degrees alone. Put the velocities onto rows first, or write the longitudes and latitudes of the points into the file",
                wide.join(", ")
            );
        }
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
