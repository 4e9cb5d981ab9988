//! WRF: components on the faces of the cells (Arakawa C grid, Arakawa & Lamb 1977) and levels that follow the terrain, interpolated
//! to heights.
//!
//! The grid holds faces and centres, so that linear interpolation on it is, horizontally, exactly the linear interpolation of each
//! component from its own faces: nothing is averaged first. Vertically, each column is interpolated linearly between its own levels.
//! Their heights are (PH + PHB) / g on the full levels (of w), and half way between them on the half levels (of u and v).
//!
//! Positions count cells from the first centre: centres are at 0, 1, 2, ..., faces at -0.5, 0.5, ....

use super::axes::{AxisPlan, Quantity};
use super::column::{in_column, in_layer};
use super::component::{ComponentPlan, SquaredErrors, read_component};
use super::nest::{Nest, Shift, places};
use super::own_axes::LinearWeight;
use crate::cf::coordinate::Kind;
use crate::error::SourceError;
use crate::formats::DataFile;
use ridgewatch_field::{Axis, AxisFault};

/// Acceleration of gravity in WRF, m/s^2.
const GRAVITY: f64 = 9.81;

/// How to read a WRF file onto heights.
#[derive(Debug, Clone)]
pub struct Staggered {
    /// Perturbation and base-state geopotential on full levels.
    pub geopotential: [ComponentPlan; 2],
    /// Map scale factors at the points of u and v, if the file has them.
    pub scale: [Option<ComponentPlan>; 2],
    pub cells: Cells,
    /// Heights of the grid, metres.
    pub heights: Vec<f64>,
    /// Distances between centres along x and y, metres of the projection.
    pub step: [f64; 2],
    /// Place of the grid; `None` if the file does not say.
    pub nest: Option<Nest>,
    /// Places of the grid at the times of the archive.
    pub reach: Reach,
    /// Description of the resampling.
    pub what: String,
}

/// Minimum and maximum shift along x and y.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Reach {
    pub least: Shift,
    pub greatest: Shift,
}

impl Reach {
    /// Union with another reach.
    pub fn with(self, other: Self) -> Self {
        let union = |f: fn(isize, isize) -> isize, a: Shift, b: Shift| [f(a[0], b[0]), f(a[1], b[1])];
        Self { least: union(isize::min, self.least, other.least), greatest: union(isize::max, self.greatest, other.greatest) }
    }
}

/// Cells of the file and the nodes of the grid on them.
#[derive(Debug, Clone, Copy)]
pub struct Cells {
    /// Centres along x and y, half levels.
    pub count: [usize; 3],
    /// Nodes of the grid for each cell, along x and y.
    pub fineness: usize,
}

impl Cells {
    /// Positions of the nodes along x or y.
    fn places(&self, axis: usize) -> Vec<f64> {
        (0..(self.count[axis] - 1) * self.fineness + 1).map(|a| a as f64 / self.fineness as f64).collect()
    }

    /// Weights at positions, for a component whose points are centres or, on a staggered axis, faces.
    fn weights(&self, axis: usize, places: &[f64], faces: bool) -> Vec<LinearWeight> {
        let (shift, count) = if faces { (0.5, self.count[axis] + 1) } else { (0.0, self.count[axis]) };
        places.iter().map(|p| LinearWeight::at(p + shift, count)).collect()
    }

    /// Points of a component along x and y.
    fn points(&self, which: usize) -> [usize; 2] {
        [0, 1].map(|k| self.count[k] + usize::from(which == k))
    }
}

/// Interpolates levels on planes of `mx` x `my` points to other points of the plane.
fn spread(values: &[f32], [mx, my]: [usize; 2], [x, y]: &[Vec<LinearWeight>; 2]) -> Vec<f32> {
    let mut out = Vec::with_capacity(values.len() / (mx * my) * x.len() * y.len());
    for plane in values.chunks_exact(mx * my) {
        for wy in y {
            out.extend(x.iter().map(|wx| wy.of(|j| wx.of(|i| plane[j * mx + i]))));
        }
    }
    out
}

fn values(file: &DataFile, plan: &ComponentPlan, entry: usize) -> Result<Vec<f32>, SourceError> {
    read_component(file, plan, &plan.file_order(), entry)
}

impl Staggered {
    /// Heights of the full levels at the centres.
    pub fn full_levels(&self, file: &DataFile, entry: usize) -> Result<Vec<f32>, SourceError> {
        let mut heights = values(file, &self.geopotential[0], entry)?;
        let base = values(file, &self.geopotential[1], entry)?;
        heights.iter_mut().zip(&base).for_each(|(h, b)| *h = ((f64::from(*h) + f64::from(*b)) / GRAVITY) as f32);
        Ok(heights)
    }

    /// A component at its own points, in m/s of the projection's plane.
    fn component(&self, file: &DataFile, frame: &[ComponentPlan], which: usize, entry: usize) -> Result<Vec<f32>, SourceError> {
        let mut component = values(file, &frame[which], entry)?;
        if let Some(Some(plan)) = self.scale.get(which) {
            let scale = values(file, plan, entry)?;
            component.chunks_exact_mut(scale.len()).for_each(|plane| plane.iter_mut().zip(&scale).for_each(|(v, s)| *v *= s));
        }
        Ok(component)
    }

    /// Reads one entry along time onto the grid. Missing below the ground, above the highest full level, and outside a moving nest.
    pub fn read(&self, file: &DataFile, frame: &[ComponentPlan], entry: usize) -> Result<Vec<Vec<f32>>, SourceError> {
        let own = self.on_own_cells(file, frame, entry)?;
        if self.reach == Reach::default() {
            return Ok(own);
        }
        let shift = self.nest.as_ref().map_or(Ok([0; 2]), |nest| nest.shift(file, entry))?;
        // A file that changed since it was opened may lie anywhere.
        if (0..2).any(|k| shift[k] < self.reach.least[k] || shift[k] > self.reach.greatest[k]) {
            return Err(file.listing.read_error(&frame[0].name, "it changed since the archive was opened").into());
        }
        let fineness = self.cells.fineness;
        let nodes = [0, 1].map(|k| self.cells.places(k).len());
        let all = [0, 1].map(|k| nodes[k] + (self.reach.greatest[k] - self.reach.least[k]) as usize * fineness);
        let from = [0, 1].map(|k| (shift[k] - self.reach.least[k]) as usize * fineness);
        let in_domain = |values: &Vec<f32>| {
            let mut out = vec![f32::NAN; all[0] * all[1] * self.heights.len()];
            for (row, line) in values.chunks_exact(nodes[0]).enumerate() {
                let (level, y) = (row / nodes[1], row % nodes[1]);
                out[(level * all[1] + from[1] + y) * all[0] + from[0]..][..nodes[0]].copy_from_slice(line);
            }
            out
        };
        Ok(own.iter().map(in_domain).collect())
    }

    /// Reads one entry along time onto the nodes on the file's own cells.
    fn on_own_cells(&self, file: &DataFile, frame: &[ComponentPlan], entry: usize) -> Result<Vec<Vec<f32>>, SourceError> {
        let places = [0, 1].map(|k| self.cells.places(k));
        let centres = [0, 1].map(|k| self.cells.weights(k, &places[k], false));
        let plane = places[0].len() * places[1].len();
        let [nx, ny, half_levels] = self.cells.count;
        let full = spread(&self.full_levels(file, entry)?, [nx, ny], &centres);
        let mut out = Vec::with_capacity(3);
        for which in 0..frame.len() {
            let values = self.component(file, frame, which, entry)?;
            let weights = [0, 1].map(|k| self.cells.weights(k, &places[k], which == k));
            let values = spread(&values, self.cells.points(which), &weights);
            let mut on_heights = vec![f32::NAN; plane * self.heights.len()];
            for point in 0..plane {
                let at_full = |k: usize| full[k * plane + point];
                let at_half = |k: usize| 0.5 * (at_full(k) + at_full(k + 1));
                let value = |k: usize| values[k * plane + point];
                for (level, &z) in self.heights.iter().enumerate() {
                    let z = z as f32;
                    let found = match which {
                        2 => in_column(z, half_levels + 1, at_full, value),
                        // Between the ground and the lowest half level the wind is that of the half level; above the highest alike.
                        _ => in_layer(z, [at_full(0), at_full(half_levels)], half_levels, at_half, value),
                    };
                    on_heights[level * plane + point] = found.unwrap_or(f32::NAN);
                }
            }
            out.push(on_heights);
        }
        Ok(out)
    }

    /// Axes of x and y, in metres. The first centre of the first time is at half a cell.
    pub fn horizontal(&self) -> Result<[AxisPlan; 2], AxisFault> {
        let plan = |k: usize, name: &str, kind: Kind| {
            let Reach { least, greatest } = self.reach;
            let Cells { count, fineness } = self.cells;
            let nodes = (count[k] - 1 + (greatest[k] - least[k]) as usize) * fineness + 1;
            let place = |a: usize| least[k] as f64 + a as f64 / fineness as f64;
            let axis = Axis::new(name, "m", (0..nodes).map(|a| (place(a) + 0.5) * self.step[k]).collect())?;
            Ok(AxisPlan::made(kind, axis, Quantity::Length))
        };
        Ok([plan(0, "west_east", Kind::X)?, plan(1, "south_north", Kind::Y)?])
    }

    /// Longitudes and latitudes at the centres of all places of the grid in the first `entries` times of a file: x, y and the degrees, x fastest.
    pub fn positions(&self, file: &DataFile, entries: usize) -> Option<(Vec<f64>, Vec<f64>, Vec<[f64; 2]>)> {
        let ([x, y], degrees) = places(file, self.nest.as_ref()?, entries)?;
        let metres = |k: usize, cells: Vec<f64>| cells.into_iter().map(|a| (a + 0.5) * self.step[k]).collect();
        Some((metres(0, x), metres(1, y), degrees))
    }

    /// Root mean squares over the points of the file, m/s: of the interpolation on the grid minus the file's values, and of the file's values.
    pub fn error(&self, file: &DataFile, frame: &[ComponentPlan], entry: usize) -> Result<[f64; 2], SourceError> {
        let grid = self.on_own_cells(file, frame, entry)?;
        let full = self.full_levels(file, entry)?;
        let Cells { count: [nx, ny, nz], fineness } = self.cells;
        let nodes = [0, 1].map(|k| self.cells.places(k).len());
        let heights: Vec<f32> = self.heights.iter().map(|&z| z as f32).collect();
        let mut sums = SquaredErrors::default();
        for which in 0..frame.len() {
            let points = self.cells.points(which);
            let levels = if which == 2 { nz + 1 } else { nz };
            for (n, &value) in self.component(file, frame, which, entry)?.iter().enumerate() {
                let (i, j, k) = (n % points[0], n / points[0] % points[1], n / (points[0] * points[1]));
                let place = [i as f64 - if which == 0 { 0.5 } else { 0.0 }, j as f64 - if which == 1 { 0.5 } else { 0.0 }];
                if k >= levels || place[0] < 0.0 || place[1] < 0.0 || place[0] > (nx - 1) as f64 || place[1] > (ny - 1) as f64 {
                    continue;
                }
                let here = [0, 1].map(|a| LinearWeight::at(place[a], self.cells.count[a]));
                let at_full = |k: usize| here[1].of(|j| here[0].of(|i| full[(k * ny + j) * nx + i]));
                let z = if which == 2 { at_full(k) } else { 0.5 * (at_full(k) + at_full(k + 1)) };
                let on_grid = [0, 1].map(|a| LinearWeight::at(place[a] * fineness as f64, nodes[a]));
                let at_level = |l: usize| on_grid[1].of(|b| on_grid[0].of(|a| grid[which][(l * nodes[1] + b) * nodes[0] + a]));
                if let Some(found) = in_column(z, heights.len(), |l| heights[l], at_level) {
                    sums.add(found.into(), value.into());
                }
            }
        }
        Ok(sums.root_mean_squares())
    }

    /// Note about a grid that moves.
    pub fn movement(&self) -> Option<String> {
        let [x, y] = [0, 1].map(|k| self.reach.greatest[k] - self.reach.least[k]);
        (self.reach != Reach::default()).then(|| {
            format!(
                "the grid moves, by up to {x} and {y} cells along x and y: each time lies in its place, in a domain that holds all places; \
                 velocities are missing outside the grid of their time"
            )
        })
    }

    /// Mean heights of full and half levels over the plane. The lowest is that of the lowest ground. The highest is the minimum of the
    /// highest half level, so that every column reaches it.
    pub fn mean_heights(&self, full: &[f32]) -> Vec<f64> {
        let plane = self.cells.count[0] * self.cells.count[1];
        let means: Vec<f64> = full.chunks_exact(plane).map(|p| p.iter().map(|&z| f64::from(z)).sum::<f64>() / plane as f64).collect();
        let lowest = full[..plane].iter().map(|&z| f64::from(z)).fold(f64::INFINITY, f64::min);
        let mut heights = vec![lowest.min(means[0])];
        for pair in means.windows(2) {
            heights.extend([0.5 * (pair[0] + pair[1]), pair[1]]);
        }
        // u lies on half levels.
        let (below, top) = (&full[full.len() - 2 * plane..][..plane], &full[full.len() - plane..]);
        let highest = below.iter().zip(top).map(|(a, b)| 0.5 * (f64::from(*a) + f64::from(*b))).fold(f64::INFINITY, f64::min);
        heights.retain(|&z| z < highest);
        heights.push(highest);
        heights
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn weights_meet_faces_and_centres() {
        let cells = Cells { count: [3, 2, 2], fineness: 2 };
        let places = cells.places(0);
        assert_eq!(places, [0.0, 0.5, 1.0, 1.5, 2.0]);
        // u lies on faces -0.5, 0.5, 1.5, 2.5: nodes on faces are its own values, nodes on centres are half way between two.
        let u = [10.0f32, 20.0, 40.0, 80.0];
        let on_grid: Vec<f32> = cells.weights(0, &places, true).iter().map(|t| t.of(|i| u[i])).collect();
        assert_eq!(on_grid, [15.0, 20.0, 30.0, 40.0, 60.0]);
        let centred: Vec<f32> = cells.weights(0, &places, false).iter().map(|t| t.of(|i| u[i])).collect();
        assert_eq!(centred, [10.0, 15.0, 20.0, 30.0, 40.0]);
    }
}
