//! Start time and duration as inputs: their ranges, and the columns that a network reads.

use super::settings::{Input, NetworkSettings};
use ridgewatch_field::UnitPoint;

/// Names of the columns of a [`Row`].
pub(super) const COLUMN_NAMES: [&str; 5] = ["x", "y", "z", "start", "duration"];
/// First column after the coordinates.
pub(super) const FIRST_TIME: usize = 3;

/// All possible inputs of one sample: unit coordinates along x, y and z, then start time and duration in the unit intervals of their
/// ranges. [`super::Architecture::axes`] lists the columns that a network reads.
pub type Row = [f32; COLUMN_NAMES.len()];

/// Start time and duration of samples without times.
pub const UNTIMED: [f32; 2] = [0.0, 1.0];

/// The row of a unit point.
pub fn row(UnitPoint([x, y, z]): UnitPoint, [start, duration]: [f32; 2]) -> Row {
    [x, y, z, start, duration]
}

impl Input {
    /// Its column in a [`Row`].
    pub(super) fn column(self) -> usize {
        FIRST_TIME + self as usize
    }
}

/// Ranges of the start time and the duration.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Times {
    /// Seed times that become 0 and 1; `None` if the start is no input.
    pub starts: Option<[f64; 2]>,
    /// The duration that becomes 1: the longest.
    pub tau: f64,
}

impl Times {
    /// Times of a network with these settings, for durations up to `tau`.
    pub fn new(settings: &NetworkSettings, tau: f64) -> Self {
        Self { starts: settings.start_range.filter(|_| settings.inputs.contains(&Input::Start)), tau }
    }

    /// A seed time and a duration in unit intervals, clamped to their ranges.
    pub fn unit(&self, start: f64, duration: f64) -> [f32; 2] {
        let start = self.starts.map_or(0.0, |[first, last]| (start - first) / (last - first));
        [start, duration / self.tau].map(|time| time.clamp(0.0, 1.0) as f32)
    }

    /// Labels of a window that begins at `before` stay valid beside those of one that begins at `now`: both starts are in range. A start
    /// out of range is clamped, so its labels contradict those at the end of the range.
    pub fn labels_stay_valid(&self, before: f64, now: f64) -> bool {
        self.covers_start(before) && self.covers_start(now)
    }

    /// The start is an input, and in its range.
    pub fn covers_start(&self, start: f64) -> bool {
        // Rounding may put the last of many slides slightly out of the range.
        self.starts.is_some_and(|[first, last]| {
            let slack = 1e-9 * (last - first);
            (first - slack..=last + slack).contains(&start)
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn times_become_their_share_of_the_range() {
        let settings = NetworkSettings { inputs: vec![Input::Start], start_range: Some([-2.0, 6.0]), ..NetworkSettings::default() };
        let times = Times::new(&settings, 4.0);
        assert_eq!(times.unit(0.0, 1.0), [0.25, 0.25]);
        assert_eq!(times.unit(9.0, 4.0), [1.0, 1.0]);
        assert!(times.covers_start(-2.0) && times.covers_start(6.0) && !times.covers_start(6.1));
        // A window before the range leaves labels that contradict those at its begin.
        assert!(times.labels_stay_valid(-2.0, 6.0) && !times.labels_stay_valid(-3.0, -2.0) && !times.labels_stay_valid(6.0, 6.1));
        let blind = Times::new(&NetworkSettings { inputs: Vec::new(), ..settings }, 4.0);
        assert!(!blind.covers_start(0.0) && blind.unit(3.0, 4.0) == UNTIMED);
    }
}
