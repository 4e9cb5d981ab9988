//! Where snapshots come from: NetCDF and HDF5 files, memory (closed forms sampled on a grid), or a simulation that runs now ([`live`]).
//!
//! In: settings and files. Out: snapshots in time order, read ahead by one I/O thread. Calls `field`.
//!
//! [`Archive`] and [`MemorySource`] are [`SnapshotSource`]s; [`read_ahead`] puts one on its thread; [`inspect`] tells what
//! would be read and why.

mod archive;
mod axes;
mod cf;
mod classic;
mod container;
mod conversion;
mod crash;
mod curvilinear;
mod dimensions;
mod error;
mod files;
mod hdf5_layout;
mod hdf5_store;
mod hyperslab;
mod inspect;
mod kinds;
mod layout;
mod libraries;
pub mod live;
mod locator;
mod memory;
mod nest;
mod netcdf4;
mod poles;
mod reader;
mod settings;
mod staggered;
mod steady;
mod synthetic;
mod times;
mod vertical;

pub use archive::Archive;
pub use axes::{FileOrder, InFile};
pub use crash::report_crashes;
pub use error::SourceError;
pub use inspect::{AxisReport, Inspection, MissingReport, ResamplingReport, ResolutionReport, TimeReport, VariableReport, inspect};
pub use kinds::{DomainSettings, SourceKind, SourceSettings};
pub use libraries::{hdf5_version, netcdf_version};
pub use memory::MemorySource;
pub use reader::{DEFAULT_READ_AHEAD, Listener, ReadAhead, StillReading, read_ahead};
pub use settings::{ArchiveSettings, Metric, Staggering, SyntheticSettings, SyntheticShape, VelocityUnit};
pub use steady::Steady;
pub use synthetic::{GlobeTurbulence, synthesize};

use crate::field::{Grid, Snapshot};
use serde::Serialize;
use std::sync::Arc;

/// Snapshots by index, in ascending time, all on one grid.
pub trait SnapshotSource: Send {
    /// The grid.
    fn grid(&self) -> &Arc<Grid>;

    /// Times of the snapshots, strictly ascending: seconds (since 1970-01-01 where there is a calendar), or snapshots counted from
    /// 0 in the index metric.
    fn times(&self) -> &[f64];

    /// Reads one snapshot.
    ///
    /// # Errors
    /// An index that is not there; a file that went away, changed or is damaged.
    fn read(&mut self, index: usize) -> Result<Snapshot, SourceError>;

    /// A time as a date (`2002-01-01T00:00:00Z`); none without a calendar.
    fn date(&self, time: f64) -> Option<String>;

    /// What it is, in words.
    fn describe(&self) -> SourceDescription;

    /// What messages call it.
    fn name(&self) -> String {
        self.describe().kind
    }

    /// |tau| where none is given: half the span of the archive, at least two intervals.
    ///
    /// # Errors
    /// Fewer than three snapshots.
    fn default_tau(&self) -> Result<f64, SourceError> {
        let times = self.times();
        if times.len() == 1 {
            return Err(SourceError::OneTime { source_name: self.name(), time: self.show(times[0]) });
        }
        let (span, interval) = (span(times), median_interval(times));
        let tau = (span / 2.0).max(2.0 * interval);
        if times.len() < 3 {
            return Err(SourceError::TooShort { source_name: self.name(), tau, needed: 3, found: times.len(), interval, span });
        }
        // Uneven steps: two median intervals may be longer than the archive.
        Ok(tau.min(span))
    }

    /// A time as a date or, where there is no calendar, as a number.
    fn show(&self, time: f64) -> String {
        self.date(time).unwrap_or_else(|| format!("{time} {}", self.describe().time_unit))
    }

    /// Whether the snapshots cover an integration over `tau`.
    ///
    /// # Errors
    /// They do not: the error says how many are needed and how many there are. Or `tau` is not a positive number.
    fn check_tau(&self, tau: f64) -> Result<(), SourceError> {
        let times = self.times();
        if !(tau.is_finite() && tau > 0.0) {
            return Err(SourceError::Setting { key: "tau", found: tau.to_string(), accepted: "a positive duration".into() });
        }
        if times.len() == 1 {
            return Err(SourceError::OneTime { source_name: self.name(), time: self.show(times[0]) });
        }
        let (span, interval) = (span(times), median_interval(times));
        // The window's slack.
        if times.len() >= 2 && span >= tau * (1.0 - 1e-9) {
            return Ok(());
        }
        let needed = if interval > 0.0 { ((tau / interval * (1.0 - 1e-9)).ceil() as usize).saturating_add(1) } else { 2 };
        let needed = needed.max(times.len() + 1);
        Err(SourceError::TooShort { source_name: self.name(), tau, needed, found: times.len(), interval, span })
    }
}

/// What a source is, in words, for logs and summaries.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct SourceDescription {
    /// Format and number of files, or what the memory holds.
    pub kind: String,
    /// Components and why they were chosen.
    pub variables: Vec<String>,
    /// Metric in force.
    pub metric: Metric,
    /// Unit of [`SnapshotSource::times`].
    pub time_unit: String,
    /// Time variable.
    pub time_variable: Option<String>,
    /// Its `units`.
    pub time_units_in_file: Option<String>,
    /// Calendar of the dates.
    pub calendar: Option<String>,
    /// What was made up, and from what; none for data that somebody measured or computed.
    pub synthetic: Option<String>,
    /// Choices, conversions, gaps in time.
    pub notes: Vec<String>,
}

impl SourceDescription {
    /// In one line, what is synthetic first.
    pub fn line(&self) -> String {
        self.synthetic.as_ref().map_or_else(|| self.kind.clone(), |synthetic| format!("{synthetic}; {}", self.kind))
    }
}

/// An interval that is longer than the others.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct TimeGap {
    /// Time of the snapshot before it.
    pub after: f64,
    /// Time of the snapshot behind it.
    pub before: f64,
    /// Snapshots that would fit in at the median interval.
    pub missing: usize,
}

/// Intervals of more than one and a half times the median.
pub fn time_gaps(times: &[f64]) -> Vec<TimeGap> {
    let median = median_interval(times);
    let gap = |w: &[f64]| {
        let steps = (w[1] - w[0]) / median;
        (steps > 1.5).then(|| TimeGap { after: w[0], before: w[1], missing: (steps.round() as usize).saturating_sub(1) })
    };
    if median > 0.0 { times.windows(2).filter_map(gap).collect() } else { Vec::new() }
}

/// Most snapshots that a window over `tau` holds: those inside, and one to interpolate from.
pub fn window_snapshots(times: &[f64], tau: f64) -> usize {
    let slack = 1e-9 * tau;
    let end = |i: usize| times.partition_point(|&t| t < times[i] + tau - slack);
    (0..times.len()).map(|i| (i, end(i))).filter(|&(_, j)| j < times.len()).map(|(i, j)| j - i + 1).max().unwrap_or(times.len())
}

fn span(times: &[f64]) -> f64 {
    times.last().zip(times.first()).map_or(0.0, |(last, first)| last - first)
}

/// A flow in a plane is drawn as a slab: from 0 to a tenth of its longer edge.
fn slab_of(axes: &[crate::field::Axis]) -> (f64, f64) {
    let edge = axes[..2].iter().map(|a| a.last() - a.first()).fold(0.0, f64::max);
    (0.0, edge / 10.0)
}

/// Median of the intervals; 0 with fewer than two times.
fn median_interval(times: &[f64]) -> f64 {
    let mut intervals: Vec<f64> = times.windows(2).map(|w| w[1] - w[0]).collect();
    intervals.sort_by(f64::total_cmp);
    intervals.get(intervals.len() / 2).copied().unwrap_or(0.0)
}
