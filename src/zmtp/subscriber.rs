//! The other end: a connection that subscribes or asks, and reads messages of bounded length.
//!
//! Not the crate `zeromq` (0.7), which reserves as much memory as the header of a frame announces, whatever that is.

use crate::bind::Place;
use crate::client::{greeting, ready};
use crate::message::{command, header};
use crate::parse::{COMMAND, GREETING, LONG, MORE};
use crate::router::message_bytes;
use bytes::{Buf, Bytes, BytesMut};
use std::io::{self, ErrorKind};
use std::time::Duration;
use thiserror::Error;
use tokio::io::{AsyncRead, AsyncReadExt, AsyncWrite, AsyncWriteExt};
use tokio::net::{TcpStream, UnixStream};
use tokio::time::timeout;

/// Time in which a publisher must be reached, greet and say READY.
const HANDSHAKE: Duration = Duration::from_secs(5);
/// Silence after which a publisher is sent a PING. After as much again it counts as lost.
const SILENCE: Duration = Duration::from_secs(10);
/// Maximum number of parts of a message.
const MAX_PARTS: usize = 8;
/// Memory that is reserved at a time, so that it follows what arrives and not what is announced.
const RESERVE: usize = 1 << 20;

/// Why there is no subscription, or none any more.
#[derive(Debug, Error)]
pub enum SubscribeError {
    /// Not an endpoint.
    #[error("{0}; accepted: tcp://HOST:PORT, ipc://PATH")]
    Endpoint(String),
    /// The peer is no publisher.
    #[error("the other end does not speak ZMTP 3 with the mechanism NULL: {0}")]
    Peer(&'static str),
    /// A message that is too long.
    #[error("a message of more than {most} bytes or {MAX_PARTS} parts")]
    Length {
        /// Accepted length in bytes.
        most: usize,
    },
    /// An error of the system, or a connection that ended.
    #[error(transparent)]
    System(#[from] io::Error),
}

/// Bytes to and from a publisher.
pub trait Stream: AsyncRead + AsyncWrite + Send + Unpin {}
impl<T: AsyncRead + AsyncWrite + Send + Unpin> Stream for T {}

/// A connection to a publisher. It is not restored when it ends.
pub struct Subscriber {
    stream: Box<dyn Stream>,
    buffer: BytesMut,
    /// Parts of a message that is not complete yet.
    parts: Vec<Bytes>,
    most: usize,
}

impl Subscriber {
    /// Connects to `tcp://HOST:PORT` or `ipc://PATH` and subscribes to topics. Messages have at most `most` bytes.
    ///
    /// # Errors
    /// An endpoint that is not accepted, a peer that is no publisher or does not answer in 5 seconds, an error of the system.
    pub async fn connect(endpoint: &str, topics: &[&str], most: usize) -> Result<Self, SubscribeError> {
        let connected = timeout(HANDSHAKE, async { Self::over(reach(endpoint).await?, topics, most).await });
        connected.await.unwrap_or_else(|_| Err(io::Error::from(ErrorKind::TimedOut).into()))
    }

    /// Greets and subscribes over a connection that exists, without a limit of time.
    ///
    /// # Errors
    /// A peer that is no publisher, or an error of the system.
    pub async fn over(stream: Box<dyn Stream>, topics: &[&str], most: usize) -> Result<Self, SubscribeError> {
        let mut subscriber = Self { stream, buffer: BytesMut::new(), parts: Vec::new(), most };
        subscriber.shake_hands(b"SUB").await?;
        let mut subscriptions = Vec::new();
        for topic in topics {
            header(&mut subscriptions, 0, 1 + topic.len());
            subscriptions.push(1);
            subscriptions.extend(topic.as_bytes());
        }
        subscriber.stream.write_all(&subscriptions).await?;
        Ok(subscriber)
    }

    async fn shake_hands(&mut self, socket_type: &[u8]) -> Result<(), SubscribeError> {
        self.stream.write_all(&greeting()).await?;
        let mut theirs = [0; GREETING];
        self.stream.read_exact(&mut theirs).await?;
        if (theirs[0], theirs[9]) != (0xff, 0x7f) || theirs[10] < 3 || !theirs[12..].starts_with(b"NULL\0") {
            return Err(SubscribeError::Peer("another greeting"));
        }
        self.stream.write_all(&ready(socket_type)).await?;
        match self.frame().await? {
            (flags, body) if flags & COMMAND != 0 && body.starts_with(b"\x05READY") => Ok(()),
            _ => Err(SubscribeError::Peer("no READY")),
        }
    }

    /// The parts of the next message. May be cancelled: what was read of a message is kept.
    ///
    /// # Errors
    /// The connection has ended, or is to be given up: a message that is too long, or a peer that is silent and does not answer PING.
    pub async fn receive(&mut self) -> Result<Vec<Bytes>, SubscribeError> {
        loop {
            let (flags, body) = self.frame().await?;
            // PONG, and what later versions may add.
            if flags & COMMAND != 0 {
                continue;
            }
            let bytes: usize = self.parts.iter().map(Bytes::len).sum();
            if bytes + body.len() > self.most || self.parts.len() == MAX_PARTS {
                return Err(SubscribeError::Length { most: self.most });
            }
            self.parts.push(body);
            if flags & MORE == 0 {
                return Ok(std::mem::take(&mut self.parts));
            }
        }
    }

    /// Flags and body of the next frame.
    async fn frame(&mut self) -> Result<(u8, Bytes), SubscribeError> {
        let mut has_pinged = false;
        loop {
            let missing = match announced(&self.buffer) {
                Some((_, length)) if length > self.most as u64 => return Err(SubscribeError::Length { most: self.most }),
                Some((head, length)) => match (head + length as usize).checked_sub(self.buffer.len()) {
                    None | Some(0) => {
                        let flags = self.buffer[0];
                        self.buffer.advance(head);
                        return Ok((flags, self.buffer.split_to(length as usize).freeze()));
                    }
                    Some(missing) => missing,
                },
                None => 1,
            };
            self.buffer.reserve(missing.min(RESERVE));
            match timeout(SILENCE, self.stream.read_buf(&mut self.buffer)).await {
                Ok(Ok(0)) => return Err(io::Error::from(ErrorKind::UnexpectedEof).into()),
                Ok(read) => {
                    read?;
                    has_pinged = false;
                }
                Err(_) if has_pinged => return Err(io::Error::from(ErrorKind::TimedOut).into()),
                Err(_) => {
                    let mut ping = Vec::new();
                    command(&mut ping, b"PING", &[0, 0]);
                    self.stream.write_all(&ping).await?;
                    has_pinged = true;
                }
            }
        }
    }
}

async fn reach(endpoint: &str) -> Result<Box<dyn Stream>, SubscribeError> {
    Ok(match Place::of(endpoint).map_err(SubscribeError::Endpoint)? {
        Place::Unix(path) => Box::new(UnixStream::connect(path).await?),
        Place::Tcp(address, port) => Box::new(TcpStream::connect((address, port)).await?),
    })
}

/// A connection to a [`crate::RouterSocket`], of type DEALER. It is not restored when it ends.
pub struct Requester(Subscriber);

impl Requester {
    /// Connects to `tcp://HOST:PORT` or `ipc://PATH`. Answers have at most `most` bytes.
    ///
    /// # Errors
    /// As for [`Subscriber::connect`].
    pub async fn connect(endpoint: &str, most: usize) -> Result<Self, SubscribeError> {
        let connected = timeout(HANDSHAKE, async {
            let mut connection = Subscriber { stream: reach(endpoint).await?, buffer: BytesMut::new(), parts: Vec::new(), most };
            connection.shake_hands(b"DEALER").await?;
            Ok(Self(connection))
        });
        connected.await.unwrap_or_else(|_| Err(io::Error::from(ErrorKind::TimedOut).into()))
    }

    /// Sends a message and returns the parts of its answer.
    ///
    /// # Errors
    /// There is no answer within `limit`, or the connection has ended. It is not to be used any more then.
    pub async fn ask(&mut self, parts: &[&[u8]], limit: Duration) -> Result<Vec<Bytes>, SubscribeError> {
        let mut bytes = Vec::new();
        message_bytes(&mut bytes, parts);
        let answered = timeout(limit, async {
            self.0.stream.write_all(&bytes).await?;
            self.0.receive().await
        });
        answered.await.unwrap_or_else(|_| Err(io::Error::from(ErrorKind::TimedOut).into()))
    }
}

/// Length of a frame's header, and of its body. `None` if the header is incomplete.
fn announced(bytes: &[u8]) -> Option<(usize, u64)> {
    if bytes.first()? & LONG == 0 {
        return Some((2, u64::from(*bytes.get(1)?)));
    }
    let length = bytes.get(1..9)?.first_chunk().copied().map(u64::from_be_bytes)?;
    Some((9, length))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Keep, Limits, PubSocket};
    use tokio::net::TcpListener;

    const MOST: usize = 1 << 20;

    #[tokio::test(flavor = "multi_thread")]
    async fn messages_arrive_whole_over_both_transports() {
        let folder = tempfile::tempdir().unwrap();
        for endpoint in ["tcp://127.0.0.1:0".to_owned(), format!("ipc://{}", folder.path().join("frames").display())] {
            let publisher = PubSocket::bind(&endpoint, None, Limits::default()).unwrap();
            let mut subscriber = Subscriber::connect(publisher.endpoint(), &["frame"], MOST).await.unwrap();
            while !publisher.is_wanted(b"frame") {
                tokio::time::sleep(Duration::from_millis(5)).await;
            }
            for length in [0, 1, 255, 256, 300_000] {
                publisher.send(&[b"other"], vec![1; 10], Keep::All);
                publisher.send(&[b"frame", b"header"], vec![7; length], Keep::All);
                let parts = timeout(HANDSHAKE, subscriber.receive()).await.unwrap().unwrap();
                assert_eq!(parts, [&b"frame"[..], b"header", &vec![7; length]]);
            }
            publisher.send(&[b"frame"], vec![7; MOST], Keep::All);
            let error = timeout(HANDSHAKE, subscriber.receive()).await.unwrap().unwrap_err();
            assert!(matches!(error, SubscribeError::Length { most: MOST }), "{error}");
        }
    }

    /// What a subscriber answers to these bytes of a publisher, after which the connection ends.
    async fn answer_to(bytes: Vec<u8>) -> String {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let endpoint = format!("tcp://{}", listener.local_addr().unwrap());
        tokio::spawn(async move {
            let (mut stream, _) = listener.accept().await.unwrap();
            stream.write_all(&bytes).await.unwrap();
            let _ = stream.read_to_end(&mut Vec::new()).await;
        });
        match Subscriber::connect(&endpoint, &["frame"], MOST).await {
            Ok(mut subscriber) => timeout(HANDSHAKE, subscriber.receive()).await.unwrap().unwrap_err().to_string(),
            Err(error) => error.to_string(),
        }
    }

    #[tokio::test(flavor = "multi_thread")]
    async fn a_frame_of_any_announced_length_costs_nothing() {
        let mut hello = greeting().to_vec();
        command(&mut hello, b"READY", b"\x0bSocket-Type\0\0\0\x03PUB");
        for length in [MOST as u64 + 1, 1 << 40, u64::MAX] {
            let frame = [&hello[..], &[LONG], &length.to_be_bytes()].concat();
            assert!(answer_to(frame).await.contains("more than 1048576 bytes"));
        }
        let endless = [&hello[..], &[MORE, 0].repeat(MAX_PARTS + 1)].concat();
        assert!(answer_to(endless).await.contains("8 parts"));
        assert!(answer_to(b"HTTP/1.1 400 Bad Request\r\n\r\n".repeat(4)).await.contains("another greeting"));
        assert!(answer_to([&greeting()[..], &[0, 1, 7]].concat()).await.contains("no READY"));
    }

    #[tokio::test]
    async fn other_endpoints_are_refused() {
        for endpoint in ["udp://127.0.0.1:1", "tcp://127.0.0.1", "tcp://127.0.0.1:x", "ipc://frames", "private"] {
            let refused = Subscriber::connect(endpoint, &[], MOST).await.err().unwrap();
            assert!(matches!(refused, SubscribeError::Endpoint(_)), "{endpoint}: {refused}");
        }
    }
}
