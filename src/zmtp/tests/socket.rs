//! The socket and its subscribers: of the `zeromq` crate, and of plain bytes.

#![allow(clippy::unwrap_used, clippy::print_stdout)]

mod kit;

use kit::{GREETING, READY};
use ridgewatch_zmtp::{BindError, Keep, Limits, Peers, PubSocket};
use std::io::{Read, Write};
use std::net::TcpStream;
use std::process::{Command, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};
use zeromq::{Socket, SocketRecv, SubSocket};

/// Longer than anything here takes on a busy machine, so that a test that hangs fails.
const LIMIT: Duration = Duration::from_secs(60);

fn bind(limits: Limits) -> PubSocket {
    PubSocket::bind("tcp://127.0.0.1:0", None, limits).unwrap()
}

fn connect(socket: &PubSocket) -> TcpStream {
    let stream = TcpStream::connect(socket.endpoint().strip_prefix("tcp://").unwrap()).unwrap();
    stream.set_read_timeout(Some(LIMIT)).unwrap();
    stream
}

/// Shakes hands and sends these bytes.
fn greet(socket: &PubSocket, bytes: &[u8]) -> TcpStream {
    let mut stream = connect(socket);
    stream.write_all(&[&GREETING, READY, bytes].concat()).unwrap();
    let mut greeting = [0; 64];
    stream.read_exact(&mut greeting).unwrap();
    assert_eq!((greeting[0], &greeting[9..16]), (0xff, b"\x7f\x03\x01NULL".as_slice()));
    assert_eq!(frame(&mut stream), (4, b"\x05READY\x0bSocket-Type\0\0\0\x03PUB".to_vec()));
    stream
}

/// Reads a frame: flags and body.
fn frame(stream: &mut TcpStream) -> (u8, Vec<u8>) {
    let (mut flags, mut length) = ([0], [0; 8]);
    stream.read_exact(&mut flags).unwrap();
    stream.read_exact(if flags[0] & 2 == 0 { &mut length[7..] } else { &mut length }).unwrap();
    let mut body = vec![0; u64::from_be_bytes(length) as usize];
    stream.read_exact(&mut body).unwrap();
    (flags[0], body)
}

fn until(what: &str, mut holds: impl FnMut() -> bool) {
    let begin = Instant::now();
    while !holds() {
        assert!(begin.elapsed() < LIMIT, "{what}");
        std::thread::sleep(Duration::from_millis(2));
    }
}

/// Whether the publisher closes the connection, whatever it sent before.
fn ends(mut stream: TcpStream) -> bool {
    stream.set_read_timeout(Some(LIMIT)).unwrap();
    match stream.read_to_end(&mut Vec::new()) {
        Ok(_) => true,
        Err(error) => error.kind() == std::io::ErrorKind::ConnectionReset,
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn subscribers_of_the_zeromq_crate_get_what_they_subscribe_to() {
    let folder = tempfile::tempdir().unwrap();
    for endpoint in ["tcp://127.0.0.1:0", "tcp://[::1]:0", &format!("ipc://{}/frames", folder.path().display())] {
        let socket = Arc::new(PubSocket::bind(endpoint, None, Limits::default()).unwrap());
        let (stop, publisher) = (Arc::new(AtomicBool::new(false)), socket.clone());
        let stopped = stop.clone();
        let publishing = tokio::task::spawn_blocking(move || {
            for number in 0u32.. {
                if stopped.load(Ordering::Relaxed) {
                    break;
                }
                publisher.send(&[b"frame", b"{}"], vec![number as u8; 300_000], Keep::Newest);
                publisher.send(&[b"record"], number.to_be_bytes().to_vec(), Keep::All);
                std::thread::sleep(Duration::from_millis(5));
            }
        });
        let receive = async |socket: &mut SubSocket| tokio::time::timeout(LIMIT, socket.recv()).await.unwrap().unwrap();
        let (mut records, mut all) = (SubSocket::new(), SubSocket::new());
        records.connect(socket.endpoint()).await.unwrap();
        records.subscribe("record").await.unwrap();
        let number = async |socket: &mut SubSocket| {
            let message = receive(socket).await;
            assert_eq!((message.len(), message.get(0).unwrap().as_ref()), (2, b"record".as_slice()));
            u32::from_be_bytes(message.get(1).unwrap().as_ref().try_into().unwrap())
        };
        let first = number(&mut records).await;
        for next in first + 1..first + 100 {
            assert_eq!(number(&mut records).await, next, "{endpoint}");
        }
        // A late one, to all topics; then without one of them, which is not the same subscription.
        all.connect(socket.endpoint()).await.unwrap();
        all.subscribe("").await.unwrap();
        let mut topics = std::collections::BTreeSet::new();
        while topics.len() < 2 {
            let message = receive(&mut all).await;
            if message.len() == 3 {
                assert_eq!(message.get(2).unwrap().len(), 300_000);
            }
            topics.insert(message.get(0).unwrap().to_vec());
        }
        all.subscribe("rec").await.unwrap();
        all.unsubscribe("").await.unwrap();
        let mut in_turn = 0;
        while in_turn < 20 {
            in_turn = if receive(&mut all).await.len() == 2 { in_turn + 1 } else { 0 };
        }
        stop.store(true, Ordering::Relaxed);
        publishing.await.unwrap();
        let counts = socket.counts();
        assert_eq!((counts.peak_subscribers, counts.stalled, counts.faults, counts.refused), (2, 0, 0, 0), "{counts:?}");
    }
    assert!(!folder.path().join("frames").exists());
}

#[test]
fn commands_of_zmtp_31_are_served() {
    let socket = bind(Limits::default());
    let mut stream = greet(&socket, b"\x04\x0b\x09SUBSCRIBEa\x04\x0b\x09SUBSCRIBEb\x04\x0a\x04PING\x00\x00xyz");
    assert_eq!(frame(&mut stream), (4, b"\x04PONGxyz".to_vec()));
    stream.write_all(b"\x04\x08\x06CANCELa\x04\x08\x04PING\x00\x001").unwrap();
    assert_eq!(frame(&mut stream), (4, b"\x04PONG1".to_vec()));
    assert!(socket.is_wanted(b"bc") && !socket.is_wanted(b"a"));
    for topic in [b"a1", b"b1"] {
        socket.send(&[topic], vec![1; 3], Keep::All);
    }
    assert_eq!((frame(&mut stream), frame(&mut stream)), ((1, b"b1".to_vec()), (0, vec![1; 3])));
    socket.send(&[], b"b".to_vec(), Keep::All);
    assert_eq!(frame(&mut stream), (0, b"b".to_vec()));
}

#[test]
fn a_peer_that_misbehaves_is_disconnected_and_nobody_else() {
    let socket = bind(Limits { handshake: Duration::from_millis(300), topics: 10, topic_bytes: 100, frames: 50, ..Limits::default() });
    let mut healthy = greet(&socket, b"\x00\x02\x01a");
    until("it subscribes", || socket.is_wanted(b"a"));
    let topics: Vec<u8> = (0..11).flat_map(|topic| [0, 2, 1, topic]).collect();
    let long = [&[0, 102, 1], [7; 101].as_slice()].concat();
    let harms = [
        topics,
        long,
        b"\0\x02\x01b".repeat(51),
        b"\x04\x0a\x04PING\0\0abc".repeat(51),
        b"\0\0".repeat(51),
        // A length that no memory holds, and flags that do not exist.
        vec![2, 0, 4, 0, 0, 0, 0, 0, 0],
        vec![8],
    ];
    for harm in &harms {
        assert!(ends(greet(&socket, harm)), "{harm:?}");
    }
    for silent in [b"".as_slice(), &GREETING, b"GET / HTTP/1.1\r\n\r\n"] {
        let mut stream = connect(&socket);
        stream.write_all(silent).unwrap();
        assert!(ends(stream));
    }
    until("all are counted", || (socket.counts().faults, socket.counts().stalled) == (10, 0));
    socket.send(&[b"a"], b"still".to_vec(), Keep::All);
    assert_eq!((frame(&mut healthy), frame(&mut healthy)), ((1, b"a".to_vec()), (0, b"still".to_vec())));
}

/// Whether the publisher has closed the connection.
fn is_closed(stream: &TcpStream) -> bool {
    stream.set_nonblocking(true).unwrap();
    let read = stream.peek(&mut [0]);
    stream.set_nonblocking(false).unwrap();
    !matches!(read, Err(error) if error.kind() == std::io::ErrorKind::WouldBlock)
}

#[test]
fn beyond_256_connections_each_new_one_takes_the_place_of_one_that_has_not_subscribed() {
    const MORE: usize = 40;
    let socket = bind(Limits::default());
    let mut first = greet(&socket, b"\x00\x02\x01a");
    until("it subscribes", || socket.is_wanted(b"a"));
    let mut others: Vec<_> = (0..255).map(|_| greet(&socket, b"")).collect();
    assert_eq!(socket.counts().displaced, 0);
    assert!(!others.iter().any(is_closed), "256 are served");
    others.extend((0..MORE).map(|_| greet(&socket, b"")));
    assert_eq!(socket.counts().displaced, MORE as u64);
    // Those that were idle for longest.
    until("they are closed", || others[..MORE].iter().all(is_closed));
    assert!(!others[MORE..].iter().any(is_closed));
    let mut late = greet(&socket, b"\x00\x02\x01a");
    until("it subscribes", || socket.counts().peak_subscribers == 2);
    socket.send(&[b"a"], b"still".to_vec(), Keep::All);
    for subscriber in [&mut first, &mut late] {
        assert_eq!((frame(subscriber), frame(subscriber)), ((1, b"a".to_vec()), (0, b"still".to_vec())));
    }
    let counts = socket.counts();
    assert_eq!((counts.displaced, counts.faults, counts.stalled), (MORE as u64 + 1, 0, 0), "{counts:?}");
}

#[test]
fn subscribers_that_do_not_read_cost_others_nothing() {
    const BYTES: usize = 32 << 20;
    let limits = Limits { stall: Duration::from_secs(2), ..Limits::default() };
    let socket = bind(limits);
    let mut healthy = greet(&socket, b"\x00\x02\x01a");
    until("it subscribes", || socket.is_wanted(b"a"));
    let mut send = || {
        until("there is room", || socket.has_room(b"a", Keep::Newest, Duration::from_millis(10)));
        let begin = Instant::now();
        socket.send(&[b"a"], vec![1; BYTES], Keep::Newest);
        assert_eq!((frame(&mut healthy).0, frame(&mut healthy).1.len()), (1, BYTES));
        begin.elapsed()
    };
    // Each is stuck in another message, so that more are held than may be in flight.
    let mut stuck = Vec::new();
    for _ in 0..6 {
        stuck.push(greet(&socket, b"\x00\x01\x01"));
        until("it subscribes", || socket.is_wanted(b"b"));
        let took = send();
        assert!(took < limits.stall, "the healthy subscriber waited {took:?}");
    }
    until("all are disconnected", || socket.counts().stalled == 6);
    assert!(stuck.into_iter().all(ends));
    assert!(socket.counts().peak_bytes <= (limits.in_flight * (BYTES + 100)) as u64, "{:?}", socket.counts());
    send();
}

#[test]
fn closing_sends_the_rest_and_dropping_does_not_wait() {
    let socket = bind(Limits::default());
    let mut reader = greet(&socket, b"\x00\x01\x01");
    let stuck = greet(&socket, b"\x00\x01\x01");
    until("both subscribe", || socket.counts().peak_subscribers == 2);
    for number in 0..20 {
        socket.send(&[b"a"], vec![number; 1 << 20], Keep::All);
    }
    let reading = std::thread::spawn(move || {
        let mut rest = Vec::new();
        reader.read_to_end(&mut rest).map(|_| rest.len())
    });
    let begin = Instant::now();
    socket.close(begin + Duration::from_millis(700));
    assert!(begin.elapsed() < Duration::from_secs(10), "{:?}", begin.elapsed());
    assert_eq!(reading.join().unwrap().unwrap(), 20 * ((1 << 20) + 9 + 3), "all came before the end");
    assert!(ends(stuck));
    let endpoint = socket.endpoint().to_owned();
    assert!(
        matches!(TcpStream::connect(endpoint.strip_prefix("tcp://").unwrap()), Err(error) if error.kind() == std::io::ErrorKind::ConnectionRefused)
    );
    let socket = PubSocket::bind(&endpoint, None, Limits::default()).unwrap();
    assert!(matches!(PubSocket::bind(&endpoint, None, Limits::default()), Err(BindError::InUse)));
    let stuck = greet(&socket, b"\x00\x01\x01");
    until("it subscribes", || socket.is_wanted(b"a"));
    socket.send(&[b"a"], vec![0; 64 << 20], Keep::Newest);
    let begin = Instant::now();
    drop(socket);
    assert!(begin.elapsed() < Duration::from_secs(1), "{:?}", begin.elapsed());
    assert!(ends(stuck));
}

/// Bytes that a process of another user receives from a TCP port of this machine.
fn received_by_nobody(port: &str) -> String {
    use std::os::unix::process::CommandExt;
    let script = format!("exec 3<>/dev/tcp/127.0.0.1/{port}; head -c 64 <&3 | wc -c");
    let output = Command::new("/bin/bash").args(["-c", &script]).uid(65534).stderr(Stdio::null()).output().unwrap();
    String::from_utf8(output.stdout).unwrap().trim().to_owned()
}

#[test]
#[ignore = "becomes another user, which needs root"]
fn other_users_are_refused_unless_they_are_let_in() {
    for (peers, bytes, refused) in [(None, "0", 1), (Some(Peers::User), "0", 1), (Some(Peers::Any), "64", 0)] {
        let socket = PubSocket::bind("tcp://127.0.0.1:0", peers, Limits::default()).unwrap();
        assert_eq!(received_by_nobody(socket.endpoint().rsplit(':').next().unwrap()), bytes, "{peers:?}");
        assert_eq!(socket.counts().refused, refused, "{peers:?}");
        greet(&socket, b"");
    }
    let socket = PubSocket::bind("tcp://*:0", None, Limits::default()).unwrap();
    assert_eq!(received_by_nobody(socket.endpoint().rsplit(':').next().unwrap()), "64", "whoever binds all interfaces serves all");
}
