//! Residuals of audit points, summed per cell.

use super::{Residual, Strata};
use rayon::prelude::*;

/// Sums over the audit points of one cell, in f64 and in the order in which they were drawn, so that every device finds the same bits.
#[repr(C)]
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct CellErrors {
    /// Points with a residual.
    pub count: f64,
    /// Sum of the optical residuals.
    pub optical: f64,
    /// Sum of their squares.
    pub square: f64,
    /// Sum of their fourth powers.
    pub fourth: f64,
    /// Sum of d^2 over the points, where d is the deviation of a squared residual from its mean in the cell.
    pub second: f64,
    /// Sum of d^3.
    pub third: f64,
    /// Sum of the squared residuals of the log-stretch.
    pub log_square: f64,
}

impl CellErrors {
    /// Sums over the residuals of a cell (optical, log-stretch). NaN is left out.
    fn from_residuals(residuals: &[(f32, f32)]) -> Self {
        let mut sums = Self::default();
        let finite = || residuals.iter().filter(|(optical, _)| !optical.is_nan());
        for &(optical, log_stretch) in finite() {
            let square = f64::from(optical) * f64::from(optical);
            sums.count += 1.0;
            sums.optical += f64::from(optical);
            sums.square += square;
            sums.fourth += square * square;
            sums.log_square += f64::from(log_stretch) * f64::from(log_stretch);
        }
        let mean = sums.square / sums.count;
        for &(optical, _) in finite() {
            let deviation = f64::from(optical) * f64::from(optical) - mean;
            sums.second += deviation * deviation;
            sums.third += deviation * deviation * deviation;
        }
        sums
    }
}

/// Residuals of the points drawn in `strata`.
#[derive(Debug, Clone)]
pub struct Audited {
    strata: Strata,
    cells: Vec<CellErrors>,
    /// Optical residuals, cell by cell; NaN for a point without residual.
    optical: Vec<f32>,
    /// Index of the first optical residual of each cell, and the end of the last.
    offsets: Vec<usize>,
}

/// Offsets of consecutive groups with the given numbers of elements, and the end of the last.
fn offsets(counts: impl Iterator<Item = usize>) -> Vec<usize> {
    let mut end = 0;
    std::iter::once(0)
        .chain(counts.map(|count| {
            end += count;
            end
        }))
        .collect()
}

impl Audited {
    /// Sorts residuals into the cells of their points and sums them. NaN is left out.
    pub fn of(residuals: &[Residual], strata: Strata) -> Self {
        let finite: Vec<(usize, (f32, f32))> = (residuals.par_iter().with_min_len(1 << 12))
            .filter(|r| r.optical.is_finite())
            .map(|r| (strata.cell(r.point), (r.optical, r.log_stretch)))
            .collect();
        let mut counts = vec![0; strata.drawn.len()];
        finite.iter().for_each(|&(cell, _)| counts[cell] += 1);
        let offsets = offsets(counts.into_iter());
        let mut next = offsets.clone();
        let mut sorted = vec![(0.0, 0.0); finite.len()];
        for (cell, residual) in finite {
            sorted[next[cell]] = residual;
            next[cell] += 1;
        }
        Self::sum(&sorted, offsets, strata)
    }

    /// Sums the residuals (optical, log-stretch) of all points in the order in which `strata` draws them: cell by cell, NaN for a point
    /// without residual.
    ///
    /// # Panics
    /// If the number of entries is not that of the points drawn.
    pub fn in_order(residuals: &[(f32, f32)], strata: Strata) -> Self {
        assert_eq!(residuals.len(), strata.total(), "one entry per point");
        let offsets = offsets(strata.drawn.iter().map(|&n| n as usize));
        Self::sum(residuals, offsets, strata)
    }

    fn sum(residuals: &[(f32, f32)], offsets: Vec<usize>, strata: Strata) -> Self {
        let cells = (0..strata.drawn.len()).into_par_iter().with_min_len(64);
        let cells = cells.map(|cell| CellErrors::from_residuals(&residuals[offsets[cell]..offsets[cell + 1]])).collect();
        Self { strata, cells, optical: residuals.iter().map(|residual| residual.0).collect(), offsets }
    }

    /// Residuals summed elsewhere: one entry per cell, and the optical residual of each point drawn, cell by cell (NaN for a point without
    /// residual).
    ///
    /// # Panics
    /// If the numbers of entries are not those of the cells and points drawn.
    pub fn new(strata: Strata, cells: Vec<CellErrors>, optical: Vec<f32>) -> Self {
        assert_eq!((cells.len(), optical.len()), (strata.drawn.len(), strata.total()), "one entry per cell and one per point");
        let offsets = offsets(strata.drawn.iter().map(|&n| n as usize));
        Self { strata, cells, optical, offsets }
    }

    /// Numbers of points drawn per cell.
    pub fn strata(&self) -> &Strata {
        &self.strata
    }

    /// Sums per cell, x fastest.
    pub fn cells(&self) -> &[CellErrors] {
        &self.cells
    }

    /// Optical residuals of a cell.
    pub(super) fn optical(&self, cell: usize) -> impl Iterator<Item = f32> {
        self.optical[self.offsets[cell]..self.offsets[cell + 1]].iter().copied().filter(|optical| !optical.is_nan())
    }

    /// Mean of a summed quantity over the domain, each point weighted with the volume that it represents; NaN without points.
    pub(super) fn mean(&self, sum: impl Fn(&CellErrors) -> f64) -> f64 {
        let cells = || self.cells.iter().zip(&self.strata.drawn).filter(|(cell, _)| cell.count > 0.0);
        let weighted = |f: &dyn Fn(&CellErrors) -> f64| cells().map(|(cell, &drawn)| f(cell) / f64::from(drawn.max(1))).sum::<f64>();
        weighted(&sum) / weighted(&|cell| cell.count)
    }

    /// Root mean square residual of the log-stretch; NaN without points.
    pub fn log_stretch_rms(&self) -> f64 {
        self.mean(|cell| cell.log_square).sqrt()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use ridgewatch_field::UnitPoint;

    #[test]
    fn cells_add_up_what_was_drawn_in_them() {
        let at = |cell: usize, optical: f32| Residual {
            point: UnitPoint([(cell as f32 + 0.5) / 3.0, 0.5, 0.5]),
            optical,
            log_stretch: 2.0 * optical,
        };
        let strata = Strata { drawn: vec![4, 2, 1], ..Strata::even([3, 1, 1], 0) };
        let residuals = [at(0, 0.5), at(2, 1.0), at(0, 1.0), at(1, f32::NAN), at(0, 0.0)];
        let audited = Audited::of(&residuals, strata.clone());
        let [first, second, third] = audited.cells() else { panic!("three cells") };
        assert_eq!((first.count, first.optical, first.square, first.fourth, first.log_square), (3.0, 1.5, 1.25, 1.0625, 5.0));
        // Squares 0.25, 1 and 0 about their mean of 1.25 / 3.
        let deviations = [0.25, 1.0, 0.0].map(|square: f64| square - 1.25 / 3.0);
        assert_eq!(first.second, deviations.iter().map(|d| d * d).sum::<f64>());
        assert_eq!(first.third, deviations.iter().map(|d| d * d * d).sum::<f64>());
        assert_eq!((second.count, third.count, third.second), (0.0, 1.0, 0.0));
        // Each point represents the volume of its cell over the number of points drawn there.
        assert!((audited.mean(|cell| cell.square) - (1.25 / 4.0 + 1.0) / (3.0 / 4.0 + 1.0)).abs() < 1e-15);
        // The same in the order of drawing, with entries for points without residual, and from sums made elsewhere.
        let optical = vec![0.5, f32::NAN, 1.0, 0.0, f32::NAN, f32::NAN, 1.0];
        let pairs: Vec<(f32, f32)> = optical.iter().map(|&o| (o, 2.0 * o)).collect();
        assert_eq!(Audited::in_order(&pairs, strata.clone()).cells(), audited.cells());
        let elsewhere = Audited::new(strata, audited.cells().to_vec(), optical);
        for cell in 0..3 {
            assert_eq!(audited.optical(cell).collect::<Vec<_>>(), elsewhere.optical(cell).collect::<Vec<_>>());
        }
    }
}
