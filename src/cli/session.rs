//! A run of `replay` or `attach`: from a scene to a run folder and the socket.

use super::common::{
    CHART, Common, Interrupted, RaceFile, Usage, beside_scene, check_folder, check_learns, chosen_steps, device, located, method,
    print_json, print_text, seconds, text_with_tau, verifies_nothing, word,
};
use super::dashboard::{self, Reach};
use super::signals::Stop;
use super::{messages, notify};
use anyhow::{Result, anyhow, bail};
use ridgewatch::config::SceneFile;
use ridgewatch::dashboard::DashboardSettings;
use ridgewatch::map::{Drawn, MapError, SlideMaps, annotated};
use ridgewatch::publish::{
    DEFAULT_ENDPOINT, FileStatistics, Filmed, Movie, MovieSettings, NewestFrame, Output, Peers, PublishError, PublishSettings, RunFolder,
    Summary, WhenDiskSlow,
};
use ridgewatch::render::Method;
use ridgewatch::run::{self, Event, FrameRecord, RunError, RunOptions, RunReport, Setup, Steering};
use ridgewatch::steer::{CommandSocket, SteerError};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

/// Options that `replay` and `attach` share.
#[derive(Debug, clap::Args)]
pub struct RunArguments {
    /// Run folder. `replay` refuses one that holds a run; `attach` takes the first of FOLDER, FOLDER-2, FOLDER-3 that does not.
    #[arg(long, short, value_name = "FOLDER", default_value = "out/run")]
    pub out: PathBuf,
    /// Replace an earlier run in that folder.
    #[arg(long)]
    pub overwrite: bool,
    /// Keep only the newest N frames on disk.
    #[arg(long, value_name = "N")]
    keep: Option<usize>,
    /// default, map (two dimensions), auto, reference, surrogate (neural), gated, marched or two_level; overrides the scene's.
    #[arg(long, value_parser = method)]
    method: Option<Method>,
    /// Publish frames at this ZeroMQ endpoint (port 0: any free one, which is printed); by default they go to files only.
    #[arg(long, value_name = "ENDPOINT", num_args = 0..=1, default_missing_value = DEFAULT_ENDPOINT)]
    publish: Option<String>,
    /// Show the run on a web page at this port or any free one, on this machine only without --bind; prints its address. Frames are published for
    /// it at the endpoint of --publish, or else where only this user reaches them.
    #[arg(long, value_name = "PORT", num_args = 0..=1, require_equals = true)]
    dashboard: Option<Option<u16>>,
    #[command(flatten)]
    reach: Reach,
    /// Accept signed commands (camera, tolerance, colours, method, budget, tau, direction, pause) at this endpoint: private, ipc://PATH or tcp://HOST:PORT. The connection file,
    /// which is printed, holds the key. With --dashboard its page steers, and without ENDPOINT another one is taken if private is in use.
    #[arg(long, value_name = "ENDPOINT", num_args = 0..=1, require_equals = true)]
    steer: Option<Option<String>>,
    /// Make a film of the frames: NAME.gif, or NAME.mp4 by the program ffmpeg, which must be installed. `replay` refuses a film that exists, unless
    /// --overwrite is given; `attach` takes the first of NAME, NAME-2, NAME-3 that does not.
    #[arg(long, value_name = "FILE")]
    movie: Option<PathBuf>,
    /// What the film shows: frames, or maps (those of the slides, with what the table [maps] of the scene draws over them; two dimensions).
    #[arg(long, value_name = "WHAT", default_value = "frames", value_parser = filmed, requires = "movie")]
    movie_of: Filmed,
    /// Frames a second of the film, from 1 to 50.
    #[arg(long, value_name = "N", default_value_t = 10.0, requires = "movie")]
    movie_fps: f64,
    /// Draw a strip below the PNGs of the frames: colour bar, time, source, stated error. Films get time and error in a corner instead. Published
    /// frames and EXR stay as they are.
    #[arg(long)]
    annotate: bool,
    /// Check each frame's stated error afterwards on N new points, and record the result.
    #[arg(long, value_name = "N", default_value_t = 0, value_parser = clap::value_parser!(u64).range(0..=100_000_000))]
    verify: u64,
    /// Begin no further frame after N seconds of wall clock.
    #[arg(long, value_name = "N", value_parser = seconds)]
    seconds: Option<f64>,
    /// End within N seconds of the first signal to stop: the frame in progress has half of them and is abandoned then; summary and checkpoint
    /// have the rest. By default `attach` has 15 seconds and `replay` as long as its frame takes.
    #[arg(long, value_name = "N", value_parser = seconds)]
    pub stop_within: Option<f64>,
    /// Write the trained surrogate here at the end. `attach` also writes it every 30 seconds, and resumes from it when it is started again.
    #[arg(long, value_name = "FILE")]
    pub checkpoint: Option<PathBuf>,
    /// Start from a surrogate written by --checkpoint.
    #[arg(long, value_name = "FILE")]
    resume: Option<PathBuf>,
}

impl RunArguments {
    /// Applies the options to the scene.
    pub fn apply(&self, scene: &mut SceneFile) -> Result<()> {
        if self.dashboard.is_none() {
            self.reach.refuse_without_page()?;
        }
        if let Some(method) = self.method {
            scene.render.method = method;
        }
        if let Some(keep) = self.keep {
            if keep == 0 {
                bail!(Usage("--keep 0: accepted: 1 or more".into()));
            }
            scene.publish.keep = Some(keep);
        }
        if let Some(endpoint) = &self.publish {
            scene.publish.endpoint = Some(endpoint.clone()).filter(|word| word != "none");
            scene.set_by("publish.endpoint", format!("--publish {endpoint}"));
        }
        if self.movie_of == Filmed::Maps && !scene.publish.maps {
            bail!(Usage("--movie-of maps: accepted: with publish.maps = true".into()));
        }
        check_learns(scene, "--checkpoint", self.checkpoint.as_deref())?;
        check_learns(scene, "--resume", self.resume.as_deref())?;
        scene.training.resume = self.resume.clone().or(scene.training.resume.take());
        Ok(())
    }
}

/// A run that is about to start.
pub struct Session<'a> {
    pub common: &'a Common,
    pub options: &'a RunArguments,
    pub scene: SceneFile,
    /// Scene as it is kept in the run folder.
    pub text: String,
    /// `None` for replays.
    pub follows: Option<Follows>,
    /// The scene file, beside which its chart and its last race of methods are kept; data files have neither.
    pub paths: &'a [PathBuf],
}

/// What a run that follows a simulation has besides.
pub struct Follows {
    /// Seconds between two checkpoints.
    pub checkpoint_seconds: f64,
    /// Weights of an earlier start, which need not fit.
    pub resume_if_fit: Option<PathBuf>,
    /// Run folder of the command line, from which the first vacant one is found.
    pub wanted: PathBuf,
}

impl Session<'_> {
    /// Runs. `open` may wait for its source until the flag is set, and then returns `None`.
    pub fn run(self, open: impl FnOnce(&SceneFile, &AtomicBool) -> Result<Option<Setup>>) -> Result<()> {
        let Self { common, options, scene, text, follows: following, paths } = self;
        let wanted = following.as_ref().filter(|_| !options.overwrite).map(|following| following.wanted.as_path());
        // Before any wait or work. The folder is checked again when it is created, in case another run takes it meanwhile.
        match RunFolder::refuse_occupied(&options.out, options.overwrite) {
            Err(PublishError::InUse { .. } | PublishError::Occupied { .. }) if wanted.is_some() => {}
            free => free?,
        }
        // Also before: a token's file that others may read costs no work.
        let page = options.dashboard.map(|port| options.reach.settings(port)).transpose()?;
        let stop = Stop::default();
        let within = options.stop_within.map(Duration::try_from_secs_f64).transpose().unwrap_or_default();
        let watch = || stop.watch(within, || ());
        let _notifying = notify::begin(stop.requested.clone());
        // While `attach` waits for its source, a signal must stop the wait. While `replay` opens its source, a signal ends the process at once.
        let follows = following.is_some();
        if follows {
            watch();
        }
        let Some(mut setup) = open(&scene, &stop.requested)? else {
            messages::note("stopped before a simulation came");
            return Ok(());
        };
        for usage in [verifies_nothing(&setup, options.verify), films_nothing(&setup, options.movie_of)].into_iter().flatten() {
            if !follows {
                bail!(usage);
            }
            // The simulation does not come again.
            messages::note(usage);
        }
        let text = text_with_tau(&scene, &setup, text)?;
        let device = device(common, &scene)?;
        let race = RaceFile::of(common, &scene, paths, &device)?;
        setup.earlier_race = race.as_ref().and_then(|race| race.read(&setup.plan));
        if let Some(checkpoint) = &options.checkpoint {
            check_folder(checkpoint)?;
        }
        // Before anything is written: from here on, a signal leaves a complete folder.
        if !follows {
            watch();
        }
        // The socket first: a port in use must not cost the previous run in the folder.
        let mut publish = scene.publish_settings();
        let started = if options.dashboard.is_some() { start_shown(&mut publish) } else { Output::start(&publish, None) };
        let mut output = started.map_err(|error| located(&scene, error, PublishError::refused))?;
        let steering = options.steer.as_ref().map(|_| Arc::new(Steering::new(&setup.plan)));
        let named = options.steer.iter().flatten().next();
        let listen = |steering| listen(named.map(String::as_str), options.dashboard.is_some(), steering);
        let commands = steering.as_ref().map(listen).transpose()?;
        let movie = options.movie.as_deref().map(|path| film(path, options, follows, &publish)).transpose()?;
        let mut folder = wanted.map_or_else(|| RunFolder::create(&options.out, options.overwrite), RunFolder::create_vacant)?;
        let out = folder.path().to_owned();
        if out != options.out {
            messages::note(format_args!("this run is written to {}, not to {}", out.display(), options.out.display()));
        }
        if let Err(error) = folder.write_scene(if follows { "attach" } else { "replay" }, &text) {
            folder.give_up();
            return Err(error.into());
        }
        if options.annotate {
            folder.draw_by(|frame| annotated(frame).map_err(std::io::Error::other));
        }
        output.write_to(folder, &publish)?;
        movie.into_iter().for_each(|movie| output.film(movie));
        if let Some(endpoint) = output.endpoint() {
            messages::note(format_args!("publishing at {endpoint}"));
        }
        if let Some(commands) = &commands {
            messages::note(format_args!("commands at {}, with the key in {}", commands.endpoint(), commands.connection().display()));
        }
        let newest = Arc::new(NewestFrame::of_run(&out, &setup.plan));
        output.describe(&newest.about());
        let dashboard = page.zip(output.endpoint()).and_then(|(page, endpoint)| {
            let steer = commands.as_ref().map(|commands| commands.connection().to_owned());
            let chart = beside_scene(paths, CHART).and_then(|file| std::fs::read(file).ok());
            let (endpoint, newest) = (endpoint.to_owned(), Some(Arc::clone(&newest)));
            dashboard::beside(common, &options.reach, DashboardSettings { endpoint, steer, newest, run: Some(out.clone()), chart, ..page })
        });
        let newest = Some(newest).filter(|_| dashboard.is_some());
        newest.iter().for_each(|newest| output.keep_newest(Arc::clone(newest)));
        let run_options = RunOptions {
            verify_points: options.verify as usize,
            seconds: options.seconds,
            threads: common.threads,
            checkpoint: options.checkpoint.clone(),
            checkpoint_seconds: following.as_ref().map(|following| following.checkpoint_seconds),
            resume_if_fit: following.and_then(|following| following.resume_if_fit),
            device,
            steering,
            abandon: stop.abandoned.clone(),
        };
        let maps = SlideMaps::new(&setup.plan, &run_options.device).filter(|_| publish.maps);
        let plan = setup.plan.clone();
        let (result, last, summary) = work(setup, &scene, &run_options, output, newest, maps, &stop.requested);
        let report = result?;
        if let (Some(file), Some(found)) = (race, report.race.as_ref().filter(|_| !report.is_steered)) {
            file.write(&plan, found.clone())?;
        }
        for warning in &report.warnings {
            messages::note(format_args!("after the last frame: {warning}"));
        }
        if common.json {
            print_json(&summary)?;
        } else {
            print_report(&report, last.as_deref());
        }
        if let Some(lost) = summary.files.as_ref().and_then(FileStatistics::lost) {
            let only_maps = summary.files.as_ref().is_some_and(|files| files.lost_only_maps());
            bail!("{}: {lost}", out.join(if only_maps { "maps" } else { "frames" }).display());
        }
        if !common.json {
            print_text(format_args!("frames in {}", out.join("frames").display()));
            let maps = summary.files.as_ref().map_or(0, |files| files.maps_written);
            if maps > 0 {
                let what = if maps == report.slides {
                    "a map of each slide".to_owned()
                } else {
                    format!("maps of {maps} of {} slides", report.slides)
                };
                print_text(format_args!("{what} in {}", out.join("maps").display()));
            }
            summary.movie.iter().for_each(|movie| print_text(movie.line()));
        }
        const DONE: &str = "the run folder is complete up to the last finished frame";
        match (report.interrupted, follows) {
            (false, _) => Ok(()),
            // A signal is the normal end of a run that follows a simulation.
            (true, true) => {
                messages::note(format_args!("stopped by a signal; {DONE}"));
                Ok(())
            }
            (true, false) => Err(Interrupted { status: stop.status(), done: DONE }.into()),
        }
    }
}

fn filmed(text: &str) -> Result<Filmed, String> {
    word(text, "frames, maps")
}

/// Refuses a film of maps that the flow has not.
fn films_nothing(setup: &Setup, of: Filmed) -> Option<Usage> {
    let has_none = of == Filmed::Maps && setup.plan.domain.dimensions == 3;
    has_none.then(|| Usage("--movie-of maps: the flow has three dimensions, whose slides have no maps; accepted: frames".into()))
}

/// Starts the film of a run. A run that follows a simulation, which may be started again, takes a name that is free.
fn film(path: &Path, options: &RunArguments, follows: bool, publish: &PublishSettings) -> Result<Movie> {
    let mut name = path.to_owned();
    let mut number = 2;
    while follows && !options.overwrite && name.symlink_metadata().is_ok() {
        let [stem, extension] = [path.file_stem(), path.extension()].map(|part| part.unwrap_or_default().to_string_lossy().into_owned());
        name = path.with_file_name(format!("{stem}-{number}.{extension}"));
        number += 1;
    }
    if name != path {
        messages::note(format_args!("{} exists: the film is written to {}", path.display(), name.display()));
    }
    let settings = MovieSettings {
        of: options.movie_of,
        path: name,
        frames_per_second: options.movie_fps,
        annotate: options.annotate,
        waits: publish.when_disk_slow.unwrap_or(WhenDiskSlow::Wait) == WhenDiskSlow::Wait,
        overwrite: options.overwrite,
    };
    Ok(Movie::start(settings)?)
}

/// Starts the output of a run with a dashboard. An endpoint that is wanted for the dashboard alone costs no run: another `ridgewatch` may publish
/// at the private one.
fn start_shown(publish: &mut PublishSettings) -> Result<Output, PublishError> {
    if publish.endpoint.is_none() {
        let mut shown = PublishSettings { peers: Some(Peers::User), ..publish.clone() };
        for endpoint in [DEFAULT_ENDPOINT, "tcp://127.0.0.1:0"] {
            shown.endpoint = Some(endpoint.to_owned());
            match Output::start(&shown, None) {
                Ok(output) => {
                    *publish = shown;
                    return Ok(output);
                }
                Err(error) => tracing::info!("no frames for the dashboard: {error}"),
            }
        }
        messages::note("no frames for the dashboard: neither the private endpoint nor another one is free (--publish names one)");
    }
    Output::start(publish, None)
}

/// Binds the command socket. One that no endpoint is named for, and whose page finds it, costs no run: another one may listen at the private one.
fn listen(named: Option<&str>, is_shown: bool, steering: &Arc<Steering>) -> Result<CommandSocket, SteerError> {
    let bind = |endpoint| CommandSocket::bind(endpoint, Arc::clone(steering));
    match bind(named.unwrap_or(DEFAULT_ENDPOINT)) {
        Err(error) if named.is_none() && is_shown && error.is_in_use() => bind("tcp://127.0.0.1:0"),
        bound => bound,
    }
}

/// Runs the cycle on the calling thread. Whatever happens, completes the output of the frames made so far.
fn work(
    setup: Setup,
    scene: &SceneFile,
    options: &RunOptions,
    mut output: Output,
    newest: Option<Arc<NewestFrame>>,
    mut maps: Option<SlideMaps>,
    stop: &AtomicBool,
) -> (Result<RunReport>, Option<Arc<FrameRecord>>, Summary) {
    let (source, time_unit) = (setup.plan.source.clone(), setup.plan.time_unit.clone());
    let mut bar = messages::progress(None);
    let mut last: Option<Arc<FrameRecord>> = None;
    let mut sink = |event| match event {
        Event::Slide(shown) => {
            newest.iter().filter_map(|newest| newest.slide()).for_each(|newest| newest.put(&shown));
            // A signal ends the run soon.
            if let Some(drawing) = maps.as_mut().filter(|_| shown.is_new && !stop.load(Ordering::Relaxed)) {
                bar.set_message(format!("map of slide {}", shown.slide.index));
                match drawing.draw(*shown, stop) {
                    Ok((drawn, notes)) => {
                        notes.iter().for_each(|text| bar.suspend(|| messages::note(text)));
                        match drawn {
                            Drawn::Map(map) => output.map(map),
                            Drawn::TooSlow | Drawn::Apart => output.no_map(),
                            Drawn::TooEarly => {}
                        }
                    }
                    Err(MapError::Stopped) => {}
                    Err(error) => {
                        bar.suspend(|| messages::note(format_args!("no maps from here on: {error}; the frames go on")));
                        maps = None;
                    }
                }
            }
        }
        event => show(event, &mut bar, &mut last, &mut output),
    };
    let run = || run::run(setup, options, &mut sink, stop);
    // A panic must not cost the frames already made.
    let result = std::panic::catch_unwind(std::panic::AssertUnwindSafe(run)).map_err(|_| anyhow!("the cycle panicked (see above)"));
    let result = result.and_then(|result| result.map_err(|error| located(scene, error, RunError::refused)));
    bar.finish_and_clear();
    let _finishing = messages::spinner("finishing the files".into());
    let mut run = serde_json::Map::new();
    run.insert("title".into(), scene.title.as_str().into());
    run.insert("seed".into(), scene.seed.into());
    run.insert("version".into(), env!("CARGO_PKG_VERSION").into());
    run.insert("source".into(), source.into());
    run.insert("time_unit".into(), time_unit.into());
    match &result {
        Ok(report) => run.extend(run_json(report)),
        Err(error) => drop(run.insert("failed".into(), error.to_string().into())),
    }
    (result, last, output.finish(run))
}

fn print_report(report: &RunReport, last: Option<&FrameRecord>) {
    let counted = |count: u64, what: &str| format!("{count} {what}{}", if count == 1 { "" } else { "s" });
    let mut text = format!("{} of {}", counted(report.frames, "frame"), counted(report.slides, "slide"));
    if report.time_is_up {
        let of = report.slides_expected.filter(|there| *there > report.slides).map(|there| format!(", which has {there} slides"));
        text += &format!("; --seconds ended the run{}", of.unwrap_or_default());
    }
    if let Some(last) = last {
        text += &format!(
            "; {} Runge-Kutta steps a path{}\nlast frame: {}",
            report.integration_steps.map_or("adaptive".to_owned(), |steps| steps.to_string()),
            match report.surrogate_bytes {
                0 => String::new(),
                bytes => format!("; surrogate {:.2} MB after {} optimizer steps", bytes as f64 / 1e6, report.train_steps),
            },
            line(last)
        );
    }
    print_text(text);
}

fn show(event: Event, bar: &mut indicatif::ProgressBar, last: &mut Option<Arc<FrameRecord>>, output: &mut Output) {
    match event {
        Event::Begin { frames, notes } => {
            *bar = messages::progress(frames);
            bar.set_message("filling the first window");
            notify::running(|| "filling the first window".into());
            for text in notes {
                bar.suspend(|| messages::note(text));
            }
        }
        Event::Note(text) => {
            bar.suspend(|| messages::note(text));
            if last.is_none() {
                notify::running(|| "preparing the first frame".into());
            }
        }
        Event::Slide(_) => {}
        Event::Progress(share) => {
            bar.set_message(format!("frame {:3.0} %", share * 100.0));
            notify::running(|| match last {
                Some(last) => format!("frame {}: {:.0} %; {}", last.frame + 1, share * 100.0, line(last)),
                None => format!("frame 0: {:.0} %", share * 100.0),
            });
        }
        Event::Frame(frame) => {
            for warning in &frame.record.warnings {
                bar.suspend(|| messages::note(format_args!("frame {}: {warning}", frame.record.frame)));
            }
            if last.is_none()
                && let (Some(steps), Some(difference)) = (frame.record.integration_steps, frame.record.integration_difference)
            {
                bar.suspend(|| messages::note(chosen_steps(steps, difference, frame.record.integration_residual)));
            }
            tracing::info!("frame {}: {}", frame.record.frame, line(&frame.record));
            notify::running(|| format!("frame {}: {}", frame.record.frame, line(&frame.record)));
            *last = Some(frame.record.clone());
            output.frame(frame);
            bar.inc(1);
        }
    }
}

/// Share traced from which the surrogate saves next to nothing.
const NOTHING_SAVED: f64 = 0.9;

/// Describes a frame in one line.
pub fn line(record: &FrameRecord) -> String {
    let mut text = match &record.date {
        Some(date) => format!("{date}, "),
        None => format!("t = {}, ", record.time),
    };
    let queries = record.queries - record.missing;
    text += &match record.method.as_str() {
        "map" => format!("{queries} seeds"),
        "gated" if record.traced_share >= NOTHING_SAVED => {
            format!("the surrogate saved nothing: {:.1} % of {queries} queries were traced", 100.0 * record.traced_share)
        }
        // All that these trace is traced, whatever drew the picture.
        "two_level" => format!("drawn by {} and corrected with {} traced points", what_drew(record), record.traced),
        "marched" => format!("drawn by {}, uncorrected: {} traced points only measure its error", what_drew(record), record.traced),
        _ => format!("traced {:.1} % of {queries} queries", 100.0 * record.traced_share),
    };
    if record.missing > 0 {
        text += &format!(", {} more on land", record.missing);
    }
    if record.audited > 0 && record.mean_lifetime_share < 0.9995 {
        text += &format!(", particles live {:.1} % of tau", 100.0 * record.mean_lifetime_share);
    }
    if let Some(error) = &record.picture_error {
        let (psnr, rms) = (error.psnr, error.rms);
        let of = if record.method == "map" { " of the colours' range" } else { "" };
        text += &format!(
            ", picture {:.1} dB [{:.1}, {:.1}], error {:.4} [{:.4}, {:.4}] rms{of}",
            psnr.value, psnr.low, psnr.high, rms.value, rms.low, rms.high
        );
    } else if let Some(error) = &record.trusted_error {
        text += &format!(
            ", error where trusted {:.4} [{:.4}, {:.4}] rms",
            error.optical_rms, error.optical_rms_interval[0], error.optical_rms_interval[1]
        );
    }
    if let Some(over) = record.tolerance_excess {
        text += &format!(" (ABOVE trust.tolerance by {over:.4})");
    }
    text + &format!(", {:.2} s", record.seconds.total)
}

/// What draws the picture of a smooth method.
fn what_drew(record: &FrameRecord) -> &'static str {
    match record.surrogate.as_deref() {
        Some("table") => "a table",
        Some("network") => "a network",
        Some("residual") => "a table with a network",
        _ => "a surrogate",
    }
}

fn run_json(report: &RunReport) -> serde_json::Map<String, serde_json::Value> {
    let serde_json::Value::Object(map) = serde_json::json!({
        "frames": report.frames,
        "slides": report.slides,
        "slides_expected": report.slides_expected,
        "interrupted": report.interrupted,
        "time_is_up": report.time_is_up,
        "waited_seconds": report.waited,
        // Share of the time for input and work; saving and publishing are not counted.
        "waited_share": if report.waited > 0.0 { report.waited / (report.waited + report.worked) } else { 0.0 },
        "optimizer_steps": report.train_steps,
        "integration_steps": report.integration_steps,
        "integration_difference": report.integration_difference,
        "precision_difference": report.precision_difference,
        "tangent_difference": report.tangent_difference,
        "integration_residual": report.integration_residual,
        "transfer": report.transfer,
        "surrogate_bytes": report.surrogate_bytes,
        "decisions": report.decisions,
        "race": report.race,
        "sizes": report.sizes,
        "window_bytes_peak": report.window_bytes,
        "checkpoints": report.checkpoints,
        "warnings": report.warnings,
        "time_resolution": report.time_resolution,
    }) else {
        unreachable!("an object literal")
    };
    map
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_line_names_what_drew_the_picture_and_what_was_traced() {
        let told = |method: &str, surrogate: Option<&str>, traced: u64| {
            let record = FrameRecord {
                method: method.into(),
                surrogate: surrogate.map(Into::into),
                queries: 2552,
                traced,
                traced_share: traced as f64 / 2552.0,
                ..FrameRecord::default()
            };
            line(&record)
        };
        let table = Some("table");
        assert_eq!(told("two_level", table, 2552), "t = 0, drawn by a table and corrected with 2552 traced points, 0.00 s");
        let marched = "t = 0, drawn by a table with a network, uncorrected: 2552 traced points only measure its error, 0.00 s";
        assert_eq!(told("marched", Some("residual"), 2552), marched);
        assert_eq!(told("gated", Some("network"), 319), "t = 0, traced 12.5 % of 2552 queries, 0.00 s");
        assert_eq!(told("gated", table, 2552), "t = 0, the surrogate saved nothing: 100.0 % of 2552 queries were traced, 0.00 s");
        assert_eq!(told("reference", None, 2552), "t = 0, traced 100.0 % of 2552 queries, 0.00 s");
    }
}
