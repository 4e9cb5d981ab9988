//! Choice of the steps that the window keeps if memory does not hold all, and the interpolation error of this choice.

use ridgewatch_field::{Snapshot, Window};
use std::sync::Arc;

/// Nodes at which the interpolation is measured.
const PROBES: usize = 1 << 15;

/// Keeps steps at least a spacing apart. Measures the error of linear interpolation in time on one skipped step of each interval.
#[derive(Debug)]
pub(super) struct Thinning {
    spacing: f64,
    kept: Option<Arc<Snapshot>>,
    skipped: Option<Arc<Snapshot>>,
    /// Error of the newest interval, relative to the velocity.
    pub error: Option<f64>,
    /// Number of skipped steps.
    pub count: u64,
}

impl Thinning {
    /// For a window over `tau` of at most `snapshots` snapshots (at least 3).
    pub fn new(tau: f64, snapshots: usize) -> Self {
        // The window reaches from a snapshot at or before its oldest time to its newest.
        let intervals = snapshots.saturating_sub(2).max(1);
        Self { spacing: tau / intervals as f64, kept: None, skipped: None, error: None, count: 0 }
    }

    /// Minimum distance in time of two kept steps.
    pub fn spacing(&self) -> f64 {
        self.spacing
    }

    /// True if a step of this time is to be kept: no step of another time in the window is too near. The window itself judges repeated and late
    /// times.
    pub fn keeps(&self, time: f64, window: &Window) -> bool {
        window.is_late(time) || window.distance(time).is_none_or(|distance| distance >= self.spacing * (1.0 - 1e-9))
    }

    /// Registers a skipped step; may call `build` for its snapshot.
    pub fn skip(&mut self, time: f64, build: impl FnOnce() -> Arc<Snapshot>) {
        self.count += 1;
        let Some(kept) = self.kept.as_ref().filter(|kept| kept.time < time) else { return };
        // Prefer the first step beyond the middle, where the interpolation error is largest; until then take the newest.
        let middle = kept.time + self.spacing / 2.0;
        if self.skipped.as_ref().is_none_or(|last| last.time < middle) {
            self.skipped = Some(build());
        }
    }

    /// Registers a kept step.
    pub fn keep(&mut self, snapshot: &Arc<Snapshot>) {
        if let (Some(before), Some(between)) = (&self.kept, self.skipped.take())
            && before.time < between.time
            && between.time < snapshot.time
        {
            self.error = interpolation_error(before, &between, snapshot).or(self.error);
        }
        // A step that repeats a time replaces the earlier one, as in the window.
        if self.kept.as_ref().is_none_or(|kept| kept.time <= snapshot.time) {
            self.kept = Some(snapshot.clone());
        }
    }

    /// Resets everything except the spacing and the count.
    pub fn restart(&mut self) {
        (self.kept, self.skipped, self.error) = (None, None, None);
    }
}

/// Root mean square of |v - interpolated v| over that of |v|, on up to 32768 nodes whose velocity is known at all three times.
fn interpolation_error(before: &Snapshot, between: &Snapshot, after: &Snapshot) -> Option<f64> {
    let share = ((between.time - before.time) / (after.time - before.time)) as f32;
    let (mut difference, mut size) = (0.0, 0.0);
    let count = between.nodes.len();
    // An odd stride, so that it does not meet the same column of every row.
    let stride = (count / PROBES).max(1) | 1;
    for i in (0..count).step_by(stride) {
        let (a, v, b) = (before.nodes[i], between.nodes[i], after.nodes[i]);
        if a[3].is_nan() || v[3].is_nan() || b[3].is_nan() {
            continue;
        }
        for k in 0..3 {
            let interpolated = a[k] + share * (b[k] - a[k]);
            difference += f64::from(v[k] - interpolated).powi(2);
            size += f64::from(v[k]).powi(2);
        }
    }
    (size > 0.0).then(|| (difference / size).sqrt())
}

#[cfg(test)]
mod tests {
    use super::*;
    use ridgewatch_field::{Axis, Geometry, Grid};

    fn at(time: f64) -> Snapshot {
        let axis = |n| Axis::uniform(n, "m", 0.0, 1.0, 3).unwrap();
        let grid = Arc::new(Grid { axes: vec![axis("x"), axis("y")], geometry: Geometry::Cartesian, slab: (0.0, 1.0) });
        // Turns once in 2 pi: |v| = 1, and interpolation over an interval h loses 1 - cos(h / 2) at its middle.
        Snapshot::from_components(time, grid, &[time.cos() as f32; 9], &[time.sin() as f32; 9], &[])
    }

    #[test]
    fn what_thinning_costs_is_measured() {
        let mut thinning = Thinning::new(6.0, 14);
        assert_eq!(thinning.spacing(), 0.5);
        let (mut window, mut kept) = (Window::new(6.0), Vec::new());
        for n in 0..101 {
            let time = f64::from(n) * 0.05;
            if thinning.keeps(time, &window) {
                let snapshot = Arc::new(at(time));
                thinning.keep(&snapshot);
                window.push(snapshot).unwrap();
                kept.push(time);
            } else {
                thinning.skip(time, || Arc::new(at(time)));
            }
        }
        assert_eq!(kept.len(), 11, "{kept:?}");
        assert!(kept.windows(2).all(|w| (w[1] - w[0] - 0.5).abs() < 1e-9));
        assert_eq!(thinning.count, 90);
        let (error, expected) = (thinning.error.unwrap(), 1.0 - 0.25f64.cos());
        assert!((error / expected - 1.0).abs() < 0.02, "{error} {expected}");
    }

    #[test]
    fn steps_far_apart_are_all_kept() {
        let (mut thinning, mut window) = (Thinning::new(6.0, 14), Window::new(6.0));
        for n in 0..10 {
            let time = f64::from(n) * 0.7;
            assert!(thinning.keeps(time, &window));
            let snapshot = Arc::new(at(time));
            thinning.keep(&snapshot);
            window.push(snapshot).unwrap();
        }
        assert_eq!((thinning.count, thinning.error), (0, None));
        assert!(thinning.keeps(-1.0, &window) && thinning.keeps(6.3, &window), "what is late, or repeats a time, is the window's to judge");
    }

    #[test]
    fn however_times_come_the_window_has_room_for_what_is_kept() {
        // Falling times, times that go back and forth, and random times (a linear congruential generator).
        let mut state = 1u64;
        let mut random = move || {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (state >> 40) as f64 / f64::from(1 << 24)
        };
        let random: Vec<f64> = (0..400).map(|n| 20.0 * random() + 0.1 * f64::from(n)).collect();
        let falling = (0..400).map(|n| -0.05 * f64::from(n)).collect();
        let to_and_fro = (0..400).map(|n| 0.1 * f64::from(n) - f64::from(n % 7)).collect();
        for times in [falling, to_and_fro, random] {
            let (mut thinning, mut window) = (Thinning::new(6.0, 14), Window::new(6.0));
            let mut most = 0;
            for time in times {
                if !thinning.keeps(time, &window) {
                    thinning.skip(time, || Arc::new(at(time)));
                    continue;
                }
                let snapshot = Arc::new(at(time));
                thinning.keep(&snapshot);
                let _ = window.push(snapshot);
                most = most.max(window.snapshots().len());
            }
            assert!((8..=14).contains(&most), "{most}");
            assert!(thinning.count > 0);
        }
    }
}
