//! The schedule of training: samples, learning rate, duration, averaged weights for prediction, and roll-back after divergence.
//!
//! The number of steps is unknown in advance, so the learning rate cannot decay towards a final step. Instead the rate stays high, and the weights
//! for prediction are a running mean over the last share of the steps (Polyak and Juditsky 1992), which has the effect of a decaying rate at every
//! step. The rate is lowered only when the loss has stopped falling.

use super::device::{HostNetwork, Labels, NetworkCopy, SurrogateTable, SyncedSamples, Training};
use super::network::{Architecture, Encoding, Field, Model, NetworkSettings, Objective, PlannedStep, Times};
use super::{Learned, NetworkFrom, ReplayBuffer, SurrogateError};
use copy::{Copies, PendingCopy};
use progress::Progress;
use ridgewatch_base::DeviceError;
use ridgewatch_base::progress::Work;
use ridgewatch_flow::Tracer;
use std::sync::Arc;
use std::time::Instant;

mod copy;
mod progress;
mod restart;
#[cfg(test)]
mod tests;

pub(super) use restart::NetworkState;

/// Steps between two updates of the average. It changes slowly, and every update reads and writes all parameters.
const AVERAGE_EVERY: u64 = 8;
/// Steps between two copies of the last good weights.
const KEEP_EVERY: u64 = 512;
/// Factor on the rate below which a call stops after a roll-back.
const MIN_CAUTION: f64 = 1e-6;

/// The state to roll back to.
struct Kept {
    steps: usize,
    progress: Progress,
    /// True if the window has slid since, so that a roll-back to it is not allowed. The next copy reuses its memory.
    is_stale: bool,
}

/// A network, its optimizer and its schedule.
pub(super) struct Trainer<T: Training> {
    pub(super) training: T,
    objective: Objective,
    progress: Progress,
    settings: NetworkSettings,
    rate: f64,
    seed: u64,
    /// Ranges of the times that are inputs, and the times of predictions, in unit intervals.
    times: Times,
    asked: [f32; 2],
    /// Start time of the latest window.
    start: f64,
    standardised: bool,
    kept: Option<Kept>,
    copies: Copies,
    /// Results of calls that failed later.
    unreported: Learned,
}

impl<T: Training> Trainer<T> {
    /// Creates a trainer of a new network for the flow map of `tracer`. `zero_output`: the output layer starts at 0. `training` moves the network to
    /// its device.
    ///
    /// # Errors
    /// A setting is out of range.
    pub(super) fn new(
        settings: &NetworkSettings,
        tracer: &dyn Tracer,
        seed: u64,
        zero_output: bool,
        training: impl FnOnce(Model) -> T,
    ) -> Result<Self, SurrogateError> {
        let (domain, tau) = (tracer.domain(), tracer.tau());
        let axes: Vec<usize> = (0..domain.dimensions.clamp(1, 3)).collect();
        let shape = Architecture::new(settings, &axes, domain.lengths())?;
        let objective = Objective::new(settings, &shape, domain.extent(), tau);
        // The published rate of 1e-4 is for a day of training; ten times that converges faster within minutes.
        let default = match settings.encoding {
            Encoding::HashGrid => 1e-2,
            Encoding::Frequency => 1e-3,
        };
        let progress = Progress { drawn: 0, averaged: 0, stall: 1.0, caution: 1.0, first_loss: 0.0, smooth: 0.0, looked: 0.0 };
        let times = Times::new(settings, tau);
        Ok(Self {
            training: training(Model::new(shape, seed, zero_output)),
            objective,
            progress,
            settings: settings.clone(),
            rate: f64::from(settings.learning_rate.unwrap_or(default)),
            seed,
            times,
            asked: times.unit(tracer.start(), tau),
            start: tracer.start(),
            standardised: false,
            kept: None,
            copies: Copies::new(progress),
            unreported: Learned::default(),
        })
    }

    /// Start time and duration of predictions, in unit intervals.
    pub(super) fn asked_times(&self) -> [f32; 2] {
        self.asked
    }

    /// Returns the averaged network, for prediction.
    pub(super) fn frozen(&self) -> Result<Arc<T::Network>, DeviceError> {
        self.training.frozen(&self.objective)
    }

    /// Moves the network to a new window: the weights are kept, the average starts again, and the rate returns to its first value. If the start time
    /// is an input, the network remains valid and training continues unchanged.
    pub(super) fn window_slid(&mut self, tracer: &dyn Tracer) {
        self.asked = self.times.unit(tracer.start(), tracer.tau());
        let before = std::mem::replace(&mut self.start, tracer.start());
        if self.times.labels_stay_valid(before, self.start) {
            return;
        }
        self.disown_kept();
        self.progress.window_slid();
        self.training.forget_labels();
    }

    /// Sets the output layer back to 0, in the weights, the moments and the average. The hidden layers keep their weights.
    pub(super) fn forget_output(&mut self) -> Result<(), DeviceError> {
        self.disown_kept();
        self.training.zero_output()
    }

    fn disown_kept(&mut self) {
        if let Some(kept) = &mut self.kept {
            kept.is_stale = true;
        }
    }

    /// Trains on the buffer's samples, or on their differences from `base`.
    ///
    /// # Errors
    /// The device fails or lacks memory. The steps before the failure are part of the next call's result.
    pub(super) fn learn(
        &mut self,
        buffer: &ReplayBuffer,
        base: Option<&T::Table>,
        seconds: f64,
        max_steps: u64,
    ) -> Result<Learned, DeviceError> {
        let start = Instant::now();
        let mut learned = Learned::default();
        let trained = self.train(Labels { buffer, base }, start, seconds, max_steps, &mut learned);
        learned.device_seconds = self.training.device_seconds();
        learned.seconds = start.elapsed().as_secs_f64();
        let learned = std::mem::take(&mut self.unreported).and(learned);
        match trained {
            Ok(()) => Ok(learned),
            Err(error) => {
                self.unreported = learned;
                Err(error)
            }
        }
    }

    fn train(
        &mut self,
        labels: Labels<'_, T::Table>,
        start: Instant,
        seconds: f64,
        max_steps: u64,
        learned: &mut Learned,
    ) -> Result<(), DeviceError> {
        let (samples, batch) = (labels.buffer.samples(), self.settings.batch_on(self.training.is_on_device()));
        if !self.standardised && (0..samples.len()).any(|index| self.objective.is_usable(samples, index)) {
            let base = labels.base.map(SurrogateTable::to_host).transpose()?;
            self.objective.standardise(self.training.shape(), samples, base.as_ref().map(|base| base as &dyn Field));
            self.standardised = true;
        }
        // The network moves to the device together with the scale of the targets, so the scale must be known first.
        if self.standardised {
            self.training.begin(&self.objective, labels.buffer.capacity(), batch)?;
        }
        let SyncedSamples { usable, dropped } = self.training.sync(&self.objective, labels)?;
        learned.dropped = dropped as u64;
        if usable == 0 {
            return Ok(());
        }
        // With few samples, a large batch would only repeat them.
        let count = batch.min(usable.max(256));
        let (mut losses, mut counted, mut first_of_call) = (0.0, 0_u64, None::<f64>);
        let began = self.training.steps_taken();
        // Without a number of steps, the caller knows when it ends.
        let work = (max_steps < u64::MAX).then(|| Work::begin("optimizer steps"));
        while learned.steps < max_steps && start.elapsed().as_secs_f64() < seconds {
            let steps = self.training.steps_taken();
            // The first step of a call is the most likely to diverge, but short calls should not need a copy.
            let apart = if learned.steps == 0 { KEEP_EVERY / 8 } else { KEEP_EVERY };
            let may_keep = learned.steps == 0 || (steps as u64).is_multiple_of(KEEP_EVERY);
            if may_keep && self.kept.as_ref().is_none_or(|kept| kept.is_stale || steps as u64 >= kept.steps as u64 + apart) {
                self.training.keep()?;
                self.kept = Some(Kept { steps, progress: self.progress, is_stale: false });
            }
            let most = (KEEP_EVERY - steps as u64 % KEEP_EVERY).min(max_steps - learned.steps);
            let group = most.min(self.training.group(seconds - start.elapsed().as_secs_f64()));
            let before = self.progress;
            let (planned, averaged): (Vec<PlannedStep>, Vec<u64>) = (0..group).map(|_| self.plan(count, labels.base.is_some())).unzip();
            let found = self.training.train(&self.objective, labels, &planned).inspect_err(|_| self.progress = before)?;
            learned.samples += (found.len() * count) as u64;
            let mut diverged = false;
            for (loss, averaged) in found.into_iter().zip(averaged) {
                diverged = self.progress.diverges(loss, *first_of_call.get_or_insert(loss), averaged);
                if diverged {
                    break;
                }
                (losses, counted) = (losses + loss, counted + 1);
                self.progress.observe(loss, averaged);
            }
            learned.loss = (counted > 0).then(|| losses / counted as f64);
            if diverged {
                learned.rollbacks += 1;
                // The moments have diverged too, so the steps since the last copy are lost.
                let reached = self.training.steps_taken();
                self.roll_back()?;
                let kept = self.training.steps_taken();
                learned.lost_steps += reached.saturating_sub(kept) as u64;
                if self.progress.caution < MIN_CAUTION {
                    learned.steps = kept.saturating_sub(began) as u64;
                    break;
                }
            }
            learned.steps = self.training.steps_taken().saturating_sub(began) as u64;
            work.iter().for_each(|work| work.reached_share(learned.steps as f64 / max_steps as f64));
        }
        if self.settings.averaging == 0.0 || self.progress.averaged < AVERAGE_EVERY {
            self.training.restart_average()?;
        }
        self.training.settle();
        self.take_in();
        if self.training.is_on_device() && self.copies.is_due() { self.update_host_copy(learned) } else { Ok(()) }
    }

    /// Counts the next step. Returns it with the number of steps since the start of the average.
    fn plan(&mut self, count: usize, hold_out: bool) -> (PlannedStep, u64) {
        let progress = &mut self.progress;
        let drawn = Some((self.seed, progress.drawn));
        progress.drawn += count as u64;
        progress.averaged += 1;
        let average_share = if self.settings.averaging > 0.0 && progress.averaged.is_multiple_of(AVERAGE_EVERY) {
            (AVERAGE_EVERY as f32 / (self.settings.averaging * progress.averaged as f32)).min(1.0)
        } else {
            0.0
        };
        let rate = self.rate * progress.stall * progress.caution;
        (PlannedStep { count, drawn, hold_out, rate, average_share, lazy: true }, progress.averaged)
    }

    /// Returns to the last good weights, at half the rate. The random counter is not reset, so that other batches are drawn.
    fn roll_back(&mut self) -> Result<(), DeviceError> {
        let (drawn, caution) = (self.progress.drawn, self.progress.caution * 0.5);
        let Some(kept) = self.kept.as_ref().filter(|kept| !kept.is_stale) else { return Ok(()) };
        self.training.roll_back()?;
        self.copies.is_rolled_back = self.copies.pending.is_some();
        self.progress = Progress { drawn, caution, ..kept.progress };
        Ok(())
    }

    /// Starts the download of the network. If the device has no memory for a copy, training waits.
    fn update_host_copy(&mut self, learned: &mut Learned) -> Result<(), DeviceError> {
        let begin = Instant::now();
        let Some(copy) = self.copy()? else { return Ok(()) };
        let wait = match copy {
            NetworkSource::Pending(pending) => {
                let name = "ridgewatch-download".to_owned();
                // If no thread starts, the next reader downloads the copy.
                self.copies.thread = std::thread::Builder::new().name(name).spawn(move || drop(pending.fetch().cloned())).ok();
                None
            }
            NetworkSource::Here(network, why) => {
                self.copies.progress = self.progress;
                self.training.set_host_copy(network);
                why
            }
        };
        let copies = &mut self.copies;
        (copies.made, copies.wait_seconds) = (Instant::now(), begin.elapsed().as_secs_f64());
        if let Some(why) = wait.filter(|_| !std::mem::replace(&mut copies.has_warned, true)) {
            learned.warnings.push(format!(
                "training waited {:.2} s for the download of the network from the GPU, this time and every {:.0} s or so: {why}",
                copies.wait_seconds,
                copies.interval()
            ));
        }
        Ok(())
    }

    /// Copies the present network; `None` while an earlier copy is still being downloaded.
    fn copy(&mut self) -> Result<Option<NetworkSource>, DeviceError> {
        self.take_in();
        if self.copies.pending.is_some() {
            return Ok(None);
        }
        Ok(Some(match self.training.copy()? {
            NetworkCopy::Ready(network, why) => NetworkSource::Here(network, why),
            NetworkCopy::Downloadable(download) => {
                let pending = PendingCopy::new(download, self.progress);
                self.copies.is_rolled_back = false;
                NetworkSource::Pending(self.copies.pending.insert(pending).clone())
            }
        }))
    }

    /// Stores a copy whose download is complete, if there is one.
    fn take_in(&mut self) {
        let Some(mut pending) = self.copies.pending.take() else { return };
        // Checked before the result, since the downloading thread drops its reference last.
        let is_shared = Arc::get_mut(&mut pending).is_none();
        match pending.ready() {
            Some(_) if std::mem::take(&mut self.copies.is_rolled_back) => {}
            Some(Ok(network)) => {
                let stale = self.training.host_copy().clone();
                self.training.set_host_copy(network.clone());
                self.copies.progress = pending.progress;
                // Freeing hundreds of megabytes takes as long as a frame.
                drop(std::thread::Builder::new().spawn(move || drop(stale)));
            }
            Some(Err(_)) => {}
            None if is_shared => self.copies.pending = Some(pending),
            None => {}
        }
    }

    /// Returns a trainer that continues with the network from `from`, which `training` moves to another device.
    ///
    /// # Errors
    /// The network is downloaded from the device, and the device fails.
    pub(super) fn moved<E: Training>(
        &mut self,
        from: NetworkFrom,
        training: impl FnOnce(HostNetwork) -> E,
    ) -> Result<Trainer<E>, DeviceError> {
        let reached = self.training.steps_taken();
        let mut progress = self.progress;
        let network = match from {
            NetworkFrom::Device => self.training.download()?,
            NetworkFrom::HostCopy => {
                self.take_in();
                progress = Progress { drawn: progress.drawn, ..self.copies.progress };
                self.training.host_copy().clone()
            }
        };
        let lost = reached.saturating_sub(network.model.steps()) as u64;
        let mut unreported = std::mem::take(&mut self.unreported);
        unreported.steps = unreported.steps.saturating_sub(lost);
        unreported.lost_steps += lost;
        Ok(Trainer {
            training: training(network),
            objective: self.objective.clone(),
            progress,
            settings: self.settings.clone(),
            rate: self.rate,
            seed: self.seed,
            times: self.times,
            asked: self.asked,
            start: self.start,
            standardised: self.standardised,
            kept: None,
            copies: Copies::new(progress),
            unreported,
        })
    }
}

/// A copy of a network: on the host (with the reason if training waited for it), or being downloaded.
#[allow(clippy::large_enum_variant)] // A run has a single one.
enum NetworkSource {
    Here(HostNetwork, Option<String>),
    Pending(Arc<PendingCopy>),
}
