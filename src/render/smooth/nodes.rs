//! The surrogate as a picture sees it: log-stretch at the nodes of a regular grid, interpolated multilinearly.

use crate::Transfer;
use rayon::prelude::*;
use ridgewatch_field::UnitPoint;
use std::ops::Range;
use std::sync::Arc;

/// Cells along the edge of a brick.
pub const BRICK: usize = 8;

/// Log-stretch at nodes i / (n - 1) of the unit domain, x fastest. Two-dimensional flows have one node along z.
#[derive(Debug, Clone)]
pub struct Nodes {
    shape: [usize; 3],
    values: Arc<Vec<f32>>,
    brick_shape: [usize; 3],
    /// Largest value at the nodes of each brick, faces included.
    brick_max: Vec<f32>,
}

/// Bricks along x, y, z of a grid with `shape` nodes.
pub fn brick_shape(shape: [usize; 3]) -> [usize; 3] {
    shape.map(|n| (n - 1).div_ceil(BRICK).max(1))
}

/// Nodes along x, y, z that belong to a brick alone: without its upper faces, unless the grid ends there.
pub fn own_nodes(shape: [usize; 3], brick: usize) -> [Range<usize>; 3] {
    let bricks = brick_shape(shape);
    let index = [brick % bricks[0], brick / bricks[0] % bricks[1], brick / (bricks[0] * bricks[1])];
    [0, 1, 2].map(|k| index[k] * BRICK..if index[k] + 1 == bricks[k] { shape[k] } else { (index[k] + 1) * BRICK })
}

impl Nodes {
    /// Takes the values of a grid with `shape` nodes along x, y, z.
    ///
    /// # Panics
    /// If the number of values is not that of the nodes, or x or y has fewer than two.
    pub fn new(shape: [usize; 3], values: Arc<Vec<f32>>) -> Self {
        assert_eq!(values.len(), shape.iter().product::<usize>(), "one value a node");
        assert!(shape[0] > 1 && shape[1] > 1 && shape[2] > 0, "{shape:?}");
        let brick_shape = brick_shape(shape);
        let largest = |brick: usize| {
            let index = [brick % brick_shape[0], brick / brick_shape[0] % brick_shape[1], brick / (brick_shape[0] * brick_shape[1])];
            let range = |k: usize| index[k] * BRICK..((index[k] + 1) * BRICK + 1).min(shape[k]);
            let mut largest = f32::NEG_INFINITY;
            for (z, y) in range(2).flat_map(|z| range(1).map(move |y| (z, y))) {
                let row = (z * shape[1] + y) * shape[0];
                largest = values[row + range(0).start..row + range(0).end].iter().copied().fold(largest, f32::max);
            }
            largest
        };
        let bricks = brick_shape.iter().product();
        let brick_max = (0..bricks).into_par_iter().with_min_len(64).map(largest).collect();
        Self { shape, values, brick_shape, brick_max }
    }

    /// Gives up the values, x fastest.
    pub fn into_values(self) -> Vec<f32> {
        Arc::unwrap_or_clone(self.values)
    }

    /// Nodes along x, y, z.
    pub fn shape(&self) -> [usize; 3] {
        self.shape
    }

    /// Values, x fastest.
    pub fn values(&self) -> &[f32] {
        &self.values
    }

    /// Largest value at the nodes of each brick, x fastest.
    pub fn brick_max(&self) -> &[f32] {
        &self.brick_max
    }

    /// Where a node lies. A flow without z is asked in the middle of its slab.
    pub fn unit(shape: [usize; 3], index: usize) -> UnitPoint {
        let node = [index % shape[0], index / shape[0] % shape[1], index / (shape[0] * shape[1])];
        UnitPoint(std::array::from_fn(|k| if shape[k] > 1 { node[k] as f32 / (shape[k] - 1) as f32 } else { 0.5 }))
    }

    /// Cell and fraction along an axis.
    #[inline]
    fn place(&self, axis: usize, unit: f32) -> (usize, f32) {
        let cells = self.shape[axis] - 1;
        let position = unit.clamp(0.0, 1.0) * cells as f32;
        let cell = (position as usize).min(cells - 1);
        (cell, position - cell as f32)
    }

    /// Log-stretch at a point, moved into [0, 1].
    #[inline]
    pub fn at(&self, unit: UnitPoint) -> f32 {
        let ((x, fx), (y, fy)) = (self.place(0, unit.0[0]), self.place(1, unit.0[1]));
        let (row, values) = (self.shape[0], &**self.values);
        let between = |a: f32, b: f32, f: f32| (b - a).mul_add(f, a);
        let plane = |first: usize| {
            let near = &values[first..first + row + 2];
            between(between(near[0], near[1], fx), between(near[row], near[row + 1], fx), fy)
        };
        let first = y * row + x;
        if self.shape[2] == 1 {
            return plane(first);
        }
        let (z, fz) = self.place(2, unit.0[2]);
        let layer = row * self.shape[1];
        between(plane(z * layer + first), plane((z + 1) * layer + first), fz)
    }

    /// The lower and upper corner of the brick around a point, if the transfer function shows nothing of that brick.
    #[inline]
    pub(super) fn empty_brick(&self, unit: UnitPoint, transfer: &Transfer, inverse_tau: f32) -> Option<(UnitPoint, UnitPoint)> {
        let (mut brick, mut stride) = (0, 1);
        let (mut low, mut high) = ([0.0; 3], [1.0; 3]);
        for k in 0..3 {
            if self.shape[k] > 1 {
                let own = self.place(k, unit.0[k]).0 / BRICK;
                brick += own * stride;
                let per_cell = 1.0 / (self.shape[k] - 1) as f32;
                low[k] = (own * BRICK) as f32 * per_cell;
                high[k] = (((own + 1) * BRICK) as f32 * per_cell).min(1.0);
            }
            stride *= self.brick_shape[k];
        }
        (transfer.ramp(self.brick_max[brick] * inverse_tau) <= 0.0).then_some((UnitPoint(low), UnitPoint(high)))
    }
}
