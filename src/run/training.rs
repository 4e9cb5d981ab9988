//! Threads and time of training: the split of the CPU threads, and the share of a device's time.

use super::need::Need;
use super::{RunError, Settings, TrainingSettings};
use crate::backend::DeviceError;
use crate::progress::Work;
use crate::surrogate::{Kind, Learned};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;

/// Thread pools of a run.
pub(super) struct Threads {
    render: rayon::ThreadPool,
    /// Pool that trains during rendering, and the pool of all threads that trains afterwards. `None`: training does not overlap with rendering.
    train: Option<[rayon::ThreadPool; 2]>,
    /// True if training waits for the picture, so that all threads render: a device trains, or little training is needed.
    pub(super) take_turns: bool,
}

impl Threads {
    /// Splits the threads: `training.share` of them train, at least one. A single thread alternates between rendering and training.
    pub(super) fn new(threads: usize, scene: &Settings) -> Result<Self, RunError> {
        let learns = scene.render.method.has_surrogate() && scene.surrogate.kind != Kind::Table;
        let share = scene.training.share;
        let all = if threads > 0 { threads } else { std::thread::available_parallelism().map_or(1, |n| n.get()) };
        let pool = |n: usize, name: &'static str| {
            rayon::ThreadPoolBuilder::new().num_threads(n).thread_name(move |i| format!("{name}-{i}")).build()
        };
        if !learns || all == 1 || share == 0.0 {
            return Ok(Self { render: pool(all, "ridgewatch-render")?, train: None, take_turns: false });
        }
        let train = ((all as f64 * share).round() as usize).clamp(1, all - 1);
        let pools = [pool(train, "ridgewatch-train")?, pool(all, "ridgewatch-all")?];
        Ok(Self { render: pool(all - train, "ridgewatch-render")?, train: Some(pools), take_turns: false })
    }

    /// Pool that renders.
    pub(super) fn render(&self) -> &rayon::ThreadPool {
        match &self.train {
            Some([_, all]) if self.take_turns => all,
            _ => &self.render,
        }
    }

    /// Pool that trains during rendering, and pool that trains afterwards. `None` if training does not overlap with rendering.
    pub(super) fn beside(&self) -> Option<[&rayon::ThreadPool; 2]> {
        self.train.as_ref().filter(|_| !self.take_turns).map(|[beside, all]| [beside, all])
    }

    /// Pool of all threads.
    pub(super) fn all(&self) -> &rayon::ThreadPool {
        self.train.as_ref().map_or(&self.render, |[_, all]| all)
    }
}

/// Device time for training during a live run: a share of each second is credited, and the time used is subtracted.
#[derive(Debug)]
pub(super) struct TrainingBudget {
    share: f64,
    /// Credited seconds, and the time of the latest credit.
    due: f64,
    counted: f64,
}

impl TrainingBudget {
    /// Maximum credit, in seconds. Time missed while training was idle is not made up.
    const MAX_DUE: f64 = 1.0;
    /// Minimum seconds of one turn of training.
    const MIN_TURN: f64 = 0.01;

    /// A budget of `share` of the time at full need, from now on.
    pub(super) fn new(share: f64) -> Self {
        Self { share, due: 0.0, counted: 0.0 }
    }

    /// Returns the credited seconds at time `now` (seconds since the beginning), of which the latest come with this factor for the need;
    /// `None` if they are too few for a turn.
    pub(super) fn due(&mut self, now: f64, need: f64) -> Option<f64> {
        self.due = (self.due + need * self.share * (now - self.counted)).min(Self::MAX_DUE);
        self.counted = now;
        (self.due >= Self::MIN_TURN).then_some(self.due)
    }

    /// Subtracts the device time that training used, in seconds.
    pub(super) fn took(&mut self, seconds: f64) {
        self.due -= seconds;
    }
}

/// End of a part of a frame's training, unless the number of steps is given.
#[derive(Clone, Copy)]
pub(super) enum Until<'a> {
    /// The frame is rendered.
    Rendered(&'a AtomicBool),
    /// This many seconds have passed.
    Seconds(f64),
}

/// Trains in slices until the end is reached or a stop is requested. `learn` takes the maximum seconds and steps of a slice. The results are added to
/// `learned`, and tell how much training is needed next.
///
/// # Errors
/// The device fails; `learned` contains the slices before the failure.
pub(super) fn train(
    mut learn: impl FnMut(f64, u64) -> Result<Learned, DeviceError>,
    settings: &TrainingSettings,
    until: Until<'_>,
    stop: &AtomicBool,
    learned: &mut Learned,
    need: &mut Need,
) -> Result<(), DeviceError> {
    const SLICE: f64 = 0.1;
    /// Steps of a slice if the number of steps is given: the result must then not depend on wall-clock time.
    const SLICE_STEPS: u64 = 32;
    let start = Instant::now();
    let (mut sum, mut result) = (Learned::default(), Ok(()));
    let work = Work::begin("training");
    while !stop.load(Ordering::Relaxed) {
        work.reached_share(match (settings.steps_per_frame, until) {
            (Some(steps), _) => sum.steps as f64 / steps.max(1) as f64,
            (None, Until::Seconds(seconds)) => (start.elapsed().as_secs_f64() / seconds).min(1.0),
            // The frame tells how far it is.
            (None, Until::Rendered(_)) => 0.0,
        });
        let (seconds, steps) = match settings.steps_per_frame {
            Some(steps) if sum.steps >= steps => break,
            Some(steps) => (f64::INFINITY, (steps - sum.steps).min(SLICE_STEPS)),
            None => {
                let left = match until {
                    Until::Rendered(done) if done.load(Ordering::Acquire) => break,
                    Until::Rendered(_) => SLICE,
                    Until::Seconds(seconds) => seconds - start.elapsed().as_secs_f64(),
                };
                if left <= 0.0 {
                    break;
                }
                (left.min(SLICE), u64::MAX)
            }
        };
        let slice = match learn(seconds, steps) {
            Ok(slice) => slice,
            Err(error) => {
                result = Err(error);
                break;
            }
        };
        // A given number of steps is what is needed.
        if settings.steps_per_frame.is_none() {
            need.observe(&slice);
        }
        let learns = slice.steps > 0;
        sum = sum.and(slice);
        if !learns {
            break;
        }
    }
    *learned = std::mem::take(learned).and(Learned { seconds: start.elapsed().as_secs_f64(), ..sum });
    result
}

#[cfg(test)]
mod tests {
    use super::*;
    /// Every slice counts the same dropped samples again, so they are not summed. A slice that was rolled back has a loss as well.
    #[test]
    fn slices_add_up() {
        let slice = |steps, samples, loss, dropped| Learned { steps, samples, loss, dropped, ..Learned::default() };
        let rolled_back = Learned { lost_steps: 90, rollbacks: 1, ..slice(0, 200, Some(6.0), 3) };
        let slices = vec![slice(32, 300, Some(1.0), 3), slice(8, 500, Some(2.0), 2), rolled_back];
        let settings = TrainingSettings { steps_per_frame: Some(1000), ..TrainingSettings::default() };
        let (mut slices, mut sum) = (slices.into_iter(), Learned::default());
        let learn = |_, _| Ok(slices.next().unwrap_or_default());
        train(learn, &settings, Until::Seconds(1.0), &AtomicBool::new(false), &mut sum, &mut Need::default()).unwrap();
        assert_eq!((sum.steps, sum.lost_steps, sum.samples, sum.rollbacks, sum.dropped), (40, 90, 1000, 1, 3));
        // (300 * 1 + 500 * 2 + 200 * 6) / 1000.
        assert_eq!(sum.loss, Some(2.5));
        assert!(sum.seconds > 0.0);
        // The results before a device failure are kept.
        let (mut calls, mut sum) = (0, Learned::default());
        let fails = |_, _| {
            calls += 1;
            if calls < 3 { Ok(slice(5, 10, None, 0)) } else { Err(DeviceError::Driver { doing: "training", reason: "by the test".into() }) }
        };
        train(fails, &settings, Until::Seconds(1.0), &AtomicBool::new(false), &mut sum, &mut Need::default()).unwrap_err();
        assert_eq!((sum.steps, sum.samples), (10, 20));
    }

    /// Training gets its share of the time, as far as it is needed, for any length of frames and any delay of a turn.
    #[test]
    fn turns_are_a_share_of_the_time() {
        for (share, need, frame, longer) in
            [(0.25, 1.0, 0.007, 1.0), (0.25, 1.0, 0.2, 1.0), (0.75, 1.0, 0.03, 1.5), (0.5, 1.0, 0.4, 0.3), (0.5, 0.125, 0.03, 1.5)]
        {
            let (mut turns, mut now, mut trained) = (TrainingBudget::new(share), 0.0, 0.0);
            for _ in 0..20_000 {
                now += frame;
                while let Some(due) = turns.due(now, need) {
                    let took = longer * f64::min(due, 0.05);
                    turns.took(took);
                    now += took;
                    trained += took;
                }
            }
            assert!((trained / now - need * share).abs() < 0.01, "{need} of {share} of frames of {frame} s: {}", trained / now);
        }
        let mut none = TrainingBudget::new(0.0);
        assert_eq!(none.due(1e6, 1.0), None);
        let mut late = TrainingBudget::new(0.5);
        assert_eq!(late.due(1e6, 1.0), Some(TrainingBudget::MAX_DUE), "what was missed is not made up for");
    }
}
