//! Checks of the archive settings: by themselves, and against the files.

use crate::archive_settings::{ArchiveSettings, Metric, Staggering, WITH_UNITS};
use crate::cf::coordinate::Kind;
use crate::error::SourceError;
use crate::formats::Format;
use crate::grids::{Layout, Quantity, Resampling};

/// Longest wait for a further snapshot, in seconds: four months.
const MOST_FOLLOWED: f64 = 1e7;

/// Refuses settings that are wrong for all files.
///
/// # Errors
/// The setting at fault.
pub fn check(settings: &ArchiveSettings) -> Result<(), SourceError> {
    let fault = |key, found: String, accepted: &str| Err(SourceError::setting(key, found, accepted));
    if let Some(region) = settings.region
        && !(region.iter().all(|v| v.is_finite()) && region[2] < region[3] && region[0] != region[1])
    {
        return fault("region", format!("{region:?}"), "[x0, x1, y0, y1] with y0 < y1 and x0 < x1 (longitudes may cross the seam)");
    }
    if let Some(slab) = settings.slab
        && !(slab[0].is_finite() && slab[1].is_finite() && slab[0] < slab[1])
    {
        return fault("slab", format!("{slab:?}"), "[lower, upper] with lower < upper");
    }
    if let Some(scale) = settings.vertical_scale
        && !(scale.is_finite() && scale > 0.0)
    {
        return fault("vertical_scale", scale.to_string(), "a number above 0");
    }
    if let Some(gib) = settings.memory_gib
        && !(gib.is_finite() && gib > 0.0)
    {
        return fault("memory_gib", gib.to_string(), "a number above 0");
    }
    if let Some(follow) = settings.follow
        && !(follow.is_finite() && follow > 0.0 && follow <= MOST_FOLLOWED)
    {
        return fault("follow", follow.to_string(), "seconds above 0, up to 1e7");
    }
    if settings.follow.is_some() && (settings.steady || settings.synthetic.is_some()) {
        return fault("follow", "given".into(), "left out of steady flows and synthetic archives, to which no snapshots are added");
    }
    if let Some(odd) = settings.units.iter().flatten().find(|(of, _)| !WITH_UNITS.contains(&of.as_str())) {
        return fault(
            "units",
            format!("{{ {} = {:?} }}", odd.0, odd.1),
            "units of u, v, w, x, y, z and time: --set archive.units.u=\"m s-1\"",
        );
    }
    if settings.level.is_some_and(|l| !l.is_finite()) {
        return fault("level", format!("{:?}", settings.level), "a coordinate of the level axis");
    }
    Ok(())
}

/// Refuses settings that have no effect on files of this kind. `from_ground` tells whether it matters which way velocities run.
///
/// # Errors
/// The setting at fault.
pub fn check_fit(settings: &ArchiveSettings, layout: &Layout, from_ground: bool, format: Format) -> Result<(), SourceError> {
    let s = settings;
    let hdf5 = !format.names_dimensions();
    let staggered = matches!(layout.resampling, Some(Resampling::Staggered(_)));
    let curvilinear = matches!(layout.resampling, Some(Resampling::Curvilinear(_)));
    let unstructured = matches!(&layout.resampling, Some(Resampling::Curvilinear(c)) if c.meshes[0].triangles.is_some());
    let what = match () {
        () if unstructured => "an unstructured mesh",
        () if staggered => "WRF output",
        () if curvilinear => "longitudes and latitudes of two dimensions",
        () => format.name(),
    };
    let terrain = staggered || layout.frames[0].iter().any(|component| component.columns.is_some());
    let own_axes = layout.frames[0].iter().any(|component| component.own.iter().any(Option::is_some));
    // Pressures have factors that differ from level to level.
    let metres = layout.axes.len() > 2 && layout.axes[2].quantity == Quantity::Length && layout.vertical.windows(2).all(|w| w[0] == w[1]);
    let in_degrees = layout.axes[0].kind == Kind::Longitude;
    let in_metres = layout.metric == Metric::Sphere || (layout.metric == Metric::Cartesian && !in_degrees);
    let closes = metres && in_metres && !staggered;
    let heights = layout.axes.len() > 2 && layout.metric != Metric::Index;
    for (key, given, fits, accepted) in [
        ("velocity", s.velocity.is_some(), hdf5, "with HDF5 only; --set archive.u=NAME, archive.v and archive.w name variables of NetCDF"),
        ("order", s.order.is_some(), hdf5, "with HDF5 only"),
        ("spacing", s.spacing.is_some(), hdf5, "with HDF5 only; the coordinates of NetCDF are in the file"),
        ("origin", s.origin.is_some(), hdf5, "with HDF5 only; the coordinates of NetCDF are in the file"),
        ("time_step", s.time_step.is_some(), hdf5, "with HDF5 only; the times of NetCDF are in the file"),
        ("heights", s.heights.is_some(), terrain, "with levels that follow the terrain or the bottom of the sea only"),
        (
            "staggering",
            s.staggering != Staggering::default(),
            staggered || own_axes,
            "with components that have own coordinates, as in WRF output, only",
        ),
        (
            "w",
            s.wants_continuity(),
            closes,
            "\"continuity\" with levels in metres, on the sphere or on x and y in metres, and not with WRF output",
        ),
        ("x", s.x.is_some(), !staggered, "left out with WRF output, whose axes are known"),
        ("y", s.y.is_some(), !staggered, "left out with WRF output, whose axes are known"),
        ("z", s.z.is_some(), !staggered, "left out with WRF output, whose axes are known"),
        ("resolution", s.resolution.is_some(), curvilinear, "with longitudes and latitudes of two dimensions and unstructured meshes only"),
        (
            "grid_relative",
            s.grid_relative.is_some(),
            curvilinear || from_ground,
            "with projections, rotated poles, longitudes and latitudes of two dimensions, and unstructured meshes only",
        ),
        ("select", s.select.is_some(), !hdf5 && !staggered, "left out with HDF5 and WRF output"),
        ("units", s.units.is_some(), !hdf5 && !staggered, "left out with HDF5 and WRF output"),
        ("mask", s.mask.is_some(), !staggered, "left out with WRF output, whose winds blow over land too"),
        ("vertical_scale", s.vertical_scale.is_some(), heights, "with levels, in the sphere and cartesian metrics"),
    ] {
        if given && !fits {
            return Err(SourceError::setting(key, format!("given, but has no effect on {what}"), accepted));
        }
    }
    let repeats = |text: &str| if hdf5 { !text.is_empty() && text.bytes().all(|b| b"xyzXYZ".contains(&b)) } else { text == "none" };
    match s.periodic.as_deref().filter(|text| !repeats(text)) {
        None => Ok(()),
        Some(text) => {
            let accepted = if hdf5 { "the letters of the axes that repeat, such as \"xy\"" } else { "\"none\", or left out" };
            Err(SourceError::setting("periodic", format!("{text:?}"), accepted))
        }
    }
}
