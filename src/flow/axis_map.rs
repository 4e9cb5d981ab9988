//! Converts state coordinates to cells along one axis.
//!
//! A state coordinate is the distance from the first node of the axis in mean spacings. On a uniform axis, cell and fraction are its
//! integer and fractional part. On other axes they come from a lookup table.

use super::Boundary;
use ridgewatch_field::Axis;
use ridgewatch_simd::{Gather, Mask, Real};

/// One axis, prepared for lookups.
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
    /// True if the last cell lies between the last node and the image of the first.
    pub seam: bool,
    /// State coordinate of the last node, or of the image of the first.
    pub high: R,
    /// Period of the state coordinate; `None` if it does not repeat.
    pub wrap: Option<R>,
    /// Lookup table; `None` if the axis is even.
    pub table: Option<Table<R>>,
}

/// Lookup table of unevenly spaced nodes.
#[derive(Debug, Clone)]
pub struct Table<R> {
    /// Positions of the nodes and, on a periodic axis, of the image of the first.
    pub positions: Vec<R>,
    /// 1 / length of each cell.
    pub inverse: Vec<R>,
    /// The cell in which each interval of even length begins.
    pub begins: Vec<u32>,
    /// Intervals per unit of length.
    pub density: R,
}

/// Intervals per cell in [`Table::begins`]; more intervals make the scan shorter.
const INTERVALS: usize = 4;

/// Cell and fraction of all lanes along one axis.
#[derive(Clone, Copy)]
pub struct GridLocation<L: Gather> {
    /// Cell.
    pub cell: L::Cells,
    /// Position in the cell, 0 to 1.
    pub fraction: L,
    /// d fraction / d state; 0 if the state is clamped to an end of the axis.
    pub slope: L,
    /// True if some slope may differ from 1.
    pub scaled: bool,
}

/// Distance beyond the end of an axis, in cell lengths, up to which the velocity still has the slope of the last cell: what rounding moves a point that
/// lies on the edge. The slope would be 0 there, and the FTLE of the edge with it.
const EDGE: f64 = 1.0 / 1024.0;

impl<R: Real> AxisMap<R> {
    /// Prepares an axis for particles with a boundary policy.
    pub fn new(axis: &Axis, boundary: Boundary) -> Self {
        let (first, cells) = (axis.first(), axis.cells());
        let spacing = (axis.last() - first) / cells as f64;
        let wrap = (axis.period().is_some() || boundary == Boundary::Periodic).then(|| R::from_f64(cells as f64));
        // A periodic axis is even only if its seam is as wide as the other cells.
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

    /// State coordinate of a domain coordinate.
    pub fn state(&self, coordinate: f64) -> f64 {
        (coordinate - self.first) / self.spacing
    }

    /// Domain coordinate of a state coordinate.
    pub fn coordinate(&self, state: f64) -> f64 {
        self.first + state * self.spacing
    }

    /// State coordinates between which a particle continues.
    pub fn ends(&self) -> [f64; 2] {
        if self.wrap.is_some() { [f64::NEG_INFINITY, f64::INFINITY] } else { [0.0, self.high.to_f64()] }
    }

    /// Distances, in cell lengths, from the first node of the cell to the previous node (negative) and to the node after the second. `None`
    /// if that node does not exist.
    pub fn reach(&self, cell: u32) -> [Option<f64>; 2] {
        let cells = self.last_cell as usize + 1;
        let i = cell as usize;
        let length = |cell: usize| self.table.as_ref().map_or(1.0, |t| 1.0 / t.inverse[cell].to_f64());
        let here = length(i);
        let before = if i > 0 { Some(i - 1) } else { self.seam.then_some(cells - 1) };
        let after = if i + 1 < cells { Some(i + 1) } else { self.seam.then_some(0) };
        [before.map(|b| -length(b) / here), after.map(|a| 1.0 + length(a) / here)]
    }

    /// Finds the cell of each lane. Cells are in range for every state, including NaN.
    #[inline(always)]
    pub fn locate<L: Gather<Real = R>>(&self, state: L) -> GridLocation<L> {
        let (mut held, mut slope, mut scaled) = (state, L::one(), false);
        if let Some(wrap) = self.wrap {
            let wrap = L::splat(wrap);
            held = state - wrap * (state / wrap).floor();
        } else {
            held = held.max(L::zero()).min(L::splat(self.high));
            let edge = L::splat(R::from_f64(EDGE));
            // False for NaN.
            let beyond = (held - state).abs();
            let same = beyond.min(edge).equal(beyond);
            if !same.all() {
                slope = L::select(same, slope, L::zero());
                scaled = true;
            }
        }
        match &self.table {
            None => {
                let (cell, base) = held.truncate(self.last_cell);
                GridLocation { cell, fraction: held - base, slope, scaled }
            }
            Some(table) => {
                let found = L::cells_from_fn(|lane| table.find(held.lane(lane), self.last_cell));
                let at = |values: &[R]| L::from_fn(|lane| values[L::cell(&found, lane) as usize]);
                let inverse = at(&table.inverse);
                GridLocation { cell: found, fraction: (held - at(&table.positions)) * inverse, slope: slope * inverse, scaled: true }
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
            let location = map.locate(map.state(coordinate));
            assert_eq!(location.cell, cell);
            // Rounding only.
            assert!((location.fraction - fraction).abs() < 1e-13, "{coordinate}");
        }
        assert_eq!(map.locate(-3.0).slope, 0.0);
        assert!(map.locate(-1e-7).slope > 0.0 && map.locate(4.0 + 1e-7).slope > 0.0, "rounding leaves a point on the edge");
        assert!(map.locate(f64::NAN).cell <= 3);
    }

    #[test]
    fn a_periodic_axis_has_a_seam() {
        let axis = Axis::uniform("lon", "degrees", 0.0, 270.0, 4).unwrap().with_period(360.0);
        let map = AxisMap::<f64>::new(&axis, Boundary::Stop);
        let location = map.locate(map.state(-45.0));
        assert_eq!((location.cell, location.fraction, location.slope), (3, 0.5, 1.0));
        let uneven = AxisMap::<f64>::new(&Axis::uniform("lon", "", 0.0, 200.0, 5).unwrap().with_period(360.0), Boundary::Stop);
        let location = uneven.locate(uneven.state(280.0));
        assert_eq!(location.cell, 4);
        assert!((location.fraction - 0.5).abs() < 1e-14, "rounding only");
    }
}
