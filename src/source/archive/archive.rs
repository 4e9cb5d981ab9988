//! Many files as one sequence of snapshots.

use super::check::{check, check_fit};
use super::files::expand;
use super::fills::unnamed_fill;
use super::follow::{Followed, Stamp, stamps};
use super::group::{Group, grouped, open_group};
use super::limits;
use super::synthetic::{declared, synthesized};
use crate::archive_settings::{ArchiveSettings, Metric, VelocityUnit};
use crate::cf::calendar::Calendar;
use crate::cf::coordinate::Kind;
use crate::cf::velocity::judge;
use crate::continuity::vertical_velocity;
use crate::error::SourceError;
use crate::formats::{DataFile, Format, Limits, Listing};
use crate::georeference::Georeference;
use crate::grids::{
    AxisPlan, ComponentPlan, Layout, Mask, Masks, NO_MASK, Orders, Poles, Resampling, ResamplingError, Role, SCALE_HEIGHT, VelocityScale,
    ZERO, difference, holds_mask, plan, read_component, read_levels, slab_of,
};
use crate::ground::GroundToGrid;
use crate::snapshots::{News, SnapshotSource, SourceDescription, TimeGap, time_gaps};
use ridgewatch_base::progress::Work;
use ridgewatch_field::{Axis, EARTH_RADIUS, Geometry, Grid, Snapshot};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant};

/// Names of the components, in order.
const COMPONENTS: [&str; 3] = ["u", "v", "w"];

/// A file of the archive, or several that are read as one; closed until it is read.
pub(super) struct ArchiveFile {
    pub(super) path: PathBuf,
    /// With files of other components, meshes and masks.
    pub(super) group: Group,
    pub(super) frames: Vec<Vec<ComponentPlan>>,
    /// As the files were before their times were read.
    pub(super) stamps: Vec<Option<Stamp>>,
}

/// The file that is open, or files that are read as one.
pub(super) struct OpenFile {
    /// Index in [`Archive::files`].
    index: usize,
    data: DataFile,
    /// As the files were before they were opened.
    stamps: Vec<Option<Stamp>>,
}

/// Shape of each component and, for each of its points, whether the velocity is always 0.
type Zeros = Vec<([usize; 3], Vec<bool>)>;

/// Place of a snapshot in the files.
#[derive(Debug, Clone, Copy)]
pub(super) struct Place {
    pub(super) file: usize,
    pub(super) frame: usize,
    pub(super) entry: usize,
}

/// Velocity in NetCDF files and Zarr stores with CF conventions, in WRF output, on curvilinear grids, or in HDF5 files. Opening reads
/// headers, coordinates and times; velocities are read one snapshot at a time. One file is open at any moment.
pub struct Archive {
    pub(super) files: Vec<ArchiveFile>,
    /// In time order.
    pub(super) places: Vec<Place>,
    pub(super) seconds: Vec<f64>,
    pub(super) times: Vec<f64>,
    calendar: Option<Calendar>,
    axes: Vec<AxisPlan>,
    grid: Arc<Grid>,
    scale: Option<VelocityScale>,
    /// See [`Layout::vertical`].
    vertical: Vec<f64>,
    poles: Poles,
    resampling: Option<Resampling>,
    ground_to_grid: Option<GroundToGrid>,
    metric: Metric,
    in_cells: bool,
    georeference: Georeference,
    description: SourceDescription,
    pub(super) open: Option<OpenFile>,
    /// Time at which the error of a resampling is measured.
    measured_at: usize,
    /// Listing of the velocities, if it suffices to open files.
    expected: Option<Listing>,
    pub(super) limits: Limits,
    pub(super) settings: ArchiveSettings,
    /// Layout of the first file.
    pub(super) first: Layout,
    /// Set once a snapshot was searched for fill values that the file does not name.
    fills_sought: bool,
    /// Set if further snapshots may come.
    pub(super) followed: Option<Box<Followed>>,
}

impl Archive {
    /// Opens files, folders and patterns; without any, those of the settings. Snapshots are sorted by time.
    ///
    /// # Errors
    /// A file that cannot be read, that lacks a velocity, axes or times that are understood, or that differs from the first one
    /// in grid, variables or calendar; two snapshots of one time; settings that do not fit. Each error names the file.
    pub fn open(paths: &[PathBuf], settings: &ArchiveSettings) -> Result<Self, SourceError> {
        let files = files_of(paths, settings)?;
        let stamps = settings.follow.map(|_| Followed::stamps(&files)).transpose()?;
        let mut archive = Self::open_files(files, settings)?;
        if let Some(stamps) = stamps {
            let paths = if paths.is_empty() { settings.files.clone() } else { paths.to_vec() };
            archive.followed = archive.followed.map(|followed| followed.watching(paths, stamps));
        }
        let synthetic = settings.synthetic.as_ref().filter(|_| paths.is_empty() && settings.files.is_empty());
        // Synthetic files of earlier versions do not declare themselves.
        if let Some(synthetic) = synthetic.filter(|_| archive.description.synthetic.is_none()) {
            archive.declare_synthetic(synthetic.described());
        }
        Ok(archive)
    }

    fn declare_synthetic(&mut self, what: String) {
        self.description.notes.push(format!("the velocities are {what}"));
        self.description.synthetic = Some(what);
    }

    /// Opens a list of files. See [`Archive::open`].
    pub(super) fn open_files(paths: Vec<PathBuf>, settings: &ArchiveSettings) -> Result<Self, SourceError> {
        check(settings)?;
        match Self::open_groups(paths.iter().map(|path| vec![path.clone()]).collect(), settings) {
            Err(error) if paths.len() > 1 => match grouped(&paths, settings)? {
                Some(groups) => Self::open_groups(groups, settings),
                None => Err(error),
            },
            result => result,
        }
    }

    /// Opens groups of files.
    fn open_groups(groups: Vec<Group>, settings: &ArchiveSettings) -> Result<Self, SourceError> {
        let limits = limits(settings);
        let mut first: Option<Layout> = None;
        let mut format = Format::Hdf5;
        let mut entries: Vec<(f64, Place)> = Vec::new();
        let mut files: Vec<ArchiveFile> = Vec::with_capacity(groups.len());
        let together = groups.iter().find(|group| group.len() > 1).map(|group| in_words(group));
        let mut open = None;
        let mut expected: Option<Listing> = None;
        let mut synthetic = None;
        let mut georeference = Georeference::default();
        let (mut ground_to_grid, mut ground_note) = (None, None);
        let mut masks: Vec<Group> = Vec::new();
        let count = groups.len();
        // The header of one file may take long too, and tells of itself.
        let work = (count > 1).then(|| Work::begin("opening the files"));
        for (number, group) in groups.into_iter().enumerate() {
            work.iter().for_each(|work| work.reached(number, count));
            let Some(path) = group.first().cloned() else { continue };
            let stamps = stamps(&group);
            let (file, layout) = match open_next(&group, settings, first.as_ref(), expected.as_ref(), limits) {
                Ok(both) => both,
                Err(_) if is_mask_alone(&path, settings, limits) => {
                    masks.push(group);
                    continue;
                }
                Err(error) => return Err(error),
            };
            let at_points = layout.frames.iter().flatten().all(|component| !component.is_interpolated());
            if expected.is_none() && group.len() == 1 && layout.resampling.is_none() && at_points && file.listing.format == Format::NetCdf4
            {
                expected = Some(file.listing.part(&layout.used(&file.listing)));
            }
            let index = files.len();
            let place = |&(frame, entry): &(usize, usize)| Place { file: index, frame, entry };
            entries.extend(layout.time.seconds.iter().copied().zip(layout.time.places.iter().map(place)));
            files.push(ArchiveFile { path: path.clone(), group: group.clone(), frames: layout.frames.clone(), stamps: stamps.clone() });
            match &mut first {
                Some(reference) => {
                    reference.widen(&layout).map_err(|fault| SourceError::file(&path, fault))?;
                    if let Some(what) = difference(reference, &layout) {
                        return Err(SourceError::Mixed { first: files[0].path.clone(), second: path, what });
                    }
                }
                None => {
                    synthetic = declared(&file.listing).map(str::to_owned);
                    if holds_mask(&file.listing, settings) {
                        masks.insert(0, group);
                    }
                    format = file.listing.format;
                    georeference = Georeference::of(&file, &layout, settings);
                    (ground_to_grid, ground_note) = GroundToGrid::of(&file, &layout, settings, georeference.positions.as_ref())?.unzip();
                    first = Some(layout);
                }
            }
            open = Some(OpenFile { index, data: file, stamps });
        }
        let Some(layout) = first else {
            let what = "it holds a mask of land, but no velocity: name the files of the velocity beside it";
            return Err(masks.first().and_then(|group| group.first()).map_or(SourceError::NoFiles, |path| SourceError::file(path, what)));
        };
        entries.sort_by(|a, b| a.0.total_cmp(&b.0));
        let calendar = layout.time.calendar;
        check_duplicates(&entries, &files, calendar)?;
        let seconds: Vec<f64> = entries.iter().map(|e| e.0).collect();
        let times = match layout.metric {
            Metric::Index => (0..seconds.len()).map(|i| i as f64).collect(),
            Metric::Sphere | Metric::Cartesian => seconds.clone(),
        };
        check_fit(settings, &layout, ground_note.is_some(), format)?;
        if settings.follow.is_some() && layout.metric == Metric::Index {
            let accepted = "in metres and seconds: velocities in cells an interval depend on the times that come next";
            return Err(SourceError::setting("follow", "given in the index metric", accepted));
        }
        let reference = layout.clone();
        let followed = settings.follow.map(|_| Box::new(Followed::default()));
        let on_sphere = layout.axes[0].kind == Kind::Longitude && layout.axes[1].kind == Kind::Latitude;
        let scale = match (layout.metric, settings.velocity_unit) {
            (Metric::Index, VelocityUnit::Si) => Some(VelocityScale::to_cells(&layout.axes)),
            (Metric::Cartesian, VelocityUnit::Si) if on_sphere => Some(VelocityScale::to_degrees(&layout.axes)),
            _ => None,
        };
        check_memory(&files[0].path, &layout, &limits)?;
        let mut land = Masks::default();
        let named = settings.mask.as_deref().filter(|mask| ![NO_MASK, ZERO].contains(mask));
        if let (Some(named), true) = (named, masks.is_empty()) {
            let accepted = format!(
                "a variable of the files (`!NAME` where 0 is water), \"{ZERO}\" or \"{NO_MASK}\"; name its file too, if it is in another"
            );
            return Err(SourceError::setting("mask", format!("\"{named}\", which no file holds"), accepted));
        }
        let staggered = matches!(layout.resampling, Some(Resampling::Staggered(_)));
        let unused = matches!(settings.mask.as_deref(), Some(NO_MASK | ZERO));
        if !staggered && !unused && !masks.is_empty() {
            open = None;
            for group in &masks {
                land.add(&open_group(group, limits)?, &layout.frames[0], settings)?;
            }
            files.iter_mut().flat_map(|file| &mut file.frames).for_each(|frame| land.apply(frame));
        }
        let grid = Arc::new(build_grid(&files[0].path, &layout.axes, layout.metric, settings)?);
        let description = describe(&layout, format, files.len(), &seconds);
        let names: Vec<String> = layout.frames.iter().flatten().map(|c| c.name.clone()).collect();
        let mut archive = Self {
            places: entries.iter().map(|e| e.1).collect(),
            vertical: layout.vertical,
            poles: layout.poles,
            ground_to_grid: ground_to_grid.flatten(),
            resampling: layout.resampling,
            seconds,
            times,
            calendar,
            axes: layout.axes,
            grid,
            scale,
            metric: layout.metric,
            in_cells: settings.velocity_unit == VelocityUnit::Cells,
            georeference,
            description,
            open,
            measured_at: 0,
            expected: expected.map(|listing| listing.part(&names)),
            limits,
            settings: settings.clone(),
            first: reference,
            files,
            fills_sought: false,
            followed,
        };
        if let Some(what) = synthetic {
            archive.declare_synthetic(what);
        }
        archive.description.notes.extend(together.map(|names| format!("read as one, and others alike: {names}")));
        let taken: Vec<&Vec<PathBuf>> = masks.iter().filter(|mask| archive.files.iter().all(|file| &file.group != *mask)).collect();
        if let ([first, rest @ ..], false) = (&taken[..], land.found.iter().all(Option::is_none)) {
            let more = if rest.is_empty() { String::new() } else { format!(" and {} more", rest.len()) };
            archive.description.notes.push(format!("no velocities, but a mask of land: {}{more}", in_words(first)));
        }
        archive.description.notes.extend(land.notes);
        archive.description.notes.extend(ground_note);
        match settings.mask.as_deref() {
            Some(ZERO) => archive.mask_zeros()?,
            None if land.found.iter().all(Option::is_none) && !staggered => archive.tell_zeros(),
            _ => {}
        }
        archive.refine(settings)?;
        if let Some(error) = archive.resampling_error()? {
            let notes = &mut archive.description.notes;
            notes.push(format!("resampling error, measured on one snapshot, root mean square: {error}"));
            notes.extend(archive.resampling.as_ref().and_then(|resampling| resampling.warning(&error)));
        }
        Ok(archive)
    }

    /// For each component, those of its `points` whose velocity is 0 at all of a few times. Stops as soon as there are none.
    fn zeros(&mut self, points: impl Fn(&ComponentPlan) -> Orders) -> Result<Zeros, SourceError> {
        let found = self.zeros_of_open(points);
        if self.files.len() > 1 {
            // A file that changes from here on is noticed.
            self.open = None;
        }
        found
    }

    fn zeros_of_open(&mut self, points: impl Fn(&ComponentPlan) -> Orders) -> Result<Zeros, SourceError> {
        let mut zeros = Zeros::new();
        for index in sampled(self.times.len()) {
            let place = self.open_at(index)?;
            let Some(OpenFile { data: file, .. }) = &self.open else { return Err(SourceError::NoFiles) };
            for (which, plan) in self.files[place.file].frames[place.frame].iter().enumerate().take(2) {
                let orders = points(plan);
                let values = read_component(file, plan, &orders, place.entry)?;
                match zeros.get_mut(which) {
                    Some((_, zero)) => zero.iter_mut().zip(values).for_each(|(zero, v)| *zero &= v == 0.0),
                    None => zeros.push((orders.map(|order| order.len()), values.into_iter().map(|v| v == 0.0).collect())),
                }
            }
            if let [(a, u), (b, v)] = &mut zeros[..]
                && a == b
            {
                u.iter_mut().zip(&mut *v).for_each(|(u, v)| (*u, *v) = (*u && *v, *u && *v));
            }
            if zeros.iter().all(|(_, zero)| !zero.contains(&true)) {
                return Ok(Vec::new());
            }
        }
        Ok(zeros)
    }

    /// Takes points as land whose velocity is 0 at all sampled times.
    fn mask_zeros(&mut self) -> Result<(), SourceError> {
        let mut masks: Vec<Arc<Mask>> =
            self.zeros(ComponentPlan::file_order)?.into_iter().map(|(shape, land)| Arc::new(Mask::new(ZERO, shape, land))).collect();
        // w has a mask only on the points of u.
        masks.extend(masks.first().cloned());
        for plan in self.files.iter_mut().flat_map(|file| &mut file.frames).flat_map(|frame| frame.iter_mut().zip(&masks)) {
            let (plan, mask) = plan;
            if mask.fits([0, 1, 2].map(|k| plan.along(k))) {
                plan.mask = Some(mask.clone());
            }
        }
        self.description.notes.push(match masks.first() {
            Some(mask) => format!("{:.1} % of the points are 0 at all sampled times: taken as missing, as set", 100.0 * mask.share()),
            None => "no point is 0 at all sampled times: `archive.mask = \"zero\"` finds no land".into(),
        });
        Ok(())
    }

    /// Tells of cells whose corners are 0 at all sampled times, in the middle one of the levels: probably land.
    fn tell_zeros(&mut self) {
        let level = self.axes.get(2).map_or(0, |axis| axis.order[axis.order.len() / 2]);
        // Nodes between the points of the file are no entries, and its components may differ in shape.
        let own_nodes = self.resampling.is_none() && self.files[0].frames[0].iter().all(|plan| plan.own.iter().all(Option::is_none));
        let region = own_nodes.then(|| [self.axes[0].order.clone(), self.axes[1].order.clone()]);
        let points = |plan: &ComponentPlan| {
            let [x, y] = region.clone().unwrap_or_else(|| [0, 1].map(|k| (0..plan.along(k)).collect()));
            // Nodes between levels are no entries.
            let level = if plan.own[2].is_some() { plan.along(2) / 2 } else { level };
            [x, y, vec![level.min(plan.along(2) - 1)]]
        };
        // What cannot be read is reported when it is needed.
        let Ok(zeros) = self.zeros(points) else { return };
        let Some(([nx, ny, _], zero)) = zeros.first() else { return };
        let corners = |cell: usize| [0, 1, *nx, nx + 1].map(|corner| cell / (nx - 1) * nx + cell % (nx - 1) + corner);
        let cells = nx.saturating_sub(1) * ny.saturating_sub(1);
        // Points without rows have no cells here.
        let (dead, of, at, which) = match ny {
            1 => (zero.iter().filter(|zero| **zero).count(), zero.len(), "", "points"),
            _ => ((0..cells).filter(|&cell| corners(cell).iter().all(|&i| zero[i])).count(), cells, "all corners of ", "cells"),
        };
        if dead > 0 {
            let share = 100.0 * dead as f64 / of as f64;
            self.description.notes.push(format!(
                "the velocity is exactly 0 at {at}{share:.1} % of the {which}{}, at all of {} times: is this land? Particles rest \
                 there; --set archive.mask=zero takes such nodes as missing, --set archive.mask=NAME names a mask, in these files or in one \
                 that is named beside them, --set archive.mask=none keeps them",
                if self.axes.len() > 2 { " of one level" } else { "" },
                sampled(self.times.len()).len()
            ));
        }
    }

    /// The files, in the order of their names in the arguments.
    pub fn files(&self) -> impl ExactSizeIterator<Item = &Path> {
        self.files.iter().map(|f| f.path.as_path())
    }

    /// The files that are read as one for the first of [`Self::files`].
    pub(super) fn first_group(&self) -> Option<&Group> {
        self.files.first().map(|file| &file.group)
    }

    /// Seconds of each snapshot since 1970-01-01 in the archive's calendar (or since the simulation's start), ascending. Equal to
    /// [`SnapshotSource::times`] except in the index metric.
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

    /// Axes of the files, before the index metric replaces them.
    pub(super) fn axis_plans(&self) -> &[AxisPlan] {
        &self.axes
    }

    /// Variable, component and reason of the choice.
    pub(super) fn chosen(&self) -> impl Iterator<Item = (&str, &'static str, &str)> {
        self.files[0].frames[0].iter().zip(COMPONENTS).map(|(c, role)| (c.name.as_str(), role, c.why.as_str()))
    }

    /// Measures one snapshot's velocities in SI and in cells per interval.
    pub(super) fn displacement(&mut self, index: usize) -> Result<Displacement, SourceError> {
        let raw = self.components(index)?;
        let mut cells = raw.clone();
        if !self.in_cells {
            VelocityScale::to_cells(&self.axes).apply(&mut cells, self.grid.shape(), self.interval(index));
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
            sum.max_cells = sum.max_cells.max(squared.sqrt());
        }
        Ok(sum)
    }

    /// Seconds that snapshot `index` represents: half the way to its neighbours on both sides.
    fn interval(&self, index: usize) -> f64 {
        let last = self.seconds.len() - 1;
        let (low, high) = (index.saturating_sub(1), (index + 1).min(last));
        if high > low { (self.seconds[high] - self.seconds[low]) / (high - low) as f64 } else { 1.0 }
    }

    /// Opens the file of a snapshot, which has changed since its times were read.
    ///
    /// # Errors
    /// The snapshot has another time there now.
    fn open_changed(&self, index: usize) -> Result<DataFile, SourceError> {
        let place = self.place(index)?;
        let group = &self.files[place.file].group;
        let (file, layout) = open_next(group, &self.settings, Some(&self.first), None, self.limits)?;
        let entry = layout.time.places.iter().position(|&found| found == (place.frame, place.entry));
        match entry.and_then(|entry| layout.time.seconds.get(entry)) {
            Some(&seconds) if seconds == self.seconds[index] => Ok(file),
            _ => Err(SourceError::file(&group[0], "its times changed since the archive was opened")),
        }
    }

    fn place(&self, index: usize) -> Result<Place, SourceError> {
        self.places.get(index).copied().ok_or(SourceError::NoSuchSnapshot { index, count: self.places.len() })
    }

    /// Opens the file of a snapshot and returns the place of the snapshot.
    fn open_at(&mut self, index: usize) -> Result<Place, SourceError> {
        let place = self.place(index)?;
        let open = match self.open.take() {
            Some(open) if open.index == place.file => open,
            other => {
                // Closed before the next file opens.
                drop(other);
                let ArchiveFile { path, group, frames, stamps: as_planned } = &self.files[place.file];
                let stamps = stamps(group);
                let file = match group.len() {
                    _ if stamps != *as_planned => self.open_changed(index)?,
                    1 => DataFile::open(path, self.expected.as_ref(), self.limits)?,
                    _ => open_group(group, self.limits)?,
                };
                for component in frames.iter().flatten() {
                    let shape = file.describe(&component.name).map(|d| d.dimensions.iter().map(|d| d.len).collect::<Vec<_>>());
                    // More times may have come.
                    let grown =
                        |(k, (now, then)): (usize, (&usize, &usize))| now == then || (component.roles[k] == Role::Time && now > then);
                    let fits =
                        |now: &Vec<usize>| now.len() == component.shape.len() && now.iter().zip(&component.shape).enumerate().all(grown);
                    if !shape.ok().as_ref().is_some_and(fits) {
                        return Err(file.listing.read_error(&component.name, "it changed since the archive was opened").into());
                    }
                }
                OpenFile { index: place.file, data: file, stamps }
            }
        };
        self.open = Some(open);
        Ok(place)
    }

    /// The components of a snapshot in SI (or unchanged, in cells), the third along the grid's third axis; x fastest; missing values
    /// are NaN. Files that are written to meanwhile are read again.
    fn components(&mut self, index: usize) -> Result<Vec<Vec<f32>>, SourceError> {
        let file = self.place(index)?.file;
        let group = self.files[file].group.clone();
        let [least, most] = PATIENCE;
        let patience = Duration::from_secs_f64(self.settings.follow.unwrap_or_default()).clamp(least, most);
        let begin = Instant::now();
        let mut is_told = false;
        loop {
            let before = match &self.open {
                Some(open) if open.index == file => open.stamps.clone(),
                _ => stamps(&group),
            };
            let read = self.components_once(index);
            // What is read during a write may be of two states of the file.
            let after = stamps(&group);
            let changed = group.iter().zip(before.iter().zip(&after)).find(|(_, (before, after))| before != after);
            let error = match (changed, read) {
                (Some((path, _)), Err(cause)) => SourceError::file(path, format!("it was written to while it was read ({cause})")),
                (Some((path, _)), Ok(_)) => SourceError::file(path, "it was written to while it was read"),
                (None, Err(error)) if error.is_locked() => error,
                (None, read) => return read,
            };
            self.open = None;
            if begin.elapsed() >= patience {
                return Err(error);
            }
            if !is_told && begin.elapsed() >= TELL {
                tracing::warn!("{error}; it is read again until it rests, for at most {} s", patience.as_secs());
                is_told = true;
            }
            std::thread::sleep(PAUSE);
        }
    }

    /// [`Self::components`], from files that stay as they are.
    fn components_once(&mut self, index: usize) -> Result<Vec<Vec<f32>>, SourceError> {
        let orders: Orders = std::array::from_fn(|k| self.axes.get(k).map_or_else(|| vec![0], |a| a.order.clone()));
        let resampling = self.resampling.clone();
        let place = self.open_at(index)?;
        let Some(OpenFile { data: file, .. }) = &self.open else { return Err(SourceError::NoFiles) };
        let plans = &self.files[place.file].frames[place.frame];
        let mut components = match resampling {
            Some(resampling) => resampling.read(file, plans, place.entry, &orders[2])?,
            None => plans.iter().map(|plan| read_levels(file, plan, &orders, place.entry)).collect::<Result<_, _>>()?,
        };
        // Values that are resampled or packed are not those of the file.
        if !std::mem::replace(&mut self.fills_sought, true) && self.resampling.is_none() {
            for ((values, plan), axis) in components.iter().zip(plans).zip(["x", "y", "z"]) {
                if let Some((fill, share)) = unnamed_fill(values).filter(|_| plan.packing.is_plain()) {
                    tracing::warn!(
                        "{}: the velocity along {axis} is {fill} at {:.1} % of the nodes, which looks like a fill value that the file does not name; \
                         archive.fill_value = {fill} takes it as missing",
                        self.files[place.file].path.display(),
                        100.0 * share
                    );
                }
            }
        }
        if let Some(ground_to_grid) = &self.ground_to_grid {
            ground_to_grid.apply(&mut components);
        }
        if !self.vertical.is_empty()
            && let Some(w) = components.get_mut(2)
        {
            let plane = w.len() / self.vertical.len();
            for (values, &factor) in w.chunks_exact_mut(plane).zip(&self.vertical) {
                values.iter_mut().for_each(|v| *v = (f64::from(*v) * factor) as f32);
            }
        }
        self.poles.extend(&mut components, self.axes[0].axis.coordinates(), self.axes[1].order.len());
        if self.settings.wants_continuity() {
            let scale_height = plans[0].of_air.then_some(SCALE_HEIGHT * self.settings.vertical_scale.unwrap_or(1.0));
            components.push(vertical_velocity(&self.grid, &components[0], &components[1], scale_height));
        }
        Ok(components)
    }

    /// Makes the grid that a mesh is resampled to fine enough, unless its resolution is set. Points on land have to be known.
    fn refine(&mut self, settings: &ArchiveSettings) -> Result<(), SourceError> {
        let Some(Resampling::Curvilinear(mesh)) = self.resampling.clone() else { return Ok(()) };
        let mut refined = mesh.clone();
        if settings.resolution.is_none() {
            let levels = self.axes.get(2).map_or(1, |axis| axis.order.len());
            // A snapshot while it is read, and a window, take half of the memory at most.
            let held = self.times.len().min(WINDOW) * size_of::<[f32; 4]>();
            let node = MESH_NODE_BYTES + (NODE_BYTES + held as u64) * levels as u64;
            let most = self.limits.memory / 2 / node;
            // A run may begin at rest.
            let mut truth = None;
            for time in [0, self.times.len() / 2, self.times.len() - 1] {
                let Place { file: index, frame, entry } = self.open_at(time)?;
                let Some(OpenFile { data: file, .. }) = &self.open else { return Err(SourceError::NoFiles) };
                let found = truth.insert(mesh.truth(file, &self.files[index].frames[frame], entry, false)?);
                self.measured_at = time;
                if found.moves() {
                    break;
                }
            }
            let Some(truth) = truth else { return Err(SourceError::NoFiles) };
            refined = mesh.refined(&truth, usize::try_from(most).unwrap_or(usize::MAX), levels);
        }
        self.description.notes.push(refined.what());
        if !Arc::ptr_eq(&mesh, &refined) {
            let path = &self.files[0].path;
            let fault = |fault| SourceError::file(path, fault);
            let [longitude, mut latitude] = refined.axes(settings.periodic.as_deref() != Some("none")).map_err(fault)?;
            self.poles = Poles::close(&longitude, &mut latitude).map_err(fault)?;
            (self.axes[0], self.axes[1]) = (longitude, latitude);
            self.grid = Arc::new(build_grid(path, &self.axes, self.metric, settings)?);
            self.resampling = Some(Resampling::Curvilinear(refined));
        }
        Ok(())
    }

    /// True if nodes of the grid are no points of a component.
    pub(super) fn is_interpolated(&self) -> bool {
        self.files[0].frames[0].iter().any(ComponentPlan::is_interpolated)
    }

    /// Description of the resampling, if any, and a warning if `error` is large.
    pub(super) fn resampled(&self, error: &ResamplingError) -> Option<(String, Option<String>)> {
        self.resampling.as_ref().map(|resampling| (resampling.what(), resampling.warning(error)))
    }

    /// Error of the resampling on the first snapshot that moves, if anything is resampled. See [`Resampling::error`].
    pub(super) fn resampling_error(&mut self) -> Result<Option<ResamplingError>, SourceError> {
        let Some(resampling) = self.resampling.clone() else { return Ok(None) };
        let Place { file: index, frame, entry } = self.open_at(self.measured_at)?;
        let Some(OpenFile { data: file, .. }) = &self.open else { return Err(SourceError::NoFiles) };
        resampling.error(file, &self.files[index].frames[frame], entry).map(Some)
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
        if let Some(scale) = &self.scale {
            let interval = if self.metric == Metric::Index { self.interval(index) } else { 1.0 };
            scale.apply(&mut components, self.grid.shape(), interval);
        }
        let w: &[f32] = components.get(2).map_or(&[], Vec::as_slice);
        Ok(Snapshot::from_components(self.times[index], self.grid.clone(), &components[0], &components[1], w))
    }

    fn look(&mut self) -> News {
        self.look_for_news()
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

    fn georeference(&self) -> Georeference {
        self.georeference.clone()
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
    pub(super) max_cells: f64,
}

impl Displacement {
    pub(super) fn add(&mut self, other: &Self) {
        self.known += other.known;
        self.missing += other.missing;
        self.squared_velocity.iter_mut().zip(other.squared_velocity).for_each(|(a, b)| *a += b);
        self.squared_cells += other.squared_cells;
        self.max_cells = self.max_cells.max(other.max_cells);
    }
}

/// The files in question: those given, else those of the settings, else a synthetic archive.
pub(super) fn files_of(paths: &[PathBuf], settings: &ArchiveSettings) -> Result<Vec<PathBuf>, SourceError> {
    let paths = if paths.is_empty() { &settings.files } else { paths };
    match &settings.synthetic {
        Some(synthetic) if paths.is_empty() => expand(&[synthesized(synthetic)?]),
        _ => expand(paths),
    }
}

/// Least and most time for which a file that is written to is read again.
const PATIENCE: [Duration; 2] = [Duration::from_secs(30), Duration::from_secs(300)];
/// Time after which the log tells of it.
const TELL: Duration = Duration::from_secs(5);
/// Time before a file is read again.
const PAUSE: Duration = Duration::from_millis(200);

/// Bytes of a node while a snapshot is read: a value of the file, in the library and converted; three components; the snapshot.
const NODE_BYTES: u64 = 2 * 8 + 3 * 4 + 16;

/// Bytes of a node of the grid that a mesh is resampled to: its places in three meshes, and east and north.
const MESH_NODE_BYTES: u64 = 3 * 12 + 2 * 12;
/// Most snapshots that a window is expected to hold when the grid of a mesh is chosen.
const WINDOW: usize = 64;

/// Compares what one snapshot needs with the memory that reading may need. The window is compared when a run is set up.
fn check_memory(path: &Path, layout: &Layout, limits: &Limits) -> Result<(), SourceError> {
    let on_grid = layout.axes.iter().fold(1u64, |n, axis| n.saturating_mul(axis.axis.len() as u64));
    // Columns and own coordinates are read whole, but for a region.
    let along = |c: &ComponentPlan, k: usize| match (&c.own[k], layout.axes.get(k)) {
        (Some(own), _) => own.points(),
        (None, Some(axis)) if k < 2 && layout.resampling.is_none() => axis.order.len(),
        _ => c.along(k),
    };
    let whole = |c: &ComponentPlan| [0, 1, 2].iter().fold(1u64, |n, &k| n.saturating_mul(along(c, k) as u64));
    let in_file = layout.frames[0].iter().filter(|c| c.is_interpolated()).map(whole).max().unwrap_or(0);
    let nodes = on_grid.max(in_file);
    let what = limits.check(nodes.saturating_mul(NODE_BYTES), &format!("snapshots of {nodes} nodes"));
    what.map_err(|what| SourceError::file(path, what))
}

/// Names of the files of a group.
fn in_words(group: &[PathBuf]) -> String {
    let names = group.iter().map(|path| path.file_name().map_or_else(|| path.display().to_string(), |n| n.to_string_lossy().into_owned()));
    names.collect::<Vec<_>>().join(", ")
}

/// Opens and plans the next group of an archive whose first file has the layout `first`.
pub(super) fn open_next(
    group: &[PathBuf],
    settings: &ArchiveSettings,
    first: Option<&Layout>,
    expected: Option<&Listing>,
    limits: Limits,
) -> Result<(DataFile, Layout), SourceError> {
    let [path] = group else {
        let file = open_group(group, limits)?;
        let layout = plan(&file, settings, first)?;
        return Ok((file, layout));
    };
    let mut file = DataFile::open(path, expected, limits)?;
    let mut planned = plan(&file, settings, first);
    let fits = planned.as_ref().is_ok_and(|layout| first.is_none_or(|first| difference(first, layout).is_none()));
    if expected.is_some() && !fits {
        // The part of the listing that suffices for the first file may not suffice for this one.
        file = DataFile::open(path, None, limits)?;
        planned = plan(&file, settings, first);
    }
    Ok((file, planned?))
}

/// Snapshots that are looked at to find nodes without motion.
const SAMPLED: usize = 3;

/// A few snapshots of `count`, evenly spread, ends included.
fn sampled(count: usize) -> Vec<usize> {
    let few = count.min(SAMPLED);
    (0..few).map(|k| if few > 1 { k * (count - 1) / (few - 1) } else { 0 }).collect()
}

/// True for a file without velocities that holds a mask of land.
fn is_mask_alone(path: &Path, settings: &ArchiveSettings, limits: Limits) -> bool {
    DataFile::open(path, None, limits).is_ok_and(|file| {
        let listing = &file.listing;
        let moves = |i: usize| judge(listing, i, settings.velocity_units()).is_ok();
        holds_mask(listing, settings) && !(0..listing.variables.len()).any(moves)
    })
}

fn check_duplicates(entries: &[(f64, Place)], files: &[ArchiveFile], calendar: Option<Calendar>) -> Result<(), SourceError> {
    let (Some(first), Some(last)) = (entries.first(), entries.last()) else { return Ok(()) };
    // Times in different units may differ in their last digits.
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

fn build_grid(path: &Path, axes: &[AxisPlan], metric: Metric, settings: &ArchiveSettings) -> Result<Grid, SourceError> {
    let index_axis = |plan: &AxisPlan| {
        let n = plan.axis.len();
        let axis = Axis::uniform(plan.axis.name(), "cells", 0.0, (n - 1) as f64, n).map_err(|fault| SourceError::file(path, fault))?;
        Ok(if plan.axis.period().is_some() { axis.with_period(n as f64) } else { axis })
    };
    let axes: Vec<Axis> = match metric {
        Metric::Index => axes.iter().map(index_axis).collect::<Result<_, SourceError>>()?,
        Metric::Sphere | Metric::Cartesian => axes.iter().map(|p| p.axis.clone()).collect(),
    };
    let slab = settings.slab.map_or_else(|| slab_of(&axes), |[low, high]| (low, high));
    let geometry = if metric == Metric::Sphere { Geometry::Sphere { radius: EARTH_RADIUS } } else { Geometry::Cartesian };
    Ok(Grid { axes, geometry, slab })
}

fn describe(layout: &Layout, format: Format, files: usize, seconds: &[f64]) -> SourceDescription {
    let variables = layout.frames[0].iter().zip(COMPONENTS).map(|(c, k)| format!("{k} = `{}`: {}", c.name, c.why)).collect();
    let mut notes = layout.notes.clone();
    if layout.time.units.trim().is_empty() && layout.metric != Metric::Index {
        notes.push(format!("`{}` has no unit: taken as seconds", layout.time.variable));
    }
    for gap in time_gaps(seconds) {
        let show = |s: f64| layout.time.calendar.and_then(|c| c.iso(s)).unwrap_or_else(|| s.to_string());
        let (after, before) = (show(gap.after), show(gap.before));
        notes.push(format!("gap in time between {after} and {before}: about {} snapshot(s) are missing", gap.missing));
    }
    SourceDescription {
        kind: format!("{}, {files} file(s)", format.name()),
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
