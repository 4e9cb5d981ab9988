//! Whether the snapshots follow one another closely enough.

use super::{Extras, FlowError, FlowMap, Traced, VelocitySource, assemble::cpu_tracer, steps};
use crate::field::{Geometry, Snapshot, Window};
use rayon::prelude::*;
use std::sync::Arc;

/// How far the flow goes, and how much the FTLE changes, between snapshots.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct TimeResolution {
    /// Root mean square displacement between snapshots, in cells, over nodes with a known velocity.
    pub displacement_rms: f64,
    /// Largest displacement between snapshots, in cells.
    pub displacement_max: f64,
    /// Root mean square change of the FTLE (1/time) on a few thousand points when every second snapshot is dropped; none with fewer
    /// than three snapshots.
    pub ftle_change: Option<f64>,
    /// Root mean square of the FTLE (1/time) on the same points, to compare with.
    pub ftle_rms: f64,
}

/// Points on which the change is measured.
const POINTS: usize = 2048;
/// Degrees from a pole within which a cell's width says nothing.
const POLAR: f64 = 1.0;

/// Measures a window's time resolution for a flow map.
///
/// # Errors
/// As [`cpu_tracer`].
pub fn time_resolution(window: &Arc<Window>, map: &FlowMap, t0: f64) -> Result<TimeResolution, FlowError> {
    let tracer = cpu_tracer(VelocitySource::Window(window.clone()), map, t0)?;
    let points = steps::points(tracer.domain(), POINTS);
    let mut all = Traced::default();
    tracer.trace(&points, Extras::default(), &mut all);
    let finite: Vec<f64> = all.log_stretch.iter().map(|s| f64::from(*s)).filter(|s| s.is_finite()).collect();
    let ftle_rms = (finite.iter().map(|s| s * s).sum::<f64>() / finite.len().max(1) as f64).sqrt() / map.tau;

    let count = window.snapshots().len();
    let mut ftle_change = None;
    if count > 2 {
        let mut thinned = Window::new(window.span().max(map.tau));
        for (index, snapshot) in window.snapshots().enumerate() {
            // The last one stays, so that the window still covers the integration. They came from a window: none is refused.
            if index % 2 == 0 || index + 1 == count {
                let pushed = thinned.push(snapshot.clone());
                debug_assert!(pushed.is_ok());
            }
        }
        let mut half = Traced::default();
        cpu_tracer(VelocitySource::Window(Arc::new(thinned)), map, t0)?.trace(&points, Extras::default(), &mut half);
        ftle_change = Some(steps::difference(&all, &half) / map.tau);
    }

    let snapshots: Vec<&Arc<Snapshot>> = window.snapshots().collect();
    let (mut squares, mut nodes, mut largest) = (0.0, 0usize, 0.0f64);
    for pair in snapshots.windows(2) {
        let (sum, known, most) = displacements(pair[0], pair[1].time - pair[0].time);
        (squares, nodes, largest) = (squares + sum, nodes + known, largest.max(most));
    }
    Ok(TimeResolution { displacement_rms: (squares / nodes.max(1) as f64).sqrt(), displacement_max: largest.sqrt(), ftle_change, ftle_rms })
}

/// Nodes of a snapshot that [`cells_crossed`] looks at.
const PROBES: usize = 4096;

/// Cells that a fast particle crosses between two times: the upper quartile of the displacement over evenly chosen nodes, summed over the
/// snapshot intervals.
pub(super) fn cells_crossed(window: &Window, from: f64, to: f64) -> f64 {
    let snapshots: Vec<&Arc<Snapshot>> = window.snapshots().collect();
    let (from, to) = (from.min(to), from.max(to));
    let crossed = |pair: &[&Arc<Snapshot>]| {
        let interval = pair[1].time.min(to) - pair[0].time.max(from);
        if interval <= 0.0 {
            return 0.0;
        }
        // Odd, so that rows and columns of a grid of even sides take turns.
        let stride = (pair[0].nodes.len() / PROBES) | 1;
        let cells = CellsMoved { snapshot: pair[0], interval };
        let mut squares: Vec<f64> = (0..pair[0].nodes.len()).step_by(stride).filter_map(|i| cells.squared(i)).collect();
        let quartile = squares.len() * 3 / 4;
        if squares.is_empty() { 0.0 } else { squares.select_nth_unstable_by(quartile, f64::total_cmp).1.sqrt() }
    };
    snapshots.windows(2).map(crossed).sum()
}

/// Displacements of a snapshot's nodes during an interval.
struct CellsMoved<'a> {
    snapshot: &'a Snapshot,
    interval: f64,
}

impl CellsMoved<'_> {
    /// Squared displacement of a node in cells; none where the velocity is missing or a cell has no width to speak of.
    fn squared(&self, i: usize) -> Option<f64> {
        let (node, grid) = (self.snapshot.nodes[i], &*self.snapshot.grid);
        if node[3].is_nan() {
            return None;
        }
        let [nx, ny, _] = grid.shape();
        let place = [i % nx, i / nx % ny, i / nx / ny];
        // The smaller of the two cells at a node.
        let cell = |axis: usize| {
            let (c, index) = (grid.axes[axis].coordinates(), place[axis]);
            let behind = if index > 0 { c[index] - c[index - 1] } else { f64::INFINITY };
            let ahead = if index + 1 < c.len() { c[index + 1] - c[index] } else { f64::INFINITY };
            behind.min(ahead)
        };
        let v = [0, 1, 2].map(|c| f64::from(node[c]) * self.interval);
        match grid.geometry {
            Geometry::Cartesian => Some((0..grid.dimensions()).map(|k| (v[k] / cell(k)).powi(2)).sum::<f64>()),
            Geometry::Sphere { radius } => {
                let (longitude, latitude) = (grid.axes[0].coordinates()[place[0]], grid.axes[1].coordinates()[place[1]]);
                let (sin_lon, cos_lon) = longitude.to_radians().sin_cos();
                let cos_lat = latitude.to_radians().cos();
                let east = v[1] * cos_lon - v[0] * sin_lon;
                let north_squared = (v.iter().map(|c| c * c).sum::<f64>() - east * east).max(0.0);
                let (width, height) = (cell(0).to_radians() * radius * cos_lat, cell(1).to_radians() * radius);
                // With levels the fourth number of a node is its vertical velocity.
                let up = if grid.dimensions() == 3 { f64::from(node[3]) * self.interval / cell(2) } else { 0.0 };
                (latitude.abs() < 90.0 - POLAR).then(|| (east / width).powi(2) + north_squared / (height * height) + up * up)
            }
        }
    }
}

/// Sum of the squared displacements in cells during `interval`, number of known nodes, largest squared displacement.
fn displacements(snapshot: &Snapshot, interval: f64) -> (f64, usize, f64) {
    let cells = CellsMoved { snapshot, interval };
    (0..snapshot.nodes.len())
        .into_par_iter()
        .filter_map(|i| cells.squared(i))
        .map(|square| (square, 1, square))
        .reduce(|| (0.0, 0, 0.0), |a, b| (a.0 + b.0, a.1 + b.1, a.2.max(b.2)))
}
