//! `live.memory_gib` bounds all that following a simulation takes: windows, steps that wait for their blocks, and buffers.

#![allow(clippy::unwrap_used, clippy::print_stdout)]

use ridgewatch::source::live::{Live, LiveSettings, Taken};
use ridgewatch_wire::{AxisDescription, BlockExtent, Description, Element, Field, Geometry, Policy, Producer};
use std::alloc::{GlobalAlloc, Layout, System};
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, AtomicIsize, Ordering};
use std::time::{Duration, Instant};

/// Counts what the process holds on its heap, and its peak.
struct Counting;

static HELD: AtomicIsize = AtomicIsize::new(0);
static PEAK: AtomicIsize = AtomicIsize::new(0);

// SAFETY: every request goes to the system's allocator unchanged.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        let held = HELD.fetch_add(layout.size() as isize, Ordering::Relaxed) + layout.size() as isize;
        PEAK.fetch_max(held, Ordering::Relaxed);
        // SAFETY: the caller's promise.
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        HELD.fetch_sub(layout.size() as isize, Ordering::Relaxed);
        // SAFETY: the caller's promise.
        unsafe { System.dealloc(pointer, layout) }
    }
}

#[global_allocator]
static COUNTING: Counting = Counting;

/// After so long a test that hangs fails.
const LONG: Duration = Duration::from_secs(120);
const NODES: u64 = 256;
/// Of a snapshot; a step of two components has half of it.
const SNAPSHOT: f64 = 16.0 * (NODES * NODES) as f64;
/// For names, descriptions and words.
const SMALL: f64 = 0.5 * SNAPSHOT;

#[test]
fn windows_waiting_steps_and_buffers_stay_below_the_limit() {
    let ring = PathBuf::from("/dev/shm").join(format!("rw-live-memory-{}", std::process::id()));
    let _ = std::fs::remove_dir_all(&ring);
    let axis = |name| AxisDescription::uniform(name, "m", 0.0, 1.0, NODES);
    let half = |index: u32| {
        let mut description = Description::whole(Geometry::Cartesian, vec![axis("x"), axis("y")], "s");
        let offset = [0, NODES / 2 * u64::from(index), 0];
        description.block = BlockExtent { index, count: 2, offset, extent: [NODES, NODES / 2, 1] };
        description
    };
    let solvers = [0, 1].map(|block| Producer::open(&ring, half(block), 8, Policy::Wait(Duration::from_millis(20))).unwrap());
    let plane = vec![1.0f32; (NODES * NODES / 2) as usize];
    let publish = |block: usize, step: u64| {
        let components = [plane.as_ptr().cast::<u8>(); 2];
        // SAFETY: a value a node of the block.
        unsafe { solvers[block].publish(step, step as f64, &Field::packed(&components, Element::F32, [NODES, NODES / 2, 1])).unwrap() };
    };
    // Eight snapshots, twice.
    let limit = (2.0 * 8.0 + 2.0) * SNAPSHOT + 5.0 * SNAPSHOT / 2.0;
    let settings = LiveSettings { ring: Some(ring.clone()), memory_gib: limit / f64::from(1 << 30), ..LiveSettings::default() };
    let before = HELD.load(Ordering::Relaxed);
    PEAK.store(before, Ordering::Relaxed);
    let window = Live::connect(&settings, &AtomicBool::new(false), &mut |_| {}).unwrap().unwrap().follow(6.0, 1).unwrap();
    let (mut frame, mut incomplete) = (None::<Taken>, 0);
    let most = || (PEAK.load(Ordering::Relaxed) - before) as f64;
    // Until all that takes memory was there; on a slow machine more steps are lost on the way.
    let (mut step, begin) = (0, Instant::now());
    loop {
        publish(0, step);
        // Now and then one block is six steps behind the other, more than wait at once.
        let behind = if step % 60 < 45 { 0 } else { 6 };
        publish(1, step - behind);
        // A frame takes as long as a window of steps and more; then its window goes.
        if step % 12 == 11 {
            frame = None;
            if let Ok(Some(Ok(taken))) = window.next_within(Duration::from_millis(200)) {
                incomplete = taken.live.steps_incomplete;
                frame = Some(taken);
            }
        }
        step += 1;
        let reached = most() > 0.7 * limit && incomplete > 20 && frame.as_ref().is_some_and(|taken| taken.live.snapshots >= 7);
        if reached && step >= 600 {
            break;
        }
        assert!(begin.elapsed() < LONG, "{} of {limit}, {incomplete} incomplete: {:?}", most(), frame.map(|taken| taken.live));
    }
    let taken = frame.unwrap();
    assert!(taken.window.is_full());
    let most = most();
    println!("{most} bytes at most, {limit} allowed, {} snapshots in the window, {incomplete} steps incomplete", taken.live.snapshots);
    assert!(most <= limit + SMALL, "{most} bytes, {limit} allowed");
    drop((window, solvers, taken));
    let _ = std::fs::remove_dir_all(&ring);
}
