//! The window of a simulation that runs now: each odd thing that a simulation can do has its result.

#![allow(clippy::unwrap_used)]

use ridgewatch::source::live::{AtEnd, Follow, Live, LiveSettings, LiveWindow, Taken};
use ridgewatch_wire::message::{ConnectionFile, Key};
use ridgewatch_wire::relay::serve;
use ridgewatch_wire::{AxisDescription, BlockExtent, Description, Element, Field, Geometry, Policy, Producer};
use std::net::TcpListener;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

/// After so long a test that hangs fails.
const LONG: Duration = Duration::from_secs(120);

struct Folder(PathBuf);

impl Folder {
    fn new(name: &str) -> Self {
        let path = PathBuf::from("/dev/shm").join(format!("rw-live-{name}-{}", std::process::id()));
        let _ = std::fs::remove_dir_all(&path);
        Self(path)
    }
}

impl Drop for Folder {
    fn drop(&mut self) {
        let _ = std::fs::remove_dir_all(&self.0);
    }
}

fn plane(nodes: u64) -> Description {
    let axis = |name| AxisDescription::uniform(name, "m", 0.0, 1.0, nodes);
    Description::whole(Geometry::Cartesian, vec![axis("x"), axis("y")], "s")
}

/// A producer that waits, so that no step is lost however slow the machine is.
fn producer(folder: &Folder, description: Description) -> Producer {
    Producer::open(&folder.0, description, 4, Policy::Wait(LONG)).unwrap()
}

/// u = value everywhere, v = time.
fn publish(producer: &Producer, step: u64, time: f64, value: f32) {
    let nodes = producer.description().block_nodes() as usize;
    let (u, v) = (vec![value; nodes], vec![time as f32; nodes]);
    let pointers = [u.as_ptr().cast::<u8>(), v.as_ptr().cast()];
    let field = Field::packed(&pointers, Element::F32, producer.description().block.extent);
    // SAFETY: a value a node.
    unsafe { producer.publish(step, time, &field).unwrap() };
}

fn settings(folder: &Folder) -> LiveSettings {
    LiveSettings { ring: Some(folder.0.clone()), memory_gib: 0.01, ..LiveSettings::default() }
}

fn follow(settings: &LiveSettings, tau: f64) -> LiveWindow {
    let live = Live::connect(settings, &AtomicBool::new(false), &mut |_| {}).unwrap().unwrap();
    live.follow(tau, 1).unwrap()
}

/// The next window that `wanted` accepts, and the warnings on the way there.
fn take(window: &LiveWindow, wanted: impl Fn(&Taken) -> bool) -> (Taken, Vec<String>) {
    let (mut warnings, begin) = (Vec::new(), Instant::now());
    loop {
        assert!(begin.elapsed() < LONG, "it never came; warnings: {warnings:?}");
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
    let begin = Instant::now();
    while (window.filled() - 0.75).abs() > 1e-9 {
        assert!(begin.elapsed() < LONG, "{}", window.filled());
        std::thread::sleep(Duration::from_millis(1));
    }
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
    let heard = Arc::new(std::sync::Mutex::new(Vec::new()));
    let hears = heard.clone();
    window.tell(Box::new(move |snapshot| hears.lock().unwrap().push(snapshot.clone())));
    for n in 0..8 {
        publish(&solver, n, n as f64 * 0.5, 1.0);
        // In the window: whatever its newest snapshots are, they were announced, and as the very same ones.
        if let Ok(Some(Ok(taken))) = window.next_within(Duration::from_secs(u64::from(n >= 4))) {
            let heard = heard.lock().unwrap();
            assert!(taken.window.snapshots().all(|s| heard.iter().any(|h| Arc::ptr_eq(h, s))));
        }
    }
    let begin = Instant::now();
    while heard.lock().unwrap().len() < 8 {
        assert!(begin.elapsed() < LONG, "{:?}", heard.lock().unwrap());
        std::thread::sleep(Duration::from_millis(1));
    }
    assert_eq!(heard.lock().unwrap().iter().map(|s| s.time).collect::<Vec<_>>(), (0..8).map(|n| f64::from(n) * 0.5).collect::<Vec<_>>());
}

#[test]
fn memory_is_kept_to_by_leaving_steps_out() {
    let folder = Folder::new("thin");
    let solver = producer(&folder, plane(32));
    // Snapshots of 32 * 32 nodes of 16 bytes: 12, twice, and two more; and five steps of half the size.
    let settings = LiveSettings { memory_gib: (12.25 * 2.0 + 2.0 + 5.0 / 2.0) * 16_384.0 / f64::from(1 << 30), ..settings(&folder) };
    let window = follow(&settings, 10.0);
    for n in 0..=200 {
        publish(&solver, n, n as f64 * 0.1, (n as f32 * 0.1).sin());
    }
    let (taken, _) = take(&window, |taken| newest(taken) > 19.0);
    assert!(taken.live.snapshots <= 12 && taken.live.snapshots >= 10, "{}", taken.live.snapshots);
    assert!((taken.live.spacing - 1.0).abs() < 1e-9 && taken.live.steps_skipped > 150, "{:?}", taken.live);
    // u = sin t, v = t: linear interpolation over 1 misses u by up to 1 / 8 of its amplitude; v exactly none.
    let error = taken.live.interpolation_error.unwrap();
    assert!(error > 1e-4 && error < 0.02, "{error}");
}

#[test]
fn too_little_memory_is_refused_in_words() {
    let folder = Folder::new("small");
    let _solver = producer(&folder, plane(256));
    let settings = LiveSettings { memory_gib: 0.005, ..settings(&folder) };
    let live = Live::connect(&settings, &AtomicBool::new(false), &mut |_| {}).unwrap().unwrap();
    let error = live.follow(1.0, 1).err().unwrap();
    assert!(error.to_string().contains("live.memory_gib") && error.to_string().contains("three snapshots"), "{error}");
}

#[test]
fn a_simulation_that_ends_and_starts_anew_is_gone_on_with() {
    let folder = Folder::new("anew");
    let solver = producer(&folder, plane(8));
    let window = follow(&settings(&folder), 2.0);
    (0..4).for_each(|n| publish(&solver, n, n as f64, 1.0));
    take(&window, |taken| newest(taken) == 3.0);
    drop(solver);
    // From a checkpoint: its times go on.
    let solver = producer(&folder, plane(8));
    publish(&solver, 3, 3.5, 1.0);
    let (taken, warnings) = take(&window, |taken| newest(taken) == 3.5);
    assert!(has(&warnings, "has ended") && has(&warnings, "started anew"), "{warnings:?}");
    assert_eq!((taken.live.restarts, taken.window.oldest()), (1, Some(1.0)));
    drop(solver);
    // From the beginning: the window too.
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
    // More than its ring holds: by the last of them it is followed.
    (2..10).for_each(|n| publish(&other, n, n as f64, 1.0));
    assert!(window.next_within(Duration::from_millis(50)).is_err());
    drop(other);
    let solver = producer(&folder, plane(8));
    publish(&solver, 10, 10.0, 1.0);
    let (_, warnings) = take(&window, |taken| newest(taken) == 10.0);
    assert!(has(&warnings, "another grid needs a run of its own"), "{warnings:?}");
}

#[test]
fn a_simulation_in_other_blocks_of_the_same_grid_is_gone_on_with() {
    let block =
        |start, index, count, offset, extent| Description { start, block: BlockExtent { index, count, offset, extent }, ..plane(8) };
    // With numbers of their starts and without: four columns, two rows, two columns, one block.
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
            let solvers: Vec<_> = blocks.into_iter().map(|block| producer(&folder, block)).collect();
            // Times go on from the step before the last whole one, as from a checkpoint; numbers begin anew.
            let times: Vec<f64> = (0..4).map(|n| (2 * round + n) as f64).collect();
            for (n, time) in (0..).zip(&times) {
                solvers.iter().for_each(|solver| publish(solver, n, *time, value));
            }
            let window = window.get_or_insert_with(|| follow(&settings(&folder), 1.0));
            let (taken, warnings) = take(window, |taken| newest(taken) == times[3] && taken.live.restarts == round);
            assert!(taken.window.snapshots().last().unwrap().nodes.iter().all(|node| node[0] == value), "{name}, round {round}");
            assert_eq!(has(&warnings, "started anew"), round > 0, "{name}, round {round}: {warnings:?}");
            assert_eq!(taken.live.steps_incomplete, round, "{name}, round {round}: {warnings:?}");
            // It ends before the last block of its next step is there.
            for solver in solvers.iter().skip(1) {
                publish(solver, 4, times[3] + 1.0, value);
            }
        }
        // The last step of those in several blocks expired, or was given up with its start.
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
    // The same time again, one that is needed still, a burst of missing values.
    publish(&solver, 4, 3.0, 5.0);
    publish(&solver, 5, 2.5, 1.0);
    publish(&solver, 6, 4.0, f32::NAN);
    let (taken, warnings) = take(&window, |taken| newest(taken) == 4.0);
    assert!(
        has(&warnings, "repeats time 3") && has(&warnings, "time 2.5 came after 3") && has(&warnings, "64 of 64 velocities"),
        "{warnings:?}"
    );
    assert_eq!(taken.window.snapshots().last().unwrap().missing(), 64);
    // Set back within one run: the first are late, then the window begins anew.
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
    // As many bytes as 12 snapshots need, see above.
    let settings = LiveSettings { memory_gib: (12.25 * 2.0 + 2.0 + 5.0 / 2.0) * 16_384.0 / f64::from(1 << 30), ..settings(&folder) };
    let window = follow(&settings, 10.0);
    let mut step = 0;
    let mut publish = |time: f64| {
        publish(&solver, step, time, time as f32);
        step += 1;
    };
    // The window fills from behind,
    (0..=195).for_each(|n| publish(10.0 - 0.05 * f64::from(n)));
    publish(11.0);
    let (taken, _) = take(&window, |taken| newest(taken) == 11.0);
    assert!((10..=12).contains(&taken.live.snapshots) && taken.live.steps_skipped > 150, "{:?}", taken.live);
    // and times come between those that it holds.
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
    // Set back by its own checkpoint: numbers and times.
    (0..10).for_each(|n| publish(&solver, 50 + n, n as f64 - 20.0, 2.0));
    let (taken, warnings) = take(&window, |taken| newest(taken) == -11.0);
    assert!(has(&warnings, "was set back") && taken.live.restarts == 1, "{warnings:?}");
    assert!(taken.window.snapshots().all(|s| s.nodes[0][0] == 2.0));
    // All of one number.
    (0..10).for_each(|n| publish(&solver, 0, n as f64 - 10.0, 3.0));
    let (taken, _) = take(&window, |taken| newest(taken) == -1.0);
    assert_eq!((taken.live.steps, taken.live.steps_incomplete), (30, 0));
}

#[test]
fn a_reading_thread_that_panicked_is_an_error_and_no_end() {
    let folder = Folder::new("panicked");
    let solver = producer(&folder, plane(8));
    let window = follow(&settings(&folder), 2.0);
    window.tell(Box::new(|snapshot| assert!(snapshot.time < 1.0, "this panic is the test's")));
    (0..2).for_each(|n| publish(&solver, n, n as f64, 1.0));
    let begin = Instant::now();
    let error = loop {
        assert!(begin.elapsed() < LONG, "it is waited for");
        if let Ok(next) = window.next_within(Duration::from_millis(50)) {
            break next.expect("no end").unwrap_err().to_string();
        }
    };
    assert_eq!(error, "the thread that follows the simulation ended after 2 steps: it panicked");
}

/// Columns of a plane, as many as told.
fn columns(nodes: u64, count: u32) -> Vec<Description> {
    let width = nodes / u64::from(count);
    let block = |index: u32| BlockExtent { index, count, offset: [width * u64::from(index), 0, 0], extent: [width, nodes, 1] };
    (0..count).map(|index| Description { start: 1, block: block(index), ..plane(nodes) }).collect()
}

#[test]
fn blocks_meet() {
    let folder = Folder::new("blocks");
    let solvers: Vec<Producer> = columns(8, 2).into_iter().map(|block| producer(&folder, block)).collect();
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
    let solvers: Vec<Producer> = columns(8, 2).into_iter().map(|block| producer(&folder, block)).collect();
    let window = follow(&LiveSettings { block_timeout_seconds: 0.2, ..settings(&folder) }, 2.0);
    publish(&solvers[0], 3, 3.0, 1.0);
    // Its time and more, also where the thread that reads comes late.
    std::thread::sleep(Duration::from_secs(3));
    // On a busy machine one of these may come too late as well.
    for n in 4..20 {
        solvers.iter().for_each(|solver| publish(solver, n, n as f64, 1.0));
    }
    let (taken, warnings) = take(&window, |taken| newest(taken) == 19.0);
    assert!(has(&warnings, "step 3 (time 3) was given up with 1 of 2 blocks: blocks did not come in time"), "{warnings:?}");
    assert!(taken.live.steps_incomplete >= 1 && taken.live.steps + taken.live.steps_incomplete == 17, "{:?}", taken.live);
}

#[test]
fn a_step_that_waits_for_its_blocks_does_not_grow_older_while_no_step_is_taken() {
    let folder = Folder::new("held");
    let solvers: Vec<Producer> = columns(9, 3).into_iter().map(|block| producer(&folder, block)).collect();
    let window = follow(&LiveSettings { follow: Follow::Every, block_timeout_seconds: 5.0, ..settings(&folder) }, 2.0);
    let publish = |block: usize, n: u64| publish(&solvers[block], n, n as f64, 1.0);
    // Until so many steps of a block were taken, as the follower's mark says.
    let taken = |block: u32, steps: u64| {
        let (ring, mut word) = (std::fs::File::open(ridgewatch_wire::block_path(&folder.0, block)).unwrap(), [0; 8]);
        let begin = Instant::now();
        while u64::from_ne_bytes(word) < steps {
            assert!(begin.elapsed() < LONG, "block {block}");
            std::thread::sleep(Duration::from_millis(1));
            std::os::unix::fs::FileExt::read_exact_at(&ring, &mut word, 4096).unwrap();
        }
    };
    for n in 0..2 {
        (0..3).for_each(|block| publish(block, n));
    }
    // The first block of step 3 is taken before the last one of step 2 is there, with which a slide is due.
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
        let (ring, stop) = (folder.0.clone(), Arc::new(AtomicBool::new(false)));
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
    let folders = ["left", "right"].map(Folder::new);
    let connections = folders.each_ref().map(|folder| folder.0.with_extension("connection"));
    let relays = [0, 1].map(|k| Relay::start(&folders[k], &connections[k]));
    let solvers: Vec<Producer> = columns(8, 2).into_iter().zip(&folders).map(|(block, folder)| producer(folder, block)).collect();
    let settings = LiveSettings { connections: connections.to_vec(), memory_gib: 0.01, ..LiveSettings::default() };
    let window = follow(&settings, 4.0);
    std::thread::scope(|scope| {
        for (n, solver) in solvers.iter().enumerate() {
            scope.spawn(move || {
                // More steps than wait on the way.
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
            // Slower than the simulation would be by itself.
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
    let solver = Producer::open(&folder.0, plane(64), 2, Policy::NewestWins).unwrap();
    let window = follow(&settings(&folder), 50.0);
    let mut steps = 0;
    let mut publish_next = || {
        publish(&solver, steps, steps as f64, 1.0);
        steps += 1;
        steps
    };
    let burst = (0..3000).map(|_| publish_next()).last().unwrap();
    // However late the window's thread came to its first look.
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
