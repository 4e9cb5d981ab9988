//! Measures the time to error of smooth frames: the true and the stated error of each frame against the seconds since the window was new, for a scene
//! file. Runs on a GPU if there is one. Prints tables.
//!
//! `-- CONFIG TRUTH_SAMPLES FRAMES [reference] [marched] [two_level] [table.key=value]`. The truth is the mean of two halves of `reference`; the product
//! of the differences to the halves is the squared error without their noise. Lit pixels have an opacity above 0.01 in the truth.

#![allow(clippy::unwrap_used, clippy::print_stdout)] // a measurement, which may stop and prints

use ridgewatch::backend::{Device, DeviceChoice, DeviceSettings};
use ridgewatch::chart::{PictureErrors, Truth, fixed_colours, picture_errors};
use ridgewatch::config::SceneFile;
use ridgewatch::render::smooth::PictureError;
use ridgewatch::render::{Film, Method};
use ridgewatch::run::{Event, Frame, RunOptions, Settings, Setup, run};
use std::path::Path;
use std::sync::atomic::AtomicBool;

static NEVER: AtomicBool = AtomicBool::new(false);

/// Intervals that hold the true value, lie above it and below it; stated over true root mean squares and stated less true PSNR.
#[derive(Clone, Default)]
struct Held {
    rms: [u32; 3],
    psnr: [u32; 3],
    ratios: Vec<[f64; 2]>,
}

impl Held {
    fn count(&mut self, stated: &PictureError, found: &PictureErrors) {
        for (counts, interval, found) in [(&mut self.rms, stated.rms, found.rms), (&mut self.psnr, stated.psnr, found.psnr)] {
            counts[if interval.low > found { 1 } else { 2 * usize::from(interval.high < found) }] += 1;
        }
        self.ratios.push([stated.rms.value / found.rms, stated.psnr.value - found.psnr]);
    }
}

fn frames(settings: &Settings, device: &Device, mut seen: impl FnMut(Frame) + Send) {
    let options = RunOptions { device: device.clone(), ..RunOptions::default() };
    let mut sink = |event: Event| {
        if let Event::Frame(frame) = event {
            seen(frame);
        }
    };
    run(Setup::new(settings.clone()).unwrap(), &options, &mut sink, &NEVER).unwrap();
}

fn main() {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let (mut keys, words): (Vec<String>, Vec<String>) = arguments.into_iter().partition(|a| a.contains('='));
    let seeds: u64 = keys.iter().find_map(|key| key.strip_prefix("seeds=")).map_or(1, |n| n.parse().unwrap());
    keys.retain(|key| !key.starts_with("seeds="));
    let file = Path::new(words.first().map_or("configs/turbulence_easy.toml", String::as_str));
    let number = |i: usize, default: usize| words.get(i).and_then(|w| w.parse().ok()).unwrap_or(default);
    let (truth_samples, count) = (number(1, 1024), number(2, 12));
    let text = std::fs::read_to_string(file).unwrap();
    let mut scene = SceneFile::parse(file, &text, &keys).unwrap().settings();
    let device = Device::open(DeviceChoice::Auto, &DeviceSettings::default()).unwrap();
    scene.transfer = Some(fixed_colours(&scene, &device).unwrap());
    (scene.time.warmup_frames, scene.time.slides) = (0, Some(1));
    let truth = Truth::new([77, 78].map(|seed| {
        let mut scene = Settings { seed, ..scene.clone() };
        (scene.render.method, scene.render.samples) = (Method::Reference, truth_samples as f64);
        (scene.render.until, scene.render.budget, scene.time.frames_per_slide) = (None, None, 1);
        let mut film = None;
        frames(&scene, &device, |frame| film = Some((*frame.film).clone()));
        film.unwrap()
    }))
    .unwrap();
    let tone_map = scene.render.tone_map;
    let size = [scene.render.width, scene.render.height];
    let name = file.file_stem().unwrap_or_default().display();
    println!("{name}: {size:?} pixels, truth of 2 x {truth_samples} samples; seconds since the window was there");
    for method in [Method::Reference, Method::Marched, Method::TwoLevel] {
        if words.len() > 3 && !words[3..].iter().any(|word| word == method.name()) {
            continue;
        }
        let mut scene = scene.clone();
        (scene.render.method, scene.time.frames_per_slide) = (method, count);
        println!(
            "\n| {}: seconds | frame, ms: picture, trace, audit | samples | rays | PSNR lit | all | rms | stated PSNR | stated rms | march rms |",
            method.name()
        );
        println!("|{}", "---|".repeat(10));
        let mut held = vec![Held::default(); count];
        for seed in 0..seeds {
            let scene = Settings { seed: scene.seed + seed, ..scene.clone() };
            let mut sum = Film::new(size[0], size[1]);
            // The measurement itself takes time between the frames.
            let mut since = 0.0;
            frames(&scene, &device, |frame| {
                let record = &frame.record;
                let stages = &record.seconds;
                let took = stages.total;
                since += took + stages.slide;
                let stated = record.picture_error;
                if stated.is_none() {
                    sum.accumulate(&frame.film).unwrap();
                }
                let film = if stated.is_some() { &frame.film } else { &sum };
                let true_error = picture_errors(film, &truth, tone_map);
                let samples = stated.map_or(record.samples_per_pixel * (record.frame + 1) as f64, |s| s.samples_per_pixel);
                let stated = stated.unwrap_or_default();
                held[record.frame as usize % count].count(&stated, &true_error);
                println!(
                    "| {since:.3} | {:.1} = {:.1} + {:.1} + {:.1} | {samples:.2} | {} | {:.2} | {:.2} | {:.5} | {:.2} ({:.2} to {:.2}) | {:.5} ({:.5} to {:.5}) | {:.5} |",
                    1e3 * took,
                    1e3 * stages.render,
                    1e3 * stages.trace,
                    1e3 * (stages.audit + stages.train),
                    stated.rays_per_pixel,
                    true_error.psnr,
                    true_error.psnr_all,
                    true_error.rms,
                    stated.psnr.value,
                    stated.psnr.low,
                    stated.psnr.high,
                    stated.rms.value,
                    stated.rms.low,
                    stated.rms.high,
                    stated.march_rms
                );
            });
        }
        for (frame, held) in held.iter().enumerate().filter(|_| seeds > 1) {
            let Held { rms, psnr, ratios } = held;
            let median = |values: &mut [f64]| {
                values.sort_by(f64::total_cmp);
                values[values.len() / 2]
            };
            let [mut linear, mut mapped]: [Vec<f64>; 2] = [0, 1].map(|which| ratios.iter().map(|ratio| ratio[which]).collect());
            println!(
                "{}, frame {frame}: of {seeds} intervals hold, lie above, below: rms {rms:?}, PSNR {psnr:?}; medians: stated over true rms {:.2}, \
                 stated less true PSNR {:.2} dB",
                method.name(),
                median(&mut linear),
                median(&mut mapped)
            );
        }
    }
}
