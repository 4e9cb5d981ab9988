//! The trust map: what each cell of the domain is known to err by.

use super::{Audited, CellErrors, TrustSettings};
use crate::field::Domain;

/// A traced sample held against the surrogate's prediction, made with weights that had not seen it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Residual {
    /// Unit coordinates.
    pub point: [f32; 3],
    /// |ramp(predicted) - ramp(traced)|, in [0, 1].
    pub optical: f32,
    /// predicted - traced log-stretch.
    pub log_stretch: f32,
}

/// Decayed sums of one cell.
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
    /// Sums over the audit points of the latest frame alone: neither inflated nor mixed with samples that pictures chose.
    audited: Vec<Cell>,
    /// Mean square residual over the latest uniform points; its ratio across a slide is the drift.
    before_slide: Option<f64>,
    just_slid: bool,
    measured_growth: f64,
}

/// Which cells the surrogate answers, frozen for one frame.
#[derive(Debug, Clone)]
pub struct Gate {
    shape: [usize; 3],
    trusted: Vec<bool>,
}

/// How many points were drawn in each cell, uniformly inside it.
#[derive(Debug, Clone, PartialEq)]
pub struct Strata {
    /// Cells along x, y and z of the unit cube.
    pub shape: [usize; 3],
    /// Points drawn in each cell, x fastest.
    pub drawn: Vec<u32>,
    /// What the audit points of the frame before saw in each cell; empty where there were none.
    pub(super) seen: Vec<Seen>,
}

/// Squared optical residuals of a cell's audit points in the frame before.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(super) struct Seen {
    /// How many points there were.
    pub(super) weight: f64,
    /// Variance of the squared residual.
    pub(super) variance: f64,
}

/// One-sided 95 % quantile of the normal distribution.
const Z95: f64 = 1.645;
/// What a frame leaves of the older frames' sums: the weights change, so old residuals lose their meaning.
const DECAY: f64 = 0.6;
/// What a slide leaves of them.
const SLIDE_DECAY: f64 = 0.25;

fn cell_of(shape: [usize; 3], point: [f32; 3]) -> usize {
    let index = |k: usize| ((point[k].clamp(0.0, 1.0) * shape[k] as f32) as usize).min(shape[k] - 1);
    (index(2) * shape[1] + index(1)) * shape[0] + index(0)
}

/// About `count` cells over the axes along which the flow varies, as cubic as the domain's lengths allow.
pub(crate) fn cubic_cells(domain: &Domain, count: usize) -> [usize; 3] {
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

    fn take(&mut self, errors: &CellErrors) {
        self.weight += errors.count;
        self.optical_square += errors.square;
        self.optical_fourth += errors.fourth;
    }

    fn seen(&self) -> Seen {
        let weight = self.weight.max(f64::MIN_POSITIVE);
        let variance = (self.optical_fourth / weight - (self.optical_square / weight).powi(2)).max(0.0);
        Seen { weight: self.weight, variance }
    }
}

impl TrustMap {
    /// A map that trusts nothing yet.
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
            before_slide: None,
            just_slid: false,
            measured_growth: 1.0,
        }
    }

    /// Cells along x, y and z.
    pub fn shape(&self) -> [usize; 3] {
        self.shape
    }

    /// Older residuals lose weight, since the weights that they were measured with have changed. Call once a frame.
    pub fn decay(&mut self) {
        self.audited.fill(Cell::default());
        for cell in &mut self.cells {
            cell.weight *= DECAY;
            cell.optical_square *= DECAY;
            cell.optical_fourth *= DECAY;
        }
    }

    /// Takes residuals in: those of points drawn over the whole domain, from which drift is read off, and those of points drawn otherwise.
    pub fn observe(&mut self, audited: Option<&Audited>, others: &[Residual]) {
        let mean = audited.map(|audited| audited.mean(|cell| cell.square));
        if let Some(mean) = mean.filter(|mean| !mean.is_nan()) {
            if self.just_slid
                && let Some(before) = self.before_slide.filter(|b| *b > 0.0)
            {
                self.measured_growth = mean / before;
            }
            self.before_slide = Some(mean);
            self.just_slid = false;
        }
        if let Some(audited) = audited {
            for (number, errors) in audited.cells().iter().enumerate() {
                let cell = cell_of(self.shape, audited.strata().centre(number));
                self.cells[cell].take(errors);
                self.audited[cell].take(errors);
            }
        }
        for residual in others.iter().filter(|r| r.optical.is_finite()) {
            self.cells[cell_of(self.shape, residual.point)].add(residual);
        }
    }

    /// The window slid: labels and predictions are of an older field. Residuals grow by the larger of the setting and the growth
    /// measured at the slide before, and count for less, so that trust must be earned again.
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

    /// Forgets everything: another surrogate has taken the place of the one that was measured.
    pub fn reset(&mut self) {
        self.cells.fill(Cell::default());
        self.audited.fill(Cell::default());
        self.before_slide = None;
        self.just_slid = false;
    }

    /// Upper 95 % bound of a cell's mean square optical residual; none with too few samples.
    ///
    /// The bound is that of the normal approximation; one pseudo-sample at twice the tolerance stands for what so few samples
    /// cannot have seen.
    fn upper_bound(&self, cell: &Cell) -> Option<f64> {
        if cell.weight < self.settings.min_samples * (1.0 - 1e-9) {
            return None;
        }
        let unseen = (2.0 * self.settings.tolerance).powi(2);
        let n = cell.weight + 1.0;
        let mean = (cell.optical_square + unseen) / n;
        let variance = ((cell.optical_fourth + unseen * unseen) / n - mean * mean).max(0.0);
        Some(mean + Z95 * (variance / n).sqrt())
    }

    /// How many audit points each cell gets, from what earlier frames have seen: `least` everywhere, and in trusted cells as many more,
    /// in proportion to the spread of the squared residual there (Neyman 1934), as bring the standard error of the stated root mean
    /// square to the setting's share of it, within the setting's bound.
    pub fn audit_strata(&self, gate: &Gate, least: usize) -> Strata {
        let mut strata = Strata { seen: self.audited.iter().map(Cell::seen).collect(), ..Strata::even(self.shape, least as u32) };
        let trusted = || self.cells.iter().zip(&gate.trusted).filter(|(_, trusted)| **trusted).map(|(cell, _)| cell);
        let cells = trusted().count();
        let weight: f64 = trusted().map(|c| c.weight).sum();
        if cells == 0 || weight == 0.0 || gate.shape != self.shape {
            return strata;
        }
        // One pseudo-sample a cell, like the whole trusted region: a cell that has shown nothing yet may still hold something.
        let prior = [trusted().map(|c| c.optical_square).sum::<f64>() / weight, trusted().map(|c| c.optical_fourth).sum::<f64>() / weight];
        let mean = |cell: &Cell| (cell.optical_square + prior[0]) / (cell.weight + 1.0);
        let spread = |cell: &Cell| ((cell.optical_fourth + prior[1]) / (cell.weight + 1.0) - mean(cell).powi(2)).max(0.0).sqrt();
        let mean_square = trusted().map(mean).sum::<f64>() / cells as f64;
        let spreads = trusted().map(spread).sum::<f64>();
        if mean_square <= 0.0 || spreads <= 0.0 {
            return strata;
        }
        // The relative error of a root is half of that of the square.
        let needed = (spreads / cells as f64 / (2.0 * self.settings.audit_precision * mean_square)).powi(2);
        let more = needed.min((self.settings.audit_max_per_cell.saturating_sub(least) * cells) as f64);
        for ((drawn, cell), trusted) in strata.drawn.iter_mut().zip(&self.cells).zip(&gate.trusted) {
            if *trusted {
                *drawn += (more * spread(cell) / spreads).round() as u32;
            }
        }
        strata
    }

    /// The gate for the next frame.
    pub fn gate(&self) -> Gate {
        let limit = self.settings.tolerance.powi(2);
        let trusted = self.cells.iter().map(|cell| self.upper_bound(cell).is_some_and(|bound| bound <= limit)).collect();
        Gate { shape: self.shape, trusted }
    }
}

impl Strata {
    /// As many points in every cell.
    pub fn even(shape: [usize; 3], per_cell: u32) -> Self {
        Self::new(shape, vec![per_cell; shape.iter().product()])
    }

    /// So many points in each cell, x fastest.
    ///
    /// # Panics
    /// When there are not as many numbers as cells.
    pub fn new(shape: [usize; 3], drawn: Vec<u32>) -> Self {
        assert_eq!(drawn.len(), shape.iter().product::<usize>(), "one number a cell");
        Self { shape, drawn, seen: Vec::new() }
    }

    /// Points in all.
    pub fn total(&self) -> usize {
        self.drawn.iter().map(|&n| n as usize).sum()
    }

    /// The cell of a unit point.
    pub(super) fn cell(&self, point: [f32; 3]) -> usize {
        cell_of(self.shape, point)
    }

    /// The middle of a cell, in unit coordinates.
    pub fn centre(&self, cell: usize) -> [f32; 3] {
        let [nx, ny, _] = self.shape;
        let index = [cell % nx, cell / nx % ny, cell / (nx * ny)];
        std::array::from_fn(|k| (index[k] as f32 + 0.5) / self.shape[k] as f32)
    }
}

impl Gate {
    /// A gate that trusts every cell (`all` true) or none.
    pub fn uniform(all: bool) -> Self {
        Self { shape: [1; 3], trusted: vec![all] }
    }

    /// Whether the surrogate answers at this unit point.
    pub fn trusts(&self, point: [f32; 3]) -> bool {
        self.trusted[cell_of(self.shape, point)]
    }

    /// Cells along x, y and z.
    pub fn shape(&self) -> [usize; 3] {
        self.shape
    }

    /// Which cells are trusted, x fastest.
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
            let point = [(cell % nx) as f32 / nx as f32 + 1e-4, (cell / nx) as f32 / ny as f32 + 1e-4, 0.5];
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
        assert_eq!(TrustMap::new(&TrustSettings::default(), &globe).shape(), [32, 16, 8], "metres are no degrees");
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
        let bad = [0.51, 0.51, 0.0];
        map.decay();
        map.observe(
            None,
            &(0..100).map(|i| Residual { point: bad, optical: 0.01 * (i % 10) as f32, log_stretch: 0.0 }).collect::<Vec<_>>(),
        );
        let gate = map.gate();
        assert!(!gate.trusts(bad));
        assert!(gate.trusts([0.45, 0.51, 0.0]));
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
        let ridge = [0.51, 0.51, 0.0];
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
