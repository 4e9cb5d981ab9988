//! Proxy in front of the ZeroMQ socket, which checks the bytes of subscribers before the `zeromq` crate reads them.
//!
//! The crate allocates any length that a peer announces, and its PUB socket reads subscriptions from every peer: nine bytes of a stranger could
//! end the run. Therefore the socket listens on a private Unix socket, and the proxy accepts the TCP connections. It passes a peer's bytes on
//! only if they are a greeting and short frames of ZMTP 3 (rfc.zeromq.org/spec/23). A peer that announces more, or does not subscribe in time,
//! is disconnected without affecting others. Bytes of the socket pass unchanged.
//!
//! The number of connections is limited. If all are taken, the owner with the most connections loses one, preferably one that has not
//! subscribed yet, preferably the oldest. Owners are the users of this machine and the addresses of other machines.

use std::fmt::{Display, Formatter};
use std::fs::{File, OpenOptions};
use std::io::{Error, ErrorKind, Result};
use std::net::{IpAddr, Ipv4Addr, SocketAddr};
use std::os::fd::AsRawFd;
use std::os::unix::fs::OpenOptionsExt;
use std::os::unix::net::UnixListener;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;
use tokio::io::{AsyncBufReadExt, AsyncRead, AsyncReadExt, AsyncWrite, AsyncWriteExt, BufReader};
use tokio::net::{TcpListener, TcpStream, UnixStream};
use tokio::task::AbortHandle;

/// Maximum number of connections.
const MAX_CONNECTIONS: usize = 256;
/// Maximum length of a frame from a peer, which holds a topic or a few properties.
const MAX_FRAME_BYTES: u64 = 1 << 16;
/// Maximum number of bytes of messages (subscriptions) from one peer, since the socket keeps them.
const MAX_MESSAGE_BYTES: u64 = 1 << 20;
/// Length of a greeting, in bytes.
const GREETING: usize = 64;
/// Time in which a peer must subscribe.
const SUBSCRIBE_TIMEOUT: Duration = Duration::from_secs(5);
/// Buffer of bytes from the socket.
const BUFFER_BYTES: usize = 1 << 18;
/// Bits of a frame's first byte.
const MORE: u8 = 1;
const LONG: u8 = 2;
const COMMAND: u8 = 4;
/// First byte of a subscription in ZMTP 3.0, the version that the socket speaks.
const SUBSCRIBE: u8 = 1;

/// A folder with a socket. Unlike `tempfile`'s it is removed by path: that opens the folder, and leaves it if no descriptor is free.
struct SocketFolder(PathBuf);

impl Drop for SocketFolder {
    fn drop(&mut self) {
        let _ = std::fs::remove_file(self.0.join("socket"));
        let _ = std::fs::remove_dir(&self.0);
    }
}

/// Opens a listener that no other process can reach, with a handle of its place. Its folder is removed at once, so that no file remains.
pub(super) fn private_listener() -> Result<(UnixListener, File)> {
    let folder = SocketFolder(tempfile::Builder::new().prefix("ridgewatch-").tempdir()?.keep());
    let path = folder.0.join("socket");
    let listener = UnixListener::bind(&path)?;
    let place = OpenOptions::new().read(true).custom_flags(libc::O_PATH).open(&path)?;
    Ok((listener, place))
}

/// Owner of a connection, for the shares of connections.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Owner {
    /// A user of this machine, whatever the address: a user may take any address of 127.0.0.0/8.
    User(u32),
    /// Another machine. Unknown users of this machine share one address.
    Address(IpAddr),
}

impl Owner {
    fn of(peer: IpAddr, user: Option<u32>) -> Self {
        let address = peer.to_canonical();
        let unknown = Self::Address(if address.is_loopback() { IpAddr::V4(Ipv4Addr::LOCALHOST) } else { address });
        user.map_or(unknown, Self::User)
    }
}

impl Display for Owner {
    fn fmt(&self, f: &mut Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::User(user) => write!(f, "user {user}"),
            Self::Address(address) => write!(f, "{address}"),
        }
    }
}

/// An accepted connection.
struct Connection {
    owner: Owner,
    has_subscribed: Arc<AtomicBool>,
    task: AbortHandle,
}

/// Accepts connections until it is dropped, and passes them on to the socket at `place`.
pub(super) async fn guard(listener: TcpListener, place: File) {
    let socket = PathBuf::from(format!("/proc/self/fd/{}", place.as_raw_fd()));
    let mut connections: Vec<Connection> = Vec::new();
    loop {
        let Ok((stream, peer)) = listener.accept().await else {
            // The peer closed the connection, or no file descriptor is free. Later connections may succeed.
            tokio::time::sleep(Duration::from_millis(100)).await;
            continue;
        };
        let user = match stream.local_addr() {
            // The system's table of connections may be long; frames must not wait for it.
            Ok(here) => tokio::task::spawn_blocking(move || user_of(peer, here)).await.unwrap_or_default(),
            Err(_) => None,
        };
        connections.retain(|connection| !connection.task.is_finished());
        if connections.len() >= MAX_CONNECTIONS {
            let present: Vec<_> = connections.iter().map(|one| (one.owner, one.has_subscribed.load(Ordering::Relaxed))).collect();
            let Connection { owner, task, .. } = connections.remove(displaced(&present));
            tracing::debug!("a connection of {owner} is closed: there are {MAX_CONNECTIONS}, and no owner has more");
            task.abort();
        }
        let (socket, has_subscribed) = (socket.clone(), Arc::new(AtomicBool::new(false)));
        let subscribes = has_subscribed.clone();
        let task = tokio::spawn(async move {
            if let Err(error) = serve(stream, &socket, &subscribes).await {
                tracing::debug!("{peer} is disconnected: {error}");
            }
        });
        connections.push(Connection { owner: Owner::of(peer.ip(), user), has_subscribed, task: task.abort_handle() });
    }
}

/// User whose process holds the other end of a connection. `None` if it is on another machine or not known.
fn user_of(peer: SocketAddr, here: SocketAddr) -> Option<u32> {
    let plain = |address: SocketAddr| SocketAddr::new(address.ip().to_canonical(), address.port());
    let (peer, here) = (plain(peer), plain(here));
    if !peer.ip().is_loopback() && peer.ip() != here.ip() {
        return None;
    }
    let tables = [procfs::net::tcp, procfs::net::tcp6].into_iter().filter_map(|table| table().ok());
    tables.flatten().find(|one| plain(one.local_address) == peer && plain(one.remote_address) == here).map(|one| one.uid)
}

/// Index of the connection to close. `connections` has the owner of each, oldest first, and whether it has subscribed.
fn displaced(connections: &[(Owner, bool)]) -> usize {
    let count = |owner: Owner| connections.iter().filter(|(one, _)| *one == owner).count();
    let weight = |(owner, has_subscribed): &(Owner, bool)| (count(*owner), !has_subscribed);
    let most = connections.iter().map(weight).max();
    connections.iter().position(|connection| Some(weight(connection)) == most).unwrap_or_default()
}

/// Serves one subscriber until either side closes the connection.
async fn serve(mut outside: TcpStream, socket: &Path, has_subscribed: &AtomicBool) -> Result<()> {
    outside.set_nodelay(true)?;
    let mut inside = UnixStream::connect(socket).await?;
    let ((from_peer, mut to_peer), (from_socket, to_socket)) = (outside.split(), inside.split());
    let mut from_socket = BufReader::with_capacity(BUFFER_BYTES, from_socket);
    tokio::select! {
        done = pass(from_peer, to_socket, has_subscribed) => done,
        done = tokio::io::copy_buf(&mut from_socket, &mut to_peer) => done.map(|_| ()),
    }
}

/// Passes on the bytes of a peer as long as a subscriber may send them.
async fn pass(from: impl AsyncRead + Unpin, to: impl AsyncWrite + Unpin, has_subscribed: &AtomicBool) -> Result<()> {
    let mut frames = Frames { from: BufReader::new(from), to, left: MAX_MESSAGE_BYTES, body: Vec::new() };
    let handshake = async {
        frames.greeting().await?;
        while let Some(subscribes) = frames.next().await? {
            if subscribes {
                return Ok(true);
            }
        }
        Result::Ok(false)
    };
    if tokio::time::timeout(SUBSCRIBE_TIMEOUT, handshake).await?? {
        has_subscribed.store(true, Ordering::Relaxed);
        while frames.next().await?.is_some() {}
    }
    Ok(())
}

/// Stream of frames from a peer to the socket.
struct Frames<R, W> {
    from: BufReader<R>,
    to: W,
    /// Number of message bytes that the peer may still send.
    left: u64,
    body: Vec<u8>,
}

impl<R: AsyncRead + Unpin, W: AsyncWrite + Unpin> Frames<R, W> {
    async fn greeting(&mut self) -> Result<()> {
        let mut greeting = [0; GREETING];
        self.from.read_exact(&mut greeting).await?;
        if greeting[0] != 0xff || greeting[9] != 0x7f || greeting[10] < 3 {
            return refuse("not a greeting of ZMTP 3");
        }
        self.to.write_all(&greeting).await
    }

    /// Passes the next frame on. Returns whether it is a subscription; `None` at the end of the stream.
    async fn next(&mut self) -> Result<Option<bool>> {
        let Self { from, to, left, body } = self;
        if from.fill_buf().await?.is_empty() {
            return Ok(None);
        }
        let flags = from.read_u8().await?;
        if flags & !(MORE | LONG | COMMAND) != 0 || flags & COMMAND != 0 && flags & MORE != 0 {
            return refuse("not a frame of ZMTP 3");
        }
        let length = if flags & LONG != 0 { from.read_u64().await? } else { from.read_u8().await?.into() };
        if length > MAX_FRAME_BYTES {
            return refuse("a frame longer than any subscription");
        }
        if flags & COMMAND == 0 {
            // Includes the header of a short frame, so that empty frames count too.
            let Some(rest) = left.checked_sub(length + 2) else { return refuse("more subscriptions than the limit") };
            *left = rest;
        }
        body.resize(length as usize, 0);
        from.read_exact(body).await?;
        if flags & LONG != 0 {
            to.write_u8(flags).await?;
            to.write_u64(length).await?;
        } else {
            to.write_all(&[flags, length as u8]).await?;
        }
        to.write_all(body).await?;
        Ok(Some(flags & COMMAND == 0 && body.first() == Some(&SUBSCRIBE)))
    }
}

fn refuse<T>(why: &'static str) -> Result<T> {
    Err(Error::new(ErrorKind::InvalidData, why))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Bytes passed on, and the result.
    fn passed(bytes: &[u8]) -> (Vec<u8>, Result<()>) {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
        let mut out = Vec::new();
        let done = runtime.block_on(pass(bytes, &mut out, &AtomicBool::new(false)));
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
    fn frames_of_a_subscriber_pass_unchanged() {
        let mut bytes = greeting();
        for (flags, length) in [(COMMAND, 41), (0, 6), (0, 0), (MORE, 1), (LONG, 1 << 16), (LONG | COMMAND, 300)] {
            bytes.extend(frame(flags, length, &vec![flags; length as usize]));
        }
        let (out, done) = passed(&bytes);
        done.unwrap();
        assert_eq!(out, bytes);
    }

    #[test]
    fn a_frame_that_no_subscriber_sends_ends_the_connection() {
        let mut ours = greeting();
        ours.extend(frame(COMMAND, 3, b"abc"));
        for (bytes, why) in [
            (frame(LONG, 1 << 50, b""), "longer"),
            (frame(LONG, (1 << 16) + 1, &[0; 100]), "longer"),
            (frame(LONG | COMMAND, u64::MAX, b""), "longer"),
            (frame(8, 1, b"a"), "not a frame"),
            (frame(COMMAND | MORE, 1, b"a"), "not a frame"),
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
    fn the_owner_with_the_most_connections_loses_one_without_subscription_or_the_oldest() {
        // Negative: has not subscribed.
        let owner = |n: i32| (Owner::User(n.unsigned_abs()), n > 0);
        for (there, gone) in [
            (&[1, 2, 2, 3][..], 1),
            (&[1, 1, 2, 2], 0),
            (&[3, 1, 2, 2, 1, 2], 2),
            (&[5], 0),
            (&[1, 1, -1, -1, 2], 2),
            (&[1, 2, -2, -1], 2),
            // Many connections of one owner do not displace a new one of another.
            (&[1, 1, 1, -2], 0),
        ] {
            let connections: Vec<_> = there.iter().map(|n| owner(*n)).collect();
            assert_eq!(displaced(&connections), gone, "{there:?}");
        }
    }

    #[test]
    fn many_addresses_of_this_machine_displace_no_other_owner() {
        let loopback = |n: u8| IpAddr::from([127, 0, n, 7]);
        let subscriber = Owner::of(loopback(0), Some(1000));
        for stranger in [Some(1001), None] {
            // All subscribe, each from a different address; the last address has the IPv6 form.
            let mapped = std::net::Ipv4Addr::new(127, 9, 9, 9).to_ipv6_mapped();
            let addresses = (1..255).map(loopback).chain([IpAddr::from(mapped)]);
            let connections: Vec<_> =
                [(subscriber, true)].into_iter().chain(addresses.map(|address| (Owner::of(address, stranger), true))).collect();
            assert_eq!(connections.len(), MAX_CONNECTIONS);
            assert_eq!(displaced(&connections), 1, "{stranger:?}");
        }
        // A user is one owner at every address; another machine is another owner.
        assert_eq!(Owner::of("192.0.2.1".parse().unwrap(), Some(1000)), subscriber);
        assert_ne!(Owner::of("192.0.2.1".parse().unwrap(), None), Owner::of(loopback(1), None));
    }

    #[test]
    fn a_subscription_is_told_from_other_frames() {
        let subscribes = |bytes: Vec<u8>| {
            let has_subscribed = AtomicBool::new(false);
            let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
            runtime.block_on(pass([greeting(), bytes].concat().as_slice(), Vec::new(), &has_subscribed)).unwrap();
            has_subscribed.into_inner()
        };
        let ready = frame(COMMAND, 5, b"\x05READ");
        assert!(!subscribes(ready.clone()) && !subscribes(frame(0, 6, b"\0frame")) && !subscribes(frame(0, 0, b"")));
        assert!(!subscribes(frame(COMMAND, 1, b"\x01")));
        assert!(subscribes([ready, frame(0, 6, b"\x01frame")].concat()) && subscribes(frame(0, 1, b"\x01")));
    }

    /// For every address of this machine.
    #[test]
    fn a_peer_of_this_machine_is_known_by_its_user() {
        // SAFETY: has no arguments and cannot fail.
        let own = unsafe { libc::geteuid() };
        for address in ["127.0.0.1:0", "[::1]:0", "[::]:0"] {
            let listener = std::net::TcpListener::bind(address).unwrap();
            let reached = if address == "[::]:0" { IpAddr::from([127, 0, 0, 1]) } else { listener.local_addr().unwrap().ip() };
            let peer = std::net::TcpStream::connect((reached, listener.local_addr().unwrap().port())).unwrap();
            let (stream, address) = listener.accept().unwrap();
            assert_eq!(user_of(address, stream.local_addr().unwrap()), Some(own), "{address}");
            assert_eq!(user_of(peer.local_addr().unwrap(), "192.0.2.1:5577".parse().unwrap()), None, "no such connection");
        }
        let listener = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
        let peer = runtime.block_on(async {
            let socket = tokio::net::TcpSocket::new_v4().unwrap();
            socket.bind("127.0.3.7:0".parse().unwrap()).unwrap();
            socket.connect(listener.local_addr().unwrap()).await.unwrap()
        });
        let (stream, address) = listener.accept().unwrap();
        assert_eq!(address, peer.local_addr().unwrap());
        assert_eq!(user_of(address, stream.local_addr().unwrap()), Some(own), "{address}");
        assert_eq!(user_of("192.0.2.7:1000".parse().unwrap(), "192.0.2.1:5577".parse().unwrap()), None, "of another machine");
    }

    #[test]
    fn subscriptions_are_bounded() {
        let mut bytes = greeting();
        // Empty parts of an endless message.
        (0..MAX_MESSAGE_BYTES).for_each(|_| bytes.extend([MORE, 0]));
        let (out, done) = passed(&bytes);
        assert!(done.unwrap_err().to_string().contains("more subscriptions"));
        assert_eq!(out.len() as u64, GREETING as u64 + MAX_MESSAGE_BYTES);
    }
}
