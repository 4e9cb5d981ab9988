//! A network that a device trains: how it goes there, how what it has learned comes back, and what is left where the device is lost.

use super::super::network::{Average, Predictor};
use super::super::{Copied, DeviceLost, Learned, NotTaken, OffloadedNetwork, OffloadedTraining};
use super::device_copy::{DeviceCopy, Numbers};
use super::{Progress, Trainer, trained_here};
use std::sync::{Arc, OnceLock};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

/// Seconds of a run after which what a device has learned comes back, at least: so much is lost with it.
const FETCH_EVERY: f64 = 60.0;
/// And so many times the seconds that training waits for it, so that it costs one hundredth of the time.
const FETCH_APART: f64 = 100.0;
/// Longest that the end of training waits for what is still coming back.
const FETCH_LIMIT: Duration = Duration::from_secs(5);

/// A network that a device trains.
pub(super) struct OnDevice {
    pub(super) training: Box<dyn OffloadedTraining>,
    /// Optimizer steps taken so far, those before it went there included.
    pub(super) steps: usize,
    /// How far it was when it last came back.
    pub(super) fetched: Progress,
    /// When it was last sent for, and the seconds that training waited then; 0 before the first time.
    pub(super) fetched_at: Instant,
    pub(super) fetch_seconds: f64,
    /// On its way back, for the thread here, or for a checkpoint.
    pub(super) device_copy: Option<Arc<DeviceCopy>>,
    /// It holds weights that were rolled back since.
    pub(super) is_disowned: bool,
    fetcher: Option<JoinHandle<()>>,
    /// Wall-clock seconds of a step, as of the latest ones; 0 before the first.
    pub(super) step_seconds: f64,
    /// What it predicts since the latest step.
    pub(super) frozen: OnceLock<Latest>,
    /// Why there is no memory for that; then training comes back with the next call.
    pub(super) full: OnceLock<String>,
    /// Calls on end that learned nothing, for want of memory for the table below.
    pub(super) idle_calls: u32,
    /// Whether it was told that training waits for it to come back.
    told_of_waiting: bool,
}

impl Drop for OnDevice {
    /// The device had better not be closed under a copy; but one that hangs is not waited for.
    fn drop(&mut self) {
        let begin = Instant::now();
        while self.fetcher.as_ref().is_some_and(|thread| !thread.is_finished()) && begin.elapsed() < FETCH_LIMIT {
            std::thread::sleep(Duration::from_millis(1));
        }
    }
}

/// What a network on a device predicts.
#[derive(Clone)]
pub(super) enum Latest {
    /// There.
    There(Arc<dyn OffloadedNetwork>),
    /// Here, by the mean that was brought back: there is no memory for a copy.
    Here(Mean),
}

/// The running mean of the parameters, and its layers packed for prediction here.
pub(super) type Mean = (Arc<Average>, Arc<Predictor>);

/// What sending for a network came to.
pub(super) enum Sent {
    For(Arc<DeviceCopy>),
    /// What was sent for before is still on its way.
    Before,
    /// The device has no memory for a copy; why.
    NoRoom(String),
}

impl OnDevice {
    /// Seconds after which it comes back again.
    pub(super) fn apart(&self) -> f64 {
        FETCH_EVERY.max(FETCH_APART * self.fetch_seconds)
    }

    /// What it predicts now, `here` where there is no memory for that.
    pub(super) fn frozen(&self, here: impl FnOnce() -> Mean) -> Result<Latest, DeviceLost> {
        if let Some(frozen) = self.frozen.get() {
            return Ok(frozen.clone());
        }
        let frozen = match self.training.frozen() {
            Ok(frozen) => Latest::There(frozen),
            Err(NotTaken::Lost(lost)) => return Err(lost),
            Err(NotTaken::NoRoom(why) | NotTaken::NoRoomForBase(why)) => {
                self.full.get_or_init(|| why);
                Latest::Here(here())
            }
        };
        Ok(self.frozen.get_or_init(|| frozen).clone())
    }
}

impl Trainer {
    /// Brings the network to the device that is to train it, once; where that does not take it, training stays here.
    pub(super) fn move_to_device(&mut self, ring: usize, learned: &mut Learned) {
        if self.on_device.is_some() {
            return;
        }
        let Some(offload) = &self.offload else { return };
        let training = match offload.training(&self.model, &self.objective, &self.average, ring, self.settings.batch) {
            Ok(training) => training,
            Err(why) => {
                self.offload = None;
                // What is lost is told where it happened.
                if let NotTaken::NoRoom(why) | NotTaken::NoRoomForBase(why) = why {
                    learned.warnings.push(trained_here(&why));
                }
                return;
            }
        };
        self.kept = None;
        self.on_device = Some(OnDevice {
            training,
            steps: self.model.steps(),
            fetched: self.progress,
            fetched_at: Instant::now(),
            fetch_seconds: 0.0,
            device_copy: None,
            is_disowned: false,
            fetcher: None,
            step_seconds: 0.0,
            frozen: OnceLock::new(),
            full: OnceLock::new(),
            idle_calls: 0,
            told_of_waiting: false,
        });
    }

    /// Goes on here, with all that was learned: the device works, but lacks memory. Device seconds of steps, not yet told.
    pub(super) fn move_back(&mut self) -> Result<f64, DeviceLost> {
        self.fetch_now()?;
        let seconds = self.on_device.as_mut().map_or(0.0, |on_device| on_device.training.device_seconds());
        (self.offload, self.kept, self.on_device) = (None, None, None);
        Ok(seconds)
    }

    /// Brings back what a device has learned, and waits for it.
    fn fetch_now(&mut self) -> Result<(), DeviceLost> {
        let Some(on_device) = &mut self.on_device else { return Ok(()) };
        on_device.training.fetch(&mut self.model, Arc::make_mut(&mut self.average))?;
        on_device.fetched = self.progress;
        self.pack();
        Ok(())
    }

    /// Goes on here, from what came back last. The generator moves on, so that the same batches are not drawn again.
    pub(super) fn lose_device(&mut self) {
        self.offload = None;
        self.kept = None;
        self.take_in();
        if let Some(on_device) = self.on_device.take() {
            self.progress = Progress { drawn: self.progress.drawn, ..on_device.fetched };
        }
    }

    /// Brings back what a device has learned, behind the back of training; where there is no memory for that, training waits.
    pub(super) fn fetch(&mut self, learned: &mut Learned) -> Result<(), DeviceLost> {
        let begin = Instant::now();
        let mut waited_for = None;
        match self.send_for()? {
            Sent::For(device_copy) => {
                let name = "ridgewatch-fetch".to_owned();
                // What fails there is told where it happens. Without a thread nothing comes back this time.
                let fetcher = std::thread::Builder::new().name(name).spawn(move || drop(device_copy.fetch().cloned())).ok();
                if let Some(on_device) = &mut self.on_device {
                    on_device.fetcher = fetcher;
                }
            }
            Sent::Before => return Ok(()),
            Sent::NoRoom(why) => {
                self.fetch_now()?;
                waited_for = Some(why);
            }
        }
        let Some(on_device) = &mut self.on_device else { return Ok(()) };
        (on_device.fetched_at, on_device.fetch_seconds) = (Instant::now(), begin.elapsed().as_secs_f64());
        if let Some(why) = waited_for.filter(|_| !std::mem::replace(&mut on_device.told_of_waiting, true)) {
            learned.warnings.push(format!(
                "training waited {:.2} s for the network to come back from the GPU, this time and every {:.0} s or so: {why}",
                on_device.fetch_seconds,
                on_device.apart()
            ));
        }
        Ok(())
    }

    /// Has the device copy what it has learned.
    pub(super) fn send_for(&mut self) -> Result<Sent, DeviceLost> {
        self.take_in();
        let Some(on_device) = self.on_device.as_mut().filter(|on_device| on_device.device_copy.is_none()) else { return Ok(Sent::Before) };
        Ok(match on_device.training.copy()? {
            Copied::NoRoom(why) => Sent::NoRoom(why),
            Copied::There(copy) => {
                let device_copy = DeviceCopy::new(copy, self.model.clone(), self.progress);
                on_device.is_disowned = false;
                Sent::For(on_device.device_copy.insert(device_copy).clone())
            }
        })
    }

    /// Takes in what has come back.
    pub(super) fn take_in(&mut self) {
        let Some(on_device) = &mut self.on_device else { return };
        let Some(mut device_copy) = on_device.device_copy.take() else { return };
        // Before looking for what has come: whoever fetches it lets go of it afterwards.
        let is_fetched_elsewhere = Arc::get_mut(&mut device_copy).is_none();
        match device_copy.ready() {
            Some(_) if std::mem::take(&mut on_device.is_disowned) => {}
            Some(Ok(numbers)) => {
                let Numbers { model, average, predictor } = numbers.clone();
                let stale = (std::mem::replace(&mut self.model, model), std::mem::replace(&mut self.average, average));
                (self.predictor, on_device.fetched) = (predictor, device_copy.progress);
                // To give hundreds of megabytes back to the system takes as long as a frame.
                drop(std::thread::Builder::new().spawn(move || drop(stale)));
            }
            Some(Err(DeviceLost)) => {}
            // Somebody fetches it, or is about to, or just has.
            None if is_fetched_elsewhere => on_device.device_copy = Some(device_copy),
            None => {}
        }
    }
}
