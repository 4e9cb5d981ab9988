//! Snapshots in time order: the trait of all sources, and properties of their times.

use super::archive_settings::Metric;
use super::error::SourceError;
use super::georeference::Georeference;
use ridgewatch_field::{Grid, Snapshot};
use serde::Serialize;
use std::sync::Arc;

/// Called with every snapshot as soon as it is read, on the reading thread. It should be quick.
pub type Listener = Box<dyn Fn(&Arc<Snapshot>) + Send + Sync>;

/// The next snapshot was not read within the time limit.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct StillReading;

/// Snapshots by index, in ascending time, all on one grid.
pub trait SnapshotSource: Send {
    /// The grid.
    fn grid(&self) -> &Arc<Grid>;

    /// Times of the snapshots, strictly ascending: seconds (since 1970-01-01 if there is a calendar), or snapshots counted from 0 in
    /// the index metric.
    fn times(&self) -> &[f64];

    /// Reads one snapshot.
    ///
    /// # Errors
    /// An index beyond the last snapshot; a file that was removed, changed or is damaged.
    fn read(&mut self, index: usize) -> Result<Snapshot, SourceError>;

    /// Looks for snapshots that have come since the source was opened, or since the last look; they follow the others.
    fn look(&mut self) -> News {
        News::default()
    }

    /// A time as a date (`2002-01-01T00:00:00Z`); `None` without a calendar.
    fn date(&self, _time: f64) -> Option<String> {
        None
    }

    /// Names and meaning of the coordinates; empty if they are in no file.
    fn georeference(&self) -> Georeference {
        Georeference::default()
    }

    /// Description for logs and summaries.
    fn describe(&self) -> SourceDescription;

    /// Name of the source in messages.
    fn name(&self) -> String {
        self.describe().kind
    }

    /// Longest |tau| that is taken by default: half the span of the archive, at least two intervals, or the span if that is shorter.
    ///
    /// # Errors
    /// Fewer than two times.
    fn longest_default_tau(&self) -> Result<f64, SourceError> {
        let (span, interval) = self.span_and_interval()?;
        let found = self.times().len();
        if found < 2 {
            return Err(self.too_short(interval, 2));
        }
        Ok((span / 2.0).max(2.0 * interval).min(span))
    }

    /// A time as a date or, without a calendar, as a number.
    fn show(&self, time: f64) -> String {
        self.date(time).unwrap_or_else(|| format!("{time} {}", self.describe().time_unit).trim_end().to_owned())
    }

    /// Checks that the snapshots cover an integration over `tau`.
    ///
    /// # Errors
    /// The snapshots do not cover it; the error says how many are needed and how many exist. `tau` is not a positive number.
    fn check_tau(&self, tau: f64) -> Result<(), SourceError> {
        if !(tau.is_finite() && tau > 0.0) {
            return Err(SourceError::setting("tau", tau, "a positive duration"));
        }
        let (span, interval) = self.span_and_interval()?;
        let found = self.times().len();
        // The same slack as in the window.
        if found >= 2 && span >= tau * (1.0 - 1e-9) {
            return Ok(());
        }
        let needed = if interval > 0.0 { ((tau / interval * (1.0 - 1e-9)).ceil() as usize).saturating_add(1) } else { 2 };
        Err(self.too_short(tau, needed.max(found + 1)))
    }

    /// The error about an archive that is shorter than `tau`, for which it needs so many snapshots.
    fn too_short(&self, tau: f64, needed: usize) -> SourceError {
        let (times, unit) = (self.times(), self.describe().time_unit);
        let [tau, interval, span] = [tau, median_interval(times), span(times)].map(|value| duration(value, &unit));
        SourceError::TooShort { source_name: self.name(), tau, needed, found: times.len(), interval, span }
    }

    /// Span of the times and their median interval.
    ///
    /// # Errors
    /// Only one time.
    fn span_and_interval(&self) -> Result<(f64, f64), SourceError> {
        match self.times() {
            [time] => Err(SourceError::OneTime { source_name: self.name(), time: self.show(*time) }),
            times => Ok((span(times), median_interval(times))),
        }
    }
}

/// A duration with its unit; seconds also in hours or days, if they are many.
pub fn duration(value: f64, unit: &str) -> String {
    const HOUR: f64 = 3600.0;
    const DAY: f64 = 24.0 * HOUR;
    match value {
        _ if unit != "s" || value < 2.0 * HOUR => format!("{value} {unit}").trim_end().to_owned(),
        _ if value < 2.0 * DAY => format!("{value} s ({:.1} hours)", value / HOUR),
        _ => format!("{value} s ({:.1} days)", value / DAY),
    }
}

/// What looks for further snapshots found.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct News {
    /// Times of the new snapshots, ascending, with their dates.
    pub dates: Vec<(f64, Option<String>)>,
    /// What was found and not taken, each said once.
    pub warnings: Vec<String>,
}

/// Description of a source, for logs and summaries.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct SourceDescription {
    /// Format and number of files, or the contents of the memory.
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
    /// Origin of synthetic data; `None` for measured or computed data.
    pub synthetic: Option<String>,
    /// Choices, conversions, gaps in time.
    pub notes: Vec<String>,
}

impl SourceDescription {
    /// One line; the origin of synthetic data goes first.
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

/// Largest number of snapshots that a window over `tau` holds: those inside, and one to interpolate from.
pub fn window_snapshots(times: &[f64], tau: f64) -> usize {
    let slack = 1e-9 * tau;
    let end = |i: usize| times.partition_point(|&t| t < times[i] + tau - slack);
    (0..times.len()).map(|i| (i, end(i))).filter(|&(_, j)| j < times.len()).map(|(i, j)| j - i + 1).max().unwrap_or(times.len())
}

/// Difference of the last and the first time; 0 without times.
pub fn span(times: &[f64]) -> f64 {
    times.last().zip(times.first()).map_or(0.0, |(last, first)| last - first)
}

/// Median of the intervals; 0 with fewer than two times.
pub fn median_interval(times: &[f64]) -> f64 {
    let mut intervals: Vec<f64> = times.windows(2).map(|w| w[1] - w[0]).collect();
    intervals.sort_by(f64::total_cmp);
    intervals.get(intervals.len() / 2).copied().unwrap_or(0.0)
}

#[cfg(test)]
mod tests {
    use super::window_snapshots;

    #[test]
    fn the_fullest_window_counts() {
        let even: Vec<f64> = (0..60).map(f64::from).collect();
        assert_eq!([29.5, 30.0, 59.0].map(|tau| window_snapshots(&even, tau)), [31, 31, 60]);
        // Hourly for two days, then daily.
        let uneven: Vec<f64> = (0..48).map(f64::from).chain((2..10).map(|d| f64::from(24 * d))).collect();
        assert_eq!(window_snapshots(&uneven, 48.0), 49);
    }
}
