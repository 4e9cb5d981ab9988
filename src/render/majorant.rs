//! The majorant grid: a bound on the extinction in each cell, learned from the queries.
//!
//! Cells start at the largest extinction of the transfer function, which is a safe bound since its ramp saturates, and tighten with each
//! query. Observations take effect in later frames only, so that the majorants of a frame do not depend on its own random numbers. Cells
//! store the largest FTLE instead of the extinction, so that a new transfer function needs no new queries. The tracking stays unbiased if
//! the extinction exceeds its majorant (see `tracking`).

use super::Transfer;
use crate::GridPoint;
use rayon::prelude::*;
use ridgewatch_field::Domain;
use std::sync::atomic::Ordering::Relaxed;
use std::sync::atomic::{AtomicBool, AtomicU32};

/// Margin of the bound above the largest ramp value observed, so that values that no sample has shown stay visible (as noise).
const FLOOR: f32 = 0.02;
/// The bound gets an additional `UNSEEN / samples`, since about 3/n of the cell may have any value after n samples (rule of three).
const UNSEEN: f32 = 8.0;
/// Relative margins on the largest ramp value observed in this window and in the previous one.
const MARGIN: f32 = 1.1;
const SLID_MARGIN: f32 = 1.25;
/// Weight of a sample of the previous window.
const SLID_WEIGHT: f32 = 0.25;
/// Number of samples without a missing value after which a cell is assumed to have none.
const MIN_SAMPLES_PRESENT: f32 = 16.0;

/// Observations in one cell.
#[derive(Debug, Clone, Copy, PartialEq)]
struct CellStatistics {
    count: u32,
    highest: f32,
    missing: bool,
}

const UNOBSERVED: CellStatistics = CellStatistics { count: 0, highest: f32::NEG_INFINITY, missing: false };

impl CellStatistics {
    fn join(self, other: Self) -> Self {
        Self {
            count: self.count.saturating_add(other.count),
            highest: self.highest.max(other.highest),
            missing: self.missing | other.missing,
        }
    }
}

/// Observations of the frame in progress. Counts, maxima and flags do not depend on the order of the threads.
#[derive(Debug, Default)]
struct CellObserver {
    count: AtomicU32,
    /// Order-preserving bits of the highest FTLE; 0 if there is none.
    highest: AtomicU32,
    missing: AtomicBool,
}

impl Clone for CellObserver {
    fn clone(&self) -> Self {
        let (count, highest) = (self.count.load(Relaxed), self.highest.load(Relaxed));
        Self { count: count.into(), highest: highest.into(), missing: self.missing.load(Relaxed).into() }
    }
}

/// Maps floats (except NaN) to integers of the same order.
fn ordered_bits(value: f32) -> u32 {
    let bits = value.to_bits();
    if bits >> 31 == 1 { !bits } else { bits | 1 << 31 }
}

fn from_ordered_bits(image: u32) -> f32 {
    f32::from_bits(if image >> 31 == 1 { image ^ 1 << 31 } else { !image })
}

/// Observations in the cells of the majorant grid, made by a device (x fastest, one entry per cell in each array).
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct CellObservations {
    /// Number of values observed, including missing ones.
    pub count: Vec<u32>,
    /// Order-preserving bits of the highest FTLE (see `ordered` in `kernels/rendering/majorant.cuh`); 0 if there is none.
    pub highest: Vec<u32>,
    /// 1 if a missing value was observed, otherwise 0.
    pub missing: Vec<u32>,
}

/// Bounds on the extinction, x fastest, then y, then z.
#[derive(Debug, Clone)]
pub struct MajorantGrid {
    cells: [usize; 3],
    majorants: Vec<f32>,
    may_be_missing: Vec<bool>,
    observers: Vec<CellObserver>,
    current: Vec<CellStatistics>,
    previous: Vec<CellStatistics>,
}

impl MajorantGrid {
    /// All cells at the transfer function's largest extinction.
    pub(super) fn new(cells: [usize; 3], transfer: &Transfer) -> Self {
        let count = cells.iter().product();
        Self {
            cells,
            majorants: vec![transfer.extinction_max(); count],
            may_be_missing: vec![true; count],
            observers: std::iter::repeat_with(CellObserver::default).take(count).collect(),
            current: vec![UNOBSERVED; count],
            previous: vec![UNOBSERVED; count],
        }
    }

    /// Cells with edges of about equal length: 96 along the longest edge in two dimensions (one along z), 32 in three.
    pub(super) fn default_cells(domain: &Domain, scale: [f64; 3]) -> [usize; 3] {
        let edges: [f64; 3] = std::array::from_fn(|k| domain.extent()[k] * scale[k]);
        let seen = &edges[..domain.dimensions];
        let longest = seen.iter().copied().fold(0.0, f64::max);
        let max_cells = if domain.dimensions == 2 { 96.0 } else { 32.0 };
        std::array::from_fn(
            |k| if k < domain.dimensions { (max_cells * edges[k] / longest).ceil().clamp(1.0, max_cells) as usize } else { 1 },
        )
    }

    /// Cells along x, y and z.
    pub fn cells(&self) -> [usize; 3] {
        self.cells
    }

    /// The current majorants, per unit of length.
    pub fn majorants(&self) -> &[f32] {
        &self.majorants
    }

    /// True if a cell may contain missing values: some were observed, or there are too few samples.
    #[inline]
    pub(super) fn may_be_missing(&self, cell: usize) -> bool {
        self.may_be_missing[cell]
    }

    /// Index of the cell around a point.
    #[inline]
    pub(super) fn cell_at(&self, point: GridPoint) -> usize {
        let [x, y, z] = std::array::from_fn(|k| (point.0[k] as usize).min(self.cells[k] - 1));
        (z * self.cells[1] + y) * self.cells[0] + x
    }

    /// Sets the majorants.
    #[cfg(test)]
    pub(super) fn set_for_test(&mut self, majorants: Vec<f32>) {
        assert_eq!(majorants.len(), self.majorants.len());
        self.majorants = majorants;
    }

    /// Records an FTLE observed in a cell.
    #[inline]
    pub(super) fn observe(&self, cell: usize, ftle: f32) {
        let observer = &self.observers[cell];
        observer.count.fetch_add(1, Relaxed);
        let image = ordered_bits(ftle);
        if image > observer.highest.load(Relaxed) {
            observer.highest.fetch_max(image, Relaxed);
        }
    }

    /// Records a missing value in a cell.
    #[inline]
    pub(super) fn observe_missing(&self, cell: usize) {
        let observer = &self.observers[cell];
        observer.count.fetch_add(1, Relaxed);
        if !observer.missing.load(Relaxed) {
            observer.missing.store(true, Relaxed);
        }
    }

    /// For each cell, whether it may contain missing values.
    pub(super) fn may_be_missing_all(&self) -> &[bool] {
        &self.may_be_missing
    }

    /// Records observations made elsewhere in all cells. Returns false, and records nothing, if they are those of another grid.
    #[must_use]
    pub(super) fn absorb(&self, seen: &CellObservations) -> bool {
        let cells = self.observers.len();
        if [seen.count.len(), seen.highest.len(), seen.missing.len()] != [cells; 3] {
            return false;
        }
        for (i, observer) in self.observers.iter().enumerate() {
            observer.count.fetch_add(seen.count[i], Relaxed);
            observer.highest.fetch_max(seen.highest[i], Relaxed);
            observer.missing.fetch_or(seen.missing[i] != 0, Relaxed);
        }
        true
    }

    /// Applies the observations of all frames so far.
    pub(super) fn commit(&mut self, transfer: &Transfer) {
        for (observer, current) in self.observers.iter_mut().zip(&mut self.current) {
            let observer = std::mem::take(observer);
            let image = observer.highest.into_inner();
            let highest = if image == 0 { f32::NEG_INFINITY } else { from_ordered_bits(image) };
            *current = current.join(CellStatistics { count: observer.count.into_inner(), highest, missing: observer.missing.into_inner() });
        }
        self.derive(transfer);
    }

    /// Adapts to a slide of the window: observations lose weight and may apply to a neighbouring cell.
    pub(super) fn slide(&mut self, transfer: &Transfer) {
        self.commit(transfer);
        let [nx, ny, nz] = self.cells;
        let around = |i: usize, n: usize| i.saturating_sub(1)..(i + 2).min(n);
        let current = &self.current;
        self.previous.par_chunks_mut(nx).enumerate().with_min_len(16).for_each(|(row, previous)| {
            let (y, z) = (row % ny, row / ny);
            for (x, previous) in previous.iter_mut().enumerate() {
                let mut joined = UNOBSERVED;
                for (k, j) in around(z, nz).flat_map(|k| around(y, ny).map(move |j| (k, j))) {
                    joined = around(x, nx).fold(joined, |all, i| all.join(current[(k * ny + j) * nx + i]));
                }
                *previous = CellStatistics { count: current[row * nx + x].count, ..joined };
            }
        });
        self.current.fill(UNOBSERVED);
        self.derive(transfer);
    }

    /// Derives the majorants from the observations.
    pub(super) fn derive(&mut self, transfer: &Transfer) {
        let largest = transfer.extinction_max();
        // An empty interval has an empty ramp.
        let ramp = |highest: f32| if highest == f32::NEG_INFINITY { 0.0 } else { transfer.ramp(highest) };
        for (i, (current, previous)) in self.current.iter().zip(&self.previous).enumerate() {
            let count = current.count as f32 + SLID_WEIGHT * previous.count as f32;
            let seen = (MARGIN * ramp(current.highest)).max(SLID_MARGIN * ramp(previous.highest));
            // With a count of 0 the bound is the largest extinction.
            self.majorants[i] = largest * (seen + FLOOR + UNSEEN / count).min(1.0);
            self.may_be_missing[i] = current.missing | previous.missing || count < MIN_SAMPLES_PRESENT;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::TransferSettings;

    fn transfer(extinction: f64) -> Transfer {
        Transfer::new(&TransferSettings { low: Some(0.0), high: Some(1.0), extinction: Some(extinction), ..Default::default() }, 1.0)
            .unwrap()
    }

    #[test]
    fn ordered_images_keep_the_order() {
        let values = [f32::NEG_INFINITY, -2.0, -1e-30, 0.0, 1e-30, 3.0, f32::INFINITY];
        for pair in values.windows(2) {
            assert!(ordered_bits(pair[0]) < ordered_bits(pair[1]));
        }
        values.iter().for_each(|&v| assert_eq!(from_ordered_bits(ordered_bits(v)), v));
        assert!(ordered_bits(f32::NEG_INFINITY) > 0, "0 stands for none");
    }

    #[test]
    fn cells_tighten_with_evidence_and_only_on_commit() {
        let transfer = transfer(100.0);
        let mut grid = MajorantGrid::new([2, 1, 1], &transfer);
        assert_eq!(grid.majorants(), [100.0, 100.0]);
        (0..800).for_each(|_| grid.observe(0, 0.2));
        assert_eq!(grid.majorants()[0], 100.0, "a frame's own samples change nothing in it");
        grid.commit(&transfer);
        // 1.1 * 0.2 seen + 0.02 floor + 8/800 unseen, times 100; f32 rounding.
        assert!((grid.majorants()[0] - 25.0).abs() < 1e-3);
        assert_eq!(grid.majorants()[1], 100.0, "nothing seen, nothing known");
        grid.observe(0, 0.7);
        grid.commit(&transfer);
        assert!(grid.majorants()[0] > 77.0, "a value above its majorant raises it");
    }

    #[test]
    fn another_transfer_function_re_derives() {
        let mut grid = MajorantGrid::new([1, 1, 1], &transfer(100.0));
        (0..8000).for_each(|_| grid.observe(0, 0.5));
        grid.commit(&transfer(100.0));
        grid.derive(&transfer(10.0));
        // 1.1 * 0.5 + 0.02 + 8/8000 of 10; f32 rounding.
        assert!((grid.majorants()[0] - 5.71).abs() < 1e-4);
    }

    #[test]
    fn a_slide_loosens_and_spreads_and_two_forget() {
        let transfer = transfer(100.0);
        let mut grid = MajorantGrid::new([4, 1, 1], &transfer);
        for cell in 0..4 {
            (0..8000).for_each(|_| grid.observe(cell, if cell == 0 { 0.5 } else { 0.0 }));
        }
        grid.commit(&transfer);
        let before = grid.majorants().to_vec();
        grid.slide(&transfer);
        assert!(grid.majorants()[1] > 60.0, "the ridge may have moved over: {:?}", grid.majorants());
        assert!((0..4).all(|k| grid.majorants()[k] > before[k]));
        assert!(grid.majorants()[3] < 10.0, "two cells away it has not");
        grid.slide(&transfer);
        assert_eq!(grid.majorants(), [100.0; 4], "a window in which nothing was seen proves nothing");
    }

    #[test]
    fn land_is_remembered_and_empty() {
        let transfer = transfer(100.0);
        let mut grid = MajorantGrid::new([2, 1, 1], &transfer);
        assert!(grid.may_be_missing(0) && grid.may_be_missing(1), "nothing seen, nothing known");
        (0..8000).for_each(|_| grid.observe_missing(0));
        (0..8000).for_each(|_| grid.observe(1, -1.0));
        grid.commit(&transfer);
        // Floor 0.02 + 8/8000 of 100; f32 rounding.
        assert!((grid.majorants()[0] - 2.1).abs() < 1e-4);
        assert!(grid.may_be_missing(0) && !grid.may_be_missing(1));
        assert_eq!(
            (grid.cell_at(GridPoint([0.9, 0.5, 0.5])), grid.cell_at(GridPoint([2.0, 1.0, 1.0]))),
            (0, 1),
            "the far walls belong to the last cells"
        );
    }

    #[test]
    fn maps_need_one_cell_in_z() {
        assert_eq!(MajorantGrid::default_cells(&Domain::slab([0.0; 2], [2.0, 1.0], (0.0, 1.0)), [1.0; 3]), [96, 48, 1]);
        assert_eq!(MajorantGrid::default_cells(&Domain::cuboid([0.0; 3], [4.0, 2.0, 1.0]), [1.0; 3]), [32, 16, 8]);
    }
}
