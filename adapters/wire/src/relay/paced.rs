//! Minimum pace of a connection, and the intervals of its heartbeats.

use crate::WireError;
use crate::bytes::PIECE;
use crate::message::Session;
use std::io::{ErrorKind, Read, Write};
use std::net::TcpStream;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

/// Longest time that a peer may take for a piece of a message: 1 MiB, or the rest of it.
pub const PEER_TIMEOUT: Duration = Duration::from_secs(5);
/// Interval of heartbeats on either side of a connection.
pub(super) const PULSE: Duration = Duration::from_secs(1);
/// Pause of an idle thread between two looks for work.
pub(super) const IDLE: Duration = Duration::from_millis(1);
/// Longest blocking call between two checks of the stop flag.
const TICK: Duration = Duration::from_millis(200);

/// A stream that fails if a [`PIECE`] of a message takes longer than [`PEER_TIMEOUT`], however few bytes the peer sends at a time, or if `stop` is set.
pub(super) struct Paced<'a> {
    pub stream: &'a TcpStream,
    stop: &'a AtomicBool,
    /// Deadline of the piece; `None` before its first byte.
    deadline: Option<Instant>,
    /// Transferred bytes of the piece.
    transferred: usize,
}

impl<'a> Paced<'a> {
    pub fn new(stream: &'a TcpStream, stop: &'a AtomicBool) -> Self {
        Self { stream, stop, deadline: None, transferred: 0 }
    }

    /// Begins a piece and its deadline.
    pub fn begin(&mut self) -> &mut Self {
        (self.deadline, self.transferred) = (Some(Instant::now() + PEER_TIMEOUT), 0);
        self
    }

    /// One attempt to transfer bytes, at most a [`TICK`] long. The callers repeat it after an interruption.
    fn attempt(&mut self, transfer: impl FnOnce(&TcpStream) -> std::io::Result<usize>) -> std::io::Result<usize> {
        if self.stop.load(Ordering::Relaxed) {
            return Err(std::io::Error::new(ErrorKind::ConnectionAborted, "stopped"));
        }
        let deadline = *self.deadline.get_or_insert_with(|| Instant::now() + PEER_TIMEOUT);
        match transfer(self.stream) {
            Err(e) if e.kind() == ErrorKind::WouldBlock => {
                let late = Instant::now() >= deadline;
                Err(if late { ErrorKind::TimedOut } else { ErrorKind::Interrupted }.into())
            }
            Ok(bytes) => {
                self.transferred += bytes;
                if self.transferred >= PIECE {
                    self.begin();
                } else if Instant::now() >= deadline {
                    return Err(ErrorKind::TimedOut.into());
                }
                Ok(bytes)
            }
            Err(e) => Err(e),
        }
    }
}

impl Read for Paced<'_> {
    fn read(&mut self, to: &mut [u8]) -> std::io::Result<usize> {
        self.attempt(|mut stream| stream.read(to))
    }
}

impl Write for Paced<'_> {
    fn write(&mut self, from: &[u8]) -> std::io::Result<usize> {
        self.attempt(|mut stream| stream.write(from))
    }

    fn flush(&mut self) -> std::io::Result<()> {
        Ok(())
    }
}

/// Exchanges both sides' greetings within [`PEER_TIMEOUT`].
pub(super) fn greet(
    stream: &TcpStream,
    stop: &AtomicBool,
    greeting: impl FnOnce(&mut Paced) -> Result<Session, WireError>,
) -> Result<Session, WireError> {
    let timeouts = || stream.set_read_timeout(Some(TICK)).and_then(|()| stream.set_write_timeout(Some(TICK)));
    stream.set_nonblocking(false).and_then(|()| stream.set_nodelay(true)).and_then(|()| timeouts()).map_err(WireError::connection)?;
    greeting(&mut Paced::new(stream, stop))
}
