//! Which threads train while the others render, and for how long; where a device trains, for how long after the picture.

use super::{EngineError, Settings, TrainingSettings};
use crate::render::Method;
use crate::surrogate::{Kind, Learned, SampleRing, Surrogate};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;

/// The pools of a run.
pub(super) struct Threads {
    render: rayon::ThreadPool,
    /// Trains while the frame is rendered, and the pool of all threads that goes on when it is.
    train: Option<[rayon::ThreadPool; 2]>,
    /// Whether a device trains, so that all threads render.
    pub(super) device_trains: bool,
}

impl Threads {
    /// `share` of the threads train, at least one; with a single thread rendering and training take turns.
    pub(super) fn new(threads: usize, scene: &Settings) -> Result<Self, EngineError> {
        let learns = scene.render.method != Method::Reference && scene.surrogate.kind != Kind::Table;
        let share = scene.training.share;
        let all = if threads > 0 { threads } else { std::thread::available_parallelism().map_or(1, |n| n.get()) };
        let pool = |n: usize, name: &'static str| {
            rayon::ThreadPoolBuilder::new().num_threads(n).thread_name(move |i| format!("{name}-{i}")).build()
        };
        if !learns || all == 1 || share == 0.0 {
            return Ok(Self { render: pool(all, "ridgewatch-render")?, train: None, device_trains: false });
        }
        let train = ((all as f64 * share).round() as usize).clamp(1, all - 1);
        let pools = [pool(train, "ridgewatch-train")?, pool(all, "ridgewatch-all")?];
        Ok(Self { render: pool(all - train, "ridgewatch-render")?, train: Some(pools), device_trains: false })
    }

    /// Who renders.
    pub(super) fn render(&self) -> &rayon::ThreadPool {
        match &self.train {
            Some([_, all]) if self.device_trains => all,
            _ => &self.render,
        }
    }

    /// Who trains while the frame is rendered, and who goes on when it is; none: training waits for its turn.
    pub(super) fn beside(&self) -> Option<[&rayon::ThreadPool; 2]> {
        self.train.as_ref().filter(|_| !self.device_trains).map(|[beside, all]| [beside, all])
    }

    /// All of them.
    pub(super) fn all(&self) -> &rayon::ThreadPool {
        self.train.as_ref().map_or(&self.render, |[_, all]| all)
    }
}

/// When a share of a frame's training ends, unless the number of steps is given.
#[derive(Clone, Copy)]
pub(super) enum Until<'a> {
    /// When the frame is rendered.
    Rendered(&'a AtomicBool),
    /// After so many seconds.
    Seconds(f64),
}

/// Trains in slices until the end is reached or the run is to stop.
pub(super) fn train(
    live: &mut dyn Surrogate,
    ring: &SampleRing,
    settings: &TrainingSettings,
    until: Until<'_>,
    stop: &AtomicBool,
) -> Learned {
    const SLICE: f64 = 0.1;
    /// Steps of a slice where their number is given: wall clock must not decide anything then.
    const SLICE_STEPS: u64 = 32;
    let start = Instant::now();
    let mut sum = Learned::default();
    let mut losses = (0.0, 0.0);
    while !stop.load(Ordering::Relaxed) {
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
        let slice = live.learn(ring, seconds, steps);
        sum.dropped += slice.dropped;
        sum.rollbacks += slice.rollbacks;
        sum.lost_steps += slice.lost_steps;
        sum.device_seconds = slice.device_seconds.map(|seconds| seconds + sum.device_seconds.unwrap_or(0.0)).or(sum.device_seconds);
        if slice.steps == 0 {
            break;
        }
        sum.steps += slice.steps;
        sum.samples += slice.samples;
        if let Some(loss) = slice.loss.filter(|loss| loss.is_finite()) {
            losses = (losses.0 + loss * slice.steps as f64, losses.1 + slice.steps as f64);
        }
    }
    sum.loss = (losses.1 > 0.0).then(|| losses.0 / losses.1);
    sum.seconds = start.elapsed().as_secs_f64();
    sum
}
