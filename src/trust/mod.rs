//! Loss per cell, the gate between surrogate and RK4, drift.
//!
//! In: residuals of traced samples that the surrogate had not been trained on. Out: which cells may be answered by it, and what
//! error its answers have. Calls no other room: residuals come in already measured.

mod audited;
mod error;
mod map;

pub use audited::{Audited, CellErrors};
pub use error::TrustedError;
pub use map::{Gate, Residual, Strata, TrustMap};

use crate::setting::{Refused, count, positive, require};
use serde::{Deserialize, Serialize};

/// `[trust]` of a scene file.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct TrustSettings {
    /// Root mean square of the optical residual |ramp(predicted) - ramp(traced)| up to which a cell is trusted.
    pub tolerance: f64,
    /// Cells along x, y, z; None: about 512 in two dimensions, 4096 in three, as cubic as the domain allows.
    pub cells: Option<[usize; 3]>,
    /// Samples (decayed count) below which a cell is not trusted.
    pub min_samples: f64,
    /// Share of all queries that is drawn uniformly over the domain and traced whatever the gate says.
    pub audit_share: f64,
    /// Audit points a frame and cell at least: enough that a trusted cell keeps its trust by audits alone.
    pub audit_min_per_cell: usize,
    /// Standard error of the stated error, as a share of it, up to which trusted cells get more audit points.
    pub audit_precision: f64,
    /// Audit points a frame and cell on average at most (unless `audit_share` asks for more).
    pub audit_max_per_cell: usize,
    /// Factor on every cell's mean square residual when the window slides, at least; the growth measured at the last slide counts
    /// where it is larger.
    pub slide_inflation: f64,
    /// Seconds a frame may spend on tracing; beyond it untrusted cells are answered by the surrogate all the same and the frame is
    /// flagged `tolerance_excess`.
    pub trace_budget: Option<f64>,
}

impl Default for TrustSettings {
    fn default() -> Self {
        Self {
            tolerance: 0.03,
            cells: None,
            min_samples: 16.0,
            audit_share: 0.01,
            audit_min_per_cell: 8,
            audit_precision: 0.1,
            audit_max_per_cell: 32,
            slide_inflation: 4.0,
            trace_budget: None,
        }
    }
}

impl TrustSettings {
    /// Checks every value.
    pub fn check(&self) -> Result<(), Refused> {
        positive("trust.tolerance", self.tolerance)?;
        require((0.01..=1.0).contains(&self.audit_share), "trust.audit_share", self.audit_share, "a number from 0.01 to 1")?;
        count("trust.audit_min_per_cell", self.audit_min_per_cell, 1, 4096)?;
        count("trust.audit_max_per_cell", self.audit_max_per_cell, 1, 65_536)?;
        require((0.001..=1.0).contains(&self.audit_precision), "trust.audit_precision", self.audit_precision, "a number from 0.001 to 1")?;
        require((4.0..=4096.0).contains(&self.min_samples), "trust.min_samples", self.min_samples, "a number from 4 to 4096")?;
        let inflation = self.slide_inflation;
        require(inflation.is_finite() && inflation >= 1.0, "trust.slide_inflation", inflation, "a number from 1 up")?;
        if let Some(seconds) = self.trace_budget {
            positive("trust.trace_budget", seconds)?;
        }
        if let Some(cells) = self.cells {
            for n in cells {
                count("trust.cells", n, 1, 1024)?;
            }
            count("trust.cells", cells.iter().product(), 1, 1 << 20)?;
            // Every frame draws and traces this many points.
            let a_cell = self.min_samples.ceil().max(self.audit_min_per_cell.max(self.audit_max_per_cell) as f64);
            let points = a_cell * cells.iter().product::<usize>() as f64;
            if points > f64::from(1 << 26) {
                let found = format_args!("is {cells:?}, which asks for {points:.0} points a frame");
                return Err(Refused::new("trust.cells", found, "at most 2^26 points (cells x samples a cell)").beside(&[
                    "trust.min_samples",
                    "trust.audit_min_per_cell",
                    "trust.audit_max_per_cell",
                ]));
            }
        }
        Ok(())
    }
}
