//! WRF: components on the faces of the cells (Arakawa C) and levels that follow the terrain, brought onto heights.
//!
//! The grid holds faces and centres alike, so that linear interpolation on it is, horizontally, exactly the linear interpolation of each
//! component from its own faces: nothing is averaged first. Vertically, each column is interpolated linearly between its own levels, whose
//! heights are (PH + PHB) / g on the full levels (of w) and half way between them on the half levels (of u and v).
//!
//! Positions count cells from the first centre: centres are at 0, 1, 2, ..., faces at -0.5, 0.5, ....

use super::SourceError;
use super::axes::{AxisPlan, Quantity};
use super::cf::coordinate::{Kind, classify_name};
use super::cf::velocity::Velocity;
use super::container::{Container, NumberType};
use super::dimensions::Extent;
use super::hyperslab::{as_in_file, read_component};
use super::layout::{ComponentPlan, Layout, Planner, Resampling, Role};
use super::nest::{Nest, Shift};
use super::settings::{Metric, Staggering, VelocityUnit};
use crate::field::{Axis, AxisFault};
use std::sync::Arc;

/// The acceleration of gravity that WRF computes with, m/s^2.
const GRAVITY: f64 = 9.81;

/// What it takes to read a file.
#[derive(Debug, Clone)]
pub(super) struct Staggered {
    /// Perturbation and base-state geopotential on full levels.
    geopotential: [ComponentPlan; 2],
    /// Map scale factors at the points of u and v, where the file has them.
    scale: [Option<ComponentPlan>; 2],
    /// Centres along x and y, half levels.
    cells: [usize; 3],
    /// Nodes of the grid a cell.
    fineness: usize,
    /// Heights of the grid, metres.
    heights: Vec<f64>,
    /// Distances between centres along x and y, metres of the projection.
    step: [f64; 2],
    /// Where the grid lies, where the file tells.
    nest: Option<Nest>,
    /// The places that the grid takes at the times of the archive.
    reach: Reach,
    /// See [`Self::what`].
    what: String,
}

/// The least and the greatest shift along x and y.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(super) struct Reach {
    least: Shift,
    greatest: Shift,
}

impl Reach {
    fn with(self, other: Self) -> Self {
        let both = |f: fn(isize, isize) -> isize, a: Shift, b: Shift| [f(a[0], b[0]), f(a[1], b[1])];
        Self { least: both(isize::min, self.least, other.least), greatest: both(isize::max, self.greatest, other.greatest) }
    }
}

/// Linear interpolation along one axis: two entries and the weight of the second.
#[derive(Debug, Clone, Copy)]
struct Tap {
    first: usize,
    second: usize,
    weight: f32,
}

impl Tap {
    /// At a place counted in entries, within the ends.
    fn at(place: f64, count: usize) -> Self {
        let place = place.clamp(0.0, (count - 1) as f64);
        let first = (place.floor() as usize).min(count.saturating_sub(2));
        Self { first, second: (first + 1).min(count - 1), weight: (place - first as f64) as f32 }
    }

    fn of(self, value: impl Fn(usize) -> f32) -> f32 {
        // A weight of 0 must not let a missing neighbour in.
        match self.weight {
            0.0 => value(self.first),
            1.0 => value(self.second),
            w => value(self.first) * (1.0 - w) + value(self.second) * w,
        }
    }
}

/// Values of `count` levels on planes of `width` points, brought onto other points of the plane.
fn spread(values: &[f32], [mx, my]: [usize; 2], x: &[Tap], y: &[Tap]) -> Vec<f32> {
    let mut out = Vec::with_capacity(values.len() / (mx * my) * x.len() * y.len());
    for plane in values.chunks_exact(mx * my) {
        for ty in y {
            for tx in x {
                out.push(ty.of(|j| tx.of(|i| plane[j * mx + i])));
            }
        }
    }
    out
}

/// Linear interpolation in a column whose level `k` is at `height(k)`, ascending; None outside.
fn in_column(z: f32, count: usize, height: impl Fn(usize) -> f32, value: impl Fn(usize) -> f32) -> Option<f32> {
    if !(z >= height(0) && z <= height(count - 1)) {
        return None;
    }
    let (mut low, mut high) = (0, count - 1);
    while high - low > 1 {
        let middle = (low + high) / 2;
        if height(middle) <= z { low = middle } else { high = middle }
    }
    let weight = (z - height(low)) / (height(high) - height(low));
    Some(value(low) * (1.0 - weight) + value(high) * weight)
}

impl Staggered {
    /// What is done, in words.
    pub(super) fn what(&self) -> &str {
        &self.what
    }

    /// Places along x or y of the nodes on the file's cells.
    fn places(&self, axis: usize) -> Vec<f64> {
        (0..(self.cells[axis] - 1) * self.fineness + 1).map(|a| a as f64 / self.fineness as f64).collect()
    }

    /// Taps at places for a component whose points are centres or, on a staggered axis, faces.
    fn taps(&self, axis: usize, places: &[f64], faces: bool) -> Vec<Tap> {
        let (shift, count) = if faces { (0.5, self.cells[axis] + 1) } else { (0.0, self.cells[axis]) };
        places.iter().map(|p| Tap::at(p + shift, count)).collect()
    }

    fn values(file: &Container, plan: &ComponentPlan, entry: usize) -> Result<Vec<f32>, SourceError> {
        read_component(file, plan, &as_in_file(plan), entry)
    }

    /// Heights of the full levels, centres.
    fn full_levels(&self, file: &Container, entry: usize) -> Result<Vec<f32>, SourceError> {
        let mut heights = Self::values(file, &self.geopotential[0], entry)?;
        let base = Self::values(file, &self.geopotential[1], entry)?;
        heights.iter_mut().zip(&base).for_each(|(h, b)| *h = ((f64::from(*h) + f64::from(*b)) / GRAVITY) as f32);
        Ok(heights)
    }

    /// A component at its own points, in m/s of the projection's plane.
    fn component(&self, file: &Container, frame: &[ComponentPlan], which: usize, entry: usize) -> Result<Vec<f32>, SourceError> {
        let mut values = Self::values(file, &frame[which], entry)?;
        if let Some(Some(plan)) = self.scale.get(which) {
            let scale = Self::values(file, plan, entry)?;
            values.chunks_exact_mut(scale.len()).for_each(|plane| plane.iter_mut().zip(&scale).for_each(|(v, s)| *v *= s));
        }
        Ok(values)
    }

    /// Points of a component along x and y.
    fn points(&self, which: usize) -> [usize; 2] {
        [self.cells[0] + usize::from(which == 0), self.cells[1] + usize::from(which == 1)]
    }

    /// One time, onto the grid: missing below the ground, above the highest full level, and where a nest that moves is not.
    pub(super) fn read(&self, file: &Container, frame: &[ComponentPlan], entry: usize) -> Result<Vec<Vec<f32>>, SourceError> {
        let own = self.on_own_cells(file, frame, entry)?;
        if self.reach == Reach::default() {
            return Ok(own);
        }
        let shift = self.nest.as_ref().map_or(Ok([0; 2]), |nest| nest.shift(file, entry))?;
        let nodes = [0, 1].map(|k| self.places(k).len());
        let all = [0, 1].map(|k| nodes[k] + (self.reach.greatest[k] - self.reach.least[k]) as usize * self.fineness);
        // A file that changed since it was opened may lie anywhere.
        if (0..2).any(|k| shift[k] < self.reach.least[k] || shift[k] > self.reach.greatest[k]) {
            let what = "it changed since the archive was opened".into();
            return Err(SourceError::Read { path: file.path.clone(), variable: frame[0].name.clone(), what });
        }
        let from = [0, 1].map(|k| (shift[k] - self.reach.least[k]) as usize * self.fineness);
        let spread_out = |values: &Vec<f32>| {
            let mut out = vec![f32::NAN; all[0] * all[1] * self.heights.len()];
            for (row, line) in values.chunks_exact(nodes[0]).enumerate() {
                let (level, y) = (row / nodes[1], row % nodes[1]);
                out[(level * all[1] + from[1] + y) * all[0] + from[0]..][..nodes[0]].copy_from_slice(line);
            }
            out
        };
        Ok(own.iter().map(spread_out).collect())
    }

    /// One time, onto nodes on the file's own cells.
    fn on_own_cells(&self, file: &Container, frame: &[ComponentPlan], entry: usize) -> Result<Vec<Vec<f32>>, SourceError> {
        let places = [self.places(0), self.places(1)];
        let centres: [Vec<Tap>; 2] = [0, 1].map(|k| self.taps(k, &places[k], false));
        let plane = places[0].len() * places[1].len();
        let full = spread(&self.full_levels(file, entry)?, [self.cells[0], self.cells[1]], &centres[0], &centres[1]);
        let half_levels = self.cells[2];
        let mut out = Vec::with_capacity(3);
        for which in 0..frame.len() {
            let values = self.component(file, frame, which, entry)?;
            let taps: [Vec<Tap>; 2] = [0, 1].map(|k| self.taps(k, &places[k], which == k));
            let values = spread(&values, self.points(which), &taps[0], &taps[1]);
            let mut on_heights = vec![f32::NAN; plane * self.heights.len()];
            for point in 0..plane {
                let at_full = |k: usize| full[k * plane + point];
                let at_half = |k: usize| 0.5 * (at_full(k) + at_full(k + 1));
                let value = |k: usize| values[k * plane + point];
                for (level, &z) in self.heights.iter().enumerate() {
                    let z = z as f32;
                    let found = match which {
                        2 => in_column(z, half_levels + 1, at_full, value),
                        // Between the ground and the lowest half level the wind is that of the latter; above the highest alike.
                        _ if z >= at_full(0) && z < at_half(0) => Some(value(0)),
                        _ if z > at_half(half_levels - 1) && z <= at_full(half_levels) => Some(value(half_levels - 1)),
                        _ => in_column(z, half_levels, at_half, value),
                    };
                    on_heights[level * plane + point] = found.unwrap_or(f32::NAN);
                }
            }
            out.push(on_heights);
        }
        Ok(out)
    }

    /// The axes of x and y, in metres: the first centre of the first time is at half a cell.
    fn horizontal(&self) -> Result<[AxisPlan; 2], AxisFault> {
        let plan = |k: usize, name: &str, kind: Kind| {
            let Reach { least, greatest } = self.reach;
            let nodes = (self.cells[k] - 1 + (greatest[k] - least[k]) as usize) * self.fineness + 1;
            let place = |a: usize| least[k] as f64 + a as f64 / self.fineness as f64;
            let axis = Axis::new(name, "m", (0..nodes).map(|a| (place(a) + 0.5) * self.step[k]).collect())?;
            Ok(AxisPlan::made(kind, axis, Quantity::Length))
        };
        Ok([plan(0, "west_east", Kind::X)?, plan(1, "south_north", Kind::Y)?])
    }

    /// What interpolation on the grid gives at the file's own points, held against what the file has there: m/s, root mean square.
    pub(super) fn error(&self, file: &Container, frame: &[ComponentPlan], entry: usize) -> Result<[f64; 2], SourceError> {
        let grid = self.on_own_cells(file, frame, entry)?;
        let full = self.full_levels(file, entry)?;
        let [nx, ny, nz] = self.cells;
        let nodes = [(nx - 1) * self.fineness + 1, (ny - 1) * self.fineness + 1];
        let heights: Vec<f32> = self.heights.iter().map(|&z| z as f32).collect();
        let (mut wrong, mut size, mut count) = (0.0, 0.0, 0usize);
        for which in 0..frame.len() {
            let values = self.component(file, frame, which, entry)?;
            let points = self.points(which);
            let levels = if which == 2 { nz + 1 } else { nz };
            for (n, &value) in values.iter().enumerate() {
                let (i, j, k) = (n % points[0], n / points[0] % points[1], n / (points[0] * points[1]));
                let place = [i as f64 - if which == 0 { 0.5 } else { 0.0 }, j as f64 - if which == 1 { 0.5 } else { 0.0 }];
                if k >= levels || place[0] < 0.0 || place[1] < 0.0 || place[0] > (nx - 1) as f64 || place[1] > (ny - 1) as f64 {
                    continue;
                }
                let here = [0, 1].map(|a| Tap::at(place[a], self.cells[a]));
                let at_full = |k: usize| here[1].of(|j| here[0].of(|i| full[(k * ny + j) * nx + i]));
                let z = if which == 2 { at_full(k) } else { 0.5 * (at_full(k) + at_full(k + 1)) };
                let on_grid = [0, 1].map(|a| Tap::at(place[a] * self.fineness as f64, nodes[a]));
                let at_level = |l: usize| on_grid[1].of(|b| on_grid[0].of(|a| grid[which][(l * nodes[1] + b) * nodes[0] + a]));
                let found = in_column(z, heights.len(), |l| heights[l], at_level);
                if let Some(found) = found.filter(|f| f.is_finite() && value.is_finite()) {
                    wrong += f64::from(found - value).powi(2);
                    size += f64::from(value).powi(2);
                    count += 1;
                }
            }
        }
        let mean = |sum: f64| (sum / count.max(1) as f64).sqrt();
        Ok([mean(wrong), mean(size)])
    }

    /// What is to be said of a grid that moves.
    fn moves(&self) -> Option<String> {
        let cells = [0, 1].map(|k| self.reach.greatest[k] - self.reach.least[k]);
        (self.reach != Reach::default()).then(|| {
            format!(
                "the grid moves, by up to {} and {} cells along x and y: each time lies in its place, in a domain that holds all places; \
                 velocities are missing where the grid is not",
                cells[0], cells[1]
            )
        })
    }
}

impl Layout {
    /// Widens the domain of a nest to that of a later file, which holds it.
    pub(super) fn widen(&mut self, later: &Self) -> Result<(), AxisFault> {
        let (Some(Resampling::Staggered(own)), Some(Resampling::Staggered(other))) =
            (self.resampling.as_deref(), later.resampling.as_deref())
        else {
            return Ok(());
        };
        if own.reach == other.reach {
            return Ok(());
        }
        let wide = Staggered { reach: other.reach, ..(**own).clone() };
        let known = own.moves();
        self.notes.retain(|note| Some(note) != known.as_ref());
        self.notes.extend(wide.moves());
        for (axis, wider) in self.axes.iter_mut().zip(wide.horizontal()?) {
            *axis = wider;
        }
        self.resampling = Some(Arc::new(Resampling::Staggered(Box::new(wide))));
        Ok(())
    }
}

impl Planner<'_> {
    /// Whether the chosen components are staggered as WRF has them.
    pub(super) fn is_staggered(&self, velocity: &Velocity) -> bool {
        let header = self.header();
        let ends_staggered = |variable: usize, from_end: usize| {
            let dims = &header.variables[variable].dimensions;
            dims.len().checked_sub(from_end + 1).is_some_and(|k| header.dimensions[dims[k]].name.ends_with("_stag"))
        };
        ends_staggered(velocity.u.variable, 0)
            && ends_staggered(velocity.v.variable, 1)
            && header.find("PH").is_some()
            && header.find("PHB").is_some()
    }

    /// A variable on (time, level, y, x), or fewer of these from the left.
    fn plain(&self, variable: usize, factor: f64, why: String) -> Result<ComponentPlan, SourceError> {
        let v = &self.header().variables[variable];
        let rank = v.dimensions.len();
        let time = |d: usize| classify_name(&self.header().dimensions[d].name) == Kind::Time;
        let role = |place: usize| match rank - 1 - place {
            _ if place == 0 && time(v.dimensions[0]) => Role::Time,
            axis @ 0..=2 => Role::Axis(axis),
            _ => Role::Fixed(0),
        };
        Ok(ComponentPlan {
            name: v.name.clone(),
            shape: self.header().shape(v),
            roles: (0..rank).map(role).collect(),
            packing: self.packing(variable)?,
            factor,
            why,
        })
    }

    pub(super) fn plan_staggered(mut self, velocity: &Velocity, first: Option<&Layout>) -> Result<Layout, SourceError> {
        let s = self.settings;
        let fault = |key, found: &str, accepted: &str| Err(SourceError::Setting { key, found: found.into(), accepted: accepted.into() });
        if s.metric.is_some_and(|m| m != Metric::Cartesian) || s.velocity_unit == VelocityUnit::Cells {
            return fault("metric", "not cartesian", "WRF output is read in metres: `metric = \"cartesian\"` and velocities in SI");
        }
        if s.level.is_some() || s.region.is_some() {
            let key = if s.level.is_some() { "level" } else { "region" };
            return fault(key, "given", "WRF output is read whole and in three dimensions; choose heights with `heights`");
        }
        let mut components = Vec::new();
        for (candidate, from_end) in [(Some(&velocity.u), 0), (Some(&velocity.v), 1), (velocity.w.as_ref(), 2)] {
            let Some(candidate) = candidate else {
                self.notes.push("no vertical velocity found: it is taken as 0".into());
                continue;
            };
            let checked = self.component(candidate, &[], None)?;
            let plan = self.plain(candidate.variable, checked.factor, candidate.why.clone())?;
            if from_end == 2 && plan.shape.len() != components.first().map_or(0, |u: &ComponentPlan| u.shape.len()) {
                continue;
            }
            components.push(plan);
        }
        let along = |plan: &ComponentPlan, axis: usize| plan.shape.iter().rev().nth(axis).copied().unwrap_or(1);
        let cells = [along(&components[0], 0).saturating_sub(1), along(&components[0], 1), along(&components[0], 2)];
        let find = |name: &str| self.header().find(name);
        let geopotential = match (find("PH"), find("PHB")) {
            (Some(p), Some(b)) => [self.plain(p, 1.0, String::new())?, self.plain(b, 1.0, String::new())?],
            _ => return Err(self.not_found("heights", "PH")),
        };
        let expected = [[cells[0] + 1, cells[1], cells[2]], [cells[0], cells[1] + 1, cells[2]], [cells[0], cells[1], cells[2] + 1]];
        for (plan, expected) in components.iter().zip(expected).chain(geopotential.iter().map(|g| (g, expected[2]))) {
            let found = [0, 1, 2].map(|k| along(plan, k));
            if found != expected || plan.shape.len() < 3 || cells.iter().any(|&n| n < 2) {
                let what = format!(
                    "it has {found:?} points along x, y and its levels; {expected:?} would fit {cells:?} cells, of which 2 are needed at least"
                );
                return Err(SourceError::Layout { path: self.path().into(), variable: plan.name.clone(), what });
            }
        }
        let scale = [["MAPFAC_U", "MAPFAC_UX"], ["MAPFAC_V", "MAPFAC_VY"]].map(|names| {
            let variable = names.iter().find_map(|n| find(n))?;
            Some(self.plain(variable, 1.0, String::new()))
        });
        let scale: Vec<Option<ComponentPlan>> = scale
            .into_iter()
            .enumerate()
            .map(|(k, plan)| Ok(plan.transpose()?.filter(|p| along(p, 0) == expected[k][0] && along(p, 1) == expected[k][1])))
            .collect::<Result<_, SourceError>>()?;
        let scale: [Option<ComponentPlan>; 2] = std::array::from_fn(|k| scale[k].clone());
        let (Some(dx), Some(dy)) = (self.header().number("DX"), self.header().number("DY")) else {
            return Err(SourceError::Layout {
                path: self.path().into(),
                variable: components[0].name.clone(),
                what: "the file has no attributes DX and DY, the distances between its points in metres".into(),
            });
        };
        let extents = self.time_extents(velocity.u.variable);
        // Minutes are written in single precision, characters are exact.
        let characters = find("Times").filter(|&i| self.settings.time.is_none() && self.header().variables[i].number == NumberType::Text);
        let time = match (characters, extents.first()) {
            (Some(index), Some(extent)) => self.characters(index, self.header().dimensions[extent.dimension].len)?,
            _ => self.time(&extents)?,
        };
        let fineness = if s.staggering == Staggering::Faces { 2 } else { 1 };
        // All files of an archive share the domain and the heights of the first.
        let same = first.and_then(|l| match l.resampling.as_deref() {
            Some(Resampling::Staggered(s)) => Some(s),
            _ => None,
        });
        let nest = match same {
            Some(first) => first.nest.clone(),
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
            None => self.notes.push("no XLONG and XLAT of its centres: the grid is taken to stay where it is".into()),
        }
        let reach = same.map_or(own_reach, |s| s.reach.with(own_reach));
        let mut staggered =
            Staggered { geopotential, scale, cells, fineness, heights: Vec::new(), step: [dx, dy], nest, reach, what: String::new() };
        staggered.heights = match (same.map(|s| s.heights.clone()), &s.heights) {
            (Some(heights), _) => heights,
            (None, Some(heights)) => heights.clone(),
            (None, None) => mean_heights(&staggered, &staggered.full_levels(self.file, 0)?),
        };
        staggered.what = format!(
            "components on faces: read on a grid of {}, {} onto {} heights from {:.0} to {:.0} m ({})",
            if fineness == 2 { "faces and centres" } else { "centres" },
            "each column interpolated between its own levels, whose heights are (PH + PHB) / g,",
            staggered.heights.len(),
            staggered.heights.first().copied().unwrap_or(0.0),
            staggered.heights.last().copied().unwrap_or(0.0),
            if s.heights.is_some() { "as set" } else { "the mean heights of its full and half levels; others with `heights`" }
        );
        self.notes.push(staggered.what.clone());
        self.notes.push(match staggered.scale {
            [Some(_), Some(_)] => "metres are those of the map projection: u and v are multiplied by its scale factors MAPFAC".into(),
            _ => "no map scale factors (MAPFAC_U, MAPFAC_V): metres of the projection are taken for metres on the ground".into(),
        });
        self.notes.push(
            "below the lowest half level, and above the highest, the wind is that of the half level; below the ground it is missing".into(),
        );
        self.notes.extend(staggered.moves());
        let path = self.path().to_path_buf();
        let fault = |fault: AxisFault| SourceError::Axis { path: path.clone(), fault };
        let mut axes = staggered.horizontal().map_err(fault)?.to_vec();
        let levels = Axis::new("height", "m", staggered.heights.clone()).map_err(fault)?;
        axes.push(AxisPlan::made(Kind::Level, levels, Quantity::Length));
        let (vertical, poles) = self.finish_axes(&mut axes, Metric::Cartesian)?;
        Ok(Layout {
            frames: vec![components],
            axes,
            vertical,
            poles,
            time,
            metric: Metric::Cartesian,
            resampling: Some(Arc::new(Resampling::Staggered(Box::new(staggered)))),
            notes: self.notes,
        })
    }

    /// The time dimension of a variable, where it has one.
    pub(super) fn time_extents(&self, variable: usize) -> Vec<Extent> {
        let dims = &self.header().variables[variable].dimensions;
        let extent = |&dimension: &usize| {
            let found = self.measured(dimension);
            (found.kind == Kind::Time).then_some(found)
        };
        dims.iter().filter_map(extent).collect()
    }
}

/// Heights of full and half levels, averaged over the plane; the lowest is that of the lowest ground, the highest that of the highest half
/// level where it is lowest: every column reaches up to it.
fn mean_heights(staggered: &Staggered, full: &[f32]) -> Vec<f64> {
    let plane = staggered.cells[0] * staggered.cells[1];
    let means: Vec<f64> = full.chunks_exact(plane).map(|p| p.iter().map(|&z| f64::from(z)).sum::<f64>() / plane as f64).collect();
    let lowest = full[..plane].iter().map(|&z| f64::from(z)).fold(f64::INFINITY, f64::min);
    let mut heights = vec![lowest.min(means[0])];
    for pair in means.windows(2) {
        heights.push(0.5 * (pair[0] + pair[1]));
        heights.push(pair[1]);
    }
    // u lies on half levels: the grid ends at the highest of them, where it is lowest.
    let (below, top) = (&full[full.len() - 2 * plane..][..plane], &full[full.len() - plane..]);
    let highest = below.iter().zip(top).map(|(a, b)| 0.5 * (f64::from(*a) + f64::from(*b))).fold(f64::INFINITY, f64::min);
    heights.retain(|&z| z < highest);
    heights.push(highest);
    heights
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn taps_meet_faces_and_centres() {
        let staggered = Staggered {
            geopotential: std::array::from_fn(|_| ComponentPlan::test()),
            scale: [None, None],
            cells: [3, 2, 2],
            fineness: 2,
            heights: Vec::new(),
            step: [1.0; 2],
            nest: None,
            reach: Reach::default(),
            what: String::new(),
        };
        let places = staggered.places(0);
        assert_eq!(places, [0.0, 0.5, 1.0, 1.5, 2.0]);
        // u lies on faces -0.5, 0.5, 1.5, 2.5: nodes on faces are its own values, those on centres half way between two.
        let u = [10.0f32, 20.0, 40.0, 80.0];
        let on_grid: Vec<f32> = staggered.taps(0, &places, true).iter().map(|t| t.of(|i| u[i])).collect();
        assert_eq!(on_grid, [15.0, 20.0, 30.0, 40.0, 60.0]);
        let centred: Vec<f32> = staggered.taps(0, &places, false).iter().map(|t| t.of(|i| u[i])).collect();
        assert_eq!(centred, [10.0, 15.0, 20.0, 30.0, 40.0]);
    }

    #[test]
    fn columns_end_where_their_levels_do() {
        let heights = [0.0f32, 10.0, 40.0];
        let at = |z: f32| in_column(z, 3, |k| heights[k], |k| heights[k] * 2.0);
        assert_eq!((at(5.0), at(25.0), at(40.0)), (Some(10.0), Some(50.0), Some(80.0)));
        assert_eq!((at(-0.1), at(40.1), at(f32::NAN)), (None, None, None));
    }
}
