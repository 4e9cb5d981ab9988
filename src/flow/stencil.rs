//! Nodes and weights of the cubic interpolation along one axis: a Hermite cubic with Catmull-Rom slopes.

use super::axis_map::AxisMap;
use ridgewatch_simd::Real;

/// The four nodes that a Hermite cubic reads along one axis.
pub struct Stencil<R> {
    /// Previous node, both nodes of the cell, next node.
    pub nodes: [usize; 4],
    /// Weights of the values at the four nodes.
    pub weights: [R; 4],
    /// d weights / d fraction.
    pub slopes: [R; 4],
}

impl<R: Real> Stencil<R> {
    #[inline(always)]
    /// Stencil for a location at `fraction` of a cell.
    pub fn new(axis: &AxisMap<R>, cell: u32, fraction: R) -> Self {
        let f = fraction.to_f64();
        let wrapped = |index: u32| if index >= axis.nodes { (index - axis.nodes) as usize } else { index as usize };
        let here = [cell as usize, wrapped(cell + 1)];
        let [before, after] = axis.reach(cell);
        // Hermite basis: values at 0 and 1, slopes at 0 and 1.
        let basis = [(1.0 + 2.0 * f) * (1.0 - f) * (1.0 - f), f * f * (3.0 - 2.0 * f), f * (1.0 - f) * (1.0 - f), f * f * (f - 1.0)];
        let derivative = [6.0 * f * (f - 1.0), 6.0 * f * (1.0 - f), (1.0 - f) * (1.0 - 3.0 * f), f * (3.0 * f - 2.0)];
        let combine = |h: [f64; 4]| {
            let mut w = [0.0, h[0], h[1], 0.0];
            // Slope at the first node: (second - previous) / (1 - before), or second - first at the end of the axis.
            match before {
                Some(b) => {
                    w[0] -= h[2] / (1.0 - b);
                    w[2] += h[2] / (1.0 - b);
                }
                None => {
                    w[1] -= h[2];
                    w[2] += h[2];
                }
            }
            match after {
                Some(a) => {
                    w[1] -= h[3] / a;
                    w[3] += h[3] / a;
                }
                None => {
                    w[1] -= h[3];
                    w[2] += h[3];
                }
            }
            w.map(R::from_f64)
        };
        let outer = [
            before.map_or(here[0], |_| if cell == 0 { axis.nodes as usize - 1 } else { cell as usize - 1 }),
            after.map_or(here[1], |_| wrapped(cell + 2)),
        ];
        Self { nodes: [outer[0], here[0], here[1], outer[1]], weights: combine(basis), slopes: combine(derivative) }
    }
}
