//! Snapshots that are computed or held in memory.

use crate::archive_settings::Metric;
use crate::error::SourceError;
use crate::snapshots::{SnapshotSource, SourceDescription};
use ridgewatch_field::{Geometry, Grid, Snapshot};
use std::sync::Arc;

/// A source whose snapshots come from a function of their index and time: closed forms sampled on a grid, tests, arrays.
pub struct MemorySource {
    grid: Arc<Grid>,
    times: Vec<f64>,
    make: Box<dyn FnMut(usize, f64) -> Snapshot + Send>,
    description: SourceDescription,
}

impl MemorySource {
    /// `make(index, time)` is called on the reading thread for each read, and must return a snapshot on `grid`. `kind` describes the
    /// source.
    ///
    /// # Errors
    /// Times that are not finite or do not ascend strictly, or no time at all.
    pub fn new(
        kind: impl Into<String>,
        grid: Arc<Grid>,
        times: Vec<f64>,
        make: impl FnMut(usize, f64) -> Snapshot + Send + 'static,
    ) -> Result<Self, SourceError> {
        let odd = times.iter().position(|t| !t.is_finite()).or_else(|| (1..times.len()).find(|&i| times[i] <= times[i - 1]));
        if let Some(i) = odd {
            return Err(SourceError::Inconsistent(format!("time {i} is {}: times must be finite and ascend", times[i])));
        }
        if times.is_empty() {
            return Err(SourceError::Inconsistent("a source needs at least one snapshot".into()));
        }
        let description = SourceDescription {
            kind: kind.into(),
            variables: Vec::new(),
            metric: if matches!(grid.geometry, Geometry::Sphere { .. }) { Metric::Sphere } else { Metric::Cartesian },
            time_unit: String::new(),
            time_variable: None,
            time_units_in_file: None,
            calendar: None,
            synthetic: None,
            notes: Vec::new(),
        };
        Ok(Self { grid, times, make: Box::new(make), description })
    }

    /// Marks the data as synthetic; `what` says how they are made.
    pub fn synthetic(mut self, what: String) -> Self {
        self.description.synthetic = Some(what);
        self
    }

    /// A source of finished snapshots, all on one grid, in ascending time.
    ///
    /// # Errors
    /// No snapshot, different grids, times that do not ascend.
    pub fn from_snapshots(kind: impl Into<String>, snapshots: Vec<Snapshot>) -> Result<Self, SourceError> {
        let Some(first) = snapshots.first() else {
            return Err(SourceError::Inconsistent("a source needs at least one snapshot".into()));
        };
        let grid = first.grid.clone();
        if let Some(i) = snapshots.iter().position(|s| *s.grid != *grid) {
            return Err(SourceError::Inconsistent(format!("snapshot {i} is on another grid than snapshot 0")));
        }
        let times = snapshots.iter().map(|s| s.time).collect();
        Self::new(kind, grid, times, move |i, _| snapshots[i].clone())
    }
}

impl SnapshotSource for MemorySource {
    fn grid(&self) -> &Arc<Grid> {
        &self.grid
    }

    fn times(&self) -> &[f64] {
        &self.times
    }

    fn read(&mut self, index: usize) -> Result<Snapshot, SourceError> {
        let Some(&time) = self.times.get(index) else {
            return Err(SourceError::NoSuchSnapshot { index, count: self.times.len() });
        };
        let snapshot = (self.make)(index, time);
        if snapshot.nodes.len() != self.grid.nodes() || snapshot.time != time {
            let (nodes, wanted) = (snapshot.nodes.len(), self.grid.nodes());
            let what = format!("snapshot {index} has {nodes} nodes at time {}, not {wanted} at {time}", snapshot.time);
            return Err(SourceError::Inconsistent(what));
        }
        Ok(snapshot)
    }

    fn describe(&self) -> SourceDescription {
        self.description.clone()
    }
}
