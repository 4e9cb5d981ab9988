//! Longitudes and latitudes as arrays of two dimensions (ocean models, projections): resampled to a grid of even longitudes and latitudes.
//!
//! Each node of the new grid is found in a cell of the old one, in the plane that touches the sphere there, and gets the bilinear
//! interpolation of the cell's four corners; it is missing where a corner is, or where no cell holds it. Each horizontal component is
//! resampled from its own points as a vector in space, along the direction in which it runs there: east and north turn about a pole within
//! a cell, vectors do not.

use super::SourceError;
use super::axes::{AxisPlan, Quantity};
use super::cf::coordinate::{Kind, classify};
use super::cf::units::Unit;
use super::cf::velocity::Velocity;
use super::container::{Container, Variable};
use super::hyperslab::{as_in_file, read_component};
use super::layout::{ComponentPlan, Layout, Planner, Resampling, Role};
use super::locator::{Locator, Mesh, Target, target};
use super::settings::{Metric, VelocityUnit};
use crate::field::{Axis, AxisFault};
use std::sync::Arc;

/// What it takes to read a file.
#[derive(Debug)]
pub(super) struct Curvilinear {
    /// Where the grid's nodes are among each component's points.
    locators: Vec<Arc<Locator>>,
    /// The points themselves.
    meshes: Vec<Arc<Mesh>>,
    target: Target,
    /// Unit vectors in which u and v run, at each of their points.
    directions: [Vec<[f32; 3]>; 2],
    /// East and north, at each node of the grid.
    bases: [Vec<[f32; 3]>; 2],
    /// See [`Self::what`].
    what: String,
}

impl Curvilinear {
    /// What is done, in words.
    pub(super) fn what(&self) -> &str {
        &self.what
    }

    /// One time, onto the grid; `levels` are the file's entries of the grid's levels.
    pub(super) fn read(
        &self,
        file: &Container,
        frame: &[ComponentPlan],
        entry: usize,
        levels: &[usize],
    ) -> Result<Vec<Vec<f32>>, SourceError> {
        let values = |which: usize| {
            let [x, y, _] = as_in_file(&frame[which]);
            read_component(file, &frame[which], &[x, y, levels.to_vec()], entry)
        };
        let mut out = self.horizontal(&values(0)?, &values(1)?);
        if let Some(locator) = self.locators.get(2) {
            out.push(values(2)?.chunks_exact(locator.points()).flat_map(|level| locator.apply(level)).collect());
        }
        Ok(out)
    }

    /// Eastward and northward velocities at the nodes of all levels.
    fn horizontal(&self, u: &[f32], v: &[f32]) -> Vec<Vec<f32>> {
        let mut out = vec![Vec::new(), Vec::new()];
        for levels in u.chunks_exact(self.locators[0].points()).zip(v.chunks_exact(self.locators[1].points())) {
            let along: [Vec<f32>; 3] = std::array::from_fn(|k| {
                let part = |which: usize, level: &[f32]| {
                    let part: Vec<f32> = level.iter().zip(&self.directions[which]).map(|(value, d)| value * d[k]).collect();
                    self.locators[which].apply(&part)
                };
                part(0, levels.0).iter().zip(part(1, levels.1)).map(|(a, b)| a + b).collect()
            });
            for (values, base) in out.iter_mut().zip(&self.bases) {
                values.extend(base.iter().enumerate().map(|(node, e)| (0..3).map(|k| e[k] * along[k][node]).sum::<f32>()));
            }
        }
        out
    }

    /// What interpolation on the grid (of vectors, as the flow is sampled) gives at the file's own points, held against what the file has
    /// there: m/s, root mean square over the horizontal components.
    pub(super) fn error(&self, file: &Container, frame: &[ComponentPlan], entry: usize) -> Result<[f64; 2], SourceError> {
        let (mut wrong, mut size, mut count) = (0.0, 0.0, 0usize);
        let mut own = Vec::with_capacity(2);
        for plan in &frame[..2] {
            own.push(read_component(file, plan, &as_in_file(plan), entry)?);
        }
        let on_grid = self.horizontal(&own[0], &own[1]);
        let nodes = self.bases[0].len();
        for (level, (east, north)) in on_grid[0].chunks_exact(nodes).zip(on_grid[1].chunks_exact(nodes)).enumerate() {
            let along: [Vec<f32>; 3] =
                std::array::from_fn(|k| (0..nodes).map(|n| east[n] * self.bases[0][n][k] + north[n] * self.bases[1][n][k]).collect());
            for which in 0..2 {
                let (mesh, points) = (&self.meshes[which], self.locators[which].points());
                for (point, &value) in own[which][level * points..][..points].iter().enumerate() {
                    let at = |k: usize| self.target.interpolate(&along[k], mesh.longitude[point], mesh.latitude[point]);
                    let found: f64 = (0..3).map(|k| at(k) * f64::from(self.directions[which][point][k])).sum();
                    if found.is_finite() && value.is_finite() {
                        wrong += (found - f64::from(value)).powi(2);
                        size += f64::from(value).powi(2);
                        count += 1;
                    }
                }
            }
        }
        let mean = |sum: f64| (sum / count.max(1) as f64).sqrt();
        Ok([mean(wrong), mean(size)])
    }
}

/// Longitude and latitude variables of a component.
type Pair = [usize; 2];

impl Planner<'_> {
    /// Coordinate arrays of each component, where the horizontal dimensions have no coordinates of their own.
    pub(super) fn curvilinear_coordinates(&self, velocity: &Velocity) -> Result<Option<Vec<Pair>>, SourceError> {
        let s = self.settings;
        let wanted = s.metric.is_none_or(|m| m == Metric::Sphere) && s.velocity_unit == VelocityUnit::Si && s.x.is_none() && s.y.is_none();
        if !wanted {
            return Ok(None);
        }
        let Some(u) = self.coordinate_arrays(velocity.u.variable) else { return Ok(None) };
        let header = self.header();
        let own = |&dimension: &usize| {
            let coordinate = self.measured(dimension).coordinate;
            coordinate.is_some_and(|c| {
                let variable = &header.variables[c];
                let length = Unit::parse(variable.units().unwrap_or_default()).is_some_and(|u| u.is_length());
                length || matches!(classify(variable), Kind::Longitude | Kind::Latitude)
            })
        };
        let dims = &header.variables[u[0]].dimensions;
        if dims[dims.len() - 2..].iter().any(own) {
            return Ok(None);
        }
        let mut pairs = vec![u];
        for other in [Some(&velocity.v), velocity.w.as_ref()].into_iter().flatten() {
            match self.coordinate_arrays(other.variable) {
                Some(pair) => pairs.push(pair),
                None => return Ok(None),
            }
        }
        Ok(Some(pairs))
    }

    /// Longitude and latitude arrays on the dimensions of a variable; those that its `coordinates` attribute names go first.
    fn coordinate_arrays(&self, variable: usize) -> Option<Pair> {
        let header = self.header();
        let of = &header.variables[variable];
        let fits = |v: &Variable| {
            let n = v.dimensions.len();
            let on = |d: &usize| of.dimensions.contains(d) && header.dimensions[*d].len > 1;
            n >= 2 && v.number.is_number() && v.dimensions[n - 2..].iter().all(on)
        };
        let named: Vec<&str> = of.text("coordinates").map(|t| t.split_whitespace().collect()).unwrap_or_default();
        let find = |kind: Kind| {
            let mut found: Vec<usize> =
                (0..header.variables.len()).filter(|&i| fits(&header.variables[i]) && classify(&header.variables[i]) == kind).collect();
            found.sort_by_key(|&i| !named.contains(&header.variables[i].name.as_str()));
            found
        };
        let latitudes = find(Kind::Latitude);
        let tail = |i: usize| header.variables[i].dimensions[header.variables[i].dimensions.len() - 2..].to_vec();
        find(Kind::Longitude).into_iter().find_map(|lon| latitudes.iter().find(|&&lat| tail(lat) == tail(lon)).map(|&lat| [lon, lat]))
    }

    /// The last two dimensions of a coordinate array; the first entry along all others.
    fn mesh(&self, [longitude, latitude]: Pair) -> Result<Mesh, SourceError> {
        let header = self.header();
        let shape = header.shape(&header.variables[longitude]);
        let shape = [shape[shape.len() - 1], shape[shape.len() - 2]];
        let (longitude_values, latitude_values) = (self.rows(longitude, None)?, self.rows(latitude, None)?);
        let odd = latitude_values.iter().copied().find(|l: &f64| l.abs() > 90.001);
        if let Some(odd) = odd {
            return Err(self.misfit(latitude, format!("a latitude is {odd} degrees; accepted are -90 to 90")));
        }
        Ok(Mesh { shape, longitude: longitude_values, latitude: latitude_values })
    }

    /// Degrees at all points of a two-dimensional coordinate, or at those of one row.
    fn rows(&self, index: usize, row: Option<usize>) -> Result<Vec<f64>, SourceError> {
        let variable = &self.header().variables[index];
        let shape = self.header().shape(variable);
        let rank = shape.len();
        let mut count: Vec<usize> = shape.iter().enumerate().map(|(k, &n)| if k + 2 >= rank { n } else { 1 }).collect();
        let mut start = vec![0; rank];
        if let Some(row) = row {
            (start[rank - 2], count[rank - 2]) = (row, 1);
        }
        let packing = self.packing(index)?;
        let radians = variable.units().is_some_and(|u| u.to_ascii_lowercase().starts_with("radian"));
        let degrees = |v: f64| if radians { v.to_degrees() } else { v };
        Ok(self.file.read(index, &start, &count)?.into_iter().map(|v| degrees(packing.unpack(v))).collect())
    }

    /// Refuses a later file whose points are not those of the first: its first and last row tell, and cost little to read.
    fn on_the_same_points(&self, pairs: &[Pair], first: &Curvilinear) -> Result<(), SourceError> {
        for (pair, mesh) in pairs.iter().zip(&first.meshes) {
            for (&index, known) in pair.iter().zip([&mesh.longitude, &mesh.latitude]) {
                for row in [0, mesh.shape[1] - 1] {
                    let here = self.rows(index, Some(row))?;
                    let there = &known[row * mesh.shape[0]..][..mesh.shape[0]];
                    let other = here.iter().zip(there).find(|(a, b)| a != b && !(a.is_nan() && b.is_nan()));
                    if let Some((a, b)) = other {
                        let what =
                            format!("it is {a} where that of the first file is {b} (row {row}); the files of an archive lie on one grid");
                        return Err(self.misfit(index, what));
                    }
                }
            }
        }
        Ok(())
    }

    /// Whether u and v run along the grid's own directions, and why that is thought.
    fn runs_along_grid(&self, u: usize) -> (bool, String) {
        let variable = &self.header().variables[u];
        let standard = variable.text("standard_name").unwrap_or_default();
        let says = |text: &str| text.contains("eastward") || text.contains("zonal");
        let long = variable.text("long_name").unwrap_or_default().to_ascii_lowercase();
        match self.settings.grid_relative {
            Some(along) => (along, "as set".into()),
            None if says(standard) => (false, format!("standard_name `{standard}`")),
            None if standard.is_empty() && says(&long) => (false, format!("long_name `{long}`")),
            None if !standard.is_empty() => (true, format!("standard_name `{standard}`")),
            None => (true, "no name says eastward; `grid_relative = false` otherwise".into()),
        }
    }

    pub(super) fn plan_curvilinear(mut self, velocity: &Velocity, pairs: Vec<Pair>, first: Option<&Layout>) -> Result<Layout, SourceError> {
        if self.settings.region.is_some() {
            return Err(SourceError::Setting {
                key: "region",
                found: "given".into(),
                accepted: "longitudes and latitudes of two dimensions are read whole".into(),
            });
        }
        let u = velocity.u.variable;
        let tail = |pair: &Pair| {
            let dims = &self.header().variables[pair[0]].dimensions;
            [dims[dims.len() - 1], dims[dims.len() - 2]]
        };
        let tails: Vec<[usize; 2]> = pairs.iter().map(tail).collect();
        let mut extents = self.extents(u)?;
        for extent in &mut extents {
            if let Some(k) = tails[0].iter().position(|&d| d == extent.dimension) {
                extent.kind = [Kind::Longitude, Kind::Latitude][k];
            }
        }
        self.name_by_position(u, &mut extents)?;
        let level = self.pick_level(&mut extents)?;
        let time = self.time(&extents)?;
        let level_extent = extents.iter().find(|e| e.kind == Kind::Level && Some(e.dimension) != level.map(|l| l.0));
        let three = level_extent.is_some();
        let metric = self.metric(&extents, three)?;
        if metric != Metric::Sphere {
            let what = "its levels are neither pressures nor lengths, which the sphere needs: pick one with `level = ...`";
            return Err(self.misfit(u, what.into()));
        }
        let level_extent = extents.iter().find(|e| e.kind == Kind::Level && Some(e.dimension) != level.map(|l| l.0));
        let level_axis = level_extent.map(|e| self.axis(u, e, 2)).transpose()?;

        let roles = |variable: usize, tail: [usize; 2]| -> Vec<(usize, Role)> {
            let dims = &self.header().variables[variable].dimensions;
            dims.iter()
                .map(|&d| {
                    let role = match tail.iter().position(|&t| t == d) {
                        Some(k) => Role::Axis(k),
                        None if level.is_some_and(|l| l.0 == d) => Role::Fixed(level.map_or(0, |l| l.1)),
                        None => match self.measured(d).kind {
                            Kind::Time => Role::Time,
                            Kind::Level if three && self.header().dimensions[d].len > 1 => Role::Axis(2),
                            _ => Role::Fixed(0),
                        },
                    };
                    (d, role)
                })
                .collect()
        };
        let all_roles: Vec<Vec<(usize, Role)>> = [Some(&velocity.u), Some(&velocity.v), velocity.w.as_ref()]
            .into_iter()
            .flatten()
            .zip(&tails)
            .map(|(c, &t)| roles(c.variable, t))
            .collect();
        let mut components = vec![self.component(&velocity.u, &all_roles[0], None)?, self.component(&velocity.v, &all_roles[1], None)?];
        let flat = |c: &ComponentPlan| c.roles.iter().zip(&c.shape).find(|(r, _)| **r == Role::Axis(2)).map_or(1, |(_, &n)| n);
        if flat(&components[0]) != flat(&components[1]) {
            let what = format!("u has {} levels, v {}", flat(&components[0]), flat(&components[1]));
            return Err(self.misfit(velocity.v.variable, what));
        }
        let w_roles = all_roles.get(2).cloned().unwrap_or_default();
        // The third axis is what matters to w.
        let axes_of_w = level_axis.as_ref().map_or_else(Vec::new, |level| vec![level.clone(); 3]);
        let w = self.vertical_component(velocity.w.as_ref(), &w_roles, &axes_of_w, three)?;
        // Levels of w between those of u would have to be interpolated.
        match w {
            Some(w) if flat(&w) == flat(&components[0]) => components.push(w),
            Some(w) => self.notes.push(format!("`{}` lies on other levels than u: vertical motion is taken as 0", w.name)),
            None => {}
        }

        let known = first.and_then(|l| {
            let same = l.frames[0].iter().map(|c| &c.shape).eq(components.iter().map(|c| &c.shape));
            l.resampling.clone().filter(|_| same).map(|r| (r, l.axes[..2].to_vec()))
        });
        if let Some((Resampling::Curvilinear(first), _)) = known.as_ref().map(|(r, axes)| (&**r, axes)) {
            self.on_the_same_points(&pairs[..components.len()], first)?;
        }
        let (resampling, mut axes) = match known {
            Some(known) => known,
            None => self.resample(&pairs[..components.len()], u)?,
        };
        if let Some(level) = level_axis {
            axes.push(level);
        }
        let (vertical, poles) = self.finish_axes(&mut axes, metric)?;
        Ok(Layout { frames: vec![components], axes, vertical, poles, time, metric, resampling: Some(resampling), notes: self.notes })
    }

    /// Makes the grid and finds its nodes among the points of each component.
    fn resample(&mut self, pairs: &[Pair], u: usize) -> Result<(Arc<Resampling>, Vec<AxisPlan>), SourceError> {
        let mut meshes: Vec<(Pair, Arc<Mesh>)> = Vec::new();
        for pair in pairs {
            let known = meshes.iter().find(|(p, _)| p == pair).map(|(_, m)| m.clone());
            let mesh = match known {
                Some(mesh) => mesh,
                None => Arc::new(self.mesh(*pair)?),
            };
            meshes.push((*pair, mesh));
        }
        let of_u = &meshes[0].1;
        let target = target(of_u, self.settings.resolution).map_err(|what| self.misfit(pairs[0][0], what))?;
        let mut locators: Vec<Arc<Locator>> = Vec::new();
        for (k, (pair, mesh)) in meshes.iter().enumerate() {
            let known = meshes[..k].iter().position(|(p, _)| p == pair);
            locators.push(known.map_or_else(|| Arc::new(Locator::new(mesh, &target)), |i| locators[i].clone()));
        }
        let (along, why) = self.runs_along_grid(u);
        let directions = std::array::from_fn(|k| meshes[k].1.directions(along).into_iter().map(|both| both[k]).collect());
        let names = pairs[0].map(|i| self.header().variables[i].name.clone());
        let what = format!(
            "`{}` and `{}` have two dimensions: resampled bilinearly from {} x {} points to {} x {} nodes, every {:.4} x {:.4} degrees",
            names[0], names[1], of_u.shape[0], of_u.shape[1], target.nodes[0], target.nodes[1], target.step[0], target.step[1]
        );
        self.notes.push(what.clone());
        let which = if along { "the grid's own directions, and are turned to east and north" } else { "east and north" };
        self.notes.push(format!("velocities run along {which} ({why})"));
        let path = self.path().to_path_buf();
        let fault = |fault: AxisFault| SourceError::Axis { path: path.clone(), fault };
        let kinds = [(Kind::Longitude, "degrees_east"), (Kind::Latitude, "degrees_north")];
        let mut axes = Vec::new();
        for (k, (kind, units)) in kinds.into_iter().enumerate() {
            let last = target.first[k] + target.step[k] * (target.nodes[k] - 1) as f64;
            let mut axis = Axis::uniform(names[k].as_str(), units, target.first[k], last, target.nodes[k]).map_err(fault)?;
            if k == 0 && target.round && self.goes_round() {
                axis = axis.with_period(360.0);
            }
            axes.push(AxisPlan::made(kind, axis, Quantity::Angle));
        }
        let meshes = meshes.into_iter().map(|(_, m)| m).collect();
        let resampled = Curvilinear { locators, meshes, target, directions, bases: target.bases(), what };
        Ok((Arc::new(Resampling::Curvilinear(Box::new(resampled))), axes))
    }
}
