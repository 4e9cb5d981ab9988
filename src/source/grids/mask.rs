//! Land in files whose velocity is 0 there: masks by convention or by name, at the points of each component.
//!
//! A mask of models (ROMS, NEMO, MITgcm, MOM) or one that the settings name always counts. One by CF (`land_binary_mask`, `flag_meanings`)
//! counts for velocities of water only: the wind blows over land too.

use super::component::{ComponentPlan, Role};
use super::land::Mask;
use crate::archive_settings::ArchiveSettings;
use crate::cf::coordinate::{Kind, classify_name};
use crate::cf::packing::Packing;
use crate::error::SourceError;
use crate::formats::{DataFile, Listing, Variable};
use std::sync::Arc;

/// Value of `archive.mask` that uses no mask.
pub const NO_MASK: &str = "none";
/// Value of `archive.mask` that takes nodes as land whose velocity is always 0.
pub const ZERO: &str = "zero";

/// Names of masks of models at the points of u, v and tracers: 0 is land.
const MODELS: [[&str; 3]; 5] = [
    ["mask_u", "mask_v", "mask_rho"],
    ["umask", "vmask", "tmask"],
    ["umaskutil", "vmaskutil", "tmaskutil"],
    ["hfacw", "hfacs", "hfacc"],
    ["wet_u", "wet_v", "wet"],
];
/// Words in the meaning of a flag.
const WATER_WORDS: [&str; 5] = ["sea", "ocean", "water", "wet", "lake"];
const LAND_WORDS: [&str; 3] = ["land", "dry", "ground"];

/// Which values are water.
#[derive(Debug, Clone, PartialEq)]
enum Water {
    /// All but 0.
    NotZero,
    /// 0 alone.
    Zero,
    /// From one half on (fractions of sea).
    Much,
    /// Below one half (fractions of land).
    Little,
    /// These flags.
    Flags(Vec<f64>),
    /// The number of levels, from the surface, that are water (POP); at a velocity's corner the least of the four around it if `is_around`.
    Levels { is_around: bool },
}

impl Water {
    /// A missing value is land.
    fn holds(&self, value: f64) -> bool {
        value.is_finite()
            && match self {
                Self::NotZero => value != 0.0,
                Self::Zero => value == 0.0,
                Self::Much => value >= 0.5,
                Self::Little => value < 0.5,
                Self::Flags(values) => values.contains(&value),
                Self::Levels { .. } => value > 0.0,
            }
    }

    /// What the attributes of a mask say.
    fn declared(variable: &Variable) -> Option<Self> {
        match variable.text("standard_name").unwrap_or_default() {
            "sea_binary_mask" | "sea_area_fraction" => return Some(Self::Much),
            "land_binary_mask" | "land_area_fraction" => return Some(Self::Little),
            _ => {}
        }
        let meanings = variable.text("flag_meanings")?.to_ascii_lowercase();
        let says = |meaning: &str, words: &[&str]| words.iter().any(|word| meaning.contains(word));
        let water = |meaning: &str| says(meaning, &WATER_WORDS) && !says(meaning, &LAND_WORDS);
        let flags: Vec<(&str, f64)> = meanings.split_whitespace().zip(variable.numbers("flag_values").iter().copied()).collect();
        let some = flags.iter().any(|f| water(f.0)) && flags.iter().any(|f| says(f.0, &LAND_WORDS));
        some.then(|| Self::Flags(flags.into_iter().filter(|f| water(f.0)).map(|f| f.1).collect()))
    }

    /// Of a mask that the settings name.
    fn of_named(variable: &Variable, opposite: bool, which: usize) -> Self {
        let name = variable.name.to_ascii_lowercase();
        match (Self::declared(variable), opposite) {
            (_, true) => Self::Zero,
            (None, false) if name == "kmu" => Self::Levels { is_around: false },
            (None, false) if name == "kmt" => Self::Levels { is_around: which < 2 },
            (Some(water), false) => water,
            (None, false) if name.starts_with("land") || name == "lsm" => Self::Little,
            (None, false) => Self::NotZero,
        }
    }

    fn described(&self) -> String {
        match self {
            Self::NotZero => "0 is land".into(),
            Self::Zero => "0 is water".into(),
            Self::Much => "from 0.5 on it is water".into(),
            Self::Little => "from 0.5 on it is land".into(),
            Self::Flags(values) => format!("{values:?} is water"),
            Self::Levels { .. } => "the number of levels that are water".into(),
        }
    }
}

/// Where the entries along one dimension of a mask belong.
#[derive(Debug, Clone, Copy)]
enum Along {
    Axis(usize),
    Entry(usize),
}

/// Matches the dimensions of a mask with those of a component: by name, then from the right by length. Along x and y, a mask may have one
/// point more than faces between its points. `None` if it does not fit.
fn fit(listing: &Listing, mask: &Variable, plan: &ComponentPlan) -> Option<Vec<Along>> {
    let mut found: Vec<Along> = Vec::new();
    let mut taken = [false; 3];
    for &d in mask.dimensions.iter().rev() {
        let dimension = &listing.dimensions[d];
        let along = if dimension.len == 1 || classify_name(&dimension.name) == Kind::Time {
            Along::Entry(0)
        } else if let Some(own) = (0..plan.shape.len()).find(|&i| plan.dimensions[i] == dimension.name && plan.shape[i] == dimension.len) {
            match plan.roles[own] {
                Role::Axis(k) => Along::Axis(k),
                Role::Fixed(entry) => Along::Entry(entry),
                Role::Time => Along::Entry(0),
            }
        } else {
            let k = taken.iter().position(|taken| !taken)?;
            let own = plan.along(k);
            let level = (0..plan.shape.len()).find_map(|i| match plan.roles[i] {
                Role::Fixed(entry) if k == 2 && plan.shape[i] == dimension.len => Some(entry),
                _ => None,
            });
            match level {
                Some(entry) if own == 1 => Along::Entry(entry),
                _ if dimension.len == own || (k < 2 && dimension.len == own + 1) => Along::Axis(k),
                _ => return None,
            }
        };
        if let Along::Axis(k) = along
            && std::mem::replace(&mut taken[k], true)
        {
            return None;
        }
        found.push(along);
    }
    found.reverse();
    (taken[0] && (taken[1] || plan.along(1) == 1)).then_some(found)
}

/// A mask that may be used: the lower the rank, the better it fits.
struct Candidate {
    variable: usize,
    rank: usize,
    water: Water,
    along: Vec<Along>,
}

/// The best mask of a file for component `which` (0, 1, 2 for u, v, w).
fn candidate(listing: &Listing, plan: &ComponentPlan, which: usize, settings: &ArchiveSettings) -> Option<Candidate> {
    let of = |i: usize| {
        let variable = &listing.variables[i];
        let name = variable.name.to_ascii_lowercase();
        let (rank, water) = match settings.mask.as_deref() {
            Some(named) => {
                let opposite = named.strip_prefix('!');
                (variable.name == opposite.unwrap_or(named)).then(|| (0, Water::of_named(variable, opposite.is_some(), which)))?
            }
            None => match MODELS.iter().find_map(|names| names.iter().position(|n| *n == name)) {
                None if name == "kmu" && which < 2 => (0, Water::Levels { is_around: false }),
                None if name == "kmt" => (1, Water::Levels { is_around: which < 2 }),
                Some(points) if points == which => (0, Water::NotZero),
                Some(2) => (1, Water::NotZero),
                Some(_) => return None,
                None => (2, Water::declared(variable).filter(|_| plan.of_water)?),
            },
        };
        let along = fit(listing, variable, plan).filter(|_| variable.number.is_number())?;
        Some(Candidate { variable: i, rank, water, along })
    };
    (0..listing.variables.len()).filter_map(of).min_by_key(|c| c.rank)
}

/// True if a file holds a mask by convention, or the one that the settings name.
pub fn holds_mask(listing: &Listing, settings: &ArchiveSettings) -> bool {
    listing.variables.iter().any(|v| match settings.mask.as_deref() {
        Some(named) if ![NO_MASK, ZERO].contains(&named) => v.name == named.strip_prefix('!').unwrap_or(named),
        _ => {
            let name = v.name.to_ascii_lowercase();
            MODELS.iter().flatten().any(|n| *n == name) || ["kmu", "kmt"].contains(&name.as_str()) || Water::declared(v).is_some()
        }
    })
}

/// Masks of the components of a file.
#[derive(Default)]
pub struct Masks {
    /// With their ranks.
    pub found: [Option<(usize, Arc<Mask>)>; 3],
    pub notes: Vec<String>,
}

impl Masks {
    /// Adds those of a file which fit better than those found before.
    ///
    /// # Errors
    /// Values that cannot be read; a mask that the settings name and that does not fit.
    pub fn add(&mut self, file: &DataFile, frame: &[ComponentPlan], settings: &ArchiveSettings) -> Result<(), SourceError> {
        let listing = &file.listing;
        let (mut lacking, mut used) = (Vec::new(), Vec::<(usize, String)>::new());
        for (which, plan) in frame.iter().enumerate().take(3) {
            let Some(best) = candidate(listing, plan, which, settings) else {
                let of_models = |v: &Variable| {
                    let name = v.name.to_ascii_lowercase();
                    MODELS.iter().any(|names| names[which] == name || names[2] == name)
                };
                if let (None, Some(odd)) = (&settings.mask, listing.matching(of_models).next()) {
                    let odd = &listing.variables[odd];
                    self.notes.push(format!(
                        "WARNING: the mask `{}` ({:?}) does not fit the points of `{}` ({:?}), and is not used",
                        odd.name,
                        listing.shape(odd),
                        plan.name,
                        plan.shape
                    ));
                }
                lacking.push(plan);
                continue;
            };
            if self.found[which].as_ref().is_some_and(|(rank, _)| *rank <= best.rank) {
                continue;
            }
            let Some(mask) = read(file, &best, plan)? else {
                self.notes.push(format!(
                    "WARNING: `{}` counts the levels that are water, but `{}` holds only some of these levels: it is not used",
                    listing.variables[best.variable].name, plan.name
                ));
                continue;
            };
            let share = 100.0 * mask.share();
            used.push((best.variable, format!("{share:.1} % of `{}` by `{}` ({})", plan.name, mask.name, best.water.described())));
            self.found[which] = Some((best.rank, Arc::new(mask)));
        }
        if !used.is_empty() {
            let parts: Vec<String> = used.into_iter().map(|u| u.1).collect();
            self.notes.push(format!("land, taken as missing: {}; `archive.mask` names another mask", parts.join(", ")));
        }
        match (settings.mask.as_deref(), lacking.first()) {
            (Some(named), Some(plan)) if holds_mask(listing, settings) => {
                let name = named.strip_prefix('!').unwrap_or(named);
                let index = listing.find(name);
                let shape = index.map(|i| listing.shape(&listing.variables[i])).unwrap_or_default();
                let found = format!("\"{named}\", whose shape is {shape:?}");
                let accepted =
                    format!("a mask of numbers on the points of `{}` ({:?}), or with one more along x and y", plan.name, plan.shape);
                Err(SourceError::setting("mask", found, accepted))
            }
            _ => Ok(()),
        }
    }

    /// Gives them to components.
    pub fn apply(&self, frame: &mut [ComponentPlan]) {
        for (plan, mask) in frame.iter_mut().zip(&self.found) {
            plan.mask = mask.as_ref().map(|(_, mask)| mask.clone());
        }
    }
}

/// `None` if it counts levels, but which ones the file holds is not known.
fn read(file: &DataFile, candidate: &Candidate, plan: &ComponentPlan) -> Result<Option<Mask>, SourceError> {
    let variable = &file.listing.variables[candidate.variable];
    let packing = Packing::of(variable).map_err(|what| SourceError::variable(&file.listing.path, &variable.name, what))?;
    let lengths = file.listing.shape(variable);
    let part = |(along, &len): (&Along, &usize)| match *along {
        Along::Axis(_) => (0, len),
        Along::Entry(entry) => (entry.min(len.saturating_sub(1)), 1),
    };
    let (start, count): (Vec<usize>, Vec<usize>) = candidate.along.iter().zip(&lengths).map(part).unzip();
    let values: Vec<f64> = file.read(candidate.variable, start, count.clone())?.into_iter().map(|v| packing.unpack(v)).collect();
    // Extent and distance between neighbours along each axis of the grid.
    let (mut extent, mut strides, mut stride) = ([1usize; 3], [0usize; 3], 1);
    for (along, &n) in candidate.along.iter().zip(&count).rev() {
        if let Along::Axis(k) = *along {
            (extent[k], strides[k]) = (n, stride);
        }
        stride *= n;
    }
    if let Water::Levels { is_around } = candidate.water {
        let at = |x: usize, y: usize| {
            let value = values[y.min(extent[1] - 1) * strides[1] + x.min(extent[0] - 1) * strides[0]];
            if value.is_finite() { value } else { 0.0 }
        };
        return Ok(below_bottom(&values, plan).map(|level| {
            let least = |x: usize, y: usize| match is_around || extent[0] > plan.along(0) || extent[1] > plan.along(1) {
                true => at(x, y).min(at(x + 1, y)).min(at(x, y + 1)).min(at(x + 1, y + 1)),
                false => at(x, y),
            };
            let shape = [0, 1, 2].map(|k| plan.along(k));
            let land =
                (0..shape.iter().product()).map(|n| least(n % shape[0], n / shape[0] % shape[1]) <= level(n / (shape[0] * shape[1])));
            Mask::new(&variable.name, shape, land.collect())
        }));
    }
    let water: Vec<bool> = values.into_iter().map(|value| candidate.water.holds(value)).collect();
    let shape = [0, 1, 2].map(|k| if extent[k] == 1 { 1 } else { plan.along(k) });
    // A face is water if the points on both sides are.
    let reach = |k: usize| if extent[k] > shape[k] { 2 } else { 1 };
    let mut land = Vec::with_capacity(shape.iter().product());
    for z in 0..shape[2] {
        for y in 0..shape[1] {
            for x in 0..shape[0] {
                let beside = |dy: usize| (0..reach(0)).all(|dx| water[z * strides[2] + (y + dy) * strides[1] + (x + dx) * strides[0]]);
                land.push(!(0..reach(1)).all(beside));
            }
        }
    }
    Ok(Some(Mask::new(&variable.name, shape, land)))
}

/// Number in the file, from the surface, of each level that a component is read on. `None` if the file does not have all the levels that `counts` reach to:
/// which of them it holds is then not known.
fn below_bottom(counts: &[f64], plan: &ComponentPlan) -> Option<impl Fn(usize) -> f64 + use<>> {
    let most = counts.iter().copied().filter(|n| n.is_finite()).fold(0.0, f64::max);
    let is_level = |name: &str| classify_name(name) == Kind::Level || name.to_ascii_lowercase().starts_with("z_");
    let place = (0..plan.roles.len()).find(|&i| match plan.roles[i] {
        Role::Axis(2) => true,
        Role::Fixed(_) => is_level(&plan.dimensions[i]),
        _ => false,
    });
    let fixed = match place.map(|i| (plan.roles[i], plan.shape[i])) {
        Some((_, len)) if (len as f64) < most => return None,
        Some((Role::Fixed(entry), _)) => entry,
        // The surface, without levels.
        _ => 0,
    };
    Some(move |level: usize| (fixed + level) as f64)
}

/// Standard name and long name, in small letters.
fn words_of(variable: &Variable) -> String {
    let of = |name: &str| variable.text(name).unwrap_or_default().to_ascii_lowercase();
    format!("{} {}", of("standard_name"), of("long_name"))
}

/// True if a velocity is of air, as far as its names say: its standard name, else a word of its long name.
pub fn is_of_air(variable: &Variable) -> bool {
    let standard = variable.text("standard_name").unwrap_or_default().to_ascii_lowercase();
    let says = |words: &[&str]| words.iter().any(|word| standard.contains(word));
    if says(&["sea_", "ocean", "water"]) {
        return false;
    }
    let words = words_of(variable);
    let mut words = words.split(|c: char| !c.is_alphanumeric());
    says(&["wind", "air"]) || words.any(|word| ["wind", "winds", "air", "atmosphere", "atmospheric"].contains(&word))
}

/// True if a velocity is of water, as far as its names say.
pub fn is_of_water(listing: &Listing, variable: &Variable) -> bool {
    let words = words_of(variable);
    let says = |words: &str, parts: &[&str]| parts.iter().any(|part| words.contains(part));
    if is_of_air(variable) {
        return false;
    }
    let name = variable.name.to_ascii_lowercase();
    let downwards = |&d: &usize| listing.dimensions[d].name.to_ascii_lowercase().starts_with("dep");
    says(&words, &["sea", "ocean", "current", "water"])
        || ["uo", "vo", "wo", "uvel", "vvel", "wvel", "ucur", "vcur", "wcur", "ugos", "vgos", "ssu", "ssv"].contains(&name.as_str())
        || says(&name, &["vozocrtx", "vomecrty", "vovecrtz", "water", "current"])
        || variable.dimensions.iter().any(downwards)
}
