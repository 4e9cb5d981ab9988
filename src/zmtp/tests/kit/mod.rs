//! A flood of subscriptions from other processes, beside a subscriber whose frames are timed. Knows ZMTP 3.0 only by its bytes (RFC 23), so that it
//! tests any publisher.

#![allow(dead_code)] // Each test binary uses its part.
#![allow(clippy::print_stdout, clippy::unwrap_used)] // Helpers of tests may panic.

use std::io::{self, ErrorKind, Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::process::{Child, Command};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

/// Greeting of ZMTP 3.0 with the NULL mechanism.
pub const GREETING: [u8; 64] = {
    let mut greeting = [0; 64];
    greeting[0] = 0xff;
    greeting[9] = 0x7f;
    greeting[10] = 3;
    [greeting[12], greeting[13], greeting[14], greeting[15]] = *b"NULL";
    greeting
};
/// READY of a SUB socket.
pub const READY: &[u8] = b"\x04\x19\x05READY\x0bSocket-Type\x00\x00\x00\x03SUB";
/// Bytes of subscriptions that each connection of a flood sends.
const FLOOD_BYTES: usize = 1 << 20;
/// Names what the attacker of [`attack_if_asked`] does.
const VARIABLE: &str = "RIDGEWATCH_TEST_ATTACK";
/// Time between a disconnection and the next attempt, as in libzmq.
const RECONNECT: Duration = Duration::from_millis(100);

/// A flood from one or more users.
#[derive(Debug, Clone, Copy)]
pub struct Flood<'a> {
    /// Connections of each user.
    pub connections: usize,
    /// Users; those other than the own one need root.
    pub users: &'a [u32],
    pub duration: Duration,
}

/// Service to a healthy subscriber, and what the publisher's process held.
#[derive(Debug)]
pub struct Outcome {
    /// Longest time without a frame, from before the flood until some seconds after it.
    pub gap: Duration,
    pub frames: usize,
    /// Open descriptors before the flood, at most, and some seconds after it.
    pub descriptors: [usize; 3],
    /// Resident MiB before the flood, at most, and some seconds after it.
    pub resident: [u64; 3],
}

/// Runs `publish` ten times a second, beside the flood and for three seconds after it.
pub fn flood(address: SocketAddr, flood: Flood, publish: &mut dyn FnMut()) -> Outcome {
    let healthy = Healthy::start(address);
    let begin = Instant::now();
    while healthy.arrivals().is_empty() {
        assert!(begin.elapsed() < Duration::from_secs(60), "no frame came");
        publish();
        std::thread::sleep(Duration::from_millis(100));
    }
    let (descriptors, resident) = (open_descriptors(), resident_mib());
    let (mut most_descriptors, mut most_resident) = (descriptors, resident);
    let share = Flood { users: &[], ..flood };
    let mut attackers: Vec<_> = flood.users.iter().map(|user| Attacker::start(address, share, *user)).collect();
    let begin = Instant::now();
    let mut tick = begin;
    while begin.elapsed() < flood.duration + Duration::from_secs(3) {
        publish();
        most_descriptors = most_descriptors.max(open_descriptors());
        most_resident = most_resident.max(resident_mib());
        if begin.elapsed() >= flood.duration {
            attackers.clear();
        }
        tick += Duration::from_millis(100);
        std::thread::sleep(tick.saturating_duration_since(Instant::now()));
    }
    let after = (open_descriptors(), resident_mib());
    let arrivals: Vec<_> = healthy.finish().into_iter().filter(|time| *time > begin).collect();
    let times: Vec<_> = [begin].into_iter().chain(arrivals).chain([Instant::now()]).collect();
    Outcome {
        gap: times.windows(2).map(|pair| pair[1] - pair[0]).max().unwrap_or_default(),
        frames: times.len() - 2,
        descriptors: [descriptors, most_descriptors, after.0],
        resident: [resident, most_resident, after.1],
    }
}

/// Number of descriptors of this process.
pub fn open_descriptors() -> usize {
    std::fs::read_dir("/proc/self/fd").map_or(0, |entries| entries.count())
}

/// Resident memory of this process.
pub fn resident_mib() -> u64 {
    let pages = std::fs::read_to_string("/proc/self/statm").ok().and_then(|text| text.split(' ').nth(1)?.parse::<u64>().ok());
    pages.unwrap_or_default() / 256
}

/// A process that attacks; it ends with this value.
struct Attacker(Child);

impl Attacker {
    /// Starts this test program again, whose ignored test `attacker` calls [`attack_if_asked`].
    fn start(address: SocketAddr, flood: Flood, user: u32) -> Self {
        let order = format!("{address} {} {user}", flood.connections);
        let program = std::env::current_exe().unwrap();
        Self(Command::new(program).args(["--exact", "attacker", "--ignored", "--nocapture"]).env(VARIABLE, order).spawn().unwrap())
    }
}

impl Drop for Attacker {
    fn drop(&mut self) {
        self.0.kill().ok();
        self.0.wait().ok();
    }
}

/// The attacker's process: floods until it is killed. Returns at once in any other process.
pub fn attack_if_asked() {
    let Ok(order) = std::env::var(VARIABLE) else { return };
    let order: Vec<&str> = order.split(' ').collect();
    let (address, connections, user) = (order[0].parse().unwrap(), order[1].parse().unwrap(), order[2].parse().unwrap());
    // SAFETY: plain numbers; the structure is written before it is read.
    unsafe {
        let mut limit = libc::rlimit { rlim_cur: 0, rlim_max: 0 };
        libc::getrlimit(libc::RLIMIT_NOFILE, &mut limit);
        limit.rlim_cur = limit.rlim_max;
        libc::setrlimit(libc::RLIMIT_NOFILE, &limit);
        assert!(libc::geteuid() == user || libc::setresuid(user, user, user) == 0, "another user needs root");
    }
    let mut bytes = [&GREETING, READY].concat();
    let everything = [bytes.as_slice(), &[0, 1, 1]].concat();
    (0..FLOOD_BYTES / 4).for_each(|number| bytes.extend([0, 2, 1, number as u8]));
    let mut all: Vec<_> = (0..connections).map(|_| Connection::default()).collect();
    let (mut reader, mut since) = (Connection::default(), Instant::now());
    loop {
        let mut moved = false;
        for connection in &mut all {
            moved |= connection.push(address, &bytes);
        }
        // Stalls as often as it can: a stalled connection is only seen to be closed by reading.
        if since.elapsed() > Duration::from_secs(5) {
            (reader, since) = (Connection::default(), Instant::now());
        }
        reader.push(address, &everything);
        if !moved {
            std::thread::sleep(Duration::from_millis(1));
        }
    }
}

/// A connection that sends and never reads. It is opened again when the publisher closes it.
#[derive(Default)]
struct Connection {
    stream: Option<TcpStream>,
    sent: usize,
    /// Bytes of the publisher's greeting that came. libzmq closes the connection of a peer that sends more than a greeting before.
    greeted: usize,
    not_before: Option<Instant>,
}

impl Connection {
    /// Sends what goes without waiting; returns whether anything went.
    fn push(&mut self, address: SocketAddr, bytes: &[u8]) -> bool {
        if self.stream.is_none() && self.not_before.is_none_or(|time| Instant::now() >= time) {
            (self.sent, self.greeted) = (0, 0);
            self.stream = TcpStream::connect_timeout(&address, Duration::from_millis(100)).ok();
            self.not_before = Some(Instant::now() + RECONNECT);
            self.stream.iter().for_each(|stream| stream.set_nonblocking(true).unwrap());
        }
        let Some(stream) = &mut self.stream else { return false };
        let end = if self.sent < GREETING.len() { GREETING.len() } else { bytes.len().min(self.sent + 65536) };
        let pushed = if self.sent == GREETING.len() && self.greeted < GREETING.len() {
            let came = stream.read(&mut [0; GREETING.len()][self.greeted..]);
            self.greeted += came.as_ref().copied().unwrap_or_default();
            came.and_then(|count| if count == 0 { Err(ErrorKind::UnexpectedEof.into()) } else { Ok(0) })
        } else if self.sent < end {
            stream.write(&bytes[self.sent..end])
        } else {
            stream.take_error().and_then(|error| error.map_or(Ok(0), Err))
        };
        match pushed {
            Ok(count) => self.sent += count,
            Err(error) if error.kind() == ErrorKind::WouldBlock => return false,
            Err(_) => (self.stream, self.not_before) = (None, Some(Instant::now() + RECONNECT)),
        }
        self.sent < bytes.len()
    }
}

/// A subscriber to the topic `frame` that reads at once and reconnects.
pub struct Healthy {
    stop: Arc<AtomicBool>,
    arrivals: Arc<Mutex<Vec<Instant>>>,
    thread: JoinHandle<()>,
}

impl Healthy {
    pub fn start(address: SocketAddr) -> Self {
        let (stop, arrivals) = (Arc::new(AtomicBool::new(false)), Arc::new(Mutex::new(Vec::new())));
        let (stopped, noted) = (stop.clone(), arrivals.clone());
        let thread = std::thread::spawn(move || {
            while !stopped.load(Ordering::Relaxed) {
                if let Err(error) = listen(address, &stopped, &noted) {
                    println!("the healthy subscriber is disconnected: {error}");
                    std::thread::sleep(RECONNECT);
                }
            }
        });
        Self { stop, arrivals, thread }
    }

    pub fn arrivals(&self) -> Vec<Instant> {
        self.arrivals.lock().unwrap().clone()
    }

    pub fn finish(self) -> Vec<Instant> {
        self.stop.store(true, Ordering::Relaxed);
        self.thread.join().unwrap();
        let arrivals = self.arrivals.lock().unwrap();
        arrivals.clone()
    }
}

fn listen(address: SocketAddr, stop: &AtomicBool, arrivals: &Mutex<Vec<Instant>>) -> io::Result<()> {
    let mut stream = TcpStream::connect(address)?;
    stream.set_read_timeout(Some(Duration::from_millis(100)))?;
    stream.write_all(&GREETING)?;
    let mut body = vec![0; 64];
    fill(&mut stream, &mut body, stop)?;
    stream.write_all(READY)?;
    stream.write_all(b"\x00\x06\x01frame")?;
    loop {
        let mut flags = [0];
        fill(&mut stream, &mut flags, stop)?;
        let mut length = [0; 8];
        fill(&mut stream, if flags[0] & 2 == 0 { &mut length[7..] } else { &mut length }, stop)?;
        body.resize(u64::from_be_bytes(length) as usize, 0);
        fill(&mut stream, &mut body, stop)?;
        if stop.load(Ordering::Relaxed) {
            return Ok(());
        }
        if flags[0] == 0 || flags[0] == 2 {
            arrivals.lock().unwrap().push(Instant::now());
        }
    }
}

/// Reads so many bytes, or fewer when it shall stop.
fn fill(stream: &mut TcpStream, mut buffer: &mut [u8], stop: &AtomicBool) -> io::Result<()> {
    while !buffer.is_empty() && !stop.load(Ordering::Relaxed) {
        match stream.read(buffer) {
            Ok(0) => return Err(ErrorKind::UnexpectedEof.into()),
            Ok(count) => buffer = &mut buffer[count..],
            Err(error) if matches!(error.kind(), ErrorKind::WouldBlock | ErrorKind::TimedOut) => {}
            Err(error) => return Err(error),
        }
    }
    Ok(())
}

/// User of this process.
pub fn user() -> u32 {
    // SAFETY: has no arguments and cannot fail.
    unsafe { libc::geteuid() }
}

/// Checks that a flood cost the healthy subscriber and the process little.
pub fn check(outcome: &Outcome) {
    println!("largest gap {:?}, {} frames, {outcome:?}", outcome.gap, outcome.frames);
    let ([descriptors, _, descriptors_after], [resident, most, _]) = (outcome.descriptors, outcome.resident);
    assert!(outcome.gap < Duration::from_secs(3), "the healthy subscriber waited");
    assert!(descriptors_after <= descriptors, "connections stay open");
    assert!(most <= resident + 32, "memory grows");
}
