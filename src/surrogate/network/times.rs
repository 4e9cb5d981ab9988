//! Start time and duration as inputs: their ranges, and the row of numbers that a network is shown.

use super::{Input, NetworkSettings};

/// Columns of a [`Row`]: unit coordinates along x, y and z, then start time and duration in the unit interval of their ranges.
pub(super) const COLUMNS: usize = 5;
/// The first column behind the coordinates.
pub(super) const FIRST_TIME: usize = 3;

/// Everything that a network may be shown of a sample; [`super::Architecture::axes`] says which columns it is shown.
pub type Row = [f32; COLUMNS];

/// Start time and duration of samples that say nothing of time.
pub const UNTIMED: [f32; 2] = [0.0, 1.0];

/// The row of a unit point.
pub fn row([x, y, z]: [f32; 3], [start, duration]: [f32; 2]) -> Row {
    [x, y, z, start, duration]
}

impl Input {
    /// Its column in a [`Row`].
    pub(super) fn column(self) -> usize {
        match self {
            Self::Start => FIRST_TIME,
            Self::Duration => FIRST_TIME + 1,
        }
    }
}

/// Which times a network is shown, and over which ranges they run.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Times {
    /// Seed times that become 0 and 1; none where the start is no input.
    pub starts: Option<[f64; 2]>,
    /// The duration that becomes 1: the largest.
    pub tau: f64,
}

impl Times {
    /// Of a network with these settings, for durations up to `tau`.
    pub fn new(settings: &NetworkSettings, tau: f64) -> Self {
        Self { starts: settings.start_range.filter(|_| settings.inputs.contains(&Input::Start)), tau }
    }

    /// A seed time and a duration in unit intervals. Beyond its range a time is answered as its end is.
    pub fn unit(&self, start: f64, duration: f64) -> [f32; 2] {
        let start = self.starts.map_or(0.0, |[first, last]| (start - first) / (last - first));
        [start, duration / self.tau].map(|time| time.clamp(0.0, 1.0) as f32)
    }

    /// Whether labels of a window that begins at `before` stay right beside those of one that begins at `now`: the network tells both starts
    /// apart. One beyond its range is answered as the end is, which labels of that end contradict.
    pub fn hold(&self, before: f64, now: f64) -> bool {
        self.tells(before) && self.tells(now)
    }

    /// Whether the network tells this start from others.
    pub fn tells(&self, start: f64) -> bool {
        // The last of many slides may end beside the range by rounding.
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
        assert!(times.tells(-2.0) && times.tells(6.0) && !times.tells(6.1));
        // A window before the range leaves labels that contradict those of its begin.
        assert!(times.hold(-2.0, 6.0) && !times.hold(-3.0, -2.0) && !times.hold(6.0, 6.1));
        let blind = Times::new(&NetworkSettings { inputs: Vec::new(), ..settings }, 4.0);
        assert!(!blind.tells(0.0) && blind.unit(3.0, 4.0) == UNTIMED);
    }
}
