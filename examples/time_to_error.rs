//! Measures the time to error after a slide: the seconds from a new window until the picture has 30, 35, 40 and 45 dB over lit pixels and keeps them, for
//! five slides seen by three cameras. Runs on a GPU if there is one. Prints a table, and what each slide took to standard error.
//!
//! `-- CONFIG TRUTH_SAMPLES FRAMES METHOD[:SURROGATE][*SAMPLES] ... [cameras=1..3] [table.key=value]`: frames a slide; a method of smooth frames,
//! `auto`, `gated` or `reference`, with samples per pixel and frame of its own if given. The seconds of `auto` have its races in them. The truth is the
//! mean of two halves of `reference`; the product of the differences to the halves is the squared error without their noise, up to a bound that their
//! samples set. The first slide, which compiles kernels, is not counted. The source needs six slides.

#![allow(clippy::unwrap_used, clippy::print_stdout)] // a measurement, which may stop and prints

use ridgewatch::backend::{Device, DeviceChoice, DeviceSettings};
use ridgewatch::chart::{Truth, fixed_colours, picture_errors};
use ridgewatch::config::SceneFile;
use ridgewatch::render::{CameraSettings, Film, Method};
use ridgewatch::run::{Event, Frame, RunOptions, Settings, Setup, run};
use ridgewatch::surrogate::Kind;
use std::path::Path;
use std::sync::atomic::AtomicBool;

static NEVER: AtomicBool = AtomicBool::new(false);
const SLIDES: usize = 6;
const CAMERAS: usize = 3;
const TARGETS: [f64; 4] = [30.0, 35.0, 40.0, 45.0];

fn frames(settings: &Settings, device: &Device, mut seen: impl FnMut(Frame) + Send) {
    let options = RunOptions { device: device.clone(), ..RunOptions::default() };
    let mut sink = |event: Event| {
        if let Event::Frame(frame) = event {
            seen(frame);
        }
    };
    run(Setup::new(settings.clone()).unwrap(), &options, &mut sink, &NEVER).unwrap();
}

/// The overview, turned around the vertical through the centre.
fn camera(scene: &Settings, number: usize) -> CameraSettings {
    let domain = Setup::new(scene.clone()).unwrap().plan.domain;
    let overview = CameraSettings::overview(&domain, [1.0; 3], scene.render.width as f64 / scene.render.height as f64);
    let (sin, cos) = (std::f64::consts::TAU * number as f64 / CAMERAS as f64).sin_cos();
    let (centre, [x, y, z]) = (overview.look_at, overview.eye);
    let [x, y] = [x - centre[0], y - centre[1]];
    CameraSettings { eye: [centre[0] + cos * x - sin * y, centre[1] + sin * x + cos * y, z], ..overview }
}

/// The true picture of each slide but the first.
fn truths(scene: &Settings, samples: f64, device: &Device) -> Vec<Truth> {
    let [a, b] = [77, 78].map(|seed| {
        let mut scene = Settings { seed, ..scene.clone() };
        (scene.render.method, scene.render.samples, scene.time.frames_per_slide) = (Method::Reference, samples, 1);
        let mut films: Vec<Film> = Vec::new();
        frames(&scene, device, |frame| films.push((*frame.film).clone()));
        films
    });
    a.into_iter().zip(b).skip(1).map(|(a, b)| Truth::new([a, b]).unwrap()).collect()
}

/// A method with its surrogate.
struct Candidate {
    name: String,
    method: Method,
    kind: Kind,
    samples: Option<f64>,
}

impl Candidate {
    fn parse(word: &str) -> Self {
        let (name, samples) = word.split_once('*').map_or((word, None), |(name, samples)| (name, Some(samples.parse().unwrap())));
        let (method, kind) = name.split_once(':').unwrap_or((name, "table"));
        let known = [Method::Auto, Method::Reference, Method::Gated, Method::Marched, Method::TwoLevel];
        let found = known.into_iter().find(|known| known.name() == method);
        let method = found.unwrap_or_else(|| panic!("a method `{method}`; accepted: {}", known.map(Method::name).join(", ")));
        let kind = match kind {
            "table" => Kind::Table,
            "residual" => Kind::Residual,
            "network" => Kind::Network,
            other => panic!("a surrogate `{other}`; accepted: table, residual, network"),
        };
        Self { name: word.to_owned(), method, kind, samples }
    }
}

/// Seconds to each target in a slide, and the decibels of its last frame, over lit pixels and over all.
#[derive(Default, Clone)]
struct Found {
    reached: [Option<f64>; TARGETS.len()],
    last: [f64; 2],
    seconds: f64,
    frames: usize,
}

fn measure(scene: &Settings, truths: &[Truth], device: &Device) -> Vec<Found> {
    let mut found = vec![Found::default(); truths.len()];
    let mut sum = Film::new(scene.render.width, scene.render.height);
    let mut shown = u64::MAX;
    frames(scene, device, |frame| {
        let seconds = &frame.record.seconds;
        if frame.record.slide != shown {
            shown = frame.record.slide;
            eprint!("\n{} ms: race {:.1}, slide {:.1}, frames", frame.record.method, 1e3 * seconds.race, 1e3 * seconds.slide);
        }
        eprint!(" {:.1}", 1e3 * seconds.total);
        let Some(number) = (frame.record.slide as usize).checked_sub(1) else { return };
        let slide = &mut found[number];
        if slide.frames == 0 {
            sum = Film::new(scene.render.width, scene.render.height);
        }
        slide.seconds += seconds.race + seconds.slide + seconds.total;
        slide.frames += 1;
        let own = matches!(frame.record.method.as_str(), "reference" | "gated") && sum.accumulate(&frame.film).is_ok();
        let errors = picture_errors(if own { &sum } else { &frame.film }, &truths[number], frame.tone_map);
        slide.last = [errors.psnr, errors.psnr_all];
        for (target, reached) in TARGETS.iter().zip(&mut slide.reached) {
            *reached = if slide.last[0] < *target { None } else { reached.or(Some(slide.seconds)) };
        }
    });
    found
}

/// Median and worst of sorted values.
fn summary(mut values: Vec<f64>) -> String {
    values.sort_by(f64::total_cmp);
    format!("{:.3} ({:.3})", values[values.len() / 2], values[values.len() - 1])
}

fn main() {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let (keys, words): (Vec<String>, Vec<String>) = arguments.into_iter().partition(|a| a.contains('='));
    let (cameras, keys): (Vec<String>, Vec<String>) = keys.into_iter().partition(|key| key.starts_with("cameras="));
    let cameras = cameras.first().map_or(CAMERAS, |key| key.trim_start_matches("cameras=").parse().unwrap());
    let file = Path::new(&words[0]);
    let (truth_samples, count): (f64, usize) = (words[1].parse().unwrap(), words[2].parse().unwrap());
    let candidates: Vec<Candidate> = words[3..].iter().map(|word| Candidate::parse(word)).collect();
    let mut scene = SceneFile::parse(file, &std::fs::read_to_string(file).unwrap(), &keys).unwrap().settings();
    let device = Device::open(DeviceChoice::Auto, &DeviceSettings::default()).unwrap();
    scene.render.method = Method::Reference;
    (scene.time.warmup_frames, scene.time.slides, scene.time.frames_per_slide) = (0, Some(SLIDES), 1);
    scene.transfer = Some(fixed_colours(&scene, &device).unwrap());
    let mut all: Vec<Vec<Found>> = vec![Vec::new(); candidates.len()];
    for number in 0..cameras {
        scene.camera = Some(camera(&scene, number));
        let truths = truths(&scene, truth_samples, &device);
        assert_eq!(truths.len(), SLIDES - 1, "the source has too few slides");
        for (candidate, all) in candidates.iter().zip(&mut all) {
            let mut scene = scene.clone();
            (scene.render.method, scene.surrogate.kind, scene.time.frames_per_slide) = (candidate.method, candidate.kind, count);
            scene.render.samples = candidate.samples.unwrap_or(scene.render.samples);
            eprint!("\n{}, camera {number}", candidate.name);
            all.extend(measure(&scene, &truths, &device));
            eprintln!();
        }
    }
    let pictures = cameras * (SLIDES - 1);
    println!(
        "{}: {} x {} pixels, {pictures} pictures ({} slides, {cameras} cameras), truth of 2 x {truth_samples} samples; seconds to error, median (worst)",
        file.file_stem().unwrap_or_default().display(),
        scene.render.width,
        scene.render.height,
        SLIDES - 1,
    );
    println!(
        "\n| method | samples a frame | {} | last frame: seconds | dB over lit pixels, median (lowest) | over all |",
        TARGETS.map(|t| format!("{t:.0} dB")).join(" | ")
    );
    println!("|{}", "---|".repeat(TARGETS.len() + 5));
    for (candidate, found) in candidates.iter().zip(&all) {
        let reached = (0..TARGETS.len()).map(|target| {
            let seconds: Vec<f64> = found.iter().filter_map(|slide| slide.reached[target]).collect();
            match seconds.len() {
                0 => "-".to_owned(),
                n if n < found.len() => format!("{} in {n} of {}", summary(seconds), found.len()),
                _ => summary(seconds),
            }
        });
        let reached: Vec<String> = reached.collect();
        let [lit, all] = [0, 1].map(|which| {
            let mut last: Vec<f64> = found.iter().map(|slide| slide.last[which]).collect();
            last.sort_by(f64::total_cmp);
            format!("{:.2} ({:.2})", last[last.len() / 2], last[0])
        });
        println!(
            "| {} | {} | {} | {} | {lit} | {all} |",
            candidate.name.split('*').next().unwrap_or_default(),
            candidate.samples.unwrap_or(scene.render.samples),
            reached.join(" | "),
            summary(found.iter().map(|slide| slide.seconds).collect()),
        );
    }
}
