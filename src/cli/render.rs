//! `ridgewatch render`.

use super::common::{
    Common, RaceFile, Usage, check_folder, check_learns, chosen_steps, device, located, method, open, print_json, print_text, scene,
    text_with_tau, verifies_nothing,
};
use super::{messages, session};
use anyhow::{Context, Result, bail};
use ridgewatch::files::write_whole;
use ridgewatch::map::annotated;
use ridgewatch::publish::{refuse_foreign_scene, write_exr, write_png, write_scene};
use ridgewatch::render::{Method, Target};
use ridgewatch::run::{self, Event, Frame, RunError, RunOptions};
use std::path::PathBuf;
use std::sync::atomic::AtomicBool;

/// Options of `render`.
#[derive(Debug, clap::Args)]
pub struct Options {
    /// A scene file (.toml), or data files, globs and URLs of Zarr stores.
    #[arg(required = true, value_name = "CONFIG | FILES")]
    paths: Vec<PathBuf>,
    /// default, map (two dimensions), auto, reference, surrogate (neural), gated, marched or two_level; overrides the scene's.
    #[arg(long, value_parser = method)]
    method: Option<Method>,
    /// Samples a pixel; overrides the scene's `render.samples`. Fractions are accepted by map (which takes an even number), marched and two_level.
    #[arg(long, value_name = "N")]
    spp: Option<f64>,
    /// map, marched and two_level: refine until the stated error is below this, e.g. 40dB or relmse=1e-3, and its interval reaches at most 20 % beyond.
    #[arg(long, value_name = "TARGET")]
    until: Option<Target>,
    /// two_level: milliseconds of sampling per frame, instead of --spp.
    #[arg(long, value_name = "MS", conflicts_with = "spp")]
    budget: Option<f64>,
    /// Number of frames rendered and discarded first, with the scene's samples; they train the surrogate and tighten the majorants.
    /// Default: the scene's time.warmup_frames.
    #[arg(long, value_name = "N")]
    warmup: Option<usize>,
    /// Check the stated error on N new points.
    #[arg(long, value_name = "N", default_value_t = 0, value_parser = clap::value_parser!(u64).range(0..=100_000_000))]
    verify: u64,
    /// Start from a surrogate written by `replay --checkpoint`.
    #[arg(long, value_name = "FILE")]
    resume: Option<PathBuf>,
    /// Draw a strip below the PNG: colour bar, time, source, stated error. The EXR stays as it is.
    #[arg(long)]
    annotate: bool,
    /// Picture: .exr (all layers, linear) or .png (tone-mapped). An .exr gets a .png beside it, and both a .scene.toml,
    /// from which `render` makes the picture again.
    #[arg(long, short, default_value = "out/render.exr")]
    out: PathBuf,
}

/// Renders.
pub fn run(common: &Common, options: Options) -> Result<()> {
    let mut scene = scene(common, &options.paths)?;
    if let Some(method) = options.method {
        scene.render.method = method;
    }
    let extension = options.out.extension().and_then(|e| e.to_str()).unwrap_or("").to_ascii_lowercase();
    if !["exr", "png"].contains(&extension.as_str()) {
        bail!(Usage(format!("--out {}: accepted: a name that ends in .exr or .png", options.out.display())));
    }
    check_folder(&options.out)?;
    let scene_file = options.out.with_extension("scene.toml");
    refuse_foreign_scene(&scene_file)?;
    if let Some(samples) = options.spp {
        scene.time.warmup_samples.get_or_insert(scene.render.samples.ceil() as usize);
        scene.render.samples = samples;
        scene.set_by("render.samples", format!("--spp {samples}"));
    }
    if let Some(until) = options.until {
        scene.render.until = Some(until);
        scene.set_by("render.until", "--until".to_owned());
    }
    if let Some(budget) = options.budget {
        scene.render.budget = Some(budget);
        scene.set_by("render.budget", format!("--budget {budget}"));
    }
    scene.time.slides = Some(1);
    scene.time.frames_per_slide = 1;
    if let Some(frames) = options.warmup {
        scene.time.warmup_frames = frames;
        scene.set_by("time.warmup_frames", format!("--warmup {frames}"));
    }
    let device = device(common, &scene)?;
    let race = RaceFile::of(common, &scene, &options.paths, &device)?;
    check_learns(&scene, "--resume", options.resume.as_deref())?;
    scene.training.resume = options.resume.clone().or(scene.training.resume);
    let run_options = RunOptions { verify_points: options.verify as usize, threads: common.threads, device, ..RunOptions::default() };
    let scene_text = scene.to_toml()?;
    let mut setup = open(&scene)?;
    setup.earlier_race = race.and_then(|race| race.read(&setup.plan));
    if let Some(usage) = verifies_nothing(&setup, options.verify) {
        bail!(usage);
    }
    let scene_text = text_with_tau(&scene, &setup, scene_text)?;
    let mut bar = messages::progress(Some(100));
    let mut picture: Option<Frame> = None;
    let (mut whole, mut warnings) = (0, Vec::new());
    let sink = &mut |event: Event| match event {
        Event::Begin { notes, frames } => {
            // Without a number of frames, the work in progress tells how many are left.
            bar = messages::progress(frames.map(|frames| 100 * frames));
            notes.into_iter().for_each(|text| bar.suspend(|| messages::note(text)));
        }
        Event::Note(text) => bar.suspend(|| messages::note(text)),
        Event::Slide(_) => {}
        Event::Progress(share) if bar.length().is_some() => bar.set_position(100 * whole + (share * 100.0) as u64),
        Event::Progress(_) => {}
        Event::Frame(frame) => {
            whole += 1;
            if bar.length().is_none() {
                bar.set_position(whole);
                bar.set_message("frames");
            }
            // Including warm-up frames, since some warnings appear once a run.
            warnings.extend(frame.record.warnings.iter().cloned());
            picture = Some(frame);
        }
    };
    run::run(setup, &run_options, sink, &AtomicBool::new(false)).map_err(|error| located(&scene, error, RunError::refused))?;
    bar.finish_and_clear();
    let frame = picture.context("no frame was made")?;
    if extension == "exr" {
        write_exr(&options.out, &frame.film, Some(&*frame.record))?;
    }
    let png = options.out.with_extension("png");
    if options.annotate {
        write_whole(&png, &annotated(&frame)?).with_context(|| format!("cannot write {}", png.display()))?;
    } else {
        write_png(&png, &frame.film, frame.tone_map)?;
    }
    write_scene(&scene_file, "render", &scene_text)?;
    if common.json {
        return print_json(&*frame.record);
    }
    for warning in &warnings {
        messages::note(warning);
    }
    if let (Some(steps), Some(difference)) = (frame.record.integration_steps, frame.record.integration_difference) {
        messages::note(chosen_steps(steps, difference, frame.record.integration_residual));
    }
    print_text(format_args!("{}: {}", options.out.display(), session::line(&frame.record)));
    Ok(())
}
