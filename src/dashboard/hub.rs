//! What all browsers share: the newest picture, the latest records, the state of the publisher.

use super::history::History;
use super::metrics::{Metrics, Server};
use super::pixels::{Kept, Pixels};
use super::received::{Received, decode};
use super::steering::{Answer, Reach, Wheel};
use crate::progress;
use crate::publish::{FRAME_TOPIC, PROTOCOL, RECORD_TOPIC, WORK_TOPIC, WorkMark};
use bytes::Bytes;
use ridgewatch_zmtp::{SubscribeError, Subscriber};
use serde::{Deserialize, Serialize};
use std::collections::VecDeque;
use std::io::ErrorKind;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};
use tokio::sync::{Notify, watch};

/// Maximum length of a published message, in bytes: a lossless picture of 16 million pixels.
const MAX_MESSAGE_BYTES: usize = 64 << 20;
/// Maximum length of a picture that is shown, in bytes. Some proxies accept 10 MB.
const MAX_PICTURE_BYTES: usize = 10_000_000 - MAX_JSON_BYTES;
/// Maximum number of characters of a problem.
const MAX_PROBLEM: usize = 300;
/// Maximum length of the JSON of a message, in bytes.
const MAX_JSON_BYTES: usize = 256 << 10;
/// Records that are kept for browsers that come later, and their bytes.
const MAX_KEPT_RECORDS: usize = 2000;
const MAX_KEPT_BYTES: usize = 16 << 20;
/// Bytes of records in one message. Some proxies accept 10 MB.
const MAX_BATCH_BYTES: usize = 1 << 20;
/// Maximum number of browsers.
const MAX_CLIENTS: usize = 64;
/// Shortest time between two attempts to reach the publisher.
const RECONNECT: Duration = Duration::from_millis(500);
/// Silence after which a publisher counts as silent, if it is also so many times the usual interval of its records. What it said of its work counts
/// as long.
const SILENT: Duration = Duration::from_secs(3);
const SILENT_INTERVALS: u32 = 5;
/// A run that leaves no mark of progress for so long may hang.
const HANGS: Duration = Duration::from_secs(60);
/// Intervals whose median is the usual one.
const INTERVALS: usize = 9;

/// A picture as it is sent to every browser.
#[derive(Debug)]
pub(super) struct Picture {
    pub sequence: u64,
    pub message: Bytes,
}

/// What all browsers share.
#[derive(Debug)]
pub(super) struct Hub {
    endpoint: String,
    /// Tells this server from others, to pages that come back.
    server: String,
    pub picture: watch::Sender<Option<Arc<Picture>>>,
    /// Number of records so far.
    pub recorded: watch::Sender<u64>,
    records: Mutex<Records>,
    health: Mutex<Health>,
    metrics: Mutex<Metrics>,
    clients: Mutex<Clients>,
    /// For commands of the browsers.
    pub wheel: Wheel,
    pub pixels: Pixels,
    /// What the run keeps in its folder.
    pub history: Option<History>,
    /// The run is in this process.
    is_beside_run: bool,
    /// SVG of speed against accuracy.
    pub chart: Option<Bytes>,
}

/// What pages are shown beside the published messages.
#[derive(Debug)]
pub(super) struct Shown {
    pub pixels: Pixels,
    pub history: Option<History>,
    pub chart: Option<Bytes>,
    pub is_beside_run: bool,
}

/// The latest records, as JSON.
#[derive(Debug, Default)]
struct Records {
    kept: VecDeque<Arc<str>>,
    bytes: usize,
    /// Number of the first one that is kept.
    first: u64,
}

#[derive(Debug, Default)]
struct Health {
    last_message: Option<Instant>,
    last_record: Option<Instant>,
    intervals: VecDeque<Duration>,
    is_connected: bool,
    /// Marks of progress of the run, and when there was a new one.
    marks: Option<(u64, Instant)>,
    /// What a run in another process said of its work, and when.
    told: Option<(WorkMark, Instant)>,
    /// Why the publisher cannot be followed.
    link_problem: Option<String>,
    /// Why pictures or records cannot be shown.
    problem: Option<String>,
}

#[derive(Debug, Default)]
struct Clients {
    next: u64,
    there: Vec<Member>,
}

/// A browser.
#[derive(Debug)]
struct Member {
    number: u64,
    may_steer: bool,
    /// Last sign that it shows pictures.
    active: Instant,
    displaced: Arc<Notify>,
}

/// A place among the browsers, until it is dropped.
#[derive(Debug)]
pub(super) struct Place {
    hub: Arc<Hub>,
    number: u64,
    /// Notified when the place is given to another one.
    pub displaced: Arc<Notify>,
}

impl Drop for Place {
    fn drop(&mut self) {
        lock(&self.hub.clients).there.retain(|member| member.number != self.number);
    }
}

impl Place {
    /// The browser has drawn a picture.
    pub fn is_active(&self) {
        if let Some(member) = lock(&self.hub.clients).there.iter_mut().find(|member| member.number == self.number) {
            member.active = Instant::now();
        }
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
enum Status {
    /// Nothing was received yet.
    Waiting,
    Following,
    /// Nothing for long: the publisher has stopped, paused or is lost.
    Silent,
}

impl Status {
    fn unless_silent(self) -> Self {
        if self == Self::Silent { Self::Following } else { self }
    }
}

/// Message about the publisher.
#[derive(Debug, Serialize)]
struct State<'a> {
    kind: &'static str,
    endpoint: &'a str,
    status: Status,
    seconds_since_message: Option<f64>,
    /// What the run has been at for more than two seconds, in words.
    #[serde(skip_serializing_if = "Option::is_none")]
    work: Option<String>,
    clients: usize,
    version: &'static str,
    #[serde(skip_serializing_if = "Option::is_none")]
    problem: Option<String>,
    steering: Reach,
    values: Kept,
    /// Whether the folder of the run is known.
    has_past: bool,
    /// Whether there is a chart of speed against accuracy.
    has_chart: bool,
    /// Token that only watches, for pages that may steer.
    #[serde(skip_serializing_if = "Option::is_none")]
    token_to_share: Option<&'a str>,
}

/// What must be known of a picture's header. The page reads the rest.
#[derive(Debug, Deserialize)]
struct Head {
    encoding: String,
    payload_bytes: usize,
    /// Rows, columns and channels.
    shape: Option<[usize; 3]>,
    tone_map: Option<[f64; 3]>,
}

impl Hub {
    pub fn new(endpoint: String, wheel: Wheel, Shown { pixels, history, chart, is_beside_run }: Shown) -> Self {
        Self {
            endpoint,
            wheel,
            pixels,
            history,
            is_beside_run,
            chart,
            server: format!("{:?}", std::time::SystemTime::now()),
            picture: watch::Sender::new(None),
            recorded: watch::Sender::new(0),
            records: Mutex::default(),
            health: Mutex::default(),
            metrics: Mutex::default(),
            clients: Mutex::default(),
        }
    }

    /// Takes a place. If all are taken, a browser loses its own: one that only watches if there is one, so that nobody who watches can push out
    /// those who steer; of these the one that has drawn nothing for longest.
    pub fn enter(self: &Arc<Self>, may_steer: bool) -> Place {
        let mut clients = lock(&self.clients);
        let (number, displaced) = (clients.next, Arc::new(Notify::new()));
        clients.next += 1;
        clients.there.push(Member { number, may_steer, active: Instant::now(), displaced: Arc::clone(&displaced) });
        if clients.there.len() > MAX_CLIENTS
            && let Some((first, _)) =
                clients.there.iter().enumerate().min_by_key(|(_, member)| (member.may_steer, member.active, member.number))
        {
            clients.there.swap_remove(first).displaced.notify_one();
        }
        drop(clients);
        Place { hub: Arc::clone(self), number, displaced }
    }

    /// Follows the publisher, and reaches it again when it is lost. Never ends.
    pub async fn follow(&self) {
        // What a run in this process is at needs no message.
        let topics: &[&str] = if self.is_beside_run { &[FRAME_TOPIC, RECORD_TOPIC] } else { &[FRAME_TOPIC, RECORD_TOPIC, WORK_TOPIC] };
        loop {
            let begin = tokio::time::Instant::now();
            match Subscriber::connect(&self.endpoint, topics, MAX_MESSAGE_BYTES).await {
                Ok(mut subscriber) => {
                    lock(&self.health).connected();
                    let error = loop {
                        match subscriber.receive().await {
                            Ok(parts) => self.take(&parts).await,
                            Err(error) => break error,
                        }
                    };
                    self.lost(&error);
                }
                Err(error) => self.lost(&error),
            }
            tokio::time::sleep_until(begin + RECONNECT).await;
        }
    }

    /// A publisher that is not there is waited for; anything else is said.
    fn lost(&self, error: &SubscribeError) {
        tracing::debug!("{}: {error}", self.endpoint);
        let mut health = lock(&self.health);
        (health.is_connected, health.told) = (false, None);
        let absent = [ErrorKind::NotFound, ErrorKind::ConnectionRefused, ErrorKind::UnexpectedEof, ErrorKind::ConnectionReset];
        match error {
            SubscribeError::System(error) if absent.contains(&error.kind()) => {}
            // It comes again with the next picture, soon after the next connection.
            SubscribeError::Length { .. } => health.problem = Some(short(&error.to_string())),
            error => health.link_problem = Some(short(&format!("the publisher cannot be followed: {error}"))),
        }
    }

    /// Takes a published message.
    async fn take(&self, parts: &[Bytes]) {
        let taken = match parts {
            [topic, record] if topic == RECORD_TOPIC => self.take_record(record),
            [topic, header, picture] if topic == FRAME_TOPIC => self.take_picture(header, picture).await,
            [topic, mark] if topic == WORK_TOPIC => self.take_work(mark),
            _ => Err(format!("a message of {} parts; accepted: frame (3 parts), record and work (2 parts)", parts.len())),
        };
        let mut health = lock(&self.health);
        // A run that is at work for long says so and has no frame meanwhile.
        if parts.first().is_some_and(|topic| topic != WORK_TOPIC) {
            health.last_message = Some(Instant::now());
        }
        if let Err(problem) = taken {
            health.problem = Some(short(&problem));
        }
    }

    fn take_record(&self, json: &[u8]) -> Result<(), String> {
        #[derive(Deserialize)]
        struct Numbered {
            #[serde(rename = "frame")]
            _frame: u64,
            seconds: Option<Seconds>,
        }
        #[derive(Deserialize)]
        struct Seconds {
            total: Option<f64>,
        }
        let (record, Numbered { seconds, .. }) = checked(json)?;
        lock(&self.health).note_record(Instant::now(), seconds.and_then(|seconds| seconds.total));
        lock(&self.metrics).take(record);
        lock(&self.records).keep(record.into());
        self.recorded.send_modify(|count| *count += 1);
        Ok(())
    }

    fn take_work(&self, json: &[u8]) -> Result<(), String> {
        let (_, mark): (_, WorkMark) = checked(understood(json)?.as_bytes())?;
        lock(&self.health).told = Some((WorkMark { work: mark.work.as_deref().map(short), ..mark }, Instant::now()));
        Ok(())
    }

    async fn take_picture(&self, given: &Bytes, picture: &Bytes) -> Result<(), String> {
        let header = understood(given)?;
        let (_, Head { encoding, payload_bytes, shape, tone_map }) = checked(header.as_bytes())?;
        if let Some((history, tone_map)) = self.history.as_ref().zip(tone_map) {
            *lock(&history.tone_map) = tone_map;
        }
        if !["jpeg", "png", "exr"].contains(&encoding.as_str()) {
            return Err(format!("the publisher sends pictures as {encoding}; shown are jpeg, png and exr (publish.payload)"));
        }
        if payload_bytes != picture.len() {
            return Err(format!("a picture of {} bytes, of which its header says {payload_bytes}", picture.len()));
        }
        if encoding != "exr" {
            self.pixels.receive_plain(shape.map_or(0, |[rows, columns, _]| rows.saturating_mul(columns)));
            return self.show(header, picture);
        }
        let (given, picture) = (given.clone(), picture.clone());
        let decoded = tokio::task::spawn_blocking(move || decode(&given, &picture)).await.map_err(|error| error.to_string())?;
        let Received { header, jpeg, frame, about } = decoded?;
        self.show(&header, &jpeg)?;
        self.pixels.receive(frame, about);
        Ok(())
    }

    /// Tells pages of a problem, until the next picture is shown.
    pub(super) fn complain(&self, problem: &str) {
        lock(&self.health).problem = Some(short(problem));
    }

    /// Where the run publishes.
    pub(super) fn endpoint(&self) -> &str {
        &self.endpoint
    }

    /// Shows a picture that browsers know.
    fn show(&self, header: &str, picture: &[u8]) -> Result<(), String> {
        if picture.len() > MAX_PICTURE_BYTES {
            return Err(format!(
                "a picture of {} bytes; shown are up to {MAX_PICTURE_BYTES} (publish.payload = \"jpeg\" is smaller)",
                picture.len()
            ));
        }
        self.picture.send_modify(|newest| {
            let sequence = newest.as_ref().map_or(1, |newest| newest.sequence + 1);
            let json = format!(r#"{{"kind":"frame","sequence":{sequence},"header":{header}}}"#);
            *newest = Some(Arc::new(Picture { sequence, message: message(&json, picture) }));
        });
        // Records arrive also where pictures are not understood.
        lock(&self.health).problem = None;
        Ok(())
    }

    /// Message with the records from number `from` on, and the number after the last of them. `None` if there are none.
    pub fn records_from(&self, from: u64) -> Option<(Bytes, u64)> {
        let (batch, skipped, next) = lock(&self.records).from(from)?;
        let (server, first) = (&self.server, from + skipped);
        let json =
            format!(r#"{{"kind":"records","server":{server:?},"first":{first},"records":[{}],"skipped":{skipped}}}"#, batch.join(","));
        Some((message(&json, &[]), next))
    }

    /// Records and state of this server for Prometheus.
    pub fn metrics(&self) -> String {
        let server = Server { is_connected: lock(&self.health).is_connected, pages: lock(&self.clients).there.len() };
        lock(&self.metrics).text(&server)
    }

    /// Message about the publisher, to a page that may steer if there is a token to share.
    pub fn state(&self, token_to_share: Option<&str>) -> Bytes {
        let clients = lock(&self.clients).there.len();
        let mut health = lock(&self.health);
        let silence = health.last_message.map(|last| last.elapsed());
        let now = Instant::now();
        let (work, marks) =
            if self.is_beside_run { (progress::work().map(|words| short(&words)), progress::marks()) } else { health.told_work(now) };
        // Marks that nobody told are none.
        let is_at_work = work.is_some() && health.has_new_marks(marks, now);
        let state = State {
            kind: "state",
            endpoint: &self.endpoint,
            // A run at work is not lost, unless it hangs.
            status: if is_at_work { health.status(silence).unless_silent() } else { health.status(silence) },
            seconds_since_message: silence.map(|silence| silence.as_secs_f64()),
            work,
            clients,
            version: env!("CARGO_PKG_VERSION"),
            problem: health.link_problem.clone().or_else(|| health.problem.clone()),
            steering: self.wheel.reach_for(token_to_share.is_some()),
            values: self.pixels.kept(),
            has_past: self.history.is_some(),
            has_chart: self.chart.is_some(),
            token_to_share,
        };
        message(&serde_json::to_string(&state).unwrap_or_default(), &[])
    }
}

impl Health {
    /// Whether the run left marks within the last while.
    fn has_new_marks(&mut self, marks: u64, now: Instant) -> bool {
        let (before, since) = *self.marks.get_or_insert((marks, now));
        if before != marks {
            self.marks = Some((marks, now));
            return true;
        }
        now.saturating_duration_since(since) < HANGS
    }

    /// What a run in another process is at, and its marks of progress. `None` if it has not said so of late.
    fn told_work(&self, now: Instant) -> (Option<String>, u64) {
        match &self.told {
            Some((mark, told)) if now.saturating_duration_since(*told) <= SILENT => (mark.work.clone(), mark.marks),
            _ => (None, 0),
        }
    }

    /// Another run may have other intervals.
    fn connected(&mut self) {
        (self.is_connected, self.link_problem, self.last_record) = (true, None, None);
        self.intervals.clear();
    }

    /// Before the first interval, the frame's own `seconds` stand for it.
    fn note_record(&mut self, now: Instant, seconds: Option<f64>) {
        let own = || Duration::try_from_secs_f64(seconds.unwrap_or_default()).unwrap_or_default();
        let interval = self.last_record.replace(now).map_or_else(own, |before| now - before);
        if self.intervals.len() == INTERVALS {
            self.intervals.pop_front();
        }
        self.intervals.push_back(interval);
    }

    fn status(&self, silence: Option<Duration>) -> Status {
        let Some(silence) = silence else { return Status::Waiting };
        let mut sorted: Vec<_> = self.intervals.iter().copied().collect();
        sorted.sort_unstable();
        let usual = sorted.get(sorted.len().saturating_sub(1) / 2).copied().unwrap_or_default();
        let longest = if self.is_connected { SILENT.max(usual.saturating_mul(SILENT_INTERVALS)) } else { SILENT };
        if silence > longest { Status::Silent } else { Status::Following }
    }
}

impl Records {
    fn keep(&mut self, record: Arc<str>) {
        self.bytes += record.len();
        self.kept.push_back(record);
        while self.kept.len() > MAX_KEPT_RECORDS || self.bytes > MAX_KEPT_BYTES {
            let Some(oldest) = self.kept.pop_front() else { break };
            self.bytes -= oldest.len();
            self.first += 1;
        }
    }

    /// Records from number `from` on, as many as a message holds; how many before them are gone; the number after the last.
    fn from(&self, from: u64) -> Option<(Vec<Arc<str>>, u64, u64)> {
        let skipped = self.first.saturating_sub(from);
        let begin = usize::try_from(from.saturating_sub(self.first)).ok()?;
        let mut bytes = 0;
        let fits = |record: &&Arc<str>| {
            bytes += record.len();
            bytes <= MAX_BATCH_BYTES
        };
        let batch: Vec<_> = self.kept.iter().skip(begin).take_while(fits).cloned().collect();
        let next = from + skipped + batch.len() as u64;
        (!batch.is_empty()).then_some((batch, skipped, next))
    }
}

/// Text that is JSON of this form, and what it says.
pub(super) fn checked<'a, T: Deserialize<'a>>(json: &'a [u8]) -> Result<(&'a str, T), String> {
    if json.len() > MAX_JSON_BYTES {
        return Err(format!("JSON of {} bytes; accepted: {MAX_JSON_BYTES}", json.len()));
    }
    let fault = |error: &dyn std::fmt::Display| format!("a message that is not understood: {error}");
    let text = std::str::from_utf8(json).map_err(|error| fault(&error))?;
    Ok((text, serde_json::from_str(text).map_err(|error| fault(&error))?))
}

/// JSON that says to be of the protocol that is spoken here.
pub(super) fn understood(json: &[u8]) -> Result<&str, String> {
    #[derive(Deserialize)]
    struct Protocol {
        protocol: u32,
    }
    match checked(json)? {
        (text, Protocol { protocol: PROTOCOL }) => Ok(text),
        (_, Protocol { protocol }) => Err(format!("the publisher speaks protocol {protocol}; accepted: {PROTOCOL}")),
    }
}

/// Message with the answer to a command.
pub(super) fn answer(number: u64, answer: &Answer) -> Bytes {
    #[derive(Serialize)]
    struct Answered<'a> {
        kind: &'static str,
        command: u64,
        #[serde(flatten)]
        answer: &'a Answer,
    }
    message(&serde_json::to_string(&Answered { kind: "answer", command: number, answer }).unwrap_or_default(), &[])
}

/// A message to the page: the length of the JSON as a little-endian u32, the JSON, and a picture.
pub(super) fn message(json: &str, picture: &[u8]) -> Bytes {
    // Our own JSON is shorter than 2^32.
    let length = u32::try_from(json.len()).unwrap_or(u32::MAX);
    [&length.to_le_bytes(), json.as_bytes(), picture].concat().into()
}

/// The beginning of a text that another program may have written.
fn short(text: &str) -> String {
    text.chars().take(MAX_PROBLEM).collect()
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Numbers of the members that are left.
    fn left(hub: &Hub) -> Vec<u64> {
        let mut left: Vec<_> = lock(&hub.clients).there.iter().map(|member| member.number).collect();
        left.sort_unstable();
        left
    }

    #[test]
    fn those_who_watch_push_out_nobody_who_steers() {
        let hub = Arc::new(Hub::new(
            "private".to_owned(),
            Wheel::new(None).0,
            Shown { pixels: Pixels::new(None), history: None, chart: None, is_beside_run: false },
        ));
        let steering = hub.enter(true);
        let watching: Vec<_> = (0..2 * MAX_CLIENTS).map(|_| hub.enter(false)).collect();
        assert_eq!(left(&hub).len(), MAX_CLIENTS);
        assert!(left(&hub).contains(&steering.number) && !left(&hub).contains(&watching[0].number));
        // Of those who watch, the one that has just drawn stays.
        let oldest = &watching[MAX_CLIENTS + 1];
        assert!(left(&hub).contains(&oldest.number));
        oldest.is_active();
        let _next = hub.enter(true);
        assert!(left(&hub).contains(&oldest.number));
        let more: Vec<_> = (0..MAX_CLIENTS - 2).map(|_| hub.enter(true)).collect();
        assert!(left(&hub)[..1] == [steering.number] && left(&hub).len() == MAX_CLIENTS);
        // All steer: who comes to watch finds no place, who comes to steer takes that of the idlest.
        let late = hub.enter(false);
        assert!(!left(&hub).contains(&late.number) && left(&hub).contains(&steering.number));
        more.iter().for_each(Place::is_active);
        let latest = hub.enter(true);
        assert!(left(&hub).contains(&latest.number) && !left(&hub).contains(&steering.number));
        drop((steering, watching, more, late));
        assert_eq!(left(&hub).len(), 2);
    }

    #[test]
    fn a_run_that_leaves_no_mark_for_a_minute_may_hang_and_words_of_another_process_go_stale() {
        let (mut health, begin) = (Health::default(), Instant::now());
        let after = |seconds| begin + Duration::from_secs(seconds);
        assert!(health.has_new_marks(7, begin) && health.has_new_marks(7, after(59)));
        assert!(!health.has_new_marks(7, after(60)));
        assert!(health.has_new_marks(8, after(61)) && health.has_new_marks(8, after(120)) && !health.has_new_marks(8, after(121)));
        assert_eq!(health.told_work(begin), (None, 0));
        health.told = Some((WorkMark { protocol: PROTOCOL, work: Some("tracing".to_owned()), marks: 9 }, begin));
        assert_eq!(health.told_work(after(3)), (Some("tracing".to_owned()), 9));
        assert_eq!(health.told_work(after(4)), (None, 0));
    }

    #[test]
    fn a_publisher_is_silent_after_five_of_its_intervals() {
        let seconds = Duration::from_secs_f64;
        let mut health = Health::default();
        health.connected();
        assert_eq!(health.status(None), Status::Waiting);
        let begin = Instant::now();
        health.note_record(begin, Some(2.0));
        assert_eq!(health.status(Some(seconds(9.9))), Status::Following, "a frame takes two seconds");
        assert_eq!(health.status(Some(seconds(10.1))), Status::Silent);
        // Fast frames, one pause: the median is not moved by it.
        for number in 1..20 {
            let pause = if number > 15 { 60.0 } else { 0.0 };
            health.note_record(begin + seconds(0.1 * f64::from(number) + pause), None);
        }
        assert_eq!(health.status(Some(seconds(2.9))), Status::Following);
        assert_eq!(health.status(Some(seconds(3.1))), Status::Silent);
        health.is_connected = false;
        health.intervals = [seconds(60.0); INTERVALS].into();
        assert_eq!(health.status(Some(seconds(2.9))), Status::Following);
        assert_eq!(health.status(Some(seconds(3.1))), Status::Silent, "its connection has ended");
        for odd in [f64::NAN, -1.0, 1e19, f64::MAX] {
            let mut health = Health::default();
            health.connected();
            health.note_record(begin, Some(odd));
            health.status(Some(seconds(1.0)));
        }
    }
}
