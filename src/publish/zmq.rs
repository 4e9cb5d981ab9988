//! ZeroMQ publisher: the newest frame wins, and every subscriber is served at its own pace.
//!
//! The cycle puts a frame into the mailbox and continues. The publishing thread encodes the newest frame once for all and gives it to the socket,
//! which is the crate `ridgewatch-zmtp`.

use super::error::PublishError;
use super::message::{FRAME_TOPIC, RECORD_TOPIC, WORK_TOPIC, WorkMark, encode_frame};
use super::settings::{DEFAULT_ENDPOINT, Payload, PublishSettings};
use super::summary::PublishStatistics;
use crate::run::{Frame, FrameRecord};
use ridgewatch_zmtp::{Keep, Limits, PubSocket, private_endpoint};
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

/// Publishes frames until [`Publisher::finish`].
#[derive(Debug)]
pub struct Publisher {
    mailbox: Arc<Mailbox>,
    /// Shared with the publishing thread.
    socket: Arc<PubSocket>,
    /// `None` once finished.
    thread: Option<JoinHandle<()>>,
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
        let limits = Limits {
            in_flight: settings.frames_in_flight,
            stall: Duration::from_secs_f64(settings.stall_seconds),
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
        let name = "ridgewatch-publish";
        let thread = std::thread::Builder::new()
            .name(name.to_owned())
            .spawn(move || worker.run())
            .map_err(|source| PublishError::Thread { name, source })?;
        Ok(Self { mailbox, socket, thread: Some(thread) })
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
        self.socket.close(by);
        self.statistics()
    }
}

/// Between the cycle and the publishing thread.
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
        if state.frame.replace(frame).is_some() {
            state.statistics.superseded += 1;
        }
        self.changed.notify_all();
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
            if waits && (!self.socket.is_wanted(FRAME_TOPIC.as_bytes()) || self.socket.has_room(TICK)) {
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
        let encoded = encode_frame(frame, self.payload);
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
