//! The schedule of training: which samples, at which rate, for how long, which weights predict, and what happens when the loss diverges.
//!
//! The horizon is unknown (a frame gives the time it has left), so no schedule can count down to it. Instead the rate stays high, and weights for
//! prediction are a running mean over the last share of the steps (Polyak and Juditsky 1992), which acts like a decaying rate at every moment. The
//! rate falls only when the loss has stopped falling.

use super::device::{DeviceTable, HostNetwork, Labels, NetworkCopy, SyncedSamples, Training};
use super::host::HostTraining;
use super::network::{Architecture, Encoding, Field, Model, NetworkSettings, Objective, PlannedStep, Times};
use super::{Learned, NetworkFrom, ReplayBuffer, SurrogateError};
use crate::backend::DeviceError;
use crate::flow::Tracer;
use copy::{Copies, PendingCopy};
use progress::Progress;
use std::sync::Arc;
use std::time::Instant;

mod copy;
mod progress;
mod restart;
#[cfg(test)]
mod tests;

pub(super) use restart::NetworkState;

/// Steps between two moves of the average: it changes slowly, and every move reads and writes all parameters.
const AVERAGE_EVERY: u64 = 8;
/// Steps between two copies of the last good weights.
const KEEP_EVERY: u64 = 512;
/// Factor on the rate below which more roll-backs make no sense in one call.
const MIN_CAUTION: f64 = 1e-6;

/// The state to roll back to.
struct Kept {
    steps: usize,
    progress: Progress,
    /// Whether the window has slid since, so that it must not be rolled back to. The next copy reuses its memory.
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
    /// Ranges of the times that are inputs, and the times that are predicted for, in unit intervals.
    times: Times,
    asked: [f32; 2],
    /// Start time of the latest window.
    start: f64,
    standardised: bool,
    kept: Option<Kept>,
    copies: Copies,
    /// What calls learned that failed afterwards.
    unreported: Learned,
}

impl<T: Training> Trainer<T> {
    /// A trainer of a fresh network for the flow map of `tracer`. `zero_output`: the output layer starts at 0. `training` takes the network over.
    ///
    /// # Errors
    /// Settings that are out of range.
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
        // The published rate of 1e-4 is meant for a day of training; within minutes ten times as much reaches further.
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

    /// Start time and duration that are predicted for, in unit intervals.
    pub(super) fn asked_times(&self) -> [f32; 2] {
        self.asked
    }

    /// The network as it predicts now.
    pub(super) fn frozen(&self) -> Result<Arc<T::Network>, DeviceError> {
        self.training.frozen(&self.objective)
    }

    /// Takes the network to a new window: weights carry over, but the average forgets the steps so far, and the rate starts at its first value. If the
    /// start time is an input, all that was learned stays right, and training goes on as it was.
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
    /// The device fails or lacks memory. What was learned until then is part of the next call's result.
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
        let samples = labels.buffer.samples();
        if !self.standardised && (0..samples.len()).any(|index| self.objective.is_usable(samples, index)) {
            let base = labels.base.map(DeviceTable::to_host).transpose()?;
            self.objective.standardise(self.training.shape(), samples, base.as_ref().map(|base| base as &dyn Field));
            self.standardised = true;
        }
        // The scale of the targets goes to the device with the network, so the network stays until it is known.
        if self.standardised {
            self.training.begin(&self.objective, labels.buffer.capacity(), self.settings.batch)?;
        }
        let SyncedSamples { usable, dropped } = self.training.sync(&self.objective, labels)?;
        learned.dropped = dropped as u64;
        if usable == 0 {
            return Ok(());
        }
        // Few samples need no large batch; they would only be drawn many times over.
        let count = self.settings.batch.min(usable.max(256));
        let (mut losses, mut counted, mut first_of_call) = (0.0, 0_u64, None::<f64>);
        let began = self.training.steps_taken();
        while learned.steps < max_steps && start.elapsed().as_secs_f64() < seconds {
            let steps = self.training.steps_taken();
            // The first step of a call is the likeliest to diverge; but a call of a few steps must not cost a copy.
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
                // The moments are part of what diverged; so the steps since the last copy are lost.
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
        }
        if self.settings.averaging == 0.0 || self.progress.averaged < AVERAGE_EVERY {
            self.training.restart_average()?;
        }
        self.training.settle();
        self.take_in();
        if self.training.is_on_device() && self.copies.is_due() { self.update_host_copy(learned) } else { Ok(()) }
    }

    /// The next step, and the number of steps that the average is then a share of.
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

    /// Returns to the last good weights, at half the rate. The generator moves on, so that the same batches are not drawn again.
    fn roll_back(&mut self) -> Result<(), DeviceError> {
        let (drawn, caution) = (self.progress.drawn, self.progress.caution * 0.5);
        let Some(kept) = self.kept.as_ref().filter(|kept| !kept.is_stale) else { return Ok(()) };
        self.training.roll_back()?;
        self.copies.is_rolled_back = self.copies.pending.is_some();
        self.progress = Progress { drawn, caution, ..kept.progress };
        Ok(())
    }

    /// Starts the download of what the device has learned. If the device has no room for a copy, training waits.
    fn update_host_copy(&mut self, learned: &mut Learned) -> Result<(), DeviceError> {
        let begin = Instant::now();
        let Some(copy) = self.copy()? else { return Ok(()) };
        let wait = match copy {
            NetworkSource::Pending(pending) => {
                let name = "ridgewatch-download".to_owned();
                // Without a thread the copy waits for the next one who asks.
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

    /// Copies the network as it is now; `None` while an earlier copy is still being downloaded.
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

    /// Takes in the copy that was downloaded, if one was.
    fn take_in(&mut self) {
        let Some(mut pending) = self.copies.pending.take() else { return };
        // Asked before the result: a thread that downloads gives its share up afterwards.
        let is_shared = Arc::get_mut(&mut pending).is_none();
        match pending.ready() {
            Some(_) if std::mem::take(&mut self.copies.is_rolled_back) => {}
            Some(Ok(network)) => {
                let stale = self.training.host_copy().clone();
                self.training.set_host_copy(network.clone());
                self.copies.progress = pending.progress;
                // Giving hundreds of megabytes back to the system takes as long as a frame.
                drop(std::thread::Builder::new().spawn(move || drop(stale)));
            }
            Some(Err(_)) => {}
            None if is_shared => self.copies.pending = Some(pending),
            None => {}
        }
    }

    /// The trainer on the CPU, which goes on with the network as `from` says.
    ///
    /// # Errors
    /// The device fails, if the network comes from it.
    pub(super) fn to_host(&mut self, from: NetworkFrom) -> Result<Trainer<HostTraining>, DeviceError> {
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
            training: HostTraining::new(network),
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

/// A copy of a network: here (with the reason if training waited for it), or being downloaded.
enum NetworkSource {
    Here(HostNetwork, Option<String>),
    Pending(Arc<PendingCopy>),
}
