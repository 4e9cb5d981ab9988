//! One snapshot as a steady flow.

use crate::error::SourceError;
use crate::georeference::Georeference;
use crate::snapshots::{SnapshotSource, SourceDescription};
use ridgewatch_field::{Grid, Snapshot};
use std::sync::Arc;

/// A source of one snapshot that appears at two times: the flow does not change between them.
pub struct Steady {
    source: Box<dyn SnapshotSource>,
    times: [f64; 2],
}

impl Steady {
    /// Extends the one time of `source` over `tau`, which is negative for integration into the past.
    ///
    /// # Errors
    /// The source has more than one time.
    pub fn new(source: Box<dyn SnapshotSource>, tau: f64) -> Result<Self, SourceError> {
        let &[time] = source.times() else {
            let accepted = format!(
                "only an archive of one time is taken as steady; {} holds {}: name one file, and pick one of its times with --set \
                 archive.select.DIMENSION=ENTRY (from 0, of the dimension of the times)",
                source.name(),
                source.times().len()
            );
            return Err(SourceError::setting("steady", true, accepted));
        };
        Ok(Self { times: [time.min(time + tau), time.max(time + tau)], source })
    }
}

impl SnapshotSource for Steady {
    fn grid(&self) -> &Arc<Grid> {
        self.source.grid()
    }

    fn times(&self) -> &[f64] {
        &self.times
    }

    fn read(&mut self, index: usize) -> Result<Snapshot, SourceError> {
        let Some(&time) = self.times.get(index) else {
            return Err(SourceError::NoSuchSnapshot { index, count: self.times.len() });
        };
        let mut snapshot = self.source.read(0)?;
        snapshot.time = time;
        Ok(snapshot)
    }

    fn date(&self, time: f64) -> Option<String> {
        self.source.date(time)
    }

    fn georeference(&self) -> Georeference {
        self.source.georeference()
    }

    fn describe(&self) -> SourceDescription {
        let mut description = self.source.describe();
        description.notes.push("one snapshot, taken as a steady flow, as set".into());
        description
    }

    fn name(&self) -> String {
        self.source.name()
    }
}
