//! Many files as one sequence of snapshots.

use super::axes::AxisPlan;
use super::cf::calendar::Calendar;
use super::cf::coordinate::Kind;
use super::container::{Container, Format, Header};
use super::conversion::Conversion;
use super::files::expand;
use super::hyperslab::{Orders, read_component};
use super::layout::{ComponentPlan, Layout, Resampling, difference, plan};
use super::poles::Poles;
use super::settings::{ArchiveSettings, Metric, Staggering, VelocityUnit};
use super::synthetic::{declared, synthesized};
use super::{SnapshotSource, SourceDescription, SourceError, TimeGap, time_gaps};
use crate::field::{Axis, EARTH_RADIUS, Geometry, Grid, Snapshot};
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// A file of the archive; closed until it is read.
struct ArchiveFile {
    path: PathBuf,
    frames: Vec<Vec<ComponentPlan>>,
}

/// Where a snapshot is.
#[derive(Debug, Clone, Copy)]
struct Place {
    file: usize,
    frame: usize,
    entry: usize,
}

/// Velocity in NetCDF files with CF conventions, of WRF, on curvilinear grids, or in HDF5 files. Opening reads headers, coordinates and
/// times; velocities are read one snapshot at a time. One file is open at any moment.
pub struct Archive {
    files: Vec<ArchiveFile>,
    /// In time order.
    places: Vec<Place>,
    seconds: Vec<f64>,
    times: Vec<f64>,
    calendar: Option<Calendar>,
    axes: Vec<AxisPlan>,
    grid: Arc<Grid>,
    conversion: Option<Conversion>,
    /// See [`Layout::vertical`].
    vertical: Vec<f64>,
    poles: Poles,
    resampling: Option<Arc<Resampling>>,
    metric: Metric,
    in_cells: bool,
    description: SourceDescription,
    open: Option<(usize, Container)>,
    /// Header of the velocities, where files may be opened by it.
    like: Option<Header>,
}

impl Archive {
    /// Opens files, folders and patterns; where there are none, those of the settings. Snapshots are sorted by time.
    ///
    /// # Errors
    /// A file that cannot be read, that lacks a velocity, axes or times that are understood, or that differs from the first one
    /// in grid, variables or calendar; two snapshots of one time; settings that do not fit. Each names the file.
    pub fn open(paths: &[PathBuf], settings: &ArchiveSettings) -> Result<Self, SourceError> {
        let mut archive = Self::open_files(files_of(paths, settings)?, settings)?;
        let made = settings.synthetic.as_ref().filter(|_| paths.is_empty() && settings.files.is_empty());
        if let Some(made) = made.filter(|_| archive.description.synthetic.is_none()) {
            // Written before files said so themselves.
            archive.is_made_of(made.described());
        }
        Ok(archive)
    }

    fn is_made_of(&mut self, what: String) {
        self.description.notes.push(format!("the velocities are {what}"));
        self.description.synthetic = Some(what);
    }

    /// Opens files that are already a list.
    pub(super) fn open_files(paths: Vec<PathBuf>, settings: &ArchiveSettings) -> Result<Self, SourceError> {
        check(settings)?;
        let mut first: Option<(Layout, &'static str)> = None;
        let mut entries: Vec<(f64, Place)> = Vec::new();
        let mut files = Vec::with_capacity(paths.len());
        let mut last_open = None;
        let mut like: Option<Header> = None;
        let mut synthetic = None;
        for path in paths {
            let known = first.as_ref().map(|f| &f.0);
            let mut container = Container::open_like(&path, like.as_ref())?;
            let mut planned = plan(&container, settings, known);
            let fits = |planned: &Result<Layout, SourceError>| match (planned, known) {
                (Ok(layout), Some(known)) => difference(known, layout).is_none(),
                (planned, _) => planned.is_ok(),
            };
            if like.is_some() && !fits(&planned) {
                // The part of the header that sufficed for the first file does not for this one, which decides nothing.
                container = Container::open(&path)?;
                planned = plan(&container, settings, known);
            }
            let layout = planned?;
            if like.is_none() && layout.resampling.is_none() && container.format == Format::NetCdf4 {
                like = Some(container.header.part(&layout.used(&container.header)));
            }
            let index = files.len();
            let place = |&(frame, entry): &(usize, usize)| Place { file: index, frame, entry };
            entries.extend(layout.time.seconds.iter().copied().zip(layout.time.places.iter().map(place)));
            files.push(ArchiveFile { path, frames: layout.frames.clone() });
            match &mut first {
                Some((reference, _)) => {
                    let path = &files[index].path;
                    reference.widen(&layout).map_err(|fault| SourceError::Axis { path: path.clone(), fault })?;
                    if let Some(what) = difference(reference, &layout) {
                        return Err(SourceError::Mixed { first: files[0].path.clone(), second: files[index].path.clone(), what });
                    }
                }
                None => {
                    synthetic = declared(&container.header).map(str::to_owned);
                    first = Some((layout, container.format.name()));
                }
            }
            last_open = Some((index, container));
        }
        let Some((layout, format)) = first else { return Err(SourceError::NoFiles) };
        entries.sort_by(|a, b| a.0.total_cmp(&b.0));
        let calendar = layout.time.calendar;
        check_duplicates(&entries, &files, calendar)?;
        let seconds: Vec<f64> = entries.iter().map(|e| e.0).collect();
        let times = match layout.metric {
            Metric::Index => (0..seconds.len()).map(|i| i as f64).collect(),
            Metric::Sphere | Metric::Cartesian => seconds.clone(),
        };
        check_fit(settings, &layout, format)?;
        let path = &files[0].path;
        let conversion = match (layout.metric, settings.velocity_unit) {
            (Metric::Index, VelocityUnit::Si) => Some(Conversion::to_cells(&layout.axes)),
            (Metric::Cartesian, VelocityUnit::Si) if is_sphere(&layout.axes) => Some(Conversion::to_degrees(&layout.axes)),
            _ => None,
        };
        let grid = Arc::new(build_grid(path, &layout, settings)?);
        let description = describe(&layout, format, files.len(), &seconds);
        let names: Vec<String> = layout.frames.iter().flatten().map(|c| c.name.clone()).collect();
        let like = like.map(|header| header.part(&names));
        let mut archive = Self {
            places: entries.iter().map(|e| e.1).collect(),
            vertical: layout.vertical,
            poles: layout.poles,
            resampling: layout.resampling,
            seconds,
            times,
            calendar,
            axes: layout.axes,
            grid,
            conversion,
            metric: layout.metric,
            in_cells: settings.velocity_unit == VelocityUnit::Cells,
            description,
            open: last_open,
            like,
            files,
        };
        if let Some(what) = synthetic {
            archive.is_made_of(what);
        }
        if let Some([error, size]) = archive.resampling_error()? {
            archive.description.notes.push(format!(
                "resampling error, measured on the first snapshot at the file's own points: {error:.3} m/s of {size:.3} m/s ({:.1} %), root mean square",
                100.0 * error / size.max(f64::MIN_POSITIVE)
            ));
        }
        Ok(archive)
    }

    /// The files, in the order of their names in the arguments.
    pub fn files(&self) -> impl ExactSizeIterator<Item = &Path> {
        self.files.iter().map(|f| f.path.as_path())
    }

    /// Seconds since 1970-01-01 in the archive's calendar (or since the simulation's start), one a snapshot, ascending. Equal to
    /// [`SnapshotSource::times`] but in the index metric.
    pub fn seconds(&self) -> &[f64] {
        &self.seconds
    }

    /// Metric in force.
    pub fn metric(&self) -> Metric {
        self.metric
    }

    /// Intervals of more than one and a half times the median, in [`Self::seconds`].
    pub fn gaps(&self) -> Vec<TimeGap> {
        time_gaps(&self.seconds)
    }

    /// Units of the axes in the files, before the index metric replaced them, with direction: for reports.
    pub(super) fn axis_plans(&self) -> &[AxisPlan] {
        &self.axes
    }

    /// Variable, component and reason of what is read.
    pub(super) fn chosen(&self) -> impl Iterator<Item = (&str, &'static str, &str)> {
        self.files[0].frames[0].iter().zip(["u", "v", "w"]).map(|(c, role)| (c.name.as_str(), role, c.why.as_str()))
    }

    /// Measures one snapshot's velocities in SI and in cells per interval.
    pub(super) fn displacement(&mut self, index: usize) -> Result<Displacement, SourceError> {
        let raw = self.components(index)?;
        let mut cells = raw.clone();
        if !self.in_cells {
            Conversion::to_cells(&self.axes).apply(&mut cells, self.grid.shape(), self.interval(index));
        }
        let mut sum = Displacement::default();
        for i in 0..self.grid.nodes() {
            if raw.iter().any(|c| !c[i].is_finite()) {
                sum.missing += 1;
                continue;
            }
            sum.known += 1;
            for (total, component) in sum.squared_velocity.iter_mut().zip(&raw) {
                *total += f64::from(component[i]).powi(2);
            }
            let squared = cells.iter().map(|c| f64::from(c[i]).powi(2)).sum::<f64>();
            sum.squared_cells += squared;
            sum.greatest_cells = sum.greatest_cells.max(squared.sqrt());
        }
        Ok(sum)
    }

    /// Seconds that snapshot `index` stands for: half the way to its neighbours on both sides.
    fn interval(&self, index: usize) -> f64 {
        let last = self.seconds.len() - 1;
        let (low, high) = (index.saturating_sub(1), (index + 1).min(last));
        if high > low { (self.seconds[high] - self.seconds[low]) / (high - low) as f64 } else { 1.0 }
    }

    /// Makes the file of a snapshot the open one.
    fn container(&mut self, file: usize) -> Result<&Container, SourceError> {
        if self.open.as_ref().is_none_or(|o| o.0 != file) {
            // Closed before the next is opened.
            self.open = None;
            let path = &self.files[file].path;
            let container = Container::open_like(path, self.like.as_ref())?;
            for component in self.files[file].frames.iter().flatten() {
                let found = container.header.find(&component.name).map(|v| &container.header.variables[v]);
                if found.is_none_or(|v| container.header.shape(v) != component.shape) {
                    let what = "it changed since the archive was opened".into();
                    return Err(SourceError::Read { path: path.clone(), variable: component.name.clone(), what });
                }
            }
            self.open = Some((file, container));
        }
        match &self.open {
            Some((_, container)) => Ok(container),
            None => Err(SourceError::NoFiles),
        }
    }

    /// The components of a snapshot in SI (or as they are, in cells), the third along the grid's third axis; x fastest; missing values
    /// are NaN.
    fn components(&mut self, index: usize) -> Result<Vec<Vec<f32>>, SourceError> {
        let Some(&Place { file, frame, entry }) = self.places.get(index) else {
            return Err(SourceError::NoSuchSnapshot { index, count: self.places.len() });
        };
        self.container(file)?;
        let Some((_, container)) = &self.open else { return Err(SourceError::NoFiles) };
        let plans = &self.files[file].frames[frame];
        let mut components = match &self.resampling {
            Some(resampling) => resampling.read(container, plans, entry, self.axes.get(2).map_or(&[0], |a| &a.order))?,
            None => {
                let orders: Orders = std::array::from_fn(|k| self.axes.get(k).map_or_else(|| vec![0], |a| a.order.clone()));
                plans.iter().map(|plan| read_component(container, plan, &orders, entry)).collect::<Result<_, _>>()?
            }
        };
        if !self.vertical.is_empty()
            && let Some(w) = components.get_mut(2)
        {
            let plane = w.len() / self.vertical.len();
            for (values, &factor) in w.chunks_exact_mut(plane).zip(&self.vertical) {
                values.iter_mut().for_each(|v| *v = (f64::from(*v) * factor) as f32);
            }
        }
        self.poles.extend(&mut components, self.axes[0].axis.coordinates(), self.axes[1].order.len());
        Ok(components)
    }

    /// What resampling does, in words; none where nothing is resampled.
    pub(super) fn resampled(&self) -> Option<&str> {
        self.resampling.as_deref().map(Resampling::what)
    }

    /// How far resampling is off, measured on the first snapshot; none where nothing is resampled. See [`Resampling::error`].
    pub(super) fn resampling_error(&mut self) -> Result<Option<[f64; 2]>, SourceError> {
        let Some(resampling) = self.resampling.clone() else { return Ok(None) };
        let Place { file, frame, entry } = self.places[0];
        self.container(file)?;
        let Some((_, container)) = &self.open else { return Err(SourceError::NoFiles) };
        resampling.error(container, &self.files[file].frames[frame], entry).map(Some)
    }
}

impl SnapshotSource for Archive {
    fn grid(&self) -> &Arc<Grid> {
        &self.grid
    }

    fn times(&self) -> &[f64] {
        &self.times
    }

    fn read(&mut self, index: usize) -> Result<Snapshot, SourceError> {
        let mut components = self.components(index)?;
        if let Some(conversion) = &self.conversion {
            let interval = if self.metric == Metric::Index { self.interval(index) } else { 1.0 };
            conversion.apply(&mut components, self.grid.shape(), interval);
        }
        let w: &[f32] = components.get(2).map_or(&[], Vec::as_slice);
        Ok(Snapshot::from_components(self.times[index], self.grid.clone(), &components[0], &components[1], w))
    }

    fn date(&self, time: f64) -> Option<String> {
        let calendar = self.calendar?;
        if self.metric != Metric::Index {
            return calendar.iso(time);
        }
        if !(time >= 0.0 && time <= (self.seconds.len() - 1) as f64) {
            return None;
        }
        let (low, high) = (time.floor() as usize, time.ceil() as usize);
        calendar.iso(self.seconds[low] + (self.seconds[high] - self.seconds[low]) * time.fract())
    }

    fn describe(&self) -> SourceDescription {
        self.description.clone()
    }

    fn name(&self) -> String {
        match &self.files[..] {
            [file] => file.path.display().to_string(),
            files => format!("{} and {} other file(s)", files[0].path.display(), files.len() - 1),
        }
    }
}

/// Sums over the nodes of one or more snapshots.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Displacement {
    pub(super) known: usize,
    pub(super) missing: usize,
    pub(super) squared_velocity: [f64; 3],
    pub(super) squared_cells: f64,
    pub(super) greatest_cells: f64,
}

impl Displacement {
    pub(super) fn add(&mut self, other: &Self) {
        self.known += other.known;
        self.missing += other.missing;
        self.squared_velocity.iter_mut().zip(other.squared_velocity).for_each(|(a, b)| *a += b);
        self.squared_cells += other.squared_cells;
        self.greatest_cells = self.greatest_cells.max(other.greatest_cells);
    }
}

fn is_sphere(axes: &[AxisPlan]) -> bool {
    axes[0].kind == Kind::Longitude && axes[1].kind == Kind::Latitude
}

/// The files that are meant: those given, else those of the settings, else a synthetic archive.
pub(super) fn files_of(paths: &[PathBuf], settings: &ArchiveSettings) -> Result<Vec<PathBuf>, SourceError> {
    let paths = if paths.is_empty() { &settings.files } else { paths };
    match &settings.synthetic {
        Some(synthetic) if paths.is_empty() => expand(&[synthesized(synthetic)?]),
        _ => expand(paths),
    }
}

/// Settings that are wrong whatever the files are.
fn check(settings: &ArchiveSettings) -> Result<(), SourceError> {
    let fault = |key, found: String, accepted: &str| Err(SourceError::Setting { key, found, accepted: accepted.into() });
    if let Some(region) = settings.region
        && !(region.iter().all(|v| v.is_finite()) && region[2] < region[3] && region[0] != region[1])
    {
        return fault("region", format!("{region:?}"), "[x0, x1, y0, y1] with y0 < y1 and x0 < x1 (longitudes may pass the seam)");
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
    if settings.level.is_some_and(|l| !l.is_finite()) {
        return fault("level", format!("{:?}", settings.level), "a coordinate of the level axis");
    }
    Ok(())
}

/// Settings that would do nothing for files of this kind.
fn check_fit(settings: &ArchiveSettings, layout: &Layout, format: &str) -> Result<(), SourceError> {
    let s = settings;
    let hdf5 = format == Format::Hdf5.name();
    let (staggered, curvilinear) = match layout.resampling.as_deref() {
        Some(Resampling::Staggered(_)) => (true, false),
        Some(Resampling::Curvilinear(_)) => (false, true),
        None => (false, false),
    };
    let what = match () {
        () if staggered => "WRF output",
        () if curvilinear => "longitudes and latitudes of two dimensions",
        () => format,
    };
    let heights = layout.axes.len() > 2 && layout.metric != Metric::Index;
    for (key, given, fits, accepted) in [
        ("velocity", s.velocity.is_some(), hdf5, "with HDF5 only; `u`, `v` and `w` name variables of NetCDF"),
        ("order", s.order.is_some(), hdf5, "with HDF5 only"),
        ("spacing", s.spacing.is_some(), hdf5, "with HDF5 only; the coordinates of NetCDF are in the file"),
        ("origin", s.origin.is_some(), hdf5, "with HDF5 only; the coordinates of NetCDF are in the file"),
        ("time_step", s.time_step.is_some(), hdf5, "with HDF5 only; the times of NetCDF are in the file"),
        ("heights", s.heights.is_some(), staggered, "with WRF output only"),
        ("staggering", s.staggering != Staggering::default(), staggered, "with WRF output only"),
        ("x", s.x.is_some(), !staggered, "left out with WRF output, whose axes are known"),
        ("y", s.y.is_some(), !staggered, "left out with WRF output, whose axes are known"),
        ("z", s.z.is_some(), !staggered, "left out with WRF output, whose axes are known"),
        ("resolution", s.resolution.is_some(), curvilinear, "with longitudes and latitudes of two dimensions only"),
        ("grid_relative", s.grid_relative.is_some(), curvilinear, "with longitudes and latitudes of two dimensions only"),
        ("vertical_scale", s.vertical_scale.is_some(), heights, "with levels, in the sphere and cartesian metrics"),
    ] {
        if given && !fits {
            return Err(SourceError::Setting { key, found: format!("given, but does nothing for {what}"), accepted: accepted.into() });
        }
    }
    let repeats = |text: &str| if hdf5 { !text.is_empty() && text.bytes().all(|b| b"xyzXYZ".contains(&b)) } else { text == "none" };
    match s.periodic.as_deref().filter(|text| !repeats(text)) {
        None => Ok(()),
        Some(text) => Err(SourceError::Setting {
            key: "periodic",
            found: format!("{text:?}"),
            accepted: if hdf5 { "the letters of the axes that repeat, such as \"xy\"" } else { "\"none\", or left out" }.into(),
        }),
    }
}

fn check_duplicates(entries: &[(f64, Place)], files: &[ArchiveFile], calendar: Option<Calendar>) -> Result<(), SourceError> {
    let (Some(first), Some(last)) = (entries.first(), entries.last()) else { return Ok(()) };
    // Times written in different units may differ in their last digits.
    let slack = (last.0 - first.0) * 1e-9;
    match entries.windows(2).find(|w| w[1].0 - w[0].0 <= slack) {
        None => Ok(()),
        Some(pair) => Err(SourceError::DuplicateTime {
            time: calendar.and_then(|c| c.iso(pair[0].0)).unwrap_or_else(|| format!("time {}", pair[0].0)),
            first: files[pair[0].1.file].path.clone(),
            second: files[pair[1].1.file].path.clone(),
        }),
    }
}

fn build_grid(path: &Path, layout: &Layout, settings: &ArchiveSettings) -> Result<Grid, SourceError> {
    let index_axis = |plan: &AxisPlan| {
        let n = plan.axis.len();
        let axis = Axis::uniform(plan.axis.name(), "cells", 0.0, (n - 1) as f64, n);
        let axis = axis.map_err(|fault| SourceError::Axis { path: path.into(), fault })?;
        Ok(if plan.axis.period().is_some() { axis.with_period(n as f64) } else { axis })
    };
    let axes: Vec<Axis> = match layout.metric {
        Metric::Index => layout.axes.iter().map(index_axis).collect::<Result<_, SourceError>>()?,
        Metric::Sphere | Metric::Cartesian => layout.axes.iter().map(|p| p.axis.clone()).collect(),
    };
    let slab = settings.slab.map_or_else(|| super::slab_of(&axes), |[low, high]| (low, high));
    let geometry = if layout.metric == Metric::Sphere { Geometry::Sphere { radius: EARTH_RADIUS } } else { Geometry::Cartesian };
    Ok(Grid { axes, geometry, slab })
}

fn describe(layout: &Layout, format: &str, files: usize, seconds: &[f64]) -> SourceDescription {
    let variables = layout.frames[0].iter().zip(["u", "v", "w"]).map(|(c, k)| format!("{k} = `{}`: {}", c.name, c.why)).collect();
    let mut notes = layout.notes.clone();
    if layout.time.units.trim().is_empty() && layout.metric != Metric::Index {
        notes.push(format!("`{}` has no unit: taken as seconds", layout.time.variable));
    }
    for gap in time_gaps(seconds) {
        let show = |s: f64| layout.time.calendar.and_then(|c| c.iso(s)).unwrap_or_else(|| s.to_string());
        notes.push(format!(
            "gap in time between {} and {}: about {} snapshot(s) are missing",
            show(gap.after),
            show(gap.before),
            gap.missing
        ));
    }
    SourceDescription {
        kind: format!("{format}, {files} file(s)"),
        variables,
        metric: layout.metric,
        time_unit: if layout.metric == Metric::Index { "snapshots".into() } else { "s".into() },
        time_variable: Some(layout.time.variable.clone()),
        time_units_in_file: Some(layout.time.units.clone()),
        calendar: layout.time.calendar.map(|c| c.name().to_owned()),
        synthetic: None,
        notes,
    }
}
