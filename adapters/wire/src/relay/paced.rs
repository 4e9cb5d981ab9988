//! The pace that a connection must keep.

use crate::WireError;
use crate::bytes::PIECE;
use crate::message::Session;
use std::io::{ErrorKind, Read, Write};
use std::net::TcpStream;
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

/// Longest that a peer may take for a piece of a message: 1 MiB, or what is left of it.
pub const PATIENCE: Duration = Duration::from_secs(5);
/// The longest that a wait lasts before it is looked whether to stop.
const TICK: Duration = Duration::from_millis(200);

/// A stream of which each [`PIECE`] of a message must be through within [`PATIENCE`], however slowly the peer dribbles; a wait ends with `stop`.
pub(super) struct Paced<'a> {
    pub stream: &'a TcpStream,
    stop: &'a AtomicBool,
    /// Until when the piece must be through; none before its first byte was tried.
    until: Option<Instant>,
    /// Bytes of the piece that are through.
    through: usize,
}

impl<'a> Paced<'a> {
    pub fn new(stream: &'a TcpStream, stop: &'a AtomicBool) -> Self {
        Self { stream, stop, until: None, through: 0 }
    }

    /// Begins a piece.
    pub fn begin(&mut self) -> &mut Self {
        (self.until, self.through) = (Some(Instant::now() + PATIENCE), 0);
        self
    }

    /// One attempt to pass bytes on, at most a [`TICK`] long; the callers try again after an interruption.
    fn attempt(&mut self, pass: impl FnOnce(&TcpStream) -> std::io::Result<usize>) -> std::io::Result<usize> {
        if self.stop.load(Ordering::Relaxed) {
            return Err(std::io::Error::new(ErrorKind::ConnectionAborted, "told to stop"));
        }
        let until = *self.until.get_or_insert_with(|| Instant::now() + PATIENCE);
        match pass(self.stream) {
            Err(e) if e.kind() == ErrorKind::WouldBlock => {
                let late = Instant::now() >= until;
                Err(if late { ErrorKind::TimedOut } else { ErrorKind::Interrupted }.into())
            }
            Ok(bytes) => {
                self.through += bytes;
                if self.through >= PIECE {
                    self.begin();
                } else if Instant::now() >= until {
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

/// Both sides' greetings take [`PATIENCE`] in all; afterwards each piece of a message may.
pub(super) fn greet(
    stream: &TcpStream,
    stop: &AtomicBool,
    greeting: impl FnOnce(&mut Paced) -> Result<Session, WireError>,
) -> Result<Session, WireError> {
    let broken = |e| WireError::io(Path::new("connection"), "broke", e);
    let timeouts = || stream.set_read_timeout(Some(TICK)).and_then(|()| stream.set_write_timeout(Some(TICK)));
    stream.set_nonblocking(false).and_then(|()| stream.set_nodelay(true)).and_then(|()| timeouts()).map_err(broken)?;
    greeting(&mut Paced::new(stream, stop))
}
