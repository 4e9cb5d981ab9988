//! Progress of training: counters, learning-rate factors, and detection of divergence and stagnation from the losses.

/// A loss above this multiple of the first one (or of the first one of this call, which may have new data) counts as diverged.
const DIVERGED: f64 = 10.0;
/// Upper bound on the first loss of a call, as a multiple of the first loss of the window.
const HARDEST: f64 = 10.0;
/// A loss below this never counts as diverged, since the first loss may be 0 (solid rotation, for example).
const NEGLIGIBLE: f64 = 1e-3;
/// Steps between two checks whether the loss still falls.
const LOOK_EVERY: u64 = 512;
/// Relative decrease of the smoothed loss between two checks below which it counts as stalled.
const STALLED: f64 = 0.02;
/// Factor on the rate at each stall, and the lower bound of their product.
const STALL_FACTOR: f64 = 0.7;
/// See [`STALL_FACTOR`].
const MIN_FACTOR: f64 = 0.1;

/// State of training besides weights and moments.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Progress {
    /// Samples drawn: the generator's counter.
    pub(super) drawn: u64,
    /// Steps since the start or the last slide; the average covers a share of them.
    pub(super) averaged: u64,
    /// Factor on the rate for stalled losses.
    pub(super) stall: f64,
    /// Factor on the rate for divergences. It rises only at slides.
    pub(super) caution: f64,
    /// The largest of the losses of the first steps of all windows; 0 before any.
    pub(super) first_loss: f64,
    /// Smoothed loss, and its value at the last check; 0 before the first.
    pub(super) smooth: f64,
    pub(super) looked: f64,
}

impl Progress {
    /// True if the loss of the step number `averaged` indicates divergence. `first` is the loss of the call's first step.
    pub(super) fn diverges(&mut self, loss: f64, first: f64, averaged: u64) -> bool {
        // The stretch of a flow may grow tenfold within some windows. The loss grows with it although training has not diverged.
        if loss.is_finite() && (self.first_loss == 0.0 || averaged == 1) {
            self.first_loss = self.first_loss.max(loss);
        }
        let hardest = first.min(HARDEST * self.first_loss);
        let limit = DIVERGED * self.first_loss.max(hardest).max(NEGLIGIBLE);
        !loss.is_finite() || loss > limit
    }

    /// Resets the rate for the labels of a new window, and relaxes the factor for divergences by half.
    pub(super) fn window_slid(&mut self) {
        let caution = (2.0 * self.caution).min(1.0);
        *self = Self { averaged: 0, stall: 1.0, caution, smooth: 0.0, looked: 0.0, ..*self };
    }

    /// Adds the loss of the step number `averaged`, and lowers the rate if the loss has stopped falling.
    pub(super) fn observe(&mut self, loss: f64, averaged: u64) {
        self.smooth = if self.smooth == 0.0 { loss } else { 0.99 * self.smooth + 0.01 * loss };
        if averaged.is_multiple_of(LOOK_EVERY) {
            if self.looked > 0.0 && self.smooth > (1.0 - STALLED) * self.looked {
                self.stall = (self.stall * STALL_FACTOR).max(MIN_FACTOR);
            }
            self.looked = self.smooth;
        }
    }
}
