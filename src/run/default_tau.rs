//! |tau| of an archive whose scene gives none: as long as neighbouring particles need to part, if they move for as long.

use super::RunError;
use crate::backend::stratified_points;
use crate::field::{DomainPoint, Snapshot, Window};
use crate::flow::{Direction, Extras, FlowMap, Normalisation, Steps, Traced, VelocitySource, cpu_tracer};
use crate::progress::Work;
use crate::source::SnapshotSource;
use crate::trust::Strata;
use std::sync::Arc;

/// Log-stretch at which neighbours count as parted: they are 20 times as far from each other. Ridges are thin then.
const PARTED: f32 = 3.0;
/// Share of the particles that are to be parted.
const PARTED_SHARE: f64 = 0.25;
/// Share of the particles that are to move for all of tau.
const STAY_SHARE: f64 = 0.6;
/// Largest number of snapshot intervals that are held. Over longer times every second snapshot is let go, and the velocity between is interpolated.
const MAX_SNAPSHOTS: usize = 48;
/// Random stream of the particles.
const STREAM: u64 = u64::MAX - 2;

/// Returns |tau| and why it is that long. Durations from two intervals to [`SnapshotSource::longest_default_tau`] are tried on the window at the start
/// of the archive, each about 1.5 times the one before. `map` has the settings of the flow map; its tau plays no part. `fits` tells whether a window
/// over a duration may be held.
///
/// # Errors
/// The archive has fewer than two times, a snapshot cannot be read, or a duration cannot be traced.
pub(super) fn default_tau(source: &mut dyn SnapshotSource, map: &FlowMap, fits: impl Fn(f64) -> bool) -> Result<(f64, String), RunError> {
    let longest = source.longest_default_tau()?;
    let times = source.times().to_vec();
    let end = times.partition_point(|time| time - times[0] < longest * (1.0 - 1e-9)).min(times.len() - 1);
    // Every `stride`-th snapshot is held.
    let (mut held, mut stride, mut read) = (Vec::<Arc<Snapshot>>::new(), 1, 0);
    let mut last = 2.min(end);
    let mut chosen = None;
    let work = Work::begin("choosing tau");
    loop {
        while last / stride > MAX_SNAPSHOTS {
            held = held.into_iter().step_by(2).collect();
            stride *= 2;
            read = held.len() * stride;
        }
        last = last.next_multiple_of(stride).min(end);
        let tau = (times[last] - times[0]).min(longest);
        if !fits(tau) {
            // The run refuses a window that does not fit at all.
            return Ok((chosen.unwrap_or(tau), "longer windows may not be held in memory (archive.memory_gib)".to_owned()));
        }
        // How long it becomes is not known.
        work.stands(format!("{last} of at most {end} snapshot intervals"));
        for index in (read..=last).step_by(stride) {
            held.push(Arc::new(source.read(index)?));
            read = index + stride;
        }
        let Some(Shares { parted, stay }) = Shares::of(&held, map)? else {
            return Ok((longest, "the longest by default, since no particle starts at a known velocity".to_owned()));
        };
        tracing::info!("tau {tau}: a share of {parted:.2} of the particles part, {stay:.2} move for all of it");
        let percent = |share: f64| format!("{:.0} %", 100.0 * share);
        if stay < STAY_SHARE {
            let (over, stop) = (if chosen.is_some() { "the next longer time" } else { "this time" }, percent(1.0 - stay));
            let tau = chosen.unwrap_or(tau);
            return Ok((tau, format!("since {stop} of the particles stop at an edge or at missing values over {over}")));
        }
        if parted >= PARTED_SHARE {
            return Ok((tau, format!("in which {} of the particles part from their neighbours by a factor of 20", percent(parted))));
        }
        if last == end {
            let why = format!("the longest by default, in which {} of the particles part from their neighbours", percent(parted));
            return Ok((longest, why));
        }
        chosen = Some(tau);
        last = (last + (last / 2).max(1)).min(end);
    }
}

/// What becomes of particles over the time of some snapshots.
struct Shares {
    /// Share that is parted from its neighbours.
    parted: f64,
    /// Share that neither leaves the domain nor meets missing values.
    stay: f64,
}

impl Shares {
    /// `None` if no particle starts at a known velocity.
    fn of(snapshots: &[Arc<Snapshot>], map: &FlowMap) -> Result<Option<Self>, RunError> {
        let mut window = Window::new(f64::INFINITY);
        for snapshot in snapshots {
            // Times ascend strictly and grids agree, so that no snapshot is refused.
            let _ = window.push(Arc::clone(snapshot));
        }
        let (oldest, newest) = (window.oldest().unwrap_or_default(), window.newest().unwrap_or_default());
        let start = if map.direction == Direction::Forward { oldest } else { newest };
        // The shares need no finer steps. Stretches of particles that stop early are not extrapolated.
        let steps = Steps::Auto { tolerance: 0.3 };
        let map = FlowMap { tau: newest - oldest, steps, normalisation: Normalisation::Tau, ..map.clone() };
        let tracer = cpu_tracer(VelocitySource::Window(Arc::new(window)), &map, start)?;
        let cells = if tracer.domain().dimensions == 3 { [16, 16, 8] } else { [64, 32, 1] };
        // Not the seed of the picture, which would change the flow map.
        let unit = stratified_points(&Strata::even(cells, 1), 0, STREAM);
        let mut points: Vec<DomainPoint> = unit.into_iter().map(|unit| tracer.domain().from_unit(unit)).collect();
        points.retain(|&point| !tracer.is_missing(point));
        if points.is_empty() {
            return Ok(None);
        }
        let mut traced = Traced::default();
        tracer.trace(&points, Extras::default(), &mut traced);
        let share = |count: usize| count as f64 / points.len() as f64;
        Ok(Some(Self {
            parted: share(traced.log_stretch.iter().filter(|stretch| **stretch >= PARTED).count()),
            stay: share(traced.lifetime_share.iter().filter(|share| **share >= 1.0).count()),
        }))
    }
}
