//! The window that a thread of its own keeps.

use super::conversion::Conversion;
use super::thinning::Thinning;
use super::{AtEnd, Follow, Live, memory};
use crate::field::{Window, WindowFault};
use crate::source::{Listener, SourceError, StillReading};
use ridgewatch_wire::{Assembler, Event, LEAD, Step};
use serde::{Deserialize, Serialize};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, OnceLock};
use std::thread::JoinHandle;
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

/// Steps that may wait for their blocks at once: those by which one ring may lead the slowest, the one that the slowest comes to, and one more.
const PENDING: usize = LEAD + 2;
/// Snapshots beside the windows: the one that is being made, and one that was left out, against which interpolation is measured.
const BESIDE: u64 = 2;
/// Warnings that are kept for the next frame; the rest is counted.
const WARNINGS: usize = 16;
/// Late steps in a row after which the simulation is taken to have been set back.
const SET_BACK: u32 = 3;
/// Bytes of a step from which on producers are told while one of its blocks is put into it: even memory that is new to the process is written faster than that
/// in a second. (While a step is converted they always are.)
const LARGE: usize = 256 << 20;
/// How often a thread that holds back looks up.
const LOOK_UP: Duration = Duration::from_millis(50);

/// What a frame's record says of the simulation.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct LiveRecord {
    /// The simulation's number of the newest step in the window.
    pub step: u64,
    /// When that step was published, seconds since 1970.
    pub published: f64,
    /// Seconds from its publication until the window had it: read, put together, converted.
    pub delay: f64,
    /// Seconds from its publication until the cycle took the window.
    pub age: f64,
    /// Whole steps that came, in all.
    pub steps: u64,
    /// Blocks of steps that were overwritten before they were read, or passed over since another block of the step was, in all.
    pub missed_blocks: u64,
    /// Steps left out for want of memory, in all.
    pub steps_skipped: u64,
    /// Least distance in time of the steps that are kept.
    pub spacing: f64,
    /// What leaving steps out costs: difference of one that was left out from linear interpolation, over its size (root mean squares); null where
    /// none was.
    pub interpolation_error: Option<f64>,
    /// Steps given up because blocks were missing, in all.
    pub steps_incomplete: u64,
    /// Times that the simulation was started or set back while it was followed.
    pub restarts: u64,
    /// Snapshots in the window.
    pub snapshots: usize,
    /// Seconds from the window's first snapshot until it covered one tenth, two tenths and so on of tau: ten numbers, since a frame needs all of it.
    pub fill_seconds: Vec<f64>,
}

/// The window at one moment.
#[derive(Debug)]
pub struct Taken {
    /// Full.
    pub window: Window,
    /// What was odd since the last one.
    pub warnings: Vec<String>,
    /// For the record.
    pub live: LiveRecord,
}

/// What both threads see.
struct State {
    window: Window,
    /// When the window had its first snapshot.
    begun_at: Option<Instant>,
    /// Snapshots that moved the window since it was last taken.
    moved: usize,
    /// Whether it was ever taken.
    begun: bool,
    warnings: Vec<String>,
    more_warnings: u64,
    live: LiveRecord,
    /// No more steps will come.
    ended: bool,
}

impl State {
    fn new(tau: f64) -> Self {
        Self {
            window: Window::new(tau),
            begun_at: None,
            moved: 0,
            begun: false,
            warnings: Vec::new(),
            more_warnings: 0,
            live: LiveRecord::default(),
            ended: false,
        }
    }

    fn warn(&mut self, text: String) {
        tracing::info!("{text}");
        if self.warnings.len() < WARNINGS { self.warnings.push(text) } else { self.more_warnings += 1 }
    }

    /// Empties the window.
    fn begin_anew(&mut self) {
        self.window = Window::new(self.window.span());
        self.begun_at = None;
        self.live.fill_seconds.clear();
    }

    /// Share of tau that the window covers.
    fn filled(&self) -> f64 {
        let covered = self.window.newest().zip(self.window.oldest()).map_or(0.0, |(newest, oldest)| newest - oldest);
        (covered / self.window.span()).min(1.0)
    }

    /// Notes how far the window has come.
    fn note_filling(&mut self) {
        let begun = *self.begun_at.get_or_insert_with(Instant::now);
        // The hair's breadth by which a sum of steps may miss tau is the window's own.
        let tenths = if self.window.is_full() { 10 } else { (10.0 * self.filled()) as usize };
        let known = self.live.fill_seconds.len().max(tenths);
        self.live.fill_seconds.resize(known, begun.elapsed().as_secs_f64());
    }

    /// Whether a slide is due.
    fn due(&self, stride: usize) -> bool {
        self.window.is_full() && (!self.begun || self.moved >= stride)
    }
}

struct Shared {
    state: Mutex<State>,
    changed: Condvar,
    stop: AtomicBool,
    /// Hears of snapshots before the window has them.
    listener: OnceLock<Listener>,
}

impl Shared {
    fn new(tau: f64) -> Self {
        Self { state: Mutex::new(State::new(tau)), changed: Condvar::new(), stop: AtomicBool::new(false), listener: OnceLock::new() }
    }

    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(|broken| broken.into_inner())
    }
}

/// A window that fills while frames are made. Dropping it ends its thread.
pub struct LiveWindow {
    shared: Arc<Shared>,
    stride: usize,
    thread: Option<JoinHandle<()>>,
}

impl LiveWindow {
    pub(super) fn start(live: Live, tau: f64, stride: usize) -> Result<Self, SourceError> {
        let nodes = live.grid.nodes() as u64;
        let (snapshot, step) = (16 * nodes, 4 * nodes * live.description.components() as u64);
        // Those that wait, the one that is read, and what the way to it holds: the simulation may come back in blocks.
        let steps = (PENDING as u64 + 1 + live.link.steps_held()) * step;
        // The window, and the one that the frame in progress still uses.
        let room = memory(&live.settings).saturating_sub(steps + BESIDE * snapshot) / (2 * snapshot.max(1));
        if room < 3 {
            let least = (steps + (BESIDE + 6) * snapshot) as f64 / f64::from(1 << 30);
            return Err(SourceError::Setting {
                key: "live.memory_gib",
                found: live.settings.memory_gib.to_string(),
                accepted: format!("at least {least:.3}: three snapshots, twice, and what is on its way to them"),
            });
        }
        let room = room as usize;
        let shared = Arc::new(Shared::new(tau));
        let conversion = Conversion::new(live.grid.clone())?;
        let mut reader = Reader::new(live, shared.clone(), conversion, Thinning::new(tau, room), stride);
        let thread = std::thread::Builder::new().name("ridgewatch-live".into()).spawn(move || reader.run());
        let thread = thread.map_err(|e| SourceError::Inconsistent { what: format!("the live thread could not start: {e}") })?;
        Ok(Self { shared, stride, thread: Some(thread) })
    }

    /// From now on `listener` hears of snapshots as they come, on the thread that reads, before the window has them. The first one that is set
    /// stays.
    pub fn tell(&self, listener: Listener) {
        // A second one has nothing to add: the first hears of everything.
        let _ = self.shared.listener.set(listener);
    }

    /// The window as it is once it is full and has moved by the stride; none when the simulation has ended and it will not; an error when the thread that
    /// reads has ended.
    ///
    /// # Errors
    /// Not within the limit: ask again.
    pub fn next_within(&self, limit: Duration) -> Result<Option<Result<Taken, SourceError>>, StillReading> {
        let until = Instant::now() + limit;
        let mut state = self.shared.lock();
        loop {
            if state.due(self.stride) {
                break;
            }
            // It ends by itself in no other way.
            if self.thread.as_ref().is_none_or(JoinHandle::is_finished) {
                return Ok(Some(Err(SourceError::LiveStopped { steps: state.live.steps, what: "it panicked".into() })));
            }
            if state.ended {
                return Ok(None);
            }
            let now = Instant::now();
            if now >= until {
                return Err(StillReading);
            }
            state = self.shared.changed.wait_timeout(state, until - now).map_or_else(|broken| broken.into_inner().0, |(state, _)| state);
        }
        (state.moved, state.begun) = (0, true);
        let mut warnings = std::mem::take(&mut state.warnings);
        if std::mem::take(&mut state.more_warnings) > 0 {
            warnings.push(format!("and more of that kind: only the first {WARNINGS} are named"));
        }
        let mut live = state.live.clone();
        live.age = since(live.published);
        live.snapshots = state.window.snapshots().len();
        let window = state.window.clone();
        drop(state);
        self.shared.changed.notify_all();
        Ok(Some(Ok(Taken { window, warnings, live })))
    }

    /// Whether [`Self::next_within`] would have to wait: nothing new is there yet, and something may come.
    pub fn is_waited_for(&self) -> bool {
        let state = self.shared.lock();
        !state.due(self.stride) && !state.ended && self.thread.as_ref().is_some_and(|thread| !thread.is_finished())
    }

    /// Share of tau that the window covers so far.
    pub fn filled(&self) -> f64 {
        self.shared.lock().filled()
    }
}

impl Drop for LiveWindow {
    fn drop(&mut self) {
        self.shared.stop.store(true, Ordering::Relaxed);
        self.shared.changed.notify_all();
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

/// The thread that reads.
struct Reader {
    live: Live,
    shared: Arc<Shared>,
    assembler: Assembler,
    conversion: Conversion,
    thinning: Thinning,
    stride: usize,
    late: u32,
    /// [`LARGE`].
    large: usize,
}

impl Reader {
    fn new(live: Live, shared: Arc<Shared>, conversion: Conversion, thinning: Thinning, stride: usize) -> Self {
        let limit = Duration::from_secs_f64(live.settings.block_timeout_seconds);
        let assembler = Assembler::new(&live.description, limit, PENDING);
        Self { live, shared, assembler, conversion, thinning, stride, late: 0, large: LARGE }
    }

    fn run(&mut self) {
        let (description, generation) = (self.live.description.clone(), self.live.generation);
        self.opened(&description, generation);
        let mut values = Vec::new();
        while !self.shared.stop.load(Ordering::Relaxed) {
            if self.live.settings.follow == Follow::Every && self.hold_back() {
                continue;
            }
            let assembler = &self.assembler;
            match self.live.link.poll(&mut values, &|block, generation| assembler.is_ahead(block, generation)) {
                Some(Event::Opened { description, generation }) => self.opened(&description, generation),
                Some(Event::Step { block, generation, step, time, published, missed }) => {
                    {
                        let live = &mut self.shared.lock().live;
                        live.missed_blocks = live.missed_blocks.saturating_add(missed);
                    }
                    let whole =
                        self.assemble(&mut values, |assembler, values| assembler.block(block, generation, step, time, published, values));
                    self.tell_incomplete();
                    match whole {
                        Ok(Some(whole)) => self.whole(whole),
                        Ok(None) => {}
                        Err(error) => self.shared.lock().warn(format!("a step was refused: {error}")),
                    }
                }
                Some(Event::Ended { block, generation, closed }) => self.ended(block, generation, closed),
                Some(Event::Refused(error)) => self.shared.lock().warn(format!("the simulation's data were refused: {error}")),
                // What lies there unread is not late.
                None => self.assembler.expire(),
            }
            self.tell_incomplete();
        }
    }

    /// Lets `take` put a block into its step; the step where it is whole.
    fn assemble<T: Send>(&mut self, values: &mut Vec<f32>, take: impl FnOnce(&mut Assembler, &mut Vec<f32>) -> T + Send) -> T {
        let Self { live, assembler, conversion, .. } = self;
        if 4 * live.grid.nodes() * live.description.components() < self.large {
            return take(assembler, values);
        }
        conversion.beside(|| take(assembler, values), &mut || live.link.beat())
    }

    /// Waits while a slide is due that was not taken; whether it did.
    fn hold_back(&mut self) -> bool {
        let state = self.shared.lock();
        if !state.due(self.stride) {
            return false;
        }
        let begin = Instant::now();
        self.live.link.hold();
        drop(self.shared.changed.wait_timeout(state, LOOK_UP));
        self.assembler.held(begin.elapsed());
        true
    }

    fn opened(&mut self, description: &ridgewatch_wire::Description, generation: u64) {
        if let Err(error) = self.assembler.introduce(description, generation) {
            self.shared.lock().warn(format!("the simulation does not fit: {error}"));
        }
    }

    /// Takes a whole step in.
    fn whole(&mut self, step: Step) {
        let Step { step: number, time, published, anew, values } = step;
        let mut state = self.shared.lock();
        if anew && state.live.steps > 0 {
            state.live.restarts += 1;
            state.ended = false;
            state.warn("the simulation was started anew".to_owned());
            if let Some(newest) = state.window.newest().filter(|newest| time <= *newest) {
                state.warn(format!("the simulation went back from time {newest} to {time}: the window begins anew"));
                state.begin_anew();
                self.thinning.restart();
            }
        }
        state.live.steps += 1;
        let keep = self.thinning.keeps(time, &state.window);
        // Conversion and the measurement take their time: frames are made meanwhile, and producers are told that somebody follows.
        drop(state);
        let mut convert = || self.conversion.snapshot(time, &values, &mut || self.live.link.beat());
        let kept = keep.then(&mut convert);
        if !keep {
            self.thinning.left_out(time, convert);
        }
        self.assembler.recycle(values);
        if let Some(kept) = &kept {
            self.thinning.kept(kept);
            if let Some(tell) = self.shared.listener.get() {
                tell(kept);
            }
        }
        let mut state = self.shared.lock();
        (state.live.steps_skipped, state.live.spacing) = (self.thinning.count, self.thinning.spacing());
        state.live.interpolation_error = self.thinning.error;
        let Some(kept) = kept else { return };
        let newest = state.window.newest();
        match state.window.push(kept.clone()) {
            Ok(pushed) => {
                self.late = 0;
                if let Some(warning) = pushed.warning {
                    state.warn(warning.to_string());
                }
            }
            Err(fault @ WindowFault::Late { .. }) => {
                self.late += 1;
                state.warn(fault.to_string());
                if self.late >= SET_BACK {
                    self.late = 0;
                    state.live.restarts += 1;
                    state.warn(format!(
                        "{SET_BACK} steps in a row were late: the simulation was set back, the window begins anew at time {time}"
                    ));
                    state.begin_anew();
                    self.thinning.restart();
                    self.thinning.kept(&kept);
                    let _ = state.window.push(kept);
                }
            }
            Err(fault) => state.warn(fault.to_string()),
        }
        state.note_filling();
        // Only what moves the window counts toward its stride.
        if state.window.newest() != newest {
            state.moved += 1;
            (state.live.step, state.live.published) = (number, published as f64 / 1e9);
            state.live.delay = since(state.live.published);
        }
        drop(state);
        self.shared.changed.notify_all();
    }

    fn ended(&mut self, block: u32, generation: u64, closed: bool) {
        let mut state = self.shared.lock();
        let how = if closed { "has ended" } else { "is gone: its process ended without closing the ring, or its relay is gone" };
        state.warn(format!("the simulation {how} (block {block})"));
        if self.assembler.ended(block, generation) && self.live.settings.at_end == AtEnd::Stop {
            state.ended = true;
        }
        drop(state);
        self.shared.changed.notify_all();
    }

    fn tell_incomplete(&mut self) {
        let given_up = self.assembler.incomplete();
        if given_up.is_empty() {
            return;
        }
        let mut state = self.shared.lock();
        for one in given_up {
            state.live.steps_incomplete += 1;
            state.warn(format!(
                "step {} (time {}) was given up with {} of {} blocks: {}",
                one.step, one.time, one.blocks, one.wanted, one.why
            ));
        }
    }
}

/// Seconds that have gone by since a moment, in seconds since 1970; 0 where it is yet to come.
fn since(moment: f64) -> f64 {
    let now = SystemTime::now().duration_since(UNIX_EPOCH).map_or(0.0, |d| d.as_secs_f64());
    (now - moment).max(0.0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::source::live::LiveSettings;
    use ridgewatch_wire::{AxisDescription, Description, Geometry, Policy, Producer};

    #[test]
    fn producers_hear_of_the_follower_while_a_step_is_taken_in() {
        let ring = std::path::PathBuf::from("/dev/shm").join(format!("rw-converting-{}", std::process::id()));
        let axis = |name| AxisDescription::uniform(name, "m", 0.0, 1.0, 2);
        let description = Description::whole(Geometry::Cartesian, vec![axis("x"), axis("y")], "s");
        let producer = Producer::open(&ring, description, 2, Policy::NewestWins).unwrap();
        let settings = LiveSettings { ring: Some(ring.clone()), ..Default::default() };
        let live = Live::connect(&settings, &AtomicBool::new(false), &mut |_| ()).unwrap().unwrap();
        let conversion = Conversion::new(live.grid().clone()).unwrap();
        let mut reader = Reader::new(live, Arc::new(Shared::new(1.0)), conversion, Thinning::new(1.0, 14), 1);
        // The first follower's mark.
        let heartbeat = || {
            let (file, mut bytes) = (std::fs::File::open(ridgewatch_wire::block_path(&ring, 0)).unwrap(), [0; 8]);
            std::os::unix::fs::FileExt::read_exact_at(&file, &mut bytes, 4096 + 8).unwrap();
            u64::from_ne_bytes(bytes)
        };
        // As if the threads that convert had so much to do.
        let long = Duration::from_millis(1500);
        let opened = heartbeat();
        reader.conversion.occupy(long);
        reader.whole(Step { step: 0, time: 0.0, published: 1, anew: true, values: vec![0.5; 8] });
        let converted = heartbeat();
        assert!(converted > opened, "while a step is converted");
        assert_eq!(reader.shared.lock().window.newest(), Some(0.0));
        reader.large = 0;
        reader.conversion.occupy(long);
        reader.assemble(&mut Vec::new(), |_, _| ());
        assert!(heartbeat() > converted, "while a block is put into a large step");
        drop((reader, producer));
        assert!(!ring.exists());
    }
}
