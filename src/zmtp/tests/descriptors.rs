//! No free descriptors: the publisher neither spins nor ends. A test program of its own, since the limit is that of the process.

#![allow(clippy::unwrap_used)]

mod kit;

use ridgewatch_zmtp::{Keep, Limits, PubSocket};
use std::net::{SocketAddr, TcpStream};
use std::time::Duration;

/// Processor time of this process.
fn processor_seconds() -> f64 {
    // SAFETY: the structure is plain numbers, and is written before it is read.
    let usage = unsafe {
        let mut usage = std::mem::zeroed::<libc::rusage>();
        libc::getrusage(libc::RUSAGE_SELF, &mut usage);
        usage
    };
    let seconds = |time: libc::timeval| time.tv_sec as f64 + 1e-6 * time.tv_usec as f64;
    seconds(usage.ru_utime) + seconds(usage.ru_stime)
}

#[test]
fn without_descriptors_subscribers_go_on_and_the_thread_sleeps() {
    let socket = PubSocket::bind("tcp://127.0.0.1:0", None, Limits::default()).unwrap();
    let address: SocketAddr = socket.endpoint().strip_prefix("tcp://").unwrap().parse().unwrap();
    let healthy = kit::Healthy::start(address);
    let frames = |count: usize| {
        for _ in 0..count {
            socket.send(&[b"frame"], vec![1; 1000], Keep::Newest);
            std::thread::sleep(Duration::from_millis(20));
        }
        healthy.arrivals().len()
    };
    while frames(1) == 0 {}
    let limit = |most: u64| {
        // SAFETY: plain numbers.
        assert_eq!(0, unsafe { libc::setrlimit(libc::RLIMIT_NOFILE, &libc::rlimit { rlim_cur: most, rlim_max: 1024 }) });
    };
    // Their own ends take all that is left.
    limit(kit::open_descriptors() as u64 + 20);
    let waiting: Vec<_> = std::iter::from_fn(|| TcpStream::connect(address).ok()).take(1000).collect();
    assert!((5..100).contains(&waiting.len()), "{}", waiting.len());
    let (spent, before) = (processor_seconds(), frames(1));
    let after = frames(50);
    assert!(processor_seconds() - spent < 0.5, "{} s of processor time in a second", processor_seconds() - spent);
    assert!(after >= before + 25, "{before} to {after} frames");
    limit(1024);
    drop(waiting);
    let late = kit::Healthy::start(address);
    while late.arrivals().is_empty() {
        frames(1);
    }
    late.finish();
}
