//! A GPU that fails at any of the calls that are made of it, with a fault or by refusing what it took before: on machines without one, a device that computes on the
//! CPU and breaks when it is told to stands for it. (`tests/gpu/lost.rs` breaks a real one.)

#![cfg(feature = "cuda")]
#![allow(clippy::unwrap_used)]

mod device;

use device::{BATCH, Breaking, How, NAME, STEP_SECONDS, STEPS};
use ridgewatch::config::SceneFile;
use ridgewatch::engine::{Device, EngineError, Event, FrameRecord, RunOptions, Setup, StageSeconds, WhenLost, run};
use ridgewatch::field::Domain;
use ridgewatch::field::analytic::Analytic;
use ridgewatch::flow::{Boundary, Direction, FlowMap, Integrator, Interpolation, Normalisation, Precision, Steps, VelocitySource};
use ridgewatch::surrogate::Learned;
use std::collections::BTreeSet;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

/// A run's frames: records without what differs from run to run, and the films' bits.
#[derive(Default)]
struct Made {
    records: Vec<FrameRecord>,
    films: Vec<Vec<u32>>,
    error: Option<EngineError>,
}

fn made(scene: &SceneFile, device: Device) -> Made {
    made_with(scene, RunOptions { device, threads: 2, ..RunOptions::default() })
}

fn made_with(scene: &SceneFile, options: RunOptions) -> Made {
    made_behind(scene, options, &mut |_| ())
}

/// The same; `behind` is called behind each frame.
fn made_behind(scene: &SceneFile, options: RunOptions, behind: &mut (dyn FnMut(u64) + Send)) -> Made {
    let mut made = Made::default();
    let mut sink = |event: Event| {
        if let Event::Frame(frame) = event {
            let film = &frame.film;
            let rgba = film.rgba.iter().flatten();
            let rest = [&film.ftle_mean, &film.traced, &film.variance, &film.samples, &film.missing, &film.queries];
            made.films.push(rgba.chain(rest.into_iter().flatten()).map(|v| v.to_bits()).collect());
            made.records.push((*frame.record).clone());
            behind(frame.record.frame);
        }
    };
    made.error = run(Setup::new(scene.settings()).unwrap(), &options, &mut sink, &AtomicBool::new(false)).err();
    made
}

fn on(device: &Arc<Breaking>, scene: &SceneFile) -> Made {
    made(scene, Device::Gpu { gpu: device.clone(), may_fall_back: false })
}

/// What a record says of the work, whoever did it.
fn figures(record: &FrameRecord) -> FrameRecord {
    let training = record.training.clone().map(|learned| Learned { seconds: 0.0, device_seconds: None, warnings: Vec::new(), ..learned });
    FrameRecord { device: String::new(), warnings: Vec::new(), seconds: StageSeconds::default(), training, ..record.clone() }
}

fn has_ended(record: &FrameRecord) -> usize {
    record.warnings.iter().filter(|w| w.contains("work on the GPU has ended") && w.contains("broken by the test")).count()
}

/// Warnings of memory that a device lacks, or of what it does not do, and works on.
fn shortages(record: &FrameRecord) -> usize {
    told_of(&record.warnings)
}

fn told_of(warnings: &[String]) -> usize {
    let when = ["whenever the GPU's memory is short", "which the GPU does not do"];
    warnings.iter().filter(|w| when.iter().any(|when| w.contains(when)) && w.contains("broken by the test")).count()
}

/// A device that has no memory for one kind of call, or does not do it, works on, even where a run is to end with it: the CPU does what those calls were
/// for, which is told once.
fn refuse_each(scene: &SceneFile, kinds: &[&'static str]) {
    let expected = made(scene, Device::CPU);
    for (&kind, how) in kinds.iter().flat_map(|kind| [How::RefusalOf(kind), How::LackOf(kind)].map(|how| (kind, how))) {
        let device = Breaking::new(0, how, WhenLost::Stop);
        let found = on(&device, scene);
        assert!(found.error.is_none() && device.line.broke_in.get() == Some(&kind), "{kind}: {:?}", found.error);
        assert!(found.films == expected.films, "{kind}: the films are the CPU's");
        for (found, expected) in found.records.iter().zip(&expected.records) {
            assert_eq!(figures(found), figures(expected), "{kind}: nothing is counted twice or not at all");
            assert_eq!((found.device.as_str(), has_ended(found)), (NAME, 0), "{kind}");
        }
        assert_eq!(found.records.iter().map(shortages).collect::<Vec<_>>()[..2], [1, 0], "{kind}: told once, by the first frame");
        assert_eq!(found.records.iter().map(shortages).sum::<usize>(), 1, "{kind}: told once");
        let calls = device.line.calls.lock().unwrap();
        assert!(calls.iter().filter(|call| **call == kind).count() > 1, "{kind}: asked again");
    }
}

/// Breaks the device at every call of a run in turn.
fn break_everywhere(scene: &SceneFile, kinds: &[&'static str]) {
    let expected = made(scene, Device::CPU);
    assert!(expected.error.is_none() && expected.records.len() >= 4);
    for how in [How::Fault, How::Refusal] {
        break_at_every_call(scene, &expected, how, kinds);
    }
}

fn break_at_every_call(scene: &SceneFile, expected: &Made, how: How, kinds: &[&'static str]) {
    let whole = Breaking::new(usize::MAX, how, WhenLost::Cpu);
    let unbroken = on(&whole, scene);
    assert!(unbroken.error.is_none() && unbroken.films == expected.films);
    assert!(unbroken.records.iter().all(|r| r.device == NAME && has_ended(r) == 0));
    let asked = whole.line.calls.lock().unwrap().clone();
    // Of every kind of call some, from the first to the last: a few dozen runs instead of thousands.
    let chosen = || kinds.iter().flat_map(|&kind| some(&asked, kind).into_iter().map(move |breaks_at| (kind, breaks_at)));

    let mut broke_in = BTreeSet::new();
    for (kind, breaks_at) in chosen() {
        let device = Breaking::at(kind, breaks_at, how, WhenLost::Cpu);
        let found = on(&device, scene);
        // How often a trace is cut up depends on the machine's speed: the last calls may not come.
        let Some(what) = device.line.broke_in.get() else { continue };
        broke_in.insert(*what);
        let case = format!("{how:?} behind {breaks_at} calls, {what}");
        if how == How::Refusal && ["making a tracer", "bringing a snapshot over"].contains(what) && found.films.is_empty() {
            // What a device that was asked for by name refuses from the start is an error of the request.
            assert!(matches!(found.error, Some(EngineError::Device(_))), "{case}: {:?}", found.error);
            continue;
        }
        assert!(found.error.is_none(), "{case}: {:?}", found.error);
        assert!(found.films == expected.films, "{case}: the films are the CPU's");
        for (found, expected) in found.records.iter().zip(&expected.records) {
            assert_eq!(figures(found), figures(expected), "{case}: nothing is counted twice or not at all");
        }
        let told: Vec<usize> = (0..found.records.len()).filter(|&i| has_ended(&found.records[i]) > 0).collect();
        assert!(found.records.iter().map(has_ended).sum::<usize>() <= 1, "{case}: told once");
        let is_short = found.records.iter().any(|record| shortages(record) > 0);
        // Behind those two it may be lost, or short, or neither.
        let may_be = how == How::Refusal && ["making a renderer", "bringing a snapshot over"].contains(what);
        assert!(how == How::Fault || *what != "making a tracer" || told.is_empty(), "{case}: {told:?}");
        assert!(may_be || is_short == (how == How::Refusal), "{case}: {is_short}");
        for (i, record) in found.records.iter().enumerate() {
            match told.first() {
                Some(&told) if i > told => assert_eq!(record.device, "cpu", "{case}, frame {i}"),
                Some(&told) if i == told => {}
                _ => assert_eq!(record.device, NAME, "{case}, frame {i}"),
            }
        }
    }
    assert_eq!(broke_in, kinds.iter().copied().collect(), "kinds of calls that broke");

    if how == How::Refusal {
        return;
    }
    let mut ended = 0;
    for (kind, breaks_at) in chosen() {
        let device = Breaking::at(kind, breaks_at, how, WhenLost::Stop);
        let found = on(&device, scene);
        let Some(what) = device.line.broke_in.get() else { continue };
        let case = format!("{how:?} behind {breaks_at} calls, {what}");
        match &found.error {
            Some(EngineError::Device(error)) => {
                assert!(error.to_string().contains("broken by the test"), "{case}: {error}");
                assert!(found.films.len() < expected.films.len(), "{case}");
                ended += 1;
            }
            Some(other) => panic!("{case}: {other}"),
            // Snapshots come over beside everything else, the end of the run included.
            None => assert!(*what == "bringing a snapshot over" && found.films.len() == expected.films.len(), "{case}"),
        }
        assert!(expected.films.starts_with(&found.films), "{case}: the frames before are whole, the broken one is not given");
        assert!(found.records.iter().all(|r| r.device == NAME && has_ended(r) == 0), "{case}");
    }
    assert!(ended > 0);
}

/// Up to a dozen calls of a kind, evenly spread: behind how many of them each comes.
fn some(asked: &[&str], kind: &str) -> Vec<usize> {
    const MOST: usize = 12;
    let calls = asked.iter().filter(|call| **call == kind).count();
    let count = calls.min(MOST);
    (0..count).map(|i| i * (calls - 1) / (count - 1).max(1)).collect()
}

#[test]
fn reference_frames_of_a_closed_form() {
    let scene = SceneFile::parse(
        Path::new("scene.toml"),
        "
[source]
kind = \"double_gyre\"
[domain]
min = [0, 0, 0]
max = [2, 1, 0.2]
[time]
tau = 5
step = 0.1
slides = 2
frames_per_slide = 2
[flow]
steps = 10
[trust]
cells = [4, 2, 1]
[render]
method = \"reference\"
width = 16
height = 8
samples = 2
",
        &[],
    )
    .unwrap();
    let kinds =
        ["making a tracer", "making a renderer", "starting a trace", "reading a trace back", "a wave of a frame", "reading a film back"];
    break_everywhere(&scene, &kinds);
    refuse_each(&scene, &kinds[2..]);
}

#[test]
fn gated_frames_with_a_table_over_a_sliding_window() {
    let scene = SceneFile::parse(
        Path::new("scene.toml"),
        "
[source]
kind = \"turbulence\"
nodes = [16, 8, 8]
snapshots = 9
[time]
tau = 4
[flow]
steps = 8
[surrogate]
kind = \"table\"
[trust]
cells = [2, 2, 2]
[render]
width = 16
height = 8
samples = 2
",
        &[],
    )
    .unwrap();
    break_everywhere(
        &scene,
        &[
            "making a tracer",
            "making a renderer",
            "tracing a table",
            "looking up in a table",
            "starting a trace",
            "reading a trace back",
            "an audit",
            "bringing a snapshot over",
        ],
    );
    refuse_each(&scene, &["tracing a table", "looking up in a table", "starting a trace", "reading a trace back", "an audit"]);
}

/// What `--device auto` may do without from the start, and not once it was taken up.
#[test]
fn a_device_chosen_by_itself_may_refuse_its_first_work_alone() {
    let flow = Analytic::Saddle { rate: 1.0 };
    let source = VelocitySource::Analytic(flow, Domain::slab([-1.0; 2], [1.0; 2], (0.0, 1.0)));
    let map = FlowMap {
        tau: 1.0,
        direction: Direction::Forward,
        integrator: Integrator::Tangent,
        precision: Precision::F32,
        steps: Steps::Fixed(8),
        difference_step: 1e-3,
        boundary: Boundary::Unbounded,
        normalisation: Normalisation::Tau,
        interpolation: Interpolation::Linear,
    };
    let tracer = |device: &Device| device.tracer(source.clone(), &map, 0.0).map(|(_, told)| told);
    let device = |breaks_at| Device::Gpu { gpu: Breaking::new(breaks_at, How::Refusal, WhenLost::Stop), may_fall_back: true };

    let refusing = device(0);
    for _ in 0..2 {
        let told = tracer(&refusing).unwrap().unwrap();
        assert!(told.contains("on the CPU") && told.contains("broken by the test"), "{told}");
    }
    let taken_up = device(1);
    assert_eq!(tracer(&taken_up).unwrap(), None);
    assert!(matches!(tracer(&taken_up), Err(EngineError::Device(_))));
}

/// A residual over a sliding window.
fn residual(keys: &[String]) -> SceneFile {
    SceneFile::parse(
        Path::new("scene.toml"),
        &format!(
            "
[source]
kind = \"turbulence\"
nodes = [16, 8, 8]
snapshots = 9
[time]
tau = 4
[flow]
steps = 8
[surrogate]
kind = \"residual\"
[network]
levels = 4
log2_table = 8
width = 16
batch = {BATCH}
[training]
steps_per_frame = {STEPS}
[trust]
cells = [2, 2, 2]
[render]
width = 16
height = 8
samples = 2
"
        ),
        keys,
    )
    .unwrap()
}

/// A device that works, without memory to train on: the network is trained on the CPU from the first step, which is told once, and frames stay on
/// the device.
#[test]
fn without_memory_for_training_frames_stay_on_the_device() {
    let scene = residual(&[]);
    let expected = made(&scene, Device::CPU);
    let full = Breaking::new(usize::MAX, How::Fault, WhenLost::Stop);
    full.line.takes.store(false, std::sync::atomic::Ordering::Relaxed);
    let found = made(&scene, Device::Gpu { gpu: full.clone(), may_fall_back: false });
    assert!(found.error.is_none() && found.films == expected.films && expected.films.len() >= 4);
    for (found, expected) in found.records.iter().zip(&expected.records) {
        assert_eq!(figures(found), figures(expected));
        assert_eq!(found.device, NAME);
        assert!(found.training.as_ref().is_some_and(|learned| learned.device_seconds.is_none() && learned.steps == STEPS));
    }
    let told = |i: usize| found.records[i].warnings.iter().filter(|told| told.contains("trained on the CPU: no room")).count();
    assert!(told(0) == 1 && (1..found.records.len()).all(|i| told(i) == 0));
    assert_eq!(some(&full.line.calls.lock().unwrap(), "taking a network over").len(), 1, "asked once");
}

/// A device that has memory to train on, and then lacks it: training comes back with all that was learned, which is told once, and frames stay on the
/// device, even where a run is to end with it.
#[test]
fn training_that_runs_out_of_memory_comes_back_with_what_it_has_learned() {
    let scene = residual(&[]);
    let expected = made(&scene, Device::CPU);
    let whole = Breaking::new(usize::MAX, How::Fault, WhenLost::Stop);
    assert!(on(&whole, &scene).error.is_none());
    let asked = whole.line.calls.lock().unwrap().clone();
    for kind in ["bringing samples over", "taking steps", "keeping a network", "freezing a network"] {
        let places = some(&asked, kind);
        assert!(places.len() > 1, "{kind}");
        for breaks_at in places {
            let case = format!("{kind} behind {breaks_at} calls");
            let device = Breaking::at(kind, breaks_at, How::RefusalOf(kind), WhenLost::Stop);
            let found = on(&device, &scene);
            assert!(found.error.is_none() && device.line.broke_in.get() == Some(&kind), "{case}: {:?}", found.error);
            assert!(found.films == expected.films, "{case}: nothing learned is lost");
            let told = |record: &FrameRecord| record.warnings.iter().filter(|told| told.contains("trained on the CPU")).count();
            let mut there = true;
            for (i, (found, expected)) in found.records.iter().zip(&expected.records).enumerate() {
                assert_eq!((found.device.as_str(), has_ended(found)), (NAME, 0), "{case}, frame {i}");
                let (mut found_figures, mut expected_figures) = (figures(found), figures(expected));
                let [found_loss, expected_loss] =
                    [&mut found_figures, &mut expected_figures].map(|record| record.training.as_mut().unwrap().loss.take().unwrap());
                assert_eq!(found_figures, expected_figures, "{case}, frame {i}");
                // A frame's mean may be that of two parts.
                assert!((found_loss / expected_loss - 1.0).abs() < 1e-12, "{case}, frame {i}: {found_loss} {expected_loss}");
                there &= told(found) == 0;
                let seconds = found.training.as_ref().unwrap().device_seconds;
                // Of the frame in which it came back those of its first part, if there were any.
                assert!(seconds.is_some() == there || told(found) == 1, "{case}, frame {i}");
            }
            let seconds: f64 = found.records.iter().filter_map(|record| record.training.as_ref()?.device_seconds).sum();
            let steps = device.line.steps.load(Ordering::Relaxed) as f64;
            assert!((seconds - STEP_SECONDS * steps).abs() < 1e-9, "{case}: {seconds} s for {steps} steps");
            // What the last frame's training ran into is met by the next.
            let all: usize = found.records.iter().map(told).sum();
            assert!(all == 1 || all == 0 && kind == "freezing a network", "{case}: told {all} times");
        }
    }
}

/// The device has no memory for points to predict at, from some call on: the network that it has comes back, not that of some time ago.
#[test]
fn a_network_that_cannot_be_asked_answers_from_here() {
    let scene = residual(&[]);
    refuse_each(&scene, &["asking a network"]);
    let expected = made(&scene, Device::CPU);
    let whole = Breaking::new(usize::MAX, How::Fault, WhenLost::Stop);
    assert!(on(&whole, &scene).error.is_none());
    let asked = whole.line.calls.lock().unwrap().clone();
    for breaks_at in some(&asked, "asking a network") {
        let device = Breaking::at("asking a network", breaks_at, How::RefusalOf("asking a network"), WhenLost::Stop);
        let found = on(&device, &scene);
        assert!(found.error.is_none() && found.films == expected.films, "call {breaks_at}: {:?}", found.error);
        // How often a trace is cut up depends on the machine's speed: the last calls may not come.
        assert_eq!(
            found.records.iter().map(shortages).sum::<usize>(),
            usize::from(device.line.broke_in.get().is_some()),
            "call {breaks_at}"
        );
        let there = |record: &FrameRecord| record.training.as_ref().is_some_and(|learned| learned.device_seconds.is_some());
        assert!(found.records.iter().all(there), "call {breaks_at}: trained there all the same");
    }
}

/// Memory for a tracer of a slide, or of a shorter duration, which labels of networks with the duration as an input need: the CPU traces those, and the
/// device works on.
#[test]
fn a_tracer_may_be_refused() {
    let keys = ["surrogate.kind=\"network\"", "network.inputs=[\"duration\"]", "network.hidden_layers=1"].map(String::from);
    let scene = residual(&keys);
    let tracers = |device: &Arc<Breaking>| device.line.calls.lock().unwrap().iter().filter(|call| **call == "making a tracer").count();
    let whole = Breaking::new(usize::MAX, How::Fault, WhenLost::Stop);
    let unbroken = on(&whole, &scene);
    assert!(unbroken.error.is_none() && tracers(&whole) > 16 * unbroken.records.len(), "{:?}", unbroken.error);
    let asked = whole.line.calls.lock().unwrap().clone();
    // Behind the window's own.
    for breaks_at in some(&asked, "making a tracer").into_iter().skip(1) {
        let device = Breaking::at("making a tracer", breaks_at, How::RefusalOf("making a tracer"), WhenLost::Stop);
        let found = on(&device, &scene);
        assert!(found.error.is_none() && found.films == unbroken.films, "call {breaks_at}: {:?}", found.error);
        for (found, expected) in found.records.iter().zip(&unbroken.records) {
            assert_eq!(figures(found), figures(expected), "call {breaks_at}");
            assert_eq!((found.device.as_str(), has_ended(found)), (NAME, 0), "call {breaks_at}");
        }
        let told = |what: &str| found.records.iter().flat_map(|record| &record.warnings).filter(|told| told.contains(what)).count();
        // As above.
        assert_eq!(told("the CPU traced shorter durations"), usize::from(device.line.broke_in.get().is_some()), "call {breaks_at}");
        assert!(told("the CPU traced a slide") <= 1, "call {breaks_at}");
    }
}

/// Where a table does not fit when it is traced, the host keeps it, and training and frames have copies of it: they go before the next one is traced.
#[test]
fn copies_of_a_table_are_gone_when_the_next_is_traced() {
    let scene = residual(&[]);
    let expected = made(&scene, Device::CPU);
    let device = Breaking::new(usize::MAX, How::Fault, WhenLost::Stop);
    device.line.tables_fit.store(false, Ordering::Relaxed);
    let found = on(&device, &scene);
    assert!(found.error.is_none() && found.films == expected.films, "{:?}", found.error);
    let asked = device.line.calls.lock().unwrap().clone();
    assert!(some(&asked, "tracing a table").len() >= 4 && some(&asked, "bringing a table over").len() >= 4, "{asked:?}");
    assert_eq!(device.line.tables_before.load(Ordering::Relaxed), 0, "tables that were there when another was traced");
}

/// Without memory for the table below the network some calls learn nothing, and training stays on the device; but not for ever.
#[test]
fn memory_for_the_table_below_is_waited_for_a_while() {
    const IDLE: usize = 8;
    let scene = residual(&["time.frames_per_slide=3".into()]);
    for refused in [3, usize::MAX] {
        let device = Breaking::new(0, How::RefusalOf("bringing a table over"), WhenLost::Stop);
        device.line.tables_fit.store(false, Ordering::Relaxed);
        device.line.refusals.store(refused, Ordering::Relaxed);
        let found = on(&device, &scene);
        assert!(found.error.is_none() && found.records.len() > IDLE + 2, "{:?}", found.error);
        let idle = refused.min(IDLE);
        for (i, record) in found.records.iter().enumerate() {
            let learned = record.training.as_ref().unwrap();
            assert_eq!((record.device.as_str(), has_ended(record)), (NAME, 0), "frame {i}");
            assert_eq!(learned.steps, if i < idle { 0 } else { STEPS }, "frame {i} of {refused}");
            assert_eq!(learned.device_seconds.is_some(), i < idle || refused == 3, "frame {i} of {refused}");
            let told = |what: &str| record.warnings.iter().filter(|told| told.contains(what)).count();
            assert_eq!(told("learns nothing"), usize::from(i == 0), "frame {i} of {refused}");
            assert_eq!(told("trained on the CPU"), usize::from(i == IDLE && refused != 3), "frame {i} of {refused}");
        }
    }
}

/// What a slide ran into whose frames were never made is told by the report.
#[test]
fn what_is_met_behind_the_last_frame_is_told() {
    let scene = residual(&[]);
    let device = Breaking::at("tracing a table", 1, How::RefusalOf("tracing a table"), WhenLost::Stop);
    let options = RunOptions { device: Device::Gpu { gpu: device.clone(), may_fall_back: false }, threads: 2, ..RunOptions::default() };
    let mut told = 0;
    let mut sink = |event: Event| {
        if let Event::Frame(frame) = event {
            told += shortages(&frame.record);
        }
    };
    let report = run(Setup::new(scene.settings()).unwrap(), &options, &mut sink, &device.line.stop).unwrap();
    assert!(report.interrupted && device.line.broke_in.get() == Some(&"tracing a table"));
    assert_eq!((told, told_of(&report.warnings)), (0, 1), "{:?}", report.warnings);
}

/// A checkpoint takes long to come back and to be written; the table that it has is the device's for a moment alone, since the next slide wants
/// its memory.
#[test]
fn a_slide_under_a_checkpoint_finds_the_table_gone() {
    let folder = tempfile::tempdir().unwrap();
    let scene = residual(&[]);
    let frames = made(&scene, Device::CPU).films.len();
    let slow = Breaking::new(usize::MAX, How::Fault, WhenLost::Cpu);
    // It comes back when the last frame is made.
    slow.line.slowness.store(1 << 30, Ordering::Relaxed);
    let options = RunOptions {
        device: Device::Gpu { gpu: slow.clone(), may_fall_back: false },
        threads: 2,
        checkpoint: Some(folder.path().join("checkpoint")),
        checkpoint_seconds: Some(0.0),
        ..RunOptions::default()
    };
    let found = made_behind(&scene, options, &mut |frame| slow.line.frame_made(frame as usize + 1 == frames));
    assert!(found.error.is_none() && found.records.iter().any(|record| record.checkpoint.is_some()), "{:?}", found.error);
    let asked = slow.line.calls.lock().unwrap().clone();
    assert!(some(&asked, "tracing a table").len() >= 4 && asked.contains(&"reading a copy"));
    assert_eq!(slow.line.tables_before.load(Ordering::Relaxed), 0, "tables that were there when another was traced");
    assert_eq!(slow.line.waited_for.load(Ordering::Relaxed), 0, "frames waited for it");
}

/// A table of another size takes the place of one that the device holds, which goes before.
#[test]
fn another_size_finds_the_table_gone() {
    let text = "[source]\nkind = \"turbulence\"\nnodes = [16, 8, 8]\n[time]\ntau = 4\nslides = 1\nframes_per_slide = 6\n[flow]\nsteps = 8\n[surrogate]\n\
         kind = \"table\"\n[network]\nsize = \"auto\"\n[trust]\ncells = [2, 2, 2]\ntolerance = 0.001\n[render]\nwidth = 16\nheight = 8\nsamples = 2\n";
    let scene = SceneFile::parse(Path::new("scene.toml"), text, &[]).unwrap();
    let device = Breaking::new(usize::MAX, How::Fault, WhenLost::Cpu);
    let found = on(&device, &scene);
    assert!(found.error.is_none() && found.films.len() == 6, "{:?}", found.error);
    let tables = device.line.calls.lock().unwrap().iter().filter(|call| **call == "tracing a table").count();
    assert!(tables >= 2, "another size was due");
    assert_eq!(device.line.tables_before.load(Ordering::Relaxed), 0, "tables that were there when another was traced");
}

/// What a checkpoint holds behind its header.
fn tensors(checkpoint: &Path) -> Vec<u8> {
    let file = std::fs::read(checkpoint).unwrap();
    file[8 + u64::from_le_bytes(file[..8].try_into().unwrap()) as usize..].to_vec()
}

/// A network that a device trains: as long as it works all is as on the CPU; once it is lost, the CPU goes on from what came back last.
#[test]
fn training_of_a_residual_over_a_sliding_window() {
    let scene = residual(&[]);
    let expected = made(&scene, Device::CPU);
    let folder = tempfile::tempdir().unwrap();
    let run = |device: &Arc<Breaking>| {
        drop(std::fs::remove_file(folder.path().join("checkpoint")));
        let device = Device::Gpu { gpu: device.clone(), may_fall_back: false };
        let options = RunOptions { device, threads: 2, checkpoint: Some(folder.path().join("checkpoint")), ..RunOptions::default() };
        made_with(&scene, options)
    };
    let whole = Breaking::new(usize::MAX, How::Fault, WhenLost::Cpu);
    let unbroken = run(&whole);
    assert!(unbroken.error.is_none() && unbroken.films == expected.films && expected.films.len() >= 4);
    for (found, expected) in unbroken.records.iter().zip(&expected.records) {
        assert_eq!(figures(found), figures(expected));
        assert!(found.training.as_ref().is_some_and(|learned| learned.device_seconds.is_some()), "trained there");
        assert!(expected.training.as_ref().is_some_and(|learned| learned.device_seconds.is_none() && learned.steps == STEPS));
    }
    let asked = whole.line.calls.lock().unwrap().clone();
    let mut refused = 0;
    for kind in [
        "taking a network over",
        "bringing samples over",
        "taking steps",
        "keeping a network",
        "freezing a network",
        "asking a network",
        "fetching a network",
    ] {
        let places = some(&asked, kind);
        assert!(!places.is_empty(), "{kind}");
        for breaks_at in places {
            for when_lost in [WhenLost::Cpu, WhenLost::Stop] {
                let device = Breaking::at(kind, breaks_at, How::Fault, when_lost);
                let found = run(&device);
                // How often a trace is cut up depends on the machine's speed.
                let what = device.line.broke_in.get();
                let case = format!("{when_lost:?} at call {breaks_at}, {what:?}");
                let told: Vec<usize> = (0..found.records.len()).filter(|&i| has_ended(&found.records[i]) > 0).collect();
                let lost = told.first().copied().unwrap_or(found.records.len());
                assert!(expected.films[..lost] == found.films[..lost], "{case}: as on the CPU up to frame {lost}");
                if when_lost == WhenLost::Stop {
                    assert!(told.is_empty() && (found.error.is_some() || found.films.len() == expected.films.len()), "{case}");
                    continue;
                }
                assert_eq!(found.films.len(), expected.films.len(), "{case}: {:?}", found.error);
                let is_whole = |tensors: &[u8]| tensors.chunks_exact(4).all(|v| f32::from_le_bytes(v.try_into().unwrap()).is_finite());
                match &found.error {
                    None => assert!(is_whole(&tensors(&folder.path().join("checkpoint"))), "{case}"),
                    // Lost by the last checkpoint itself, when nobody is left to trace its table anew.
                    Some(error) => {
                        let error = error.to_string();
                        assert!(kind == "fetching a network" && error.contains("before the values of its table"), "{case}: {error}");
                        assert!(told.is_empty() && !folder.path().join("checkpoint").exists(), "{case}");
                        refused += 1;
                    }
                }
                assert!(told.len() <= 1, "{case}: told once");
                for (i, record) in found.records.iter().enumerate() {
                    let learned = record.training.as_ref().unwrap();
                    // The frame in which it is lost may end with fewer steps, and says how many were lost.
                    assert!(learned.steps == STEPS || i == lost || i == lost + 1, "{case}, frame {i}: {learned:?}");
                    assert!(learned.loss.is_none_or(f64::is_finite) && learned.rollbacks == 0, "{case}, frame {i}: {learned:?}");
                    assert!(i >= lost || learned.lost_steps == 0, "{case}, frame {i}: {learned:?}");
                }
                // Where no path met anything some layers hold no number.
                let values = found.films.iter().flatten().map(|bits| f32::from_bits(*bits));
                assert!(values.filter(|value| !value.is_nan()).all(|value| value.abs() < 1e6), "{case}: nothing of a broken answer");
            }
        }
    }
    assert!(refused > 0);
}

/// Checkpoints of a network that a device trains: a copy that takes long to come back does not hold the frames up, and what it comes back with is
/// what it was copied from; without room for a copy frames wait and a record says so; a copy that is lost costs one checkpoint.
#[test]
fn checkpoints_while_a_device_trains() {
    // Frames and slides that go by before a copy is back.
    const SLOW: usize = 6;
    let scene = residual(&["time.frames_per_slide=5".into()]);
    let frames = made(&scene, Device::CPU).films.len();
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("checkpoint");
    let run = |there: &Arc<Breaking>, checkpoint_seconds, slowness| {
        drop(std::fs::remove_file(&path));
        let (device, checkpoint) = (Device::Gpu { gpu: there.clone(), may_fall_back: false }, Some(path.clone()));
        let options = RunOptions { device, threads: 2, checkpoint, checkpoint_seconds, ..RunOptions::default() };
        // The first checkpoint is waited for: the disk has its time for it.
        let written = || checkpoint_seconds.is_none() || path.exists();
        let line = there.line.clone();
        let found = made_behind(&scene, options, &mut |frame| {
            line.frame_made(frame as usize + 1 == frames);
            let begin = Instant::now();
            while frame > 0 && !written() && begin.elapsed() < Duration::from_secs(60) {
                std::thread::sleep(Duration::from_millis(1));
            }
            if frame == 1 {
                line.slowness.store(slowness, Ordering::Relaxed);
            }
        });
        assert!(found.error.is_none(), "{:?}", found.error);
        (found, std::fs::read(&path).unwrap())
    };
    let whole = || Breaking::new(usize::MAX, How::Fault, WhenLost::Cpu);
    let (expected, last) = run(&whole(), None, 0);
    assert!(expected.records.iter().all(|record| record.checkpoint.is_none()));

    let slow = whole();
    let (found, with_others_before) = run(&slow, Some(0.0), SLOW);
    assert!(found.films == expected.films && with_others_before == last, "checkpoints change nothing");
    let behind = |record: &&FrameRecord| record.checkpoint.as_ref().is_some_and(|checkpoint| checkpoint.frame > Some(0));
    let under_way: Vec<&FrameRecord> = found.records.iter().filter(behind).collect();
    assert!(under_way.len() >= 3);
    assert_eq!(slow.line.waited_for.load(Ordering::Relaxed), 0, "frames waited for it");
    assert!(under_way.iter().all(|record| record.checkpoint.as_ref().unwrap().behind), "{under_way:?}");
    assert!(under_way[2].checkpoint.as_ref().unwrap().postponed >= 1, "one at a time: {:?}", under_way[2].checkpoint);

    let full = whole();
    full.line.room.store(false, Ordering::Relaxed);
    let (found, without_room) = run(&full, Some(0.0), 0);
    assert!(found.films == expected.films && without_room == last);
    let told = found.records.iter().flat_map(|record| &record.warnings).filter(|warning| warning.contains("refused by the test")).count();
    assert!(told >= 1, "a record says that frames waited");
    let not_there = found.records.iter().filter_map(|record| record.checkpoint.as_ref()).filter(|checkpoint| checkpoint.frame > Some(0));
    assert!(not_there.map(|checkpoint| checkpoint.behind).all(|behind| !behind));

    for kind in ["copying a network", "reading a copy"] {
        // The second: the first checkpoint is on the disk.
        let device = Breaking::at(kind, 1, How::Fault, WhenLost::Cpu);
        let (found, _) = run(&device, Some(0.0), 0);
        assert!(device.line.broke_in.get().is_some() && found.films.len() == expected.films.len(), "{kind}");
        assert_eq!(found.records.iter().map(has_ended).sum::<usize>(), 1, "{kind}");
        let goes_on = made(&residual(&[format!("training.resume={:?}", path.display().to_string())]), Device::CPU);
        assert!(goes_on.error.is_none(), "{kind}: the last one is whole: {:?}", goes_on.error);
    }
}
