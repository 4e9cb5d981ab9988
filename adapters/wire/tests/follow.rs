//! Followers of rings and relays: restarts, kills, several blocks, connections that break.

#![allow(clippy::unwrap_used, clippy::print_stdout)]

#[path = "support/folder.rs"]
mod folder;

use folder::Folder;
use ridgewatch_wire::message::{ASK_BYTES, Ask, ConnectionFile, Facts, Key, Kind, Session};
use ridgewatch_wire::relay::{RelayCounts, RelayFollower, serve};
use ridgewatch_wire::{
    Assembler, AxisDescription, BlockExtent, Description, Element, Event, Field, Geometry, Incomplete, Limits, Policy, Producer, Published,
    RingFollower, WireError,
};
use std::cell::Cell;
use std::collections::BTreeMap;
use std::io::{Read, Write};
use std::net::{TcpListener, TcpStream};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::{Duration, Instant};

fn description(nodes: u64) -> Description {
    let axis = |name| AxisDescription::uniform(name, "m", 0.0, 1.0, nodes);
    Description::whole(Geometry::Cartesian, vec![axis("x"), axis("y")], "s")
}

fn publish(producer: &Producer, step: u64) -> Published {
    let plane = vec![step as f32; producer.description().block_nodes() as usize];
    let pointers = [plane.as_ptr().cast::<u8>(); 2];
    // SAFETY: a value a node.
    unsafe { producer.publish(step, step as f64, &Field::packed(&pointers, Element::F32, producer.description().block.extent)).unwrap() }
}

/// Events in words, until `enough` or a minute went by.
fn events(poll: &mut dyn FnMut(&mut Vec<f32>) -> Option<Event>, enough: &str) -> Vec<String> {
    let (mut seen, mut values, begin) = (Vec::new(), Vec::new(), Instant::now());
    while begin.elapsed() < Duration::from_secs(60) {
        let words = match poll(&mut values) {
            Some(Event::Opened { description, .. }) => format!("opened {}", description.shape()[0]),
            Some(Event::Step { step, time, missed, .. }) => {
                assert!(time == step as f64 && values.iter().all(|v| *v == step as f32), "step {step}");
                format!("step {step} missed {missed}")
            }
            Some(Event::Ended { closed, .. }) => format!("ended {closed}"),
            Some(Event::Refused(error)) => format!("refused {error}"),
            None => {
                std::thread::sleep(Duration::from_millis(1));
                continue;
            }
        };
        let last = words.starts_with(enough);
        seen.push(words);
        if last {
            break;
        }
    }
    seen
}

#[test]
fn a_solver_that_ends_and_one_that_starts_anew_are_followed() {
    let folder = Folder::new("anew");
    let mut follower = RingFollower::begin(&folder.0, Limits::default()).unwrap();
    let mut poll = |values: &mut Vec<f32>| follower.poll(values);
    let producer = Producer::open(&folder.0, description(4), 4, Policy::NewestWins).unwrap();
    (0..3).for_each(|n| _ = publish(&producer, n));
    assert_eq!(events(&mut poll, "step 2"), ["opened 4", "step 0 missed 0", "step 1 missed 0", "step 2 missed 0"]);
    publish(&producer, 3);
    drop(producer);
    // Another grid, at once: what the first left is read first.
    let producer = Producer::open(&folder.0, description(5), 4, Policy::NewestWins).unwrap();
    publish(&producer, 0);
    assert_eq!(events(&mut poll, "step 0"), ["step 3 missed 0", "ended true", "opened 5", "step 0 missed 0"]);
    drop(producer);
    assert_eq!(events(&mut poll, "ended"), ["ended true"]);
    drop(follower);
    assert!(!folder.0.exists());
}

/// A child that publishes one step and waits to be killed.
fn doomed(folder: &Folder, step: u64) -> libc::pid_t {
    // SAFETY: the child makes a producer and waits to be killed; no other thread of it is needed.
    let child = unsafe { libc::fork() };
    if child == 0 {
        let producer = Producer::open(&folder.0, description(4), 4, Policy::NewestWins).unwrap();
        publish(&producer, step);
        loop {
            std::thread::sleep(Duration::from_secs(1));
        }
    }
    child
}

fn kill(child: libc::pid_t) {
    let mut status = 0;
    // SAFETY: that child.
    unsafe {
        libc::kill(child, libc::SIGKILL);
        libc::waitpid(child, &mut status, 0);
    }
}

#[test]
fn a_killed_solver_is_noticed_and_its_ring_is_no_news_to_others() {
    let folder = Folder::alone("killed");
    let mut follower = RingFollower::begin(&folder.0, Limits::default()).unwrap();
    let mut poll = |values: &mut Vec<f32>| follower.poll(values);
    let killed = || {
        // SAFETY: the child makes a producer and is killed in it; no other thread of it is needed.
        let child = unsafe { libc::fork() };
        if child == 0 {
            let producer = Producer::open(&folder.0, description(4), 4, Policy::NewestWins).unwrap();
            publish(&producer, 7);
            // SAFETY: as a machine that runs out of memory does it.
            unsafe { libc::kill(libc::getpid(), libc::SIGKILL) };
        }
        let mut status = 0;
        // SAFETY: waits for that child.
        unsafe { libc::waitpid(child, &mut status, 0) };
        assert!(libc::WIFSIGNALED(status));
    };
    let producer = Producer::open(&folder.0, description(4), 4, Policy::NewestWins).unwrap();
    publish(&producer, 1);
    assert_eq!(events(&mut poll, "step 1").len(), 2);
    drop(producer);
    assert_eq!(events(&mut poll, "ended"), ["ended true"]);
    killed();
    // It was dead before it was seen: its ring is what a killed run left.
    let begin = Instant::now();
    while begin.elapsed() < Duration::from_secs(1) {
        assert!(poll(&mut Vec::new()).is_none(), "it is no news");
    }
    // A new one takes its place.
    let producer = Producer::open(&folder.0, description(4), 4, Policy::NewestWins).unwrap();
    publish(&producer, 2);
    assert_eq!(events(&mut poll, "step 2"), ["opened 4", "step 2 missed 0"]);
}

#[test]
fn a_solver_that_is_killed_and_replaced_at_once_is_followed() {
    let folder = Folder::alone("replaced");
    let mut follower = RingFollower::begin(&folder.0, Limits::default()).unwrap();
    let mut poll = |values: &mut Vec<f32>| follower.poll(values);
    for round in 0..5 {
        let child = doomed(&folder, 10 * round);
        let seen = events(&mut poll, &format!("step {}", 10 * round));
        assert_eq!(seen.last().unwrap(), &format!("step {} missed 0", 10 * round), "{seen:?}");
        kill(child);
        // Before the follower has had time to look.
        let producer = Producer::open(&folder.0, description(4), 4, Policy::NewestWins).unwrap();
        publish(&producer, 10 * round + 1);
        assert_eq!(events(&mut poll, "step"), ["ended false".to_owned(), "opened 4".into(), format!("step {} missed 0", 10 * round + 1)]);
        drop(producer);
        assert_eq!(events(&mut poll, "ended"), ["ended true"]);
    }
}

/// A relay of a folder's rings, and the way to it.
struct Relay {
    address: std::net::SocketAddr,
    key: Key,
    counts: Arc<RelayCounts>,
    stop: Arc<AtomicBool>,
    thread: Option<std::thread::JoinHandle<()>>,
}

impl Relay {
    fn start(folder: &Folder, address: &str, key: &Key) -> Self {
        let listener = TcpListener::bind(address).unwrap();
        let address = listener.local_addr().unwrap();
        let (counts, stop) = (Arc::new(RelayCounts::default()), Arc::new(AtomicBool::new(false)));
        let (ring, key, told, flag) = (folder.0.clone(), key.clone(), counts.clone(), stop.clone());
        let served = key.clone();
        let thread = std::thread::spawn(move || serve(&ring, &listener, &served, &told, &flag, Arc::new(|_| {})).unwrap());
        Self { address, key, counts, stop, thread: Some(thread) }
    }

    fn follow(&self, gone: Duration) -> RelayFollower {
        let file = ConnectionFile { address: self.address.to_string(), key: self.key.clone() };
        RelayFollower::begin(Box::new(move || Ok(file.clone())), Limits::default(), gone).unwrap()
    }
}

impl Drop for Relay {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        self.thread.take().unwrap().join().unwrap();
    }
}

const LONG: Duration = Duration::from_secs(30);

#[test]
fn a_ring_that_lies_is_left_until_a_new_one_comes() {
    let folder = Folder::new("lies");
    let mut follower = RingFollower::begin(&folder.0, Limits::default()).unwrap();
    let mut poll = |values: &mut Vec<f32>| follower.poll(values);
    let producer = Producer::open(&folder.0, description(4), 4, Policy::NewestWins).unwrap();
    publish(&producer, 1);
    assert_eq!(events(&mut poll, "step 1"), ["opened 4", "step 1 missed 0"]);
    publish(&producer, 2);
    // The time of the second step is no number any more: the first slot begins behind a description of less than a page.
    let ring = std::fs::OpenOptions::new().write(true).open(ridgewatch_wire::block_path(&folder.0, 0)).unwrap();
    std::os::unix::fs::FileExt::write_all_at(&ring, &f64::NAN.to_ne_bytes(), 12288 + 4096 + 16).unwrap();
    assert_eq!(events(&mut poll, "refused"), ["refused `time` is NaN; accepted: a finite number"]);
    // Neither opened nor refused again; its end is told.
    (3..6).for_each(|n| _ = publish(&producer, n));
    let begin = Instant::now();
    while begin.elapsed() < Duration::from_millis(500) {
        assert!(poll(&mut Vec::new()).is_none());
    }
    drop(producer);
    assert_eq!(events(&mut poll, "ended"), ["ended false"]);
    let producer = Producer::open(&folder.0, description(4), 4, Policy::NewestWins).unwrap();
    publish(&producer, 7);
    assert_eq!(events(&mut poll, "step 7"), ["opened 4", "step 7 missed 0"]);
}

#[test]
fn strangers_take_no_followers_place() {
    let folder = Folder::new("strangers");
    let relay = Relay::start(&folder, "127.0.0.1:0", &Key::random().unwrap());
    let producer = Producer::open(&folder.0, description(8), 4, Policy::NewestWins).unwrap();
    publish(&producer, 0);
    let waited = || {
        // They come and say nothing.
        let strangers: Vec<TcpStream> = (0..100).map(|_| TcpStream::connect(relay.address).unwrap()).collect();
        let begin = Instant::now();
        let mut follower = relay.follow(LONG);
        let seen = events(&mut |values| follower.poll(values, Duration::from_millis(10)), "step 0");
        assert_eq!(seen.last().unwrap(), "step 0 missed 0", "{seen:?}");
        let waited = begin.elapsed();
        assert!(relay.counts.followers.load(Ordering::Relaxed) >= 1);
        drop(strangers);
        waited
    };
    // Well before the first of them has used up its time; a machine may have stood still once.
    let waits: Vec<Duration> = (0..3).map(|_| waited()).take_while(|waited| *waited > Duration::from_secs(4)).collect();
    assert!(waits.len() < 3, "{waits:?}");
}

#[test]
fn a_follower_for_whom_there_is_no_place_is_told_so_once_and_comes_in_when_there_is() {
    let folder = Folder::new("places");
    let relay = Relay::start(&folder, "127.0.0.1:0", &Key::random().unwrap());
    let producer = Producer::open(&folder.0, description(4), 4, Policy::NewestWins).unwrap();
    publish(&producer, 0);
    let wait = |count: &AtomicU64, enough: u64| {
        let begin = Instant::now();
        while count.load(Ordering::Relaxed) < enough {
            assert!(begin.elapsed() < LONG, "{} of {enough}", count.load(Ordering::Relaxed));
            std::thread::sleep(Duration::from_millis(1));
        }
    };
    let mut followers: Vec<RelayFollower> = (0..16).map(|_| relay.follow(LONG)).collect();
    wait(&relay.counts.accepted, 16);
    let mut late = relay.follow(LONG);
    // It tries again and again.
    wait(&relay.counts.refused, 3);
    followers.pop();
    let seen = events(&mut |values| late.poll(values, Duration::from_millis(10)), "step 0");
    assert_eq!(seen, [&format!("refused {}", WireError::SentAway), "opened 4", "step 0 missed 0"]);
    assert_eq!(relay.counts.accepted.load(Ordering::Relaxed), 17);
}

/// Lets this process open no file any more; what it was let before.
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
    let producer = Producer::open(&folder.0, description(4), 4, Policy::NewestWins).unwrap();
    publish(&producer, 0);
    let (mut heard, mut says) = std::io::pipe().unwrap();
    let follow = || {
        let mut follower = RingFollower::begin(&folder.0, Limits::default()).unwrap();
        let mut poll = |values: &mut Vec<f32>| follower.poll(values);
        assert_eq!(events(&mut poll, "step 0"), ["opened 4", "step 0 missed 0"]);
        let before = exhaust_descriptors();
        assert!(ridgewatch_wire::producer_lives(&folder.0, 0).is_err());
        let (mut seen, begin) = (Vec::new(), Instant::now());
        // Told once, and not again for a while.
        while seen.is_empty() && begin.elapsed() < LONG {
            seen.extend(poll(&mut Vec::new()));
        }
        let begin = Instant::now();
        while begin.elapsed() < Duration::from_millis(500) {
            seen.extend(poll(&mut Vec::new()));
        }
        // SAFETY: the limit outlives the call.
        assert_eq!(unsafe { libc::setrlimit(libc::RLIMIT_NOFILE, &before) }, 0);
        assert!(matches!(seen[..], [Event::Refused(_)]), "{seen:?}");
        says.write_all(&[1]).unwrap();
        assert_eq!(events(&mut poll, "step 1"), ["step 1 missed 0"]);
    };
    // SAFETY: no other test runs meanwhile, and no other thread of the child is needed.
    let child = unsafe { libc::fork() };
    if child == 0 {
        let passed = std::panic::catch_unwind(std::panic::AssertUnwindSafe(follow)).is_ok();
        // SAFETY: ends the child, without what the tests would do at their end.
        unsafe { libc::_exit(i32::from(!passed)) };
    }
    drop(says);
    // None comes where the child has failed.
    let _ = heard.read(&mut [0]);
    publish(&producer, 1);
    let mut status = -1;
    // SAFETY: waits for that child.
    unsafe { libc::waitpid(child, &mut status, 0) };
    assert_eq!(status, 0);
}

#[test]
fn two_followers_of_a_relay_lose_nothing_of_a_solver_that_waits() {
    let folder = Folder::new("two");
    let relay = Relay::start(&folder, "127.0.0.1:0", &Key::random().unwrap());
    let producer = Producer::open(&folder.0, description(64), 4, Policy::Wait(LONG)).unwrap();
    let took = Arc::new(AtomicU64::new(0));
    let followers: Vec<_> = [0, 2]
        .map(|pause| {
            let (mut follower, took) = (relay.follow(LONG), took.clone());
            std::thread::spawn(move || {
                let mut poll = |values: &mut Vec<f32>| {
                    std::thread::sleep(Duration::from_millis(pause));
                    let event = follower.poll(values, Duration::from_millis(10));
                    took.fetch_add(u64::from(matches!(event, Some(Event::Step { step: 0, .. }))), Ordering::Relaxed);
                    event
                };
                events(&mut poll, "step 199")
            })
        })
        .into();
    // Both are there before the ring has turned once.
    publish(&producer, 0);
    let begin = Instant::now();
    while took.load(Ordering::Relaxed) < 2 {
        assert!(begin.elapsed() < LONG);
        std::thread::sleep(Duration::from_millis(1));
    }
    (1..200).for_each(|n| _ = publish(&producer, n));
    let expected: Vec<String> = ["opened 64".to_owned()].into_iter().chain((0..200).map(|n| format!("step {n} missed 0"))).collect();
    for follower in followers {
        assert_eq!(follower.join().unwrap(), expected);
    }
}

/// Columns of a grid, as many as told.
fn columns(nodes: u64, count: u32) -> Vec<Description> {
    let width = nodes / u64::from(count);
    let block = |index: u32| BlockExtent { index, count, offset: [width * u64::from(index), 0, 0], extent: [width, nodes, 1] };
    (0..count).map(|index| Description { start: 1, block: block(index), ..description(nodes) }).collect()
}

/// Follows until `enough` says so of the whole steps, whose values are the step's number. After each look `meanwhile` hears whether a block came.
fn assemble(folder: &Folder, meanwhile: &mut dyn FnMut(bool), enough: &dyn Fn(&[u64]) -> bool) -> (Vec<u64>, Vec<Incomplete>) {
    let mut follower = RingFollower::begin(&folder.0, Limits::default()).unwrap();
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
        // While a field is read, in however many blocks, 8/3 steps are published; where nothing was there to be read, the next one.
        let (published, mut due) = (Cell::new(0), 0);
        let mut solve = |block_came: bool| {
            due += if block_came { 8 } else { 3 * count };
            while due >= 3 * count {
                producers.iter().for_each(|producer| _ = publish(producer, published.get()));
                (due, _) = (due - 3 * count, published.replace(published.get() + 1));
            }
        };
        // While the solver runs: what is in the rings at last is no news.
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
                std::thread::sleep(Duration::from_millis(200) * n as u32);
                (0..40).for_each(|n| assert!(!publish(producer, n).overwrote));
            });
        }
        let mut rest = |block_came: bool| std::thread::sleep(Duration::from_micros(if block_came { 0 } else { 100 }));
        let (whole, given_up) = assemble(&folder, &mut rest, &|whole| whole.len() == 40);
        assert_eq!((whole, given_up), ((0..40).collect(), Vec::new()));
    });
}

/// Steps of a burst that overwrote one that was not taken. The solver waits; whoever follows it has found nothing new for longer than a silent
/// follower is waited for, and then takes its time for each step.
fn overwritten_after_a_quiet_time(folder: &Folder, poll: &mut dyn FnMut(&mut Vec<f32>) -> Option<Event>) -> usize {
    let producer = Producer::open(&folder.0, description(4), 2, Policy::Wait(LONG)).unwrap();
    publish(&producer, 0);
    assert_eq!(events(poll, "step 0"), ["opened 4", "step 0 missed 0"]);
    let begin = Instant::now();
    while begin.elapsed() < Duration::from_secs(6) {
        assert!(poll(&mut Vec::new()).is_none());
        std::thread::sleep(Duration::from_millis(1));
    }
    let burst = std::thread::spawn(move || (1..=8).filter(|n| publish(&producer, *n).overwrote).count());
    for n in 1..=8 {
        std::thread::sleep(Duration::from_millis(100));
        assert_eq!(events(poll, "step"), [format!("step {n} missed 0")]);
    }
    burst.join().unwrap()
}

#[test]
fn a_follower_that_found_nothing_new_for_long_is_waited_for() {
    let folder = Folder::new("idle");
    let mut follower = RingFollower::begin(&folder.0, Limits::default()).unwrap();
    assert_eq!(overwritten_after_a_quiet_time(&folder, &mut |values| follower.poll(values)), 0);
}

#[test]
fn a_relay_that_found_nothing_new_for_long_is_waited_for() {
    let folder = Folder::new("idlerelay");
    let relay = Relay::start(&folder, "127.0.0.1:0", &Key::random().unwrap());
    let mut follower = relay.follow(LONG);
    assert_eq!(overwritten_after_a_quiet_time(&folder, &mut |values| follower.poll(values, Duration::from_millis(10))), 0);
}

#[test]
fn a_receiving_thread_that_panicked_is_told_and_its_blocks_end() {
    let folder = Folder::new("panicked");
    let relay = Relay::start(&folder, "127.0.0.1:0", &Key::random().unwrap());
    let file = ConnectionFile { address: relay.address.to_string(), key: relay.key.clone() };
    let asked = AtomicBool::new(false);
    let place = move || {
        assert!(!asked.swap(true, Ordering::Relaxed), "asked for a second time: this panic is the test's");
        Ok(file.clone())
    };
    let mut follower = RelayFollower::begin(Box::new(place), Limits::default(), LONG).unwrap();
    let mut poll = |values: &mut Vec<f32>| follower.poll(values, Duration::from_millis(10));
    let producer = Producer::open(&folder.0, description(4), 4, Policy::NewestWins).unwrap();
    publish(&producer, 0);
    assert_eq!(events(&mut poll, "step 0"), ["opened 4", "step 0 missed 0"]);
    drop(relay);
    let seen = events(&mut poll, "ended");
    assert!(seen.len() == 3 && seen[1].contains("has panicked") && seen[2] == "ended false", "{seen:?}");
    assert!(poll(&mut Vec::new()).is_none());
}

#[test]
fn a_relay_takes_no_memory_without_bound() {
    let folder = Folder::new("large");
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let file = ConnectionFile { address: listener.local_addr().unwrap().to_string(), key: Key::random().unwrap() };
    let (heard, stop) = (Arc::new(std::sync::Mutex::new(String::new())), Arc::new(AtomicBool::new(false)));
    let relay = {
        let (ring, key, hears, stop) = (folder.0.clone(), file.key.clone(), heard.clone(), stop.clone());
        let tell = Arc::new(move |words: String| hears.lock().unwrap().push_str(&words));
        std::thread::spawn(move || serve(&ring, &listener, &key, &Arc::default(), &stop, tell).unwrap())
    };
    // A small block of 2000^3 nodes.
    let axis = |name| AxisDescription::uniform(name, "m", 0.0, 1.0, 2000);
    let mut large = Description::whole(Geometry::Cartesian, vec![axis("x"), axis("y"), axis("z")], "s");
    large.block = ridgewatch_wire::BlockExtent { index: 0, count: 8, offset: [0; 3], extent: [2; 3] };
    let producer = Producer::open(&folder.0, large, 2, Policy::NewestWins).unwrap();
    let limits = Limits { step_bytes: u64::MAX };
    let mut follower = RelayFollower::begin(Box::new(move || Ok(file.clone())), limits, LONG).unwrap();
    let begin = Instant::now();
    while !heard.lock().unwrap().contains("96000000000 bytes; at most 17179869184 are allowed") {
        assert!(follower.poll(&mut Vec::new(), Duration::from_millis(10)).is_none(), "it was let through");
        assert!(begin.elapsed() < LONG, "{}", heard.lock().unwrap());
    }
    stop.store(true, Ordering::Relaxed);
    relay.join().unwrap();
    drop(producer);
}

#[test]
fn a_follower_that_holds_is_not_cut_off_and_holds_the_solver() {
    let folder = Folder::new("holds");
    let relay = Relay::start(&folder, "127.0.0.1:0", &Key::random().unwrap());
    let producer = Producer::open(&folder.0, description(64), 2, Policy::Wait(LONG)).unwrap();
    let mut follower = relay.follow(LONG);
    let mut poll = |values: &mut Vec<f32>| follower.poll(values, Duration::from_millis(10));
    publish(&producer, 0);
    assert_eq!(events(&mut poll, "step 0"), ["opened 64", "step 0 missed 0"]);
    let published = Arc::new(AtomicU64::new(0));
    let count = published.clone();
    let solver = std::thread::spawn(move || {
        for n in 1..30 {
            publish(&producer, n);
            count.store(n, Ordering::Relaxed);
        }
        producer
    });
    // Longer than the relay's patience, and than a producer waits for one that it does not hear of.
    std::thread::sleep(ridgewatch_wire::relay::PATIENCE + Duration::from_secs(2));
    let ahead = published.load(Ordering::Relaxed);
    assert!(ahead < 10, "{ahead} steps were published while the follower held");
    let seen = events(&mut poll, "step 29");
    assert_eq!(seen, (1..30).map(|n| format!("step {n} missed 0")).collect::<Vec<_>>());
    assert_eq!(relay.counts.accepted.load(Ordering::Relaxed), 1, "one connection all the while");
    drop(solver.join().unwrap());
    assert_eq!(events(&mut poll, "ended"), ["ended true"]);
}

#[test]
fn a_pulse_is_no_answer_and_what_was_asked_is_not_asked_again() {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let key = Key::random().unwrap();
    let file = ConnectionFile { address: listener.local_addr().unwrap().to_string(), key: key.clone() };
    let mut follower = RelayFollower::begin(Box::new(move || Ok(file.clone())), Limits::default(), LONG).unwrap();
    const SENT: [Kind; 7] = [Kind::Pulse, Kind::Opened, Kind::Pulse, Kind::Pulse, Kind::Step, Kind::Pulse, Kind::Ended];
    // Says all that a relay may say, and notes what it is asked before each and at last.
    let relay = std::thread::spawn(move || {
        let mut stream = listener.accept().unwrap().0;
        stream.set_read_timeout(Some(LONG)).unwrap();
        let mut session = Session::accept(&mut stream, &key).unwrap();
        let quiet = Facts { kind: Kind::Pulse, block: 0, generation: 1, step: 0, time: 0.0, published: 0, missed: 0 };
        let mut asked = Vec::new();
        for answer in SENT.map(Some).into_iter().chain([None]) {
            let mut bytes = [0; ASK_BYTES];
            stream.read_exact(&mut bytes).unwrap();
            asked.push(session.check_ask(&bytes).unwrap());
            let Some(kind) = answer else { break };
            let announced = (kind == Kind::Opened).then(|| description(2));
            let values: &[f32] = if kind == Kind::Step { &[0.0; 8] } else { &[] };
            session.send(&mut stream, &Facts { kind, ..quiet }, announced.as_ref(), values).unwrap();
        }
        asked
    });
    let mut poll = |values: &mut Vec<f32>| follower.poll(values, Duration::from_millis(10));
    assert_eq!(events(&mut poll, "ended"), ["opened 2", "step 0 missed 0", "ended true"]);
    // The first, then one after each answer; after a pulse that the follower lives.
    let expected = std::iter::once(Ask::Next).chain(SENT.map(|kind| if kind == Kind::Pulse { Ask::Hold } else { Ask::Next }));
    assert_eq!(relay.join().unwrap(), expected.collect::<Vec<_>>());
}

#[test]
fn a_ring_that_cannot_be_opened_is_told_of_once() {
    let folder = Folder::new("unopened");
    let producer = Producer::open(&folder.0, description(4), 2, Policy::NewestWins).unwrap();
    let ring = folder.0.join("block-00000.ring");
    std::fs::remove_file(&ring).unwrap();
    std::fs::create_dir(&ring).unwrap();
    let mut follower = RingFollower::begin(&folder.0, Limits::default()).unwrap();
    let mut poll = |values: &mut Vec<f32>| follower.poll(values);
    let told = events(&mut poll, "refused");
    assert!(told.len() == 1 && told[0].contains("block-00000.ring: cannot be opened"), "{told:?}");
    let begin = Instant::now();
    while begin.elapsed() < Duration::from_millis(300) {
        assert!(poll(&mut Vec::new()).is_none(), "it is no news");
    }
    drop((follower, producer));
}

/// A step of 34 MB on its way to a follower that reads so many bytes each 50 milliseconds.
fn dribble(relay: &Relay, folder: &Folder, bytes: usize) -> (Producer, std::thread::JoinHandle<()>) {
    let producer = Producer::open(&folder.0, description(2048), 2, Policy::NewestWins).unwrap();
    publish(&producer, 0);
    let mut stream = TcpStream::connect(relay.address).unwrap();
    let mut session = Session::connect(&mut stream, &relay.key).unwrap();
    session.ask(&mut stream, Ask::Next).unwrap();
    let mut note = |_: u32, announced: Option<Description>| announced.map(|announced| announced.block_bytes());
    let mut receive = || session.receive(&mut stream, &Limits::default(), &mut note, &mut Vec::new()).unwrap().kind;
    let opened = std::iter::repeat_with(&mut receive).find(|kind| *kind != Kind::Pulse);
    assert_eq!(opened, Some(Kind::Opened));
    session.ask(&mut stream, Ask::Next).unwrap();
    let reading = std::thread::spawn(move || {
        let mut piece = vec![0; bytes];
        while stream.read_exact(&mut piece).is_ok() {
            std::thread::sleep(Duration::from_millis(50));
        }
    });
    let begin = Instant::now();
    while relay.counts.steps.load(Ordering::Relaxed) == 0 {
        assert!(begin.elapsed() < LONG);
        std::thread::sleep(Duration::from_millis(1));
    }
    (producer, reading)
}

#[test]
fn a_relay_that_is_told_to_stop_waits_for_no_slow_follower() {
    let folder = Folder::new("stop");
    let relay = Relay::start(&folder, "127.0.0.1:0", &Key::random().unwrap());
    // Half a minute for the step.
    let (producer, reading) = dribble(&relay, &folder, 1 << 16);
    std::thread::sleep(Duration::from_millis(300));
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
    let relay = Relay::start(&folder, "127.0.0.1:0", &Key::random().unwrap());
    // Half an hour for the step; a tenth of a piece while a piece is waited for.
    let (producer, reading) = dribble(&relay, &folder, 1 << 10);
    let begin = Instant::now();
    while relay.counts.followers.load(Ordering::Relaxed) > 0 {
        assert!(begin.elapsed() < 10 * LONG, "it is still there");
        std::thread::sleep(Duration::from_millis(10));
    }
    drop((relay, producer));
    // What was in the sockets' memory is not waited for.
    drop(reading);
}

#[test]
fn a_relay_that_says_nothing_is_left_and_one_that_lives_is_waited_for() {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let key = Key::random().unwrap();
    let file = ConnectionFile { address: listener.local_addr().unwrap().to_string(), key: key.clone() };
    let mut follower = RelayFollower::begin(Box::new(move || Ok(file.clone())), Limits::default(), LONG).unwrap();
    let relay = std::thread::spawn(move || {
        let mut stream = listener.accept().unwrap().0;
        let mut session = Session::accept(&mut stream, &key).unwrap();
        let quiet = Facts { kind: Kind::Pulse, block: 0, generation: 1, step: 0, time: 0.0, published: 0, missed: 0 };
        let mut asked = [0; ASK_BYTES];
        stream.read_exact(&mut asked).unwrap();
        session.send(&mut stream, &Facts { kind: Kind::Opened, ..quiet }, Some(&description(4)), &[]).unwrap();
        stream.read_exact(&mut asked).unwrap();
        // As if it read a large step for longer than its follower's patience.
        let begin = Instant::now();
        while begin.elapsed() < ridgewatch_wire::relay::PATIENCE + Duration::from_secs(1) {
            session.send(&mut stream, &quiet, None, &[]).unwrap();
            std::thread::sleep(Duration::from_millis(500));
        }
        session.send(&mut stream, &Facts { kind: Kind::Step, ..quiet }, None, &[0.0; 32]).unwrap();
        // Nothing any more, until the follower comes anew.
        let mut again = listener.accept().unwrap().0;
        Session::accept(&mut again, &key).unwrap();
    });
    let mut poll = |values: &mut Vec<f32>| follower.poll(values, Duration::from_millis(10));
    assert_eq!(events(&mut poll, "step 0"), ["opened 4", "step 0 missed 0"]);
    let told = events(&mut poll, "refused");
    assert!(told.len() == 1 && told[0].contains("timed out"), "{told:?}");
    relay.join().unwrap();
}

/// Block, step and missed ones of the first so many steps of blocks that are read, in three pieces each, and the pieces that this took. `meanwhile` hears
/// of each, numbered from 1, and may overwrite the step or break off. Two steps are there at first, in two slots.
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
    let mut follower = RingFollower::begin(&folder.0, Limits::default()).unwrap();
    let (mut values, mut seen, mut pieces, begin) = (Vec::new(), Vec::new(), 0, Instant::now());
    while seen.len() < enough {
        assert!(begin.elapsed() < LONG, "{seen:?}");
        let event = follower.poll_beside(&mut values, &mut || {
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
    // The newest, after two pieces for nothing; then what comes.
    let mut one = |piece: u32, producers: &[Producer]| {
        overwrite(piece, producers);
        if piece == 5 {
            publish(&producers[0], 4);
        }
        true
    };
    assert_eq!(read_in_pieces("between-1", 1, 2, &mut one), (vec![(0, 3, 3), (0, 4, 0)], 2 + 3 + 3));
    // Of several blocks as of one.
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
    let mut follower = RingFollower::begin(&folder.0, Limits::default()).unwrap();
    // 16 MiB a block, in as many pieces.
    let solvers: Vec<_> = columns(2048, 2)
        .into_iter()
        .map(|block| {
            let producer = Producer::open(&folder.0, block, 2, Policy::Wait(10 * LONG)).unwrap();
            std::thread::spawn(move || (0..5).for_each(|n| _ = publish(&producer, n)))
        })
        .collect();
    let (mut values, mut seen, begin) = (Vec::new(), BTreeMap::<u32, Vec<u64>>::new(), Instant::now());
    // Together longer than a producer waits for one that it does not hear of.
    let mut pieces = 0;
    while seen.values().map(Vec::len).sum::<usize>() < 10 {
        assert!(begin.elapsed() < 10 * LONG, "{seen:?}");
        let event = follower.poll_beside(&mut values, &mut || {
            pieces += 1;
            if pieces <= 8 {
                std::thread::sleep(Duration::from_secs(1));
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
    let relay = Relay::start(&folder, "127.0.0.1:0", &Key::random().unwrap());
    let producer = Producer::open(&folder.0, description(16384), 2, Policy::Wait(20 * LONG)).unwrap();
    let mut follower = relay.follow(LONG);
    let solver = std::thread::spawn(move || (0..4).for_each(|n| _ = publish(&producer, n)));
    let (mut values, mut steps, begin) = (Vec::new(), 0, Instant::now());
    while steps < 4 {
        // Memory that was never touched may come at a tenth of a gigabyte a second.
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
    let relay = Relay::start(&folder, "127.0.0.1:0", &Key::random().unwrap());
    let mut follower = relay.follow(LONG);
    let mut poll = |values: &mut Vec<f32>| follower.poll(values, Duration::from_millis(10));
    let child = doomed(&folder, 7);
    assert_eq!(events(&mut poll, "step 7"), ["opened 4", "step 7 missed 0"]);
    kill(child);
    assert_eq!(events(&mut poll, "ended"), ["ended false"]);
    let producer = Producer::open(&folder.0, description(4), 4, Policy::NewestWins).unwrap();
    publish(&producer, 8);
    assert_eq!(events(&mut poll, "step 8"), ["opened 4", "step 8 missed 0"]);
    drop(producer);
    assert_eq!(events(&mut poll, "ended"), ["ended true"]);
}

#[test]
fn what_a_relay_no_longer_has_is_ended() {
    let folder = Folder::new("dying");
    let key = Key::random().unwrap();
    // An address of its own, so that nobody else gets the port meanwhile.
    let relay = Relay::start(&folder, "127.0.0.3:0", &key);
    let address = relay.address.to_string();
    let mut follower = relay.follow(LONG);
    let mut brief = relay.follow(Duration::from_millis(300));
    let mut poll = |values: &mut Vec<f32>| follower.poll(values, Duration::from_millis(10));
    let mut poll_brief = |values: &mut Vec<f32>| brief.poll(values, Duration::from_millis(10));
    let producer = Producer::open(&folder.0, description(8), 4, Policy::NewestWins).unwrap();
    publish(&producer, 0);
    for poll in [&mut poll as &mut dyn FnMut(&mut Vec<f32>) -> Option<Event>, &mut poll_brief] {
        assert_eq!(events(poll, "step 0"), ["opened 8", "step 0 missed 0"]);
    }
    drop(relay);
    // Whoever has no patience takes the solver for ended, and hears of it when the relay is back.
    assert_eq!(events(&mut poll_brief, "ended").last().unwrap(), "ended false");
    let relay = Relay::start(&folder, &address, &key);
    let seen = events(&mut poll_brief, "step 0");
    assert_eq!(seen[seen.len() - 2..], ["opened 8", "step 0 missed 0"], "{seen:?}");
    let seen = events(&mut poll, "step 0");
    assert!(seen.iter().all(|words| !words.starts_with("ended") && !words.starts_with("opened")), "{seen:?}");
    drop(relay);
    // The solver ends while no relay is there: the next one has nothing of it.
    drop(producer);
    let relay = Relay::start(&folder, &address, &key);
    assert_eq!(events(&mut poll, "ended").last().unwrap(), "ended false");
    drop(relay);
}

#[test]
fn a_relay_ships_steps_to_those_who_have_the_key() {
    let folder = Folder::new("relay");
    let listener = TcpListener::bind("127.0.0.4:0").unwrap();
    let address = listener.local_addr().unwrap();
    let (key, counts, stop) = (Key::random().unwrap(), Arc::new(RelayCounts::default()), Arc::new(AtomicBool::new(false)));
    let relay = {
        let (ring, key, counts, stop) = (folder.0.clone(), key.clone(), counts.clone(), stop.clone());
        std::thread::spawn(move || serve(&ring, &listener, &key, &counts, &stop, Arc::new(|_| {})).unwrap())
    };
    let mut stranger = TcpStream::connect(address).unwrap();
    assert!(matches!(Session::connect(&mut stranger, &Key::random().unwrap()), Err(WireError::SentAway)));
    let file = ConnectionFile { address: address.to_string(), key: key.clone() };
    let mut follower = RelayFollower::begin(Box::new(move || Ok(file.clone())), Limits::default(), Duration::from_secs(30)).unwrap();
    let mut poll = |values: &mut Vec<f32>| follower.poll(values, Duration::from_millis(10));
    let producer = Producer::open(&folder.0, description(64), 4, Policy::NewestWins).unwrap();
    // One after another, so that none is overwritten.
    publish(&producer, 0);
    assert_eq!(events(&mut poll, "step 0"), ["opened 64", "step 0 missed 0"]);
    for n in 1..20 {
        publish(&producer, n);
        assert_eq!(events(&mut poll, "step"), [format!("step {n} missed 0")]);
    }
    // Far more than the ring and the wire hold: each step is seen or counted, and the newest comes.
    (20..2000).for_each(|n| _ = publish(&producer, n));
    let seen = events(&mut poll, "step 1999");
    let missed: usize = seen.iter().map(|words| words.rsplit(' ').next().unwrap().parse::<usize>().unwrap()).sum();
    assert_eq!(seen.len() + missed, 1980);
    drop(producer);
    assert_eq!(events(&mut poll, "ended"), ["ended true"]);
    let producer = Producer::open(&folder.0, description(8), 4, Policy::NewestWins).unwrap();
    publish(&producer, 5);
    assert_eq!(events(&mut poll, "step 5"), ["opened 8", "step 5 missed 0"]);
    assert_eq!((counts.accepted.load(Ordering::Relaxed), counts.refused.load(Ordering::Relaxed)), (1, 1));
    stop.store(true, Ordering::Relaxed);
    relay.join().unwrap();
    // The relay is gone, and comes back at its old address: the follower finds it by itself.
    assert!(events(&mut poll, "refused").last().unwrap().starts_with("refused"));
    let listener = TcpListener::bind(address).unwrap();
    let stop = Arc::new(AtomicBool::new(false));
    let relay = {
        let (ring, stop) = (folder.0.clone(), stop.clone());
        std::thread::spawn(move || serve(&ring, &listener, &key, &counts, &stop, Arc::new(|_| {})).unwrap())
    };
    let seen = events(&mut poll, "step 5");
    assert_eq!(seen.last().unwrap(), "step 5 missed 0", "{seen:?}");
    publish(&producer, 6);
    assert_eq!(events(&mut poll, "step 6"), ["step 6 missed 0"]);
    stop.store(true, Ordering::Relaxed);
    relay.join().unwrap();
}
