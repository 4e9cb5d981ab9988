//! Plan of files that do not name their dimensions (plain HDF5): datasets of the velocity, meaning of their axes, times.
//!
//! Understood without settings: cutouts of the Johns Hopkins turbulence databases in both layouts (`Velocity_0001` (z, y, x,
//! component) with `xcoor`, `ycoor`, `zcoor`; `u01000` of the same shape), and separate components with their own coordinates (`u`,
//! `v`, `w` or other usual names, and `x`, `y`, `z`). The settings name everything else.

use super::axes::{AxisPlan, Coordinates};
use super::component::{ComponentPlan, Role};
use super::layout::Layout;
use super::planner::Planner;
use super::times::TimePlan;
use crate::archive_settings::{Metric, VelocityUnit};
use crate::cf::coordinate::Kind;
use crate::cf::units::Unit;
use crate::cf::velocity;
use crate::error::SourceError;
use crate::formats::{Attribute, Variable};

/// Names of a scalar, attribute or dataset that holds the time.
const TIME_NAMES: [&str; 5] = ["time", "Time", "t", "simulation_time", "physical_time"];
/// Largest number of nodes along an axis: single precision resolves no more, and a damaged shape must be refused before memory is
/// allocated for it.
const MAX_NODES: usize = 1 << 24;
/// Names of coordinates, compared without their group and without regard to case; `x` stands for the axis.
const COORDINATE_NAMES: [&str; 7] = ["x", "xcoor", "xc", "x_coordinate", "coords_x", "grid_x", "x_coor"];
/// Letters of the axes.
const LETTERS: [&str; 3] = ["x", "y", "z"];

/// Datasets with the numbers in their names.
type Numbered = Vec<(usize, Option<f64>)>;

/// One time: datasets of u, v and w, or one that holds all.
struct Frame {
    /// Index of the variable of each component, and its entry along the component axis if the dataset holds all components.
    components: Vec<(usize, Option<usize>)>,
    /// The number in the dataset's name.
    number: Option<f64>,
}

/// Shape shared by all datasets of the velocity.
struct Shape {
    /// Letter of each axis, slowest first: x, y, z, t (time), c (component), - (one entry).
    order: Vec<u8>,
    lengths: Vec<usize>,
}

impl Shape {
    fn place(&self, letter: &str) -> Option<usize> {
        self.order.iter().position(|&o| o == letter.as_bytes()[0])
    }

    fn length(&self, letter: &str) -> Option<usize> {
        self.place(letter).map(|place| self.lengths[place])
    }
}

/// Datasets of a name in which `*` stands for digits, sorted by their number.
fn matching(variables: &[Variable], pattern: &str) -> Numbered {
    let mut found: Numbered = match pattern.split_once('*') {
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

/// Frames of datasets that hold all components.
fn interleaved(found: Numbered, parts: usize) -> Vec<Frame> {
    let frame = |(i, number)| Frame { components: (0..parts).map(|c| (i, Some(c))).collect(), number };
    found.into_iter().map(frame).collect()
}

/// The last number in a text.
fn last_number(text: &str) -> Option<f64> {
    let end = text.rfind(|c: char| c.is_ascii_digit())? + 1;
    let start = text[..end].rfind(|c: char| !(c.is_ascii_digit() || c == '.')).map_or(0, |i| i + 1);
    text[start..end].trim_start_matches('.').parse().ok()
}

impl Planner<'_> {
    /// Plans a file of datasets.
    pub fn plan_datasets(mut self) -> Result<Layout, SourceError> {
        let s = self.settings;
        let (frames, why) = self.frames()?;
        let (first, part) = frames[0].components[0];
        let shape = Shape { order: self.order(first, part.is_some())?, lengths: self.shape(first) };
        if s.level.is_some() || s.region.is_some() {
            let key = if s.level.is_some() { "level" } else { "region" };
            return Err(SourceError::setting(key, "given", "left out: HDF5 archives are read whole"));
        }
        let metric = match (s.metric, s.velocity_unit) {
            (Some(Metric::Sphere), _) => {
                return Err(SourceError::setting("metric", "sphere", "HDF5 archives are read as cartesian, or as index"));
            }
            (None | Some(Metric::Index), VelocityUnit::Cells) => Metric::Index,
            (Some(Metric::Cartesian), VelocityUnit::Cells) => {
                return Err(SourceError::setting("metric", "cartesian", "velocities in cells need --set archive.metric=index"));
            }
            (metric, VelocityUnit::Si) => metric.unwrap_or(Metric::Cartesian),
        };
        // Faults of the data come before faults that settings could mend.
        for letter in LETTERS {
            let Some(nodes) = shape.length(letter) else { continue };
            if nodes < 2 {
                let what = format!(
                    "it is {nodes} node(s) thick along {letter}: no flow map can be traced in a single slab; accepted are 2 nodes or more along every axis"
                );
                return Err(self.misfit(first, what));
            }
            if nodes > MAX_NODES {
                let what = format!("it claims {nodes} nodes along {letter}; accepted are {MAX_NODES} at most along an axis");
                return Err(self.misfit(first, what));
            }
        }
        // A damaged shape is refused before coordinates are made for it.
        let nodes: Vec<usize> = LETTERS.into_iter().filter_map(|letter| shape.length(letter)).collect();
        self.listing().check_count(self.variable(first), &nodes)?;
        let mut axes = Vec::new();
        for (k, letter) in LETTERS.into_iter().enumerate() {
            if let Some(nodes) = shape.length(letter) {
                axes.push(self.dataset_axis(first, k, nodes)?);
            }
        }
        let mut components = Vec::new();
        for frame in &frames {
            let plans = frame.components.iter().take(axes.len());
            let plans = plans.map(|&(variable, part)| self.dataset_component(variable, part, &shape, &why));
            components.push(plans.collect::<Result<Vec<_>, _>>()?);
        }
        let time = self.dataset_times(&frames, shape.length("t"))?;
        if components[0].len() < axes.len() {
            self.note("no third component: motion along z is taken as 0");
        }
        if let Some(text) = self.variable(first).units().filter(|t| Unit::parse(t).is_none_or(|u| !u.is_velocity())) {
            self.note(format!("unit `{text}` of the velocity is not converted"));
        }
        let (vertical, poles) = self.finish_axes(&mut axes, metric)?;
        Ok(Layout { frames: components, axes, vertical, poles, time, metric, resampling: None, notes: self.notes })
    }

    /// The datasets of each time, and why they were chosen.
    fn frames(&self) -> Result<(Vec<Frame>, String), SourceError> {
        let s = self.settings;
        let listing = self.listing();
        if let Some(pattern) = &s.velocity {
            let found = matching(&listing.variables, pattern);
            let Some(&(first, _)) = found.first() else { return Err(self.not_found("velocity", pattern)) };
            let order = self.order(first, true)?;
            let parts = self.shape(first)[order.iter().position(|&o| o == b'c').unwrap_or(0)];
            if !(2..=3).contains(&parts) {
                return Err(self.misfit(first, format!("its component axis holds {parts} entries; accepted are 2 and 3")));
            }
            return Ok((interleaved(found, parts), format!("named by the setting `velocity = \"{pattern}\"`")));
        }
        if s.u.is_some() || s.v.is_some() {
            return self.named_frames();
        }
        // Cutouts of the Johns Hopkins databases: four axes, the last one of three components.
        for pattern in ["Velocity_*", "velocity_*", "u*"] {
            let mut found = matching(&listing.variables, pattern);
            found.retain(|&(i, _)| matches!(self.shape(i)[..], [_, _, _, 3]) && self.variable(i).number.is_number());
            if !found.is_empty() {
                let why = format!("`{pattern}` with three components: a cutout of the Johns Hopkins turbulence databases");
                return Ok((interleaved(found, 3), why));
            }
        }
        match velocity::choose(listing, [None; 3], s.leaves_out_w(), [None; 3]) {
            Ok(found) => {
                let mut components = vec![(found.u.variable, None), (found.v.variable, None)];
                components.extend(found.w.map(|w| (w.variable, None)));
                Ok((vec![Frame { components, number: None }], found.u.why))
            }
            Err(lacking) => {
                let single = |v: &&Variable| matches!(listing.shape(v)[..], [_, _, _, 1]) && v.number.is_number();
                Err(self.no_velocity(&match listing.variables.iter().find(single) {
                    Some(v) => {
                        format!("{lacking}; `{}` has one component per point: it is a scalar, and a flow map needs a velocity", v.name)
                    }
                    None => lacking,
                }))
            }
        }
    }

    /// Separate datasets that the settings name, each with or without a `*`.
    fn named_frames(&self) -> Result<(Vec<Frame>, String), SourceError> {
        let s = self.settings;
        let mut lists: Vec<(&str, Numbered)> = Vec::new();
        for (key, name) in [("u", &s.u), ("v", &s.v), ("w", &s.w)] {
            match name.as_deref() {
                None if key == "w" => {}
                Some(_) if key == "w" && s.leaves_out_w() => {}
                None => {
                    let accepted = "the names of two or three datasets: `u`, `v` and `w`";
                    return Err(SourceError::setting("u", format!("given without `{key}`"), accepted));
                }
                Some(name) => {
                    let found = matching(&self.listing().variables, name);
                    if found.is_empty() {
                        return Err(self.not_found(key, name));
                    }
                    lists.push((key, found));
                }
            }
        }
        let numbers = |list: &Numbered| list.iter().map(|e| e.1).collect::<Vec<_>>();
        let reference = numbers(&lists[0].1);
        if let Some((key, list)) = lists.iter().find(|l| numbers(&l.1) != reference) {
            let what = format!("`{key}` matches {} datasets of other numbers than the {} of `u`", list.len(), reference.len());
            return Err(self.misfit(list[0].0, what));
        }
        let frame = |i: usize| Frame { components: lists.iter().map(|l| (l.1[i].0, None)).collect(), number: reference[i] };
        Ok(((0..reference.len()).map(frame).collect(), "named by the settings".into()))
    }

    /// Letter of each axis of a dataset, slowest first.
    fn order(&self, variable: usize, interleaved: bool) -> Result<Vec<u8>, SourceError> {
        let rank = self.variable(variable).dimensions.len();
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
            "it has {rank} axes{}; give --set archive.order=LETTERS, one letter for each axis, slowest first: {letters}, and z, t (time) or `-` (one entry) for the others",
            if text.is_empty() { String::new() } else { format!(", which `{text}` does not describe") }
        );
        Err(self.misfit(variable, what))
    }

    fn dataset_axis(&self, velocity: usize, k: usize, nodes: usize) -> Result<AxisPlan, SourceError> {
        let s = self.settings;
        let letter = LETTERS[k];
        let fits = |v: &Variable| self.listing().shape(v) == [nodes] && v.number.is_number();
        let index = match [&s.x, &s.y, &s.z][k] {
            Some(name) => match self.listing().find(name) {
                Some(i) if fits(self.variable(i)) => Some(i),
                Some(i) => {
                    let shape = self.shape(i);
                    let what = format!("`{letter}` must name {nodes} numbers in one row, this one has shape {shape:?}");
                    return Err(self.misfit(i, what));
                }
                None => return Err(self.not_found(letter, name)),
            },
            None => {
                let usual = |v: &Variable| {
                    let stem = v.name.rsplit('/').next().unwrap_or_default().to_ascii_lowercase();
                    COORDINATE_NAMES.iter().any(|name| stem == name.replace('x', letter))
                };
                self.listing().matching(|v| usual(v) && fits(v)).next()
            }
        };
        let kind = [Kind::X, Kind::Y, Kind::Level][k];
        let (name, units, values) = match (index, s.spacing) {
            (Some(i), _) => {
                let v = self.variable(i);
                (v.name.as_str(), v.units().filter(|u| Unit::parse(u).is_some()), self.coordinate_values(i)?)
            }
            (None, Some(spacing)) => {
                if !(spacing[k].is_finite() && spacing[k] > 0.0) {
                    return Err(SourceError::setting("spacing", format!("{spacing:?}"), "three numbers above 0"));
                }
                let origin = s.origin.unwrap_or([0.0; 3])[k];
                (letter, None, (0..nodes).map(|i| origin + spacing[k] * i as f64).collect())
            }
            (None, None) if s.velocity_unit == VelocityUnit::Cells => (letter, None, (0..nodes).map(|i| i as f64).collect()),
            (None, None) => {
                let what = format!(
                    "no dataset holds the {nodes} coordinates along {letter}; name it with --set archive.{letter}=NAME, or give --set \
                     archive.spacing=[DX,DY,DZ] in the velocity's unit of length, or --set archive.velocity_unit=cells"
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

    fn dataset_component(&self, variable: usize, part: Option<usize>, shape: &Shape, why: &str) -> Result<ComponentPlan, SourceError> {
        let v = self.variable(variable);
        let found = self.shape(variable);
        if found != shape.lengths {
            let expected = &shape.lengths;
            return Err(self.misfit(variable, format!("its shape is {found:?}, that of the first velocity {expected:?}")));
        }
        if !v.number.is_number() {
            return Err(self.misfit(variable, "it holds no numbers"));
        }
        let role = |letter: &u8| match letter {
            b'x' => Role::Axis(0),
            b'y' => Role::Axis(1),
            b'z' => Role::Axis(2),
            b't' => Role::Time,
            b'c' => Role::Fixed(part.unwrap_or(0)),
            _ => Role::Fixed(0),
        };
        let unit = v.units().and_then(Unit::parse).filter(Unit::is_velocity);
        let factor = if self.settings.velocity_unit == VelocityUnit::Cells { 1.0 } else { unit.map_or(1.0, |u| u.factor) };
        let why = part.map_or_else(|| why.to_owned(), |part| format!("component {part} of {why}"));
        let roles = shape.order.iter().map(role).collect();
        Ok(ComponentPlan {
            name: v.name.clone(),
            shape: found,
            dimensions: self.dimensions_of(variable),
            roles,
            packing: self.velocity_packing(variable)?,
            factor,
            why,
            of_water: false,
            of_air: false,
            mask: None,
            columns: None,
            own: Default::default(),
        })
    }

    /// Times of all frames: by a dataset or attribute that holds them, or by the numbers in names. `along_axis` is the length of the
    /// datasets' time axis, if they have one.
    fn dataset_times(&mut self, frames: &[Frame], along_axis: Option<usize>) -> Result<TimePlan, SourceError> {
        let s = self.settings;
        let listing = self.listing();
        let step = s.time_step.unwrap_or(1.0);
        if !(step.is_finite() && step > 0.0) {
            return Err(SourceError::setting("time_step", step, "a number above 0"));
        }
        let names: Vec<&str> = s.time.as_deref().map_or_else(|| TIME_NAMES.to_vec(), |name| vec![name]);
        let expected = along_axis.unwrap_or(frames.len());
        let own = |frame: &Frame| {
            let variable = self.variable(frame.components[0].0);
            names.iter().find_map(|n| variable.numbers(n).first().map(|&t| (n.to_string(), t)))
        };
        let rows: Option<usize> = names.iter().find_map(|n| {
            let fits = |v: &Variable| {
                v.number.is_number() && listing.shape(v).iter().product::<usize>() == expected && v.name.rsplit('/').next() == Some(n)
            };
            listing.find(n).filter(|&i| fits(self.variable(i))).or_else(|| listing.matching(fits).next())
        });
        let of_file = names.iter().find_map(|n| match listing.attribute(n) {
            Some(Attribute::Numbers(_, values)) => values.first().map(|&t| (n.to_string(), t)),
            _ => None,
        });
        let owned: Option<Vec<(String, f64)>> = frames.iter().map(own).collect();
        let numbers: Option<Vec<f64>> = frames.iter().map(|f| f.number).collect();
        let (mut name, mut units) = (String::new(), String::new());
        let seconds: Vec<f64> = if let Some(index) = rows {
            let variable = self.variable(index);
            let factor = variable.units().and_then(Unit::parse).filter(Unit::is_time).map_or(1.0, |u| u.factor);
            (name, units) = (variable.name.clone(), variable.units().unwrap_or_default().to_owned());
            self.file.read_all(index)?.iter().map(|v| v * factor).collect()
        } else if along_axis.is_some() {
            return Err(
                self.time_fault(format!("no dataset holds the {expected} times along the time axis; name it with --set archive.time=NAME"))
            );
        } else if let Some(owned) = owned {
            name = owned[0].0.clone();
            self.note(format!("times are attributes `{name}` of the datasets"));
            owned.iter().map(|o| o.1).collect()
        } else if let (Some((attribute, time)), 1) = (of_file, frames.len()) {
            name = attribute;
            self.note(format!("the time is the attribute `{name}` of the file"));
            vec![time]
        } else if let Some(name) = &s.time {
            return Err(self.time_fault(format!("neither a dataset of {expected} numbers nor an attribute is called `{name}`")));
        } else if let Some(numbers) = numbers {
            self.note(format!("times are the numbers in dataset names, times {step}; another step with archive.time_step"));
            numbers.iter().map(|n| n * step).collect()
        } else {
            let stem = self.path().file_stem().and_then(|n| n.to_str()).unwrap_or_default();
            let Some(number) = last_number(stem).filter(|_| frames.len() == 1) else {
                let what = "neither a dataset, an attribute, a dataset's name nor the file's name tells the time";
                return Err(self.time_fault(format!("{what}; name it with --set archive.time=NAME")));
            };
            self.note(format!("the time is the last number in the file's name, times {step}; another step with archive.time_step"));
            vec![number * step]
        };
        if let Some(i) = seconds.iter().position(|t| !t.is_finite()) {
            return Err(self.time_fault(format!("time {i} is not a number")));
        }
        if let Some(i) = (1..seconds.len()).find(|&i| seconds[i] <= seconds[i - 1]) {
            let (before, here) = (seconds[i - 1], seconds[i]);
            return Err(self.time_fault(format!("time {i} is {here}, the one before it {before}; times must ascend")));
        }
        let places = (0..seconds.len()).map(|i| if along_axis.is_some() { (0, i) } else { (i, 0) }).collect();
        Ok(TimePlan { variable: name, units, seconds, places, calendar: None })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::formats::NumberType;

    #[test]
    fn numbers_are_found_in_names() {
        assert_eq!(last_number("flame_0012"), Some(12.0));
        assert_eq!(last_number("run3/step_2.5e"), Some(2.5));
        assert_eq!(last_number("none"), None);
        let named = |name: &str| Variable { name: name.into(), number: NumberType::Float32, dimensions: vec![], attributes: vec![] };
        let variables: Vec<Variable> =
            ["Velocity_0010", "Velocity_0002", "Velocity_", "Pressure_0001", "u"].into_iter().map(named).collect();
        assert_eq!(matching(&variables, "Velocity_*"), [(1, Some(2.0)), (0, Some(10.0))]);
        assert_eq!(matching(&variables, "u"), [(4, None)]);
        assert!(matching(&variables, "u*").is_empty());
    }
}
