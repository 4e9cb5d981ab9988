//! Conversion of velocities from metres per second to coordinates of the grid: cells per interval (index metric) or degrees per
//! second.

use super::axes::{AxisPlan, Quantity};
use ridgewatch_field::EARTH_RADIUS;

/// Factors along the axes: u is multiplied by `u_x[i] u_y[j]`, v by `v_y[j]`, w by `w_z[k]`.
pub struct VelocityScale {
    u_x: Vec<f64>,
    u_y: Vec<f64>,
    v_y: Vec<f64>,
    w_z: Vec<f64>,
}

impl VelocityScale {
    /// To cells per second, by the local spacing of the nodes.
    pub fn to_cells(axes: &[AxisPlan]) -> Self {
        let mut this = Self::to_degrees(axes);
        for (factors, plan) in [(&mut this.u_x, axes.first()), (&mut this.v_y, axes.get(1)), (&mut this.w_z, axes.get(2))] {
            if let Some(plan) = plan {
                factors.iter_mut().zip(spacing(plan)).for_each(|(f, s)| *f /= s);
            }
        }
        this
    }

    /// To coordinate units per second: degrees along an angle, unchanged along other axes.
    pub fn to_degrees(axes: &[AxisPlan]) -> Self {
        let degrees = |plan: &AxisPlan| if plan.quantity == Quantity::Angle { (1.0 / EARTH_RADIUS).to_degrees() } else { 1.0 };
        let ones = |k: usize| axes.get(k).map_or_else(Vec::new, |a| vec![degrees(a); a.axis.len()]);
        let latitudes = axes[1].axis.coordinates();
        let u_y = if axes[0].quantity == Quantity::Angle && axes[1].quantity == Quantity::Angle {
            // A cell has no width at a pole: take the circle half a cell away.
            let last = latitudes.len() - 1;
            let half = [(latitudes[1] - latitudes[0]) / 2.0, (latitudes[last] - latitudes[last - 1]) / 2.0];
            let widest = |l: f64| l.abs().min(90.0 - if l < 0.0 { half[0] } else { half[1] });
            latitudes.iter().map(|&l| 1.0 / widest(l).to_radians().cos()).collect()
        } else {
            vec![1.0; latitudes.len()]
        };
        Self { u_x: ones(0), u_y, v_y: ones(1), w_z: ones(2) }
    }

    /// The inverse conversion.
    pub fn inverse(mut self) -> Self {
        for factors in [&mut self.u_x, &mut self.u_y, &mut self.v_y, &mut self.w_z] {
            factors.iter_mut().for_each(|f| *f = 1.0 / *f);
        }
        self
    }

    /// Converts u, v and, if present, w; a time unit has `interval` seconds.
    pub fn apply(&self, components: &mut [Vec<f32>], [nx, ny, _]: [usize; 3], interval: f64) {
        for (which, values) in components.iter_mut().enumerate() {
            for (row, line) in values.chunks_exact_mut(nx).enumerate() {
                let (y, z) = (row % ny, row / ny);
                let row_factor = interval
                    * match which {
                        0 => self.u_y[y],
                        1 => self.v_y[y],
                        _ => self.w_z[z],
                    };
                for (x, value) in line.iter_mut().enumerate() {
                    let factor = if which == 0 { row_factor * self.u_x[x] } else { row_factor };
                    *value = (f64::from(*value) * factor) as f32;
                }
            }
        }
    }
}

/// Distance between neighbours at each node: half the way to each side.
fn spacing(plan: &AxisPlan) -> Vec<f64> {
    let (x, n) = (plan.axis.coordinates(), plan.axis.len());
    let at = |i: usize| {
        let (low, high) = (i.saturating_sub(1), (i + 1).min(n - 1));
        (x[high] - x[low]) / (high - low) as f64
    };
    (0..n).map(at).collect()
}
