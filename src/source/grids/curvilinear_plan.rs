//! Plan of files with longitudes and latitudes of two dimensions, and of [unstructured](super::unstructured_plan) meshes.

use super::axes::AxisPlan;
use super::column_plan::Terrain;
use super::component::{ComponentPlan, Role};
use super::curvilinear::Curvilinear;
use super::dimensions::Extent;
use super::layout::{Layout, Resampling};
use super::locator::{Mesh, target};
use super::planner::Planner;
use super::refine::Choice;
use crate::archive_settings::{Metric, VelocityUnit};
use crate::cf::coordinate::{Kind, classify};
use crate::cf::units::Unit;
use crate::cf::velocity::{Candidate, Velocity, says_eastward};
use crate::error::SourceError;
use crate::formats::Variable;
use std::sync::Arc;

/// Longitude and latitude variables.
pub type Pair = [usize; 2];

/// Where the points of a component lie.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Points {
    pub pair: Pair,
    /// Dimensions of the component along x and y; of points without rows, their one dimension twice.
    pub plane: [usize; 2],
    /// True along axes on which they lie between the points of the pair.
    pub between: [bool; 2],
    /// -1 or 1 along axes on which they lie half a cell before or behind the points of the pair.
    pub shift: [i8; 2],
    pub cells: Cells,
}

/// What lies between the points of a component. Faces are a variable of the nodes at their corners.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Cells {
    /// Points in rows.
    Rows,
    /// Points of no known mesh.
    Unknown,
    /// The points are the nodes of faces.
    AtNodes { faces: usize },
    /// The points stand for faces, whose nodes have the coordinates `nodes`; their middles if these are the pair.
    InFaces { faces: usize, nodes: Pair },
}

/// Ends of the names of dimensions of faces, whose centres have the name without it, and how many half cells they lie from these.
const FACES: [(&str, i8); 3] = [("_g", -1), ("_left", -1), ("_right", 1)];
/// Levels of u and v that differ by this share are the same.
const SAME_LEVEL: f64 = 1e-3;

/// Bytes of a point of a mesh: coordinates, directions, and up to four nodes with their places, bases and velocities.
pub const POINT_BYTES: u64 = 500;

impl Planner<'_> {
    /// Points of each component. `None` if the horizontal dimensions have coordinates of their own.
    ///
    /// # Errors
    /// Coordinates that the settings name and that are no pair; values that cannot be read.
    pub fn curvilinear_points(&mut self, velocity: &Velocity) -> Result<Option<Vec<Points>>, SourceError> {
        let s = self.settings;
        if s.metric.is_some_and(|m| m != Metric::Sphere) || s.velocity_unit != VelocityUnit::Si {
            return Ok(None);
        }
        let named = self.named_pair()?;
        if named.is_none() && (s.x.is_some() || s.y.is_some()) {
            return Ok(None);
        }
        let Some(u) = self.points(velocity.u.variable, "u", named)? else { return Ok(None) };
        let own = |&dimension: &usize| {
            self.measured(dimension).coordinate.map(|c| self.variable(c)).is_some_and(|variable| {
                let length = Unit::parse(variable.units().unwrap_or_default()).is_some_and(|u| u.is_length());
                length || matches!(classify(variable), Kind::Longitude | Kind::Latitude)
            })
        };
        if named.is_none() && u.plane.iter().any(own) {
            return Ok(None);
        }
        let mut points = vec![u];
        // Vertical velocities lie above tracers.
        for (other, letter) in [Some((&velocity.v, "v")), velocity.w.as_ref().map(|w| (w, "t"))].into_iter().flatten() {
            match self.points(other.variable, letter, named)? {
                Some(found) => points.push(found),
                None => return Ok(None),
            }
        }
        for (candidate, points) in [Some(&velocity.u), Some(&velocity.v), velocity.w.as_ref()].into_iter().flatten().zip(&points) {
            if points.between != [false; 2] {
                let [name, longitude, latitude] = [candidate.variable, points.pair[0], points.pair[1]].map(|i| &self.variable(i).name);
                self.note(format!(
                    "`{name}` has no coordinates of its own: its points lie between those of `{longitude}` and `{latitude}`"
                ));
            }
            if points.shift != [0; 2] {
                let [name, longitude, latitude] = [candidate.variable, points.pair[0], points.pair[1]].map(|i| &self.variable(i).name);
                self.note(format!(
                    "`{name}` lies on faces without coordinates: half a cell from the points of `{longitude}` and `{latitude}`, by `c_grid_axis_shift` or its \
                     dimension's name"
                ));
            }
        }
        Ok(Some(points))
    }

    /// Coordinates of two dimensions that the settings name.
    pub fn named_pair(&self) -> Result<Option<Pair>, SourceError> {
        let s = self.settings;
        let wide = |name: &Option<String>| {
            let index = name.as_ref().and_then(|name| self.listing().find(name));
            index.filter(|&i| {
                let variable = self.variable(i);
                let angle = matches!(classify(variable), Kind::Longitude | Kind::Latitude);
                variable.number.is_number() && (variable.dimensions.len() == 2 || (variable.dimensions.len() > 2 && angle))
            })
        };
        match (wide(&s.x), wide(&s.y)) {
            (Some(longitude), Some(latitude)) if self.plane_of(longitude) == self.plane_of(latitude) => Ok(Some([longitude, latitude])),
            (None, None) => Ok(None),
            (Some(odd), _) | (None, Some(odd)) => {
                let what = "a coordinate of two dimensions is one of a pair on the same points: name both, with --set \
                            archive.x=LONGITUDES --set archive.y=LATITUDES";
                Err(self.misfit(odd, what))
            }
        }
    }

    /// The last two dimensions of a variable: x and y.
    fn plane_of(&self, variable: usize) -> [usize; 2] {
        let dims = &self.variable(variable).dimensions;
        [dims[dims.len() - 1], dims[dims.len() - 2]]
    }

    /// Points of a variable, those of `letter` on a staggered grid: a pair of longitudes and latitudes on its dimensions, of which those that its `coordinates` attribute names go
    /// first; else a pair with one point more along x or y, between whose points it lies. Pairs without values are passed over.
    fn points(&self, variable: usize, letter: &str, named: Option<Pair>) -> Result<Option<Points>, SourceError> {
        let (listing, of) = (self.listing(), self.variable(variable));
        let wide: Vec<usize> = of.dimensions.iter().rev().copied().filter(|&d| listing.dimensions[d].len > 1).collect();
        let [x, y, ..] = wide[..] else { return Ok(None) };
        let first: Vec<&str> = of.text("coordinates").map(|t| t.split_whitespace().collect()).unwrap_or_default();
        let find = |kind: Kind| {
            let fits = |v: &Variable| v.dimensions.len() >= 2 && v.number.is_number() && classify(v) == kind;
            // Longitudes in metres are those of an idealised model.
            let mut found: Vec<usize> = listing.matching(fits).filter(|&i| !self.is_in_metres(kind, i)).collect();
            // In files that were joined, each component has coordinates of its own file, or of its points in a mesh.
            found.sort_by_key(|&i| {
                let ((part, name), of_part) = (self.file.origin(i), self.file.origin(variable).0);
                let name_of = |letter: &str| {
                    let name = name.to_ascii_lowercase();
                    name.starts_with(letter) || name.ends_with(letter)
                };
                // On Arakawa's B grid, v lies where u does.
                (part != of_part, !first.contains(&name), !name_of(letter), letter != "v" || !name_of("u"))
            });
            found
        };
        let latitudes = find(Kind::Latitude);
        let pairs: Vec<Pair> = match named {
            Some(pair) => vec![pair],
            None => {
                let partner = |lon: usize| latitudes.iter().find(|&&lat| self.are_partners(lon, lat)).map(|&lat| [lon, lat]);
                find(Kind::Longitude).into_iter().filter_map(partner).collect()
            }
        };
        let length = |d: usize| listing.dimensions[d].len;
        let on = |&[lon, _]: &Pair| {
            let plane = self.plane_of(lon);
            let own = plane.iter().all(|d| wide.contains(d));
            own.then_some(Points { pair: [0; 2], plane, between: [false; 2], shift: [0; 2], cells: Cells::Rows })
        };
        let beside = |&[lon, _]: &Pair| {
            let more = [0, 1].map(|k| length(self.plane_of(lon)[k]) as i64 - length([x, y][k]) as i64);
            let between = more.map(|more| more == 1);
            let same_part = self.file.origin(lon).0 == self.file.origin(variable).0;
            let shift = [0, 1].map(|k| match (self.plane_of(lon)[k], [x, y][k]) {
                (of_pair, own) if same_part && more[k] == 0 && of_pair != own => {
                    (self.face_shift(own) - self.face_shift(of_pair)).clamp(-1, 1)
                }
                _ => 0,
            });
            (more.iter().all(|more| (0..=1).contains(more))).then_some(Points {
                pair: [0; 2],
                plane: [x, y],
                between,
                shift,
                cells: Cells::Rows,
            })
        };
        let choices: [&dyn Fn(&Pair) -> Option<Points>; 2] = [&on, &beside];
        for points_of in choices {
            for &pair in &pairs {
                if let Some(points) = points_of(&pair)
                    && self.has_values(pair)?
                {
                    return Ok(Some(Points { pair, ..points }));
                }
            }
        }
        Ok(None)
    }

    /// Half cells by which faces along a dimension lie from the centres: by the attribute of SGRID and xgcm, or by the names of MITgcm.
    fn face_shift(&self, dimension: usize) -> i8 {
        let name = &self.listing().dimensions[dimension].name;
        let of = self.listing().matching(|v| v.dimensions == [dimension] && v.name == *name).next();
        let stated = of.and_then(|index| self.variable(index).numbers("c_grid_axis_shift").first().copied());
        match stated {
            Some(shift) if shift != 0.0 => shift.signum() as i8,
            _ => FACES
                .iter()
                .find(|(end, _)| name.strip_suffix(end).is_some_and(|centre| self.listing().dimensions.iter().any(|d| d.name == centre)))
                .map_or(0, |(_, shift)| *shift),
        }
    }

    /// True if longitudes and latitudes are of the same points.
    fn are_partners(&self, longitude: usize, latitude: usize) -> bool {
        self.plane_of(longitude) == self.plane_of(latitude) && self.file.origin(longitude).0 == self.file.origin(latitude).0
    }

    /// False if the longitudes or the latitudes are all 0 or missing, as in files from which other points were cut.
    fn has_values(&self, pair: Pair) -> Result<bool, SourceError> {
        for index in pair {
            let rows = self.listing().dimensions[self.plane_of(index)[1]].len;
            let known = |values: Vec<f64>| values.iter().any(|v| v.is_finite() && *v != 0.0);
            self.check_mesh(index)?;
            if !known(self.degrees(index, Some(rows / 2))?) && !known(self.degrees(index, None)?) {
                return Ok(false);
            }
        }
        Ok(true)
    }

    /// Refuses coordinates that the file cannot hold, or that need too much memory.
    fn check_mesh(&self, longitude: usize) -> Result<(), SourceError> {
        let shape = self.plane_of(longitude).map(|d| self.listing().dimensions[d].len);
        let points = shape[0].saturating_mul(shape[1]);
        self.listing().check_count(self.variable(longitude), &shape)?;
        let needed = (points as u64).saturating_mul(POINT_BYTES);
        self.file.limits.check(needed, &format!("{points} points of a mesh")).map_err(|what| self.misfit(longitude, what))
    }

    /// Points of a component, at the first entry along all dimensions but the last two.
    fn mesh(&self, points: &Points) -> Result<Mesh, SourceError> {
        let [longitude, latitude] = points.pair;
        if points.cells != Cells::Rows {
            return self.unstructured_mesh(points);
        }
        let shape = self.plane_of(longitude).map(|d| self.listing().dimensions[d].len);
        self.check_mesh(longitude)?;
        let mut mesh = Mesh::rows(shape, self.degrees(longitude, None)?, self.degrees(latitude, None)?);
        self.check_latitudes(latitude, &mesh.latitude)?;
        mesh.leave_out_zeros();
        Ok(mesh.between(points.between).shifted(points.shift))
    }

    /// Refuses latitudes beyond the poles.
    pub fn check_latitudes(&self, variable: usize, latitudes: &[f64]) -> Result<(), SourceError> {
        match latitudes.iter().find(|l| l.abs() > 90.001) {
            Some(odd) => {
                let hint = "if the coordinates are metres, write --set archive.units.x=m --set archive.units.y=m";
                Err(self.misfit(variable, format!("a latitude is {odd} degrees; accepted are -90 to 90, and missing values; {hint}")))
            }
            None => Ok(()),
        }
    }

    /// Values of a coordinate along its last two dimensions (or its one), or along one row of them.
    pub fn plane(&self, index: usize, row: Option<usize>) -> Result<Vec<f64>, SourceError> {
        let mut count = self.shape(index);
        let rank = count.len();
        count[..rank.saturating_sub(2)].fill(1);
        let mut start = vec![0; rank];
        if let (Some(row), 2..) = (row, rank) {
            (start[rank - 2], count[rank - 2]) = (row, 1);
        }
        let packing = self.packing(index)?;
        Ok(self.file.read(index, start, count)?.into_iter().map(|v| packing.unpack(v)).collect())
    }

    /// The same in degrees.
    pub fn degrees(&self, index: usize, row: Option<usize>) -> Result<Vec<f64>, SourceError> {
        let variable = self.variable(index);
        // MPAS writes radians, and may not say so.
        let is_mpas = ["loncell", "latcell"].contains(&variable.name.to_ascii_lowercase().as_str());
        let radians = variable.units().map_or(is_mpas, |u| u.to_ascii_lowercase().starts_with("rad"));
        let degrees = |v: f64| if radians { v.to_degrees() } else { v };
        Ok(self.plane(index, row)?.into_iter().map(degrees).collect())
    }

    /// Refuses a later file whose points differ from those of the first. Compares the first and the last row, which cost little to
    /// read.
    fn check_points(&self, points: &[Points], first: &Curvilinear) -> Result<(), SourceError> {
        for (k, mesh) in first.meshes.iter().enumerate().take(points.len()) {
            let (points, before) = (&points[k], &points[..k]);
            if points.cells != Cells::Rows {
                if !before.contains(points) {
                    self.check_unstructured(points, mesh)?;
                }
                continue;
            }
            let is_own = points.between == [false; 2] && points.shift == [0; 2];
            let whole = if is_own { None } else { Some(self.mesh(points)?) };
            let whole = [whole.as_ref().map(|mesh| &mesh.longitude), whole.as_ref().map(|mesh| &mesh.latitude)];
            for ((&index, known), whole) in points.pair.iter().zip([&mesh.longitude, &mesh.latitude]).zip(whole) {
                for row in [0, mesh.shape[1] - 1] {
                    let in_row = |values: &[f64]| values[row * mesh.shape[0]..][..mesh.shape[0]].to_vec();
                    let here = whole.map_or_else(|| self.degrees(index, Some(row)), |values| Ok(in_row(values)))?;
                    let there = in_row(known);
                    // Points at 0 were left out.
                    let same = |a: f64, b: f64| a == b || (b.is_nan() && (a.is_nan() || a == 0.0));
                    if let Some((a, b)) = here.iter().zip(&there).find(|(a, b)| !same(**a, **b)) {
                        let what = format!("it is {a} where the first file has {b} (row {row}); the files of an archive lie on one grid");
                        return Err(self.misfit(index, what));
                    }
                }
            }
        }
        Ok(())
    }

    /// True if u and v run along the grid's own directions; and the reason.
    fn runs_along_grid(&self, u: usize, cells: Cells) -> (bool, String) {
        let variable = self.variable(u);
        let standard = variable.text("standard_name").unwrap_or_default();
        match (self.settings.grid_relative, says_eastward(variable)) {
            (Some(along), _) => (along, "as set".into()),
            (None, _) if cells != Cells::Rows => (false, "the mesh has no rows".into()),
            (None, Some(why)) => (false, why),
            (None, None) if !standard.is_empty() => (true, format!("standard_name `{standard}`")),
            (None, None) => (true, "no name says eastward; --set archive.grid_relative=false otherwise".into()),
        }
    }

    /// Plans a file whose components lie on `points`.
    pub fn plan_curvilinear(mut self, velocity: &Velocity, points: Vec<Points>, first: Option<&Layout>) -> Result<Layout, SourceError> {
        let u = velocity.u.variable;
        if points[0].cells != Cells::Rows && self.settings.grid_relative == Some(true) {
            return Err(SourceError::setting("grid_relative", "true", "false: a mesh without rows has no directions of its own"));
        }
        let planes: Vec<[usize; 2]> = points.iter().map(|points| points.plane).collect();
        let mut extents = self.extents(u)?;
        for extent in &mut extents {
            if let Some(k) = planes[0].iter().position(|&d| d == extent.dimension) {
                extent.kind = [Kind::Longitude, Kind::Latitude][k];
            }
        }
        let terrain = self.terrain(velocity, &mut extents, first)?;
        if points[0].cells != Cells::Rows {
            let latitude = Extent { dimension: planes[0][1], kind: Kind::Latitude, coordinate: None };
            extents.push(latitude);
        }
        self.name_by_position(u, &mut extents)?;
        let level = if terrain.is_some() { None } else { self.pick_level(&extents)? };
        let time = self.time(&extents)?;
        let level_extent = extents.iter().find(|e| e.kind == Kind::Level && Some(e.dimension) != level.map(|l| l.0));
        let three = terrain.as_ref().map_or(level_extent.is_some(), Terrain::is_three);
        let metric = self.metric(&extents, three, terrain.is_some())?;
        if metric != Metric::Sphere {
            let what = "its levels are neither pressures nor lengths, which the sphere needs: pick one by its coordinate with --set \
                        archive.level=VALUE, or by its entry with --set archive.select.DIMENSION=0";
            return Err(self.misfit(u, what));
        }
        let mut level_axis = match &terrain {
            Some(terrain) => self.height_axis(terrain)?,
            None => level_extent.map(|e| self.axis(u, e, 2)).transpose()?,
        };
        let mut own_levels = Vec::new();
        if let (Some(w), Some(extent), true, None) = (&velocity.w, level_extent, three, &terrain) {
            let dims = self.variable(w.variable).dimensions.iter().map(|&d| self.measured(d));
            if let Some(of_w) = dims.filter(|e| e.kind == Kind::Level).find(|e| self.listing().dimensions[e.dimension].len > 1) {
                // u and v have the same levels.
                let along = [(u, *extent), (u, *extent), (w.variable, of_w)];
                let (axis, own) = self.axis_of_all(&along, 2)?;
                (level_axis, own_levels) = (Some(axis), own);
            }
        }

        let one_level = self.level_of_u(u, level);
        let role = |which: usize, variable: usize, d: usize| -> Result<Role, SourceError> {
            let is_wide = self.listing().dimensions[d].len > 1;
            Ok(match planes[which].iter().position(|&t| t == d) {
                Some(k) => Role::Axis(k),
                None if terrain.as_ref().is_some_and(|t| t.is_along(which, d)) => Role::Axis(2),
                None => match (self.measured(d).kind, one_level) {
                    (Kind::Time, _) => Role::Time,
                    (Kind::Level, _) if three && is_wide => Role::Axis(2),
                    // w is not read in two dimensions.
                    (Kind::Level, Some(of_u)) if is_wide && which < 2 => Role::Fixed(self.same_level(variable, d, of_u)?),
                    _ => Role::Fixed(self.entry_of(d)),
                },
            })
        };
        let roles = |(which, candidate): (usize, &Candidate)| -> Result<Vec<(usize, Role)>, SourceError> {
            self.variable(candidate.variable).dimensions.iter().map(|&d| Ok((d, role(which, candidate.variable, d)?))).collect()
        };
        let candidates = [Some(&velocity.u), Some(&velocity.v), velocity.w.as_ref()].into_iter().flatten();
        let roles: Vec<Vec<(usize, Role)>> = candidates.enumerate().map(roles).collect::<Result<_, _>>()?;
        let mut components = vec![self.component(&velocity.u, &roles[0], None)?, self.component(&velocity.v, &roles[1], None)?];
        let levels = [0, 1].map(|k| components[k].along(2));
        if levels[0] != levels[1] {
            return Err(self.misfit(velocity.v.variable, format!("u has {} levels, v {}", levels[0], levels[1])));
        }
        if three && terrain.is_none() {
            self.check_same_levels(velocity, &components)?;
        }
        let w = self.vertical_candidate(velocity, terrain.as_ref());
        let w = self.vertical_component(w, roles.get(2).map_or(&[][..], Vec::as_slice), level_axis.as_ref(), three, terrain.as_ref())?;
        match w {
            Some(w) if terrain.is_some() || w.along(2) == levels[0] || !own_levels.is_empty() => components.push(w),
            Some(w) => self.note(format!("`{}` lies on other levels than u: vertical motion is taken as 0", w.name)),
            None => {}
        }
        components.iter_mut().zip(own_levels).for_each(|(component, own)| component.own[2] = Some(own));
        self.give_columns(&mut components, terrain.as_ref(), first.is_none())?;

        let points = &points[..components.len()];
        let same_shapes = |l: &&Layout| l.frames[0].iter().map(|c| &c.shape).eq(components.iter().map(|c| &c.shape));
        let known = first.filter(same_shapes).and_then(|l| Some((l.resampling.clone()?, l.axes[..2].to_vec())));
        if let Some((Resampling::Curvilinear(known), _)) = &known {
            self.check_points(points, known)?;
        }
        let (resampling, mut axes) = match known {
            Some(known) => known,
            None => self.resample(points, u)?,
        };
        axes.extend(level_axis);
        let (vertical, poles) = self.finish_axes(&mut axes, metric)?;
        Ok(Layout { frames: vec![components], axes, vertical, poles, time, metric, resampling: Some(resampling), notes: self.notes })
    }

    /// Refuses levels of v that lie elsewhere than those of u: they are read one for one.
    fn check_same_levels(&self, velocity: &Velocity, components: &[ComponentPlan]) -> Result<(), SourceError> {
        let levels = |which: usize, variable: usize| {
            let place = components[which].roles.iter().position(|role| *role == Role::Axis(2));
            place.and_then(|place| self.measured(self.variable(variable).dimensions[place]).coordinate)
        };
        let [u, v] = [velocity.u.variable, velocity.v.variable];
        let (Some(of_u), Some(of_v)) = (levels(0, u), levels(1, v)) else { return Ok(()) };
        if of_u == of_v {
            return Ok(());
        }
        let values = |index: usize| {
            let factor = self.axis_units(Kind::Level, index).and_then(Unit::parse).map_or(1.0, |unit| unit.factor);
            Ok::<Vec<f64>, SourceError>(self.coordinate_values(index)?.into_iter().map(|value| factor * value).collect())
        };
        let [here, there] = [values(of_u)?, values(of_v)?];
        match here.iter().zip(&there).position(|(a, b)| (a - b).abs() > SAME_LEVEL * a.abs().max(b.abs())) {
            None => Ok(()),
            Some(k) => {
                let name = &self.variable(u).name;
                let what = format!(
                    "level {k} of it lies at {}, that of `{name}` at {}: accepted are components on the same levels",
                    there[k], here[k]
                );
                Err(self.misfit(v, what))
            }
        }
    }

    /// Refuses points of v that lie elsewhere than those of u altogether.
    fn check_overlap(&self, points: &[Points], meshes: &[Arc<Mesh>]) -> Result<(), SourceError> {
        let [u, v] = [&meshes[0], &meshes[1]];
        // From the first known point of u, so that a box may cross any meridian.
        let known = |mesh: &Mesh| (0..mesh.longitude.len()).filter_map(|n| mesh.place(n)).collect::<Vec<_>>();
        let [of_u, of_v] = [known(u), known(v)];
        let Some(&[origin, _]) = of_u.first() else { return Ok(()) };
        let range = |places: &[[f64; 2]]| {
            places.iter().fold([[f64::INFINITY, f64::NEG_INFINITY]; 2], |box_, place| {
                let place = [(place[0] - origin + 180.0).rem_euclid(360.0) - 180.0, place[1]];
                [0, 1].map(|k| [box_[k][0].min(place[k]), box_[k][1].max(place[k])])
            })
        };
        let [a, b] = [range(&of_u), range(&of_v)];
        if of_v.is_empty() || (0..2).all(|k| a[k][0] <= b[k][1] && b[k][0] <= a[k][1]) {
            return Ok(());
        }
        let shown =
            |r: [[f64; 2]; 2]| format!("{:.2} to {:.2} east, {:.2} to {:.2} north", r[0][0] + origin, r[0][1] + origin, r[1][0], r[1][1]);
        let what = format!("v lies at {}, u at {}: accepted are components of one place", shown(b), shown(a));
        Err(self.misfit(points[1].pair[0], what))
    }

    /// Makes the grid, at the mesh's own spacing unless one is set, and locates its nodes among the points of each component.
    fn resample(&mut self, points: &[Points], u: usize) -> Result<(Resampling, Vec<AxisPlan>), SourceError> {
        let mut meshes: Vec<Arc<Mesh>> = Vec::new();
        for (k, own) in points.iter().enumerate() {
            // Components with the same coordinates share them.
            let twin = points[..k].iter().position(|other| other == own);
            meshes.push(twin.map_or_else(|| self.mesh(own).map(Arc::new), |twin| Ok(meshes[twin].clone()))?);
        }
        self.check_overlap(points, &meshes)?;
        let resolution = self.settings.resolution;
        let target = target(&meshes[0], resolution, self.settings.region).map_err(|what| self.misfit(points[0].pair[0], what))?;
        let (along, why) = self.runs_along_grid(u, points[0].cells);
        let directions = std::array::from_fn(|k| meshes[k].directions(along).into_iter().map(|both| both[k]).collect());
        let which = if along { "the grid's own directions, and are turned to east and north" } else { "east and north" };
        self.note(format!("velocities run along {which} ({why})"));
        let names = points[0].pair.map(|i| self.variable(i).name.clone());
        let choice = if resolution.is_some() { Choice::Set } else { Choice::Mesh { factor: 1.0, stopped: None } };
        let resampled = Curvilinear::new(names, meshes, Arc::new(directions), target, choice);
        let axes = resampled.axes(self.wants_periodic()).map_err(|fault| self.fault(fault))?;
        Ok((Resampling::Curvilinear(Arc::new(resampled)), axes.to_vec()))
    }
}
