//! Conversion of a step's components to a snapshot, by a few threads and in reused memory.

use crate::error::SourceError;
use ridgewatch_field::{Grid, Snapshot};
use std::sync::Arc;
use std::sync::mpsc::{RecvTimeoutError, sync_channel};
use std::time::Duration;

/// Interval between heartbeats while the pool works.
const BEAT_INTERVAL: Duration = Duration::from_millis(100);

/// Largest number of converting threads: enough to saturate the memory bandwidth.
const MAX_THREADS: usize = 4;

/// Makes snapshots. The memory of a released snapshot is reused, so that a steady run allocates none.
pub(super) struct Conversion {
    grid: Arc<Grid>,
    pool: rayon::ThreadPool,
    /// Snapshots that may still be in use.
    made: Vec<Arc<Snapshot>>,
    spare: Option<Vec<[f32; 4]>>,
}

impl Conversion {
    /// For snapshots on `grid`. Uses a quarter of the process's threads, at most [`MAX_THREADS`]; the others make frames.
    ///
    /// # Errors
    /// The threads cannot be started.
    pub fn new(grid: Arc<Grid>) -> Result<Self, SourceError> {
        let threads = (rayon::current_num_threads() / 4).clamp(1, MAX_THREADS);
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).thread_name(|i| format!("ridgewatch-convert-{i}")).build();
        let pool = pool.map_err(|e| SourceError::Inconsistent(format!("the converting threads could not start: {e}")))?;
        Ok(Self { grid, pool, made: Vec::new(), spare: None })
    }

    /// Makes a snapshot of u, v and w, stored in this order, and calls `beat` repeatedly meanwhile.
    pub fn snapshot(&mut self, time: f64, values: &[f32], beat: &mut dyn FnMut()) -> Arc<Snapshot> {
        self.reclaim();
        let (u, rest) = values.split_at(self.grid.nodes());
        let (v, w) = rest.split_at(self.grid.nodes());
        let (grid, nodes) = (self.grid.clone(), self.spare.take().unwrap_or_default());
        let made = Arc::new(self.beside(|| Snapshot::from_components_into(nodes, time, grid, u, v, w), beat));
        self.made.push(made.clone());
        made
    }

    /// Does `work` in the pool, and calls `beat` repeatedly on this thread until it is done.
    pub fn beside<T: Send>(&self, work: impl FnOnce() -> T + Send, beat: &mut dyn FnMut()) -> T {
        let (done, wait) = sync_channel(1);
        let made = self.pool.in_place_scope(|scope| {
            scope.spawn(move |_| drop(done.send(work())));
            loop {
                match wait.recv_timeout(BEAT_INTERVAL) {
                    Ok(made) => return Some(made),
                    Err(RecvTimeoutError::Timeout) => beat(),
                    Err(RecvTimeoutError::Disconnected) => return None,
                }
            }
        });
        let Some(made) = made else { unreachable!("the scope resumes a panic of `work`") };
        made
    }

    /// Drops the snapshots without other references, and keeps the memory of one for reuse.
    fn reclaim(&mut self) {
        for made in std::mem::take(&mut self.made) {
            match Arc::try_unwrap(made) {
                Ok(snapshot) => self.spare = Some(snapshot.nodes),
                Err(held) => self.made.push(held),
            }
        }
    }
}

#[cfg(test)]
impl Conversion {
    /// Keeps all threads busy for `time`.
    pub fn occupy(&self, time: Duration) {
        self.pool.spawn_broadcast(move |_| std::thread::sleep(time));
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use ridgewatch_field::{Axis, Geometry};

    fn grid() -> Arc<Grid> {
        let axis = |n| Axis::uniform(n, "m", 0.0, 1.0, 3).unwrap();
        Arc::new(Grid { axes: vec![axis("x"), axis("y")], geometry: Geometry::Cartesian, slab: (0.0, 1.0) })
    }

    #[test]
    fn memory_goes_round_and_what_is_held_is_left_alone() {
        let grid = grid();
        let values = |step: usize| -> Vec<f32> { (0..18).map(|i| (100 * step + i) as f32).collect() };
        let expected = |step: usize| Snapshot::from_components(0.0, grid.clone(), &values(step)[..9], &values(step)[9..], &[]).nodes;
        let mut conversion = Conversion::new(grid.clone()).unwrap();
        // A window of three.
        let mut held = std::collections::VecDeque::new();
        let mut places = std::collections::BTreeSet::new();
        for step in 0..20 {
            let made = conversion.snapshot(step as f64, &values(step), &mut || ());
            places.insert(made.nodes.as_ptr() as usize);
            held.push_back((step, made));
            if held.len() > 3 {
                held.pop_front();
            }
            assert!(held.iter().all(|(step, made)| made.nodes == expected(*step) && made.time == *step as f64));
        }
        assert!(places.len() <= 4, "{places:?}: three are held, one is made");
        held.clear();
        conversion.snapshot(20.0, &values(20), &mut || ());
        assert_eq!(conversion.made.len(), 1, "nothing is kept for its own sake");
    }

    #[test]
    fn a_panic_of_the_work_is_passed_on() {
        let conversion = Conversion::new(grid()).unwrap();
        let work = || -> u8 { panic!("as no conversion should") };
        let panicked = std::panic::catch_unwind(std::panic::AssertUnwindSafe(|| conversion.beside(work, &mut || ())));
        assert_eq!(panicked.unwrap_err().downcast_ref(), Some(&"as no conversion should"));
        assert_eq!(conversion.beside(|| 7, &mut || ()), 7);
    }
}
