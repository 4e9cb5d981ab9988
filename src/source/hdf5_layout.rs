//! HDF5 archives: which datasets hold the velocity, what their axes are, and where the time is.
//!
//! Understood without settings: cutouts of the Johns Hopkins turbulence databases in both layouts (`Velocity_0001` (z, y, x, component)
//! with `xcoor`, `ycoor`, `zcoor`; `u01000` of the same shape), and separate components with coordinates of their own (`u`, `v`, `w` or
//! other usual names, and `x`, `y`, `z`). Everything else is named by the settings.

use super::SourceError;
use super::axes::{AxisPlan, Coordinates};
use super::cf::coordinate::Kind;
use super::cf::units::Unit;
use super::cf::velocity;
use super::container::{Attribute, Variable};
use super::layout::{ComponentPlan, Layout, Planner, Role, list_candidates};
use super::settings::{Metric, VelocityUnit};
use super::times::TimePlan;

/// Names of a scalar, attribute or dataset that holds the time.
const TIME_NAMES: [&str; 5] = ["time", "Time", "t", "simulation_time", "physical_time"];
/// Most nodes along an axis: single precision tells no more places apart, and a damaged shape must not take memory before it is refused.
const MOST_ALONG: usize = 1 << 24;
/// Names of coordinates, compared without their group and without regard to case; `x` stands for the axis.
const COORDINATE_NAMES: [&str; 7] = ["x", "xcoor", "xc", "x_coordinate", "coords_x", "grid_x", "x_coor"];

/// One time: datasets of u, v and w, or one that holds all.
struct Frame {
    /// Index of the variable of each component, and its entry along the component axis where the dataset holds all.
    components: Vec<(usize, Option<usize>)>,
    /// The number in the dataset's name.
    number: Option<f64>,
}

/// Datasets of a name in which `*` stands for digits, with the number; sorted by it.
fn matching(variables: &[Variable], pattern: &str) -> Vec<(usize, Option<f64>)> {
    let mut found: Vec<(usize, Option<f64>)> = match pattern.split_once('*') {
        None => variables.iter().position(|v| v.name == pattern).map(|i| (i, None)).into_iter().collect(),
        Some((before, after)) => {
            let number = |v: &Variable| {
                let digits = v.name.strip_prefix(before)?.strip_suffix(after)?;
                digits.parse::<f64>().ok().filter(|n| n.is_finite() && digits.bytes().all(|b| b.is_ascii_digit() || b == b'.'))
            };
            variables.iter().enumerate().filter_map(|(i, v)| number(v).map(|n| (i, Some(n)))).collect()
        }
    };
    found.sort_by(|a, b| a.1.unwrap_or(0.0).total_cmp(&b.1.unwrap_or(0.0)));
    found
}

/// The last number in a text.
fn last_number(text: &str) -> Option<f64> {
    let end = text.rfind(|c: char| c.is_ascii_digit())? + 1;
    let start = text[..end].rfind(|c: char| !(c.is_ascii_digit() || c == '.')).map_or(0, |i| i + 1);
    text[start..end].trim_start_matches('.').parse().ok()
}

impl Planner<'_> {
    pub(super) fn plan_hdf5(mut self) -> Result<Layout, SourceError> {
        let s = self.settings;
        let (frames, why) = self.frames()?;
        let (first, part) = frames[0].components[0];
        let order = self.order(first, part.is_some())?;
        let shape = self.header().shape(&self.header().variables[first]);
        let three = order.contains(&b'z') && s.level.is_none();
        if s.level.is_some() || s.region.is_some() {
            let key = if s.level.is_some() { "level" } else { "region" };
            return Err(SourceError::Setting { key, found: "given".into(), accepted: "HDF5 archives are read whole".into() });
        }
        let metric = match (s.metric, s.velocity_unit) {
            (Some(Metric::Sphere), _) => {
                let accepted = "HDF5 archives are read as cartesian, or as index".into();
                return Err(SourceError::Setting { key: "metric", found: "sphere".into(), accepted });
            }
            (None | Some(Metric::Index), VelocityUnit::Cells) => Metric::Index,
            (Some(Metric::Cartesian), VelocityUnit::Cells) => {
                let accepted = "velocities in cells want `metric = \"index\"`".into();
                return Err(SourceError::Setting { key: "metric", found: "cartesian".into(), accepted });
            }
            (metric, VelocityUnit::Si) => metric.unwrap_or(Metric::Cartesian),
        };
        // What cannot be mended is told before what settings could add.
        for (letter, name) in [(b'x', "x"), (b'y', "y"), (b'z', "z")] {
            let Some(place) = order.iter().position(|&o| o == letter) else { continue };
            let nodes = shape[place];
            if nodes < 2 {
                let what = format!(
                    "it is {nodes} node(s) thick along {name}: no flow map can be traced in a single slab; accepted are 2 nodes or more along every axis"
                );
                return Err(self.misfit(first, what));
            }
            if nodes > MOST_ALONG {
                return Err(
                    self.misfit(first, format!("it claims {nodes} nodes along {name}; accepted are {MOST_ALONG} at most along an axis"))
                );
            }
        }
        // Before coordinates are made for a shape that is damaged.
        let nodes: Vec<usize> = order.iter().zip(&shape).filter(|(letter, _)| b"xyz".contains(letter)).map(|(_, &n)| n).collect();
        self.file.check_count(first, &nodes)?;
        let mut axes = Vec::new();
        for (k, letter) in [b'x', b'y', b'z'].into_iter().enumerate().take(if three { 3 } else { 2 }) {
            let Some(place) = order.iter().position(|&o| o == letter) else { continue };
            axes.push(self.hdf5_axis(first, k, shape[place])?);
        }
        let mut components = Vec::new();
        for frame in &frames {
            let plans = frame.components.iter().take(axes.len());
            let plans = plans.map(|&(variable, part)| self.hdf5_component(variable, part, &order, &shape, &why));
            components.push(plans.collect::<Result<Vec<_>, _>>()?);
        }
        let time = self.hdf5_times(&frames, &order)?;
        if components[0].len() < axes.len() {
            self.notes.push("no third component: motion along z is taken as 0".into());
        }
        let unit = |i: usize| self.header().variables[i].units().map(str::to_owned);
        if let Some(text) = unit(first).filter(|t| Unit::parse(t).is_none_or(|u| !u.is_velocity())) {
            self.notes.push(format!("unit `{text}` of the velocity is not converted"));
        }
        let (vertical, poles) = self.finish_axes(&mut axes, metric)?;
        Ok(Layout { frames: components, axes, vertical, poles, time, metric, resampling: None, notes: self.notes })
    }

    /// The datasets of each time, and why they were chosen.
    fn frames(&mut self) -> Result<(Vec<Frame>, String), SourceError> {
        let s = self.settings;
        let variables = &self.header().variables;
        let whole = |found: Vec<(usize, Option<f64>)>, parts: usize, first: usize| -> Vec<Frame> {
            let frame =
                |(i, number): (usize, Option<f64>)| Frame { components: (0..parts).map(|c| (i, Some(first + c))).collect(), number };
            found.into_iter().map(frame).collect()
        };
        if let Some(pattern) = &s.velocity {
            let found = matching(variables, pattern);
            let Some(&(first, _)) = found.first() else { return Err(self.not_found("velocity", pattern)) };
            let order = self.order(first, true)?;
            let place = order.iter().position(|&o| o == b'c').unwrap_or(0);
            let parts = self.header().shape(&variables[first])[place];
            if !(2..=3).contains(&parts) {
                return Err(self.misfit(first, format!("its component axis holds {parts} entries; accepted are 2 and 3")));
            }
            return Ok((whole(found, parts, 0), format!("named by the setting `velocity = \"{pattern}\"`")));
        }
        if s.u.is_some() || s.v.is_some() {
            return self.named_frames();
        }
        // Cutouts of the Johns Hopkins databases: four axes, the last one of three components.
        for pattern in ["Velocity_*", "velocity_*", "u*"] {
            let mut found = matching(variables, pattern);
            found.retain(|&(i, _)| matches!(self.header().shape(&variables[i])[..], [_, _, _, 3]) && variables[i].number.is_number());
            if !found.is_empty() {
                let why = format!("`{pattern}` with three components: a cutout of the Johns Hopkins turbulence databases");
                return Ok((whole(found, 3, 0), why));
            }
        }
        let ignore_w = s.w.as_deref() == Some("none");
        match velocity::choose(self.header(), [None, None, None], ignore_w) {
            Ok(found) => {
                let mut components = vec![(found.u.variable, None), (found.v.variable, None)];
                components.extend(found.w.map(|w| (w.variable, None)));
                Ok((vec![Frame { components, number: None }], found.u.why))
            }
            Err(lacking) => Err(self.no_hdf5_velocity(&lacking.what)),
        }
    }

    fn no_hdf5_velocity(&self, lacking: &str) -> SourceError {
        let header = self.header();
        let single = header.variables.iter().find(|v| matches!(header.shape(v)[..], [_, _, _, 1]) && v.number.is_number());
        let lacking = match single {
            Some(v) => format!("{lacking}; `{}` has one component a point: it is a scalar, and a flow map needs a velocity", v.name),
            None => lacking.to_owned(),
        };
        SourceError::NoVelocity { path: self.path().into(), lacking, candidates: list_candidates(header) }
    }

    /// Separate datasets that the settings name, each with a `*` or none.
    fn named_frames(&self) -> Result<(Vec<Frame>, String), SourceError> {
        let s = self.settings;
        let variables = &self.header().variables;
        let mut lists = Vec::new();
        for (key, name) in [("u", &s.u), ("v", &s.v), ("w", &s.w)] {
            match name.as_deref() {
                Some("none") if key == "w" => {}
                None if key == "w" => {}
                None => {
                    let accepted = "the names of two or three datasets: `u`, `v` and `w`".into();
                    return Err(SourceError::Setting { key: "u", found: format!("given without `{key}`"), accepted });
                }
                Some(name) => {
                    let found = matching(variables, name);
                    if found.is_empty() {
                        return Err(self.not_found(key, name));
                    }
                    lists.push((key, found));
                }
            }
        }
        let numbers = |list: &[(usize, Option<f64>)]| list.iter().map(|e| e.1).collect::<Vec<_>>();
        let reference = numbers(&lists[0].1);
        if let Some((key, list)) = lists.iter().find(|l| numbers(&l.1) != reference) {
            let what = format!("`{key}` matches {} datasets of other numbers than the {} of `u`", list.len(), reference.len());
            return Err(self.misfit(list[0].0, what));
        }
        let frame = |i: usize| Frame { components: lists.iter().map(|l| (l.1[i].0, None)).collect(), number: reference[i] };
        Ok(((0..reference.len()).map(frame).collect(), "named by the settings".into()))
    }

    /// What each axis of a dataset is, slowest first.
    fn order(&self, variable: usize, interleaved: bool) -> Result<Vec<u8>, SourceError> {
        let rank = self.header().variables[variable].dimensions.len();
        let usual = match (rank, interleaved) {
            (2, false) => "yx",
            (3, false) => "zyx",
            (4, false) => "tzyx",
            (3, true) => "yxc",
            (4, true) => "zyxc",
            (5, true) => "tzyxc",
            _ => "",
        };
        let text = self.settings.order.as_deref().unwrap_or(usual);
        let order: Vec<u8> = text.bytes().map(|b| b.to_ascii_lowercase()).collect();
        let count = |letter: u8| order.iter().filter(|&&o| o == letter).count();
        let known = order.iter().all(|o| b"xyztc-".contains(o)) && b"xyztc".iter().all(|&l| count(l) <= 1);
        let complete = count(b'x') == 1 && count(b'y') == 1 && count(b'c') == usize::from(interleaved);
        if known && complete && order.len() == rank {
            return Ok(order);
        }
        let letters = if interleaved { "x, y, c (component)" } else { "x and y" };
        let what = format!(
            "it has {rank} axes{}; give `order = \"...\"`, one letter an axis, slowest first: {letters}, and z, t (time) or `-` (one entry) for the others",
            if text.is_empty() { String::new() } else { format!(", which `{text}` does not describe") }
        );
        Err(self.misfit(variable, what))
    }

    fn hdf5_axis(&self, velocity: usize, k: usize, nodes: usize) -> Result<AxisPlan, SourceError> {
        let s = self.settings;
        let letter = ["x", "y", "z"][k];
        let header = self.header();
        let fits = |v: &Variable| header.shape(v) == [nodes] && v.number.is_number();
        let named = [&s.x, &s.y, &s.z][k];
        let index = match named {
            Some(name) => match header.find(name) {
                Some(i) if fits(&header.variables[i]) => Some(i),
                Some(i) => {
                    return Err(self.misfit(
                        i,
                        format!(
                            "`{letter}` must name {nodes} numbers in one row, this one has shape {:?}",
                            header.shape(&header.variables[i])
                        ),
                    ));
                }
                None => return Err(self.not_found(letter, name)),
            },
            None => {
                let usual = |v: &Variable| {
                    let stem = v.name.rsplit('/').next().unwrap_or_default().to_ascii_lowercase();
                    COORDINATE_NAMES.iter().any(|name| stem == name.replace('x', letter))
                };
                (0..header.variables.len()).find(|&i| usual(&header.variables[i]) && fits(&header.variables[i]))
            }
        };
        let kind = [Kind::X, Kind::Y, Kind::Level][k];
        let (name, units, values) = match (index, s.spacing) {
            (Some(i), _) => {
                let v = &header.variables[i];
                (v.name.as_str(), v.units().filter(|u| Unit::parse(u).is_some()), self.coordinate_values(i)?)
            }
            (None, Some(spacing)) => {
                if !(spacing[k].is_finite() && spacing[k] > 0.0) {
                    let found = format!("{spacing:?}");
                    return Err(SourceError::Setting { key: "spacing", found, accepted: "three numbers above 0".into() });
                }
                let origin = s.origin.unwrap_or([0.0; 3])[k];
                (letter, None, (0..nodes).map(|i| origin + spacing[k] * i as f64).collect())
            }
            (None, None) if s.velocity_unit == VelocityUnit::Cells => (letter, None, (0..nodes).map(|i| i as f64).collect()),
            (None, None) => {
                let what = format!(
                    "no dataset holds the {nodes} coordinates along {letter}; name it with `{letter}`, or give `spacing = [dx, dy, dz]` in the \
                     velocity's unit of length, or set `velocity_unit = \"cells\"`"
                );
                return Err(self.misfit(velocity, what));
            }
        };
        let coordinates = Coordinates { path: self.path(), name, units, positive_down: false, kind, values };
        let mut plan = coordinates.plan(None, true)?;
        if index.is_none() {
            plan.in_file = None;
        }
        if s.periodic.as_deref().is_some_and(|p| p.to_ascii_lowercase().contains(letter)) {
            let step = (plan.axis.last() - plan.axis.first()) / (nodes - 1) as f64;
            let period = step * nodes as f64;
            plan.notes.push(format!("`{name}` repeats after {period}, as set"));
            plan.axis = plan.axis.with_period(period);
        }
        Ok(plan)
    }

    fn hdf5_component(
        &self,
        variable: usize,
        part: Option<usize>,
        order: &[u8],
        shape: &[usize],
        why: &str,
    ) -> Result<ComponentPlan, SourceError> {
        let v = &self.header().variables[variable];
        let found = self.header().shape(v);
        if found != shape {
            return Err(self.misfit(variable, format!("its shape is {found:?}, that of the first velocity {shape:?}")));
        }
        if !v.number.is_number() {
            return Err(self.misfit(variable, "it holds no numbers".into()));
        }
        let roles = order
            .iter()
            .map(|letter| match letter {
                b'x' => Role::Axis(0),
                b'y' => Role::Axis(1),
                b'z' => Role::Axis(2),
                b't' => Role::Time,
                b'c' => Role::Fixed(part.unwrap_or(0)),
                _ => Role::Fixed(0),
            })
            .collect();
        let unit = v.units().and_then(Unit::parse).filter(Unit::is_velocity);
        let factor = if self.settings.velocity_unit == VelocityUnit::Cells { 1.0 } else { unit.map_or(1.0, |u| u.factor) };
        let why = part.map_or_else(|| why.to_owned(), |part| format!("component {part} of {why}"));
        Ok(ComponentPlan { name: v.name.clone(), shape: found, roles, packing: self.packing(variable)?, factor, why })
    }

    /// Times of all frames: by a dataset or attribute that holds them, or by the numbers in names.
    fn hdf5_times(&mut self, frames: &[Frame], order: &[u8]) -> Result<TimePlan, SourceError> {
        let s = self.settings;
        let header = self.header();
        let fault = |what: String| SourceError::Time { path: self.path().into(), what };
        let step = s.time_step.unwrap_or(1.0);
        if !(step.is_finite() && step > 0.0) {
            return Err(SourceError::Setting { key: "time_step", found: step.to_string(), accepted: "a number above 0".into() });
        }
        let names: Vec<&str> = s.time.as_deref().map_or_else(|| TIME_NAMES.to_vec(), |name| vec![name]);
        let first = &header.variables[frames[0].components[0].0];
        let expected = match order.iter().position(|&o| o == b't') {
            Some(place) => header.shape(first)[place],
            None => frames.len(),
        };
        let own = |frame: &Frame| {
            let variable = &header.variables[frame.components[0].0];
            names.iter().find_map(|n| variable.numbers(n).first().copied().map(|t| (n.to_string(), t)))
        };
        let rows: Option<usize> = names.iter().find_map(|n| {
            let fits = |v: &Variable| {
                v.number.is_number() && header.shape(v).iter().product::<usize>() == expected && v.name.rsplit('/').next() == Some(n)
            };
            header.find(n).filter(|&i| fits(&header.variables[i])).or_else(|| header.variables.iter().position(fits))
        });
        let of_file = names.iter().find_map(|n| match header.attributes.iter().find(|(name, _)| name == n) {
            Some((_, Attribute::Numbers(_, values))) => values.first().map(|&t| (n.to_string(), t)),
            _ => None,
        });
        let owned: Option<Vec<(String, f64)>> = frames.iter().map(own).collect();
        let numbers: Option<Vec<f64>> = frames.iter().map(|f| f.number).collect();
        let (variable, units, seconds, note) = if let Some(index) = rows {
            let variable = &header.variables[index];
            let units = variable.units().and_then(Unit::parse).filter(Unit::is_time);
            let values = self.file.read_all(index)?;
            let factor = units.map_or(1.0, |u| u.factor);
            (
                variable.name.clone(),
                variable.units().unwrap_or_default().to_owned(),
                values.iter().map(|v| v * factor).collect::<Vec<_>>(),
                None,
            )
        } else if order.contains(&b't') {
            return Err(fault(format!("no dataset holds the {expected} times along the time axis; name it with `time`")));
        } else if let Some(owned) = owned {
            (
                owned[0].0.clone(),
                String::new(),
                owned.iter().map(|o| o.1).collect(),
                Some(format!("times are attributes `{}` of the datasets", owned[0].0)),
            )
        } else if let (Some((name, time)), 1) = (of_file, frames.len()) {
            (name.clone(), String::new(), vec![time], Some(format!("the time is the attribute `{name}` of the file")))
        } else if let Some(name) = &s.time {
            return Err(fault(format!("neither a dataset of {expected} numbers nor an attribute is called `{name}`")));
        } else if let Some(numbers) = numbers {
            let note = format!("times are the numbers in dataset names, times {step}; another step with `time_step`");
            (String::new(), String::new(), numbers.iter().map(|n| n * step).collect(), Some(note))
        } else {
            let stem = self.path().file_stem().and_then(|n| n.to_str()).unwrap_or_default();
            let Some(number) = last_number(stem).filter(|_| frames.len() == 1) else {
                return Err(fault(
                    "neither a dataset, an attribute, a dataset's name nor the file's name tells the time; name it with `time = \"...\"`"
                        .into(),
                ));
            };
            let note = format!("the time is the last number in the file's name, times {step}; another step with `time_step`");
            (String::new(), String::new(), vec![number * step], Some(note))
        };
        if let Some(i) = seconds.iter().position(|t| !t.is_finite()) {
            return Err(fault(format!("time {i} is not a number")));
        }
        if let Some(i) = (1..seconds.len()).find(|&i| seconds[i] <= seconds[i - 1]) {
            return Err(fault(format!("time {i} is {}, the one before it {}; times must ascend", seconds[i], seconds[i - 1])));
        }
        let places = (0..seconds.len()).map(|i| if order.contains(&b't') { (0, i) } else { (i, 0) }).collect();
        self.notes.extend(note);
        Ok(TimePlan { variable, units, seconds, places, calendar: None })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::source::container::NumberType;

    #[test]
    fn numbers_are_found_in_names() {
        assert_eq!(last_number("flame_0012"), Some(12.0));
        assert_eq!(last_number("run3/step_2.5e"), Some(2.5));
        assert_eq!(last_number("none"), None);
        let named = |name: &str| Variable { name: name.into(), number: NumberType::F32, dimensions: vec![], attributes: vec![] };
        let variables: Vec<Variable> =
            ["Velocity_0010", "Velocity_0002", "Velocity_", "Pressure_0001", "u"].into_iter().map(named).collect();
        assert_eq!(matching(&variables, "Velocity_*"), [(1, Some(2.0)), (0, Some(10.0))]);
        assert_eq!(matching(&variables, "u"), [(4, None)]);
        assert!(matching(&variables, "u*").is_empty());
    }
}
