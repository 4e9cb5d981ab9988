//! One subscriber: its subscriptions, what waits for it, and its connection.

use crate::lock;
use crate::message::{Keep, Message, command};
use crate::owner::Owner;
use crate::parse::{Fault, GREETING, Incoming, Parser, Role};
use std::collections::{BTreeSet, VecDeque};
use std::io;
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};
use thiserror::Error;
use tokio::io::{AsyncRead, AsyncReadExt, AsyncWrite, AsyncWriteExt};
use tokio::sync::Notify;
use tokio::time::timeout;

/// Bounds on what subscribers may cost.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Limits {
    /// Maximum number of connections.
    pub connections: usize,
    /// Time in which a peer must greet and say READY.
    pub handshake: Duration,
    /// Time in which a subscriber must take a message, once its first byte is written.
    pub stall: Duration,
    /// The same for a message of [`Keep::Bulk`].
    pub bulk_stall: Duration,
    /// Maximum number of messages of [`Keep::Newest`], and of [`Keep::Bulk`], that are held at a time, see [`crate::PubSocket::has_room`].
    pub in_flight: usize,
    /// Maximum number of [`Keep::All`] messages that wait for one subscriber.
    pub queued: usize,
    /// Maximum number of different topics of one subscriber.
    pub topics: usize,
    /// Maximum length of these topics together, in bytes.
    pub topic_bytes: usize,
    /// Frames that a peer may send at once, and again in each minute.
    pub frames: u32,
}

impl Default for Limits {
    fn default() -> Self {
        Self {
            connections: 256,
            handshake: Duration::from_secs(5),
            stall: Duration::from_secs(2),
            bulk_stall: Duration::from_secs(10),
            in_flight: 3,
            queued: 256,
            topics: 256,
            topic_bytes: 1 << 14,
            frames: 1000,
        }
    }
}

impl Limits {
    /// Time in which a subscriber must take a message.
    pub(crate) fn stall_of(&self, keep: Keep) -> Duration {
        if keep == Keep::Bulk { self.bulk_stall } else { self.stall }
    }
}

/// Why a connection ends.
#[derive(Debug, Error)]
pub(crate) enum End {
    #[error(transparent)]
    Fault(#[from] Fault),
    #[error(transparent)]
    System(#[from] io::Error),
    #[error("no greeting and READY in time")]
    Handshake,
    #[error("it does not read")]
    Stall,
}

/// A connection, as all who use it know it.
#[derive(Debug)]
pub(crate) struct Client {
    pub owner: Owner,
    outbox: Mutex<Outbox>,
    /// Something is to be written.
    wake: Notify,
    close: Notify,
}

#[derive(Debug)]
struct Outbox {
    topics: BTreeSet<Vec<u8>>,
    topic_bytes: usize,
    all: VecDeque<Arc<Message>>,
    /// The newest message of each topic, unless it was written.
    newest: Vec<Arc<Message>>,
    /// Context of the last PING, unless it was answered.
    ping: Option<Vec<u8>>,
    /// Kind and number of the message that is being written, and since when.
    writing: Option<(Keep, u64, Instant)>,
    /// It has subscribed since a message of [`Keep::Bulk`] was given to it.
    is_new: bool,
    /// Since when nothing was written to the end.
    idle_since: Instant,
    /// The connection ends when everything is written.
    last: bool,
}

/// Next bytes to write.
enum Due {
    Message(Arc<Message>),
    Pong(Vec<u8>),
    Nothing,
    End,
}

impl Client {
    pub fn new(owner: Owner) -> Self {
        let outbox = Outbox {
            topics: BTreeSet::new(),
            topic_bytes: 0,
            all: VecDeque::new(),
            newest: Vec::new(),
            ping: None,
            writing: None,
            is_new: false,
            idle_since: Instant::now(),
            last: false,
        };
        Self { owner, outbox: Mutex::new(outbox), wake: Notify::new(), close: Notify::new() }
    }

    pub fn has_subscribed(&self) -> bool {
        !lock(&self.outbox).topics.is_empty()
    }

    /// Since when no message was written to the end, or the connection exists.
    pub fn idle_since(&self) -> Instant {
        lock(&self.outbox).idle_since
    }

    /// Number of the message of this kind that is being written, and since when.
    pub fn writing(&self, kind: Keep) -> Option<(u64, Instant)> {
        lock(&self.outbox).writing.filter(|(keep, ..)| *keep == kind).map(|(_, number, since)| (number, since))
    }

    /// Ends the connection at once.
    pub fn close(&self) {
        self.close.notify_one();
    }

    /// Ends the connection when everything is written.
    pub fn finish(&self) {
        lock(&self.outbox).last = true;
        self.wake.notify_one();
    }

    /// Whether it subscribes to messages of this topic and kind.
    pub fn wants(&self, topic: &[u8], keep: Keep) -> bool {
        lock(&self.outbox).wants(topic, keep)
    }

    /// Whether it subscribes to a topic of [`Keep::Bulk`], and has subscribed since such a message was given to it.
    pub fn awaits(&self, topic: &[u8]) -> bool {
        let outbox = lock(&self.outbox);
        outbox.is_new && outbox.wants(topic, Keep::Bulk)
    }

    /// Gives a message to a subscriber of its topic. Returns whether the oldest message was dropped for it.
    pub fn give(&self, message: &Arc<Message>, queued: usize) -> bool {
        let mut outbox = lock(&self.outbox);
        if !outbox.wants(&message.topic, message.keep) {
            return false;
        }
        outbox.is_new &= message.keep != Keep::Bulk;
        let full = message.keep == Keep::All && outbox.all.len() >= queued;
        match message.keep {
            Keep::All => {
                if full {
                    outbox.all.pop_front();
                }
                outbox.all.push_back(Arc::clone(message));
            }
            Keep::Newest | Keep::Note | Keep::Bulk => {
                outbox.newest.retain(|older| older.topic != message.topic);
                outbox.newest.push(Arc::clone(message));
            }
        }
        drop(outbox);
        self.wake.notify_one();
        full
    }

    /// Serves the connection until either side ends it. `subscribed` is called when it has a first subscription.
    pub async fn serve(
        &self,
        mut from: impl AsyncRead + Unpin,
        mut to: impl AsyncWrite + Unpin,
        limits: &Limits,
        subscribed: impl Fn(),
    ) -> Result<(), End> {
        let mut reader = Reader::new(Role::Pub, limits);
        let served = async {
            if !reader.greet(&mut from, &mut to).await? {
                return Ok(());
            }
            tokio::select! {
                end = self.read(&mut reader, &mut from, &subscribed) => end,
                end = self.write(&mut to, limits) => end,
            }
        };
        tokio::select! {
            end = served => end,
            () = self.close.notified() => Ok(()),
        }
    }

    async fn read(&self, reader: &mut Reader<'_>, from: &mut (impl AsyncRead + Unpin), subscribed: &impl Fn()) -> Result<(), End> {
        while let Some(incoming) = reader.next(from).await? {
            let mut outbox = lock(&self.outbox);
            match incoming {
                Incoming::Subscribe(topic) => {
                    let first = outbox.topics.is_empty();
                    outbox.subscribe(topic, reader.limits)?;
                    drop(outbox);
                    if first {
                        subscribed();
                    }
                }
                Incoming::Cancel(topic) => {
                    outbox.topic_bytes -= if outbox.topics.remove(&topic) { topic.len() } else { 0 };
                }
                Incoming::Ping(context) => {
                    outbox.ping = Some(context);
                    self.wake.notify_one();
                }
                Incoming::Greeting | Incoming::Ready | Incoming::Part { .. } | Incoming::Other => {}
            }
        }
        Ok(())
    }

    async fn write(&self, to: &mut (impl AsyncWrite + Unpin), limits: &Limits) -> Result<(), End> {
        loop {
            let due = lock(&self.outbox).take();
            let stall = if let Due::Message(message) = &due { limits.stall_of(message.keep) } else { limits.stall };
            let written = async {
                match &due {
                    Due::Message(message) => {
                        to.write_all(&message.head).await?;
                        to.write_all(&message.last).await
                    }
                    Due::Pong(context) => {
                        let mut pong = Vec::new();
                        command(&mut pong, b"PONG", context);
                        to.write_all(&pong).await
                    }
                    Due::Nothing => Ok(()),
                    Due::End => to.shutdown().await,
                }
            };
            timeout(stall, written).await.map_err(|_| End::Stall)??;
            match due {
                Due::End => return Ok(()),
                Due::Nothing => self.wake.notified().await,
                Due::Message(_) | Due::Pong(_) => {
                    let mut outbox = lock(&self.outbox);
                    (outbox.writing, outbox.idle_since) = (None, Instant::now());
                }
            }
        }
    }
}

impl Outbox {
    fn wants(&self, topic: &[u8], keep: Keep) -> bool {
        match keep {
            // Those who subscribe to all topics do not know that they ask for it.
            Keep::Bulk => self.topics.contains(topic),
            Keep::Newest | Keep::Note | Keep::All => self.topics.iter().any(|prefix| topic.starts_with(prefix)),
        }
    }

    /// Adds a topic. The same one again changes nothing, as in libzmq.
    fn subscribe(&mut self, topic: Vec<u8>, limits: &Limits) -> Result<(), Fault> {
        let bytes = self.topic_bytes + topic.len();
        if self.topics.insert(topic) {
            (self.topic_bytes, self.is_new) = (bytes, true);
        }
        if self.topics.len() > limits.topics || self.topic_bytes > limits.topic_bytes { Err(Fault::Subscriptions) } else { Ok(()) }
    }

    fn take(&mut self) -> Due {
        if let Some(context) = self.ping.take() {
            Due::Pong(context)
        } else if let Some(message) = self.all.pop_front() {
            Due::Message(message)
        } else if !self.newest.is_empty() {
            let message = self.newest.remove(0);
            self.writing = Some((message.keep, message.number, Instant::now()));
            Due::Message(message)
        } else if self.last {
            Due::End
        } else {
            Due::Nothing
        }
    }
}

pub(crate) fn greeting() -> [u8; GREETING] {
    let mut greeting = [0; GREETING];
    // The byte before 0x7f tells ZMTP 1 peers the length of an identity.
    [greeting[0], greeting[8], greeting[9], greeting[10], greeting[11]] = [0xff, 1, 0x7f, 3, 1];
    greeting[12..16].copy_from_slice(b"NULL");
    greeting
}

/// READY of a socket of this type.
pub(crate) fn ready(socket_type: &[u8]) -> Vec<u8> {
    let mut ready = Vec::new();
    command(&mut ready, b"READY", &[b"\x0bSocket-Type\0\0\0", &[socket_type.len() as u8][..], socket_type].concat());
    ready
}

/// Reads from a peer, at a bounded number of frames a minute.
pub(crate) struct Reader<'a> {
    role: Role,
    parser: Parser,
    /// Frames that the peer may send now.
    left: f64,
    since: Instant,
    limits: &'a Limits,
}

impl<'a> Reader<'a> {
    pub fn new(role: Role, limits: &'a Limits) -> Self {
        Self { role, parser: Parser::of(role), left: f64::from(limits.frames), since: Instant::now(), limits }
    }

    /// Exchanges greeting and READY, in bounded time. Returns whether the peer is still there.
    pub async fn greet(&mut self, from: &mut (impl AsyncRead + Unpin), to: &mut (impl AsyncWrite + Unpin)) -> Result<bool, End> {
        let limit = self.limits.handshake;
        let greeted = async {
            to.write_all(&greeting()).await?;
            self.next(from).await?;
            // Only now: some peers close the connection if more than a greeting comes before theirs is out.
            to.write_all(&ready(if self.role == Role::Pub { b"PUB" } else { b"ROUTER" })).await?;
            self.next(from).await
        };
        Ok(timeout(limit, greeted).await.map_err(|_| End::Handshake)??.is_some())
    }

    /// The next unit. `None` at the end of the stream.
    pub async fn next(&mut self, from: &mut (impl AsyncRead + Unpin)) -> Result<Option<Incoming>, End> {
        loop {
            if let Some(incoming) = self.parser.parse()? {
                let most = f64::from(self.limits.frames);
                let earned = self.since.elapsed().as_secs_f64() * most / 60.0;
                (self.left, self.since) = ((self.left + earned).min(most) - 1.0, Instant::now());
                return if self.left < 0.0 { Err(Fault::Rate.into()) } else { Ok(Some(incoming)) };
            }
            let count = from.read(self.parser.space()).await?;
            if count == 0 {
                return Ok(None);
            }
            self.parser.filled(count);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::message::Ledger;

    fn subscriber(topics: &[&str]) -> Client {
        let client = Client::new(Owner::User(1));
        for topic in topics {
            lock(&client.outbox).subscribe(topic.as_bytes().to_vec(), &Limits::default()).unwrap();
        }
        client
    }

    #[test]
    fn the_newest_message_of_a_topic_replaces_the_one_that_waits_and_others_wait() {
        let (client, ledger) = (subscriber(&["a", "b"]), Arc::new(Ledger::default()));
        let give = |topic: &[u8], keep, last: u8| client.give(&ledger.message(&[topic], vec![last], keep), 2);
        let dropped: Vec<bool> = [1, 2, 3].into_iter().map(|last| give(b"b", Keep::All, last)).collect();
        assert_eq!(dropped, [false, false, true]);
        for last in [4, 5] {
            give(b"a1", Keep::Newest, last);
            give(b"a2", Keep::Newest, last);
            give(b"c", Keep::Newest, last);
        }
        let mut outbox = lock(&client.outbox);
        let mut taken = Vec::new();
        while let Due::Message(message) = outbox.take() {
            taken.push(message.last[0]);
        }
        assert_eq!(taken, [2, 3, 5, 5]);
        drop(outbox);
        assert!(ledger.wait_below(Keep::Newest, 1, Duration::ZERO));
        // Two of topic b that were held longest, then all that wait, a kilobyte at most.
        assert!((1..1000).contains(&ledger.peak_bytes()));
    }

    #[test]
    fn the_newest_note_of_a_topic_replaces_the_one_that_waits_and_is_not_in_flight() {
        let (client, ledger) = (subscriber(&["a", "b"]), Arc::new(Ledger::default()));
        client.give(&ledger.message(&[b"a"], vec![0], Keep::Newest), 2);
        for last in [1, 2] {
            client.give(&ledger.message(&[b"b"], vec![last], Keep::Note), 2);
        }
        assert!(ledger.wait_below(Keep::Newest, 2, Duration::ZERO), "one message is in flight");
        let mut outbox = lock(&client.outbox);
        let Due::Message(picture) = outbox.take() else { panic!("no message") };
        assert!(picture.last == [0] && outbox.writing.is_some_and(|(keep, ..)| keep == Keep::Newest));
        let Due::Message(note) = outbox.take() else { panic!("no note") };
        assert!(
            note.last == [2] && outbox.writing.is_some_and(|(keep, ..)| keep == Keep::Note),
            "whoever takes a note slowly holds no place of a picture"
        );
        assert!(matches!(outbox.take(), Due::Nothing));
    }

    #[test]
    fn bulk_goes_to_those_who_name_its_topic_and_is_counted_for_itself() {
        let ledger = Arc::new(Ledger::default());
        let all = subscriber(&["", "lay"]);
        let named = subscriber(&["layers"]);
        assert!(!all.awaits(b"layers") && named.awaits(b"layers") && !named.awaits(b"other"));
        for last in [1, 2] {
            let message = ledger.message(&[b"layers"], vec![last], Keep::Bulk);
            assert!(!all.give(&message, 2) && !named.give(&message, 2));
        }
        assert!(ledger.wait_below(Keep::Newest, 1, Duration::ZERO) && !ledger.wait_below(Keep::Bulk, 1, Duration::ZERO));
        assert!(ledger.wait_below(Keep::Bulk, 2, Duration::ZERO), "the second has replaced the first");
        assert!(!named.awaits(b"layers"));
        lock(&named.outbox).subscribe(b"other".to_vec(), &Limits::default()).unwrap();
        assert!(named.awaits(b"layers"), "it has subscribed to something since");
        assert!(matches!(lock(&all.outbox).take(), Due::Nothing));
        let Due::Message(message) = lock(&named.outbox).take() else { panic!("no message") };
        assert!(message.last == [2] && named.writing(Keep::Newest).is_none() && named.writing(Keep::Bulk).is_some());
        drop(message);
        assert!(ledger.wait_below(Keep::Bulk, 1, Duration::ZERO));
    }

    #[test]
    fn topics_are_bounded_and_count_once() {
        let limits = Limits { topics: 3, topic_bytes: 10, ..Limits::default() };
        let mut outbox = subscriber(&[]).outbox.into_inner().unwrap();
        for topic in ["a", "b", "a", "a", "cdefgh"] {
            outbox.subscribe(topic.into(), &limits).unwrap();
        }
        assert_eq!(outbox.topic_bytes, 8);
        assert_eq!(outbox.subscribe("d".into(), &limits), Err(Fault::Subscriptions));
        let mut outbox = subscriber(&[]).outbox.into_inner().unwrap();
        assert_eq!(outbox.subscribe("12345678901".into(), &limits), Err(Fault::Subscriptions));
    }
}
