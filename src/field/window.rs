//! The sliding window: exactly the snapshots that an integration over [t0, t0 + tau] needs.

use super::{Axis, Geometry, Grid, Snapshot};
use std::collections::VecDeque;
use std::sync::Arc;
use thiserror::Error;

/// Snapshots in ascending time, all on one grid.
#[derive(Debug, Clone, Default)]
pub struct Window {
    snapshots: VecDeque<Arc<Snapshot>>,
    span: f64,
}

/// Result of adding a snapshot.
#[derive(Debug, Clone, PartialEq)]
pub struct Pushed {
    /// Number of old snapshots dropped.
    pub dropped: usize,
    /// Irregularity of the snapshot; `None` if it is regular.
    pub warning: Option<WindowWarning>,
}

/// Irregularity of a snapshot that was accepted.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum WindowWarning {
    /// The snapshot replaced an older one of the same time.
    #[error("snapshot repeats time {time}: the newer one replaces the older")]
    Duplicate {
        /// Its time.
        time: f64,
    },
    /// The snapshot was inserted before newer ones.
    #[error("snapshot at time {time} came after {newest}: it was inserted in order of time")]
    OutOfOrder {
        /// Its time.
        time: f64,
        /// Newest time in the window.
        newest: f64,
    },
    /// Many more velocities are missing than before.
    #[error("{missing} of {nodes} velocities at time {time} are missing; the previous snapshot had {before}")]
    MissingBurst {
        /// Its time.
        time: f64,
        /// Missing nodes.
        missing: usize,
        /// All nodes.
        nodes: usize,
        /// Missing nodes of the previous snapshot.
        before: usize,
    },
}

impl WindowWarning {
    /// Time of the snapshot.
    pub fn time(&self) -> f64 {
        match self {
            Self::Duplicate { time } | Self::OutOfOrder { time, .. } | Self::MissingBurst { time, .. } => *time,
        }
    }
}

/// Error of adding a snapshot; the window is unchanged.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum WindowFault {
    /// The snapshot is older than the window.
    #[error("snapshot at time {time} is late: the window already starts at {oldest}")]
    Late {
        /// Its time.
        time: f64,
        /// Oldest time in the window.
        oldest: f64,
    },
    /// The grid differs from that of the window.
    #[error("snapshot at time {time} has another grid ({found:?} nodes) than the window ({expected:?} nodes)")]
    GridChanged {
        /// Its time.
        time: f64,
        /// Shape of its grid.
        found: [usize; 3],
        /// Shape of the window's grid.
        expected: [usize; 3],
    },
    /// The time is not finite.
    #[error("snapshot has no finite time ({time})")]
    NoTime {
        /// Its time.
        time: f64,
    },
}

impl Window {
    /// An empty window for integrations over `span` = |tau|, in time units.
    pub fn new(span: f64) -> Self {
        Self { snapshots: VecDeque::new(), span }
    }

    /// Adds a snapshot, and drops those that an integration over `span` ending at the newest time no longer needs.
    ///
    /// # Errors
    /// The snapshot is late, has no finite time, or has another grid. The window is unchanged then.
    pub fn push(&mut self, snapshot: Arc<Snapshot>) -> Result<Pushed, WindowFault> {
        let time = snapshot.time;
        if !time.is_finite() {
            return Err(WindowFault::NoTime { time });
        }
        let mut warning = None;
        if let Some(front) = self.snapshots.front() {
            if !Arc::ptr_eq(&front.grid, &snapshot.grid) && *front.grid != *snapshot.grid {
                return Err(WindowFault::GridChanged { time, found: snapshot.grid.shape(), expected: front.grid.shape() });
            }
            if self.is_late(time) {
                return Err(WindowFault::Late { time, oldest: front.time });
            }
        }
        let place = self.snapshots.partition_point(|s| s.time < time);
        if self.snapshots.get(place).is_some_and(|s| s.time == time) {
            self.snapshots[place] = snapshot;
            return Ok(Pushed { dropped: 0, warning: Some(WindowWarning::Duplicate { time }) });
        }
        if place < self.snapshots.len() {
            warning = Some(WindowWarning::OutOfOrder { time, newest: self.newest().unwrap_or(time) });
        } else if let Some(last) = self.snapshots.back() {
            let (missing, before, nodes) = (snapshot.missing_nodes(), last.missing_nodes(), snapshot.nodes.len());
            if missing > before + nodes / 20 {
                warning = Some(WindowWarning::MissingBurst { time, missing, nodes, before });
            }
        }
        self.snapshots.insert(place, snapshot);
        Ok(Pushed { dropped: self.drop_expired(), warning })
    }

    /// True if [`Self::push`] would refuse a snapshot of this time as late: a full window never moves back in time.
    pub fn is_late(&self, time: f64) -> bool {
        self.oldest().is_some_and(|oldest| time < oldest) && self.is_full()
    }

    /// Time between a new snapshot and the nearest one in the window; `None` if the window is empty or the new snapshot would replace one.
    pub fn distance(&self, time: f64) -> Option<f64> {
        let place = self.snapshots.partition_point(|s| s.time < time);
        let before = place.checked_sub(1).map(|before| time - self.snapshots[before].time);
        let behind = self.snapshots.get(place).map(|s| s.time - time);
        if behind == Some(0.0) { None } else { before.into_iter().chain(behind).reduce(f64::min) }
    }

    /// Drops snapshots before `newest - span`, except for the last one before it.
    fn drop_expired(&mut self) -> usize {
        let Some(newest) = self.newest() else { return 0 };
        let start = newest - self.span;
        let slack = self.span * 1e-9;
        let mut dropped = 0;
        while self.snapshots.len() > 2 && self.snapshots[1].time <= start + slack {
            self.snapshots.pop_front();
            dropped += 1;
        }
        dropped
    }

    /// True if the snapshots cover an integration over the whole span.
    pub fn is_full(&self) -> bool {
        match (self.oldest(), self.newest()) {
            (Some(oldest), Some(newest)) => self.snapshots.len() >= 2 && newest - oldest >= self.span * (1.0 - 1e-9),
            _ => false,
        }
    }

    /// Integration span |tau| that the window serves.
    pub fn span(&self) -> f64 {
        self.span
    }

    /// Time of the oldest snapshot; `None` if the window is empty.
    pub fn oldest(&self) -> Option<f64> {
        self.snapshots.front().map(|s| s.time)
    }

    /// Time of the newest snapshot; `None` if the window is empty.
    pub fn newest(&self) -> Option<f64> {
        self.snapshots.back().map(|s| s.time)
    }

    /// Snapshots, oldest first.
    pub fn snapshots(&self) -> impl ExactSizeIterator<Item = &Arc<Snapshot>> {
        self.snapshots.iter()
    }

    /// Grid of the snapshots; `None` if the window is empty.
    pub fn grid(&self) -> Option<&Arc<Grid>> {
        self.snapshots.front().map(|s| &s.grid)
    }

    /// A window over `span` of every `stride`-th snapshot and the last one, so that it still covers the time of this one.
    pub fn thinned(&self, stride: usize, span: f64) -> Self {
        let count = self.snapshots().len();
        let mut thinned = Self::new(span);
        for (_, snapshot) in self.snapshots().enumerate().filter(|(index, _)| index % stride == 0 || index + 1 == count) {
            // Snapshots of a window are never refused.
            let pushed = thinned.push(snapshot.clone());
            debug_assert!(pushed.is_ok());
        }
        thinned
    }

    /// A window of every `stride`-th node along each axis, of those axes that have at least four of them left. A periodic axis keeps its nodes unless it
    /// has a multiple of `stride`, since its cells would differ.
    pub fn coarsened(&self, stride: usize) -> Self {
        let mut coarsened = Self::new(self.span);
        let Some(fine) = self.grid() else { return coarsened };
        let stride = stride.max(1);
        let is_coarsened = |axis: &Axis| axis.len().div_ceil(stride) >= 4 && (axis.period().is_none() || axis.len().is_multiple_of(stride));
        let strides: [usize; 3] = std::array::from_fn(|k| fine.axes.get(k).filter(|axis| is_coarsened(axis)).map_or(1, |_| stride));
        let axes = fine.axes.iter().zip(strides).map(|(axis, stride)| axis.thinned(stride)).collect();
        let grid = Arc::new(Grid { axes, ..(**fine).clone() });
        let ([nx, ny, _], shape) = (fine.shape(), grid.shape());
        for snapshot in &self.snapshots {
            let node = |i: usize| {
                let [x, y, z] = [i % shape[0], i / shape[0] % shape[1], i / shape[0] / shape[1]];
                snapshot.nodes[(z * strides[2] * ny + y * strides[1]) * nx + x * strides[0]]
            };
            let nodes = (0..grid.nodes()).map(node).collect();
            // Times of a window ascend.
            let pushed = coarsened.push(Arc::new(Snapshot::new(snapshot.time, grid.clone(), nodes)));
            debug_assert!(pushed.is_ok());
        }
        coarsened
    }

    /// Whether all levels (nodes of the third axis, two or more) have the same velocity in every snapshot, and none across them.
    pub fn is_flat(&self) -> bool {
        let Some(grid) = self.grid() else { return false };
        let [nx, ny, nz] = grid.shape();
        // See `Snapshot::nodes`.
        let across = if matches!(grid.geometry, Geometry::Sphere { .. }) { 3 } else { 2 };
        let is_same = |(a, b): (&[f32; 4], &[f32; 4])| (0..4).all(|k| a[k] == b[k] || a[k].is_nan() && b[k].is_nan());
        nz > 1
            && self.snapshots.iter().all(|snapshot| {
                let mut levels = snapshot.nodes.chunks_exact(nx * ny);
                let first = levels.next().unwrap_or_default();
                first.iter().all(|node| node[across] == 0.0 || node[3].is_nan()) && levels.all(|level| first.iter().zip(level).all(is_same))
            })
    }

    /// Memory of all nodes, in bytes.
    pub fn bytes(&self) -> usize {
        self.snapshots.iter().map(|s| s.bytes()).sum()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn grid(nodes: usize) -> Arc<Grid> {
        let axis = |name| Axis::uniform(name, "m", 0.0, 1.0, nodes).unwrap();
        Arc::new(Grid { axes: vec![axis("x"), axis("y")], geometry: Geometry::Cartesian, slab: (0.0, 1.0) })
    }

    #[test]
    fn a_window_is_flat_if_its_levels_are_alike_and_nothing_crosses_them() {
        let axis = |name, nodes| Axis::uniform(name, "m", 0.0, 1.0, nodes).unwrap();
        let flat = |levels: usize, node: &dyn Fn(usize, usize) -> [f32; 3]| {
            let axes = [("x", 3), ("y", 2), ("z", levels)].into_iter().filter(|(_, nodes)| *nodes > 1);
            let axes = axes.map(|(name, nodes)| axis(name, nodes)).collect();
            let grid = Arc::new(Grid { axes, geometry: Geometry::Cartesian, slab: (0.0, 1.0) });
            let mut window = Window::new(2.0);
            for time in 0..3 {
                let of = |k: usize| (0..6 * levels).map(|i| node(time, i)[k]).collect::<Vec<f32>>();
                window.push(Arc::new(Snapshot::from_components(time as f64, grid.clone(), &of(0), &of(1), &of(2)))).unwrap();
            }
            window.is_flat()
        };
        let alike = |time: usize, i: usize| [(i % 6 + time) as f32, if i % 6 == 4 { f32::NAN } else { 1.0 }, 0.0];
        assert!(flat(2, &alike) && flat(5, &alike), "missing nodes are alike too");
        assert!(!flat(1, &alike), "one level is a plane already");
        for (time, i, component, value) in [(2, 29, 0, 7.5), (0, 13, 1, 1.5), (1, 2, 2, 1e-9), (1, 22, 1, 0.0)] {
            let odd = |t: usize, j: usize| {
                let mut node = alike(t, j);
                if (t, j) == (time, i) {
                    node[component] = value;
                }
                node
            };
            assert!(!flat(5, &odd), "{time} {i} {component}");
        }
    }

    #[test]
    fn a_coarser_window_has_the_same_velocities_at_its_nodes() {
        let axis = |name, nodes| Axis::uniform(name, "m", 0.0, (nodes - 1) as f64, nodes).unwrap();
        let levels = Axis::new("z", "m", vec![0.0, 1.0, 3.0]).unwrap();
        // Eight columns that close a circle, nine rows, and too few levels to leave any out.
        let grid = Arc::new(Grid {
            axes: vec![axis("x", 8).with_period(8.0), axis("y", 9), levels],
            geometry: Geometry::Cartesian,
            slab: (0.0, 1.0),
        });
        let mut window = Window::new(1.0);
        for time in [0.0, 1.0] {
            // Each node's velocity is its place.
            let of = |divisor: usize, count: usize| (0..grid.nodes()).map(|i| (i / divisor % count) as f32).collect::<Vec<f32>>();
            window.push(Arc::new(Snapshot::from_components(time, grid.clone(), &of(1, 8), &of(8, 9), &of(72, 3)))).unwrap();
        }
        let coarser = window.coarsened(2);
        let grid = coarser.grid().unwrap();
        assert_eq!((grid.shape(), grid.axes[0].period(), coarser.snapshots().len()), ([4, 5, 3], Some(8.0), 2));
        assert_eq!(grid.domain(), window.grid().unwrap().domain());
        for (i, node) in coarser.snapshots().flat_map(|snapshot| snapshot.nodes.iter().enumerate()) {
            assert_eq!(node[..3], [(i % 4 * 2) as f32, (i / 4 % 5 * 2) as f32, (i / 20) as f32]);
        }
        // Columns that do not close the circle stay, and so do rows of which three would be left.
        assert_eq!(window.coarsened(3).grid().unwrap().shape(), [8, 9, 3]);
        assert_eq!(window.coarsened(1).grid(), window.grid());
    }

    fn at(time: f64, grid: &Arc<Grid>) -> Arc<Snapshot> {
        let zeros = vec![0.0; grid.nodes()];
        Arc::new(Snapshot::from_components(time, grid.clone(), &zeros, &zeros, &[]))
    }

    #[test]
    fn holds_what_the_span_needs_and_no_more() {
        let grid = grid(2);
        let mut window = Window::new(2.5);
        for t in 0..10 {
            window.push(at(f64::from(t), &grid)).unwrap();
        }
        let times: Vec<f64> = window.snapshots().map(|s| s.time).collect();
        assert_eq!(times, [6.0, 7.0, 8.0, 9.0], "6 is needed to interpolate at 6.5");
        assert!(window.is_full());
    }

    #[test]
    fn odd_snapshots_have_defined_results() {
        let grid_2 = grid(2);
        let mut window = Window::new(2.0);
        for t in [0.0, 1.0, 3.0] {
            window.push(at(t, &grid_2)).unwrap();
        }
        let pushed = window.push(at(3.0, &grid_2)).unwrap();
        assert_eq!(pushed.warning, Some(WindowWarning::Duplicate { time: 3.0 }));
        let pushed = window.push(at(2.0, &grid_2)).unwrap();
        assert_eq!(pushed.warning, Some(WindowWarning::OutOfOrder { time: 2.0, newest: 3.0 }));
        assert!(matches!(window.push(at(0.5, &grid_2)), Err(WindowFault::Late { .. })));
        assert!(matches!(window.push(at(4.0, &grid(3))), Err(WindowFault::GridChanged { .. })));
        assert!(matches!(window.push(at(f64::NAN, &grid_2)), Err(WindowFault::NoTime { .. })));
        let nan = vec![f32::NAN; 4];
        let burst = window.push(Arc::new(Snapshot::from_components(4.0, grid_2, &nan, &nan, &[]))).unwrap();
        assert!(matches!(burst.warning, Some(WindowWarning::MissingBurst { missing: 4, .. })));
    }
}
