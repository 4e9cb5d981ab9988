//! |tau| of an archive whose scene gives none: as long as neighbouring particles need to part, if they stay in the domain for as long.

use super::RunError;
use crate::backend::stratified_points;
use crate::field::Window;
use crate::flow::{Direction, Extras, FlowMap, Steps, Traced, VelocitySource, cpu_tracer};
use crate::source::SnapshotSource;
use crate::trust::Strata;
use std::sync::Arc;

/// Log-stretch at which neighbours count as parted: they are 20 times as far from each other. Ridges are thin then.
const PARTED: f32 = 3.0;
/// Share of the particles that are to be parted.
const PARTED_SHARE: f64 = 0.25;
/// Share of the particles that are to stay in the domain for all of tau.
const STAY_SHARE: f64 = 0.6;
/// Largest number of snapshots that are read. Between those that are left out of long archives, the velocity is interpolated.
const MAX_SNAPSHOTS: usize = 48;
/// Random stream of the particles.
const STREAM: u64 = u64::MAX - 2;

/// Returns |tau| and why it is that long. Durations from two intervals to half of the span are tried on the window at the start of the archive, each
/// about 1.5 times the one before. `map` has the settings of the flow map, and its tau plays no part; `fits` tells whether a window over a duration
/// may be held.
///
/// # Errors
/// The archive has one time only, a snapshot cannot be read, or the first duration cannot be traced.
pub(super) fn default_tau(
    source: &mut dyn SnapshotSource,
    map: &FlowMap,
    seed: u64,
    fits: impl Fn(f64) -> bool,
) -> Result<(f64, String), RunError> {
    let longest = source.longest_default_tau()?;
    let times = source.times().to_vec();
    let end = times.partition_point(|time| time - times[0] < longest * (1.0 - 1e-9)).min(times.len() - 1);
    let stride = end.div_ceil(MAX_SNAPSHOTS).max(1);
    let mut window = Window::new(f64::INFINITY);
    let (mut read, mut last) = (0, (2 * stride).min(end));
    let mut chosen = None;
    if !fits(times[last] - times[0]) {
        return Ok((times[last] - times[0], "the shortest by default".to_owned()));
    }
    loop {
        for index in (read..=last).step_by(stride) {
            // Times ascend strictly and grids agree, so that no snapshot is refused.
            let _ = window.push(Arc::new(source.read(index)?));
            read = index + stride;
        }
        let Shares { parted, stay, tau } = Shares::of(&window, map, seed)?;
        tracing::info!("tau {tau}: a share of {parted:.2} of the particles part, {stay:.2} stay in the domain");
        let percent = |share: f64| format!("{:.0} %", 100.0 * share);
        if stay < STAY_SHARE {
            let tau = chosen.unwrap_or(tau);
            return Ok((tau, format!("over longer times only {} of the particles or fewer stay in the domain", percent(stay))));
        }
        if parted >= PARTED_SHARE {
            return Ok((tau, format!("in which {} of the particles part from their neighbours by a factor of 20", percent(parted))));
        }
        if last == end {
            return Ok((
                longest,
                format!("the longest by default, in which {} of the particles part from their neighbours", percent(parted)),
            ));
        }
        chosen = Some(tau);
        last = (last + (last / 2 / stride).max(1) * stride).min(end);
        if !fits(times[last] - times[0]) {
            return Ok((tau, "the longest whose window may be held in memory (archive.memory_gib)".to_owned()));
        }
    }
}

/// What becomes of particles over a time.
struct Shares {
    /// Share that is parted from its neighbours.
    parted: f64,
    /// Share that stays in the domain.
    stay: f64,
    /// The time.
    tau: f64,
}

impl Shares {
    fn of(window: &Window, map: &FlowMap, seed: u64) -> Result<Self, RunError> {
        let (oldest, newest) = (window.oldest().unwrap_or_default(), window.newest().unwrap_or_default());
        let tau = newest - oldest;
        let start = if map.direction == Direction::Forward { oldest } else { newest };
        // The shares need no finer steps.
        let map = FlowMap { tau, steps: Steps::Auto { tolerance: 0.3 }, ..map.clone() };
        let tracer = cpu_tracer(VelocitySource::Window(Arc::new(window.clone())), &map, start)?;
        let cells = if tracer.domain().dimensions == 3 { [16, 16, 8] } else { [64, 32, 1] };
        let unit = stratified_points(&Strata::even(cells, 1), seed, STREAM);
        let mut points: Vec<[f32; 3]> = unit.into_iter().map(|unit| tracer.domain().from_unit(unit)).collect();
        points.retain(|&point| !tracer.is_missing(point));
        let mut traced = Traced::default();
        tracer.trace(&points, Extras::default(), &mut traced);
        let share = |count: usize| count as f64 / points.len().max(1) as f64;
        Ok(Self {
            parted: share(traced.log_stretch.iter().filter(|stretch| **stretch >= PARTED).count()),
            stay: share(traced.lifetime_share.iter().filter(|share| **share >= 1.0).count()),
            tau,
        })
    }
}
