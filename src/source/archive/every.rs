//! Every n-th snapshot of a source.

use crate::error::SourceError;
use crate::georeference::Georeference;
use crate::snapshots::{News, SnapshotSource, SourceDescription};
use ridgewatch_field::{Grid, Snapshot};
use std::sync::Arc;

/// A source of which every n-th snapshot is read, from the first one on. Times, and with them tau and velocities, keep their unit.
pub struct Every {
    source: Box<dyn SnapshotSource>,
    every: usize,
    times: Vec<f64>,
}

impl Every {
    /// Reads every `every`-th snapshot of `source`; with 1, all of them.
    pub fn new(source: Box<dyn SnapshotSource>, every: usize) -> Self {
        let every = every.max(1);
        Self { times: source.times().iter().copied().step_by(every).collect(), source, every }
    }
}

impl SnapshotSource for Every {
    fn grid(&self) -> &Arc<Grid> {
        self.source.grid()
    }

    fn times(&self) -> &[f64] {
        &self.times
    }

    fn read(&mut self, index: usize) -> Result<Snapshot, SourceError> {
        if index >= self.times.len() {
            return Err(SourceError::NoSuchSnapshot { index, count: self.times.len() });
        }
        self.source.read(index * self.every)
    }

    fn look(&mut self) -> News {
        let mut numbers = self.source.times().len()..;
        let mut news = self.source.look();
        news.dates.retain(|_| numbers.next().is_some_and(|number| number.is_multiple_of(self.every)));
        self.times.extend(news.dates.iter().map(|(time, _)| *time));
        news
    }

    fn date(&self, time: f64) -> Option<String> {
        self.source.date(time)
    }

    fn georeference(&self) -> Georeference {
        self.source.georeference()
    }

    fn describe(&self) -> SourceDescription {
        let mut description = self.source.describe();
        if self.every > 1 {
            let (read, all) = (self.times.len(), self.source.times().len());
            description.notes.push(format!("{read} of {all} snapshots are read, as set (time.every = {})", self.every));
        }
        description
    }

    fn name(&self) -> String {
        let name = self.source.name();
        if self.every > 1 { format!("{name} (time.every = {})", self.every) } else { name }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::archive::memory::MemorySource;
    use ridgewatch_field::{Axis, Geometry};

    /// Snapshots at the times 0, 1, 2 and so on, of which `known` are there at first.
    struct Growing {
        all: MemorySource,
        times: Vec<f64>,
    }

    impl Growing {
        fn new(count: usize, known: usize) -> Self {
            let axis = |name| Axis::uniform(name, "m", 0.0, 1.0, 2).unwrap();
            let grid = Arc::new(Grid { axes: vec![axis("x"), axis("y")], geometry: Geometry::Cartesian, slab: (0.0, 1.0) });
            let on = grid.clone();
            let make = move |_, time: f64| Snapshot::from_components(time, on.clone(), &[0.0; 4], &[0.0; 4], &[]);
            let times: Vec<f64> = (0..count).map(|i| i as f64).collect();
            let all = MemorySource::new("test", grid, times.clone(), make).unwrap();
            Self { all, times: times[..known].to_vec() }
        }
    }

    impl SnapshotSource for Growing {
        fn grid(&self) -> &Arc<Grid> {
            self.all.grid()
        }
        fn times(&self) -> &[f64] {
            &self.times
        }
        fn read(&mut self, index: usize) -> Result<Snapshot, SourceError> {
            self.all.read(index)
        }
        // Two more at each look.
        fn look(&mut self) -> News {
            let (known, all) = (self.times.len(), self.all.times());
            let new = all[known..(known + 2).min(all.len())].to_vec();
            self.times.extend(&new);
            News { dates: new.into_iter().map(|time| (time, None)).collect(), warnings: Vec::new() }
        }
        fn describe(&self) -> SourceDescription {
            self.all.describe()
        }
    }

    #[test]
    fn every_third_snapshot_is_read_of_those_that_are_there_and_of_those_that_come() {
        for (known, read) in [(1, 1), (3, 1), (4, 2), (6, 2), (7, 3)] {
            let mut source = Every::new(Box::new(Growing::new(9, known)), 3);
            assert_eq!(source.times().len(), read, "of {known}");
            while source.source.times().len() < 9 {
                let before = source.times().len();
                let news = source.look();
                assert_eq!(news.dates.iter().map(|(time, _)| *time).collect::<Vec<_>>(), source.times()[before..]);
            }
            assert_eq!(source.times(), [0.0, 3.0, 6.0]);
            assert_eq!((0..3).map(|index| source.read(index).unwrap().time).collect::<Vec<_>>(), source.times());
            assert!(matches!(source.read(3), Err(SourceError::NoSuchSnapshot { index: 3, count: 3 })));
        }
    }

    #[test]
    fn errors_and_notes_name_the_key_unless_all_are_read() {
        let source = |every| Every::new(Box::new(Growing::new(9, 9)), every);
        assert!(source(1).check_tau(8.0).is_ok() && source(2).check_tau(8.0).is_ok());
        let error = source(3).check_tau(8.0).unwrap_err().to_string();
        assert!(error.contains("needs 4 snapshots 3 apart, but test (time.every = 3) has 3"), "{error}");
        let error = source(9).check_tau(8.0).unwrap_err().to_string();
        assert!(error.contains("test (time.every = 9) holds one time"), "{error}");
        assert_eq!(source(4).describe().notes, ["3 of 9 snapshots are read, as set (time.every = 4)"]);
        assert!(source(1).describe().notes.is_empty() && source(1).name() == "test");
    }
}
