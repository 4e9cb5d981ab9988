//! ZeroMQ publisher: the newest frame wins, and every subscriber is served at its own pace.
//!
//! The cycle puts a frame into the mailbox and continues. The publishing thread encodes the newest frame once for all and gives it to the socket,
//! which is the crate `ridgewatch-zmtp`. Another thread encodes all layers of the newest frame while somebody subscribes to them, so that no picture
//! waits for that.

use super::error::PublishError;
use super::message::{FRAME_TOPIC, LAYERS_TOPIC, MAX_LAYERED_PIXELS, RECORD_TOPIC, WORK_TOPIC, WorkMark, encode_frame};
use super::newest::RunAbout;
use super::settings::{DEFAULT_ENDPOINT, Payload, PublishSettings};
use super::summary::PublishStatistics;
use crate::run::{Frame, FrameRecord};
use ridgewatch_zmtp::{Keep, Limits, PubSocket, private_endpoint};
use serde_json::Value;
use std::collections::VecDeque;
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

/// Maximum number of records that wait for the publishing thread, and for a subscriber.
const MAX_RECORDS: usize = 256;
/// Longest wait for room in the socket, after which records are looked at again.
const TICK: Duration = Duration::from_millis(20);
/// Interval at which it is told what the run is at.
const TELL: Duration = Duration::from_secs(1);
/// Shortest time from one message with all layers to the next.
const LAYERS_SPACING: Duration = Duration::from_secs(1);
/// The same in times of making one, so that it takes a quarter of a processor at most.
const LAYERS_SHARE: u32 = 4;
/// Interval at which subscribers to layers are looked for.
const LAYERS_LOOK: Duration = Duration::from_millis(200);
/// Time for a message with all layers to be taken, in times of that for others.
const LAYERS_PATIENCE: u32 = 5;
/// Maximum length of what is told of the run, in bytes.
const MAX_ABOUT_BYTES: usize = 64 << 10;
/// Pause between two looks whether a thread has ended.
const PAUSE: Duration = Duration::from_millis(5);

/// Publishes frames until [`Publisher::finish`].
#[derive(Debug)]
pub struct Publisher {
    mailbox: Arc<Mailbox>,
    /// Shared with the publishing thread.
    socket: Arc<PubSocket>,
    /// `None` once finished.
    thread: Option<JoinHandle<()>>,
    layers: Option<JoinHandle<()>>,
}

impl Drop for Publisher {
    /// Without [`Publisher::finish`], after an error elsewhere, the thread ends by itself and closes the socket.
    fn drop(&mut self) {
        self.mailbox.close(Instant::now());
    }
}

impl Publisher {
    /// Binds `endpoint` (`tcp://HOST:PORT`, where `*` is every interface and port 0 a free one, `ipc://PATH`, or `private`) and starts the
    /// publishing thread. Uses the settings `payload`, `frames_in_flight`, `stall_seconds` and `peers`.
    ///
    /// # Errors
    /// A setting or an endpoint that is not accepted or in use, or an error of the system.
    pub fn start(endpoint: &str, settings: &PublishSettings) -> Result<Self, PublishError> {
        settings.check()?;
        let stall = Duration::from_secs_f64(settings.stall_seconds);
        let limits = Limits {
            in_flight: settings.frames_in_flight,
            stall,
            bulk_stall: stall * LAYERS_PATIENCE,
            queued: MAX_RECORDS,
            ..Limits::default()
        };
        let endpoint = match endpoint {
            DEFAULT_ENDPOINT => private_endpoint("frames").map_err(|error| PublishError::of_bind(endpoint, error))?,
            endpoint => endpoint.to_owned(),
        };
        let bound = PubSocket::bind(&endpoint, settings.peers.map(Into::into), limits);
        let socket = Arc::new(bound.map_err(|error| PublishError::of_bind(&endpoint, error))?);
        let mailbox = Arc::new(Mailbox::default());
        let worker = Worker {
            mailbox: Arc::clone(&mailbox),
            socket: Arc::clone(&socket),
            payload: settings.payload,
            said: (0, 0),
            told: None,
            is_at_work: false,
        };
        let layers = LayersWorker { mailbox: Arc::clone(&mailbox), socket: Arc::clone(&socket) };
        // Ends the threads if one cannot be started.
        let mut publisher = Self { mailbox, socket, thread: None, layers: None };
        publisher.thread = Some(spawn("ridgewatch-publish", move || worker.run())?);
        publisher.layers = Some(spawn("ridgewatch-layers", move || layers.run())?);
        Ok(publisher)
    }

    /// Tells those who get all layers what is to be known of the run.
    pub fn describe(&self, about: &RunAbout) {
        let told = serde_json::to_value(about).ok().filter(|told| told.to_string().len() <= MAX_ABOUT_BYTES);
        self.mailbox.lock().about = told.map(Arc::new);
    }

    /// Endpoint, with the port that was bound.
    pub fn endpoint(&self) -> &str {
        self.socket.endpoint()
    }

    /// Publishes a frame. Never waits. It replaces a picture that was not sent yet; that record is still sent.
    pub fn frame(&self, frame: Frame) {
        self.mailbox.put(frame);
    }

    /// Counts so far.
    pub fn statistics(&self) -> PublishStatistics {
        let (ours, socket) = (self.mailbox.lock().statistics, self.socket.counts());
        PublishStatistics {
            records_dropped: ours.records_dropped + socket.dropped,
            stall_disconnects: socket.stalled,
            refused_connections: socket.refused,
            closed_connections: socket.faults + socket.displaced,
            peak_subscribers: socket.peak_subscribers,
            peak_queued_bytes: socket.peak_bytes,
            ..ours
        }
    }

    /// Sends the rest, waits at most `linger` until subscribers have it, and closes the socket.
    pub fn finish(mut self, linger: Duration) -> PublishStatistics {
        let by = Instant::now() + linger;
        self.mailbox.close(by);
        if self.thread.take().is_some_and(|thread| thread.join().is_err()) {
            tracing::error!("the publishing thread ended by a panic");
        }
        // It may be at a message that nobody will take in time.
        while self.layers.as_ref().is_some_and(|thread| !thread.is_finished()) && Instant::now() < by {
            std::thread::sleep(PAUSE);
        }
        self.socket.close(by);
        self.statistics()
    }
}

fn spawn(name: &'static str, work: impl FnOnce() + Send + 'static) -> Result<JoinHandle<()>, PublishError> {
    std::thread::Builder::new().name(name.to_owned()).spawn(work).map_err(|source| PublishError::Thread { name, source })
}

/// Between the cycle and the publishing threads.
#[derive(Debug, Default)]
struct Mailbox {
    state: Mutex<State>,
    changed: Condvar,
}

#[derive(Debug, Default)]
struct State {
    /// The newest frame. It replaces one that was not sent yet.
    frame: Option<Frame>,
    records: VecDeque<Arc<FrameRecord>>,
    /// The newest frame, for those who will ask for its layers.
    newest: Option<Frame>,
    /// What is told of the run.
    about: Option<Arc<Value>>,
    /// Deadline of the publishing thread, once it is asked to end.
    close_by: Option<Instant>,
    /// Without the counts of the socket.
    statistics: PublishStatistics,
}

impl Mailbox {
    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn put(&self, frame: Frame) {
        let mut state = self.lock();
        state.statistics.frames += 1;
        if state.records.len() >= MAX_RECORDS {
            state.records.pop_front();
            state.statistics.records_dropped += 1;
        }
        state.records.push_back(Arc::clone(&frame.record));
        let before = state.newest.replace(frame.clone());
        if state.frame.replace(frame).is_some() {
            state.statistics.superseded += 1;
        }
        drop(state);
        self.changed.notify_all();
        // A large picture is given back to the system without the lock.
        drop(before);
    }

    fn close(&self, by: Instant) {
        self.lock().close_by.get_or_insert(by);
        self.changed.notify_all();
    }

    /// Waits until there is something to do, at most until the work of the run is to be told again.
    fn wait(&self) -> MutexGuard<'_, State> {
        let idle = |state: &mut State| state.frame.is_none() && state.records.is_empty() && state.close_by.is_none();
        self.changed.wait_timeout_while(self.lock(), TELL, idle).unwrap_or_else(PoisonError::into_inner).0
    }

    /// Waits for so long, or until it is closed.
    fn wait_closed(&self, pause: Duration) -> MutexGuard<'_, State> {
        let is_open = |state: &mut State| state.close_by.is_none();
        self.changed.wait_timeout_while(self.lock(), pause, is_open).unwrap_or_else(PoisonError::into_inner).0
    }
}

/// The publishing thread.
struct Worker {
    mailbox: Arc<Mailbox>,
    socket: Arc<PubSocket>,
    payload: Payload,
    /// Stalled subscribers and refused connections that were warned about.
    said: (u64, u64),
    /// When the work of the run was last told.
    told: Option<Instant>,
    /// Whether it was told to be at any.
    is_at_work: bool,
}

impl Worker {
    fn run(mut self) {
        loop {
            let mut state = self.mailbox.wait();
            let records = std::mem::take(&mut state.records);
            let done = state.close_by.filter(|by| state.frame.is_none() || Instant::now() >= *by);
            if done.is_some() && state.frame.take().is_some() {
                state.statistics.superseded += 1;
            }
            let waits = state.frame.is_some();
            drop(state);
            for record in records {
                self.send_record(&record);
            }
            let topic = FRAME_TOPIC.as_bytes();
            if waits && (!self.socket.is_wanted(topic) || self.socket.has_room(topic, Keep::Newest, TICK)) {
                // Maybe a newer one by now.
                let newest = self.mailbox.lock().frame.take();
                newest.iter().for_each(|frame| self.send_picture(frame));
            }
            self.tell_work();
            self.warn();
            if done.is_some() {
                return;
            }
        }
    }

    fn send_record(&self, record: &FrameRecord) {
        let sent = if self.socket.is_wanted(RECORD_TOPIC.as_bytes()) {
            serde_json::to_vec(record).map(|json| self.socket.send(&[RECORD_TOPIC.as_bytes()], json, Keep::All))
        } else {
            Ok(())
        };
        let statistics = &mut self.mailbox.lock().statistics;
        match sent {
            Ok(()) => statistics.records += 1,
            Err(error) => {
                statistics.records_dropped += 1;
                tracing::warn!("record of frame {} was not published: {error}", record.frame);
            }
        }
    }

    fn send_picture(&self, frame: &Frame) {
        if !self.socket.is_wanted(FRAME_TOPIC.as_bytes()) {
            self.mailbox.lock().statistics.without_subscriber += 1;
            return;
        }
        let about = self.mailbox.lock().about.clone();
        let encoded = encode_frame(frame, self.payload, about.as_deref());
        let sent = encoded.map(|(header, payload)| self.socket.send(&[FRAME_TOPIC.as_bytes(), &header], payload, Keep::Newest));
        let statistics = &mut self.mailbox.lock().statistics;
        match sent {
            Ok(()) => statistics.sent += 1,
            Err(error) => {
                statistics.failed += 1;
                tracing::warn!("frame {} was not published: {error}", frame.record.frame);
            }
        }
    }

    /// Tells what the run is at while it takes long, each second, and once that it is over.
    fn tell_work(&mut self) {
        let is_early = self.told.is_some_and(|told| told.elapsed() < TELL);
        if is_early || !self.socket.is_wanted(WORK_TOPIC.as_bytes()) {
            return;
        }
        let mark = WorkMark::now();
        if mark.work.is_none() && !self.is_at_work {
            return;
        }
        (self.told, self.is_at_work) = (Some(Instant::now()), mark.work.is_some());
        match serde_json::to_vec(&mark) {
            Ok(json) => self.socket.send(&[WORK_TOPIC.as_bytes()], json, Keep::Note),
            Err(error) => tracing::warn!("the work of the run was not published: {error}"),
        }
    }

    /// Says what happened to subscribers: the first time, and when it has happened twice as often.
    fn warn(&mut self) {
        let counts = self.socket.counts();
        if counts.stalled > 2 * self.said.0 {
            self.said.0 = counts.stalled;
            tracing::warn!("{} times a subscriber that did not read was disconnected; it may reconnect", counts.stalled);
        }
        if counts.refused > 2 * self.said.1 {
            self.said.1 = counts.refused;
            tracing::warn!("{} connections of other users were refused (publish.peers = \"any\" accepts them)", counts.refused);
        }
    }
}

/// The thread that makes messages with all layers.
struct LayersWorker {
    mailbox: Arc<Mailbox>,
    socket: Arc<PubSocket>,
}

impl LayersWorker {
    fn run(self) {
        // Count of frames when one was sent last, how long that took, and when the next may be.
        let (mut sent, mut took, mut next) = (0, Duration::ZERO, Instant::now());
        loop {
            let pause = next.saturating_duration_since(Instant::now()).max(LAYERS_LOOK);
            let state = self.mailbox.wait_closed(pause);
            let (close_by, count, newest, about) = (state.close_by, state.statistics.frames, state.newest.clone(), state.about.clone());
            drop(state);
            let begin = Instant::now();
            // At the end only what can be taken in time.
            let in_time = close_by.is_none_or(|by| begin + took <= by);
            let fits = |frame: &Frame| frame.film.width.saturating_mul(frame.film.height) <= MAX_LAYERED_PIXELS;
            if let Some(frame) = newest.filter(fits)
                && in_time
                && self.is_due(count != sent)
            {
                self.send(&frame, about.as_deref());
                (sent, took) = (count, begin.elapsed());
                next = begin + LAYERS_SPACING.max(took * LAYERS_SHARE);
            }
            if close_by.is_some() {
                return;
            }
        }
    }

    /// Whether somebody wants layers who has not got those of the newest frame, and there is room for them.
    fn is_due(&self, is_new: bool) -> bool {
        let topic = LAYERS_TOPIC.as_bytes();
        self.socket.wants_bulk(topic).is_some_and(|has_come| has_come || is_new) && self.socket.has_room(topic, Keep::Bulk, Duration::ZERO)
    }

    fn send(&self, frame: &Frame, about: Option<&Value>) {
        match encode_frame(frame, Payload::Exr, about) {
            Ok((header, exr)) => {
                self.socket.send(&[LAYERS_TOPIC.as_bytes(), &header], exr, Keep::Bulk);
                self.mailbox.lock().statistics.layers += 1;
            }
            Err(error) => tracing::warn!("the layers of frame {} were not published: {error}", frame.record.frame),
        }
    }
}
