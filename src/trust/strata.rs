//! The cells of the unit cube as strata: residuals at points, and the numbers of points drawn per cell.

use ridgewatch_field::UnitPoint;

/// Difference between a traced sample and the prediction of a surrogate that has not been trained on it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Residual {
    /// Where the sample lies.
    pub point: UnitPoint,
    /// |ramp(predicted) - ramp(traced)|, in [0, 1].
    pub optical: f32,
    /// predicted - traced log-stretch.
    pub log_stretch: f32,
}

/// Numbers of points drawn uniformly in each cell (strata of stratified sampling).
#[derive(Debug, Clone, PartialEq)]
pub struct Strata {
    /// Cells along x, y and z of the unit cube.
    pub shape: [usize; 3],
    /// Points drawn in each cell, x fastest.
    pub drawn: Vec<u32>,
    /// Statistics of the audit points of the previous frame per cell; empty if there was none.
    pub(super) previous: Vec<PreviousAudit>,
}

/// Squared optical residuals of the audit points of a cell in the previous frame.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(super) struct PreviousAudit {
    /// Number of points.
    pub(super) weight: f64,
    /// Variance of the squared residual.
    pub(super) variance: f64,
}

/// Index of the cell of a unit point.
pub(super) fn cell_of(shape: [usize; 3], point: UnitPoint) -> usize {
    let index = |k: usize| ((point.0[k].clamp(0.0, 1.0) * shape[k] as f32) as usize).min(shape[k] - 1);
    (index(2) * shape[1] + index(1)) * shape[0] + index(0)
}

impl Strata {
    /// The same number of points in every cell.
    pub fn even(shape: [usize; 3], per_cell: u32) -> Self {
        Self::new(shape, vec![per_cell; shape.iter().product()])
    }

    /// Given numbers of points per cell, x fastest.
    ///
    /// # Panics
    /// If the number of entries is not that of the cells.
    pub fn new(shape: [usize; 3], drawn: Vec<u32>) -> Self {
        assert_eq!(drawn.len(), shape.iter().product::<usize>(), "one number per cell");
        Self { shape, drawn, previous: Vec::new() }
    }

    /// Total number of points.
    pub fn total(&self) -> usize {
        self.drawn.iter().map(|&n| n as usize).sum()
    }

    /// Index of the cell of a unit point.
    pub(super) fn cell(&self, point: UnitPoint) -> usize {
        cell_of(self.shape, point)
    }

    /// Centre of a cell.
    pub fn centre(&self, cell: usize) -> UnitPoint {
        let [nx, ny, _] = self.shape;
        let index = [cell % nx, cell / nx % ny, cell / (nx * ny)];
        UnitPoint(std::array::from_fn(|k| (index[k] as f32 + 0.5) / self.shape[k] as f32))
    }
}
