//! What the relay's TCP costs beside ZeroMQ, in one run: seconds a step, memory beside a follower that stalls, and what a stranger's announcement
//! of a length does. The same signature and hash either way; over ZeroMQ a follower asks for each step, so that the newest wins and one is on its way.
//!
//! `cargo bench --bench relay -- [MEGABYTES [ROUNDS]]` (340 and 8; a minute)
#![allow(clippy::print_stdout, clippy::unwrap_used, missing_docs)]

use bytes::Bytes;
use ridgewatch_wire::message::{Facts, Key, Kind, Session};
use ridgewatch_wire::{AxisDescription, Description, Geometry, Limits};
use std::io::{Cursor, Read, Write};
use std::net::{TcpListener, TcpStream};
use std::process::{Command, Stdio};
use std::sync::Arc;
use std::time::{Duration, Instant};
use zeromq::{DealerSocket, RouterSocket, Socket, SocketRecv, SocketSend, ZmqMessage};

/// Set in the process that strangers connect to.
const VICTIM: &str = "RIDGEWATCH_BENCH_VICTIM";

fn main() {
    if std::env::var_os(VICTIM).is_some() {
        return victim();
    }
    let numbers: Vec<usize> = std::env::args().filter_map(|a| a.parse().ok()).collect();
    let (megabytes, rounds) = (numbers.first().copied().unwrap_or(340), numbers.get(1).copied().unwrap_or(8));
    throughput(megabytes, rounds);
    stalled(megabytes);
    announced();
}

/// A field of about so many megabytes.
fn field(megabytes: usize) -> (Description, Arc<Vec<f32>>) {
    let nodes = ((megabytes as f64 * 1e6 / 12.0).cbrt() as u64).max(2);
    let axis = |name| AxisDescription::uniform(name, "m", 0.0, 1.0, nodes);
    let description = Description::whole(Geometry::Cartesian, vec![axis("x"), axis("y"), axis("z")], "s");
    let values = (0..description.block_bytes() / 4).map(|i| i as f32).collect();
    (description, Arc::new(values))
}

fn facts(step: u64) -> Facts {
    Facts { kind: Kind::Step, block: 0, generation: 1, step, time: step as f64, published: 0, missed: 0 }
}

/// Takes one message in, and says so of its last value.
fn receive(session: &mut Session, from: &mut impl Read, known: &mut Option<Description>, values: &mut Vec<f32>) {
    let mut note = |_, announced: Option<Description>| {
        *known = announced.or(known.take());
        known.as_ref().map(Description::block_bytes)
    };
    session.receive(from, &Limits { step_bytes: u64::MAX }, &mut note, values).unwrap();
    assert_eq!(values[1], 1.0);
}

/// Both ends of a session.
fn sessions() -> (Session, Session, TcpStream, TcpStream) {
    let (listener, key) = (TcpListener::bind("127.0.0.1:0").unwrap(), Key::random().unwrap());
    let mut client = TcpStream::connect(listener.local_addr().unwrap()).unwrap();
    let mut server = listener.accept().unwrap().0;
    let other = key.clone();
    let mut plain = client.try_clone().unwrap();
    let connecting = std::thread::spawn(move || Session::connect(&mut plain, &other).unwrap());
    let accepted = Session::accept(&mut server, &key).unwrap();
    client.flush().unwrap();
    (accepted, connecting.join().unwrap(), server, client)
}

/// Keeps a message up to where its values begin.
struct Head {
    bytes: Vec<u8>,
    values: usize,
    seen: usize,
}

impl Write for Head {
    fn write(&mut self, from: &[u8]) -> std::io::Result<usize> {
        if from.len() < self.values && self.seen == self.bytes.len() {
            self.bytes.extend_from_slice(from);
        }
        self.seen += from.len();
        Ok(from.len())
    }
    fn flush(&mut self) -> std::io::Result<()> {
        Ok(())
    }
}

/// The field's memory as ZeroMQ takes it, uncopied.
struct Owned(Arc<Vec<f32>>);

impl AsRef<[u8]> for Owned {
    fn as_ref(&self) -> &[u8] {
        // SAFETY: floats without padding are bytes.
        unsafe { std::slice::from_raw_parts(self.0.as_ptr().cast(), 4 * self.0.len()) }
    }
}

/// A step as two frames, signed and hashed as over TCP.
fn frames(session: &mut Session, description: &Description, values: &Arc<Vec<f32>>, step: u64) -> [Bytes; 2] {
    let mut head = Head { bytes: Vec::new(), values: 1 << 16, seen: 0 };
    session.send(&mut head, &facts(step), Some(description), values).unwrap();
    [head.bytes.into(), Bytes::from_owner(Owned(values.clone()))]
}

fn throughput(megabytes: usize, rounds: usize) {
    let (description, values) = field(megabytes);
    let bytes = description.block_bytes() as f64;
    // TCP: the relay's own way.
    let (mut relay, mut follower, mut server, client) = sessions();
    let (ask, asked) = std::sync::mpsc::sync_channel::<u64>(0);
    let (sent, announced) = (values.clone(), description.clone());
    let sender = std::thread::spawn(move || {
        while let Ok(step) = asked.recv() {
            relay.send(&mut server, &facts(step), Some(&announced), &sent).unwrap();
        }
    });
    // ZeroMQ: a follower asks, a ROUTER answers.
    let runtime = || tokio::runtime::Builder::new_multi_thread().worker_threads(1).enable_all().build().unwrap();
    let (there, here) = (runtime(), runtime());
    let (mut zmq_relay, mut zmq_follower, ..) = sessions();
    let mut router = RouterSocket::new();
    let endpoint = there.block_on(router.bind("tcp://127.0.0.1:0")).unwrap().to_string();
    let (sent, announced) = (values.clone(), description.clone());
    let serving = there.spawn(async move {
        for step in 1.. {
            let Ok(request) = router.recv().await else { return };
            let [head, payload] = frames(&mut zmq_relay, &announced, &sent, step);
            let mut answer = ZmqMessage::from(request.get(0).unwrap().clone());
            answer.push_back(head);
            answer.push_back(payload);
            router.send(answer).await.unwrap();
        }
    });
    let mut dealer = DealerSocket::new();
    here.block_on(dealer.connect(&endpoint)).unwrap();
    let mut from = std::io::BufReader::with_capacity(1 << 16, client);
    let (mut known, mut buffer, mut copy) = (None, Vec::new(), vec![0.0f32; values.len()]);
    let (mut tcp, mut zmq, mut plain) = (Vec::new(), Vec::new(), Vec::new());
    for step in 0..=rounds as u64 {
        let begin = Instant::now();
        ask.send(step + 1).unwrap();
        receive(&mut follower, &mut from, &mut known, &mut buffer);
        let middle = Instant::now();
        let answer = here.block_on(async {
            dealer.send(ZmqMessage::from("next")).await.unwrap();
            dealer.recv().await.unwrap()
        });
        receive(
            &mut zmq_follower,
            &mut Cursor::new(answer.get(0).unwrap()).chain(Cursor::new(answer.get(1).unwrap())),
            &mut known,
            &mut buffer,
        );
        drop(answer);
        let end = Instant::now();
        copy.copy_from_slice(&values);
        assert_eq!(copy[1], 1.0);
        // The first round takes memory.
        if step > 0 {
            tcp.push((middle - begin).as_secs_f64());
            zmq.push((end - middle).as_secs_f64());
            plain.push(end.elapsed().as_secs_f64());
        }
    }
    drop(ask);
    sender.join().unwrap();
    serving.abort();
    let median = |times: &mut Vec<f64>| {
        times.sort_by(f64::total_cmp);
        times[times.len() / 2]
    };
    let (tcp, zmq, plain) = (median(&mut tcp), median(&mut zmq), median(&mut plain));
    println!("| {:.0} MB a step, median of {rounds} | s | GB/s | times TCP |\n|---|---|---|---|", bytes / 1e6);
    for (name, seconds) in [("TCP, signed and hashed", tcp), ("ZeroMQ, signed and hashed", zmq), ("memcpy", plain)] {
        println!("| {name} | {seconds:.3} | {:.2} | {:.2} |", bytes / seconds / 1e9, seconds / tcp);
    }
}

/// `VmRSS` or `VmSize` of a process, MB.
fn memory(process: u32, which: &str) -> f64 {
    let status = std::fs::read_to_string(format!("/proc/{process}/status")).unwrap_or_default();
    let line = status.lines().find(|line| line.starts_with(which)).unwrap_or_default().to_owned();
    line.split_whitespace().nth(1).and_then(|n| n.parse::<f64>().ok()).unwrap_or(f64::NAN) / 1e3
}

/// A follower that asks and reads nothing, beside each way of sending.
fn stalled(megabytes: usize) {
    let (description, values) = field(megabytes);
    let me = std::process::id();
    let before = memory(me, "VmRSS");
    let (mut relay, _follower, mut server, _client) = sessions();
    let (sent, announced) = (values.clone(), description.clone());
    server.set_write_timeout(Some(Duration::from_secs(3))).unwrap();
    let sending = std::thread::spawn(move || relay.send(&mut server, &facts(1), Some(&announced), &sent).is_err());
    std::thread::sleep(Duration::from_secs(2));
    let tcp = memory(me, "VmRSS") - before;
    assert!(sending.join().unwrap(), "it is cut off");
    let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(2).enable_all().build().unwrap();
    let (mut zmq_relay, ..) = sessions();
    let before = memory(me, "VmRSS");
    let zmq = runtime.block_on(async {
        let mut router = RouterSocket::new();
        let endpoint = router.bind("tcp://127.0.0.1:0").await.unwrap().to_string();
        // A peer that speaks ZMTP as far as its request, and then takes nothing.
        let mut peer = TcpStream::connect(endpoint.trim_start_matches("tcp://")).unwrap();
        zmtp(&mut peer, b"DEALER");
        peer.write_all(&[0, 4]).and_then(|()| peer.write_all(b"next")).unwrap();
        let request = router.recv().await.unwrap();
        let [head, payload] = frames(&mut zmq_relay, &description, &values, 1);
        let mut answer = ZmqMessage::from(request.get(0).unwrap().clone());
        answer.push_back(head);
        answer.push_back(payload);
        router.send(answer).await.unwrap();
        tokio::time::sleep(Duration::from_secs(2)).await;
        memory(me, "VmRSS") - before
    });
    println!(
        "\nbeside the step itself, one stalled follower costs the relay {tcp:.0} MB over TCP until it is cut off, {zmq:.0} MB over ZeroMQ"
    );
}

/// Greets as a ZMTP 3 peer without authentication.
fn zmtp(stream: &mut TcpStream, kind: &[u8]) {
    let mut greeting = [0u8; 64];
    greeting[..12].copy_from_slice(&[0xff, 0, 0, 0, 0, 0, 0, 0, 1, 0x7f, 3, 0]);
    greeting[12..16].copy_from_slice(b"NULL");
    stream.write_all(&greeting).unwrap();
    let mut theirs = [0u8; 64];
    stream.read_exact(&mut theirs).unwrap();
    let mut ready = b"\x05READY\x0bSocket-Type".to_vec();
    ready.extend_from_slice(&(kind.len() as u32).to_be_bytes());
    ready.extend_from_slice(kind);
    stream.write_all(&[4, ready.len() as u8]).and_then(|()| stream.write_all(&ready)).unwrap();
    let mut head = [0u8; 2];
    stream.read_exact(&mut head).unwrap();
    stream.read_exact(&mut vec![0; usize::from(head[1])]).unwrap();
}

/// A ROUTER that waits for requests.
fn victim() {
    let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(1).enable_all().build().unwrap();
    runtime.block_on(async {
        let mut router = RouterSocket::new();
        println!("{}", router.bind("tcp://127.0.0.1:0").await.unwrap());
        loop {
            let _ = router.recv().await;
        }
    });
}

/// Nine bytes of somebody who knows no key: the length of a frame.
fn announced() {
    println!("\n| a stranger announces | the ROUTER's process |\n|---|---|");
    for length in [1u64 << 34, 1 << 50] {
        let mut child =
            Command::new(std::env::current_exe().unwrap()).env(VICTIM, "1").stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
        let mut line = String::new();
        std::io::BufRead::read_line(&mut std::io::BufReader::new(child.stdout.as_mut().unwrap()), &mut line).unwrap();
        let mut peer = TcpStream::connect(line.trim().trim_start_matches("tcp://")).unwrap();
        zmtp(&mut peer, b"DEALER");
        std::thread::sleep(Duration::from_millis(200));
        let before = memory(child.id(), "VmSize");
        let mut frame = vec![2u8];
        frame.extend_from_slice(&length.to_be_bytes());
        peer.write_all(&frame).unwrap();
        std::thread::sleep(Duration::from_secs(1));
        let what = match child.try_wait().unwrap() {
            Some(status) => format!("is gone: {status}"),
            None => format!("lives; its memory grew by {:.0} MB", memory(child.id(), "VmSize") - before),
        };
        println!("| a frame of 2^{} bytes | {what} |", length.ilog2());
        let _ = child.kill();
        let _ = child.wait();
    }
}
