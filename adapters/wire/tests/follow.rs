//! Followers of rings and relays: restarts, kills, several blocks, broken connections.

#![allow(clippy::unwrap_used, clippy::print_stdout)]

#[path = "support/folder.rs"]
mod folder;

use folder::Folder;
use ridgewatch_wire::message::{ASK_BYTES, Ask, ConnectionFile, Facts, Key, Kind, Session};
use ridgewatch_wire::relay::{PEER_TIMEOUT, RelayCounts, RelayFollower, serve};
use ridgewatch_wire::{
    Assembler, AxisDescription, BlockExtent, Description, Element, Event, Field, Geometry, Incomplete, Limits, Policy, Producer, Published,
    RingFollower, WireError, block_path,
};
use std::cell::Cell;
use std::collections::BTreeMap;
use std::io::{Read, Write};
use std::net::{TcpListener, TcpStream};
use std::os::unix::fs::FileExt;
use std::sync::atomic::{AtomicBool, AtomicU64, AtomicUsize, Ordering};
use std::sync::{Arc, Barrier, Mutex};
use std::thread::{JoinHandle, sleep, spawn};
use std::time::{Duration, Instant};

const LONG: Duration = Duration::from_secs(30);
const MILLISECOND: Duration = Duration::from_millis(1);

fn description(nodes: u64) -> Description {
    let axis = |name| AxisDescription::uniform(name, "m", 0.0, 1.0, nodes);
    Description::whole(Geometry::Cartesian, vec![axis("x"), axis("y")], "s")
}

/// Opens a ring of a square field with 4 slots, in which the newest step wins.
fn open(folder: &Folder, nodes: u64) -> Producer {
    Producer::open(&folder.0, description(nodes), 4, Policy::NewestWins).unwrap()
}

fn publish(producer: &Producer, step: u64) -> Published {
    let plane = vec![step as f32; producer.description().block_nodes() as usize];
    let pointers = [plane.as_ptr().cast::<u8>(); 2];
    // SAFETY: one value per node.
    unsafe { producer.publish(step, step as f64, &Field::packed(&pointers, Element::F32, producer.description().block.extent)).unwrap() }
}

/// A follower of rings or of a relay.
trait Follow {
    fn next(&mut self, values: &mut Vec<f32>) -> Option<Event>;
}

impl Follow for RingFollower {
    fn next(&mut self, values: &mut Vec<f32>) -> Option<Event> {
        self.poll(values)
    }
}

impl Follow for RelayFollower {
    fn next(&mut self, values: &mut Vec<f32>) -> Option<Event> {
        self.poll(values, 10 * MILLISECOND)
    }
}

fn follow(folder: &Folder) -> RingFollower {
    RingFollower::begin(&folder.0, Limits::default()).unwrap()
}

/// Events as text, until one begins with `enough` or a minute has passed.
fn events(follower: &mut dyn Follow, enough: &str) -> Vec<String> {
    let (mut seen, mut values, begin) = (Vec::new(), Vec::new(), Instant::now());
    while begin.elapsed() < 2 * LONG {
        let text = match follower.next(&mut values) {
            Some(Event::Opened { description, .. }) => format!("opened {}", description.shape()[0]),
            Some(Event::Step { step, time, missed, .. }) => {
                assert!(time == step as f64 && values.iter().all(|v| *v == step as f32), "step {step}");
                format!("step {step} missed {missed}")
            }
            Some(Event::Ended { closed, .. }) => format!("ended {closed}"),
            Some(Event::Refused(error)) => format!("refused {error}"),
            None => {
                sleep(MILLISECOND);
                continue;
            }
        };
        let last = text.starts_with(enough);
        seen.push(text);
        if last {
            break;
        }
    }
    seen
}

/// Asserts that there is no event for a while.
fn assert_quiet(follower: &mut dyn Follow, time: Duration) {
    let begin = Instant::now();
    while begin.elapsed() < time {
        let event = follower.next(&mut Vec::new());
        assert!(event.is_none(), "{event:?}");
    }
}

/// Waits for a condition.
fn until(limit: Duration, holds: impl Fn() -> bool) {
    let begin = Instant::now();
    while !holds() {
        assert!(begin.elapsed() < limit, "it did not happen within {limit:?}");
        sleep(MILLISECOND);
    }
}

/// Runs `work` in a child process, which exits with status 1 if it panics.
fn fork(work: impl FnOnce()) -> libc::pid_t {
    // SAFETY: no other test runs meanwhile, and the child needs no other thread.
    let child = unsafe { libc::fork() };
    if child == 0 {
        let passed = std::panic::catch_unwind(std::panic::AssertUnwindSafe(work)).is_ok();
        // SAFETY: ends the child without the exit handlers of the tests.
        unsafe { libc::_exit(i32::from(!passed)) };
    }
    child
}

fn wait(child: libc::pid_t) -> i32 {
    let mut status = -1;
    // SAFETY: waits for this child.
    unsafe { libc::waitpid(child, &mut status, 0) };
    status
}

/// A child process that publishes one step and waits to be killed.
fn doomed(folder: &Folder, step: u64) -> libc::pid_t {
    fork(|| {
        let producer = open(folder, 4);
        publish(&producer, step);
        loop {
            sleep(LONG);
        }
    })
}

fn kill(child: libc::pid_t) {
    // SAFETY: this process's child.
    unsafe { libc::kill(child, libc::SIGKILL) };
    assert!(libc::WIFSIGNALED(wait(child)));
}

/// A relay of a folder's rings.
struct Relay {
    file: ConnectionFile,
    counts: Arc<RelayCounts>,
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl Relay {
    fn start(folder: &Folder) -> Self {
        Self::start_at(folder, "127.0.0.1:0", &Key::random().unwrap(), |_| {})
    }

    fn start_at(folder: &Folder, address: &str, key: &Key, tell: impl Fn(String) + Send + Sync + 'static) -> Self {
        let listener = TcpListener::bind(address).unwrap();
        let file = ConnectionFile { address: listener.local_addr().unwrap().to_string(), key: key.clone() };
        let (counts, stop) = (Arc::<RelayCounts>::default(), Arc::<AtomicBool>::default());
        let (ring, key, shared, flag) = (folder.0.clone(), key.clone(), counts.clone(), stop.clone());
        let thread = spawn(move || serve(&ring, &listener, &key, &shared, &flag, Arc::new(tell)).unwrap());
        Self { file, counts, stop, thread: Some(thread) }
    }

    fn follow(&self, gone: Duration) -> RelayFollower {
        follow_relay(&self.file, Limits::default(), gone)
    }
}

impl Drop for Relay {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        self.thread.take().unwrap().join().unwrap();
    }
}

fn follow_relay(file: &ConnectionFile, limits: Limits, gone: Duration) -> RelayFollower {
    let file = file.clone();
    RelayFollower::begin(Box::new(move || Ok(file.clone())), limits, gone).unwrap()
}

/// The relay's side of a connection, played by `play`, and a follower of it.
fn scripted<T: Send + 'static>(
    play: impl FnOnce(&Key, TcpListener, TcpStream, Session) -> T + Send + 'static,
) -> (RelayFollower, JoinHandle<T>) {
    let (listener, key) = (TcpListener::bind("127.0.0.1:0").unwrap(), Key::random().unwrap());
    let file = ConnectionFile { address: listener.local_addr().unwrap().to_string(), key: key.clone() };
    let follower = follow_relay(&file, Limits::default(), LONG);
    let relay = spawn(move || {
        let mut stream = listener.accept().unwrap().0;
        stream.set_read_timeout(Some(LONG)).unwrap();
        let session = Session::accept(&mut stream, &key).unwrap();
        play(&key, listener, stream, session)
    });
    (follower, relay)
}

const PULSE: Facts = Facts { kind: Kind::Pulse, block: 0, generation: 1, step: 0, time: 0.0, published: 0, missed: 0 };

fn read_ask(stream: &mut TcpStream, session: &mut Session) -> Ask {
    let mut bytes = [0; ASK_BYTES];
    stream.read_exact(&mut bytes).unwrap();
    session.check_ask(&bytes).unwrap()
}

#[test]
fn a_solver_that_ends_and_one_that_starts_anew_are_followed() {
    let folder = Folder::new("anew");
    let mut follower = follow(&folder);
    let producer = open(&folder, 4);
    (0..3).for_each(|n| _ = publish(&producer, n));
    assert_eq!(events(&mut follower, "step 2"), ["opened 4", "step 0 missed 0", "step 1 missed 0", "step 2 missed 0"]);
    publish(&producer, 3);
    drop(producer);
    // Another grid at once: the rest of the first ring is read first.
    let producer = open(&folder, 5);
    publish(&producer, 0);
    assert_eq!(events(&mut follower, "step 0"), ["step 3 missed 0", "ended true", "opened 5", "step 0 missed 0"]);
    drop(producer);
    assert_eq!(events(&mut follower, "ended"), ["ended true"]);
    drop(follower);
    assert!(!folder.0.exists());
}

#[test]
fn a_killed_solver_is_noticed_and_its_ring_is_no_news_to_others() {
    let folder = Folder::alone("killed");
    let mut follower = follow(&folder);
    let producer = open(&folder, 4);
    publish(&producer, 1);
    assert_eq!(events(&mut follower, "step 1").len(), 2);
    drop(producer);
    assert_eq!(events(&mut follower, "ended"), ["ended true"]);
    let killed = fork(|| {
        let producer = open(&folder, 4);
        publish(&producer, 7);
        // SAFETY: as if the machine ran out of memory.
        unsafe { libc::kill(libc::getpid(), libc::SIGKILL) };
    });
    assert!(libc::WIFSIGNALED(wait(killed)));
    // It was dead before the follower saw it: its ring is left from a killed run.
    assert_quiet(&mut follower, Duration::from_secs(1));
    // A new one replaces it.
    let producer = open(&folder, 4);
    publish(&producer, 2);
    assert_eq!(events(&mut follower, "step 2"), ["opened 4", "step 2 missed 0"]);
}

#[test]
fn a_solver_that_is_killed_and_replaced_at_once_is_followed() {
    let folder = Folder::alone("replaced");
    let mut follower = follow(&folder);
    for first in (0..50).step_by(10) {
        let child = doomed(&folder, first);
        let seen = events(&mut follower, &format!("step {first}"));
        assert_eq!(seen.last().unwrap(), &format!("step {first} missed 0"), "{seen:?}");
        kill(child);
        // Before the follower checks the producer.
        let producer = open(&folder, 4);
        publish(&producer, first + 1);
        assert_eq!(events(&mut follower, "step"), ["ended false".to_owned(), "opened 4".into(), format!("step {} missed 0", first + 1)]);
        drop(producer);
        assert_eq!(events(&mut follower, "ended"), ["ended true"]);
    }
}

#[test]
fn a_ring_that_lies_is_left_until_a_new_one_comes() {
    let folder = Folder::new("lies");
    let mut follower = follow(&folder);
    let producer = open(&folder, 4);
    publish(&producer, 1);
    assert_eq!(events(&mut follower, "step 1"), ["opened 4", "step 1 missed 0"]);
    publish(&producer, 2);
    // Makes the time of the second step NaN. The first slot begins after a description of less than a page.
    let ring = std::fs::OpenOptions::new().write(true).open(block_path(&folder.0, 0)).unwrap();
    ring.write_all_at(&f64::NAN.to_ne_bytes(), 12288 + 4096 + 16).unwrap();
    assert_eq!(events(&mut follower, "refused"), ["refused `time` is NaN; accepted: a finite number"]);
    // It is neither opened nor refused again, and its end is reported.
    (3..6).for_each(|n| _ = publish(&producer, n));
    assert_quiet(&mut follower, Duration::from_millis(500));
    drop(producer);
    assert_eq!(events(&mut follower, "ended"), ["ended false"]);
    let producer = open(&folder, 4);
    publish(&producer, 7);
    assert_eq!(events(&mut follower, "step 7"), ["opened 4", "step 7 missed 0"]);
}

#[test]
fn strangers_take_no_followers_place() {
    let folder = Folder::new("strangers");
    let relay = Relay::start(&folder);
    let producer = open(&folder, 8);
    publish(&producer, 0);
    let waited = || {
        // They connect and send nothing.
        let strangers: Vec<TcpStream> = (0..100).map(|_| TcpStream::connect(&relay.file.address).unwrap()).collect();
        let begin = Instant::now();
        let mut follower = relay.follow(LONG);
        let seen = events(&mut follower, "step 0");
        assert_eq!(seen.last().unwrap(), "step 0 missed 0", "{seen:?}");
        let waited = begin.elapsed();
        assert!(relay.counts.followers.load(Ordering::Relaxed) >= 1);
        drop(strangers);
        waited
    };
    // Well before the first of them times out; the machine may have stood still once.
    let waits: Vec<Duration> = (0..3).map(|_| waited()).take_while(|waited| *waited > Duration::from_secs(4)).collect();
    assert!(waits.len() < 3, "{waits:?}");
}

#[test]
fn a_follower_for_whom_there_is_no_place_is_told_so_once_and_comes_in_when_there_is() {
    let folder = Folder::new("places");
    let relay = Relay::start(&folder);
    let producer = open(&folder, 4);
    publish(&producer, 0);
    let mut followers: Vec<RelayFollower> = (0..16).map(|_| relay.follow(LONG)).collect();
    until(LONG, || relay.counts.accepted.load(Ordering::Relaxed) >= 16);
    let mut late = relay.follow(LONG);
    // It tries again and again.
    until(LONG, || relay.counts.refused.load(Ordering::Relaxed) >= 3);
    followers.pop();
    let seen = events(&mut late, "step 0");
    assert_eq!(seen, [&format!("refused {}", WireError::Rejected), "opened 4", "step 0 missed 0"]);
    assert_eq!(relay.counts.accepted.load(Ordering::Relaxed), 17);
}

/// Keeps this process from opening files, and returns the earlier limit.
fn exhaust_descriptors() -> libc::rlimit {
    let mut before = libc::rlimit { rlim_cur: 0, rlim_max: 0 };
    // SAFETY: both limits outlive the calls.
    unsafe {
        assert_eq!(libc::getrlimit(libc::RLIMIT_NOFILE, &mut before), 0);
        assert_eq!(libc::setrlimit(libc::RLIMIT_NOFILE, &libc::rlimit { rlim_cur: 0, ..before }), 0);
    }
    before
}

#[test]
fn a_block_that_lives_goes_on_when_descriptors_were_wanting_for_a_while() {
    let folder = Folder::alone("wanting");
    let producer = open(&folder, 4);
    publish(&producer, 0);
    let (mut heard, mut says) = std::io::pipe().unwrap();
    let child = fork(|| {
        let mut follower = follow(&folder);
        assert_eq!(events(&mut follower, "step 0"), ["opened 4", "step 0 missed 0"]);
        let before = exhaust_descriptors();
        assert!(ridgewatch_wire::producer_lives(&folder.0, 0).is_err());
        let (mut seen, begin) = (Vec::new(), Instant::now());
        // Reported once, and not again for a while.
        while seen.is_empty() && begin.elapsed() < LONG {
            seen.extend(follower.next(&mut Vec::new()));
        }
        assert!(matches!(seen[..], [Event::Refused(_)]), "{seen:?}");
        assert_quiet(&mut follower, Duration::from_millis(500));
        // SAFETY: the limit outlives the call.
        assert_eq!(unsafe { libc::setrlimit(libc::RLIMIT_NOFILE, &before) }, 0);
        says.write_all(&[1]).unwrap();
        assert_eq!(events(&mut follower, "step 1"), ["step 1 missed 0"]);
    });
    drop(says);
    // Returns without a byte if the child has failed.
    let _ = heard.read(&mut [0]);
    publish(&producer, 1);
    assert_eq!(wait(child), 0);
}

#[test]
fn two_followers_of_a_relay_lose_nothing_of_a_solver_that_waits() {
    struct Slow(RelayFollower, Duration, Arc<AtomicUsize>);
    impl Follow for Slow {
        fn next(&mut self, values: &mut Vec<f32>) -> Option<Event> {
            sleep(self.1);
            let event = self.0.next(values);
            self.2.fetch_add(usize::from(matches!(event, Some(Event::Step { step: 0, .. }))), Ordering::Relaxed);
            event
        }
    }
    let folder = Folder::new("two");
    let relay = Relay::start(&folder);
    let producer = Producer::open(&folder.0, description(64), 4, Policy::Wait(LONG)).unwrap();
    let took = Arc::new(AtomicUsize::new(0));
    let followers = [0, 2].map(|pause| {
        let mut follower = Slow(relay.follow(LONG), pause * MILLISECOND, took.clone());
        spawn(move || events(&mut follower, "step 199"))
    });
    // Both follow before the first slot is used again.
    publish(&producer, 0);
    until(LONG, || took.load(Ordering::Relaxed) == 2);
    (1..200).for_each(|n| _ = publish(&producer, n));
    let expected: Vec<String> = ["opened 64".to_owned()].into_iter().chain((0..200).map(|n| format!("step {n} missed 0"))).collect();
    for follower in followers {
        assert_eq!(follower.join().unwrap(), expected);
    }
}

/// `count` columns of a grid.
fn columns(nodes: u64, count: u32) -> Vec<Description> {
    let width = nodes / u64::from(count);
    let block = |index: u32| BlockExtent { index, count, offset: [width * u64::from(index), 0, 0], extent: [width, nodes, 1] };
    (0..count).map(|index| Description { start: 1, block: block(index), ..description(nodes) }).collect()
}

/// Follows until `enough` returns true for the numbers of the complete steps, and checks their values. `meanwhile` is called after each poll, with true if a
/// block was read.
fn assemble(folder: &Folder, meanwhile: &mut dyn FnMut(bool), enough: &dyn Fn(&[u64]) -> bool) -> (Vec<u64>, Vec<Incomplete>) {
    let mut follower = follow(folder);
    let (mut values, mut whole, mut assembler, begin) = (Vec::new(), Vec::new(), None::<Assembler>, Instant::now());
    while !enough(&whole) {
        assert!(begin.elapsed() < LONG, "{whole:?}");
        let event = follower.poll(&mut values);
        let block_came = matches!(event, Some(Event::Step { .. }));
        match event {
            Some(Event::Opened { description, generation }) => {
                let assembler = assembler.get_or_insert_with(|| Assembler::new(&description, LONG, 4));
                assembler.introduce(&description, generation).unwrap();
            }
            Some(Event::Step { block, generation, step, time, published, .. }) => {
                let came = assembler.as_mut().unwrap().block(block, generation, step, time, published, &mut values).unwrap();
                if let Some(came) = came {
                    assert!(came.values.iter().all(|v| *v == came.step as f32));
                    whole.push(came.step);
                }
            }
            Some(other) => panic!("{other:?}"),
            None => {}
        }
        meanwhile(block_came);
    }
    (whole, assembler.unwrap().incomplete())
}

#[test]
fn blocks_of_a_solver_that_is_too_fast_meet_about_as_often_as_one_block_comes() {
    const STEPS: u64 = 400;
    let [one, four] = [1, 4].map(|count| {
        let folder = Folder::new(&format!("fast{count}"));
        let producers: Vec<Producer> =
            columns(64, count).into_iter().map(|block| Producer::open(&folder.0, block, 4, Policy::NewestWins).unwrap()).collect();
        // While a field is read, in however many blocks, 8/3 steps are published. If there was nothing to read, the next step is.
        let (published, mut due) = (Cell::new(0), 0);
        let mut solve = |block_came: bool| {
            due += if block_came { 8 } else { 3 * count };
            while due >= 3 * count {
                producers.iter().for_each(|producer| _ = publish(producer, published.get()));
                (due, _) = (due - 3 * count, published.replace(published.get() + 1));
            }
        };
        // Only steps that were read while the solver ran count.
        assemble(&folder, &mut solve, &|_| published.get() >= STEPS).0.len() as u64
    });
    assert!(one < STEPS / 2, "{one} of {STEPS}: the reader is not slow");
    assert!(2 * four >= one, "{four} steps of four blocks, {one} of one block");
}

#[test]
fn a_block_that_is_late_is_waited_for_and_no_step_is_lost() {
    let folder = Folder::new("late");
    let producers: Vec<Producer> =
        columns(9, 3).into_iter().map(|block| Producer::open(&folder.0, block, 8, Policy::Wait(LONG)).unwrap()).collect();
    std::thread::scope(|scope| {
        // Each publishes as fast as it may, one after another.
        for (n, producer) in producers.iter().enumerate() {
            scope.spawn(move || {
                sleep(Duration::from_millis(200) * n as u32);
                (0..40).for_each(|n| assert!(!publish(producer, n).overwrote));
            });
        }
        let mut rest = |block_came: bool| sleep(Duration::from_micros(if block_came { 0 } else { 100 }));
        let (whole, given_up) = assemble(&folder, &mut rest, &|whole| whole.len() == 40);
        assert_eq!((whole, given_up), ((0..40).collect(), Vec::new()));
    });
}

#[test]
fn blocks_that_open_after_the_others_were_found_lose_no_step() {
    let folder = Folder::new("opened-late");
    let (first, later) = (&columns(9, 3)[..1], &columns(9, 3)[1..]);
    let open = |block: &Description| Producer::open(&folder.0, block.clone(), 4, Policy::Wait(LONG)).unwrap();
    let mut producers: Vec<Producer> = first.iter().map(open).collect();
    let (mut polls, done) = (0, AtomicBool::new(false));
    let done = &done;
    std::thread::scope(|scope| {
        // All blocks are open before the first step, and step together, as in any solver.
        let mut start = |_| {
            polls += 1;
            // The first poll found the first block, and the second looked for others in vain.
            if polls == 2 {
                producers.extend(later.iter().map(open));
                let together = Arc::new(Barrier::new(3));
                for producer in producers.drain(..) {
                    let together = together.clone();
                    scope.spawn(move || {
                        for n in 0..12 {
                            together.wait();
                            assert!(!publish(&producer, n).overwrote);
                        }
                        // Its end would be an event of its own.
                        let begin = Instant::now();
                        while !done.load(Ordering::Relaxed) && begin.elapsed() < LONG {
                            sleep(MILLISECOND);
                        }
                    });
                }
            }
        };
        let (whole, given_up) = assemble(&folder, &mut start, &|whole| whole.last() == Some(&11));
        done.store(true, Ordering::Relaxed);
        assert_eq!((whole, given_up), ((0..12).collect(), Vec::new()));
    });
}

/// Counts the steps of a burst that overwrote an untaken one. The solver waits; its follower has found nothing new for longer than a silent follower is
/// waited for, and then takes its time for each step.
fn overwritten_after_a_quiet_time(folder: &Folder, follower: &mut dyn Follow) -> usize {
    let producer = Producer::open(&folder.0, description(4), 2, Policy::Wait(LONG)).unwrap();
    publish(&producer, 0);
    assert_eq!(events(follower, "step 0"), ["opened 4", "step 0 missed 0"]);
    assert_quiet(follower, Duration::from_secs(6));
    let burst = spawn(move || (1..=8).filter(|n| publish(&producer, *n).overwrote).count());
    for n in 1..=8 {
        sleep(Duration::from_millis(100));
        assert_eq!(events(follower, "step"), [format!("step {n} missed 0")]);
    }
    burst.join().unwrap()
}

#[test]
fn a_follower_that_found_nothing_new_for_long_is_waited_for() {
    let folder = Folder::new("idle");
    assert_eq!(overwritten_after_a_quiet_time(&folder, &mut follow(&folder)), 0);
}

#[test]
fn a_relay_that_found_nothing_new_for_long_is_waited_for() {
    let folder = Folder::new("idlerelay");
    let relay = Relay::start(&folder);
    assert_eq!(overwritten_after_a_quiet_time(&folder, &mut relay.follow(LONG)), 0);
}

#[test]
fn a_receiving_thread_that_panicked_is_told_and_its_blocks_end() {
    let folder = Folder::new("panicked");
    let relay = Relay::start(&folder);
    let (file, asked) = (relay.file.clone(), AtomicBool::new(false));
    let locate = move || {
        assert!(!asked.swap(true, Ordering::Relaxed), "called for a second time: this panic belongs to the test");
        Ok(file.clone())
    };
    let mut follower = RelayFollower::begin(Box::new(locate), Limits::default(), LONG).unwrap();
    let producer = open(&folder, 4);
    publish(&producer, 0);
    assert_eq!(events(&mut follower, "step 0"), ["opened 4", "step 0 missed 0"]);
    drop(relay);
    let seen = events(&mut follower, "ended");
    assert!(seen.len() == 3 && seen[1].contains("has panicked") && seen[2] == "ended false", "{seen:?}");
    assert!(follower.next(&mut Vec::new()).is_none());
}

#[test]
fn a_relay_takes_no_memory_without_bound() {
    let folder = Folder::new("large");
    let notices = Arc::new(Mutex::new(String::new()));
    let shared = notices.clone();
    let relay = Relay::start_at(&folder, "127.0.0.1:0", &Key::random().unwrap(), move |text| shared.lock().unwrap().push_str(&text));
    // A small block of 2000^3 nodes.
    let axis = |name| AxisDescription::uniform(name, "m", 0.0, 1.0, 2000);
    let mut large = Description::whole(Geometry::Cartesian, vec![axis("x"), axis("y"), axis("z")], "s");
    large.block = BlockExtent { index: 0, count: 8, offset: [0; 3], extent: [2; 3] };
    let _producer = Producer::open(&folder.0, large, 2, Policy::NewestWins).unwrap();
    let mut follower = follow_relay(&relay.file, Limits { step_bytes: u64::MAX }, LONG);
    let begin = Instant::now();
    while !notices.lock().unwrap().contains("96000000000 bytes; at most 17179869184 are allowed") {
        assert!(follower.next(&mut Vec::new()).is_none(), "the block was accepted");
        assert!(begin.elapsed() < LONG, "{}", notices.lock().unwrap());
    }
}

#[test]
fn a_follower_that_holds_is_not_cut_off_and_holds_the_solver() {
    let folder = Folder::new("holds");
    let relay = Relay::start(&folder);
    let producer = Producer::open(&folder.0, description(64), 2, Policy::Wait(LONG)).unwrap();
    let mut follower = relay.follow(LONG);
    publish(&producer, 0);
    assert_eq!(events(&mut follower, "step 0"), ["opened 64", "step 0 missed 0"]);
    let published = Arc::new(AtomicU64::new(0));
    let count = published.clone();
    let solver = spawn(move || {
        for n in 1..30 {
            publish(&producer, n);
            count.store(n, Ordering::Relaxed);
        }
        producer
    });
    // Longer than the relay's timeout, and than a producer waits for a silent follower.
    sleep(PEER_TIMEOUT + Duration::from_secs(2));
    let ahead = published.load(Ordering::Relaxed);
    assert!(ahead < 10, "{ahead} steps were published while the follower held");
    let seen = events(&mut follower, "step 29");
    assert_eq!(seen, (1..30).map(|n| format!("step {n} missed 0")).collect::<Vec<_>>());
    assert_eq!(relay.counts.accepted.load(Ordering::Relaxed), 1, "there was one connection");
    drop(solver.join().unwrap());
    assert_eq!(events(&mut follower, "ended"), ["ended true"]);
}

#[test]
fn a_pulse_is_no_answer_and_what_was_asked_is_not_asked_again() {
    const SENT: [Kind; 7] = [Kind::Pulse, Kind::Opened, Kind::Pulse, Kind::Pulse, Kind::Step, Kind::Pulse, Kind::Ended];
    // Sends all kinds of messages, and records the request before each and after the last.
    let (mut follower, relay) = scripted(|_, _, mut stream, mut session| {
        let mut asked = Vec::new();
        for kind in SENT {
            asked.push(read_ask(&mut stream, &mut session));
            let announced = (kind == Kind::Opened).then(|| description(2));
            let values: &[f32] = if kind == Kind::Step { &[0.0; 8] } else { &[] };
            session.send(&mut stream, &Facts { kind, ..PULSE }, announced.as_ref(), values).unwrap();
        }
        asked.push(read_ask(&mut stream, &mut session));
        asked
    });
    assert_eq!(events(&mut follower, "ended"), ["opened 2", "step 0 missed 0", "ended true"]);
    // The first request, then one after each answer; after a pulse a heartbeat.
    let expected = std::iter::once(Ask::Next).chain(SENT.map(|kind| if kind == Kind::Pulse { Ask::Hold } else { Ask::Next }));
    assert_eq!(relay.join().unwrap(), expected.collect::<Vec<_>>());
}

#[test]
fn a_ring_that_cannot_be_opened_is_told_of_once() {
    let folder = Folder::new("unopened");
    let producer = open(&folder, 4);
    let ring = block_path(&folder.0, 0);
    std::fs::remove_file(&ring).unwrap();
    std::fs::create_dir(&ring).unwrap();
    let mut follower = follow(&folder);
    let reported = events(&mut follower, "refused");
    assert!(reported.len() == 1 && reported[0].contains("block-00000.ring: cannot be opened"), "{reported:?}");
    assert_quiet(&mut follower, Duration::from_millis(300));
    drop((follower, producer));
}

/// Sends a step of 34 MB to a follower that reads so many bytes each 50 milliseconds.
fn dribble(relay: &Relay, folder: &Folder, bytes: usize) -> (Producer, JoinHandle<()>) {
    let producer = Producer::open(&folder.0, description(2048), 2, Policy::NewestWins).unwrap();
    publish(&producer, 0);
    let mut stream = TcpStream::connect(&relay.file.address).unwrap();
    let mut session = Session::connect(&mut stream, &relay.file.key).unwrap();
    session.ask(&mut stream, Ask::Next).unwrap();
    let mut note = |_: u32, announced: Option<Description>| announced.map(|announced| announced.block_bytes());
    let mut receive = || session.receive(&mut stream, &Limits::default(), &mut note, &mut Vec::new()).unwrap().kind;
    let opened = std::iter::repeat_with(&mut receive).find(|kind| *kind != Kind::Pulse);
    assert_eq!(opened, Some(Kind::Opened));
    session.ask(&mut stream, Ask::Next).unwrap();
    let reading = spawn(move || {
        let mut piece = vec![0; bytes];
        while stream.read_exact(&mut piece).is_ok() {
            sleep(50 * MILLISECOND);
        }
    });
    until(LONG, || relay.counts.steps.load(Ordering::Relaxed) > 0);
    (producer, reading)
}

#[test]
fn a_relay_that_is_told_to_stop_waits_for_no_slow_follower() {
    let folder = Folder::new("stop");
    let relay = Relay::start(&folder);
    // Half a minute for the step.
    let (producer, reading) = dribble(&relay, &folder, 1 << 16);
    sleep(Duration::from_millis(300));
    assert_eq!(relay.counts.followers.load(Ordering::Relaxed), 1);
    let begin = Instant::now();
    drop(relay);
    assert!(begin.elapsed() < Duration::from_secs(10), "{:?}", begin.elapsed());
    reading.join().unwrap();
    drop(producer);
}

#[test]
fn a_follower_that_dribbles_is_cut_off() {
    let folder = Folder::new("dribbles");
    let relay = Relay::start(&folder);
    // Half an hour for the step; a tenth of a piece within the timeout of a piece.
    let (producer, reading) = dribble(&relay, &folder, 1 << 10);
    until(10 * LONG, || relay.counts.followers.load(Ordering::Relaxed) == 0);
    drop((relay, producer));
    // The rest in the sockets' buffers is not waited for.
    drop(reading);
}

#[test]
fn a_relay_that_says_nothing_is_left_and_one_that_lives_is_waited_for() {
    let (mut follower, relay) = scripted(|key, listener, mut stream, mut session| {
        read_ask(&mut stream, &mut session);
        session.send(&mut stream, &Facts { kind: Kind::Opened, ..PULSE }, Some(&description(4)), &[]).unwrap();
        read_ask(&mut stream, &mut session);
        // As if it read a large step for longer than its follower's timeout.
        let begin = Instant::now();
        while begin.elapsed() < PEER_TIMEOUT + Duration::from_secs(1) {
            session.send(&mut stream, &PULSE, None, &[]).unwrap();
            sleep(Duration::from_millis(500));
        }
        session.send(&mut stream, &Facts { kind: Kind::Step, ..PULSE }, None, &[0.0; 32]).unwrap();
        // It is silent now, until the follower reconnects.
        let mut again = listener.accept().unwrap().0;
        Session::accept(&mut again, key).unwrap();
    });
    assert_eq!(events(&mut follower, "step 0"), ["opened 4", "step 0 missed 0"]);
    let reported = events(&mut follower, "refused");
    assert!(reported.len() == 1 && reported[0].contains("timed out"), "{reported:?}");
    relay.join().unwrap();
}

/// Block, step and missed steps of the first `enough` steps that are read, in three pieces each, and the number of pieces. `meanwhile` is called after each piece,
/// numbered from 1, and may overwrite the step or stop the read. At first there are two steps, in two slots.
fn read_in_pieces(
    name: &str,
    count: u32,
    enough: usize,
    meanwhile: &mut dyn FnMut(u32, &[Producer]) -> bool,
) -> (Vec<(u32, u64, u64)>, u32) {
    let folder = Folder::new(name);
    // 2.25 MiB a block: two pieces and a quarter.
    let blocks = if count == 1 { vec![description(544)] } else { columns(768, count) };
    let producers: Vec<Producer> =
        blocks.into_iter().map(|block| Producer::open(&folder.0, block, 2, Policy::NewestWins).unwrap()).collect();
    (0..2).for_each(|n| producers.iter().for_each(|producer| _ = publish(producer, n)));
    let mut follower = follow(&folder);
    let (mut values, mut seen, mut pieces, begin) = (Vec::new(), Vec::new(), 0, Instant::now());
    while seen.len() < enough {
        assert!(begin.elapsed() < LONG, "{seen:?}");
        let event = follower.poll_while(&mut values, &mut || {
            pieces += 1;
            meanwhile(pieces, &producers)
        });
        match event {
            Some(Event::Step { block, step, missed, .. }) => {
                assert!(values.iter().all(|v| *v == step as f32), "step {step} of block {block} is torn");
                seen.push((block, step, missed));
            }
            Some(Event::Refused(error)) => panic!("{error}"),
            _ => {}
        }
    }
    (seen, pieces)
}

#[test]
fn a_step_that_is_overwritten_between_its_pieces_is_left_there() {
    let mut overwrite = |piece: u32, producers: &[Producer]| {
        if piece == 2 {
            (2..4).for_each(|n| producers.iter().for_each(|producer| _ = publish(producer, n)));
        }
        true
    };
    // The newest step, after two useless pieces, then the next one.
    let mut one = |piece: u32, producers: &[Producer]| {
        overwrite(piece, producers);
        if piece == 5 {
            publish(&producers[0], 4);
        }
        true
    };
    assert_eq!(read_in_pieces("between-1", 1, 2, &mut one), (vec![(0, 3, 3), (0, 4, 0)], 2 + 3 + 3));
    // Several blocks behave like one.
    assert_eq!(read_in_pieces("between-2", 2, 2, &mut overwrite), (vec![(0, 3, 3), (1, 3, 3)], 2 + 2 * 3));
}

#[test]
fn a_step_whose_reading_was_broken_off_is_read_later() {
    let mut stop = |piece: u32, _: &[Producer]| piece != 2;
    assert_eq!(read_in_pieces("off-1", 1, 2, &mut stop), (vec![(0, 0, 0), (0, 1, 0)], 2 + 2 * 3));
    assert_eq!(read_in_pieces("off-2", 2, 4, &mut stop), (vec![(0, 0, 0), (1, 0, 0), (0, 1, 0), (1, 1, 0)], 2 + 4 * 3));
}

#[test]
fn producers_wait_while_a_step_is_read_slowly() {
    let folder = Folder::new("slowly");
    let mut follower = follow(&folder);
    // 16 MiB a block, in as many pieces.
    let solvers: Vec<_> = columns(2048, 2)
        .into_iter()
        .map(|block| {
            let producer = Producer::open(&folder.0, block, 2, Policy::Wait(10 * LONG)).unwrap();
            spawn(move || (0..5).for_each(|n| _ = publish(&producer, n)))
        })
        .collect();
    let (mut values, mut seen, begin) = (Vec::new(), BTreeMap::<u32, Vec<u64>>::new(), Instant::now());
    // Together longer than a producer waits for a silent follower.
    let mut pieces = 0;
    while seen.values().map(Vec::len).sum::<usize>() < 10 {
        assert!(begin.elapsed() < 10 * LONG, "{seen:?}");
        let event = follower.poll_while(&mut values, &mut || {
            pieces += 1;
            if pieces <= 8 {
                sleep(Duration::from_secs(1));
            }
            true
        });
        match event {
            Some(Event::Step { block, step, missed, .. }) => {
                assert_eq!(missed, 0, "before step {step} of block {block}");
                seen.entry(block).or_default().push(step);
            }
            Some(Event::Refused(error)) => panic!("{error}"),
            _ => {}
        }
    }
    assert!(pieces == 160 && seen.values().all(|steps| *steps == [0, 1, 2, 3, 4]), "{pieces} {seen:?}");
    solvers.into_iter().for_each(|solver| solver.join().unwrap());
}

#[test]
#[ignore = "takes 12 GB of memory"]
fn steps_of_two_gigabytes_arrive_over_one_connection() {
    let folder = Folder::new("gigabytes");
    let relay = Relay::start(&folder);
    let producer = Producer::open(&folder.0, description(16384), 2, Policy::Wait(20 * LONG)).unwrap();
    let mut follower = relay.follow(LONG);
    let solver = spawn(move || (0..4).for_each(|n| _ = publish(&producer, n)));
    let (mut values, mut steps, begin) = (Vec::new(), 0, Instant::now());
    while steps < 4 {
        // Memory that was never touched may be provided at 0.1 GB/s.
        assert!(begin.elapsed() < 20 * LONG, "{steps} steps came");
        match follower.poll(&mut values, Duration::from_millis(10)) {
            Some(Event::Step { step, missed, .. }) => {
                assert_eq!((step, missed, values.len()), (steps, 0, 1 << 29));
                assert!(values.iter().all(|v| *v == step as f32), "step {step}");
                steps += 1;
                println!("step {step} after {:?}", begin.elapsed());
            }
            Some(Event::Refused(error)) => panic!("{error}"),
            _ => {}
        }
    }
    assert_eq!(relay.counts.accepted.load(Ordering::Relaxed), 1);
    solver.join().unwrap();
}

#[test]
fn a_relay_tells_a_killed_solver_from_one_that_ended() {
    let folder = Folder::alone("lost");
    let relay = Relay::start(&folder);
    let mut follower = relay.follow(LONG);
    let child = doomed(&folder, 7);
    assert_eq!(events(&mut follower, "step 7"), ["opened 4", "step 7 missed 0"]);
    kill(child);
    assert_eq!(events(&mut follower, "ended"), ["ended false"]);
    let producer = open(&folder, 4);
    publish(&producer, 8);
    assert_eq!(events(&mut follower, "step 8"), ["opened 4", "step 8 missed 0"]);
    drop(producer);
    assert_eq!(events(&mut follower, "ended"), ["ended true"]);
}

#[test]
fn what_a_relay_no_longer_has_is_ended() {
    let folder = Folder::new("dying");
    let key = Key::random().unwrap();
    // A separate address, so that no other process gets the port meanwhile.
    let relay = Relay::start_at(&folder, "127.0.0.3:0", &key, |_| {});
    let address = relay.file.address.clone();
    let (mut follower, mut brief) = (relay.follow(LONG), relay.follow(Duration::from_millis(300)));
    let producer = open(&folder, 8);
    publish(&producer, 0);
    for follower in [&mut follower, &mut brief] {
        assert_eq!(events(follower, "step 0"), ["opened 8", "step 0 missed 0"]);
    }
    drop(relay);
    // The follower with the short limit ends the block, and opens it again when the relay is back.
    assert_eq!(events(&mut brief, "ended").last().unwrap(), "ended false");
    let relay = Relay::start_at(&folder, &address, &key, |_| {});
    let seen = events(&mut brief, "step 0");
    assert_eq!(seen[seen.len() - 2..], ["opened 8", "step 0 missed 0"], "{seen:?}");
    let seen = events(&mut follower, "step 0");
    assert!(seen.iter().all(|text| !text.starts_with("ended") && !text.starts_with("opened")), "{seen:?}");
    drop(relay);
    // The solver ends without a relay: the next relay does not have its block.
    drop(producer);
    let _relay = Relay::start_at(&folder, &address, &key, |_| {});
    assert_eq!(events(&mut follower, "ended").last().unwrap(), "ended false");
}

#[test]
fn a_relay_ships_steps_to_those_who_have_the_key() {
    let folder = Folder::new("relay");
    let key = Key::random().unwrap();
    let relay = Relay::start_at(&folder, "127.0.0.4:0", &key, |_| {});
    let address = relay.file.address.clone();
    let mut stranger = TcpStream::connect(&address).unwrap();
    assert!(matches!(Session::connect(&mut stranger, &Key::random().unwrap()), Err(WireError::Rejected)));
    let mut follower = relay.follow(LONG);
    let producer = open(&folder, 64);
    // One after another, so that none is overwritten.
    publish(&producer, 0);
    assert_eq!(events(&mut follower, "step 0"), ["opened 64", "step 0 missed 0"]);
    for n in 1..20 {
        publish(&producer, n);
        assert_eq!(events(&mut follower, "step"), [format!("step {n} missed 0")]);
    }
    // Far more than the ring and the connection hold: each step is seen or counted, and the newest is received.
    (20..2000).for_each(|n| _ = publish(&producer, n));
    let seen = events(&mut follower, "step 1999");
    let missed: usize = seen.iter().map(|text| text.rsplit(' ').next().unwrap().parse::<usize>().unwrap()).sum();
    assert_eq!(seen.len() + missed, 1980);
    drop(producer);
    assert_eq!(events(&mut follower, "ended"), ["ended true"]);
    let producer = open(&folder, 8);
    publish(&producer, 5);
    assert_eq!(events(&mut follower, "step 5"), ["opened 8", "step 5 missed 0"]);
    assert_eq!((relay.counts.accepted.load(Ordering::Relaxed), relay.counts.refused.load(Ordering::Relaxed)), (1, 1));
    drop(relay);
    // The relay comes back at its old address, and the follower reconnects.
    assert!(events(&mut follower, "refused").last().unwrap().starts_with("refused"));
    let _relay = Relay::start_at(&folder, &address, &key, |_| {});
    let seen = events(&mut follower, "step 5");
    assert_eq!(seen.last().unwrap(), "step 5 missed 0", "{seen:?}");
    publish(&producer, 6);
    assert_eq!(events(&mut follower, "step 6"), ["step 6 missed 0"]);
}
