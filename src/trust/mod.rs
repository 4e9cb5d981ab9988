//! Error of the surrogate per cell, the gate between surrogate and RK4, and drift between slides.
//!
//! In: residuals of traced samples that the surrogate has not been trained on. Out: the cells that the surrogate may answer, and the error of
//! its answers. Calls only `field` (the domain) and `setting`.

mod audited;
mod error;
mod evidence;
mod map;
mod strata;

pub use audited::{Audited, CellErrors};
pub use error::TrustedError;
pub use evidence::{GateEvidence, REJECTED};
pub use map::{Gate, TrustMap};
pub use strata::{Residual, Strata};

use ridgewatch_base::setting::{Refused, count, positive, require};
use serde::{Deserialize, Serialize};

/// `[trust]` of a scene file.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct TrustSettings {
    /// Largest root mean square of the optical residual |ramp(predicted) - ramp(traced)| of a trusted cell.
    pub tolerance: f64,
    /// Cells along x, y, z. `None`: about 512 in two dimensions and 4096 in three, as cubic as the domain allows.
    pub cells: Option<[usize; 3]>,
    /// Smallest number of samples (decayed count) of a trusted cell.
    pub min_samples: f64,
    /// Share of all queries that is drawn uniformly over the domain and always traced.
    pub audit_share: f64,
    /// Smallest number of audit points per frame and cell, with which a trusted cell stays trusted by audits alone.
    pub audit_min_per_cell: usize,
    /// Relative standard error of the stated error; trusted cells get more audit points until it is reached.
    pub audit_precision: f64,
    /// Largest average number of audit points per frame and cell (unless `audit_share` requires more).
    pub audit_max_per_cell: usize,
    /// Smallest factor on the mean square residual of every cell when the window slides. The growth measured at the previous slide replaces
    /// it if that is larger.
    pub slide_inflation: f64,
    /// Seconds that a frame may spend on tracing. After that the surrogate also answers in untrusted cells, and the frame is flagged
    /// `tolerance_excess`.
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
    ///
    /// # Errors
    /// The first key whose value is out of range.
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
            let per_cell = self.min_samples.ceil().max(self.audit_min_per_cell.max(self.audit_max_per_cell) as f64);
            let points = per_cell * cells.iter().product::<usize>() as f64;
            if points > f64::from(1 << 26) {
                let found = format_args!("is {cells:?}, which asks for {points:.0} points a frame");
                return Err(Refused::new("trust.cells", found, "at most 2^26 points (cells x samples per cell)").beside(&[
                    "trust.min_samples",
                    "trust.audit_min_per_cell",
                    "trust.audit_max_per_cell",
                ]));
            }
        }
        Ok(())
    }
}
