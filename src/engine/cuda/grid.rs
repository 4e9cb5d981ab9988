//! A window and a flow map as kernels see them.

use super::layout::{AxisData, DeviceReal, GridData, GridStep, Words, words};
use super::{DeviceError, Storage};
use crate::field::{Geometry, Grid};
use crate::flow::{AxisMap, FlowMap, Integrator, Interpolation, angle_slack, bounds, poles};

/// What a kernel for a window is launched with.
#[derive(Debug)]
pub struct GridArguments {
    /// `GridData`.
    pub data: Words,
    /// Address of the steps.
    pub steps: u64,
    /// Macros of `trace_grid.cu`.
    pub defines: Vec<String>,
}

/// The snapshots of a window as kernels see them.
#[derive(Debug, Clone)]
pub struct Nodes {
    /// Addresses, oldest first.
    pub addresses: Vec<u64>,
    /// How velocities are held.
    pub storage: Storage,
    /// What stored velocities are multiplied by.
    pub scale: f32,
    /// Whether some node is missing.
    pub missing: bool,
}

/// Beyond these times of an interval, a time is that of a snapshot (as the CPU's sampler has it).
const SAME_TIME: f64 = 1e-9;

impl GridArguments {
    /// Everything for `steps` steps over `span`. `keep`: keep the current cell in registers (see `grid.cuh`). `put` copies bytes to where
    /// the kernel can read them and returns their address.
    pub fn new<R: DeviceReal>(
        put: &mut dyn FnMut(&[u8]) -> Result<u64, DeviceError>,
        nodes: &Nodes,
        times: &[f64],
        grid: &Grid,
        map: &FlowMap,
        span: (f64, f64),
        steps: usize,
        keep: bool,
    ) -> Result<Self, DeviceError> {
        let maps: Vec<AxisMap<R>> = grid.axes.iter().map(|axis| AxisMap::new(axis, map.boundary)).collect();
        let (mut even, mut wrap, mut seam) = (0, 0, 0);
        let mut axes = Vec::new();
        for k in 0..3 {
            // A third axis that is not there is never read.
            let axis = &maps[k.min(maps.len() - 1)];
            let mut data = AxisData {
                positions: 0,
                inverse: 0,
                begins: 0,
                first: axis.first,
                spacing: axis.spacing,
                density: R::from_f64(0.0),
                high: axis.high,
                wrap: axis.wrap.unwrap_or(R::from_f64(0.0)),
                nodes: axis.nodes as i32,
                last_cell: axis.last_cell as i32,
                intervals: 0,
            };
            if let Some(table) = &axis.table {
                data.positions = put(bytes_of(&table.positions))?;
                data.inverse = put(bytes_of(&table.inverse))?;
                data.begins = put(bytes_of(&table.begins))?;
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
        // As on the CPU: an angle computed from a unit vector may miss by a few units in the last place.
        let slack = |k: usize| if sphere && k < 2 { angle_slack(R::from_f64(1f64.to_degrees() / spacing[k])) } else { R::from_f64(0.0) };
        let end = |i: usize| -> [R; 3] {
            std::array::from_fn(|k| if i == 0 { R::from_f64(ends[k][i]) - slack(k) } else { R::from_f64(ends[k][i]) + slack(k) })
        };
        let [low, high] = bounds(map.boundary, end(0), end(1));
        let [nx, ny, _] = grid.shape();
        let (longitude, latitude) = (&maps[0], &maps[1]);
        let middle = longitude.coordinate(longitude.high.to_f64() / 2.0);
        let (sine, cosine) = middle.to_radians().sin_cos();
        let real = R::from_f64;
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
            })
            .collect();
        let steps = put(bytes_of(&stages))?;
        let one = R::from_f64(1.0);
        let scaled = data.rate[..grid.dimensions() + usize::from(sphere)].iter().any(|r| *r != one);
        let cubic = map.interpolation == Interpolation::Cubic;
        let flag = |name: &str, value: bool| format!("{name}={}", u8::from(value));
        let defines = vec![
            format!("RW_REAL={}", R::NAME),
            format!("RW_AXES={}", grid.dimensions()),
            flag("RW_SPHERE", sphere),
            storage_define(nodes.storage),
            flag("RW_CUBIC", cubic),
            flag("RW_MARKS", nodes.missing),
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
pub(super) fn storage_define(storage: Storage) -> String {
    format!("RW_STORAGE={}", storage as u8)
}

/// The bytes of plain numbers.
fn bytes_of<T: Copy>(values: &[T]) -> &[u8] {
    // SAFETY: callers pass numbers and structures of numbers without padding between or behind them that matters: kernels read fields
    // alone. `u8` has no alignment.
    unsafe { std::slice::from_raw_parts(values.as_ptr().cast(), size_of_val(values)) }
}

/// For start, middle and end of every step: the interval between snapshots, and the weight of its later one. A snapshot's own time is put
/// into the interval that the particle comes to next: the end of a step then reads the cell that the next one starts with.
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
                // One change an interval, and none at the end, where there is nothing to come.
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
