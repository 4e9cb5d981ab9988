//! Measures the time to error of smooth frames: the true and the stated error of each frame against the seconds since the window was new, for
//! a scene file. Runs on a GPU if there is one. Prints tables.
//!
//! `-- CONFIG TRUTH_SAMPLES FRAMES [reference] [marched] [two_level] [seeds=N] [until=38dB] [table.key=value]`. The truth is the mean of two
//! halves of `reference`; the product of the differences to the halves is the squared error without their noise. Lit pixels have an opacity
//! above 0.01 in the truth. Crests are the twentieth of the pixels that are brightest against those around them in the truth, thin ridges the
//! twentieth in which the surrogate of the first frame is most wrong. With `until`
//! each picture is drawn by a run with that target, and the errors are those of its last frame.

#![allow(clippy::unwrap_used, clippy::print_stdout)] // a measurement, which may stop and prints

use ridgewatch::backend::{Device, DeviceChoice, DeviceSettings};
use ridgewatch::chart::{PictureErrors, Truth, fixed_colours, picture_errors};
use ridgewatch::config::SceneFile;
use ridgewatch::render::smooth::{ErrorEstimate, PictureError, smoothed};
use ridgewatch::render::{Film, Method, Target, UNTIL_SLACK};
use ridgewatch::run::{Event, Frame, RunOptions, Settings, Setup, run};
use std::path::Path;
use std::sync::atomic::AtomicBool;

static NEVER: AtomicBool = AtomicBool::new(false);
/// Standard deviations of a 95 % interval of a normal distribution.
const Z95: f64 = 1.96;
/// Radius of what is around a pixel.
const AROUND: usize = 8;

/// Intervals that hold the true value, lie above it and below it; stated over true root mean squares and stated less true PSNR; widths of the
/// intervals of the root mean square over the values stated; shares of pixels whose error is within the stated one, in the order of [`Measured`].
#[derive(Clone, Default)]
struct Held {
    rms: [u32; 3],
    psnr: [u32; 3],
    ratios: Vec<[f64; 2]>,
    widths: Vec<f64>,
    within: Vec<[f64; 4]>,
}

impl Held {
    fn count(&mut self, stated: &PictureError, found: &PictureErrors, within: [f64; 4]) {
        for (counts, interval, found) in [(&mut self.rms, stated.rms, found.rms), (&mut self.psnr, stated.psnr, found.psnr)] {
            counts[if interval.low > found { 1 } else { 2 * usize::from(interval.high < found) }] += 1;
        }
        self.ratios.push([stated.rms.value / found.rms, stated.psnr.value - found.psnr]);
        self.widths.push(width(stated.rms));
        self.within.push(within);
    }
}

/// Width of an interval over its value.
fn width(estimate: ErrorEstimate) -> f64 {
    (estimate.high - estimate.low) / estimate.value
}

fn median(values: impl Iterator<Item = f64>) -> f64 {
    let mut values: Vec<f64> = values.collect();
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}

/// The truth, and pixels: all, lit ones, crests and thin ridges.
struct Measured {
    truth: Truth,
    /// Square of the truth's own standard error, mean over the channels and the pixels around.
    uncertain: Vec<f32>,
    pixels: [Vec<usize>; 4],
    tone_map: [f64; 3],
}

impl Measured {
    fn new(scene: &Settings, samples: f64, device: &Device) -> Self {
        let film = |seed: u64, method: Method| {
            let mut scene = Settings { seed, ..scene.clone() };
            (scene.render.method, scene.render.samples) = (method, samples);
            (scene.render.until, scene.render.budget, scene.time.frames_per_slide) = (None, None, 1);
            // Majorants that are tight make samples cheaper.
            (scene.time.warmup_frames, scene.time.warmup_samples) = (1, Some(1));
            if method == Method::Marched {
                (scene.render.samples, scene.surrogate.refine) = (1.0, false);
            }
            let mut film = None;
            frames(&scene, device, |frame| film = Some((*frame.film).clone()));
            film.unwrap()
        };
        let truth = Truth::new([77, 78].map(|seed| film(seed, Method::Reference))).unwrap();
        let all: Vec<usize> = (0..truth.halves[0].rgba.len()).collect();
        let lit = all.iter().copied().filter(|&pixel| truth.is_lit(pixel)).collect();
        let ridges = truth.most_wrong(&film(79, Method::Marched));
        let width = scene.render.width;
        let apart = |pixel: usize| {
            let [a, b] = [0, 1].map(|half: usize| truth.halves[half].rgba[pixel]);
            (0..3).map(|k| (0.5 * (a[k] - b[k])).powi(2)).sum::<f32>() / 3.0
        };
        let uncertain = smoothed(&all.iter().map(|&pixel| apart(pixel)).collect::<Vec<_>>(), width, AROUND);
        let luminances: Vec<f32> = truth.mean.luminances().into_iter().map(|value| value as f32).collect();
        let around = smoothed(&luminances, width, AROUND);
        let mut crests = all.clone();
        crests.sort_by(|&a, &b| (luminances[b] - around[b]).total_cmp(&(luminances[a] - around[a])));
        crests.truncate(all.len() / 20);
        Self { truth, uncertain, pixels: [all, lit, crests, ridges], tone_map: scene.render.tone_map }
    }

    fn errors(&self, film: &Film) -> PictureErrors {
        picture_errors(film, &self.truth, self.tone_map)
    }

    /// Shares of the pixels whose error is at most `Z95` times what the layer `error` and the noise of the truth amount to together.
    fn within(&self, film: &Film) -> [f64; 4] {
        let holds = |pixel: usize| {
            let (shown, truth) = (film.rgba[pixel], self.truth.mean.rgba[pixel]);
            let squared = (0..3).map(|k| f64::from(shown[k] - truth[k]).powi(2)).sum::<f64>() / 3.0;
            squared <= Z95.powi(2) * (f64::from(film.error[pixel]).powi(2) + f64::from(self.uncertain[pixel]))
        };
        self.pixels.each_ref().map(|pixels| pixels.iter().filter(|&&pixel| holds(pixel)).count() as f64 / pixels.len() as f64)
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

fn percent(shares: [f64; 4]) -> String {
    shares.map(|share| format!("{:.1}", 100.0 * share)).join(", ")
}

/// Frames of pictures, seed by seed.
fn table(scene: &Settings, device: &Device, measured: &Measured, (count, seeds): (usize, u64)) {
    let name = scene.render.method.name();
    println!(
        "\n| {name}: seconds | frame, ms: picture, trace, audit | samples | rays | PSNR lit | all | rms | stated PSNR | stated rms | width | march rms | \
         within, %: all, lit, crests, ridges |"
    );
    println!("|{}", "---|".repeat(12));
    let mut held = vec![Held::default(); count];
    for seed in 0..seeds {
        let mut scene = Settings { seed: scene.seed + seed, ..scene.clone() };
        scene.time.frames_per_slide = count;
        let mut sum = Film::new(scene.render.width, scene.render.height);
        // The measurement itself takes time between the frames.
        let mut since = 0.0;
        frames(&scene, device, |frame| {
            let record = &frame.record;
            let stages = &record.seconds;
            let took = stages.total;
            since += took + stages.slide;
            let stated = record.picture_error;
            if stated.is_none() {
                sum.accumulate(&frame.film).unwrap();
            }
            let film = if stated.is_some() { &*frame.film } else { &sum };
            let (true_error, within) = (measured.errors(film), stated.map_or([0.0; 4], |_| measured.within(film)));
            let samples = stated.map_or(record.samples_per_pixel * (record.frame + 1) as f64, |s| s.samples_per_pixel);
            let stated = stated.unwrap_or_default();
            held[record.frame as usize % count].count(&stated, &true_error, within);
            println!(
                "| {since:.3} | {:.1} = {:.1} + {:.1} + {:.1} | {samples:.2} | {} | {:.2} | {:.2} | {:.5} | {:.2} ({:.2} to {:.2}) | {:.5} ({:.5} to {:.5}) | \
                 {:.2} | {:.5} | {} |",
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
                width(stated.rms),
                stated.march_rms,
                percent(within)
            );
        });
    }
    for (frame, held) in held.iter().enumerate().filter(|_| seeds > 1) {
        let Held { rms, psnr, ratios, widths, within } = held;
        let [linear, mapped] = [0, 1].map(|which| median(ratios.iter().map(|ratio| ratio[which])));
        let shares = [0, 1, 2, 3].map(|which| median(within.iter().map(|within| within[which])));
        println!(
            "{name}, frame {frame}: of {seeds} intervals hold, lie above, below: rms {rms:?}, PSNR {psnr:?}; medians: stated over true rms {linear:.2}, \
             stated less true PSNR {mapped:.2} dB, width {:.2}, within {} %",
            median(widths.iter().copied()),
            percent(shares)
        );
    }
}

/// The mean square error of a picture over that of a target.
fn over(target: Target, psnr: f64, relmse: f64) -> f64 {
    match target {
        Target::Psnr(decibels) => 10f64.powf(0.1 * (decibels - psnr)),
        Target::Relmse(most) => relmse / most,
    }
}

/// Pictures that a run draws until it says that they are within a target.
fn stops(scene: &Settings, device: &Device, measured: &Measured, target: Target, seeds: u64) {
    let name = scene.render.method.name();
    println!(
        "\n| {name} until {target}: seconds | frames | samples | stated | true | mean square over the target, stated | true | stopped |"
    );
    println!("|{}", "---|".repeat(8));
    let mut ratios = Vec::new();
    for seed in 0..seeds {
        let mut scene = Settings { seed: scene.seed + seed, ..scene.clone() };
        (scene.render.until, scene.time.frames_per_slide) = (Some(target), 1);
        let (mut since, mut last) = (0.0, None);
        frames(&scene, device, |frame| {
            since += frame.record.seconds.total + frame.record.seconds.slide;
            last = Some(frame);
        });
        let frame = last.unwrap();
        let (stated, found) = (frame.record.picture_error.unwrap_or_default(), measured.errors(&frame.film));
        let [stated_over, true_over] = [over(target, stated.psnr.value, stated.relmse.value), over(target, found.psnr, found.relmse)];
        let [stated_as, true_as] = match target {
            Target::Psnr(_) => [stated.psnr.value, found.psnr].map(|decibels| format!("{decibels:.2} dB")),
            Target::Relmse(_) => [stated.relmse.value, found.relmse].map(|relmse| format!("{relmse:.3e}")),
        };
        // The same that ends the frames of a run.
        let is_met = target.is_met_by(&stated);
        println!(
            "| {since:.2} | {} | {:.1} | {stated_as} | {true_as} | {stated_over:.2} | {true_over:.2} | {} |",
            frame.record.frame + 1,
            stated.samples_per_pixel,
            if is_met { "at the target" } else { "before it" }
        );
        ratios.extend(is_met.then_some(true_over));
    }
    let held = ratios.iter().filter(|&&ratio| ratio <= UNTIL_SLACK).count();
    println!(
        "{name}: {} of {seeds} pictures reached {target}, {held} of them with at most {UNTIL_SLACK} times its mean square",
        ratios.len()
    );
}

fn main() {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let (mut keys, words): (Vec<String>, Vec<String>) = arguments.into_iter().partition(|a| a.contains('='));
    let seeds: u64 = keys.iter().find_map(|key| key.strip_prefix("seeds=")).map_or(1, |n| n.parse().unwrap());
    let until: Option<Target> = keys.iter().find_map(|key| key.strip_prefix("until=")).map(|target| target.parse().unwrap());
    keys.retain(|key| !key.starts_with("seeds=") && !key.starts_with("until="));
    let file = Path::new(words.first().map_or("configs/turbulence_easy.toml", String::as_str));
    let number = |i: usize, default: usize| words.get(i).and_then(|w| w.parse().ok()).unwrap_or(default);
    let (truth_samples, count) = (number(1, 1024), number(2, 12));
    let text = std::fs::read_to_string(file).unwrap();
    let mut scene = SceneFile::parse(file, &text, &keys).unwrap().settings();
    let device = Device::open(DeviceChoice::Auto, &DeviceSettings::default()).unwrap();
    scene.transfer = Some(fixed_colours(&scene, &device).unwrap());
    (scene.time.warmup_frames, scene.time.slides) = (0, Some(1));
    let measured = Measured::new(&scene, truth_samples as f64, &device);
    let name = file.file_stem().unwrap_or_default().display();
    let size = [scene.render.width, scene.render.height];
    println!("{name}: {size:?} pixels, truth of 2 x {truth_samples} samples; seconds since the window was there");
    for method in [Method::Reference, Method::Marched, Method::TwoLevel] {
        // Only pictures that accumulate have a target.
        let is_asked = if words.len() > 3 {
            words[3..].iter().any(|word| word == method.name())
        } else {
            until.is_none() || method == Method::TwoLevel
        };
        if !is_asked {
            continue;
        }
        let mut scene = scene.clone();
        scene.render.method = method;
        match until {
            Some(target) => stops(&scene, &device, &measured, target, seeds),
            None => table(&scene, &device, &measured, (count, seeds)),
        }
    }
}
