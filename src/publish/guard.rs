//! The door in front of the ZeroMQ socket: what subscribers send is looked at before the `zeromq` crate has it.
//!
//! The crate takes memory for any length that a peer announces, and its PUB socket reads subscriptions from everybody: nine bytes of a stranger could end
//! the run. So the socket itself listens where nobody else can reach it, connections over TCP end here, and a peer's bytes are handed on only as far as they
//! are a greeting and short frames of ZMTP 3 (rfc.zeromq.org/spec/23). Who announces more is cut off, and nobody else notices. What the socket sends passes
//! as it is. Who greets may stay, so that places are shared out by address: where none is left, the one that has most of them gives up its oldest.

use std::fs::{File, OpenOptions};
use std::io::{Error, ErrorKind, Result};
use std::net::IpAddr;
use std::os::fd::AsRawFd;
use std::os::unix::fs::OpenOptionsExt;
use std::os::unix::net::UnixListener;
use std::path::{Path, PathBuf};
use std::time::Duration;
use tokio::io::{AsyncBufReadExt, AsyncRead, AsyncReadExt, AsyncWrite, AsyncWriteExt, BufReader};
use tokio::net::{TcpListener, TcpStream, UnixStream};
use tokio::task::AbortHandle;

/// Connections at once.
const CONNECTIONS: usize = 256;
/// Longest frame of a peer: names of topics and a few properties.
const FRAME_BYTES: u64 = 1 << 16;
/// Most bytes of messages (subscriptions) that one peer may send: the socket keeps them.
const MESSAGE_BYTES: u64 = 1 << 20;
/// Bytes of a greeting, and how long a peer may take for them.
const GREETING: usize = 64;
const PATIENCE: Duration = Duration::from_secs(5);
/// How many bytes of the socket are passed on at once.
const PIECE: usize = 1 << 18;
/// Bits of a frame's first byte.
const MORE: u8 = 1;
const LONG: u8 = 2;
const COMMAND: u8 = 4;

/// A listener that nobody else can reach, and its place. The folder in which it was made is gone, so that nothing stays behind however this process ends.
pub(super) fn private_listener() -> Result<(UnixListener, File)> {
    let folder = tempfile::Builder::new().prefix("ridgewatch-").tempdir()?;
    let path = folder.path().join("socket");
    let listener = UnixListener::bind(&path)?;
    let place = OpenOptions::new().read(true).custom_flags(libc::O_PATH).open(&path)?;
    Ok((listener, place))
}

/// Lets subscribers in, until it is dropped. The socket listens at `place`.
pub(super) async fn guard(listener: TcpListener, place: File) {
    let socket = PathBuf::from(format!("/proc/self/fd/{}", place.as_raw_fd()));
    let mut guests: Vec<(IpAddr, AbortHandle)> = Vec::new();
    loop {
        let Ok((stream, peer)) = listener.accept().await else {
            // A peer that went before it was taken, or no descriptor left: later ones may fare better.
            tokio::time::sleep(Duration::from_millis(100)).await;
            continue;
        };
        guests.retain(|(_, connection)| !connection.is_finished());
        if guests.len() >= CONNECTIONS {
            let (address, oldest) = guests.remove(displaced(&guests));
            tracing::debug!("a connection of {address} is cut off: {CONNECTIONS} are there, and most of them are its own");
            oldest.abort();
        }
        let socket = socket.clone();
        let connection = tokio::spawn(async move {
            if let Err(error) = connection(stream, &socket).await {
                tracing::debug!("{peer} is cut off: {error}");
            }
        });
        guests.push((peer.ip(), connection.abort_handle()));
    }
}

/// Who goes, of guests as they came: of the address with most places the one that came first.
fn displaced<T>(guests: &[(IpAddr, T)]) -> usize {
    let places = |address: IpAddr| guests.iter().filter(|(one, _)| *one == address).count();
    let most = guests.iter().map(|(address, _)| places(*address)).max().unwrap_or_default();
    guests.iter().position(|(address, _)| places(*address) == most).unwrap_or_default()
}

/// One subscriber, until either side ends it.
async fn connection(mut outside: TcpStream, socket: &Path) -> Result<()> {
    outside.set_nodelay(true)?;
    let mut inside = UnixStream::connect(socket).await?;
    let ((mut from_peer, mut to_peer), (from_socket, mut to_socket)) = (outside.split(), inside.split());
    let mut from_socket = BufReader::with_capacity(PIECE, from_socket);
    tokio::select! {
        done = pass(&mut from_peer, &mut to_socket) => done,
        done = tokio::io::copy_buf(&mut from_socket, &mut to_peer) => done.map(|_| ()),
    }
}

/// Hands on what a peer sends, as long as it is what a subscriber may send.
async fn pass(from: &mut (impl AsyncRead + Unpin), to: &mut (impl AsyncWrite + Unpin)) -> Result<()> {
    let mut greeting = [0; GREETING];
    tokio::time::timeout(PATIENCE, from.read_exact(&mut greeting)).await??;
    if greeting[0] != 0xff || greeting[9] != 0x7f || greeting[10] < 3 {
        return refuse("no greeting of ZMTP 3");
    }
    to.write_all(&greeting).await?;
    let mut from = BufReader::new(from);
    let (mut left, mut body) = (MESSAGE_BYTES, Vec::new());
    while !from.fill_buf().await?.is_empty() {
        let flags = from.read_u8().await?;
        if flags & !(MORE | LONG | COMMAND) != 0 || flags & COMMAND != 0 && flags & MORE != 0 {
            return refuse("no frame of ZMTP 3");
        }
        let length = if flags & LONG != 0 { from.read_u64().await? } else { from.read_u8().await?.into() };
        if length > FRAME_BYTES {
            return refuse("a frame longer than any subscription");
        }
        if flags & COMMAND == 0 {
            // With a head that a short frame has, so that empty ones count too.
            let Some(rest) = left.checked_sub(length + 2) else { return refuse("more subscriptions than are kept") };
            left = rest;
        }
        body.resize(length as usize, 0);
        from.read_exact(&mut body).await?;
        if flags & LONG != 0 {
            to.write_u8(flags).await?;
            to.write_u64(length).await?;
        } else {
            to.write_all(&[flags, length as u8]).await?;
        }
        to.write_all(&body).await?;
    }
    Ok(())
}

fn refuse(why: &'static str) -> Result<()> {
    Err(Error::new(ErrorKind::InvalidData, why))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// What is handed on of these bytes, and why it ends.
    fn passed(bytes: &[u8]) -> (Vec<u8>, Result<()>) {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
        let mut out = Vec::new();
        let done = runtime.block_on(pass(&mut { bytes }, &mut out));
        (out, done)
    }

    fn greeting() -> Vec<u8> {
        let mut bytes = vec![0; GREETING];
        (bytes[0], bytes[9], bytes[10]) = (0xff, 0x7f, 3);
        bytes[12..16].copy_from_slice(b"NULL");
        bytes
    }

    fn frame(flags: u8, length: u64, body: &[u8]) -> Vec<u8> {
        let head = if flags & LONG != 0 { length.to_be_bytes().to_vec() } else { vec![length as u8] };
        [&[flags], head.as_slice(), body].concat()
    }

    #[test]
    fn what_a_subscriber_sends_passes_unchanged() {
        let mut bytes = greeting();
        for (flags, length) in [(COMMAND, 41), (0, 6), (0, 0), (MORE, 1), (LONG, 1 << 16), (LONG | COMMAND, 300)] {
            bytes.extend(frame(flags, length, &vec![flags; length as usize]));
        }
        let (out, done) = passed(&bytes);
        done.unwrap();
        assert_eq!(out, bytes);
    }

    #[test]
    fn what_no_subscriber_sends_ends_with_what_came_before() {
        let mut ours = greeting();
        ours.extend(frame(COMMAND, 3, b"abc"));
        for (bytes, why) in [
            (frame(LONG, 1 << 50, b""), "longer"),
            (frame(LONG, (1 << 16) + 1, &[0; 100]), "longer"),
            (frame(LONG | COMMAND, u64::MAX, b""), "longer"),
            (frame(8, 1, b"a"), "no frame"),
            (frame(COMMAND | MORE, 1, b"a"), "no frame"),
            (frame(0, 9, b"cut"), "eof"),
        ] {
            let (out, done) = passed(&[ours.clone(), bytes].concat());
            assert!(done.unwrap_err().to_string().contains(why), "{why}");
            assert_eq!(out, ours);
        }
        let (out, done) = passed(&[b"GET / HTTP/1.1\r\n".as_slice(), &[0; 64]].concat());
        assert!(out.is_empty() && done.unwrap_err().to_string().contains("greeting"));
    }

    #[test]
    fn whoever_has_most_places_gives_up_the_oldest() {
        let guests = |last: &[u8]| last.iter().map(|n| (IpAddr::from([10, 0, 0, *n]), ())).collect::<Vec<_>>();
        for (there, gone) in [(&[1, 2, 2, 3][..], 1), (&[1, 1, 2, 2], 0), (&[3, 1, 2, 2, 1, 2], 2), (&[5], 0)] {
            assert_eq!(displaced(&guests(there)), gone, "{there:?}");
        }
    }

    #[test]
    fn subscriptions_are_bounded() {
        let mut bytes = greeting();
        // Empty parts of a message that never ends.
        (0..MESSAGE_BYTES).for_each(|_| bytes.extend([MORE, 0]));
        let (out, done) = passed(&bytes);
        assert!(done.unwrap_err().to_string().contains("more subscriptions"));
        assert_eq!(out.len() as u64, GREETING as u64 + MESSAGE_BYTES);
    }
}
