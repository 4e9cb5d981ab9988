//! A window and a flow map as kernels see them.

use super::layout::{AxisData, DeviceReal, GridData, GridStep, Words, words};
use super::{DeviceError, Storage};
use crate::field::{Geometry, Grid};
use crate::flow::{AxisMap, Boundary, FlowMap, Integrator, Interpolation};
use crate::simd::Real;

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
                wrap: axis.wrap_length().unwrap_or(R::from_f64(0.0)),
                nodes: axis.nodes as i32,
                last_cell: axis.last_cell as i32,
                intervals: 0,
            };
            if let Some(table) = axis.table() {
                data.positions = put(bytes_of(table.positions))?;
                data.inverse = put(bytes_of(table.inverse))?;
                data.begins = put(bytes_of(table.begins))?;
                data.density = table.density;
                data.intervals = table.begins.len() as i32;
            } else {
                even |= 1 << k;
            }
            wrap |= i32::from(axis.wrap_length().is_some()) << k;
            seam |= i32::from(axis.seam) << k;
            axes.push(data);
        }
        let sphere = matches!(grid.geometry, Geometry::Sphere { .. });
        let spacing: [f64; 3] = std::array::from_fn(|k| axes[k].spacing);
        let scale = f64::from(nodes.scale);
        let rate = match grid.geometry {
            Geometry::Cartesian => spacing.map(|s| scale / s),
            Geometry::Sphere { radius } => [scale / radius; 3],
        };
        let ends: [[f64; 2]; 3] = std::array::from_fn(|k| maps[k.min(maps.len() - 1)].ends());
        let end = |i: usize| -> [R; 3] { std::array::from_fn(|k| R::from_f64(ends[k][i])) };
        let (low, high) = match map.boundary {
            Boundary::Stop => (end(0), end(1)),
            Boundary::Zero => (end(0).map(R::above), end(1).map(R::below)),
            Boundary::Clamp | Boundary::Periodic | Boundary::Unbounded => {
                ([R::from_f64(f64::NEG_INFINITY); 3], [R::from_f64(f64::INFINITY); 3])
            }
        };
        let [nx, ny, _] = grid.shape();
        let (longitude, latitude) = (&maps[0], &maps[1]);
        let middle = longitude.coordinate(longitude.high.to_f64() / 2.0);
        let (sine, cosine) = middle.to_radians().sin_cos();
        let real = R::from_f64;
        let data = GridData {
            snapshots: put(bytes_of(&nodes.addresses))?,
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
            middle,
        };
        let stages = stages::<R>(times, span.0, span.1, steps);
        let steps = put(bytes_of(&stages))?;
        let one = R::from_f64(1.0);
        let scaled = data.rate[..if sphere { 3 } else { grid.dimensions() }].iter().any(|r| *r != one);
        let cubic = map.interpolation == Interpolation::Cubic;
        let flag = |name: &str, value: bool| format!("{name}={}", u8::from(value));
        let defines = vec![
            format!("RW_REAL={}", R::NAME),
            format!("RW_AXES={}", grid.dimensions()),
            flag("RW_SPHERE", sphere),
            format!("RW_STORAGE={}", u8::from(nodes.storage == Storage::F16)),
            flag("RW_CUBIC", cubic),
            flag("RW_MARKS", nodes.missing),
            // In double precision the kept cell does not fit into the registers.
            flag("RW_KEEP", keep && size_of::<R>() == size_of::<f32>()),
            flag("RW_SCALED", scaled),
            format!("RW_EVEN={even}"),
            format!("RW_WRAP={wrap}"),
            format!("RW_SEAM={seam}"),
            flag("RW_DIFFERENCES", map.integrator == Integrator::Differences),
        ];
        Ok(Self { data: words(&data), steps, defines })
    }
}

/// The bytes of plain numbers.
fn bytes_of<T: Copy>(values: &[T]) -> &[u8] {
    // SAFETY: callers pass numbers and structures of numbers without padding between or behind them that matters: kernels read fields
    // alone. `u8` has no alignment.
    unsafe { std::slice::from_raw_parts(values.as_ptr().cast(), size_of_val(values)) }
}

/// The times of every step. Where a time is a snapshot's own, it is put into the interval of the step's middle, so that a kernel that
/// keeps the current cell does not read another one for it.
pub fn stages<R: Real>(times: &[f64], from: f64, to: f64, steps: usize) -> Vec<GridStep<R>> {
    let last = times.len() - 1;
    // (first snapshot, weight of the next one); weight 0 at a snapshot's own time.
    let place = |time: f64| -> (usize, f64) {
        let first = times.partition_point(|&t| t <= time).clamp(1, last.max(1)) - 1;
        if first >= last {
            return (last, 0.0);
        }
        let weight = ((time - times[first]) / (times[first + 1] - times[first])).clamp(0.0, 1.0);
        if weight > 1.0 - SAME_TIME {
            (first + 1, 0.0)
        } else if weight < SAME_TIME {
            (first, 0.0)
        } else {
            (first, weight)
        }
    };
    let halves = 2 * steps;
    (0..steps)
        .map(|n| {
            let at: [(usize, f64); 3] = std::array::from_fn(|j| place(from + (to - from) * ((2 * n + j) as f64 / halves as f64)));
            let middle = if at[1].1 > 0.0 {
                at[1].0
            } else {
                // The step spans intervals: that of its start.
                let back = at[0].0 < at[1].0;
                if back && at[1].0 > 0 { at[1].0 - 1 } else { at[1].0.min(last - 1) }
            };
            let mut step = GridStep { interval: [0; 3], weight: [R::from_f64(0.0); 3] };
            for (j, (first, weight)) in at.into_iter().enumerate() {
                let (interval, weight) = match (first, weight) {
                    (first, weight) if weight > 0.0 => (first, weight),
                    (first, _) if first == middle + 1 || first == last => (first - 1, 1.0),
                    (first, _) => (first, 0.0),
                };
                step.interval[j] = interval as i32;
                step.weight[j] = R::from_f64(weight);
            }
            step
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_step_within_an_interval_stays_in_it() {
        let times = [0.0, 1.0, 2.0, 3.0];
        for (from, to) in [(0.0, 3.0), (3.0, 0.0)] {
            for steps in [3, 6, 12] {
                for step in stages::<f64>(&times, from, to, steps) {
                    assert!(step.interval.iter().all(|i| *i == step.interval[0]), "{from} {to} {steps}: {step:?}");
                }
            }
        }
    }

    #[test]
    fn every_time_is_met() {
        let times = [0.0, 0.5, 2.0, 2.25, 5.0];
        for (from, to) in [(0.2, 4.9), (5.0, 0.0), (0.0, 5.0)] {
            for steps in [1, 2, 3, 7, 10] {
                for (n, step) in stages::<f64>(&times, from, to, steps).iter().enumerate() {
                    for j in 0..3 {
                        let time = from + (to - from) * ((2 * n + j) as f64 / (2 * steps) as f64);
                        let (i, w) = (step.interval[j] as usize, step.weight[j]);
                        let met = times[i] * (1.0 - w) + times[i + 1] * w;
                        // Times within 1e-9 of an interval of at most 2.75 are taken as a snapshot's.
                        assert!((met - time).abs() < 3e-9, "{time} {met}");
                    }
                }
            }
        }
    }
}
