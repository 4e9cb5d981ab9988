//! The window of a simulation that runs now: the result of each odd thing that a simulation can do.

use crate::ALONE;
use crate::kit::program::until;
use crate::kit::ring::{self, Ring, columns, grid};
use ridgewatch::source::live::{AtEnd, Follow, Live, LiveSettings, LiveWindow, Taken};
use ridgewatch_wire::message::{ConnectionFile, Key};
use ridgewatch_wire::relay::serve;
use ridgewatch_wire::{BlockExtent, Description, Policy, Producer};
use std::net::TcpListener;
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, RwLockReadGuard};
use std::time::{Duration, Instant};

/// Time after which a test that hangs fails.
const LONG: Duration = Duration::from_secs(120);

/// Ring of a test.
struct Folder {
    ring: Ring,
    /// One a test: a second one would wait for tests of the program that wait for the first.
    _alone: Option<RwLockReadGuard<'static, ()>>,
}

impl Folder {
    fn new(name: &str) -> Self {
        let alone = ALONE.read().unwrap_or_else(|broken| broken.into_inner());
        Self { ring: Ring::new(&format!("live-{name}")), _alone: Some(alone) }
    }

    fn path(&self) -> &Path {
        &self.ring.0
    }
}

fn plane(nodes: u64) -> Description {
    grid(&[nodes; 2])
}

/// A producer that waits, so that no step is lost however slow the machine is.
fn producer(folder: &Folder, description: Description) -> Producer {
    Producer::open(folder.path(), description, 4, Policy::Wait(LONG)).unwrap()
}

fn producers(folder: &Folder, blocks: Vec<Description>) -> Vec<Producer> {
    blocks.into_iter().map(|block| producer(folder, block)).collect()
}

/// Publishes a step with u = value and v = time everywhere.
fn publish(producer: &Producer, step: u64, time: f64, value: f32) {
    let nodes = producer.description().block_nodes() as usize;
    ring::publish(producer, step, time, &[&vec![value; nodes], &vec![time as f32; nodes]]);
}

fn settings(folder: &Folder) -> LiveSettings {
    LiveSettings { ring: Some(folder.path().to_owned()), memory_gib: 0.01, ..LiveSettings::default() }
}

fn follow(settings: &LiveSettings, tau: f64) -> LiveWindow {
    let live = Live::connect(settings, &AtomicBool::new(false), &mut |_| {}).unwrap().unwrap();
    live.follow(tau, 1).unwrap()
}

/// The next window that `wanted` accepts, and the warnings on the way there.
fn take(window: &LiveWindow, wanted: impl Fn(&Taken) -> bool) -> (Taken, Vec<String>) {
    let (mut warnings, begin) = (Vec::new(), Instant::now());
    loop {
        assert!(begin.elapsed() < LONG, "no such window; warnings: {warnings:?}");
        if let Ok(Some(Ok(taken))) = window.next_within(Duration::from_millis(50)) {
            warnings.extend(taken.warnings.clone());
            if wanted(&taken) {
                return (taken, warnings);
            }
        }
    }
}

fn newest(taken: &Taken) -> f64 {
    taken.window.newest().unwrap()
}

fn has(warnings: &[String], text: &str) -> bool {
    warnings.iter().any(|warning| warning.contains(text))
}

#[test]
fn the_window_fills_and_moves_with_the_simulation() {
    let folder = Folder::new("fills");
    let solver = producer(&folder, plane(8));
    let window = follow(&settings(&folder), 2.0);
    for n in 0..4 {
        publish(&solver, n, n as f64 * 0.5, 1.0);
    }
    until("three quarters of the window", || (window.filled() - 0.75).abs() <= 1e-9);
    assert!(window.next_within(Duration::from_millis(50)).is_err(), "1.5 of 2 is not full");
    publish(&solver, 4, 2.0, 1.0);
    let (taken, warnings) = take(&window, |_| true);
    assert_eq!((taken.live.step, newest(&taken), taken.live.snapshots, taken.live.steps, taken.live.missed_blocks), (4, 2.0, 5, 5, 0));
    // A quarter of tau a step.
    let filling = &taken.live.fill_seconds;
    assert!(filling.len() == 10 && filling.is_sorted() && filling[0] == filling[1] && filling[5] == filling[6], "{filling:?}");
    assert!(filling[9] - filling[6] >= 0.05, "{filling:?}: the last quarter was late");
    assert!(taken.live.delay <= taken.live.age && taken.live.age < 60.0 && warnings.is_empty(), "{warnings:?}");
    assert!(window.next_within(Duration::from_millis(20)).is_err(), "nothing new");
    publish(&solver, 5, 2.5, 3.0);
    let (taken, _) = take(&window, |_| true);
    assert_eq!((taken.window.oldest(), newest(&taken)), (Some(0.5), 2.5));
    assert_eq!(taken.window.snapshots().last().unwrap().nodes[63], [3.0, 2.5, 0.0, 0.0]);
}

#[test]
fn a_listener_hears_of_each_snapshot_before_the_window_has_it() {
    let folder = Folder::new("listener");
    let solver = producer(&folder, plane(8));
    let window = follow(&settings(&folder), 2.0);
    let heard = Arc::new(Mutex::new(Vec::new()));
    let hears = heard.clone();
    window.tell(Box::new(move |snapshot| hears.lock().unwrap().push(snapshot.clone())));
    for n in 0..8 {
        publish(&solver, n, n as f64 * 0.5, 1.0);
        // All snapshots in the window were announced, as the same objects.
        if let Ok(Some(Ok(taken))) = window.next_within(Duration::from_secs(u64::from(n >= 4))) {
            let heard = heard.lock().unwrap();
            assert!(taken.window.snapshots().all(|s| heard.iter().any(|h| Arc::ptr_eq(h, s))));
        }
    }
    until("the eighth snapshot", || heard.lock().unwrap().len() == 8);
    assert_eq!(heard.lock().unwrap().iter().map(|s| s.time).collect::<Vec<_>>(), (0..8).map(|n| f64::from(n) * 0.5).collect::<Vec<_>>());
}

/// Settings with the memory for 12 snapshots of 32 x 32 nodes of 16 bytes, twice, two more, and five steps of half the size.
fn twelve_snapshots(folder: &Folder) -> LiveSettings {
    LiveSettings { memory_gib: (12.25 * 2.0 + 2.0 + 5.0 / 2.0) * 16_384.0 / f64::from(1 << 30), ..settings(folder) }
}

#[test]
fn memory_is_kept_to_by_leaving_steps_out() {
    let folder = Folder::new("thin");
    let solver = producer(&folder, plane(32));
    let window = follow(&twelve_snapshots(&folder), 10.0);
    for n in 0..=200 {
        publish(&solver, n, n as f64 * 0.1, (n as f32 * 0.1).sin());
    }
    let (taken, _) = take(&window, |taken| newest(taken) > 19.0);
    assert!(taken.live.snapshots <= 12 && taken.live.snapshots >= 10, "{}", taken.live.snapshots);
    assert!((taken.live.spacing - 1.0).abs() < 1e-9 && taken.live.steps_skipped > 150, "{:?}", taken.live);
    // u = sin t, v = t: linear interpolation over 1 is off by up to 1 / 8 of the amplitude in u, and exact in v.
    let error = taken.live.interpolation_error.unwrap();
    assert!(error > 1e-4 && error < 0.02, "{error}");
}

#[test]
fn every_third_complete_step_is_taken_whatever_its_number() {
    let folder = Folder::new("every");
    let solver = producer(&folder, plane(8));
    let live = Live::connect(&settings(&folder), &AtomicBool::new(false), &mut |_| {}).unwrap().unwrap();
    let window = live.follow_beside(6.0, 1, 3, 0).unwrap();
    // Every third number would be all of them.
    (0..11).for_each(|n| publish(&solver, 3 * n, n as f64, 1.0));
    let (taken, warnings) = take(&window, |taken| newest(taken) == 9.0);
    assert_eq!(taken.window.snapshots().map(|s| s.time).collect::<Vec<_>>(), [3.0, 6.0, 9.0]);
    assert_eq!((taken.live.step, taken.live.steps_skipped, taken.live.snapshots), (27, 0, 3));
    assert!(warnings.is_empty(), "{warnings:?}");
}

#[test]
fn too_little_memory_is_refused_in_words() {
    let folder = Folder::new("small");
    let _solver = producer(&folder, plane(256));
    let settings = LiveSettings { memory_gib: 0.005, ..settings(&folder) };
    let connect = || Live::connect(&settings, &AtomicBool::new(false), &mut |_| {}).unwrap().unwrap();
    let error = connect().follow(1.0, 1).err().unwrap();
    assert!(error.to_string().contains("live.memory_gib") && error.to_string().contains("three snapshots, twice"), "{error}");
    // A third window for maps of both directions.
    let beside = connect().follow_beside(1.0, 1, 1, 1).err().unwrap().to_string();
    let least = |text: &str| text.split("at least ").nth(1).unwrap().split(':').next().unwrap().parse::<f64>().unwrap();
    assert!(beside.contains("three snapshots, 3 times") && least(&beside) > least(&error.to_string()), "{beside}");
}

#[test]
fn a_loss_is_told_at_once_and_once() {
    let folder = Folder::new("loss");
    let solver = producer(&folder, plane(8));
    let window = follow(&settings(&folder), 2.0);
    (0..4).for_each(|n| publish(&solver, n, n as f64, 1.0));
    take(&window, |taken| newest(taken) == 3.0);
    assert_eq!(window.loss(), Vec::<String>::new());
    drop(solver);
    let mut loss = Vec::new();
    until("the loss", || {
        loss = window.loss();
        !loss.is_empty()
    });
    assert!(window.is_waited_for() && has(&loss, "has ended"), "without another window: {loss:?}");
    assert_eq!(window.loss(), Vec::<String>::new());
    // A window says it no second time.
    let solver = producer(&folder, plane(8));
    publish(&solver, 4, 4.0, 1.0);
    let (_, warnings) = take(&window, |taken| newest(taken) == 4.0);
    assert!(!has(&warnings, "has ended") && has(&warnings, "started anew"), "{warnings:?}");
}

#[test]
fn a_simulation_that_ends_and_starts_anew_is_gone_on_with() {
    let folder = Folder::new("anew");
    let solver = producer(&folder, plane(8));
    let window = follow(&settings(&folder), 2.0);
    (0..4).for_each(|n| publish(&solver, n, n as f64, 1.0));
    take(&window, |taken| newest(taken) == 3.0);
    drop(solver);
    // From a checkpoint: times go on.
    let solver = producer(&folder, plane(8));
    publish(&solver, 3, 3.5, 1.0);
    let (taken, warnings) = take(&window, |taken| newest(taken) == 3.5);
    assert!(has(&warnings, "has ended") && has(&warnings, "started anew"), "{warnings:?}");
    assert_eq!((taken.live.restarts, taken.window.oldest()), (1, Some(1.0)));
    drop(solver);
    // From the beginning: the window starts again.
    let solver = producer(&folder, plane(8));
    (0..3).for_each(|n| publish(&solver, n, n as f64, 2.0));
    let (taken, warnings) = take(&window, |taken| newest(taken) == 2.0);
    assert!(has(&warnings, "went back from time 3.5 to 0"), "{warnings:?}");
    assert_eq!((taken.window.oldest(), taken.live.restarts, taken.live.fill_seconds.len()), (Some(0.0), 2, 10));
    assert!(taken.window.snapshots().all(|s| s.nodes[0][0] == 2.0), "nothing of the run before");
}

#[test]
fn another_grid_in_mid_run_is_refused_and_the_old_one_taken_again() {
    let folder = Folder::new("grid");
    let solver = producer(&folder, plane(8));
    let window = follow(&settings(&folder), 1.0);
    (0..2).for_each(|n| publish(&solver, n, n as f64, 1.0));
    take(&window, |_| true);
    drop(solver);
    let other = producer(&folder, plane(9));
    // More steps than the ring holds: by the last of them, the follower has connected.
    (2..10).for_each(|n| publish(&other, n, n as f64, 1.0));
    assert!(window.next_within(Duration::from_millis(50)).is_err());
    drop(other);
    let solver = producer(&folder, plane(8));
    publish(&solver, 10, 10.0, 1.0);
    let (_, warnings) = take(&window, |taken| newest(taken) == 10.0);
    assert!(has(&warnings, "another grid needs another run"), "{warnings:?}");
}

#[test]
fn a_simulation_in_other_blocks_of_the_same_grid_is_gone_on_with() {
    let block =
        |start, index, count, offset, extent| Description { start, block: BlockExtent { index, count, offset, extent }, ..plane(8) };
    // With start numbers and without: four columns, two rows, two columns, one block.
    for (name, starts) in [("told", [1, 2, 3, 4]), ("untold", [0; 4])] {
        let rounds: [Vec<Description>; 4] = [
            (0..4).map(|k| block(starts[0], k, 4, [2 * u64::from(k), 0, 0], [2, 8, 1])).collect(),
            (0..2).map(|k| block(starts[1], k, 2, [0, 4 * u64::from(k), 0], [8, 4, 1])).collect(),
            (0..2).map(|k| block(starts[2], k, 2, [4 * u64::from(k), 0, 0], [4, 8, 1])).collect(),
            vec![block(starts[3], 0, 1, [0, 0, 0], [8, 8, 1])],
        ];
        let folder = Folder::new(name);
        let mut window = None;
        for (round, blocks) in (0u64..).zip(rounds) {
            let value = round as f32 + 1.0;
            let solvers = producers(&folder, blocks);
            // Times go on from the step before the last whole one, as from a checkpoint; step numbers begin at 0.
            let times: Vec<f64> = (0..4).map(|n| (2 * round + n) as f64).collect();
            for (n, time) in (0..).zip(&times) {
                solvers.iter().for_each(|solver| publish(solver, n, *time, value));
            }
            let window = window.get_or_insert_with(|| follow(&settings(&folder), 1.0));
            let (taken, warnings) = take(window, |taken| newest(taken) == times[3] && taken.live.restarts == round);
            assert!(taken.window.snapshots().last().unwrap().nodes.iter().all(|node| node[0] == value), "{name}, round {round}");
            assert_eq!(has(&warnings, "started anew"), round > 0, "{name}, round {round}: {warnings:?}");
            assert_eq!(taken.live.steps_incomplete, round, "{name}, round {round}: {warnings:?}");
            // The simulation ends before the last block of its next step.
            for solver in solvers.iter().skip(1) {
                publish(solver, 4, times[3] + 1.0, value);
            }
        }
        // The last step in several blocks expired, or was dropped with its start.
        let solver = producer(&folder, block(9, 0, 1, [0, 0, 0], [8, 8, 1]));
        publish(&solver, 0, 20.0, 1.0);
        publish(&solver, 1, 21.0, 1.0);
        let (taken, _) = take(window.as_ref().unwrap(), |taken| newest(taken) == 21.0);
        assert_eq!((taken.live.steps_incomplete, taken.live.restarts), (3, 4), "{name}");
    }
}

#[test]
fn odd_times_and_missing_values_are_told() {
    let folder = Folder::new("odd");
    let solver = producer(&folder, plane(8));
    let window = follow(&settings(&folder), 2.0);
    (0..4).for_each(|n| publish(&solver, n, n as f64, 1.0));
    take(&window, |taken| newest(taken) == 3.0);
    // The same time again, an earlier time that the window needs, a step of missing values.
    publish(&solver, 4, 3.0, 5.0);
    publish(&solver, 5, 2.5, 1.0);
    publish(&solver, 6, 4.0, f32::NAN);
    let (taken, warnings) = take(&window, |taken| newest(taken) == 4.0);
    assert!(
        has(&warnings, "repeats time 3") && has(&warnings, "time 2.5 came after 3") && has(&warnings, "64 of 64 velocities"),
        "{warnings:?}"
    );
    assert_eq!(taken.window.snapshots().last().unwrap().missing_nodes(), 64);
    // Times go back within one run: the first steps are late, then the window starts again.
    for n in 0..5 {
        publish(&solver, 7 + n, n as f64 - 10.0, 1.0);
    }
    let (taken, warnings) = take(&window, |taken| newest(taken) < 0.0);
    assert!(has(&warnings, "is late") && has(&warnings, "was set back"), "{warnings:?}");
    assert_eq!((newest(&taken), taken.window.oldest()), (-6.0, Some(-8.0)));
}

#[test]
fn times_that_fall_take_no_more_memory_than_times_that_rise() {
    let folder = Folder::new("falling");
    let solver = producer(&folder, plane(32));
    let window = follow(&twelve_snapshots(&folder), 10.0);
    let mut step = 0;
    let mut publish = |time: f64| {
        publish(&solver, step, time, time as f32);
        step += 1;
    };
    // The window fills from its end to its beginning,
    (0..=195).for_each(|n| publish(10.0 - 0.05 * f64::from(n)));
    publish(11.0);
    let (taken, _) = take(&window, |taken| newest(taken) == 11.0);
    assert!((10..=12).contains(&taken.live.snapshots) && taken.live.steps_skipped > 150, "{:?}", taken.live);
    // and then times fall between those in the window.
    (1..100).for_each(|n| publish(11.0 - 0.07 * f64::from(n)));
    publish(12.0);
    let (taken, _) = take(&window, |taken| newest(taken) == 12.0);
    assert!((10..=12).contains(&taken.live.snapshots) && taken.live.steps_skipped > 250, "{:?}", taken.live);
}

#[test]
fn a_simulation_whose_numbers_fall_or_stay_is_followed_on() {
    let folder = Folder::new("numbers");
    let solver = producer(&folder, plane(8));
    let window = follow(&settings(&folder), 2.0);
    (0..10).for_each(|n| publish(&solver, 100 + n, n as f64, 1.0));
    take(&window, |taken| newest(taken) == 9.0);
    // A checkpoint of the simulation sets numbers and times back.
    (0..10).for_each(|n| publish(&solver, 50 + n, n as f64 - 20.0, 2.0));
    let (taken, warnings) = take(&window, |taken| newest(taken) == -11.0);
    assert!(has(&warnings, "was set back") && taken.live.restarts == 1, "{warnings:?}");
    assert!(taken.window.snapshots().all(|s| s.nodes[0][0] == 2.0));
    // All steps have one number.
    (0..10).for_each(|n| publish(&solver, 0, n as f64 - 10.0, 3.0));
    let (taken, _) = take(&window, |taken| newest(taken) == -1.0);
    assert_eq!((taken.live.steps, taken.live.steps_incomplete), (30, 0));
}

#[test]
fn a_reading_thread_that_panicked_is_an_error_and_no_end() {
    let folder = Folder::new("panicked");
    let solver = producer(&folder, plane(8));
    let window = follow(&settings(&folder), 2.0);
    window.tell(Box::new(|snapshot| assert!(snapshot.time < 1.0, "this panic is part of the test")));
    (0..2).for_each(|n| publish(&solver, n, n as f64, 1.0));
    let begin = Instant::now();
    let error = loop {
        assert!(begin.elapsed() < LONG, "the error did not come");
        if let Ok(next) = window.next_within(Duration::from_millis(50)) {
            break next.expect("no end").unwrap_err().to_string();
        }
    };
    assert_eq!(error, "the thread that follows the simulation ended after 2 steps: it panicked");
}

#[test]
fn blocks_meet() {
    let folder = Folder::new("blocks");
    let solvers = producers(&folder, columns(8, 2));
    let window = follow(&settings(&folder), 2.0);
    for n in 0..3 {
        publish(&solvers[1], n, n as f64, 2.0);
        publish(&solvers[0], n, n as f64, 1.0);
    }
    let (taken, warnings) = take(&window, |taken| newest(taken) == 2.0);
    let nodes = &taken.window.snapshots().next().unwrap().nodes;
    assert!(nodes.iter().enumerate().all(|(i, node)| node[0] == if i % 8 < 4 { 1.0 } else { 2.0 }));
    assert_eq!((taken.live.steps_incomplete, taken.live.steps), (0, 3), "{warnings:?}");
}

#[test]
fn a_step_that_lacks_a_block_is_given_up_after_its_time_and_later_ones_come() {
    let folder = Folder::new("lacks");
    let solvers = producers(&folder, columns(8, 2));
    let window = follow(&LiveSettings { block_timeout_seconds: 0.2, ..settings(&folder) }, 2.0);
    publish(&solvers[0], 3, 3.0, 1.0);
    // Longer than its limit, also if the reading thread is late.
    std::thread::sleep(Duration::from_secs(3));
    // On a busy machine one of these may be late as well.
    for n in 4..20 {
        solvers.iter().for_each(|solver| publish(solver, n, n as f64, 1.0));
    }
    let (taken, warnings) = take(&window, |taken| newest(taken) == 19.0);
    assert!(has(&warnings, "step 3 (time 3) was given up with 1 of 2 blocks: blocks did not arrive in time"), "{warnings:?}");
    assert!(taken.live.steps_incomplete >= 1 && taken.live.steps + taken.live.steps_incomplete == 17, "{:?}", taken.live);
}

#[test]
fn a_step_that_waits_for_its_blocks_does_not_grow_older_while_no_step_is_taken() {
    let folder = Folder::new("held");
    let solvers = producers(&folder, columns(9, 3));
    let window = follow(&LiveSettings { follow: Follow::Every, block_timeout_seconds: 5.0, ..settings(&folder) }, 2.0);
    let publish = |block: usize, n: u64| publish(&solvers[block], n, n as f64, 1.0);
    // Waits until the mark of the follower shows so many steps of a block.
    let taken = |block: u32, steps: u64| {
        let (ring, mut word) = (std::fs::File::open(ridgewatch_wire::block_path(folder.path(), block)).unwrap(), [0; 8]);
        until("the reading of a block", || {
            std::os::unix::fs::FileExt::read_exact_at(&ring, &mut word, 4096).unwrap();
            u64::from_ne_bytes(word) >= steps
        });
    };
    for n in 0..2 {
        (0..3).for_each(|block| publish(block, n));
    }
    // The first block of step 3 is taken before the last block of step 2, which causes a slide.
    [(0, 2), (0, 3), (1, 2)].iter().for_each(|(block, n)| publish(*block, *n));
    taken(0, 4);
    [(2, 2), (1, 3)].iter().for_each(|(block, n)| publish(*block, *n));
    // Longer than a step may wait.
    std::thread::sleep(Duration::from_secs(6));
    take(&window, |taken| newest(taken) == 2.0);
    taken(1, 4);
    publish(2, 3);
    let (taken, warnings) = take(&window, |taken| newest(taken) == 3.0);
    assert_eq!((taken.live.steps_incomplete, taken.live.steps), (0, 4), "{warnings:?}");
}

/// A relay of a folder's rings.
struct Relay {
    stop: Arc<AtomicBool>,
    thread: Option<std::thread::JoinHandle<()>>,
}

impl Relay {
    fn start(folder: &Folder, connection: &Path) -> Self {
        let (listener, key) = (TcpListener::bind("127.0.0.1:0").unwrap(), Key::random().unwrap());
        ConnectionFile { address: listener.local_addr().unwrap().to_string(), key: key.clone() }.write(connection).unwrap();
        let (ring, stop) = (folder.path().to_owned(), Arc::new(AtomicBool::new(false)));
        let flag = stop.clone();
        let thread = std::thread::spawn(move || serve(&ring, &listener, &key, &Arc::default(), &flag, Arc::new(|_| {})).unwrap());
        Self { stop, thread: Some(thread) }
    }
}

impl Drop for Relay {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        self.thread.take().unwrap().join().unwrap();
    }
}

#[test]
fn a_relay_whose_blocks_come_late_is_waited_for() {
    let folders = [Folder::new("left"), Folder { ring: Ring::new("live-right"), _alone: None }];
    let connections = folders.each_ref().map(|folder| folder.path().with_extension("connection"));
    let relays = [0, 1].map(|k| Relay::start(&folders[k], &connections[k]));
    let solvers: Vec<Producer> = columns(8, 2).into_iter().zip(&folders).map(|(block, folder)| producer(folder, block)).collect();
    let settings = LiveSettings { connections: connections.to_vec(), memory_gib: 0.01, ..LiveSettings::default() };
    let window = follow(&settings, 4.0);
    std::thread::scope(|scope| {
        for (n, solver) in solvers.iter().enumerate() {
            scope.spawn(move || {
                // Later by more steps than the connection holds.
                std::thread::sleep(Duration::from_millis(500) * n as u32);
                (0..40).for_each(|n| publish(solver, n, n as f64, 1.0));
            });
        }
        let (taken, warnings) = take(&window, |taken| newest(taken) == 39.0);
        assert_eq!((taken.live.steps_incomplete, taken.live.steps, taken.live.missed_blocks), (0, 40, 0), "{warnings:?}");
    });
    drop((window, relays));
    connections.iter().for_each(|file| std::fs::remove_file(file).unwrap());
}

#[test]
fn every_step_is_taken_when_asked_for_and_the_end_ends() {
    let folder = Folder::new("every");
    let settings = LiveSettings { follow: Follow::Every, at_end: AtEnd::Stop, ..settings(&folder) };
    let solver = producer(&folder, plane(8));
    let window = follow(&settings, 2.0);
    let play = std::thread::spawn(move || (0..20).for_each(|n| publish(&solver, n, n as f64, 1.0)));
    let mut times = Vec::new();
    let begin = Instant::now();
    while begin.elapsed() < LONG {
        match window.next_within(Duration::from_millis(50)) {
            // Slower than the simulation alone.
            Ok(Some(taken)) => {
                let taken = taken.unwrap();
                times.push(newest(&taken));
                assert_eq!(taken.live.missed_blocks, 0);
                std::thread::sleep(Duration::from_millis(5));
            }
            Ok(None) => break,
            Err(_) => {}
        }
    }
    play.join().unwrap();
    assert_eq!(times, (2..20).map(f64::from).collect::<Vec<_>>());
}

#[test]
fn a_simulation_that_never_waits_is_seen_at_its_newest() {
    let folder = Folder::new("newest");
    let solver = Producer::open(folder.path(), plane(64), 2, Policy::NewestWins).unwrap();
    let window = follow(&settings(&folder), 50.0);
    let mut steps = 0;
    let mut publish_next = || {
        publish(&solver, steps, steps as f64, 1.0);
        steps += 1;
        steps
    };
    let burst = (0..3000).map(|_| publish_next()).last().unwrap();
    // However late the thread of the window reads for the first time.
    let (mut published, begin) = (burst, Instant::now());
    while published == burst || window.filled() < 1.0 {
        assert!(begin.elapsed() < LONG, "{} after {published} steps", window.filled());
        std::thread::sleep(Duration::from_millis(2));
        published = publish_next();
    }
    let (taken, _) = take(&window, |taken| newest(taken) == (published - 1) as f64);
    assert_eq!(taken.live.steps + taken.live.missed_blocks, published, "each step is taken or counted");
    assert!(taken.window.is_full());
}

#[test]
fn waiting_for_a_simulation_ends_when_told() {
    let folder = Folder::new("nobody");
    let stop = AtomicBool::new(true);
    let mut told = Vec::new();
    assert!(Live::connect(&settings(&folder), &stop, &mut |text| told.push(text)).unwrap().is_none());
    assert!(told[0].contains("RIDGEWATCH_RING=/dev/shm/rw-live-nobody"), "{told:?}");
    let nowhere = LiveSettings::default();
    if std::env::var_os("RIDGEWATCH_RING").is_none() {
        assert!(Live::connect(&nowhere, &stop, &mut |_| {}).err().unwrap().to_string().contains("live.ring"));
    }
}
