//! The trust map: residual statistics per cell of the domain, and the gate that follows from them.
//!
//! A cell is trusted if the upper 95 % bound of its mean square residual (normal approximation) is within the tolerance. Audit points are
//! distributed over the trusted cells by optimal allocation (Neyman 1934).

use super::strata::{PreviousAudit, Residual, Strata, cell_of};
use super::{Audited, CellErrors, GateEvidence, REJECTED, TrustSettings, TrustedError};
use ridgewatch_field::{Domain, UnitPoint};

/// Decayed sums over the residuals of one cell.
#[derive(Debug, Clone, Copy, Default)]
struct Cell {
    weight: f64,
    optical_square: f64,
    optical_fourth: f64,
}

/// Residual statistics per cell of the unit cube.
#[derive(Debug, Clone)]
pub struct TrustMap {
    shape: [usize; 3],
    cells: Vec<Cell>,
    settings: TrustSettings,
    /// Sums over the audit points of the latest frame alone, without inflation and without samples of pictures.
    audited: Vec<Cell>,
    /// Mean square residual of the latest audit points. Its growth across a slide is the drift.
    latest_mean_square: Option<f64>,
    just_slid: bool,
    measured_growth: f64,
    evidence: GateEvidence,
}

/// The cells that the surrogate answers during one frame.
#[derive(Debug, Clone)]
pub struct Gate {
    shape: [usize; 3],
    trusted: Vec<bool>,
}

/// One-sided 95 % quantile of the normal distribution.
const Z95: f64 = 1.645;
/// Factor on the sums of older frames per frame, since the weights change and old residuals become obsolete.
const DECAY: f64 = 0.6;
/// Factor on the sums per slide.
const SLIDE_DECAY: f64 = 0.25;

/// About `count` cells over the axes along which the flow varies, as cubic as the domain's lengths allow.
fn cubic_cells(domain: &Domain, count: usize) -> [usize; 3] {
    let lengths = domain.lengths();
    let axes = domain.dimensions;
    let volume: f64 = lengths[..axes].iter().product();
    let edge = (volume / count as f64).powf(1.0 / axes as f64);
    std::array::from_fn(|k| if k < axes { ((lengths[k] / edge).round() as usize).clamp(1, count) } else { 1 })
}

impl Cell {
    fn add(&mut self, residual: &Residual) {
        let square = f64::from(residual.optical).powi(2);
        self.weight += 1.0;
        self.optical_square += square;
        self.optical_fourth += square * square;
    }

    fn add_errors(&mut self, errors: &CellErrors) {
        self.weight += errors.count;
        self.optical_square += errors.square;
        self.optical_fourth += errors.fourth;
    }

    fn previous(&self) -> PreviousAudit {
        let weight = self.weight.max(f64::MIN_POSITIVE);
        let variance = (self.optical_fourth / weight - (self.optical_square / weight).powi(2)).max(0.0);
        PreviousAudit { weight: self.weight, variance }
    }
}

impl TrustMap {
    /// A map without samples, which trusts no cell.
    pub fn new(settings: &TrustSettings, domain: &Domain) -> Self {
        let shape = match settings.cells {
            Some([x, y, z]) => [x, y, if domain.dimensions == 3 { z } else { 1 }],
            None => cubic_cells(domain, if domain.dimensions == 3 { 4096 } else { 512 }),
        };
        let cells = vec![Cell::default(); shape.iter().product()];
        Self {
            shape,
            audited: cells.clone(),
            cells,
            settings: settings.clone(),
            latest_mean_square: None,
            just_slid: false,
            measured_growth: 1.0,
            evidence: GateEvidence::new(settings.tolerance),
        }
    }

    /// Allowed optical residual.
    pub fn tolerance(&self) -> f64 {
        self.settings.tolerance
    }

    /// Changes the allowed optical residual. What was measured stays; the evidence against the gate begins anew.
    pub fn set_tolerance(&mut self, tolerance: f64) {
        if tolerance == self.settings.tolerance {
            return;
        }
        self.settings.tolerance = tolerance;
        self.evidence = GateEvidence::new(tolerance);
    }

    /// Cells along x, y and z.
    pub fn shape(&self) -> [usize; 3] {
        self.shape
    }

    /// Reduces the weight of older residuals, since the surrogate has changed since. Call once per frame.
    pub fn decay(&mut self) {
        self.audited.fill(Cell::default());
        for cell in &mut self.cells {
            cell.weight *= DECAY;
            cell.optical_square *= DECAY;
            cell.optical_fourth *= DECAY;
        }
    }

    /// Adds residuals: those of audit points, which also measure the drift, and those of other points.
    pub fn observe(&mut self, audited: Option<&Audited>, others: &[Residual]) {
        let mean = audited.map(|audited| audited.mean(|cell| cell.square));
        if let Some(mean) = mean.filter(|mean| !mean.is_nan()) {
            if self.just_slid
                && let Some(before) = self.latest_mean_square.filter(|b| *b > 0.0)
            {
                self.measured_growth = mean / before;
            }
            self.latest_mean_square = Some(mean);
            self.just_slid = false;
        }
        if let Some(audited) = audited {
            for (number, errors) in audited.cells().iter().enumerate() {
                let cell = cell_of(self.shape, audited.strata().centre(number));
                self.cells[cell].add_errors(errors);
                self.audited[cell].add_errors(errors);
            }
        }
        for residual in others.iter().filter(|r| r.optical.is_finite()) {
            self.cells[cell_of(self.shape, residual.point)].add(residual);
        }
    }

    /// Adapts the statistics to a slide of the window, after which labels and predictions are those of an older field. Mean square residuals
    /// grow by the larger of the setting and the growth measured at the previous slide. Their weight decreases, so that cells must earn their
    /// trust again.
    pub fn window_slid(&mut self) {
        let inflation = self.settings.slide_inflation.max(self.measured_growth);
        for cell in &mut self.cells {
            cell.weight *= SLIDE_DECAY;
            cell.optical_square *= SLIDE_DECAY * inflation;
            cell.optical_fourth *= SLIDE_DECAY * inflation * inflation;
        }
        self.audited.fill(Cell::default());
        self.just_slid = true;
    }

    /// Forgets all residuals, for use when another surrogate replaces the one that was measured.
    pub fn reset(&mut self) {
        self.cells.fill(Cell::default());
        self.audited.fill(Cell::default());
        self.latest_mean_square = None;
        self.just_slid = false;
        self.evidence.restart();
    }

    /// Adds a frame's measured error to the evidence against the gate, and returns the evidence and the frames that it rests on. At [`REJECTED`] or
    /// above the gate has promised too much over the run: all residuals are forgotten, so that every cell earns its trust again.
    pub fn weigh(&mut self, trusted: &TrustedError) -> (f64, u64) {
        let evidence = self.evidence.observe(trusted.optical_rms.powi(2));
        let frames = self.evidence.frames();
        if evidence >= REJECTED {
            self.reset();
        }
        (evidence, frames)
    }

    /// Upper 95 % bound of the mean square optical residual of a cell; `None` with too few samples.
    ///
    /// The bound is that of the normal approximation, with one additional pseudo-sample at twice the tolerance that stands for residuals
    /// that few samples are unlikely to show.
    fn upper_bound(&self, cell: &Cell) -> Option<f64> {
        if cell.weight < self.settings.min_samples * (1.0 - 1e-9) {
            return None;
        }
        let pseudo = (2.0 * self.settings.tolerance).powi(2);
        let n = cell.weight + 1.0;
        let mean = (cell.optical_square + pseudo) / n;
        let variance = ((cell.optical_fourth + pseudo * pseudo) / n - mean * mean).max(0.0);
        Some(mean + Z95 * (variance / n).sqrt())
    }

    /// Number of audit points per cell, from the residuals of earlier frames: `min_per_cell` in every cell, and more in trusted cells, in
    /// proportion to the standard deviation of the squared residual there (Neyman 1934). Their total brings the relative standard error of the
    /// stated root mean square to `audit_precision`, within `audit_max_per_cell`.
    pub fn audit_strata(&self, gate: &Gate, min_per_cell: usize) -> Strata {
        let mut strata =
            Strata { previous: self.audited.iter().map(Cell::previous).collect(), ..Strata::even(self.shape, min_per_cell as u32) };
        let trusted = || self.cells.iter().zip(&gate.trusted).filter(|(_, trusted)| **trusted).map(|(cell, _)| cell);
        let cells = trusted().count();
        let weight: f64 = trusted().map(|c| c.weight).sum();
        if cells == 0 || weight == 0.0 || gate.shape != self.shape {
            return strata;
        }
        // Each cell gets one pseudo-sample with the moments of the whole trusted region, since few samples may miss large residuals.
        let prior = [trusted().map(|c| c.optical_square).sum::<f64>() / weight, trusted().map(|c| c.optical_fourth).sum::<f64>() / weight];
        let mean = |cell: &Cell| (cell.optical_square + prior[0]) / (cell.weight + 1.0);
        let spread = |cell: &Cell| ((cell.optical_fourth + prior[1]) / (cell.weight + 1.0) - mean(cell).powi(2)).max(0.0).sqrt();
        let mean_square = trusted().map(mean).sum::<f64>() / cells as f64;
        let spreads = trusted().map(spread).sum::<f64>();
        if mean_square <= 0.0 || spreads <= 0.0 {
            return strata;
        }
        // The relative error of a root is half that of the square.
        let needed = (spreads / cells as f64 / (2.0 * self.settings.audit_precision * mean_square)).powi(2);
        let more = needed.min((self.settings.audit_max_per_cell.saturating_sub(min_per_cell) * cells) as f64);
        for ((drawn, cell), trusted) in strata.drawn.iter_mut().zip(&self.cells).zip(&gate.trusted) {
            if *trusted {
                *drawn += (more * spread(cell) / spreads).round() as u32;
            }
        }
        strata
    }

    /// Returns the gate for the next frame.
    pub fn gate(&self) -> Gate {
        let limit = self.settings.tolerance.powi(2);
        let trusted = self.cells.iter().map(|cell| self.upper_bound(cell).is_some_and(|bound| bound <= limit)).collect();
        Gate { shape: self.shape, trusted }
    }
}

impl Gate {
    /// A gate that trusts every cell (`all` true) or none.
    pub fn uniform(all: bool) -> Self {
        Self { shape: [1; 3], trusted: vec![all] }
    }

    /// True if the surrogate answers at a unit point.
    pub fn trusts(&self, point: UnitPoint) -> bool {
        self.trusted[cell_of(self.shape, point)]
    }

    /// A gate of `shape` cells along x, y and z, `trusted` with x fastest.
    ///
    /// # Panics
    /// If the number of cells differs.
    pub fn new(shape: [usize; 3], trusted: Vec<bool>) -> Self {
        assert_eq!(trusted.len(), shape.iter().product::<usize>(), "one entry a cell");
        Self { shape, trusted }
    }

    /// True if the surrogate answers everywhere between two corners, the lower one first.
    pub fn trusts_box(&self, corners: [UnitPoint; 2]) -> bool {
        let [low, high] = corners.map(|corner| cell_of(self.shape, corner));
        let [nx, ny, nz] = self.shape;
        let range = |stride: usize, n: usize| low / stride % n..=high / stride % n;
        range(nx * ny, nz).all(|z| range(nx, ny).all(|y| range(1, nx).all(|x| self.trusted[(z * ny + y) * nx + x])))
    }

    /// Cells along x, y and z.
    pub fn shape(&self) -> [usize; 3] {
        self.shape
    }

    /// For each cell, x fastest, whether it is trusted.
    pub fn cells(&self) -> &[bool] {
        &self.trusted
    }

    /// Trusted share of the domain's volume.
    pub fn share(&self) -> f64 {
        self.trusted.iter().filter(|t| **t).count() as f64 / self.trusted.len() as f64
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn domain() -> Domain {
        Domain::slab([0.0, 0.0], [2.0, 1.0], (0.0, 1.0))
    }

    fn filled(map: &mut TrustMap, optical: f32, per_cell: usize) {
        let [nx, ny, _] = map.shape();
        let mut residuals = Vec::new();
        for cell in 0..nx * ny {
            let point = UnitPoint([(cell % nx) as f32 / nx as f32 + 1e-4, (cell / nx) as f32 / ny as f32 + 1e-4, 0.5]);
            residuals.extend((0..per_cell).map(|_| Residual { point, optical, log_stretch: 0.0 }));
        }
        map.decay();
        let strata = Strata::even(map.shape(), per_cell as u32);
        map.observe(Some(&Audited::of(&residuals, strata)), &[]);
    }

    #[test]
    fn cells_are_as_cubic_as_the_domain_allows() {
        assert_eq!(TrustMap::new(&TrustSettings::default(), &domain()).shape(), [32, 16, 1]);
        let cube = Domain::cuboid([0.0; 3], [1.0; 3]);
        assert_eq!(TrustMap::new(&TrustSettings::default(), &cube).shape(), [16, 16, 16]);
        let globe = Domain { scale: [1.0, 1.0, 90.0 / 28_000.0], ..Domain::cuboid([0.0, -90.0, 1e3], [360.0, 90.0, 29e3]) };
        assert_eq!(TrustMap::new(&TrustSettings::default(), &globe).shape(), [32, 16, 8], "metres and degrees do not compare");
    }

    #[test]
    fn trust_is_earned_lost_on_a_slide_and_earned_again() {
        let mut map = TrustMap::new(&TrustSettings::default(), &domain());
        assert_eq!(map.gate().share(), 0.0, "nothing is known");
        filled(&mut map, 0.01, 8);
        assert_eq!(map.gate().share(), 0.0, "too few samples");
        filled(&mut map, 0.01, 20);
        assert_eq!(map.gate().share(), 1.0);
        map.window_slid();
        assert_eq!(map.gate().share(), 0.0);
        filled(&mut map, 0.012, 40);
        assert_eq!(map.gate().share(), 1.0);
    }

    #[test]
    fn a_bad_cell_is_answered_by_rk4_and_its_neighbours_are_not() {
        let mut map = TrustMap::new(&TrustSettings::default(), &domain());
        filled(&mut map, 0.01, 64);
        let bad = UnitPoint([0.51, 0.51, 0.0]);
        map.decay();
        map.observe(
            None,
            &(0..100).map(|i| Residual { point: bad, optical: 0.01 * (i % 10) as f32, log_stretch: 0.0 }).collect::<Vec<_>>(),
        );
        let gate = map.gate();
        assert!(!gate.trusts(bad));
        assert!(gate.trusts(UnitPoint([0.45, 0.51, 0.0])));
        assert!((gate.share() - 511.0 / 512.0).abs() < 1e-12);
    }

    #[test]
    fn residuals_at_the_tolerance_are_not_trusted_and_nan_is_ignored() {
        let mut map = TrustMap::new(&TrustSettings::default(), &domain());
        filled(&mut map, 0.03, 1000);
        assert_eq!(map.gate().share(), 0.0);
        let mut map = TrustMap::new(&TrustSettings::default(), &domain());
        filled(&mut map, f32::NAN, 1000);
        assert_eq!(map.gate().share(), 0.0);
    }

    #[test]
    fn a_field_that_drifts_fast_is_inflated_by_what_was_measured() {
        let mut map = TrustMap::new(&TrustSettings { slide_inflation: 1.0, ..TrustSettings::default() }, &domain());
        filled(&mut map, 0.001, 100);
        map.window_slid();
        filled(&mut map, 0.02, 100);
        for _ in 0..20 {
            filled(&mut map, 0.002, 100);
        }
        map.window_slid();
        assert_eq!(map.gate().share(), 0.0, "400-fold growth was seen at the last slide; 0.002 would become 0.04");
    }

    #[test]
    fn audits_go_where_the_error_is_spread() {
        let settings = TrustSettings { audit_max_per_cell: 32, ..TrustSettings::default() };
        let mut map = TrustMap::new(&settings, &domain());
        filled(&mut map, 0.001, 64);
        let ridge = UnitPoint([0.51, 0.51, 0.0]);
        let some: Vec<Residual> =
            (0..200).map(|i| Residual { point: ridge, optical: if i % 20 == 0 { 0.05 } else { 0.001 }, log_stretch: 0.0 }).collect();
        map.observe(None, &some);
        let gate = map.gate();
        assert!(gate.trusts(ridge));
        let strata = map.audit_strata(&gate, 8);
        let here = strata.drawn[strata.cell(ridge)];
        assert!(strata.drawn.iter().all(|&n| n >= 8));
        let elsewhere = *strata.drawn.iter().enumerate().filter(|(c, _)| *c != strata.cell(ridge)).map(|(_, n)| n).max().unwrap();
        assert!(here > 3 * elsewhere, "{here} against {elsewhere}");
        // Rounding may add half a point a cell.
        assert!(strata.total() <= 512 * 32 + 256, "{} points", strata.total());
        assert_eq!(map.audit_strata(&Gate::uniform(false), 8).drawn, vec![8; 512], "nothing is trusted: nothing is stated");
    }
}
