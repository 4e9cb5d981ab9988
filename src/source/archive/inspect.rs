//! Inspection of an archive: what would be read from it, and why.

use super::archive::{Archive, Displacement, files_of};
use super::check::check;
use super::every::Every;
use super::group::open_group;
use super::limits;
use crate::archive_settings::ArchiveSettings;
use crate::cf::velocity;
use crate::error::SourceError;
use crate::formats::{DataFile, Listing};
use crate::grids::{AxisPlan, InFile, Quantity, ResamplingError, readable_axes};
use crate::snapshots::{SnapshotSource, SourceDescription, TimeGap, median_interval, span, time_gaps, window_snapshots};
use ridgewatch_base::setting::{Refused, word};
use serde::Serialize;
use std::fmt;
use std::path::PathBuf;

/// Snapshots that are read to measure displacements and missing values.
const SAMPLED: usize = 5;

/// Output of `ridgewatch inspect`.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Inspection {
    /// The first file.
    pub file: PathBuf,
    /// Number of files.
    pub files: usize,
    /// Format of the first file.
    pub format: String,
    /// All variables of the first file.
    pub variables: Vec<VariableReport>,
    /// Why the files cannot be read as an archive. All later fields except `axes` are empty then.
    pub problem: Option<String>,
    /// The setting at fault, if the problem is a setting.
    #[serde(skip)]
    pub refused: Option<Refused>,
    /// Description of the source.
    pub source: Option<SourceDescription>,
    /// Axes of the grid, or the axes of the first file if it cannot be read as an archive.
    pub axes: Vec<AxisReport>,
    /// Times.
    pub time: Option<TimeReport>,
    /// Resampling to other longitudes and latitudes, or of WRF output.
    pub resampling: Option<ResamplingReport>,
    /// True if a component is interpolated from its own points along an axis, or between levels that follow the bottom.
    pub interpolated: bool,
    /// Missing values.
    pub missing: Option<MissingReport>,
    /// Resolution in time.
    pub resolution: Option<ResolutionReport>,
}

/// A variable and its role.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct VariableReport {
    /// Name.
    pub name: String,
    /// External type, e.g. `int16`.
    pub number: String,
    /// Dimensions, slowest first, with their lengths.
    pub dimensions: Vec<(String, usize)>,
    /// Units in the file.
    pub units: Option<String>,
    /// `u`, `v`, `w`, `x`, `y`, `z` or `time`; `None` if it is not used.
    pub role: Option<String>,
    /// Why it has this role, or what it lacks.
    pub why: String,
}

/// An axis.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct AxisReport {
    /// `x`, `y` or `z`.
    pub role: String,
    /// Name in the file.
    pub name: String,
    /// Units (after conversion to degrees, metres or pascal).
    pub units: String,
    /// Nodes read.
    pub nodes: usize,
    /// First coordinate, ascending.
    pub first: f64,
    /// Last coordinate.
    pub last: f64,
    /// Minimum distance between neighbours.
    pub least_spacing: f64,
    /// Greatest distance between neighbours.
    pub greatest_spacing: f64,
    /// The coordinates in the file; `None` if the axis is made (resampled, or counted by settings).
    pub in_file: Option<InFile>,
    /// Period of a periodic axis.
    pub period: Option<f64>,
}

/// Times of the archive.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct TimeReport {
    /// Number of snapshots.
    pub snapshots: usize,
    /// First time, as a date if there is a calendar.
    pub first: String,
    /// Last time.
    pub last: String,
    /// Median interval, in `unit`.
    pub interval: f64,
    /// Unit of times.
    pub unit: String,
    /// Intervals longer than one and a half times the median.
    pub gaps: Vec<TimeGap>,
    /// |tau| for which the memory is stated: the requested one, or the longest that is taken by default.
    pub tau: Option<f64>,
    /// True if it was requested.
    pub tau_is_given: bool,
    /// Number of snapshots in a window of this tau.
    pub window_snapshots: Option<usize>,
    /// Its memory in bytes.
    pub window_bytes: Option<usize>,
    /// Why tau does not fit the archive.
    pub tau_problem: Option<String>,
}

/// Resampling and its error on the first snapshot.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ResamplingReport {
    /// Description.
    pub what: String,
    /// Root mean square of the interpolation on the new grid minus the file's velocity, at the file's own points, in m/s.
    pub error: f64,
    /// Root mean square of the interpolation on the new grid minus interpolation in the mesh, between the file's points, in m/s. `None` if the
    /// file has no mesh of longitudes and latitudes.
    pub error_between: Option<f64>,
    /// Root mean square of the file's velocity, in m/s.
    pub velocity: f64,
    /// A warning if the error is large, and what to write.
    pub warning: Option<String>,
}

/// Missing values, measured on a few snapshots.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct MissingReport {
    /// Snapshots that were read.
    pub sampled: usize,
    /// Share of nodes without a velocity, in [0, 1].
    pub share: f64,
}

/// Displacement between two snapshots, measured on a few of them.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ResolutionReport {
    /// Root mean square of the displacement in one interval, in cells of the grid (after resampling).
    pub rms_cells: f64,
    /// Greatest displacement in one interval, in cells.
    pub max_cells: f64,
    /// Root mean square of each component in SI.
    pub rms_velocity: Vec<f64>,
    /// A warning if particles cross many cells between two snapshots.
    pub warning: Option<String>,
}

/// Inspects an archive of which every `every`-th snapshot is read (1: all). If the first file's header can be read, other errors become
/// [`Inspection::problem`].
///
/// # Errors
/// No file; a first file that is missing, damaged or of another format.
pub fn inspect(paths: &[PathBuf], settings: &ArchiveSettings, every: usize, tau: Option<f64>) -> Result<Inspection, SourceError> {
    let files = files_of(paths, settings)?;
    let Some(file) = files.first().cloned() else { return Err(SourceError::NoFiles) };
    check(settings)?;
    let first = DataFile::open(&file, None, limits(settings))?;
    let mut inspection = Inspection {
        file,
        files: files.len(),
        format: first.listing.format.name().into(),
        variables: variables(&first.listing, settings),
        problem: None,
        refused: None,
        source: None,
        axes: Vec::new(),
        time: None,
        resampling: None,
        interpolated: false,
        missing: None,
        resolution: None,
    };
    match Archive::open_files(files, settings) {
        Ok(archive) => {
            if let Some(group) = archive.first_group().filter(|group| **group != [inspection.file.clone()]) {
                inspection.variables = variables(&open_group(group, limits(settings))?.listing, settings);
            }
            inspection.fill(archive, settings.steady, every.max(1), tau)?;
        }
        Err(error) => {
            (inspection.problem, inspection.refused) = (Some(error.to_string()), error.refused());
            inspection.axes = readable_axes(&first, settings).iter().map(|(role, plan)| AxisReport::of(plan, role)).collect();
        }
    }
    Ok(inspection)
}

impl AxisReport {
    fn of(plan: &AxisPlan, role: &str) -> Self {
        let steps: Vec<f64> = plan.axis.coordinates().windows(2).map(|w| w[1] - w[0]).collect();
        Self {
            role: role.into(),
            name: plan.axis.name().into(),
            units: if plan.quantity == Quantity::None { "no unit".into() } else { plan.axis.units().into() },
            nodes: plan.axis.len(),
            first: plan.axis.coordinates()[0],
            last: plan.axis.coordinates()[plan.axis.len() - 1],
            least_spacing: steps.iter().copied().fold(f64::INFINITY, f64::min),
            greatest_spacing: steps.iter().copied().fold(0.0, f64::max),
            in_file: plan.in_file.clone(),
            period: plan.axis.period(),
        }
    }
}

fn variables(listing: &Listing, settings: &ArchiveSettings) -> Vec<VariableReport> {
    let report = |i: usize| {
        let variable = &listing.variables[i];
        VariableReport {
            name: variable.name.clone(),
            number: word(variable.number),
            dimensions: variable.dimensions.iter().map(|&d| (listing.dimensions[d].name.clone(), listing.dimensions[d].len)).collect(),
            units: variable.units().map(str::to_owned),
            role: None,
            why: match velocity::judge(listing, i, settings.velocity_units()) {
                Ok(candidate) => format!("may be {}: {}", candidate.component.name(), candidate.why),
                Err(lacks) => lacks,
            },
        }
    };
    (0..listing.variables.len()).map(report).collect()
}

impl Inspection {
    fn fill(&mut self, mut archive: Archive, steady: bool, every: usize, tau: Option<f64>) -> Result<(), SourceError> {
        let description = archive.describe();
        let mut give = |name: &str, role: &str, why: String| {
            if let Some(variable) = self.variables.iter_mut().find(|v| v.name == name) {
                (variable.role, variable.why) = (Some(role.into()), why);
            }
        };
        for (name, role, why) in archive.chosen() {
            give(name, role, why.to_owned());
        }
        if let Some(time) = &description.time_variable {
            give(time, "time", format!("times, in `{}`", description.time_units_in_file.as_deref().unwrap_or_default()));
        }
        for (plan, role) in archive.axis_plans().iter().zip(["x", "y", "z"]) {
            give(plan.axis.name(), role, format!("coordinates of {role}"));
            self.axes.push(AxisReport::of(plan, role));
        }
        let error = archive.resampling_error()?;
        self.interpolated = archive.is_interpolated();
        self.resampling = error.and_then(|error| {
            let (what, warning) = archive.resampled(&error)?;
            let ResamplingError { at_points, between, velocity } = error;
            Some(ResamplingReport { what, error: at_points, error_between: between, velocity, warning })
        });
        let count = archive.times().len().div_ceil(every);
        let sampled = count.min(SAMPLED);
        let mut sum = Displacement::default();
        for k in 0..sampled {
            // Evenly over the archive, ends included.
            sum.add(&archive.displacement(if sampled > 1 { k * (count - 1) / (sampled - 1) * every } else { 0 })?);
        }
        self.missing = Some(MissingReport { sampled, share: sum.missing as f64 / (sum.missing + sum.known).max(1) as f64 });
        if sum.known > 0 && count > 1 {
            let mean = |s: f64| (s / sum.known as f64).sqrt();
            // In an interval of those that are read.
            let rms_cells = every as f64 * mean(sum.squared_cells);
            self.resolution = Some(ResolutionReport {
                rms_cells,
                max_cells: every as f64 * sum.max_cells,
                rms_velocity: sum.squared_velocity.iter().take(archive.grid().dimensions()).map(|&s| mean(s)).collect(),
                warning: (rms_cells > 4.0).then(|| {
                    format!("particles cross {rms_cells:.1} cells between snapshots (root mean square): too coarse in time for linear interpolation")
                }),
            });
        }
        let gaps = time_gaps(&archive.seconds.iter().copied().step_by(every).collect::<Vec<_>>());
        let source = Every::new(Box::new(archive), every);
        self.time = Some(times(&source, gaps, steady, tau));
        self.source = Some(source.describe());
        Ok(())
    }
}

impl Inspection {
    /// The table of variables: of a refused file without those that are no fields.
    fn variables(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f, "\nvariables")?;
        let width = self.variables.iter().map(|v| v.name.chars().count()).max().unwrap_or(0);
        let (used, mut unused): (Vec<_>, Vec<_>) = self.variables.iter().partition(|v| v.role.is_some());
        let all = unused.len();
        if self.problem.is_some() {
            unused.retain(|v| v.dimensions.len() > 1);
        }
        let left_out = all - unused.len();
        for v in used.into_iter().chain(unused) {
            let dims: Vec<String> = v.dimensions.iter().map(|(n, l)| format!("{n} {l}")).collect();
            let role = v.role.as_deref().unwrap_or("-");
            writeln!(f, "  {role:<4} {:width$}  {} ({}): {}", v.name, v.number, dims.join(", "), v.why)?;
        }
        if left_out > 0 {
            writeln!(f, "  and {left_out} variables of fewer than two dimensions")?;
        }
        Ok(())
    }
}

fn times(source: &dyn SnapshotSource, gaps: Vec<TimeGap>, steady: bool, tau: Option<f64>) -> TimeReport {
    let (times, unit) = (source.times(), source.describe().time_unit);
    let show = |t: f64| source.date(t).unwrap_or_else(|| format!("{t} {unit}"));
    let interval = median_interval(times);
    let steady = steady && times.len() == 1;
    let tau_is_given = tau.is_some();
    let tau = match tau {
        Some(tau) if steady => Ok(tau),
        Some(tau) => source.check_tau(tau).map(|()| tau),
        None if steady => Err(SourceError::setting("tau", "missing", "a duration, since a steady flow has no default")),
        None => source.longest_default_tau(),
    };
    // A steady flow counts twice (see [`super::steady::Steady`]).
    let snapshots = tau.as_ref().ok().map(|&t| if steady { 2 } else { window_snapshots(times, t) });
    TimeReport {
        snapshots: times.len(),
        first: show(times[0]),
        last: show(times[0] + span(times)),
        interval,
        unit,
        gaps,
        window_snapshots: snapshots,
        window_bytes: snapshots.map(|s| s * source.grid().nodes() * size_of::<[f32; 4]>()),
        tau_problem: tau.as_ref().err().map(ToString::to_string),
        tau: tau.ok(),
        tau_is_given,
    }
}

impl fmt::Display for Inspection {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let more = if self.files > 1 { format!(" and {} more", self.files - 1) } else { String::new() };
        writeln!(f, "{}{more} ({})", self.file.display(), self.format)?;
        if let Some(problem) = &self.problem {
            writeln!(f, "\ncannot be read as an archive:\n{problem}")?;
        }
        // Candidates are a part of the reason.
        let lists = self.problem.as_ref().is_some_and(|problem| problem.contains('\n'));
        if !lists {
            self.variables(f)?;
        }
        if let Some(source) = &self.source {
            writeln!(f, "\nmetric {}", word(source.metric))?;
        }
        if !self.axes.is_empty() {
            writeln!(f, "\naxes")?;
        }
        for axis in &self.axes {
            let (first, last) = (Short(axis.first), Short(axis.last));
            write!(f, "  {} `{}`: {} nodes from {first} to {last} {}", axis.role, axis.name, axis.nodes, axis.units)?;
            if axis.greatest_spacing - axis.least_spacing <= 1e-5 * axis.greatest_spacing {
                write!(f, ", every {}", Short(axis.greatest_spacing))?;
            } else {
                write!(f, ", spacing {} to {}", Short(axis.least_spacing), Short(axis.greatest_spacing))?;
            }
            let period = axis.period.map(|p| format!(", periodic with {p}")).unwrap_or_default();
            match &axis.in_file {
                Some(InFile { first, last, units, order }) => {
                    writeln!(f, "{period}; in the file {} to {} {units}, {}", Short(*first), Short(*last), word(order))?;
                }
                None => writeln!(f, "{period}; made, ascending")?,
            }
        }
        if self.problem.is_some() {
            return Ok(());
        }
        if let Some(t) = &self.time {
            if t.snapshots == 1 {
                writeln!(f, "\ntime\n  one snapshot, {}", t.first)?;
            } else {
                writeln!(f, "\ntime\n  {} snapshots from {} to {}, every {} {}", t.snapshots, t.first, t.last, Short(t.interval), t.unit)?;
            }
            let calendar = self.source.as_ref().and_then(|s| s.calendar.as_deref()).unwrap_or("none");
            writeln!(f, "  calendar {calendar}, {} gap(s)", t.gaps.len())?;
            if let (Some(tau), Some(held), Some(bytes)) = (t.tau, t.window_snapshots, t.window_bytes) {
                let most = if t.tau_is_given { "" } else { "at most " };
                writeln!(
                    f,
                    "  tau {most}{} {}: a window of {held} snapshots, {:.1} MiB",
                    Short(tau),
                    t.unit,
                    bytes as f64 / f64::from(1 << 20)
                )?;
            }
            if let Some(problem) = &t.tau_problem {
                writeln!(f, "  {problem}")?;
            }
        }
        match &self.resampling {
            Some(r) => {
                let share = |error: f64| 100.0 * error / r.velocity.max(f64::MIN_POSITIVE);
                let (error, velocity) = (Short(r.error), Short(r.velocity));
                write!(
                    f,
                    "\nresampling\n  error {error} m/s of {velocity} m/s ({:.2} %), root mean square at the file's own points",
                    share(r.error)
                )?;
                if let Some(between) = r.error_between {
                    write!(f, "; {} m/s ({:.2} %) between them, against interpolation in the mesh", Short(between), share(between))?;
                }
                writeln!(f, "\n  {}", r.what)?;
                r.warning.iter().try_for_each(|warning| writeln!(f, "  {warning}"))?;
            }
            None if self.interpolated => writeln!(f, "\nresampling\n  each component is interpolated from its own points: see the notes")?,
            None => writeln!(f, "\nresampling\n  none: nodes are the file's own")?,
        }
        if let Some(m) = &self.missing {
            writeln!(f, "\nvelocity (measured on {} snapshots)\n  missing {:.1} %", m.sampled, 100.0 * m.share)?;
        }
        if let Some(r) = &self.resolution {
            let rms: Vec<String> = r.rms_velocity.iter().map(|v| Short(*v).to_string()).collect();
            writeln!(f, "  root mean square of the components {}", rms.join(", "))?;
            let of = if self.resampling.is_some() { " of the grid that it is resampled to" } else { "" };
            writeln!(f, "  displacement in one interval: {:.2} cells{of} (root mean square), {:.2} at most", r.rms_cells, r.max_cells)?;
            if let Some(warning) = &r.warning {
                writeln!(f, "  {warning}")?;
            }
        }
        let notes = self.source.as_ref().map_or(&[][..], |s| &s.notes);
        if !notes.is_empty() {
            writeln!(f, "\nnotes")?;
        }
        notes.iter().try_for_each(|note| writeln!(f, "  {note}"))
    }
}

/// A number with six significant digits at most.
struct Short(f64);

impl fmt::Display for Short {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let v = self.0;
        if v == 0.0 || (1e-3..1e7).contains(&v.abs()) {
            let digits = if v == 0.0 { 0 } else { (5 - v.abs().log10().floor() as i32).max(0) as usize };
            let text = format!("{v:.digits$}");
            f.write_str(if text.contains('.') { text.trim_end_matches('0').trim_end_matches('.') } else { &text })
        } else {
            write!(f, "{v:.4e}")
        }
    }
}

#[cfg(test)]
mod tests {
    use super::Short;

    #[test]
    fn numbers_are_short() {
        for (value, text) in
            [(0.0, "0"), (0.25, "0.25"), (86_400.0, "86400"), (-40.125, "-40.125"), (1.0 / 3.0, "0.333333"), (2.5e-7, "2.5000e-7")]
        {
            assert_eq!(Short(value).to_string(), text);
        }
    }
}
