//! The window that a thread fills from a simulation.

use super::conversion::Conversion;
use super::settings::{AtEnd, Follow};
use super::simulation::Live;
use super::thinning::Thinning;
use crate::error::SourceError;
use crate::snapshots::{Listener, StillReading};
use ridgewatch_field::{Window, WindowFault};
use ridgewatch_wire::{Assembler, Event, LEAD, Step};
use serde::{Deserialize, Serialize};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, OnceLock};
use std::thread::JoinHandle;
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

/// Largest number of steps that wait for blocks: the steps by which one ring may lead the slowest, the slowest ring's next step, and one
/// more.
const MAX_PENDING: usize = LEAD + 2;
/// Snapshots besides the windows: the one in conversion, and a skipped one against which interpolation is measured.
const EXTRA_SNAPSHOTS: u64 = 2;
/// Largest number of warnings that are kept for the next frame; further ones are counted.
const MAX_WARNINGS: usize = 16;
/// Number of consecutive late steps after which the simulation counts as set back.
const SET_BACK: u32 = 3;
/// Bytes of a step above which the heartbeat is renewed while a block is copied into it. Smaller steps are copied in less than a second.
/// (During conversion the heartbeat is always renewed.)
const LARGE: usize = 256 << 20;
/// Interval at which a waiting thread checks for a stop.
const CHECK_INTERVAL: Duration = Duration::from_millis(50);

/// The simulation in a frame's record.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct LiveRecord {
    /// The simulation's number of the newest step in the window.
    pub step: u64,
    /// When that step was published, seconds since 1970.
    pub published: f64,
    /// Seconds from its publication until it was in the window: read, assembled, converted.
    pub delay: f64,
    /// Seconds from its publication until the cycle took the window.
    pub age: f64,
    /// Total number of complete steps received.
    pub steps: u64,
    /// Total number of blocks that were overwritten before they were read, or ignored because another block of their step was.
    pub missed_blocks: u64,
    /// Total number of steps skipped to save memory.
    pub steps_skipped: u64,
    /// Minimum distance in time of the kept steps.
    pub spacing: f64,
    /// Error of linear interpolation at a skipped step, relative to its velocity (root mean squares); null if none was skipped.
    pub interpolation_error: Option<f64>,
    /// Total number of steps given up because blocks were missing.
    pub steps_incomplete: u64,
    /// Number of restarts and setbacks of the simulation while it was followed.
    pub restarts: u64,
    /// Number of snapshots in the window.
    pub snapshots: usize,
    /// Seconds from the window's first snapshot until it covered one tenth, two tenths and so on of tau: ten numbers, since a frame needs
    /// the full window.
    pub fill_seconds: Vec<f64>,
}

/// The window at one moment.
#[derive(Debug)]
pub struct Taken {
    /// A full window.
    pub window: Window,
    /// Warnings since the last one.
    pub warnings: Vec<String>,
    /// Entry of the frame's record.
    pub live: LiveRecord,
}

/// State that both threads share.
struct State {
    window: Window,
    /// Time of the window's first snapshot.
    begun_at: Option<Instant>,
    /// Number of snapshots that moved the window since it was last taken.
    moved: usize,
    /// True if the window was taken before.
    taken: bool,
    warnings: Vec<String>,
    warnings_left_out: u64,
    live: LiveRecord,
    /// Loss of the whole simulation, of which nobody was told yet.
    lost: Option<String>,
    /// No more steps will come.
    ended: bool,
}

impl State {
    fn new(tau: f64) -> Self {
        Self {
            window: Window::new(tau),
            begun_at: None,
            moved: 0,
            taken: false,
            warnings: Vec::new(),
            warnings_left_out: 0,
            live: LiveRecord::default(),
            lost: None,
            ended: false,
        }
    }

    /// Takes the warnings, and with them the loss of the simulation.
    fn take_warnings(&mut self) -> Vec<String> {
        let mut warnings = std::mem::take(&mut self.warnings);
        if std::mem::take(&mut self.warnings_left_out) > 0 {
            warnings.push(format!("and more of that kind: only the first {MAX_WARNINGS} are listed"));
        }
        warnings.extend(self.lost.take());
        warnings
    }

    fn warn(&mut self, text: String) {
        tracing::info!("{text}");
        if self.warnings.len() < MAX_WARNINGS { self.warnings.push(text) } else { self.warnings_left_out += 1 }
    }

    /// Empties the window.
    fn restart(&mut self) {
        self.window = Window::new(self.window.span());
        self.begun_at = None;
        self.live.fill_seconds.clear();
    }

    /// Share of tau that the window covers.
    fn filled(&self) -> f64 {
        let covered = self.window.newest().zip(self.window.oldest()).map_or(0.0, |(newest, oldest)| newest - oldest);
        (covered / self.window.span()).min(1.0)
    }

    /// Records how far the window is filled.
    fn note_filling(&mut self) {
        let begun = *self.begun_at.get_or_insert_with(Instant::now);
        // The window decides whether it is full: a sum of steps may miss tau by rounding.
        let tenths = if self.window.is_full() { 10 } else { (10.0 * self.filled()) as usize };
        let known = self.live.fill_seconds.len().max(tenths);
        self.live.fill_seconds.resize(known, begun.elapsed().as_secs_f64());
    }

    /// True if a slide is due.
    fn due(&self, stride: usize) -> bool {
        self.window.is_full() && (!self.taken || self.moved >= stride)
    }
}

struct Shared {
    state: Mutex<State>,
    changed: Condvar,
    stop: AtomicBool,
    /// Called with snapshots before they enter the window.
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

/// The next window of a simulation, for those who work beside the one that was taken.
#[derive(Clone)]
pub struct NextWindow {
    shared: Arc<Shared>,
    stride: usize,
}

impl NextWindow {
    /// Whether it is complete, so that [`LiveWindow::next_within`] would not wait. False once no more steps come.
    pub fn is_complete(&self) -> bool {
        self.shared.lock().due(self.stride)
    }
}

/// A window that fills while frames are made. Dropping it ends its thread.
pub struct LiveWindow {
    shared: Arc<Shared>,
    stride: usize,
    thread: Option<JoinHandle<()>>,
}

impl Live {
    /// Starts to fill a window over `tau`; with [`Follow::Every`] a slide is `stride` steps.
    ///
    /// # Errors
    /// Too little memory for three snapshots; the thread cannot be started.
    pub fn follow(self, tau: f64, stride: usize) -> Result<LiveWindow, SourceError> {
        self.follow_beside(tau, stride, 1, 0)
    }

    /// The same with every `every`-th complete step alone, which a slide then counts, and with memory for so many windows that others hold besides
    /// that of the current frame.
    ///
    /// # Errors
    /// As for [`Live::follow`].
    pub fn follow_beside(self, tau: f64, stride: usize, every: usize, others: u64) -> Result<LiveWindow, SourceError> {
        let live = self;
        let nodes = live.grid.nodes() as u64;
        let (snapshot, step) = (16 * nodes, 4 * nodes * live.description.components() as u64);
        // Waiting steps, the step being read, and the buffers of the link: a restarted simulation may have blocks.
        let steps = (MAX_PENDING as u64 + 1 + live.link.steps_held()) * step;
        // The window, and the window of the current frame.
        let windows = 2 + others;
        let room = live.settings.memory_bytes().saturating_sub(steps + EXTRA_SNAPSHOTS * snapshot) / (windows * snapshot.max(1));
        if room < 3 {
            let least = (steps + (EXTRA_SNAPSHOTS + 3 * windows) * snapshot) as f64 / f64::from(1 << 30);
            let times = if others == 0 { "twice".to_owned() } else { format!("{windows} times") };
            let accepted = format!("at least {least:.3}: three snapshots, {times}, and the data on the way to them");
            return Err(SourceError::setting("live.memory_gib", live.settings.memory_gib, accepted));
        }
        let room = room as usize;
        let shared = Arc::new(Shared::new(tau));
        let conversion = Conversion::new(live.grid.clone())?;
        let mut reader = Reader { every: every as u64, ..Reader::new(live, shared.clone(), conversion, Thinning::new(tau, room), stride) };
        let thread = std::thread::Builder::new().name("ridgewatch-live".into()).spawn(move || reader.run());
        let thread = thread.map_err(|e| SourceError::Inconsistent(format!("the live thread could not start: {e}")))?;
        Ok(LiveWindow { shared, stride, thread: Some(thread) })
    }
}

impl LiveWindow {
    /// Sets the listener, which is called on the reading thread with each snapshot before it enters the window. A second call has no
    /// effect.
    pub fn tell(&self, listener: Listener) {
        // The first listener receives all snapshots already.
        let _ = self.shared.listener.set(listener);
    }

    /// The window, once it is full and has moved by the stride. `None` if the simulation ended before that. The inner error says that the
    /// reading thread has ended.
    ///
    /// # Errors
    /// The window is not ready within `limit`: ask again.
    pub fn next_within(&self, limit: Duration) -> Result<Option<Result<Taken, SourceError>>, StillReading> {
        let until = Instant::now() + limit;
        let mut state = self.shared.lock();
        loop {
            if state.due(self.stride) {
                break;
            }
            // The thread ends early only by a panic.
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
        (state.moved, state.taken) = (0, true);
        let warnings = state.take_warnings();
        let mut live = state.live.clone();
        live.age = since(live.published);
        live.snapshots = state.window.snapshots().len();
        let window = state.window.clone();
        drop(state);
        self.shared.changed.notify_all();
        Ok(Some(Ok(Taken { window, warnings, live })))
    }

    /// The warnings so far, if the simulation was lost since they were last taken: they do not wait for a window that may never come.
    pub fn loss(&self) -> Vec<String> {
        let mut state = self.shared.lock();
        if state.lost.is_some() { state.take_warnings() } else { Vec::new() }
    }

    /// The warnings since they were last taken, with the end of the simulation.
    pub fn warnings(&self) -> Vec<String> {
        self.shared.lock().take_warnings()
    }

    /// Whether [`Self::loss`] has something to tell.
    pub fn is_lost(&self) -> bool {
        self.shared.lock().lost.is_some()
    }

    /// Waits until the next window is complete or the simulation is lost or over, but no longer than this.
    pub fn wait_within(&self, limit: Duration) {
        let state = self.shared.lock();
        if !state.due(self.stride) && !state.ended && state.lost.is_none() {
            drop(self.shared.changed.wait_timeout(state, limit));
        }
    }

    /// True if [`Self::next_within`] would wait.
    pub fn is_waited_for(&self) -> bool {
        let state = self.shared.lock();
        !state.due(self.stride) && !state.ended && self.thread.as_ref().is_some_and(|thread| !thread.is_finished())
    }

    /// Tells whether the next window is complete, also to those who do not hold this one.
    pub fn next_window(&self) -> NextWindow {
        NextWindow { shared: Arc::clone(&self.shared), stride: self.stride }
    }

    /// Share of tau that the window covers.
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

/// The reading thread.
struct Reader {
    live: Live,
    shared: Arc<Shared>,
    assembler: Assembler,
    conversion: Conversion,
    thinning: Thinning,
    stride: usize,
    /// Every how many complete steps one is taken.
    every: u64,
    /// Complete steps since the window began.
    seen: u64,
    late: u32,
    /// [`LARGE`].
    large: usize,
}

impl Reader {
    fn new(live: Live, shared: Arc<Shared>, conversion: Conversion, thinning: Thinning, stride: usize) -> Self {
        let limit = Duration::from_secs_f64(live.settings.block_timeout_seconds);
        let assembler = Assembler::new(&live.description, limit, MAX_PENDING);
        Self { live, shared, assembler, conversion, thinning, stride, every: 1, seen: 0, late: 0, large: LARGE }
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
                // Blocks that wait unread in the ring are not late, so time runs only here.
                None => self.assembler.expire(),
            }
            self.tell_incomplete();
        }
    }

    /// Lets `take` put a block into its step.
    fn assemble<T: Send>(&mut self, values: &mut Vec<f32>, take: impl FnOnce(&mut Assembler, &mut Vec<f32>) -> T + Send) -> T {
        let Self { live, assembler, conversion, .. } = self;
        if 4 * live.grid.nodes() * live.description.components() < self.large {
            return take(assembler, values);
        }
        conversion.beside(|| take(assembler, values), &mut || live.link.beat())
    }

    /// Waits if a slide is due but was not taken. Returns whether it waited.
    fn hold_back(&mut self) -> bool {
        let state = self.shared.lock();
        if !state.due(self.stride) {
            return false;
        }
        let begin = Instant::now();
        self.live.link.hold();
        drop(self.shared.changed.wait_timeout(state, CHECK_INTERVAL));
        self.assembler.held(begin.elapsed());
        true
    }

    fn opened(&mut self, description: &ridgewatch_wire::Description, generation: u64) {
        if let Err(error) = self.assembler.introduce(description, generation) {
            self.shared.lock().warn(format!("the simulation does not fit: {error}"));
        }
    }

    /// Puts a complete step into the window.
    fn whole(&mut self, step: Step) {
        let Step { step: number, time, published, anew, values } = step;
        let mut state = self.shared.lock();
        if anew && state.live.steps > 0 {
            state.live.restarts += 1;
            state.ended = false;
            state.warn("the simulation was started anew".to_owned());
            if let Some(newest) = state.window.newest().filter(|newest| time <= *newest) {
                state.warn(format!("the simulation went back from time {newest} to {time}: the window begins anew"));
                state.restart();
                self.thinning.restart();
                self.seen = 0;
            }
        }
        // Not by its number: a simulation may publish every tenth step.
        let is_taken = self.seen.is_multiple_of(self.every.max(1));
        self.seen += 1;
        state.live.steps += 1;
        if !is_taken {
            drop(state);
            self.assembler.recycle(values);
            return;
        }
        let keep = self.thinning.keeps(time, &state.window);
        // Conversion and measurement take long: release the lock so that frames are made meanwhile, and renew the heartbeat.
        drop(state);
        let mut convert = || self.conversion.snapshot(time, &values, &mut || self.live.link.beat());
        let kept = keep.then(&mut convert);
        if !keep {
            self.thinning.skip(time, convert);
        }
        self.assembler.recycle(values);
        if let Some(kept) = &kept {
            self.thinning.keep(kept);
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
                    state.restart();
                    self.thinning.restart();
                    self.thinning.keep(&kept);
                    let _ = state.window.push(kept);
                }
            }
            Err(fault) => state.warn(fault.to_string()),
        }
        state.note_filling();
        // Only steps that move the window count toward the stride.
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
        let text = format!("the simulation {how} (block {block})");
        match (self.assembler.ended(block, generation), self.live.settings.at_end) {
            (true, AtEnd::Wait) => {
                tracing::info!("{text}");
                state.lost = Some(text);
            }
            (is_whole, _) => {
                state.warn(text);
                state.ended |= is_whole;
            }
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

/// Seconds since a moment, given in seconds since 1970; 0 if it lies in the future.
fn since(moment: f64) -> f64 {
    let now = SystemTime::now().duration_since(UNIX_EPOCH).map_or(0.0, |d| d.as_secs_f64());
    (now - moment).max(0.0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::live::settings::LiveSettings;
    use ridgewatch_wire::{AxisDescription, Description, Geometry, Policy, Producer};

    #[test]
    fn the_heartbeat_goes_on_while_a_step_is_taken_in() {
        let ring = std::path::PathBuf::from("/dev/shm").join(format!("rw-converting-{}", std::process::id()));
        let axis = |name| AxisDescription::uniform(name, "m", 0.0, 1.0, 2);
        let description = Description::whole(Geometry::Cartesian, vec![axis("x"), axis("y")], "s");
        let producer = Producer::open(&ring, description, 2, Policy::NewestWins).unwrap();
        let settings = LiveSettings { ring: Some(ring.clone()), ..Default::default() };
        let live = Live::connect(&settings, &AtomicBool::new(false), &mut |_| ()).unwrap().unwrap();
        let conversion = Conversion::new(live.grid().clone()).unwrap();
        let mut reader = Reader::new(live, Arc::new(Shared::new(1.0)), conversion, Thinning::new(1.0, 14), 1);
        // The first follower's heartbeat.
        let heartbeat = || {
            let (file, mut bytes) = (std::fs::File::open(ridgewatch_wire::block_path(&ring, 0)).unwrap(), [0; 8]);
            std::os::unix::fs::FileExt::read_exact_at(&file, &mut bytes, 4096 + 8).unwrap();
            u64::from_ne_bytes(bytes)
        };
        // The converting threads are busy for this long.
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
