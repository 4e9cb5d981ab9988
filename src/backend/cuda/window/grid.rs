//! Launch arguments and macros of the kernels that trace in a window of snapshots.

use crate::cuda::layout::{AxisData, DeviceReal, GridData, GridStep, Words, words};
use crate::cuda::{DeviceError, Storage};
use bytemuck::{Zeroable, cast_slice};
use ridgewatch_field::{Geometry, Grid};
use ridgewatch_flow::{AxisMap, FlowMap, Integrator, Interpolation, angle_slack, bounds, poles};

/// Launch arguments and macros of `trace_grid.cu`.
#[derive(Debug)]
pub struct GridArguments {
    /// `GridData`.
    pub data: Words,
    /// Address of the steps.
    pub steps: u64,
    /// Macros.
    pub defines: Vec<String>,
}

/// The snapshots of a window on the device.
#[derive(Debug, Clone)]
pub struct Nodes {
    /// Addresses, oldest first.
    pub addresses: Vec<u64>,
    /// Format of the velocities.
    pub storage: Storage,
    /// Factor of the stored velocities.
    pub scale: f32,
    /// True if some node is missing.
    pub missing: bool,
}

/// A flow map in a window: everything that [`GridArguments`] depend on.
#[derive(Debug, Clone, Copy)]
pub struct WindowFlowMap<'a> {
    /// The snapshots on the device.
    pub nodes: &'a Nodes,
    /// Their times.
    pub times: &'a [f64],
    /// Their grid.
    pub grid: &'a Grid,
    /// The flow map.
    pub map: &'a FlowMap,
    /// Times at which paths start and end.
    pub span: (f64, f64),
    /// Steps between them.
    pub steps: usize,
    /// True if threads cache their cell in registers (see `grid.cuh`).
    pub keep: bool,
}

/// A time within this share of an interval of a snapshot's time counts as this snapshot's, as in the CPU's sampler.
const SAME_TIME: f64 = 1e-9;

impl GridArguments {
    /// Arguments in the precision `R`. `put` copies bytes to memory that the kernel can read and returns their address.
    ///
    /// # Errors
    /// Those of `put`.
    pub fn new<R: DeviceReal>(
        put: &mut dyn FnMut(&[u8]) -> Result<u64, DeviceError>,
        flow: WindowFlowMap<'_>,
    ) -> Result<Self, DeviceError> {
        let WindowFlowMap { nodes, times, grid, map, span, steps, keep } = flow;
        let real = R::from_f64;
        let maps: Vec<AxisMap<R>> = grid.axes.iter().map(|axis| AxisMap::new(axis, map.boundary)).collect();
        let (mut even, mut wrap, mut seam) = (0, 0, 0);
        let mut axes = Vec::new();
        for k in 0..3 {
            // Kernels for the plane never read a third axis.
            let axis = &maps[k.min(maps.len() - 1)];
            let mut data = AxisData {
                positions: 0,
                inverse: 0,
                begins: 0,
                first: axis.first,
                spacing: axis.spacing,
                density: real(0.0),
                high: axis.high,
                wrap: axis.wrap.unwrap_or(real(0.0)),
                nodes: axis.nodes as i32,
                last_cell: axis.last_cell as i32,
                intervals: 0,
                pad: R::IntPad::zeroed(),
            };
            if let Some(table) = &axis.table {
                data.positions = put(cast_slice(&table.positions))?;
                data.inverse = put(cast_slice(&table.inverse))?;
                data.begins = put(cast_slice(&table.begins))?;
                data.density = table.density;
                data.intervals = table.begins.len() as i32;
            } else {
                even |= 1 << k;
            }
            wrap |= i32::from(axis.wrap.is_some()) << k;
            seam |= i32::from(axis.seam) << k;
            axes.push(data);
        }
        let sphere = matches!(grid.geometry, Geometry::Sphere { .. });
        let spacing: [f64; 3] = std::array::from_fn(|k| axes[k].spacing);
        let scale = f64::from(nodes.scale);
        let (rate, radius) = match grid.geometry {
            Geometry::Cartesian => ([scale / spacing[0], scale / spacing[1], scale / spacing[2], 1.0], 1.0),
            Geometry::Sphere { radius } => ([scale / radius, scale / radius, scale / radius, scale / spacing[2]], radius),
        };
        let ends: [[f64; 2]; 3] = std::array::from_fn(|k| maps[k.min(maps.len() - 1)].ends());
        // As on the CPU: rounding of an angle computed from a unit vector must not end a path.
        let slack = |k: usize| if sphere && k < 2 { angle_slack(real(1f64.to_degrees() / spacing[k])) } else { real(0.0) };
        let end = |i: usize| -> [R; 3] { std::array::from_fn(|k| real(ends[k][i]) + if i == 0 { -slack(k) } else { slack(k) }) };
        let [low, high] = bounds(map.boundary, end(0), end(1));
        let [nx, ny, _] = grid.shape();
        let (longitude, latitude) = (&maps[0], &maps[1]);
        let middle = longitude.coordinate(longitude.high.to_f64() / 2.0);
        let (sine, cosine) = middle.to_radians().sin_cos();
        let data = GridData {
            row: nx as u32,
            plane: (nx * ny) as u32,
            axes: [axes[0], axes[1], axes[2]],
            rate: rate.map(real),
            low,
            high,
            ratios: std::array::from_fn(|i| std::array::from_fn(|j| real(spacing[i] / spacing[j]))),
            per_radian: [real(1f64.to_degrees() / spacing[0]), real(1f64.to_degrees() / spacing[1])],
            origin: [real(longitude.state(middle)), real(latitude.state(0.0))],
            turn: [real(cosine), real(sine)],
            poles: poles(latitude).map(real),
            pad: R::RealPad::zeroed(),
            middle,
            radius,
            level: spacing[2] / radius,
        };
        let stages: Vec<GridStep<R>> = stages(times, span.0, span.1, steps)
            .into_iter()
            .map(|step| GridStep {
                first: step.map(|(interval, _)| nodes.addresses[interval]),
                second: step.map(|(interval, _)| nodes.addresses[interval + 1]),
                weight: step.map(|(_, weight)| real(weight)),
                pad: R::RealPad::zeroed(),
            })
            .collect();
        let steps = put(cast_slice(&stages))?;
        let scaled = data.rate[..grid.dimensions() + usize::from(sphere)].iter().any(|r| *r != real(1.0));
        let cubic = map.interpolation == Interpolation::Cubic;
        let flag = |name: &str, value: bool| format!("{name}={}", u8::from(value));
        let defines = vec![
            format!("RW_REAL={}", R::NAME),
            format!("RW_AXES={}", grid.dimensions()),
            flag("RW_SPHERE", sphere),
            storage_define(nodes.storage),
            flag("RW_CUBIC", cubic),
            flag("RW_MISSING", nodes.missing),
            flag("RW_KEEP", keep),
            flag("RW_SCALED", scaled),
            format!("RW_EVEN={even}"),
            format!("RW_WRAP={wrap}"),
            format!("RW_SEAM={seam}"),
            flag("RW_DIFFERENCES", map.integrator == Integrator::Differences),
        ];
        Ok(Self { data: words(&data), steps, defines })
    }
}

/// `RW_STORAGE`, as `Storage` in `grid.cuh`.
pub(in crate::cuda) fn storage_define(storage: Storage) -> String {
    format!("RW_STORAGE={}", storage as u8)
}

/// Interval between snapshots and weight of its later snapshot, at start, middle and end of every step. A snapshot's own time belongs to the
/// interval that the particle enters next, so that the end of a step reads the same cell as the start of the next one.
pub fn stages(times: &[f64], from: f64, to: f64, steps: usize) -> Vec<[(usize, f64); 3]> {
    let last = times.len() - 1;
    let forward = to > from;
    let place = |time: f64| -> (usize, f64) {
        let interval = times.partition_point(|&t| t <= time).clamp(1, last) - 1;
        let weight = ((time - times[interval]) / (times[interval + 1] - times[interval])).clamp(0.0, 1.0);
        if weight < SAME_TIME {
            if forward || interval == 0 { (interval, 0.0) } else { (interval - 1, 1.0) }
        } else if weight > 1.0 - SAME_TIME {
            if forward && interval + 1 < last { (interval + 1, 0.0) } else { (interval, 1.0) }
        } else {
            (interval, weight)
        }
    };
    let halves = 2 * steps;
    (0..steps).map(|n| std::array::from_fn(|j| place(from + (to - from) * ((2 * n + j) as f64 / halves as f64)))).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_end_of_a_step_is_the_start_of_the_next() {
        let times = [0.0, 1.0, 2.0, 3.0];
        for (from, to) in [(0.0, 3.0), (3.0, 0.0)] {
            for steps in [1, 3, 6, 12] {
                let stages = stages(&times, from, to, steps);
                assert!(stages.windows(2).all(|pair| pair[0][2] == pair[1][0]), "{from} {to} {steps}: {stages:?}");
                // One change per interval, and none at the end.
                let changes = stages.iter().filter(|step| step[0].0 != step[2].0).count();
                assert!(steps < 3 || changes == 2, "{from} {to} {steps}: {changes}");
            }
        }
    }

    #[test]
    fn every_time_is_met() {
        let times = [0.0, 0.5, 2.0, 2.25, 5.0];
        for (from, to) in [(0.2, 4.9), (5.0, 0.0), (0.0, 5.0)] {
            for steps in [1, 2, 3, 7, 10] {
                for (n, step) in stages(&times, from, to, steps).iter().enumerate() {
                    for (j, &(i, w)) in step.iter().enumerate() {
                        let time = from + (to - from) * ((2 * n + j) as f64 / (2 * steps) as f64);
                        let met = times[i] * (1.0 - w) + times[i + 1] * w;
                        // Times within 1e-9 of an interval of at most 2.75 are taken as a snapshot's.
                        assert!((met - time).abs() < 3e-9, "{time} {met}");
                    }
                }
            }
        }
    }
}
