//! Gated frames of the standard easy turbulence on a GPU, in the loop that `ridgewatch replay` runs: a traced table answers where it is
//! trusted, RK4 elsewhere. Frames a second, where the time goes, what is traced, what error is stated; and what 64 accumulated frames are
//! worth against 4,096 samples of another seed, beside 64 reference frames. Prints; needs a GPU. `-- WIDTH HEIGHT NX NY NZ SAMPLES`.

#![allow(clippy::unwrap_used, clippy::print_stdout)] // a measurement, which may stop and prints

use ridgewatch::config::SceneFile;
use ridgewatch::engine::{
    Device, DeviceChoice, DeviceSettings, Event, FrameRecord, RunOptions, Settings, Setup, run, stratified_points, trace,
};
use ridgewatch::publish::compare_films;
use ridgewatch::render::{Film, Method, TransferSettings};
use ridgewatch::surrogate::Kind;
use ridgewatch::trust::Strata;
use std::path::Path;
use std::sync::atomic::AtomicBool;

static NEVER: AtomicBool = AtomicBool::new(false);
const FRAMES: usize = 64;
const WARM_UP: usize = 8;

/// `frames` pictures of a scene after its warm-up, added up, and their records.
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

/// One transfer function for all pictures, scaled to this field as a bare file's would be.
fn colours(settings: &Settings, device: &Device) -> TransferSettings {
    let mut setup = Setup::new(settings.clone()).unwrap();
    let slide = setup.feed.next_slide().unwrap().unwrap();
    let (tracer, _) = device.tracer(slide.velocity, &setup.plan.map, slide.time).unwrap();
    let points = stratified_points(&Strata::even([64, 64, 16], 1), settings.seed, 0);
    let labels = trace(&*tracer, &points, false).samples.log_stretch;
    let ftle: Vec<f32> = labels.iter().map(|s| s / tracer.tau() as f32).collect();
    TransferSettings::default().scaled_to(&ftle)
}

fn median(records: &[FrameRecord], value: impl Fn(&FrameRecord) -> f64) -> f64 {
    let mut values: Vec<f64> = records.iter().map(value).collect();
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}

fn main() {
    let given: Vec<usize> = std::env::args().skip(1).filter_map(|a| a.parse().ok()).collect();
    let value = |i: usize, default: usize| given.get(i).copied().unwrap_or(default);
    let nodes = [value(2, 600), value(3, 192), value(4, 192)];
    let device = Device::open(DeviceChoice::Auto, &DeviceSettings::default()).unwrap();
    if let Device::Cpu { why } = &device {
        return println!("no GPU: nothing is measured ({why:?})");
    }
    let text = include_str!("../configs/turbulence_easy.toml");
    let mut scene = SceneFile::parse(Path::new("turbulence_easy.toml"), text, &["flow.steps=22".into()]).unwrap().settings();
    scene.source.nodes = Some(nodes);
    (scene.render.width, scene.render.height, scene.render.samples) = (value(0, 1920), value(1, 1080), 1);
    scene.transfer = Some(colours(&scene, &device));
    (scene.time.warmup_frames, scene.time.frames_per_slide) = (WARM_UP, FRAMES);
    let size = format!("{}x{}", scene.render.width, scene.render.height);

    let mut truth = scene.clone();
    truth.seed = 77;
    truth.render.method = Method::Reference;
    truth.render.samples = value(5, 4096);
    (truth.time.warmup_frames, truth.time.frames_per_slide) = (1, 1);
    let (reference, records) = pictures(&truth, &device);
    let frame = &records[0];
    println!("<!-- block gated -->");
    println!("{size} pixels of {nodes:?} nodes, 22 steps; medians of {FRAMES} frames of one sample after {WARM_UP}.");
    println!(
        "The reference of {} samples, seed {}: {:.1} s, {} queries, {:.0} M traced a second of tracing.\n",
        frame.samples_per_pixel,
        truth.seed,
        frame.seconds.total,
        frame.queries,
        1e-6 * (frame.traced + frame.traced_ahead) as f64 / frame.seconds.trace
    );

    println!(
        "| answers | frames/s | frame, ms | walk | trace | predict | audit | queries | traced | trusted volume | stated error | \
         over tolerance | PSNR of {FRAMES} frames, dB |"
    );
    println!("|---|---|---|---|---|---|---|---|---|---|---|---|---|");
    let double = nodes.map(|n| 2 * n - 1);
    for (name, table) in [("RK4", None), ("table of the data's nodes", Some(nodes)), ("table of twice as many an edge", Some(double))] {
        scene.render.method = if table.is_some() { Method::Gated } else { Method::Reference };
        scene.surrogate.kind = Kind::Table;
        scene.surrogate.table_nodes = table;
        let (sum, records) = pictures(&scene, &device);
        let psnr = compare_films(&sum, &reference, scene.render.tone_map).unwrap().psnr.unwrap_or(f64::INFINITY);
        let ms = |of: fn(&FrameRecord) -> f64| 1e3 * median(&records, of);
        let total = ms(|r| r.seconds.total);
        let over = records.iter().filter(|r| r.over_tolerance.is_some()).count();
        println!(
            "| {name} | {:.1} | {total:.1} | {:.1} | {:.1} | {:.1} | {:.1} | {:.0} | {:.1} % | {:.1} % | {:.4} | {over} frames | {psnr:.1} |",
            1e3 / total,
            ms(|r| r.seconds.render),
            ms(|r| r.seconds.trace),
            ms(|r| r.seconds.predict),
            ms(|r| r.seconds.audit),
            median(&records, |r| r.queries as f64),
            100.0 * median(&records, |r| r.traced_share),
            100.0 * median(&records, |r| r.trusted_share),
            median(&records, |r| r.trusted.map_or(0.0, |e| e.optical_rms))
        );
        for record in &records {
            assert!(record.device.starts_with("cuda") && record.traced_ahead > 0, "{:?}", record.warnings);
        }
    }
}
