//! From a moment to its ridges: lines in two dimensions, surfaces in three.

use super::footprint::MapTracer;
use super::lines::RidgeLine;
use super::make::{MOST_NODES, about, nodes_in_cell, ridge_field, ridge_nodes, structures};
use super::ridges::Strength;
use super::smoothing::{roughness, too_coarse};
use super::surface_files::SurfacesAbout;
use super::surfaces::Surfaces;
use super::view::{View, is_geographic};
use super::volume::Volume;
use super::words::Rate;
use super::{MapError, Moment};
use crate::backend::Device;
use crate::field::{Domain, DomainPoint, EARTH_RADIUS};
use crate::flow::Direction;
use crate::run::RunError;
use serde::Serialize;
use std::time::Instant;

/// Nodes of a volume if no grid is given.
const VOLUME_NODES: f64 = 1_048_576.0;
/// Nodes traced at once, which bounds the memory beside the field.
const AT_ONCE: usize = 1 << 19;
/// Pixels of the map on whose default grid lines are found.
const MAP_PIXELS: usize = 800;

/// Ridges of a moment.
pub enum RidgesOfMoment {
    /// In two dimensions.
    Lines(Vec<RidgeLine>),
    /// In three dimensions.
    Surfaces(Surfaces),
}

/// Ridges, what files say of them, and the record.
pub struct FoundRidges {
    /// The ridges.
    pub ridges: RidgesOfMoment,
    /// What files say.
    pub about: SurfacesAbout,
    /// What is printed.
    pub record: RidgesRecord,
    /// Remarks for the user.
    pub notes: Vec<String>,
}

/// Record of ridges.
#[derive(Debug, Clone, Serialize)]
pub struct RidgesRecord {
    /// Version of ridgewatch.
    pub version: &'static str,
    /// Title of the scene.
    pub title: String,
    /// Source of the velocity.
    pub source: String,
    /// Seed time, in time units of the source.
    pub time: f64,
    /// Seed time as a date.
    pub date: Option<String>,
    /// Unit of `time` and `tau`; empty if they have none.
    pub time_unit: String,
    /// Direction of the integration.
    pub direction: Direction,
    /// |tau|.
    pub tau: f64,
    /// Runge-Kutta steps per path; 0 if adaptive.
    pub steps: usize,
    /// Difference of the log-stretch from twice as many steps; `None` if the steps were given.
    pub integration_difference: Option<f64>,
    /// Nodes along each axis.
    pub grid: Vec<usize>,
    /// Percentile of the FTLE that `least` of a ridge reaches.
    pub percentile: f64,
    /// Percentile of the sharpness of ridge points below which they are cut off.
    pub sharpness: f64,
    /// Length of a line in nodes, or area of a surface in squares of nodes, that reaches the percentile at least.
    pub least: f64,
    /// Standard deviation of the smoothing, in nodes.
    pub smoothing: f64,
    /// Root mean square difference of the FTLE at a node from the mean of its two neighbours, as a share of the standard deviation of all nodes.
    pub roughness: f64,
    /// Unit of the FTLE in the file.
    pub ftle_unit: String,
    /// Number of lines or surfaces.
    pub ridges: usize,
    /// Points of lines, or vertices of surfaces.
    pub points: usize,
    /// Triangles; `None` for lines.
    pub triangles: Option<usize>,
    /// Seconds of tracing, and of finding the ridges.
    pub seconds: [f64; 2],
}

/// Finds the ridges of a moment on a grid of nodes from edge to edge of the domain; without `grid`, two nodes for each pixel of a map in two dimensions,
/// and a million, evenly spaced, in three. Calls `progress` with the nodes traced and those in all.
///
/// # Errors
/// The grid does not fit the flow, no node has a velocity, or the device fails.
pub fn find(
    moment: &Moment,
    grid: Option<&[usize]>,
    strength: &Strength,
    device: &Device,
    progress: &mut dyn FnMut(u64, u64),
) -> Result<FoundRidges, MapError> {
    let (plan, tau) = (&moment.plan, moment.taus[0]);
    let domain = &plan.domain;
    if let Some(grid) = grid
        && grid.len() != domain.dimensions
    {
        let (given, accepted) =
            (grid.iter().map(usize::to_string).collect::<Vec<_>>().join("x"), ["NXxNY", "NXxNYxNZ"][domain.dimensions - 2]);
        return Err(MapError::Usage(format!("--grid {given}: the flow has {} dimensions; accepted: {accepted}", domain.dimensions)));
    }
    let geographic = is_geographic(&moment.velocity);
    let level = (domain.min[2] + domain.max[2]) / 2.0;
    let view = View::new(domain, geographic, None, level, MAP_PIXELS);
    let size = match (grid, domain.dimensions) {
        (Some(grid), _) => grid.to_vec(),
        (None, 2) => ridge_nodes(view.as_ref().map_err(|why| MapError::Usage(why.clone()))?).to_vec(),
        (None, _) => volume_nodes(domain).to_vec(),
    };
    let total = size.iter().product::<usize>() as u64;
    let map = moment.map(tau);
    let mut tracer = MapTracer::new(device, &moment.velocity, &map, moment.time).map_err(RunError::of)?;
    let mut done = 0;
    let mut count = |seeds: usize| {
        done += seeds as u64;
        progress(done, total);
    };
    let start = Instant::now();
    let kind = structures(map.direction);
    let missing = || MapError::AllMissing(super::make::when(moment));
    let mut strength = *strength;
    let (ridges, seconds, roughness) = match size[..] {
        [nx, ny, nz] => {
            let volume = volume(domain, geographic, &mut tracer, [nx, ny, nz], &mut count)?;
            let traced = start.elapsed().as_secs_f64();
            if volume.values.iter().all(|v| !v.is_finite()) {
                return Err(missing());
            }
            (RidgesOfMoment::Surfaces(volume.surfaces(&strength)), traced, roughness(&volume.values, &size))
        }
        _ => {
            let view = view.map_err(MapError::Usage)?;
            let mut count = |nodes: usize| {
                count(nodes);
                true
            };
            let field = ridge_field(&view, &mut tracer, [size[0], size[1]], &mut count)?;
            let traced = start.elapsed().as_secs_f64();
            if field.values.iter().all(|v| !v.is_finite()) {
                return Err(missing());
            }
            strength = strength.over(&field, nodes_in_cell(&moment.velocity, field.size));
            let lines = field.ridges(&strength).into_iter().map(|points| RidgeLine { kind, tau, points }).collect();
            (RidgesOfMoment::Lines(lines), traced, roughness(&field.values, &size))
        }
    };
    let rate = Rate::fitting(&plan.time_unit, tau);
    let flow = tracer.flow();
    let (number, points, triangles) = match &ridges {
        RidgesOfMoment::Lines(lines) => (lines.len(), lines.iter().map(|line| line.points.len()).sum(), None),
        RidgesOfMoment::Surfaces(found) => (found.surfaces.len(), found.points.len(), Some(found.triangles.len())),
    };
    let record = RidgesRecord {
        version: env!("CARGO_PKG_VERSION"),
        title: plan.scene.title.clone(),
        source: plan.source.clone(),
        time: moment.time,
        date: moment.date.clone(),
        time_unit: plan.time_unit.clone(),
        direction: map.direction,
        tau,
        steps: flow.steps(),
        integration_difference: flow.step_choice().map(|chosen| chosen.difference).filter(|d| d.is_finite()),
        grid: size,
        percentile: strength.percentile,
        sharpness: strength.sharpness,
        least: strength.extent,
        smoothing: strength.smoothing,
        roughness,
        ftle_unit: rate.unit.clone(),
        ridges: number,
        points,
        triangles,
        seconds: [seconds, start.elapsed().as_secs_f64() - seconds],
    };
    let about = SurfacesAbout { shared: about(moment, rate, level), time: moment.time, tau, direction: map.direction };
    let doubt = tracer.short_lived();
    let notes = tracer.note.take().into_iter().chain(doubt).chain(too_coarse(roughness, "--grid")).collect();
    Ok(FoundRidges { ridges, about, record, notes })
}

/// Nodes of a volume, evenly spaced, at least 16 along each axis.
fn volume_nodes(domain: &Domain) -> [usize; 3] {
    let lengths = domain.lengths();
    let nodes = |step: f64| lengths.map(|length| ((length / step).round() as usize + 1).clamp(16, MOST_NODES >> 9));
    let mut step = (lengths.iter().product::<f64>() / VOLUME_NODES).cbrt();
    // Flat domains take more along their short axis than their share.
    while nodes(step).iter().product::<usize>() > MOST_NODES {
        step *= 1.1;
    }
    nodes(step)
}

/// The FTLE at nodes from edge to edge of the domain.
fn volume(
    domain: &Domain,
    is_geographic: bool,
    tracer: &mut MapTracer<'_>,
    size: [usize; 3],
    done: &mut dyn FnMut(usize),
) -> Result<Volume, MapError> {
    let (origin, extent) = (domain.min, domain.extent());
    let step: [f64; 3] = std::array::from_fn(|k| extent[k] / (size[k] - 1) as f64);
    let [nx, ny, nz] = size;
    let at = |k: usize, n: usize| origin[k] + step[k] * n as f64;
    let nodes = nx * ny * nz;
    let mut values = Vec::with_capacity(nodes);
    for first in (0..nodes).step_by(AT_ONCE) {
        let seeds: Vec<DomainPoint> = (first..(first + AT_ONCE).min(nodes))
            .map(|node| domain.inward([at(0, node % nx), at(1, node / nx % ny), at(2, node / (nx * ny))]))
            .collect();
        values.extend(tracer.ftle(&seeds, done).map_err(RunError::of)?);
    }
    let degree = (EARTH_RADIUS / 1000.0).to_radians();
    // Kilometres; heights are metres.
    let scale = |j: usize| [degree * at(1, j).to_radians().cos().max(0.0), degree, 1e-3];
    let scale = (0..ny).map(|j| if is_geographic { scale(j) } else { [1.0; 3] }).collect();
    // An integration rounds the log-stretch to some 1e-5, however small it is.
    Ok(Volume { origin, step, size, values, scale, rounding: 1e-5 / tracer.flow().tau() })
}
