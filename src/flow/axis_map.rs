//! From state coordinates to cells, for one axis.
//!
//! A state coordinate is the distance from the axis' first node in mean spacings. On a uniform axis cell and fraction are its integer
//! and fractional part; on another one they are found in a table.

use super::Boundary;
use crate::field::Axis;
use crate::simd::{Gather, Mask, Real};

/// One axis, prepared.
#[derive(Debug, Clone)]
pub struct AxisMap<R> {
    /// Coordinate of the first node.
    pub first: f64,
    /// Mean spacing in coordinate units.
    pub spacing: f64,
    /// Number of nodes.
    pub nodes: u32,
    /// Index of the last cell.
    pub last_cell: u32,
    /// Whether the last cell lies between the last node and the first one's image.
    pub seam: bool,
    /// State coordinate of the last node (or image).
    pub high: R,
    /// After which length states repeat.
    wrap: Option<R>,
    table: Option<Table<R>>,
}

/// Unevenly spaced nodes.
#[derive(Debug, Clone)]
struct Table<R> {
    /// Node positions, with the image of the first one where the axis is periodic.
    positions: Vec<R>,
    /// 1 / length of each cell.
    inverse: Vec<R>,
    /// The cell in which each of evenly spaced intervals begins.
    begins: Vec<u32>,
    /// Intervals in a unit of length.
    density: R,
}

/// The table of an uneven axis, for other devices.
#[cfg_attr(not(feature = "cuda"), allow(dead_code))]
pub(crate) struct TableView<'a, R> {
    /// Node positions, with the image of the first one where the axis is periodic.
    pub positions: &'a [R],
    /// 1 / length of each cell.
    pub inverse: &'a [R],
    /// The cell in which each of evenly spaced intervals begins.
    pub begins: &'a [u32],
    /// Intervals in a unit of length.
    pub density: R,
}

/// Intervals a cell in [`Table::begins`]: more make the scan shorter.
const INTERVALS: usize = 4;

/// Where lanes are along one axis.
#[derive(Clone, Copy)]
pub struct Place<L: Gather> {
    /// Cell.
    pub cell: L::Cells,
    /// Position in it, 0 to 1.
    pub fraction: L,
    /// d fraction / d state; 0 where the state is held at an end of the axis.
    pub slope: L,
    /// Whether some slope is not 1.
    pub sloped: bool,
}

impl<R: Real> AxisMap<R> {
    /// Prepares an axis for particles with this edge policy.
    pub fn new(axis: &Axis, policy: Boundary) -> Self {
        let (first, cells) = (axis.first(), axis.cells());
        let spacing = (axis.last() - first) / cells as f64;
        let wrap = (axis.period().is_some() || policy == Boundary::Periodic).then(|| R::from_f64(cells as f64));
        // A periodic axis is even only when its seam is as wide as the other cells.
        let even = axis.uniform_step().is_some_and(|step| (step / spacing - 1.0).abs() < 1e-5);
        Self {
            first,
            spacing,
            nodes: axis.len() as u32,
            last_cell: cells as u32 - 1,
            seam: axis.period().is_some(),
            high: R::from_f64(cells as f64),
            wrap,
            table: (!even).then(|| Table::new(axis, first, spacing)),
        }
    }

    /// After which length states repeat.
    #[cfg_attr(not(feature = "cuda"), allow(dead_code))]
    pub(crate) fn wrap_length(&self) -> Option<R> {
        self.wrap
    }

    /// The table of an uneven axis.
    #[cfg_attr(not(feature = "cuda"), allow(dead_code))]
    pub(crate) fn table(&self) -> Option<TableView<'_, R>> {
        match &self.table {
            Some(table) => {
                Some(TableView { positions: &table.positions, inverse: &table.inverse, begins: &table.begins, density: table.density })
            }
            None => None,
        }
    }

    /// State coordinate of a domain coordinate.
    pub fn state(&self, coordinate: f64) -> f64 {
        (coordinate - self.first) / self.spacing
    }

    /// Domain coordinate of a state coordinate.
    pub fn coordinate(&self, state: f64) -> f64 {
        self.first + state * self.spacing
    }

    /// Ends within which a particle may go on.
    pub fn ends(&self) -> [f64; 2] {
        if self.wrap.is_some() { [f64::NEG_INFINITY, f64::INFINITY] } else { [0.0, self.high.to_f64()] }
    }

    /// Distances from the cell's first node to the nodes around it in cell lengths: the node before (negative), the node after next.
    /// None where there is no such node.
    pub fn reach(&self, cell: u32) -> [Option<f64>; 2] {
        let cells = self.last_cell as usize + 1;
        let i = cell as usize;
        let length = |cell: usize| self.table.as_ref().map_or(1.0, |t| 1.0 / t.inverse[cell].to_f64());
        let here = length(i);
        let before = if i > 0 { Some(i - 1) } else { self.seam.then_some(cells - 1) };
        let after = if i + 1 < cells { Some(i + 1) } else { self.seam.then_some(0) };
        [before.map(|b| -length(b) / here), after.map(|a| 1.0 + length(a) / here)]
    }

    /// Finds each lane's cell. Cells are in range whatever the state is.
    #[inline(always)]
    pub fn locate<L: Gather<Real = R>>(&self, state: L) -> Place<L> {
        let (mut held, mut slope, mut sloped) = (state, L::one(), false);
        if let Some(wrap) = self.wrap {
            let wrap = L::splat(wrap);
            held = state - wrap * (state / wrap).floor();
        } else {
            held = held.max(L::zero()).min(L::splat(self.high));
            let same = held.equal(state);
            if !same.all() {
                slope = L::select(same, slope, L::zero());
                sloped = true;
            }
        }
        match &self.table {
            None => {
                let (cell, base) = held.truncate(self.last_cell);
                Place { cell, fraction: held - base, slope, sloped }
            }
            Some(table) => {
                let found = L::cells_from_fn(|lane| table.find(held.lane(lane), self.last_cell));
                let at = |values: &[R]| L::from_fn(|lane| values[L::cell(&found, lane) as usize]);
                let inverse = at(&table.inverse);
                Place { cell: found, fraction: (held - at(&table.positions)) * inverse, slope: slope * inverse, sloped: true }
            }
        }
    }
}

impl<R: Real> Table<R> {
    fn new(axis: &Axis, first: f64, spacing: f64) -> Self {
        let mut positions: Vec<f64> = axis.coordinates().iter().map(|c| (c - first) / spacing).collect();
        if axis.period().is_some() {
            positions.push((axis.last() - first) / spacing);
        }
        let cells = positions.len() - 1;
        let intervals = cells * INTERVALS;
        let density = intervals as f64 / positions[cells];
        let begins =
            (0..intervals).map(|i| (positions.partition_point(|&p| p <= i as f64 / density).max(1) - 1).min(cells - 1) as u32).collect();
        let real = |values: Vec<f64>| values.into_iter().map(R::from_f64).collect::<Vec<R>>();
        let inverse = real(positions.windows(2).map(|w| 1.0 / (w[1] - w[0])).collect());
        Self { positions: real(positions), inverse, begins, density: R::from_f64(density) }
    }

    #[inline(always)]
    fn find(&self, position: R, last_cell: u32) -> u32 {
        // NaN and negative numbers become 0.
        let interval = ((position * self.density).to_f64() as usize).min(self.begins.len() - 1);
        let mut cell = self.begins[interval];
        while cell < last_cell && position >= self.positions[cell as usize + 1] {
            cell += 1;
        }
        while cell > 0 && position < self.positions[cell as usize] {
            cell -= 1;
        }
        cell
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn uneven_cells_are_found() {
        let axis = Axis::new("z", "m", vec![0.0, 1.0, 1.1, 5.0, 40.0]).unwrap();
        let map = AxisMap::<f64>::new(&axis, Boundary::Stop);
        for (coordinate, cell, fraction) in [(0.0, 0, 0.0), (0.5, 0, 0.5), (1.05, 1, 0.5), (4.999, 2, 3.899 / 3.9), (40.0, 3, 1.0)] {
            let place = map.locate(map.state(coordinate));
            assert_eq!(place.cell, cell);
            // Rounding only.
            assert!((place.fraction - fraction).abs() < 1e-13, "{coordinate}");
        }
        assert_eq!(map.locate(-3.0).slope, 0.0);
        assert!(map.locate(f64::NAN).cell <= 3);
    }

    #[test]
    fn a_periodic_axis_has_a_seam() {
        let axis = Axis::uniform("lon", "degrees", 0.0, 270.0, 4).unwrap().with_period(360.0);
        let map = AxisMap::<f64>::new(&axis, Boundary::Stop);
        let place = map.locate(map.state(-45.0));
        assert_eq!((place.cell, place.fraction, place.slope), (3, 0.5, 1.0));
        let uneven = AxisMap::<f64>::new(&Axis::uniform("lon", "", 0.0, 200.0, 5).unwrap().with_period(360.0), Boundary::Stop);
        let place = uneven.locate(uneven.state(280.0));
        assert_eq!(place.cell, 4);
        assert!((place.fraction - 0.5).abs() < 1e-14, "rounding only");
    }
}
