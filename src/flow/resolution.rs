//! Time resolution of a window: displacement between snapshots, and the change of the FTLE without every second snapshot.

use super::displacement::displacements;
use super::{Extras, FlowError, FlowMap, Traced, VelocitySource, assemble::cpu_tracer, steps};
use ridgewatch_base::progress::Work;
use ridgewatch_field::{Snapshot, Window};
use std::sync::Arc;

/// Displacement between snapshots, and change of the FTLE without every second snapshot.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct TimeResolution {
    /// Root mean square displacement between snapshots, in cells, over nodes with a known velocity.
    pub displacement_rms: f64,
    /// Largest displacement between snapshots, in cells.
    pub displacement_max: f64,
    /// Root mean square change of the FTLE (1/time) on a few thousand points without every second snapshot; `None` with fewer than three
    /// snapshots.
    pub ftle_change: Option<f64>,
    /// Root mean square of the FTLE (1/time) on the same points, for comparison.
    pub ftle_rms: f64,
}

/// Points on which the change of the FTLE is measured.
const POINTS: usize = 2048;
/// Measures a window's time resolution for a flow map.
///
/// # Errors
/// As [`cpu_tracer`].
pub fn time_resolution(window: &Arc<Window>, map: &FlowMap, t0: f64) -> Result<TimeResolution, FlowError> {
    let tracer = cpu_tracer(VelocitySource::Window(window.clone()), map, t0)?;
    let points = steps::quasi_random_points(tracer.domain(), POINTS);
    let work = Work::begin("measuring the resolution in time");
    let mut all = Traced::default();
    tracer.trace(&points, Extras::default(), &mut all);
    work.reached(1, 2);
    let finite: Vec<f64> = all.log_stretch.iter().map(|s| f64::from(*s)).filter(|s| s.is_finite()).collect();
    let ftle_rms = (finite.iter().map(|s| s * s).sum::<f64>() / finite.len().max(1) as f64).sqrt() / map.tau;

    let count = window.snapshots().len();
    let mut ftle_change = None;
    if count > 2 {
        let thinned = window.thinned(2, window.span().max(map.tau));
        let mut half = Traced::default();
        cpu_tracer(VelocitySource::Window(Arc::new(thinned)), map, t0)?.trace(&points, Extras::default(), &mut half);
        ftle_change = Some(steps::rms_difference(&all, &half) / map.tau);
    }

    let snapshots: Vec<&Arc<Snapshot>> = window.snapshots().collect();
    let (mut squares, mut nodes, mut largest) = (0.0, 0usize, 0.0f64);
    for pair in snapshots.windows(2) {
        let (sum, known, max) = displacements(pair[0], pair[1].time - pair[0].time);
        (squares, nodes, largest) = (squares + sum, nodes + known, largest.max(max));
    }
    Ok(TimeResolution { displacement_rms: (squares / nodes.max(1) as f64).sqrt(), displacement_max: largest.sqrt(), ftle_change, ftle_rms })
}
