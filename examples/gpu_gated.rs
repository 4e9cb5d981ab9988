//! Measures gated frames of the standard easy turbulence on a GPU, in the loop of `ridgewatch replay`. A traced table, or a network trained between
//! the frames, answers in trusted cells, and RK4 elsewhere. Prints tables; needs a GPU.
//!
//! - Frame rate, time by stage, traced share and stated error.
//! - PSNR of 64 accumulated frames against many samples of another seed, compared with 64 reference frames.
//! - Effect of a sliding window on the traced share, device memory over a thousand frames, and cost of checkpoints.
//!
//! `-- WIDTH HEIGHT NX NY NZ SAMPLES [tables] [networks] [slides] [published] [table.key=value]`, with the keys of a scene. `published` measures
//! frames with the smallest of the published networks.

#![allow(clippy::unwrap_used, clippy::print_stdout)] // a measurement, which may stop and prints

use ridgewatch::backend::cuda::{Gpu, GpuSettings};
use ridgewatch::backend::{CudaDevice, Device, Storage, TracedOnce, WhenLost, stratified_points};
use ridgewatch::config::SceneFile;
use ridgewatch::field::DomainPoint;
use ridgewatch::publish::compare_films;
use ridgewatch::render::{Film, Method, TransferSettings};
use ridgewatch::run::{CheckpointRecord, Event, FrameRecord, RunOptions, RunReport, Settings, Setup, run};
use ridgewatch::surrogate::Kind;
use ridgewatch::surrogate::network::Encoding;
use ridgewatch::trust::Strata;
use std::path::Path;
use std::sync::atomic::AtomicBool;

static NEVER: AtomicBool = AtomicBool::new(false);
const FRAMES: usize = 64;
const WARM_UP: usize = 8;
/// Rows before those of networks.
const NETWORKS: usize = 3;
/// Frames in which a network is trained before the measurement.
const LEARNING: usize = 240;
/// The same until its loss has stalled, so that training takes less.
const LEARNED: usize = 1000;
/// Number of slides. All memory is allocated by the end of the first one; the others have a thousand frames.
const SLIDES: usize = 6;
const FRAMES_A_SLIDE: usize = 200;
/// Maximum change of free memory over these frames, as the driver reports it: two growth steps of its pool.
const FLAT: usize = 64 << 20;
/// Seconds between two checkpoints; a run beside a simulation has 30.
const CHECKPOINT_SECONDS: f64 = 5.0;
/// Frames of a slide whose traced share is shown, from 0.
const SHOWN: [usize; 8] = [0, 1, 2, 4, 9, 24, 99, 199];
/// A network of 71 MB with few levels, the finest as dense as its table allows, and batches that keep the device busy.
const NETWORK: [&str; 6] = [
    "network.levels=3",
    "network.features=4",
    "network.growth=1.8",
    "network.base_resolution=128",
    "network.log2_table=24",
    "network.batch=262144",
];

/// Sum of `frames` pictures of a scene after its warm-up, and their records.
fn pictures(settings: &Settings, device: &Device) -> (Film, Vec<FrameRecord>) {
    let mut sum = Film::new(settings.render.width, settings.render.height);
    let mut records = Vec::new();
    let mut seen = 0;
    let mut sink = |event: Event| {
        if let Event::Frame(frame) = event {
            seen += 1;
            if seen > settings.time.warmup_frames {
                sum.accumulate(&frame.film).unwrap();
                records.push((*frame.record).clone());
            }
        }
    };
    let options = RunOptions { device: device.clone(), ..RunOptions::default() };
    run(Setup::new(settings.clone()).unwrap(), &options, &mut sink, &NEVER).unwrap();
    (sum, records)
}

/// Transfer function for all pictures, scaled to this field as by default.
fn colours(settings: &Settings, device: &Device) -> TransferSettings {
    let mut setup = Setup::new(settings.clone()).unwrap();
    let slide = setup.slides.next_slide(&NEVER).unwrap().unwrap();
    let points = stratified_points(&Strata::even([64, 64, 16], 1), settings.seed, 0);
    let seeds: Vec<DomainPoint> = points.into_iter().map(|point| setup.plan.domain.from_unit(point)).collect();
    let TracedOnce { flow, traced, .. } =
        device.trace(&slide.velocity, &setup.plan.map, slide.time, &seeds, &AtomicBool::new(false)).unwrap();
    let ftle: Vec<f32> = traced.log_stretch.iter().map(|s| s / flow.tau() as f32).collect();
    TransferSettings::default().scaled_to(&ftle)
}

fn median(records: &[FrameRecord], value: impl Fn(&FrameRecord) -> f64) -> f64 {
    let mut values: Vec<f64> = records.iter().map(value).collect();
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}

/// Median and, in brackets, the largest.
fn median_and_most(records: &[FrameRecord], value: impl Fn(&FrameRecord) -> f64 + Copy) -> String {
    format!("{:.1} ({:.1})", median(records, value), records.iter().map(value).fold(f64::NEG_INFINITY, f64::max))
}

/// Milliseconds of each frame except the first, from record to record: includes the work between frames, but no slides and no waiting for them.
fn lengths(records: &[&FrameRecord]) -> Vec<f64> {
    let between =
        |pair: &[&FrameRecord]| pair[1].seconds.elapsed - pair[0].seconds.elapsed - pair[1].seconds.slide - pair[1].seconds.waiting;
    records.windows(2).map(|pair| 1e3 * between(pair)).collect()
}

/// Cost of checkpoints: frames during a checkpoint compared with other frames.
fn checkpoints(records: &[&FrameRecord], report: &RunReport) -> String {
    let lengths = lengths(records);
    let frames = || lengths.iter().zip(&records[1..]);
    let of = |under_way: bool| {
        let mut some: Vec<f64> = frames().filter(|(_, r)| r.checkpoint.is_some() == under_way).map(|(length, _)| *length).collect();
        some.sort_by(f64::total_cmp);
        assert!(!some.is_empty(), "frames with and without a checkpoint under way");
        format!("{} frames, median {:.1} ms, longest {:.1} ms", some.len(), some[some.len() / 2], some[some.len() - 1])
    };
    let ended: Vec<&CheckpointRecord> = records.iter().filter_map(|r| r.checkpoint.as_ref()).filter(|c| c.bytes.is_some()).collect();
    let waited_for = ended.iter().filter(|c| !c.asynchronous).count();
    let most = |value: fn(&CheckpointRecord) -> f64| ended.iter().map(|c| value(c)).fold(0.0, f64::max);
    format!(
        "{} checkpoints of {:.0} MB, {waited_for} of them waited for, {} postponed: the loop stood still for {:.1} ms at most, written after {:.2} s at most; with one under way: {}; others: {}",
        ended.len(),
        most(|c| c.bytes.unwrap_or(0) as f64 * 1e-6),
        report.checkpoints.as_ref().map_or(0, |c| c.postponed),
        1e3 * most(|c| c.copy_seconds),
        most(|c| c.seconds),
        of(true),
        of(false)
    )
}

/// Measures traced frames, and frames answered by a network of 8 layers of 256 on a frequency encoding that is trained between them.
fn published(mut scene: Settings, device: &Device, size: &str) {
    (scene.network.encoding, scene.network.hidden_layers, scene.network.width, scene.network.batch) =
        (Encoding::Frequency, 8, 256, Some(1 << 16));
    scene.surrogate.kind = Kind::Network;
    scene.time.warmup_frames = LEARNING;
    println!("<!-- block gated-published -->");
    println!(
        "{size}, 22 steps; medians of {FRAMES} frames of one sample after {LEARNING}, in which the network of 8x256 is trained too.\n"
    );
    println!(
        "| answers | frame, ms (and longest) | on the device: picture | training | trace | predict | queries | traced | network alone, dB |"
    );
    println!("|{}", "---|".repeat(9));
    for (name, method) in
        [("RK4", Method::Reference), ("network, RK4 where it is not trusted", Method::Gated), ("network alone", Method::Surrogate)]
    {
        scene.render.method = method;
        let (_, records) = pictures(&scene, device);
        let ms = |of: fn(&FrameRecord) -> f64| 1e3 * median(&records, of);
        println!(
            "| {name} | {} | {:.1} | {:.1} | {:.1} | {:.1} | {:.0} | {:.1} % | {} |",
            median_and_most(&records, |r| 1e3 * r.seconds.total),
            ms(|r| r.seconds.device),
            ms(|r| r.training.as_ref().and_then(|learned| learned.device_seconds).unwrap_or(0.0)),
            ms(|r| r.seconds.trace),
            ms(|r| r.seconds.predict),
            median(&records, |r| r.queries as f64),
            100.0 * median(&records, |r| r.traced_share),
            records[0]
                .surrogate_psnr
                .map_or("-".to_owned(), |_| format!("{:.1}", median(&records, |r| r.surrogate_psnr.unwrap_or(f64::NAN))))
        );
    }
    println!();
}

fn main() {
    let (told, words): (Vec<String>, Vec<String>) = std::env::args().skip(1).partition(|a| a.contains('='));
    let asked = |what: &str| words.iter().all(|w| w.parse::<usize>().is_ok()) || words.iter().any(|w| w == what);
    let given: Vec<usize> = std::env::args().skip(1).filter_map(|a| a.parse().ok()).collect();
    let value = |i: usize, default: usize| given.get(i).copied().unwrap_or(default);
    let nodes = [value(2, 600), value(3, 192), value(4, 192)];
    let gpu = Gpu::open(0, &GpuSettings::default()).unwrap_or_else(|why| panic!("nothing is measured: {why}"));
    let device = CudaDevice { gpu: gpu.clone(), storage: Some(Storage::F32), when_lost: WhenLost::Stop, may_fall_back: false };
    let device = Device::Cuda(device);
    let text = include_str!("../configs/turbulence_easy.toml");
    let mut keys = ["flow.steps=22", "surrogate.kind=residual"].map(str::to_owned).to_vec();
    keys.extend(NETWORK.map(str::to_owned));
    keys.extend(told);
    let mut scene = SceneFile::parse(Path::new("turbulence_easy.toml"), text, &keys).unwrap().settings();
    scene.source.nodes = Some(nodes);
    (scene.render.width, scene.render.height, scene.render.samples) = (value(0, 1920), value(1, 1080), 1.0);
    scene.transfer = Some(colours(&scene, &device));
    (scene.time.warmup_frames, scene.time.frames_per_slide) = (WARM_UP, FRAMES);
    let size = format!("{}x{}", scene.render.width, scene.render.height);
    if asked("published") {
        published(scene.clone(), &device, &format!("{size} pixels of {nodes:?} nodes"));
    }
    if !["tables", "networks", "slides"].into_iter().any(asked) {
        return;
    }

    let mut truth = scene.clone();
    truth.seed = 77;
    truth.render.method = Method::Reference;
    truth.render.samples = value(5, 4096) as f64;
    (truth.time.warmup_frames, truth.time.frames_per_slide) = (1, 1);
    let (reference, records) = pictures(&truth, &device);
    let frame = &records[0];
    let reference_is = format!(
        "The reference of {} samples, seed {}: {:.1} s, {} queries, {:.0} M traced a second of tracing.\n",
        frame.samples_per_pixel,
        truth.seed,
        frame.seconds.total,
        frame.queries,
        1e-6 * (frame.traced + frame.speculative_traces) as f64 / frame.seconds.trace
    );

    let begin = |block: &str, after: &str| {
        println!("<!-- block {block} -->");
        println!("{size} pixels of {nodes:?} nodes, 22 steps; medians of {FRAMES} frames of one sample after {after}.");
        println!("{reference_is}");
        println!(
            "| answers | frames/s | frame, ms (and longest) | walk | trace | predict | audit | train | on the device: picture | training | \
             steps | queries | traced | trusted volume | stated error | over tolerance | surrogate alone, dB | PSNR of {FRAMES} frames, dB |"
        );
        println!("|{}", "---|".repeat(18));
    };
    let double = nodes.map(|n| 2 * n - 1);
    let rows = [
        ("RK4", None, WARM_UP),
        ("table of the data's nodes", Some((Kind::Table, nodes)), WARM_UP),
        ("table of twice as many an edge", Some((Kind::Table, double)), WARM_UP),
        ("network", Some((Kind::Network, nodes)), LEARNING),
        ("network above the table of the data's nodes", Some((Kind::Residual, nodes)), LEARNING),
        ("network after 1000 frames", Some((Kind::Network, nodes)), LEARNED),
    ];
    for (number, (name, surrogate, warm_up)) in rows.into_iter().enumerate() {
        let is_network = surrogate.is_some_and(|(kind, _)| kind != Kind::Table);
        match number {
            0 if asked("tables") => begin("gated", &format!("{WARM_UP}")),
            NETWORKS if asked("networks") => begin("gated-networks", &format!("{LEARNING}, in which the network is trained too")),
            _ => {}
        }
        if !asked(if is_network { "networks" } else { "tables" }) {
            continue;
        }
        scene.render.method = if surrogate.is_some() { Method::Gated } else { Method::Reference };
        if let Some((kind, nodes)) = surrogate {
            (scene.surrogate.kind, scene.surrogate.table_nodes) = (kind, Some(nodes));
        }
        scene.time.warmup_frames = warm_up;
        let (sum, records) = pictures(&scene, &device);
        let psnr = compare_films(&sum, &reference, scene.render.tone_map).unwrap().psnr.unwrap_or(f64::INFINITY);
        let ms = |of: fn(&FrameRecord) -> f64| 1e3 * median(&records, of);
        let over = records.iter().filter(|r| r.tolerance_excess.is_some()).count();
        // Adding the pictures is not part of the loop's time.
        let seconds: f64 = records.iter().map(|r| r.seconds.total).sum();
        println!(
            "| {name} | {:.1} | {} | {:.1} | {:.1} | {:.1} | {:.1} | {:.1} | {:.1} | {:.1} | {} | {:.0} | {:.1} % | {:.1} % | {:.4} | {over} frames | {:.1} | {psnr:.1} |",
            FRAMES as f64 / seconds,
            median_and_most(&records, |r| 1e3 * r.seconds.total),
            ms(|r| r.seconds.render),
            ms(|r| r.seconds.trace),
            ms(|r| r.seconds.predict),
            ms(|r| r.seconds.audit),
            ms(|r| r.seconds.train),
            ms(|r| r.seconds.device),
            ms(|r| r.training.as_ref().and_then(|learned| learned.device_seconds).unwrap_or(0.0)),
            median(&records, |r| r.training.as_ref().map_or(0.0, |learned| learned.steps as f64)),
            median(&records, |r| r.queries as f64),
            100.0 * median(&records, |r| r.traced_share),
            100.0 * median(&records, |r| r.trusted_volume),
            median(&records, |r| r.trusted_error.map_or(0.0, |e| e.optical_rms)),
            median(&records, |r| r.surrogate_psnr.unwrap_or(f64::INFINITY))
        );
        for record in &records {
            assert!(record.device.starts_with("cuda") && record.speculative_traces > 0, "{:?}", record.warnings);
        }
        // Once the loss has stalled, turns are left out.
        let is_trained = |record: &FrameRecord| record.training.as_ref().is_some_and(|l| l.device_seconds.is_some() && l.steps > 0);
        assert!(!is_network || records.iter().any(is_trained), "{name}: trained there");
    }
    println!();

    if !asked("slides") {
        return;
    }
    println!("<!-- block gated-slides -->");
    println!(
        "{SLIDES} slides of {FRAMES_A_SLIDE} frames after {LEARNING} at the first; the share that is traced by the frame of a slide, its length in ms beside it.\n"
    );
    println!("| answers | slide | {} | slide itself, ms |", SHOWN.map(|n| (n + 1).to_string()).join(" | "));
    println!("|---|---|{}---|", "---|".repeat(SHOWN.len()));
    scene.render.method = Method::Gated;
    (scene.time.warmup_frames, scene.time.frames_per_slide) = (LEARNING, FRAMES_A_SLIDE);
    scene.time.slides = Some(SLIDES);
    scene.source.snapshots = Some(12 + SLIDES - 1);
    let mut lines = Vec::new();
    let mut runs = Vec::new();
    let folder = tempfile::tempdir().unwrap();
    for (name, surrogate, _) in rows[NETWORKS..].iter().filter(|row| row.2 == LEARNING) {
        let Some((kind, nodes)) = *surrogate else { continue };
        (scene.surrogate.kind, scene.surrogate.table_nodes) = (kind, Some(nodes));
        let mut seen: Vec<(FrameRecord, u64, usize)> = Vec::new();
        let mut sink = |event: Event| {
            if let Event::Frame(frame) = event {
                seen.push(((*frame.record).clone(), gpu.memory().0, gpu.context().mem_get_info().unwrap().0));
            }
        };
        let options = RunOptions {
            device: device.clone(),
            checkpoint: Some(folder.path().join("weights")),
            checkpoint_seconds: Some(CHECKPOINT_SECONDS),
            ..RunOptions::default()
        };
        let report = run(Setup::new(scene.clone()).unwrap(), &options, &mut sink, &NEVER).unwrap();
        assert_eq!(seen.len(), LEARNING + SLIDES * FRAMES_A_SLIDE);
        let settling: Vec<(FrameRecord, u64, usize)> = seen.drain(..LEARNING).collect();
        let settling: Vec<&FrameRecord> = settling.iter().map(|s| &s.0).collect();
        lines.push(format!(
            "{name}, warm-up: its first frame took {:.1} ms, the longest of the {} behind it {:.1} ms.",
            1e3 * settling[0].seconds.total,
            settling.len() - 1,
            lengths(&settling).into_iter().fold(0.0, f64::max)
        ));
        for (slide, frames) in seen.chunks(FRAMES_A_SLIDE).enumerate() {
            let shown = SHOWN.map(|n| format!("{:.1} %, {:.0}", 100.0 * frames[n].0.traced_share, 1e3 * frames[n].0.seconds.total));
            println!("| {name} | {} | {} | {:.0} |", slide + 1, shown.join(" | "), 1e3 * frames[0].0.seconds.slide);
        }
        // All memory is allocated before the second slide.
        let settled = &seen[FRAMES_A_SLIDE..];
        let taken = || settled.iter().map(|s| s.1 >> 20);
        let free = || settled.iter().map(|s| s.2);
        let (least, most) = (free().min().unwrap(), free().max().unwrap());
        lines.push(format!(
            "{name}, memory over the {} frames from the second slide on: {} to {} MiB taken; of the device {} to {} MiB free.",
            settled.len(),
            taken().min().unwrap(),
            taken().max().unwrap(),
            least >> 20,
            most >> 20
        ));
        runs.push((settled.len(), most - least, report.checkpoints.clone().unwrap()));
        let records: Vec<&FrameRecord> = seen.iter().map(|s| &s.0).collect();
        lines.push(format!("{name}: {}.", checkpoints(&records, &report)));
        let (length, record) = lengths(&records).into_iter().zip(&records[1..]).max_by(|a, b| a.0.total_cmp(&b.0)).unwrap();
        lines.push(format!(
            "{name}, longest of all {} frames after the warm-up, from record to record, slides apart, while the CPU makes the next snapshot: {length:.1} ms (frame {} of slide {}).",
            records.len(),
            record.frame,
            record.slide + 1
        ));
    }
    println!("\n{}", lines.join("\n\n"));
    for (frames, change, checkpoints) in runs {
        assert!(frames >= 1000 && change <= FLAT, "free memory changed by {change} bytes over {frames} frames");
        assert!(checkpoints.written >= 3 && checkpoints.failed == 0, "{checkpoints:?}");
    }
}
