//! Decides how a network is trained: which samples, at which rate, for how long, which weights predict, and what happens when the loss
//! diverges.
//!
//! The horizon is unknown (a frame gives what time it has left), so no schedule can count down to it. Instead the rate stays high, weights for
//! prediction are a running mean over the last share of the steps, which does the work of a decaying rate at every moment, and the rate falls
//! only when the loss has stopped falling.

use super::network::{
    Architecture, Average, Encoding, Field, Fused, Model, NetworkSettings, Objective, PlannedStep, Predictor, Step, Times,
};
use super::{
    Brought, DeviceLost, Learned, NetworkState, NotTaken, Offload, OffloadedNetwork, Predict, SampleRing, Samples, SurrogateError, Table,
    fresh_stamp,
};
use crate::flow::Tracer;
use device_copy::DeviceCopy;
use on_device::{Latest, Mean, OnDevice, Sent};
use progress::Progress;
use std::sync::{Arc, OnceLock};
use std::time::Instant;

mod device_copy;
mod on_device;
mod progress;
mod restart;
#[cfg(test)]
mod tests;

pub(super) use restart::NetworkDraft;

/// Steps between two moves of the average: it changes slowly, and every move reads and writes all parameters.
const AVERAGE_EVERY: u64 = 8;
/// Steps between two copies of the last good weights.
const KEEP_EVERY: u64 = 512;
/// Factor on the rate below which more rollbacks make no sense in one call.
const LEAST_CAUTION: f64 = 1e-6;
/// Steps that a device is told at once at most, and before it is known how long one takes.
const GROUP: [u64; 2] = [64, 8];
/// Calls on end that learn nothing for want of memory for the table below, before training comes back: a slide may bring a table that is there.
const IDLE_CALLS: u32 = 8;
/// What to come back to.
struct Kept {
    steps: usize,
    progress: Progress,
    /// Weights, moments and mean; none where a device keeps them.
    here: Option<([[Vec<f32>; 3]; 2], Average)>,
    /// Not to be come back to any more; the next copy takes its place, in the same memory.
    is_stale: bool,
}

/// What is trained on, here.
#[derive(Clone, Copy)]
struct Labels<'a> {
    samples: &'a Samples,
    among: Option<&'a [u32]>,
    base: Option<&'a dyn Field>,
}

/// A network, its optimizer and its schedule.
pub(super) struct Trainer {
    /// burn's module. While a device trains the network: as it last came back, and mean and predictor likewise.
    model: Model,
    objective: Objective,
    average: Arc<Average>,
    predictor: Arc<Predictor>,
    progress: Progress,
    settings: NetworkSettings,
    rate: f64,
    seed: u64,
    /// Ranges of the times that are inputs, and the times that are predicted for, in them.
    times: Times,
    asked: [f32; 2],
    /// Of the latest window.
    start: f64,
    standardised: bool,
    fused: Option<Fused>,
    kept: Option<Kept>,
    /// Who trains it on a device, and there it is once it has begun.
    offload: Option<Arc<dyn Offload>>,
    on_device: Option<OnDevice>,
}

/// A network as it was.
pub(super) struct FrozenNetwork {
    shape: Architecture,
    objective: Objective,
    average: Arc<Average>,
    predictor: Arc<Predictor>,
    on_device: Option<Arc<dyn OffloadedNetwork>>,
    /// That network brought back, once the device had no memory for points to predict at.
    brought: OnceLock<Mean>,
    asked: [f32; 2],
    stamp: u64,
}

impl FrozenNetwork {
    /// The network on the device, brought back; none once that is lost.
    fn brought(&self, network: &dyn OffloadedNetwork) -> Option<&Mean> {
        if self.brought.get().is_none() {
            let mut average = Average::clone(&self.average);
            network.fetch(&mut average).ok()?;
            let predictor = Arc::new(Predictor::new(&self.shape, &average.layers));
            self.brought.get_or_init(|| (Arc::new(average), predictor));
        }
        self.brought.get()
    }
}

impl Predict for FrozenNetwork {
    fn name(&self) -> &'static str {
        "network"
    }

    /// By the device where it is there, otherwise here: with its parameters as long as it works, else with those that came back last.
    fn predict(&self, points: &[[f32; 3]], out: &mut [f32]) {
        let Self { shape, objective, average, predictor, on_device, asked, .. } = self;
        let (average, predictor) = match on_device.as_deref().map(|network| (network, network.predict(points, *asked, out))) {
            Some((_, Ok(()))) => return,
            Some((network, Err(NotTaken::NoRoom(_) | NotTaken::NoRoomForBase(_)))) => {
                self.brought(network).map_or((average, predictor), |(average, predictor)| (average, predictor))
            }
            Some((_, Err(NotTaken::Lost(_)))) | None => (average, predictor),
        };
        predictor.log_stretch(shape, objective, &average.tables, points, *asked, out);
    }

    fn bytes(&self) -> usize {
        self.shape.parameters() * size_of::<f32>()
    }

    fn network(&self) -> Option<NetworkState<'_>> {
        let Self { shape, objective, average, stamp, asked, .. } = self;
        let (on_device, tables, layers) = (self.on_device.as_deref(), &average.tables, &average.layers);
        Some(NetworkState { stamp: *stamp, shape, objective, tables, layers, times: *asked, on_device, base: None })
    }
}

/// The warning of a device that works, but not for training.
fn trained_here(why: &str) -> String {
    format!("the network is trained on the CPU: {why}")
}

impl Trainer {
    /// For what `tracer` traces; `centred`: the output layer starts at 0.
    pub(super) fn new(settings: &NetworkSettings, tracer: &dyn Tracer, seed: u64, centred: bool) -> Result<Self, SurrogateError> {
        let (domain, tau) = (tracer.domain(), tracer.tau());
        let axes: Vec<usize> = (0..domain.dimensions.clamp(1, 3)).collect();
        let shape = Architecture::new(settings, &axes, domain.lengths())?;
        let objective = Objective::new(settings, &shape, domain.extent(), tau);
        let model = Model::new(shape, seed, centred);
        let average = Arc::new(Average { tables: model.tables(), layers: model.layers() });
        let predictor = Arc::new(Predictor::new(&model.shape, &average.layers));
        // The published rate of 1e-4 is meant for a day of training; within minutes ten times as much reaches further.
        let default = match settings.encoding {
            Encoding::HashGrid => 1e-2,
            Encoding::Frequency => 1e-3,
        };
        let progress = Progress { drawn: 0, averaged: 0, stall: 1.0, caution: 1.0, first_loss: 0.0, smooth: 0.0, looked: 0.0 };
        let rate = f64::from(settings.learning_rate.unwrap_or(default));
        let times = Times::new(settings, tau);
        Ok(Self {
            model,
            objective,
            average,
            predictor,
            progress,
            settings: settings.clone(),
            rate,
            seed,
            times,
            asked: times.unit(tracer.start(), tau),
            start: tracer.start(),
            standardised: false,
            fused: None,
            kept: None,
            offload: None,
            on_device: None,
        })
    }

    /// Trains on a device from the next step on, where that takes this network.
    pub(super) fn offload(&mut self, to: &Arc<dyn Offload>) {
        self.offload = to.takes(&self.model.shape, &self.objective).then(|| to.clone());
    }

    /// Whether a device trains it.
    pub(super) fn is_offloaded(&self) -> bool {
        self.offload.is_some()
    }

    /// Optimizer steps taken so far.
    fn steps(&self) -> usize {
        self.on_device.as_ref().map_or_else(|| self.model.steps(), |on_device| on_device.steps)
    }

    /// Writes the log-stretch (or the residual's part of it) at each point.
    pub(super) fn predict(&self, points: &[[f32; 3]], out: &mut [f32]) {
        self.frozen().predict(points, out);
    }

    /// What predicts now, for good.
    pub(super) fn frozen(&self) -> FrozenNetwork {
        let (mut average, mut predictor, mut on_device) = (self.average.clone(), self.predictor.clone(), None);
        let here = || {
            let average = self.present().1;
            let predictor = Arc::new(Predictor::new(&self.model.shape, &average.layers));
            (average, predictor)
        };
        match self.on_device.as_ref().map(|on_device| on_device.frozen(here)) {
            Some(Ok(Latest::There(frozen))) => on_device = Some(frozen),
            Some(Ok(Latest::Here(mean))) => (average, predictor) = mean,
            // What it predicts then is here already: what came back last.
            Some(Err(DeviceLost)) | None => {}
        }
        let (shape, objective, brought) = (self.model.shape.clone(), self.objective.clone(), OnceLock::new());
        FrozenNetwork { shape, objective, average, predictor, on_device, brought, asked: self.asked, stamp: fresh_stamp() }
    }

    /// Parameters that prediction reads, in bytes.
    pub(super) fn bytes(&self) -> usize {
        self.model.shape.parameters() * size_of::<f32>()
    }

    /// The window slid: weights carry over, but the average forgets what it has seen, and the rate is the first one again. Where the start
    /// time is an input, of this window and the one before, all that was learned stays right, and training goes on as it was.
    pub(super) fn window_slid(&mut self, tracer: &dyn Tracer) {
        self.asked = self.times.unit(tracer.start(), tracer.tau());
        let before = std::mem::replace(&mut self.start, tracer.start());
        if self.times.labels_stay_valid(before, self.start) {
            return;
        }
        self.disown_kept();
        self.progress.window_slid();
        if let Some(on_device) = &mut self.on_device {
            on_device.training.forget_labels();
        }
    }

    /// The table below is about to be traced anew: its copy with the device goes first, so that they never need memory together.
    pub(super) fn let_go_of_base(&mut self) {
        if let Some(on_device) = &mut self.on_device {
            on_device.training.let_go_of_base();
        }
    }

    /// Sets the output layer back to 0, in the weights, the moments and the average: what the hidden layers have learned stays.
    pub(super) fn forget_output(&mut self) {
        self.disown_kept();
        let head = &self.model.shape.layers[self.model.shape.layers.len() - 1];
        let output = head.weights..head.biases + head.outputs;
        if let Some(on_device) = &mut self.on_device {
            on_device.frozen = OnceLock::new();
            if on_device.training.zero_layers(output.clone()).is_ok() {
                return;
            }
            self.lose_device();
        }
        self.model.zero_output();
        Arc::make_mut(&mut self.average).layers[output].fill(0.0);
        self.pack();
    }

    /// Trains on the ring's samples, or on what they have beyond `base`.
    pub(super) fn learn(&mut self, ring: &SampleRing, base: Option<&Table>, seconds: f64, max_steps: u64) -> Learned {
        let start = Instant::now();
        let began = self.steps();
        let mut learned = Learned::default();
        let mut before = None;
        let mut trained = self.train(ring, base, start, seconds, max_steps, &mut learned);
        if let Err(NotTaken::NoRoom(why) | NotTaken::NoRoomForBase(why)) = &trained
            && let Ok(seconds_there) = self.move_back()
        {
            before = Some(seconds_there).filter(|&seconds| seconds > 0.0);
            learned.steps = self.steps().saturating_sub(began) as u64;
            learned.warnings.push(trained_here(why));
            let there = std::mem::take(&mut learned);
            trained = self.train(ring, base, start, seconds, max_steps.saturating_sub(there.steps), &mut learned);
            learned = there.and(learned);
        }
        if trained.is_err() {
            let reached = self.steps();
            self.lose_device();
            learned.steps = self.steps().saturating_sub(began) as u64;
            learned.lost_steps += reached.saturating_sub(self.steps()) as u64;
        }
        learned.device_seconds = self.on_device.as_mut().map(|on_device| on_device.training.device_seconds()).or(before);
        learned.seconds = start.elapsed().as_secs_f64();
        learned
    }

    fn train(
        &mut self,
        ring: &SampleRing,
        base: Option<&Table>,
        start: Instant,
        seconds: f64,
        max_steps: u64,
        learned: &mut Learned,
    ) -> Result<(), NotTaken> {
        let samples = ring.samples();
        let mut labels = Labels { samples, among: None, base: base.map(|base| base as &dyn Field) };
        if !self.standardised && (0..samples.len()).any(|index| self.objective.is_usable(samples, index)) {
            self.objective.standardise(&self.model.shape, samples, labels.base);
            self.standardised = true;
        }
        // Its mean and deviation go with it for good, so not before there are any.
        if self.standardised {
            self.move_to_device(ring.capacity(), learned);
        }
        let sieved;
        let Brought { usable, dropped } = if let Some(on_device) = &mut self.on_device {
            if let Some(why) = on_device.full.get() {
                return Err(NotTaken::NoRoom(why.clone()));
            }
            match on_device.training.bring(ring, base) {
                Err(NotTaken::NoRoomForBase(why)) if on_device.idle_calls < IDLE_CALLS => {
                    if on_device.idle_calls == 0 {
                        learned.warnings.push(format!("the network learns nothing for up to {IDLE_CALLS} turns of training: {why}"));
                    }
                    on_device.idle_calls += 1;
                    return Ok(());
                }
                brought => {
                    on_device.idle_calls = 0;
                    brought?
                }
            }
        } else {
            // Training reads the table in pieces by many threads: it had better be here before they start.
            base.map(Table::values);
            sieved = self.objective.usable_samples(samples);
            labels.among = sieved.as_deref();
            let usable = labels.among.map_or(samples.len(), <[u32]>::len);
            Brought { usable, dropped: samples.len() - usable }
        };
        learned.dropped = dropped as u64;
        if usable == 0 {
            return Ok(());
        }
        // Few samples need no large batch; they would only be drawn many times over.
        let count = self.settings.batch.min(usable.max(256));
        let (mut losses, mut counted, mut first_of_call) = (0.0, 0_u64, None::<f64>);
        let began = self.steps();
        while learned.steps < max_steps && start.elapsed().as_secs_f64() < seconds {
            let steps = self.steps();
            // The first step of a call is the likeliest to meet something new; but a call of a few steps must not cost a copy.
            let apart = if learned.steps == 0 { KEEP_EVERY / 8 } else { KEEP_EVERY };
            let may_keep = learned.steps == 0 || (steps as u64).is_multiple_of(KEEP_EVERY);
            if may_keep && self.kept.as_ref().is_none_or(|kept| kept.is_stale || steps as u64 >= kept.steps as u64 + apart) {
                self.keep()?;
            }
            let most = (KEEP_EVERY - steps as u64 % KEEP_EVERY).min(max_steps - learned.steps);
            let group = most.min(self.group(seconds - start.elapsed().as_secs_f64()));
            let before = self.progress;
            let planned: Vec<(PlannedStep, u64)> = (0..group).map(|_| self.plan(count, base.is_some())).collect();
            // What could not be taken is planned anew.
            let found = self.take(&planned, labels).inspect_err(|_| self.progress = before)?;
            learned.samples += (found.len() * count) as u64;
            let mut diverged = false;
            for (loss, (_, averaged)) in found.into_iter().zip(&planned) {
                diverged = self.progress.diverges(loss, *first_of_call.get_or_insert(loss), *averaged);
                if diverged {
                    break;
                }
                (losses, counted) = (losses + loss, counted + 1);
                self.progress.observe(loss, *averaged);
            }
            learned.loss = (counted > 0).then(|| losses / counted as f64);
            if diverged {
                learned.rollbacks += 1;
                // The moments are part of what diverged; so the steps since the last copy are lost.
                let reached = self.steps();
                self.roll_back()?;
                let kept = self.steps();
                learned.lost_steps += reached.saturating_sub(kept) as u64;
                if self.progress.caution < LEAST_CAUTION {
                    learned.steps = kept.saturating_sub(began) as u64;
                    break;
                }
            }
            learned.steps = self.steps().saturating_sub(began) as u64;
        }
        Ok(self.settle(learned)?)
    }

    /// Packs the layers of the mean for prediction here.
    fn pack(&mut self) {
        self.predictor = Arc::new(Predictor::new(&self.model.shape, &self.average.layers));
    }

    /// Steps to take before the clock is looked at again, with so many seconds left.
    fn group(&self, left: f64) -> u64 {
        let [most, first] = GROUP;
        match &self.on_device {
            None => 1,
            Some(on_device) if on_device.step_seconds == 0.0 => first,
            Some(on_device) => ((left / on_device.step_seconds) as u64).clamp(1, most),
        }
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

    /// Takes the steps, wherever the network is; the loss of each, before it.
    fn take(&mut self, planned: &[(PlannedStep, u64)], labels: Labels<'_>) -> Result<Vec<f64>, NotTaken> {
        if let Some(on_device) = &mut self.on_device {
            let begin = Instant::now();
            let steps: Vec<PlannedStep> = planned.iter().map(|(step, _)| *step).collect();
            on_device.frozen = OnceLock::new();
            let losses = on_device.training.steps(&steps)?;
            on_device.steps += steps.len();
            on_device.step_seconds = begin.elapsed().as_secs_f64() / steps.len() as f64;
            return Ok(losses);
        }
        let Self { model, objective, average, fused, settings, .. } = self;
        let fused = fused.get_or_insert_with(|| Fused::new(model, objective, settings.batch));
        let mut losses = Vec::with_capacity(planned.len());
        fused.steps(model, objective, Arc::make_mut(average), |done, loss| {
            losses.extend(loss);
            planned.get(done as usize).map(|(step, _)| Step::of(step, labels.samples, labels.among, labels.base))
        });
        Ok(losses)
    }

    /// After the last step of a call: what predicts is up to date, and every minute or so it comes back from where it is trained.
    fn settle(&mut self, learned: &mut Learned) -> Result<(), DeviceLost> {
        let restart = self.settings.averaging == 0.0 || self.progress.averaged < AVERAGE_EVERY;
        if let Some(on_device) = &mut self.on_device {
            if restart {
                on_device.training.restart_average()?;
            }
            self.take_in();
            let Some(on_device) = &self.on_device else { return Ok(()) };
            let due = on_device.fetched_at.elapsed().as_secs_f64() >= on_device.apart();
            return if due { self.fetch(learned) } else { Ok(()) };
        }
        if restart {
            self.average = Arc::new(Average { tables: self.model.tables(), layers: self.model.layers() });
        }
        self.pack();
        Ok(())
    }

    /// Copies the present weights as what to come back to.
    fn keep(&mut self) -> Result<(), NotTaken> {
        let (steps, progress) = (self.steps(), self.progress);
        if let Some(on_device) = &mut self.on_device {
            on_device.training.keep()?;
            self.kept = Some(Kept { steps, progress, here: None, is_stale: false });
            return Ok(());
        }
        let here = match self.kept.take().and_then(|kept| kept.here) {
            Some((mut state, mut average)) => {
                self.model.copy_state(&mut state);
                average.tables.copy_from_slice(&self.average.tables);
                average.layers.copy_from_slice(&self.average.layers);
                (state, average)
            }
            None => (self.model.state(), Average::clone(&self.average)),
        };
        self.kept = Some(Kept { steps, progress, here: Some(here), is_stale: false });
        Ok(())
    }

    /// The copy is not to be come back to any more. Its memory, four times that of the network, stays for the next one: to give it back and to take it
    /// anew would cost each slide of a window its page faults.
    fn disown_kept(&mut self) {
        if let Some(kept) = &mut self.kept {
            kept.is_stale = true;
        }
    }

    /// Back to the last good weights, at half the rate. The generator moves on, so that the same batches are not drawn again.
    fn roll_back(&mut self) -> Result<(), DeviceLost> {
        let (drawn, caution) = (self.progress.drawn, self.progress.caution * 0.5);
        let Some(kept) = self.kept.as_ref().filter(|kept| !kept.is_stale) else { return Ok(()) };
        match (&mut self.on_device, &kept.here) {
            (Some(on_device), _) => {
                on_device.training.roll_back()?;
                (on_device.steps, on_device.frozen) = (kept.steps, OnceLock::new());
                on_device.is_disowned = on_device.device_copy.is_some();
            }
            (None, Some((state, average))) => {
                self.model.set_state(state.clone(), kept.steps);
                self.average = Arc::new(average.clone());
            }
            (None, None) => {}
        }
        self.progress = Progress { drawn, caution, ..kept.progress };
        Ok(())
    }

    /// The network as it is now, wherever it is; as it last came back, where the device is lost.
    fn present(&self) -> (Model, Arc<Average>, Progress) {
        let (mut model, last) = (self.model.clone(), self.average.clone());
        let Some(on_device) = &self.on_device else { return (model, last, self.progress) };
        let mut average = Average::clone(&last);
        let device_copy = on_device.device_copy.as_ref().filter(|_| !on_device.is_disowned);
        match (on_device.training.fetch(&mut model, &mut average), device_copy.and_then(|r| Some((r.progress, r.ready()?)))) {
            (Ok(()), _) => (model, Arc::new(average), self.progress),
            (Err(DeviceLost), Some((progress, Ok(numbers)))) => (numbers.model.clone(), numbers.average.clone(), progress),
            (Err(DeviceLost), _) => (self.model.clone(), last, on_device.fetched),
        }
    }
}
