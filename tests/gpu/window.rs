//! Snapshots on the device.

use super::scenes::*;
use crate::kit::scene;
use ridgewatch::backend::BackendError;
use ridgewatch::backend::cuda::{CudaTracer, DeviceError, GpuSettings, SnapshotStore, Storage, Tuning};
use ridgewatch::backend::{CudaDevice, Device, WhenLost};
use ridgewatch::field::{DomainPoint, Window};
use ridgewatch::flow::{Boundary, Extras, FlowMap, Interpolation, Precision, Steps, Traced, VelocitySource};
use ridgewatch::run::{Event, RunOptions, RunReport, Steering, run};
use ridgewatch::surrogate::Trace;
use serde_json::json;
use std::collections::VecDeque;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

#[test]
#[ignore = "needs a GPU"]
fn a_slide_brings_only_what_is_new() {
    // A handle of its own, so that no other test's memory counts.
    let gpu = opened(GpuSettings::default());
    let store = SnapshotStore::new(&gpu);
    let grid = cartesian(even(&[40, 30, 20]));
    let map = FlowMap { boundary: Boundary::Clamp, ..map(3.0, 12) };
    let mut window = Window::new(3.0);
    for time in 0..4 {
        window.push(snapshot(&grid, f64::from(time), 0.5, false)).unwrap();
    }
    let mut taken = None;
    let mut before: Option<(CudaTracer, Traced, Vec<DomainPoint>)> = None;
    for slide in 0..12u32 {
        let source = VelocitySource::Window(Arc::new(window.clone()));
        let tracer = CudaTracer::new(&store, &gpu, source.clone(), &map, f64::from(slide), Tuning::default()).unwrap();
        assert_eq!(store.uploaded(), 4 + u64::from(slide));
        let seeds = fresh(&grid.domain(), 5000);
        let mut out = Traced::default();
        tracer.trace(&seeds, Extras::default(), &mut out).unwrap();
        let exact = on_cpu(&source, &map, f64::from(slide), &seeds);
        let odd = (0..seeds.len()).filter(|&i| (out.log_stretch_f64[i] - exact.log_stretch_f64[i]).abs() > 2e-9).count();
        // Paths along a cell face, as in trace.rs.
        assert!(odd <= 10, "slide {slide}: {odd} differ");
        // A tracer of the window before still answers as it did: its snapshots are not overwritten.
        if let Some((old, answered, asked)) = &before {
            let mut again = Traced::default();
            old.trace(asked, Extras::default(), &mut again).unwrap();
            assert_eq!(again.log_stretch_f64, answered.log_stretch_f64);
        }
        before = Some((tracer, out, seeds));
        if slide >= 2 {
            let used = gpu.memory().0;
            assert_eq!(*taken.get_or_insert(used), used, "memory is flat from slide to slide");
        }
        window.push(snapshot(&grid, f64::from(slide + 4), 0.5, false)).unwrap();
    }
}

/// Waits until `count` snapshots came over in all.
fn until_brought(store: &SnapshotStore, count: u64) {
    let began = std::time::Instant::now();
    while store.uploaded() < count {
        assert!(began.elapsed().as_secs() < 20, "{} of {count} came over", store.uploaded());
        std::thread::sleep(std::time::Duration::from_millis(1));
    }
}

#[test]
#[ignore = "needs a GPU"]
fn what_is_expected_is_there_before_the_window_wants_it() {
    for storage in Storage::ALL {
        let gpu = opened(GpuSettings::default());
        let store = SnapshotStore::new(&gpu);
        let tuning = Tuning { storage, ..Tuning::default() };
        let grid = cartesian(even(&[120, 90, 61]));
        let map = FlowMap { boundary: Boundary::Clamp, ..map(3.0, 12) };
        // From the tenth on there are velocities that half precision cannot hold at the scale of those before.
        let read: Vec<_> = (0..20).map(|t| snapshot(&grid, f64::from(t), if t < 9 { 0.05 } else { 1.0 }, false)).collect();
        // Told of between the thirteenth and the fourteenth, and taken by no window.
        let stray = snapshot(&grid, 0.0, 0.05, false);
        let mut window = Window::new(3.0);
        let mut taken = None;
        for (i, next) in read.iter().enumerate() {
            store.expect(next);
            if i == 12 {
                store.expect(&stray);
            }
            // The first four wait until there is a window; half precision is encoded anew for the tenth, by the window.
            if i > 3 && (storage == Storage::F32 || i < 9) {
                until_brought(&store, i as u64 + 1 + u64::from(i >= 12));
            }
            window.push(next.clone()).unwrap();
            if i < 3 {
                continue;
            }
            let (t0, source) = (i as f64 - 3.0, VelocitySource::Window(Arc::new(window.clone())));
            let tracer = CudaTracer::new(&store, &gpu, source.clone(), &map, t0, tuning).unwrap();
            let seeds = fresh(&grid.domain(), 2000);
            let (mut out, exact) = (Traced::default(), on_cpu(&source, &map, t0, &seeds));
            tracer.trace(&seeds, Extras::default(), &mut out).unwrap();
            let mut errors: Vec<f64> = (0..seeds.len()).map(|k| (out.log_stretch_f64[k] - exact.log_stretch_f64[k]).abs()).collect();
            errors.sort_by(f64::total_cmp);
            // Paths along a cell face, as in trace.rs; rounded velocities, as below.
            let most = errors[errors.len() * 99 / 100];
            assert!(most < if storage == Storage::F32 { 2e-9 } else { 2e-2 }, "{storage:?}, snapshot {i}: {most}");
            if storage == Storage::F32 {
                assert_eq!(store.prefetched(), i as u64 - 3, "snapshot {i}");
                // The stray one stays until the window has passed it by.
                if i >= 6 && i != 12 {
                    assert_eq!(*taken.get_or_insert(gpu.memory().0), gpu.memory().0, "memory is flat, snapshot {i}");
                }
            }
        }
        assert!(store.prefetched() >= 5, "{storage:?}");
        drop(store);
        assert_eq!(Arc::strong_count(&gpu), 1, "the thread has let go of the device");
    }
}

#[test]
#[ignore = "needs a GPU"]
fn nothing_comes_ahead_where_memory_is_short() {
    let grid = cartesian(even(&[40, 40, 40]));
    // A snapshot takes 1 MB, a window 4; there is room for a fifth beside the tracer, but others might need it.
    let gpu = opened(GpuSettings { memory_cap: Some(7 << 20), ..GpuSettings::default() });
    let store = SnapshotStore::new(&gpu);
    let map = FlowMap { boundary: Boundary::Clamp, ..map(3.0, 6) };
    let mut window = Window::new(3.0);
    for t in 0..8_u32 {
        let next = snapshot(&grid, f64::from(t), 0.5, false);
        store.expect(&next);
        if t > 3 {
            std::thread::sleep(std::time::Duration::from_millis(50));
        }
        window.push(next).unwrap();
        if t >= 3 {
            let source = VelocitySource::Window(Arc::new(window.clone()));
            CudaTracer::new(&store, &gpu, source, &map, f64::from(t) - 3.0, Tuning::default()).unwrap();
        }
    }
    assert_eq!((store.uploaded(), store.prefetched()), (8, 0));
}

#[test]
#[ignore = "needs a GPU"]
fn half_precision_is_as_good_as_its_rounding() {
    let linear = FlowMap { boundary: Boundary::Clamp, precision: Precision::F32, ..map(5.0, 20) };
    let cubic = FlowMap { interpolation: Interpolation::Cubic, ..linear.clone() };
    let region = smooth(&sphere((-30.0, 10.0, 21), (20.0, 60.0, 21), false), 0.8, false);
    let shorter = |map: &FlowMap| FlowMap { tau: 3.2, steps: Steps::Fixed(16), ..map.clone() };
    for (name, source, map) in [
        ("linear", turbulence([48, 32, 32], 6), linear.clone()),
        ("cubic", turbulence([48, 32, 32], 6), cubic.clone()),
        ("cubic in the plane", smooth(&cartesian(even(&[40, 30])), 0.6, false), shorter(&cubic)),
        ("sphere", region.clone(), shorter(&linear)),
        (
            "levels",
            smooth(&levels((-30.0, 10.0, 21), (20.0, 60.0, 21), &[0.0, 0.5, 1.0, 1.5, 2.0, 2.5], false), 0.5, false),
            shorter(&linear),
        ),
        ("sphere, cubic", region, shorter(&cubic)),
    ] {
        let seeds = fresh(&domain(&source), 20_000);
        let exact = on_cpu(&source, &FlowMap { precision: Precision::F64, ..map.clone() }, 0.0, &seeds);
        let rms = |found: &Traced| {
            let squares = (0..seeds.len()).map(|i| (f64::from(found.log_stretch[i]) - exact.log_stretch_f64[i]).powi(2)).sum::<f64>();
            (squares / seeds.len() as f64).sqrt()
        };
        let of = |storage, keep, sorted| rms(&on_gpu(&source, &map, 0.0, Tuning { storage, keep, sorted, ..Tuning::default() }, &seeds));
        let half = of(Storage::F16, true, true);
        measured!("half precision, {name}: root mean square error of the log-stretch {half:.1e}");
        // Velocities are off by 2^-12 of themselves, their differences between nodes by some 1e-3; errors of single nodes average out along
        // a path. Log-stretches here are about 1.
        assert!(half < 5e-3 && half > 1e-6, "{name}: {half}");
        for (storage, keep, sorted) in [(Storage::F16, false, false), (Storage::F16Pairs, true, true), (Storage::F16Pairs, false, false)] {
            let other = of(storage, keep, sorted);
            // Changes between snapshots, at most twice as large as velocities, are rounded once more: at a share w of the interval the
            // variance is (1 - w)^2 + w^2, and with them (1 - w)^2 + w^2 (1 + 4): over all w three times as much.
            let most = if storage == Storage::F16Pairs { 3f64.sqrt() } else { 1.0 };
            assert!(other > 0.9 * half && other < 1.1 * most * half, "{name}, {storage:?}, {keep}: {half} {other}");
        }
    }
}

#[test]
#[ignore = "needs a GPU"]
fn pairs_lead_to_the_snapshot_that_follows_in_this_window() {
    let (gpu, grid) = (gpu(), cartesian(even(&[16, 16, 16])));
    let store = SnapshotStore::new(&gpu);
    let tuning = Tuning { storage: Storage::F16Pairs, ..Tuning::default() };
    let map = FlowMap { boundary: Boundary::Clamp, ..map(3.0, 12) };
    let read: Vec<_> = (0..4).map(|t| snapshot(&grid, f64::from(t), 0.5, t == 2)).collect();
    let window = |kept: &[usize]| {
        let mut window = Window::new(3.0);
        for &k in kept {
            window.push(read[k].clone()).unwrap();
        }
        VelocitySource::Window(Arc::new(window))
    };
    let seeds = fresh(&grid.domain(), 2000);
    // The second window is thinned in time; the first one's tracer goes on, and so do both beside the third.
    let windows = [window(&[0, 1, 2, 3]), window(&[0, 2, 3]), window(&[0, 1, 3])];
    let tracers = windows.each_ref().map(|source| CudaTracer::new(&store, &gpu, source.clone(), &map, 0.0, tuning).unwrap());
    for (source, tracer) in windows.iter().zip(&tracers) {
        let (mut out, exact) = (Traced::default(), on_cpu(source, &map, 0.0, &seeds));
        tracer.trace(&seeds, Extras::default(), &mut out).unwrap();
        // As below; another snapshot's changes would be as large as velocities.
        let odd = (0..seeds.len()).filter(|&i| (out.log_stretch_f64[i] - exact.log_stretch_f64[i]).abs() > 2e-2).count();
        assert!(odd <= seeds.len() / 50, "{odd} differ");
    }
    assert_eq!(store.uploaded(), 4 + 1 + 2, "the first snapshot for each window, and the one that was left out");
}

#[test]
#[ignore = "needs a GPU"]
fn a_window_that_grows_beyond_half_precision_is_encoded_anew() {
    let (gpu, grid) = (gpu(), cartesian(even(&[16, 16, 16])));
    let store = SnapshotStore::new(&gpu);
    let tuning = Tuning { storage: Storage::F16, ..Tuning::default() };
    let map = FlowMap { boundary: Boundary::Clamp, ..map(1.0, 1) };
    let mut window = Window::new(1.0);
    window.push(snapshot(&grid, 0.0, 1e-3, false)).unwrap();
    window.push(snapshot(&grid, 1.0, 1e-3, false)).unwrap();
    CudaTracer::new(&store, &gpu, VelocitySource::Window(Arc::new(window.clone())), &map, 0.0, tuning).unwrap();
    window.push(snapshot(&grid, 2.0, 1.0, false)).unwrap();
    let source = VelocitySource::Window(Arc::new(window));
    let tracer = CudaTracer::new(&store, &gpu, source.clone(), &map, 1.0, tuning).unwrap();
    assert_eq!(store.uploaded(), 4, "the snapshot that is still needed came over again");
    let seeds = fresh(&grid.domain(), 5000);
    let (mut out, exact) = (Traced::default(), on_cpu(&source, &map, 1.0, &seeds));
    tracer.trace(&seeds, Extras::default(), &mut out).unwrap();
    let mut errors: Vec<f64> = (0..seeds.len()).map(|i| (out.log_stretch_f64[i] - exact.log_stretch_f64[i]).abs()).collect();
    errors.sort_by(f64::total_cmp);
    // Had the larger velocities been cut off at the range of half precision, this would be of order 1. In the worst percent, rounded
    // velocities take a stage across a cell face, where the gradient jumps.
    let most = errors[errors.len() * 99 / 100];
    assert!(most < 2e-2, "{most}");
}

#[test]
#[ignore = "needs a GPU"]
fn a_window_that_does_not_fit_is_refused_with_the_way_out() {
    let gpu = opened(GpuSettings { memory_cap: Some(3 << 20), ..GpuSettings::default() });
    let source = turbulence([40, 40, 40], 4);
    let map = FlowMap { boundary: Boundary::Clamp, ..map(3.0, 6) };
    let refused = CudaTracer::new(&SnapshotStore::new(&gpu), &gpu, source, &map, 0.0, Tuning::default()).err().unwrap();
    let BackendError::Device(error) = refused else { panic!("{refused}") };
    assert!(
        matches!(&error, DeviceError::WindowTooLarge { snapshots: 4, missing: 4, needed: 4_096_000, needed_f16: 2_048_000, .. }),
        "{error:?}"
    );
    assert!(error.to_string().contains("f16") && error.to_string().contains("region of interest"), "{error}");
    assert_eq!(gpu.memory().0, 0, "nothing is kept of it");
}

#[test]
#[ignore = "needs a GPU"]
fn a_slide_that_does_not_fit_names_the_whole_window_and_what_it_lacks() {
    let gpu = opened(GpuSettings { memory_cap: Some(7 << 20), ..GpuSettings::default() });
    let (store, grid) = (SnapshotStore::new(&gpu), cartesian(even(&[40, 40, 40])));
    let mut window = Window::new(3.0);
    for t in 0..4_u32 {
        window.push(snapshot(&grid, f64::from(t), 0.5, false)).unwrap();
    }
    let _held = store.window(&window, Storage::F32).unwrap();
    // Somebody takes what is left.
    let _taken = gpu.alloc::<u8>("a test", gpu.memory_left() as usize).unwrap();
    window.push(snapshot(&grid, 4.0, 0.5, false)).unwrap();
    let error = store.window(&window, Storage::F32).err().unwrap();
    assert!(
        matches!(&error, DeviceError::WindowTooLarge { snapshots: 4, missing: 1, needed: 1_024_000, needed_f16: 2_048_000, .. }),
        "{error:?}"
    );
}

#[test]
#[ignore = "needs a GPU"]
fn a_snapshot_that_others_hold_is_let_go_all_the_same() {
    let gpu = opened(GpuSettings::default());
    let (store, grid) = (SnapshotStore::new(&gpu), cartesian(even(&[16, 16, 16])));
    let mut window = Window::new(3.0);
    // A source that uses the memory of its snapshots again waits for the last of the others.
    let made: Vec<_> = (0..12_u32).map(|t| snapshot(&grid, f64::from(t), 0.5, false)).collect();
    for snapshot in &made {
        store.expect(snapshot);
        window.push(snapshot.clone()).unwrap();
        store.window(&window, Storage::F32).unwrap();
    }
    let began = std::time::Instant::now();
    while made[..8].iter().any(|snapshot| Arc::strong_count(snapshot) > 1) {
        assert!(began.elapsed().as_secs() < 5, "still held");
        std::thread::sleep(std::time::Duration::from_millis(5));
    }
}

/// Left to the run, windows are held in half precision, and pictures do not show it.
#[test]
#[ignore = "needs a GPU"]
fn smooth_pictures_do_not_show_half_precision() {
    let keys = "
        source.nodes = [96, 48, 48]
        source.snapshots = 14
        time.tau = 8
        time.frames_per_slide = 1
        transfer.low = 0.1
        transfer.high = 0.4
        render.method = \"two_level\"
        surrogate.kind = \"table\"
    ";
    let text = scene::scene("turbulence", [192, 96, 4], keys);
    let gpu = opened(GpuSettings::default());
    let run = |storage| {
        let device = Device::Cuda(CudaDevice { gpu: gpu.clone(), storage, when_lost: WhenLost::Stop, may_fall_back: false });
        let mut frames = Vec::new();
        let report =
            scene::run_frames(scene::setup(&text, &[]), &RunOptions { device, ..RunOptions::default() }, |frame| frames.push(frame));
        (report, frames)
    };
    let decision =
        |report: &RunReport| report.decisions.iter().find(|d| d.setting == "device.storage").map(|d| (d.chosen.clone(), d.why.clone()));
    let ((single, before), (open, after)) = (run(Some(Storage::F32)), run(None));
    assert_eq!(decision(&single), None);
    let (chosen, why) = decision(&open).unwrap();
    println!("{chosen}: {why}");
    assert_eq!(chosen, "f16_pairs");
    assert!(before.len() == after.len() && before.len() > 3);
    for (before, after) in before.iter().zip(&after) {
        let squares =
            before.film.rgba.iter().zip(&after.film.rgba).map(|(a, b)| (0..3).map(|k| f64::from(a[k] - b[k]).powi(2)).sum::<f64>() / 3.0);
        let rms = (squares.sum::<f64>() / before.film.rgba.len() as f64).sqrt();
        let stated = before.record.picture_error.unwrap().rms.value;
        println!("slide {}: films differ by {rms:.2e} rms, stated error {stated:.2e}", before.record.slide);
        assert!(rms > 0.0 && rms < 0.7 * stated, "as many samples, of the same random numbers: {rms} of {stated}");
    }
}

/// Slides, cameras and finer tables come and go, and a subscriber keeps the newest films.
#[test]
#[ignore = "needs a GPU"]
fn memory_is_flat_over_a_thousand_frames_of_smooth_pictures() {
    const SLIDES: u64 = 20;
    const FRAMES: u64 = 50;
    let keys = format!(
        "source.nodes = [48, 24, 24]\nsource.snapshots = {}\ntime.tau = 5\ntime.frames_per_slide = {FRAMES}\nflow.steps = 20\n
        transfer.low = 0.05\ntransfer.high = 0.3\nrender.method = \"two_level\"\nsurrogate.kind = \"table\"\n",
        SLIDES + 5
    );
    let setup = scene::setup(&scene::scene("turbulence", [96, 48, 1], &keys), &[]);
    // A handle of its own, so that no other test's memory counts.
    let gpu = opened(GpuSettings::default());
    let steering = Arc::new(Steering::new(&setup.plan));
    let device = Device::Cuda(CudaDevice { gpu: gpu.clone(), storage: None, when_lost: WhenLost::Stop, may_fall_back: false });
    let options = RunOptions { device, steering: Some(Arc::clone(&steering)), ..RunOptions::default() };
    let (mut held, mut taken, mut frames) = (VecDeque::new(), Vec::new(), 0);
    let mut sink = |event: Event| {
        let Event::Frame(frame) = event else { return };
        frames += 1;
        let of_slide = frame.record.frame % FRAMES;
        if of_slide == FRAMES / 2 {
            let z = 80.0 + frame.record.slide as f64;
            let camera = json!({"eye": [24, 12, z], "look_at": [24, 12, 12], "up": [0, 1, 0], "orthographic": true});
            steering.command(json!({"camera": camera}).as_object().unwrap()).unwrap();
        }
        if of_slide + 1 == FRAMES {
            taken.push(gpu.memory().0);
        }
        held.push_back(frame);
        if held.len() > 8 {
            held.pop_front();
        }
    };
    run(setup, &options, &mut sink, &AtomicBool::new(false)).unwrap();
    println!("{frames} frames, bytes at the end of each slide: {taken:?}");
    assert_eq!((frames, taken.len() as u64), (SLIDES * FRAMES, SLIDES));
    // The first slides fill what is kept from slide to slide; before the last ones fewer snapshots wait.
    assert!(taken[6..].iter().all(|bytes| *bytes <= taken[5]), "{taken:?}");
}
