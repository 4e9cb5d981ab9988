//! `ridgewatch replay`.

use super::{Common, Interrupted, Usage, check_learns, located, messages, print_json, print_text, scene};
use anyhow::{Context, Result, anyhow, bail};
use ridgewatch::config::SceneFile;
use ridgewatch::engine::{self, EngineError, Event, FrameRecord, RunOptions, RunReport, Setup};
use ridgewatch::publish::{DEFAULT_ENDPOINT, FileStatistics, Output, PublishError, RunFolder};
use ridgewatch::render::Method;
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU8, Ordering};

/// Options of `replay`.
#[derive(Debug, clap::Args)]
pub struct Options {
    /// A scene file (.toml), or data files and globs that just get the defaults.
    #[arg(required = true, value_name = "CONFIG | FILES")]
    paths: Vec<PathBuf>,
    #[command(flatten)]
    run: RunArguments,
}

/// What `replay` and `attach` have in common.
#[derive(Debug, clap::Args)]
pub struct RunArguments {
    /// Run folder. `replay` refuses one that holds a run; `attach` takes the first of FOLDER, FOLDER-2, FOLDER-3 that does not.
    #[arg(long, short, value_name = "FOLDER", default_value = "out/run")]
    pub(super) out: PathBuf,
    /// Replaces an earlier run in that folder.
    #[arg(long)]
    pub(super) overwrite: bool,
    /// Keeps only the newest N frames on disk.
    #[arg(long, value_name = "N")]
    keep: Option<usize>,
    /// reference, surrogate (neural) or gated; overrides the scene's.
    #[arg(long, value_parser = super::method)]
    method: Option<Method>,
    /// Publishes frames at this ZeroMQ endpoint (port 0: any free one, which is printed); without it frames go to files only.
    #[arg(long, value_name = "ENDPOINT", num_args = 0..=1, default_missing_value = DEFAULT_ENDPOINT)]
    publish: Option<String>,
    /// Checks each frame's stated error on N fresh points afterwards and records that too.
    #[arg(long, value_name = "N", default_value_t = 0, value_parser = clap::value_parser!(u64).range(0..=100_000_000))]
    verify: u64,
    /// Begins no further frame after N seconds of wall clock.
    #[arg(long, value_name = "N", value_parser = super::seconds)]
    seconds: Option<f64>,
    /// Writes the trained surrogate here at the end; `attach` every 30 seconds too, and goes on from it when it is started again.
    #[arg(long, value_name = "FILE")]
    pub(super) checkpoint: Option<PathBuf>,
    /// Starts from a surrogate written by --checkpoint.
    #[arg(long, value_name = "FILE")]
    pub(super) resume: Option<PathBuf>,
}

/// Replays.
pub fn run(common: &Common, options: Options) -> Result<()> {
    let mut scene = scene(common, &options.paths)?;
    options.run.apply(&mut scene)?;
    let open = |scene: &SceneFile, _: &AtomicBool| super::open(scene).map(Some);
    let scene_text = scene.to_toml()?;
    conduct(common, &options.run, scene, &scene_text, None, open)
}

impl RunArguments {
    /// What the options change in the scene.
    pub(super) fn apply(&self, scene: &mut SceneFile) -> Result<()> {
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
        check_learns(scene, "--checkpoint", self.checkpoint.as_deref())?;
        check_learns(scene, "--resume", self.resume.as_deref())?;
        scene.training.resume = self.resume.clone().or(scene.training.resume.take());
        Ok(())
    }
}

/// Runs a scene into a run folder, where it is kept as `scene_text`, and onto the socket. `open` may wait for its source until the flag is set, and gives none then.
pub(super) fn conduct(
    common: &Common,
    options: &RunArguments,
    scene: SceneFile,
    scene_text: &str,
    checkpoint_seconds: Option<f64>,
    open: impl FnOnce(&SceneFile, &AtomicBool) -> Result<Option<Setup>>,
) -> Result<()> {
    let runtime =
        tokio::runtime::Builder::new_multi_thread().worker_threads(2).enable_all().build().context("cannot start the I/O threads")?;
    runtime.block_on(frames(common, options, scene, scene_text, checkpoint_seconds, open))
}

async fn frames(
    common: &Common,
    options: &RunArguments,
    scene: SceneFile,
    scene_text: &str,
    checkpoint_seconds: Option<f64>,
    open: impl FnOnce(&SceneFile, &AtomicBool) -> Result<Option<Setup>>,
) -> Result<()> {
    // Before anything is waited for or read; what another run makes of the folder meanwhile is refused below.
    RunFolder::refuse_occupied(&options.out, options.overwrite)?;
    let (stop, caught) = (Arc::new(AtomicBool::new(false)), Arc::new(AtomicU8::new(0)));
    let watch = || watch_signals(stop.clone(), caught.clone()).map(tokio::spawn);
    // A source that is waited for must be left by a signal; one that is there is opened before signals are caught, so that they end it at once.
    let follows = checkpoint_seconds.is_some();
    let early = if follows { watch() } else { None };
    let Some(setup) = open(&scene, &stop)? else {
        messages::note("stopped before a simulation came");
        return Ok(());
    };
    let device = super::device(common, &scene)?;
    if let Some(checkpoint) = &options.checkpoint {
        super::check_folder(checkpoint)?;
    }
    // Before anything is written: from here on a signal leaves a complete folder.
    let signals = early.or_else(watch);
    // The socket first: a port in use must not cost the run that the folder holds.
    let publish = scene.publish_settings();
    let mut output = Output::start(&publish, None).map_err(|error| located(&scene, error, PublishError::refused))?;
    let mut folder = RunFolder::create(&options.out, options.overwrite)?;
    if let Err(error) = folder.write_scene(if follows { "attach" } else { "replay" }, scene_text) {
        folder.put_back().with_context(|| format!("{}: the run before cannot be put back", options.out.display()))?;
        return Err(error.into());
    }
    output.write_to(folder, &publish)?;
    if let Some(endpoint) = output.endpoint() {
        messages::note(format_args!("publishing at {endpoint}"));
    }
    let run_options = RunOptions {
        verify_points: options.verify as usize,
        seconds: options.seconds,
        threads: common.threads,
        checkpoint: options.checkpoint.clone(),
        checkpoint_seconds,
        device,
    };
    let (source, time_unit) = (setup.plan.source.clone(), setup.plan.time_unit.clone());
    // The cycle is plain blocking work; reading, training and publishing go on beside it on threads of their own.
    let worker = tokio::task::spawn_blocking(move || {
        let mut bar = messages::progress(None);
        let mut last: Option<Arc<FrameRecord>> = None;
        let run = || engine::run(setup, &run_options, &mut |event| show(event, &mut bar, &mut last, &mut output), &stop);
        // A fault of ours must not cost the frames that are already made.
        let result = std::panic::catch_unwind(std::panic::AssertUnwindSafe(run)).map_err(|_| anyhow!("the cycle panicked (see above)"));
        let result = result.and_then(|result| result.map_err(|error| located(&scene, error, EngineError::refused)));
        bar.finish_and_clear();
        // Whatever happened, the frames made so far and their records are completed.
        let mut run = serde_json::Map::new();
        run.insert("title".into(), scene.title.into());
        run.insert("seed".into(), scene.seed.into());
        run.insert("version".into(), env!("CARGO_PKG_VERSION").into());
        run.insert("source".into(), source.into());
        run.insert("time_unit".into(), time_unit.into());
        match &result {
            Ok(report) => run.extend(run_json(report)),
            Err(error) => drop(run.insert("failed".into(), error.to_string().into())),
        }
        (result, last, output.finish(run))
    });
    let (result, last, summary) = worker.await.context("the cycle stopped unexpectedly")?;
    if let Some(signals) = signals {
        signals.abort();
    }
    let report = result?;
    for warning in &report.warnings {
        messages::note(format_args!("behind the last frame: {warning}"));
    }
    if common.json {
        print_json(&summary)?;
    } else {
        print_report(&report, last.as_deref());
    }
    if let Some(lost) = summary.files.as_ref().and_then(FileStatistics::lost) {
        bail!("{}: {lost}", options.out.join("frames").display());
    }
    if !common.json {
        print_text(format_args!("frames in {}", options.out.join("frames").display()));
    }
    const DONE: &str = "the run folder is complete up to the last finished frame";
    match (report.interrupted, follows) {
        (false, _) => Ok(()),
        // What follows a simulation without an end is ended so.
        (true, true) => {
            messages::note(format_args!("stopped by a signal; {DONE}"));
            Ok(())
        }
        (true, false) => Err(Interrupted { status: caught.load(Ordering::Relaxed), done: DONE }.into()),
    }
}

fn print_report(report: &RunReport, last: Option<&FrameRecord>) {
    let mut text = format!("{} frames of {} slides", report.frames, report.slides);
    // Before the first frame there is nothing else to tell.
    if let Some(last) = last {
        text += &format!(
            "; {} Runge-Kutta steps a path; surrogate {:.2} MB after {} optimizer steps\nlast frame: {}",
            report.integration_steps.map_or("adaptive".to_owned(), |steps| steps.to_string()),
            report.surrogate_bytes as f64 / 1e6,
            report.train_steps,
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
            for text in notes {
                bar.suspend(|| messages::note(text));
            }
        }
        Event::Note(text) => bar.suspend(|| messages::note(text)),
        Event::Progress(share) => bar.set_message(format!("frame {:3.0} %", share * 100.0)),
        Event::Frame(frame) => {
            for warning in &frame.record.warnings {
                bar.suspend(|| messages::note(format_args!("frame {}: {warning}", frame.record.frame)));
            }
            if last.is_none()
                && let (Some(steps), Some(difference)) = (frame.record.integration_steps, frame.record.integration_difference)
            {
                bar.suspend(|| messages::note(super::steps_told(steps, difference)));
            }
            tracing::info!("frame {}: {}", frame.record.frame, line(&frame.record));
            *last = Some(frame.record.clone());
            output.frame(frame);
            bar.inc(1);
        }
    }
}

/// A frame in one line.
pub(super) fn line(record: &FrameRecord) -> String {
    let mut text = match &record.date {
        Some(date) => format!("{date}, "),
        None => format!("t = {}, ", record.time),
    };
    text += &format!("traced {:.1} % of {} queries", 100.0 * record.traced_share, record.queries - record.missing);
    if record.missing > 0 {
        text += &format!(", {} more on land", record.missing);
    }
    if record.audited > 0 && record.mean_lifetime_share < 0.9995 {
        text += &format!(", particles live {:.1} % of tau", 100.0 * record.mean_lifetime_share);
    }
    if let Some(error) = &record.trusted_error {
        text += &format!(
            ", error where trusted {:.4} [{:.4}, {:.4}] rms",
            error.optical_rms, error.optical_rms_interval[0], error.optical_rms_interval[1]
        );
    }
    if let Some(over) = record.tolerance_excess {
        text += &format!(", OVER TOLERANCE by {over:.4}");
    }
    text + &format!(", {:.2} s", record.seconds.total)
}

fn run_json(report: &RunReport) -> serde_json::Map<String, serde_json::Value> {
    let serde_json::Value::Object(map) = serde_json::json!({
        "frames": report.frames,
        "slides": report.slides,
        "interrupted": report.interrupted,
        "waited_seconds": report.waited,
        // Of waiting for input and working, saving and publishing not counted.
        "waited_share": if report.waited > 0.0 { report.waited / (report.waited + report.worked) } else { 0.0 },
        "optimizer_steps": report.train_steps,
        "integration_steps": report.integration_steps,
        "integration_difference": report.integration_difference,
        "transfer": report.transfer,
        "surrogate_bytes": report.surrogate_bytes,
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

/// The first SIGINT or SIGTERM ends the run after the current frame, and leaves its exit status in `caught`; the second ends the process.
/// Both are caught from this call on.
pub(super) fn watch_signals(stop: Arc<AtomicBool>, caught: Arc<AtomicU8>) -> Option<impl Future<Output = ()>> {
    use tokio::signal::unix::{SignalKind, signal};
    let (Ok(mut interrupt), Ok(mut terminate)) = (signal(SignalKind::interrupt()), signal(SignalKind::terminate())) else {
        messages::note("cannot watch for signals: an interrupt will end the run at once");
        return None;
    };
    Some(async move {
        loop {
            let status = tokio::select! { _ = interrupt.recv() => 130u8, _ = terminate.recv() => 143 };
            caught.store(status, Ordering::Relaxed);
            if stop.swap(true, Ordering::Relaxed) {
                messages::note("stopped at once; what was not written yet is lost");
                // SAFETY: ends the process and touches no memory of ours. Not `exit`, whose handlers wait for libraries that may be
                // waiting for a disk.
                unsafe { libc::_exit(status.into()) }
            }
            messages::note("finishing the current frame; once more to stop at once");
        }
    })
}
