//! What one file of an archive holds, for files that have to be read together.

use super::column_field::named_heights;
use super::mask::holds_mask;
use super::planner::Planner;
use super::unstructured_plan::holds_mesh;
use crate::archive_settings::ArchiveSettings;
use crate::cf::coordinate::{Kind, classify, classify_name};
use crate::cf::velocity::{Component, judge};
use crate::error::SourceError;
use crate::formats::{DataFile, Listing, Variable};

/// Components and times of a file.
pub struct Content {
    /// Whether there is a velocity along x, y and the levels.
    pub components: [bool; 3],
    /// Times of the components, or of heights that change; empty without any.
    pub seconds: Vec<f64>,
    /// The times, in words.
    pub when: String,
    /// Names and shapes of the variables that do not change with time.
    pub fixed: Vec<(String, Vec<usize>)>,
    /// True if it holds a mask, longitudes and latitudes of two dimensions, an unstructured mesh, or the heights of levels that are named.
    pub helps: bool,
}

fn fixed(listing: &Listing) -> Vec<(String, Vec<usize>)> {
    let moves = |v: &Variable| v.dimensions.iter().any(|&d| classify_name(&listing.dimensions[d].name) == Kind::Time);
    listing.variables.iter().filter(|v| !moves(v)).map(|v| (v.name.clone(), listing.shape(v))).collect()
}

/// Contents of a file; `None` if it does not name dimensions.
///
/// # Errors
/// One component alone whose times are not understood.
pub fn content(file: &DataFile, settings: &ArchiveSettings) -> Result<Option<Content>, SourceError> {
    let listing = &file.listing;
    if !listing.format.names_dimensions() {
        return Ok(None);
    }
    let found: Vec<(usize, Component)> = (0..listing.variables.len())
        .filter_map(|i| judge(listing, i, settings.velocity_units()).ok().map(|c| (i, c.component)))
        .filter(|(_, component)| *component != Component::W || !settings.leaves_out_w())
        .collect();
    let named = [settings.u.as_deref(), settings.v.as_deref(), settings.named_w()];
    let variable = |k: usize| match named[k] {
        Some(name) => listing.find(name),
        None => found.iter().find(|(_, component)| *component as usize == k).map(|(i, _)| *i),
    };
    let variables = [0, 1, 2].map(variable);
    let pair = [Kind::Longitude, Kind::Latitude].map(|kind| listing.matching(|v| v.dimensions.len() > 1 && classify(v) == kind).next());
    let mut content = Content {
        components: variables.map(|v| v.is_some()),
        seconds: Vec::new(),
        when: String::new(),
        fixed: fixed(listing),
        helps: holds_mask(listing, settings)
            || pair.iter().all(Option::is_some)
            || holds_mesh(listing)
            || named_heights(listing, settings).is_some(),
    };
    // A mesh has one time at most, of which it says nothing.
    let is_dated = |d: usize| {
        let says = |v: &Variable| v.dimensions == [d] && v.units().is_some_and(|units| units.contains(" since "));
        listing.dimensions[d].len > 1 || listing.matching(says).next().is_some()
    };
    let moving = |&field: &usize| {
        let dimensions = &listing.variables[field].dimensions;
        dimensions.iter().any(|&d| classify_name(&listing.dimensions[d].name) == Kind::Time && is_dated(d))
    };
    let heights = named_heights(listing, settings).filter(moving);
    if let Some(variable) = variables.into_iter().flatten().next().or(heights) {
        // Coordinates may lie in another file.
        let mut own = settings.clone();
        let is_here = |name: &String| listing.find(name).is_some() || listing.dimensions.iter().any(|d| d.name == *name);
        [&mut own.x, &mut own.y, &mut own.z].into_iter().for_each(|name| *name = name.take().filter(is_here));
        let mut planner = Planner::new(file, &own);
        let time = match planner.extents(variable).and_then(|extents| planner.time(&extents)) {
            Ok(time) => time,
            // What is wrong with whole files is told when they are planned.
            Err(_) if content.components[..2] == [true; 2] => return Ok(None),
            Err(error) => return Err(error),
        };
        let show = |t: &f64| time.calendar.and_then(|c| c.iso(*t)).unwrap_or_else(|| format!("{t} s"));
        content.when = match &time.seconds[..] {
            [one] => show(one),
            [first, .., last] => format!("{} times from {} to {}", time.seconds.len(), show(first), show(last)),
            [] => "none".into(),
        };
        content.seconds = time.seconds;
    }
    Ok(Some(content))
}
