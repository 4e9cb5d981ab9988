//! The fields of a file as variables: those of one parameter, type of level and grid are one, on all of their times, members and levels.

use super::super::limits::MAX_OBJECTS;
use super::super::messages::{Attribute, Dimension, FormatFault, Listing, NumberType, UNREADABLE, Variable};
use super::date;
use super::grid::{Axis, Grid, Mapping, Regular};
use super::message::{Kind, Message, Place};
use super::names::Levels;
use std::collections::HashMap;
use std::ops::Range;

/// Most grids of a file whose coordinates are computed, which takes time: Gaussian ones and projections.
const MAX_COMPUTED: usize = 16;

/// What a variable holds.
pub enum Content {
    Axis(Axis),
    Cube(Cube),
    /// Nothing that can be read; its attribute says why.
    Unread,
}

/// A variable on time, member and level (the last two where there are several, or any), latitude and longitude.
pub struct Cube {
    /// Its messages in the order of these dimensions.
    pub places: Range<usize>,
    pub grid: Regular,
    /// Lengths of all dimensions.
    pub shape: Vec<usize>,
}

/// A field of a variable.
struct Entry {
    time: i64,
    member: u32,
    level: f64,
    place: Place,
}

/// The fields of a variable.
struct Fields {
    kind: Kind,
    entries: Vec<Entry>,
    /// Why it cannot be read.
    fault: Option<String>,
}

/// Fills an empty listing. Returns the places of all messages and what each variable holds.
///
/// # Errors
/// Too many variables.
pub fn listed(listing: Listing, messages: Vec<Message>) -> Result<(Listing, Vec<Place>, Vec<Content>), FormatFault> {
    let mut all: Vec<Fields> = Vec::new();
    let mut known: HashMap<Kind, usize> = HashMap::new();
    for Message { kind, time, member, level, place, fault } in messages {
        let index = *known.entry(kind.clone()).or_insert_with(|| {
            all.push(Fields { kind, entries: Vec::new(), fault: None });
            all.len() - 1
        });
        all[index].entries.push(Entry { time, member, level, place });
        all[index].fault = all[index].fault.take().or(fault);
        if all.len() > MAX_OBJECTS {
            return Err(FormatFault::Refused(format!("it holds more than {MAX_OBJECTS} variables; accepted are files of fewer")));
        }
    }
    drop(known);
    resolve(&mut all);
    let mut list = List { listing, contents: Vec::new(), axes: Vec::new(), mappings: Vec::new() };
    let mut places = Vec::new();
    let names = names(&all.iter().map(|fields| &fields.kind).collect::<Vec<_>>());
    for (fields, name) in all.into_iter().zip(names) {
        list.add(fields, name, &mut places);
    }
    Ok((list.listing, places, list.contents))
}

/// Computes the latitudes of Gaussian grids, and the coordinates of projections.
fn resolve(all: &mut [Fields]) {
    let mut resolved: HashMap<Grid, Grid> = HashMap::new();
    for fields in all {
        if fields.kind.grid.is_open() {
            let grid = fields.kind.grid.clone();
            fields.kind.grid = if resolved.len() < MAX_COMPUTED || resolved.contains_key(&grid) {
                resolved.entry(grid.clone()).or_insert_with(|| grid.resolved()).clone()
            } else {
                Grid::Other(format!("the file holds more than {MAX_COMPUTED} Gaussian or projected grids"))
            };
        }
    }
}

/// A name for each variable: that of its parameter, and if several have it, what tells them apart.
fn names(kinds: &[&Kind]) -> Vec<String> {
    let mut names: Vec<String> = kinds.iter().map(|kind| kind.parameter.name()).collect();
    let level = |kind: &Kind| kind.levels.name();
    let process = |kind: &Kind| kind.process.map_or_else(String::new, |process| process.name());
    for more in [&level as &dyn Fn(&Kind) -> String, &process] {
        // The different words of each name.
        let mut words: HashMap<String, Vec<String>> = HashMap::new();
        for (name, kind) in names.iter().zip(kinds) {
            let (words, word) = (words.entry(name.clone()).or_default(), more(kind));
            if !words.contains(&word) {
                words.push(word);
            }
        }
        for (name, kind) in names.iter_mut().zip(kinds) {
            let word = more(kind);
            if words[name].len() > 1 && !word.is_empty() {
                *name = format!("{name}_{word}");
            }
        }
    }
    let mut count: HashMap<String, usize> = HashMap::new();
    for name in &mut names {
        let count = count.entry(name.clone()).or_default();
        *count += 1;
        if *count > 1 {
            *name = format!("{name}_{count}");
        }
    }
    names
}

fn text(name: &str, value: impl Into<String>) -> (String, Attribute) {
    (name.into(), Attribute::Text(value.into()))
}

impl Fields {
    /// Sorts the fields and looks for those that are missing or there twice. Returns times, members and levels.
    fn sort(&mut self) -> (Vec<i64>, Vec<u32>, Vec<f64>) {
        self.entries.sort_by(|a, b| (a.time, a.member).cmp(&(b.time, b.member)).then(a.level.total_cmp(&b.level)));
        let mut times: Vec<i64> = self.entries.iter().map(|entry| entry.time).collect();
        let mut members: Vec<u32> = self.entries.iter().map(|entry| entry.member).collect();
        let mut levels: Vec<f64> = self.entries.iter().map(|entry| entry.level).collect();
        times.dedup();
        members.sort_unstable();
        members.dedup();
        levels.sort_by(f64::total_cmp);
        levels.dedup();
        let of = |entry: &Entry| (entry.time, entry.member, entry.level.to_bits());
        let words = |(time, member, level): (i64, u32, u64)| {
            let levels = self.kind.levels;
            let units = levels.known().map_or("", |known| known.units);
            let level = if levels.valued { format!(" at {} {units}", f64::from_bits(level)) } else { String::new() };
            let member = if members.len() > 1 { format!(" of member {member}") } else { String::new() };
            format!("its message{}{member} of {}", level.trim_end(), date::iso(time))
        };
        if let Some(two) = self.entries.windows(2).find(|two| of(&two[0]) == of(&two[1])) {
            self.fault.get_or_insert(format!(
                "{} is there twice (bytes {} and {}), such as from two forecasts: leave one out, for example with `grib_copy -w`",
                words(of(&two[0])),
                two[0].place.begin,
                two[1].place.begin
            ));
        }
        let product = times.len() as u128 * members.len() as u128 * levels.len() as u128;
        if product != self.entries.len() as u128 && self.fault.is_none() {
            let expected = |k: usize| {
                let (rest, level) = (k / levels.len(), k % levels.len());
                (times[rest / members.len()], members[rest % members.len()], levels[level].to_bits())
            };
            let first = self.entries.iter().enumerate().find(|(k, entry)| of(entry) != expected(*k));
            let first = first.map_or(self.entries.len(), |(k, _)| k);
            self.fault = Some(format!(
                "{} is missing, and it has {} of the {product} that {} times, {} members and {} levels make: get the others, or leave out \
                 incomplete ones, for example with `grib_copy -w`",
                words(expected(first)),
                self.entries.len(),
                times.len(),
                members.len(),
                levels.len()
            ));
        }
        (times, members, levels)
    }
}

/// A listing in the making.
struct List {
    listing: Listing,
    contents: Vec<Content>,
    /// Name, coordinates and dimension of each axis.
    axes: Vec<(String, Axis, usize)>,
    /// Grid mappings that have a variable; the first one is `crs`.
    mappings: Vec<Mapping>,
}

impl List {
    fn add(&mut self, mut fields: Fields, name: String, places: &mut Vec<Place>) {
        let (times, members, levels) = fields.sort();
        let mut dimensions = Vec::new();
        let time = [text("standard_name", "time"), text("units", "seconds since 1970-01-01 00:00:00")];
        dimensions.push(self.axis("time", Axis::of(times.into_iter().map(|time| time as f64)), &time));
        if members.len() > 1 {
            dimensions.push(self.axis("number", Axis::of(members.into_iter().map(f64::from)), &[text("standard_name", "realization")]));
        }
        if fields.kind.levels.valued {
            dimensions.push(self.axis(&fields.kind.levels.name(), Axis::of(levels), &described(fields.kind.levels)));
        }
        let known = fields.kind.parameter.known();
        let mut attributes: Vec<_> = known.map_or(Vec::new(), |known| {
            vec![text("long_name", known.long_name), text("standard_name", known.standard_name), text("units", known.units)]
        });
        let (number, content) = match (fields.kind.grid, fields.fault) {
            (Grid::Regular(grid), fault) => {
                let [y, x] = match &grid.mapping {
                    None => [["latitude", "latitude", "degrees_north"], ["longitude", "longitude", "degrees_east"]],
                    Some(mapping) if mapping.is_plane() => [["y", "projection_y_coordinate", "m"], ["x", "projection_x_coordinate", "m"]],
                    Some(_) => [["rlat", "grid_latitude", "degrees"], ["rlon", "grid_longitude", "degrees"]],
                };
                for ([name, standard, units], axis) in [(y, &grid.y), (x, &grid.x)] {
                    dimensions.push(self.axis(name, axis.clone(), &[text("standard_name", standard), text("units", units)]));
                }
                if let Some(mapping) = &grid.mapping {
                    attributes.push(text("grid_mapping", self.mapping(mapping)));
                    if mapping.along_grid {
                        for (_, value) in attributes.iter_mut().filter(|(name, _)| name == "standard_name") {
                            along_grid(value);
                        }
                    }
                }
                match fault {
                    None => {
                        let from = places.len();
                        places.extend(fields.entries.iter().map(|entry| entry.place));
                        let shape = dimensions.iter().map(|&dimension| self.listing.dimensions[dimension].len).collect();
                        (NumberType::Float32, Content::Cube(Cube { places: from..places.len(), grid, shape }))
                    }
                    Some(what) => {
                        attributes.push(text(UNREADABLE, what));
                        (NumberType::Other, Content::Unread)
                    }
                }
            }
            (Grid::Other(what), _) => {
                attributes.push(text(UNREADABLE, what));
                (NumberType::Other, Content::Unread)
            }
        };
        self.listing.variables.push(Variable { name, number, dimensions, attributes });
        self.contents.push(content);
    }

    /// Name of the variable of a grid mapping, which is added if it is new.
    fn mapping(&mut self, mapping: &Mapping) -> String {
        let name = |index: usize| if index == 0 { "crs".to_owned() } else { format!("crs{index}") };
        if let Some(known) = self.mappings.iter().position(|known| known == mapping) {
            return name(known);
        }
        let name = name(self.mappings.len());
        let mut attributes = vec![text("grid_mapping_name", mapping.kind)];
        attributes
            .extend(mapping.numbers().into_iter().map(|(name, values)| (name.into(), Attribute::Numbers(NumberType::Float64, values))));
        self.listing.variables.push(Variable { name: name.clone(), number: NumberType::Int32, dimensions: Vec::new(), attributes });
        self.contents.push(Content::Unread);
        self.mappings.push(mapping.clone());
        name
    }

    /// The dimension of an axis, which is added with its coordinates if it is new. Another one of the same name gets a number.
    fn axis(&mut self, base: &str, axis: Axis, attributes: &[(String, Attribute)]) -> usize {
        if let Some((.., dimension)) = self.axes.iter().find(|(name, known, _)| name == base && *known == axis) {
            return *dimension;
        }
        let before = self.axes.iter().filter(|(name, ..)| name == base).count();
        let name = if before == 0 { base.to_owned() } else { format!("{base}{before}") };
        let dimension = self.listing.dimensions.len();
        self.listing.dimensions.push(Dimension { name: name.clone(), len: axis.len() });
        let attributes = attributes.to_vec();
        self.listing.variables.push(Variable { name, number: NumberType::Float64, dimensions: vec![dimension], attributes });
        self.contents.push(Content::Axis(axis.clone()));
        self.axes.push((base.to_owned(), axis, dimension));
        dimension
    }
}

/// The standard name of a velocity along the axes of its grid.
fn along_grid(name: &mut Attribute) {
    let Attribute::Text(text) = name else { return };
    for (eastward, along) in [
        ("eastward_wind", "x_wind"),
        ("northward_wind", "y_wind"),
        ("eastward_sea_water_velocity", "sea_water_x_velocity"),
        ("northward_sea_water_velocity", "sea_water_y_velocity"),
        ("eastward_sea_ice_velocity", "sea_ice_x_velocity"),
        ("northward_sea_ice_velocity", "sea_ice_y_velocity"),
    ] {
        if text == eastward {
            along.clone_into(text);
            return;
        }
    }
}

/// Attributes of a level axis.
fn described(levels: Levels) -> Vec<(String, Attribute)> {
    let Some(known) = levels.known() else { return Vec::new() };
    let all = [("standard_name", known.standard_name), ("units", known.units), ("positive", known.positive)];
    all.into_iter().filter(|(_, value)| !value.is_empty()).map(|(name, value)| text(name, value)).collect()
}
