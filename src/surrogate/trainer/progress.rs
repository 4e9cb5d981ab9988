//! How far training has come, and what its losses say: whether it has diverged, and whether it still gets on.

/// A loss above this many times the first one (or the first one of this call, which may meet something new) counts as diverged.
const DIVERGED: f64 = 10.0;
/// What is new within a window makes weights wrong, but not more so than this many times the first loss.
const HARDEST: f64 = 10.0;
/// A loss below this is never a divergence: where there is nothing to learn (solid rotation) the first loss may be 0.
const NEGLIGIBLE: f64 = 1e-3;
/// Steps between two looks at whether the loss still falls.
const LOOK_EVERY: u64 = 512;
/// Fall of the smoothed loss between two looks, below which it counts as stalled.
const STALLED: f64 = 0.02;
/// Factor on the rate when stalled, and the least it may come to.
const STALL_FACTOR: f64 = 0.7;
/// See [`STALL_FACTOR`].
const LEAST_FACTOR: f64 = 0.1;

/// How far training has come; everything besides weights and moments that the next step depends on.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Progress {
    /// Samples drawn: the generator's counter.
    pub(super) drawn: u64,
    /// Steps since the start or the last slide, which the average is a share of.
    pub(super) averaged: u64,
    /// Factor on the rate for stalled losses.
    pub(super) stall: f64,
    /// Factor on the rate for divergences; rises at slides alone.
    pub(super) caution: f64,
    /// The largest of the losses of the first steps of all windows; 0 before any.
    pub(super) first_loss: f64,
    /// Smoothed loss, and its value at the last look; 0 before the first.
    pub(super) smooth: f64,
    pub(super) looked: f64,
}

impl Progress {
    /// Whether a step's loss says that training has diverged, `first` being that of the call's first step, the step the last of `averaged`.
    pub(super) fn diverges(&mut self, loss: f64, first: f64, averaged: u64) -> bool {
        // A flow may stretch ten times as much some windows later, and all that was learned be as wrong: that is not the training's fault.
        if loss.is_finite() && (self.first_loss == 0.0 || averaged == 1) {
            self.first_loss = self.first_loss.max(loss);
        }
        let hardest = first.min(HARDEST * self.first_loss);
        let limit = DIVERGED * self.first_loss.max(hardest).max(NEGLIGIBLE);
        !loss.is_finite() || loss > limit
    }

    /// All labels are others now: the rate is the first one again, but for half of the caution.
    pub(super) fn window_slid(&mut self) {
        let caution = (2.0 * self.caution).min(1.0);
        *self = Self { averaged: 0, stall: 1.0, caution, smooth: 0.0, looked: 0.0, ..*self };
    }

    /// Takes a step's loss in, the last of `averaged`, and lowers the rate when the loss has stopped falling.
    pub(super) fn observe(&mut self, loss: f64, averaged: u64) {
        self.smooth = if self.smooth == 0.0 { loss } else { 0.99 * self.smooth + 0.01 * loss };
        if averaged.is_multiple_of(LOOK_EVERY) {
            if self.looked > 0.0 && self.smooth > (1.0 - STALLED) * self.looked {
                self.stall = (self.stall * STALL_FACTOR).max(LEAST_FACTOR);
            }
            self.looked = self.smooth;
        }
    }
}
