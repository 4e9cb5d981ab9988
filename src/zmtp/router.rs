//! A ROUTER socket: each message of a peer is answered before its next one is read, so that nothing queues.

use crate::bind::{BindError, Peers};
use crate::client::{End, Limits, Reader};
use crate::lock;
use crate::message::{command, header};
use crate::owner::{Owner, displaced};
use crate::parse::{Fault, Incoming, MORE, Role};
use crate::socket::{Opened, SHUTDOWN_LIMIT, Stream};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::thread::JoinHandle;
use std::time::Instant;
use tokio::io::{AsyncRead, AsyncWrite, AsyncWriteExt};
use tokio::sync::{Notify, oneshot};
use tokio::time::timeout;

/// Maximum number of parts of a message, with the empty one of a REQ socket.
const MAX_PARTS: usize = 3;

/// The other end of one connection, as the program sees it.
pub trait Answer: Send {
    /// Answers a message; returns the parts of the answer, and whether the peer has proved who it is. Called on the socket's only thread, which
    /// it must not hold up.
    fn answer(&mut self, parts: &[Vec<u8>]) -> (Vec<Vec<u8>>, bool);
}

/// Makes an [`Answer`] for each connection.
pub type Answers = dyn Fn() -> Box<dyn Answer> + Send + Sync;

/// A ROUTER socket for peers of type DEALER and REQ. Dropping it closes all connections.
#[derive(Debug)]
pub struct RouterSocket {
    endpoint: String,
    /// Dropped to end the thread.
    stop: Option<oneshot::Sender<()>>,
    thread: Option<JoinHandle<()>>,
}

/// A connection. Those that prove nothing give way first.
struct Member {
    owner: Owner,
    is_known: AtomicBool,
    last_message: Mutex<Instant>,
    close: Notify,
}

struct Shared {
    limits: Limits,
    members: Mutex<Vec<Arc<Member>>>,
    answers: Box<Answers>,
}

impl RouterSocket {
    /// Binds an endpoint as [`crate::PubSocket::bind`] does. Of the limits, `connections`, `handshake`, `stall` and `frames` apply.
    ///
    /// # Errors
    /// An endpoint that is not accepted or in use, or an error of the system.
    pub fn bind(endpoint: &str, peers: Option<Peers>, limits: Limits, answers: Box<Answers>) -> Result<Self, BindError> {
        let Opened { listener, endpoint, peers, runtime } = Opened::new(endpoint, peers)?;
        let shared = Arc::new(Shared { limits, members: Mutex::default(), answers });
        let (stop, stopped) = oneshot::channel();
        let thread = std::thread::Builder::new().name("ridgewatch-router".to_owned()).spawn(move || {
            runtime.block_on(async {
                let accepts = async {
                    loop {
                        for (stream, owner) in listener.batch().await {
                            if peers.accept(owner) {
                                shared.admit(stream, owner);
                            }
                        }
                    }
                };
                tokio::select! {
                    () = accepts => {}
                    // Its sender is dropped.
                    _ = stopped => {}
                }
            });
            runtime.shutdown_timeout(SHUTDOWN_LIMIT);
        })?;
        Ok(Self { endpoint, stop: Some(stop), thread: Some(thread) })
    }

    /// The endpoint, with the port that was bound.
    pub fn endpoint(&self) -> &str {
        &self.endpoint
    }
}

impl Drop for RouterSocket {
    fn drop(&mut self) {
        self.stop.take();
        // A panic has been printed.
        let _ = self.thread.take().map(JoinHandle::join);
    }
}

impl Shared {
    /// Starts to serve a connection.
    fn admit(self: &Arc<Self>, stream: Stream, owner: Owner) {
        let now = Instant::now();
        let member = Arc::new(Member { owner, is_known: AtomicBool::new(false), last_message: Mutex::new(now), close: Notify::new() });
        let mut members = lock(&self.members);
        if members.len() >= self.limits.connections {
            let present: Vec<_> =
                members.iter().map(|one| (one.owner, one.is_known.load(Ordering::Relaxed), *lock(&one.last_message))).collect();
            if let Some(index) = first_to_go(&present) {
                members.remove(index).close.notify_one();
            }
        }
        members.push(Arc::clone(&member));
        drop(members);
        let shared = Arc::clone(self);
        tokio::spawn(async move {
            let leaving = Leaving { shared: &shared, member: &member };
            let served = async {
                match stream {
                    Stream::Tcp(mut stream) => {
                        let (from, to) = stream.split();
                        shared.serve(&member, from, to).await
                    }
                    Stream::Unix(mut stream) => {
                        let (from, to) = stream.split();
                        shared.serve(&member, from, to).await
                    }
                }
            };
            // Whatever ended it, the connection is closed, and others go on.
            tokio::select! {
                _ = served => {}
                () = member.close.notified() => {}
            }
            drop(leaving);
        });
    }

    /// Answers a peer until either side ends the connection.
    async fn serve(&self, member: &Member, mut from: impl AsyncRead + Unpin, mut to: impl AsyncWrite + Unpin) -> Result<(), End> {
        let mut reader = Reader::new(Role::Router, &self.limits);
        if !reader.greet(&mut from, &mut to).await? {
            return Ok(());
        }
        let (mut answers, mut parts) = ((self.answers)(), Vec::new());
        while let Some(incoming) = reader.next(&mut from).await? {
            let mut bytes = Vec::new();
            match incoming {
                Incoming::Part { .. } if parts.len() == MAX_PARTS => return Err(Fault::Parts.into()),
                Incoming::Part { body, more } => {
                    parts.push(body);
                    if more {
                        continue;
                    }
                    let message = std::mem::take(&mut parts);
                    // The first part that a REQ socket adds, and expects before the answer.
                    let delimiters = usize::from(message.len() > 1 && message[0].is_empty());
                    let (answer, is_known) = answers.answer(&message[delimiters..]);
                    member.is_known.fetch_or(is_known, Ordering::Relaxed);
                    *lock(&member.last_message) = Instant::now();
                    let all: Vec<&[u8]> = std::iter::repeat_n(&[][..], delimiters).chain(answer.iter().map(Vec::as_slice)).collect();
                    message_bytes(&mut bytes, &all);
                }
                Incoming::Ping(context) => command(&mut bytes, b"PONG", &context),
                _ => continue,
            }
            timeout(self.limits.stall, to.write_all(&bytes)).await.map_err(|_| End::Stall)??;
        }
        Ok(())
    }
}

/// Index of the connection to close: one that has proved nothing if there is one, whoever has most of the others.
fn first_to_go(present: &[(Owner, bool, Instant)]) -> Option<usize> {
    let unknown: Vec<usize> = (0..present.len()).filter(|&index| !present[index].1).collect();
    let of_unknown: Vec<_> = unknown.iter().map(|&index| present[index]).collect();
    displaced(&of_unknown).map(|at| unknown[at]).or_else(|| displaced(present))
}

/// Adds a message of these parts.
pub(crate) fn message_bytes(to: &mut Vec<u8>, parts: &[&[u8]]) {
    for (index, part) in parts.iter().enumerate() {
        header(to, if index + 1 < parts.len() { MORE } else { 0 }, part.len());
        to.extend(*part);
    }
}

/// Removes a connection when its task ends, however it ends.
struct Leaving<'a> {
    shared: &'a Shared,
    member: &'a Arc<Member>,
}

impl Drop for Leaving<'_> {
    fn drop(&mut self) {
        lock(&self.shared.members).retain(|one| !Arc::ptr_eq(one, self.member));
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Requester;
    use std::io::{Read, Write};
    use std::os::unix::net::UnixStream;
    use std::time::Duration;

    const LIMIT: Duration = Duration::from_secs(30);

    /// Repeats what it is told; `known` proves who it is.
    struct Echo;

    impl Answer for Echo {
        fn answer(&mut self, parts: &[Vec<u8>]) -> (Vec<Vec<u8>>, bool) {
            (parts.to_vec(), parts == [b"known"])
        }
    }

    fn echo(endpoint: &str, limits: Limits) -> RouterSocket {
        RouterSocket::bind(endpoint, None, limits, Box::new(|| Box::new(Echo))).unwrap()
    }

    #[tokio::test(flavor = "multi_thread")]
    async fn messages_are_answered_over_both_transports() {
        let folder = tempfile::tempdir().unwrap();
        for endpoint in ["tcp://127.0.0.1:0".to_owned(), format!("ipc://{}", folder.path().join("commands").display())] {
            let router = echo(&endpoint, Limits::default());
            let mut requester = Requester::connect(router.endpoint(), 1 << 16).await.unwrap();
            for parts in [&[&b"a"[..]][..], &[b"a", &[7; 4000]], &[b"", b"a", b"b"], &[b""]] {
                assert_eq!(requester.ask(parts, LIMIT).await.unwrap(), parts);
            }
            drop(router);
            assert!(requester.ask(&[b"a"], LIMIT).await.is_err());
        }
    }

    #[tokio::test(flavor = "multi_thread")]
    async fn what_is_too_much_ends_the_connection_and_no_other() {
        let folder = tempfile::tempdir().unwrap();
        let router = echo(&format!("ipc://{}", folder.path().join("commands").display()), Limits { frames: 100, ..Limits::default() });
        let connect = || Requester::connect(router.endpoint(), 1 << 16);
        let mut healthy = connect().await.unwrap();
        healthy.ask(&[b"a"], LIMIT).await.unwrap();
        assert!(connect().await.unwrap().ask(&[&[0; 5000]], LIMIT).await.is_err(), "too long");
        assert!(connect().await.unwrap().ask(&[b"", b"", b"", b""], LIMIT).await.is_err(), "too many parts");
        let mut flood = connect().await.unwrap();
        let mut answered = 0;
        while flood.ask(&[b"a"], LIMIT).await.is_ok() {
            answered += 1;
        }
        // Greeting and READY count too.
        assert!((90..=100).contains(&answered), "{answered}");
        healthy.ask(&[b"a"], LIMIT).await.unwrap();
    }

    #[tokio::test(flavor = "multi_thread")]
    async fn who_proves_nothing_gives_way() {
        let folder = tempfile::tempdir().unwrap();
        let router = echo(&format!("ipc://{}", folder.path().join("commands").display()), Limits { connections: 4, ..Limits::default() });
        let mut known = Requester::connect(router.endpoint(), 1 << 16).await.unwrap();
        known.ask(&[b"known"], LIMIT).await.unwrap();
        for _ in 0..20 {
            let mut stranger = Requester::connect(router.endpoint(), 1 << 16).await.unwrap();
            stranger.ask(&[b"a"], LIMIT).await.unwrap();
            std::mem::forget(stranger);
        }
        known.ask(&[b"known"], LIMIT).await.unwrap();
    }

    #[test]
    fn many_proven_connections_of_one_owner_do_not_give_way_to_strangers() {
        let begin = Instant::now();
        // Positive: has proved who it is. The first is idle for longest.
        let connection = |(at, n): (usize, &i32)| (Owner::User(n.unsigned_abs()), *n > 0, begin + Duration::from_secs(at as u64));
        for (there, gone) in [
            (&[1, 1, -2, -3][..], 2),
            (&[1, 1, 1, -1], 3),
            // Of those that have proved nothing, the owner with the most of them loses one.
            (&[1, 1, 1, -2, -3, -4, -3], 4),
            (&[-2, 1, -1, 3, -1], 2),
            // All have proved it.
            (&[1, 2, 2, 3], 1),
        ] {
            let present: Vec<_> = there.iter().enumerate().map(connection).collect();
            assert_eq!(first_to_go(&present), Some(gone), "{there:?}");
        }
        assert_eq!(first_to_go(&[]), None);
    }

    #[test]
    fn a_peer_that_does_not_greet_is_not_waited_for() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("commands");
        let _router = echo(&format!("ipc://{}", path.display()), Limits { handshake: Duration::from_millis(200), ..Limits::default() });
        let mut silent = UnixStream::connect(&path).unwrap();
        silent.set_read_timeout(Some(LIMIT)).unwrap();
        silent.write_all(&[0xff]).unwrap();
        let mut heard = Vec::new();
        silent.read_to_end(&mut heard).unwrap();
        assert_eq!(heard.len(), 64, "its greeting, and the end");
    }
}
