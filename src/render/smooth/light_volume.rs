//! Optical depth to the light, tabulated once for a window, a light and a transfer function.
//!
//! For a directional light the table is sheared: its columns are light rays. The depth is summed along each column, plane by plane, away from the
//! light, so that it is exact along the light up to quadrature, and interpolation acts across the rays only. Where light enters through a side wall,
//! neighbouring columns are in the box for different lengths; so the extinction is continued outside, and what lies before the wall is subtracted.
//! For a point light each node of a plain grid is marched by itself.

use super::medium::{Medium, node_spacing};
use crate::Light;
use rayon::prelude::*;
use ridgewatch_field::UnitPoint;
use std::ops::RangeInclusive;

/// Optical depth to the light at any point of the box.
#[derive(Debug, Clone)]
pub struct LightVolume {
    grid: LightGrid,
    /// Grid positions along x, y, z are unit coordinates times `cells`.
    cells: [f32; 3],
    depth: Vec<f32>,
}

/// Where the values of a light volume lie.
#[derive(Debug, Clone, PartialEq)]
pub struct LightGrid {
    /// Nodes along x, y, z.
    pub nodes: [usize; 3],
    /// `Some` for a directional light.
    pub shear: Option<Shear>,
    /// Stored values along the first lateral axis, the second, and the planes; x, y, z for a point light.
    pub size: [usize; 3],
    /// Quadrature points from plane to plane.
    pub samples: usize,
    /// Step of the quadrature to a point light, scene units.
    pub step: f32,
}

/// Axes and slopes of the columns.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Shear {
    /// Axis across the planes, and the two others.
    pub major: usize,
    pub lateral: [usize; 2],
    /// True if the light is on the high side of the major axis.
    pub from_above: bool,
    /// Lateral shift per plane, walking away from the light.
    pub slope: [f32; 2],
    /// Scene length along the light per plane.
    pub length: f32,
}

/// Stored columns beyond the box on either side.
pub const MARGIN: i32 = 2;

impl Shear {
    fn offset(&self, lateral: usize, plane: usize) -> i32 {
        (plane as f32 * self.slope[lateral]).floor() as i32
    }
}

impl LightGrid {
    /// The finest grid over a box with these edges (scene units) and a surrogate of `shape` nodes that has at most about `max_values` values.
    /// The distance between its values is that of the nodes divided by `refine`, if the limit allows.
    pub fn new(edges: [f64; 3], shape: [usize; 3], light: &Light, max_values: usize, refine: usize) -> Self {
        let spacing = node_spacing(edges, shape);
        // Quarters of the distance between nodes, from the finest that is asked for.
        let grid_of = |quarter: usize| -> [usize; 3] {
            std::array::from_fn(|k| {
                if shape[k] > 1 {
                    (4 * (shape[k] - 1)).div_ceil(quarter) + 1
                } else {
                    ((4.0 * edges[k] / (spacing * quarter as f64)).ceil() as usize + 1).clamp(2, 1025)
                }
            })
        };
        let fits = |quarter: &usize| grid_of(*quarter).iter().map(|n| n + 4).product::<usize>() <= max_values;
        let quarter = (1..=256_usize).map(|i| (4 * i).div_ceil(refine.max(1))).find(fits).unwrap_or(1024);
        let nodes = grid_of(quarter);
        // Two quadrature points in the distance of two nodes at least.
        let samples = 2 * (quarter * refine).div_ceil(4);
        let step = (spacing * quarter as f64 / 4.0) as f32 / samples as f32;
        let Light::Directional { toward, .. } = light else {
            return Self { nodes, shear: None, size: nodes, samples, step };
        };
        let delta: [f64; 3] = std::array::from_fn(|k| toward[k] / edges[k] * (nodes[k] - 1) as f64);
        // The axis along which the light passes most nodes, so that no slope is above 1; of nearly equal ones that with the fewest planes.
        let most = delta.iter().fold(0.0, |most: f64, passed| most.max(passed.abs()));
        let major = (0..3).filter(|&k| delta[k].abs() >= 0.999 * most).min_by_key(|&k| nodes[k]).unwrap_or(0);
        let lateral = [usize::from(major == 0), if major == 2 { 1 } else { 2 }];
        let shear = Shear {
            major,
            lateral,
            from_above: delta[major] > 0.0,
            slope: lateral.map(|k| (-delta[k] / delta[major].abs()) as f32),
            length: (1.0 / delta[major].abs()) as f32,
        };
        let size = [nodes[lateral[0]] + 2 * MARGIN as usize, nodes[lateral[1]] + 2 * MARGIN as usize, nodes[major]];
        Self { nodes, shear: Some(shear), size, samples, step }
    }

    /// Number of stored values.
    pub fn values(&self) -> usize {
        self.size.iter().product()
    }

    /// Numbers of the columns along a lateral axis that any plane stores.
    pub fn columns(&self, shear: &Shear, side: usize) -> RangeInclusive<i32> {
        let ends = [shear.offset(side, 0), shear.offset(side, self.size[2] - 1)];
        -MARGIN - ends[0].max(ends[1])..=self.size[side] as i32 - 1 - MARGIN - ends[0].min(ends[1])
    }
}

impl LightVolume {
    /// Tabulates the depth on the grid of [`LightGrid::new`].
    pub fn new(medium: &Medium<'_>, max_values: usize, refine: usize) -> Self {
        let space = medium.scene.space;
        let grid = LightGrid::new(space.edges(), medium.nodes.shape(), medium.scene.light, max_values, refine);
        let cells = grid.nodes.map(|n| (n - 1) as f32);
        let depth = match grid.shear {
            Some(shear) => Self::sheared(medium, &grid, &shear),
            None => (0..grid.values())
                .into_par_iter()
                .map(|i| {
                    let [nx, ny, _] = grid.nodes;
                    let node = [i % nx, i / nx % ny, i / (nx * ny)];
                    let unit = UnitPoint(std::array::from_fn(|k| node[k] as f32 / cells[k]));
                    medium.depth_to_light(space.grid_of_unit(unit), grid.step)
                })
                .collect(),
        };
        Self { grid, cells, depth }
    }

    fn sheared(medium: &Medium<'_>, grid: &LightGrid, shear: &Shear) -> Vec<f32> {
        let cells = grid.nodes.map(|n| (n - 1) as f32);
        let (size, samples) = (grid.size, grid.samples);
        let (across, down) = (grid.columns(shear, 0), grid.columns(shear, 1));
        let (first, width) = ([*across.start(), *down.start()], (across.end() - across.start() + 1) as usize);
        // Plane by plane, so that the nodes in use stay in the caches.
        let mut sums = vec![0.0_f32; width * (down.end() - down.start() + 1) as usize];
        let mut depth = vec![0.0; grid.values()];
        for (plane, values) in depth.chunks_mut(size[0] * size[1]).enumerate() {
            if plane > 0 {
                // Columns that are far from the box between the two planes gain nothing.
                let near = |side: usize| {
                    let shifts = [plane - 1, plane].map(|plane| plane as f32 * shear.slope[side]);
                    let low = -shifts[0].max(shifts[1]).ceil() as i32 - MARGIN - first[side];
                    let high = (cells[shear.lateral[side]] - shifts[0].min(shifts[1])).ceil() as i32 + MARGIN - first[side];
                    low.max(0) as usize..high.max(0) as usize + 1
                };
                let (across, down) = (near(0), near(1));
                sums.par_chunks_mut(width).enumerate().skip(down.start).take(down.len()).for_each(|(w, row)| {
                    for v in across.start..across.end.min(width) {
                        for m in 0..samples {
                            let x = (plane - 1) as f32 + (m as f32 + 0.5) / samples as f32;
                            let start = [first[0] + v as i32, first[1] + w as i32];
                            row[v] += Self::extinction_at(medium, shear, &cells, start, x) * (shear.length / samples as f32);
                        }
                    }
                });
            }
            values.par_chunks_mut(size[0]).enumerate().for_each(|(c, values)| {
                let w = (c as i32 - MARGIN - shear.offset(1, plane) - first[1]) as usize;
                let v = (-MARGIN - shear.offset(0, plane) - first[0]) as usize;
                values.copy_from_slice(&sums[w * width + v..][..size[0]]);
            });
        }
        depth
    }

    /// Extinction on a column at plane coordinate `x`: that of the wall in the margin around the box, 0 beyond.
    fn extinction_at(medium: &Medium<'_>, shear: &Shear, cells: &[f32; 3], column: [i32; 2], x: f32) -> f32 {
        let mut place = [0.0; 3];
        place[shear.major] = if shear.from_above { cells[shear.major] - x } else { x };
        for side in 0..2 {
            let k = shear.lateral[side];
            place[k] = column[side] as f32 + x * shear.slope[side];
            if place[k] < -MARGIN as f32 || place[k] > cells[k] + MARGIN as f32 {
                return 0.0;
            }
        }
        medium.extinction(UnitPoint(std::array::from_fn(|k| (place[k] / cells[k]).clamp(0.0, 1.0))))
    }

    /// Optical depth from a point to the light.
    #[inline]
    pub fn at(&self, unit: UnitPoint) -> f32 {
        let place: [f32; 3] = std::array::from_fn(|k| unit.0[k].clamp(0.0, 1.0) * self.cells[k]);
        let lower = |x: f32, n: usize| (x.floor() as usize).min(n - 2);
        let between = |a: f32, b: f32, f: f32| (b - a).mul_add(f, a);
        let size = self.grid.size;
        let Some(shear) = &self.grid.shear else {
            let cell: [usize; 3] = std::array::from_fn(|k| lower(place[k], size[k]));
            let f: [f32; 3] = std::array::from_fn(|k| place[k] - cell[k] as f32);
            let value = |x: usize, y: usize, z: usize| self.depth[((cell[2] + z) * size[1] + cell[1] + y) * size[0] + cell[0] + x];
            let plane = |z| between(between(value(0, 0, z), value(1, 0, z), f[0]), between(value(0, 1, z), value(1, 1, z), f[0]), f[1]);
            return between(plane(0), plane(1), f[2]);
        };
        let x = if shear.from_above { self.cells[shear.major] - place[shear.major] } else { place[shear.major] };
        let column: [f32; 2] = std::array::from_fn(|side| place[shear.lateral[side]] - x * shear.slope[side]);
        let first = column.map(f32::floor);
        let f: [f32; 2] = std::array::from_fn(|side| column[side] - first[side]);
        let at = |plane: usize| {
            // The clamp guards against rounding at the outermost columns.
            let index = |side: usize| (first[side] as i32 + MARGIN + shear.offset(side, plane)).clamp(0, size[side] as i32 - 2) as usize;
            let start = (plane * size[1] + index(1)) * size[0] + index(0);
            let near = &self.depth[start..start + size[0] + 2];
            let row = size[0];
            between(between(near[0], near[1], f[0]), between(near[row], near[row + 1], f[0]), f[1])
        };
        let depth = |x: f32| {
            let plane = lower(x, size[2]);
            between(at(plane), at(plane + 1), x - plane as f32)
        };
        // Where the light came in, if not through the first plane.
        let wall = |side: usize| if shear.slope[side] < 0.0 { self.cells[shear.lateral[side]] } else { 0.0 };
        let entry = |side: usize| if shear.slope[side] == 0.0 { 0.0 } else { (wall(side) - column[side]) / shear.slope[side] };
        let entry = entry(0).max(entry(1)).min(x);
        if entry > 0.0 { depth(x) - depth(entry) } else { depth(x) }
    }
}
