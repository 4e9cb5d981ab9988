//! `live.memory_gib` bounds all memory for following a simulation: windows, steps that wait for their blocks, and buffers. The test counts the
//! heap of its process, which therefore runs nothing else.

#![allow(clippy::unwrap_used, clippy::print_stdout)]

mod kit;

use kit::ring::{self, Ring, columns};
use ridgewatch::source::live::{Live, LiveSettings, Taken};
use ridgewatch_wire::{Policy, Producer};
use std::alloc::{GlobalAlloc, Layout, System};
use std::sync::atomic::{AtomicBool, AtomicIsize, Ordering};
use std::time::{Duration, Instant};

/// Counts the bytes on the heap of the process, and their peak.
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

/// Time after which a test that hangs fails.
const LONG: Duration = Duration::from_secs(120);
const NODES: u64 = 256;
/// Bytes of a snapshot; a step of two components has half of them.
const SNAPSHOT: f64 = 16.0 * (NODES * NODES) as f64;
/// Allowance for names, descriptions and messages.
const SMALL: f64 = 0.5 * SNAPSHOT;

#[test]
fn windows_waiting_steps_and_buffers_stay_below_the_limit() {
    let ring = Ring::new("live-memory");
    let blocks = columns(NODES, 2).into_iter();
    let solvers: Vec<_> = blocks.map(|block| Producer::open(&ring.0, block, 8, Policy::Wait(Duration::from_millis(20))).unwrap()).collect();
    let plane = vec![1.0f32; (NODES * NODES / 2) as usize];
    let publish = |block: usize, step: u64| ring::publish(&solvers[block], step, step as f64, &[&plane[..]; 2]);
    // Eight snapshots, twice.
    let limit = (2.0 * 8.0 + 2.0) * SNAPSHOT + 5.0 * SNAPSHOT / 2.0;
    let settings = LiveSettings { ring: Some(ring.0.clone()), memory_gib: limit / f64::from(1 << 30), ..LiveSettings::default() };
    let before = HELD.load(Ordering::Relaxed);
    PEAK.store(before, Ordering::Relaxed);
    let window = Live::connect(&settings, &AtomicBool::new(false), &mut |_| {}).unwrap().unwrap().follow(6.0, 1).unwrap();
    let (mut frame, mut incomplete) = (None::<Taken>, 0);
    let most = || (PEAK.load(Ordering::Relaxed) - before) as f64;
    // Until everything that takes memory has been used; a slow machine loses more steps.
    let (mut step, begin) = (0, Instant::now());
    loop {
        publish(0, step);
        // At times one block is six steps behind the other, more than may wait at once.
        let behind = if step % 60 < 45 { 0 } else { 6 };
        publish(1, step - behind);
        // A frame takes longer than a window of steps; then its window is dropped.
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
}
