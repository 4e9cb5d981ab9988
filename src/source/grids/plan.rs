//! Choice of the plan for a file.

use super::axes::{AxisPlan, Coordinates};
use super::layout::Layout;
use super::planner::Planner;
use crate::archive_settings::ArchiveSettings;
use crate::cf::coordinate::{Kind, classify};
use crate::error::SourceError;
use crate::formats::DataFile;

/// Plans how to read a file. Costly parts are taken from `first`, the layout of the archive's first file.
///
/// # Errors
/// A file that lacks a velocity, axes or times that are understood; settings that do not fit.
pub fn plan(file: &DataFile, settings: &ArchiveSettings, first: Option<&Layout>) -> Result<Layout, SourceError> {
    let mut planner = Planner::new(file, settings);
    if !file.listing.format.names_dimensions() {
        return planner.plan_datasets();
    }
    let velocity = planner.velocity()?;
    let components = [Some(&velocity.u), Some(&velocity.v), velocity.w.as_ref()];
    components.into_iter().flatten().try_for_each(|c| planner.check_extents(c.variable))?;
    if planner.is_staggered(&velocity) {
        if let Some(field) = planner.named_heights() {
            return Err(planner.misfit(field, "the heights of WRF's levels are those of `PH` and `PHB`: leave out `z`"));
        }
        planner.plan_staggered(&velocity, first)
    } else if let Some(points) = planner.unstructured_points(&velocity)? {
        planner.plan_curvilinear(&velocity, points, first)
    } else if let Some(points) = planner.curvilinear_points(&velocity)? {
        planner.plan_curvilinear(&velocity, points, first)
    } else {
        planner.plan_rectilinear(&velocity, first)
    }
}

/// Axes of a file whose velocity is not understood, with their names (`x`, `y`, `z`): for each, the first variable of one dimension
/// that measures it and whose values make an axis.
pub fn readable_axes(file: &DataFile, settings: &ArchiveSettings) -> Vec<(&'static str, AxisPlan)> {
    let planner = Planner::new(file, settings);
    let axis = |(role, kinds): (&'static str, &[Kind])| {
        (0..file.listing.variables.len()).find_map(|i| {
            let variable = planner.variable(i);
            let kind = classify(variable);
            let fits = variable.dimensions.len() == 1 && variable.number.is_number() && kinds.contains(&kind);
            let values = fits.then(|| planner.coordinate_values(i).ok()).flatten()?;
            Some((role, Coordinates::of(planner.path(), variable, kind, values).plan(None, true).ok()?))
        })
    };
    let roles: [(&str, &[Kind]); 3] = [("x", &[Kind::Longitude, Kind::X]), ("y", &[Kind::Latitude, Kind::Y]), ("z", &[Kind::Level])];
    roles.into_iter().filter_map(axis).collect()
}
