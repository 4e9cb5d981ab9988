//! Velocity between nodes and snapshots: linear in time, linear or cubic in space, with the exact derivative of that interpolant.
//!
//! For each lane the hot path loads pairs of nodes adjacent along x and interpolates them along t, y and z as one vector. It transposes the
//! pairs into lanes before the last interpolation, along x.
//!
//! On periodic longitudes, nodes near a pole are so close that the slope along x is a small difference of large numbers over a tiny length.
//! There, and for cubics, neighbours are subtracted before the interpolation. The subtraction is exact, so that a row of equal nodes (a pole)
//! has slope 0 in every precision.
//!
//! Beyond the end of an axis that is not periodic, the velocity is that at the end, since a stage of a step may lie slightly outside. Its
//! derivative across the end is 0.
//!
//! The cubic interpolation is a Hermite cubic along each axis. Its slopes at the nodes are the central differences of the neighbours
//! (Catmull and Rom 1974), also for unevenly spaced nodes; at an end of the axis the difference is one-sided. A missing node in the stencil
//! makes the velocity missing.

use super::axis_map::{AxisMap, GridLocation};
use super::stencil::Stencil;
use super::{Boundary, FlowError, Interpolation};
use ridgewatch_field::{Grid, Snapshot, Window};
use ridgewatch_simd::{Gather, Lanes, NodePair, NodePairReader, Real, array};
use std::sync::Arc;

/// Interpolates the velocity of a window of snapshots. `N` is the number of grid axes.
#[derive(Debug, Clone)]
pub struct Sampler<R, const N: usize> {
    snapshots: Vec<Arc<Snapshot>>,
    times: Vec<f64>,
    pub axes: [AxisMap<R>; N],
    /// Factors from the four components of a node to state units per time; 1 for a mark.
    unit_factors: [f64; 4],
    row: usize,
    plane: usize,
    interpolation: Interpolation,
    /// True if some axis has a cell between its last and its first node.
    has_seams: bool,
}

/// The snapshots that bracket a time, with their weights.
#[derive(Debug, Clone)]
pub struct GridStage<R> {
    first: usize,
    /// True if the time is that of the first snapshot, so that the next one is not read.
    at_snapshot: bool,
    weights: [[R; 4]; 2],
}

/// Velocity, its derivatives along each axis, and a mark that is NaN if a node was missing. `M` is 3, or 4 if the mark of a node is a
/// component of the velocity too (levels on the sphere).
pub struct Sample<L, const N: usize, const M: usize> {
    pub velocity: [L; M],
    /// `slopes[axis][component]`, per state unit.
    pub slopes: [[L; M]; N],
    pub mark: L,
}

/// Times closer than this to that of a snapshot, in snapshot intervals, are equal to it.
const SAME_TIME: f64 = 1e-9;

impl<R: Real, const N: usize> Sampler<R, N> {
    /// Prepares a window. `unit_factors` convert the four components of a node to state units per time.
    ///
    /// # Errors
    /// An unbounded domain, too many nodes, or a snapshot whose number of nodes is not that of the grid.
    pub fn new(
        window: &Window,
        grid: &Grid,
        boundary: Boundary,
        interpolation: Interpolation,
        unit_factors: impl Fn(&[AxisMap<R>; N]) -> [f64; 4],
    ) -> Result<Self, FlowError> {
        if boundary == Boundary::Unbounded {
            return Err(FlowError::NotOnGrids { boundary });
        }
        if u32::try_from(grid.nodes()).is_err() {
            return Err(FlowError::GridTooLarge { nodes: grid.nodes() });
        }
        let snapshots: Vec<_> = window.snapshots().cloned().collect();
        // Unchecked reads of nodes rely on this.
        if let Some(odd) = snapshots.iter().find(|s| s.nodes.len() != grid.nodes()) {
            return Err(FlowError::SnapshotShape { time: odd.time, found: odd.nodes.len(), expected: grid.nodes() });
        }
        let axes: [AxisMap<R>; N] = array(|k| AxisMap::new(&grid.axes[k], boundary));
        let [nx, ny, _] = grid.shape();
        Ok(Self {
            times: snapshots.iter().map(|s| s.time).collect(),
            snapshots,
            unit_factors: unit_factors(&axes),
            row: nx,
            plane: nx * ny,
            interpolation,
            has_seams: axes.iter().any(|a| a.seam),
            axes,
        })
    }

    /// Times of the snapshots.
    pub fn times(&self) -> &[f64] {
        &self.times
    }

    /// Snapshots and weights at a time within the window (the nearest snapshot outside of it).
    pub fn stage(&self, time: f64) -> GridStage<R> {
        let last = self.times.len() - 1;
        let mut first = self.times.partition_point(|&t| t <= time).clamp(1, last.max(1)) - 1;
        let mut weight = 0.0;
        if first < last {
            weight = ((time - self.times[first]) / (self.times[first + 1] - self.times[first])).clamp(0.0, 1.0);
            if weight > 1.0 - SAME_TIME {
                (first, weight) = (first + 1, 0.0);
            }
        }
        let at_snapshot = weight < SAME_TIME;
        if at_snapshot {
            weight = 0.0;
        }
        let weights = [1.0 - weight, weight].map(|w| self.unit_factors.map(|factor| R::from_f64(factor * w)));
        GridStage { first, at_snapshot, weights }
    }

    /// Morton key (Z-order) of the cell of a state; cells share a key if there are too many for 32 bits.
    pub fn sort_key(&self, state: &[f64; N]) -> u32 {
        let bits = 32 / N as u32;
        let mut key = 0u32;
        for k in 0..N {
            let cells = f64::from(self.axes[k].last_cell) + 1.0;
            let share = (state[k] / cells).clamp(0.0, 1.0);
            // One index per cell of the axis, or fewer if the bits do not suffice.
            let index = (share * cells.min(f64::from(1u32 << bits) - 1.0)) as u32;
            for bit in 0..bits {
                key |= (index >> bit & 1) << (bit * N as u32 + k as u32);
            }
        }
        key
    }

    #[inline(always)]
    fn locate<L: Gather<Real = R>>(&self, x: &[L; N]) -> [GridLocation<L>; N] {
        let mut locations = [self.axes[0].locate(x[0]); N];
        for k in 1..N {
            locations[k] = self.axes[k].locate(x[k]);
        }
        locations
    }

    /// Velocity and mark.
    #[inline(always)]
    pub fn value<L: Gather<Real = R>, const M: usize>(&self, stage: &GridStage<R>, x: &[L; N]) -> ([L; M], L) {
        let locations = self.locate(x);
        match self.interpolation {
            Interpolation::Linear => {
                let [pair] = if self.has_seams {
                    self.linear_across_seams::<L, 1>(stage, &locations)
                } else {
                    self.linear_inside::<L, 1>(stage, &locations)
                };
                (lerp_x(&pair, locations[0].fraction), pair[3] + pair[7])
            }
            Interpolation::Cubic => {
                let [pair] = self.cubic::<L, 1>(stage, &locations);
                (array(|c| pair[c] + pair[c + 4]), pair[3] + pair[7])
            }
        }
    }

    /// Velocity, derivatives and mark.
    #[inline(always)]
    pub fn sample<L: Gather<Real = R>, const M: usize>(&self, stage: &GridStage<R>, x: &[L; N]) -> Sample<L, N, M> {
        let locations = self.locate(x);
        let mut sample = match self.interpolation {
            Interpolation::Linear => {
                // The value and its derivatives along y and z; with seams also that along x.
                let fraction = locations[0].fraction;
                let mut slopes = [[L::zero(); M]; N];
                let along = |pair: &[L; 8]| array(|c| pair[c + 4] - pair[c]);
                let pairs = if self.has_seams {
                    let found = self.linear_across_seams::<L, 4>(stage, &locations);
                    slopes[0] = array(|c| found[3][c] + found[3][c + 4]);
                    array(|k| found[k])
                } else {
                    let pairs: [[L; 8]; N] = self.linear_inside(stage, &locations);
                    slopes[0] = along(&pairs[0]);
                    pairs
                };
                for k in 1..N {
                    slopes[k] = lerp_x(&pairs[k], fraction);
                }
                let velocity = lerp_x(&pairs[0], fraction);
                Sample { velocity, slopes, mark: pairs[0][3] + pairs[0][7] }
            }
            Interpolation::Cubic => {
                let pairs = self.cubic::<L, 4>(stage, &locations);
                let joined = |k: usize| array(|c| pairs[k][c] + pairs[k][c + 4]);
                Sample { velocity: joined(0), slopes: array(|k| joined(k + 1)), mark: pairs[0][3] + pairs[0][7] }
            }
        };
        if locations.iter().any(|p| p.scaled) {
            for k in 0..N {
                sample.slopes[k] = array(|c| sample.slopes[k][c] * locations[k].slope);
            }
        }
        sample
    }

    /// Node pairs interpolated along t, y and z (`[0]`) and, if K > 1, their derivatives along y and z.
    #[inline(always)]
    fn linear_inside<L: Gather<Real = R>, const K: usize>(&self, stage: &GridStage<R>, locations: &[GridLocation<L>; N]) -> [[L; 8]; K] {
        let first = self.snapshots[stage.first].nodes.as_ptr();
        let weights = array(|i| L::Pair::repeat(stage.weights[i]));
        let mut flat = locations[N - 1].cell;
        for k in (0..N - 1).rev() {
            flat = L::flatten(flat, self.axes[k].nodes, locations[k].cell);
        }
        let (row, plane) = (self.row, self.plane);
        if stage.at_snapshot {
            L::gather(&InteriorReader::<L, N, true> { first, second: first, weights, flat, row, plane, locations })
        } else {
            let second = self.snapshots[stage.first + 1].nodes.as_ptr();
            L::gather(&InteriorReader::<L, N, false> { first, second, weights, flat, row, plane, locations })
        }
    }

    /// [`Self::linear_inside`] for cells whose nodes may lie at opposite ends of an axis. If K > 3, the sum of both halves of `[3]` is the
    /// derivative along x.
    #[inline(never)]
    fn linear_across_seams<L: Gather<Real = R>, const K: usize>(
        &self,
        stage: &GridStage<R>,
        locations: &[GridLocation<L>; N],
    ) -> [[L; 8]; K] {
        L::gather(&SeamReader { nodes: self.nodes(stage), sampler: self, locations })
    }

    /// Sums over the stencil: the value and, if K > 1, its derivatives along x, y and z. The caller adds the two halves of each.
    #[inline(never)]
    fn cubic<L: Gather<Real = R>, const K: usize>(&self, stage: &GridStage<R>, locations: &[GridLocation<L>; N]) -> [[L; 8]; K] {
        L::gather(&CubicReader { nodes: self.nodes(stage), sampler: self, locations })
    }

    fn nodes<P: NodePair<Real = R>>(&self, stage: &GridStage<R>) -> TimeBracket<'_, P> {
        let second = (!stage.at_snapshot).then(|| self.snapshots[stage.first + 1].nodes.as_slice());
        TimeBracket { first: &self.snapshots[stage.first].nodes, second, weights: array(|i| P::repeat(stage.weights[i])) }
    }
}

/// The nodes of the snapshots that bracket a time; `second` is `None` if the time is that of the first.
struct TimeBracket<'a, P> {
    first: &'a [[f32; 4]],
    second: Option<&'a [[f32; 4]]>,
    weights: [P; 2],
}

impl<P: NodePair> TimeBracket<'_, P> {
    /// Pairs of nodes interpolated in time, and the same pairs after subtraction of the second node of the first pair. The subtraction
    /// comes first, so that it is exact.
    #[inline(always)]
    fn pairs<const K: usize>(&self, at: [[usize; 2]; K]) -> ([P; K], [P; K]) {
        let raw = |nodes: &[[f32; 4]]| -> [P; K] { array(|k| P::from_nodes(nodes[at[k][0]], nodes[at[k][1]])) };
        let first = raw(self.first);
        let common = first[0].repeat_second();
        let mut values: [P; K] = array(|k| first[k] * self.weights[0]);
        let mut differences: [P; K] = array(|k| (first[k] - common) * self.weights[0]);
        if let Some(second) = self.second {
            let second = raw(second);
            let common = second[0].repeat_second();
            values = array(|k| second[k].mul_add(self.weights[1], values[k]));
            differences = array(|k| (second[k] - common).mul_add(self.weights[1], differences[k]));
        }
        (values, differences)
    }
}

/// Linear interpolation in cells whose nodes along x are adjacent in memory.
struct InteriorReader<'a, L: Gather, const N: usize, const AT_SNAPSHOT: bool> {
    first: *const [f32; 4],
    second: *const [f32; 4],
    weights: [L::Pair; 2],
    /// Index of the first node of each cell.
    flat: L::Cells,
    row: usize,
    plane: usize,
    locations: &'a [GridLocation<L>; N],
}

impl<L: Gather, const N: usize, const AT_SNAPSHOT: bool, const K: usize> NodePairReader<L::Pair, K>
    for InteriorReader<'_, L, N, AT_SNAPSHOT>
{
    #[inline(always)]
    fn read_pairs(&self, lane: usize) -> [L::Pair; K] {
        let base = L::cell(&self.flat, lane) as usize;
        let fetch = |offset: usize| {
            // SAFETY: each cell index is at most the number of nodes of its axis minus 2 (`truncate`, `find`; no axis has a seam here).
            // Hence all nodes of the cell lie within the snapshot, whose length `Sampler::new` has checked.
            unsafe {
                let a = L::Pair::load_adjacent(self.first.add(base + offset)) * self.weights[0];
                if AT_SNAPSHOT { a } else { L::Pair::load_adjacent(self.second.add(base + offset)).mul_add(self.weights[1], a) }
            }
        };
        let (row, plane) = (self.row, self.plane);
        let y = L::Pair::splat(self.locations[1].fraction.lane(lane));
        if N == 2 {
            bilinear(y, [fetch(0), fetch(row)])
        } else {
            let z = L::Pair::splat(self.locations[N - 1].fraction.lane(lane));
            trilinear(y, z, [fetch(0), fetch(row), fetch(plane), fetch(plane + row)])
        }
    }
}

/// Linear interpolation in any cell, also across a seam.
struct SeamReader<'a, L: Gather, const N: usize> {
    nodes: TimeBracket<'a, L::Pair>,
    sampler: &'a Sampler<L::Real, N>,
    locations: &'a [GridLocation<L>; N],
}

impl<L: Gather, const N: usize, const K: usize> NodePairReader<L::Pair, K> for SeamReader<'_, L, N> {
    #[inline(always)]
    fn read_pairs(&self, lane: usize) -> [L::Pair; K] {
        let ends: [[usize; 2]; N] = array(|k| {
            let cell = L::cell(&self.locations[k].cell, lane);
            let next = if cell + 1 == self.sampler.axes[k].nodes { 0 } else { cell + 1 };
            [cell as usize, next as usize]
        });
        let fetch = |y: usize, z: usize| {
            let base = ends[1][y] * self.sampler.row + if N == 3 { ends[N - 1][z] * self.sampler.plane } else { 0 };
            let ([pair], [difference]) = self.nodes.pairs([[base + ends[0][0], base + ends[0][1]]]);
            // Second node minus first node; the other half is 0.
            (pair, -difference)
        };
        let y = L::Pair::splat(self.locations[1].fraction.lane(lane));
        if N == 2 {
            let rows = [fetch(0, 0), fetch(1, 0)];
            let mut out = bilinear(y, array(|i| rows[i].0));
            if K > 3 {
                [out[3]] = bilinear(y, array(|i| rows[i].1));
            }
            out
        } else {
            let z = L::Pair::splat(self.locations[N - 1].fraction.lane(lane));
            let rows = [fetch(0, 0), fetch(1, 0), fetch(0, 1), fetch(1, 1)];
            let mut out = trilinear(y, z, array(|i| rows[i].0));
            if K > 3 {
                [out[3]] = trilinear(y, z, array(|i| rows[i].1));
            }
            out
        }
    }
}

/// Cubic interpolation.
struct CubicReader<'a, L: Gather, const N: usize> {
    nodes: TimeBracket<'a, L::Pair>,
    sampler: &'a Sampler<L::Real, N>,
    locations: &'a [GridLocation<L>; N],
}

impl<L: Gather, const N: usize, const K: usize> NodePairReader<L::Pair, K> for CubicReader<'_, L, N> {
    #[inline(always)]
    fn read_pairs(&self, lane: usize) -> [L::Pair; K] {
        let stencils: [Stencil<L::Real>; N] =
            array(|k| Stencil::new(&self.sampler.axes[k], L::cell(&self.locations[k].cell, lane), self.locations[k].fraction.lane(lane)));
        let (x, y) = (&stencils[0], &stencils[1]);
        let spread = |w: &[L::Real; 4]| [L::Pair::splat_nodes(w[0], w[1]), L::Pair::splat_nodes(w[2], w[3])];
        let (weights_x, slopes_x) = (spread(&x.weights), spread(&x.slopes));
        let mut sums = [L::Pair::zero(); K];
        for iz in 0..if N == 3 { 4 } else { 1 } {
            let (z_weight, z_slope, z_base) = if N == 3 {
                let z = &stencils[N - 1];
                (z.weights[iz], z.slopes[iz], z.nodes[iz] * self.sampler.plane)
            } else {
                (L::Real::one(), L::Real::zero(), 0)
            };
            for iy in 0..4 {
                let base = z_base + y.nodes[iy] * self.sampler.row;
                let (halves, differences) =
                    self.nodes.pairs([[base + x.nodes[0], base + x.nodes[1]], [base + x.nodes[2], base + x.nodes[3]]]);
                let row = halves[0].mul_add(weights_x[0], halves[1] * weights_x[1]);
                let weight = L::Pair::splat(y.weights[iy] * z_weight);
                sums[0] = row.mul_add(weight, sums[0]);
                if K > 1 {
                    // The weights of a slope sum to 0, so that a constant may be subtracted from all nodes.
                    let row_slope = differences[0].mul_add(slopes_x[0], differences[1] * slopes_x[1]);
                    sums[1] = row_slope.mul_add(weight, sums[1]);
                    sums[2] = row.mul_add(L::Pair::splat(y.slopes[iy] * z_weight), sums[2]);
                    sums[3] = row.mul_add(L::Pair::splat(y.weights[iy] * z_slope), sums[3]);
                }
            }
        }
        sums
    }
}

/// Interpolates along x.
#[inline(always)]
fn lerp_x<L: Lanes, const M: usize>(pair: &[L; 8], fraction: L) -> [L; M] {
    array(|c| fraction.mul_add(pair[c + 4] - pair[c], pair[c]))
}

/// Value and, if K > 1, derivative along y of two rows.
#[inline(always)]
fn bilinear<P: Lanes, const K: usize>(y: P, rows: [P; 2]) -> [P; K] {
    let slope = rows[1] - rows[0];
    let mut out = [y.mul_add(slope, rows[0]); K];
    if K > 1 {
        out[1] = slope;
    }
    out
}

/// Value and, if K > 1, derivatives along y and z of four rows (y fastest).
#[inline(always)]
fn trilinear<P: Lanes, const K: usize>(y: P, z: P, rows: [P; 4]) -> [P; K] {
    let (near, far) = (rows[1] - rows[0], rows[3] - rows[2]);
    let start = y.mul_add(near, rows[0]);
    let slope = y.mul_add(far, rows[2]) - start;
    let mut out = [z.mul_add(slope, start); K];
    if K > 2 {
        out[1] = z.mul_add(far - near, near);
        out[2] = slope;
    }
    out
}
